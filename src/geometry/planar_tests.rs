//! Planes in noisy surfaces, made by hand or fused from noisy depth maps.

use std::collections::HashSet;

use glam::Vec3;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;

use super::*;
use crate::geometry::surface::simplify;
use crate::geometry::tests::{ANY, depth_map, edge_counts, orbit, unit_sphere};
use crate::geometry::{Fusion, FusionOptions, SurfaceOptions, surface_from_fusion};

/// The surface of a cube of `n`³ unit cells, every vertex moved by up to `noise` along each axis.
fn cube(n: u32, noise: f32) -> Surface {
    let mut rng = Pcg64::seed_from_u64(3);
    let mut index = HashMap::new();
    let mut surface = Surface::default();
    for axis in 0..3 {
        for (x, y, top) in (0..n).flat_map(|x| (0..n).flat_map(move |y| [false, true].map(|top| (x, y, top)))) {
            let mut at = |u: u32, v: u32| {
                let mut p = [0; 3];
                p[axis] = if top { n } else { 0 };
                (p[(axis + 1) % 3], p[(axis + 2) % 3]) = (x + u, y + v);
                *index.entry(p).or_insert_with(|| {
                    let moved = p.map(|c| c as f32 + rng.random_range(-1.0..1.0_f32) * noise);
                    surface.positions.push(Vec3::from(moved));
                    surface.positions.len() as u32 - 1
                })
            };
            let [a, b, c, d] = [at(0, 0), at(1, 0), at(1, 1), at(0, 1)];
            surface.triangles.extend(if top { [[a, b, c], [a, c, d]] } else { [[a, c, b], [a, d, c]] });
        }
    }
    surface
}

/// Euler characteristic (vertices − edges + triangles) of a surface without unused vertices: 2 for a closed surface of
/// genus 0.
fn euler(surface: &Surface) -> i64 {
    let sides = |t: &[u32; 3]| [(t[0], t[1]), (t[1], t[2]), (t[2], t[0])].map(|(a, b)| (a.min(b), a.max(b)));
    let edges: HashSet<(u32, u32)> = surface.triangles.iter().flat_map(sides).collect();
    let used: HashSet<u32> = surface.triangles.iter().flatten().copied().collect();
    used.len() as i64 - edges.len() as i64 + surface.triangles.len() as i64
}

/// Distance of vertices from the surface of a box around the origin with half side `half`.
fn off_box(surface: &Surface, half: f32) -> Vec<f32> {
    let off = |p: &Vec3| {
        let q = p.abs() - half;
        q.max(Vec3::ZERO).length() + q.max_element().min(0.0).abs()
    };
    surface.positions.iter().map(off).collect()
}

fn mean(values: &[f32]) -> f32 {
    values.iter().sum::<f32>() / values.len() as f32
}

/// Gravel: all of its bumps refit to the mean plane, which is too rough to count as a plane.
#[test]
fn what_is_rough_is_searched_in_time_linear_in_its_vertices() {
    let visits = |side: u32| {
        let height = |x: u32, y: u32| {
            let wave = |v: u32| (f64::from(v) * std::f64::consts::TAU / 24.0).sin();
            (1.3 * wave(x) * wave(y)) as f32
        };
        let positions = (0..side).flat_map(|y| (0..side).map(move |x| Vec3::new(x as f32, y as f32, height(x, y))));
        let squares = (0..side - 1).flat_map(|y| (0..side - 1).map(move |x| y * side + x));
        let triangles = squares.flat_map(|a| [[a, a + 1, a + side + 1], [a, a + side + 1, a + side]]);
        let surface = Surface { positions: positions.collect(), triangles: triangles.collect() };
        let mut search = Search::new(surface.positions.len());
        let (planes, _) = Sheet::new(&surface, 1.0, None).planes(&mut search);
        assert!(planes.is_empty(), "{} planes", planes.len());
        search.visits
    };
    let (few, many) = (visits(60), visits(240));
    assert!(many < 24 * few, "{many} visits, {few} of a sixteenth of the vertices");
}

