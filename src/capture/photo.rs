//! A decoded picture, and what it says at a pixel.

use glam::DVec2;

/// A pixel of which a mask or alpha leaves less than half says nothing: files of masks round what does not.
const LEAST_ALPHA: u8 = 128;

/// A decoded picture at the size of its view's camera.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Photo {
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// `[height·width·4]`, rows from the top: sRGB-encoded colour, and A, which is straight alpha, a mask
    /// (255 = use this pixel) or their product. Colour is undefined where A is 0.
    pub rgba: Vec<u8>,
    /// Some pixel of the file is transparent: A is opacity over an unknown background. What an undistorted frame shows
    /// outside of such a photograph, if anything, is transparent, too, as what is around an object that was cut out.
    pub has_alpha: bool,
    /// A mask was applied, or the undistorted frame reaches outside a photograph without alpha, as it does only of the
    /// most distorted (see [`Lens::pinhole`](super::Lens::pinhole)): A is how far a pixel counts.
    pub masked: bool,
}

/// Number of the pixel in column `x` and row `y` of a picture of this width, by rows from the top.
pub(crate) fn pixel_index(width: u32, x: usize, y: usize) -> usize {
    y * width as usize + x
}

impl Photo {
    /// Number of the pixel in column `x` and row `y`, by rows from the top.
    pub(crate) fn index(&self, x: usize, y: usize) -> usize {
        pixel_index(self.width, x, y)
    }

    /// Number of the pixel that holds a continuous pixel position inside the picture.
    pub(crate) fn index_at(&self, at: DVec2) -> usize {
        self.index(at.x as usize, at.y as usize)
    }

    /// Colour, sRGB-encoded, and A of a pixel by its number, in 0 to 1.
    ///
    /// # Panics
    /// If there is no such pixel.
    pub(crate) fn color(&self, pixel: usize) -> [f32; 4] {
        [0, 1, 2, 3].map(|c| f32::from(self.rgba[4 * pixel + c]) / 255.0)
    }

    /// Colour, sRGB-encoded, of a pixel that is all there: where A is less than 255 it is mixed with what is not known.
    /// `None` also where there is no such pixel.
    pub(crate) fn whole(&self, pixel: usize) -> Option<[u8; 3]> {
        match *self.rgba.get(4 * pixel..4 * pixel + 4)? {
            [r, g, b, 255] => Some([r, g, b]),
            _ => None,
        }
    }

    /// Colour at a continuous pixel position, sRGB-encoded, in 0 to 1, between the centres of pixels; at the border
    /// that of the last. `None` where a pixel there has none, A being 0, as where undistortion reached outside the
    /// photograph.
    ///
    /// # Panics
    /// If the picture says that it has more pixels than it has.
    pub(crate) fn sample(&self, at: DVec2) -> Option<[f32; 3]> {
        let last = DVec2::new(f64::from(self.width) - 1.0, f64::from(self.height) - 1.0);
        let at = (at - 0.5).clamp(DVec2::ZERO, last);
        let (x, y) = (at.x as usize, at.y as usize);
        let (fx, fy) = (at.x.fract() as f32, at.y.fract() as f32);
        let (right, below) = ((x + 1).min(last.x as usize), (y + 1).min(last.y as usize));
        let rows = [y, below].map(|y| [x, right].map(|x| self.color(self.index(x, y))));
        rows.iter().flatten().all(|rgba| rgba[3] > 0.0).then(|| {
            [0, 1, 2].map(|k| {
                let row = |[left, right]: [[f32; 4]; 2]| left[k] * (1.0 - fx) + right[k] * fx;
                row(rows[0]) * (1.0 - fy) + row(rows[1]) * fy
            })
        })
    }

    /// Whether a mask leaves in a pixel, for the most part; what is transparent shows the background, which counts.
    pub(crate) fn counts(&self, pixel: usize) -> bool {
        !self.masked || self.is_there(pixel)
    }

    /// Whether a mask or alpha leaves out a pixel, for the most part: nothing that is known is there.
    pub(crate) fn is_cut_out(&self, pixel: usize) -> bool {
        (self.masked || self.has_alpha) && !self.is_there(pixel)
    }

    fn is_there(&self, pixel: usize) -> bool {
        self.rgba.get(4 * pixel + 3).is_some_and(|alpha| *alpha >= LEAST_ALPHA)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A photograph of 2×2 pixels with alpha of one, a half, slightly less than a half, and zero.
    fn photo(masked: bool, has_alpha: bool) -> Photo {
        let rgba = [[0_u8, 51, 255, 255], [102, 0, 0, 128], [0, 0, 0, 127], [9, 9, 9, 0]].concat();
        Photo { width: 2, height: 2, rgba, has_alpha, masked }
    }

    #[test]
    fn pixels_are_numbered_by_rows() {
        let photo = photo(false, false);
        assert_eq!([[0, 0], [1, 0], [0, 1], [1, 1]].map(|[x, y]| photo.index(x, y)), [0, 1, 2, 3]);
        assert_eq!(photo.index_at(DVec2::new(1.0, 0.99)), 1);
        assert_eq!(photo.index_at(DVec2::new(0.99, 1.99)), 2);
        assert_eq!(photo.color(0), [0.0, 0.2, 1.0, 1.0]);
    }

    #[test]
    fn masks_and_alpha_leave_out_what_they_say() {
        let of = |f: fn(&Photo, usize) -> bool, masked, has_alpha| {
            let photo = photo(masked, has_alpha);
            [0, 1, 2, 3, 4].map(|p| f(&photo, p))
        };
        let left = [true, true, false, false, false];
        assert_eq!(of(Photo::counts, true, false), left);
        assert_eq!(of(Photo::counts, false, true), [true; 5]);
        for (masked, has_alpha) in [(true, false), (false, true), (true, true)] {
            assert_eq!(of(Photo::is_cut_out, masked, has_alpha), left.map(|is_left| !is_left));
        }
        assert_eq!(of(Photo::is_cut_out, false, false), [false; 5]);
        let photo = photo(false, true);
        assert_eq!([0, 1, 2, 3, 4].map(|p| photo.whole(p)), [Some([0, 51, 255]), None, None, None, None]);
    }

    #[test]
    fn colors_are_mixed_between_centers() {
        let rgba = [[0_u8, 0, 0, 255], [255, 0, 0, 255], [0, 255, 0, 255], [255, 255, 0, 1]].concat();
        let photo = Photo { width: 2, height: 2, rgba, has_alpha: true, masked: false };
        let at = |x: f64, y: f64| photo.sample(DVec2::new(x, y));
        assert_eq!(at(1.0, 0.75), Some([0.5, 0.25, 0.0]));
        // At the border and beyond it there is nothing to interpolate with.
        for (x, y) in [(2.0, 2.0), (1.5, 1.5), (7.0, 3.0)] {
            assert_eq!(at(x, y), Some([1.0, 1.0, 0.0]));
        }
        assert_eq!(at(-1.0, 0.0), Some([0.0; 3]));
        let without = Photo { rgba: [photo.rgba[..15].to_vec(), vec![0]].concat(), ..photo };
        assert_eq!(without.sample(DVec2::new(1.0, 0.75)), None);
        assert_eq!(without.sample(DVec2::new(2.0, 2.0)), None);
    }
}
