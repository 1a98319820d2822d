//! 8-bit, view-independent previews of maps, for other programs.

use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ExtendedColorType, ImageEncoder as _};

use super::activation;
use crate::scene::color::to_byte;
use crate::scene::{ColorSpace, Texture, sh};

/// sRGB-encoded colour of a texel of a base map.
pub(super) fn color(texel: &[f32], space: ColorSpace) -> [u8; 3] {
    space.to_srgb(sh::rgb_from_dc([texel[0], texel[1], texel[2]])).map(to_byte)
}

/// Linear opacity of a texel of a base map.
pub(super) fn opacity(texel: &[f32]) -> u8 {
    to_byte(activation::opacity(texel[3]))
}

/// Encodes `pixels` as PNG, with the width and height of `size`.
pub(super) fn png(size: &Texture, pixels: &[u8], kind: ExtendedColorType) -> Vec<u8> {
    let mut png = vec![];
    PngEncoder::new_with_quality(&mut png, CompressionType::Fast, FilterType::Adaptive)
        .write_image(pixels, size.width(), size.height(), kind)
        .expect("encoding into memory, with a buffer of the declared size, cannot fail");
    png
}
