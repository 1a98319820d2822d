//! Training of static scenes: from posed photographs to a hybrid, after HERA.
//!
//! Three phases: splats alone, for a surface (skipped with a given mesh or without one); the maps of the mesh alone;
//! everything together. All random numbers are drawn from the seed and the iteration of the splats, or of the warm-up,
//! so that a resumed run takes the views and decisions of an uninterrupted one.

mod backdrop;
mod budget;
mod density_step;
mod finding;
mod handover;
mod identity;
mod masks;
mod order;
mod origin;
mod phase;
mod photographs;
mod plan;
mod pruning;
mod selection;
mod setup;
mod start;
mod unseen;
mod views;

pub use views::RefinedPose;

use std::{
    cell::OnceCell,
    ops::ControlFlow,
    path::{Path, PathBuf},
    sync::atomic::AtomicBool,
};

use self::origin::Origin;
use self::setup::{Scales, Setup};
use self::views::Views;
use super::{
    Density, Event, MeshSource, Phase, Progress, Selection, SurfaceOrigin, TrainError, TrainOptions, finite,
    log::Log,
    memory, or_why_not,
    resume::{Identity, Saved, SurfaceRecord},
    size,
};
use crate::{
    capture::Capture,
    geometry::Shell,
    render::gpu::{
        Gpu,
        exposure::ExposureState,
        memory::most_splats,
        training::{Training, TrainingOptions},
    },
    scene::{Camera, HybridScene, Mesh},
};

/// Why a run ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Outcome {
    /// All iterations are done.
    Finished,
    /// `stop` was set; the checkpoint, if the session has one, holds what is needed to go on.
    Interrupted,
}

/// The result of a run.
#[derive(Clone, Debug)]
pub struct Trained {
    /// The scene.
    pub scene: HybridScene,
    /// Data that the surface of its mesh was made of, if it has one.
    pub surface: Option<SurfaceOrigin>,
    /// Why no surface could be made, if this run tried.
    pub no_surface: Option<String>,
    /// Verdict on the triangles of the surface, if this run judged them.
    pub selection: Option<Selection>,
    /// Triangles of its mesh that belong to the shell around everything else, see [`TrainOptions::shell`].
    pub shell_triangles: usize,
    /// Number of triangles of a made surface that were removed after training because they had become invisible.
    pub faint_triangles: usize,
    /// Number of splats removed after training because opaque triangles hide them from all training views.
    pub occluded_splats: usize,
    /// Why the run ended.
    pub outcome: Outcome,
    /// Progress reports, those from before the run was resumed included.
    pub history: Vec<Progress>,
    /// Exposures by name of training view: the 3×4 matrix, by rows, that maps the rendered colour (r, g, b, 1) to the
    /// photograph's; empty without [`TrainOptions::exposure`].
    pub exposures: Vec<(String, [f32; 12])>,
    /// Refinements of poses by name of training view; empty without [`TrainOptions::refine_poses`].
    pub poses: Vec<(String, RefinedPose)>,
    /// Cameras of all views of the capture, refined ones included.
    pub cameras: Vec<Camera>,
    /// Mean seconds per joint iteration, without evaluation, those before the run was resumed included; `None` if there
    /// was none.
    pub seconds_per_iteration: Option<f64>,
    /// Seconds of the whole training: all phases, evaluation, making and judging a surface. From before a resumption,
    /// the time up to the checkpoint counts.
    pub training_seconds: f64,
    /// Peak bytes of buffers on the adapter. From before a resumption, the peak up to the checkpoint counts.
    pub peak_gpu_bytes: u64,
    /// Iterations of this run that were repeated because their view, or one before it, needed longer lists, which were
    /// made then.
    pub repeated_iterations: u32,
}

/// Checkpoint file of a run, if any.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum Checkpoints {
    /// No checkpoint: the progress of an interrupted run is only in its result.
    #[default]
    Off,
    /// Written regularly, see [`TrainOptions::checkpoint_every`]. A run goes on where one cannot be written, see
    /// [`Event::Unsaved`], unless it is stopped there.
    Save(PathBuf),
    /// As `Save`, after the run has resumed from the file.
    Resume(PathBuf),
}

impl Checkpoints {
    fn file(&self) -> Option<&Path> {
        match self {
            Self::Off => None,
            Self::Save(file) | Self::Resume(file) => Some(file),
        }
    }
}

