//! Exposures against finite differences of the loss's definition, and what their steps do.

use glam::{DMat3, DVec3, Quat, Vec3};

use super::{
    Gpu,
    adam::{AdamStep, SplatRates},
    exposure::{ExposureState, ExposureStep, FLOATS},
    loss::{LossValues, TruthAlpha, tests::defined},
    training::{Show, Step, Training},
    view::Dropout,
};
use crate::{
    render::testing,
    scene::{Camera, Composition, HybridScene, Intrinsics, Splats},
};

/// No multiple of a workgroup's pixels.
const SIZE: [u32; 2] = [70, 61];
const SPLATS: usize = 6;
const BACKGROUND: [f32; 3] = [0.1, 0.2, 0.3];
const RATES: SplatRates =
    SplatRates { mean: 0.0, opacity: 0.0, rotation: 0.0, log_scale: 0.0, sh_dc: 0.0, sh_rest: 0.0 };

fn camera() -> Camera {
    let [width, height] = SIZE;
    let k = Intrinsics { width, height, fx: 60.0, fy: 60.0, cx: 35.0, cy: 30.0 };
    Camera::new(k, DMat3::IDENTITY, DVec3::new(0.0, 0.0, 3.0)).unwrap()
}

/// Coloured splats that overlap; `shift` is added to one SH coefficient of one of them.
fn scene((splat, channel): (usize, usize), shift: f32) -> HybridScene {
    let mut sh: Vec<[f32; 3]> = (0..SPLATS).map(|i| [0.3 * (i as f32).sin(), 0.2, 0.25 * (i as f32).cos()]).collect();
    sh[splat][channel] += shift;
    let splats = Splats::new(
        (0..SPLATS).map(|i| Vec3::new(0.3 * i as f32 - 0.8, 0.2 * (i % 3) as f32 - 0.2, 0.1 * i as f32)).collect(),
        vec![Quat::IDENTITY; SPLATS],
        vec![Vec3::splat(-1.2); SPLATS],
        vec![0.8; SPLATS],
        0,
        sh,
    );
    HybridScene { splats: splats.unwrap(), meshes: vec![], composition: Composition::default() }
}

/// 0 or 255, so that no difference changes its sign near the pictures here.
fn truth() -> Vec<u8> {
    let pixels = SIZE[0] * SIZE[1];
    (0..pixels)
        .flat_map(|p| [p, p / 3, p / 7].map(|v| if v % 5 < 2 { 255 } else { 0 }).into_iter().chain([255]))
        .collect()
}

/// Of three views; the middle one mixes channels.
fn exposures() -> ExposureState {
    let mut state = ExposureState::new(3);
    let mixed = [0.8, 0.05, -0.02, 0.03, 0.04, 0.9, 0.02, 0.02, -0.03, 0.06, 0.7, 0.05];
    state.values[FLOATS..2 * FLOATS].copy_from_slice(&mixed);
    state
}

fn training<'g>(gpu: &'g Gpu, scene: &HybridScene, ssim_weight: f32) -> Training<'g> {
    Training::new(gpu, scene, &[camera()], ssim_weight).unwrap()
}

fn step(training: &mut Training, truth: &[u8], exposure: Option<ExposureStep>) {
    step_on(training, (truth, TruthAlpha::Ignore), exposure);
}

fn step_on(training: &mut Training, (truth, truth_alpha): (&[u8], TruthAlpha), exposure: Option<ExposureStep>) {
    let splats = AdamStep {
        number: 1,
        n_splats: SPLATS as u32,
        sh_degree: 0,
        rates: RATES,
        opacity_weight: 0.0,
        scale_weight: 0.0,
        noise: 0.0,
        seed: 0,
        visible_only: false,
    };
    training
        .step(&Step {
            camera: &camera(),
            truth,
            kept_as: None,
            truth_alpha,
            background: BACKGROUND,
            sh_degree: 0,
            band_degree: 0,
            dropout: Dropout::default(),
            disparity_weight: 0.1,
            splats: Some(splats),
            texels: None,
            vertices: None,
            exposure,
            pose: None,
        })
        .unwrap();
}

