//! From an opened asset to a hybrid scene.

use serde_json::Value;

use super::camera;
use super::extension::{HYBRID, KHR_SPLATS, SceneContract, parse_color_space};
use super::lift::Asset;
use super::meshes::Meshes;
use super::splats;
use super::transform::{is_ours, placements};
use crate::format::SceneFile;
use crate::format::error::{Fault, from_value};
use crate::format::placed::join;
use crate::scene::{ColorSpace, Composition, HybridScene, sh};

/// Bytes of geometry that a byte of the file may become, above what any small file may. Meshes at many nodes and accessors
/// in many meshes multiply it; real files stay far below.
const MAX_RATIO: u64 = 512;
const ALWAYS: u64 = 1 << 26;

pub(in crate::format) fn scene(asset: &Asset) -> Result<SceneFile, Fault> {
    asset.check_required()?;
    let mut notes = vec![];
    let composition = composition(asset)?;
    let space = composition.color_space;
    let (mut parts, mut meshes, mut cameras) = (vec![], Meshes::new(asset, space)?, vec![]);
    let stored: usize = asset.buffers.iter().chain(asset.plain_views.values()).map(Vec::len).sum();
    let most = (stored + asset.json_bytes) as u64 * MAX_RATIO + ALWAYS;
    let mut bytes = 0u64;
    for (node, transform) in placements(&asset.document)? {
        let at_node = format!("/nodes/{}", node.index());
        for primitive in node.mesh().iter().flat_map(gltf::Mesh::primitives) {
            let mesh = node.mesh().map_or(0, |m| m.index());
            if let Some(khr) = primitive.extension_value(KHR_SPLATS) {
                let id = (mesh, primitive.index());
                let part = splats::read(asset, id, &primitive, khr, (node.index(), transform), space, &mut notes)?;
                bytes =
                    bytes.saturating_add(part.means.len() as u64 * (44 + 12 * sh::coefficients(sh::MAX_DEGREE) as u64));
                parts.push((format!("/meshes/{mesh}/primitives/{}", id.1), part));
            } else if let Some(added) = meshes.add((&node, transform), &primitive, &mut notes)? {
                bytes = bytes.saturating_add(added);
            } else {
                notes.push(format!("{at_node}: a primitive that is neither triangles nor splats is left out"));
            }
            if bytes > most {
                let expected = format!("a scene of at most {most} bytes from a file of this size");
                return Err(Fault::pointer(at_node, expected, "more, by repeated use of meshes"));
            }
        }
        if let Some(camera) = node.camera() {
            let name = node.name().or(camera.name()).map_or_else(|| format!("camera_{}", cameras.len()), str::to_owned);
            match camera::read(asset, camera.index(), transform) {
                Ok((camera, None)) => cameras.push((name, camera)),
                Ok((camera, Some(note))) => {
                    notes.push(format!("{at_node}: {note}"));
                    cameras.push((name, camera));
                }
                Err(reason) => notes.push(format!("{at_node}: camera left out: {reason}")),
            }
        }
    }
    let meshes = meshes.finish(&mut notes)?;
    let scene = HybridScene { splats: join(parts)?, meshes, composition };
    Ok(SceneFile {
        scene,
        cameras,
        notes,
        y_up: !is_ours(&asset.document),
        attributes: vec![],
        dropped: 0,
        source: None,
    })
}

/// The nearest `znear` of all cameras, each of which has its own by the extension; that of a scene without cameras otherwise.
fn least_near(document: &gltf::Document) -> f32 {
    let znear = |camera: gltf::Camera<'_>| match camera.projection() {
        gltf::camera::Projection::Perspective(p) if p.znear() > 0.0 && p.znear().is_finite() => Some(p.znear()),
        _ => None,
    };
    document.cameras().filter_map(znear).reduce(f32::min).unwrap_or(Composition::default().near)
}

/// The scene's contract; without one, defaults in the colour space of the first splat primitive.
fn composition(asset: &Asset) -> Result<Composition, Fault> {
    let document = &asset.document;
    if let Some(scene) = document.default_scene().or_else(|| document.scenes().next())
        && let Some(value) = scene.extension_value(HYBRID)
    {
        let at = format!("/scenes/{}/extensions/{HYBRID}", scene.index());
        let contract: SceneContract = from_value(value, &at, &format!("a scene of {HYBRID}"))?;
        return contract.composition(&at, least_near(document));
    }
    let mut primitives = document.meshes().flat_map(|m| m.primitives().map(move |p| (m.index(), p)));
    let first = primitives.find_map(|(mesh, p)| {
        let token = p.extension_value(KHR_SPLATS)?.get("colorSpace").and_then(Value::as_str)?.to_owned();
        Some((format!("/meshes/{mesh}/primitives/{}/extensions/{KHR_SPLATS}", p.index()), token))
    });
    let color_space = first.map_or(Ok(ColorSpace::default()), |(at, token)| parse_color_space(&token, &at))?;
    Ok(Composition { color_space, ..Composition::default() })
}
