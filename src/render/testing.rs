//! Random scenes for the tests of the reference and of the GPU renderer, and differences of numbers.

use glam::{DMat3, DQuat, DVec3, Quat, Vec2, Vec3};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

use crate::scene::testing::{ahead, alike};
use crate::scene::{Atlas, Camera, Composition, HybridScene, Intrinsics, Mesh, OrderMode, Splats, Texture, sh};

/// Largest of at least one magnitude; NaN if one is NaN, which `f64::max` would ignore.
pub(crate) fn largest(magnitudes: impl IntoIterator<Item = f64>) -> f64 {
    magnitudes.into_iter().max_by(f64::total_cmp).unwrap()
}

/// A camera with different focal lengths and an off-centre principal point, rotated by up to 0.3 rad, and a function
/// from its camera space to world space.
fn random_camera(rng: &mut Pcg64Mcg, width: u32, height: u32) -> (Camera, impl Fn(DVec3) -> Vec3 + use<>) {
    let w = f64::from(width);
    let intrinsics = Intrinsics {
        width,
        height,
        fx: w * rng.random_range(0.8..1.2),
        fy: w * rng.random_range(0.8..1.2),
        cx: 0.5 * w + rng.random_range(-0.08..0.08) * w,
        cy: 0.5 * f64::from(height) + rng.random_range(-0.08..0.08) * w,
    };
    let turn = DVec3::from_array([0; 3].map(|_| rng.random_range(-0.3..0.3)));
    let rotation = DMat3::from_quat(DQuat::from_scaled_axis(turn));
    let translation = DVec3::from_array([0; 3].map(|_| rng.random_range(-1.0..1.0)));
    let camera = Camera::new(intrinsics, rotation, translation).unwrap();
    let (rotation, translation) = (camera.rotation(), camera.translation());
    (camera, move |p| (rotation.transpose() * (p - translation)).as_vec3())
}

/// A texture of values around `mean`: per-texel noise over a random gradient.
fn random_texture(
    rng: &mut Pcg64Mcg,
    size: [u32; 2],
    channels: u32,
    spread: f32,
    mean: impl Fn(u32) -> f32,
) -> Texture {
    let slope: Vec<[f32; 2]> = (0..channels).map(|_| [0; 2].map(|_| rng.random_range(-spread..spread))).collect();
    let mut texels = Vec::new();
    for y in 0..size[1] {
        for x in 0..size[0] {
            for c in 0..channels {
                let [sx, sy] = slope[c as usize];
                let smooth = sx * (x as f32 / size[0] as f32 - 0.5) + sy * (y as f32 / size[1] as f32 - 0.5);
                texels.push(mean(c) + smooth + rng.random_range(-spread..spread));
            }
        }
    }
    Texture::new(size[0], size[1], channels, texels).unwrap()
}

/// Photograph by a camera, RGBA8, with values 0 or 255, so that no difference changes sign near rendered values.
pub(crate) fn photograph(camera: &Camera) -> Vec<u8> {
    (0..camera.intrinsics().pixels())
        .flat_map(|p| [p, p / 3, p / 7].map(|v| if v % 5 < 2 { 255 } else { 0 }).into_iter().chain([255]))
        .collect()
}

/// A grid of `cells` quads with UVs over the whole atlas (and slightly beyond its border), mapped to world space by
/// `place`.
pub(crate) fn grid_mesh(cells: [u32; 2], atlas: Atlas, place: impl Fn(f64, f64) -> Vec3) -> Mesh {
    let uv = |x: u32, y: u32| Vec2::new(x as f32 / cells[0] as f32, y as f32 / cells[1] as f32);
    let corner = |x: u32, y: u32| y * (cells[0] + 1) + x;
    let mut positions = Vec::new();
    for y in 0..=cells[1] {
        for x in 0..=cells[0] {
            positions.push(place(f64::from(uv(x, y).x), f64::from(uv(x, y).y)));
        }
    }
    let (mut triangles, mut uvs) = (Vec::new(), Vec::new());
    for y in 0..cells[1] {
        for x in 0..cells[0] {
            for t in [[[0, 0], [1, 0], [1, 1]], [[0, 0], [1, 1], [0, 1]]] {
                triangles.push(t.map(|[dx, dy]| corner(x + dx, y + dy)));
                uvs.push(t.map(|[dx, dy]| 1.06 * uv(x + dx, y + dy) - 0.03));
            }
        }
    }
    Mesh::new(positions, triangles, uvs, atlas).unwrap()
}

