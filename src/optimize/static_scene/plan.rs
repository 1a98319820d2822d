//! Plan of each phase of a run: its schedule, and what each of its steps trains on and how.

use rand::RngExt;

use super::{Phase, order::ViewOrder, setup::Setup};
use crate::{
    optimize::{
        Background, Density, TrainOptions,
        density::mcmc,
        random::{self, Purpose},
        resolution::ResolutionSchedule,
        schedule::{self, Schedule},
    },
    render::gpu::{
        adam::AdamStep, exposure::ExposureStep, loss::TruthAlpha, photographs::Truth, pose::PoseStep,
        texels::TexelStep, training::Step, view::Dropout,
    },
    scene::{Camera, sh},
};

/// Divisor of the learning rate for higher bands of the maps relative to the zeroth, as with those of splats, where it
/// is 20 (INRIA 3DGS): a texel is seen by few views, and all of them would otherwise be explained by its bands.
const BAND_RATE_DIVISOR: f32 = 5.0;

/// Iterations whose photographs are decoded ahead of time, at most: enough to find some that are neither in memory nor
/// on the adapter where most are.
const LOOKS_AHEAD: u32 = 64;

/// Contents and schedule of one phase.
pub(super) struct Plan {
    pub(super) phase: Phase,
    /// Iterations of this phase done before this run.
    pub(super) from: u32,
    pub(super) iterations: u32,
    /// Iterations of the splats before this phase.
    pub(super) clock: u32,
    pub(super) schedule: Schedule,
    pub(super) order: ViewOrder,
    pub(super) resolution: ResolutionSchedule,
    pub(super) has_mesh: bool,
    pub(super) moves_vertices: bool,
}

impl Plan {
    /// For a phase of which `from` iterations are done.
    pub(super) fn of(setup: &Setup, phase: Phase, from: u32, has_mesh: bool) -> Self {
        let (o, finds_surface) = (setup.options, setup.finds_surface());
        // Surface and joint phase are two parts of one run of the splats, with one clock.
        let before = o.surface_phase_iterations();
        let is_second_part = phase == Phase::Joint && finds_surface;
        let iterations = o.iterations_of(phase, finds_surface);
        let clock = if is_second_part { before } else { 0 };
        let mut schedule = Schedule::new(if phase == Phase::Warmup { o.warmup } else { o.iterations });
        if o.density == Density::Mcmc {
            schedule = schedule.for_mcmc();
        }
        if o.background == Background::White {
            schedule = schedule.with_white_background();
        }
        if phase == Phase::Surface {
            schedule = schedule.before_surface(before);
        }
        if is_second_part {
            // If no triangle was kept, there was no handover.
            schedule = if has_mesh { schedule.handed_over(before) } else { schedule.after_surface(before) };
        }
        // Surfaces are made, and maps warmed up, at full size.
        let half = o.iterations / 2;
        let full_from = match phase {
            _ if !o.coarse_to_fine => 0,
            Phase::Warmup => 0,
            _ if finds_surface => half.min(before - before / 4),
            _ => half,
        };
        let resolution = ResolutionSchedule { full_from };
        // The user's mesh stays where it is.
        let moves_vertices = has_mesh && finds_surface;
        let order = ViewOrder::of(setup, phase);
        Self { phase, from, iterations, clock, schedule, order, resolution, has_mesh, moves_vertices }
    }

    /// View of iteration `t`.
    pub(super) fn view_at(&self, t: u32) -> usize {
        self.order.at(self.clock + t)
    }

    /// Relative side of the pictures of iteration `t`.
    pub(super) fn scale_at(&self, setup: &Setup, t: u32) -> f64 {
        self.resolution.scale(self.clock + t, setup.scales.longest_side)
    }

    /// Views of the phase's iterations after `t`, the next first, as far as it is worth looking ahead: pictures of
    /// another size are made when it is their turn.
    pub(super) fn views_after(&self, setup: &Setup, t: u32) -> impl Iterator<Item = usize> {
        let last = t.saturating_add(LOOKS_AHEAD.min(self.order.len())).min(self.iterations.saturating_sub(1));
        let scale = self.scale_at(setup, t);
        let next = (t..last).map(|t| t + 1).take_while(move |&t| self.scale_at(setup, t) == scale);
        next.map(move |t| self.view_at(t))
    }

