use glam::{DMat3, DVec3};
use serde_json::json;

use super::*;
use crate::capture::{self, LoadOptions};
use crate::format::test_scenes::{camera, random_scene};
use crate::format::{
    ReadOptions, WriteOptions, read_cameras, read_file, validate, write_cameras, write_cameras_with_scene, write_scene,
};
use crate::render::testing::largest;
use crate::scene::Intrinsics;

/// A camera path with rotations, some of which pass half a turn, where the sign of the quaternion flips.
fn shot(frames: usize, zoom: f64) -> Vec<(String, Camera)> {
    let at = |i: usize| {
        let t = i as f64;
        let k = Intrinsics { width: 321, height: 200, fx: 150.25 + zoom * t, fy: 151.5, cx: 160.125, cy: 99.7 };
        let rotation = DMat3::from_euler(glam::EulerRot::YXZ, 0.9 * t, (0.3 * t).sin(), 0.2 * t);
        (format!("frame_{i:05}"), Camera::new(k, rotation, DVec3::new(t.sin(), 0.1 * t - 3.0, 2.0)).unwrap())
    };
    (0..frames).map(at).collect()
}

fn largest_difference(a: &[(String, Camera)], b: &[(String, Camera)]) -> f64 {
    assert_eq!(a.len(), b.len());
    let of = |(a, b): (&(String, Camera), &(String, Camera))| {
        assert_eq!(a.1.intrinsics(), b.1.intrinsics());
        let rotation = (a.1.rotation() - b.1.rotation()).to_cols_array().map(f64::abs);
        rotation.into_iter().chain((a.1.center() - b.1.center()).abs().to_array())
    };
    largest(a.iter().zip(b).flat_map(of))
}

fn read(path: &Path) -> CameraFile {
    read_cameras(path, &Sampling::default()).unwrap()
}

#[test]
fn what_is_written_is_read() {
    let folder = tempfile::tempdir().unwrap();
    for (frames, fps) in [(1, 24.0), (2, 30.0), (37, 29.97), (300, 60.0)] {
        let file = CameraFile {
            cameras: shot(frames, 0.0),
            fps: Some(fps),
            y_up: false,
            times: vec![],
            near: None,
            notes: vec![],
        };
        for (name, tolerance) in [("a.glb", 1e-5), ("a.gltf", 1e-5), ("a.usda", 1e-12)] {
            let path = folder.path().join(name);
            let bytes = write_cameras(&path, &file).unwrap();
            assert_eq!(bytes, path.metadata().unwrap().len());
            let back = read(&path);
            assert_eq!((back.y_up, &back.notes[..]), (false, &[][..]), "{name}");
            // A single frame does not move, so USD stores no frame rate.
            let expected = (frames > 1 || name != "a.usda").then_some(fps);
            assert_eq!(back.fps, expected, "{name}");
            let found = largest_difference(&file.cameras, &back.cameras);
            assert!(found <= tolerance, "{name}, {frames} frames: {found}");
            assert!(frames == 1 || back.cameras.iter().zip(&file.cameras).all(|(a, b)| a.0 == b.0));
            if name != "a.usda" {
                let faults = validate(&path).unwrap();
                assert!(faults.findings.is_empty(), "{:?}", faults.findings);
            }
            // Twice the frame rate gives twice as many frames, minus one at the end.
            let twice = read_cameras(&path, &Sampling { fps: Some(2.0 * fps), ..Sampling::default() }).unwrap();
            assert!(frames == 1 || twice.cameras.len() == 2 * frames - 1, "{name}: {}", twice.cameras.len());
        }
        for name in ["a.json", "model"] {
            let path = folder.path().join(name);
            write_cameras(&path, &file).unwrap();
            let back = capture::cameras(&path, &LoadOptions::default()).unwrap();
            assert_eq!(back.fps, (name == "a.json").then_some(fps));
            assert!(largest_difference(&file.cameras, &back.cameras) < 1e-12, "{name}");
            assert!(back.cameras[0].0 == "frame_00000.png");
        }
    }
}

#[test]
fn lenses_may_differ() {
    let folder = tempfile::tempdir().unwrap();
    let file =
        CameraFile { cameras: shot(5, 1.5), fps: Some(10.0), y_up: false, times: vec![], near: None, notes: vec![] };
    let at = |name: &str| {
        let path = folder.path().join(name);
        write_cameras(&path, &file).unwrap();
        path
    };
    let (gltf, usd) = (read(&at("a.glb")), read(&at("a.usda")));
    // glTF cannot animate lenses: it gets one camera per frame.
    assert_eq!((gltf.fps, usd.fps), (None, Some(10.0)));
    assert!(largest_difference(&file.cameras, &gltf.cameras) < 1e-6);
    assert!(largest_difference(&file.cameras, &usd.cameras) < 1e-6);
    for name in ["a.json", "model"] {
        let back = capture::cameras(&at(name), &LoadOptions::default()).unwrap();
        assert!(largest_difference(&file.cameras, &back.cameras) < 1e-12, "{name}");
    }
}

