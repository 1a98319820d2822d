//! PLY container: a header that names typed columns, then rows in ASCII or binary.

mod rows;

use std::io::{self, BufRead, Read as _, Seek, SeekFrom};

pub(crate) use self::rows::{Body, Row};
use super::Table;
use crate::format::attribute::Scalar;
use crate::format::error::{Fault, shown};

/// Longest header that is read. A header with a thousand properties takes 30 kB.
const MAX_HEADER: u64 = 1 << 20;

/// Header of a PLY file.
pub(crate) struct Header {
    elements: Vec<Element>,
    /// Comments without the keyword.
    comments: Vec<String>,
    /// Offset of `end_header`.
    end: usize,
}

/// Table of the file: `vertex`, `face`, …
pub(crate) struct Element {
    name: String,
    /// Offset of the line that declares the table.
    pub(crate) at: usize,
    pub(crate) count: usize,
    properties: Vec<Property>,
    /// Bytes of a row's scalars in [`Body::blocks`].
    stride: usize,
}

struct Property {
    name: String,
    kind: Scalar,
    list_length: Option<Scalar>,
    /// Column in a row of [`Body::blocks`]; meaningless for lists.
    column: Column,
}

/// Location of a property in a row of [`Body::blocks`].
#[derive(Clone, Copy)]
pub(crate) struct Column {
    offset: usize,
    kind: Scalar,
}

#[derive(Clone, Copy, PartialEq)]
enum Encoding {
    Ascii,
    Little,
    Big,
}

impl Element {
    /// Describes the table as declared in the header; names in one line.
    pub(super) fn describe(&self) -> Table {
        let name = |name: &str| name.chars().take(60).collect::<String>();
        let property = |p: &Property| format!("{}{}", name(&p.name), if p.list_length.is_some() { "[]" } else { "" });
        let properties = self.properties.iter().map(property).collect();
        Table { name: name(&self.name), rows: self.count, properties, bounds: None }
    }

    /// Index of the scalar property `name`.
    pub(crate) fn scalar(&self, name: &str) -> Option<usize> {
        self.properties.iter().position(|p| p.name == name && p.list_length.is_none())
    }

    /// Names of the list properties.
    pub(super) fn list_names(&self) -> impl Iterator<Item = &str> {
        self.properties.iter().filter(|p| p.list_length.is_some()).map(|p| p.name.as_str())
    }

    pub(super) fn name(&self) -> &str {
        &self.name
    }

    /// Column, name and type of every scalar property.
    pub(super) fn scalar_properties(&self) -> impl Iterator<Item = (Column, &str, Scalar)> {
        let scalars = self.properties.iter().filter(|p| p.list_length.is_none());
        scalars.map(|p| (p.column, p.name.as_str(), p.kind))
    }

    /// Index of the list property `name`.
    pub(crate) fn list(&self, name: &str) -> Option<usize> {
        self.properties.iter().position(|p| p.name == name && p.list_length.is_some())
    }

    /// Indices of scalar properties that must exist.
    pub(crate) fn scalars<const N: usize>(&self, names: [&str; N]) -> Result<[usize; N], Fault> {
        let mut columns = [0; N];
        for (column, name) in columns.iter_mut().zip(names) {
            *column = self.scalar(name).ok_or_else(|| {
                let expected = format!("a PLY with the {} property `{name}`", self.name);
                Fault::byte(self.at, expected, "a header without it")
            })?;
        }
        Ok(columns)
    }

    /// Same as [`Self::scalar`], for [`Body::blocks`].
    pub(super) fn column(&self, name: &str) -> Option<Column> {
        self.scalar(name).map(|i| self.properties[i].column)
    }

    /// Same as [`Self::scalars`], for [`Body::blocks`].
    pub(super) fn columns<const N: usize>(&self, names: [&str; N]) -> Result<[Column; N], Fault> {
        Ok(self.scalars(names)?.map(|i| self.properties[i].column))
    }

    /// Index and name of every scalar property.
    pub(crate) fn scalar_names(&self) -> Vec<(usize, &str)> {
        let columns = self.properties.iter().enumerate();
        columns.filter(|(_, p)| p.list_length.is_none()).map(|(column, p)| (column, p.name.as_str())).collect()
    }

    /// Whether `name` is declared as a floating-point property.
    pub(crate) fn is_float(&self, name: &str) -> bool {
        self.properties.iter().any(|p| p.name == name && matches!(p.kind, Scalar::F32 | Scalar::F64))
    }
}

impl Column {
    /// Value of the property in `row`, as f32.
    pub(super) fn f32(self, row: &[u8]) -> f32 {
        if self.kind == Scalar::F32 { f32::from_le_bytes(self.bytes(row)) } else { self.f64(row) as f32 }
    }

    /// Value of the property in `row`, as f64.
    pub(super) fn f64(self, row: &[u8]) -> f64 {
        match self.kind {
            Scalar::I8 => f64::from(i8::from_le_bytes(self.bytes(row))),
            Scalar::U8 => f64::from(u8::from_le_bytes(self.bytes(row))),
            Scalar::I16 => f64::from(i16::from_le_bytes(self.bytes(row))),
            Scalar::U16 => f64::from(u16::from_le_bytes(self.bytes(row))),
            Scalar::I32 => f64::from(i32::from_le_bytes(self.bytes(row))),
            Scalar::U32 => f64::from(u32::from_le_bytes(self.bytes(row))),
            Scalar::F32 => f64::from(f32::from_le_bytes(self.bytes(row))),
            Scalar::F64 => f64::from_le_bytes(self.bytes(row)),
        }
    }

