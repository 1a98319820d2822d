//! One phase of a run, iteration by iteration: a step on one view, density control, and regular reports.

use std::{sync::atomic::Ordering, time::Instant};

use glam::Vec3;

use super::{Event, Outcome, Phase, Progress, Run, density_step, plan::Plan, start, views::sampled};
use crate::{
    evaluate::Comparison,
    geometry::Shell,
    optimize::{
        TrainError,
        density::mcmc::EpochWeight,
        finite::check_finite,
        resume::{HostState, Saved},
    },
    render::gpu::{
        photographs::Truth,
        pose::PoseState,
        training::{Look, Show, Training},
        vertices::VertexState,
    },
    scene::{Camera, HybridScene, Mesh},
    stats::median,
};

/// Iterations between reports of the loss, each of which waits for the GPU.
const REPORT_EVERY: u32 = 10;
/// Number of first iterations of a phase, if there are no fewer views, each of which is checked for lists that were too
/// short.
const LOOKS_AT_FIRST: u32 = 300;
/// Iterations between measurements of how far splats are smoothed; in as many last ones it stays fixed (Mip-Splatting).
const SMOOTH_EVERY: u32 = 100;

impl Run<'_> {
    /// Runs a phase from its beginning or from where `saved` left it.
    pub(super) fn run_phase(
        &mut self,
        training: &mut Training,
        scene: &HybridScene,
        phase: Phase,
        saved: Option<Saved>,
    ) -> Result<Outcome, TrainError> {
        let plan = Plan::of(&self.setup, phase, saved.as_ref().map_or(0, |s| s.iteration), !scene.meshes.is_empty());
        let mut epoch = self.begin(training, scene, &plan, saved)?;
        let outcome = self.iterate(training, scene, &plan, &mut epoch)?;
        self.views.exposures = training.read_exposures()?;
        if let Some(poses) = training.read_poses()? {
            self.views.fix_poses(&self.setup, poses);
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
            let pixel = || pixel_size(&self.views.train_cameras, &scene.meshes, self.setup.shell.as_ref());
            let before = saved.as_ref().map(|saved| saved.vertices.clone());
            let state = before.unwrap_or_else(|| VertexState::new(&scene.meshes, pixel()));
            training.free_vertices(&scene.meshes, &state)?;
        }
        if self.setup.refines_poses(plan.phase) {
            let before = saved.as_ref().and_then(|saved| saved.poses.clone());
            training.refine_poses(&before.unwrap_or_else(|| PoseState::new(self.views.cameras.len())))?;
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
        let most = self.setup.budget.splats_beside(&scene.meshes);
        let mut done = plan.from;
        while done < plan.iterations {
            let begin = Instant::now();
            self.views.photos.resize(plan.scale_at(&self.setup, done));
            self.step(training, plan, done)?;
            done += 1;
            let mut stop = self.session.stop.load(Ordering::Relaxed);
            let reports = self.reports_after(plan, done) || stop;
            // After the last iteration of the run there is nothing to stop, nor to resume.
            let is_last = done == plan.iterations && plan.phase == Phase::Joint;
            // A phase's end saves too: what follows takes minutes, and writes files that may not fit on the disk.
            let ends = done == plan.iterations && self.setup.options.checkpoint_every > 0;
            let saves = stop || ends || is_due(done, self.setup.options.checkpoint_every);
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
                self.log.peak_gpu_bytes(self.session.gpu.peak_bytes());
                let host = HostState {
                    reached: self.log.reached,
                    found: self.found.clone(),
                    poses: self.views.poses.as_ref(),
                    epoch,
                    past: self.log.past.clone(),
                };
                let saved = Saved::capture(training, scene, host)?;
                let written = saved.write(path, &self.setup.identity);
                // Scores at the end of a phase take long enough for the user to stop the run there, and what follows
                // longer.
                stop |= ends && self.session.stop.load(Ordering::Relaxed);
                match written {
                    // What was learnt is nowhere else.
                    Err(error) if stop && !is_last => return Err(error.into()),
                    // There may be room for a later one, or for the scene.
                    Err(error) if !std::mem::replace(&mut self.log.told_unsaved, true) => {
                        (self.session.progress)(Event::Unsaved { error: &error, is_last });
                    }
                    Err(_) | Ok(()) => {}
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
        is_due(done, self.setup.options.eval_every) || done == plan.iterations
    }

    /// Whether to check after `done` iterations that lists were long enough, besides when the host waits for the GPU
    /// anyway: often at first, when most are too short and little is lost, and before anything happens between steps.
    fn looks_after(&self, plan: &Plan, done: u32) -> bool {
        let epoch_length = self.setup.train.len() as u32;
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
        let epoch_length = self.setup.train.len() as u32;
        let age = plan.clock + done;
        if plan.phase != Phase::Warmup {
            let (side, initial) = (self.setup.scales.longest_side, start::initial_count(self.setup.capture, most));
            let max_splats = plan.resolution.max_splats(age - 1, side, initial, most);
            density_step::control_density(&self.setup, training, plan, epoch, max_splats, done)?;
            if is_due(age, SMOOTH_EVERY) && age + SMOOTH_EVERY <= plan.schedule.iterations {
                training.smooth();
            }
        }
        if !is_due(age, epoch_length) {
            return Ok(());
        }
        if self.setup.learns_exposures(plan.phase) {
            let mut state = training.read_exposures()?.unwrap_or_default();
            state.center(&self.setup.train);
            training.expose(&state)?;
        }
        if self.setup.refines_poses(plan.phase) {
            let mut state = training.read_poses()?.unwrap_or_default();
            state.center(&self.views.cameras, &self.setup.train);
            training.refine_poses(&state)?;
        }
        Ok(())
    }

    /// One training step on one view: forward, backward, Adam.
    pub(super) fn step(&self, training: &mut Training, plan: &Plan, t: u32) -> Result<(), TrainError> {
        let (photos, view) = (&self.views.photos, plan.view_at(t));
        let (width, height) = photos.size_in_steps(view);
        let kept = |view: usize| training.kept_photograph(view, photos.size_in_steps(view));
        let photo;
        let truth = match kept(view) {
            Some(kept) => Truth::Kept(kept),
            None => {
                photo = photos.of_step(view)?;
                Truth::Sent { rgba: &photo.rgba, number: Some(view) }
            }
        };
        // While this step is on the GPU. Whether the adapter keeps this view's photograph is not known before.
        photos.prefetch(plan.views_after(&self.setup, t).filter(|&next| next != view && kept(next).is_none()));
        // Where it was found to be, at the size of the picture.
        let camera = self.views.cameras[view].resized(width, height);
        let n_splats = training.n_splats() as u32;
        training.step(&plan.step_on(&self.setup, t, n_splats, view, &camera, (truth, photos.alpha(view))))?;
        Ok(())
    }

    fn report(&mut self, training: &mut Training, plan: &Plan, done: u32, look: Look) -> Result<(), TrainError> {
        let Look { status, loss: values } = look;
        let weight = f64::from(self.setup.options.ssim_weight);
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
        (self.session.progress)(Event::Progress(&progress));
        // Reports caused by a stop are not in the history, which so equals that of an uninterrupted run.
        if self.reports_after(plan, done) {
            self.log.past.history.push(progress);
        }
        Ok(())
    }

    /// Mean PSNR over up to four held-out views, over the scene's background.
    fn held_out_psnr(&self, training: &mut Training, phase: Phase) -> Result<Option<f64>, TrainError> {
        let composition = self.setup.composition();
        let show = if phase == Phase::Warmup { Show::MeshesAlone } else { Show::All };
        let mut scores = vec![];
        for i in sampled(&self.setup.test) {
            let photo = self.views.photos.whole_of(i)?;
            let picture = training.render(&self.views.cameras[i], composition.background, show)?;
            let comparison = Comparison::new(&photo, &picture, &composition);
            if !comparison.is_empty {
                // Photographs are as large as their cameras say.
                scores.extend(comparison.psnr());
            }
        }
        Ok((!scores.is_empty()).then(|| scores.iter().sum::<f64>() / scores.len() as f64))
    }
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
