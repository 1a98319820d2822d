//! Interrupted runs, their checkpoints, and runs resumed from these.

use std::sync::atomic::Ordering;

use super::*;
use crate::optimize::{checkpoint::Checkpoint, density::mcmc::EpochWeight, resume::HostState};

#[test]
fn checkpoints_have_the_history() {
    let (gpu, capture, folder) = (Gpu::open(None).unwrap(), demo(), tempfile::tempdir().unwrap());
    let path = folder.path().join("checkpoint");
    let history = |resume: bool, stop: bool| -> Result<Vec<u32>, TrainError> {
        let stop = AtomicBool::new(stop);
        let checkpoints = checkpoints(&path, resume);
        let session = Session { gpu: &gpu, checkpoints, stop: &stop, progress: &mut |_| {} };
        train(&capture, MeshSource::None, &options(), session).map(|t| t.history.iter().map(|p| p.iteration).collect())
    };
    assert_eq!(history(false, true).unwrap(), Vec::<u32>::new(), "only what is reported without a stop");
    let whole = Checkpoint::read(&path).unwrap();
    let mut damaged = whole.clone();
    damaged.indices.get_mut("log").unwrap().pop();
    damaged.write(&path).unwrap();
    assert!(history(true, false).unwrap_err().to_string().ends_with("log is missing or damaged"));
    whole.write(&path).unwrap();
    assert_eq!(history(true, false).unwrap(), [10, 20]);
}

/// Also if the run was stopped after the reason was known.
#[test]
fn a_resumed_run_says_why_it_has_no_surface() {
    let (gpu, folder) = (Gpu::open(None).unwrap(), tempfile::tempdir().unwrap());
    let capture = in_a_row(folder.path(), 0.0, |_| image::Rgba([0, 0, 0, 255]));
    let options = TrainOptions { iterations: 40, surface_iterations: Some(10), max_splats: Some(5), ..options() };
    let run = |resume: bool| {
        let stop = AtomicBool::new(false);
        let progress = &mut on_progress(|p| stop.store(!resume && p.phase == Phase::Joint, Ordering::Relaxed));
        let checkpoints = checkpoints(&folder.path().join("checkpoint"), resume);
        let session = Session { gpu: &gpu, checkpoints, stop: &stop, progress };
        let trained = train(&capture, MeshSource::Splats, &options, session).unwrap();
        (trained.outcome, trained.no_surface.unwrap())
    };
    let [(stopped, why), (finished, why_then)] = [false, true].map(run);
    assert_eq!((stopped, finished), (Outcome::Interrupted, Outcome::Finished));
    assert!(why.contains("surface") && why == why_then, "{why:?} {why_then:?}");
}

/// Even while the last scores of a phase are computed: the next phase takes minutes.
#[test]
fn a_stop_at_the_end_of_a_phase_is_heeded_there() {
    let (gpu, folder) = (Gpu::open(None).unwrap(), tempfile::tempdir().unwrap());
    let capture = in_a_row(folder.path(), 0.0, |_| image::Rgba([0, 0, 0, 255]));
    let short = TrainOptions { iterations: 20, surface_iterations: Some(10), max_splats: Some(5), ..options() };
    let (options, path) = (TrainOptions { checkpoint_every: 1000, ..short }, folder.path().join("checkpoint"));
    let stop = AtomicBool::new(false);
    let is_last = |p: &Progress| (p.phase, p.iteration) == (Phase::Surface, 10);
    let progress = &mut on_progress(|p| stop.store(is_last(p), Ordering::Relaxed));
    let session = Session { gpu: &gpu, checkpoints: checkpoints(&path, false), stop: &stop, progress };
    let trained = train(&capture, MeshSource::Splats, &options, session).unwrap();
    assert_eq!((trained.outcome, trained.no_surface), (Outcome::Interrupted, None));
    assert_eq!(Checkpoint::read(&path).unwrap().meta["phase"], serde_json::to_value(Phase::Surface).unwrap());
}

