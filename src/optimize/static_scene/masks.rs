//! What masks leave of the pictures of the training views.

use glam::DVec2;
use rayon::prelude::*;

use super::photographs::Photographs;
use crate::capture::{CaptureError, Photo, pixel_index};

/// What masks leave of the pictures of the training views, in their order.
pub(super) struct Masks(Vec<Option<MaskBits>>);

/// Which pixels of a photograph count ([`Photo::counts`]), 64 to a number.
struct MaskBits {
    width: u32,
    pixels: Vec<u64>,
}

impl Masks {
    /// Of the training views, by their indices in the capture.
    pub(super) fn of(photos: &Photographs, train: &[usize]) -> Result<Self, CaptureError> {
        let of_view = |&i: &usize| photos.whole_of(i).map(|photo| photo.masked.then(|| MaskBits::of(&photo)));
        let bits: Result<Vec<Option<MaskBits>>, CaptureError> = train.par_iter().map(of_view).collect();
        bits.map(Self)
    }

    /// Whether the picture of a training view, by its place among these, says anything at a continuous pixel position
    /// inside it, as [`Viewers::shows`](crate::geometry::Viewers::shows).
    pub(super) fn show(&self, view: usize, at: DVec2) -> bool {
        self.0[view].as_ref().is_none_or(|bits| bits.hold(pixel_index(bits.width, at.x as usize, at.y as usize)))
    }

    /// The same of a pixel, by its number by rows.
    pub(super) fn show_pixel(&self, view: usize, pixel: usize) -> bool {
        self.0[view].as_ref().is_none_or(|bits| bits.hold(pixel))
    }
}

impl MaskBits {
    fn of(photo: &Photo) -> Self {
        let count = photo.rgba.len() / 4;
        let bits = |first: usize| {
            let pixels = first..(first + 64).min(count);
            pixels.rev().fold(0, |bits, pixel| bits << 1 | u64::from(photo.counts(pixel)))
        };
        Self { width: photo.width, pixels: (0..count).step_by(64).map(bits).collect() }
    }

    fn hold(&self, pixel: usize) -> bool {
        self.pixels.get(pixel / 64).is_some_and(|bits| bits >> (pixel % 64) & 1 == 1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn masks_are_kept_by_the_bit() {
        // 9 pixels per row, so that rows do not begin with a word of the bit mask.
        // Masked pixels are 3, not 0, as JPEG may leave black.
        let alpha = |pixel: usize| if pixel % 7 == 3 { 200 } else { 3 };
        let rgba: Vec<u8> = (0..9 * 20).flat_map(|pixel| [0, 0, 0, alpha(pixel)]).collect();
        let photo = Photo { width: 9, height: 20, rgba, has_alpha: false, masked: true };
        let masks = Masks(vec![None, Some(MaskBits::of(&photo))]);
        for pixel in 0..9 * 20 {
            let at = DVec2::new((pixel % 9) as f64 + 0.9, (pixel / 9) as f64);
            assert_eq!([masks.show(1, at), masks.show_pixel(1, pixel)], [alpha(pixel) == 200; 2], "{pixel}");
            assert!(masks.show(0, at) && masks.show_pixel(0, pixel));
        }
        assert!(!masks.show(1, DVec2::new(8.0, 30.0)));
    }
}
