//! From a fused volume to a surface that is ready to be unwrapped.

use super::fusion::{DepthView, Fusion, FusionOptions};
use super::holes::without_holes;
use super::planar::{PlanarOptions, PlanarStats, flatten};
use super::smooth::{smooth, without_rough};
use super::surface::{Surface, clean, simplify};
use super::{Contraction, GeometryError};

/// From depth maps to a mesh that is ready to be unwrapped.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SurfaceOptions {
    /// The volume.
    pub fusion: FusionOptions,
    /// Components with fewer triangles are dropped: 50 (2DGS).
    pub min_component_faces: usize,
    /// So many of the largest components are kept: 50 (2DGS).
    pub keep_components: usize,
    /// Holes with an edge of so many edges are closed, see [`without_holes`]: 40, about 13 voxels across.
    pub max_hole_edges: usize,
    /// Passes of [`smooth`]: 20.
    pub smooth_passes: usize,
    /// Least mean of unit normals around a triangle, see [`without_rough`]: 0.6, which a right-angled edge passes.
    pub least_direction: f64,
    /// What counts as a plane, which is then made flat and meshed anew; `None` if none is sought.
    pub planar: Option<PlanarOptions>,
    /// Triangles after simplification: 100 000.
    pub target_triangles: usize,
}

impl SurfaceOptions {
    /// The defaults named at each field, on the given volume.
    #[must_use]
    pub fn new(fusion: FusionOptions) -> Self {
        Self {
            fusion,
            min_component_faces: 50,
            keep_components: 50,
            max_hole_edges: 40,
            smooth_passes: 20,
            least_direction: 0.6,
            planar: Some(PlanarOptions::default()),
            target_triangles: 100_000,
        }
    }
}

/// Edges around a triangle over which its roughness is judged.
const ROUGH_RADIUS: usize = 4;

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

/// Fuses all views and returns the cleaned, simplified surface. To render, fuse and drop one view at a time or to see
/// the counts, use [`Fusion`] and [`surface_from_fusion`].
///
/// # Errors
/// Those of [`Fusion::new`] and [`Fusion::integrate`], and if no triangle is left.
pub fn surface_from_depths<'a>(
    views: impl IntoIterator<Item = DepthView<'a>>,
    options: &SurfaceOptions,
) -> Result<Surface, GeometryError> {
    let mut fusion = Fusion::new(options.fusion)?;
    for view in views {
        fusion.integrate(&view)?;
    }
    Ok(surface_from_fusion(&fusion, options)?.0)
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
    let extracted = fusion.extract_contracted();
    stats.extracted = extracted.triangles.len();
    if stats.extracted == 0 {
        let hint = "too few views agree on how far away it is";
        return Err(GeometryError::EmptySurface { step: "extraction", hint });
    }
    let cleaned = clean(extracted, options.min_component_faces, options.keep_components);
    stats.cleaned = cleaned.triangles.len();
    if stats.cleaned == 0 {
        let hint = "all its pieces are too small to be kept";
        return Err(GeometryError::EmptySurface { step: "cleaning", hint });
    }
    let mut smoothed;
    (smoothed, stats.holes) = without_holes(cleaned, options.max_hole_edges);
    smooth(&mut smoothed, options.smooth_passes);
    let even = without_rough(smoothed, ROUGH_RADIUS, options.least_direction);
    let even = clean(even, options.min_component_faces, options.keep_components);
    stats.even = even.triangles.len();
    if stats.even == 0 {
        let hint = "the surface has no direction anywhere: its depths disagree by more than they should";
        return Err(GeometryError::EmptySurface { step: "dropping rough parts", hint });
    }
    let (flat, keep) = match &options.planar {
        Some(planar) => {
            let (flat, keep, planes) =
                flatten(even, options.fusion.voxel, contraction.as_ref(), options.target_triangles, planar);
            stats.planar = planes;
            (flat, keep)
        }
        None => (even, vec![]),
    };
    let simplified = simplify(&flat, &keep, options.target_triangles);
    stats.simplified = simplified.triangles.len();
    if stats.simplified == 0 {
        return Err(GeometryError::EmptySurface { step: "simplification", hint: "target_triangles is too small" });
    }
    Ok((fusion.expanded(simplified), stats))
}
