//! Instances of meshes and splats at one node.

use glam::Vec3;
use serde_json::{Value, json};

use super::core_tests::{Builder, near, triangle};
use super::extension::{HYBRID, INSTANCING, KHR_SPLATS};
use super::remainder::remainder;
use super::splat_tests::{khr, splat_document, splats};
use super::*;
use crate::format::{WriteOptions, mesh_import, read_file, read_scene, validate, write_scene};

fn copied(attributes: &Value) -> Value {
    json!({ INSTANCING: { "attributes": attributes } })
}

/// Three instances of a triangle at a node that shifts and doubles: shifted; rotated and stretched; mirrored.
fn three() -> (Builder, Value) {
    let (mut b, attributes) = triangle();
    let copies = copied(&json!({
        "TRANSLATION": b.floats(&[[1.0f32, 0.0, 0.0], [0.0, 0.0, 3.0], [0.0; 3]]),
        "ROTATION": b.normalized(5120, "VEC4", 3, &[0, 0, 0, 127, 0, 0, 90, 90, 0, 0, 0, 127]),
        "SCALE": b.floats(&[[1.0f32; 3], [3.0, 1.0, 1.0], [-1.0, 1.0, 1.0]]),
    }));
    let document = json!({
        "meshes": [{ "primitives": [{ "attributes": attributes }] }],
        "nodes": [{ "mesh": 0, "translation": [10, 0, 0], "scale": [2, 2, 2], "extensions": copies }],
        "extensionsUsed": [INSTANCING], "extensionsRequired": [INSTANCING],
    });
    (b, document)
}

const PLACED: [[f32; 3]; 9] = [
    [12.0, 0.0, 0.0],
    [14.0, 0.0, 0.0],
    [12.0, 2.0, 0.0],
    [10.0, 0.0, 6.0],
    [10.0, 6.0, 6.0],
    [8.0, 0.0, 6.0],
    [10.0, 0.0, 0.0],
    [8.0, 0.0, 0.0],
    [10.0, 2.0, 0.0],
];

#[test]
fn copies_are_below_their_node() {
    let (b, document) = three();
    let file = b.read(document.clone()).unwrap();
    assert!(!file.notes.iter().any(|note| note.contains(INSTANCING)), "{:?}", file.notes);
    let [mesh] = &file.scene.meshes[..] else { panic!("one mesh") };
    near(bytemuck::cast_slice(mesh.positions()), PLACED.as_flattened(), 1e-5);
    assert_eq!(mesh.triangles(), [[0, 1, 2], [3, 4, 5], [6, 8, 7]], "a mirrored front stays a front");

    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.gltf");
    std::fs::write(&path, b.file(&document)).unwrap();
    let imported = mesh_import::read(&path).unwrap();
    let corners: Vec<Vec3> = imported.triangles.iter().flatten().map(|&v| imported.positions[v as usize]).collect();
    let expected = [0, 1, 2, 3, 4, 5, 6, 8, 7].map(|v: usize| PLACED[v]);
    near(bytemuck::cast_slice(&corners), expected.as_flattened(), 1e-5);
    assert_eq!((imported.corner_uvs.as_ref().map(Vec::len), imported.notes.len()), (Some(3), 0));

    // The declared bounding box is from 0 to 1 along all axes.
    let asset = Asset::open(&path).unwrap();
    let [low, high] = describe(&asset).map_err(|_| ()).unwrap().nodes[0].bounds.unwrap();
    near(&[low[0] as f32, high[0] as f32], &[8.0, 14.0], 1e-5);
    let findings = validate(&path).unwrap().findings;
    assert!(!findings.iter().any(|finding| finding.to_string().contains(INSTANCING)), "{findings:?}");
}

