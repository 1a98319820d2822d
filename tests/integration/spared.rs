//! Files not named as an output are not overwritten.

use std::path::Path;

use crate::common::{self, centaur, stderr, write_capture};
use centaur::format::{WriteOptions, write_scene};
use centaur::scene::{Composition, HybridScene, Splats};
use glam::{Quat, Vec3};

/// Runs a command that must succeed; returns its output.
fn run(folder: &Path, args: &str) -> String {
    let output = centaur(folder).args(args.split(' ')).output().unwrap();
    assert!(output.status.success(), "{args}: {}", stderr(&output));
    common::said(&output)
}

/// Error line of a command that must fail and change no file.
fn refused(folder: &Path, args: &str) -> String {
    common::failure(folder, centaur(folder).args(args.split(' ')))
}

fn write_splats(path: &Path, n: usize) {
    let means = (0..n).map(|i| Vec3::new(0.1 * i as f32, 0.0, 0.0)).collect();
    let splats =
        Splats::new(means, vec![Quat::IDENTITY; n], vec![Vec3::splat(-3.0); n], vec![2.0; n], 1, vec![[0.5; 3]; 4 * n]);
    let scene = HybridScene { splats: splats.unwrap(), meshes: vec![], composition: Composition::default() };
    write_scene(path, &scene, &WriteOptions::default()).unwrap();
}

#[test]
fn a_path_does_not_replace_the_scene_it_is_of() {
    let folder = tempfile::tempdir().unwrap();
    write_capture(&folder.path().join("capture"), 9, (16, 12));
    run(folder.path(), "cameras convert capture -o scene.glb");
    for kind in ["orbit scene.glb -o scene.glb --frames 3", "convert scene.glb -o ./scene.glb"] {
        let line = refused(folder.path(), &format!("cameras {kind}"));
        let is_so = line.contains("another file than scene.glb, which would be lost; --with-scene writes it again");
        assert!(is_so, "{line}");
    }
}

#[test]
fn advice_is_of_what_the_format_can_do() {
    let folder = tempfile::tempdir().unwrap();
    write_capture(&folder.path().join("capture"), 9, (16, 12));
    run(folder.path(), "cameras convert capture -o path.json");
    let line = refused(folder.path(), "cameras convert path.json -o path.json");
    assert_eq!(line, "error: path.json: expected another file than path.json, which would be lost");
}

#[test]
fn a_surface_does_not_replace_what_it_is_made_of() {
    let folder = tempfile::tempdir().unwrap();
    write_capture(&folder.path().join("capture"), 9, (16, 12));
    write_splats(&folder.path().join("splats.glb"), 5);
    let line = refused(folder.path(), "mesh splats.glb capture -o splats.glb");
    assert_eq!(line, "error: splats.glb: expected another file than splats.glb, which would be lost");
    let line = refused(folder.path(), "train capture --mesh splats.glb -o splats.glb");
    assert_eq!(line, "error: splats.glb: expected another file than splats.glb, which would be lost");
}

