//! Image files: what their first bytes say, and their pixels as stored.

use std::io::Cursor;
use std::path::Path;

use image::metadata::Orientation;
use image::{DynamicImage, ImageDecoder, ImageError, ImageReader, Limits};

use super::{CaptureError, error};
use crate::format::{MAX_BESIDE_PIXELS, max_pixel_ratio};
use crate::scene::Intrinsics;

/// Bytes at the start of an image file, which usually contain its size and EXIF.
const HEADER_BYTES: usize = 1 << 17;

/// What the first bytes of an image say.
pub(super) struct Header {
    pub(super) size: (u32, u32),
    pub(super) orientation: Orientation,
    pub(super) has_alpha: bool,
}

impl Header {
    /// EXIF orientation, and the size of the picture after applying it.
    pub(super) fn upright(&self) -> (Orientation, (u32, u32)) {
        let (w, h) = self.size;
        let turned = matches!(
            self.orientation,
            Orientation::Rotate90 | Orientation::Rotate270 | Orientation::Rotate90FlipH | Orientation::Rotate270FlipH
        );
        (self.orientation, if turned { (h, w) } else { (w, h) })
    }

    /// Identity orientation, and the size of the picture as stored.
    pub(super) fn stored(&self) -> (Orientation, (u32, u32)) {
        (Orientation::NoTransforms, self.size)
    }
}

/// Chooses the orientation with which a picture has this size, or else the nearest aspect ratio, within 1 %; for a
/// nearly square picture several may qualify. Among equals the first is taken.
pub(super) fn fitting<const N: usize>(
    ways: [(Orientation, (u32, u32)); N],
    size: (u32, u32),
) -> Option<(Orientation, (u32, u32))> {
    let of_size = ways.into_iter().find(|way| way.1 == size);
    let by_aspect = || ways.into_iter().min_by(|a, b| off_aspect(a.1, size).total_cmp(&off_aspect(b.1, size)));
    // Resized pictures are rounded to whole pixels.
    of_size.or_else(|| by_aspect().filter(|way| off_aspect(way.1, size) <= 0.01))
}

/// Relative difference of the aspect ratios of two sizes.
fn off_aspect(a: (u32, u32), b: (u32, u32)) -> f64 {
    let ratio = |(w, h): (u32, u32)| f64::from(w) / f64::from(h);
    (ratio(a) / ratio(b) - 1.0).abs()
}

fn image_error(path: &Path, length: usize, error: &ImageError) -> CaptureError {
    match error {
        ImageError::IoError(e) if e.kind() == std::io::ErrorKind::UnexpectedEof => {
            CaptureError::Truncated { path: path.into(), offset: length, expected: "more image data".into() }
        }
        // Decoders put line breaks into some messages.
        other => CaptureError::Image { path: path.into(), reason: other.to_string().replace('\n', " ") },
    }
}

/// Decoder for `bytes`, the beginning of a file of `length` bytes; the size of the picture has been checked.
fn decoder<'a>(bytes: &'a [u8], length: usize, path: &Path) -> Result<impl ImageDecoder + 'a, CaptureError> {
    let mut reader = ImageReader::new(Cursor::new(bytes))
        .with_guessed_format()
        .map_err(|e| image_error(path, bytes.len(), &e.into()))?;
    // Not for pixels, whose number is limited below.
    let mut limits = Limits::no_limits();
    limits.max_alloc = Some(MAX_BESIDE_PIXELS);
    reader.limits(limits);
    let decoder = reader.into_decoder().map_err(|e| image_error(path, bytes.len(), &e))?;
    let (w, h) = decoder.dimensions();
    if !Intrinsics::is_size(w, h) {
        let expected = format!("1 to {} pixels, at most {} a side", Intrinsics::MAX_PIXELS, Intrinsics::MAX_SIDE);
        return Err(CaptureError::invalid(path, "image size", expected, format!("{w}×{h}")));
    }
    let least = decoder.total_bytes() / max_pixel_ratio(bytes);
    if least > length as u64 {
        let expected = format!("{w}×{h} pixels in {least} bytes");
        return Err(CaptureError::Truncated { path: path.into(), offset: length, expected });
    }
    Ok(decoder)
}

