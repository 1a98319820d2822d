//! INRIA's adaptive density control: clone or split where the screen-space gradient is large, prune what is transparent
//! or huge (Kerbl et al. 2023, sec. 5.2); and the variant of AbsGS (Ye et al. 2024), which splits where per-pixel
//! gradients are large even if they cancel, as for a large splat over fine texture.

use glam::Vec3;

use super::Statistics;
use crate::optimize::{
    arrangement::Arrangement,
    random::{self, Purpose},
};

/// Divisor of a child's scale: 0.8 × the number of children.
const SPLIT_SHRINKAGE: f32 = 1.6;
/// Farthest offset of a child, in σ of the parent: offsets are drawn from the parent's own Gaussian, within the part of
/// it that is rendered (about 3.3 σ).
const SPLIT_REACH: f32 = 3.0;

/// Thresholds of the strategy.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(in crate::optimize) struct InriaOptions {
    /// [`capture::extent`](crate::capture::extent) of the scene, world units.
    pub(in crate::optimize) extent: f32,
    /// Mean gradient from which a splat is cloned or split, normalised device coordinates: 2e-4.
    pub(in crate::optimize) gradient_threshold: f32,
    /// Mean absolute gradient from which a splat is split, where that criterion is used: 4e-4 (AbsGS).
    pub(in crate::optimize) split_gradient: Option<f32>,
    /// Largest scale that is cloned rather than split, in extents: 0.01 (AbsGS: 0.001).
    pub(in crate::optimize) dense_fraction: f32,
    /// Opacity below which splats are pruned: 0.005.
    pub(in crate::optimize) min_opacity: f32,
    /// Scale, in extents, above which splats are pruned, if set: 0.1 once opacities have been reset; before that a
    /// large splat may still be the best explanation of a background.
    pub(in crate::optimize) max_scale: Option<f32>,
    /// Largest number of splats. Those with the largest gradients, relative to their thresholds, grow first.
    pub(in crate::optimize) max_splats: usize,
}

impl InriaOptions {
    /// INRIA's constants, without pruning by scale.
    pub(in crate::optimize) fn new(extent: f32, max_splats: usize) -> Self {
        Self {
            extent,
            gradient_threshold: 2e-4,
            split_gradient: None,
            dense_fraction: 0.01,
            min_opacity: 0.005,
            max_scale: None,
            max_splats,
        }
    }

    /// The constants of AbsGS, without pruning by scale.
    pub(in crate::optimize) fn absolute(extent: f32, max_splats: usize) -> Self {
        Self { split_gradient: Some(4e-4), dense_fraction: 0.001, ..Self::new(extent, max_splats) }
    }

    /// The same options with pruning by scale.
    pub(in crate::optimize) fn pruning_large(self) -> Self {
        Self { max_scale: Some(0.1), ..self }
    }
}

#[derive(Clone, Copy, PartialEq)]
enum Fate {
    Keep,
    Prune,
    Clone,
    Split,
}

/// One density step. Afterwards the survivors come first in their old order, then clones, then children of splits.
///
/// Growth and pruning are decided together, on the splats as they come in: the outcome equals growing first and pruning
/// everything afterwards, except that splats about to be pruned do not count against `max_splats`.
///
/// # Panics
/// If there is not one row of statistics per splat.
pub(in crate::optimize) fn densify(
    splats: &mut Arrangement,
    statistics: Statistics<'_>,
    options: &InriaOptions,
    iteration: u32,
    seed: u64,
) {
    let n = splats.len();
    assert_eq!(statistics.0.len(), n, "one row of statistics per splat");
    let max_scale = options.max_scale.map_or(f32::INFINITY, |m| m * options.extent);
    let is_pruned = |i: usize| splats.opacity(i) < options.min_opacity || splats.scales(i).max_element() > max_scale;
    // The gradient that decides, divided by its threshold.
    let urge = |i: usize, is_small: bool| match options.split_gradient {
        Some(threshold) if !is_small => statistics.absolute_gradient(i) / threshold,
        _ => statistics.mean_gradient(i) / options.gradient_threshold,
    };
    let wants_to_grow = |i: usize| -> Option<Fate> {
        let scale = splats.scales(i).max_element();
        let is_small = scale <= options.dense_fraction * options.extent;
        if splats.opacity(i) < options.min_opacity || urge(i, is_small) < 1.0 {
            None
        } else if is_small {
            Some(Fate::Clone)
        } else {
            // Splitting may shrink a splat below the size at which it is pruned.
            (scale / SPLIT_SHRINKAGE <= max_scale).then_some(Fate::Split)
        }
    };

    let mut fates: Vec<Fate> =
        (0..n).map(|i| wants_to_grow(i).unwrap_or(if is_pruned(i) { Fate::Prune } else { Fate::Keep })).collect();
    let pruned = fates.iter().filter(|&&f| f == Fate::Prune).count();
    let mut growing: Vec<usize> = (0..n).filter(|&i| matches!(fates[i], Fate::Clone | Fate::Split)).collect();
    // Cloning and splitting both add one splat.
    let room = options.max_splats.saturating_sub(n - pruned);
    if growing.len() > room {
        let urge = |i: usize| urge(i, fates[i] == Fate::Clone);
        growing.sort_by(|&a, &b| urge(b).total_cmp(&urge(a)).then(a.cmp(&b)));
        for &i in &growing[room..] {
            fates[i] = if is_pruned(i) { Fate::Prune } else { Fate::Keep };
        }
    }

    let mut rng = random::generator(seed, Purpose::Density, iteration);
    for i in (0..n).filter(|&i| fates[i] == Fate::Clone) {
        splats.push_copy(i);
    }
    for i in (0..n).filter(|&i| fates[i] == Fate::Split) {
        for _ in 0..2 {
            splats.push_copy(i);
            let offset = random::normal3(&mut rng).clamp_length_max(SPLIT_REACH);
            move_child(splats, splats.len() - 1, offset);
        }
    }
    let mut keep: Vec<bool> = fates.iter().map(|f| matches!(f, Fate::Keep | Fate::Clone)).collect();
    keep.resize(splats.len(), true);
    splats.retain(&keep);
}

