//! Decoding of `meta.json` and images to splats.

use glam::{DQuat, Quat, Vec3};
use rayon::prelude::*;

use super::files::FileSet;
use super::meta::{Field, Meta, Numbers};
use super::texels::Texels;
use crate::format::error::Fault;
use crate::format::splat_record::{SplatRecord, largest_component, logit_of_byte};
use crate::scene::{SplatArrays, Splats, sh};

/// What each of the 256 values of a byte stands for.
type Table = [f32; 256];

/// Checked content of `meta.json`: the meaning of the images.
pub(super) struct Scheme {
    count: usize,
    /// Lowest and highest transformed mean, per axis.
    means: [[f64; 2]; 3],
    scales: [Table; 3],
    /// Tables of RGB of coefficient 0, and of opacity logits.
    colors: [Table; 4],
    palette: Option<Palette>,
    /// JSON pointer and name of each image, in the order of [`Meta::files`].
    files: Vec<(String, String)>,
}

struct Palette {
    table: Table,
    /// Degree and number of entries, if `meta.json` states them; in version 1 they follow from the image's size.
    stated: Option<(u32, usize)>,
}

/// Palette entries per row of the palette's image, each with one texel per coefficient.
pub(super) const ENTRIES_PER_ROW: usize = 64;

impl Scheme {
    /// Checks `meta`; `bytes` is the total length of all files.
    pub(super) fn parse(meta: &Meta, bytes: u64) -> Result<Self, Fault> {
        let first = meta.version.is_none();
        if !matches!(meta.version, None | Some(2)) {
            let found = meta.version.unwrap_or_default().to_string();
            return Err(Fault::pointer("/version", "version 2, or none for version 1", found));
        }
        let (at, count) = if first {
            ("/means/shape/0", meta.means.shape.as_ref().and_then(|s| s.first()).copied())
        } else {
            ("/count", meta.count)
        };
        let count = count.ok_or_else(|| Fault::pointer(at, "the number of splats", "none"))?;
        // Trained splats take 8 to 20 bytes each. Files of constant images could claim any number.
        let most = bytes.saturating_mul(4).saturating_add(4096);
        if count > most {
            let expected = format!("at most {most} splats in {bytes} bytes");
            return Err(Fault::pointer(at, expected, count.to_string()));
        }
        let count = count as usize;

        let mut files = vec![];
        let mut take = |name: &str, field: &Field, expected: usize| {
            if field.files.len() != expected {
                let found = field.files.len().to_string();
                return Err(Fault::pointer(format!("/{name}/files"), format!("{expected} file(s)"), found));
            }
            files.extend(field.files.iter().enumerate().map(|(i, f)| (format!("/{name}/files/{i}"), f.clone())));
            Ok(())
        };
        take("means", &meta.means, 2)?;
        take("scales", &meta.scales, 1)?;
        take("quats", &meta.quats, 1)?;
        take("sh0", &meta.sh0, 1)?;
        if let Some(field) = &meta.sh_n {
            take("shN", field, 2)?;
        }

        let table = |name: &str, field: &Field, channel| {
            if first { range_table(name, field, channel) } else { codebook_table(name, field) }
        };
        let sh0 = |channel| table("sh0", &meta.sh0, channel);
        let opacities = if first { sh0(3)? } else { std::array::from_fn(|v| logit_of_byte(v as u8)) };
        let palette = match &meta.sh_n {
            None => None,
            Some(field) => Some(Palette { table: table("shN", field, 0)?, stated: stated(field, first)? }),
        };
        Ok(Self {
            count,
            means: [range("means", &meta.means, 0)?, range("means", &meta.means, 1)?, range("means", &meta.means, 2)?],
            scales: [
                table("scales", &meta.scales, 0)?,
                table("scales", &meta.scales, 1)?,
                table("scales", &meta.scales, 2)?,
            ],
            colors: [sh0(0)?, sh0(1)?, sh0(2)?, opacities],
            palette,
            files,
        })
    }

    /// Reads and decodes the images.
    pub(super) fn fetch(&self, files: &mut FileSet) -> Result<Vec<Texels>, Fault> {
        let mut contents = vec![];
        for (at, name) in &self.files {
            contents.push(files.image(name, at)?);
        }
        let decode = |(i, content): (usize, Vec<u8>)| {
            let image = Texels::decode(&content, |width, height| self.check_size(i, width, height));
            image.map_err(|fault| fault.in_member(&self.files[i].1))
        };
        contents.into_par_iter().enumerate().map(decode).collect()
    }

    /// Checks the size of image `i`; on failure, the expected size.
    fn check_size(&self, i: usize, width: usize, height: usize) -> Result<(), String> {
        if i == 5 {
            let palette_fits = degree_of_width(width).is_some() && height <= (1 << 16) / ENTRIES_PER_ROW;
            let expected = "64 texels per coefficient (192, 512 or 960) by at most 1024";
            return if palette_fits { Ok(()) } else { Err(expected.to_owned()) };
        }
        let most = self.count.saturating_mul(2).saturating_add(1 << 16);
        let fits = (self.count..=most).contains(&(width * height));
        if fits { Ok(()) } else { Err(format!("{} to {most} texels", self.count)) }
    }

