//! Files of cameras: written, read again, refused.

mod animations;
mod names;
mod scenes;
mod usd;
mod written;

use glam::{DMat3, DVec3};
use serde_json::json;

use super::*;
use crate::format::read_cameras;
use crate::render::testing::largest;
use crate::scene::Intrinsics;

/// A camera path with rotations, some of which pass half a turn, where the sign of the quaternion flips.
fn shot(frames: usize, zoom: f64) -> Vec<(String, Camera)> {
    let at = |i: usize| {
        let t = i as f64;
        let k = Intrinsics { width: 321, height: 200, fx: 150.25 + zoom * t, fy: 151.5, cx: 160.125, cy: 99.7 };
        let rotation = DMat3::from_euler(glam::EulerRot::YXZ, 0.9 * t, (0.3 * t).sin(), 0.2 * t);
        (format!("frame_{i:05}"), Camera::new(k, rotation, DVec3::new(t.sin(), 0.1 * t - 3.0, 2.0)).unwrap())
    };
    (0..frames).map(at).collect()
}

fn largest_difference(a: &[(String, Camera)], b: &[(String, Camera)]) -> f64 {
    assert_eq!(a.len(), b.len());
    let of = |(a, b): (&(String, Camera), &(String, Camera))| {
        assert_eq!(a.1.intrinsics(), b.1.intrinsics());
        let rotation = (a.1.rotation() - b.1.rotation()).to_cols_array().map(f64::abs);
        rotation.into_iter().chain((a.1.center() - b.1.center()).abs().to_array())
    };
    largest(a.iter().zip(b).flat_map(of))
}

fn read(path: &Path) -> CameraFile {
    read_cameras(path, &Sampling::default()).unwrap()
}

/// A glTF whose camera nodes are moved by animation `channels`, with accessors made of `floats` (type and values).
fn gltf_with(
    folder: &Path,
    floats: &[(&str, &[f32])],
    samplers: &serde_json::Value,
    channels: &serde_json::Value,
) -> PathBuf {
    let (mut bin, mut views, mut accessors) = (vec![], vec![], vec![]);
    for (kind, values) in floats {
        let width = if *kind == "SCALAR" { 1 } else { kind[3..].parse::<usize>().unwrap() };
        let bound = |of: fn(f32, f32) -> f32| -> Vec<f32> {
            (0..width).map(|c| values.iter().skip(c).step_by(width).copied().reduce(of).unwrap()).collect()
        };
        views.push(json!({ "buffer": 0, "byteOffset": bin.len(), "byteLength": 4 * values.len() }));
        accessors.push(
            json!({ "bufferView": views.len() - 1, "componentType": 5126, "type": kind, "count": values.len() / width,
            "min": bound(f32::min), "max": bound(f32::max) }),
        );
        bin.extend(values.iter().flat_map(|v| v.to_le_bytes()));
    }
    let document = json!({
        "asset": { "version": "2.0" },
        "scene": 0,
        "scenes": [{ "nodes": [0] }],
        "nodes": [{ "children": [1, 2] }, { "camera": 0, "name": "moving" }, { "camera": 0, "name": "resting" }],
        "cameras": [{ "type": "perspective", "perspective": { "yfov": 1.0, "aspectRatio": 1.5, "znear": 0.1 } }],
        "animations": [{ "samplers": samplers, "channels": channels }],
        "accessors": accessors, "bufferViews": views, "buffers": [{ "byteLength": bin.len(), "uri": "a.bin" }],
    });
    std::fs::write(folder.join("a.bin"), bin).unwrap();
    std::fs::write(folder.join("a.gltf"), document.to_string()).unwrap();
    folder.join("a.gltf")
}

const TURN: [f32; 8] = [0.0, 0.0, 0.0, 1.0, 0.0, std::f32::consts::FRAC_1_SQRT_2, 0.0, std::f32::consts::FRAC_1_SQRT_2];
