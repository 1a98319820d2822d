//! Camera paths around a captured subject: from posed views to the frames of a shot.
//!
//! All are in the world of the views, whatever it is; up is where the views have theirs. A path never holds a number
//! that is not finite: views that say too little give an error, which names the option that says the rest. Of a scene
//! without views [`overview()`] makes some.

mod overview;
mod rig;
mod spline;
#[cfg(test)]
mod tests;

use glam::DVec3;

use crate::scene::{Camera, Intrinsics, SceneError, view_axes};
use crate::stats::median_by;
pub use overview::{Overview, UP, overview};
use rig::Rig;
pub use spline::{Spline, spline};

/// Options common to all paths.
#[derive(Clone, Copy, Debug)]
pub struct Shot {
    /// Number of frames, at least 1.
    pub frames: usize,
    /// Width and height of the image; `None`: those of the view with the median vertical field of view.
    pub size: Option<[u32; 2]>,
    /// Vertical field of view in radians; `None`: the median over the views.
    pub fov_y: Option<f64>,
}

/// Options of a path around the point at which the views look; lengths are in world units.
#[derive(Clone, Copy, Debug)]
pub struct Around {
    /// Point to look at; `None`: the least-squares nearest point to all optical axes.
    pub focus: Option<DVec3>,
    /// Radius of the circle, or half the width of the figure of eight; `None`: derived from the views.
    pub radius: Option<f64>,
    /// Height of the circle's centre above the focus, along the circle's axis; or half the height of the loops of the
    /// figure of eight. `None`: derived from the views.
    pub height: Option<f64>,
    /// Factor by which the radius is multiplied.
    pub radius_scale: f64,
    /// Factor by which the height is multiplied.
    pub height_scale: f64,
}

impl Default for Around {
    fn default() -> Self {
        Self { focus: None, radius: None, height: None, radius_scale: 1.0, height_scale: 1.0 }
    }
}

/// Reasons for which no path can be made.
#[derive(Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum PathError {
    /// There are too few views.
    #[error("expected at least {expected} views, found {found}")]
    TooFew {
        /// Least number of views.
        expected: usize,
        /// Number of views found.
        found: usize,
    },
    /// All optical axes are parallel, or there is only one.
    #[error("the views' optical axes do not meet in a point: state what to look at as the focus")]
    NoFocus,
    /// The point nearest to the optical axes lies behind most views.
    #[error("the views look away from each other: state what to look at as the focus")]
    Outwards,
    /// The circle or figure of eight would shrink to a point.
    #[error("the views are on the axis through the focus: state the radius")]
    NoRadius,
    /// A scene without views shows nothing either.
    #[error("expected a scene to look at, found no splats and no meshes")]
    Empty,
    /// The options do not make a camera.
    #[error("{0}")]
    Camera(#[from] SceneError),
}

/// Circle about the focus in the best-fit plane of the camera centres, or a level one where that plane is undefined or
/// more than 45° from level. Radius and height default to the views' mean distance from the axis and mean height above
/// the focus. Frames are evenly spaced, counterclockwise seen from above; the first has the azimuth of the first view
/// and is not repeated at the end, so that the shot can be looped.
///
/// # Errors
/// If there are no views, or they do not determine where to look at or from.
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

/// Upper bound on half the width of a figure of eight, relative to the distance to the focus, unless stated.
const WIDEST: f64 = 0.25;
/// Half the width of a figure of eight relative to the distance to the focus, where all views coincide.
const DEFAULT_WIDTH: f64 = 0.1;

/// Figure of eight (the lemniscate of Gerono: x = a sin t, y = b sin 2t), perpendicular to the direction from the focus
/// to the mean view, at the views' mean distance; where the views surround the focus, the direction is that to the
/// first view. Half the width, a, is the root-mean-square spread of the views perpendicular to that direction; half the
/// height of the loops, b, is a/3. Every frame looks at the focus. The first frame is at the crossing; the shot can be
/// looped.
///
/// # Errors
/// Same as [`orbit`].
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
