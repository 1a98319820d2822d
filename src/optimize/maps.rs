//! Maps of a mesh before they know anything, and the room that its charts need in them.

use glam::Vec2;

use super::{TrainError, TrainOptions};
use crate::{
    geometry::{GeometryError, Surface, UnwrappedMesh},
    scene::{Atlas, Mesh, Texture, sh},
};

/// What `make` makes of charts in an atlas of `size`² texels, or of up to `largest`² where they have no room in fewer.
pub(super) fn with_room_for_charts<T>(
    mut size: u32,
    largest: u32,
    make: impl Fn(u32) -> Result<T, TrainError>,
) -> Result<T, TrainError> {
    loop {
        match make(size) {
            Err(TrainError::Geometry(GeometryError::AtlasTooSmall { .. })) if size < largest => {
                // By a quarter: of a budget that is small, twice the side may leave nothing for splats.
                size = size.saturating_add(size / 4).next_multiple_of(32).min(largest);
            }
            made => return made,
        }
    }
}

/// [`textured`] with the charts that it was unwrapped into.
pub(super) fn textured_as(
    unwrapped: UnwrappedMesh,
    options: &TrainOptions,
    texture_size: u32,
) -> Result<Mesh, TrainError> {
    let UnwrappedMesh { positions, triangles, corner_uvs, .. } = unwrapped;
    textured(Surface { positions, triangles }, corner_uvs, options, texture_size)
}

/// Side of a texel of the map of higher bands, in texels of the base map.
pub(super) const BAND_TEXEL: u32 = 4;

/// Side of the map of higher bands beside a base map of `texture_size` texels a side: 16 at least.
pub(super) fn band_side(texture_size: u32) -> u32 {
    (texture_size / BAND_TEXEL).max(16)
}

/// A mesh with empty maps (zeros, as in HERA): opacity one half, grey.
pub(super) fn textured(
    surface: Surface,
    corner_uvs: Vec<[Vec2; 3]>,
    options: &TrainOptions,
    texture_size: u32,
) -> Result<Mesh, TrainError> {
    let degree = options.band_degree.min(sh::MAX_DEGREE);
    let bands = (degree > 0).then(|| {
        let side = band_side(texture_size);
        Texture::zeros(side, side, 3 * (sh::coefficients(degree) as u32 - 1))
    });
    let atlas = Atlas::new(Texture::zeros(texture_size, texture_size, 4), bands)?;
    Ok(Mesh::new(surface.positions, surface.triangles, corner_uvs, atlas)?)
}
