//! Photometric loss of a rendered image and its gradient (`shaders/loss.wgsl`, `shaders/loss_serial.wgsl` on software
//! adapters).

use super::device::{Buffer, Frame, Gpu, GpuError, Stage, groups};

/// Division of an image among threads: each tile of a channel has a mean of its own.
struct Tiling {
    file: &'static str,
    /// Size of a tile, pixels.
    width: usize,
    height: usize,
    /// Whether a thread, rather than a workgroup, takes a tile.
    by_threads: bool,
}

const PARALLEL: Tiling = Tiling { file: "loss.wgsl", width: 16, height: 40, by_threads: false };
const SERIAL: Tiling = Tiling { file: "loss_serial.wgsl", width: 8, height: 64, by_threads: true };

/// Meaning of the truth's alpha channel.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) enum TruthAlpha {
    /// No meaning: the truth is opaque.
    #[default]
    Ignore,
    /// The truth is composited over the view's background.
    Composite,
    /// Weight of the pixel: both images are multiplied by it.
    Mask,
}

/// The loss of one image is `(1 − w)·l1 + w·(1 − ssim)`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct LossValues {
    /// Mean absolute difference over pixels and channels.
    pub(crate) l1: f64,
    /// Mean SSIM over pixels and channels.
    pub(crate) ssim: f64,
}

impl LossValues {
    /// Values from the per-tile means of [`Loss::means`].
    pub(crate) fn of(means: &[[f32; 2]]) -> Self {
        let sum = |i: usize| means.iter().map(|mean| f64::from(mean[i])).sum();
        Self { l1: sum(1), ssim: sum(0) }
    }
}

/// Buffers that the loss reads and writes.
pub(crate) struct LossBuffers<'a> {
    /// The view's uniform.
    pub(crate) view: &'a Buffer,
    /// `array<vec4f>` `[h·w]`, rgb and final transmittance.
    pub(crate) image: &'a Buffer,
    /// `array<u32>` `[h·w]`, RGBA8 with r in the low byte, alpha not premultiplied.
    pub(crate) truth: &'a Buffer,
    /// `array<vec4f>` `[h·w]`, receives ∂L/∂rgb and the slope by the pixel's disparity; with exposures rgb is what
    /// these make of the image.
    pub(crate) gradient: &'a Buffer,
    /// `array<vec4f>` `[V·3]`, see `exposure.wgsl`.
    pub(crate) exposures: Option<&'a Buffer>,
}

/// Photometric loss L1 + D-SSIM (Kerbl et al. 2023, eq. 7).
pub(crate) struct Loss {
    forward: Stage,
    backward: Stage,
    /// Derivatives of SSIM, `[3][pixel]` vec4.
    slopes: Buffer,
    means: Buffer,
    weights: Buffer,
    ssim_weight: f32,
    n_tiles: usize,
    tiling: Tiling,
}

impl Loss {
    /// Stages for views of these sizes (width, height), pixels, and smaller ones of the same shape: the size of a
    /// frame's image is the one in the view's uniform.
    ///
    /// # Errors
    /// If the adapter cannot hold the intermediate maps (48 bytes per pixel).
    pub(crate) fn new(
        gpu: &Gpu,
        sizes: &[(usize, usize)],
        ssim_weight: f32,
        buffers: &LossBuffers,
    ) -> Result<Self, GpuError> {
        let tiling = if gpu.profile().is_cpu { SERIAL } else { PARALLEL };
        let tiles = |&(w, h): &(usize, usize)| 3 * groups(w, tiling.width) * groups(h, tiling.height);
        let n_tiles = sizes.iter().map(tiles).max().unwrap_or(0);
        let pixels = sizes.iter().map(|&(w, h)| w * h).max().unwrap_or(0);
        let weights = gpu.uniform("loss weights", 4)?;
        let slopes = gpu.storage("SSIM slopes", 12 * pixels)?;
        let means = gpu.storage("loss means", 2 * n_tiles)?;
        let [forward, backward] = stages(gpu, &tiling, buffers, [&weights, &slopes, &means]);
        let loss = Self { forward, backward, slopes, means, weights, ssim_weight, n_tiles, tiling };
        loss.set_truth(gpu, TruthAlpha::Ignore, 0);
        Ok(loss)
    }

