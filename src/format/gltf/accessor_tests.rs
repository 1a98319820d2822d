//! Accessors in every form that core glTF allows, and the buffers below them.

use std::path::PathBuf;

use glam::{Vec2, Vec3};
use serde_json::{Value, json};

use super::core_tests::{Builder, CORNERS, triangle};
use super::*;
use crate::format::{WriteOptions, read_file, write_scene};

#[test]
fn positions_in_every_component_type() {
    let cases: [(u32, bool, Vec<u8>, f32); 8] = [
        (5120, false, vec![0, 0, 0, 127, 0x80, 0], 127.0),
        (5120, true, vec![0, 0, 0, 127, 0x81, 0], 1.0),
        (5121, false, vec![0, 0, 0, 200, 0, 0], 200.0),
        (5121, true, vec![0, 0, 0, 255, 0, 0], 1.0),
        (5122, false, [0i16, 0, 0, 300, -300, 0].iter().flat_map(|v| v.to_le_bytes()).collect(), 300.0),
        (5122, true, [0i16, 0, 0, 32767, -32768, 0].iter().flat_map(|v| v.to_le_bytes()).collect(), 1.0),
        (5123, false, [0u16, 0, 0, 40000, 0, 0].iter().flat_map(|v| v.to_le_bytes()).collect(), 40000.0),
        (5123, true, [0u16, 0, 0, 65535, 0, 0].iter().flat_map(|v| v.to_le_bytes()).collect(), 1.0),
    ];
    for (component, normalized, bytes, x) in cases {
        let mut b = Builder::default();
        // The third vertex equals the first; elements of 3 or 6 bytes have strides of 4 or 8.
        let size = bytes.len() / 2;
        let row = |r: &[u8]| {
            let mut r = r.to_vec();
            r.resize(size.next_multiple_of(4), 0);
            r
        };
        let padded = [row(&bytes[..size]), row(&bytes[size..]), row(&bytes[..size])].concat();
        let position = b.accessor(component, "VEC3", 3, &padded);
        b.accessors[position]["normalized"] = json!(normalized);
        b.bounded(position);
        b.views[0]["byteStride"] = json!(size.next_multiple_of(4));
        let rest = json!({
            "meshes": [{ "primitives": [{ "attributes": { "POSITION": position } }] }],
            "extensionsUsed": ["KHR_mesh_quantization"], "extensionsRequired": ["KHR_mesh_quantization"],
        });
        let mesh = b.read(rest).unwrap().scene.meshes.remove(0);
        assert_eq!(mesh.positions()[1].x, x, "{component} {normalized}");
        assert!(mesh.positions()[1].y <= 0.0 && mesh.positions()[1].y >= -300.0);
        if component == 5122 && normalized {
            assert_eq!(mesh.positions()[1].y, -1.0, "both lowest values are −1");
        }
    }
}

#[test]
fn sparse_elements_with_and_without_a_base() {
    for based in [true, false] {
        let (mut b, attributes) = triangle();
        let (indices, values) = (b.view(&[1, 2]), b.view(bytemuck::cast_slice(&[[7.0f32, 8.0, 9.0], [4.0, 5.0, 6.0]])));
        let position = attributes["POSITION"].as_u64().unwrap() as usize;
        b.accessors[position]["sparse"] = json!({
            "count": 2, "indices": { "bufferView": indices, "componentType": 5121 }, "values": { "bufferView": values },
        });
        if !based {
            b.accessors[position].as_object_mut().unwrap().remove("bufferView");
        }
        let rest = |b: &Builder| b.read(json!({ "meshes": [{ "primitives": [{ "attributes": attributes }] }] }));
        let mesh = rest(&b).unwrap().scene.meshes.remove(0);
        assert_eq!(mesh.positions(), [Vec3::ZERO, Vec3::new(7.0, 8.0, 9.0), Vec3::new(4.0, 5.0, 6.0)]);
        // Counts beyond the data are reported before memory is reserved.
        b.accessors[position]["sparse"]["count"] = json!(4_000_000_000u32);
        assert!(rest(&b).unwrap_err().contains("/sparse/count: expected 4000000000 elements"), "{:?}", rest(&b).err());
        b.accessors[position]["sparse"]["count"] = json!(2);
        b.accessors[position]["count"] = json!(4_000_000_000u32);
        let message = rest(&b).unwrap_err();
        assert!(message.starts_with("f: /accessors/0") && message.contains("expected"), "{message}");
        b.accessors[position]["count"] = json!(2);
        assert!(rest(&b).unwrap_err().contains("/accessors/0/sparse: expected indices below 2, found 2"));
    }
}

