//! A coarse surface from sparse points alone, in seconds: per view a Delaunay triangulation of its visible points,
//! lifted to their depths; triangles that occlude points seen by another view are dropped. The remaining edges tell
//! which lie on the surface: those that most views found become constraints of a second triangulation of every view,
//! whose triangles are judged likewise, rasterised to depth maps and fused.

use std::collections::{HashMap, HashSet};
use std::ops::Range;

use glam::{DVec2, DVec3, Vec3};
use rayon::prelude::*;
use spade::{CdtEdge, ConstrainedDelaunayTriangulation, HasPosition, Point2, Triangulation as _};

use super::bvh::MeshBvh;
use super::fusion::MAX_BYTES;
use super::raster::pixels_in;
use super::reconstruct::{FusionVolume, SurfaceOptions, SurfaceStats, surface_from_depths};
use super::surface::Surface;
use super::{Contraction, GeometryError};
use crate::scene::Camera;
use crate::stats::median;

/// A camera and the points of a cloud that it sees.
#[derive(Clone, Debug)]
pub struct PointView {
    /// Camera; only its pose and field of view matter, not the size of its picture.
    pub camera: Camera,
    /// Indices of the visible points.
    pub sees: Vec<u32>,
    /// Whether visibility is unknown and was estimated by [`visible_points`].
    pub guessed: bool,
}

impl PointView {
    /// View with estimated visibility, where nothing else tells which points a camera sees.
    #[must_use]
    pub fn guess(camera: Camera, points: &[Vec3]) -> Self {
        Self { camera, sees: visible_points(&camera, points), guessed: true }
    }
}

/// Least and most voxels along the radius of the volume.
const LEAST_RESOLUTION: u32 = 48;
const MAX_RESOLUTION: u32 = 384;
/// Truncation in voxels (2DGS).
const TRUNCATION: f64 = 5.0;
/// Longer side, pixels, of the depth maps that are fused. Points are some ten pixels apart in them.
const SIDE: u32 = 320;

/// Least cosine between a triangle's normal and the direction of view: more edge-on ones span a jump in depth.
const LEAST_COSINE: f64 = 0.17;
/// Largest length of a triangle's edges in the picture, in median edges of its view: longer ones span regions without
/// points.
const LONGEST_EDGE: f64 = 6.0;
/// Least number of views that must have an edge for it to be a constraint in others.
const LEAST_AGREEING: u32 = 5;
/// Number of rays from cameras to points that a triangle may obstruct: some points are wrong.
const ALLOWED_RAYS: u32 = 1;
/// Relative depth by which a triangle must be nearer than the point to obstruct the ray.
const IN_THE_WAY: f64 = 0.03;
/// Most triangles judged at once: a hierarchy takes some 400 bytes for each while it is built, as much for all of these
/// as voxels may take.
const MOST_AT_ONCE: usize = MAX_BYTES / 400;
/// Least number of triangles of a connected piece of the fused surface (2DGS).
const LEAST_FACES: usize = 50;
/// Number of cells across the longer side of the picture in which [`visible_points`] compares depths.
const CELLS: f64 = 48.0;
/// Number of finer cells across, in each of which only the nearest visible point is kept: two pixels of the depth maps.
const FINE_CELLS: f64 = SIDE as f64 / 2.0;
/// Largest depth, relative to the nearest in its cell, at which a point counts as visible.
const SAME_SURFACE: f64 = 1.05;

/// Counts of making a surface from points.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SparseStats {
    /// Number of views.
    pub views: usize,
    /// Views whose visible points were estimated by [`visible_points`].
    pub guessed: usize,
    /// Triangles lifted from all views.
    pub lifted: usize,
    /// Triangles among these that occlude nothing that is seen.
    pub clear: usize,
    /// Counts of the fusion of these triangles.
    pub surface: SurfaceStats,
}

impl SparseStats {
    /// Whether visibility was estimated for half of the views or more.
    #[must_use]
    pub fn is_guess(&self) -> bool {
        2 * self.guessed >= self.views
    }
}

