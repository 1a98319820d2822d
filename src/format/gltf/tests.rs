use std::collections::HashMap;
use std::path::PathBuf;

use glam::{DQuat, DVec3, Vec3};
use proptest::prelude::*;
use serde_json::{Value, json};

use super::*;
use crate::format::test_scenes::{camera, random_mesh, random_scene, random_splats};
use crate::format::{FormatError, read_scene};
use crate::scene::{Composition, Intrinsics, Splats, sh};

fn bytes_of(scene: &HybridScene, cameras: &[(String, Camera)]) -> Vec<u8> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("scene.glb");
    let written = write_glb(&path, scene, cameras, Some(json!({ "psnr": 30.5 }))).unwrap();
    let bytes = std::fs::read(&path).unwrap();
    assert_eq!(written, bytes.len() as u64);
    bytes
}

fn read_bytes(bytes: &[u8]) -> Result<Content, String> {
    let asset = Asset::parse(bytes, PathBuf::new());
    asset.and_then(|asset| read::scene(&asset)).map_err(|fault| fault.in_file(Path::new("f")).to_string())
}

/// The chunks of a GLB.
fn split(glb: &[u8]) -> (Vec<u8>, &[u8]) {
    let glb::Chunks { json, bin } = glb::split(&mut std::io::Cursor::new(glb)).map_err(|_| ()).unwrap();
    (json, &glb[bin.unwrap_or_default()])
}

/// The JSON of a GLB, and the same file with other JSON.
fn json_of(glb: &[u8]) -> Value {
    serde_json::from_slice(&split(glb).0).unwrap()
}

fn with_json(glb: &[u8], json: &Value) -> Vec<u8> {
    let bin = split(glb).1;
    let mut text = json.to_string().into_bytes();
    text.resize(text.len().next_multiple_of(4), b' ');
    let [header, bin_header] = glb::headers(text.len(), bin.len()).unwrap();
    [&header, &text, &bin_header, bin].concat()
}

fn assert_close(a: &Splats, b: &Splats) {
    assert_eq!(a.means(), b.means());
    assert_eq!(a.sh_degree(), b.sh_degree());
    assert_eq!(a.sh(), b.sh());
    for i in 0..a.len() {
        assert!((a.rotations()[i] - b.rotations()[i]).length() < 2.5e-7, "normalised once more");
        // f32 has 24 bits: applying exp and ln changes s by 6e-8, plus rounding.
        assert!((a.log_scales()[i] - b.log_scales()[i]).abs().max_element() < 1e-6);
        let opacity = |s: &Splats| 1.0 / (1.0 + (-f64::from(s.opacity_logits()[i])).exp());
        assert!((opacity(a) - opacity(b)).abs() <= 1e-6 * opacity(a), "{} {}", opacity(a), opacity(b));
    }
}

#[test]
fn round_trip() {
    for seed in 0..8 {
        let scene = random_scene(20, 1 + seed as u32 % 3, seed as u32 % 4, seed);
        let cameras = vec![("IMG_01.jpg".to_owned(), camera()), ("b".to_owned(), camera().resized(320, 200))];
        let back = read_bytes(&bytes_of(&scene, &cameras)).unwrap();
        assert_eq!(back.scene.meshes, scene.meshes, "geometry, UVs and maps bit for bit");
        assert_eq!(back.scene.composition, scene.composition);
        assert_close(&scene.splats, &back.scene.splats);
        assert_eq!(back.notes, Vec::<String>::new());
        for ((name, camera), (name_back, camera_back)) in cameras.iter().zip(&back.cameras) {
            assert_eq!((name, camera.intrinsics()), (name_back, camera_back.intrinsics()));
            // `Camera::new` orthonormalises the rotation again.
            assert!(camera.rotation().abs_diff_eq(camera_back.rotation(), 1e-14));
            assert_eq!(camera.translation(), camera_back.translation());
        }
    }
}

