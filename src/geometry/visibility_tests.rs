//! Visibility by rays, compared with brute force and with scenes of known visibility.

use glam::{DMat3, Vec3};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;

use super::*;
use crate::{
    geometry::{
        Surface,
        tests::{meets, orbit, sphere},
        unwrap,
    },
    scene::{Atlas, Intrinsics, testing},
};

const ALL: &(dyn Fn(usize, DVec2) -> bool + Sync) = &|_, _| true;

fn viewers(cameras: &[Camera], layers: usize) -> Viewers<'_> {
    Viewers { cameras, near: 0.0, layers, shows: ALL }
}

fn mesh(positions: Vec<Vec3>, triangles: Vec<[u32; 3]>, uvs: Vec<[Vec2; 3]>) -> Mesh {
    Mesh::new(positions, triangles, uvs, Atlas::new(Texture::zeros(16, 16, 4), None).unwrap()).unwrap()
}

fn unwrapped(surface: &Surface, size: u32) -> Mesh {
    let u = unwrap(surface, None, size, 4).unwrap();
    mesh(u.positions, u.triangles, u.corner_uvs)
}

fn look(mesh: &Mesh, size: usize, viewers: &Viewers) -> TexelVisibility {
    let bvh = MeshBvh::new([(mesh.positions(), mesh.triangles())]);
    texel_visibility(mesh, [size; 2], &bvh, viewers).unwrap()
}

/// A camera at the origin that looks along z.
fn ahead(side: u32, focal: f64) -> Camera {
    testing::ahead([side, side], focal, DVec3::ZERO)
}

/// Per texel, the faces that contain its centre, with the surface points there.
fn points(mesh: &Mesh, size: usize) -> Vec<Vec<(usize, DVec3)>> {
    let mut found = vec![vec![]; size * size];
    for (f, (uvs, t)) in mesh.corner_uvs().iter().zip(mesh.triangles()).enumerate() {
        let [a, b, c] = uvs.map(|uv| uv.as_dvec2() * size as f64);
        let p = t.map(|v| mesh.positions()[v as usize].as_dvec3());
        // Only texels of the triangle's bounding box, to save time: there are thousands of faces.
        let [low, high] = [a.min(b).min(c), a.max(b).max(c)].map(|corner| [corner.x, corner.y].map(|v| v as usize));
        let texels = (low[1]..=high[1].min(size - 1))
            .flat_map(|row| (low[0]..=high[0].min(size - 1)).map(move |column| row * size + column));
        for i in texels {
            let at = DVec2::new((i % size) as f64 + 0.5, (i / size) as f64 + 0.5);
            let whole = (b - a).perp_dot(c - a);
            let (v, w) = ((at - a).perp_dot(c - a) / whole, (b - a).perp_dot(at - a) / whole);
            if v >= 0.0 && w >= 0.0 && v + w <= 1.0 {
                found[i].push((f, p[0] + (p[1] - p[0]) * v + (p[2] - p[0]) * w));
            }
        }
    }
    found
}

fn soup(count: u32, seed: u64) -> Surface {
    let mut random = Pcg64::seed_from_u64(seed);
    let mut point = || Vec3::from_array(random.random::<[f32; 3]>()) * 2.0 - 1.0;
    let positions = (0..count).flat_map(|_| {
        let middle = point();
        [middle + 0.6 * point(), middle + 0.6 * point(), middle + 0.6 * point()]
    });
    Surface { positions: positions.collect(), triangles: (0..count).map(|i| [3 * i, 3 * i + 1, 3 * i + 2]).collect() }
}

