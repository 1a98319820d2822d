//! COLMAP models: which files are there, what the camera models mean, and how they become frames.

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use glam::{DMat3, DQuat, DVec3};

use super::distortion::{Distortion, Lens};
use super::views::{Frame, inside};
use super::{CaptureError, Listed, LoadOptions, Point, colmap_binary, colmap_text, error};
use crate::scene::Intrinsics;

/// Number, name and parameter count of every camera model of COLMAP 4.2, parameters in COLMAP's order. They
/// are as pycolmap lists them (`tests/oracles/check_colmap_models.py`).
const MODELS: [(i32, &str, usize); 18] = [
    (0, "SIMPLE_PINHOLE", 3),
    (1, "PINHOLE", 4),
    (2, "SIMPLE_RADIAL", 4),
    (3, "RADIAL", 5),
    (4, "OPENCV", 8),
    (5, "OPENCV_FISHEYE", 8),
    (6, "FULL_OPENCV", 12),
    (7, "FOV", 5),
    (8, "SIMPLE_RADIAL_FISHEYE", 4),
    (9, "RADIAL_FISHEYE", 5),
    (10, "THIN_PRISM_FISHEYE", 12),
    (11, "RAD_TAN_THIN_PRISM_FISHEYE", 16),
    (12, "SIMPLE_DIVISION", 4),
    (13, "DIVISION", 5),
    (14, "SIMPLE_FISHEYE", 3),
    (15, "FISHEYE", 4),
    (16, "EUCM", 6),
    (17, "EQUIRECTANGULAR", 2),
];

/// Name and parameter count of a model number.
pub(super) fn model_of_id(id: i32) -> Option<(&'static str, usize)> {
    MODELS.iter().find(|m| m.0 == id).map(|m| (m.1, m.2))
}

/// Parameter count of a model name.
pub(super) fn parameter_count(name: &str) -> Option<usize> {
    MODELS.iter().find(|m| m.1 == name).map(|m| m.2)
}

/// The lens of a model name with its parameters. `None` if the model is unknown, has another number of parameters
/// or sees more than a pinhole can show (`EQUIRECTANGULAR`).
pub(super) fn lens(name: &str, p: &[f64], width: u32, height: u32) -> Option<Lens> {
    let brown = |k1, k2, p1, p2| Distortion::Brown { k: [k1, k2, 0.0, 0.0, 0.0, 0.0], p: [p1, p2] };
    let fisheye = |k| Distortion::Fisheye { k, p: [0.0; 2], s: [0.0; 2] };
    let (f, c, distortion) = match (name, p) {
        ("SIMPLE_PINHOLE", &[f, cx, cy]) => ([f, f], [cx, cy], Distortion::None),
        ("PINHOLE", &[fx, fy, cx, cy]) => ([fx, fy], [cx, cy], Distortion::None),
        ("SIMPLE_RADIAL", &[f, cx, cy, k]) => ([f, f], [cx, cy], brown(k, 0.0, 0.0, 0.0)),
        ("RADIAL", &[f, cx, cy, k1, k2]) => ([f, f], [cx, cy], brown(k1, k2, 0.0, 0.0)),
        ("OPENCV", &[fx, fy, cx, cy, k1, k2, p1, p2]) => ([fx, fy], [cx, cy], brown(k1, k2, p1, p2)),
        ("FULL_OPENCV", &[fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6]) => {
            ([fx, fy], [cx, cy], Distortion::Brown { k: [k1, k2, k3, k4, k5, k6], p: [p1, p2] })
        }
        ("SIMPLE_FISHEYE", &[f, cx, cy]) => ([f, f], [cx, cy], fisheye([0.0; 4])),
        ("FISHEYE", &[fx, fy, cx, cy]) => ([fx, fy], [cx, cy], fisheye([0.0; 4])),
        ("SIMPLE_RADIAL_FISHEYE", &[f, cx, cy, k]) => ([f, f], [cx, cy], fisheye([k, 0.0, 0.0, 0.0])),
        ("RADIAL_FISHEYE", &[f, cx, cy, k1, k2]) => ([f, f], [cx, cy], fisheye([k1, k2, 0.0, 0.0])),
        ("OPENCV_FISHEYE", &[fx, fy, cx, cy, k1, k2, k3, k4]) => ([fx, fy], [cx, cy], fisheye([k1, k2, k3, k4])),
        ("THIN_PRISM_FISHEYE", &[fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, s1, s2]) => {
            ([fx, fy], [cx, cy], Distortion::Fisheye { k: [k1, k2, k3, k4], p: [p1, p2], s: [s1, s2] })
        }
        ("RAD_TAN_THIN_PRISM_FISHEYE", &[fx, fy, cx, cy, k0, k1, k2, k3, k4, k5, p0, p1, s0, s1, s2, s3]) => {
            let (k, p, s) = ([k0, k1, k2, k3, k4, k5], [p0, p1], [s0, s1, s2, s3]);
            ([fx, fy], [cx, cy], Distortion::RadTanFisheye { k, p, s })
        }
        ("FOV", &[fx, fy, cx, cy, omega]) => ([fx, fy], [cx, cy], Distortion::Fov { omega }),
        ("SIMPLE_DIVISION", &[f, cx, cy, k]) => ([f, f], [cx, cy], Distortion::Division { k }),
        ("DIVISION", &[fx, fy, cx, cy, k]) => ([fx, fy], [cx, cy], Distortion::Division { k }),
        ("EUCM", &[fx, fy, cx, cy, alpha, beta]) => ([fx, fy], [cx, cy], Distortion::Eucm { alpha, beta }),
        _ => return None,
    };
    // COLMAP writes OPENCV cameras with zero distortion; those need no resampling.
    let distortion = match distortion {
        Distortion::Brown { k, p } if k == [0.0; 6] && p == [0.0; 2] => Distortion::None,
        other => other,
    };
    let intrinsics = Intrinsics { width, height, fx: f[0], fy: f[1], cx: c[0], cy: c[1] };
    Some(Lens { intrinsics, distortion })
}

