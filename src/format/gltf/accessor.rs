//! Accessor reading with full bounds checks; the `gltf` crate's own iterators panic on invalid ranges.

use std::borrow::Cow;
use std::ops::Range;

use glam::DMat4;
use gltf::accessor::sparse::IndexType;
use gltf::accessor::{DataType, Dimensions};

use super::buffer::Buffer;
use super::lift::Asset;
use crate::format::blocks::BLOCK_BYTES;
use crate::format::error::Fault;

/// Strided sequence of elements: element `i` starts at `start + i·stride`.
struct Elements<'a> {
    bytes: Bytes<'a>,
    start: usize,
    count: usize,
    stride: usize,
    size: usize,
    at: &'a str,
}

/// Storage of the elements, all of which are within bounds.
enum Bytes<'a> {
    /// Decompressed view.
    Plain(&'a [u8]),
    Buffer(&'a Buffer),
}

impl Elements<'_> {
    /// Maps the bytes of each element with `of`, reading block by block.
    fn map<T>(&self, of: impl Fn(&[u8]) -> T) -> Result<Vec<T>, Fault> {
        let mut values = Vec::with_capacity(self.count);
        let per_block = (BLOCK_BYTES / self.stride).max(1);
        for first in (0..self.count).step_by(per_block) {
            let rows = per_block.min(self.count - first);
            let start = self.start + first * self.stride;
            let range = start..start + (rows - 1) * self.stride + self.size;
            let block = match self.bytes {
                Bytes::Plain(bytes) => Cow::Borrowed(&bytes[range]),
                Bytes::Buffer(buffer) => {
                    buffer.read(range).map_err(|e| Fault::pointer(self.at, "readable content", e.to_string()))?
                }
            };
            values.extend(block.chunks(self.stride).map(&of));
        }
        Ok(values)
    }
}

impl Asset {
    /// Whether any data of an accessor is stored; otherwise it is all zeros, unless an extension provides the data.
    pub(super) fn is_stored(&self, accessor: &gltf::Accessor<'_>) -> bool {
        accessor.sparse().is_some() || accessor.view().is_some_and(|view| self.has_view(&view))
    }

    /// Component type of an accessor, if it exists, and whether integers are normalised.
    pub(super) fn component(&self, accessor: usize) -> Option<(DataType, bool)> {
        self.document.accessors().nth(accessor).map(|accessor| (accessor.data_type(), accessor.normalized()))
    }

    /// Elements of a float or (normalised) integer accessor with `N` components, as floats, including sparse ones.
    pub(in crate::format) fn floats<const N: usize>(&self, accessor: usize) -> Result<Vec<[f32; N]>, Fault> {
        let accessor = self.accessor(accessor, N)?;
        let (kind, normalized) = (accessor.data_type(), accessor.normalized());
        self.decoded(&accessor, [0.0; N], |row| numbers(row, kind, normalized))
    }

    /// Elements of a SCALAR unsigned integer accessor, including sparse ones.
    pub(in crate::format) fn indices(&self, accessor: usize) -> Result<Vec<u32>, Fault> {
        let accessor = self.accessor(accessor, 1)?;
        let kind = accessor.data_type();
        if !matches!(kind, DataType::U8 | DataType::U16 | DataType::U32) {
            let at = format!("/accessors/{}/componentType", accessor.index());
            return Err(Fault::pointer(at, "an unsigned integer type", format!("{kind:?}")));
        }
        self.decoded(&accessor, 0, |row| unsigned(row, kind))
    }

    /// Maps the bytes of each element with `of`; elements without stored data become `zero`.
    fn decoded<T: Clone>(
        &self,
        accessor: &gltf::Accessor<'_>,
        zero: T,
        of: impl Fn(&[u8]) -> T,
    ) -> Result<Vec<T>, Fault> {
        let at = format!("/accessors/{}", accessor.index());
        let (count, kind, components) = (accessor.count(), accessor.data_type(), accessor.dimensions().multiplicity());
        let mut values = match accessor.view().filter(|view| self.has_view(view)) {
            Some(view) => self.elements(&view, accessor.offset(), count, (components, kind), &at)?.map(&of)?,
            None => {
                // Zeros except for sparse elements (glTF 2.0, 3.6.2.3). Such an accessor accompanies others that are
                // stored in full, so a count above the number of bytes in the file is invalid.
                if count > self.stored_bytes() {
                    let expected = format!("at most {} elements without a bufferView", self.stored_bytes());
                    return Err(Fault::pointer(format!("{at}/count"), expected, count.to_string()));
                }
                self.spend((count * components * 4) as u64, &at)?;
                vec![zero; count]
            }
        };
        if let Some(sparse) = accessor.sparse() {
            let at = format!("{at}/sparse");
            let (indices, replacements) = (sparse.indices(), sparse.values());
            let index_kind = match indices.index_type() {
                IndexType::U8 => DataType::U8,
                IndexType::U16 => DataType::U16,
                IndexType::U32 => DataType::U32,
            };
            let n = sparse.count();
            let indices = self.elements(&indices.view(), indices.offset(), n, (1, index_kind), &at)?;
            let indices = indices.map(|row| unsigned(row, index_kind))?;
            let (view, offset) = (replacements.view(), replacements.offset());
            let replacements = self.elements(&view, offset, n, (components, kind), &at)?.map(&of)?;
            for (index, value) in indices.into_iter().zip(replacements) {
                let slot = values.get_mut(index as usize);
                let slot =
                    slot.ok_or_else(|| Fault::pointer(&at, format!("indices below {count}"), index.to_string()))?;
                *slot = value;
            }
        }
        Ok(values)
    }

