//! Splats hidden by opaque triangles.

use glam::{DMat3, DVec3};
use rayon::prelude::*;

use super::{Hit, MeshBvh, Viewers, bvh::ONE_HIT, raster::texel_positions};
use crate::scene::{Mesh, Splats, sigmoid};

/// Distance from the mean, in standard deviations along each axis to either side, of the points at which a splat is
/// tested.
const DEVIATIONS: f64 = 2.0;
/// A triangle in this last part of the way to a point does not hide it but has it on itself.
const SAME_PLACE: f64 = 1e-6;

/// Which splats `[N]` lie behind opaque triangles. A splat is tested at its mean and at both ends of its axes, two
/// standard deviations away, in all cameras whose picture they are in; it must be in at least one picture. A point is
/// hidden if less than `transmittance`, in 0..=1, passes the first `layers` triangles of the ray to it. A splat may
/// still be seen between these points.
///
/// A visible splat costs a ray or little more, a hidden one seven for every camera. `bvh` is [`MeshBvh::of`] these
/// meshes.
#[must_use]
pub fn occluded_splats(
    splats: &Splats,
    (meshes, bvh): (&[Mesh], &MeshBvh),
    transmittance: f64,
    viewers: &Viewers,
) -> Vec<bool> {
    let veil = Veil { bvh, meshes, transmittance, viewers };
    let is_occluded = |i: usize| {
        let points = samples(splats, i);
        let mut is_hidden = false;
        for view in 0..viewers.cameras.len() {
            for &point in &points {
                match veil.hides(view, point) {
                    Some(true) => is_hidden = true,
                    Some(false) => return false,
                    None => {}
                }
            }
        }
        is_hidden
    };
    (0..splats.len()).into_par_iter().map(is_occluded).collect()
}

/// The mean of a splat and the ends of its axes.
fn samples(splats: &Splats, i: usize) -> [DVec3; 7] {
    let mean = splats.means()[i].as_dvec3();
    let axes = DMat3::from_quat(splats.rotations()[i].as_dquat())
        * DMat3::from_diagonal(DEVIATIONS * splats.log_scales()[i].as_dvec3().exp());
    let [x, y, z] = [axes.x_axis, axes.y_axis, axes.z_axis];
    [mean, mean + x, mean - x, mean + y, mean - y, mean + z, mean - z]
}

/// The meshes that may hide points, and the cameras.
struct Veil<'a> {
    bvh: &'a MeshBvh,
    meshes: &'a [Mesh],
    transmittance: f64,
    viewers: &'a Viewers<'a>,
}

impl Veil<'_> {
    /// Whether a point is hidden from a camera; `None` if it is not in the camera's picture.
    fn hides(&self, view: usize, point: DVec3) -> Option<bool> {
        let sight = self.viewers.sight(view, point)?;
        let (mut passes, mut layers, mut last) = (1.0, 0, f64::NEG_INFINITY);
        for hit in sight.hits_before(self.bvh, SAME_PLACE) {
            if hit.t - last <= ONE_HIT * hit.t {
                continue;
            }
            last = hit.t;
            passes *= 1.0 - opacity(&self.meshes[hit.mesh as usize], &hit);
            layers += 1;
            if passes < self.transmittance || layers == self.viewers.layers {
                break;
            }
        }
        Some(passes < self.transmittance)
    }
}

/// Least opacity among the texels of the finest level that bilinear filtering mixes at a hit.
fn opacity(mesh: &Mesh, hit: &Hit) -> f64 {
    let base = mesh.atlas().base();
    let size = [base.width() as usize, base.height() as usize];
    let corners = texel_positions(&mesh.corner_uvs()[hit.triangle as usize], size);
    let at = corners[0] * hit.barycentrics.x + corners[1] * hit.barycentrics.y + corners[2] * hit.barycentrics.z;
    let taps = |at: f64, side: usize| [at.floor(), at.floor() + 1.0].map(|t| (t.max(0.0) as usize).min(side - 1));
    let logit = |x: usize, y: usize| f64::from(base.texels()[4 * (y * size[0] + x) + 3]);
    let rows = taps(at.y, size[1]).into_iter();
    let least = rows.flat_map(|y| taps(at.x, size[0]).map(|x| logit(x, y))).fold(f64::INFINITY, f64::min);
    sigmoid(least)
}

#[cfg(test)]
mod tests {
    use glam::{DVec2, Quat, Vec2, Vec3};

    use super::*;
    use crate::scene::{Atlas, Camera, SplatArrays, Texture, testing::ahead};

    /// A square of side 2 across z at depth `z`, with these opacities in its quarters (u, v) = (0, 0), (1, 0), (0, 1),
    /// (1, 1).
    fn quarters(z: f32, opacities: [f32; 4]) -> Mesh {
        let corners = [[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]];
        let positions = corners.map(|[x, y]: [f32; 2]| Vec3::new(x, y, z)).to_vec();
        let triangles = vec![[0, 1, 2], [0, 2, 3]];
        let uv = |k: u32| Vec2::from(corners[k as usize]) * 0.5 + 0.5;
        let uvs = triangles.iter().map(|t: &[u32; 3]| t.map(uv)).collect();
        let texel = |i: usize| {
            let opacity = opacities[i / 32 * 2 + i % 8 / 4];
            [0.0, 0.0, 0.0, (opacity / (1.0 - opacity)).ln()]
        };
        let base = Texture::new(8, 8, 4, (0..64).flat_map(texel).collect()).unwrap();
        Mesh::new(positions, triangles, uvs, Atlas::new(base, None).unwrap()).unwrap()
    }

    fn square(z: f32, opacity: f32) -> Mesh {
        quarters(z, [opacity; 4])
    }

