//! Distance between surfaces.

use glam::DVec3;
use rayon::prelude::*;
use serde::Serialize;

use super::{MeshBvh, Surface, surface::area_normal};

/// Number of samples of each surface.
const SAMPLES: usize = 200_000;

/// Distance between a surface and the true one, as in A. Knapitsch et al., *Tanks and Temples*, 2017: from points
/// evenly spread over both.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct SurfaceDistance {
    /// Mean distance of the surface's points to the truth.
    pub accuracy: f64,
    /// Mean distance of the truth's points to the surface.
    pub completeness: f64,
    /// Chamfer distance: mean of both.
    pub chamfer: f64,
    /// Distance within which points count for the following three.
    pub within: f64,
    /// Fraction of the surface that is within this distance of the truth.
    pub precision: f64,
    /// Fraction of the truth that is within this distance of the surface.
    pub recall: f64,
    /// Harmonic mean of precision and recall.
    pub f_score: f64,
    /// Fraction of the truth within the ball that counts.
    pub counted: f64,
}

/// A ball in world units.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ball {
    /// Centre.
    pub center: DVec3,
    /// Radius.
    pub radius: f64,
}

impl Ball {
    /// All of space.
    pub const EVERYTHING: Self = Self { center: DVec3::ZERO, radius: f64::INFINITY };

    fn contains(&self, p: DVec3) -> bool {
        p.distance(self.center) <= self.radius
    }

    /// Whether the ball may intersect a triangle: it intersects the triangle's bounding box.
    fn may_meet(&self, [a, b, c]: &[DVec3; 3]) -> bool {
        self.contains(self.center.clamp(a.min(*b).min(*c), a.max(*b).max(*c)))
    }
}

/// Compares a surface with the truth. Points of both count if they are in the ball, those of the truth only where
/// `counts` holds: no surface is expected where no view looks. The nearest point on the other surface may lie outside
/// the ball. `None` if one of the surfaces has no area in the ball, or nothing counts.
#[must_use]
pub fn surface_distance(
    surface: &Surface,
    truth: &Surface,
    within: f64,
    ball: Ball,
    counts: impl Fn(DVec3) -> bool + Sync,
) -> Option<SurfaceDistance> {
    let (all, of_surface) = (spread(truth, ball)?, spread(surface, ball)?);
    let of_truth: Vec<DVec3> = all.par_iter().copied().filter(|p| counts(*p)).collect();
    if of_truth.is_empty() || of_surface.is_empty() {
        return None;
    }
    let (accuracy, precision) = to(&of_surface, truth, within);
    let (completeness, recall) = to(&of_truth, surface, within);
    let sum = precision + recall;
    let f_score = if sum > 0.0 { 2.0 * precision * recall / sum } else { 0.0 };
    let counted = of_truth.len() as f64 / all.len() as f64;
    let chamfer = 0.5 * (accuracy + completeness);
    Some(SurfaceDistance { accuracy, completeness, chamfer, within, precision, recall, f_score, counted })
}

/// Mean distance of points to a surface, and the fraction of them within `within` of it.
fn to(points: &[DVec3], surface: &Surface, within: f64) -> (f64, f64) {
    let bvh = MeshBvh::new([(surface.positions.as_slice(), surface.triangles.as_slice())]);
    let distance = |p: &DVec3| bvh.closest_point(*p).map_or(f64::INFINITY, |closest| closest.distance);
    let distances: Vec<f64> = points.par_iter().map(distance).collect();
    let near = distances.iter().filter(|d| **d <= within).count();
    (distances.iter().sum::<f64>() / points.len() as f64, near as f64 / points.len() as f64)
}

