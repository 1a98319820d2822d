//! Validator for the part of JSON Schema (2020-12) that the schemas of glTF and of its extensions use.
//!
//! Half a page of code, in place of a crate with forty dependencies in the program; tests compare its answers with that
//! crate's.

use std::collections::BTreeMap;
use std::sync::LazyLock;

use serde_json::{Map, Value};

use super::super::Findings;

/// Schemas by file name, as used in `$ref`.
static SCHEMAS: LazyLock<BTreeMap<String, Value>> = LazyLock::new(|| {
    // Rules of glTF itself, written by hand; Khronos' schemas are split over seventy files.
    let core: Map<String, Value> =
        serde_json::from_str(include_str!("core.schema.json")).expect("the embedded schemas are JSON objects");
    let mut schemas: BTreeMap<String, Value> = core.into_iter().collect();
    for text in HYBRID_SCHEMAS {
        let schema: Value = serde_json::from_str(text).expect("the embedded schemas are JSON objects");
        let name = schema["$id"].as_str().expect("every schema names itself").to_owned();
        schemas.insert(name, schema);
    }
    schemas
});

macro_rules! hybrid_schemas {
    ($($name:literal),+ $(,)?) => {
        [$(include_str!(concat!("../../../../schema/EXT_gaussian_splatting_hybrid/schema/", $name, ".schema.json"))),+]
    };
}

const HYBRID_SCHEMAS: [&str; 14] = hybrid_schemas![
    "KHR_gaussian_splatting.EXT_gaussian_splatting_hybrid",
    "binding",
    "deformationField",
    "deformationHeads",
    "footprint",
    "glTF.EXT_gaussian_splatting_hybrid",
    "hexplaneLevel",
    "material.EXT_gaussian_splatting_hybrid",
    "mesh.primitive.EXT_gaussian_splatting_hybrid",
    "mlpLayer",
    "opacityField",
    "scene.EXT_gaussian_splatting_hybrid",
    "sphericalHarmonics",
    "texelSource",
];

/// Reports everything in `value`, located at the JSON pointer `at`, that the schema called `name` forbids.
pub(super) fn check(value: &Value, name: &str, at: &str, findings: &mut Findings) {
    if let Some(schema) = SCHEMAS.get(name) {
        apply(schema, value, at, findings);
    }
}

/// Property that no schema of its object defines.
pub(super) struct Unknown {
    /// JSON pointer of the object.
    pub(super) at: String,
    pub(super) name: String,
    /// Properties that the object may have.
    pub(super) known: Vec<String>,
}

/// Every property in `value`, located at `at`, that the schema called `name` does not define; JSON Schema allows them.
/// Objects of extensions have schemas of their own.
pub(super) fn unknown(value: &Value, name: &str, at: &str) -> Vec<Unknown> {
    let mut found = vec![];
    if let Some(schema) = SCHEMAS.get(name) {
        unknown_in(&[schema], value, at, &mut found);
    }
    found
}

fn unknown_in<'a>(schemas: &[&'a Value], value: &Value, at: &str, found: &mut Vec<Unknown>) {
    let mut all = vec![];
    schemas.iter().for_each(|schema| flatten(schema, &mut all));
    let of_key = |key: &str, name: &str| -> Vec<&'a Value> {
        all.iter().filter_map(|schema| schema.get(key)?.get(name)).collect()
    };
    // Any name may be in an object of which no schema lists properties, such as `attributes` and `extensions`.
    let lists_properties = all.iter().any(|schema| schema.get("properties").is_some());
    match value {
        Value::Object(object) if lists_properties => {
            for (name, inner) in object {
                let schemas = of_key("properties", name);
                if schemas.is_empty() {
                    let known = all.iter().filter_map(|schema| schema.get("properties")?.as_object());
                    let known =
                        known.flat_map(|p| p.keys()).filter(|key| !["extensions", "extras"].contains(&key.as_str()));
                    found.push(Unknown { at: at.to_owned(), name: name.clone(), known: known.cloned().collect() });
                }
                unknown_in(&schemas, inner, &format!("{at}/{}", escaped(name)), found);
            }
        }
        Value::Array(items) => {
            let schemas: Vec<&Value> = all.iter().filter_map(|schema| schema.get("items")).collect();
            items.iter().enumerate().for_each(|(i, item)| unknown_in(&schemas, item, &format!("{at}/{i}"), found));
        }
        _ => {}
    }
}