    /// Splats at (x, y, z) with these standard deviations along x and z.
    fn splats(at: &[([f32; 3], f32, f32)]) -> Splats {
        let arrays = SplatArrays {
            sh_degree: 0,
            means: at.iter().map(|(mean, ..)| Vec3::from(*mean)).collect(),
            rotations: vec![Quat::IDENTITY; at.len()],
            log_scales: at.iter().map(|&(.., a, b)| Vec3::new(a.ln(), 0.01_f32.ln(), b.ln())).collect(),
            opacity_logits: vec![0.0; at.len()],
            sh: vec![[0.0; 3]; at.len()],
        };
        arrays.check().unwrap()
    }

    /// A camera that looks along z from this z.
    fn camera(z: f64) -> Camera {
        ahead([100, 100], 50.0, z * DVec3::Z)
    }

    fn occluded(splats: &Splats, meshes: &[Mesh], cameras: &[Camera], near: f64, layers: usize) -> Vec<bool> {
        let viewers = Viewers { cameras, near, layers, shows: &|_, _| true };
        occluded_splats(splats, (meshes, &MeshBvh::of(meshes)), 0.02, &viewers)
    }

    #[test]
    fn what_is_all_behind_what_is_opaque_is_occluded() {
        let splats = splats(&[
            ([0.0, 0.0, 3.0], 0.1, 0.1),  // behind, on the line through an edge
            ([0.0, 0.0, 1.0], 0.1, 0.1),  // in front
            ([0.0, 0.0, 2.3], 0.1, 0.1),  // behind
            ([0.0, 0.0, 2.3], 0.1, 0.2),  // protrudes from it
            ([0.0, 0.0, 3.0], 1.0, 0.1),  // extends beyond its edge
            ([2.0, 0.0, 3.0], 0.1, 0.1),  // beside it
            ([0.0, 0.0, 2.0], 0.1, 1e-9), // on it
            ([9.0, 0.0, 3.0], 0.1, 0.1),  // outside the picture
            ([4.0, 0.0, 3.0], 2.0, 0.1),  // one end is hidden, the rest is outside the picture
        ]);
        let opaque = [square(2.0, 0.99)];
        let expected = [true, false, true, false, false, false, false, false, true];
        assert_eq!(occluded(&splats, &opaque, &[camera(0.0)], 0.1, 1), expected);
        assert_eq!(occluded(&splats, &opaque, &[camera(0.0), camera(0.1)], 0.1, 1), expected);
        // A camera beyond the square, or with a near plane beyond it, sees the splats.
        assert_eq!(occluded(&splats, &opaque, &[camera(0.0), camera(2.1)], 0.1, 1)[..2], [false, false]);
        assert_eq!(occluded(&splats, &opaque, &[camera(0.0)], 2.1, 1), [false; 9]);
        assert_eq!(occluded(&splats, &opaque, &[], 0.1, 1), [false; 9]);
        assert_eq!(occluded(&splats, &[], &[camera(0.0)], 0.1, 1), [false; 9]);
        assert_eq!(occluded(&splats, &[square(2.0, 0.97)], &[camera(0.0)], 0.1, 1), [false; 9]);
    }

    #[test]
    fn layers_hide_together_as_far_as_they_are_drawn() {
        let splats = splats(&[([0.0, 0.0, 3.0], 0.1, 0.1)]);
        // A ray through the edge between two triangles passes one layer.
        for (meshes, layers, expected) in [(1, 4, false), (2, 1, false), (2, 2, true), (3, 4, true)] {
            let meshes: Vec<Mesh> = (0..meshes).map(|i| square(2.0 + 0.1 * i as f32, 0.9)).collect();
            assert_eq!(occluded(&splats, &meshes, &[camera(0.0)], 0.1, layers), [expected], "{layers}");
        }
    }

    #[test]
    fn opacities_are_those_of_the_texels_that_are_met() {
        let at = |x: f32, y: f32| ([1.5 * x, 1.5 * y, 3.0], 0.1, 0.1);
        let splats = splats(&[at(-0.5, -0.5), at(0.5, -0.5), at(-0.5, 0.5), at(0.5, 0.5), at(0.0, 0.5)]);
        let found = |meshes: &[Mesh]| occluded(&splats, meshes, &[camera(0.0)], 0.1, 2);
        let (upper, lower) = (quarters(2.0, [0.99, 0.1, 0.99, 0.1]), quarters(2.2, [0.1, 0.1, 0.99, 0.99]));
        assert_eq!(found(&[quarters(2.0, [0.99, 0.1, 0.1, 0.1])]), [true, false, false, false, false]);
        assert_eq!(found(&[quarters(2.0, [0.1, 0.99, 0.1, 0.1])]), [false, true, false, false, false]);
        // Where opaque and transparent texels are mixed, the most transparent one counts.
        assert_eq!(found(&[quarters(2.0, [0.1, 0.1, 0.99, 0.99])]), [false, false, true, true, true]);
        assert_eq!(found(std::slice::from_ref(&upper)), [true, false, true, false, false]);
        for meshes in [[upper.clone(), lower.clone()], [lower, upper]] {
            assert_eq!(found(&meshes), [true, false, true, true, true]);
        }
    }

    #[test]
    fn what_is_masked_says_nothing() {
        let (splats, cameras) = (splats(&[([0.0, 0.0, 3.0], 0.1, 0.1)]), [camera(0.0), camera(2.1)]);
        let shows = |view: usize, _: DVec2| view == 0;
        let viewers = Viewers { cameras: &cameras, near: 0.1, layers: 1, shows: &shows };
        let wall = [square(2.0, 0.99)];
        assert_eq!(occluded_splats(&splats, (&wall, &MeshBvh::of(&wall)), 0.02, &viewers), [true]);
    }
}
