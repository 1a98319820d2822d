//! Planar regions of a surface: planes are grown over it, its vertices moved into them, and the regions retriangulated
//! with few triangles.

use std::collections::HashMap;

use glam::{DMat2, DVec2, DVec3};

use super::Contraction;
use super::smooth::{Rings, directions};
use super::surface::{Surface, area_normal, compact, without_broken};

/// Largest distance of a vertex from its plane, voxels. The noise that smoothing leaves is below that.
const TOLERANCE: f64 = 1.0;
/// Least cosine between a plane and the surface normal averaged over some edges around a vertex of it: 26°.
const LEAST_COSINE: f64 = 0.9;
/// Least area of a plane, square voxels: 12×12. Smaller parts of a round shape pass for flat within the tolerance.
const LEAST_AREA: f64 = 150.0;
/// Largest length of edges within planes, relative to edges of the whole surface if the target number of triangles were
/// spread evenly. Larger triangles could only be kept or dropped as a whole when training judges them.
const COARSENESS: f64 = 4.0;
/// Radius, edges, over which surface normals are averaged.
const RADIUS: usize = 4;
/// Reach of the first region around a plane's first vertex, voxels; and number of fits while it grows.
const SEED_REACH: f64 = 6.0;
const ROUNDS: usize = 16;
/// Largest root-mean-square height above a plane, in tolerances: a region cut out of something larger that is round
/// fills the tolerance evenly, and has 0.45 to 0.58.
const ROUGHEST: f64 = 0.35;
/// Most rejected regions a vertex may be part of: bumps of a rough area all refit to the same plane, and each would
/// grow all over it.
const MOST_REFUSALS: u8 = 4;
/// Number of edges over which vertices beside a plane join it if within the tolerance and inclined by up to 60°: single
/// bumps, and rounded edges between two planes. With twice the number, rims and what stands on the plane were flattened
/// too.
const CLOSING_PASSES: usize = 4;
const CLOSING_COSINE: f64 = 0.5;
/// Largest distance that a vertex is moved, in tolerances, including onto the line between two planes.
const FARTHEST: f64 = 3.0;
/// Squared sine of the least angle, 2°, between planes that a vertex is moved into together: below, it is moved into
/// the first of the two only.
const LEAST_SINE_SQUARED: f64 = 1.2e-3;
/// Number of passes in which planes become coarser, up to the longest edge allowed: in a single pass triangles would be
/// uneven.
const PASSES: u32 = 6;
/// Least shape of triangles made by that, 1 for an equilateral one, unless they were worse before.
const LEAST_SHAPE: f64 = 0.3;
/// Least doubled area of planar triangles, square voxels; otherwise their vertices stay: thinner ones may vanish by
/// rounding.
const THINNEST: f64 = 1e-3;
/// No plane.
const NONE: u32 = u32::MAX;

/// Counts of planes and of triangles in them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct PlanarStats {
    /// Planes found.
    pub planes: usize,
    /// Triangles in the planes before retriangulation.
    pub before: usize,
    /// Triangles in the planes after it.
    pub after: usize,
}

/// The plane `normal`·p = `offset`.
#[derive(Clone, Copy, Debug)]
struct Plane {
    normal: DVec3,
    offset: f64,
}

impl Plane {
    fn height(&self, p: DVec3) -> f64 {
        self.normal.dot(p) - self.offset
    }
}

