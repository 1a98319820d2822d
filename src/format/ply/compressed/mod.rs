//! Compressed PLY of `PlayCanvas` (`SuperSplat`, splat-transform): chunks of 256 splats with their bounds, then 16
//! bytes per splat, then a byte per SH coefficient above 0.
//!
//! | word | bits from the top | content | largest error of [`write()`] |
//! |---|---|---|---|
//! | position | 11, 10, 11 | mean x, y, z between the chunk's bounds | 1/4094 (x, z) or 1/2046 (y) of its extent |
//! | rotation | 2, 10, 10, 10 | index in (w, x, y, z) of the largest component, which is positive; the others ×√½ + ½ | 0.28° |
//! | scale | 11, 10, 11 | log standard deviations between the chunk's bounds; below −20 is −20 | as for means |
//! | colour | 8, 8, 8, 8 | red, green, blue of SH coefficient 0 between the chunk's bounds (or 0..1), opacity | 1/510 of the extent, 1/510 |
//! | SH | 8 each | `f_rest_*`, −4..4 in 256 bins, of which the first and the last stand for ±4 | 1/64, 1/32 at the ends; beyond ±4 clipped |
//!
//! The frame is that of INRIA PLY: the scene's own, by convention y down.

use std::io::{BufRead, Seek, SeekFrom, Write as _};
use std::path::Path;

use glam::{Quat, Vec3};

use super::filter::filter_comments;
use super::layout::{degree_of_rest, rest_columns, rest_name};
use super::table::{Body, Element, Header};
use crate::format::blocks::in_waves;
use crate::format::error::Fault;
use crate::format::loss::{Loss, SplatError, WriteReport};
use crate::format::splat_record::{SplatRecord, largest_component, logit_of_byte, opacity_byte, quantize};
use crate::format::{FormatError, atomic_write_with};
use crate::scene::{PixelFilter, SplatArrays, Splats, in_morton_order, sh};

/// Splats in a chunk.
const CHUNK: usize = 256;

/// Number of splats encoded as one task.
const GROUP: usize = 32 * CHUNK;

/// Half the range of SH coefficients.
const SH_RANGE: f32 = 4.0;

/// Least log-scale written, as by `PlayCanvas`: a splat of 10⁻³⁵ must not reduce the precision of its neighbours.
const LEAST_LOG_SCALE: f32 = -20.0;

/// Names of the bounds in writing order. The last six may be absent.
const BOUNDS: [&str; 18] = [
    "min_x",
    "min_y",
    "min_z",
    "max_x",
    "max_y",
    "max_z",
    "min_scale_x",
    "min_scale_y",
    "min_scale_z",
    "max_scale_x",
    "max_scale_y",
    "max_scale_z",
    "min_r",
    "min_g",
    "min_b",
    "max_r",
    "max_g",
    "max_b",
];
const PACKED: [&str; 4] = ["packed_position", "packed_rotation", "packed_scale", "packed_color"];

/// Lowest and highest values in a chunk, per axis.
#[derive(Clone, Copy)]
struct Bounds {
    mean: [Vec3; 2],
    log_scale: [Vec3; 2],
    color: [Vec3; 2],
}

