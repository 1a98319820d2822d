//! `OpenEXR` writer for images with any number of named channels, and for maps, including the metadata needed to
//! interpret them.

use std::io::Cursor;
use std::path::Path;

use exr::meta::attribute::{AttributeValue, Chromaticities, Text};
use exr::prelude::{
    AnyChannel, AnyChannels, Compression, Encoding, FlatSamples, Image, Layer, LayerAttributes, LineOrder,
    WritableImage as _, f16,
};

use super::error::Fault;
use super::{FormatError, atomic_write};
use crate::scene::{ColorSpace, Intrinsics, Texture};

/// Sample type of stored channels.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum SampleType {
    /// 32 bits.
    #[default]
    Float,
    /// 16 bits, but 32 for channels that are [`Channel::precise`].
    Half,
}

/// Lossless compression methods.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ExrCompression {
    /// Deflate in blocks of 16 lines, which every program reads.
    #[default]
    Zip,
    /// Wavelets; smaller for noisy images.
    Piz,
}

/// Channel of an image.
#[derive(Clone, Debug, PartialEq)]
pub struct Channel {
    /// Name of the channel: `R`, `splats.R`, `Z`; in Latin-1, as EXR requires.
    pub name: String,
    /// Samples `[height·width]`, row-major from the top.
    pub values: Vec<f32>,
    /// Whether the channel needs more than 16 bits, as depths and counts do.
    pub precise: bool,
}

/// Content of the header besides the size.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ExrHeader {
    /// Colour space of the colour channels. Rec. 709 primaries in either case.
    pub color_space: ColorSpace,
    /// Width of a pixel over its height, see [`pixel_aspect`].
    pub pixel_aspect: f32,
    /// Comment of a sentence or two for whoever opens the file.
    pub comment: String,
    /// Sample type.
    pub samples: SampleType,
    /// Compression method.
    pub compression: ExrCompression,
}

/// Pixel aspect ratio (width over height) of a camera: focal lengths are in pixels, so that the narrower side of a
/// pixel has the larger one.
#[must_use]
pub fn pixel_aspect(k: &Intrinsics) -> f32 {
    (k.fy / k.fx) as f32
}

/// Writes `channels` as a single-part file. `colorSpace` in the header is `lin_rec709_display` or
/// `srgb_rec709_display`; the standard attribute `chromaticities` states Rec. 709. The header entry is needed for
/// sRGB-encoded images, because EXR is assumed to be linear.
///
/// # Errors
/// If the file cannot be written, there is no pixel or no channel, or a channel's name is not Latin-1 or not unique.
///
/// # Panics
/// If a channel has another length than `width`·`height`.
pub fn write_exr(
    path: &Path,
    [width, height]: [u32; 2],
    channels: Vec<Channel>,
    header: &ExrHeader,
) -> Result<(), FormatError> {
    let size = (width as usize, height as usize);
    let sampled = |channel: Channel| {
        let name = Text::new_or_none(&channel.name)
            .ok_or_else(|| Fault::whole("names of channels in Latin-1", format!("`{}`", channel.name)).in_file(path))?;
        assert_eq!(channel.values.len(), size.0 * size.1, "{}", channel.name);
        let samples = if header.samples == SampleType::Half && !channel.precise {
            FlatSamples::F16(channel.values.into_iter().map(f16::from_f32).collect())
        } else {
            FlatSamples::F32(channel.values)
        };
        Ok::<_, FormatError>(AnyChannel::new(name, samples))
    };
    let channels = channels.into_iter().map(sampled).collect::<Result<_, FormatError>>()?;
    let channels = AnyChannels::sort(channels);
    let text = |s: &str| AttributeValue::Text(Text::new_or_panic(s));
    let mut attributes =
        LayerAttributes { software_name: Some(Text::new_or_panic("centaur")), ..LayerAttributes::default() };
    attributes.comments = Text::new_or_none(&header.comment);
    attributes.other.insert(Text::new_or_panic("colorSpace"), text(header.color_space.name()));
    let compression = match header.compression {
        ExrCompression::Zip => Compression::ZIP16,
        ExrCompression::Piz => Compression::PIZ,
    };
    let encoding = Encoding { compression, ..Encoding::SMALL_LOSSLESS };
    let mut image = Image::from_layer(Layer::new(size, attributes, encoding, channels));
    image.attributes.pixel_aspect = header.pixel_aspect;
    image.attributes.chromaticities = Some(REC_709);
    let failed = |reason| FormatError::Write { file: path.to_owned(), source: std::io::Error::other(reason) };
    atomic_write(path, &bytes(&image).map_err(failed)?)
}