#[test]
fn frames_of_reference_are_kept_where_files_have_one() {
    let folder = tempfile::tempdir().unwrap();
    let file =
        CameraFile { cameras: shot(4, 0.0), fps: Some(10.0), y_up: true, times: vec![], near: None, notes: vec![] };
    for name in ["a.glb", "a.usda"] {
        let path = folder.path().join(name);
        write_cameras(&path, &file).unwrap();
        assert!(largest_difference(&file.cameras, &read(&path).in_frame(true).cameras) < 1e-5, "{name}");
    }
    for y_up in [true, false] {
        let path = folder.path().join("a.json");
        write_cameras(&path, &CameraFile { y_up, ..file.clone() }).unwrap();
        let back = capture::cameras(&path, &LoadOptions::default()).unwrap();
        assert_eq!(back.y_up, y_up);
        assert!(largest_difference(&file.cameras, &back.cameras) < 1e-12, "{y_up}");
    }
    // A COLMAP model is in the frame of captures.
    let there = file.clone().in_frame(false);
    write_cameras(&folder.path().join("model"), &file).unwrap();
    let back = capture::cameras(&folder.path().join("model"), &LoadOptions::default()).unwrap();
    assert!(!back.y_up && largest_difference(&there.cameras, &back.cameras) < 1e-12);
    // The two frames differ by half a turn about x.
    let (p, q) = (file.cameras[2].1.center(), there.cameras[2].1.center());
    assert!((p.x - q.x).abs() < 1e-12 && (p.y + q.y).abs() < 1e-12 && (p.z + q.z).abs() < 1e-12);
}

#[test]
fn names_of_pictures_are_safe_and_unique() {
    let names = |views: &[&str]| picture_names(views.iter().copied(), "png");
    let found = names(&["left/0001.jpg", "left_0001.PNG", "LEFT/0001", "../../etc/passwd", "IMG 12.tar.JPG", "..", ""]);
    let expected = ["left_0001", "left_0001_2", "LEFT_0001_3", "_.._etc_passwd", "IMG_12.tar", "view", "view_2"];
    assert_eq!(found, expected.map(|stem| format!("{stem}.png")));
    let long = format!("{}_{}", "日".repeat(100), "x".repeat(100));
    let found = names(&[&long, &format!("{long}y")]);
    assert_eq!(
        found,
        ["", "_2"].map(|number| format!("{}{number}.png", "日".repeat(66))),
        "longer than files may be called"
    );
    // Numbers that Blender appends to copies are no file extensions.
    let found = names(&["Camera", "Camera.001", "Camera.001_00007", "Camera.002.jpeg"]);
    assert_eq!(found, ["Camera", "Camera.001", "Camera.001_00007", "Camera.002"].map(|stem| format!("{stem}.png")));
    // Reserved device names of Windows.
    let found = names(&["aux", "Nul.left.png", "com1", "com10", "console", "LPT9.1.jpg"]);
    let expected = ["_aux", "_Nul.left", "_com1", "com10", "console", "_LPT9.1"];
    assert_eq!(found, expected.map(|stem| format!("{stem}.png")));
    // Camera files contain these names, unless all cameras already have names of pictures.
    let folder = tempfile::tempdir().unwrap();
    let (first, second) = (shot(1, 0.0)[0].1, shot(2, 0.0)[1].1);
    for (given, expected) in [
        (["left/0001.jpg", "left_0001.PNG"], ["left/0001.jpg", "left_0001.PNG"]),
        (["left/0001.jpg", "left_0001"], ["left_0001.png", "left_0001_2.png"]),
        (["../0001.jpg", "2.jpg"], ["_0001.png", "2.png"]),
        (["a.jpg", "A.jpg"], ["a.png", "A_2.png"]),
    ] {
        let cameras = vec![(given[0].to_owned(), first), (given[1].to_owned(), second)];
        let file = CameraFile { cameras, fps: None, y_up: false, times: vec![], near: None, notes: vec![] };
        for name in ["a.json", "model"] {
            write_cameras(&folder.path().join(name), &file).unwrap();
            let back = capture::cameras(&folder.path().join(name), &LoadOptions::default()).unwrap();
            let mut read: Vec<&str> = back.cameras.iter().map(|(name, _)| &name[..]).collect();
            let mut expected = expected;
            read.sort_unstable();
            expected.sort_unstable();
            assert_eq!(read, expected, "{name}");
        }
    }
}

#[test]
fn captures_are_neither_replaced_nor_hidden() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    let file =
        CameraFile { cameras: shot(3, 0.0), fps: Some(9.0), y_up: false, times: vec![], near: None, notes: vec![] };
    let write = |name: &str| write_cameras(&root.join(name), &file).map_err(|e| e.to_string());
    let refused = |name: &str, held: &str| {
        let path = root.join(name).display().to_string();
        let expected = format!(
            "{path}: expected a folder without a capture, which the cameras would replace or hide, found `{held}`"
        );
        assert_eq!(write(name), Err(expected));
    };
    let touch = |name: &str, text: &str| {
        std::fs::create_dir_all(root.join(name).parent().unwrap()).unwrap();
        std::fs::write(root.join(name), text).unwrap();
    };
    // Every place in which a capture is found.
    for (capture, held) in [
        ("a/sparse/0/cameras.bin", "sparse"),
        ("b/sparse/cameras.txt", "sparse"),
        ("c/colmap/sparse/0/images.bin", "colmap"),
        ("d/frames.bin", "frames.bin"),
        ("e/transforms.json", "transforms.json"),
        ("f/transforms_train.json", "transforms_train.json"),
        ("g/sparse/1/cameras.bin", "sparse"),
    ] {
        touch(capture, "{}");
        refused(&capture[..1], held);
        refused(&format!("{}/transforms.json", &capture[..1]), held);
        assert_eq!(std::fs::read_to_string(root.join(capture)).unwrap(), "{}");
    }
    refused("f/transforms_train.json", "transforms_train.json");
    // A folder with photographs alone would become a capture if a COLMAP model were added; a single file beside them
    // hides nothing.
    touch("h/images/a.png", "");
    refused("h", "images");
    write("h/transforms.json").unwrap();
    write("a/shot.json").unwrap();
    // Files written by us can be overwritten, and no temporary files remain.
    for _ in 0..2 {
        write("new").unwrap();
        write("h/transforms.json").unwrap();
    }
    let listed = |name: &str| {
        let mut names: Vec<_> = std::fs::read_dir(root.join(name)).unwrap().map(|e| e.unwrap().file_name()).collect();
        names.sort();
        names
    };
    assert_eq!(listed("new"), ["sparse"]);
    assert_eq!(listed("new/sparse"), ["0"]);
    assert_eq!(listed("new/sparse/0"), ["cameras.txt", "images.txt", "points3D.txt"]);
    touch("new/sparse/0/points3D.txt", "1 0 0 0 9 9 9 0.1\n");
    refused("new", "sparse");
    // Files of others beside ours are kept as well.
    write("other").unwrap();
    touch("other/sparse/0/cameras.bin", "theirs");
    refused("other", "sparse");
    assert_eq!(std::fs::read_to_string(root.join("other/sparse/0/cameras.bin")).unwrap(), "theirs");
    // Captures are also looked for in a subfolder of this name, before the folder itself.
    refused("e/colmap", "../transforms.json");
    refused("h/colmap", "../images");
    assert!(!root.join("h/colmap").exists());
    write("i/colmap").unwrap();
    write("i/colmap").unwrap();
}