    /// Reads and writes these buffers from now on, of views of the same sizes.
    pub(crate) fn rebind(&mut self, gpu: &Gpu, buffers: &LossBuffers) {
        let own = [&self.weights, &self.slopes, &self.means];
        [self.forward, self.backward] = stages(gpu, &self.tiling, buffers, own);
    }

    /// Sets the meaning of alpha in frames from now on, and, with exposures, the view whose exposure applies. The
    /// shader composites the truth over the background where the third weight is 1, and weights both images by its
    /// alpha where the fourth is.
    pub(crate) fn set_truth(&self, gpu: &Gpu, alpha: TruthAlpha, view: usize) {
        let is = |wanted: TruthAlpha| f32::from(u8::from(alpha == wanted));
        let weights = [self.ssim_weight, view as f32, is(TruthAlpha::Composite), is(TruthAlpha::Mask)];
        gpu.write(&self.weights, 0, &weights);
    }

    /// Appends loss and gradient to a frame.
    pub(crate) fn record(&self, frame: &mut Frame) {
        let take = if self.tiling.by_threads { Frame::dispatch_threads } else { Frame::dispatch };
        take(frame, &self.forward, self.n_tiles);
        take(frame, &self.backward, self.n_tiles);
    }

    /// Per-tile means of the last frame, for [`LossValues::of`], and their number.
    pub(crate) fn means(&self) -> (&Buffer, usize) {
        (&self.means, self.n_tiles)
    }

    /// The values of the last frame. Waits for it.
    ///
    /// # Errors
    /// If the driver failed.
    #[cfg(test)]
    pub(crate) fn read(&self, gpu: &Gpu) -> Result<LossValues, GpuError> {
        Ok(LossValues::of(&gpu.read::<[f32; 2]>(&self.means, self.n_tiles)?))
    }
}

/// Stages `forward` and `backward`.
fn stages(gpu: &Gpu, tiling: &Tiling, buffers: &LossBuffers, [weights, slopes, means]: [&Buffer; 3]) -> [Stage; 2] {
    let &LossBuffers { view, image, truth, gradient, exposures } = buffers;
    let defines = (gpu.defines().with("EXPOSURE", u32::from(exposures.is_some())))
        .with("WIDTH", tiling.width as u32)
        .with("HEIGHT", tiling.height as u32);
    let mut buffers = vec![view, weights, image, truth, slopes, gradient, means];
    buffers.extend(exposures);
    ["forward", "backward"].map(|entry| Stage::new(gpu, tiling.file, entry, &defines, &buffers))
}

