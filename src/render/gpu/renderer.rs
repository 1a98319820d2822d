//! Renderer of finished scenes.

use super::{
    device::{Frame, Gpu, GpuError},
    picture::Picture,
    pipeline::Pipeline,
    unit::Unit,
};
use crate::scene::{Camera, HybridScene};

/// Renderer of a scene, with the scene on the GPU.
pub struct Renderer<'g> {
    gpu: &'g Gpu,
    unit: Unit,
    pipeline: Pipeline,
}

impl<'g> Renderer<'g> {
    /// Uploads the scene and makes room for pictures up to the sizes of `cameras`. Very small and very large scenes are
    /// rendered in another unit of length, which their distance from `cameras` decides.
    ///
    /// # Errors
    /// If the adapter cannot hold the scene, or its composition is not valid.
    pub fn new(gpu: &'g Gpu, scene: &HybridScene, cameras: &[Camera]) -> Result<Self, GpuError> {
        scene.composition.validate().map_err(GpuError::Scene)?;
        let unit = Unit::of(scene, cameras);
        let scene = unit.scene(scene).map_err(GpuError::Scene)?;
        Ok(Self { gpu, unit, pipeline: Pipeline::new(gpu, &scene, 0, cameras, None)? })
    }

    /// Renders one picture and waits for it.
    ///
    /// # Errors
    /// If the image is larger than announced, the driver fails or the adapter runs short of memory.
    pub fn render(&mut self, camera: &Camera) -> Result<Picture, GpuError> {
        self.pipeline.front.image.check(camera)?;
        loop {
            self.submit(camera)?;
            if !self.pipeline.grow_if_short(self.gpu)? {
                break;
            }
        }
        self.pipeline.read_picture(self.gpu, camera)
    }

    /// Median depth of the splats alone, `[h·w]`, 0 where there is none. Waits.
    pub(crate) fn median_depth(&mut self, camera: &Camera) -> Result<Vec<f32>, GpuError> {
        self.pipeline.front.image.check(camera)?;
        loop {
            let view = self.pipeline.prepare(self.gpu, &self.unit.camera(camera))?;
            let depth = self.pipeline.submit_median_depth(self.gpu, &view)?;
            if !self.pipeline.grow_if_short(self.gpu)? {
                return Ok(self.unit.in_world(self.gpu.read(&depth, view.pixels())?));
            }
        }
    }

    /// Mean seconds per frame over `frames` renderings of `camera` without read-back, after one to warm up.
    ///
    /// # Errors
    /// As [`Renderer::render`].
    pub fn seconds_per_frame(&mut self, camera: &Camera, frames: u32) -> Result<f64, GpuError> {
        self.render(camera)?;
        let start = std::time::Instant::now();
        for _ in 0..frames.max(1) {
            self.submit(camera)?;
        }
        // Waits, and unlike a wait finds out about aborted work.
        self.pipeline.front.lists.read_counts(self.gpu)?;
        Ok(start.elapsed().as_secs_f64() / f64::from(frames.max(1)))
    }

    fn submit(&mut self, camera: &Camera) -> Result<(), GpuError> {
        let view = self.pipeline.prepare(self.gpu, &self.unit.camera(camera))?;
        let mut frame = Frame::new(self.gpu);
        self.pipeline.record(self.gpu, &mut frame, &view);
        frame.submit();
        Ok(())
    }
}