/// Of an exposed picture and the truth, which is over the background as it is exposed.
fn values(state: &ExposureState, picture: &[[f32; 3]], truth: &[u8]) -> LossValues {
    let e: Vec<f64> = state.of(1).map(f64::from).to_vec();
    let exposed = |rgb: &[f32; 3], c: usize| {
        let [r, g, b] = rgb.map(f64::from);
        e[4 * c] * r + e[4 * c + 1] * g + e[4 * c + 2] * b + e[4 * c + 3]
    };
    let channels = [0, 1, 2].map(|c| {
        let true_values = truth.chunks(4).map(|rgba| {
            let alpha = f64::from(rgba[3]) / 255.0;
            alpha * f64::from(rgba[c]) / 255.0 + (1.0 - alpha) * exposed(&BACKGROUND, c)
        });
        (picture.iter().map(|rgb| exposed(rgb, c)).collect::<Vec<_>>(), true_values.collect::<Vec<_>>())
    });
    defined(SIZE.map(|side| side as usize), channels.each_ref().map(|(x, y)| [&x[..], &y[..]]))
}

fn loss(values: LossValues, ssim_weight: f32) -> f64 {
    let w = f64::from(ssim_weight);
    (1.0 - w) * values.l1 + w * (1.0 - values.ssim)
}

/// With SSIM, too, whose windows are of what is exposed.
#[test]
fn gradients_are_those_of_the_exposed_picture() {
    assert_gradients(0.0, &truth());
    assert_gradients(0.2, &truth());
}

/// What is behind a photograph with alpha is exposed with it. Of alphas by which no difference changes its sign near the pictures here.
#[test]
fn gradients_are_those_of_a_photograph_over_the_exposed_background() {
    let is_there = |p: usize| if p.is_multiple_of(3) { 0 } else { 230 };
    let cut_out: Vec<u8> = truth().chunks(4).enumerate().flat_map(|(p, c)| [c[0], c[1], c[2], is_there(p)]).collect();
    assert_gradients(0.0, &cut_out);
}

/// Compares the gradients of a step with central differences of the definition.
fn assert_gradients(ssim_weight: f32, truth: &[u8]) {
    let (gpu, state) = (Gpu::open(None).unwrap(), exposures());
    let mut trained = training(&gpu, &scene((0, 0), 0.0), ssim_weight);
    let picture = trained.render(&camera(), BACKGROUND, Show::All).unwrap().rgb;
    trained.expose(&state).unwrap();
    step_on(&mut trained, (truth, TruthAlpha::Composite), Some(ExposureStep { view: 1, rate: 1e-2 }));
    let (found, expected) = (trained.loss().unwrap(), values(&state, &picture, truth));
    assert!(
        (found.l1 - expected.l1).abs() < 1e-6 && (found.ssim - expected.ssim).abs() < 1e-5,
        "{found:?} {expected:?}"
    );

    // Adam's first moment of the first step is a tenth of the gradient.
    let after = trained.read_exposures().unwrap().unwrap();
    let largest = testing::largest(after.moments[0].iter().map(|m| f64::from(10.0 * m.abs())));
    assert!(largest > 0.01, "{largest}");
    for i in 0..FLOATS {
        let at = |h: f32| {
            let mut moved = state.clone();
            moved.values[FLOATS + i] += h;
            (loss(values(&moved, &picture, truth), ssim_weight), f64::from(moved.values[FLOATS + i]))
        };
        let ((a, to_a), (b, to_b)) = (at(1e-4), at(-1e-4));
        let (numeric, found) = ((a - b) / (to_a - to_b), f64::from(10.0 * after.moments[0][FLOATS + i]));
        assert!((numeric - found).abs() < 1e-5 * largest, "{i}: {found}, differences say {numeric}");
        // And the step is one of Adam: by the rate, against the gradient.
        let moved = after.values[FLOATS + i] - state.values[FLOATS + i];
        assert!((f64::from(moved) + 1e-2 * numeric.signum()).abs() < 1e-6, "{i}: {moved}");
    }
    // The other views rest.
    for other in [0, 2] {
        assert_eq!(after.of(other), state.of(other));
    }
    assert_eq!(after.steps, [0, 1, 0]);

    // What the scene learns is the gradient through the exposure.
    let found = trained.read_splats().unwrap().sh_m.clone();
    for splat in 0..SPLATS {
        for channel in 0..3 {
            let at = |h: f32| {
                let mut moved = training(&gpu, &scene((splat, channel), h), ssim_weight);
                let picture = moved.render(&camera(), BACKGROUND, Show::All).unwrap().rgb;
                loss(values(&state, &picture, truth), ssim_weight)
            };
            let numeric = (at(0.05) - at(-0.05)) / 0.1;
            let found = f64::from(10.0 * found[3 * splat + channel]);
            assert!((numeric - found).abs() < 2e-6 + 1e-3 * numeric.abs(), "{splat}.{channel}: {found}, not {numeric}");
        }
    }
}

