//! `centaur convert` as a user meets it: kept content, reported losses, refused input.

use std::path::Path;

use crate::common::{self, stderr};
use centaur::edit::Similarity;
use centaur::format::{self, WriteOptions, gltf, ply};
use centaur::scene::{Atlas, Camera, Composition, HybridScene, Intrinsics, Mesh, Splats, Texture, in_morton_order, sh};
use glam::{DMat3, DVec3, Quat, Vec2, Vec3};

/// `n` distinct splats along the diagonal from (0, 0, 0) to (n−1, n−1, n−1).
pub(crate) fn splats(n: usize, degree: u32) -> Splats {
    let x = |i: usize| i as f32 * 0.37 % 1.0;
    Splats::new(
        (0..n).map(|i| Vec3::splat(i as f32)).collect(),
        (0..n).map(|i| Quat::from_euler(glam::EulerRot::XYZ, x(i), x(2 * i), x(3 * i))).collect(),
        (0..n).map(|i| Vec3::new(x(i), x(5 * i), x(7 * i)) - 3.0).collect(),
        (0..n).map(|i| 6.0 * x(i) - 3.0).collect(),
        degree,
        (0..n * sh::coefficients(degree)).map(|i| [x(i), x(11 * i), x(13 * i)]).collect(),
    )
    .unwrap()
}

/// Writes 10 splats of degree 3, a triangle with bands of degree 2, and a camera.
pub(crate) fn write_hybrid(path: &Path) {
    let texels = |channels: u32| (0..4 * 4 * channels).map(|i| (i as f32 * 0.7).sin()).collect();
    let base = Texture::new(4, 4, 4, texels(4)).unwrap();
    let bands = Texture::new(4, 4, 24, texels(24)).unwrap();
    let atlas = Atlas::new(base, Some(bands)).unwrap();
    let corners = vec![Vec3::ZERO, Vec3::X, Vec3::Y];
    let mesh = Mesh::new(corners, vec![[0, 1, 2]], vec![[Vec2::ZERO, Vec2::X, Vec2::Y]], atlas).unwrap();
    let scene = HybridScene { splats: splats(10, 3), meshes: vec![mesh], composition: Composition::default() };
    let intrinsics = Intrinsics { width: 64, height: 48, fx: 60.0, fy: 61.0, cx: 31.0, cy: 25.0 };
    let camera = Camera::new(intrinsics, DMat3::from_rotation_y(0.3), DVec3::new(0.1, 0.2, 5.0)).unwrap();
    gltf::write_glb(path, &scene, &[("front".to_owned(), camera)], None).unwrap();
}

/// Writes a scene with a training record, as trained scenes have.
fn write_trained(path: &Path) -> serde_json::Value {
    let record = serde_json::json!({ "capture": "garden", "settings": { "iterations": 7 } });
    let scene = HybridScene { splats: splats(3, 0), meshes: vec![], composition: Composition::default() };
    gltf::write_glb(path, &scene, &[], Some(record.clone())).unwrap();
    record
}

pub(crate) fn read(path: &Path) -> format::SceneFile {
    format::read_file(path, &format::ReadOptions::default()).unwrap()
}

/// Runs `centaur convert` with `args` separated by blanks; what it prints, notes last.
pub(crate) fn convert(folder: &Path, args: &str) -> String {
    let output = common::centaur(folder).arg("convert").args(args.split(' ')).output().unwrap();
    assert_eq!(output.status.code(), Some(0), "{args}: {}", stderr(&output));
    assert!(stderr(&output).lines().all(|line| line.starts_with("note: ")), "{args}: {}", stderr(&output));
    common::said(&output)
}

pub(crate) fn as_json(folder: &Path, args: &str) -> serde_json::Value {
    serde_json::from_str(&convert(folder, &format!("{args} --json"))).unwrap()
}

pub(crate) fn failure(folder: &Path, args: &str) -> String {
    common::failure(folder, common::centaur(folder).arg("convert").args(args.split(' ')))
}