/// Adapter, checkpoint file and callbacks of a run.
pub struct Session<'a> {
    /// The adapter to train on.
    pub gpu: &'a Gpu,
    /// Checkpoint file.
    pub checkpoints: Checkpoints,
    /// Flag, set from outside, that ends the run after the current iteration, or after the first one following a
    /// surface that is being made.
    pub stop: &'a AtomicBool,
    /// Receives every report, and what else the run tells.
    pub progress: &'a mut dyn FnMut(Event<'_>),
}

/// Trains a static scene on the views of a capture that [`TrainOptions::split`] leaves for it.
///
/// # Errors
/// If an option is not valid, a photograph cannot be read, there are too few views, the unit of length is so large or so
/// small that f32 does not hold the scene, poses are to be refined beside a given mesh, no view sees that mesh, its
/// charts do not fit the atlas, the budget has no room for a splat beside it, a checkpoint cannot be read or is of
/// another run, that of a stopped run cannot be written, the adapter fails or has too little memory, or a parameter is
/// no longer finite.
pub fn train<'a>(
    capture: &'a Capture,
    mesh: MeshSource,
    options: &'a TrainOptions,
    session: Session<'a>,
) -> Result<Trained, TrainError> {
    options.validate().map_err(TrainError::Options)?;
    let Some(origin) = Origin::of(capture)? else {
        return Run::new(capture, options, &mesh, session)?.all(mesh);
    };
    let (capture, mesh) = (origin.capture(capture)?, origin.mesh(mesh));
    // Rebuilt, since its lifetime may not outlive this capture.
    let Session { gpu, checkpoints, stop, progress } = session;
    let session = Session { gpu, checkpoints, stop, progress };
    let trained = Run::new(&capture, options, &mesh, session)?.all(mesh)?;
    origin.trained(trained)
}

/// A run in progress: what does not change, what it learns of the views, and its records. The scene is on the adapter.
struct Run<'a> {
    setup: Setup<'a>,
    views: Views<'a>,
    /// Bytes of photographs that may stay on the adapter.
    kept_photographs: u64,
    log: Log,
    found: SurfaceRecord,
    session: Session<'a>,
}

impl<'a> Run<'a> {
    fn new(
        capture: &'a Capture,
        options: &'a TrainOptions,
        source: &MeshSource,
        session: Session<'a>,
    ) -> Result<Self, TrainError> {
        let log = Log::new();
        session.gpu.reset_peak();
        let (train, test) = options.split.split(&capture.views);
        if train.len() < 2 {
            return Err(TrainError::TooFewViews { capture: capture.name.clone(), found: capture.views.len() });
        }
        if options.refine_poses && matches!(source, MeshSource::Given { .. }) {
            return Err(TrainError::PosesBesideMesh);
        }
        let input = identity::input(capture, source);
        let identity = Identity { options, input, finds_surface: source.is_found() };
        let photos = photographs::Photographs::open(capture, &train, views::sampled(&test))?;
        let exposures = options.exposure.then(|| ExposureState::new(capture.views.len()));
        let views = Views::new(photos, capture.cameras(), &train, exposures);
        let scales = Scales::of(capture, &train, &views.train_cameras);
        if !size::DISTANCES.contains(&scales.distance) {
            return Err(TrainError::Unit { capture: capture.name.clone(), found: scales.distance });
        }
        let bindable = most_splats(session.gpu, options.sh_degree);
        let budget = budget::Budget::of(options, source, scales.longest_side, bindable);
        // Without a warm-up the shell would not be judged.
        let wants_shell = options.shell && source.is_found() && !views.photos.are_cut_out && options.warmup > 0;
        let shell = wants_shell.then(|| Shell::around(&views.train_cameras, &capture.positions())).flatten();
        let given_hierarchy = OnceCell::new();
        let setup = Setup { capture, options, identity, train, test, scales, budget, shell, given_hierarchy };
        Ok(Self { setup, views, kept_photographs: 0, log, found: SurfaceRecord::default(), session })
    }

