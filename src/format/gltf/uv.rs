//! From texture coordinates of glTF to those of maps, which do not repeat.

use glam::{Mat2, Vec2};
use gltf::texture::WrappingMode;
use serde_json::Value;

use super::extension::{TEXTURE_TRANSFORM, TexelSource, TextureTransform};
use crate::format::error::{Fault, from_value};
use crate::scene::{Atlas, Texture};

/// How a material reads a texture.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(in crate::format) struct UvMap {
    /// n of `TEXCOORD_n`.
    pub(super) set: u32,
    pub(super) transform: Option<(Mat2, Vec2)>,
    wrap: [WrappingMode; 2],
}

/// What coordinates may pass the border of a tile by, in tiles, and belong to it.
const ROUNDING: f32 = 1e-3;

/// Floats that a repeated texture may take, 256 MB of them; above this it is not repeated.
const MAX_FLOATS: u64 = 1 << 26;

/// Floats that all repeated textures of a file may take, 1 GiB of them.
const MAX_FLOATS_OF_FILE: u64 = 1 << 28;

/// Writes repetitions out for the surfaces of a file, as far as there is room.
#[derive(Default)]
pub(in crate::format) struct Unrolling {
    floats: u64,
}

impl Unrolling {
    /// All maps of a material as these corners need them, scaled to that; what was given, if it would become too large.
    pub(in crate::format) fn unrolled(
        &mut self,
        map: &UvMap,
        atlas: Atlas,
        corners: &mut [[Vec2; 3]],
    ) -> Result<Atlas, Atlas> {
        let [columns, rows] = map.tiles(corners).map(f64::from);
        if columns * rows == 1.0 {
            return Ok(atlas);
        }
        let floats = columns * rows * atlas.floats() as f64;
        if floats > (MAX_FLOATS_OF_FILE - self.floats) as f64 {
            return Err(atlas);
        }
        let (before, mut of_bands) = (corners.to_vec(), corners.to_vec());
        let unrolled = || -> Option<Atlas> {
            let base = map.unrolled(atlas.base(), corners)?;
            let bands = match atlas.bands() {
                Some(bands) => Some(map.unrolled(bands, &mut of_bands)?),
                None => None,
            };
            Atlas::new(base, bands).ok()
        }();
        match unrolled {
            Some(unrolled) => {
                self.floats += floats as u64;
                Ok(unrolled)
            }
            None => {
                corners.copy_from_slice(&before);
                Err(atlas)
            }
        }
    }
}

impl UvMap {
    /// Coordinates of a set as they are.
    pub(in crate::format) fn plain(set: u32) -> Self {
        Self { set, transform: None, wrap: [WrappingMode::ClampToEdge; 2] }
    }

    /// Coordinates that a linear map and a translation take to those of a texture, and how that goes on beyond 0..1.
    pub(in crate::format) fn new(transform: (Mat2, Vec2), wrap: [WrappingMode; 2]) -> Self {
        Self { transform: Some(transform).filter(|t| *t != (Mat2::IDENTITY, Vec2::ZERO)), wrap, ..Self::plain(0) }
    }

    /// That of a `textureInfo`, at the JSON pointer `at`.
    pub(super) fn of(info: &gltf::texture::Info<'_>, at: &str) -> Result<Self, Fault> {
        let sampler = info.texture().sampler();
        let mut map = Self { set: info.tex_coord(), transform: None, wrap: [sampler.wrap_s(), sampler.wrap_t()] };
        map.transform_by(info.extension_value(TEXTURE_TRANSFORM), at)?;
        Ok(map)
    }

    /// That of a texel source, at the JSON pointer `at`.
    pub(super) fn of_source(document: &gltf::Document, source: &TexelSource, at: &str) -> Result<Self, Fault> {
        let wrap = |sampler: gltf::texture::Sampler<'_>| [sampler.wrap_s(), sampler.wrap_t()];
        let Some(texture) = &source.texture else {
            // Without a sampler an accessor ends at its edge, a texture repeats.
            let sampler = source.sampler.and_then(|i| document.samplers().nth(i));
            return Ok(Self {
                wrap: sampler.map_or([WrappingMode::ClampToEdge; 2], wrap),
                ..Self::plain(source.tex_coord)
            });
        };
        let sampled = document.textures().nth(texture.index).map(|t| wrap(t.sampler()));
        let mut map = Self { wrap: sampled.unwrap_or([WrappingMode::Repeat; 2]), ..Self::plain(texture.tex_coord) };
        map.transform_by(texture.extensions.get(TEXTURE_TRANSFORM), &format!("{at}/texture"))?;
        Ok(map)
    }

    fn transform_by(&mut self, value: Option<&Value>, at: &str) -> Result<(), Fault> {
        let Some(value) = value else { return Ok(()) };
        let at = format!("{at}/extensions/{TEXTURE_TRANSFORM}");
        let t: TextureTransform = from_value(value, &at, &format!("an object of {TEXTURE_TRANSFORM}"))?;
        let (sin, cos) = t.rotation.sin_cos();
        let rotation = Mat2::from_cols(Vec2::new(cos, -sin), Vec2::new(sin, cos));
        let transform = (rotation * Mat2::from_diagonal(Vec2::from(t.scale)), Vec2::from(t.offset));
        self.transform = Some(transform).filter(|t| *t != (Mat2::IDENTITY, Vec2::ZERO));
        self.set = t.tex_coord.unwrap_or(self.set);
        Ok(())
    }