#[test]
fn wrong_usage_is_exit_code_2() {
    let folder = tempfile::tempdir().unwrap();
    for args in [
        "",
        "a.ply -o b.txt",
        "a.ply b.ply --axes y-up",
        "a.ply b.ply --axes up:down",
        "a.ply b.ply --scale 0",
        "a.ply b.ply --rotate 1,2",
        "a.ply b.ply --translate 1,2,nan",
        "a.ply b.ply --keep-box 0,0,0,1,-1,1",
        "a.ply b.ply --remove-sphere 0,0,0,-1",
        "a.ply b.ply --min-opacity 2",
        "a.ply b.ply --decimate 101%",
        "a.ply b.ply --sh-degree 4",
        "a.ply b.spz --spz-version 1",
    ] {
        let output = common::centaur(folder.path()).arg("convert").args(args.split(' ')).output().unwrap();
        assert_eq!(output.status.code(), Some(2), "{args}");
        assert!(output.stdout.is_empty() && stderr(&output).contains("--help"), "{args}: {}", stderr(&output));
    }
}

#[test]
fn the_output_may_be_named_anywhere_by_an_option() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    ply::write(&path("a.ply"), &splats(5, 1)).unwrap();
    convert(folder.path(), "a.ply b.glb");
    for args in ["-o c.glb a.ply", "a.ply --output c.glb", "a.ply a.ply -o d.glb"] {
        convert(folder.path(), args);
    }
    assert_eq!(std::fs::read(path("b.glb")).unwrap(), std::fs::read(path("c.glb")).unwrap());
    assert_eq!(format::read_scene(&path("d.glb")).unwrap().splats.len(), 10);
    let line = failure(folder.path(), "a.ply none.ply -o e.glb");
    assert_eq!(line, "error: none.ply: cannot read: No such file or directory");
    for (args, expected) in [
        ("a.ply", "expected files to read and one to write, found one; --help says more"),
        (
            "a.ply b.txt",
            "b.txt: expected a name that ends in .glb or .gltf or .usda or .usdz or .ply or .sog or .spz or .splat or .ksplat or .xml or .blend.py",
        ),
    ] {
        let line =
            common::wrong_usage(folder.path(), common::centaur(folder.path()).arg("convert").args(args.split(' ')));
        assert_eq!(line, format!("error: {expected}"));
    }
}

#[test]
fn what_is_lost_is_named_or_refused() {
    let folder = tempfile::tempdir().unwrap();
    write_hybrid(&folder.path().join("h.glb"));
    let line = failure(folder.path(), "h.glb s.ply --strict");
    assert_eq!(line, "error: s.ply: --strict: a .ply would lose 1 mesh(es); 1 camera(s); the blending rule");
    let outcome = as_json(folder.path(), "h.glb s.ply");
    assert_eq!((outcome["lossless"].as_bool(), outcome["loss"]["meshes"].as_u64()), (Some(false), Some(1)));
    assert_eq!((outcome["splats"].as_u64(), outcome["meshes"].as_u64()), (Some(10), Some(0)));

    let outcome = as_json(folder.path(), "h.glb s.ply --no-mesh --no-cameras --strict");
    assert_eq!(outcome["lossless"].as_bool(), Some(true), "what options remove is no loss: {outcome}");
    let outcome = as_json(folder.path(), "h.glb again.glb --strict");
    assert_eq!((outcome["meshes"].as_u64(), outcome["cameras"].as_u64()), (Some(1), Some(1)));
    let [before, after] = ["h.glb", "again.glb"].map(|name| read(&folder.path().join(name)));
    assert_eq!(before.scene.meshes, after.scene.meshes);
    let (camera, same) = (before.cameras[0].1, after.cameras[0].1);
    assert!(camera.rotation().abs_diff_eq(same.rotation(), 1e-12) && camera.translation() == same.translation());
}

#[test]
fn records_of_trainings_are_kept_or_named_and_no_part_of_the_scene() {
    let folder = tempfile::tempdir().unwrap();
    let record = write_trained(&folder.path().join("a.glb"));
    let kept =
        |name: &str| format::read_file(&folder.path().join(name), &format::ReadOptions::default()).unwrap().record;
    for args in ["a.glb b.usdz", "b.usdz c.glb", "c.glb d.gltf --decimate 2", "d.gltf e.usda"] {
        let said = convert(folder.path(), args);
        let output = args.split(' ').nth(1).unwrap();
        assert!(kept(output) == Some(record.clone()) && !said.contains("record"), "{args}: {said}");
    }
    for output in ["a.ply", "a.spz", "a.sog"] {
        let said = convert(folder.path(), &format!("a.glb {output}"));
        assert!(said.starts_with("lost: the record of the training"), "{output}: {said}");
    }
    convert(folder.path(), "a.glb strict.ply --strict");
    // Losses that --strict permits are not named as a reason of refusal.
    let line = failure(folder.path(), "a.glb b.splat --strict");
    assert!(line.starts_with("error: b.splat: --strict: a .splat would lose ") && !line.contains("record"), "{line}");
    let said = convert(folder.path(), "a.glb a.ply two.glb --strict");
    assert!(said.starts_with("lost: the record of the training") && kept("two.glb").is_none(), "{said}");
}