#[test]
fn a_scene_may_leave_near_to_its_cameras_and_faces_to_one_side() {
    let mut scene = random_scene(3, 1, 0, 5);
    scene.composition.near = 0.07;
    let glb = bytes_of(&scene, &[("a".to_owned(), camera()), ("b".to_owned(), camera())]);
    let mut json = json_of(&glb);
    let contract = json["scenes"][0]["extensions"]["EXT_gaussian_splatting_hybrid"].as_object_mut().unwrap();
    assert!(contract.remove("near").is_some());
    json["cameras"][1]["perspective"]["znear"] = json!(0.05);
    json["materials"][0]["doubleSided"] = json!(false);
    let back = read_bytes(&with_json(&glb, &json)).unwrap();
    assert_eq!(back.scene.composition.near, 0.05, "the least");
    let said = "1 single-sided material is drawn from both sides: glTF hides the backs of such surfaces";
    assert_eq!(back.notes, [said]);
    json["nodes"].as_array_mut().unwrap().iter_mut().for_each(|n| drop(n.as_object_mut().unwrap().remove("camera")));
    json["cameras"] = json!([]);
    let back = read_bytes(&with_json(&glb, &json)).unwrap();
    assert_eq!(back.scene.composition.near, Composition::default().near);
}

#[test]
fn parts_may_be_absent() {
    for (splats, meshes) in [(0, 0), (0, 1), (3, 0)] {
        let scene = random_scene(splats, meshes, 0, 2);
        let bytes = bytes_of(&scene, &[]);
        let back = read_bytes(&bytes).unwrap().scene;
        assert_eq!((back.splats.len(), back.meshes.len()), (splats, meshes as usize));
        let used = json_of(&bytes)["extensionsUsed"].as_array().unwrap().len();
        assert_eq!(used, 1 + usize::from(splats > 0) + usize::from(meshes > 0));
    }
}

#[test]
fn choices_that_are_not_known_give_way_to_defaults() {
    let scene = random_scene(2, 1, 1, 2);
    let glb = bytes_of(&scene, &[]);
    let hybrid = extension::HYBRID;
    let changed = |pointer: &str, token: &str| {
        let mut json = json_of(&glb);
        *json.pointer_mut(pointer).unwrap() = json!(token);
        let file = read_bytes(&with_json(&glb, &json)).unwrap();
        let said = format!("{pointer}: ");
        assert!(file.notes.len() == 1 && file.notes[0].starts_with(&said), "{:?}", file.notes);
        (file.notes[0][said.len()..].to_owned(), file.scene)
    };
    for (key, default) in [("mode", "stable"), ("sortKey", "viewZ")] {
        let (note, found) = changed(&format!("/scenes/0/extensions/{hybrid}/{key}"), "other");
        assert_eq!(note, format!("`other` is unknown, the default {default} is used"));
        let mode = if key == "mode" { crate::scene::OrderMode::Stable } else { scene.composition.mode };
        assert_eq!(found.composition, Composition { mode, ..scene.composition });
    }
    let of_material = |key: &str| format!("/materials/0/extensions/{hybrid}/{key}");
    let (note, found) = changed(&of_material("sphericalHarmonics/frame"), "triangle");
    let expected = "triangle is read as node, which differs where the mesh is skinned, deformed, mirrored or stretched";
    assert_eq!(note, expected);
    assert_eq!(found.meshes, scene.meshes);
    for key in ["sphericalHarmonics/frame", "opacity/activation"] {
        let (note, found) = changed(&of_material(key), "other");
        assert_eq!(note, "`other` is unknown, the colour of the core material is used");
        assert_eq!((found.meshes[0].atlas().sh_degree(), scene.meshes[0].atlas().sh_degree()), (0, 1));
    }
}

