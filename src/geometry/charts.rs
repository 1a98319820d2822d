//! Cutting of a surface into charts, each of which a planar projection maps one-to-one.

use std::collections::{HashMap, VecDeque};

use glam::{DVec2, DVec3};
use rayon::prelude::*;

use super::raster::pixels_around;
use super::surface::{area_normal, first_at_place};

/// A piece of the surface and its planar projection.
pub(super) struct Chart {
    /// Triangle indices.
    pub(super) faces: Vec<u32>,
    /// `[faces]` corners in the chart's plane, world units.
    pub(super) corners: Vec<[DVec2; 3]>,
}

/// Least cosine between a triangle's smoothed normal and the seed's for it to join a chart, 60°: areas shrink at most
/// to half.
const CONE: f64 = 0.5;
/// Least cosine between a triangle's own, noisy normal and the chart's axis, 75°; no triangle is folded over.
const STEEPEST: f64 = 0.26;
/// Most times that overlapping parts are split off a chart. A spring overlaps with every turn, and each split would
/// leave one turn.
const MOST_PASSES: u32 = 32;
/// No neighbouring triangle; no chart.
const NONE: u32 = u32::MAX;

/// Per-triangle data for growing charts.
struct Faces {
    corners: Vec<[DVec3; 3]>,
    /// Normal times twice the area.
    normals: Vec<DVec3>,
    smooth: Vec<DVec3>,
    neighbors: Vec<[u32; 3]>,
}

/// Cuts a surface into charts, with every triangle in exactly one, except triangles with two coincident corners, which
/// are in none. `texel` is the expected size of a texel in world units, `max_side` the largest extent of a chart.
/// Positions must be finite. Deterministic.
pub(super) fn cut(corners: Vec<[DVec3; 3]>, texel: f64, max_side: f64) -> Vec<Chart> {
    let normals: Vec<DVec3> = corners.par_iter().map(|t| area_normal(*t)).collect();
    let neighbors = neighbors(&corners);
    let smooth = smooth_normals(&normals, &neighbors);
    let faces = Faces { corners, normals, smooth, neighbors };
    let mut chart_of = grow_all(&faces, max_side);
    // Charts below some 8×8 texels cost more gutter than they hold.
    merge(&faces, &mut chart_of, 64.0 * texel * texel, max_side);
    members(&chart_of)
        .into_par_iter()
        .filter(|m| !m.is_empty())
        .flat_map_iter(|m| without_overlap(&faces, m, texel))
        .collect()
}

/// Triangles of each chart.
fn members(chart_of: &[u32]) -> Vec<Vec<u32>> {
    let charts = chart_of.iter().filter(|&&c| c != NONE).map(|&c| c as usize + 1).max().unwrap_or(0);
    let mut members = vec![Vec::new(); charts];
    for (face, &chart) in (0u32..).zip(chart_of).filter(|(_, c)| **c != NONE) {
        members[chart as usize].push(face);
    }
    members
}

/// Per triangle the neighbour across the edge from corner k to k+1. Corners at the same position are one vertex. An
/// edge of more than two triangles, or of two that run along it in the same direction, is a border.
fn neighbors(corners: &[[DVec3; 3]]) -> Vec<[u32; 3]> {
    let vertices = first_at_place(corners.as_flattened().iter().copied());
    let (vertices, _) = vertices.as_chunks::<3>();
    let mut edges: Vec<(u32, u32, bool, u32, usize)> = Vec::with_capacity(3 * vertices.len());
    for (face, v) in (0u32..).zip(vertices).filter(|(_, v)| v[0] != v[1] && v[1] != v[2] && v[2] != v[0]) {
        for k in 0..3 {
            let (a, b) = (v[k], v[(k + 1) % 3]);
            edges.push((a.min(b), a.max(b), a < b, face, k));
        }
    }
    edges.par_sort_unstable();
    let mut neighbors = vec![[NONE; 3]; corners.len()];
    for shared in edges.chunk_by(|x, y| (x.0, x.1) == (y.0, y.1)) {
        if let [x, y] = shared
            && x.2 != y.2
            && x.3 != y.3
        {
            neighbors[x.3 as usize][x.4] = y.3;
            neighbors[y.3 as usize][y.4] = x.3;
        }
    }
    neighbors
}

