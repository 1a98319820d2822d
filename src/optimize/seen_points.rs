//! Points visible in a capture's views, and whether these are enough to make a surface of.

use std::sync::Arc;

use glam::{DVec2, Vec3};
use rayon::prelude::*;

use crate::{
    capture::{Capture, CaptureError, DECODED_AT_ONCE, Photo, View},
    geometry::PointView,
    scene::Camera,
    stats::median,
};

/// Least number of visible points listed for the median view for a surface to be made of points by default: with
/// somewhat fewer its triangles would already be guesses. Structure from motion finds hundreds.
const LEAST_SEEN: usize = 100;

/// Per view, the visible points: from the structure-from-motion track list if present, else estimated; points masked
/// out of the photograph are removed. `cameras` are those of all views of the capture; `photo_of` yields a view's
/// photograph where it may mask something. Views left with no point are omitted.
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

/// Whether the photographs' masks leave so few visible points that a surface of them would be a guess, where it was
/// none before.
pub(super) fn are_few_left(capture: &Capture, views: &[usize], seen: &[PointView]) -> bool {
    let listed = views.iter().map(|&i| capture.views[i].sees.len()).collect();
    // Views left with no point are missing from `seen`; each counts as 0.
    let left = seen.iter().map(|view| view.sees.len());
    let left = left.chain(std::iter::repeat_n(0, views.len() - seen.len())).collect();
    are_many(listed) && !are_many(left)
}

/// Whether the median view sees enough points for a surface of them, by how many each sees.
pub(super) fn are_many(seen: Vec<usize>) -> bool {
    median(seen.into_iter().map(|count| count as f64).collect()).is_some_and(|median| median >= LEAST_SEEN as f64)
}
