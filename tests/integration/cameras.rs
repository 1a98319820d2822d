//! `centaur cameras`, and `centaur render` from its output, as a user runs them.

use std::path::Path;

use crate::common::{centaur, failure, said, stderr, tree, write_capture};
use centaur::capture::{self, LoadOptions};
use centaur::format::{WriteOptions, write_scene};
use centaur::scene::{Camera, Composition, HybridScene, Intrinsics, Splats};
use glam::{DMat3, DVec3, Quat, Vec3};

pub(crate) fn run(folder: &Path, args: &[&str]) -> String {
    let output = centaur(folder).args(args).output().unwrap();
    assert_eq!(output.status.code(), Some(0), "{args:?}: {}", stderr(&output));
    said(&output)
}

/// Writes a ball that is red at x > 0 and blue at x < 0.
pub(crate) fn write_ball(path: &Path, composition: Composition) {
    write_ball_of(path, composition, 1.0);
}

/// Same as [`write_ball`], so many times as large.
fn write_ball_of(path: &Path, composition: Composition, size: f32) {
    let means = vec![size * Vec3::new(0.2, 0.0, 0.0), size * Vec3::new(-0.2, 0.0, 0.0)];
    let color = |c: [f32; 3]| c.map(|v| (v - 0.5) / 0.282_094_8);
    let sh = vec![color([1.0, 0.0, 0.0]), color([0.0, 0.0, 1.0])];
    let scales = vec![Vec3::splat((0.1 * size).ln()); 2];
    let splats = Splats::new(means, vec![Quat::IDENTITY; 2], scales, vec![5.0; 2], 0, sh).unwrap();
    let scene = HybridScene { splats, meshes: vec![], composition };
    write_scene(path, &scene, &WriteOptions::default()).unwrap();
}

#[test]
fn paths_are_made_of_captures_without_photographs_and_rendered() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    write_capture(&at("capture"), 9, (32, 24));
    std::fs::remove_dir_all(at("capture/images")).unwrap();
    write_ball(&at("ball.glb"), Composition::default());
    let shot = ["--frames", "6", "--size", "20x15", "--fps", "12"];
    for (kind, out) in
        [("orbit", "orbit.json"), ("spline", "flight.glb"), ("lemniscate", "eight.usda"), ("orbit", "model")]
    {
        let said = run(folder.path(), &[&["cameras", kind, "capture", "-o", out][..], &shot].concat());
        assert_eq!(said, format!("{out}: 6 frames of 20×15, 0.5 s at 12 frames a second\n"));
    }
    let mut pictures = vec![];
    // The same path in four formats, each converted from the previous one.
    for (from, to) in [("orbit.json", "orbit.glb"), ("orbit.glb", "orbit.usda"), ("orbit.usda", "orbit_model")] {
        run(folder.path(), &["cameras", "convert", from, "-o", to]);
    }
    for (i, path) in ["orbit.json", "orbit.glb", "orbit.usda", "orbit_model"].into_iter().enumerate() {
        let out = format!("frames{i}");
        run(folder.path(), &["render", "ball.glb", "--cameras", path, "-o", &out]);
        let frames: Vec<Vec<u8>> = (0..6)
            .map(|frame| image::open(at(&out).join(format!("frame_{frame:05}.png"))).unwrap().into_rgb8().into_raw())
            .collect();
        assert!(frames[0].len() == 20 * 15 * 3 && frames[0] != frames[3]);
        pictures.push(frames);
    }
    for other in &pictures[1..] {
        let differences = pictures[0].concat().into_iter().zip(other.concat()).map(|(a, b)| a.abs_diff(b));
        assert!(differences.max().unwrap() <= 1);
    }
    // Every frame looks at the ball, which is in the centre.
    for frame in &pictures[0] {
        let brightest = |x: usize| (0..3).map(|c| frame[(7 * 20 + x) * 3 + c]).max().unwrap();
        assert!((8..12).map(brightest).max().unwrap() > 100 && brightest(0) < 20 && brightest(19) < 20);
    }
}

