//! Handover: selection of the splats that a mesh does not make superfluous.

use super::{setup::Setup, views::Views};
use crate::{
    optimize::{TrainError, arrangement::Arrangement},
    render::gpu::training::{Show, Training},
};

/// Inverse of the least fraction of splats that stay, however good the mesh is: density control can only copy existing
/// splats.
const KEEPS_ONE_OF: usize = 100;

/// Keeps those splats of the surface phase that explain the photographs better than the mesh, which takes over the
/// smooth regions, as in HERA: a splat is removed if over its footprint in all views the squared error of the mesh
/// alone is no larger than that of the splats alone. What remains is mostly fine structure, at most `most` splats, the
/// limit of the training, which gives back memory for more. Their smoothing is measured anew.
pub(super) fn hand_over(setup: &Setup, views: &Views, training: &mut Training, most: usize) -> Result<(), TrainError> {
    let mut splats = Arrangement::new(training.read_geometry()?);
    let (mut advantage, mut seen) = (vec![0.0_f64; splats.len()], vec![false; splats.len()]);
    views.compare(training, &setup.train, setup.composition().background, |training, camera, errors| {
        let gathered = training.gather(camera, errors, Show::SplatsAlone)?;
        for ((sum, seen), [mesh, splats, _, weight]) in advantage.iter_mut().zip(&mut seen).zip(gathered) {
            *sum += f64::from(mesh) - f64::from(splats);
            *seen |= weight > 0.0;
        }
        Ok(())
    })?;
    splats.retain(&kept(&advantage, &seen, most));
    training.rearrange(splats.geometry(), splats.sources())?;
    training.smooth();
    Ok(())
}

/// Which splats stay, `[N]`, by their `advantage` over the mesh and whether any view sees them: those with a positive
/// advantage, best first, at least one of [`KEEPS_ONE_OF`], and no more than `max_splats`. Unseen splats rank last:
/// density control would make nothing of them.
fn kept(advantage: &[f64], seen: &[bool], max_splats: usize) -> Vec<bool> {
    let mut ranked: Vec<usize> = (0..advantage.len()).collect();
    ranked.sort_by(|&a, &b| seen[b].cmp(&seen[a]).then(advantage[b].total_cmp(&advantage[a])));
    let better = advantage.iter().filter(|a| **a > 0.0).count();
    let count = better.max(advantage.len().div_ceil(KEEPS_ONE_OF)).min(max_splats);
    let mut keep = vec![false; advantage.len()];
    ranked.iter().take(count).for_each(|&i| keep[i] = true);
    keep
}

#[cfg(test)]
mod tests {
    #[test]
    fn what_is_better_stays_and_something_in_any_case() {
        let kept = |advantage: &[f64], most| {
            // A splat without gain or loss counts as unseen.
            let seen: Vec<bool> = advantage.iter().map(|a| *a != 0.0).collect();
            let keep = super::kept(advantage, &seen, most);
            (0..keep.len()).filter(|&i| keep[i]).collect::<Vec<_>>()
        };
        assert_eq!(kept(&[-1.0, 2.0, 0.0, 3.0, 1.0], 9), [1, 3, 4]);
        assert_eq!(kept(&[-1.0, 2.0, 0.0, 3.0, 1.0], 2), [1, 3]);
        // If the mesh is better than all splats, the best of the seen ones are kept.
        let mut worse = vec![-2.0; 150];
        (worse[7], worse[9], worse[11]) = (-0.5, 0.0, -0.25);
        assert_eq!((kept(&worse, 150), kept(&worse, 1), kept(&worse, 0)), (vec![7, 11], vec![11], vec![]));
        assert!(kept(&[], 9).is_empty());
    }
}
