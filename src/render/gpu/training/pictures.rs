//! Pictures of the present state of a training, and sums over them.

use super::{Show, Training};
use crate::{
    render::gpu::{
        device::{Frame, GpuError},
        picture::Picture,
    },
    scene::Camera,
};

impl Training<'_> {
    /// Renders a view of the present state. Waits.
    pub(crate) fn render(&mut self, camera: &Camera, background: [f32; 3], show: Show) -> Result<Picture, GpuError> {
        self.pipeline.front.composition.background = background;
        loop {
            let view = show.of(self.prepare(camera)?);
            let mut frame = Frame::new(self.gpu);
            self.pipeline.record(self.gpu, &mut frame, &view);
            frame.submit();
            if !self.grow_after_frame()? {
                return self.pipeline.read_picture(self.gpu, camera);
            }
        }
    }

    /// Sums a picture over the footprint of every splat: Σ w·`values` (3) and Σ w, where w is the splat's blend weight
    /// at a pixel. `values` is `[h·w]`; the result `[N]`. Waits.
    pub(crate) fn gather(
        &mut self,
        camera: &Camera,
        values: &[[f32; 3]],
        show: Show,
    ) -> Result<Vec<[f32; 4]>, GpuError> {
        let padded: Vec<[f32; 4]> = values.iter().map(|v| [v[0], v[1], v[2], 0.0]).collect();
        loop {
            let view = show.of(self.prepare(camera)?);
            self.gpu.write(&self.backward.image_gradient, 0, &padded);
            let mut frame = Frame::new(self.gpu);
            // Splats out of view would otherwise keep sums of another view.
            frame.clear(self.backward.sums().0);
            self.pipeline.record(self.gpu, &mut frame, &view);
            frame.split();
            self.backward.record_blend(&mut frame, &view);
            frame.submit();
            if !self.grow_after_frame()? {
                break;
            }
        }
        let (sums, row) = self.backward.sums();
        let rows: Vec<f32> = self.gpu.read(sums, self.pipeline.front.n_splats * row)?;
        Ok(rows.chunks_exact(row).map(|s| [s[6], s[7], s[8], s[9]]).collect())
    }

    /// Median depth of the splats alone, `[h·w]`, 0 where there is none. Waits.
    pub(crate) fn median_depth(&mut self, camera: &Camera) -> Result<Vec<f32>, GpuError> {
        loop {
            let view = self.prepare(camera)?;
            let depth = self.pipeline.submit_median_depth(self.gpu, &view)?;
            if !self.grow_after_frame()? {
                return self.gpu.read(&depth, view.pixels());
            }
        }
    }

    /// Index + 1 of the nearest triangle at each pixel of the last rendered view, `[h·w]`; 0 where there is none; empty
    /// without meshes. Waits.
    pub(crate) fn front_triangles(&self, camera: &Camera) -> Result<Vec<u32>, GpuError> {
        let pixels = camera.intrinsics().pixels();
        self.pipeline.front.mesh.as_ref().map_or(Ok(vec![]), |m| m.read_front_triangles(self.gpu, pixels))
    }
}