/// Writes splats as compressed PLY, in Morton order, so that neighbours in a chunk have narrow bounds. Comments state
/// the pixel filter as those of [`super::write_with`] do.
///
/// # Errors
/// If the file cannot be written.
pub fn write(path: &Path, splats: &Splats, pixel_filter: PixelFilter) -> Result<WriteReport, FormatError> {
    let bands = sh::coefficients(splats.sh_degree()) - 1;
    let order = in_morton_order(splats);
    let chunks = splats.len().div_ceil(CHUNK);
    let properties =
        |kind: &str, names: &[&str]| names.iter().map(|name| format!("property {kind} {name}\n")).collect::<String>();
    let comments = filter_comments(pixel_filter);
    let mut header = format!("ply\nformat binary_little_endian 1.0\n{comments}element chunk {chunks}\n");
    header += &properties("float", &BOUNDS);
    header += &format!("element vertex {}\n", splats.len());
    header += &properties("uint", &PACKED);
    if bands > 0 {
        header += &format!("element sh {}\n", splats.len());
        (0..3 * bands).for_each(|i| header += &properties("uchar", &[&rest_name(i)]));
    }
    header += "end_header\n";
    let mut max_error = SplatError::default();
    let bytes = atomic_write_with(path, |out| {
        out.write_all(header.as_bytes())?;
        // The three tables are filled in parallel at their final offsets.
        let bounds = header.len();
        let vertices = bounds + chunks * 4 * BOUNDS.len();
        let mut ends = [bounds, vertices, vertices + splats.len() * 4 * PACKED.len()].map(|offset| offset as u64);
        let group = |i: usize| &order[i * GROUP..order.len().min((i + 1) * GROUP)];
        let encode = |i: usize| group(i).chunks(CHUNK).map(|indices| encode_chunk(splats, indices)).collect();
        in_waves(order.len().div_ceil(GROUP), encode, |chunks: Vec<EncodedChunk>| {
            let bounds = chunks.iter().flat_map(|c| &c.bounds).flat_map(|v| v.to_le_bytes()).collect();
            let packed = chunks.iter().flat_map(|c| c.packed.iter().flatten()).flat_map(|v| v.to_le_bytes()).collect();
            let tables: [Vec<u8>; 3] = [bounds, packed, chunks.iter().flat_map(|c| &c.sh).copied().collect()];
            for (end, rows) in ends.iter_mut().zip(tables) {
                out.seek(SeekFrom::Start(*end))?;
                out.write_all(&rows)?;
                *end += rows.len() as u64;
            }
            max_error = chunks.iter().map(|c| c.error).fold(max_error, SplatError::max);
            Ok(())
        })
    })?;
    Ok(WriteReport { bytes, loss: Loss { max_error, ..Loss::default() }, ..WriteReport::default() })
}

/// Whether the header is that of a compressed PLY.
pub(in crate::format) fn is_compressed(header: &Header) -> bool {
    header.element("vertex").is_some_and(|vertex| vertex.scalar(PACKED[0]).is_some())
}

/// Names of scalar properties besides the packed ones.
pub(super) fn extra_properties(vertex: &Element) -> impl Iterator<Item = &str> {
    vertex.scalar_properties().map(|(_, name, _)| name).filter(|name| !PACKED.contains(name))
}

