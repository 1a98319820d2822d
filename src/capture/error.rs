use std::io::Read as _;
use std::path::{Path, PathBuf};

use crate::{format::FormatError, scene::SceneError};

/// Why a capture cannot be used. Every message is one line with the file, the place, what was expected and what
/// was found.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum CaptureError {
    /// A file or folder cannot be read.
    #[error("{}: cannot read: {source}", .path.display())]
    Io {
        /// What was opened.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// A file ends before what it announces.
    #[error("{}: ends at byte {offset}, expected {expected}", .path.display())]
    Truncated {
        /// The file.
        path: PathBuf,
        /// Its length, or the offset at which too few bytes are left.
        offset: usize,
        /// What should have followed.
        expected: String,
    },
    /// A value in a file is not what its format asks for.
    #[error("{}: {place}: expected {expected}, found {found}", .path.display())]
    Invalid {
        /// The file or folder.
        path: PathBuf,
        /// Byte, line, JSON pointer, or property of an image.
        place: String,
        /// What would have been accepted.
        expected: String,
        /// What was there.
        found: String,
    },
    /// A camera model for which no pinhole image can be made.
    #[error(
        "{}: {place}: expected a camera model with a pinhole image, found camera model {}; undistort the capture with COLMAP first",
        .path.display(),
        .model.chars().take(60).collect::<String>().escape_debug()
    )]
    UnsupportedModel {
        /// The file that names it.
        path: PathBuf,
        /// Byte, line or JSON pointer.
        place: String,
        /// COLMAP's or nerfstudio's name, or the number of an unknown one.
        model: String,
    },
    /// An image cannot be decoded; decoders do not say where.
    #[error("{}: expected a PNG or JPEG, found one that cannot be decoded: {reason}", .path.display())]
    Image {
        /// The image.
        path: PathBuf,
        /// The decoder's reason.
        reason: String,
    },
    /// Its points cannot be read.
    #[error(transparent)]
    Points(#[from] FormatError),
    /// Images or masks that the capture names do not exist.
    #[error("{}: {count} of {total} {what} missing, the first is {first}", .folder.display())]
    Missing {
        /// Where they were looked for.
        folder: PathBuf,
        /// `images` or `masks`.
        what: &'static str,
        /// How many are not there.
        count: usize,
        /// How many there should be.
        total: usize,
        /// The first one: an image's path in the folder, or the image that lacks a mask.
        first: String,
    },
}

impl CaptureError {
    pub(super) fn invalid(
        path: &Path,
        place: impl Into<String>,
        expected: impl Into<String>,
        found: impl Into<String>,
    ) -> Self {
        // Numbers of 300 digits, and what decoders quote.
        const MOST: usize = 200;
        let mut found: String = found.into();
        if let Some((cut, _)) = found.char_indices().nth(MOST) {
            found.truncate(cut);
            found.push('…');
        }
        Self::Invalid { path: path.into(), place: place.into(), expected: expected.into(), found }
    }

    /// JSON that is no such thing, or not what it should be.
    pub(super) fn json(path: &Path, expected: &str, error: &serde_json::Error) -> Self {
        let place = format!("line {} column {}", error.line(), error.column());
        let why = error.to_string();
        let why = why.split(" at line ").next().unwrap_or_default();
        // The parser's words for what it cannot begin to read, such as NaN, which JSON has no way to write, say what it wanted.
        let found = if error.is_syntax() { format!("no JSON: {why}") } else { why.to_owned() };
        Self::invalid(path, place, expected, found)
    }

    /// A value that `scene` refuses, found at `place` of `path`.
    pub(super) fn scene(path: &Path, place: &str, error: SceneError) -> Self {
        Self::invalid(path, format!("{place}: {}", error.field), error.expected, error.found)
    }
}

/// The bytes of `path`.
pub(super) fn read(path: &Path) -> Result<Vec<u8>, CaptureError> {
    std::fs::read(path).map_err(|source| CaptureError::Io { path: path.into(), source })
}

/// The first bytes of a file, at most so many, and the length of all of it.
pub(super) fn read_start(path: &Path, most: usize) -> Result<(Vec<u8>, usize), CaptureError> {
    let read = || -> std::io::Result<_> {
        let file = std::fs::File::open(path)?;
        let length = file.metadata()?.len();
        let mut start = vec![];
        file.take(most as u64).read_to_end(&mut start)?;
        Ok((start, usize::try_from(length).unwrap_or(usize::MAX)))
    };
    read().map_err(|source| CaptureError::Io { path: path.into(), source })
}

/// The text of `path`, without the byte order mark that editors of Windows put before it.
pub(super) fn read_text(path: &Path) -> Result<String, CaptureError> {
    let mut text = String::from_utf8(read(path)?).map_err(|e| {
        let at = format!("byte {}", e.utf8_error().valid_up_to());
        CaptureError::invalid(path, at, "UTF-8 text", "other bytes")
    })?;
    if text.starts_with('\u{feff}') {
        text.remove(0);
    }
    Ok(text)
}
