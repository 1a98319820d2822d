//! Records of a COLMAP model, common to both encodings: camera models and their meaning, images and points.

use super::Point;
use super::distortion::{Distortion, Lens};
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

/// The first focal length of a lens that is not positive.
pub(super) fn unfit_focal_length(lens: &Lens) -> Option<f64> {
    [lens.intrinsics.fx, lens.intrinsics.fy].into_iter().find(|f| *f <= 0.0)
}

/// A record of `images.txt` or `images.bin`.
#[derive(Debug)]
pub(super) struct ImageRecord {
    /// Position in the file: `line 7`, `byte 120`.
    pub(super) at: String,
    pub(super) id: u32,
    pub(super) name: String,
    pub(super) camera: u32,
    /// Quaternion w, x, y, z; world→camera.
    pub(super) rotation: [f64; 4],
    pub(super) translation: [f64; 3],
}

/// Points of a model, and for each the numbers of the images that see it.
#[derive(Debug, Default)]
pub(super) struct PointRecords {
    pub(super) points: Vec<Point>,
    pub(super) tracks: Vec<Vec<u32>>,
}