pub(super) fn parse(header: &Header, body: &mut Body<impl BufRead + Seek + Send>) -> Result<Splats, Fault> {
    let (chunk, vertex) = (header.required("chunk")?, header.required("vertex")?);
    let geometry: [usize; 12] = chunk.scalars([
        "min_x",
        "min_y",
        "min_z",
        "max_x",
        "max_y",
        "max_z",
        "min_scale_x",
        "min_scale_y",
        "min_scale_z",
        "max_scale_x",
        "max_scale_y",
        "max_scale_z",
    ])?;
    let color = chunk.scalars(["min_r", "min_g", "min_b", "max_r", "max_g", "max_b"]).ok();
    let packed = vertex.columns(PACKED)?;
    let (count, needed) = (vertex.count, vertex.count.div_ceil(CHUNK));
    if chunk.count < needed {
        let found = format!("{} chunks", chunk.count);
        return Err(Fault::byte(chunk.at, format!("{needed} chunks of {CHUNK} splats for {count} splats"), found));
    }
    let chunks = body.rows(header, "chunk", Vec::with_capacity, |chunks, row| {
        let at = |k: usize| Vec3::from([0, 1, 2].map(|axis| row.values[geometry[k + axis]] as f32));
        let color_at = |c: [usize; 3]| Vec3::from(c.map(|column| row.values[column] as f32));
        let color =
            color.map_or([Vec3::ZERO, Vec3::ONE], |[a, b, c, d, e, f]| [color_at([a, b, c]), color_at([d, e, f])]);
        chunks.push(Bounds { mean: [at(0), at(3)], log_scale: [at(6), at(9)], color });
        Ok(())
    })?;

    let sh_degree = match header.element("sh") {
        None => 0,
        Some(element) if element.count != count || element.is_float("f_rest_0") => {
            let found = format!("{} rows", element.count);
            return Err(Fault::byte(element.at, format!("the element `sh` with {count} rows of uchar"), found));
        }
        Some(element) => degree_of_rest(rest_columns(element).len()).map_err(|fault| fault.at_byte(element.at))?,
    };
    let rows = body.blocks(header, "vertex", Vec::with_capacity, |words, rows| {
        words.extend(rows.map(|row| packed.map(|column| column.f64(row) as u32)));
        Ok(())
    })?;
    let record = |i: usize| decode(&chunks[i / CHUNK], rows[i]);
    let arrays = match header.element("sh").filter(|_| sh_degree > 0) {
        None => {
            let mut arrays = SplatArrays::with_capacity(count, 0);
            arrays.extend(count, record);
            arrays
        }
        Some(element) => {
            let (rest, bands) = (rest_columns(element), sh::coefficients(sh_degree) - 1);
            // `sh` has as many rows as there are splats, so `count` is bounded by the file's length.
            let start = |_| (0, SplatArrays::with_capacity(count, sh_degree));
            body.blocks(header, "sh", start, |(first, arrays), rows| {
                let rows: Vec<&[u8]> = rows.collect();
                arrays.extend(rows.len(), |i| {
                    let mut splat = SplatRecord { sh_degree, ..record(*first + i) };
                    for band in 0..bands {
                        let byte = |channel: usize| rest[channel * bands + band].f64(rows[i]) as u8;
                        splat.sh[1 + band] = [0, 1, 2].map(|channel| coefficient(byte(channel)));
                    }
                    splat
                });
                *first += rows.len();
                Ok(())
            })?
            .1
        }
    };
    // Bounds are the only floats that may be invalid.
    arrays.check().map_err(|e| body.locate(header, "chunk", |i| i / CHUNK, e.into()))
}

struct EncodedChunk {
    bounds: [f32; 18],
    packed: Vec<[u32; 4]>,
    sh: Vec<u8>,
    error: SplatError,
}

fn encode_chunk(splats: &Splats, indices: &[usize]) -> EncodedChunk {
    let records: Vec<SplatRecord> = indices.iter().map(|&i| SplatRecord::of(splats, i)).collect();
    let span = |value: fn(&SplatRecord) -> Vec3| {
        let values = || records.iter().map(value);
        [values().reduce(Vec3::min).unwrap_or_default(), values().reduce(Vec3::max).unwrap_or_default()]
    };
    let bounds = Bounds { mean: span(|r| r.mean), log_scale: span(log_scale), color: span(color) };
    let bands = sh::coefficients(splats.sh_degree()) - 1;
    let mut chunk = EncodedChunk {
        bounds: [0.0; 18],
        packed: Vec::with_capacity(indices.len()),
        sh: Vec::with_capacity(indices.len() * 3 * bands),
        error: SplatError::default(),
    };
    let ends = [bounds.mean, bounds.log_scale, bounds.color].into_iter().flatten().flat_map(|v| v.to_array());
    chunk.bounds.iter_mut().zip(ends).for_each(|(to, from)| *to = from);
    for splat in &records {
        let packed = encode(&bounds, splat);
        let mut back = SplatRecord { sh_degree: splat.sh_degree, ..decode(&bounds, packed) };
        for channel in 0..3 {
            for (band, value) in splat.sh().iter().enumerate().skip(1) {
                let byte = coefficient_byte(value[channel]);
                back.sh[band][channel] = coefficient(byte);
                chunk.sh.push(byte);
            }
        }
        chunk.error.include(splat, &back);
        chunk.packed.push(packed);
    }
    chunk
}

fn log_scale(splat: &SplatRecord) -> Vec3 {
    splat.log_scale.max(Vec3::splat(LEAST_LOG_SCALE))
}

