//! Static scenes: from posed photographs to a hybrid (METHODS 2.6–2.8, 4.7).
//!
//! Three phases: splats alone, for a surface (unless there is a mesh or none is wanted); the maps of the mesh alone;
//! everything together. All that is random is drawn from (seed, phase, iteration), so that a resumed run takes
//! the views and decisions of an uninterrupted one.

mod handover;
mod selection;

use std::{
    path::PathBuf,
    sync::atomic::{AtomicBool, Ordering},
    time::Instant,
};

use rand::{RngExt, SeedableRng, seq::SliceRandom};
use rand_pcg::Pcg64;

use super::{
    Background, Density, MeshSource, SurfaceOrigin, TrainError, TrainOptions,
    density::{
        self, Statistics,
        inria::{self, InriaOptions},
        mcmc::{self, EpochWeight, McmcOptions},
    },
    initialize::{self, Initial},
    memory,
    resume::{Identity, Saved},
    schedule::{self, Schedule},
    state::{GEOMETRY_FLOATS, SplatState},
    surface,
};
use crate::{
    capture::{self, Capture, Photo, PhotoCache, Split},
    render::gpu::{
        Gpu,
        adam::{AdamStep, SplatRates},
        exposure::{ExposureState, ExposureStep},
        loss::TruthAlpha,
        texels::TexelStep,
        training::{SplatArrays, Step, Training},
        vertices::{VertexState, VertexStep},
    },
    scene::{Camera, Composition, HybridScene, Mesh, PixelFilter, Splats, sh},
};

/// Decoded photographs are kept up to this many bytes.
const PHOTO_BUDGET: usize = 2 << 30;
/// Iterations between looks at the loss: each waits for the GPU.
const REPORT_EVERY: u32 = 10;
/// Splats of a capture without points.
const RANDOM_SPLATS: usize = 20_000;
/// Near plane of static scenes in the capture's unit (METHODS 2.2), but never more than a twentieth of the extent.
const NEAR: f32 = 0.2;
/// Iterations between measurements of how far splats are smoothed, and of the last ones in which that stays (METHODS 3).
const SMOOTH_EVERY: u32 = 100;
/// Higher bands of the maps learn slower than the zeroth by this factor, as those of splats do by 20 (METHODS 2.7): a
/// texel is seen by few views, and all of them would otherwise be explained by its bands.
const BAND_RATE_DIVISOR: f32 = 5.0;

/// What a run is doing.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Phase {
    /// Splats alone, to find a surface.
    Surface,
    /// Maps of the mesh alone.
    Warmup,
    /// Splats and maps.
    Joint,
}

/// A sign of life, every few iterations.
#[derive(Clone, Copy, Debug, serde::Serialize)]
pub struct Progress {
    /// Current phase.
    pub phase: Phase,
    /// Iterations done in this phase.
    pub iteration: u32,
    /// Iterations of this phase.
    pub of: u32,
    /// (1 − w)·L1 + w·(1 − SSIM) of the last view, w the option `ssim_weight`.
    pub loss: f64,
    /// Splats there are.
    pub splats: usize,
    /// PSNR of a held-out view, whenever one was just rendered, dB.
    pub psnr: Option<f64>,
    /// Seconds since this run began (not counting what a resumed run did before).
    pub seconds: f64,
}

/// Why a run ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Outcome {
    /// All iterations are done.
    Finished,
    /// `stop` was set; the checkpoint holds what is needed to go on.
    Interrupted,
}

/// The result of a run.
#[derive(Clone, Debug)]
pub struct Trained {
    /// The scene as it is.
    pub scene: HybridScene,
    /// What the surface of its mesh was made of, if it has one.
    pub surface: Option<SurfaceOrigin>,
    /// Why the run ended.
    pub outcome: Outcome,
    /// All reports of this run.
    pub history: Vec<Progress>,
    /// By the names of training views, the 3×4 matrix, by rows, that takes what is rendered, (r, g, b, 1), to the photograph; empty
    /// without [`TrainOptions::exposure`].
    pub exposures: Vec<(String, [f32; 12])>,
    /// Seconds per joint iteration of this run, without evaluation; `None` if it had none.
    pub seconds_per_iteration: Option<f64>,
    /// Iterations of this run that changed nothing because their view needed longer lists, which were made then.
    pub skipped_iterations: u32,
}

