//! Cameras that are left out of a document, with the nodes that only placed them and what animates either.

use serde_json::{Value, json};

use super::extension::{ANIMATION_POINTER, EXTRAS, HYBRID, KHR_SPLATS};
use super::source::remove_cameras;
use super::source_tests::{KEEP, opened, rich};
use super::*;
use crate::format::cameras::CameraFile;
use crate::format::test_scenes::{camera, random_scene};
use crate::format::{WriteOptions, read_file, write_scene};

#[test]
fn what_animates_cameras_goes_with_them() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let (b, mut document) = rich();
    let pointer = json!({ "KHR_animation_pointer": { "pointer": "/cameras/0/perspective/yfov" } });
    document["animations"][0]["channels"][0]["target"]["extensions"] = pointer;
    let mut alone = document["animations"][0].clone();
    alone["channels"].as_array_mut().unwrap().truncate(1);
    let other = document["animations"][0]["channels"][1].clone();
    document["animations"].as_array_mut().unwrap().push(alone);
    document["extensionsUsed"] = json!(["EXT_unknown", "KHR_animation_pointer"]);
    std::fs::write(at("in.gltf"), b.file(&document)).unwrap();
    let file = read_file(&at("in.gltf"), &KEEP).unwrap();
    for (cameras, expected) in [
        (&file.cameras[..], &[][..]),
        (&[], &["/animations: 2 channels of KHR_animation_pointer left out with the cameras animated by it"]),
    ] {
        let options = WriteOptions { cameras, source: file.source.as_ref(), ..WriteOptions::default() };
        let report = write_scene(&at("out.glb"), &file.scene, &options).unwrap();
        assert!(report.loss.is_none(), "{}", report.loss);
        assert_eq!(report.notes, expected);
    }
    let (json, _) = opened(&at("out.glb"));
    let animations = json["animations"].as_array().unwrap();
    assert_eq!((animations.len(), &animations[0]["channels"]), (1, &json!([other])));
    assert_eq!(json["extensionsUsed"], json!(["EXT_unknown"]));
}

/// Nodes that others refer to stay. What refers to nodes follows them, unless there may be more that does.
#[test]
fn nodes_that_only_placed_cameras_go_with_them() {
    let place = || json!({ "name": "view", "translation": [1, 2, 3] });
    let with = |mut node: Value, key: &str, value: Value| {
        node[key] = value;
        node
    };
    let camera = || with(place(), "camera", json!(0));
    let of_path = with(camera(), "extras", json!({ EXTRAS: { "path": true } }));
    let moves = |node: u64, path: &str| json!({ "sampler": 0, "target": { "node": node, "path": path } });
    let points = |pointer: &str| {
        let extensions = json!({ ANIMATION_POINTER: { "pointer": pointer } });
        json!({ "sampler": 0, "target": { "path": "pointer", "extensions": extensions } })
    };
    let bound = |node: u64| {
        let binding = json!({ HYBRID: { "binding": { "node": node } } });
        json!([{ "primitives": [{ "extensions": { KHR_SPLATS: { "extensions": binding } } }] }])
    };
    let document = |extension: &str| {
        json!({
            "extensionsUsed": [ANIMATION_POINTER, HYBRID, KHR_SPLATS, extension],
            "scenes": [{ "nodes": [0, 1, 2, 3, 8, 9] }],
            "nodes": [
                camera(), { "children": [4, 5, 6], "name": "rig" }, of_path, with(camera(), "extras", json!(1)), camera(),
                camera(), camera(), camera(), { "mesh": 0, "skin": 0 }, of_path,
            ],
            "cameras": [{ "type": "perspective", "perspective": { "yfov": 1, "znear": 1 } }],
            "meshes": bound(8),
            "skins": [{ "joints": [2, 1], "skeleton": 1 }],
            "animations": [
                { "name": "view", "samplers": [{}], "channels": [moves(4, "scale"), moves(9, "translation")] },
                { "samplers": [{}], "channels": [
                    moves(5, "rotation"), moves(8, "rotation"), points("/nodes/6/rotation"), points("/nodes/8/weights/0"),
                    points("/cameras/0/perspective/yfov"),
                ] },
            ],
        })
    };
    for (extension, [rig, joint, held, pointed, mesh], nodes) in
        [("KHR_materials_unlit", [0, 1, 2, 3, 4], 5), ("EXT_unknown", [1, 2, 3, 6, 8], 10)]
    {
        let mut root = document(extension);
        remove_cameras(&mut root);
        let mut expected = vec![json!({}); nodes];
        for (at, node) in [
            (rig, json!({ "children": [pointed], "name": "rig" })),
            (joint, place()),
            (held, with(place(), "extras", json!(1))),
            (pointed, place()),
            (mesh, json!({ "mesh": 0, "skin": 0 })),
        ] {
            expected[at] = node;
        }
        let channels = json!([
            moves(mesh as u64, "rotation"),
            points(&format!("/nodes/{pointed}/rotation")),
            points(&format!("/nodes/{mesh}/weights/0")),
        ]);
        let expected = json!({
            "extensionsUsed": [ANIMATION_POINTER, HYBRID, KHR_SPLATS, extension],
            "scenes": [{ "nodes": [rig, joint, held, mesh] }],
            "nodes": expected,
            "meshes": bound(mesh as u64),
            "skins": [{ "joints": [joint, rig], "skeleton": rig }],
            "animations": [{ "samplers": [{}], "channels": channels }],
        });
        assert_eq!(root, expected, "{extension}");
    }
    let mut alone = json!({ "scenes": [{ "nodes": [0] }], "nodes": [camera()], "cameras": [{}] });
    remove_cameras(&mut alone);
    assert_eq!(alone, json!({ "scenes": [{}] }));
}

/// In files of Centaur, the root comes after the cameras, and a path after the root.
#[test]
fn without_cameras_a_file_of_ours_is_as_if_it_never_had_any() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let scene = random_scene(4, 1, 1, 4);
    let cameras = ["a", "b"].map(|name| (name.to_owned(), camera()));
    write_glb(&at("bare.glb"), &scene, &[], None).unwrap();
    write_glb(&at("views.glb"), &scene, &cameras, None).unwrap();
    let path = CameraFile { cameras: cameras.to_vec(), fps: Some(9.0), ..CameraFile::default() };
    write_with_cameras(&at("path.glb"), &at("views.glb"), &path).unwrap();
    assert!(opened(&at("path.glb")).0.get("animations").is_some());
    let (bare, _) = opened(&at("bare.glb"));
    for name in ["views.glb", "path.glb"] {
        let file = read_file(&at(name), &KEEP).unwrap();
        let options = WriteOptions { source: file.source.as_ref(), ..WriteOptions::default() };
        let report = write_scene(&at("out.glb"), &file.scene, &options).unwrap();
        assert!(report.loss.is_none() && report.notes.is_empty(), "{name}: {}, {:?}", report.loss, report.notes);
        let (left, _) = opened(&at("out.glb"));
        for key in ["nodes", "scenes", "cameras", "animations", "extensionsUsed"] {
            assert_eq!(left.get(key), bare.get(key), "{name}: {key}");
        }
    }
}
