//! One phase of a run, iteration by iteration: a step on one view, density control, and regular reports.

use std::{sync::atomic::Ordering, time::Instant};

use glam::Vec3;
use rand::{RngExt, seq::SliceRandom};

use super::{Outcome, Phase, Progress, Run, photographs::truth_alpha, plan::Plan, sampled};
use crate::{
    capture::Photo,
    evaluate::Comparison,
    geometry::Shell,
    optimize::{
        Background, Density, TrainError, TrainOptions,
        density::mcmc::{self, EpochWeight},
        finite::check_finite,
        random::{self, Purpose},
        resume::{HostState, Saved},
        schedule,
    },
    render::gpu::{
        adam::AdamStep,
        exposure::ExposureStep,
        texels::TexelStep,
        training::{Look, Show, Step, Training},
        vertices::VertexState,
        view::Dropout,
    },
    scene::{Camera, HybridScene, Mesh, sh},
    stats::median,
};

/// Iterations between reports of the loss, each of which waits for the GPU.
const REPORT_EVERY: u32 = 10;
/// Number of first iterations of a phase, if there are no fewer views, each of which is checked for lists that were too
/// short.
const LOOKS_AT_FIRST: u32 = 300;
/// Iterations between measurements of how far splats are smoothed; in as many last ones it stays fixed (Mip-Splatting).
const SMOOTH_EVERY: u32 = 100;
/// Divisor of the learning rate for higher bands of the maps relative to the zeroth, as with those of splats, where it
/// is 20 (INRIA 3DGS): a texel is seen by few views, and all of them would otherwise be explained by its bands.
const BAND_RATE_DIVISOR: f32 = 5.0;

