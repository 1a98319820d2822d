//! Which bytes of a glTF file hold what.

use std::collections::{BTreeMap, BTreeSet};

use serde::Deserialize as _;
use serde_json::Value;

use super::extension::{HYBRID, KHR_SPLATS, Radiance, SPZ, Surface};
use super::lift::Asset;
use super::meshopt;

/// Bytes by part: `json`, `splats`, `geometry`, `maps`, `animation`, `images`, `other`. Counted by accessor and image, of
/// compressed views as they are stored; what two parts share counts for the first.
pub(in crate::format) fn bytes_by_part(asset: &Asset, file_bytes: u64) -> BTreeMap<&'static str, u64> {
    let parts = BTreeMap::from([("json", asset.json_bytes as u64)]);
    let mut count = Count { asset, parts, accessors: BTreeSet::new(), views: BTreeSet::new() };
    for mesh in asset.document.meshes() {
        for primitive in mesh.primitives() {
            let khr = primitive.extension_value(KHR_SPLATS);
            let part = if khr.is_some() { "splats" } else { "geometry" };
            let lifted = asset.attributes.get(&(mesh.index(), primitive.index()));
            lifted.into_iter().flat_map(|a| a.values()).for_each(|&a| count.accessor(part, a));
            primitive.attributes().for_each(|(_, a)| count.accessor(part, a.index()));
            primitive.indices().into_iter().for_each(|a| count.accessor(part, a.index()));
            for target in primitive.morph_targets() {
                let of_target = [target.positions(), target.normals(), target.tangents()];
                of_target.into_iter().flatten().for_each(|a| count.accessor(part, a.index()));
            }
            let own = primitive.extension_value(HYBRID).and_then(|v| Surface::deserialize(v).ok()?.surface_vertices);
            own.into_iter().for_each(|a| count.accessor(part, a));
            let stream = khr.and_then(|k| k.get("extensions")?.get(SPZ)?.get("bufferView")?.as_u64());
            stream.into_iter().for_each(|view| count.view(part, view as usize));
        }
    }
    for material in asset.document.materials() {
        let Some(Ok(radiance)) = material.extension_value(HYBRID).map(Radiance::deserialize) else { continue };
        let harmonics = radiance.spherical_harmonics.into_iter().flat_map(|s| s.coefficients);
        let sources = harmonics.chain(radiance.opacity.map(|o| o.source));
        sources.filter_map(|source| source.accessor).for_each(|a| count.accessor("maps", a));
    }
    for animation in asset.document.animations() {
        let ends = animation.samplers().flat_map(|s| [s.input(), s.output()]);
        ends.for_each(|a| count.accessor("animation", a.index()));
    }
    for skin in asset.document.skins() {
        skin.inverse_bind_matrices().into_iter().for_each(|a| count.accessor("animation", a.index()));
    }
    for image in &asset.document.as_json().images {
        image.buffer_view.iter().for_each(|view| count.view("images", view.value()));
    }
    let mut parts = count.parts;
    let known = parts.values().fold(0u64, |sum, bytes| sum.saturating_add(*bytes));
    parts.insert("other", file_bytes.saturating_sub(known));
    parts
}

struct Count<'a> {
    asset: &'a Asset,
    parts: BTreeMap<&'static str, u64>,
    accessors: BTreeSet<usize>,
    /// Those that are counted as a whole.
    views: BTreeSet<usize>,
}

impl Count<'_> {
    fn accessor(&mut self, part: &'static str, index: usize) {
        let Some(accessor) = self.asset.document.accessors().nth(index).filter(|_| self.accessors.insert(index)) else {
            return;
        };
        match accessor.view().filter(|view| self.asset.has_view(view)) {
            Some(view) if self.asset.plain_views.contains_key(&view.index()) => self.view(part, view.index()),
            Some(_) => self.add(part, accessor.count().saturating_mul(accessor.size()) as u64),
            None => {}
        }
    }

    fn view(&mut self, part: &'static str, index: usize) {
        let view = self.asset.root.get("bufferViews").and_then(|views| views.get(index));
        let Some(view) = view.filter(|_| self.views.insert(index)) else { return };
        let stored = meshopt::of_view(view).map_or(view, |(_, compressed)| compressed);
        self.add(part, stored.get("byteLength").and_then(Value::as_u64).unwrap_or(0));
    }

    fn add(&mut self, part: &'static str, bytes: u64) {
        let total = self.parts.entry(part).or_default();
        *total = total.saturating_add(bytes);
    }
}
