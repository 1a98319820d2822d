//! Byte images and their lossless `WebP` form.

use std::io::Cursor;

use crate::format::error::Fault;
use image_webp::{ColorType, EncoderParams, WebPDecoder, WebPEncoder};

/// Largest side that `WebP` can represent.
pub(super) const MAX_SIDE: usize = 16384;

/// Row-major image of 8-bit texels with 3 or 4 channels, first row at the top.
pub(super) struct Texels {
    pub(super) width: usize,
    pub(super) height: usize,
    channels: usize,
    bytes: Vec<u8>,
}

impl Texels {
    /// Black, opaque RGBA image.
    pub(super) fn opaque(width: usize, height: usize) -> Self {
        Self { width, height, channels: 4, bytes: [0, 0, 0, 255].repeat(width * height) }
    }

    /// Texel `i`, row-major from the top left. Images without alpha are opaque.
    pub(super) fn at(&self, i: usize) -> [u8; 4] {
        let t = &self.bytes[i * self.channels..][..self.channels];
        [t[0], t[1], t[2], *t.get(3).unwrap_or(&255)]
    }

    /// All texels of an RGBA image.
    pub(super) fn rgba_mut(&mut self) -> &mut [[u8; 4]] {
        self.bytes.as_chunks_mut().0
    }

    /// Decodes a lossless `WebP` whose size `fits`. Faults have the byte offset up to which it was read.
    pub(super) fn decode(webp: &[u8], fits: impl FnOnce(usize, usize) -> Result<(), String>) -> Result<Self, Fault> {
        let mut cursor = Cursor::new(webp);
        let decoded = Self::read(&mut cursor, fits);
        decoded.map_err(|(expected, found)| Fault::byte(cursor.position() as usize, expected, found))
    }

    fn read(
        webp: &mut Cursor<&[u8]>,
        fits: impl FnOnce(usize, usize) -> Result<(), String>,
    ) -> Result<Self, (String, String)> {
        let lossless = |found: String| ("a lossless WebP image".to_owned(), found);
        let mut decoder = WebPDecoder::new(webp).map_err(|e| lossless(e.to_string()))?;
        if decoder.is_animated() || decoder.is_lossy() {
            return Err(lossless("a lossy or animated one, which cannot hold indices".to_owned()));
        }
        let (width, height) = decoder.dimensions();
        let (width, height) = (width as usize, height as usize);
        fits(width, height).map_err(|expected| (expected, format!("{width}×{height}")))?;
        let channels = if decoder.has_alpha() { 4 } else { 3 };
        let mut bytes = vec![0; width * height * channels];
        decoder.read_image(&mut bytes).map_err(|e| lossless(e.to_string()))?;
        Ok(Self { width, height, channels, bytes })
    }

    /// Encodes the image as lossless `WebP`.
    pub(super) fn encode(&self) -> Vec<u8> {
        // Prediction from neighbours improves the compression of means, and worsens that of indices.
        let candidates = [true, false].map(|predict| {
            let mut webp = vec![];
            let mut parameters = EncoderParams::default();
            parameters.use_predictor_transform = predict;
            let mut encoder = WebPEncoder::new(&mut webp);
            encoder.set_params(parameters);
            let color = if self.channels == 4 { ColorType::Rgba8 } else { ColorType::Rgb8 };
            encoder
                .encode(&self.bytes, self.width as u32, self.height as u32, color)
                .expect("encoding into memory an image of the declared size and at most 16384 a side cannot fail");
            webp
        });
        let [predicted, plain] = candidates;
        if predicted.len() <= plain.len() { predicted } else { plain }
    }
}