/// What a run needs besides the capture and the options.
pub struct Session<'a> {
    /// The adapter to train on.
    pub gpu: &'a Gpu,
    /// Where checkpoints go, if wanted; also read if `resume` is set.
    pub checkpoint: Option<PathBuf>,
    /// Go on from the checkpoint.
    pub resume: bool,
    /// Set from outside to end the run after the current iteration.
    pub stop: &'a AtomicBool,
    /// Receives every report.
    pub progress: &'a mut dyn FnMut(&Progress),
}

/// Trains a static scene on the training views of a capture (all but every eighth).
///
/// # Errors
/// If a photograph cannot be read, there are too few views, no surface is found, the adapter fails or a parameter is
/// no longer finite.
pub fn train<'a>(
    capture: &'a Capture,
    mesh: MeshSource,
    options: &'a TrainOptions,
    session: Session<'a>,
) -> Result<Trained, TrainError> {
    Run::new(capture, options, &mesh, session)?.all(mesh)
}

struct Run<'a> {
    identity: Identity<'a>,
    capture: &'a Capture,
    options: &'a TrainOptions,
    session: Session<'a>,
    cameras: Vec<Camera>,
    train_cameras: Vec<Camera>,
    train: Vec<usize>,
    test: Vec<usize>,
    cache: PhotoCache,
    truth_alpha: TruthAlpha,
    extent: f32,
    start: Instant,
    history: Vec<Progress>,
    joint_seconds: f64,
    joint_iterations: u32,
    skipped_iterations: u32,
    /// The joint phase begins with splats of the surface phase.
    hands_over: bool,
    /// What the meshes were made of.
    surface: Option<SurfaceOrigin>,
    /// Of all views of the capture, after the last phase.
    exposures: Option<ExposureState>,
    /// The last iteration.
    reached: (Phase, u32),
}

/// What one phase does.
struct Plan {
    phase: Phase,
    /// Iterations done before this run.
    from: u32,
    iterations: u32,
    /// Iterations of the splats before this phase.
    clock: u32,
    schedule: Schedule,
    has_mesh: bool,
    moves_vertices: bool,
}

impl<'a> Run<'a> {
    fn new(
        capture: &'a Capture,
        options: &'a TrainOptions,
        mesh: &MeshSource,
        session: Session<'a>,
    ) -> Result<Self, TrainError> {
        let (train, test) = Split::Every8th.split(&capture.views);
        if train.len() < 2 {
            return Err(TrainError::TooFewViews { capture: capture.name.clone(), found: capture.views.len() });
        }
        let size = |c: &Camera| (c.intrinsics().width, c.intrinsics().height);
        let views: Vec<_> = capture.views.iter().map(|v| (&v.name, size(&v.camera))).collect();
        let mesh = match mesh {
            MeshSource::None => "none".to_owned(),
            MeshSource::Splats => "splats".to_owned(),
            MeshSource::Points => "points".to_owned(),
            MeshSource::Given { surface, .. } => format!("given, {} triangles", surface.triangles.len()),
        };
        let identity = Identity { options, input: serde_json::json!({ "views": views, "mesh": mesh }) };
        let cache = PhotoCache::new(PHOTO_BUDGET);
        let first = cache.get(&capture.views[train[0]])?;
        let truth_alpha = match (first.masked, first.has_alpha) {
            (true, _) => TruthAlpha::Mask,
            (false, true) => TruthAlpha::Composite,
            (false, false) => TruthAlpha::Ignore,
        };
        let cameras: Vec<Camera> = capture.views.iter().map(|v| v.camera).collect();
        let train_cameras: Vec<Camera> = train.iter().map(|&i| cameras[i]).collect();
        let extent = capture::extent(&train_cameras) as f32;
        Ok(Self {
            identity,
            capture,
            options,
            session,
            cameras,
            train_cameras,
            train,
            test,
            cache,
            truth_alpha,
            extent: if extent > 0.0 { extent } else { 1.0 },
            start: Instant::now(),
            history: vec![],
            joint_seconds: 0.0,
            joint_iterations: 0,
            skipped_iterations: 0,
            reached: (Phase::Surface, 0),
            hands_over: false,
            surface: None,
            exposures: options.exposure.then(|| ExposureState::new(capture.views.len())),
        })
    }

