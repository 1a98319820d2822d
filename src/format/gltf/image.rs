//! Decodes textures of a glTF file.

use std::io::Cursor;

use super::lift::{Asset, resolve};
use crate::format::error::Fault;

/// Texels as stored, 0..1, no transfer function undone; rows from the top.
pub(super) struct Texels {
    pub(super) width: u32,
    pub(super) height: u32,
    pub(super) rgba: Vec<[f32; 4]>,
}

/// Largest side accepted, that of `scene::Texture`.
const MAX_SIDE: u32 = 16384;

impl Asset {
    /// Decodes the image of texture `index`: PNG (8 or 16 bit) or JPEG.
    pub(super) fn texels(&self, index: usize) -> Result<Texels, Fault> {
        let json = self.document.as_json();
        let source = json.textures.get(index).map(|t| t.source.value());
        let Some((source, image)) = source.and_then(|s| Some((s, json.images.get(s)?))) else {
            return Err(Fault::pointer(format!("/textures/{index}"), "a texture with an image", "none"));
        };
        let at = format!("/images/{source}");
        let view = image.buffer_view.as_ref().and_then(|v| self.document.views().nth(v.value()));
        let encoded = match (view, &image.uri) {
            (Some(view), _) => self.view_bytes(&view)?.to_vec(),
            (None, Some(uri)) => resolve(uri, &self.folder)
                .map_err(|(expected, found)| Fault::pointer(format!("{at}/uri"), expected, found))?,
            (None, None) => return Err(Fault::pointer(at, "a bufferView or a uri", "neither")),
        };
        let undecodable = |e: &dyn std::fmt::Display| Fault::pointer(&at, "a PNG or JPEG image", e.to_string());
        let mut reader =
            image::ImageReader::new(Cursor::new(encoded)).with_guessed_format().map_err(|e| undecodable(&e))?;
        let mut limits = image::Limits::default();
        limits.max_image_width = Some(MAX_SIDE);
        limits.max_image_height = Some(MAX_SIDE);
        // RGBA of 16 bits at the largest size, for the decoder itself.
        limits.max_alloc = Some(u64::from(MAX_SIDE) * u64::from(MAX_SIDE) * 8);
        reader.limits(limits);
        let pixels = reader.decode().map_err(|e| undecodable(&e))?.into_rgba32f();
        let rgba = pixels.pixels().map(|p| p.0).collect();
        Ok(Texels { width: pixels.width(), height: pixels.height(), rgba })
    }
}
