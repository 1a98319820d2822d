//! Normalisation of integers written as `5126.0` or `1e2`, which JSON does not distinguish but typed readers do.

use serde_json::{Number, Value};

/// Properties of glTF and of the supported extensions that are integers, or arrays of them.
const INTEGERS: [&str; 54] = [
    "accessor",
    "bias",
    "buffer",
    "bufferView",
    "byteLength",
    "byteOffset",
    "byteStride",
    "camera",
    "channel",
    "children",
    "componentType",
    "count",
    "deformation",
    "degree",
    "features",
    "height",
    "index",
    "indices",
    "input",
    "inputs",
    "inverseBindMatrices",
    "joints",
    "layers",
    "light",
    "magFilter",
    "material",
    "mesh",
    "minFilter",
    "mode",
    "node",
    "nodes",
    "output",
    "outputs",
    "planes",
    "primitive",
    "resolution",
    "rotations",
    "sampler",
    "scales",
    "scene",
    "skeleton",
    "skin",
    "source",
    "surfaceVertices",
    "target",
    "texCoord",
    "texture",
    "times",
    "translations",
    "triangleCount",
    "triangles",
    "width",
    "wrapS",
    "wrapT",
];

/// Properties whose objects contain only integers: accessors by attribute name.
const OF_INTEGERS: [&str; 2] = ["attributes", "targets"];

/// Magnitude beyond which f64 does not represent all integers.
const BEYOND: f64 = 9e15;

/// Rewrites whole numbers as integers where glTF has integers. Other numbers, and all content of `extras`, stay
/// unchanged.
pub(in crate::format) fn write_as_integers(root: &mut Value) {
    visit(root, false, false);
}

/// Visits a value; `here`: whether its numbers are integers; `below`: whether those of nested objects are, too.
fn visit(value: &mut Value, here: bool, below: bool) {
    match value {
        Value::Number(number) if here => {
            if let Some(whole) = whole(number) {
                *number = whole;
            }
        }
        Value::Array(items) => items.iter_mut().for_each(|item| visit(item, here, below)),
        Value::Object(object) => {
            for (key, inner) in object.iter_mut().filter(|(key, _)| *key != "extras") {
                let has_integers = OF_INTEGERS.contains(&key.as_str());
                visit(inner, below || INTEGERS.contains(&key.as_str()), below || has_integers);
            }
        }
        _ => {}
    }
}

fn whole(number: &Number) -> Option<Number> {
    let value = number.as_f64().filter(|_| number.is_f64())?;
    let is_whole = value.fract() == 0.0 && value.abs() < BEYOND && !(value == 0.0 && value.is_sign_negative());
    is_whole.then(|| Number::from(value as i64))
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn whole_numbers_are_integers_where_gltf_has_integers() {
        let mut root: Value = serde_json::from_str(
            r#"{
                "accessors": [{ "componentType": 5126.0, "count": 1e2, "min": [1.0], "extras": { "count": 2.0 } }],
                "meshes": [{ "primitives": [{ "attributes": { "POSITION": 0.0, "_ID": 1.5 }, "targets": [{ "NORMAL": 3.0 }] }] }],
                "nodes": [{ "children": [1.0, -0.0, 1e16], "scale": [2.0, 2.0, 2.0] }]
            }"#,
        )
        .unwrap();
        write_as_integers(&mut root);
        let expected = json!({
            "accessors": [{ "componentType": 5126, "count": 100, "min": [1.0], "extras": { "count": 2.0 } }],
            "meshes": [{ "primitives": [{ "attributes": { "POSITION": 0, "_ID": 1.5 }, "targets": [{ "NORMAL": 3 }] }] }],
            "nodes": [{ "children": [1, -0.0, 1e16], "scale": [2.0, 2.0, 2.0] }],
        });
        assert_eq!(root.to_string(), expected.to_string());
    }
}
