//! Errors of reading and writing files, with the place of a fault, and first steps of reading a file.

use std::borrow::Cow;
use std::fmt;
use std::io::{BufReader, Read as _};
use std::path::{Path, PathBuf};

use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::Value;

use super::has_extension;
use crate::scene::SceneError;

/// Error of reading or writing a file. Displays as one line: file, place in it, expectation, finding.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
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
    #[error("{}: {fault}", file.display())]
    Content {
        /// File at fault.
        file: PathBuf,
        /// Where in the file, and what is wrong with it.
        fault: Fault,
    },
}

/// What is expected of a file, and what of what it holds, where it is a scene without cameras. See [`FormatError::is_lack_of_cameras`].
pub(super) const NO_CAMERAS: [&str; 2] =
    ["a file that can hold cameras: .glb, .gltf, .usda, .usdc, .usdz or .json", "cameras"];

/// What is expected of a glTF where little more is known than that it is broken. See [`FormatError::invalid_gltf`].
pub(super) const VALID_GLTF: &str = "valid glTF 2.0";

impl FormatError {
    /// Whether nothing else is wrong with a file whose cameras were to be read than that it holds none. Cameras that cannot
    /// be read are another error, which gives the reason.
    #[must_use]
    pub fn is_lack_of_cameras(&self) -> bool {
        matches!(self, Self::Content { fault, .. } if NO_CAMERAS.contains(&fault.expected.as_str()))
    }

    /// File that is refused as no valid glTF 2.0 without the broken rule, which [`validate`](super::validate()) names.
    #[must_use]
    pub fn invalid_gltf(&self) -> Option<&Path> {
        match self {
            Self::Content { file, fault } if fault.expected == VALID_GLTF => Some(file.as_path()),
            _ => None,
        }
    }
}

/// A place in a file. Displays as a prefix of a message: `byte 1204: `.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Location {
    /// The file as a whole.
    File,
    /// Offset in bytes from the start of the file.
    Byte(u64),
    /// Line and column in a text, both counted from 1; the column in characters.
    Line {
        /// Line.
        line: u64,
        /// Column.
        column: u64,
    },
    /// JSON pointer (RFC 6901) into the glTF document, or path of a prim or property of a USD layer.
    Pointer(String),
    /// Field of the scene being built: `means[17]`.
    Field(String),
    /// Place in a member of a zip archive, or in the unpacked content of a compressed file.
    Member {
        /// Quoted name of the member, or `unpacked`.
        name: String,
        /// Place in the member.
        at: Box<Location>,
    },
}

impl fmt::Display for Location {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::File => Ok(()),
            Self::Byte(offset) => write!(f, "byte {offset}: "),
            Self::Line { line, column } => write!(f, "line {line}, column {column}: "),
            Self::Pointer(at) | Self::Field(at) => write!(f, "{}: ", one_line(at)),
            Self::Member { name, at } if **at == Self::File => write!(f, "{name}: "),
            Self::Member { name, at } => write!(f, "{name}, {at}"),
        }
    }
}

/// What is wrong with the content of a file. Displays as [`FormatError::Content`] without the file's name.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{location}expected {expected}, found {found}")]
pub struct Fault {
    /// Where in the file.
    pub location: Location,
    /// What the format, or Centaur, would accept.
    pub expected: String,
    /// What the file contains.
    pub found: String,
}

impl Fault {
    /// Creates a fault without a place: the request is at fault, not the file's content.
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

    /// Creates a fault for content at `offset` that could not be read, because of the system or the end of the file.
    pub(crate) fn unreadable(offset: u64, error: &std::io::Error) -> Self {
        Self { location: Location::Byte(offset), expected: "readable content".to_owned(), found: error.to_string() }
    }

    /// Sets the place, in bytes, of a fault that has none.
    pub(crate) fn at_byte(self, offset: usize) -> Self {
        Self { location: Location::Byte(offset as u64), ..self }
    }

    /// Same as [`Self::at_byte`], but keeps a place that is already known.
    pub(crate) fn or_at_byte(self, offset: usize) -> Self {
        if self.location == Location::File { self.at_byte(offset) } else { self }
    }

