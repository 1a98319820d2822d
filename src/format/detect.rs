//! Detection of the format of a file that is read.

use std::io::Read as _;
use std::path::Path;

use super::error::{Fault, no_scene, open_file};
use super::{Format, FormatError, sog, usd};

/// Finds the format of a scene file by its first bytes: `.splat` and `.ksplat`, which have no signature, and the
/// `meta.json` or `lod-meta.json` of a SOG folder are recognised by the file name.
///
/// # Errors
/// If the file cannot be read or is of no format that [`read_file`](super::read_file) reads.
pub fn detect(path: &Path) -> Result<Format, FormatError> {
    let mut start = vec![];
    // Enough bytes to get past white space at the start of JSON.
    let read = open_file(path)?.take(256).read_to_end(&mut start);
    read.map_err(|source| FormatError::Read { file: path.to_owned(), source })?;
    of_start(path, &start).ok_or_else(|| {
        let expected = "a .glb, .gltf, .usda, .usdc, .usdz, .ply, .sog, .spz, .splat or .ksplat file";
        Fault::byte(0, expected, no_scene(path, &start)).in_file(path)
    })
}

/// Format of the file at `path`, which begins with `start`.
fn of_start(path: &Path, start: &[u8]) -> Option<Format> {
    let is = |signature: &[u8]| start.starts_with(signature);
    let named = Format::of_path(path).filter(|format| matches!(format, Format::Splat | Format::Ksplat));
    if is(b"glTF") {
        Some(Format::Glb)
    } else if is(b"ply") {
        Some(Format::Ply)
    } else if let Some(usd) = usd::format_of(start) {
        Some(usd)
    } else if is(b"PK\x03\x04") && Format::of_path(path) == Some(Format::Usdz) {
        // Its first file is not a layer, as opening it will report.
        Some(Format::Usdz)
    } else if sog::is_named(path) || is(b"PK\x03\x04") {
        Some(Format::Sog)
    } else if is(b"NGSP") || is(&[0x1f, 0x8b, 8]) {
        // If the gzip stream holds something else, opening it will report so.
        Some(Format::Spz)
    } else if named.is_some() {
        named
    } else {
        let first = start.iter().find(|b| !b.is_ascii_whitespace());
        (first == Some(&b'{')).then_some(Format::Gltf)
    }
}
