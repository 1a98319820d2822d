//! Reading and writing of scene files in all supported formats. Readers check everything and report file, place,
//! expectation and finding; writers use a temporary file, so that no incomplete file is ever visible.

mod activation;
mod archive;
mod blender;
mod blocks;
mod cameras;
mod error;
mod exchange;
mod exr;
pub mod gltf;
mod inside;
mod inspect;
pub mod ksplat;
mod length;
mod loss;
mod map_budget;
pub mod mesh_import;
pub mod mitsuba;
mod placed;
pub mod ply;
mod polygon;
mod preview;
mod scene_file;
pub mod sog;
pub mod splat;
mod splat_record;
pub mod spz;
#[cfg(test)]
pub(crate) mod test_scenes;
pub mod usd;
mod validate;

use std::fs::File;
use std::io::{self, BufWriter, Write as _};
use std::path::Path;

pub use cameras::{
    CameraFile, DEFAULT_FPS, MAX_FRAMES, Sampling, WRITABLE_CAMERAS, frame_count, picture_names, read_cameras, some_of,
    write_cameras, write_cameras_with_scene,
};
pub use error::{FormatError, Location, one_line};
pub use exchange::{Sharing, sharing};
pub use exr::{Channel, ExrCompression, ExrHeader, SampleType, pixel_aspect, write_exr};
pub use inspect::{CameraSummary, CompositionSummary, MeshSummary, SplatSummary, Summary, inspect};
pub use length::stored_bytes;
pub use loss::{Loss, SplatError, WriteReport};
pub use scene_file::{
    EXPORTABLE, ReadOptions, SPLATS_ALONE, SceneFile, WRITABLE, WriteOptions, read_file, write_scene,
};
pub use validate::{Finding, Severity, Validation, validate};

use crate::atomic;
use crate::scene::{HybridScene, PixelFilter, Splats};

/// Upper bound on the bytes of pixels per stored byte of an image. Deflate reaches 1032, each of which is 8 one-bit
/// pixels, or 24 bytes of palette colours: 24,768. A progressive JPEG of a single colour reaches about 1000 (one bit
/// per 8×8 block). No memory is reserved for headers that claim more.
pub(crate) const MAX_PIXEL_RATIO: u64 = 1 << 15;

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

/// File format, recognised by the first bytes, or by the extension where a format has no signature.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Kind {
    Gltf,
    Ksplat,
    Ply,
    Sog,
    Splat,
    Spz,
    Usd,
}

impl Kind {
    /// Display name of the format.
    fn name(self) -> &'static str {
        match self {
            Self::Gltf => "glTF",
            Self::Ksplat => "ksplat",
            Self::Ply => "PLY",
            Self::Sog => "SOG",
            Self::Splat => "splat",
            Self::Spz => "SPZ",
            Self::Usd => "USD",
        }
    }
}

/// Splats of a format that carries further information about them.
#[derive(Clone, Debug)]
pub struct NotedSplats {
    /// The splats.
    pub splats: Splats,
    /// Pixel filter with which the splats were trained: [`PixelFilter::NORMALIZED_DILATION`] where the file says
    /// *antialiased*.
    pub pixel_filter: PixelFilter,
    /// Notes on content that could not be represented, one sentence each.
    pub notes: Vec<String>,
}

impl NotedSplats {
    fn new(splats: Splats, antialiased: bool, notes: Vec<String>) -> Self {
        let pixel_filter = if antialiased { PixelFilter::NORMALIZED_DILATION } else { PixelFilter::DILATION };
        Self { splats, pixel_filter, notes }
    }
}

/// Reads a hybrid scene from a `.glb`, `.gltf`, `.usda`, `.usdc` or `.usdz` file, or splats alone from a `.ply` (INRIA
/// or compressed), `.sog`, `.spz`, `.splat` or `.ksplat`. Formats are recognised by content; `.splat` and `.ksplat`,
/// which have no signature, and the `meta.json` or `lod-meta.json` of a SOG folder are recognised by the file name.
///
/// The scene is in the frame of captures: x to the right, y down, z forward, as OpenCV's cameras have it. glTF and USD of other programs,
/// which are y up, are turned half about x ([`OPENGL_FROM_OPENCV`](crate::scene::frame::OPENGL_FROM_OPENCV));
/// [`write_scene`] turns them again, so that they stay where they were. What states no frame, as `.ply`, is taken as it is. Rewriting coordinates in other frames is for
/// [`edit::Axes`](crate::edit::Axes).
///
/// # Errors
/// If the file cannot be read or is none of these; see [`gltf::read`], [`usd::read`], [`ply::read`], [`sog::read`],
/// [`spz::read`], [`splat::read`] and [`ksplat::read`].
pub fn read_scene(path: &Path) -> Result<HybridScene, FormatError> {
    Ok(read_file(path, &ReadOptions::default())?.scene)
}

fn kind(path: &Path) -> Result<Kind, FormatError> {
    use std::io::Read as _;
    let failed = |source| FormatError::Read { file: path.to_owned(), source };
    let mut start = vec![];
    // Enough bytes to get past white space at the start of JSON.
    error::open_file(path)?.take(256).read_to_end(&mut start).map_err(failed)?;
    let first = start.iter().find(|b| !b.is_ascii_whitespace());
    if start.starts_with(b"glTF") {
        Ok(Kind::Gltf)
    } else if start.starts_with(b"ply") {
        Ok(Kind::Ply)
    } else if usd::is_usd(&start) {
        Ok(Kind::Usd)
    } else if sog::is_named(path) || start.starts_with(b"PK\x03\x04") {
        Ok(Kind::Sog)
    } else if start.starts_with(b"NGSP") || start.starts_with(&[0x1f, 0x8b, 8]) {
        // If the gzip stream holds something else, opening it will report so.
        Ok(Kind::Spz)
    } else if has_extension(path, &["splat"]) {
        Ok(Kind::Splat)
    } else if has_extension(path, &["ksplat"]) {
        Ok(Kind::Ksplat)
    } else if first == Some(&b'{') {
        Ok(Kind::Gltf)
    } else {
        let expected = "a .glb, .gltf, .usda, .usdc, .usdz, .ply, .sog, .spz, .splat or .ksplat file";
        Err(error::Fault::byte(0, expected, error::no_scene(path, &start)).in_file(path))
    }
}
