//! A mesh for the hybrid: from splats by way of their depth maps, or from geometry that the user has.

use std::sync::Arc;

use glam::{DVec2, Vec2, Vec3};
use rayon::prelude::*;

use super::{TrainError, TrainOptions, size};
use crate::{
    capture::{self, Capture, CaptureError, DECODED_AT_ONCE, Photo, View},
    geometry::{
        self, Contraction, Fusion, FusionOptions, GeometryError, PointView, SparseStats, Surface, SurfaceOptions,
        SurfaceStats, UnwrappedMesh,
    },
    render::gpu::{Gpu, Renderer},
    scene::{Atlas, Camera, Composition, HybridScene, Mesh, Texture, sh},
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
/// Points that the median view must be known to see for a surface of points by default: some too few for its triangles to be
/// more than guesses. Structure from motion finds hundreds.
const LEAST_SEEN: usize = 100;
/// Alpha of a photograph, which may be a mask, from which on surfaces are made of what it shows.
pub(super) const LEAST_ALPHA: u8 = 128;
/// Triangles of the least connected piece of the iso-surface: some 10×10 voxels.
const LEAST_FACES: usize = 150;

/// Where the mesh comes from.
#[derive(Clone, Debug, Default, PartialEq)]
pub enum MeshSource {
    /// No mesh: plain 3DGS.
    None,
    /// Splats are trained first and their median depths fused.
    #[default]
    Splats,
    /// Splats are trained first all the same, to judge the surface; it is made of the points that the training views see
    /// ([`geometry::surface_from_points`]), and only if these are too few as for `Splats`.
    Points,
    /// The user's; unwrapped if it has no texture coordinates.
    Given {
        /// Geometry in the capture's world frame.
        surface: Surface,
        /// UV of every corner, v downwards, `[F]`.
        corner_uvs: Option<Vec<[Vec2; 3]>>,
    },
}

/// What the surface of a trained mesh was made of.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SurfaceOrigin {
    /// It was the user's.
    Given,
    /// The capture's points, where it says of more than half of the training views which of them they see.
    Points,
    /// The capture's points, in half of the training views or more each taken for seen where no other is nearer
    /// ([`geometry::visible_points`]).
    GuessedPoints,
    /// The fused depth of splats.
    Splats,
}

impl MeshSource {
    /// What `centaur train` takes unless told: `Points` if the capture says of its median view that it sees 100 of them or more, else
    /// `Splats`.
    #[must_use]
    pub fn suited_to(capture: &Capture) -> Self {
        let seen = capture.views.iter().map(|view| view.sees.len()).collect();
        if are_many(seen) { Self::Points } else { Self::Splats }
    }

    /// Whether splats are trained before there is a mesh, and handed over to it.
    pub(super) fn is_found(&self) -> bool {
        matches!(self, Self::Splats | Self::Points)
    }
}

/// Near plane of a scene of this extent ([`size::extent`]): as wanted, but no more than a twentieth of it.
pub(super) fn near_plane(extent: f32, wanted: f32) -> f32 {
    wanted.min(0.05 * extent)
}

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
    let composition = Composition { near: near_plane(extent, scene.composition.near), ..scene.composition };
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

/// What these views of a capture see of its points, by the `cameras` of all its views: what its list says, or is likely where that says
/// nothing, and of that what photographs show where `photo_of` has one that may leave something out. A view of which nothing is left then is
/// none.
///
/// # Errors
/// If a photograph cannot be read.
///
/// # Panics
/// If a view has no camera.
pub fn point_views(
    capture: &Capture,
    cameras: &[Camera],
    views: &[usize],
    photo_of: impl Fn(&View) -> Result<Option<Arc<Photo>>, CaptureError> + Sync,
) -> Result<Vec<PointView>, CaptureError> {
    let points = capture.positions();
    let listed = |&i: &usize| {
        let (camera, sees) = (cameras[i], &capture.views[i].sees);
        let known = || PointView { camera, sees: sees.clone(), guessed: false };
        (i, if sees.is_empty() { PointView::guess(camera, &points) } else { known() })
    };
    let mut seen: Vec<(usize, PointView)> = views.par_iter().map(listed).collect();
    let clear = |(i, of_view): &mut (usize, PointView)| {
        let Some(photo) = photo_of(&capture.views[*i])? else { return Ok(()) };
        let camera = of_view.camera;
        let at = |point: &Vec3| camera.in_picture(camera.to_camera(point.as_dvec3()));
        of_view.sees.retain(|&p| points.get(p as usize).and_then(at).is_some_and(|at| shows(&photo, at)));
        Ok::<_, CaptureError>(())
    };
    for part in seen.chunks_mut(DECODED_AT_ONCE) {
        part.par_iter_mut().try_for_each(clear)?;
    }
    Ok(seen.into_iter().map(|(_, of_view)| of_view).filter(|of_view| !of_view.sees.is_empty()).collect())
}

/// Whether so few of the points that views see are left by what photographs show of them that a surface of them would be a guess, where it would
/// not have been one before.
pub(super) fn are_few_left(capture: &Capture, views: &[usize], seen: &[PointView]) -> bool {
    let listed = views.iter().map(|&i| capture.views[i].sees.len()).collect();
    // A view of which nothing is left is none, and has none.
    let left = seen.iter().map(|view| view.sees.len());
    let left = left.chain(std::iter::repeat_n(0, views.len() - seen.len())).collect();
    are_many(listed) && !are_many(left)
}

/// Whether the median view sees enough points for a surface of them, by how many each sees.
fn are_many(mut seen: Vec<usize>) -> bool {
    seen.sort_unstable();
    seen.get(seen.len() / 2).is_some_and(|&median| median >= LEAST_SEEN)
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

/// Takes out the depths `[h·w]` of what a photograph's mask or alpha leaves out.
pub(super) fn clear_unseen(depth: &mut [f32], photo: &Photo) {
    if photo.masked || photo.has_alpha {
        let pixels = depth.iter_mut().zip(photo.rgba.chunks_exact(4));
        pixels.filter(|(_, rgba)| rgba[3] < LEAST_ALPHA).for_each(|(depth, _)| *depth = 0.0);
    }
}

/// Whether a photograph's mask or alpha leaves in what is there.
fn shows(photo: &Photo, at: DVec2) -> bool {
    let pixel = at.y as usize * photo.width as usize + at.x as usize;
    !(photo.masked || photo.has_alpha) || photo.rgba.get(4 * pixel + 3).is_some_and(|alpha| *alpha >= LEAST_ALPHA)
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
    let options = |resolution: u32| {
        let suggested = FusionOptions::suggest(cameras, points, resolution, contraction)?;
        Ok(FusionOptions { truncation: TRUNCATION * suggested.voxel, ..suggested })
    };
    let fusion = Fusion::of_depths(cameras, LEAST_RESOLUTION..=resolution, options, depth_of)?;
    let options = SurfaceOptions { min_component_faces: LEAST_FACES, planar, target_triangles: triangles };
    Ok(geometry::surface_from_fusion(&fusion, &options)?)
}

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

/// What was made, or why it cannot be made of this geometry. What the splats have learnt is worth more than a mesh: that does not end a run.
pub(super) fn or_why_not<T>(made: Result<T, TrainError>) -> Result<Result<T, GeometryError>, TrainError> {
    match made {
        Ok(made) => Ok(Ok(made)),
        Err(TrainError::Geometry(why)) => Ok(Err(why)),
        Err(error) => Err(error),
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
