//! EXR of named 32-bit float channels, lossless.

use std::io::Cursor;

use exr::prelude::{AnyChannel, AnyChannels, Encoding, FlatSamples, Image, Layer, LayerAttributes, WritableImage as _};

use crate::scene::Texture;

/// A file whose channel `names[i]` holds channel `first + i` of `map`. Rows as in the map, the first at the top.
pub(super) fn encode(map: &Texture, first: usize, names: &[impl AsRef<str>]) -> Result<Vec<u8>, String> {
    let channels = map.channels() as usize;
    let plane = |c: usize| map.texels().iter().skip(c).step_by(channels).copied().collect();
    let named =
        |(i, name): (usize, &_)| AnyChannel::new(AsRef::<str>::as_ref(name), FlatSamples::F32(plane(first + i)));
    let planes = names.iter().enumerate().map(named).collect();
    let size = (map.width() as usize, map.height() as usize);
    let layer = Layer::new(size, LayerAttributes::default(), Encoding::SMALL_FAST_LOSSLESS, AnyChannels::sort(planes));
    let mut file = Cursor::new(vec![]);
    Image::from_layer(layer).write().to_buffered(&mut file).map_err(|e| e.to_string())?;
    Ok(file.into_inner())
}
