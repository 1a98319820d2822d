//! Reading and writing of scene files in all supported formats. Readers check everything and report file, place,
//! expectation and finding; writers use a temporary file, so that no incomplete file is ever visible.

mod activation;
mod archive;
mod attribute;
mod blender;
mod blocks;
mod cameras;
mod content;
mod detect;
mod error;
mod exchange;
mod exr;
pub mod gltf;
mod inside;
mod inspect;
mod kind;
pub mod ksplat;
mod length;
mod loss;
mod map_budget;
pub mod mesh_import;
pub mod mitsuba;
mod notes;
mod placed;
pub mod ply;
mod polygon;
mod preview;
mod read;
pub mod sog;
pub mod splat;
mod splat_record;
pub mod spz;
#[cfg(test)]
pub(crate) mod test_scenes;
pub mod usd;
mod validate;
mod write;

use std::fs::File;
use std::io::{self, BufWriter, Write as _};
use std::path::Path;

pub use attribute::Attribute;
pub use cameras::{CameraFile, DEFAULT_FPS, MAX_FRAMES, Sampling, frame_count, is_device, picture_names};
pub use content::{ReadOptions, SplatFile};
pub use detect::detect;
pub use error::{Fault, FormatError, Location, one_line, some_of};
pub use exchange::{Sharing, referred, sharing};
pub use exr::{Channel, ExrCompression, ExrHeader, SampleType, pixel_aspect, write_exr};
pub use inspect::{CameraSummary, CompositionSummary, MeshSummary, SplatSummary, Summary, inspect};
pub use kind::Format;
pub use length::stored_bytes;
pub use loss::{Loss, SplatError, WriteReport};
pub use read::{SceneFile, read_cameras, read_file, read_scene};
pub use validate::{Finding, Severity, Validation, validate};
pub use write::{WRITABLE_CAMERAS, WriteOptions, write_cameras, write_cameras_with_scene, write_scene};

use crate::atomic;

/// Upper bound on the bytes of pixels per stored byte of an image. Deflate reaches 1032, each of which is 8 one-bit
/// pixels, or 24 bytes of palette colours: 24,768. No memory is reserved for headers that claim more.
pub(crate) const MAX_PIXEL_RATIO: u64 = 1 << 15;

/// The same of a JPEG, which has at least one bit per block of 8×8 samples, and at least nine blocks per 32×32 pixels of
/// three components, which are 3072 bytes: 2731. The decoder of a progressive one also allocates coefficients, of 8 bytes
/// per pixel at most.
const MAX_JPEG_RATIO: u64 = 1 << 12;

/// Upper bound on the bytes of pixels per stored byte of an image, by the first bytes of its file.
pub(crate) fn max_pixel_ratio(start: &[u8]) -> u64 {
    if start.starts_with(&[0xff, 0xd8]) { MAX_JPEG_RATIO } else { MAX_PIXEL_RATIO }
}

/// Bytes besides its pixels to which an image may unpack, such as an (unused) colour profile; same as the `png` crate's
/// own limit.
pub(crate) const MAX_BESIDE_PIXELS: u64 = 64 << 20;

/// Image height assigned to cameras that do not state one.
const DEFAULT_HEIGHT: u32 = 1080;

/// Writes `bytes` to `path` via a temporary file in the same folder, so that `path` holds either its former content or
/// all of the new one.
///
/// # Errors
/// If the folder does not exist or cannot be written to.
pub fn atomic_write(path: &Path, bytes: &[u8]) -> Result<(), FormatError> {
    atomic_write_with(path, |out| out.write_all(bytes)).map(drop)
}

/// Same as [`atomic_write`], for content produced piecewise. Returns the number of bytes written.
///
/// # Errors
/// If the folder does not exist or cannot be written to, or `produce` fails.
pub fn atomic_write_with(
    path: &Path,
    produce: impl FnOnce(&mut BufWriter<&mut File>) -> io::Result<()>,
) -> Result<u64, FormatError> {
    atomic::write_with(path, produce).map_err(|source| FormatError::Write { file: path.to_owned(), source })
}

/// Whether the extension of a file name is one of `extensions` (without dot), ignoring case.
#[must_use]
pub fn has_extension(path: &Path, extensions: &[&str]) -> bool {
    path.extension().is_some_and(|own| extensions.iter().any(|extension| own.eq_ignore_ascii_case(extension)))
}