impl Run<'_> {
    /// Runs a phase from its beginning or from where `saved` left it.
    pub(super) fn run_phase(
        &mut self,
        training: &mut Training,
        scene: &HybridScene,
        phase: Phase,
        saved: Option<Saved>,
    ) -> Result<Outcome, TrainError> {
        let plan = self.plan(phase, saved.as_ref().map_or(0, |s| s.iteration), !scene.meshes.is_empty());
        let mut epoch = self.begin(training, scene, &plan, saved)?;
        let outcome = self.iterate(training, scene, &plan, &mut epoch)?;
        self.exposures = training.read_exposures()?;
        if let Some(poses) = training.read_poses()? {
            self.fix_poses(poses);
        }
        Ok(outcome)
    }

    /// Enables the moving of vertices and poses that the phase moves, and restores a saved state.
    fn begin(
        &self,
        training: &mut Training,
        scene: &HybridScene,
        plan: &Plan,
        saved: Option<Saved>,
    ) -> Result<EpochWeight, TrainError> {
        if plan.moves_vertices {
            let pixel = || pixel_size(&self.train_cameras, &scene.meshes, self.shell.as_ref());
            let before = saved.as_ref().map(|saved| saved.vertices.clone());
            let state = before.unwrap_or_else(|| VertexState::new(&scene.meshes, pixel()));
            training.free_vertices(&scene.meshes, &state)?;
        }
        if self.refines_poses(plan.phase) {
            let before = saved.as_ref().and_then(|saved| saved.poses.clone());
            training.refine_poses(&before.unwrap_or_else(|| self.given_poses()))?;
        }
        match saved {
            Some(saved) => saved.restore(training),
            None => {
                // Continuing splats keep their smoothing, and `hand_over` measures that of the ones it leaves; in the
                // warm-up splats rest.
                if plan.phase != Phase::Warmup && plan.clock == 0 {
                    training.smooth();
                }
                Ok(EpochWeight::default())
            }
        }
    }

    fn iterate(
        &mut self,
        training: &mut Training,
        scene: &HybridScene,
        plan: &Plan,
        epoch: &mut EpochWeight,
    ) -> Result<Outcome, TrainError> {
        let most = self.budget.splats_beside(&scene.meshes);
        let mut done = plan.from;
        while done < plan.iterations {
            let begin = Instant::now();
            self.photos.resize(plan.resolution.scale(plan.clock + done, self.longest_side));
            self.step(training, plan, done)?;
            done += 1;
            let mut stop = self.session.stop.load(Ordering::Relaxed);
            let reports = self.reports_after(plan, done) || stop;
            // After the last iteration of the run there is nothing to stop, nor to resume.
            let is_last = done == plan.iterations && plan.phase == Phase::Joint;
            // A phase's end saves too: what follows takes minutes, and writes files that may not fit on the disk.
            let ends = done == plan.iterations && self.options.checkpoint_every > 0;
            let saves = stop || ends || is_due(done, self.options.checkpoint_every);
            let mut seen = None;
            if reports || saves || self.looks_after(plan, done) {
                let look = training.look()?;
                let again = look.status.skipped;
                if again > 0 {
                    done = done.saturating_sub(again).max(plan.from);
                    self.log.take_back(again, plan.phase, begin);
                    continue;
                }
                seen = Some(look);
            }
            self.log.reached = (plan.phase, done);
            self.after_step(training, plan, epoch, most, done)?;
            if plan.phase == Phase::Joint && (reports || saves) {
                // Steps run asynchronously until this wait; what follows it does not count as their time.
                self.session.gpu.wait()?;
            }
            self.log.count(plan.phase, begin);
            if reports && let Some(look) = seen {
                self.report(training, plan, done, look)?;
            }
            if saves && let Some(path) = self.session.checkpoints.file() {
                let host = HostState {
                    reached: self.log.reached,
                    found: self.found.clone(),
                    poses: self.poses.as_ref(),
                    epoch,
                    past: self.log.past.clone(),
                };
                let saved = Saved::capture(training, scene, host)?;
                let written = saved.write(path, &self.identity);
                // Scores at the end of a phase take long enough for the user to stop the run there, and what follows
                // longer.
                stop |= ends && self.session.stop.load(Ordering::Relaxed);
                // A failed write after the last iteration, or at a phase's end that was not asked for, is ignored:
                // there may still be room for the scene.
                if !is_last && (stop || is_due(done, self.options.checkpoint_every)) {
                    written?;
                }
            }
            if stop && !is_last {
                return Ok(Outcome::Interrupted);
            }
        }
        Ok(Outcome::Finished)
    }

    /// Whether an uninterrupted run reports after `done` iterations.
    fn reports_after(&self, plan: &Plan, done: u32) -> bool {
        is_due(done, REPORT_EVERY) || self.evaluates_after(plan, done)
    }

    /// Whether the report after `done` iterations includes the PSNR of held-out views.
    fn evaluates_after(&self, plan: &Plan, done: u32) -> bool {
        is_due(done, self.options.eval_every) || done == plan.iterations
    }

    /// Whether to check after `done` iterations that lists were long enough, besides when the host waits for the GPU
    /// anyway: often at first, when most are too short and little is lost, and before anything happens between steps.
    fn looks_after(&self, plan: &Plan, done: u32) -> bool {
        let epoch_length = self.train.len() as u32;
        let age = plan.clock + done;
        let changes = plan.schedule.densifies_after(age) || plan.schedule.resets_opacity_after(age);
        let between = changes || is_due(age, SMOOTH_EVERY) || is_due(age, epoch_length);
        self.session.gpu.profile().is_cpu || done <= epoch_length.min(LOOKS_AT_FIRST) || between
    }

    /// Actions between steps, each at its own interval: density control, smoothing, and centring of exposures and
    /// poses.
    fn after_step(
        &self,
        training: &mut Training,
        plan: &Plan,
        epoch: &mut EpochWeight,
        most: usize,
        done: u32,
    ) -> Result<(), TrainError> {
        let epoch_length = self.train.len() as u32;
        let age = plan.clock + done;
        if plan.phase != Phase::Warmup {
            let max_splats = plan.resolution.max_splats(age - 1, self.longest_side, self.initial_count(most), most);
            self.control_density(training, plan, epoch, max_splats, done)?;
            if is_due(age, SMOOTH_EVERY) && age + SMOOTH_EVERY <= plan.schedule.iterations {
                training.smooth();
            }
        }
        if !is_due(age, epoch_length) {
            return Ok(());
        }
        if self.exposures.is_some() && plan.phase != Phase::Warmup {
            let mut state = training.read_exposures()?.unwrap_or_default();
            state.center(&self.train);
            training.expose(&state)?;
        }
        if self.refines_poses(plan.phase) {
            let mut state = training.read_poses()?.unwrap_or_default();
            state.center(&self.cameras, &self.train);
            training.refine_poses(&state)?;
        }
        Ok(())
    }

    /// One training step on one view: forward, backward, Adam.
    pub(super) fn step(&self, training: &mut Training, plan: &Plan, t: u32) -> Result<(), TrainError> {
        let view = self.view_at(plan, t);
        let photo = self.photos.of_step(view, self.view_at(plan, t + 1))?;
        // Where it was found to be, at the size of the picture.
        let camera = self.cameras[view].resized(photo.width, photo.height);
        let n_splats = training.n_splats() as u32;
        training.step(&self.step_on(plan, t, n_splats, view, &camera, &photo))?;
        Ok(())
    }

    /// What iteration `t` trains on and how, with so many splats and this photograph of a view.
    pub(super) fn step_on<'s>(
        &self,
        plan: &Plan,
        t: u32,
        n_splats: u32,
        view: usize,
        camera: &'s Camera,
        photo: &'s Photo,
    ) -> Step<'s> {
        let o = self.options;
        let age = plan.clock + t;
        let mut rng = random::generator(o.seed, Purpose::Step(plan.phase), age);
        let background = match o.background {
            Background::Black => [0.0; 3],
            Background::White => [1.0; 3],
            Background::Random => [0; 3].map(|_| rng.random()),
        };
        let seed: u32 = rng.random();
        let vertex_step = || schedule::vertex_step(t, plan.iterations, self.longest_side);
        Step {
            camera,
            truth: &photo.rgba,
            kept_as: Some(view),
            truth_alpha: truth_alpha(photo),
            background,
            sh_degree: plan.schedule.sh_degree(age, o.sh_degree),
            band_degree: if plan.phase == Phase::Joint { sh::MAX_DEGREE } else { plan.schedule.sh_degree(t, 3) },
            dropout: Dropout { seed, rate: self.dropout(plan, age) },
            disparity_weight: o.disparity_weight * self.distance,
            splats: self.splat_step(plan, age, n_splats, seed),
            texels: self.texel_step(plan, t),
            vertices: plan.moves_vertices.then(vertex_step).flatten(),
            exposure: self.exposure_step(plan, view, age),
            pose: self.pose_step(plan, view, t),
        }
    }

    /// How splats move that have been trained for `age` iterations.
    fn splat_step(&self, plan: &Plan, age: u32, n_splats: u32, seed: u32) -> Option<AdamStep> {
        let o = self.options;
        let is_mcmc = o.density == Density::Mcmc;
        (plan.phase != Phase::Warmup).then(|| AdamStep {
            number: age + 1,
            n_splats,
            sh_degree: plan.schedule.sh_degree(age, o.sh_degree),
            rates: plan.schedule.rates(age, self.extent),
            opacity_weight: if is_mcmc { mcmc::OPACITY_WEIGHT } else { 0.0 },
            scale_weight: if is_mcmc { mcmc::scale_weight(self.unit) } else { 0.0 },
            noise: if is_mcmc { mcmc::noise(self.unit, plan.schedule.haste(age)) } else { 0.0 },
            seed,
            visible_only: o.visible_only,
        })
    }

    /// How maps are moved by iteration `t`.
    fn texel_step(&self, plan: &Plan, t: u32) -> Option<TexelStep> {
        let o = self.options;
        plan.has_mesh.then(|| {
            let is_joint = plan.phase == Phase::Joint;
            let base_rate = texel_rate(o, is_joint.then_some((t, plan.iterations)));
            TexelStep {
                // Maps that were packed anew have no moments from the warm-up.
                number: if is_joint && !self.finds_surface() { o.warmup + t + 1 } else { t + 1 },
                base_rate,
                band_rate: base_rate / BAND_RATE_DIVISOR,
                visited_only: !o.dense_texels,
                holds_opacity: is_joint && plan.schedule.freezes_mesh_opacity(plan.clock + t + 1),
            }
        })
    }

    /// Whose exposure counts, and how it moves, with splats of this age.
    fn exposure_step(&self, plan: &Plan, view: usize, age: u32) -> Option<ExposureStep> {
        self.exposures.as_ref().map(|_| ExposureStep {
            view,
            // In the warm-up few of the views are seen, and maps follow those.
            rate: if plan.phase == Phase::Warmup { 0.0 } else { plan.schedule.exposure_rate(age, self.train.len()) },
        })
    }

    /// Part of the splats that an iteration drops.
    pub(super) fn dropout(&self, plan: &Plan, age: u32) -> f32 {
        let most = self.options.dropout.unwrap_or_else(|| TrainOptions::dropout_of(self.train.len()));
        plan.schedule.dropout(age, most)
    }

    /// Training views that judge a made surface (`true`) or warm up its maps (`false`): every fourth judges, so that
    /// maps which merely repeat the views they were made from are not taken for good. Splats have learnt from all. With
    /// fewer than eight views all do both, as splats cannot spare any.
    pub(super) fn views(&self, judges: bool) -> Vec<usize> {
        if !self.finds_surface() || self.train.len() < 8 {
            return self.train.clone();
        }
        let (judging, warming): (Vec<_>, Vec<_>) = self.train.iter().enumerate().partition(|(i, _)| i % 4 == 2);
        let chosen = if judges { judging } else { warming };
        chosen.into_iter().map(|(_, &view)| view).collect()
    }

    /// View of iteration `t`: every epoch is a permutation of the training views.
    fn view_at(&self, plan: &Plan, t: u32) -> usize {
        let mut order = if plan.phase == Phase::Warmup { self.views(false) } else { self.train.clone() };
        let (n, age) = (order.len() as u32, plan.clock + t);
        order.shuffle(&mut random::generator(self.options.seed, Purpose::ViewOrder(plan.phase), age / n));
        order[(age % n) as usize]
    }

    fn report(&mut self, training: &mut Training, plan: &Plan, done: u32, look: Look) -> Result<(), TrainError> {
        let Look { status, loss: values } = look;
        let weight = f64::from(self.options.ssim_weight);
        let loss = (1.0 - weight) * values.l1 + weight * (1.0 - values.ssim);
        if !loss.is_finite() || status.not_finite.is_some() {
            check_finite(training, plan.phase, done)?;
            let group = status.not_finite.unwrap_or("the loss").to_owned();
            return Err(TrainError::NotFinite { phase: plan.phase, iteration: done, group });
        }
        let psnr = if self.evaluates_after(plan, done) { self.held_out_psnr(training, plan.phase)? } else { None };
        let progress = Progress {
            phase: plan.phase,
            iteration: done,
            of: plan.iterations,
            loss,
            splats: if plan.phase == Phase::Warmup { 0 } else { training.n_splats() },
            psnr,
            seconds: self.log.seconds(),
        };
        (self.session.progress)(&progress);
        // Reports caused by a stop are not in the history, which so equals that of an uninterrupted run.
        if self.reports_after(plan, done) {
            self.log.past.history.push(progress);
        }
        Ok(())
    }

    /// Mean PSNR over up to four held-out views, over the scene's background.
    fn held_out_psnr(&self, training: &mut Training, phase: Phase) -> Result<Option<f64>, TrainError> {
        let composition = self.composition();
        let show = if phase == Phase::Warmup { Show::MeshesAlone } else { Show::All };
        let mut scores = vec![];
        for i in sampled(&self.test) {
            let view = &self.capture.views[i];
            let photo = self.photos.whole(view)?;
            let picture = training.render(&view.camera, composition.background, show)?;
            let comparison = Comparison::new(&photo, &picture, &composition);
            if !comparison.is_empty {
                // Photographs are as large as their cameras say.
                scores.extend(comparison.psnr());
            }
        }
        Ok((!scores.is_empty()).then(|| scores.iter().sum::<f64>() / scores.len() as f64))
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

/// Whether an event that happens every `every` iterations (0: never) is due after `done`.
fn is_due(done: u32, every: u32) -> bool {
    every > 0 && done.is_multiple_of(every)
}

/// World size of a pixel on the meshes, excluding the shell: the median over vertices and the cameras that they are in
/// front of.
fn pixel_size(cameras: &[Camera], meshes: &[Mesh], shell: Option<&Shell>) -> f32 {
    let is_near = |p: &&Vec3| shell.is_none_or(|shell| !shell.holds(**p));
    let positions = || meshes.iter().flat_map(Mesh::positions).filter(is_near);
    let stride = positions().count().div_ceil(1000).max(1);
    let sizes = (positions().step_by(stride))
        .flat_map(|p| cameras.iter().map(move |c| c.to_camera(p.as_dvec3()).z / c.intrinsics().fx))
        .filter(|size| *size > 0.0);
    median(sizes.collect()).map_or(0.0, |size| size as f32)
}
