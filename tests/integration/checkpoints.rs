//! Checkpoints of `centaur train` as a user meets them: left by a signal or a failure, resumed, set aside.

#[cfg(unix)]
use std::io::{BufRead as _, BufReader};
#[cfg(unix)]
use std::process::{Command, Stdio};

use crate::common::{self, demo};

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
        // On other systems, what `nohup` sets cannot be undone for the test.
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
            |line: &&String| line.starts_with(r#"{"note":"stopping after the current step, and keeping what is done;"#);
        let is_json = |line: &String| serde_json::from_str::<serde_json::Value>(line).is_ok();
        assert!(rest.iter().all(is_json), "{rest:?}");
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
    assert!(code == Some(1) && said.contains(": 4 of 4 images missing, the first is images_4"), "{said}");
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
