//! Size of a scene, in a capture's arbitrary unit of length.

use std::ops::RangeInclusive;

use crate::{
    capture::{self, Capture},
    scene::Camera,
    stats::median,
};

/// Typical extent of captures as scaled by COLMAP, for which noise and regularisers of 3DGS-MCMC were chosen: lengths
/// are in their units.
const USUAL_EXTENT: f64 = 5.0;
/// Extent divided by median depth of such captures; in others cameras stand closer together, or are spread farther.
const USUAL_SPREAD: RangeInclusive<f64> = 0.5..=1.5;
/// Tangent of half a lens's angle of view below which the visible region is notably smaller than its distance.
const NARROW: f64 = 0.1;
/// Distances of what views see with which training works, in the unit of the capture: the variances of splats in a
/// smaller scene leave the range of f32, and the depths of a larger one that of the sort keys, which end at 2³² times the
/// near plane.
pub(super) const DISTANCES: RangeInclusive<f32> = 1e-14..=5e8;
/// Largest number of projected points, over all views, from which the median depth is taken.
const DEPTHS: usize = 1_000_000;

/// [`capture::extent_or_depth`] of cameras, and 1 if nothing tells.
pub(super) fn extent(cameras: &[Camera], depth: Option<f64>) -> f64 {
    capture::extent_or_depth(cameras, depth).unwrap_or(1.0)
}

/// Near plane for a scene of this extent ([`extent`]): as wanted, but at most a twentieth of it.
pub(super) fn near_plane(extent: f32, wanted: f32) -> f32 {
    wanted.min(0.05 * extent)
}

/// Factor, at most 1, by which a narrow angle of view makes the visible region smaller than through usual lenses,
/// relative to its distance and to the spread of the cameras; from the median angle of view along the longer side.
pub(super) fn narrowness(cameras: &[Camera]) -> f64 {
    let half_angle = |camera: &Camera| {
        let k = camera.intrinsics();
        (f64::from(k.width) / k.fx).max(f64::from(k.height) / k.fy) / 2.0
    };
    median(cameras.iter().map(half_angle).collect()).map_or(1.0, |tangent| (tangent / NARROW).min(1.0))
}

/// A capture's unit of length, relative to captures for which constants with a length in them were chosen: from the
/// extent of its cameras, clamped to what the depth of the scene makes plausible.
pub(super) fn unit_of_length(extent: f64, depth: Option<f64>) -> f64 {
    depth.map_or(extent, |d| extent.clamp(USUAL_SPREAD.start() * d, USUAL_SPREAD.end() * d)) / USUAL_EXTENT
}

/// Median depth of the points that project into these views; `None` if there are none.
pub(super) fn median_depth(capture: &Capture, views: &[usize]) -> Option<f64> {
    let step = (views.len() * capture.points.len()).div_ceil(DEPTHS).max(1);
    let in_view = |&i: &usize| {
        let camera = &capture.views[i].camera;
        let points = capture.points.iter().step_by(step).map(|point| camera.to_camera(point.position));
        points.filter_map(|p| camera.in_picture(p).map(|_| p.z))
    };
    median(views.iter().flat_map(in_view).collect())
}