#[test]
fn rays_see_what_brute_force_sees() {
    let (mut counts, mut close) = ([0; 2], 0);
    for seed in 0..6 {
        let layers = 1 + seed as usize % 3;
        let mesh = unwrapped(&soup(60, seed), 96);
        let corners: Vec<[DVec3; 3]> =
            mesh.triangles().iter().map(|t| t.map(|v| mesh.positions()[v as usize].as_dvec3())).collect();
        let cameras = &orbit(3, 40, 30);
        let near = if seed < 3 { 0.0 } else { 2.5 };
        let masked = |view: usize, at: DVec2| view != 1 || at.x < 25.0;
        let found = look(&mesh, 96, &Viewers { cameras, near, layers, shows: &masked });
        for (texel, points) in found.texels.iter().zip(points(&mesh, 96)) {
            // Charts of single triangles do not share texels, so there is at most one point.
            let [(face, point)] = points[..] else {
                assert!(points.is_empty());
                continue;
            };
            let mut is_close = false;
            let seen = cameras.iter().enumerate().any(|(i, camera)| {
                let p = camera.to_camera(point);
                if !camera.in_picture(p).is_some_and(|at| masked(i, at)) || p.z <= near {
                    return false;
                }
                let others = corners.iter().enumerate().filter(|(other, _)| *other != face);
                let eye = camera.center();
                let hits: Vec<f64> = others.filter_map(|(_, t)| meets(eye, point - eye, *t)).collect();
                is_close |= hits.iter().any(|t| (t - 1.0).abs() < 1.5e-6);
                hits.iter().filter(|&&t| t * p.z > near && t < 1.0).count() < layers
            });
            close += usize::from(is_close);
            assert!(is_close || (*texel >= TexelSight::Seen(0)) == seen, "{seed}: {texel:?} {seen}");
            counts[usize::from(seen)] += 1;
        }
    }
    assert!(close < 5 && counts.iter().all(|&n| n > 1000), "{close}, {counts:?}");
}

fn joined(parts: &[Surface]) -> Surface {
    let mut all = Surface::default();
    for part in parts {
        let first = all.positions.len() as u32;
        all.positions.extend(&part.positions);
        all.triangles.extend(part.triangles.iter().map(|t| t.map(|v| v + first)));
    }
    all
}

/// A square of `n`×`n` cells across the view, extending `half` to each side of the axis.
fn square(n: u32, z: f32, half: f32) -> Surface {
    let at = |i: u32| (2.0 * i as f32 / n as f32 - 1.0) * half;
    let cells = (0..n).flat_map(|y| (0..n).map(move |x| y * (n + 1) + x));
    Surface {
        positions: (0..=n).flat_map(|y| (0..=n).map(move |x| Vec3::new(at(x), at(y), z))).collect(),
        triangles: cells.flat_map(|a| [[a, a + 1, a + n + 2], [a, a + n + 2, a + n + 1]]).collect(),
    }
}