#[test]
fn shots_keep_their_times() {
    let folder = tempfile::tempdir().unwrap();
    for (start, fps, frames) in [(5.0, 30.0, 91), (0.25, 29.97, 40), (4000.1, 60.0, 7)] {
        let times: Vec<f64> = (0..frames).map(|i| start + f64::from(i) / fps).collect();
        let cameras = shot(times.len(), 0.0);
        let file = CameraFile { cameras, fps: Some(fps), y_up: false, times, near: None, notes: vec![] };
        for name in ["a.glb", "a.usda"] {
            let path = folder.path().join(name);
            write_cameras(&path, &file).unwrap();
            let back = read(&path);
            assert!(largest_difference(&file.cameras, &back.cameras) < 1e-4, "{name}, {start}");
            let differ = file.times.iter().zip(&back.times).any(|(a, b)| (a - b).abs() > 1e-6 * a);
            assert!(!differ && back.times.len() == file.times.len(), "{name}: {:?}", back.times);
            assert_eq!(validate(&path).map_or(0, |faults| faults.errors), 0, "{name}");
        }
        // Times that are not valid key times are not written.
        for times in [vec![-1.0; file.times.len()], vec![start; file.times.len()], vec![start]] {
            let path = folder.path().join("a.glb");
            write_cameras(&path, &CameraFile { times, ..file.clone() }).unwrap();
            assert_eq!(read(&path).times[0], 0.0);
        }
    }
}

#[test]
fn names_of_cameras_are_short() {
    let folder = tempfile::tempdir().unwrap();
    let floats: [(&str, &[f32]); 2] = [("SCALAR", &[0.0, 1.0]), ("VEC4", &TURN)];
    let channels = json!([{ "sampler": 0, "target": { "node": 0, "path": "rotation" } }]);
    let path = gltf_with(folder.path(), &floats, &json!([{ "input": 0, "output": 1 }]), &channels);
    let name = "ä".repeat(1 << 18);
    let text = std::fs::read_to_string(&path).unwrap();
    std::fs::write(&path, text.replace("moving", &name)).unwrap();
    let found = read(&path);
    assert_eq!(found.cameras[30].0, format!("{}_00030", "ä".repeat(100)));
    let only = read_cameras(&path, &Sampling { only: std::slice::from_ref(&name), ..Sampling::default() }).unwrap();
    assert_eq!(only.cameras.len(), 31);
    let usd = folder.path().join("a.usda");
    std::fs::write(&usd, format!("#usda 1.0\ndef Camera \"a\" ( displayName = \"{name}\" ) {{}}\n")).unwrap();
    assert_eq!(read(&usd).cameras[0].0, "ä".repeat(100));
    let layer = format!("#usda 1.0\ndef Xform \"{0}\" {{ def Camera \"a\" {{}} }}\n", "b".repeat(1 << 18));
    std::fs::write(&usd, layer).unwrap();
    let found = read(&usd);
    assert!(
        found.notes.iter().any(|note| note.starts_with(&format!("/{}/a: ", "b".repeat(100)))),
        "{:?}",
        found.notes[0].len()
    );
}

#[test]
fn deep_cameras_have_a_limit() {
    let folder = tempfile::tempdir().unwrap();
    let floats: [(&str, &[f32]); 2] = [("SCALAR", &[0.0, 1199.0]), ("VEC4", &TURN)];
    let channels = json!([{ "sampler": 0, "target": { "node": 0, "path": "rotation" } }]);
    let path = gltf_with(folder.path(), &floats, &json!([{ "input": 0, "output": 1 }]), &channels);
    let mut document: serde_json::Value = serde_json::from_slice(&std::fs::read(&path).unwrap()).unwrap();
    let depth = 4000;
    let mut nodes: Vec<serde_json::Value> = (1..depth).map(|child| json!({ "children": [child] })).collect();
    nodes.push(json!({ "camera": 0 }));
    document["nodes"] = json!(nodes);
    std::fs::write(&path, document.to_string()).unwrap();
    let error = read_cameras(&path, &Sampling::default()).unwrap_err().to_string();
    let expected = "/nodes/3999: expected at most 134217728 transforms of nodes above cameras, of all frames together, found 4000 of \
                    each of 35971 frames";
    assert!(error.ends_with(expected), "{error}");
    let slow = read_cameras(&path, &Sampling { fps: Some(0.1), ..Sampling::default() }).unwrap();
    assert_eq!(slow.cameras.len(), 120);
}

