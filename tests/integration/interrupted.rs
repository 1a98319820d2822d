//! Results of Ctrl-C and of termination signals: complete files, under their old or their intended names.

use std::io::{BufRead as _, BufReader};
use std::os::unix::process::ExitStatusExt as _;
use std::path::Path;
use std::process::{Child, Stdio};
use std::time::Duration;

use crate::common;
use centaur::format::ply;
use centaur::scene::Splats;
use glam::{Quat, Vec3};

fn start(folder: &Path, arguments: &str) -> Child {
    let mut command = common::centaur(folder);
    command.args(arguments.split(' ')).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap()
}

/// Waits for a condition; returns whether it became true before the program ended.
fn wait_for(child: &mut Child, what: &str, mut is_so: impl FnMut() -> bool) -> bool {
    for _ in 0..60_000 {
        if is_so() {
            return true;
        }
        if child.try_wait().unwrap().is_some() {
            return false;
        }
        std::thread::sleep(Duration::from_millis(1));
    }
    panic!("{what}: not after a minute");
}

#[test]
fn what_was_being_written_is_gone() {
    let folder = tempfile::tempdir().unwrap();
    let n = 100_000;
    let splats = Splats::new(
        vec![Vec3::ONE; n],
        vec![Quat::IDENTITY; n],
        vec![Vec3::splat(-3.0); n],
        vec![0.5; n],
        3,
        vec![[0.1; 3]; 16 * n],
    );
    ply::write(&folder.path().join("in.ply"), &splats.unwrap()).unwrap();
    for (signal, number) in [("INT", 2), ("TERM", 15)] {
        // On a busy machine the program can finish before it receives the signal, and then says nothing of it.
        let ended = (0..20).find_map(|_| {
            let mut child = start(folder.path(), "convert in.ply out.usda");
            let is_writing = wait_for(&mut child, "a file in a temporary folder", || {
                common::tree(folder.path()).iter().filter(|path| path.contains(".centaur-")).count() > 1
            });
            if is_writing {
                common::send(signal, &child.id().to_string());
            }
            let status = child.wait().unwrap();
            if status.success() {
                std::fs::remove_file(folder.path().join("out.usda")).unwrap();
            }
            status.signal()
        });
        assert_eq!(ended, Some(number));
        assert_eq!(common::tree(folder.path()), [folder.path().join("in.ply").display().to_string()], "{signal}");
    }
}