#[test]
fn refusals_are_one_line_and_leave_nothing() {
    let folder = tempfile::tempdir().unwrap();
    write_hybrid(&folder.path().join("h.glb"));
    std::fs::write(folder.path().join("notes.txt"), "not a scene").unwrap();
    for (args, expected) in [
        ("none.ply b.glb", "error: none.ply: cannot read: No such file or directory"),
        ("h.glb none/b.glb", "error: none/b.glb: cannot write: folder none: No such file or directory"),
        (
            "h.glb b.glb --keep-sphere 99,99,99,1",
            "error: b.glb: expected something to write, found no splats and no meshes after removing",
        ),
        ("h.glb b.ply --min-opacity 1", "error: b.ply: expected splats for a .ply, found meshes alone"),
        ("h.glb b.glb --scale 1e300", "error: moving the scene: near: expected a positive number, found inf"),
    ] {
        assert_eq!(failure(folder.path(), args), expected);
    }
    assert!(failure(folder.path(), "h.glb notes.txt b.glb").starts_with("error: notes.txt: byte 0: expected a "));
}

#[test]
fn where_nothing_is_left_all_notes_say_what_was_left_out() {
    let folder = tempfile::tempdir().unwrap();
    let usda = "#usda 1.0\n(\n    upAxis = \"Y\"\n)\ndef PointInstancer \"P\"\n{\n}\n";
    std::fs::write(folder.path().join("copies.usda"), usda).unwrap();
    let output = common::centaur(folder.path()).args(["convert", "copies.usda", "b.glb"]).output().unwrap();
    let said = stderr(&output);
    let (notes, error) = said.trim_end().rsplit_once('\n').unwrap();
    assert_eq!(error, "error: b.glb: expected something to write, found no splats and no meshes");
    assert!(notes.contains("note: copies.usda: 1 prim of type PointInstancer left out, with all below"), "{notes}");
    assert!(output.status.code() == Some(1) && notes.lines().all(|line| line.starts_with("note: ")), "{notes}");
    // Nor do steps change that, if they remove nothing.
    let command = ["convert", "copies.usda", "b.glb", "--no-mesh"];
    let output = common::centaur(folder.path()).args(command).output().unwrap();
    assert_eq!(stderr(&output), said);
}

#[test]
fn steps_that_remove_nothing_say_so() {
    let folder = tempfile::tempdir().unwrap();
    write_hybrid(&folder.path().join("h.glb"));
    let said = convert(folder.path(), "h.glb m.glb --min-opacity 1");
    assert!(said.starts_with("min-opacity: removed 10 splats\n"), "{said}");
    let said = convert(folder.path(), "m.glb n.glb --keep-sphere 0,0,0,99 --decimate 50%");
    assert!(said.starts_with("crop: removed nothing\ndecimate: removed nothing\n"), "{said}");
    let said = convert(folder.path(), "m.glb h.glb -o n.glb --no-mesh");
    assert!(said.starts_with("no-mesh: removed 2 triangles\n"), "{said}");
}