#[test]
fn a_moved_root_moves_everything() {
    let scene = random_scene(5, 1, 1, 4);
    let glb = bytes_of(&scene, &[("c".to_owned(), camera())]);
    let mut json = json_of(&glb);
    let root = json["scenes"][0]["nodes"][0].as_u64().unwrap() as usize;
    json["nodes"][root]["translation"] = json!([1, 2, 3]);
    let moved = read_bytes(&with_json(&glb, &json)).unwrap();
    // y and z are negated in the frame of captures.
    let offset = Vec3::new(1.0, -2.0, -3.0);
    for (a, b) in scene.splats.means().iter().zip(moved.scene.splats.means()) {
        assert!((*a + offset - *b).length() < 1e-6);
    }
    for (a, b) in scene.meshes[0].positions().iter().zip(moved.scene.meshes[0].positions()) {
        assert!((*a + offset - *b).length() < 1e-6);
    }
    let center = moved.cameras[0].1.center() - camera().center();
    assert!(center.abs_diff_eq(offset.as_dvec3(), 1e-5), "{center}");
    assert_eq!(moved.cameras[0].1.intrinsics(), camera().intrinsics());
}

#[test]
fn a_composition_that_no_reader_takes_is_not_written() {
    let folder = tempfile::tempdir().unwrap();
    let scene = random_scene(1, 0, 0, 4);
    let composition = Composition { layers: 3, ..scene.composition };
    let path = folder.path().join("a.glb");
    let error = write_glb(&path, &HybridScene { composition, ..scene }, &[], None).unwrap_err().to_string();
    assert!(error.ends_with("layers: expected 1, 2 or 4, found 3") && !path.exists(), "{error}");
}

#[test]
fn a_lens_that_was_changed_is_taken() {
    let glb = bytes_of(&random_scene(1, 0, 0, 4), &[("c".to_owned(), camera())]);
    let k = *camera().intrinsics();
    let changed = |name: &str, value: f64| {
        let mut json = json_of(&glb);
        json["cameras"][0]["perspective"][name] = json!(value);
        read_bytes(&with_json(&glb, &json)).unwrap()
    };
    // Twice the tangent halves the focal lengths; size and principal point stay.
    let wide = *changed("yfov", 2.0 * (f64::from(k.height) / k.fy).atan()).cameras[0].1.intrinsics();
    assert!((wide.fx - 0.5 * k.fx).abs() < 1e-4 * k.fx && (wide.fy - 0.5 * k.fy).abs() < 1e-4 * k.fy, "{wide:?}");
    assert_eq!((wide.width, wide.height, wide.cx, wide.cy), (k.width, k.height, k.cx, k.cy));
    let other = changed("aspectRatio", 2.0);
    assert_eq!(other.cameras[0].1.intrinsics().width, 2160);
    assert!(
        other.notes[0].contains("whose aspect ratio differs from that of its exact intrinsics"),
        "{:?}",
        other.notes
    );
}

/// The fields listed in the extension's specification; they can be written without knowing the camera's place in the
/// capture.
#[test]
fn six_numbers_of_a_camera_are_enough() {
    let glb = bytes_of(&random_scene(1, 0, 0, 4), &[("c".to_owned(), camera())]);
    let read = |damage: &dyn Fn(&mut Value)| {
        let mut json = json_of(&glb);
        damage(&mut json["cameras"][0]["extras"][extension::EXTRAS]);
        let file = read_bytes(&with_json(&glb, &json)).unwrap();
        (file.cameras[0].1, file.notes)
    };
    let (exact, _) = read(&|_| ());
    for without in [&["rotation", "translation"][..], &["rotation"], &["translation"]] {
        let (found, notes) = read(&|own| own.as_object_mut().unwrap().retain(|key, _| !without.contains(&&key[..])));
        assert_eq!((found.intrinsics(), notes), (exact.intrinsics(), vec![]));
        // The node stores the pose in f32.
        assert!(found.rotation().abs_diff_eq(exact.rotation(), 1e-6));
        assert!(found.center().abs_diff_eq(exact.center(), 1e-5), "{} {}", found.center(), exact.center());
    }
    let said = |damage: &dyn Fn(&mut Value)| {
        let notes = read(damage).1;
        assert_eq!(notes.len(), 1, "{notes:?}");
        assert!(notes[0].contains(": a camera whose exact intrinsics cannot be read (extras/centaur"), "{notes:?}");
        notes[0].clone()
    };
    assert!(said(&|own| drop(own.as_object_mut().unwrap().remove("cx"))).contains("centaur: missing field `cx`)"));
    assert!(said(&|own| own["fy"] = json!("x")).contains("centaur/fy: invalid type: string \"x\", expected f64)"));
    assert!(said(&|own| own["rotation"] = json!([1])).contains("centaur/rotation"));
    assert!(said(&|own| *own = json!("x".repeat(1000))).len() < 300);
}

