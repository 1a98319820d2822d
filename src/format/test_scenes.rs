//! Random scenes for the tests of this module.

use std::path::Path;

use glam::{DMat3, DVec3, Quat, Vec2, Vec3};
use rand::{RngExt as _, SeedableRng as _};
use rand_pcg::Pcg64Mcg;

use super::loss::{Loss, SplatError};
use super::{ReadOptions, SceneFile, read_file};
use crate::scene::{
    Atlas, Camera, ColorSpace, Composition, HybridScene, Intrinsics, Mesh, OrderMode, PixelFilter, Splats, Texture, sh,
};

pub(super) fn random_splats(n: usize, degree: u32, seed: u64) -> Splats {
    let mut rng = Pcg64Mcg::seed_from_u64(seed);
    let mut r = |low: f32, high: f32| rng.random_range(low..high);
    let means = (0..n).map(|_| Vec3::new(r(-3.0, 3.0), r(-3.0, 3.0), r(-3.0, 3.0))).collect();
    let rotations = (0..n).map(|_| Quat::from_xyzw(r(-1., 1.), r(-1., 1.), r(-1., 1.), r(0.1, 1.))).collect();
    let log_scales = (0..n).map(|_| Vec3::new(r(-9.0, 1.0), r(-9.0, 1.0), r(-9.0, 1.0))).collect();
    let logits = (0..n).map(|_| r(-9.0, 9.0)).collect();
    let sh = (0..n * sh::coefficients(degree)).map(|_| [r(-2.0, 2.0), r(-2.0, 2.0), r(-2.0, 2.0)]).collect();
    Splats::new(means, rotations, log_scales, logits, degree, sh).unwrap()
}

/// A tetrahedron that shares vertices but not UVs: every corner lies on a seam.
pub(super) fn random_mesh(degree: u32, seed: u64) -> Mesh {
    let mut rng = Pcg64Mcg::seed_from_u64(seed);
    let mut r = |low: f32, high: f32| rng.random_range(low..high);
    let mut positions: Vec<Vec3> = (0..4).map(|_| Vec3::new(r(-1., 1.), r(-1., 1.), r(-1., 1.))).collect();
    // Two coincident vertices and one unused vertex must survive.
    positions.push(positions[0]);
    positions.push(Vec3::splat(9.0));
    let triangles = vec![[0, 1, 2], [0, 3, 1], [0, 2, 3], [4, 3, 2]];
    let uvs = triangles.iter().map(|_| [(); 3].map(|()| Vec2::new(r(0., 1.), r(0., 1.)))).collect();
    let mut texture = |w: u32, h: u32, channels: u32| {
        Texture::new(w, h, channels, (0..w * h * channels).map(|_| r(-4.0, 4.0)).collect()).unwrap()
    };
    let base = texture(8, 16, 4);
    let bands = (degree > 0).then(|| texture(4, 2, sh::band_floats(degree) as u32));
    Mesh::new(positions, triangles, uvs, Atlas::new(base, bands).unwrap()).unwrap()
}

pub(super) fn random_scene(splats: usize, meshes: u32, degree: u32, seed: u64) -> HybridScene {
    HybridScene {
        splats: random_splats(splats, degree, seed),
        meshes: (0..meshes).map(|i| random_mesh((degree + i) % 4, seed + 1 + u64::from(i))).collect(),
        composition: Composition {
            mode: [OrderMode::Stable, OrderMode::SurfaceConsistent, OrderMode::Direct][seed as usize % 3],
            lambda: if seed.is_multiple_of(2) { f32::INFINITY } else { 0.1 },
            layers: [1, 2, 4][seed as usize % 3],
            color_space: if seed.is_multiple_of(2) { ColorSpace::SrgbDisplay } else { ColorSpace::LinearDisplay },
            background: [0.1, 0.2, 0.3],
            near: 0.07,
            pixel_filter: PixelFilter { variance: 0.2, normalized: seed.is_multiple_of(3) },
        },
    }
}

pub(super) fn camera() -> Camera {
    let intrinsics = Intrinsics { width: 640, height: 480, fx: 510.3, fy: 498.7, cx: 301.1, cy: 250.9 };
    let rotation = DMat3::from_euler(glam::EulerRot::YXZ, 0.4, -0.2, 1.7);
    Camera::new(intrinsics, rotation, DVec3::new(0.3, -2.0, 5.0)).unwrap()
}

