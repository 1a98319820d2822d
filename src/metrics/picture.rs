use image::{Rgb, Rgb32FImage, RgbImage, imageops};

use super::{check_same_size, to_rgb8};
use crate::scene::SceneError;

/// Factor that makes errors visible: a difference of 1/4 has full brightness.
const ERROR_GAIN: f32 = 4.0;
const SEPARATOR: u32 = 4;
const PAPER: Rgb<u8> = Rgb([255; 3]);
const INK: Rgb<u8> = Rgb([40; 3]);

/// Composes photograph | render | absolute error × 4, with captions, for visual inspection of a view.
///
/// # Errors
/// If the sizes differ.
pub fn side_by_side(truth: &Rgb32FImage, render: &Rgb32FImage) -> Result<RgbImage, SceneError> {
    check_same_size(truth, render)?;
    let mut error = truth.clone();
    for (e, r) in error.iter_mut().zip(render.iter()) {
        *e = (*e - r).abs() * ERROR_GAIN;
    }
    let (width, height) = truth.dimensions();
    // Glyphs are 5×7 dots; a dot is one pixel per 300 pixels of height, so that it can be read when scaled down.
    let dot = 1 + height / 300;
    let strip = 11 * dot;
    let mut sheet = RgbImage::from_pixel(3 * width + 2 * SEPARATOR, height + strip, PAPER);
    for (i, (image, caption)) in [(truth, "TRUTH"), (render, "RENDER"), (&error, "ERROR X4")].into_iter().enumerate() {
        let left = i as u32 * (width + SEPARATOR);
        imageops::replace(&mut sheet, &to_rgb8(image), i64::from(left), i64::from(strip));
        write(&mut sheet, caption, left + 2 * dot, 2 * dot, dot);
    }
    Ok(sheet)
}

/// Writes capital letters at (`left`, `top`); parts outside the image are clipped.
fn write(sheet: &mut RgbImage, text: &str, left: u32, top: u32, dot: u32) {
    for (i, letter) in text.chars().enumerate() {
        for (y, row) in (0_u32..).zip(glyph(letter)) {
            for x in (0..5_u32).filter(|x| row & (0b1_0000 >> x) != 0) {
                let corner = (left + (6 * i as u32 + x) * dot, top + y * dot);
                for (dx, dy) in (0..dot).flat_map(|dy| (0..dot).map(move |dx| (dx, dy))) {
                    if let Some(p) = sheet.get_pixel_mut_checked(corner.0 + dx, corner.1 + dy) {
                        *p = INK;
                    }
                }
            }
        }
    }
}

/// Bitmap of a caption letter, 5×7 dots, top row first.
fn glyph(letter: char) -> [u8; 7] {
    match letter {
        'D' => [0b11110, 0b10001, 0b10001, 0b10001, 0b10001, 0b10001, 0b11110],
        'E' => [0b11111, 0b10000, 0b10000, 0b11110, 0b10000, 0b10000, 0b11111],
        'H' => [0b10001, 0b10001, 0b10001, 0b11111, 0b10001, 0b10001, 0b10001],
        'N' => [0b10001, 0b11001, 0b10101, 0b10101, 0b10011, 0b10001, 0b10001],
        'O' => [0b01110, 0b10001, 0b10001, 0b10001, 0b10001, 0b10001, 0b01110],
        'R' => [0b11110, 0b10001, 0b10001, 0b11110, 0b10100, 0b10010, 0b10001],
        'T' => [0b11111, 0b00100, 0b00100, 0b00100, 0b00100, 0b00100, 0b00100],
        'U' => [0b10001, 0b10001, 0b10001, 0b10001, 0b10001, 0b10001, 0b01110],
        'X' => [0b00000, 0b10001, 0b01010, 0b00100, 0b01010, 0b10001, 0b00000],
        '4' => [0b00010, 0b00110, 0b01010, 0b10010, 0b11111, 0b00010, 0b00010],
        _ => [0; 7],
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn panels_hold_truth_render_and_amplified_error() {
        let fill = |v: [f32; 3]| Rgb32FImage::from_pixel(60, 20, Rgb(v));
        let sheet = side_by_side(&fill([0.2, 0.4, 1.0]), &fill([0.3, 0.4, 0.0])).unwrap();
        assert_eq!(sheet.dimensions(), (3 * 60 + 8, 20 + 11));
        let centre = |panel: u32| sheet.get_pixel(panel * 64 + 30, 11 + 10).0;
        assert_eq!(centre(0), [51, 102, 255]);
        assert_eq!(centre(1), [77, 102, 0]);
        assert_eq!(centre(2), [102, 0, 255]);
        assert!(sheet.pixels().any(|p| *p == INK), "no caption");
    }

    #[test]
    fn tiny_images_clip_captions() {
        assert!(side_by_side(&Rgb32FImage::new(1, 1), &Rgb32FImage::new(1, 1)).is_ok());
        assert!(side_by_side(&Rgb32FImage::new(1, 1), &Rgb32FImage::new(1, 2)).is_err());
    }
}