/// Encodes a file whose channel `names[i]` holds channel `first + i` of `map`, as 32-bit floats. Rows as in the map,
/// the first at the top.
pub(super) fn encode(map: &Texture, first: usize, names: &[impl AsRef<str>]) -> Result<Vec<u8>, String> {
    let channels = map.channels() as usize;
    let plane = |c: usize| map.texels().iter().skip(c).step_by(channels).copied().collect();
    let named =
        |(i, name): (usize, &_)| AnyChannel::new(AsRef::<str>::as_ref(name), FlatSamples::F32(plane(first + i)));
    let planes = AnyChannels::sort(names.iter().enumerate().map(named).collect());
    let size = (map.width() as usize, map.height() as usize);
    // Without a fixed line order, tiles are written in the order in which threads finish, and encoding would not be
    // reproducible.
    let encoding = Encoding { line_order: LineOrder::Increasing, ..Encoding::SMALL_FAST_LOSSLESS };
    bytes(&Image::from_layer(Layer::new(size, LayerAttributes::default(), encoding, planes)))
}

fn bytes(image: &Image<Layer<AnyChannels<FlatSamples>>>) -> Result<Vec<u8>, String> {
    let mut file = Cursor::new(vec![]);
    image.write().to_buffered(&mut file).map_err(|e| e.to_string())?;
    Ok(file.into_inner())
}

const REC_709: Chromaticities = Chromaticities {
    red: exr::math::Vec2(0.64, 0.33),
    green: exr::math::Vec2(0.30, 0.60),
    blue: exr::math::Vec2(0.15, 0.06),
    white: exr::math::Vec2(0.3127, 0.3290),
};

#[cfg(test)]
mod tests {
    use super::*;

    fn picture() -> Vec<Channel> {
        let channel = |name: &str, precise, f: fn(f32) -> f32| {
            let values = (0..15).map(|i| f(i as f32)).collect();
            Channel { name: name.to_owned(), values, precise }
        };
        vec![channel("R", false, |i| 0.1 * i - 0.3), channel("splats.A", false, |i| i), channel("Z", true, |i| 1e5 + i)]
    }

    #[test]
    fn channels_and_header_are_read_back() {
        let folder = tempfile::tempdir().unwrap();
        for (samples, compression) in [
            (SampleType::Float, ExrCompression::Zip),
            (SampleType::Float, ExrCompression::Piz),
            (SampleType::Half, ExrCompression::Zip),
        ] {
            let path = folder.path().join("a.exr");
            let header = ExrHeader {
                pixel_aspect: 1.25,
                comment: "parts".to_owned(),
                samples,
                compression,
                ..ExrHeader::default()
            };
            write_exr(&path, [5, 3], picture(), &header).unwrap();
            let image = exr::prelude::read_first_flat_layer_from_file(&path).unwrap();
            assert_eq!(image.attributes.pixel_aspect, 1.25);
            assert_eq!(image.attributes.chromaticities, Some(REC_709));
            let layer = &image.layer_data;
            assert_eq!(
                layer.attributes.other[&Text::new_or_panic("colorSpace")],
                AttributeValue::Text(Text::new_or_panic("srgb_rec709_display"))
            );
            assert_eq!(layer.attributes.comments, Text::new_or_none("parts"));
            for expected in picture() {
                let found = layer.channel_data.list.iter().find(|c| c.name.eq(expected.name.as_str())).unwrap();
                let exact = samples == SampleType::Float || expected.precise;
                for (found, expected) in found.sample_data.values_as_f32().zip(&expected.values) {
                    assert!((found - expected).abs() <= if exact { 0.0 } else { 1e-3 * expected.abs() });
                }
            }
        }
    }

    /// The same map always encodes to the same bytes, by which exports recognise shared maps.
    #[test]
    fn a_map_is_one_file() {
        let (width, height) = (1300, 600);
        let texels = (0..width * height).map(|i| (i as f32).sin()).collect();
        let map = Texture::new(width, height, 1, texels).unwrap();
        let file = encode(&map, 0, &["Y"]).unwrap();
        let header = &exr::meta::MetaData::read_from_buffered(&file[..], true).unwrap().headers[0];
        assert!(matches!(header.blocks, exr::meta::BlockDescription::Tiles(_)) && header.chunk_count > 1);
        assert_eq!(header.line_order, LineOrder::Increasing);
        for _ in 0..8 {
            assert!(encode(&map, 0, &["Y"]).unwrap() == file);
        }
    }

    /// With pixels twice as wide as high, the focal length is half as many pixels across as down.
    #[test]
    fn aspect_is_width_over_height() {
        let k = Intrinsics { width: 50, height: 100, fx: 60.0, fy: 120.0, cx: 25.0, cy: 50.0 };
        assert_eq!(pixel_aspect(&k), 2.0);
    }

    #[test]
    fn names_that_exr_cannot_hold_are_errors() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.exr");
        for (name, said) in [("深さ", "a.exr: expected names of channels in Latin-1, found `深さ`"), ("R", "a.exr")]
        {
            let mut channels = picture();
            channels[1].name = name.to_owned();
            let error = write_exr(&path, [5, 3], channels, &ExrHeader::default()).unwrap_err().to_string();
            assert!(error.contains(said) && !path.exists(), "{error}");
        }
    }

    #[test]
    fn a_folder_that_is_not_there_is_named() {
        let error = write_exr(Path::new("/nowhere/a.exr"), [5, 3], picture(), &ExrHeader::default()).unwrap_err();
        assert!(error.to_string().contains("/nowhere/a.exr"), "{error}");
    }
}