/// Size and orientation of the image at `path`.
pub(super) fn header(path: &Path) -> Result<Header, CaptureError> {
    let read = |bytes: &[u8], length: usize| {
        let mut decoder = decoder(bytes, length, path)?;
        let size = decoder.dimensions();
        let orientation = decoder.orientation().map_err(|e| image_error(path, length, &e))?;
        Ok(Header { size, orientation, has_alpha: decoder.color_type().has_alpha() })
    };
    let (start, length) = error::read_start(path, HEADER_BYTES)?;
    if start.len() < length
        && let Ok(header) = read(&start, length)
    {
        return Ok(header);
    }
    // Long profiles or previews may come first, or the file is faulty.
    let bytes = error::read(path)?;
    read(&bytes, bytes.len())
}

/// All pixels of the image at `path` as stored, and the orientation its EXIF data gives.
pub(super) fn pixels(path: &Path) -> Result<(DynamicImage, Orientation), CaptureError> {
    let bytes = error::read(path)?;
    // The JPEG decoder fills missing data with grey.
    if bytes.starts_with(&[0xff, 0xd8]) && !jpeg_is_complete(&bytes) {
        let expected = "the end-of-image marker of a JPEG".into();
        return Err(CaptureError::Truncated { path: path.into(), offset: bytes.len(), expected });
    }
    let mut decoder = decoder(&bytes, bytes.len(), path)?;
    let orientation = decoder.orientation().map_err(|e| image_error(path, bytes.len(), &e))?;
    let image = DynamicImage::from_decoder(decoder).map_err(|e| image_error(path, bytes.len(), &e))?;
    Ok((image, orientation))
}

/// Whether the segments of a JPEG lead to an end-of-image marker. (A search for the marker alone would find that
/// of an embedded thumbnail.)
fn jpeg_is_complete(bytes: &[u8]) -> bool {
    let mut at = 2;
    while let Some(&[first, marker]) = bytes.get(at..).and_then(|b| b.first_chunk()) {
        match (first, marker) {
            (0xff, 0xd9) => return true,
            // Fill bytes, stuffed zeros, restart markers and entropy-coded data have no length.
            (0xff, 0xff) => at += 1,
            (0xff, 0x00 | 0x01 | 0xd0..=0xd8) => at += 2,
            (0xff, _) => match bytes.get(at + 2..).and_then(|b| b.first_chunk()) {
                Some(&length) => at += 2 + usize::from(u16::from_be_bytes(length)),
                None => return false,
            },
            _ => at += 1,
        }
    }
    false
}

#[cfg(test)]
mod tests {
    use image::RgbImage;

    use super::*;
    use crate::capture::Downscale;
    use crate::capture::testing::{jpeg, oriented, photo_of, png};
    use crate::format::test_scenes::{black_png, profiled_png};

    #[test]
    fn exif_turns_pictures_of_which_only_the_upright_one_fits() {
        // Orientation 6 rotates by 90° clockwise: the bright quarter moves to the top right.
        let photo = photo_of(&oriented(6), 8, 16, Downscale::Full).unwrap();
        assert_eq!((photo.width, photo.height), (8, 16));
        assert!(photo.rgba[4 * 6] > 200 && photo.rgba[4] < 50);
        // With poses of the stored picture, it stays as it is.
        let photo = photo_of(&oriented(6), 16, 8, Downscale::Full).unwrap();
        assert!(photo.width == 16 && photo.rgba[0] > 200);
        // Of a nearly square picture that was resized, only the upright version has exactly the right proportions.
        let (stored, camera) = ((1004, 1000), (4000, 4016));
        let header = Header { size: stored, orientation: Orientation::Rotate90, has_alpha: false };
        let ways = [header.stored(), header.upright()];
        assert_eq!(fitting(ways, camera), Some((Orientation::Rotate90, (1000, 1004))));
        assert_eq!(fitting(ways, (camera.1, camera.0)), Some((Orientation::NoTransforms, stored)));
        // Orientation 3 is upside down, which sizes cannot reveal.
        let photo = photo_of(&oriented(3), 16, 8, Downscale::Full).unwrap();
        assert!(photo.rgba[0] > 200 && photo.rgba[4 * (16 * 8 - 1)] < 50);
    }

    #[test]
    fn truncated_pictures_are_refused() {
        // A PNG without its last chunk has all its pixels; a JPEG without its last marker cannot be told from one that
        // lacks more.
        let noise = RgbImage::from_fn(16, 8, |x, y| image::Rgb([x * 97, y * 101, x * y * 31].map(|v| (v % 251) as u8)));
        for (bytes, last) in [(oriented(1), 2), (png(&noise.into()), 40)] {
            assert!(photo_of(&bytes, 16, 8, Downscale::Full).is_ok());
            for cut in [bytes.len() - last, bytes.len() / 2, 60, 10, 0] {
                let found = photo_of(&bytes[..cut], 16, 8, Downscale::Full);
                let message = found.expect_err("must be refused").to_string();
                assert!(message.contains("00.png") && !message.contains('\n'), "{message}");
            }
        }
    }

