//! The command as a user meets it: exit codes, one clear line for every mistake, no files left behind.

use std::path::Path;
use std::process::Output;

use crate::common::{self, stderr};

fn centaur(args: &[&str]) -> Output {
    common::centaur(Path::new(".")).args(args).output().unwrap()
}

/// Error line of a command that must fail and leave nothing behind.
fn failure(folder: &Path, args: &[&str]) -> String {
    common::failure(folder, common::centaur(folder).args(args))
}

#[test]
fn wrong_usage_is_exit_code_2() {
    for args in [
        &[][..],
        &["fly"],
        &["devices", "--fast"],
        &["train", "capture"],
        &["train", "capture", "-o", "scene.txt"],
        &["train", "capture", "-o", "scene.glb", "--layers", "3"],
        &["train", "capture", "-o", "scene.glb", "--lambda", "-1"],
        &["train", "capture", "-o", "scene.glb", "--mesh", "a.obj", "--no-mesh"],
        &["train", "capture", "-o", "scene.glb", "--report", "out", "--no-eval"],
        &["train", "capture", "-o", "scene.glb", "--budget-mb", "9", "--max-floats", "9"],
        &["eval", "scene.glb"],
        &["render", "scene.glb", "-o", "out", "--format", "tiff"],
        // Of `train`, the number of mesh layers.
        &["render", "scene.glb", "-o", "out", "--layers"],
        &["mesh", "splats.ply", "capture", "-o", "surface.obj"],
        &["mesh", "capture", "-o", "surface.glb", "--truth", "a.glb", "--within", "NaN"],
        &["mesh", "capture", "-o", "surface.glb", "--truth", "a.glb", "--within=-1"],
    ] {
        let output = centaur(args);
        assert_eq!(output.status.code(), Some(2), "{args:?}");
        assert!(output.stdout.is_empty(), "{args:?}");
        assert!(stderr(&output).contains("--help") || args.is_empty(), "{args:?}: {}", stderr(&output));
    }
}

#[test]
fn arguments_that_do_not_go_together_are_wrong_usage_in_one_line() {
    let folder = tempfile::tempdir().unwrap();
    for (args, expected) in [
        (
            &["train", "c", "-o", "a.glb", "--surface", "points", "--no-points"][..],
            "--surface points: expected points, found --no-points",
        ),
        (
            &["train", "c", "-o", "a.glb", "--max-floats", "58"],
            "--max-floats: expected at least the 59 of a splat of degree 3, found 58",
        ),
        (
            &["train", "c", "-o", "a.glb", "--budget-mb", "0.00005", "--sh-degree", "0"],
            "--budget-mb: expected at least the 0.000056 of a splat of degree 0, found 0.00005",
        ),
        (
            &["render", "a.glb", "-o", "a", "--exr-layers", "--format", "png"],
            "--exr-layers writes EXR files: omit --format png",
        ),
        (
            &["render", "a.glb", "-o", "a", "--sh-direction", "ray"],
            "--sh-direction ray needs --model ray: with --model ewa, every splat has one colour",
        ),
        (
            &["render", "a.glb", "-o", "a", "--video", "a.mp4", "--exr-layers"],
            "--video is made of PNG images: omit --format exr and --exr-layers",
        ),
        (
            &["render", "a.glb", "-o", "a", "--exr-type", "half"],
            "--exr-type and --exr-compression apply to EXR files: give --format exr or --exr-layers",
        ),
        (
            &["render", "a.glb", "-o", "a", "--images", "images_4"],
            "--images applies to photographs: give --cameras CAPTURE, or omit --images",
        ),
        (
            &["convert", "a.ply", "a.glb", "--spz-version", "3"],
            "a.glb: --spz-version: expected a name that ends in .spz",
        ),
        (
            &["cameras", "orbit", "a.glb", "-o", "a.json", "--with-scene"],
            "a.json: --with-scene: expected a name that ends in .glb or .gltf",
        ),
    ] {
        let line = common::wrong_usage(folder.path(), common::centaur(folder.path()).args(args));
        assert_eq!(line, format!("error: {expected}"));
    }
    // Flags for jobs are checked before any job starts.
    std::fs::create_dir_all(folder.path().join("sets/one/sparse/0")).unwrap();
    for (flags, expected) in [
        (&["--seeds", "1,1"][..], "--seeds: 1 given twice"),
        (&["--variant", "a", "--variant", "a=--no-mesh"], "--variant a: given twice"),
        (
            &["--protocol", "b", "--", "--max-side", "9"],
            "--protocol b: expected no flag for the pictures, which it decides, found `--max-side`",
        ),
        (
            &["--", "--max-splats", "many"],
            "flags of default/one-0: invalid value 'many' for '--max-splats <N>': expected a whole number from 1",
        ),
    ] {
        let mut bench = common::centaur(folder.path());
        let line = common::wrong_usage(folder.path(), bench.args(["bench", "sets", "-o", "out"]).args(flags));
        assert_eq!(line, format!("error: {expected}"));
    }
}

