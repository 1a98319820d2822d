//! 3DGS-MCMC's density control (Kheradmand et al. 2024): dead splats are relocated onto living ones, and a few are
//! added each time, such that the picture hardly changes. Unlike in the paper, copies are set apart, and in hybrids
//! splats that a mesh hides count as dead.

use glam::Vec3;
use rand::RngExt;
use rand_pcg::Pcg64;
use rayon::prelude::*;

use super::Statistics;
use crate::optimize::{
    arrangement::Arrangement,
    random::{self, Purpose},
};

/// Largest number of copies, itself included, that one splat becomes in a step.
const MAX_COPIES: usize = 51;
/// Largest growth factor of the number of splats per step.
const MOST_GROWTH: f64 = 2.0;
/// Fraction of a splat's smoothed variance along its longest axis that becomes the spread of its copies: two are 1.2
/// standard deviations apart and four fifths as long.
const SPREAD: f32 = 0.36;
/// Upper bound on that spread as a fraction of the splat's own variance: splats smaller than pixels are not shrunk to
/// nothing.
const MOST_SPREAD: f32 = 0.75;
/// Largest opacity of copies, unless their source exceeds it: the most that a pixel shows.
const MOST_OPAQUE: f32 = 0.99;

/// Weight of the mean opacity in the loss.
pub(in crate::optimize) const OPACITY_WEIGHT: f32 = 0.01;

/// Weight of the mean scale in the loss: 0.01 where `unit`, the capture's unit of length, is 1.
pub(in crate::optimize) fn scale_weight(unit: f32) -> f32 {
    0.01 / unit
}

/// Noise on the means per step, relative to their learning rate: 5e5 where `unit` is 1 and rates are those of a full
/// run. It multiplies a splat's covariance, a squared length, hence the division by the squared unit; the division by
/// `haste`, the factor on the rates of short runs, keeps the noise the same in runs of any length.
pub(in crate::optimize) fn noise(unit: f32, haste: f32) -> f32 {
    5e5 / (unit.powi(2) * haste)
}

/// Thresholds of the strategy.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(in crate::optimize) struct McmcOptions {
    /// Opacity, as rendered (smoothed), up to which splats are dead; also the least unsmoothed opacity of copies:
    /// 0.005.
    pub(in crate::optimize) min_opacity: f32,
    /// Growth factor of the number of splats per step: 1.05, or more in runs with few steps, see [`Self::arriving_in`].
    pub(in crate::optimize) growth: f64,
    /// Number of splats to grow to.
    pub(in crate::optimize) max_splats: usize,
    /// Blend weight summed over an epoch below which splats are dead too, and get no copies, if set: 1e-3 for scenes
    /// with a mesh. Behind an opaque mesh a splat keeps its opacity, but shows nothing.
    pub(in crate::optimize) min_epoch_weight: Option<f32>,
    /// Number of epochs that an epoch weight is summed over: 1, or enough that dropout has not left any splat out of
    /// all renders of a view.
    pub(in crate::optimize) epochs: u32,
}

impl McmcOptions {
    /// The paper's constants; for scenes with a mesh also the criterion on blend weights, which is not in the paper.
    pub(in crate::optimize) fn new(max_splats: usize, has_mesh: bool) -> Self {
        Self { min_opacity: 0.005, growth: 1.05, max_splats, min_epoch_weight: has_mesh.then_some(1e-3), epochs: 1 }
    }

    /// The same options where iterations drop out this part of the splats at random: with enough epochs that at most
    /// one splat in a thousand is left out of all renders of a view.
    pub(in crate::optimize) fn with_dropout(self, part: f32) -> Self {
        let epochs = if part > 0.0 { (1e-3_f32.ln() / part.ln()).ceil().max(1.0) as u32 } else { 1 };
        Self { epochs, ..self }
    }

    /// The same options with growth fast enough for `splats` to become [`Self::max_splats`] within this many steps, the
    /// present one included; at most doubling per step. The usual 5 % over 24 steps, as in 800 iterations, only triples
    /// the number, and of two runs asked for one size, the one that began with more splats would end with more.
    pub(in crate::optimize) fn arriving_in(self, steps: u32, splats: usize) -> Self {
        let needed = (self.max_splats as f64 / splats.max(1) as f64).powf(1.0 / f64::from(steps.max(1)));
        Self { growth: self.growth.max(needed.min(MOST_GROWTH)), ..self }
    }
}

