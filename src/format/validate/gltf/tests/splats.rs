//! Faults in `KHR_gaussian_splatting`.

use serde_json::{Value, json};

use super::{File, HYBRID, KHR, Planted, SPLATS, SURFACE, U16, copied, everything, node_of, primitive};

pub(super) const PLANTED: &[Planted] = &[
    ("SCHEMA_REQUIRED", "/extensions/KHR_gaussian_splatting", |f| {
        drop(primitive(f, SPLATS)["extensions"][KHR].as_object_mut().unwrap().remove("colorSpace"));
    }),
    ("SPLAT_MODE", "/mode", |f| primitive(f, SPLATS)["mode"] = json!(4)),
    ("SPLAT_INDICES", "/indices", |f| {
        let indices = f.accessor("SCALAR", U16, &[0., 1., 2., 3., 4., 5.]);
        primitive(f, SPLATS)["indices"] = json!(indices);
    }),
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
    ("ATTRIBUTE_ALIGNMENT", "/attributes/KHR_gaussian_splatting:OPACITY", |f| {
        let before = f.attribute(SPLATS, "KHR_gaussian_splatting:OPACITY");
        let count = f.json["accessors"][before]["count"].as_u64().unwrap();
        let packed = f.accessor("SCALAR", U16, &vec![0.0; count as usize]);
        f.json["accessors"][packed]["normalized"] = json!(true);
        primitive(f, SPLATS)["attributes"]["KHR_gaussian_splatting:OPACITY"] = json!(packed);
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
    ("SPLAT_FLAT", "/nodes/", |f| {
        unbind(f);
        node_of(f, SPLATS)["scale"] = json!([1, 0, 1]);
    }),
    ("SPLAT_FLAT", "/nodes/", |f| {
        unbind(f);
        let top = f.json["scenes"][0]["nodes"][0].as_u64().unwrap() as usize;
        f.json["nodes"][top]["scale"] = json!([0, 0, 0]);
    }),
    ("SPLAT_FLAT", "/EXT_mesh_gpu_instancing/attributes/SCALE", |f| {
        unbind(f);
        let scales = f.floats("VEC3", &[1., 1., 1., 0., 0., 0., 1., 0., 1.]);
        copied(f, SPLATS, &json!({ "SCALE": scales }));
    }),
    ("SPLAT_FALLBACK_COLOR", "/attributes/COLOR_0", |f| {
        let dc = f.attribute(SPLATS, "KHR_gaussian_splatting:SH_DEGREE_0_COEF_0");
        f.set_float(dc, 1, 3, 9.0);
        f.set_float(dc, 2, 3, -9.0);
    }),
];

/// Leaves the splats to their node.
fn unbind(file: &mut File) {
    let object = &mut primitive(file, SPLATS)["extensions"][KHR]["extensions"][HYBRID];
    drop(object.as_object_mut().unwrap().remove("binding"));
}

#[test]
fn flat_transforms_that_move_or_place_no_splats_are_no_fault() {
    let mut file = everything();
    // Bound splats are on their triangles.
    node_of(&mut file, SPLATS)["scale"] = json!([0, 0, 0]);
    assert_eq!(file.codes(), [""; 0]);
    // If these move, they are not flat at all times.
    node_of(&mut file, SURFACE)["scale"] = json!([0, 0, 0]);
    assert_eq!(file.codes(), [""; 0]);
    let mut still = everything();
    still.json.as_object_mut().unwrap().remove("animations");
    assert_eq!(still.codes(), [""; 0]);
    node_of(&mut still, SURFACE)["scale"] = json!([0, 0, 0]);
    assert_eq!(still.codes(), ["SPLAT_FLAT"]);
    // The transform of a node with a skin has no effect.
    node_of(&mut still, SURFACE)["skin"] = json!(0);
    assert!(!still.codes().contains(&"SPLAT_FLAT"));
    node_of(&mut file, SURFACE)["scale"] = json!([1, 1, 1]);
    unbind(&mut file);
    assert_eq!(file.codes(), ["SPLAT_FLAT"]);
    node_of(&mut file, SPLATS)["scale"] = json!([1, 1, 1]);
    node_of(&mut file, SURFACE)["scale"] = json!([0, 0, 0]);
    assert_eq!(file.codes(), [""; 0]);
    node_of(&mut file, SPLATS)["scale"] = json!([0, 0, 0]);
    let is_splats = |node: &Value| node["mesh"] == json!(SPLATS);
    let node = file.json["nodes"].as_array().unwrap().iter().position(is_splats).unwrap();
    file.json["animations"][0]["channels"][0]["target"]["node"] = json!(node);
    assert_eq!(file.codes(), [""; 0]);
}
