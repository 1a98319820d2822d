//! Gradients of exposures compared with finite differences of the loss, and effects of exposure steps.

use glam::{DMat3, DVec3, Vec3};

use super::{
    Gpu,
    adam::AdamStep,
    exposure::{ExposureState, ExposureStep, FLOATS},
    loss::{LossValues, TruthAlpha, tests::defined},
    training::{Show, Step, Training},
};
use crate::{
    render::testing,
    scene::{Atlas, Camera, Composition, HybridScene, Intrinsics, SplatArrays, Splats, Texture, testing::alike},
};

/// Not a multiple of a workgroup's pixels.
const SIZE: [u32; 2] = [70, 61];
const SPLATS: usize = 6;
const BACKGROUND: [f32; 3] = [0.1, 0.2, 0.3];

fn camera() -> Camera {
    let [width, height] = SIZE;
    let k = Intrinsics { width, height, fx: 60.0, fy: 60.0, cx: 35.0, cy: 30.0 };
    Camera::new(k, DMat3::IDENTITY, DVec3::new(0.0, 0.0, 3.0)).unwrap()
}

/// Coloured, overlapping splats; `shift` is added to one SH coefficient of one of them.
fn scene((splat, channel): (usize, usize), shift: f32) -> HybridScene {
    let mut sh: Vec<[f32; 3]> = (0..SPLATS).map(|i| [0.3 * (i as f32).sin(), 0.2, 0.25 * (i as f32).cos()]).collect();
    sh[splat][channel] += shift;
    let mean = |i: usize| Vec3::new(0.3 * i as f32 - 0.8, 0.2 * (i % 3) as f32 - 0.2, 0.1 * i as f32);
    let arrays = alike((0..SPLATS).map(mean).collect(), -1.2, 0.8, [0.0; 3]).into_arrays();
    let splats = SplatArrays { sh, ..arrays }.check().unwrap();
    HybridScene { splats, meshes: vec![], composition: Composition::default() }
}

fn truth() -> Vec<u8> {
    testing::photograph(&camera())
}

/// Exposures of three views; the middle one mixes channels.
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

fn step_on(training: &mut Training, truth: (&[u8], TruthAlpha), exposure: Option<ExposureStep>) {
    step_of(training, truth, true, exposure);
}

/// With meshes alone unless it `has_splats`.
fn step_of(
    training: &mut Training,
    (truth, truth_alpha): (&[u8], TruthAlpha),
    has_splats: bool,
    exposure: Option<ExposureStep>,
) {
    let camera = camera();
    let splats = AdamStep { number: 1, n_splats: SPLATS as u32, ..AdamStep::default() };
    let step = Step {
        truth_alpha,
        background: BACKGROUND,
        disparity_weight: 0.1,
        splats: has_splats.then_some(splats),
        exposure,
        ..Step::still(&camera, truth)
    };
    training.step(&step).unwrap();
}

/// Adapters with the kernels for software adapters and for GPUs.
fn gpus() -> [Gpu; 2] {
    [Gpu::open(None).unwrap(), Gpu::open(None).unwrap().posing_as_gpu()]
}

/// Loss of an exposed picture against the photograph, which is composited over the exposed background or weights both
/// by its alpha.
fn values(state: &ExposureState, picture: &[[f32; 3]], (truth, alpha): (&[u8], TruthAlpha)) -> LossValues {
    let e: Vec<f64> = state.of(1).map(f64::from).to_vec();
    let exposed = |rgb: &[f32; 3], c: usize| {
        let [r, g, b] = rgb.map(f64::from);
        e[4 * c] * r + e[4 * c + 1] * g + e[4 * c + 2] * b + e[4 * c + 3]
    };
    let channels = [0, 1, 2].map(|c| {
        let of_pixel = |(rgb, rgba): (&[f32; 3], &[u8])| {
            let (part, x, y) = (f64::from(rgba[3]) / 255.0, exposed(rgb, c), f64::from(rgba[c]) / 255.0);
            match alpha {
                TruthAlpha::Ignore => (x, y),
                TruthAlpha::Composite => (x, part * y + (1.0 - part) * exposed(&BACKGROUND, c)),
                TruthAlpha::Mask => (part * x, part * y),
            }
        };
        picture.iter().zip(truth.chunks(4)).map(of_pixel).unzip::<f64, f64, Vec<_>, Vec<_>>()
    });
    defined(SIZE.map(|side| side as usize), channels.each_ref().map(|(x, y)| [&x[..], &y[..]]))
}