/// Blend weight of every splat, summed until each training view has certainly been rendered [`McmcOptions::epochs`]
/// times. Part of a checkpoint.
///
/// A density interval is usually shorter than an epoch, and a splat that none of its views shows is not yet useless.
/// Each block of n iterations, n the number of views, has all views in some order, so any 2n − 1 iterations contain a
/// whole block.
#[derive(Clone, Debug, Default, PartialEq)]
pub(in crate::optimize) struct EpochWeight {
    /// Sums so far, `[N]`.
    pub(in crate::optimize) weight: Vec<f32>,
    /// Iterations summed so far.
    pub(in crate::optimize) iterations: u32,
}

impl EpochWeight {
    /// Adds the statistics of a number of iterations.
    pub(in crate::optimize) fn add(&mut self, statistics: Statistics<'_>, iterations: u32) {
        self.weight.resize(statistics.0.len(), 0.0);
        self.weight.iter_mut().zip(statistics.0).for_each(|(sum, s)| *sum += s[2]);
        self.iterations = self.iterations.saturating_add(iterations);
    }
}

/// One density step. Afterwards all splats are at their old index, followed by those added; a relocated splat takes
/// over the whole row of its source.
///
/// `epoch`, to which the statistics since the last step have been added, is evaluated and restarted once it covers all
/// `views`.
///
/// The paper clears the moments of sources only; this also clears those of relocated splats, which describe another
/// place.
///
/// # Panics
/// If there is not one epoch weight per splat.
pub(in crate::optimize) fn relocate_and_add(
    splats: &mut Arrangement,
    epoch: &mut EpochWeight,
    views: u32,
    options: &McmcOptions,
    iteration: u32,
    seed: u64,
) {
    let n = splats.len();
    assert_eq!(epoch.weight.len(), n, "one epoch weight per splat");
    // Any (k + 1)·n − 1 iterations contain k whole epochs.
    let epoch_ends = epoch.iterations >= views.saturating_mul(options.epochs.saturating_add(1)).saturating_sub(1);
    let min_weight = options.min_epoch_weight.filter(|_| epoch_ends).unwrap_or(0.0);
    let opacities: Vec<f32> = (0..n).into_par_iter().map(|i| splats.seen_opacity(i)).collect();
    let dead: Vec<usize> =
        (0..n).filter(|&i| opacities[i] <= options.min_opacity || epoch.weight[i] < min_weight).collect();
    // Sampled by opacity, as in the paper. By blend weight, splats as large as a background would get nearly all
    // copies.
    let scores_of = |least_weight: f32| -> Vec<f64> {
        let gets_copies = |&i: &usize| epoch.weight[i] >= least_weight;
        let mut scores = vec![0.0; n];
        (0..n).filter(gets_copies).for_each(|i| scores[i] = f64::from(opacities[i]));
        dead.iter().for_each(|&i| scores[i] = 0.0);
        scores
    };
    let mut scores = scores_of(options.min_epoch_weight.unwrap_or(0.0));
    if scores.iter().sum::<f64>() <= 0.0 {
        // No view saw a living splat.
        scores = scores_of(0.0);
    }

    let mut rng = random::generator(seed, Purpose::Density, iteration);
    let sources = sample(&scores, dead.len(), &mut rng);
    share(splats, &mut scores, &sources, options.min_opacity);
    for (&to, &from) in dead.iter().zip(&sources) {
        splats.copy_over(from, to);
        scores[to] = scores[from];
        epoch.weight[to] = epoch.weight[from];
    }
    set_apart(splats, sources.iter().copied().zip(dead.iter().copied()));

    // Small sets grow too, by at least one.
    let grown = ((n as f64 * options.growth).round() as usize).max(n + usize::from(options.growth > 1.0));
    let target = grown.min(options.max_splats);
    let added = sample(&scores, target.saturating_sub(n), &mut rng);
    share(splats, &mut scores, &added, options.min_opacity);
    for &from in &added {
        splats.push_copy(from);
        epoch.weight.push(epoch.weight[from]);
    }
    set_apart(splats, added.iter().copied().zip(n..));
    if epoch_ends {
        epoch.weight.fill(0.0);
        epoch.iterations = 0;
    }
}

