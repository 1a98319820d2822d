//! Which bytes of a glTF file hold what.

use std::collections::{BTreeMap, BTreeSet};

use serde::Deserialize as _;

use super::extension::{HYBRID, KHR_SPLATS, Radiance, Surface};
use super::lift::Asset;

/// Bytes by part: `json`, `splats`, `geometry`, `maps`, `images`, `other`. Counted by accessor and image; what two parts
/// share counts for the first.
pub(in crate::format) fn bytes_by_part(asset: &Asset, file_bytes: u64) -> BTreeMap<&'static str, u64> {
    let mut parts = BTreeMap::from([("json", asset.json_bytes as u64)]);
    let mut seen = BTreeSet::new();
    let mut count = |part: &'static str, accessors: &mut dyn Iterator<Item = usize>| {
        for index in accessors.filter(|&index| seen.insert(index)) {
            let bytes = asset.document.accessors().nth(index).map_or(0, |a| a.count().saturating_mul(a.size()));
            let total = parts.entry(part).or_default();
            *total = total.saturating_add(bytes as u64);
        }
    };
    for mesh in asset.document.meshes() {
        for primitive in mesh.primitives() {
            let lifted = asset.attributes.get(&(mesh.index(), primitive.index()));
            let attributes = lifted.into_iter().flat_map(|a| a.values().copied());
            let core = [gltf::Semantic::Positions, gltf::Semantic::TexCoords(0)];
            let core = core.iter().filter_map(|s| primitive.get(s)).chain(primitive.indices()).map(|a| a.index());
            let own = primitive.extension_value(HYBRID).and_then(|v| Surface::deserialize(v).ok()?.surface_vertices);
            let part = if primitive.extension_value(KHR_SPLATS).is_some() { "splats" } else { "geometry" };
            count(part, &mut attributes.chain(core).chain(own));
        }
    }
    for material in asset.document.materials() {
        let Some(Ok(radiance)) = material.extension_value(HYBRID).map(Radiance::deserialize) else { continue };
        let harmonics = radiance.spherical_harmonics.into_iter().flat_map(|s| s.coefficients);
        count("maps", &mut harmonics.chain(radiance.opacity.map(|o| o.source)).filter_map(|source| source.accessor));
    }
    let json = asset.document.as_json();
    let views = json.images.iter().filter_map(|image| json.buffer_views.get(image.buffer_view.as_ref()?.value()));
    let images = views.fold(0u64, |sum, view| sum.saturating_add(view.byte_length.0));
    if images > 0 {
        parts.insert("images", images);
    }
    let known = parts.values().fold(0u64, |sum, bytes| sum.saturating_add(*bytes));
    parts.insert("other", file_bytes.saturating_sub(known));
    parts
}