    fn all(&mut self, source: MeshSource) -> Result<Trained, TrainError> {
        let mut saved = match &self.session.checkpoints {
            Checkpoints::Resume(file) => Some(Saved::read(file, &self.setup.identity)?),
            Checkpoints::Off | Checkpoints::Save(_) => None,
        };
        // The phases before this one are done; the saved state belongs to it.
        let first = match &saved {
            Some(saved) => saved.phase,
            None if self.setup.finds_surface() => Phase::Surface,
            None => Phase::Warmup,
        };
        if let Some(saved) = &mut saved {
            self.recall(saved);
        }
        let (o, cameras, budget) = (self.setup.options, &self.views.cameras, &self.setup.budget);
        let (most, size) = (budget.splats_beside(&[]), budget.texture_size());
        self.kept_photographs = memory::check(self.session.gpu, o, cameras, &source, most, size)?;
        let of_points = source == MeshSource::Points;
        let mut scene = self.first_scene(source, saved.as_mut())?;
        let mut training = if first == Phase::Surface {
            match self.surface_phase(&mut scene, of_points, saved.take())? {
                ControlFlow::Continue(training) => training,
                ControlFlow::Break(interrupted) => return Ok(*interrupted),
            }
        } else {
            self.training(&scene)?
        };
        if first != Phase::Joint {
            if !scene.meshes.is_empty()
                && self.run_phase(&mut training, &scene, Phase::Warmup, saved.take())? == Outcome::Interrupted
            {
                return self.finish(&mut training, &scene, Outcome::Interrupted);
            }
            if self.setup.finds_surface() {
                training = self.share_out(training, &mut scene)?;
            }
        }
        let outcome = self.run_phase(&mut training, &scene, Phase::Joint, saved)?;
        self.finish(&mut training, &scene, outcome)
    }

    /// Restores the records of a resumed run, and its cameras if they are refined no further.
    fn recall(&mut self, saved: &mut Saved) {
        self.log.past = std::mem::take(&mut saved.past);
        self.log.reached = (saved.phase, saved.iteration);
        self.found = std::mem::take(&mut saved.found);
        if !self.setup.refines_poses(saved.phase)
            && let Some(poses) = saved.poses.take()
        {
            self.views.fix_poses(&self.setup, poses);
        }
    }

    /// Initial scene of the run; when resuming, saved splats replace the initial ones once the phase begins.
    fn first_scene(&mut self, source: MeshSource, saved: Option<&mut Saved>) -> Result<HybridScene, TrainError> {
        let (begins, is_joint) = (saved.is_none(), saved.as_ref().is_some_and(|saved| saved.phase == Phase::Joint));
        let meshes = match (saved, source) {
            (Some(saved), _) => std::mem::take(&mut saved.meshes),
            (None, MeshSource::Given { surface, corner_uvs }) => {
                self.found.surface = Some(SurfaceOrigin::Given);
                vec![start::given_mesh(&self.setup, &self.views, surface, corner_uvs)?]
            }
            (None, _) => vec![],
        };
        // A mesh that exists from the beginning takes its part of the budget from the beginning, and any mesh does once
        // splats are trained beside it.
        let beside: &[Mesh] = if self.setup.finds_surface() && !is_joint { &[] } else { &meshes };
        let splats = start::splats(&self.setup, &self.views, beside, begins)?;
        Ok(HybridScene { splats, meshes, composition: self.setup.composition() })
    }

