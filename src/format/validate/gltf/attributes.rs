//! Validation of primitives of core glTF: attributes, their values, and indices.

use std::collections::{BTreeMap, BTreeSet};

use serde_json::{Map, Value};

use super::super::{Findings, Offenders};
use super::accessors::check_bounds;
use super::document::{Component, Document, Elements, layout};
use super::scenes::{UNIT_TOLERANCE, check_unit};
use super::schema::escaped;
use super::{index, items, primitives};
use crate::format::error::shown;
use crate::format::gltf::extension::{KHR_SPLATS, extension_of};

pub(super) fn check(document: &Document<'_>, findings: &mut Findings) {
    for (at, primitive) in primitives(document.root) {
        check_primitive(document, primitive, &at, findings);
    }
    check_strides(document, findings);
}

/// Name and number of an attribute of which there can be several: `TEXCOORD_1`. Numbers have no leading zeros.
fn numbered(name: &str) -> Option<(&str, usize)> {
    let (base, digits) = name.rsplit_once('_')?;
    let number: usize = digits.parse().ok()?;
    let is_one = ["COLOR", "JOINTS", "TEXCOORD", "WEIGHTS"].contains(&base) && number.to_string() == digits;
    is_one.then_some((base, number))
}

/// Types and component types of a core attribute; `KHR_mesh_quantization` allows others.
fn attribute_rule(name: &str) -> Option<(&'static [&'static str], &'static [Component])> {
    use Component::{Float, UnsignedByte, UnsignedShort};
    Some(match (name, numbered(name).map(|(base, _)| base)) {
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
    let quantized = document.uses("KHR_mesh_quantization");
    let positions = attributes.get("POSITION").and_then(accessor);
    let vertices = positions.and_then(|p| index(p, "count"));
    match attributes.get("POSITION").and_then(Value::as_u64).filter(|_| positions.is_some()) {
        None => findings.warning("PRIMITIVE_POSITION", format!("{at}/attributes"), "POSITION", "none"),
        Some(accessor) => check_bounds(document, accessor as usize, "PRIMITIVE_BOUNDS", "POSITION", findings),
    }
    check_names(document, attributes, &format!("{at}/attributes"), findings);
    for (name, value) in attributes {
        let place = || format!("{at}/attributes/{}", escaped(name));
        let Some(accessor) = accessor(value) else { continue };
        let count = index(accessor, "count");
        if count != vertices && vertices.is_some() {
            let expected = format!("{} elements, as in POSITION", vertices.unwrap_or_default());
            findings.error("PRIMITIVE_COUNT", place(), expected, count.unwrap_or_default());
        }
        check_format(accessor, name, quantized, place, findings);
        check_alignment(document, accessor, place, findings);
    }
    let targets = items(primitive, "targets").iter().enumerate();
    for (k, target) in targets.filter_map(|(k, target)| Some((k, target.as_object()?))) {
        for (name, accessor) in target.iter().filter_map(|(name, value)| Some((name, accessor(value)?))) {
            let place = || format!("{at}/targets/{k}/{}", escaped(name));
            check_alignment(document, accessor, place, findings);
        }
    }
    check_indices(document, primitive, vertices, at, findings);
    check_values(document, primitive, attributes, &format!("{at}/attributes"), findings);
}

/// Checks the names of attributes: known ones, those of extensions, or with `_` at the beginning; numbers without gaps
/// (glTF 2.0, 3.7.2.1).
fn check_names(document: &Document<'_>, attributes: &Map<String, Value>, at: &str, findings: &mut Findings) {
    for name in attributes.keys() {
        let place = || format!("{at}/{}", escaped(name));
        let Some((base, number)) = numbered(name) else {
            let is_core = ["POSITION", "NORMAL", "TANGENT"].contains(&name.as_str());
            let is_of_extension = || name.split_once(':').is_some_and(|(extension, _)| document.uses(extension));
            if !is_core && !name.starts_with('_') && !is_of_extension() {
                let expected = "an attribute of glTF or of a used extension, or a name that begins with `_`";
                findings.error("PRIMITIVE_SEMANTIC", place(), expected, shown(name.as_bytes()));
            }
            continue;
        };
        let mut demand = |other: String| {
            if !attributes.contains_key(&other) {
                findings.error("PRIMITIVE_SETS", place(), format!("{other} as well"), "none");
            }
        };
        if let Some(before) = number.checked_sub(1) {
            demand(format!("{base}_{before}"));
        }
        match base {
            "JOINTS" => demand(format!("WEIGHTS_{number}")),
            "WEIGHTS" => demand(format!("JOINTS_{number}")),
            _ => {}
        }
    }
    if attributes.contains_key("TANGENT") && !attributes.contains_key("NORMAL") {
        findings.warning("PRIMITIVE_TANGENT", format!("{at}/TANGENT"), "NORMAL as well, else it is not used", "none");
    }
}

/// Checks type and component type of an attribute, and whether integers are normalised.
fn check_format(accessor: &Value, name: &str, quantized: bool, place: impl Fn() -> String, findings: &mut Findings) {
    let found_kind = accessor.get("componentType").and_then(Value::as_u64).and_then(Component::of);
    if name.starts_with('_') && found_kind == Some(Component::UnsignedInt) {
        return findings.error("PRIMITIVE_ATTRIBUTE", place(), "a component type of vertex attributes", "UnsignedInt");
    }
    let Some((shapes, kinds)) = attribute_rule(name) else { return };
    let found_shape = accessor.get("type").and_then(Value::as_str).unwrap_or_default();
    let allowed = found_kind.is_none_or(|k| kinds.contains(&k) || quantized);
    if !shapes.contains(&found_shape) || !allowed {
        let expected = format!("{} of {kinds:?}", shapes.join(" or "));
        return findings.error("PRIMITIVE_ATTRIBUTE", place(), expected, format!("{found_shape} of {found_kind:?}"));
    }
    let is_integer = found_kind.is_some_and(|kind| kind != Component::Float);
    let Some((base, _)) = numbered(name).filter(|_| is_integer) else { return };
    let is_normalized = accessor.get("normalized") == Some(&Value::Bool(true));
    if base == "JOINTS" && is_normalized {
        findings.error("PRIMITIVE_NORMALIZED", place(), "integers that are not normalised", "normalised ones");
    } else if base != "JOINTS" && !is_normalized && !(base == "TEXCOORD" && quantized) {
        findings.error("PRIMITIVE_NORMALIZED", place(), "floats or normalised integers", "other integers");
    }
}

fn check_values(
    document: &Document<'_>,
    primitive: &Value,
    attributes: &Map<String, Value>,
    at: &str,
    findings: &mut Findings,
) {
    let elements = |name: &str| document.elements(attributes.get(name)?.as_u64()? as usize);
    if extension_of(primitive, KHR_SPLATS).is_none() {
        check_unit::<3>(elements("NORMAL"), &format!("{at}/NORMAL"), "NORMAL_NORM", findings);
        if let Some(tangents) = elements("TANGENT").filter(|tangents| tangents.components == 4) {
            check_tangents(&tangents, &format!("{at}/TANGENT"), findings);
        }
    }
    // What others mean is up to applications.
    if let Some(colors) = elements("COLOR_0").filter(|colors| colors.kind == Component::Float) {
        check_colors(&colors, &format!("{at}/COLOR_0"), findings);
    }
}

/// Checks that tangents have length 1, and that their fourth component is a sign.
fn check_tangents(tangents: &Elements<'_>, at: &str, findings: &mut Findings) {
    let (mut lengths, mut signs) = (Offenders::default(), Offenders::default());
    for i in 0..tangents.count {
        let [x, y, z, sign] = tangents.vector::<4>(i);
        let norm = (x * x + y * y + z * z).sqrt();
        // NaN has a finding of its own.
        if (norm - 1.0).abs() > UNIT_TOLERANCE {
            lengths.note(|| format!("length {norm:.4} of element {i}"));
        }
        if sign.abs() != 1.0 && !sign.is_nan() {
            signs.note(|| format!("{sign} of element {i}"));
        }
    }
    if let Some(found) = lengths.summary(tangents.count) {
        findings.error("TANGENT_NORM", at, "length 1 of the first three components", found);
    }
    if let Some(found) = signs.summary(tangents.count) {
        findings.error("TANGENT_SIGN", at, "1 or -1 as the fourth component", found);
    }
}

fn check_colors(colors: &Elements<'_>, at: &str, findings: &mut Findings) {
    let mut offenders = Offenders::default();
    for i in 0..colors.count {
        // NaN has a finding of its own.
        let is_outside = |v: &f64| !(0.0..=1.0).contains(v) && !v.is_nan();
        for v in (0..colors.components).map(|c| colors.value(i, c)).filter(is_outside) {
            offenders.note(|| format!("{v} of element {i}"));
        }
    }
    if let Some(found) = offenders.summary(colors.count * colors.components) {
        findings.error("COLOR_RANGE", at, "components from 0 to 1", found);
    }
}

/// Checks that every element of a vertex attribute begins at a multiple of 4 bytes of its view (glTF 2.0, 3.6.2.4).
fn check_alignment(document: &Document<'_>, accessor: &Value, place: impl Fn() -> String, findings: &mut Findings) {
    let kind = accessor.get("componentType").and_then(Value::as_u64).and_then(Component::of);
    let size = accessor.get("type").and_then(Value::as_str).zip(kind).and_then(|(shape, kind)| layout(shape, kind));
    let view = index(accessor, "bufferView").and_then(|view| document.object("bufferViews", view));
    let (Some((size, _)), Some(view)) = (size, view) else { return };
    let stride = index(view, "byteStride").unwrap_or(size);
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
        (2 | 3, Some(n)) => n > 1,
        (4, Some(n)) => n.is_multiple_of(3) && n > 0,
        (5 | 6, Some(n)) => n > 2,
        _ => true,
    };
    if !whole {
        let expected = if mode < 4 { "two ends per line" } else { "three corners per triangle" };
        findings.warning("PRIMITIVE_INCOMPLETE", at, expected, format!("{} in all", corners.unwrap_or_default()));
    }
}