/// Normals averaged over a few rings of neighbours, by area: charts follow the shape, not the noise of a scan.
fn smooth_normals(normals: &[DVec3], neighbors: &[[u32; 3]]) -> Vec<DVec3> {
    let mut smooth = normals.to_vec();
    for _ in 0..4 {
        smooth = (0..normals.len())
            .into_par_iter()
            .map(|f| {
                let around = neighbors[f].iter().filter(|&&n| n != NONE).map(|&n| smooth[n as usize]);
                (smooth[f] + around.sum::<DVec3>()) / 4.0
            })
            .collect();
    }
    smooth.iter().zip(normals).map(|(s, n)| s.try_normalize().unwrap_or_else(|| unit_or_x(*n))).collect()
}

fn unit_or_x(v: DVec3) -> DVec3 {
    v.try_normalize().unwrap_or(DVec3::X)
}

impl Faces {
    fn around(&self, face: u32) -> impl Iterator<Item = u32> {
        self.neighbors[face as usize].into_iter().filter(|&n| n != NONE)
    }

    /// Whether `face` is not too steep for a projection along `axis`; always true for a triangle without area.
    fn fits(&self, face: u32, axis: DVec3) -> bool {
        let n = self.normals[face as usize];
        n.dot(axis) >= STEEPEST * n.length()
    }
}

/// Grows charts from the flattest places outwards, breadth first so that they are round. Returns the chart of each
/// triangle.
fn grow_all(faces: &Faces, max_side: f64) -> Vec<u32> {
    let count = faces.normals.len() as u32;
    let mut seeds: Vec<(u64, u32)> = (0..count)
        .into_par_iter()
        .map(|f| {
            let n = faces.smooth[f as usize];
            let bend: f64 = faces.around(f).map(|g| 1.0 - n.dot(faces.smooth[g as usize])).sum();
            // Bends are not negative, so their bits sort like the numbers.
            (bend.max(0.0).to_bits(), f)
        })
        .collect();
    seeds.par_sort_unstable();
    let mut chart_of = vec![NONE; count as usize];
    let mut chart = 0;
    let mut queue = VecDeque::new();
    for (_, seed) in seeds {
        let [a, b, c] = faces.corners[seed as usize];
        if chart_of[seed as usize] != NONE || a == b || b == c || c == a {
            continue;
        }
        let axis = if faces.fits(seed, faces.smooth[seed as usize]) {
            faces.smooth[seed as usize]
        } else {
            unit_or_x(faces.normals[seed as usize])
        };
        let mut extent = Extent::new(axis);
        extent.take(&faces.corners[seed as usize], f64::INFINITY);
        chart_of[seed as usize] = chart;
        queue.push_back(seed);
        while let Some(face) = queue.pop_front() {
            for next in faces.around(face) {
                let n = next as usize;
                let joins = chart_of[n] == NONE
                    && faces.smooth[n].dot(axis) >= CONE
                    && faces.fits(next, axis)
                    && extent.take(&faces.corners[n], max_side);
                if joins {
                    chart_of[n] = chart;
                    queue.push_back(next);
                }
            }
        }
        chart += 1;
    }
    chart_of
}

/// Bounding rectangle in the plane across an axis.
#[derive(Clone, Copy)]
struct Extent {
    plane: [DVec3; 2],
    low: DVec2,
    high: DVec2,
}

impl Extent {
    fn new(axis: DVec3) -> Self {
        let x = axis.any_orthonormal_vector();
        Self { plane: [x, axis.cross(x)], low: DVec2::INFINITY, high: DVec2::NEG_INFINITY }
    }

    fn project(&self, p: DVec3) -> DVec2 {
        DVec2::new(self.plane[0].dot(p), self.plane[1].dot(p))
    }

    /// Grows by a triangle unless a side would exceed `max_side`.
    fn take(&mut self, corners: &[DVec3; 3], max_side: f64) -> bool {
        let p = corners.map(|c| self.project(c));
        let low = self.low.min(p[0]).min(p[1].min(p[2]));
        let high = self.high.max(p[0]).max(p[1].max(p[2]));
        let fits = (high - low).max_element() <= max_side;
        if fits {
            (self.low, self.high) = (low, high);
        }
        fits
    }
}