#[test]
fn joined_files_keep_their_copyrights_and_name_their_extras_as_lost() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    write_hybrid(&at("h.glb"));
    ply::write(&at("a.ply"), &splats(2, 1)).unwrap();
    convert(folder.path(), "h.glb h.gltf");
    let json = |name: &str| -> serde_json::Value { serde_json::from_slice(&std::fs::read(at(name)).unwrap()).unwrap() };
    for (name, copyright) in [("us.gltf", "us"), ("them.gltf", "them")] {
        let mut document = json("h.gltf");
        document["asset"]["copyright"] = copyright.into();
        if name == "us.gltf" {
            document["extras"] = serde_json::json!({ "of": "root" });
        }
        std::fs::write(at(name), document.to_string()).unwrap();
    }
    let extras = "us.gltf: left out on joining: extras of the file";
    let said = convert(folder.path(), "us.gltf a.ply us.gltf them.gltf -o all.gltf");
    assert!(said.starts_with("lost: nothing, except as noted\n") && said.contains(extras), "{said}");
    assert_eq!(json("all.gltf")["asset"]["copyright"], "us; them");
    let line = failure(folder.path(), "us.gltf a.ply strict.gltf --strict");
    assert!(line.starts_with("error: us.gltf: --strict: ") && line.ends_with("extras of the file"), "{line}");
    convert(folder.path(), "them.gltf a.ply -o two.gltf --strict");
    assert_eq!(json("two.gltf")["asset"]["copyright"], "them");
    for output in ["b.ply", "c.usda", "d.xml", "e.blend.py"] {
        let said = convert(folder.path(), &format!("them.gltf a.ply -o {output}"));
        assert!(said.lines().any(|line| line.starts_with("lost: ") && line.contains("the copyright")), "{said}");
    }
}

#[test]
fn moving_turns_splats_meshes_and_cameras_with_their_harmonics() {
    let folder = tempfile::tempdir().unwrap();
    write_hybrid(&folder.path().join("h.glb"));
    convert(folder.path(), "h.glb moved.glb --axes y-down:unity --scale 2 --rotate 0,0,90 --translate -1,0,0.5");
    let [before, after] = ["h.glb", "moved.glb"].map(|name| read(&folder.path().join(name)));
    // y-down to Unity mirrors y; then (x, y, z) becomes (−y, x, z).
    let orthogonal = DMat3::from_cols(DVec3::Y, DVec3::X, DVec3::Z);
    let by = Similarity::new(2.0, orthogonal, DVec3::new(-1.0, 0.0, 0.5)).unwrap();
    let expected = by.scene(before.scene).unwrap();
    let near = |a: &[[f32; 3]], b: &[[f32; 3]]| {
        a.as_flattened().iter().zip(b.as_flattened()).all(|(a, b)| (a - b).abs() < 1e-5 * b.abs().max(1.0))
    };
    assert!(near(after.scene.splats.sh(), expected.splats.sh()));
    let rows = |points: &[Vec3]| points.iter().map(Vec3::to_array).collect::<Vec<_>>();
    assert!(near(&rows(after.scene.splats.means()), &rows(expected.splats.means())));
    assert!(near(&rows(after.scene.meshes[0].positions()), &rows(expected.meshes[0].positions())));
    let bands = |scene: &HybridScene| scene.meshes[0].atlas().bands().unwrap().texels().as_chunks().0.to_vec();
    assert!(near(&bands(&after.scene), &bands(&expected)));
    let (camera, moved) = (by.camera(&before.cameras[0].1).unwrap(), after.cameras[0].1);
    assert!(camera.rotation().abs_diff_eq(moved.rotation(), 1e-6) && camera.center().abs_diff_eq(moved.center(), 1e-5));
    assert_eq!(camera.intrinsics(), moved.intrinsics());
}

#[test]
fn a_rule_that_no_input_states_is_not_lost_by_scaling() {
    let folder = tempfile::tempdir().unwrap();
    ply::write(&folder.path().join("a.ply"), &splats(5, 1)).unwrap();
    assert!(convert(folder.path(), "a.ply b.ply --scale 100 --strict").starts_with("lost: nothing\n"));
    // A format that can state the near plane has it in the new unit; a format that cannot then loses it.
    convert(folder.path(), "a.ply b.glb --scale 100 --strict");
    assert_eq!(format::read_scene(&folder.path().join("b.glb")).unwrap().composition.near, 20.0);
    let line = failure(folder.path(), "b.glb c.ply --strict");
    assert_eq!(line, "error: c.ply: --strict: a .ply would lose the blending rule");
}

