//! Initial maps of a mesh, and the atlas size that its charts need.

use glam::Vec2;

use super::{TrainError, TrainOptions};
use crate::{
    geometry::{GeometryError, Surface, UnwrappedMesh},
    scene::{Atlas, Mesh, Texture, sh},
};

/// Result of `make` for an atlas of `size`² texels, or of up to `largest`² if the charts do not fit in fewer.
pub(super) fn with_room_for_charts<T>(
    mut size: u32,
    largest: u32,
    make: impl Fn(u32) -> Result<T, TrainError>,
) -> Result<T, TrainError> {
    loop {
        match make(size) {
            Err(TrainError::Geometry(GeometryError::AtlasTooSmall { .. })) if size < largest => {
                size = larger(size).min(largest);
            }
            made => return made,
        }
    }
}

/// Next larger side: by a quarter, since with a small budget twice the side may leave nothing for splats.
pub(super) fn larger(side: u32) -> u32 {
    side.saturating_add(side / 4).next_multiple_of(32)
}

/// A mesh with empty maps ([`textured`]) on the charts of `unwrapped`.
pub(super) fn textured_as(
    unwrapped: UnwrappedMesh,
    options: &TrainOptions,
    texture_size: u32,
) -> Result<Mesh, TrainError> {
    let UnwrappedMesh { positions, triangles, corner_uvs, .. } = unwrapped;
    textured(Surface { positions, triangles }, corner_uvs, options, texture_size)
}

/// Side of a texel of the map of higher bands, in texels of the base map.
const BAND_TEXEL: u32 = 4;

/// The maps of a mesh: their size, and what they show.
#[derive(Clone, Copy)]
pub(super) struct MapLayout {
    /// Texels of a side of the base map.
    pub(super) side: u32,
    /// SH degree of the map of higher bands; with 0 there is none.
    pub(super) degree: u32,
}

impl MapLayout {
    pub(super) fn of(options: &TrainOptions, side: u32) -> Self {
        Self { side, degree: options.band_degree.min(sh::MAX_DEGREE) }
    }

    /// Side of the map of higher bands: 16 at least.
    pub(super) fn band_side(self) -> u32 {
        (self.side / BAND_TEXEL).max(16)
    }

    /// Floats of the base map and of that of higher bands.
    pub(super) fn floats(self) -> [usize; 2] {
        let texels = |side: u32| side as usize * side as usize;
        [4 * texels(self.side), sh::band_floats(self.degree) * texels(self.band_side())]
    }

    /// Floats of both to a texel of the base map; of all but the smallest, see [`Self::band_side`].
    pub(super) fn floats_per_texel(self) -> f64 {
        4.0 + sh::band_floats(self.degree) as f64 / f64::from(BAND_TEXEL.pow(2))
    }

    /// Maps of zeros.
    fn zeros(self) -> Result<Atlas, TrainError> {
        let square = |side: u32, channels: usize| Texture::zeros(side, side, channels as u32);
        let bands = (self.degree > 0).then(|| square(self.band_side(), sh::band_floats(self.degree)));
        Ok(Atlas::new(square(self.side, 4), bands)?)
    }
}

/// A mesh with maps of zeros, as in HERA: opacity one half, grey.
pub(super) fn textured(
    surface: Surface,
    corner_uvs: Vec<[Vec2; 3]>,
    options: &TrainOptions,
    texture_size: u32,
) -> Result<Mesh, TrainError> {
    let atlas = MapLayout::of(options, texture_size).zeros()?;
    Ok(Mesh::new(surface.positions, surface.triangles, corner_uvs, atlas)?)
}
