//! Conversion of an opened asset to a hybrid scene.

use glam::DMat4;
use serde_json::Value;

use super::extension::{
    BindingObject, HYBRID, KHR_SPLATS, SPZ, SceneContract, SplatExtension, extension_of, parse_color_space,
};
use super::instancing::{Single, copies};
use super::lift::{Asset, has_scenes};
use super::meshes::{Finished, Meshes};
use super::motion::Motion;
use super::moving::Moving;
use super::transform::{Visibility, all_placements_by, is_ours, local, placements};
use super::{binding, camera, splats};
use crate::format::activation::layers;
use crate::format::content::Content;
use crate::format::error::{Fault, from_value};
use crate::format::notes::Notes;
use crate::format::placed::{NOT_DRAWN, is_flat, join};
use crate::scene::rig::{Anchor, AttachedSplats, HIDDEN, Rig};
use crate::scene::{ColorSpace, Composition, HybridScene, SplatArrays, sh};

/// Scene in the rest pose.
pub(in crate::format) fn scene(asset: &Asset) -> Result<Content, Fault> {
    scene_and_motion(asset, &[]).map(|(content, _)| content)
}

/// A scene as it rests, and what moves it: these of its animations, see [`super::super::ReadOptions::animations`].
pub(super) fn scene_and_motion(asset: &Asset, animations: &[String]) -> Result<(Content, Moving), Fault> {
    asset.check_required()?;
    let (mut said, mut notes) = (Notes::default(), vec![]);
    notes.extend(asset.unshown().map(|name| format!("/extensionsRequired: {name} is not shown")));
    let (mut composition, is_stated) = composition(asset, &mut notes)?;
    let space = composition.color_space;
    let motion = Motion::chosen(asset, animations)?;
    notes.extend(motion.notes());
    let stated_layers = is_stated.then_some(composition.layers);
    let mut meshes = Meshes::new(asset, &motion, space, stated_layers)?;
    let mut hung = vec![];
    let placed = placements(&asset.document)?;
    notes.extend(not_placed(asset)?);
    let single = Single::of(&asset.root);
    for (node, transform) in &placed {
        let at_node = format!("/nodes/{}", node.index());
        let copies = copies(asset, &single, node, &mut notes)?;
        for primitive in node.mesh().iter().flat_map(gltf::Mesh::primitives) {
            let id = (node.mesh().map_or(0, |m| m.index()), primitive.index());
            let at = format!("/meshes/{}/primitives/{}", id.0, id.1);
            let khr = extension_of(&asset.root["meshes"][id.0]["primitives"][id.1], KHR_SPLATS);
            let is_spz = khr.is_some_and(|khr| extension_of(khr, SPZ).is_some());
            if !asset.has_positions(id) && !is_spz {
                notes.push(format!("{at}: left out: it has no POSITION"));
            } else if let Some(khr) = khr {
                let stored = splats::read(asset, id, &primitive, khr, (space, is_stated), &mut notes)?;
                // What rests under a flat transform is held without it, for poses in which it is not flat, or for
                // triangles, which replace it.
                let is_held = is_flat(*transform) && (meshes.moves(node.index()) || binding::is_bound(khr, id)?);
                let above = if is_held { DMat4::IDENTITY } else { *transform };
                let (transforms, note) = drawn(above, copies.as_deref());
                notes.extend(note.map(|note| format!("{at_node}: {note}")));
                // The last instance takes the splats that were read, without a copy.
                for (stored, transform) in std::iter::repeat_n(stored, transforms.len()).zip(transforms) {
                    let part = stored.placed(transform);
                    asset.spend(bytes_of(&part), &at_node)?;
                    hung.push(Hung { part, is_held, node: node.index(), transform, id, khr });
                }
            } else if !meshes.add((node, *transform), copies.as_deref(), &primitive, &mut notes)? {
                notes.push(format!("{at_node}: a primitive that is neither triangles nor splats is left out"));
            }
            said.take(&mut notes);
        }
    }
    let mut read = meshes.finish(&mut notes)?;
    let mut attached: Vec<AttachedSplats> = vec![];
    let (mut parts, mut count) = (vec![], 0);
    for hung in hung {
        let at = format!("/meshes/{}/primitives/{}", hung.id.0, hung.id.1);
        if let Some((part, attachment)) = hung.attached(asset, &mut read, count, &mut notes)? {
            count += part.means.len();
            attached.extend(attachment);
            parts.push((at, part));
        }
        said.take(&mut notes);
    }
    let Finished { meshes, mut rest_surfaces, mut poses, .. } = read;
    poses.compact(&mut rest_surfaces, &mut attached);
    let cameras = camera::all(&asset.document, &placed, &mut notes);
    said.take(&mut notes);
    if !is_stated {
        composition.layers = layers(&meshes);
    }
    let scene = HybridScene { splats: join(parts)?, meshes, composition };
    let moves = !attached.is_empty() || rest_surfaces.iter().any(Option::is_some);
    let rig = if moves {
        Some(Rig::new(rest_surfaces, attached, poses.rest().clone(), poses.names(&asset.document))?)
    } else {
        None
    };
    let moving = Moving::new(asset.document.clone(), motion, rig.map(|rig| (poses, rig)));
    let y_up = !is_ours(&asset.document);
    let notes = said.into_lines();
    Ok((Content { scene, states_composition: is_stated, cameras, notes, y_up, record: None }, moving))
}

