//! From an opened asset to a hybrid scene.

use std::ops::Range;

use glam::DMat4;
use serde_json::Value;

use super::extension::{BindingObject, HYBRID, KHR_SPLATS, SceneContract, SplatExtension, parse_color_space};
use super::lift::Asset;
use super::meshes::{Finished, Meshes};
use super::motion::Motion;
use super::moving::Moving;
use super::transform::{is_ours, placements};
use super::{binding, camera, splats};
use crate::format::SceneFile;
use crate::format::error::{Fault, from_value};
use crate::format::placed::join;
use crate::scene::rig::{Followers, Leader, Rig};
use crate::scene::{Camera, ColorSpace, Composition, HybridScene, SplatArrays, sh};

/// Bytes of geometry that a byte of the file may become, above what any small file may. Meshes at many nodes and accessors
/// in many meshes multiply it; real files stay far below.
const MAX_RATIO: u64 = 512;
const ALWAYS: u64 = 1 << 26;

/// A scene as it rests.
pub(in crate::format) fn scene(asset: &Asset) -> Result<SceneFile, Fault> {
    scene_and_motion(asset).map(|(file, _)| file)
}

/// Cameras with their names.
type Cameras = Vec<(String, Camera)>;

/// A scene as it rests, and what moves it.
pub(super) fn scene_and_motion(asset: &Asset) -> Result<(SceneFile, Moving), Fault> {
    asset.check_required()?;
    let mut notes = vec![];
    let composition = composition(asset)?;
    let space = composition.color_space;
    let motion = Motion::read(asset)?;
    let (mut parts, mut meshes, mut hung) = (vec![], Meshes::new(asset, &motion, space)?, vec![]);
    let stored = asset.stored_bytes();
    let most = (stored + asset.json_bytes) as u64 * MAX_RATIO + ALWAYS;
    let (mut bytes, mut count) = (0u64, 0);
    let placed = placements(&asset.document)?;
    for (node, transform) in &placed {
        let at_node = format!("/nodes/{}", node.index());
        for primitive in node.mesh().iter().flat_map(gltf::Mesh::primitives) {
            let mesh = node.mesh().map_or(0, |m| m.index());
            if let Some(khr) = primitive.extension_value(KHR_SPLATS) {
                let id = (mesh, primitive.index());
                let part = splats::read(asset, id, &primitive, khr, (node.index(), *transform), space, &mut notes)?;
                bytes = bytes.saturating_add(bytes_of(&part));
                let these = count..count + part.means.len();
                count = these.end;
                let object = binding::object(khr, id)?;
                hung.push(Hung { splats: these, node: node.index(), transform: *transform, object });
                parts.push((format!("/meshes/{mesh}/primitives/{}", id.1), part));
            } else if let Some(added) = meshes.add((node, *transform), &primitive, &mut notes)? {
                bytes = bytes.saturating_add(added);
            } else {
                notes.push(format!("{at_node}: a primitive that is neither triangles nor splats is left out"));
            }
            if bytes > most {
                let expected = format!("a scene of at most {most} bytes from a file of this size");
                return Err(Fault::pointer(at_node, expected, "more, by repeated use of meshes"));
            }
        }
    }
    let bones: Vec<usize> = hung.iter().map(|hung| meshes.bone(hung.node)).collect();
    let finished = meshes.finish(&mut notes)?;
    let followers: Vec<Followers> = hung
        .into_iter()
        .zip(bones)
        .filter_map(|(hung, bone)| hung.follows(asset, &finished, bone, &mut notes))
        .collect();
    let Finished { meshes, forms, poses, .. } = finished;
    let cameras = cameras(&asset.document, &placed, &mut notes);
    let scene = HybridScene { splats: join(parts)?, meshes, composition };
    let moves = !followers.is_empty() || forms.iter().any(Option::is_some);
    let rig = if moves { Some(Rig::new(forms, followers, poses.rest().clone())?) } else { None };
    let moving = Moving::new(asset.document.clone(), motion, rig.map(|rig| (poses, rig)));
    let y_up = !is_ours(&asset.document);
    Ok((SceneFile { scene, cameras, notes, y_up, attributes: vec![], dropped: 0, source: None }, moving))
}

/// Splats of a primitive at a node.
struct Hung {
    splats: Range<usize>,
    node: usize,
    transform: DMat4,
    object: Option<(String, SplatExtension)>,
}

impl Hung {
    /// What they follow; `None` if they keep still.
    fn follows(self, asset: &Asset, read: &Finished, bone: usize, notes: &mut Vec<String>) -> Option<Followers> {
        let Self { splats, node, transform, object } = self;
        if let Some((at, SplatExtension { binding: Some(object), .. })) = &object {
            let BindingObject { node, primitive, .. } = *object;
            let bound = match read.bindable.get(&(node, primitive)) {
                Some(to) if !to.moves => return None,
                Some(to) => binding::read(asset, object, splats.len(), to, bone, transform),
                None => {
                    Err(format!("expected triangles at node {node}, primitive {primitive}, found none in the scene"))
                }
            };
            match bound {
                Ok(binding) => return Some(Followers { splats, leader: Leader::Triangles(binding) }),
                Err(reason) => notes.push(format!("{at}/binding: ignored: {reason}")),
            }
        }
        read.poses.moves(node).then_some(Followers { splats, leader: Leader::Bone(bone) })
    }
}

fn bytes_of(part: &SplatArrays) -> u64 {
    part.means.len() as u64 * (44 + 12 * sh::coefficients(sh::MAX_DEGREE) as u64)
}

pub(super) fn cameras(
    document: &gltf::Document,
    placed: &[(gltf::Node<'_>, DMat4)],
    notes: &mut Vec<String>,
) -> Cameras {
    let mut cameras = vec![];
    for (node, transform) in placed {
        let Some(optics) = node.camera() else { continue };
        let name = node.name().or(optics.name()).map_or_else(|| format!("camera_{}", cameras.len()), str::to_owned);
        match camera::read(document, optics.index(), *transform) {
            Ok((camera, note)) => {
                notes.extend(note.map(|note| format!("/nodes/{}: {note}", node.index())));
                cameras.push((name, camera));
            }
            Err(reason) => notes.push(format!("/nodes/{}: camera left out: {reason}", node.index())),
        }
    }
    cameras
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