/// Merges each chart, smallest first, into the neighbour with the longest common border whose axis suits all of its
/// triangles: within the cone, or for charts of less than `min_area` merely not too steep.
fn merge(faces: &Faces, chart_of: &mut [u32], min_area: f64, max_side: f64) {
    // Merging moves the mean axes; a few passes reach what can be reached.
    for _ in 0..4 {
        let mut members = members(chart_of);
        let normal_sum = |m: &Vec<u32>| m.iter().map(|&f| faces.normals[f as usize]).sum::<DVec3>();
        let axes: Vec<DVec3> = members.iter().map(|m| unit_or_x(normal_sum(m))).collect();
        let area = |m: &Vec<u32>| m.iter().map(|&f| faces.normals[f as usize].length() / 2.0).sum::<f64>();
        let mut areas: Vec<f64> = members.iter().map(area).collect();
        let mut extents: Vec<Extent> = axes
            .iter()
            .zip(&members)
            .map(|(&axis, m)| {
                let mut extent = Extent::new(axis);
                m.iter().for_each(|&f| {
                    extent.take(&faces.corners[f as usize], f64::INFINITY);
                });
                extent
            })
            .collect();
        let mut order: Vec<usize> = (0..members.len()).filter(|&c| !members[c].is_empty()).collect();
        order.sort_by(|&a, &b| areas[a].total_cmp(&areas[b]).then(a.cmp(&b)));
        let mut merged = false;
        for chart in order {
            let mut borders: HashMap<u32, f64> = HashMap::new();
            for &f in &members[chart] {
                for (k, &n) in faces.neighbors[f as usize].iter().enumerate() {
                    if n != NONE && chart_of[n as usize] as usize != chart {
                        let c = &faces.corners[f as usize];
                        *borders.entry(chart_of[n as usize]).or_default() += c[k].distance(c[(k + 1) % 3]);
                    }
                }
            }
            let mut borders: Vec<(u32, f64)> = borders.into_iter().collect();
            borders.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(&b.0)));
            // In a small chart, stretch is better than a seam.
            let steepest = if areas[chart] < min_area { -1.0 } else { CONE };
            let suits = |f: u32, axis: DVec3| faces.fits(f, axis) && faces.smooth[f as usize].dot(axis) >= steepest;
            let into = borders.iter().map(|b| b.0 as usize).find(|&c| {
                let mut extent = extents[c];
                let fits = members[chart].iter().all(|&f| suits(f, axes[c]))
                    && members[chart].iter().all(|&f| extent.take(&faces.corners[f as usize], max_side));
                if fits {
                    extents[c] = extent;
                }
                fits
            });
            if let Some(into) = into {
                let moved = std::mem::take(&mut members[chart]);
                moved.iter().for_each(|&f| chart_of[f as usize] = into as u32);
                members[into].extend(moved);
                areas[into] += areas[chart];
                merged = true;
            }
        }
        if !merged {
            break;
        }
    }
}

