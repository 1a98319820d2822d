//! From a fused volume to a surface that is ready to be unwrapped.

use super::fusion::Fusion;
use super::holes::without_holes;
use super::planar::{PlanarStats, flatten};
use super::smooth::{smooth, without_rough};
use super::surface::{Surface, clean, simplify};
use super::{Contraction, GeometryError};

/// What surface is wanted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SurfaceOptions {
    /// Components with fewer triangles are dropped.
    pub min_component_faces: usize,
    /// Whether flat regions are found, made flat and meshed anew with few triangles.
    pub planar: bool,
    /// Triangles after simplification, at most about.
    pub target_triangles: usize,
}

/// So many of the largest components are kept (2DGS).
const KEEP_COMPONENTS: usize = 50;

/// What each step left.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct SurfaceStats {
    /// That of the volume.
    pub contraction: Option<Contraction>,
    /// Views fused.
    pub views: usize,
    /// Bytes of voxels.
    pub voxel_bytes: usize,
    /// Triangles of the iso-surface.
    pub extracted: usize,
    /// Triangles after cleaning.
    pub cleaned: usize,
    /// Holes that were closed then.
    pub holes: usize,
    /// Triangles that are not rough.
    pub even: usize,
    /// What was flat of these.
    pub planar: PlanarStats,
    /// Triangles after simplification.
    pub simplified: usize,
}

/// Extracts, cleans and simplifies the surface of a fused volume; in contracted space, if it is, so that what is far away is judged as it
/// is seen.
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
    let simplified = simplify(&flat, &keep, options.target_triangles);
    stats.simplified = simplified.triangles.len();
    if stats.simplified == 0 {
        return Err(GeometryError::EmptySurface { step: "simplification", hint: "too few triangles were asked for" });
    }
    Ok((fusion.expanded(simplified), stats))
}
