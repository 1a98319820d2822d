//! The PLY container: a header that names typed columns, then rows in ASCII or binary.

use crate::format::error::Fault;

/// A parsed header over the bytes of a whole file.
pub(crate) struct Ply<'a> {
    bytes: &'a [u8],
    body: usize,
    encoding: Encoding,
    elements: Vec<Element>,
}

/// One table of the file: `vertex`, `face`, …
pub(crate) struct Element {
    name: String,
    pub(crate) count: usize,
    properties: Vec<Property>,
}

struct Property {
    name: String,
    kind: Scalar,
    list_length: Option<Scalar>,
}

/// One row: `values[column]` for scalars (NaN in the place of a list), `lists[column]` for lists.
#[derive(Default)]
pub(crate) struct Row {
    pub(crate) values: Vec<f64>,
    pub(crate) lists: Vec<Vec<f64>>,
}

#[derive(Clone, Copy, PartialEq)]
enum Encoding {
    Ascii,
    Little,
    Big,
}

/// Type of a property.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Scalar {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl Scalar {
    fn parse(name: &str) -> Option<Self> {
        Some(match name {
            "char" | "int8" => Self::I8,
            "uchar" | "uint8" => Self::U8,
            "short" | "int16" => Self::I16,
            "ushort" | "uint16" => Self::U16,
            "int" | "int32" => Self::I32,
            "uint" | "uint32" => Self::U32,
            "float" | "float32" => Self::F32,
            "double" | "float64" => Self::F64,
            _ => return None,
        })
    }

    /// As in the headers of PLY 1.0.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::I8 => "char",
            Self::U8 => "uchar",
            Self::I16 => "short",
            Self::U16 => "ushort",
            Self::I32 => "int",
            Self::U32 => "uint",
            Self::F32 => "float",
            Self::F64 => "double",
        }
    }

    /// Appends a value of this type, little endian.
    pub(crate) fn encode(self, value: f64, out: &mut Vec<u8>) {
        match self {
            Self::I8 => out.extend((value as i8).to_le_bytes()),
            Self::U8 => out.extend((value as u8).to_le_bytes()),
            Self::I16 => out.extend((value as i16).to_le_bytes()),
            Self::U16 => out.extend((value as u16).to_le_bytes()),
            Self::I32 => out.extend((value as i32).to_le_bytes()),
            Self::U32 => out.extend((value as u32).to_le_bytes()),
            Self::F32 => out.extend((value as f32).to_le_bytes()),
            Self::F64 => out.extend(value.to_le_bytes()),
        }
    }

    fn bytes(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::F64 => 8,
        }
    }

    /// `b` has `self.bytes()` little-endian bytes, padded to 8.
    fn decode(self, b: [u8; 8]) -> f64 {
        let [b0, b1, b2, b3, ..] = b;
        match self {
            Self::I8 => f64::from(b0 as i8),
            Self::U8 => f64::from(b0),
            Self::I16 => f64::from(i16::from_le_bytes([b0, b1])),
            Self::U16 => f64::from(u16::from_le_bytes([b0, b1])),
            Self::I32 => f64::from(i32::from_le_bytes([b0, b1, b2, b3])),
            Self::U32 => f64::from(u32::from_le_bytes([b0, b1, b2, b3])),
            Self::F32 => f64::from(f32::from_le_bytes([b0, b1, b2, b3])),
            Self::F64 => f64::from_le_bytes(b),
        }
    }
}

impl Element {
    /// Column of the scalar property `name`.
    pub(crate) fn scalar(&self, name: &str) -> Option<usize> {
        self.properties.iter().position(|p| p.name == name && p.list_length.is_none())
    }

    /// Column, name and type of every scalar property.
    pub(crate) fn scalar_properties(&self) -> impl Iterator<Item = (usize, &str, Scalar)> {
        let scalars = self.properties.iter().enumerate().filter(|(_, p)| p.list_length.is_none());
        scalars.map(|(column, p)| (column, p.name.as_str(), p.kind))
    }

    /// Column of the list property `name`.
    pub(crate) fn list(&self, name: &str) -> Option<usize> {
        self.properties.iter().position(|p| p.name == name && p.list_length.is_some())
    }

