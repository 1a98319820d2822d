//! `transforms*.json` files written by the tests themselves, and errors in them.

use std::path::Path;

use glam::DVec3;
use image::RgbImage;

use super::tests::{full, message, write_capture};
use super::*;
use crate::scene::Intrinsics;

/// Lengths in pixels refer to the photographs that the file names, not to the smaller ones used in their place.
#[test]
fn other_folders_keep_the_field_of_view_of_files_without_a_size() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    let frame = |i: usize| {
        for (images, scale) in [("images", 2), ("images_2", 1)] {
            std::fs::create_dir_all(root.join(images)).unwrap();
            RgbImage::new(20 * scale, 10 * scale).save(root.join(format!("{images}/{i}.png"))).unwrap();
        }
        let x = i as f64;
        serde_json::json!({
            "file_path": format!("images/{i}.png"), "transform_matrix": [[1, 0, 0, x], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1]],
        })
    };
    let frames = [0, 1].map(frame);
    let write = |mut file: serde_json::Value| {
        file["frames"] = serde_json::json!(frames);
        std::fs::write(root.join("transforms.json"), file.to_string()).unwrap();
    };
    let options = LoadOptions { images: Some("images_2".into()), ..full() };
    let read = || open(root, &options).map(|capture| *capture.views[0].camera.intrinsics());
    let expected = Intrinsics { width: 20, height: 10, fx: 25.0, fy: 25.0, cx: 9.0, cy: 5.0 };
    let in_pixels = serde_json::json!({ "fl_x": 50, "cx": 18 });
    write(in_pixels.clone());
    assert_eq!(read().unwrap(), expected);
    std::fs::remove_dir_all(root.join("images")).unwrap();
    assert!(message(root, &options).contains("expected w and h beside fl_x"), "{}", message(root, &options));
    // Fields of view do not depend on the size.
    write(serde_json::json!({ "camera_angle_x": 2.0 * (10.0_f64 / 25.0).atan() }));
    assert!((read().unwrap().fx - 25.0).abs() < 1e-9);
}

