//! Training that is stopped and goes on, in the library and by Ctrl-C, on the small capture of the repository.

#![allow(clippy::unwrap_used, reason = "a failed unwrap is a failed test")]

mod common;

use std::io::{BufRead as _, BufReader};
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::sync::atomic::{AtomicBool, Ordering};

use centaur::capture::{self, Capture, Downscale, LoadOptions};
use centaur::geometry::Surface;
use centaur::optimize::{Density, MeshSource, Outcome, Phase, Progress, Session, TrainOptions, Trained, train};
use centaur::render::gpu::Gpu;
use glam::Vec3;

fn demo() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("demo")
}

fn options(density: Density) -> TrainOptions {
    TrainOptions {
        iterations: 90, // the fewest with a density step between those of warm-up and end
        warmup: 20,
        surface_iterations: 30,
        density,
        max_splats: 1500,
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
}

impl Bench {
    fn new(mesh: MeshSource, options: TrainOptions) -> Self {
        let small = LoadOptions { downscale: Downscale::MaxSide(64), ..LoadOptions::default() };
        let mut capture = capture::open(&demo(), &small).unwrap();
        // Fewer than `max_splats`, so that there is something to decide on.
        capture.points.truncate(700);
        Self { gpu: Gpu::open(None).unwrap(), capture, mesh, options, folder: tempfile::tempdir().unwrap() }
    }

    /// Trains, from the checkpoint on if `resume`, and asks for a stop at a report if there is a `stop_at`.
    fn run(&self, resume: bool, stop_at: Option<(Phase, u32)>) -> Trained {
        let stop = AtomicBool::new(false);
        let session = Session {
            gpu: &self.gpu,
            checkpoint: Some(self.folder.path().join("checkpoint")),
            resume,
            stop: &stop,
            progress: &mut |p| {
                if stop_at == Some((p.phase, p.iteration)) {
                    stop.store(true, Ordering::Relaxed);
                }
            },
        };
        train(&self.capture, self.mesh.clone(), &self.options, session).unwrap()
    }

    /// Asserts that a run that is stopped and resumed reports what `straight` reports.
    fn assert_same(&self, straight: &[Progress], stop_at: (Phase, u32)) {
        let first = self.run(false, Some(stop_at));
        assert_eq!(first.outcome, Outcome::Interrupted);
        let second = self.run(true, None);
        assert_eq!(second.outcome, Outcome::Finished);
        let begin = second.history[0];
        assert!(begin.phase == stop_at.0 && begin.iteration > stop_at.1, "nothing was resumed: {begin:?}");
        let mut reports = first.history.iter().chain(&second.history);
        for expected in straight {
            let found = reports.find(|p| (p.phase, p.iteration) == (expected.phase, expected.iteration)).unwrap();
            // The order in which the adapter adds gradients up is not fixed: with gradient-based density two runs of
            // the same thing differ by up to 3e-5 here, with MCMC by 3e-6.
            let difference = (found.loss - expected.loss).abs();
            assert!(difference < 1e-4, "stopped at {stop_at:?}: expected {expected:?}, found {found:?}");
            assert_eq!(found.splats, expected.splats, "stopped at {stop_at:?}: {expected:?}");
        }
    }
}

/// A table top: a mesh that is the same in every run.
fn square() -> MeshSource {
    let positions = [[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]].map(Vec3::from).to_vec();
    MeshSource::Given { surface: Surface { positions, triangles: vec![[0, 1, 2], [0, 2, 3]] }, corner_uvs: None }
}

fn resumes_in_both_phases(density: Density) {
    let bench = Bench::new(square(), options(density));
    let straight = bench.run(false, None);
    let splats: Vec<usize> = straight.history.iter().map(|p| p.splats).collect();
    assert!(splats.contains(&700) && *splats.last().unwrap() > 700, "no density step was tested: {splats:?}");
    for stop_at in [(Phase::Warmup, 10), (Phase::Joint, 30)] {
        bench.assert_same(&straight.history, stop_at);
    }
}

#[test]
fn resumed_with_gradient_based_density() {
    resumes_in_both_phases(Density::Inria);
}

#[test]
fn resumed_with_mcmc() {
    resumes_in_both_phases(Density::Mcmc);
}

/// Only up to the surface: simplification of the mesh decides by comparisons, so that two runs that differ in the last
/// bits of the splats get meshes that differ by some triangles, and losses afterwards by up to 6e-3.
#[test]
fn resumed_while_looking_for_a_surface() {
    let bench = Bench::new(MeshSource::Splats, TrainOptions { iterations: 10, warmup: 10, ..options(Density::Inria) });
    let straight = bench.run(false, None).history;
    let surface: Vec<Progress> = straight.into_iter().filter(|p| p.phase == Phase::Surface).collect();
    assert_eq!(surface.len(), 3);
    bench.assert_same(&surface, (Phase::Surface, 10));
}

/// Ctrl-C in a terminal is SIGINT.
#[cfg(unix)]
#[test]
fn ctrl_c_leaves_a_checkpoint_that_resume_finishes() {
    let folder = tempfile::tempdir().unwrap();
    let demo = demo().display().to_string();
    let arguments = [
        "train",
        &demo,
        "-o",
        "scene.glb",
        "--max-side",
        "64",
        "--no-mesh",
        "--max-splats",
        "1000",
        "--iterations",
        "200",
        "--no-eval",
        "--json",
    ];
    let mut child =
        common::centaur(folder.path()).args(arguments).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    let mut lines = BufReader::new(child.stderr.take().unwrap()).lines();
    let line = lines.next().unwrap().unwrap();
    assert!(line.starts_with(r#"{"progress":"#), "{line}");
    let sent = std::process::Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap();
    assert!(sent.success());
    // Reports are read on, so that the child does not wait for a full pipe.
    let last = lines.map(Result::unwrap).last();
    let output = child.wait_with_output().unwrap();
    assert_eq!(output.status.code(), Some(0), "{last:?}");
    let outcome: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(outcome["outcome"], "interrupted");
    let files = || -> Vec<_> {
        std::fs::read_dir(folder.path()).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect()
    };
    assert_eq!(files(), ["scene.glb.checkpoint"]);

    let output = common::centaur(folder.path()).args(arguments).arg("--resume").output().unwrap();
    assert_eq!(output.status.code(), Some(0), "{}", common::stderr(&output));
    let outcome: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(outcome["outcome"], "finished");
    assert_eq!(files(), ["scene.glb"]);
    centaur::format::read_scene(&folder.path().join("scene.glb")).unwrap();
}
