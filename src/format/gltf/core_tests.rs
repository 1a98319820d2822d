//! Hand-written core glTF as other programs write it: one small document per feature.

use std::path::{Path, PathBuf};

use glam::{DVec3, Vec2, Vec3};
use serde_json::{Value, json};

use super::extension::HYBRID;
use super::*;
use crate::base64;
use crate::format::test_scenes::read_turned;
use crate::format::{WriteOptions, read_file, read_scene, write_scene};

/// Builder of documents, which turns each array into an accessor with its own buffer view.
#[derive(Default)]
pub(super) struct Builder {
    pub(super) bytes: Vec<u8>,
    pub(super) views: Vec<Value>,
    pub(super) accessors: Vec<Value>,
}

impl Builder {
    pub(super) fn view(&mut self, bytes: &[u8]) -> usize {
        self.bytes.resize(self.bytes.len().next_multiple_of(4), 0);
        self.views.push(json!({ "buffer": 0, "byteOffset": self.bytes.len(), "byteLength": bytes.len() }));
        self.bytes.extend_from_slice(bytes);
        self.views.len() - 1
    }

    pub(super) fn accessor(&mut self, component: u32, kind: &str, count: usize, bytes: &[u8]) -> usize {
        let view = self.view(bytes);
        self.accessors.push(json!({ "bufferView": view, "componentType": component, "type": kind, "count": count }));
        self.accessors.len() - 1
    }

    pub(super) fn floats<const N: usize>(&mut self, values: &[[f32; N]]) -> usize {
        let kind = match N {
            1 => "SCALAR",
            2 => "VEC2",
            3 => "VEC3",
            4 => "VEC4",
            _ => "MAT4",
        };
        let bytes: Vec<u8> = values.as_flattened().iter().flat_map(|v| v.to_le_bytes()).collect();
        let index = self.accessor(5126, kind, values.len(), &bytes);
        self.bounded(index)
    }

    /// Adds the bounds that POSITION must have; only validators check their values.
    pub(super) fn bounded(&mut self, accessor: usize) -> usize {
        self.accessors[accessor]["min"] = json!([0, 0, 0]);
        self.accessors[accessor]["max"] = json!([1, 1, 1]);
        accessor
    }

    pub(super) fn normalized(&mut self, component: u32, kind: &str, count: usize, bytes: &[u8]) -> usize {
        let index = self.accessor(component, kind, count, bytes);
        self.accessors[index]["normalized"] = json!(true);
        index
    }

    /// Adds the joints and weights of a skin to the attributes of three vertices.
    pub(super) fn skinned(&mut self, attributes: &mut Value, joints: [[u8; 4]; 3], weights: [[f32; 4]; 3]) {
        attributes["JOINTS_0"] = json!(self.accessor(5121, "VEC4", 3, joints.as_flattened()));
        attributes["WEIGHTS_0"] = json!(self.floats(&weights));
    }

    /// Bytes of the file; `rest` replaces the default content, one node with mesh 0.
    pub(super) fn file(&self, rest: &Value) -> Vec<u8> {
        let text = format!("data:application/octet-stream;base64,{}", base64::encode(&self.bytes));
        let mut document = json!({
            "asset": { "version": "2.0" }, "scene": 0, "scenes": [{ "nodes": [0] }], "nodes": [{ "mesh": 0 }],
            "bufferViews": self.views, "accessors": self.accessors,
            "buffers": [{ "byteLength": self.bytes.len(), "uri": text }],
        });
        rest.as_object().unwrap().iter().for_each(|(key, value)| document[key] = value.clone());
        document.to_string().into_bytes()
    }

    #[expect(clippy::needless_pass_by_value, reason = "documents are written where they are read")]
    pub(super) fn read(&self, rest: Value) -> Result<Content, String> {
        let asset = Asset::parse(&self.file(&rest), PathBuf::new());
        asset.and_then(|asset| read::scene(&asset)).map_err(|fault| fault.in_file(Path::new("f")).to_string())
    }
}

pub(super) const CORNERS: [[f32; 3]; 3] = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]];
pub(super) const UVS: [[f32; 2]; 3] = [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]];

