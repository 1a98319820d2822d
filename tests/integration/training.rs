//! Trainings that give one scene to the last bit, on the small capture of the repository: interrupted and resumed, run
//! again, or without the mesh that they did not keep.

use std::cell::Cell;
use std::sync::atomic::{AtomicBool, Ordering};

use crate::common::{self, demo};
use centaur::capture::{self, Capture, Downscale, LoadOptions};
use centaur::geometry::Surface;
use centaur::optimize::{
    Checkpoints, Density, Event, MeshSource, Outcome, Phase, Session, TrainOptions, Trained, train,
};
use centaur::render::gpu::Gpu;
use glam::Vec3;

fn options(density: Density) -> TrainOptions {
    TrainOptions {
        iterations: 90, // the fewest with a density step between those of warm-up and end
        warmup: 20,
        surface_iterations: Some(30),
        density,
        max_splats: Some(1500),
        sh_degree: 1,
        texture_size: Some(64),
        checkpoint_every: 0,
        eval_every: 0,
        ..TrainOptions::default()
    }
}

struct Bench {
    gpu: Gpu,
    capture: Capture,
    mesh: MeshSource,
    options: TrainOptions,
    folder: tempfile::TempDir,
    /// Number of reports of the last run itself.
    told: Cell<usize>,
}

impl Bench {
    fn new(mesh: MeshSource, options: TrainOptions) -> Self {
        Self::of_size(64, mesh, options)
    }

    fn of_size(side: u32, mesh: MeshSource, options: TrainOptions) -> Self {
        let small = LoadOptions { downscale: Downscale::MaxSide(side), ..LoadOptions::default() };
        let mut capture = capture::open(&demo(), &small).unwrap();
        // Fewer points than `max_splats`, so that density control has decisions to make.
        capture.points.truncate(700);
        Self {
            gpu: Gpu::open(None).unwrap(),
            capture,
            mesh,
            options,
            folder: tempfile::tempdir().unwrap(),
            told: Cell::new(0),
        }
    }

    /// Trains, from the checkpoint if `resume`, and requests a stop at the report `stop_at`, if given.
    fn run(&self, resume: bool, stop_at: Option<(Phase, u32)>) -> Trained {
        let stop = AtomicBool::new(false);
        self.told.set(0);
        let checkpoint = self.folder.path().join("checkpoint");
        let session = Session {
            gpu: &self.gpu,
            checkpoints: if resume { Checkpoints::Resume(checkpoint) } else { Checkpoints::Save(checkpoint) },
            stop: &stop,
            progress: &mut |event| {
                let Event::Progress(p) = event else { return };
                self.told.set(self.told.get() + 1);
                if stop_at == Some((p.phase, p.iteration)) {
                    stop.store(true, Ordering::Relaxed);
                }
            },
        };
        train(&self.capture, self.mesh.clone(), &self.options, session).unwrap()
    }

    /// Asserts that an interrupted and resumed run equals `straight` to the last bit.
    fn assert_same(&self, straight: &Trained, stop_at: (Phase, u32)) {
        let first = self.run(false, Some(stop_at));
        assert_eq!(first.outcome, Outcome::Interrupted);
        let second = self.run(true, None);
        assert_eq!(second.outcome, Outcome::Finished);
        assert!(self.told.get() < second.history.len(), "nothing was resumed");
        let last = |trained: &Trained| trained.history.last().map_or(0.0, |report| report.seconds);
        // An evaluation of held-out views comes between the last report and the checkpoint.
        let both = 0.5 * last(&first) + last(&second);
        assert!(second.training_seconds > both, "{} s in all, not {both}", second.training_seconds);
        let but_for_seconds = |trained: &Trained| -> Vec<_> {
            trained.history.iter().map(|p| (p.phase, p.iteration, p.of, p.loss, p.splats, p.psnr)).collect()
        };
        assert_eq!(but_for_seconds(straight), but_for_seconds(&second), "stopped at {stop_at:?}");
        assert_eq!(straight.surface, second.surface);
        assert_eq!(straight.selection, second.selection, "stopped at {stop_at:?}");
        assert!(straight.scene == second.scene, "stopped at {stop_at:?}: another scene");
        assert_eq!(straight.cameras, second.cameras, "stopped at {stop_at:?}");
    }
}