    /// Elements of a float MAT4 accessor.
    pub(super) fn matrices(&self, accessor: usize) -> Result<Vec<DMat4>, Fault> {
        let at = format!("/accessors/{accessor}");
        let found = self.document.accessors().nth(accessor);
        let usable = found.filter(|a| (a.dimensions(), a.data_type()) == (Dimensions::Mat4, DataType::F32));
        let stored = usable.filter(|a| a.sparse().is_none()).and_then(|a| Some((a.clone(), a.view()?)));
        let Some((accessor, view)) = stored.filter(|(_, view)| self.has_view(view)) else {
            return Err(Fault::pointer(at, "MAT4 of floats, stored in full", "another accessor"));
        };
        let elements = self.elements(&view, accessor.offset(), accessor.count(), (16, DataType::F32), &at)?;
        elements.map(|row| DMat4::from_cols_array(&numbers::<16>(row, DataType::F32, false).map(f64::from)))
    }

    /// Accessor `index`, checked to have `components` components.
    fn accessor(&self, index: usize, components: usize) -> Result<gltf::Accessor<'_>, Fault> {
        let accessor = self.document.accessors().nth(index).ok_or_else(|| {
            let accessors = self.document.as_json().accessors.len();
            Fault::pointer("/accessors", format!("more than {index} accessors"), accessors.to_string())
        })?;
        let found = accessor.dimensions();
        let is_matrix = matches!(found, Dimensions::Mat2 | Dimensions::Mat3 | Dimensions::Mat4);
        if is_matrix || found.multiplicity() != components {
            let at = format!("/accessors/{index}/type");
            return Err(Fault::pointer(at, format!("{components} component(s)"), format!("{found:?}")));
        }
        Ok(accessor)
    }

    fn elements<'a>(
        &'a self,
        view: &gltf::buffer::View<'_>,
        offset: usize,
        count: usize,
        (components, kind): (usize, DataType),
        at: &'a str,
    ) -> Result<Elements<'a>, Fault> {
        let size = components * kind.size();
        let stride = view.stride().unwrap_or(size);
        if stride < size {
            return Err(Fault::pointer(at, format!("a byteStride of at least {size}"), stride.to_string()));
        }
        let needed = match count {
            0 => Some(0),
            n => (n - 1).checked_mul(stride).and_then(|b| b.checked_add(size)),
        };
        let (bytes, range) = self.place(view)?;
        let length = range.len().saturating_sub(offset);
        if needed.is_none_or(|n| n > length) {
            let expected = format!("{count} elements of {size} bytes, {stride} apart");
            return Err(Fault::pointer(format!("{at}/count"), expected, format!("{length} bytes")));
        }
        self.spend((count as u64).saturating_mul(components as u64 * 4), at)?;
        Ok(Elements { bytes, start: range.start.saturating_add(offset), count, stride, size, at })
    }

    /// Bytes of a buffer view, decompressed.
    pub(super) fn view_bytes(&self, view: &gltf::buffer::View<'_>) -> Result<Cow<'_, [u8]>, Fault> {
        match self.place(view)? {
            (Bytes::Plain(bytes), range) => Ok(Cow::Borrowed(&bytes[range])),
            (Bytes::Buffer(buffer), range) => buffer.read(range).map_err(|e| {
                Fault::pointer(format!("/bufferViews/{}", view.index()), "readable content", e.to_string())
            }),
        }
    }

    /// Storage and range of the bytes of a buffer view, checked to be within bounds.
    fn place(&self, view: &gltf::buffer::View<'_>) -> Result<(Bytes<'_>, Range<usize>), Fault> {
        if let Some(plain) = self.plain_views.get(&view.index()) {
            return Ok((Bytes::Plain(plain), 0..plain.len()));
        }
        let buffer = self.buffers.get(view.buffer().index());
        let length = buffer.map_or(0, Buffer::len);
        let end = view.offset().checked_add(view.length()).filter(|&end| end <= length);
        let place = buffer.zip(end).map(|(buffer, end)| (Bytes::Buffer(buffer), view.offset()..end));
        place.ok_or_else(|| {
            let expected = format!("{} bytes at offset {}", view.length(), view.offset());
            Fault::pointer(format!("/bufferViews/{}", view.index()), expected, format!("{length} bytes"))
        })
    }
}

/// Components of an element.
fn numbers<const N: usize>(row: &[u8], kind: DataType, normalized: bool) -> [f32; N] {
    std::array::from_fn(|c| component(&row[c * kind.size()..], kind, normalized))
}

/// First component of an element; 0 for types other than unsigned integers, which callers exclude.
fn unsigned(row: &[u8], kind: DataType) -> u32 {
    match kind {
        DataType::U8 => u32::from(row[0]),
        DataType::U16 => u32::from(u16::from_le_bytes([row[0], row[1]])),
        DataType::U32 => u32::from_le_bytes([row[0], row[1], row[2], row[3]]),
        DataType::I8 | DataType::I16 | DataType::F32 => 0,
    }
}

/// Decodes a little-endian component; signed normalised types map both of their lowest values to −1 (glTF 2.0,
/// 3.6.2.2).
fn component(b: &[u8], kind: DataType, normalized: bool) -> f32 {
    let (value, range) = match kind {
        DataType::I8 => (f32::from(b[0] as i8), 127.0),
        DataType::U8 => (f32::from(b[0]), 255.0),
        DataType::I16 => (f32::from(i16::from_le_bytes([b[0], b[1]])), 32767.0),
        DataType::U16 => (f32::from(u16::from_le_bytes([b[0], b[1]])), 65535.0),
        DataType::U32 => (u32::from_le_bytes([b[0], b[1], b[2], b[3]]) as f32, u32::MAX as f32),
        DataType::F32 => return f32::from_le_bytes([b[0], b[1], b[2], b[3]]),
    };
    if normalized { (value / range).max(-1.0) } else { value }
}