    /// Decoder of the images returned by [`Self::fetch`], which are checked now; splats are decoded one by one on
    /// request.
    pub(super) fn decoder<'a>(&'a self, images: &'a [Texels]) -> Result<Decoder<'a>, Fault> {
        let [lower, upper, scales, rotations, colors, palette @ ..] = images else {
            return Err(Fault::pointer("/means/files", "at least 5 images", images.len().to_string()));
        };
        let bad_tag = |i| rotation(rotations.at(i)).err().map(|tag| (i, tag));
        if let Some((i, tag)) = (0..self.count).into_par_iter().find_map_first(bad_tag) {
            return Err(Fault::pointer("/quats", "alpha of 252 to 255", format!("{tag} in texel {i}")));
        }
        let harmonics = match (&self.palette, palette) {
            (Some(palette), [entries, labels]) => Some(self.harmonics(palette, entries, labels)?),
            _ => None,
        };
        Ok(Decoder { scheme: self, lower, upper, scales, rotations, colors, harmonics })
    }

    /// Palette, after checking that all labels refer to its entries.
    fn harmonics<'a>(
        &self,
        palette: &'a Palette,
        entries: &'a Texels,
        labels: &'a Texels,
    ) -> Result<Harmonics<'a>, Fault> {
        let degree = degree_of_width(entries.width).unwrap_or_default();
        let held = ENTRIES_PER_ROW * entries.height;
        if let Some((stated, count)) = palette.stated {
            if stated != degree {
                let found = format!("an image for degree {degree}");
                return Err(Fault::pointer("/shN/bands", format!("{stated} as by the palette's width"), found));
            }
            if count > held {
                return Err(Fault::pointer("/shN/count", format!("at most {held} entries"), count.to_string()));
            }
        }
        let count = palette.stated.map_or(held, |(_, count)| count);
        let harmonics = Harmonics { degree, table: &palette.table, entries, labels };
        let beyond = |i: usize| Some((i, harmonics.label(i))).filter(|&(_, label)| label >= count);
        if let Some((i, label)) = (0..self.count).into_par_iter().find_map_first(beyond) {
            let found = format!("{label} in texel {i}");
            return Err(Fault::pointer("/shN/files/1", format!("labels below {count}"), found));
        }
        Ok(harmonics)
    }
}

/// Checked images.
pub(super) struct Decoder<'a> {
    scheme: &'a Scheme,
    lower: &'a Texels,
    upper: &'a Texels,
    scales: &'a Texels,
    rotations: &'a Texels,
    colors: &'a Texels,
    harmonics: Option<Harmonics<'a>>,
}

struct Harmonics<'a> {
    degree: u32,
    table: &'a Table,
    entries: &'a Texels,
    labels: &'a Texels,
}

impl Harmonics<'_> {
    fn label(&self, i: usize) -> usize {
        let [low, high, ..] = self.labels.at(i);
        usize::from(u16::from_le_bytes([low, high]))
    }
}

impl Decoder<'_> {
    pub(super) fn splats(&self) -> Result<Splats, Fault> {
        let mut arrays = SplatArrays::with_capacity(self.scheme.count, self.harmonics.as_ref().map_or(0, |h| h.degree));
        arrays.extend(self.scheme.count, |i| self.record(i));
        arrays.check().map_err(|e| Fault::from(e).under("/means"))
    }

    /// Decodes splat `i`.
    pub(super) fn record(&self, i: usize) -> SplatRecord {
        let scheme = self.scheme;
        let (low, high, scale, color) = (self.lower.at(i), self.upper.at(i), self.scales.at(i), self.colors.at(i));
        let mean = |axis: usize| {
            let [first, last] = scheme.means[axis];
            let part = f64::from(u16::from_le_bytes([low[axis], high[axis]])) / 65535.0;
            expand(first + (last - first) * part) as f32
        };
        let color = |channel: usize| scheme.colors[channel][usize::from(color[channel])];
        let mut sh = [[0.0; 3]; 16];
        sh[0] = [0, 1, 2].map(color);
        let mut sh_degree = 0;
        if let Some(harmonics) = &self.harmonics {
            sh_degree = harmonics.degree;
            // Entries are consecutive in rows of 64, so all coefficients form one sequence.
            let bands = sh::coefficients(sh_degree) - 1;
            let first = harmonics.label(i) * bands;
            for (k, coefficient) in sh[1..=bands].iter_mut().enumerate() {
                let [r, g, b, _] = harmonics.entries.at(first + k);
                *coefficient = [r, g, b].map(|v| harmonics.table[usize::from(v)]);
            }
        }
        SplatRecord {
            mean: Vec3::from([0, 1, 2].map(mean)),
            // Tags have been checked.
            rotation: rotation(self.rotations.at(i)).unwrap_or_default(),
            log_scale: Vec3::from([0, 1, 2].map(|axis| scheme.scales[axis][usize::from(scale[axis])])),
            opacity_logit: color(3),
            sh_degree,
            sh,
        }
    }
}

