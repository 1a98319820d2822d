//! Builds a small hybrid scene by hand and writes it: `cargo run --release --example write_hybrid -- scene.glb`
//! (or `.usda`, `.usdz`).
//!
//! A half-transparent square with view-dependent colour, inside a ball of splats.

use std::error::Error;
use std::path::Path;

use centaur::format::{self, WriteOptions};
use centaur::scene::{Atlas, Camera, Composition, HybridScene, Intrinsics, Mesh, Splats, Texture, sh};
use glam::{DMat3, DVec3, Quat, Vec2, Vec3};

fn main() -> Result<(), Box<dyn Error>> {
    let path = std::env::args().nth(1).ok_or("usage: write_hybrid FILE.glb|usda|usdz")?;

    let (size, band_size) = (64u32, 16u32);
    let base = (0..size * size).flat_map(|i| {
        let is_light = (i % size / 8 + i / size / 8).is_multiple_of(2);
        let [r, g, b] = sh::dc_from_rgb(if is_light { [0.9, 0.8, 0.6] } else { [0.2, 0.3, 0.5] });
        [r, g, b, if is_light { 3.0 } else { -1.0 }]
    });
    let base = Texture::new(size, size, 4, base.collect())?;
    let bands = Texture::new(band_size, band_size, 9, vec![0.1; (band_size * band_size * 9) as usize])?;
    let positions = [(-1., -1.), (1., -1.), (1., 1.), (-1., 1.)].map(|(x, y)| Vec3::new(x, y, 0.0)).to_vec();
    // The two triangles are apart in UV space: the diagonal is a seam.
    let uvs = vec![
        [Vec2::new(0.0, 0.0), Vec2::new(0.9, 0.0), Vec2::new(0.9, 0.9)],
        [Vec2::new(0.1, 0.1), Vec2::new(1.0, 1.0), Vec2::new(0.1, 1.0)],
    ];
    let mesh = Mesh::new(positions, vec![[0, 1, 2], [0, 2, 3]], uvs, Atlas::new(base, Some(bands))?)?;

    // Points on a sphere, spaced by the golden angle.
    let (count, degree) = (1000u16, 3);
    let means = (0..count).map(|i| {
        let z = 1.0 - 2.0 * (f32::from(i) + 0.5) / f32::from(count);
        let (sin, cos) = (f32::from(i) * 2.399_963).sin_cos();
        Vec3::new((1.0 - z * z).sqrt() * cos, (1.0 - z * z).sqrt() * sin, z)
    });
    let means: Vec<Vec3> = means.collect();
    let n = means.len();
    let facing = |p: &Vec3| Quat::from_rotation_arc(Vec3::Z, p.normalize());
    let sh = (0..n * sh::coefficients(degree)).map(|i| if i.is_multiple_of(16) { [1.0, 0.2, -0.5] } else { [0.05; 3] });
    let splats = Splats::new(
        means.clone(),
        means.iter().map(facing).collect(),
        vec![Vec3::new(-3.0, -3.0, -5.0); n],
        vec![1.0; n],
        degree,
        sh.collect(),
    )?;

    // Off centre, so that the seam does not run through pixel centres, which rounding could assign to either side.
    let intrinsics = Intrinsics { width: 640, height: 480, fx: 600.0, fy: 600.0, cx: 319.7, cy: 240.2 };
    let camera = Camera::new(intrinsics, DMat3::IDENTITY, DVec3::new(0.0, 0.0, 4.0))?;
    let scene = HybridScene { splats, meshes: vec![mesh], composition: Composition::default() };
    let cameras = [("front".to_owned(), camera)];
    format::write_scene(Path::new(&path), &scene, &WriteOptions { cameras: &cameras, ..WriteOptions::default() })?;
    Ok(())
}
