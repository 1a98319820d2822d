//! A scene on the GPU during training: parameters, gradients, Adam, and one step of it.

mod pictures;
mod splats;

use std::sync::Arc;

use super::{
    adam::{AdamBuffers, AdamStep, SplatAdam, SplatFloats},
    backward::Backward,
    device::{Buffer, Frame, Gpu, GpuError, Timer},
    exposure::{ExposureState, ExposureStep, Exposures},
    front::Front,
    geometry::GEOMETRY_FLOATS,
    loss::{Loss, LossBuffers, LossValues, TruthAlpha},
    memory::with_headroom,
    mesh::MeshStage,
    photographs::{Truth, UploadedPhotographs},
    pipeline::Pipeline,
    pose::{PoseState, PoseStep, Poses},
    rows::RowGather,
    smoothing::Smoothing,
    splats::{SplatBuffers, longest_list},
    status::{ListCheck, Status, status_buffer},
    texels::TexelStep,
    vertices::{VertexState, VertexStep},
    view::{Dropout, View},
};
use crate::scene::{Atlas, Camera, HybridScene, Mesh, sh};

/// What a training is for, besides a scene and cameras.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct TrainingOptions {
    /// Weight of D-SSIM in the loss.
    pub(crate) ssim_weight: f32,
    /// Most splats that density control will make: buffers have room for no more, unless the scene has more.
    pub(crate) most_splats: usize,
    /// Whether the statistics of density control include absolute gradients (AbsGS).
    pub(crate) absolute_gradients: bool,
}

impl Default for TrainingOptions {
    /// The loss of 3DGS and any number of splats, without absolute gradients.
    fn default() -> Self {
        Self { ssim_weight: 0.2, most_splats: usize::MAX, absolute_gradients: false }
    }
}

/// Inputs and options of one training step.
pub(crate) struct Step<'a> {
    pub(crate) camera: &'a Camera,
    /// Photograph, of the camera's size.
    pub(crate) truth: Truth<'a>,
    /// Meaning of the photograph's alpha.
    pub(crate) truth_alpha: TruthAlpha,
    pub(crate) background: [f32; 3],
    pub(crate) sh_degree: u32,
    pub(crate) band_degree: u32,
    pub(crate) dropout: Dropout,
    /// As [`View::disparity_weight`].
    pub(crate) disparity_weight: f32,
    /// Adam step of the splats; without it they are neither rendered nor changed.
    pub(crate) splats: Option<AdamStep>,
    /// Adam step of the maps; without it they are rendered but not changed.
    pub(crate) texels: Option<TexelStep>,
    /// Step of free vertices; without it they do not move.
    pub(crate) vertices: Option<VertexStep>,
    /// Exposure step; the view's exposure applies with [`Training::expose`]. Without splats it learns of what meshes
    /// cover.
    pub(crate) exposure: Option<ExposureStep>,
    /// Pose step; the view's correction applies with [`Training::refine_poses`].
    pub(crate) pose: Option<PoseStep>,
}

impl<'a> Step<'a> {
    /// A step that changes nothing: meshes, of SH degree 0 and before black, are compared with an RGBA8 photograph,
    /// whose alpha is ignored.
    pub(crate) fn still(camera: &'a Camera, rgba: &'a [u8]) -> Self {
        Self {
            camera,
            truth: Truth::Sent { rgba, number: None },
            truth_alpha: TruthAlpha::Ignore,
            background: [0.0; 3],
            sh_degree: 0,
            band_degree: 0,
            dropout: Dropout::default(),
            disparity_weight: 0.0,
            splats: None,
            texels: None,
            vertices: None,
            exposure: None,
            pose: None,
        }
    }
}

/// Parts of a scene to render.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Show {
    All,
    MeshesAlone,
    SplatsAlone,
}

impl Show {
    fn of(self, view: View) -> View {
        match self {
            Self::All => view,
            Self::MeshesAlone => View { n_splats: 0, ..view },
            Self::SplatsAlone => View { n_triangles: 0, ..view },
        }
    }
}

/// Status and loss, as read back by the host.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Look {
    pub(crate) status: Status,
    /// Loss of the last step.
    pub(crate) loss: LossValues,
}

