//! Hand-written splat primitives as other programs write them.

use glam::{Quat, Vec3};
use serde_json::{Value, json};

use super::core_tests::{Builder, near};
use super::remainder::remainder;
use crate::format::activation;
use crate::scene::sh;

/// A primitive of two splats, and its attributes by name.
pub(super) fn splats(quantized: bool) -> (Builder, serde_json::Map<String, Value>) {
    let mut b = Builder::default();
    let mut attributes = serde_json::Map::new();
    let mut add = |name: &str, index: usize| attributes.insert(name.to_owned(), json!(index));
    add("POSITION", b.floats(&[[0.0f32, 0.0, 0.0], [1.0, 2.0, 3.0]]));
    let khr = |name: &str| format!("KHR_gaussian_splatting:{name}");
    if quantized {
        add(&khr("ROTATION"), b.normalized(5120, "VEC4", 2, &[0, 0, 0, 127, 90, 0, 0, 90]));
        add(&khr("SCALE"), b.accessor(5121, "VEC3", 2, &[1, 2, 3, 0, 4, 5, 6, 0]));
        b.views[2]["byteStride"] = json!(4);
        add(&khr("OPACITY"), b.normalized(5123, "SCALAR", 2, &[0xFF, 0x3F, 0xFF, 0xBF]));
    } else {
        add(&khr("ROTATION"), b.floats(&[[0.0f32, 0.0, 0.0, 1.0], [0.6, 0.0, 0.0, 0.8]]));
        add(&khr("SCALE"), b.floats(&[[1.0f32, 2.0, 3.0], [4.0, 5.0, 6.0]]));
        add(&khr("OPACITY"), b.floats(&[[0.25f32], [0.75]]));
    }
    add(&khr("SH_DEGREE_0_COEF_0"), b.floats(&[[0.1f32, 0.2, 0.3], [0.4, 0.5, 0.6]]));
    (b, attributes)
}

#[expect(clippy::needless_pass_by_value, reason = "documents are written where they are read")]
pub(super) fn splat_document(attributes: &serde_json::Map<String, Value>, khr: Value) -> Value {
    json!({
        "meshes": [{ "primitives": [{ "mode": 0, "attributes": attributes, "extensions": { "KHR_gaussian_splatting": khr } }] }],
        "extensionsUsed": ["KHR_gaussian_splatting"],
    })
}

pub(super) fn khr() -> Value {
    json!({ "kernel": "ellipse", "colorSpace": "srgb_rec709_display" })
}

#[test]
fn quantised_splats() {
    for quantized in [false, true] {
        let (b, attributes) = splats(quantized);
        let found = b.read(splat_document(&attributes, khr())).unwrap().scene.splats;
        let scales: Vec<f32> = found.log_scales().iter().flat_map(|s| s.to_array().map(f32::exp)).collect();
        near(&scales, &[1.0, 2.0, 3.0, 4.0, 5.0, 6.0], 1e-5);
        let opacities: Vec<f32> = found.opacity_logits().iter().map(|l| activation::opacity(*l)).collect();
        near(&opacities, &[0.25, 0.75], 1.0 / 65535.0);
        let turned = if quantized {
            Quat::from_xyzw(1.0, 0.0, 0.0, 1.0).normalize()
        } else {
            Quat::from_xyzw(0.6, 0.0, 0.0, 0.8)
        };
        near(&found.rotations()[1].to_array(), &turned.to_array(), 1e-6);
        assert_eq!(found.rotations()[0], Quat::IDENTITY);
    }
}

/// Splats with an unknown kernel or projection must not be rendered with another one.
#[test]
fn unknown_kernels_and_projections_are_refused() {
    let (b, attributes) = splats(false);
    for (key, known) in [("kernel", "ellipse"), ("projection", "perspective")] {
        let mut of = khr();
        of[key] = json!(known);
        b.read(splat_document(&attributes, of.clone())).unwrap();
        of[key] = json!("other");
        let message = b.read(splat_document(&attributes, of)).unwrap_err();
        assert!(message.contains(&format!("/{key}: expected {known}, found `other`")), "{message}");
    }
}