    fn all(&mut self, source: MeshSource) -> Result<Trained, TrainError> {
        let mut saved = match (&self.session.checkpoint, self.session.resume) {
            (Some(path), true) => Some(Saved::read(path, &self.identity)?),
            _ => None,
        };
        memory::check(
            self.session.gpu,
            self.options,
            &self.cameras,
            &source,
            self.max_splats(&[]),
            self.texture_size(),
        )?;
        self.surface = saved.as_ref().and_then(|s| s.surface);
        let after_surface = saved.take_if(|s| s.phase != Phase::Surface);
        self.hands_over = source.is_found();
        let of_points = source == MeshSource::Points;
        let meshes = match (&after_surface, source) {
            (Some(saved), _) => saved.meshes.clone(),
            (None, MeshSource::Given { surface, corner_uvs }) => {
                self.surface = Some(SurfaceOrigin::Given);
                vec![surface::textured(surface, corner_uvs, self.options, self.texture_size())?]
            }
            (None, _) => vec![],
        };
        // A mesh that is there from the beginning takes its part of the budget from the beginning.
        let splats = self.initial_splats(if self.hands_over { &[] } else { &meshes })?;
        let mut scene = HybridScene { splats, meshes, composition: self.composition() };
        let mut trained = None;
        if self.hands_over && after_surface.is_none() {
            let mut training = self.training(&scene)?;
            if self.run_phase(&mut training, &scene, Phase::Surface, saved)? == Outcome::Interrupted {
                return self.finish(&training, &scene, Outcome::Interrupted);
            }
            scene.meshes = vec![self.find_surface(&mut training, of_points)?];
            let state = splat_state(&training)?;
            finite_splats(&state, self.reached.0, self.reached.1)?;
            scene.splats = state.to_splats()?;
            trained = Some(state);
        }
        let mut training = self.training(&scene)?;
        if let Some(state) = trained {
            // With their moments. They are not rendered during the warm-up; the handover picks from them.
            training.write_splats(&arrays(state))?;
        }
        let joint = after_surface.as_ref().is_some_and(|s| s.phase == Phase::Joint);
        let (warmup, rest) = if joint { (None, after_surface) } else { (after_surface, None) };
        let mut outcome = Outcome::Finished;
        if !scene.meshes.is_empty() && !joint {
            outcome = self.run_phase(&mut training, &scene, Phase::Warmup, warmup)?;
        }
        if outcome == Outcome::Finished {
            if self.hands_over && !joint {
                scene.meshes = training.read_meshes(&scene.meshes)?;
                // Maps that have not learnt anything cannot be judged.
                if let Some(mesh) = scene.meshes.first().filter(|_| self.options.warmup > 0) {
                    let selected = self.select_faces(&mut training, mesh)?;
                    let state = splat_state(&training)?;
                    scene.meshes = selected.into_iter().collect();
                    training = self.training(&scene)?;
                    training.write_splats(&arrays(state))?;
                }
                self.hand_over(&mut training, self.max_splats(&scene.meshes))?;
            }
            outcome = self.run_phase(&mut training, &scene, Phase::Joint, rest)?;
        }
        self.finish(&training, &scene, outcome)
    }