    #[test]
    fn headers_are_not_believed() {
        let mut bytes = png(&DynamicImage::new_rgb8(16, 8));
        assert!(photo_of(&png(&DynamicImage::new_rgb8(4000, 3000)), 4000, 3000, Downscale::Factor(99)).is_ok());
        assert!(photo_of(&black_png(4000, 3000), 4000, 3000, Downscale::Factor(99)).is_ok());
        // IHDR chunk with 16384×16384 pixels and its checksum.
        let mut crc = !0u32;
        bytes[16..24].copy_from_slice(&[0, 0, 0x40, 0, 0, 0, 0x40, 0]);
        for &b in &bytes[12..29] {
            crc = (0..8).fold(crc ^ u32::from(b), |c, _| (c >> 1) ^ (0xedb8_8320 * (c & 1)));
        }
        bytes[29..33].copy_from_slice(&(!crc).to_be_bytes());
        let message = photo_of(&bytes, 16, 16, Downscale::Full).unwrap_err().to_string();
        assert!(message.contains("16384×16384 pixels"), "{message}");
        // Frame headers of a baseline JPEG, and of a progressive one, for which coefficients would be allocated as well.
        // The comment makes the file as long as a PNG of that size could be.
        let short = jpeg();
        let mut bytes = [&short[..2], &[0xff, 0xfe, 4, 0], &[0; 0x3fe], &short[2..]].concat();
        let frame = bytes.windows(2).position(|marker| marker == [0xff, 0xc0]).unwrap();
        bytes[frame + 5..frame + 9].copy_from_slice(&[0x10, 0, 0x10, 0]);
        for kind in [0xc0, 0xc2] {
            bytes[frame + 1] = kind;
            let message = photo_of(&bytes, 16, 16, Downscale::Full).unwrap_err().to_string();
            assert!(message.contains("expected 4096×4096 pixels in 4096 bytes"), "{kind:x}: {message}");
        }
    }

    #[test]
    fn headers_are_read_without_the_rest() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("picture");
        let found = |bytes: &[u8]| {
            std::fs::write(&path, bytes).unwrap();
            header(&path).map(|header| (header.orientation, header.size)).ok()
        };
        let expected = Some((Orientation::Rotate90, (16, 8)));
        let short = oriented(6);
        assert_eq!(found(&short), expected);
        // Of a file of a terabyte, only the beginning is read: the whole would not fit in memory.
        std::fs::OpenOptions::new().write(true).open(&path).unwrap().set_len(1 << 40).unwrap();
        assert_eq!(header(&path).map(|header| (header.orientation, header.size)).ok(), expected);
        // Colour profiles fill the beginning of the file.
        let profile = [&[0xff, 0xe2, 0xff, 0xff][..], &[0; 0xfffd]].concat();
        assert_eq!(found(&[&short[..2], &profile.repeat(3), &short[2..]].concat()), expected);
    }

    /// If a colour profile is too long, the picture is read without it.
    #[test]
    fn colour_profiles_unpack_to_little() {
        let profile = |bytes: usize| {
            let png = profiled_png(bytes);
            assert!(photo_of(&png, 1, 1, Downscale::Full).is_ok());
            let mut decoder = decoder(&png, png.len(), Path::new("a.png")).unwrap();
            decoder.icc_profile().unwrap().map(|profile| profile.len())
        };
        assert_eq!([1 << 20, 65 << 20].map(profile), [Some(1 << 20), None]);
    }

    proptest::proptest! {
        #[test]
        fn damaged_pictures_are_read_or_refused(at in 0.0..1.0f64, damage in proptest::collection::vec(0u8.., 1..8)) {
            let folder = tempfile::tempdir().unwrap();
            let path = folder.path().join("picture");
            for mut bytes in [oriented(6), png(&DynamicImage::new_rgba16(9, 7))] {
                let start = (at * bytes.len() as f64) as usize;
                let end = bytes.len().min(start + damage.len());
                bytes[start..end].copy_from_slice(&damage[..end - start]);
                std::fs::write(&path, &bytes).unwrap();
                let _ = header(&path);
                let _ = pixels(&path);
            }
        }
    }
}
