//! Removal, after training, of splats behind an opaque mesh and of triangles that have become invisible.

use glam::DVec2;

use super::{masks::Masks, setup::Setup, views::Views};
use crate::{
    geometry::{self, Viewers},
    optimize::TrainError,
    render::gpu::training::{Show, Training},
    scene::{Camera, Mesh, Splats, gather},
};

/// Largest blend weight of a splat beside the mesh, relative to that without the mesh, at which it counts as hidden.
const SHOWN: f64 = 0.02;
/// Mean opacity below which a triangle is removed after training: 0.02, at most 5 of 255 steps.
const FAINT: f64 = 0.02;

/// The trained splats without those that the mesh hides from all training views: by rays towards them, see
/// [`geometry::occluded_splats`], and, since rays miss what is between them, by their blend weights with the mesh and
/// without it. Masked-out pixels do not count in either.
pub(super) fn without_occluded(
    setup: &Setup,
    views: &Views,
    training: &mut Training,
    splats: Splats,
    meshes: &[Mesh],
) -> Result<Splats, TrainError> {
    if meshes.is_empty() {
        return Ok(splats);
    }
    let masks = Masks::of(&views.photos, &setup.train)?;
    let shows = |view: usize, at: DVec2| masks.show(view, at);
    let viewers = Viewers { shows: &shows, ..setup.viewers(&views.train_cameras) };
    let occluded = geometry::occluded_splats(&splats, (meshes, &setup.hierarchy(meshes)), SHOWN, &viewers);
    if !occluded.contains(&true) {
        return Ok(splats);
    }
    let mut weights = |show| blended(&views.train_cameras, training, &masks, show);
    let (beside, alone) = (weights(Show::All)?, weights(Show::SplatsAlone)?);
    let is_seen = |i: &usize| !occluded[*i] || beside[*i] > SHOWN * alone[*i];
    let seen: Vec<usize> = (0..occluded.len()).filter(is_seen).collect();
    Ok(gather(splats, &seen))
}

/// The trained mesh without the triangles that show next to nothing and hide nothing of it, see
/// [`geometry::faint_triangles`], also where masks leave nothing in: it may be seen from there. The maps stay as they
/// are. `None` if nothing is left.
pub(super) fn without_faint(mesh: Mesh, viewers: &Viewers) -> Option<Mesh> {
    let faint = geometry::faint_triangles(&mesh, FAINT, viewers);
    let keep: Vec<bool> = faint.iter().map(|faint| !faint).collect();
    if keep.contains(&false) { mesh.with_triangles(&keep) } else { Some(mesh) }
}

/// Σ of the blend weights of every splat `[N]` over all pixels that the training views, with these cameras, show.
fn blended(cameras: &[Camera], training: &mut Training, masks: &Masks, show: Show) -> Result<Vec<f64>, TrainError> {
    let mut sums = vec![];
    for (view, camera) in cameras.iter().enumerate() {
        let value = |pixel: usize| [f32::from(u8::from(masks.show_pixel(view, pixel))); 3];
        let values: Vec<[f32; 3]> = (0..camera.intrinsics().pixels()).map(value).collect();
        let weights = training.gather(camera, &values, show)?;
        sums.resize(weights.len(), 0.0);
        sums.iter_mut().zip(weights).for_each(|(sum, [weight, ..])| *sum += f64::from(weight));
    }
    Ok(sums)
}