fn random_atlas(rng: &mut Pcg64Mcg, sh_degree: u32, opacity_logit: f32) -> Atlas {
    let mut size = || [0; 2].map(|_| [32, 48, 64][rng.random_range(0..3)]);
    let (base_size, band_size) = (size(), size().map(|s| s / 2));
    let base = random_texture(rng, base_size, 4, 0.8, |c| if c == 3 { opacity_logit } else { 0.0 });
    let bands =
        (sh_degree > 0).then(|| random_texture(rng, band_size, sh::band_floats(sh_degree) as u32, 0.1, |_| 0.0));
    Atlas::new(base, bands).unwrap()
}

/// `n_splats` splats and `n_meshes` wavy sheets or spheres in front of a 96×72 camera, depths 2 to 7.
///
/// Splats are in front of, inside and behind the meshes, some outside the image, some nearly opaque; textures have
/// sides of 32 to 64 texels with mips, are minified by the more distant meshes, and are partly transparent.
pub(crate) fn random_scene(
    seed: u64,
    n_splats: usize,
    n_meshes: usize,
    sh_degree: u32,
    layers: u32,
    mode: OrderMode,
) -> (HybridScene, Camera) {
    let mut rng = Pcg64Mcg::seed_from_u64(seed);
    let (camera, to_world) = random_camera(&mut rng, 96, 72);

    let mut meshes = Vec::new();
    for _ in 0..n_meshes {
        let opacity_logit = rng.random_range(-1.5..2.5);
        let atlas = random_atlas(&mut rng, sh_degree, opacity_logit);
        let center = DVec3::new(rng.random_range(-1.0..1.0), rng.random_range(-0.8..0.8), rng.random_range(3.0..5.5));
        let axis = DVec3::from_array([0; 3].map(|_| rng.random_range(-0.7..0.7)));
        let turn = DQuat::from_scaled_axis(axis);
        meshes.push(if rng.random_bool(0.5) {
            let (size, waves, depth) =
                (rng.random_range(1.5..4.0), rng.random_range(3.0..9.0), rng.random_range(0.0..0.3));
            grid_mesh([14, 10], atlas, |u, v| {
                let z = depth * (waves * u + 1.0).sin() * (waves * v).cos();
                to_world(center + turn * DVec3::new((u - 0.5) * size, (v - 0.5) * size, z))
            })
        } else {
            let radius = rng.random_range(0.5..1.3);
            grid_mesh([16, 9], atlas, |u, v| {
                let (longitude, latitude) = (u * std::f64::consts::TAU, (v - 0.5) * 3.0);
                let ring = latitude.cos();
                let p = DVec3::new(ring * longitude.cos(), latitude.sin(), ring * longitude.sin());
                to_world(center + turn * (radius * p))
            })
        });
    }

    let k = sh::coefficients(sh_degree);
    let (mut means, mut rotations, mut log_scales, mut logits, mut sh) = (vec![], vec![], vec![], vec![], vec![]);
    for _ in 0..n_splats {
        let z = rng.random_range(2.0..7.0);
        let slope = [0; 2].map(|_| rng.random_range(-0.75..0.75));
        means.push(to_world(DVec3::new(slope[0] * z, 0.8 * slope[1] * z, z)));
        rotations.push(Quat::from_array([0; 4].map(|_| rng.random_range(-1.0..1.0_f32))));
        log_scales.push(Vec3::from_array([0; 3].map(|_| rng.random_range(-4.5..-1.6))));
        logits.push(rng.random_range(-3.0..4.0));
        sh.extend((0..k).map(|i| [0; 3].map(|_| if i == 0 { 1.5 } else { 0.2 } * rng.random_range(-1.0..1.0_f32))));
    }
    let splats = Splats::new(means, rotations, log_scales, logits, sh_degree, sh).unwrap();
    let composition = Composition {
        mode,
        lambda: if rng.random_bool(0.2) { f32::INFINITY } else { rng.random_range(0.02..0.6) },
        layers,
        background: [0; 3].map(|_| rng.random_range(0.0..1.0)),
        ..Composition::default()
    };
    (HybridScene { splats, meshes, composition }, camera)
}

