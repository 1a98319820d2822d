//! Shell: a surface for sky and far background, the part of a sphere around the scene that views see beyond everything
//! else.

use std::collections::HashMap;

use glam::{DVec3, Vec3};
use rayon::prelude::*;

use super::bvh::MeshBvh;
use super::sight::Viewers;
use super::surface::{Surface, compact};
use crate::scene::{Camera, LARGEST_COORDINATE, center_and_spread};
use crate::stats::quantile;

/// Least number of views that must see a triangle of the shell: what a single view sees may be near.
const LEAST_VIEWS: u32 = 2;
/// Largest radius of the shell that parallax asks for, in units of the cameras' spread: beyond, nothing is gained,
/// neither in f32 nor in other viewers. Points may ask for a larger one.
const FARTHEST: f64 = 1000.0;
/// Radius of the shell relative to the distance of all but the outermost hundredth of the points.
const BEYOND_POINTS: f64 = 4.0;
/// Distance of surfaces inside the shell, relative to its radius, up to which they are kept: from there on parallax
/// between the centre and a camera is at most four times that at the shell.
const FARTHEST_SURFACE: f64 = 0.25;
/// Nothing else is where the shell is: all of the way to a point of it counts.
const SAME_PLACE: f64 = 0.0;
/// Edges across the field of view: its triangles are judged one by one.
const EDGES_ACROSS: f64 = 6.0;
/// Most subdivisions of the icosahedron.
const MOST_SUBDIVISIONS: u32 = 4;

/// A sphere so far around the cameras that there is no visible parallax: seen from its centre and from the outermost
/// camera, its points are at most a pixel apart, or, with focal lengths of more than a thousand pixels, a thousandth of
/// a radian.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Shell {
    center: DVec3,
    radius: f64,
    subdivisions: u32,
}

impl Shell {
    /// Largest number of triangles of the shell.
    pub const MOST_TRIANGLES: usize = 20 * 4_usize.pow(MOST_SUBDIVISIONS);

    /// Shell around the cameras, and the points if there are any; `None` if neither gives a scale.
    #[must_use]
    pub fn around(cameras: &[Camera], points: &[Vec3]) -> Option<Self> {
        let (center, spread) = center_and_spread(cameras);
        let focal = cameras.iter().map(|c| c.intrinsics().fx.max(c.intrinsics().fy)).fold(0.0, f64::max);
        let distances = points.iter().map(|p| p.as_dvec3().distance(center)).filter(|d| d.is_finite()).collect();
        let outer = quantile(distances, 0.99).map_or(0.0, |d| BEYOND_POINTS * d);
        let radius = outer.max(spread * focal.min(FARTHEST));
        (radius > 0.0 && radius < LARGEST_COORDINATE).then(|| {
            let width = cameras.iter().map(field_of_view).fold(0.0, f64::max);
            // An edge of an icosahedron spans 63.4°.
            let halvings = (63.4_f64.to_radians() * EDGES_ACROSS / width).log2().ceil();
            Self { center, radius, subdivisions: halvings.clamp(1.0, f64::from(MOST_SUBDIVISIONS)) as u32 }
        })
    }

    /// Whether a point lies on the shell rather than inside.
    #[must_use]
    pub fn holds(&self, point: Vec3) -> bool {
        (point.as_dvec3().distance(self.center) / self.radius - 1.0).abs() < 0.01
    }

    /// The surface with those triangles of the shell that at least two of the viewers see past it, wound to be seen
    /// from within. What of the surface is farther than a quarter of the way to the shell goes: depth hardly shows
    /// there, and the shell takes its place.
    #[must_use]
    pub fn around_surface(&self, mut surface: Surface, viewers: &Viewers) -> Surface {
        let is_within = |p: &Vec3| p.as_dvec3().distance(self.center) <= FARTHEST_SURFACE * self.radius;
        let within: Vec<bool> = surface.positions.iter().map(is_within).collect();
        surface.triangles.retain(|t| t.iter().all(|&v| within[v as usize]));
        let mut surface = compact(surface);
        let far = self.seen_past(&surface, viewers);
        let first = surface.positions.len() as u32;
        surface.positions.extend(far.positions);
        surface.triangles.extend(far.triangles.into_iter().map(|t| t.map(|v| first + v)));
        surface
    }

