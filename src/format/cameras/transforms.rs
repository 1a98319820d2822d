//! Writer of nerfstudio's `transforms.json`.

use std::path::Path;

use serde_json::{Map, Value, json};

use super::captures::{GENERATOR, spare};
use super::{CameraFile, image_names};
use crate::format::{FormatError, atomic_write};
use crate::scene::{Camera, Intrinsics};

/// Writes cameras. Intrinsics that all frames share are written once. Images need not exist; rendered into the file's
/// folder under the names in the file, they make it a dataset.
pub(in crate::format) fn write(
    path: &Path,
    CameraFile { cameras, fps, y_up, .. }: &CameraFile,
) -> Result<u64, FormatError> {
    spare(path)?;
    let shared = cameras.first().map(|(_, first)| first.intrinsics());
    let shared = shared.filter(|k| cameras.iter().all(|(_, camera)| camera.intrinsics() == *k));
    let mut document = Map::new();
    document.insert("generator".to_owned(), json!(GENERATOR));
    document.insert("camera_model".to_owned(), json!("PINHOLE"));
    if let Some(fps) = fps {
        document.insert("fps".to_owned(), json!(fps));
    }
    document.insert("centaur".to_owned(), json!({ "y_up": y_up }));
    if let Some(k) = shared {
        document.extend(lens(k));
    }
    let frame = |(name, (_, camera)): (String, &(String, Camera))| {
        let mut frame = Map::new();
        frame.insert("file_path".to_owned(), json!(name));
        if shared.is_none() {
            frame.extend(lens(camera.intrinsics()));
        }
        let (r, c) = (camera.rotation().transpose(), camera.center());
        let row = |i: usize| [r.x_axis[i], -r.y_axis[i], -r.z_axis[i], c[i]];
        frame.insert("transform_matrix".to_owned(), json!([row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]]));
        Value::Object(frame)
    };
    let frames: Vec<Value> = image_names(cameras).into_iter().zip(cameras).map(frame).collect();
    document.insert("frames".to_owned(), Value::Array(frames));
    let text = serde_json::to_vec_pretty(&Value::Object(document)).unwrap_or_default();
    atomic_write(path, &text)?;
    Ok(text.len() as u64)
}

fn lens(k: &Intrinsics) -> Map<String, Value> {
    let fields =
        [("fl_x", k.fx), ("fl_y", k.fy), ("cx", k.cx), ("cy", k.cy)].map(|(name, v)| (name.to_owned(), json!(v)));
    [("w", k.width), ("h", k.height)].map(|(name, v)| (name.to_owned(), json!(v))).into_iter().chain(fields).collect()
}