#[test]
fn filters_apply_in_one_order_whatever_the_order_of_options() {
    let folder = tempfile::tempdir().unwrap();
    ply::write(&folder.path().join("a.ply"), &splats(100, 2)).unwrap();
    let options = [
        "--translate=-10,-10,-10",
        "--keep-box=-inf,-inf,0,50,inf,inf",
        "--min-opacity=0.3",
        "--decimate=50%",
        "--sh-degree=1",
        "--morton",
    ];
    let outcome = as_json(folder.path(), &format!("a.ply b.ply {}", options.join(" ")));
    let steps: Vec<(&str, u64)> = (outcome["steps"].as_array().unwrap().iter())
        .map(|s| (s["step"].as_str().unwrap(), s["removed_splats"].as_u64().unwrap()))
        .collect();
    // Splat i moves to i − 10; 51 of them are within 0 to 50.
    assert_eq!(steps[0], ("crop", 49));
    assert_eq!((steps[1].0, steps[2].0), ("min-opacity", "decimate"));
    let left = 51 - steps[1].1;
    assert!(steps[1].1 > 0 && steps[2].1.abs_diff(left / 2) <= 1, "{steps:?}");
    assert_eq!((outcome["splats"].as_u64().unwrap(), outcome["sh_degree"].as_u64()), (left - steps[2].1, Some(1)));

    let reversed: Vec<&str> = options.iter().rev().copied().collect();
    convert(folder.path(), &format!("{} a.ply c.ply", reversed.join(" ")));
    let [b, c] = ["b.ply", "c.ply"].map(|name| std::fs::read(folder.path().join(name)).unwrap());
    assert_eq!(b, c);
    let kept = read(&folder.path().join("b.ply")).scene.splats;
    assert!(kept.opacity_logits().iter().all(|&l| l >= (0.3_f32 / 0.7).ln()));
    assert_eq!(in_morton_order(&kept), (0..kept.len()).collect::<Vec<_>>());
}

