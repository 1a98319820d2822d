//! Texels of a given mesh that no training view sees become transparent.

use glam::DVec2;

use super::{masks::Masks, setup::Setup, views::Views};
use crate::{
    geometry::{self, TexelSight, TexelVisibility, Viewers},
    optimize::{TrainError, resolution::ResolutionSchedule},
    scene::{Atlas, Mesh, Texture},
};

/// Largest side of the map on which visibility is sampled by rays, texels: an unseen texel takes a ray for every view.
const LONGEST_SIDE: usize = 1024;
/// Width of the unseen border around charts that becomes transparent, texels: half of a gutter, the other half belongs
/// to the next chart.
const RIM: usize = 2;
/// Opacity logit of unseen texels: the least that maps have (`adam_texels.wgsl`).
pub(super) const TRANSPARENT: f32 = -6.0;

/// The mesh with those texels of charts and their borders made transparent that do not contribute to any pixel of the
/// training views: training would leave them as they were made. Other texels between charts stay as they are: nobody
/// sees them, and mip levels mix them with the borders of what is seen.
///
/// # Errors
/// If the training views see nothing of the mesh, or a photograph cannot be read.
pub(super) fn without_unseen(setup: &Setup, views: &Views, mesh: Mesh) -> Result<Mesh, TrainError> {
    let base = mesh.atlas().base();
    let [width, height] = [base.width() as usize, base.height() as usize];
    let halvings = (0..16).find(|n| width.max(height) >> n <= LONGEST_SIDE).unwrap_or(16);
    let sights = texel_visibility(setup, views, &mesh, [width, height].map(|side| (side >> halvings).max(1)))?;
    if !sights.texels.iter().any(|texel| matches!(texel, TexelSight::Seen(_))) {
        return Err(TrainError::UnseenMesh);
    }
    let coarsest = base.mip_levels().saturating_sub(1 + halvings);
    let reached = sights.reached(coarser(setup), coarsest as u8);
    let hidden = hidden(&sights, &reached, (RIM >> halvings).max(1));
    let [columns, rows] = sights.size;
    let mut texels = base.texels().to_vec();
    for (i, texel) in texels.chunks_exact_mut(4).enumerate() {
        let [x, y] = [i % width, i / width].map(|at| at >> halvings);
        if hidden[y.min(rows - 1) * columns + x.min(columns - 1)] {
            texel[3] = TRANSPARENT;
        }
    }
    let base = Texture::new(base.width(), base.height(), base.channels(), texels)?;
    let atlas = Atlas::new(base, mesh.atlas().bands().cloned())?;
    Ok(mesh.with_atlas(atlas))
}

/// Number of mip levels by which the smallest pictures of the run read coarser than full-size ones.
pub(super) fn coarser(setup: &Setup) -> u8 {
    let first = ResolutionSchedule { full_from: u32::from(setup.options.coarse_to_fine) };
    -first.scale(0, setup.scales.longest_side).log2().floor() as u8
}

/// Visibility, from the training views, of the texels of a map of `size` (width, height), if there is no other mesh.
pub(super) fn texel_visibility(
    setup: &Setup,
    views: &Views,
    mesh: &Mesh,
    size: [usize; 2],
) -> Result<TexelVisibility, TrainError> {
    let masks = Masks::of(&views.photos, &setup.train)?;
    let shows = |view: usize, at: DVec2| masks.show(view, at);
    let viewers = Viewers { shows: &shows, ..setup.viewers(&views.train_cameras) };
    Ok(geometry::texel_visibility(mesh, size, &setup.hierarchy(std::slice::from_ref(mesh)), &viewers)?)
}

/// Chart texels that are neither seen nor reached by filtering, and unreached texels between charts within `rim` of
/// these, with which they are filtered.
fn hidden(sights: &TexelVisibility, reached: &[bool], rim: usize) -> Vec<bool> {
    let [width, height] = sights.size;
    let mut hidden: Vec<bool> =
        (sights.texels.iter().zip(reached)).map(|(t, is_reached)| *t == TexelSight::Hidden && !is_reached).collect();
    for _ in 0..rim {
        let is_beside = |i: usize| {
            let (x, y) = (i % width, i / width);
            let rows = y.saturating_sub(1)..(y + 2).min(height);
            let columns = x.saturating_sub(1)..(x + 2).min(width);
            rows.into_iter().any(|row| columns.clone().any(|column| hidden[row * width + column]))
        };
        let free = |i: &usize| sights.texels[*i] == TexelSight::Outside && !reached[*i] && !hidden[*i];
        let added: Vec<usize> = (0..hidden.len()).filter(free).filter(|&i| is_beside(i)).collect();
        added.into_iter().for_each(|i| hidden[i] = true);
    }
    hidden
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rims_of_what_is_hidden_are_too_but_for_those_of_what_is_seen() {
        let texels: Vec<TexelSight> = (0..10 * 4)
            .map(|i| match i % 10 {
                0 | 1 => TexelSight::Hidden,
                8 | 9 => TexelSight::Seen(0),
                _ => TexelSight::Outside,
            })
            .collect();
        let sights = TexelVisibility { size: [10, 4], texels, rays: 0 };
        // This map has two mip levels above level 0.
        for (coarser, rim, last) in [(0, 2, 3), (0, 9, 6), (1, 9, 5), (3, 1, 2), (3, 9, 5)] {
            let hidden = hidden(&sights, &sights.reached(coarser, 9), rim);
            let expected: Vec<bool> = (0..10 * 4).map(|i| i % 10 <= last).collect();
            assert_eq!(hidden, expected, "{coarser} {rim}");
        }
    }
}