#[cfg(test)]
pub(super) mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg32;

    use super::*;
    use crate::render::{gpu::view::VIEW_WORDS, testing};

    const BACKGROUND: [f32; 3] = [0.9, 0.4, 0.1];
    /// Derivative of the loss by the disparity of a pixel that matches its photograph.
    const SLOPE: f32 = 3.0;
    const SSIM_WEIGHT: f32 = 0.2;

    struct Images {
        size: [usize; 2],
        image: Vec<[f32; 4]>,
        truth: Vec<[u8; 4]>,
        alpha: TruthAlpha,
    }

    /// Weights of a window along one side.
    fn gauss() -> Vec<f64> {
        let gauss: Vec<f64> = (-5..=5).map(|i| (-f64::from(i * i) / 4.5).exp()).collect();
        let sum: f64 = gauss.iter().sum();
        gauss.iter().map(|weight| weight / sum).collect()
    }

    /// Pixels of the image in the window around a pixel, with their weights; pixels outside the image are zero.
    fn window(gauss: &[f64], [w, h]: [usize; 2], pixel: usize) -> impl Iterator<Item = (usize, f64)> {
        let (row, column) = (pixel / w, pixel % w);
        (row.saturating_sub(5)..h.min(row + 6)).flat_map(move |r| {
            let columns = column.saturating_sub(5)..w.min(column + 6);
            columns.map(move |k| (r * w + k, gauss[r + 5 - row] * gauss[k + 5 - column]))
        })
    }

    /// Means of x and y in a window, and A, B, C and D, where SSIM = AB/(CD).
    struct Window {
        means: [f64; 2],
        factors: [f64; 4],
    }

    impl Window {
        fn of([x, y]: [&[f64]; 2], pixels: impl Iterator<Item = (usize, f64)>) -> Self {
            let mut m = [0.0; 5];
            pixels.for_each(|(i, weight)| {
                let (x, y) = (x[i], y[i]);
                let terms = [x, y, x * x, y * y, x * y];
                m.iter_mut().zip(terms).for_each(|(sum, term)| *sum += weight * term);
            });
            let [m1, m2, ..] = m;
            let (s11, s22, s12) = (m[2] - m1 * m1, m[3] - m2 * m2, m[4] - m1 * m2);
            let factors = [2.0 * m1 * m2 + 1e-4, 2.0 * s12 + 9e-4, m1 * m1 + m2 * m2 + 1e-4, s11 + s22 + 9e-4];
            Self { means: [m1, m2], factors }
        }

        fn ssim(&self) -> f64 {
            let [a, b, c, d] = self.factors;
            a * b / (c * d)
        }

        /// Derivatives of SSIM by the means of x, x² and xy.
        fn slopes(&self) -> [f64; 3] {
            let ([m1, m2], [a, b, c, d], s) = (self.means, self.factors, self.ssim());
            let by_mean = 2.0 * m2 * (b - a) / (c * d) + 2.0 * m1 * s * (1.0 / d - 1.0 / c);
            [by_mean, -s / d, 2.0 * a / (c * d)]
        }
    }

    /// The loss by definition, window by window, from rendered and true values `[h·w]` of each channel.
    pub(in crate::render::gpu) fn defined(size: [usize; 2], channels: [[&[f64]; 2]; 3]) -> LossValues {
        let gauss = gauss();
        let (mut l1, mut ssim) = (0.0, 0.0);
        for [x, y] in channels {
            let of_window = |pixel| Window::of([x, y], window(&gauss, size, pixel)).ssim();
            ssim += (0..x.len()).map(of_window).sum::<f64>();
            l1 += x.iter().zip(y).map(|(x, y)| (x - y).abs()).sum::<f64>();
        }
        let n = (3 * size[0] * size[1]) as f64;
        LossValues { l1: l1 / n, ssim: ssim / n }
    }

    /// Derivative of the loss by the rendered values of a channel, `[h·w]`. L1 has derivative 0 where they equal the
    /// true values.
    fn adjoint(size: [usize; 2], [x, y]: [&[f64]; 2], ssim_weight: f64) -> Vec<f64> {
        let (gauss, n) = (gauss(), (3 * x.len()) as f64);
        let by_l1 = |(x, y): (&f64, &f64)| if x == y { 0.0 } else { (x - y).signum() };
        let mut slopes: Vec<f64> = x.iter().zip(y).map(by_l1).map(|slope| (1.0 - ssim_weight) * slope / n).collect();
        for pixel in 0..x.len() {
            let [by_mean, by_square, by_product] = Window::of([x, y], window(&gauss, size, pixel)).slopes();
            window(&gauss, size, pixel).for_each(|(i, weight)| {
                slopes[i] -= ssim_weight / n * weight * (by_mean + 2.0 * x[i] * by_square + y[i] * by_product);
            });
        }
        slopes
    }

    impl Images {
        /// Smooth shapes with noise in both images; a fifth of the pixels are black in both, thus equal.
        fn random(size: [usize; 2], alpha: TruthAlpha, seed: u64) -> Self {
            let mut rng = Pcg32::seed_from_u64(seed);
            let mut images = Self { size, image: vec![], truth: vec![], alpha };
            for i in 0..size[0] * size[1] {
                let (x, y) = ((i % size[0]) as f32, (i / size[0]) as f32);
                let base =
                    [0.5 + 0.3 * (x / 7.0).sin(), 0.5 + 0.3 * (y / 9.0).cos(), 0.4 + 0.2 * ((x + y) / 5.0).sin()];
                let black = rng.random_range(0..5) == 0;
                let truth = base.map(|b| if black { 0 } else { ((b + rng.random_range(-0.1..0.1)) * 255.0) as u8 });
                let color = base.map(|b| if black { 0.0 } else { b + rng.random_range(-0.2..0.2) });
                images.image.push([color[0], color[1], color[2], 0.3]);
                images.truth.push([truth[0], truth[1], truth[2], rng.random_range(0..=255)]);
            }
            images
        }

        /// Rendered and true values of a channel as used by the loss, and the alpha that multiplied them.
        fn channel(&self, c: usize) -> (Vec<f64>, Vec<f64>, Vec<f64>) {
            let (mut x, mut y, mut slope) = (vec![], vec![], vec![]);
            for (p, t) in self.image.iter().zip(&self.truth) {
                let (a, v) = (f64::from(t[3]) / 255.0, f64::from(t[c]) / 255.0);
                let weight = if self.alpha == TruthAlpha::Mask { a } else { 1.0 };
                let composite = a * v + (1.0 - a) * f64::from(BACKGROUND[c]);
                x.push(weight * f64::from(p[c]));
                y.push(if self.alpha == TruthAlpha::Composite { composite } else { weight * v });
                slope.push(weight);
            }
            (x, y, slope)
        }

        fn values(&self) -> LossValues {
            defined(self.size, [0, 1, 2].map(|c| self.channel(c)).each_ref().map(|(x, y, _)| [&x[..], &y[..]]))
        }

        fn on_gpu(&self, gpu: &Gpu, ssim_weight: f32) -> (LossValues, Vec<[f32; 4]>) {
            let [w, h] = self.size;
            let mut view = [0u32; VIEW_WORDS];
            view[20..24].copy_from_slice(&[w as u32, h as u32, w.div_ceil(16) as u32, h.div_ceil(16) as u32]);
            view[15] = SLOPE.to_bits();
            view[24..27].copy_from_slice(&BACKGROUND.map(f32::to_bits));
            let uniform = gpu.uniform("view", VIEW_WORDS).unwrap();
            gpu.write(&uniform, 0, &view);
            let image = gpu.storage_with("image", &self.image).unwrap();
            let truth = gpu.storage_with("truth", &self.truth).unwrap();
            let gradient = gpu.storage_with("gradient", &vec![[7f32; 4]; w * h]).unwrap();
            // One tile more than needed, as for a smaller view of a set.
            let sizes = [(w + PARALLEL.width, h)];
            let buffers =
                LossBuffers { view: &uniform, image: &image, truth: &truth, gradient: &gradient, exposures: None };
            let loss = Loss::new(gpu, &sizes, ssim_weight, &buffers).unwrap();
            loss.set_truth(gpu, self.alpha, 0);
            let mut frame = Frame::new(gpu);
            loss.record(&mut frame);
            frame.submit();
            (loss.read(gpu).unwrap(), gpu.read(&gradient, w * h).unwrap())
        }
    }

    #[test]
    fn ssim_of_a_known_pair() {
        // The images of `metrics::ssim`'s tests, with zero padding. The truth is the one of the two that 8 bits can
        // represent.
        let mut images = Images { size: [16, 16], image: vec![], truth: vec![], alpha: TruthAlpha::Ignore };
        for i in 0..256usize {
            let y = (0.9 * i as f32 / 255.0 + 0.05 * ((i / 16 + i) % 2) as f32).clamp(0.0, 1.0);
            images.image.push([y, y, y, 0.0]);
            images.truth.push([i as u8, i as u8, i as u8, 255]);
        }
        let (found, _) = images.on_gpu(&Gpu::open(None).unwrap(), 0.2);
        // f32 variances have errors of 1e-7, compared with C2 = 9e-4.
        assert!((found.ssim - 0.970_822_791).abs() < 1e-5, "{found:?}");
        assert!((images.values().ssim - 0.970_822_791).abs() < 1e-7);
    }

    #[test]
    fn the_adjoint_is_that_of_differences() {
        let (size, w) = ([17, 13], 0.2);
        let images = Images::random(size, TruthAlpha::Composite, 1);
        let channels = [0, 1, 2].map(|c| {
            let (x, y, _) = images.channel(c);
            [x, y]
        });
        for (c, [x, y]) in channels.iter().enumerate() {
            let expected = adjoint(size, [x, y], w);
            let largest = testing::largest(expected.iter().map(|e| e.abs()));
            for (pixel, expected) in expected.into_iter().enumerate().step_by(7) {
                let loss_at = |h: f64| {
                    let mut moved = channels.clone();
                    moved[c][0][pixel] += h;
                    let values = defined(size, moved.each_ref().map(|[x, y]| [&x[..], &y[..]]));
                    (1.0 - w) * values.l1 - w * values.ssim
                };
                let numeric = (loss_at(1e-5) - loss_at(-1e-5)) / 2e-5;
                let error = (numeric - expected).abs();
                assert!(error < 1e-6 * largest, "pixel {pixel}.{c}: {expected}, differences say {numeric}");
            }
        }
    }

    /// Relative to the largest derivative: f32 means over windows have errors of about 1e-7, and variances here are
    /// some hundredths.
    const SLOPES: f64 = 1e-5;

    #[test]
    fn loss_and_gradient_match_the_definition() {
        // Around the tile boundaries of either kernel, and far from them.
        let cases = [
            ([37, 101], TruthAlpha::Ignore),
            ([16, 40], TruthAlpha::Composite),
            ([53, 20], TruthAlpha::Mask),
            ([3, 2], TruthAlpha::Ignore),
            ([15, 41], TruthAlpha::Ignore),
            ([17, 39], TruthAlpha::Composite),
            ([17, 41], TruthAlpha::Mask),
            ([7, 65], TruthAlpha::Ignore),
            ([9, 63], TruthAlpha::Composite),
            ([9, 65], TruthAlpha::Mask),
        ];
        let gpus = [Gpu::open(None).unwrap(), Gpu::open(None).unwrap().posing_as_gpu()];
        for (i, (size, alpha)) in cases.into_iter().enumerate() {
            let images = Images::random(size, alpha, i as u64);
            let values = images.values();
            let channels = [0, 1, 2].map(|c| images.channel(c));
            let slopes = channels.each_ref().map(|(x, y, weight)| {
                let by_compared = adjoint(size, [x, y], f64::from(SSIM_WEIGHT));
                by_compared.iter().zip(weight).map(|(slope, weight)| slope * weight).collect::<Vec<_>>()
            });
            let largest = testing::largest(slopes.iter().flatten().map(|slope| slope.abs()));
            for gpu in &gpus {
                let (found, gradient) = images.on_gpu(gpu, SSIM_WEIGHT);
                assert!((found.l1 - values.l1).abs() < 1e-6, "{size:?} {alpha:?}: {found:?}, not {values:?}");
                assert!((found.ssim - values.ssim).abs() < 1e-5, "{size:?} {alpha:?}: {found:?}, not {values:?}");
                for (pixel, g) in gradient.iter().enumerate() {
                    for (c, slopes) in slopes.iter().enumerate() {
                        let (found, expected) = (f64::from(g[c]), slopes[pixel]);
                        let error = (found - expected).abs();
                        assert!(
                            error < SLOPES * largest,
                            "{size:?} {alpha:?} pixel {pixel}.{c}: {found}, not {expected} of at most {largest}"
                        );
                    }
                    let amiss = testing::largest(channels.iter().map(|(x, y, _)| (x[pixel] - y[pixel]).abs()));
                    let expected = f64::from(SLOPE) * (-amiss / 0.02).exp();
                    let error = (f64::from(g[3]) - expected).abs();
                    // Colours have errors of an ulp or two, which enter an exponential with a factor of fifty.
                    assert!(
                        error < 3e-5 * f64::from(SLOPE),
                        "{size:?} {alpha:?} pixel {pixel}: {}, not {expected}",
                        g[3]
                    );
                }
            }
        }
    }

    #[test]
    fn gradient_of_ssim_vanishes_where_the_images_agree() {
        let mut images = Images::random([40, 60], TruthAlpha::Ignore, 9);
        for (p, t) in images.image.iter_mut().zip(&images.truth) {
            *p = t.map(|v| f32::from(v) * (1.0 / 255.0));
        }
        for gpu in [Gpu::open(None).unwrap(), Gpu::open(None).unwrap().posing_as_gpu()] {
            let (found, gradient) = images.on_gpu(&gpu, 1.0);
            assert!(found.l1 < 1e-7 && (found.ssim - 1.0).abs() < 1e-6, "{found:?}");
            // An adapter may convert 8-bit values with a different rounding (6e-8); the derivative by that is at most
            // 2/C2.
            let bound = 6e-8 * 2.0 / 9e-4 / (3.0 * 40.0 * 60.0);
            assert!(gradient.iter().flat_map(|g| &g[..3]).all(|g| g.abs() <= bound));
        }
    }
}
