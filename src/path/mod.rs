//! Camera paths through what was photographed: from posed views to the frames of a shot.
//!
//! All are in the world of the views, whatever it is; up is where the views have theirs. A path never holds a number that
//! is not finite: views that say too little give an error, which names the option that says the rest. Of a scene without
//! views [`overview()`] makes some.

mod overview;
mod rig;
mod spline;
#[cfg(test)]
mod tests;

use glam::DVec3;

use crate::scene::{Camera, Intrinsics, SceneError, view_axes};
use crate::stats::median_by;
pub use overview::{Overview, overview};
use rig::Rig;
pub use spline::{Spline, spline};

/// What all paths share.
#[derive(Clone, Copy, Debug)]
pub struct Shot {
    /// Number of frames, at least 1.
    pub frames: usize,
    /// Width and height of the image; `None`: those of the view with the median field of view.
    pub size: Option<[u32; 2]>,
    /// Vertical field of view in radians; `None`: the median of the views.
    pub fov_y: Option<f64>,
}

/// A path around the point that the views look at; lengths are in world units.
#[derive(Clone, Copy, Debug)]
pub struct Around {
    /// That point; `None`: the one nearest to all optical axes, by squared distance.
    pub focus: Option<DVec3>,
    /// Radius of the circle, half the width of the figure of eight; `None`: from the views.
    pub radius: Option<f64>,
    /// Of the circle's centre above the focus, along its axis; half the height of the loops of the figure of eight.
    pub height: Option<f64>,
    /// Factor of the radius.
    pub radius_scale: f64,
    /// Factor of the height.
    pub height_scale: f64,
}

impl Default for Around {
    fn default() -> Self {
        Self { focus: None, radius: None, height: None, radius_scale: 1.0, height_scale: 1.0 }
    }
}

/// Why there is no path.
#[derive(Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum PathError {
    /// There is nothing to make it from.
    #[error("expected at least {expected} views, found {found}")]
    TooFew {
        /// Least number.
        expected: usize,
        /// Number of views.
        found: usize,
    },
    /// Optical axes are parallel, or there is one only.
    #[error("the views' optical axes do not meet in a point: state what to look at as the focus")]
    NoFocus,
    /// The point nearest to the optical axes is behind most views.
    #[error("the views look away from each other: state what to look at as the focus")]
    Outwards,
    /// Circle or figure would be a point.
    #[error("the views are on the axis through the focus: state the radius")]
    NoRadius,
    /// A scene without views shows nothing either.
    #[error("expected a scene to look at, found no splats and no meshes")]
    Empty,
    /// The options do not make a camera.
    #[error("{0}")]
    Camera(#[from] SceneError),
}

/// A circle about the focus in the plane that fits the views' centres best, or a level one where that plane is more than 45°
/// from level or is none. Radius and height are the views' mean distances from its axis and above the focus. Frames are
/// evenly spaced, counterclockwise seen from above, begin at the azimuth of the first view, and do not repeat it: the shot
/// can be looped.
///
/// # Errors
/// If there are no views, or they do not say what to look at or from where.
pub fn orbit(views: &[Camera], around: &Around, shot: &Shot) -> Result<Vec<Camera>, PathError> {
    let k = intrinsics(views, shot)?;
    let rig = Rig::of(views)?;
    let focus = around.focus.map_or_else(|| rig.focus(), Ok)?;
    let axis = rig.orbit_axis();
    let offsets = || rig.centers.iter().map(|&c| c - focus);
    let n = rig.centers.len() as f64;
    let height = around.height.unwrap_or_else(|| offsets().map(|o| o.dot(axis)).sum::<f64>() / n) * around.height_scale;
    let flat = |o: DVec3| o - axis * o.dot(axis);
    let radius = around.radius.unwrap_or_else(|| offsets().map(|o| flat(o).length()).sum::<f64>() / n);
    let radius = radius * around.radius_scale;
    let size = height.abs() + offsets().map(DVec3::length).sum::<f64>() / n;
    if radius.is_nan() || radius <= 1e-6 * size {
        return Err(PathError::NoRadius);
    }
    let first = flat(rig.centers[0] - focus);
    let start = if first.length() > 1e-6 * size { first.normalize() } else { axis.any_orthonormal_vector() };
    let side = axis.cross(start);
    let frame = |i: usize| {
        let (sin, cos) = (std::f64::consts::TAU * i as f64 / shot.frames as f64).sin_cos();
        let center = focus + axis * height + (start * cos + side * sin) * radius;
        Ok(Camera::look_at(k, center, focus, rig.up)?)
    };
    (0..shot.frames).map(frame).collect()
}