    fn training(&self, scene: &HybridScene) -> Result<Training<'a>, TrainError> {
        let mut training =
            Training::new(self.session.gpu, scene, &self.cameras, self.options.ssim_weight, self.truth_alpha)?;
        if self.options.antialias {
            training.smooth_for(&self.train_cameras)?;
        }
        if let Some(state) = &self.exposures {
            training.expose(state)?;
        }
        Ok(training)
    }

    fn initial_splats(&self, beside: &[Mesh]) -> Result<Splats, TrainError> {
        let (o, points) = (self.options, &self.capture.points);
        let initial = if o.density == Density::Mcmc { Initial::MCMC } else { Initial::INRIA };
        Ok(if points.is_empty() {
            let count = RANDOM_SPLATS.min(self.max_splats(beside));
            initialize::from_cameras(&self.train_cameras, count, o.sh_degree, initial, o.seed)?
        } else {
            initialize::from_points(points, o.sh_degree, initial, self.max_splats(beside), o.seed)?
        })
    }

    fn composition(&self) -> Composition {
        Composition {
            mode: self.options.mode,
            lambda: self.options.lambda * self.extent,
            layers: self.options.layers,
            background: if self.options.background == Background::White { [1.0; 3] } else { [0.0; 3] },
            near: NEAR.min(0.05 * self.extent),
            pixel_filter: if self.options.antialias { PixelFilter::MIP } else { PixelFilter::DILATION },
            ..Composition::default()
        }
    }

    fn texture_size(&self) -> u32 {
        let side = self.cameras.iter().map(|c| c.intrinsics().width.max(c.intrinsics().height)).max().unwrap_or(1);
        self.options.texture_size.unwrap_or_else(|| side.next_power_of_two().clamp(128, 2048))
    }

    /// Most splats that the budgets and the adapter's bindings allow beside these meshes.
    fn max_splats(&self, meshes: &[Mesh]) -> usize {
        let mesh_only =
            HybridScene { splats: Splats::empty(0), meshes: meshes.to_vec(), composition: Composition::default() };
        let per_splat = 11 + 3 * sh::coefficients(self.options.sh_degree);
        let by_floats = self
            .options
            .max_floats
            .map_or(usize::MAX, |floats| (floats.saturating_sub(mesh_only.total_floats()) / per_splat).max(1));
        // The longest array of a splat, in bytes.
        let widest = 4 * (3 * sh::coefficients(self.options.sh_degree)).max(GEOMETRY_FLOATS);
        let by_adapter = self.session.gpu.max_binding_bytes() as usize / widest;
        self.options.max_splats.min(by_floats).min(by_adapter)
    }

    /// Runs a phase from its beginning or from where `saved` left it.
    fn run_phase(
        &mut self,
        training: &mut Training,
        scene: &HybridScene,
        phase: Phase,
        saved: Option<Saved>,
    ) -> Result<Outcome, TrainError> {
        let outcome = self.iterate(training, scene, phase, saved)?;
        self.exposures = training.read_exposures()?;
        Ok(outcome)
    }

    fn iterate(
        &mut self,
        training: &mut Training,
        scene: &HybridScene,
        phase: Phase,
        saved: Option<Saved>,
    ) -> Result<Outcome, TrainError> {
        let o = self.options;
        // Surface and joint phase are two parts of one run of the splats: their clock goes on.
        let before = o.before_surface();
        let (iterations, clock, schedule) = match phase {
            Phase::Surface => (before, 0, Schedule::new(o.iterations)),
            Phase::Warmup => (o.warmup, 0, Schedule::new(o.warmup)),
            Phase::Joint if self.hands_over => (o.iterations - before, before, Schedule::new(o.iterations)),
            Phase::Joint => (o.iterations, 0, Schedule::new(o.iterations)),
        };
        let schedule = if o.density == Density::Mcmc { schedule.for_mcmc() } else { schedule };
        let schedule = if o.background == Background::White { schedule.with_white_background() } else { schedule };
        let from = saved.as_ref().map_or(0, |s| s.iteration);
        let moves_vertices = phase == Phase::Warmup && self.hands_over;
        let has_mesh = !scene.meshes.is_empty();
        let plan = Plan { phase, from, iterations, clock, schedule, has_mesh, moves_vertices };
        let mut epoch = EpochWeight::default();
        if moves_vertices {
            let state = match &saved {
                Some(saved) => saved.vertices.clone(),
                None => VertexState::new(&scene.meshes, pixel_size(&self.train_cameras, &scene.meshes)),
            };
            training.free_vertices(&scene.meshes, &state)?;
        }
        match saved {
            Some(saved) => epoch = saved.restore(training)?,
            None => training.smooth(),
        }
        let max_splats = self.max_splats(&scene.meshes);
        let epoch_length = self.train.len() as u32;
        for t in plan.from..plan.iterations {
            let begin = Instant::now();
            self.step(training, &plan, t)?;
            let done = t + 1;
            self.reached = (phase, done);
            if self.session.gpu.profile().is_cpu || done % 16 == 0 || done <= epoch_length {
                training.grow_if_short()?;
            }
            if phase != Phase::Warmup {
                self.control_density(training, &plan, &mut epoch, max_splats, done)?;
                if is_due(done, SMOOTH_EVERY) && plan.iterations - done >= SMOOTH_EVERY {
                    training.smooth();
                }
            }
            if self.exposures.is_some() && phase != Phase::Warmup && is_due(done, epoch_length) {
                let mut state = training.read_exposures()?.unwrap_or_default();
                state.center(&self.train);
                training.expose(&state)?;
            }
            if phase == Phase::Joint {
                self.joint_seconds += begin.elapsed().as_secs_f64();
                self.joint_iterations += 1;
            }
            let stop = self.session.stop.load(Ordering::Relaxed);
            if done % REPORT_EVERY == 0 || done == plan.iterations || stop {
                self.report(training, &plan, done)?;
            }
            if (stop || is_due(done, o.checkpoint_every))
                && let Some(path) = &self.session.checkpoint
            {
                check_finite(training, phase, done)?;
                Saved::capture(training, scene, (phase, done), self.surface, &epoch)?.write(path, &self.identity)?;
            }
            if stop && done < plan.iterations {
                return Ok(Outcome::Interrupted);
            }
        }
        Ok(Outcome::Finished)
    }

    /// One view: forward, backward, Adam.
    fn step(&self, training: &mut Training, plan: &Plan, t: u32) -> Result<(), TrainError> {
        let o = self.options;
        let index = self.view_at(plan.phase, t);
        let view = &self.capture.views[index];
        // The next view is decoded while this one is on the GPU.
        self.cache.prefetch(&self.capture.views[self.view_at(plan.phase, t + 1)]);
        let photo = self.cache.get(view)?;
        let mut random = random(o.seed, plan.phase, t);
        let background = match o.background {
            Background::Black => [0.0; 3],
            Background::White => [1.0; 3],
            Background::Random => [0; 3].map(|_| random.random()),
        };
        let age = plan.clock + t;
        let rates = plan.schedule.rates(age, self.extent);
        let mcmc = o.density == Density::Mcmc;
        let sh_degree = plan.schedule.sh_degree(age, o.sh_degree);
        let splats = (plan.phase != Phase::Warmup).then(|| AdamStep {
            number: age + 1,
            n_splats: training.pipeline.n_splats as u32,
            sh_degree,
            rates: SplatRates {
                mean: rates.mean,
                opacity: rates.opacity,
                rotation: rates.rotation,
                log_scale: rates.log_scale,
                sh_dc: rates.sh_dc,
                sh_rest: rates.sh_rest,
            },
            opacity_weight: if mcmc { 0.01 } else { 0.0 },
            scale_weight: if mcmc { 0.01 } else { 0.0 },
            noise: if mcmc { 5e5 } else { 0.0 },
            seed: random.random(),
            visible_only: o.visible_only,
        });
        let texels = plan.has_mesh.then(|| {
            let is_joint = plan.phase == Phase::Joint;
            let base_rate = match plan.phase {
                Phase::Warmup => schedule::texel_rate(o.warmup),
                _ => schedule::joint_texel_rate(o.warmup, t, plan.iterations),
            };
            TexelStep {
                // Maps that were laid out anew have no moments from the warm-up.
                number: if is_joint && !self.hands_over { o.warmup + t + 1 } else { t + 1 },
                base_rate,
                band_rate: base_rate / BAND_RATE_DIVISOR,
                visited_only: !o.dense_texels,
                holds_opacity: is_joint && plan.schedule.freezes_mesh_opacity(age),
            }
        });
        let rate = if plan.moves_vertices { schedule::vertex_rate(t, plan.iterations) } else { None };
        let vertices = rate.map(|rate| VertexStep { number: t + 1, rate });
        let band_degree = if plan.phase == Phase::Joint { sh::MAX_DEGREE } else { plan.schedule.sh_degree(t, 3) };
        training.step(&Step {
            camera: &view.camera,
            truth: &photo.rgba,
            background,
            sh_degree,
            band_degree,
            splats,
            texels,
            vertices,
            exposure: self.exposures.as_ref().map(|_| ExposureStep {
                view: index,
                // In the warm-up few of the views are seen, and maps follow those.
                rate: if plan.phase == Phase::Warmup {
                    0.0
                } else {
                    plan.schedule.exposure_rate(age, self.train.len())
                },
            }),
        })?;
        Ok(())
    }

    /// Training views that judge a fused surface (`true`) or that its maps are warmed up on (`false`): every fourth judges,
    /// so that maps are not taken for good where they merely repeat the views that they were made from.
    fn views(&self, judges: bool) -> Vec<usize> {
        if !self.hands_over || self.train.len() < 8 {
            return self.train.clone();
        }
        let (judging, warming): (Vec<_>, Vec<_>) = self.train.iter().enumerate().partition(|(i, _)| i % 4 == 2);
        let chosen = if judges { judging } else { warming };
        chosen.into_iter().map(|(_, &view)| view).collect()
    }

    /// View of iteration `t`: every epoch is a permutation of the training views.
    fn view_at(&self, phase: Phase, t: u32) -> usize {
        let mut order = if phase == Phase::Warmup { self.views(false) } else { self.train.clone() };
        let n = order.len() as u32;
        order.shuffle(&mut random(self.options.seed ^ 0x5eed, phase, t / n));
        order[(t % n) as usize]
    }

    fn control_density(
        &self,
        training: &mut Training,
        plan: &Plan,
        epoch: &mut EpochWeight,
        max_splats: usize,
        done: u32,
    ) -> Result<(), TrainError> {
        let (o, schedule, done) = (self.options, &plan.schedule, plan.clock + done);
        let (densify, reset) = (schedule.densifies_after(done), schedule.resets_opacity_after(done));
        if !densify && !reset {
            return Ok(());
        }
        let statistics = training.read_statistics()?;
        let statistics = Statistics(bytemuck::cast_slice(&statistics));
        let mut state = splat_state(training)?;
        finite_splats(&state, plan.phase, done)?;
        if densify {
            match o.density {
                Density::Inria => {
                    let max_scale = schedule.prunes_large(done).then_some(0.1);
                    let options = InriaOptions { max_scale, ..InriaOptions::new(self.extent, max_splats) };
                    inria::densify(&mut state, statistics, &options, done, o.seed);
                }
                Density::Mcmc => {
                    let options = McmcOptions::new(max_splats, plan.has_mesh);
                    epoch.add(statistics, schedule.densify_interval);
                    let views = self.train.len() as u32;
                    mcmc::relocate_and_add(&mut state, statistics, epoch, views, &options, done, o.seed);
                }
            }
        }
        if reset {
            density::reset_opacity(&mut state);
        }
        training.write_splats(&arrays(state))?;
        training.smooth();
        Ok(())
    }

    fn report(&mut self, training: &mut Training, plan: &Plan, done: u32) -> Result<(), TrainError> {
        let status = training.take_status()?;
        self.skipped_iterations += status.skipped;
        let values = training.loss()?;
        let weight = f64::from(self.options.ssim_weight);
        let loss = (1.0 - weight) * values.l1 + weight * (1.0 - values.ssim);
        if !loss.is_finite() || status.not_finite.is_some() {
            check_finite(training, plan.phase, done)?;
            let group = status.not_finite.unwrap_or("the loss").to_owned();
            return Err(TrainError::NotFinite { phase: plan.phase, iteration: done, group });
        }
        let due = is_due(done, self.options.eval_every) || done == plan.iterations;
        let psnr = if due { self.held_out_psnr(training, plan.phase)? } else { None };
        let progress = Progress {
            phase: plan.phase,
            iteration: done,
            of: plan.iterations,
            loss,
            splats: if plan.phase == Phase::Warmup { 0 } else { training.pipeline.n_splats },
            psnr,
            seconds: self.start.elapsed().as_secs_f64(),
        };
        (self.session.progress)(&progress);
        self.history.push(progress);
        Ok(())
    }

    /// Mean PSNR over up to four held-out views, over the scene's background.
    fn held_out_psnr(&self, training: &mut Training, phase: Phase) -> Result<Option<f64>, TrainError> {
        let stride = self.test.len().div_ceil(4).max(1);
        let background = self.composition().background;
        let mut scores = vec![];
        for &i in self.test.iter().step_by(stride) {
            let view = &self.capture.views[i];
            let photo = self.cache.get(view)?;
            let picture = training.render(&view.camera, background, phase != Phase::Warmup)?;
            scores.push(psnr(&photo, &picture.rgb, background));
        }
        Ok((!scores.is_empty()).then(|| scores.iter().sum::<f64>() / scores.len() as f64))
    }

    fn finish(&mut self, training: &Training, scene: &HybridScene, outcome: Outcome) -> Result<Trained, TrainError> {
        let (phase, iteration) = self.reached;
        check_finite(training, phase, iteration)?;
        let state = splat_state(training)?;
        let meshes = training.read_meshes(&scene.meshes)?;
        let scene = HybridScene { splats: state.to_splats()?, meshes, composition: scene.composition };
        let exposures = self.exposures.as_ref().map_or_else(Vec::new, |state| {
            self.train.iter().map(|&i| (self.capture.views[i].name.clone(), state.of(i))).collect()
        });
        Ok(Trained {
            exposures,
            surface: self.surface.filter(|_| !scene.meshes.is_empty()),
            scene,
            outcome,
            history: std::mem::take(&mut self.history),
            seconds_per_iteration: (self.joint_iterations > 0)
                .then(|| self.joint_seconds / f64::from(self.joint_iterations)),
            skipped_iterations: self.skipped_iterations,
        })
    }
}