/// A camera in the corner of a cube of side 4 with a unit sphere in its middle.
#[test]
fn a_sphere_in_a_box_hides_what_it_must() {
    let wall = |turn: DMat3| {
        let mut wall = square(8, 2.0, 2.0);
        wall.positions.iter_mut().for_each(|p| *p = (turn * p.as_dvec3()).as_vec3());
        wall
    };
    let (x, y, z) = (DVec3::X, DVec3::Y, DVec3::Z);
    let turns = [[x, y, z], [x, -y, -z], [y, z, x], [y, -z, -x], [z, x, y], [z, -x, -y]];
    let mut parts: Vec<Surface> = turns.map(|[x, y, z]| wall(DMat3::from_cols(x, y, z))).to_vec();
    parts.push(sphere(96, Vec3::ZERO, 1.0));
    let mesh = unwrapped(&joined(&parts), 384);
    let eye = DVec3::new(-1.5, -1.3, -1.6);
    let right = (-eye).normalize().any_orthonormal_vector();
    let rotation = DMat3::from_cols(right, (-eye).normalize().cross(right), (-eye).normalize()).transpose();
    let k = Intrinsics { width: 100, height: 80, fx: 50.0, fy: 45.0, cx: 48.0, cy: 41.0 };
    let camera = Camera::new(k, rotation, -(rotation * eye)).unwrap();
    let found = look(&mesh, 384, &viewers(&[camera], 1));
    let (mut counts, mut near_edge) = ([[0; 2]; 2], 0);
    for (texel, points) in found.texels.iter().zip(points(&mesh, 384)) {
        let Some((_, p)) = points.first() else { continue };
        let way = *p - eye;
        let is_sphere = p.length() < 1.01;
        // The half of the sphere that faces the camera is visible, and the walls except behind its silhouette.
        let measure = if is_sphere {
            -way.normalize().dot(p.normalize())
        } else {
            (eye.cross(way).length() / way.length()) - 1.0
        };
        let is_ahead = camera.to_camera(*p).z > 0.0;
        let seen = camera.in_picture(camera.to_camera(*p)).is_some() && measure > 0.0;
        // The silhouette of a polyhedron with edges of 1.9° is .0006 inside that of the sphere, and its normals deviate
        // by as much as its edges.
        if is_ahead && measure.abs() < if is_sphere { 0.04 } else { 0.001 } {
            near_edge += 1;
            continue;
        }
        assert_eq!(*texel >= TexelSight::Seen(0), seen, "{p} {measure}");
        counts[usize::from(is_sphere)][usize::from(seen)] += 1;
    }
    assert!(counts.as_flattened().iter().all(|&n| n > 2000) && near_edge < 2000, "{counts:?} {near_edge}");
}

/// Planes one behind the other, so that rays to cell corners pass through edges and corners of those in front.
#[test]
fn layers_are_counted() {
    let planes: Vec<Surface> = (0..3).map(|i| square(4, 2.0 + i as f32, 1.0 + 0.5 * i as f32)).collect();
    let mesh = unwrapped(&joined(&planes), 192);
    let plane_of = |p: DVec3| (p.z - 2.0).round() as usize;
    let points = points(&mesh, 192);
    let seen_of = |near: f64, layers: usize| {
        let found = look(&mesh, 192, &Viewers { near, ..viewers(&[ahead(64, 40.0)], layers) });
        let (mut seen, mut all) = ([0; 3], [0; 3]);
        for (texel, points) in found.texels.iter().zip(&points) {
            let Some((_, p)) = points.first() else { continue };
            all[plane_of(*p)] += 1;
            seen[plane_of(*p)] += usize::from(*texel >= TexelSight::Seen(0));
        }
        assert!(all.iter().all(|&n| n > 500), "{all:?}");
        [0, 1, 2].map(|i| match seen[i] {
            0 => false,
            n => {
                assert_eq!(n, all[i], "near {near}, {layers} layers, plane {i}");
                true
            }
        })
    };
    for layers in 1..=3 {
        assert_eq!(seen_of(0.0, layers), [0, 1, 2].map(|i| i < layers));
        // The first plane is in front of the near plane.
        assert_eq!(seen_of(2.5, layers), [0, 1, 2].map(|i| i > 0 && i < layers + 1));
    }
}

/// Two copies of the same faces, far from the origin, where f32 positions are 1e-3 apart, seen frontally to nearly
/// edge-on.
#[test]
fn what_lies_on_a_surface_does_not_hide_it() {
    let offset = Vec3::new(9000.0, -5000.0, 2000.0);
    let mut surface = joined(&[square(5, 0.0, 1.0), square(4, 0.0, 1.0)]);
    let turn = glam::Quat::from_scaled_axis(Vec3::new(0.4, -0.3, 0.9));
    surface.positions.iter_mut().for_each(|p| *p = offset + turn * *p);
    let mesh = unwrapped(&surface, 128);
    let normal = (turn * Vec3::Z).as_dvec3();
    let along = (turn * Vec3::X).as_dvec3();
    for degrees in [0.0_f64, 45.0, 80.0, 88.0] {
        let (sin, cos) = degrees.to_radians().sin_cos();
        let z = -(normal * cos + along * sin);
        let x = z.any_orthonormal_vector();
        let rotation = DMat3::from_cols(x, z.cross(x), z).transpose();
        let camera = ahead(100, 100.0);
        let eye = offset.as_dvec3() - 5.0 * z;
        let camera = Camera::new(*camera.intrinsics(), rotation, -(rotation * eye)).unwrap();
        let (charted, seen) = look(&mesh, 128, &viewers(&[camera], 1)).counts();
        assert!(seen == charted && seen > 5000, "{degrees}°: {seen} of {charted}");
    }
}