/// A path computed from the cameras of a scene and written into that scene repeatedly is always based on the original
/// cameras; a path that begins later than 0 says so.
#[test]
fn a_path_is_not_made_of_the_one_before() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let lens = Intrinsics { width: 20, height: 15, fx: 18.0, fy: 18.0, cx: 10.0, cy: 7.5 };
    let camera = |i: u32| {
        let turn = DMat3::from_rotation_y(0.5 * f64::from(i));
        (
            format!("view_{i}"),
            Camera::new(lens, turn, DVec3::new(0.1 * f64::from(i * i), 0.0, 3.0 + f64::from(i % 2))).unwrap(),
        )
    };
    let cameras: Vec<_> = (0..5).map(camera).collect();
    let splats = Splats::new(vec![Vec3::ZERO], vec![Quat::IDENTITY], vec![Vec3::ZERO], vec![0.0], 0, vec![[0.0; 3]]);
    let scene = HybridScene { splats: splats.unwrap(), meshes: vec![], composition: Composition::default() };
    write_scene(&at("a.glb"), &scene, &WriteOptions { cameras: &cameras, ..WriteOptions::default() }).unwrap();
    let spline = |from: &str, to: &str| {
        run(folder.path(), &["cameras", "spline", from, "-o", to, "--with-scene", "--frames", "9", "--fps", "4"]);
        run(folder.path(), &["cameras", "convert", to, "-o", "path.json"]);
        std::fs::read_to_string(at("path.json")).unwrap()
    };
    let first = spline("a.glb", "b.gltf");
    assert_eq!(spline("b.gltf", "c.glb"), first);
    // An animation of cameras alone is no loss with --no-cameras, but an animation that could move other things may be.
    let strict = ["convert", "b.gltf", "b.usda", "--no-cameras", "--strict"];
    run(folder.path(), &strict);
    let document = std::fs::read_to_string(at("b.gltf")).unwrap();
    let pointing = document.replace("extensionsUsed\":[", "extensionsUsed\":[\"KHR_animation_pointer\",");
    assert_ne!(pointing.matches("KHR_animation_pointer").count(), 0, "{document}");
    std::fs::write(at("b.gltf"), pointing).unwrap();
    assert!(failure(folder.path(), centaur(folder.path()).args(strict)).contains("KHR_animation_pointer"));
    std::fs::write(at("b.gltf"), document).unwrap();

    let mut late: serde_json::Value = serde_json::from_slice(&std::fs::read(at("b.gltf")).unwrap()).unwrap();
    let first = 5.0 + 1.0 / 24.0f32;
    let times: Vec<u8> = (0..9).flat_map(|i| (first + 0.25 * i as f32).to_le_bytes()).collect();
    std::fs::write(at("times.bin"), &times).unwrap();
    let mut push = |key: &str, value: serde_json::Value| {
        let array = late[key].as_array_mut().unwrap();
        array.push(value);
        array.len() - 1
    };
    let buffer = push("buffers", serde_json::json!({ "byteLength": times.len(), "uri": "times.bin" }));
    let view = push("bufferViews", serde_json::json!({ "buffer": buffer, "byteLength": times.len() }));
    let input = push(
        "accessors",
        serde_json::json!({ "bufferView": view, "componentType": 5126, "type": "SCALAR", "count": 9, "min": [first], "max": [first + 2.0] }),
    );
    let samplers = late["animations"][0]["samplers"].as_array_mut().unwrap();
    samplers.iter_mut().for_each(|sampler| sampler["input"] = input.into());
    std::fs::write(at("late.gltf"), late.to_string()).unwrap();
    let said = run(folder.path(), &["cameras", "convert", "late.gltf", "-o", "late.json"]);
    assert!(
        said.contains("note: late.gltf: begins at 5.042 s, which late.json cannot store: there it begins at 0"),
        "{said}"
    );
    let said = run(folder.path(), &["cameras", "convert", "late.gltf", "-o", "late.usda"]);
    assert!(!said.contains("begins"), "{said}");
    assert!(std::fs::read_to_string(at("late.usda")).unwrap().contains("startTimeCode = 20.1666"));
}