fn loss(values: LossValues, ssim_weight: f32) -> f64 {
    let w = f64::from(ssim_weight);
    (1.0 - w) * values.l1 + w * (1.0 - values.ssim)
}

/// Also with SSIM, whose windows contain exposed values.
#[test]
fn gradients_are_those_of_the_exposed_picture() {
    assert_gradients(&[0.0, 0.2], (&truth(), TruthAlpha::Composite));
}

/// A photograph in which every third pixel has an alpha of 0; other values are such that no difference changes sign
/// near the rendered values.
fn cut_out() -> Vec<u8> {
    let is_there = |p: usize| if p.is_multiple_of(3) { 0 } else { 230 };
    truth().chunks(4).enumerate().flat_map(|(p, c)| [c[0], c[1], c[2], is_there(p)]).collect()
}

/// The background behind a photograph with alpha is exposed too.
#[test]
fn gradients_are_those_of_a_photograph_over_the_exposed_background() {
    assert_gradients(&[0.0], (&cut_out(), TruthAlpha::Composite));
}

/// Pixels with weight zero have no influence on the exposure.
#[test]
fn gradients_are_those_of_the_exposed_picture_behind_a_mask() {
    assert_gradients(&[0.0, 0.2], (&cut_out(), TruthAlpha::Mask));
}

/// Losses for an increased and a decreased parameter, and the distance between the two.
struct Sides {
    losses: [LossValues; 2],
    apart: f64,
}

impl Sides {
    fn slope(&self, ssim_weight: f32) -> f64 {
        let [more, less] = self.losses.map(|values| loss(values, ssim_weight));
        (more - less) / self.apart
    }
}

/// For the floats of the exposure.
fn exposure_sides(picture: &[[f32; 3]], truth: (&[u8], TruthAlpha)) -> Vec<Sides> {
    let sides = |i: usize| {
        let moved = [1e-4, -1e-4].map(|h: f32| {
            let mut state = exposures();
            state.values[FLOATS + i] += h;
            state
        });
        let [more, less] = moved.each_ref().map(|state| f64::from(state.values[FLOATS + i]));
        Sides { losses: moved.each_ref().map(|state| values(state, picture, truth)), apart: more - less }
    };
    (0..FLOATS).map(sides).collect()
}

/// For the coefficients of the splats, `[splat·3 + channel]`.
fn sh_sides(gpu: &Gpu, truth: (&[u8], TruthAlpha)) -> Vec<Sides> {
    let state = exposures();
    let coefficients = (0..SPLATS).flat_map(|splat| [0, 1, 2].map(|channel| (splat, channel)));
    let sides = |which: (usize, usize)| {
        let losses = [0.05, -0.05].map(|h| {
            let mut moved = training(gpu, &scene(which, h), 0.0);
            values(&state, &moved.render(&camera(), BACKGROUND, Show::All).unwrap().rgb, truth)
        });
        Sides { losses, apart: 0.1 }
    };
    coefficients.map(sides).collect()
}