/// Squares of which a pixel covers 3.9, .9, .4, … texels, seen frontally, and a tilted one.
#[test]
fn mip_levels_are_those_of_the_footprint() {
    let cases = [
        (3.9_f64, 0.0_f64, 2),
        (0.9, 0.0, 0),
        (0.4, 0.0, 0),
        (2.1, 0.0, 2),
        (1.1, 0.0, 1),
        (0.9, 65.0, 2),
        (100.0, 0.0, 4),
    ];
    for (z, tilt, expected) in cases {
        // 64 texels on a side of 0.64; at depth z a pixel is z/100 wide.
        let turn = glam::Quat::from_rotation_y(tilt.to_radians() as f32);
        let corners = [[-0.32, -0.32], [0.32, -0.32], [0.32, 0.32], [-0.32, 0.32]];
        let positions = corners.map(|[x, y]| turn * Vec3::new(x, y, 0.0) + Vec3::new(0.0, 0.0, z as f32)).to_vec();
        let uv = [Vec2::ZERO, Vec2::X, Vec2::ONE, Vec2::Y];
        let uvs = vec![[uv[0], uv[1], uv[2]], [uv[0], uv[2], uv[3]]];
        let mesh = mesh(positions, vec![[0, 1, 2], [0, 2, 3]], uvs);
        let found = look(&mesh, 64, &viewers(&[ahead(400, 100.0)], 1));
        assert_eq!(found.texels[32 * 64 + 32], TexelSight::Seen(expected), "{z} {tilt}");
        // The more distant view is the coarser one.
        let far = Camera::new(*ahead(400, 100.0).intrinsics(), DMat3::IDENTITY, DVec3::new(0.0, 0.0, 12.0)).unwrap();
        let both = look(&mesh, 64, &viewers(&[ahead(400, 100.0), far], 1));
        assert_eq!(both.texels[32 * 64 + 32], TexelSight::Seen(4));
        assert!(both.rays <= 2 * 64 * 64, "{}", both.rays);
    }
}

/// A rail: its chart contains few or no texel centres, and all of it is visible.
#[test]
fn charts_thinner_than_a_texel_are_seen_along_all_of_them() {
    for (slant, thickness) in [(0.0, 0.4), (0.0, 0.1), (0.36, 0.3)] {
        let along = Vec2::new(100.0, 100.0 * slant);
        let uv = |t: f32, side: f32| (Vec2::new(10.0, 20.05 + side * thickness) + t * along) / 128.0;
        let at = |t: f32, side: f32| Vec3::new(2.0 * t - 1.0, 0.02 * side, 4.0);
        let corners = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)];
        let uvs = [[0, 1, 2], [0, 2, 3]].map(|t| t.map(|i: usize| uv(corners[i].0, corners[i].1)));
        let positions = corners.map(|(t, side)| at(t, side)).to_vec();
        let rail = mesh(positions, vec![[0, 1, 2], [0, 2, 3]], uvs.to_vec());
        let found = look(&rail, 128, &viewers(&[ahead(100, 90.0)], 1));
        assert!(!found.texels.contains(&TexelSight::Hidden));
        let reached = found.reached(0, u8::MAX);
        for k in 0..400 {
            let p = uv(k as f32 / 400.0, 0.5) * 128.0;
            assert!(reached[p.y as usize * 128 + p.x as usize], "{slant} {thickness}: {p}");
        }
    }
}