    /// Its triangles that at least two of the viewers see past `rest`.
    fn seen_past(&self, rest: &Surface, viewers: &Viewers) -> Surface {
        let (directions, triangles) = icosphere(self.subdivisions);
        let corners: Vec<DVec3> = directions.iter().map(|d| self.center + *d * self.radius).collect();
        let bvh = MeshBvh::new([(rest.positions.as_slice(), rest.triangles.as_slice())]);
        let views = 0..viewers.cameras.len();
        let sees = |view: usize, p: DVec3| Self::is_seen(viewers, view, p, &bvh);
        // By corner and camera, which six triangles share.
        let seen: Vec<Vec<bool>> =
            corners.par_iter().map(|p| views.clone().map(|view| sees(view, *p)).collect()).collect();
        let is_seen = |t: &&[u32; 3]| {
            let middle = t.iter().map(|&v| corners[v as usize]).sum::<DVec3>() / 3.0;
            let by = |view: &usize| t.iter().any(|&v| seen[v as usize][*view]) || sees(*view, middle);
            views.clone().filter(by).count() >= LEAST_VIEWS as usize
        };
        let triangles = triangles.par_iter().filter(is_seen).map(|&[a, b, c]| [a, c, b]).collect();
        compact(Surface { positions: corners.iter().map(|p| p.as_vec3()).collect(), triangles })
    }

    /// Whether one of the viewers, by its index, sees a point of a shell past the `rest`.
    ///
    /// # Panics
    /// If there is no such viewer.
    #[must_use]
    pub fn is_seen(viewers: &Viewers, view: usize, point: DVec3, rest: &MeshBvh) -> bool {
        viewers.sight(view, point).is_some_and(|sight| sight.is_clear(rest, viewers.layers, SAME_PLACE))
    }
}

/// Angle of view along the longer side of the picture, radians.
fn field_of_view(camera: &Camera) -> f64 {
    let k = camera.intrinsics();
    2.0 * (0.5 * f64::from(k.width) / k.fx).max(0.5 * f64::from(k.height) / k.fy).atan()
}

/// Unit vectors and triangles of a subdivided icosahedron, counter-clockwise from outside.
fn icosphere(subdivisions: u32) -> (Vec<DVec3>, Vec<[u32; 3]>) {
    let g = (1.0 + 5.0_f64.sqrt()) / 2.0;
    let rectangle = [[-1.0, g], [1.0, g], [-1.0, -g], [1.0, -g]];
    let mut corners: Vec<DVec3> = (0..3)
        .flat_map(|turn| {
            let turned = move |[a, b]: [f64; 2]| [[a, b, 0.0], [0.0, a, b], [b, 0.0, a]][turn];
            rectangle.map(|at| DVec3::from(turned(at)).normalize())
        })
        .collect();
    #[rustfmt::skip]
    let mut triangles = vec![
        [0, 11, 5], [0, 5, 1], [0, 1, 7], [0, 7, 10], [0, 10, 11],
        [1, 5, 9], [5, 11, 4], [11, 10, 2], [10, 7, 6], [7, 1, 8],
        [3, 9, 4], [3, 4, 2], [3, 2, 6], [3, 6, 8], [3, 8, 9],
        [4, 9, 5], [2, 4, 11], [6, 2, 10], [8, 6, 7], [9, 8, 1],
    ];
    for _ in 0..subdivisions {
        let mut middles: HashMap<(u32, u32), u32> = HashMap::new();
        let mut middle = |a: u32, b: u32| {
            *middles.entry((a.min(b), a.max(b))).or_insert_with(|| {
                corners.push((corners[a as usize] + corners[b as usize]).normalize());
                corners.len() as u32 - 1
            })
        };
        triangles = (triangles.iter())
            .flat_map(|&[a, b, c]| {
                let [x, y, z] = [middle(a, b), middle(b, c), middle(c, a)];
                [[a, x, z], [b, y, x], [c, z, y], [x, y, z]]
            })
            .collect();
    }
    (corners, triangles)
}

#[cfg(test)]
mod tests {
    use glam::DVec2;

    use super::*;
    use crate::scene::testing::ahead;

    const NEAR: f64 = 0.2;

    /// Cameras at x = −1, 0, 1 that look along z with a field of view of 53° × 37°.
    fn cameras() -> Vec<Camera> {
        [-1.0, 0.0, 1.0].map(|x: f64| ahead([150, 100], 150.0, x * DVec3::X)).to_vec()
    }