/// Projects a chart and splits off what would overlap the rest, until nothing does. Overlaps left after [`MOST_PASSES`]
/// are put into layers at once, so that the cost is linear in the triangles.
fn without_overlap(faces: &Faces, members: Vec<u32>, texel: f64) -> Vec<Chart> {
    let pieces =
        |members: Vec<u32>, passes: u32| connected(faces, members).into_iter().map(move |piece| (piece, passes));
    let mut charts = Vec::new();
    let mut pending = vec![(members, 0)];
    while let Some((members, passes)) = pending.pop() {
        let mean = unit_or_x(members.iter().map(|&f| faces.normals[f as usize]).sum());
        let first = unit_or_x(faces.normals[members[0] as usize]);
        let all_fit = |axis: &DVec3| members.iter().all(|&f| faces.fits(f, *axis));
        let Some(axis) = [mean, first].into_iter().find(all_fit) else {
            // The mean has drifted away from some triangles: these are handled separately. If it suits none, they point
            // in all directions and the first triangle gives the axis. Both sets are smaller than before.
            let axis = if members.iter().any(|&f| faces.fits(f, mean)) { mean } else { first };
            let (fit, rest): (Vec<u32>, Vec<u32>) = members.iter().partition(|&&f| faces.fits(f, axis));
            pending.extend(pieces(rest, passes));
            pending.extend(pieces(fit, passes));
            continue;
        };
        let plane = Extent::new(axis);
        let projected = |ordered: Vec<u32>| Chart {
            corners: ordered.iter().map(|&f| faces.corners[f as usize].map(|p| plane.project(p))).collect(),
            faces: ordered,
        };
        let chart = projected(connected(faces, members).concat());
        let low = chart.corners.iter().flatten().copied().fold(DVec2::INFINITY, DVec2::min);
        let high = chart.corners.iter().flatten().copied().fold(DVec2::NEG_INFINITY, DVec2::max);
        // At most 2048² cells: 4 MiB, and for layers 16 MiB.
        let cell = (texel / 2.0).max((high - low).max_element() / 2047.0).max(f64::MIN_POSITIVE);
        let clear = not_overlapping(&chart.corners, low, cell);
        if clear.iter().all(|&c| c) {
            charts.push(chart);
        } else if passes == MOST_PASSES {
            let mut in_layers: Vec<Vec<u32>> = vec![];
            for (&face, layer) in chart.faces.iter().zip(layers(&chart.corners, low, cell)) {
                in_layers.resize_with(in_layers.len().max(layer + 1), Vec::new);
                in_layers[layer].push(face);
            }
            charts.extend(in_layers.into_iter().flat_map(|layer| connected(faces, layer)).map(projected));
        } else {
            let of = |wanted: bool| chart.faces.iter().zip(&clear).filter(move |c| *c.1 == wanted).map(|c| *c.0);
            pending.extend(pieces(of(false).collect(), passes + 1));
            pending.extend(pieces(of(true).collect(), passes + 1));
        }
    }
    charts
}

/// Moves triangles that cover a texel centre of another triangle of their chart into charts of their own; `at` maps a
/// point of a chart to texels. Returns the new charts.
pub(super) fn split_overlaps(charts: &mut [Chart], at: impl Fn(usize, DVec2) -> DVec2 + Sync) -> Vec<Chart> {
    let split = |(i, chart): (usize, &mut Chart)| {
        let texels: Vec<[DVec2; 3]> = chart.corners.iter().map(|t| t.map(|p| at(i, p))).collect();
        let low = texels.iter().flatten().copied().fold(DVec2::INFINITY, DVec2::min).floor();
        let clear = not_overlapping(&texels, low, 1.0);
        let mut alone = Vec::new();
        if clear.contains(&false) {
            let (faces, corners) = (std::mem::take(&mut chart.faces), std::mem::take(&mut chart.corners));
            for ((face, corners), clear) in faces.into_iter().zip(corners).zip(clear) {
                if clear {
                    chart.faces.push(face);
                    chart.corners.push(corners);
                } else {
                    alone.push(Chart { faces: vec![face], corners: vec![corners] });
                }
            }
        }
        alone
    };
    charts.par_iter_mut().enumerate().flat_map_iter(split).collect()
}

/// Connected pieces of a set of triangles, each in breadth-first order from its lowest index.
fn connected(faces: &Faces, mut members: Vec<u32>) -> Vec<Vec<u32>> {
    members.sort_unstable();
    let mut left = vec![true; members.len()];
    let mut pieces = Vec::new();
    for start in 0..members.len() {
        if !left[start] {
            continue;
        }
        left[start] = false;
        let (mut piece, mut next) = (vec![members[start]], 0);
        while next < piece.len() {
            for n in faces.around(piece[next]) {
                if let Ok(i) = members.binary_search(&n)
                    && std::mem::take(&mut left[i])
                {
                    piece.push(n);
                }
            }
            next += 1;
        }
        pieces.push(piece);
    }
    pieces
}

/// Per triangle, whether it covers no cell that an earlier one covers, on a grid of `cell`s from `low`.
fn not_overlapping(corners: &[[DVec2; 3]], low: DVec2, cell: f64) -> Vec<bool> {
    if corners.len() == 1 {
        return vec![true];
    }
    let grid = Grid::over(corners, low, cell);
    let mut taken = vec![false; grid.width * grid.height];
    let mut covered = Vec::new();
    let is_clear = |triangle| {
        grid.cover(triangle, &mut covered);
        let is_clear = !covered.iter().any(|&i| taken[i]);
        if is_clear {
            covered.iter().for_each(|&i| taken[i] = true);
        }
        is_clear
    };
    corners.iter().map(is_clear).collect()
}

