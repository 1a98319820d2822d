//! Conversion of glTF texture coordinates to those of maps, which do not repeat.

use glam::{Mat2, Vec2};
use gltf::texture::WrappingMode;
use serde_json::Value;

use super::extension::{TEXTURE_TRANSFORM, TexelSource, TextureRef, TextureTransform};
use crate::format::error::{Fault, from_value};
use crate::scene::{Atlas, SceneError, Texture};

/// Texture-coordinate mapping of a material's texture.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(in crate::format) struct UvMap {
    /// Index n of `TEXCOORD_n`.
    pub(super) set: u32,
    pub(super) transform: Option<(Mat2, Vec2)>,
    wrap: [WrappingMode; 2],
}

/// Tolerance, in tiles, by which coordinates may pass the border of a tile and still belong to it.
const ROUNDING: f32 = 1e-3;

/// Most floats of a repeated texture, 256 MB; larger ones are repeated at a lower resolution.
const MAX_FLOATS: u64 = 1 << 26;

/// Most floats of a texture at a lower resolution: 64 MB, which with mips any adapter can bind.
const MAX_FLOATS_REDUCED: u64 = 1 << 24;

/// Most floats of all repeated textures of a file, 1 GiB.
const MAX_FLOATS_OF_FILE: u64 = 1 << 28;

/// Most floats averaged for lower resolutions in a file, some seconds of work: many surfaces may share one texture.
const MAX_AVERAGED_OF_FILE: u64 = 1 << 32;

/// Least fraction of the triangles that must lie beyond the first tile for the rest to lose resolution.
const LEAST_BEYOND: f64 = 0.01;

/// Writes out repetitions of textures for the surfaces of a file, within memory limits.
#[derive(Default)]
pub(in crate::format) struct Unrolling {
    floats: u64,
    averaged: u64,
}

impl Unrolling {
    /// Maps of a material, repeated as these corners need them; scales the corners accordingly. If memory does not
    /// suffice, the maps are repeated at a lower resolution or returned unchanged, with a note.
    pub(in crate::format) fn unrolled(
        &mut self,
        map: &UvMap,
        atlas: Atlas,
        corners: &mut [[Vec2; 3]],
    ) -> (Atlas, Option<String>) {
        let tiles = map.tiles(corners);
        let Some(smaller) = self.fitting(&atlas, tiles, || map.beyond(corners)) else {
            return (atlas, Some(ONCE.to_owned()));
        };
        let tiles = needed(&smaller, tiles);
        if tiles != [1.0; 2] {
            self.floats += floats(&smaller, tiles) as u64;
        }
        let repeated = map.repeated(smaller.base(), tiles).and_then(|base| {
            let bands = smaller.bands().map(|bands| map.repeated(bands, tiles)).transpose()?;
            Atlas::new(base, bands)
        });
        let Ok(repeated) = repeated else { return (atlas, Some(ONCE.to_owned())) };
        let scale = Vec2::from(tiles).recip();
        corners.as_flattened_mut().iter_mut().for_each(|uv| *uv *= scale);
        let (width, height) = (smaller.base().width(), smaller.base().height());
        let said = || format!("a texture that repeats too often is repeated at a lower resolution, {width}×{height}");
        (repeated, (smaller.floats() < atlas.floats()).then(said))
    }

    /// Atlas with its sides halved until its repetitions fit; `None` if that is not worthwhile.
    fn fitting(&mut self, atlas: &Atlas, tiles: [f32; 2], beyond: impl FnOnce() -> f64) -> Option<Atlas> {
        let room = (MAX_FLOATS_OF_FILE - self.floats) as f64;
        let fits = |atlas: &Atlas, most: u64| {
            let tiles = needed(atlas, tiles);
            let each = |map: &Texture| {
                let [width, height] = sides(map, tiles);
                width.max(height) <= f64::from(Texture::MAX_SIDE)
                    && width * height * f64::from(map.channels()) <= most as f64
            };
            tiles == [1.0; 2] || maps(atlas).all(each) && floats(atlas, tiles) <= room
        };
        if fits(atlas, MAX_FLOATS) {
            return Some(atlas.clone());
        }
        if beyond() < LEAST_BEYOND {
            return None;
        }
        let mut smaller = atlas.clone();
        // Terminates: with one texel per side all tiles are equal, and it fits.
        while !fits(&smaller, MAX_FLOATS_REDUCED) {
            self.averaged += smaller.floats() as u64;
            if self.averaged > MAX_AVERAGED_OF_FILE {
                return None;
            }
            let bands = smaller.bands().map(halved).transpose();
            smaller = Atlas::new(halved(smaller.base()).ok()?, bands.ok()?).ok()?;
        }
        Some(smaller)
    }
}

