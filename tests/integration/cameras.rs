//! `centaur cameras`, and `centaur render` from its output, as a user runs them.

use std::path::Path;
use std::process::Command;

use crate::common::{centaur, failure, said, stderr, tree, write_capture};
use centaur::format::{WriteOptions, write_scene};
use centaur::scene::color::linear_to_srgb;
use centaur::scene::{Atlas, Camera, Composition, HybridScene, Intrinsics, Mesh, Splats, Texture};
use glam::{DMat3, DVec3, Quat, Vec2, Vec3};

fn run(folder: &Path, args: &[&str]) -> String {
    let output = centaur(folder).args(args).output().unwrap();
    assert_eq!(output.status.code(), Some(0), "{args:?}: {}", stderr(&output));
    said(&output)
}

/// Writes a ball that is red at x > 0 and blue at x < 0.
fn write_ball(path: &Path, composition: Composition) {
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

/// RGBA pixels, row-major from the top.
fn read_exr(path: &Path) -> Vec<[f32; 4]> {
    use exr::prelude::{Vec2, read_first_rgba_layer_from_file};
    let read = read_first_rgba_layer_from_file(
        path,
        |size: Vec2<usize>, _| (size.width(), vec![[0.0; 4]; size.area()]),
        |(width, pixels), at: Vec2<usize>, (r, g, b, a): (f32, f32, f32, f32)| {
            pixels[at.y() * *width + at.x()] = [r, g, b, a];
        },
    );
    read.unwrap().layer_data.channel_data.pixels.1
}

/// Composited over a colour as browsers do with PNG, and in linear light as EXR stores it, a cut-out equals the
/// picture.
#[test]
fn what_is_cut_out_makes_the_picture_again_over_its_background() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    write_capture(&at("capture"), 9, (32, 24));
    let background = [0.25, 0.5, 1.0];
    write_ball(&at("ball.glb"), Composition { background, ..Composition::default() });
    for model in ["ewa", "ray"] {
        let render = |out: &str, flags: &[&str]| {
            let base =
                ["render", "ball.glb", "--cameras", "capture", "--camera", "000.png", "--model", model, "-o", out];
            run(folder.path(), &[&base[..], flags].concat());
            let mut files = std::fs::read_dir(at(out)).unwrap().map(|entry| entry.unwrap().path());
            let (file, more) = (files.next().unwrap(), files.next());
            assert_eq!(more, None);
            file
        };
        let name = |kind: &str| format!("{model}-{kind}");
        let whole = image::open(render(&name("whole"), &[])).unwrap().into_rgb8();
        let cut = image::open(render(&name("cut"), &["--alpha"])).unwrap();
        assert_eq!(cut.color(), image::ColorType::Rgba8);
        let cut = cut.into_rgba8();
        let linear = read_exr(&render(&name("linear"), &["--alpha", "--format", "exr"]));
        let mut see_through = 0;
        for ((whole, cut), linear) in whole.pixels().zip(cut.pixels()).zip(&linear) {
            let alpha = f32::from(cut.0[3]) / 255.0;
            see_through += u32::from(cut.0[3] > 5 && cut.0[3] < 250);
            assert!((linear[3] - alpha).abs() <= 0.5001 / 255.0);
            for c in 0..3 {
                let over = alpha * f32::from(cut.0[c]) / 255.0 + (1.0 - alpha) * background[c];
                // Three roundings to 8 bits: of the colour, of alpha and of the reference.
                assert!((over - f32::from(whole.0[c]) / 255.0).abs() <= 1.501 / 255.0, "{over} for {whole:?}");
                let straight = if linear[3] > 0.0 { linear_to_srgb(linear[c] / linear[3]) } else { 0.0 };
                assert!((straight.clamp(0.0, 1.0) - f32::from(cut.0[c]) / 255.0).abs() <= 0.51 / 255.0);
            }
        }
        assert!(see_through > 10, "{see_through} pixels are half transparent");
    }
    let both = ["render", "ball.glb", "-o", "out", "--alpha", "--exr-layers"];
    assert_eq!(centaur(folder.path()).args(both).output().unwrap().status.code(), Some(2));
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

#[cfg(unix)]
#[test]
fn films_are_made_by_ffmpeg_or_not_begun() {
    use std::os::unix::fs::PermissionsExt;
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    write_capture(&at("capture"), 9, (32, 24));
    write_ball(&at("ball.ply"), Composition::default());
    run(
        folder.path(),
        &["cameras", "orbit", "capture", "-o", "orbit.json", "--frames", "3", "--size", "21x15", "--fps", "12.5"],
    );
    let render = ["render", "ball.ply", "--cameras", "orbit.json", "-o", "frames", "--video", "film.mp4"];
    let film = |script: Option<&str>| {
        let _ = std::fs::remove_dir_all(at("bin"));
        std::fs::create_dir(at("bin")).unwrap();
        if let Some(script) = script {
            std::fs::write(
                at("bin/ffmpeg"),
                format!("#!/bin/sh\n[ \"$1\" = -version ] && exit\nPATH=/usr/bin:/bin\n{script}\n"),
            )
            .unwrap();
            std::fs::set_permissions(at("bin/ffmpeg"), PermissionsExt::from_mode(0o755)).unwrap();
        }
        let mut command = centaur(folder.path());
        // Temporary files are beside the film, even if the system's temporary folder is not available.
        let output = command.args(render).env("PATH", at("bin")).env("TMPDIR", at("none")).output().unwrap();
        (output.status.code(), stderr(&output))
    };
    let (code, said) = film(None);
    let expected = "error: film.mp4: cannot be made: there is no ffmpeg on PATH; install it";
    assert!(code == Some(1) && said.starts_with(expected), "{code:?} {said}");
    assert!(!at("frames").exists() && !at("film.mp4").exists(), "it was rendered for nothing");

    let (code, said) = film(Some("for last; do :; done; cat > \"$last\"; echo \"$*\" > arguments"));
    assert_eq!((code, &said[..]), (Some(0), ""));
    let names = [0, 1, 2].map(|i| at("frames").join(format!("frame_0000{i}.png")));
    let fed: Vec<u8> = names.iter().flat_map(|name| std::fs::read(name).unwrap()).collect();
    assert!(std::fs::read(at("film.mp4")).unwrap() == fed);
    assert!(std::fs::read_to_string(at("arguments")).unwrap().contains("-framerate 12.5 -i -"));

    // Also with the film in the folder of the pictures, which does not exist yet.
    let among = ["render", "ball.ply", "--cameras", "orbit.json", "-o", "new", "--video", "./new/film.mp4"];
    let output = centaur(folder.path()).args(among).env("PATH", at("bin")).output().unwrap();
    assert_eq!((output.status.code(), &*stderr(&output)), (Some(0), ""));
    assert!(std::fs::read(at("new/film.mp4")).unwrap() == fed);

    std::fs::remove_file(at("film.mp4")).unwrap();
    let (code, said) = film(Some("echo 'Unknown encoder libx264' >&2; exit 1"));
    assert_eq!((code, &said[..]), (Some(1), "error: film.mp4: not made: ffmpeg: Unknown encoder libx264\n"));
    // A closed pipe to ffmpeg is an error, unlike one to a reader of our output.
    let (code, said) = film(Some("exec <&-"));
    assert!(code == Some(1) && said.starts_with("error: ") && !at("film.mp4").exists(), "{code:?} {said}");
    let left: Vec<_> = std::fs::read_dir(folder.path()).unwrap().map(|e| e.unwrap().file_name()).collect();
    assert!(left.iter().all(|name| !name.to_string_lossy().starts_with(".centaur-")), "{left:?}");
}

/// Metadata of a film by the real ffmpeg, and its frames: the pictures, with odd sizes, in order and with their
/// colours.
#[test]
#[ignore = "needs ffmpeg: make oracle-ffmpeg"]
fn films_show_the_pictures() {
    let folder = tempfile::tempdir().unwrap();
    let ([width, height], frames) = ([61, 45], 5);
    write_capture(&folder.path().join("capture"), 9, (32, 24));
    write_ball(&folder.path().join("ball.ply"), Composition::default());
    run(
        folder.path(),
        &["cameras", "orbit", "capture", "-o", "orbit.json", "--frames", "5", "--size", "61x45", "--fps", "12.5"],
    );
    run(folder.path(), &["render", "ball.ply", "--cameras", "orbit.json", "-o", "frames", "--video", "film.mp4"]);
    let stdout_of = |program: &str, args: &[&str]| {
        let output = Command::new(program).current_dir(folder.path()).args(args).output().unwrap();
        assert!(output.status.success(), "{}", stderr(&output));
        output.stdout
    };
    let entries = "stream=codec_name,pix_fmt,width,height,r_frame_rate,nb_read_frames,color_range,color_space,color_transfer,color_primaries";
    let told =
        stdout_of("ffprobe", &["-v", "error", "-count_frames", "-show_entries", entries, "-of", "json", "film.mp4"]);
    let told: serde_json::Value = serde_json::from_slice(&told).unwrap();
    let expected = serde_json::json!([{
        "codec_name": "h264", "pix_fmt": "yuv420p", "width": 62, "height": 46, "r_frame_rate": "25/2", "nb_read_frames": "5",
        "color_range": "tv", "color_space": "bt709", "color_transfer": "bt709", "color_primaries": "bt709",
    }]);
    assert_eq!(told["streams"], expected);

    let shown = stdout_of("ffmpeg", &["-v", "error", "-i", "film.mp4", "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]);
    assert_eq!(shown.len(), frames * (width + 1) * (height + 1) * 3);
    // Mean difference between a frame of the film and a picture, out of 255, without the column and row that make its
    // sides even.
    let difference = |frame: usize, picture: usize| {
        let picture = image::open(folder.path().join(format!("frames/frame_0000{picture}.png"))).unwrap().to_rgb8();
        let rows = shown.chunks_exact(3 * (width + 1)).skip(frame * (height + 1)).take(height);
        let pairs = rows.flat_map(|row| &row[..3 * width]).zip(picture.as_raw());
        pairs.map(|(a, b)| f64::from(a.abs_diff(*b))).sum::<f64>() / (3 * width * height) as f64
    };
    for frame in 0..frames {
        let (same, next) = (difference(frame, frame), difference(frame, (frame + 1) % frames));
        assert!(same < 1.0 && next > 2.0 * same, "frame {frame}: {same} from its picture, {next} from the next");
    }

    // Pixels that are twice as wide as high are displayed so, and frames with different pixel aspects make no film.
    let frame = |name: &str, fl_y: u32| {
        serde_json::json!({
            "file_path": name, "w": 64, "h": 48, "fl_x": 30, "fl_y": fl_y,
            "transform_matrix": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1]],
        })
    };
    let render = ["render", "ball.ply", "--cameras", "wide.json", "-o", "wide", "--video", "wide.mp4"];
    let write = |frames: &[serde_json::Value]| {
        std::fs::write(folder.path().join("wide.json"), serde_json::json!({ "frames": frames }).to_string()).unwrap();
    };
    write(&[frame("a.png", 60), frame("b.png", 30)]);
    let line = failure(folder.path(), centaur(folder.path()).args(render));
    assert_eq!(
        line,
        "error: --video: expected pixels of one shape, found 2 times as wide as high and 1 of b.png; other cameras may help"
    );
    write(&[frame("a.png", 60), frame("b.png", 60)]);
    run(folder.path(), &render);
    let entries = ["-v", "error", "-show_entries", "stream=sample_aspect_ratio", "-of", "csv=p=0", "wide.mp4"];
    assert_eq!(String::from_utf8(stdout_of("ffprobe", &entries)).unwrap().trim(), "2:1");
}

/// Splats of another program, and a y-up model.
#[test]
fn scenes_without_cameras_are_seen_from_around_them() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    for scene in ["ball.ply", "ball.glb"] {
        write_ball(&at(scene), Composition::default());
        let said = run(folder.path(), &["render", scene, "-o", "around", "--max-side", "64"]);
        let note =
            format!("note: {scene}: has no cameras: rendered from 8 places around it; --cameras takes cameras of");
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
            let note = format!("note: {scene}: has no cameras: the path is made from 8 around the scene\n");
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
    let some = ["render", "ball.glb", "-o", "some", "--camera", "view_3", "--camera", "0", "--max-side", "32"];
    run(folder.path(), &some);
    let names = ["view_0.png", "view_3.png"].map(|name| at("some").join(name).display().to_string());
    assert_eq!(tree(&at("some")), names);
    // A path written into a scene does not count as the scene's cameras.
    for _ in 0..2 {
        run(folder.path(), &["cameras", "orbit", "ball.glb", "-o", "both.glb", "--with-scene", "--frames", "3"]);
        std::fs::rename(at("both.glb"), at("ball.glb")).unwrap();
    }
    let said = run(folder.path(), &["render", "ball.glb", "-o", "path", "--max-side", "32"]);
    assert!(said.starts_with("path: 3 pictures\n"), "{said}");
    let empty = HybridScene { splats: Splats::empty(0), meshes: vec![], composition: Composition::default() };
    write_scene(&at("empty.ply"), &empty, &WriteOptions::default()).unwrap();
    let line = failure(folder.path(), centaur(folder.path()).args(["render", "empty.ply", "-o", "no"]));
    assert_eq!(line, "error: empty.ply: expected a scene to look at, found no splats and no meshes");
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
        &["render", "ball.glb", "-o", "a", "--video", "a.avi"],
    ] {
        let output = centaur(folder.path()).args(args).output().unwrap();
        assert_eq!(output.status.code(), Some(2), "{args:?}");
    }
}

