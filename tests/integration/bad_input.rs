//! Faulty captures and checkpoints: one line that names the file and what was expected, exit code 1, and no files left
//! behind.

use std::path::Path;
use std::process::Command;
use std::sync::atomic::AtomicBool;

use crate::common::{self, centaur, failure, stderr, write_capture};
use centaur::capture::{self, LoadOptions};
use centaur::format::{WriteOptions, gltf, write_scene};
use centaur::optimize::checkpoint::Checkpoint;
use centaur::optimize::{self, MeshSource, Outcome, Session, TrainOptions};
use centaur::render::gpu::Gpu;
use centaur::scene::{Composition, HybridScene, Splats};
use glam::{Quat, Vec3};

/// A run that takes a second or two.
const SHORT: [&str; 8] = ["train", "capture", "-o", "scene.glb", "--iterations", "12", "--no-eval", "--quiet"];

/// Flags that have no effect with --no-mesh; the last one has none with --mesh either.
pub(crate) const OF_A_MESH: [&str; 3] = ["--warmup", "4", "--surface-iterations=11"];

pub(crate) fn folder_with_capture(views: usize) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    write_capture(&folder.path().join("capture"), views, (48, 32));
    folder
}

/// Removes the scene of an earlier run, which would cause a note.
pub(crate) fn train<'a>(folder: &Path, more: impl IntoIterator<Item = &'a str>) -> Command {
    let _ = std::fs::remove_file(folder.join("scene.glb"));
    let more: Vec<&str> = more.into_iter().collect();
    let mut command = centaur(folder);
    let has = |flag| more.contains(&flag);
    let of_a_mesh = match (has("--no-mesh"), has("--mesh")) {
        (true, _) => &[][..],
        (false, true) => &OF_A_MESH[..2],
        (false, false) => &OF_A_MESH[..],
    };
    command.args(SHORT).args(of_a_mesh).args(more);
    command
}

/// Trains a capture of 8 views after `damage` has changed it; returns the one line of its error.
fn refused(damage: impl FnOnce(&Path)) -> String {
    let folder = folder_with_capture(8);
    damage(&folder.path().join("capture"));
    failure(folder.path(), &mut train(folder.path(), []))
}

pub(crate) fn edit(path: &Path, change: impl FnOnce(String) -> String) {
    std::fs::write(path, change(std::fs::read_to_string(path).unwrap())).unwrap();
}

#[test]
fn captures_with_missing_or_wrong_parts() {
    let line = refused(|c| {
        std::fs::remove_file(c.join("images/002.png")).unwrap();
        std::fs::remove_file(c.join("images/005.png")).unwrap();
    });
    assert_eq!(line, "error: capture: 2 of 8 images missing, the first is images/002.png");

    let line = refused(|c| std::fs::write(c.join("images/003.png"), "no picture").unwrap());
    assert!(line.starts_with("error: capture/images/003.png: "), "{line}");

    // Cut in the middle: the header is right, so the missing pixels are found only during training.
    let line = refused(|c| {
        let path = c.join("images/003.png");
        let bytes = std::fs::read(&path).unwrap();
        std::fs::write(&path, &bytes[..bytes.len() / 2]).unwrap();
    });
    assert!(line.starts_with("error: capture/images/003.png: "), "{line}");

    let line = refused(|c| std::fs::write(c.join("sparse/0/cameras.txt"), "# none\n").unwrap());
    assert_eq!(line, "error: capture/sparse/0/cameras.txt: cameras: expected at least one camera, found none");

    let line = refused(|c| std::fs::write(c.join("sparse/0/cameras.txt"), "1 PINHOLE 48 32 48 0 24 16\n").unwrap());
    assert_eq!(line, "error: capture/sparse/0/cameras.txt: line 1: expected positive focal lengths, found 0");

    let line = refused(|c| std::fs::write(c.join("sparse/0/images.txt"), "# none\n").unwrap());
    assert_eq!(line, "error: capture/sparse/0/images.txt: views: expected at least 2 posed images, found 0");

    for views in 1..=2 {
        let folder = folder_with_capture(views);
        let line = failure(folder.path(), &mut train(folder.path(), []));
        assert!(line.starts_with("error: capture") && line.contains("expected at least"), "{line}");
        assert!(line.contains(&format!("found {views}")), "{line}");
    }
}

