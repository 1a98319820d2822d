//! Writer of nerfstudio's `transforms.json`.

use std::path::{Component, Path};

use serde_json::{Map, Value, json};

use super::captures::{GENERATOR, spare};
use super::{CameraFile, image_names};
use crate::atomic::{folder_of, real_path};
use crate::format::{FormatError, atomic_write};
use crate::scene::{Camera, Intrinsics};

/// Writes cameras. Intrinsics that all frames share are written once. Photographs that are known are named with their
/// folder, which `centaur.images` repeats, because names of cameras are without it. Other images need not exist;
/// rendered into the file's folder under the names in the file, they make it a dataset.
pub(in crate::format) fn write(
    path: &Path,
    CameraFile { cameras, fps, y_up, images, .. }: &CameraFile,
) -> Result<u64, FormatError> {
    spare(path)?;
    let folder = images.as_deref().map(|images| place_of_images(path, images, cameras));
    let names: Vec<String> = match &folder {
        Some(_) => cameras.iter().map(|(name, _)| name.clone()).collect(),
        None => image_names(cameras),
    };
    let folder = folder.filter(|folder| !folder.is_empty());
    let shared = cameras.first().map(|(_, first)| first.intrinsics());
    let shared = shared.filter(|k| cameras.iter().all(|(_, camera)| camera.intrinsics() == *k));
    let mut document = Map::new();
    document.insert("generator".to_owned(), json!(GENERATOR));
    document.insert("camera_model".to_owned(), json!("PINHOLE"));
    if let Some(fps) = fps {
        document.insert("fps".to_owned(), json!(fps));
    }
    let mut ours = json!({ "y_up": y_up });
    if let Some(folder) = &folder {
        ours["images"] = json!(folder);
    }
    document.insert("centaur".to_owned(), ours);
    if let Some(k) = shared {
        document.extend(lens(k));
    }
    let frame = |(name, (_, camera)): (String, &(String, Camera))| {
        let mut frame = Map::new();
        let file_path = match &folder {
            Some(folder) => format!("{folder}/{name}"),
            None => name,
        };
        frame.insert("file_path".to_owned(), json!(file_path));
        if shared.is_none() {
            frame.extend(lens(camera.intrinsics()));
        }
        let (r, c) = (camera.rotation().transpose(), camera.center());
        let row = |i: usize| [r.x_axis[i], -r.y_axis[i], -r.z_axis[i], c[i]];
        frame.insert("transform_matrix".to_owned(), json!([row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]]));
        Value::Object(frame)
    };
    let frames: Vec<Value> = names.into_iter().zip(cameras).map(frame).collect();
    document.insert("frames".to_owned(), Value::Array(frames));
    let text = serde_json::to_vec_pretty(&Value::Object(document)).unwrap_or_default();
    atomic_write(path, &text)?;
    Ok(text.len() as u64)
}

/// Folder with which paths of the cameras' photographs, which are in the folder `images`, begin, separated by `/`:
/// relative to the file at `path` where they lie below its folder, else `images`, as nerfstudio's captures have it. Empty
/// where they are beside the file, or have names that begin with `images/`.
fn place_of_images(path: &Path, images: &Path, cameras: &[(String, Camera)]) -> String {
    let real = real_path(folder_of(path)).ok().zip(real_path(images).ok());
    let below = real.as_ref().and_then(|(folder, images)| images.strip_prefix(folder).ok());
    let is_stated = || cameras.iter().all(|(name, _)| name.starts_with("images/"));
    let folder = below.unwrap_or_else(|| Path::new(if is_stated() { "" } else { "images" }));
    let parts = folder.components().filter_map(|part| match part {
        Component::Normal(name) => Some(name.to_string_lossy()),
        _ => None,
    });
    parts.collect::<Vec<_>>().join("/")
}

fn lens(k: &Intrinsics) -> Map<String, Value> {
    let fields =
        [("fl_x", k.fx), ("fl_y", k.fy), ("cx", k.cx), ("cy", k.cy)].map(|(name, v)| (name.to_owned(), json!(v)));
    [("w", k.width), ("h", k.height)].map(|(name, v)| (name.to_owned(), json!(v))).into_iter().chain(fields).collect()
}
