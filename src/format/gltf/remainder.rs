//! Parts of a document that a scene does not hold, in words.

use std::collections::BTreeSet;
use std::fmt;

use serde_json::Value;

use super::extension::{
    ANIMATION_POINTER, DRAFT_ROTATION, DRAFT_SCALE, EMISSIVE_STRENGTH, EXTRAS, HYBRID, INSTANCING, KHR_SPLATS,
    MOVED_NODE, ROTATION, SCALE, SPECULAR_GLOSSINESS, SPZ, TEXTURE_TRANSFORM, UNLIT, WEBP, extension_of,
};
use super::json::{index, items, primitives, strings};
use super::{instancing, meshopt};

/// Part of a document that a scene does not hold.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Remnant {
    /// Description: `2 animations`.
    pub what: String,
    /// Relation of the part to animation.
    pub role: Role,
}

/// Relation of a part to animation.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Role {
    /// Animates something: animations.
    Moves,
    /// Defines how something follows: skins, morph targets, bindings.
    Follows,
    /// Animation that is not played here: of properties other than nodes', or by deformation fields.
    Unplayed,
    /// Unrelated to animation.
    Rests,
}

impl Remnant {
    fn still(what: String) -> Self {
        Self { what, role: Role::Rests }
    }
}

impl fmt::Display for Remnant {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.what)
    }
}

/// Everything that a scene written anew would lack. `is_ours`: whether Centaur wrote the tree of nodes.
pub(super) fn remainder(root: &Value, is_ours: bool) -> Vec<Remnant> {
    let mut found = vec![];
    let mut count = |n: usize, what: &str, role: Role| {
        if n > 0 {
            found.push(Remnant { what: format!("{n} {what}{}", if n == 1 { "" } else { "s" }), role });
        }
    };
    let list = |key: &str| items(root, key);
    let primitives = || primitives(root).map(|(_, primitive)| primitive);
    count(list("animations").len(), "animation", Role::Moves);
    count(list("skins").len(), "skin", Role::Follows);
    count(list("scenes").len().saturating_sub(1), "further scene", Role::Rests);
    count(primitives().map(|p| items(p, "targets").len()).max().unwrap_or(0), "morph target", Role::Follows);
    let is_orthographic = |c: &&Value| c.get("type").and_then(Value::as_str) == Some("orthographic");
    count(list("cameras").iter().filter(is_orthographic).count(), "orthographic camera", Role::Rests);
    let nodes = list("nodes");
    // Nodes inserted above a scene to transform it become part of its coordinates.
    let has_children =
        |n: &&Value| !items(n, "children").is_empty() && n.get("name").and_then(Value::as_str) != Some(MOVED_NODE);
    if nodes.iter().filter(has_children).count() > usize::from(is_ours) {
        found.push(Remnant::still(format!("the tree of {} nodes", nodes.len())));
    }
    if primitives().any(|p| khr_extension(p, HYBRID)) {
        found.push(Remnant { what: "bindings of splats".to_owned(), role: Role::Follows });
    }
    if extension_of(root, HYBRID).is_some() {
        found.push(Remnant { what: "deformation fields".to_owned(), role: Role::Unplayed });
    }
    let materials = list("materials");
    let material_of = |p: &Value| materials.get(index(p, "material")?);
    let others: BTreeSet<&str> = primitives().flat_map(|p| other_attributes(p, &Shown::of(material_of(p)))).collect();
    if !others.is_empty() {
        let names: Vec<&str> = others.into_iter().collect();
        found.push(Remnant::still(format!("the attributes {}", names.join(", "))));
    }
    if materials.iter().any(has_other_textures) {
        found.push(Remnant::still("textures for shading".to_owned()));
    }
    let is_in_part = instancing::is_in_part(root);
    let is_taken_over = |name: &str| is_taken_over(name) || name == INSTANCING && !is_in_part;
    for name in strings(root, "extensionsUsed").filter(|name| !is_taken_over(name)) {
        let role = if name == ANIMATION_POINTER { Role::Unplayed } else { Role::Rests };
        found.push(Remnant { what: format!("the extension {name}"), role });
    }
    let of_parts = ["nodes", "meshes", "materials", "cameras", "accessors", "textures", "images"];
    if of_parts.iter().any(|key| list(key).iter().any(has_extras)) || primitives().any(has_extras) {
        found.push(Remnant::still("extras".to_owned()));
    }
    found
}

fn khr_extension(primitive: &Value, name: &str) -> bool {
    extension_of(primitive, KHR_SPLATS).is_some_and(|khr| extension_of(khr, name).is_some())
}

/// Parts of a material that a scene takes, as in `material::maps`.
struct Shown {
    /// Index n of `TEXCOORD_n`.
    set: u64,
    /// Whether vertex colours are used.
    colors: bool,
    /// Whether emission is used in place of the base colour.
    emission: bool,
}

impl Shown {
    fn of(material: Option<&Value>) -> Self {
        let Some(material) = material else { return Self { set: 0, colors: true, emission: false } };
        if let Some(source) = extension_of(material, HYBRID).and_then(first_source) {
            let set = set_of(source.get("texture").unwrap_or(source));
            return Self { set, colors: false, emission: false };
        }
        let (_, base) = base_of(material);
        if !is_shown_by_emission(material) {
            // Vertex colours that cannot be shown together with an image are noted where they are read.
            return Self { set: base.map_or(0, set_of), colors: true, emission: false };
        }
        let has_alpha = material.get("alphaMode").is_some_and(|mode| mode != "OPAQUE");
        let picture = material.get("emissiveTexture").or(base.filter(|_| has_alpha));
        Self { set: picture.map_or(0, set_of), colors: false, emission: true }
    }
}

