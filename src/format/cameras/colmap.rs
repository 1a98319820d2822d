//! A COLMAP model as text: cameras and poses, without points.

use std::fmt::Write as _;
use std::path::Path;

use glam::DQuat;

use super::picture_names;
use crate::format::{FormatError, atomic_write};
use crate::scene::{Camera, Intrinsics};

pub(super) fn write(folder: &Path, cameras: &[(String, Camera)]) -> Result<u64, FormatError> {
    let model = folder.join("sparse").join("0");
    std::fs::create_dir_all(&model).map_err(|source| FormatError::Write { file: model.clone(), source })?;
    let mut lenses: Vec<Intrinsics> = vec![];
    let mut images = String::from("# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME; world to camera\n");
    for (i, ((_, camera), name)) in cameras.iter().zip(picture_names(cameras)).enumerate() {
        let lens = lenses.iter().rposition(|k| k == camera.intrinsics()).unwrap_or_else(|| {
            lenses.push(*camera.intrinsics());
            lenses.len() - 1
        });
        let (q, t) = (DQuat::from_mat3(&camera.rotation()).normalize(), camera.translation());
        // Observations, of which there are none, have a line of their own.
        let line = format!("{} {} {} {} {} {} {} {} {} {name}\n\n", i + 1, q.w, q.x, q.y, q.z, t.x, t.y, t.z, lens + 1);
        images.push_str(&line);
    }
    let mut text = String::from("# CAMERA_ID, MODEL, WIDTH, HEIGHT, FX, FY, CX, CY\n");
    for (i, k) in lenses.iter().enumerate() {
        writeln!(text, "{} PINHOLE {} {} {} {} {} {}", i + 1, k.width, k.height, k.fx, k.fy, k.cx, k.cy)
            .expect("writing to a string cannot fail");
    }
    let files = [("cameras.txt", text), ("images.txt", images), ("points3D.txt", "# No points\n".to_owned())];
    let mut bytes = 0;
    for (name, text) in files {
        atomic_write(&model.join(name), text.as_bytes())?;
        bytes += text.len() as u64;
    }
    Ok(bytes)
}
