//! Documents written again: unchanged, transformed, or with named losses.

use std::path::PathBuf;

use glam::{DMat4, DQuat, DVec3};
use proptest::prelude::*;
use serde_json::{Value, json};

use super::buffer::Buffer;
use super::core_tests::{Builder, triangle};
use super::extension::{EXTRAS, HYBRID, KHR_SPLATS, SPECULAR_GLOSSINESS};
use super::remainder::remainder;
use super::tests::{fuzzed_values, leaves};
use super::*;
use crate::base64;
use crate::format::test_scenes::{black_png, camera, random_scene};
use crate::format::{ReadOptions, WriteOptions, read_file, read_scene, write_scene};
use crate::scene::PixelFilter;

pub(super) const KEEP: ReadOptions<'_> =
    ReadOptions { drop_invalid: false, keep_document: true, time: None, animations: &[] };

/// A triangle with all features that a scene cannot hold.
pub(super) fn rich() -> (Builder, Value) {
    let (mut b, mut attributes) = triangle();
    attributes["NORMAL"] = json!(b.floats(&[[0.0f32, 0.0, 1.0]; 3]));
    attributes["_TEMPERATURE"] = json!(b.floats(&[[1.5f32], [2.5], [3.5]]));
    b.skinned(&mut attributes, [[0; 4]; 3], [[1.0, 0.0, 0.0, 0.0]; 3]);
    let delta = b.floats(&[[0.0f32, 0.0, 0.5]; 3]);
    let (times, turns) = (b.floats(&[[0.0f32], [1.0]]), b.floats(&[[0.0f32, 0.0, 0.0, 1.0], [0.0, 0.0, 1.0, 0.0]]));
    let extra = |name: &str| json!({ "of": name });
    let unknown = |name: &str| json!({ "EXT_unknown": { "of": name } });
    let document = json!({
        "asset": { "version": "2.0", "generator": "hand", "copyright": "us", "extras": extra("asset"), "extensions": unknown("asset") },
        "extensionsUsed": ["EXT_unknown"], "extensions": unknown("root"), "extras": extra("root"),
        "scenes": [{ "nodes": [0, 2], "name": "main", "extras": extra("scene"), "extensions": unknown("scene") }],
        "nodes": [
            { "mesh": 0, "skin": 0, "name": "flag", "children": [1], "extras": extra("node"), "extensions": unknown("node") },
            { "name": "joint", "translation": [0, 1, 0] },
            { "name": "eye", "camera": 0, "translation": [0, 0, 3] },
        ],
        "meshes": [{
            "extras": extra("mesh"), "extensions": unknown("mesh"),
            "primitives": [{
                "attributes": attributes, "material": 0, "targets": [{ "POSITION": delta }],
                "extras": extra("primitive"), "extensions": unknown("primitive"),
            }],
        }],
        "materials": [{ "name": "cloth", "extras": extra("material"), "extensions": unknown("material"), "emissiveFactor": [1, 0, 0] }],
        "skins": [{ "joints": [1] }],
        "cameras": [{ "type": "perspective", "perspective": { "yfov": 1, "znear": 0.1 } }],
        "animations": [{
            "samplers": [{ "input": times, "output": turns }],
            "channels": [
                { "sampler": 0, "target": { "path": "pointer", "extensions": { "KHR_animation_pointer": { "pointer": "/extras" } } } },
                { "sampler": 0, "target": { "node": 1, "path": "rotation" } },
            ],
        }],
    });
    (b, document)
}

/// JSON and buffers of a file in either container.
pub(super) fn opened(path: &Path) -> (Value, Vec<Vec<u8>>) {
    let asset = Asset::open(path).unwrap();
    let content = |buffer: &Buffer| buffer.read(0..buffer.len()).unwrap().into_owned();
    (asset.root, asset.buffers.iter().map(content).collect())
}

