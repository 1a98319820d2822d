//! SPZ format (Niantic Labs, github.com/nianticlabs/spz): attribute by attribute in 8 to 32 bits, then compressed.
//!
//! | attribute | stored as | largest error of [`write()`] |
//! |---|---|---|
//! | mean | 24-bit fixed point with `fractionalBits` f, chosen by the scene's size | 2^−(f+1) |
//! | opacity | 255 steps | 1/510 |
//! | SH coefficient 0 | 0.15·c + 0.5 in 255 steps, which reaches ±3.3 | 0.0037 of the colour; beyond clipped |
//! | log standard deviation | 16 steps per e-fold from −10 to 5.94 | 1/32; beyond clipped |
//! | rotation, version 2 | x, y, z in 255 steps of the quaternion with w ≥ 0 | 1°, near half a turn 13.5° |
//! | rotation, versions 3, 4 | the three smallest components in sign and 9 bits, index of the largest in (x, y, z, w) | 0.28° |
//! | SH bands 1; 2, 3 | (c + 1)·128 rounded to 5; 4 bits ([`Options::sh_bits`]) | 1/32; 1/16 (1/256 with 8 bits); beyond ±1 clipped |
//!
//! Versions 2 and 3 are one gzip stream of a 16-byte header and the attributes; version 4 has a 32-byte header,
//! extension records, a table of sizes and a zstd frame per attribute.
//!
//! **Frame.** SPZ is x right, y up, z backwards; PLY and captures are y down, z forwards. Reading and writing rotate
//! splats by half a turn about x, including rotations and SH, so that a scene read from PLY and from SPZ is the same. A
//! version 4 file may state another frame (`SPZ_ADOBE_coordinate_system`), which is applied, even if mirrored. Some
//! programs store PLY axes without stating it; such files appear upside down.

pub(super) mod container;
mod frame;
mod packed;

use std::path::Path;

use self::container::{ANTIALIASED, Header, Packed, STREAMS, Writer};
use self::frame::Frame;
use super::blocks::in_waves;
use super::content::pixel_filter_of;
use super::error::{Fault, read_file};
use super::loss::{Loss, SplatError, WriteReport};
use super::splat_record::SplatRecord;
use super::{FormatError, ReadOptions, SplatFile, atomic_write_with};
use crate::scene::{SplatArrays, Splats, sh};

/// File layout.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Version {
    /// gzip, 24-bit rotations: for readers from before 2025.
    V2,
    /// gzip, 32-bit rotations.
    V3,
    /// zstd, one stream per attribute.
    #[default]
    V4,
}

/// Options of writing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Options {
    /// File layout.
    pub version: Version,
    /// Bits of SH coefficients in band 1 and in the higher bands, 1 to 8. Readers need not know the number; fewer bits
    /// compress better. The default of 5 and 4 is that of the format's own library.
    pub sh_bits: [u32; 2],
    /// Whether the file states that projections of splats keep their integral (`PixelFilter::normalized`);
    /// [`super::write_scene`] sets it according to the scene's composition.
    pub antialiased: bool,
}

impl Default for Options {
    fn default() -> Self {
        Self { version: Version::default(), sh_bits: [5, 4], antialiased: false }
    }
}

/// Reads splats of versions 2 to 4, compressed or not, with the pixel filter, and notes on what could not be
/// represented: SH of degree 4, unknown extensions. No option applies.
///
/// # Errors
/// If the file cannot be read, is not SPZ, is truncated or damaged, or declares more splats than a file of its length can
/// hold.
pub fn read(path: &Path, _options: &ReadOptions<'_>) -> Result<SplatFile, FormatError> {
    parse(&read_file(path)?).map_err(|fault| fault.in_file(path))
}

/// Writes splats in their own order.
///
/// # Errors
/// If the file cannot be written.
pub fn write(path: &Path, splats: &Splats, options: &Options) -> Result<WriteReport, FormatError> {
    let header = Header {
        version: match options.version {
            Version::V2 => 2,
            Version::V3 => 3,
            Version::V4 => 4,
        },
        // `encode` rejects more than 2³² splats.
        count: splats.len(),
        sh_degree: splats.sh_degree(),
        fractional_bits: packed::fractional_bits(splats.means()),
        flags: if options.antialiased { ANTIALIASED } else { 0 },
    };
    let sh_bits = options.sh_bits.map(|bits| bits.clamp(1, 8));
    let mut max_error = SplatError::default();
    let bytes = atomic_write_with(path, |out| {
        let mut writer = Writer::new(&header)?;
        in_waves(
            splats.len().div_ceil(BLOCK),
            |block| pack(&header, splats, sh_bits, block),
            |(streams, error)| {
                max_error = max_error.max(error);
                writer.append(&streams)
            },
        )?;
        writer.finish(out)
    })?;
    Ok(WriteReport { bytes, loss: Loss { max_error, ..Loss::default() }, ..WriteReport::default() })
}

pub(super) fn parse(bytes: &[u8]) -> Result<SplatFile, Fault> {
    let Packed { header, frame, streams, mut notes, .. } = container::decode(bytes)?;
    let sh_degree = header.sh_degree.min(sh::MAX_DEGREE);
    if sh_degree < header.sh_degree {
        notes.push(format!("SH bands above degree {sh_degree} of {} are left out", header.sh_degree));
    }
    let mut arrays = SplatArrays::with_capacity(header.count, sh_degree);
    let streams = streams.each_ref().map(Vec::as_slice);
    arrays.extend(header.count, |i| frame.to_scene(&packed::decode(&header, streams, i)));
    let pixel_filter = pixel_filter_of(header.flags & ANTIALIASED != 0);
    Ok(SplatFile { pixel_filter, notes, ..SplatFile::of(arrays.check()?) })
}

/// Number of splats packed as one task.
const BLOCK: usize = 1 << 14;

/// Stream bytes of a block of splats, and the error that a reader will see.
fn pack(header: &Header, splats: &Splats, sh_bits: [u32; 2], block: usize) -> ([Vec<u8>; STREAMS], SplatError) {
    let frame = Frame::default();
    let (mut streams, mut error) = ([const { Vec::new() }; STREAMS], SplatError::default());
    let start = block * BLOCK;
    for i in start..splats.len().min(start + BLOCK) {
        let splat = SplatRecord::of(splats, i);
        packed::encode(header, sh_bits, &frame.to_file(&splat), &mut streams);
        let written = streams.each_ref().map(Vec::as_slice);
        error.include(&splat, &frame.to_scene(&packed::decode(header, written, i - start)));
    }
    (streams, error)
}

#[cfg(test)]
mod tests;
