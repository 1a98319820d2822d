//! Static scenes: from posed photographs to a hybrid, after HERA.
//!
//! Three phases: splats alone, for a surface (unless there is a mesh or none is wanted); the maps of the mesh alone;
//! everything together. All that is random is drawn from the seed and the iteration of the splats, or of the warm-up, so that a resumed run takes
//! the views and decisions of an uninterrupted one.

mod backdrop;
mod budget;
mod comparison;
mod density_step;
mod finding;
mod handover;
mod identity;
mod masks;
mod origin;
mod phase;
mod photographs;
mod plan;
mod poses;
mod pruning;
mod selection;
mod start;
mod unseen;

pub use poses::RefinedPose;

use std::{
    cell::OnceCell,
    ops::ControlFlow,
    path::{Path, PathBuf},
    rc::Rc,
    sync::atomic::AtomicBool,
};

use glam::Vec3;

use self::{budget::Budget, origin::Origin, photographs::Photographs};
use super::{
    Background, Density, MeshSource, Phase, Progress, Selection, SurfaceOrigin, TrainError, TrainOptions,
    arrangement::Arrangement,
    finite, fused, initialize,
    log::Log,
    memory, or_why_not,
    resume::{Identity, Saved, SurfaceRecord},
    size,
};
use crate::{
    capture::Capture,
    geometry::{ChartSpace, Contraction, MeshBvh, Shell},
    render::gpu::{Gpu, exposure::ExposureState, memory::most_splats, pose::PoseState, training::Training},
    scene::{Camera, Composition, HybridScene, Mesh, PixelFilter},
};

/// Near plane of static scenes in the capture's unit (as in INRIA 3DGS), but never more than a twentieth of the extent.
const NEAR: f32 = 0.2;

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
    /// The scene as it is.
    pub scene: HybridScene,
    /// What the surface of its mesh was made of, if it has one.
    pub surface: Option<SurfaceOrigin>,
    /// Why no surface could be made, if this run tried.
    pub no_surface: Option<String>,
    /// What became of the triangles that were found, if this run judged them.
    pub selection: Option<Selection>,
    /// Triangles of its mesh that are of the shell around everything else, see [`TrainOptions::shell`].
    pub shell_triangles: usize,
    /// Triangles of a found surface that went after training, having become invisible.
    pub faint_triangles: usize,
    /// Splats that went after training, since opaque triangles hide them from all training views.
    pub occluded_splats: usize,
    /// Why the run ended.
    pub outcome: Outcome,
    /// Reports after every so many iterations, those from before the run was resumed included.
    pub history: Vec<Progress>,
    /// By the names of training views, the 3×4 matrix, by rows, that takes what is rendered, (r, g, b, 1), to the photograph; empty
    /// without [`TrainOptions::exposure`].
    pub exposures: Vec<(String, [f32; 12])>,
    /// By the names of training views, how they were refined; empty without [`TrainOptions::refine_poses`].
    pub poses: Vec<(String, RefinedPose)>,
    /// Of all views of the capture, refined where they were.
    pub cameras: Vec<Camera>,
    /// Seconds per joint iteration, those before the run was resumed included, without evaluation; `None` if there was none.
    pub seconds_per_iteration: Option<f64>,
    /// Seconds of the whole training: all phases, evaluation, a surface being made and judged. Of what was before the run was resumed, until
    /// its checkpoint.
    pub training_seconds: f64,
    /// Most bytes that buffers took at once on the adapter; of a run that was resumed, since then.
    pub peak_gpu_bytes: u64,
    /// Iterations of this run that were taken again because their view, or one before it, needed longer lists, which were made then.
    pub repeated_iterations: u32,
}

/// The file, if any, that a run is kept in.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum Checkpoints {
    /// None: what an interrupted run has learnt is in its result alone.
    #[default]
    Off,
    /// Written now and then, see [`TrainOptions::checkpoint_every`].
    Save(PathBuf),
    /// The same, after the run has gone on from what it holds.
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

/// What a run needs besides the capture and the options.
pub struct Session<'a> {
    /// The adapter to train on.
    pub gpu: &'a Gpu,
    /// Where the run is kept.
    pub checkpoints: Checkpoints,
    /// Set from outside to end the run after the current iteration, or the first one after a surface that is being made.
    pub stop: &'a AtomicBool,
    /// Receives every report.
    pub progress: &'a mut dyn FnMut(&Progress),
}

