//! Schedules: learning rates and times of interventions, after INRIA 3DGS, 3DGS-MCMC and HERA.

use crate::{
    render::gpu::{adam::SplatRates, vertices::VertexStep},
    scene::sh,
};

/// Length of run that INRIA's constants are made for.
const FULL: u32 = 30_000;
/// Warm-up iterations of the HERA paper, and its learning rate of texels.
const PAPER_WARM_UP: u32 = 9_000;
const PAPER_TEXEL_RATE: f64 = 5e-4;
/// Iterations for which the opacity map is frozen after an opacity reset: with the splats in front of it gone the mesh
/// might otherwise turn opaque to make up for them.
const FREEZE: u32 = 200;
/// Largest factor by which a run counts as shorter than a full one when learning rates are adapted: that of 750
/// iterations.
const MOST_SHORTENED: f64 = 40.0;
/// Fraction of a short run after which its rates fall, and the factor to which they fall.
const SETTLES_FROM: f64 = 0.75;
const SETTLED: f64 = 0.1;

/// Schedule of the splats: when interventions happen, and learning rates. `t` counts their iterations done: those of
/// the surface phase, continued by the joint phase. The warm-up of the mesh in between does not count, and has a
/// schedule of its own.
///
/// For 30 000 iterations and more, everything has INRIA's constants, except that the position rate falls over the whole
/// run. Shorter runs are compressed: every time below is multiplied by iterations/30 000, down to a floor that leaves
/// Adam enough steps between two interventions, and learning rates by [`Schedule::haste`] and [`Schedule::settling`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Schedule {
    /// Length of the run.
    pub(super) iterations: u32,
    /// Iteration after which density control begins: 500, but not before one interval of statistics.
    pub(super) densify_from: u32,
    /// Iteration before which density control ends: 15 000 (INRIA), 25 000 (MCMC).
    pub(super) densify_until: u32,
    /// Iterations between density steps: 100, in runs below 3000 proportionally less but at least 20.
    pub(super) densify_interval: u32,
    /// Iterations between opacity resets: 3000, at least 1000. None in runs below 3000, which end before the splats
    /// are opaque again, and with MCMC.
    pub(super) opacity_reset_interval: Option<u32>,
    /// Iteration after which opacities are reset: 0, or that of the handover.
    pub(super) opacity_reset_from: u32,
    /// Iteration before which opacities are reset: any, or early enough for splats to be opaque again when a surface is
    /// made of them.
    pub(super) opacity_reset_until: u32,
    /// Iteration after which splats are pruned for their size, if at all: that of the first opacity reset, before which
    /// a large one may be the best explanation of a background.
    pub(super) prune_large_from: Option<u32>,
    /// Iterations between increases of the SH degree: 1000, at least 100.
    pub(super) sh_interval: u32,
    /// Whether there is one more opacity reset, at `densify_from`: white splats over a white background would otherwise
    /// stay for ever.
    pub(super) white_background: bool,
}

impl Schedule {
    /// INRIA's schedule for a run of `iterations`.
    pub(super) fn new(iterations: u32) -> Self {
        let of_full = |t: u32, floor: u32| {
            let scaled = u64::from(t) * u64::from(iterations.min(FULL)) / u64::from(FULL);
            u32::try_from(scaled).unwrap_or(t).max(floor)
        };
        let densify_interval = (iterations / 30).clamp(20, 100);
        let opacity_reset_interval = (iterations >= 3000).then(|| of_full(3000, 1000));
        Self {
            iterations,
            densify_from: of_full(500, densify_interval),
            densify_until: of_full(15_000, 0),
            densify_interval,
            opacity_reset_interval,
            opacity_reset_from: 0,
            opacity_reset_until: u32::MAX,
            prune_large_from: opacity_reset_interval,
            sh_interval: of_full(1000, 100),
            white_background: false,
        }
    }

