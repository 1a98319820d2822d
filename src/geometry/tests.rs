//! From fusion of analytic depth maps to a simplified surface.

use std::collections::HashMap;

use glam::{DMat3, DVec2, DVec3, Vec3};

use super::surface::{clean, simplify};
use super::*;
use crate::render::testing::largest;
use crate::scene::{Camera, Intrinsics};

/// Options that drop only tiny components.
pub(super) const ANY: SurfaceOptions =
    SurfaceOptions { min_component_faces: 50, planar: true, target_triangles: 100_000 };

fn look_at(eye: DVec3, target: DVec3, width: u32, height: u32) -> Camera {
    let f = 1.2 * f64::from(width);
    let intrinsics =
        Intrinsics { width, height, fx: f, fy: f, cx: f64::from(width) * 0.49, cy: f64::from(height) * 0.52 };
    Camera::look_at(intrinsics, eye, target, DVec3::ZERO).unwrap()
}

/// Cameras on a Fibonacci sphere of radius 3, looking at the origin.
pub(super) fn orbit(count: u32, width: u32, height: u32) -> Vec<Camera> {
    (0..count)
        .map(|i| {
            let y = 1.0 - 2.0 * (f64::from(i) + 0.5) / f64::from(count);
            let (s, c) = (2.399_963 * f64::from(i)).sin_cos();
            let r = (1.0 - y * y).sqrt();
            look_at(DVec3::new(r * c, y, r * s) * 3.0, DVec3::ZERO, width, height)
        })
        .collect()
}

/// A latitude-longitude sphere.
pub(super) fn sphere(n: u32, center: Vec3, radius: f32) -> Surface {
    let ring = 2 * n;
    let at = |i: u32, j: u32| {
        let [a, b] = [i, j].map(|k| std::f32::consts::PI * k as f32 / n as f32);
        center + radius * Vec3::new(a.sin() * b.cos(), a.sin() * b.sin(), a.cos())
    };
    let triangles = (0..n).flat_map(|i| (0..ring).map(move |j| (i * ring + j, i * ring + (j + 1) % ring)));
    Surface {
        positions: (0..=n).flat_map(|i| (0..ring).map(move |j| at(i, j))).collect(),
        triangles: triangles.flat_map(|(a, b)| [[a, a + ring, b], [b, a + ring, b + ring]]).collect(),
    }
}

/// Depth map of the surface hit by `hit(origin, dir)`, which returns the ray parameter: for a ray with z = 1 this is
/// the depth.
pub(super) fn depth_map(camera: &Camera, hit: impl Fn(DVec3, DVec3) -> Option<f64>) -> Vec<f32> {
    let k = *camera.intrinsics();
    let to_world = camera.rotation().transpose();
    (0..k.width * k.height)
        .map(|i| {
            let uv = DVec2::new(f64::from(i % k.width) + 0.5, f64::from(i / k.width) + 0.5);
            hit(camera.center(), to_world * camera.ray(uv)).map_or(0.0, |t| t as f32)
        })
        .collect()
}

pub(super) fn unit_sphere(origin: DVec3, dir: DVec3) -> Option<f64> {
    let (a, b, c) = (dir.length_squared(), origin.dot(dir), origin.length_squared() - 1.0);
    let d = b * b - a * c;
    (d >= 0.0).then(|| (-b - d.sqrt()) / a)
}

/// Ray-triangle intersection by Möller–Trumbore, a formula other than that of the hierarchy; returns the ray parameter.
pub(super) fn meets(origin: DVec3, dir: DVec3, [a, b, c]: [DVec3; 3]) -> Option<f64> {
    let (e1, e2) = (b - a, c - a);
    let q = dir.cross(e2);
    let det = e1.dot(q);
    let s = origin - a;
    let u = s.dot(q) / det;
    let r = s.cross(e1);
    let v = dir.dot(r) / det;
    (u >= 0.0 && v >= 0.0 && u + v <= 1.0).then(|| e2.dot(r) / det)
}