    /// Columns of scalar properties that must exist.
    pub(crate) fn scalars<const N: usize>(&self, names: [&str; N]) -> Result<[usize; N], Fault> {
        let mut columns = [0; N];
        for (column, name) in columns.iter_mut().zip(names) {
            *column = self.scalar(name).ok_or_else(|| {
                Fault::whole(format!("a PLY with the {} property `{name}`", self.name), "a header without it")
            })?;
        }
        Ok(columns)
    }

    /// Column and name of every scalar property.
    pub(crate) fn scalar_names(&self) -> Vec<(usize, &str)> {
        let columns = self.properties.iter().enumerate();
        columns.filter(|(_, p)| p.list_length.is_none()).map(|(column, p)| (column, p.name.as_str())).collect()
    }

    /// True if `name` is declared as a floating-point property.
    pub(crate) fn is_float(&self, name: &str) -> bool {
        self.properties.iter().any(|p| p.name == name && matches!(p.kind, Scalar::F32 | Scalar::F64))
    }
}

impl<'a> Ply<'a> {
    /// Parses the header.
    pub(crate) fn parse(bytes: &'a [u8]) -> Result<Self, Fault> {
        if !bytes.starts_with(b"ply\n") && !bytes.starts_with(b"ply\r\n") {
            return Err(Fault::byte(0, "a PLY file (starts with `ply`)", "something else"));
        }
        let mut encoding = None;
        let mut elements: Vec<Element> = vec![];
        let mut offset = 0;
        loop {
            let start = offset;
            let Some(length) = bytes[start..].iter().position(|&b| b == b'\n') else {
                return Err(Fault::byte(bytes.len(), "`end_header`", "the end of the file"));
            };
            offset = start + length + 1;
            let line = String::from_utf8_lossy(&bytes[start..start + length]);
            let words: Vec<&str> = line.split_ascii_whitespace().collect();
            let bad = |expected: &str| Fault::byte(start, expected, format!("`{}`", line.trim_end()));
            match words.as_slice() {
                ["end_header"] => break,
                [] | ["ply" | "comment" | "obj_info", ..] => {}
                ["format", name, ..] => {
                    encoding = Some(match *name {
                        "ascii" => Encoding::Ascii,
                        "binary_little_endian" => Encoding::Little,
                        "binary_big_endian" => Encoding::Big,
                        _ => return Err(bad("format ascii, binary_little_endian or binary_big_endian")),
                    });
                }
                ["element", name, count] => {
                    let count = count.parse().map_err(|_| bad("element NAME COUNT"))?;
                    elements.push(Element { name: (*name).to_owned(), count, properties: vec![] });
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
                    element.properties.push(Property { name: (*name).to_owned(), kind, list_length });
                }
                _ => return Err(bad("a PLY header line")),
            }
        }
        let encoding = encoding.ok_or_else(|| Fault::byte(offset, "a `format` line", "none in the header"))?;
        Ok(Self { bytes, body: offset, encoding, elements })
    }

    /// The first table of this name.
    pub(crate) fn element(&self, name: &str) -> Option<&Element> {
        self.elements.iter().find(|e| e.name == name)
    }

    /// A property that its element has twice; readers see the first alone.
    pub(crate) fn repeated_property(&self) -> Option<&str> {
        self.elements.iter().find_map(|element| {
            let names = element.properties.iter().map(|p| p.name.as_str());
            let mut seen = std::collections::HashSet::new();
            names.into_iter().find(|name| !seen.insert(*name))
        })
    }

    /// Walks over all rows of all elements without looking at values. Returns the number of bytes after the last row.
    pub(crate) fn bytes_after_rows(&self) -> Result<usize, Fault> {
        let mut cursor = Cursor { bytes: self.bytes, offset: self.body, encoding: self.encoding };
        for element in &self.elements {
            cursor.check_fits(element)?;
            cursor.skip(element)?;
        }
        let rest = &self.bytes[cursor.offset..];
        let blank = self.encoding == Encoding::Ascii && rest.iter().all(u8::is_ascii_whitespace);
        Ok(if blank { 0 } else { rest.len() })
    }

