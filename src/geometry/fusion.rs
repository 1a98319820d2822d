use std::{collections::HashMap, ops::RangeInclusive};

use glam::{DVec3, Vec3};
use rayon::prelude::*;

use super::GeometryError;
use super::contraction::Contraction;
use crate::scene::Camera;
use crate::stats::quantile_box;

/// Options for fusing depth maps: extent and resolution of the volume. Lengths are in world units, or with a
/// contraction in units of contracted space.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FusionOptions {
    /// Edge of a voxel.
    pub voxel: f64,
    /// Distance from the surface at which the signed distance is cut off, at least 2 voxels.
    pub truncation: f64,
    /// Box (low corner, high corner) outside which nothing is fused.
    pub bounds: (DVec3, DVec3),
    /// Contraction for unbounded scenes: the grid then lies in contracted space.
    pub contraction: Option<Contraction>,
    /// Depth, world units, beyond which depths are ignored.
    pub max_depth: f64,
    /// Limit on the memory for voxels, bytes.
    pub max_bytes: usize,
}

/// Least number of voxels in contracted space behind the farthest surface: the truncation and some more.
const VOXELS_BEHIND: f64 = 8.0;
/// Largest distance of a surface, in radii of the contraction: parallax ends there, and splats of the sky begin at some
/// 15 (`optimize/background.rs`).
const FARTHEST: f64 = 12.0;

/// Least number of views that must have seen a voxel for it to count (2DGS).
pub(super) const LEAST_VIEWS: f32 = 2.0;

/// Memory for voxels, bytes.
pub(super) const MAX_BYTES: usize = 2 << 30;

impl FusionOptions {
    /// Options with the constants of 2DGS: voxel = radius of [`Contraction::around`] / resolution, truncation = 5
    /// voxels. In bounded scenes the box holds all but the outermost 0.5 % of `points` on each side and reaches no
    /// farther than that radius along any axis from the cameras' focus, and `max_depth` is the largest distance of a
    /// camera to anything in the box. With a `contraction` the box is one of contracted points, and `max_depth` leaves
    /// room for some voxels behind a surface.
    ///
    /// # Errors
    /// Without cameras or with resolution 0.
    pub fn suggest(
        cameras: &[Camera],
        points: &[Vec3],
        resolution: u32,
        contraction: Option<Contraction>,
    ) -> Result<Self, GeometryError> {
        let Contraction { center, radius } = Contraction::around(cameras, points)?;
        if resolution == 0 {
            return Err(GeometryError::argument("resolution", "at least 1 voxel", &"0"));
        }
        let voxel = radius / f64::from(resolution);
        let reach = if contraction.is_some() { 2.0 * radius } else { radius };
        let mut bounds = (center - reach, center + reach);
        let points = points.iter().map(|p| p.as_dvec3());
        let placed = points.map(|p| contraction.map_or(p, |c| c.contract(p)));
        if let Some((low, high)) = quantile_box(placed, 0.005) {
            let margin = (high - low) * 0.05 + 5.0 * voxel;
            let tight = (bounds.0.max(low - margin), bounds.1.min(high + margin));
            if tight.0.cmplt(tight.1).all() {
                bounds = tight;
            }
        }
        let max_depth = match contraction {
            None => {
                let farthest = |c: DVec3| (c - bounds.0).abs().max((c - bounds.1).abs()).length();
                cameras.iter().map(|camera| farthest(camera.center())).fold(0.0, f64::max)
            }
            // A surface at x radii lies 1/x radii inside the contracted ball's boundary.
            Some(_) => radius * (f64::from(resolution) / VOXELS_BEHIND).clamp(1.0, FARTHEST),
        };
        let truncation = 5.0 * voxel;
        Ok(Self { voxel, truncation, bounds, contraction, max_depth, max_bytes: MAX_BYTES })
    }

    /// Position, in the grid's space, of a surface seen at the world point `p`, and the step from there along the ray
    /// of one truncation; `ray` is the ray's step of depth 1.
    fn band(&self, p: DVec3, ray: DVec3) -> (DVec3, DVec3) {
        let Some(contraction) = &self.contraction else { return (p, ray * self.truncation) };
        let along = contraction.along(p, ray);
        (contraction.contract(p), along * (self.truncation * ray.length() / along.length()))
    }
}

