//! Validation of buffer views and accessors: ranges, alignment, values.

use serde_json::Value;

use super::super::{Findings, Offenders};
use super::document::{Component, Document, Elements, components};
use super::{index, objects};

pub(super) fn check(document: &Document<'_>, findings: &mut Findings) {
    for (at, view) in objects(document.root, "bufferViews", "") {
        let Some(length) = index(view, "buffer").and_then(|b| document.buffer_length(b)) else { continue };
        let (offset, bytes) = (index(view, "byteOffset").unwrap_or(0), index(view, "byteLength").unwrap_or(0));
        if offset.checked_add(bytes).is_none_or(|end| end > length) {
            let found = format!("a buffer of {length} bytes");
            findings.error("VIEW_RANGE", at, format!("{bytes} bytes from byte {offset}"), found);
        }
    }
    for (i, (at, accessor)) in objects(document.root, "accessors", "").enumerate() {
        check_layout(document, accessor, &at, findings);
        check_sparse(document, i, accessor, &at, findings);
        check_count(document, i, accessor, &at, findings);
        // Bounds of accessors without stored data are unconstrained (glTF 2.0, 3.6.2.5).
        if let Some(elements) = document.elements(i).filter(Elements::is_stored) {
            check_values(&elements, accessor, &at, findings);
        }
    }
}

/// Reports an accessor that lacks bounds where glTF requires them (2.0, 3.6.2.5).
pub(super) fn check_bounds(
    document: &Document<'_>,
    accessor: usize,
    code: &'static str,
    of: &str,
    findings: &mut Findings,
) {
    let Some(object) = document.object("accessors", accessor) else { return };
    if object.get("min").is_none() || object.get("max").is_none() {
        findings.error(code, format!("/accessors/{accessor}"), format!("min and max, as for every {of}"), "none");
    }
}

fn check_layout(document: &Document<'_>, accessor: &Value, at: &str, findings: &mut Findings) {
    let kind = accessor.get("componentType").and_then(Value::as_u64).and_then(Component::of);
    let shape = accessor.get("type").and_then(Value::as_str).unwrap_or_default();
    let (Some(kind), Some(_)) = (kind, components(shape)) else { return };
    let normalized = accessor.get("normalized") == Some(&Value::Bool(true));
    if normalized && matches!(kind, Component::Float | Component::UnsignedInt) {
        findings.error("ACCESSOR_NORMALIZED", format!("{at}/normalized"), "false for this component type", true);
    }
    for key in ["min", "max"] {
        let length = accessor.get(key).and_then(Value::as_array).map(Vec::len);
        if let Some(length) = length.filter(|&n| Some(n) != components(shape)) {
            findings.error(
                "ACCESSOR_BOUNDS",
                format!("{at}/{key}"),
                format!("as many numbers as a {shape} has"),
                length,
            );
        }
    }
    let mut check = |view: usize, offset: usize, count: usize, kind: Component, shape: &str, at: &str| {
        if let Some((expected, found)) = document.range_fault(view, offset, count, kind, shape) {
            findings.error("ACCESSOR_RANGE", at, expected, found);
        }
        let view = document.root.get("bufferViews").and_then(|v| v.get(view));
        let start = view.and_then(|v| index(v, "byteOffset")).unwrap_or(0).saturating_add(offset);
        // Columns of matrices begin at multiples of 4 (glTF 2.0, 3.6.2.4).
        let size = if shape.starts_with("MAT") { 4 } else { kind.size() };
        if !offset.is_multiple_of(size) || !start.is_multiple_of(size) {
            let expected = format!("a start that is a multiple of {size}, in the view and in the buffer");
            findings.error("ACCESSOR_ALIGNMENT", at, expected, format!("bytes {offset} and {start}"));
        }
    };
    let offset = |object: &Value| index(object, "byteOffset").unwrap_or(0);
    if let (Some(view), Some(count)) = (index(accessor, "bufferView"), index(accessor, "count")) {
        check(view, offset(accessor), count, kind, shape, at);
    }
    if let Some(sparse) = accessor.get("sparse")
        && let (Some(count), Some(indices), Some(values)) =
            (index(sparse, "count"), sparse.get("indices"), sparse.get("values"))
    {
        let index_kind = indices.get("componentType").and_then(Value::as_u64).and_then(Component::of);
        if let (Some(view), Some(kind)) = (index(indices, "bufferView"), index_kind) {
            check(view, offset(indices), count, kind, "SCALAR", &format!("{at}/sparse/indices"));
        }
        if let Some(view) = index(values, "bufferView") {
            check(view, offset(values), count, kind, shape, &format!("{at}/sparse/values"));
        }
    }
}

