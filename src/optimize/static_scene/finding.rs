//! Making of a surface, from the capture's points or from splats, and of a mesh from it.

use glam::Vec3;

use super::{backdrop::painted, setup::Setup, start::with_empty_maps, views::Views};
use crate::{
    capture::{Capture, View},
    geometry::{ChartSpace, Contraction, GeometryError, Surface, Viewers},
    optimize::{SurfaceOrigin, TrainError, cut_out, fused, seen_points},
    render::gpu::{state, training::Training},
    scene::Mesh,
};

/// Makes a mesh by fusing triangles between the points that the training views see, or the median depths of the present
/// splats; also says which.
pub(super) fn find_surface(
    setup: &Setup,
    views: &Views,
    training: &mut Training,
    of_points: bool,
) -> Result<(Mesh, SurfaceOrigin), TrainError> {
    let (o, capture, photos) = (setup.options, setup.capture, &views.photos);
    if of_points {
        let photo_of = |view: &View| photos.are_cut_out.then(|| photos.whole(view)).transpose();
        let seen = seen_points::point_views(capture, &views.cameras, &setup.train, photo_of)?;
        // With few points left the surface would be a guess, where splats know better.
        if !seen_points::are_few_left(capture, &setup.train, &seen) {
            match fused::from_points(capture, &seen, o.triangles, o.planar) {
                Ok((surface, _, origin)) => return Ok((textured(setup, views, training, surface)?, origin)),
                Err(GeometryError::EmptySurface { .. }) => {}
                Err(error) => return Err(error.into()),
            }
        }
    }
    let points = whereabouts(capture, training)?;
    let (surface, _) = fused::from_depths(&views.train_cameras, &points, o.triangles, o.planar, |i| {
        let mut depth = training.median_depth(&views.train_cameras[i])?;
        cut_out::clear_unseen(&mut depth, &*photos.whole_of(setup.train[i])?);
        Ok(depth)
    })?;
    Ok((textured(setup, views, training, surface)?, SurfaceOrigin::Splats))
}

/// Turns a surface into a mesh with empty maps; if there is a shell, what training views see past the surface is added
/// on it and painted.
fn textured(setup: &Setup, views: &Views, training: &Training, surface: Surface) -> Result<Mesh, TrainError> {
    let chart_space = chart_space(setup, views, training)?;
    let Some(shell) = &setup.shell else { return with_empty_maps(setup, &surface, chart_space.as_ref()) };
    // Past the surface is where nothing of it is, whatever may show through.
    let viewers = Viewers { layers: 1, ..setup.viewers(&views.train_cameras) };
    let both = shell.around_surface(surface.clone(), &viewers);
    // Nothing is left if all of it is far away, and no two views see the same part of the shell.
    let surface = if both.triangles.is_empty() { surface } else { both };
    painted(setup, views, with_empty_maps(setup, &surface, chart_space.as_ref())?)
}

/// Space of charts, if not the world: in unbounded scenes and with a shell. By the present cameras.
pub(super) fn chart_space(setup: &Setup, views: &Views, training: &Training) -> Result<Option<ChartSpace>, TrainError> {
    let (cameras, points) = (&views.train_cameras, whereabouts(setup.capture, training)?);
    let around = || Contraction::around(cameras, &points);
    Ok(match (Contraction::if_unbounded(cameras, &points)?, setup.shell) {
        (Some(contraction), _) => Some(ChartSpace::unbounded(contraction)),
        (None, Some(shell)) => Some(ChartSpace::within_shell(around()?, shell)),
        (None, None) => None,
    })
}

/// Points from which the scene's place is estimated, see [`fused::whereabouts`]. Splats beside an untrained mesh rest,
/// so the answer does not change.
fn whereabouts(capture: &Capture, training: &Training) -> Result<Vec<Vec3>, TrainError> {
    fused::whereabouts(capture, || Ok(state::means(&training.read_geometry()?)?))
}
