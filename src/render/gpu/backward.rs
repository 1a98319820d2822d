//! One frame from the gradient of the image back to those of the parameters.

use super::{
    blend::{BlendBackward, moments},
    device::{Buffer, Frame, Gpu, GpuError, Stage},
    front::Front,
    pipeline::Pipeline,
    splats::{GEOMETRY, with_sh},
    view::View,
};
use crate::scene::sh;

/// Gradients of the splats' parameters, and how they are found. Those of texels are the mesh stage's.
pub(crate) struct Backward {
    /// `[h·w]` vec4: ∂L/∂rgb of the image and by its disparity Σw/z, written by the loss.
    pub(crate) image_gradient: Buffer,
    /// What the run finds out about itself, see `status.rs`.
    pub(crate) status: Buffer,
    pub(crate) splats: SplatGradients,
    besides: Besides,
    blend: BlendBackward,
    /// `splat_backward.wgsl`
    of_splats: Stage,
}

/// Of `capacity` splats. Gradients of those that the last view does not see mean nothing.
pub(crate) struct SplatGradients {
    /// As `SplatBuffers::geometry`.
    pub(crate) geometry: Buffer,
    /// As `SplatBuffers::sh`.
    pub(crate) sh: Buffer,
    /// `[capacity]` vec4, see `splat_backward.wgsl`.
    pub(crate) statistics: Buffer,
    /// `[capacity]` vec4, see `splat_backward.wgsl`, with [`Backward::differentiate_poses`].
    pub(crate) turn: Option<Buffer>,
    capacity: usize,
}

/// What is found besides gradients of parameters.
#[derive(Clone, Copy, Default)]
struct Besides {
    /// The statistics hold absolute gradients.
    absolute: bool,
    /// Gradients by the pose.
    by_pose: bool,
}

impl Backward {
    /// Of a pipeline that was made with this `status`.
    ///
    /// # Errors
    /// If the adapter has no memory left.
    pub(crate) fn new(gpu: &Gpu, pipeline: &Pipeline, status: Buffer) -> Result<Self, GpuError> {
        let besides = Besides::default();
        let image_gradient = gpu.storage("image gradient", pipeline.pixels() * 4)?;
        let blend = blend_backward(gpu, pipeline, &image_gradient, besides)?;
        let splats = SplatGradients::new(gpu, pipeline, besides)?;
        let of_splats = of_splats(gpu, pipeline, &blend, &splats, &status, besides);
        Ok(Self { image_gradient, status, splats, besides, blend, of_splats })
    }

    /// Follows the pipeline to the buffers that it has now. Where it has room for another number of splats, all of theirs
    /// are new.
    ///
    /// # Errors
    /// If the adapter has no memory left.
    pub(crate) fn renew(&mut self, gpu: &Gpu, pipeline: &Pipeline) -> Result<(), GpuError> {
        self.blend = blend_backward(gpu, pipeline, &self.image_gradient, self.besides)?;
        if self.splats.capacity != pipeline.front.splats.capacity {
            self.splats = SplatGradients::new(gpu, pipeline, self.besides)?;
        }
        self.of_splats = of_splats(gpu, pipeline, &self.blend, &self.splats, &self.status, self.besides);
        Ok(())
    }

    /// From now on the statistics also hold absolute gradients, for AbsGS.
    ///
    /// # Errors
    /// If the adapter has no memory left.
    pub(crate) fn sum_absolute_gradients(&mut self, gpu: &Gpu, pipeline: &Pipeline) -> Result<(), GpuError> {
        self.besides.absolute = true;
        self.renew(gpu, pipeline)
    }

    /// From now on there are gradients by the pose of the camera, too, as far as splats depend on it.
    ///
    /// # Errors
    /// If the adapter has no memory left.
    pub(crate) fn differentiate_poses(&mut self, gpu: &Gpu, pipeline: &Pipeline) -> Result<(), GpuError> {
        self.besides.by_pose = true;
        self.splats.turn = turn_gradient(gpu, self.splats.capacity, self.besides)?;
        self.renew(gpu, pipeline)
    }

    /// Appends everything from the image gradient to parameter gradients.
    pub(crate) fn record(&self, frame: &mut Frame, pipeline: &Pipeline, view: &View) {
        self.record_blend(frame, view);
        frame.dispatch_threads(&self.of_splats, view.n_splats as usize);
        if let Some(mesh) = &pipeline.front.mesh {
            mesh.record_backward(frame);
        }
    }

    /// Appends only what leads from the image gradient to [`Self::moments`].
    pub(crate) fn record_blend(&self, frame: &mut Frame, view: &View) {
        self.blend.record(frame, view.n_tiles(), view.n_splats as usize);
    }

    /// Sums per splat that the blend found, and how many of each there are: `[capacity][that many]`. Those that the last view does not see
    /// keep what they had.
    pub(crate) fn moments(&self) -> (&Buffer, usize) {
        (&self.blend.moments, moments(self.besides.absolute))
    }
}

impl SplatGradients {
    fn new(gpu: &Gpu, pipeline: &Pipeline, besides: Besides) -> Result<Self, GpuError> {
        let capacity = pipeline.front.splats.capacity;
        Ok(Self {
            geometry: gpu.storage("geometry gradient", capacity * GEOMETRY)?,
            sh: gpu.storage("SH gradient", capacity * 3 * sh::coefficients(pipeline.front.splats.sh_degree))?,
            statistics: gpu.storage("density statistics", capacity * 4)?,
            turn: turn_gradient(gpu, capacity, besides)?,
            capacity,
        })
    }
}

fn turn_gradient(gpu: &Gpu, capacity: usize, besides: Besides) -> Result<Option<Buffer>, GpuError> {
    besides.by_pose.then(|| gpu.storage("rotation gradients", capacity * 4)).transpose()
}

fn blend_backward(
    gpu: &Gpu,
    pipeline: &Pipeline,
    image_gradient: &Buffer,
    besides: Besides,
) -> Result<BlendBackward, GpuError> {
    let Pipeline { front, blend } = pipeline;
    let Front { lists, view, splats, .. } = front;
    let sums = (splats.capacity, besides.absolute);
    BlendBackward::new(gpu, lists, blend, view, front.layers(), image_gradient, sums)
}

fn of_splats(
    gpu: &Gpu,
    pipeline: &Pipeline,
    blend: &BlendBackward,
    gradients: &SplatGradients,
    status: &Buffer,
    Besides { absolute, by_pose }: Besides,
) -> Stage {
    let Front { view, splats, lists, .. } = &pipeline.front;
    let defines = with_sh(gpu.defines(), splats.sh_degree)
        .with("MOMENTS", moments(absolute) as u32)
        .with("ABSOLUTE", u32::from(absolute))
        .with("POSES", u32::from(by_pose));
    let mut buffers = vec![
        view,
        &splats.geometry,
        &splats.sh,
        &lists.projected,
        &lists.visible,
        &blend.moments,
        &gradients.geometry,
        &gradients.sh,
        &gradients.statistics,
        status,
    ];
    buffers.extend(&gradients.turn);
    Stage::new(gpu, "splat_backward.wgsl", "main", &defines, &buffers)
}