#[test]
fn nothing_is_lost_where_nothing_changes() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let (b, document) = rich();
    std::fs::write(at("in.gltf"), b.file(&document)).unwrap();
    let (original, bytes) = opened(&at("in.gltf"));
    let file = read_file(&at("in.gltf"), &KEEP).unwrap();
    for name in ["out.glb", "out.gltf"] {
        let options = WriteOptions { cameras: &file.cameras, source: file.source.as_ref(), ..WriteOptions::default() };
        let report = write_scene(&at(name), &file.scene, &options).unwrap();
        assert!(report.loss.is_none(), "{}", report.loss);
        let (written, written_bytes) = opened(&at(name));
        assert_eq!(written, original, "all of the JSON");
        assert_eq!(written_bytes, bytes, "all accessors, bit for bit");
    }
}

#[test]
fn hybrids_come_back_bit_for_bit() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let cameras = [("front".to_owned(), camera())];
    write_glb(&at("a.glb"), &random_scene(30, 2, 3, 4), &cameras, Some(json!({ "psnr": 30.5 }))).unwrap();
    let file = read_file(&at("a.glb"), &KEEP).unwrap();
    assert!(file.source.as_ref().unwrap().remainder().is_empty(), "{:?}", file.source.unwrap().remainder());
    let options = WriteOptions { cameras: &file.cameras, source: file.source.as_ref(), ..WriteOptions::default() };
    let report = write_scene(&at("b.glb"), &file.scene, &options).unwrap();
    assert!(report.loss.is_none());
    let [a, b] = ["a.glb", "b.glb"].map(|name| std::fs::read(at(name)).unwrap());
    assert!(a == b, "the same file");
}

#[test]
fn what_moves_hangs_below_a_node() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let turn = DQuat::from_euler(glam::EulerRot::XYZ, 0.4, -0.5, 0.6);
    let by = DMat4::from_scale_rotation_translation(DVec3::splat(2.0), turn, DVec3::new(1.0, 2.0, 3.0));
    let (b, document) = rich();
    std::fs::write(at("theirs.gltf"), b.file(&document)).unwrap();
    write_glb(&at("ours.glb"), &random_scene(4, 1, 1, 4), &[("c".to_owned(), camera())], None).unwrap();
    for name in ["theirs.gltf", "ours.glb"] {
        let file = read_file(&at(name), &KEEP).unwrap();
        // The fingerprint is that of the scene which the caller states as the transformed one.
        let mut source = file.source.clone().unwrap();
        source.follow(by, &file.scene, &file.cameras);
        let options = WriteOptions { cameras: &file.cameras, source: Some(&source), ..WriteOptions::default() };
        let report = write_scene(&at("moved.glb"), &file.scene, &options).unwrap();
        assert!(report.loss.is_none(), "{}", report.loss);
        let moved = read_file(&at("moved.glb"), &KEEP).unwrap();
        assert_eq!((moved.y_up, file.y_up), (name == "theirs.gltf", name == "theirs.gltf"));
        for (before, after) in file.scene.meshes.iter().zip(&moved.scene.meshes) {
            for (p, q) in before.positions().iter().zip(after.positions()) {
                let expected = by.transform_point3(p.as_dvec3());
                assert!(q.as_dvec3().abs_diff_eq(expected, 1e-4), "{name}: {q} {expected}");
            }
        }
        for (before, after) in file.scene.splats.means().iter().zip(moved.scene.splats.means()) {
            let expected = by.transform_point3(before.as_dvec3());
            assert!(after.as_dvec3().abs_diff_eq(expected, 1e-4), "{name}: {after} {expected}");
        }
        let (json, _) = opened(&at("moved.glb"));
        let (original, _) = opened(&at(name));
        assert_eq!(json["animations"], original["animations"]);
        assert_eq!(json["meshes"], original["meshes"]);
        // A mirrored document cannot be kept.
        let mut source = file.source.unwrap();
        source.follow(DMat4::from_scale(DVec3::new(-1.0, 1.0, 1.0)), &file.scene, &file.cameras);
        assert!(!source.stands(&file.scene, &file.cameras));
    }
}

