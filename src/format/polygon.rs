//! Triangulation of polygons, and selection of used vertices.

use std::collections::{HashMap, HashSet};

use glam::{DVec3, Vec3};
use spade::{ConstrainedDelaunayTriangulation, Point2, Triangulation as _};

/// Largest inverted area of a triangle of a fan, relative to the polygon's area: rounding inverts triangles whose
/// corners are collinear.
const ROUNDING: f64 = 1e-6;

/// Triangles of a polygon, with its winding, as indices of its corners; none for fewer than three corners. A fan about
/// the first corner where that covers the polygon once, as for convex ones; otherwise constrained Delaunay triangles in
/// the polygon's plane. Polygons that intersect themselves or have no plane also get the fan.
pub(super) fn triangles(corners: &[Vec3]) -> Vec<[usize; 3]> {
    let fan: Vec<[usize; 3]> = (2..corners.len()).map(|i| [0, i - 1, i]).collect();
    let mut normals = fan.iter().map(|t| {
        let [a, b, c] = t.map(|i| corners[i].as_dvec3());
        (b - a).cross(c - a)
    });
    // Newell's normal, which does not depend on the triangulation.
    let normal: DVec3 = normals.clone().sum();
    let least = -ROUNDING * normal.length_squared();
    if normals.all(|n| n.dot(normal) >= least) { fan } else { within(corners, normal).unwrap_or(fan) }
}

/// Renumbers triangles to the vertices that they use, and returns these of the `count` vertices, in order.
pub(super) fn used(count: usize, triangles: &mut [[u32; 3]]) -> Vec<usize> {
    let mut places = vec![None; count];
    triangles.as_flattened().iter().for_each(|&vertex| places[vertex as usize] = Some(0));
    let kept: Vec<usize> = (0..count).filter(|&vertex| places[vertex].is_some()).collect();
    (0..).zip(&kept).for_each(|(place, &vertex)| places[vertex] = Some(place));
    triangles.as_flattened_mut().iter_mut().for_each(|vertex| *vertex = places[*vertex as usize].unwrap_or_default());
    kept
}