/// Voxels along the edge of a block.
pub(super) const SIDE: i32 = 8;
/// Voxels of a block.
pub(super) const VOLUME: usize = (SIDE * SIDE * SIDE) as usize;

/// Signed distance to the surface in units of the truncation, positive outside, and the number of views behind it.
#[derive(Clone, Copy, Default)]
pub(super) struct Voxel {
    pub(super) distance: f32,
    pub(super) views: f32,
}

/// `SIDE`³ voxels, x fastest.
pub(super) struct Block {
    pub(super) key: [i32; 3],
    pub(super) voxels: Box<[Voxel]>,
}

/// A truncated signed distance function on a sparse grid: blocks of 8³ voxels exist only near surfaces that were seen,
/// so memory grows with the surface and not with the volume.
///
/// The order of views matters a little: a view carves free space only out of blocks that exist when it is fused.
pub struct Fusion {
    /// Options of the volume.
    pub(super) options: FusionOptions,
    pub(super) blocks: Vec<Block>,
    pub(super) slots: HashMap<[i32; 3], u32>,
    /// Number of blocks along each axis of the box.
    extent: [i32; 3],
    views: usize,
}

impl Fusion {
    /// An empty volume.
    ///
    /// # Errors
    /// If a number is not positive and finite, the box is empty, has more than 2²⁰ voxels along an axis, or the
    /// truncation is below 2 voxels.
    pub fn new(options: FusionOptions) -> Result<Self, GeometryError> {
        let positive = [("voxel", options.voxel), ("truncation", options.truncation), ("max_depth", options.max_depth)];
        let radius = options.contraction.map(|c| ("contraction", c.radius));
        for (field, value) in positive.into_iter().chain(radius) {
            if !(value > 0.0 && value.is_finite()) {
                return Err(GeometryError::argument(field, "a positive length", &value));
            }
        }
        if options.truncation < 2.0 * options.voxel {
            let expected = format!("at least 2 voxels of {}", options.voxel);
            return Err(GeometryError::argument("truncation", expected, &options.truncation));
        }
        let (low, high) = options.bounds;
        let voxels = (high - low) / options.voxel;
        if !(low.is_finite() && high.is_finite() && voxels.min_element() > 0.0) {
            return Err(GeometryError::argument("bounds", "a box that is not empty", &format!("{low} to {high}")));
        }
        if voxels.max_element() > f64::from(1 << 20) {
            let found = format!("{:.0} voxels", voxels.max_element());
            return Err(GeometryError::argument("bounds", "at most 1048576 voxels along each axis", &found));
        }
        let extent = (voxels / f64::from(SIDE)).ceil().max(DVec3::ONE).as_ivec3().to_array();
        Ok(Self { options, blocks: Vec::new(), slots: HashMap::new(), extent, views: 0 })
    }