    /// Moves a fault to `at`, a JSON pointer or the path of a prim, if its place is no more than a field of the scene.
    pub(crate) fn under(self, at: impl Into<String>) -> Self {
        let found = match self.location {
            Location::File => self.found,
            Location::Field(field) => format!("{} in {field}", self.found),
            _ => return self,
        };
        Self { location: Location::Pointer(at.into()), found, ..self }
    }

    /// Moves a fault to the place of an element, given its index, if its place is no more than a field of the scene.
    pub(crate) fn of_element(self, place: impl FnOnce(usize) -> Location) -> Self {
        match self.element() {
            Some((name, i)) => Self { location: place(i), found: format!("{} in {name}[{i}]", self.found), ..self },
            None => self,
        }
    }

    /// Moves a fault to the part that contains the faulty element. Parts are consecutive; each has a number of elements
    /// and a pointer or the path of a prim.
    pub(crate) fn of_part<'a>(self, parts: impl IntoIterator<Item = (usize, &'a str)>) -> Self {
        let Some((name, mut i)) = self.element() else { return self };
        for (count, at) in parts {
            if i < count {
                let found = format!("{} in {name}[{i}]", self.found);
                return Self { location: Location::Pointer(at.to_owned()), found, ..self };
            }
            i -= count;
        }
        self
    }

    /// `means` and 17 of `means[17]`.
    pub(crate) fn element(&self) -> Option<(String, usize)> {
        let Location::Field(field) = &self.location else { return None };
        let (name, index) = field.strip_suffix(']')?.rsplit_once('[')?;
        Some((name.to_owned(), index.parse().ok()?))
    }

    /// The same, with what to do about it.
    pub(crate) fn with_advice(self, advice: &str) -> Self {
        Self { found: format!("{}; {advice}", self.found), ..self }
    }

    /// The same in a member of a zip.
    pub(crate) fn in_member(self, name: &str) -> Self {
        let location = Location::Member { name: shown(name.as_bytes()), at: Box::new(self.location) };
        Self { location, ..self }
    }

    /// Places a fault in the unpacked content of the file.
    pub(crate) fn unpacked(self) -> Self {
        match self.location {
            Location::File => self,
            at => Self { location: Location::Member { name: "unpacked".to_owned(), at: Box::new(at) }, ..self },
        }
    }

    pub(crate) fn in_file(self, file: &Path) -> FormatError {
        let Self { location, expected, found } = self;
        let [expected, found] = [expected, found].map(|text| one_line(&text).into_owned());
        FormatError::Content { file: file.to_owned(), fault: Self { location, expected, found } }
    }
}

impl From<SceneError> for Fault {
    fn from(e: SceneError) -> Self {
        Self { location: Location::Field(e.field), expected: e.expected, found: e.found }
    }
}

/// Parses JSON located at `offset` of a file. Syntax faults have a byte offset, faults of values a pointer.
pub(crate) fn from_json<T: DeserializeOwned>(json: &[u8], offset: usize, expected: &str) -> Result<T, Fault> {
    let mut text = serde_json::Deserializer::from_slice(json);
    let value = serde_path_to_error::deserialize(&mut text).map_err(|e| {
        if e.inner().is_data() {
            return Fault::pointer(pointer(e.path()), expected, e.inner().to_string());
        }
        in_text(e.inner(), json, offset, expected)
    })?;
    text.end().map_err(|e| in_text(&e, json, offset, expected))?;
    Ok(value)
}

fn in_text(error: &serde_json::Error, json: &[u8], offset: usize, expected: &str) -> Fault {
    let lines = json.split_inclusive(|&b| b == b'\n').take(error.line().max(1) - 1);
    let line_start: usize = lines.map(<[u8]>::len).sum();
    // Columns are counted from 1, except at the end of the text.
    let column = if error.is_eof() { error.column() } else { error.column().saturating_sub(1) };
    Fault::byte(offset + line_start + column, expected, error.to_string())
}

/// Converts a JSON value, located at pointer `at` of the document, to a type.
pub(crate) fn from_value<T: DeserializeOwned>(value: &Value, at: &str, expected: &str) -> Result<T, Fault> {
    serde_path_to_error::deserialize(value)
        .map_err(|e| Fault::pointer(format!("{at}{}", pointer(e.path())), expected, e.inner().to_string()))
}