/// Compositors make a layer of all channels with the same prefix before the dot, and know layers of RGBA, of XYZ and of
/// one channel: Blender displays nothing of others.
#[test]
fn layers_have_channels_that_compositors_know() {
    let folder = tempfile::tempdir().unwrap();
    write_capture(&folder.path().join("capture"), 3, (32, 24));
    write_ball(&folder.path().join("ball.glb"), Composition::default());
    let render = ["render", "ball.glb", "--cameras", "capture", "--camera", "000.png", "--exr-layers", "-o", "out"];
    run(folder.path(), &render);
    let image = exr::prelude::read_first_flat_layer_from_file(folder.path().join("out/000.exr")).unwrap();
    let names: Vec<String> = image.layer_data.channel_data.list.iter().map(|c| c.name.to_string()).collect();
    let mut layers = std::collections::BTreeMap::<&str, Vec<&str>>::new();
    for (layer, channel) in names.iter().filter_map(|name| name.rsplit_once('.')) {
        layers.entry(layer).or_default().push(channel);
    }
    for (layer, channels) in &layers {
        let is_known = channels.len() == 1 || [&["A", "B", "G", "R"][..], &["X", "Y", "Z"]].contains(&&channels[..]);
        assert!(is_known, "{layer}: {channels:?}");
    }
    assert_eq!(layers.into_keys().collect::<Vec<_>>(), ["N", "count", "depth", "mesh", "splats"]);
}

