//! Interrupted and resumed training, in the library and by Ctrl-C, on the small capture of the repository.

use std::cell::Cell;
use std::fmt::Write as _;
#[cfg(unix)]
use std::io::{BufRead as _, BufReader};
use std::path::{Path, PathBuf};
#[cfg(unix)]
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};

use crate::common;
use centaur::capture::{self, Capture, Downscale, LoadOptions};
use centaur::format::mesh_import;
use centaur::geometry::Surface;
use centaur::optimize::{Checkpoints, Density, MeshSource, Outcome, Phase, Session, TrainOptions, Trained, train};
use centaur::render::gpu::Gpu;
use centaur::scene::Camera;
use glam::{DVec3, Vec3};

fn demo() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("demo")
}

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
            progress: &mut |p| {
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
        progress: &mut |p| {
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

/// With `--all-views` the scene learns from held-out views too, and scores carry a note.
#[test]
fn all_views_are_trained_on_if_asked_for() {
    let folder = tempfile::tempdir().unwrap();
    let capture = folder.path().join("capture");
    std::fs::create_dir(&capture).unwrap();
    // All photographs are grey except the first by name, which is held out and red.
    let frames: Vec<_> = (0..8)
        .map(|i| {
            let (sin, cos) = (0.1 * f64::from(i)).sin_cos();
            let color = if i == 0 { [200, 30, 30] } else { [90; 3] };
            image::RgbImage::from_pixel(24, 24, image::Rgb(color)).save(capture.join(format!("{i}.png"))).unwrap();
            let pose =
                [[cos, 0.0, sin, 3.0 * sin], [0.0, 1.0, 0.0, 0.0], [-sin, 0.0, cos, 3.0 * cos], [0.0, 0.0, 0.0, 1.0]];
            serde_json::json!({ "file_path": format!("{i}.png"), "transform_matrix": pose })
        })
        .collect();
    let write = |frames: &[serde_json::Value]| {
        let file = serde_json::json!({ "w": 24, "h": 24, "fl_x": 24.0, "frames": frames });
        std::fs::write(capture.join("transforms.json"), file.to_string()).unwrap();
    };
    let start = |line: &str| common::centaur(folder.path()).args(line.split(' ')).output().unwrap();
    let run = |line: &str| {
        let output = start(line);
        assert!(output.status.success(), "{line}: {}", common::stderr(&output));
        serde_json::from_slice::<serde_json::Value>(&output.stdout).unwrap()
    };
    write(&frames);
    let scored = |more: &str| {
        let flags = "--no-mesh --iterations 500 --max-splats 300 --quiet --json";
        let trained = run(&format!("train capture -o scene.glb {flags}{more}"));
        let scores = run("eval scene.glb capture --quiet --json");
        let says = scores["notes"].to_string().contains("trained on all views");
        let psnr = scores["views"][0]["psnr"].as_f64().unwrap();
        (trained["evaluation"].is_null(), trained["settings"]["split"].clone(), says, psnr)
    };
    let (is_null, split, says, without) = scored("");
    assert!(!is_null && split == "every8th" && !says);
    // Without the first, the second is held out, which was trained on.
    write(&frames[1..]);
    let notes = run("eval scene.glb capture --quiet --json")["notes"].to_string();
    assert!(notes.contains("trained on 1 of the 1 views that are scored"), "{notes}");
    write(&frames);
    let (is_null, split, says, with) = scored(" --all-views");
    assert!(is_null && split == "all" && says);
    assert!(with > without + 1.0, "{with} dB, {without} dB where it is held out");

    // Of two photographs one is held out, and the one left is not enough.
    write(&frames[..2]);
    let few = "train capture -o few.glb --no-mesh --iterations 5 --max-splats 50 --quiet";
    let said = common::stderr(&start(few));
    assert!(said.trim_end().ends_with("found 2 in all; --all-views holds none out"), "{said}");
    run(&format!("{few} --json --all-views"));
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

/// Ctrl-C in a terminal is SIGINT; a closing terminal causes hangups, by its shell and by itself, for all processes
/// except those run by `nohup`.
#[cfg(unix)]
#[test]
fn signals_leave_a_checkpoint_that_resume_finishes() {
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
        // 1,000 splats of 59 floats.
        "--budget-mb",
        "0.236",
        "--no-eval",
        "--json",
    ];
    // More iterations than any GPU can do while signals are on their way. The signals are not held back by a STOP: two
    // of one kind would be merged.
    let endless = ["--iterations", "1000000"];
    let files = || -> Vec<_> {
        std::fs::read_dir(folder.path()).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect()
    };
    // Under nohup a run continues after a hangup; otherwise the hangups of the shell, the terminal and the session's
    // end count as one request, and so do the two signals of `timeout`.
    let (nohup, hung_up) = ("trap '' HUP; exec \"$@\"", "exec \"$@\"");
    let mut runs = vec![(nohup, &["HUP", "INT"][..], 130, None), (hung_up, &["TERM", "TERM"], 143, Some("--resume"))];
    if cfg!(target_os = "linux") {
        // On other systems, hangups are heeded if stderr is a terminal.
        runs.push((hung_up, &["HUP", "HUP", "TERM"], 129, Some("--resume")));
    }
    for (shell, signals, code, resume) in runs {
        let mut command = Command::new("env");
        if cfg!(target_os = "linux") {
            // Tests may run under nohup.
            command.arg("--default-signal=HUP");
        }
        command.args(["sh", "-c", shell, "sh", env!("CARGO_BIN_EXE_centaur")]);
        command.current_dir(folder.path()).env("XDG_RUNTIME_DIR", std::env::temp_dir()).args(arguments);
        command.args(endless).args(resume);
        let mut child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        let mut lines = BufReader::new(child.stderr.take().unwrap()).lines().map(Result::unwrap);
        let line = lines.next().unwrap();
        assert!(line.starts_with(r#"{"progress":"#), "{line}");
        for &signal in signals {
            common::send(signal, &child.id().to_string());
            if shell == nohup && signal == "HUP" {
                // After a stop request there is only the note that it will stop.
                assert_eq!(lines.by_ref().take(5).count(), 5);
                assert_eq!(child.try_wait().unwrap(), None);
            }
        }
        // Reports are read on, so that the child does not block on a full pipe.
        let rest: Vec<String> = lines.collect();
        let output = child.wait_with_output().unwrap();
        assert_eq!(output.status.code(), Some(code), "{signals:?} {:?}", rest.last());
        // Once, immediately, and not on a line of progress.
        let is_heard =
            |line: &&String| line.starts_with("note: stopping after the current step, and keeping what is done;");
        assert_eq!(rest.iter().filter(is_heard).count(), 1, "{signals:?} {rest:?}");
        let outcome: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
        assert_eq!(outcome["outcome"], "interrupted");
        assert!(!outcome["notes"].to_string().contains("earlier run"), "{outcome}");
        assert_eq!(files(), ["scene.glb.checkpoint"]);
    }
    // A file left by an earlier run is named.
    std::fs::write(folder.path().join("scene.glb"), "of an earlier run").unwrap();
    let mut command = common::centaur(folder.path());
    let stopped = command.args(arguments).args(endless).args(["--resume", "--stop-at-eof"]);
    let stopped = stopped.stdin(Stdio::null()).output().unwrap();
    let outcome: serde_json::Value = serde_json::from_slice(&stopped.stdout).unwrap();
    let notes = outcome["notes"].to_string();
    assert_eq!(stopped.status.code(), Some(130));
    assert!(notes.contains("scene.glb: is still the scene of an earlier run"), "{notes}");
    std::fs::remove_file(folder.path().join("scene.glb")).unwrap();

    // A run that completes, which is asked to stop at its start.
    std::fs::remove_file(folder.path().join("scene.glb.checkpoint")).unwrap();
    let run = |more: &str, code: i32| -> serde_json::Value {
        let mut command = common::centaur(folder.path());
        command.args(arguments).args(["--iterations", "400", more]);
        let output = command.stdin(Stdio::null()).output().unwrap();
        assert_eq!(output.status.code(), Some(code), "{}", common::stderr(&output));
        serde_json::from_slice(&output.stdout).unwrap()
    };
    assert_eq!(run("--stop-at-eof", 130)["outcome"], "interrupted");
    assert_eq!(files(), ["scene.glb.checkpoint"]);
    let outcome = run("--resume", 0);
    assert_eq!(outcome["outcome"], "finished");
    assert_eq!(files(), ["scene.glb"]);
    assert_eq!(outcome["settings"]["max_floats"], 59_000);
    let scene = centaur::format::read_scene(&folder.path().join("scene.glb")).unwrap();
    assert_eq!(scene.splats.len(), 1000);
}

/// A forgotten --resume loses nothing, and photographs must not be changed in between.
#[test]
fn a_checkpoint_is_set_aside_or_gone_on_from_with_the_same_files() {
    let folder = tempfile::tempdir().unwrap();
    let capture = folder.path().join("capture");
    std::fs::create_dir_all(&capture).unwrap();
    let picture = |i: u32, shade: u8| {
        image::RgbImage::from_fn(24, 24, |x, y| image::Rgb([(x * y) as u8, shade, x as u8]))
            .save(capture.join(format!("{i}.png")))
            .unwrap();
    };
    let frame = |i: u32| {
        picture(i, 9);
        let pose = [[1.0, 0.0, 0.0, f64::from(i)], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 4.0], [0.0, 0.0, 0.0, 1.0]];
        serde_json::json!({ "file_path": format!("{i}.png"), "transform_matrix": pose })
    };
    let frames: Vec<_> = (0..4).map(frame).collect();
    let write = |more: serde_json::Value| {
        let mut file = serde_json::json!({ "w": 24, "h": 24, "fl_x": 24.0, "frames": frames });
        file.as_object_mut().unwrap().extend(more.as_object().unwrap().clone());
        std::fs::write(capture.join("transforms.json"), file.to_string()).unwrap();
    };
    write(serde_json::json!({}));
    let flags = "train capture --no-mesh --iterations 20 --checkpoint-every 10 --max-splats 50 -o scene.glb";
    let run = |more: &str| {
        let args = flags.split(' ').chain(more.split(' ').filter(|word| !word.is_empty()));
        let output = common::centaur(folder.path()).args(args).output().unwrap();
        (output.status.code(), common::stderr(&output), String::from_utf8(output.stdout).unwrap())
    };
    std::fs::create_dir_all(folder.path().join("report/report.html")).unwrap();
    assert_eq!(run("--report report --quiet").0, Some(1), "it leaves a checkpoint");
    let [checkpoint, aside] =
        ["scene.glb.checkpoint", "scene.glb.checkpoint.before-1"].map(|name| folder.path().join(name));
    let bytes = std::fs::read(&checkpoint).unwrap();

    let (code, _, said) = run("--no-eval --quiet --json");
    let said: serde_json::Value = serde_json::from_str(&said).unwrap();
    assert!(code == Some(0) && !checkpoint.exists() && std::fs::read(&aside).unwrap() == bytes, "{said}");
    assert!(said["notes"][2].as_str().unwrap().contains("was left by another run, and was renamed to"), "{said}");

    std::fs::rename(&aside, &checkpoint).unwrap();
    picture(2, 0);
    image::RgbImage::new(24, 24).save(capture.join("2.png")).unwrap();
    let (code, said, _) = run("--resume --no-eval --quiet");
    assert!(code == Some(1) && said.contains("of the same photographs"), "{said}");
    picture(2, 9);
    assert_eq!(run("--resume --no-eval --quiet").0, Some(0));

    // All that a capture lacks is reported before training.
    let notes = |more: &str| {
        let (code, error, said) = run(more);
        assert_eq!(code, Some(0), "{error}");
        let said: serde_json::Value = serde_json::from_str(&said).unwrap();
        assert!(said["evaluation"].is_null());
        said["notes"].as_array().unwrap().iter().map(|note| note.as_str().unwrap().to_owned()).collect::<Vec<_>>()
    };
    write(serde_json::json!({ "train_filenames": ["0.png", "1.png", "2.png", "3.png"] }));
    let all = notes("--masks --quiet --json");
    assert!(all[1].ends_with("has no masks: nothing is masked") && all[2].contains("holds out no view"), "{all:?}");
    assert!(all.len() == 5 && all[3].contains("was taken with +y up"), "{all:?}");
    assert_eq!(all[4], "scene.glb: exists, and will be replaced when this training is done");
    let (code, said, _) = run("--images images_4 --quiet");
    assert!(code == Some(1) && said.contains("/frames/0/file_path") && said.contains("begins with images/"), "{said}");
    let (code, said, _) = run("--max-splats 0");
    assert!(code == Some(2) && said.contains("from 1"), "{said}");
}

/// A failure after training must not lose the training.
#[test]
fn a_checkpoint_stays_until_all_is_written() {
    let folder = tempfile::tempdir().unwrap();
    let in_the_way = folder.path().join("report/report.html");
    std::fs::create_dir_all(&in_the_way).unwrap();
    let demo = demo().display().to_string();
    let flags = "--no-mesh --max-side 64 --max-splats 500 --iterations 20 --checkpoint-every 10 --quiet --report report -o scene.glb";
    let run = |more: &[&str]| {
        common::centaur(folder.path()).args(["train", &demo]).args(flags.split(' ')).args(more).output().unwrap()
    };
    let failed = run(&[]);
    assert_eq!(failed.status.code(), Some(1));
    assert!(common::stderr(&failed).contains("\nerror: scene.glb is written, but not its evaluation"));
    let checkpoint = folder.path().join("scene.glb.checkpoint");
    assert!(checkpoint.is_file());
    std::fs::remove_dir(in_the_way).unwrap();
    let resumed = run(&["--resume", "--json"]);
    assert!(resumed.status.success() && !checkpoint.exists(), "{}", common::stderr(&resumed));
    // Nothing was left to train: its time is known from the earlier run.
    let outcome: serde_json::Value = serde_json::from_slice(&resumed.stdout).unwrap();
    for of in [&outcome, &outcome["evaluation"]] {
        let [all, each] = ["training_seconds", "seconds_per_iteration"].map(|name| of[name].as_f64().unwrap());
        assert!(each > 0.0 && all > 20.0 * each, "{outcome}");
    }
}

/// If scoring fails, no results of another run remain; other files are reported.
#[test]
fn a_report_has_no_pictures_of_another() {
    let folder = tempfile::tempdir().unwrap();
    common::write_capture(&folder.path().join("capture"), 10, (48, 32));
    let at = |name: &str| folder.path().join(name);
    let run = |line: &str| {
        let output = common::centaur(folder.path()).args(line.split(' ')).output().unwrap();
        (output.status.code(), common::stderr(&output))
    };
    let score = || run("eval scene.glb capture -o report --quiet");
    let train = "train capture -o scene.glb --no-mesh --max-splats 50 --iterations 2 --report report --quiet";
    assert_eq!(run(train), (Some(0), String::new()));
    assert_eq!(score(), (Some(0), String::new()));
    // Without the first view, others are held out.
    let list = at("capture/sparse/0/images.txt");
    let views = std::fs::read_to_string(&list).unwrap();
    let note = |left: &str| {
        format!("note: report: has 2 pictures of an earlier report, of views that are not scored now: {left}\n")
    };
    std::fs::write(&list, views.split_once("\n\n").unwrap().1).unwrap();
    let (code, said) = run(train);
    assert!(code == Some(0) && said.contains(&note("000.png, 008.png")), "{said}");
    std::fs::write(&list, &views).unwrap();
    let (code, said) = score();
    assert!(code == Some(0) && said.contains(&note("001.png, 009.png")), "{said}");
    let all = ["000.png", "001.png", "008.png", "009.png"];
    let left = || -> Vec<_> {
        let entries = std::fs::read_dir(at("report")).unwrap().map(|entry| entry.unwrap().file_name());
        let mut names: Vec<_> = entries.map(|name| name.into_string().unwrap()).collect();
        names.sort();
        names
    };
    assert_eq!(left(), [&all[..], &["metrics.json", "report.html"]].concat());
    // The first of two views is scored, the second turns out to be broken after its header.
    let last = at("capture/images/008.png");
    let bytes = std::fs::read(&last).unwrap();
    std::fs::write(&last, &bytes[..bytes.len() / 2]).unwrap();
    let (code, said) = score();
    assert!(code == Some(1) && said.lines().last().unwrap().starts_with("error: "), "{said}");
    assert_eq!(left(), all);
}

/// Lines of progress on stderr.
fn progress(output: &std::process::Output) -> Vec<serde_json::Value> {
    let line = |line: &str| serde_json::from_str::<serde_json::Value>(line).unwrap()["progress"].take();
    common::stderr(output).lines().map(line).collect()
}

/// Also after training, from the scene's record.
#[test]
fn commands_say_how_far_they_are_and_evaluations_what_the_training_took() {
    let folder = tempfile::tempdir().unwrap();
    let demo = demo().display().to_string();
    let run = |command: &str, args: &str| {
        let mut centaur = common::centaur(folder.path());
        let output = centaur.args(command.split(' ').chain([&*demo]).chain(args.split(' '))).output().unwrap();
        assert!(output.status.success(), "{}", common::stderr(&output));
        output
    };
    let json = |output: &std::process::Output| serde_json::from_slice::<serde_json::Value>(&output.stdout).unwrap();
    let flags = "--no-mesh --max-side 64 --max-splats 500 --iterations 40 --eval-every 20 --json -o scene.glb";
    let training = run("train", flags);
    let (trained, told) = (json(&training), progress(&training));
    let views = trained["evaluation"]["views"].as_array().unwrap().len();
    assert!(views > 0 && trained["seconds_per_iteration"].as_f64().unwrap() > 0.0);

    let evaluation = run("eval scene.glb", "--max-side 64 --json -o scores");
    let (evaluated, scored) = (json(&evaluation), progress(&evaluation));
    assert_eq!(scored.len(), views);
    for (i, line) in scored.iter().enumerate() {
        assert_eq!((&line["phase"], &line["view"], &line["of"]), (&"scoring".into(), &(i + 1).into(), &views.into()));
        assert!(line["seconds"].as_f64().unwrap() >= 0.0);
    }
    assert_eq!(told.iter().filter(|line| line["phase"] == "scoring").count(), views, "as after training");
    for name in ["seconds_per_iteration", "training_seconds", "training_peak_gpu_bytes"] {
        assert!(trained[name].is_number(), "{name}: {trained}");
        assert_eq!((&evaluated[name], &trained["evaluation"][name]), (&trained[name], &trained[name]));
    }
    // Training needs gradients and moments in addition to the memory of rendering, which is the same directly after it
    // and later.
    let peak = &evaluated["peak_gpu_bytes"];
    assert_eq!(peak, &trained["evaluation"]["peak_gpu_bytes"]);
    assert!(peak.as_u64().unwrap() < trained["training_peak_gpu_bytes"].as_u64().unwrap(), "{peak}");
    let metrics = std::fs::read(folder.path().join("scores/metrics.json")).unwrap();
    let mut said = evaluated.clone();
    said.as_object_mut().unwrap().remove("notes");
    assert_eq!(serde_json::from_slice::<serde_json::Value>(&metrics).unwrap(), said);
    let report = || std::fs::read_to_string(folder.path().join("scores/report.html")).unwrap();
    for part in [
        "training time",
        "time per iteration",
        " MiB training<",
        "ssim weight",
        "aria-label=\"loss\"",
        "aria-label=\"held-out PSNR (dB)\"",
        "<polyline",
    ] {
        assert!(report().contains(part), "{part}");
    }

    // Splats alone do not contain the record.
    let mut convert = common::centaur(folder.path());
    assert!(convert.args(["convert", "scene.glb", "splats.ply", "--quiet"]).status().unwrap().success());
    let evaluation = run("eval splats.ply", "--max-side 64 --json --quiet -o scores");
    assert!(evaluation.stderr.is_empty() && json(&evaluation)["seconds_per_iteration"].is_null());
    assert!(!report().contains("<polyline") && !report().contains("ssim weight"));

    let rendering =
        common::centaur(folder.path()).args(["render", "scene.glb", "--json", "-o", "pictures"]).output().unwrap();
    let (pictures, told) = (json(&rendering)["pictures"].as_array().unwrap().len(), progress(&rendering));
    assert!(told.len() == pictures && told.iter().all(|line| line["phase"] == "rendering"), "{told:?}");

    let fusion = run("mesh scene.glb", "--max-side 64 --triangles 500 --texture-size 128 --json -o surface.glb");
    let (fused, told) = (json(&fusion), progress(&fusion));
    assert_eq!((fused["origin"].as_str(), told.len()), (Some("splats"), 48));
    assert!(told.iter().zip(1..).all(|(line, view)| line["phase"] == "fusing" && line["view"] == view), "{told:?}");
}

/// The demo has no tracks.
#[test]
fn what_a_surface_was_made_of_is_said() {
    let folder = tempfile::tempdir().unwrap();
    let demo = demo().display().to_string();
    let flags = "--max-side 64 --max-splats 1000 --iterations 20 --warmup 0 --triangles 500 --texture-size 64 --quiet --json -o scene.glb";
    // One of the notes is that the demo is z up.
    for (surface, origin, notes) in
        [(Some("points"), "guessed_points", 2), (Some("splats"), "splats", 1), (None, "splats", 1)]
    {
        let mut command = common::centaur(folder.path());
        let _ = std::fs::remove_file(folder.path().join("scene.glb"));
        command.args(["train", &demo, "--report", "report"]).args(flags.split(' '));
        let output = command.args(surface.map(|s| format!("--surface={s}"))).output().unwrap();
        assert!(output.status.success(), "{}", common::stderr(&output));
        let outcome: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
        assert_eq!((outcome["surface"].as_str(), outcome["notes"].as_array().unwrap().len()), (Some(origin), notes));
        let report = std::fs::read_to_string(folder.path().join("report/report.html")).unwrap();
        let words = if notes == 2 {
            "points of the capture, taken as visible where no nearer one hides them"
        } else {
            "fused depth of splats"
        };
        assert!(report.contains(words), "{surface:?}");
    }
}

#[test]
fn a_surface_is_compared_with_what_it_should_be() {
    let folder = tempfile::tempdir().unwrap();
    let demo = demo().display().to_string();
    let mesh = |args: &str| {
        let output = common::centaur(folder.path()).args(["mesh", &demo]).args(args.split(' ')).output().unwrap();
        assert_eq!(output.status.code(), Some(0), "{}", common::stderr(&output));
        String::from_utf8(output.stdout).unwrap()
    };
    let said = mesh("-o a.glb --triangles 3000 --quiet");
    let (last, written) = (said.lines().last().unwrap(), folder.path().join("a.glb"));
    let count = mesh_import::read(&written).unwrap().triangles.len();
    assert_eq!(last, format!("wrote a.glb: {count} triangles, {} bytes", written.metadata().unwrap().len()));
    let found: serde_json::Value =
        serde_json::from_str(&mesh("-o b.glb --truth a.glb --within 1e-4 --triangles 3000 --json")).unwrap();
    let of = |key: &str| found["truth"][key].as_f64().unwrap();
    assert!(of("accuracy") < 1e-6 && of("completeness") < 1e-6 && of("f_score") == 1.0, "{found}");
    assert!(of("counted") > 0.5 && of("counted") <= 1.0, "{found}");
    assert!(found["holes_closed"].as_u64().unwrap() > 0, "{found}");
    // The surface consists of what views see, except what was filled in around corners.
    let seen = found["atlas"]["seen"].as_f64().unwrap();
    assert!(seen > 0.8 && seen <= 1.0, "{found}");
    assert_eq!(of("chamfer"), 0.5 * (of("accuracy") + of("completeness")));
    // The same surface as a user's mesh: nothing to repair, fewer triangles, new charts.
    let own: serde_json::Value =
        serde_json::from_str(&mesh("--mesh a.glb -o c.glb --triangles 1000 --truth a.glb --json")).unwrap();
    let of_triangles = |json: &serde_json::Value, step: &str| json["triangles"][step].as_u64().unwrap();
    let (whole, read) = (of_triangles(&own, "cleaned"), of_triangles(&found, "simplified"));
    assert!(own["origin"] == "given" && of_triangles(&own, "extracted") == read && whole * 10 > read * 8, "{own}");
    let left = of_triangles(&own, "simplified");
    assert!((500..=1000).contains(&left) && own["truth"]["f_score"].as_f64().unwrap() > 0.9, "{own}");
    assert_eq!(mesh_import::read(&folder.path().join("c.glb")).unwrap().triangles.len() as u64, left);
    // If so few triangles cannot be reached, a note says so.
    let few: serde_json::Value = serde_json::from_str(&mesh("--mesh a.glb -o d.glb --triangles 1 --json")).unwrap();
    let (left, notes) = (of_triangles(&few, "simplified"), few["notes"].to_string());
    let said = format!("d.glb: {left} triangles remain, more than the 1 of --triangles: ");
    assert_eq!(notes.contains(&said), left > 1, "{notes}");
    assert_eq!(few["bytes"], folder.path().join("d.glb").metadata().unwrap().len());
    // Parts that no camera sees do not count: a square above all cameras, as large as the surface.
    let seen = mesh_import::read(&folder.path().join("a.glb")).unwrap();
    let area = |[a, b, c]: [Vec3; 3]| 0.5 * (b - a).cross(c - a).length();
    let side = seen.triangles.iter().map(|t| area(t.map(|i| seen.positions[i as usize]))).sum::<f32>().sqrt();
    let cameras: Vec<_> =
        capture::open(Path::new(&demo), &LoadOptions::default()).unwrap().views.iter().map(|v| v.camera).collect();
    let ahead: DVec3 = cameras.iter().map(|c| c.rotation().row(2)).sum();
    let ahead = ahead.normalize();
    let center = cameras.iter().map(Camera::center).sum::<DVec3>() / cameras.len() as f64 - 100.0 * ahead;
    let (x, y) = ahead.any_orthonormal_pair();
    let corners = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)];
    let corners = corners.map(|(u, v)| (center + f64::from(side) * (u * x + v * y)).as_vec3());
    let mut obj = String::new();
    for p in seen.positions.iter().chain(&corners) {
        writeln!(obj, "v {} {} {}", p.x, p.y, p.z).unwrap();
    }
    let first = u32::try_from(seen.positions.len()).unwrap();
    let square = [[first, first + 1, first + 2], [first, first + 2, first + 3]];
    for [a, b, c] in seen.triangles.iter().chain(&square) {
        writeln!(obj, "f {} {} {}", a + 1, b + 1, c + 1).unwrap();
    }
    std::fs::write(folder.path().join("more.obj"), obj).unwrap();
    let with_more: serde_json::Value =
        serde_json::from_str(&mesh("-o b.glb --triangles 3000 --truth more.obj --within 1e-4 --json")).unwrap();
    let counted = with_more["truth"]["counted"].as_f64().unwrap();
    assert!((counted - 0.5 * of("counted")).abs() < 0.01, "{found} {with_more}");
    assert!(with_more["truth"]["completeness"].as_f64().unwrap() < 1e-6, "{with_more}");
    let error = common::failure(
        folder.path(),
        common::centaur(folder.path()).args(["mesh", &demo, "-o", "c.glb", "--truth", "none.ply"]),
    );
    assert!(error.contains("none.ply: cannot read"), "{error}");
}
