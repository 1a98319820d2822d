//! Breakdown of a glTF file's bytes by content.

use std::collections::{BTreeMap, BTreeSet, HashMap};

use serde::Deserialize as _;
use serde_json::Value;

use super::buffer::Buffer;
use super::extension::{HYBRID, INSTANCING, KHR_SPLATS, Radiance, SPZ, Surface, extension_of};
use super::json::items;
use super::lift::Asset;
use super::{meshopt, uri};

/// Byte counts of a glTF.
pub(in crate::format) struct Sizes {
    /// Total of the file, and of the existing buffers and images beside it.
    pub(in crate::format) total: u64,
    /// Bytes by part: `json`, `splats`, `geometry`, `maps`, `animation`, `images`, `base64` (overhead of embedding) and
    /// `other`.
    pub(in crate::format) parts: BTreeMap<&'static str, u64>,
}

/// Counts by accessor and image, compressed views as stored; bytes shared by two parts count for the first.
pub(in crate::format) fn sizes(asset: &Asset, file_bytes: u64) -> Sizes {
    let left = asset.buffers.iter().map(|buffer| (buffer.place(), buffer.len() as u64)).collect();
    let mut count = Count { asset, parts: BTreeMap::new(), accessors: BTreeSet::new(), views: BTreeSet::new(), left };
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
            let stream = khr.and_then(|k| extension_of(k, SPZ)?.get("bufferView")?.as_u64());
            stream.into_iter().for_each(|view| count.view(part, view as usize));
        }
    }
    for node in asset.document.nodes() {
        let copies = node.extension_value(INSTANCING).and_then(|copies| copies.get("attributes")?.as_object());
        let accessors = copies.into_iter().flatten().filter_map(|(_, accessor)| accessor.as_u64());
        accessors.for_each(|accessor| count.accessor("geometry", accessor as usize));
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
    let images = Images::of(asset);
    let mut parts = count.parts;
    let mut add = |part: &'static str, bytes: u64| *parts.entry(part).or_default() += bytes;
    add("images", images.embedded + images.beside);
    add("base64", (asset.places.uris - asset.places.embedded) as u64 + images.uris - images.embedded);
    add("json", (asset.json_bytes as u64).saturating_sub(asset.places.uris as u64 + images.uris));
    parts.retain(|_, bytes| *bytes > 0);
    let total = file_bytes + asset.places.beside as u64 + images.beside;
    let known: u64 = parts.values().sum();
    parts.insert("other", total.saturating_sub(known));
    Sizes { total, parts }
}

/// Bytes of images outside buffers: data URIs, their decoded content, and files, each counted once.
#[derive(Default)]
struct Images {
    uris: u64,
    embedded: u64,
    beside: u64,
}

impl Images {
    fn of(asset: &Asset) -> Self {
        let uris = || items(&asset.root, "images").iter().filter_map(|image| image.get("uri")?.as_str());
        let mut images = Self { beside: uri::bytes_of_files(uris(), &asset.folder), ..Self::default() };
        for uri in uris().filter(|uri| uri.starts_with("data:")) {
            images.uris += uri.len() as u64;
            images.embedded += uri::embedded_bytes(uri) as u64;
        }
        images
    }
}

struct Count<'a> {
    asset: &'a Asset,
    parts: BTreeMap<&'static str, u64>,
    /// Accessors already counted, by view and offset.
    accessors: BTreeSet<(usize, usize)>,
    /// Views that are counted as a whole.
    views: BTreeSet<usize>,
    /// Bytes of buffers not counted yet, by place, because parts can overlap.
    left: HashMap<(usize, u64), u64>,
}