/// A wall seen from several positions.
#[test]
fn voxels_grow_until_they_fit() {
    let k = Intrinsics { width: 160, height: 120, fx: 600.0, fy: 600.0, cx: 80.0, cy: 60.0 };
    let cameras: Vec<Camera> =
        (0..4).map(|i| Camera::new(k, DMat3::IDENTITY, DVec3::new(0.02 * f64::from(i), 0.0, 2.0)).unwrap()).collect();
    let points = [Vec3::new(-0.2, -0.2, -0.1), Vec3::new(0.2, 0.2, 0.1), Vec3::ZERO, Vec3::ZERO];
    let bytes = |max_bytes: usize| {
        let options = |n: u32| Ok(FusionOptions { max_bytes, ..FusionOptions::suggest(&cameras, &points, n, None)? });
        let depth_of = |_| Ok::<_, GeometryError>(vec![2.0; 160 * 120]);
        Fusion::of_depths(&cameras, 64..=400, options, depth_of).map(|fusion| fusion.bytes())
    };
    let all = bytes(2 << 30).unwrap();
    let less = bytes(all / 3).unwrap();
    assert!(less <= all / 3 && less > all / 10, "{less} of {all}");
    assert!(matches!(bytes(1000), Err(GeometryError::FusionMemory { .. })));
}

fn fused_sphere(cameras: &[Camera], voxel: f64) -> Fusion {
    let options = FusionOptions {
        voxel,
        truncation: 5.0 * voxel,
        bounds: (DVec3::splat(-1.3), DVec3::splat(1.3)),
        contraction: None,
        max_depth: 6.0,
        max_bytes: 1 << 30,
    };
    let mut fusion = Fusion::new(options).unwrap();
    for camera in cameras {
        let depth = depth_map(camera, unit_sphere);
        fusion.integrate(camera, &depth).unwrap();
    }
    fusion
}

/// Number of edges with two faces, with four faces, and with an odd number (a crack or boundary).
pub(super) fn edge_counts(surface: &Surface) -> [usize; 3] {
    let mut faces: HashMap<(u32, u32), usize> = HashMap::new();
    for t in &surface.triangles {
        for k in 0..3 {
            let (a, b) = (t[k], t[(k + 1) % 3]);
            *faces.entry((a.min(b), a.max(b))).or_default() += 1;
        }
    }
    let count = |wanted: &dyn Fn(usize) -> bool| faces.values().filter(|&&n| wanted(n)).count();
    [count(&|n| n == 2), count(&|n| n > 2 && n % 2 == 0), count(&|n| n % 2 == 1)]
}

/// Largest and mean distance of samples (vertices and centroids) from the unit sphere.
fn sphere_error(surface: &Surface) -> (f64, f64) {
    let corners = surface.triangles.iter().map(|t| t.map(|v| surface.positions[v as usize].as_dvec3()));
    let centroids = corners.map(|[a, b, c]| (a + b + c) / 3.0);
    let errors: Vec<f64> =
        surface.positions.iter().map(|p| p.as_dvec3()).chain(centroids).map(|p| (p.length() - 1.0).abs()).collect();
    (largest(errors.iter().copied()), errors.iter().sum::<f64>() / errors.len() as f64)
}

#[test]
fn a_sphere_is_closed_and_in_place() {
    let voxel = 0.04;
    let fusion = fused_sphere(&orbit(24, 160, 160), voxel);
    let surface = fusion.extract();
    let [two, four, odd] = edge_counts(&surface);
    assert_eq!(odd, 0, "cracks");
    // Surface nets have one vertex per cell, which two sheets passing through the cell share: rare on a smooth surface.
    assert!(four * 1000 < two, "{four} of {two} edges have four faces");
    let (max, mean) = sphere_error(&surface);
    eprintln!(
        "{} triangles, error in voxels: max {:.3}, mean {:.3}",
        surface.triangles.len(),
        max / voxel,
        mean / voxel
    );
    // Distances along the ray are too large at grazing angles, where few pixels see the surface.
    assert!(max < voxel && mean < 0.25 * voxel, "{max} {mean}");
    let volume: f32 = surface
        .triangles
        .iter()
        .map(|t| t.map(|v| surface.positions[v as usize]))
        .map(|[a, b, c]| a.dot(b.cross(c)) / 6.0)
        .sum();
    // Positive only if faces point outwards.
    assert!((f64::from(volume) / (4.0 / 3.0 * std::f64::consts::PI) - 1.0).abs() < 0.03, "volume {volume}");
    // The same views give the same surface, independently of thread scheduling.
    assert_eq!(surface, fused_sphere(&orbit(24, 160, 160), voxel).extract());
}