/// Transforms of the instances of splats below `above`, without flat ones, of which there is a note.
fn drawn(above: DMat4, copies: Option<&[DMat4]>) -> (Vec<DMat4>, Option<&'static str>) {
    let mut transforms: Vec<DMat4> = match copies {
        Some(copies) => copies.iter().map(|local| above * *local).collect(),
        None => vec![above],
    };
    let all = transforms.len();
    transforms.retain(|transform| !is_flat(*transform));
    let note = (transforms.len() < all).then_some(NOT_DRAWN);
    (transforms, note)
}

/// What is added to [`NOT_DRAWN`] where other poses may show them.
const IN_REST: &str = " in the rest pose";

/// Splats of a primitive at a node.
struct Hung<'a> {
    part: SplatArrays,
    /// Whether they are held without the transform of the node, because that is flat.
    is_held: bool,
    node: usize,
    /// Transform under which they are held.
    transform: DMat4,
    /// Primitive (mesh, index in the mesh), and its `KHR_gaussian_splatting`.
    id: (usize, usize),
    khr: &'a Value,
}

impl Hung<'_> {
    /// The splats, of which `first` is the index in the scene, and their attachment, `None` if they are static; nothing
    /// if no pose shows them.
    fn attached(
        self,
        asset: &Asset,
        read: &mut Finished,
        first: usize,
        notes: &mut Vec<String>,
    ) -> Result<Option<(SplatArrays, Option<AttachedSplats>)>, Fault> {
        let Self { mut part, is_held, node, transform, id, khr } = self;
        let splats = first..first + part.means.len();
        let object = binding::object(khr, id)?;
        let moves = read.poses.moves(node);
        if let Some((at, SplatExtension { deformation: Some(_), .. })) = &object {
            notes.push(format!("{at}/deformation: not played: its splats are shown undeformed"));
        }
        if let Some((at, SplatExtension { binding: Some(object), .. })) = &object {
            let to = read.bindable.get(&(object.node, object.primitive));
            let bound = to.ok_or_else(|| {
                let BindingObject { node, primitive, .. } = object;
                format!("expected triangles at node {node}, primitive {primitive}, of mode 4, found none in the scene")
            });
            // Read even for static content, so that faults are reported.
            match bound.and_then(|to| {
                let binding = binding::read(asset, object, splats.len(), to, read.poses.bone(node), transform)?;
                Ok((binding, to.moves || moves))
            }) {
                Ok((mut binding, moves)) => {
                    let mesh = &read.meshes[binding.surface];
                    let hidden = if is_held { binding.settle(&mut part, mesh) } else { None };
                    if hidden.is_some() {
                        notes.push(format!("/nodes/{node}: {NOT_DRAWN}{}", if moves { IN_REST } else { "" }));
                    }
                    if hidden.is_some() && !moves && part.opacity_logits.iter().all(|logit| *logit == HIDDEN) {
                        return Ok(None);
                    }
                    let anchor = Anchor::Triangles(binding);
                    return Ok(Some((part, moves.then_some(AttachedSplats { splats, anchor, hidden }))));
                }
                Err(reason) => notes.push(format!("{at}/binding: ignored: {reason}")),
            }
        }
        if is_held && !moves {
            notes.push(format!("/nodes/{node}: {NOT_DRAWN}"));
            return Ok(None);
        }
        let hidden = is_held.then(|| {
            notes.push(format!("/nodes/{node}: {NOT_DRAWN}{IN_REST}"));
            std::mem::replace(&mut part.opacity_logits, vec![HIDDEN; splats.len()])
        });
        let attachment = moves.then(|| AttachedSplats { splats, anchor: Anchor::Bone(read.poses.bone(node)), hidden });
        Ok(Some((part, attachment)))
    }
}

