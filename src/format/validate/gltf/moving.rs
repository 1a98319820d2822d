//! Validation of animated content of core glTF: skins, morph targets and animations.

use std::collections::HashSet;

use serde_json::Value;

use super::super::{Findings, Offenders};
use super::accessors::check_bounds;
use super::document::{Component, Document, Elements};
use super::{index, items, objects, primitives};

/// Least sum of a vertex's weights that counts as non-zero.
const LEAST_WEIGHT: f64 = 1e-6;

pub(super) fn check(document: &Document<'_>, findings: &mut Findings) {
    check_skins(document, findings);
    // Every pair of mesh and skin is checked once, regardless of the number of its nodes.
    let mut checked = HashSet::new();
    for (at, node) in objects(document.root, "nodes", "") {
        if let Some(pair) = index(node, "mesh").zip(index(node, "skin")).filter(|pair| checked.insert(*pair)) {
            check_bound(document, pair, &at, findings);
        }
    }
    for (at, primitive) in primitives(document.root) {
        check_targets(document, primitive, &at, findings);
    }
    check_animations(document, findings);
}

fn check_skins(document: &Document<'_>, findings: &mut Findings) {
    for (at, skin) in objects(document.root, "skins", "") {
        let joints = items(skin, "joints").len();
        let matrices = index(skin, "inverseBindMatrices").and_then(|i| document.elements(i));
        if let Some(m) = matrices.filter(|m| m.count < joints || m.components != 16 || m.kind != Component::Float) {
            let expected = format!("MAT4 of Float, one for each of {joints} joints");
            let found = format!("{} elements of {} components of {:?}", m.count, m.components, m.kind);
            findings.error("SKIN_MATRICES", format!("{at}/inverseBindMatrices"), expected, found);
        }
    }
}

/// Checks the joints and weights of the mesh of a node with a skin.
fn check_bound(document: &Document<'_>, (i, skin): (usize, usize), at: &str, findings: &mut Findings) {
    let (Some(mesh), Some(skin)) = (document.object("meshes", i), document.object("skins", skin)) else { return };
    let joints = items(skin, "joints").len();
    for (place, primitive) in objects(mesh, "primitives", &format!("/meshes/{i}")) {
        let set = |name: &str, n: usize| {
            let accessor = primitive.get("attributes")?.get(format!("{name}_{n}"))?.as_u64()?;
            document.elements(accessor as usize).filter(|e| e.components == 4)
        };
        let sets: Vec<(Elements<'_>, Elements<'_>)> =
            (0..).map_while(|n| set("JOINTS", n).zip(set("WEIGHTS", n))).collect();
        if sets.is_empty() {
            let found = format!("no such pair, and the skin of {at}");
            findings.error("SKIN_WEIGHTS", place, "JOINTS_0 and WEIGHTS_0", found);
            continue;
        }
        let vertices = sets.iter().map(|(joints, weights)| joints.count.min(weights.count)).min().unwrap_or_default();
        let (mut beyond, mut weightless) = (Offenders::default(), Offenders::default());
        for v in 0..vertices {
            let bound = || {
                sets.iter().flat_map(|(joints, weights)| joints.vector::<4>(v).into_iter().zip(weights.vector::<4>(v)))
            };
            // Indices of joints with zero weight need not be valid.
            if let Some((joint, _)) = bound().find(|&(joint, weight)| weight != 0.0 && joint >= joints as f64) {
                beyond.note(|| format!("{joint} at vertex {v}"));
            }
            let total: f64 = bound().map(|(_, weight)| weight).sum();
            if total < LEAST_WEIGHT {
                weightless.note(|| format!("{total} at vertex {v}"));
            }
        }
        if let Some(found) = beyond.summary(vertices) {
            let expected = format!("joints below {joints}, as the skin of {at} has");
            findings.error("SKIN_JOINTS", format!("{place}/attributes/JOINTS_0"), expected, found);
        }
        if let Some(found) = weightless.summary(vertices) {
            findings.error(
                "SKIN_WEIGHTS",
                format!("{place}/attributes/WEIGHTS_0"),
                "weights that add up to more than nothing",
                found,
            );
        }
    }
}