/// A root node of two scenes must not become the child of a node in only one of them.
#[test]
fn what_scenes_share_moves_in_all_of_them() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let (b, mut document) = rich();
    let roots = document["scenes"][0]["nodes"].as_array().unwrap().clone();
    let nodes = document["nodes"].as_array_mut().unwrap();
    let alone = nodes.len();
    nodes.push(json!({ "name": "alone" }));
    document["scenes"].as_array_mut().unwrap().push(json!({ "nodes": [roots[0], alone] }));
    std::fs::write(at("two.gltf"), b.file(&document)).unwrap();
    let file = read_file(&at("two.gltf"), &KEEP).unwrap();
    let mut source = file.source.unwrap();
    source.follow(DMat4::from_translation(DVec3::X), &file.scene, &file.cameras);
    let options = WriteOptions { cameras: &file.cameras, source: Some(&source), ..WriteOptions::default() };
    write_scene(&at("moved.gltf"), &file.scene, &options).unwrap();
    let faults = crate::format::validate(&at("moved.gltf")).unwrap();
    assert!(!faults.findings.iter().any(|f| ["SCENE_ROOT", "NODE_PARENT"].contains(&f.code)), "{:?}", faults.findings);
    let (json, _) = opened(&at("moved.gltf"));
    let [current, other] = [0, 1].map(|i| json["scenes"][i]["nodes"].as_array().unwrap().clone());
    assert_eq!((current.len(), &other[..]), (roots.len(), &[current[0].clone(), json!(alone)][..]));
    let top = &json["nodes"][current[0].as_u64().unwrap() as usize];
    assert_eq!((&top["children"], &top["name"]), (&json!([roots[0]]), &json!("moved")));
}

#[test]
fn a_changed_scene_is_written_anew_and_what_is_dropped_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let (b, document) = rich();
    std::fs::write(at("in.gltf"), b.file(&document)).unwrap();
    let file = read_file(&at("in.gltf"), &KEEP).unwrap();
    let source = file.source.unwrap();
    let mut scene = file.scene;
    scene.meshes.push(scene.meshes[0].clone());
    assert!(!source.stands(&scene, &file.cameras));
    let options = WriteOptions { cameras: &file.cameras, source: Some(&source), ..WriteOptions::default() };
    let dropped = [
        "1 animation",
        "1 skin",
        "1 morph target",
        "the tree of 3 nodes",
        "the attributes NORMAL, _TEMPERATURE",
        "the extension EXT_unknown",
        "extras",
    ];
    // File-level metadata is written to another glTF.
    for (name, of_the_file) in [("out.glb", &[][..]), ("out.ply", &["the copyright", "extras of the file"])] {
        let report = write_scene(&at(name), &scene, &options).unwrap();
        assert_eq!(report.loss.document, [&dropped[..], of_the_file].concat());
        assert!(
            !report.loss.is_rounding() && report.loss.to_string().contains("1 animation; 1 skin"),
            "{}",
            report.loss
        );
    }
    let (json, _) = opened(&at("out.glb"));
    assert_eq!(json["asset"]["copyright"], "us");
    assert_eq!(json["asset"]["extras"]["of"], "asset");
    assert_eq!((&json["extras"]["of"], &json["scenes"][0]["name"]), (&json!("root"), &json!("main")));
    assert_eq!(read_file(&at("out.glb"), &KEEP).unwrap().scene.meshes.len(), 2);
}