/// Points in the ball, out of [`SAMPLES`] points spread evenly by area over the triangles that may intersect it; `None`
/// if these have no area.
fn spread(surface: &Surface, ball: Ball) -> Option<Vec<DVec3>> {
    let corner = |v: u32| surface.positions.get(v as usize).map(|p| p.as_dvec3()).filter(|p| p.is_finite());
    let corners = |t: &[u32; 3]| Some([corner(t[0])?, corner(t[1])?, corner(t[2])?]);
    let triangles: Vec<[DVec3; 3]> =
        surface.triangles.iter().filter_map(corners).filter(|t| ball.may_meet(t)).collect();
    let areas = triangles.iter().map(|t| 0.5 * area_normal(*t).length());
    let mut end = 0.0;
    let ends: Vec<f64> = areas
        .map(|area| {
            end += area;
            end
        })
        .collect();
    if !(end > 0.0 && end.is_finite()) {
        return None;
    }
    let point = |i: usize| {
        let at = (i as f64 + 0.5) / SAMPLES as f64 * end;
        let which = ends.partition_point(|e| *e <= at).min(triangles.len() - 1);
        let [a, b, c] = triangles[which];
        // The R2 sequence (M. Roberts, 2018) within triangles: even, and the same on every run.
        let (u, v) = ((i as f64 * 0.754_877_666_246_692_8).fract(), (i as f64 * 0.569_840_290_998_053_3).fract());
        let (u, v) = if u + v > 1.0 { (1.0 - u, 1.0 - v) } else { (u, v) };
        a + u * (b - a) + v * (c - a)
    };
    Some((0..SAMPLES).into_par_iter().map(point).filter(|p| ball.contains(*p)).collect())
}

#[cfg(test)]
mod tests {
    use glam::Vec3;

    use super::*;

    /// Unit squares in a row along x, at height `z`.
    fn squares(count: u32, z: f32) -> Surface {
        let positions = (0..=count).flat_map(|x| [0.0, 1.0].map(|y| Vec3::new(x as f32, y, z))).collect();
        let square = |x: u32| [[2 * x, 2 * x + 2, 2 * x + 3], [2 * x, 2 * x + 3, 2 * x + 1]];
        Surface { positions, triangles: (0..count).flat_map(square).collect() }
    }

    #[test]
    fn distances_are_those_of_planes() {
        let found = surface_distance(&squares(2, 0.25), &squares(2, 0.0), 0.25, Ball::EVERYTHING, |_| true).unwrap();
        assert!((found.accuracy - 0.25).abs() < 1e-12 && (found.chamfer - 0.25).abs() < 1e-12);
        assert_eq!((found.precision, found.recall, found.f_score, found.counted), (1.0, 1.0, 1.0, 1.0));
        let far = surface_distance(&squares(2, 0.25), &squares(2, 0.0), 0.2, Ball::EVERYTHING, |_| true).unwrap();
        assert_eq!((far.precision, far.recall, far.f_score), (0.0, 0.0, 0.0));
    }

    #[test]
    fn what_is_missing_counts_where_it_is_seen() {
        // One square out of four: the mean distance from the others to it is 1.5 · 3/4.
        let (part, whole) = (squares(1, 0.0), squares(4, 0.0));
        let found = surface_distance(&part, &whole, 0.5, Ball::EVERYTHING, |_| true).unwrap();
        assert!(found.accuracy < 1e-9 && (found.completeness - 1.125).abs() < 1e-4, "{found:?}");
        assert!((found.recall - 0.375).abs() < 1e-4 && found.precision == 1.0, "{found:?}");
        assert!((found.f_score - 2.0 * 0.375 / 1.375).abs() < 1e-4);
        let seen = surface_distance(&part, &whole, 0.5, Ball::EVERYTHING, |p| p.x < 1.0).unwrap();
        assert!((seen.recall, seen.f_score) == (1.0, 1.0) && (seen.counted - 0.25).abs() < 1e-4, "{seen:?}");
        assert_eq!(surface_distance(&part, &whole, 0.5, Ball::EVERYTHING, |_| false), None);
        assert_eq!(surface_distance(&Surface::default(), &whole, 0.5, Ball::EVERYTHING, |_| true), None);
    }

    #[test]
    fn only_what_is_in_the_ball_counts() {
        // The surface ends after the first of forty squares; within the ball of radius 2 the second square is missing.
        let (part, whole) = (squares(1, 0.0), squares(40, 0.0));
        let ball = Ball { center: DVec3::new(0.0, 0.5, 0.0), radius: 2.0 };
        let found = surface_distance(&part, &whole, 0.25, ball, |_| true).unwrap();
        assert!(found.precision == 1.0 && found.counted == 1.0, "{found:?}");
        // The ball's boundary near x = 2 is an arc, which over a chord of 1 cuts off 0.02 of a square.
        assert!((found.recall - 1.25 / 1.98).abs() < 0.01 && (found.completeness - 0.24).abs() < 0.01, "{found:?}");
        let elsewhere = Ball { center: DVec3::new(20.0, 0.0, 0.0), ..ball };
        assert_eq!(surface_distance(&part, &whole, 0.25, elsewhere, |_| true), None, "nothing of the surface is there");
    }
}