/// Shrinks a copy and moves it by `offset`, in standard deviations along the parent's axes.
fn move_child(splats: &mut Arrangement, child: usize, offset: Vec3) {
    splats.move_by(child, offset * splats.scales(child));
    splats.scale_by(child, -SPLIT_SHRINKAGE.ln());
}

#[cfg(test)]
mod tests {
    use glam::Quat;

    use super::*;
    use crate::{
        optimize::density::tests::{arrangement, rearranged, state},
        render::gpu::{rows::Source, state::Geometry},
    };

    const HOT: [f32; 4] = [4e-4, 2.0, 1.0, 1.0]; // a mean gradient of exactly the threshold
    const COLD: [f32; 4] = [3.9e-4, 2.0, 1.0, 1.0];

    fn set_scale(s: &mut Arrangement, i: usize, scale: [f32; 3]) {
        s.edit(i, |g| g.log_scale = Vec3::from(scale).ln());
    }

    /// Of the first `before` splats: how many were cloned, how many were split into two smaller ones, and how many were
    /// removed.
    fn fates(before: usize, splats: &Arrangement) -> [usize; 3] {
        let sources = splats.sources().iter().copied();
        let (kept, new): (Vec<Source>, Vec<Source>) =
            sources.partition(|source| *source == Source::new(source.splat()));
        let cloned = new.iter().filter(|source| kept.contains(&Source::new(source.splat()))).count();
        let split = (new.len() - cloned) / 2;
        [cloned, split, before - kept.len() - split]
    }

    #[test]
    fn clones_small_and_splits_large_splats_with_large_gradients() {
        let mut s = arrangement(6);
        for i in [1, 3] {
            set_scale(&mut s, i, [0.001, 0.011, 0.002]); // largest just above 0.01 extents
        }
        s.set_opacity(5, 0.004);
        let before = s.clone();
        densify(&mut s, Statistics(&[HOT, HOT, COLD, COLD, HOT, HOT]), &InriaOptions::new(1.001, 1000), 600, 7);
        assert_eq!(fates(6, &s), [2, 1, 1]);
        // Splats 0, 2, 3 and 4 survive; clones of 0 and 4; two children of 1.
        assert_eq!(s.len(), 8);
        let moments = rearranged(&state(6, 1), &s).geometry_m;
        for (now, then) in [(0, 0), (1, 2), (2, 3), (3, 4), (4, 0), (5, 4)] {
            assert_eq!(s.row(now), before.row(then));
            assert_eq!(moments[12 * now] == 0.0, now >= 4, "only clones start without moments");
        }
        for child in [6, 7] {
            let (child, parent) = (s.row(child), before.row(1));
            let inherited = |g: Geometry| (g.opacity_logit, g.rotation);
            assert_eq!(inherited(child), inherited(parent), "opacity and rotation are the parent's");
            let ratio = (parent.log_scale - child.log_scale).exp();
            assert!((ratio - 1.6).abs().max_element() < 1e-5, "{ratio}");
            assert_ne!(child.mean, parent.mean);
        }
        assert_ne!(s.row(6).mean, s.row(7).mean);
    }

    #[test]
    fn pulls_that_cancel_split_large_splats_only() {
        let mut s = arrangement(4);
        for i in [0, 1] {
            set_scale(&mut s, i, [0.0009; 3]);
        }
        // Two views; a mean gradient of 2e-4 or zero, an absolute gradient of 4e-4 or less.
        let (mean, absolute) = ([4e-4, 2.0, 1.0, 0.0], [0.0, 2.0, 1.0, 8e-4]);
        let rows = [mean, absolute, absolute, mean];
        densify(&mut s, Statistics(&rows), &InriaOptions::absolute(1.0, 100), 600, 7);
        assert_eq!(fates(4, &s), [1, 1, 0]);
        // With room for one, the splat with the stronger gradient, which is split.
        let mut s = arrangement(2);
        set_scale(&mut s, 0, [0.0009; 3]);
        let rows = [[6e-4, 2.0, 1.0, 0.0], [0.0, 2.0, 1.0, 16e-4]];
        densify(&mut s, Statistics(&rows), &InriaOptions::absolute(1.0, 3), 600, 7);
        assert_eq!(fates(2, &s), [0, 1, 0]);
    }

