use image::Rgb32FImage;
use nv_flip::{DEFAULT_PIXELS_PER_DEGREE, FlipImageRgb8};

use super::{check_least, check_same_size, to_rgb8};
use crate::scene::SceneError;

/// FLIP (Andersson et al. 2020): the difference an observer perceives when alternating between two images, from 0
/// (none) to 1, averaged over pixels. On 8-bit sRGB images at 67 pixels per degree, the default of NVIDIA's program.
/// Needs no network weights.
///
/// # Errors
/// If the sizes differ or the images are empty.
pub fn flip(truth: &Rgb32FImage, render: &Rgb32FImage) -> Result<f64, SceneError> {
    check_same_size(truth, render)?;
    check_least("FLIP", 1, truth.dimensions())?;
    let [truth, render] =
        [truth, render].map(|image| FlipImageRgb8::with_data(image.width(), image.height(), &to_rgb8(image)));
    let errors = nv_flip::flip(truth, render, DEFAULT_PIXELS_PER_DEGREE).to_vec();
    Ok(errors.iter().map(|&e| f64::from(e)).sum::<f64>() / errors.len() as f64)
}

#[cfg(test)]
mod tests {
    use image::Rgb;

    use super::*;

    /// The pictures of `tests/oracles/check_flip.py`.
    fn pictures(width: u32, height: u32) -> (Rgb32FImage, Rgb32FImage) {
        let color = |x: u32, y: u32, more: u32| {
            let lines = if (x + y) % 11 < 4 { 230 } else { 40 };
            Rgb([5 * x % 256, 7 * y % 256, lines].map(|c| (c + more).min(255) as f32 / 255.0))
        };
        let truth = Rgb32FImage::from_fn(width, height, |x, y| color(x, y, 0));
        (truth, Rgb32FImage::from_fn(width, height, |x, y| color(x + 2, y, 12)))
    }

    #[test]
    fn golden_values() {
        // Golden values by PyPI's flip-evaluator 1.7; nv-flip contains version 1.2, which rounds differently at sharp
        // lines.
        for ((width, height), golden) in [((64, 48), 0.377_455), ((31, 17), 0.353_533), ((5, 3), 0.444_331)] {
            let (truth, render) = pictures(width, height);
            let found = flip(&truth, &render).unwrap();
            assert!((found - golden).abs() < 1e-4, "{width}×{height}: {found}, not {golden}");
        }
    }

    #[test]
    fn limits_and_errors() {
        let [black, white] = [0.0, 1.0].map(|v| Rgb32FImage::from_pixel(8, 8, Rgb([v; 3])));
        assert_eq!(flip(&black, &black), Ok(0.0));
        assert!(flip(&black, &white).unwrap() > 0.9);
        assert!(flip(&black, &Rgb32FImage::new(8, 7)).is_err());
        assert!(flip(&Rgb32FImage::new(0, 0), &Rgb32FImage::new(0, 0)).is_err());
        let nan = Rgb32FImage::from_pixel(8, 8, Rgb([f32::NAN; 3]));
        assert_eq!(flip(&black, &nan), Ok(0.0), "as PNGs have it: black");
    }
}