fn color(splat: &SplatRecord) -> Vec3 {
    Vec3::from(sh::rgb_from_dc(splat.sh[0]))
}

fn encode(bounds: &Bounds, splat: &SplatRecord) -> [u32; 4] {
    let [x, y, z] = parts(splat.mean, bounds.mean);
    let [sx, sy, sz] = parts(log_scale(splat), bounds.log_scale);
    let [r, g, b] = parts(color(splat), bounds.color).map(|c| quantize(c, 255));
    let pack = |x, y, z| quantize(x, 2047) << 21 | quantize(y, 1023) << 11 | quantize(z, 2047);
    let alpha = u32::from(opacity_byte(splat.opacity_logit));
    [pack(x, y, z), encode_rotation(splat.rotation), pack(sx, sy, sz), r << 24 | g << 16 | b << 8 | alpha]
}

fn decode(bounds: &Bounds, [position, rotation, scale, color]: [u32; 4]) -> SplatRecord {
    let unpack = |v: u32| Vec3::new(unit(v >> 21, 2047), unit(v >> 11, 1023), unit(v, 2047));
    let rgb = Vec3::new(unit(color >> 24, 255), unit(color >> 16, 255), unit(color >> 8, 255));
    let mut sh = [[0.0; 3]; 16];
    sh[0] = sh::dc_from_rgb(between(bounds.color, rgb).to_array());
    SplatRecord {
        mean: between(bounds.mean, unpack(position)),
        rotation: decode_rotation(rotation),
        log_scale: between(bounds.log_scale, unpack(scale)),
        opacity_logit: logit_of_byte(color as u8),
        sh_degree: 0,
        sh,
    }
}

/// Position of `value` between the bounds, 0 to 1 per axis; 0 where the bounds coincide.
fn parts(value: Vec3, [low, high]: [Vec3; 2]) -> [f32; 3] {
    // In f64: the extent of f32 values may exceed the range of f32.
    let (value, low, high) = (value.as_dvec3(), low.as_dvec3(), high.as_dvec3());
    let part = (value - low) / (high - low).max(glam::DVec3::splat(f64::MIN_POSITIVE));
    part.as_vec3().to_array()
}

fn between([low, high]: [Vec3; 2], part: Vec3) -> Vec3 {
    low * (Vec3::ONE - part) + high * part
}

/// Lowest bits of `v`, selected by the all-ones mask `levels`, as a fraction of `levels`.
fn unit(v: u32, levels: u32) -> f32 {
    (v & levels) as f32 / levels as f32
}

fn encode_rotation(q: Quat) -> u32 {
    let q = [q.w, q.x, q.y, q.z];
    let largest = largest_component(q);
    let sign = q[largest].signum();
    let others =
        (0..4).filter(|&i| i != largest).map(|i| quantize(sign * q[i] * std::f32::consts::FRAC_1_SQRT_2 + 0.5, 1023));
    others.fold(largest as u32, |word, component| word << 10 | component)
}

fn decode_rotation(word: u32) -> Quat {
    let part = |shift: u32| (unit(word >> shift, 1023) - 0.5) * std::f32::consts::SQRT_2;
    let others = [part(20), part(10), part(0)];
    let largest = (1.0 - others.iter().map(|c| c * c).sum::<f32>()).max(0.0).sqrt();
    let [a, b, c] = others;
    let [w, x, y, z] = match word >> 30 {
        0 => [largest, a, b, c],
        1 => [a, largest, b, c],
        2 => [a, b, largest, c],
        _ => [a, b, c, largest],
    };
    Quat::from_xyzw(x, y, z, w)
}

fn coefficient_byte(value: f32) -> u8 {
    // A cast saturates, which clips the value.
    ((value / (2.0 * SH_RANGE) + 0.5) * 256.0) as u8
}

fn coefficient(byte: u8) -> f32 {
    let part = match byte {
        0 => 0.0,
        255 => 1.0,
        _ => (f32::from(byte) + 0.5) / 256.0,
    };
    (part - 0.5) * 2.0 * SH_RANGE
}

#[cfg(test)]
mod tests;
