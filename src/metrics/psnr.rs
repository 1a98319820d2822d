use image::{Rgb32FImage, RgbImage};

use super::{check_least, check_same_size};
use crate::scene::{SceneError, color::to_byte};

/// Peak signal-to-noise ratio in dB, −10·log₁₀ of the mean squared error over all pixels and channels (peak 1).
/// Infinite for equal images, NaN if a value is NaN.
///
/// # Errors
/// If the sizes differ or the images are empty.
pub fn psnr(truth: &Rgb32FImage, render: &Rgb32FImage) -> Result<f64, SceneError> {
    check_same_size(truth, render)?;
    check_least("PSNR", 1, truth.dimensions())?;
    let squares: f64 = truth.iter().zip(render.iter()).map(|(&t, &r)| (f64::from(t) - f64::from(r)).powi(2)).sum();
    Ok(-10.0 * (squares / truth.as_raw().len() as f64).log10())
}

/// Converts to an 8-bit image: values are clamped to \[0, 1\] and rounded to the nearest k/255; NaN becomes 0.
#[must_use]
pub fn to_rgb8(image: &Rgb32FImage) -> RgbImage {
    let mut out = RgbImage::new(image.width(), image.height());
    for (o, &v) in out.iter_mut().zip(image.iter()) {
        *o = to_byte(v);
    }
    out
}

/// Quantises an image to 8 bits, as writing and reading a PNG would.
#[must_use]
pub fn quantised(image: &Rgb32FImage) -> Rgb32FImage {
    let mut out = image.clone();
    for (o, v) in out.iter_mut().zip(to_rgb8(image).iter()) {
        *o = f32::from(*v) / 255.0;
    }
    out
}

#[cfg(test)]
mod tests {
    use image::{Rgb, Rgb32FImage};

    use super::*;
    use crate::metrics::ssim::tests::golden_pair;

    #[test]
    fn golden_value() {
        let (x, y) = golden_pair();
        // The golden value has 6 decimals; storing pixels in f32 adds about 1e-6 dB.
        assert!((psnr(&x, &y).unwrap() - 26.798809).abs() < 2e-6);
        assert_eq!(psnr(&x, &x).unwrap(), f64::INFINITY);
    }

    #[test]
    fn quantisation_rounds_clamps_and_is_idempotent() {
        let pixel = |v: [f32; 3]| Rgb32FImage::from_pixel(1, 1, Rgb(v));
        assert_eq!(to_rgb8(&pixel([0.5 / 255.0, 0.499 / 255.0, 254.6 / 255.0])).as_raw(), &[1, 0, 255]);
        assert_eq!(to_rgb8(&pixel([-1.0, 2.0, f32::NAN])).as_raw(), &[0, 255, 0]);
        for k in 0..=255_u8 {
            let exact = pixel([f32::from(k) / 255.0; 3]);
            assert_eq!(quantised(&exact), exact);
        }
    }

    #[test]
    fn quantisation_changes_psnr() {
        let (x, y) = golden_pair();
        let (full, eight_bit) = (psnr(&x, &y).unwrap(), psnr(&quantised(&x), &quantised(&y)).unwrap());
        assert!(full != eight_bit && (full - eight_bit).abs() < 0.1);
    }

    #[test]
    fn sizes_must_match() {
        let error = psnr(&Rgb32FImage::new(2, 3), &Rgb32FImage::new(3, 2)).unwrap_err();
        assert_eq!(error.to_string(), "render: expected 2×3 pixels as in the photograph, found 3×2");
        assert!(psnr(&Rgb32FImage::new(0, 0), &Rgb32FImage::new(0, 0)).is_err());
    }
}