/// Sends a signal when the first view has been scored or rendered, according to progress lines; returns the remaining
/// output and the exit code.
fn stopped(
    folder: &Path,
    arguments: &str,
    (phase, of): (&str, usize),
    signal: &str,
) -> (serde_json::Value, Option<i32>) {
    let mut command = common::centaur(folder);
    command.args(arguments.split(' ')).arg("--json").stdout(Stdio::piped()).stderr(Stdio::piped());
    let mut child = command.spawn().unwrap();
    let mut lines = BufReader::new(child.stderr.take().unwrap()).lines().map(Result::unwrap);
    let phase = format!(r#""phase":"{phase}""#);
    assert!(lines.any(|line| line.contains(&phase)), "{arguments}: nothing is begun");
    // Stopped, the program does not continue while the signal is on its way.
    for signal in ["STOP", signal, "CONT"] {
        common::send(signal, &child.id().to_string());
    }
    let views = 1 + lines.filter(|line| line.contains(&phase)).count();
    assert!(views < of, "{arguments}: all {views} are done");
    let output = child.wait_with_output().unwrap();
    (serde_json::from_slice(&output.stdout).unwrap(), output.status.code())
}

/// For termination as for Ctrl-C.
#[test]
fn scoring_and_rendering_stop_and_the_scene_stays() {
    let folder = tempfile::tempdir().unwrap();
    common::write_capture(&folder.path().join("capture"), 80, (640, 480));
    let train =
        "train capture -o scene.glb --no-mesh --iterations 1 --checkpoint-every 1 --eval-every 0 --max-splats 50";
    let (said, code) = stopped(folder.path(), train, ("scoring", 10), "TERM");
    assert_eq!(code, Some(143));
    let files = ["scene.glb", "scene.glb.checkpoint"];
    let expected = serde_json::json!({ "outcome": "interrupted", "scene": files[0], "checkpoint": files[1], "notes": said["notes"] });
    assert_eq!(said, expected);
    centaur::format::read_scene(&folder.path().join(files[0])).unwrap();
    assert!(folder.path().join(files[1]).is_file());
    assert!(!folder.path().join("scene.glb.lock").exists());

    // An earlier report stays as it was.
    let at = |name: &str| folder.path().join(name);
    std::fs::create_dir(at("scores")).unwrap();
    std::fs::write(at("scores/metrics.json"), "{}").unwrap();
    let (said, code) = stopped(folder.path(), "eval scene.glb capture -o scores", ("scoring", 10), "INT");
    assert_eq!((said["outcome"].as_str(), code), (Some("interrupted"), Some(130)), "{said}");
    let scored = said["views"].as_array().unwrap().len();
    assert!((1..10).contains(&scored) && said["of"] == 10 && said["output"] == "scores", "{said}");
    assert_eq!(common::tree(&at("scores")), [at("scores/metrics.json").display().to_string()]);
    assert_eq!(std::fs::read(at("scores/metrics.json")).unwrap(), b"{}");
    let (said, code) = stopped(folder.path(), "render scene.glb -o pictures", ("rendering", 80), "INT");
    assert_eq!((said["outcome"].as_str(), code), (Some("interrupted"), Some(130)), "{said}");
    assert_eq!(said["pictures"].as_array().unwrap().len(), common::tree(&at("pictures")).len());
    assert!(said["notes"].is_array(), "{said}");
}

/// Even if ffmpeg does not end by itself.
#[test]
fn a_film_that_is_stopped_is_none() {
    use std::os::unix::fs::PermissionsExt;
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let splats = Splats::new(vec![Vec3::ZERO], vec![Quat::IDENTITY], vec![Vec3::ZERO], vec![0.5], 0, vec![[0.1; 3]]);
    ply::write(&at("in.ply"), &splats.unwrap()).unwrap();
    std::fs::create_dir(at("bin")).unwrap();
    let script = "#!/bin/sh\n[ \"$1\" = -version ] && exit\nPATH=/usr/bin:/bin\n: >encoding\nexec sleep 60\n";
    std::fs::write(at("bin/ffmpeg"), script).unwrap();
    std::fs::set_permissions(at("bin/ffmpeg"), PermissionsExt::from_mode(0o755)).unwrap();
    let mut command = common::centaur(folder.path());
    command.args("render in.ply -o frames --max-side 32 --video film.mp4 --json --quiet".split(' '));
    command.env("PATH", at("bin")).stdout(Stdio::piped()).stderr(Stdio::null());
    let mut child = command.spawn().unwrap();
    assert!(wait_for(&mut child, "ffmpeg", || at("encoding").exists()), "it ended before");
    common::send("TERM", &child.id().to_string());
    let output = child.wait_with_output().unwrap();
    assert_eq!(output.status.code(), Some(143));
    let said: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!((said["outcome"].as_str(), said["pictures"].as_array().unwrap().len()), (Some("interrupted"), 8));
    let note = said["notes"][0].as_str().unwrap();
    assert!(note.starts_with("has no cameras: rendered from 8 places"), "{note}");
    let mut left: Vec<_> = std::fs::read_dir(folder.path()).unwrap().map(|e| e.unwrap().file_name()).collect();
    left.sort();
    assert_eq!(left, ["bin", "encoding", "frames", "in.ply"]);
}

/// The checkpoint is no longer needed once everything is written, and is removed even if nobody reads the output.
/// Output that cannot be printed is a failure, after which a run can be resumed.
#[test]
fn a_checkpoint_goes_with_whoever_reads_the_result() {
    let folder = tempfile::tempdir().unwrap();
    common::write_capture(&folder.path().join("capture"), 8, (48, 32));
    let checkpoint = folder.path().join("scene.glb.checkpoint");
    let train = |stdout: Stdio| {
        let mut command = common::centaur(folder.path());
        command.args("train capture -o scene.glb --no-mesh --iterations 1 --no-eval --quiet".split(' '));
        command.stdout(stdout).status().unwrap()
    };
    let (reader, writer) = std::io::pipe().unwrap();
    drop(reader);
    assert_eq!((train(writer.into()).code(), checkpoint.exists()), (Some(0), false));
    assert!(!folder.path().join("scene.glb.lock").exists());
    // Only Linux has a file that is always full.
    if let Ok(full) = std::fs::File::options().write(true).open("/dev/full") {
        assert_eq!((train(full.into()).code(), checkpoint.exists()), (Some(1), true));
        assert!(train(Stdio::null()).success());
    }
}

/// The first of two signals asks training to stop. Both are pending when it continues: between them it would have time
/// to finish.
#[test]
fn a_checkpoint_that_was_set_aside_is_back() {
    let folder = tempfile::tempdir().unwrap();
    common::write_capture(&folder.path().join("capture"), 8, (48, 32));
    let at = |name: &str| folder.path().join(name);
    std::fs::write(at("scene.glb.checkpoint"), "of another run").unwrap();
    let before = common::tree(folder.path());
    // Of a training that was killed.
    std::fs::write(at("scene.glb.lock"), "").unwrap();
    let arguments = "train capture -o scene.glb --no-mesh --iterations 1000000 --checkpoint-every 0";
    let mut child = start(folder.path(), arguments);
    let is_aside = wait_for(&mut child, "another name", || at("scene.glb.checkpoint.before-1").exists());
    assert!(is_aside, "it ended before");
    // Of the same output a second training would overwrite the checkpoint.
    std::os::unix::fs::symlink("scene.glb", at("link.glb")).unwrap();
    for output in ["./scene.glb", "link.glb"] {
        let mut second = common::centaur(folder.path());
        let line = common::failure(folder.path(), second.args(["train", "capture", "--no-mesh", "-o", output]));
        let expected = "another training is writing this scene: wait for its end, or give -o another name";
        assert_eq!(line, format!("error: {output}: {expected}"));
    }
    std::fs::remove_file(at("link.glb")).unwrap();
    for signal in ["STOP", "INT", "TERM", "CONT"] {
        common::send(signal, &child.id().to_string());
    }
    // The order of two pending signals is not defined.
    assert!(matches!(child.wait().unwrap().signal(), Some(2 | 15)));
    assert_eq!(common::tree(folder.path()), before);
    assert_eq!(std::fs::read(at("scene.glb.checkpoint")).unwrap(), b"of another run");
}
