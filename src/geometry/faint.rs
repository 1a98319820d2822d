//! Triangles of a trained mesh that show next to nothing and whose removal would uncover nothing either.

use glam::DVec3;
use rayon::prelude::*;

use super::{
    MeshBvh, Viewers,
    raster::{texel_positions, texels_in},
};
use crate::scene::{Mesh, sigmoid};

/// From this part of the way to a point on, what is met is behind that point and not beside it.
const BEHIND: f64 = 1.0 + 1e-6;

/// Which triangles `[F]` have a mean opacity below `least`, in 0..=1, over the texels of the finest level whose centres
/// lie in them, and have no triangle behind them that is not such a one, as any of the `viewers` sees it. Only a
/// pixel's first layers are drawn, be they as many as they may: with a faint triangle gone one behind it would come to
/// be drawn, of which nobody has trained what it shows from there.
#[must_use]
pub fn faint_triangles(mesh: &Mesh, least: f64, viewers: &Viewers) -> Vec<bool> {
    let base = mesh.atlas().base();
    let size = [base.width(), base.height()].map(|side| side as usize);
    let opacity = |x: usize, y: usize| sigmoid(f64::from(base.texels()[4 * (y * size[0] + x) + 3]));
    let looks_faint = |face: usize| {
        let (mut sum, mut texels) = (0.0, 0.0);
        for_each_texel(mesh, face, size, |x, y, _| {
            sum += opacity(x, y);
            texels += 1.0;
        });
        sum < least * texels
    };
    let faces = 0..mesh.triangles().len();
    let mut faint: Vec<bool> = faces.clone().into_par_iter().map(looks_faint).collect();
    let rest: Vec<[u32; 3]> = faces.filter(|&f| !faint[f]).map(|f| mesh.triangles()[f]).collect();
    let rest = MeshBvh::new([(mesh.positions(), rest.as_slice())]);
    let hides = |point: DVec3| {
        let mut sights = (0..viewers.cameras.len()).filter_map(|view| viewers.sight(view, point));
        sights.any(|sight| sight.has_hit(&rest, BEHIND, f64::INFINITY))
    };
    faint.par_iter_mut().enumerate().filter(|(_, is_faint)| **is_faint).for_each(|(face, is_faint)| {
        let corners = mesh.triangles()[face].map(|v| mesh.positions()[v as usize].as_dvec3());
        // The middle is tested first, as it hides something in most cases that any point does.
        *is_faint = !hides((corners[0] + corners[1] + corners[2]) / 3.0);
        if *is_faint {
            for_each_texel(mesh, face, size, |_, _, w| {
                *is_faint = *is_faint && !hides(corners[0] * w.x + corners[1] * w.y + corners[2] * w.z);
            });
        }
    });
    faint
}

/// Column, row and corner weights of the texels whose centres lie in a triangle; if there are none, of the texel at its
/// middle.
fn for_each_texel(mesh: &Mesh, face: usize, size: [usize; 2], mut each: impl FnMut(usize, usize, DVec3)) {
    let uvs = &mesh.corner_uvs()[face];
    let mut is_empty = true;
    texels_in(uvs, size, 0..size[1], |x, y, weights| {
        is_empty = false;
        each(x, y, weights);
    });
    if is_empty {
        let [a, b, c] = texel_positions(uvs, size);
        let middle = ((a + b + c) / 3.0).round();
        let at = |at: f64, side: usize| (at.max(0.0) as usize).min(side - 1);
        each(at(middle.x, size[0]), at(middle.y, size[1]), DVec3::splat(1.0 / 3.0));
    }
}

#[cfg(test)]
mod tests {
    use glam::{Vec2, Vec3};

    use super::*;
    use crate::scene::{Atlas, Camera, Texture, testing::ahead};