/// Its header is complete. During training only some of the held-out views are evaluated; all are scored afterwards.
#[test]
fn a_held_out_photograph_that_ends_early_is_found_before_training() {
    let folder = folder_with_capture(64);
    let image = folder.path().join("capture/images/008.png");
    let whole = std::fs::read(&image).unwrap();
    std::fs::write(&image, &whole[..whole.len() - 20]).unwrap();
    let mut scored = centaur(folder.path());
    scored.args(SHORT.iter().filter(|word| **word != "--no-eval")).arg("--no-mesh");
    let line = failure(folder.path(), &mut scored);
    assert!(line.starts_with("error: capture/images/008.png: "), "{line}");
    let trained = train(folder.path(), ["--no-mesh"]).output().unwrap();
    assert!(trained.status.success(), "it is needed for scores alone: {}", stderr(&trained));
}

/// Writes zero weights of `AlexNet` in the format of `lpips_weights.py`.
fn write_weights(file: &Path) {
    let convolutions = [[64, 3, 11], [192, 64, 5], [384, 192, 3], [256, 384, 3], [256, 256, 3]];
    let shapes: Vec<(String, Vec<usize>)> = (convolutions.into_iter().enumerate())
        .flat_map(|(i, [outputs, inputs, kernel])| {
            let of = |part: &str| format!("conv{}.{part}", i + 1);
            [
                (of("weight"), vec![outputs, inputs, kernel, kernel]),
                (of("bias"), vec![outputs]),
                (format!("lin{i}.weight"), vec![outputs]),
            ]
        })
        .collect();
    let zeros = vec![0; 4 * 384 * 256 * 9];
    let tensors = shapes.into_iter().map(|(name, shape)| {
        let bytes = &zeros[..4 * shape.iter().product::<usize>()];
        (name, safetensors::tensor::TensorView::new(safetensors::Dtype::F32, shape, bytes).unwrap())
    });
    std::fs::write(file, safetensors::serialize(tensors, None).unwrap()).unwrap();
}

#[test]
fn photographs_without_room_for_the_network_of_lpips_are_found_before_training() {
    let folder = folder_with_capture(8);
    write_weights(&folder.path().join("alex.safetensors"));
    let mut command = centaur(folder.path());
    command.args(["train", "capture", "-o", "scene.glb", "--iterations", "12", "--no-mesh", "--quiet"]);
    command.args(["--lpips-weights", "alex.safetensors", "--max-side", "40"]);
    let line = failure(folder.path(), &mut command);
    assert!(line.ends_with("000.png: LPIPS: expected images of at least 31×31 pixels, found 40×27"), "{line}");
    assert!(!folder.path().join("scene.glb").exists());
}

#[test]
fn truncated_binary_models() {
    let camera = |count: u64| {
        let mut bytes = count.to_le_bytes().to_vec();
        bytes.extend([1u32.to_le_bytes(), 1u32.to_le_bytes()].concat());
        bytes.extend([48u64.to_le_bytes(), 32u64.to_le_bytes()].concat());
        bytes.extend([48.0, 48.0, 24.0, 16.0].map(f64::to_le_bytes).concat());
        bytes
    };
    let whole = camera(1);
    // A declared count that no file could hold must not be trusted either.
    for bytes in [&whole[..5], &whole[..whole.len() - 1], &camera(u64::MAX)] {
        let line = refused(|c| std::fs::write(c.join("sparse/0/cameras.bin"), bytes).unwrap());
        assert!(line.starts_with("error: capture/sparse/0/cameras.bin: "), "{line}");
        assert!(line.contains("expected"), "{line}");
    }
}