#[test]
fn splats_of_early_drafts() {
    // Like Cesium's sample: `_SCALE`, `_ROTATION`, a colour in place of coefficient 0 and opacity, and no kernel.
    let (mut b, full) = splats(false);
    let colour = b.normalized(5121, "VEC4", 2, &[255, 51, 0, 51, 0, 0, 0, 255]);
    let attribute = |name: &str| full[&format!("KHR_gaussian_splatting:{name}")].clone();
    let old = json!({ "POSITION": full["POSITION"], "_SCALE": attribute("SCALE"), "_ROTATION": attribute("ROTATION"), "COLOR_0": colour });
    let file = b.read(splat_document(old.as_object().unwrap(), json!({}))).unwrap();
    assert!(file.notes[0].contains("for a draft of the extension"), "{:?}", file.notes);
    near(&sh::rgb_from_dc(file.scene.splats.sh_of(0)[0]), &[1.0, 0.2, 0.0], 1e-6);
    assert!((activation::opacity(file.scene.splats.opacity_logits()[0]) - 0.2).abs() < 1e-6);
    let left_out = |attributes: &Value, khr: Value| {
        let mut document = splat_document(attributes.as_object().unwrap(), khr);
        document["asset"] = json!({ "version": "2.0" });
        remainder(&document, false).into_iter().map(|part| part.what).collect::<Vec<_>>()
    };
    assert_eq!(left_out(&old, json!({})), Vec::<String>::new(), "what is read is not lost");
    assert_eq!(left_out(&old, khr()), ["the attributes _ROTATION, _SCALE"]);
    let mut both = old.clone();
    both["KHR_gaussian_splatting:SCALE"] = old["_SCALE"].clone();
    both["_LABEL"] = old["_SCALE"].clone();
    assert_eq!(left_out(&both, json!({})), ["the attributes _LABEL, _SCALE"]);
    // With a kernel the old names are not accepted.
    let message = b.read(splat_document(old.as_object().unwrap(), khr())).unwrap_err();
    assert!(message.contains("expected the attribute `KHR_gaussian_splatting:ROTATION`"), "{message}");
}

#[test]
fn splats_within_spz() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.spz");
    let scene = crate::format::test_scenes::random_splats(5, 1, 3);
    for version in [crate::format::spz::Version::V2, crate::format::spz::Version::V3, crate::format::spz::Version::V4] {
        let options = crate::format::spz::Options { version, ..Default::default() };
        crate::format::spz::write(&path, &scene, &options).unwrap();
        let plain = crate::format::spz::read(&path, &crate::format::ReadOptions::default()).unwrap().splats;
        let mut b = Builder::default();
        let view = b.view(&std::fs::read(&path).unwrap());
        // Accessors describe the decompressed content, and have no data.
        b.accessors =
            vec![json!({ "componentType": 5126, "type": "VEC3", "count": 5, "min": [0, 0, 0], "max": [1, 1, 1] })];
        let attributes = json!({ "POSITION": 0 });
        let mut khr = khr();
        khr["extensions"] = json!({ "KHR_gaussian_splatting_compression_spz_2": { "bufferView": view } });
        let document = |khr: &Value| {
            let mut document = splat_document(attributes.as_object().unwrap(), khr.clone());
            document["extensionsRequired"] = json!(["KHR_gaussian_splatting_compression_spz_2"]);
            document
        };
        let found = b.read(document(&khr)).unwrap().scene.splats;
        // Captures are right, down, front; glTF's splats are left, up, front.
        for (a, b) in plain.means().iter().zip(found.means()) {
            assert_eq!(*b, *a * Vec3::new(-1.0, -1.0, 1.0));
        }
        near(found.log_scales()[0].as_ref(), plain.log_scales()[0].as_ref(), 0.0);
        // Harmonics of band 1 transform like −y, z, −x.
        for k in 0..3 {
            let [y, z, x] = [1, 2, 3].map(|c| plain.sh_of(2)[c][k]);
            near(&[1, 2, 3].map(|c| found.sh_of(2)[c][k]), &[-y, z, -x], 1e-6);
        }
        // The compressed stream contains the positions as well.
        let mut bare = document(&khr);
        bare["meshes"][0]["primitives"][0]["attributes"] = json!({});
        assert_eq!(b.read(bare).unwrap().scene.splats, found);
        let mut wrong = b;
        wrong.accessors[0]["count"] = json!(6);
        assert!(wrong.read(document(&khr)).unwrap_err().contains("expected 6 splats, as in POSITION, found 5"));
        khr["extensions"]["KHR_gaussian_splatting_compression_spz_2"]["bufferView"] = json!(9);
        assert!(
            wrong.read(document(&khr)).unwrap_err().contains("/bufferView: expected a bufferView below 1, found 9")
        );
    }
}