#[test]
fn a_report_in_the_place_of_another_output_is_wrong_usage() {
    let folder = tempfile::tempdir().unwrap();
    for (report, file) in [
        ("./a.glb", "a.glb"),
        ("a.ply", "a.ply"),
        ("a.glb.checkpoint", "a.glb.checkpoint"),
        ("a.glb.lock", "a.glb.lock"),
    ] {
        let mut train = common::centaur(folder.path());
        let args = ["train", "c", "-o", "a.glb", "--ply", "a.ply", "--report", report];
        let line = common::wrong_usage(folder.path(), train.args(args));
        assert_eq!(line, format!("error: --report: expected another name than {file}, which is a file"));
    }
}

/// Whatever `--checkpoint-every` is, since Ctrl-C saves a checkpoint.
#[test]
fn a_checkpoint_that_cannot_be_written_is_an_error_before_training() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::create_dir(folder.path().join("a.glb.checkpoint")).unwrap();
    let long = format!("{}.glb", "a".repeat(245));
    for (name, expected) in [("a.glb", "expected the name of a file, found a folder"), (&long, "cannot write: ")] {
        let mut train = common::centaur(folder.path());
        let line = common::failure(folder.path(), train.args(["train", ".", "--checkpoint-every", "0", "-o", name]));
        assert!(line.starts_with(&format!("error: {name}.checkpoint: {expected}")), "{line}");
    }
}

/// The other commands are covered by `cli::tests`, which gets their list from clap.
#[test]
fn help_and_version_are_answers_not_errors() {
    for args in [&["--help"][..], &["--version"], &["bench", "--help"], &["cameras", "orbit", "--help"]] {
        let output = centaur(args);
        assert_eq!(output.status.code(), Some(0), "{args:?}");
        assert!(!output.stdout.is_empty() && output.stderr.is_empty(), "{args:?}");
    }
}

#[test]
fn devices_as_json_is_an_array_with_or_without_a_gpu() {
    let output = centaur(&["devices", "--json"]);
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    let listed: Vec<serde_json::Value> = serde_json::from_slice(&output.stdout).unwrap();
    for (i, adapter) in listed.iter().enumerate() {
        assert_eq!(adapter["index"], i, "{adapter}");
        let bus = &adapter["pci_bus_id"];
        assert!(bus.is_null() || bus.as_str().unwrap().contains(':'), "{adapter}");
    }
}

#[test]
fn inputs_that_are_not_there_or_not_scenes() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("notes.txt"), "not a scene").unwrap();
    std::fs::write(folder.path().join("marked.gltf"), "\u{feff}{}").unwrap();
    std::fs::write(folder.path().join("wide.usda"), b"\xff\xfe#\0u\0s\0d\0a\0").unwrap();
    for (args, expected) in [
        (&["inspect", "none.glb"][..], "error: none.glb: cannot read: No such file or directory"),
        (
            &["inspect", "notes.txt"],
            "error: notes.txt: byte 0: expected a .glb, .gltf, .usda, .usdc, .usdz, .ply, .sog, .spz, .splat or .ksplat file, found other content",
        ),
        (
            &["inspect", "marked.gltf"],
            "error: marked.gltf: byte 0: expected a .glb, .gltf, .usda, .usdc, .usdz, .ply, .sog, .spz, .splat or .ksplat file, found a byte order mark: save it as UTF-8 without",
        ),
        (
            &["validate", "wide.usda"],
            "error: wide.usda: byte 0: expected a .glb, .gltf, .usda, .usdc, .usdz, .ply, .sog, .spz, .splat or .ksplat file, found text in UTF-16: save it as UTF-8 without a byte order mark",
        ),
        (&["eval", "none.glb", "capture"], "error: none.glb: cannot read: No such file or directory"),
        (&["render", "none.glb", "-o", "out"], "error: none.glb: cannot read: No such file or directory"),
        (&["mesh", "none.ply", "capture", "-o", "a.glb"], "error: capture: cannot read: No such file or directory"),
        (&["train", "capture", "-o", "a.glb"], "error: capture: cannot read: No such file or directory"),
        (&["bench", "sets", "-o", "out"], "error: sets: cannot read: No such file or directory"),
        (
            &["cameras", "orbit", "none.json", "-o", "a.json"],
            "error: none.json: cannot read: No such file or directory",
        ),
        (&["train", ".", "-o", "a.glb", "--mesh", "none.obj"], "error: none.obj: expected a mesh file, found none"),
        (&["train", ".", "-o", "a.glb", "--resume"], "error: a.glb.checkpoint: expected a checkpoint, found none"),
    ] {
        assert_eq!(failure(folder.path(), args), expected);
    }
    let line = failure(folder.path(), &["train", ".", "-o", "a.glb"]);
    assert!(line.contains("COLMAP") && line.contains("transforms"), "{line}");
}

