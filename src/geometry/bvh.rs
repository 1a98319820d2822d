use std::cmp::Reverse;
use std::collections::{BinaryHeap, HashMap};
use std::time::Duration;

use glam::{DVec3, Vec3, Vec3A};
use obvhs::aabb::Aabb;
use obvhs::bvh2::Bvh2;
use obvhs::bvh2::builder::build_bvh2;
use obvhs::ray::Ray;
use obvhs::{Boundable, BvhBuildParams};

use crate::scene::Mesh;

/// Intersection of a ray with a triangle.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Hit {
    /// Ray parameter: the point is `origin + t·dir`, with `dir` as given (not normalised).
    pub t: f64,
    /// Index of the mesh in the order given to [`MeshBvh::new`].
    pub mesh: u32,
    /// Index of the triangle in its mesh.
    pub triangle: u32,
    /// Weights of the triangle's three corners; their sum is 1.
    pub barycentrics: DVec3,
}

/// The point of a mesh that is closest to another point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ClosestPoint {
    /// World position on the triangle.
    pub position: DVec3,
    /// Distance to the query.
    pub distance: f64,
    /// Index of the mesh in the order given to [`MeshBvh::new`].
    pub mesh: u32,
    /// Index of the triangle in its mesh.
    pub triangle: u32,
    /// Weights of the triangle's three corners; their sum is 1.
    pub barycentrics: DVec3,
}

/// A bounding volume hierarchy over the triangles of one or several meshes, both sides visible.
///
/// The boxes are f32, relative to the centre of the scene, in units of its radius, and padded so that rounding cannot
/// lose a triangle; the intersections are f64 from the f32 vertices.
pub struct MeshBvh {
    /// Tree over distinct boxes: the builder takes time quadratic in the number of equal ones.
    tree: Bvh2,
    /// Index of the first triangle of each box, and the end.
    starts: Vec<usize>,
    /// Triangles in the order of their boxes.
    triangles: Vec<Indexed>,
    center: DVec3,
    /// Unit of the boxes: half the diagonal of the scene, or 1 if that is 0. In world units the areas of boxes, by
    /// which the builder pairs them, would be infinite for sides above 2e19 and zero below 1e-23, and all pairs equal:
    /// the builder takes time quadratic in these, too.
    radius: f64,
}

struct Indexed {
    corners: [Vec3; 3],
    mesh: u32,
    triangle: u32,
}

struct Boxed(Aabb);

impl Boundable for Boxed {
    fn aabb(&self) -> Aabb {
        self.0
    }
}

/// How far outside a triangle, in barycentric units, a ray still counts as a hit: a ray through a shared edge must find
/// at least one of its triangles whatever the rounding.
const EDGE_TOLERANCE: f64 = 1e-9;

/// Part of the ray parameter within which hits are one: at an edge, as far as its tolerance lets them differ.
pub(super) const ONE_HIT: f64 = 1e-8;

/// Padding of the boxes, in their unit: some 30 f32 roundings of coordinates up to 3 radii.
const BOX_PADDING: f64 = 1e-5;

