//! `centaur bench` on a small data set: done once, gone on with, listed for others.

#![allow(clippy::unwrap_used, reason = "a failed unwrap is a failed test")]

use std::path::Path;
use std::process::{Command, Output};

const COARSE: &str = "--max-side 48 --iterations 20 --surface-iterations 10 --warmup 10 --triangles 500 --texture-size 64 --max-splats 2000";

fn bench(folder: &Path, more: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_centaur"));
    command.current_dir(folder).args([
        "bench",
        "scenes",
        "-o",
        "out",
        "--variant",
        "hybrid",
        "--variant",
        "splats=--no-mesh",
    ]);
    command.args(more).arg("--").args(COARSE.split_whitespace()).output().unwrap()
}

fn said(output: &Output) -> (String, String) {
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    (text(&output.stdout), text(&output.stderr))
}

#[test]
#[cfg(unix)]
fn a_data_set_is_trained_once_and_tabled() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    std::fs::create_dir(at("scenes")).unwrap();
    for scene in ["one", "two"] {
        std::os::unix::fs::symlink(Path::new(env!("CARGO_MANIFEST_DIR")).join("demo"), at("scenes").join(scene))
            .unwrap();
    }
    let refused = bench(folder.path(), &["--scenes", "three"]);
    assert_eq!(refused.status.code(), Some(1));
    assert_eq!(said(&refused).1, "error: scenes: expected a scene `three`, found one, two\n");

    let (list, _) = said(&bench(folder.path(), &["--list"]));
    assert_eq!(list.lines().count(), 4);
    assert!(!at("out").exists(), "a list does nothing");

    // One job, as a scheduler would do it; then the rest.
    let job = list.lines().find(|line| line.contains("splats/two-0")).unwrap();
    let one = Command::new("sh").args(["-c", job]).current_dir(folder.path()).output().unwrap();
    assert!(one.status.success(), "{:?}", said(&one));
    assert!(said(&one).0.contains("| splats | two | 1 |") && !said(&one).0.contains("hybrid"), "{:?}", said(&one));
    let written = at("out/splats/two-0.glb").metadata().unwrap().modified().unwrap();
    let rest = bench(folder.path(), &["--jobs", "2"]);
    let (table, _) = said(&rest);
    assert!(rest.status.success(), "{:?}", said(&rest));
    for row in ["| hybrid | one | 1 |", "| hybrid | two | 1 |", "| **splats** | **mean** | 2 |"] {
        assert!(table.contains(row), "{table}");
    }
    assert_eq!(std::fs::read_to_string(at("out/table.md")).unwrap(), table);
    assert_eq!(at("out/splats/two-0.glb").metadata().unwrap().modified().unwrap(), written, "it was trained again");
    assert!(at("out/hybrid/one-0/report.html").is_file());
    assert_eq!(said(&bench(folder.path(), &["--list"])).0, "");

    // A job that fails is named with its reason; what is done stays.
    std::fs::remove_file(at("out/hybrid/one-0.json")).unwrap();
    std::fs::remove_file(at("scenes/one")).unwrap();
    std::fs::create_dir_all(at("scenes/one/sparse/0")).unwrap();
    let failed = bench(folder.path(), &[]);
    assert_eq!(failed.status.code(), Some(1));
    assert!(said(&failed).1.starts_with("error: 1 of 1 jobs failed, first hybrid/one-0: "), "{:?}", said(&failed));
    assert!(said(&bench(folder.path(), &["--table"])).0.contains("| hybrid | two | 1 |"));
}