/// Compares the gradients of a step, by the kernels for either kind of adapter, with central differences of the
/// definition.
fn assert_gradients(ssim_weights: &[f32], truth: (&[u8], TruthAlpha)) {
    let (gpus, state) = (gpus(), exposures());
    let picture = training(&gpus[0], &scene((0, 0), 0.0), 0.0).render(&camera(), BACKGROUND, Show::All).unwrap().rgb;
    let (expected, by_exposure, by_sh) =
        (values(&state, &picture, truth), exposure_sides(&picture, truth), sh_sides(&gpus[0], truth));
    for (gpu, &ssim_weight) in gpus.iter().flat_map(|gpu| ssim_weights.iter().map(move |weight| (gpu, weight))) {
        let case = format!("{:?}, SSIM {ssim_weight}, {:?}", gpu.profile(), truth.1);
        let mut trained = training(gpu, &scene((0, 0), 0.0), ssim_weight);
        // A first rendering makes the lists long enough.
        trained.render(&camera(), BACKGROUND, Show::All).unwrap();
        trained.expose(&state).unwrap();
        step_on(&mut trained, truth, Some(ExposureStep { view: 1, rate: 1e-2 }));
        let found = trained.loss().unwrap();
        assert!(
            (found.l1 - expected.l1).abs() < 1e-6 && (found.ssim - expected.ssim).abs() < 1e-5,
            "{case}: {found:?} {expected:?}"
        );

        // Adam's first moment after the first step is a tenth of the gradient.
        let after = trained.read_exposures().unwrap().unwrap();
        let largest = testing::largest(after.moments[0].iter().map(|m| f64::from(10.0 * m.abs())));
        assert!(largest > 0.01, "{case}: {largest}");
        for (i, sides) in by_exposure.iter().enumerate() {
            let (numeric, found) = (sides.slope(ssim_weight), f64::from(10.0 * after.moments[0][FLOATS + i]));
            assert!((numeric - found).abs() < 1e-5 * largest, "{case}, {i}: {found}, differences say {numeric}");
            // The step is one of Adam: by the learning rate, against the gradient.
            let moved = after.values[FLOATS + i] - state.values[FLOATS + i];
            assert!((f64::from(moved) + 1e-2 * numeric.signum()).abs() < 1e-6, "{case}, {i}: {moved}");
        }
        // Other views are unchanged.
        for other in [0, 2] {
            assert_eq!(after.of(other), state.of(other));
        }
        assert_eq!(after.steps, [0, 1, 0]);

        // The scene's gradient is that through the exposure.
        let found = trained.read_splats().unwrap().sh_m;
        assert_eq!(found.len(), by_sh.len());
        for (i, (found, sides)) in found.iter().zip(&by_sh).enumerate() {
            let (numeric, found) = (sides.slope(ssim_weight), f64::from(10.0 * found));
            assert!((numeric - found).abs() < 2e-6 + 1e-3 * numeric.abs(), "{case}, SH {i}: {found}, not {numeric}");
        }
    }
}