/// Note on a texture that stays unrepeated.
const ONCE: &str = "a texture that repeats too often is shown once, and its edge is extended beyond its borders";

/// Base and band maps.
fn maps(atlas: &Atlas) -> impl Iterator<Item = &Texture> {
    std::iter::once(atlas.base()).chain(atlas.bands())
}

/// Number of tiles that matter: along a side of one texel, only the first does.
fn needed(atlas: &Atlas, [columns, rows]: [f32; 2]) -> [f32; 2] {
    let is_constant = |side: fn(&Texture) -> u32| maps(atlas).all(|map| side(map) == 1);
    [if is_constant(Texture::width) { 1.0 } else { columns }, if is_constant(Texture::height) { 1.0 } else { rows }]
}

/// Width and height of a map after repetition.
fn sides(map: &Texture, [columns, rows]: [f32; 2]) -> [f64; 2] {
    [f64::from(map.width()) * f64::from(columns), f64::from(map.height()) * f64::from(rows)]
}

/// Number of floats of an atlas after repetition.
fn floats(atlas: &Atlas, [columns, rows]: [f32; 2]) -> f64 {
    f64::from(columns) * f64::from(rows) * atlas.floats() as f64
}

/// Halves the resolution, each texel being the mean of 2×2 as in mips; with an odd side, neighbours share a texel.
fn halved(map: &Texture) -> Result<Texture, SceneError> {
    let (w, h, channels) = (map.width(), map.height(), map.channels() as usize);
    let [width, height] = [w, h].map(|side| (side / 2).max(1));
    let under = |i: u32, side: u32, from: u32| i * from / side..((i + 1) * from).div_ceil(side);
    let mut texels = Vec::with_capacity(width as usize * height as usize * channels);
    for y in 0..height {
        for x in 0..width {
            let (rows, columns) = (under(y, height, h), under(x, width, w));
            let count = (rows.len() * columns.len()) as f64;
            for c in 0..channels {
                let mut sum = 0.0;
                for row in rows.clone() {
                    for column in columns.clone() {
                        sum += f64::from(map.texels()[(row as usize * w as usize + column as usize) * channels + c]);
                    }
                }
                texels.push((sum / count) as f32);
            }
        }
    }
    Texture::new(width, height, map.channels(), texels)
}

impl UvMap {
    /// Mapping that uses the coordinates of a set unchanged.
    pub(in crate::format) fn plain(set: u32) -> Self {
        Self { set, transform: None, wrap: [WrappingMode::ClampToEdge; 2] }
    }

    /// Mapping by a linear map and a translation, with the wrapping modes beyond 0..1.
    pub(in crate::format) fn new(transform: (Mat2, Vec2), wrap: [WrappingMode; 2]) -> Self {
        Self { transform: Some(transform).filter(|t| *t != (Mat2::IDENTITY, Vec2::ZERO)), wrap, ..Self::plain(0) }
    }

    /// Mapping of a `textureInfo` at the JSON pointer `at`.
    pub(super) fn of(info: &gltf::texture::Info<'_>, at: &str) -> Result<Self, Fault> {
        let sampler = info.texture().sampler();
        let mut map = Self { set: info.tex_coord(), transform: None, wrap: [sampler.wrap_s(), sampler.wrap_t()] };
        map.transform_by(info.extension_value(TEXTURE_TRANSFORM), at)?;
        Ok(map)
    }

