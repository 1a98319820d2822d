//! Initial state of a run: splats, and the given mesh.

use glam::Vec2;

use super::{setup::Setup, unseen::without_unseen, views::Views};
use crate::{
    capture::{Capture, View},
    geometry::{self, ChartSpace, Surface},
    optimize::{
        Background, Density, TrainError, background,
        coverage::{self, Known},
        initialize::{self, Initial},
        maps,
    },
    scene::{Mesh, Splats},
};

/// Number of splats for a capture without points.
const RANDOM_SPLATS: usize = 20_000;

/// Number of initial splats in a run limited to `most`, not counting those placed where there are no points.
pub(super) fn initial_count(capture: &Capture, most: usize) -> usize {
    let points = capture.points.len();
    if points == 0 { RANDOM_SPLATS.min(most) } else { points.min(most) }
}

/// Initial splats beside these meshes. Unless the run `begins`, saved ones will replace them, so only those of points
/// are made.
pub(super) fn splats(setup: &Setup, views: &Views, beside: &[Mesh], begins: bool) -> Result<Splats, TrainError> {
    let (o, points) = (setup.options, &setup.capture.points);
    let most = setup.budget.splats_beside(beside);
    let is_mcmc = o.density == Density::Mcmc;
    if points.is_empty() {
        let initial = if is_mcmc { Initial::MCMC } else { Initial::INRIA };
        let count = initial_count(setup.capture, most);
        return Ok(initialize::from_cameras(&views.train_cameras, count, o.sh_degree, initial, o.seed)?);
    }
    let initial = if is_mcmc { Initial::mcmc_in(o.iterations) } else { Initial::INRIA };
    let of_points = |most| initialize::from_points(points, o.sh_degree, initial, most, o.seed);
    // Density control by gradients begins with splats large enough to cover regions without points, and soon prunes
    // larger ones.
    if !is_mcmc || !begins {
        return Ok(of_points(most)?);
    }
    let (room, photos) = (most / 4, &views.photos);
    let photo = |view: &View| photos.whole(view);
    let far_room = if photos.are_cut_out { 0 } else { room };
    let empty = (o.background != Background::Random).then(|| setup.composition().background);
    let behind = background::behind_points(setup.capture, &setup.train, o.sh_degree, far_room, empty, photo)?;
    let train: Vec<_> = setup.train.iter().map(|&i| &setup.capture.views[i]).collect();
    let far = behind.means().iter().map(|m| m.as_dvec3());
    let known: Vec<_> = points.iter().map(|p| p.position).chain(far).collect();
    let near = f64::from(setup.scales.near);
    let known = Known { points: &known, meshes: &setup.hierarchy(beside), near, background: empty };
    let between = coverage::between_points(&train, &known, o.sh_degree, room - behind.len(), photo)?;
    let mut all = of_points(most - behind.len() - between.len())?.into_arrays();
    all.append(behind.into_arrays());
    all.append(between.into_arrays());
    Ok(all.check()?)
}

/// The user's mesh with empty maps, within the budget, transparent where no training view sees it.
pub(super) fn given_mesh(
    setup: &Setup,
    views: &Views,
    surface: Surface,
    corner_uvs: Option<Vec<[Vec2; 3]>>,
) -> Result<Mesh, TrainError> {
    let mesh = match corner_uvs {
        Some(uvs) => maps::textured(surface, uvs, setup.options, setup.budget.texture_size())?,
        None => with_empty_maps(setup, &surface, None)?,
    };
    setup.budget.check(std::slice::from_ref(&mesh))?;
    without_unseen(setup, views, mesh)
}

/// The surface cut into charts, in this space if not the world, with empty maps that have room for them.
pub(super) fn with_empty_maps(
    setup: &Setup,
    surface: &Surface,
    chart_space: Option<&ChartSpace>,
) -> Result<Mesh, TrainError> {
    let (size, largest) = (setup.budget.texture_size(), setup.budget.largest_texture());
    maps::with_room_for_charts(size, largest, |size| {
        maps::textured_as(geometry::unwrap(surface, chart_space, size, geometry::WIDEST_GUTTER)?, setup.options, size)
    })
}