/// Splats of another program, and a y-up model.
#[test]
fn scenes_without_cameras_are_seen_from_around_them() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    for scene in ["ball.ply", "ball.glb"] {
        write_ball(&at(scene), Composition::default());
        let said = run(folder.path(), &["render", scene, "-o", "around", "--max-side", "64"]);
        let up = "with -y up (where it lies on its side, --up z or another axis)";
        let note = format!(
            "note: {scene}: has no cameras: rendered from 8 places around it, {up}; --cameras takes cameras of"
        );
        assert!(said.starts_with("around: 8 pictures\n") && said.contains(&note), "{said}");
        for i in 0..8 {
            let picture = image::open(at(&format!("around/view_{i}.png"))).unwrap().into_rgb8();
            assert_eq!(picture.dimensions(), (64, 48));
            let is_lit = |x: u32, y: u32| picture.get_pixel(x, y).0.iter().any(|c| *c > 100);
            let is_in_the_middle = (20..44).any(|x| is_lit(x, 24));
            assert!(is_in_the_middle && ![(0, 24), (63, 24), (32, 0), (32, 47)].iter().any(|&(x, y)| is_lit(x, y)));
        }
        for (kind, out) in [("orbit", "o.glb"), ("lemniscate", "l.json"), ("spline", "s.usda")] {
            let said = run(folder.path(), &["cameras", kind, scene, "-o", out, "--frames", "3", "--size", "32x24"]);
            let note = format!("note: {scene}: has no cameras: the path is made from 8 around the scene, {up}\n");
            assert!(said.starts_with(&format!("{out}: 3 frames of 32×24")) && said.ends_with(&note), "{said}");
        }
    }
    let theirs = "#usda 1.0\n( metersPerUnit = 1\n upAxis = \"Y\" )\ndef Mesh \"m\" {\n point3f[] points = [(-9, 90, 2), (9, 90, 0), (-1, 99, -3)]\n \
                  int[] faceVertexCounts = [3]\n int[] faceVertexIndices = [0, 1, 2]\n}\n";
    std::fs::write(at("theirs.usda"), theirs).unwrap();
    run(folder.path(), &["cameras", "orbit", "theirs.usda", "-o", "up.json", "--frames", "4"]);
    let path: serde_json::Value = serde_json::from_slice(&std::fs::read(at("up.json")).unwrap()).unwrap();
    // The camera is above the model, and upright.
    let pose = &path["frames"][0]["transform_matrix"];
    assert!(pose[1][3].as_f64().unwrap() > 99.0 && pose[1][1].as_f64().unwrap() > 0.9, "{pose}");
    for (scene, up, axis, sign) in [
        ("theirs.usda", "-y", 1_usize, -1.0),
        ("theirs.usda", "z", 2, 1.0),
        ("ball.ply", "-x", 0, -1.0),
        ("ball.ply", "y", 1, 1.0),
    ] {
        run(folder.path(), &["cameras", "orbit", scene, "-o", "up.json", "--frames", "4", "--up", up]);
        let path: serde_json::Value = serde_json::from_slice(&std::fs::read(at("up.json")).unwrap()).unwrap();
        let pose = &path["frames"][0]["transform_matrix"];
        assert!(sign * pose[axis][1].as_f64().unwrap() > 0.9, "{scene} {up}: {pose}");
    }
    let some = ["render", "ball.glb", "-o", "some", "--camera", "view_3", "--camera", "0", "--max-side", "32"];
    run(folder.path(), &some);
    let names = ["view_0.png", "view_3.png"].map(|name| at("some").join(name).display().to_string());
    assert_eq!(tree(&at("some")), names);
    // A path written into a scene does not count as the scene's cameras.
    for _ in 0..2 {
        run(folder.path(), &["cameras", "orbit", "ball.glb", "-o", "both.glb", "--with-scene", "--frames", "3"]);
        std::fs::rename(at("both.glb"), at("ball.glb")).unwrap();
    }
    let said = run(folder.path(), &["render", "ball.glb", "-o", "path", "--max-side", "32", "--up", "z"]);
    let is_idle = said.contains("note: ball.glb: has cameras: --up has no effect\n");
    assert!(said.starts_with("path: 3 pictures\n") && is_idle, "{said}");
    let empty = HybridScene { splats: Splats::empty(0), meshes: vec![], composition: Composition::default() };
    write_scene(&at("empty.ply"), &empty, &WriteOptions::default()).unwrap();
    let line = failure(folder.path(), centaur(folder.path()).args(["render", "empty.ply", "-o", "no"]));
    assert_eq!(line, "error: empty.ply: expected a scene to look at, found no splats and no meshes");
}

