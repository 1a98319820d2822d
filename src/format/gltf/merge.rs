//! Binary data of a document that is kept to be written again, as one buffer.

use std::collections::{BTreeMap, HashMap};
use std::path::Path;
use std::sync::Arc;

use serde_json::{Value, json};

use super::buffer::Buffer;
use super::container::Bin;
use super::image::media_type;
use super::json::{enlist, index, items, items_mut, lists, object_at, push, remove};
use super::{meshopt, uri};
use crate::format::error::one_line;

/// Binary data referenced by a document.
#[derive(Clone, Debug)]
pub(super) struct Content {
    buffers: Vec<Buffer>,
    /// Images outside buffers, by index; images with the same file share the data.
    images: BTreeMap<usize, Arc<Vec<u8>>>,
    /// `uri`s of images that were not found.
    pub(super) unfound: Vec<String>,
}

impl Content {
    /// Data of a document with these buffers; loads the images outside buffers, from `folder` or below it.
    pub(super) fn new(root: &Value, buffers: Vec<Buffer>, folder: &Path) -> Self {
        // Images that cannot be found stay references.
        let (mut images, mut unfound, mut loaded) = (BTreeMap::new(), vec![], uri::Loaded::default());
        let listed = items(root, "images").iter().enumerate();
        for (i, uri) in listed.filter_map(|(i, image)| Some((i, image.get("uri")?.as_str()?))) {
            match loaded.resolve(uri, folder) {
                Ok(bytes) => {
                    images.insert(i, bytes);
                }
                Err(_) => unfound.push(one_line(uri).into_owned()),
            }
        }
        unfound.sort_unstable();
        unfound.dedup();
        Self { buffers, images, unfound }
    }

    /// Merges all buffers into one, including images outside buffers. Buffers that are never stored, placeholders of
    /// compressed views, follow.
    pub(super) fn merge(&self, root: &mut Value) -> Bin<'_> {
        let mut bin = Bin::default();
        let old = items(root, "buffers").to_vec();
        let has_bin = self.buffers.iter().any(|b| !b.is_empty()) || !self.images.is_empty();
        let (places, mut placeholders) = self.merge_buffers(&old, usize::from(has_bin), &mut bin);
        for view in items_mut(root, "bufferViews") {
            move_view(view, &places);
            for name in meshopt::NAMES {
                if let Some(compressed) = view.get_mut("extensions").and_then(|e| e.get_mut(name)) {
                    move_view(compressed, &places);
                }
            }
        }
        self.merge_images(root, &mut bin);
        placeholders.iter_mut().for_each(|placeholder| drop_fallback(placeholder, root));
        let mut buffers = vec![];
        if has_bin {
            let first = old.into_iter().zip(&self.buffers).find(|(_, content)| !content.is_empty());
            let mut whole = first.map_or_else(|| json!({}), |(buffer, _)| buffer);
            whole["byteLength"] = json!(bin.len());
            buffers.push(whole);
        }
        buffers.append(&mut placeholders);
        if !buffers.is_empty() {
            root["buffers"] = Value::Array(buffers);
        }
        bin
    }

    /// Appends the buffers to `bin`. Returns the new index and offset of each buffer, and the buffers without content,
    /// whose new indices begin at `first`.
    fn merge_buffers<'a>(
        &'a self,
        old: &[Value],
        first: usize,
        bin: &mut Bin<'a>,
    ) -> (Vec<(usize, usize)>, Vec<Value>) {
        let (mut places, mut placeholders) = (vec![], vec![]);
        // Content shared by several buffers is copied once.
        let mut copies = HashMap::new();
        for (buffer, content) in old.iter().zip(&self.buffers) {
            if content.is_empty() {
                places.push((first + placeholders.len(), 0));
                placeholders.push(buffer.clone());
            } else {
                let length = index(buffer, "byteLength").unwrap_or(0).min(content.len());
                let copy = copies.entry((content.place(), length)).or_insert_with(|| bin.push_copy(content, length));
                places.push((0, *copy));
            }
        }
        (places, placeholders)
    }

    /// Appends the images to `bin`, and replaces their `uri`s by buffer views.
    fn merge_images<'a>(&'a self, root: &mut Value, bin: &mut Bin<'a>) {
        let mut views = HashMap::new();
        for (&i, content) in &self.images {
            let view = *views.entry(Arc::as_ptr(content)).or_insert_with(|| {
                let start = bin.push(content.as_slice());
                push(root, "bufferViews", json!({ "buffer": 0, "byteOffset": start, "byteLength": content.len() }))
            });
            let image = &mut root["images"][i];
            let uri = remove(image, "uri");
            image["bufferView"] = json!(view);
            if let Some(found) = media_type(content) {
                image["mimeType"] = json!(found);
            } else if image.get("mimeType").is_none() {
                image["mimeType"] = json!("image/png");
            }
            if let Some(Value::String(uri)) = uri.filter(|_| image.get("name").is_none())
                && !uri.starts_with("data:")
            {
                image["name"] = json!(uri);
            }
        }
    }
}

/// Redirects a buffer view, or its compressed form, to the merged buffer.
fn move_view(view: &mut Value, places: &[(usize, usize)]) {
    let Some(&(buffer, start)) = index(view, "buffer").and_then(|b| places.get(b)) else { return };
    let offset = view.get("byteOffset").and_then(Value::as_u64).unwrap_or(0);
    view["buffer"] = json!(buffer);
    if start > 0 {
        // Saturating, because unreferenced views have not been validated.
        view["byteOffset"] = json!((start as u64).saturating_add(offset));
    }
}

/// Drops the uncompressed fallback of compressed views, if it is in a file of its own; the compression extension then
/// becomes required.
fn drop_fallback(placeholder: &mut Value, root: &mut Value) {
    if remove(placeholder, "uri").is_none() {
        return;
    }
    for name in meshopt::NAMES {
        if lists(root, "extensionsUsed", name) {
            enlist(root, "extensionsRequired", name);
            // Only a buffer marked as fallback may lack a file.
            object_at(object_at(placeholder, "extensions"), name)["fallback"] = json!(true);
        }
    }
}
