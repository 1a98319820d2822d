//! Surfaces by fusion of depth maps: of splats, or of triangles between the capture's points.

use glam::Vec3;

use super::{SurfaceOrigin, TrainError, cut_out::clear_unseen, size};
use crate::{
    capture::{self, Capture},
    geometry::{self, Contraction, GeometryError, PointView, SparseStats, Surface, SurfaceOptions, SurfaceStats},
    render::gpu::{Gpu, Renderer},
    scene::{Camera, Composition, HybridScene},
};

/// Most voxels along the radius of what is fused (2DGS has 1024).
const MAX_RESOLUTION: u32 = 1024;
/// Least voxels along it.
const LEAST_RESOLUTION: u32 = 64;
/// Pixels to a voxel at the focus. The depth of splats is noise below the size of a splat: smaller voxels hold crumbs,
/// each a chart of its own, and what they would resolve is found by moving the vertices.
const VOXEL_PIXELS: f64 = 3.0;
/// Truncation in voxels: noise of depths beyond it tears the surface.
const TRUNCATION: f64 = 4.0;
/// Triangles of the least connected piece of the iso-surface: some 10×10 voxels.
const LEAST_FACES: usize = 150;

/// A surface of the splats of a trained scene: their median depths from all cameras of a capture, fused, `triangles` and `planar` as in
/// [`geometry::surface_from_points`]. Of the photographs only alpha and masks are looked at: pixels that they leave out have no depth.
///
/// `on_view` hears of every view when it is fused, by its index; from 0 again where they did not fit and voxels had to grow.
///
/// # Errors
/// If a photograph cannot be read, the adapter fails or no surface is found.
pub fn from_splats(
    gpu: &Gpu,
    scene: &HybridScene,
    capture: &Capture,
    triangles: usize,
    planar: bool,
    mut on_view: impl FnMut(usize),
) -> Result<(Surface, SurfaceStats), TrainError> {
    let cameras = capture.cameras();
    let splats = &scene.splats;
    let all: Vec<usize> = (0..cameras.len()).collect();
    let extent = size::extent(&cameras, size::median_depth(capture, &all)) as f32;
    let composition = Composition { near: size::near_plane(extent, scene.composition.near), ..scene.composition };
    let scene = HybridScene { splats: splats.clone(), meshes: vec![], composition };
    let mut renderer = Renderer::new(gpu, &scene, &cameras)?;
    let points = whereabouts(capture, || Ok(splats.means().to_vec()))?;
    from_depths(&cameras, &points, triangles, planar, |i| {
        let mut depth = renderer.median_depth(&cameras[i])?;
        clear_unseen(&mut depth, &capture::decode(&capture.views[i])?);
        on_view(i);
        Ok(depth)
    })
}

/// A surface of the points that these views of a capture see; `triangles` and `planar` as in [`geometry::surface_from_points`].
///
/// # Errors
/// As there.
pub fn from_points(
    capture: &Capture,
    views: &[PointView],
    triangles: usize,
    planar: bool,
) -> Result<(Surface, SparseStats, SurfaceOrigin), GeometryError> {
    let (surface, stats) = geometry::surface_from_points(views, &capture.positions(), triangles, planar)?;
    let origin = if stats.is_guess() { SurfaceOrigin::GuessedPoints } else { SurfaceOrigin::Points };
    Ok((surface, stats, origin))
}

/// Points that say where a scene is and whether it has bounds: the capture's or, where these are too few, those of the splats.
pub(super) fn whereabouts(
    capture: &Capture,
    means: impl FnOnce() -> Result<Vec<Vec3>, TrainError>,
) -> Result<Vec<Vec3>, TrainError> {
    if capture.points.len() < Contraction::LEAST_POINTS { means() } else { Ok(capture.positions()) }
}

/// Fuses median depths of the training views, in voxels of some pixels at the focus; in contracted space where `points` ([`whereabouts`]) say
/// that the scene has no bounds.
///
/// `depth_of` yields a camera's depth map `[h·w]`, 0 where there is none; more than once where voxels had to grow.
pub(super) fn from_depths(
    cameras: &[Camera],
    points: &[Vec3],
    triangles: usize,
    planar: bool,
    depth_of: impl FnMut(usize) -> Result<Vec<f32>, TrainError>,
) -> Result<(Surface, SurfaceStats), TrainError> {
    // The radius is twice the distance of the focus, which a pixel there divides by the focal length.
    let focal = cameras.iter().map(|c| c.intrinsics().fx).fold(0.0, f64::max);
    let resolution = ((2.0 * focal / VOXEL_PIXELS) as u32).clamp(LEAST_RESOLUTION, MAX_RESOLUTION);
    let contraction = Contraction::if_unbounded(cameras, points)?;
    let options = SurfaceOptions { min_component_faces: LEAST_FACES, planar, target_triangles: triangles };
    let resolutions = LEAST_RESOLUTION..=resolution;
    geometry::surface_from_depths(cameras, points, contraction, resolutions, TRUNCATION, &options, depth_of)
}
