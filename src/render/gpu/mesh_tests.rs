//! The mesh layers compared with a brute-force oracle in f64: every pixel against every triangle, without tiles.

use glam::{DMat2, DMat3, DQuat, DVec2, DVec3, DVec4, Vec2, Vec3};

use super::device::{Buffer, Frame, Gpu};
use super::mesh::{BIN, MeshStage, binning_shares};
use super::status::status_buffer;
use super::view::{VIEW_WORDS, View};
use crate::scene::{Atlas, Camera, Composition, Intrinsics, Mesh, Texture, sh};

/// splitmix64 as a generator of numbers in [0, 1).
pub(super) struct Random(pub(super) u64);

impl Random {
    pub(super) fn unit(&mut self) -> f32 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ (z >> 31)) >> 40) as f32 / (1u64 << 24) as f32
    }

    pub(super) fn signed(&mut self) -> f32 {
        2.0 * self.unit() - 1.0
    }

    pub(super) fn vec3(&mut self) -> Vec3 {
        Vec3::new(self.signed(), self.signed(), self.signed())
    }

    pub(super) fn texture(&mut self, width: u32, height: u32, channels: u32, scale: f32) -> Texture {
        let texels = (0..width * height * channels).map(|_| scale * self.signed()).collect();
        Texture::new(width, height, channels, texels).unwrap()
    }
}

pub(super) fn atlas(random: &mut Random, degree: u32, size: u32) -> Atlas {
    let bands = (degree > 0).then(|| random.texture(size / 2, size, sh::band_floats(degree) as u32, 0.4));
    Atlas::new(random.texture(2 * size, size, 4, 1.5), bands).unwrap()
}

/// Random triangles around z = 1..6 in camera space, including ones through the near and camera planes, ones behind the
/// camera and degenerate ones. UVs cover the map at densities that span several mip levels.
pub(super) fn soup(random: &mut Random, n: usize, degree: u32) -> Mesh {
    let (mut positions, mut uvs) = (vec![], vec![]);
    for i in 0..n {
        let reach = 0.1 + 1.2 * random.unit();
        let center = match i % 16 {
            0 => Vec3::new(0.4, 0.4, 0.2) * random.vec3(),
            1 => Vec3::new(random.signed(), random.signed(), -1.5),
            _ => Vec3::new(2.0 * random.signed(), 2.0 * random.signed(), 1.0 + 5.0 * random.unit()),
        };
        let corner = [0, 1, 2].map(|_| center + reach * random.vec3());
        let last = match i % 16 {
            2 => corner[0],
            3 => 0.5 * (corner[0] + corner[1]),
            _ => corner[2],
        };
        positions.extend([corner[0], corner[1], last]);
        let density = [0.05, 0.3, 2.0, 8.0][i % 4];
        let at = Vec2::new(random.unit(), random.unit());
        uvs.push([0, 1, 2].map(|_| at + density * Vec2::new(random.signed(), random.signed())));
    }
    let triangles = (0..n as u32).map(|i| [3 * i, 3 * i + 1, 3 * i + 2]).collect();
    Mesh::new(positions, triangles, uvs, atlas(random, degree, 32)).unwrap()
}

/// A latitude-longitude sphere of 2·columns·rows triangles.
pub(super) fn sphere(columns: u32, rows: u32, center: Vec3, radius: f32, atlas: Atlas) -> Mesh {
    let uv = |x: u32, y: u32| Vec2::new(x as f32 / columns as f32, y as f32 / rows as f32);
    let point = |x: u32, y: u32| {
        let (a, b) = (uv(x % columns, y).x * std::f32::consts::TAU, uv(x, y).y * std::f32::consts::PI);
        center + radius * Vec3::new(b.sin() * a.cos(), b.cos(), b.sin() * a.sin())
    };
    let positions = (0..=rows).flat_map(|y| (0..columns).map(move |x| point(x, y))).collect();
    let (mut triangles, mut uvs) = (vec![], vec![]);
    for (x, y) in (0..rows).flat_map(|y| (0..columns).map(move |x| (x, y))) {
        let i = |dx: u32, dy: u32| (y + dy) * columns + (x + dx) % columns;
        triangles.extend([[i(0, 0), i(1, 0), i(1, 1)], [i(0, 0), i(1, 1), i(0, 1)]]);
        uvs.push([uv(x, y), uv(x + 1, y), uv(x + 1, y + 1)]);
        uvs.push([uv(x, y), uv(x + 1, y + 1), uv(x, y + 1)]);
    }
    Mesh::new(positions, triangles, uvs, atlas).unwrap()
}