#[test]
fn indices_may_be_sparse_or_not_stored() {
    let (mut b, attributes) = triangle();
    let indices = b.accessor(5121, "SCALAR", 3, &[0, 1, 1]);
    let (places, values) = (b.view(&[1, 2]), b.view(&[2, 1]));
    b.accessors[indices]["sparse"] = json!({
        "count": 2, "indices": { "bufferView": places, "componentType": 5121 }, "values": { "bufferView": values },
    });
    let read = |b: &Builder| {
        let primitive = json!({ "attributes": attributes, "indices": indices });
        let file = b.read(json!({ "meshes": [{ "primitives": [primitive] }] }));
        file.map(|file| file.scene.meshes[0].triangles().to_vec())
    };
    assert_eq!(read(&b).unwrap(), [[0, 2, 1]]);
    b.accessors[indices].as_object_mut().unwrap().remove("bufferView");
    assert_eq!(read(&b).unwrap(), [[0, 2, 1]], "zeros but for two");
    b.accessors[indices]["sparse"]["indices"]["bufferView"] = json!(values);
    b.accessors[indices]["count"] = json!(2);
    assert!(read(&b).unwrap_err().ends_with("/accessors/2/sparse: expected indices below 2, found 2"));
    b.accessors[indices].as_object_mut().unwrap().remove("sparse");
    b.accessors[indices]["count"] = json!(3);
    assert_eq!(read(&b).unwrap(), [[0, 0, 0]]);
    b.accessors[indices]["count"] = json!(4_000_000_000u32);
    let message = read(&b).unwrap_err();
    assert!(message.starts_with("f: /accessors/2/count: expected at most "), "{message}");
}

#[test]
fn accessors_without_data_are_zeros_unless_draco_has_it() {
    let (mut b, attributes) = triangle();
    let read = |b: &Builder, extensions: &Value| {
        let primitive = json!({ "attributes": attributes, "extensions": extensions });
        b.read(json!({ "meshes": [{ "primitives": [primitive] }] })).map(|file| file.scene.meshes)
    };
    let draco = json!({ "KHR_draco_mesh_compression": { "bufferView": 0, "attributes": { "POSITION": 0 } } });
    let [position, uv] =
        ["POSITION", "TEXCOORD_0"].map(|name| usize::try_from(attributes[name].as_u64().unwrap()).unwrap());
    b.accessors[uv].as_object_mut().unwrap().remove("bufferView");
    assert_eq!(read(&b, &json!({})).unwrap()[0].corner_uvs(), [[Vec2::ZERO; 3]]);
    assert!(read(&b, &draco).is_ok(), "accessors have positions as well");
    b.accessors[position].as_object_mut().unwrap().remove("bufferView");
    assert_eq!(read(&b, &json!({})).unwrap()[0].positions(), [Vec3::ZERO; 3]);
    let message = read(&b, &draco).unwrap_err();
    assert!(
        message
            .ends_with("expected a primitive with its data in accessors, found one that is compressed by Draco alone")
    );
    b.accessors[position]["count"] = json!(4_000_000_000u32);
    let message = read(&b, &json!({})).unwrap_err();
    assert!(message.starts_with("f: /accessors/0/count: expected at most "), "{message}");
}

