use image::Rgb32FImage;
use rayon::prelude::*;

use super::{check_least, check_same_size};
use crate::scene::SceneError;

/// Radius of the 11-tap window of Wang et al. 2004.
const RADIUS: usize = 5;
const TAPS: usize = 2 * RADIUS + 1;
/// Standard deviation of the Gaussian window in pixels.
const SIGMA: f64 = 1.5;
/// SSIM constants (0.01·peak)² and (0.03·peak)² for peak 1; they keep the ratio finite where an image is black or flat.
const C1: f64 = 1e-4;
const C2: f64 = 9e-4;

/// SSIM as INRIA's 3DGS (and the training loss) computes it: windows centred on every pixel, zero padding, mean over
/// pixels and channels. This is the convention of published Gaussian-splatting tables.
///
/// # Errors
/// If the sizes differ or the images are empty.
pub fn ssim_inria(truth: &Rgb32FImage, render: &Rgb32FImage) -> Result<f64, SceneError> {
    check_least("SSIM", 1, truth.dimensions())?;
    ssim(truth, render, Border::Zero)
}

/// SSIM over windows that lie inside the image only, like Wang's `ssim.m` (sometimes called MATLAB's) without its
/// downscaling, scikit-image with `gaussian_weights=True, sigma=1.5, use_sample_covariance=False`, and `NerfBaselines`.
///
/// # Errors
/// If the sizes differ or a side is shorter than the window of 11 pixels.
pub fn ssim_valid(truth: &Rgb32FImage, render: &Rgb32FImage) -> Result<f64, SceneError> {
    check_least("SSIM (valid)", TAPS as u32, truth.dimensions())?;
    ssim(truth, render, Border::Valid)
}

/// SSIM over windows centred on every pixel, with the image reflected about the centres of its outermost pixels.
///
/// # Errors
/// If the sizes differ or a side is shorter than 6 pixels.
pub fn ssim_reflect(truth: &Rgb32FImage, render: &Rgb32FImage) -> Result<f64, SceneError> {
    check_least("SSIM (reflect)", RADIUS as u32 + 1, truth.dimensions())?;
    ssim(truth, render, Border::Reflect)
}

/// Border handling of windows that extend beyond the image.
#[derive(Clone, Copy)]
enum Border {
    Zero,
    Valid,
    Reflect,
}

impl Border {
    /// Number of windows along `length` pixels.
    fn windows(self, length: usize) -> usize {
        match self {
            Self::Valid => length.saturating_sub(2 * RADIUS),
            Self::Zero | Self::Reflect => length,
        }
    }

    /// Pixel under tap `k` of window `w`; `None` where the window sees zero padding.
    fn pixel(self, w: usize, k: usize, length: usize) -> Option<usize> {
        match self {
            Self::Valid => Some(w + k),
            Self::Zero => (w + k).checked_sub(RADIUS).filter(|&p| p < length),
            Self::Reflect => {
                let p = (w + k).abs_diff(RADIUS);
                Some(p.min(2 * (length - 1) - p))
            }
        }
    }
}

/// Mean SSIM over the channels; the caller has checked that at least one window fits.
fn ssim(truth: &Rgb32FImage, render: &Rgb32FImage, border: Border) -> Result<f64, SceneError> {
    check_same_size(truth, render)?;
    let (width, height) = (truth.width() as usize, truth.height() as usize);
    let channel = |image: &Rgb32FImage, c: usize| -> Vec<f64> {
        image.as_raw().iter().skip(c).step_by(3).map(|&v| f64::from(v)).collect()
    };
    let sum: f64 = (0..3).map(|c| plane(&channel(truth, c), &channel(render, c), width, height, border)).sum();
    Ok(sum / 3.0)
}

/// Mean SSIM of two planes `[height·width]`.
fn plane(x: &[f64], y: &[f64], width: usize, height: usize, border: Border) -> f64 {
    let moments: Vec<[f64; 5]> = x.iter().zip(y).map(|(&x, &y)| [x, y, x * x, y * y, x * y]).collect();
    let columns = blur_transposed(&moments, width, border);
    let windows = blur_transposed(&columns, height, border);
    let ssim = |&[m1, m2, e11, e22, e12]: &[f64; 5]| {
        let (s11, s22, s12) = (e11 - m1 * m1, e22 - m2 * m2, e12 - m1 * m2);
        (2.0 * m1 * m2 + C1) * (2.0 * s12 + C2) / ((m1 * m1 + m2 * m2 + C1) * (s11 + s22 + C2))
    };
    windows.iter().map(ssim).sum::<f64>() / windows.len() as f64
}

