//! Faults in `KHR_gaussian_splatting`.

use serde_json::json;

use super::{KHR, Planted, SPLATS, U16, primitive};

pub(super) const PLANTED: &[Planted] = &[
    ("SCHEMA_REQUIRED", "/extensions/KHR_gaussian_splatting", |f| {
        drop(primitive(f, SPLATS)["extensions"][KHR].as_object_mut().unwrap().remove("colorSpace"));
    }),
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
    ("SPLAT_FALLBACK_COLOR", "/attributes/COLOR_0", |f| {
        let dc = f.attribute(SPLATS, "KHR_gaussian_splatting:SH_DEGREE_0_COEF_0");
        f.set_float(dc, 1, 3, 9.0);
        f.set_float(dc, 2, 3, -9.0);
    }),
];
