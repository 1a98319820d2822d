use std::io::{Read, Seek, SeekFrom};
use std::ops::Range;

use glam::{DVec3, Quat, Vec3};
use half::f16;

use super::{CENTER, DEFAULT_SH_RANGE, HEADER, Level, MAX_DEGREE, MEAN_RANGE, SECTION_HEADER};
use crate::format::blocks::read_in_blocks;
use crate::format::error::{Fault, Location};
use crate::format::splat_record::{SplatRecord, dc_of_bytes, log_of_scale, logit_of_byte};
use crate::scene::{SplatArrays, Splats, sh};

/// Storage of a splat's numbers.
#[derive(Clone, Copy)]
pub(super) struct Layout {
    pub(super) level: Level,
    pub(super) sh_degree: u32,
    /// Values of 0 and 255 in 8-bit SH.
    pub(super) sh_range: [f32; 2],
    /// Scene units per step of a 16-bit mean (`mean_step`), and the step that represents the centre (`mean_range`).
    pub(super) mean_step: f64,
    pub(super) mean_range: u32,
}

struct Section {
    count: usize,
    layout: Layout,
    bucket_size: usize,
    bucket_stride: usize,
    full_buckets: usize,
    /// Byte ranges in the file: lengths of the buckets that are not full, centres, splats.
    lengths: Range<usize>,
    centers: Range<usize>,
    splats: Range<usize>,
}

pub(super) fn decode(mut file: impl Read + Seek + Send) -> Result<Splats, Fault> {
    let length = file.seek(SeekFrom::End(0)).map_err(|e| Fault::unreadable(0, &e))? as usize;
    if length < HEADER {
        return Err(Fault::byte(length, format!("a .ksplat header of {HEADER} bytes"), "the end of the file"));
    }
    let header = read_at(&mut file, 0..HEADER)?;
    if header[..2] != [0, 1] {
        return Err(Fault::byte(0, ".ksplat version 0.1", format!("{}.{}", header[0], header[1])));
    }
    let sections = u32_at(&header, 4) as usize;
    let declared = u32_at(&header, 16);
    let code = u16_at(&header, 20);
    let level =
        Level::from_code(code).ok_or_else(|| Fault::byte(20, "compression level 0, 1 or 2", code.to_string()))?;
    let or = |value: f32, default| if value == 0.0 { default } else { value };
    let sh_range = [or(f32_at(&header, 36), -DEFAULT_SH_RANGE), or(f32_at(&header, 40), DEFAULT_SH_RANGE)];
    let most = (length - HEADER) / SECTION_HEADER;
    if sections > most {
        return Err(Fault::byte(4, format!("at most {most} sections in {length} bytes"), sections.to_string()));
    }
    let mut offset = HEADER + sections * SECTION_HEADER;
    let mut parsed = Vec::with_capacity(sections);
    for i in 0..sections {
        let at = HEADER + i * SECTION_HEADER;
        let header = read_at(&mut file, at..at + SECTION_HEADER)?;
        parsed.push(Section::parse(&header, at, (&mut offset, length), level, sh_range)?);
    }
    // Every splat occupies bytes of the file, so `count` is bounded.
    let count: usize = parsed.iter().map(|s| s.count).sum();
    if count != declared as usize {
        return Err(Fault::byte(16, format!("{count} splats as in the sections"), declared.to_string()));
    }
    let sh_degree = parsed.iter().map(|s| s.layout.sh_degree).max().unwrap_or(0);
    let mut arrays = SplatArrays::with_capacity(count, sh_degree);
    parsed.iter().try_for_each(|section| section.decode(&mut file, &mut arrays))?;
    let byte = |i: usize| Location::Byte(start_of_splat(&parsed, i) as u64);
    arrays.check().map_err(|e| Fault::from(e).of_element(byte))
}

/// Offset of splat `i`, counted over all sections.
fn start_of_splat(sections: &[Section], i: usize) -> usize {
    let mut left = i;
    for section in sections {
        if left < section.count {
            return section.splats.start + left * section.layout.level.splat_bytes(section.layout.sh_degree);
        }
        left -= section.count;
    }
    HEADER
}

impl Section {
    /// Parses the section header at offset `at` of the file, and advances `offset` from the section's content to its
    /// end.
    fn parse(
        header: &[u8],
        at: usize,
        (offset, file_length): (&mut usize, usize),
        level: Level,
        sh_range: [f32; 2],
    ) -> Result<Self, Fault> {
        let [count, room, bucket_size, buckets] = [0, 4, 8, 12].map(|k| u32_at(header, k) as usize);
        let (block, stride) = (f32_at(header, 16), usize::from(u16_at(header, 20)));
        let mean_range = Some(u32_at(header, 24)).filter(|&range| range > 0).unwrap_or(MEAN_RANGE);
        let [full_buckets, partial_buckets] = [32, 36].map(|k| u32_at(header, k) as usize);
        let sh_degree = u32::from(u16_at(header, 40));
        if sh_degree > MAX_DEGREE {
            return Err(Fault::byte(at + 40, format!("SH degree 0 to {MAX_DEGREE}"), sh_degree.to_string()));
        }
        if count > room {
            return Err(Fault::byte(at, format!("at most {room} splats in the section"), count.to_string()));
        }
        if level != Level::Float && buckets > 0 && stride < CENTER {
            return Err(Fault::byte(at + 20, format!("at least {CENTER} bytes per bucket"), stride.to_string()));
        }
        let mut take = |length: Option<usize>| {
            let end = length.and_then(|l| offset.checked_add(l)).filter(|&end| end <= file_length)?;
            Some(std::mem::replace(offset, end)..end)
        };
        let ranges = (|| {
            let lengths = take(partial_buckets.checked_mul(4))?;
            let centers = take(buckets.checked_mul(stride))?;
            Some((lengths, centers, take(room.checked_mul(level.splat_bytes(sh_degree)))?))
        })();
        let Some((lengths, centers, splats)) = ranges else {
            let expected = format!("a section that ends within the file's {file_length} bytes");
            return Err(Fault::byte(at, expected, format!("{room} splats, {buckets} buckets")));
        };
        let mean_step = f64::from(block) / 2.0 / f64::from(mean_range);
        let layout = Layout { level, sh_degree, sh_range, mean_step, mean_range };
        Ok(Self { count, layout, bucket_size, bucket_stride: stride, full_buckets, lengths, centers, splats })
    }