    /// Trains splats alone and makes the mesh of the scene, if one can be made. Returns the training in which the
    /// splats go on, with their moments, or, if interrupted, the finished result.
    fn surface_phase(
        &mut self,
        scene: &mut HybridScene,
        of_points: bool,
        saved: Option<Saved>,
    ) -> Result<ControlFlow<Box<Trained>, Training<'a>>, TrainError> {
        let mut training = self.training(scene)?;
        if self.run_phase(&mut training, scene, Phase::Surface, saved)? == Outcome::Interrupted {
            return Ok(ControlFlow::Break(Box::new(self.finish(&mut training, scene, Outcome::Interrupted)?)));
        }
        match or_why_not(finding::find_surface(&self.setup, &self.views, &mut training, of_points))? {
            Ok((mesh, origin)) => {
                self.found.surface = Some(origin);
                scene.meshes = vec![mesh];
            }
            Err(why) => self.found.no_surface = Some(why.to_string()),
        }
        // Checked as in `share_out`, before the adapter allocates: maps that are never packed again may exceed the
        // budget.
        if self.setup.options.warmup == 0 && self.setup.budget.check(&scene.meshes).is_err() {
            scene.meshes.clear();
        }
        let splats = training.read_splats()?;
        finite::finite_splats(&splats, self.log.reached.0, self.log.reached.1)?;
        scene.splats = splats.to_splats()?;
        // Dropped first: both trainings at once would exceed the memory asked for.
        drop(training);
        training = self.training(scene)?;
        // Restores the moments. Splats are not rendered during the warm-up; the handover picks from them.
        training.write_splats(&splats)?;
        Ok(ControlFlow::Continue(training))
    }

    /// Divides the scene after the warm-up: keeps the triangles that explain the photographs about as well as splats
    /// do, and the splats that explain them better than the mesh.
    fn share_out(&mut self, mut training: Training<'a>, scene: &mut HybridScene) -> Result<Training<'a>, TrainError> {
        scene.meshes = training.read_meshes(&scene.meshes)?;
        let mut meshes = scene.meshes.clone();
        // Maps without training cannot be judged.
        if let Some(mesh) = scene.meshes.first().filter(|_| self.setup.options.warmup > 0) {
            let (kept, selection) = selection::select_faces(&self.setup, &self.views, &mut training, mesh)?;
            self.found.selection = Some(selection);
            meshes = kept.into_iter().collect();
        }
        // With a budget too small for a mesh, plain splats are the better use of it.
        if self.setup.budget.check(&meshes).is_err() {
            meshes.clear();
        }
        // A judged mesh is another one to Adam, even where its maps are the same.
        if self.found.selection.is_some() || meshes != scene.meshes {
            let splats = training.read_splats()?;
            scene.meshes = meshes;
            // Dropped first: two hybrids at once would exceed the memory asked for.
            drop(training);
            training = self.training(scene)?;
            training.write_splats(&splats)?;
        }
        // Without a mesh nothing replaces the splats.
        if !scene.meshes.is_empty() {
            let most = self.setup.budget.splats_beside(&scene.meshes);
            handover::hand_over(&self.setup, &self.views, &mut training, most)?;
        }
        Ok(training)
    }

    fn training(&self, scene: &HybridScene) -> Result<Training<'a>, TrainError> {
        let (o, views) = (self.setup.options, &self.views);
        let options = TrainingOptions {
            ssim_weight: o.ssim_weight,
            most_splats: self.setup.budget.splats_beside(&scene.meshes),
            absolute_gradients: o.density == Density::Absgs,
        };
        let mut training = Training::with_options(self.session.gpu, scene, &views.cameras, &options)?;
        training.keep_photographs(self.kept_photographs);
        if o.antialias {
            training.smooth_for(&views.train_cameras)?;
        }
        if let Some(state) = &views.exposures {
            training.expose(state)?;
        }
        Ok(training)
    }

    fn finish(
        &mut self,
        training: &mut Training,
        scene: &HybridScene,
        outcome: Outcome,
    ) -> Result<Trained, TrainError> {
        let (setup, views) = (&self.setup, &self.views);
        let (phase, iteration) = self.log.reached;
        finite::check_finite(training, phase, iteration)?;
        let (splats, mut meshes) = (training.read_splats()?.to_splats()?, training.read_meshes(&scene.meshes)?);
        let all = splats.len();
        // An interrupted run keeps all splats, as its checkpoint does.
        let splats = match outcome {
            Outcome::Finished => pruning::without_occluded(setup, views, training, splats, &meshes)?,
            Outcome::Interrupted => splats,
        };
        let triangles = |meshes: &[Mesh]| meshes.iter().map(|mesh| mesh.triangles().len()).sum::<usize>();
        let trained = triangles(&meshes);
        // As for splats; of the user's mesh nothing is removed.
        if setup.finds_surface() && outcome == Outcome::Finished {
            let viewers = setup.viewers(&views.train_cameras);
            meshes = meshes.into_iter().filter_map(|mesh| pruning::without_faint(mesh, &viewers)).collect();
        }
        let scene = HybridScene { splats, meshes, composition: scene.composition };
        let exposures = views.exposures.as_ref().map_or_else(Vec::new, |state| {
            setup.train.iter().map(|&i| (setup.capture.views[i].name.clone(), state.of(i))).collect()
        });
        let far_of = |mesh: &Mesh| mesh.triangles().iter().filter(|t| setup.is_of_shell(mesh, t)).count();
        Ok(Trained {
            shell_triangles: scene.meshes.iter().map(far_of).sum(),
            faint_triangles: trained - triangles(&scene.meshes),
            occluded_splats: all - scene.splats.len(),
            exposures,
            poses: views.refined_poses(setup),
            cameras: views.cameras.clone(),
            surface: self.found.surface.filter(|_| !scene.meshes.is_empty()),
            no_surface: self.found.no_surface.take(),
            selection: self.found.selection,
            scene,
            outcome,
            seconds_per_iteration: self.log.seconds_per_iteration(),
            training_seconds: self.log.training_seconds(),
            peak_gpu_bytes: self.log.peak_gpu_bytes(self.session.gpu.peak_bytes()),
            repeated_iterations: self.log.repeated_iterations,
            history: std::mem::take(&mut self.log.past.history),
        })
    }
}

#[cfg(test)]
mod tests;
