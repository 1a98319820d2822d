//! Encoding of splats to `meta.json` and images.

use glam::Vec3;
use rayon::prelude::*;
use serde_json::{Map, json};

use super::codebook::Codebook;
use super::decode::{ENTRIES_PER_ROW, compress, rotation_texel};
use super::meta::{Field, Meta, Numbers};
use super::palette::{Vectors, palette};
use super::texels::{MAX_SIDE, Texels};
use crate::format::error::Fault;
use crate::format::splat_record::opacity_byte;
use crate::scene::{Splats, in_morton_order, sh};

/// SOG in memory.
pub(super) struct Encoded {
    pub(super) meta: Meta,
    /// Images in the order of [`Meta::files`].
    pub(super) images: Vec<Texels>,
    /// Per written splat, its original index.
    pub(super) order: Vec<usize>,
}

pub(super) fn encode(splats: &Splats, antialias: bool) -> Result<Encoded, Fault> {
    let n = splats.len();
    if n > MAX_SIDE * MAX_SIDE {
        return Err(Fault::whole(format!("at most {} splats", MAX_SIDE * MAX_SIDE), n.to_string()));
    }
    let order = in_morton_order(splats);
    let size = image_size(n);
    let image = |texel: &(dyn Fn(usize) -> [u8; 4] + Sync)| {
        let mut image = Texels::opaque(size[0], size[1]);
        image.rgba_mut()[..n].par_iter_mut().zip(&order).for_each(|(slot, &i)| *slot = texel(i));
        image
    };

    let range = MeanRange::of(splats.means());
    let mean_bytes = |i: usize, byte: usize| range.bits(splats.means()[i]).map(|v| v.to_le_bytes()[byte]);
    let opaque = |[r, g, b]: [u8; 3]| [r, g, b, 255];

    let scales = Codebook::of(splats.log_scales().iter().flat_map(Vec3::to_array).collect());
    let scale = |i: usize| opaque(splats.log_scales()[i].to_array().map(|v| scales.nearest(v)));
    let colors = Codebook::of((0..n).flat_map(|i| splats.sh_of(i)[0]).collect());
    let color = |i: usize| {
        let [r, g, b] = splats.sh_of(i)[0].map(|v| colors.nearest(v));
        [r, g, b, opacity_byte(splats.opacity_logits()[i])]
    };

    let mut images = vec![
        image(&|i| opaque(mean_bytes(i, 0))),
        image(&|i| opaque(mean_bytes(i, 1))),
        image(&scale),
        image(&|i| rotation_texel(splats.rotations()[i])),
        image(&color),
    ];
    let mut sh_n = None;
    if splats.sh_degree() > 0 {
        let (entries, labels, field) = harmonics(splats);
        images.push(entries);
        images.push(image(&|i| {
            let [low, high] = labels[i].to_le_bytes();
            [low, high, 0, 255]
        }));
        sh_n = Some(field);
    }
    let files = |names: &[&str]| names.iter().map(|name| format!("{name}.webp")).collect();
    let table = |name: &str, codebook: &Codebook| Field {
        codebook: Some(codebook.values().map(Some).to_vec()),
        files: files(&[name]),
        ..Field::default()
    };
    let meta = Meta {
        version: Some(2),
        asset: Some(json!({ "generator": concat!("Centaur ", env!("CARGO_PKG_VERSION")) })),
        count: Some(n as u64),
        // `antialias` is for readers that follow the format's description, `model` is written like splat-transform
        // does.
        antialias,
        model: antialias.then(|| json!("antialiased")),
        means: Field {
            mins: Some(Numbers::Many(range.mins.to_vec())),
            maxs: Some(Numbers::Many(range.maxs.to_vec())),
            files: files(&["means_l", "means_u"]),
            ..Field::default()
        },
        scales: table("scales", &scales),
        quats: Field { files: files(&["quats"]), ..Field::default() },
        sh0: table("sh0", &colors),
        sh_n: sh_n.map(|field| Field { files: files(&["shN_centroids", "shN_labels"]), ..field }),
        rest: Map::new(),
    };
    Ok(Encoded { meta, images, order })
}

/// Ranges of the means' 16-bit coordinates, after [`compress`].
struct MeanRange {
    mins: [f64; 3],
    maxs: [f64; 3],
}

impl MeanRange {
    fn of(means: &[Vec3]) -> Self {
        if means.is_empty() {
            return Self { mins: [0.0; 3], maxs: [0.0; 3] };
        }
        let (mut mins, mut maxs) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
        for mean in means {
            let compressed = Self::compressed(*mean);
            mins = std::array::from_fn(|a| mins[a].min(compressed[a]));
            maxs = std::array::from_fn(|a| maxs[a].max(compressed[a]));
        }
        Self { mins, maxs }
    }

    fn compressed(mean: Vec3) -> [f64; 3] {
        mean.to_array().map(|v| compress(f64::from(v)))
    }

    fn bits(&self, mean: Vec3) -> [u16; 3] {
        let compressed = Self::compressed(mean);
        std::array::from_fn(|a| {
            let span = (self.maxs[a] - self.mins[a]).max(f64::MIN_POSITIVE);
            ((compressed[a] - self.mins[a]) / span * 65535.0).round() as u16
        })
    }
}

/// Width and height in texels: multiples of 4, approximately square.
fn image_size(count: usize) -> [usize; 2] {
    let width = ((count as f64).sqrt().ceil() as usize).next_multiple_of(4).clamp(4, MAX_SIDE);
    [width, count.div_ceil(width).next_multiple_of(4).clamp(4, MAX_SIDE)]
}

/// Image of the palette's entries, labels, and the field that describes them.
fn harmonics(splats: &Splats) -> (Texels, Vec<u16>, Field) {
    let (n, degree) = (splats.len(), splats.sh_degree());
    let coefficients = sh::coefficients(degree) - 1;
    let vectors = Vectors { sh: splats.sh().as_flattened(), dims: 3 * coefficients };
    // Palette size: half to all of the number of splats, up to the number of 16-bit labels.
    let most = 1 << n.max(1).ilog2().min(16);
    let palette = palette(vectors, n, most);
    let count = palette.entries.len() / vectors.dims;
    let codebook = Codebook::of(palette.entries.clone());
    let mut image = Texels::opaque(ENTRIES_PER_ROW * coefficients, count.div_ceil(ENTRIES_PER_ROW).max(1));
    for (texel, rgb) in image.rgba_mut().iter_mut().zip(palette.entries.as_chunks::<3>().0) {
        let [r, g, b] = rgb.map(|v| codebook.nearest(v));
        *texel = [r, g, b, 255];
    }
    let field = Field {
        codebook: Some(codebook.values().map(Some).to_vec()),
        count: Some(count as u64),
        bands: Some(degree),
        ..Field::default()
    };
    (image, palette.labels, field)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn images_hold_all_splats() {
        for n in [0, 1, 15, 16, 17, 8406, 307_128, MAX_SIDE * MAX_SIDE] {
            let [w, h] = image_size(n);
            assert!(w * h >= n && w <= MAX_SIDE && h <= MAX_SIDE && w * h <= 2 * n + (1 << 16), "{n}");
        }
        // The sizes that splat-transform chooses.
        assert_eq!((image_size(8406), image_size(307_128)), ([92, 92], [556, 556]));
    }
}
