//! Synthetic scenes for `stages`.

use std::f32::consts::TAU;

use centaur::scene::{Atlas, Camera, Composition, HybridScene, Intrinsics, Mesh, Splats, Texture, sh};
use glam::{DMat3, DVec3, Quat, Vec2, Vec3};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;

const SH_DEGREE: u32 = 3;
const SH_TERMS: usize = 16;

/// Image width over focal length.
const FIELD: f64 = 1.2;

/// A mesh of 2·`cells`² triangles, with a base map of `side`² texels and SH bands of degree 2 at a quarter of its side.
#[derive(Clone, Copy)]
pub(crate) struct Sheet {
    pub(crate) cells: usize,
    pub(crate) side: u32,
}

/// SH degree of the band maps.
const BAND_DEGREE: u32 = 2;

impl Sheet {
    /// Number of floats in both maps.
    pub(crate) fn map_floats(self) -> usize {
        let texels = |side: u32| side as usize * side as usize;
        4 * texels(self.side) + sh::band_floats(BAND_DEGREE) * texels(self.side / 4)
    }
}

/// Camera of every scene: at the origin, looking along z.
pub(crate) fn camera(width: u32, height: u32) -> Camera {
    let (w, h) = (f64::from(width), f64::from(height));
    let focal = w / FIELD;
    let intrinsics = Intrinsics { width, height, fx: focal, fy: focal, cx: 0.5 * w, cy: 0.5 * h };
    Camera::new(intrinsics, DMat3::IDENTITY, DVec3::ZERO).expect("finite, a rotation")
}

/// `n` splats of degree 3 that fill slightly more than the view of `camera`, between depths 2 and 10. They are
/// ellipsoids whose size in *pixels* of that camera is log-normal and does not depend on depth, so that a splat covers
/// the same number of tiles in every scene, about five on average. Opacities are log-uniform in 0.01 to 0.3: with
/// hundreds of thousands of splats, pixels become opaque before the end of their lists, as they do in captures.
pub(crate) fn scene(n: usize, camera: &Camera, sheet: Option<Sheet>) -> HybridScene {
    let mut rng = Pcg32::seed_from_u64(20);
    let k = camera.intrinsics();
    let (fx, fy) = (k.fx as f32, k.fy as f32);
    let half = Vec2::new(k.width as f32 / fx, k.height as f32 / fy) * 0.53;
    // The sum of four uniform values has variance 4/3: close enough to a normal distribution.
    let mut normal = |deviation: f32| -> f32 {
        (0..4).map(|_| rng.random_range(-1.0..1.0f32)).sum::<f32>() * (0.75f32).sqrt() * deviation
    };
    let shapes: Vec<(Quat, Vec3)> = (0..n)
        .map(|_| {
            let rotation = Quat::from_xyzw(normal(1.0), normal(1.0), normal(1.0), normal(1.0) + 1e-3);
            let size = 4.2f32.ln() + normal(0.4);
            (rotation, Vec3::new(size + normal(0.4), size + normal(0.4), size + normal(0.4)))
        })
        .collect();
    let means: Vec<Vec3> = (0..n)
        .map(|_| {
            let z = rng.random_range(2.0..10.0);
            Vec3::new(rng.random_range(-half.x..half.x) * z, rng.random_range(-half.y..half.y) * z, z)
        })
        .collect();
    let log_scales = shapes.iter().zip(&means).map(|((_, s), m)| *s + (m.z / fx).ln()).collect();
    let logits = (0..n).map(|_| logit(rng.random_range(0.01f32.ln()..0.3f32.ln()).exp())).collect();
    let sh = (0..n * SH_TERMS).map(|_| [0; 3].map(|_| rng.random_range(-0.2..0.2))).collect();
    let rotations = shapes.into_iter().map(|s| s.0).collect();
    let splats = Splats::new(means, rotations, log_scales, logits, SH_DEGREE, sh).expect("finite, of one length");
    let meshes = sheet.map(|s| mesh(s, half)).into_iter().collect();
    HybridScene { splats, meshes, composition: Composition::default() }
}

fn logit(p: f32) -> f32 {
    (p / (1.0 - p)).ln()
}

/// A wavy sheet among the splats that covers about four fifths of the view, with opacity one half.
fn mesh(Sheet { cells, side }: Sheet, half: Vec2) -> Mesh {
    let along = |i: usize| i as f32 / cells as f32;
    let vertices = cells + 1;
    let positions = (0..vertices * vertices)
        .map(|i| {
            let (u, v) = (along(i % vertices), along(i / vertices));
            let z = 5.0 + 0.4 * (2.0 * TAU * u).sin() + 0.3 * (1.5 * TAU * v).cos();
            let at = (Vec2::new(u, v) - 0.5) * 2.0 * 0.85 * half * 5.0;
            Vec3::new(at.x, at.y, z)
        })
        .collect();
    let (mut triangles, mut corner_uvs) = (vec![], vec![]);
    for cell in 0..cells * cells {
        let corner = (cell / cells * vertices + cell % cells) as u32;
        let (below, v) = (corner + vertices as u32, vertices as u32);
        for t in [[corner, corner + 1, below], [corner + 1, below + 1, below]] {
            triangles.push(t);
            corner_uvs.push(t.map(|i| Vec2::new(along((i % v) as usize), along((i / v) as usize))));
        }
    }
    let mut rng = Pcg32::seed_from_u64(21);
    let mut texture = |side: u32, channels: usize| {
        let texels = (0..side as usize * side as usize * channels)
            // The fourth channel of the base map is the opacity logit.
            .map(|i| if channels == 4 && i % 4 == 3 { 0.0 } else { rng.random_range(-0.5..0.5) })
            .collect();
        Texture::new(side, side, channels as u32, texels).expect("finite, of the right length")
    };
    let (base, bands) = (texture(side, 4), texture(side / 4, sh::band_floats(BAND_DEGREE)));
    let atlas = Atlas::new(base, Some(bands)).expect("channels of degree 2");
    Mesh::new(positions, triangles, corner_uvs, atlas).expect("indices in range")
}