/// A `transforms.json` in the three usual shapes reads as the same cameras.
#[test]
fn transforms_in_opengl_axes() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    std::fs::create_dir_all(root.join("train")).unwrap();
    std::fs::create_dir_all(root.join("test")).unwrap();
    // OpenGL camera at (0, 0, 4) that looks along its −z, towards the origin.
    let pose = "[[1,0,0,0],[0,1,0,0],[0,0,1,4],[0,0,0,1]]";
    for (part, count) in [("train", 2), ("test", 1)] {
        let mut frames = vec![];
        for i in 0..count {
            image::RgbaImage::from_pixel(8, 8, image::Rgba([9, 8, 7, 128]))
                .save(root.join(format!("{part}/r_{i}.png")))
                .unwrap();
            frames.push(format!(r#"{{"file_path":"./{part}/r_{i}","rotation":0.1,"transform_matrix":{pose}}}"#));
        }
        let json = format!(r#"{{"camera_angle_x":1.5707963267948966,"frames":[{}]}}"#, frames.join(","));
        std::fs::write(root.join(format!("transforms_{part}.json")), json).unwrap();
    }
    let capture = open(root, &full()).unwrap();
    let names: Vec<_> = capture.views.iter().map(|v| &v.name[..]).collect();
    assert_eq!(names, ["test/r_0", "train/r_0", "train/r_1"]);
    assert_eq!(Split::Every8th.split(&capture.views), (vec![1, 2], vec![0]));
    let camera = capture.views[0].camera;
    // tan 45° = 1: the focal length is half the width.
    assert!((camera.intrinsics().fx - 4.0).abs() < 1e-9 && (camera.intrinsics().fy - 4.0).abs() < 1e-9);
    assert!(camera.center().distance(DVec3::new(0.0, 0.0, 4.0)) < 1e-12);
    // World up is up in the picture: a point above the origin projects to the upper half.
    let p = camera.to_camera(DVec3::new(1.0, 2.0, 0.0));
    assert!(p.distance(DVec3::new(1.0, -2.0, 4.0)) < 1e-12, "{p}");
    let photo = decode(&capture.views[0]).unwrap();
    assert!(photo.has_alpha && !photo.masked && photo.rgba[..4] == [9, 8, 7, 128]);

    let frames = |extra: &str| {
        format!(
            r#"{{"fl_x":6,"fl_y":7,"cx":4.5,"cy":3.5,"w":8,"h":8.0,"aabb_scale":16{extra},"frames":[
            {{"file_path":"train/r_0.png","transform_matrix":{pose}}},
            {{"file_path":"train/r_1.png","fl_x":5,"transform_matrix":{pose}}}]}}"#
        )
    };
    let file = root.join("transforms.json");
    std::fs::write(&file, frames(r#","k1":0.1,"p1":0.01,"test_filenames":["./train/r_1.png"]"#)).unwrap();
    let capture = open(&file, &full()).unwrap();
    let k = capture.views[1].source.lens().intrinsics;
    // A value that a frame gives for one axis applies to both, as in instant-ngp.
    assert_eq!((k.fx, k.fy, k.cx, k.cy), (5.0, 5.0, 4.5, 3.5));
    let brown = Distortion::Brown { k: [0.1, 0.0, 0.0, 0.0, 0.0, 0.0], p: [0.01, 0.0] };
    assert_eq!(capture.views[1].source.lens().distortion, brown);
    assert_eq!(Split::Every8th.split(&capture.views), (vec![0], vec![1]));
    assert!(capture.points.is_empty());

    // Points are in the world frame of the poses; every file is read only once.
    let ply = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n\
               property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n1 2 3 10 20 30\n4 5 6 40 50 60\n";
    std::fs::write(root.join("sparse_pc.ply"), ply).unwrap();
    std::fs::write(&file, frames(r#","ply_file_path":"./sparse_pc.ply""#)).unwrap();
    let points = open(&file, &full()).unwrap().points;
    let expected = [([1.0, 2.0, 3.0], [10, 20, 30]), ([4.0, 5.0, 6.0], [40, 50, 60])];
    assert_eq!(points, expected.map(|(p, rgb)| Point { position: DVec3::from(p), rgb }));
    // A y-up world is rotated into the frame of captures, including its points.
    let there = open(&file, &full()).unwrap();
    std::fs::write(&file, frames(r#","ply_file_path":"./sparse_pc.ply","centaur":{"y_up":true}"#)).unwrap();
    let turned = open(&file, &full()).unwrap();
    let half_turn = DVec3::new(1.0, -1.0, -1.0);
    for (before, after) in there.views.iter().zip(&turned.views) {
        let p = DVec3::new(0.3, 0.7, -0.2);
        assert!(after.camera.to_camera(half_turn * p).abs_diff_eq(before.camera.to_camera(p), 1e-12));
    }
    assert!(there.points.iter().zip(&turned.points).all(|(a, b)| half_turn * a.position == b.position));
    std::fs::write(&file, frames(r#","ply_file_path":"../sparse_pc.ply""#)).unwrap();
    let escape = open(&file, &full()).unwrap_err().to_string();
    assert!(escape.contains("/ply_file_path: expected a path inside the capture"), "{escape}");
    std::fs::write(&file, frames(r#","ply_file_path":"none.ply""#)).unwrap();
    let missing = open(&file, &full()).unwrap_err().to_string();
    assert!(missing.contains("none.ply: "), "{missing}");
    assert!(open(&file, &LoadOptions { without_points: true, ..full() }).is_ok());
    for lists in [
        r#","test_filenames":null,"val_filenames":["train/r_0.png"]"#,
        r#","train_filenames":["train/r_1.png"],"val_filenames":["train/r_0.png"]"#,
    ] {
        std::fs::write(&file, frames(lists)).unwrap();
        assert_eq!(Split::Every8th.split(&open(&file, &full()).unwrap().views), (vec![1], vec![0]), "{lists}");
    }
    // Frames that are in no list are left out.
    std::fs::write(&file, frames(r#","train_filenames":["train/r_1.png"]"#)).unwrap();
    assert!(message(&file, &full()).contains("at least 2 posed images, found 1"));
    std::fs::write(&file, frames(r#","train_filenames":["train/r_1.png","train/r_0"]"#)).unwrap();
    assert!(message(&file, &full()).ends_with("expected the file_path of a frame, found train/r_0"));

    for (extra, expected) in [
        (r#","camera_model":"EQUIRECTANGULAR""#, "EQUIRECTANGULAR"),
        (r#","k4":0.5"#, "k4"),
        (r#","camera_model":"OPENCV","k6":0.5"#, "k6"),
        (r#","w":NaN"#, "line 1"),
    ] {
        std::fs::write(&file, frames(extra)).unwrap();
        assert!(message(&file, &full()).contains(expected), "{extra}");
    }
    std::fs::write(&file, frames(r#","camera_model":"FULL_OPENCV","k2":0.2,"k4":0.4,"k6":0.6"#)).unwrap();
    let rational = Distortion::Brown { k: [0.0, 0.2, 0.0, 0.4, 0.0, 0.6], p: [0.0; 2] };
    assert_eq!(open(&file, &full()).unwrap().views[0].source.lens().distortion, rational);
    let scaled = frames("").replace("[1,0,0,0]", "[2,0,0,0]");
    std::fs::write(&file, scaled).unwrap();
    assert!(message(&file, &full()).contains("rotation"));
}

#[test]
fn of_two_files_the_one_at_fault_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    for name in ["a.png", "b.png"] {
        RgbImage::new(8, 6).save(root.join(name)).unwrap();
    }
    let file = |name: &str, x: f64| {
        format!(
            r#"{{ "fl_x": 8, "frames": [{{ "file_path": "{name}", "transform_matrix": [[{x},0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]] }}] }}"#
        )
    };
    std::fs::write(root.join("transforms_train.json"), file("a.png", 1.0)).unwrap();
    for (test, said) in [
        (file("b.png", 3.0), "transforms_test.json: /frames/0, image b.png: pose"),
        (file("a.png", 1.0), "transforms_test.json: /frames/0: expected unique names, found a.png twice"),
    ] {
        std::fs::write(root.join("transforms_test.json"), test).unwrap();
        let error = message(root, &full());
        assert!(error.contains(said), "{error}");
    }
}

#[test]
fn frames_have_lenses_of_their_own() {
    let folder = tempfile::tempdir().unwrap();
    write_transforms(folder.path(), 0.0);
    let file = folder.path().join("transforms.json");
    let text = std::fs::read_to_string(&file).unwrap();
    // Pictures of 8×8 pixels; at 90° the focal length is half of a side.
    let focal = |of_file: &str, of_frame: &str| {
        let own = format!(r#""file_path":"1.png",{of_frame}"#);
        let text = text.replace(r#""fl_x":8"#, of_file).replace(r#""file_path":"1.png","#, &own);
        std::fs::write(&file, text).unwrap();
        open(&file, &full()).map(|capture| {
            let k = capture.views[1].camera.intrinsics();
            [k.fx, k.fy].map(|f| (f * 1e6).round() / 1e6)
        })
    };
    let right = "1.5707963267948966";
    for (of_file, of_frame, expected) in [
        (r#""fl_x":8,"fl_y":9"#, String::new(), [8.0, 9.0]),
        (r#""fl_x":8,"fl_y":9"#, format!(r#""camera_angle_x":{right},"#), [4.0, 4.0]),
        (r#""fl_x":8,"fl_y":9"#, r#""fl_y":7,"#.into(), [7.0, 7.0]),
        (r#""x_fov":90,"fl_x":8"#, String::new(), [4.0, 4.0]),
        (r#""fl_x":8"#, format!(r#""camera_angle_x":{right},"fl_y":6,"#), [4.0, 6.0]),
    ] {
        assert_eq!(focal(of_file, &of_frame).unwrap(), expected, "{of_file} {of_frame}");
    }
    for angle in ["3.15", "40", "0", "-1"] {
        let refusal = focal(&format!(r#""camera_angle_x":{angle}"#), "").unwrap_err().to_string();
        assert!(refusal.contains("an angle of view between 0 and π radians"), "{refusal}");
    }
    let refusal = focal(r#""fl_x":8"#, r#""fl_x":1e300,"#).unwrap_err().to_string();
    assert!(refusal.contains("focal length: expected 0.001 to 1000000 times the sides"), "{refusal}");
    let refusal = focal(r#""fl_x":8,"latlong":true"#, "").unwrap_err().to_string();
    assert!(refusal.contains("latlong"), "{refusal}");
    let refusal = focal(r#""fl_x":8,"equirectangular":true"#, "").unwrap_err().to_string();
    assert!(refusal.contains("equirectangular"), "{refusal}");
    let refusal = focal(r#""fl_x":8,"camera_model":"OPENCV""#, r#""is_fisheye":true,"#).unwrap_err().to_string();
    assert!(refusal.contains("expected no is_fisheye beside camera_model OPENCV, found true"), "{refusal}");
    focal(r#""fl_x":8,"camera_model":"OPENCV_FISHEYE","is_fisheye":true"#, "").unwrap();
}

/// The list is in nerfstudio's order and takes precedence over single coefficients beside it.
#[test]
fn distortion_is_also_a_list() {
    let folder = tempfile::tempdir().unwrap();
    write_transforms(folder.path(), 0.0);
    let file = folder.path().join("transforms.json");
    let text = std::fs::read_to_string(&file).unwrap();
    let lens = |fields: &str| {
        std::fs::write(&file, text.replace(r#""fl_x":8"#, &format!(r#""fl_x":8,{fields}"#))).unwrap();
        open(&file, &full()).map(|capture| capture.views[0].source.lens)
    };
    let named = lens(r#""k1":-0.02,"k2":0.01,"k3":0.003,"p1":0.001,"p2":-0.002"#).unwrap();
    assert_ne!(named.distortion, Distortion::None);
    assert_eq!(lens(r#""k1":0.5,"distortion_params":[-0.02,0.01,0.003,0,0.001,-0.002]"#).unwrap(), named);
    let refusal = lens(r#""distortion_params":[-0.02,0.01]"#).unwrap_err().to_string();
    assert!(refusal.contains("expected six distortion_params: k1, k2, k3, k4, p1, p2, found 2"), "{refusal}");
}

/// Also if the axes in the matrix are rounded, or slightly longer than one.
#[test]
fn cameras_are_where_their_matrices_say() {
    let (sin, cos) = 0.4_f64.sin_cos();
    for (scale, digits) in [(1.005, 1e9), (1.0, 1e4)] {
        let round = |v: f64| (v * scale * digits).round() / digits;
        let rows = [
            [round(cos), 0.0, round(sin), 900.0],
            [0.0, round(1.0), 0.0, -300.0],
            [round(-sin), 0.0, round(cos), 500.0],
            [0.0, 0.0, 0.0, 1.0],
        ];
        let (rotation, translation) = transforms::world_to_camera(&rows).unwrap();
        let intrinsics = Intrinsics { width: 8, height: 8, fx: 8.0, fy: 8.0, cx: 4.0, cy: 4.0 };
        let camera = Camera::new(intrinsics, rotation, translation).unwrap();
        assert!(camera.center().distance(DVec3::new(900.0, -300.0, 500.0)) < 1e-9, "{}", camera.center());
        let ahead = camera.rotation().transpose() * DVec3::Z;
        assert!(ahead.distance(DVec3::new(-sin, 0.0, -cos)) < 2.0 / digits, "{ahead}");
    }
}

#[test]
fn frames_say_when_they_were_taken() {
    let folder = tempfile::tempdir().unwrap();
    write_transforms(folder.path(), 0.0);
    let file = folder.path().join("transforms.json");
    let text = std::fs::read_to_string(&file).unwrap();
    for (own, expected) in [
        ("", None),
        (r#""time":0.25,"#, Some(0.25)),
        (r#""timestep_index":7,"#, Some(7.0)),
        (r#""time":"0003","#, Some(3.0)),
        (r#""time":"noon","#, None),
        (r#""time":[1],"#, None),
    ] {
        std::fs::write(&file, text.replace(r#""file_path":"1.png","#, &format!(r#"{own}"file_path":"1.png","#)))
            .unwrap();
        let views = open(&file, &full()).unwrap().views;
        assert_eq!((views[0].source.time(), views[1].source.time()), (None, expected), "{own}");
    }
}

#[test]
fn paths_of_windows_are_read_everywhere() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    write_transforms(folder.path(), 0.0);
    std::fs::create_dir(at("images")).unwrap();
    for name in ["0.png", "1.png"] {
        std::fs::rename(at(name), at("images").join(name)).unwrap();
    }
    let text = std::fs::read_to_string(at("transforms.json")).unwrap();
    let write = |before: &str| {
        let text = text.replace(r#""file_path":""#, &format!(r#""file_path":"{before}"#));
        std::fs::write(at("transforms.json"), text).unwrap();
    };
    write(r".\\images\\");
    let names: Vec<_> = open(folder.path(), &full()).unwrap().views.into_iter().map(|view| view.name).collect();
    assert_eq!(names, ["images/0.png", "images/1.png"]);
    for outside in [r"..\\", r"images\\..\\..\\", r"\\images\\"] {
        write(outside);
        assert!(message(folder.path(), &full()).contains("expected a path inside the capture"), "{outside}");
    }
    // Masks that are not asked for may be anywhere.
    for mask in ["../out.png", "/out.png", ""] {
        let text = text.replace("cut/out.png", mask).replace(r#""file_path":""#, r#""file_path":"images/"#);
        std::fs::write(at("transforms.json"), text).unwrap();
        assert_eq!(open(folder.path(), &full()).unwrap().views.len(), 2);
        let masks = open(folder.path(), &LoadOptions { masks: true, ..full() });
        let refused = masks.err().is_some_and(|e| e.to_string().contains("expected a path inside the capture"));
        assert_eq!(refused, !mask.is_empty(), "{mask}");
    }
}

/// Writes a `transforms.json` with two frames, at `x` and `x` + 1, the second with a mask.
pub(super) fn write_transforms(root: &Path, x: f64) {
    let frames: Vec<String> = [(0, ""), (1, r#""mask_path":"cut/out.png","#)]
        .into_iter()
        .map(|(i, mask)| {
            RgbImage::new(8, 8).save(root.join(format!("{i}.png"))).unwrap();
            let at = x + f64::from(i);
            let pose = format!("[[1,0,0,{at}],[0,1,0,0],[0,0,1,4],[0,0,0,1]]");
            format!(r#"{{"file_path":"{i}.png",{mask}"transform_matrix":{pose}}}"#)
        })
        .collect();
    let json = format!(r#"{{"fl_x":8,"frames":[{}]}}"#, frames.join(","));
    std::fs::write(root.join("transforms.json"), json).unwrap();
}

#[test]
fn what_lies_beside_transforms_does_not_hide_them() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    write_transforms(root, 0.0);
    std::fs::write(root.join("frames.txt"), "file '0.png'\nfile '1.png'\n").unwrap();
    assert_eq!(open(root, &full()).unwrap().views.len(), 2);
    // A COLMAP model directly in the folder is recognised.
    write_capture(root, 3, 8, 8);
    for file in ["cameras.bin", "images.bin", "points3D.bin"] {
        std::fs::rename(root.join("sparse/0").join(file), root.join(file)).unwrap();
    }
    let capture = open(root, &full()).unwrap();
    assert_eq!((capture.views.len(), capture.passed_over), (3, vec![root.join("transforms.json")]));
    let named = open(&root.join("transforms.json"), &full()).unwrap();
    assert_eq!((named.views.len(), named.passed_over), (2, vec![]));
}

/// Two files define a split; a single one does not: every eighth of its views is held out, as if it were named
/// explicitly.
#[test]
fn a_split_is_of_two_files() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    write_transforms(root, 0.0);
    let at = |name: &str| root.join(name);
    for name in ["transforms_train.json", "transforms_test.json"] {
        std::fs::rename(at("transforms.json"), at(name)).unwrap();
        let capture = open(root, &full()).unwrap();
        assert_eq!(Split::Every8th.split(&capture.views), (vec![1], vec![0]), "{name}");
        assert_eq!(capture.views[0].source.held_out(), None);
        std::fs::rename(at(name), at("transforms.json")).unwrap();
    }
    // Without a test file, the validation file is held out.
    let other = tempfile::tempdir().unwrap();
    for (part, x) in [("val", 9.0), ("train", 0.0)] {
        write_transforms(other.path(), x);
        let at = |name: &str| other.path().join(name);
        for i in [0, 1] {
            std::fs::rename(at(&format!("{i}.png")), at(&format!("{part}{i}.png"))).unwrap();
        }
        let text = std::fs::read_to_string(at("transforms.json")).unwrap();
        let text = text.replace(r#""file_path":""#, &format!(r#""file_path":"{part}"#));
        std::fs::write(at(&format!("transforms_{part}.json")), text).unwrap();
        std::fs::remove_file(at("transforms.json")).unwrap();
    }
    let views = open(other.path(), &full()).unwrap().views;
    for (views_of_part, part) in <[Vec<usize>; 2]>::from(Split::Every8th.split(&views)).iter().zip(["train", "val"]) {
        let names: Vec<&str> = views_of_part.iter().map(|&i| views[i].name.as_str()).collect();
        assert_eq!(names, [0, 1].map(|i| format!("{part}{i}.png")));
    }
    // Beside a `transforms.json` with all frames they are ignored.
    for name in ["transforms_train.json", "transforms_test.json"] {
        std::fs::copy(at("transforms.json"), at(name)).unwrap();
    }
    let both = ["transforms_train.json", "transforms_test.json"].map(at).to_vec();
    assert_eq!(open(root, &full()).unwrap().passed_over, both);
    assert_eq!(cameras(root, &full()).unwrap().passed_over, both);
}

#[test]
fn masks_that_frames_name_are_missed_where_they_should_be() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    write_transforms(root, 0.0);
    let missing = message(root, &LoadOptions { masks: true, ..full() });
    let expected = Path::new("cut").join("out.png").display().to_string();
    assert!(missing.contains(&format!("1 of 1 masks missing, the first is {expected}")), "{missing}");
    assert!(!missing.contains("masks:"), "there is no such folder: {missing}");
    // The name that VHAP gives to masks.
    let file = root.join("transforms.json");
    let renamed = std::fs::read_to_string(&file).unwrap().replace("mask_path", "fg_mask_path");
    std::fs::write(&file, renamed).unwrap();
    assert_eq!(message(root, &LoadOptions { masks: true, ..full() }), missing);
}

/// If only one of two images were replaced, the other would be used in its own, larger size.
#[test]
fn another_folder_takes_the_place_of_all_images_or_of_none() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    write_transforms(root, 0.0);
    for place in ["images", "small", "extra"] {
        std::fs::create_dir(root.join(place)).unwrap();
        for name in ["0.png", "1.png"] {
            std::fs::copy(root.join(name), root.join(place).join(name)).unwrap();
        }
    }
    let file = root.join("transforms.json");
    let text = std::fs::read_to_string(&file).unwrap();
    let small = LoadOptions { images: Some("small".to_owned()), ..full() };
    for (second, is_read) in [("images/1.png", true), ("small/1.png", true), ("extra/1.png", false)] {
        let named = text.replace(r#""0.png""#, r#""images/0.png""#).replace(r#""1.png""#, &format!("\"{second}\""));
        std::fs::write(&file, named).unwrap();
        match open(root, &small) {
            Ok(capture) => assert!(is_read && capture.views.len() == 2, "{second}"),
            Err(e) => assert!(!is_read && e.to_string().contains("/frames/1/file_path"), "{second}: {e}"),
        }
    }
}

/// The list is in order: a file is not there.
#[test]
fn missing_images_of_another_folder_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    write_transforms(root, 0.0);
    std::fs::create_dir_all(root.join("small/left")).unwrap();
    for name in ["0.png", "left/0.png"] {
        std::fs::copy(root.join("0.png"), root.join("small").join(name)).unwrap();
    }
    let small = LoadOptions { images: Some("small".to_owned()), ..full() };
    let text = std::fs::read_to_string(root.join("transforms.json")).unwrap();
    let text = text.replace(r#""fl_x":8"#, r#""fl_x":8,"w":8,"h":8"#);
    for (before, file) in [("", "small/1.png"), ("left/", "small/left/1.png"), ("small/", "small/1.png")] {
        let named = text.replace(r#""file_path":""#, &format!(r#""file_path":"{before}"#));
        std::fs::write(root.join("transforms.json"), named).unwrap();
        let missing = message(root, &small).replace('\\', "/");
        assert!(missing.ends_with(&format!(": 1 of 2 images missing, the first is {file}")), "{missing}");
    }
    // Of files in none of these folders the path is said as it is listed, also where names are without its beginning.
    let named = text.replace(r#""file_path":""#, r#""file_path":"./a/b/"#);
    let ours = named.replace(r#""frames""#, r#""centaur":{"images":"a"},"frames""#);
    std::fs::write(root.join("transforms.json"), ours).unwrap();
    let refused = message(root, &small);
    assert!(refused.contains("/frames/0/file_path: ") && refused.ends_with(" found ./a/b/0.png"), "{refused}");
}

/// As nerfstudio lays captures out, where a list leaves out the folder.
#[test]
fn photographs_may_lie_in_their_usual_folder() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    write_transforms(root, 0.0);
    for images in ["images", "small"] {
        std::fs::create_dir(root.join(images)).unwrap();
        for name in ["0.png", "1.png"] {
            std::fs::copy(root.join(name), root.join(images).join(name)).unwrap();
        }
    }
    let first = |images: Option<&str>| {
        let options = LoadOptions { images: images.map(str::to_owned), ..full() };
        let view = open(root, &options).unwrap().views.remove(0);
        assert_eq!(view.name, "0.png");
        view.source.path().strip_prefix(root).unwrap().to_owned()
    };
    let [beside, images, small] = ["0.png", "images/0.png", "small/0.png"].map(Path::new);
    assert_eq!([None, Some("images"), Some("small")].map(first), [beside, images, small]);
    for name in ["0.png", "1.png"] {
        std::fs::remove_file(root.join(name)).unwrap();
    }
    assert_eq!([None, Some("images"), Some("small")].map(first), [images, images, small]);
    // What lies there beside one of ours, which does not say so, may be renders of it.
    let file = root.join("transforms.json");
    let named = || cameras(root, &full()).unwrap().images[0].clone();
    let text = std::fs::read_to_string(&file).unwrap().replace(r#""fl_x":8"#, r#""fl_x":8,"w":8,"h":8"#);
    std::fs::write(&file, &text).unwrap();
    assert_eq!(named(), root.join(images));
    std::fs::write(&file, text.replace(r#""fl_x":8"#, r#""fl_x":8,"centaur":{}"#)).unwrap();
    assert_eq!(named(), root.join(beside));
}

/// As `centaur cameras convert` writes it, with names as in the capture that the cameras are of.
#[test]
fn names_may_be_without_the_folder_of_the_photographs() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    write_transforms(root, 0.0);
    std::fs::create_dir_all(root.join("a/images")).unwrap();
    for name in ["0.png", "1.png"] {
        std::fs::rename(root.join(name), root.join("a/images").join(name)).unwrap();
    }
    let file = root.join("transforms.json");
    let text = std::fs::read_to_string(&file).unwrap().replace(r#""file_path":""#, r#""file_path":"./a/images/"#);
    for (images, name) in [("a/images", "0.png"), ("a", "images/0.png"), ("b", "a/images/0.png")] {
        let ours = format!(r#""centaur":{{"images":"{images}"}},"frames""#);
        std::fs::write(&file, text.replace(r#""frames""#, &ours)).unwrap();
        let view = open(root, &full()).unwrap().views.remove(0);
        assert_eq!((&*view.name, view.source.path()), (name, &*root.join("a/images/0.png")));
        assert_eq!(cameras(root, &full()).unwrap().cameras[0].0, name);
        let found = cameras(root, &full()).unwrap().images_folder;
        assert_eq!(found, root.join("a/images/0.png").ancestors().nth(name.split('/').count()).map(Path::to_owned));
    }
}