pub(super) fn triangle() -> (Builder, Value) {
    let mut b = Builder::default();
    let (position, uv) = (b.floats(&CORNERS), b.floats(&UVS));
    (b, json!({ "POSITION": position, "TEXCOORD_0": uv }))
}

#[track_caller]
pub(super) fn near(found: &[f32], expected: &[f32], tolerance: f32) {
    assert_eq!(found.len(), expected.len());
    assert!(found.iter().zip(expected).all(|(a, b)| (a - b).abs() <= tolerance), "{found:?}, expected {expected:?}");
}

/// Foreign files are y up and scenes y down; written again, they are upright.
#[test]
fn what_others_wrote_stays_where_it_is_however_often_it_is_written() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let mut b = Builder::default();
    let position = b.floats(&[[0.0f32, 1.0, 2.0], [1.0, 1.0, 2.0], [0.0, 3.0, 2.0]]);
    let document = json!({
        "meshes": [{ "primitives": [{ "attributes": { "POSITION": position } }] }],
        "nodes": [{ "mesh": 0, "children": [1] }, { "name": "eye", "camera": 0, "translation": [0.5, 2, 7] }],
        "cameras": [{ "type": "perspective", "perspective": { "yfov": 1.0, "aspectRatio": 1.5, "znear": 0.1 } }],
    });
    std::fs::write(at("theirs.gltf"), b.file(&document)).unwrap();
    read_turned(&at("theirs.gltf"), true);
    let theirs = read_file(&at("theirs.gltf"), &ReadOptions { keep_document: true, ..ReadOptions::default() }).unwrap();
    for (name, source) in [("a.gltf", None), ("a.glb", None), ("a.usda", None), ("same.glb", theirs.source.as_ref())] {
        let options = WriteOptions { cameras: &theirs.cameras, source, ..WriteOptions::default() };
        write_scene(&at(name), &theirs.scene, &options).unwrap();
        read_turned(&at(name), source.is_some());
    }
    // Programs that do not know our root node see the scene where the original was.
    let mut ours: Value = serde_json::from_slice(&std::fs::read(at("a.gltf")).unwrap()).unwrap();
    let root = ours["scenes"][0]["nodes"][0].as_u64().unwrap() as usize;
    ours["nodes"][root]["name"] = json!("world");
    std::fs::write(at("seen.gltf"), ours.to_string()).unwrap();
    read_turned(&at("seen.gltf"), true);

    write_scene(&at("b.glb"), &read_scene(&at("theirs.gltf")).unwrap(), &WriteOptions::default()).unwrap();
    assert_eq!(read_scene(&at("b.glb")).unwrap().meshes, theirs.scene.meshes);
}

#[test]
fn copies_at_seams_have_numbers_without_gaps_and_one_place() {
    let mut b = Builder::default();
    let position = b.floats(&[
        [0.0, 0.0, 0.0],
        [1.0, 0.0, 0.0],
        [0.0, 1.0, 0.0],
        [0.0, 0.0, 0.0],
        [1.0, 0.0, 0.0],
        [0.0, 0.0, 1.0],
    ]);
    for (of_corners, fault) in [
        ([0, 1, 2, 0, 1, 3], ""),
        ([0, 1, 2, 0, 1, 4], "expected surface vertices without gaps, found none that is 3"),
        ([0, 1, 2, 0, 1, 6], "expected surface vertices below 6, found 6"),
        ([0, 1, 2, 1, 0, 3], "expected copies of a surface vertex in one place, found vertex 1 in two"),
    ] {
        let source = b.accessor(5121, "SCALAR", 6, &of_corners);
        let extension = json!({ "EXT_gaussian_splatting_hybrid": { "surfaceVertices": source } });
        let read = b.read(json!({
            "meshes": [{ "primitives": [{ "attributes": { "POSITION": position }, "extensions": extension }] }],
        }));
        match read {
            Ok(file) => assert_eq!((fault, file.scene.meshes[0].positions().len()), ("", 4)),
            Err(message) => assert!(!fault.is_empty() && message.ends_with(fault), "{message}"),
        }
    }
}

