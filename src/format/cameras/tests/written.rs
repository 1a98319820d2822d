//! What is written is read again, and replaces no capture.

use super::{largest_difference, read, shot};
use crate::capture::{self, LoadOptions};
use crate::format::cameras::{CameraFile, Sampling};
use crate::format::{read_cameras, validate, write_cameras};

#[test]
fn what_is_written_is_read() {
    let folder = tempfile::tempdir().unwrap();
    for (frames, fps) in [(1, 24.0), (2, 30.0), (37, 29.97), (300, 60.0)] {
        let file = CameraFile { cameras: shot(frames, 0.0), fps: Some(fps), ..CameraFile::default() };
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
    let file = CameraFile { cameras: shot(5, 1.5), fps: Some(10.0), ..CameraFile::default() };
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
    let file = CameraFile { cameras: shot(4, 0.0), fps: Some(10.0), y_up: true, ..CameraFile::default() };
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
fn captures_are_neither_replaced_nor_hidden() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    let file = CameraFile { cameras: shot(3, 0.0), fps: Some(9.0), ..CameraFile::default() };
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
    // A model's folder may be named in place of its capture.
    refused("a/sparse", "0");
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
        let file = CameraFile { cameras, fps: Some(fps), times, ..CameraFile::default() };
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