/// Buffers and kernels of a training run.
pub(crate) struct Training<'g> {
    gpu: &'g Gpu,
    pub(super) pipeline: Pipeline,
    backward: Backward,
    photographs: UploadedPhotographs,
    list_check: ListCheck,
    loss: Loss,
    adam: SplatAdam,
    moments: [Buffer; 4],
    /// Capacity of `moments`, splats.
    moments_of: usize,
    /// As [`TrainingOptions::most_splats`].
    most_splats: usize,
    rows: RowGather,
    smoothing: Option<Smoothing>,
    exposures: Option<Exposures>,
    poses: Option<Poses>,
    timer: Option<Timer>,
    /// [`Front::generation`] that all above is bound to. `loss` and `exposures` bind buffers that are never replaced.
    bound_to: u64,
    /// [`Front::triangle_list_generation`] that `list_check` is bound to.
    checks: u64,
}

impl<'g> Training<'g> {
    /// Number of splats.
    pub(crate) fn n_splats(&self) -> usize {
        self.pipeline.front.n_splats
    }

    /// As [`Front::list_lengths`].
    pub(crate) fn list_lengths(&self) -> [usize; 2] {
        self.pipeline.front.list_lengths()
    }

    /// `Front::list_lengths` of a run on another adapter, limited to what this one binds.
    pub(crate) fn bindable(&self, lengths: [usize; 2]) -> [usize; 2] {
        lengths.map(|length| length.min(longest_list(self.gpu)))
    }

    /// Training of a scene of any number of splats, seen by `cameras`.
    #[cfg(test)]
    pub(crate) fn new(
        gpu: &'g Gpu,
        scene: &HybridScene,
        cameras: &[Camera],
        ssim_weight: f32,
    ) -> Result<Self, GpuError> {
        Self::with_options(gpu, scene, cameras, &TrainingOptions { ssim_weight, ..TrainingOptions::default() })
    }

    /// Training of a scene seen by `cameras`.
    pub(crate) fn with_options(
        gpu: &'g Gpu,
        scene: &HybridScene,
        cameras: &[Camera],
        options: &TrainingOptions,
    ) -> Result<Self, GpuError> {
        let &TrainingOptions { ssim_weight, most_splats, absolute_gradients } = options;
        let capacity = with_headroom(gpu, scene.splats.len(), scene.splats.sh_degree(), most_splats);
        let status = status_buffer(gpu)?;
        let pipeline = Pipeline::new(gpu, scene, capacity, cameras, Some(&status))?;
        let backward = Backward::new(gpu, &pipeline, status, absolute_gradients)?;
        let size = |c: &Camera| (c.intrinsics().width as usize, c.intrinsics().height as usize);
        let mut sizes: Vec<_> = cameras.iter().map(size).collect();
        sizes.sort_unstable();
        sizes.dedup();
        let photographs = UploadedPhotographs::new(gpu, pipeline.pixels())?;
        let loss = Loss::new(gpu, &sizes, ssim_weight, &loss_buffers(&pipeline, &backward, &photographs.shown, None))?;
        let (moments, moments_of) = (new_moments(gpu, &pipeline.front.splats)?, pipeline.front.splats.capacity);
        let adam = new_adam(gpu, &pipeline, &backward, &moments)?;
        let list_check = new_list_check(gpu, &pipeline, &backward.status);
        let rows = RowGather::new(gpu, sh_floats(&pipeline.front.splats))?;
        let (smoothing, exposures, poses, timer) = (None, None, None, None);
        Ok(Self {
            gpu,
            bound_to: pipeline.front.generation(),
            checks: pipeline.front.triangle_list_generation(),
            pipeline,
            backward,
            photographs,
            list_check,
            loss,
            adam,
            moments_of,
            most_splats,
            moments,
            rows,
            smoothing,
            exposures,
            poses,
            timer,
        })
    }

