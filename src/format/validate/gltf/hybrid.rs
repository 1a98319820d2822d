//! `EXT_gaussian_splatting_hybrid`: schemas, and what they cannot say.

use std::collections::HashMap;

use serde_json::Value;

use super::super::{Findings, Offenders};
use super::binding::is_unsigned;
use super::document::{Component, Document, Elements};
use super::moving::check_times;
use super::schema::{self, Unknown};
use super::splats::check_token;
use super::{binding, extension, fields, index, objects, primitives};
use crate::format::error::shown;
use crate::format::gltf::extension::{HYBRID, KHR_SPLATS, TEXTURE_TRANSFORM, extension_of};
use crate::scene::ColorSpace;

/// The objects of the extension in a document, each with its JSON pointer and the name of its schema.
fn parts<'a>(root: &'a Value) -> Vec<(String, &'a Value, String)> {
    let mut found = vec![];
    let mut add = |object: Option<(String, &'a Value)>, of: &str| {
        found.extend(object.map(|(at, part)| (at, part, format!("{of}.{HYBRID}.schema.json"))));
    };
    objects(root, "scenes", "").for_each(|(at, scene)| add(extension(scene, HYBRID, &at), "scene"));
    objects(root, "materials", "").for_each(|(at, material)| add(extension(material, HYBRID, &at), "material"));
    for (at, primitive) in primitives(root) {
        add(extension(primitive, HYBRID, &at), "mesh.primitive");
        let khr = extension(primitive, KHR_SPLATS, &at);
        add(khr.and_then(|(at, khr)| extension(khr, HYBRID, &at)), KHR_SPLATS);
    }
    add(extension(root, HYBRID, ""), "glTF");
    found
}

/// Every property of the extension's objects that it does not have.
pub(super) fn unknown(root: &Value) -> Vec<Unknown> {
    let mut found = vec![];
    parts(root).iter().for_each(|(at, part, name)| schema::unknown(part, name, at, &mut found));
    found
}

pub(super) fn check(document: &Document<'_>, findings: &mut Findings) {
    let root = document.root;
    let required = root.get("extensionsRequired").and_then(Value::as_array).into_iter().flatten();
    if let Some(i) = required.clone().position(|name| name == HYBRID) {
        let expected = "optional use: every part has a fallback in core glTF";
        findings.warning("HYBRID_REQUIRED", format!("/extensionsRequired/{i}"), expected, "required");
    }
    parts(root).iter().for_each(|(at, part, name)| schema::check(part, name, at, findings));
    for Unknown { at, name, known } in unknown(root) {
        findings.warning("HYBRID_PROPERTY", at, format!("no other than {}", known.join(", ")), shown(name.as_bytes()));
    }
    for (at, scene) in objects(root, "scenes", "") {
        if let Some((at, contract)) = extension(scene, HYBRID, &at) {
            check_scene(root, contract, &at, findings);
        }
    }
    let mut shown_by: HashMap<usize, Vec<(String, &Value)>> = HashMap::new();
    for (at, primitive) in primitives(root) {
        if let Some(material) = index(primitive, "material") {
            shown_by.entry(material).or_default().push((at, primitive));
        }
    }
    for (i, (at, material)) in objects(root, "materials", "").enumerate() {
        if let Some((at_radiance, radiance)) = extension(material, HYBRID, &at) {
            let shown = shown_by.get(&i).map_or(&[][..], Vec::as_slice);
            check_material(document, (i, material, shown), radiance, &at_radiance, findings);
        }
    }
    for (at, primitive) in primitives(root) {
        if let Some((at_surface, surface)) = extension(primitive, HYBRID, &at) {
            check_surface(document, primitive, surface, (&at, &at_surface), findings);
        }
        if let Some((at_khr, khr)) = extension(primitive, KHR_SPLATS, &at)
            && let Some((at, bound)) = extension(khr, HYBRID, &at_khr)
            && let Some(own) = bound.get("binding")
        {
            binding::check(document, primitive, own, &format!("{at}/binding"), findings);
        }
    }
    check_mixed(root, findings);
    if let Some((at, own)) = extension(root, HYBRID, "") {
        fields::check(document, own, &at, findings);
    }
}