/// Flattens planar regions and retriangulates them; a vertex stays if it would move far or fold a triangle over.
/// Nothing else changes, except that triangles dropped by [`without_broken`] go, and the surface stays as closed as it
/// was. With a `contraction` the surface and its voxels lie in contracted space, while flatness is judged in the world.
/// `voxel` is the edge length of a voxel. Also returns which vertices `[V]` a simplification to `target_triangles`
/// should keep, lest the triangles of planes become much larger than those of the rest.
pub(super) fn flatten(
    surface: Surface,
    voxel: f64,
    contraction: Option<&Contraction>,
    target_triangles: usize,
) -> (Surface, Vec<bool>, PlanarStats) {
    let mut surface = compact(without_broken(surface));
    let keep_none = vec![false; surface.positions.len()];
    let sheet = Sheet::new(&surface, voxel, contraction);
    let (planes, mut of_vertex) = sheet.planes(&mut Search::new(sheet.positions.len()));
    if planes.is_empty() {
        return (surface, keep_none, PlanarStats::default());
    }
    sheet.close(&planes, &mut of_vertex);
    let (positions, planes_of) = sheet.snapped(&surface.triangles, &planes, &of_vertex);
    let places: Vec<DVec3> = positions.iter().map(|p| sheet.place(*p)).collect();
    let area: f64 = surface.triangles.iter().map(|t| 0.5 * area_normal(t.map(|v| places[v as usize])).length()).sum();
    let mean = area / target_triangles.clamp(1, surface.triangles.len()) as f64;
    let longest = COARSENESS * (mean * 4.0 / 3.0_f64.sqrt()).sqrt();
    let moved = places.iter().zip(&planes_of).zip(&mut surface.positions).filter(|m| !m.0.1.is_empty());
    moved.for_each(|((new, _), old)| *old = (*new * voxel).as_vec3());
    let mut mesh = Planar::new(surface.triangles, &positions, &places, &planes, &planes_of);
    let before = mesh.plane_of_face.iter().filter(|plane| **plane != NONE).count();
    (1..=PASSES).for_each(|pass| mesh.thin_out(longest * f64::from(pass) / f64::from(PASSES)));
    let keep = (0..positions.len()).map(|v| mesh.is_within(v as u32)).collect();
    let after = (0..mesh.triangles.len()).filter(|&f| !mesh.gone[f] && mesh.plane_of_face[f] != NONE).count();
    let left = mesh.triangles.iter().zip(&mesh.gone).filter_map(|(t, gone)| (!gone).then_some(*t));
    surface.triangles = left.collect();
    (surface, keep, PlanarStats { planes: planes.len(), before, after })
}

/// Bookkeeping of growing regions.
struct Search {
    /// Last region that visited each vertex.
    passed: Vec<u32>,
    number: u32,
    /// Number of rejected regions that each vertex was part of.
    refusals: Vec<u8>,
    /// Total number of vertices of all regions.
    #[cfg(test)]
    visits: usize,
}

impl Search {
    fn new(vertices: usize) -> Self {
        Self {
            passed: vec![0; vertices],
            number: 0,
            refusals: vec![0; vertices],
            #[cfg(test)]
            visits: 0,
        }
    }

    fn refuse(&mut self, region: &[usize]) {
        region.iter().for_each(|&v| self.refusals[v] = self.refusals[v].saturating_add(1));
    }
}

/// A surface with the data for growing planes. Lengths are in voxels.
struct Sheet {
    contraction: Option<Contraction>,
    /// Positions in the world.
    positions: Vec<DVec3>,
    /// Positions in contracted space.
    places: Vec<DVec3>,
    rings: Rings,
    /// Mean of unit normals around each vertex, shorter than 1 where the surface bends.
    directions: Vec<DVec3>,
    /// Area of each vertex in contracted space, a third of that of its triangles.
    areas: Vec<f64>,
}

impl Sheet {
    fn new(surface: &Surface, voxel: f64, contraction: Option<&Contraction>) -> Self {
        let contraction = contraction.map(|c| Contraction { center: c.center / voxel, radius: c.radius / voxel });
        let places: Vec<DVec3> = surface.positions.iter().map(|p| p.as_dvec3() / voxel).collect();
        let in_world = |p: &DVec3| contraction.map(|c| c.expand(*p)).filter(|q| q.is_finite()).unwrap_or(*p);
        let positions: Vec<DVec3> = places.iter().map(in_world).collect();
        let rings = Rings::full(positions.len(), &surface.triangles);
        let directions = directions(&positions, &surface.triangles, &rings, RADIUS);
        let mut areas = vec![0.0; positions.len()];
        for t in &surface.triangles {
            let area = area_normal(t.map(|v| places[v as usize])).length() / 6.0;
            t.iter().for_each(|&v| areas[v as usize] += area);
        }
        Self { contraction, positions, places, rings, directions, areas }
    }

