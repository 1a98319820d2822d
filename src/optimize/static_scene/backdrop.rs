//! First colours of the shell behind everything: what photographs show there. It is so far away that they agree where it is right, and
//! with every texel seen by few views, maps that begin grey would need longer than a warm-up is.

use glam::{DVec2, DVec3, Vec2};
use rayon::prelude::*;

use super::Run;
use crate::{
    capture::Photo,
    geometry::{MeshBvh, Shell},
    optimize::TrainError,
    scene::{Atlas, Camera, Mesh, Texture, sh},
};

/// Opacity logit where a photograph shows it: 0.95, from which both ways are open.
const OPACITY: f32 = 3.0;
/// Texels around a triangle that are painted as well, for those that blend at its edge.
const MARGIN: f32 = 1.0;

/// A triangle of the shell.
struct Face {
    corners: [DVec3; 3],
    spots: Vec<Spot>,
}

/// A texel of it.
struct Spot {
    index: usize,
    is_inside: bool,
    position: DVec3,
    sum: [f32; 3],
    views: f32,
}

impl Run<'_> {
    /// Paints the triangles of the shell with the mean of what those views show there that the maps are warmed up on. Only views
    /// count that see all corners of a triangle past the rest.
    pub(super) fn painted(&self, mesh: Mesh, shell: &Shell) -> Result<Mesh, TrainError> {
        let is_far = |t: &[u32; 3]| shell.holds(mesh.positions()[t[0] as usize]);
        let near: Vec<[u32; 3]> = mesh.triangles().iter().filter(|t| !is_far(t)).copied().collect();
        let bvh = MeshBvh::new([(mesh.positions(), near.as_slice())]);
        let base = mesh.atlas().base();
        let mut faces: Vec<Face> = (mesh.triangles().iter().zip(mesh.corner_uvs()))
            .filter(|(t, _)| is_far(t))
            .map(|(t, uvs)| Face::new(t.map(|v| mesh.positions()[v as usize].as_dvec3()), *uvs, base.width()))
            .collect();
        for i in self.views(false) {
            let view = &self.capture.views[i];
            let photo = self.cache.get(view)?;
            let camera = &self.cameras[i];
            faces.par_iter_mut().for_each(|face| face.add(camera, &photo, &bvh));
        }
        let mut texels = base.texels().to_vec();
        for inside in [false, true] {
            for spot in faces.iter().flat_map(|face| &face.spots).filter(|s| s.is_inside == inside && s.views > 0.0) {
                let dc = sh::dc_from_rgb(spot.sum.map(|sum| sum / spot.views));
                texels[4 * spot.index..4 * spot.index + 4].copy_from_slice(&[dc[0], dc[1], dc[2], OPACITY]);
            }
        }
        let base = Texture::new(base.width(), base.height(), 4, texels)?;
        let atlas = Atlas::new(base, mesh.atlas().bands().cloned())?;
        Ok(mesh.with_atlas(atlas))
    }
}

impl Face {
    fn new(corners: [DVec3; 3], uvs: [Vec2; 3], side: u32) -> Self {
        let [a, b, c] = uvs.map(|uv| uv * side as f32 - 0.5);
        let area = (b - a).perp_dot(c - a);
        let mut spots = vec![];
        if area > 0.0 {
            let low = (a.min(b).min(c) - MARGIN).ceil().max(Vec2::ZERO);
            let high = (a.max(b).max(c) + MARGIN).floor().min(Vec2::splat(side as f32 - 1.0));
            let heights = [c.distance(b), a.distance(c), b.distance(a)].map(|length| area / length);
            for y in low.y as u32..=high.y.max(low.y) as u32 {
                for x in low.x as u32..=high.x.max(low.x) as u32 {
                    let p = Vec2::new(x as f32, y as f32);
                    let (wa, wb) = ((c - b).perp_dot(p - b) / area, (a - c).perp_dot(p - c) / area);
                    let w = [wa, wb, 1.0 - wa - wb];
                    // Distances from the sides, negative outside.
                    let inside = [0, 1, 2].map(|k| w[k] * heights[k]).into_iter().fold(f32::INFINITY, f32::min);
                    if inside >= -MARGIN && x < side && y < side {
                        let position = (0..3).map(|k| f64::from(w[k]) * corners[k]).sum();
                        let index = (y * side + x) as usize;
                        spots.push(Spot { index, is_inside: inside >= 0.0, position, sum: [0.0; 3], views: 0.0 });
                    }
                }
            }
        }
        Self { corners, spots }
    }

    fn add(&mut self, camera: &Camera, photo: &Photo, near: &MeshBvh) {
        if self.corners.iter().any(|p| !Shell::is_seen(camera, *p, near)) {
            return;
        }
        for spot in &mut self.spots {
            let rgb = sample(photo, camera.project(camera.to_camera(spot.position)));
            spot.sum = [0, 1, 2].map(|k| spot.sum[k] + rgb[k]);
            spot.views += 1.0;
        }
    }
}

/// Colour at a place in pixels, between their centres; at the border that of the last.
fn sample(photo: &Photo, at: DVec2) -> [f32; 3] {
    let last = DVec2::new(f64::from(photo.width) - 1.0, f64::from(photo.height) - 1.0);
    let at = (at - 0.5).clamp(DVec2::ZERO, last);
    let (x, y) = (at.x as usize, at.y as usize);
    let (fx, fy) = (at.x.fract() as f32, at.y.fract() as f32);
    let (right, below) = ((x + 1).min(last.x as usize), (y + 1).min(last.y as usize));
    let value = |x: usize, y: usize, k: usize| f32::from(photo.rgba[4 * (y * photo.width as usize + x) + k]) / 255.0;
    [0, 1, 2].map(|k| {
        let row = |y: usize| value(x, y, k) * (1.0 - fx) + value(right, y, k) * fx;
        row(y) * (1.0 - fy) + row(below) * fy
    })
}
