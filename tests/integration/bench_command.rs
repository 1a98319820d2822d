//! `centaur bench` on a small data set: run once, continued, and listed for other runners.

use std::io::{BufRead as _, BufReader};
use std::path::Path;
#[cfg(target_os = "linux")]
use std::path::PathBuf;
use std::process::{Command, Output, Stdio};

#[cfg(target_os = "linux")]
use crate::common;
#[cfg(target_os = "linux")]
use centaur::optimize::checkpoint::Checkpoint;

const COARSE: &str = "--max-side 48 --iterations 20 --surface-iterations 10 --warmup 10 --triangles 500 --texture-size 64 --max-splats 2000";

fn centaur(folder: &Path) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_centaur"));
    command.current_dir(folder);
    command
}

fn bench(folder: &Path, more: &[&str], flags: &str) -> Output {
    let mut command = centaur(folder);
    command.args(["bench", "scenes", "-o", "out", "--variant", "hybrid", "--variant", "splats=--no-mesh"]);
    command.args(more).arg("--").args(flags.split(' ')).output().unwrap()
}

/// A capture whose files are there, but which has no cameras.
fn no_cameras(folder: &Path) {
    std::fs::create_dir_all(folder.join("sparse/0")).unwrap();
    std::fs::write(folder.join("sparse/0/cameras.bin"), []).unwrap();
}

fn said(output: &Output) -> (String, String) {
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    (text(&output.stdout), text(&output.stderr))
}