/// Makes a surface of approximately at most `triangles` triangles from the points that views see. With `planar`, planar
/// regions are flattened and retriangulated with few triangles.
///
/// About two triangles, at most, are lifted per point and view that sees it. They take some 60 bytes each, and up to 2
/// GiB together while they are judged. That happens twice, by a ray to every such point; of more than 5 million
/// triangles (some 500 views of 5,000 points) each 5 million are judged by all rays.
///
/// # Errors
/// Without cameras, if there are too few points, or if no surface is left.
pub fn surface_from_points(
    views: &[PointView],
    points: &[Vec3],
    triangles: usize,
    planar: bool,
) -> Result<(Surface, SparseStats), GeometryError> {
    let of_points = |view: &PointView| view.sees.iter().copied().filter(|&i| (i as usize) < points.len()).collect();
    let seen: Vec<Vec<u32>> = views.iter().map(of_points).collect();
    let lifted = |constraints: &[Vec<[u32; 2]>]| -> Vec<Vec<[u32; 3]>> {
        let each = views.par_iter().zip(&seen).zip(constraints);
        each.map(|((view, seen), constraints)| lift(&view.camera, points, seen, constraints)).collect()
    };
    let first = without_hiding(views, points, &seen, &lifted(&vec![vec![]; views.len()]), MOST_AT_ONCE);
    let lifted = lifted(&agreed(points.len(), &seen, &first));
    let clear = without_hiding(views, points, &seen, &lifted, MOST_AT_ONCE);
    let count = |of: &[Vec<[u32; 3]>]| of.iter().map(Vec::len).sum::<usize>();
    let mut stats = SparseStats {
        views: views.len(),
        guessed: views.iter().filter(|view| view.guessed).count(),
        lifted: count(&lifted),
        clear: count(&clear),
        surface: SurfaceStats::default(),
    };
    if stats.clear == 0 {
        let hint = "the capture has too few points, or its views see too few of them";
        return Err(GeometryError::EmptySurface { step: "lifting triangles of points", hint });
    }
    let cameras: Vec<Camera> = views.iter().map(|view| small(&view.camera)).collect();
    let space = Contraction::around(&cameras, points)?;
    let contraction = Contraction::if_unbounded(&cameras, points)?;
    // Half an edge: finer voxels would only resolve the same facets.
    let edge = median_edge(points, &clear, contraction.as_ref());
    let resolution = (2.0 * space.radius / edge).clamp(LEAST_RESOLUTION.into(), MAX_RESOLUTION.into()) as u32;
    let options = SurfaceOptions { min_component_faces: LEAST_FACES, planar, target_triangles: triangles };
    let volume = FusionVolume { contraction, resolutions: LEAST_RESOLUTION..=resolution, truncation: TRUNCATION };
    let depth_of = |i: usize| Ok::<_, GeometryError>(depth_map(&cameras[i], points, &clear[i]));
    let surface;
    (surface, stats.surface) = surface_from_depths(&cameras, points, volume, &options, depth_of)?;
    Ok((surface, stats))
}

/// Indices, ascending, of the points that no others hide, as far as points can tell: in every cell of the picture the
/// nearest ones. A cloud denser than the depth maps is subsampled.
#[must_use]
pub fn visible_points(camera: &Camera, points: &[Vec3]) -> Vec<u32> {
    let (coarse, fine) = (Squares::across(CELLS, camera), Squares::across(FINE_CELLS, camera));
    let mut nearest = vec![f64::INFINITY; coarse.count()];
    let mut found = vec![];
    for (i, point) in (0u32..).zip(points) {
        let Some((pixel, depth)) = project(camera, *point) else { continue };
        let at = coarse.of(pixel);
        nearest[at] = nearest[at].min(depth);
        found.push((i, pixel, depth));
    }
    let mut visible = vec![(f64::INFINITY, None); fine.count()];
    for (i, pixel, depth) in found {
        let nearest_of_fine = &mut visible[fine.of(pixel)];
        if depth <= SAME_SURFACE * nearest[coarse.of(pixel)] && depth < nearest_of_fine.0 {
            *nearest_of_fine = (depth, Some(i));
        }
    }
    let mut visible: Vec<u32> = visible.into_iter().filter_map(|(_, point)| point).collect();
    visible.sort_unstable();
    visible
}

/// Division of a picture into squares.
struct Squares {
    side: f64,
    columns: usize,
    rows: usize,
}