    fn decode(&self, file: &mut (impl Read + Seek + Send), arrays: &mut SplatArrays) -> Result<(), Fault> {
        let lengths = read_at(file, self.lengths.clone())?;
        let centers = read_at(file, self.centers.clone())?;
        let lengths = std::iter::repeat_n(self.bucket_size, self.full_buckets)
            .chain(lengths.as_chunks::<4>().0.iter().map(|&length| u32::from_le_bytes(length) as usize));
        let buckets = lengths.zip(centers.chunks_exact(self.bucket_stride.max(1)));
        // End of each bucket (index of its last splat plus one), and its centre.
        let (mut end, mut ends) = (0usize, vec![]);
        if self.layout.level != Level::Float {
            for (length, center) in buckets {
                end = end.saturating_add(length);
                ends.push((end, Vec3::from([0, 4, 8].map(|k| f32_at(center, k)))));
            }
            if end < self.count {
                let expected = format!("buckets for {} splats", self.count);
                return Err(Fault::byte(self.lengths.start, expected, format!("for {end}")));
            }
        }
        let center_of = |i: usize| ends.get(ends.partition_point(|&(end, _)| end <= i)).map_or(Vec3::ZERO, |b| b.1);
        let (start, stride) = (self.splats.start as u64, self.layout.level.splat_bytes(self.layout.sh_degree));
        file.seek(SeekFrom::Start(start)).map_err(|e| Fault::unreadable(start, &e))?;
        read_in_blocks(file, start, (self.count, stride), |first, rows| {
            let rows: Vec<&[u8]> = rows.collect();
            arrays.extend(rows.len(), |i| decode_splat(&self.layout, center_of(first + i), rows[i]));
        })
    }
}

fn read_at(file: &mut (impl Read + Seek), range: Range<usize>) -> Result<Vec<u8>, Fault> {
    let mut bytes = vec![0; range.len()];
    let read = file.seek(SeekFrom::Start(range.start as u64)).and_then(|_| file.read_exact(&mut bytes));
    read.map_err(|e| Fault::unreadable(range.start as u64, &e))?;
    Ok(bytes)
}

/// Decodes a splat; `row` has [`Level::splat_bytes`] bytes.
pub(super) fn decode_splat(layout: &Layout, center: Vec3, row: &[u8]) -> SplatRecord {
    let (component, sh_component) = layout.level.component_bytes();
    let number = |k: usize| match layout.level {
        Level::Float => f32_at(row, 4 * k),
        _ => f16::from_bits(u16_at(row, 2 * k)).to_f32(),
    };
    let mean = match layout.level {
        Level::Float => Vec3::from([0, 1, 2].map(number)),
        _ => {
            let steps = [0, 2, 4].map(|at| f64::from(u16_at(row, at)) - f64::from(layout.mean_range));
            (DVec3::from(steps) * layout.mean_step + center.as_dvec3()).as_vec3()
        }
    };
    let [w, x, y, z] = [6, 7, 8, 9].map(number);
    let colors = 10 * component;
    let mut all = [[0.0; 3]; 16];
    all[0] = dc_of_bytes([row[colors], row[colors + 1], row[colors + 2]]);
    let bands = colors + 4;
    for (k, coefficient) in all.iter_mut().enumerate().take(sh::coefficients(layout.sh_degree)).skip(1) {
        *coefficient = [0, 1, 2].map(|channel| {
            let at = bands + sh_component * sh_place(k, channel);
            match layout.level {
                Level::Float => f32_at(row, at),
                Level::Half => f16::from_bits(u16_at(row, at)).to_f32(),
                Level::HalfAndByte => {
                    let [low, high] = layout.sh_range;
                    low + f32::from(row[at]) / 255.0 * (high - low)
                }
            }
        });
    }
    SplatRecord {
        mean,
        rotation: Quat::from_xyzw(x, y, z, w),
        log_scale: Vec3::from([3, 4, 5].map(|k| log_of_scale(number(k)))),
        opacity_logit: logit_of_byte(row[colors + 3]),
        sh_degree: layout.sh_degree,
        sh: all,
    }
}

/// Index of coefficient `k` ≥ 1 of a channel among the SH components of a splat: ordered by band, then channel.
pub(super) fn sh_place(k: usize, channel: usize) -> usize {
    let (start, width) = if k < 4 { (1, 3) } else { (4, 5) };
    3 * (start - 1) + channel * width + (k - start)
}

fn u16_at(bytes: &[u8], at: usize) -> u16 {
    u16::from_le_bytes([bytes[at], bytes[at + 1]])
}

fn u32_at(bytes: &[u8], at: usize) -> u32 {
    u32::from_le_bytes([bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]])
}

fn f32_at(bytes: &[u8], at: usize) -> f32 {
    f32::from_bits(u32_at(bytes, at))
}