    /// Takes a training step: renders the view, differentiates the loss and updates the parameters. If lists were too
    /// short for the view, this step and those after it change nothing until [`Self::grow_if_short`] is called. Does
    /// not wait.
    pub(crate) fn step(&mut self, step: &Step) -> Result<(), GpuError> {
        self.pipeline.front.composition.background = step.background;
        let mut view = self.prepare(step.camera)?;
        view.sh_degree = step.sh_degree.min(view.sh_degree);
        view.band_degree = step.band_degree;
        view.dropout = step.dropout;
        view.disparity_weight = step.disparity_weight;
        if step.splats.is_none() {
            view.n_splats = 0;
        }
        let mut frame = match &mut self.timer {
            Some(timer) => Frame::timed(self.gpu, timer),
            None => Frame::new(self.gpu),
        };
        self.photographs.show(self.gpu, &mut frame, &step.truth);
        let pose = self.poses.as_mut().zip(step.pose).map(|(poses, step)| {
            poses.record_correction(self.gpu, &mut frame, &step);
            poses
        });
        self.pipeline.record(self.gpu, &mut frame, &view);
        self.list_check.record(&mut frame);
        let exposure = self.exposures.as_mut().zip(step.exposure);
        self.loss.set_truth(self.gpu, step.truth_alpha, exposure.as_ref().map_or(0, |(_, step)| step.view));
        self.loss.record(&mut frame);
        if let Some((exposures, exposed)) = exposure {
            exposures.record(self.gpu, &mut frame, &view, &exposed, (step.truth_alpha, step.splats.is_none()));
        }
        frame.split();
        self.backward.record(&mut frame, &self.pipeline, &view);
        if let (Some(_), Some(mesh)) = (&step.vertices, &self.pipeline.front.mesh) {
            mesh.record_vertex_backward(&mut frame);
        }
        if let Some(poses) = pose {
            poses.record_update(&mut frame);
        }
        if let Some(rates) = &step.splats {
            self.adam.set(self.gpu, rates);
            self.adam.record(&mut frame);
        }
        if let (Some(rates), Some(mesh)) = (&step.texels, &self.pipeline.front.mesh) {
            mesh.set_step(self.gpu, rates);
            mesh.record_adam(&mut frame);
        }
        if let (Some(step), Some(mesh)) = (&step.vertices, &self.pipeline.front.mesh) {
            mesh.record_vertex_step(self.gpu, &mut frame, step);
        }
        frame.submit();
        Ok(())
    }

    /// Keeps photographs that have a number on the adapter from now on, up to this many bytes, unless its memory is the
    /// host's.
    pub(crate) fn keep_photographs(&mut self, bytes: u64) {
        self.photographs.keep(if self.gpu.shares_host_memory() { 0 } else { bytes });
    }

    /// The photograph of this number, width and height, if it is kept on the adapter.
    pub(crate) fn kept_photograph(&self, number: usize, (width, height): (u32, u32)) -> Option<Arc<Buffer>> {
        self.photographs.kept(number, 4 * u64::from(width) * u64::from(height))
    }

    /// Enables exposures of photographs, optimised by `Step::exposure`, or replaces them by others of as many views.
    /// Every step must then name its view.
    pub(crate) fn expose(&mut self, state: &ExposureState) -> Result<(), GpuError> {
        if let Some(exposures) = &mut self.exposures {
            exposures.views.write(self.gpu, state);
            return Ok(());
        }
        let (pipeline, backward, truth) = (&self.pipeline, &self.backward, &self.photographs.shown);
        let mut exposures = Exposures::new(self.gpu, state, pipeline.pixels())?;
        exposures.bind(self.gpu, pipeline, backward, truth);
        self.loss.rebind(self.gpu, &loss_buffers(pipeline, backward, truth, Some(&exposures.views.values)));
        self.exposures = Some(exposures);
        Ok(())
    }

    /// Reads the exposures, if there are any. Waits.
    pub(crate) fn read_exposures(&self) -> Result<Option<ExposureState>, GpuError> {
        self.exposures.as_ref().map(|exposures| exposures.views.read(self.gpu)).transpose()
    }

    /// Enables corrections of the steps' cameras, optimised by `Step::pose`, or replaces them by others of as many
    /// views. Every step must then name its view. Meshes do not contribute to pose gradients.
    pub(crate) fn refine_poses(&mut self, state: &PoseState) -> Result<(), GpuError> {
        if let Some(poses) = &mut self.poses {
            poses.views.write(self.gpu, state);
            return Ok(());
        }
        self.backward.differentiate_poses(self.gpu, &self.pipeline)?;
        let mut poses = Poses::new(self.gpu, state)?;
        poses.bind(self.gpu, &self.pipeline, &self.backward);
        self.poses = Some(poses);
        Ok(())
    }

    /// Reads the corrections, if there are any. Waits.
    pub(crate) fn read_poses(&self) -> Result<Option<PoseState>, GpuError> {
        self.poses.as_ref().map(|poses| poses.views.read(self.gpu)).transpose()
    }

    /// Sets the training views for [`Self::smooth`], which smooths splats as far as these cannot tell.
    pub(crate) fn smooth_for(&mut self, cameras: &[Camera]) -> Result<(), GpuError> {
        self.smoothing = Some(Smoothing::new(self.gpu, cameras, self.pipeline.front.composition.near)?);
        Ok(())
    }

    /// Measures how far the splats are to be smoothed at their present positions; does nothing without
    /// [`Self::smooth_for`]. Does not wait.
    pub(crate) fn smooth(&self) {
        if let Some(smoothing) = &self.smoothing {
            smoothing.run(self.gpu, &self.pipeline.front.splats.geometry, self.pipeline.front.n_splats);
        }
    }