fn check_sparse(document: &Document<'_>, i: usize, accessor: &Value, at: &str, findings: &mut Findings) {
    if accessor.get("sparse").is_none() {
        return;
    }
    let Some((indices, count)) = document.sparse_indices(i) else { return };
    let mut offenders = Offenders::default();
    for (k, &index) in indices.iter().enumerate() {
        if index as usize >= count || (k > 0 && indices[k - 1] >= index) {
            offenders.note(|| format!("{index} at position {k}"));
        }
    }
    if let Some(found) = offenders.summary(indices.len()) {
        let expected = format!("strictly increasing indices below {count}");
        findings.error("SPARSE_INDICES", format!("{at}/sparse/indices"), expected, found);
    }
}

/// Warns of zeros, stored nowhere, that are more than `convert` reads.
fn check_count(document: &Document<'_>, i: usize, accessor: &Value, at: &str, findings: &mut Findings) {
    if accessor.get("bufferView").is_some() || document.is_supplied(i) {
        return;
    }
    let most = document.stored_bytes();
    if let Some(count) = index(accessor, "count").filter(|&count| count > most) {
        let expected = format!("at most {most} elements without a bufferView, the bytes of all buffers");
        findings.warning("ACCESSOR_COUNT", format!("{at}/count"), expected, count);
    }
}

fn check_values(elements: &Elements<'_>, accessor: &Value, at: &str, findings: &mut Findings) {
    let bound = |key: &str| {
        let numbers = accessor.get(key)?.as_array()?;
        (numbers.len() == elements.components).then(|| numbers.iter().map(|n| n.as_f64().unwrap_or(f64::NAN)).collect())
    };
    let declared: [Option<Vec<f64>>; 2] = [bound("min"), bound("max")];
    // Integers are always finite; without declared bounds there is nothing to compare.
    if elements.kind != Component::Float && declared.iter().all(Option::is_none) {
        return;
    }
    let n = elements.components;
    let (mut low, mut high) = (vec![f64::INFINITY; n], vec![f64::NEG_INFINITY; n]);
    let mut not_finite = Offenders::default();
    for i in 0..elements.count {
        for c in 0..n {
            let v = elements.raw(i, c);
            if !v.is_finite() {
                not_finite.note(|| format!("{v} in element {i}"));
            }
            low[c] = low[c].min(v);
            high[c] = high[c].max(v);
        }
    }
    if let Some(found) = not_finite.summary(elements.count.saturating_mul(n)) {
        findings.error("ACCESSOR_NOT_FINITE", at, "finite numbers", found);
    }
    for ((key, declared), actual) in ["min", "max"].into_iter().zip(declared).zip([low, high]) {
        // Bounds of floats are written in decimal, often with fewer digits than f32 has.
        let as_stored = |v: f64| if elements.kind == Component::Float { f64::from(v as f32) } else { v };
        let differs = |(a, b): (&f64, &f64)| as_stored(*a) != *b;
        if let Some(declared) = declared
            && let Some(c) = declared.iter().zip(&actual).position(differs)
        {
            let expected = format!("{}, the {key} of component {c}", actual[c]);
            findings.error("ACCESSOR_BOUNDS", format!("{at}/{key}"), expected, declared[c]);
        }
    }
}
