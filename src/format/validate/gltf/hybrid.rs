//! Validation of `EXT_gaussian_splatting_hybrid`: by schemas, and by rules beyond them.

use std::collections::{BTreeSet, HashMap, HashSet};

use serde_json::Value;

use super::super::{Findings, Offenders};
use super::document::{Component, Document, Elements};
use super::materials::{Primitives, check_set, primitives_of, set_of};
use super::moving::check_times;
use super::pictures::Pictures;
use super::schema::{self, Unknown};
use super::splats::check_token;
use super::{binding, extension, fields, index, objects, primitives, warn_of};
use crate::format::gltf::extension::{HYBRID, KHR_SPLATS, TEXTURE_TRANSFORM, extension_of};
use crate::scene::ColorSpace;

/// Objects of the extension in a document, each with its JSON pointer and the name of its schema.
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

/// Properties of the extension's objects that it does not define.
pub(super) fn unknown(root: &Value) -> Vec<Unknown> {
    parts(root).iter().flat_map(|(at, part, name)| schema::unknown(part, name, at)).collect()
}

pub(super) fn check(document: &Document<'_>, findings: &mut Findings) {
    let root = document.root;
    let required = root.get("extensionsRequired").and_then(Value::as_array).into_iter().flatten();
    if let Some(i) = required.clone().position(|name| name == HYBRID) {
        let expected = "optional use: every part has a fallback in core glTF";
        findings.warning("HYBRID_REQUIRED", format!("/extensionsRequired/{i}"), expected, "required");
    }
    parts(root).iter().for_each(|(at, part, name)| schema::check(part, name, at, findings));
    warn_of(unknown(root), "HYBRID_PROPERTY", findings);
    let mut composed = BTreeSet::new();
    for (at, scene) in objects(root, "scenes", "") {
        if let Some((at, contract)) = extension(scene, HYBRID, &at) {
            let reached = Reached::by(root, scene);
            check_scene(root, contract, &reached, &at, findings);
            composed.extend(reached.meshes);
        }
    }
    check_mixed(root, &composed, findings);
    let shown_by = primitives_of(root);
    let mut pictures = Pictures::new(document);
    for (i, (at, material)) in objects(root, "materials", "").enumerate() {
        if let Some((at_radiance, radiance)) = extension(material, HYBRID, &at) {
            let shown = shown_by.get(&i).map_or(&[][..], Vec::as_slice);
            check_material(document, &mut pictures, (i, material, shown), radiance, &at_radiance, findings);
        }
    }
    for (at, primitive) in primitives(root) {
        if let Some((at_surface, surface)) = extension(primitive, HYBRID, &at) {
            check_surface(document, primitive, surface, (&at, &at_surface), findings);
        }
        if let Some((at_khr, khr)) = extension(primitive, KHR_SPLATS, &at)
            && let Some((at, bound)) = extension(khr, HYBRID, &at_khr)
        {
            if let Some(own) = bound.get("binding") {
                binding::check(document, primitive, own, &format!("{at}/binding"), findings);
            }
            fields::check_degree(root, primitive, bound, &at, findings);
        }
    }
    if let Some((at, own)) = extension(root, HYBRID, "") {
        fields::check(document, own, &at, findings);
    }
}

/// Content of a scene's nodes: indices of meshes and of their materials.
#[derive(Default)]
struct Reached {
    meshes: BTreeSet<usize>,
    materials: BTreeSet<usize>,
}

impl Reached {
    fn by(root: &Value, scene: &Value) -> Self {
        let item = |array: &str, i: usize| root.get(array).and_then(|array| array.get(i));
        let indices = |object: &Value, key: &str| -> Vec<usize> {
            let list = object.get(key).and_then(Value::as_array).into_iter().flatten();
            list.filter_map(Value::as_u64).map(|i| i as usize).collect()
        };
        let (mut reached, mut met, mut next) = (Self::default(), HashSet::new(), indices(scene, "nodes"));
        while let Some(i) = next.pop() {
            let Some(node) = item("nodes", i).filter(|_| met.insert(i)) else { continue };
            next.extend(indices(node, "children"));
            reached.meshes.extend(index(node, "mesh"));
        }
        for mesh in reached.meshes.iter().filter_map(|&mesh| item("meshes", mesh)) {
            let materials = objects(mesh, "primitives", "").filter_map(|(_, primitive)| index(primitive, "material"));
            reached.materials.extend(materials);
        }
        reached
    }
}

