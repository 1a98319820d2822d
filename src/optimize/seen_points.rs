//! Which of a capture's points its views see, and whether these are enough for a surface of them.

use std::sync::Arc;

use glam::{DVec2, Vec3};
use rayon::prelude::*;

use crate::{
    capture::{Capture, CaptureError, DECODED_AT_ONCE, Photo, View},
    geometry::PointView,
    scene::Camera,
    stats::median,
};

/// Points that the median view must be known to see for a surface of points by default: some too few for its triangles to be
/// more than guesses. Structure from motion finds hundreds.
const LEAST_SEEN: usize = 100;

/// What these views of a capture see of its points, by the `cameras` of all its views: what its list says, or is likely where that says
/// nothing, and of that what photographs show where `photo_of` has one that may leave something out. A view of which nothing is left then is
/// none.
///
/// # Errors
/// If a photograph cannot be read.
///
/// # Panics
/// If a view has no camera.
pub fn point_views(
    capture: &Capture,
    cameras: &[Camera],
    views: &[usize],
    photo_of: impl Fn(&View) -> Result<Option<Arc<Photo>>, CaptureError> + Sync,
) -> Result<Vec<PointView>, CaptureError> {
    let points = capture.positions();
    let listed = |&i: &usize| {
        let (camera, sees) = (cameras[i], &capture.views[i].sees);
        let known = || PointView { camera, sees: sees.clone(), guessed: false };
        (i, if sees.is_empty() { PointView::guess(camera, &points) } else { known() })
    };
    let mut seen: Vec<(usize, PointView)> = views.par_iter().map(listed).collect();
    let clear = |(i, of_view): &mut (usize, PointView)| {
        let Some(photo) = photo_of(&capture.views[*i])? else { return Ok(()) };
        let camera = of_view.camera;
        let at = |point: &Vec3| camera.in_picture(camera.to_camera(point.as_dvec3()));
        let is_left = |at: DVec2| !photo.is_cut_out(photo.index_at(at));
        of_view.sees.retain(|&p| points.get(p as usize).and_then(at).is_some_and(is_left));
        Ok::<_, CaptureError>(())
    };
    for part in seen.chunks_mut(DECODED_AT_ONCE) {
        part.par_iter_mut().try_for_each(clear)?;
    }
    Ok(seen.into_iter().map(|(_, of_view)| of_view).filter(|of_view| !of_view.sees.is_empty()).collect())
}

/// Whether so few of the points that views see are left by what photographs show of them that a surface of them would be a guess, where it would
/// not have been one before.
pub(super) fn are_few_left(capture: &Capture, views: &[usize], seen: &[PointView]) -> bool {
    let listed = views.iter().map(|&i| capture.views[i].sees.len()).collect();
    // A view of which nothing is left is none, and has none.
    let left = seen.iter().map(|view| view.sees.len());
    let left = left.chain(std::iter::repeat_n(0, views.len() - seen.len())).collect();
    are_many(listed) && !are_many(left)
}

/// Whether the median view sees enough points for a surface of them, by how many each sees.
pub(super) fn are_many(seen: Vec<usize>) -> bool {
    median(seen.into_iter().map(|count| count as f64).collect()).is_some_and(|median| median >= LEAST_SEEN as f64)
}