/// Constrained Delaunay triangles within an outline, projected along its normal; `None` if the projection intersects
/// itself.
fn within(corners: &[Vec3], normal: DVec3) -> Option<Vec<[usize; 3]>> {
    let normal = normal.try_normalize()?;
    let u = normal.any_orthonormal_vector();
    let v = normal.cross(u);
    // Corners at the same place, such as the ends of a slit to a hole, are represented by the first one.
    let (mut firsts, mut known) = (vec![], HashMap::new());
    let mut vertex = |(i, p): (usize, &Vec3)| {
        *known.entry((p + 0.0).to_array().map(f32::to_bits)).or_insert_with(|| {
            firsts.push(i);
            firsts.len() - 1
        })
    };
    let outline: Vec<usize> = corners.iter().enumerate().map(&mut vertex).collect();
    let sides = outline.iter().zip(outline.iter().cycle().skip(1)).map(|(&a, &b)| [a, b]);
    let sides = sides.filter(|[a, b]| a != b).collect();
    let flat = |&i: &usize| {
        let p = corners[i].as_dvec3() - corners[0].as_dvec3();
        Point2::new(p.dot(u), p.dot(v))
    };
    let points = firsts.iter().map(flat).collect();
    let mut crosses = false;
    let loaded = ConstrainedDelaunayTriangulation::<Point2<f64>>::try_bulk_load_cdt(points, sides, |_| crosses = true);
    let cdt = loaded.ok().filter(|cdt| !crosses && cdt.num_vertices() == firsts.len())?;

    // Traversal from outside inwards: inside faces are reached across an odd number of sides. Both faces at a slit are
    // reached without crossing it.
    let (mut triangles, mut reached, mut is_inside) = (vec![], HashSet::new(), false);
    let (mut beyond, mut front): (Vec<_>, Vec<_>) =
        cdt.convex_hull().map(|edge| edge.rev()).partition(|edge| edge.is_constraint_edge());
    loop {
        while let Some(edge) = front.pop() {
            let Some(face) = edge.face().as_inner().filter(|face| reached.insert(face.index())) else { continue };
            if is_inside {
                triangles.push(face.vertices().map(|vertex| firsts[vertex.index()]));
            }
            for next in [edge.next().rev(), edge.prev().rev()] {
                if next.is_constraint_edge() { &mut beyond } else { &mut front }.push(next);
            }
        }
        if beyond.is_empty() {
            return Some(triangles);
        }
        (front, is_inside) = (std::mem::take(&mut beyond), !is_inside);
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn polygon(corners: &[[f32; 2]]) -> Vec<Vec3> {
        corners.iter().map(|&[x, y]| Vec3::new(x, y, 0.0)).collect()
    }

    /// Twice the area of each triangle, negative if it is flipped.
    fn areas(corners: &[Vec3], normal: Vec3) -> Vec<f32> {
        let area = |[a, b, c]: [Vec3; 3]| (b - a).cross(c - a).dot(normal);
        triangles(corners).into_iter().map(|t| area(t.map(|i| corners[i]))).collect()
    }

    #[test]
    fn convex_polygons_are_fans() {
        let hexagon = [[0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [3.0, 1.0], [2.0, 2.0], [0.0, 2.0]];
        assert_eq!(triangles(&polygon(&hexagon)), [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]]);
        assert_eq!(triangles(&[Vec3::ZERO; 4]), [[0, 1, 2], [0, 2, 3]], "no area");
        assert_eq!(triangles(&[Vec3::NAN; 4]).len(), 2);
        assert_eq!(triangles(&[Vec3::ZERO; 2]), [[0; 3]; 0]);
        let bow_tie = polygon(&[[0.0, 0.0], [2.0, 2.0], [2.0, 0.0], [0.0, 1.0]]);
        assert_eq!(triangles(&bow_tie), [[0, 1, 2], [0, 2, 3]], "crosses itself");
    }

    #[test]
    fn concave_polygons_are_covered_once() {
        let arrow = polygon(&[[0.0, 0.0], [2.0, 0.0], [2.0, 2.0], [1.0, 0.5], [0.0, 2.0]]);
        let found = areas(&arrow, Vec3::Z);
        assert!(found.iter().all(|&a| a > 0.0) && found.iter().sum::<f32>() == 5.0, "{found:?}");
        let back: Vec<Vec3> = arrow.into_iter().rev().collect();
        let found = areas(&back, Vec3::NEG_Z);
        assert!(found.iter().all(|&a| a > 0.0) && found.iter().sum::<f32>() == 5.0, "{found:?}");
    }

    #[test]
    fn a_slit_leads_to_a_hole() {
        let outer = [[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [0.0, 4.0], [0.0, 0.0]];
        let hole = [[1.0, 1.0], [1.0, 3.0], [3.0, 3.0], [3.0, 1.0], [1.0, 1.0]];
        let found = areas(&polygon(&[&outer[..], &hole].concat()), Vec3::Z);
        assert_eq!((found.len(), found.iter().sum::<f32>()), (8, 24.0), "{found:?}");
        assert!(found.iter().all(|&a| a > 0.0), "{found:?}");
    }

    proptest! {
        /// In any plane, at a distance from the origin that is usual in scenes.
        #[test]
        fn what_is_seen_whole_from_within_is_covered_once(radii in prop::collection::vec(0.2f32..1.0, 4..40), tilt in 0f32..6.0) {
            let turn = std::f32::consts::TAU / radii.len() as f32;
            let tilt = glam::Quat::from_euler(glam::EulerRot::XYZ, tilt, 2.0 * tilt, 0.0);
            let corner = |(i, r): (usize, &f32)| tilt * (r * Vec3::new((i as f32 * turn).cos(), (i as f32 * turn).sin(), 0.0)) + 10.0;
            let corners: Vec<Vec3> = radii.iter().enumerate().map(corner).collect();
            let found = areas(&corners, tilt * Vec3::Z);
            let around = radii.iter().zip(radii.iter().cycle().skip(1));
            let whole: f32 = around.map(|(a, b)| a * b * turn.sin()).sum();
            prop_assert_eq!(found.len(), radii.len() - 2);
            prop_assert!(found.iter().all(|&a| a > -1e-4), "{:?}", found);
            prop_assert!((found.iter().sum::<f32>() - whole).abs() < 1e-4, "{:?} {}", found, whole);
        }
    }
}
