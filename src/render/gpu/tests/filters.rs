//! Splats of all widths: pixel filters, smoothing, and needles, in images and gradients.

use std::f64::consts::PI;

use glam::{DMat3, DVec3, Quat, Vec3};

use super::{
    MEAN, MOST, NEEDLE_GRADIENT, check_gradients, class_errors, compare, gpu_frame, random_cotangent, special_frame,
};
use crate::{
    render::{
        gpu::device::Gpu,
        reference::{self, Parameters},
        testing,
    },
    scene::{Camera, Composition, HybridScene, Intrinsics, OrderMode, PixelFilter, SplatArrays, sh},
};

/// Needles of up to about a thousand pixels of which a large picture shows a small part, far from their centres.
#[test]
fn needles_are_those_of_the_reference_far_from_their_centres() {
    let gpu = Gpu::open(None).unwrap();
    let intrinsics = Intrinsics { width: 64, height: 48, fx: 2000.0, fy: 2000.0, cx: 1500.3, cy: 1100.6 };
    let camera = Camera::new(intrinsics, DMat3::IDENTITY, DVec3::ZERO).unwrap();
    let depth = 2.0;
    // Point on the ray through the picture's middle at this depth.
    let middle =
        depth * DVec3::new((32.0 - intrinsics.cx) / intrinsics.fx, (24.0 - intrinsics.cy) / intrinsics.fy, 1.0);
    for deviation in [300.0, 1000.0, 2000.0] {
        let mut splats = SplatArrays::default();
        for i in 0..12 {
            let turn = 0.13 + f64::from(i) * PI / 12.0;
            let across = f64::from(i % 5 - 2) * 4.0 / intrinsics.fx * depth;
            let along = [-2.0, -1.0, 1.0, 1.7][i as usize % 4] * deviation / intrinsics.fx * depth;
            let axes = DMat3::from_rotation_z(turn);
            splats.means.push((middle + axes * DVec3::new(along, across, 1e-5 * f64::from(i))).as_vec3());
            splats.rotations.push(Quat::from_rotation_z(turn as f32));
            let long = deviation / intrinsics.fx * depth;
            splats.log_scales.push(Vec3::new(long.ln() as f32, -9.0, -9.0));
            splats.opacity_logits.push(1.0);
            splats.sh.push([0.2 * i as f32, 1.0, -0.1 * i as f32]);
        }
        let splats = splats.check().unwrap();
        let scene = HybridScene { splats, meshes: vec![], composition: Composition::default() };
        let cotangent = random_cotangent(&camera, 3);
        let (found, gradient) = gpu_frame(&gpu, &scene, &camera, Some(&cotangent));
        let (mean, most, _) = compare(&found, &scene, &camera);
        let errors = class_errors(&gradient.unwrap(), &reference::backward(&scene, &camera, &cotangent));
        eprintln!("{deviation} px: mean {mean:.1e}, max {most:.1e}, {errors:?}");
        assert!(mean < MEAN && most < MOST, "{deviation} px: mean {mean:e}, max {most:e}");
        assert!(errors.iter().all(|(_, error)| *error < NEEDLE_GRADIENT), "{deviation} px: {errors:?}");
    }
}

/// Filters about as wide as the splats, and as narrow as in training.
#[test]
fn filters_equal_the_reference() {
    let gpu = Gpu::open(None).unwrap();
    for (variance, deviation) in [(20.0, 0.0), (0.1, 0.2), (20.0, 0.2), (0.1, 0.01)] {
        let (mut scene, camera) = testing::smooth_scene(3, 2, OrderMode::Stable);
        scene.composition.pixel_filter = PixelFilter { variance, normalized: true };
        let mut parameters = Parameters::of(&scene);
        let deviations: Vec<f64> =
            parameters.means.iter().map(|&mean| f64::from((deviation * camera.to_camera(mean).z) as f32)).collect();
        parameters.smoothing.clone_from(&deviations);
        let cotangent = random_cotangent(&camera, 3);
        let expected = reference::backward_parameters(&scene, &camera, &parameters, &cotangent, None).0;
        let cotangents = Some((&cotangent, None));
        let (image, found, _) = special_frame(&gpu, &scene, &camera, sh::MAX_DEGREE, &deviations, cotangents);
        let reference = reference::render_parameters(&scene, &camera, &parameters);
        let pairs = image.rgb.iter().flatten().zip(reference.rgb.iter().flatten());
        let most = testing::largest(pairs.map(|(a, b)| (a - b).abs()));
        eprintln!("{variance} px², {deviation}: image {most:.1e}");
        // A few wide splats: only rounding differs.
        assert!(most < 1e-5, "{variance} px², {deviation}: {most:e}");
        check_gradients(&found.unwrap(), &expected, &format!("{variance} px², {deviation}"));
    }
    // Needles of hundreds of pixels along no axis of the picture: their gradients suffer from cancellation.
    for long in [2.0, 4.0, 5.0] {
        let (mut scene, camera) = testing::smooth_scene(3, 2, OrderMode::Stable);
        scene.composition.pixel_filter = PixelFilter::MIP;
        let s = scene.splats.into_arrays();
        let log_scales = s.log_scales.iter().map(|l| Vec3::new(l.x + long, l.y - 1.0, l.z - 1.0)).collect();
        scene.splats = SplatArrays { log_scales, ..s }.check().unwrap();
        let cotangent = random_cotangent(&camera, 3);
        let expected = reference::backward(&scene, &camera, &cotangent);
        let found = gpu_frame(&gpu, &scene, &camera, Some(&cotangent)).1.unwrap();
        let errors = class_errors(&found, &expected);
        eprintln!("needles e^{long} times as long: {errors:?}");
        assert!(errors.iter().all(|(_, error)| *error < NEEDLE_GRADIENT), "e^{long}: {errors:?}");
    }
    // Splats from far below a pixel to many pixels, and needles, some with a deviation of about a thousand pixels.
    for seed in 0..8 {
        let (mut scene, camera) = testing::random_scene(seed, 800, 1, 1, 2, OrderMode::Stable);
        let s = scene.splats.into_arrays();
        let log_scales = s.log_scales.iter().enumerate().map(|(i, l)| match i % 40 {
            0 => Vec3::new(l.x, 4.5, l.z - 4.0),
            _ => *l - [0.0, 2.0, 4.0][i % 3] * Vec3::new(1.0, 1.0, (i % 2) as f32),
        });
        scene.splats = SplatArrays { log_scales: log_scales.collect(), ..s }.check().unwrap();
        scene.composition.pixel_filter = [PixelFilter::MIP, PixelFilter::DILATION][seed as usize % 2];
        let (mean, most, _) = compare(&gpu_frame(&gpu, &scene, &camera, None).0, &scene, &camera);
        eprintln!("scene {seed}: mean {mean:.1e}, max {most:.1e}");
        assert!(mean < MEAN && most < MOST, "scene {seed}: mean {mean:e}, max {most:e}");
    }
}
