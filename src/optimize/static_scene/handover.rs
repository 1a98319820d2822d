//! Back from a mesh to the splats that it does not make superfluous.

use super::{Run, arrangement};
use crate::{
    optimize::TrainError,
    render::gpu::training::{Show, Training},
};

/// Splats of which one stays at least, however good the mesh is: density control can copy what there is, and nothing else.
const KEEPS_ONE_OF: usize = 100;

impl<'a> Run<'a> {
    /// Keeps those splats of the surface phase that explain the photographs better than the mesh does, which has the smooth
    /// regions, as in HERA: a splat goes if the mesh alone has no larger squared error than the splats
    /// alone over its footprint in all views. What remains is mostly fine structure, at most `max_splats` of them.
    /// How far views tell what remains is measured anew.
    pub(super) fn hand_over(&self, training: &mut Training<'a>, max_splats: usize) -> Result<(), TrainError> {
        let mut splats = arrangement(training)?;
        let (mut advantage, mut seen) = (vec![0.0_f64; splats.len()], vec![false; splats.len()]);
        self.compare(training, &self.train, |training, camera, errors| {
            let gathered = training.gather(camera, errors, Show::SplatsAlone)?;
            for ((sum, seen), [mesh, splats, _, weight]) in advantage.iter_mut().zip(&mut seen).zip(gathered) {
                *sum += f64::from(mesh) - f64::from(splats);
                *seen |= weight > 0.0;
            }
            Ok(())
        })?;
        let mut ranked: Vec<usize> = (0..splats.len()).collect();
        ranked.sort_by(|&a, &b| seen[b].cmp(&seen[a]).then(advantage[b].total_cmp(&advantage[a])));
        let better = advantage.iter().filter(|a| **a > 0.0).count();
        let count = better.max(splats.len().div_ceil(KEEPS_ONE_OF)).min(max_splats);
        let mut keep = vec![false; splats.len()];
        ranked.iter().take(count).for_each(|&i| keep[i] = true);
        splats.retain(&keep);
        training.rearrange(splats.geometry(), splats.sources())?;
        training.smooth();
        Ok(())
    }
}
