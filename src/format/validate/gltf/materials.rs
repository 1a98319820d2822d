//! Validation of materials, and of the primitives that have them.

use std::collections::HashMap;

use serde_json::Value;

use super::super::{Findings, Offenders};
use super::schema::escaped;
use super::{index, objects, primitives};
use crate::format::gltf::extension::{TEXTURE_TRANSFORM, extension_of};

/// Primitives, each with its JSON pointer.
pub(super) type Primitives<'a> = [(String, &'a Value)];

pub(super) fn check(root: &Value, findings: &mut Findings) {
    let shown_by = primitives_of(root);
    for (i, (at, material)) in objects(root, "materials", "").enumerate() {
        let shown = shown_by.get(&i).map_or(&[][..], Vec::as_slice);
        for (at, texture) in textures(material, &at) {
            check_set(set_of(texture), shown, "MATERIAL_TEXCOORD", &at, findings);
        }
        let mode = material.get("alphaMode").and_then(Value::as_str).unwrap_or("OPAQUE");
        if material.get("alphaCutoff").is_some() && mode != "MASK" {
            findings.warning("MATERIAL_CUTOFF", format!("{at}/alphaCutoff"), "alphaMode MASK beside it", mode);
        }
    }
}

/// Primitives of every material.
pub(super) fn primitives_of(root: &Value) -> HashMap<usize, Vec<(String, &Value)>> {
    let mut shown_by: HashMap<usize, Vec<(String, &Value)>> = HashMap::new();
    for (at, primitive) in primitives(root) {
        if let Some(material) = index(primitive, "material") {
            shown_by.entry(material).or_default().push((at, primitive));
        }
    }
    shown_by
}

/// Textures of a material and of its extensions, each with its JSON pointer.
fn textures<'a>(object: &'a Value, at: &str) -> Vec<(String, &'a Value)> {
    let mut found = vec![];
    for (key, inner) in object.as_object().into_iter().flatten().filter(|(key, _)| *key != "extras") {
        let at = format!("{at}/{}", escaped(key));
        if key.ends_with("Texture") && inner.get("index").is_some() {
            found.push((at, inner));
        } else {
            found.extend(textures(inner, &at));
        }
    }
    found
}

/// Set of coordinates of a texture.
pub(super) fn set_of(texture: &Value) -> usize {
    let moved = extension_of(texture, TEXTURE_TRANSFORM).and_then(|transform| index(transform, "texCoord"));
    moved.or(index(texture, "texCoord")).unwrap_or(0)
}

/// Reports primitives without the set of coordinates of their material.
pub(super) fn check_set(set: usize, shown: &Primitives<'_>, code: &'static str, at: &str, findings: &mut Findings) {
    let name = format!("TEXCOORD_{set}");
    let mut lacking = Offenders::default();
    for (at_primitive, primitive) in shown {
        if primitive.get("attributes").is_some_and(|a| a.get(&name).is_none()) {
            lacking.note(|| at_primitive.clone());
        }
    }
    if let Some(found) = lacking.summary(shown.len()) {
        let expected = format!("{name} in every primitive of the material");
        findings.error(code, at, expected, format!("none in {found}"));
    }
}
