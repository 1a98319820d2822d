//! Validation of animated content of core glTF: morph targets and animations.

use std::collections::{HashMap, HashSet};

use serde_json::Value;

use super::super::{Findings, Offenders};
use super::accessors::check_bounds;
use super::document::{Component, Document, Elements};
use super::scenes::check_units;
use super::{index, items, objects, primitives};
use crate::format::gltf::extension::animated_property;

pub(super) fn check(document: &Document<'_>, findings: &mut Findings) {
    check_counts(document, findings);
    for (at, primitive) in primitives(document.root) {
        check_targets(document, primitive, &at, findings);
    }
    check_animations(document, findings);
}

/// Checks that the primitives of a mesh have equally many morph targets, and the mesh and its nodes as many weights.
fn check_counts(document: &Document<'_>, findings: &mut Findings) {
    for (i, (at, mesh)) in objects(document.root, "meshes", "").enumerate() {
        let Some(targets) = target_count(document, i) else { continue };
        check_weights(mesh, targets, "MESH_WEIGHTS", &at, findings);
        for (at, primitive) in objects(mesh, "primitives", &at) {
            let found = items(primitive, "targets").len();
            if found != targets {
                let expected = format!("{targets} morph targets, as in the first primitive");
                findings.error("MESH_TARGETS", at, expected, found);
            }
        }
    }
    for (at, node) in objects(document.root, "nodes", "") {
        if let Some(targets) = index(node, "mesh").and_then(|mesh| target_count(document, mesh)) {
            check_weights(node, targets, "NODE_WEIGHTS", &at, findings);
        }
    }
}

fn check_weights(object: &Value, targets: usize, code: &'static str, at: &str, findings: &mut Findings) {
    let weights = object.get("weights").and_then(Value::as_array).map(Vec::len);
    if let Some(found) = weights.filter(|&found| found != targets) {
        findings.error(code, format!("{at}/weights"), format!("{targets}, one per morph target"), found);
    }
}

/// Number of morph targets of a mesh.
fn target_count(document: &Document<'_>, mesh: usize) -> Option<usize> {
    let first = items(document.object("meshes", mesh)?, "primitives").first()?;
    Some(items(first, "targets").len())
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
            if primitive.get("attributes").is_some_and(|attributes| attributes.get(name).is_none()) {
                findings.error("TARGET_BASE", place(), format!("{name} of the primitive as well"), "none");
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
            let Some(times) = document.elements(input) else { continue };
            check_times(&times, &format!("{at}/input"), findings);
            if is_spline(sampler) && times.count < 2 {
                findings.error("ANIMATION_KEYS", format!("{at}/input"), "two or more for CUBICSPLINE", times.count);
            }
        }
        let mut animated = HashMap::new();
        for (i, (at, channel)) in objects(animation, "channels", &at).enumerate() {
            let first = target_of(channel).map_or(i, |target| *animated.entry(target).or_insert(i));
            if first != i {
                let expected = "a target of no other channel of the animation";
                findings.error("ANIMATION_TWICE", format!("{at}/target"), expected, format!("that of channel {first}"));
            }
            check_channel(document, animation, channel, &at, findings);
        }
    }
}

fn is_spline(sampler: &Value) -> bool {
    sampler.get("interpolation").and_then(Value::as_str) == Some("CUBICSPLINE")
}

/// JSON pointer to what a channel animates, if it does.
fn target_of(channel: &Value) -> Option<String> {
    if let Some(pointer) = animated_property(channel) {
        return Some(pointer.to_owned());
    }
    let target = channel.get("target").filter(|target| target.get("extensions").is_none())?;
    Some(format!("/nodes/{}/{}", index(target, "node")?, target.get("path")?.as_str()?))
}

fn check_channel(document: &Document<'_>, animation: &Value, channel: &Value, at: &str, findings: &mut Findings) {
    let Some(target) = channel.get("target").filter(|target| target.get("extensions").is_none()) else { return };
    let path = target.get("path").and_then(Value::as_str).unwrap_or_default();
    let node = index(target, "node").and_then(|i| document.object("nodes", i));
    // Elements per key, and components of each.
    let (elements, components) = match path {
        "translation" | "scale" => (Some(1), 3),
        "rotation" => (Some(1), 4),
        "weights" => {
            let mesh = node.and_then(|node| index(node, "mesh"));
            (mesh.map_or(node.map(|_| 0), |mesh| target_count(document, mesh)), 1)
        }
        _ => {
            let expected = "translation, rotation, scale or weights";
            return findings.error("ANIMATION_PATH", format!("{at}/target/path"), expected, path.to_owned());
        }
    };
    if elements == Some(0) {
        let expected = "a node with a mesh that has morph targets";
        return findings.error("ANIMATION_WEIGHTS", format!("{at}/target/node"), expected, "another");
    }
    if path != "weights" && node.is_some_and(|node| node.get("matrix").is_some()) {
        let expected = "a node with translation, rotation and scale";
        findings.error("ANIMATION_MATRIX", format!("{at}/target/node"), expected, "one with a matrix");
    }
    let sampler = index(channel, "sampler").and_then(|s| animation.get("samplers")?.get(s));
    let (Some(elements), Some(sampler)) = (elements, sampler) else { return };
    let of = |key| index(sampler, key).and_then(|i| document.elements(i));
    let (Some(input), Some(output)) = (of("input"), of("output")) else { return };
    let tangents = is_spline(sampler);
    let expected = input.count.saturating_mul(if tangents { 3 } else { 1 }).saturating_mul(elements);
    if output.count != expected || output.components != components {
        let expected = format!("{expected} elements of {components} components for {path}");
        let found = format!("{} of {}", output.count, output.components);
        findings.error("ANIMATION_OUTPUT", at, expected, found);
    }
    let takes_integers = ["rotation", "weights"].contains(&path);
    if output.kind != Component::Float && !(takes_integers && output.normalized) {
        let expected = if takes_integers { "floats or normalised integers" } else { "floats" };
        findings.error("ANIMATION_TYPE", at, format!("{expected} for {path}"), format!("{:?}", output.kind));
    } else if path == "rotation" {
        // Of a spline, every second of three elements is a rotation, and the others are its tangents.
        let rotations = (usize::from(tangents)..output.count).step_by(if tangents { 3 } else { 1 });
        check_units::<4>(&output, rotations, at, "ANIMATION_ROTATION", findings);
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
