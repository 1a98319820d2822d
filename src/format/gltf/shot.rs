//! A camera that moves, in a document.

use glam::DQuat;
use serde_json::{Value, json};

use super::container::Bin;
use super::extension::{EXTRAS, ROOT_NODE};
use super::write::{FLOAT, camera_and_node, node_rotation};
use crate::format::cameras::NAME;
use crate::scene::Camera;

/// Where an animation of ours says how many frames it has a second.
pub(super) const FPS: &str = "framesPerSecond";

/// Adds cameras: one with a linear animation whose keys are the frames; where intrinsics differ, which glTF does not animate,
/// as many as there are. They are in the frame of what hangs below our root node, or in glTF's if there is none.
pub(super) fn append(document: &mut Value, bin: &mut Bin<'_>, cameras: &[(String, Camera)], fps: f64, near: f32) {
    let Some((_, first)) = cameras.first() else { return };
    if cameras.iter().all(|(_, camera)| camera.intrinsics() == first.intrinsics()) {
        let node = add_camera(document, NAME, first, near);
        let animation = animation(document, bin, cameras, fps, node);
        push(document, "animations", animation);
    } else {
        for (name, camera) in cameras {
            add_camera(document, name, camera, near);
        }
    }
    if bin.len() > 0 {
        if document.get("buffers").and_then(Value::as_array).is_none_or(Vec::is_empty) {
            document["buffers"] = json!([{}]);
        }
        document["buffers"][0]["byteLength"] = json!(bin.len());
    }
}

/// Marks our root node.
const OURS: &str = "/extras/centaur";

/// Returns its node.
fn add_camera(document: &mut Value, name: &str, camera: &Camera, near: f32) -> usize {
    let index = document.get("cameras").and_then(Value::as_array).map_or(0, Vec::len);
    let (optics, node) = camera_and_node(name, camera, near, index);
    push(document, "cameras", optics);
    let node = push(document, "nodes", node);
    let is_root = |n: &Value| n.get("name").is_some_and(|name| name == ROOT_NODE) && n.pointer(OURS).is_some();
    let root = document.get("nodes").and_then(Value::as_array).and_then(|nodes| nodes.iter().position(is_root));
    let scene = document.get("scene").and_then(Value::as_u64).unwrap_or(0) as usize;
    match root {
        Some(root) => push(&mut document["nodes"][root], "children", json!(node)),
        None => match document.get_mut("scenes").and_then(|scenes| scenes.get_mut(scene)) {
            Some(scene) => push(scene, "nodes", json!(node)),
            None => push(document, "scenes", json!({ "nodes": [node] })),
        },
    };
    node
}

fn animation(document: &mut Value, bin: &mut Bin<'_>, cameras: &[(String, Camera)], fps: f64, node: usize) -> Value {
    let times: Vec<f32> = (0..cameras.len()).map(|i| (i as f64 / fps) as f32).collect();
    let translations = cameras.iter().flat_map(|(_, c)| c.center().to_array()).map(|v| v as f32).collect();
    let mut last = DQuat::IDENTITY;
    let rotations = cameras.iter().flat_map(|(_, camera)| {
        let q = node_rotation(camera);
        // Programs that blend components need neighbours on the same side.
        last = if q.dot(last) < 0.0 { -q } else { q };
        last.to_array().map(|v| v as f32)
    });
    let rotations: Vec<f32> = rotations.collect();
    let ends = [times[0], times[times.len() - 1]];
    let mut accessor = |kind: &str, values: Vec<f32>| {
        let bytes: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
        let length = bytes.len();
        let view = json!({ "buffer": 0, "byteOffset": bin.push(bytes), "byteLength": length });
        let view = push(document, "bufferViews", view);
        let accessor = json!({ "bufferView": view, "componentType": FLOAT, "type": kind, "count": cameras.len() });
        push(document, "accessors", accessor)
    };
    let input = accessor("SCALAR", times);
    let outputs = [("translation", accessor("VEC3", translations)), ("rotation", accessor("VEC4", rotations))];
    document["accessors"][input]["min"] = json!([ends[0]]);
    document["accessors"][input]["max"] = json!([ends[1]]);
    let samplers = outputs.map(|(_, output)| json!({ "input": input, "interpolation": "LINEAR", "output": output }));
    let mut channels = vec![];
    for (i, (path, _)) in outputs.iter().enumerate() {
        channels.push(json!({ "sampler": i, "target": { "node": node, "path": path } }));
    }
    json!({ "name": NAME, "channels": channels, "samplers": samplers, "extras": { EXTRAS: { FPS: fps } } })
}

/// Appends to the array of a key, which is made; returns the index.
fn push(object: &mut Value, key: &str, value: Value) -> usize {
    let array = &mut object[key];
    if !array.is_array() {
        *array = json!([]);
    }
    let array = array.as_array_mut().expect("it has just been made one");
    array.push(value);
    array.len() - 1
}
