mod core;
mod hybrid;
mod splats;
mod text;

use std::path::Path;

use proptest::prelude::*;
use serde_json::{Value, json};

use super::super::{Finding, Findings, Severity, validate};
use super::*;
use crate::format::error::Location;
use crate::format::gltf::write_glb;
use crate::format::test_scenes::{camera, random_scene};
use crate::scene::HybridScene;

/// A document and its only buffer.
#[derive(Clone)]
struct File {
    json: Value,
    bin: Vec<u8>,
}

const FLOAT: u32 = 5126;
const U16: u32 = 5123;
const U32: u32 = 5125;
const HYBRID: &str = crate::format::gltf::extension::HYBRID;

impl File {
    fn of(scene: &HybridScene) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("s.glb");
        write_glb(&path, scene, &[("c".to_owned(), camera())], None).unwrap();
        let bytes = std::fs::read(&path).unwrap();
        let mut findings = Findings::default();
        let parts = container::open(&bytes, &mut findings).unwrap();
        assert!(findings.0.is_empty());
        Self { json: parts.root, bin: parts.bin.unwrap_or_default().to_vec() }
    }

    /// Adds an accessor of tightly packed values with a view of its own; returns its index.
    fn accessor(&mut self, kind: &str, component: u32, values: &[f64]) -> usize {
        self.bin.resize(self.bin.len().next_multiple_of(4), 0);
        let start = self.bin.len();
        for &v in values {
            match component {
                FLOAT => self.bin.extend((v as f32).to_le_bytes()),
                U32 => self.bin.extend((v as u32).to_le_bytes()),
                _ => self.bin.extend((v as u16).to_le_bytes()),
            }
        }
        let length = self.bin.len() - start;
        let view = self.push("bufferViews", json!({ "buffer": 0, "byteOffset": start, "byteLength": length }));
        self.json["buffers"][0]["byteLength"] = json!(self.bin.len());
        let count = values.len() / document::components(kind).unwrap();
        let accessor = json!({ "bufferView": view, "componentType": component, "type": kind, "count": count });
        self.push("accessors", accessor)
    }

    fn floats(&mut self, kind: &str, values: &[f64]) -> usize {
        self.accessor(kind, FLOAT, values)
    }

    fn push(&mut self, array: &str, object: Value) -> usize {
        if self.json.get(array).is_none() {
            self.json[array] = json!([]);
        }
        let array = self.json[array].as_array_mut().unwrap();
        array.push(object);
        array.len() - 1
    }

    fn glb(&self) -> Vec<u8> {
        let mut text = self.json.to_string().into_bytes();
        text.resize(text.len().next_multiple_of(4), b' ');
        let mut bin = self.bin.clone();
        bin.resize(bin.len().next_multiple_of(4), 0);
        let mut glb = b"glTF".to_vec();
        let word = |glb: &mut Vec<u8>, n: usize| glb.extend((n as u32).to_le_bytes());
        word(&mut glb, 2);
        word(&mut glb, 28 + text.len() + bin.len());
        for (content, kind) in [(text, b"JSON"), (bin, b"BIN\0")] {
            word(&mut glb, content.len());
            glb.extend(kind);
            glb.extend(content);
        }
        glb
    }

    fn findings(&self) -> Vec<Finding> {
        check_bytes(&self.glb())
    }

    /// Codes of the broken rules.
    fn codes(&self) -> Vec<&'static str> {
        self.findings().iter().map(|finding| finding.code).collect()
    }

    /// The bytes of element `i` of an accessor.
    fn element(&mut self, accessor: usize, i: usize, size: usize) -> &mut [u8] {
        let view = self.json["accessors"][accessor]["bufferView"].as_u64().unwrap() as usize;
        let start = self.json["bufferViews"][view]["byteOffset"].as_u64().unwrap() as usize;
        &mut self.bin[start + i * size..][..size]
    }

    fn set_float(&mut self, accessor: usize, i: usize, components: usize, value: f32) {
        self.element(accessor, i, 4 * components)[..4].copy_from_slice(&value.to_le_bytes());
    }

    fn attribute(&self, mesh: usize, name: &str) -> usize {
        self.json["meshes"][mesh]["primitives"][0]["attributes"][name].as_u64().unwrap() as usize
    }
}

