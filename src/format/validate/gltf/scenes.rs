//! Validation of nodes and cameras of core glTF.

use glam::{DMat3, DVec3};
use serde_json::Value;

use super::super::{Findings, Offenders};
use super::document::{Component, Document, Elements};
use super::schema::escaped;
use super::{extension, index, objects};
use crate::format::gltf::extension::INSTANCING;
use crate::format::gltf::json::indices;

/// Largest deviation of a unit vector's or quaternion's norm from 1: 8-bit components are each off by up to half a step
/// of 1/127.
pub(super) const UNIT_TOLERANCE: f64 = 0.01;

/// Largest cosine between two axes of a matrix without shear: what rounding to four decimals explains.
const SHEAR_TOLERANCE: f64 = 2e-4;
/// … and below this product of cosine and axis: what rounding of elements may do, as Khronos' validator allows.
const ROUNDING: f64 = 5e-5;

pub(super) fn check(document: &Document<'_>, findings: &mut Findings) {
    check_nodes(document.root, findings);
    for (at, node) in objects(document.root, "nodes", "") {
        check_copies(document, node, &at, findings);
    }
    check_cameras(document.root, findings);
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
        check_matrix(node, &format!("{at}/matrix"), findings);
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

/// Checks that the matrix of a node is a product of translation, rotation and scale.
fn check_matrix(node: &Value, at: &str, findings: &mut Findings) {
    let Ok(m) = <[f64; 16]>::try_from(numbers(node.get("matrix"))) else { return };
    let last = [m[3], m[7], m[11], m[15]];
    if last != [0.0, 0.0, 0.0, 1.0] {
        return findings.error("NODE_MATRIX", at, "[0.0, 0.0, 0.0, 1.0] as the fourth row", format!("{last:?}"));
    }
    let [x, y, z] = [0, 4, 8].map(|i| DVec3::new(m[i], m[i + 1], m[i + 2]));
    if DMat3::from_cols(x, y, z).determinant() == 0.0 {
        return findings.warning("NODE_MATRIX", at, "a matrix that has an inverse", "determinant 0");
    }
    let cosine = |a: DVec3, b: DVec3| a.normalize().dot(b.normalize()).abs();
    // Small axes may be rounded.
    let is_sheared = |a: DVec3, b: DVec3| {
        let shear = cosine(a, b);
        shear > SHEAR_TOLERANCE && shear * a.length().min(b.length()) > ROUNDING
    };
    if [(x, y), (y, z), (z, x)].into_iter().any(|(a, b)| is_sheared(a, b)) {
        let shear = cosine(x, y).max(cosine(y, z)).max(cosine(z, x));
        let expected = "a product of translation, rotation and scale";
        let found = format!("axes {:.2}° from a right angle", shear.min(1.0).asin().to_degrees());
        findings.error("NODE_MATRIX", at, expected, found);
    }
}

/// Checks what the schema does not say of cameras.
fn check_cameras(root: &Value, findings: &mut Findings) {
    for (at, camera) in objects(root, "cameras", "") {
        for kind in ["perspective", "orthographic"] {
            let number = |key: &str| camera.get(kind)?.get(key)?.as_f64();
            let place = |key: &str| format!("{at}/{kind}/{key}");
            if let (Some(near), Some(far)) = (number("znear"), number("zfar"))
                && far <= near
            {
                findings.error("CAMERA_DEPTHS", place("zfar"), format!("more than znear, which is {near}"), far);
            }
            if let Some(angle) = number("yfov").filter(|&angle| angle >= std::f64::consts::PI) {
                findings.warning("CAMERA_ANGLE", place("yfov"), "less than π", angle);
            }
            for (key, size) in ["xmag", "ymag"].into_iter().filter_map(|key| Some((key, number(key)?))) {
                if size == 0.0 {
                    findings.error("CAMERA_SIZE", place(key), "other than 0", size);
                } else if size < 0.0 {
                    findings.warning("CAMERA_SIZE", place(key), "more than 0", size);
                }
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
        let place = || format!("{at}/attributes/{}", escaped(name));
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

/// Reports vectors whose norm is not 1.
pub(super) fn check_unit<const N: usize>(
    elements: Option<Elements<'_>>,
    at: &str,
    code: &'static str,
    findings: &mut Findings,
) {
    if let Some(elements) = elements {
        check_units::<N>(&elements, 0..elements.count, at, code, findings);
    }
}

/// Same as [`check_unit`], of some elements.
pub(super) fn check_units<const N: usize>(
    elements: &Elements<'_>,
    which: impl ExactSizeIterator<Item = usize>,
    at: &str,
    code: &'static str,
    findings: &mut Findings,
) {
    if elements.components != N {
        return;
    }
    let (mut offenders, checked) = (Offenders::default(), which.len());
    for i in which {
        let norm = elements.vector::<N>(i).iter().map(|v| v * v).sum::<f64>().sqrt();
        // NaN has a finding of its own.
        if (norm - 1.0).abs() > UNIT_TOLERANCE {
            offenders.note(|| format!("length {norm:.4} of element {i}"));
        }
    }
    if let Some(found) = offenders.summary(checked) {
        findings.error(code, at, "length 1", found);
    }
}