#[test]
fn pictures_do_not_replace_photographs() {
    let folder = tempfile::tempdir().unwrap();
    write_capture(&folder.path().join("capture"), 9, (16, 12));
    write_splats(&folder.path().join("splats.ply"), 5);
    let line = refused(folder.path(), "render splats.ply --cameras capture -o capture/images");
    assert!(line.ends_with("000.png: is a photograph of the capture: expected another folder"), "{line}");
    let line = refused(folder.path(), "eval splats.ply capture -o capture/images");
    assert!(line.ends_with("000.png: is a photograph of the capture: expected another folder"), "{line}");
    // Refused before training, not after it.
    let line = refused(folder.path(), "train capture -o s.glb --no-mesh --iterations 1 --report capture/images");
    assert!(line.ends_with("000.png: is a photograph of the capture: expected another folder"), "{line}");
    // Beside photographs of other names the renders would be taken for photographs.
    let other = folder.path().join("other");
    write_capture(&other, 9, (16, 12));
    for i in 0..9 {
        let at = |extension: &str| other.join(format!("images/{i:03}.{extension}"));
        std::fs::rename(at("png"), at("PNG")).unwrap();
    }
    let list = other.join("sparse/0/images.txt");
    std::fs::write(&list, std::fs::read_to_string(&list).unwrap().replace(".png", ".PNG")).unwrap();
    for args in [
        "render splats.ply --cameras other -o other/images",
        "eval splats.ply other -o other/images",
        "train other -o s.glb --no-mesh --iterations 1 --report ./other/images",
    ] {
        let line = refused(folder.path(), args);
        assert!(line.ends_with("other/images: holds photographs of the capture: expected another folder"), "{line}");
    }
    // Masks are found by the names that renders have.
    std::fs::create_dir_all(other.join("masks/left")).unwrap();
    for args in [
        "render splats.ply --cameras other -o other/masks",
        "render splats.ply --cameras other -o other/masks/left",
        "eval splats.ply other -o other/masks",
        "train other -o s.glb --no-mesh --iterations 1 --report other/masks",
    ] {
        let line = refused(folder.path(), args);
        assert!(line.ends_with(": holds masks of the capture: expected another folder"), "{line}");
    }
    // A folder of that name elsewhere is not affected.
    std::fs::create_dir(folder.path().join("masks")).unwrap();
    run(folder.path(), "render splats.ply --cameras other -o masks");
    // Renders of several cameras are a folder deeper.
    let rig = folder.path().join("rig");
    write_capture(&rig, 9, (16, 12));
    std::fs::rename(rig.join("images"), rig.join("left")).unwrap();
    std::fs::create_dir(rig.join("images")).unwrap();
    std::fs::rename(rig.join("left"), rig.join("images/left")).unwrap();
    let list = rig.join("sparse/0/images.txt");
    let names = (0..9).fold(std::fs::read_to_string(&list).unwrap(), |text, i| {
        text.replace(&format!(" {i:03}.png"), &format!(" left/{i:03}.png"))
    });
    std::fs::write(&list, names).unwrap();
    run(folder.path(), "cameras orbit capture -o orbit.json --frames 2");
    let line = refused(folder.path(), "render splats.ply --cameras orbit.json -o rig/images/left");
    assert!(line.ends_with("rig/images/left: holds photographs of the capture: expected another folder"), "{line}");
    // Cameras in the scene's own file do not tell where the photographs are.
    run(folder.path(), "train capture -o s.glb --ply s.ply --no-mesh --iterations 1 --max-splats 50 --no-eval");
    let line = refused(folder.path(), "render s.glb -o capture/images");
    assert!(line.ends_with("000.png: is a photograph of the capture: expected another folder"), "{line}");
    // Pictures of an earlier run are replaced, in the capture as anywhere.
    for _ in 0..2 {
        run(folder.path(), "render splats.ply --cameras capture -o capture/renders");
    }
}

#[test]
fn splats_do_not_replace_the_points_that_they_begin_with() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    write_capture(&at("capture"), 9, (16, 12));
    run(folder.path(), "cameras convert capture -o capture/images/transforms.json");
    let list = at("capture/images/transforms.json");
    let text = std::fs::read_to_string(&list).unwrap().replacen('{', r#"{"ply_file_path":"points.ply","#, 1);
    std::fs::write(&list, text).unwrap();
    let points = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\nproperty uchar red\n\
                  property uchar green\nproperty uchar blue\nend_header\n0 0 0 9 9 9\n0 0.1 0 9 9 9\n";
    std::fs::write(at("capture/images/points.ply"), points).unwrap();
    // Even if the points are not used.
    for without in ["", " --no-points"] {
        let train = "train capture/images -o s.glb --ply capture/images/points.ply --iterations 1 --no-mesh";
        let line = refused(folder.path(), &format!("{train}{without}"));
        assert!(line.ends_with("points.ply, which would be lost"), "{line}");
    }
}