/// As artists make them, in a file of ours and in one that is y up.
#[test]
fn a_scene_with_one_camera_is_circled() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    write_ball(&at("ball.glb"), Composition::default());
    let scene = centaur::format::read_scene(&at("ball.glb")).unwrap();
    let lens = Intrinsics { width: 20, height: 15, fx: 18.0, fy: 18.0, cx: 10.0, cy: 7.5 };
    let camera = Camera::look_at(lens, DVec3::new(0.5, 0.0, -3.0), DVec3::ZERO, DVec3::NEG_Y).unwrap();
    let cameras = [("front".to_owned(), camera)];
    write_scene(&at("ours.glb"), &scene, &WriteOptions { cameras: &cameras, ..WriteOptions::default() }).unwrap();
    let corners = [0.0_f32, 90.0, 0.0, 4.0, 90.0, 0.0, 0.0, 94.0, 0.0];
    std::fs::write(at("theirs.bin"), corners.map(f32::to_le_bytes).as_flattened()).unwrap();
    let theirs = serde_json::json!({
        "asset": { "version": "2.0" }, "scene": 0, "scenes": [{ "nodes": [0, 1] }],
        "nodes": [{ "mesh": 0 }, { "camera": 0, "translation": [2, 92, 10] }],
        "cameras": [{ "type": "perspective", "perspective": { "yfov": 0.8, "aspectRatio": 1.25, "znear": 0.1 } }],
        "meshes": [{ "primitives": [{ "attributes": { "POSITION": 0 } }] }],
        "accessors": [{ "bufferView": 0, "componentType": 5126, "type": "VEC3", "count": 3, "min": [0, 90, 0], "max": [4, 94, 0] }],
        "bufferViews": [{ "buffer": 0, "byteLength": 36 }], "buffers": [{ "byteLength": 36, "uri": "theirs.bin" }],
    });
    std::fs::write(at("theirs.gltf"), theirs.to_string()).unwrap();
    for (scene, middle, distance) in
        [("ours.glb", DVec3::ZERO, 9.25_f64.sqrt()), ("theirs.gltf", DVec3::new(2.0, 92.0, 0.0), 10.0)]
    {
        let note = format!(
            "note: {scene}: optical axes of its cameras do not meet in a point: the path is around the middle of the scene (--focus X,Y,Z)\n"
        );
        for kind in ["orbit", "lemniscate"] {
            let said =
                run(folder.path(), &["cameras", kind, scene, "-o", "path.json", "--frames", "5", "--size", "8x6"]);
            assert!(said.ends_with(&note), "{said}");
        }
        run(folder.path(), &["cameras", "orbit", scene, "-o", "path.json", "--frames", "5", "--size", "8x6"]);
        let path: serde_json::Value = serde_json::from_slice(&std::fs::read(at("path.json")).unwrap()).unwrap();
        for frame in path["frames"].as_array().unwrap() {
            let column =
                |j: usize| DVec3::from([0, 1, 2].map(|i: usize| frame["transform_matrix"][i][j].as_f64().unwrap()));
            let offset = column(3) - middle;
            assert!(
                (offset.length() - distance).abs() < 1e-4 && offset.angle_between(column(2)) < 1e-4,
                "{scene}: {frame}"
            );
        }
    }
    // Of flags that have no effect there is a note.
    let render = ["render", "ball.glb", "--cameras", "ours.glb", "-o", "still", "--fps", "24", "--images", "photos"];
    let said = run(folder.path(), &render);
    for idle in ["its cameras are not frames of a path and have no times: --fps", "names no photographs: --images"] {
        assert!(said.contains(&format!("note: ours.glb: {idle} has no effect\n")), "{said}");
    }
}