impl Squares {
    /// Division with `count` squares along the longer side.
    fn across(count: f64, camera: &Camera) -> Self {
        let k = camera.intrinsics();
        let side = f64::from(k.longer_side()) / count;
        let along = |pixels: u32| (f64::from(pixels) / side).ceil() as usize + 1;
        Self { side, columns: along(k.width), rows: along(k.height) }
    }

    fn count(&self) -> usize {
        self.columns * self.rows
    }

    fn of(&self, pixel: DVec2) -> usize {
        (pixel.y / self.side) as usize * self.columns + (pixel.x / self.side) as usize
    }
}

/// Pixel position and depth of a point in front of the camera and inside its picture.
fn project(camera: &Camera, point: Vec3) -> Option<(DVec2, f64)> {
    let p = camera.to_camera(point.as_dvec3());
    Some((camera.in_picture(p)?, p.z))
}

/// The view at a size of `SIDE` pixels.
fn small(camera: &Camera) -> Camera {
    let k = camera.intrinsics();
    let scale = f64::from(SIDE) / f64::from(k.longer_side());
    let side = |n: u32| (f64::from(n) * scale).round().max(1.0) as u32;
    camera.resized(side(k.width), side(k.height))
}

/// A point projected into a picture.
struct Seen {
    pixel: DVec2,
    point: u32,
}

impl HasPosition for Seen {
    type Scalar = f64;

    fn position(&self) -> Point2<f64> {
        Point2::new(self.pixel.x, self.pixel.y)
    }
}

/// Constraints of each view: edges of triangles that most of the views which see both ends have, and at least
/// [`LEAST_AGREEING`], sorted by decreasing number of views. Edges that only few views have stem from points that the
/// others lack.
fn agreed(points: usize, seen: &[Vec<u32>], triangles: &[Vec<[u32; 3]>]) -> Vec<Vec<[u32; 2]>> {
    let mut found: HashMap<[u32; 2], u32> = HashMap::new();
    for triangles in triangles {
        let edges: HashSet<[u32; 2]> = triangles
            .iter()
            .flat_map(|&[a, b, c]| [[a, b], [b, c], [c, a]])
            .map(|[a, b]| [a.min(b), a.max(b)])
            .collect();
        edges.into_iter().for_each(|edge| *found.entry(edge).or_default() += 1);
    }
    let mut by: Vec<Vec<u32>> = vec![vec![]; points];
    for (view, seen) in (0u32..).zip(seen) {
        seen.iter().for_each(|&i| by[i as usize].push(view));
    }
    let both = |[a, b]: [u32; 2]| {
        let (a, b) = (&by[a as usize], &by[b as usize]);
        a.iter().copied().filter(|view| b.binary_search(view).is_ok())
    };
    let mut edges: Vec<([u32; 2], u32)> =
        found.into_iter().filter(|&(edge, n)| n >= LEAST_AGREEING && 2 * n > both(edge).count() as u32).collect();
    edges.sort_unstable_by_key(|&(edge, n)| (std::cmp::Reverse(n), edge));
    let mut of_view = vec![vec![]; seen.len()];
    for (edge, _) in edges {
        both(edge).for_each(|view| of_view[view as usize].push(edge));
    }
    of_view
}

