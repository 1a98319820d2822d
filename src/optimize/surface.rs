//! A mesh for the hybrid: from splats by way of their depth maps, or from geometry that the user has.

use glam::{Vec2, Vec3};

use super::{TrainError, TrainOptions};
use crate::{
    geometry::{self, DepthView, Fusion, FusionOptions, Surface, SurfaceOptions},
    scene::{Atlas, Camera, Mesh, Texture, sh},
};

/// Most voxels along the depth range (2DGS has 1024).
const MAX_RESOLUTION: u32 = 1024;

/// Where the mesh comes from.
#[derive(Clone, Debug, Default, PartialEq)]
pub enum MeshSource {
    /// No mesh: plain 3DGS.
    None,
    /// Splats are trained first and their median depths fused (METHODS 6).
    #[default]
    Splats,
    /// The user's; unwrapped if it has no texture coordinates.
    Given {
        /// Geometry in the capture's world frame.
        surface: Surface,
        /// UV of every corner, v downwards, `[F]`.
        corner_uvs: Option<Vec<[Vec2; 3]>>,
    },
}

/// Fuses median depths of the training views into a mesh with empty maps.
///
/// `depths` yields every training camera with its depth map `[h·w]`, 0 where there is none.
pub(super) fn from_depths(
    cameras: &[Camera],
    points: &[Vec3],
    options: &TrainOptions,
    texture_size: u32,
    mut depth_of: impl FnMut(usize) -> Result<Vec<f32>, TrainError>,
) -> Result<Mesh, TrainError> {
    // A voxel as large as a pixel at the focus: coarser ones blur the maps, finer ones hold noise. The depth range is
    // twice the distance of the focus, which a pixel there divides by the focal length.
    let focal = cameras.iter().map(|c| c.intrinsics().fx).fold(0.0, f64::max);
    let resolution = ((2.0 * focal) as u32).clamp(128, MAX_RESOLUTION);
    let volume = FusionOptions::suggest(cameras, points, resolution)?;
    let mut fusion = Fusion::new(volume)?;
    let bounds = SurfaceOptions { target_triangles: options.triangles, ..SurfaceOptions::new(volume) };
    for (i, camera) in cameras.iter().enumerate() {
        let depth = depth_of(i)?;
        fusion.integrate(&DepthView { camera: *camera, depth: &depth, weight: None })?;
    }
    let (surface, _) = geometry::surface_from_fusion(&fusion, &bounds)?;
    textured(surface, None, options, texture_size)
}

/// A mesh with empty maps: opacity one half, grey (METHODS 4.1).
pub(super) fn textured(
    surface: Surface,
    corner_uvs: Option<Vec<[Vec2; 3]>>,
    options: &TrainOptions,
    texture_size: u32,
) -> Result<Mesh, TrainError> {
    let (surface, corner_uvs) = match corner_uvs {
        Some(uvs) => (surface, uvs),
        None => {
            let unwrapped = geometry::unwrap(&surface, texture_size)?;
            (Surface { positions: unwrapped.positions, triangles: unwrapped.triangles }, unwrapped.corner_uvs)
        }
    };
    let degree = options.band_degree.min(sh::MAX_DEGREE);
    let bands = (degree > 0).then(|| {
        let size = (texture_size / 4).max(16);
        Texture::zeros(size, size, 3 * (sh::coefficients(degree) as u32 - 1))
    });
    let atlas = Atlas::new(Texture::zeros(texture_size, texture_size, 4), bands)?;
    Ok(Mesh::new(surface.positions, surface.triangles, corner_uvs, atlas)?)
}