/// Reports meshes with both splats and other primitives in a scene with a stated composition: some viewers reject the
/// whole file.
fn check_mixed(root: &Value, composed: &BTreeSet<usize>, findings: &mut Findings) {
    for (_, (at, mesh)) in objects(root, "meshes", "").enumerate().filter(|(i, _)| composed.contains(i)) {
        let parts = || objects(mesh, "primitives", &at).map(|(at, p)| extension(p, KHR_SPLATS, &at).is_some());
        if parts().any(|is_splats| is_splats) && !parts().all(|is_splats| is_splats) {
            findings.error("HYBRID_MIXED_MESH", at, "splats and triangles in different meshes", "both");
        }
    }
}

fn check_scene(root: &Value, contract: &Value, reached: &Reached, at: &str, findings: &mut Findings) {
    check_token(contract, "colorSpace", &ColorSpace::ALL.map(ColorSpace::name), "HYBRID_TOKEN", at, findings);
    check_token(contract, "mode", &["stable", "surfaceConsistent", "direct"], "HYBRID_TOKEN", at, findings);
    check_token(contract, "sortKey", &["viewZ"], "HYBRID_TOKEN", at, findings);
    let Some(space) = contract.get("colorSpace").and_then(Value::as_str) else { return };
    let mut demand = |place: &str, object: &Value| {
        if let Some(other) = object.get("colorSpace").and_then(Value::as_str).filter(|&other| other != space) {
            let expected = format!("{space}, as in {at}");
            findings.error("HYBRID_COLOR_SPACE", format!("{place}/colorSpace"), expected, other);
        }
    };
    let (meshes, materials) = (&reached.meshes, &reached.materials);
    for (_, (at, mesh)) in objects(root, "meshes", "").enumerate().filter(|(i, _)| meshes.contains(i)) {
        for (at, primitive) in objects(mesh, "primitives", &at) {
            if let Some((at, khr)) = extension(primitive, KHR_SPLATS, &at) {
                demand(&at, khr);
            }
        }
    }
    for (_, (at, material)) in objects(root, "materials", "").enumerate().filter(|(i, _)| materials.contains(i)) {
        if let Some((at, radiance)) = extension(material, HYBRID, &at) {
            demand(&at, radiance);
        }
    }
}

