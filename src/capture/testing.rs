//! Image files and captures of them, for the tests of how pictures are read.

use std::io::Cursor;

use image::{DynamicImage, GrayImage};

use super::tests::write_capture;
use super::{CaptureError, Downscale, LoadOptions, Photo, decode, open};

/// A 16×8 JPEG with a bright top-left quarter.
pub(super) fn jpeg() -> Vec<u8> {
    let image = GrayImage::from_fn(16, 8, |x, y| image::Luma([if x < 8 && y < 4 { 250 } else { 5 }]));
    let mut bytes = Vec::new();
    image::codecs::jpeg::JpegEncoder::new_with_quality(&mut bytes, 100).encode_image(&image).unwrap();
    bytes
}

/// [`jpeg`] with an EXIF orientation, and with an end-of-image marker inside the EXIF block, as a thumbnail has.
pub(super) fn oriented(orientation: u8) -> Vec<u8> {
    let mut exif = b"Exif\0\0MM\0\x2a\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0".to_vec();
    exif.extend([orientation, 0, 0, 0, 0, 0, 0, 0xff, 0xd9]);
    let length = (exif.len() as u16 + 2).to_be_bytes();
    let bytes = jpeg();
    [&bytes[..2], &[0xff, 0xe1], &length, &exif, &bytes[2..]].concat()
}

/// A capture of two `width`×`height` cameras whose first image has these bytes.
pub(super) fn capture_of(bytes: &[u8], width: u32, height: u32) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    write_capture(folder.path(), 2, width, height);
    std::fs::write(folder.path().join("images/00.png"), bytes).unwrap();
    folder
}

/// First picture of [`capture_of`] these bytes.
pub(super) fn photo_of(bytes: &[u8], width: u32, height: u32, downscale: Downscale) -> Result<Photo, CaptureError> {
    let folder = capture_of(bytes, width, height);
    let capture = open(folder.path(), &LoadOptions { downscale, ..LoadOptions::default() })?;
    decode(&capture.views[0])
}

pub(super) fn png(image: &DynamicImage) -> Vec<u8> {
    let mut bytes = Cursor::new(Vec::new());
    image.write_to(&mut bytes, image::ImageFormat::Png).unwrap();
    bytes.into_inner()
}
