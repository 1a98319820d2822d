//! Noise removal on an extracted surface: small noise is smoothed; parts that are nothing but noise are cut out.

use glam::{DVec3, Vec3};
use rayon::prelude::*;

use super::surface::{Surface, area_normal, compact};

/// Factors of Taubin smoothing: each step forward is followed by a slightly longer one back, which preserves shapes
/// larger than some ten edges (pass band 0.1) and does not shrink them.
const FORWARD: f32 = 0.5;
const BACK: f32 = -0.526;
/// Number of times that both steps are taken.
const PASSES: usize = 20;
/// Radius around a triangle, edges, over which its roughness is judged.
const ROUGH_RADIUS: usize = 4;
/// Least length of the mean of unit normals around a triangle for it not to be rough; a right-angled edge passes.
const LEAST_DIRECTION: f64 = 0.6;

/// Adjacency of vertices: the neighbours of `v` are `of[first[v]..first[v + 1]]`, ascending.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Rings {
    /// Start of each vertex's neighbours in `of`, `[V + 1]`.
    pub first: Vec<u32>,
    /// Neighbours of all vertices.
    pub of: Vec<u32>,
}

impl Rings {
    /// Adjacency of `count` vertices; all indices must be below that. Vertices on a border have only their neighbours
    /// along it: it is smoothed as a curve and does not creep in.
    #[must_use]
    pub fn new(count: usize, triangles: &[[u32; 3]]) -> Self {
        let mut edges: Vec<(u32, u32)> = (triangles.iter())
            .flat_map(|t| [(t[0], t[1]), (t[1], t[2]), (t[2], t[0])])
            .map(|(a, b)| (a.min(b), a.max(b)))
            .collect();
        edges.par_sort_unstable();
        let mut on_border = vec![false; count];
        let mut unique: Vec<(u32, u32, bool)> = vec![];
        for same in edges.chunk_by(|a, b| a == b) {
            let border = same.len() != 2;
            unique.push((same[0].0, same[0].1, border));
            if border {
                on_border[same[0].0 as usize] = true;
                on_border[same[0].1 as usize] = true;
            }
        }
        let mut directed: Vec<(u32, u32)> = vec![];
        for (a, b, border) in unique {
            directed.extend((border || !on_border[a as usize]).then_some((a, b)));
            directed.extend((border || !on_border[b as usize]).then_some((b, a)));
        }
        Self::of(count, directed)
    }

    /// Adjacency in which vertices on a border have all their neighbours.
    pub(super) fn full(count: usize, triangles: &[[u32; 3]]) -> Self {
        let pairs = |t: &[u32; 3]| [(0, 1), (1, 2), (2, 0), (1, 0), (2, 1), (0, 2)].map(|(i, j)| (t[i], t[j]));
        Self::of(count, triangles.iter().flat_map(pairs).collect())
    }

    fn of(count: usize, mut directed: Vec<(u32, u32)>) -> Self {
        directed.par_sort_unstable();
        directed.dedup();
        let mut first = vec![0; count + 1];
        directed.iter().for_each(|e| first[e.0 as usize + 1] += 1);
        (1..first.len()).for_each(|v| first[v] += first[v - 1]);
        Self { first, of: directed.into_iter().map(|e| e.1).collect() }
    }

    /// Neighbours of `v`, ascending.
    pub(super) fn around(&self, v: usize) -> &[u32] {
        &self.of[self.first[v] as usize..self.first[v + 1] as usize]
    }
}

/// Taubin smoothing: removes noise of the size of an edge, preserves shapes and volume. Indices must be in range.
pub(super) fn smooth(surface: &mut Surface) {
    let rings = Rings::new(surface.positions.len(), &surface.triangles);
    for step in (0..PASSES).flat_map(|_| [FORWARD, BACK]) {
        let old = &surface.positions;
        let moved = (0..old.len()).into_par_iter().map(|v| {
            let around = rings.around(v);
            if around.is_empty() {
                return old[v];
            }
            let mean = around.iter().map(|&n| old[n as usize]).sum::<Vec3>() / around.len() as f32;
            old[v] + step * (mean - old[v])
        });
        surface.positions = moved.collect();
    }
}

/// Unit normals of vertices, averaged over their triangles by area; zero for a vertex without area. Indices must be in
/// range.
#[must_use]
pub fn vertex_normals(positions: &[Vec3], triangles: &[[u32; 3]]) -> Vec<Vec3> {
    let mut normals = vec![Vec3::ZERO; positions.len()];
    for t in triangles {
        let [a, b, c] = t.map(|v| positions[v as usize]);
        let cross = (b - a).cross(c - a);
        t.iter().for_each(|&v| normals[v as usize] += cross);
    }
    normals.into_iter().map(Vec3::normalize_or_zero).collect()
}