#[test]
fn a_noisy_cube_gets_six_flat_sides() {
    let noisy = cube(40, 0.25);
    let (flat, keep, stats) = flatten(noisy.clone(), 1.0, None, noisy.triangles.len());
    assert_eq!(stats.planes, 6, "{stats:?}");
    assert!(stats.before * 100 > 99 * noisy.triangles.len() && stats.after * 5 < stats.before, "{stats:?}");
    assert_eq!((euler(&noisy), euler(&flat)), (2, 2));
    assert_eq!(edge_counts(&flat)[1..], [0, 0]);
    assert_eq!(keep.len(), flat.positions.len());
    // All triangles face one of six directions, outwards, and none is much larger than others.
    let (mut volume, mut tilted, mut largest) = (0.0, 0, 0.0_f32);
    for t in &flat.triangles {
        let [a, b, c] = t.map(|v| flat.positions[v as usize]);
        let cross = (b - a).cross(c - a);
        volume += a.dot(b.cross(c)) / 6.0;
        tilted += usize::from(cross.normalize().abs().max_element() < 0.9999);
        largest = largest.max(0.5 * cross.length());
    }
    assert!((volume / 64_000.0 - 1.0).abs() < 0.002, "{volume}");
    assert!(tilted * 100 < flat.triangles.len(), "{tilted} of {}", flat.triangles.len());
    // Samples are spaced by three edges of length 1.1; without samples a side would be two triangles of area 800.
    assert!(largest < 40.0, "{largest}");
    // Planes meet in their common line, and at the corners of the cube.
    let corners = (0..8).map(|i| Vec3::from([1, 2, 4].map(|bit| if i & bit == 0 { 0.0 } else { 40.0 })));
    for corner in corners {
        let nearest = flat.positions.iter().map(|p| p.distance(corner)).fold(f32::MAX, f32::min);
        assert!(nearest < 0.1, "{corner} {nearest}");
    }
    // Simplification removes only vertices that are not marked.
    let simple = simplify(&flat, &keep, 1);
    let left: HashSet<[u32; 3]> = simple.positions.iter().map(|p| p.to_array().map(f32::to_bits)).collect();
    let marked = flat.positions.iter().zip(&keep).filter(|p| *p.1).map(|p| p.0.to_array().map(f32::to_bits));
    assert!(marked.clone().count() > 500 && marked.clone().all(|p| left.contains(&p)));
}

#[test]
fn what_is_not_flat_or_too_small_stays_as_it_was() {
    let noisy = cube(10, 0.2);
    let (same, keep, stats) = flatten(noisy.clone(), 1.0, None, 100);
    assert_eq!((same, stats), (noisy, PlanarStats::default()));
    assert!(!keep.contains(&true));
    // A dome on a sheet with a hole: only the sheet is flat, and boundary edges stay.
    let mut rng = Pcg64::seed_from_u64(4);
    let n = 80_u32;
    let height = |x: f32, y: f32| (144.0 - (x - 25.0).powi(2) - (y - 25.0).powi(2)).max(0.0).sqrt();
    let mut sheet = Surface::default();
    for (x, y) in (0..=n).flat_map(|y| (0..=n).map(move |x| (x as f32, y as f32))) {
        sheet.positions.push(Vec3::new(x, y, height(x, y) + rng.random_range(-0.2..0.2)));
    }
    let is_hole = |x: u32, y: u32| (50..60).contains(&x) && (50..70).contains(&y);
    for (x, y) in (0..n).flat_map(|y| (0..n).map(move |x| (x, y))).filter(|&(x, y)| !is_hole(x, y)) {
        let a = y * (n + 1) + x;
        sheet.triangles.extend([[a, a + 1, a + n + 2], [a, a + n + 2, a + n + 1]]);
    }
    let sheet = compact(sheet);
    let (flat, _, stats) = flatten(sheet.clone(), 1.0, None, sheet.triangles.len());
    assert_eq!(stats.planes, 1, "{stats:?}");
    assert!(stats.after * 4 < stats.before, "{stats:?}");
    assert_eq!((euler(&sheet), euler(&flat)), (0, 0));
    let dome = |s: &Surface| s.positions.iter().filter(|p| p.z > 3.0).copied().collect::<Vec<_>>();
    assert_eq!(dome(&flat), dome(&sheet));
    let low = flat.positions.iter().filter(|p| (p.x - 25.0).hypot(p.y - 25.0) > 16.0);
    let off = low.map(|p| p.z.abs()).fold(0.0, f32::max);
    assert!(off < 0.05, "{off}");
    for t in &flat.triangles {
        let [a, b, c] = t.map(|v| flat.positions[v as usize]);
        assert!((b - a).cross(c - a).z > 0.0, "{a} {b} {c} fold");
    }
}

const VOXEL: f64 = 2.8 / 96.0;

