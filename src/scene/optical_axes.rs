//! Common point of cameras' optical axes.

use glam::{DMat3, DVec3};

use super::Camera;

/// Least determinant of the mean of I − d dᵀ, over the directions d of axes, at which these count as meeting in a
/// point. It is about the square of the angle, in radians, by which directions spread: half a degree.
const LEAST_SPREAD: f64 = 1e-4;
/// Weight of an expected point, relative to a total weight of 1 for all axes.
const PRIOR: f64 = 1e-3;

/// Optical axes of cameras. The least-squares nearest point p to all axes satisfies Σ (I − d dᵀ)(p − c) = 0 over their
/// directions d and the centres c; world units.
#[derive(Clone, Copy, Debug)]
pub(crate) struct OpticalAxes {
    /// Mean of I − d dᵀ.
    across: DMat3,
    /// Mean of (I − d dᵀ) c.
    across_center: DVec3,
}

impl OpticalAxes {
    /// Optical axes of these cameras.
    pub(crate) fn of(cameras: &[Camera]) -> Self {
        let share = (cameras.len().max(1) as f64).recip();
        let (mut across, mut across_center) = (DMat3::ZERO, DVec3::ZERO);
        for camera in cameras {
            let d = camera.rotation().row(2);
            let of_axis = DMat3::IDENTITY - DMat3::from_cols(d * d.x, d * d.y, d * d.z);
            across += of_axis * share;
            across_center += of_axis * camera.center() * share;
        }
        Self { across, across_center }
    }

    /// The point nearest to all axes; `None` if they are nearly parallel, or there are none. It may lie behind cameras.
    pub(crate) fn meeting_point(&self) -> Option<DVec3> {
        let point = (self.across.determinant() > LEAST_SPREAD).then(|| self.across.inverse() * self.across_center)?;
        point.is_finite().then_some(point)
    }

    /// The point nearest to all axes and to an expected one, which hardly counts unless the axes are nearly parallel.
    pub(crate) fn meeting_point_near(&self, expected: DVec3) -> DVec3 {
        (self.across + DMat3::from_diagonal(DVec3::splat(PRIOR))).inverse() * (self.across_center + PRIOR * expected)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::Intrinsics;

    fn looking(center: DVec3, at: DVec3) -> Camera {
        let intrinsics = Intrinsics { width: 8, height: 8, fx: 8.0, fy: 8.0, cx: 4.0, cy: 4.0 };
        Camera::look_at(intrinsics, center, at, DVec3::ZERO).unwrap()
    }

    #[test]
    fn axes_that_cross_meet_where_they_cross() {
        let focus = DVec3::new(1.0, -2.0, 30.0);
        let centers = [DVec3::ZERO, DVec3::new(5.0, 0.0, 1.0), DVec3::new(0.0, 6.0, -2.0)];
        let axes = OpticalAxes::of(&centers.map(|c| looking(c, focus)));
        assert!(axes.meeting_point().unwrap().abs_diff_eq(focus, 1e-9));
        // The expected point has a weight of one thousandth, and moves the result mostly along the axes.
        assert!(axes.meeting_point_near(focus).abs_diff_eq(focus, 1e-9));
        assert!(axes.meeting_point_near(DVec3::ZERO).distance(focus) > 0.1);
    }

    #[test]
    fn parallel_axes_meet_nowhere_but_near_what_is_expected() {
        let cameras = [0.0, 1.0, 2.0].map(|x| looking(DVec3::X * x, DVec3::new(x, 0.0, 1.0)));
        let axes = OpticalAxes::of(&cameras);
        assert_eq!(axes.meeting_point(), None);
        assert!(axes.meeting_point_near(DVec3::new(1.0, 0.0, 7.0)).abs_diff_eq(DVec3::new(1.0, 0.0, 7.0), 1e-9));
        assert_eq!(OpticalAxes::of(&[]).meeting_point(), None);
    }
}
