//! Cameras in files of scenes: paths added to a scene, and scenes without any.

use serde_json::json;

use super::{largest_difference, read, shot};
use crate::format::cameras::{CameraFile, NAME, Sampling};
use crate::format::test_scenes::{camera, random_scene};
use crate::format::{
    ReadOptions, WriteOptions, read_cameras, read_file, validate, write_cameras_with_scene, write_scene,
};

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
        let file = CameraFile { cameras: shot(7, 0.0), fps: Some(25.0), y_up, ..CameraFile::default() };
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
        let file = CameraFile { cameras: shot(1, 0.0), ..CameraFile::default() };
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
    let file = CameraFile { cameras: shot(5, 0.0), fps: Some(9.0), ..CameraFile::default() };
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