/// Splats at the limits of [`Splats`] and of other programs: transparent and opaque beyond 8 bits, thinner and wider
/// than every table allows, far away, saturated in colour, and with a rotation component of exactly ±1.
pub(super) fn saturated_splats() -> Splats {
    let means = vec![Vec3::ZERO, Vec3::splat(-1e6), Vec3::new(1e6, 0.0, -0.0), Vec3::X];
    let rotations = vec![
        Quat::IDENTITY,
        -Quat::IDENTITY,
        Quat::from_xyzw(0.0, -1.0, 0.0, 0.0),
        Quat::from_xyzw(0.5, -0.5, 0.5, -0.5),
    ];
    let log_scales = vec![Vec3::splat(-87.0), Vec3::splat(80.0), Vec3::new(0.0, -30.0, 30.0), Vec3::ZERO];
    let logits = vec![-80.0, 80.0, 16.0, -16.0];
    let sh = (0..64).map(|i| if i % 2 == 0 { [9.0, -9.0, 0.0] } else { [-9.0, 1e4, -1e4] }).collect();
    Splats::new(means, rotations, log_scales, logits, 3, sh).unwrap()
}

/// Asserts that two losses are equal except for the last bits of rotations, which `Splats::new` normalises again.
pub(super) fn assert_same_loss(measured: &Loss, found: &Loss) {
    let rotation = measured.max_error.rotation;
    assert!((rotation - found.max_error.rotation).abs() < 1e-3 * rotation + 1e-4, "{measured:?} {found:?}");
    let max_error = SplatError { rotation, ..found.max_error };
    assert_eq!(*measured, Loss { max_error, ..found.clone() });
}

/// A black PNG of 1 bit per pixel, as programs write masks: a thousandth of a byte per pixel.
pub(crate) fn black_png(width: u32, height: u32) -> Vec<u8> {
    let size = [width.to_be_bytes(), height.to_be_bytes()].concat();
    let rows = vec![0; height as usize * (1 + width.div_ceil(8) as usize)];
    let parts = [
        png_chunk(b"IHDR", &[&size[..], &[1, 0, 0, 0, 0]].concat()),
        png_chunk(b"IDAT", &deflated(&rows)),
        png_chunk(b"IEND", &[]),
    ];
    [b"\x89PNG\r\n\x1a\n", &parts.concat()[..]].concat()
}

/// [`black_png`] of one pixel, with a colour profile that decompresses to this many bytes.
pub(crate) fn profiled_png(bytes: usize) -> Vec<u8> {
    let mut png = black_png(1, 1);
    // After the header.
    png.splice(33..33, png_chunk(b"iCCP", &[b"a\0\0", &deflated(&vec![0; bytes])[..]].concat()));
    png
}

fn png_chunk(kind: &[u8; 4], data: &[u8]) -> Vec<u8> {
    let named = [kind, data].concat();
    let mut crc = flate2::Crc::new();
    crc.update(&named);
    [&(data.len() as u32).to_be_bytes(), &named[..], &crc.sum().to_be_bytes()].concat()
}

fn deflated(bytes: &[u8]) -> Vec<u8> {
    let mut encoder = flate2::write::ZlibEncoder::new(vec![], flate2::Compression::best());
    std::io::Write::write_all(&mut encoder, bytes).unwrap();
    encoder.finish().unwrap()
}

/// Reads a file of a y-up world with one triangle and one camera, as two tests write it for glTF and USD, and asserts
/// that both are in the frame of captures. `y_up` is whether the file says so.
#[track_caller]
pub(super) fn read_turned(path: &Path, y_up: bool) -> SceneFile {
    let file = read_file(path, &ReadOptions::default()).unwrap();
    assert_eq!((file.y_up, file.cameras.len()), (y_up, 1));
    let expected = [[0.0, -1.0, -2.0], [1.0, -1.0, -2.0], [0.0, -3.0, -2.0]].map(Vec3::from);
    assert_eq!(file.scene.meshes[0].positions(), expected);
    // The camera looked along −z with y up; in the scene it looks along z with y down.
    let camera = file.cameras[0].1;
    assert!(camera.center().abs_diff_eq(DVec3::new(0.5, -2.0, -7.0), 1e-6), "{}", camera.center());
    assert!(camera.rotation().abs_diff_eq(DMat3::IDENTITY, 1e-6), "{}", camera.rotation());
    file
}