#[test]
fn what_a_material_does_not_show_is_lost() {
    let lost = |attributes: &[&str], material: Value| {
        let attributes: Value = attributes.iter().map(|name| ((*name).to_owned(), json!(0))).collect();
        let primitive = json!({ "attributes": attributes, "material": 0 });
        let document = json!({ "meshes": [{ "primitives": [primitive] }], "materials": [material] });
        remainder(&document, false).into_iter().map(|part| part.what).collect::<Vec<_>>()
    };
    let based = |texture: Value| json!({ "pbrMetallicRoughness": { "baseColorTexture": texture } });
    let sets = ["POSITION", "TEXCOORD_0", "TEXCOORD_1"];
    assert_eq!(lost(&sets, json!({})), ["the attributes TEXCOORD_1"]);
    assert_eq!(lost(&sets, based(json!({ "index": 0, "texCoord": 1 }))), ["the attributes TEXCOORD_0"]);
    let moved = json!({ "index": 0, "extensions": { "KHR_texture_transform": { "texCoord": 1 } } });
    assert_eq!(lost(&sets, based(moved)), ["the attributes TEXCOORD_0"]);
    let exact = json!({ "sphericalHarmonics": { "degree": 0, "coefficients": [{ "accessor": 0, "texCoord": 1 }] } });
    assert_eq!(lost(&sets, json!({ "extensions": { HYBRID: exact.clone() } })), ["the attributes TEXCOORD_0"]);

    let colors = ["POSITION", "TEXCOORD_0", "COLOR_0"];
    assert_eq!(lost(&colors, json!({})), Vec::<String>::new());
    assert_eq!(lost(&colors, based(json!({ "index": 0 }))), Vec::<String>::new(), "what is left out of them is noted");
    assert_eq!(lost(&colors, json!({ "extensions": { HYBRID: exact } })), ["the attributes COLOR_0, TEXCOORD_0"]);
    assert_eq!(lost(&["POSITION", "COLOR_0", "COLOR_1"], json!({})), ["the attributes COLOR_1"]);

    let (texture, unshown) = (json!({ "index": 0 }), ["textures for shading"]);
    let mut shiny = based(texture.clone());
    shiny["normalTexture"] = texture.clone();
    shiny["pbrMetallicRoughness"]["metallicRoughnessTexture"] = texture.clone();
    assert_eq!(lost(&["POSITION"], shiny), unshown);
    let mut bright = json!({ "emissiveTexture": { "index": 0, "texCoord": 1 }, "emissiveFactor": [1, 1, 1] });
    assert_eq!(lost(&sets, bright.clone()), ["the attributes TEXCOORD_0"], "it is what is shown");
    // The diffuse colour of an extension replaces the base colour.
    let mut diffuse = bright.clone();
    diffuse["extensions"] = json!({ SPECULAR_GLOSSINESS: { "diffuseTexture": { "index": 0, "texCoord": 1 } } });
    assert_eq!(lost(&sets, diffuse.clone()), ["the attributes TEXCOORD_0", unshown[0]]);
    diffuse.as_object_mut().unwrap().remove("emissiveTexture");
    diffuse["extensions"][SPECULAR_GLOSSINESS]["specularGlossinessTexture"] = texture.clone();
    assert_eq!(lost(&["POSITION"], diffuse), unshown);
    bright["pbrMetallicRoughness"] = json!({ "baseColorTexture": texture });
    assert_eq!(lost(&["POSITION"], bright), unshown);
}

#[test]
fn cameras_and_the_rule_change_within_the_document() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let (b, document) = rich();
    std::fs::write(at("in.gltf"), b.file(&document)).unwrap();
    let file = read_file(&at("in.gltf"), &KEEP).unwrap();
    let mut scene = file.scene;
    scene.composition.lambda = 0.25;
    assert_eq!(file.cameras.len(), 1);
    let options = WriteOptions { source: file.source.as_ref(), ..WriteOptions::default() };
    assert!(write_scene(&at("out.glb"), &scene, &options).unwrap().loss.is_none());
    let (json, _) = opened(&at("out.glb"));
    assert!(json.get("cameras").is_none() && json["nodes"][2].get("camera").is_none());
    assert_eq!(json["scenes"][0]["extensions"][HYBRID]["lambda"], 0.25);
    assert_eq!(json["scenes"][0]["extensions"]["EXT_unknown"]["of"], "scene");
    let again = read_file(&at("out.glb"), &KEEP).unwrap();
    assert_eq!((again.scene.composition, again.cameras.len()), (scene.composition, 0));
    assert_eq!(json["animations"], document["animations"]);

    // Properties of the rule that the document states and the new rule does not are removed.
    scene.composition.pixel_filter = PixelFilter { variance: 0.5, normalized: true };
    write_scene(&at("wide.glb"), &scene, &options).unwrap();
    let wide = read_file(&at("wide.glb"), &KEEP).unwrap();
    assert_eq!(wide.scene.composition, scene.composition);
    scene.composition = Composition { near: scene.composition.near, ..Composition::default() };
    let options = WriteOptions { source: wide.source.as_ref(), ..WriteOptions::default() };
    write_scene(&at("usual.glb"), &scene, &options).unwrap();
    let usual = read_file(&at("usual.glb"), &KEEP).unwrap();
    assert_eq!(usual.scene.composition, scene.composition);

    let (mut json, _) = opened(&at("wide.glb"));
    json["scenes"][0]["extensions"][HYBRID]["footprint"]["variance"] = json!(-1.0);
    json["buffers"][0]["uri"] = json!(format!("data:;base64,{}", base64::encode(&vec![0; 4096])));
    std::fs::write(at("damaged.gltf"), json.to_string()).unwrap();
    let error = read_file(&at("damaged.gltf"), &KEEP).unwrap_err().to_string();
    let place = format!("/scenes/0/extensions/{HYBRID}/footprint/variance: expected a number ≥ 0, found -1");
    assert!(error.ends_with(&place), "{error}");
}

