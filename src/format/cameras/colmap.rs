//! Writer of COLMAP text models: cameras and poses, without points.

use std::collections::HashMap;
use std::fmt::Write as _;
use std::path::Path;
use std::{fs, io};

use glam::DQuat;

use super::captures::{FILES, NO_POINTS, spare_in};
use super::image_names;
use crate::atomic::{self, Staging};
use crate::format::FormatError;
use crate::scene::{Camera, Intrinsics};

pub(in crate::format) fn write(folder: &Path, cameras: &[(String, Camera)]) -> Result<u64, FormatError> {
    spare_in(folder)?;
    let (mut lenses, mut places): (Vec<Intrinsics>, HashMap<_, usize>) = (vec![], HashMap::new());
    let mut images = String::from("# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME; world to camera\n");
    for (i, ((_, camera), name)) in cameras.iter().zip(image_names(cameras)).enumerate() {
        let k = camera.intrinsics();
        let lens =
            *places.entry((k.width, k.height, [k.fx, k.fy, k.cx, k.cy].map(f64::to_bits))).or_insert_with(|| {
                lenses.push(*k);
                lenses.len() - 1
            });
        let (q, t) = (DQuat::from_mat3(&camera.rotation()).normalize(), camera.translation());
        // The second line of an image lists its observations, of which there are none.
        let line = format!("{} {} {} {} {} {} {} {} {} {name}\n\n", i + 1, q.w, q.x, q.y, q.z, t.x, t.y, t.z, lens + 1);
        images.push_str(&line);
    }
    let mut text = String::from("# CAMERA_ID, MODEL, WIDTH, HEIGHT, FX, FY, CX, CY\n");
    for (i, k) in lenses.iter().enumerate() {
        writeln!(text, "{} PINHOLE {} {} {} {} {} {}", i + 1, k.width, k.height, k.fx, k.fy, k.cx, k.cy)
            .expect("writing to a string cannot fail");
    }
    let files = [&text[..], &images, NO_POINTS];
    place(folder, files).map_err(|source| FormatError::Write { file: folder.join("sparse/0"), source })?;
    Ok(files.iter().map(|text| text.len() as u64).sum())
}

/// Moves a completely written model to `sparse/0`.
fn place(folder: &Path, files: [&str; 3]) -> io::Result<()> {
    let sparse = folder.join("sparse");
    fs::create_dir_all(&sparse)?;
    let staging = Staging::within(folder)?;
    let [model, new, former] = [sparse.join("0"), staging.path().join("new"), staging.path().join("former")];
    fs::create_dir(&new)?;
    FILES.iter().zip(files).try_for_each(|(name, text)| fs::write(new.join(name), text))?;
    let _undisturbed = atomic::undisturbed();
    let replaces = model.exists();
    if replaces {
        atomic::rename(&model, &former)?;
    }
    let placed = atomic::rename(&new, &model);
    if placed.is_err() && replaces {
        atomic::rename(&former, &model)?;
    }
    placed
}