#[test]
fn pictures_are_as_wide_as_the_aspect_ratio_says() {
    let glb = bytes_of(&random_scene(1, 0, 0, 4), &[("c".to_owned(), camera())]);
    let read = |aspect: Option<f32>| {
        let mut json = json_of(&glb);
        let camera = json["cameras"][0].as_object_mut().unwrap();
        camera.remove("extras");
        camera["perspective"] = json!({ "yfov": 1.0, "znear": 0.1 });
        if let Some(aspect) = aspect {
            camera["perspective"]["aspectRatio"] = json!(aspect);
        }
        *read_bytes(&with_json(&glb, &json)).unwrap().cameras[0].1.intrinsics()
    };
    for aspect in [1.5, 1.2341, 0.777] {
        let k = read(Some(aspect));
        let expected = f64::from(k.width) / (2.0 * f64::from(aspect) * 0.5f64.tan());
        assert!((k.fx - expected).abs() < 1e-9 * expected, "{aspect}: {} {expected}", k.fx);
        assert_eq!((k.width, k.fx == k.fy), ((aspect * 1080.0).round() as u32, aspect == 1.5));
    }
    let usual = read(None);
    assert_eq!((usual.width, usual.fx), (1920, usual.fy));
    // Of an image wider than any picture may be, the middle is kept.
    let cut = read(Some(1e9));
    assert_eq!((cut.width, cut.fx), (Intrinsics::MAX_PICTURE_SIDE, cut.fy));
}

#[test]
fn cameras_too_large_to_render_are_left_out() {
    let glb = bytes_of(&random_scene(1, 0, 0, 4), &[("c".to_owned(), camera())]);
    for (width, height) in [(u32::MAX, u32::MAX), (1 << 17, 1), (1 << 15, 1 << 14)] {
        let mut json = json_of(&glb);
        let exact = &mut json["cameras"][0]["extras"][extension::EXTRAS];
        (exact["width"], exact["height"]) = (json!(width), json!(height));
        let back = read_bytes(&with_json(&glb, &json)).unwrap();
        assert!(back.cameras.is_empty());
        assert!(back.notes[0].contains(&format!("{width}×{height} pixels is empty or too large")), "{:?}", back.notes);
    }
}

