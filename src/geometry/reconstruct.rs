//! Surface reconstruction: from depth maps, or a volume in which they are fused, to a surface that is ready to be
//! unwrapped.

use std::ops::RangeInclusive;

use glam::Vec3;

use super::fusion::{Fusion, FusionOptions};
use super::holes::without_holes;
use super::planar::{PlanarStats, flatten};
use super::smooth::{smooth, without_rough};
use super::surface::{Surface, clean, simplified};
use super::{Contraction, GeometryError};
use crate::scene::Camera;

/// Options of surface reconstruction.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SurfaceOptions {
    /// Least number of triangles of a component; smaller ones are dropped.
    pub min_component_faces: usize,
    /// Whether planar regions are flattened and retriangulated with few triangles.
    pub planar: bool,
    /// Approximate upper bound on triangles after simplification.
    pub target_triangles: usize,
}

/// Volume in which [`surface_from_depths`] fuses.
pub(crate) struct FusionVolume {
    /// Contraction of space, if it is unbounded.
    pub(crate) contraction: Option<Contraction>,
    /// Voxels along the radius: at least, and at most.
    pub(crate) resolutions: RangeInclusive<u32>,
    /// Truncation distance, voxels.
    pub(crate) truncation: f64,
}

/// Number of the largest components that are kept (2DGS).
const KEEP_COMPONENTS: usize = 50;

/// Counts after each step of surface reconstruction.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct SurfaceStats {
    /// Contraction of the volume.
    pub contraction: Option<Contraction>,
    /// Views fused.
    pub views: usize,
    /// Bytes of voxels.
    pub voxel_bytes: usize,
    /// Triangles of the iso-surface.
    pub extracted: usize,
    /// Triangles after cleaning.
    pub cleaned: usize,
    /// Holes closed after cleaning.
    pub holes: usize,
    /// Triangles after dropping rough parts.
    pub even: usize,
    /// Planar regions among these.
    pub planar: PlanarStats,
    /// Triangles after simplification.
    pub simplified: usize,
}

/// Fuses the depth maps of all cameras and reconstructs their surface. The volume follows [`FusionOptions::suggest`]
/// for `points`, but with the truncation of `volume`, at the highest of its resolutions, or at a lower one if voxels do
/// not fit into memory. `depth_of` is that of [`Fusion::of_depths`].
///
/// # Errors
/// Those of [`Fusion::of_depths`] and [`surface_from_fusion`].
pub(crate) fn surface_from_depths<E: From<GeometryError>>(
    cameras: &[Camera],
    points: &[Vec3],
    volume: FusionVolume,
    options: &SurfaceOptions,
    depth_of: impl FnMut(usize) -> Result<Vec<f32>, E>,
) -> Result<(Surface, SurfaceStats), E> {
    let FusionVolume { contraction, resolutions, truncation } = volume;
    let of_resolution = |resolution: u32| {
        let suggested = FusionOptions::suggest(cameras, points, resolution, contraction)?;
        Ok(FusionOptions { truncation: truncation * suggested.voxel, ..suggested })
    };
    let fusion = Fusion::of_depths(cameras, resolutions, of_resolution, depth_of)?;
    Ok(surface_from_fusion(&fusion, options)?)
}

/// Extracts, cleans and simplifies the surface of a fused volume; with a contraction in contracted space, so that far
/// content is judged by its apparent size.
///
/// # Errors
/// If no triangle is left; the message names the step.
pub fn surface_from_fusion(
    fusion: &Fusion,
    options: &SurfaceOptions,
) -> Result<(Surface, SurfaceStats), GeometryError> {
    let contraction = fusion.options.contraction;
    let mut stats =
        SurfaceStats { contraction, views: fusion.views(), voxel_bytes: fusion.bytes(), ..Default::default() };
    let extracted = fusion.extract();
    stats.extracted = extracted.triangles.len();
    if stats.extracted == 0 {
        let hint = "too few views agree on how far away it is";
        return Err(GeometryError::EmptySurface { step: "extraction", hint });
    }
    let cleaned = clean(extracted, options.min_component_faces, KEEP_COMPONENTS);
    stats.cleaned = cleaned.triangles.len();
    if stats.cleaned == 0 {
        let hint = "all its pieces are too small to be kept";
        return Err(GeometryError::EmptySurface { step: "cleaning", hint });
    }
    let mut smoothed;
    (smoothed, stats.holes) = without_holes(cleaned);
    smooth(&mut smoothed);
    let even = without_rough(smoothed);
    let even = clean(even, options.min_component_faces, KEEP_COMPONENTS);
    stats.even = even.triangles.len();
    if stats.even == 0 {
        let hint = "the surface has no direction anywhere: its depths disagree by more than they should";
        return Err(GeometryError::EmptySurface { step: "dropping rough parts", hint });
    }
    let (flat, keep);
    if options.planar {
        let voxel = fusion.options.voxel;
        (flat, keep, stats.planar) = flatten(even, voxel, contraction.as_ref(), options.target_triangles);
    } else {
        (flat, keep) = (even, vec![]);
    }
    let simplified = simplified(&flat, &keep, options.target_triangles)?;
    stats.simplified = simplified.triangles.len();
    Ok((fusion.expanded(simplified), stats))
}
