//! File formats: what is written to and read from disk. Readers check everything and name file, place, expectation
//! and finding; writers go through a temporary file, so that nothing half-written is ever seen.

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

/// Bytes of pixels a byte of an image can stand for at most. Deflate reaches 1032, of which each is 8 pixels of 1 bit, or 24 bytes of a
/// palette's colours: 24,768. A progressive JPEG of one colour has about 1000 (one bit per 8×8 block). Memory is not reserved on the word of a
/// header that claims more.
pub(crate) const MAX_PIXEL_RATIO: u64 = 1 << 15;

/// Bytes that an image may unpack to besides its pixels, as a colour profile, of which nothing is used; the `png` crate has the same by itself.
pub(crate) const MAX_BESIDE_PIXELS: u64 = 64 << 20;

/// Image height given to cameras that do not state one.
const DEFAULT_HEIGHT: u32 = 1080;

/// Writes `bytes` to `path` by way of a temporary file in the same folder, so that `path` holds either its former
/// content or all of the new one.
///
/// # Errors
/// If the folder does not exist or cannot be written to.
pub fn atomic_write(path: &Path, bytes: &[u8]) -> Result<(), FormatError> {
    atomic_write_with(path, |out| out.write_all(bytes)).map(drop)
}

/// As [`atomic_write`], for content that is produced piecemeal. Returns the number of bytes written.
///
/// # Errors
/// If the folder does not exist or cannot be written to, or `produce` fails.
pub fn atomic_write_with(
    path: &Path,
    produce: impl FnOnce(&mut BufWriter<&mut File>) -> io::Result<()>,
) -> Result<u64, FormatError> {
    atomic::write_with(path, produce).map_err(|source| FormatError::Write { file: path.to_owned(), source })
}

/// Whether the name of a file ends in one of `extensions` (without dot), in any case.
#[must_use]
pub fn has_extension(path: &Path, extensions: &[&str]) -> bool {
    path.extension().is_some_and(|own| extensions.iter().any(|extension| own.eq_ignore_ascii_case(extension)))
}

/// What a file is: by its first bytes, and by its extension where a format has no mark of its own.
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
    /// For people.
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

/// Splats of a format that says something more of them.
#[derive(Clone, Debug)]
pub struct NotedSplats {
    /// The splats.
    pub splats: Splats,
    /// What they were trained to be seen with: [`PixelFilter::NORMALIZED_DILATION`] where the file says *antialiased*.
    pub pixel_filter: PixelFilter,
    /// What could not be taken over, one sentence each.
    pub notes: Vec<String>,
}

impl NotedSplats {
    fn new(splats: Splats, antialiased: bool, notes: Vec<String>) -> Self {
        let pixel_filter = if antialiased { PixelFilter::NORMALIZED_DILATION } else { PixelFilter::DILATION };
        Self { splats, pixel_filter, notes }
    }
}

/// Reads a hybrid scene from a `.glb`, `.gltf`, `.usda`, `.usdc` or `.usdz` file, or splats alone from a `.ply` (INRIA or compressed), `.sog`, `.spz`,
/// `.splat` or `.ksplat`. They are told by their content; the last two, which have no mark of their
/// own, and the `meta.json` or `lod-meta.json` of a SOG that is a folder by the file's name.
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
    // Enough to see past the white space with which JSON may begin.
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
        // gzip of something else says so when it is opened.
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