/// World size of a pixel on the meshes: the median over vertices and cameras that have them in front.
fn pixel_size(cameras: &[Camera], meshes: &[Mesh]) -> f32 {
    let positions = || meshes.iter().flat_map(Mesh::positions);
    let stride = positions().count().div_ceil(1000).max(1);
    let mut sizes: Vec<f64> = (positions().step_by(stride))
        .flat_map(|p| cameras.iter().map(move |c| c.to_camera(p.as_dvec3()).z / c.intrinsics().fx))
        .filter(|size| *size > 0.0)
        .collect();
    sizes.sort_unstable_by(f64::total_cmp);
    sizes.get(sizes.len() / 2).map_or(0.0, |&s| s as f32)
}

/// Whether something that happens after every `every` iterations (0: never) happens now.
fn is_due(done: u32, every: u32) -> bool {
    every > 0 && done.is_multiple_of(every)
}

/// A generator for one iteration of one phase.
fn random(seed: u64, phase: Phase, t: u32) -> Pcg64 {
    Pcg64::seed_from_u64(seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) ^ (u64::from(t) << 2 | phase as u64))
}

/// PSNR of a picture as its 8-bit file would show it (METHODS 8), dB.
fn psnr(photo: &Photo, render: &[[f32; 3]], background: [f32; 3]) -> f64 {
    let shown = |v: f32| (v.clamp(0.0, 1.0) * 255.0).round() / 255.0;
    let error = |(p, rgb): (usize, &[f32; 3])| f64::from(squared_error(photo, p, &rgb.map(shown), background));
    let squares: f64 = render.iter().enumerate().map(error).sum();
    -10.0 * (squares / (3 * render.len()).max(1) as f64).log10()
}