/// With a copy of the photographs beside them, as nerfstudio lays captures out.
#[test]
fn cameras_of_a_capture_make_a_capture_of_its_photographs() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    write_capture(&at("capture"), 9, (32, 24));
    std::fs::create_dir_all(at("ns/images")).unwrap();
    for i in 0..9 {
        std::fs::copy(at(&format!("capture/images/{i:03}.png")), at(&format!("ns/images/{i:03}.png"))).unwrap();
    }
    let opened = |path: &str| {
        let views = capture::open(&at(path), &LoadOptions::default()).unwrap().views;
        views.into_iter().map(|view| (view.name, view.camera.center())).collect::<Vec<_>>()
    };
    for (from, to, named) in [
        ("capture", "ns/transforms.json", "images/000.png"),
        ("ns", "all.json", "ns/images/000.png"),
        ("all.json", "ns/again.json", "images/000.png"),
    ] {
        run(folder.path(), &["cameras", "convert", from, "-o", to]);
        let list: serde_json::Value = serde_json::from_slice(&std::fs::read(at(to)).unwrap()).unwrap();
        assert_eq!(list["frames"][0]["file_path"], named);
        for ((name, center), (expected, place)) in opened(to).into_iter().zip(opened("capture")) {
            assert!(name == expected && center.distance(place) < 1e-9, "{to}: {name} {center}");
        }
    }
    // Pictures have the names of the photographs; a model's folder is found in place of its capture.
    write_ball(&at("ball.glb"), Composition::default());
    for cameras in ["ns", "capture", "capture/sparse"] {
        let render = ["render", "ball.glb", "--cameras", cameras, "-o", "frames", "--camera", "003.png"];
        run(folder.path(), &render);
        assert_eq!(tree(&at("frames")), [at("frames").join("003.png").display().to_string()]);
        std::fs::remove_dir_all(at("frames")).unwrap();
    }
    std::fs::remove_dir_all(at("ns/images")).unwrap();
    let line = failure(&at("ns"), centaur(&at("ns")).args(["train", "transforms.json", "-o", "s.glb"]));
    assert!(line.starts_with("error: transforms.json: 9 of 9 images missing, the first is images"), "{line}");
}

/// All of such a scene is nearer to the cameras of a path than the usual near plane.
#[test]
fn small_scenes_are_seen_from_paths_around_them() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    write_ball_of(&at("small.ply"), Composition::default(), 0.01);
    run(folder.path(), &["cameras", "orbit", "small.ply", "-o", "o.json", "--frames", "2", "--size", "32x24"]);
    run(folder.path(), &["render", "small.ply", "--cameras", "o.json", "-o", "frames"]);
    let picture = image::open(at("frames/frame_00000.png")).unwrap().into_rgb8();
    assert!((0..32).any(|x| picture.get_pixel(x, 12).0.iter().any(|c| *c > 100)), "it is black");
    // Programs that open the path show the scene, too.
    let corners = [0.0_f32, 0.0, 0.0, 0.01, 0.0, 0.0, 0.0, 0.01, 0.0];
    std::fs::write(at("small.bin"), corners.map(f32::to_le_bytes).as_flattened()).unwrap();
    let theirs = serde_json::json!({
        "asset": { "version": "2.0" }, "scene": 0, "scenes": [{ "nodes": [0] }], "nodes": [{ "mesh": 0 }],
        "meshes": [{ "primitives": [{ "attributes": { "POSITION": 0 } }] }],
        "accessors": [{ "bufferView": 0, "componentType": 5126, "type": "VEC3", "count": 3, "min": [0, 0, 0], "max": [0.01, 0.01, 0] }],
        "bufferViews": [{ "buffer": 0, "byteLength": 36 }], "buffers": [{ "byteLength": 36, "uri": "small.bin" }],
    });
    std::fs::write(at("small.gltf"), theirs.to_string()).unwrap();
    for (scene, out, more) in [("small.ply", "path.gltf", None), ("small.gltf", "both.gltf", Some("--with-scene"))] {
        let orbit = ["cameras", "orbit", scene, "-o", out, "--frames", "2"];
        run(folder.path(), &orbit.into_iter().chain(more).collect::<Vec<_>>());
        let path: serde_json::Value = serde_json::from_slice(&std::fs::read(at(out)).unwrap()).unwrap();
        let near = path["cameras"][0]["perspective"]["znear"].as_f64().unwrap();
        assert!(near > 0.0 && near < 0.002, "{out}: {near}");
    }
    run(folder.path(), &["cameras", "orbit", "small.ply", "-o", "path.usda", "--frames", "2"]);
    let path = std::fs::read_to_string(at("path.usda")).unwrap();
    assert!(path.contains("clippingRange = (") && !path.contains("clippingRange = (0.2"), "{path}");
}

