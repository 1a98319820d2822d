//! Output files of `centaur render`.

use std::path::Path;

use anyhow::{Context as _, Result};
use centaur::format::{self, Channel, ExrCompression, ExrHeader, SampleType};
use centaur::render::gpu::{LayeredPicture, Picture};
use centaur::scene::color::{linear_to_srgb, srgb_to_linear, to_byte};
use centaur::scene::{Camera, ColorSpace, Composition};
use image::{RgbImage, RgbaImage};

use super::{Args, Compression, ExrType, Format};
use crate::cli::eval::write_png;

/// Depth where there is no surface: beyond everything, as other programs write it.
const NO_DEPTH: f32 = 1e10;

/// Output file, and its metadata.
pub(super) struct File<'a> {
    pub(super) path: &'a Path,
    pub(super) camera: &'a Camera,
    pub(super) composition: &'a Composition,
    pub(super) args: &'a Args,
}

impl File<'_> {
    /// Writes an image over the background, or with alpha instead.
    pub(super) fn picture(&self, picture: Picture) -> Result<()> {
        let alpha = self.args.look.alpha;
        let size = [picture.width, picture.height];
        let colors: Vec<[f32; 4]> = if alpha {
            picture.premultiplied(self.composition.background)
        } else {
            picture.rgb.into_iter().map(|[r, g, b]| [r, g, b, 1.0]).collect()
        };
        match self.args.format() {
            Format::Png => self.png(size, &colors, alpha),
            Format::Exr => self.exr(size, &colors, alpha),
        }
    }

    fn png(&self, [width, height]: [u32; 2], colors: &[[f32; 4]], alpha: bool) -> Result<()> {
        let encode: fn(f32) -> f32 = match self.composition.color_space {
            ColorSpace::SrgbDisplay => |c| c,
            ColorSpace::LinearDisplay => linear_to_srgb,
        };
        let bytes = |n| colors.iter().flat_map(|c| pixel(c, encode).into_iter().take(n)).collect();
        let expected = "a picture has width·height pixels";
        if alpha {
            write_png(self.path, &RgbaImage::from_raw(width, height, bytes(4)).context(expected)?)
        } else {
            write_png(self.path, &RgbImage::from_raw(width, height, bytes(3)).context(expected)?)
        }
    }

    /// Writes EXR in linear light, premultiplied by convention of EXR.
    fn exr(&self, size: [u32; 2], colors: &[[f32; 4]], alpha: bool) -> Result<()> {
        let decode: fn(f32) -> f32 = match self.composition.color_space {
            ColorSpace::SrgbDisplay => srgb_to_linear,
            ColorSpace::LinearDisplay => |c| c,
        };
        let color = |c: usize| colors.iter().map(|p| decode(straight(p, p[3])[c]) * p[3]).collect();
        let mut channels = vec![plain("R", color(0)), plain("G", color(1)), plain("B", color(2))];
        if alpha {
            channels.push(plain("A", colors.iter().map(|p| p[3]).collect()));
        }
        let comment = if alpha { "Premultiplied, not over the background." } else { "Over the scene's background." };
        Ok(format::write_exr(self.path, size, channels, &self.header(ColorSpace::LinearDisplay, comment))?)
    }

    /// Writes the parts of the image.
    pub(super) fn layers(&self, picture: LayeredPicture) -> Result<()> {
        let size = [picture.width, picture.height];
        let depth = |name: &str, values: Vec<f32>| {
            let values = values.into_iter().map(|z| if z > 0.0 { z } else { NO_DEPTH }).collect();
            Channel { name: name.to_owned(), values, precise: true }
        };
        let mut channels = vec![];
        for (c, suffix) in ["R", "G", "B", "A"].into_iter().enumerate() {
            let both = picture.splats.iter().zip(&picture.mesh);
            channels.push(plain(suffix, both.map(|(s, m)| s[c] + m[c]).collect()));
            channels.push(plain(&format!("splats.{suffix}"), picture.splats.iter().map(|p| p[c]).collect()));
            channels.push(plain(&format!("mesh.{suffix}"), picture.mesh.iter().map(|p| p[c]).collect()));
        }
        for (c, suffix) in ["X", "Y", "Z"].into_iter().enumerate() {
            channels.push(plain(&format!("N.{suffix}"), picture.normal.iter().map(|n| n[c]).collect()));
        }
        channels.push(depth("Z", picture.expected_depth));
        channels.push(depth("depth.first", picture.median_depth));
        channels.push(Channel { name: "count.splats".to_owned(), values: picture.count, precise: true });
        let comment = "Premultiplied, blended in colorSpace, not over the background. N is y-down: negate Y and Z for glTF and USD. Z is expected depth along the camera's \
                       axis, depth.first where alpha passes one half.";
        Ok(format::write_exr(self.path, size, channels, &self.header(self.composition.color_space, comment))?)
    }

    fn header(&self, color_space: ColorSpace, comment: &str) -> ExrHeader {
        let look = &self.args.look;
        ExrHeader {
            color_space,
            pixel_aspect: format::pixel_aspect(self.camera.intrinsics()),
            comment: comment.to_owned(),
            samples: if look.exr_type == Some(ExrType::Half) { SampleType::Half } else { SampleType::Float },
            compression: if look.exr_compression == Some(Compression::Piz) {
                ExrCompression::Piz
            } else {
                ExrCompression::Zip
            },
        }
    }
}

/// Pixel of a PNG, whose colours end at 1: colours brighter than their alpha keep their brightness by raising it.
fn pixel(premultiplied: &[f32; 4], encode: fn(f32) -> f32) -> [u8; 4] {
    let alpha = premultiplied.iter().copied().fold(0.0, f32::max).min(1.0);
    let [r, g, b, _] = straight(premultiplied, alpha);
    [encode(r), encode(g), encode(b), alpha].map(to_byte)
}

/// Colours divided by their alpha; 0 where alpha is 0.
fn straight(&[r, g, b, _]: &[f32; 4], alpha: f32) -> [f32; 4] {
    let color = |c: f32| if alpha > 0.0 { c / alpha } else { 0.0 };
    [color(r), color(g), color(b), alpha]
}

fn plain(name: &str, values: Vec<f32>) -> Channel {
    Channel { name: name.to_owned(), values, precise: false }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn highlights_keep_their_brightness() {
        let over_black = |p: [f32; 4]| {
            let [r, g, b, a] = pixel(&p, |c| c).map(|v| f32::from(v) / 255.0);
            [r * a, g * a, b * a, a]
        };
        for p in [[0.1, 0.2, 0.3, 0.6], [0.9, 0.2, 0.0, 0.8], [0.0; 4]] {
            let found = over_black(p);
            assert!((0..3).all(|c| (found[c] - p[c]).abs() < 1.01 / 255.0), "{p:?}: {found:?}");
        }
        assert_eq!(pixel(&[0.9, 0.2, 0.0, 0.8], |c| c), [255, 57, 0, 230]);
        assert_eq!(pixel(&[1.5, 0.2, 0.1, 1.0], |c| c), [255, 51, 26, 255], "a picture without alpha is cut off at 1");
        assert_eq!(pixel(&[1.2, 0.6, 0.0, 0.8], |c| c), [255, 153, 0, 255]);
    }
}
