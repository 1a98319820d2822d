//! Validation of splats bound to triangles.

use serde_json::Value;

use super::super::{Findings, Offenders};
use super::document::{Component, Document};
use super::index;
use super::scenes::check_unit;
use super::splats::check_token;
pub(super) use crate::format::gltf::binding::geometry_digest;

/// Checks `binding` of the splats in `primitive`.
pub(super) fn check(document: &Document<'_>, primitive: &Value, binding: &Value, at: &str, findings: &mut Findings) {
    check_token(binding, "frame", &["edgeNormal"], "HYBRID_TOKEN", at, findings);
    check_token(binding, "sphericalHarmonicsFrame", &["node", "triangle"], "HYBRID_TOKEN", at, findings);
    check_poses(document, primitive, binding, at, findings);
    let Some(node) = index(binding, "node").and_then(|i| document.object("nodes", i)) else { return };
    let mesh = index(node, "mesh").and_then(|i| document.object("meshes", i));
    let number = index(binding, "primitive").unwrap_or(0);
    let bound = mesh.and_then(|mesh| mesh.get("primitives")?.get(number));
    let Some(bound) = bound.filter(|bound| index(bound, "mode").unwrap_or(4) == 4) else {
        let expected = format!("a node whose mesh has a primitive {number} of mode 4 (TRIANGLES)");
        return findings.error("HYBRID_BINDING_MESH", format!("{at}/node"), expected, "another");
    };
    check_triangles(document, bound, binding, at, findings);
}

/// Checks the accessors: one element per splat, of the required types.
fn check_poses(document: &Document<'_>, primitive: &Value, binding: &Value, at: &str, findings: &mut Findings) {
    let splats = document.positions(primitive).map_or(0, |p| p.count);
    let elements = |key: &str| index(binding, key).and_then(|i| document.elements(i));
    for (key, components) in [("triangles", 1), ("translations", 3), ("rotations", 4), ("scales", 3)] {
        let Some(e) = elements(key) else { continue };
        let at = format!("{at}/{key}");
        if e.count != splats || e.components != components {
            let expected = format!("{splats} elements of {components} component(s), one per splat");
            findings.error("HYBRID_BINDING_COUNT", at, expected, format!("{} of {}", e.count, e.components));
            continue;
        }
        let is_turn = key == "rotations" && e.normalized && matches!(e.kind, Component::Byte | Component::Short);
        if key != "triangles" && e.kind != Component::Float && !is_turn {
            let expected = if key == "rotations" { "Float, or normalised Byte or Short" } else { "Float" };
            findings.error("HYBRID_BINDING_TYPE", at, expected, format!("{:?}", e.kind));
        }
    }
    check_unit::<4>(elements("rotations"), &format!("{at}/rotations"), "HYBRID_BINDING_ROTATION", findings);
    if let (Some(triangles), Some(declared)) = (elements("triangles"), index(binding, "triangleCount")) {
        let mut offenders = Offenders::default();
        for i in 0..triangles.count {
            let v = triangles.raw(i, 0);
            if v >= declared as f64 || !triangles.is_unsigned() {
                offenders.note(|| format!("{v} of splat {i}"));
            }
        }
        if let Some(found) = offenders.summary(triangles.count) {
            let expected = format!("unsigned integers below triangleCount = {declared}");
            findings.error("HYBRID_BINDING_TRIANGLE", format!("{at}/triangles"), expected, found);
        }
    }
}

/// Checks that the triangles of the primitive `bound` are those for which the binding was made.
fn check_triangles(document: &Document<'_>, bound: &Value, binding: &Value, at: &str, findings: &mut Findings) {
    let Some(positions) = document.positions(bound) else { return };
    let indices = match index(bound, "indices") {
        Some(accessor) => match document.elements(accessor) {
            Some(indices) => Some(indices),
            None => return,
        },
        None => None,
    };
    let triangles = indices.as_ref().map_or(positions.count, |indices| indices.count) / 3;
    if let Some(declared) = index(binding, "triangleCount").filter(|&declared| declared != triangles) {
        let expected = format!("{triangles}, the triangles of the mesh");
        return findings.error("HYBRID_BINDING_MESH", format!("{at}/triangleCount"), expected, declared);
    }
    let Some(declared) = binding.get("geometryDigest").and_then(Value::as_str) else { return };
    let vertex = |corner: usize| indices.as_ref().map_or(corner as f64, |indices| indices.raw(corner, 0));
    let corners = (0..3 * triangles).map(|corner| {
        let vertex = vertex(corner) as usize;
        (vertex < positions.count).then(|| positions.vector::<3>(vertex).map(|v| v as f32))
    });
    // An index out of range has a finding of its own.
    let Some(digest) = corners.collect::<Option<Vec<_>>>().map(|corners| geometry_digest(&corners)) else { return };
    if declared != digest {
        let expected = format!("{digest}, the digest of the triangles of the mesh");
        findings.error("HYBRID_BINDING_DIGEST", format!("{at}/geometryDigest"), expected, declared);
    }
}
