//! Validation of nodes and primitives of core glTF.

use std::collections::{BTreeMap, BTreeSet};

use serde_json::Value;

use super::super::{Findings, Offenders};
use super::accessors::check_bounds;
use super::document::{Component, Document, Elements, components};
use super::{extension, index, items, objects, primitives};
use crate::format::gltf::extension::{INSTANCING, KHR_SPLATS, extension_of};
use crate::format::gltf::json::indices;

/// Largest deviation of a unit vector's or quaternion's norm from 1: 8-bit components are each off by up to half a step
/// of 1/127.
pub(super) const UNIT_TOLERANCE: f64 = 0.01;

pub(super) fn check(document: &Document<'_>, findings: &mut Findings) {
    check_nodes(document.root, findings);
    for (at, node) in objects(document.root, "nodes", "") {
        check_copies(document, node, &at, findings);
    }
    for (at, primitive) in primitives(document.root) {
        check_primitive(document, primitive, &at, findings);
    }
    check_strides(document, findings);
}

fn check_nodes(root: &Value, findings: &mut Findings) {
    let nodes: Vec<(String, &Value)> = objects(root, "nodes", "").collect();
    let mut parent: Vec<Option<usize>> = vec![None; nodes.len()];
    for (i, (at, node)) in nodes.iter().enumerate() {
        for child in children(node, nodes.len()) {
            let first = *parent[child].get_or_insert(i);
            if first != i {
                let expected = format!("one parent of node {child}");
                findings.error("NODE_PARENT", format!("{at}/children"), expected, format!("nodes {first} and {i}"));
            }
        }
        if node.get("matrix").is_some() && ["translation", "rotation", "scale"].iter().any(|k| node.get(k).is_some()) {
            findings.error("NODE_TRANSFORM", at, "a matrix or translation, rotation and scale", "both");
        }
        let rotation = numbers(node.get("rotation"));
        let norm = rotation.iter().map(|v| v * v).sum::<f64>().sqrt();
        if rotation.len() == 4 && (norm - 1.0).abs() > UNIT_TOLERANCE {
            findings.error("NODE_ROTATION", format!("{at}/rotation"), "a unit quaternion", format!("norm {norm:.4}"));
        }
    }
    // Walks up from every node, but visits no node twice.
    let mut walked_from = vec![None; nodes.len()];
    for start in 0..nodes.len() {
        let mut above = Some(start);
        while let Some(node) = above.filter(|&node| walked_from[node].is_none()) {
            walked_from[node] = Some(start);
            above = parent[node];
        }
        if let Some(node) = above.filter(|&node| walked_from[node] == Some(start)) {
            findings.error("NODE_CYCLE", &nodes[node].0, "a node that is not its own ancestor", "one that is");
        }
    }
    for (at, scene) in objects(root, "scenes", "") {
        for (k, node) in numbers(scene.get("nodes")).into_iter().enumerate() {
            if let Some(Some(other)) = parent.get(node as usize) {
                findings.error(
                    "SCENE_ROOT",
                    format!("{at}/nodes/{k}"),
                    "a node without parent",
                    format!("child of {other}"),
                );
            }
        }
    }
}

/// Checks instances of a mesh: equally many elements of each attribute, and the extension's types for those that
/// determine transforms.
fn check_copies(document: &Document<'_>, node: &Value, at: &str, findings: &mut Findings) {
    use Component::{Byte, Float, Short};
    let Some((at, copies)) = extension(node, INSTANCING, at) else { return };
    let mut first: Option<(&str, usize)> = None;
    for (name, value) in copies.get("attributes").and_then(Value::as_object).into_iter().flatten() {
        let place = || format!("{at}/attributes/{}", super::schema::escaped(name));
        let Some(accessor) = value.as_u64().and_then(|i| document.object("accessors", i as usize)) else { continue };
        let Some(count) = index(accessor, "count") else { continue };
        let (other, expected) = *first.get_or_insert((name.as_str(), count));
        if count != expected {
            findings.error("COPIES_COUNT", place(), format!("{expected} elements, as in {other}"), count);
        }
        let (shape, kinds): (&str, &[Component]) = match name.as_str() {
            "TRANSLATION" | "SCALE" => ("VEC3", &[Float]),
            "ROTATION" => ("VEC4", &[Float, Byte, Short]),
            _ => continue,
        };
        let found_shape = accessor.get("type").and_then(Value::as_str).unwrap_or_default();
        let found_kind = accessor.get("componentType").and_then(Value::as_u64).and_then(Component::of);
        let is_scaled = found_kind == Some(Float) || accessor.get("normalized") == Some(&Value::Bool(true));
        if found_shape != shape || !is_scaled || found_kind.is_some_and(|kind| !kinds.contains(&kind)) {
            let expected = format!("{shape} of {kinds:?}, integers normalised");
            findings.error("COPIES_ATTRIBUTE", place(), expected, format!("{found_shape} of {found_kind:?}"));
        }
    }
}