pub(super) fn view(width: u32, height: u32, rotation: DMat3, layers: u32, meshes: &[Mesh]) -> View {
    let f = 0.8 * f64::from(width);
    let k = Intrinsics { width, height, fx: f, fy: 1.1 * f, cx: 0.47 * f64::from(width), cy: 0.55 * f64::from(height) };
    let camera = Camera::new(k, rotation, DVec3::new(0.1, -0.05, 0.2)).unwrap();
    let n_triangles = meshes.iter().map(|m| m.triangles().len() as u32).sum();
    View { band_degree: 3, n_triangles, ..View::of(&camera, Composition { layers, ..Composition::default() }) }
}

/// Intersection of a pixel's ray with a triangle.
#[derive(Clone, Copy)]
pub(super) struct Hit {
    z: f64,
    pub(super) mesh: usize,
    uv: DVec2,
    /// ∂uv/∂pixel, columns x and y.
    slope: DMat2,
    direction: DVec3,
}

/// Barycentric coordinates and depth of the intersection of ray `r` with triangle `v`, in camera space.
fn intersect(v: [DVec3; 3], r: DVec3) -> Option<(DVec3, f64)> {
    let a = DVec3::new(r.dot(v[1].cross(v[2])), r.dot(v[2].cross(v[0])), r.dot(v[0].cross(v[1])));
    let sum = a.element_sum();
    let inside = a.min_element() >= 0.0 || a.max_element() <= 0.0;
    (inside && sum != 0.0).then(|| (a / sum, v[0].dot(v[1].cross(v[2])) / sum))
}

/// Hits of every pixel sorted by depth, at most `layers`.
pub(super) fn hits(view: &View, meshes: &[Mesh]) -> Vec<Vec<Hit>> {
    let (camera, k) = (&view.camera, view.camera.intrinsics());
    let mut triangles = vec![];
    for (m, mesh) in meshes.iter().enumerate() {
        for (t, uvs) in mesh.triangles().iter().zip(mesh.corner_uvs()) {
            let v = t.map(|i| camera.to_camera(mesh.positions()[i as usize].as_dvec3()));
            triangles.push((m, v, uvs.map(Vec2::as_dvec2)));
        }
    }
    let pixel = |i: usize| {
        let p = DVec2::new((i % k.width as usize) as f64 + 0.5, (i / k.width as usize) as f64 + 0.5);
        let mut found = vec![];
        for (m, v, uvs) in &triangles {
            let uv_at = |p: DVec2| {
                let r = camera.ray(p);
                let a = DVec3::new(r.dot(v[1].cross(v[2])), r.dot(v[2].cross(v[0])), r.dot(v[0].cross(v[1])));
                let b = a / a.element_sum();
                uvs[0] * b.x + uvs[1] * b.y + uvs[2] * b.z
            };
            let Some((_, z)) = intersect(*v, camera.ray(p)) else { continue };
            if z > f64::from(view.composition.near) {
                let h = 1e-5;
                let slope = |d: DVec2| (uv_at(p + h * d) - uv_at(p - h * d)) / (2.0 * h);
                let slope = DMat2::from_cols(slope(DVec2::X), slope(DVec2::Y));
                let direction = (camera.rotation().transpose() * camera.ray(p)).normalize();
                found.push(Hit { z, mesh: *m, uv: uv_at(p), slope, direction });
            }
        }
        found.sort_by(|a, b| a.z.total_cmp(&b.z));
        found.truncate(view.composition.layers as usize);
        found
    };
    (0..view.pixels()).map(pixel).collect()
}

/// A texel of a mip level: the mean of the level-0 texels that it covers.
fn mip_texel(t: &Texture, level: u32, x: u32, y: u32, c: u32) -> f64 {
    let side = 1 << level;
    let at = |i: u32| {
        let (x, y) = (x * side + i % side, y * side + i / side);
        f64::from(t.texels()[((y * t.width() + x) * t.channels() + c) as usize])
    };
    (0..side * side).map(at).sum::<f64>() / f64::from(side * side)
}

