//! Nodes of a document: what refers to them, and their removal.

use std::collections::{BTreeSet, HashSet};

use serde_json::{Map, Value, json};

use super::extension::{ANIMATION_POINTER, HYBRID, INSTANCING, KHR_SPLATS, VISIBILITY};
use super::json::{items, items_mut, primitives_mut, retain};

/// Properties of a node that only places something.
const OWN: [&str; 5] = ["name", "rotation", "translation", "scale", "matrix"];

/// Beginnings of the names of extensions that do not refer to nodes, or only where [`renumber`] looks.
const KNOWN: [&str; 17] = [
    ANIMATION_POINTER,
    HYBRID,
    INSTANCING,
    KHR_SPLATS,
    VISIBILITY,
    "EXT_lights_",
    "EXT_mesh_features",
    "EXT_meshopt_compression",
    "EXT_structural_metadata",
    "EXT_texture_",
    "KHR_draco_mesh_compression",
    "KHR_lights_punctual",
    "KHR_materials_",
    "KHR_mesh_quantization",
    "KHR_meshopt_compression",
    "KHR_texture_",
    "KHR_xmp_json_ld",
];

/// Whether a node places nothing.
pub(super) fn is_bare(node: &Map<String, Value>) -> bool {
    node.keys().all(|key| OWN.contains(&&key[..]))
}

/// Nodes to which skins, bindings of splats or pointers refer: more than lists of nodes and channels of animations.
pub(super) fn needed(root: &mut Value) -> HashSet<u64> {
    let mut found = HashSet::new();
    renumber(root, |node, is_needed| {
        if is_needed {
            found.insert(node);
        }
        node
    });
    found
}

/// Removes nodes to which no more than scenes and parents refer, and renumbers the others. In a document with an
/// extension that may refer to nodes by index in ways not known here, they stay, empty and in no scene.
pub(super) fn remove_nodes(root: &mut Value, gone: &BTreeSet<u64>) {
    unlist(root, gone);
    let is_known = |name: &Value| name.as_str().is_some_and(|name| KNOWN.iter().any(|known| name.starts_with(*known)));
    if !items(root, "extensionsUsed").iter().all(is_known) {
        for (_, node) in (0..).zip(items_mut(root, "nodes")).filter(|(i, _)| gone.contains(i)) {
            *node = json!({});
        }
        return;
    }
    retain(root, "nodes", |i, _| !gone.contains(&(i as u64)));
    let gone: Vec<u64> = gone.iter().copied().collect();
    renumber(root, |node, _| node - gone.partition_point(|gone| *gone < node) as u64);
}

/// Replaces every index of a node by what `renumbered` makes of it and of whether the reference needs the node.
fn renumber(root: &mut Value, mut renumbered: impl FnMut(u64, bool) -> u64) {
    let mut replace = |index: &mut Value, needs: bool| {
        if let Some(node) = index.as_u64() {
            *index = json!(renumbered(node, needs));
        }
    };
    for (owners, key, needs) in [("scenes", "nodes", false), ("nodes", "children", false), ("skins", "joints", true)] {
        for owner in items_mut(root, owners) {
            items_mut(owner, key).iter_mut().for_each(|index| replace(index, needs));
        }
    }
    for skin in items_mut(root, "skins") {
        if let Some(index) = skin.get_mut("skeleton") {
            replace(index, true);
        }
    }
    let bound_to = format!("/extensions/{KHR_SPLATS}/extensions/{HYBRID}/binding/node");
    for (_, primitive) in primitives_mut(root) {
        if let Some(index) = primitive.pointer_mut(&bound_to) {
            replace(index, true);
        }
    }
    let animated = format!("/target/extensions/{ANIMATION_POINTER}/pointer");
    for channel in items_mut(root, "animations").iter_mut().flat_map(|animation| items_mut(animation, "channels")) {
        if let Some(index) = channel.pointer_mut("/target/node") {
            replace(index, false);
        }
        let Some(pointer) = channel.pointer_mut(&animated) else { continue };
        let Some(path) = pointer.as_str().and_then(|pointer| pointer.strip_prefix("/nodes/")) else { continue };
        let (node, below) = path.split_at(path.find('/').unwrap_or(path.len()));
        let Ok(node) = node.parse::<u64>() else { continue };
        let mut index = json!(node);
        replace(&mut index, true);
        *pointer = json!(format!("/nodes/{index}{below}"));
    }
}

/// Removes nodes from the lists of scenes and of other nodes.
pub(super) fn unlist(root: &mut Value, gone: &BTreeSet<u64>) {
    let is_gone = |index: &Value| index.as_u64().is_some_and(|i| gone.contains(&i));
    for (owners, key) in [("scenes", "nodes"), ("nodes", "children")] {
        items_mut(root, owners).iter_mut().for_each(|owner| retain(owner, key, |_, index| !is_gone(index)));
    }
}