/// Means of unit normals over some `radius` edges around each vertex: of length 1 on a plane, 0.7 along a right-angled
/// edge, towards 0 in a heap of crumbs. Indices must be in range.
pub(super) fn directions(positions: &[DVec3], triangles: &[[u32; 3]], rings: &Rings, radius: usize) -> Vec<DVec3> {
    let mut normals = vec![(DVec3::ZERO, 0.0_f64); positions.len()];
    for t in triangles {
        let normal = area_normal(t.map(|v| positions[v as usize]));
        for &v in t {
            normals[v as usize].0 += normal;
            normals[v as usize].1 += normal.length();
        }
    }
    // A random walk of n² steps reaches some n edges.
    for _ in 0..radius * radius {
        normals = (0..normals.len())
            .into_par_iter()
            .map(|v| {
                let own = normals[v];
                let around = rings.around(v).iter().map(|&n| normals[n as usize]);
                around.fold(own, |sum, n| (sum.0 + n.0, sum.1 + n.1))
            })
            .map(|(sum, weight)| if weight > 0.0 { (sum / weight, 1.0) } else { (sum, 0.0) })
            .collect();
    }
    normals.into_iter().map(|n| n.0).collect()
}

/// Drops triangles around which normals cancel, as in a heap of crumbs. Indices must be in range.
pub(super) fn without_rough(surface: Surface) -> Surface {
    let rings = Rings::new(surface.positions.len(), &surface.triangles);
    let Surface { positions, mut triangles } = surface;
    let exact: Vec<DVec3> = positions.iter().map(|p| p.as_dvec3()).collect();
    let directions = directions(&exact, &triangles, &rings, ROUGH_RADIUS);
    triangles.retain(|t| t.iter().all(|&v| directions[v as usize].length() >= LEAST_DIRECTION));
    compact(Surface { positions, triangles })
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};

    use super::*;

    /// A square grid of `n`² cells of side 1 at heights `z`.
    fn sheet(n: u32, mut z: impl FnMut(u32, u32) -> f32) -> Surface {
        let positions = (0..(n + 1) * (n + 1)).map(|i| (i % (n + 1), i / (n + 1)));
        let positions = positions.map(|(x, y)| Vec3::new(x as f32, y as f32, z(x, y))).collect();
        let cell = |c: u32| {
            let a = c / n * (n + 1) + c % n;
            [[a, a + 1, a + n + 2], [a, a + n + 2, a + n + 1]]
        };
        Surface { positions, triangles: (0..n * n).flat_map(cell).collect() }
    }

    #[test]
    fn noise_goes_and_shapes_stay() {
        let mut rng = rand_pcg::Pcg64::seed_from_u64(1);
        let wave = |x: f32| 3.0 * (x * std::f32::consts::TAU / 40.0).sin();
        let mut surface = sheet(80, |x, _| wave(x as f32) + rng.random_range(-0.3..0.3));
        let rms = |s: &Surface| {
            let inner = s.positions.iter().filter(|p| p.x.min(p.y) > 5.0 && p.x.max(p.y) < 75.0);
            let errors: Vec<f32> = inner.map(|p| (p.z - wave(p.x)).powi(2)).collect();
            (errors.iter().sum::<f32>() / errors.len() as f32).sqrt()
        };
        let before = rms(&surface);
        smooth(&mut surface);
        // A pass band of one tenth keeps about a tenth of the power of white noise.
        assert!(rms(&surface) < 0.4 * before, "{before} became {}", rms(&surface));
        let amplitude = surface.positions.iter().map(|p| p.z).fold(0.0, f32::max);
        assert!((amplitude - 3.0).abs() < 0.25, "{amplitude}");
    }

    #[test]
    fn borders_do_not_creep_in() {
        let mut surface = sheet(20, |_, _| 0.0);
        smooth(&mut surface);
        let low = surface.positions.iter().fold(Vec3::INFINITY, |low, &p| low.min(p));
        let high = surface.positions.iter().fold(Vec3::NEG_INFINITY, |high, &p| high.max(p));
        assert!((high - low).truncate().min_element() > 19.5, "{low} {high}");
        smooth(&mut Surface::default());
    }

    #[test]
    fn rough_parts_go_and_edges_stay() {
        let mut rng = rand_pcg::Pcg64::seed_from_u64(2);
        // Flat, with a right-angled ridge along x = 30, and random heights beyond x = 60.
        let surface = sheet(90, |x, _| if x < 60 { -(x as f32 - 30.0).abs() } else { rng.random_range(-9.0..9.0) });
        let kept = without_rough(surface.clone());
        let beyond = |s: &Surface, from: f32| s.positions.iter().filter(|p| p.x > from).count();
        assert_eq!(kept.positions.iter().filter(|p| p.x < 50.0).count(), 50 * 91);
        assert!(beyond(&kept, 64.0) * 10 < beyond(&surface, 64.0), "{} left", beyond(&kept, 64.0));
        assert_eq!(without_rough(Surface::default()), Surface::default());
    }

    #[test]
    fn normals_are_those_of_the_plane() {
        let s = sheet(4, |x, _| x as f32);
        let expected = Vec3::new(-1.0, 0.0, 1.0).normalize();
        assert!(vertex_normals(&s.positions, &s.triangles).iter().all(|n| n.distance(expected) < 1e-6));
        assert_eq!(vertex_normals(&[Vec3::X], &[]), [Vec3::ZERO]);
    }
}