    /// The same schedule for MCMC: density steps go on for 5/6 of the run, opacities are never reset.
    pub(super) fn for_mcmc(self) -> Self {
        let until = u64::from(self.densify_until) * 25 / 15;
        let densify_until = u32::try_from(until).unwrap_or(u32::MAX);
        Self { densify_until, opacity_reset_interval: None, prune_large_from: None, ..self }
    }

    /// The same schedule with INRIA's additional reset for white backgrounds (none where there are no resets).
    pub(super) fn with_white_background(self) -> Self {
        Self { white_background: true, ..self }
    }

    /// The same schedule where a surface is made after iteration `at`, judged by the splats: no opacity reset in the
    /// half interval before it.
    pub(super) fn before_surface(self, at: u32) -> Self {
        let recovery = self.opacity_reset_interval.unwrap_or(0) / 2;
        let until = at.saturating_sub(recovery);
        Self {
            opacity_reset_until: until,
            prune_large_from: self.prune_large_from.filter(|first| *first < until),
            ..self
        }
    }

    /// The same schedule where [`Self::before_surface`] has left out resets until iteration `at`.
    pub(super) fn after_surface(self, at: u32) -> Self {
        let first = |interval: u32| {
            let was_reset = interval < self.before_surface(at).opacity_reset_until;
            if was_reset { interval } else { (at / interval + 1).saturating_mul(interval) }
        };
        Self { prune_large_from: self.opacity_reset_interval.map(first), ..self }
    }

    /// The same schedule where splats are handed over to a mesh after iteration `at`: density control, which may have
    /// ended in the splats' own run, goes on for the first half of what is left, as soon as there are statistics of
    /// splats beside the mesh. Unchanged where density control goes on longer.
    pub(super) fn handed_over(self, at: u32) -> Self {
        let half = at.saturating_add(self.iterations.saturating_sub(at) / 2);
        let again = half > self.densify_until;
        Self {
            densify_from: if again { at.saturating_add(self.densify_from) } else { self.densify_from },
            densify_until: half.max(self.densify_until),
            opacity_reset_from: at,
            // The additional reset was for the beginning.
            white_background: false,
            ..self.after_surface(at)
        }
    }

    /// SH degree in use after `t` iterations, at most `max_degree`.
    pub(super) fn sh_degree(&self, t: u32, max_degree: u32) -> u32 {
        (t / self.sh_interval).min(max_degree).min(sh::MAX_DEGREE)
    }

    /// Part of the splats that the iteration after `t` others drops: `most` times the fraction of the run that is over
    /// (`DropGaussian`).
    pub(super) fn dropout(&self, t: u32, most: f32) -> f32 {
        most * (t as f32 / self.iterations.max(1) as f32).min(1.0)
    }

    /// True if a density step follows `t` iterations.
    pub(super) fn densifies_after(&self, t: u32) -> bool {
        t > self.densify_from && t < self.densify_until && t.is_multiple_of(self.densify_interval)
    }

    /// Number of density steps after `t` iterations and later.
    pub(super) fn density_steps_from(&self, t: u32) -> u32 {
        // Counts multiples of the interval: the last is before `densify_until`, the first after `densify_from`.
        let steps_before = |t: u32| t.saturating_sub(1) / self.densify_interval.max(1);
        let begin = t.max(self.densify_from.saturating_add(1));
        steps_before(self.densify_until).saturating_sub(steps_before(begin))
    }

    /// True if the density step after `t` iterations prunes splats for their size.
    pub(super) fn prunes_large(&self, t: u32) -> bool {
        self.prune_large_from.is_some_and(|from| t > from)
    }

    /// True if an opacity reset follows `t` iterations.
    pub(super) fn resets_opacity_after(&self, t: u32) -> bool {
        self.opacity_reset_interval.is_some_and(|interval| {
            t > self.opacity_reset_from
                && t < self.densify_until.min(self.opacity_reset_until)
                && (t.is_multiple_of(interval) || (self.white_background && t == self.densify_from))
        })
    }