#[cfg(unix)]
#[test]
fn names_that_json_cannot_hold_are_refused_before_any_work() {
    use std::os::unix::ffi::OsStrExt as _;
    let folder = tempfile::tempdir().unwrap();
    let name = std::ffi::OsStr::from_bytes(b"\xff.glb");
    let of = |args: &[&str]| {
        let output = common::centaur(folder.path()).arg("inspect").arg(name).args(args).output().unwrap();
        (output.status.code(), stderr(&output))
    };
    assert_eq!(of(&["--json"]), (Some(2), "error: --json: expected names in UTF-8, found \u{fffd}.glb\n".to_owned()));
    assert!(of(&[]).1.contains("No such file"));
}

#[test]
fn outputs_that_cannot_be_written_are_found_before_any_work() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("file"), "").unwrap();
    std::fs::create_dir(folder.path().join("folder.glb")).unwrap();
    // None of the inputs exists: the output is checked first.
    for (args, expected) in [
        (
            &["train", "c", "-o", "none/a.glb"][..],
            "error: none/a.glb: cannot write: folder none: No such file or directory",
        ),
        (&["train", "c", "-o", "file/a.glb"], "error: file/a.glb: cannot write: file is not a folder"),
        (&["train", "c", "-o", "folder.glb"], "error: folder.glb: expected the name of a file, found a folder"),
        (&["train", "c", "-o", "a.glb", "--report", "file"], "error: file: cannot write: file is not a folder"),
        (&["eval", "s.glb", "c", "-o", "file"], "error: file: cannot write: file is not a folder"),
        (&["render", "s.glb", "-o", "no/out"], "error: no/out: cannot write: folder no: No such file or directory"),
        (
            &["mesh", "s.ply", "c", "-o", "no/a.glb"],
            "error: no/a.glb: cannot write: folder no: No such file or directory",
        ),
    ] {
        assert_eq!(failure(folder.path(), args), expected);
    }
}