#[test]
fn poses_and_points_that_are_no_numbers() {
    for (from, to) in [(" 1.5 1 004.png", " NaN 1 004.png"), (" 1.5 1 004.png", " inf 1 004.png")] {
        let line = refused(|c| edit(&c.join("sparse/0/images.txt"), |text| text.replacen(from, to, 1)));
        assert!(
            line.starts_with("error: capture/sparse/0/images.txt: line ") && line.contains(", image 004.png: "),
            "{line}"
        );
        assert!(line.contains("expected") && line.contains("finite"), "{line}");
    }
    let line = refused(|c| {
        edit(&c.join("sparse/0/images.txt"), |_| "1 0 0 0 0 0 0 1 1 000.png\n\n2 1 0 0 0 0 0 1 1 001.png\n\n".into());
    });
    assert_eq!(
        line,
        "error: capture/sparse/0/images.txt: line 1, image 000.png: expected a unit quaternion, found [0.0, 0.0, 0.0, 0.0]"
    );
    let line = refused(|c| edit(&c.join("sparse/0/points3D.txt"), |text| format!("{text}999 0 NaN 0 1 2 3 0.1\n")));
    assert!(line.starts_with("error: capture/sparse/0/points3D.txt: line 301: expected finite numbers"), "{line}");
}

#[test]
fn models_without_their_cameras() {
    let line = refused(|c| std::fs::remove_file(c.join("sparse/0/cameras.txt")).unwrap());
    let expected = "COLMAP model: expected cameras.txt beside images.txt, found none: it is missing";
    assert_eq!(line, format!("error: capture/sparse/0: {expected}"));
}

#[test]
fn what_is_given_in_place_of_another_is_recognised() {
    let folder = folder_with_capture(3);
    let at = |name: &str| folder.path().join(name);
    let splats = Splats::new(vec![Vec3::ZERO], vec![Quat::IDENTITY], vec![Vec3::ZERO], vec![0.0], 0, vec![[0.5; 3]]);
    let scene = HybridScene { splats: splats.unwrap(), meshes: vec![], composition: Composition::default() };
    write_scene(&at("s.ply"), &scene, &WriteOptions::default()).unwrap();
    let header = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n";
    let faces = "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n";
    std::fs::write(at("mesh.ply"), [header, faces].concat()).unwrap();
    std::fs::write(at("points.ply"), [header, "end_header\n0 0 0\n1 0 0\n0 1 0\n"].concat()).unwrap();
    std::fs::write(at("mesh.obj"), "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n").unwrap();
    std::fs::create_dir(at("sog")).unwrap();
    std::fs::write(at("sog/meta.json"), "{}").unwrap();
    for (args, file, said) in [
        ("render capture -o r", "capture", "expected a file, found a folder with sparse, as of a capture"),
        ("inspect sog", "sog", "expected a file, found a folder with a SOG: give its meta.json"),
        ("convert sog a.glb", "sog", "expected a file, found a folder with a SOG: give its meta.json"),
        ("inspect mesh.obj", "mesh.obj", "found an OBJ, which holds a mesh alone: `centaur train --mesh` and "),
        ("convert mesh.ply a.glb", "mesh.ply", "with `f_dc_0` and more, found a mesh, no splats (`face`: 1)"),
        ("convert points.ply a.glb", "points.ply", "with `f_dc_0` and more, found points, no splats"),
        (
            "train capture --mesh s.ply -o a.glb",
            "s.ply",
            "expected a mesh, of vertices and faces, found splats, which ",
        ),
        (
            "render s.ply --cameras capture/sparse/0/images.txt -o r",
            "capture/sparse/0/images.txt",
            "is a part of a COLMAP model: give the folder, capture/sparse/0",
        ),
    ] {
        let line = failure(folder.path(), centaur(folder.path()).args(args.split(' ')));
        assert!(line.starts_with(&format!("error: {file}: ")) && line.contains(said), "{args}: {line}");
    }
    let line = common::wrong_usage(folder.path(), centaur(folder.path()).args(["eval", "capture", "s.ply"]));
    assert_eq!(line, "error: expected SCENE CAPTURE, found a capture first: capture s.ply");
}