/// Layer of each triangle: the one above all earlier triangles that cover a cell with it, so that no cell is covered
/// twice in a layer. A triangle that covers no cell stays in the layer of the one before it.
fn layers(corners: &[[DVec2; 3]], low: DVec2, cell: f64) -> Vec<usize> {
    let grid = Grid::over(corners, low, cell);
    let mut heights = vec![0_u32; grid.width * grid.height];
    let (mut covered, mut layer) = (Vec::new(), 0);
    let layer_of = |triangle| {
        grid.cover(triangle, &mut covered);
        layer = covered.iter().map(|&i| heights[i]).max().unwrap_or(layer);
        covered.iter().for_each(|&i| heights[i] = layer + 1);
        layer as usize
    };
    corners.iter().map(layer_of).collect()
}

/// Grid of cells over the plane of a chart.
struct Grid {
    low: DVec2,
    cell: f64,
    width: usize,
    height: usize,
}

impl Grid {
    fn over(corners: &[[DVec2; 3]], low: DVec2, cell: f64) -> Self {
        let high = corners.iter().flatten().copied().fold(low, DVec2::max);
        let [width, height] = ((high - low) / cell).to_array().map(|side| side as usize + 1);
        Self { low, cell, width, height }
    }

    /// Sets `covered` to the cells whose centres lie in a triangle.
    fn cover(&self, triangle: &[DVec2; 3], covered: &mut Vec<usize>) {
        covered.clear();
        let [a, b, c] = triangle.map(|p| (p - self.low) / self.cell);
        let corners = [a, b, c].map(|p| p - 0.5);
        for (x, y) in pixels_around(&corners, 0.0, [self.width, self.height], 0..self.height) {
            let p = DVec2::new(x as f64 + 0.5, y as f64 + 0.5);
            let side = |s: DVec2, e: DVec2| (e - s).perp_dot(p - s);
            // Counter-clockwise by construction of the charts; a centre on an edge belongs to no triangle.
            if side(a, b) > 0.0 && side(b, c) > 0.0 && side(c, a) > 0.0 {
                covered.push(y * self.width + x);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// All of the 300 turns face up, and each overlaps all others.
    #[test]
    fn a_long_spring_is_cut_in_a_few_passes() {
        const TURNS: f64 = 300.0;
        // 5.3 squares per turn, so that no chart of whole turns has its axis in the middle.
        let (squares, texel) = ((5.3 * TURNS) as usize, 0.05);
        let at = |i: usize, radius: f64| {
            let turn = std::f64::consts::TAU * i as f64 / 5.3;
            DVec3::new(radius * turn.cos(), radius * turn.sin(), 0.01 * turn)
        };
        let square = |i: usize| {
            let [a, b, c, d] = [at(i, 0.5), at(i, 1.0), at(i + 1, 1.0), at(i + 1, 0.5)];
            [[a, b, d], [b, c, d]]
        };
        let corners: Vec<[DVec3; 3]> = (0..squares).flat_map(square).collect();
        let charts = cut(corners.clone(), texel, 10.0);
        let mut all: Vec<u32> = charts.iter().flat_map(|chart| chart.faces.iter().copied()).collect();
        all.sort_unstable();
        assert!(all.into_iter().eq(0..2 * squares as u32), "each triangle once");
        for chart in &charts {
            let low = chart.corners.iter().flatten().copied().fold(DVec2::INFINITY, DVec2::min);
            assert!(not_overlapping(&chart.corners, low, texel / 2.0).iter().all(|&clear| clear));
        }
        // Charts of layers are in the common projection plane, other charts in their own planes.
        let is_in_own_plane = |chart: &&Chart| {
            let normals = chart.faces.iter().map(|&f| corners[f as usize]).map(|[a, b, c]| (b - a).cross(c - a));
            let plane = Extent::new(unit_or_x(normals.sum()));
            let own = chart.faces.iter().map(|&f| corners[f as usize].map(|p| plane.project(p)));
            own.eq(chart.corners.iter().copied())
        };
        let passes = charts.iter().filter(is_in_own_plane).count();
        // Five squares per chart.
        assert!((300..400).contains(&charts.len()) && passes <= MOST_PASSES as usize, "{passes} of {}", charts.len());
    }
}
