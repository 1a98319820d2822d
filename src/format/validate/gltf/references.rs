//! Validation of indices that refer to objects in arrays, and of JSON pointers of animations.

use serde_json::Value;

use super::super::Findings;
use super::schema::{escaped, shown};
use crate::format::gltf::extension::{ANIMATION_POINTER, animated_property};

/// Paths of index properties (`*` is any item or property), and the arrays to which they refer.
const REFERENCES: [(&str, &str); 51] = [
    ("scene", "scenes"),
    ("scenes/*/nodes/*", "nodes"),
    ("nodes/*/children/*", "nodes"),
    ("nodes/*/mesh", "meshes"),
    ("nodes/*/camera", "cameras"),
    ("nodes/*/skin", "skins"),
    ("nodes/*/extensions/EXT_mesh_gpu_instancing/attributes/*", "accessors"),
    ("meshes/*/primitives/*/attributes/*", "accessors"),
    ("meshes/*/primitives/*/indices", "accessors"),
    ("meshes/*/primitives/*/targets/*/*", "accessors"),
    ("meshes/*/primitives/*/material", "materials"),
    ("accessors/*/bufferView", "bufferViews"),
    ("accessors/*/sparse/indices/bufferView", "bufferViews"),
    ("accessors/*/sparse/values/bufferView", "bufferViews"),
    ("bufferViews/*/buffer", "buffers"),
    ("textures/*/source", "images"),
    ("textures/*/sampler", "samplers"),
    ("images/*/bufferView", "bufferViews"),
    ("materials/*/pbrMetallicRoughness/baseColorTexture/index", "textures"),
    ("materials/*/pbrMetallicRoughness/metallicRoughnessTexture/index", "textures"),
    ("materials/*/normalTexture/index", "textures"),
    ("materials/*/occlusionTexture/index", "textures"),
    ("materials/*/emissiveTexture/index", "textures"),
    ("materials/*/extensions/KHR_materials_pbrSpecularGlossiness/diffuseTexture/index", "textures"),
    ("materials/*/extensions/KHR_materials_pbrSpecularGlossiness/specularGlossinessTexture/index", "textures"),
    ("skins/*/inverseBindMatrices", "accessors"),
    ("skins/*/skeleton", "nodes"),
    ("skins/*/joints/*", "nodes"),
    ("animations/*/samplers/*/input", "accessors"),
    ("animations/*/samplers/*/output", "accessors"),
    ("animations/*/channels/*/target/node", "nodes"),
    ("materials/*/extensions/EXT_gaussian_splatting_hybrid/opacity/accessor", "accessors"),
    ("materials/*/extensions/EXT_gaussian_splatting_hybrid/opacity/sampler", "samplers"),
    ("materials/*/extensions/EXT_gaussian_splatting_hybrid/opacity/texture/index", "textures"),
    ("materials/*/extensions/EXT_gaussian_splatting_hybrid/sphericalHarmonics/coefficients/*/accessor", "accessors"),
    ("materials/*/extensions/EXT_gaussian_splatting_hybrid/sphericalHarmonics/coefficients/*/sampler", "samplers"),
    (
        "materials/*/extensions/EXT_gaussian_splatting_hybrid/sphericalHarmonics/coefficients/*/texture/index",
        "textures",
    ),
    ("meshes/*/primitives/*/extensions/EXT_gaussian_splatting_hybrid/surfaceVertices", "accessors"),
    ("meshes/*/primitives/*/extensions/EXT_gaussian_splatting_hybrid/times", "accessors"),
    ("meshes/*/primitives/*/extensions/EXT_gaussian_splatting_hybrid/translations", "accessors"),
    ("KHR/binding/node", "nodes"),
    ("KHR/binding/triangles", "accessors"),
    ("KHR/binding/translations", "accessors"),
    ("KHR/binding/rotations", "accessors"),
    ("KHR/binding/scales", "accessors"),
    ("KHR/deformation", "extensions/EXT_gaussian_splatting_hybrid/deformationFields"),
    ("extensions/EXT_gaussian_splatting_hybrid/deformationFields/*/levels/*/planes/*", "accessors"),
    ("extensions/EXT_gaussian_splatting_hybrid/deformationFields/*/trunk/*/weights", "accessors"),
    ("extensions/EXT_gaussian_splatting_hybrid/deformationFields/*/trunk/*/bias", "accessors"),
    ("extensions/EXT_gaussian_splatting_hybrid/deformationFields/*/heads/*/*/weights", "accessors"),
    ("extensions/EXT_gaussian_splatting_hybrid/deformationFields/*/heads/*/*/bias", "accessors"),
];

