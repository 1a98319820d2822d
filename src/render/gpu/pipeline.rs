//! Forward pass of a frame, from parameters to the image: order of the stages, and their buffers. `backward` is the
//! backward pass.

use super::{
    blend::Blend,
    device::{Buffer, Frame, Gpu, GpuError, Stage},
    front::Front,
    picture::Picture,
    splats::{Purpose, SplatBuffers},
    view::View,
};
use crate::render::contract::ImageModel;
use crate::scene::{Camera, HybridScene};

/// Buffers and stages of one view's frame.
pub(crate) struct Pipeline {
    pub(crate) front: Front,
    pub(crate) blend: Blend,
    /// [`Front::generation`] that `blend` is bound to.
    bound_to: u64,
}

impl Pipeline {
    /// A pipeline for the scene, with room for `capacity` splats (at least those it has), seen by `cameras`. With a
    /// training's `status` it can be differentiated.
    pub(crate) fn new(
        gpu: &Gpu,
        scene: &HybridScene,
        capacity: usize,
        cameras: &[Camera],
        status: Option<&Buffer>,
    ) -> Result<Self, GpuError> {
        let purpose = if status.is_some() { Purpose::Train } else { Purpose::Render(ImageModel::Ewa) };
        let front = Front::new(gpu, scene, capacity, cameras, purpose, status)?;
        let blend = Blend::new(gpu, &front.lists, front.image, &front.view, front.layers())?;
        let bound_to = front.generation();
        Ok(Self { front, blend, bound_to })
    }

    /// As [`Front::prepare`].
    pub(crate) fn prepare(&mut self, gpu: &Gpu, camera: &Camera) -> Result<View, GpuError> {
        let view = self.front.prepare(gpu, camera)?;
        self.refresh(gpu);
        Ok(view)
    }

    /// Appends all stages from parameters to the image.
    pub(crate) fn record(&self, gpu: &Gpu, frame: &mut Frame, view: &View) {
        debug_assert_eq!(self.bound_to, self.front.generation(), "frames are prepared");
        self.front.record(gpu, frame, view);
        frame.split();
        self.blend.record(frame, view.n_tiles());
    }

    /// As [`Front::grow_if_short`].
    ///
    /// # Errors
    /// If the driver failed or the adapter cannot hold longer lists.
    pub(crate) fn grow_if_short(&mut self, gpu: &Gpu) -> Result<bool, GpuError> {
        let was_short = self.front.grow_if_short(gpu)?;
        self.refresh(gpu);
        Ok(was_short)
    }

    /// Pixels of the largest image.
    pub(crate) fn pixels(&self) -> usize {
        self.front.image.pixels
    }

    /// As [`Front::lengthen_lists`].
    ///
    /// # Errors
    /// If the adapter cannot hold them.
    pub(crate) fn lengthen_lists(&mut self, gpu: &Gpu, lengths: [usize; 2]) -> Result<(), GpuError> {
        self.front.lengthen_lists(gpu, lengths)?;
        self.refresh(gpu);
        Ok(())
    }

    /// As [`Front::replace_splats`].
    pub(crate) fn replace_splats(
        &mut self,
        gpu: &Gpu,
        splats: SplatBuffers,
        pairs: usize,
    ) -> Result<SplatBuffers, GpuError> {
        let before = self.front.replace_splats(gpu, splats, pairs)?;
        self.refresh(gpu);
        Ok(before)
    }

    /// As [`Front::empty_lists`].
    pub(crate) fn empty_lists(&mut self, gpu: &Gpu) -> Result<(), GpuError> {
        self.front.empty_lists(gpu)?;
        self.refresh(gpu);
        Ok(())
    }

    /// Binds the blend to the present buffers, if any was replaced, so that those of before are freed.
    fn refresh(&mut self, gpu: &Gpu) {
        let generation = self.front.generation();
        if self.bound_to != generation {
            self.blend.rebind(gpu, &self.front.lists, &self.front.view, self.front.layers());
            self.bound_to = generation;
        }
    }

    /// Reads the image of the last frame, which was of `camera`. Waits.
    pub(crate) fn read_picture(&self, gpu: &Gpu, camera: &Camera) -> Result<Picture, GpuError> {
        let k = camera.intrinsics();
        let words: Vec<[f32; 4]> = gpu.read(&self.blend.image, k.pixels())?;
        Ok(Picture {
            width: k.width,
            height: k.height,
            rgb: words.iter().map(|p| [p[0], p[1], p[2]]).collect(),
            transmittance: words.iter().map(|p| p[3]).collect(),
        })
    }

    /// Renders the median depth of the splats alone, `[h·w]`, 0 where there is none, for a view that the pipeline is
    /// prepared for; incomplete if lists were too short. Does not wait.
    ///
    /// # Errors
    /// If the adapter has no memory left.
    pub(crate) fn submit_median_depth(&self, gpu: &Gpu, view: &View) -> Result<Buffer, GpuError> {
        let depth = gpu.storage("median depth", view.pixels())?;
        let Front { view: uniform, splats, lists, .. } = &self.front;
        let buffers = [uniform, &lists.pairs.ranges, lists.pairs.splats(), &lists.projected, &depth, &splats.geometry];
        let blend = Stage::new(gpu, "blend_depth.wgsl", "main", &gpu.defines(), &buffers);
        let mut frame = Frame::new(gpu);
        self.front.record(gpu, &mut frame, view);
        frame.split();
        frame.dispatch(&blend, view.n_tiles());
        frame.submit();
        Ok(depth)
    }
}