/// Bytes of a part besides its splats: its name, transform and attachment.
const BYTES_OF_PART: u64 = 512;

fn bytes_of(part: &SplatArrays) -> u64 {
    BYTES_OF_PART + part.means.len() as u64 * (44 + 12 * sh::coefficients(sh::MAX_DEGREE) as u64)
}

/// The nearest `znear` of all cameras, each of which has its own by the extension; that of a scene without cameras
/// otherwise.
fn least_near(document: &gltf::Document) -> f32 {
    // Read from JSON, because the crate panics if the object named by `type` is missing.
    let perspectives = document.as_json().cameras.iter().filter_map(|camera| camera.perspective.as_ref());
    let nears = perspectives.map(|p| p.znear).filter(|znear| *znear > 0.0 && znear.is_finite());
    nears.reduce(f32::min).unwrap_or(Composition::default().near)
}

/// Notes on nodes that are not in the scene, or only by assumption.
pub(in crate::format) fn not_placed(asset: &Asset) -> Result<Vec<String>, Fault> {
    let mut notes = vec![];
    if asset.document.nodes().len() > 0 && !has_scenes(&asset.root) {
        notes.push("/scenes: there are none, so all nodes are shown".to_owned());
    }
    let all = all_placements_by(&asset.document, local)?;
    match all.iter().filter(|placed| placed.visibility == Visibility::MadeInvisible).count() {
        0 => {}
        1 => notes.push("1 node left out because invisible, with all below".to_owned()),
        n => notes.push(format!("{n} nodes left out because invisible, with all below")),
    }
    Ok(notes)
}

/// Composition stated by the scene, with true; otherwise defaults in the colour space of the first splat primitive,
/// with false.
fn composition(asset: &Asset, notes: &mut Vec<String>) -> Result<(Composition, bool), Fault> {
    let document = &asset.document;
    if let Some(scene) = document.default_scene().or_else(|| document.scenes().next())
        && let Some(value) = scene.extension_value(HYBRID)
    {
        let at = format!("/scenes/{}/extensions/{HYBRID}", scene.index());
        let contract: SceneContract = from_value(value, &at, &format!("a scene of {HYBRID}"))?;
        return Ok((contract.composition(&at, least_near(document), notes)?, true));
    }
    let mut primitives = document.meshes().flat_map(|m| m.primitives().map(move |p| (m.index(), p)));
    let first = primitives.find_map(|(mesh, p)| {
        let token = p.extension_value(KHR_SPLATS)?.get("colorSpace").and_then(Value::as_str)?.to_owned();
        Some((format!("/meshes/{mesh}/primitives/{}/extensions/{KHR_SPLATS}", p.index()), token))
    });
    let color_space = first.map_or(Ok(ColorSpace::default()), |(at, token)| parse_color_space(&token, &at))?;
    Ok((Composition { color_space, ..Composition::default() }, false))
}