    /// Mapping of a texel source at the JSON pointer `at`.
    pub(super) fn of_source(document: &gltf::Document, source: &TexelSource, at: &str) -> Result<Self, Fault> {
        let wrap = |sampler: gltf::texture::Sampler<'_>| [sampler.wrap_s(), sampler.wrap_t()];
        let Some(texture) = &source.texture else {
            // Without a sampler, an accessor is clamped to its edge, and a texture repeats.
            let sampler = source.sampler.and_then(|i| document.samplers().nth(i));
            return Ok(Self {
                wrap: sampler.map_or([WrappingMode::ClampToEdge; 2], wrap),
                ..Self::plain(source.tex_coord)
            });
        };
        Self::of_texture(document, texture, &format!("{at}/texture"))
    }

    /// Mapping of an extension's `textureInfo` at the JSON pointer `at`; its texture need not exist.
    pub(super) fn of_texture(document: &gltf::Document, texture: &TextureRef, at: &str) -> Result<Self, Fault> {
        let sampler = document.textures().nth(texture.index).map(|t| t.sampler());
        let wrap = sampler.map_or([WrappingMode::Repeat; 2], |sampler| [sampler.wrap_s(), sampler.wrap_t()]);
        let mut map = Self { wrap, ..Self::plain(texture.tex_coord) };
        map.transform_by(texture.extensions.get(TEXTURE_TRANSFORM), at)?;
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

    /// Corners of a triangle on the map: transformed, and for repeating textures shifted by whole tiles into the first
    /// tile as far as possible. Any part that still exceeds 1 is a repetition within the triangle.
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
            // Triangles that lie only in the second, mirrored tile of a period: flipped into the first.
            if period == 2.0 && low - shift >= 1.0 - ROUNDING && high - shift <= 2.0 + ROUNDING {
                uvs.iter_mut().for_each(|uv| uv[axis] = 2.0 - uv[axis]);
            }
        }
        uvs
    }

    /// Number of repetitions of the texture, horizontally and vertically, that these corners need.
    fn tiles(&self, corners: &[[Vec2; 3]]) -> [f32; 2] {
        [0, 1].map(|axis| {
            let high = corners.as_flattened().iter().map(|uv| uv[axis]).fold(1.0, f32::max);
            if self.wrap[axis] == WrappingMode::ClampToEdge { 1.0 } else { (high - ROUNDING).ceil().max(1.0) }
        })
    }

    /// Mean fraction of a triangle that lies beyond the first tile.
    fn beyond(&self, corners: &[[Vec2; 3]]) -> f64 {
        let of_triangle = |uvs: &[Vec2; 3]| {
            let along = |axis: usize| {
                let low = uvs.iter().map(|uv| uv[axis]).fold(f32::INFINITY, f32::min);
                let high = uvs.iter().map(|uv| uv[axis]).fold(f32::NEG_INFINITY, f32::max);
                let repeats = self.wrap[axis] != WrappingMode::ClampToEdge && high > 1.0 + ROUNDING;
                if repeats { ((high - 1.0) / (high - low)).min(1.0) } else { 0.0 }
            };
            f64::from(along(0).max(along(1)))
        };
        corners.iter().map(of_triangle).sum::<f64>() / corners.len() as f64
    }

    /// Repeats a texture horizontally and vertically. The resulting sides have been checked.
    fn repeated(&self, texture: &Texture, tiles: [f32; 2]) -> Result<Texture, SceneError> {
        if tiles == [1.0; 2] {
            return Ok(texture.clone());
        }
        let (w, h) = (texture.width(), texture.height());
        let [width, height] = sides(texture, tiles).map(|side| side as u32);
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
        Texture::new(width, height, texture.channels(), texels)
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
        // −3 is an odd number of tiles, so the texture is mirrored.
        let mirrored = CORNER.map(|uv| Vec2::new(1.0 - uv.x, 1.0 - uv.y));
        assert_eq!(map(WrappingMode::MirroredRepeat).corners(moved), mirrored);
        for wrap in [WrappingMode::Repeat, WrappingMode::MirroredRepeat] {
            assert_eq!(map(wrap).corners(CORNER), CORNER);
        }
    }

    /// A map whose texels have one value in all channels.
    fn grey(width: u32, height: u32, channels: u32, values: &[f32]) -> Texture {
        let texels = values.iter().flat_map(|&v| vec![v; channels as usize]).collect();
        Texture::new(width, height, channels, texels).unwrap()
    }

    /// The first channel of every texel.
    fn values(map: &Texture) -> Vec<f32> {
        map.texels().iter().step_by(map.channels() as usize).copied().collect()
    }

    /// A triangle from the origin to (u, 0) and (0, v).
    fn reaching(u: f32, v: f32) -> [Vec2; 3] {
        [Vec2::ZERO, Vec2::new(u, 0.0), Vec2::new(0.0, v)]
    }

    #[test]
    fn repetitions_within_a_triangle_are_written_out() {
        let atlas = Atlas::new(grey(2, 1, 4, &[0.0, 1.0]), None).unwrap();
        for (wrap, texels) in [
            (WrappingMode::Repeat, [0.0, 1.0, 0.0, 1.0, 0.0, 1.0]),
            (WrappingMode::MirroredRepeat, [0.0, 1.0, 1.0, 0.0, 0.0, 1.0]),
        ] {
            let mut corners = [reaching(2.5, 1.0)];
            let (unrolled, said) = Unrolling::default().unrolled(&map(wrap), atlas.clone(), &mut corners);
            assert_eq!((unrolled.base().width(), unrolled.base().height(), said), (6, 1, None));
            assert_eq!(values(unrolled.base()), texels);
            assert!(corners[0][1].abs_diff_eq(Vec2::new(2.5 / 3.0, 0.0), 1e-6));
        }
        let mut corners = [reaching(2.5, 1.0)];
        let clamped = Unrolling::default().unrolled(&map(WrappingMode::ClampToEdge), atlas.clone(), &mut corners);
        assert_eq!((clamped, corners), ((atlas, None), [reaching(2.5, 1.0)]));
    }

    #[test]
    fn what_repeats_too_often_does_so_at_a_lower_resolution() {
        let base = grey(4, 3, 4, &[0.0, 2.0, 8.0, 8.0, 4.0, 2.0, 8.0, 8.0, 0.0, 4.0, 8.0, 8.0]);
        let atlas = Atlas::new(base, Some(grey(2, 2, 9, &[1.0, 2.0, 3.0, 4.0]))).unwrap();
        let repeat = map(WrappingMode::Repeat);
        // 20,000 texels are too many, 10,000 are not.
        let mut corners = [reaching(5000.0, 0.5)];
        let (unrolled, said) = Unrolling::default().unrolled(&repeat, atlas.clone(), &mut corners);
        assert_eq!(said.unwrap(), "a texture that repeats too often is repeated at a lower resolution, 2×1");
        assert_eq!((unrolled.base().width(), unrolled.base().height()), (10_000, 1));
        assert_eq!(values(unrolled.base())[..4], [2.0, 8.0, 2.0, 8.0]);
        let bands = unrolled.bands().unwrap();
        assert_eq!((bands.width(), bands.height(), values(bands)[4999]), (5000, 1, 2.5));
        assert!(corners[0][1].abs_diff_eq(Vec2::X, 1e-6) && corners[0][2] == Vec2::new(0.0, 0.5));
        // A map of one texel is the same however often it repeats.
        let mut corners = [reaching(1e6, 1e6)];
        let (mean, said) = Unrolling::default().unrolled(&repeat, atlas, &mut corners);
        assert_eq!((values(mean.base()), values(mean.bands().unwrap())), (vec![5.0], vec![2.5]));
        assert!(said.unwrap().ends_with("lower resolution, 1×1"));
        assert_eq!(corners, [reaching(1e6, 1e6)]);
    }

    #[test]
    fn for_few_triangles_beyond_a_tile_the_rest_keeps_its_resolution() {
        let atlas = Atlas::new(grey(4, 1, 4, &[0.0, 1.0, 2.0, 3.0]), None).unwrap();
        let mut corners = [CORNER; 200];
        corners[7] = reaching(5000.0, 1.0);
        let before = corners;
        let (once, said) = Unrolling::default().unrolled(&map(WrappingMode::Repeat), atlas.clone(), &mut corners);
        assert_eq!((once, said.as_deref()), (atlas, Some(ONCE)));
        assert_eq!(corners, before);
    }
}