    /// Fuses the depth maps of all cameras at the highest of `resolutions`, or at a lower one if voxels do not fit into
    /// memory. `options` yields the options for a resolution, `depth_of` the depth map of a camera by its index, anew
    /// for every resolution.
    ///
    /// # Errors
    /// As [`Self::new`] and [`Self::integrate`], and what `options` and `depth_of` return.
    pub fn of_depths<E: From<GeometryError>>(
        cameras: &[Camera],
        resolutions: RangeInclusive<u32>,
        options: impl Fn(u32) -> Result<FusionOptions, GeometryError>,
        mut depth_of: impl FnMut(usize) -> Result<Vec<f32>, E>,
    ) -> Result<Self, E> {
        let (least, mut resolution) = resolutions.into_inner();
        'resolutions: loop {
            let mut fusion = Self::new(options(resolution)?)?;
            for (i, camera) in cameras.iter().enumerate() {
                let depth = depth_of(i)?;
                match fusion.integrate(camera, &depth) {
                    Err(GeometryError::FusionMemory { .. }) if resolution > least => {
                        // About half of the voxels, as these lie near a surface.
                        resolution = ((0.7 * f64::from(resolution)) as u32).max(least);
                        continue 'resolutions;
                    }
                    fused => fused?,
                }
            }
            return Ok(fusion);
        }
    }

    /// Number of views fused so far.
    #[must_use]
    pub fn views(&self) -> usize {
        self.views
    }

    /// Bytes of voxels allocated so far.
    #[must_use]
    pub fn bytes(&self) -> usize {
        self.blocks.len() * VOLUME * size_of::<Voxel>()
    }

    /// Fuses one view, `depth` `[h·w]` in camera-space z; 0, negative or not finite means no surface. Every voxel in
    /// front of the seen surface and up to one truncation behind it averages (seen depth − own depth), cut off at the
    /// truncation.
    ///
    /// # Errors
    /// If the map does not have the size of the camera's image, or the blocks exceed `max_bytes`; the view is then not
    /// fused.
    pub fn integrate(&mut self, camera: &Camera, depth: &[f32]) -> Result<(), GeometryError> {
        let k = camera.intrinsics();
        let pixels = k.pixels();
        if depth.len() != pixels {
            let expected = format!("{}×{} = {pixels} pixels", k.width, k.height);
            return Err(GeometryError::argument("depth", expected, &depth.len()));
        }
        self.allocate(camera, depth)?;
        let projection = Projection::new(camera, depth, &self.options);
        self.blocks.par_iter_mut().for_each(|block| projection.update(block));
        self.views += 1;
        Ok(())
    }

    /// Allocates the blocks within one truncation of the surface that a camera sees.
    fn allocate(&mut self, camera: &Camera, depth: &[f32]) -> Result<(), GeometryError> {
        let o = self.options;
        let k = camera.intrinsics();
        let (width, to_world) = (k.width as usize, camera.rotation().transpose());
        let center = camera.center();
        // Cells of half a block; samples along the ray are half a cell apart.
        let cell = o.voxel * f64::from(SIDE / 2);
        let cells_of_row = |row: usize| {
            let (mut cells, mut previous) = (Vec::new(), None);
            for (x, &depth) in depth[row * width..(row + 1) * width].iter().enumerate() {
                let Some(depth) = valid_depth(depth, o.max_depth) else { continue };
                let ray = to_world * camera.ray(glam::DVec2::new(x as f64 + 0.5, row as f64 + 0.5));
                let (middle, reach) = o.band(center + ray * f64::from(depth), ray);
                let [near, far] = [middle - reach, middle + reach].map(|p| (p - o.bounds.0) / cell);
                // Neighbouring pixels mostly pass the same cells.
                let ends = Some((near.floor(), far.floor()));
                if ends == previous {
                    continue;
                }
                previous = ends;
                let steps = (2.0 * near.distance(far)).ceil().max(1.0);
                for i in 0..=steps as u32 {
                    let p = near.lerp(far, f64::from(i) / steps);
                    // Skips samples outside by more than a block, which also keeps the numbers within i32.
                    if p.cmpge(DVec3::splat(-2.0)).all() && p.max_element() < f64::from(i32::MAX / 2) {
                        cells.push(p.floor().as_ivec3().to_array());
                    }
                }
            }
            cells.sort_unstable();
            cells.dedup();
            cells
        };
        let mut cells: Vec<[i32; 3]> = (0..k.height as usize).into_par_iter().flat_map_iter(cells_of_row).collect();
        cells.par_sort_unstable();
        cells.dedup();
        // A voxel that projects into a pixel is at most half a step along the ray and half a pixel diagonal across it
        // from a sample; the latter matters for coarse depth maps far away. In contracted space pixels stop growing: at
        // x radii from the centre those of a camera at c are (x + c)(2 − 1/x)/x as wide, which is below 2(1 + c).
        let depths = depth.iter().filter_map(|&depth| valid_depth(depth, o.max_depth));
        let farthest = f64::from(depths.fold(0.0, f32::max));
        let widest =
            o.contraction.map_or(farthest, |c| farthest.min(2.0 * (c.radius + camera.center().distance(c.center))));
        let footprint = widest * 0.71 / k.fx.min(k.fy);
        let reach = 0.25 + (footprint / cell).min(8.0);
        let mut keys: Vec<[i32; 3]> = cells
            .into_par_iter()
            .flat_map_iter(|cell| blocks_around(cell, reach, self.extent))
            .filter(|key| !self.slots.contains_key(key))
            .collect();
        keys.par_sort_unstable();
        keys.dedup();
        if (self.blocks.len() + keys.len()).saturating_mul(VOLUME * size_of::<Voxel>()) > o.max_bytes {
            let resolution = ((o.bounds.1 - o.bounds.0).max_element() / o.voxel).round() as u32;
            return Err(GeometryError::FusionMemory { limit_mib: o.max_bytes >> 20, views: self.views, resolution });
        }
        for key in keys {
            self.slots.insert(key, self.blocks.len() as u32);
            self.blocks.push(Block { key, voxels: vec![Voxel::default(); VOLUME].into() });
        }
        Ok(())
    }
}