/// In other documents the scene is written anew, which every reader accepts.
#[test]
fn a_rule_is_set_only_in_documents_that_may_have_one() {
    let folder = tempfile::tempdir().unwrap();
    let (mut b, attributes) = triangle();
    let of_splats = json!({
        "POSITION": b.floats(&[[0.0f32; 3]]),
        format!("{KHR_SPLATS}:ROTATION"): b.floats(&[[0.0f32, 0.0, 0.0, 1.0]]),
        format!("{KHR_SPLATS}:SCALE"): b.floats(&[[0.1f32; 3]]),
        format!("{KHR_SPLATS}:OPACITY"): b.floats(&[[0.7f32]]),
        format!("{KHR_SPLATS}:SH_DEGREE_0_COEF_0"): b.floats(&[[0.1f32; 3]]),
    });
    let splats = |space: &str| {
        let khr = json!({ "kernel": "ellipse", "colorSpace": space });
        json!({ "mode": 0, "attributes": of_splats, "extensions": { KHR_SPLATS: khr } })
    };
    let [srgb, linear] = ["srgb_rec709_display", "lin_rec709_display"].map(splats);
    let surface = json!({ "attributes": attributes });
    for (name, meshes, is_set) in [
        ("apart", [json!([srgb]), json!([surface])], true),
        ("spaces", [json!([srgb]), json!([linear])], false),
        ("mixed", [json!([srgb, surface]), json!([srgb])], false),
    ] {
        let document = json!({
            "meshes": meshes.map(|primitives| json!({ "primitives": primitives })),
            "nodes": [{ "mesh": 0 }, { "mesh": 1 }], "scenes": [{ "nodes": [0, 1] }], "extensionsUsed": [KHR_SPLATS],
        });
        let [path, out] = ["in", "out"].map(|place| folder.path().join(format!("{place}_{name}.gltf")));
        std::fs::write(&path, b.file(&document)).unwrap();
        let file = read_file(&path, &KEEP).unwrap();
        let source = file.source.unwrap();
        assert!(source.stands(&file.scene, &[]), "{name}: as it was");
        let mut scene = file.scene;
        scene.composition.layers = 2;
        assert_eq!(source.stands(&scene, &[]), is_set, "{name}");
        let options = WriteOptions { source: Some(&source), ..WriteOptions::default() };
        write_scene(&out, &scene, &options).unwrap();
        assert_eq!(read_file(&out, &KEEP).unwrap().scene.composition, scene.composition, "{name}");
        let findings = crate::format::validate(&out).unwrap().findings;
        let is_refused = |code: &str| ["HYBRID_MIXED_MESH", "HYBRID_COLOR_SPACE"].contains(&code);
        assert!(!findings.iter().any(|finding| is_refused(finding.code)), "{name}: {findings:?}");
    }
}