/// Opacity and scale factor for each of `copies` coincident splats that together look like one of `opacity` (eq. 9 of
/// the MCMC paper): equally opaque at the centre, and with the same integral along a line through it.
pub(in crate::optimize) fn relocation(opacity: f64, copies: usize) -> (f64, f64) {
    let copies = copies.clamp(1, MAX_COPIES);
    // 1 − (1 − o)^(1/N), accurate also for tiny o.
    let each = -((-opacity).ln_1p() / copies as f64).exp_m1();
    let mut denominator = 0.0;
    for i in 0..copies {
        let mut term = each; // C(i, k)·(−1)ᵏ·oᵏ⁺¹
        for k in 0..=i {
            denominator += term / ((k + 1) as f64).sqrt();
            term *= -each * (i - k) as f64 / (k + 1) as f64;
        }
    }
    let scale = opacity / denominator;
    if scale.is_finite() { (each, scale) } else { (each, 1.0) }
}

/// `count` indices drawn with probabilities proportional to `scores`, none more often than makes [`MAX_COPIES`] of it;
/// fewer if all indices have reached that, none if all scores are 0.
fn sample(scores: &[f64], count: usize, rng: &mut Pcg64) -> Vec<usize> {
    let (mut drawn, mut times, mut scores) = (Vec::with_capacity(count), vec![0; scores.len()], scores.to_vec());
    while drawn.len() < count {
        let more = sample_with_repetition(&scores, count - drawn.len(), rng);
        if more.is_empty() {
            break;
        }
        for i in more {
            // With more copies their combined appearance would change.
            if times[i] < MAX_COPIES - 1 {
                times[i] += 1;
                drawn.push(i);
            } else {
                scores[i] = 0.0;
            }
        }
    }
    drawn
}

/// `count` indices with probabilities proportional to `scores`, or none if all of those are 0.
fn sample_with_repetition(scores: &[f64], count: usize, rng: &mut Pcg64) -> Vec<usize> {
    let mut total = 0.0;
    let cumulative: Vec<f64> = scores
        .iter()
        .map(|s| {
            total += if s.is_finite() { s.max(0.0) } else { 0.0 };
            total
        })
        .collect();
    let Some(last) = scores.iter().rposition(|&s| s > 0.0).filter(|_| total > 0.0) else { return vec![] };
    let drawn: Vec<f64> = (0..count).map(|_| rng.random::<f64>() * total).collect();
    // The product may round up to the total itself.
    drawn.into_par_iter().map(|x| cumulative.partition_point(|&c| c <= x).min(last)).collect()
}

/// Gives every sampled splat the opacity and scale that it will share with its copies, and clears its moments.
fn share(splats: &mut Arrangement, scores: &mut [f64], sources: &[usize], min_opacity: f32) {
    let mut sorted = sources.to_vec();
    sorted.sort_unstable();
    for group in sorted.chunk_by(|a, b| a == b) {
        let i = group[0];
        let copies = group.len() + 1;
        let (opacity, factor) = relocation(f64::from(splats.opacity(i)), copies);
        let opacity = (opacity as f32).clamp(min_opacity, 1.0 - f32::EPSILON);
        splats.clear_moments(i);
        splats.set_opacity(i, opacity);
        splats.scale_by(i, factor.ln() as f32);
        scores[i] = f64::from(splats.seen_opacity(i));
    }
}

