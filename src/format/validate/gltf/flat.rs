//! Validation of transforms above splats: below flat ones, which have no inverse, splats are not drawn unless they are
//! bound to triangles.

use std::collections::HashSet;

use glam::{DMat4, DQuat, DVec3, DVec4};
use serde_json::Value;

use super::super::{Findings, Offenders};
use super::document::Document;
use super::scenes::{children, numbers};
use super::{extension, index, objects};
use crate::format::gltf::extension::{HYBRID, INSTANCING, KHR_SPLATS, extension_of};
use crate::scene::placement::is_flat;

const CODE: &str = "SPLAT_FLAT";

/// Reports splats below flat transforms, except where an animation moves these.
pub(super) fn check(document: &Document<'_>, findings: &mut Findings) {
    let nodes: Vec<(String, &Value)> = objects(document.root, "nodes", "").collect();
    let flat = flat_nodes(document, &nodes);
    let placed_by = nodes_of_splats(document.root);
    for (i, (at, node)) in nodes.iter().enumerate() {
        let Some(placed_by) = index(node, "mesh").and_then(|mesh| placed_by.get(mesh)) else { continue };
        // The transform of a node with a skin has no effect on the triangles to which splats are bound.
        let is_skinned = |i: usize| nodes.get(i).is_some_and(|(_, node)| node.get("skin").is_some());
        let hides = |placing: &Option<usize>| match placing {
            None => flat[i],
            Some(bound) => flat.get(*bound) == Some(&true) && !is_skinned(*bound),
        };
        if placed_by.iter().any(hides) {
            findings.warning(CODE, at, "an invertible transform above splats, else they are not drawn", "a flat one");
        } else if placed_by.contains(&None) {
            check_copies(document, node, at, findings);
        }
    }
}

/// Which nodes have a flat transform that no animation moves.
fn flat_nodes(document: &Document<'_>, nodes: &[(String, &Value)]) -> Vec<bool> {
    let moving = moving_nodes(document.root);
    let below: HashSet<usize> = nodes.iter().flat_map(|(_, node)| children(node, nodes.len())).collect();
    let tops = (0..nodes.len()).filter(|i| !below.contains(i));
    let mut stack: Vec<(usize, DMat4, bool)> = tops.map(|i| (i, DMat4::IDENTITY, false)).collect();
    let (mut seen, mut flat) = (vec![false; nodes.len()], vec![false; nodes.len()]);
    while let Some((i, above, moves)) = stack.pop() {
        // A node of several parents is a fault of its own.
        if std::mem::replace(&mut seen[i], true) {
            continue;
        }
        let (transform, moves) = (above * linear(nodes[i].1), moves || moving.contains(&i));
        flat[i] = is_flat(transform) && !moves;
        stack.extend(children(nodes[i].1, nodes.len()).into_iter().map(|child| (child, transform, moves)));
    }
    flat
}

/// Reports instances without extent along an axis; those without any are hidden on purpose.
fn check_copies(document: &Document<'_>, node: &Value, at: &str, findings: &mut Findings) {
    let Some((at, copies)) = extension(node, INSTANCING, at) else { return };
    let accessor = copies.pointer("/attributes/SCALE").and_then(Value::as_u64);
    let scales = accessor.and_then(|i| document.elements(i as usize)).filter(|scales| scales.components == 3);
    let Some(scales) = scales else { return };
    let mut offenders = Offenders::default();
    for i in 0..scales.count {
        let scale = scales.vector::<3>(i);
        if scale.contains(&0.0) && scale != [0.0; 3] {
            offenders.note(|| format!("{scale:?} of copy {i}"));
        }
    }
    if let Some(found) = offenders.summary(scales.count) {
        let expected = "scales of splats other than 0, else they are not drawn";
        findings.warning(CODE, format!("{at}/attributes/SCALE"), expected, found);
    }
}

/// Per mesh, the nodes that place its splats: `None` for the one that has the mesh, else that of the triangles to which
/// splats are bound.
fn nodes_of_splats(root: &Value) -> Vec<Vec<Option<usize>>> {
    let placing = |primitive: &Value| {
        let khr = extension_of(primitive, KHR_SPLATS)?;
        Some(extension_of(khr, HYBRID).and_then(|object| index(object.get("binding")?, "node")))
    };
    let of_mesh = |(at, mesh): (String, &Value)| {
        objects(mesh, "primitives", &at).filter_map(|(_, primitive)| placing(primitive)).collect()
    };
    objects(root, "meshes", "").map(of_mesh).collect()
}

/// Nodes whose own transform is animated.
fn moving_nodes(root: &Value) -> HashSet<usize> {
    let mut moving = HashSet::new();
    for (at, animation) in objects(root, "animations", "") {
        moving.extend(objects(animation, "channels", &at).filter_map(|(_, channel)| {
            let target = channel.get("target")?;
            let path = target.get("path")?.as_str()?;
            index(target, "node").filter(|_| ["translation", "rotation", "scale"].contains(&path))
        }));
    }
    moving
}

/// Local transform of a node, without its translation, in single precision as readers have it. Parts that are malformed
/// count as absent.
fn linear(node: &Value) -> DMat4 {
    let single = |key: &str| numbers(node.get(key)).into_iter().map(|v| f64::from(v as f32)).collect::<Vec<f64>>();
    if let Ok(matrix) = <[f64; 16]>::try_from(single("matrix")) {
        return DMat4::from_cols_array(&matrix);
    }
    let scale = <[f64; 3]>::try_from(single("scale")).map_or(DVec3::ONE, DVec3::from);
    let rotation = <[f64; 4]>::try_from(single("rotation")).ok().and_then(|q| DVec4::from(q).try_normalize());
    let rotation = rotation.map_or(DQuat::IDENTITY, DQuat::from_vec4);
    DMat4::from_scale_rotation_translation(scale, rotation, DVec3::ZERO)
}
