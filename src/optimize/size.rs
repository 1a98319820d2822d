//! How large a scene is, in a capture's unit of length, which is any.

use std::ops::RangeInclusive;

use crate::{
    capture::{self, Capture},
    scene::Camera,
    stats::median,
};

/// Extent of captures as COLMAP scales them, about, for which noise and regularisers of 3DGS-MCMC were chosen: lengths are in their units.
const USUAL_EXTENT: f64 = 5.0;
/// Extents of median depth that such captures have; cameras of others stand closer together, or are spread farther.
const USUAL_SPREAD: RangeInclusive<f64> = 0.5..=1.5;
/// Tangent of half the angle of view of lenses, below which what they see is no longer about as large as it is far away.
const NARROW: f64 = 0.1;
/// Points of the pictures of all views, of which the median depth is taken, at most.
const DEPTHS: usize = 1_000_000;

/// [`capture::extent_or_depth`] of cameras, and 1 if nothing tells.
pub(super) fn extent(cameras: &[Camera], depth: Option<f64>) -> f64 {
    capture::extent_or_depth(cameras, depth).unwrap_or(1.0)
}

/// Near plane of a scene of this extent ([`extent`]): as wanted, but no more than a twentieth of it.
pub(super) fn near_plane(extent: f32, wanted: f32) -> f32 {
    wanted.min(0.05 * extent)
}

/// How much smaller what cameras see is, beside how far away it is and how far they are apart, than through usual lenses: 1, and less through
/// long ones, by the median of their angles of view along the longer side.
pub(super) fn narrowness(cameras: &[Camera]) -> f64 {
    let half_angle = |camera: &Camera| {
        let k = camera.intrinsics();
        (f64::from(k.width) / k.fx).max(f64::from(k.height) / k.fy) / 2.0
    };
    median(cameras.iter().map(half_angle).collect()).map_or(1.0, |tangent| (tangent / NARROW).min(1.0))
}

/// A capture's size in that of captures for which constants with a length in them were chosen: by the extent of its cameras, as far as this
/// says how large what they see is.
pub(super) fn unit_of_length(extent: f64, depth: Option<f64>) -> f64 {
    depth.map_or(extent, |d| extent.clamp(USUAL_SPREAD.start() * d, USUAL_SPREAD.end() * d)) / USUAL_EXTENT
}

/// Of the points in the pictures of these views; `None` if there are none.
pub(super) fn median_depth(capture: &Capture, views: &[usize]) -> Option<f64> {
    let step = (views.len() * capture.points.len()).div_ceil(DEPTHS).max(1);
    let in_view = |&i: &usize| {
        let camera = &capture.views[i].camera;
        let points = capture.points.iter().step_by(step).map(|point| camera.to_camera(point.position));
        points.filter_map(|p| camera.in_picture(p).map(|_| p.z))
    };
    median(views.iter().flat_map(in_view).collect())
}
