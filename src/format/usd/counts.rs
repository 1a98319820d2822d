//! Check of whether arrays of meshes and splats have as many values as their interpolation requires. Readers stop at
//! those that they use, and truncate or ignore the others.

use std::collections::HashMap;

use super::Breach;
use super::document::{Numeric, Prim, Property, PropertyKind, Value, field};
use super::splats::coefficients_stated;
use super::stage::Stage;
use super::to_scene::SPLATS;
use crate::format::error::Fault;

/// Interpolations of `UsdGeomPrimvar`.
const INTERPOLATIONS: [&str; 5] = ["constant", "uniform", "varying", "vertex", "faceVarying"];

/// Per-point attributes of a mesh besides positions, unless they state another interpolation.
const OF_POINTS: [&str; 3] = ["normals", "velocities", "accelerations"];

/// Attributes of splats, in single precision or, with suffix `h`, in half precision.
const OF_SPLATS: [&str; 3] = ["orientations", "scales", "opacities"];
const HARMONICS: &str = "radiance:sphericalHarmonicsCoefficients";

/// Numbers of a prim's elements for which values can be given; `None` if unknown or varying over time.
struct Sizes {
    points: Option<usize>,
    faces: Option<usize>,
    corners: Option<usize>,
}

impl Sizes {
    fn of(&self, interpolation: &str) -> Option<usize> {
        match interpolation {
            "constant" => Some(1),
            "uniform" => self.faces,
            "varying" | "vertex" => self.points,
            _ => self.corners,
        }
    }
}

/// Reports faults of the arrays of a prim, at most one per array.
pub(super) fn check(stage: &Stage<'_>, prim: usize, breaches: &mut Vec<Breach>) {
    let here = stage.prims[prim];
    let is_mesh = here.type_name == "Mesh";
    if !is_mesh && here.type_name != SPLATS {
        return;
    }
    let points = if is_mesh { count(here, "points") } else { either(here, "positions").and_then(count_of) };
    let sizes = Sizes { points, faces: count(here, "faceVertexCounts"), corners: count(here, "faceVertexIndices") };
    // Looked up by name for each attribute, of which there can be many.
    let named: HashMap<&str, &Property> = here.properties.iter().map(|p| (p.name.as_str(), p)).collect();
    for property in &here.properties {
        let name = property.name.as_str();
        let usual = match name.strip_prefix("primvars:") {
            Some(primvar) if !primvar.ends_with(":indices") => "constant",
            None if is_mesh && OF_POINTS.contains(&name) => "vertex",
            _ => continue,
        };
        let indices = named.get(format!("{name}:indices").as_str()).copied();
        breaches.extend(primvar(stage, prim, (property, indices), usual, &sizes));
    }
    let Some(n) = points.filter(|_| !is_mesh) else { return };
    let expected =
        OF_SPLATS.map(|name| (name, 1)).into_iter().chain(coefficients_stated(stage, prim).map(|k| (HARMONICS, k)));
    for (name, each) in expected {
        let Some(property) = either(here, name) else { continue };
        let expected = n.saturating_mul(each);
        if let Some(found) = count_of(property).filter(|&found| found != expected) {
            breaches.push(breach(stage, prim, &property.name, format!("{expected} values for {n} splats"), &found));
        }
    }
}

/// Checks a primvar, with or without indices.
fn primvar(
    stage: &Stage<'_>,
    prim: usize,
    (property, indices): (&Property, Option<&Property>),
    usual: &str,
    sizes: &Sizes,
) -> Option<Breach> {
    let name = &property.name;
    let interpolation = field(&property.metadata, "interpolation").and_then(Value::as_text).unwrap_or(usual);
    if !INTERPOLATIONS.contains(&interpolation) {
        let expected = format!("an interpolation: {}", INTERPOLATIONS.join(", "));
        return Some(breach(stage, prim, name, expected, &format!("`{interpolation}`")));
    }
    let found = count_of(property)?;
    let each = field(&property.metadata, "elementSize").and_then(Value::as_number);
    let each = each.filter(|n| *n >= 1.0).map_or(1, |n| n as usize);
    let expected = sizes.of(interpolation)?;
    let (at, found, each) = match indices {
        Some(indices) => {
            if let Some(outside) = outside(indices, found / each) {
                let expected = format!("indices below {}", found / each);
                return Some(breach(stage, prim, &indices.name, expected, &outside));
            }
            (&indices.name, count_of(indices)?, 1)
        }
        None => (name, found, each),
    };
    let expected = expected.saturating_mul(each);
    let says = format!("{expected} values for interpolation {interpolation}");
    // Constant arrays are allowed, but rarely intended.
    let is_error = interpolation != "constant";
    (found != expected).then(|| Breach { is_error, ..breach(stage, prim, at, says, &found) })
}

/// First index that is not less than `count`.
fn outside(indices: &Property, count: usize) -> Option<i64> {
    let of_value = |value: &Value| match value {
        Value::Integers(all) => all.iter().copied().find(|&i| !usize::try_from(i).is_ok_and(|i| i < count)),
        _ => None,
    };
    values(indices).find_map(of_value)
}

fn breach(stage: &Stage<'_>, prim: usize, name: &str, expected: String, found: &impl ToString) -> Breach {
    let fault = Fault::pointer(format!("{}.{name}", stage.path(prim)), expected, found.to_string());
    Breach { code: "USD_COUNT", is_error: true, fault }
}

/// Attribute in single precision, else in half precision.
fn either<'a>(prim: &'a Prim, name: &str) -> Option<&'a Property> {
    prim.property(name).or_else(|| prim.property(&format!("{name}h")))
}

fn count(prim: &Prim, name: &str) -> Option<usize> {
    prim.property(name).and_then(count_of)
}

/// Number of elements of an array, if it is the same at all times.
fn count_of(property: &Property) -> Option<usize> {
    let PropertyKind::Attribute { type_name, .. } = &property.kind else { return None };
    let elements = |value: &Value| {
        let numbers = match value {
            Value::Floats(all) => all.len(),
            Value::Doubles(all) => all.len(),
            Value::Integers(all) => all.len(),
            Value::List(all) => return Some(all.len()),
            _ => return None,
        };
        Some(numbers / Numeric::of(type_name)?.width())
    };
    let mut counts = values(property).filter(|value| **value != Value::Blocked).map(elements);
    let first = counts.next()??;
    counts.all(|other| other == Some(first)).then_some(first).filter(|_| type_name.ends_with("[]"))
}

/// Value of an attribute, and those of its samples.
fn values(property: &Property) -> impl Iterator<Item = &Value> {
    let (value, samples) = match &property.kind {
        PropertyKind::Attribute { value, samples, .. } => (value.as_ref(), &samples[..]),
        PropertyKind::Relationship { .. } => (None, &[][..]),
    };
    value.into_iter().chain(samples.iter().map(|(_, value)| value))
}