    /// Calls `visit` with each row of the first table called `name`, in order.
    ///
    /// `reserve` is called once before that with the number of rows, which is known by then to fit into the file.
    pub(crate) fn rows<S>(
        &self,
        name: &str,
        reserve: impl FnOnce(usize) -> S,
        mut visit: impl FnMut(&mut S, &Row) -> Result<(), Fault>,
    ) -> Result<S, Fault> {
        let mut cursor = Cursor { bytes: self.bytes, offset: self.body, encoding: self.encoding };
        for element in &self.elements {
            cursor.check_fits(element)?;
            if element.name != name {
                cursor.skip(element)?;
                continue;
            }
            let mut state = reserve(element.count);
            let mut row = Row::default();
            for _ in 0..element.count {
                cursor.row(element, &mut row)?;
                visit(&mut state, &row)?;
            }
            return Ok(state);
        }
        Err(Fault::whole(format!("a PLY with the element `{name}`"), "a header without it"))
    }
}

struct Cursor<'a> {
    bytes: &'a [u8],
    offset: usize,
    encoding: Encoding,
}

impl Cursor<'_> {
    /// Error if the declared rows cannot fit into what is left of the file.
    fn check_fits(&self, element: &Element) -> Result<(), Fault> {
        let least_row: usize = match self.encoding {
            // A digit and a separator each.
            Encoding::Ascii => 2 * element.properties.len(),
            _ => element.properties.iter().map(|p| p.list_length.unwrap_or(p.kind).bytes()).sum(),
        };
        // The last separator of the file may be missing.
        let left = self.bytes.len() - self.offset + usize::from(self.encoding == Encoding::Ascii);
        let fits = element.count == 0
            || (least_row > 0 && element.count.checked_mul(least_row).is_some_and(|needed| needed <= left));
        if fits {
            return Ok(());
        }
        Err(Fault::byte(
            self.offset,
            format!("{} rows of `{}` of at least {least_row} bytes", element.count, element.name),
            format!("{left} bytes"),
        ))
    }

    fn skip(&mut self, element: &Element) -> Result<(), Fault> {
        if self.encoding != Encoding::Ascii && element.properties.iter().all(|p| p.list_length.is_none()) {
            // Cannot overflow or run past the end: `check_fits` has looked.
            self.offset += element.count * element.properties.iter().map(|p| p.kind.bytes()).sum::<usize>();
            return Ok(());
        }
        let mut row = Row::default();
        (0..element.count).try_for_each(|_| self.row(element, &mut row))
    }

    fn row(&mut self, element: &Element, row: &mut Row) -> Result<(), Fault> {
        row.values.clear();
        row.lists.resize(element.properties.len(), vec![]);
        for (property, list) in element.properties.iter().zip(&mut row.lists) {
            let Some(length_kind) = property.list_length else {
                row.values.push(self.scalar(property.kind)?);
                continue;
            };
            let at = self.offset;
            let length = self.scalar(length_kind)?;
            if !(length >= 0.0 && length <= (self.bytes.len() - self.offset) as f64 && length.fract() == 0.0) {
                return Err(Fault::byte(at, "a list length that fits into the file", length.to_string()));
            }
            list.clear();
            for _ in 0..length as usize {
                list.push(self.scalar(property.kind)?);
            }
            row.values.push(f64::NAN);
        }
        Ok(())
    }

    fn scalar(&mut self, kind: Scalar) -> Result<f64, Fault> {
        let rest = &self.bytes[self.offset..];
        if self.encoding == Encoding::Ascii {
            let start = rest.iter().position(|b| !b.is_ascii_whitespace()).unwrap_or(rest.len());
            let length = rest[start..].iter().position(u8::is_ascii_whitespace).unwrap_or(rest.len() - start);
            let token = &rest[start..start + length];
            let at = self.offset + start;
            self.offset = at + length;
            return std::str::from_utf8(token)
                .ok()
                .and_then(|t| t.parse().ok())
                .ok_or_else(|| Fault::byte(at, "a number", format!("`{}`", String::from_utf8_lossy(token))));
        }
        let size = kind.bytes();
        let Some(bytes) = rest.get(..size) else {
            return Err(Fault::byte(self.offset, format!("{size} more bytes"), "the end of the file"));
        };
        let mut little = [0; 8];
        little[..size].copy_from_slice(bytes);
        if self.encoding == Encoding::Big {
            little[..size].reverse();
        }
        self.offset += size;
        Ok(kind.decode(little))
    }
}
