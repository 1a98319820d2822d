//! Hole filling: holes in a surface are closed by constrained Delaunay triangulation in the plane that fits their edge
//! best.

use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet};

use glam::{DVec2, DVec3, Vec3};
use spade::{
    AngleLimit, ConstrainedDelaunayTriangulation, HasPosition, Point2, RefinementParameters, Triangulation as _,
};

use super::surface::{Surface, area_normal};
use crate::stats::median;

/// Most edges around a hole that is closed: about 13 voxels across on an iso-surface.
const MOST_EDGES: usize = 40;
/// Largest distance from a hole's plane, both of its edge and of vertices that count as inside it, relative to the
/// square root of its area.
const FLATNESS: f64 = 0.3;
/// Least mean cosine between that plane and the triangles around the edge: below, the hole is the end of a tube.
const LEAST_COSINE: f64 = 0.5;
/// Least corner angle of new triangles, degrees, where the edge allows it.
const SHARPEST: f64 = 20.0;

/// Budget of vertices and cells visited when looking for the content of all holes, per vertex of the surface. On an
/// even mesh a slit of [`MOST_EDGES`] has a thousand vertices around it and 40 of its own, so that all slits together
/// visit 25 times as many as there are.
const MOST_LOOKS: usize = 256;

/// A boundary loop, in the direction of the adjacent triangles.
struct Edge {
    vertices: Vec<u32>,
    /// Sum of the adjacent triangles' normals, each as long as twice the area, and of their lengths.
    around: DVec3,
    around_length: f64,
}

/// A vertex in the plane of a hole; `index` is that in the surface, assigned later to new vertices within the hole.
#[derive(Clone, Copy)]
struct Corner {
    at: DVec2,
    index: Option<u32>,
}

impl HasPosition for Corner {
    type Scalar = f64;

    fn position(&self) -> Point2<f64> {
        Point2::new(self.at.x, self.at.y)
    }
}

impl From<Point2<f64>> for Corner {
    fn from(at: Point2<f64>) -> Self {
        Self { at: DVec2::new(at.x, at.y), index: None }
    }
}

/// Closes small holes, and returns their number. A hole is a boundary that the surface surrounds: nearly flat, simple
/// in its plane, with no other vertex in it or near above and below. Outlines, ends of tubes, holes with something in
/// them and holes whose boundaries touch stay open. New triangles are about as large as those around, and wound alike.
///
/// The cost is linear in the triangles: the content of a hole is looked up in the cells of a grid around it, with at
/// most [`MOST_LOOKS`] visits per vertex in all. If the surroundings of all holes exceed that, the largest holes stay
/// open.
pub(super) fn without_holes(surface: Surface) -> (Surface, usize) {
    let looks = MOST_LOOKS.saturating_mul(surface.positions.len());
    closed_within(surface, looks)
}

/// [`without_holes`] with a budget of `looks` visits.
fn closed_within(mut surface: Surface, mut looks: usize) -> (Surface, usize) {
    let edges = boundaries(&surface);
    let small = |edge: &&Edge| edge.vertices.len() <= MOST_EDGES;
    let holes: Vec<Hole> = edges.iter().filter(small).filter_map(|edge| Hole::new(&surface.positions, edge)).collect();
    // Not the mean: a single large hole would make cells that hold everything.
    let grid = Grid::new(&surface, median(holes.iter().map(|hole| hole.reach).collect()).unwrap_or(0.0));
    let mut smallest_first: Vec<usize> = (0..holes.len()).collect();
    smallest_first.sort_by(|&a, &b| holes[a].reach.total_cmp(&holes[b].reach));
    let mut is_empty = vec![false; holes.len()];
    for i in smallest_first {
        let hole = &holes[i];
        let Some(mut near) = grid.near(hole.center, hole.reach, &mut looks) else { break };
        is_empty[i] = !near.any(|v| hole.holds(&surface, v));
    }
    let closed = holes.iter().zip(is_empty).filter(|(hole, is_empty)| *is_empty && hole.fill(&mut surface)).count();
    (surface, closed)
}

