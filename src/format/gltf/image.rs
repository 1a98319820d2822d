//! Decoding of a glTF file's textures.

use std::io::Cursor;

use image::error::LimitErrorKind;
use image::{ImageDecoder as _, ImageError};

use super::extension::WEBP;
use super::lift::Asset;
use super::uri::resolve;
use crate::format::error::Fault;
use crate::format::map_budget::{Identity, MapBudget, identity};
use crate::format::{MAX_BESIDE_PIXELS, MAX_PIXEL_RATIO, max_pixel_ratio};
use crate::scene::Texture;

/// Texels as stored, 0..1, without undoing a transfer function; rows from the top.
pub(in crate::format) struct Texels {
    pub(in crate::format) width: u32,
    pub(in crate::format) height: u32,
    pub(in crate::format) rgba: Vec<[f32; 4]>,
    /// Whether the image has 8-bit colours, which are conventionally sRGB if nothing is stated.
    pub(in crate::format) is_srgb_by_custom: bool,
    /// Identity of the encoded image.
    pub(in crate::format) encoded: Identity,
}

impl Asset {
    /// Decodes the image of texture `index`: PNG (8 or 16 bit), JPEG or WebP.
    pub(super) fn texels(&self, index: usize) -> Result<Texels, Fault> {
        texels(self.encoded(index)?)
    }

    /// Encoded image of texture `index`, and its place in the document.
    pub(super) fn encoded(&self, index: usize) -> Result<(String, Vec<u8>), Fault> {
        let json = self.document.as_json();
        let texture = self.document.textures().nth(index);
        let webp = texture.as_ref().and_then(|t| t.extension_value(WEBP)?.get("source")?.as_u64());
        let source = webp.map(|s| s as usize).or(json.textures.get(index).map(|t| t.source.value()));
        let Some((source, image)) = source.and_then(|s| Some((s, json.images.get(s)?))) else {
            return Err(Fault::pointer(format!("/textures/{index}"), "a texture with an image", "none"));
        };
        let at = format!("/images/{source}");
        let view = image.buffer_view.as_ref().and_then(|v| self.document.views().nth(v.value()));
        let encoded = match (view, &image.uri) {
            (Some(view), _) => self.view_bytes(&view)?.into_owned(),
            (None, Some(uri)) => resolve(uri, &self.folder)
                .map_err(|(expected, found)| Fault::pointer(format!("{at}/uri"), expected, found))?,
            (None, None) => return Err(Fault::pointer(at, "a bufferView or a uri", "neither")),
        };
        Ok((at, encoded))
    }
}

/// Decodes the result of [`Asset::encoded`].
pub(super) fn texels((at, encoded): (String, Vec<u8>)) -> Result<Texels, Fault> {
    decode(encoded).map_err(|(expected, found)| Fault::pointer(at, expected, found))
}

/// Media type of an image, by its first bytes.
pub(in crate::format) fn media_type(content: &[u8]) -> Option<&'static str> {
    match content {
        [0x89, b'P', b'N', b'G', ..] => Some("image/png"),
        [0xFF, 0xD8, 0xFF, ..] => Some("image/jpeg"),
        [b'R', b'I', b'F', b'F', _, _, _, _, b'W', b'E', b'B', b'P', ..] => Some("image/webp"),
        [0xAB, b'K', b'T', b'X', b' ', b'2', b'0', ..] => Some("image/ktx2"),
        [_, _, _, _, b'f', b't', b'y', b'p', b'a', b'v', b'i', b'f' | b's', ..] => Some("image/avif"),
        [b'D', b'D', b'S', b' ', ..] => Some("image/vnd-ms.dds"),
        _ => None,
    }
}

/// Expectation stated where an image is missing or unreadable.
const IMAGE: &str = "a PNG, JPEG or WebP image";

/// Expectation and finding for an image that cannot be decoded.
fn undecodable(error: &ImageError) -> (String, String) {
    match error {
        ImageError::Limits(limit) if limit.kind() == LimitErrorKind::DimensionError => {
            let expected = format!("{IMAGE} of at most {} pixels along each side", Texture::MAX_SIDE);
            (expected, "a larger one".to_owned())
        }
        ImageError::Limits(limit) if limit.kind() == LimitErrorKind::InsufficientMemory => {
            (format!("{IMAGE} with at most {MAX_BESIDE_PIXELS} bytes besides its pixels"), "more".to_owned())
        }
        _ => (IMAGE.to_owned(), error.to_string()),
    }
}

/// Decodes a PNG (8 or 16 bit), JPEG or `WebP`. On failure: expectation and finding.
pub(in crate::format) fn decode(encoded: Vec<u8>) -> Result<Texels, (String, String)> {
    let (encoded_bytes, ratio, identity) = (encoded.len() as u64, max_pixel_ratio(&encoded), identity(&encoded));
    if encoded.starts_with(b"RIFF") {
        return webp_texels(&encoded, identity);
    }
    let reader = image::ImageReader::new(Cursor::new(encoded)).with_guessed_format();
    let mut reader = reader.map_err(|e| undecodable(&ImageError::IoError(e)))?;
    let mut limits = image::Limits::default();
    limits.max_image_width = Some(Texture::MAX_SIDE);
    limits.max_image_height = Some(Texture::MAX_SIDE);
    limits.max_alloc = Some(MAX_BESIDE_PIXELS);
    reader.limits(limits);
    let decoder = reader.into_decoder().map_err(|e| undecodable(&e))?;
    let (width, height) = decoder.dimensions();
    let least = decoder.total_bytes() / ratio;
    if least > encoded_bytes {
        let expected = format!("{width}×{height} pixels in {least} bytes or more");
        return Err((expected, format!("{encoded_bytes} bytes")));
    }
    MapBudget::new(encoded_bytes).spend(4 * u64::from(width) * u64::from(height))?;
    let is_srgb_by_custom = matches!(decoder.color_type(), image::ColorType::Rgb8 | image::ColorType::Rgba8);
    let pixels = image::DynamicImage::from_decoder(decoder).map_err(|e| undecodable(&e))?.into_rgba32f();
    let rgba = pixels.pixels().map(|p| p.0).collect();
    Ok(Texels { width: pixels.width(), height: pixels.height(), rgba, is_srgb_by_custom, encoded: identity })
}

