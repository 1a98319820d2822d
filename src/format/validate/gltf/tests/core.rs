//! Faults in core glTF.

use serde_json::{Value, json};

use super::{
    FLOAT, File, KHR, Planted, SPLATS, SURFACE, U16, U32, copied, declare, everything, pointed, primitive, skinned,
    surface_node,
};

fn vertices(file: &File) -> usize {
    file.json["accessors"][file.attribute(SURFACE, "POSITION")]["count"].as_u64().unwrap() as usize
}

/// Gives all vertices of the surface the same value of an attribute; returns the accessor.
fn give(file: &mut File, name: &str, (kind, component): (&str, u32), value: &[f64]) -> usize {
    let values = value.repeat(vertices(file));
    let accessor = file.accessor(kind, component, &values);
    primitive(file, SURFACE)["attributes"][name] = json!(accessor);
    accessor
}

fn base_color(file: &mut File) -> &mut Value {
    &mut file.json["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]
}

fn channels(file: &mut File) -> &mut Vec<Value> {
    file.json["animations"][0]["channels"].as_array_mut().unwrap()
}

/// View of the surface's indices.
fn view_of_indices(file: &mut File) -> &mut Value {
    let indices = primitive(file, SURFACE)["indices"].as_u64().unwrap() as usize;
    let view = file.json["accessors"][indices]["bufferView"].as_u64().unwrap() as usize;
    &mut file.json["bufferViews"][view]
}

pub(super) const PLANTED: &[Planted] = &[
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
    ("SCHEMA_CHOICE", "/cameras/0", |f| f.json["cameras"][0]["type"] = json!("orthographic")),
    ("SCHEMA_CHOICE", "/images/0", |f| f.json["images"][0]["uri"] = json!("a.png")),
    // Properties that are not defined.
    ("PROPERTY_UNKNOWN", "/accessors/0", |f| f.json["accessors"][0]["stride"] = json!(1)),
    ("PROPERTY_UNKNOWN", "/nodes/0", |f| f.json["nodes"][0]["Name"] = json!("a")),
    ("PROPERTY_UNKNOWN", "/meshes/0/primitives/0", |f| primitive(f, SURFACE)["matrial"] = json!(0)),
    ("PROPERTY_UNKNOWN", "/materials/0", |f| f.json["materials"][0]["baseColorFactor"] = json!([1, 1, 1, 1])),
    ("PROPERTY_UNKNOWN", "/materials/0/pbrMetallicRoughness/baseColorTexture", |f| {
        base_color(f)["texcoord"] = json!(0);
    }),
    ("PROPERTY_UNKNOWN", "/cameras/0/perspective", |f| f.json["cameras"][0]["perspective"]["xfov"] = json!(1)),
    ("PROPERTY_UNKNOWN", "/animations/0/channels/0/target", |f| channels(f)[0]["target"]["bone"] = json!(0)),
    ("PROPERTY_UNKNOWN", "/extensions/KHR_gaussian_splatting", |f| {
        primitive(f, SPLATS)["extensions"][KHR]["colourSpace"] = json!("srgb_rec709_display");
    }),
    // References.
    ("INDEX_RANGE", "/scene", |f| f.json["scene"] = json!(9)),
    ("INDEX_RANGE", "/primitives/0/material", |f| primitive(f, SURFACE)["material"] = json!(5)),
    ("INDEX_RANGE", "/attributes/POSITION", |f| primitive(f, SPLATS)["attributes"]["POSITION"] = json!(9999)),
    ("INDEX_RANGE", "/textures/0/source", |f| f.json["textures"][0]["source"] = json!(1)),
    ("INDEX_RANGE", "/diffuseTexture/index", |f| {
        declare(f, "KHR_materials_pbrSpecularGlossiness");
        let diffuse = json!({ "diffuseTexture": { "index": 99 } });
        f.json["materials"][0]["extensions"]["KHR_materials_pbrSpecularGlossiness"] = diffuse;
    }),
    ("INDEX_RANGE", "/channels/0/sampler", |f| f.json["animations"][0]["channels"][0]["sampler"] = json!(1)),
    ("ANIMATION_POINTER", "/KHR_animation_pointer/pointer", |f| pointed(f, "/cameras/1/perspective/yfov")),
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
    ("EXTENSION_OPTIONAL", "/extensionsUsed/3", |f| declare(f, "KHR_mesh_quantization")),
    // Buffers, views, accessors.
    ("BUFFER_TYPE", "/buffers/0/uri", |f| f.json["buffers"][0]["uri"] = json!("data:text/plain;base64,AAAA")),
    ("VIEW_DATA", "/bufferViews/0", |f| {
        let indices = primitive(f, SURFACE)["indices"].as_u64().unwrap() as usize;
        f.json["accessors"][indices]["bufferView"] = json!(0);
    }),
    ("VIEW_TARGET", "/target", |f| view_of_indices(f)["target"] = json!(34962)),
    ("VIEW_TARGET", "/target", |f| {
        let matrices = f.json["skins"][0]["inverseBindMatrices"].as_u64().unwrap() as usize;
        let view = f.json["accessors"][matrices]["bufferView"].as_u64().unwrap() as usize;
        f.json["bufferViews"][view]["target"] = json!(34962);
    }),
    ("VIEW_STRIDE", "/byteStride", |f| view_of_indices(f)["byteStride"] = json!(4)),
    ("ACCESSOR_COUNT", "/count", |f| {
        _ = f.push("accessors", json!({ "componentType": FLOAT, "type": "SCALAR", "count": 1_000_000_000 }));
    }),
    // The columns of a matrix are aligned, its components need not be.
    ("ACCESSOR_ALIGNMENT", "/accessors/", |f| {
        let matrix = json!({ "bufferView": 0, "byteOffset": 2, "componentType": U16, "type": "MAT2", "count": 1 });
        f.push("accessors", matrix);
    }),
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
    ("NODE_MATRIX", "/nodes/0/matrix", |f| {
        f.json["nodes"][0]["matrix"] = json!([1, 0, 0, 0, 0.5, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]);
    }),
    ("NODE_MATRIX", "/nodes/0/matrix", |f| {
        f.json["nodes"][0]["matrix"] = json!([1, 0, 0, 0.5, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]);
    }),
    ("NODE_MATRIX", "/nodes/0/matrix", |f| {
        f.json["nodes"][0]["matrix"] = json!([1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]);
    }),
    ("NODE_WEIGHTS", "/nodes/0/weights", |f| f.json["nodes"][0]["weights"] = json!([1])),
    ("MESH_WEIGHTS", "/meshes/0/weights", |f| f.json["meshes"][SURFACE]["weights"] = json!([1])),
    ("MESH_TARGETS", "/meshes/0/primitives/1", |f| {
        let mut other = primitive(f, SURFACE).clone();
        other["targets"] = json!([{ "POSITION": other["attributes"]["POSITION"] }]);
        f.json["meshes"][SURFACE]["primitives"].as_array_mut().unwrap().push(other);
    }),
    ("CAMERA_DEPTHS", "/perspective/zfar", |f| {
        let near = f.json["cameras"][0]["perspective"]["znear"].clone();
        f.json["cameras"][0]["perspective"]["zfar"] = near;
    }),
    ("CAMERA_ANGLE", "/perspective/yfov", |f| f.json["cameras"][0]["perspective"]["yfov"] = json!(4)),
    ("CAMERA_SIZE", "/orthographic/xmag", |f| {
        let optics = json!({ "xmag": 0, "ymag": 1, "zfar": 2, "znear": 1 });
        f.push("cameras", json!({ "type": "orthographic", "orthographic": optics }));
    }),
    ("CAMERA_SIZE", "/orthographic/ymag", |f| {
        let optics = json!({ "xmag": 1, "ymag": -1, "zfar": 2, "znear": 1 });
        f.push("cameras", json!({ "type": "orthographic", "orthographic": optics }));
    }),
    ("MATERIAL_TEXCOORD", "/baseColorTexture", |f| base_color(f)["texCoord"] = json!(1)),
    ("MATERIAL_TEXCOORD", "/baseColorTexture", |f| {
        declare(f, "KHR_texture_transform");
        base_color(f)["extensions"] = json!({ "KHR_texture_transform": { "texCoord": 1 } });
    }),
    ("MATERIAL_TEXCOORD", "/KHR_materials_clearcoat/clearcoatTexture", |f| {
        declare(f, "KHR_materials_clearcoat");
        let clearcoat = json!({ "clearcoatTexture": { "index": 0, "texCoord": 2 } });
        f.json["materials"][0]["extensions"]["KHR_materials_clearcoat"] = clearcoat;
    }),
    ("MATERIAL_CUTOFF", "/materials/0/alphaCutoff", |f| f.json["materials"][0]["alphaCutoff"] = json!(0.3)),
    ("NODE_PARENT", "/children", |f| _ = f.push("nodes", json!({ "children": [0] }))),
    ("NODE_CYCLE", "/nodes/0", |f| f.json["nodes"][0]["children"] = json!([0])),
    ("NODE_CYCLE", "/nodes/", |f| {
        let root = f.json["scenes"][0]["nodes"][0].clone();
        f.json["nodes"][0]["children"] = json!([root]);
    }),
    ("SCENE_ROOT", "/scenes/0/nodes/1", |f| f.json["scenes"][0]["nodes"].as_array_mut().unwrap().push(json!(0))),
    ("COPIES_COUNT", "/EXT_mesh_gpu_instancing/attributes/TRANSLATION", |f| {
        let (turns, places) = (f.floats("VEC4", &[0., 0., 0., 1.]), f.floats("VEC3", &[0.0; 6]));
        copied(f, SURFACE, &json!({ "ROTATION": turns, "TRANSLATION": places }));
    }),
    ("COPIES_ATTRIBUTE", "/EXT_mesh_gpu_instancing/attributes/SCALE", |f| {
        let scales = f.accessor("VEC3", U16, &[1.0; 3]);
        copied(f, SURFACE, &json!({ "SCALE": scales }));
    }),
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
    ("PRIMITIVE_ATTRIBUTE", "/attributes/_ID", |f| _ = give(f, "_ID", ("SCALAR", U32), &[1.0])),
    ("PRIMITIVE_NORMALIZED", "/attributes/COLOR_0", |f| _ = give(f, "COLOR_0", ("VEC4", U16), &[1.0; 4])),
    ("PRIMITIVE_NORMALIZED", "/attributes/JOINTS_0", |f| {
        skinned(f, 0.0, 1.0);
        let joints = f.attribute(SURFACE, "JOINTS_0");
        f.json["accessors"][joints]["normalized"] = json!(true);
    }),
    ("PRIMITIVE_SEMANTIC", "/attributes/foo", |f| _ = give(f, "foo", ("SCALAR", FLOAT), &[1.0])),
    ("PRIMITIVE_SEMANTIC", "/attributes/TEXCOORD_01", |f| _ = give(f, "TEXCOORD_01", ("VEC2", FLOAT), &[1.0; 2])),
    ("PRIMITIVE_SEMANTIC", "/attributes/KHR_none:ID", |f| _ = give(f, "KHR_none:ID", ("SCALAR", FLOAT), &[1.0])),
    ("PRIMITIVE_SETS", "/attributes/TEXCOORD_5", |f| _ = give(f, "TEXCOORD_5", ("VEC2", FLOAT), &[1.0; 2])),
    ("PRIMITIVE_SETS", "/attributes/JOINTS_0", |f| _ = give(f, "JOINTS_0", ("VEC4", U16), &[0.0; 4])),
    ("PRIMITIVE_SETS", "/attributes/WEIGHTS_0", |f| _ = give(f, "WEIGHTS_0", ("VEC4", FLOAT), &[0.25; 4])),
    ("PRIMITIVE_TANGENT", "/attributes/TANGENT", |f| _ = give(f, "TANGENT", ("VEC4", FLOAT), &[0., 1., 0., 1.])),
    ("TANGENT_NORM", "/attributes/TANGENT", |f| _ = give(f, "TANGENT", ("VEC4", FLOAT), &[0., 2., 0., 1.])),
    ("TANGENT_SIGN", "/attributes/TANGENT", |f| _ = give(f, "TANGENT", ("VEC4", FLOAT), &[0., 1., 0., 0.5])),
    ("COLOR_RANGE", "/attributes/COLOR_0", |f| _ = give(f, "COLOR_0", ("VEC3", FLOAT), &[0., 3., 0.])),
    ("PRIMITIVE_INCOMPLETE", "/primitives/0", |f| {
        let indices = primitive(f, SURFACE)["indices"].as_u64().unwrap() as usize;
        f.json["accessors"][indices]["count"] = json!(2);
        primitive(f, SURFACE)["mode"] = json!(5);
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
    ("IMAGE_CONTENT", "/images/0", |f| {
        f.json["images"][0] = json!({ "uri": "data:image/avif;base64,AAAAHGZ0eXBhdmlmAAAAAA==" });
    }),
    ("IMAGE_URI", "/images/0/uri", |f| f.json["images"][0] = json!({ "uri": "none.png" })),
    ("SKIN_MATRICES", "/inverseBindMatrices", |f| f.json["skins"][0]["joints"] = json!([0, 1])),
    ("SKIN_JOINTS", "/primitives/0/attributes/JOINTS_0", |f| skinned(f, 7.0, 1.0)),
    ("SKIN_WEIGHTS", "/primitives/0/attributes/WEIGHTS_0", |f| skinned(f, 0.0, 0.0)),
    ("SKIN_WEIGHTS", "/primitives/0/attributes/WEIGHTS_0", |f| skinned(f, 0.0, 0.999)),
    ("SKIN_WEIGHTS", "/primitives/0/attributes/WEIGHTS_0", |f| {
        skinned(f, 0.0, 1.0);
        give(f, "WEIGHTS_0", ("VEC4", FLOAT), &[1.5, -0.5, 0., 0.]);
    }),
    ("SKIN_JOINTS", "/primitives/0/attributes/JOINTS_0", |f| {
        skinned(f, 0.0, 1.0);
        give(f, "WEIGHTS_0", ("VEC4", FLOAT), &[0.5, 0.5, 0., 0.]);
    }),
    ("SKIN_MATRICES", "/inverseBindMatrices", |f| {
        let matrices = f.json["skins"][0]["inverseBindMatrices"].as_u64().unwrap() as usize;
        f.element(matrices, 0, 64)[12..16].copy_from_slice(&0.5f32.to_le_bytes());
    }),
    ("SKIN_ROOT", "/skins/0/joints", |f| {
        let apart = f.push("nodes", json!({}));
        f.json["skins"][0]["joints"] = json!([0, apart]);
    }),
    ("SKIN_SKELETON", "/skins/0/skeleton", |f| f.json["skins"][0]["skeleton"] = json!(1)),
    ("SKIN_SCENE", "/nodes/0/skin", |f| {
        let apart = f.push("nodes", json!({}));
        f.json["skins"][0]["joints"] = json!([apart]);
        surface_node(f)["skin"] = json!(0);
    }),
    ("NODE_SKIN", "/nodes/0", |f| {
        skinned(f, 0.0, 1.0);
        drop(surface_node(f).as_object_mut().unwrap().remove("skin"));
    }),
    ("SKIN_WEIGHTS", "/primitives/0", |f| surface_node(f)["skin"] = json!(0)),
    ("TARGET_COUNT", "/targets/0/POSITION", |f| {
        let short = f.floats("VEC3", &[0.0; 6]);
        primitive(f, SURFACE)["targets"] = json!([{ "POSITION": short }]);
    }),
    ("TARGET_TYPE", "/targets/0/POSITION", |f| {
        let uv = primitive(f, SURFACE)["attributes"]["TEXCOORD_0"].clone();
        primitive(f, SURFACE)["targets"] = json!([{ "POSITION": uv }]);
    }),
    ("TARGET_BASE", "/targets/0/NORMAL", |f| {
        let position = primitive(f, SURFACE)["attributes"]["POSITION"].clone();
        primitive(f, SURFACE)["targets"] = json!([{ "NORMAL": position }]);
    }),
    ("ATTRIBUTE_ALIGNMENT", "/targets/0/POSITION", |f| {
        let position = primitive(f, SURFACE)["attributes"]["POSITION"].clone();
        let mut moved = f.json["accessors"][position.as_u64().unwrap() as usize].clone();
        moved["byteOffset"] = json!(2);
        let moved = f.push("accessors", moved);
        primitive(f, SURFACE)["targets"] = json!([{ "POSITION": moved }]);
    }),
    // A second attribute interleaved with the bytes of the first.
    ("VIEW_STRIDE", "/bufferViews/0", |f| {
        let position = f.json["accessors"][f.attribute(SURFACE, "POSITION")].clone();
        let again = f.push("accessors", position);
        primitive(f, SURFACE)["targets"] = json!([{ "POSITION": again }]);
    }),
    ("TARGET_BOUNDS", "/accessors/", |f| {
        let count = f.json["accessors"][f.attribute(SURFACE, "POSITION")]["count"].as_u64().unwrap() as usize;
        let moved = f.floats("VEC3", &vec![0.0; 3 * count]);
        primitive(f, SURFACE)["targets"] = json!([{ "POSITION": moved }]);
    }),
    ("ANIMATION_BOUNDS", "/accessors/", |f| {
        let input = f.json["animations"][0]["samplers"][0]["input"].as_u64().unwrap() as usize;
        drop(f.json["accessors"][input].as_object_mut().unwrap().remove("max"));
    }),
    ("ANIMATION_PATH", "/channels/0/target/path", |f| {
        f.json["animations"][0]["channels"][0]["target"]["path"] = json!("colour");
    }),
    ("ANIMATION_TWICE", "/channels/1/target", |f| {
        let twice = channels(f)[0].clone();
        channels(f).push(twice);
    }),
    ("ANIMATION_TWICE", "/channels/1/target", |f| {
        pointed(f, "/nodes/0/rotation");
        let target = json!({ "node": 0, "path": "rotation" });
        channels(f).push(json!({ "sampler": 0, "target": target }));
    }),
    ("ANIMATION_MATRIX", "/channels/0/target/node", |f| {
        f.json["nodes"][0]["matrix"] = json!([1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]);
    }),
    ("ANIMATION_WEIGHTS", "/channels/0/target/node", |f| channels(f)[0]["target"]["path"] = json!("weights")),
    ("ANIMATION_KEYS", "/samplers/0/input", |f| {
        let once = f.floats("SCALAR", &[0.0]);
        f.json["animations"][0]["samplers"][0]["input"] = json!(once);
        f.json["animations"][0]["samplers"][0]["interpolation"] = json!("CUBICSPLINE");
    }),
    ("ANIMATION_TYPE", "/channels/0", |f| {
        let turns = f.accessor("VEC4", U16, &[0., 0., 0., 1.].repeat(3));
        f.json["animations"][0]["samplers"][0]["output"] = json!(turns);
    }),
    ("ANIMATION_ROTATION", "/channels/0", |f| {
        let turns = f.json["animations"][0]["samplers"][0]["output"].as_u64().unwrap() as usize;
        f.set_float(turns, 1, 4, 3.0);
    }),
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
];

/// An accessor without data is zero, unless an extension can provide the data, in which case any bounds are valid.
#[test]
fn what_is_stored_nowhere_is_zero() {
    let mut file = everything();
    let count = file.json["accessors"][file.attribute(SURFACE, "POSITION")]["count"].clone();
    let bounds = [9, 9, 9];
    let normals = json!({ "componentType": FLOAT, "type": "VEC3", "count": count, "min": bounds, "max": bounds });
    let normals = file.push("accessors", normals);
    primitive(&mut file, SURFACE)["attributes"]["NORMAL"] = json!(normals);
    assert_eq!(file.codes(), ["NORMAL_NORM"]);
    declare(&mut file, "KHR_draco_mesh_compression");
    let compressed = json!({ "bufferView": 0, "attributes": { "NORMAL": 0 } });
    primitive(&mut file, SURFACE)["extensions"]["KHR_draco_mesh_compression"] = compressed;
    assert_eq!(file.codes(), [""; 0]);
}

/// What an animation points to may have a default where the object that has it is there.
#[test]
fn pointers_lead_to_properties_of_what_is_there() {
    for (pointer, is_defined) in [
        ("/nodes/0/rotation", true),
        ("/nodes/0/weights/1", true),
        ("/cameras/0/perspective/yfov", true),
        ("/materials/0/extensions/KHR_materials_unlit/any", true),
        ("/extras", true),
        ("/cameras/1/perspective/zfar", true),
        ("/cameras/1/perspective/aspectRatio", false),
        ("/cameras/2/perspective/aspectRatio", true),
        ("/cameras/2/perspective/zfar", false),
        ("/scenes/0/nodes/0", true),
        ("/nodes/99/rotation", false),
        ("/nodes/99", false),
        ("/nodes/0", false),
        ("/nodes/99/weights/1", false),
        ("/cameras/7", false),
        ("/lights/7", false),
        ("/meshes/0/primitives/9", false),
        ("/scenes/0/nodes/99", false),
        ("/cameras/0/orthographic/xmag", false),
        ("/materials/0/extensions/KHR_none/any", false),
        ("nodes/0/rotation", false),
        ("", false),
    ] {
        let mut file = everything();
        for (property, value) in [("zfar", 9.0), ("aspectRatio", 1.5)] {
            let perspective = json!({ "yfov": 1, "znear": 0.5, property: value });
            file.push("cameras", json!({ "type": "perspective", "perspective": perspective }));
        }
        pointed(&mut file, pointer);
        let expected: &[&str] = if is_defined { &[] } else { &["ANIMATION_POINTER"] };
        assert_eq!(file.codes(), expected, "{pointer}");
    }
}

#[test]
fn unknown_properties_are_found_at_the_root_but_not_in_extras_and_extensions() {
    let mut file = everything();
    file.json["foo"] = json!(1);
    let said = file.findings()[0].to_string();
    assert!(said.starts_with("warning PROPERTY_UNKNOWN: ") && said.ends_with(", found `foo`"), "{said}");
    file.json.as_object_mut().unwrap().remove("foo");
    file.json["extras"] = json!({ "foo": { "bar": 1 } });
    declare(&mut file, "KHR_none");
    file.json["nodes"][0]["extensions"] = json!({ "KHR_none": { "foo": [{}] } });
    assert_eq!(file.codes(), [""; 0]);
}

#[test]
fn weights_add_up_but_for_rounding() {
    let mut file = everything();
    skinned(&mut file, 0.0, 1.0);
    give(&mut file, "JOINTS_0", ("VEC4", U16), &[0., 1., 2., 9.]);
    file.json["skins"][0] = json!({ "joints": [0, 1, 2] });
    give(&mut file, "WEIGHTS_0", ("VEC4", FLOAT), &[0.1, 0.2, 0.7, 0.0]);
    assert_eq!(file.codes(), [""; 0]);
    give(&mut file, "WEIGHTS_0", ("VEC4", FLOAT), &[0.1, 0.2, 0.71, 0.0]);
    let said: Vec<String> = file.findings().iter().map(ToString::to_string).collect();
    assert!(said.len() == 1 && said[0].starts_with("warning SKIN_WEIGHTS: "), "{said:?}");
    for (weights, expected) in [([40000., 25535., 0., 0.], &[][..]), ([40000., 25534., 0., 0.], &["SKIN_WEIGHTS"][..])]
    {
        let weights = give(&mut file, "WEIGHTS_0", ("VEC4", U16), &weights);
        file.json["accessors"][weights]["normalized"] = json!(true);
        assert_eq!(file.codes(), expected);
    }
}

/// Rotated by 30° about z and mirrored, with the digits that many exporters write, and with an uneven scale.
#[test]
fn matrices_may_mirror_and_scale_unevenly() {
    let mut file = everything();
    file.json.as_object_mut().unwrap().remove("animations");
    let matrix = json!([0.866, 0.5, 0, 0, -1.5, 2.5981, 0, 0, 0, 0, -0.01, 0, 5, 6, 7, 1]);
    surface_node(&mut file)["matrix"] = matrix;
    assert_eq!(file.codes(), [""; 0]);
}

/// Small axes that are rounded to five digits, as of a model in centimetres.
#[test]
fn small_matrices_may_be_rounded_and_flat_ones_are_warned_of() {
    let mut file = everything();
    file.json.as_object_mut().unwrap().remove("animations");
    surface_node(&mut file)["matrix"] =
        json!([0.00867, 0.005, 0, 0, -0.005, 0.00866, 0, 0, 0.00002, 0, 0.01, 0, 0, 0, 0, 1]);
    assert_eq!(file.codes(), [""; 0]);
    surface_node(&mut file)["matrix"] = json!([1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]);
    let said: Vec<String> = file.findings().iter().map(ToString::to_string).collect();
    // The other is of the splats below.
    let starts = ["warning NODE_MATRIX: ", "warning SPLAT_FLAT: "];
    assert!(said.len() == 2 && said.iter().zip(starts).all(|(said, start)| said.starts_with(start)), "{said:?}");
}

/// The specification restricts the first set of colours alone.
#[test]
fn further_colours_may_be_of_any_value() {
    let mut file = everything();
    give(&mut file, "COLOR_0", ("VEC3", FLOAT), &[0., 1., 0.]);
    give(&mut file, "COLOR_1", ("VEC3", FLOAT), &[0., 3., 0.]);
    assert_eq!(file.codes(), [""; 0]);
}

#[test]
fn media_types_are_of_any_case() {
    let mut file = everything();
    file.json["buffers"][0]["uri"] = json!("data:Application/Octet-Stream;base64,AAAA");
    assert!(!file.codes().contains(&"BUFFER_TYPE"), "{:?}", file.codes());
}

/// Of images, indices, attributes and matrices of skins a view holds one kind; of other data it may hold several.
#[test]
fn keys_and_sparse_elements_may_share_a_view() {
    let mut file = everything();
    let times = file.json["animations"][0]["samplers"][0]["input"].as_u64().unwrap() as usize;
    let view = file.json["accessors"][times]["bufferView"].clone();
    let part = json!({ "bufferView": view, "componentType": U16 });
    let sparse = json!({ "count": 1, "indices": part, "values": { "bufferView": view } });
    file.json["accessors"][times]["sparse"] = sparse;
    assert!(!file.codes().contains(&"VIEW_DATA"), "{:?}", file.codes());
}

/// What an extension provides is there, though it is not stored.
#[test]
fn joints_and_weights_may_be_compressed() {
    let mut file = everything();
    skinned(&mut file, 0.0, 1.0);
    declare(&mut file, "KHR_draco_mesh_compression");
    let compressed = json!({ "bufferView": 0, "attributes": { "JOINTS_0": 0, "WEIGHTS_0": 1 } });
    primitive(&mut file, SURFACE)["extensions"]["KHR_draco_mesh_compression"] = compressed;
    for name in ["JOINTS_0", "WEIGHTS_0"] {
        let accessor = file.attribute(SURFACE, name);
        file.json["accessors"][accessor].as_object_mut().unwrap().remove("bufferView");
    }
    assert_eq!(file.codes(), [""; 0]);
}

#[test]
fn rotations_of_splines_have_tangents_of_any_length() {
    let mut file = everything();
    let [tangent, turn] = [[0.5, 0., 0., 3.], [0., 0., 0., 1.]];
    let turns = file.floats("VEC4", &[tangent, turn, tangent].concat().repeat(3));
    let sampler = &mut file.json["animations"][0]["samplers"][0];
    sampler["output"] = json!(turns);
    sampler["interpolation"] = json!("CUBICSPLINE");
    assert_eq!(file.codes(), [""; 0]);
    file.set_float(turns, 4, 4, 3.0);
    assert_eq!(file.codes(), ["ANIMATION_ROTATION"]);
}