impl Count<'_> {
    fn accessor(&mut self, part: &'static str, index: usize) {
        let Some(accessor) = self.asset.document.accessors().nth(index) else { return };
        match accessor.view().filter(|view| self.asset.has_view(view)) {
            Some(view) if self.asset.plain_views.contains_key(&view.index()) => self.view(part, view.index()),
            Some(view) if self.accessors.insert((view.index(), accessor.offset())) => {
                let bytes = accessor.count().saturating_mul(accessor.size()) as u64;
                self.add(part, view.buffer().index(), bytes);
            }
            _ => {}
        }
    }

    fn view(&mut self, part: &'static str, index: usize) {
        let view = self.asset.root.get("bufferViews").and_then(|views| views.get(index));
        let Some(view) = view.filter(|_| self.views.insert(index)) else { return };
        let stored = meshopt::of_view(view).map_or(view, |(_, compressed)| compressed);
        let number = |key: &str| stored.get(key).and_then(Value::as_u64).unwrap_or(0);
        self.add(part, number("buffer") as usize, number("byteLength"));
    }

    fn add(&mut self, part: &'static str, buffer: usize, bytes: u64) {
        let place = self.asset.buffers.get(buffer).map(Buffer::place);
        let Some(left) = place.and_then(|place| self.left.get_mut(&place)) else { return };
        let bytes = bytes.min(*left);
        *left -= bytes;
        *self.parts.entry(part).or_default() += bytes;
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use serde_json::json;

    use crate::base64;
    use crate::format::gltf::uri::resolve;
    use crate::format::gltf::write_glb;
    use crate::format::inspect;
    use crate::format::test_scenes::random_scene;

    /// Bytes of all parts except `other`, which must be the remainder of `whole`.
    fn parts(path: &Path, whole: usize) -> Vec<(&'static str, u64)> {
        let summary = inspect(path).unwrap();
        assert_eq!(
            (summary.bytes, summary.bytes_by_part.values().sum::<u64>()),
            (whole as u64, whole as u64),
            "{summary}"
        );
        summary.bytes_by_part.into_iter().filter(|(part, _)| *part != "other").collect()
    }

    #[test]
    fn parts_add_up_wherever_buffers_and_images_are() {
        let folder = tempfile::tempdir().unwrap();
        let scene = random_scene(50, 1, 1, 4);
        let [glb, gltf] = ["a.glb", "a.gltf"].map(|name| folder.path().join(name));
        let lengths = [&glb, &gltf].map(|path| write_glb(path, &scene, &[], None).unwrap() as usize);
        let of_glb = parts(&glb, lengths[0]);
        assert_eq!(
            of_glb.iter().map(|(part, _)| *part).collect::<Vec<_>>(),
            ["geometry", "images", "json", "maps", "splats"]
        );
        let without_text = |parts: &[(&'static str, u64)]| -> Vec<_> {
            parts.iter().copied().filter(|(part, _)| !["json", "base64"].contains(part)).collect()
        };

        // Embedded buffer: its base64 text is a third longer than its bytes, which are counted once.
        let of_gltf = parts(&gltf, lengths[1]);
        assert_eq!(without_text(&of_gltf), without_text(&of_glb));
        let mut document: serde_json::Value = serde_json::from_slice(&std::fs::read(&gltf).unwrap()).unwrap();
        let uri = document["buffers"][0]["uri"].as_str().unwrap().to_owned();
        let buffer = resolve(&uri, Path::new("")).unwrap();
        assert!(of_gltf.contains(&("base64", (uri.len() - buffer.len()) as u64)), "{of_gltf:?}");
        assert!(of_gltf.contains(&("json", (lengths[1] - uri.len()) as u64)), "{of_gltf:?}");

        // External buffer; a second accessor for the same bytes adds nothing.
        std::fs::write(folder.path().join("a.bin"), &buffer).unwrap();
        document["buffers"][0]["uri"] = json!("a.bin");
        let twin = document["accessors"][0].clone();
        document["accessors"].as_array_mut().unwrap().push(twin);
        let count = document["accessors"].as_array().unwrap().len();
        document["meshes"][0]["primitives"][0]["attributes"]["_TWIN"] = json!(count - 1);
        let text = document.to_string();
        std::fs::write(&gltf, &text).unwrap();
        let of_gltf = parts(&gltf, text.len() + buffer.len());
        assert_eq!(without_text(&of_gltf), without_text(&of_glb));
        assert!(of_gltf.contains(&("json", text.len() as u64)), "{of_gltf:?}");

        // Images in the text, in a file beside it, and missing.
        let picture = vec![7; 1000];
        let uri = format!("data:image/png;base64,{}", base64::encode(&picture));
        std::fs::write(folder.path().join("a.png"), &picture).unwrap();
        let before = of_glb.iter().find(|(part, _)| *part == "images").unwrap().1;
        for image in [
            json!({ "uri": uri }),
            json!({ "uri": "a.png" }),
            json!({ "uri": "./a.png" }),
            json!({ "uri": "none.png" }),
        ] {
            document["images"].as_array_mut().unwrap().push(image);
        }
        let text = document.to_string();
        std::fs::write(&gltf, &text).unwrap();
        let of_gltf = parts(&gltf, text.len() + buffer.len() + picture.len());
        assert!(of_gltf.contains(&("images", before + 2 * picture.len() as u64)), "{of_gltf:?}");
        assert!(of_gltf.contains(&("base64", (uri.len() - picture.len()) as u64)), "{of_gltf:?}");
        assert!(of_gltf.contains(&("json", (text.len() - uri.len()) as u64)), "{of_gltf:?}");
    }
}