/// Mip level of a texture at a hit.
pub(super) fn mip_level(t: &Texture, hit: &Hit) -> f64 {
    let size = DVec2::new(f64::from(t.width()), f64::from(t.height()));
    let (x, y) = (hit.slope.x_axis * size, hit.slope.y_axis * size);
    let (a, b, c) = (x.length_squared(), y.length_squared(), x.dot(y));
    let squared = 0.5 * (a + b) + (0.25 * (a - b).powi(2) + c * c).sqrt();
    (0.5 * squared.log2()).clamp(0.0, f64::from(t.mip_levels() - 1))
}

/// All channels of a texture at a hit, trilinear.
fn sample(t: &Texture, hit: &Hit) -> Vec<f64> {
    let level = mip_level(t, hit);
    let mut out = vec![0.0; t.channels() as usize];
    for (m, share) in [(level.floor(), 1.0 - level.fract()), (level.floor() + 1.0, level.fract())] {
        if share == 0.0 {
            continue;
        }
        let (w, h) = (t.width() >> m as u32, t.height() >> m as u32);
        let st = hit.uv * DVec2::new(f64::from(w), f64::from(h)) - 0.5;
        let f = st - st.floor();
        for (dx, dy, weight) in [
            (0.0, 0.0, (1.0 - f.x) * (1.0 - f.y)),
            (1.0, 0.0, f.x * (1.0 - f.y)),
            (0.0, 1.0, (1.0 - f.x) * f.y),
            (1.0, 1.0, f.x * f.y),
        ] {
            let i = (st.x.floor() + dx).clamp(0.0, f64::from(w - 1)) as u32;
            let j = (st.y.floor() + dy).clamp(0.0, f64::from(h - 1)) as u32;
            for (c, out) in out.iter_mut().enumerate() {
                *out += share * weight * mip_texel(t, m as u32, i, j, c as u32);
            }
        }
    }
    out
}

/// Colour and alpha of a hit.
pub(super) fn shade(hit: &Hit, meshes: &[Mesh], band_degree: u32) -> DVec4 {
    let atlas = meshes[hit.mesh].atlas();
    let base = sample(atlas.base(), hit);
    let basis = sh::basis(hit.direction.to_array());
    let mut rgb = DVec3::splat(0.5) + basis[0] * DVec3::new(base[0], base[1], base[2]);
    if let Some(bands) = atlas.bands() {
        let t = sample(bands, hit);
        for k in 1..sh::coefficients(band_degree.min(atlas.sh_degree())) {
            rgb += basis[k] * DVec3::new(t[3 * k - 3], t[3 * k - 2], t[3 * k - 1]);
        }
    }
    rgb.max(DVec3::ZERO).extend((1.0 / (1.0 + (-base[3]).exp())).min(1.0 - 1e-4))
}

pub(super) struct Rig {
    pub(super) gpu: Gpu,
    pub(super) uniform: Buffer,
    pub(super) stage: MeshStage,
}

impl Rig {
    pub(super) fn new(gpu: Gpu, view: &View, meshes: &[Mesh], trainable: bool) -> Self {
        let uniform = gpu.uniform("view", VIEW_WORDS).unwrap();
        let status = trainable.then(|| status_buffer(&gpu).unwrap());
        let stage = MeshStage::new(&gpu, meshes, view.composition.layers, status.as_ref()).unwrap();
        let mut rig = Self { gpu, uniform, stage };
        rig.forward(view);
        rig
    }

    pub(super) fn forward(&mut self, view: &View) {
        self.gpu.write(&self.uniform, 0, &view.words());
        self.stage.resize(&self.gpu, view, &self.uniform).unwrap();
        let mut frame = Frame::new(&self.gpu);
        self.stage.record_forward(&mut frame);
        frame.submit();
    }

    pub(super) fn layers(&self, view: &View) -> (Vec<f32>, Vec<[f32; 4]>) {
        let n = view.pixels() * view.composition.layers as usize;
        (self.gpu.read(self.stage.layer_depth(), n).unwrap(), self.gpu.read(self.stage.layer_color(), n).unwrap())
    }