    /// Corners of a triangle on the map: transformed, and where the texture repeats, moved into the first tile as far as
    /// whole tiles do. What is left beyond 1 is repeated within the triangle.
    pub(in crate::format) fn corners(&self, uvs: [Vec2; 3]) -> [Vec2; 3] {
        let mut uvs = self.transform.map_or(uvs, |(linear, offset)| uvs.map(|uv| linear * uv + offset));
        for axis in 0..2 {
            let period = match self.wrap[axis] {
                WrappingMode::ClampToEdge => continue,
                WrappingMode::Repeat => 1.0,
                WrappingMode::MirroredRepeat => 2.0,
            };
            let low = uvs.iter().map(|uv| uv[axis]).fold(f32::INFINITY, f32::min);
            let high = uvs.iter().map(|uv| uv[axis]).fold(f32::NEG_INFINITY, f32::max);
            if low >= -ROUNDING && high <= 1.0 + ROUNDING {
                continue;
            }
            let shift = period * ((low + ROUNDING) / period).floor();
            uvs.iter_mut().for_each(|uv| uv[axis] -= shift);
            // In the second, mirrored tile of a period alone: it is the first, read backwards.
            if period == 2.0 && low - shift >= 1.0 - ROUNDING && high - shift <= 2.0 + ROUNDING {
                uvs.iter_mut().for_each(|uv| uv[axis] = 2.0 - uv[axis]);
            }
        }
        uvs
    }

    /// How often the texture lies side by side and one below the other for these corners.
    fn tiles(&self, corners: &[[Vec2; 3]]) -> [f32; 2] {
        [0, 1].map(|axis| {
            let high = corners.as_flattened().iter().map(|uv| uv[axis]).fold(1.0, f32::max);
            if self.wrap[axis] == WrappingMode::ClampToEdge { 1.0 } else { (high - ROUNDING).ceil().max(1.0) }
        })
    }

    /// Writes the repetitions out that `corners` still need: a larger texture, and corners scaled to it. `None` if it
    /// would become too large.
    fn unrolled(&self, texture: &Texture, corners: &mut [[Vec2; 3]]) -> Option<Texture> {
        let [columns, rows] = self.tiles(corners);
        if columns * rows == 1.0 {
            return Some(texture.clone());
        }
        let (w, h) = (texture.width(), texture.height());
        let (width, height) = (f64::from(w) * f64::from(columns), f64::from(h) * f64::from(rows));
        if width.max(height) > f64::from(Texture::MAX_SIDE)
            || width * height * f64::from(texture.channels()) > MAX_FLOATS as f64
        {
            return None;
        }
        let (width, height) = (width as u32, height as u32);
        let source = |i: u32, size: u32, wrap: WrappingMode| {
            let mirrored = wrap == WrappingMode::MirroredRepeat && !(i / size).is_multiple_of(2);
            if mirrored { size - 1 - i % size } else { i % size }
        };
        let channels = texture.channels() as usize;
        let mut texels = Vec::with_capacity(width as usize * height as usize * channels);
        for y in 0..height {
            let row = source(y, h, self.wrap[1]) as usize * w as usize;
            for x in 0..width {
                let texel = (row + source(x, w, self.wrap[0]) as usize) * channels;
                texels.extend_from_slice(&texture.texels()[texel..texel + channels]);
            }
        }
        let scale = Vec2::new(columns, rows).recip();
        corners.as_flattened_mut().iter_mut().for_each(|uv| *uv *= scale);
        Texture::new(width, height, texture.channels(), texels).ok()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn map(wrap: WrappingMode) -> UvMap {
        UvMap { wrap: [wrap; 2], ..UvMap::plain(0) }
    }

    const CORNER: [Vec2; 3] = [Vec2::new(0.25, 0.0), Vec2::new(0.75, 0.0), Vec2::new(0.25, 1.0)];

    #[test]
    fn whole_tiles_are_taken_off() {
        let moved = CORNER.map(|uv| uv + Vec2::new(-3.0, 5.0));
        assert_eq!(map(WrappingMode::Repeat).corners(moved), CORNER);
        assert_eq!(map(WrappingMode::ClampToEdge).corners(moved), moved);
        // −3 is an odd number of tiles: mirrored.
        let mirrored = CORNER.map(|uv| Vec2::new(1.0 - uv.x, 1.0 - uv.y));
        assert_eq!(map(WrappingMode::MirroredRepeat).corners(moved), mirrored);
        for wrap in [WrappingMode::Repeat, WrappingMode::MirroredRepeat] {
            assert_eq!(map(wrap).corners(CORNER), CORNER);
        }
    }

    #[test]
    fn repetitions_within_a_triangle_are_written_out() {
        let texture = Texture::new(2, 1, 1, vec![0.0, 1.0]).unwrap();
        let wide = [Vec2::new(0.0, 0.0), Vec2::new(2.5, 0.0), Vec2::new(0.0, 1.0)];
        for (wrap, texels) in [
            (WrappingMode::Repeat, [0.0, 1.0, 0.0, 1.0, 0.0, 1.0]),
            (WrappingMode::MirroredRepeat, [0.0, 1.0, 1.0, 0.0, 0.0, 1.0]),
        ] {
            let mut corners = [wide];
            let unrolled = map(wrap).unrolled(&texture, &mut corners).unwrap();
            assert_eq!((unrolled.width(), unrolled.height(), unrolled.texels()), (6, 1, &texels[..]));
            assert!(corners[0][1].abs_diff_eq(Vec2::new(2.5 / 3.0, 0.0), 1e-6));
        }
        let mut far = [wide.map(|uv| uv * 1e5)];
        assert!(map(WrappingMode::Repeat).unrolled(&texture, &mut far).is_none());
        let mut corners = [wide];
        assert_eq!(map(WrappingMode::ClampToEdge).unrolled(&texture, &mut corners).unwrap(), texture);
    }
}