/// Fusion of depth maps from all around, with noise of up to `noise` voxels that is constant over about 36 pixels.
fn fused(hit: impl Fn(DVec3, DVec3) -> Option<f64>, noise: f64) -> Fusion {
    let mut rng = Pcg64::seed_from_u64(5);
    let volume = FusionOptions {
        voxel: VOXEL,
        truncation: 4.0 * VOXEL,
        bounds: (DVec3::splat(-1.4), DVec3::splat(1.4)),
        contraction: None,
        max_depth: 6.0,
        max_bytes: 1 << 30,
    };
    let mut fusion = Fusion::new(volume).unwrap();
    for camera in orbit(40, 160, 120) {
        let mut depth = depth_map(&camera, &hit);
        let blocks: Vec<f64> = (0..27 * 20).map(|_| noise * VOXEL * rng.random_range(-1.0..1.0)).collect();
        for (i, d) in depth.iter_mut().enumerate().filter(|d| *d.1 > 0.0) {
            *d += blocks[i / 160 / 6 * 27 + i % 160 / 6] as f32;
        }
        fusion.integrate(&camera, &depth).unwrap();
    }
    fusion
}

fn surface(fusion: &Fusion, planar: bool, target_triangles: usize) -> (Surface, PlanarStats) {
    let options = SurfaceOptions { planar, target_triangles, ..ANY };
    let (surface, stats) = surface_from_fusion(fusion, &options).unwrap();
    (surface, stats.planar)
}

#[test]
fn a_fused_box_is_flat_and_has_edges() {
    const HALF: f32 = 0.7;
    let side = |o: DVec3, d: DVec3| {
        let (a, b) = ((-f64::from(HALF) - o) / d, (f64::from(HALF) - o) / d);
        let (enter, leave) = (a.min(b).max_element(), a.max(b).min_element());
        (enter < leave).then_some(enter)
    };
    let fusion = fused(side, 3.0);
    let (with, stats) = surface(&fusion, true, 6000);
    let (without, none) = surface(&fusion, false, 6000);
    assert_eq!((stats.planes, none), (6, PlanarStats::default()));
    let voxel = VOXEL as f32;
    let (flat, rough) = (mean(&off_box(&with, HALF)) / voxel, mean(&off_box(&without, HALF)) / voxel);
    assert!(rough > 0.15 && flat < 0.6 * rough, "{rough} voxels became {flat}");
    // Distance of the cube's edges from the surface: rounded by fusion and smoothing, sharp where planes meet.
    let along = (0..40).map(|i| 0.9 * HALF * (i as f32 / 19.5 - 1.0));
    let edges: Vec<Vec3> = along.flat_map(|a| [(a, HALF), (-a, -HALF)].map(|(a, h)| Vec3::new(a, h, HALF))).collect();
    let to = |surface: &Surface| {
        let bvh = crate::geometry::MeshBvh::new([(surface.positions.as_slice(), surface.triangles.as_slice())]);
        let distance = |p: &Vec3| bvh.closest_point(p.as_dvec3()).unwrap().distance as f32 / voxel;
        mean(&edges.iter().map(distance).collect::<Vec<_>>())
    };
    let (sharp, round) = (to(&with), to(&without));
    assert!(round > 0.2 && sharp < 0.3 * round, "{round} voxels became {sharp}");
    // The topology is unchanged: tears caused by noise remain.
    let (before, _) = surface(&fusion, false, usize::MAX);
    let (after, ..) = flatten(before.clone(), VOXEL, None, 6000);
    assert_eq!(
        (euler(&before), edge_counts(&before)[1..].to_vec()),
        (euler(&after), edge_counts(&after)[1..].to_vec())
    );
}

#[test]
fn a_fused_sphere_has_no_plane() {
    let fusion = fused(unit_sphere, 2.0);
    let (with, stats) = surface(&fusion, true, 6000);
    assert_eq!((with, stats), surface(&fusion, false, 6000));
}