    fn viewers(cameras: &[Camera], near: f64) -> Viewers<'_> {
        Viewers::unmasked(cameras, near, 1)
    }

    /// A square of side 2·`half` across z at depth 3, centred at `x`.
    fn wall(x: f32, half: f32) -> Surface {
        let corners = [[-half, -half], [half, -half], [half, half], [-half, half]];
        let positions = corners.map(|[a, b]| Vec3::new(x + a, b, 3.0)).to_vec();
        Surface { positions, triangles: vec![[0, 1, 2], [0, 2, 3]] }
    }

    #[test]
    fn an_icosphere_is_closed_and_faces_outwards() {
        for level in 0..=MOST_SUBDIVISIONS {
            let (corners, triangles) = icosphere(level);
            assert_eq!(triangles.len(), 20 * 4_usize.pow(level));
            assert_eq!(corners.len(), triangles.len() / 2 + 2);
            let mut edges = HashMap::new();
            for t in &triangles {
                let [a, b, c] = t.map(|v| corners[v as usize]);
                assert!((b - a).cross(c - a).dot(a + b + c) > 0.0);
                (0..3).for_each(|k| *edges.entry((t[k], t[(k + 1) % 3])).or_insert(0) += 1);
            }
            assert!(edges.iter().all(|((a, b), n)| *n == 1 && edges.contains_key(&(*b, *a))));
        }
        assert_eq!(Shell::MOST_TRIANGLES, icosphere(MOST_SUBDIVISIONS).1.len());
    }

    #[test]
    fn it_is_beyond_points_and_parallax() {
        let shell = Shell::around(&cameras(), &[]).unwrap();
        assert_eq!((shell.center, shell.radius), (DVec3::ZERO, 150.0));
        // The parallax between the middle and an outer camera is one pixel, at the middle of the picture.
        let far = DVec3::new(0.0, 0.0, shell.radius);
        let [left, middle, _] = [0, 1, 2].map(|i| cameras()[i].project(cameras()[i].to_camera(far)));
        assert!((left.distance(middle) - 1.0).abs() < 1e-9);
        let points: Vec<Vec3> = (0..1000).map(|i| Vec3::new(0.0, 0.0, if i < 5 { 1e6 } else { 100.0 })).collect();
        assert_eq!(Shell::around(&cameras(), &points).unwrap().radius, 400.0);
        assert_eq!(Shell::around(&[], &[]), None);
        assert_eq!(Shell::around(&cameras()[..1], &[]), None);
        assert!(Shell::around(&cameras()[..1], &points).is_some());
    }

    #[test]
    fn what_two_views_see_past_the_rest_is_kept() {
        let shell = Shell::around(&cameras(), &[]).unwrap();
        let open = shell.seen_past(&Surface::default(), &viewers(&cameras(), NEAR));
        let bvh = MeshBvh::new([(open.positions.as_slice(), open.triangles.as_slice())]);
        // The shell covers the whole picture of the middle camera, and little outside.
        for (x, y) in (0..15).flat_map(|x| (0..10).map(move |y| (x, y))) {
            let ray = cameras()[1].ray(DVec2::new(10.0 * f64::from(x) + 5.0, 10.0 * f64::from(y) + 5.0));
            assert!(bvh.any_hit(DVec3::ZERO, ray, 0.0, 1e4), "{x} {y}");
        }
        let (_, all) = icosphere(shell.subdivisions);
        assert!(open.triangles.len() < all.len() / 8, "{} of {}", open.triangles.len(), all.len());
        assert!(open.positions.iter().all(|p| shell.holds(*p)));
        for t in &open.triangles {
            let [a, b, c] = t.map(|v| open.positions[v as usize].as_dvec3());
            assert!((b - a).cross(c - a).dot(a) < 0.0, "seen from within");
        }
        // A wall hides the shell behind it, but not beside it.
        assert_eq!(shell.seen_past(&wall(0.0, 9.0), &viewers(&cameras(), NEAR)), Surface::default());
        let beside = shell.seen_past(&wall(9.0, 9.0), &viewers(&cameras(), NEAR));
        assert!(beside.triangles.len() > 10 && beside.triangles.len() < open.triangles.len() * 3 / 4);
        // A wall in front of the near plane hides nothing.
        assert_eq!(shell.seen_past(&wall(0.0, 9.0), &viewers(&cameras(), 3.1)), open);
        // One view is too few.
        assert_eq!(shell.seen_past(&Surface::default(), &viewers(&cameras()[..1], NEAR)), Surface::default());
    }

    #[test]
    fn it_takes_the_place_of_what_is_nearly_as_far() {
        let shell = Shell::around(&cameras(), &[]).unwrap();
        let all = shell.around_surface(Surface::default(), &viewers(&cameras(), NEAR));
        let at = |scale: f32| {
            let Surface { positions, triangles } = wall(0.0, 9.0);
            Surface { positions: positions.into_iter().map(|p| p * scale).collect(), triangles }
        };
        // Corners are at a distance of 13.1 × scale; the radius of the shell is 150.
        assert_eq!(shell.around_surface(at(2.9), &viewers(&cameras(), NEAR)), all);
        assert_eq!(shell.around_surface(at(2.8), &viewers(&cameras(), NEAR)), at(2.8));
        let beside = shell.around_surface(wall(9.0, 9.0), &viewers(&cameras(), NEAR));
        assert_eq!(
            (&beside.positions[..4], &beside.triangles[..2]),
            (&*wall(9.0, 9.0).positions, &[[0, 1, 2], [0, 2, 3]][..])
        );
        assert!(beside.triangles.len() > 12 && beside.triangles[2..].iter().flatten().all(|&v| v >= 4));
        assert!(beside.positions[4..].iter().all(|p| shell.holds(*p)));
    }
}