#[test]
fn foreign_nodes_turn_splats_and_their_harmonics() {
    let scene = HybridScene { meshes: vec![], ..random_scene(4, 0, 3, 6) };
    let glb = bytes_of(&scene, &[]);
    let mut json = json_of(&glb);
    let turn = DQuat::from_euler(glam::EulerRot::XYZ, 0.4, 0.5, -0.6);
    json["nodes"] = json!([{ "mesh": 0, "rotation": turn.to_array(), "scale": [2, 2, 2], "translation": [1, 0, 0] }]);
    json["scenes"] = json!([{ "nodes": [0] }]);
    json["extensionsRequired"] = json!(["KHR_gaussian_splatting"]);
    let back = read_bytes(&with_json(&glb, &json)).unwrap().scene.splats;
    for i in 0..4 {
        let mean = turn * (scene.splats.means()[i].as_dvec3() * 2.0) + DVec3::X;
        assert!(back.means()[i].as_dvec3().abs_diff_eq(mean, 1e-5));
        let colour = |s: &Splats, d: DVec3| -> f64 {
            sh::basis(d.to_array()).iter().zip(s.sh_of(i)).map(|(y, c)| y * f64::from(c[0])).sum()
        };
        let d = DVec3::new(0.48, 0.6, -0.64);
        assert!((colour(&scene.splats, d) - colour(&back, turn * d)).abs() < 1e-5);
        let log_scale = scene.splats.log_scales()[i].x + 2f32.ln();
        assert!((back.log_scales()[i].x - log_scale).abs() < 2e-6);
    }
    // The volume of splats scales as that of the node, even if it stretches or mirrors.
    json["nodes"][0]["scale"] = json!([1, -3, 2]);
    let stretched = read_bytes(&with_json(&glb, &json)).unwrap().scene.splats;
    for i in 0..4 {
        let mean = turn * (scene.splats.means()[i].as_dvec3() * DVec3::new(1.0, -3.0, 2.0)) + DVec3::X;
        assert!(stretched.means()[i].as_dvec3().abs_diff_eq(mean, 1e-5));
        let volume = |s: &Splats| s.log_scales()[i].as_dvec3().element_sum();
        assert!((volume(&stretched) - volume(&scene.splats) - 6f64.ln()).abs() < 1e-5);
    }
}

/// Scaled to zero is a common way to hide.
#[test]
fn a_part_under_a_flat_transform_is_not_drawn_and_the_other_is() {
    let scene = random_scene(4, 1, 2, 6);
    let glb = bytes_of(&scene, &[]);
    for scale in [[0, 0, 0], [1, 0, 2]] {
        let read = |node: usize| {
            let mut json = json_of(&glb);
            json["nodes"][node]["scale"] = json!(scale);
            read_bytes(&with_json(&glb, &json)).unwrap()
        };
        let file = read(0);
        let expected = "/nodes/0: a mesh with view-dependent colour under a flat transform is not drawn";
        assert_eq!(file.notes, [expected]);
        assert!(file.scene.meshes[0].positions().iter().all(|p| *p == Vec3::ZERO));
        assert_eq!(file.scene.splats.means(), scene.splats.means());
        let file = read(1);
        assert_eq!(file.notes, ["/nodes/1: splats under a flat transform are not drawn"]);
        assert_eq!((file.scene.splats.len(), &file.scene.meshes), (0, &scene.meshes));
    }
}

#[test]
fn extreme_opacities_and_scales_stay_finite() {
    let one = random_splats(1, 0, 1);
    let extreme = |logit: f32, log_scale: f32| {
        let scales = vec![Vec3::splat(log_scale)];
        Splats::new(one.means().to_vec(), one.rotations().to_vec(), scales, vec![logit], 0, one.sh().to_vec()).unwrap()
    };
    for (logit, log_scale) in [(200.0, 200.0), (-200.0, -200.0)] {
        let scene =
            HybridScene { splats: extreme(logit, log_scale), meshes: vec![], composition: Composition::default() };
        let back = read_bytes(&bytes_of(&scene, &[])).unwrap();
        assert!(back.notes.is_empty());
        assert_eq!(back.scene.splats.opacity_logits()[0].signum(), logit.signum());
    }
}