#[test]
fn what_is_contracted_is_flat_in_the_world() {
    // A floor below the centre, 150 × 150 voxels in contracted space, whose outer parts bend up towards the horizon.
    let ball = Contraction { center: DVec3::ZERO, radius: 50.0 };
    let mut rng = Pcg64::seed_from_u64(6);
    let n = 150_u32;
    let mut floor = Surface::default();
    for (x, y) in (0..=n).flat_map(|y| (0..=n).map(move |x| (f64::from(x) - 75.0, f64::from(y) - 75.0))) {
        // Intersection of the floor with the ray through this point of a horizontal plane.
        let flat = DVec3::new(x, y, 0.0).clamp_length_max(96.0);
        let far = ball.expand(flat).with_z(-20.0);
        floor.positions.push((ball.contract(far) + 0.3 * rng.random_range(-1.0..1.0) * DVec3::Z).as_vec3());
    }
    for (x, y) in (0..n).flat_map(|y| (0..n).map(move |x| (x, y))) {
        let a = y * (n + 1) + x;
        floor.triangles.extend([[a, a + 1, a + n + 2], [a, a + n + 2, a + n + 1]]);
    }
    // The corners are left out, since they were all clamped onto one circle.
    let is_in = |v: u32| (f64::from(v % (n + 1)) - 75.0).hypot(f64::from(v / (n + 1)) - 75.0) < 95.0;
    floor.triangles.retain(|t| t.iter().all(|&v| is_in(v)));
    let height = |s: &Surface| {
        let up = |p: &Vec3| (ball.expand(p.as_dvec3()).z + 20.0).abs() as f32;
        mean(&s.positions.iter().map(up).collect::<Vec<_>>())
    };
    let floor = compact(floor);
    let (flat, _, stats) = flatten(floor.clone(), 1.0, Some(&ball), floor.triangles.len());
    assert_eq!(stats.planes, 1, "{stats:?}");
    assert!(stats.before * 10 > 9 * floor.triangles.len() && stats.after * 4 < stats.before, "{stats:?}");
    let flat = compact(flat);
    assert!(height(&flat) < 0.25 * height(&floor), "{} became {}", height(&floor), height(&flat));
}

#[test]
fn anything_is_taken() {
    let corners = [Vec3::ZERO, Vec3::X, Vec3::Y, Vec3::Z, Vec3::NAN, Vec3::INFINITY, Vec3::MAX];
    let triangles =
        [[0, 0, 0], [0, 1, 2], [0, 2, 1], [0, 1, 3], [1, 0, 3], [0, 1, 4], [2, 3, 5], [0, 1, 6], [7, 8, 99]];
    let few = Surface { positions: corners.to_vec(), triangles: triangles.to_vec() };
    let mut broken = cube(14, 0.1);
    broken.positions[7] = Vec3::NAN;
    broken.positions[8] = Vec3::MAX;
    broken.triangles[9] = [0, 1, u32::MAX];
    // Only the last surface is large enough for planes.
    assert!(flatten(broken.clone(), 1.0, None, 1).2.planes > 0);
    for surface in [Surface::default(), few, broken] {
        for voxel in [1.0, 1e-3, 1e-30, 1e30, 0.0, -1.0, f64::NAN, f64::INFINITY] {
            for ball in [None, Some(&Contraction { center: DVec3::ONE, radius: 2.0 })] {
                let (flat, keep, _) = flatten(surface.clone(), voxel, ball, 1);
                assert_eq!(flat.positions.len(), keep.len());
                assert!(flat.positions.iter().all(|p| p.is_finite()));
            }
        }
    }
}

/// Two planes 1.5° apart have no usable common line to which a vertex could be moved; each has one with the floor.
#[test]
fn a_vertex_of_two_planes_that_are_nearly_one_is_still_set_onto_the_third() {
    let tilt = 1.5_f64.to_radians();
    let plane = |normal: DVec3| Plane { normal, offset: 0.0 };
    let planes = [plane(DVec3::Z), plane(DVec3::new(-tilt.sin(), 0.0, tilt.cos())), plane(DVec3::Y)];
    let positions = vec![Vec3::new(0.0, 0.3, 0.2), Vec3::new(5.0, 0.2, 0.0), Vec3::new(2.0, -0.3, 4.0)];
    let surface = Surface { positions, triangles: vec![[0, 2, 1]] };
    let sheet = Sheet::new(&surface, 1.0, None);
    let (positions, planes_of) = sheet.snapped(&surface.triangles, &planes, &[0, 1, 2]);
    assert_eq!(planes_of, [vec![0, 2], vec![1, 2], vec![2]]);
    assert!(positions[0].abs_diff_eq(DVec3::ZERO, 1e-7), "{}", positions[0]);
    assert!(
        positions.iter().zip(&planes_of).all(|(p, on)| on.iter().all(|&i| planes[i as usize].height(*p).abs() < 1e-12))
    );
}
