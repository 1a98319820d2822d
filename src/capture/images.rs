//! Pictures of views: from a file to a picture that fits its pinhole camera.

use std::ops::Deref;
use std::path::{Path, PathBuf};

use image::imageops::{self, FilterType};
use image::metadata::Orientation;
use image::{Rgba, RgbaImage};

use super::distortion::{Distortion, Lens};
use super::image_file::pixels;
use super::masks::mask;
use super::photo::Photo;
use super::{CaptureError, View};

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
    if rgba.dimensions() != source.size {
        rgba = resize(rgba, width, height);
    }
    Ok(Photo { width, height, rgba: rgba.into_raw(), has_alpha, masked })
}

/// A decoded picture, resized to this width and height as [`decode`] does.
pub(super) fn reduced(photo: &Photo, (width, height): (u32, u32)) -> Photo {
    if (photo.width, photo.height) == (width, height) {
        return photo.clone();
    }
    let rgba = image::ImageBuffer::<Rgba<u8>, &[u8]>::from_raw(photo.width, photo.height, &photo.rgba);
    let rgba = resize(rgba.expect("a picture has all its pixels"), width, height).into_raw();
    Photo { width, height, rgba, ..*photo }
}

/// Resizes bicubically (a = −½) with the support scaled by the factor, as Pillow does. Colours are weighted by alpha.
fn resize<C: Deref<Target = [u8]>>(rgba: image::ImageBuffer<Rgba<u8>, C>, width: u32, height: u32) -> RgbaImage {
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
    use image::{DynamicImage, GrayImage};

    use super::*;
    use crate::capture::testing::{capture_of, jpeg, photo_of, png};
    use crate::capture::tests::cameras_bin;
    use crate::capture::{Downscale, LoadOptions, cameras, open};
    use crate::scene::Intrinsics;

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

    /// Reduced pictures have the colours and the alpha of those that are downscaled when they are decoded.
    #[test]
    fn decoded_pictures_are_reduced_as_when_they_are_decoded() {
        let of = |alpha: u8| {
            RgbaImage::from_fn(16, 8, |x, y| Rgba([x as u8 * 15, y as u8 * 30, 90, if x > 5 { 255 } else { alpha }]))
        };
        for file in [0, 130, 255].map(|alpha| png(&of(alpha).into())) {
            let [whole, quarter] =
                [Downscale::Full, Downscale::Factor(4)].map(|downscale| photo_of(&file, 16, 8, downscale).unwrap());
            assert!(reduced(&whole, (4, 2)) == quarter && reduced(&whole, (16, 8)) == whole);
            let masked = Photo { masked: true, ..whole };
            assert_eq!(reduced(&masked, (4, 2)), Photo { masked: true, ..quarter });
        }
    }

    #[test]
    fn a_picture_that_changed_is_refused() {
        let folder = capture_of(&jpeg(), 16, 8);
        let view = open(folder.path(), &LoadOptions::default()).unwrap().views.remove(0);
        std::fs::write(view.source.path(), png(&DynamicImage::new_rgb8(8, 4))).unwrap();
        assert!(decode(&view).unwrap_err().to_string().contains("expected 16×8, found 8×4"));
    }
}