fn check_targets(document: &Document<'_>, primitive: &Value, at: &str, findings: &mut Findings) {
    let accessor = |i: &Value| i.as_u64().and_then(|i| document.object("accessors", i as usize));
    let vertices = primitive.pointer("/attributes/POSITION").and_then(accessor).and_then(|p| index(p, "count"));
    for (at, target) in objects(primitive, "targets", at) {
        for (name, value) in target.as_object().into_iter().flatten() {
            let Some(found) = accessor(value) else { continue };
            let place = || format!("{at}/{}", super::schema::escaped(name));
            let count = index(found, "count");
            if vertices.is_some() && count != vertices {
                let expected = format!("{} elements, as in POSITION", vertices.unwrap_or_default());
                findings.error("TARGET_COUNT", place(), expected, count.unwrap_or_default());
            }
            let kind = found.get("type").and_then(Value::as_str).unwrap_or_default();
            if ["POSITION", "NORMAL", "TANGENT"].contains(&name.as_str()) && kind != "VEC3" {
                findings.error("TARGET_TYPE", place(), "VEC3", kind);
            }
            if name == "POSITION" {
                let of = "POSITION of a morph target";
                check_bounds(document, value.as_u64().unwrap_or_default() as usize, "TARGET_BOUNDS", of, findings);
            }
        }
    }
}

fn check_animations(document: &Document<'_>, findings: &mut Findings) {
    // Many samplers may share an accessor.
    let mut bounded = HashSet::new();
    for (at, animation) in objects(document.root, "animations", "") {
        for (at, sampler) in objects(animation, "samplers", &at) {
            let Some(input) = index(sampler, "input") else { continue };
            if bounded.insert(input) {
                check_bounds(document, input, "ANIMATION_BOUNDS", "input of an animation", findings);
            }
            if let Some(times) = document.elements(input) {
                check_times(&times, &format!("{at}/input"), findings);
            }
        }
        for (at, channel) in objects(animation, "channels", &at) {
            check_channel(document, animation, channel, &at, findings);
        }
    }
}

fn check_channel(document: &Document<'_>, animation: &Value, channel: &Value, at: &str, findings: &mut Findings) {
    let Some(target) = channel.get("target").filter(|target| target.get("extensions").is_none()) else { return };
    let path = target.get("path").and_then(Value::as_str).unwrap_or_default();
    let weights = || {
        let mesh = index(document.object("nodes", index(target, "node")?)?, "mesh")?;
        let first = document.object("meshes", mesh)?.get("primitives")?.get(0)?;
        first.get("targets").and_then(Value::as_array).map(Vec::len)
    };
    // Elements per key, and components of each.
    let (elements, components) = match path {
        "translation" | "scale" => (Some(1), 3),
        "rotation" => (Some(1), 4),
        "weights" => (weights(), 1),
        _ => {
            let expected = "translation, rotation, scale or weights";
            return findings.error("ANIMATION_PATH", format!("{at}/target/path"), expected, path.to_owned());
        }
    };
    let sampler = index(channel, "sampler").and_then(|s| animation.get("samplers")?.get(s));
    let (Some(elements), Some(sampler)) = (elements, sampler) else { return };
    let of = |key| index(sampler, key).and_then(|i| document.elements(i));
    let (Some(input), Some(output)) = (of("input"), of("output")) else { return };
    let tangents = sampler.get("interpolation").and_then(Value::as_str) == Some("CUBICSPLINE");
    let expected = input.count.saturating_mul(if tangents { 3 } else { 1 }).saturating_mul(elements);
    if output.count != expected || output.components != components {
        let expected = format!("{expected} elements of {components} components for {path}");
        let found = format!("{} of {}", output.count, output.components);
        findings.error("ANIMATION_OUTPUT", at, expected, found);
    }
}

/// Reports times that are not strictly increasing from 0 or later.
pub(super) fn check_times(times: &Elements<'_>, at: &str, findings: &mut Findings) {
    if times.components != 1 || times.kind != Component::Float {
        return findings.error("TIMES_TYPE", at, "SCALAR of Float", format!("{:?}", times.kind));
    }
    let mut offenders = Offenders::default();
    for i in 0..times.count {
        let (t, before) = (times.raw(i, 0), if i == 0 { -f64::MIN_POSITIVE } else { times.raw(i - 1, 0) });
        if t <= before || t < 0.0 {
            offenders.note(|| format!("{t} at position {i}"));
        }
    }
    if let Some(found) = offenders.summary(times.count) {
        findings.error("TIMES_ORDER", at, "strictly increasing times from 0 s", found);
    }
}