/// A glTF whose camera nodes are moved by animation `channels`, with accessors made of `floats` (type and values).
fn gltf_with(
    folder: &Path,
    floats: &[(&str, &[f32])],
    samplers: &serde_json::Value,
    channels: &serde_json::Value,
) -> std::path::PathBuf {
    let (mut bin, mut views, mut accessors) = (vec![], vec![], vec![]);
    for (kind, values) in floats {
        let width = if *kind == "SCALAR" { 1 } else { kind[3..].parse::<usize>().unwrap() };
        let bound = |of: fn(f32, f32) -> f32| -> Vec<f32> {
            (0..width).map(|c| values.iter().skip(c).step_by(width).copied().reduce(of).unwrap()).collect()
        };
        views.push(json!({ "buffer": 0, "byteOffset": bin.len(), "byteLength": 4 * values.len() }));
        accessors.push(
            json!({ "bufferView": views.len() - 1, "componentType": 5126, "type": kind, "count": values.len() / width,
            "min": bound(f32::min), "max": bound(f32::max) }),
        );
        bin.extend(values.iter().flat_map(|v| v.to_le_bytes()));
    }
    let document = json!({
        "asset": { "version": "2.0" },
        "scene": 0,
        "scenes": [{ "nodes": [0] }],
        "nodes": [{ "children": [1, 2] }, { "camera": 0, "name": "moving" }, { "camera": 0, "name": "resting" }],
        "cameras": [{ "type": "perspective", "perspective": { "yfov": 1.0, "aspectRatio": 1.5, "znear": 0.1 } }],
        "animations": [{ "samplers": samplers, "channels": channels }],
        "accessors": accessors, "bufferViews": views, "buffers": [{ "byteLength": bin.len(), "uri": "a.bin" }],
    });
    std::fs::write(folder.join("a.bin"), bin).unwrap();
    std::fs::write(folder.join("a.gltf"), document.to_string()).unwrap();
    folder.join("a.gltf")
}

const TURN: [f32; 8] = [0.0, 0.0, 0.0, 1.0, 0.0, std::f32::consts::FRAC_1_SQRT_2, 0.0, std::f32::consts::FRAC_1_SQRT_2];

#[test]
fn animations_of_gltf_are_followed_through_ancestors() {
    let folder = tempfile::tempdir().unwrap();
    // Times, a quarter turn about y, scales, and x from 0 to 4 with tangents 2 and 0.
    let floats: [(&str, &[f32]); 5] = [
        ("SCALAR", &[1.0, 3.0]),
        ("VEC4", &TURN),
        ("SCALAR", &[1.0, 2.0]),
        ("VEC3", &[1.0, 1.0, 1.0, 2.0, 2.0, 2.0]),
        ("VEC3", &[9., 9., 9., 0., 0., 0., 2., 0., 0., 0., 0., 0., 4., 0., 0., 9., 9., 9.]),
    ];
    let cubic_samplers = json!([
        { "input": 0, "output": 1 },
        { "input": 2, "output": 3, "interpolation": "STEP" },
        { "input": 0, "output": 4, "interpolation": "CUBICSPLINE" },
    ]);
    let channel =
        |sampler: u32, node: u32, path: &str| json!({ "sampler": sampler, "target": { "node": node, "path": path } });
    let channels = [channel(0, 0, "rotation"), channel(1, 0, "scale"), channel(2, 1, "translation")];
    let path = gltf_with(folder.path(), &floats, &cubic_samplers, &json!(channels));
    let sampling = Sampling { fps: Some(2.0), only: &["moving".to_owned()], ..Sampling::default() };
    let found = read_cameras(&path, &sampling).unwrap();
    assert_eq!((found.fps, found.y_up, found.cameras.len()), (Some(2.0), true, 5));
    let cubic = [0.0, 0.625 + 0.5625, 2.5, 4.0 * 0.84375 + 4.0 * 0.046875, 4.0];
    for (i, (name, camera)) in found.cameras.iter().enumerate() {
        let (sin, cos) = (std::f64::consts::FRAC_PI_8 * i as f64).sin_cos();
        let x = cubic[i] * if i < 2 { 1.0 } else { 2.0 };
        assert_eq!(name, &format!("frame_0000{i}"));
        assert!(camera.center().abs_diff_eq(DVec3::new(x * cos, 0.0, -x * sin), 1e-6), "{i}: {}", camera.center());
        assert!(camera.rotation().row(2).abs_diff_eq(DVec3::new(-sin, 0.0, -cos), 1e-6), "{i}");
    }
    // Node 0 is the parent of both cameras, so both are in the shot, with 30 frames per second by default.
    let both = read_cameras(&path, &Sampling::default()).unwrap();
    assert_eq!((both.cameras.len(), both.fps), (2 * 61, Some(DEFAULT_FPS)));
    assert!(both.cameras[60].0 == "moving_00060" && both.cameras[61].0 == "resting_00000");
    for (only, named) in [(&["third"][..], "third"), (&["moving", "2"], "2")] {
        let only: Vec<String> = only.iter().map(|&only| only.to_owned()).collect();
        let error = read_cameras(&path, &Sampling { only: &only, ..Sampling::default() }).unwrap_err().to_string();
        assert!(error.ends_with(&format!("expected a camera called {named}, found moving, resting")), "{error}");
    }

    // The limit applies to the frames of all selected cameras of a file together.
    let long: [(&str, &[f32]); 2] = [("SCALAR", &[0.0, 700.0]), ("VEC4", &TURN)];
    let (samplers, turn) = (json!([{ "input": 0, "output": 1 }]), json!([channel(0, 0, "rotation")]));
    let path = gltf_with(folder.path(), &long, &samplers, &turn);
    let error = read_cameras(&path, &Sampling::default()).unwrap_err().to_string();
    let expected = "/nodes/2: expected a shot of at most 36000 frames, of all cameras together, found 700 seconds at 30 a second \
                    after 21001 of other cameras";
    assert!(error.ends_with(expected), "{error}");
    for only in ["moving", "resting", "0", "1"] {
        let found = read_cameras(&path, &Sampling { only: &[only.to_owned()], ..Sampling::default() }).unwrap();
        assert_eq!(found.cameras.len(), 21001, "{only}");
    }

    // If one camera moves, cameras at rest are left out.
    let alone = gltf_with(folder.path(), &floats, &cubic_samplers, &json!([channel(2, 1, "translation")]));
    let found = read_cameras(&alone, &sampling).unwrap();
    assert_eq!(found.cameras.len(), 5);
    let found = read_cameras(&alone, &Sampling { fps: Some(1.0), ..Sampling::default() }).unwrap();
    assert_eq!(found.cameras.len(), 3);
    assert_eq!(found.notes.last().unwrap(), "cameras that do not move: left out (1)");
    let resting = read_cameras(&alone, &Sampling { only: &["resting".to_owned()], ..Sampling::default() }).unwrap();
    assert_eq!((resting.cameras.len(), resting.fps), (1, None));
    // Together they would be frames of which some have no time.
    let both = ["moving", "resting"].map(str::to_owned);
    let error = read_cameras(&alone, &Sampling { only: &both, ..Sampling::default() }).unwrap_err().to_string();
    let expected = "/cameras: expected cameras that all move, or none that does, found moving, which moves, and resting, which does not";
    assert!(error.ends_with(expected), "{error}");
    let at_once = Sampling { only: &both, time: Some(1.5), ..Sampling::default() };
    assert_eq!(read_cameras(&alone, &at_once).unwrap().cameras.len(), 2);
}