/// Texel source of coefficient 0, whose UV mapping all sources of a material share; `None` if the core material is
/// shown instead.
fn first_source(radiance: &Value) -> Option<&Value> {
    let harmonics = radiance.get("sphericalHarmonics")?;
    let is_one_of = |token: Option<&Value>, known: [&str; 2]| {
        token.is_none_or(|token| token.as_str().is_some_and(|token| known.contains(&token)))
    };
    let is_known = is_one_of(harmonics.get("frame"), ["node", "triangle"])
        && is_one_of(radiance.pointer("/opacity/activation"), ["none", "logistic"]);
    harmonics.get("coefficients")?.get(0).filter(|_| is_known)
}

/// Index n of the `TEXCOORD_n` used by a texture or a texel source.
fn set_of(texture: &Value) -> u64 {
    let moved = extension_of(texture, TEXTURE_TRANSFORM).and_then(|transform| transform.get("texCoord"));
    moved.or(texture.get("texCoord")).and_then(Value::as_u64).unwrap_or(0)
}

/// Factor and texture of a material's base colour, see `material::Base`.
fn base_of(material: &Value) -> (Option<&Value>, Option<&Value>) {
    match extension_of(material, SPECULAR_GLOSSINESS) {
        Some(own) => (own.get("diffuseFactor"), own.get("diffuseTexture")),
        None => {
            let of_core = |key: &str| material.get("pbrMetallicRoughness").and_then(|pbr| pbr.get(key));
            (of_core("baseColorFactor"), of_core("baseColorTexture"))
        }
    }
}

/// Whether a core material is shown by its emission: its base colour is black, or its only image is that of the
/// emission.
fn is_shown_by_emission(material: &Value) -> bool {
    let is_positive = |value: &Value| value.as_f64().is_some_and(|value| value > 0.0);
    let strength = extension_of(material, EMISSIVE_STRENGTH).and_then(|own| own.get("emissiveStrength"));
    let emits = items(material, "emissiveFactor").iter().any(is_positive) && strength.is_none_or(is_positive);
    let (color, picture) = base_of(material);
    let color = color.and_then(Value::as_array).map_or(&[][..], Vec::as_slice);
    let is_black = color.len() > 3 && !color[..3].iter().any(is_positive);
    let is_only_picture = material.get("emissiveTexture").is_some() && picture.is_none();
    emits && (is_black || is_only_picture) && extension_of(material, UNLIT).is_none()
}

/// Whether a material has core textures besides the one shown.
fn has_other_textures(material: &Value) -> bool {
    let others = ["/normalTexture", "/occlusionTexture", "/pbrMetallicRoughness/metallicRoughnessTexture"];
    let is_specular =
        extension_of(material, SPECULAR_GLOSSINESS).is_some_and(|own| own.get("specularGlossinessTexture").is_some());
    let is_emission_left = material.get("emissiveTexture").is_some() && !Shown::of(Some(material)).emission;
    is_emission_left || is_specular || others.iter().any(|at| material.pointer(at).is_some())
}

/// Attributes of a primitive that a scene does not hold.
fn other_attributes<'a>(primitive: &'a Value, shown: &Shown) -> Vec<&'a str> {
    let Some(attributes) = primitive.get("attributes").and_then(Value::as_object) else { return vec![] };
    let khr = extension_of(primitive, KHR_SPLATS);
    // Draft names are read where the current ones are missing and no SPZ replaces the attributes.
    let of_draft = khr.is_some_and(is_draft) && !khr_extension(primitive, SPZ);
    let is_read = |name: &str| match name {
        DRAFT_ROTATION => of_draft && !attributes.contains_key(ROTATION),
        DRAFT_SCALE => of_draft && !attributes.contains_key(SCALE),
        "COLOR_0" => khr.is_some() || shown.colors,
        _ => match name.strip_prefix("TEXCOORD_") {
            Some(set) => khr.is_none() && set.parse::<u64>().is_ok_and(|set| set == shown.set),
            None => is_held(name),
        },
    };
    attributes.keys().map(String::as_str).filter(|name| !is_read(name)).collect()
}

/// Whether splats follow an early draft of the extension, which had neither `kernel` nor `colorSpace`.
fn is_draft(khr: &Value) -> bool {
    ["kernel", "colorSpace"].iter().all(|key| khr.get(key).is_none_or(Value::is_null))
}

/// Whether a scene holds the values of a vertex attribute, regardless of the material. Joints and weights are counted
/// with the skins.
fn is_held(name: &str) -> bool {
    let prefixes = ["JOINTS_", "WEIGHTS_", "KHR_gaussian_splatting:"];
    name == "POSITION" || prefixes.iter().any(|prefix| name.starts_with(prefix))
}

/// Whether an extension is written anew, or encodes in another way data that a scene holds.
fn is_taken_over(name: &str) -> bool {
    let known = [KHR_SPLATS, HYBRID, UNLIT, SPZ, TEXTURE_TRANSFORM, WEBP, SPECULAR_GLOSSINESS, "KHR_mesh_quantization"];
    known.contains(&name) || meshopt::NAMES.contains(&name)
}

/// Whether an object has extras besides our own, which are written anew.
pub(super) fn has_extras(object: &Value) -> bool {
    match object.get("extras") {
        None => false,
        Some(Value::Object(extras)) => extras.keys().any(|key| key != EXTRAS),
        Some(_) => true,
    }
}
