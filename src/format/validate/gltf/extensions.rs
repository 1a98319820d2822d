//! Validation of extensions: used, declared and supported.

use std::collections::BTreeMap;

use serde_json::Value;

use super::super::Findings;
use super::schema::escaped;
use crate::format::gltf::{expected_for, json::strings};

/// Extensions that relax rules without an object of their own, so that documents have to require them.
const WITHOUT_OBJECT: [&str; 1] = ["KHR_mesh_quantization"];

pub(super) fn check(root: &Value, findings: &mut Findings) {
    let [used, required] = ["extensionsUsed", "extensionsRequired"].map(|key| strings(root, key).collect::<Vec<_>>());
    let mut present = BTreeMap::new();
    walk(root, &mut String::new(), &mut present);
    for (name, at) in &present {
        if !used.contains(name) {
            findings.error("EXTENSION_UNDECLARED", at, format!("`{name}` in extensionsUsed"), "none");
        }
    }
    for (i, name) in required.iter().enumerate() {
        if !used.contains(name) {
            let at = format!("/extensionsRequired/{i}");
            findings.error("EXTENSION_UNDECLARED", at, format!("`{name}` in extensionsUsed as well"), "none");
        }
    }
    for (i, name) in used.iter().enumerate() {
        let at = format!("/extensionsUsed/{i}");
        if WITHOUT_OBJECT.contains(name) {
            if !required.contains(name) {
                findings.error("EXTENSION_OPTIONAL", at, format!("`{name}` in extensionsRequired as well"), "none");
            }
        } else if !present.contains_key(*name) {
            findings.warning("EXTENSION_UNUSED", at, format!("an object of `{name}`"), "none");
        }
    }
}

/// Reports required extensions that Centaur does not support.
pub(super) fn check_support(root: &Value, findings: &mut Findings) {
    for (i, name) in strings(root, "extensionsRequired").enumerate() {
        if let Some(expected) = expected_for(name) {
            findings.warning(
                "EXTENSION_UNSUPPORTED",
                format!("/extensionsRequired/{i}"),
                expected,
                format!("`{name}`"),
            );
        }
    }
}

/// Collects every extension's name with the place of its first object. Content of `extras` is unconstrained.
fn walk<'a>(value: &'a Value, at: &mut String, present: &mut BTreeMap<&'a str, String>) {
    let length = at.len();
    match value {
        Value::Object(object) => {
            for (key, inner) in object.iter().filter(|(key, _)| *key != "extras") {
                at.push('/');
                at.push_str(&escaped(key));
                if key == "extensions"
                    && let Some(extensions) = inner.as_object()
                {
                    for name in extensions.keys() {
                        present.entry(name).or_insert_with(|| format!("{at}/{}", escaped(name)));
                    }
                }
                walk(inner, at, present);
                at.truncate(length);
            }
        }
        Value::Array(items) => {
            for (i, item) in items.iter().enumerate() {
                at.push_str(&format!("/{i}"));
                walk(item, at, present);
                at.truncate(length);
            }
        }
        _ => {}
    }
}