impl MeshBvh {
    /// Builds the hierarchy over meshes given as (positions, triangles). Triangles with an index out of range or a
    /// position that is not finite are never hit; they keep their number.
    #[must_use]
    pub fn new<'a>(meshes: impl IntoIterator<Item = (&'a [Vec3], &'a [[u32; 3]])>) -> Self {
        let mut triangles = Vec::new();
        for (mesh, (positions, indices)) in (0u32..).zip(meshes) {
            triangles.extend((0u32..).zip(indices).filter_map(|(triangle, t)| {
                let corner = |k: usize| positions.get(t[k] as usize).copied().filter(|p| p.is_finite());
                Some(Indexed { corners: [corner(0)?, corner(1)?, corner(2)?], mesh, triangle })
            }));
        }
        let corners = || triangles.iter().flat_map(|t| t.corners).map(Vec3::as_dvec3);
        let (low, high) =
            corners().fold((DVec3::INFINITY, DVec3::NEG_INFINITY), |(low, high), p| (low.min(p), high.max(p)));
        let (center, radius) =
            if triangles.is_empty() { (DVec3::ZERO, 0.0) } else { ((low + high) / 2.0, low.distance(high) / 2.0) };
        let radius = if radius > 0.0 { radius } else { 1.0 };
        let padding = Vec3A::splat(BOX_PADDING as f32);
        let mut boxes: Vec<Boxed> = vec![];
        let mut known: HashMap<[u32; 6], usize> = HashMap::with_capacity(triangles.len());
        let mut in_boxes: Vec<(usize, Indexed)> = Vec::with_capacity(triangles.len());
        for t in triangles {
            let local = t.corners.map(|p| ((p.as_dvec3() - center) / radius).as_vec3a());
            let tight = Aabb::from_points(&local);
            let padded = Aabb { min: tight.min - padding, max: tight.max + padding };
            let ([a, b, c], [d, e, f]) = (padded.min.to_array(), padded.max.to_array());
            let index = *known.entry([a, b, c, d, e, f].map(f32::to_bits)).or_insert_with(|| {
                boxes.push(Boxed(padded));
                boxes.len() - 1
            });
            in_boxes.push((index, t));
        }
        // Stable: triangles of a box stay in order.
        in_boxes.sort_by_key(|(index, _)| *index);
        let mut starts = vec![0; boxes.len() + 1];
        in_boxes.iter().for_each(|(index, _)| starts[index + 1] += 1);
        (0..boxes.len()).for_each(|i| starts[i + 1] += starts[i]);
        let triangles = in_boxes.into_iter().map(|(_, triangle)| triangle).collect();
        let tree = build_bvh2(&boxes, BvhBuildParams::medium_build(), &mut Duration::default());
        Self { tree, starts, triangles, center, radius }
    }

    /// Builds the hierarchy over these meshes.
    #[must_use]
    pub fn of(meshes: &[Mesh]) -> Self {
        Self::new(meshes.iter().map(|mesh| (mesh.positions(), mesh.triangles())))
    }

    /// Every triangle on the ray with `t ≥ 0`, nearest first, each once. Ties in `t` are in order of mesh and triangle.
    /// A ray through an edge or a vertex reports all triangles that share it.
    #[must_use]
    pub fn all_hits(&self, origin: impl Into<DVec3>, dir: impl Into<DVec3>) -> Vec<Hit> {
        self.hits_before(origin, dir, f64::INFINITY)
    }

    /// The hits of [`Self::all_hits`] with `t < t_max`. Boxes behind that are not visited.
    #[must_use]
    pub fn hits_before(&self, origin: impl Into<DVec3>, dir: impl Into<DVec3>, t_max: f64) -> Vec<Hit> {
        let mut hits = Vec::new();
        let Some(local) = self.local_ray(origin.into(), dir.into(), t_max) else { return hits };
        self.tree.ray_traverse_anyhit(local.boxes, |_, slot| {
            let met = self.triangles_at(slot).iter().filter_map(|triangle| triangle.intersect(&local));
            hits.extend(met.filter(|h| h.t >= 0.0 && h.t < t_max));
        });
        hits.sort_by(|a, b| a.t.total_cmp(&b.t).then((a.mesh, a.triangle).cmp(&(b.mesh, b.triangle))));
        hits
    }

    /// Whether any triangle lies on the ray with `t_min ≤ t ≤ t_max`.
    #[must_use]
    pub fn any_hit(&self, origin: impl Into<DVec3>, dir: impl Into<DVec3>, t_min: f64, t_max: f64) -> bool {
        self.has_layers(1, origin, dir, t_min, t_max)
    }

    /// Whether the ray passes at least `count` triangles with `t_min ≤ t ≤ t_max`. Triangles hit at one place, as at a
    /// shared edge, count once.
    #[must_use]
    pub fn has_layers(
        &self,
        count: usize,
        origin: impl Into<DVec3>,
        dir: impl Into<DVec3>,
        t_min: f64,
        t_max: f64,
    ) -> bool {
        let Some(local) = self.local_ray(origin.into(), dir.into(), t_max) else { return count == 0 };
        let mut found: Vec<f64> = vec![];
        let mut is_new = |t: f64| {
            let is_new = t_min <= t && t <= t_max && found.iter().all(|f| (t - f).abs() > ONE_HIT * t.abs());
            if is_new && found.len() + 1 < count {
                found.push(t);
                return false;
            }
            is_new
        };
        let missed = self.tree.ray_traverse_miss(local.boxes, |_, slot| {
            let mut met = self.triangles_at(slot).iter().filter_map(|triangle| triangle.intersect(&local));
            if met.any(|hit| is_new(hit.t)) { 0.0 } else { f32::INFINITY }
        });
        count == 0 || !missed
    }

    /// The closest point on any triangle; `None` without triangles or if `point` is not finite. Degenerate triangles
    /// count as segments.
    #[must_use]
    pub fn closest_point(&self, point: impl Into<DVec3>) -> Option<ClosestPoint> {
        let point = point.into();
        if self.tree.nodes.is_empty() || !point.is_finite() {
            return None;
        }
        let distance_to = |node: usize| {
            let aabb = self.tree.nodes[node].aabb();
            let [low, high] = [aabb.min, aabb.max].map(|corner| self.center + self.radius * corner.as_dvec3());
            point.distance_squared(point.clamp(low, high))
        };
        let mut best: Option<ClosestPoint> = None;
        // Squared distances are not negative, so their bits sort like the numbers.
        let mut queue = BinaryHeap::from([Reverse((distance_to(0).to_bits(), 0usize))]);
        while let Some(Reverse((bits, index))) = queue.pop() {
            if best.as_ref().is_some_and(|b| f64::from_bits(bits) >= b.distance * b.distance) {
                break;
            }
            let node = &self.tree.nodes[index];
            if !node.is_leaf() {
                let first = node.first_index as usize;
                queue.extend([first, first + 1].map(|child| Reverse((distance_to(child).to_bits(), child))));
                continue;
            }
            let slots = node.first_index..node.first_index + node.prim_count;
            for t in slots.flat_map(|slot| self.triangles_at(slot as usize)) {
                let corners = t.corners.map(Vec3::as_dvec3);
                let barycentrics = closest_barycentrics(point, corners);
                let position = weighted(corners, barycentrics);
                let distance = position.distance(point);
                if best.as_ref().is_none_or(|b| distance < b.distance) {
                    best = Some(ClosestPoint { position, distance, mesh: t.mesh, triangle: t.triangle, barycentrics });
                }
            }
        }
        best
    }

    /// The ray in local coordinates, limited to boxes that begin before `t_max`; `None` if it misses the scene or has
    /// no valid direction.
    fn local_ray(&self, origin: DVec3, dir: DVec3, t_max: f64) -> Option<LocalRay> {
        let unit = dir.try_normalize()?;
        let shift = (self.center - origin).dot(dir) / dir.length_squared();
        let nearest = origin + dir * shift;
        let to_nearest = (nearest - self.center) / self.radius;
        // 1 % more than the radius: boxes are padded and `nearest` is rounded.
        if !nearest.is_finite() || to_nearest.length() > 1.01 {
            return None;
        }
        let mut boxes = Ray::new_inf((to_nearest - 2.0 * unit).as_vec3a(), unit.as_vec3a());
        // Boxes are padded, and their ray starts two radii before its point nearest to the centre.
        let length = (t_max - shift) * dir.length() / self.radius + 2.0 + BOX_PADDING;
        boxes.tmax = (length * (1.0 + BOX_PADDING)) as f32;
        Some(LocalRay { boxes, nearest, shift, dir })
    }

    /// Triangles of the box at this position in the tree's leaves.
    fn triangles_at(&self, slot: usize) -> &[Indexed] {
        let index = self.tree.primitive_indices[slot] as usize;
        &self.triangles[self.starts[index]..self.starts[index + 1]]
    }
}

