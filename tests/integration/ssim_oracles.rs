//! SSIM compared with published values for image pairs of others (`shared/data/oracle_ssim_*`).

use crate::common::data;
use centaur::metrics::ssim_valid;
use image::{Rgb, Rgb32FImage};

/// 512×512 photograph with noise of σ = 20, window as in Wang et al. 2004, valid region.
#[test]
#[ignore = "needs shared data"]
fn camera_pair_of_scikit_image() {
    let open = |path| image::open(data(path)).unwrap().to_rgb32f();
    let clean = open("oracle_ssim_skimage/src/_skimage2/data/camera.png");
    let noisy = open("oracle_ssim_skimage/cam_noisy.png");
    let score = ssim_valid(&clean, &noisy).unwrap();
    // scikit-image gives 0.357964; IPOL's C implementation 0.357959 in single precision.
    assert!((score - 0.357964).abs() < 1e-6, "{score}");
}

/// TID2013's first picture: published 0.7820 after the 2×2 pooling of the original `ssim.m`, 0.52707 without.
#[test]
#[ignore = "needs shared data"]
fn colour_pair_of_piq() {
    let reference = bmp24("oracle_ssim_piq/tests/assets/I01.BMP");
    let distorted = bmp24("oracle_ssim_piq/tests/assets/i01_01_5.bmp");
    let plain = ssim_valid(&reference, &distorted).unwrap();
    assert!((plain - 0.52707).abs() < 5e-6, "{plain}");
    let pooled = ssim_valid(&pooled(&reference), &pooled(&distorted)).unwrap();
    assert!((pooled - 0.78196).abs() < 5e-6, "{pooled}");
}

/// Mean of 2×2 pixels.
fn pooled(image: &Rgb32FImage) -> Rgb32FImage {
    Rgb32FImage::from_fn(image.width() / 2, image.height() / 2, |x, y| {
        let at = |dx, dy, c: usize| image.get_pixel(2 * x + dx, 2 * y + dy).0[c];
        Rgb([0, 1, 2].map(|c| (at(0, 0, c) + at(1, 0, c) + at(0, 1, c) + at(1, 1, c)) / 4.0))
    })
}

/// Reads an uncompressed 24-bit bottom-up BMP, to avoid a decoder among the crate's dependencies.
fn bmp24(path: &str) -> Rgb32FImage {
    let bytes = std::fs::read(data(path)).unwrap();
    let word = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap());
    let (pixels, width, height) = (word(10) as usize, word(18), word(22));
    assert_eq!((bytes[28], word(30)), (24, 0), "24 bits, not compressed");
    let stride = (3 * width as usize).next_multiple_of(4);
    Rgb32FImage::from_fn(width, height, |x, y| {
        let at = pixels + (height - 1 - y) as usize * stride + 3 * x as usize;
        Rgb([bytes[at + 2], bytes[at + 1], bytes[at]].map(|v| f32::from(v) / 255.0))
    })
}
