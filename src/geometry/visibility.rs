//! Visibility of a mesh's texels from views, by rays from the cameras.

use std::sync::atomic::{AtomicUsize, Ordering};

use glam::{DVec2, DVec3, Vec2};
use rayon::prelude::*;

use super::{
    GeometryError, MeshBvh, Sight, Viewers,
    raster::{texel_positions, texels_in, texels_touched},
};
use crate::scene::{Camera, Mesh, Texture};

/// Rows of texels per task.
const ROWS: usize = 8;
/// Relative ray length before a texel within which hits count as at the texel: f64 rounding puts its own triangles
/// there.
const SAME_PLACE: f64 = 1e-6;
/// The same length for rays that graze the surface, where rounding along its normal is a long way along the ray.
const SAME_PLACE_GRAZING: f64 = 1e-2;
/// Width, texels, below which a triangle is thin: nearly level, it may pass between two rows of centres for long.
const THIN: f64 = 1.0;
/// Rounding of f32 positions, relative to their largest coordinate, within which triangles count as coincident.
const ROUNDING: f64 = 4.0 * (f32::EPSILON as f64);

/// What views see of a texel.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum TexelSight {
    /// Outside all charts: no triangle contains its centre, and no thin one touches it.
    Outside,
    /// No view sees the point at the texel's centre.
    Hidden,
    /// Seen by a view, which reads mip levels up to this one there: the first view that was found. On a large triangle
    /// others may read higher levels.
    Seen(u8),
}

/// Visibility of all texels of a map, see [`texel_visibility`].
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TexelVisibility {
    /// Width and height in texels.
    pub size: [usize; 2],
    /// `[h·w]`, first row at the top.
    pub texels: Vec<TexelSight>,
    /// Number of rays cast.
    pub rays: usize,
}

impl TexelVisibility {
    /// Numbers of texels in charts, and of those that a view sees.
    #[must_use]
    pub fn counts(&self) -> (usize, usize) {
        let count = |wanted: TexelSight| self.texels.iter().filter(|&&t| t >= wanted).count();
        (count(TexelSight::Hidden), count(TexelSight::Seen(0)))
    }

    /// Per texel, `[h·w]`: whether rendering any view, at full size or downsampled by up to 2^`coarser`, reads it
    /// through mip filtering. These are the seen texels and all that the mip levels read mix with them, at least one
    /// texel around, be they hidden or in a gutter. Approximate at rims: a triangle's coarsest view is determined at
    /// its middle, and the centre of a partly seen texel may be hidden, so views may read a little of other texels,
    /// too. No mip level above `coarsest` is read.
    #[must_use]
    pub fn reached(&self, coarser: u8, coarsest: u8) -> Vec<bool> {
        let [width, height] = self.size;
        let levels = mip_levels(self.size);
        let mut reached: Vec<Vec<bool>> = (0..levels).map(|l| vec![false; (width >> l) * (height >> l)]).collect();
        for (i, sight) in self.texels.iter().enumerate() {
            let TexelSight::Seen(level) = *sight else { continue };
            let level = usize::from(level.saturating_add(coarser).min(coarsest)).min(levels - 1);
            let (across, down) = (taps(i % width, level, width), taps(i / width, level, height));
            for y in down {
                for x in across.clone() {
                    reached[level][y * (width >> level) + x] = true;
                }
            }
        }
        for level in (1..levels).rev() {
            let (finer, coarser) = reached.split_at_mut(level);
            let width = width >> level;
            for (i, is_reached) in finer[level - 1].iter_mut().enumerate() {
                *is_reached |= coarser[0][i / (2 * width) / 2 * width + i % (2 * width) / 2];
            }
        }
        reached.swap_remove(0)
    }
}

/// Number of mip levels of a map of this size; 1 for sizes that no [`Texture`] may have.
fn mip_levels([width, height]: [usize; 2]) -> usize {
    let side = |n: usize| u32::try_from(n).unwrap_or(1);
    Texture::mip_levels_of(side(width), side(height)) as usize
}

/// Columns of a mip level that bilinear filtering reads at positions within column `x` of level 0; `width` is that of
/// level 0.
fn taps(x: usize, level: usize, width: usize) -> std::ops::RangeInclusive<usize> {
    let texels = (1_usize << level) as f64;
    let low = (x as f64 / texels - 0.5).floor().max(0.0) as usize;
    let high = ((x + 1) as f64 / texels - 0.5).ceil().max(0.0) as usize;
    low..=high.min((width >> level) - 1)
}

