//! Animated scenes as a user meets them: inspected, converted at a point in time, rendered in motion.

use std::path::Path;

use crate::common::{self, stderr};
use centaur::format::{ReadOptions, read_file, read_scene};
use glam::Vec3;
use serde_json::{Value, json};

/// Writes a triangle that slides by 2 along x in a second, at a node that has a duplicate, and a resting camera.
fn write_slide(folder: &Path) {
    let positions: [f32; 9] = [-1.0, -1.0, -4.0, 1.0, -1.0, -4.0, 0.0, 1.0, -4.0];
    let (times, slide): ([f32; 2], [f32; 6]) = ([0.0, 1.0], [0.0, 0.0, 0.0, 2.0, 0.0, 0.0]);
    let bytes: Vec<u8> = positions.iter().chain(&times).chain(&slide).flat_map(|v| v.to_le_bytes()).collect();
    std::fs::write(folder.join("a.bin"), &bytes).unwrap();
    let view = |offset: usize, length: usize| json!({ "buffer": 0, "byteOffset": offset, "byteLength": length });
    let accessor = |view: usize, kind: &str, count: usize| json!({ "bufferView": view, "componentType": 5126, "type": kind, "count": count, "min": [-1, -1, -4], "max": [2, 1, 0] });
    let optics = json!({ "width": 32, "height": 24, "fx": 30, "fy": 30, "cx": 16, "cy": 12 });
    let document = json!({
        "asset": { "version": "2.0" }, "scene": 0, "scenes": [{ "nodes": [0, 1] }],
        "nodes": [{ "mesh": 0 }, { "name": "front", "camera": 0 }],
        "meshes": [{ "primitives": [{ "attributes": { "POSITION": 0 }, "material": 0 }] }],
        "materials": [{ "doubleSided": true, "extensions": { "KHR_materials_unlit": {} } }],
        "cameras": [{ "type": "perspective", "perspective": { "yfov": 0.761_012_75, "aspectRatio": 1.333_333_3, "znear": 0.1 } }],
        "animations": [{
            "name": "slide", "samplers": [{ "input": 1, "output": 2 }],
            "channels": [{ "sampler": 0, "target": { "node": 0, "path": "translation" } }],
        }],
        "extensionsUsed": ["KHR_materials_unlit"],
        "accessors": [accessor(0, "VEC3", 3), accessor(1, "SCALAR", 2), accessor(2, "VEC3", 2)],
        "bufferViews": [view(0, 36), view(36, 8), view(44, 24)],
        "buffers": [{ "byteLength": bytes.len(), "uri": "a.bin" }],
    });
    let mut document = document;
    document["accessors"][1]["min"] = json!([0]);
    document["accessors"][1]["max"] = json!([1]);
    let pose = json!({ "rotation": [1, 0, 0, 0, -1, 0, 0, 0, -1], "translation": [0, 0, 0] });
    let mut extras = optics;
    extras.as_object_mut().unwrap().extend(pose.as_object().unwrap().clone());
    document["cameras"][0]["extras"] = json!({ "centaur": extras });
    std::fs::write(folder.join("a.gltf"), document.to_string()).unwrap();
}

fn run(folder: &Path, args: &str) -> String {
    let output = common::centaur(folder).args(args.split(' ')).output().unwrap();
    assert_eq!(output.status.code(), Some(0), "{args}: {}", stderr(&output));
    common::said(&output)
}

fn failure(folder: &Path, args: &str) -> String {
    common::failure(folder, common::centaur(folder).args(args.split(' ')))
}

fn as_json(folder: &Path, args: &str) -> Value {
    serde_json::from_str(run(folder, &format!("{args} --json")).lines().next().unwrap()).unwrap()
}

