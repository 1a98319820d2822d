//! Validation of `KHR_gaussian_splatting`.

use serde_json::{Map, Value};

use super::super::{Findings, Offenders};
use super::document::{Component, Document};
use super::scenes::check_unit;
use super::schema::{self, escaped, shown};
use super::{extension, index, primitives, warn_of};
use crate::format::gltf::extension::{HYBRID, KHR_SPLATS, OPACITY, ROTATION, SCALE, sh_attributes};
use crate::scene::{ColorSpace, color, sh};

/// Largest deviation of `COLOR_0` from the splats' colour that rounding to 8 bits explains.
const FALLBACK_TOLERANCE: f64 = 1.5 / 255.0;

pub(super) fn check(document: &Document<'_>, findings: &mut Findings) {
    for (at, primitive) in primitives(document.root) {
        if let Some((at_khr, khr)) = extension(primitive, KHR_SPLATS, &at) {
            check_object(khr, &at_khr, findings);
            let mode = index(primitive, "mode").unwrap_or(4);
            if mode != 0 {
                findings.error("SPLAT_MODE", format!("{at}/mode"), "0 (POINTS)", mode);
            }
            check_indices(primitive, &at, findings);
            // Compressed splats store their attributes elsewhere, and other kernels have other attributes.
            let nested = khr.get("extensions").and_then(Value::as_object);
            let compressed = nested.is_some_and(|names| names.keys().any(|name| name != HYBRID));
            let known_kernel = khr.get("kernel").is_none_or(|kernel| kernel == "ellipse");
            if let Some(attributes) = primitive.get("attributes").and_then(Value::as_object)
                && !compressed
                && known_kernel
            {
                check_attributes(document, attributes, &format!("{at}/attributes"), findings);
                check_values(document, attributes, &format!("{at}/attributes"), findings);
                check_fallback(document, attributes, khr, &format!("{at}/attributes"), findings);
            }
        }
    }
}

/// Warns of indices, which select nothing: splats are the elements of their attributes.
fn check_indices(primitive: &Value, at: &str, findings: &mut Findings) {
    if let Some(accessor) = primitive.get("indices") {
        let expected = "none: every splat of the attributes is shown once";
        findings.warning("SPLAT_INDICES", format!("{at}/indices"), expected, accessor);
    }
}

fn check_object(khr: &Value, at: &str, findings: &mut Findings) {
    schema::check(khr, KHR_SPLATS, at, findings);
    warn_of(schema::unknown(khr, KHR_SPLATS, at), "PROPERTY_UNKNOWN", findings);
    let known: [(&str, &[&str]); 4] = [
        ("kernel", &["ellipse"]),
        ("colorSpace", &ColorSpace::ALL.map(ColorSpace::name)),
        ("projection", &["perspective"]),
        ("sortingMethod", &["cameraDistance"]),
    ];
    for (key, tokens) in known {
        check_token(khr, key, tokens, "SPLAT_TOKEN", at, findings);
    }
}

/// Warns of a string that no known specification defines; extensions may add some.
pub(super) fn check_token(
    object: &Value,
    key: &str,
    tokens: &[&str],
    code: &'static str,
    at: &str,
    findings: &mut Findings,
) {
    if let Some(token) = object.get(key).and_then(Value::as_str)
        && !tokens.contains(&token)
    {
        findings.warning(code, format!("{at}/{key}"), tokens.join(" or "), shown(&token.into()));
    }
}

