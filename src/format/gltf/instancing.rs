//! Instances of a mesh at one node, by `EXT_mesh_gpu_instancing`.

use std::collections::{BTreeMap, HashSet};

use glam::{DMat4, DVec3, DVec4};
use serde_json::Value;

use super::extension::{HYBRID, INSTANCING, Instancing, KHR_SPLATS, extension_of};
use super::json::{index, items, primitives};
use super::lift::Asset;
use super::transform::unit;
use crate::format::error::{Fault, from_value};

/// Bytes taken by an instance besides its arrays: its transform and its bone.
pub(in crate::format) const BYTES_OF_COPY: u64 = 512;

/// Attributes of instances that determine their transforms.
const PLACES: [&str; 3] = ["TRANSLATION", "ROTATION", "SCALE"];

/// Nodes of a document whose mesh is shown once, regardless of instances.
pub(in crate::format) struct Single {
    /// Nodes to which splats are bound.
    nodes: HashSet<usize>,
    /// Meshes whose splats are bound.
    meshes: HashSet<usize>,
}

impl Single {
    pub(in crate::format) fn of(root: &Value) -> Self {
        let (mut nodes, mut meshes) = (HashSet::new(), HashSet::new());
        for ((mesh, _), primitive) in primitives(root) {
            let khr = extension_of(primitive, KHR_SPLATS);
            if let Some(binding) = khr.and_then(|khr| extension_of(khr, HYBRID)?.get("binding")) {
                meshes.insert(mesh);
                nodes.extend(index(binding, "node"));
            }
        }
        Self { nodes, meshes }
    }

    /// Reason for which the mesh of a node is shown once, if it is.
    fn why(&self, i: usize, node: &Value) -> Option<&'static str> {
        if node.get("skin").is_some() {
            return Some("it has a skin");
        }
        let is_bound = self.nodes.contains(&i) || index(node, "mesh").is_some_and(|mesh| self.meshes.contains(&mesh));
        is_bound.then_some("splats are bound to it")
    }
}

/// Transforms of the instances of a node's mesh, in the node's space; `None` if the mesh is shown once, at the node.
pub(in crate::format) fn copies(
    asset: &Asset,
    single: &Single,
    node: &gltf::Node<'_>,
    notes: &mut Vec<String>,
) -> Result<Option<Vec<DMat4>>, Fault> {
    let Some(value) = node.extension_value(INSTANCING).filter(|_| node.mesh().is_some()) else { return Ok(None) };
    let at = format!("/nodes/{}", node.index());
    if let Some(why) = single.why(node.index(), &asset.root["nodes"][node.index()]) {
        notes.push(format!("{at}: only one instance of {INSTANCING} is shown, at the node itself: {why}"));
        return Ok(None);
    }
    let at = format!("{at}/extensions/{INSTANCING}");
    let Instancing { attributes } = from_value(value, &at, &format!("an object of {INSTANCING}"))?;
    let Some(count) = count(asset, &attributes, &at)? else {
        notes.push(format!("{at}/attributes: there are none: the mesh is shown once"));
        return Ok(None);
    };
    asset.spend((count as u64).saturating_mul(size_of::<DMat4>() as u64), &at)?;
    let [translation, rotation, scale] = PLACES;
    let translations = elements(asset, &attributes, translation, count, [0.0; 3])?;
    let rotations = elements(asset, &attributes, rotation, count, [0.0, 0.0, 0.0, 1.0])?;
    let scales = elements(asset, &attributes, scale, count, [1.0; 3])?;
    let mut copies = Vec::with_capacity(count);
    for (i, ((t, r), s)) in translations.iter().zip(&rotations).zip(&scales).enumerate() {
        if !t.iter().chain(r).chain(s).all(|v| v.is_finite()) {
            return Err(Fault::pointer(format!("{at}/attributes"), "finite numbers", format!("others in copy {i}")));
        }
        // Zero scale is a common way to hide an instance: it has no extent.
        if *s == [0.0; 3] {
            continue;
        }
        copies.push(DMat4::from_scale_rotation_translation(
            DVec3::from(s.map(f64::from)),
            unit(DVec4::from(r.map(f64::from))),
            DVec3::from(t.map(f64::from)),
        ));
    }
    Ok(Some(copies))
}

/// Number of instances, on which all attributes must agree; `None` without attributes.
fn count(asset: &Asset, attributes: &BTreeMap<String, usize>, at: &str) -> Result<Option<usize>, Fault> {
    let mut count: Option<(&str, usize)> = None;
    for (name, &index) in attributes {
        let at = || format!("{at}/attributes/{name}");
        let Some(accessor) = asset.document.accessors().nth(index) else {
            let accessors = asset.document.as_json().accessors.len();
            return Err(Fault::pointer(at(), format!("an accessor below {accessors}"), index.to_string()));
        };
        let found = accessor.count();
        let (first, expected) = *count.get_or_insert((name.as_str(), found));
        if found != expected {
            return Err(Fault::pointer(at(), format!("{expected} elements, as in {first}"), found.to_string()));
        }
    }
    Ok(count.map(|(_, count)| count))
}

/// Values of an attribute for all instances, or its default where the attribute is absent.
fn elements<const N: usize>(
    asset: &Asset,
    attributes: &BTreeMap<String, usize>,
    name: &str,
    count: usize,
    default: [f32; N],
) -> Result<Vec<[f32; N]>, Fault> {
    attributes.get(name).map_or_else(|| Ok(vec![default; count]), |&accessor| asset.floats::<N>(accessor))
}

/// Whether a scene lacks part of a document's instances: instances that are shown once only, or custom attributes.
pub(super) fn is_in_part(root: &Value) -> bool {
    let single = Single::of(root);
    items(root, "nodes").iter().enumerate().any(|(i, node)| {
        extension_of(node, INSTANCING).is_some_and(|own| {
            let mut attributes = own.get("attributes").and_then(Value::as_object).into_iter().flatten();
            let has_others = attributes.any(|(name, _)| !PLACES.contains(&name.as_str()));
            has_others || single.why(i, node).is_some()
        })
    })
}
