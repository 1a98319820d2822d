use std::fmt;
use std::io::BufReader;
use std::path::{Path, PathBuf};

use serde::Serialize;

use crate::scene::SceneError;

/// Why a file could not be read or written. One line: the file, where in it, what was expected, what was found.
#[derive(Debug, thiserror::Error)]
pub enum FormatError {
    /// The operating system refused to read.
    #[error("{}: cannot read: {source}", file.display())]
    Read {
        /// File that was to be read.
        file: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// The operating system refused to write. Nothing is left at the target.
    #[error("{}: cannot write: {source}", file.display())]
    Write {
        /// File that was to be written.
        file: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// The content is malformed, or is well-formed but not something Centaur can represent.
    #[error("{}: {location}expected {expected}, found {found}", file.display())]
    Content {
        /// File at fault.
        file: PathBuf,
        /// Where in the file.
        location: Location,
        /// What would have been accepted.
        expected: String,
        /// What was there.
        found: String,
    },
}

/// A place in a file. Displays as a prefix of a message: `byte 1204: `.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Location {
    /// The file as a whole.
    File,
    /// Offset in bytes from the start of the file.
    Byte(u64),
    /// Place in a text, both counted from 1; the column in characters.
    Line {
        /// Line.
        line: u64,
        /// Column.
        column: u64,
    },
    /// JSON pointer (RFC 6901) into the glTF document, or path of a prim or property of a USD layer.
    Pointer(String),
    /// A field of the scene that was being made: `means[17]`.
    Field(String),
}

impl fmt::Display for Location {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::File => Ok(()),
            Self::Byte(offset) => write!(f, "byte {offset}: "),
            Self::Line { line, column } => write!(f, "line {line}, column {column}: "),
            Self::Pointer(pointer) => write!(f, "{pointer}: "),
            Self::Field(field) => write!(f, "{field}: "),
        }
    }
}

/// [`FormatError::Content`] before the file's name is known: what the parsers return.
#[derive(Debug)]
pub(crate) struct Fault {
    location: Location,
    expected: String,
    found: String,
}

impl Fault {
    pub(crate) fn whole(expected: impl Into<String>, found: impl Into<String>) -> Self {
        Self { location: Location::File, expected: expected.into(), found: found.into() }
    }

    pub(crate) fn byte(offset: usize, expected: impl Into<String>, found: impl Into<String>) -> Self {
        Self { location: Location::Byte(offset as u64), expected: expected.into(), found: found.into() }
    }

    pub(crate) fn at(location: Location, expected: impl Into<String>, found: impl Into<String>) -> Self {
        Self { location, expected: expected.into(), found: found.into() }
    }

    pub(crate) fn pointer(at: impl Into<String>, expected: impl Into<String>, found: impl Into<String>) -> Self {
        Self { location: Location::Pointer(at.into()), expected: expected.into(), found: found.into() }
    }

    /// The system or the end of the file kept a reader from what should be at `offset`.
    pub(crate) fn unreadable(offset: u64, error: &std::io::Error) -> Self {
        Self { location: Location::Byte(offset), expected: "readable content".to_owned(), found: error.to_string() }
    }

    /// The same at a place that the finder did not know.
    pub(crate) fn at_byte(self, offset: usize) -> Self {
        Self { location: Location::Byte(offset as u64), ..self }
    }

    /// As [`Self::at_byte`], unless the finder did know.
    pub(crate) fn or_at_byte(self, offset: usize) -> Self {
        if self.location == Location::File { self.at_byte(offset) } else { self }
    }

    /// Where, what was expected and what was found.
    pub(crate) fn into_parts(self) -> (Location, String, String) {
        (self.location, self.expected, self.found)
    }

    pub(crate) fn in_file(self, file: &Path) -> FormatError {
        let Self { location, expected, found } = self;
        FormatError::Content { file: file.to_owned(), location, expected, found }
    }
}

impl From<SceneError> for Fault {
    fn from(e: SceneError) -> Self {
        Self { location: Location::Field(e.field), expected: e.expected, found: e.found }
    }
}

/// Text of a file as it may stand in a message: short, in one line.
pub(crate) fn shown(text: &[u8]) -> String {
    const MOST: usize = 60;
    let text = String::from_utf8_lossy(&text[..text.len().min(4 * MOST)]);
    let cut = if text.chars().count() > MOST { "…" } else { "" };
    format!("`{}{cut}`", text.chars().take(MOST).flat_map(char::escape_debug).collect::<String>())
}

/// The file, to be read piece by piece.
pub(crate) fn open_file(path: &Path) -> Result<BufReader<std::fs::File>, FormatError> {
    let file = std::fs::File::open(path).map_err(|source| FormatError::Read { file: path.to_owned(), source })?;
    Ok(BufReader::with_capacity(1 << 18, file))
}

/// The whole file in memory. Its length bounds every count that the file declares.
pub(crate) fn read_file(path: &Path) -> Result<Vec<u8>, FormatError> {
    std::fs::read(path).map_err(|source| FormatError::Read { file: path.to_owned(), source })
}