    /// True if the mesh's opacity map is frozen in the `t`-th iteration, the first being 1: in the 200 after each
    /// reset.
    pub(super) fn freezes_mesh_opacity(&self, t: u32) -> bool {
        (t.saturating_sub(FREEZE)..t).any(|reset| self.resets_opacity_after(reset))
    }

    /// Factor on learning rates after `t` iterations of a short run: in one r times as short as 30 000, r^¾ falling to
    /// r^¼, its logarithm linear in t; at most that of 750 iterations.
    ///
    /// A step of Adam is about as long as its rate, whatever the gradient. INRIA's rates move a mean by 1/36 of the
    /// extent in all 800 iterations of a run: fewer steps have to be longer. With a factor of r itself, splats would
    /// leave what they show in single steps; at the end such steps are noise (`docs/experiments.md`).
    pub(super) fn haste(&self, t: u32) -> f32 {
        let shorter = (f64::from(FULL) / f64::from(self.iterations.max(1))).clamp(1.0, MOST_SHORTENED);
        shorter.powf(0.75 - 0.5 * part(t, self.iterations)) as f32
    }

    /// Factor on learning rates towards the end of a short run, after `t` iterations: 1 in its first three quarters,
    /// then falling to a tenth, or to 1/r in one r times shorter than 30 000 where that is more, its logarithm linear
    /// in t. With the longer steps splats fit the last few views: on skull66, held-out views went up and down by a dB
    /// from epoch to epoch (`docs/experiments.md`).
    pub(super) fn settling(&self, t: u32) -> f32 {
        let n = f64::from(self.iterations.max(1));
        let at = (f64::from(t) / n).clamp(SETTLES_FROM, 1.0);
        let shorter = (f64::from(FULL) / n).clamp(1.0, 1.0 / SETTLED);
        shorter.powf((SETTLES_FROM - at) / (1.0 - SETTLES_FROM)) as f32
    }

    /// Learning rates after `t` iterations in a scene of this extent (INRIA 3DGS, `arguments/__init__.py`), larger in
    /// short runs ([`Self::haste`]), except for opacities, which go from 0.005 to 0.995 in 200 steps, and smaller at
    /// their end ([`Self::settling`]).
    pub(super) fn rates(&self, t: u32, extent: f32) -> SplatRates {
        let settling = self.settling(t);
        let haste = self.haste(t) * settling;
        SplatRates {
            mean: (position_rate(t, self.iterations) * f64::from(extent)) as f32 * haste,
            opacity: 0.05 * settling,
            rotation: 1e-3 * haste,
            log_scale: 5e-3 * haste,
            sh_dc: 2.5e-3 * haste,
            sh_rest: 1.25e-4 * haste,
        }
    }

    /// Learning rate of exposures after `t` iterations, each on one of `views`: from 1e-2 to 1e-3, its logarithm linear
    /// in t/n (as in INRIA 3DGS). These rates reach half of the brightness where a view is seen 150 times, as in 30,000
    /// iterations on 200 photographs; where it is seen less often the rate is higher, up to ten times.
    pub(super) fn exposure_rate(&self, t: u32, views: usize) -> f32 {
        let faster = (150.0 * views as f64 / f64::from(self.iterations.max(1))).clamp(1.0, 10.0);
        (faster * 10f64.powf(-2.0 - part(t, self.iterations))) as f32
    }
}

/// Part of a run of `iterations` that is over after `t` of them, at most 1.
fn part(t: u32, iterations: u32) -> f64 {
    (f64::from(t) / f64::from(iterations.max(1))).min(1.0)
}

/// Learning rate of means after `t` iterations of a full run for an extent of 1: from 1.6e-4 to 1.6e-6, its logarithm
/// linear in t/n.
pub(super) fn position_rate(t: u32, iterations: u32) -> f64 {
    let at = part(t, iterations);
    (1.6e-4_f64.ln() * (1.0 - at) + 1.6e-6_f64.ln() * at).exp()
}

