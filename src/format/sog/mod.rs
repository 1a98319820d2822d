//! SOG (spatially ordered Gaussians, `PlayCanvas`): `meta.json` and lossless `WebP` images, in a folder or in a zip
//! called `.sog`. The format is described at
//! <https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/sog/>.
//!
//! One texel represents one splat: means in 16 bits of a signed logarithm, rotations in 26, opacities in 8; scales and
//! colours are indices into codebooks of 256 values, harmonics into a palette of up to 65,536 vectors. Version 1, which
//! has ranges instead of codebooks, is read but not written.

mod codebook;
mod decode;
mod encode;
mod files;
mod levels;
mod meta;
mod palette;
#[cfg(test)]
mod tests;
mod texels;

use std::path::Path;

use rayon::prelude::*;

use self::files::FileSet;
use super::content::pixel_filter_of;
use super::error::{Fault, FormatError, shown, some_of};
use super::loss::{Loss, SplatError, WriteReport};
use super::splat_record::SplatRecord;
use super::{ReadOptions, SplatFile};
use crate::scene::{PixelFilter, Splats};

/// Reads a `.sog` bundle, or a folder of the same files by the path of its `meta.json`. Versions 1 and 2, SH degree 0
/// to 3. Frame and colour space are the file's own, which the format cannot state.
///
/// Of a scene with levels of detail (`lod-meta.json`) the finest is read; for parts whose file is missing, the finest
/// available.
///
/// With the splats come the pixel filter, and a note each on missing levels of detail and on other content of the file,
/// such as a camera. No option applies.
///
/// # Errors
/// If a file cannot be read or is missing, names a path outside the folder, holds lossy images or images of a size
/// other than the number of splats requires, refers beyond its palettes, or declares more splats than files of its size
/// can describe.
pub fn read(path: &Path, _options: &ReadOptions<'_>) -> Result<SplatFile, FormatError> {
    if path.file_name().is_some_and(|name| name == levels::INDEX) {
        return levels::read(path);
    }
    FileSet::open(path)?.splats().map_err(|fault| fault.in_file(path))
}

/// Note on the keys of `file` that do not affect splats, if there are any.
fn left_out<'a>(file: &str, keys: impl Iterator<Item = &'a str>) -> Option<String> {
    let keys: Vec<String> = keys.map(|key| shown(key.as_bytes())).collect();
    (!keys.is_empty()).then(|| format!("{} of {file}: left out", some_of(keys.iter().map(String::as_str))))
}

/// Whether the file's name alone identifies it as SOG.
pub(super) fn is_named(path: &Path) -> bool {
    path.file_name().is_some_and(|name| name == files::META || name == levels::INDEX)
}

/// Total length of the files that a `meta.json` or a `lod-meta.json` names, see [`super::stored_bytes`]; 0 for a
/// bundle.
pub(super) fn bytes_beside(path: &Path) -> Result<u64, FormatError> {
    if path.file_name().is_some_and(|name| name == levels::INDEX) {
        return levels::bytes_beside(path);
    }
    FileSet::open(path)?.bytes_beside().map_err(|fault| fault.in_file(path))
}

impl FileSet {
    fn splats(&mut self) -> Result<SplatFile, Fault> {
        let meta = self.meta()?;
        let scheme = decode::Scheme::parse(&meta, self.bytes()).map_err(|fault| self.in_meta(fault))?;
        let images = scheme.fetch(self)?;
        let splats = scheme.decoder(&images).and_then(|decoder| decoder.splats());
        let splats = splats.map_err(|fault| self.in_meta(fault))?;
        let (antialiased, of_model) = meta.antialiased();
        let of_rest = left_out(files::META, meta.rest.keys().map(String::as_str));
        let notes = of_model.into_iter().chain(of_rest).collect();
        Ok(SplatFile { pixel_filter: pixel_filter_of(antialiased), notes, ..SplatFile::of(splats) })
    }
}

/// Writes version 2, splats in Morton order: a bundle, or, if `path` ends in `meta.json`, separate files in that folder
/// (images first, each written atomically). The same splats always give the same bytes. Of the filter the file states
/// whether projections of splats keep their integral.
///
/// # Errors
/// If a file cannot be written, or there are more splats than an image has texels (16384²).
pub fn write(path: &Path, splats: &Splats, pixel_filter: PixelFilter) -> Result<WriteReport, FormatError> {
    let encoded = encode::encode(splats, pixel_filter.normalized).map_err(|fault| fault.in_file(path))?;
    let written = decode::Scheme::parse(&encoded.meta, u64::MAX).map_err(|fault| fault.in_file(path))?;
    let written = written.decoder(&encoded.images).map_err(|fault| fault.in_file(path))?;
    let errors = encoded.order.par_iter().enumerate().map(|(i, &source)| {
        let mut error = SplatError::default();
        error.include(&SplatRecord::of(splats, source), &written.record(i));
        error
    });
    let loss = Loss { max_error: errors.reduce(SplatError::default, SplatError::max), ..Loss::default() };
    Ok(WriteReport { bytes: files::write(path, &encoded.meta, &encoded.images)?, loss, ..WriteReport::default() })
}