/// A table top: a mesh that is the same in every run.
fn square() -> MeshSource {
    let positions = [[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]].map(Vec3::from).to_vec();
    MeshSource::Given { surface: Surface { positions, triangles: vec![[0, 1, 2], [0, 2, 3]] }, corner_uvs: None }
}

fn resumes_in_both_phases(options: TrainOptions) {
    let bench = Bench::new(square(), options);
    let straight = bench.run(false, None);
    let splats: Vec<usize> = straight.history.iter().map(|p| p.splats).collect();
    let first = splats.iter().find(|n| **n > 0).unwrap();
    assert!(splats.last().unwrap() > first, "no density step was tested: {splats:?}");
    for stop_at in [(Phase::Warmup, 10), (Phase::Joint, 30)] {
        bench.assert_same(&straight, stop_at);
    }
}

/// Without a mesh, poses are optimised until the end.
#[test]
fn resumed_with_poses_and_without_a_mesh() {
    let options = TrainOptions { refine_poses: true, ..options(Density::Mcmc) };
    let bench = Bench::new(MeshSource::None, options);
    let straight = bench.run(false, None);
    assert!(straight.poses.iter().any(|(_, pose)| pose.degrees > 0.01), "no pose was refined");
    bench.assert_same(&straight, (Phase::Joint, 40));
}

#[test]
fn resumed_with_gradient_based_density() {
    resumes_in_both_phases(options(Density::Inria));
}

#[test]
fn resumed_with_absolute_gradients() {
    resumes_in_both_phases(options(Density::Absgs));
}

#[test]
fn resumed_with_mcmc() {
    // With exposures, which are part of the state too, and growing picture sizes.
    let options = TrainOptions { exposure: true, coarse_to_fine: true, ..options(Density::Mcmc) };
    resumes_in_both_phases(options);
}

/// Splats of which each is in nearly all tiles. Iterations with lists that are too short are repeated, so the list
/// lengths, which are large in a resumed run, must not matter.
#[test]
fn resumed_where_lists_were_too_short() {
    let options = TrainOptions { max_splats: Some(40), ..options(Density::Mcmc) };
    let mut bench = Bench::of_size(128, MeshSource::None, options);
    bench.capture.points.truncate(10);
    let straight = bench.run(false, None);
    assert!(straight.repeated_iterations > 0, "no list was too short");
    bench.assert_same(&straight, (Phase::Joint, 40));
}

#[test]
fn resumed_while_looking_for_a_surface() {
    // After the 30 iterations of the surface phase, 20 are left for the joint phase.
    // Poses are optimised before there is a surface, and are part of the state from then on.
    let options = TrainOptions { iterations: 50, warmup: 20, refine_poses: true, ..options(Density::Inria) };
    let bench = Bench::new(MeshSource::Splats, options);
    let straight = bench.run(false, None);
    assert!(straight.history.iter().any(|p| p.phase == Phase::Joint), "nothing is trained together");
    assert!(straight.selection.is_some(), "no triangle was judged");
    // During the warm-up, vertices are optimised.
    for stop_at in [(Phase::Surface, 10), (Phase::Warmup, 10), (Phase::Joint, 10)] {
        bench.assert_same(&straight, stop_at);
    }
}