#[test]
fn memory_follows_the_surface_and_has_a_limit() {
    let cameras = orbit(8, 120, 120);
    let (coarse, fine) = (fused_sphere(&cameras, 0.04), fused_sphere(&cameras, 0.02));
    let growth = fine.bytes() as f64 / coarse.bytes() as f64;
    // With half the voxel size: 4 times the surface voxels in a band of a fixed number of voxels, not 8 times.
    assert!(growth < 5.0, "{growth}");
    let mut limited = Fusion::new(FusionOptions { max_bytes: 100_000, ..coarse.options }).unwrap();
    let depth = depth_map(&cameras[0], unit_sphere);
    let bounds = limited.options.bounds;
    let resolution = ((bounds.1 - bounds.0).max_element() / 0.04).round() as u32;
    let error = limited.integrate(&cameras[0], &depth).unwrap_err();
    assert_eq!(error, GeometryError::FusionMemory { limit_mib: 0, views: 0, resolution });
    assert!(error.to_string().ends_with(&format!("with {resolution} voxels along the longest side")), "{error}");
    assert_eq!(limited.bytes(), 0);
}

#[test]
fn an_open_plane_ends_where_nothing_was_seen() {
    let cameras: Vec<Camera> = (0..6)
        .map(|i| look_at(DVec3::new(0.2 * f64::from(i) - 0.5, 0.1, -2.0), DVec3::new(0.0, 0.0, 0.0), 120, 90))
        .collect();
    let mut fusion = Fusion::new(FusionOptions {
        voxel: 0.02,
        truncation: 0.1,
        bounds: (DVec3::splat(-1.0), DVec3::splat(1.0)),
        contraction: None,
        max_depth: 4.0,
        max_bytes: 1 << 28,
    })
    .unwrap();
    for camera in &cameras {
        let depth = depth_map(camera, |o, d| {
            let t = -o.z / d.z;
            let p = o + d * t;
            (p.x.abs() < 0.4 && p.y.abs() < 0.4).then_some(t)
        });
        fusion.integrate(camera, &depth).unwrap();
    }
    let surface = surface_from_fusion(&fusion, &ANY).unwrap().0;
    for p in &surface.positions {
        // 0.05 voxels: z is interpolated linearly between pixels, although 1/z is linear on a plane. One voxel and a
        // pixel beyond the boundary may be filled.
        assert!(p.z.abs() < 1e-3 && p.x.abs() < 0.43 && p.y.abs() < 0.43, "{p}");
    }
    let area: f32 = surface
        .triangles
        .iter()
        .map(|t| t.map(|v| surface.positions[v as usize]))
        .map(|[a, b, c]| (b - a).cross(c - a).length() / 2.0)
        .sum();
    assert!((area - 0.64).abs() < 0.08, "{area}");
}

#[test]
fn simplification_keeps_the_shape() {
    let voxel = 0.04;
    let surface = fused_sphere(&orbit(24, 160, 160), voxel).extract();
    let simple = simplify(&surface, &[], 2000);
    assert!((1900..=2000).contains(&simple.triangles.len()), "{}", simple.triangles.len());
    assert_eq!(edge_counts(&simple)[2], 0);
    let (max, mean) = sphere_error(&simple);
    eprintln!("simplified: error in voxels: max {:.3}, mean {:.3}", max / voxel, mean / voxel);
    // For edges of length ~0.1 the sagitta is 0.1²/8 = 0.03 voxels; the rest is the error of the input.
    assert!(max < 1.2 * voxel && mean < 0.3 * voxel, "{max} {mean}");
    assert_eq!(simple, simplify(&surface, &[], 2000));
}

#[test]
fn cleaning_keeps_the_large_components() {
    let strip = |count: u32, first: u32| (0..count).map(move |i| [first + i, first + i + 1, first + i + 2]);
    let mut positions: Vec<Vec3> =
        (0..100u32).map(|i| Vec3::new(i as f32, (i % 2) as f32, (i / 2 % 2) as f32)).collect();
    positions.push(Vec3::NAN);
    let mut triangles: Vec<[u32; 3]> = strip(30, 0).chain(strip(5, 40)).chain(strip(20, 60)).collect();
    let good = triangles.len();
    triangles.extend([[1, 2, 0], [3, 3, 4], [0, 1, 100], [0, 1, 4000]]);
    let surface = Surface { positions, triangles };
    let all = clean(surface.clone(), 1, 10);
    assert_eq!(all.triangles.len(), good, "only the broken and the repeated ones go");
    assert_eq!(all.positions.len(), 32 + 7 + 22);
    assert_eq!(clean(surface.clone(), 5, 10).triangles.len(), 55, "the limit itself is enough");
    assert_eq!(clean(surface.clone(), 6, 10).triangles.len(), 50);
    assert_eq!(clean(surface.clone(), 1, 1).triangles.len(), 30);
    assert_eq!(clean(surface, 1000, 10), Surface::default());
    assert_eq!(clean(Surface::default(), 0, 0), Surface::default());
    assert_eq!(simplify(&Surface { positions: vec![], triangles: vec![[0, 1, 2]; 9] }, &[], 1), Surface::default());
}

