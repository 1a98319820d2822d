//! Animated cameras of glTF, frame by frame.

use glam::DVec3;
use serde_json::json;

use super::{TURN, gltf_with};
use crate::format::cameras::{CameraFile, DEFAULT_FPS, MAX_FRAMES, Sampling, frame_count};
use crate::format::read_cameras;

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
