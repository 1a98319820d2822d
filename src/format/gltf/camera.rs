//! glTF cameras as pinhole cameras.

use glam::{DMat3, DMat4, DVec3};
use serde_json::Value;

use super::extension::{EXTRAS, ExactCamera};
use crate::format::DEFAULT_HEIGHT;
use crate::format::cameras::short;
use crate::format::placed::{Decomposed, similarity};
use crate::scene::{Camera, Intrinsics};

/// What a camera at a node is called; `nth` of those that are read, from 0, if nobody says.
pub(super) fn name(node: &gltf::Node<'_>, nth: usize) -> String {
    let name = node.name().or(node.camera().and_then(|camera| camera.name()));
    name.map_or_else(|| format!("camera_{nth}"), short)
}

/// A camera and what had to be assumed about it; on failure, the reason.
pub(super) fn read(
    document: &gltf::Document,
    index: usize,
    transform: DMat4,
) -> Result<(Camera, Option<String>), String> {
    let camera = document.as_json().cameras.get(index).ok_or("no such camera")?;
    let Decomposed { rotation, translation, .. } =
        similarity(transform).ok_or("its node shears, mirrors or stretches")?;
    let to_camera = (DMat3::from_quat(rotation) * DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0))).transpose();
    let pose = (to_camera, -(to_camera * translation));

    let extras = camera.extras.as_ref().and_then(|e| serde_json::from_str::<Value>(e.get()).ok());
    let exact = extras.and_then(|e| serde_json::from_value::<ExactCamera>(e.get(EXTRAS)?.clone()).ok());
    if let Some(c) = &exact
        && !Intrinsics::is_size(c.width, c.height)
    {
        return Err(format!("its image of {}×{} pixels is empty or too large", c.width, c.height));
    }
    let reshaped = exact.is_some();
    if let Some(c) = exact.and_then(|mut c| takes_lens_of(&mut c, camera).then_some(c)) {
        let k = Intrinsics { width: c.width, height: c.height, fx: c.fx, fy: c.fy, cx: c.cx, cy: c.cy };
        let own = (DMat3::from_cols_array(&c.rotation).transpose(), DVec3::from(c.translation));
        // glTF nodes are read in f32; a larger difference means that somebody has moved the camera.
        let tolerance = 1e-5 * (1.0 + own.1.length());
        let unmoved = own.0.abs_diff_eq(pose.0, 1e-5) && own.1.abs_diff_eq(pose.1, tolerance);
        let (rotation, translation) = if unmoved { own } else { pose };
        return Camera::new(k, rotation, translation).map(|c| (c, None)).map_err(|e| e.to_string());
    }
    let perspective = camera.perspective.as_ref().ok_or("it is orthographic, and cameras here are pinholes")?;
    let yfov = f64::from(perspective.yfov);
    if !(yfov > 0.0 && yfov < std::f64::consts::PI) {
        return Err(format!("its yfov of {yfov} is not between 0 and π"));
    }
    let aspect = perspective.aspect_ratio.map(f64::from).filter(|a| a.is_finite() && *a > 0.0);
    let height = f64::from(DEFAULT_HEIGHT);
    let width = (aspect.unwrap_or(16.0 / 9.0) * height).round().clamp(1.0, f64::from(Intrinsics::MAX_PICTURE_SIDE));
    let f = 0.5 * height / (0.5 * yfov).tan();
    let (cx, cy) = (0.5 * width, 0.5 * height);
    let k = Intrinsics { width: width as u32, height: DEFAULT_HEIGHT, fx: f, fy: f, cx, cy };
    let what = if reshaped { "whose aspect ratio was changed since Centaur wrote it" } else { "without an image size" };
    let note = format!("a camera {what} is taken to have {}×{} pixels", k.width, k.height);
    Camera::new(k, pose.0, pose.1).map(|c| (c, Some(note))).map_err(|e| e.to_string())
}

/// Gives the exact camera the field of view that the file has now: somebody may have changed that and kept the extras. False if the
/// aspect ratio has changed, and with it the picture.
fn takes_lens_of(exact: &mut ExactCamera, camera: &gltf::json::Camera) -> bool {
    let Some(perspective) = camera.perspective.as_ref() else { return false };
    let (width, height) = (f64::from(exact.width), f64::from(exact.height));
    // The file's are rounded to f32.
    let near = |found: f64, written: f64| (found - written).abs() <= 1e-5 * written.abs();
    let aspect = (width * exact.fy) / (height * exact.fx);
    if perspective.aspect_ratio.is_some_and(|found| !near(f64::from(found), aspect)) {
        return false;
    }
    let yfov = f64::from(perspective.yfov);
    if yfov > 0.0 && yfov < std::f64::consts::PI && !near(yfov, 2.0 * (0.5 * height / exact.fy).atan()) {
        let factor = (0.5 * height / exact.fy) / (0.5 * yfov).tan();
        (exact.fx, exact.fy) = (factor * exact.fx, factor * exact.fy);
    }
    true
}