impl Indexed {
    fn intersect(&self, ray: &LocalRay) -> Option<Hit> {
        let [a, b, c] = self.corners.map(|p| p.as_dvec3() - ray.nearest);
        // Signed volumes of the ray with each edge.
        let volumes = DVec3::new(ray.dir.dot(b.cross(c)), ray.dir.dot(c.cross(a)), ray.dir.dot(a.cross(b)));
        let barycentrics = volumes / volumes.element_sum();
        let normal = (b - a).cross(c - a);
        let t_hit = a.dot(normal) / ray.dir.dot(normal) + ray.shift;
        // The tests fail on the NaN and infinity of a degenerate triangle or one seen edge-on.
        (barycentrics.min_element() >= -EDGE_TOLERANCE && t_hit.is_finite() && barycentrics.is_finite())
            .then_some(Hit { t: t_hit, mesh: self.mesh, triangle: self.triangle, barycentrics })
    }
}

/// A ray moved to where f32 and f64 resolve the scene well, however far away the camera is.
struct LocalRay {
    /// Ray for the f32 boxes, in their unit: unit direction, origin two radii before the centre and so before every
    /// triangle.
    boxes: Ray,
    /// The point of the ray closest to the scene's centre, world space.
    nearest: DVec3,
    /// Ray parameter of `nearest`.
    shift: f64,
    /// Direction as given.
    dir: DVec3,
}