/// Delaunay triangles of the points that a camera sees, without those that cannot be a surface. They contain the edges
/// `constraints` whose ends are in its picture, except edges that cross earlier ones.
fn lift(camera: &Camera, points: &[Vec3], seen: &[u32], constraints: &[[u32; 2]]) -> Vec<[u32; 3]> {
    let project = |&i: &u32| project(camera, points[i as usize]).map(|(pixel, _)| Seen { pixel, point: i });
    let seen = seen.iter().filter_map(project).collect();
    let Ok(mut delaunay) = ConstrainedDelaunayTriangulation::<Seen>::bulk_load(seen) else {
        return vec![];
    };
    let handles: HashMap<u32, _> = delaunay.vertices().map(|v| (v.data().point, v.fix())).collect();
    for [a, b] in constraints {
        if let (Some(&a), Some(&b)) = (handles.get(a), handles.get(b))
            && delaunay.can_add_constraint(a, b)
        {
            delaunay.add_constraint(a, b);
        }
    }
    let edges = delaunay.undirected_edges().map(|edge| edge.length_2()).filter(|length| *length > 0.0);
    let Some(median) = median(edges.collect()) else {
        return vec![];
    };
    let longest = median * LONGEST_EDGE * LONGEST_EDGE; // of squares
    let surface = |face: spade::handles::FaceHandle<'_, spade::handles::InnerTag, Seen, (), CdtEdge<()>, ()>| {
        let corners = face.vertices().map(|v| v.data().point);
        let pixels = face.vertices().map(|v| v.data().pixel);
        let sides = [(0, 1), (1, 2), (2, 0)].map(|(a, b)| pixels[a].distance_squared(pixels[b]));
        let [a, b, c] = corners.map(|i| points[i as usize].as_dvec3());
        let normal = (b - a).cross(c - a).normalize_or_zero();
        let towards = ((a + b + c) / 3.0 - camera.center()).normalize_or_zero();
        let faces = normal.dot(towards).abs() >= LEAST_COSINE;
        (faces && sides.iter().all(|s| *s <= longest)).then_some(corners)
    };
    delaunay.inner_faces().filter_map(surface).collect()
}

/// The triangles that obstruct no more than [`ALLOWED_RAYS`] rays from any camera to a point it sees, judged in parts
/// of `most` triangles: the verdict on one does not depend on the others.
fn without_hiding(
    views: &[PointView],
    points: &[Vec3],
    seen: &[Vec<u32>],
    lifted: &[Vec<[u32; 3]>],
    most: usize,
) -> Vec<Vec<[u32; 3]>> {
    let counts: Vec<usize> = lifted.iter().map(Vec::len).collect();
    let clear = |part: Range<usize>| judged_at_once(views, points, seen, &lifted[part]);
    parts(&counts, most).into_iter().flat_map(clear).collect()
}

/// Runs of views with together at most `most` triangles, from the count of each; a view with more is alone.
fn parts(counts: &[usize], most: usize) -> Vec<Range<usize>> {
    let (mut parts, mut start, mut together) = (vec![], 0, 0_usize);
    for (view, &count) in counts.iter().enumerate() {
        if view > start && together + count > most {
            parts.push(start..view);
            (start, together) = (view, 0);
        }
        together += count;
    }
    parts.push(start..counts.len());
    parts
}

/// [`without_hiding`] for the triangles of some views, by the rays of all.
fn judged_at_once(
    views: &[PointView],
    points: &[Vec3],
    seen: &[Vec<u32>],
    lifted: &[Vec<[u32; 3]>],
) -> Vec<Vec<[u32; 3]>> {
    use std::sync::atomic::{AtomicU32, Ordering};
    let bvh = MeshBvh::new(lifted.iter().map(|triangles| (points, triangles.as_slice())));
    let hidden: Vec<Vec<AtomicU32>> =
        lifted.iter().map(|triangles| triangles.iter().map(|_| AtomicU32::new(0)).collect()).collect();
    views.par_iter().zip(seen).for_each(|(view, seen)| {
        let origin = view.camera.center();
        for &point in seen {
            // The ray's parameter is 1 at the point. No [`super::Sight`]: lists name points outside pictures, too, as
            // lenses showed them.
            let along = points[point as usize].as_dvec3() - origin;
            for hit in bvh.hits_before(origin, along, 1.0 - IN_THE_WAY) {
                hidden[hit.mesh as usize][hit.triangle as usize].fetch_add(1, Ordering::Relaxed);
            }
        }
    });
    let keep = |(triangles, hidden): (&Vec<[u32; 3]>, &Vec<AtomicU32>)| {
        let clear = triangles.iter().zip(hidden).filter(|(_, n)| n.load(Ordering::Relaxed) <= ALLOWED_RAYS);
        clear.map(|(t, _)| *t).collect()
    };
    lifted.iter().zip(&hidden).map(keep).collect()
}

/// Median length of the triangles' first edges, in contracted space if there is one.
fn median_edge(points: &[Vec3], lifted: &[Vec<[u32; 3]>], contraction: Option<&Contraction>) -> f64 {
    let place = |v: u32| {
        let p = points[v as usize].as_dvec3();
        contraction.map_or(p, |c| c.contract(p))
    };
    let length = |t: &[u32; 3]| place(t[0]).distance(place(t[1]));
    median(lifted.iter().flatten().map(length).collect()).unwrap_or(0.0).max(f64::MIN_POSITIVE)
}