fn check_material(
    document: &Document<'_>,
    pictures: &mut Pictures<'_>,
    (i, material, shown): (usize, &Value, &Primitives<'_>),
    radiance: &Value,
    at: &str,
    findings: &mut Findings,
) {
    check_token(radiance, "colorSpace", &ColorSpace::ALL.map(ColorSpace::name), "HYBRID_TOKEN", at, findings);
    if let Some(opacity) = radiance.get("opacity") {
        check_token(opacity, "activation", &["none", "logistic"], "HYBRID_TOKEN", &format!("{at}/opacity"), findings);
        check_texels(document, pictures, (opacity, shown), 1, &format!("{at}/opacity"), findings);
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
        check_texels(document, pictures, (source, shown), 3, &at, findings);
    }
    check_sizes(pictures, (radiance.get("opacity"), harmonics), &at, findings);
    check_coordinates(radiance.get("opacity"), harmonics, &at, findings);
}

/// UV mapping of a texel source.
#[derive(PartialEq)]
struct Coordinates {
    set: usize,
    /// Offset, scale and rotation.
    transform: [f64; 5],
}

impl Coordinates {
    fn of(source: &Value) -> Self {
        let texture = source.get("texture").unwrap_or(&Value::Null);
        let transform = extension_of(texture, TEXTURE_TRANSFORM).unwrap_or(&Value::Null);
        let part =
            |key: &str, i: usize, usual: f64| transform.get(key).and_then(|v| v.get(i)?.as_f64()).unwrap_or(usual);
        let rotation = transform.get("rotation").and_then(Value::as_f64).unwrap_or(0.0);
        let set = match source.get("texture") {
            Some(texture) => set_of(texture),
            None => index(source, "texCoord").unwrap_or(0),
        };
        let [offset, scale] = [("offset", 0.0), ("scale", 1.0)].map(|(key, usual)| [0, 1].map(|i| part(key, i, usual)));
        Self { set, transform: [offset[0], offset[1], scale[0], scale[1], rotation] }
    }
}

/// Checks that all sources have the same set of coordinates and the same transform.
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

/// Checks sizes: one for coefficient 0 and the opacity, one for all other coefficients.
fn check_sizes(
    pictures: &mut Pictures<'_>,
    (opacity, harmonics): (Option<&Value>, &Value),
    at: &str,
    findings: &mut Findings,
) {
    let of_opacity = opacity.and_then(|source| pictures.size(source));
    let mut sizes = objects(harmonics, "coefficients", at).map(|(at, source)| (at, pictures.size(source)));
    let Some((at_first, first)) = sizes.next() else { return };
    let mut demand = |at: String, found: Option<(usize, usize)>, expected: Option<(usize, usize)>, like: &str| {
        if let (Some((w, h)), Some((width, height))) = (found, expected)
            && (w, h) != (width, height)
        {
            let expected = format!("{width}×{height}, as in {like}");
            findings.error("HYBRID_MAP_SIZE", at, expected, format!("{w}×{h}"));
        }
    };
    demand(at_first, first, of_opacity, "the opacity");
    if let Some((like, bands)) = sizes.next() {
        sizes.for_each(|(at, found)| demand(at, found, bands, &like));
    }
}

/// Reports properties that apply to a texture or an accessor only, in a texel source that has the other one: viewers
/// ignore them.
fn check_strays(source: &Value, at: &str, findings: &mut Findings) {
    let (form, strays): (&str, &[&str]) = match source.get("texture") {
        Some(_) => ("a texture", &["width", "height", "sampler", "texCoord"]),
        None => ("an accessor", &["channel"]),
    };
    for key in strays.iter().filter(|key| source.get(**key).is_some()) {
        let expected = format!("no `{key}` beside {form}");
        findings.warning("HYBRID_TEXEL_UNUSED", format!("{at}/{key}"), expected, "one, which is passed over");
    }
}

/// Checks a texel source with `channels` values per texel, of a material of these primitives.
fn check_texels(
    document: &Document<'_>,
    pictures: &mut Pictures<'_>,
    (source, shown): (&Value, &Primitives<'_>),
    channels: usize,
    at: &str,
    findings: &mut Findings,
) {
    if source.get("accessor").is_some() == source.get("texture").is_some() {
        // Reported by the schema already; further rules depend on which of both is meant.
        return;
    }
    check_strays(source, at, findings);
    if let Some(loss) = pictures.of(source).and_then(|picture| picture.loss) {
        findings.error("HYBRID_TEXEL_LOSS", format!("{at}/texture"), "a picture without loss, such as PNG", loss);
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
    check_set(Coordinates::of(source).set, shown, "HYBRID_TEXCOORD", at, findings);
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
    let Some(positions) = document.positions(primitive) else { return };
    if let Some(source) = index(surface, "surfaceVertices").and_then(|i| document.elements(i)) {
        check_surface_vertices(&source, &positions, &format!("{at}/surfaceVertices"), findings);
    }
    check_token(surface, "interpolation", &["LINEAR", "STEP"], "HYBRID_TOKEN", at, findings);
    let Some(times) = index(surface, "times").and_then(|i| document.elements(i)) else { return };
    check_times(&times, &format!("{at}/times"), findings);
    if let Some(moved) = index(surface, "translations").and_then(|i| document.elements(i)) {
        let expected = times.count.saturating_mul(positions.count);
        let is_number = moved.kind == Component::Float || document.uses("KHR_mesh_quantization");
        if moved.count != expected || moved.components != 3 || !is_number {
            let expected =
                format!("{expected} elements of 3 components of Float: {} times {}", times.count, positions.count);
            let found = format!("{} of {} of {:?}", moved.count, moved.components, moved.kind);
            findings.error("HYBRID_TRANSLATIONS", format!("{at}/translations"), expected, found);
        }
    }
}

fn check_surface_vertices(source: &Elements<'_>, positions: &Elements<'_>, at: &str, findings: &mut Findings) {
    if !source.is_unsigned() || source.count != positions.count {
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