#[test]
fn plain_materials_become_maps() {
    let scene = random_scene(0, 1, 2, 4);
    let glb = bytes_of(&scene, &[]);
    let mut json = json_of(&glb);
    json["materials"][0]["extensions"] = json!({ "KHR_materials_unlit": {} });
    let back = read_bytes(&with_json(&glb, &json)).unwrap();
    assert_eq!(back.notes, Vec::<String>::new(), "unlit is what maps are");
    let (maps, preview) = (scene.meshes[0].atlas().base(), back.scene.meshes[0].atlas().base());
    assert_eq!((maps.width(), maps.height()), (preview.width(), preview.height()));
    for (exact, shown) in maps.texels().chunks_exact(4).zip(preview.texels().chunks_exact(4)) {
        let rgb = |t: &[f32]| sh::rgb_from_dc([t[0], t[1], t[2]]).map(|c| c.clamp(0.0, 1.0));
        let alpha = |t: &[f32]| 1.0 / (1.0 + (-t[3]).exp());
        // Half a step of 8 bits.
        assert!(rgb(exact).iter().zip(rgb(shown)).all(|(a, b)| (a - b).abs() < 0.502 / 255.0));
        assert!((alpha(exact) - alpha(shown)).abs() < 0.502 / 255.0);
    }
}

#[test]
fn fallback_colour_is_linear_light() {
    let glb = bytes_of(&random_scene(9, 0, 0, 2), &[]);
    let asset = Asset::parse(&glb, PathBuf::new()).map_err(|_| ()).unwrap();
    let attributes = &asset.attributes[&(0, 0)];
    let colours = asset.floats::<4>(attributes["COLOR_0"]).map_err(|_| ()).unwrap();
    let dc = asset.floats::<3>(attributes["KHR_gaussian_splatting:SH_DEGREE_0_COEF_0"]).map_err(|_| ()).unwrap();
    for (colour, dc) in colours.iter().zip(dc) {
        let shown = (0.5 + 0.282_095 * dc[1]).clamp(0.0, 1.0);
        let linear = if shown <= 0.04045 { shown / 12.92 } else { ((shown + 0.055) / 1.055).powf(2.4) };
        assert!((colour[1] - linear).abs() < 1e-5, "a step of 16 bits");
    }
}

/// Validates every object of the document that has a schema; returns the number of these and the faults.
fn validate(document: &Value) -> (usize, Vec<String>) {
    // The parts of core glTF that our schemas refer to, and the requirements of KHR_gaussian_splatting on its object.
    let core = json!({
        "mesh.primitive.KHR_gaussian_splatting.schema.json": {
            "type": "object",
            "required": ["colorSpace", "kernel"],
            "properties": {
                "kernel": { "const": "ellipse" },
                "colorSpace": { "enum": ["srgb_rec709_display", "lin_rec709_display"] },
            },
        },
        "glTFProperty.schema.json": { "type": "object", "properties": { "extensions": { "type": "object" } } },
        "glTFChildOfRootProperty.schema.json": { "type": "object", "properties": { "name": { "type": "string" } } },
        "glTFid.schema.json": { "type": "integer", "minimum": 0 },
        "textureInfo.schema.json": { "type": "object", "required": ["index"] },
    });
    let mut schemas: HashMap<String, Value> = core.as_object().unwrap().clone().into_iter().collect();
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("schema/EXT_gaussian_splatting_hybrid/schema");
    for entry in folder.read_dir().unwrap() {
        let path = entry.unwrap().path();
        let schema = serde_json::from_slice(&std::fs::read(&path).unwrap()).unwrap();
        schemas.insert(path.file_name().unwrap().to_str().unwrap().to_owned(), schema);
    }
    let base = "json-schema:///";
    let resources: Vec<(String, jsonschema::Resource)> = schemas
        .iter()
        .map(|(name, schema)| {
            let mut schema = schema.clone();
            schema["$id"] = json!(format!("{base}{name}"));
            schema["$schema"] = json!("https://json-schema.org/draft/2020-12/schema");
            (format!("{base}{name}"), jsonschema::Resource::from_contents(schema))
        })
        .collect();
    let registry = jsonschema::Registry::new().extend(resources).unwrap().prepare().unwrap();
    let (mut checked, mut faults) = (0, vec![]);
    let mut check = |name: String, value: &Value| {
        let schema =
            json!({ "$schema": "https://json-schema.org/draft/2020-12/schema", "$ref": format!("{base}{name}") });
        let validator = jsonschema::options().with_registry(&registry).build(&schema).unwrap();
        checked += 1;
        faults.extend(validator.iter_errors(value).map(|e| format!("{name}{}: {e}", e.instance_path())));
    };
    let hybrid = extension::HYBRID;
    let objects = |key: &str| document[key].as_array().cloned().unwrap_or_default();
    for (kind, array) in [("scene", objects("scenes")), ("material", objects("materials"))] {
        for object in array {
            if let Some(value) = object.pointer(&format!("/extensions/{hybrid}")) {
                check(format!("{kind}.{hybrid}.schema.json"), value);
            }
        }
    }
    for primitive in objects("meshes").iter().flat_map(|m| m["primitives"].as_array().unwrap()) {
        for name in [hybrid, extension::KHR_SPLATS] {
            if let Some(value) = primitive.pointer(&format!("/extensions/{name}")) {
                check(format!("mesh.primitive.{name}.schema.json"), value);
            }
        }
    }
    (checked, faults)
}