#[test]
fn several_inputs_become_one_scene() {
    let folder = tempfile::tempdir().unwrap();
    write_hybrid(&folder.path().join("h.glb"));
    ply::write(&folder.path().join("a.ply"), &splats(7, 1)).unwrap();
    let outcome = as_json(folder.path(), "a.ply h.glb a.ply all.glb");
    assert_eq!(outcome["inputs"].as_array().unwrap().len(), 3);
    let all = format::read_scene(&folder.path().join("all.glb")).unwrap();
    assert_eq!((all.splats.len(), all.splats.sh_degree(), all.meshes.len()), (24, 3, 1));
    assert_eq!(all.splats.sh_of(20)[..4], *splats(7, 1).sh_of(3));
    assert_eq!(all.splats.sh_of(20)[4..], [[0.0; 3]; 12]);

    // If an input's composition is overruled by the others, a note names the difference.
    let mip =
        Composition { pixel_filter: centaur::scene::PixelFilter::MIP, background: [1.0; 3], ..Composition::default() };
    let scene = HybridScene { splats: splats(1, 0), meshes: vec![], composition: mip };
    format::write_scene(&folder.path().join("m.glb"), &scene, &WriteOptions::default()).unwrap();
    let said = convert(folder.path(), "a.ply m.glb -o b.glb");
    assert!(said.contains("note: m.glb: left out on joining: its own pixel filter\n"), "{said}");
    assert_eq!(format::read_scene(&folder.path().join("b.glb")).unwrap().composition.background, [1.0; 3]);
    let line = failure(folder.path(), "a.ply m.glb -o b.glb --strict");
    assert!(line.contains("pixel filter"), "{line}");
    assert!(!convert(folder.path(), "m.glb m.glb -o b.glb").contains("left out"));
    // With a glob such as `*.glb` the last name is not meant as an output.
    let line = failure(folder.path(), "a.ply m.glb b.glb");
    assert_eq!(line, "error: b.glb: exists already: -o b.glb replaces it");
    std::fs::copy(folder.path().join("b.glb"), folder.path().join("b c.glb")).unwrap();
    let mut convert_all = common::centaur(folder.path());
    let line = common::failure(folder.path(), convert_all.args(["convert", "a.ply", "m.glb", "b c.glb"]));
    let quoted = if cfg!(windows) { "\"b c.glb\"" } else { "'b c.glb'" };
    assert_eq!(line, format!("error: b c.glb: exists already: -o {quoted} replaces it"));
    // Of two names of one kind the second is written, and that is said.
    format::write_scene(&folder.path().join("old.glb"), &scene, &WriteOptions::default()).unwrap();
    let note = "note: old.glb: existed before and is replaced: the last file is the one to write\n";
    assert!(
        convert(folder.path(), "m.glb old.glb").contains(note)
            && !convert(folder.path(), "m.glb -o old.glb").contains(note)
    );
    assert!(convert(folder.path(), "a.ply old.glb").contains(note), "of any two names");
    // An output that cannot be written is reported before that check.
    let line =
        common::wrong_usage(folder.path(), common::centaur(folder.path()).args(["convert", "a.ply", "m.glb", "."]));
    assert!(!line.contains("replaces"), "{line}");
    // A .ply has no background, so none is left out.
    let said = convert(folder.path(), "m.glb a.ply -o b.glb");
    assert!(said.contains("note: a.ply: left out on joining: its own pixel filter\n"), "{said}");

    // A scene with a mesh that states a rule has priority, in any position; a stated black background counts like any
    // other.
    for inputs in ["h.glb m.glb", "m.glb h.glb"] {
        let said = convert(folder.path(), &format!("{inputs} -o b.glb"));
        assert!(said.contains("note: m.glb: left out on joining: its own ") && said.contains("background\n"), "{said}");
        assert_eq!(format::read_scene(&folder.path().join("b.glb")).unwrap().composition.background, [0.0; 3]);
    }
    let black = Composition { near: 0.5, ..Composition::default() };
    let scene = HybridScene { splats: splats(1, 0), meshes: vec![], composition: black };
    format::write_scene(&folder.path().join("k.glb"), &scene, &WriteOptions::default()).unwrap();
    let said = convert(folder.path(), "m.glb k.glb -o b.glb");
    assert!(
        said.contains("note: k.glb: left out on joining: its own pixel filter and background and near plane\n"),
        "{said}"
    );
    // The near plane of a .ply is a default, not its own.
    convert(folder.path(), "a.ply k.glb -o b.glb --strict");
    assert_eq!(format::read_scene(&folder.path().join("b.glb")).unwrap().composition.near, 0.5);

    let linear = Composition { color_space: centaur::scene::ColorSpace::LinearDisplay, ..Composition::default() };
    let scene = HybridScene { splats: splats(1, 0), meshes: vec![], composition: linear };
    format::write_scene(&folder.path().join("l.glb"), &scene, &WriteOptions::default()).unwrap();
    let line = failure(folder.path(), "h.glb l.glb -o b.glb");
    assert!(line.starts_with("error: joining the inputs: ") && line.contains("LinearDisplay"), "{line}");
}

/// Writes `splats` with a label of 8 bits per splat, its index; the splats in `broken` have no finite mean.
fn write_labelled(path: &Path, n: usize, broken: &[usize]) {
    ply::write(path, &splats(n, 0)).unwrap();
    let plain = std::fs::read(path).unwrap();
    let body = plain.len() - n * 68;
    let header = String::from_utf8(plain[..body].to_vec()).unwrap();
    let mut file = header.replace("end_header", "property uchar label\nend_header").into_bytes();
    for (i, row) in plain[body..].as_chunks::<68>().0.iter().enumerate() {
        let mut row = *row;
        if broken.contains(&i) {
            row[..4].copy_from_slice(&f32::NAN.to_le_bytes());
        }
        file.extend(row);
        file.push(i as u8);
    }
    std::fs::write(path, file).unwrap();
}