/// Visibility from `viewers` of each texel of a map of `size` texels (width, height) on `mesh`: whether the point at
/// its centre is in a picture, farther than `near`, with fewer than `layers` triangles of `hidden_by` in front of it,
/// from either side. `hidden_by` holds all meshes in the frame of the cameras, `mesh` among them. Where triangles share
/// a texel it is seen if any of them is.
///
/// Few texel centres, or none, may lie in a triangle. One narrower than a texel is also sampled in the texels that it
/// touches and whose centres no triangle contains, at its point nearest to the centre; one that contains no centre also
/// at its middle.
///
/// Triangles coincident with the texel, its own and others within f32 rounding, do not hide it. Memory is two bytes per
/// texel and some 250 per triangle. A seen texel costs a ray or little more, a hidden one a ray per view that has it in
/// the picture, and a triangle a sort of all views; views that look at it from farthest away are tried first, and among
/// these the one that saw the last texel.
///
/// # Errors
/// If `size` is empty or above [`Texture::MAX_SIDE`] a side, `near` is negative or not a number, or `layers` is 0.
pub fn texel_visibility(
    mesh: &Mesh,
    size: [usize; 2],
    hidden_by: &MeshBvh,
    viewers: &Viewers,
) -> Result<TexelVisibility, GeometryError> {
    if size.iter().any(|side| !(1..=Texture::MAX_SIDE as usize).contains(side)) {
        let expected = format!("1 to {} texels a side", Texture::MAX_SIDE);
        return Err(GeometryError::argument("size", expected, &format!("{}×{}", size[0], size[1])));
    }
    if !(viewers.near >= 0.0 && viewers.near.is_finite()) {
        return Err(GeometryError::argument("near", "a depth of 0 or more", &viewers.near));
    }
    if viewers.layers == 0 {
        return Err(GeometryError::argument("layers", "at least 1", &"0"));
    }
    let faces: Vec<Face> =
        (0..mesh.triangles().len()).into_par_iter().filter_map(|f| Face::new(mesh, f, size)).collect();
    let mut texels = vec![TexelSight::Outside; size[0] * size[1]];
    let rays = AtomicUsize::new(0);
    texels.par_chunks_mut(size[0] * ROWS).enumerate().for_each(|(part, texels)| {
        let rows = part * ROWS..part * ROWS + texels.len() / size[0];
        let mut look = Look::new(viewers, hidden_by, mip_levels(size) - 1);
        let near: Vec<&Face> = faces.iter().filter(|f| f.rows[0] < rows.end && f.rows[1] >= rows.start).collect();
        for face in near.iter().filter(|face| face.has_center) {
            look.at_face(face);
            texels_in(&face.uvs, size, rows.clone(), |x, y, weights| {
                let texel = &mut texels[(y - rows.start) * size[0] + x];
                *texel = (*texel).max(look.at(face, face.point(weights)));
            });
        }
        let is_free: Vec<bool> = texels.iter().map(|texel| *texel == TexelSight::Outside).collect();
        for face in near.iter().filter(|face| face.is_thin) {
            look.at_face(face);
            let index = |x: usize, y: usize| (y - rows.start) * size[0] + x;
            let mut mark = |x: usize, y: usize, weights: DVec3| {
                let texel = &mut texels[index(x, y)];
                *texel = (*texel).max(look.at(face, face.point(weights)));
            };
            let [x, y] = face.middle;
            if !face.has_center && rows.contains(&y) {
                mark(x, y, DVec3::splat(1.0 / 3.0));
            }
            texels_touched(&face.uvs, size, rows.clone(), |x, y| is_free[index(x, y)], mark);
        }
        rays.fetch_add(look.rays, Ordering::Relaxed);
    });
    Ok(TexelVisibility { size, texels, rays: rays.into_inner() })
}

/// A triangle with nonzero area.
struct Face {
    corners: [DVec3; 3],
    normal: DVec3,
    uvs: [Vec2; 3],
    /// First and last row in which it may have texels.
    rows: [usize; 2],
    /// Whether it contains the centre of a texel.
    has_center: bool,
    /// Whether it is narrower than [`THIN`] or contains no centre, so that it may show texels whose centres lie beside
    /// it.
    is_thin: bool,
    /// Texel at its middle, column and row.
    middle: [usize; 2],
    /// World-space steps per texel to the right and down; `None` without area in the map.
    texel: Option<[DVec3; 2]>,
}