#[test]
fn frames_are_counted_with_both_ends() {
    for (start, end, fps, expected) in [
        (0.0, 0.0, 30.0, Some(1)),
        (1.0, 2.0, 24.0, Some(25)),
        (0.0, f64::from(0.1f32 * 7.0), 10.0, Some(8)),
        (0.0, 35_999.0, 1.0, Some(MAX_FRAMES)),
        (0.0, 36_000.0, 1.0, None),
        (0.0, f64::MAX, 1.0, None),
        (f64::MIN, f64::MAX, 1e3, None),
        (1.0, 0.0, 30.0, None),
        (0.0, f64::NAN, 30.0, None),
    ] {
        assert_eq!(frame_count(start, end, fps), expected, "{start} to {end}");
    }
}

#[test]
fn animations_that_are_none_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let error = |times: &[f32], values: &[f32], fps: f64| {
        let samplers = json!([{ "input": 0, "output": 1 }]);
        let channels = json!([{ "sampler": 0, "target": { "node": 1, "path": "rotation" } }]);
        let path = gltf_with(folder.path(), &[("SCALAR", times), ("VEC4", values)], &samplers, &channels);
        read_cameras(&path, &Sampling { fps: Some(fps), ..Sampling::default() }).map_err(|e| e.to_string())
    };
    let is = |found: Result<CameraFile, String>, end: &str| {
        let message = found.unwrap_err();
        assert!(message.contains(end), "{message}");
    };
    for (target, said) in [
        (
            json!({ "node": 1, "path": "turn" }),
            "target/path: expected translation, rotation, scale, weights, found `turn`",
        ),
        (json!({ "node": 3, "path": "rotation" }), "target/node: expected a node below 3, found `3`"),
    ] {
        let channels = json!([{ "sampler": 0, "target": target }]);
        let floats: [(&str, &[f32]); 2] = [("SCALAR", &[0.0, 1.0]), ("VEC4", &TURN)];
        let path = gltf_with(folder.path(), &floats, &json!([{ "input": 0, "output": 1 }]), &channels);
        let message = read_cameras(&path, &Sampling::default()).unwrap_err().to_string();
        assert!(message.ends_with(&format!("a.gltf: /animations/0/channels/0/{said}")), "{message}");
    }
    // Channels are named by their index in the file, which counts channels that are not core glTF.
    let pointer = json!({ "path": "pointer", "extensions": { "KHR_animation_pointer": { "pointer": "/extras" } } });
    let channels = json!([
        { "sampler": 0, "target": pointer }, { "sampler": 0, "target": { "node": 1, "path": "scale" } },
    ]);
    let floats: [(&str, &[f32]); 2] = [("SCALAR", &[0.0, 1.0, 2.0]), ("VEC3", &[1.0; 6])];
    let path = gltf_with(folder.path(), &floats, &json!([{ "input": 0, "output": 1 }]), &channels);
    let message = read_cameras(&path, &Sampling::default()).unwrap_err().to_string();
    assert!(message.contains("/animations/0/channels/1: expected 3 times 3 numbers"), "{message}");
    is(error(&[1.0, 1.0], &TURN, 1.0), "/accessors/0: expected key times that grow, found 1 after 1");
    is(error(&[0.0, f32::NAN], &TURN, 1.0), "/accessors/0: expected finite key times, found NaN");
    is(error(&[0.0, 1.0, 2.0], &TURN, 1.0), "/animations/0/channels/0: expected 3 times 4 numbers, found 8");
    is(error(&[0.0, 1.0], &[f32::NAN; 8], 1.0), "/accessors/1: expected finite numbers, found NaN");
    is(error(&[0.0, 1e9], &TURN, 1e9), "expected a shot of at most 36000 frames");
    // A quaternion of zeros means no rotation.
    assert_eq!(error(&[0.0, 1.0], &[0.0; 8], 1.0).unwrap().cameras.len(), 2);
    let floats: [(&str, &[f32]); 2] = [("SCALAR", &[0.0, 1.0]), ("VEC3", &[1.0, 1.0, 1.0, 1.0, 2.0, 1.0])];
    let channels = json!([{ "sampler": 0, "target": { "node": 1, "path": "scale" } }]);
    let path = gltf_with(folder.path(), &floats, &json!([{ "input": 0, "output": 1 }]), &channels);
    let without = read_cameras(&path, &Sampling { fps: Some(2.0), ..Sampling::default() }).unwrap();
    assert_eq!(
        without.notes[0],
        "/nodes/1: camera left out: its node has shear, mirroring or non-uniform scale, at 0.5 s"
    );
    assert_eq!(without.cameras.len(), 1);
}