#[test]
fn written_json_satisfies_the_schemas() {
    let document = json_of(&bytes_of(&random_scene(3, 2, 3, 1), &[]));
    let (checked, faults) = validate(&document);
    assert_eq!((checked, faults), (1 + 2 + 2 + 1, vec![]), "a scene, two materials, two surfaces, the splats");

    let mut bad = document;
    bad["scenes"][0]["extensions"][extension::HYBRID]["lambda"] = json!(-1);
    let material = &mut bad["materials"][0]["extensions"][extension::HYBRID];
    material["opacity"]["width"] = json!(0);
    material["sphericalHarmonics"]["coefficients"][0].as_object_mut().unwrap().remove("accessor");
    assert_eq!(validate(&bad).1.len(), 3, "{:?}", validate(&bad).1);
}

#[test]
fn messages_name_file_place_expected_and_found() {
    let glb = bytes_of(&random_scene(3, 1, 0, 1), &[]);
    let json = json_of(&glb);
    let message = |pointer: &str, value: Value| {
        let mut json = json.clone();
        *json.pointer_mut(pointer).unwrap() = value;
        read_bytes(&with_json(&glb, &json)).unwrap_err()
    };
    let message_of = read_bytes(&glb[..glb.len() - 8]).unwrap_err();
    assert_eq!(message_of, format!("f: byte 8: expected a file of {} bytes, found {} bytes", glb.len(), glb.len() - 8));
    let khr = "/meshes/1/primitives/0/extensions/KHR_gaussian_splatting";
    assert_eq!(
        message(&format!("{khr}/kernel"), json!("cube")),
        format!("f: {khr}/kernel: expected ellipse, found `cube`")
    );
    assert!(message("/extensionsUsed", json!(3)).contains("glTF 2.0 JSON"));
    assert!(
        message("/accessors/0/count", json!(1_000_000_000))
            .contains("/accessors/0/count: expected 1000000000 elements")
    );
    assert!(message("/meshes/0/primitives/0/attributes/POSITION", json!(99)).contains("expected an accessor below"));
    let mut required = json.clone();
    required["extensionsRequired"] = json!(["KHR_draco_mesh_compression"]);
    assert!(read_bytes(&with_json(&glb, &required)).unwrap_err().contains("found `KHR_draco_mesh_compression`"));
    assert!(read_bytes(b"{ \"asset\": ").unwrap_err().starts_with("f: byte 11: expected glTF JSON"));
    let missing = read(Path::new("/nonexistent/scene.glb"), &ReadOptions::default()).unwrap_err();
    assert!(matches!(missing, FormatError::Read { .. }), "{missing}");
}