#[test]
fn nodes_made_invisible_are_left_out() {
    let (b, attributes) = triangle();
    let read = |is_visible: bool| {
        let file = b.read(json!({
            "meshes": [{ "primitives": [{ "attributes": attributes }] }],
            "cameras": [{ "type": "perspective", "perspective": { "yfov": 1.0, "aspectRatio": 2.0, "znear": 0.1 } }],
            "nodes": [
                { "children": [1, 2] },
                { "mesh": 0, "children": [3], "extensions": { "KHR_node_visibility": { "visible": is_visible } } },
                { "mesh": 0 },
                { "mesh": 0, "camera": 0, "extensions": { "KHR_node_visibility": { "visible": false } } },
            ],
            "extensionsUsed": ["KHR_node_visibility"],
            "extensionsRequired": ["KHR_node_visibility"],
        }));
        let file = file.unwrap();
        assert_eq!(file.notes[0], "1 node left out because invisible, with all below");
        assert!(file.cameras.is_empty());
        file.scene.meshes[0].triangles().len()
    };
    assert_eq!([true, false].map(read), [2, 1]);
}

#[test]
fn primitives_without_positions_are_left_out() {
    let (b, attributes) = triangle();
    let mut bare = attributes.clone();
    bare.as_object_mut().unwrap().remove("POSITION");
    let splats = json!({ "kernel": "ellipse", "colorSpace": "srgb_rec709_display" });
    let document = json!({
        "meshes": [{ "primitives": [
            { "attributes": bare }, { "attributes": attributes },
            { "attributes": bare, "mode": 0, "extensions": { "KHR_gaussian_splatting": splats } },
        ] }],
        "extensionsUsed": ["KHR_gaussian_splatting"],
    });
    let file = b.read(document.clone()).unwrap();
    let said = |primitive: usize| format!("/meshes/0/primitives/{primitive}: left out: it has no POSITION");
    assert!(file.notes[0] == said(0) && file.notes.contains(&said(2)), "{:?}", file.notes);
    assert_eq!((file.scene.meshes[0].triangles().len(), file.scene.splats.len()), (1, 0));
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.gltf");
    std::fs::write(&path, b.file(&document)).unwrap();
    let mesh = crate::format::mesh_import::read(&path).unwrap();
    assert_eq!((mesh.triangles.len(), mesh.y_up, mesh.notes), (1, true, vec![said(0), said(2)]));
    let asset = Asset::open(&path).unwrap();
    let primitives = &describe(&asset).map_err(|_| ()).unwrap().nodes[0].primitives;
    assert_eq!(primitives.iter().map(|p| p.vertices).collect::<Vec<_>>(), [0, 3, 0]);
}

#[test]
fn positions_that_are_not_finite_are_refused_at_their_place() {
    let mut b = Builder::default();
    let broken = [CORNERS[0], [1.0, 0.0, f32::NAN], CORNERS[2]];
    let [whole, broken] = [CORNERS, broken].map(|corners| b.floats(&corners));
    let message = |position: usize| {
        let large = [1e30; 3];
        let document = json!({
            "meshes": [{ "primitives": [{ "attributes": { "POSITION": position } }] }],
            "nodes": [{ "scale": large, "children": [1] }, { "scale": large, "mesh": 0 }],
        });
        b.read(document).unwrap_err()
    };
    let expected = "expected positions of finite numbers, found";
    let stored = format!("f: /meshes/0/primitives/0/attributes/POSITION: {expected} NaN at vertex 1");
    assert_eq!(message(broken), stored);
    assert_eq!(message(whole), format!("f: /nodes/1: {expected} inf at vertex 1"), "by their nodes");
}