#[test]
fn positions_need_no_bounds() {
    let (mut b, attributes) = triangle();
    let document = json!({ "meshes": [{ "primitives": [{ "attributes": attributes }] }] });
    let bounds = |b: &Builder| {
        let asset = Asset::parse(&b.file(&document), PathBuf::new()).map_err(|_| ()).unwrap();
        describe(&asset).map_err(|_| ()).unwrap().nodes[0].bounds
    };
    assert!(bounds(&b).is_some());
    b.accessors[0].as_object_mut().unwrap().retain(|key, _| !["min", "max"].contains(&key.as_str()));
    assert_eq!(b.read(document.clone()).unwrap().scene.meshes[0].positions()[1], Vec3::X);
    assert!(bounds(&b).is_none(), "nobody has said any");
}

#[test]
fn integers_may_be_written_as_other_numbers() {
    let (b, attributes) = triangle();
    let document = b.file(&json!({ "meshes": [{ "primitives": [{ "attributes": attributes }] }] }));
    let text = String::from_utf8(document).unwrap();
    let other = text.replace("5126", "5126.0").replace(r#""count":3"#, r#""count":0.3e1"#);
    assert_ne!(other, text);
    let read = |text: &str| {
        let asset = Asset::parse(text.as_bytes(), PathBuf::new());
        asset.and_then(|asset| read::scene(&asset)).map_err(|_| ()).unwrap().scene
    };
    assert_eq!(read(&other), read(&text));
    // The validator also checks the content of such accessors.
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.gltf");
    std::fs::write(&path, &other).unwrap();
    let findings = crate::format::validate(&path).unwrap().findings;
    let said = "/accessors/0/max: expected 0, the max of component 2, found 1";
    assert!(findings.iter().any(|finding| finding.to_string().contains(said)), "{findings:?}");
}

#[test]
fn a_file_that_many_buffers_name_is_there_once() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let bytes: Vec<u8> = CORNERS.as_flattened().iter().flat_map(|v| v.to_le_bytes()).collect();
    std::fs::write(at("a.bin"), &bytes).unwrap();
    let primitive = |accessor: usize| json!({ "attributes": { "POSITION": accessor } });
    let accessor = |view: usize| json!({ "bufferView": view, "componentType": 5126, "type": "VEC3", "count": 3, "min": [0, 0, 0], "max": [1, 1, 0] });
    let buffers = ["a.bin", "./a.bin", "%61.bin"].map(|uri| json!({ "byteLength": 36, "uri": uri }));
    let document = json!({
        "asset": { "version": "2.0" }, "scene": 0, "scenes": [{ "nodes": [0] }], "nodes": [{ "mesh": 0 }],
        "meshes": [{ "primitives": (0..3).map(primitive).collect::<Vec<_>>() }],
        "accessors": (0..3).map(accessor).collect::<Vec<_>>(),
        "bufferViews": (0..3).map(|i| json!({ "buffer": i, "byteLength": 36 })).collect::<Vec<_>>(),
        "buffers": buffers,
    });
    std::fs::write(at("a.gltf"), document.to_string()).unwrap();
    let asset = Asset::open(&at("a.gltf")).unwrap();
    assert_eq!((asset.stored_bytes(), asset.buffers.len()), (36, 3));
    let options = ReadOptions { keep_document: true, ..ReadOptions::default() };
    let file = read_file(&at("a.gltf"), &options).unwrap();
    let options = WriteOptions { source: file.source.as_ref(), ..WriteOptions::default() };
    write_scene(&at("b.gltf"), &file.scene, &options).unwrap();
    let written: Value = serde_json::from_slice(&std::fs::read(at("b.gltf")).unwrap()).unwrap();
    assert_eq!(written["buffers"][0]["byteLength"], 36);
    let back = read_file(&at("b.gltf"), &ReadOptions::default()).unwrap().scene;
    let corners: Vec<&[Vec3]> = back.meshes[0].positions().chunks(3).collect();
    assert!(
        corners.len() == 3 && corners.iter().all(|corners| corners[0] == Vec3::ZERO && corners[1] == Vec3::X),
        "{corners:?}"
    );
}
