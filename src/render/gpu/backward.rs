//! Backward pass of a frame: from the gradient of the image to those of the parameters.

use super::{
    blend::{BlendBackward, sums_each},
    device::{Buffer, Frame, Gpu, GpuError, Stage},
    front::Front,
    geometry::GEOMETRY_FLOATS,
    pipeline::Pipeline,
    splats::with_sh,
    view::View,
};
use crate::scene::sh;

/// Gradients of the splats' parameters, and the stages that compute them. Gradients of texels belong to the mesh stage.
pub(crate) struct Backward {
    /// Gradients of the loss, `[h·w]` vec4: by the image's rgb, and by its disparity Σw/z; written by the loss.
    pub(crate) image_gradient: Buffer,
    /// Status of training steps, see `status.rs`.
    pub(crate) status: Buffer,
    pub(crate) splats: SplatGradients,
    besides: Besides,
    blend: BlendBackward,
    /// Stage `splat_backward.wgsl`.
    of_splats: Stage,
}

/// Gradients of `capacity` splats. Those of splats that the last view does not see are undefined.
pub(crate) struct SplatGradients {
    /// Laid out as `SplatBuffers::geometry`.
    pub(crate) geometry: Buffer,
    /// Laid out as `SplatBuffers::sh`.
    pub(crate) sh: Buffer,
    /// Density statistics, `[capacity]` vec4, see `splat_backward.wgsl`.
    pub(crate) statistics: Buffer,
    /// Each splat's part of the gradient by the camera's rotation, `[capacity]` vec4, see `splat_backward.wgsl`; only
    /// with [`Backward::differentiate_poses`].
    pub(crate) turn: Option<Buffer>,
    capacity: usize,
}

/// Optional outputs besides gradients of parameters.
#[derive(Clone, Copy)]
struct Besides {
    /// Whether the statistics include absolute gradients.
    absolute: bool,
    /// Whether there are gradients by the pose.
    by_pose: bool,
}

impl Backward {
    /// Backward pass of a pipeline that was made with this `status`; with `absolute` gradients in the statistics, for
    /// AbsGS.
    ///
    /// # Errors
    /// If the adapter has no memory left.
    pub(crate) fn new(gpu: &Gpu, pipeline: &Pipeline, status: Buffer, absolute: bool) -> Result<Self, GpuError> {
        let besides = Besides { absolute, by_pose: false };
        let image_gradient = gpu.storage("image gradient", pipeline.pixels() * 4)?;
        let blend = blend_backward(gpu, pipeline, &image_gradient, besides)?;
        let splats = SplatGradients::new(gpu, pipeline, besides)?;
        let of_splats = of_splats(gpu, pipeline, &blend, &splats, &status, besides);
        Ok(Self { image_gradient, status, splats, besides, blend, of_splats })
    }

    /// Rebinds to the pipeline's present buffers. If it has room for another number of splats, the gradients are
    /// allocated anew.
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

    /// Enables gradients by the pose of the camera, through splats only.
    ///
    /// # Errors
    /// If the adapter has no memory left.
    pub(crate) fn differentiate_poses(&mut self, gpu: &Gpu, pipeline: &Pipeline) -> Result<(), GpuError> {
        self.besides.by_pose = true;
        self.splats.turn = turn_gradient(gpu, self.splats.capacity, self.besides)?;
        self.of_splats = of_splats(gpu, pipeline, &self.blend, &self.splats, &self.status, self.besides);
        Ok(())
    }

    /// Appends the whole pass, from the image gradient to parameter gradients.
    pub(crate) fn record(&self, frame: &mut Frame, pipeline: &Pipeline, view: &View) {
        self.record_blend(frame, view);
        frame.split();
        frame.dispatch_threads(&self.of_splats, view.n_splats as usize);
        if let Some(mesh) = &pipeline.front.mesh {
            mesh.record_backward(frame);
        }
    }

    /// Appends only the part from the image gradient to [`Self::sums`].
    pub(crate) fn record_blend(&self, frame: &mut Frame, view: &View) {
        self.blend.record(frame, view.n_tiles(), view.n_splats as usize);
    }

    /// Sums per splat from the blend, and their number: `[capacity][number]`. Rows of splats that the last view does
    /// not see are stale.
    pub(crate) fn sums(&self) -> (&Buffer, usize) {
        (&self.blend.sums, sums_each(self.besides.absolute))
    }
}

impl SplatGradients {
    fn new(gpu: &Gpu, pipeline: &Pipeline, besides: Besides) -> Result<Self, GpuError> {
        let capacity = pipeline.front.splats.capacity;
        Ok(Self {
            geometry: gpu.storage("geometry gradient", capacity * GEOMETRY_FLOATS)?,
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
    let Pipeline { front, blend, .. } = pipeline;
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
        .with("SUMS", sums_each(absolute) as u32)
        .with("ABSOLUTE", u32::from(absolute))
        .with("POSES", u32::from(by_pose));
    let mut buffers = vec![
        view,
        &splats.geometry,
        &splats.sh,
        &lists.projected,
        &lists.visible,
        &blend.sums,
        &gradients.geometry,
        &gradients.sh,
        &gradients.statistics,
        status,
    ];
    buffers.extend(&gradients.turn);
    Stage::new(gpu, "splat_backward.wgsl", "main", &defines, &buffers)
}