#[test]
fn attributes_follow_their_splats_as_far_as_ply_goes() {
    let folder = tempfile::tempdir().unwrap();
    write_labelled(&folder.path().join("a.ply"), 9, &[]);
    let labels = |name: &str| {
        let file = read(&folder.path().join(name));
        assert!(file.attributes.iter().all(|a| a.name() == "label"));
        file.attributes.first().map(|a| a.values().to_vec())
    };
    convert(folder.path(), "a.ply b.ply --strict");
    assert_eq!(
        std::fs::read(folder.path().join("b.ply")).unwrap(),
        std::fs::read(folder.path().join("a.ply")).unwrap()
    );
    // Mirrored at the origin, the Morton order is reversed.
    convert(
        folder.path(),
        "a.ply b.ply --axes RUB:LDF --remove-sphere 0,0,0,0 --remove-box -4,-4,-4,-3,-3,-3 --morton",
    );
    assert_eq!(labels("b.ply"), Some(vec![8.0, 7.0, 6.0, 5.0, 2.0, 1.0]));
    convert(folder.path(), "a.ply a.ply -o b.ply");
    assert_eq!(labels("b.ply").map(|l| l.len()), Some(18));

    // A mesh-only scene has no splats that could be missing.
    write_hybrid(&folder.path().join("h.glb"));
    let mut scene = format::read_scene(&folder.path().join("h.glb")).unwrap();
    scene.splats = Splats::empty(0);
    format::write_scene(&folder.path().join("mesh.glb"), &scene, &WriteOptions::default()).unwrap();
    convert(folder.path(), "a.ply mesh.glb -o b.ply");
    assert_eq!(labels("b.ply").map(|l| l.len()), Some(9));

    ply::write(&folder.path().join("plain.ply"), &splats(2, 0)).unwrap();
    let said = convert(folder.path(), "a.ply plain.ply -o b.ply");
    assert!(said.contains("note: a.ply: attribute label: left out, not in all inputs\n"), "{said}");
    assert_eq!(labels("b.ply"), None);
    let line = failure(folder.path(), "a.ply c.glb --strict");
    assert!(line.starts_with("error: c.glb: --strict: a .glb would lose the attributes label"), "{line}");
}

#[test]
fn invalid_splats_are_refused_or_dropped() {
    let folder = tempfile::tempdir().unwrap();
    write_labelled(&folder.path().join("a.ply"), 5, &[0, 3]);
    assert_eq!(
        failure(folder.path(), "a.ply b.ply"),
        "error: a.ply: byte 432: expected finite numbers, found NaN in row 0 of `x`; `centaur convert --drop-invalid` leaves such splats out"
    );
    let said = convert(folder.path(), "a.ply b.ply --drop-invalid");
    assert!(said.starts_with("a.ply: dropped 2 invalid splats\n"), "{said}");
    write_labelled(&folder.path().join("one.ply"), 2, &[0]);
    let said = convert(folder.path(), "one.ply c.ply --drop-invalid");
    assert!(said.starts_with("one.ply: dropped 1 invalid splat\n") && said.contains(": 1 splat of SH"), "{said}");
    let left = read(&folder.path().join("b.ply"));
    assert_eq!(left.attributes[0].values(), [1.0, 2.0, 4.0]);
    assert_eq!(as_json(folder.path(), "a.ply b.ply --drop-invalid")["inputs"][0]["dropped"].as_u64(), Some(2));
    // Formats that are read whole or not at all, with the place of the fault.
    for whole in ["b.spz", "b.compressed.ply", "b.glb"] {
        convert(folder.path(), &format!("b.ply {whole}"));
        let note = format!(
            "--drop-invalid has no effect on {whole}: it applies to .splat, and to .ply that is not compressed"
        );
        let said = convert(folder.path(), &format!("a.ply {whole} -o d.ply --drop-invalid"));
        assert!(said.contains(&format!("\nnote: d.ply: {note}\n")), "{said}");
        let said = as_json(folder.path(), &format!("{whole} -o d.splat --drop-invalid"));
        assert_eq!((&said["inputs"][0]["dropped"], &said["notes"]), (&0.into(), &[note].into()));
    }
    let said = convert(folder.path(), "d.splat e.ply --drop-invalid");
    assert!(!said.contains("no effect"), "{said}");
}

/// As clusters set it: the program must not end silently and leave half a file.
#[cfg(unix)]
#[test]
fn a_limit_on_the_size_of_files_is_an_error() {
    let folder = tempfile::tempdir().unwrap();
    ply::write(&folder.path().join("a.ply"), &splats(200, 3)).unwrap();
    let line = format!("ulimit -f 8; exec {} convert a.ply b.ply", env!("CARGO_BIN_EXE_centaur"));
    let output = std::process::Command::new("sh").args(["-c", &line]).current_dir(folder.path()).output().unwrap();
    let said = String::from_utf8(output.stderr).unwrap();
    assert_eq!((output.status.code(), said.as_str()), (Some(1), "error: b.ply: cannot write: File too large\n"));
    assert_eq!(common::tree(folder.path()).len(), 1, "nothing is left");
}