#[test]
fn files_beside_the_document_are_taken_in() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let (b, attributes) = triangle();
    ::image::RgbImage::from_pixel(2, 1, ::image::Rgb([9, 8, 7])).save(at("a b.png")).unwrap();
    let picture = std::fs::read(at("a b.png")).unwrap();
    std::fs::write(at("first.bin"), &b.bytes[..36]).unwrap();
    std::fs::write(at("second.bin"), &b.bytes[36..]).unwrap();
    let document = json!({
        "meshes": [{ "primitives": [{ "attributes": attributes, "material": 0 }] }],
        "materials": [{ "pbrMetallicRoughness": { "baseColorTexture": { "index": 0 } }, "normalTexture": { "index": 1 } }],
        "textures": [{ "source": 0 }, { "source": 1 }], "images": [{ "uri": "a%20b.png" }, { "uri": "missing.png" }],
        "buffers": [{ "uri": "first.bin", "byteLength": 36 }, { "uri": "second.bin", "byteLength": b.bytes.len() - 36 }],
        "bufferViews": [{ "buffer": 0, "byteLength": 36 }, { "buffer": 1, "byteLength": 24 }],
    });
    std::fs::write(at("in.gltf"), b.file(&document)).unwrap();
    let file = read_file(&at("in.gltf"), &KEEP).unwrap();
    let elsewhere = tempfile::tempdir().unwrap();
    let out = elsewhere.path().join("out.glb");
    let options = WriteOptions { source: file.source.as_ref(), ..WriteOptions::default() };
    let loss = write_scene(&out, &file.scene, &options).unwrap().loss;
    assert_eq!(loss.to_string(), "the picture `missing.png`, which was not found");
    let (json, buffers) = opened(&out);
    assert_eq!(buffers.len(), 1);
    assert_eq!(json["images"][1]["uri"], "missing.png", "what is not there stays a reference");
    let image = &json["images"][0];
    assert_eq!(
        (&image["mimeType"], &image["name"], image.get("uri")),
        (&json!("image/png"), &json!("a%20b.png"), None)
    );
    let view = &json["bufferViews"][image["bufferView"].as_u64().unwrap() as usize];
    let start = view["byteOffset"].as_u64().unwrap() as usize;
    assert_eq!(buffers[0][start..start + picture.len()], picture);
    assert_eq!(read_scene(&out).unwrap().meshes, file.scene.meshes);
}

#[test]
fn a_picture_that_many_images_name_is_taken_in_once() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let (b, attributes) = triangle();
    let picture = black_png(64, 64);
    std::fs::write(at("a.png"), &picture).unwrap();
    let images: Vec<Value> = ["a.png", "./a.png", "%61.png"].iter().map(|uri| json!({ "uri": uri })).collect();
    let document = json!({ "meshes": [{ "primitives": [{ "attributes": attributes }] }], "images": images });
    std::fs::write(at("in.gltf"), b.file(&document)).unwrap();
    let file = read_file(&at("in.gltf"), &KEEP).unwrap();
    let options = WriteOptions { source: file.source.as_ref(), ..WriteOptions::default() };
    write_scene(&at("out.glb"), &file.scene, &options).unwrap();
    let (json, buffers) = opened(&at("out.glb"));
    let images = json["images"].as_array().unwrap();
    assert!(images.len() == 3 && images.iter().all(|image| image["bufferView"] == images[0]["bufferView"]), "{json}");
    assert_eq!(json["bufferViews"].as_array().unwrap().len(), b.views.len() + 1);
    assert_eq!(buffers[0].windows(picture.len()).filter(|bytes| **bytes == picture).count(), 1);
}

#[test]
fn a_document_whose_file_was_written_into_is_an_error_of_that_file() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    write_scene(&at("in.glb"), &random_scene(20, 1, 1, 4), &WriteOptions::default()).unwrap();
    for out in ["out.glb", "out.gltf"] {
        let file = read_file(&at("in.glb"), &KEEP).unwrap();
        let options = WriteOptions { source: file.source.as_ref(), ..WriteOptions::default() };
        let mut bytes = std::fs::read(at("in.glb")).unwrap();
        bytes.extend([0; 4]);
        std::fs::write(at("in.glb"), &bytes).unwrap();
        let error = write_scene(&at(out), &file.scene, &options).unwrap_err().to_string();
        let named = format!("{}: cannot read: it was changed while it was in use", at("in.glb").display());
        assert!(error == named && !at(out).exists(), "{error}");
        bytes.truncate(bytes.len() - 4);
        std::fs::write(at("in.glb"), &bytes).unwrap();
    }
}