/// Vertex colours become a map in which the corners of a mirrored triangle are swapped too.
#[test]
fn copies_with_colours_of_vertices_are_one_mesh() {
    let (mut b, mut document) = three();
    let colors = b.floats(&[[1.0f32, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]);
    document["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"] = json!(colors);
    let file = b.read(document).unwrap();
    let [mesh] = &file.scene.meshes[..] else { panic!("{} meshes", file.scene.meshes.len()) };
    near(bytemuck::cast_slice(mesh.positions()), PLACED.as_flattened(), 1e-5);
    let [first, second, third] = mesh.corner_uvs() else { panic!("three triangles") };
    assert_eq!((first, [third[0], third[2], third[1]]), (second, *first));
    assert_eq!(mesh.triangles()[2], [6, 8, 7]);
    assert_eq!(file.scene.composition.layers, 1, "opaque colours hide what is behind");
}

#[test]
fn copies_are_written_once_in_either_way() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let (b, document) = three();
    std::fs::write(at("a.gltf"), b.file(&document)).unwrap();
    let file = read_file(&at("a.gltf"), &ReadOptions { keep_document: true, ..ReadOptions::default() }).unwrap();
    let source = file.source.as_ref().unwrap();
    assert!(source.remainder().is_empty(), "{:?}", source.remainder());
    let options = WriteOptions { source: Some(source), ..WriteOptions::default() };
    assert!(write_scene(&at("same.gltf"), &file.scene, &options).unwrap().loss.is_none());
    let same = Asset::open(&at("same.gltf")).unwrap();
    assert_eq!(same.root["nodes"], document["nodes"]);
    assert_eq!(read_scene(&at("same.gltf")).unwrap(), file.scene);
    write_scene(&at("anew.glb"), &file.scene, &WriteOptions::default()).unwrap();
    let anew = read_scene(&at("anew.glb")).unwrap();
    assert_eq!(anew.meshes[0].triangles(), file.scene.meshes[0].triangles());
}

#[test]
fn splats_are_copied_and_those_of_no_extent_left_out() {
    let (mut b, attributes) = splats(false);
    let copies = copied(&json!({
        "TRANSLATION": b.floats(&[[0.0f32; 3], [5.0, 0.0, 0.0], [9.0, 9.0, 9.0], [9.0, 9.0, 9.0]]),
        "SCALE": b.floats(&[[1.0f32; 3], [2.0; 3], [0.0; 3], [1.0, 0.0, 1.0]]),
    }));
    let mut document = splat_document(&attributes, khr());
    document["nodes"] = json!([{ "mesh": 0, "extensions": copies }]);
    let file = b.read(document).unwrap();
    assert_eq!(file.notes, ["/nodes/0: splats under a flat transform are not drawn"]);
    let found = file.scene.splats;
    let expected = [[0.0, 0.0, 0.0], [1.0, 2.0, 3.0], [5.0, 0.0, 0.0], [7.0, 4.0, 6.0]];
    near(bytemuck::cast_slice(found.means()), expected.as_flattened(), 1e-6);
    near(&[found.log_scales()[2].x.exp()], &[2.0], 1e-6);
}

#[test]
fn copies_move_with_their_node() {
    let (mut b, attributes) = triangle();
    let copies = copied(&json!({ "TRANSLATION": b.floats(&[[0.0f32; 3], [0.0, 0.0, 5.0]]) }));
    let (times, places) = (b.floats(&[[0.0f32], [1.0]]), b.floats(&[[0.0f32; 3], [2.0, 0.0, 0.0]]));
    let document = json!({
        "meshes": [{ "primitives": [{ "attributes": attributes }] }],
        "nodes": [{ "mesh": 0, "extensions": copies }],
        "animations": [{
            "samplers": [{ "input": times, "output": places }],
            "channels": [{ "sampler": 0, "target": { "node": 0, "path": "translation" } }],
        }],
    });
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.gltf");
    std::fs::write(&path, b.file(&document)).unwrap();
    let (rest, source) = read_as_stored(&path, &ReadOptions::default()).unwrap();
    let posed = read_as_stored(&path, &ReadOptions { time: Some(1.0), ..ReadOptions::default() }).unwrap().0.scene;
    assert_eq!(source.at(&rest.scene, 1.0).unwrap(), posed);
    let first = |scene: &HybridScene| scene.meshes.iter().map(|mesh| mesh.positions()[0]).collect::<Vec<_>>();
    assert_eq!(first(&rest.scene), [Vec3::ZERO, Vec3::new(0.0, 0.0, 5.0)]);
    assert_eq!(first(&posed), [Vec3::new(2.0, 0.0, 0.0), Vec3::new(2.0, 0.0, 5.0)]);
}