/// Learning rate of texels during a warm-up of `iterations`; `dense` if every texel moves in every iteration.
///
/// The paper's 5e-4 over 9000 iterations moves a texel by 4.5, an opacity of 0.989 and a colour beyond black or white.
/// A shorter warm-up has a higher rate for the same reach, up to 0.07. Texels that move only when a view shows them get
/// three times that reach, since a view in five or so does. (Demo capture, 0.6 M floats, 200 iterations: 25.07 dB with
/// the paper's reach, 25.23 with twice that, 25.36 with three times and no bands.)
pub(super) fn texel_rate(iterations: u32, dense: bool) -> f32 {
    let shorter = f64::from(PAPER_WARM_UP) / f64::from(iterations.clamp(1, PAPER_WARM_UP));
    let reach = if dense { 1.0 } else { 3.0 };
    (PAPER_TEXEL_RATE * reach * shorter).min(0.07) as f32
}

/// Learning rate of texels after `t` iterations of the joint phase: from `warm`, that of the warm-up, to three tenths
/// of it, its logarithm linear in t, but not below the paper's 5e-4.
pub(super) fn joint_texel_rate(warm: f32, t: u32, iterations: u32) -> f32 {
    (f64::from(warm) * 0.3_f64.powf(part(t, iterations))).max(PAPER_TEXEL_RATE) as f32
}

/// Step of the vertices of a made surface after `t` iterations of a phase with a mesh, for pictures with sides up to
/// `longest`: none in the first eighth, while maps are still grey or splats beside them have yet to grow, then 0.1
/// pixels falling to 0.01, its logarithm linear in t; less in a longer phase, so that all steps together reach no
/// farther than a thirteenth of that side.
pub(super) fn vertex_step(t: u32, iterations: u32, longest: u32) -> Option<VertexStep> {
    let before = t.checked_sub(iterations.div_ceil(8))?;
    let n = f64::from(iterations.max(1));
    let at = f64::from(t) / n;
    // The integral of 0.1^x over x from 1/8 to 1.
    let steps = n * (0.1_f64.powf(0.125) - 0.1) / 10f64.ln();
    let first = (f64::from(longest) / 13.0 / steps).min(0.1);
    Some(VertexStep { number: before + 1, rate: (first * 0.1_f64.powf(at)) as f32 })
}

