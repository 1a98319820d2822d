//! Binding of splats to triangles, by the hybrid extension.

use glam::{DMat4, DQuat, Quat, Vec3, Vec4};
use gltf::accessor::DataType;
use serde_json::Value;

use super::extension::{BindingObject, HYBRID, KHR_SPLATS, SplatExtension, extension_of};
use super::lift::Asset;
use crate::format::error::{Fault, from_value};
use crate::format::placed::orthogonal;
use crate::scene::rig::{Binding, Frame, ShFrame};

/// Largest deviation of a rotation's norm from 1, which 8-bit components cause by half a step each.
const UNIT_TOLERANCE: f32 = 0.01;

/// Triangle primitive at a node, to which splats can be bound.
pub(super) struct Bindable {
    /// Index of the scene's mesh made from the primitive; `moves`: whether that mesh is animated.
    pub(super) surface: usize,
    pub(super) moves: bool,
    /// Per triangle, in the file's order: vertices of that mesh (`corners`), and undeformed positions (`stored`).
    pub(super) corners: Vec<[u32; 3]>,
    pub(super) stored: Vec<[Vec3; 3]>,
}

/// Place and content of the extension's object in a primitive's `KHR_gaussian_splatting`.
pub(super) fn object(khr: &Value, id: (usize, usize)) -> Result<Option<(String, SplatExtension)>, Fault> {
    let Some(value) = extension_of(khr, HYBRID) else { return Ok(None) };
    let at = format!("/meshes/{}/primitives/{}/extensions/{KHR_SPLATS}/extensions/{HYBRID}", id.0, id.1);
    let object = from_value(value, &at, &format!("an object of {HYBRID}"))?;
    Ok(Some((at, object)))
}

/// Whether the extension's object binds splats.
pub(super) fn is_bound(khr: &Value, id: (usize, usize)) -> Result<bool, Fault> {
    Ok(object(khr, id)?.is_some_and(|(_, object)| object.binding.is_some()))
}

/// Pairs (node, primitive) to which any splats are bound.
pub(super) fn wanted(asset: &Asset) -> std::collections::HashSet<(usize, usize)> {
    let primitives = asset.document.meshes().flat_map(|m| m.primitives().map(move |p| (m.index(), p)));
    let objects = primitives.filter_map(|(m, p)| {
        let (_, found) = object(p.extension_value(KHR_SPLATS)?, (m, p.index())).ok()??;
        Some((found.binding.as_ref()?.node, found.binding?.primitive))
    });
    objects.collect()
}

/// Reads the binding of `count` splats; an inner `Err` gives the reason for which the binding is ignored.
/// `harmonics_bone` is the bone of the splats' node, and `turn` the transform under which they are
/// held, that node's in the rest pose unless it is flat.
pub(super) fn read(
    asset: &Asset,
    object: &BindingObject,
    count: usize,
    to: &Bindable,
    harmonics_bone: usize,
    turn: DMat4,
) -> Result<Binding, String> {
    let said = |fault: Fault| fault.to_string();
    if object.frame != "edgeNormal" {
        return Err(format!("expected a frame edgeNormal, found `{}`", object.frame));
    }
    let triangles = to.corners.len();
    if object.triangle_count != triangles {
        return Err(format!("expected a binding of {triangles} triangles, found one of {}", object.triangle_count));
    }
    if let Some(declared) = &object.geometry_digest {
        let corners: Vec<[f32; 3]> = to.stored.iter().flatten().map(Vec3::to_array).collect();
        let digest = geometry_digest(&corners);
        if *declared != digest {
            return Err(format!("expected geometryDigest {digest}, of the triangles, found {declared}"));
        }
    }
    let which = asset.indices(object.triangles).map_err(said)?;
    let translations = asset.floats::<3>(object.translations).map_err(said)?;
    let rotations = asset.floats::<4>(object.rotations).map_err(said)?;
    let scales = asset.floats::<3>(object.scales).map_err(said)?;
    for found in [which.len(), translations.len(), rotations.len(), scales.len()] {
        if found != count {
            return Err(format!("expected {count} elements, one per splat, found {found}"));
        }
    }
    if let Some(bad) = which.iter().find(|&&t| t as usize >= triangles) {
        return Err(format!("expected triangles below {triangles}, found {bad}"));
    }
    for (key, accessor) in [("translations", object.translations), ("scales", object.scales)] {
        if let Some((kind, _)) = asset.component(accessor).filter(|(kind, _)| *kind != DataType::F32) {
            return Err(format!("expected {key} of Float, found {kind:?}"));
        }
    }
    let is_finite =
        translations.iter().chain(&scales).flatten().chain(rotations.iter().flatten()).all(|v| v.is_finite());
    if !is_finite || scales.iter().flatten().any(|s| *s < 0.0) {
        return Err("expected finite numbers, scales of at least 0, found others".to_owned());
    }
    let lengths = rotations.iter().map(|q| Vec4::from(*q).length());
    if let Some((i, length)) = lengths.enumerate().find(|(_, length)| (length - 1.0).abs() > UNIT_TOLERANCE) {
        return Err(format!("expected rotations of length 1, found length {length:.4} of element {i}"));
    }
    let harmonics = match &object.spherical_harmonics_frame[..] {
        "node" => ShFrame::Bone(harmonics_bone),
        "triangle" => {
            let turn = orthogonal(turn).unwrap_or_default();
            if turn.determinant() < 0.0 {
                return Err(
                    "expected a node that does not mirror what turns with triangles, found one that does".to_owned()
                );
            }
            let unturned = DQuat::from_mat3(&turn.transpose());
            let undeformed = |&t: &u32| {
                let frame = Frame::of(to.stored[t as usize].map(Vec3::as_dvec3));
                frame.map_or(DQuat::IDENTITY, |f| DQuat::from_mat3(&f.axes.transpose())) * unturned
            };
            ShFrame::Triangles(which.iter().map(undeformed).collect())
        }
        other => return Err(format!("expected sphericalHarmonicsFrame node or triangle, found `{other}`")),
    };
    Ok(Binding {
        surface: to.surface,
        corners: which.iter().map(|&t| to.corners[t as usize]).collect(),
        translations: translations.into_iter().map(Vec3::from).collect(),
        rotations: rotations.into_iter().map(Quat::from_array).collect(),
        scales: scales.into_iter().map(Vec3::from).collect(),
        harmonics,
    })
}

/// `geometryDigest` of triangles with these corners: 64-bit FNV-1a over the positions as little-endian f32.
pub(in crate::format) fn geometry_digest(corners: &[[f32; 3]]) -> String {
    let mut hash = 0xcbf2_9ce4_8422_2325_u64;
    for &v in corners.as_flattened() {
        // Adding 0 turns −0 into 0.
        for byte in (v + 0.0).to_le_bytes() {
            hash = (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3);
        }
    }
    format!("{hash:016x}")
}
