//! Validation of glTF 2.0 and its splat extensions.

mod accessors;
mod attributes;
mod binding;
mod container;
mod document;
mod extensions;
mod fields;
mod flat;
mod hybrid;
mod materials;
mod moving;
mod pictures;
mod references;
mod scenes;
mod schema;
mod skins;
mod splats;
#[cfg(test)]
mod tests;
mod views;

use std::path::Path;

use serde_json::Value;

use self::document::Document;
use super::Findings;
use crate::format::error::shown;
use crate::format::gltf::extension::{HYBRID, extension_of};
use crate::format::gltf::json::{index, items};

/// Checks a `.glb` or `.gltf`; `folder` may contain its buffers and images.
pub(super) fn check(bytes: &[u8], folder: &Path, findings: &mut Findings) {
    let Some(container::Parts { root, bin }) = container::open(bytes, findings) else { return };
    schema::check(&root, "glTF", "", findings);
    warn_of(schema::unknown(&root, "glTF", ""), "PROPERTY_UNKNOWN", findings);
    references::check(&root, findings);
    extensions::check(&root, findings);
    let document = Document::load(&root, bin, folder, findings);
    accessors::check(&document, findings);
    views::check(&document, findings);
    scenes::check(&document, findings);
    attributes::check(&document, findings);
    materials::check(&root, findings);
    pictures::check(&document, findings);
    skins::check(&document, findings);
    moving::check(&document, findings);
    splats::check(&document, findings);
    flat::check(&document, findings);
    hybrid::check(&document, findings);
    // A sound file may still require features that a reader lacks.
    if !findings.has_errors() {
        extensions::check_support(&root, findings);
    }
}

/// Warnings on properties of the hybrid extension's objects that it does not define, one each.
pub(super) fn unknown_properties(root: &Value) -> Vec<String> {
    let said = |schema::Unknown { at, name, .. }| {
        format!("{at}: {} is no property of {HYBRID} and is ignored", shown(name.as_bytes()))
    };
    hybrid::unknown(root).into_iter().map(said).collect()
}

/// Warns of properties that no schema defines: viewers ignore them, so mistyped ones would go unnoticed.
fn warn_of(unknown: Vec<schema::Unknown>, code: &'static str, findings: &mut Findings) {
    for schema::Unknown { at, name, known } in unknown {
        findings.warning(code, at, format!("no other than {}", known.join(", ")), shown(name.as_bytes()));
    }
}

/// Objects of the array `key`, each with its JSON pointer.
fn objects<'a>(parent: &'a Value, key: &str, at: &str) -> impl Iterator<Item = (String, &'a Value)> {
    let prefix = format!("{at}/{key}");
    items(parent, key).iter().enumerate().map(move |(i, item)| (format!("{prefix}/{i}"), item))
}

/// All primitives of all meshes, each with its JSON pointer.
fn primitives(root: &Value) -> impl Iterator<Item = (String, &Value)> {
    objects(root, "meshes", "").flat_map(|(at, mesh)| objects(mesh, "primitives", &at).collect::<Vec<_>>())
}

/// Extension of an object, with its JSON pointer.
fn extension<'a>(object: &'a Value, name: &str, at: &str) -> Option<(String, &'a Value)> {
    Some((format!("{at}/extensions/{name}"), extension_of(object, name)?))
}
