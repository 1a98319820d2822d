//! Size of a scene as estimated, and limits of its size.

use glam::DVec3;

use super::*;
use crate::{optimize::size, scene::Intrinsics};

#[test]
fn units_follow_what_is_seen() {
    assert_eq!(size::unit_of_length(5.0, None), 1.0);
    assert_eq!(size::unit_of_length(4.0, Some(4.0)), 0.8);
    // A drone above a plain, and three cameras next to each other.
    assert_eq!((size::unit_of_length(500.0, Some(80.0)), size::unit_of_length(0.1, Some(3.0))), (24.0, 0.3));
    let mut demo = demo();
    let train: Vec<usize> = (0..demo.views.len()).collect();
    let found = size::median_depth(&demo, &train).unwrap() / capture::extent(demo.views.iter().map(|v| &v.camera));
    assert!((0.7..1.2).contains(&found), "{found}");
    // Cameras on a tripod have no extent: learning rates of means, λ and the near plane follow the visible points
    // instead.
    let [there, turned] = [0, 1].map(|i| demo.views[i].camera);
    let there_too =
        Camera::new(*turned.intrinsics(), turned.rotation(), -(turned.rotation() * there.center())).unwrap();
    // Cameras whose positions differ by less than a pixel have no extent either.
    let hand = DVec3::splat(1e-6);
    let beside = Camera::new(*there.intrinsics(), there.rotation(), there.translation() + hand).unwrap();
    for (cameras, depth, extent) in [
        ([there, there_too], Some(4e-3), 4e-3),
        ([there, beside], Some(4.0), 4.0),
        ([there, there_too], None, 1.0),
        ([there, turned], Some(4e-3), capture::extent(&[there, turned])),
    ] {
        assert_eq!(size::extent(&cameras, depth), extent);
    }
    // With focal lengths ten times as long, from ten times the distance, objects have the same size.
    let through = |times: f64| {
        let k = *there.intrinsics();
        let focal = times * f64::from(k.longer_side());
        Camera::new(Intrinsics { fx: focal, fy: focal, ..k }, there.rotation(), there.translation()).unwrap()
    };
    let narrowness = [0.5, 5.0, 50.0].map(|times| size::narrowness(&[through(times)]));
    assert!(narrowness[..2] == [1.0; 2] && (narrowness[2] - 0.1).abs() < 1e-12, "{narrowness:?}");
    demo.points.clear();
    assert_eq!(size::median_depth(&demo, &train), None);
}

#[test]
fn the_near_plane_is_near_in_small_scenes() {
    let cameras = demo().cameras();
    let smaller = |c: &Camera| Camera::new(*c.intrinsics(), c.rotation(), 0.02 * c.translation()).unwrap();
    let small: Vec<Camera> = cameras.iter().map(smaller).collect();
    let extent = capture::extent(&small) as f32;
    let near = |cameras: &[Camera]| size::near_plane(size::extent(cameras, None) as f32, 0.1);
    assert_eq!(near(&cameras), 0.1);
    assert!(extent < 0.1 && near(&small) == 0.05 * extent);
    assert_eq!(near(&small[..1]), 0.05, "one camera says nothing of the size");
}

/// Before an iteration, rather than by numbers that are not finite or by pictures without order.
#[test]
fn scenes_too_small_or_too_large_for_their_unit_are_refused() {
    let (gpu, stop) = (Gpu::open(None).unwrap(), AtomicBool::new(false));
    let options = TrainOptions { iterations: 2, max_splats: Some(100), ..options() };
    let run = |factor: f64| {
        let mut capture = demo();
        capture.views.iter_mut().for_each(|view| view.camera = view.camera.scaled(factor));
        capture.points.iter_mut().for_each(|point| point.position *= factor);
        let session = Session { gpu: &gpu, checkpoints: Checkpoints::Off, stop: &stop, progress: &mut |_| {} };
        train(&capture, MeshSource::None, &options, session)
    };
    for factor in [1e-20, 1e-15, 1e9, 1e15] {
        let error = run(factor).unwrap_err();
        assert!(matches!(error, TrainError::Unit { .. }), "{factor}: {error}");
        let said = error.to_string();
        assert!(
            said.starts_with("demo: expected a scene that views see from 1e-14 to 5e8 units away, found "),
            "{said}"
        );
    }
    for factor in [1e-13, 1e-6, 1e6, 1e8] {
        assert_eq!(run(factor).unwrap().outcome, Outcome::Finished, "{factor}");
    }
}

/// Also if the mesh exists before the splats, or its surface is made of points.
#[test]
fn floats_stay_within_their_budget() {
    let (gpu, capture, stop) = (Gpu::open(None).unwrap(), demo(), AtomicBool::new(false));
    let options = TrainOptions { max_floats: Some(60_000), ..options() };
    for source in [square(), MeshSource::Points, MeshSource::Splats, MeshSource::None] {
        let session = Session { gpu: &gpu, checkpoints: Checkpoints::Off, stop: &stop, progress: &mut |_| {} };
        let scene = train(&capture, source.clone(), &options, session).unwrap().scene;
        assert!(scene.total_floats() <= 60_000, "{source:?}: {}", scene.total_floats());
        assert!(scene.total_floats() > 40_000, "{source:?}: {}", scene.total_floats());
    }
    // Maps that are never laid out anew begin at their final size.
    for (source, warmup) in [(square(), 20), (MeshSource::Points, 0)] {
        let options = TrainOptions { texture_size: Some(256), warmup, ..options.clone() };
        let session = Session { gpu: &gpu, checkpoints: Checkpoints::Off, stop: &stop, progress: &mut |_| {} };
        let scene = train(&capture, source, &options, session).unwrap().scene;
        let maps = scene.meshes[0].atlas().floats();
        assert!(scene.total_floats() <= 60_000 && maps > 15_000 && maps <= 30_000, "{}, {maps}", scene.total_floats());
    }
    let options = TrainOptions { max_floats: Some(1000), ..options };
    for warmup in [0, 20] {
        let options = TrainOptions { warmup, ..options.clone() };
        let session = Session { gpu: &gpu, checkpoints: Checkpoints::Off, stop: &stop, progress: &mut |_| {} };
        let scene = train(&capture, MeshSource::Points, &options, session).unwrap().scene;
        assert!(scene.meshes.is_empty() && scene.total_floats() <= 1000, "{}", scene.total_floats());
    }
    let session = Session { gpu: &gpu, checkpoints: Checkpoints::Off, stop: &stop, progress: &mut |_| {} };
    let error = train(&capture, square(), &options, session).unwrap_err().to_string();
    assert!(error.starts_with("expected a budget of at least the ") && error.ends_with("take, found 1000"), "{error}");
}
