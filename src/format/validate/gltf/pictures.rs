//! Validation of images: whether their content has the stated type, and whether their headers suit maps.

use std::borrow::Cow;
use std::collections::HashMap;
use std::io::Cursor;

use serde_json::Value;

use super::super::Findings;
use super::document::Document;
use super::{index, objects};
use crate::format::gltf::extension::{WEBP, extension_of};
use crate::format::gltf::{media_type, resolve};

/// Extension for lossily compressed GPU textures.
const BASIS_UNIVERSAL: &str = "KHR_texture_basisu";

pub(super) fn check(document: &Document<'_>, findings: &mut Findings) {
    for (i, (at, image)) in objects(document.root, "images", "").enumerate() {
        check_image(document, (i, image), &at, findings);
    }
}

fn check_image(document: &Document<'_>, (i, image): (usize, &Value), at: &str, findings: &mut Findings) {
    let content = match content(document, image) {
        Ok(Some(content)) => content,
        Ok(None) => return,
        Err((expected, found)) => return findings.error("IMAGE_URI", format!("{at}/uri"), expected, found),
    };
    let found = media_type(&content);
    // Whether core textures use the image; an extension's image is additional to, or a replacement of, the core's.
    let is_of_core = || objects(document.root, "textures", "").any(|(_, t)| index(t, "source") == Some(i));
    let is_usual = found.is_some_and(|found| ["image/png", "image/jpeg"].contains(&found));
    let Some(found) = found.filter(|_| is_usual || !is_of_core()) else {
        return findings.error("IMAGE_CONTENT", at, "PNG or JPEG", found.unwrap_or("other content"));
    };
    let declared = image.get("mimeType").and_then(Value::as_str);
    if let Some(declared) = declared.filter(|&declared| declared != found) {
        findings.error("IMAGE_TYPE", format!("{at}/mimeType"), found, declared);
    }
}

/// Content of an image; `None` if the document does not validly state its place. On failure: expectation and finding.
fn content<'a>(document: &'a Document<'_>, image: &Value) -> Result<Option<Cow<'a, [u8]>>, (String, String)> {
    Ok(match (image.get("uri").and_then(Value::as_str), index(image, "bufferView")) {
        (Some(uri), None) => Some(Cow::Owned(resolve(uri, document.folder)?)),
        (None, Some(view)) => document.view(view).map(Cow::Borrowed),
        _ => None,
    })
}

/// Properties of an image that holds the texels of a map.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Picture {
    /// Width and height; `None` if unknown.
    pub(super) size: Option<(usize, usize)>,
    /// Lossy step that has changed the texels, if any.
    pub(super) loss: Option<&'static str>,
}

impl Picture {
    /// Reads the properties from a file's header.
    fn of(content: &[u8]) -> Self {
        let (size, loss) = match media_type(content) {
            Some("image/webp") => match image_webp::WebPDecoder::new(Cursor::new(content)) {
                Ok(mut decoder) => (Some(decoder.dimensions()), decoder.is_lossy().then_some("WebP with loss")),
                Err(_) => (None, None),
            },
            kind => {
                let reader = image::ImageReader::new(Cursor::new(content)).with_guessed_format().ok();
                let size = reader.and_then(|reader| reader.into_dimensions().ok());
                (size, (kind == Some("image/jpeg")).then_some("JPEG"))
            }
        };
        Self { size: size.map(|(width, height)| (width as usize, height as usize)), loss }
    }

    /// Properties of a texture's image, as far as it can be read: images have findings of their own.
    fn of_texture(document: &Document<'_>, texture: usize) -> Self {
        let Some(texture) = document.object("textures", texture) else { return Self::default() };
        if extension_of(texture, BASIS_UNIVERSAL).is_some() {
            return Self { size: None, loss: Some(BASIS_UNIVERSAL) };
        }
        let webp = extension_of(texture, WEBP).and_then(|webp| index(webp, "source"));
        let image = webp.or(index(texture, "source")).and_then(|image| document.object("images", image));
        let content = image.and_then(|image| content(document, image).ok().flatten());
        content.map(|content| Self::of(&content)).unwrap_or_default()
    }
}

/// Images of a document, each inspected once.
pub(super) struct Pictures<'a> {
    document: &'a Document<'a>,
    of_textures: HashMap<usize, Picture>,
}

impl<'a> Pictures<'a> {
    pub(super) fn new(document: &'a Document<'a>) -> Self {
        Self { document, of_textures: HashMap::new() }
    }

    /// Properties of a texel source's image; `None` if it has no texture.
    pub(super) fn of(&mut self, source: &Value) -> Option<Picture> {
        let (document, texture) = (self.document, index(source.get("texture")?, "index")?);
        Some(*self.of_textures.entry(texture).or_insert_with(|| Picture::of_texture(document, texture)))
    }

    /// Width and height of the map in a texel source, if known.
    pub(super) fn size(&mut self, source: &Value) -> Option<(usize, usize)> {
        match source.get("texture") {
            Some(_) => self.of(source)?.size,
            None => Some((index(source, "width")?, index(source, "height")?)),
        }
    }
}

#[cfg(test)]
mod tests {
    use image::{ImageFormat, RgbImage};

    use super::*;
    use crate::format::test_scenes::black_png;

    #[test]
    fn headers_tell_size_and_loss() {
        let mut jpeg = Cursor::new(vec![]);
        RgbImage::new(7, 5).write_to(&mut jpeg, ImageFormat::Jpeg).unwrap();
        let jpeg = jpeg.into_inner();
        let mut webp = vec![];
        image_webp::WebPEncoder::new(&mut webp).encode(&[9; 36], 4, 3, image_webp::ColorType::Rgb8).unwrap();
        let size = |width: usize, height: usize| Some((width, height));
        assert_eq!(Picture::of(&black_png(12, 3)), Picture { size: size(12, 3), loss: None });
        assert_eq!(Picture::of(&jpeg), Picture { size: size(7, 5), loss: Some("JPEG") });
        assert_eq!(Picture::of(&webp), Picture { size: size(4, 3), loss: None });
        for cut in [&jpeg[..4], &webp[..15], b"", b"GIF89a"] {
            assert_eq!(Picture::of(cut).size, None);
        }
    }
}