    fn bytes<const N: usize>(self, row: &[u8]) -> [u8; N] {
        *row[self.offset..].first_chunk().expect("a row holds all columns of its element")
    }
}

/// Parses the header; rows are read later.
pub(crate) fn open<R: BufRead + Seek>(mut reader: R) -> Result<(Header, Body<R>), Fault> {
    let unreadable = |e: io::Error| Fault::unreadable(0, &e);
    let length = reader.seek(SeekFrom::End(0)).map_err(unreadable)?;
    reader.rewind().map_err(unreadable)?;
    let mut encoding = None;
    let (mut elements, mut comments): (Vec<Element>, Vec<String>) = (vec![], vec![]);
    let (mut offset, mut line) = (0, vec![]);
    let end = loop {
        let start = offset as usize;
        line.clear();
        offset += reader.by_ref().take(MAX_HEADER - offset).read_until(b'\n', &mut line).map_err(unreadable)? as u64;
        if start == 0 && line != b"ply\n" && line != b"ply\r\n" {
            return Err(Fault::byte(0, "a PLY file (starts with `ply`)", "something else"));
        }
        if line.last() != Some(&b'\n') {
            let found = if offset < MAX_HEADER { "the end of the file" } else { "a longer header" };
            return Err(Fault::byte(offset as usize, "`end_header`", found));
        }
        let text = String::from_utf8_lossy(&line);
        let words: Vec<&str> = text.split_ascii_whitespace().collect();
        let bad = |expected: &str| Fault::byte(start, expected, shown(line.trim_ascii_end()));
        match words.as_slice() {
            ["end_header"] => break start,
            ["comment", words @ ..] => comments.push(words.join(" ")),
            [] | ["ply" | "obj_info", ..] => {}
            ["format", name, version @ ..] => {
                if !matches!(version, [] | ["1.0", ..]) {
                    return Err(bad("version 1.0 of the format"));
                }
                encoding = Some(match *name {
                    "ascii" => Encoding::Ascii,
                    "binary_little_endian" => Encoding::Little,
                    "binary_big_endian" => Encoding::Big,
                    _ => return Err(bad("format ascii, binary_little_endian or binary_big_endian")),
                });
            }
            ["element", name, count] => {
                let count = count.parse().map_err(|_| bad("element NAME COUNT"))?;
                elements.push(Element { name: (*name).to_owned(), at: start, count, properties: vec![], stride: 0 });
            }
            ["property", kind @ .., name] if (1..=3).contains(&kind.len()) => {
                let (kind, list_length) = match kind {
                    [kind] => (Scalar::parse(kind), Ok(None)),
                    ["list", length, kind] => (Scalar::parse(kind), Scalar::parse(length).map(Some).ok_or(())),
                    _ => (None, Err(())),
                };
                let (Some(kind), Ok(list_length), Some(element)) = (kind, list_length, elements.last_mut()) else {
                    return Err(bad("property [list] TYPE NAME"));
                };
                let column = Column { offset: 0, kind };
                element.properties.push(Property { name: (*name).to_owned(), kind, list_length, column });
            }
            _ => return Err(bad("a PLY header line")),
        }
    };
    let encoding = encoding.ok_or_else(|| Fault::byte(offset as usize, "a `format` line", "none in the header"))?;
    for element in &mut elements {
        for property in element.properties.iter_mut().filter(|p| p.list_length.is_none()) {
            // ASCII values may exceed the declared type.
            let kind = if encoding == Encoding::Ascii { Scalar::F64 } else { property.kind };
            property.column = Column { offset: element.stride, kind };
            element.stride += kind.bytes();
        }
    }
    Ok((Header { elements, comments, end }, Body::new(reader, offset, length, encoding)))
}

impl Header {
    pub(crate) fn elements(&self) -> &[Element] {
        &self.elements
    }

    pub(super) fn comments(&self) -> &[String] {
        &self.comments
    }

    /// First table of this name.
    pub(crate) fn element(&self, name: &str) -> Option<&Element> {
        self.elements.iter().find(|e| e.name == name)
    }

    /// Same as [`Self::element`], for a table that must exist.
    pub(crate) fn required(&self, name: &str) -> Result<&Element, Fault> {
        let missing = || {
            let names: Vec<&str> = self.elements.iter().take(8).map(|e| e.name.as_str()).collect();
            let found = if names.is_empty() { "none".to_owned() } else { shown(names.join(", ").as_bytes()) };
            Fault::byte(self.end, format!("the element `{name}` before the end of the header"), found)
        };
        self.element(name).ok_or_else(missing)
    }

    /// Fault of a property that occurs twice in a table, which makes it ambiguous.
    pub(crate) fn repeated_property(&self) -> Option<Fault> {
        self.elements.iter().find_map(|element| {
            let mut seen = std::collections::HashSet::new();
            let twice = element.properties.iter().find(|p| !seen.insert(p.name.as_str()))?;
            let found = format!("{} twice", shown(twice.name.as_bytes()));
            Some(Fault::byte(element.at, "each property once", found))
        })
    }
}