    /// Lets the vertices of `meshes`, those of the scene, move by `Step::vertices`.
    pub(crate) fn free_vertices(&mut self, meshes: &[Mesh], state: &VertexState) -> Result<(), GpuError> {
        let Front { mesh, view, .. } = &mut self.pipeline.front;
        let status = &self.backward.status;
        mesh.as_mut().map_or(Ok(()), |mesh| mesh.free_vertices(self.gpu, meshes, view, status, state))
    }

    /// Reads the meshes: moved vertices, trained maps. `meshes` are those of the scene. Waits.
    pub(crate) fn read_meshes(&self, meshes: &[Mesh]) -> Result<Vec<Mesh>, GpuError> {
        let Some(stage) = &self.pipeline.front.mesh else { return Ok(vec![]) };
        let count = meshes.iter().map(|m| m.positions().len()).sum();
        let mut positions = stage.read_positions(self.gpu, count)?.into_iter();
        let invalid = |e| GpuError::Failed { adapter: self.gpu.adapter().to_owned(), reason: format!("mesh {e}") };
        let moved = |(mesh, atlas): (&Mesh, Atlas)| {
            let positions = positions.by_ref().take(mesh.positions().len()).collect();
            Mesh::new(positions, mesh.triangles().to_vec(), mesh.corner_uvs().to_vec(), atlas).map_err(invalid)
        };
        meshes.iter().zip(stage.read_atlases(self.gpu)?).map(moved).collect()
    }

    /// Reads normals and moments of free vertices; empty if none are free. Waits.
    pub(crate) fn read_vertex_state(&self) -> Result<VertexState, GpuError> {
        let vertices = self.pipeline.front.mesh.as_ref().and_then(|m| m.vertices());
        vertices.map_or(Ok(VertexState::default()), |v| v.read_state(self.gpu))
    }

    /// Loss of the last step. Waits for it.
    #[cfg(test)]
    pub(crate) fn loss(&self) -> Result<LossValues, GpuError> {
        self.loss.read(self.gpu)
    }

    /// Reads the status of the steps so far. Waits for the last one.
    pub(crate) fn status(&self) -> Result<Status, GpuError> {
        Status::read(self.gpu, &self.backward.status)
    }

    /// Waits for the last step and enlarges lists that were too short for any so far. If [`Status::skipped`] is not 0,
    /// that many of the last steps changed nothing and are to be repeated, in the same order.
    pub(crate) fn look(&mut self) -> Result<Look, GpuError> {
        let (status, loss) = (Status::words(&self.backward.status), self.loss.means());
        let (words, means) = self.gpu.read_both::<u32, [f32; 2]>(status, loss)?;
        let look = Look { status: Status::of(&words), loss: LossValues::of(&means) };
        let Status { skipped, pairs: needed, .. } = look.status;
        self.exposures.iter_mut().for_each(|exposures| exposures.views.settle(skipped));
        self.poses.iter_mut().for_each(|poses| poses.views.settle(skipped));
        if skipped > 0 {
            let longer = self.pipeline.front.longer_lists(self.gpu, needed);
            self.lengthen_lists(longer)?;
            Status::forget_skipped(self.gpu, &self.backward.status);
        }
        Ok(look)
    }

    /// As [`Self::look`], returning only the number of steps to repeat.
    pub(crate) fn grow_if_short(&mut self) -> Result<u32, GpuError> {
        Ok(self.look()?.status.skipped)
    }

    /// As [`Pipeline::prepare`], binding everything to the pipeline's present buffers.
    fn prepare(&mut self, camera: &Camera) -> Result<View, GpuError> {
        let view = self.pipeline.prepare(self.gpu, camera)?;
        self.refresh()?;
        Ok(view)
    }

    /// Waits for a forward frame and enlarges lists that were too short for it; true if so.
    fn grow_after_frame(&mut self) -> Result<bool, GpuError> {
        let needed = self.pipeline.front.needed_lengths(self.gpu)?;
        let longer = self.pipeline.front.longer_lists(self.gpu, needed);
        self.lengthen_lists(longer)?;
        Ok(longer != [0; 2])
    }

    /// Enlarges the lists to at least the given `Front::list_lengths`. The old ones are freed first, so that both need
    /// not fit; their content is lost.
    pub(crate) fn lengthen_lists(&mut self, lengths: [usize; 2]) -> Result<(), GpuError> {
        if lengths[0] > self.list_lengths()[0] {
            self.pipeline.empty_lists(self.gpu)?;
            self.refresh()?;
            self.gpu.wait()?;
        }
        self.pipeline.lengthen_lists(self.gpu, lengths)?;
        self.refresh()
    }

