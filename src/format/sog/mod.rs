//! SOG (spatially ordered Gaussians, `PlayCanvas`): `meta.json` and lossless `WebP` images, together in a folder or in a
//! zip called `.sog`. The format is described at
//! <https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/sog/>.
//!
//! One texel is one splat: means in 16 bits of a signed logarithm, rotations in 26, opacities in 8; scales and colours
//! are indices into codebooks of 256 values, harmonics into a palette of up to 65,536 vectors. Version 1, which has
//! ranges in place of codebooks, is read but not written.

mod codebook;
mod decode;
mod encode;
mod files;
mod levels;
mod palette;
#[cfg(test)]
mod tests;
mod texels;

use std::path::Path;

use rayon::prelude::*;

use self::files::FileSet;
use super::NotedSplats;
use super::error::{Fault, FormatError};
use super::loss::{Loss, SplatError, WriteReport};
use super::splat_record::SplatRecord;
use crate::scene::Splats;

/// Reads a `.sog` bundle, or a folder of the same files by the path of its `meta.json`. Versions 1 and 2, SH degree 0
/// to 3. Frame and colour space are the file's own: the format cannot state them.
///
/// Of a scene in levels of detail (`lod-meta.json`) every part is read at the finest level that is there.
///
/// # Errors
/// If a file cannot be read or is missing, names a path outside of the folder, holds lossy images or images of another
/// size than the number of splats calls for, refers to more than its palettes hold, or declares more splats than files
/// of its size can describe.
pub fn read(path: &Path) -> Result<Splats, FormatError> {
    read_noted(path).map(|read| read.splats)
}

/// As [`read`], with the pixel filter, and a sentence on levels of detail that are missing.
///
/// # Errors
/// As [`read`].
pub fn read_noted(path: &Path) -> Result<NotedSplats, FormatError> {
    if path.file_name().is_some_and(|name| name == levels::INDEX) {
        return levels::read(path);
    }
    let (splats, antialiased) = FileSet::open(path)?.splats().map_err(|fault| fault.in_file(path))?;
    Ok(NotedSplats::new(splats, antialiased, vec![]))
}

/// True if the file's name alone says that it is SOG.
pub(super) fn is_named(path: &Path) -> bool {
    path.file_name().is_some_and(|name| name == files::META || name == levels::INDEX)
}

/// Length of the files that a `meta.json` or a `lod-meta.json` names, see [`super::stored_bytes`]; a bundle has none.
pub(super) fn bytes_beside(path: &Path) -> Result<u64, FormatError> {
    if path.file_name().is_some_and(|name| name == levels::INDEX) {
        return levels::bytes_beside(path);
    }
    FileSet::open(path)?.bytes_beside().map_err(|fault| fault.in_file(path))
}

impl FileSet {
    /// And whether the file says *antialias*.
    fn splats(&mut self) -> Result<(Splats, bool), Fault> {
        let meta = self.meta()?;
        let scheme = decode::Scheme::parse(&meta, self.bytes()).map_err(|fault| self.in_meta(fault))?;
        let images = scheme.fetch(self)?;
        let splats = scheme.decoder(&images).and_then(|decoder| decoder.splats());
        Ok((splats.map_err(|fault| self.in_meta(fault))?, meta.antialias))
    }
}

/// Writes version 2, splats in Morton order: a bundle, or where `path` ends in `meta.json` the files of one into that
/// folder (the images first, each at once or not at all). The same splats always give the same bytes.
///
/// # Errors
/// If a file cannot be written, or there are more splats than an image has texels (16384²).
pub fn write(path: &Path, splats: &Splats) -> Result<WriteReport, FormatError> {
    write_with(path, splats, false)
}

/// As [`write()`]; `antialiased` is stated in the file: whether splats are to keep their integral over a picture
/// (`PixelFilter::normalized`).
///
/// # Errors
/// As [`write()`].
pub fn write_with(path: &Path, splats: &Splats, antialiased: bool) -> Result<WriteReport, FormatError> {
    let encoded = encode::encode(splats, antialiased).map_err(|fault| fault.in_file(path))?;
    let written = decode::Scheme::parse(&encoded.meta, u64::MAX).map_err(|fault| fault.in_file(path))?;
    let written = written.decoder(&encoded.images).map_err(|fault| fault.in_file(path))?;
    let errors = encoded.order.par_iter().enumerate().map(|(i, &source)| {
        let mut error = SplatError::default();
        error.include(&SplatRecord::of(splats, source), &written.record(i));
        error
    });
    let loss = Loss { max_error: errors.reduce(SplatError::default, SplatError::max), ..Loss::default() };
    Ok(WriteReport { bytes: files::write(path, &encoded)?, loss, ..WriteReport::default() })
}