/// Depths, normals and counts of a tilted opaque plane, z = 4 + x, behind a splat at depth 2, seen from the origin
/// along z.
#[test]
fn layers_hold_depths_normals_and_counts() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let splats = Splats::new(
        vec![Vec3::new(-0.25, 0.0, 2.0)],
        vec![Quat::IDENTITY],
        vec![Vec3::splat(0.1_f32.ln())],
        vec![2.0],
        0,
        vec![[0.5; 3]],
    );
    let corners = [(-2.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-2.0, 1.0)].map(|(x, y)| Vec3::new(x, y, 4.0 + x));
    let atlas = Atlas::new(Texture::new(1, 1, 4, vec![0.5, 0.5, 0.5, 6.0]).unwrap(), None).unwrap();
    let uvs = vec![[Vec2::ZERO, Vec2::X, Vec2::Y]; 2];
    let mesh = Mesh::new(corners.to_vec(), vec![[0, 1, 2], [0, 2, 3]], uvs, atlas).unwrap();
    let scene = HybridScene { splats: splats.unwrap(), meshes: vec![mesh], composition: Composition::default() };
    write_scene(&at("s.glb"), &scene, &WriteOptions::default()).unwrap();
    let pose = "[[1,0,0,0],[0,-1,0,0],[0,0,-1,0],[0,0,0,1]]";
    let frame = format!(r#"{{"file_path":"a.png","transform_matrix":{pose}}}"#);
    let lens = r#""fl_x":33,"fl_y":33,"cx":16.5,"cy":16.5,"w":33,"h":33"#;
    std::fs::write(at("c.json"), format!("{{{lens},\"frames\":[{frame}]}}")).unwrap();
    for (kind, is_half) in [("float", false), ("half", true)] {
        let render = ["render", "s.glb", "--cameras", "c.json", "--exr-layers", "--exr-type", kind, "-o", kind];
        run(folder.path(), &render);
        let image = exr::prelude::read_first_flat_layer_from_file(at(kind).join("a.exr")).unwrap();
        let list = image.layer_data.channel_data.list;
        let channel = |name: &str| list.iter().find(|channel| channel.name.eq(name)).unwrap();
        let values = |name: &str| -> Vec<f32> { channel(name).sample_data.values_as_f32().collect() };
        let is_f16 = |name: &str| matches!(channel(name).sample_data, exr::prelude::FlatSamples::F16(_));
        assert_eq!([is_f16("R"), is_f16("Z"), is_f16("count.splats")], [is_half, false, false]);
        let [splat, plane, mean, first] = ["splats.A", "mesh.A", "Z", "depth.first"].map(values);
        let [count, x, y, z] = ["count.splats", "N.X", "N.Y", "N.Z"].map(values);
        let (mut before, mut bare) = (0, 0);
        for i in 0..33 * 33 {
            let depth = 4.0 / (1.0 - ((i % 33) as f32 - 16.0) / 33.0);
            assert_eq!(count[i], f32::from(splat[i] > 0.0), "{i}");
            let weight = splat[i] + plane[i];
            let [expected_mean, expected_first] = match (weight > 0.0, weight > 0.5, splat[i] > 0.5) {
                (false, ..) => [1e10; 2],
                (_, false, _) => [2.0, 1e10],
                (_, _, is_before) => {
                    [(2.0 * splat[i] + depth * plane[i]) / weight, if is_before { 2.0 } else { depth }]
                }
            };
            for (found, expected) in [(mean[i], expected_mean), (first[i], expected_first)] {
                assert!((found / expected - 1.0).abs() < 2e-3, "{kind} {i}: {found}, not {expected}");
            }
            let slant = if plane[i] > 0.0 { 0.5_f32.sqrt() } else { 0.0 };
            let off = [x[i] - slant, y[i], z[i] + slant].map(f32::abs);
            assert!(off.iter().all(|off| *off < 1e-3), "{kind} {i}: {off:?}");
            before += usize::from(splat[i] > 0.5);
            bare += usize::from(weight == 0.0);
        }
        assert!(before > 3 && bare > 100, "{before} {bare}");
    }
}