/// Collects a schema and those that apply in addition to it.
fn flatten<'a>(schema: &'a Value, all: &mut Vec<&'a Value>) {
    all.push(schema);
    let referred = schema.get("$ref").and_then(Value::as_str).and_then(|name| SCHEMAS.get(name));
    let parts = schema.get("allOf").and_then(Value::as_array).into_iter().flatten();
    referred.into_iter().chain(parts).for_each(|part| flatten(part, all));
}

/// Key with `~` and `/` escaped, as RFC 6901 requires.
pub(super) fn escaped(key: &str) -> String {
    key.replace('~', "~0").replace('/', "~1")
}

fn apply(schema: &Value, value: &Value, at: &str, findings: &mut Findings) {
    let Some(schema) = schema.as_object() else { return };
    if let Some(name) = schema.get("$ref").and_then(Value::as_str) {
        check(value, name, at, findings);
    }
    if let Some(kind) = schema.get("type").and_then(Value::as_str)
        && !is_of(value, kind)
    {
        // No further rule applies to a value of another type.
        return findings.error("SCHEMA_TYPE", at, kind, shown(value));
    }
    if let Some(only) = schema.get("const")
        && only != value
    {
        findings.error("SCHEMA_VALUE", at, only.to_string(), shown(value));
    }
    if let Some(Value::Array(allowed)) = schema.get("enum")
        && !allowed.iter().any(|a| equal(a, value))
    {
        let allowed: Vec<String> = allowed.iter().map(Value::to_string).collect();
        findings.error("SCHEMA_VALUE", at, allowed.join(", "), shown(value));
    }
    let parts = |key: &str| schema.get(key).and_then(Value::as_array).map_or(&[][..], Vec::as_slice);
    parts("allOf").iter().for_each(|part| apply(part, value, at, findings));
    let matching = |parts: &[Value]| parts.iter().filter(|part| holds(part, value)).count();
    let (any, one) = (parts("anyOf"), parts("oneOf"));
    if !any.is_empty() && matching(any) == 0 {
        findings.error("SCHEMA_CHOICE", at, "one of several forms", shown(value));
    }
    if !one.is_empty() && matching(one) != 1 {
        let expected = format!("exactly one of {}", one.iter().map(brief).collect::<Vec<_>>().join(" or "));
        findings.error("SCHEMA_CHOICE", at, expected, format!("{} of them", matching(one)));
    }
    match value {
        Value::Object(object) => check_object(schema, object, at, findings),
        Value::Array(array) => check_array(schema, array, at, findings),
        Value::Number(number) => check_number(schema, number.as_f64().unwrap_or_default(), at, findings),
        _ => {}
    }
}

/// Whether `value` satisfies all rules of `schema`.
fn holds(schema: &Value, value: &Value) -> bool {
    let mut findings = Findings::default();
    apply(schema, value, "", &mut findings);
    findings.0.is_empty()
}

fn check_object(schema: &Map<String, Value>, object: &Map<String, Value>, at: &str, findings: &mut Findings) {
    for key in schema.get("required").and_then(Value::as_array).into_iter().flatten().filter_map(Value::as_str) {
        if !object.contains_key(key) {
            findings.error("SCHEMA_REQUIRED", at, format!("the property `{key}`"), "none");
        }
    }
    for (key, needed) in schema.get("dependentRequired").and_then(Value::as_object).into_iter().flatten() {
        for needed in needed.as_array().into_iter().flatten().filter_map(Value::as_str) {
            if object.contains_key(key) && !object.contains_key(needed) {
                findings.error("SCHEMA_REQUIRED", at, format!("`{needed}` next to `{key}`"), "none");
            }
        }
    }
    if let Some(least) = schema.get("minProperties").and_then(Value::as_u64)
        && (object.len() as u64) < least
    {
        findings.error("SCHEMA_LENGTH", at, format!("at least {least} properties"), object.len());
    }
    let properties = schema.get("properties").and_then(Value::as_object);
    for (key, value) in object {
        let inner = properties.and_then(|p| p.get(key)).or_else(|| schema.get("additionalProperties"));
        if let Some(inner) = inner {
            apply(inner, value, &format!("{at}/{}", escaped(key)), findings);
        }
    }
}