#[test]
fn a_document_without_scenes_shows_all_its_nodes() {
    let (b, attributes) = triangle();
    let document = json!({
        "meshes": [{ "primitives": [{ "attributes": attributes }] }], "scenes": [],
        "nodes": [{ "mesh": 0, "translation": [0, 0, 1] }, { "children": [0] }, { "mesh": 0 }],
    });
    let file = b.read(document.clone()).unwrap();
    assert_eq!(file.scene.meshes[0].triangles().len(), 2);
    assert_eq!(file.notes[0], "/scenes: there are none, so all nodes are shown");
    // Moved, it is written with one, below which all of it is.
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    std::fs::write(at("a.gltf"), b.file(&document)).unwrap();
    let options = ReadOptions { keep_document: true, ..ReadOptions::default() };
    let read = read_file(&at("a.gltf"), &options).unwrap();
    let mut source = read.source.unwrap();
    source.follow(DMat4::from_translation(DVec3::X), &read.scene, &[]);
    let options = WriteOptions { source: Some(&source), ..WriteOptions::default() };
    write_scene(&at("b.gltf"), &read.scene, &options).unwrap();
    let written: Value = serde_json::from_slice(&std::fs::read(at("b.gltf")).unwrap()).unwrap();
    assert_eq!((&written["scenes"], &written["nodes"][3]["children"]), (&json!([{ "nodes": [3] }]), &json!([1, 2])));
}

#[test]
fn what_leaves_the_base_colour_alone_may_be_required() {
    let (b, attributes) = triangle();
    let unshown = [
        "KHR_materials_clearcoat",
        "KHR_lights_punctual",
        "KHR_materials_variants",
        "KHR_animation_pointer",
        "KHR_xmp_json_ld",
        "EXT_mesh_features",
        "EXT_structural_metadata",
    ];
    let read = |required: &[&str]| {
        let document = json!({
            "meshes": [{ "primitives": [{ "attributes": attributes }] }], "extensionsRequired": required,
        });
        b.read(document).unwrap().notes
    };
    let said = unshown.map(|name| format!("/extensionsRequired: {name} is not shown"));
    assert_eq!(read(&unshown)[..unshown.len()], said);
    // These extensions are supported.
    assert_eq!(read(&["KHR_materials_emissive_strength", "KHR_materials_pbrSpecularGlossiness"]), read(&[]));
}

#[test]
fn skins_and_morph_targets_come_in_their_rest_pose() {
    let (mut b, mut attributes) = triangle();
    let weights = [[1.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.5, 0.5, 0.0, 0.0]];
    b.skinned(&mut attributes, [[0, 0, 0, 0], [1, 0, 0, 0], [0, 1, 0, 0]], weights);
    let delta = b.floats(&[[0.0f32, 0.0, 1.0]; 3]);
    // Joint 0 was bound one unit along x, joint 1 at the origin.
    let mut bind = glam::Mat4::IDENTITY;
    bind.w_axis.x = -1.0;
    let inverse = b.floats(&[bind.to_cols_array(), glam::Mat4::IDENTITY.to_cols_array()]);
    let document = json!({
        "meshes": [{ "primitives": [{ "attributes": attributes, "targets": [{ "POSITION": delta }] }], "weights": [0.25] }],
        "skins": [{ "joints": [1, 2], "inverseBindMatrices": inverse }],
        // The transform of the node of a skinned mesh is ignored.
        "nodes": [
            { "mesh": 0, "skin": 0, "translation": [100, 100, 100], "children": [1, 2] },
            { "translation": [-100, -100, -100] }, { "translation": [-100, -98, -100] },
        ],
    });
    let mesh = b.read(document.clone()).unwrap().scene.meshes.remove(0);
    // z comes from the morph target. x, y: vertex 0 follows joint 0 at 0, vertex 1 follows joint 1, and vertex 2 is
    // halfway between both.
    let expected = [Vec3::new(-1.0, 0.0, 0.25), Vec3::new(1.0, 2.0, 0.25), Vec3::new(-0.5, 2.0, 0.25)];
    assert_eq!(mesh.positions(), expected);
    let mut outside = document.clone();
    outside["skins"][0]["joints"] = json!([1]);
    assert!(b.read(outside).unwrap_err().contains("JOINTS_0: expected joints below 1, found 1 at vertex 1"));
    let mut apart = document;
    apart["nodes"][0]["children"] = json!([1]);
    assert!(
        b.read(apart)
            .unwrap_err()
            .contains("/skins/0/joints: expected joints in the scene of their mesh, found node 2")
    );
}