#[test]
fn suggested_volume_holds_the_scene() {
    let cameras = orbit(20, 100, 80);
    let mut points: Vec<Vec3> = orbit(1000, 1, 1).iter().map(|c| (c.center() / 3.0).as_vec3()).collect();
    points.extend([Vec3::splat(1e6), Vec3::NAN]);
    let o = FusionOptions::suggest(&cameras, &points, 256, None).unwrap();
    // All cameras are at distance 3 from the focus, and see the far corners of the box.
    assert!((256.0 * o.voxel - 6.0).abs() < 0.05 && o.max_depth < 3.0 + 3.0_f64.sqrt() * 1.5);
    for corner in 0..8 {
        let [x, y, z] = [0, 1, 2].map(|axis| if corner >> axis & 1 == 0 { o.bounds.0[axis] } else { o.bounds.1[axis] });
        assert!(cameras.iter().all(|c| c.center().distance(DVec3::new(x, y, z)) <= o.max_depth));
    }
    assert!((o.truncation / o.voxel - 5.0).abs() < 1e-12);
    assert!(o.bounds.0.max_element() < -1.0 && o.bounds.1.min_element() > 1.0, "{:?}", o.bounds);
    assert!(o.bounds.0.min_element() > -1.5 && o.bounds.1.max_element() < 1.5, "{:?}", o.bounds);
    // A camera that passes the focus gives no information on the extent of the scene.
    let mut walk = cameras.clone();
    let first = &cameras[0];
    let beside = -(first.rotation() * DVec3::new(0.1, 0.0, 0.0));
    walk.push(Camera::new(*first.intrinsics(), first.rotation(), beside).unwrap());
    assert!((256.0 * FusionOptions::suggest(&walk, &points, 256, None).unwrap().voxel - 6.0).abs() < 0.3);
    assert!(FusionOptions::suggest(&[], &points, 256, None).is_err());
    assert!(FusionOptions::suggest(&cameras, &points, 0, None).is_err());
    for (cameras, points) in [(&cameras[..1], &points[..0]), (&[cameras[0]; 3], &points), (&cameras, &points[1001..])] {
        assert!(Fusion::new(FusionOptions::suggest(cameras, points, 64, None).unwrap()).is_ok());
    }
}

#[test]
fn within_a_shell_charts_are_laid_out_in_the_world() {
    let cameras = orbit(20, 100, 80);
    let point = Vec3::X * 1000.0;
    let (contraction, shell) =
        (Contraction::around(&cameras, &[point]).unwrap(), Shell::around(&cameras, &[point]).unwrap());
    let center = cameras.iter().map(Camera::center).sum::<DVec3>() / cameras.len() as f64;
    // At four times the distance of the point.
    let far = center + DVec3::Y * 4.0 * center.distance(point.as_dvec3());
    assert!(shell.holds(far.as_vec3()) && !shell.holds(point));
    let (unbounded, within) = (ChartSpace::unbounded(contraction), ChartSpace::within_shell(contraction, shell));
    for p in [DVec3::ZERO, DVec3::Z * 5.0, point.as_dvec3()] {
        assert_eq!(within.place(p), p);
    }
    assert_ne!(unbounded.place(point.as_dvec3()), point.as_dvec3());
    assert_eq!(within.place(far), unbounded.place(far));
}

