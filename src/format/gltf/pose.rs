//! The pose in which a scene rests: skins by their joints' own transforms, morph targets by their default weights. It is
//! what viewers show before an animation starts, and what the static mesh is made of.

use std::collections::HashMap;

use glam::{DMat4, DVec3, DVec4, Vec3};

use super::lift::Asset;
use super::transform::placements;
use crate::format::error::Fault;

/// Where the nodes of the scene are.
pub(in crate::format) struct Pose {
    global: HashMap<usize, DMat4>,
}

/// Joints of a vertex, four at a time, and their weights.
type Influences = Vec<(Vec<[f32; 4]>, Vec<[f32; 4]>)>;

impl Pose {
    /// As [`placements`], with which it fails alike.
    pub(in crate::format) fn rest(document: &gltf::Document) -> Result<Self, Fault> {
        let global = placements(document)?.into_iter().map(|(node, global)| (node.index(), global)).collect();
        Ok(Self { global })
    }

    /// Positions of `primitive`, of the mesh of `node`, in the scene.
    pub(super) fn positions(
        &self,
        asset: &Asset,
        node: &gltf::Node<'_>,
        primitive: &gltf::Primitive<'_>,
        stored: Vec<Vec3>,
    ) -> Result<Vec<Vec3>, Fault> {
        let mut positions = stored;
        let mesh = node.mesh().map_or(0, |m| m.index());
        let at = format!("/meshes/{mesh}/primitives/{}", primitive.index());
        let weights = node.weights().or(node.mesh().and_then(|m| m.weights())).unwrap_or_default();
        for (i, (target, &weight)) in primitive.morph_targets().zip(weights).enumerate() {
            let Some(accessor) = target.positions().filter(|_| weight != 0.0) else { continue };
            let deltas = asset.floats::<3>(accessor.index())?;
            if deltas.len() != positions.len() {
                let expected = format!("{} elements, as in POSITION", positions.len());
                return Err(Fault::pointer(format!("{at}/targets/{i}/POSITION"), expected, deltas.len().to_string()));
            }
            positions.iter_mut().zip(deltas).for_each(|(p, d)| *p += weight * Vec3::from(d));
        }
        if let Some(skin) = node.skin() {
            return self.skinned(asset, &skin, (mesh, primitive.index()), &positions);
        }
        let transform = self.global.get(&node.index()).copied().unwrap_or_default();
        if transform != DMat4::IDENTITY {
            positions.iter_mut().for_each(|p| *p = transform.transform_point3(p.as_dvec3()).as_vec3());
        }
        Ok(positions)
    }

    /// Linear blend skinning; the transform of the mesh's own node has no effect (glTF 2.0, 3.7.3.3).
    fn skinned(
        &self,
        asset: &Asset,
        skin: &gltf::Skin<'_>,
        id: (usize, usize),
        positions: &[Vec3],
    ) -> Result<Vec<Vec3>, Fault> {
        let at_skin = format!("/skins/{}", skin.index());
        let at = format!("/meshes/{}/primitives/{}/attributes", id.0, id.1);
        let joints: Vec<usize> = skin.joints().map(|j| j.index()).collect();
        let inverse_bind = match skin.inverse_bind_matrices() {
            None => vec![DMat4::IDENTITY; joints.len()],
            Some(accessor) => asset.matrices(accessor.index())?,
        };
        if inverse_bind.len() < joints.len() {
            let at = format!("{at_skin}/inverseBindMatrices");
            return Err(Fault::pointer(
                at,
                format!("{} matrices, one a joint", joints.len()),
                inverse_bind.len().to_string(),
            ));
        }
        let mut matrices = vec![];
        for (joint, inverse) in joints.iter().zip(inverse_bind) {
            let global = self.global.get(joint).ok_or_else(|| {
                Fault::pointer(
                    format!("{at_skin}/joints"),
                    "joints in the scene of their mesh",
                    format!("node {joint}"),
                )
            })?;
            matrices.push(*global * inverse);
        }
        let influences = influences(asset, id, positions.len(), &at)?;
        let mut posed = Vec::with_capacity(positions.len());
        for (v, p) in positions.iter().enumerate() {
            let (mut sum, mut total) = (DVec3::ZERO, 0.0);
            for (joints, weights) in &influences {
                for (&joint, &weight) in joints[v].iter().zip(&weights[v]).filter(|(_, w)| **w != 0.0) {
                    let matrix = matrices.get(joint as usize).ok_or_else(|| {
                        let expected = format!("joints below {}", matrices.len());
                        Fault::pointer(format!("{at}/JOINTS_0"), expected, format!("{joint} at vertex {v}"))
                    })?;
                    sum += f64::from(weight) * (*matrix * DVec4::from((p.as_dvec3(), 1.0))).truncate();
                    total += f64::from(weight);
                }
            }
            if total.is_nan() || total <= 0.0 {
                return Err(Fault::pointer(
                    format!("{at}/WEIGHTS_0"),
                    "weights that add up to 1",
                    format!("{total} at vertex {v}"),
                ));
            }
            // Quantised weights add up to 1 but for their rounding.
            posed.push((sum / total).as_vec3());
        }
        Ok(posed)
    }
}

/// Sets of joints that are read: 32 a vertex.
const MAX_SETS: usize = 8;

/// All sets `JOINTS_n`, `WEIGHTS_n`.
fn influences(asset: &Asset, id: (usize, usize), count: usize, at: &str) -> Result<Influences, Fault> {
    let attributes = asset.attributes.get(&id);
    let find = |name: &str| attributes.and_then(|a| a.get(name)).copied();
    let mut sets = vec![];
    while let (Some(joints), Some(weights)) =
        (find(&format!("JOINTS_{}", sets.len())), find(&format!("WEIGHTS_{}", sets.len())))
    {
        let set = (asset.floats::<4>(joints)?, asset.floats::<4>(weights)?);
        if set.0.len() != count || set.1.len() != count {
            let expected = format!("{count} elements, as in POSITION");
            let found = format!("{} and {}", set.0.len(), set.1.len());
            return Err(Fault::pointer(format!("{at}/JOINTS_{}", sets.len()), expected, found));
        }
        sets.push(set);
        if sets.len() == MAX_SETS {
            break;
        }
    }
    if sets.is_empty() {
        return Err(Fault::pointer(at, "JOINTS_0 and WEIGHTS_0, as its node has a skin", "no such pair"));
    }
    Ok(sets)
}