/// Vertices used by triangles, by grid cell.
struct Grid {
    cell: f64,
    cells: HashMap<[i64; 3], Vec<u32>>,
}

impl Grid {
    fn new(surface: &Surface, cell: f64) -> Self {
        let mut grid = Self { cell: if cell > 0.0 { cell } else { 1.0 }, cells: HashMap::new() };
        let used: BTreeSet<u32> = surface.triangles.iter().flatten().copied().collect();
        for v in used {
            let at = grid.cell_of(surface.positions[v as usize].as_dvec3());
            grid.cells.entry(at).or_default().push(v);
        }
        grid
    }

    fn cell_of(&self, p: DVec3) -> [i64; 3] {
        // The conversion saturates; non-finite coordinates get a cell of their own.
        (p / self.cell).floor().to_array().map(|v| v as i64)
    }

    /// All vertices within this distance, and some beyond. They and the cells searched are subtracted from `looks`;
    /// `None` if nothing was left of it.
    fn near(&self, center: DVec3, reach: f64, looks: &mut usize) -> Option<impl Iterator<Item = u32>> {
        if *looks == 0 {
            return None;
        }
        let low = self.cell_of(center - reach);
        let high = self.cell_of(center + reach);
        let many = (0..3).map(|i| high[i].saturating_sub(low[i]).saturating_add(1)).fold(1i64, i64::saturating_mul);
        // For a hole much larger than the others it is cheaper to scan all occupied cells.
        let is_in = move |at: &[i64; 3]| (0..3).all(|i| (low[i]..=high[i]).contains(&at[i]));
        let many = usize::try_from(many).unwrap_or(usize::MAX);
        let cells: Vec<&Vec<u32>> = if many > self.cells.len() {
            self.cells.iter().filter(|(at, _)| is_in(at)).map(|(_, vertices)| vertices).collect()
        } else {
            let along = |i: usize| low[i]..=high[i];
            let all = along(0).flat_map(|x| along(1).flat_map(move |y| along(2).map(move |z| [x, y, z])));
            all.filter_map(|at| self.cells.get(&at)).collect()
        };
        let vertices: usize = cells.iter().copied().map(Vec::len).sum();
        *looks = looks.saturating_sub(many.min(self.cells.len()).saturating_add(vertices));
        Some(cells.into_iter().flatten().copied())
    }
}

/// All boundary loops that do not touch themselves or each other.
fn boundaries(surface: &Surface) -> Vec<Edge> {
    let corners = |t: &[u32; 3]| [(t[0], t[1]), (t[1], t[2]), (t[2], t[0])];
    let mut count: HashMap<(u32, u32), u32> = HashMap::new();
    surface.triangles.iter().flat_map(corners).for_each(|edge| *count.entry(edge).or_default() += 1);
    // By start vertex of a boundary edge: the next vertex and the triangle's normal; `None` if several edges start
    // there.
    let mut next: BTreeMap<u32, Option<(u32, DVec3)>> = BTreeMap::new();
    for t in &surface.triangles {
        for (a, b) in corners(t).into_iter().filter(|&(a, b)| count[&(a, b)] == 1 && !count.contains_key(&(b, a))) {
            let places = t.map(|v| surface.positions[v as usize].as_dvec3());
            next.entry(a).and_modify(|n| *n = None).or_insert_with(|| Some((b, area_normal(places))));
        }
    }
    let mut found = vec![];
    while let Some((&start, _)) = next.first_key_value() {
        let (mut edge, mut at) = (Edge { vertices: vec![], around: DVec3::ZERO, around_length: 0.0 }, start);
        // Every vertex is removed, so this terminates.
        while let Some(Some((after, normal))) = next.remove(&at) {
            edge.vertices.push(at);
            edge.around += normal;
            edge.around_length += normal.length();
            at = after;
        }
        if at == start && edge.vertices.len() >= 3 {
            found.push(edge);
        }
    }
    found
}