#[test]
fn time_samples_of_usd_are_followed_through_ancestors() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.usda");
    let layer = r#"#usda 1.0
(
    metersPerUnit = 0.01
    timeCodesPerSecond = 10
    upAxis = "Z"
)
def Xform "rig" {
    float xformOp:rotateZ.timeSamples = { 25: 90, 5: 0, }
    uniform token[] xformOpOrder = ["xformOp:rotateZ"]
    def Camera "shot" {
        float focalLength = 1
        float focalLength.timeSamples = { 5: 50, 25: 100 }
        double3 xformOp:translate = (300, 0, 0)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }
}
def Camera "resting" { }
"#;
    std::fs::write(&path, layer).unwrap();
    for (fps, frames) in [(None, 21), (Some(5.0), 11), (Some(20.0), 41)] {
        let found = read_cameras(&path, &Sampling { fps, ..Sampling::default() }).unwrap();
        assert_eq!((found.cameras.len(), found.fps, found.y_up), (frames, fps.or(Some(10.0)), true));
        for (i, (_, camera)) in found.cameras.iter().enumerate() {
            let part = i as f64 / (frames - 1) as f64;
            let (sin, cos) = (std::f64::consts::FRAC_PI_2 * part).sin_cos();
            // z up to y up: (x, y, z) → (x, z, −y).
            assert!(
                camera.center().abs_diff_eq(DVec3::new(3.0 * cos, 0.0, -3.0 * sin), 1e-9),
                "{i}: {}",
                camera.center()
            );
            let expected = (50.0 + 50.0 * part) / 15.2908 * 1080.0;
            assert!((camera.intrinsics().fy / expected - 1.0).abs() < 1e-6, "{i}");
        }
    }
    // Matrices are not interpolated component-wise, which would shrink the camera's axes.
    let matrices = layer.replace("float xformOp:rotateZ.timeSamples = { 25: 90, 5: 0, }", "matrix4d xformOp:transform.timeSamples = {
        5: ((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1)), 25: ((0, 1, 0, 0), (-1, 0, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1)) }")
        .replace("\"xformOp:rotateZ\"", "\"xformOp:transform\"");
    std::fs::write(&path, matrices).unwrap();
    let found = read(&path);
    let diagonal = 3.0 * 0.5_f64.sqrt();
    assert!(found.cameras[10].1.center().abs_diff_eq(DVec3::new(diagonal, 0.0, -diagonal), 1e-9));
    std::fs::write(&path, layer.replace("25: 90", "1e12: 90")).unwrap();
    let error = read_cameras(&path, &Sampling::default()).unwrap_err().to_string();
    assert!(error.contains("expected a shot of at most 36000 frames"), "{error}");

    // The limit applies to the frames of all selected cameras of a file together.
    let rig = layer.replace("25: 90", "25000: 90");
    let two = rig.replace("def Xform \"rig\" {", "def Xform \"rig\" {\n    def Camera \"other\" { }");
    std::fs::write(&path, two).unwrap();
    let error = read_cameras(&path, &Sampling::default()).unwrap_err().to_string();
    assert!(
        error.contains("/rig/shot: expected a shot of at most 36000 frames") && error.contains("after 24996"),
        "{error}"
    );
    let found = read_cameras(&path, &Sampling { only: &["shot".to_owned()], ..Sampling::default() }).unwrap();
    assert_eq!(found.cameras.len(), 24996);
    // The number of transform steps is limited too: every frame applies those of all ancestors.
    let order = ["\"xformOp:rotateZ\""; 1000].join(", ");
    let level = |content: &str| {
        format!(
            "def Xform \"a\" {{ float xformOp:rotateZ.timeSamples = {{ 0: 0, 30000: 90 }}\n uniform token[] xformOpOrder = [{order}]\n {content} }}\n"
        )
    };
    std::fs::write(&path, format!("#usda 1.0\n{}", level(&level("def Camera \"shot\" { }")))).unwrap();
    let error = read_cameras(&path, &Sampling { fps: Some(24.0), ..Sampling::default() }).unwrap_err().to_string();
    assert!(error.contains("/a/a/shot: expected at most 50000000 steps of transforms"), "{error}");
    let longer = layer.replace("\"xformOp:rotateZ\"", &format!("{order}, {order}"));
    std::fs::write(&path, longer).unwrap();
    let error = read_cameras(&path, &Sampling::default()).unwrap_err().to_string();
    assert!(error.contains("/rig.xformOpOrder: expected at most 1000 operations, found 2000"), "{error}");
    // If no camera is found, the error names those left out, whatever other notes there are.
    let sheared = layer
        .replace("float xformOp:rotateZ", "float3 xformOp:scale = (1, 2, 3)\n    float xformOp:rotateZ")
        .replace("[\"xformOp:rotateZ\"]", "[\"xformOp:rotateZ\", \"xformOp:scale\"]")
        .replace("def Camera \"resting\" { }", "");
    std::fs::write(&path, sheared.replace("metersPerUnit = 0.01", "")).unwrap();
    let error = read_cameras(&path, &Sampling::default()).unwrap_err();
    let said = "expected a camera, found /rig/shot: camera left out: its transform has shear";
    assert!(error.to_string().contains(said) && !error.is_lack_of_cameras(), "{error}");
}

