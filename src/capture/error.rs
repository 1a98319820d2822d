use std::io::Read as _;
use std::path::{Path, PathBuf};

use crate::{format::FormatError, scene::SceneError};

/// Error of reading a capture. Every message is one line with the file, the place, what was expected and what was
/// found.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum CaptureError {
    /// A file or folder cannot be read.
    #[error("{}: cannot read: {source}", .path.display())]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// Error of the operating system.
        source: std::io::Error,
    },
    /// A file ends before the data it announces.
    #[error("{}: ends at byte {offset}, expected {expected}", .path.display())]
    Truncated {
        /// The file.
        path: PathBuf,
        /// Its length, or the offset at which too few bytes are left.
        offset: usize,
        /// What should have followed.
        expected: String,
    },
    /// A value in a file does not conform to its format.
    #[error("{}: {place}: expected {expected}, found {found}", .path.display())]
    Invalid {
        /// The file or folder.
        path: PathBuf,
        /// Byte, line, JSON pointer, or property of an image.
        place: String,
        /// What is expected there.
        expected: String,
        /// What was found there.
        found: String,
    },
    /// A camera model without a pinhole image.
    #[error(
        "{}: {place}: expected a camera model with a pinhole image, found camera model {}; {}",
        .path.display(),
        .model.chars().take(60).collect::<String>().escape_debug(),
        way_out(.model)
    )]
    UnsupportedModel {
        /// The file that names the model.
        path: PathBuf,
        /// Byte, line or JSON pointer.
        place: String,
        /// COLMAP's or nerfstudio's name of the model, or its number if unknown.
        model: String,
    },
    /// An image cannot be decoded; decoders do not report where.
    #[error("{}: expected a PNG or JPEG, found one that cannot be decoded: {reason}", .path.display())]
    Image {
        /// The image.
        path: PathBuf,
        /// The decoder's message.
        reason: String,
    },
    /// The points cannot be read.
    #[error(transparent)]
    Points(#[from] FormatError),
    /// Images or masks that the capture names do not exist.
    #[error("{}: {count} of {total} {what} missing, the first is {first}", .folder.display())]
    Missing {
        /// Folder in which they were expected; the file that names images where that is the current folder.
        folder: PathBuf,
        /// `images` or `masks`.
        what: &'static str,
        /// Number of missing files.
        count: usize,
        /// Number of files named.
        total: usize,
        /// The first missing one: an image's path in the folder, or the image that lacks a mask.
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
        // Shortens numbers of 300 digits, and quotes by decoders.
        const MOST: usize = 200;
        let mut found: String = found.into();
        if let Some((cut, _)) = found.char_indices().nth(MOST) {
            found.truncate(cut);
            found.push('…');
        }
        Self::Invalid { path: path.into(), place: place.into(), expected: expected.into(), found }
    }

    /// Error for text that is no JSON, or not of the expected shape.
    pub(super) fn json(path: &Path, expected: &str, error: &serde_json::Error) -> Self {
        let place = format!("line {} column {}", error.line(), error.column());
        let why = error.to_string();
        let why = why.split(" at line ").next().unwrap_or_default();
        let found = match no_number(path, error) {
            Some(word) => format!("{word}, which is no number in JSON"),
            // For text that the parser cannot begin to read, its message says what it wanted.
            None if error.is_syntax() => format!("no JSON: {why}"),
            None => why.to_owned(),
        };
        Self::invalid(path, place, expected, found)
    }

    /// Error for a value that `scene` refuses, found at `place` of `path`.
    pub(super) fn scene(path: &Path, place: &str, error: SceneError) -> Self {
        Self::invalid(path, format!("{place}: {}", error.field), error.expected, error.found)
    }
}

/// What Python writes for a number that JSON has no way to write, where that is what the parser stopped at.
fn no_number(path: &Path, error: &serde_json::Error) -> Option<&'static str> {
    let text = read_text(path).ok().filter(|_| error.is_syntax())?;
    let line = text.split('\n').nth(error.line().checked_sub(1)?)?;
    let rest = line.as_bytes().get(error.column().checked_sub(1)?..)?;
    ["NaN", "Infinity"].into_iter().find(|word| rest.starts_with(word.as_bytes()))
}

/// How to use photographs of a camera model that has no pinhole image.
fn way_out(model: &str) -> &'static str {
    if model.eq_ignore_ascii_case("equirectangular") {
        "cut perspective views out of the panoramas first"
    } else {
        "undistort the capture with COLMAP first"
    }
}

/// The bytes of `path`.
pub(super) fn read(path: &Path) -> Result<Vec<u8>, CaptureError> {
    std::fs::read(path).map_err(|source| CaptureError::Io { path: path.into(), source })
}

/// First bytes of a file, at most `most`, and the length of the whole file.
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

/// Text of `path`, without the byte order mark that editors of Windows put in front.
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_python_writes_for_no_number_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("transforms.json");
        for (text, found) in [
            ("{\n \"a\": [[NaN, 1]] }", "line 2 column 9: expected frames, found NaN, which is no number in JSON"),
            ("{\n \"a\": -Infinity }", "expected frames, found Infinity, which is no number in JSON"),
            ("{\n \"a\": nan }", "expected frames, found no JSON: expected ident"),
            ("{ \"a\": ", "expected frames, found EOF while parsing a value"),
        ] {
            std::fs::write(&path, text).unwrap();
            let error = serde_json::from_str::<serde_json::Value>(text).unwrap_err();
            let said = CaptureError::json(&path, "frames", &error).to_string();
            assert!(said.ends_with(found), "{text}: {said}");
        }
    }

    #[test]
    fn panoramas_are_cut_rather_than_undistorted() {
        let said = |model: &str| {
            let (path, place) = ("a.json".into(), "/frames/0".to_owned());
            CaptureError::UnsupportedModel { path, place, model: model.to_owned() }.to_string()
        };
        assert!(said("EQUIRECTANGULAR").ends_with("; cut perspective views out of the panoramas first"));
        assert!(said("ORTHOPHOTO").ends_with("; undistort the capture with COLMAP first"));
    }
}