/// Half the width of a figure of eight is at most this part of the distance to the focus, unless stated.
const WIDEST: f64 = 0.25;
/// And this part where all views are in one place.
const DEFAULT_WIDTH: f64 = 0.1;

/// A figure of eight (the lemniscate of Gerono: x = a sin t, y = b sin 2t) across the direction from the focus to the mean
/// view, at the views' mean distance; where the views surround the focus, to the first view instead. Half its width a is the
/// views' spread (root mean square) across that direction, half the height of its loops b a third of a. Every frame looks
/// at the focus. The first is in the middle; the shot can be looped.
///
/// # Errors
/// As [`orbit`].
pub fn lemniscate(views: &[Camera], around: &Around, shot: &Shot) -> Result<Vec<Camera>, PathError> {
    let k = intrinsics(views, shot)?;
    let rig = Rig::of(views)?;
    let focus = around.focus.map_or_else(|| rig.focus(), Ok)?;
    let offsets: Vec<DVec3> = rig.centers.iter().map(|&c| c - focus).collect();
    let n = offsets.len() as f64;
    let distance = offsets.iter().map(|o| o.length()).sum::<f64>() / n;
    let mean = offsets.iter().map(|o| o.normalize_or_zero()).sum::<DVec3>() / n;
    let toward = if mean.length() > 0.5 { mean } else { offsets[0] }.normalize_or_zero();
    if toward == DVec3::ZERO {
        return Err(PathError::NoRadius);
    }
    let across = |o: &DVec3| (*o - toward * o.dot(toward)).length_squared();
    let spread = (offsets.iter().map(across).sum::<f64>() / n).sqrt().min(WIDEST * distance);
    let spread = if spread > 1e-6 * distance { spread } else { DEFAULT_WIDTH * distance };
    let a = around.radius.unwrap_or(spread) * around.radius_scale;
    let b = around.height.unwrap_or(a / 3.0) * around.height_scale;
    if a.is_nan() || a <= 0.0 {
        return Err(PathError::NoRadius);
    }
    let to_world = view_axes(-toward, rig.up);
    let frame = |i: usize| {
        let t = std::f64::consts::TAU * i as f64 / shot.frames as f64;
        let center =
            focus + toward * distance + to_world.x_axis * (a * t.sin()) - to_world.y_axis * (b * (2.0 * t).sin());
        Ok(Camera::look_at(k, center, focus, rig.up)?)
    };
    (0..shot.frames).map(frame).collect()
}

/// Intrinsics of all frames: the principal point is in the middle, pixels have the aspect of the view's.
fn intrinsics(views: &[Camera], shot: &Shot) -> Result<Intrinsics, PathError> {
    let fov = |c: &Camera| c.intrinsics().fov_y();
    let view = median_by(views.to_vec(), fov).ok_or(PathError::TooFew { expected: 1, found: 0 })?;
    let own = view.intrinsics();
    let [width, height] = shot.size.unwrap_or([own.width, own.height]);
    let square = Intrinsics::from_fov_y(width, height, shot.fov_y.unwrap_or_else(|| fov(&view)));
    Ok(Intrinsics { fx: square.fy * own.fx / own.fy, ..square })
}
