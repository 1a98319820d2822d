//! Measurement of how far splats are smoothed during training (`shaders/filter_splats.wgsl`).

use super::device::{Buffer, Frame, Gpu, GpuError, Kernel};
use crate::scene::Camera;

/// Words per view.
const VIEW: usize = 20;
/// Margin around the image, relative to its size, within which means count as seen (Mip-Splatting's
/// `scene/gaussian_model.py`).
const MARGIN: f64 = 0.15;

/// Mip-Splatting's 3-D filter for the training views.
pub(crate) struct Smoothing {
    measure: Kernel,
    complete: Kernel,
    uniform: Buffer,
    views: Buffer,
    largest: Buffer,
    n_views: usize,
    near: f32,
}

impl Smoothing {
    /// Filter for these views, which see nothing nearer than depth `near`.
    ///
    /// # Errors
    /// If the adapter has no memory left.
    pub(crate) fn new(gpu: &Gpu, cameras: &[Camera], near: f32) -> Result<Self, GpuError> {
        let words: Vec<f32> = cameras.iter().flat_map(view_words).collect();
        let kernel = |entry| Kernel::new(gpu, "filter_splats.wgsl", entry, &gpu.defines());
        Ok(Self {
            measure: kernel("measure"),
            complete: kernel("complete"),
            uniform: gpu.uniform("smoothing", 4)?,
            views: gpu.storage_with("training views", if words.is_empty() { &[0.0; VIEW] } else { &words })?,
            largest: gpu.storage("largest deviation", 1)?,
            n_views: cameras.len(),
            near,
        })
    }

    /// Sets the smoothing deviations of the first `n_splats` splats of a geometry buffer. Does not wait.
    pub(crate) fn run(&self, gpu: &Gpu, geometry: &Buffer, n_splats: usize) {
        gpu.write(&self.uniform, 0, &[n_splats as u32, self.n_views as u32, self.near.to_bits(), 0]);
        let mut frame = Frame::new(gpu);
        frame.clear(&self.largest);
        for kernel in [&self.measure, &self.complete] {
            let buffers = [&self.uniform, &self.views, geometry, &self.largest];
            frame.dispatch_threads(&kernel.bind(gpu, &buffers), n_splats);
        }
        frame.submit();
    }
}

/// Words of `TrainingView` in the shader.
fn view_words(camera: &Camera) -> [f32; VIEW] {
    let (k, r, t) = (camera.intrinsics(), camera.rotation(), camera.translation());
    let row = |i: usize| [r.row(i).x, r.row(i).y, r.row(i).z, t[i]];
    let [w, h] = k.size().to_array();
    let low = [(-MARGIN * w - k.cx) / k.fx, (-MARGIN * h - k.cy) / k.fy];
    let high = [((1.0 + MARGIN) * w - k.cx) / k.fx, ((1.0 + MARGIN) * h - k.cy) / k.fy];
    let rest = [low[0], low[1], high[0], high[1], k.fx.max(k.fy), 0.0, 0.0, 0.0];
    let mut words = [0.0; VIEW];
    for (word, value) in words.iter_mut().zip([row(0), row(1), row(2)].concat().into_iter().chain(rest)) {
        *word = value as f32;
    }
    words
}

#[cfg(test)]
mod tests {
    use glam::{DMat3, DVec3, Vec3};

    use super::*;
    use crate::render::gpu::splats::SplatBuffers;
    use crate::scene::{Intrinsics, testing::alike};

    /// A camera at (0, 0, −`distance`) that looks along +z.
    fn camera(distance: f64, focal: f64) -> Camera {
        let k = Intrinsics { width: 100, height: 80, fx: focal, fy: 0.5 * focal, cx: 40.0, cy: 40.0 };
        Camera::new(k, DMat3::IDENTITY, DVec3::new(0.0, 0.0, distance)).unwrap()
    }

    #[test]
    fn the_finest_view_that_sees_a_splat_decides() {
        let gpu = Gpu::open(None).unwrap();
        let smoothing = Smoothing::new(&gpu, &[camera(4.0, 100.0), camera(1.0, 50.0)], 0.2).unwrap();
        // In the middle of both; far to the right of the second; visible in none; behind the second; at the border of
        // the second's margin, 0.15·100 px beyond its right side, and just beyond.
        let edge = (115.0 - 40.0) / 50.0;
        let means = [
            [0.0, 0.0, 1.0],
            [2.5, 0.0, 0.0],
            [0.0, 99.0, 1.0],
            [0.0, 0.0, -2.0],
            [2.0 * edge - 1e-4, 0.0, 1.0],
            [2.0 * edge + 1e-4, 0.0, 1.0],
        ];
        let n = means.len();
        let splats = alike(means.map(Vec3::from).to_vec(), 0.0, 0.0, [0.0; 3]);
        let buffers = SplatBuffers::new(&gpu, n, 0).unwrap();
        buffers.write(&gpu, &splats);
        smoothing.run(&gpu, &buffers.geometry, n);
        let geometry: Vec<f32> = gpu.read(&buffers.geometry, 12 * n).unwrap();
        // Depth divided by focal length, for the finer of the views that see the splat.
        let pixel = [2.0 / 50.0, 4.0 / 100.0, 5.0 / 100.0, 2.0 / 100.0, 2.0 / 50.0, 5.0 / 100.0];
        for (i, pixel) in pixel.into_iter().enumerate() {
            let found = geometry[12 * i + 11];
            assert!((found / (0.2_f32.sqrt() * pixel) - 1.0).abs() < 1e-5, "splat {i}: {found}, pixel {pixel}");
            assert_eq!(geometry[12 * i..][..3], means[i], "the rest stays");
        }
    }
}
