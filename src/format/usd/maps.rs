//! Images beside a layer: previews for other programs (8-bit PNG), and the maps themselves (EXR of 32-bit floats).

use std::io::Cursor;

use exr::prelude::{ReadChannels as _, ReadLayers as _};
use image::ExtendedColorType;

use crate::format::map_budget::{MapBudget, identity};
use crate::format::{MAX_PIXEL_RATIO, preview};
use crate::scene::{Atlas, ColorSpace, Texture};

/// Expectation and finding of a failure.
pub(super) type Mismatch = (String, String);

/// Encodes RGB without view dependence as PNG.
pub(super) fn color_png(atlas: &Atlas, space: ColorSpace) -> Vec<u8> {
    let base = atlas.base();
    let pixels: Vec<u8> = base.texels().chunks_exact(4).flat_map(|texel| preview::color(texel, space)).collect();
    preview::png(base, &pixels, ExtendedColorType::Rgb8)
}

/// Encodes linear opacity as a grey PNG.
pub(super) fn opacity_png(atlas: &Atlas) -> Vec<u8> {
    let base = atlas.base();
    let pixels: Vec<u8> = base.texels().chunks_exact(4).map(preview::opacity).collect();
    preview::png(base, &pixels, ExtendedColorType::L8)
}

/// Channel names of a map: for the base, the zeroth coefficient and the opacity logit; for the bands, the other
/// coefficients.
fn channel_names(channels: u32) -> Vec<String> {
    let of = |k: u32| ["R", "G", "B"].map(|c| format!("sh{k:02}.{c}"));
    match channels {
        4 => of(0).into_iter().chain(["opacity.logit".to_owned()]).collect(),
        channels => (1..=channels / 3).flat_map(of).collect(),
    }
}

/// Encodes a map as lossless EXR.
pub(super) fn exr(map: &Texture) -> Result<Vec<u8>, String> {
    crate::format::exr::encode(map, 0, &channel_names(map.channels()))
}

/// Decodes a map written by [`exr()`], within `budget`. A map of bands has 9, 24 or 45 channels, as many as are named
/// consecutively.
pub(super) fn from_exr(file: &[u8], is_base: bool, budget: &mut MapBudget) -> Result<Texture, Mismatch> {
    let unreadable = |e: exr::error::Error| ("an EXR image".to_owned(), e.to_string());
    // Before decoding, the header must not claim more than the file can hold.
    let meta = exr::meta::MetaData::read_from_buffered(Cursor::new(file), true).map_err(unreadable)?;
    let header = meta.headers.first().ok_or_else(|| ("an EXR image".to_owned(), "none in the file".to_owned()))?;
    let (width, height) = (header.layer_size.x(), header.layer_size.y());
    // A window may be so large that the number of its samples overflows.
    let samples = [height, header.channels.list.len()].iter().fold(width as u64, |n, &m| n.saturating_mul(m as u64));
    if meta.headers.len() > 1
        || width.max(height) > Texture::MAX_SIDE as usize
        || samples / MAX_PIXEL_RATIO > file.len() as u64
    {
        let found = format!("{} of {width}×{height} in {} bytes", meta.headers.len(), file.len());
        return Err(("one EXR image that its file can hold".to_owned(), found));
    }
    // Additional channels are ignored.
    let names = channel_names(if is_base { 4 } else { (header.channels.list.len() / 3 * 3) as u32 });
    if !is_base && ![9, 24, 45].contains(&names.len()) {
        let found = header.channels.list.len().to_string();
        return Err(("9, 24 or 45 channels, of the SH bands above the first".to_owned(), found));
    }
    // A map that is too large by itself does not use up the common budget.
    MapBudget::of(file).spend(samples)?;
    budget.include(identity(file));
    budget.spend(samples)?;
    let image = exr::prelude::read()
        .no_deep_data()
        .largest_resolution_level()
        .all_channels()
        .first_valid_layer()
        .all_attributes()
        .from_buffered(Cursor::new(file))
        .map_err(unreadable)?;
    let planes = &image.layer_data.channel_data.list;
    let mut texels = vec![0.0; width * height * names.len()];
    for (c, name) in names.iter().enumerate() {
        let plane = planes.iter().find(|p| p.name.eq(name.as_str()));
        let plane = plane.ok_or_else(|| (format!("a channel `{name}`"), "none of this name".to_owned()))?;
        let slots = texels.iter_mut().skip(c).step_by(names.len());
        slots.zip(plane.sample_data.values_as_f32()).for_each(|(slot, value)| *slot = value);
    }
    let channels = names.len() as u32;
    Texture::new(width as u32, height as u32, channels, texels).map_err(|e| (e.expected, e.found))
}
