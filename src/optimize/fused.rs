//! Surfaces by fusion of depth maps: of splats, or of triangles between the capture's points.

use glam::Vec3;

use super::{SurfaceOrigin, TrainError, cut_out::clear_unseen, size};
use crate::{
    capture::{self, Capture},
    geometry::{
        self, Contraction, FusionVolume, GeometryError, PointView, SparseStats, Surface, SurfaceOptions, SurfaceStats,
    },
    render::gpu::{Gpu, Renderer},
    scene::{Camera, Composition, HybridScene},
};

/// Largest number of voxels along the radius of the fused region (2DGS has 1024).
const MAX_RESOLUTION: u32 = 1024;
/// Least number of voxels along the radius.
const LEAST_RESOLUTION: u32 = 64;
/// Size of a voxel in pixels at the focus. The depth of splats is noise below the size of a splat: smaller voxels hold
/// crumbs, each a chart of its own; finer detail is found later by moving the vertices.
const VOXEL_PIXELS: f64 = 3.0;
/// Truncation distance, voxels: noise of depths beyond it tears the surface.
const TRUNCATION: f64 = 4.0;
/// Least number of triangles of a connected piece of the iso-surface: some 10×10 voxels.
const LEAST_FACES: usize = 150;

/// Extracts a surface from the splats of a trained scene by fusing their median depths from all cameras of a capture;
/// `triangles` and `planar` as in [`geometry::surface_from_points`]. Of the photographs only alpha and masks are used:
/// pixels that these leave out have no depth.
///
/// `on_view` is called with the index of every view once it is fused; again from 0 where the result was too large and
/// voxels had to grow.
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

/// Makes a surface of the points that these views of a capture see; `triangles` and `planar` as in
/// [`geometry::surface_from_points`].
///
/// # Errors
/// As [`geometry::surface_from_points`].
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

/// Points from which the scene's place and boundedness are estimated: the capture's or, if these are too few, the means
/// of the splats.
pub(super) fn whereabouts(
    capture: &Capture,
    means: impl FnOnce() -> Result<Vec<Vec3>, TrainError>,
) -> Result<Vec<Vec3>, TrainError> {
    if capture.points.len() < Contraction::LEAST_POINTS { means() } else { Ok(capture.positions()) }
}

/// Fuses median depths of the training views, in voxels of some pixels at the focus; in contracted space if `points`
/// ([`whereabouts`]) show the scene to be unbounded.
///
/// `depth_of` yields a camera's depth map `[h·w]`, 0 where there is none; called again for a camera if voxels had to
/// grow.
pub(super) fn from_depths(
    cameras: &[Camera],
    points: &[Vec3],
    triangles: usize,
    planar: bool,
    depth_of: impl FnMut(usize) -> Result<Vec<f32>, TrainError>,
) -> Result<(Surface, SurfaceStats), TrainError> {
    // The radius is twice the distance to the focus, and a pixel there is that distance over the focal length.
    let focal = cameras.iter().map(|c| c.intrinsics().fx).fold(0.0, f64::max);
    let resolution = ((2.0 * focal / VOXEL_PIXELS) as u32).clamp(LEAST_RESOLUTION, MAX_RESOLUTION);
    let contraction = Contraction::if_unbounded(cameras, points)?;
    let options = SurfaceOptions { min_component_faces: LEAST_FACES, planar, target_triangles: triangles };
    let volume = FusionVolume { contraction, resolutions: LEAST_RESOLUTION..=resolution, truncation: TRUNCATION };
    geometry::surface_from_depths(cameras, points, volume, &options, depth_of)
}