/// Children of a node that are among `nodes` nodes.
pub(super) fn children(node: &Value, nodes: usize) -> Vec<usize> {
    indices(node, "children").map(|i| i as usize).filter(|&i| i < nodes).collect()
}

pub(super) fn numbers(value: Option<&Value>) -> Vec<f64> {
    value.and_then(Value::as_array).into_iter().flatten().filter_map(Value::as_f64).collect()
}

/// Types and component types of a core attribute; `KHR_mesh_quantization` allows others.
fn attribute_rule(name: &str) -> Option<(&'static [&'static str], &'static [Component])> {
    use Component::{Float, UnsignedByte, UnsignedShort};
    let set = name.rsplit_once('_').filter(|(_, digits)| digits.bytes().all(|b| b.is_ascii_digit()));
    Some(match (name, set.map(|(name, _)| name)) {
        ("POSITION" | "NORMAL", _) => (&["VEC3"], &[Float]),
        ("TANGENT", _) => (&["VEC4"], &[Float]),
        (_, Some("TEXCOORD")) => (&["VEC2"], &[Float, UnsignedByte, UnsignedShort]),
        (_, Some("JOINTS")) => (&["VEC4"], &[UnsignedByte, UnsignedShort]),
        (_, Some("WEIGHTS")) => (&["VEC4"], &[Float, UnsignedByte, UnsignedShort]),
        (_, Some("COLOR")) => (&["VEC3", "VEC4"], &[Float, UnsignedByte, UnsignedShort]),
        _ => return None,
    })
}

fn check_primitive(document: &Document<'_>, primitive: &Value, at: &str, findings: &mut Findings) {
    let Some(attributes) = primitive.get("attributes").and_then(Value::as_object) else { return };
    let accessor = |i: &Value| i.as_u64().and_then(|i| document.root.get("accessors")?.get(i as usize));
    let is_splats = extension_of(primitive, KHR_SPLATS).is_some();
    let quantized = document.uses("KHR_mesh_quantization");
    let positions = attributes.get("POSITION").and_then(accessor);
    let vertices = positions.and_then(|p| index(p, "count"));
    match attributes.get("POSITION").and_then(Value::as_u64).filter(|_| positions.is_some()) {
        None => findings.warning("PRIMITIVE_POSITION", format!("{at}/attributes"), "POSITION", "none"),
        Some(accessor) => check_bounds(document, accessor as usize, "PRIMITIVE_BOUNDS", "POSITION", findings),
    }
    for (name, value) in attributes {
        let place = || format!("{at}/attributes/{}", super::schema::escaped(name));
        let Some(accessor) = accessor(value) else { continue };
        let count = index(accessor, "count");
        if count != vertices && vertices.is_some() {
            let expected = format!("{} elements, as in POSITION", vertices.unwrap_or_default());
            findings.error("PRIMITIVE_COUNT", place(), expected, count.unwrap_or_default());
        }
        if let Some((shapes, kinds)) = attribute_rule(name) {
            let found_shape = accessor.get("type").and_then(Value::as_str).unwrap_or_default();
            let found_kind = accessor.get("componentType").and_then(Value::as_u64).and_then(Component::of);
            let allowed = found_kind.is_none_or(|k| kinds.contains(&k) || quantized);
            if !shapes.contains(&found_shape) || !allowed {
                let expected = format!("{} of {kinds:?}", shapes.join(" or "));
                findings.error("PRIMITIVE_ATTRIBUTE", place(), expected, format!("{found_shape} of {found_kind:?}"));
            }
        }
        check_alignment(document, accessor, place, findings);
    }
    let targets = items(primitive, "targets").iter().enumerate();
    for (k, target) in targets.filter_map(|(k, target)| Some((k, target.as_object()?))) {
        for (name, accessor) in target.iter().filter_map(|(name, value)| Some((name, accessor(value)?))) {
            let place = || format!("{at}/targets/{k}/{}", super::schema::escaped(name));
            check_alignment(document, accessor, place, findings);
        }
    }
    check_indices(document, primitive, vertices, at, findings);
    if !is_splats && let Some(normals) = attributes.get("NORMAL").and_then(Value::as_u64) {
        check_unit::<3>(
            document.elements(normals as usize),
            &format!("{at}/attributes/NORMAL"),
            "NORMAL_NORM",
            findings,
        );
    }
}