#[test]
fn scenes_of_another_capture_are_scored_and_it_is_said() {
    let folder = folder_with_capture(9);
    let splats = Splats::new(vec![Vec3::ZERO], vec![Quat::IDENTITY], vec![Vec3::ZERO], vec![0.0], 0, vec![[0.5; 3]]);
    let scene = HybridScene { splats: splats.unwrap(), meshes: vec![], composition: Composition::default() };
    for (trained_on, notes) in [
        ("gar\u{1b}den", "note: the scene was trained on a capture called garden, this one is called capture\n"),
        ("capture", ""),
    ] {
        let record = serde_json::json!({ "capture": trained_on, "settings": {} });
        gltf::write_glb(&folder.path().join("s.glb"), &scene, &[], Some(record)).unwrap();
        let output = centaur(folder.path()).args(["eval", "s.glb", "capture", "--quiet"]).output().unwrap();
        assert_eq!((output.status.code(), &*stderr(&output)), (Some(0), notes));
    }
}

/// The header is right: missing pixels are found only when the photograph is scored.
#[test]
fn photographs_that_are_cut_off_leave_no_report() {
    let folder = folder_with_capture(9);
    let splats = Splats::new(vec![Vec3::ZERO], vec![Quat::IDENTITY], vec![Vec3::ZERO], vec![0.0], 0, vec![[0.5; 3]]);
    let scene = HybridScene { splats: splats.unwrap(), meshes: vec![], composition: Composition::default() };
    write_scene(&folder.path().join("s.ply"), &scene, &WriteOptions::default()).unwrap();
    let photograph = folder.path().join("capture/images/000.png");
    let bytes = std::fs::read(&photograph).unwrap();
    std::fs::write(&photograph, &bytes[..bytes.len() / 2]).unwrap();
    let eval = ["eval", "s.ply", "capture", "-o", "scores", "--quiet"];
    let line = failure(folder.path(), centaur(folder.path()).args(eval));
    assert!(line.starts_with("error: capture/images/000.png: "), "{line}");
}

