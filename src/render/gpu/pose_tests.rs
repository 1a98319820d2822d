//! Gradients of poses compared with finite differences of the f64 reference, and effects of pose steps.

use glam::{DMat3, DQuat, DVec3};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

use super::{
    Gpu,
    adam::AdamStep,
    pose::{FLOATS, PoseState, PoseStep},
    training::{Step, Training, TrainingOptions},
};
use crate::{
    render::{reference, testing},
    scene::{Camera, HybridScene, OrderMode, PixelFilter, gather},
};

const POSE: PoseStep = PoseStep { view: 1, turn_rate: 1e-3, shift_rate: 2e-3 };
/// Rotation vector and translation of the trained view's correction.
const CHANGE: [DVec3; 2] = [DVec3::new(0.02, -0.03, 0.05), DVec3::new(-0.04, 0.03, 0.05)];

/// Corrections of three views, of which only the middle one is not zero.
fn poses() -> PoseState {
    let mut state = PoseState::new(3);
    for (at, v) in [0, 4].into_iter().zip(CHANGE) {
        state.values[FLOATS + at..FLOATS + at + 3].copy_from_slice(&v.as_vec3().to_array());
    }
    state
}

fn changed(camera: &Camera, [turn, shift]: [DVec3; 2]) -> Camera {
    let rotation = DMat3::from_quat(DQuat::from_scaled_axis(turn)) * camera.rotation();
    Camera::new(*camera.intrinsics(), rotation, -(rotation * (camera.center() + shift))).unwrap()
}

fn step(training: &mut Training, camera: &Camera, sh_degree: u32, pose: Option<PoseStep>) {
    let n_splats = training.n_splats() as u32;
    let splats = Some(AdamStep { number: 1, n_splats, sh_degree, ..AdamStep::default() });
    let truth = testing::photograph(camera);
    let still = Step::still(camera, &truth);
    training.step(&Step { background: [0.3, 0.2, 0.1], sh_degree, splats, pose, ..still }).unwrap();
}

/// Mean absolute difference between the reference's rendering and the photograph.
fn l1(scene: &HybridScene, camera: &Camera, truth: &[u8]) -> f64 {
    let picture = reference::render(scene, camera);
    let of_pixel = |(p, rgb): (usize, &[f64; 3])| {
        (0..3).map(|c| (rgb[c] - f64::from(truth[4 * p + c]) / 255.0).abs()).sum::<f64>()
    };
    picture.rgb.iter().enumerate().map(of_pixel).sum::<f64>() / (3 * picture.rgb.len()) as f64
}

/// Trains one step, and compares the gradient with central differences of step `h`.
fn assert_gradient(gpu: &Gpu, mut scene: HybridScene, camera: &Camera, h: f64, tolerance: f64) {
    scene.meshes.clear();
    scene.composition.background = [0.3, 0.2, 0.1];
    let training = Training::new(gpu, &scene, &[*camera], 0.0).unwrap();
    assert_gradient_of(training, &scene, camera, h, tolerance);
}

/// [`assert_gradient`] for an existing training.
fn assert_gradient_of(mut training: Training, scene: &HybridScene, camera: &Camera, h: f64, tolerance: f64) {
    training.refine_poses(&poses()).unwrap();
    step(&mut training, camera, scene.splats.sh_degree(), Some(POSE));
    if training.grow_if_short().unwrap() > 0 {
        training.refine_poses(&poses()).unwrap();
        step(&mut training, camera, scene.splats.sh_degree(), Some(POSE));
    }
    let after = training.read_poses().unwrap().unwrap();
    let truth = testing::photograph(camera);
    assert!((training.loss().unwrap().l1 - l1(scene, &changed(camera, CHANGE), &truth)).abs() < 1e-5);

    // Adam's first moment after the first step is a tenth of the gradient.
    for part in 0..2 {
        let found = |axis: usize| f64::from(10.0 * after.moments[0][FLOATS + 4 * part + axis]);
        let largest = (0..3).map(|axis| found(axis).abs()).fold(0.0, f64::max);
        assert!(largest > 1e-4, "{largest}");
        for axis in 0..3 {
            let at = |h: f64| {
                let mut moved = CHANGE;
                moved[part][axis] += h;
                l1(scene, &changed(camera, moved), &truth)
            };
            let (numeric, found) = ((at(h) - at(-h)) / (2.0 * h), found(axis));
            assert!((numeric - found).abs() < tolerance * largest, "{part}.{axis}: {found}, differences say {numeric}");
            // The step is one of Adam: by the learning rate, against the gradient.
            let i = FLOATS + 4 * part + axis;
            let (moved, rate) = (after.values[i] - poses().values[i], [POSE.turn_rate, POSE.shift_rate][part]);
            assert!((moved + rate * numeric.signum() as f32).abs() < 1e-6, "{i}: {moved}");
        }
    }
    // Other views are unchanged.
    for other in [0, 2] {
        assert_eq!(after.of(other), [DVec3::ZERO; 2]);
    }
    assert_eq!(after.steps[0] + after.steps[2], 0);
}

#[test]
fn gradients_are_those_of_the_reference() {
    let gpus = [Gpu::open(None).unwrap(), Gpu::with_subgroups(false)];
    for gpu in gpus.into_iter().chain([Gpu::open(None).unwrap().posing_as_gpu()]) {
        // A smooth scene with each pixel filter, and large differences.
        for filter in [PixelFilter::DILATION, PixelFilter::MIP] {
            let (mut scene, camera) = testing::smooth_scene(7, 1, OrderMode::Stable);
            scene.composition.pixel_filter = filter;
            assert_gradient(&gpu, scene, &camera, 1e-5, 2e-4);
        }
        // More splats than a workgroup has threads, some of them outside the picture: the difference is so small that
        // no pixel crosses a threshold.
        let (scene, camera) = testing::random_scene(5, 300, 0, 2, 1, OrderMode::Stable);
        assert_gradient(&gpu, scene, &camera, 1e-8, 2e-4);
    }
}