#[test]
fn a_data_set_is_trained_once_and_tabled() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    std::fs::create_dir(at("scenes")).unwrap();
    for scene in ["one", "two"] {
        std::os::unix::fs::symlink(Path::new(env!("CARGO_MANIFEST_DIR")).join("demo"), at("scenes").join(scene))
            .unwrap();
    }
    let refused = bench(folder.path(), &["--scenes", "three"], COARSE);
    assert_eq!(refused.status.code(), Some(1));
    assert_eq!(said(&refused).1, "error: scenes: expected a scene `three`, found one, two\n");

    let (list, _) = said(&bench(folder.path(), &["--list"], COARSE));
    assert_eq!(list.lines().count(), 4);
    let (part, _) = said(&bench(folder.path(), &["--list", "--shard", "1/2"], COARSE));
    assert_eq!(part.lines().collect::<Vec<_>>(), list.lines().skip(1).step_by(2).collect::<Vec<_>>());
    assert!(!at("out").exists(), "a list does nothing");

    // One job, as run by a scheduler; then the rest.
    let job = list.lines().find(|line| line.contains("splats/two-0")).unwrap();
    std::fs::write(at("list"), format!("{job}\n")).unwrap();
    let each = "tr '\\n' '\\0' < list | xargs -0 -n 1 -P 4 sh -c";
    let one = Command::new("sh").args(["-c", each]).current_dir(folder.path()).output().unwrap();
    assert!(one.status.success(), "{:?}", said(&one));
    assert!(said(&one).0.contains("| splats | two | 1 |") && !said(&one).0.contains("hybrid"), "{:?}", said(&one));
    let made = |name: &str| -> serde_json::Value {
        serde_json::from_slice(&std::fs::read(at(&format!("out/{name}.json"))).unwrap()).unwrap()
    };
    assert_eq!(made("splats/two-0")["job"]["at_a_time"], 0, "others may have been beside it");
    let written = at("out/splats/two-0.glb").metadata().unwrap().modified().unwrap();
    let rest = bench(folder.path(), &["--jobs", "2"], COARSE);
    let (table, _) = said(&rest);
    assert!(rest.status.success(), "{:?}", said(&rest));
    let idle = "--no-mesh: --surface-iterations, --triangles, --warmup, --texture-size have no effect";
    let note = format!("\n- splats, all scenes: {idle}\n");
    for row in ["| hybrid | one | 1 |", "| hybrid | two | 1 |", "| **splats** | **mean** | 2 |", &note] {
        assert!(table.contains(row), "{table}");
    }
    assert!(said(&rest).1.contains(&format!("note: splats/one-0: {idle}\n")), "{:?}", said(&rest));
    // The demo has z up, which matters to who looks at the scenes.
    assert!(!table.contains(" up: ") && !said(&rest).1.contains(" up: "), "{:?}", said(&rest));
    assert!(made("splats/one-0")["notes"].to_string().contains("was taken with +z up: "));
    assert_eq!(std::fs::read_to_string(at("out/table.md")).unwrap(), table);
    assert_eq!(at("out/splats/two-0.glb").metadata().unwrap().modified().unwrap(), written, "it was trained again");
    assert!(at("out/hybrid/one-0/report.html").is_file());
    let done = bench(folder.path(), &["--list"], COARSE);
    assert!(done.status.success() && said(&done).0.is_empty(), "{:?}", said(&done));

    for own in ["-o s.glb", "-os.glb", "--seed=7"] {
        let mut command = centaur(folder.path());
        let output = command.args(["bench", "scenes", "-o", "new", "--"]).args(own.split(' ')).output().unwrap();
        let message = said(&output).1;
        assert!(message.contains("expected none that every job has of its own"), "{message}");
    }
    assert!(!at("new").exists());

    // Results made with other flags are neither used nor overwritten.
    let other = bench(folder.path(), &["--list"], "--max-side 32");
    let message = said(&other).1;
    assert!(
        message
            .starts_with("error: out/hybrid/one-0.json: expected a result of the flags `--max-side 32`, found `--max-"),
        "{message}"
    );
    let other = bench(folder.path(), &["--protocol", "a"], "--iterations 20");
    assert_eq!(said(&other).1, "error: out/hybrid/one-0.json: expected a result of --protocol a, found none\n");
    let other = bench(folder.path(), &["--protocol", "a", "--table"], COARSE);
    assert_eq!(said(&other).1, "error: out/hybrid/one-0.json: expected a result of --protocol a, found none\n");

    // Nor are results in the wrong place, files that are no results, or results of another capture.
    let place = at("out/hybrid/one-0.json");
    let whole = std::fs::read(&place).unwrap();
    let refused = || said(&bench(folder.path(), &["--list"], COARSE)).1;
    std::fs::create_dir(at("out/copy")).unwrap();
    std::fs::write(at("out/copy/one-0.json"), &whole).unwrap();
    let expected = "error: out/copy/one-0.json: expected a result of this place, found that of out/hybrid/one-0.json\n";
    assert_eq!(refused(), expected);
    std::fs::remove_dir_all(at("out/copy")).unwrap();
    let mut elsewhere: serde_json::Value = serde_json::from_slice(&whole).unwrap();
    elsewhere["job"]["capture"] = (elsewhere["job"]["capture"].as_u64().unwrap() ^ 1).into();
    let elsewhere = elsewhere.to_string();
    for (text, expected) in [
        ("{}", "not the result of a training; delete it to repeat the job\n"),
        (
            "{",
            "not the result of a training; delete it to repeat the job: EOF while parsing an object at line 1 column 1\n",
        ),
        (
            &elsewhere,
            "expected a result of scenes/one, found that of other cameras, photographs, masks or points: give -o another folder\n",
        ),
    ] {
        std::fs::write(&place, text).unwrap();
        assert_eq!(refused(), format!("error: out/hybrid/one-0.json: {expected}"));
    }
    std::fs::write(&place, &whole).unwrap();
    // Results of earlier versions also contain scene flags that were overridden.
    let mut replaced: serde_json::Value = serde_json::from_slice(&whole).unwrap();
    replaced["job"]["scene_flags"] = ["--iterations", "7"].into();
    std::fs::write(&place, replaced.to_string()).unwrap();
    assert_eq!(refused(), "");
    replaced["job"]["scene_flags"] = ["--lambda", "7"].into();
    std::fs::write(&place, replaced.to_string()).unwrap();
    assert!(refused().contains("of the flags of one in scenes.json"), "{}", refused());
    std::fs::write(&place, &whole).unwrap();
    // Files without the name of a result are ignored.
    std::fs::write(at("out/hybrid/notes.json"), "{").unwrap();
    assert_eq!(refused(), "");
    // Another variant may use other photographs.
    let mut small: serde_json::Value = serde_json::from_slice(&whole).unwrap();
    let of_small = centaur::capture::fingerprint(&at("scenes/one"), Some("small")).unwrap();
    assert_ne!(Some(of_small.unwrap().into()), small["job"]["capture"].as_u64());
    let changed = [("variant", "small".into()), ("flags", ["--images", "small"].into()), ("capture", of_small.into())];
    for (key, value) in changed {
        small["job"][key] = value;
    }
    std::fs::create_dir(at("out/small")).unwrap();
    std::fs::write(at("out/small/one-0.json"), small.to_string()).unwrap();
    assert_eq!(refused(), "");
    std::fs::remove_dir_all(at("out/small")).unwrap();

    // A shard may contain no job at all, both before and after any job is done.
    for out in ["out", "nowhere"] {
        let empty = centaur(folder.path())
            .args(["bench", "scenes", "-o", out, "--shard", "7/8", "--"])
            .args(COARSE.split(' '))
            .output();
        let empty = empty.unwrap();
        assert!(empty.status.success(), "{:?}", said(&empty));
    }

    // A failing job is named with its reason; finished results stay and are tabulated.
    std::fs::remove_file(at("out/hybrid/one-0.json")).unwrap();
    std::fs::remove_file(at("scenes/one")).unwrap();
    no_cameras(&at("scenes/one"));
    std::fs::remove_file(at("out/table.md")).unwrap();
    let failed = bench(folder.path(), &["--quiet"], COARSE);
    assert_eq!(failed.status.code(), Some(1));
    let (table, messages) = said(&failed);
    let lines: Vec<&str> = messages.lines().collect();
    assert!(lines[0].starts_with("hybrid/one-0: ") && lines[0].ends_with("(exit status: 1)"), "{messages}");
    assert_eq!(lines[1], format!("error: 1 of 1 jobs failed, first {}", lines[0]));
    assert!(table.contains("| hybrid | two | 1 |") && at("out/table.md").is_file());
    // The table can be made from results alone.
    std::fs::remove_dir_all(at("scenes")).unwrap();
    let alone = centaur(folder.path()).args(["bench", "scenes", "-o", "out", "--table"]).output().unwrap();
    assert_eq!(said(&alone).0, table);
}

