//! Faults in core glTF.

use serde_json::json;

use super::{
    FLOAT, Planted, SPLATS, SURFACE, U16, copied, declare, everything, pointed, primitive, skinned, surface_node,
};

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
    ("SKIN_WEIGHTS", "/primitives/0", |f| surface_node(f)["skin"] = json!(0)),
    ("TARGET_COUNT", "/targets/0/POSITION", |f| {
        let short = f.floats("VEC3", &[0.0; 6]);
        primitive(f, SURFACE)["targets"] = json!([{ "POSITION": short }]);
    }),
    ("TARGET_TYPE", "/targets/0/POSITION", |f| {
        let uv = primitive(f, SURFACE)["attributes"]["TEXCOORD_0"].clone();
        primitive(f, SURFACE)["targets"] = json!([{ "POSITION": uv }]);
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
