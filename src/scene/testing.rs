//! Plain cameras and splats for tests.

use glam::{DMat3, DVec3, Quat, Vec3};

use super::{Camera, Intrinsics, Splats};

/// A camera at `center` that looks along z, of a picture of this width and height with the principal point in its
/// middle.
pub(crate) fn ahead([width, height]: [u32; 2], focal: f64, center: DVec3) -> Camera {
    let [cx, cy] = [width, height].map(|side| 0.5 * f64::from(side));
    let intrinsics = Intrinsics { width, height, fx: focal, fy: focal, cx, cy };
    Camera::new(intrinsics, DMat3::IDENTITY, -center).unwrap()
}

/// Round splats of SH degree 0 that are alike but for their means.
pub(crate) fn alike(means: Vec<Vec3>, log_scale: f32, opacity_logit: f32, sh: [f32; 3]) -> Splats {
    let n = means.len();
    let (rotations, log_scales) = (vec![Quat::IDENTITY; n], vec![Vec3::splat(log_scale); n]);
    Splats::new(means, rotations, log_scales, vec![opacity_logit; n], 0, vec![sh; n]).unwrap()
}