#[test]
fn the_identity_changes_nothing() {
    let (gpus, truth, scene) = (gpus(), truth(), scene((0, 0), 0.0));
    let learnt = |gpu: &Gpu, exposed: bool| {
        let mut training = training(gpu, &scene, 0.2);
        if exposed {
            training.expose(&ExposureState::new(2)).unwrap();
        }
        step(&mut training, &truth, exposed.then_some(ExposureStep { view: 1, rate: 0.0 }));
        if let Some(state) = training.read_exposures().unwrap() {
            assert_eq!(state, ExposureState::new(2), "of rate 0 nothing moves");
        }
        (training.loss().unwrap(), training.read_splats().unwrap())
    };
    for gpu in &gpus {
        let ((loss, with), (expected, without)) = (learnt(gpu, true), learnt(gpu, false));
        assert_eq!(loss, expected);
        for (a, b) in with.geometry_m.iter().zip(&without.geometry_m).chain(with.sh_m.iter().zip(&without.sh_m)) {
            assert!((a - b).abs() < 1e-7, "{a} {b}");
        }
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
    // A photograph mapped to a single grey cannot be inverted.
    state.values[..FLOATS].fill(0.0);
    assert_eq!(state.undo(0, rgb), rgb);
}

#[test]
fn the_mean_of_the_training_views_is_taken_out() {
    let mut state = ExposureState::new(3);
    state.values[0] = 1.5;
    state.values[FLOATS + 3] = 0.2;
    // A view outside the set that is centred.
    state.values[2 * FLOATS + 7] = 9.0;
    state.center(&[0, 1]);
    assert_eq!((state.of(0)[0], state.of(1)[0]), (1.25, 0.75));
    assert!((state.of(0)[3] + 0.1).abs() < 1e-6 && (state.of(1)[3] - 0.1).abs() < 1e-6);
    assert_eq!(state.of(2)[7], 9.0);
    assert_eq!(state.apply(1, [0.4, 0.6, 0.8]).map(|v| (10.0 * v).round()), [4.0, 6.0, 8.0]);
    assert!(state.is_of(3) && !state.is_of(2));
}

/// A fully transparent photograph becomes the exposed background, and so does an empty rendering: the two agree.
#[test]
fn what_is_transparent_on_both_sides_leaves_exposures_alone() {
    let state = exposures();
    let nothing = HybridScene { splats: Splats::empty(0), ..scene((0, 0), 0.0) };
    let truth: Vec<u8> = truth().chunks(4).flat_map(|p| [p[0], p[1], p[2], 0]).collect();
    for gpu in gpus() {
        let mut trained = training(&gpu, &nothing, 0.2);
        trained.expose(&state).unwrap();
        step_on(&mut trained, (&truth, TruthAlpha::Composite), Some(ExposureStep { view: 1, rate: 1e-2 }));
        assert!(trained.loss().unwrap().l1 < 1e-6);
        let after = trained.read_exposures().unwrap().unwrap();
        assert!(after.moments[0].iter().all(|m| m.abs() < 1e-7), "{:?}", after.moments[0]);
    }
}

/// As in the warm-up of a given mesh, which may be an object in front of surroundings that are not drawn yet.
#[test]
fn exposures_learn_nothing_of_what_meshes_leave_open() {
    let atlas = Atlas::new(Texture::zeros(16, 16, 4), None).unwrap();
    let square = testing::grid_mesh([1, 1], atlas, |u, v| Vec3::new(u as f32 - 0.5, v as f32 - 0.5, 0.0));
    let composition = Composition { layers: 1, ..Composition::default() };
    let scene = HybridScene { splats: Splats::empty(0), meshes: vec![square], composition };
    for gpu in gpus() {
        // First moments for photographs that differ only in the wall around the square.
        let learnt = |has_splats: bool| {
            [0, 255].map(|wall| {
                let mut trained = training(&gpu, &scene, 0.0);
                let transmittance = trained.render(&camera(), BACKGROUND, Show::All).unwrap().transmittance;
                let open = transmittance.iter().filter(|t| **t == 1.0).count();
                assert!((transmittance.len() / 2..transmittance.len() - 200).contains(&open), "{open}");
                let of_pixel = |t: &f32| if *t < 1.0 { [200, 210, 220, 255] } else { [wall, wall, wall, 255] };
                let truth: Vec<u8> = transmittance.iter().flat_map(of_pixel).collect();
                trained.expose(&exposures()).unwrap();
                let exposure = Some(ExposureStep { view: 1, rate: 1e-2 });
                step_of(&mut trained, (&truth, TruthAlpha::Ignore), has_splats, exposure);
                assert_eq!(trained.status().unwrap().skipped, 0);
                let [first, _] = trained.read_exposures().unwrap().unwrap().moments;
                first[FLOATS..2 * FLOATS].to_vec()
            })
        };
        let [dark, bright] = learnt(false);
        assert!(dark == bright && dark.iter().all(|m| *m < 0.0), "{dark:?} {bright:?}");
        // Beside splats, which are to explain all of the picture, every pixel counts.
        let [dark, bright] = learnt(true);
        assert!(dark.iter().zip(&bright).all(|(dark, bright)| dark > bright), "{dark:?} {bright:?}");
    }
}