fn check_bytes(bytes: &[u8]) -> Vec<Finding> {
    let mut findings = Findings::default();
    check(bytes, Path::new("/nonexistent"), &mut findings);
    findings.0
}

const KHR: &str = "KHR_gaussian_splatting";
/// Indices of the mesh and of the splats in `meshes`.
const SURFACE: usize = 0;
const SPLATS: usize = 1;

/// A scene with a mesh, splats and a camera as written by Centaur, with everything else that the rules cover.
fn everything() -> File {
    let mut file = File::of(&random_scene(6, 1, 1, 4));
    let identity = [1., 0., 0., 0., 0., 1., 0., 0., 0., 0., 1., 0., 0., 0., 0., 1.];
    let vertices = file.json["accessors"][file.attribute(SURFACE, "POSITION")]["count"].as_u64().unwrap() as usize;
    let triangles = file.json["meshes"][SURFACE]["primitives"][0]["indices"].as_u64().unwrap() as usize;
    let triangles = file.json["accessors"][triangles]["count"].as_u64().unwrap() / 3;

    // A skin, an animation and a sparse accessor of core glTF.
    let matrices = file.floats("MAT4", &identity);
    file.push("skins", json!({ "joints": [0], "inverseBindMatrices": matrices }));
    let times = file.floats("SCALAR", &[0.0, 0.5, 2.0]);
    file.json["accessors"][times]["min"] = json!([0]);
    file.json["accessors"][times]["max"] = json!([2]);
    let turns = file.floats("VEC4", &[0., 0., 0., 1.].repeat(3));
    file.push(
        "animations",
        json!({
            "samplers": [{ "input": times, "output": turns }],
            "channels": [{ "sampler": 0, "target": { "node": 0, "path": "rotation" } }],
        }),
    );
    let (places, values) = (file.accessor("SCALAR", U16, &[1.0, 4.0]), file.floats("SCALAR", &[7.0, 8.0]));
    let sparse = file.floats("SCALAR", &[0.0; 6]);
    let view = |accessor: usize| file.json["accessors"][accessor]["bufferView"].clone();
    let parts = json!({
        "count": 2,
        "indices": { "bufferView": view(places), "componentType": U16 },
        "values": { "bufferView": view(values) },
    });
    file.json["accessors"][sparse]["sparse"] = parts;
    file.json["accessors"][sparse]["max"] = json!([8.0]);

    // Animated vertices, bound splats and a deformation field.
    let key_times = file.floats("SCALAR", &[0.0, 1.0]);
    let moved = file.floats("VEC3", &vec![0.1; 2 * 3 * vertices]);
    let surface = &mut file.json["meshes"][SURFACE]["primitives"][0]["extensions"][HYBRID];
    surface["times"] = json!(key_times);
    surface["translations"] = json!(moved);
    let binding = json!({
        "node": 0, "triangleCount": triangles, "geometryDigest": digest(&mut file),
        "triangles": file.accessor("SCALAR", U32, &[0., 1., 2., 3., 1., 0.]),
        "translations": file.floats("VEC3", &[0.0; 18]),
        "rotations": file.floats("VEC4", &[0., 0., 0., 1.].repeat(6)),
        "scales": file.floats("VEC3", &[0.1; 18]),
    });
    let khr = &mut file.json["meshes"][SPLATS]["primitives"][0]["extensions"][KHR];
    khr["extensions"] = json!({ HYBRID: { "binding": binding, "deformation": 0 } });
    let plane = |file: &mut File, n: usize| file.floats("SCALAR", &vec![0.5; n]);
    let planes: Vec<usize> = [2 * 3, 2 * 4, 2 * 5, 3 * 4, 3 * 5, 4 * 5].map(|n| plane(&mut file, 2 * n)).to_vec();
    let mut layer = |inputs: usize, outputs: usize| {
        json!({
            "inputs": inputs, "outputs": outputs,
            "weights": plane(&mut file, inputs * outputs), "bias": plane(&mut file, outputs),
        })
    };
    let (trunk, head, turn) = (layer(2, 8), layer(8, 3), layer(8, 4));
    file.json["extensions"] = json!({ HYBRID: { "deformationFields": [{
        "type": "hexplane", "features": 2,
        "coordinateOffset": [0, 0, 0, 0], "coordinateScale": [1, 1, 1, 1],
        "levels": [{ "resolution": [2, 3, 4, 5], "planes": planes }],
        "trunk": [trunk], "heads": { "translation": [head], "rotation": [turn] },
    }] } });
    file
}

