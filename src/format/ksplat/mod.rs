//! Format `.ksplat` of mkkellogg's `GaussianSplats3D`, version 0.1: a file header of 4096 bytes, section headers of
//! 1024 bytes, sections.
//!
//! A splat consists of mean, scales (linear), rotation (w, x, y, z), red, green, blue and opacity in 255 steps, and the
//! SH bands from 1 up to degree 2 at most, by band, then channel. [`Level`] selects the precision.
//!
//! | attribute | level 0 | level 1 | level 2 |
//! |---|---|---|---|
//! | mean | f32, exact | 16 bits about the centre of a bucket of ≤ 256 splats in a block of side b: b/131068, b ≤ 5 | as 1 |
//! | log standard deviation | rounding of f32 | f16: 1/2048 from e^−9.7 to e^11, less exact below, clipped above | as 1 |
//! | rotation | rounding of f32 | f16: 0.06° | as 1 |
//! | colour, opacity | 1/510; colours outside of 0..1 are clipped | as 0 | as 0 |
//! | SH bands | f32, exact | f16: 1/2048 of the coefficient | 255 steps from the least to the greatest: 1/510 of their range |
//!
//! The figures are the largest errors of [`write()`]. The file cannot state its frame: as for PLY it is the scene's
//! own, by convention y down.

mod decode;
mod encode;

use std::path::Path;

use super::error::{Fault, open_file};
use super::loss::{Loss, WriteReport};
use super::{FormatError, ReadOptions, SplatFile, atomic_write_with};
use crate::scene::Splats;

/// Bytes of the file header.
const HEADER: usize = 4096;
/// Bytes of a section header.
const SECTION_HEADER: usize = 1024;
/// Bytes of a bucket's centre.
const CENTER: usize = 12;
/// Half the range of a 16-bit mean.
const MEAN_RANGE: u32 = 32767;
/// Highest SH degree of the format.
const MAX_DEGREE: u32 = 2;
/// Half the range of 8-bit SH if the header does not state one.
const DEFAULT_SH_RANGE: f32 = 1.5;

/// Compression level of the format.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Level {
    /// 0: f32.
    #[default]
    Float,
    /// 1: 16 bits.
    Half,
    /// 2: 16 bits, and 8 for SH.
    HalfAndByte,
}

impl Level {
    fn from_code(code: u16) -> Option<Self> {
        [Self::Float, Self::Half, Self::HalfAndByte].into_iter().find(|&level| level as u16 == code)
    }

    /// Bytes per component: of mean, scale and rotation, and of SH.
    fn component_bytes(self) -> (usize, usize) {
        match self {
            Self::Float => (4, 4),
            Self::Half => (2, 2),
            Self::HalfAndByte => (2, 1),
        }
    }

    /// Bytes of a splat.
    fn splat_bytes(self, sh_degree: u32) -> usize {
        let (component, sh_component) = self.component_bytes();
        10 * component + 4 + crate::scene::sh::band_floats(sh_degree) * sh_component
    }
}

/// Reads splats of any compression level: the file says no more than splats, and no option applies to it.
///
/// # Errors
/// If the file cannot be read, is not a `.ksplat`, is truncated, contradicts itself, or holds values that
/// [`Splats::new`] rejects.
pub fn read(path: &Path, _options: &ReadOptions<'_>) -> Result<SplatFile, FormatError> {
    let splats = decode::decode(open_file(path)?).map_err(|fault| fault.in_file(path))?;
    Ok(SplatFile::of(splats))
}

/// Writes splats: in their own order at level 0, bucket by bucket at other levels.
///
/// # Errors
/// If there are more splats than the format can count, or the file cannot be written.
pub fn write(path: &Path, splats: &Splats, level: Level) -> Result<WriteReport, FormatError> {
    if u32::try_from(splats.len()).is_err() {
        let fault = Fault::whole("at most 4294967295 splats", splats.len().to_string());
        return Err(fault.in_file(path));
    }
    let mut loss = Loss::default();
    let bytes = atomic_write_with(path, |out| {
        loss = encode::encode(splats, level, out)?;
        Ok(())
    })?;
    Ok(WriteReport { bytes, loss, ..WriteReport::default() })
}

#[cfg(test)]
mod tests;
