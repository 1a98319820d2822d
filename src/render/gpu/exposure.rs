//! Exposures of photographs during training (`shaders/exposure.wgsl`).

use glam::{Mat3, Vec3};

use super::{
    adam,
    backward::Backward,
    device::{Buffer, Frame, Gpu, GpuError, Kernel, Stage, groups},
    loss::TruthAlpha,
    per_view::{PerView, PerViewBuffers},
    pipeline::Pipeline,
    view::View,
};

/// Pixels per thread of `pull`, and per workgroup.
const PER_THREAD: usize = 16;
const PIXELS: usize = 256 * PER_THREAD;
/// Floats per matrix.
pub(crate) const FLOATS: usize = 12;
/// The identity matrix, by rows.
const IDENTITY: [f32; FLOATS] = [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0];

/// Exposures: a 3×4 matrix per view, by rows, that maps the rendered (r, g, b, 1) to the photograph's colour.
pub(crate) type ExposureState = PerView<FLOATS>;

impl ExposureState {
    /// Identity exposures.
    pub(crate) fn new(views: usize) -> Self {
        Self::beginning_at(IDENTITY, views)
    }

    /// The matrix of a view, by rows.
    pub(crate) fn of(&self, view: usize) -> [f32; FLOATS] {
        self.values[FLOATS * view..].first_chunk().copied().unwrap_or(IDENTITY)
    }

    /// Rendered colour after a view's exposure.
    pub(crate) fn apply(&self, view: usize, [r, g, b]: [f32; 3]) -> [f32; 3] {
        let e = self.of(view);
        [0, 4, 8].map(|row| e[row] * r + e[row + 1] * g + e[row + 2] * b + e[row + 3])
    }

    /// Rendered colour of which a view's exposure makes `rgb`; `rgb` itself if the matrix cannot be inverted.
    pub(crate) fn undo(&self, view: usize, rgb: [f32; 3]) -> [f32; 3] {
        let e = self.of(view);
        let columns = [0, 1, 2].map(|c| Vec3::new(e[c], e[4 + c], e[8 + c]));
        let matrix = Mat3::from_cols(columns[0], columns[1], columns[2]);
        let undone = matrix.inverse() * (Vec3::from(rgb) - Vec3::new(e[3], e[7], e[11]));
        if undone.is_finite() { undone.into() } else { rgb }
    }

    /// Shifts the matrices so that their mean over `views` is the identity: what all photographs have in common belongs
    /// to the scene.
    pub(crate) fn center(&mut self, views: &[usize]) {
        for (float, identity) in IDENTITY.iter().enumerate() {
            let sum: f64 = views.iter().map(|view| f64::from(self.values[FLOATS * view + float])).sum();
            let excess = (sum / views.len().max(1) as f64) as f32 - identity;
            views.iter().for_each(|view| self.values[FLOATS * view + float] -= excess);
        }
    }
}

/// Exposure step of a training step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct ExposureStep {
    /// View of the photograph.
    pub(crate) view: usize,
    /// Learning rate; 0 leaves the exposure as it is.
    pub(crate) rate: f32,
}

/// Exposures of all views, and their stages between loss and blend.
pub(crate) struct Exposures {
    /// Kernels `pull` and `update`.
    kernels: [Kernel; 2],
    uniform: Buffer,
    pub(super) views: PerViewBuffers<FLOATS>,
    partial: Buffer,
    stages: Option<[Stage; 2]>,
}

impl Exposures {
    /// Exposures for pictures of at most `pixels` pixels.
    ///
    /// # Errors
    /// If the adapter has no memory left.
    pub(crate) fn new(gpu: &Gpu, state: &ExposureState, pixels: usize) -> Result<Self, GpuError> {
        let defines = adam::defines(gpu).with("PER_THREAD", PER_THREAD as u32);
        Ok(Self {
            kernels: ["pull", "update"].map(|entry| Kernel::new(gpu, "exposure.wgsl", entry, &defines)),
            uniform: gpu.uniform("exposure step", 8)?,
            views: PerViewBuffers::new(gpu, "exposures", state)?,
            partial: gpu.storage("exposure gradients", FLOATS * groups(pixels, PIXELS))?,
            stages: None,
        })
    }

    /// Binds to the buffers of a pipeline and its backward pass, and to the photograph that the loss reads.
    pub(crate) fn bind(&mut self, gpu: &Gpu, pipeline: &Pipeline, backward: &Backward, truth: &Buffer) {
        let images = [&pipeline.blend.image, &backward.image_gradient, truth];
        self.bind_images(gpu, images, &pipeline.front.view, &backward.status);
    }

