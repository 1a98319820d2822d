//! Images: from a file to a picture that fits its pinhole camera.

use std::io::Cursor;
use std::path::{Path, PathBuf};

use image::imageops::{self, FilterType};
use image::metadata::Orientation;
use image::{DynamicImage, GrayImage, ImageDecoder, ImageError, ImageReader, Limits, Rgba, RgbaImage};
use rayon::prelude::*;

use super::distortion::{Distortion, Lens};
use super::photo::Photo;
use super::{CaptureError, View, error};
use crate::format::{MAX_BESIDE_PIXELS, max_pixel_ratio};
use crate::scene::Intrinsics;

/// Bytes at the start of an image file, which usually contain its size and EXIF.
const HEADER_BYTES: usize = 1 << 17;

/// Origin of a picture, and the processing that makes it fit its camera.
#[derive(Clone, Debug)]
pub struct ImageSource {
    pub(super) image: PathBuf,
    pub(super) mask: Option<PathBuf>,
    pub(super) orientation: Orientation,
    /// Lens at the size of the upright photograph.
    pub(super) lens: Lens,
    /// Size after downscaling.
    pub(super) size: (u32, u32),
    pub(super) held_out: Option<bool>,
    pub(super) time: Option<f64>,
    /// Whether the file has an alpha channel; nothing in it need be transparent.
    pub(super) stores_alpha: bool,
}

impl ImageSource {
    /// The image file.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.image
    }

    /// The mask file, if one is applied.
    #[must_use]
    pub fn mask(&self) -> Option<&Path> {
        self.mask.as_deref()
    }

    /// The lens the photograph was taken with, at its full upright size.
    #[must_use]
    pub fn lens(&self) -> &Lens {
        &self.lens
    }

    /// The same picture, to be shrunk to this size when decoded.
    pub(super) fn resized(&self, size: (u32, u32)) -> Self {
        Self { size, ..self.clone() }
    }

    /// Whether the capture itself puts this view into its test set; `None` if it has no split of its own.
    #[must_use]
    pub fn held_out(&self) -> Option<bool> {
        self.held_out
    }

    /// Time at which the photograph was taken, in the capture's own unit, if stated: `time` (D-NeRF, nerfstudio) or
    /// `timestep_index` (VHAP).
    #[must_use]
    pub fn time(&self) -> Option<f64> {
        self.time
    }
}