    /// Contracted position of a world point.
    fn place(&self, p: DVec3) -> DVec3 {
        self.contraction.map_or(p, |c| c.contract(p))
    }

    /// Voxels per world unit at a vertex along a direction: 1 except in contracted space.
    fn scale(&self, v: usize, direction: DVec3) -> f64 {
        self.contraction.map_or(1.0, |c| c.along(self.positions[v], direction).length())
    }

    /// Height of a vertex above a plane, voxels.
    fn height(&self, plane: &Plane, v: usize) -> f64 {
        plane.height(self.positions[v]) * self.scale(v, plane.normal)
    }

    /// All planes, and the plane of each vertex. The cost is linear in the vertices: none is in more than
    /// [`MOST_REFUSALS`] regions and a plane, of [`ROUNDS`] each.
    fn planes(&self, search: &mut Search) -> (Vec<Plane>, Vec<u32>) {
        let count = self.positions.len();
        let (mut planes, mut of_vertex) = (vec![], vec![NONE; count]);
        let mut tried = vec![false; count];
        let mut seeds: Vec<usize> = (0..count).filter(|&v| self.directions[v].length() > LEAST_COSINE).collect();
        seeds.sort_by(|&a, &b| self.directions[b].length_squared().total_cmp(&self.directions[a].length_squared()));
        for seed in seeds {
            if tried[seed] || of_vertex[seed] != NONE {
                continue;
            }
            let normal = self.directions[seed].normalize();
            let mut plane = Plane { normal, offset: normal.dot(self.positions[seed]) };
            let mut region = self.grown(seed, &plane, SEED_REACH, &of_vertex, search);
            region.iter().for_each(|&v| tried[v] = true);
            let mut widest = vec![];
            for _ in 0..ROUNDS {
                let Some(fitted) = self.fitted(&plane, &region) else { break };
                plane = fitted;
                let before =
                    std::mem::replace(&mut region, self.grown(seed, &plane, f64::INFINITY, &of_vertex, search));
                if region.len() <= before.len() {
                    widest = before;
                    break;
                }
            }
            // Rejected regions are not tried again: the flattest seeds come first, and a region may be large.
            region.iter().for_each(|&v| tried[v] = true);
            let area: f64 = region.iter().map(|&v| self.areas[v]).sum();
            let is_flat = self.roughness(&plane, &region) <= ROUGHEST * TOLERANCE;
            // After refitting, the seed may no longer belong to the plane.
            region.retain(|&v| v != seed || self.belongs(v, &plane));
            if area >= LEAST_AREA && is_flat {
                region.iter().for_each(|&v| of_vertex[v] = planes.len() as u32);
                planes.push(plane);
            } else {
                search.refuse(if widest.len() > region.len() { &widest } else { &region });
            }
        }
        (planes, of_vertex)
    }

    /// Whether a vertex is near a plane, and the surface around it has a similar normal.
    fn belongs(&self, v: usize, plane: &Plane) -> bool {
        let direction = self.directions[v];
        self.height(plane, v).abs() <= TOLERANCE && plane.normal.dot(direction) >= LEAST_COSINE * direction.length()
    }