#[test]
fn without_its_bytes_a_document_does_not_stand() {
    let (b, document) = rich();
    let asset = Asset::parse(&b.file(&document), PathBuf::new()).map_err(|_| ()).unwrap();
    let (file, moving) = read::scene_and_motion(&asset, &[]).map_err(|_| ()).unwrap();
    let source = Source::new(asset, &file.scene, &file.cameras, moving, false);
    assert!(!source.stands(&file.scene, &file.cameras) && !source.remainder().is_empty());
}

/// A triangle whose material refers to the picture at `uri`.
fn pictured(uri: &str) -> (Builder, Value) {
    let (b, attributes) = triangle();
    let document = json!({
        "asset": { "version": "2.0" },
        "scenes": [{ "nodes": [0] }], "nodes": [{ "mesh": 0 }],
        "meshes": [{ "primitives": [{ "attributes": attributes, "material": 0 }] }],
        "materials": [{ "normalTexture": { "index": 0 } }],
        "textures": [{ "source": 0 }], "images": [{ "uri": uri }],
    });
    (b, document)
}

/// A missing picture is reported as lost in a copy elsewhere, also if it exists but is outside of the folder.
#[test]
fn pictures_that_were_not_found_are_lost() {
    let folder = tempfile::tempdir().unwrap();
    let inner = folder.path().join("in");
    std::fs::create_dir(&inner).unwrap();
    std::fs::write(folder.path().join("n.png"), "which nobody decodes").unwrap();
    for uri in ["../n.png", "none.png"] {
        let (b, document) = pictured(uri);
        std::fs::write(inner.join("a.gltf"), b.file(&document)).unwrap();
        let file = read_file(&inner.join("a.gltf"), &KEEP).unwrap();
        let options = WriteOptions { cameras: &file.cameras, source: file.source.as_ref(), ..WriteOptions::default() };
        let report = write_scene(&inner.join("b.glb"), &file.scene, &options).unwrap();
        assert_eq!(report.loss.document, [format!("the picture `{uri}`, which was not found")]);
        assert_eq!(opened(&inner.join("b.glb")).0["images"][0]["uri"], uri);
    }
}

/// They are written to another glTF, but not to other formats.
#[test]
fn the_copyright_and_extras_of_the_file_are_lost_elsewhere() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let (b, attributes) = triangle();
    let document = |asset: Value, scene: Value| {
        json!({
            "asset": asset, "scenes": [scene], "nodes": [{ "mesh": 0 }],
            "meshes": [{ "primitives": [{ "attributes": attributes.clone() }] }],
        })
    };
    let lost = |document: &Value, name: &str| {
        std::fs::write(at("a.gltf"), b.file(document)).unwrap();
        let file = read_file(&at("a.gltf"), &KEEP).unwrap();
        let options = WriteOptions { source: file.source.as_ref(), ..WriteOptions::default() };
        write_scene(&at(name), &file.scene, &options).unwrap().loss.document
    };
    let ours = json!({ "version": "2.0", "extras": { EXTRAS: { "psnr": 30.5 } } });
    let ours = document(ours, json!({ "nodes": [0] }));
    for name in ["b.usda", "b.xml", "b.blend.py"] {
        assert_eq!(lost(&ours, name), Vec::<String>::new(), "{name}");
    }
    let theirs = json!({ "version": "2.0", "copyright": "us" });
    let theirs = document(theirs, json!({ "nodes": [0], "extras": { "of": "scene" } }));
    assert_eq!(lost(&theirs, "b.usda"), ["the copyright", "extras of the file"]);
    for name in ["b.ply", "b.xml", "b.blend.py"] {
        assert_eq!(lost(&theirs, name), ["the copyright", "extras of the file"], "{name}");
    }
    assert_eq!(lost(&theirs, "b.glb"), Vec::<String>::new());
}

