//! Machines that lack what a run needs: adapters, threads, open files, folders that take files.

#[cfg(unix)]
use std::process::Command;

use crate::bad_input::{folder_with_capture, train};
#[cfg(target_os = "linux")]
use crate::common::centaur;
use crate::common::failure;
#[cfg(unix)]
use crate::common::stderr;

#[cfg(target_os = "linux")]
#[test]
fn folders_that_take_no_files() {
    let folder = folder_with_capture(3);
    let mut command = centaur(folder.path());
    command.args(["train", "capture", "-o", "/proc/scene.glb", "--quiet"]);
    let line = failure(folder.path(), &mut command);
    assert!(line.starts_with("error: /proc/scene.glb: cannot write: folder /proc: "), "{line}");
}

/// As in a container with more cores than permitted threads. Here the threads' stacks do not fit into memory.
#[cfg(target_os = "linux")]
#[test]
fn threads_that_cannot_be_started() {
    let folder = tempfile::tempdir().unwrap();
    let mut command = Command::new("sh");
    command.args([
        "-c",
        "ulimit -v 4000000; exec \"$0\" \"$@\"",
        env!("CARGO_BIN_EXE_centaur"),
        "inspect",
        "scene.glb",
    ]);
    // Stacks of 1 GiB, so that there is memory left for everything else when there is none for another thread.
    command.env("RAYON_NUM_THREADS", "1000").env("RUST_MIN_STACK", (1 << 30).to_string());
    let line = failure(folder.path(), command.current_dir(folder.path()));
    assert!(line.starts_with("error: cannot start a thread for every core; RAYON_NUM_THREADS=4, say, "), "{line}");
}

/// A document that names more files than may be open, with a triangle in each.
#[cfg(unix)]
#[test]
fn more_files_than_may_be_open() {
    use std::fmt::Write as _;
    let folder = tempfile::tempdir().unwrap();
    let triangle: Vec<u8> =
        [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0].iter().flat_map(|v: &f32| v.to_le_bytes()).collect();
    let [mut buffers, mut views, mut accessors, mut primitives] = [(); 4].map(|()| String::new());
    for i in 0..100 {
        std::fs::write(folder.path().join(format!("{i}.bin")), &triangle).unwrap();
        let comma = if i > 0 { "," } else { "" };
        write!(buffers, r#"{comma}{{"uri":"{i}.bin","byteLength":36}}"#).unwrap();
        write!(views, r#"{comma}{{"buffer":{i},"byteLength":36}}"#).unwrap();
        let bounds = r#""min":[0,0,0],"max":[1,1,0]"#;
        write!(accessors, r#"{comma}{{"bufferView":{i},"componentType":5126,"count":3,"type":"VEC3",{bounds}}}"#)
            .unwrap();
        write!(primitives, r#"{comma}{{"attributes":{{"POSITION":{i}}}}}"#).unwrap();
    }
    let document = format!(
        r#"{{"asset":{{"version":"2.0"}},"scene":0,"scenes":[{{"nodes":[0]}}],"nodes":[{{"mesh":0}}],"meshes":[{{"primitives":[{primitives}]}}],
            "buffers":[{buffers}],"bufferViews":[{views}],"accessors":[{accessors}]}}"#
    );
    std::fs::write(folder.path().join("scene.gltf"), document).unwrap();
    let mut command = Command::new("sh");
    command.args([
        "-c",
        "ulimit -n 50; exec \"$0\" \"$@\"",
        env!("CARGO_BIN_EXE_centaur"),
        "inspect",
        "scene.gltf",
        "--json",
    ]);
    let output = command.current_dir(folder.path()).output().unwrap();
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    assert!(String::from_utf8_lossy(&output.stdout).contains("\"triangles\":100"), "{output:?}");
}

#[test]
fn adapters_that_do_not_exist() {
    let folder = folder_with_capture(3);
    for wanted in ["abacus", "#99", "ffff:ff:1f.7"] {
        let expected = format!("error: no adapter matches {wanted:?}; available: #0 ");
        let line = failure(folder.path(), &mut train(folder.path(), ["--adapter", wanted]));
        assert!(line.starts_with(&expected), "{line}");
        // Also from the environment, unless a flag says otherwise.
        let line = failure(folder.path(), train(folder.path(), []).env("CENTAUR_ADAPTER", wanted));
        assert!(line.starts_with(&expected), "{line}");
        let line = failure(folder.path(), train(folder.path(), ["--adapter", "none"]).env("CENTAUR_ADAPTER", wanted));
        assert!(line.starts_with(r#"error: no adapter matches "none""#), "{line}");
    }
}

/// No driver for Vulkan's loader, as on a machine without one.
#[cfg(target_os = "linux")]
#[test]
fn machines_without_an_adapter() {
    let folder = folder_with_capture(3);
    let without_drivers = |command: &mut Command| {
        for name in ["VK_ICD_FILENAMES", "VK_DRIVER_FILES"] {
            command.env(name, "/nonexistent.json");
        }
        command.env("VK_LOADER_DRIVERS_DISABLE", "*");
    };
    let mut command = train(folder.path(), []);
    without_drivers(&mut command);
    let line = failure(folder.path(), &mut command);
    assert!(line.starts_with("error: no GPU adapter found: install "), "{line}");
    // Once for several jobs.
    std::fs::create_dir(folder.path().join("scenes")).unwrap();
    for scene in ["one", "two"] {
        std::os::unix::fs::symlink("../capture", folder.path().join("scenes").join(scene)).unwrap();
    }
    let mut command = centaur(folder.path());
    command.args(["bench", "scenes", "-o", "out"]);
    without_drivers(&mut command);
    let line = failure(folder.path(), &mut command);
    assert!(line.starts_with("error: no GPU adapter found: install "), "{line}");
    let mut command = centaur(folder.path());
    command.args(["bench", "scenes", "-o", "capture/images/000.png"]);
    let line = failure(folder.path(), &mut command);
    assert!(line.ends_with("capture/images/000.png is not a folder"), "{line}");
    let mut command = centaur(folder.path());
    command.args(["devices", "--json"]);
    without_drivers(&mut command);
    let output = command.output().unwrap();
    assert_eq!((output.status.code(), output.stdout.trim_ascii()), (Some(0), &b"[]"[..]), "{}", stderr(&output));
}
