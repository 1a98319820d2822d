//! Pictures as they are read back.

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
    /// What is left of the background. `[height·width]`
    pub transmittance: Vec<f32>,
}

impl Picture {
    /// 8-bit sRGB as in a PNG, `[height·width·3]`; `space` is the scene's, in which the picture is blended.
    #[must_use]
    pub fn to_rgb8(&self, space: ColorSpace) -> Vec<u8> {
        self.rgb.iter().flat_map(|rgb| space.to_srgb(*rgb).map(to_byte)).collect()
    }

    /// Premultiplied colour and alpha without the `background` that the picture is over. `[height·width]`
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
        let picture = Picture { width: 1, height: 1, rgb: vec![[-1.0, 0.5, 2.0]], transmittance: vec![0.0] };
        assert_eq!(picture.to_rgb8(ColorSpace::SrgbDisplay), [0, 128, 255]);
        assert_eq!(picture.to_rgb8(ColorSpace::LinearDisplay), [0, 188, 255]);
    }
}