#[test]
fn validation_tells_by_its_exit_code() {
    let folder = tempfile::tempdir().unwrap();
    let write = |text: &str| std::fs::write(folder.path().join("a.gltf"), text).unwrap();
    let run = |more: &[&str]| common::centaur(folder.path()).args(["validate", "a.gltf"]).args(more).output().unwrap();
    write(r#"{ "asset": { "version": "2.0" }, "extensionsUsed": ["NONE_such"] }"#);
    let output = run(&[]);
    assert_eq!(output.status.code(), Some(0), "a warning is no failure: {}", stderr(&output));
    let text = String::from_utf8(output.stdout).unwrap();
    assert_eq!(
        text,
        "warning EXTENSION_UNUSED: /extensionsUsed/0: expected an object of `NONE_such`, found none\n\
         a.gltf: glTF, 0 error(s), 1 warning(s)\n"
    );
    write(r#"{ "asset": {}, "scene": 3 }"#);
    let output = run(&["--json"]);
    assert_eq!((output.status.code(), stderr(&output).trim()), (Some(1), "error: a.gltf: 2 error(s)"));
    let json: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(json["findings"][0]["location"]["pointer"], "/asset");
    assert_eq!((&json["errors"], &json["findings"][1]["code"]), (&2.into(), &"INDEX_RANGE".into()));
}

#[test]
fn a_ply_of_something_else_is_inspected() {
    let folder = tempfile::tempdir().unwrap();
    let text = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\nelement face 1\n\
        property list uchar int vertex_indices\nend_header\n0 0 0\n1 nan 0\n-1 2 0.5\n3 0 1 2\n";
    std::fs::write(folder.path().join("mesh.ply"), text).unwrap();
    let output = common::centaur(folder.path()).args(["inspect", "mesh.ply"]).output().unwrap();
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    let said = String::from_utf8(output.stdout).unwrap();
    assert!(said.contains("├ vertex: 3 rows of x, y, z, [-1.000 0.000 0.000] to [0.000 2.000 0.500]"), "{said}");
    assert!(said.contains("├ face: 1 rows of vertex_indices[]\n") && said.contains("warning: no splats"), "{said}");
    // A file that is meant to contain splats but does not is an error.
    std::fs::write(folder.path().join("bad.ply"), text.replace("float z", "float z\nproperty float f_dc_0")).unwrap();
    let line = common::failure(folder.path(), common::centaur(folder.path()).args(["inspect", "bad.ply"]));
    assert!(line.starts_with("error: bad.ply: byte "), "{line}");
}

#[test]
fn what_is_no_valid_gltf_is_left_to_validation() {
    let folder = tempfile::tempdir().unwrap();
    let document =
        r#"{ "asset": { "version": "2.0" }, "meshes": [{ "primitives": [{ "attributes": {}, "material": 7 }] }] }"#;
    std::fs::write(folder.path().join("a b.gltf"), document).unwrap();
    let name = if cfg!(windows) { "\"a b.gltf\"" } else { "'a b.gltf'" };
    let said = format!("found index out of bounds; `centaur validate {name}` says more");
    for args in [&["inspect", "a b.gltf"][..], &["convert", "a b.gltf", "c.usda"]] {
        let line = failure(folder.path(), args);
        assert!(line.ends_with(&said), "{line}");
    }
}

/// Names in files, and names of files, can contain anything.
#[test]
fn names_cannot_move_the_cursor() {
    let folder = tempfile::tempdir().unwrap();
    let document = r#"{ "asset": { "version": "2.0" }, "scene": 0, "scenes": [{ "nodes": [0] }], "nodes": [{ "mesh": 0 }],
        "meshes": [{ "primitives": [{ "attributes": { "POSITION": 0 } }] }], "extensionsUsed": ["A\u001b[2J\r\nB"],
        "accessors": [{ "bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3", "min": [0, 0, 0], "max": [1, 1, 0] }],
        "bufferViews": [{ "buffer": 0, "byteLength": 36 }], "buffers": [{ "byteLength": 36, "uri": "a.bin" }] }"#;
    let corners = [0.0f32, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0].map(f32::to_le_bytes);
    std::fs::write(folder.path().join("a.bin"), corners.concat()).unwrap();
    std::fs::write(folder.path().join("a.gltf"), document).unwrap();
    let said = |args: &[&str]| {
        let output = common::centaur(folder.path()).args(args).output().unwrap();
        let text = String::from_utf8(output.stdout).unwrap() + &String::from_utf8(output.stderr).unwrap();
        assert!(!text.contains(|c: char| c.is_control() && c != '\n'), "{args:?}: {text:?}");
        text
    };
    let text = said(&["validate", "a.gltf"]);
    assert!(text.contains(r"expected an object of `A\u{1b}[2J\r\nB`, found none"), "{text}");
    let text = said(&["convert", "a.gltf", "a.usda"]);
    assert!(text.contains(r"the extension A\u{1b}[2J\r\nB"), "{text}");
    #[cfg(unix)]
    {
        std::fs::write(folder.path().join("a\u{1b}[2J.gltf"), document).unwrap();
        std::fs::write(folder.path().join("b\u{1b}[2J.ply"), "").unwrap();
        assert!(said(&["inspect", "b\u{1b}[2J.ply"]).starts_with(r"error: b\u{1b}[2J.ply: byte 0: expected "));
        assert!(said(&["validate", "a\u{1b}[2J.gltf"]).contains("\na\\u{1b}[2J.gltf: glTF, "));
        assert!(said(&["convert", "a\u{1b}[2J.gltf", "c\u{1b}[2J.usda"]).contains("\nc\\u{1b}[2J.usda: 0 splats"));
        assert!(said(&["convert", "a.gltf", "c\r\n\td.glb"]).contains("\nc\\r\\n\\td.glb: 0 splats"));
    }
}
