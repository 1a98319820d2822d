//! Surfaces: ray queries, fusion of depth maps, simplification, unwrapping, visibility of texels.

mod bvh;
mod charts;
mod contraction;
mod distance;
mod extract;
mod faint;
mod fusion;
mod gaps;
mod holes;
mod neighbors;
mod occluded;
mod pack;
mod planar;
mod raster;
mod reconstruct;
mod shell;
mod sight;
mod smooth;
mod sparse;
mod surface;
mod tidy;
mod transfer;
mod unwrap;
mod visibility;

use std::fmt::Display;

pub use bvh::{ClosestPoint, Hit, MeshBvh};
pub use contraction::Contraction;
pub use distance::{Ball, SurfaceDistance, surface_distance};
pub use faint::faint_triangles;
pub use fusion::{Fusion, FusionOptions};
pub(crate) use gaps::gaps;
pub use neighbors::mean_squared_distance_to_3_neighbors;
pub use occluded::occluded_splats;
pub use planar::PlanarStats;
pub(crate) use reconstruct::{FusionVolume, surface_from_depths};
pub use reconstruct::{SurfaceOptions, SurfaceStats, surface_from_fusion};
pub use shell::Shell;
pub use sight::{Sight, Viewers};
pub use smooth::{Rings, vertex_normals};
pub use sparse::{PointView, SparseStats, surface_from_points, visible_points};
pub use surface::{Surface, compact, components};
pub use tidy::{Tidying, tidy};
pub use transfer::transfer;
pub use unwrap::{ChartSpace, UnwrapStats, UnwrappedMesh, WIDEST_GUTTER, unwrap};
pub use visibility::{TexelSight, TexelVisibility, texel_visibility};

use crate::scene::SceneError;

/// Error of making or unwrapping a surface.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum GeometryError {
    /// An argument is not valid.
    #[error(transparent)]
    Argument(SceneError),
    /// The fused volume would exceed its memory limit.
    #[error(
        "fusion: expected the surface to fit in {limit_mib} MiB of voxels, found more after {views} views with {resolution} voxels \
         along the longest side"
    )]
    FusionMemory {
        /// [`FusionOptions::max_bytes`] in MiB.
        limit_mib: usize,
        /// Views fused when the limit was reached.
        views: usize,
        /// Voxels along the longest side of [`FusionOptions::bounds`].
        resolution: u32,
    },
    /// A step left no triangle of the surface.
    #[error("surface: expected triangles after {step}, found none; {hint}")]
    EmptySurface {
        /// The step.
        step: &'static str,
        /// Suggestion for the user.
        hint: &'static str,
    },
    /// The charts do not fit the atlas at any useful scale.
    #[error(
        "unwrap: expected the {charts} charts to fit in an atlas of {atlas_size}×{atlas_size} texels, found no room \
         even with the narrowest gutters"
    )]
    AtlasTooSmall {
        /// Number of charts.
        charts: usize,
        /// Side of the atlas in texels.
        atlas_size: u32,
    },
}

impl GeometryError {
    fn argument(field: impl Into<String>, expected: impl Into<String>, found: &dyn Display) -> Self {
        Self::Argument(SceneError::new(field, expected, found.to_string()))
    }
}

#[cfg(test)]
mod tests;
