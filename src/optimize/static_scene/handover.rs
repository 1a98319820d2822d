//! Back from a mesh to the splats that it does not make superfluous.

use super::{Run, arrangement};
use crate::{optimize::TrainError, render::gpu::training::Training};

impl<'a> Run<'a> {
    /// Keeps those splats of the surface phase that explain the photographs better than the mesh does, which has the smooth
    /// regions, as in HERA: a splat goes if the mesh alone has no larger squared error than the splats
    /// alone over its footprint in all views. What remains is mostly fine structure, at most `max_splats` of them.
    /// How far views tell what remains is measured anew.
    pub(super) fn hand_over(&self, training: &mut Training<'a>, max_splats: usize) -> Result<(), TrainError> {
        let mut splats = arrangement(training)?;
        let mut advantage = vec![0.0_f64; splats.len()];
        self.compare(training, &self.train, |_, splats_only, camera, errors| {
            for (sum, [mesh, splats, ..]) in advantage.iter_mut().zip(splats_only.gather(camera, errors)?) {
                *sum += f64::from(mesh) - f64::from(splats);
            }
            Ok(())
        })?;
        let mut ranked = advantage.clone();
        ranked.sort_by(|a, b| b.total_cmp(a));
        let least = ranked.get(max_splats).copied().unwrap_or(0.0).max(0.0);
        let keep: Vec<bool> = advantage.iter().map(|&a| a > least).collect();
        splats.retain(&keep);
        training.rearrange(splats.geometry(), splats.sources())?;
        training.smooth();
        Ok(())
    }
}