/// Digest of the mesh's triangles.
fn digest(file: &mut File) -> String {
    let position = file.attribute(SURFACE, "POSITION");
    let indices = file.json["meshes"][SURFACE]["primitives"][0]["indices"].as_u64().unwrap() as usize;
    let count = file.json["accessors"][indices]["count"].as_u64().unwrap() as usize;
    let indices: Vec<u32> = bytemuck::pod_collect_to_vec(file.element(indices, 0, 4 * count));
    let corner = |i: &u32| bytemuck::pod_read_unaligned(file.element(position, *i as usize, 12));
    binding::geometry_digest(&indices.iter().map(corner).collect::<Vec<[f32; 3]>>())
}

#[test]
fn what_we_write_is_faultless() {
    for (splats, meshes) in [(0, 0), (0, 1), (3, 0), (9, 2)] {
        for seed in 0..6 {
            let findings = File::of(&random_scene(splats, meshes, seed as u32 % 4, seed)).findings();
            assert!(findings.is_empty(), "{splats} {meshes} {seed}: {findings:?}");
        }
    }
    let findings = everything().findings();
    assert!(findings.is_empty(), "{findings:?}");
}

/// A planted fault: its code, the end of the place where it is found, and the change.
type Planted = (&'static str, &'static str, fn(&mut File));

fn primitive(file: &mut File, mesh: usize) -> &mut Value {
    &mut file.json["meshes"][mesh]["primitives"][0]
}

/// The node that holds a mesh.
fn node_of(file: &mut File, mesh: usize) -> &mut Value {
    let nodes = file.json["nodes"].as_array_mut().unwrap();
    nodes.iter_mut().find(|node| node["mesh"] == json!(mesh)).unwrap()
}

/// The node that holds the surface.
fn surface_node(file: &mut File) -> &mut Value {
    node_of(file, SURFACE)
}

/// Adds instances of a mesh.
fn copied(file: &mut File, mesh: usize, attributes: &Value) {
    declare(file, "EXT_mesh_gpu_instancing");
    node_of(file, mesh)["extensions"] = json!({ "EXT_mesh_gpu_instancing": { "attributes": attributes } });
}

/// Animates a property by its JSON pointer.
fn pointed(file: &mut File, pointer: &str) {
    declare(file, "KHR_animation_pointer");
    let target = json!({ "path": "pointer", "extensions": { "KHR_animation_pointer": { "pointer": pointer } } });
    file.json["animations"][0]["channels"][0]["target"] = target;
}

/// Binds all vertices of the surface to one joint of the skin.
fn skinned(file: &mut File, joint: f64, weight: f64) {
    let position = primitive(file, SURFACE)["attributes"]["POSITION"].as_u64().unwrap() as usize;
    let count = file.json["accessors"][position]["count"].as_u64().unwrap() as usize;
    let joints = file.accessor("VEC4", U16, &[joint, 0.0, 0.0, 0.0].repeat(count));
    let weights = file.floats("VEC4", &[weight, 0.0, 0.0, 0.0].repeat(count));
    primitive(file, SURFACE)["attributes"]["JOINTS_0"] = json!(joints);
    primitive(file, SURFACE)["attributes"]["WEIGHTS_0"] = json!(weights);
    surface_node(file)["skin"] = json!(0);
}

