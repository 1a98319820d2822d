//! What ends up showing nothing is dropped after training: splats behind an opaque mesh, and triangles that have become invisible.

use glam::DVec2;

use super::{Run, unseen::MaskBits};
use crate::{
    geometry::{self, Viewers},
    optimize::TrainError,
    render::gpu::training::{Show, Training},
    scene::{Mesh, Splats, gather},
};

/// Part of what a splat would show of itself without the mesh that it shows at most beside it.
const SHOWN: f64 = 0.02;
/// Mean opacity below which a triangle goes after training: 0.02, at most 5 of 255 steps.
const FAINT: f64 = 0.02;

impl Run<'_> {
    /// The trained splats without those that the mesh hides from all training views: by rays to them, see
    /// [`geometry::occluded_splats`], and, since these miss what is between, by their blend weights with the mesh and without it, both
    /// as far as masks leave the views.
    pub(super) fn without_occluded(
        &self,
        training: &mut Training,
        splats: Splats,
        meshes: &[Mesh],
    ) -> Result<Splats, TrainError> {
        if meshes.is_empty() {
            return Ok(splats);
        }
        let shown = self.shown()?;
        let viewers = Viewers {
            cameras: &self.train_cameras,
            near: f64::from(self.composition().near),
            layers: self.options.layers as usize,
            shows: &|view, at| shown[view].as_ref().is_none_or(|shown| shown.holds(at)),
        };
        let occluded = geometry::occluded_splats(&splats, (meshes, &self.hierarchy(meshes)), SHOWN, &viewers);
        if !occluded.contains(&true) {
            return Ok(splats);
        }
        let mut weights = |show| self.blend_weights(training, &shown, show);
        let (beside, alone) = (weights(Show::All)?, weights(Show::SplatsAlone)?);
        let is_seen = |i: &usize| !occluded[*i] || beside[*i] > SHOWN * alone[*i];
        let seen: Vec<usize> = (0..occluded.len()).filter(is_seen).collect();
        Ok(gather(splats, &seen))
    }

    /// The trained mesh without the triangles that show next to nothing and hide nothing of it, see
    /// [`geometry::faint_triangles`]. The maps stay as they are. `None` if nothing is left.
    pub(super) fn without_faint(&self, mesh: Mesh) -> Option<Mesh> {
        let near = f64::from(self.composition().near);
        let faint = geometry::faint_triangles(&mesh, FAINT, &self.train_cameras, near);
        let keep: Vec<bool> = faint.iter().map(|faint| !faint).collect();
        if keep.contains(&false) { mesh.with_triangles(&keep) } else { Some(mesh) }
    }

    /// Σ of the blend weights of every splat `[N]` over all pixels that the training views show.
    fn blend_weights(
        &self,
        training: &mut Training,
        shown: &[Option<MaskBits>],
        show: Show,
    ) -> Result<Vec<f64>, TrainError> {
        let mut sums = vec![];
        for (camera, shown) in self.train_cameras.iter().zip(shown) {
            let (width, height) = (camera.intrinsics().width as usize, camera.intrinsics().height as usize);
            let is_shown = |p: usize| {
                let at = DVec2::new((p % width) as f64, (p / width) as f64) + 0.5;
                shown.as_ref().is_none_or(|shown| shown.holds(at))
            };
            let values: Vec<[f32; 3]> = (0..width * height).map(|p| [f32::from(u8::from(is_shown(p))); 3]).collect();
            let weights = training.gather(camera, &values, show)?;
            sums.resize(weights.len(), 0.0);
            sums.iter_mut().zip(weights).for_each(|(sum, [weight, ..])| *sum += f64::from(weight));
        }
        Ok(sums)
    }
}