/// Depth of the nearest triangle at every pixel centre, `[h·w]`, 0 where there is none. All triangles are in front of
/// the camera, as [`lift`] makes them.
fn depth_map(camera: &Camera, points: &[Vec3], triangles: &[[u32; 3]]) -> Vec<f32> {
    let k = camera.intrinsics();
    let (width, height) = (k.width as usize, k.height as usize);
    let mut depth = vec![0.0_f32; width * height];
    for triangle in triangles {
        let corners = triangle.map(|i| camera.to_camera(points[i as usize].as_dvec3()));
        let pixels = corners.map(|p| camera.project(p) - 0.5);
        // It is inverse depth that is linear in the picture.
        let nearness = DVec3::from(corners.map(|p| p.z.recip()));
        pixels_in(&pixels, [width, height], 0..height, |x, y, weights| {
            let z = nearness.dot(weights).recip() as f32;
            let known = &mut depth[y * width + x];
            if *known == 0.0 || z < *known {
                *known = z;
            }
        });
    }
    depth
}

/// A sphere and a floor under it, seen from all around above.
#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg32;

    use super::*;
    use crate::scene::{Intrinsics, testing::ahead};

    const FLOOR: f64 = 1.2;

    /// Cameras in two rings around the y axis, which points down.
    fn cameras() -> Vec<Camera> {
        let ring = |i: u32, n: u32, height: f64| {
            let (s, c) = (std::f64::consts::TAU * f64::from(i) / f64::from(n)).sin_cos();
            let eye = DVec3::new(4.0 * c, -height, 4.0 * s);
            let k = Intrinsics { width: 400, height: 300, fx: 380.0, fy: 380.0, cx: 200.0, cy: 150.0 };
            Camera::look_at(k, eye, DVec3::new(0.0, 0.3, 0.0), DVec3::NEG_Y).unwrap()
        };
        (0..14).map(|i| ring(i, 14, 0.8)).chain((0..10).map(|i| ring(i, 10, 2.4))).collect()
    }

    /// Noisy points on the sphere and the floor, `wrong` of them outliers, and the points that each camera sees.
    fn cloud(cameras: &[Camera], wrong: usize) -> (Vec<Vec3>, Vec<PointView>) {
        let mut rng = Pcg32::seed_from_u64(3);
        let mut points = vec![];
        let mut normals = vec![];
        for i in 0..5000 {
            let d = DVec3::from_array([0; 3].map(|_| rng.random_range(-1.0..1.0)));
            let noise = 1.0 + 0.002 * rng.random_range(-1.0..1.0);
            if i % 2 == 0 && d.length() < 1.0 && d.length() > 0.1 {
                points.push((noise * d.normalize()).as_vec3());
                normals.push(d.normalize());
            } else {
                points.push(DVec3::new(2.0 * d.x, FLOOR * noise, 2.0 * d.z).as_vec3());
                normals.push(-DVec3::Y);
            }
        }
        let right = points.len();
        points.extend((0..wrong).map(|_| Vec3::from_array([0; 3].map(|_| rng.random_range(-2.0..1.1_f32)))));
        let sees = |camera: &Camera| {
            let hidden = |p: DVec3| {
                // Whether the sphere, slightly shrunk, is hit before the point itself.
                let d = p - camera.center();
                let (a, b, c) = (d.length_squared(), camera.center().dot(d), camera.center().length_squared() - 0.99);
                b * b > a * c && (-b - (b * b - a * c).sqrt()) / a < 0.99
            };
            let seen = |&i: &u32| {
                let p = points[i as usize].as_dvec3();
                let faces = i as usize >= right || normals[i as usize].dot(p - camera.center()) < 0.0;
                faces && !hidden(p) && project(camera, points[i as usize]).is_some() && i % 3 != 0
            };
            (0..points.len() as u32).filter(seen).collect()
        };
        let views =
            cameras.iter().map(|camera| PointView { camera: *camera, sees: sees(camera), guessed: false }).collect();
        (points, views)
    }

    /// Distance of a point from the nearer of the two surfaces.
    fn error(p: Vec3) -> f64 {
        let p = p.as_dvec3();
        let floor = if p.x.abs().max(p.z.abs()) < 2.1 { (p.y - FLOOR).abs() } else { f64::INFINITY };
        (p.length() - 1.0).abs().min(floor)
    }

    /// Mean distances from the mesh to the truth, and from correct points to the mesh.
    fn errors(surface: &Surface, points: &[Vec3]) -> [f64; 2] {
        let center = |t: &[u32; 3]| t.iter().map(|&i| surface.positions[i as usize]).sum::<Vec3>() / 3.0;
        let accuracy = surface.triangles.iter().map(|t| error(center(t))).sum::<f64>() / surface.triangles.len() as f64;
        let bvh = MeshBvh::new([(surface.positions.as_slice(), surface.triangles.as_slice())]);
        let distance = |p: &Vec3| bvh.closest_point(*p).map_or(f64::INFINITY, |c| c.distance);
        // No camera sees the region below the sphere.
        let seen = |p: &&Vec3| !(f64::from(p.y) > 0.5 && f64::from(p.x.hypot(p.z)) < 1.2);
        let known: Vec<f64> = points[..5000].iter().filter(seen).map(distance).collect();
        [accuracy, known.iter().sum::<f64>() / known.len() as f64]
    }

    #[test]
    fn edges_that_views_agree_on_are_kept_in_all() {
        let camera = ahead([400, 400], 300.0, DVec3::ZERO);
        // A kite, which Delaunay triangulation splits along the shorter diagonal.
        let points = [[-1.0, 0.0, 3.0], [1.0, 0.0, 3.0], [0.0, 0.5, 3.0], [0.0, -0.5, 3.0]].map(Vec3::from);
        let has = |triangles: &[[u32; 3]], edge: [u32; 2]| {
            triangles.len() == 2 && triangles.iter().all(|t| edge.iter().all(|v| t.contains(v)))
        };
        let lift = |constraints: &[[u32; 2]]| lift(&camera, &points, &[0, 1, 2, 3], constraints);
        assert!(has(&lift(&[]), [2, 3]) && has(&lift(&[[0, 1]]), [0, 1]));
        // Of crossing constraints the first is kept, and constraints to unseen points are ignored.
        assert!(has(&lift(&[[0, 1], [2, 3]]), [0, 1]) && has(&lift(&[[2, 3], [0, 1], [0, 9]]), [2, 3]));
        let (long, short) = (lift(&[[0, 1]]), lift(&[]));
        let agreed = |[n_long, n_short]: [usize; 2], seen: usize| {
            let triangles = [vec![long.clone(); n_long], vec![short.clone(); n_short]].concat();
            // One more view, which sees only three of them.
            let all = agreed(4, &[vec![vec![0, 1, 2, 3]; seen], vec![vec![0, 2, 3]]].concat(), &triangles);
            let (few, whole) = all.split_last().unwrap();
            assert!(whole.iter().all(|edges| *edges == whole[0]));
            let seen_by_few = whole[0].iter().copied().filter(|edge| !edge.contains(&1));
            assert_eq!(*few, seen_by_few.collect::<Vec<_>>());
            whole[0].clone()
        };
        let rim = [[0, 2], [0, 3], [1, 2], [1, 3]];
        assert_eq!(agreed([5, 4], 9), [&rim[..], &[[0, 1]]].concat());
        // Not if only half of the views that see both ends have the edge, nor if few views have any.
        assert_eq!(agreed([5, 5], 10), rim);
        assert_eq!(agreed([4, 0], 4), [[0; 2]; 0]);
        assert_eq!(agreed([5, 0], 11), [[0; 2]; 0]);
    }

    #[test]
    fn a_sphere_on_a_floor_is_found() {
        let cameras = cameras();
        for wrong in [0, 100] {
            let (points, views) = cloud(&cameras, wrong);
            let (surface, stats) = surface_from_points(&views, &points, 20_000, true).unwrap();
            let [accuracy, completeness] = errors(&surface, &points);
            eprintln!("{wrong} wrong points: {accuracy:.4} to the truth, {completeness:.4} from it, {stats:?}");
            assert!(accuracy < 0.01 && completeness < 0.01, "{accuracy} {completeness}");
            assert!(stats.clear < stats.lifted);
            assert_eq!((stats.views, stats.guessed), (24, 0));
        }
        // One view without tracks does not make the others guesses.
        let (points, mut views) = cloud(&cameras, 0);
        views[3] = PointView::guess(views[3].camera, &points);
        let (_, stats) = surface_from_points(&views, &points, 20_000, true).unwrap();
        assert_eq!((stats.guessed, stats.is_guess()), (1, false));
        // Without tracks, visibility is estimated from the points: as accurate, but less complete.
        views.iter_mut().for_each(|view| *view = PointView::guess(view.camera, &points));
        let (surface, stats) = surface_from_points(&views, &points, 20_000, true).unwrap();
        let [accuracy, completeness] = errors(&surface, &points);
        eprintln!("without tracks: {accuracy:.4} {completeness:.4}");
        assert!(accuracy < 0.01 && completeness < 0.15, "{accuracy} {completeness}");
        assert_eq!((stats.guessed, stats.is_guess()), (24, true));
    }

    /// A view sees at most one point per cell of its depth map, however many points there are.
    #[test]
    fn of_dense_clouds_a_part_is_seen() {
        let camera = &cameras()[0];
        let ahead = camera.rotation().row(2).as_vec3();
        let (right, down) = (camera.rotation().row(0).as_vec3(), camera.rotation().row(1).as_vec3());
        let at = |i: usize| {
            ahead * 2.0 + right * ((i % 1000) as f32 - 500.0) * 1e-3 + down * ((i / 1000) as f32 - 100.0) * 1e-3
        };
        let points: Vec<Vec3> = (0..200_000).map(|i| camera.center().as_vec3() + at(i)).collect();
        let seen = visible_points(camera, &points);
        assert!(seen.len() <= (FINE_CELLS * FINE_CELLS) as usize && seen.len() > 500, "{}", seen.len());
        assert!(seen.is_sorted());
    }

    /// With little memory, the result is the same as with memory for all.
    #[test]
    fn triangles_are_judged_in_parts_as_together() {
        let parts_of = |counts: &[usize], most: usize| -> Vec<(usize, usize)> {
            parts(counts, most).into_iter().map(|part| (part.start, part.end)).collect()
        };
        assert_eq!(parts_of(&[5, 3, 2, 9, 1], 10), [(0, 3), (3, 5)]);
        assert_eq!(parts_of(&[5, 3, 2, 9, 1], 20), [(0, 5)]);
        assert_eq!(parts_of(&[1, 20, 1], 10), [(0, 1), (1, 2), (2, 3)]);
        assert_eq!(parts_of(&[0, 0], 0), [(0, 2)]);
        assert_eq!(parts_of(&[], 10), [(0, 0)]);
        let (points, views) = cloud(&cameras()[..8], 100);
        let seen: Vec<Vec<u32>> = views.iter().map(|view| view.sees.clone()).collect();
        let lifted: Vec<_> = views.iter().map(|view| lift(&view.camera, &points, &view.sees, &[])).collect();
        let judged = |most: usize| without_hiding(&views, &points, &seen, &lifted, most);
        let count = |of: &[Vec<[u32; 3]>]| of.iter().map(Vec::len).sum::<usize>();
        let together = judged_at_once(&views, &points, &seen, &lifted);
        assert!((1..count(&lifted)).contains(&count(&together)));
        for most in [1, count(&lifted) / 3, MOST_AT_ONCE] {
            assert!(judged(most) == together, "{most} at once");
        }
    }

    #[test]
    fn too_little_is_an_error() {
        let cameras = cameras();
        let sees = vec![0, 1, 2, 900];
        let views = cameras.iter().map(|c| PointView { camera: *c, sees: sees.clone(), guessed: false });
        let views: Vec<_> = views.collect();
        for points in [vec![], vec![Vec3::ZERO], vec![Vec3::ZERO; 3], vec![Vec3::NAN; 5]] {
            let error = surface_from_points(&views, &points, 1000, false).unwrap_err().to_string();
            assert!(error.contains("lifting triangles of points"), "{error}");
        }
        assert!(surface_from_points(&[], &[Vec3::ZERO], 1000, false).is_err());
    }
}