    /// Vertices near a plane that are connected to the seed and in no other plane, the seed first.
    fn grown(&self, seed: usize, plane: &Plane, reach: f64, of_vertex: &[u32], search: &mut Search) -> Vec<usize> {
        search.number += 1;
        search.passed[seed] = search.number;
        let (mut region, mut next) = (vec![seed], 0);
        let Search { passed, number, refusals, .. } = search;
        let belongs = |v: usize| {
            of_vertex[v] == NONE
                && refusals[v] < MOST_REFUSALS
                && self.belongs(v, plane)
                && self.places[v].distance(self.places[seed]) <= reach
        };
        while let Some(&v) = region.get(next) {
            next += 1;
            for &n in self.rings.around(v) {
                let n = n as usize;
                if passed[n] != *number {
                    passed[n] = *number;
                    if belongs(n) {
                        region.push(n);
                    }
                }
            }
        }
        #[cfg(test)]
        {
            search.visits += region.len();
        }
        region
    }

    /// Least-squares fit of a plane to heights above the given one, weighted by area.
    fn fitted(&self, plane: &Plane, region: &[usize]) -> Option<Plane> {
        let weight = |v: usize| self.areas[v] * self.scale(v, plane.normal).powi(2);
        let total: f64 = region.iter().map(|&v| weight(v)).sum();
        let center = region.iter().map(|&v| weight(v) * self.positions[v]).sum::<DVec3>() / total;
        let (u, v) = plane.normal.any_orthonormal_pair();
        let (mut matrix, mut right) = (DMat2::ZERO, DVec2::ZERO);
        for &i in region {
            let p = self.positions[i] - center;
            let at = weight(i) * DVec2::new(u.dot(p), v.dot(p));
            matrix += DMat2::from_cols(u.dot(p) * at, v.dot(p) * at);
            right += plane.normal.dot(p) * at;
        }
        // At the centre the height is that of the plane, as both coordinates sum to zero.
        let slope = matrix.inverse() * right;
        let normal = (plane.normal - slope.x * u - slope.y * v).try_normalize()?;
        Some(Plane { normal, offset: normal.dot(center) })
    }

    /// Root-mean-square height above a plane.
    fn roughness(&self, plane: &Plane, region: &[usize]) -> f64 {
        let (mut sum, mut total) = (0.0, 0.0);
        for &v in region {
            sum += self.areas[v] * self.height(plane, v).powi(2);
            total += self.areas[v];
        }
        (sum / total).sqrt()
    }

    /// Lets vertices beside planes join the nearest one.
    fn close(&self, planes: &[Plane], of_vertex: &mut [u32]) {
        let height = |plane: u32, v: usize| self.height(&planes[plane as usize], v).abs();
        for _ in 0..CLOSING_PASSES {
            let mut joins: HashMap<usize, u32> = HashMap::new();
            for v in (0..of_vertex.len()).filter(|&v| of_vertex[v] != NONE) {
                let plane = of_vertex[v];
                for &n in self.rings.around(v) {
                    let n = n as usize;
                    let cosine = planes[plane as usize].normal.dot(self.directions[n].normalize_or_zero());
                    let is_near = height(plane, n) <= TOLERANCE && cosine >= CLOSING_COSINE;
                    if of_vertex[n] == NONE && is_near {
                        let best = joins.entry(n).or_insert(plane);
                        if (height(plane, n), plane) < (height(*best, n), *best) {
                            *best = plane;
                        }
                    }
                }
            }
            joins.into_iter().for_each(|(v, plane)| of_vertex[v] = plane);
        }
    }