#[test]
fn files_without_cameras_say_so() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.gltf");
    std::fs::write(&path, r#"{ "asset": { "version": "2.0" } }"#).unwrap();
    let error = read_cameras(&path, &Sampling::default()).unwrap_err().to_string();
    assert!(error.contains("a.gltf: /cameras: expected cameras, found none that are pinholes; `centaur "), "{error}");
    std::fs::write(&path, "ply\n").unwrap();
    let error = read_cameras(&path, &Sampling::default()).unwrap_err();
    let said = "expected a file that can hold cameras: .glb, .gltf, .usda, .usdc, .usdz or .json, found PLY; `centaur ";
    assert!(error.is_lack_of_cameras() && error.to_string().contains(said), "{error}");
    std::fs::write(&path, "no").unwrap();
    assert!(!read_cameras(&path, &Sampling::default()).unwrap_err().is_lack_of_cameras());
}

#[test]
fn a_path_is_added_to_a_scene_of_either_frame() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let scene = random_scene(20, 1, 2, 4);
    let cameras = [("front".to_owned(), camera())];
    write_scene(&at("ours.gltf"), &scene, &WriteOptions { cameras: &cameras, ..WriteOptions::default() }).unwrap();
    let ours: serde_json::Value = serde_json::from_slice(&std::fs::read(at("ours.gltf")).unwrap()).unwrap();
    // Without our marker the same data belong to another program, in a y-up frame.
    let mut theirs = ours.clone();
    let root = ours["scenes"][0]["nodes"][0].as_u64().unwrap() as usize;
    theirs["nodes"][root]["name"] = json!("world");
    std::fs::write(at("theirs.gltf"), theirs.to_string()).unwrap();
    // The layout written for a transformed scene.
    let mut moved = ours.clone();
    let nodes = moved["nodes"].as_array_mut().unwrap();
    nodes.push(json!({ "name": "moved", "translation": [1, 2, 3], "rotation": [0, 0.6, 0, 0.8], "scale": [2, 2, 2], "children": [root] }));
    moved["scenes"][0]["nodes"] = json!([nodes.len() - 1]);
    std::fs::write(at("moved.gltf"), moved.to_string()).unwrap();
    for (name, y_up) in [("ours.gltf", false), ("theirs.gltf", true), ("moved.gltf", false)] {
        let before = read_file(&at(name), &ReadOptions::default()).unwrap();
        assert_eq!((before.y_up, before.cameras.len()), (y_up, 1), "{name}");
        let file =
            CameraFile { cameras: shot(7, 0.0), fps: Some(25.0), y_up, times: vec![], near: None, notes: vec![] };
        // A path replaces the previous one: by another path, by one with changing lenses, and by one with fewer frames.
        let paths = [shot(9, 0.0), shot(7, 0.0), shot(7, 1.5), shot(3, 1.5), shot(7, 0.0)];
        let mut from = at(name);
        for cameras in paths {
            let file = CameraFile { cameras, ..file.clone() };
            let count =
                if file.cameras[0].1.intrinsics() == file.cameras[1].1.intrinsics() { 1 } else { file.cameras.len() };
            write_cameras_with_scene(&at("with.gltf"), &from, &file).unwrap();
            from = at("with.gltf");
            let whole = read_file(&from, &ReadOptions::default()).unwrap();
            assert_eq!((whole.cameras.len(), whole.y_up), (1 + count, y_up), "{name}");
            assert_eq!(whole.scene, before.scene, "{name}");
            let back = read(&from);
            let frames = if count == 1 {
                assert!(back.notes.last().unwrap().starts_with("cameras that do not move: left out"), "{name}");
                assert_eq!(back.fps, Some(25.0), "{name}");
                &back.cameras[..]
            } else {
                &back.cameras[1..]
            };
            assert!(largest_difference(&file.cameras, frames) < 2e-5, "{name}");
            let faults = validate(&from).unwrap();
            assert_eq!(faults.errors, 0, "{name}: {:?}", faults.findings);
        }
        let stated = CameraFile { y_up: false, ..file.clone() };
        write_cameras_with_scene(&at("with.glb"), &at(name), &stated).unwrap();
        let back = read(&at("with.glb"));
        assert_eq!(back.y_up, y_up, "{name}");
        assert!(largest_difference(&file.cameras, &back.in_frame(false).cameras) < 2e-5, "{name}");
    }
    let error = |out: &str, scene: &str| {
        let file =
            CameraFile { cameras: shot(1, 0.0), fps: None, y_up: false, times: vec![], near: None, notes: vec![] };
        write_cameras_with_scene(&at(out), &at(scene), &file).unwrap_err().to_string()
    };
    assert!(error("a.json", "ours.gltf").contains("expected a name that ends in .glb or .gltf"));
    std::fs::write(at("a.ply"), "ply").unwrap();
    assert!(error("a.glb", "a.ply").ends_with("expected a .glb or .gltf, to which cameras can be added, found PLY"));
}