    /// Binds what is rendered, the gradient and the photograph.
    fn bind_images(&mut self, gpu: &Gpu, [image, gradient, truth]: [&Buffer; 3], view: &Buffer, status: &Buffer) {
        let Self { uniform, partial, views, .. } = &*self;
        let [first, second] = &views.moments;
        let buffers = [view, uniform, image, gradient, &views.values, first, second, partial, status, truth];
        self.stages = Some(self.kernels.each_ref().map(|kernel| kernel.bind(gpu, &buffers)));
    }

    /// Appends the conversion of the gradient of the exposed picture to that of the rendered one, and a step of the
    /// view's exposure. `alpha` is the meaning of the photograph's. If the picture is of meshes alone (`is_partial`),
    /// the exposure learns of what they cover.
    pub(crate) fn record(
        &mut self,
        gpu: &Gpu,
        frame: &mut Frame,
        view: &View,
        step: &ExposureStep,
        (alpha, is_partial): (TruthAlpha, bool),
    ) {
        let Some([pull, update]) = &self.stages else { return };
        let [first, second] = self.views.count(step.view, step.rate != 0.0);
        let n = groups(view.pixels(), PIXELS);
        let is_composite = f32::from(u8::from(alpha == TruthAlpha::Composite)).to_bits();
        let is_partial = u32::from(is_partial);
        let words = [step.view as u32, n as u32, step.rate.to_bits(), first, second, is_composite, is_partial, 0];
        gpu.write(&self.uniform, 0, &words);
        frame.dispatch(pull, n);
        frame.dispatch(update, 1);
    }
}

#[cfg(test)]
mod tests {
    use glam::{DMat3, DVec3};

    use super::*;
    use crate::{
        render::gpu::{status::status_buffer, view::VIEW_WORDS},
        scene::{Camera, Composition, Intrinsics},
    };

    /// More partial gradients than threads that sum them, for a picture whose brightness and gradient increase towards
    /// its end.
    #[test]
    fn all_of_a_large_picture_pulls() {
        let (width, height) = (1100, 1000);
        let k = Intrinsics { width, height, fx: 1000.0, fy: 1000.0, cx: 550.0, cy: 500.0 };
        let view = View::of(&Camera::new(k, DMat3::IDENTITY, DVec3::ZERO).unwrap(), Composition::default());
        let pixels = view.pixels();
        assert!(groups(pixels, PIXELS) > 256);
        // Value of channel c of pixel p.
        let value = |p: usize, c: usize| (p % 97 + 31 * c) as f32 / 200.0 + p as f32 / pixels as f32;
        let image: Vec<[f32; 4]> = (0..pixels).map(|p| [value(p, 0), value(p, 1), value(p, 2), 0.0]).collect();
        let slopes: Vec<[f32; 4]> =
            image.iter().map(|[r, g, b, _]| [*b, *g, *r, 0.0].map(|v| v / pixels as f32)).collect();

        let gpu = Gpu::open(None).unwrap();
        let uniform = gpu.uniform("view", VIEW_WORDS).unwrap();
        gpu.write(&uniform, 0, &view.words());
        let images = [
            gpu.storage_with("image", &image).unwrap(),
            gpu.storage_with("gradient", &slopes).unwrap(),
            gpu.storage("truth", pixels).unwrap(),
        ];
        let mut exposures = Exposures::new(&gpu, &ExposureState::new(1), pixels).unwrap();
        exposures.bind_images(&gpu, images.each_ref(), &uniform, &status_buffer(&gpu).unwrap());
        let mut frame = Frame::new(&gpu);
        let step = ExposureStep { view: 0, rate: 1e-3 };
        exposures.record(&gpu, &mut frame, &view, &step, (TruthAlpha::Ignore, false));
        frame.submit();

        let [first, _] = exposures.views.read(&gpu).unwrap().moments;
        for (i, moment) in first.into_iter().enumerate() {
            let (row, column) = (i / 4, i % 4);
            let seen = |rgb: &[f32; 4]| if column < 3 { f64::from(rgb[column]) } else { 1.0 };
            let expected: f64 = image.iter().zip(&slopes).map(|(rgb, g)| f64::from(g[row]) * seen(rgb)).sum();
            // Adam's first moment after the first step is a tenth of the gradient.
            let found = 10.0 * f64::from(moment);
            assert!((found / expected - 1.0).abs() < 1e-5, "{i}: {found}, not {expected}");
        }
    }
}
