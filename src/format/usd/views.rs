//! Conversion of `UsdGeomCamera` to cameras.

use glam::{DMat3, DMat4, DVec3};

use super::names;
use super::stage::Stage;
use crate::format::DEFAULT_HEIGHT;
use crate::format::placed::{Decomposed, similarity};
use crate::scene::{Camera, Intrinsics, frame};

/// Reads a camera with the world transform `transform`, followed by `to_scene`, and collects notes on assumptions; on
/// failure, the reason.
pub(super) fn read(
    stage: &Stage<'_>,
    prim: usize,
    transform: DMat4,
    to_scene: DMat4,
) -> Result<(Camera, Option<String>), String> {
    if stage.text(prim, "projection").is_some_and(|projection| projection != "perspective") {
        return Err("it is not a perspective camera".to_owned());
    }
    let placed = to_scene * transform;
    let Decomposed { rotation, translation, .. } =
        similarity(placed).ok_or("its transform has shear, mirroring or non-uniform scale")?;
    let pose = frame::camera_of_node(rotation, translation);

    // USD's defaults are those of a 35 mm film camera.
    let optics = [
        ("focalLength", 50.0),
        ("horizontalAperture", 20.955),
        ("verticalAperture", 15.2908),
        ("horizontalApertureOffset", 0.0),
        ("verticalApertureOffset", 0.0),
    ];
    let [focal, horizontal, vertical, right, up] =
        optics.map(|(name, default)| stage.number(prim, name).unwrap_or(default));
    if !(focal > 0.0 && horizontal > 0.0 && vertical > 0.0) {
        return Err(format!("focal length {focal} and apertures {horizontal}×{vertical} are not all positive"));
    }
    let stated = stage.numbers::<2>(prim, names::IMAGE_SIZE);
    let [width, height] = stated.unwrap_or_else(|| {
        let height = f64::from(DEFAULT_HEIGHT);
        [(height * horizontal / vertical).round().max(1.0), height]
    });
    // A cast saturates, and maps NaN to 0.
    if !Intrinsics::is_size(width as u32, height as u32) {
        return Err(format!("an image of {width}×{height} pixels"));
    }
    let (fx, fy) = (focal / horizontal * width, focal / vertical * height);
    let (cx, cy) = ((0.5 - right / horizontal) * width, (0.5 + up / vertical) * height);
    let mut k = Intrinsics { width: width as u32, height: height as u32, fx, fy, cx, cy };
    // The schema's numbers have single precision; a larger difference means that another program has changed them.
    if let Some([own_fx, own_fy, own_cx, own_cy]) = stage.numbers::<4>(prim, names::INTRINSICS) {
        let near = |a: f64, b: f64, size: f64| (a - b).abs() <= 1e-5 * size;
        let is_unchanged = near(own_fx, fx, fx)
            && near(own_fy, fy, fy)
            && near(own_cx, cx, width + cx.abs())
            && near(own_cy, cy, height + cy.abs());
        if is_unchanged {
            k = Intrinsics { fx: own_fx, fy: own_fy, cx: own_cx, cy: own_cy, ..k };
        }
    }
    let own = stage.numbers::<16>(prim, names::POSE).map(|pose| DMat4::from_cols_array(&pose));
    let own = own.map(|own| (DMat3::from_mat4(own), own.w_axis.truncate()));
    let tolerance = 1e-9 * (1.0 + pose.1.length());
    let is_unmoved = |own: &(DMat3, DVec3)| own.0.abs_diff_eq(pose.0, 1e-9) && own.1.abs_diff_eq(pose.1, tolerance);
    let (rotation, translation) = own.filter(is_unmoved).unwrap_or(pose);
    let camera = Camera::new(k, rotation, translation).map_err(|e| e.to_string())?;
    let note = || format!("a camera without an image size is taken to have {}×{} pixels", k.width, k.height);
    Ok((camera, stated.is_none().then(note)))
}