/// All optional features at once, starting with fewer splats than the final capacity.
#[test]
fn more_splats_than_there_was_room_for_pull_at_poses() {
    let gpu = Gpu::open(None).unwrap();
    let (mut scene, camera) = testing::random_scene(5, 300, 0, 2, 1, OrderMode::Stable);
    scene.meshes.clear();
    scene.composition.background = [0.3, 0.2, 0.1];
    let few = HybridScene { splats: gather(scene.splats.clone(), &(0..10).collect::<Vec<usize>>()), ..scene.clone() };
    let options = TrainingOptions { ssim_weight: 0.0, absolute_gradients: true, ..TrainingOptions::default() };
    let mut training = Training::with_options(&gpu, &few, &[camera], &options).unwrap();
    training.refine_poses(&poses()).unwrap();
    let all = Training::new(&gpu, &scene, &[camera], 0.0).unwrap().read_splats().unwrap();
    assert!(training.pipeline.front.splats.capacity < 300);
    training.write_splats(&all).unwrap();
    assert_gradient_of(training, &scene, &camera, 1e-8, 2e-4);
}

#[test]
fn no_change_and_no_rate_change_nothing() {
    let gpu = Gpu::open(None).unwrap();
    let (mut scene, camera) = testing::random_scene(3, 100, 0, 1, 1, OrderMode::Stable);
    scene.meshes.clear();
    let learnt = |refined: bool| {
        let mut training = Training::new(&gpu, &scene, &[camera], 0.2).unwrap();
        if refined {
            training.refine_poses(&PoseState::new(2)).unwrap();
        }
        let pose = PoseStep { view: 1, turn_rate: 0.0, shift_rate: 0.0 };
        step(&mut training, &camera, 1, refined.then_some(pose));
        if let Some(state) = training.read_poses().unwrap() {
            assert_eq!(state, PoseState::new(2));
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
fn a_camera_is_changed_as_it_says() {
    let (_, camera) = testing::smooth_scene(1, 1, OrderMode::Stable);
    let [found, expected] = [poses().apply(1, &camera), changed(&camera, CHANGE)];
    assert!(found.rotation().abs_diff_eq(expected.rotation(), 1e-8));
    assert!(found.center().abs_diff_eq(camera.center() + CHANGE[1], 1e-7));
    assert_eq!(poses().apply(0, &camera), camera);
    assert!(poses().is_of(3) && !poses().is_of(2));
}

#[test]
fn what_all_have_in_common_is_taken_out() {
    let mut rng = Pcg64Mcg::seed_from_u64(3);
    let mut vector = |size: f64| DVec3::from_array([0; 3].map(|_| rng.random_range(-size..size)));
    let (_, camera) = testing::smooth_scene(1, 1, OrderMode::Stable);
    let views: Vec<usize> = (0..30).collect();
    let cameras: Vec<Camera> = (0..31).map(|_| changed(&camera, [vector(2.0), vector(3.0)])).collect();
    let put = |state: &mut PoseState, view: usize, change: [DVec3; 2]| {
        let words = change.map(|v| [v.x as f32, v.y as f32, v.z as f32, 0.0]);
        state.values[FLOATS * view..FLOATS * (view + 1)].copy_from_slice(words.as_flattened());
    };
    // A small similarity common to all cameras is removed, up to its square.
    let mut common = PoseState::new(31);
    let (shift, turn, growth) = (DVec3::new(1e-3, -2e-3, 1e-3), DVec3::new(2e-3, 1e-3, -1e-3), 3e-3);
    for (i, camera) in cameras.iter().enumerate() {
        let moved = shift + turn.cross(camera.center()) + growth * camera.center();
        put(&mut common, i, [camera.rotation() * -turn, moved]);
    }
    let of_others = common.of(30);
    let mut centered = common.clone();
    centered.center(&cameras, &views);
    let largest = |state: &PoseState| testing::largest(state.values[..30 * FLOATS].iter().map(|v| f64::from(v.abs())));
    assert!(largest(&common) > 1e-3 && largest(&centered) < 1e-8, "{}", largest(&centered));
    assert_eq!(centered.of(30), of_others, "a view that is not among them rests");

    // Random corrections remain up to a small change; with a common part added, the same remains.
    let mut random = PoseState::new(31);
    let mut with_common = PoseState::new(31);
    for i in views.clone() {
        let change = [vector(1e-2), vector(1e-2)];
        put(&mut random, i, change);
        put(&mut with_common, i, [0, 1].map(|k| change[k] + common.of(i)[k]));
    }
    let before = random.clone();
    random.center(&cameras, &views);
    with_common.center(&cameras, &views);
    let distance = |a: &PoseState, b: &PoseState| {
        a.values.iter().zip(&b.values).map(|(a, b)| f64::from(a - b).powi(2)).sum::<f64>().sqrt()
    };
    let size = distance(&before, &PoseState::new(31));
    assert!(distance(&random, &before) < 0.5 * size, "{} of {size}", distance(&random, &before));
    assert!(distance(&random, &with_common) < 1e-6);
    assert!((0..30).map(|i| random.of(i)[1]).sum::<DVec3>().length() < 1e-7);

    // Cameras in one place have no scale.
    let mut state = before.clone();
    state.center(&vec![camera; 31], &views);
    assert!(state.values.iter().all(|v| v.is_finite()));
    let turn: DVec3 = (0..30).map(|i| state.of(i)[0]).sum();
    assert!(turn.length() < 1e-7, "{turn}");
}