fn binding(file: &mut File) -> &mut Value {
    &mut primitive(file, SPLATS)["extensions"][KHR]["extensions"][HYBRID]["binding"]
}

fn declare(file: &mut File, extension: &str) {
    file.json["extensionsUsed"].as_array_mut().unwrap().push(json!(extension));
}

#[test]
fn every_planted_fault_is_found_at_its_place() {
    let whole = everything();
    let planted = core::PLANTED.iter().chain(splats::PLANTED).chain(hybrid::PLANTED);
    for (number, (code, place, plant)) in planted.enumerate() {
        let mut file = whole.clone();
        plant(&mut file);
        let findings = file.findings();
        let is_it = |f: &Finding| {
            let Location::Pointer(at) = &f.location else { return false };
            f.code == *code && (at.ends_with(place) || at.contains(place) && place.ends_with('/'))
        };
        let all: Vec<String> = findings.iter().map(ToString::to_string).collect();
        assert!(findings.iter().any(is_it), "{number} {code} at …{place}: {all:#?}");
    }
}

#[test]
fn unknown_properties_are_warnings_with_their_name() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.glb");
    let mut file = everything();
    let contract = &mut file.json["scenes"][0]["extensions"][HYBRID];
    contract["lam\nda"] = json!(0.1);
    contract["extras"] = json!({ "anything": 1 });
    std::fs::write(&path, file.glb()).unwrap();
    let found = validate(&path).unwrap();
    assert_eq!((found.errors, found.warnings), (0, 1), "{found}");
    let line = found.findings[0].to_string();
    assert!(line.ends_with("mode, near, sortKey, found `lam\\nda`"), "{line}");
    let warnings = crate::format::inspect(&path).unwrap().warnings;
    let expected = format!("/scenes/0/extensions/{HYBRID}: `lam\\nda` is no property of {HYBRID} and is ignored");
    assert!(warnings.contains(&expected), "{warnings:?}");
}

#[test]
fn containers() {
    let glb = everything().glb();
    let codes = |bytes: &[u8]| -> Vec<(&'static str, Location)> {
        check_bytes(bytes).into_iter().map(|f| (f.code, f.location)).collect()
    };
    let patched = |at: usize, word: u32| {
        let mut glb = glb.clone();
        glb[at..at + 4].copy_from_slice(&word.to_le_bytes());
        glb
    };
    assert_eq!(codes(&glb), []);
    assert_eq!(codes(b"glTF"), [("GLB_HEADER", Location::Byte(0))]);
    assert_eq!(codes(&patched(4, 1)), [("GLB_VERSION", Location::Byte(4))]);
    assert_eq!(codes(&patched(8, 7)), [("GLB_LENGTH", Location::Byte(8))]);
    assert!(codes(&patched(12, 1 << 30)).contains(&("GLB_CHUNK_LENGTH", Location::Byte(12))));
    assert!(codes(&patched(16, 7)).contains(&("GLB_CHUNK_ORDER", Location::Byte(16))));
    let json_length = u32::from_le_bytes(*glb[12..].first_chunk().unwrap());
    assert!(codes(&patched(12, json_length - 2)).contains(&("GLB_CHUNK_ALIGNMENT", Location::Byte(12))));
    let bin = 20 + json_length as usize;
    assert_eq!(codes(&patched(bin + 4, 7))[0], ("GLB_CHUNK_TYPE", Location::Byte(bin as u64 + 4)));
    assert!(codes(&[&glb[..], &[0; 3]].concat()).contains(&("GLB_CHUNK_HEADER", Location::Byte(glb.len() as u64))));
    assert_eq!(codes(b"{ \"asset\": \n nonsense"), [("JSON_SYNTAX", Location::Byte(15))]);
    assert_eq!(codes(b" [1]"), [("JSON_SYNTAX", Location::Byte(0))]);
    let only_json = br#"{ "asset": { "version": "2.0" }, "extras": { "extensions": { "NONE": 3 } } }"#;
    assert_eq!(codes(only_json), []);
    let unused = File { json: json!({ "asset": { "version": "2.0" } }), bin: vec![1; 4] };
    assert_eq!(unused.findings()[0].code, "BUFFER_UNUSED");
}