/// Foreign glTF and USD are y up, cameras of a capture are not: however they are combined, pictures and normals are
/// those of the converted scene.
#[test]
fn scenes_that_are_y_up_are_seen_by_captures_as_their_conversion_is() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    write_capture(&at("capture"), 3, (32, 24));
    // A tilted triangle, larger than the cameras' view.
    let layer = "#usda 1.0\n( metersPerUnit = 1\n upAxis = \"Y\" )\ndef Mesh \"m\" {\n point3f[] points = [(-9, -9, 2), (9, -9, 0), (-1, 9, -3)]\n \
                 int[] faceVertexCounts = [3]\n int[] faceVertexIndices = [0, 1, 2]\n uniform token subdivisionScheme = \"none\"\n \
                 color3f[] primvars:displayColor = [(0.2, 0.4, 0.6)]\n}\n";
    std::fs::write(at("theirs.usda"), layer).unwrap();
    run(folder.path(), &["convert", "theirs.usda", "ours.glb"]);
    let layers = |scene: &str, out: &str| {
        let said = run(folder.path(), &["render", scene, "--cameras", "capture", "--exr-layers", "-o", out]);
        let mut files: Vec<_> = std::fs::read_dir(at(out)).unwrap().map(|e| e.unwrap().path()).collect();
        files.sort();
        let channels = |path: &std::path::PathBuf| {
            let image = exr::prelude::read_first_flat_layer_from_file(path).unwrap();
            let list = image.layer_data.channel_data.list;
            list.into_iter()
                .map(|c| (c.name.to_string(), c.sample_data.values_as_f32().collect::<Vec<f32>>()))
                .collect()
        };
        let files: Vec<Vec<(String, Vec<f32>)>> = files.iter().map(channels).collect();
        (said, files)
    };
    let ((said, theirs), (quiet, ours)) = (layers("theirs.usda", "a"), layers("ours.glb", "b"));
    let note = "note: capture: cameras taken to be y down, as in captures: rotated by 180° about x, because theirs.usda is y up\n";
    assert!(said.contains(note) && !quiet.contains("180° about x"), "{said} {quiet}");
    let mut seen = false;
    for (a, b) in theirs.iter().flatten().zip(ours.iter().flatten()) {
        assert_eq!(a.0, b.0);
        seen |= a.0 == "N.Z" && a.1.iter().any(|z| *z != 0.0);
        assert!(a.1.iter().zip(&b.1).all(|(x, y)| (x - y).abs() < 1e-4 * (1.0 + x.abs())), "{}", a.0);
    }
    assert!(seen && theirs.len() == 3);
}