/// The unit sphere inside a sphere of radius 60: ten times the radius of the uncontracted space.
#[test]
fn unbounded_scenes_are_fused_in_contracted_space() {
    const FAR: f64 = 60.0;
    let cameras = orbit(24, 160, 160);
    let around = |o: DVec3, d: DVec3| {
        let (a, b, c) = (d.length_squared(), o.dot(d), o.length_squared() - FAR * FAR);
        unit_sphere(o, d).or(Some((-b + (b * b - a * c).sqrt()) / a))
    };
    let points: Vec<Vec3> = (orbit(1000, 1, 1).iter().zip([1.0, 1.0, FAR / 3.0].into_iter().cycle()))
        .map(|(c, scale)| (c.center() * scale).as_vec3())
        .collect();
    assert_eq!(Contraction::if_unbounded(&cameras, &points[..99]).unwrap(), None);
    let near: Vec<Vec3> = points.iter().copied().filter(|p| p.length() < 5.0).collect();
    assert_eq!(Contraction::if_unbounded(&cameras, &near).unwrap(), None);
    let contraction = Contraction::if_unbounded(&cameras, &points).unwrap();
    let options = FusionOptions::suggest(&cameras, &points, 128, contraction).unwrap();
    assert!((contraction.unwrap().radius - 6.0).abs() < 0.1 && options.max_depth > FAR + 3.0);
    let mut fusion = Fusion::new(options).unwrap();
    for camera in &cameras {
        let depth = depth_map(camera, around);
        fusion.integrate(camera, &depth).unwrap();
    }
    let surface = fusion.expanded(fusion.extract());
    let mut errors = [vec![], vec![]];
    for p in &surface.positions {
        let distance = f64::from(p.length());
        let is_far = usize::from(distance > 10.0);
        // In units of the local voxel size, which grows with the square of the distance along the ray.
        let size = [options.voxel, options.voxel * (FAR / 6.0).powi(2)][is_far];
        errors[is_far].push((distance - [1.0, FAR][is_far]).abs() / size);
    }
    let kinds = errors.each_ref().map(Vec::len);
    let worst = errors.map(largest);
    let mib = fusion.bytes() >> 20;
    eprintln!("{kinds:?} vertices near and far, at most {worst:?} voxels off, {mib} MiB");
    assert!(worst[0] < 1.0 && worst[1] < 1.0, "{worst:?}");
    // 4π/voxel² vertices near, and far those in image corners seen by two views, out of 4π(6·1.9/voxel)².
    assert!(kinds[0] > 5_000 && kinds[1] > 50_000 && mib < 200, "{kinds:?}, {mib} MiB");
    let (simple, stats) = surface_from_fusion(&fusion, &ANY).unwrap();
    assert!(stats.contraction == contraction && simple.positions.iter().any(|p| (p.length() - 60.0).abs() < 1.0));
    let [near, far] = [0.5..1.5, 50.0..70.0].map(|range: std::ops::Range<f32>| {
        simple.triangles.iter().filter(|t| range.contains(&simple.positions[t[0] as usize].length())).count()
    });
    assert_eq!(near + far, simple.triangles.len());
    // The number of triangles is proportional to the area in contracted space, not in the world.
    assert!(near > 500 && far > near, "{near} and {far}");
    assert_eq!(surface_from_fusion(&fusion, &ANY).unwrap().0, simple);
}

#[test]
fn refuses_what_makes_no_sense() {
    let good = fused_sphere(&[], 0.1).options;
    let refused = |options| matches!(Fusion::new(options), Err(GeometryError::Argument(_)));
    assert!(refused(FusionOptions { voxel: 0.0, ..good }));
    assert!(refused(FusionOptions { voxel: f64::NAN, ..good }));
    assert!(refused(FusionOptions { voxel: 1e-9, ..good }));
    let flat = Contraction { center: DVec3::ZERO, radius: 0.0 };
    assert!(refused(FusionOptions { contraction: Some(flat), ..good }));
    assert!(refused(FusionOptions { truncation: 0.1, ..good }));
    assert!(refused(FusionOptions { bounds: (DVec3::ONE, DVec3::ZERO), ..good }));
    let camera = orbit(1, 8, 8)[0];
    let mut fusion = Fusion::new(good).unwrap();
    assert!(fusion.integrate(&camera, &[1.0; 63]).is_err());
    let broken = [f32::NAN, f32::INFINITY, -1.0, 0.0, 1e30, 1e-30, 2.0, 2.1].repeat(8);
    fusion.integrate(&camera, &broken).unwrap();
    assert!(fusion.extract().positions.iter().all(|p| p.is_finite()));
    let none = surface_from_fusion(&Fusion::new(good).unwrap(), &ANY);
    assert!(matches!(none, Err(GeometryError::EmptySurface { step: "extraction", .. })));
}