/// Photographs that `centaur render` made, a little brighter, are scored as such: the near plane is the same.
#[test]
fn small_scenes_are_scored_as_they_are_rendered() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    write_ball_of(&at("small.ply"), Composition::default(), 0.01);
    let pose = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.03], [0.0, 0.0, 0.0, 1.0]];
    let pictures = ["a.png", "b.png"];
    let frames = pictures.map(|name| serde_json::json!({ "file_path": name, "transform_matrix": pose }));
    let cameras = serde_json::json!({ "w": 32, "h": 24, "fl_x": 32, "frames": frames });
    std::fs::create_dir(at("capture")).unwrap();
    std::fs::write(at("capture/transforms.json"), cameras.to_string()).unwrap();
    run(folder.path(), &["render", "small.ply", "--cameras", "capture", "-o", "rendered"]);
    for name in pictures {
        let mut picture = image::open(at("rendered").join(name)).unwrap().into_rgb8();
        assert!(picture.iter().any(|c| *c > 100), "it is black");
        picture.iter_mut().for_each(|c| *c = c.saturating_add(1));
        picture.save(at("capture").join(name)).unwrap();
    }
    let scores = run(folder.path(), &["eval", "small.ply", "capture", "--json", "--quiet"]);
    let scores: serde_json::Value = serde_json::from_str(&scores).unwrap();
    assert!(scores["psnr"].as_f64().unwrap() > 45.0, "{scores}");
    let notes = scores["notes"].to_string();
    assert!(notes.contains("small.ply: states no near plane: it is 0.00"), "{notes}");
}

/// One camera is inside of what the scene shows, and the near plane hides it from both. Neither is it another one where
/// the other camera is picked or scored alone.
#[test]
fn the_near_plane_does_not_depend_on_the_choice_of_a_camera() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    write_ball_of(&at("small.ply"), Composition::default(), 0.01);
    let frames = [("a.png", 0.03), ("b.png", 0.0)].map(|(name, z)| {
        let pose = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, z], [0.0, 0.0, 0.0, 1.0]];
        serde_json::json!({ "file_path": name, "transform_matrix": pose })
    });
    let cameras = serde_json::json!({ "w": 32, "h": 24, "fl_x": 32, "frames": frames });
    std::fs::create_dir(at("capture")).unwrap();
    std::fs::write(at("capture/transforms.json"), cameras.to_string()).unwrap();
    for name in ["a.png", "b.png"] {
        image::RgbImage::from_pixel(32, 24, image::Rgb([1; 3])).save(at("capture").join(name)).unwrap();
    }
    let render = ["render", "small.ply", "--cameras", "capture", "-o"];
    for more in [&["both"][..], &["one", "--camera", "a.png"]] {
        run(folder.path(), &[&render[..], more].concat());
        let picture = image::open(at(more[0]).join("a.png")).unwrap().into_rgb8();
        assert!(picture.iter().all(|c| *c == 0), "{more:?}");
    }
    let scores = run(folder.path(), &["eval", "small.ply", "capture", "--json", "--quiet"]);
    let scores: serde_json::Value = serde_json::from_str(&scores).unwrap();
    assert!(scores["psnr"].as_f64().unwrap() > 45.0 && !scores["notes"].to_string().contains("near plane"), "{scores}");
}