    /// Unit squares across z at depth 2, one below the other in one atlas, each with its x, depth and opacity.
    fn squares(squares: &[(f32, f32, f32)], side: u32) -> Mesh {
        let (mut positions, mut triangles, mut uvs) = (vec![], vec![], vec![]);
        let rows = side / squares.len() as u32;
        for (i, &(x, z, _)) in squares.iter().enumerate() {
            let first = positions.len() as u32;
            let corners = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]];
            positions.extend(corners.map(|[a, b]| Vec3::new(x + a - 0.5, b - 0.5, z)));
            for t in [[0, 1, 2], [0, 2, 3]] {
                triangles.push(t.map(|k| first + k));
                let place = |k: u32| {
                    let [a, b] = corners[k as usize];
                    Vec2::new(a, (i as f32 + b) * rows as f32 / side as f32)
                };
                uvs.push(t.map(place));
            }
        }
        let logit = |opacity: f32| (opacity / (1.0 - opacity)).ln();
        let texel = |i: u32| [0.0, 0.0, 0.0, logit(squares[((i / side / rows) as usize).min(squares.len() - 1)].2)];
        let base = Texture::new(side, side, 4, (0..side * side).flat_map(texel).collect()).unwrap();
        Mesh::new(positions, triangles, uvs, Atlas::new(base, None).unwrap()).unwrap()
    }

    fn camera() -> Camera {
        ahead([100, 100], 50.0, DVec3::ZERO)
    }

    fn faint_squares(mesh: &Mesh, cameras: &[Camera], near: f64) -> Vec<bool> {
        let faint = faint_triangles(mesh, 0.02, &Viewers::unmasked(cameras, near, 1));
        assert!(faint.chunks(2).all(|pair| pair[0] == pair[1]), "{faint:?}");
        faint.into_iter().step_by(2).collect()
    }

    #[test]
    fn what_is_faint_goes_but_not_before_what_is_not() {
        let alone = (-1.0, 2.0, 0.01);
        let before_one = (1.0, 2.0, 0.01);
        let opaque = (1.5, 3.0, 0.9);
        // A neighbour at the same depth is not behind it, so the square is dropped.
        let beside = (0.0, 2.0, 0.021);
        for side in [64, 4] {
            let mesh = squares(&[alone, before_one, opaque, beside], side);
            assert_eq!(faint_squares(&mesh, &[camera()], 0.1), [true, false, false, false], "{side}");
            // In front of the near plane or out of view, a surface hides nothing.
            assert_eq!(faint_squares(&mesh, &[camera()], 2.5), [true, true, false, false]);
            assert_eq!(faint_squares(&mesh, &[], 0.1), [true, true, false, false]);
        }
    }

    #[test]
    fn what_is_faint_may_go_from_before_what_is_faint_but_not_what_both_hide() {
        let (first, second) = ((0.0, 2.0, 0.01), (0.0, 2.5, 0.01));
        assert_eq!(faint_squares(&squares(&[first, second], 64), &[camera()], 0.1), [true, true]);
        let last = (0.0, 3.0, 0.5);
        assert_eq!(faint_squares(&squares(&[first, second, last], 63), &[camera()], 0.1), [false; 3]);
    }

    #[test]
    fn triangles_smaller_than_texels_have_the_opacity_at_their_middle() {
        let (mut opacities, side) = (vec![0.9; 64], 8);
        opacities[3 * 8 + 5] = 0.01;
        let texel = |a: f32| [0.0, 0.0, 0.0, (a / (1.0 - a)).ln()];
        let base = Texture::new(side, side, 4, opacities.into_iter().flat_map(texel).collect()).unwrap();
        let positions = [[0.0, 0.0, 2.0], [0.1, 0.0, 2.0], [0.0, 0.1, 2.0]].map(Vec3::from).to_vec();
        let at = |x: f32, y: f32| Vec2::new(x, y) / side as f32;
        for (x, expected) in [(5.6, true), (4.6, false), (6.6, false)] {
            let uvs = vec![[at(x, 3.6), at(x + 0.2, 3.6), at(x, 3.8)]];
            let atlas = Atlas::new(base.clone(), None).unwrap();
            let mesh = Mesh::new(positions.clone(), vec![[0, 1, 2]], uvs, atlas).unwrap();
            let cameras = [camera()];
            let viewers = Viewers::unmasked(&cameras, 0.1, 1);
            assert_eq!(faint_triangles(&mesh, 0.02, &viewers), [expected], "{x}");
        }
    }
}