    /// Compares all layers of a rendered view with the oracle.
    pub(super) fn check(&self, view: &View, meshes: &[Mesh], what: &str) {
        let (depths, colors) = self.layers(view);
        let expected = hits(view, meshes);
        let covered = expected.iter().filter(|h| !h.is_empty()).count();
        assert!(view.pixels() < 1000 || 5 * covered > view.pixels(), "{what}: only {covered} pixels see a mesh");
        let (mut mismatched, mut depth_error, mut color_error) = (0, 0.0, 0.0);
        for (i, (&z, color)) in depths.iter().zip(&colors).enumerate() {
            let hit = expected[i % view.pixels()].get(i / view.pixels());
            let color = DVec4::from_array(color.map(f64::from));
            let wanted = hit.map_or(DVec4::ZERO, |h| shade(h, meshes, view.band_degree));
            let relative = hit.map_or(f64::from(z), |h| (f64::from(z) - h.z) / h.z).abs();
            // At an edge, or for two surfaces at one depth, f32 can decide differently from f64.
            mismatched += usize::from(relative > 1e-4);
            depth_error += relative;
            color_error += (color - wanted).abs().element_sum() / 4.0;
        }
        let n = depths.len() as f64;
        let (depth_error, color_error) = (depth_error / n, color_error / n);
        eprintln!(
            "{what}: mean |Δz|/z {depth_error:.1e}, mean |Δrgba| {color_error:.1e}, {mismatched} of {n} decided otherwise"
        );
        assert!(depth_error < 1e-4 && color_error < 1e-4, "{what}");
        assert!(mismatched as f64 <= 1.0 + 2e-4 * n, "{what}: {mismatched} of {n} pixels differ");
    }
}

#[test]
fn layers_match_brute_force() {
    let mut random = Random(1);
    for (case, (width, height)) in [(64, 48), (37, 51), (97, 33), (16, 16), (1, 1), (150, 70)].into_iter().enumerate() {
        for layers in [1, 2, 4] {
            let degree = (case as u32 + layers) % 4;
            let mut meshes = vec![soup(&mut random, 120, degree)];
            if case % 2 == 1 {
                let maps = atlas(&mut random, 2, 16);
                meshes.push(sphere(24, 12, Vec3::new(0.2, 0.1, 3.0), 1.0, maps));
                meshes.push(soup(&mut random, 9, 0));
            }
            let turn = DMat3::from_quat(DQuat::from_rotation_y(0.3 * f64::from(random.signed())));
            let mut view = view(width, height, turn, layers, &meshes);
            view.band_degree = [3, 1, 2][case % 3];
            let rig = Rig::new(Gpu::open(None).unwrap(), &view, &meshes, false);
            rig.check(&view, &meshes, &format!("{width}×{height}, {layers} layers, degree {degree}"));
        }
    }
}

#[test]
fn views_may_change_size() {
    let mut random = Random(2);
    let maps = atlas(&mut random, 1, 16);
    let meshes = [soup(&mut random, 60, 1), sphere(24, 12, Vec3::new(0.0, 0.0, 3.0), 1.5, maps)];
    let first = view(40, 30, DMat3::IDENTITY, 2, &meshes);
    let mut rig = Rig::new(Gpu::open(None).unwrap(), &first, &meshes, false);
    for (width, height) in [(90, 20), (17, 70), (40, 30)] {
        let view = view(width, height, DMat3::IDENTITY, 2, &meshes);
        rig.forward(&view);
        rig.check(&view, &meshes, &format!("resized to {width}×{height}"));
    }
}

/// 500 triangles that each cover the whole image of 24 tiles: more than the estimated 4 · 500 + 16 · 24 pairs.
#[test]
fn a_short_pair_list_grows() {
    let mut random = Random(3);
    let n = 500;
    let positions = (0..n).flat_map(|i| {
        let z = 1.0 + 0.01 * i as f32;
        [Vec3::new(-20.0, -20.0, z), Vec3::new(20.0, -20.0, z), Vec3::new(0.0, 40.0, z)]
    });
    let triangles = (0..n as u32).map(|i| [3 * i, 3 * i + 1, 3 * i + 2]).collect();
    let uvs = vec![[Vec2::ZERO, Vec2::X, Vec2::Y]; n];
    let meshes = [Mesh::new(positions.collect(), triangles, uvs, atlas(&mut random, 0, 16)).unwrap()];
    let view = view(96, 64, DMat3::IDENTITY, 4, &meshes);
    let mut rig = Rig::new(Gpu::open(None).unwrap(), &view, &meshes, false);
    let needed = rig.stage.pairs_needed(&rig.gpu).unwrap();
    let generations = |rig: &Rig| (rig.stage.generation(), rig.stage.layer_generation());
    let (all, layers) = generations(&rig);
    rig.stage.lengthen(&rig.gpu, &rig.uniform, needed).unwrap();
    assert_eq!(generations(&rig), (all + 1, layers), "layers stay");
    rig.forward(&view);
    assert_eq!(rig.stage.pairs_needed(&rig.gpu).unwrap(), needed);
    rig.stage.lengthen(&rig.gpu, &rig.uniform, needed).unwrap();
    assert_eq!(generations(&rig), (all + 1, layers), "it was long enough");
    rig.check(&view, &meshes, "after growing");
}

