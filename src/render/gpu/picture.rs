//! Rendered pictures.

use image::{Rgb, RgbImage};

use crate::scene::{ColorSpace, color::to_byte};

/// A rendered picture in the scene's blending space, row-major from the top.
#[derive(Clone, Debug, PartialEq)]
pub struct Picture {
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// Colour over the background, not clamped above. `[height·width]`
    pub rgb: Vec<[f32; 3]>,
    /// Weight of the background. `[height·width]`
    pub transmittance: Vec<f32>,
}

impl Picture {
    /// 8-bit sRGB over the background, to be saved as PNG or JPEG; `space` is that of the scene
    /// ([`Composition::color_space`](crate::scene::Composition::color_space)), in which the picture is blended.
    #[must_use]
    pub fn to_image(&self, space: ColorSpace) -> RgbImage {
        let mut image = RgbImage::new(self.width, self.height);
        for (pixel, rgb) in image.pixels_mut().zip(&self.rgb) {
            *pixel = Rgb(space.to_srgb(*rgb).map(to_byte));
        }
        image
    }

    /// Premultiplied colour and alpha, with the `background` that the picture is composited over removed.
    /// `[height·width]`
    #[must_use]
    pub fn premultiplied(&self, background: [f32; 3]) -> Vec<[f32; 4]> {
        let pixel = |(rgb, &t): (&[f32; 3], &f32)| {
            let color = |c: usize| rgb[c] - t * background[c];
            [color(0), color(1), color(2), 1.0 - t]
        };
        self.rgb.iter().zip(&self.transmittance).map(pixel).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bytes_are_srgb_whatever_the_space_of_blending() {
        let rgb = vec![[-1.0, 0.5, 2.0], [0.0; 3]];
        let picture = Picture { width: 1, height: 2, rgb, transmittance: vec![0.0; 2] };
        for (space, middle) in [(ColorSpace::SrgbDisplay, 128), (ColorSpace::LinearDisplay, 188)] {
            let image = picture.to_image(space);
            assert_eq!((image.dimensions(), &image.into_raw()[..]), ((1, 2), &[0, middle, 255, 0, 0, 0][..]));
        }
    }
}