/// The focal length of a lens that is no pinhole's.
pub(super) fn unfit_focal_length(lens: &Lens) -> Option<f64> {
    [lens.intrinsics.fx, lens.intrinsics.fy].into_iter().find(|f| *f <= 0.0)
}

/// One line of `images.txt` or record of `images.bin`.
#[derive(Debug)]
pub(super) struct ImageRecord {
    /// Where it stands: `line 7`, `byte 120`.
    pub(super) at: String,
    pub(super) id: u32,
    pub(super) name: String,
    pub(super) camera: u32,
    /// w, x, y, z; world→camera.
    pub(super) rotation: [f64; 4],
    pub(super) translation: [f64; 3],
}

/// The points of a model, and for each the images that see it, by their number.
#[derive(Debug, Default)]
pub(super) struct PointRecords {
    pub(super) points: Vec<Point>,
    pub(super) tracks: Vec<Vec<u32>>,
}

/// The folder of a COLMAP model in or below `root`, if there is one.
pub(super) fn find_model(root: &Path) -> Option<PathBuf> {
    let holds = |folder: &Path, files: &[&str]| files.iter().any(|f| folder.join(f).is_file());
    let cameras = ["cameras.bin", "cameras.txt", "frames.bin", "frames.txt"];
    let model = ["sparse/0", "sparse", "colmap/sparse/0"].iter().map(|f| root.join(f)).find(|f| holds(f, &cameras));
    // In the capture's own folder a list of frames may be anyone's.
    let others = ["images.bin", "images.txt", "rigs.bin", "rigs.txt"];
    model.or_else(|| (holds(root, &cameras) && holds(root, &others)).then(|| root.to_owned()))
}

/// A file of the model in `folder`, in the encoding of its cameras, else in the other.
pub(super) fn file_of(folder: &Path, stem: &str) -> PathBuf {
    let extensions = if folder.join("cameras.bin").is_file() { ["bin", "txt"] } else { ["txt", "bin"] };
    let [usual, other] = extensions.map(|extension| folder.join(format!("{stem}.{extension}")));
    if other.is_file() && !usual.is_file() { other } else { usual }
}

/// Frames and points of the model in `folder`, with the images in `root/<images folder>`. Unless they are wanted, points are not
/// read, nor which of them a frame sees.
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
    // As `transforms.json` need not name any.
    let points_file = Some(points_file).filter(|file| wants_points && file.exists());
    let PointRecords { points, tracks } = match &points_file {
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
    Ok(Listed { frames, list: images_file, points, points_file })
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
        let rotation = DQuat::from_xyzw(x, y, z, w).normalize();
        if !rotation.is_finite() {
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
            rotation: DMat3::from_quat(rotation),
            translation: DVec3::from(image.translation),
            held_out: None,
            time: None,
            sees: vec![],
        });
    }
    Ok(frames)
}
