//! Faults in `EXT_gaussian_splatting_hybrid`.

use serde_json::{Value, json};

use super::{File, HYBRID, KHR, Planted, SPLATS, SURFACE, U16, U32, binding, declare, everything, primitive};
use crate::base64;

fn contract(file: &mut File) -> &mut Value {
    &mut file.json["scenes"][0]["extensions"][HYBRID]
}

fn hybrid_material(file: &mut File) -> &mut Value {
    &mut file.json["materials"][0]["extensions"][HYBRID]
}

fn field(file: &mut File) -> &mut Value {
    &mut file.json["extensions"][HYBRID]["deformationFields"][0]
}

/// The same number of texels in one column.
fn flatten(source: &mut Value) {
    let texels = source["width"].as_u64().unwrap() * source["height"].as_u64().unwrap();
    source["width"] = json!(1);
    source["height"] = json!(texels);
}

/// Reads coefficient `i` from the picture of the base colour.
fn pictured(file: &mut File, i: usize) -> &mut Value {
    let coefficient = &mut hybrid_material(file)["sphericalHarmonics"]["coefficients"][i];
    *coefficient = json!({ "texture": { "index": 0 } });
    coefficient
}

pub(super) const PLANTED: &[Planted] = &[
    // The schema.
    ("SCHEMA_RANGE", "EXT_gaussian_splatting_hybrid/lambda", |f| {
        f.json["scenes"][0]["extensions"][HYBRID]["lambda"] = json!(-1);
    }),
    ("SCHEMA_CHOICE", "/opacity", |f| hybrid_material(f)["opacity"]["texture"] = json!({ "index": 0 })),
    ("SCHEMA_RANGE", "/sphericalHarmonics/degree", |f| hybrid_material(f)["sphericalHarmonics"]["degree"] = json!(7)),
    ("SCHEMA_REQUIRED", "/binding", |f| drop(binding(f).as_object_mut().unwrap().remove("scales"))),
    ("SCHEMA_REQUIRED", "EXT_gaussian_splatting_hybrid", |f| {
        drop(primitive(f, SURFACE)["extensions"][HYBRID].as_object_mut().unwrap().remove("times"));
    }),
    ("HYBRID_PROPERTY", "/scenes/0/extensions/EXT_gaussian_splatting_hybrid", |f| contract(f)["lamda"] = json!(0.1)),
    ("HYBRID_PROPERTY", "/footprint", |f| contract(f)["footprint"] = json!({ "varianz": 0.1 })),
    ("HYBRID_PROPERTY", "/opacity", |f| hybrid_material(f)["opacity"]["activations"] = json!("none")),
    ("HYBRID_PROPERTY", "/coefficients/1", |f| {
        hybrid_material(f)["sphericalHarmonics"]["coefficients"][1]["Width"] = json!(4);
    }),
    ("HYBRID_PROPERTY", "/binding", |f| binding(f)["digest"] = json!("0")),
    ("HYBRID_PROPERTY", "/levels/0", |f| field(f)["levels"][0]["plane"] = json!([])),
    // References.
    ("INDEX_RANGE", "/deformation", |f| {
        primitive(f, SPLATS)["extensions"][KHR]["extensions"][HYBRID]["deformation"] = json!(1);
    }),
    ("INDEX_RANGE", "/coefficients/3/accessor", |f| {
        hybrid_material(f)["sphericalHarmonics"]["coefficients"][3]["accessor"] = json!(1234);
    }),
    ("INDEX_RANGE", "/binding/triangles", |f| binding(f)["triangles"] = json!(1234)),
    ("SCHEMA_TYPE", "EXT_gaussian_splatting_hybrid/lambda", |f| contract(f)["lambda"] = json!("none")),
    ("SCHEMA_VALUE", "EXT_gaussian_splatting_hybrid/layers", |f| contract(f)["layers"] = json!(3)),
    ("SCHEMA_RANGE", "EXT_gaussian_splatting_hybrid/near", |f| contract(f)["near"] = json!(0)),
    ("SCHEMA_RANGE", "EXT_gaussian_splatting_hybrid/footprint/variance", |f| {
        contract(f)["footprint"] = json!({ "variance": -0.1 });
    }),
    ("SCHEMA_TYPE", "EXT_gaussian_splatting_hybrid/footprint/normalized", |f| {
        contract(f)["footprint"] = json!({ "normalized": 1 });
    }),
    ("SCHEMA_LENGTH", "EXT_gaussian_splatting_hybrid/background", |f| contract(f)["background"] = json!([0, 0])),
    ("SCHEMA_REQUIRED", "/scenes/0/extensions/EXT_gaussian_splatting_hybrid", |f| {
        drop(contract(f).as_object_mut().unwrap().remove("colorSpace"));
    }),
    ("SCHEMA_REQUIRED", "/materials/0/extensions/EXT_gaussian_splatting_hybrid", |f| {
        drop(hybrid_material(f).as_object_mut().unwrap().remove("colorSpace"));
    }),
    ("SCHEMA_RANGE", "/opacity/channel", |f| hybrid_material(f)["opacity"]["channel"] = json!(4)),
    ("SCHEMA_LENGTH", "/opacity/scale", |f| hybrid_material(f)["opacity"]["scale"] = json!([])),
    ("SCHEMA_RANGE", "/opacity/width", |f| hybrid_material(f)["opacity"]["width"] = json!(0)),
    ("SCHEMA_CHOICE", "/coefficients/1", |f| {
        drop(hybrid_material(f)["sphericalHarmonics"]["coefficients"][1].as_object_mut().unwrap().remove("accessor"));
    }),
    ("SCHEMA_CHOICE", "/coefficients/1", |f| pictured(f, 1)["accessor"] = json!(0)),
    ("SCHEMA_REQUIRED", "/opacity", |f| {
        drop(hybrid_material(f)["opacity"].as_object_mut().unwrap().remove("width"));
    }),
    ("SCHEMA_RANGE", "/binding/triangleCount", |f| binding(f)["triangleCount"] = json!(0)),
    ("SCHEMA_TYPE", "/binding/geometryDigest", |f| binding(f)["geometryDigest"] = json!(7)),
    ("SCHEMA_LENGTH", "/planes", |f| drop(field(f)["levels"][0]["planes"].as_array_mut().unwrap().pop())),
    ("SCHEMA_LENGTH", "/levels", |f| field(f)["levels"] = json!([])),
    ("SCHEMA_RANGE", "/resolution/2", |f| field(f)["levels"][0]["resolution"][2] = json!(0)),
    ("SCHEMA_LENGTH", "/coordinateScale", |f| field(f)["coordinateScale"] = json!([1, 1, 1])),
    ("SCHEMA_REQUIRED", "/deformationFields/0", |f| drop(field(f).as_object_mut().unwrap().remove("heads"))),
    ("SCHEMA_REQUIRED", "/trunk/0", |f| drop(field(f)["trunk"][0].as_object_mut().unwrap().remove("bias"))),
    ("INDEX_RANGE", "/binding/node", |f| binding(f)["node"] = json!(99)),
    ("INDEX_RANGE", "/planes/5", |f| field(f)["levels"][0]["planes"][5] = json!(9999)),
    ("INDEX_RANGE", "/opacity/sampler", |f| hybrid_material(f)["opacity"]["sampler"] = json!(4)),
    ("INDEX_RANGE", "/surfaceVertices", |f| {
        primitive(f, SURFACE)["extensions"][HYBRID]["surfaceVertices"] = json!(9999);
    }),
    // The hybrid extension.
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
    ("HYBRID_TEXEL_UV", "/opacity", |f| {
        let uvs = primitive(f, SURFACE)["attributes"]["TEXCOORD_0"].clone();
        primitive(f, SURFACE)["attributes"]["TEXCOORD_1"] = uvs;
        hybrid_material(f)["opacity"]["texCoord"] = json!(1);
    }),
    ("HYBRID_TEXEL_UV", "/coefficients/1", |f| {
        let texture = f.json["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]["index"].clone();
        let moved = json!({ "KHR_texture_transform": { "offset": [0, 0.25] } });
        hybrid_material(f)["sphericalHarmonics"]["coefficients"][1] =
            json!({ "texture": { "index": texture, "extensions": moved } });
    }),
    ("HYBRID_MODE", "/mode", |f| primitive(f, SURFACE)["mode"] = json!(5)),
    ("HYBRID_SURFACE_TYPE", "/surfaceVertices", |f| {
        let position = primitive(f, SURFACE)["attributes"]["POSITION"].clone();
        primitive(f, SURFACE)["extensions"][HYBRID]["surfaceVertices"] = position;
    }),
    ("HYBRID_SURFACE_POSITION", "/surfaceVertices", |f| {
        let source = primitive(f, SURFACE)["extensions"][HYBRID]["surfaceVertices"].as_u64().unwrap() as usize;
        f.element(source, 1, 4).copy_from_slice(&2u32.to_le_bytes());
    }),
    // All vertices are copies of vertex 0.
    ("HYBRID_SURFACE_POSITION", "/surfaceVertices", |f| {
        let source = primitive(f, SURFACE)["extensions"][HYBRID]["surfaceVertices"].as_u64().unwrap() as usize;
        drop(f.json["accessors"][source].as_object_mut().unwrap().remove("bufferView"));
    }),
    ("HYBRID_SURFACE_GAP", "/surfaceVertices", |f| {
        let source = primitive(f, SURFACE)["extensions"][HYBRID]["surfaceVertices"].as_u64().unwrap() as usize;
        f.element(source, 5, 4).copy_from_slice(&99u32.to_le_bytes());
    }),
    ("HYBRID_TRANSLATIONS", "/translations", |f| {
        let count = f.json["accessors"][f.attribute(SURFACE, "POSITION")]["count"].as_u64().unwrap() as usize;
        let coarse = f.accessor("VEC3", U16, &vec![0.0; 2 * 3 * count]);
        primitive(f, SURFACE)["extensions"][HYBRID]["translations"] = json!(coarse);
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
    ("HYBRID_PLANE_SIZE", "/planes/0", |f| {
        let pairs = f.floats("VEC2", &[0.5; 12]);
        field(f)["levels"][0]["planes"][0] = json!(pairs);
    }),
    // Three outputs, but degree 1 has four coefficients.
    ("HYBRID_LAYER_CHAIN", "/deformation", |f| {
        field(f)["heads"]["sphericalHarmonics"] = field(f)["heads"]["translation"].clone();
    }),
    ("HYBRID_LAYER_CHAIN", "/trunk/0/inputs", |f| field(f)["features"] = json!(3)),
    ("HYBRID_LAYER_CHAIN", "/heads/logScale", |f| {
        field(f)["heads"]["logScale"] = field(f)["heads"]["rotation"].clone();
    }),
    ("HYBRID_LAYER_SIZE", "/trunk/0/bias", |f| {
        let weights = field(f)["trunk"][0]["weights"].clone();
        field(f)["trunk"][0]["bias"] = weights;
    }),
    ("HYBRID_TOKEN", "/sortKey", |f| contract(f)["sortKey"] = json!("cameraDistance")),
    ("HYBRID_TOKEN", "/colorSpace", |f| contract(f)["colorSpace"] = json!("rec2020")),
    ("HYBRID_TOKEN", "/activation", |f| hybrid_material(f)["opacity"]["activation"] = json!("tanh")),
    ("HYBRID_TOKEN", "/sphericalHarmonics/frame", |f| {
        hybrid_material(f)["sphericalHarmonics"]["frame"] = json!("world");
    }),
    ("HYBRID_TOKEN", "/interpolation", |f| {
        primitive(f, SURFACE)["extensions"][HYBRID]["interpolation"] = json!("CUBICSPLINE");
    }),
    ("HYBRID_TOKEN", "/binding/frame", |f| binding(f)["frame"] = json!("centroid")),
    ("HYBRID_TOKEN", "/binding/sphericalHarmonicsFrame", |f| binding(f)["sphericalHarmonicsFrame"] = json!("world")),
    ("HYBRID_TOKEN", "/deformationFields/0/type", |f| field(f)["type"] = json!("grid")),
    ("HYBRID_TOKEN", "/trunk/0/activation", |f| field(f)["trunk"][0]["activation"] = json!("tanh")),
    ("HYBRID_COLOR_SPACE", "/extensions/KHR_gaussian_splatting/colorSpace", |f| {
        primitive(f, SPLATS)["extensions"][KHR]["colorSpace"] = json!("lin_rec709_display");
    }),
    ("HYBRID_MIXED_MESH", "/meshes/0", |f| {
        let splats = primitive(f, SPLATS).clone();
        f.json["meshes"][SURFACE]["primitives"].as_array_mut().unwrap().push(splats);
    }),
    ("HYBRID_MAP_SIZE", "/coefficients/0", |f| flatten(&mut hybrid_material(f)["opacity"])),
    ("HYBRID_MAP_SIZE", "/coefficients/3", |f| {
        flatten(&mut hybrid_material(f)["sphericalHarmonics"]["coefficients"][3]);
    }),
    // 8×16 texels, as in coefficient 0; the others have 4×2.
    ("HYBRID_MAP_SIZE", "/coefficients/2", |f| _ = pictured(f, 1)),
    ("HYBRID_TEXEL_UNUSED", "/coefficients/1/sampler", |f| pictured(f, 1)["sampler"] = json!(0)),
    ("HYBRID_TEXEL_UNUSED", "/opacity/channel", |f| hybrid_material(f)["opacity"]["channel"] = json!(1)),
    ("HYBRID_TEXEL_LOSS", "/coefficients/0/texture", |f| {
        pictured(f, 0);
        let mut jpeg = std::io::Cursor::new(vec![]);
        image::RgbImage::new(8, 16).write_to(&mut jpeg, image::ImageFormat::Jpeg).unwrap();
        f.json["images"][0] = json!({ "uri": format!("data:image/jpeg;base64,{}", base64::encode(jpeg.get_ref())) });
    }),
    ("HYBRID_TEXEL_LOSS", "/coefficients/0/texture", |f| {
        pictured(f, 0);
        declare(f, "KHR_texture_basisu");
        f.json["textures"][0]["extensions"] = json!({ "KHR_texture_basisu": { "source": 0 } });
    }),
    ("HYBRID_TEXEL_TYPE", "/coefficients/2/accessor", |f| {
        let accessor =
            hybrid_material(f)["sphericalHarmonics"]["coefficients"][2]["accessor"].as_u64().unwrap() as usize;
        f.json["accessors"][accessor]["componentType"] = json!(U32);
    }),
    ("HYBRID_TEXEL_RANGE", "/coefficients/1/scale", |f| {
        hybrid_material(f)["sphericalHarmonics"]["coefficients"][1]["scale"] = json!([1, 1]);
    }),
    ("TIMES_ORDER", "/times", |f| {
        let times = primitive(f, SURFACE)["extensions"][HYBRID]["times"].as_u64().unwrap() as usize;
        f.set_float(times, 1, 1, 0.0);
    }),
    ("HYBRID_BINDING_TYPE", "/binding/scales", |f| {
        let coarse = f.accessor("VEC3", U16, &[1.0; 18]);
        binding(f)["scales"] = json!(coarse);
    }),
    ("HYBRID_BINDING_TYPE", "/binding/rotations", |f| {
        let coarse = f.accessor("VEC4", U16, &[0., 0., 0., 1.].repeat(6));
        binding(f)["rotations"] = json!(coarse);
    }),
    ("HYBRID_BINDING_MESH", "/binding/node", |f| primitive(f, SURFACE)["mode"] = json!(5)),
    // Another order of triangles, another order of corners, a moved vertex, and the digest of another mesh.
    ("HYBRID_BINDING_DIGEST", "/binding/geometryDigest", |f| {
        let indices = primitive(f, SURFACE)["indices"].as_u64().unwrap() as usize;
        let (first, second) = f.element(indices, 0, 4 * 6).split_at_mut(12);
        first.swap_with_slice(&mut second[..12]);
    }),
    ("HYBRID_BINDING_DIGEST", "/binding/geometryDigest", |f| {
        let indices = primitive(f, SURFACE)["indices"].as_u64().unwrap() as usize;
        f.element(indices, 0, 12).rotate_left(4);
    }),
    ("HYBRID_BINDING_DIGEST", "/binding/geometryDigest", |f| f.set_float(f.attribute(SURFACE, "POSITION"), 0, 3, 1e-3)),
    ("HYBRID_BINDING_DIGEST", "/binding/geometryDigest", |f| binding(f)["geometryDigest"] = json!("0123456789abcdef")),
    ("HYBRID_LAYER_CHAIN", "/heads/sphericalHarmonics", |f| {
        field(f)["heads"]["sphericalHarmonics"] = field(f)["heads"]["rotation"].clone();
    }),
    ("HYBRID_LAYER_SIZE", "/translation/0/weights", |f| {
        let bias = field(f)["trunk"][0]["bias"].clone();
        field(f)["heads"]["translation"][0]["weights"] = bias;
    }),
];

#[test]
fn a_source_that_many_primitives_lack_coordinates_for_is_one_finding() {
    let mut file = everything();
    hybrid_material(&mut file)["opacity"]["texCoord"] = json!(1);
    let one = primitive(&mut file, SURFACE).clone();
    for _ in 1..40 {
        file.json["meshes"][SURFACE]["primitives"].as_array_mut().unwrap().push(one.clone());
    }
    let found: Vec<_> = file.findings().into_iter().filter(|finding| finding.code == "HYBRID_TEXCOORD").collect();
    let expected = "none in 40 of 40, the first: /meshes/0/primitives/0";
    assert!(found.len() == 1 && found[0].found == expected, "{found:?}");
}

#[test]
fn a_set_of_coordinates_beside_a_texture_is_passed_over() {
    let mut file = everything();
    pictured(&mut file, 0)["texCoord"] = json!(1);
    assert_eq!(file.codes(), ["HYBRID_TEXEL_UNUSED"]);
}

/// Adds a scene of one node with a mesh; returns its index.
fn scene_of(file: &mut File, mesh: usize) -> usize {
    let node = file.push("nodes", json!({ "mesh": mesh }));
    file.push("scenes", json!({ "nodes": [node] }))
}

#[test]
fn a_scene_is_held_to_what_its_nodes_reach() {
    let mut file = everything();
    let composed = contract(&mut file).clone();
    let in_linear_light = |object: &mut Value| object["colorSpace"] = json!("lin_rec709_display");
    // Splats in a scene of their own, and an unused material.
    let mut splats = file.json["meshes"][SPLATS].clone();
    let own = &mut splats["primitives"][0];
    own["attributes"].as_object_mut().unwrap().remove("COLOR_0");
    own["extensions"] = json!({ KHR: { "kernel": "ellipse" } });
    in_linear_light(&mut own["extensions"][KHR]);
    let splats = file.push("meshes", splats);
    let other = scene_of(&mut file, splats);
    file.json["scenes"][other]["extensions"] = json!({ HYBRID: composed });
    in_linear_light(&mut file.json["scenes"][other]["extensions"][HYBRID]);
    let mut unused = file.json["materials"][0].clone();
    in_linear_light(&mut unused["extensions"][HYBRID]);
    file.push("materials", unused);
    assert_eq!(file.codes(), [""; 0]);

    // Splats and a surface of the first scene that are also below a node of the second scene.
    let children = [SPLATS, SURFACE].map(|mesh| file.push("nodes", json!({ "mesh": mesh })));
    let above = file.push("nodes", json!({ "children": children }));
    file.json["scenes"][other]["nodes"].as_array_mut().unwrap().push(json!(above));
    let said: Vec<String> = file.findings().iter().map(ToString::to_string).collect();
    let places = ["/meshes/1/primitives/0/extensions/KHR_gaussian_splatting", "/materials/0/extensions/"];
    assert!(said.len() == 2, "{said:?}");
    for (said, place) in said.iter().zip(places) {
        assert!(said.starts_with(&format!("error HYBRID_COLOR_SPACE: {place}")), "{said}");
        assert!(said.contains(&format!("as in /scenes/{other}/extensions/{HYBRID}")), "{said}");
    }
}

#[test]
fn meshes_of_splats_and_triangles_are_wrong_where_they_are_composed() {
    let mut file = everything();
    let mut mixed = file.json["meshes"][SURFACE].clone();
    let splats = primitive(&mut file, SPLATS).clone();
    mixed["primitives"].as_array_mut().unwrap().push(splats);
    let mixed = file.push("meshes", mixed);
    let scene = scene_of(&mut file, mixed);
    assert_eq!(file.codes(), [""; 0]);
    file.json["scenes"][scene]["extensions"] = file.json["scenes"][0]["extensions"].clone();
    assert_eq!(file.codes(), ["HYBRID_MIXED_MESH"]);
}
