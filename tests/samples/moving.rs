//! A glTF in which everything is animated: a skin with a morph target, a deformation over time, splats on a triangle, a
//! camera.

use serde_json::{Value, json};

const KHR: &str = "KHR_gaussian_splatting";
const HYBRID: &str = "EXT_gaussian_splatting_hybrid";

/// Accessors and the buffer behind them.
#[derive(Default)]
struct Content {
    bytes: Vec<u8>,
    views: Vec<Value>,
    accessors: Vec<Value>,
}

impl Content {
    fn add(&mut self, component: u32, kind: &str, count: usize, bytes: &[u8]) -> usize {
        self.views.push(json!({ "buffer": 0, "byteOffset": self.bytes.len(), "byteLength": bytes.len() }));
        self.bytes.extend(bytes);
        self.bytes.resize(self.bytes.len().next_multiple_of(4), 0);
        let view = self.views.len() - 1;
        self.accessors.push(json!({ "bufferView": view, "componentType": component, "type": kind, "count": count }));
        self.accessors.len() - 1
    }

    fn floats<const N: usize>(&mut self, values: &[[f32; N]]) -> usize {
        let kind = ["", "SCALAR", "VEC2", "VEC3", "VEC4"][N];
        let bytes: Vec<u8> = values.as_flattened().iter().flat_map(|v| v.to_le_bytes()).collect();
        self.add(5126, kind, values.len(), &bytes)
    }
}

/// The document, and its buffer, to which it refers as `uri`.
pub(crate) fn document(uri: &str) -> (Value, Vec<u8>) {
    let mut c = Content::default();
    let half = std::f32::consts::FRAC_1_SQRT_2;
    let positions = c.floats(&[[0.0f32, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]);
    c.accessors[positions]["min"] = json!([0, 0, 0]);
    c.accessors[positions]["max"] = json!([1, 1, 0]);
    let joints = c.add(5121, "VEC4", 3, &[0, 1, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0]);
    let weights = c.floats(&[[0.75f32, 0.25, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.5, 0.5, 0.0, 0.0]]);
    let delta = c.floats(&[[0.0f32, 0.0, 0.5]; 3]);
    let keys = c.floats(&[[0.0f32], [1.0]]);
    c.accessors[keys]["min"] = json!([0]);
    c.accessors[keys]["max"] = json!([1]);
    let turn = c.floats(&[[0.0f32, 0.0, 0.0, 1.0], [0.0, 0.0, half, half]]);
    let blend = c.floats(&[[0.0f32], [1.0]]);
    let slide = c.floats(&[[0.0f32; 3], [0.0; 3], [0.0; 3], [0.0; 3], [1.0, 2.0, 3.0], [0.0; 3]]);
    let deformed = c.floats(&[[0.1f32, 0.0, 0.0]; 6]);
    let triangles = c.add(5125, "SCALAR", 1, &[0; 4]);
    let translations = c.floats(&[[0.0f32, 0.5, 0.0]]);
    c.accessors[translations]["min"] = json!([0, 0.5, 0]);
    c.accessors[translations]["max"] = json!([0, 0.5, 0]);
    let rotations = c.floats(&[[0.0f32, 0.0, 0.0, 1.0]]);
    let scales = c.floats(&[[0.1f32, 0.2, 0.3]]);
    let opacity = c.floats(&[[0.7f32]]);
    let attributes = json!({
        "POSITION": translations, format!("{KHR}:ROTATION"): rotations, format!("{KHR}:SCALE"): scales,
        format!("{KHR}:OPACITY"): opacity, format!("{KHR}:SH_DEGREE_0_COEF_0"): translations,
    });
    let binding = json!({
        "node": 0, "triangleCount": 1, "triangles": triangles, "translations": translations, "rotations": rotations,
        "scales": scales, "sphericalHarmonicsFrame": "triangle",
    });
    let khr = json!({ "kernel": "ellipse", "colorSpace": "srgb_rec709_display", "extensions": { HYBRID: { "binding": binding } } });
    let channel = |sampler: usize, node: usize, path: &str| json!({ "sampler": sampler, "target": { "node": node, "path": path } });
    let document = json!({
        "asset": { "version": "2.0" }, "scene": 0, "scenes": [{ "nodes": [0, 1, 3, 4, 5] }],
        "nodes": [
            { "mesh": 0, "skin": 0, "weights": [0.5] }, { "name": "root", "children": [2] }, { "translation": [0, 1, 0] },
            { "mesh": 1 }, { "mesh": 2 }, { "camera": 0, "translation": [0, 0, 4] },
        ],
        "meshes": [
            { "primitives": [{ "attributes": { "POSITION": positions, "JOINTS_0": joints, "WEIGHTS_0": weights }, "targets": [{ "POSITION": delta }] }] },
            { "primitives": [{ "attributes": { "POSITION": positions }, "extensions": { HYBRID: { "times": keys, "translations": deformed } } }] },
            { "primitives": [{ "mode": 0, "attributes": attributes, "extensions": { KHR: khr } }] },
        ],
        "skins": [{ "joints": [1, 2] }],
        "cameras": [{ "type": "perspective", "perspective": { "yfov": 0.8, "aspectRatio": 1.5, "znear": 0.1 } }],
        "animations": [{
            "samplers": [
                { "input": keys, "output": turn }, { "input": keys, "output": blend },
                { "input": keys, "output": slide, "interpolation": "CUBICSPLINE" },
            ],
            "channels": [channel(0, 2, "rotation"), channel(1, 0, "weights"), channel(2, 5, "translation")],
        }],
        "extensionsUsed": [KHR, HYBRID],
        "accessors": c.accessors, "bufferViews": c.views, "buffers": [{ "byteLength": c.bytes.len(), "uri": uri }],
    });
    (document, c.bytes)
}