/// Step size of poses after `t` of `iterations`, each on one of `views`, in radians of rotation and extents of shift: 0
/// in the first twentieth, while all is blurred, then a rate that falls to a hundredth, its logarithm linear in t. All
/// steps of a view together reach `reach`, a single one at most a third of it.
pub(super) fn pose_rate(t: u32, iterations: u32, views: usize, reach: f64) -> f32 {
    let at = part(t, iterations);
    if at < 0.05 {
        return 0.0;
    }
    let steps = (f64::from(iterations.max(1)) / views.max(1) as f64).max(1.0);
    // The mean of 0.01^x over x from 0 to 1 is 0.99 / ln 100.
    let begin = (reach / steps * 100f64.ln() / 0.99).min(reach / 3.0);
    (begin * 0.01f64.powf(at)) as f32
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::optimize::TrainOptions;

    #[test]
    fn exposures_reach_as_far_in_short_runs() {
        let long = Schedule::new(30_000);
        for (t, rate) in [(0, 1e-2), (15_000, 1e-2 / 10f32.sqrt()), (30_000, 1e-3)] {
            assert!((long.exposure_rate(t, 200) / rate - 1.0).abs() < 1e-6, "{t}");
        }
        // A view that is seen half as often moves twice as far each time, but at most ten times as far.
        assert!((Schedule::new(30_000).exposure_rate(0, 400) - 2e-2).abs() < 1e-8);
        assert!((Schedule::new(100).exposure_rate(0, 50) - 0.1).abs() < 1e-7);
        assert!((Schedule::new(30_000).exposure_rate(0, 10) - 1e-2).abs() < 1e-8);
    }

    #[test]
    fn density_control_goes_on_beside_a_mesh() {
        let splats = Schedule::new(30_000).with_white_background();
        let joint = splats.handed_over(15_000);
        let during = |s: &Schedule, when: fn(&Schedule, u32) -> bool| {
            (15_001..30_000).filter(|t| when(s, *t)).collect::<Vec<_>>()
        };
        assert!(during(&splats, Schedule::densifies_after).is_empty());
        let densifies = during(&joint, Schedule::densifies_after);
        assert_eq!((densifies[0], densifies[densifies.len() - 1], densifies.len()), (15_600, 22_400, 69));
        assert_eq!(during(&joint, Schedule::resets_opacity_after), [18_000, 21_000]);
        assert!(joint.freezes_mesh_opacity(18_100) && !joint.freezes_mesh_opacity(18_300));
        assert!(!joint.freezes_mesh_opacity(15_001), "the phase before reset nothing there");
        // MCMC density control continues anyway; a short schedule stays in order.
        let mcmc = Schedule::new(30_000).for_mcmc();
        assert_eq!(mcmc.handed_over(15_000), Schedule { opacity_reset_from: 15_000, ..mcmc });
        assert!(Schedule::new(20).handed_over(20).densify_until <= 20);
    }

    #[test]
    fn density_steps_that_are_left_are_counted() {
        for iterations in [0, 10, 20, 100, 800, 3001] {
            for schedule in [Schedule::new(iterations), Schedule::new(iterations).for_mcmc()] {
                for schedule in [schedule, schedule.handed_over(iterations / 3)] {
                    for t in 0..=iterations + 1 {
                        let left = (t..=iterations).filter(|t| schedule.densifies_after(*t)).count();
                        assert_eq!(schedule.density_steps_from(t) as usize, left, "{t} of {schedule:?}");
                    }
                }
            }
        }
    }

    #[test]
    fn poses_reach_as_far_in_short_runs() {
        for (iterations, views) in [(30_000, 200), (1000, 42)] {
            let of_view =
                (0..iterations).map(|t| f64::from(pose_rate(t, iterations, views, 0.03))).sum::<f64>() / views as f64;
            // Except for the beginning, when the poses are fixed.
            assert!((0.02..0.03).contains(&of_view), "{of_view}");
        }
        assert_eq!([0, 49].map(|t| pose_rate(t, 1000, 42, 0.03)), [0.0; 2]);
        assert!(pose_rate(50, 1000, 42, 0.03) > 50.0 * pose_rate(999, 1000, 42, 0.03));
        assert!((0..50).all(|t| pose_rate(t, 50, 42, 0.03) <= 0.01) && pose_rate(0, 0, 0, 0.03).is_finite());
    }

    #[test]
    fn position_rate_has_the_golden_values() {
        for (t, rate, digits) in
            [(0, 1.6e-4, 1e-12), (7500, 5.0596e-5, 1e-9), (15_000, 1.6e-5, 1e-12), (30_000, 1.6e-6, 1e-12)]
        {
            assert!((position_rate(t, 30_000) - rate).abs() < digits, "{t}");
        }
        assert_eq!(position_rate(40_000, 30_000), position_rate(30_000, 30_000));
        assert!(position_rate(0, 0).is_finite());
        let rates = Schedule::new(30_000).rates(15_000, 2.0);
        assert!((rates.mean - 3.2e-5).abs() < 1e-10);
        assert_eq!((rates.sh_dc, rates.sh_rest), (2.5e-3, 1.25e-4));
    }

    #[test]
    fn short_runs_have_longer_steps() {
        for (iterations, first, last) in
            [(60_000, 1.0, 1.0), (30_000, 1.0, 1.0), (1875, 8.0, 2.0), (750, 15.9054, 2.514_87), (0, 15.9054, 2.514_87)]
        {
            let (schedule, full) = (Schedule::new(iterations), Schedule::new(30_000));
            for (t, haste) in [(0, first), (iterations, last), (iterations + 9, last)] {
                assert!(iterations == 0 || (schedule.haste(t) / haste - 1.0).abs() < 1e-5, "{iterations} {t}");
            }
            let (short, usual) = (schedule.rates(0, 1.0), full.rates(0, 1.0));
            let ratios = [short.mean / usual.mean, short.log_scale / usual.log_scale, short.sh_rest / usual.sh_rest];
            assert!(ratios.iter().all(|ratio| (ratio / first - 1.0).abs() < 1e-5), "{iterations}: {ratios:?}");
            assert_eq!(short.opacity, usual.opacity);
        }
    }

    #[test]
    fn short_runs_come_to_rest() {
        for (iterations, last) in [(60_000, 1.0), (30_000, 1.0), (15_000, 0.5), (3000, 0.1), (750, 0.1), (1, 0.1)] {
            let schedule = Schedule::new(iterations);
            let at = |eighths: u32| schedule.settling(iterations * eighths / 8);
            assert_eq!([0, 3, 6].map(at), [1.0; 3], "{iterations}");
            assert!((schedule.settling(iterations) / last - 1.0).abs() < 1e-5, "{iterations}");
            assert!(iterations < 8 || (at(7) / last.sqrt() - 1.0).abs() < 0.01, "{iterations}: {}", at(7));
        }
        let short = Schedule::new(3000);
        let (first, last) = (short.rates(0, 1.0), short.rates(3000, 1.0));
        assert!((last.opacity - 0.005).abs() < 1e-7 && first.opacity == 0.05);
        assert!((last.log_scale / 5e-3 - 0.1 * 10f32.powf(0.25)).abs() < 1e-4);
    }

    #[test]
    fn a_full_run_is_inrias() {
        let s = Schedule::new(30_000);
        assert_eq!(
            s,
            Schedule {
                iterations: 30_000,
                densify_from: 500,
                densify_until: 15_000,
                densify_interval: 100,
                opacity_reset_interval: Some(3000),
                opacity_reset_from: 0,
                opacity_reset_until: u32::MAX,
                prune_large_from: Some(3000),
                sh_interval: 1000,
                white_background: false,
            }
        );
        assert_eq!(Schedule { iterations: 30_000, ..Schedule::new(100_000) }, s);
        let steps: Vec<u32> = (1..=30_000).filter(|&t| s.densifies_after(t)).collect();
        assert_eq!((steps.len(), steps[0], steps[143]), (144, 600, 14_900));
        let resets = |s: Schedule| (0..=30_000).filter(|&t| s.resets_opacity_after(t)).collect::<Vec<_>>();
        assert_eq!(resets(s), [3000, 6000, 9000, 12_000]);
        assert_eq!(resets(s.with_white_background()), [500, 3000, 6000, 9000, 12_000]);
        // Surface extraction happens after opacities have recovered from a reset.
        assert_eq!(resets(s.before_surface(15_000)), [3000, 6000, 9000, 12_000]);
        assert_eq!([6000, 4600, 4400].map(|at| resets(s.before_surface(at)).len()), [1, 1, 0]);
        assert!(resets(s.with_white_background().before_surface(1500)).is_empty());
        assert_eq!([999, 1000, 2999, 3000, 30_000].map(|t| s.sh_degree(t, 3)), [0, 1, 2, 3, 3]);
        assert_eq!(s.sh_degree(30_000, 1), 1);
        assert!(!s.prunes_large(3000) && s.prunes_large(3001));
        // Not before an opacity reset: a surface phase leaves room for one reset in the first half of 6,000 iterations,
        // and for none in that of 3,000.
        let [after, instead] = [3000, 1500].map(|at| Schedule::new(2 * at).handed_over(at).prune_large_from);
        assert_eq!((after, instead), (Some(1000), Some(2000)));
        assert_eq!((Schedule::new(2999).prune_large_from, s.for_mcmc().prune_large_from), (None, None));
        let mcmc = s.for_mcmc();
        assert_eq!((mcmc.densify_until, mcmc.opacity_reset_interval), (25_000, None));
        assert!(resets(mcmc.with_white_background()).is_empty());
    }

    #[test]
    fn short_runs_are_compressed_to_floors() {
        let s = Schedule::new(7000);
        assert_eq!((s.densify_from, s.densify_until, s.densify_interval), (116, 3500, 100));
        assert_eq!((s.opacity_reset_interval, s.sh_interval), (Some(1000), 233));
        let s = Schedule::new(2999);
        assert_eq!((s.densify_interval, s.opacity_reset_interval, s.sh_interval), (99, None, 100));
        let s = Schedule::new(300);
        assert_eq!((s.densify_from, s.densify_until, s.densify_interval), (20, 150, 20));
        for n in 0..500 {
            let s = Schedule::new(n).for_mcmc();
            assert!((0..=n).all(|t| s.sh_degree(t, 3) <= 3 && !s.resets_opacity_after(t)));
        }
        assert_eq!(Schedule::new(u32::MAX).for_mcmc().densify_until, 25_000);
    }

    #[test]
    fn the_opacity_map_rests_after_a_reset() {
        let s = Schedule::new(30_000);
        let frozen: Vec<u32> = (0..=30_000).filter(|&t| s.freezes_mesh_opacity(t)).collect();
        assert_eq!((frozen.len(), frozen[0], frozen[199], frozen[200]), (800, 3001, 3200, 6001));
        assert!((0..2000).all(|t| !Schedule::new(2000).freezes_mesh_opacity(t)));
    }

    #[test]
    fn texels_reach_further_in_a_shorter_warm_up() {
        assert_eq!([9000, 30_000].map(|n| texel_rate(n, true)), [5e-4; 2], "the paper's");
        assert_eq!([0, 1, 50].map(|n| texel_rate(n, false)), [0.07; 3]);
        assert_eq!(joint_texel_rate(texel_rate(9000, true), 10, 1000), 5e-4);
        assert_eq!(joint_texel_rate(0.02, 0, 1000), 0.02);
        assert!((joint_texel_rate(0.02, 1000, 1000) - 0.006).abs() < 1e-7);
    }

    #[test]
    fn texels_reach_as_far_in_warm_ups_of_any_length() {
        for n in [300, 3000, 8999, 9000] {
            for (dense, expected) in [(true, 4.5), (false, 13.5)] {
                let reach = texel_rate(n, dense) * n as f32;
                assert!((reach / expected - 1.0).abs() < 1e-5, "{n}: {reach}");
            }
        }
    }

    #[test]
    fn few_views_have_dropout_and_more_of_it_to_the_end() {
        let schedule = Schedule::new(1000);
        assert_eq!([0, 500, 1000, 2000].map(|t| schedule.dropout(t, 0.2)), [0.0, 0.1, 0.2, 0.2]);
        let found = [1, 12, 16, 20, 500].map(TrainOptions::dropout_of);
        assert_eq!(found, [0.2, 0.2, 0.1, 0.0, 0.0]);
    }

    #[test]
    fn vertices_come_no_farther_in_longer_phases() {
        let reach = |n, side| (0..n).filter_map(|t| vertex_step(t, n, side)).map(|step| step.rate).sum::<f32>();
        // Adam's step number starts at 1.
        let number = |t, n| vertex_step(t, n, 176).map(|step| step.number);
        assert_eq!([0, 59, 60, 479].map(|t| number(t, 480)), [None, None, Some(1), Some(420)]);
        assert_eq!([1, 2, 12].map(|t| number(t, 13)), [None, Some(1), Some(11)], "not before an eighth is over");
        assert!((vertex_step(60, 480, 176).unwrap().rate - 0.075).abs() < 1e-3);
        for (n, side) in [(480, 176), (9000, 1300), (100_000, 1300)] {
            let part = reach(n, side) / side as f32;
            assert!((0.07..0.0775).contains(&part), "{n}: {part}");
        }
        assert!(reach(0, 0) == 0.0 && reach(100, 1300) < 3.0, "a pixel in ten steps at most");
    }
}