/// Keys of the blocks that overlap `cell` (half blocks) grown by `reach` cells on each side.
fn blocks_around(cell: [i32; 3], reach: f64, extent: [i32; 3]) -> impl Iterator<Item = [i32; 3]> {
    let range = |axis: usize| {
        let (low, high) = (f64::from(cell[axis]) - reach, f64::from(cell[axis]) + 1.0 + reach);
        ((low / 2.0).floor() as i32).max(0)..=((high / 2.0).floor() as i32).min(extent[axis] - 1)
    };
    let (rx, ry, rz) = (range(0), range(1), range(2));
    rz.flat_map(move |z| {
        let rx = rx.clone();
        ry.clone().flat_map(move |y| rx.clone().map(move |x| [x, y, z]))
    })
}

fn valid_depth(depth: f32, max_depth: f64) -> Option<f32> {
    (depth > 0.0 && f64::from(depth) <= max_depth).then_some(depth)
}

/// A view with precomputed data for the voxel loop.
struct Projection<'a> {
    camera: &'a Camera,
    /// Depth map `[h·w]`.
    depth: &'a [f32],
    options: &'a FusionOptions,
    /// Camera-space steps of one voxel along the world axes.
    steps: [Vec3; 3],
    /// Unit normals of the four side planes through the camera, pointing inwards.
    sides: [DVec3; 4],
}

impl<'a> Projection<'a> {
    fn new(camera: &'a Camera, depth: &'a [f32], options: &'a FusionOptions) -> Self {
        let k = camera.intrinsics();
        let rotation = camera.rotation();
        let [w, h] = k.size().to_array();
        let sides = [
            DVec3::new(k.fx, 0.0, k.cx),
            DVec3::new(-k.fx, 0.0, w - k.cx),
            DVec3::new(0.0, k.fy, k.cy),
            DVec3::new(0.0, -k.fy, h - k.cy),
        ];
        Self {
            camera,
            depth,
            options,
            steps: [0, 1, 2].map(|axis| (rotation.col(axis) * options.voxel).as_vec3()),
            sides: sides.map(DVec3::normalize),
        }
    }

