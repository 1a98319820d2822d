//! Validation of the deformation fields of `EXT_gaussian_splatting_hybrid`: sizes of planes and layers.

use serde_json::Value;

use super::super::Findings;
use super::document::{Component, Document};
use super::splats::check_token;
use super::{index, objects};
use crate::format::gltf::extension::{HYBRID, KHR_SPLATS};

/// Axes of the planes, in order: xy, xz, xt, yz, yt, zt.
const PLANES: [[usize; 2]; 6] = [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]];

pub(super) fn check(document: &Document<'_>, own: &Value, at: &str, findings: &mut Findings) {
    for (at, field) in objects(own, "deformationFields", at) {
        check_token(field, "type", &["hexplane"], "HYBRID_TOKEN", &at, findings);
        let features = index(field, "features").unwrap_or(0);
        let mut levels = 0usize;
        for (at, level) in objects(field, "levels", &at) {
            levels += 1;
            check_planes(document, level, features, &at, findings);
        }
        let inputs = features.saturating_mul(levels);
        let trunk = check_layers(document, field, "trunk", Some(inputs), &at, findings);
        let Some(heads) = field.get("heads").and_then(Value::as_object) else { continue };
        for name in heads.keys() {
            let outputs =
                check_layers(document, &field["heads"], name, trunk.or(Some(inputs)), &format!("{at}/heads"), findings);
            let expected: &[usize] = match name.as_str() {
                "translation" | "logScale" => &[3],
                "rotation" => &[4],
                "opacityLogit" => &[1],
                "sphericalHarmonics" => &[3, 12, 27, 48],
                _ => continue,
            };
            if let Some(found) = outputs.filter(|found| !expected.contains(found)) {
                let expected = format!("{expected:?} outputs of the last layer");
                findings.error("HYBRID_LAYER_CHAIN", format!("{at}/heads/{name}"), expected, found);
            }
        }
    }
}

/// Checks that the field that deforms a primitive changes as many SH coefficients as its splats have.
pub(super) fn check_degree(root: &Value, primitive: &Value, bound: &Value, at: &str, findings: &mut Findings) {
    let field = index(bound, "deformation")
        .and_then(|i| root.pointer(&format!("/extensions/{HYBRID}/deformationFields/{i}/heads/sphericalHarmonics")));
    let Some(outputs) = field.and_then(|layers| index(layers.as_array()?.last()?, "outputs")) else { return };
    let prefix = format!("{KHR_SPLATS}:SH_DEGREE_");
    let attributes = primitive.get("attributes").and_then(Value::as_object).into_iter().flatten();
    // Compressed splats store coefficients elsewhere.
    let stored = attributes.filter(|(name, _)| name.starts_with(&prefix)).count();
    if stored > 0 && outputs != 3 * stored {
        let expected = format!("a field of {} outputs for {stored} SH coefficients", 3 * stored);
        findings.error("HYBRID_LAYER_CHAIN", format!("{at}/deformation"), expected, outputs);
    }
}

fn check_planes(document: &Document<'_>, level: &Value, features: usize, at: &str, findings: &mut Findings) {
    let sizes: Vec<usize> = level
        .get("resolution")
        .and_then(Value::as_array)
        .into_iter()
        .flatten()
        .map(|v| v.as_u64().unwrap_or(0) as usize)
        .collect();
    let planes = level.get("planes").and_then(Value::as_array).map_or(&[][..], Vec::as_slice);
    if sizes.len() != 4 {
        return;
    }
    for (k, (plane, [a, b])) in planes.iter().zip(PLANES).enumerate() {
        let Some(elements) = plane.as_u64().and_then(|i| document.elements(i as usize)) else { continue };
        let expected = features.saturating_mul(sizes[a]).saturating_mul(sizes[b]);
        if elements.count != expected || elements.components != 1 || elements.kind != Component::Float {
            let expected = format!("{features} features × {} × {} SCALAR floats", sizes[a], sizes[b]);
            let found = format!("{} of {} component(s) of {:?}", elements.count, elements.components, elements.kind);
            findings.error("HYBRID_PLANE_SIZE", format!("{at}/planes/{k}"), expected, found);
        }
    }
}

/// Checks layers, and returns the number of outputs of the last of those called `key`; `None` if there are none.
fn check_layers(
    document: &Document<'_>,
    parent: &Value,
    key: &str,
    mut inputs: Option<usize>,
    at: &str,
    findings: &mut Findings,
) -> Option<usize> {
    let mut last = None;
    for (at, layer) in objects(parent, key, at) {
        check_token(layer, "activation", &["none", "relu"], "HYBRID_TOKEN", &at, findings);
        let (Some(own_inputs), Some(outputs)) = (index(layer, "inputs"), index(layer, "outputs")) else { return None };
        if let Some(expected) = inputs.filter(|&n| n != own_inputs) {
            findings.error(
                "HYBRID_LAYER_CHAIN",
                format!("{at}/inputs"),
                format!("{expected}, as the step before gives"),
                own_inputs,
            );
        }
        for (key, expected) in [("weights", own_inputs.saturating_mul(outputs)), ("bias", outputs)] {
            let Some(e) = index(layer, key).and_then(|i| document.elements(i)) else { continue };
            if e.count != expected || e.components != 1 || e.kind != Component::Float {
                let found = format!("{} of {} component(s) of {:?}", e.count, e.components, e.kind);
                findings.error("HYBRID_LAYER_SIZE", format!("{at}/{key}"), format!("{expected} SCALAR floats"), found);
            }
        }
        (inputs, last) = (Some(outputs), Some(outputs));
    }
    last
}
