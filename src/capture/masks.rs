//! Masks: which pixels of a photograph count.

use std::path::Path;

use image::imageops::{self, FilterType};
use image::metadata::Orientation;
use image::{DynamicImage, GrayImage};
use rayon::prelude::*;

use super::CaptureError;
use super::image_file::{Header, fitting, pixels};

/// Reads the mask at `path` at the size of its photograph, which was oriented by `orientation`: 255 where pixels count.
pub(super) fn mask(
    path: &Path,
    orientation: Orientation,
    (width, height): (u32, u32),
) -> Result<GrayImage, CaptureError> {
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

#[cfg(test)]
mod tests {
    use image::Rgba;

    use super::*;
    use crate::capture::testing::{capture_of, jpeg, oriented, png};
    use crate::capture::{LoadOptions, decode, open};

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
}
