//! Disparity weighting with exposures: whether a pixel matches its photograph is decided after exposure.

use super::{
    Gpu,
    adam::AdamStep,
    exposure::{ExposureState, ExposureStep, FLOATS},
    geometry::GEOMETRY_FLOATS,
    training::{Show, Step, Training},
};
use crate::{
    render::{
        reference::{self, Image, Parameters},
        testing,
    },
    scene::{Camera, HybridScene, OrderMode, sh},
};

const WEIGHT: f32 = 10.0;
/// Exposure of the training view, by rows; it mixes channels.
const EXPOSURE: [f32; FLOATS] = [0.8, 0.05, -0.02, 0.03, 0.04, 0.9, 0.02, 0.02, -0.03, 0.06, 0.7, 0.05];

/// First moments of splat geometry and of exposures after the first step, which are a tenth of the gradients.
fn first_moments(training: &mut Training, camera: &Camera, truth: &[u8], disparity_weight: f32) -> [Vec<f32>; 2] {
    let (n_splats, sh_degree) = (training.n_splats() as u32, sh::MAX_DEGREE);
    let step = Step {
        sh_degree,
        band_degree: sh::MAX_DEGREE,
        disparity_weight,
        splats: Some(AdamStep { number: 1, n_splats, sh_degree, ..AdamStep::default() }),
        exposure: Some(ExposureStep { view: 1, rate: 1e-3 }),
        ..Step::still(camera, truth)
    };
    training.step(&step).unwrap();
    assert_eq!(training.status().unwrap().skipped, 0);
    let [of_exposures, _] = training.read_exposures().unwrap().unwrap().moments;
    [training.read_splats().unwrap().geometry_m, of_exposures]
}

/// Gradients of splat geometry by the reference, `[N·11]`, for a loss that grows by `slopes` with the disparity of each
/// pixel.
fn by_disparity(scene: &HybridScene, camera: &Camera, slopes: &[f64]) -> Vec<f64> {
    let k = camera.intrinsics();
    let nothing = Image {
        width: k.width as usize,
        height: k.height as usize,
        rgb: vec![[0.0; 3]; slopes.len()],
        transmittance: vec![0.0; slopes.len()],
    };
    let of = reference::backward_parameters(scene, camera, &Parameters::of(scene), &nothing, Some(slopes)).0;
    let row = |i: usize| {
        let (mean, log_scale) = (of.means[i].to_array(), of.log_scales[i].to_array());
        [&mean[..], &[of.opacity_logits[i]], &of.rotations[i], &log_scale].concat()
    };
    (0..scene.splats.len()).flat_map(row).collect()
}

#[test]
fn nearness_counts_as_far_as_the_exposed_picture_is_the_photograph() {
    for gpu in [Gpu::open(None).unwrap(), Gpu::open(None).unwrap().posing_as_gpu()] {
        let (mut scene, camera) = testing::smooth_scene(1, 2, OrderMode::Stable);
        scene.composition.background = [0.0; 3];
        let mut state = ExposureState::new(3);
        state.values[FLOATS..2 * FLOATS].copy_from_slice(&EXPOSURE);
        let new = || Training::new(&gpu, &scene, &[camera], 0.2).unwrap();
        let picture = new().render(&camera, [0.0; 3], Show::All).unwrap().rgb;
        // The photograph differs by 2/255, in either direction.
        let off = |i: usize, value: f32| {
            let byte = (255.0 * value).round() as u8;
            if i.is_multiple_of(3) { byte.saturating_sub(2) } else { byte.saturating_add(2) }
        };
        let of_pixel = |(i, rgb): (usize, &[f32; 3])| {
            let [r, g, b] = state.apply(1, *rgb);
            [off(i, r), off(i + 1, g), off(i, b), 255]
        };
        let truth: Vec<u8> = picture.iter().enumerate().flat_map(of_pixel).collect();
        let learnt = |disparity_weight: f32| {
            let mut training = new();
            training.expose(&state).unwrap();
            first_moments(&mut training, &camera, &truth, disparity_weight)
        };
        let ([with, of_exposures], [without, expected]) = (learnt(WEIGHT), learnt(0.0));
        assert!(of_exposures == expected, "how near things are says nothing of exposures");

        let e = state.of(1).map(f64::from);
        let slope = |(rgb, truth): (&[f32; 3], &[u8])| {
            let [r, g, b] = rgb.map(f64::from);
            let exposed = [0, 4, 8].map(|row| e[row] * r + e[row + 1] * g + e[row + 2] * b + e[row + 3]);
            let amiss = testing::largest((0..3).map(|c| (exposed[c] - f64::from(truth[c]) / 255.0).abs()));
            f64::from(WEIGHT) / picture.len() as f64 * (-amiss / 0.02).exp()
        };
        let slopes: Vec<f64> = picture.iter().zip(truth.chunks_exact(4)).map(slope).collect();
        let most = testing::largest(slopes.iter().copied()) * picture.len() as f64 / f64::from(WEIGHT);
        assert!((0.6..0.8).contains(&most), "no pixel is 2/255 off: {most}");
        let expected = by_disparity(&scene, &camera, &slopes);
        let rows = |moments: &[f32]| {
            moments.chunks_exact(GEOMETRY_FLOATS).flat_map(|row| row[..11].to_vec()).collect::<Vec<_>>()
        };
        let pairs = rows(&with).into_iter().zip(rows(&without)).zip(&expected);
        let error = testing::largest(pairs.map(|((a, b), expected)| (10.0 * f64::from(a - b) - expected).abs()));
        let largest = testing::largest(expected.iter().map(|g| g.abs()));
        eprintln!("{}: {error:.1e} of {largest:.1e}", gpu.adapter());
        // Differences between two f32 sums.
        assert!(largest > 0.0 && error < 1e-4 * largest, "{error:e} of {largest:e}");
    }
}
