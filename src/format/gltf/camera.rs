//! Conversion of glTF cameras to pinhole cameras.

use glam::{DMat3, DMat4, DVec3};
use serde_json::Value;

use super::extension::{EXTRAS, ExactCamera};
use crate::format::DEFAULT_HEIGHT;
use crate::format::cameras::short;
use crate::format::error::{Fault, from_value};
use crate::format::placed::{Decomposed, similarity};
use crate::scene::{Camera, Intrinsics, frame};

/// Cameras with their names.
pub(super) type Cameras = Vec<(String, Camera)>;

/// Those of the nodes that are `placed`; one that cannot be had is left out, with a note.
pub(super) fn all(document: &gltf::Document, placed: &[(gltf::Node<'_>, DMat4)], notes: &mut Vec<String>) -> Cameras {
    let mut cameras = vec![];
    for (node, transform) in placed {
        let Some(optics) = node.camera() else { continue };
        let name = name(node, cameras.len());
        match read(document, optics.index(), *transform) {
            Ok((camera, note)) => {
                notes.extend(note.map(|note| format!("/nodes/{}: {note}", node.index())));
                cameras.push((name, camera));
            }
            Err(reason) => notes.push(format!("/nodes/{}: camera left out: {reason}", node.index())),
        }
    }
    cameras
}

/// Name of the camera at a node; if it has none, derived from `nth`, the index among the cameras read.
pub(super) fn name(node: &gltf::Node<'_>, nth: usize) -> String {
    let name = node.name().or(node.camera().and_then(|camera| camera.name()));
    name.map_or_else(|| format!("camera_{nth}"), short)
}

/// Converts a camera and collects notes on assumptions; on failure, the reason.
pub(super) fn read(
    document: &gltf::Document,
    index: usize,
    transform: DMat4,
) -> Result<(Camera, Option<String>), String> {
    let camera = document.as_json().cameras.get(index).ok_or("no such camera")?;
    let Decomposed { rotation, translation, .. } =
        similarity(transform).ok_or("its node has shear, mirroring or non-uniform scale")?;
    let pose = frame::camera_of_node(rotation, translation);

    let why = match exact(camera) {
        None => "without an image size".to_owned(),
        Some(Err(reason)) => format!("whose exact intrinsics cannot be read ({reason})"),
        Some(Ok(c)) if !Intrinsics::is_size(c.width, c.height) => {
            return Err(format!("its image of {}×{} pixels is empty or too large", c.width, c.height));
        }
        Some(Ok(c)) => {
            if let Some(c) = with_lens_of(c, camera) {
                let k = Intrinsics { width: c.width, height: c.height, fx: c.fx, fy: c.fy, cx: c.cx, cy: c.cy };
                let (rotation, translation) = c.pose().filter(|own| is_unmoved(*own, pose)).unwrap_or(pose);
                return Camera::new(k, rotation, translation).map(|c| (c, None)).map_err(|e| e.to_string());
            }
            "whose aspect ratio differs from that of its exact intrinsics".to_owned()
        }
    };
    let perspective =
        camera.perspective.as_ref().ok_or("it is orthographic, and only perspective cameras are supported")?;
    let yfov = f64::from(perspective.yfov);
    if !(yfov > 0.0 && yfov < std::f64::consts::PI) {
        return Err(format!("its yfov of {yfov} is not between 0 and π"));
    }
    let aspect = perspective.aspect_ratio.map(f64::from).filter(|a| a.is_finite() && *a > 0.0);
    let height = f64::from(DEFAULT_HEIGHT);
    let wide = aspect.unwrap_or(16.0 / 9.0) * height;
    let width = wide.round().clamp(1.0, f64::from(Intrinsics::MAX_PICTURE_SIDE));
    let fy = 0.5 * height / (0.5 * yfov).tan();
    // The horizontal field of view follows the aspect ratio, regardless of rounding the width to whole pixels.
    let is_rounded = aspect.is_some() && (width - wide).abs() <= 0.5;
    let fx = if is_rounded { fy * (width / wide) } else { fy };
    let (cx, cy) = (0.5 * width, 0.5 * height);
    let k = Intrinsics { width: width as u32, height: DEFAULT_HEIGHT, fx, fy, cx, cy };
    let note = format!("a camera {why} is taken to have {}×{} pixels", k.width, k.height);
    Camera::new(k, pose.0, pose.1).map(|c| (c, Some(note))).map_err(|e| e.to_string())
}

/// Exact camera parameters in the extras, as Centaur, or a program that follows it, writes them; `Err`: the reason for
/// which they cannot be read.
fn exact(camera: &gltf::json::Camera) -> Option<Result<ExactCamera, String>> {
    let extras = serde_json::from_str::<Value>(camera.extras.as_ref()?.get()).ok()?;
    let read =
        from_value::<ExactCamera>(extras.get(EXTRAS)?, &format!("extras/{EXTRAS}"), "the intrinsics of a camera");
    Some(read.map_err(|Fault { location, found, .. }| short(&format!("{location}{found}"))))
}

impl ExactCamera {
    /// World→camera rotation and translation, if both are present.
    fn pose(&self) -> Option<(DMat3, DVec3)> {
        Some((DMat3::from_cols_array(&self.rotation?).transpose(), DVec3::from(self.translation?)))
    }
}

/// Whether a camera's exact pose agrees with that of its node. Nodes are stored in f32; a larger difference means that
/// the camera has been moved by another program.
fn is_unmoved(own: (DMat3, DVec3), node: (DMat3, DVec3)) -> bool {
    let tolerance = 1e-5 * (1.0 + own.1.length());
    own.0.abs_diff_eq(node.0, 1e-5) && own.1.abs_diff_eq(node.1, tolerance)
}

/// Exact camera with the file's current field of view, which another program may have changed while keeping the extras.
/// `None` if the aspect ratio, and hence the image, has changed.
fn with_lens_of(mut exact: ExactCamera, camera: &gltf::json::Camera) -> Option<ExactCamera> {
    let perspective = camera.perspective.as_ref()?;
    let (width, height) = (f64::from(exact.width), f64::from(exact.height));
    // Values of the file are rounded to f32.
    let near = |found: f64, written: f64| (found - written).abs() <= 1e-5 * written.abs();
    let aspect = (width * exact.fy) / (height * exact.fx);
    if perspective.aspect_ratio.is_some_and(|found| !near(f64::from(found), aspect)) {
        return None;
    }
    let yfov = f64::from(perspective.yfov);
    if yfov > 0.0 && yfov < std::f64::consts::PI && !near(yfov, 2.0 * (0.5 * height / exact.fy).atan()) {
        let factor = (0.5 * height / exact.fy) / (0.5 * yfov).tan();
        (exact.fx, exact.fy) = (factor * exact.fx, factor * exact.fy);
    }
    Some(exact)
}