/// A boundary with the surface around it.
struct Hole {
    /// Boundary vertices, counter-clockwise in the plane.
    vertices: Vec<u32>,
    outline: Vec<DVec2>,
    /// Heights of the boundary vertices above the plane.
    offsets: Vec<f64>,
    center: DVec3,
    axes: [DVec3; 3],
    /// Largest distance from the centre to anything in the hole.
    reach: f64,
    area: f64,
}

impl Hole {
    fn new(positions: &[Vec3], edge: &Edge) -> Option<Self> {
        // Triangles run around a hole clockwise.
        let vertices: Vec<u32> = edge.vertices.iter().rev().copied().collect();
        let points: Vec<DVec3> = vertices.iter().map(|&v| positions[v as usize].as_dvec3()).collect();
        let center = points.iter().sum::<DVec3>() / points.len() as f64;
        let around_center = points.iter().zip(points.iter().cycle().skip(1));
        let twice_area: DVec3 = around_center.map(|(p, q)| (*p - center).cross(*q - center)).sum();
        let normal = twice_area.try_normalize()?;
        // For a tube the adjacent normals cancel in the sum, and what remains of it points anywhere.
        if normal.dot(edge.around) < LEAST_COSINE * edge.around_length || edge.around_length == 0.0 {
            return None;
        }
        let (u, v) = normal.any_orthonormal_pair();
        // Right-handed, whichever order the pair has.
        let axes = if u.cross(v).dot(normal) > 0.0 { [u, v, normal] } else { [v, u, normal] };
        let local: Vec<DVec3> = points.iter().map(|p| DVec3::from(axes.map(|axis| axis.dot(*p - center)))).collect();
        let area = 0.5 * twice_area.length();
        if local.iter().any(|p| p.z.abs() > FLATNESS * area.sqrt()) {
            return None;
        }
        let outline: Vec<DVec2> = local.iter().map(|p| p.truncate()).collect();
        let farthest = outline.iter().map(|p| p.length()).fold(0.0, f64::max);
        let reach = farthest.max(FLATNESS * area.sqrt());
        let offsets = local.iter().map(|p| p.z).collect();
        Some(Self { vertices, outline, offsets, center, axes, reach, area })
    }

    /// Whether a vertex is in the hole: within its outline, and near its plane.
    fn holds(&self, surface: &Surface, vertex: u32) -> bool {
        let point = surface.positions[vertex as usize].as_dvec3();
        let p = DVec3::from(self.axes.map(|axis| axis.dot(point - self.center)));
        let q = p.truncate();
        if q.length() > self.reach || p.z.abs() > FLATNESS * self.area.sqrt() || self.vertices.contains(&vertex) {
            return false;
        }
        let crosses = |(a, b): (&DVec2, &DVec2)| {
            (a.y > q.y) != (b.y > q.y) && q.x < a.x + (q.y - a.y) / (b.y - a.y) * (b.x - a.x)
        };
        let sides = self.outline.iter().zip(self.outline.iter().cycle().skip(1));
        sides.filter(|side| crosses(*side)).count() % 2 == 1
    }

    /// Appends the hole's triangles; returns false, and does nothing, if its outline is not simple.
    fn fill(&self, surface: &mut Surface) -> bool {
        let n = self.outline.len();
        let corner = |(at, index): (&DVec2, &u32)| Corner { at: *at, index: Some(*index) };
        let corners = self.outline.iter().zip(&self.vertices).map(corner).collect();
        let sides = (0..n).map(|i| [i, (i + 1) % n]).collect();
        let mut crosses = false;
        let loaded = ConstrainedDelaunayTriangulation::<Corner>::try_bulk_load_cdt(corners, sides, |_| crosses = true);
        let Ok(mut cdt) = loaded else { return false };
        if crosses || cdt.num_vertices() != n {
            return false;
        }
        let length: f64 =
            self.outline.iter().zip(self.outline.iter().cycle().skip(1)).map(|(a, b)| a.distance(*b)).sum();
        let side = length / n as f64;
        let refined = cdt.refine(
            RefinementParameters::new()
                .exclude_outer_faces(true)
                .keep_constraint_edges()
                .with_angle_limit(AngleLimit::from_deg(SHARPEST))
                // One and a half times the area of an equilateral triangle with the edge's mean length.
                .with_max_allowed_area(0.65 * side * side)
                .with_max_additional_vertices(n * n),
        );
        let outside: HashSet<_> = refined.excluded_faces.into_iter().collect();
        let mut index: Vec<u32> = vec![];
        for vertex in cdt.vertices() {
            let Corner { at, index: known } = *vertex.data();
            index.push(known.unwrap_or_else(|| {
                surface.positions.push(self.lifted(at));
                surface.positions.len() as u32 - 1
            }));
        }
        let faces = cdt.inner_faces().filter(|face| !outside.contains(&face.fix()));
        surface.triangles.extend(faces.map(|face| face.vertices().map(|v| index[v.index()])));
        true
    }