#[test]
fn exports_do_not_replace_files_of_others_beside_them() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    write_splats(&at("g.ply"), 5);
    write_splats(&at("g_splats.ply"), 9);
    // Its own input; then the output of a training.
    let line = refused(folder.path(), "convert g_splats.ply g.xml");
    assert!(
        line.starts_with("error: g.xml: would replace ")
            && line.ends_with("is an input; another name or a folder of its own keeps both"),
        "{line}"
    );
    let line = refused(folder.path(), "convert g.ply g.xml");
    let expected = "g_splats.ply, which exists already; another name or a folder of its own keeps both";
    assert!(line.ends_with(expected), "{line}");
    // An export may be repeated, also beside another export of the same scene.
    std::fs::remove_file(at("g_splats.ply")).unwrap();
    for args in ["convert g.ply g.xml", "convert g.ply g.xml --scale 2", "convert g.ply g.xml"] {
        run(folder.path(), args);
    }
    // Also if the name comes late in the file, across a block boundary of the reader.
    let text = std::fs::read_to_string(at("g.xml")).unwrap();
    let begin = text.find("g_splats.ply").unwrap();
    let late = format!("<!--{}-->", " ".repeat((1 << 20) - begin - 7 - 4));
    std::fs::write(at("g.xml"), [&late, &text[..]].concat()).unwrap();
    run(folder.path(), "convert g.ply g.xml --scale 3");
    run(folder.path(), "convert g.ply g.xml");
    // The plug-in is identical, so several scenes can share it.
    run(folder.path(), "convert g.ply other.xml");
    let line = refused(folder.path(), "convert g.ply g.blend.py --scale 3");
    assert!(line.starts_with("error: g.blend.py: would replace ") && line.ends_with(expected), "{line}");
}

#[test]
fn outputs_do_not_replace_files_that_others_use() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    write_splats(&at("g.ply"), 5);
    write_splats(&at("h.ply"), 9);
    for (export, splats) in [("a.xml", "a_splats.ply"), ("b.blend.py", "b_splats.ply")] {
        run(folder.path(), &format!("convert g.ply {export}"));
        for args in [format!("convert h.ply {splats}"), format!("convert h.ply -o {splats}")] {
            let line = refused(folder.path(), &args);
            assert!(
                line.ends_with(&format!("{splats}: is a file that {export} uses: expected another name")),
                "{line}"
            );
        }
    }
    // Names that only end or begin so are of other files.
    let text = std::fs::read_to_string(at("a.xml")).unwrap();
    std::fs::write(at("a.xml"), text.replace("\"a_splats.ply\"", "\"aa_splats.ply\"")).unwrap();
    let said = run(folder.path(), "convert h.ply a_splats.ply");
    assert!(said.contains("note: a_splats.ply: existed before and is replaced"), "{said}");
    // Points of a capture, even if it is read otherwise.
    write_capture(&at("capture"), 9, (16, 12));
    std::fs::create_dir(at("capture/points")).unwrap();
    write_splats(&at("capture/points/p.ply"), 5);
    std::fs::write(at("capture/transforms.json"), r#"{"ply_file_path":"./points/p.ply","frames":[]}"#).unwrap();
    let line = refused(folder.path(), "convert g.ply capture/points/p.ply");
    assert!(line.starts_with("error: capture/points/p.ply: holds the points of the capture "), "{line}");
    assert!(line.ends_with("capture: expected another name"), "{line}");
    run(folder.path(), "convert g.ply capture/points/q.ply");
}