/// Trains a static scene on the views of a capture that [`TrainOptions::split`] leaves for it.
///
/// # Errors
/// If an option is not valid, a photograph cannot be read, there are too few views, poses are to be refined beside a given mesh, no view sees
/// that mesh, it leaves no room in its atlas or none for a splat in the budget, a checkpoint cannot be read or written or is of another run, the
/// adapter fails or has too little memory, or a parameter is no longer finite.
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
    // Written anew, since it may not outlive this capture.
    let Session { gpu, checkpoints, stop, progress } = session;
    let session = Session { gpu, checkpoints, stop, progress };
    let trained = Run::new(&capture, options, &mesh, session)?.all(mesh)?;
    origin.trained(trained)
}

struct Run<'a> {
    identity: Identity<'a>,
    capture: &'a Capture,
    options: &'a TrainOptions,
    session: Session<'a>,
    /// Of all views; those of training views as refined, after the phase that refines them.
    cameras: Vec<Camera>,
    train_cameras: Vec<Camera>,
    train: Vec<usize>,
    test: Vec<usize>,
    photos: Photographs<'a>,
    /// Bytes of them that may stay on the adapter.
    kept_photographs: u64,
    longest_side: u32,
    budget: Budget<'a>,
    extent: f32,
    /// The capture's unit of length, see [`size::unit_of_length`].
    unit: f32,
    /// About how far away is what views see, world units.
    distance: f32,
    /// Near plane, by the poses as they were given.
    near: f32,
    log: Log,
    found: SurfaceRecord,
    /// Around surfaces that the run makes, where photographs do not say by themselves that nothing is behind.
    shell: Option<Shell>,
    /// Of the mesh that was given.
    given_hierarchy: OnceCell<Rc<MeshBvh>>,
    /// Of all views of the capture, after the last phase.
    exposures: Option<ExposureState>,
    /// Of all views of the capture, after the phase that refines them.
    poses: Option<PoseState>,
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
        let photos = Photographs::open(capture, &train, sampled(&test))?;
        let cameras = capture.cameras();
        let train_cameras: Vec<Camera> = train.iter().map(|&i| cameras[i]).collect();
        let depth = size::median_depth(capture, &train).or_else(|| initialize::distance_of_focus(&train_cameras));
        let narrowness = size::narrowness(&train_cameras);
        let extent = (narrowness * size::extent(&train_cameras, depth)) as f32;
        let unit = size::unit_of_length(f64::from(extent), depth.map(|depth| narrowness * depth)) as f32;
        let distance = depth.map_or(extent, |depth| depth as f32);
        let near = size::near_plane(extent, NEAR);
        let longest_side = cameras.iter().map(longest_side).max().unwrap_or(1);
        let budget = Budget::of(options, source, longest_side, most_splats(session.gpu, options.sh_degree));
        // Without a warm-up nothing would be judged.
        let wants_shell = options.shell && source.is_found() && !photos.are_cut_out && options.warmup > 0;
        let shell = wants_shell.then(|| Shell::around(&train_cameras, &capture.positions())).flatten();
        Ok(Self {
            identity,
            capture,
            options,
            session,
            longest_side,
            budget,
            cameras,
            train_cameras,
            train,
            test,
            photos,
            kept_photographs: 0,
            extent,
            unit,
            distance,
            near,
            log,
            found: SurfaceRecord::default(),
            shell,
            given_hierarchy: OnceCell::new(),
            exposures: options.exposure.then(|| ExposureState::new(capture.views.len())),
            poses: None,
        })
    }

    fn all(&mut self, source: MeshSource) -> Result<Trained, TrainError> {
        let mut saved = match &self.session.checkpoints {
            Checkpoints::Resume(file) => Some(Saved::read(file, &self.identity)?),
            Checkpoints::Off | Checkpoints::Save(_) => None,
        };
        // The phases before this one are done, and what was saved is of it.
        let first = match &saved {
            Some(saved) => saved.phase,
            None if self.finds_surface() => Phase::Surface,
            None => Phase::Warmup,
        };
        if let Some(saved) = &mut saved {
            self.recall(saved);
        }
        self.kept_photographs = memory::check(
            self.session.gpu,
            self.options,
            &self.cameras,
            &source,
            self.budget.splats_beside(&[]),
            self.budget.texture_size(),
        )?;
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
            if self.finds_surface() {
                training = self.share_out(training, &mut scene)?;
            }
        }
        let outcome = self.run_phase(&mut training, &scene, Phase::Joint, saved)?;
        self.finish(&mut training, &scene, outcome)
    }

    /// Takes over what a run that goes on knows of itself, and its cameras if they are refined no further.
    fn recall(&mut self, saved: &mut Saved) {
        self.log.past = std::mem::take(&mut saved.past);
        self.log.reached = (saved.phase, saved.iteration);
        self.found = std::mem::take(&mut saved.found);
        if !self.refines_poses(saved.phase)
            && let Some(poses) = saved.poses.take()
        {
            self.fix_poses(poses);
        }
    }

    /// What the run begins or goes on with; in the latter case saved splats take the place of these when the phase begins.
    fn first_scene(&mut self, source: MeshSource, saved: Option<&mut Saved>) -> Result<HybridScene, TrainError> {
        let begins = saved.is_none();
        let meshes = match (saved, source) {
            (Some(saved), _) => std::mem::take(&mut saved.meshes),
            (None, MeshSource::Given { surface, corner_uvs }) => {
                self.found.surface = Some(SurfaceOrigin::Given);
                vec![self.given(surface, corner_uvs)?]
            }
            (None, _) => vec![],
        };
        // A mesh that is there from the beginning takes its part of the budget from the beginning.
        let splats = self.initial_splats(if self.finds_surface() { &[] } else { &meshes }, begins)?;
        Ok(HybridScene { splats, meshes, composition: self.composition() })
    }

    /// Trains splats alone and makes the mesh of the scene, if there is one to make. The splats go on in the training that it returns, with
    /// their moments; what was interrupted is done.
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
        scene.meshes = match or_why_not(self.find_surface(&mut training, of_points))? {
            Ok(mesh) => vec![mesh],
            Err(why) => {
                self.found.no_surface = Some(why.to_string());
                vec![]
            }
        };
        // As in `share_out`, before the adapter takes them: maps that stay as they were laid out may need more than was asked for.
        if self.options.warmup == 0 && self.budget.check(&scene.meshes).is_err() {
            scene.meshes.clear();
        }
        let splats = training.read_splats()?;
        finite::finite_splats(&splats, self.log.reached.0, self.log.reached.1)?;
        scene.splats = splats.to_splats()?;
        // Both at once are more than was asked for.
        drop(training);
        training = self.training(scene)?;
        // With their moments. They are not rendered during the warm-up; the handover picks from them.
        training.write_splats(&splats)?;
        Ok(ControlFlow::Continue(training))
    }

    /// After the warm-up: keeps of the mesh what explains the photographs about as well as splats do, and of the splats those that
    /// explain them better than the mesh.
    fn share_out(&mut self, mut training: Training<'a>, scene: &mut HybridScene) -> Result<Training<'a>, TrainError> {
        scene.meshes = training.read_meshes(&scene.meshes)?;
        let mut meshes = scene.meshes.clone();
        // Maps that have not learnt anything cannot be judged.
        if let Some(mesh) = scene.meshes.first().filter(|_| self.options.warmup > 0) {
            let (kept, selection) = self.select_faces(&mut training, mesh)?;
            self.found.selection = Some(selection);
            meshes = kept.into_iter().collect();
        }
        // Plain splats make more of a budget that is too small for a mesh.
        if self.budget.check(&meshes).is_err() {
            meshes.clear();
        }
        // What was judged is another mesh, to Adam also where its maps are the same.
        if self.found.selection.is_some() || meshes != scene.meshes {
            let splats = training.read_splats()?;
            scene.meshes = meshes;
            // Two hybrids at once are more than was asked for.
            drop(training);
            training = self.training(scene)?;
            training.write_splats(&splats)?;
        }
        // Nothing takes the splats' place without a mesh.
        if !scene.meshes.is_empty() {
            self.hand_over(&mut training, self.budget.splats_beside(&scene.meshes))?;
        }
        Ok(training)
    }

    fn training(&self, scene: &HybridScene) -> Result<Training<'a>, TrainError> {
        let mut training = Training::new(self.session.gpu, scene, &self.cameras, self.options.ssim_weight)?;
        training.keep_photographs(self.kept_photographs);
        if self.options.density == Density::Absgs {
            training.sum_absolute_gradients()?;
        }
        if self.options.antialias {
            training.smooth_for(&self.train_cameras)?;
        }
        if let Some(state) = &self.exposures {
            training.expose(state)?;
        }
        Ok(training)
    }

    /// The joint phase begins with splats of the surface phase then.
    fn finds_surface(&self) -> bool {
        self.identity.finds_surface
    }

    fn composition(&self) -> Composition {
        Composition {
            mode: self.options.mode,
            lambda: self.options.lambda * self.extent,
            layers: self.options.layers,
            background: if self.options.background == Background::White { [1.0; 3] } else { [0.0; 3] },
            near: self.near,
            pixel_filter: if self.options.antialias { PixelFilter::MIP } else { PixelFilter::DILATION },
            ..Composition::default()
        }
    }

    /// Points that say where the scene is, see [`fused::whereabouts`]. Beside an untrained mesh splats rest: these do not change.
    fn whereabouts(&self, training: &Training) -> Result<Vec<Vec3>, TrainError> {
        fused::whereabouts(self.capture, || Ok(training.read_splats()?.to_splats()?.means().to_vec()))
    }

    /// Where charts are laid out, if not in the world: the scene has no bounds, or there is a shell. By the cameras as they are now.
    fn charts_in(&self, training: &Training) -> Result<Option<ChartSpace>, TrainError> {
        let points = self.whereabouts(training)?;
        let around = || Contraction::around(&self.train_cameras, &points);
        Ok(match (Contraction::if_unbounded(&self.train_cameras, &points)?, self.shell) {
            (Some(contraction), _) => Some(ChartSpace::unbounded(contraction)),
            (None, Some(shell)) => Some(ChartSpace::within_shell(around()?, shell)),
            (None, None) => None,
        })
    }

    /// For rays among the meshes of this run. That of a mesh that was given, which does not move, is built once.
    fn hierarchy(&self, meshes: &[Mesh]) -> Rc<MeshBvh> {
        let build = || Rc::new(MeshBvh::of(meshes));
        // Without a mesh there is none to keep; of those that are found every one is another.
        if self.finds_surface() || meshes.is_empty() {
            build()
        } else {
            Rc::clone(self.given_hierarchy.get_or_init(build))
        }
    }

    fn finish(
        &mut self,
        training: &mut Training,
        scene: &HybridScene,
        outcome: Outcome,
    ) -> Result<Trained, TrainError> {
        let (phase, iteration) = self.log.reached;
        finite::check_finite(training, phase, iteration)?;
        let (splats, mut meshes) = (training.read_splats()?.to_splats()?, training.read_meshes(&scene.meshes)?);
        let all = splats.len();
        // The checkpoint of what was interrupted has all of them.
        let splats = match outcome {
            Outcome::Finished => self.without_occluded(training, splats, &meshes)?,
            Outcome::Interrupted => splats,
        };
        let triangles = |meshes: &[Mesh]| meshes.iter().map(|mesh| mesh.triangles().len()).sum::<usize>();
        let trained = triangles(&meshes);
        // As above; of the user's mesh nothing goes.
        if self.finds_surface() && outcome == Outcome::Finished {
            meshes = meshes.into_iter().filter_map(|mesh| self.without_faint(mesh)).collect();
        }
        let scene = HybridScene { splats, meshes, composition: scene.composition };
        let exposures = self.exposures.as_ref().map_or_else(Vec::new, |state| {
            self.train.iter().map(|&i| (self.capture.views[i].name.clone(), state.of(i))).collect()
        });
        let far_of = |mesh: &Mesh| mesh.triangles().iter().filter(|t| self.is_of_shell(mesh, t)).count();
        Ok(Trained {
            shell_triangles: scene.meshes.iter().map(far_of).sum(),
            faint_triangles: trained - triangles(&scene.meshes),
            occluded_splats: all - scene.splats.len(),
            exposures,
            poses: self.refined_poses(),
            cameras: self.cameras.clone(),
            surface: self.found.surface.filter(|_| !scene.meshes.is_empty()),
            no_surface: self.found.no_surface.take(),
            selection: self.found.selection,
            scene,
            outcome,
            seconds_per_iteration: self.log.seconds_per_iteration(),
            training_seconds: self.log.training_seconds(),
            peak_gpu_bytes: self.session.gpu.peak_bytes(),
            repeated_iterations: self.log.repeated_iterations,
            history: std::mem::take(&mut self.log.past.history),
        })
    }
}

/// Up to four of the held-out views, for a look at them while training.
fn sampled(test: &[usize]) -> impl Iterator<Item = usize> {
    test.iter().copied().step_by(test.len().div_ceil(4).max(1))
}

fn longest_side(camera: &Camera) -> u32 {
    camera.intrinsics().longer_side()
}

/// The splats on the GPU, to be rearranged.
pub(super) fn arrangement(training: &Training) -> Result<Arrangement, TrainError> {
    Ok(Arrangement::new(training.read_geometry()?))
}

#[cfg(test)]
mod tests;