/// JSON pointer (RFC 6901) as far as the path is known; empty for the whole document.
fn pointer(path: &serde_path_to_error::Path) -> String {
    use serde_path_to_error::Segment;
    let token = |segment: &Segment| match segment {
        Segment::Seq { index } => Some(format!("/{index}")),
        Segment::Map { key } => Some(format!("/{}", key.replace('~', "~0").replace('/', "~1"))),
        Segment::Enum { .. } | Segment::Unknown => None,
    };
    path.iter().map_while(token).collect()
}

/// Single-line form of a text, with control characters escaped: names and messages may quote file content.
#[must_use]
pub fn one_line(text: &str) -> Cow<'_, str> {
    if !text.contains(char::is_control) {
        return text.into();
    }
    let escaped = |c: char| if c.is_control() { c.escape_default().collect() } else { String::from(c) };
    text.chars().map(escaped).collect::<String>().into()
}

/// Joins the first few names for a message.
pub fn some_of<'a>(mut names: impl Iterator<Item = &'a str>) -> String {
    let mut some: Vec<&str> = names.by_ref().take(8).collect();
    some.extend(names.next().map(|_| "…"));
    some.join(", ")
}

/// Short single-line form of text from a file, for use in a message.
pub(crate) fn shown(text: &[u8]) -> String {
    const MOST: usize = 60;
    let text = String::from_utf8_lossy(&text[..text.len().min(4 * MOST)]);
    let cut = if text.chars().count() > MOST { "…" } else { "" };
    format!("`{}{cut}`", text.chars().take(MOST).flat_map(char::escape_debug).collect::<String>())
}

/// As [`unknown`], of a file that is no scene.
pub(crate) fn no_scene(path: &Path, start: &[u8]) -> &'static str {
    if has_extension(path, &["obj"]) {
        "an OBJ, which holds a mesh alone: `centaur train --mesh` and `centaur mesh --mesh` take it"
    } else {
        unknown(start)
    }
}

/// What a file is that begins like none that can be read. Editors of Windows put a mark before text, or write it in UTF-16: both look right there.
pub(crate) fn unknown(start: &[u8]) -> &'static str {
    match start {
        [] => "an empty file",
        [0xef, 0xbb, 0xbf, ..] => "a byte order mark: save it as UTF-8 without",
        [0xff, 0xfe, ..] | [0xfe, 0xff, ..] => "text in UTF-16: save it as UTF-8 without a byte order mark",
        _ => "other content",
    }
}

/// What a folder is that was given in place of a file.
fn folder_in_words(path: &Path) -> String {
    let has = |names: &[&'static str]| names.iter().copied().find(|name| path.join(name).exists());
    if let Some(name) = has(&["lod-meta.json", "meta.json"]) {
        return format!("a folder with a SOG: give its {name}");
    }
    match has(&["sparse", "colmap", "transforms.json", "transforms_train.json", "cameras.bin", "cameras.txt"]) {
        Some(name) => format!("a folder with {name}, as of a capture"),
        None => "a folder".to_owned(),
    }
}

/// The file, to be read piece by piece.
pub(crate) fn open_file(path: &Path) -> Result<BufReader<std::fs::File>, FormatError> {
    let failed = |source| FormatError::Read { file: path.to_owned(), source };
    // Checked before opening, because opening a pipe waits for a writer.
    let kind = path.metadata().map_err(failed)?.file_type();
    if kind.is_dir() {
        return Err(Fault::whole("a file", folder_in_words(path)).in_file(path));
    }
    if !kind.is_file() {
        return Err(failed(std::io::Error::other("it is a device or a pipe, in which nothing can be read twice")));
    }
    let file = std::fs::File::open(path).map_err(failed)?;
    Ok(BufReader::with_capacity(1 << 18, file))
}

/// Length of the file alone.
pub(crate) fn file_bytes(path: &Path) -> Result<u64, FormatError> {
    Ok(path.metadata().map_err(|source| FormatError::Read { file: path.to_owned(), source })?.len())
}

/// The whole file in memory. Its length bounds every count that the file declares.
pub(crate) fn read_file(path: &Path) -> Result<Vec<u8>, FormatError> {
    let mut bytes = vec![];
    let read = open_file(path)?.into_inner().read_to_end(&mut bytes);
    read.map_err(|source| FormatError::Read { file: path.to_owned(), source })?;
    Ok(bytes)
}