fn webp_texels(encoded: &[u8], identity: Identity) -> Result<Texels, (String, String)> {
    // WebP codes an image of one colour in almost no bits: up to this size any ratio is accepted.
    const SMALL: usize = 1 << 24;
    let undecodable = |e: image_webp::DecodingError| (IMAGE.to_owned(), e.to_string());
    let mut decoder = image_webp::WebPDecoder::new(Cursor::new(encoded)).map_err(undecodable)?;
    let (width, height) = decoder.dimensions();
    let channels = if decoder.has_alpha() { 4 } else { 3 };
    let size = decoder.output_buffer_size().unwrap_or(usize::MAX);
    if size > SMALL && size as u64 / MAX_PIXEL_RATIO > encoded.len() as u64 {
        return Err((IMAGE.to_owned(), format!("{width}×{height} pixels in {} bytes", encoded.len())));
    }
    MapBudget::of(encoded).spend(4 * u64::from(width) * u64::from(height))?;
    let mut bytes = vec![0; size];
    decoder.read_image(&mut bytes).map_err(undecodable)?;
    let rgba = bytes.chunks_exact(channels).map(|p| {
        let unit = |c: usize| p.get(c).map_or(1.0, |b| f32::from(*b) / 255.0);
        [0, 1, 2, 3].map(unit)
    });
    Ok(Texels { width, height, rgba: rgba.collect(), is_srgb_by_custom: true, encoded: identity })
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;
    use crate::format::test_scenes::black_png;

    /// One bit per pixel, compressed by deflate to a thousandth.
    #[test]
    fn images_of_one_colour_are_short() {
        let folder = tempfile::tempdir().unwrap();
        let short = black_png(2048, 2048);
        assert!(short.len() < 1024, "{} bytes", short.len());
        std::fs::write(folder.path().join("a.png"), short).unwrap();
        let json =
            br#"{ "asset": { "version": "2.0" }, "images": [{ "uri": "a.png" }], "textures": [{ "source": 0 }] }"#;
        let asset = Asset::parse(json, folder.path().to_owned()).map_err(|_| ()).unwrap();
        let texels = asset.texels(0).map_err(|e| e.in_file(Path::new("f")).to_string()).unwrap();
        assert_eq!((texels.width, texels.rgba[0]), (2048, [0.0, 0.0, 0.0, 1.0]));
    }

    #[test]
    fn kinds_of_pictures_are_told_by_their_first_bytes() {
        let avif = b"\0\0\0\x1cftypavif\0\0\0\0";
        assert_eq!(media_type(avif), Some("image/avif"));
        assert_eq!(media_type(&black_png(1, 1)), Some("image/png"));
        assert_eq!((media_type(b"DDS |"), media_type(b"GIF89a")), (Some("image/vnd-ms.dds"), None));
    }

    #[test]
    fn the_largest_side_is_named_where_one_is_longer() {
        let (expected, found) = decode(black_png(60_000, 1)).err().unwrap();
        let limit = "a PNG, JPEG or WebP image of at most 16384 pixels along each side";
        assert_eq!((&*expected, &*found), (limit, "a larger one"));
    }

    #[test]
    fn what_an_image_may_unpack_to_is_limited() {
        // About 30 kB that decompress to 33 MB of rows would need 4 GB of floats.
        let (expected, found) = decode(black_png(16384, 16384)).err().unwrap();
        assert!(expected.starts_with("maps of at most ") && found == "4294967296 bytes", "{expected}, {found}");
    }

    #[test]
    fn an_image_header_that_claims_more_than_its_file_can_hold_is_refused() {
        let mut jpeg = Cursor::new(vec![]);
        image::RgbImage::new(8, 8).write_to(&mut jpeg, image::ImageFormat::Jpeg).unwrap();
        let mut jpeg = jpeg.into_inner();
        let frame_header = jpeg.windows(2).position(|w| w == [0xff, 0xc0]).unwrap();
        jpeg[frame_header + 5..frame_header + 9].copy_from_slice(&[0x40, 0, 0x40, 0]);
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("a.jpg"), jpeg).unwrap();
        let json =
            br#"{ "asset": { "version": "2.0" }, "images": [{ "uri": "a.jpg" }], "textures": [{ "source": 0 }] }"#;
        let asset = Asset::parse(json, folder.path().to_owned()).map_err(|_| ()).unwrap();
        let message = asset.texels(0).err().unwrap().in_file(Path::new("f")).to_string();
        assert!(message.starts_with("f: /images/0: expected 16384×16384 pixels in 196608 bytes"), "{message}");
    }
}
