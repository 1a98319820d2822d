//! Validation of buffer views by what refers to them (glTF 2.0, 3.6.1.1).

use std::collections::{BTreeMap, BTreeSet};

use serde_json::Value;

use super::super::Findings;
use super::document::Document;
use super::{index, items, objects, primitives};

const ATTRIBUTES: &str = "vertex attributes";
const INDICES: &str = "vertex indices";
const KEYS: &str = "keys of animations";
const SPARSE: &str = "sparse elements";

/// Checks that views hold one kind of data, and that `target` and `byteStride` suit it.
pub(super) fn check(document: &Document<'_>, findings: &mut Findings) {
    for (view, held) in kinds(document) {
        let Some(object) = document.object("bufferViews", view) else { continue };
        let (at, found) = (format!("/bufferViews/{view}"), held.iter().copied().collect::<Vec<_>>().join(" and "));
        // Only of these does it not matter what else is there.
        let is_free = |kind: &&str| [KEYS, SPARSE].contains(kind);
        if held.len() > 1 && !held.iter().all(is_free) {
            findings.error("VIEW_DATA", at, "data of one kind", found);
            continue;
        }
        let meant = match index(object, "target") {
            Some(34962) => ATTRIBUTES,
            Some(34963) => INDICES,
            _ => found.as_str(),
        };
        if meant != found {
            let expected = format!("none, or the one of {found}");
            findings.error("VIEW_TARGET", format!("{at}/target"), expected, format!("the one of {meant}"));
        }
        if found != ATTRIBUTES && object.get("byteStride").is_some() {
            findings.error("VIEW_STRIDE", format!("{at}/byteStride"), format!("none, as for all {found}"), "one");
        }
    }
}

/// Kinds of data in the views.
fn kinds(document: &Document<'_>) -> BTreeMap<usize, BTreeSet<&'static str>> {
    let root = document.root;
    let mut held: BTreeMap<usize, BTreeSet<&'static str>> = BTreeMap::new();
    let mut add = |object: Option<&Value>, kind: &'static str| {
        if let Some(view) = object.and_then(|object| index(object, "bufferView")) {
            held.entry(view).or_default().insert(kind);
        }
    };
    let accessor = |i: &Value| i.as_u64().and_then(|i| document.object("accessors", i as usize));
    for (_, primitive) in primitives(root) {
        let lists = items(primitive, "targets").iter().chain(primitive.get("attributes"));
        lists.filter_map(Value::as_object).flatten().for_each(|(_, i)| add(accessor(i), ATTRIBUTES));
        add(primitive.get("indices").and_then(accessor), INDICES);
    }
    for skin in items(root, "skins") {
        add(skin.get("inverseBindMatrices").and_then(accessor), "inverse bind matrices");
    }
    for (at, animation) in objects(root, "animations", "") {
        for (_, sampler) in objects(animation, "samplers", &at) {
            ["input", "output"].iter().for_each(|key| add(sampler.get(key).and_then(accessor), KEYS));
        }
    }
    for sparse in items(root, "accessors").iter().filter_map(|accessor| accessor.get("sparse")) {
        ["indices", "values"].iter().for_each(|key| add(sparse.get(key), SPARSE));
    }
    items(root, "images").iter().for_each(|image| add(Some(image), "images"));
    held
}