#[test]
fn the_verdict_counts_and_prints() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("s.glb");
    let mut file = everything();
    primitive(&mut file, SPLATS)["mode"] = json!(4);
    file.json["materials"][0]["alphaMode"] = json!("OPAQUE");
    std::fs::write(&path, file.glb()).unwrap();
    let validation = validate(&path).unwrap();
    let of = |severity| validation.findings.iter().filter(|f| f.severity == severity).count();
    assert_eq!((validation.errors, validation.warnings), (of(Severity::Error), of(Severity::Warning)));
    assert_eq!((validation.format, validation.warnings), ("glTF", 1));
    let line = "error SPLAT_MODE: /meshes/1/primitives/0/mode: expected 0 (POINTS), found 4\n";
    assert!(validation.to_string().contains(line), "{validation}");
    let json = serde_json::to_value(&validation).unwrap();
    let finding = json["findings"].as_array().unwrap().iter().find(|f| f["code"] == "SPLAT_MODE").unwrap();
    assert_eq!(finding["severity"], "error");
    assert_eq!(finding["location"], json!({ "pointer": "/meshes/1/primitives/0/mode" }));
    std::fs::write(&path, b"PK\x03\x04").unwrap();
    let zip = validate(&path).unwrap();
    assert_eq!((zip.format, zip.errors, zip.findings[0].code), ("SOG", 1, "CONTENT"));
    std::fs::write(&path, b"nothing").unwrap();
    assert!(validate(&path).is_err() && validate(Path::new("/nonexistent")).is_err());
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(300))]
    #[test]
    fn damaged_files_do_not_panic(cut: prop::sample::Index, hits in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..8), short: bool) {
        use std::sync::LazyLock;
        static GLB: LazyLock<Vec<u8>> = LazyLock::new(|| everything().glb());
        let mut glb = GLB.clone();
        for (at, byte) in hits {
            let at = at.index(glb.len());
            glb[at] = byte;
        }
        if short {
            glb.truncate(cut.index(glb.len()));
        }
        check_bytes(&glb);
    }

    #[test]
    fn odd_values_do_not_panic(places in prop::collection::vec((any::<prop::sample::Index>(), 0usize..9), 1..4)) {
        use std::sync::LazyLock;
        static FILE: LazyLock<File> = LazyLock::new(everything);
        let mut file = FILE.clone();
        let odd = [json!(null), json!(-1), json!(u64::MAX), json!(1e300), json!("x"), json!([]), json!({}), json!(true), json!(0)];
        for (place, value) in places {
            let mut pointers = vec![];
            collect(&file.json, String::new(), &mut pointers);
            let pointer = &pointers[place.index(pointers.len())];
            *file.json.pointer_mut(pointer).unwrap() = odd[value].clone();
        }
        file.findings();
    }
}

fn collect(value: &Value, at: String, pointers: &mut Vec<String>) {
    match value {
        Value::Object(object) => {
            object.iter().for_each(|(key, v)| collect(v, format!("{at}/{}", schema::escaped(key)), pointers));
        }
        Value::Array(items) => items.iter().enumerate().for_each(|(i, v)| collect(v, format!("{at}/{i}"), pointers)),
        _ => {}
    }
    pointers.push(at);
}