/// A disk without room for a checkpoint may have some later, or room for the scene.
#[test]
fn a_run_goes_on_without_checkpoints_unless_it_is_stopped() {
    let (gpu, capture, folder) = (Gpu::open(None).unwrap(), demo(), tempfile::tempdir().unwrap());
    let path = folder.path().join("missing/checkpoint");
    let run = |iterations: u32, checkpoint_every: u32, stop_after: u32| {
        let (stop, mut unsaved) = (AtomicBool::new(false), vec![]);
        let session = Session {
            gpu: &gpu,
            checkpoints: checkpoints(&path, false),
            stop: &stop,
            progress: &mut |event| match event {
                Event::Progress(p) => stop.store(p.iteration == stop_after, Ordering::Relaxed),
                Event::Unsaved { error, .. } => unsaved.push(error.to_string()),
            },
        };
        let options = TrainOptions { iterations, checkpoint_every, ..options() };
        let trained = train(&capture, MeshSource::None, &options, session);
        (trained.map(|trained| trained.outcome), unsaved)
    };
    // A scheduled checkpoint, one at which the run is stopped as well, one requested in the last iteration, and several
    // of which the first is told.
    for (iterations, every, stop_after) in [(10, 10, 0), (10, 10, 10), (11, 0, 10), (30, 10, 0)] {
        let (outcome, unsaved) = run(iterations, every, stop_after);
        assert_eq!(outcome.unwrap(), Outcome::Finished, "{iterations}, {every}, {stop_after}");
        let [told] = &unsaved[..] else { panic!("{iterations}, {every}, {stop_after}: {unsaved:?}") };
        assert!(told.contains("checkpoint: "), "{told}");
    }
    // The stop is heeded in the next iteration.
    for (every, told) in [(0, 0), (10, 1)] {
        let (outcome, unsaved) = run(20, every, 10);
        assert!(matches!(outcome, Err(TrainError::Checkpoint(_))) && unsaved.len() == told, "{every}: {unsaved:?}");
    }
    assert!(!path.exists());
}

/// Its memory is that of the whole training, of which the part after a stop may need less.
#[test]
fn a_resumed_run_has_the_peak_of_memory_of_what_was_before() {
    let (gpu, capture, folder) = (Gpu::open(None).unwrap(), demo(), tempfile::tempdir().unwrap());
    let path = folder.path().join("checkpoint");
    let run = |resume: bool| {
        let (checkpoints, stop) = (checkpoints(&path, resume), AtomicBool::new(!resume));
        let session = Session { gpu: &gpu, checkpoints, stop: &stop, progress: &mut |_| {} };
        train(&capture, MeshSource::None, &options(), session).unwrap().peak_gpu_bytes
    };
    let own = run(false);
    let mut file = Checkpoint::read(&path).unwrap();
    let log = file.indices.get_mut("log").unwrap();
    // Its sixth and seventh number: more than any run of this size needs.
    let before = 1_u64 << 40;
    assert!((1..before).contains(&own), "{own}");
    log[5..7].copy_from_slice(&[before as u32, (before >> 32) as u32]);
    file.write(&path).unwrap();
    assert_eq!(run(true), before);
}

/// Buffers have room for no more, so that density control need not replace them, and lists stay as long as they were.
#[test]
fn a_resumed_joint_phase_begins_with_no_more_splats_than_it_may_have() {
    with_run(&TrainOptions { max_floats: Some(60_000), ..options() }, |run, training, scene| {
        run.setup.identity.finds_surface = true;
        let most = run.setup.budget.splats_beside(&scene.meshes);
        assert!(most < run.setup.budget.splats_beside(&[]) && most < run.setup.capture.points.len(), "{most}");
        for (phase, is_limited) in [(Phase::Joint, true), (Phase::Warmup, false)] {
            let host = HostState {
                reached: (phase, 0),
                found: run.found.clone(),
                poses: None,
                epoch: &EpochWeight::default(),
                past: run.log.past.clone(),
            };
            let mut saved = Saved::capture(training, scene, host).unwrap();
            let first = run.first_scene(MeshSource::Points, Some(&mut saved)).unwrap();
            assert_eq!(first.meshes.len(), 1);
            assert_eq!(first.splats.len() == most, is_limited, "{phase:?}: {} of {most}", first.splats.len());
        }
    });
}