    #[test]
    fn children_follow_the_shape_of_their_parent() {
        let n = 2000;
        let mut s = arrangement(n);
        let scale = Vec3::new(0.3, 0.02, 0.1);
        for i in 0..n {
            set_scale(&mut s, i, scale.into());
        }
        let before = s.clone();
        densify(&mut s, Statistics(&vec![HOT; n]), &InriaOptions::new(1.0, 10 * n), 600, 7);
        assert_eq!(s.len(), 2 * n);
        let rotation = Quat::from_xyzw(0.0, 0.6, 0.0, 0.8);
        let mut squares = Vec3::ZERO;
        for child in 0..2 * n {
            let offset = s.row(child).mean - before.row(child / 2).mean;
            let sigmas = rotation.inverse() * offset / scale;
            // f32 resolves 1e-4 of a unit at coordinates of up to 2000.
            assert!(sigmas.length() <= 3.0 + 2e-4 / 0.02, "{sigmas}");
            squares += sigmas * sigmas;
        }
        // Unit variance, less the 2 % that the limit of 3 σ removes, ± 5 standard errors.
        let variance = squares / (2 * n) as f32;
        assert!((variance - 0.98).abs().max_element() < 0.12, "{variance}");
    }

    #[test]
    fn prunes_transparent_and_huge_splats_but_splits_what_fits_afterwards() {
        let mut s = arrangement(5);
        s.set_opacity(0, 0.0049);
        s.set_opacity(1, 0.0051);
        set_scale(&mut s, 2, [0.101, 0.01, 0.01]);
        set_scale(&mut s, 3, [0.15, 0.01, 0.01]); // its children have a scale of 0.094
        set_scale(&mut s, 4, [0.17, 0.01, 0.01]); // its children would have a scale of 0.106
        let rows = [COLD, COLD, COLD, HOT, HOT];
        let options = InriaOptions::new(1.0, 100).pruning_large();
        let mut early = s.clone();
        densify(&mut s, Statistics(&rows), &options, 4000, 7);
        assert_eq!((fates(5, &s), s.len()), ([0, 1, 3], 3));
        densify(&mut early, Statistics(&rows), &InriaOptions { max_scale: None, ..options }, 600, 7);
        assert_eq!(fates(5, &early), [0, 2, 1]);
    }

    #[test]
    fn the_cap_favours_large_gradients() {
        let n = 100;
        let mut s = arrangement(n);
        for i in (0..n).step_by(2) {
            set_scale(&mut s, i, [0.5; 3]);
        }
        s.set_opacity(99, 0.001);
        let rows: Vec<_> = (0..n).map(|i| [1e-3 * (1 + i) as f32, 1.0, 1.0, 1.0]).collect();
        densify(&mut s, Statistics(&rows), &InriaOptions::new(1.0, 109), 600, 7);
        assert_eq!((fates(n, &s), s.len()), ([5, 5, 1], 109));
        // 89 to 98 grow: odd ones have a clone, even ones are gone for their children.
        let near = |x: f32| (0..s.len()).filter(|&i| (s.row(i).mean.x - x).abs() < 1e-6).count();
        assert_eq!([86.0, 87.0, 88.0, 89.0, 90.0, 97.0, 98.0].map(near), [1, 1, 1, 2, 0, 2, 0]);
        // Already above the cap, so nothing grows.
        let before = s.clone();
        densify(&mut s, Statistics(&[HOT; 109]), &InriaOptions::new(1.0, 50), 700, 7);
        assert_eq!(s, before);
    }

    #[test]
    fn equal_input_gives_equal_output() {
        let run = |seed, iteration| {
            let mut s = arrangement(50);
            (0..50).for_each(|i| set_scale(&mut s, i, [0.1, 0.2, 0.3]));
            densify(&mut s, Statistics(&[HOT; 50]), &InriaOptions::new(1.0, 1000), iteration, seed);
            assert_eq!(s.first_non_finite(), None);
            s
        };
        assert_eq!(run(1, 600), run(1, 600));
        assert_ne!(run(1, 600), run(1, 700));
        assert_ne!(run(1, 600), run(2, 600));
    }

    #[test]
    fn nothing_to_do() {
        let mut s = Arrangement::default();
        densify(&mut s, Statistics(&[]), &InriaOptions::new(1.0, 10), 600, 7);
        assert_eq!(s.len(), 0);
    }
}