#[test]
fn the_identity_changes_nothing() {
    let (gpu, truth, scene) = (Gpu::open(None).unwrap(), truth(), scene((0, 0), 0.0));
    let learnt = |exposed: bool| {
        let mut training = training(&gpu, &scene, 0.2);
        if exposed {
            training.expose(&ExposureState::new(2)).unwrap();
        }
        step(&mut training, &truth, exposed.then_some(ExposureStep { view: 1, rate: 0.0 }));
        if let Some(state) = training.read_exposures().unwrap() {
            assert_eq!(state, ExposureState::new(2), "of rate 0 nothing moves");
        }
        (training.loss().unwrap(), training.read_splats().unwrap())
    };
    let ((loss, with), (expected, without)) = (learnt(true), learnt(false));
    assert_eq!(loss, expected);
    for (a, b) in with.geometry_m.iter().zip(&without.geometry_m).chain(with.sh_m.iter().zip(&without.sh_m)) {
        assert!((a - b).abs() < 1e-7, "{a} {b}");
    }
}

#[test]
fn an_exposure_is_undone() {
    let mut state = ExposureState::new(2);
    state.values[..FLOATS].copy_from_slice(&[1.2, 0.1, 0.0, 0.05, -0.1, 0.8, 0.2, -0.02, 0.0, 0.1, 1.1, 0.1]);
    let rgb = [0.3, 0.6, 0.9];
    let undone = state.undo(0, state.apply(0, rgb));
    assert!(rgb.iter().zip(undone).all(|(a, b)| (a - b).abs() < 1e-5), "{undone:?}");
    assert_eq!(state.undo(1, rgb), rgb);
    // A photograph that is one grey says nothing.
    state.values[..FLOATS].fill(0.0);
    assert_eq!(state.undo(0, rgb), rgb);
}

#[test]
fn the_mean_of_the_training_views_is_taken_out() {
    let mut state = ExposureState::new(3);
    state.values[0] = 1.5;
    state.values[FLOATS + 3] = 0.2;
    // A view that is not among them.
    state.values[2 * FLOATS + 7] = 9.0;
    state.center(&[0, 1]);
    assert_eq!((state.of(0)[0], state.of(1)[0]), (1.25, 0.75));
    assert!((state.of(0)[3] + 0.1).abs() < 1e-6 && (state.of(1)[3] - 0.1).abs() < 1e-6);
    assert_eq!(state.of(2)[7], 9.0);
    assert_eq!(state.apply(1, [0.4, 0.6, 0.8]).map(|v| (10.0 * v).round()), [4.0, 6.0, 8.0]);
    assert!(state.is_of(3) && !state.is_of(2));
}

/// A photograph of nothing is over the background as its exposure has it: that agrees with a picture of nothing.
#[test]
fn what_is_transparent_on_both_sides_leaves_exposures_alone() {
    let (gpu, state) = (Gpu::open(None).unwrap(), exposures());
    let nothing = HybridScene { splats: Splats::empty(0), ..scene((0, 0), 0.0) };
    let truth: Vec<u8> = truth().chunks(4).flat_map(|p| [p[0], p[1], p[2], 0]).collect();
    let mut trained = training(&gpu, &nothing, 0.2);
    trained.expose(&state).unwrap();
    step_on(&mut trained, (&truth, TruthAlpha::Composite), Some(ExposureStep { view: 1, rate: 1e-2 }));
    assert!(trained.loss().unwrap().l1 < 1e-6);
    let after = trained.read_exposures().unwrap().unwrap();
    assert!(after.moments[0].iter().all(|m| m.abs() < 1e-7), "{:?}", after.moments[0]);
}