/// As if structure from motion has made several models of the capture.
#[test]
fn photographs_that_a_capture_does_not_list_are_noted() {
    let folder = folder_with_capture(8);
    let images = folder.path().join("capture/images");
    std::fs::write(images.join("list.txt"), "no photograph").unwrap();
    let notes = || stderr(&train(folder.path(), ["--no-mesh", "--max-splats", "500"]).output().unwrap());
    assert_eq!(notes(), "");
    for name in ["100.png", "101.JPG"] {
        std::fs::copy(images.join("000.png"), images.join(name)).unwrap();
    }
    assert_eq!(notes(), "note: capture: lists 8 of the 10 photographs: the others are left out\n");
    // The two photographs may belong to a further model.
    let sparse = folder.path().join("capture/sparse");
    std::fs::create_dir(sparse.join("1")).unwrap();
    for file in ["cameras.txt", "images.txt"] {
        std::fs::copy(sparse.join("0").join(file), sparse.join("1").join(file)).unwrap();
    }
    let note = "note: capture: has further COLMAP models of other photographs (1): model 0 is used; to use another, rename it to 0\n";
    assert!(notes().starts_with(note), "{}", notes());
    std::fs::remove_dir_all(sparse.join("1")).unwrap();
    // Beside the model, a file with two of the views with another orientation.
    let frame = |i: u32| {
        format!(
            r#"{{"file_path":"images/{i:03}.png","transform_matrix":[[1,0,0,{i}],[0,-1,0,0],[0,0,-1,0],[0,0,0,1]]}}"#
        )
    };
    let json = format!(r#"{{"fl_x":32,"frames":[{},{}]}}"#, frame(0), frame(1));
    std::fs::write(folder.path().join("capture/transforms.json"), json).unwrap();
    let note = "note: capture: has a COLMAP model, which is used, and transforms.json, which is not: to use that file, give it instead of the folder\n";
    assert!(notes().starts_with(note), "{}", notes());
    for part in ["train", "test"] {
        std::fs::write(folder.path().join(format!("capture/transforms_{part}.json")), "{}").unwrap();
    }
    std::fs::rename(folder.path().join("capture/transforms.json"), folder.path().join("t.json")).unwrap();
    let note = "note: capture: has a COLMAP model, which is used, and transforms_train.json, which is not: to use the split, move the former away\n";
    assert!(notes().starts_with(note), "{}", notes());
    std::fs::rename(folder.path().join("t.json"), folder.path().join("capture/transforms.json")).unwrap();
    let more = ["--no-mesh", "--max-splats", "500", "--all-views", "--iterations", "2"];
    let mut of_file = centaur(folder.path());
    of_file.args(["train", "capture/transforms.json", "-o", "t.glb", "--quiet"]).args(more);
    let said = stderr(&of_file.output().unwrap());
    assert!(
        said.contains("note: capture/transforms.json: lists 2 of the 10 photographs: the others are left out\n"),
        "{said}"
    );
}

#[test]
fn budgets_without_room_for_a_splat() {
    let folder = folder_with_capture(8);
    let line = common::wrong_usage(folder.path(), &mut train(folder.path(), ["--no-mesh", "--max-floats", "10"]));
    assert_eq!(line, "error: --max-floats: expected at least the 59 of a splat of degree 3, found 10");
}

#[test]
fn point_clouds_without_points() {
    let advice = "--no-points begins with splats at random places that the cameras look at";
    let line = refused(|c| std::fs::write(c.join("sparse/0/points3D.txt"), "# none\n").unwrap());
    assert_eq!(line, format!("error: capture/sparse/0/points3D.txt: expected points, found none; {advice}"));

    let folder = folder_with_capture(8);
    // The points are not needed.
    std::fs::remove_file(folder.path().join("capture/sparse/0/points3D.txt")).unwrap();
    let flags = ["--no-mesh", "--max-splats", "500", "--no-points"];
    let output = train(folder.path(), flags).output().unwrap();
    assert_eq!((output.status.code(), stderr(&output)), (Some(0), String::new()));
    let scene = centaur::format::read_scene(&folder.path().join("scene.glb")).unwrap();
    assert_eq!(scene.splats.len(), 500);
    let flags = ["--surface", "points", "--no-points"];
    let line = common::wrong_usage(folder.path(), &mut train(folder.path(), flags));
    assert_eq!(line, "error: --surface points: expected points, found --no-points");
}

#[test]
fn captures_that_name_no_points_start_from_random_splats_and_say_so() {
    let folder = folder_with_capture(8);
    let capture = folder.path().join("capture");
    std::fs::remove_dir_all(capture.join("sparse")).unwrap();
    let frame = |i: u32| {
        let pose = [[1.0, 0.0, 0.0, f64::from(i)], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 4.0], [0.0, 0.0, 0.0, 1.0]];
        serde_json::json!({ "file_path": format!("images/{i:03}.png"), "transform_matrix": pose })
    };
    let frames: Vec<_> = (0..8).map(frame).collect();
    let write = |more: &[(&str, &str)]| {
        let mut file = serde_json::json!({ "w": 48, "h": 32, "fl_x": 48.0, "frames": frames });
        more.iter().for_each(|(key, value)| file[*key] = (*value).into());
        std::fs::write(capture.join("transforms.json"), file.to_string()).unwrap();
    };
    let ply =
        "ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nproperty float y\nproperty float z\nend_header\n";
    std::fs::write(capture.join("points.ply"), ply).unwrap();
    write(&[("ply_file_path", "points.ply")]);
    let line = failure(folder.path(), &mut train(folder.path(), []));
    assert!(line.starts_with("error: capture/points.ply: expected points, found none"), "{line}");
    write(&[("ply_file_path", "gone.ply")]);
    let line = failure(folder.path(), &mut train(folder.path(), []));
    let advice = "No such file or directory; --no-points begins with splats at random places that the cameras look at";
    assert_eq!(line, format!("error: capture/gone.ply: cannot read: {advice}"));

    write(&[]);
    let output = train(folder.path(), ["--no-mesh", "--max-splats", "500"]).output().unwrap();
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    let note = "capture: has no points: splats begin at random places that its cameras look at";
    // The world is that of OpenGL.
    let lies = "capture: was taken with +y up: glTF viewers, which have +y up, will show the scene upside down; to set it upright: \
                centaur convert scene.glb OUT.glb --axes y-up:y-down";
    assert_eq!(stderr(&output), format!("note: {note}\nnote: {lies}\n"));
    let output = train(folder.path(), ["--no-mesh", "--max-splats", "500", "--json"]).output().unwrap();
    let outcome: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!((stderr(&output), &outcome["notes"]), (String::new(), &serde_json::json!([note, lies])));

    // A run that uses no points does not need the file.
    write(&[("ply_file_path", "gone.ply")]);
    let tetrahedron =
        "v 0.4 0 -0.3\nv -0.4 0.3 -0.3\nv -0.4 -0.3 -0.3\nv 0 0 0.4\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n";
    std::fs::write(folder.path().join("mesh.obj"), tetrahedron).unwrap();
    for args in
        ["eval scene.glb capture --quiet", "mesh capture --mesh mesh.obj -o surface.glb --texture-size 64 --quiet"]
    {
        let output = centaur(folder.path()).args(args.split(' ')).output().unwrap();
        assert_eq!((output.status.code(), stderr(&output)), (Some(0), String::new()), "{args}");
    }
}