/// Thread numbers must not overflow to 0, however dispatches are folded into rows: otherwise one bin of a triangle
/// would be processed twice, and others never.
#[test]
fn threads_that_go_through_bins_can_be_numbered() {
    let (large, most_bins, row) = (1920 * 1080, 4096, 65_535 * 256);
    assert_eq!(binning_shares(1000, large, most_bins), 507);
    assert_eq!(binning_shares(0, large, most_bins), 507);
    assert_eq!(binning_shares(10, 1, most_bins), 1);
    for triangles in [8_000_000, 8_470_001, 20_000_000, 80_000_000, usize::MAX] {
        let shares = binning_shares(triangles, large, most_bins);
        assert!(shares >= 1);
        // Buffers cannot hold more triangles than this.
        if triangles <= 80_000_000 {
            let numbered = (triangles * shares).next_multiple_of(row);
            assert!(numbered <= 1 << 32, "{triangles} triangles, {shares} shares: {numbered} threads");
        }
    }
}

/// The same surface with separate vertices for each triangle.
fn split(mesh: &Mesh) -> Mesh {
    let positions = mesh.triangles().iter().flatten().map(|&v| mesh.positions()[v as usize]).collect();
    let triangles = (0..mesh.triangles().len() as u32).map(|i| [3 * i, 3 * i + 1, 3 * i + 2]).collect();
    Mesh::new(positions, triangles, mesh.corner_uvs().to_vec(), mesh.atlas().clone()).unwrap()
}

/// A closed surface has no cracks: every pixel inside its silhouette is covered, whatever the adapter's rounding, even
/// if triangles have copies of their vertices. There are more bins than are scanned at a time.
#[test]
fn a_dense_sphere_has_no_cracks() {
    let whole = sphere(200, 100, Vec3::new(0.0, 0.0, 2.0), 1.0, atlas(&mut Random(4), 0, 16));
    assert_no_cracks(&[split(&whole)]);
    assert_no_cracks(&[whole]);
}

fn assert_no_cracks(meshes: &[Mesh]) {
    const SIDE: u32 = 280;
    const { assert!(SIDE.div_ceil(BIN).pow(2) > 1024) };
    let view = view(SIDE, SIDE, DMat3::IDENTITY, 1, meshes);
    let rig = Rig::new(Gpu::open(None).unwrap(), &view, meshes, false);
    let (depths, _) = rig.layers(&view);
    let camera = &view.camera;
    let center = camera.to_camera(DVec3::new(0.0, 0.0, 2.0));
    for (i, &z) in (0_u32..).zip(&depths) {
        let r = camera.ray(DVec2::new(f64::from(i % SIDE) + 0.5, f64::from(i / SIDE) + 0.5)).normalize();
        let distance = (center - r * center.dot(r)).length();
        // Chords of the tessellation deviate from the radius by less than 0.1 %.
        if distance < 0.998 {
            let front = r.z * (center.dot(r) - (1.0 - distance * distance).sqrt());
            assert!((f64::from(z) - front).abs() < 0.05, "pixel {i}: {z} instead of {front}");
        } else if distance > 1.002 {
            assert_eq!(z, 0.0, "pixel {i}");
        }
    }
}

/// Without meshes nothing is dispatched and almost nothing is allocated.
#[test]
fn no_mesh_costs_nothing() {
    let view = view(64, 64, DMat3::IDENTITY, 4, &[]);
    let mut rig = Rig::new(Gpu::open(None).unwrap(), &view, &[], true);
    rig.stage.resize(&rig.gpu, &view, &rig.uniform).unwrap();
    assert_eq!(rig.stage.generation(), 0);
    let mut frame = Frame::new(&rig.gpu);
    rig.stage.record_forward(&mut frame);
    rig.stage.record_backward(&mut frame);
    rig.stage.record_adam(&mut frame);
    assert_eq!(frame.dispatches(), 0);
    frame.submit();
    assert!(rig.gpu.peak_bytes() < 20_000, "{} bytes", rig.gpu.peak_bytes());
}