/// An unused view is not checked on reading, but counts when buffers are merged.
#[test]
fn a_view_that_begins_beyond_all_numbers_is_written_on() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let (b, document) = rich();
    let mut document: Value = serde_json::from_slice(&b.file(&document)).unwrap();
    let data = |bytes: &[u8]| format!("data:application/octet-stream;base64,{}", base64::encode(bytes));
    let mut add = |key: &str, value: Value| document[key].as_array_mut().unwrap().push(value);
    add("buffers", json!({ "byteLength": 4, "uri": data(b"abcd") }));
    add("bufferViews", json!({ "buffer": 1, "byteOffset": u64::MAX, "byteLength": 1 }));
    std::fs::write(at("a.gltf"), document.to_string()).unwrap();
    let file = read_file(&at("a.gltf"), &KEEP).unwrap();
    let options = WriteOptions { cameras: &file.cameras, source: file.source.as_ref(), ..WriteOptions::default() };
    write_scene(&at("b.glb"), &file.scene, &options).unwrap();
    assert_eq!(read_file(&at("b.glb"), &KEEP).unwrap().scene, file.scene);
}

/// The uncompressed fallback of compressed views is not copied; a buffer without data must be marked as a fallback.
#[test]
fn a_plain_form_that_is_left_out_says_that_it_is_one() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let compressed = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/meshopt/khr_float.glb");
    let (mut document, buffers) = opened(&compressed);
    let data = format!("data:application/octet-stream;base64,{}", base64::encode(&buffers[0]));
    document["buffers"][0]["uri"] = json!(data);
    let length = document["buffers"][1]["byteLength"].as_u64().unwrap() as usize;
    std::fs::write(at("plain.bin"), vec![0; length]).unwrap();
    document["buffers"][1] = json!({ "byteLength": length, "uri": "plain.bin" });
    document["extensionsRequired"] = json!(["KHR_mesh_quantization"]);
    std::fs::write(at("a.gltf"), document.to_string()).unwrap();
    let file = read_file(&at("a.gltf"), &KEEP).unwrap();
    let options = WriteOptions { cameras: &file.cameras, source: file.source.as_ref(), ..WriteOptions::default() };
    write_scene(&at("b.glb"), &file.scene, &options).unwrap();
    let (written, _) = opened(&at("b.glb"));
    let expected = json!({ "byteLength": length, "extensions": { "KHR_meshopt_compression": { "fallback": true } } });
    assert_eq!(written["buffers"][1], expected);
    assert_eq!(written["extensionsRequired"], json!(["KHR_mesh_quantization", "KHR_meshopt_compression"]));
    assert_eq!(crate::format::validate(&at("b.glb")).unwrap().findings, []);
}

/// Reads, describes and writes a file that may be damaged.
fn exercise(bytes: &[u8], folder: &Path) {
    let Ok(asset) = Asset::parse(bytes, PathBuf::new()) else { return };
    let _ = (sizes(&asset, 0), describe(&asset));
    let Ok((file, moving)) = read::scene_and_motion(&asset, &[]) else { return };
    let source = Source::new(asset, &file.scene, &file.cameras, moving, true);
    let _ = source.at(&file.scene, 0.3);
    let options = WriteOptions { source: Some(&source), ..WriteOptions::default() };
    for name in ["a.glb", "a.gltf"] {
        let _ = write_scene(&folder.join(name), &file.scene, &options);
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(400))]
    #[test]
    fn damaged_documents_do_not_panic(at: prop::sample::Index, value in fuzzed_values()) {
        let folder = tempfile::tempdir().unwrap();
        let (b, rest) = rich();
        let mut document: Value = serde_json::from_slice(&b.file(&rest)).unwrap();
        let mut found = vec![];
        leaves(&document, "", &mut found);
        let pointer: &String = at.get(&found);
        *document.pointer_mut(pointer).unwrap() = value;
        exercise(&document.to_string().into_bytes(), folder.path());
    }

    #[test]
    fn damaged_compressed_files_do_not_panic(at: prop::sample::Index, byte: u8, which in 0usize..3) {
        let folder = tempfile::tempdir().unwrap();
        let name = ["ext_quantized", "khr_float", "transform_high"][which];
        let file = Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("tests/data/meshopt/{name}.glb"));
        let mut bytes = std::fs::read(file).unwrap();
        let at = at.index(bytes.len());
        bytes[at] = byte;
        exercise(&bytes, folder.path());
    }
}