#[test]
fn animations_are_named_with_their_lengths() {
    let folder = tempfile::tempdir().unwrap();
    write_slide(folder.path());
    assert!(run(folder.path(), "inspect a.gltf").contains("├ animation: slide, 1.000 s, 1 channels"));
    let clip = &as_json(folder.path(), "inspect a.gltf")["document"]["animations"][0];
    assert_eq!(*clip, json!({ "name": "slide", "range": [0.0, 1.0], "channels": 1 }));
}

#[test]
fn a_pose_is_baked_and_what_moved_it_is_named() {
    let folder = tempfile::tempdir().unwrap();
    write_slide(folder.path());
    assert!(run(folder.path(), "convert a.gltf posed.glb --time 0.75 --strict").starts_with("lost: nothing"));
    let posed = read_file(&folder.path().join("posed.glb"), &ReadOptions::default()).unwrap();
    // y down, where it was y up.
    assert_eq!(posed.scene.meshes[0].positions()[2], Vec3::new(1.5, -1.0, 4.0));
    assert!(posed.source.unwrap().clips().is_empty());
    // The unchanged document has lost nothing.
    assert_eq!(as_json(folder.path(), "convert a.gltf whole.glb --strict")["lossless"], true);
    let whole = read_file(&folder.path().join("whole.glb"), &ReadOptions::default()).unwrap();
    assert!(whole.source.unwrap().moves());

    // Mitsuba holds one pose; Blender is animated.
    let lost = as_json(folder.path(), "convert a.gltf a.xml")["loss"]["document"].clone();
    assert_eq!(lost, json!(["1 animation"]));
    assert_eq!(
        failure(folder.path(), "convert a.gltf a.xml --strict"),
        "error: a.xml: --strict: a .xml would lose 1 animation"
    );
    let outcome = as_json(folder.path(), "convert a.gltf a.blend.py --strict");
    assert!(outcome["beside"].as_array().unwrap().contains(&json!("a_motion.npz")), "{outcome}");
    let script = std::fs::read_to_string(folder.path().join("a.blend.py")).unwrap();
    assert!(script.contains(r#""frames":31"#) && script.contains(r#""meshes":[0]"#));
    let arrays = std::fs::read(folder.path().join("a_motion.npz")).unwrap();
    assert!(arrays.starts_with(b"PK"));
    // Transformed as a whole it stays animated.
    let outcome = as_json(folder.path(), "convert a.gltf b.blend.py --scale 2 --rotate 10,20,30");
    assert!(outcome["loss"]["document"].as_array().unwrap().is_empty(), "{outcome}");
    assert!(folder.path().join("b_motion.npz").exists());
    // After other changes it is at rest and says so; a requested point in time is at rest without a loss.
    for (name, how, lost) in [("c", "--axes gltf:unity", json!(["1 animation"])), ("d", "--time 0.5", json!([]))] {
        let outcome = as_json(folder.path(), &format!("convert a.gltf {name}.blend.py {how}"));
        assert_eq!(outcome["loss"]["document"], lost, "{how}");
        assert!(!folder.path().join(format!("{name}_motion.npz")).exists());
    }
}

/// The file's world is y up, unlike any of Centaur's.
#[test]
fn cameras_of_others_stay_where_they_are_in_every_format() {
    let folder = tempfile::tempdir().unwrap();
    write_slide(folder.path());
    let picture = |cameras: &str, out: &str| {
        run(folder.path(), &format!("render a.gltf --cameras {cameras} -o {out}"));
        let mut files = std::fs::read_dir(folder.path().join(out)).unwrap();
        image::open(files.next().unwrap().unwrap().path()).unwrap().into_rgb8()
    };
    let expected = picture("embedded", "own");
    assert!(expected.pixels().any(|p| p.0 != expected.get_pixel(0, 0).0), "nothing is seen");
    for (from, to) in [("a.gltf", "p.json"), ("p.json", "p.glb"), ("p.glb", "q.json"), ("q.json", "q.usda")] {
        run(folder.path(), &format!("cameras convert {from} -o {to}"));
        assert!(picture(to, &format!("by-{to}")) == expected, "{to}");
    }
    let said = run(folder.path(), "cameras convert a.gltf -o model");
    assert!(
        said.contains("note: a.gltf: its world is y up: rotated by 180° about x into the frame of captures"),
        "{said}"
    );
    assert!(picture("model", "by-model") == expected);
}

#[test]
fn animations_are_chosen_by_name() {
    let folder = tempfile::tempdir().unwrap();
    write_slide(folder.path());
    let text = std::fs::read_to_string(folder.path().join("a.gltf")).unwrap();
    let mut document: Value = serde_json::from_str(&text).unwrap();
    // A further animation moves the same node up by 4.
    let rise: Vec<u8> = [0.0_f32, 0.0, 0.0, 0.0, 4.0, 0.0].iter().flat_map(|v| v.to_le_bytes()).collect();
    std::fs::write(folder.path().join("rise.bin"), &rise).unwrap();
    let mut add = |list: &str, what: Value| document[list].as_array_mut().unwrap().push(what);
    add("buffers", json!({ "byteLength": rise.len(), "uri": "rise.bin" }));
    add("bufferViews", json!({ "buffer": 1, "byteLength": rise.len() }));
    add("accessors", json!({ "bufferView": 3, "componentType": 5126, "type": "VEC3", "count": 2 }));
    let channel = json!({ "sampler": 0, "target": { "node": 0, "path": "translation" } });
    add("animations", json!({ "name": "rise", "samplers": [{ "input": 1, "output": 3 }], "channels": [channel] }));
    std::fs::write(folder.path().join("b.gltf"), document.to_string()).unwrap();
    let first = |flags: &str| {
        let said = as_json(folder.path(), &format!("convert b.gltf posed.glb --time 1 {flags}"));
        let scene = read_scene(&folder.path().join("posed.glb")).unwrap();
        // Scenes are y-down.
        let moved = scene.meshes[0].positions()[0] - Vec3::new(-1.0, 1.0, 4.0);
        (moved, said["inputs"][0]["notes"].to_string())
    };
    for (flags, expected, note) in [
        ("--quiet", Vec3::new(2.0, 0.0, 0.0), "1 of 2 move something that an earlier one moves"),
        ("--animation slide", Vec3::new(2.0, 0.0, 0.0), "not selected and left out: 1"),
        ("--animation rise", Vec3::new(0.0, -4.0, 0.0), "not selected and left out: 1"),
        ("--animation 1", Vec3::new(0.0, -4.0, 0.0), "not selected and left out: 1"),
        (
            "--animation rise --animation slide",
            Vec3::new(2.0, 0.0, 0.0),
            "1 of 2 move something that an earlier one moves",
        ),
    ] {
        let (moved, notes) = first(flags);
        assert!((moved - expected).length() < 1e-6 && notes.contains(note), "{flags}: {moved}, {notes}");
    }
    run(folder.path(), "render b.gltf --camera front --animation rise --time 0..1 --fps 2 -o up");
    run(folder.path(), "render a.gltf --camera front --time 0..1 --fps 2 -o along");
    let picture = |file: &str| image::open(folder.path().join(file)).unwrap().into_rgb8();
    assert!(picture("up/frame_00000.png") == picture("along/frame_00000.png"));
    assert!(picture("up/frame_00002.png") != picture("along/frame_00002.png"));
    let error = failure(folder.path(), "render b.gltf -o no --animation fall --time 1");
    assert_eq!(error, "error: b.gltf: /animations: expected one called fall, found slide, rise");
    for output in ["c.glb", "c.ply"] {
        let args = ["convert", "b.gltf", output, "--animation", "rise"];
        let error = common::wrong_usage(folder.path(), common::centaur(folder.path()).args(args));
        assert!(error.contains("only a .blend.py is animated by it") && error.contains("without --time"), "{error}");
    }
    // A note that one of two animations is ignored appears only if they are played, not at rest.
    for (flags, is_said) in [("--time 0..0.5 --fps 2", true), ("", false)] {
        let said = run(folder.path(), format!("render b.gltf --camera front -o said --quiet {flags}").trim_end());
        let note = "note: b.gltf: /animations: 1 of 2 move something that an earlier one moves: there the earlier one is played; --animation selects one\n";
        assert_eq!(said.contains(note), is_said, "{said}");
    }
    let said = run(folder.path(), "render b.gltf --camera front --animation rise -o rest --quiet");
    assert!(said.contains("--animation has no effect, and the scene is shown in its rest pose"), "{said}");
}

/// A frame rate applies to frames: photographs and other stills show an animated scene at rest.
#[test]
fn stills_have_no_time() {
    let folder = tempfile::tempdir().unwrap();
    write_slide(folder.path());
    common::write_capture(&folder.path().join("capture"), 9, (16, 12));
    let pictures = |out: &str, flags: &str| {
        let said = run(folder.path(), &format!("render a.gltf --cameras capture -o {out} --quiet{flags}"));
        let files = common::tree(&folder.path().join(out));
        (said, files.iter().map(|file| std::fs::read(file).unwrap()).collect::<Vec<_>>())
    };
    let ((_, rest), (said, film)) = (pictures("rest", ""), pictures("film", " --fps 4"));
    assert!(rest == film && rest.len() == 9);
    let note = "note: capture: its cameras are not frames of a path and have no times: --fps has no effect, and the scene is shown in its rest pose";
    assert!(said.contains(note), "{said}");
    // Motion would be visible, even though the first view does not see it.
    assert!(rest[1..] != pictures("moved", " --time 1").1[1..]);
    // A key at 0.75 s does not concern a still.
    let said = run(folder.path(), "cameras convert capture -o one.json --camera 003.png --fps 4");
    assert!(!said.contains("begins at"), "{said}");
}

/// A triangle that slides beyond the range of numbers.
#[test]
fn what_fails_late_leaves_no_empty_folder() {
    let folder = tempfile::tempdir().unwrap();
    write_slide(folder.path());
    let at = |name: &str| folder.path().join(name);
    let mut bytes = std::fs::read(at("a.bin")).unwrap();
    bytes[44 + 12..][..4].copy_from_slice(&3e38_f32.to_le_bytes());
    std::fs::write(at("a.bin"), bytes).unwrap();
    let mut document: Value = serde_json::from_slice(&std::fs::read(at("a.gltf")).unwrap()).unwrap();
    document["nodes"].as_array_mut().unwrap().push(json!({ "children": [0], "scale": [10, 10, 10] }));
    document["scenes"][0]["nodes"] = json!([2, 1]);
    std::fs::write(at("a.gltf"), document.to_string()).unwrap();
    let error = failure(folder.path(), "render a.gltf --time 1..1 -o frames");
    assert!(error.starts_with("error: a.gltf: ") && error.contains("finite"), "{error}");
}

/// Its picture takes a few kilobytes, its map a megabyte.
#[test]
fn what_becomes_large_says_why() {
    let folder = tempfile::tempdir().unwrap();
    write_slide(folder.path());
    let at = |name: &str| folder.path().join(name);
    image::RgbImage::from_fn(256, 256, |x, y| image::Rgb([x as u8, y as u8, 9])).save(at("t.png")).unwrap();
    let uv: Vec<u8> = [0.0_f32, 0.0, 1.0, 0.0, 0.0, 1.0].iter().flat_map(|v| v.to_le_bytes()).collect();
    std::fs::write(at("uv.bin"), &uv).unwrap();
    let mut document: Value = serde_json::from_slice(&std::fs::read(at("a.gltf")).unwrap()).unwrap();
    let mut add = |list: &str, what: Value| document[list].as_array_mut().unwrap().push(what);
    add("buffers", json!({ "byteLength": uv.len(), "uri": "uv.bin" }));
    add("bufferViews", json!({ "buffer": 1, "byteLength": uv.len() }));
    add("accessors", json!({ "bufferView": 3, "componentType": 5126, "type": "VEC2", "count": 3 }));
    document["meshes"][0]["primitives"][0]["attributes"]["TEXCOORD_0"] = json!(3);
    document["images"] = json!([{ "uri": "t.png" }]);
    document["textures"] = json!([{ "source": 0 }]);
    document["materials"][0]["pbrMetallicRoughness"] = json!({ "baseColorTexture": { "index": 0 } });
    std::fs::write(at("c.gltf"), document.to_string()).unwrap();
    let said = run(folder.path(), "convert c.gltf posed.glb --time 0.5");
    let why = " times as large as its source: images and splats that are compressed there are stored as floats\n";
    assert!(said.contains(why), "{said}");
    let said = run(folder.path(), "convert c.gltf whole.glb");
    assert!(!said.contains("as large as"), "{said}");
}

#[test]
fn what_is_malformed_keeps_still_in_blender_and_is_named() {
    let folder = tempfile::tempdir().unwrap();
    write_slide(folder.path());
    let text = std::fs::read_to_string(folder.path().join("a.gltf")).unwrap();
    let mut document: Value = serde_json::from_str(&text).unwrap();
    let turn = json!({ "sampler": 0, "target": { "node": 1, "path": "rotation" } });
    document["animations"][0]["channels"].as_array_mut().unwrap().push(turn);
    std::fs::write(folder.path().join("b.gltf"), document.to_string()).unwrap();
    let outcome = as_json(folder.path(), "convert b.gltf b.blend.py");
    assert_eq!(outcome["loss"]["document"], json!(["1 animation"]), "{outcome}");
    let notes = outcome["notes"].to_string();
    let expected = "nothing is animated, because an animation is malformed: /accessors/2/type: expected ";
    assert!(notes.contains(expected), "{notes}");
    assert!(!folder.path().join("b_motion.npz").exists());
}

#[test]
fn exact_exports_are_not_refused() {
    let folder = tempfile::tempdir().unwrap();
    write_slide(folder.path());
    run(folder.path(), "convert a.gltf posed.glb --time 0.5");
    for name in ["posed.xml", "posed.blend.py"] {
        assert!(run(folder.path(), &format!("convert posed.glb {name} --strict")).contains("lost: nothing"));
    }
}

#[test]
fn pictures_are_of_their_time() {
    let folder = tempfile::tempdir().unwrap();
    write_slide(folder.path());
    let read = |name: &str| std::fs::read(folder.path().join(name)).unwrap();
    let bright = |name: &str| {
        let picture = image::open(folder.path().join(name)).unwrap().into_luma8();
        let lit: Vec<u32> = picture.enumerate_pixels().filter(|(_, _, p)| p.0[0] > 128).map(|(x, ..)| x).collect();
        lit.iter().map(|x| f64::from(*x)).sum::<f64>() / lit.len() as f64
    };
    run(folder.path(), "render a.gltf -o rest --quiet");
    run(folder.path(), "render a.gltf -o at --time 0.5 --quiet");
    // fx is 30, and the triangle is 4 away and 1 further to the right.
    assert!((bright("at/front.png") - bright("rest/front.png") - 7.5).abs() < 0.6);
    run(folder.path(), "render a.gltf -o span --time 0..0.5 --fps 4 --quiet");
    assert_eq!(common::tree(&folder.path().join("span")).len(), 3);
    assert_eq!(bright("span/frame_00000.png"), bright("rest/front.png"));
    assert_eq!(bright("span/frame_00002.png"), bright("at/front.png"));
    let shorter = run(folder.path(), "render a.gltf -o span --time 0..0.25 --fps 4 --quiet");
    assert!(shorter.ends_with("note: span: 1 picture after frame_00001.png is of an earlier render\n"), "{shorter}");
    let one = run(folder.path(), "render a.gltf -o span --time 0 --quiet");
    assert!(!one.contains("note"), "{one}");
    // Beyond the last key nothing moves on.
    let beyond = "note: a.gltf: /animations: last from 0.000 to 1.000 s: outside, the scene is as at the nearer end\n";
    for (time, is_said) in [("5", true), ("0.5..1.5", true), ("1", false)] {
        let said = run(folder.path(), &format!("render a.gltf -o late --time {time} --fps 2 --quiet"));
        assert_eq!(said.contains(beyond), is_said, "{time}: {said}");
    }
    // A camera that slides along sees the triangle in the same place.
    let text = std::fs::read_to_string(folder.path().join("a.gltf")).unwrap();
    let mut document: Value = serde_json::from_str(&text).unwrap();
    let along = json!({ "sampler": 0, "target": { "node": 1, "path": "translation" } });
    document["animations"][0]["channels"].as_array_mut().unwrap().push(along);
    std::fs::write(folder.path().join("along.gltf"), document.to_string()).unwrap();
    run(folder.path(), "render along.gltf -o along --time 0.5 --quiet");
    assert_eq!(read("along/front.png"), read("rest/front.png"));
    // A camera path without a scene plays the scene at the times of its frames.
    run(folder.path(), "cameras orbit a.gltf -o path.json --frames 3 --fps 4 --focus 0,0,-4 --radius 4");
    run(folder.path(), "render a.gltf --cameras path.json -o moving --quiet");
    run(folder.path(), "render a.gltf --cameras path.json -o still --time 0 --quiet");
    let same = |frame: &str| {
        let read = |run: &str| std::fs::read(folder.path().join(run).join(frame)).unwrap();
        read("moving") == read("still")
    };
    assert!(same("frame_00000.png") && !same("frame_00002.png"));
    // A single frame of a path equals that frame in the whole path.
    run(folder.path(), "render a.gltf --cameras path.json --camera frame_00002.png -o one --quiet");
    let read = |run: &str| std::fs::read(folder.path().join(run).join("frame_00002.png")).unwrap();
    assert!(read("one") == read("moving"));
    let error = failure(folder.path(), "render a.gltf --cameras path.json -o no --time 0..1");
    assert!(error.contains("expected one still camera, found 3 frames of a moving one"), "{error}");
    // One of a capture keeps still, and so does a frame of a path.
    common::write_capture(&folder.path().join("capture"), 9, (16, 12));
    for (still, out) in
        [("capture --camera 003.png", "capture_span"), ("path.json --camera frame_00001.png", "path_span")]
    {
        run(folder.path(), &format!("render a.gltf --cameras {still} -o {out} --time 0..0.5 --fps 4 --quiet"));
        assert_eq!(common::tree(&folder.path().join(out)).len(), 3);
    }
    let error = failure(folder.path(), "render a.gltf -o no --time 0..2000");
    assert!(error.ends_with("expected at most 36000 frames, found 2000 s at 30 a second"), "{error}");
    run(folder.path(), "convert a.gltf still.glb --time 0");
    let error = failure(folder.path(), "render still.glb -o no --time 0..1");
    assert!(error.ends_with("--time START..END: expected an animated scene, found one without animation"), "{error}");
    let mut document: Value = serde_json::from_str(&text).unwrap();
    document["animations"][0]["channels"][0]["target"]["node"] = json!(1);
    std::fs::write(folder.path().join("view.gltf"), document.to_string()).unwrap();
    let error = failure(folder.path(), "render view.gltf -o no --time 0..1");
    assert!(error.ends_with("an animated scene, found one whose animations move cameras at most"), "{error}");
    let said = as_json(folder.path(), "render still.glb -o still --time 1")["notes"].to_string();
    assert!(said.contains("at 1 s the scene is in its rest pose"), "{said}");
    std::fs::write(folder.path().join("p.ply"), "ply\n").unwrap();
    let error = failure(folder.path(), "convert p.ply b.glb --time 1");
    assert!(
        error.contains("expected a .glb or .gltf, whose animations can be evaluated at a time, found PLY"),
        "{error}"
    );
}