impl Face {
    fn new(mesh: &Mesh, face: usize, size: [usize; 2]) -> Option<Self> {
        let corners = mesh.triangles()[face].map(|v| mesh.positions()[v as usize].as_dvec3());
        let uvs = mesh.corner_uvs()[face];
        let (along, beside) = (corners[1] - corners[0], corners[2] - corners[0]);
        let normal = along.cross(beside).try_normalize()?;
        let [a, b, c] = texel_positions(&uvs, size);
        let mut has_center = false;
        texels_in(&uvs, size, 0..size[1], |_, _, _| has_center = true);
        let row = |y: f64| y.clamp(0.0, (size[1] - 1) as f64) as usize;
        let rows = [row(a.y.min(b.y).min(c.y).floor() - 1.0), row(a.y.max(b.y).max(c.y).ceil() + 1.0)];
        let (right, down) = (b - a, c - a);
        let (area, middle) = (right.perp_dot(down), (a + b + c) / 3.0);
        // The inverse of the map from texels to weights.
        let texel = [(along * down.y - beside * right.y) / area, (beside * right.x - along * down.x) / area];
        Some(Self {
            corners,
            normal,
            uvs,
            rows,
            has_center,
            is_thin: !has_center || area.abs() < THIN * right.length().max(down.length()).max(b.distance(c)),
            middle: [(middle.x, size[0]), (middle.y, size[1])]
                .map(|(at, side)| (at.round().max(0.0) as usize).min(side - 1)),
            texel: texel.iter().all(|d| d.is_finite()).then_some(texel),
        })
    }

    fn point(&self, weights: DVec3) -> DVec3 {
        self.corners[0] * weights.x + self.corners[1] * weights.y + self.corners[2] * weights.z
    }
}

/// State of one task that tests texels one after the other.
struct Look<'a> {
    viewers: &'a Viewers<'a>,
    hidden_by: &'a MeshBvh,
    /// Index of the last mip level.
    coarsest: usize,
    /// Views in the order in which they are tried, each with the mip level that it reads at the middle of the triangle.
    order: Vec<(usize, u8)>,
    rays: usize,
}

impl<'a> Look<'a> {
    fn new(viewers: &'a Viewers<'a>, hidden_by: &'a MeshBvh, coarsest: usize) -> Self {
        Self { viewers, hidden_by, coarsest, order: (0..viewers.cameras.len()).map(|i| (i, 0)).collect(), rays: 0 }
    }

    /// Moves views that read coarse levels of this triangle to the front, otherwise keeping their order.
    fn at_face(&mut self, face: &Face) {
        let middle = face.point(DVec3::splat(1.0 / 3.0));
        for (view, level) in &mut self.order {
            let camera = &self.viewers.cameras[*view];
            *level = mip_level(camera, camera.to_camera(middle), face.texel, self.coarsest);
        }
        self.order.sort_by_key(|(_, level)| std::cmp::Reverse(*level));
    }

    fn at(&mut self, face: &Face, point: DVec3) -> TexelSight {
        for i in 0..self.order.len() {
            let (view, level) = self.order[i];
            let Some(sight) = self.viewers.sight(view, point) else { continue };
            self.rays += 1;
            if sight.is_clear(self.hidden_by, self.viewers.layers, same_place(&sight, point, face.normal)) {
                let first = self.order.partition_point(|(_, other)| *other > level);
                self.order[first..=i].rotate_right(1);
                let camera = &self.viewers.cameras[view];
                return TexelSight::Seen(mip_level(camera, sight.in_camera, face.texel, self.coarsest));
            }
        }
        TexelSight::Hidden
    }
}

/// The last part of the way to a point on a plane in which a triangle is where the point is.
fn same_place(sight: &Sight, point: DVec3, normal: DVec3) -> f64 {
    let rounding = ROUNDING * point.abs().max_element() / sight.way.dot(normal).abs().max(f64::MIN_POSITIVE);
    rounding.clamp(SAME_PLACE, SAME_PLACE_GRAZING)
}

/// Highest mip level that a pixel reads at camera-space point `p` of a surface with these world-space steps per texel:
/// from the longer axis of its footprint, as in the renderer.
fn mip_level(camera: &Camera, p: DVec3, texel: Option<[DVec3; 2]>, coarsest: usize) -> u8 {
    let Some(texel) = texel else { return 0 };
    let k = camera.intrinsics();
    let [x, y] = texel
        .map(|d| camera.rotation() * d)
        .map(|d| DVec2::new(k.fx * (d.x * p.z - p.x * d.z), k.fy * (d.y * p.z - p.y * d.z)) / (p.z * p.z));
    let (a, b, c) = (x.dot(x), y.dot(y), x.dot(y));
    let longer = 0.5 * (a + b) + (0.25 * (a - b) * (a - b) + c * c).sqrt();
    // Pixels per texel are the inverse of texels per pixel, so the longer axis of one is the shorter of the other.
    let level = (0.5 * longer.log2() - x.perp_dot(y).abs().log2()).ceil();
    // The level is infinite edge-on, and may be NaN at the camera's plane.
    if level >= coarsest as f64 { coarsest as u8 } else { level.max(0.0) as u8 }
}

#[cfg(test)]
#[path = "visibility_tests.rs"]
mod tests;