#[test]
fn meshes_of_one_material_become_one() {
    let (b, attributes) = triangle();
    let primitive = |material: usize| json!({ "attributes": attributes, "material": material });
    let file = b
        .read(json!({
            "meshes": [{ "primitives": [primitive(0), primitive(1)] }],
            "materials": [{}, {}],
            "nodes": [{ "mesh": 0, "children": [1] }, { "mesh": 0, "scale": [-2, 2, 2] }],
        }))
        .unwrap();
    let counts: Vec<usize> = file.scene.meshes.iter().map(|m| m.triangles().len()).collect();
    assert_eq!(counts, [2, 2]);
    let mesh = &file.scene.meshes[0];
    assert_eq!(mesh.triangles(), [[0, 1, 2], [3, 5, 4]], "a mirrored front stays a front");
    assert_eq!(mesh.positions()[4], Vec3::new(-2.0, 0.0, 0.0));
}

/// Layout that many programs use for parts of a mesh with different materials.
#[test]
fn parts_that_share_vertices_have_those_that_they_use() {
    let mut b = Builder::default();
    let position = b.floats(&[[0f32, 0., 0.], [1., 0., 0.], [0., 1., 0.], [5., 5., 5.], [1., 1., 0.]]);
    let uv = b.floats(&[[0f32, 0.], [1., 0.], [0., 1.], [0.5, 0.5], [1., 1.]]);
    let mut part = |corners: [u8; 3], material: usize| {
        let indices = b.accessor(5121, "SCALAR", 3, &corners);
        json!({ "attributes": { "POSITION": position, "TEXCOORD_0": uv }, "indices": indices, "material": material })
    };
    let parts = [part([0, 1, 2], 0), part([4, 2, 1], 1)];
    let meshes = |primitives: &[Value]| {
        let mesh = json!({ "meshes": [{ "primitives": primitives }], "materials": [{}, {}] });
        b.read(mesh).unwrap().scene.meshes
    };
    let [first, second] = &meshes(&parts)[..] else { panic!("two meshes") };
    assert_eq!(first.positions(), [Vec3::ZERO, Vec3::X, Vec3::Y]);
    assert_eq!(second.positions(), [Vec3::X, Vec3::Y, Vec3::new(1.0, 1.0, 0.0)]);
    assert_eq!((second.triangles(), second.corner_uvs()[0]), (&[[2, 1, 0]][..], [Vec2::ONE, Vec2::Y, Vec2::X]));
    // A part alone keeps all vertices of the file.
    let [alone] = &meshes(&parts[1..])[..] else { panic!("one mesh") };
    assert_eq!((alone.positions().len(), alone.triangles()), (5, &[[4, 2, 1]][..]));
}

#[test]
fn repeated_use_of_a_mesh_is_bounded() {
    let mut b = Builder::default();
    let position = b.floats(&vec![[0.5f32; 3]; 8000]);
    let nodes: Vec<Value> = (0..20_000).map(|_| json!({ "mesh": 0 })).collect();
    let message = b
        .read(json!({
            "meshes": [{ "primitives": [{ "attributes": { "POSITION": position } }] }],
            "nodes": nodes, "scenes": [{ "nodes": (0..20_000).collect::<Vec<_>>() }],
        }))
        .unwrap_err();
    assert!(message.contains("bytes of arrays from a file of this size, found more, by repeated use"), "{message}");
}