/// Blurs along rows of `width` pixels and returns the transposed image, so that two calls blur in both directions.
fn blur_transposed(image: &[[f64; 5]], width: usize, border: Border) -> Vec<[f64; 5]> {
    let weights = window();
    let height = image.len() / width;
    (0..border.windows(width))
        .into_par_iter()
        .flat_map_iter(|w| {
            image.chunks_exact(width).take(height).map(move |row| {
                let mut sum = [0.0; 5];
                for (k, weight) in weights.iter().enumerate() {
                    if let Some(p) = border.pixel(w, k, width) {
                        for (s, v) in sum.iter_mut().zip(&row[p]) {
                            *s += weight * v;
                        }
                    }
                }
                sum
            })
        })
        .collect()
}

/// Normalised 1-D Gaussian window.
fn window() -> [f64; TAPS] {
    let g: [f64; TAPS] = std::array::from_fn(|k| (-(k as f64 - RADIUS as f64).powi(2) / (2.0 * SIGMA * SIGMA)).exp());
    let sum: f64 = g.iter().sum();
    g.map(|v| v / sum)
}

#[cfg(test)]
pub(super) mod tests {
    use image::{Rgb, Rgb32FImage};

    use super::*;

    /// X = (16i+j)/255, Y = clip(0.9·X + 0.05·((i+j) mod 2)), 16×16. The golden SSIM was computed separately, in
    /// float64.
    fn golden_planes() -> (Vec<f64>, Vec<f64>) {
        let x: Vec<f64> = (0..256).map(|p| f64::from(p) / 255.0).collect();
        let y = (0..256).map(|p| (0.9 * x[p] + 0.05 * ((p / 16 + p % 16) % 2) as f64).clamp(0.0, 1.0)).collect();
        (x, y)
    }

    pub(in crate::metrics) fn golden_pair() -> (Rgb32FImage, Rgb32FImage) {
        let (x, y) = golden_planes();
        let grey = |v: &[f64]| Rgb32FImage::from_fn(16, 16, |j, i| Rgb([v[(16 * i + j) as usize] as f32; 3]));
        (grey(&x), grey(&y))
    }

    #[test]
    fn golden_values() {
        let (x, y) = golden_planes();
        for (border, golden) in
            [(Border::Zero, 0.970822791), (Border::Valid, 0.958179291), (Border::Reflect, 0.947735576)]
        {
            // The golden values have 9 decimals.
            assert!((plane(&x, &y, 16, 16, border) - golden).abs() < 6e-10);
        }
        let (x, y) = golden_pair();
        // Rounding pixels to f32 changes the value by about 1e-7.
        assert!((ssim_inria(&x, &y).unwrap() - 0.970822791).abs() < 1e-6);
        assert!((ssim_valid(&x, &y).unwrap() - 0.958179291).abs() < 1e-6);
        assert!((ssim_reflect(&x, &y).unwrap() - 0.947735576).abs() < 1e-6);
    }

    #[test]
    fn window_is_that_of_wang_et_al() {
        let half = [0.26601172, 0.21300554, 0.10936069, 0.03600077, 0.00759876, 0.00102838];
        let w = window();
        for (k, g) in half.iter().enumerate() {
            assert!((w[RADIUS + k] - g).abs() < 5e-9 && (w[RADIUS - k] - g).abs() < 5e-9);
        }
    }

    #[test]
    fn equal_images_score_one_and_channels_are_averaged() {
        let (x, y) = golden_pair();
        assert!((ssim_inria(&x, &x).unwrap() - 1.0).abs() < 1e-12);
        let mut only_red = x.clone();
        for (o, r) in only_red.pixels_mut().zip(y.pixels()) {
            o.0[0] = r.0[0];
        }
        let (one, all) = (ssim_inria(&x, &only_red).unwrap(), ssim_inria(&x, &y).unwrap());
        assert!((one - (all + 2.0) / 3.0).abs() < 1e-12);
    }

    #[test]
    fn not_square_and_symmetric_under_transposition() {
        let a = Rgb32FImage::from_fn(23, 14, |x, y| Rgb([0.0, 0.4, 0.9].map(|c| ((x * y) % 7) as f32 / 9.0 + c * 0.1)));
        let b = Rgb32FImage::from_fn(23, 14, |x, y| Rgb([((x + 3 * y) % 5) as f32 / 6.0; 3]));
        let t = image::imageops::rotate90::<Rgb32FImage>;
        for f in [ssim_inria, ssim_valid, ssim_reflect] {
            assert!((f(&a, &b).unwrap() - f(&t(&a), &t(&b)).unwrap()).abs() < 1e-12);
        }
    }

    #[test]
    fn small_images_are_refused_where_the_window_needs_more() {
        let image = |n| Rgb32FImage::new(n, n);
        assert!(ssim_inria(&image(1), &image(1)).is_ok());
        assert!(ssim_inria(&image(0), &image(0)).is_err());
        assert!(ssim_reflect(&image(5), &image(5)).is_err() && ssim_reflect(&image(6), &image(6)).is_ok());
        let error = ssim_valid(&image(10), &image(10)).unwrap_err().to_string();
        assert_eq!(error, "SSIM (valid): expected images of at least 11×11 pixels, found 10×10");
        assert!(ssim_valid(&image(11), &image(11)).is_ok());
    }
}