    /// Replaces the moments by ones of the pipeline's present capacity, returning the old ones.
    fn replace_moments(&mut self, moments: [Buffer; 4]) -> [Buffer; 4] {
        self.moments_of = self.pipeline.front.splats.capacity;
        std::mem::replace(&mut self.moments, moments)
    }

    /// First and second moments of the maps, in one documented order. Waits.
    pub(crate) fn read_texel_moments(&self) -> Result<(Vec<f32>, Vec<f32>), GpuError> {
        self.pipeline.front.mesh.as_ref().map_or(Ok((vec![], vec![])), |m| m.read_moments(self.gpu))
    }

    /// Replaces the moments of the maps; false if their number is wrong.
    pub(crate) fn write_texel_moments(&self, first: &[f32], second: &[f32]) -> bool {
        match &self.pipeline.front.mesh {
            Some(mesh) => mesh.write_moments(self.gpu, first, second),
            None => first.is_empty() && second.is_empty(),
        }
    }

    /// Times every step from now on, if the adapter can.
    pub(crate) fn profile(&mut self) {
        self.timer = Timer::new(self.gpu);
    }

    /// Kernels of the last step and their seconds; empty if not profiled. Waits.
    pub(crate) fn seconds(&self) -> Result<Vec<(String, f64)>, GpuError> {
        self.timer.as_ref().map_or(Ok(vec![]), |t| t.seconds(self.gpu))
    }

    /// Binds all users of the pipeline's buffers to the present ones, if any was replaced, so that those of before are
    /// freed; moments of another capacity start at zero.
    fn refresh(&mut self) -> Result<(), GpuError> {
        let front = &self.pipeline.front;
        let (generation, triangles) = (front.generation(), front.triangle_list_generation());
        if self.bound_to != generation || self.checks != triangles {
            self.list_check = new_list_check(self.gpu, &self.pipeline, &self.backward.status);
            self.checks = triangles;
        }
        if self.bound_to == generation {
            return Ok(());
        }
        self.backward.renew(self.gpu, &self.pipeline)?;
        if let Some(poses) = &mut self.poses {
            poses.bind(self.gpu, &self.pipeline, &self.backward);
        }
        if self.moments_of != self.pipeline.front.splats.capacity {
            self.replace_moments(new_moments(self.gpu, &self.pipeline.front.splats)?);
        }
        self.adam = new_adam(self.gpu, &self.pipeline, &self.backward, &self.moments)?;
        self.bound_to = generation;
        Ok(())
    }
}

fn sh_floats(splats: &SplatBuffers) -> usize {
    3 * sh::coefficients(splats.sh_degree)
}

fn loss_buffers<'a>(
    pipeline: &'a Pipeline,
    backward: &'a Backward,
    truth: &'a Buffer,
    exposures: Option<&'a Buffer>,
) -> LossBuffers<'a> {
    LossBuffers {
        view: &pipeline.front.view,
        image: &pipeline.blend.image,
        truth,
        gradient: &backward.image_gradient,
        exposures,
    }
}

fn new_list_check(gpu: &Gpu, pipeline: &Pipeline, status: &Buffer) -> ListCheck {
    ListCheck::new(
        gpu,
        &pipeline.front.view,
        &pipeline.front.lists,
        pipeline.front.mesh.as_ref().map(MeshStage::pairs),
        status,
    )
}

fn new_moments(gpu: &Gpu, splats: &SplatBuffers) -> Result<[Buffer; 4], GpuError> {
    let (n, terms) = (splats.capacity, sh_floats(splats));
    Ok([
        gpu.storage("geometry moment 1", n * GEOMETRY_FLOATS)?,
        gpu.storage("geometry moment 2", n * GEOMETRY_FLOATS)?,
        gpu.storage("SH moment 1", n * terms)?,
        gpu.storage("SH moment 2", n * terms)?,
    ])
}

fn new_adam(gpu: &Gpu, pipeline: &Pipeline, backward: &Backward, moments: &[Buffer; 4]) -> Result<SplatAdam, GpuError> {
    let [geometry_m, geometry_v, sh_m, sh_v] = moments;
    let splats = &pipeline.front.splats;
    let buffers = AdamBuffers {
        parameters: SplatFloats { geometry: &splats.geometry, sh: &splats.sh },
        gradient: SplatFloats { geometry: &backward.splats.geometry, sh: &backward.splats.sh },
        moments: [SplatFloats { geometry: geometry_m, sh: sh_m }, SplatFloats { geometry: geometry_v, sh: sh_v }],
        visible: &pipeline.front.lists.visible,
        status: &backward.status,
    };
    SplatAdam::new(gpu, sh_floats(splats), &buffers)
}