#[test]
fn what_makes_no_path_is_one_line() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    write_capture(&at("capture"), 9, (32, 24));
    write_ball(&at("ball.glb"), Composition::default());
    run(folder.path(), &["cameras", "orbit", "capture", "-o", "orbit.glb", "--frames", "2"]);
    // Paths can be overwritten any number of times.
    run(folder.path(), &["cameras", "orbit", "capture", "-o", "orbit.glb", "--frames", "2"]);
    // A file with one camera, and one of another size.
    let one = r#"{ "w": 8, "h": 6, "fl_x": 8, "frames": [{ "transform_matrix": [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]] }] }"#;
    std::fs::write(at("one.json"), one).unwrap();
    let two =
        one.replace("}] }", "}, { \"w\": 9, \"transform_matrix\": [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]] }] }");
    std::fs::write(at("two.json"), two).unwrap();
    let sheared = "#usda 1.0\n( metersPerUnit = 1\n upAxis = \"Y\" )\ndef Camera \"c\" {\n float3 xformOp:scale = (1, 2, 3)\n \
                   uniform token[] xformOpOrder = [\"xformOp:scale\"]\n}\n";
    std::fs::write(at("sheared.usda"), sheared).unwrap();
    let cases: [(&[&str], &str); 13] = [
        (
            &["cameras", "orbit", "sheared.usda", "-o", "a.json"],
            "sheared.usda: /: expected a camera, found /c: camera left out: its transform has shear, mirroring or non-uniform scale",
        ),
        (
            &["cameras", "orbit", "capture", "-o", "ball.glb"],
            "ball.glb: holds a scene, which would be lost: expected another file",
        ),
        (
            &["cameras", "orbit", "one.json", "-o", "a.glb"],
            "one.json: the views' optical axes do not meet in a point: state what to look at as the focus (--focus X,Y,Z)",
        ),
        (&["cameras", "spline", "one.json", "-o", "a.glb"], "one.json: expected at least 2 views, found 1"),
        (
            &["cameras", "orbit", "one.json", "-o", "a.glb", "--focus", "0,0,0"],
            "one.json: the views are on the axis through the focus: state the radius (--radius R)",
        ),
        (&["cameras", "orbit", "none", "-o", "a.glb"], "none: cannot read: No such file or directory"),
        (
            &["cameras", "convert", "ball.glb", "-o", "a.glb"],
            "ball.glb: /cameras: expected cameras, found none that are pinholes; `centaur cameras orbit` makes a path around any scene",
        ),
        (
            &["render", "ball.glb", "-o", "a", "--cameras", "ball.glb"],
            "ball.glb: /cameras: expected cameras, found none that are pinholes; `centaur cameras orbit` makes a path around any scene",
        ),
        (
            &["cameras", "convert", "orbit.glb", "-o", "no/a.json"],
            "no/a.json: cannot write: folder no: No such file or directory",
        ),
        (
            &["cameras", "convert", "orbit.glb", "-o", "a.json", "--camera", "b"],
            "orbit.glb: /cameras: expected a camera called b, found path",
        ),
        (
            &["render", "ball.glb", "--cameras", "capture", "-o", "a", "--camera", "002.png", "--camera", "9"],
            "capture: expected a camera called 9, found 000.png, 001.png, 002.png, 003.png, 004.png, 005.png, 006.png, 007.png, …",
        ),
        (
            &["render", "ball.glb", "-o", "a", "--camera", "b"],
            "ball.glb: expected a camera called b, found view_0, view_1, view_2, view_3, view_4, view_5, view_6, view_7",
        ),
        (
            &["render", "ball.glb", "--cameras", "two.json", "-o", "a", "--video", "a.mp4"],
            "--video: expected pictures of one size, found 8×6 and 9×6 of frame_00001; --max-side or other cameras may help",
        ),
    ];
    for (args, expected) in cases {
        assert_eq!(failure(folder.path(), centaur(folder.path()).args(args)), format!("error: {expected}"), "{args:?}");
    }
    for args in [
        &["cameras", "orbit", "capture", "-o", "a.mp4"][..],
        &["cameras", "orbit", "capture", "-o", "a.json", "--frames", "0"],
        &["cameras", "orbit", "capture", "-o", "a.json", "--size", "0x4"],
        &["cameras", "orbit", "capture", "-o", "a.json", "--fov", "180"],
        &["cameras", "orbit", "capture", "-o", "a.json", "--focus", "1,2"],
        &["cameras", "spline", "capture", "-o", "a.json", "--keys", "1"],
        &["render", "ball.glb", "-o", "a", "--fps", "0"],
        &["render", "ball.glb", "-o", "a", "--up", "w"],
        &["render", "ball.glb", "-o", "a", "--cameras", "capture", "--up", "z"],
        &["render", "ball.glb", "-o", "a", "--video", "a.avi"],
    ] {
        let output = centaur(folder.path()).args(args).output().unwrap();
        assert_eq!(output.status.code(), Some(2), "{args:?}");
    }
}