/// Moves sources and their copies, as pairs (source, copy), apart along the longest axis, and shrinks that axis to
/// match: splats of equal weight keep their common mean and covariance.
///
/// In the paper copies stay at their source until noise separates them, but noise moves next to nothing that is more
/// opaque than 0.05. Pixels send coincident copies nearly the same gradients, from which Adam makes steps of one
/// length: they would remain copies.
fn set_apart(splats: &mut Arrangement, copies: impl Iterator<Item = (usize, usize)>) {
    let mut copies: Vec<(usize, usize)> = copies.collect();
    copies.sort_unstable();
    for group in copies.chunk_by(|a, b| a.0 == b.0) {
        let source = group[0].0;
        let (scales, opacity, smoothing) =
            (splats.scales(source), splats.opacity(source), splats.row(source).smoothing);
        let longest = scales.max_position();
        let scale = scales[longest];
        // Relative to the variance along the longest axis.
        let spread = (SPREAD * (1.0 + (smoothing / scale).powi(2))).min(MOST_SPREAD);
        let shrinkage = (1.0 - spread).sqrt();
        // The variance of n numbers spaced 1 apart is (n² − 1)/12.
        let n = group.len() as f32 + 1.0;
        let step = Vec3::AXES[longest] * scale * (12.0 * spread / (n * n - 1.0)).sqrt();
        // Keeps the integral of opacity along a line through all of them.
        let opacity = (opacity / shrinkage).min(opacity.max(MOST_OPAQUE));
        for (k, i) in std::iter::once(source).chain(group.iter().map(|pair| pair.1)).enumerate() {
            splats.move_by(i, step * (k as f32 - (n - 1.0) / 2.0));
            splats.edit(i, |g| g.log_scale[longest] += shrinkage.ln());
            splats.set_opacity(i, opacity);
        }
    }
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;
    use crate::{
        optimize::density::tests::{arrangement, rearranged, state},
        render::gpu::state::{Geometry, logit, sigmoid},
    };

    const SEEN: [f32; 4] = [0.0, 2.0, 4.0, 1.0];

    fn run(s: &mut Arrangement, rows: &[[f32; 4]], options: &McmcOptions, seed: u64) -> EpochWeight {
        let mut epoch = EpochWeight::default();
        epoch.add(Statistics(rows), 100);
        relocate_and_add(s, &mut epoch, 50, options, 600, seed);
        assert_eq!(s.first_non_finite(), None);
        epoch
    }

    /// Of the first `before` splats, how many are now copies of others; and how many splats were added.
    fn relocated_and_added(before: usize, s: &Arrangement) -> (usize, usize) {
        let relocated = s.sources()[..before].iter().enumerate().filter(|(i, source)| source.splat() != *i).count();
        (relocated, s.len() - before)
    }

    /// However large its share of the total score.
    #[test]
    fn no_splat_becomes_more_than_51() {
        let mut scores = vec![1.0; 1000];
        scores[3] = 1e9;
        let mut rng = random::generator(1, Purpose::Density, 600);
        let drawn = sample(&scores, 400, &mut rng);
        assert_eq!((drawn.len(), drawn.iter().filter(|i| **i == 3).count()), (400, MAX_COPIES - 1));
        // The limit also holds for all splats together.
        assert_eq!(sample(&[1.0, 0.0, 2.0], 1000, &mut rng).len(), 2 * (MAX_COPIES - 1));
        assert!(sample(&[0.0; 3], 10, &mut rng).is_empty());
    }

    #[test]
    fn relocation_has_the_golden_values() {
        for (o, copies, each, scale) in
            [(0.9, 2, 0.683_772_234, 0.867_937_851), (0.5, 3, 0.206_299_474, 0.936_881_752), (0.3, 1, 0.3, 1.0)]
        {
            let (o, s) = relocation(o, copies);
            // The golden values have nine digits.
            assert!((o - each).abs() < 1e-9 && (s - scale).abs() < 1e-9, "{o} {s}");
        }
    }

    #[test]
    fn copies_blend_to_what_their_source_was_along_a_line() {
        for (opacity, copies) in [(0.9_f64, 2), (0.5, 3), (0.99, 20), (0.1, 51)] {
            let (each, scale) = relocation(opacity, copies);
            // ∫ 1 − (1 − o′·G(x))ᴺ dx by the trapezoid rule, which is exact up to rounding for such functions.
            let step = 0.01;
            let integral: f64 = (-1000..=1000)
                .map(|i| f64::from(i) * step / scale)
                .map(|x| step * (1.0 - (1.0 - each * (-0.5 * x * x).exp()).powi(copies as i32)))
                .sum();
            let source = opacity * std::f64::consts::TAU.sqrt();
            assert!((integral - source).abs() < 1e-9, "{opacity} {copies}: {integral} against {source}");
        }
    }

    #[test]
    fn relocation_stays_finite_at_the_limits() {
        for o in [0.0, 1e-30, 0.005, 0.5, 1.0 - f64::from(f32::EPSILON), 1.0] {
            for copies in [0, 1, 2, 25, 51, 10_000] {
                let (each, scale) = relocation(o, copies);
                assert!((0.0..=o * (1.0 + 1e-15)).contains(&each), "{o} {copies}: {each}");
                assert!(scale > 0.0 && scale.is_finite(), "{o} {copies}: {scale}");
            }
        }
    }

    #[test]
    fn the_dead_move_and_together_the_copies_have_the_place_and_shape_of_their_source() {
        let n = 10;
        let mut s = arrangement(n);
        for i in 0..n {
            s.set_opacity(i, if i == 4 { 0.9 } else { 0.004 });
        }
        let before = s.clone();
        run(&mut s, &[SEEN; 10], &McmcOptions::new(n, false), 1);
        assert_eq!(relocated_and_added(n, &s), (9, 0));
        let (opacity, factor) = relocation(0.9, 10);
        let mean = |s: &Arrangement, i: usize| s.row(i).mean.as_dvec3();
        let center = (0..n).map(|i| mean(&s, i)).sum::<DVec3>() / n as f64;
        assert!(center.distance(mean(&before, 4)) < 1e-6);
        // Axes of the quaternion 0.8 + 0.6 j.
        let axes = [DVec3::new(0.28, 0.0, -0.96), DVec3::Y, DVec3::new(0.96, 0.0, 0.28)];
        for (k, axis) in axes.into_iter().enumerate() {
            let apart = (0..n).map(|i| (mean(&s, i) - center).dot(axis).powi(2)).sum::<f64>() / n as f64;
            let whole = (0.01 * factor).powi(2);
            assert!((apart / whole - [0.36, 0.0, 0.0][k]).abs() < 1e-3, "{k}: {apart}");
            let own = f64::from(s.scales(9)[k]).powi(2);
            assert!(((own + apart) / whole - 1.0).abs() < 1e-3, "{k}: {own}");
        }
        for i in 0..n {
            assert_eq!(Geometry { mean: Vec3::ZERO, ..s.row(i) }, Geometry { mean: Vec3::ZERO, ..s.row(0) });
            assert!((f64::from(s.opacity(i)) - opacity / 0.8).abs() < 1e-6);
        }
        let all = state(n, 1);
        let after = rearranged(&all, &s);
        assert_eq!(after.sh[..12], all.sh[48..60]);
        assert!(after.geometry_m.iter().chain(&after.sh_v).all(|&v| v == 0.0));
    }

    /// Also for twins of the highest opacity, and for twins far smaller than their smoothing.
    #[test]
    fn twins_keep_what_there_is_of_them_along_a_line() {
        for (opacity, smoothing, expected) in [(0.3, 0.0, 0.375), (0.995, 0.0, 0.995), (0.3, 1.0, 0.6)] {
            let mut s = arrangement(2);
            for i in 0..2 {
                let (mean, log_scale) = (Vec3::ZERO, Vec3::new(-5.0, -3.0, -4.0));
                s.edit(i, |g| *g = Geometry { mean, opacity_logit: logit(opacity), log_scale, smoothing, ..*g });
            }
            set_apart(&mut s, std::iter::once((1, 0)));
            let share = if smoothing > 0.0 { 0.75_f32 } else { 0.36 };
            let apart = s.row(0).mean - s.row(1).mean;
            // Along the second axis, which the quaternion leaves where it is.
            assert!((apart.abs() - Vec3::Y * 2.0 * share.sqrt() * (-3.0_f32).exp()).length() < 1e-6, "{apart}");
            let scales = Vec3::new(-5.0, -3.0 + 0.5 * (1.0 - share).ln(), -4.0);
            for i in 0..2 {
                assert!((s.opacity(i) - expected).abs() < 1e-5, "{}", s.opacity(i));
                assert!((s.row(i).log_scale - scales).abs().max_element() < 1e-5);
            }
        }
    }

    #[test]
    fn grows_by_a_twentieth_up_to_the_cap() {
        let mut s = arrangement(100);
        let before = s.clone();
        let epoch = run(&mut s, &[SEEN; 100], &McmcOptions::new(103, false), 1);
        assert_eq!(relocated_and_added(100, &s), (0, 3));
        assert_eq!(epoch, EpochWeight { weight: vec![0.0; 103], iterations: 0 });
        let moments = rearranged(&state(100, 0), &s).geometry_m;
        let untouched = (0..100).filter(|&i| s.row(i) == before.row(i) && moments[12 * i] != 0.0).count();
        assert!((97..100).contains(&untouched), "{untouched}");
        run(&mut s, &[SEEN; 103], &McmcOptions::new(1000, false), 1);
        assert_eq!(s.len(), 108);
        run(&mut s, &[SEEN; 108], &McmcOptions::new(50, false), 1);
        assert_eq!(s.len(), 108);
        let mut few = arrangement(5);
        run(&mut few, &[SEEN; 5], &McmcOptions::new(50, false), 1);
        assert_eq!(few.len(), 6);
    }

    /// Growth per step is larger than a twentieth if there are few steps, never smaller, and never more than twofold.
    #[test]
    fn arrives_at_the_number_that_is_asked_for() {
        for (steps, cap, expected) in [(4, 1000, 1000), (60, 1000, 1000), (2, 1000, 400), (0, 1000, 200), (3, 50, 100)]
        {
            let (mut s, mut least) = (arrangement(100), f64::INFINITY);
            for step in 0..steps.max(1) {
                let n = s.len();
                let options = McmcOptions::new(cap, false).arriving_in(steps.max(1) - step, n);
                run(&mut s, &vec![SEEN; n], &options, u64::from(step));
                least = least.min(s.len().min(cap) as f64 / n.min(cap) as f64);
            }
            assert_eq!(s.len(), expected, "{cap} in {steps}");
            assert!(least > 1.5 || steps != 4, "evenly: {least}");
        }
        assert_eq!(McmcOptions::new(1000, false).arriving_in(1000, 100), McmcOptions::new(1000, false));
    }

    /// A splat that smoothing makes invisible is dead, and one that keeps an eighth of its opacity gets an eighth of
    /// the copies, whatever its logit.
    #[test]
    fn splats_are_judged_as_they_are_seen() {
        let n = 2000;
        let mut s = arrangement(n);
        for i in 0..n {
            // Scales are 0.01: √(1 + 3)⁻³ = ⅛ is left of every other one, of the first 10⁻⁶.
            s.edit(i, |g| g.smoothing = [0.01 * 3.0_f32.sqrt(), 0.0][i % 2]);
        }
        s.edit(0, |g| g.smoothing = 1.0);
        run(&mut s, &vec![SEEN; n], &McmcOptions { growth: 1.5, ..McmcOptions::new(3000, false) }, 1);
        assert_eq!(relocated_and_added(n, &s), (1, 1000));
        let smoothed = (n..3000).filter(|&i| s.row(i).smoothing > 0.0).count();
        // A ninth; five standard errors of a binomial distribution: 50.
        assert!((61..162).contains(&smoothed), "{smoothed}");
    }

    #[test]
    fn samples_in_proportion() {
        let mut rng = random::generator(3, Purpose::Density, 4);
        let picks = sample_with_repetition(&[1.0, 0.0, 3.0, f64::NAN, 4.0, 0.0], 40_000, &mut rng);
        let count = |i| picks.iter().filter(|&&p| p == i).count() as f64 / 40_000.0;
        assert_eq!([count(1), count(3), count(5)], [0.0; 3]);
        // Five standard errors: 5·√(¼/40000) = 0.0125.
        for (i, share) in [(0, 0.125), (2, 0.375), (4, 0.5)] {
            assert!((count(i) - share).abs() < 0.0125, "{i}: {}", count(i));
        }
        assert!(sample_with_repetition(&[0.0; 3], 5, &mut rng).is_empty());
        assert!(sample(&[], 5, &mut rng).is_empty());
    }

    #[test]
    fn with_a_mesh_the_hidden_are_dead_but_only_after_an_epoch() {
        let mut rows = vec![SEEN; 8];
        rows[2] = [0.0, 2.0, 4e-4, 1.0]; // opaque, but behind the mesh
        rows[5] = [0.0; 4]; // in no view
        let options = McmcOptions::new(8, true);
        let mut s = arrangement(8);
        let mut epoch = EpochWeight::default();
        epoch.add(Statistics(&rows), 60);
        // In 60 iterations over 60 views some views may not occur; in 119 iterations all occur.
        relocate_and_add(&mut s, &mut epoch, 60, &options, 600, 1);
        assert_eq!(relocated_and_added(8, &s), (0, 0));
        epoch.add(Statistics(&rows), 60);
        relocate_and_add(&mut s, &mut epoch, 60, &options, 660, 1);
        assert_eq!(relocated_and_added(8, &s), (2, 0));
        assert_ne!((s.row(2).mean.x, s.row(5).mean.x), (2.0, 5.0));
        assert_eq!(epoch, EpochWeight { weight: vec![0.0; 8], iterations: 0 });
        let mut pure = arrangement(8);
        run(&mut pure, &rows, &McmcOptions::new(8, false), 1);
        assert_eq!(relocated_and_added(8, &pure), (0, 0));
    }

    #[test]
    fn what_steps_leave_out_is_given_more_looks() {
        let of = |part| McmcOptions::new(8, true).with_dropout(part);
        assert_eq!([0.0, 0.001, 0.1, 0.2, 0.9].map(|part| of(part).epochs), [1, 1, 3, 5, 66]);
        let mut rows = vec![SEEN; 8];
        rows[5] = [0.0; 4];
        let mut epoch = EpochWeight::default();
        let mut s = arrangement(8);
        // Any 359 iterations contain five full epochs of 60 views.
        for (iterations, relocated) in [(300, 0), (59, 1)] {
            epoch.add(Statistics(&rows), iterations);
            relocate_and_add(&mut s, &mut epoch, 60, &of(0.2), 600, 1);
            assert_eq!(relocated_and_added(8, &s), (relocated, 0));
        }
    }

    /// Copies are drawn by opacity, independently of the splats' size in pictures.
    #[test]
    fn with_a_mesh_copies_go_to_what_is_shown() {
        let n = 4000;
        let rows: Vec<_> = (0..n).map(|i| [0.0, 2.0, [4.0, 4000.0, 0.0, 4e-4][i % 4], 1.0]).collect();
        // Less than an epoch: no splat is dead yet.
        let options = McmcOptions { growth: 1.25, ..McmcOptions::new(5000, true) };
        let (mut s, mut epoch) = (arrangement(n), EpochWeight::default());
        epoch.add(Statistics(&rows), 60);
        relocate_and_add(&mut s, &mut epoch, 60, &options, 600, 1);
        assert_eq!(relocated_and_added(n, &s), (0, 1000));
        let mut copies = [0; 4];
        (n..5000).for_each(|i| copies[s.row(i).mean.x.round() as usize % 4] += 1);
        // Five standard errors of a binomial distribution: 80.
        assert_eq!((copies[0] + copies[1], &copies[2..]), (1000, [0, 0].as_slice()));
        assert!((420..580).contains(&copies[0]), "{copies:?}");
        // Nothing was seen: all splats are equal.
        let mut s = arrangement(40);
        run(&mut s, &[[0.0; 4]; 40], &McmcOptions::new(50, true), 1);
        assert_eq!(relocated_and_added(40, &s), (0, 0), "all are dead after an epoch");
        let mut epoch = EpochWeight::default();
        epoch.add(Statistics(&[[0.0; 4]; 40]), 60);
        relocate_and_add(&mut s, &mut epoch, 60, &options, 600, 1);
        assert_eq!(s.len(), 50);
    }

    #[test]
    fn equal_input_gives_equal_output() {
        let once = |seed| {
            let mut s = arrangement(200);
            (0..20).for_each(|i| s.set_opacity(i, 0.001));
            run(&mut s, &[SEEN; 200], &McmcOptions::new(1000, false), seed);
            s
        };
        assert_eq!(once(1), once(1));
        assert_ne!(once(1), once(2));
    }

    #[test]
    fn nothing_alive_or_nothing_at_all() {
        let mut s = arrangement(3);
        (0..3).for_each(|i| s.edit(i, |g| g.opacity_logit = -20.0));
        run(&mut s, &[SEEN; 3], &McmcOptions::new(100, false), 1);
        assert_eq!(relocated_and_added(3, &s), (0, 0));
        let mut none = Arrangement::default();
        run(&mut none, &[], &McmcOptions::new(100, true), 1);
        assert_eq!(none.len(), 0);
        assert!(sigmoid(logit(1.0 - f32::EPSILON)) < 1.0, "the most opaque copy has a finite logit");
    }
}