/// What the first bytes of an image say.
pub(super) struct Header {
    size: (u32, u32),
    orientation: Orientation,
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
fn pixels(path: &Path) -> Result<(DynamicImage, Orientation), CaptureError> {
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

/// Decodes the picture of a view: reads, orients, masks, undistorts and downscales it.
///
/// # Errors
/// If the image or its mask cannot be read, is truncated, or has changed its size since [`super::open`], or
/// undistortion leaves nothing of it.
pub fn decode(view: &View) -> Result<Photo, CaptureError> {
    let source = &view.source;
    let (width, height) = (source.lens.intrinsics.width, source.lens.intrinsics.height);
    let (mut image, _) = pixels(&source.image)?;
    image.apply_orientation(source.orientation);
    if (image.width(), image.height()) != (width, height) {
        let found = format!("{}×{}", image.width(), image.height());
        return Err(CaptureError::invalid(&source.image, "image size", format!("{width}×{height}"), found));
    }
    let mut rgba = image.into_rgba8();
    let has_alpha = rgba.pixels().any(|p| p[3] < 255);
    if let Some(path) = &source.mask {
        let mask = mask(path, source.orientation, (width, height))?;
        for (pixel, m) in rgba.pixels_mut().zip(mask.pixels()) {
            // Rounded product of two fractions of 255.
            pixel[3] = ((u32::from(pixel[3]) * u32::from(m[0]) + 127) / 255) as u8;
        }
    }
    let mut masked = source.mask.is_some();
    if source.lens.distortion != Distortion::None {
        let (pinhole, outside) = source.lens.rectify(&rgba);
        let shows = |rgba: &[u8]| rgba.iter().skip(3).step_by(4).any(|alpha| *alpha > 0);
        if shows(&rgba) && !shows(&pinhole) {
            let expected = "one that leaves a pinhole image";
            let found = "none of the photograph in it";
            return Err(CaptureError::invalid(&source.image, "lens distortion", expected, found));
        }
        masked |= outside && !has_alpha;
        rgba = RgbaImage::from_raw(width, height, pinhole).expect("rectify keeps the size");
    }
    let (width, height) = source.size;
    let rgba = resize(rgba, width, height).into_raw();
    Ok(Photo { width, height, rgba, has_alpha, masked })
}

/// Reads the mask at `path` at the size of its photograph, which was oriented by `orientation`: 255 where pixels count.
fn mask(path: &Path, orientation: Orientation, (width, height): (u32, u32)) -> Result<GrayImage, CaptureError> {
    let (mut image, own) = pixels(path)?;
    let header = Header { size: (image.width(), image.height()), orientation: own, has_alpha: false };
    // Oriented like its photograph: as stored if that is, else by its own EXIF note or, without one, by the
    // photograph's.
    let stored = header.stored();
    let turned = [header.upright(), stored, Header { orientation, ..header }.upright()];
    let ways = if orientation == Orientation::NoTransforms { [stored, turned[0], stored] } else { turned };
    let Some((turn, size)) = fitting(ways, (width, height)) else {
        let (expected, (w, h)) = (format!("the aspect ratio of its image, {width}×{height}"), ways[0].1);
        return Err(CaptureError::invalid(path, "mask size", expected, format!("{w}×{h}")));
    };
    image.apply_orientation(turn);
    let mask = weights(image);
    if size == (width, height) {
        return Ok(mask);
    }
    Ok(imageops::resize(&mask, width, height, FilterType::Triangle))
}

/// Weight of each pixel of a mask: its lightness times opacity, or 1 if the mask has only one level besides black, as
/// for labels: COLMAP takes everything that is not black for white.
fn weights(mask: DynamicImage) -> GrayImage {
    let (size, levels) = ((mask.width(), mask.height()), levels(mask));
    let most = match lightest(&levels) {
        Some((level, true)) => level,
        _ => WHITE,
    };
    // Rounded.
    let weight = |level| ((255 * u64::from(level) + u64::from(most / 2)) / u64::from(most)) as u8;
    let weights = levels.into_iter().map(weight).collect();
    GrayImage::from_raw(size.0, size.1, weights).expect("a weight per pixel")
}

/// Level of a white, opaque pixel of a mask.
const WHITE: u32 = 65_535_u32.pow(2);

/// Lightness times opacity of each pixel of a mask.
fn levels(mask: DynamicImage) -> Vec<u32> {
    // In 16 bits, as 16-bit labels would be 0 in 8.
    mask.into_luma_alpha16().pixels().map(|p| u32::from(p[0]) * u32::from(p[1])).collect()
}

/// Highest level of a mask, and whether it is the only one besides black; `None` if all is black.
fn lightest(levels: &[u32]) -> Option<(u32, bool)> {
    let level = levels.iter().copied().max().filter(|level| *level > 0)?;
    Some((level, levels.iter().all(|other| [0, level].contains(other))))
}

/// Number of masks checked at once.
const MASKS_AT_ONCE: usize = 4;

/// Rejects masks that are labels of several things, which would be weighted by their label numbers, and masks that
/// leave nothing.
pub(super) fn check_masks(masks: &[&Path]) -> Result<(), CaptureError> {
    // Highest level of all masks, and a mask with several levels.
    let mut found: (u32, Option<&Path>) = (0, None);
    for some in masks.chunks(MASKS_AT_ONCE) {
        let look = |path: &&Path| Ok(lightest(&levels(pixels(path)?.0)));
        let lightest = some.par_iter().map(look).collect::<Result<Vec<_>, CaptureError>>()?;
        for (&path, lightest) in some.iter().zip(lightest) {
            let Some((level, is_one)) = lightest else { continue };
            found = (found.0.max(level), found.1.or((!is_one).then_some(path)));
        }
        // Usually the first masks suffice.
        if found.0 >= WHITE / 2 {
            return Ok(());
        }
    }
    let of_255 = 255.0 * f64::from(found.0) / f64::from(WHITE);
    let (path, found) = match (found, masks.first()) {
        ((0, _), Some(first)) => (*first, "black alone, as in all masks".to_owned()),
        ((_, Some(several)), _) => (several, format!("several levels, none in any mask above {of_255:.1} of 255")),
        _ => return Ok(()),
    };
    let expected = "white, or a single level besides black, where a photograph counts";
    Err(CaptureError::invalid(path, "mask", expected, found))
}

/// Resizes bicubically (a = −½) with the support scaled by the factor, as Pillow does. Colours are weighted by alpha.
fn resize(rgba: RgbaImage, width: u32, height: u32) -> RgbaImage {
    if rgba.dimensions() == (width, height) {
        return rgba;
    }
    if rgba.pixels().all(|p| p[3] == 255) {
        return imageops::resize(&rgba, width, height, FilterType::CatmullRom);
    }
    // Premultiplied, in units of 2/255²: the kernel overshoots by up to an eighth, which must not saturate.
    let mut weighted = image::ImageBuffer::<Rgba<u16>, Vec<u16>>::new(rgba.width(), rgba.height());
    for (w, p) in weighted.pixels_mut().zip(rgba.pixels()) {
        let alpha = u16::from(p[3]);
        *w = Rgba([p[0], p[1], p[2], 255].map(|c| u16::from(c) * alpha / 2));
    }
    drop(rgba);
    let weighted = imageops::resize(&weighted, width, height, FilterType::CatmullRom);
    let mut out = RgbaImage::new(width, height);
    for (p, w) in out.pixels_mut().zip(weighted.pixels()) {
        let alpha = (f32::from(w[3]) / 127.5).round().min(255.0);
        if alpha > 0.0 {
            let color = |c: u16| (255.0 * f32::from(c) / f32::from(w[3])).round().min(255.0) as u8;
            *p = Rgba([color(w[0]), color(w[1]), color(w[2]), alpha as u8]);
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::super::tests::{cameras_bin, write_capture};
    use super::super::{Downscale, LoadOptions, cameras, open};
    use super::*;
    use crate::format::test_scenes::{black_png, profiled_png};
    use image::RgbImage;

    /// A 16×8 JPEG with a bright top-left quarter.
    fn jpeg() -> Vec<u8> {
        let image = GrayImage::from_fn(16, 8, |x, y| image::Luma([if x < 8 && y < 4 { 250 } else { 5 }]));
        let mut bytes = Vec::new();
        image::codecs::jpeg::JpegEncoder::new_with_quality(&mut bytes, 100).encode_image(&image).unwrap();
        bytes
    }

    /// [`jpeg`] with an EXIF orientation, and with an end-of-image marker inside the EXIF block, as a thumbnail has.
    fn oriented(orientation: u8) -> Vec<u8> {
        let mut exif = b"Exif\0\0MM\0\x2a\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0".to_vec();
        exif.extend([orientation, 0, 0, 0, 0, 0, 0, 0xff, 0xd9]);
        let length = (exif.len() as u16 + 2).to_be_bytes();
        let bytes = jpeg();
        [&bytes[..2], &[0xff, 0xe1], &length, &exif, &bytes[2..]].concat()
    }

    /// A capture of two `width`×`height` cameras whose first image has these bytes.
    fn capture_of(bytes: &[u8], width: u32, height: u32) -> tempfile::TempDir {
        let folder = tempfile::tempdir().unwrap();
        write_capture(folder.path(), 2, width, height);
        std::fs::write(folder.path().join("images/00.png"), bytes).unwrap();
        folder
    }

    /// First picture of [`capture_of`] these bytes.
    fn photo_of(bytes: &[u8], width: u32, height: u32, downscale: Downscale) -> Result<Photo, CaptureError> {
        let folder = capture_of(bytes, width, height);
        let capture = open(folder.path(), &LoadOptions { downscale, ..LoadOptions::default() })?;
        decode(&capture.views[0])
    }

    fn png(image: &DynamicImage) -> Vec<u8> {
        let mut bytes = Cursor::new(Vec::new());
        image.write_to(&mut bytes, image::ImageFormat::Png).unwrap();
        bytes.into_inner()
    }

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

    /// A mask is rotated by its EXIF orientation exactly if its photograph is.
    #[test]
    fn masks_are_turned_as_their_photographs() {
        // White at the top left as stored in the photograph, and upright for orientation 6.
        let upright = || {
            DynamicImage::ImageLuma8(GrayImage::from_fn(8, 16, |x, y| {
                image::Luma([if x >= 4 && y < 8 { 255 } else { 0 }])
            }))
        };
        for (photograph, mask, (width, height)) in [
            (oriented(3), oriented(3), (16, 8)),
            (oriented(6), oriented(6), (16, 8)),
            (jpeg(), oriented(3), (16, 8)),
            (oriented(6), oriented(6), (8, 16)),
            (oriented(6), jpeg(), (8, 16)),
            (oriented(6), png(&upright()), (8, 16)),
        ] {
            let folder = capture_of(&photograph, width, height);
            std::fs::create_dir(folder.path().join("masks")).unwrap();
            for name in ["00.png", "01.png"] {
                std::fs::write(folder.path().join("masks").join(name), &mask).unwrap();
            }
            let options = LoadOptions { masks: true, ..LoadOptions::default() };
            let photo = decode(&open(folder.path(), &options).unwrap().views[0]).unwrap();
            let pixels = photo.rgba.chunks_exact(4);
            assert!(pixels.clone().all(|p| (p[0] > 125) == (p[3] > 125)), "{width}×{height}");
            assert_eq!(pixels.filter(|p| p[3] > 125).count(), 32, "{width}×{height}");
        }
    }

    #[test]
    fn lenses_that_leave_nothing_of_a_photograph_are_refused() {
        let (folder, (w, h)) = (capture_of(&png(&DynamicImage::new_rgb8(16, 8)), 16, 8), (16.0, 8.0));
        let with = |k: f64| {
            let cameras = cameras_bin(2, 16, 8, &[w, w / 2.0, h / 2.0, k]);
            std::fs::write(folder.path().join("sparse/0/cameras.bin"), cameras).unwrap();
            decode(&open(folder.path(), &LoadOptions::default()).unwrap().views[0])
        };
        assert!(with(-0.1).is_ok());
        let said = with(-1e6).unwrap_err().to_string();
        assert!(
            said.ends_with(
                "00.png: lens distortion: expected one that leaves a pinhole image, found none of the photograph in it"
            ),
            "{said}"
        );
    }

    /// Without a mask nothing is masked, whatever the lens, unless it is extreme. Cameras are the same when read
    /// without photographs.
    #[test]
    fn pinholes_are_within_their_photographs() {
        let folder = capture_of(&png(&DynamicImage::new_rgb8(160, 80)), 160, 80);
        let options = |downscale, masks| LoadOptions { downscale, masks, ..LoadOptions::default() };
        std::fs::create_dir(folder.path().join("masks")).unwrap();
        for name in ["00.png", "01.png"] {
            GrayImage::from_pixel(160, 80, image::Luma([255])).save(folder.path().join("masks").join(name)).unwrap();
        }
        let opened = |k: f64, options: LoadOptions| {
            let cameras = cameras_bin(2, 160, 80, &[80.0, 80.0, 40.0, k]);
            std::fs::write(folder.path().join("sparse/0/cameras.bin"), cameras).unwrap();
            let view = open(folder.path(), &options).unwrap().views.remove(0);
            (*view.camera.intrinsics(), decode(&view).unwrap())
        };
        for (k, is_closer, is_blank) in [(-0.04, false, false), (0.04, true, false), (20.0, false, true)] {
            let (pinhole, photo) = opened(k, options(Downscale::Full, false));
            assert_eq!((photo.masked, photo.has_alpha), (is_blank, false), "{k}");
            assert_eq!(photo.rgba.chunks_exact(4).any(|pixel| pixel[3] < 255), is_blank, "{k}");
            assert!(
                if is_closer { (81.0..88.0).contains(&pinhole.fx) } else { pinhole.fx == 80.0 },
                "{k}: {pinhole:?}"
            );
            assert_eq!(pinhole, Intrinsics { fy: pinhole.fx, cx: 80.0, cy: 40.0, ..pinhole });
            let (half, photo) = opened(k, options(Downscale::Factor(2), true));
            assert_eq!((half, photo.masked), (pinhole.resized(80, 40), true), "{k}");
            let alone = || cameras(folder.path(), &options(Downscale::Full, false)).unwrap().cameras[0].1;
            let with = alone();
            let (photograph, away) = (folder.path().join("images/00.png"), folder.path().join("00.png"));
            std::fs::rename(&photograph, &away).unwrap();
            assert_eq!((*with.intrinsics(), alone()), (pinhole, with), "{k}");
            std::fs::rename(away, photograph).unwrap();
        }
    }

    /// Columns 0 to 4 of 16 have the first colour.
    fn labelled<P: image::Pixel>(label: P, rest: P) -> DynamicImage
    where
        DynamicImage: From<image::ImageBuffer<P, Vec<P::Subpixel>>>,
    {
        image::ImageBuffer::from_fn(16, 8, |x, _| if x < 5 { label } else { rest }).into()
    }

    /// As in COLMAP, every pixel that is not black counts, whatever its label number or palette colour.
    #[test]
    fn masks_of_labels_are_masks() {
        use image::{Luma, LumaA, Rgb};
        for mask in [
            labelled(Luma([1_u8]), Luma([0])),
            labelled(Luma([3_u8]), Luma([0])),
            labelled(Luma([1_u16]), Luma([0])),
            labelled(Rgb([128_u8, 0, 0]), Rgb([0; 3])),
            labelled(Rgba([255_u8; 4]), Rgba([255, 255, 255, 0])),
        ] {
            assert!(weights(mask).enumerate_pixels().all(|(x, _, p)| p[0] == if x < 5 { 255 } else { 0 }));
        }
        let whole = DynamicImage::ImageLuma8(GrayImage::from_pixel(16, 8, Luma([255])));
        assert!(weights(whole).iter().all(|w| *w == 255));
        assert!(weights(DynamicImage::new_luma8(16, 8)).iter().all(|w| *w == 0));
        // Several levels are fractions.
        let shares = image::ImageBuffer::from_fn(256, 1, |x, _| LumaA([x as u8, if x == 9 { 0 } else { 255 }]));
        assert!(weights(shares.into()).iter().enumerate().all(|(x, w)| usize::from(*w) == if x == 9 { 0 } else { x }));
    }

    #[test]
    fn masks_leave_out_what_they_have_black() {
        let folder = capture_of(&jpeg(), 16, 8);
        std::fs::create_dir(folder.path().join("masks")).unwrap();
        for name in ["00.png", "01.png"] {
            labelled(image::Luma([2_u8]), image::Luma([0])).save(folder.path().join("masks").join(name)).unwrap();
        }
        let options = LoadOptions { masks: true, ..LoadOptions::default() };
        let photo = decode(&open(folder.path(), &options).unwrap().views[0]).unwrap();
        assert!(photo.rgba.chunks_exact(4).enumerate().all(|(i, p)| p[3] == if i % 16 < 5 { 255 } else { 0 }));
    }

    #[test]
    fn masks_of_several_labels_or_of_nothing_are_refused() {
        let folder = capture_of(&jpeg(), 16, 8);
        std::fs::create_dir(folder.path().join("masks")).unwrap();
        let labels = |levels: [u8; 2]| {
            GrayImage::from_fn(16, 8, |x, _| image::Luma([[0, levels[0], levels[1]][x as usize / 6]]))
        };
        let options = LoadOptions { masks: true, ..LoadOptions::default() };
        let opened = |first: [u8; 2], second: [u8; 2]| {
            for (name, levels) in [("00.png", first), ("01.png", second)] {
                labels(levels).save(folder.path().join("masks").join(name)).unwrap();
            }
            open(folder.path(), &options).map_err(|e| e.to_string())
        };
        let refused = opened([1, 1], [1, 2]).unwrap_err();
        assert!(refused.contains("01.png: mask: expected white, or a single level besides black"), "{refused}");
        assert!(refused.ends_with("found several levels, none in any mask above 2.0 of 255"), "{refused}");
        let refused = opened([0, 0], [0, 0]).unwrap_err();
        assert!(
            refused.contains("00.png: mask: ") && refused.ends_with("found black alone, as in all masks"),
            "{refused}"
        );
        // A single label per mask; and fractions, of which one view may contain only faint ones.
        for (first, second) in [([1, 1], [2, 2]), ([0, 0], [3, 3]), ([1, 2], [9, 255])] {
            assert!(opened(first, second).is_ok(), "{first:?} {second:?}");
        }
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

    /// Evaluation protocols that downscale pictures on loading use Pillow: `Image.resize((5, 4), BICUBIC)` of this
    /// picture by Pillow 13.0.0. Pillow rounds between the two directions, and we do not.
    #[test]
    fn pictures_are_made_smaller_as_by_pillow() {
        let picture = RgbaImage::from_fn(13, 11, |x, y| {
            let stripes = if (y / 2 + x / 3) % 2 == 1 { 250 } else { 3 };
            Rgba([((y * 37 + x * 91) % 256) as u8, ((y * x * 29 + x * 7) % 256) as u8, stripes, 255])
        });
        #[rustfmt::skip]
        let expected: [u8; 60] = [
            97, 34, 88, 118, 84, 154, 132, 128, 110, 146, 81, 129, 116, 111, 143,
            136, 87, 124, 109, 145, 128, 120, 146, 125, 136, 142, 127, 150, 119, 128,
            113, 114, 150, 131, 135, 110, 110, 152, 136, 117, 125, 125, 135, 103, 117,
            109, 63, 95, 120, 117, 149, 133, 127, 113, 112, 100, 129, 110, 133, 140,
        ];
        let found = resize(picture, 5, 4);
        let differences: Vec<u8> =
            (found.pixels().flat_map(|p| [p[0], p[1], p[2]]).zip(expected)).map(|(a, b)| a.abs_diff(b)).collect();
        let off = differences.iter().filter(|d| **d > 0).count();
        assert!(differences.len() == 60 && differences.iter().all(|d| *d <= 1) && off <= 15, "{off}: {differences:?}");
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
    fn sixteen_bits_and_grey_become_rgba8() {
        let deep = image::ImageBuffer::<image::LumaA<u16>, _>::from_pixel(4, 4, image::LumaA([0x8080, 0x4040]));
        let photo = photo_of(&png(&deep.into()), 4, 4, Downscale::Full).unwrap();
        assert_eq!(photo.rgba[..4], [0x80, 0x80, 0x80, 0x40]);
        assert!(photo.has_alpha && !photo.masked);
        let opaque = png(&DynamicImage::new_luma16(4, 4));
        assert!(!photo_of(&opaque, 4, 4, Downscale::Full).unwrap().has_alpha);
    }

    #[test]
    fn transparent_colours_do_not_bleed() {
        let sharp = RgbaImage::from_fn(16, 16, |x, _| if x < 6 { Rgba([200, 100, 50, 255]) } else { Rgba([0; 4]) });
        let photo = photo_of(&png(&sharp.into()), 16, 16, Downscale::Factor(4)).unwrap();
        for pixel in photo.rgba.chunks_exact(4).filter(|p| p[3] > 0) {
            // One level of rounding, and the error that 8-bit alpha causes for small weights.
            assert!(pixel[..3].iter().zip([200, 100, 50]).all(|(a, b)| a.abs_diff(b) <= 2), "{pixel:?}");
        }
        assert!((100..156).contains(&photo.rgba[4 + 3]), "half covered: {}", photo.rgba[4 + 3]);
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

    #[test]
    fn a_picture_that_changed_is_refused() {
        let folder = capture_of(&jpeg(), 16, 8);
        let view = open(folder.path(), &LoadOptions::default()).unwrap().views.remove(0);
        std::fs::write(view.source.path(), png(&DynamicImage::new_rgb8(8, 4))).unwrap();
        assert!(decode(&view).unwrap_err().to_string().contains("expected 16×8, found 8×4"));
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