/// Path for which `KHR/` is an abbreviation.
const KHR: &str = "meshes/*/primitives/*/extensions/KHR_gaussian_splatting/extensions/EXT_gaussian_splatting_hybrid/";

pub(super) fn check(root: &Value, findings: &mut Findings) {
    for (pattern, target) in REFERENCES {
        let pattern = pattern.strip_prefix("KHR/").map_or_else(|| pattern.to_owned(), |rest| format!("{KHR}{rest}"));
        let length = root.pointer(&format!("/{target}")).and_then(Value::as_array).map_or(0, Vec::len);
        let steps: Vec<&str> = pattern.split('/').collect();
        visit(root, &steps, &mut String::new(), &mut |at, value| {
            // Other types are reported by the schema.
            if let Some(index) = value.as_u64()
                && index >= length as u64
            {
                findings.error("INDEX_RANGE", at, format!("an index below {length}, the number of {target}"), index);
            }
        });
    }
    for (at, animation) in super::objects(root, "animations", "") {
        let samplers = super::items(animation, "samplers").len();
        for (at, channel) in super::objects(animation, "channels", &at) {
            if let Some(sampler) = super::index(channel, "sampler").filter(|&s| s >= samplers) {
                let expected = format!("an index below {samplers}, the number of samplers of the animation");
                findings.error("INDEX_RANGE", format!("{at}/sampler"), expected, sampler);
            }
            if let Some(pointer) = animated_property(channel).filter(|pointer| !is_defined(root, pointer)) {
                let at = format!("{at}/target/extensions/{ANIMATION_POINTER}/pointer");
                let expected = "a property of an object of the document";
                findings.error("ANIMATION_POINTER", at, expected, shown(&pointer.into()));
            }
        }
    }
}

/// Whether an animated property, or an element of one, is there, or its object is there and it may have a default.
fn is_defined(root: &Value, pointer: &str) -> bool {
    let Some((above, last)) = pointer.rsplit_once('/') else { return false };
    match root.pointer(above) {
        Some(Value::Object(object)) => object.contains_key(last) || may_have_default(above, last),
        // Elements are numbers, as in `weights`: what has objects is no property.
        Some(Value::Array(elements)) => {
            last.parse::<usize>().ok().and_then(|i| elements.get(i)).is_some_and(Value::is_number)
        }
        Some(_) => false,
        // An element of a property that is absent. Only objects in arrays have such, not the document.
        None => above.rsplit_once('/').is_some_and(|(owner, _)| {
            is_index(last) && owner.split('/').any(is_index) && root.pointer(owner).is_some_and(Value::is_object)
        }),
    }
}

/// Whether a property of the object at `above` may have a default; of core glTF, two of perspective cameras have none.
fn may_have_default(above: &str, property: &str) -> bool {
    let camera = above.strip_prefix("/cameras/").and_then(|below| below.strip_suffix("/perspective"));
    !(camera.is_some_and(is_index) && ["aspectRatio", "zfar"].contains(&property))
}

fn is_index(token: &str) -> bool {
    token.parse::<usize>().is_ok()
}

fn visit(value: &Value, steps: &[&str], at: &mut String, found: &mut impl FnMut(&str, &Value)) {
    let Some((step, rest)) = steps.split_first() else { return found(at, value) };
    let mut descend = |key: &str, inner: &Value| {
        let length = at.len();
        at.push('/');
        at.push_str(key);
        visit(inner, rest, at, found);
        at.truncate(length);
    };
    match value {
        Value::Array(items) if *step == "*" => {
            items.iter().enumerate().for_each(|(i, item)| descend(&i.to_string(), item));
        }
        Value::Object(object) if *step == "*" => {
            object.iter().for_each(|(key, inner)| descend(&escaped(key), inner));
        }
        Value::Object(object) => {
            if let Some(inner) = object.get(*step) {
                descend(step, inner);
            }
        }
        _ => {}
    }
}