/// Splats and other primitives in one mesh: some viewers refuse the whole file.
fn check_mixed(root: &Value, findings: &mut Findings) {
    let is_used = objects(root, "scenes", "").any(|(at, scene)| extension(scene, HYBRID, &at).is_some());
    for (at, mesh) in objects(root, "meshes", "").filter(|_| is_used) {
        let parts = || objects(mesh, "primitives", &at).map(|(at, p)| extension(p, KHR_SPLATS, &at).is_some());
        if parts().any(|is_splats| is_splats) && !parts().all(|is_splats| is_splats) {
            findings.error("HYBRID_MIXED_MESH", at, "splats and triangles in different meshes", "both");
        }
    }
}

fn check_scene(root: &Value, contract: &Value, at: &str, findings: &mut Findings) {
    check_token(contract, "colorSpace", &ColorSpace::ALL.map(ColorSpace::name), "HYBRID_TOKEN", at, findings);
    check_token(contract, "mode", &["stable", "surfaceConsistent", "direct"], "HYBRID_TOKEN", at, findings);
    check_token(contract, "sortKey", &["viewZ"], "HYBRID_TOKEN", at, findings);
    let Some(space) = contract.get("colorSpace").and_then(Value::as_str) else { return };
    let splats = primitives(root).filter_map(|(at, primitive)| extension(primitive, KHR_SPLATS, &at));
    let materials = objects(root, "materials", "").filter_map(|(at, material)| extension(material, HYBRID, &at));
    for (place, object) in splats.chain(materials) {
        if let Some(other) = object.get("colorSpace").and_then(Value::as_str).filter(|&other| other != space) {
            let expected = format!("{space}, as in {at}");
            findings.error("HYBRID_COLOR_SPACE", format!("{place}/colorSpace"), expected, other);
        }
    }
}

/// Primitives, each with its JSON pointer.
type Primitives<'a> = [(String, &'a Value)];