/// Splats trained with other cameras or other points are not continued.
#[test]
fn checkpoints_are_of_their_cameras_and_points() {
    let (gpu, capture, folder) = (Gpu::open(None).unwrap(), demo(), tempfile::tempdir().unwrap());
    let options = TrainOptions { iterations: 60, lambda: f32::INFINITY, ..options() };
    let run = |capture: &Capture, resume: bool| {
        let stop = AtomicBool::new(false);
        let progress = &mut on_progress(|_| stop.store(true, Ordering::Relaxed));
        let checkpoints = checkpoints(&folder.path().join("checkpoint"), resume);
        let session = Session { gpu: &gpu, checkpoints, stop: &stop, progress };
        train(capture, MeshSource::None, &options, session).map(|trained| trained.outcome)
    };
    assert_eq!(run(&capture, false).unwrap(), Outcome::Interrupted);
    assert_eq!(run(&capture, true).unwrap(), Outcome::Interrupted);
    let mut moved = demo();
    let camera = &mut moved.views[3].camera;
    *camera = Camera::new(*camera.intrinsics(), camera.rotation(), camera.translation() + 1e-9).unwrap();
    let mut other = demo();
    other.points[7].position.x += 1e-9;
    for capture in [moved, other] {
        assert!(matches!(run(&capture, true), Err(TrainError::Resume(_))));
    }
}

/// Without a mesh there is no surface phase and no warm-up.
#[test]
fn checkpoints_of_phases_that_a_run_has_not_are_refused() {
    let (gpu, capture, folder) = (Gpu::open(None).unwrap(), demo(), tempfile::tempdir().unwrap());
    let path = folder.path().join("checkpoint");
    let run = |resume: bool| {
        let (checkpoints, stop) = (checkpoints(&path, resume), AtomicBool::new(true));
        let session = Session { gpu: &gpu, checkpoints, stop: &stop, progress: &mut |_| {} };
        train(&capture, MeshSource::None, &options(), session).map(|trained| trained.outcome)
    };
    assert_eq!(run(false).unwrap(), Outcome::Interrupted);
    let whole = Checkpoint::read(&path).unwrap();
    for phase in [Phase::Surface, Phase::Warmup] {
        let mut other = whole.clone();
        other.meta["phase"] = serde_json::to_value(phase).unwrap();
        other.write(&path).unwrap();
        let error = run(true).unwrap_err().to_string();
        assert!(error.ends_with("phase is missing or damaged"), "{phase:?}: {error}");
    }
}

/// A checkpoint is accepted or refused, whatever its arrays contain.
#[test]
fn damaged_checkpoints_are_refused() {
    let (gpu, capture, folder) = (Gpu::open(None).unwrap(), demo(), tempfile::tempdir().unwrap());
    let path = folder.path().join("checkpoint");
    let options = TrainOptions {
        iterations: 30,
        surface_iterations: Some(10),
        warmup: 30,
        exposure: true,
        refine_poses: true,
        ..options()
    };
    for (source, phase) in
        [(MeshSource::Points, Phase::Warmup), (MeshSource::Splats, Phase::Warmup), (MeshSource::Splats, Phase::Joint)]
    {
        let run = |resume: bool| {
            let stop = AtomicBool::new(false);
            let progress = &mut on_progress(|p| stop.store(p.phase == phase, Ordering::Relaxed));
            let session = Session { gpu: &gpu, checkpoints: checkpoints(&path, resume), stop: &stop, progress };
            train(&capture, source.clone(), &options, session)
        };
        assert_eq!(run(false).unwrap().outcome, Outcome::Interrupted);
        let whole = Checkpoint::read(&path).unwrap();
        assert_eq!(whole.meta["phase"], serde_json::to_value(phase).unwrap());
        let names: Vec<String> = whole.tensors.keys().cloned().collect();
        assert!(!whole.tensors["vertices/normals"].is_empty(), "{phase:?}: no vertex moves");
        for name in names {
            let mut damaged = whole.clone();
            damaged.tensors.get_mut(&name).unwrap().pop();
            damaged.write(&path).unwrap();
            match run(true) {
                Err(TrainError::Resume(_)) => {}
                // Truncating an empty array changes nothing.
                Ok(_) if damaged == whole => {}
                other => panic!("{source:?}, {phase:?}, {name}: {:?}", other.map(|trained| trained.outcome)),
            }
        }
    }
}