/// Seconds per iteration cover all runs of a job, one of which may have run beside others.
#[test]
#[cfg(target_os = "linux")]
fn jobs_that_ran_beside_others_before_have_no_times() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    std::fs::create_dir(at("scenes")).unwrap();
    std::fs::create_dir_all(at("out/default")).unwrap();
    let flags = ["--no-mesh", "--max-side", "32", "--iterations", "4", "--max-splats", "200"];
    for (scene, before, at_a_time) in [("alone", 1, 1), ("beside", 2, 0)] {
        let demo = Path::new(env!("CARGO_MANIFEST_DIR")).join("demo");
        std::os::unix::fs::symlink(demo, at("scenes").join(scene)).unwrap();
        let mut begun = centaur(folder.path());
        begun.args(["train", &format!("scenes/{scene}"), "-o", &format!("out/default/{scene}-0.glb"), "--stop-at-eof"]);
        let begun = begun.args(flags).stdin(Stdio::null()).output().unwrap();
        assert!(said(&begun).0.starts_with("stopped; saved "), "{:?}", said(&begun));
        std::fs::write(at(&format!("out/default/{scene}-0.lock")), format!("jobs at a time: {before}\n")).unwrap();
        let mut command = centaur(folder.path());
        let done = command.args(["bench", "scenes", "-o", "out", "--quiet", "--"]).args(flags).output().unwrap();
        assert!(done.status.success(), "{:?}", said(&done));
        let result = std::fs::read(at(&format!("out/default/{scene}-0.json"))).unwrap();
        let result: serde_json::Value = serde_json::from_slice(&result).unwrap();
        assert_eq!(result["job"]["at_a_time"], at_a_time, "{scene}");
    }
}