fn degree_of_width(width: usize) -> Option<u32> {
    (1..=sh::MAX_DEGREE).find(|&d| width == ENTRIES_PER_ROW * (sh::coefficients(d) - 1))
}

fn stated(field: &Field, first: bool) -> Result<Option<(u32, usize)>, Fault> {
    if first {
        return Ok(None);
    }
    let bands = field.bands.filter(|b| (1..=sh::MAX_DEGREE).contains(b));
    let bands = bands.ok_or_else(|| Fault::pointer("/shN/bands", "1 to 3", format!("{:?}", field.bands)))?;
    let count = field.count.filter(|&c| c <= 1 << 16);
    let count = count.ok_or_else(|| Fault::pointer("/shN/count", "at most 65536", format!("{:?}", field.count)))?;
    Ok(Some((bands, count as usize)))
}

fn range(name: &str, field: &Field, channel: usize) -> Result<[f64; 2], Fault> {
    let end = |key: &str, numbers: &Option<Numbers>| {
        numbers
            .as_ref()
            .and_then(|n| n.get(channel))
            .ok_or_else(|| Fault::pointer(format!("/{name}/{key}"), format!("a number for channel {channel}"), "none"))
    };
    Ok([end("mins", &field.mins)?, end("maxs", &field.maxs)?])
}

/// Evenly spaced table of version 1.
fn range_table(name: &str, field: &Field, channel: usize) -> Result<Table, Fault> {
    let [low, high] = range(name, field, channel)?;
    Ok(std::array::from_fn(|v| (low + (high - low) * v as f64 / 255.0) as f32))
}

/// Codebook table of version 2.
fn codebook_table(name: &str, field: &Field) -> Result<Table, Fault> {
    let at = format!("/{name}/codebook");
    let fault = |found: String| Fault::pointer(&at, "1 to 256 numbers", found);
    let codebook = field.codebook.as_ref().ok_or_else(|| fault("none".to_owned()))?;
    let (first, rest) = match codebook.as_slice() {
        [first, rest @ ..] if rest.len() < 256 => (first, rest),
        other => return Err(fault(other.len().to_string())),
    };
    let rest: Result<Vec<f32>, Fault> = rest.iter().map(|v| v.ok_or_else(|| fault("null".to_owned()))).collect();
    let rest = rest?;
    // With few splats there may be fewer values than 256; bytes then refer to no others.
    let last = rest.last().copied().or(*first).ok_or_else(|| fault("null".to_owned()))?;
    let mut table = [last; 256];
    table[1..=rest.len()].copy_from_slice(&rest);
    // A missing first value is assumed to be one mean step below the second, as in PlayCanvas' own reader.
    table[0] = first.unwrap_or(table[1] - (table[255] - table[1]) / 255.0);
    Ok(table)
}

/// Inverse of [`compress`].
fn expand(v: f64) -> f64 {
    v.abs().exp_m1().copysign(v)
}

/// Signed logarithm in which means are stored: fine near the origin, coarse far away.
pub(super) fn compress(v: f64) -> f64 {
    v.abs().ln_1p().copysign(v)
}

/// Decodes a rotation: the components of (w, x, y, z) other than the largest, in order, and a tag with the index of the
/// largest. On failure, the tag.
fn rotation([a, b, c, tag]: [u8; 4]) -> Result<Quat, u8> {
    let largest = usize::from(tag.checked_sub(252).ok_or(tag)?);
    let rest = [a, b, c].map(|v| (f64::from(v) / 255.0 * 2.0 - 1.0) * std::f64::consts::FRAC_1_SQRT_2);
    let mut wxyz = [0.0; 4];
    let others = (0..4).filter(|&i| i != largest);
    others.zip(rest).for_each(|(i, v)| wxyz[i] = v);
    wxyz[largest] = (1.0 - rest.iter().map(|v| v * v).sum::<f64>()).max(0.0).sqrt();
    let [w, x, y, z] = wxyz;
    Ok(DQuat::from_xyzw(x, y, z, w).normalize().as_quat())
}

/// Inverse of [`rotation`], for a unit quaternion.
pub(super) fn rotation_texel(q: Quat) -> [u8; 4] {
    let wxyz = [q.w, q.x, q.y, q.z];
    let largest = largest_component(wxyz);
    let wxyz = wxyz.map(f64::from);
    // A quaternion and its negative are the same rotation; readers assume the largest component to be positive.
    let sign = wxyz[largest].signum();
    let mut others = (0..4).filter(|&i| i != largest);
    let mut byte = || {
        let v = others.next().map_or(0.0, |i| sign * wxyz[i] * std::f64::consts::SQRT_2);
        ((0.5 * v + 0.5) * 255.0).round() as u8
    };
    [byte(), byte(), byte(), 252 + largest as u8]
}
