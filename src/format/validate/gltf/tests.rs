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
/// Position of the mesh and of the splats in `meshes`.
const SURFACE: usize = 0;
const SPLATS: usize = 1;

/// A scene with a mesh, splats and a camera as Centaur writes it, and whatever else the rules speak of.
fn everything() -> File {
    let mut file = File::of(&random_scene(6, 1, 1, 4));
    let identity = [1., 0., 0., 0., 0., 1., 0., 0., 0., 0., 1., 0., 0., 0., 0., 1.];
    let vertices = file.json["accessors"][file.attribute(SURFACE, "POSITION")]["count"].as_u64().unwrap() as usize;
    let triangles = file.json["meshes"][SURFACE]["primitives"][0]["indices"].as_u64().unwrap() as usize;
    let triangles = file.json["accessors"][triangles]["count"].as_u64().unwrap() / 3;

    // A skin, an animation and a sparse accessor of the core.
    let matrices = file.floats("MAT4", &identity);
    file.push("skins", json!({ "joints": [0], "inverseBindMatrices": matrices }));
    let times = file.floats("SCALAR", &[0.0, 0.5, 2.0]);
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

    // Moving vertices, bound splats and a field of deformation.
    let key_times = file.floats("SCALAR", &[0.0, 1.0]);
    let moved = file.floats("VEC3", &vec![0.1; 2 * 3 * vertices]);
    let surface = &mut file.json["meshes"][SURFACE]["primitives"][0]["extensions"][HYBRID];
    surface["times"] = json!(key_times);
    surface["translations"] = json!(moved);
    let binding = json!({
        "node": 0, "triangleCount": triangles,
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

/// What is broken, the code that must be found, and the end of the place where.
type Planted = (&'static str, &'static str, fn(&mut File));

fn hybrid_material(file: &mut File) -> &mut Value {
    &mut file.json["materials"][0]["extensions"][HYBRID]
}

fn primitive(file: &mut File, mesh: usize) -> &mut Value {
    &mut file.json["meshes"][mesh]["primitives"][0]
}

fn binding(file: &mut File) -> &mut Value {
    &mut primitive(file, SPLATS)["extensions"][KHR]["extensions"][HYBRID]["binding"]
}

fn field(file: &mut File) -> &mut Value {
    &mut file.json["extensions"][HYBRID]["deformationFields"][0]
}

fn declare(file: &mut File, extension: &str) {
    file.json["extensionsUsed"].as_array_mut().unwrap().push(json!(extension));
}

const PLANTED: &[Planted] = &[
    // The schema.
    ("SCHEMA_REQUIRED", "/accessors/0", |f| drop(f.json["accessors"][0].as_object_mut().unwrap().remove("count"))),
    ("SCHEMA_REQUIRED", "", |f| drop(f.json.as_object_mut().unwrap().remove("asset"))),
    ("SCHEMA_TYPE", "/nodes/0/name", |f| f.json["nodes"][0]["name"] = json!(3)),
    ("SCHEMA_TYPE", "/buffers/0/byteLength", |f| f.json["buffers"][0]["byteLength"] = json!("many")),
    ("SCHEMA_VALUE", "/asset/version", |f| f.json["asset"]["version"] = json!("1.0")),
    ("SCHEMA_VALUE", "/accessors/1/componentType", |f| f.json["accessors"][1]["componentType"] = json!(5124)),
    ("SCHEMA_VALUE", "/materials/0/alphaMode", |f| f.json["materials"][0]["alphaMode"] = json!("GLASS")),
    ("SCHEMA_LENGTH", "/scenes/0/nodes", |f| f.json["scenes"][0]["nodes"] = json!([])),
    ("SCHEMA_LENGTH", "/nodes/0/rotation", |f| f.json["nodes"][0]["rotation"] = json!([0, 0, 1])),
    ("SCHEMA_RANGE", "/cameras/0/perspective/znear", |f| f.json["cameras"][0]["perspective"]["znear"] = json!(0)),
    ("SCHEMA_UNIQUE", "/skins/0/joints", |f| f.json["skins"][0]["joints"] = json!([0, 0])),
    ("SCHEMA_CHOICE", "/images/0", |f| f.json["images"][0]["uri"] = json!("a.png")),
    ("SCHEMA_RANGE", "EXT_gaussian_splatting_hybrid/lambda", |f| {
        f.json["scenes"][0]["extensions"][HYBRID]["lambda"] = json!(-1);
    }),
    ("SCHEMA_CHOICE", "/opacity", |f| hybrid_material(f)["opacity"]["texture"] = json!({ "index": 0 })),
    ("SCHEMA_RANGE", "/sphericalHarmonics/degree", |f| hybrid_material(f)["sphericalHarmonics"]["degree"] = json!(7)),
    ("SCHEMA_REQUIRED", "/extensions/KHR_gaussian_splatting", |f| {
        drop(primitive(f, SPLATS)["extensions"][KHR].as_object_mut().unwrap().remove("colorSpace"));
    }),
    ("SCHEMA_REQUIRED", "/binding", |f| drop(binding(f).as_object_mut().unwrap().remove("scales"))),
    ("SCHEMA_REQUIRED", "EXT_gaussian_splatting_hybrid", |f| {
        drop(primitive(f, SURFACE)["extensions"][HYBRID].as_object_mut().unwrap().remove("times"));
    }),
    // References.
    ("INDEX_RANGE", "/scene", |f| f.json["scene"] = json!(9)),
    ("INDEX_RANGE", "/primitives/0/material", |f| primitive(f, SURFACE)["material"] = json!(5)),
    ("INDEX_RANGE", "/attributes/POSITION", |f| primitive(f, SPLATS)["attributes"]["POSITION"] = json!(9999)),
    ("INDEX_RANGE", "/textures/0/source", |f| f.json["textures"][0]["source"] = json!(1)),
    ("INDEX_RANGE", "/channels/0/sampler", |f| f.json["animations"][0]["channels"][0]["sampler"] = json!(1)),
    ("INDEX_RANGE", "/deformation", |f| {
        primitive(f, SPLATS)["extensions"][KHR]["extensions"][HYBRID]["deformation"] = json!(1);
    }),
    ("INDEX_RANGE", "/coefficients/3/accessor", |f| {
        hybrid_material(f)["sphericalHarmonics"]["coefficients"][3]["accessor"] = json!(1234);
    }),
    ("INDEX_RANGE", "/binding/triangles", |f| binding(f)["triangles"] = json!(1234)),
    // Extensions.
    ("EXTENSION_UNDECLARED", "/materials/0/extensions/KHR_materials_unlit", |f| {
        f.json["extensionsUsed"].as_array_mut().unwrap().retain(|e| e != "KHR_materials_unlit");
    }),
    ("EXTENSION_UNDECLARED", "/extensionsRequired/0", |f| f.json["extensionsRequired"] = json!(["KHR_none"])),
    ("EXTENSION_UNUSED", "/extensionsUsed/3", |f| declare(f, "KHR_none")),
    ("EXTENSION_UNSUPPORTED", "/extensionsRequired/0", |f| {
        declare(f, "KHR_draco_mesh_compression");
        f.json["extensionsRequired"] = json!(["KHR_draco_mesh_compression"]);
        f.json["nodes"][0]["extensions"] = json!({ "KHR_draco_mesh_compression": {} });
    }),
    // Buffers, views, accessors.
    ("BUFFER_LENGTH", "/buffers/0/byteLength", |f| f.json["buffers"][0]["byteLength"] = json!(1 << 30)),
    ("BUFFER_LENGTH", "/buffers/0/byteLength", |f| f.bin.extend([0; 8])),
    ("BUFFER_URI", "/buffers/0/uri", |f| f.json["buffers"][0]["uri"] = json!("../../etc/passwd")),
    ("BUFFER_URI", "/buffers/1", |f| _ = f.push("buffers", json!({ "byteLength": 4 }))),
    ("VIEW_RANGE", "/bufferViews/0", |f| f.json["bufferViews"][0]["byteLength"] = json!(1 << 30)),
    ("ACCESSOR_RANGE", "/accessors/0", |f| f.json["accessors"][0]["count"] = json!(1_000_000_000)),
    ("ACCESSOR_RANGE", "/accessors/0", |f| f.json["bufferViews"][0]["byteStride"] = json!(8)),
    ("ACCESSOR_ALIGNMENT", "/accessors/0", |f| f.json["bufferViews"][0]["byteOffset"] = json!(2)),
    ("ACCESSOR_NORMALIZED", "/accessors/0/normalized", |f| f.json["accessors"][0]["normalized"] = json!(true)),
    ("ACCESSOR_BOUNDS", "/accessors/0/min", |f| f.json["accessors"][0]["min"] = json!([0.5])),
    ("ACCESSOR_BOUNDS", "/accessors/0/max", |f| f.json["accessors"][0]["max"][1] = json!(77)),
    ("ACCESSOR_NOT_FINITE", "/accessors/0", |f| f.set_float(0, 1, 3, f32::NAN)),
    ("SPARSE_INDICES", "/sparse/indices", |f| {
        let places =
            f.json["accessors"].as_array().unwrap().iter().position(|a| a["componentType"] == U16 && a["count"] == 2);
        f.element(places.unwrap(), 1, 2).copy_from_slice(&[6, 0]);
    }),
    // Nodes and primitives.
    ("NODE_ROTATION", "/nodes/0/rotation", |f| f.json["nodes"][0]["rotation"] = json!([0, 0, 0, 2])),
    ("NODE_TRANSFORM", "/nodes/0", |f| {
        f.json["nodes"][0]["matrix"] = json!([1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]);
        f.json["nodes"][0]["scale"] = json!([1, 1, 1]);
    }),
    ("NODE_PARENT", "/children", |f| _ = f.push("nodes", json!({ "children": [0] }))),
    ("NODE_CYCLE", "/nodes/0", |f| f.json["nodes"][0]["children"] = json!([0])),
    ("NODE_CYCLE", "/nodes/", |f| {
        let root = f.json["scenes"][0]["nodes"][0].clone();
        f.json["nodes"][0]["children"] = json!([root]);
    }),
    ("SCENE_ROOT", "/scenes/0/nodes/1", |f| f.json["scenes"][0]["nodes"].as_array_mut().unwrap().push(json!(0))),
    ("PRIMITIVE_POSITION", "/attributes", |f| {
        drop(primitive(f, SURFACE)["attributes"].as_object_mut().unwrap().remove("POSITION"));
    }),
    ("PRIMITIVE_BOUNDS", "/accessors/0", |f| drop(f.json["accessors"][0].as_object_mut().unwrap().remove("min"))),
    ("PRIMITIVE_COUNT", "/attributes/TEXCOORD_0", |f| {
        let short = f.floats("VEC2", &[0.0; 4]);
        primitive(f, SURFACE)["attributes"]["TEXCOORD_0"] = json!(short);
    }),
    ("PRIMITIVE_ATTRIBUTE", "/attributes/TEXCOORD_0", |f| {
        let position = primitive(f, SURFACE)["attributes"]["POSITION"].clone();
        primitive(f, SURFACE)["attributes"]["TEXCOORD_0"] = position;
    }),
    ("INDICES_TYPE", "/indices", |f| {
        let position = primitive(f, SURFACE)["attributes"]["POSITION"].clone();
        primitive(f, SURFACE)["indices"] = position;
    }),
    ("INDICES_RANGE", "/indices", |f| {
        let indices = primitive(f, SURFACE)["indices"].as_u64().unwrap() as usize;
        f.element(indices, 2, 4).copy_from_slice(&999u32.to_le_bytes());
    }),
    ("PRIMITIVE_INCOMPLETE", "/primitives/0", |f| {
        let indices = primitive(f, SURFACE)["indices"].as_u64().unwrap() as usize;
        f.json["accessors"][indices]["count"] = json!(4);
    }),
    ("NORMAL_NORM", "/attributes/NORMAL", |f| {
        let position = primitive(f, SURFACE)["attributes"]["POSITION"].clone();
        primitive(f, SURFACE)["attributes"]["NORMAL"] = position;
    }),
    ("IMAGE_TYPE", "/images/0/mimeType", |f| f.json["images"][0]["mimeType"] = json!("image/jpeg")),
    ("IMAGE_CONTENT", "/images/0", |f| f.json["images"][0]["bufferView"] = json!(0)),
    ("IMAGE_URI", "/images/0/uri", |f| f.json["images"][0] = json!({ "uri": "none.png" })),
    ("SKIN_MATRICES", "/inverseBindMatrices", |f| f.json["skins"][0]["joints"] = json!([0, 1])),
    ("ANIMATION_OUTPUT", "/channels/0", |f| {
        f.json["animations"][0]["samplers"][0]["interpolation"] = json!("CUBICSPLINE");
    }),
    ("TIMES_ORDER", "/samplers/0/input", |f| {
        let input = f.json["animations"][0]["samplers"][0]["input"].as_u64().unwrap() as usize;
        f.set_float(input, 1, 1, 3.0);
    }),
    ("TIMES_TYPE", "/samplers/0/input", |f| {
        let output = f.json["animations"][0]["samplers"][0]["output"].clone();
        f.json["animations"][0]["samplers"][0]["input"] = output;
    }),
    // Splats.
    ("SPLAT_MODE", "/mode", |f| primitive(f, SPLATS)["mode"] = json!(4)),
    ("SPLAT_TOKEN", "/sortingMethod", |f| primitive(f, SPLATS)["extensions"][KHR]["sortingMethod"] = json!("zDepth")),
    ("SPLAT_ATTRIBUTE_MISSING", "/attributes", |f| {
        let attributes = primitive(f, SPLATS)["attributes"].as_object_mut().unwrap();
        drop(attributes.remove("KHR_gaussian_splatting:SCALE"));
    }),
    ("SPLAT_SH_INCOMPLETE", "/attributes", |f| {
        let attributes = primitive(f, SPLATS)["attributes"].as_object_mut().unwrap();
        drop(attributes.remove("KHR_gaussian_splatting:SH_DEGREE_1_COEF_1"));
    }),
    ("SPLAT_ATTRIBUTE_TYPE", "/attributes/KHR_gaussian_splatting:OPACITY", |f| {
        let scale = primitive(f, SPLATS)["attributes"]["KHR_gaussian_splatting:SCALE"].clone();
        primitive(f, SPLATS)["attributes"]["KHR_gaussian_splatting:OPACITY"] = scale;
    }),
    ("SPLAT_ATTRIBUTE_UNKNOWN", "/attributes/KHR_gaussian_splatting:SH_DEGREE_4_COEF_0", |f| {
        let scale = primitive(f, SPLATS)["attributes"]["KHR_gaussian_splatting:SCALE"].clone();
        primitive(f, SPLATS)["attributes"]["KHR_gaussian_splatting:SH_DEGREE_4_COEF_0"] = scale;
    }),
    ("SPLAT_ROTATION_NORM", "/attributes/KHR_gaussian_splatting:ROTATION", |f| {
        f.set_float(f.attribute(SPLATS, "KHR_gaussian_splatting:ROTATION"), 2, 4, 5.0);
    }),
    ("SPLAT_OPACITY_RANGE", "/attributes/KHR_gaussian_splatting:OPACITY", |f| {
        f.set_float(f.attribute(SPLATS, "KHR_gaussian_splatting:OPACITY"), 2, 1, 1.5);
    }),
    ("SPLAT_SCALE_NEGATIVE", "/attributes/KHR_gaussian_splatting:SCALE", |f| {
        f.set_float(f.attribute(SPLATS, "KHR_gaussian_splatting:SCALE"), 2, 3, -0.5);
    }),
    ("SPLAT_FALLBACK_COLOR", "/attributes/COLOR_0", |f| {
        let dc = f.attribute(SPLATS, "KHR_gaussian_splatting:SH_DEGREE_0_COEF_0");
        f.set_float(dc, 1, 3, 9.0);
        f.set_float(dc, 2, 3, -9.0);
    }),
    // The hybrid.
    ("HYBRID_REQUIRED", "/extensionsRequired/0", |f| f.json["extensionsRequired"] = json!([HYBRID])),
    ("HYBRID_TOKEN", "/mode", |f| f.json["scenes"][0]["extensions"][HYBRID]["mode"] = json!("any")),
    ("HYBRID_COLOR_SPACE", "/colorSpace", |f| hybrid_material(f)["colorSpace"] = json!("lin_rec709_display")),
    ("HYBRID_ALPHA_MODE", "/materials/0", |f| f.json["materials"][0]["alphaMode"] = json!("OPAQUE")),
    ("HYBRID_SH_COUNT", "/coefficients", |f| hybrid_material(f)["sphericalHarmonics"]["degree"] = json!(2)),
    ("HYBRID_TEXEL_COUNT", "/opacity/accessor", |f| hybrid_material(f)["opacity"]["width"] = json!(3)),
    ("HYBRID_TEXEL_TYPE", "/opacity/accessor", |f| {
        let other = hybrid_material(f)["sphericalHarmonics"]["coefficients"][0]["accessor"].clone();
        hybrid_material(f)["opacity"]["accessor"] = other;
    }),
    ("HYBRID_TEXEL_RANGE", "/opacity/offset", |f| hybrid_material(f)["opacity"]["offset"] = json!([0, 0, 0])),
    ("HYBRID_TEXCOORD", "/opacity", |f| hybrid_material(f)["opacity"]["texCoord"] = json!(1)),
    ("HYBRID_MODE", "/mode", |f| primitive(f, SURFACE)["mode"] = json!(5)),
    ("HYBRID_SURFACE_TYPE", "/surfaceVertices", |f| {
        let position = primitive(f, SURFACE)["attributes"]["POSITION"].clone();
        primitive(f, SURFACE)["extensions"][HYBRID]["surfaceVertices"] = position;
    }),
    ("HYBRID_SURFACE_POSITION", "/surfaceVertices", |f| {
        let source = primitive(f, SURFACE)["extensions"][HYBRID]["surfaceVertices"].as_u64().unwrap() as usize;
        f.element(source, 1, 4).copy_from_slice(&2u32.to_le_bytes());
    }),
    ("HYBRID_SURFACE_GAP", "/surfaceVertices", |f| {
        let source = primitive(f, SURFACE)["extensions"][HYBRID]["surfaceVertices"].as_u64().unwrap() as usize;
        f.element(source, 5, 4).copy_from_slice(&99u32.to_le_bytes());
    }),
    ("HYBRID_TRANSLATIONS", "/translations", |f| {
        let longer = f.floats("SCALAR", &[0.0, 1.0, 2.0]);
        primitive(f, SURFACE)["extensions"][HYBRID]["times"] = json!(longer);
    }),
    ("HYBRID_BINDING_COUNT", "/binding/scales", |f| {
        let short = f.floats("VEC3", &[0.1; 3]);
        binding(f)["scales"] = json!(short);
    }),
    ("HYBRID_BINDING_ROTATION", "/binding/rotations", |f| {
        let rotations = binding(f)["rotations"].as_u64().unwrap() as usize;
        f.set_float(rotations, 0, 4, 3.0);
    }),
    ("HYBRID_BINDING_TRIANGLE", "/binding/triangles", |f| {
        let triangles = binding(f)["triangles"].as_u64().unwrap() as usize;
        f.element(triangles, 0, 4).copy_from_slice(&4u32.to_le_bytes());
    }),
    ("HYBRID_BINDING_MESH", "/binding/triangleCount", |f| binding(f)["triangleCount"] = json!(5)),
    ("HYBRID_BINDING_MESH", "/binding/node", |f| binding(f)["primitive"] = json!(5)),
    ("HYBRID_PLANE_SIZE", "/planes/4", |f| field(f)["levels"][0]["resolution"][3] = json!(6)),
    ("HYBRID_LAYER_CHAIN", "/trunk/0/inputs", |f| field(f)["features"] = json!(3)),
    ("HYBRID_LAYER_CHAIN", "/heads/logScale", |f| {
        field(f)["heads"]["logScale"] = field(f)["heads"]["rotation"].clone();
    }),
    ("HYBRID_LAYER_SIZE", "/trunk/0/bias", |f| {
        let weights = field(f)["trunk"][0]["weights"].clone();
        field(f)["trunk"][0]["bias"] = weights;
    }),
];

#[test]
fn every_planted_fault_is_found_at_its_place() {
    let whole = everything();
    for (number, (code, place, plant)) in PLANTED.iter().enumerate() {
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