/// Checks that every element of a vertex attribute begins at a multiple of 4 bytes of its view (glTF 2.0, 3.6.2.4).
fn check_alignment(document: &Document<'_>, accessor: &Value, place: impl Fn() -> String, findings: &mut Findings) {
    let kind = accessor.get("componentType").and_then(Value::as_u64).and_then(Component::of);
    let components = accessor.get("type").and_then(Value::as_str).and_then(components);
    let view = index(accessor, "bufferView").and_then(|view| document.object("bufferViews", view));
    let (Some(kind), Some(components), Some(view)) = (kind, components, view) else { return };
    let stride = index(view, "byteStride").unwrap_or(components * kind.size());
    let offset = index(accessor, "byteOffset").unwrap_or(0);
    if !stride.is_multiple_of(4) || !offset.is_multiple_of(4) {
        let expected = "elements that begin at multiples of 4 bytes of the view";
        findings.error("ATTRIBUTE_ALIGNMENT", place(), expected, format!("byte {offset}, then every {stride} bytes"));
    }
}

/// Checks that a view shared by several vertex attributes states the stride of their elements (glTF 2.0, 3.6.2.4).
fn check_strides(document: &Document<'_>, findings: &mut Findings) {
    let mut inside: BTreeMap<usize, BTreeSet<usize>> = BTreeMap::new();
    for (_, primitive) in primitives(document.root) {
        let targets = items(primitive, "targets").iter();
        let lists = targets.chain(primitive.get("attributes")).filter_map(Value::as_object);
        for accessor in lists.flatten().filter_map(|(_, accessor)| accessor.as_u64()).map(|i| i as usize) {
            let view = document.object("accessors", accessor).and_then(|accessor| index(accessor, "bufferView"));
            if let Some(view) = view {
                inside.entry(view).or_default().insert(accessor);
            }
        }
    }
    for (view, accessors) in inside.into_iter().filter(|(_, accessors)| accessors.len() > 1) {
        if document.object("bufferViews", view).is_some_and(|view| view.get("byteStride").is_none()) {
            let expected = format!("a byteStride, as {} vertex attributes are in it", accessors.len());
            findings.error("VIEW_STRIDE", format!("/bufferViews/{view}"), expected, "none");
        }
    }
}

fn check_indices(
    document: &Document<'_>,
    primitive: &Value,
    vertices: Option<usize>,
    at: &str,
    findings: &mut Findings,
) {
    let mode = index(primitive, "mode").unwrap_or(4);
    // Unreadable indices are not counted.
    let mut corners = if primitive.get("indices").is_none() { vertices } else { None };
    if let Some(accessor) = index(primitive, "indices")
        && let Some(elements) = document.elements(accessor)
    {
        let place = format!("{at}/indices");
        corners = Some(elements.count);
        let unsigned = [Component::UnsignedByte, Component::UnsignedShort, Component::UnsignedInt];
        if !unsigned.contains(&elements.kind) || elements.components != 1 || elements.normalized {
            let expected = "SCALAR of an unsigned integer type, not normalised";
            return findings.error("INDICES_TYPE", place, expected, format!("{:?}", elements.kind));
        }
        let mut offenders = Offenders::default();
        for i in 0..elements.count {
            let v = elements.raw(i, 0);
            if vertices.is_some_and(|n| v >= n as f64) || v == elements.kind.largest() {
                offenders.note(|| format!("{v} at position {i}"));
            }
        }
        if let Some(found) = offenders.summary(elements.count) {
            let expected = format!("indices below {}, the number of vertices", vertices.unwrap_or_default());
            findings.error("INDICES_RANGE", place, expected, found);
        }
    }
    let whole = match (mode, corners) {
        (1, Some(n)) => n.is_multiple_of(2) && n > 0,
        (4, Some(n)) => n.is_multiple_of(3) && n > 0,
        _ => true,
    };
    if !whole {
        let expected = if mode == 4 { "three corners per triangle" } else { "two ends per line" };
        findings.warning("PRIMITIVE_INCOMPLETE", at, expected, format!("{} in all", corners.unwrap_or_default()));
    }
}

/// Reports vectors whose norm is not 1.
pub(super) fn check_unit<const N: usize>(
    elements: Option<Elements<'_>>,
    at: &str,
    code: &'static str,
    findings: &mut Findings,
) {
    let Some(elements) = elements.filter(|e| e.components == N) else { return };
    let mut offenders = Offenders::default();
    for i in 0..elements.count {
        let norm = elements.vector::<N>(i).iter().map(|v| v * v).sum::<f64>().sqrt();
        // NaN has a finding of its own.
        if (norm - 1.0).abs() > UNIT_TOLERANCE {
            offenders.note(|| format!("length {norm:.4} of element {i}"));
        }
    }
    if let Some(found) = offenders.summary(elements.count) {
        findings.error(code, at, "length 1", found);
    }
}