fn weighted([a, b, c]: [DVec3; 3], w: DVec3) -> DVec3 {
    a * w.x + b * w.y + c * w.z
}

/// Barycentrics of the point of a triangle closest to `p`: inside the face, else on the closest edge.
pub(super) fn closest_barycentrics(p: DVec3, [a, b, c]: [DVec3; 3]) -> DVec3 {
    let (ab, ac, ap) = (b - a, c - a, p - a);
    let n = ab.cross(ac);
    let area = n.length_squared();
    if area > 0.0 {
        let v = ap.cross(ac).dot(n) / area;
        let w = ab.cross(ap).dot(n) / area;
        let inside = DVec3::new(1.0 - v - w, v, w);
        if inside.min_element() >= 0.0 {
            return inside;
        }
    }
    let on_edge = |from: DVec3, to: DVec3| {
        let d = to - from;
        let length = d.length_squared();
        if length > 0.0 { ((p - from).dot(d) / length).clamp(0.0, 1.0) } else { 0.0 }
    };
    let (s, t, u) = (on_edge(a, b), on_edge(b, c), on_edge(c, a));
    [DVec3::new(1.0 - s, s, 0.0), DVec3::new(0.0, 1.0 - t, t), DVec3::new(u, 0.0, 1.0 - u)]
        .into_iter()
        .min_by(|&x, &y| {
            let distance = |w| p.distance_squared(weighted([a, b, c], w));
            distance(x).total_cmp(&distance(y))
        })
        .expect("three candidates")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::tests::meets;
    use rand::{RngExt, SeedableRng};

    type Soup = (Vec<Vec3>, Vec<[u32; 3]>);

    fn random_soup(count: u32, seed: u64, offset: Vec3) -> Soup {
        let mut rng = rand_pcg::Pcg64::seed_from_u64(seed);
        let positions = (0..3 * count)
            .map(|i| offset + Vec3::splat((i / 3 % 7) as f32) * 0.1 + 0.5 * Vec3::from_array(rng.random::<[f32; 3]>()))
            .collect();
        (positions, (0..count).map(|i| [3 * i, 3 * i + 1, 3 * i + 2]).collect())
    }

    fn brute_force(soups: &[Soup], origin: DVec3, dir: DVec3) -> Vec<(f64, u32, u32)> {
        let mut hits = Vec::new();
        for (mesh, (positions, triangles)) in (0u32..).zip(soups) {
            for (i, t) in (0u32..).zip(triangles) {
                let t = meets(origin, dir, t.map(|v| positions[v as usize].as_dvec3()));
                hits.extend(t.filter(|t| *t >= 0.0).map(|t| (t, mesh, i)));
            }
        }
        hits.sort_by(|a, b| a.0.total_cmp(&b.0));
        hits
    }

    fn bvh(soups: &[Soup]) -> MeshBvh {
        MeshBvh::new(soups.iter().map(|(p, t)| (p.as_slice(), t.as_slice())))
    }

    #[test]
    fn hits_equal_brute_force() {
        let mut found = 0;
        // The second scene is far from the origin, where f32 positions are 0.06 apart.
        for (seed, offset, away) in [(1, Vec3::ZERO, 1.0), (2, Vec3::new(5e5, -3e5, 10.0), 1.0), (3, Vec3::ZERO, 1e5)] {
            let soups = [random_soup(700, seed, offset), random_soup(300, seed + 10, offset)];
            let tree = bvh(&soups);
            let mut rng = rand_pcg::Pcg64::seed_from_u64(seed);
            for i in 0..500 {
                let target = offset.as_dvec3() + DVec3::from_array(rng.random::<[f64; 3]>());
                let mut dir = DVec3::from_array(rng.random::<[f64; 3]>()) - 0.5;
                if i % 5 == 0 {
                    dir = [DVec3::X, DVec3::NEG_Y, DVec3::Z][i % 3];
                }
                let origin = target - dir * away;
                let expected = brute_force(&soups, origin, dir);
                let hits = tree.all_hits(origin, dir);
                found += hits.len();
                assert_eq!(
                    hits.iter().map(|h| (h.mesh, h.triangle)).collect::<Vec<_>>(),
                    expected.iter().map(|h| (h.1, h.2)).collect::<Vec<_>>()
                );
                for (h, e) in hits.iter().zip(&expected) {
                    // f64 rounding at coordinates up to 1e5: 1e-16·1e5 times the condition number of slivers.
                    assert!((h.t - e.0).abs() < 1e-7 * away, "{} {}", h.t, e.0);
                    let corners = soups[h.mesh as usize].1[h.triangle as usize]
                        .map(|v| soups[h.mesh as usize].0[v as usize].as_dvec3());
                    assert!(weighted(corners, h.barycentrics).distance(origin + h.t * dir) < 1e-4);
                }
                assert_eq!(tree.any_hit(origin, dir, 0.0, f64::INFINITY), !expected.is_empty());
                for count in 0..4 {
                    let has = tree.has_layers(count, origin, dir, 0.0, f64::INFINITY);
                    assert_eq!(has, expected.len() >= count, "{count} of {}", expected.len());
                }
                if let [first, second, ..] = expected[..] {
                    let middle = (first.0 + second.0) / 2.0;
                    assert_eq!(tree.hits_before(origin, dir, middle), hits[..1]);
                    assert_eq!(tree.hits_before(origin, dir, second.0 + 1e-6 * away)[1].triangle, second.2);
                    assert!(tree.hits_before(origin, dir, first.0 * (1.0 - 1e-9) - 1e-9).is_empty());
                    assert!(tree.any_hit(origin, dir, 0.0, middle));
                    assert!(!tree.any_hit(origin, dir, 0.0, first.0 * (1.0 - 1e-9) - 1e-9));
                }
            }
        }
        assert!(found > 5000, "the rays must hit something: {found}");
    }

    #[test]
    fn rays_through_edges_and_vertices_find_every_triangle() {
        let positions: Vec<Vec3> =
            (0..121).map(|i| Vec3::new((i % 11) as f32 * 0.1, (i / 11) as f32 * 0.1, 0.3)).collect();
        let triangles: Vec<[u32; 3]> =
            (0..110u32).filter(|i| i % 11 != 10).flat_map(|i| [[i, i + 1, i + 11], [i + 1, i + 12, i + 11]]).collect();
        let tree = bvh(&[(positions.clone(), triangles)]);
        let eye = DVec3::new(0.21, 0.43, -2.0);
        for y in 1..10 {
            for x in 1..10 {
                let vertex = positions[y * 11 + x].as_dvec3();
                assert_eq!(tree.all_hits(eye, vertex - eye).len(), 6, "vertex {x} {y}");
                let edge = (vertex + positions[y * 11 + x + 1].as_dvec3()) / 2.0;
                assert_eq!(tree.all_hits(eye, edge - eye).len(), 2, "edge {x} {y}");
                let layers = [1, 2].map(|count| tree.has_layers(count, eye, edge - eye, 0.0, f64::INFINITY));
                assert_eq!(layers, [true, false], "edge {x} {y}");
            }
        }
    }

    #[test]
    fn closest_point_equals_brute_force() {
        let soups = [random_soup(300, 4, Vec3::ZERO)];
        let tree = bvh(&soups);
        let mut rng = rand_pcg::Pcg64::seed_from_u64(5);
        for _ in 0..300 {
            let p = DVec3::from_array(rng.random::<[f64; 3]>()) * 4.0 - 1.5;
            // Dense samples of each triangle give an upper bound of the distance.
            let mut nearest = f64::INFINITY;
            for t in &soups[0].1 {
                let corners = t.map(|v| soups[0].0[v as usize].as_dvec3());
                for i in 0..=20 {
                    for j in 0..=20 - i {
                        let (u, v) = (f64::from(i) / 20.0, f64::from(j) / 20.0);
                        nearest = nearest.min(p.distance(weighted(corners, DVec3::new(1.0 - u - v, u, v))));
                    }
                }
            }
            let closest = tree.closest_point(p).unwrap();
            assert!(closest.distance <= nearest + 1e-12);
            // The samples are at most 0.5·√3/20 apart.
            assert!(closest.distance >= nearest - 0.05);
            assert!(closest.barycentrics.min_element() >= 0.0);
        }
    }

    /// Without sharing a box, building the hierarchy would take minutes.
    #[test]
    fn equal_triangles_share_a_box() {
        let (positions, one) = (vec![Vec3::ZERO, Vec3::X, Vec3::Y, Vec3::Z], [[0, 1, 2], [1, 2, 3]]);
        let triangles: Vec<[u32; 3]> = (0..40_000).map(|i| one[usize::from(i % 1000 == 0)]).collect();
        let tree = bvh(&[(positions, triangles)]);
        assert_eq!(tree.tree.primitive_indices.len(), 2);
        let hits = tree.all_hits(Vec3::new(0.2, 0.2, -1.0), Vec3::Z);
        assert!(hits[..39_960].is_sorted_by_key(|h| h.triangle) && hits.len() == 40_000, "{}", hits.len());
        assert_eq!(hits[39_960..].iter().map(|h| h.triangle).collect::<Vec<_>>()[..2], [0, 1000]);
        assert!(tree.has_layers(2, Vec3::new(0.2, 0.2, -1.0), Vec3::Z, 0.0, f64::INFINITY));
        assert!(!tree.has_layers(3, Vec3::new(0.2, 0.2, -1.0), Vec3::Z, 0.0, f64::INFINITY));
    }

    /// Areas overflow f32, by which the builder orders boxes: without an order its time would be quadratic.
    #[test]
    fn extreme_scenes_have_the_hierarchy_of_ordinary_ones() {
        let (positions, triangles) = random_soup(3000, 6, Vec3::ZERO);
        let ordinary = bvh(&[(positions.clone(), triangles.clone())]);
        // Scaling by powers of two, about 1e25 and 1e-25, does not change rounding.
        for scale in [2f32.powi(83), 2f32.powi(-83)] {
            let tree = bvh(&[(positions.iter().map(|p| *p * scale).collect(), triangles.clone())]);
            assert_eq!(tree.tree.primitive_indices, ordinary.tree.primitive_indices);
            let (scale, mut rng) = (f64::from(scale), rand_pcg::Pcg64::seed_from_u64(8));
            for _ in 0..100 {
                let [target, away] = [0; 2].map(|_| DVec3::from_array(rng.random::<[f64; 3]>()));
                let dir = away - 0.5;
                let origin = target - 2.0 * dir;
                let scaled = |hits: Vec<Hit>| hits.into_iter().map(|h| Hit { t: h.t * scale, ..h }).collect::<Vec<_>>();
                assert_eq!(tree.all_hits(scale * origin, dir), scaled(ordinary.all_hits(origin, dir)));
                assert_eq!(
                    tree.hits_before(scale * origin, dir, 2.0 * scale),
                    scaled(ordinary.hits_before(origin, dir, 2.0))
                );
                let [there, here] =
                    [(&tree, scale * origin), (&ordinary, origin)].map(|(tree, p)| tree.closest_point(p).unwrap());
                assert_eq!((there.triangle, there.distance), (here.triangle, scale * here.distance));
            }
        }
    }

    #[test]
    fn degenerate_input_is_no_hit_and_no_panic() {
        let empty = MeshBvh::new([]);
        assert!(empty.all_hits(Vec3::ZERO, Vec3::Z).is_empty());
        assert!(empty.closest_point(Vec3::ZERO).is_none());
        let p = [Vec3::ZERO, Vec3::X, Vec3::Y, Vec3::NAN];
        let t = [[0, 1, 9], [0, 1, 3], [0, 0, 0], [0, 1, 1], [0, 1, 2]];
        let tree = MeshBvh::new([(&p[..], &t[..])]);
        let hits = tree.all_hits(Vec3::new(0.2, 0.2, -1.0), Vec3::Z);
        assert_eq!(hits.iter().map(|h| h.triangle).collect::<Vec<_>>(), [4]);
        for dir in [Vec3::ZERO, Vec3::NAN, Vec3::splat(f32::INFINITY)] {
            assert!(tree.all_hits(Vec3::ZERO, dir).is_empty());
        }
        let point = MeshBvh::new([(&[Vec3::ONE; 3][..], &[[0, 1, 2]][..])]);
        assert!(point.all_hits(Vec3::ZERO, Vec3::ONE).is_empty());
        assert!((point.closest_point(Vec3::ZERO).unwrap().distance - 3f64.sqrt()).abs() < 1e-6);
    }
}