#[test]
fn checkpoints_of_other_runs_and_damaged_ones() {
    let folder = folder_with_capture(8);
    let checkpoint = folder.path().join("scene.glb.checkpoint");
    let line = failure(folder.path(), &mut train(folder.path(), ["--resume"]));
    assert_eq!(line, "error: scene.glb.checkpoint: expected a checkpoint, found none");

    let resumed = |more: &[&str]| {
        let line = failure(folder.path(), train(folder.path(), ["--no-mesh", "--resume"]).args(more));
        assert!(line.starts_with("error: scene.glb.checkpoint: "), "{line}");
        line
    };
    for garbage in ["", "no checkpoint, but longer than its header would be"] {
        std::fs::write(&checkpoint, garbage).unwrap();
        assert!(resumed(&[]).contains("expected a safetensors file"));
    }

    let options = TrainOptions { iterations: 12, warmup: 0, ..TrainOptions::default() };
    stop_after_one_iteration(folder.path(), &options, &checkpoint);
    let whole = std::fs::read(&checkpoint).unwrap();
    let line = resumed(&["--seed", "7"]);
    assert!(
        line.ends_with("expected a checkpoint of a run with the same options, but seed was 0 and is now 7"),
        "{line}"
    );
    let mut with_mesh = train(folder.path(), ["--surface", "points", "--resume"]);
    let line = failure(folder.path(), &mut with_mesh);
    assert!(line.ends_with("a run with the same mesh, but it was none and is now points"), "{line}");
    let line = resumed(&["--max-side", "40"]);
    assert!(line.contains("expected a checkpoint of the same photographs and masks at the same size"), "{line}");
    std::fs::write(&checkpoint, &whole[..whole.len() - 7]).unwrap();
    assert!(resumed(&[]).contains("truncated"));
    let mut flipped = whole.clone();
    flipped[whole.len() / 2] ^= 1;
    std::fs::write(&checkpoint, flipped).unwrap();
    assert!(resumed(&[]).ends_with(": the file is damaged"));
    std::fs::write(&checkpoint, whole).unwrap();
    let mut beyond = Checkpoint::read(&checkpoint).unwrap();
    beyond.meta["iteration"] = 13.into();
    beyond.write(&checkpoint).unwrap();
    assert!(resumed(&[]).ends_with("iteration: expected at most the 12 of its phase, found 13"));
}

/// There is no checkpoint of this run to refer to.
#[test]
fn what_is_not_finite_is_named() {
    let folder = folder_with_capture(8);
    std::fs::write(folder.path().join("scene.glb.checkpoint"), "of another run").unwrap();
    let mut command = train(folder.path(), ["--no-mesh", "--refine-poses", "--pose-reach", "1e300"]);
    let said = stderr(&command.output().unwrap());
    assert!(said.trim_end().ends_with(" not finite"), "{said}");
}

fn stop_after_one_iteration(folder: &Path, options: &TrainOptions, checkpoint: &Path) {
    let capture = capture::open(&folder.join("capture"), &LoadOptions::default()).unwrap();
    let session = Session {
        gpu: &Gpu::open(None).unwrap(),
        checkpoints: optimize::Checkpoints::Save(checkpoint.into()),
        stop: &AtomicBool::new(true),
        progress: &mut |_| {},
    };
    let trained = optimize::train(&capture, MeshSource::None, options, session).unwrap();
    assert_eq!(trained.outcome, Outcome::Interrupted);
}