/// A stopped job is not continued with other flags; the message says how to start it anew.
#[test]
fn a_stopped_job_with_other_flags_names_a_way_out() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    std::fs::create_dir(at("scenes")).unwrap();
    std::fs::create_dir_all(at("out/default")).unwrap();
    std::os::unix::fs::symlink(Path::new(env!("CARGO_MANIFEST_DIR")).join("demo"), at("scenes/one")).unwrap();
    let flags = ["--no-mesh", "--max-side", "32", "--max-splats", "200", "--iterations"];
    let mut begun = centaur(folder.path());
    begun.args(["train", "scenes/one", "-o", "out/default/one-0.glb", "--stop-at-eof"]).args(flags).arg("9");
    let begun = begun.stdin(Stdio::null()).output().unwrap();
    assert!(said(&begun).0.starts_with("stopped; saved "), "{:?}", said(&begun));
    let bench = || {
        let mut command = centaur(folder.path());
        command.args(["bench", "scenes", "-o", "out", "--quiet", "--"]).args(flags).arg("4").output().unwrap()
    };
    let refused = bench();
    let expected = "default/one-0: out/default/one-0.glb.checkpoint: expected a checkpoint of a run with the same options, but iterations was \
                    9 and is now 4: delete that file to do the job anew, or give the variant another name (exit status: 1)";
    assert_eq!(said(&refused).1.lines().next(), Some(expected));
    std::fs::remove_file(at("out/default/one-0.glb.checkpoint")).unwrap();
    let done = bench();
    assert!(done.status.success(), "{:?}", said(&done));
}

/// Runs `bench.sbatch` in each task of an array, with the variables that Slurm sets; `--list` replaces trainings.
#[test]
#[cfg(target_os = "linux")]
fn tasks_of_slurm_do_every_job_once() {
    use std::os::unix::fs::PermissionsExt as _;
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    for scene in ["one", "two", "three"] {
        no_cameras(&at("scenes").join(scene));
    }
    // No GPU is assigned, so the Python script has nothing to print.
    std::fs::create_dir(at("bin")).unwrap();
    std::fs::write(at("bin/python3"), "#!/bin/sh\n").unwrap();
    std::fs::set_permissions(at("bin/python3"), std::fs::Permissions::from_mode(0o755)).unwrap();
    let path = format!("{}:{}", at("bin").display(), std::env::var("PATH").unwrap());
    let options = ["scenes", "-o", "out", "--seeds", "0,1,2", "--variant", "a", "--variant", "b=--no-mesh", "--list"];
    let flags = ["--", "--antialias"];
    let all = said(&centaur(folder.path()).arg("bench").args(options).args(flags).output().unwrap()).0;
    let root = env!("CARGO_MANIFEST_DIR");
    let mut listed = vec![];
    for task in 0..4 {
        let mut command = Command::new("bash");
        command.current_dir(folder.path()).arg(format!("{root}/datasets-scripts/bench.sbatch"));
        command.args(options).args(flags).env("PATH", &path);
        command.env("SLURM_SUBMIT_DIR", root).env("CENTAUR_PROGRAM", env!("CARGO_BIN_EXE_centaur"));
        for (name, value) in [("ID", task), ("MIN", 0), ("MAX", 3), ("COUNT", 4)] {
            command.env(format!("SLURM_ARRAY_TASK_{name}"), value.to_string());
        }
        let output = command.output().unwrap();
        assert!(output.status.success(), "{:?}", said(&output));
        listed.extend(said(&output).0.lines().map(str::to_owned));
    }
    let mut expected: Vec<_> = all.lines().collect();
    assert_eq!(expected.len(), 18);
    expected.sort_unstable();
    listed.sort_unstable();
    assert_eq!(listed, expected);
}