#[test]
fn what_is_mixed_in_is_reached() {
    let reached_from = |coarser: u8, coarsest: u8, size: [usize; 2], seen: &[(usize, usize, u8)]| {
        let mut texels = vec![TexelSight::Hidden; size[0] * size[1]];
        seen.iter().for_each(|&(x, y, level)| texels[y * size[0] + x] = TexelSight::Seen(level));
        let reached = TexelVisibility { size, texels, rays: 0 }.reached(coarser, coarsest);
        (0..size[0] * size[1]).filter(|&i| reached[i]).map(|i| (i % size[0], i / size[0])).collect::<Vec<_>>()
    };
    let reached = |size: [usize; 2], seen: &[(usize, usize, u8)]| reached_from(0, u8::MAX, size, seen);
    let block = |x: std::ops::Range<usize>, y: std::ops::Range<usize>| {
        y.flat_map(|y| x.clone().map(move |x| (x, y))).collect::<Vec<_>>()
    };
    assert_eq!(reached([64, 32], &[(5, 9, 0)]), block(4..7, 8..11));
    assert_eq!(reached([64, 32], &[(0, 31, 0)]), block(0..2, 30..32));
    // Column 5 of level 0 is in the right half of column 1 of level 2 (4..8), row 9 in the left half of row 2 (8..12).
    assert_eq!(reached([64, 32], &[(5, 9, 2)]), block(0..8, 4..12));
    assert_eq!(reached([64, 32], &[(63, 0, 4)]), block(48..64, 0..16));
    // A side of 5 texels has no mips, whatever level a texel has.
    assert_eq!(reached([5, 8], &[(2, 2, 3)]), block(1..4, 1..4));
    assert_eq!(reached([16, 16], &[]), []);
    // Smaller pictures read coarser levels, up to the last level of a texture.
    assert_eq!(reached_from(2, u8::MAX, [64, 32], &[(5, 9, 0)]), block(0..8, 4..12));
    assert_eq!(reached_from(2, 1, [64, 32], &[(5, 9, 3)]), reached([64, 32], &[(5, 9, 1)]));
}

#[test]
fn triangles_without_texels_and_without_sense() {
    // On an atlas of 8² texels: a triangle smaller than a texel, one without area in space, and one without area in the
    // map.
    let positions = [[0.0, 0.0, 2.0], [0.1, 0.0, 2.0], [0.0, 0.1, 2.0], [0.2, 0.0, 2.0]].map(Vec3::from).to_vec();
    let small = [Vec2::new(0.01, 0.01), Vec2::new(0.03, 0.01), Vec2::new(0.01, 0.03)];
    let uvs = vec![small, small.map(|uv| uv + 0.5), [Vec2::ONE; 3]];
    let mesh = mesh(positions, vec![[0, 1, 2], [0, 1, 3], [0, 1, 2]], uvs);
    let found = look(&mesh, 8, &viewers(&[ahead(8, 8.0)], 1));
    let seen: Vec<usize> = (0..64).filter(|&i| found.texels[i] >= TexelSight::Seen(0)).collect();
    assert_eq!((seen, found.counts()), (vec![0, 63], (2, 2)));
    let none = look(&mesh, 8, &viewers(&[], 1));
    assert_eq!((none.counts(), none.rays), ((2, 0), 0));
    let bvh = MeshBvh::new([]);
    let error = |size: [usize; 2], near: f64, layers: usize| {
        texel_visibility(&mesh, size, &bvh, &Viewers { near, ..viewers(&[], layers) }).unwrap_err().to_string()
    };
    assert_eq!(error([0, 8], 0.0, 1), "size: expected 1 to 16384 texels a side, found 0×8");
    assert_eq!(error([8, 8], f64::NAN, 1), "near: expected a depth of 0 or more, found NaN");
    assert_eq!(error([8, 8], 0.0, 0), "layers: expected at least 1, found 0");
}
