use std::collections::BTreeMap;
use std::io::{self, Write};

use glam::{DVec3, Vec3};
use half::f16;

use super::decode::{Layout, decode_splat, sh_place};
use super::{CENTER, DEFAULT_SH_RANGE, HEADER, Level, MAX_DEGREE, MEAN_RANGE, SECTION_HEADER};
use crate::format::activation;
use crate::format::blocks::in_waves;
use crate::format::loss::{Loss, SplatError};
use crate::format::splat_record::{SplatRecord, color_bytes, opacity_byte, quantize};
use crate::scene::{self, Splats, sh};

/// Splats in a full bucket, as in the format's own writer.
const BUCKET: usize = 256;
const BUCKETS_PER_TASK: usize = 32;
/// Side of a block in scene units, as in the format's own writer; smaller in small scenes, so that they have as many
/// blocks.
const GREATEST_BLOCK: f64 = 5.0;
/// Least number of blocks along the scene's greatest extent …
const BLOCKS: f64 = 16.0;
/// … and the greatest, so that blocks can be counted.
const MOST_BLOCKS: f64 = 1048576.0;

/// Splats that share a centre.
struct Bucket {
    center: Vec3,
    splats: Vec<u32>,
}

pub(super) fn encode(splats: &Splats, level: Level, out: &mut (impl Write + Send)) -> io::Result<Loss> {
    let sh_degree = splats.sh_degree().min(MAX_DEGREE);
    let (block, buckets) = match level {
        Level::Float => (0.0, in_order(splats.len())),
        _ => in_blocks(splats.means()),
    };
    let layout = Layout {
        level,
        sh_degree,
        sh_range: sh_range(splats, sh_degree),
        mean_step: f64::from(block) / 2.0 / f64::from(MEAN_RANGE),
        mean_range: MEAN_RANGE,
    };
    let full = buckets.iter().take_while(|b| b.splats.len() == BUCKET).count();
    let mut start = headers(&layout, splats, block, (buckets.len(), full));
    if level != Level::Float {
        buckets[full..].iter().for_each(|b| start.extend((b.splats.len() as u32).to_le_bytes()));
        buckets.iter().for_each(|b| b.center.to_array().iter().for_each(|v| start.extend(v.to_le_bytes())));
    }
    let section = start.len() - HEADER - SECTION_HEADER + splats.len() * level.splat_bytes(sh_degree);
    // Beyond 4 GiB the field overflows; readers compute the size from the counts.
    let section = u32::try_from(section).unwrap_or(u32::MAX);
    start[HEADER + 28..HEADER + 32].copy_from_slice(&section.to_le_bytes());
    out.write_all(&start)?;
    let mut loss = Loss::of_sh_degree(splats.sh_degree(), sh_degree);
    let groups: Vec<&[Bucket]> = buckets.chunks(BUCKETS_PER_TASK).collect();
    in_waves(
        groups.len(),
        |i| encode_buckets(splats, &layout, groups[i]),
        |(bytes, error)| {
            loss.max_error = loss.max_error.max(error);
            out.write_all(&bytes)
        },
    )?;
    Ok(loss)
}

/// File header, and the header of its only section, whose size is filled in later.
fn headers(layout: &Layout, splats: &Splats, block: f32, (buckets, full): (usize, usize)) -> Vec<u8> {
    let mut file = vec![0; HEADER + SECTION_HEADER];
    let mut put = |at: usize, bytes: &[u8]| file[at..at + bytes.len()].copy_from_slice(bytes);
    let count = (splats.len() as u32).to_le_bytes();
    put(1, &[1]);
    [4, 8].iter().for_each(|&at| put(at, &1u32.to_le_bytes()));
    [12, 16, HEADER, HEADER + 4].iter().for_each(|&at| put(at, &count));
    put(20, &(layout.level as u16).to_le_bytes());
    let center = bounds(splats.means()).iter().sum::<DVec3>() / 2.0;
    center.as_vec3().to_array().iter().zip([24, 28, 32]).for_each(|(v, at)| put(at, &v.to_le_bytes()));
    layout.sh_range.iter().zip([36, 40]).for_each(|(v, at)| put(at, &v.to_le_bytes()));
    put(HEADER + 40, &(layout.sh_degree as u16).to_le_bytes());
    if layout.level != Level::Float {
        put(HEADER + 8, &(BUCKET as u32).to_le_bytes());
        put(HEADER + 12, &(buckets as u32).to_le_bytes());
        put(HEADER + 16, &block.to_le_bytes());
        put(HEADER + 20, &(CENTER as u16).to_le_bytes());
        put(HEADER + 24, &MEAN_RANGE.to_le_bytes());
        put(HEADER + 32, &(full as u32).to_le_bytes());
        put(HEADER + 36, &((buckets - full) as u32).to_le_bytes());
    }
    file
}