    fn update(&self, block: &mut Block) {
        let o = self.options;
        let edge = o.voxel * f64::from(SIDE);
        let corner = o.bounds.0 + glam::IVec3::from_array(block.key).as_dvec3() * edge;
        let camera = self.camera;
        let is_outside = |middle: DVec3, radius: f64| {
            let middle = camera.to_camera(middle);
            let aside = self.sides.iter().any(|n| n.dot(middle) < -radius);
            aside || middle.z < -radius || middle.z > o.max_depth + o.truncation + radius
        };
        let truncation = o.truncation as f32;
        let Some(contraction) = o.contraction.filter(|c| (corner + edge / 2.0).distance(c.center) + edge > c.radius)
        else {
            if !is_outside(corner + edge / 2.0, edge * 0.87) {
                let first = camera.to_camera(corner).as_vec3();
                let [dx, dy, dz] = self.steps;
                self.fuse(block, |x, y, z| Some((first + dz * z as f32 + dy * y as f32 + dx * x as f32, truncation)));
            }
            return;
        };
        // Bounding sphere of the contracted block's corners, enlarged since space between them is bent. If a corner is
        // at infinity, each voxel is tested.
        let corners =
            [0, 1, 2, 3, 4, 5, 6, 7].map(|i| DVec3::new(f64::from(i & 1), f64::from(i >> 1 & 1), f64::from(i >> 2)));
        let corners = corners.map(|c| contraction.expand(corner + c * edge));
        let middle = corners.iter().sum::<DVec3>() / 8.0;
        let radius = 1.5 * corners.iter().map(|c| c.distance(middle)).fold(0.0, f64::max);
        if radius.is_finite() && is_outside(middle, radius) {
            return;
        }
        let center = camera.center();
        self.fuse(block, |x, y, z| {
            let world = contraction.expand(corner + DVec3::new(x as f64, y as f64, z as f64) * o.voxel);
            let p = camera.to_camera(world);
            // Ratio of lengths along the ray in the world and in contracted space.
            let ray = world - center;
            let local = o.truncation * ray.length() / contraction.along(world, ray).length();
            (p.z > 0.0 && p.is_finite() && local.is_finite()).then(|| (p.as_vec3(), local as f32))
        });
    }

    /// Fuses the view into all voxels of a block. `place` gives a voxel's camera-space position and the truncation
    /// there.
    fn fuse(&self, block: &mut Block, place: impl Fn(usize, usize, usize) -> Option<(Vec3, f32)>) {
        let side = SIDE as usize;
        for (i, voxel) in block.voxels.iter_mut().enumerate() {
            let Some((p, truncation)) = place(i % side, i / side % side, i / (side * side)) else { continue };
            let Some(distance) = self.sample(p, truncation) else { continue };
            voxel.views += 1.0;
            voxel.distance += ((distance / truncation).min(1.0) - voxel.distance) * voxel.views.recip();
        }
    }

    /// Seen depth minus own depth at the projection of camera-space `p`; `None` if deeper than the truncation behind
    /// the surface. Depth is interpolated bilinearly on a surface and nearest at its edges, so that none is made up
    /// between two surfaces.
    fn sample(&self, p: Vec3, truncation: f32) -> Option<f32> {
        if p.z <= 0.0 {
            return None;
        }
        let k = self.camera.intrinsics();
        let (u, v) = (k.fx as f32 * p.x / p.z + k.cx as f32, k.fy as f32 * p.y / p.z + k.cy as f32);
        let (w, h) = (k.width as usize, k.height as usize);
        if !(u >= 0.0 && v >= 0.0 && u < w as f32 && v < h as f32) {
            return None;
        }
        let at = |x: usize, y: usize| valid_depth(self.depth[y * w + x], self.options.max_depth);
        // `u < w` holds for the f32 nearest to w − tiny too, hence no index is out of range.
        let nearest = (u as usize, v as usize);
        let depth = at(nearest.0, nearest.1)?;
        let in_band = |distance: f32| (distance >= -truncation).then_some(distance);
        let (left, top) = ((u - 0.5).max(0.0), (v - 0.5).max(0.0));
        let (x, y) = (left as usize, top as usize);
        // Far from the surface only the sign matters.
        let rough = depth - p.z;
        if rough.abs() > 2.0 * truncation || x + 1 >= w || y + 1 >= h {
            return in_band(rough);
        }
        let [Some(a), Some(b), Some(c), Some(d)] = [at(x, y), at(x + 1, y), at(x, y + 1), at(x + 1, y + 1)] else {
            return in_band(rough);
        };
        if a.max(b).max(c.max(d)) - a.min(b).min(c.min(d)) > truncation {
            return in_band(rough);
        }
        let (fx, fy) = (left - x as f32, top - y as f32);
        let (upper, lower) = (a + (b - a) * fx, c + (d - c) * fx);
        in_band(upper + (lower - upper) * fy - p.z)
    }
}