#[test]
fn of_what_has_a_skin_one_copy_is_shown() {
    let (mut b, mut attributes) = triangle();
    b.skinned(&mut attributes, [[0; 4]; 3], [[1.0, 0.0, 0.0, 0.0]; 3]);
    let copies = copied(&json!({ "TRANSLATION": b.floats(&[[0.0f32; 3], [0.0, 0.0, 5.0]]) }));
    let document = json!({
        "meshes": [{ "primitives": [{ "attributes": attributes }] }], "skins": [{ "joints": [1] }],
        "nodes": [{ "mesh": 0, "skin": 0, "children": [1], "extensions": copies }, {}],
        "extensionsUsed": [INSTANCING],
    });
    let file = b.read(document.clone()).unwrap();
    let said = format!("/nodes/0: only one instance of {INSTANCING} is shown, at the node itself: it has a skin");
    assert!(file.notes.contains(&said) && file.scene.meshes[0].triangles().len() == 1, "{:?}", file.notes);
    let lost: Vec<String> = remainder(&document, false).into_iter().map(|part| part.what).collect();
    assert!(lost.contains(&format!("the extension {INSTANCING}")), "{lost:?}");
}

#[test]
fn copies_with_bound_splats_are_in_a_scene_in_part() {
    let document = |bound: usize| {
        let binding = json!({ HYBRID: { "binding": { "node": bound } } });
        json!({
            "meshes": [{ "primitives": [{}] }, { "primitives": [{ "extensions": { KHR_SPLATS: { "extensions": binding } } }] }],
            "nodes": [{ "mesh": 0, "extensions": copied(&json!({ "TRANSLATION": 0 })) }, { "mesh": 0 }, { "mesh": 1 }],
        })
    };
    assert_eq!([0, 1].map(|bound| instancing::is_in_part(&document(bound))), [true, false]);
    let mut own = document(1);
    own["nodes"][2]["extensions"] = copied(&json!({ "TRANSLATION": 0 }));
    assert!(instancing::is_in_part(&own));
    let mut labelled = document(1);
    labelled["nodes"][0]["extensions"] = copied(&json!({ "TRANSLATION": 0, "_ID": 1 }));
    assert!(instancing::is_in_part(&labelled));
}

#[test]
fn copies_that_cannot_be_read_are_refused_in_one_line() {
    let (mut b, attributes) = triangle();
    let two = b.floats(&[[1.0f32; 3]; 2]);
    let three = b.floats(&[[1.0f32; 3]; 3]);
    let broken = b.floats(&[[f32::NAN; 3]; 2]);
    b.accessors.push(json!({ "componentType": 5126, "type": "VEC3", "count": 20_000_000 }));
    let many = b.accessors.len() - 1;
    for (copies, fault) in [
        (
            json!({ "SCALE": two, "TRANSLATION": three }),
            "/attributes/TRANSLATION: expected 2 elements, as in SCALE, found 3",
        ),
        (json!({ "SCALE": 99 }), "/attributes/SCALE: expected an accessor below 6, found 99"),
        (json!({ "ROTATION": two }), "/type: expected 4 component(s), found Vec3"),
        (json!({ "SCALE": broken }), "/attributes: expected finite numbers, found others in copy 0"),
        (json!({ "SCALE": "x" }), "/attributes/SCALE: expected an object of EXT_mesh_gpu_instancing, found "),
        (json!({ "TRANSLATION": many }), "bytes of arrays from a file of this size, found more, by repeated use"),
    ] {
        let read = b.read(json!({
            "meshes": [{ "primitives": [{ "attributes": attributes }] }],
            "nodes": [{ "mesh": 0, "extensions": copied(&copies) }],
        }));
        let message = read.map(|file| file.scene).unwrap_err();
        assert!(message.contains(fault) && !message.contains('\n'), "{message}");
    }
}
