//! The GPU pipeline against the f64 reference: images, gradients, limits.

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;

use super::{
    device::{Frame, Gpu},
    pipeline::Pipeline,
};
use crate::{
    render::{
        reference::{self, Image, Margin, Parameters},
        testing,
    },
    scene::{Camera, HybridScene, OrderMode, sh},
};

/// Renders on the GPU; with a cotangent also returns the gradients of every splat parameter.
fn gpu_frame(
    gpu: &Gpu,
    scene: &HybridScene,
    camera: &Camera,
    cotangent: Option<&Image>,
) -> (Image, Option<Parameters>) {
    let k = *camera.intrinsics();
    let mut pipeline = Pipeline::new(gpu, scene, 0, &[*camera], cotangent.is_some()).unwrap();
    let n = scene.splats.len();
    let terms = sh::coefficients(scene.splats.sh_degree());
    loop {
        let view = pipeline.prepare(gpu, camera).unwrap();
        if let (Some(c), Some(b)) = (cotangent, &pipeline.backward) {
            let words: Vec<f32> = c.rgb.iter().flat_map(|g| [g[0], g[1], g[2], 0.0].map(|v| v as f32)).collect();
            gpu.write(&b.image_gradient, 0, &words);
        }
        let mut frame = Frame::new(gpu);
        pipeline.record_forward(gpu, &mut frame, &view);
        pipeline.record_backward(&mut frame, &view);
        frame.submit();
        if !pipeline.grow_if_short(gpu).unwrap() {
            break;
        }
    }
    let pixels = (k.width * k.height) as usize;
    let words: Vec<f32> = gpu.read(&pipeline.blend.image, pixels * 4).unwrap();
    let rendered = Image {
        width: k.width as usize,
        height: k.height as usize,
        rgb: words.chunks_exact(4).map(|p| [p[0], p[1], p[2]].map(f64::from)).collect(),
        transmittance: words.chunks_exact(4).map(|p| f64::from(p[3])).collect(),
    };
    let gradients = pipeline.backward.as_ref().map(|b| {
        let mut out = Parameters::of(scene).zeros_like();
        let geometry: Vec<f32> = gpu.read(&b.geometry_gradient, n * 12).unwrap();
        for (i, g) in geometry.chunks_exact(12).enumerate() {
            let g: Vec<f64> = g.iter().copied().map(f64::from).collect();
            out.means[i] = glam::DVec3::new(g[0], g[1], g[2]);
            out.opacity_logits[i] = g[3];
            out.rotations[i] = [g[4], g[5], g[6], g[7]];
            out.log_scales[i] = glam::DVec3::new(g[8], g[9], g[10]);
        }
        let sh: Vec<f32> = gpu.read(&b.sh_gradient, n * 3 * terms).unwrap();
        for (i, c) in sh.chunks_exact(3).enumerate() {
            out.sh[i] = glam::DVec3::new(f64::from(c[0]), f64::from(c[1]), f64::from(c[2]));
        }
        out
    });
    (rendered, gradients)
}

/// f32 depths, alphas and barycentrics resolve decisions down to about this.
const TOLERANCE: Margin = Margin { alpha: 1e-4, order: 1e-5, edge: 1e-4, stop: 1e-3 };

/// Mean and largest difference over pixels that no decision is close in, and the number of the others.
fn compare(found: &Image, scene: &HybridScene, camera: &Camera) -> (f64, f64, usize) {
    let (expected, margins) = reference::render_with_margins(scene, camera);
    let (mut sum, mut most, mut excused) = (0.0, 0.0_f64, 0);
    for (i, margin) in margins.iter().enumerate() {
        if margin.is_within(&TOLERANCE) {
            excused += 1;
            continue;
        }
        for c in 0..3 {
            let difference = (found.rgb[i][c] - expected.rgb[i][c]).abs();
            assert!(difference.is_finite());
            sum += difference;
            most = most.max(difference);
        }
    }
    (sum / (3 * (margins.len() - excused).max(1)) as f64, most, excused)
}

const MODES: [OrderMode; 3] = [OrderMode::Stable, OrderMode::SurfaceConsistent, OrderMode::Direct];

#[test]
fn images_equal_the_reference() {
    let gpu = Gpu::open(None).unwrap();
    for seed in 0..6 {
        let n = [0, 1, 17, 300, 1500, 5000][seed as usize];
        let (scene, camera) = testing::random_scene(seed, n, 0, (seed % 4) as u32, 1, MODES[seed as usize % 3]);
        let (found, _) = gpu_frame(&gpu, &scene, &camera, None);
        let (mean, most, excused) = compare(&found, &scene, &camera);
        eprintln!(
            "scene {seed}: {n} splats: mean {mean:.2e}, max {most:.2e}, {excused} threshold pixels of {}",
            found.rgb.len()
        );
        assert!(mean < 1e-4 && most < 2e-3, "scene {seed}: mean {mean:e}, max {most:e}");
    }
}

/// Relative error of a whole class: ‖found − expected‖ / ‖expected‖.
fn relative(found: impl Iterator<Item = f64>, expected: impl Iterator<Item = f64>) -> f64 {
    let (mut difference, mut norm) = (0.0, 0.0);
    for (f, e) in found.zip(expected) {
        difference += (f - e) * (f - e);
        norm += e * e;
    }
    (difference / norm.max(1e-30)).sqrt()
}

#[test]
fn gradients_equal_the_reference() {
    let gpu = Gpu::open(None).unwrap();
    for seed in 0..3 {
        let (scene, camera) = testing::smooth_scene(seed, 1, MODES[seed as usize]);
        let scene = HybridScene { meshes: vec![], ..scene };
        let k = camera.intrinsics();
        let pixels = (k.width * k.height) as usize;
        let mut rng = Pcg32::seed_from_u64(seed);
        let cotangent = Image {
            width: k.width as usize,
            height: k.height as usize,
            rgb: (0..pixels).map(|_| [0; 3].map(|_| rng.random_range(-1.0..1.0))).collect(),
            transmittance: vec![0.0; pixels],
        };
        let expected = reference::backward(&scene, &camera, &cotangent);
        let (_, found) = gpu_frame(&gpu, &scene, &camera, Some(&cotangent));
        let found = found.unwrap();
        let classes = [
            ("means", relative(flat(&found.means), flat(&expected.means))),
            ("log_scales", relative(flat(&found.log_scales), flat(&expected.log_scales))),
            (
                "rotations",
                relative(found.rotations.iter().flatten().copied(), expected.rotations.iter().flatten().copied()),
            ),
            ("opacity", relative(found.opacity_logits.iter().copied(), expected.opacity_logits.iter().copied())),
            ("sh", relative(flat(&found.sh), flat(&expected.sh))),
        ];
        eprintln!("{seed}: {classes:?}");
        for (name, error) in classes {
            assert!(error < 1e-3, "seed {seed}, {name}: relative error {error:e}");
        }
    }
}

fn flat(v: &[glam::DVec3]) -> impl Iterator<Item = f64> + '_ {
    v.iter().flat_map(|v| v.to_array())
}