#[test]
fn programs_are_told_in_json() {
    let folder = tempfile::tempdir().unwrap();
    no_cameras(&folder.path().join("scenes/one"));
    let mut command = centaur(folder.path());
    // Mesa prints warnings if this is not set.
    command.env("XDG_RUNTIME_DIR", std::env::temp_dir()).args(["bench", "scenes", "-o", "out", "--json"]);
    let output = command.output().unwrap();
    let (_, lines) = said(&output);
    let mut lines: Vec<&str> = lines.lines().collect();
    assert!(lines.pop().unwrap().starts_with("error: 1 of 1 jobs failed, first default/one-0: "));
    let told: Vec<serde_json::Value> = lines.iter().map(|line| serde_json::from_str(line).unwrap()).collect();
    let [note, progress] = &told[..] else { panic!("{lines:?}") };
    assert!(note["note"].as_str().unwrap().starts_with("default/one-0: "), "{note}");
    let progress = &progress["progress"];
    let job = (&progress["job"], &progress["of"], &progress["name"], &progress["outcome"]);
    assert_eq!(job, (&1.into(), &1.into(), &"default/one-0".into(), &"failed".into()), "{progress}");
}

/// Jobs held by another runner are distinguished from finished ones, and run if that runner leaves them undone.
#[test]
fn jobs_of_another_runner_have_an_exit_code_and_can_be_waited_for() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    no_cameras(&at("scenes/one"));
    std::fs::create_dir_all(at("out/default")).unwrap();
    let lock = std::fs::File::create(at("out/default/one-0.lock")).unwrap();
    lock.lock().unwrap();
    let bench = |more: &[&str]| {
        let mut command = centaur(folder.path());
        command.args(["bench", "scenes", "-o", "out", "--quiet"]).args(more).stderr(Stdio::piped());
        command
    };
    let all = bench(&[]).output().unwrap();
    assert!(all.status.success(), "{:?}", said(&all));
    assert_eq!(said(&all).1, "note: 1 job left to another runner, first default/one-0\n");
    let left = "error: 1 job left to another runner, first default/one-0: the same command does what that runner leaves undone\n";
    for part in [["--only", "default/one-0"], ["--shard", "0/1"], ["--wait", "1"]] {
        let part = bench(&part).output().unwrap();
        assert_eq!(part.status.code(), Some(3), "{:?}", said(&part));
        assert!(said(&part).1.ends_with(left), "{:?}", said(&part));
    }
    let mut waiting = bench(&["--wait", "600"]).spawn().unwrap();
    let mut lines = BufReader::new(waiting.stderr.take().unwrap()).lines().map(Result::unwrap);
    assert_eq!(lines.next().unwrap(), "note: 1 job left to another runner: waiting for at most 600 s");
    drop(lock);
    // The capture has no cameras, which shows that the job was attempted.
    assert!(lines.last().unwrap().starts_with("error: 1 of 1 jobs failed, first default/one-0: "));
    assert_eq!(waiting.wait().unwrap().code(), Some(1));
}

/// A runner whose training does not end.
#[cfg(target_os = "linux")]
fn endless(folder: &Path) -> std::process::Child {
    let flags = "--no-mesh --max-side 64 --iterations 1000000 --max-splats 1000 --checkpoint-every 0 --eval-every 0";
    // If tests run under nohup, a hangup would not end any process that they start.
    let mut command = Command::new("env");
    command.args(["--default-signal=HUP", env!("CARGO_BIN_EXE_centaur")]);
    command.current_dir(folder).env("XDG_RUNTIME_DIR", std::env::temp_dir());
    command.args(["bench", "scenes", "-o", "out", "--quiet", "--"]).args(flags.split(' '));
    command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap()
}

#[cfg(target_os = "linux")]
fn wait_for(what: &str, mut is_so: impl FnMut() -> bool) {
    for _ in 0..1200 {
        if is_so() {
            return;
        }
        std::thread::sleep(std::time::Duration::from_millis(100));
    }
    panic!("{what}: not after two minutes");
}