/// The work after a phase takes time, and the last phase is followed by writing the scene: before that, the training
/// state is saved in a checkpoint.
#[test]
fn resumed_from_the_end_of_each_phase() {
    let options = TrainOptions {
        iterations: 50,
        refine_poses: true,
        exposure: true,
        checkpoint_every: 1000,
        ..options(Density::Mcmc)
    };
    let bench = Bench::new(MeshSource::Splats, options);
    let file = |name: &str| bench.folder.path().join(name);
    let (stop, phase) = (AtomicBool::new(false), Cell::new(Phase::Surface));
    let session = Session {
        gpu: &bench.gpu,
        checkpoints: Checkpoints::Save(file("checkpoint")),
        stop: &stop,
        progress: &mut |event| {
            let Event::Progress(p) = event else { return };
            if p.phase != phase.replace(p.phase) {
                std::fs::copy(file("checkpoint"), file(&format!("before-{:?}", p.phase))).unwrap();
            }
        },
    };
    let straight = train(&bench.capture, bench.mesh.clone(), &bench.options, session).unwrap();
    std::fs::copy(file("checkpoint"), file("at-the-end")).unwrap();
    // The remaining reports are those of the other phases.
    for (name, reports) in [("before-Warmup", 4), ("before-Joint", 2), ("at-the-end", 0)] {
        std::fs::copy(file(name), file("checkpoint")).unwrap();
        let resumed = bench.run(true, None);
        assert_eq!((resumed.outcome, bench.told.get()), (Outcome::Finished, reports), "{name}");
        assert!(straight.scene == resumed.scene && straight.cameras == resumed.cameras, "{name}: another scene");
        assert_eq!(straight.exposures, resumed.exposures, "{name}");
        assert_eq!((straight.surface, straight.selection), (resumed.surface, resumed.selection), "{name}");
    }
}

/// A surface is extracted and its maps are judged, but the budget has no room for them: the remaining result is that of
/// splats alone.
#[test]
fn a_run_that_keeps_no_mesh_is_one_without() {
    // Before density control ends, and so late that it would continue beside a mesh.
    for surface_iterations in [90, 150] {
        assert_keeps_nothing(surface_iterations);
    }
}

fn assert_keeps_nothing(surface_iterations: u32) {
    let options = TrainOptions {
        iterations: 220,
        surface_iterations: Some(surface_iterations),
        antialias: true,
        exposure: true,
        max_splats: None,
        max_floats: Some(16_000),
        ..options(Density::Mcmc)
    };
    let [with, without] =
        [MeshSource::Splats, MeshSource::None].map(|mesh| Bench::new(mesh, options.clone()).run(false, None));
    assert!(with.selection.is_some() && with.history.iter().any(|p| p.phase == Phase::Warmup), "no mesh was judged");
    assert!(without.scene.splats.len() > 650, "{} splats", without.scene.splats.len());
    assert!(with.scene == without.scene && with.exposures == without.exposures, "its splats are others");
}

/// Splats, a surface made of them, maps and vertices, on the command line: a second run gives the same file except for
/// measurements, even with other numbers of threads on the host and of a software adapter.
#[test]
fn a_seed_is_one_scene() {
    let folder = tempfile::tempdir().unwrap();
    let demo = demo().display().to_string();
    let flags = "--max-side 64 --iterations 90 --surface-iterations 40 --warmup 30 --max-floats 60000 --antialias --no-eval --quiet";
    let trained = |name: &str, threads: &str| {
        let output = common::centaur(folder.path())
            .args(["train", &demo, "-o", name])
            .args(flags.split(' '))
            .envs([("LP_NUM_THREADS", threads), ("RAYON_NUM_THREADS", threads)])
            .output()
            .unwrap();
        assert!(output.status.success(), "{}", common::stderr(&output));
        let bytes = std::fs::read(folder.path().join(name)).unwrap();
        let json = 20..20 + u32::from_le_bytes(bytes[12..16].try_into().unwrap()) as usize;
        let mut document: serde_json::Value = serde_json::from_slice(&bytes[json.clone()]).unwrap();
        for name in ["seconds_per_iteration", "training_seconds", "training_peak_gpu_bytes"] {
            let measured = document.pointer_mut(&format!("/asset/extras/centaur/{name}")).unwrap().take();
            assert!(measured.as_f64().unwrap() > 0.0, "{name}");
        }
        (document, bytes[json.end..].to_vec())
    };
    let expected = trained("a.glb", "2");
    assert!(expected.0["meshes"].as_array().unwrap().len() > 1, "there is no mesh beside the splats");
    assert!(trained("b.glb", "2") == expected, "another run");
    assert!(trained("c.glb", "1") == expected, "one thread");
}