fn bounds(means: &[Vec3]) -> [DVec3; 2] {
    scene::bounds(means.iter().copied()).unwrap_or_default().map(Vec3::as_dvec3)
}

fn in_order(count: usize) -> Vec<Bucket> {
    let starts = (0..count).step_by(BUCKET);
    starts
        .map(|i| Bucket { center: Vec3::ZERO, splats: (i..count.min(i + BUCKET)).map(|i| i as u32).collect() })
        .collect()
}

/// Side length of blocks, and buckets of splats of one block each; full buckets first.
fn in_blocks(means: &[Vec3]) -> (f32, Vec<Bucket>) {
    let [low, high] = bounds(means);
    let extent = (high - low).max_element();
    let block = (extent / BLOCKS).min(GREATEST_BLOCK).max(extent / MOST_BLOCKS);
    let block = if extent > 0.0 { block.max(f64::from(f32::MIN_POSITIVE)) as f32 } else { GREATEST_BLOCK as f32 };
    let side = f64::from(block);
    let (mut full, mut open) = (vec![], BTreeMap::<[u32; 3], Bucket>::new());
    for (i, mean) in means.iter().enumerate() {
        let block = ((mean.as_dvec3() - low) / side).floor();
        let key = block.to_array().map(|c| c as u32);
        let center = (low + (block + 0.5) * side).as_vec3();
        let bucket = open.entry(key).or_insert_with(|| Bucket { center, splats: vec![] });
        bucket.splats.push(i as u32);
        if bucket.splats.len() == BUCKET {
            full.extend(open.remove(&key));
        }
    }
    full.extend(open.into_values());
    (block, full)
}

/// Least and greatest coefficient of the written bands. Neither is 0, which readers interpret as "not stated".
fn sh_range(splats: &Splats, sh_degree: u32) -> [f32; 2] {
    let (all, kept) = (sh::coefficients(splats.sh_degree()), sh::coefficients(sh_degree));
    if kept == 1 {
        return [-DEFAULT_SH_RANGE, DEFAULT_SH_RANGE];
    }
    let values = splats.sh().chunks_exact(all).flat_map(|c| &c[1..kept]).flatten();
    values.fold([-1e-6, 1e-6], |[low, high]: [f32; 2], &v| [low.min(v), high.max(v)])
}

fn encode_buckets(splats: &Splats, layout: &Layout, buckets: &[Bucket]) -> (Vec<u8>, SplatError) {
    let (mut bytes, mut error) = (vec![], SplatError::default());
    for bucket in buckets {
        for &i in &bucket.splats {
            let splat = SplatRecord::of(splats, i as usize);
            let start = bytes.len();
            encode_splat(layout, bucket.center, &splat, &mut bytes);
            error.include(&splat, &decode_splat(layout, bucket.center, &bytes[start..]));
        }
    }
    (bytes, error)
}

fn encode_splat(layout: &Layout, center: Vec3, splat: &SplatRecord, bytes: &mut Vec<u8>) {
    let number = |bytes: &mut Vec<u8>, v: f32| match layout.level {
        Level::Float => bytes.extend(v.to_le_bytes()),
        _ => bytes.extend(half(v).to_le_bytes()),
    };
    match layout.level {
        Level::Float => splat.mean.to_array().iter().for_each(|v| bytes.extend(v.to_le_bytes())),
        _ => {
            let steps = (splat.mean.as_dvec3() - center.as_dvec3()) / layout.mean_step;
            // A cast from float to u16 saturates.
            let stored = steps.to_array().map(|s| (s.round() + f64::from(layout.mean_range)) as u16);
            stored.iter().for_each(|v| bytes.extend(v.to_le_bytes()));
        }
    }
    splat.log_scale.to_array().iter().for_each(|&s| number(bytes, activation::scale(s)));
    let q = splat.rotation;
    [q.w, q.x, q.y, q.z].iter().for_each(|&c| number(bytes, c));
    bytes.extend(color_bytes(splat.sh[0]));
    bytes.push(opacity_byte(splat.opacity_logit));
    let mut bands = [0.0; 24];
    for (k, coefficient) in splat.sh.iter().enumerate().take(sh::coefficients(layout.sh_degree)).skip(1) {
        (0..3).for_each(|channel| bands[sh_place(k, channel)] = coefficient[channel]);
    }
    for &v in &bands[..sh::band_floats(layout.sh_degree)] {
        match layout.level {
            Level::Float => bytes.extend(v.to_le_bytes()),
            Level::Half => bytes.extend(half(v).to_le_bytes()),
            Level::HalfAndByte => {
                let [low, high] = layout.sh_range;
                bytes.push(quantize((v - low) / (high - low), 255) as u8);
            }
        }
    }
}

/// Nearest f16; too large values become the largest.
fn half(v: f32) -> f16 {
    f16::from_f32(v).clamp(f16::MIN, f16::MAX)
}