fn check_attributes(document: &Document<'_>, attributes: &Map<String, Value>, at: &str, findings: &mut Findings) {
    use Component::{Byte, Float, Short, UnsignedByte, UnsignedShort};
    let degree =
        |name: &str| name.strip_prefix("KHR_gaussian_splatting:SH_DEGREE_")?.split_once("_COEF_")?.0.parse().ok();
    let highest: u32 =
        attributes.keys().filter_map(|name| degree(name)).filter(|&d| d <= sh::MAX_DEGREE).max().unwrap_or(0);
    let harmonics: Vec<String> = sh_attributes(highest).collect();
    // Name, type, component types of floats and plain integers, component types of normalised integers.
    let rules: [(&str, &str, &[Component], &[Component]); 3] = [
        (ROTATION, "VEC4", &[Float], &[Byte, Short]),
        (SCALE, "VEC3", &[Float, UnsignedByte, UnsignedShort], &[UnsignedByte, UnsignedShort]),
        (OPACITY, "SCALAR", &[Float], &[UnsignedByte, UnsignedShort]),
    ];
    let harmonic =
        |name: &'_ str| -> (String, &str, &[Component], &[Component]) { (name.to_owned(), "VEC3", &[Float], &[]) };
    let rules = rules.map(|(name, shape, plain, normalized)| (name.to_owned(), shape, plain, normalized));
    for (name, shape, plain, normalized) in rules.into_iter().chain(harmonics.iter().map(|name| harmonic(name))) {
        let Some(accessor) = attributes.get(&name) else {
            let code = if name.contains(":SH_DEGREE_") { "SPLAT_SH_INCOMPLETE" } else { "SPLAT_ATTRIBUTE_MISSING" };
            findings.error(code, at, format!("the attribute `{name}`"), "none");
            continue;
        };
        let Some(accessor) = accessor.as_u64().and_then(|i| document.object("accessors", i as usize)) else { continue };
        let kind = accessor.get("componentType").and_then(Value::as_u64).and_then(Component::of);
        let is_normalized = accessor.get("normalized") == Some(&Value::Bool(true));
        let allowed = if is_normalized { normalized } else { plain };
        let found_shape = accessor.get("type").and_then(Value::as_str).unwrap_or_default();
        if found_shape != shape || kind.is_some_and(|kind| !allowed.contains(&kind)) {
            let normalised = if is_normalized { "normalised " } else { "" };
            let expected = format!("{shape} of {plain:?} or normalised {normalized:?}");
            let found = format!("{found_shape} of {normalised}{}", kind.map_or("?".to_owned(), |k| format!("{k:?}")));
            findings.error("SPLAT_ATTRIBUTE_TYPE", format!("{at}/{}", escaped(&name)), expected, found);
        }
    }
    for name in attributes.keys().filter(|name| name.starts_with("KHR_gaussian_splatting:")) {
        if ![ROTATION, SCALE, OPACITY].contains(&name.as_str()) && !harmonics.contains(name) {
            let expected = "ROTATION, SCALE, OPACITY or SH_DEGREE_l_COEF_m of degrees 0 to 3";
            findings.error("SPLAT_ATTRIBUTE_UNKNOWN", format!("{at}/{}", escaped(name)), expected, format!("`{name}`"));
        }
    }
}

fn check_values(document: &Document<'_>, attributes: &Map<String, Value>, at: &str, findings: &mut Findings) {
    let elements = |name: &str| document.elements(attributes.get(name)?.as_u64()? as usize);
    check_unit::<4>(elements(ROTATION), &format!("{at}/{ROTATION}"), "SPLAT_ROTATION_NORM", findings);
    let mut check = |name: &str, code: &'static str, expected: &str, is_bad: fn(f64) -> bool| {
        let Some(elements) = elements(name) else { return };
        let mut offenders = Offenders::default();
        for i in 0..elements.count {
            for v in (0..elements.components).map(|c| elements.value(i, c)).filter(|&v| is_bad(v)) {
                offenders.note(|| format!("{v} of splat {i}"));
            }
        }
        if let Some(found) = offenders.summary(elements.count * elements.components) {
            findings.error(code, format!("{at}/{name}"), expected, found);
        }
    };
    check(SCALE, "SPLAT_SCALE_NEGATIVE", "linear scales ≥ 0", |v| v < 0.0);
    // NaN has a finding of its own.
    check(OPACITY, "SPLAT_OPACITY_RANGE", "linear opacities from 0 to 1", |v| !(0.0..=1.0).contains(&v) && !v.is_nan());
}

/// Checks `COLOR_0`, which is linear light regardless of the splats' colour space; a common mistake of writers.
fn check_fallback(
    document: &Document<'_>,
    attributes: &Map<String, Value>,
    khr: &Value,
    at: &str,
    findings: &mut Findings,
) {
    let elements = |name: &str| document.elements(attributes.get(name)?.as_u64()? as usize);
    let dc = sh_attributes(0).next().unwrap_or_default();
    let (Some(color), Some(dc)) = (elements("COLOR_0"), elements(&dc)) else { return };
    let is_srgb = khr.get("colorSpace").and_then(Value::as_str) == Some(ColorSpace::SrgbDisplay.name());
    let (mut worst, mut first) = (0.0, 0);
    for i in 0..color.count.min(dc.count) {
        let (stored, dc) = (color.vector::<3>(i), dc.vector::<3>(i));
        for c in 0..3 {
            let shown = (0.5 + sh::C0 * dc[c]).clamp(0.0, 1.0);
            let linear = if is_srgb { f64::from(color::srgb_to_linear(shown as f32)) } else { shown };
            if (stored[c] - linear).abs() > worst {
                (worst, first) = ((stored[c] - linear).abs(), i);
            }
        }
    }
    if worst > FALLBACK_TOLERANCE {
        let expected = "0.5 + C0·SH coefficient 0, clamped, in linear light";
        findings.warning(
            "SPLAT_FALLBACK_COLOR",
            format!("{at}/COLOR_0"),
            expected,
            format!("{worst:.3} off in splat {first}"),
        );
    }
}