    /// A point within the hole, with a height interpolated from the edge around it.
    fn lifted(&self, at: DVec2) -> Vec3 {
        let (mut sum, mut total) = (0.0, 0.0);
        for (p, offset) in self.outline.iter().zip(&self.offsets) {
            let weight = p.distance_squared(at).max(1e-12 * self.area).recip();
            sum += weight * offset;
            total += weight;
        }
        let [u, v, normal] = self.axes;
        (self.center + at.x * u + at.y * v + (sum / total) * normal).as_vec3()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A square with n × n unit cells at height `z(x, y)`, without the cells for which `missing` is true.
    fn sheet(n: u32, z: impl Fn(f32, f32) -> f32, missing: impl Fn(u32, u32) -> bool) -> Surface {
        let at = |x: u32, y: u32| y * (n + 1) + x;
        let positions = (0..=n).flat_map(|y| (0..=n).map(move |x| (x as f32, y as f32)));
        let positions = positions.map(|(x, y)| Vec3::new(x, y, z(x, y))).collect();
        let cells = (0..n).flat_map(|y| (0..n).map(move |x| (x, y))).filter(|&(x, y)| !missing(x, y));
        let triangles = cells.flat_map(|(x, y)| {
            let [a, b, c, d] = [at(x, y), at(x + 1, y), at(x + 1, y + 1), at(x, y + 1)];
            [[a, b, c], [a, c, d]]
        });
        Surface { positions, triangles: triangles.collect() }
    }

    fn area(surface: &Surface) -> DVec3 {
        let corners = surface.triangles.iter().map(|t| t.map(|v| surface.positions[v as usize].as_dvec3()));
        corners.map(|[a, b, c]| 0.5 * (b - a).cross(c - a)).sum()
    }

    #[test]
    fn a_hole_is_closed_and_the_outline_is_not() {
        let (closed, count) = without_holes(sheet(9, |_, _| 0.0, |x, y| (3..6).contains(&x) && (3..7).contains(&y)));
        assert_eq!(count, 1);
        // All triangles face the same side and cover the square once: the signed area equals that of the square.
        assert!((area(&closed) - 81.0 * DVec3::Z).length() < 1e-4, "{}", area(&closed));
        let unsigned: f64 = closed
            .triangles
            .iter()
            .map(|t| t.map(|v| closed.positions[v as usize].as_dvec3()))
            .map(|[a, b, c]| 0.5 * (b - a).cross(c - a).length())
            .sum();
        assert!((unsigned - 81.0).abs() < 1e-4, "{unsigned}");
        // Only the outline is left: its 36 edges are the only ones without a neighbour.
        let left = boundaries(&closed);
        assert_eq!(left.iter().map(|edge| edge.vertices.len()).collect::<Vec<_>>(), [36]);
        // Triangles that fill holes are about as large as those around them.
        assert!(closed.triangles.len() > 162 && closed.triangles.len() < 200, "{}", closed.triangles.len());
        assert_eq!(without_holes(closed.clone()), (closed, 0));
    }

    /// If all holes are slits across the whole surface, the vertices around them number holes × vertices.
    #[test]
    fn the_largest_holes_stay_open_where_all_would_take_too_long() {
        // A slit, and a hole that comes later in the order of vertices.
        let missing = |x: u32, y: u32| (y == 3 && (1..11).contains(&x)) || (y == 7 && x == 6);
        let surface = sheet(12, |_, _| 0.0, missing);
        let closed = |looks: usize| closed_within(surface.clone(), looks);
        assert_eq!([0, 1, 10_000].map(|looks| closed(looks).1), [0, 1, 2]);
        let left = boundaries(&closed(1).0).iter().map(|edge| edge.vertices.len()).collect::<Vec<_>>();
        assert_eq!(left, [48, 22]);
        // The default limit is far above the work for these holes.
        assert_eq!(without_holes(surface.clone()), closed(10_000));
    }

    #[test]
    fn a_hole_in_a_bent_surface_follows_it() {
        let bent = |x: f32, y: f32| 0.02 * ((x - 6.0).powi(2) + (y - 6.0).powi(2));
        let (closed, count) = without_holes(sheet(12, bent, |x, y| (4..8).contains(&x) && (4..8).contains(&y)));
        assert_eq!(count, 1);
        // The boundary has heights from 0.08 in the middle of its sides to 0.16 at its corners: the filling must be in
        // between, not at 0.
        let heights = closed.positions[169..].iter().map(|p| p.z);
        let (low, high) = heights.fold((f32::MAX, f32::MIN), |(low, high), z| (low.min(z), high.max(z)));
        assert!(closed.positions.len() > 169 && low > 0.08 && high < 0.16 && high - low > 1e-3, "{low} {high}");
    }

    #[test]
    fn what_is_no_hole_stays_open() {
        let kept = |surface: Surface| without_holes(surface).1;
        let hole = |x: u32, y: u32| (3..6).contains(&x) && (3..6).contains(&y);
        let long = |n: u32| sheet(20, |_, _| 0.0, move |x, y| (3..13).contains(&x) && (3..n).contains(&y));
        assert_eq!((kept(long(13)), kept(long(14))), (1, 0), "too long");
        assert_eq!(kept(sheet(9, |_, _| 0.0, |x, y| hole(x, y) && (x, y) != (4, 4))), 0, "an island in it");
        assert_eq!(kept(sheet(9, |_, _| 0.0, |x, y| (x, y) == (3, 3) || (x, y) == (4, 4))), 0, "two that touch");
        assert_eq!(kept(sheet(9, |x, _| 3.0 * (x - 4.5).abs(), hole)), 0, "a fold");
        // A tube of squares.
        let ring = |z: f32| [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]].map(|[x, y]| Vec3::new(x, y, z));
        let wall = |i: u32| [[i, (i + 1) % 4, (i + 1) % 4 + 4], [i, (i + 1) % 4 + 4, i + 4]];
        let tube = Surface { positions: [ring(0.0), ring(1.0)].concat(), triangles: (0..4).flat_map(wall).collect() };
        assert_eq!((boundaries(&tube).len(), kept(tube.clone())), (2, 0), "ends");
        let mut tapered = tube;
        tapered.positions[4..]
            .iter_mut()
            .for_each(|p| *p = Vec3::new(0.5, 0.5, 1.0) + 0.9 * (*p - Vec3::new(0.5, 0.5, 1.0)));
        assert_eq!(kept(tapered), 0, "ends of a tube that narrows");
        // A closed surface inside the hole has no boundary.
        let mut with_blob = sheet(9, |_, _| 0.0, hole);
        let first = with_blob.positions.len() as u32;
        let corners = [[4.5, 4.5, 0.3], [4.2, 4.2, -0.3], [4.8, 4.2, -0.3], [4.5, 4.8, -0.3]].map(Vec3::from);
        with_blob.positions.extend(corners);
        let faces = [[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]];
        with_blob.triangles.extend(faces.map(|t| t.map(|v| first + v)));
        assert_eq!(kept(with_blob), 0, "a blob in it");
        assert_eq!(kept(Surface::default()), 0);
    }
}