    /// What iteration `t` trains on and how, with so many splats, and this photograph of a view and meaning of its
    /// alpha.
    pub(super) fn step_on<'s>(
        &self,
        setup: &Setup,
        t: u32,
        n_splats: u32,
        view: usize,
        camera: &'s Camera,
        (truth, truth_alpha): (Truth<'s>, TruthAlpha),
    ) -> Step<'s> {
        let o = setup.options;
        let age = self.clock + t;
        let mut rng = random::generator(o.seed, Purpose::Step(self.phase), age);
        let background = match o.background {
            Background::Black => [0.0; 3],
            Background::White => [1.0; 3],
            Background::Random => [0; 3].map(|_| rng.random()),
        };
        let seed: u32 = rng.random();
        let vertex_step = || schedule::vertex_step(t, self.iterations, setup.scales.longest_side);
        Step {
            camera,
            truth,
            truth_alpha,
            background,
            sh_degree: self.schedule.sh_degree(age, o.sh_degree),
            band_degree: if self.phase == Phase::Joint { sh::MAX_DEGREE } else { self.schedule.sh_degree(t, 3) },
            dropout: Dropout { seed, rate: self.dropout(setup, age) },
            disparity_weight: o.disparity_weight * setup.scales.distance,
            splats: self.splat_step(setup, age, n_splats, seed),
            texels: self.texel_step(setup, t),
            vertices: self.moves_vertices.then(vertex_step).flatten(),
            exposure: self.exposure_step(setup, view, age),
            pose: self.pose_step(setup, view, t),
        }
    }

    /// How splats move that have been trained for `age` iterations.
    fn splat_step(&self, setup: &Setup, age: u32, n_splats: u32, seed: u32) -> Option<AdamStep> {
        let o = setup.options;
        let is_mcmc = o.density == Density::Mcmc;
        (self.phase != Phase::Warmup).then(|| AdamStep {
            number: age + 1,
            n_splats,
            sh_degree: self.schedule.sh_degree(age, o.sh_degree),
            rates: self.schedule.rates(age, setup.scales.extent),
            opacity_weight: if is_mcmc { mcmc::OPACITY_WEIGHT } else { 0.0 },
            scale_weight: if is_mcmc { mcmc::scale_weight(setup.scales.unit) } else { 0.0 },
            noise: if is_mcmc { mcmc::noise(setup.scales.unit, self.schedule.haste(age)) } else { 0.0 },
            seed,
            visible_only: o.visible_only,
        })
    }

    /// How maps are moved by iteration `t`.
    fn texel_step(&self, setup: &Setup, t: u32) -> Option<TexelStep> {
        let o = setup.options;
        self.has_mesh.then(|| {
            let is_joint = self.phase == Phase::Joint;
            let base_rate = texel_rate(o, is_joint.then_some((t, self.iterations)));
            TexelStep {
                // Maps that were packed anew have no moments from the warm-up.
                number: if is_joint && !setup.finds_surface() { o.warmup + t + 1 } else { t + 1 },
                base_rate,
                band_rate: base_rate / BAND_RATE_DIVISOR,
                visited_only: !o.dense_texels,
                holds_opacity: is_joint && self.schedule.freezes_mesh_opacity(self.clock + t + 1),
            }
        })
    }

    /// Whose exposure counts, and how it moves, with splats of this age.
    fn exposure_step(&self, setup: &Setup, view: usize, age: u32) -> Option<ExposureStep> {
        let learns = setup.learns_exposures(self.phase);
        let rate = if learns { self.schedule.exposure_rate(age, setup.train.len()) } else { 0.0 };
        setup.options.exposure.then_some(ExposureStep { view, rate })
    }

    /// How the pose of a view is moved by iteration `t`.
    fn pose_step(&self, setup: &Setup, view: usize, t: u32) -> Option<PoseStep> {
        let rate = schedule::pose_rate(t, self.iterations, setup.train.len(), setup.options.pose_reach.to_radians());
        let shift_rate = rate * setup.scales.extent;
        setup.refines_poses(self.phase).then_some(PoseStep { view, turn_rate: rate, shift_rate })
    }

    /// Part of the splats that an iteration drops.
    pub(super) fn dropout(&self, setup: &Setup, age: u32) -> f32 {
        let most = setup.options.dropout.unwrap_or_else(|| TrainOptions::dropout_of(setup.train.len()));
        self.schedule.dropout(age, most)
    }
}

/// Learning rate of texels in a warm-up, or, with `joint` = (t, n), after t of the n iterations of the joint phase:
/// that begins as if after a warm-up of at least the usual length, as a short one is no reason to keep maps noisy to
/// the end.
pub(super) fn texel_rate(options: &TrainOptions, joint: Option<(u32, u32)>) -> f32 {
    let usual = if joint.is_some() { TrainOptions::warmup_of(options.iterations) } else { 0 };
    let warm = schedule::texel_rate(options.warmup.max(usual), options.dense_texels);
    joint.map_or(warm, |(t, iterations)| schedule::joint_texel_rate(warm, t, iterations))
}