fn check_array(schema: &Map<String, Value>, array: &[Value], at: &str, findings: &mut Findings) {
    let limit = |key: &str| schema.get(key).and_then(Value::as_u64);
    let length = array.len() as u64;
    let too_few = limit("minItems").filter(|&least| length < least).map(|n| format!("at least {n} items"));
    let too_many = limit("maxItems").filter(|&most| length > most).map(|n| format!("at most {n} items"));
    for expected in too_few.into_iter().chain(too_many) {
        findings.error("SCHEMA_LENGTH", at, expected, length);
    }
    if schema.get("uniqueItems") == Some(&Value::Bool(true)) {
        let mut seen = std::collections::BTreeSet::new();
        if let Some(twice) = array.iter().find(|item| !seen.insert(item.to_string())) {
            findings.error("SCHEMA_UNIQUE", at, "no item twice", shown(twice));
        }
    }
    if let Some(inner) = schema.get("items") {
        array.iter().enumerate().for_each(|(i, item)| apply(inner, item, &format!("{at}/{i}"), findings));
    }
}

fn check_number(schema: &Map<String, Value>, value: f64, at: &str, findings: &mut Findings) {
    let limit = |key: &str| schema.get(key).and_then(Value::as_f64);
    let faults = [
        limit("minimum").filter(|&least| value < least).map(|l| format!("at least {l}")),
        limit("maximum").filter(|&most| value > most).map(|m| format!("at most {m}")),
        limit("exclusiveMinimum").filter(|&least| value <= least).map(|l| format!("more than {l}")),
        limit("multipleOf").filter(|&unit| value % unit != 0.0).map(|u| format!("a multiple of {u}")),
    ];
    faults.into_iter().flatten().for_each(|expected| findings.error("SCHEMA_RANGE", at, expected, value));
}

fn is_of(value: &Value, kind: &str) -> bool {
    match kind {
        "object" => value.is_object(),
        "array" => value.is_array(),
        "string" => value.is_string(),
        "boolean" => value.is_boolean(),
        "number" => value.is_number(),
        // 3.0 is an integer in JSON Schema.
        "integer" => value.is_i64() || value.is_u64() || value.as_f64().is_some_and(|v| v.fract() == 0.0),
        _ => value.is_null(),
    }
}

fn equal(a: &Value, b: &Value) -> bool {
    a == b || a.as_f64().is_some_and(|a| b.as_f64() == Some(a))
}

/// Short description of a schema: the alternatives of a `oneOf` are distinguished by the properties they require.
fn brief(schema: &Value) -> String {
    let required = schema.get("required").and_then(Value::as_array).into_iter().flatten().filter_map(Value::as_str);
    format!("({})", required.collect::<Vec<_>>().join(", "))
}