/// An existing output file need not be an export by this program.
#[test]
fn outputs_of_others_do_not_give_their_neighbours_away() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    write_splats(&at("g.ply"), 5);
    write_splats(&at("h_splats.ply"), 9);
    std::fs::write(at("h.xml"), "<scene version='3.0.0'/>\n").unwrap();
    let line = refused(folder.path(), "convert g.ply h.xml");
    assert!(
        line.ends_with("h_splats.ply, which exists already; another name or a folder of its own keeps both"),
        "{line}"
    );
    // Another version, or a file edited by hand, under the name that all scenes use for it.
    std::fs::write(at("hybrid_rf.py"), "# other\n").unwrap();
    let line = refused(folder.path(), "convert g.ply i.xml");
    assert!(line.ends_with("hybrid_rf.py, which exists already; a folder of its own keeps both"), "{line}");
    // Nothing is put beside a scene that cannot be put there.
    std::fs::remove_file(at("hybrid_rf.py")).unwrap();
    std::fs::create_dir(at("hybrid_rf.py")).unwrap();
    refused(folder.path(), "convert g.ply i.xml");
}

/// It may be that of a copy of the export, or the user's.
#[test]
fn what_only_the_replaced_export_used_is_named_and_stays() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    write_splats(&at("g.ply"), 5);
    let leave = || {
        run(folder.path(), "convert g.ply s.blend.py");
        let text = std::fs::read_to_string(at("s.blend.py")).unwrap();
        // As of an animated scene with a mesh.
        let text = text.replace("\"motion\":null", "\"motion\":{\"file\":\"s_motion.npz\",\"mesh\":\"s_mesh0.ply\"}");
        assert!(text.contains("s_motion.npz"));
        std::fs::write(at("s.blend.py"), text).unwrap();
        for name in ["s_motion.npz", "s_mesh0.ply", "s_mesh1.ply"] {
            std::fs::write(at(name), "").unwrap();
        }
    };
    leave();
    let said = run(folder.path(), "convert g.ply s.blend.py --scale 2");
    let is_named = |name: &str| said.contains(&format!("{name}: was used by the replaced export"));
    assert_eq!(["s_motion.npz", "s_mesh0.ply", "s_mesh1.ply"].map(is_named), [true, true, false], "{said}");
    assert!(at("s_motion.npz").exists() && at("s_mesh0.ply").exists());
    leave();
    run(folder.path(), "convert g.ply s.xml");
    let said = run(folder.path(), "convert g.ply s.blend.py");
    assert!(!said.contains("was used by"), "the other export may use it: {said}");
}

/// As after a renaming; only where case does not matter is it the same file.
#[test]
fn an_export_names_its_files_in_any_case_where_the_system_ignores_it() {
    let folder = tempfile::tempdir().unwrap();
    write_splats(&folder.path().join("g.ply"), 5);
    run(folder.path(), "convert g.ply s.xml");
    let export = folder.path().join("s.xml");
    let text = std::fs::read_to_string(&export).unwrap().replace("s_splats.ply", "S_splats.ply");
    assert!(text.contains("S_splats.ply"), "{text}");
    std::fs::write(&export, text).unwrap();
    let again = "convert g.ply s.xml --scale 2";
    if cfg!(any(windows, target_os = "macos")) {
        run(folder.path(), again);
    } else {
        let line = refused(folder.path(), again);
        assert!(line.contains("s_splats.ply, which exists already; "), "{line}");
    }
}

/// Blanks become `_` in names of files beside an export.
#[test]
fn exports_that_share_files_are_told_of() {
    let folder = tempfile::tempdir().unwrap();
    write_splats(&folder.path().join("g.ply"), 5);
    run(folder.path(), "convert g.ply s_1.xml");
    let said = run(folder.path(), "convert g.ply s_1.blend.py");
    assert!(!said.contains("replaced"), "the same files: {said}");
    let said = run(folder.path(), "convert g.ply s_1.xml --scale 2");
    assert!(
        said.contains("note: s_1.xml: s_1.blend.py uses files that were replaced: convert it again, too"),
        "{said}"
    );
    std::fs::rename(folder.path().join("s_1.blend.py"), folder.path().join("s 1.blend.py")).unwrap();
    let line = refused(folder.path(), "convert g.ply s_1.xml");
    let expected = "s_1_splats.ply, which s 1.blend.py uses; another name or a folder of its own keeps both";
    assert!(line.ends_with(expected), "{line}");
}