#[test]
fn a_path_that_gives_way_leaves_nothing_of_it() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let cameras = [("front".to_owned(), camera())];
    let scene = random_scene(5, 0, 1, 4);
    write_scene(&at("a.glb"), &scene, &WriteOptions { cameras: &cameras, ..WriteOptions::default() }).unwrap();
    let file =
        CameraFile { cameras: shot(5, 0.0), fps: Some(9.0), y_up: false, times: vec![], near: None, notes: vec![] };
    write_cameras_with_scene(&at("b.gltf"), &at("a.glb"), &file).unwrap();
    let document =
        |name: &str| -> serde_json::Value { serde_json::from_slice(&std::fs::read(at(name)).unwrap()).unwrap() };
    let mut changed = document("b.gltf");
    // Another program also animates our node, in an animation of its own and in one that moves further nodes, and uses
    // our camera at a node of its own.
    let mut theirs = changed["animations"][0].clone();
    theirs.as_object_mut().unwrap().remove("extras");
    let node = theirs["channels"][0]["target"]["node"].clone();
    let mut both = theirs.clone();
    both["channels"][1]["target"]["node"] = json!(0);
    changed["animations"].as_array_mut().unwrap().extend([theirs, both]);
    let nodes = changed["nodes"].as_array_mut().unwrap();
    let optics = nodes[node.as_u64().unwrap() as usize]["camera"].clone();
    let last = nodes.len();
    nodes.push(json!({ "name": "theirs", "camera": optics }));
    changed["scenes"][0]["nodes"].as_array_mut().unwrap().push(json!(last));
    std::fs::write(at("c.gltf"), changed.to_string()).unwrap();
    write_cameras_with_scene(&at("d.gltf"), &at("c.gltf"), &file).unwrap();
    let after = document("d.gltf");
    let channels: Vec<usize> =
        after["animations"].as_array().unwrap().iter().map(|a| a["channels"].as_array().unwrap().len()).collect();
    assert_eq!(channels, [1, 2]);
    assert_eq!(after["animations"][0]["channels"][0]["target"]["node"], 0);
    let camera = after["nodes"][last]["camera"].as_u64().unwrap() as usize;
    assert_eq!(after["cameras"][camera], changed["cameras"][optics.as_u64().unwrap() as usize]);
    assert_eq!(after["cameras"].as_array().unwrap().len(), 3);
    assert_eq!(validate(&at("d.gltf")).unwrap().errors, 0);
    let only = Sampling { only: &[NAME.to_owned()], ..Sampling::default() };
    assert!(largest_difference(&file.cameras, &read_cameras(&at("d.gltf"), &only).unwrap().cameras) < 2e-5);
    // Children of our node stay at its rest position.
    let mut hung = document("b.gltf");
    let nodes = hung["nodes"].as_array_mut().unwrap();
    let (path, light) = (node.as_u64().unwrap() as usize, nodes.len());
    nodes.push(json!({ "name": "light" }));
    nodes[path]["children"] = json!([light]);
    std::fs::write(at("e.gltf"), hung.to_string()).unwrap();
    write_cameras_with_scene(&at("f.gltf"), &at("e.gltf"), &file).unwrap();
    let after = document("f.gltf");
    let (still, rested) = (&after["nodes"][path], &hung["nodes"][path]);
    assert_eq!((&still["children"], &still["translation"]), (&json!([light]), &rested["translation"]));
    assert!(still.get("camera").is_none() && after["scenes"][0]["nodes"].as_array().unwrap().contains(&json!(path)));
    assert_eq!(
        (after["nodes"][light].clone(), after["animations"].as_array().unwrap().len()),
        (json!({ "name": "light" }), 1)
    );
    assert_eq!(validate(&at("f.gltf")).unwrap().errors, 0);
    // Without the path, the cameras of the scene are left.
    let without = read_cameras(&at("b.gltf"), &Sampling { without_paths: true, ..Sampling::default() }).unwrap();
    let names: Vec<&str> = without.cameras.iter().map(|(name, _)| &name[..]).collect();
    assert_eq!((names, without.fps), (vec!["front"], None));
}

#[test]
fn usd_in_binary_moves_as_its_text() {
    let at = |name: &str| Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/usd").join(name);
    let (text, binary) = (read(&at("moving.usda")), read(&at("moving.usdc")));
    assert_eq!((binary.fps, &binary.cameras), (Some(24.0), &text.cameras));
    let x: Vec<f64> = binary.cameras.iter().map(|(_, camera)| camera.center().x).collect();
    assert_eq!(x, [0.0, 1.0, 2.0, 3.0, 4.0]);
}