/// Value as text in a message: complete if short.
pub(super) fn shown(value: &Value) -> String {
    let text = value.to_string();
    if text.chars().count() <= 60 { text } else { format!("{}…", text.chars().take(60).collect::<String>()) }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use proptest::prelude::*;
    use serde_json::json;

    use super::*;

    const KNOWN: [&str; 22] = [
        "$ref",
        "type",
        "const",
        "enum",
        "allOf",
        "anyOf",
        "oneOf",
        "required",
        "dependentRequired",
        "minProperties",
        "properties",
        "additionalProperties",
        "minItems",
        "maxItems",
        "uniqueItems",
        "items",
        "minimum",
        "maximum",
        "exclusiveMinimum",
        "multipleOf",
        "$id",
        "$schema",
    ];

    fn keywords_and_references(schema: &Value, keywords: &mut Vec<String>, references: &mut Vec<String>) {
        let Some(object) = schema.as_object() else { return };
        for (key, value) in object {
            keywords.push(key.clone());
            match key.as_str() {
                "$ref" => references.push(value.as_str().unwrap().to_owned()),
                "properties" => {
                    value.as_object().unwrap().values().for_each(|v| keywords_and_references(v, keywords, references));
                }
                "allOf" | "anyOf" | "oneOf" => {
                    value.as_array().unwrap().iter().for_each(|v| keywords_and_references(v, keywords, references));
                }
                "items" | "additionalProperties" => keywords_and_references(value, keywords, references),
                _ => {}
            }
        }
    }

    #[test]
    fn every_schema_is_here_and_every_keyword_and_reference_known() {
        let (mut keywords, mut references) = (vec![], vec![]);
        SCHEMAS.values().for_each(|schema| keywords_and_references(schema, &mut keywords, &mut references));
        let unknown: Vec<_> = keywords
            .iter()
            // The only pattern is that of the digest, which `binding` checks by computing it.
            .filter(|k| !KNOWN.contains(&k.as_str()))
            .filter(|k| !["title", "description", "default", "pattern"].contains(&k.as_str()))
            .collect();
        assert!(unknown.is_empty(), "{unknown:?}");
        assert!(references.iter().all(|name| SCHEMAS.contains_key(name)), "{references:?}");
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("schema/EXT_gaussian_splatting_hybrid/schema");
        for file in folder.read_dir().unwrap() {
            let name = file.unwrap().file_name().into_string().unwrap();
            assert!(SCHEMAS.contains_key(&name), "{name} is not embedded");
        }
    }

    /// JSON with keys that occur in the schemas, so that many rules apply.
    fn documents() -> impl Strategy<Value = Value> {
        let keys = prop::sample::select(vec![
            "colorSpace",
            "lambda",
            "layers",
            "mode",
            "near",
            "background",
            "sortKey",
            "opacity",
            "sphericalHarmonics",
            "degree",
            "coefficients",
            "accessor",
            "texture",
            "index",
            "width",
            "height",
            "scale",
            "offset",
            "channel",
            "activation",
            "node",
            "triangles",
            "triangleCount",
            "times",
            "translations",
            "rotations",
            "scales",
            "name",
            "extensions",
            "binding",
            "deformation",
            "inputs",
            "outputs",
            "weights",
            "bias",
        ]);
        let leaf = prop_oneof![
            Just(Value::Null),
            any::<bool>().prop_map(Value::from),
            (-2i64..9).prop_map(Value::from),
            prop::sample::select(vec![0.5, 1.0, -1.5, 3.0]).prop_map(Value::from),
            Just(json!("stable")),
            Just(json!([0, 0, 0])),
        ];
        leaf.prop_recursive(4, 40, 6, move |inner| {
            prop_oneof![
                prop::collection::vec(inner.clone(), 0..5).prop_map(Value::from),
                prop::collection::btree_map(keys.clone(), inner, 0..8).prop_map(|map| map
                    .into_iter()
                    .map(|(k, v)| (k.to_owned(), v))
                    .collect::<Map<_, _>>()
                    .into()),
            ]
        })
    }

    fn oracles() -> Vec<(String, jsonschema::Validator)> {
        let base = "json-schema:///";
        // References are relative to the base; relative `$id`s would be nested.
        let absolute = |name: &str, schema: &Value| {
            let mut schema = schema.clone();
            schema["$id"] = json!(format!("{base}{name}"));
            schema["$schema"] = json!("https://json-schema.org/draft/2020-12/schema");
            (format!("{base}{name}"), jsonschema::Resource::from_contents(schema))
        };
        let resources: Vec<_> = SCHEMAS.iter().map(|(name, schema)| absolute(name, schema)).collect();
        let registry = jsonschema::Registry::new().extend(resources).unwrap().prepare().unwrap();
        let oracle = |name: &String| {
            let schema =
                json!({ "$schema": "https://json-schema.org/draft/2020-12/schema", "$ref": format!("{base}{name}") });
            (name.clone(), jsonschema::options().with_registry(&registry).build(&schema).unwrap())
        };
        SCHEMAS.keys().map(oracle).collect()
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(300))]
        #[test]
        fn the_verdict_is_that_of_the_jsonschema_crate(document in documents()) {
            use std::sync::LazyLock;
            static ORACLES: LazyLock<Vec<(String, jsonschema::Validator)>> = LazyLock::new(oracles);
            for (name, oracle) in ORACLES.iter() {
                let mut findings = Findings::default();
                check(&document, name, "", &mut findings);
                prop_assert_eq!(findings.0.is_empty(), oracle.is_valid(&document), "{} {}: {:?}", name, document, findings.0);
            }
        }
    }
}
