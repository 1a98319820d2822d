//! COLMAP models: finding their files, and converting them to frames.

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use glam::{DMat3, DQuat, DVec3};

use super::colmap_records::{ImageRecord, PointRecords};
use super::distortion::Lens;
use super::views::{Frame, inside};
use super::{CaptureError, Listed, LoadOptions, colmap_binary, colmap_text, error};

/// The folder of a COLMAP model in or below `root`, if there is one.
pub(super) fn find_model(root: &Path) -> Option<PathBuf> {
    let holds = |folder: &Path, files: &[&str]| files.iter().any(|f| folder.join(f).is_file());
    let cameras = ["cameras.bin", "cameras.txt", "frames.bin", "frames.txt"];
    let model = ["sparse/0", "sparse", "colmap/sparse/0"].iter().map(|f| root.join(f)).find(|f| holds(f, &cameras));
    // In the capture's own folder a list of frames may belong to anything, so a list of images or rigs is required too.
    let others = ["images.bin", "images.txt", "rigs.bin", "rigs.txt"];
    let holds_both = |folder: &Path| holds(folder, &cameras) && holds(folder, &others);
    // `0` is where models are in a folder `sparse`, which may be named in place of the capture.
    model.or_else(|| [root.to_owned(), root.join("0")].into_iter().find(|folder| holds_both(folder)))
}

/// The folder of a model in or below `root` that lacks its cameras, the file that is missing and one that is there.
pub(super) fn find_incomplete(root: &Path) -> Option<(PathBuf, String, &'static str)> {
    const FILES: [&str; 4] = ["images.bin", "images.txt", "points3D.bin", "points3D.txt"];
    ["sparse/0", "sparse", "colmap/sparse/0"].iter().map(|folder| root.join(folder)).find_map(|folder| {
        let there = FILES.into_iter().find(|file| folder.join(file).is_file())?;
        let missing = there.replace("images", "cameras").replace("points3D", "cameras");
        Some((folder, missing, there))
    })
}

/// Further models beside that in `folder`, in order: COLMAP's mapper numbers them, one for each set of photographs that
/// it cannot connect with others.
pub(super) fn further_models(folder: &Path) -> Vec<PathBuf> {
    if folder.file_name().is_none_or(|name| name != "0") {
        return vec![];
    }
    // Numbers have no gaps.
    (1..)
        .map(|number| folder.with_file_name(number.to_string()))
        .take_while(|other| find_model(other).is_some())
        .collect()
}

/// A file of the model in `folder`, preferably in the encoding of its cameras file.
pub(super) fn file_of(folder: &Path, stem: &str) -> PathBuf {
    let extensions = if folder.join("cameras.bin").is_file() { ["bin", "txt"] } else { ["txt", "bin"] };
    let [usual, other] = extensions.map(|extension| folder.join(format!("{stem}.{extension}")));
    if other.is_file() && !usual.is_file() { other } else { usual }
}

/// Reads frames and points of the model in `folder`, with the images in `root/<images folder>`. Unless points are
/// wanted, neither they nor the visibility of points in frames are read.
pub(super) fn load(
    root: &Path,
    folder: &Path,
    (options, wants_points): (&LoadOptions, bool),
) -> Result<Listed, CaptureError> {
    let [cameras_file, images_file, points_file] = ["cameras", "images", "points3D"].map(|stem| file_of(folder, stem));
    if !images_file.is_file() && (folder.join("frames.bin").is_file() || folder.join("frames.txt").is_file()) {
        let expected = "an images file beside rigs and frames; export the model again with COLMAP's model_converter";
        return Err(CaptureError::invalid(folder, "COLMAP model", expected, "frames only"));
    }
    let cameras = if is_binary(&cameras_file) {
        colmap_binary::cameras(&error::read(&cameras_file)?, &cameras_file)?
    } else {
        colmap_text::cameras(&error::read_text(&cameras_file)?, &cameras_file)?
    };
    let images = if is_binary(&images_file) {
        colmap_binary::images(&error::read(&images_file)?, &images_file)?
    } else {
        colmap_text::images(&error::read_text(&images_file)?, &images_file)?
    };
    // Points are optional, as in `transforms.json`.
    let points_files = Vec::from_iter(Some(points_file).filter(|file| file.exists()));
    let PointRecords { points, tracks } = match points_files.first().filter(|_| wants_points) {
        None => PointRecords::default(),
        Some(file) if is_binary(file) => colmap_binary::points(&error::read(file)?, file)?,
        Some(file) => colmap_text::points(&error::read_text(file)?, file)?,
    };
    if cameras.is_empty() {
        return Err(CaptureError::invalid(&cameras_file, "cameras", "at least one camera", "none"));
    }
    let images_folder = root.join(options.images.as_deref().unwrap_or("images"));
    let mut numbers = HashMap::with_capacity(images.len());
    for (i, image) in images.iter().enumerate() {
        if numbers.insert(image.id, i).is_some() {
            return Err(CaptureError::invalid(&images_file, &image.at, "a new image id", image.id.to_string()));
        }
    }
    let mut frames = frames(images, &cameras, &images_file, &images_folder)?;
    for (point, track) in (0u32..).zip(&tracks) {
        for &frame in track.iter().filter_map(|id| numbers.get(id)) {
            // A point that an image sees twice is still one point.
            if frames[frame].sees.last() != Some(&point) {
                frames[frame].sees.push(point);
            }
        }
    }
    Ok(Listed { frames, list: images_file, points, points_files })
}

fn is_binary(file: &Path) -> bool {
    file.extension().is_some_and(|e| e == "bin")
}

/// Joins images with their cameras.
fn frames(
    images: Vec<ImageRecord>,
    cameras: &HashMap<u32, Lens>,
    path: &Path,
    images_folder: &Path,
) -> Result<Vec<Frame>, CaptureError> {
    let mut frames = Vec::with_capacity(images.len());
    let list: Arc<Path> = path.into();
    for image in images {
        let place = format!("{}, image {}", image.at, image.name);
        let Some(lens) = cameras.get(&image.camera) else {
            let found = format!("camera {}", image.camera);
            return Err(CaptureError::invalid(path, place, "a camera of the cameras file", found));
        };
        let [w, x, y, z] = image.rotation;
        let rotation = DQuat::from_xyzw(x, y, z, w);
        // Large components may overflow to an infinite length, which cannot be normalised.
        if !(rotation.length() > 0.0 && rotation.length().is_finite()) {
            let found = format!("{:?}", image.rotation);
            return Err(CaptureError::invalid(path, place, "a unit quaternion", found));
        }
        frames.push(Frame {
            image: images_folder.join(inside(path, &image.at, &image.name)?),
            name: image.name,
            list: list.clone(),
            at: image.at,
            mask: None,
            lens: *lens,
            has_size: true,
            rotation: DMat3::from_quat(rotation.normalize()),
            translation: DVec3::from(image.translation),
            held_out: None,
            time: None,
            sees: vec![],
        });
    }
    Ok(frames)
}