    /// Positions of all vertices, with those of planes moved into them, and the planes that each is in.
    fn snapped(&self, triangles: &[[u32; 3]], planes: &[Plane], of_vertex: &[u32]) -> (Vec<DVec3>, Vec<Vec<u32>>) {
        let mut planes_of: Vec<Vec<u32>> =
            of_vertex.iter().map(|&plane| if plane == NONE { vec![] } else { vec![plane] }).collect();
        // If a triangle lies between two planes, its vertices in the first also move onto the second.
        for t in triangles {
            for (&a, &b) in t.iter().flat_map(|a| t.iter().map(move |b| (a, b))) {
                let (of_a, of_b) = (of_vertex[a as usize], of_vertex[b as usize]);
                if of_a < of_b && of_b != NONE && !planes_of[a as usize].contains(&of_b) {
                    planes_of[a as usize].push(of_b);
                }
            }
        }
        // Position of a vertex moved into its planes. Planes nearly equal to earlier ones, or containing nearly their
        // common line, are left out.
        let set = |v: usize, on: &mut Vec<u32>| {
            let (mut p, mut used) = (self.positions[v], Vec::<DVec3>::new());
            on.retain(|&i| {
                let plane = &planes[i as usize];
                // The shortest way into this plane along the earlier ones.
                let along = used.iter().fold(plane.normal, |d, n| d - d.dot(*n) * n);
                let differs = along.length_squared() >= LEAST_SINE_SQUARED;
                if differs {
                    p -= along * (plane.height(p) / along.dot(plane.normal));
                    used.push(along.normalize());
                }
                differs
            });
            p
        };
        let mut positions: Vec<DVec3> = planes_of.iter_mut().enumerate().map(|(v, on)| set(v, on)).collect();
        // Vertices that may not stay where they were moved: first those moved too far, then those that fold a triangle.
        let farthest = FARTHEST * TOLERANCE;
        let is_far = |v: &usize| self.place(positions[*v]).distance(self.places[*v]) > farthest;
        let mut back: Vec<usize> = (0..positions.len()).filter(is_far).collect();
        loop {
            back.retain(|&v| !planes_of[v].is_empty());
            if back.is_empty() {
                return (positions, planes_of);
            }
            for v in back {
                // From several planes back into the first, and from there to the original position.
                let left = usize::from(planes_of[v].len() > 1);
                planes_of[v].truncate(left);
                positions[v] = set(v, &mut planes_of[v]);
            }
            let folds = |t: &&[u32; 3]| {
                let expected = match common_plane(&planes_of, t) {
                    Some(plane) => planes[plane as usize].normal,
                    None => area_normal(t.map(|v| self.positions[v as usize])),
                };
                let corners = t.map(|v| positions[v as usize]);
                let placed = corners.map(|p| self.place(p));
                area_normal(corners).dot(expected) <= 0.0 || area_normal(placed).length() <= THINNEST
            };
            back = triangles.iter().filter(folds).flatten().map(|&v| v as usize).collect();
            back.sort_unstable();
            back.dedup();
        }
    }
}

fn common_plane(planes_of: &[Vec<u32>], t: &[u32; 3]) -> Option<u32> {
    let [a, b, c] = t.map(|v| &planes_of[v as usize]);
    a.iter().copied().find(|plane| b.contains(plane) && c.contains(plane))
}

/// A mesh whose planar part is coarsened by collapsing vertices onto others, without leaving its planes or changing its
/// topology.
struct Planar<'a> {
    triangles: Vec<[u32; 3]>,
    gone: Vec<bool>,
    /// Plane of each triangle, or [`NONE`].
    plane_of_face: Vec<u32>,
    /// Triangles at each vertex.
    at: Vec<Vec<u32>>,
    /// Positions in the world; `places` are those in contracted space.
    positions: &'a [DVec3],
    places: &'a [DVec3],
    planes: &'a [Plane],
    planes_of: &'a [Vec<u32>],
}

impl<'a> Planar<'a> {
    fn new(
        triangles: Vec<[u32; 3]>,
        positions: &'a [DVec3],
        places: &'a [DVec3],
        planes: &'a [Plane],
        planes_of: &'a [Vec<u32>],
    ) -> Self {
        let plane_of_face = triangles.iter().map(|t| common_plane(planes_of, t).unwrap_or(NONE)).collect();
        let mut at = vec![vec![]; positions.len()];
        for (f, t) in (0..).zip(&triangles) {
            t.iter().for_each(|&v| at[v as usize].push(f));
        }
        Self { gone: vec![false; triangles.len()], triangles, plane_of_face, at, positions, places, planes, planes_of }
    }

