//! Animated cameras in a document.

use std::collections::{BTreeSet, HashSet};

use glam::DQuat;
use serde_json::{Value, json};

use super::container::Bin;
use super::extension::EXTRAS;
use super::json::{index, items, items_mut, push, retain};
use super::nodes::{is_bare, needed, unlist};
use super::write::{FLOAT, camera_and_node, node_rotation};
use crate::format::cameras::{CameraFile, DEFAULT_FPS, NAME};
use crate::scene::Camera;

/// Key of an animation's frame rate in files that Centaur writes.
pub(super) const FPS: &str = "framesPerSecond";

/// Key that marks the nodes of these cameras, so that a later path replaces them.
const MARK: &str = "path";

/// Whether a node carries this mark.
pub(super) fn is_marked(node: &gltf::Node<'_>) -> bool {
    let extras = node.extras().as_ref().and_then(|extras| serde_json::from_str::<Value>(extras.get()).ok());
    extras.is_some_and(|extras| extras.get(EXTRAS).is_some_and(|ours| ours.get(MARK).is_some()))
}

/// Adds cameras at the top of the scene, replacing those added before: one camera with a linear animation whose keys
/// are the frames, at their times; or, where intrinsics differ, which glTF does not animate, one camera per frame.
/// `shown` is in the frame of the document's scene, which is the capture's below a root node of ours. Bytes of a former
/// path stay in the buffer.
pub(super) fn append(document: &mut Value, bin: &mut Bin<'_>, shown: &CameraFile, near: f32) {
    // Nodes above our root node, or above a transformed scene, are in glTF's axes.
    let placed = shown.clone().in_frame(true).cameras;
    let Some((_, first)) = shown.cameras.first() else { return };
    let mut vacant = take_out(document).into_iter();
    let mut add = |document: &mut Value, name: &str, i: usize| {
        let camera = items(document, "cameras").len();
        let (optics, _) = camera_and_node(name, &shown.cameras[i].1, near, camera);
        let (_, mut node) = camera_and_node(name, &placed[i].1, near, camera);
        node["extras"] = json!({ EXTRAS: { MARK: true } });
        push(document, "cameras", optics);
        let at = match vacant.next() {
            Some(at) => {
                let at = at as usize;
                document["nodes"][at] = node;
                at
            }
            None => push(document, "nodes", node),
        };
        let scene = index(document, "scene").unwrap_or(0);
        match document.get_mut("scenes").and_then(|scenes| scenes.get_mut(scene)) {
            Some(scene) => push(scene, "nodes", json!(at)),
            None => push(document, "scenes", json!({ "nodes": [at] })),
        };
        at
    };
    if shown.cameras.iter().all(|(_, camera)| camera.intrinsics() == first.intrinsics()) {
        let node = add(document, NAME, 0);
        let fps = shown.fps.unwrap_or(DEFAULT_FPS);
        let animation = animation(document, bin, (&placed, &shown.keys()), fps, node);
        push(document, "animations", animation);
    } else {
        for (i, (name, _)) in shown.cameras.iter().enumerate() {
            add(document, name, i);
        }
    }
    if bin.len() > 0 {
        if items(document, "buffers").is_empty() {
            document["buffers"] = json!([{}]);
        }
        document["buffers"][0]["byteLength"] = json!(bin.len());
    }
}

/// Removes a path of ours from a document. Returns its nodes, emptied and removed from all lists but not deleted,
/// because other nodes are referenced by index. Nodes to which another program has attached something, or refers, stay
/// in their rest pose.
pub(super) fn take_out(document: &mut Value) -> BTreeSet<u64> {
    let of_ours = |object: &Value, key: &str| object.pointer(&format!("/extras/{EXTRAS}/{key}")).is_some();
    let camera_of = |node: &Value| index(node, "camera");
    let needed = needed(document);
    let (mut nodes, mut cameras, mut still) = (BTreeSet::new(), vec![], HashSet::new());
    for (i, node) in (0..).zip(items_mut(document, "nodes")) {
        if of_ours(node, MARK) {
            cameras.extend(camera_of(node));
            still.insert(i);
            let Some(object) = node.as_object_mut() else { continue };
            object.remove("camera");
            if let Some(extras) = object.get_mut("extras").and_then(Value::as_object_mut) {
                extras.remove(EXTRAS);
                if extras.is_empty() {
                    object.remove("extras");
                }
            }
            if is_bare(object) && !needed.contains(&i) {
                nodes.insert(i);
                *node = json!({});
            }
        }
    }
    unlist(document, &nodes);
    // Cameras that another program uses in other nodes are kept.
    let used: HashSet<usize> = items(document, "nodes").iter().filter_map(camera_of).collect();
    cameras.retain(|camera| !used.contains(camera));
    cameras.sort_unstable();
    cameras.dedup();
    retain(document, "cameras", |i, _| cameras.binary_search(&i).is_err());
    for node in items_mut(document, "nodes") {
        if let Some(camera) = camera_of(node) {
            node["camera"] = json!(camera - cameras.partition_point(|gone| *gone < camera));
        }
    }
    // Animations that another program derived from the path have lost their target, and must not move the next path.
    for animation in items_mut(document, "animations") {
        let is_still = |index: &Value| index.as_u64().is_some_and(|i| still.contains(&i));
        retain(animation, "channels", |_, channel| !channel.pointer("/target/node").is_some_and(is_still));
        // What another program has added to the path's animation is none of a path.
        if let Some(ours) = animation.pointer_mut(&format!("/extras/{EXTRAS}")).and_then(Value::as_object_mut) {
            ours.remove(FPS);
        }
    }
    retain(document, "animations", |_, animation| animation.get("channels").is_some());
    nodes
}

fn animation(
    document: &mut Value,
    bin: &mut Bin<'_>,
    (cameras, times): (&[(String, Camera)], &[f64]),
    fps: f64,
    node: usize,
) -> Value {
    let times: Vec<f32> = times.iter().map(|time| *time as f32).collect();
    let translations = cameras.iter().flat_map(|(_, c)| c.center().to_array()).map(|v| v as f32).collect();
    let mut last = DQuat::IDENTITY;
    let rotations = cameras.iter().flat_map(|(_, camera)| {
        let q = node_rotation(camera);
        // Programs that interpolate by component need neighbouring quaternions in the same hemisphere.
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
