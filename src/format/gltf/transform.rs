//! Transforms of nodes, in the capture's frame.

use std::collections::HashSet;

use glam::{DMat4, DQuat, DVec3, DVec4};
use gltf::scene::Transform;

use super::extension::{EXTRAS, ROOT_NODE, VISIBILITY};
use crate::format::error::Fault;
use crate::scene::frame::HALF_TURN;

/// Every visible node reachable from the default scene (else the first), in document order, with its global transform.
/// In files written by Centaur the transform is in the capture's frame, otherwise in glTF's.
pub(in crate::format) fn placements(document: &gltf::Document) -> Result<Vec<(gltf::Node<'_>, DMat4)>, Fault> {
    placements_by(document, local)
}

/// Same as [`placements`], with local transforms given by `local`.
pub(super) fn placements_by<'a>(
    document: &'a gltf::Document,
    local: impl Fn(&gltf::Node<'a>) -> DMat4,
) -> Result<Vec<(gltf::Node<'a>, DMat4)>, Fault> {
    let all = all_placements_by(document, local)?;
    Ok(all.into_iter().filter(|p| p.visibility == Visibility::Shown).map(|p| (p.node, p.transform)).collect())
}

/// Node with its global transform.
pub(super) struct Placed<'a> {
    pub(super) node: gltf::Node<'a>,
    pub(super) transform: DMat4,
    pub(super) visibility: Visibility,
}

/// Visibility of a node.
#[derive(Clone, Copy, PartialEq)]
pub(super) enum Visibility {
    Shown,
    MadeInvisible,
    /// Hidden because an ancestor is invisible.
    Below,
}

/// Same as [`placements_by`], including invisible nodes: visible content may depend on joints among them.
pub(super) fn all_placements_by<'a>(
    document: &'a gltf::Document,
    local: impl Fn(&gltf::Node<'a>) -> DMat4,
) -> Result<Vec<Placed<'a>>, Fault> {
    let Some(scene) = document.default_scene().or_else(|| document.scenes().next()) else { return Ok(vec![]) };
    let nodes: Vec<gltf::Node<'_>> = document.nodes().collect();
    let mut stack: Vec<(usize, DMat4, Visibility)> = vec![];
    let frame = frame_of(document);
    stack.extend(scene.nodes().map(|node| (node.index(), frame, Visibility::Shown)));
    stack.reverse();
    let mut seen = HashSet::new();
    let mut placed = vec![];
    while let Some((index, parent, above)) = stack.pop() {
        if !seen.insert(index) {
            return Err(Fault::pointer(format!("/nodes/{index}"), "a node with one parent", "two paths to it"));
        }
        let node = nodes[index].clone();
        let global = parent * local(&node);
        if !global.is_finite() {
            return Err(Fault::pointer(format!("/nodes/{index}"), "a finite transform", "numbers that are not"));
        }
        let visibility = match above {
            Visibility::Shown if is_invisible(&node) => Visibility::MadeInvisible,
            Visibility::Shown => Visibility::Shown,
            Visibility::MadeInvisible | Visibility::Below => Visibility::Below,
        };
        let children: Vec<usize> = node.children().map(|c| c.index()).collect();
        stack.extend(children.into_iter().rev().map(|c| (c, global, visibility)));
        placed.push(Placed { node, transform: global, visibility });
    }
    Ok(placed)
}

fn is_invisible(node: &gltf::Node<'_>) -> bool {
    node.extension_value(VISIBILITY).and_then(|own| own.get("visible")?.as_bool()) == Some(false)
}

/// From glTF's frame to the one that the scene of a document is read in: the root node of our own files is turned.
pub(super) fn frame_of(document: &gltf::Document) -> DMat4 {
    if is_ours(document) { HALF_TURN } else { DMat4::IDENTITY }
}

/// Whether a document has our root node; then its frame is that of the capture, otherwise glTF's.
pub(in crate::format) fn is_ours(document: &gltf::Document) -> bool {
    document.nodes().any(|node| is_our_root(&node))
}

pub(super) fn is_our_root(node: &gltf::Node<'_>) -> bool {
    let is_marked = |extras: &str| {
        serde_json::from_str::<serde_json::Value>(extras).is_ok_and(|extras| extras.get(EXTRAS).is_some())
    };
    node.name() == Some(ROOT_NODE) && node.extras().as_ref().is_some_and(|extras| is_marked(extras.get()))
}

/// Local transform of a node, relative to its parent.
pub(super) fn local(node: &gltf::Node<'_>) -> DMat4 {
    match node.transform() {
        Transform::Matrix { matrix } => DMat4::from_cols_array_2d(&matrix.map(|column| column.map(f64::from))),
        Transform::Decomposed { translation, rotation, scale } => DMat4::from_scale_rotation_translation(
            DVec3::from(scale.map(f64::from)),
            unit(DVec4::from(rotation.map(f64::from))),
            DVec3::from(translation.map(f64::from)),
        ),
    }
}

/// Rotation of a quaternion of any norm; identity if it is zero.
pub(super) fn unit(q: DVec4) -> DQuat {
    DQuat::from_vec4(q.try_normalize().unwrap_or(DVec4::W))
}