    /// Vertices that share a triangle with this one, each once.
    fn ring(&self, v: u32) -> Vec<u32> {
        let corners = self.at[v as usize].iter().flat_map(|&f| self.triangles[f as usize]);
        let mut ring: Vec<u32> = corners.filter(|&n| n != v).collect();
        ring.sort_unstable();
        ring.dedup();
        ring
    }

    /// Whether a vertex is surrounded by planar triangles.
    fn is_within(&self, v: u32) -> bool {
        let at = &self.at[v as usize];
        !at.is_empty() && at.iter().all(|&f| self.plane_of_face[f as usize] != NONE) && self.ring(v).len() == at.len()
    }

    /// Collapses vertices as long as no edge gets longer than `longest`.
    fn thin_out(&mut self, longest: f64) {
        for v in 0..self.positions.len() as u32 {
            if !self.is_within(v) {
                continue;
            }
            let now =
                self.at[v as usize].iter().map(|&f| self.shape(f, self.triangles[f as usize])).fold(1.0, f64::min);
            let ring = self.ring(v);
            let targets = ring.iter().filter_map(|&n| Some((self.shape_after(v, n, &ring, longest)?, n)));
            let best = targets.max_by(|a, b| a.0.total_cmp(&b.0));
            if let Some((shape, onto)) = best
                && shape >= LEAST_SHAPE.min(now)
            {
                self.collapse(v, onto);
            }
        }
    }

    /// Shape of a triangle: 1 if equilateral, towards 0 for a needle, negative if folded over in its plane.
    fn shape(&self, face: u32, t: [u32; 3]) -> f64 {
        let normal = self.planes[self.plane_of_face[face as usize] as usize].normal;
        let [a, b, c] = t.map(|v| self.places[v as usize]);
        let squares = a.distance_squared(b) + b.distance_squared(c) + c.distance_squared(a);
        let area = area_normal([a, b, c]).length();
        let is_up = area > THINNEST && area_normal(t.map(|v| self.positions[v as usize])).dot(normal) > 0.0;
        if is_up { 2.0 * 3.0_f64.sqrt() * area / squares } else { -1.0 }
    }

    /// Worst shape left by collapsing `v` onto `n`; `None` if that is not allowed.
    fn shape_after(&self, v: u32, n: u32, ring: &[u32], longest: f64) -> Option<f64> {
        let onto = self.places[n as usize];
        let on = &self.planes_of[n as usize];
        let stays = self.planes_of[v as usize].iter().all(|plane| on.contains(plane));
        // The vertices around both must be exactly those of the two triangles removed, or the surface would pinch.
        let shared = self.ring(n).iter().filter(|o| ring.contains(o)).count();
        if !stays || shared != 2 || ring.len() < 4 {
            return None;
        }
        let mut worst = 1.0_f64;
        for &f in &self.at[v as usize] {
            let t = self.triangles[f as usize];
            if t.contains(&n) {
                continue;
            }
            let far = t.iter().any(|&o| o != v && self.places[o as usize].distance(onto) > longest);
            let shape = self.shape(f, t.map(|o| if o == v { n } else { o }));
            if far || shape <= 0.0 {
                return None;
            }
            worst = worst.min(shape);
        }
        Some(worst)
    }

    fn collapse(&mut self, v: u32, onto: u32) {
        for f in std::mem::take(&mut self.at[v as usize]) {
            let t = &mut self.triangles[f as usize];
            if t.contains(&onto) {
                self.gone[f as usize] = true;
                t.iter().for_each(|&o| self.at[o as usize].retain(|&g| g != f));
            } else {
                *t = t.map(|o| if o == v { onto } else { o });
                self.at[onto as usize].push(f);
            }
        }
    }
}

#[cfg(test)]
#[path = "planar_tests.rs"]
mod tests;