#[test]
fn primitives_of_several_meshes_and_degrees_become_one() {
    let (mut b, first) = splats(false);
    let mut second = first.clone();
    for m in 0..3 {
        let harmonics = b.floats(&[[m as f32, 0.0, 0.0], [0.0, m as f32, 0.5]]);
        second.insert(format!("KHR_gaussian_splatting:SH_DEGREE_1_COEF_{m}"), json!(harmonics));
    }
    let primitive = |attributes: &serde_json::Map<String, Value>| json!({ "mode": 0, "attributes": attributes, "extensions": { "KHR_gaussian_splatting": khr() } });
    let document = |second: &serde_json::Map<String, Value>| {
        json!({
            "meshes": [{ "primitives": [primitive(&first), primitive(second)] }, { "primitives": [primitive(second)] }],
            "nodes": [{ "mesh": 0, "children": [1] }, { "mesh": 1, "translation": [10, 0, 0], "scale": [2, 2, 2] }],
            "extensionsUsed": ["KHR_gaussian_splatting"],
        })
    };
    let found = b.read(document(&second)).unwrap().scene.splats;
    assert_eq!((found.len(), found.sh_degree()), (6, 1));
    assert_eq!(found.sh_of(0)[1..], [[0.0; 3]; 3], "a lower degree is filled up");
    assert_eq!(found.sh_of(3)[1..], [[0.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 2.0, 0.5]]);
    assert_eq!(found.means()[5], Vec3::new(12.0, 4.0, 6.0));
    near(&[found.log_scales()[4].x.exp()], &[2.0], 1e-6);
    // A degree must be complete.
    second.remove("KHR_gaussian_splatting:SH_DEGREE_1_COEF_2");
    let message = b.read(document(&second)).unwrap_err();
    assert_eq!(
        message,
        "f: /meshes/0/primitives/1/attributes: expected complete SH degrees from 0 to at most 3, found 3 SH attributes"
    );
}

#[test]
fn colour_spaces_differ_where_the_scene_states_none() {
    let (b, attributes) = splats(false);
    let primitive = |space: &str| {
        let khr = json!({ "kernel": "ellipse", "colorSpace": space });
        json!({ "mode": 0, "attributes": attributes, "extensions": { "KHR_gaussian_splatting": khr } })
    };
    let read = |scene: Value| {
        b.read(json!({
            "meshes": [{ "primitives": [primitive("lin_rec709_display"), primitive("srgb_rec709_display")] }],
            "scenes": [{ "nodes": [0], "extensions": scene }],
        }))
    };
    let file = read(json!({})).unwrap();
    assert_eq!(file.scene.composition.color_space.name(), "lin_rec709_display");
    let said =
        "/meshes/0/primitives/1/extensions/KHR_gaussian_splatting: blended in the colour space of the first splats";
    assert_eq!((file.scene.splats.len(), &file.notes[..]), (4, &[said.to_owned()][..]));
    let refused = read(json!({ "EXT_gaussian_splatting_hybrid": { "colorSpace": "lin_rec709_display" } })).unwrap_err();
    assert!(
        refused.contains("primitives/1") && refused.contains("expected lin_rec709_display throughout"),
        "{refused}"
    );
}

#[test]
fn indices_of_splats_are_ignored_and_said() {
    let (mut b, attributes) = splats(false);
    let indices = b.accessor(5121, "SCALAR", 1, &[1]);
    let mut document = splat_document(&attributes, khr());
    document["meshes"][0]["primitives"][0]["indices"] = json!(indices);
    let file = b.read(document).unwrap();
    let said = "/meshes/0/primitives/0/indices: ignored: every splat of the attributes is shown once";
    assert_eq!((file.scene.splats.len(), &file.notes[..]), (2, &[said.to_owned()][..]));
}

/// An unknown compression extension provides the content that the accessors describe.
#[test]
fn splats_without_data_are_refused_beside_what_is_unknown() {
    let (mut b, attributes) = splats(false);
    let mut of = khr();
    of["extensions"] = json!({ "OTHER_compression": {} });
    assert!(
        b.read(splat_document(&attributes, of.clone())).unwrap().notes[0].contains("`OTHER_compression` is unknown")
    );
    let position = usize::try_from(attributes["POSITION"].as_u64().unwrap()).unwrap();
    b.accessors[position].as_object_mut().unwrap().remove("bufferView");
    let message = b.read(splat_document(&attributes, of)).unwrap_err();
    assert!(message.ends_with("found accessors without data beside `OTHER_compression`"), "{message}");
    assert_eq!(b.read(splat_document(&attributes, khr())).unwrap().scene.splats.means(), [Vec3::ZERO; 2]);
}