#[test]
fn text_gltf_with_a_data_uri_and_with_an_external_buffer() {
    let scene = random_scene(3, 1, 1, 3);
    let glb = bytes_of(&scene, &[]);
    let mut json = json_of(&glb);
    let bin = split(&glb).1;
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("scene data.bin"), bin).unwrap();
    json["buffers"][0]["uri"] = json!("scene%20data.bin");
    let path = folder.path().join("scene.gltf");
    std::fs::write(&path, json.to_string()).unwrap();
    assert_eq!(read_scene(&path).unwrap().meshes, scene.meshes);
    json["buffers"][0]["uri"] = json!("../scene.bin");
    std::fs::write(&path, json.to_string()).unwrap();
    assert!(read_scene(&path).unwrap_err().to_string().contains("/buffers/0/uri: expected a path inside the folder"));
    json["buffers"][0]["uri"] = json!("data:application/octet-stream;base64,AAAA");
    std::fs::write(&path, json.to_string()).unwrap();
    assert!(read_scene(&path).unwrap_err().to_string().contains("found 3 bytes"));
}

#[test]
fn import_undoes_the_frame_and_the_seams() {
    let mesh = random_mesh(0, 3);
    let scene =
        HybridScene { splats: Splats::empty(0), meshes: vec![mesh.clone()], composition: Composition::default() };
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("scene.glb");
    write_glb(&path, &scene, &[], None).unwrap();
    let imported = crate::format::mesh_import::read(&path).unwrap();
    assert!(!imported.y_up);
    assert_eq!(imported.corner_uvs.unwrap(), mesh.corner_uvs());
    assert_eq!(imported.positions.len(), 4, "of six, one is of no triangle and two are in one place");
    for (a, b) in imported.triangles.iter().zip(mesh.triangles()) {
        assert_eq!(a.map(|v| imported.positions[v as usize]), b.map(|v| mesh.positions()[v as usize]));
    }
}

/// Pointers to all values in a document that are neither objects nor arrays.
pub(super) fn leaves(value: &Value, pointer: &str, found: &mut Vec<String>) {
    match value {
        Value::Object(map) => map.iter().for_each(|(k, v)| leaves(v, &format!("{pointer}/{k}"), found)),
        Value::Array(array) => array.iter().enumerate().for_each(|(i, v)| leaves(v, &format!("{pointer}/{i}"), found)),
        _ => found.push(pointer.to_owned()),
    }
}

pub(super) fn fuzzed_values() -> impl Strategy<Value = Value> {
    prop_oneof![
        any::<u8>().prop_map(|n| json!(n)),
        any::<u64>().prop_map(|n| json!(n)),
        any::<f64>().prop_map(|n| json!(n)),
        Just(json!(null)),
        Just(json!("")),
        Just(json!([])),
        Just(json!({})),
        Just(json!(-1)),
        Just(json!(u32::MAX)),
    ]
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(600))]
    #[test]
    fn damaged_json_does_not_panic(at: prop::sample::Index, value in fuzzed_values()) {
        let glb = bytes_of(&random_scene(2, 1, 1, 1), &[("c".to_owned(), camera())]);
        let mut json = json_of(&glb);
        let mut found = vec![];
        leaves(&json, "", &mut found);
        let pointer: &String = at.get(&found);
        *json.pointer_mut(pointer).unwrap() = value;
        let damaged = with_json(&glb, &json);
        let _ = read_bytes(&damaged);
        if let Ok(asset) = Asset::parse(&damaged, PathBuf::new()) {
            let _ = sizes(&asset, 0);
        }
    }

    #[test]
    fn damaged_bytes_do_not_panic(cut: prop::sample::Index, at: prop::sample::Index, byte: u8) {
        let mut glb = bytes_of(&random_scene(2, 1, 0, 1), &[]);
        let at = at.index(glb.len());
        glb[at] = byte;
        let _ = read_bytes(&glb);
        glb.truncate(cut.index(glb.len()));
        prop_assert!(read_bytes(&glb).is_err());
    }
}