/// The product of nodes and primitives can be much larger than either number in the file.
#[test]
fn primitives_at_many_nodes_say_the_same_once() {
    let (b, attributes) = triangle();
    let at_nodes = |nodes: usize, primitives: usize, part: &Value| {
        json!({
            "meshes": [{ "primitives": vec![part; primitives] }],
            "nodes": vec![json!({ "mesh": 0 }); nodes], "scenes": [{ "nodes": (0..nodes).collect::<Vec<_>>() }],
        })
    };
    let lines = json!({ "attributes": attributes, "mode": 1 });
    let notes = b.read(at_nodes(3, 40, &lines)).unwrap().notes;
    let said =
        |node: usize| format!("/nodes/{node}: a primitive that is neither triangles nor splats is left out (40 times)");
    assert_eq!(notes[notes.len() - 3..], [said(0), said(1), said(2)]);
    assert!(notes.len() < 6, "{notes:?}");

    let asset = Asset::parse(&b.file(&at_nodes(1600, 1600, &lines)), PathBuf::new()).map_err(|_| ()).unwrap();
    let message = describe(&asset).unwrap_err().in_file(Path::new("f")).to_string();
    assert!(message.contains("bytes of arrays from a file of this size, found more, by repeated use"), "{message}");
}

#[test]
fn cameras_with_and_without_perspective() {
    let (b, attributes) = triangle();
    let file = b
        .read(json!({
            "meshes": [{ "primitives": [{ "attributes": attributes }] }],
            "nodes": [{ "mesh": 0, "children": [1, 2] }, { "camera": 0, "name": "wide" }, { "camera": 1 }],
            "cameras": [
                { "type": "perspective", "perspective": { "yfov": 1.0, "aspectRatio": 2.0, "znear": 0.1 } },
                { "type": "orthographic", "orthographic": { "xmag": 1, "ymag": 1, "zfar": 10, "znear": 0.1 } },
            ],
        }))
        .unwrap();
    let [(name, camera)] = &file.cameras[..] else { panic!("{:?}", file.cameras) };
    let k = camera.intrinsics();
    assert_eq!((name.as_str(), k.width, k.height), ("wide", 2160, 1080));
    assert!((2.0 * (540.0 / k.fy).atan() - 1.0).abs() < 1e-6);
    assert!(file.notes.iter().any(|n| n.contains("camera left out: it is orthographic")), "{:?}", file.notes);
}

/// For a hybrid scene the near plane is read from all cameras; the crate `gltf` panics on a camera that lacks the data
/// of its type.
#[test]
fn a_camera_without_what_its_type_names_is_left_out() {
    let (b, attributes) = triangle();
    let file = b
        .read(json!({
            "extensionsUsed": [HYBRID],
            "scenes": [{ "nodes": [0, 1], "extensions": { HYBRID: { "colorSpace": "srgb_rec709_display" } } }],
            "meshes": [{ "primitives": [{ "attributes": attributes }] }],
            "nodes": [{ "mesh": 0 }, { "camera": 0 }],
            "cameras": [{ "type": "perspective", "orthographic": { "xmag": 1, "ymag": 1, "zfar": 10, "znear": 0.1 } }],
        }))
        .unwrap();
    assert!(file.cameras.is_empty() && file.scene.composition.near == Composition::default().near);
    assert!(file.notes.iter().any(|n| n.contains("camera left out")), "{:?}", file.notes);
}

#[test]
fn versions_that_are_not_understood_are_refused() {
    let (b, attributes) = triangle();
    let read = |asset: Value| {
        b.read(json!({ "asset": asset, "meshes": [{ "primitives": [{ "attributes": attributes }] }] })).map(drop)
    };
    for asset in
        [json!({ "version": "2.0" }), json!({ "version": "2.1" }), json!({ "version": "2.7", "minVersion": "2.0" })]
    {
        assert_eq!(read(asset), Ok(()));
    }
    let refused = |asset: Value| read(asset).unwrap_err();
    let expected = "glTF 2.0, or a later 2.x that can be read as 2.0";
    assert_eq!(refused(json!({ "version": "3.0" })), format!("f: /asset/version: expected {expected}, found `3.0`"));
    for asset in [json!({ "version": "1.0" }), json!({ "version": "new" }), json!({ "version": "20.0" })] {
        assert!(refused(asset).starts_with("f: /asset/version: expected"));
    }
    let least = refused(json!({ "version": "2.1", "minVersion": "2.1" }));
    assert_eq!(least, format!("f: /asset/minVersion: expected {expected}, found `2.1`"));
}