/// Processes of trainings in `folder`; processes that are ending have no arguments.
#[cfg(target_os = "linux")]
fn trainings(folder: &Path) -> Vec<String> {
    let folder = folder.canonicalize().unwrap();
    let processes = std::fs::read_dir("/proc").unwrap().map(|entry| entry.unwrap().path());
    let is_ours = |process: &PathBuf| {
        std::fs::read_link(process.join("cwd")).is_ok_and(|cwd| cwd == folder)
            && std::fs::read(process.join("cmdline"))
                .is_ok_and(|arguments| arguments.split(|c| *c == 0).any(|argument| argument == b"train"))
    };
    processes.filter(is_ours).map(|process| process.file_name().unwrap().to_str().unwrap().to_owned()).collect()
}

/// Whether nobody holds the lock. A process without arguments, or a zombie, may still hold it: its other threads end
/// later.
#[cfg(target_os = "linux")]
fn is_free(lock: &Path) -> bool {
    std::fs::OpenOptions::new().write(true).open(lock).unwrap().try_lock().is_ok()
}

/// Whether the process can already be asked to stop: one of its threads waits for the end of stdin.
#[cfg(target_os = "linux")]
fn can_be_asked(process: &str) -> bool {
    let threads = std::fs::read_dir(format!("/proc/{process}/task")).into_iter().flatten().flatten();
    let mut names = threads.filter_map(|thread| std::fs::read_to_string(thread.path().join("comm")).ok());
    names.any(|name| name.trim() == "end of stdin")
}

/// Neither an interrupt to this process alone, nor a hangup to all, nor the end of this process leaves a training
/// behind, and no two processes train the same job.
#[test]
#[cfg(target_os = "linux")]
fn no_training_is_left_behind_or_done_twice() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    std::fs::create_dir(at("scenes")).unwrap();
    std::os::unix::fs::symlink(Path::new(env!("CARGO_MANIFEST_DIR")).join("demo"), at("scenes/one")).unwrap();
    let is_left_to_another = || {
        let second = endless(folder.path()).wait_with_output().unwrap();
        assert!(second.status.success() && said(&second).1.contains("another runner"), "{:?}", said(&second));
    };
    let mut before = 0;
    for signal in ["INT", "HUP", "KILL"] {
        let mut runner = endless(folder.path());
        wait_for("a training", || {
            assert_eq!(runner.try_wait().unwrap(), None, "{signal}: the runner ended before it trained");
            trainings(folder.path()).len() == 1
        });
        is_left_to_another();
        let training = trainings(folder.path()).pop().unwrap();
        match signal {
            "HUP" => {
                wait_for("a training that can be asked to stop", || can_be_asked(&training));
                common::send("HUP", &training);
            }
            "KILL" => common::send("STOP", &training),
            _ => {}
        }
        common::send(signal, &runner.id().to_string());
        let ended = runner.wait_with_output().unwrap();
        let lock = std::fs::read_to_string(at("out/default/one-0.lock")).unwrap();
        assert!(lock.starts_with("jobs at a time: 1\n"), "{lock}");
        if signal == "INT" {
            let heard = "note: stopping after the current step, and keeping what is done; a second time ends at once\n";
            assert_eq!(said(&ended).1, format!("{heard}note: stopped; the same command goes on\n"));
            assert_eq!(ended.status.code(), Some(130));
        } else if signal == "KILL" {
            // The training outlives its runner, and continues.
            is_left_to_another();
            common::send("CONT", &training);
        }
        wait_for("the end of the training", || is_free(&at("out/default/one-0.lock")));
        // Checkpoints are written only when a run ends, and each run does at least one iteration.
        let checkpoint = Checkpoint::read(&at("out/default/one-0.glb.checkpoint")).unwrap();
        let iteration = checkpoint.meta["iteration"].as_u64().unwrap();
        assert!(iteration > before, "{signal}: expected more than {before} iterations, found {iteration}");
        before = iteration;
    }
}