/// A scene in which every parameter has a derivative and finite differences cross no threshold: 24×18 pixels, five
/// splats each so wide that its alpha is above the cut-off in every pixel and below the cap, colours away from 0, SH
/// degree 3, and `layers` sheets but at least two, the second minified so that it is sampled between mips 1 and 3.
pub(crate) fn smooth_scene(seed: u64, layers: u32, mode: OrderMode) -> (HybridScene, Camera) {
    let mut rng = Pcg64Mcg::seed_from_u64(seed);
    let (camera, to_world) = random_camera(&mut rng, 24, 18);
    let sheet = |rng: &mut Pcg64Mcg, z: f64, size: f64, tilt: f64, texels: u32| {
        let base = random_texture(rng, [texels, texels], 4, 0.3, |_| 0.2);
        let bands = random_texture(rng, [texels / 2, texels / 2], 45, 0.04, |_| 0.0);
        let atlas = Atlas::new(base, Some(bands)).unwrap();
        grid_mesh([3, 2], atlas, |u, v| {
            to_world(DVec3::new((u - 0.51) * size, (v - 0.47) * size, z + tilt * u + 0.1 * (7.0 * v).sin()))
        })
    };
    let mut meshes = vec![sheet(&mut rng, 3.1, 2.0, 0.4, 16), sheet(&mut rng, 4.2, 7.0, -0.3, 128)];
    let (mut means, mut rotations, mut log_scales, mut logits, mut sh) = (vec![], vec![], vec![], vec![], vec![]);
    for z in [2.0, 2.9, 3.6, 4.4, 5.0] {
        means.push(to_world(DVec3::new(rng.random_range(-0.3..0.3), rng.random_range(-0.2..0.2), z)));
        rotations.push(Quat::from_array([0; 4].map(|_| rng.random_range(-1.0..1.0_f32))));
        log_scales.push(Vec3::from_array([0; 3].map(|_| (0.35 * z as f32).ln() + rng.random_range(-0.2..0.2))));
        logits.push(rng.random_range(-1.0..0.5));
        sh.extend((0..16).map(|i| [0; 3].map(|_| if i == 0 { 0.8 } else { 0.08 } * rng.random_range(-0.5..1.0_f32))));
    }
    for (z, size, tilt, texels) in
        [(2.4, 1.8, 0.2, 32), (5.6, 6.0, 0.3, 64)].into_iter().take(layers.max(2) as usize - 2)
    {
        meshes.push(sheet(&mut rng, z, size, tilt, texels));
    }
    let splats = Splats::new(means, rotations, log_scales, logits, 3, sh).unwrap();
    let composition = Composition { mode, lambda: 0.3, layers, background: [0.3, 0.5, 0.2], ..Composition::default() };
    (HybridScene { splats, meshes, composition }, camera)
}

/// The same splats, except that the alpha of splat `which` is capped around its centre, where its shape and opacity
/// have no derivative.
pub(crate) fn nearly_opaque(splats: &Splats, which: usize) -> Splats {
    let mut logits = splats.opacity_logits().to_vec();
    logits[which] = 8.0;
    let (means, rotations) = (splats.means().to_vec(), splats.rotations().to_vec());
    Splats::new(means, rotations, splats.log_scales().to_vec(), logits, splats.sh_degree(), splats.sh().to_vec())
        .unwrap()
}

/// A tilted sheet that is pierced by a splat: the paper's figure. At its own projection the mean is just behind the
/// sheet. On the ray of a neighbouring pixel the sheet is farther than the mean. Also returns the two pixels.
pub(crate) fn two_rays(mode: OrderMode) -> (HybridScene, Camera, [usize; 2]) {
    let red = [2.0, -2.0, -2.0];
    let splats = alike(vec![Vec3::new(0.0, 0.0, 3.02)], 0.3_f32.ln(), (0.9_f32 / 0.1).ln(), red);
    // The opaque sheet z = 3 + x/2.
    let corner = |x: f32, y: f32| Vec3::new(x, y, 3.0 + 0.5 * x);
    let mut base = Texture::zeros(1, 1, 4).texels().to_vec();
    base[3] = 100.0;
    let atlas = Atlas::new(Texture::new(1, 1, 4, base).unwrap(), None).unwrap();
    let positions = vec![corner(-2.0, -2.0), corner(2.0, -2.0), corner(2.0, 2.0), corner(-2.0, 2.0)];
    let mesh = Mesh::new(positions, vec![[0, 1, 2], [0, 2, 3]], vec![[Vec2::ZERO; 3]; 2], atlas).unwrap();
    let composition = Composition { mode, lambda: 0.5, ..Composition::default() };
    let camera = ahead([33, 33], 33.0, DVec3::ZERO);
    (HybridScene { splats, meshes: vec![mesh], composition }, camera, [14, 18].map(|x| 16 * 33 + x))
}