fn check_material(
    document: &Document<'_>,
    (i, material, shown): (usize, &Value, &Primitives<'_>),
    radiance: &Value,
    at: &str,
    findings: &mut Findings,
) {
    check_token(radiance, "colorSpace", &ColorSpace::ALL.map(ColorSpace::name), "HYBRID_TOKEN", at, findings);
    if let Some(opacity) = radiance.get("opacity") {
        check_token(opacity, "activation", &["none", "logistic"], "HYBRID_TOKEN", &format!("{at}/opacity"), findings);
        check_texels(document, (opacity, shown), 1, &format!("{at}/opacity"), findings);
        let mode = material.get("alphaMode").and_then(Value::as_str).unwrap_or("OPAQUE");
        if mode != "BLEND" {
            let expected = "alphaMode BLEND, so that other viewers blend as well";
            findings.warning("HYBRID_ALPHA_MODE", format!("/materials/{i}"), expected, mode);
        }
    }
    let Some(harmonics) = radiance.get("sphericalHarmonics") else { return };
    let at = format!("{at}/sphericalHarmonics");
    check_token(harmonics, "frame", &["node", "triangle"], "HYBRID_TOKEN", &at, findings);
    let stored = harmonics.get("coefficients").and_then(Value::as_array).map_or(0, Vec::len);
    if let Some(degree) = index(harmonics, "degree").filter(|d| *d <= 3 && (d + 1) * (d + 1) != stored) {
        let expected = format!("{} for degree {degree}", (degree + 1) * (degree + 1));
        findings.error("HYBRID_SH_COUNT", format!("{at}/coefficients"), expected, stored);
    }
    for (at, source) in objects(harmonics, "coefficients", &at) {
        check_texels(document, (source, shown), 3, &at, findings);
    }
    check_sizes(radiance.get("opacity"), harmonics, &at, findings);
    check_coordinates(radiance.get("opacity"), harmonics, &at, findings);
}

/// Where a texel source lies.
#[derive(PartialEq)]
struct Coordinates {
    set: usize,
    /// Offset, scale, rotation.
    transform: [f64; 5],
}

impl Coordinates {
    fn of(source: &Value) -> Self {
        let texture = source.get("texture").unwrap_or(&Value::Null);
        let transform = extension_of(texture, TEXTURE_TRANSFORM).unwrap_or(&Value::Null);
        let part =
            |key: &str, i: usize, usual: f64| transform.get(key).and_then(|v| v.get(i)?.as_f64()).unwrap_or(usual);
        let rotation = transform.get("rotation").and_then(Value::as_f64).unwrap_or(0.0);
        let set =
            index(transform, "texCoord").or(index(texture, "texCoord")).or(index(source, "texCoord")).unwrap_or(0);
        let [offset, scale] = [("offset", 0.0), ("scale", 1.0)].map(|(key, usual)| [0, 1].map(|i| part(key, i, usual)));
        Self { set, transform: [offset[0], offset[1], scale[0], scale[1], rotation] }
    }
}

/// One set and one transform for all.
fn check_coordinates(opacity: Option<&Value>, harmonics: &Value, at: &str, findings: &mut Findings) {
    let mut sources = objects(harmonics, "coefficients", at);
    let Some((_, first)) = sources.next() else { return };
    let expected = Coordinates::of(first);
    let opacity = opacity.map(|opacity| (at.replace("/sphericalHarmonics", "/opacity"), opacity));
    for (at, source) in sources.chain(opacity) {
        let own = Coordinates::of(source);
        if own != expected {
            let shown = |c: &Coordinates| format!("TEXCOORD_{}, offset, scale and rotation {:?}", c.set, c.transform);
            findings.error("HYBRID_TEXEL_UV", at, format!("{}, as of coefficient 0", shown(&expected)), shown(&own));
        }
    }
}

/// One size for coefficient 0 and the opacity, one for all other coefficients. Sizes of images are not looked at.
fn check_sizes(opacity: Option<&Value>, harmonics: &Value, at: &str, findings: &mut Findings) {
    let size = |source: &Value| Some((index(source, "width")?, index(source, "height")?));
    let mut sizes = objects(harmonics, "coefficients", at).map(|(at, source)| (at, size(source)));
    let Some((at_first, first)) = sizes.next() else { return };
    let mut demand = |at: String, found: Option<(usize, usize)>, expected: Option<(usize, usize)>, like: &str| {
        if let (Some((w, h)), Some((width, height))) = (found, expected)
            && (w, h) != (width, height)
        {
            let expected = format!("{width}×{height}, as in {like}");
            findings.error("HYBRID_MAP_SIZE", at, expected, format!("{w}×{h}"));
        }
    };
    demand(at_first, first, opacity.and_then(size), "the opacity");
    if let Some((like, bands)) = sizes.next() {
        sizes.for_each(|(at, found)| demand(at, found, bands, &like));
    }
}

/// A texel source with `channels` values per texel, of a material of these primitives.
fn check_texels(
    document: &Document<'_>,
    (source, shown): (&Value, &Primitives<'_>),
    channels: usize,
    at: &str,
    findings: &mut Findings,
) {
    if source.get("accessor").is_some() == source.get("texture").is_some() {
        // The schema has said so; what the one or the other should be like is anybody's guess.
        return;
    }
    if let Some(accessor) = index(source, "accessor")
        && let Some(elements) = document.elements(accessor)
    {
        let at = format!("{at}/accessor");
        let size = index(source, "width").unwrap_or(0).saturating_mul(index(source, "height").unwrap_or(0));
        if elements.count != size {
            findings.error("HYBRID_TEXEL_COUNT", &at, format!("width × height = {size} elements"), elements.count);
        }
        let is_number = elements.kind == Component::Float || elements.normalized;
        if elements.components != channels || !is_number {
            let expected = format!("{channels} component(s), of Float or a normalised type");
            let found = format!("{} of {:?}", elements.components, elements.kind);
            findings.error("HYBRID_TEXEL_TYPE", &at, expected, found);
        }
    }
    for key in ["offset", "scale"] {
        let length = source.get(key).and_then(Value::as_array).map(Vec::len);
        if let Some(length) = length.filter(|&n| n != 1 && n != channels) {
            findings.error("HYBRID_TEXEL_RANGE", format!("{at}/{key}"), format!("1 or {channels} numbers"), length);
        }
    }
    let name = format!("TEXCOORD_{}", Coordinates::of(source).set);
    let mut lacking = Offenders::default();
    for (at_primitive, primitive) in shown {
        if primitive.get("attributes").is_some_and(|a| a.get(&name).is_none()) {
            lacking.note(|| at_primitive.clone());
        }
    }
    if let Some(found) = lacking.summary(shown.len()) {
        let expected = format!("{name} in every primitive of the material");
        findings.error("HYBRID_TEXCOORD", at, expected, format!("none in {found}"));
    }
}

pub(super) fn position_of<'a>(document: &'a Document<'_>, primitive: &Value) -> Option<Elements<'a>> {
    document.elements(index(primitive.get("attributes")?, "POSITION")?)
}

fn check_surface(
    document: &Document<'_>,
    primitive: &Value,
    surface: &Value,
    (at_primitive, at): (&str, &str),
    findings: &mut Findings,
) {
    let mode = index(primitive, "mode").unwrap_or(4);
    if mode != 4 {
        findings.error("HYBRID_MODE", format!("{at_primitive}/mode"), "4 (TRIANGLES)", mode);
    }
    let Some(positions) = position_of(document, primitive) else { return };
    if let Some(source) = index(surface, "surfaceVertices").and_then(|i| document.elements(i)) {
        check_surface_vertices(&source, &positions, &format!("{at}/surfaceVertices"), findings);
    }
    check_token(surface, "interpolation", &["LINEAR", "STEP"], "HYBRID_TOKEN", at, findings);
    let Some(times) = index(surface, "times").and_then(|i| document.elements(i)) else { return };
    check_times(&times, &format!("{at}/times"), findings);
    if let Some(moved) = index(surface, "translations").and_then(|i| document.elements(i)) {
        let expected = times.count.saturating_mul(positions.count);
        if moved.count != expected || moved.components != 3 {
            let expected = format!("{expected} elements of 3 components: {} times {}", times.count, positions.count);
            let found = format!("{} of {}", moved.count, moved.components);
            findings.error("HYBRID_TRANSLATIONS", format!("{at}/translations"), expected, found);
        }
    }
}

fn check_surface_vertices(source: &Elements<'_>, positions: &Elements<'_>, at: &str, findings: &mut Findings) {
    if !is_unsigned(source) || source.count != positions.count {
        let expected = format!("{} SCALAR elements of an unsigned integer type", positions.count);
        return findings.error("HYBRID_SURFACE_TYPE", at, expected, format!("{} of {:?}", source.count, source.kind));
    }
    let mut places: HashMap<u64, [f64; 3]> = HashMap::new();
    let mut apart = Offenders::default();
    for i in 0..source.count {
        let (vertex, position) = (source.raw(i, 0) as u64, positions.vector::<3>(i));
        if *places.entry(vertex).or_insert(position) != position {
            apart.note(|| format!("vertex {i}, a copy of {vertex}"));
        }
    }
    if let Some(found) = apart.summary(source.count) {
        findings.error("HYBRID_SURFACE_POSITION", at, "copies of a surface vertex in one place", found);
    }
    let gap = (0..places.len() as u64).find(|v| !places.contains_key(v));
    if let Some(gap) = gap {
        let expected = format!("numbers from 0 to {} without gaps", places.len() - 1);
        findings.error("HYBRID_SURFACE_GAP", at, expected, format!("none that is {gap}"));
    }
}