/// Squared difference of a render from pixel `p` of a photograph: over the background where that is transparent; a mask
/// multiplies both (METHODS 8).
fn squared_error(photo: &Photo, p: usize, render: &[f32; 3], background: [f32; 3]) -> f32 {
    let truth = &photo.rgba[4 * p..4 * p + 4];
    let a = f32::from(truth[3]) / 255.0;
    let error: f32 = (0..3)
        .map(|c| {
            let rgb = f32::from(truth[c]) / 255.0;
            let seen = if photo.masked { rgb } else { a * rgb + (1.0 - a) * background[c] };
            (seen - render[c]).powi(2)
        })
        .sum();
    if photo.masked { error * a * a } else { error }
}

/// The splats on the GPU with their moments.
pub(super) fn splat_state(training: &Training) -> Result<SplatState, TrainError> {
    let SplatArrays { geometry: [geometry, geometry_m, geometry_v], sh: [sh, sh_m, sh_v] } = training.read_splats()?;
    let sh_degree = training.pipeline.splats.sh_degree;
    Ok(SplatState { sh_degree, geometry, sh, geometry_m, geometry_v, sh_m, sh_v })
}

/// The same as the GPU takes them.
pub(super) fn arrays(s: SplatState) -> SplatArrays {
    SplatArrays { geometry: [s.geometry, s.geometry_m, s.geometry_v], sh: [s.sh, s.sh_m, s.sh_v] }
}

/// Names the parameter group that holds a NaN or an infinity. Waits.
fn check_finite(training: &Training, phase: Phase, iteration: u32) -> Result<(), TrainError> {
    finite_splats(&splat_state(training)?, phase, iteration)?;
    // The maps themselves are refused when read; their moments follow their gradients.
    let (first, second) = training.read_texel_moments()?;
    if first.iter().chain(&second).all(|v| v.is_finite()) {
        return Ok(());
    }
    Err(TrainError::NotFinite { phase, iteration, group: "a map of the mesh".to_owned() })
}

fn finite_splats(state: &SplatState, phase: Phase, iteration: u32) -> Result<(), TrainError> {
    match state.first_non_finite() {
        None => Ok(()),
        Some((group, splat)) => {
            Err(TrainError::NotFinite { phase, iteration, group: format!("{group} of splat {splat}") })
        }
    }
}

#[cfg(test)]
mod tests;
