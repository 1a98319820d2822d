//! Reads accessors with every bound checked; the `gltf` crate's own iterators panic on ranges that do not fit.

use glam::DMat4;
use gltf::accessor::sparse::IndexType;
use gltf::accessor::{DataType, Dimensions};

use super::lift::Asset;
use crate::format::error::Fault;

/// A run of elements in a buffer view: element `i` starts at `i·stride`.
struct Elements<'a> {
    bytes: &'a [u8],
    count: usize,
    stride: usize,
    kind: DataType,
    normalized: bool,
}

impl Elements<'_> {
    fn float<const N: usize>(&self, i: usize) -> [f32; N] {
        let size = self.kind.size();
        std::array::from_fn(|c| component(&self.bytes[i * self.stride + c * size..], self.kind, self.normalized))
    }

    /// The first component of element `i`; 0 for types that are not unsigned integers, which callers exclude.
    fn index(&self, i: usize) -> u32 {
        let b = &self.bytes[i * self.stride..];
        match self.kind {
            DataType::U8 => u32::from(b[0]),
            DataType::U16 => u32::from(u16::from_le_bytes([b[0], b[1]])),
            DataType::U32 => u32::from_le_bytes([b[0], b[1], b[2], b[3]]),
            DataType::I8 | DataType::I16 | DataType::F32 => 0,
        }
    }
}

impl Asset {
    /// Elements of a float or (normalised) integer accessor with `N` components, as floats; sparse ones included.
    pub(in crate::format) fn floats<const N: usize>(&self, accessor: usize) -> Result<Vec<[f32; N]>, Fault> {
        let accessor = self.accessor(accessor, N)?;
        let at = format!("/accessors/{}", accessor.index());
        let (count, kind, normalized) = (accessor.count(), accessor.data_type(), accessor.normalized());
        let mut values = match accessor.view().filter(|view| self.has_view(view)) {
            Some(view) => {
                let base = self.elements(&view, accessor.offset(), count, N, (kind, normalized), &at)?;
                (0..count).map(|i| base.float(i)).collect()
            }
            None => {
                // All zero but for the sparse elements. Such an accessor goes with others that are stored in full, so
                // a count above the number of bytes in the file is a lie.
                let bytes: usize = self.buffers.iter().chain(self.plain_views.values()).map(Vec::len).sum();
                if accessor.sparse().is_none() || count > bytes {
                    return Err(Fault::pointer(at, "an accessor with a bufferView", "one without"));
                }
                vec![[0.0; N]; count]
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
            let indices = self.elements(&indices.view(), indices.offset(), n, 1, (index_kind, false), &at)?;
            let (view, offset) = (replacements.view(), replacements.offset());
            let replacements = self.elements(&view, offset, n, N, (kind, normalized), &at)?;
            for i in 0..n {
                let index = indices.index(i);
                let slot = values.get_mut(index as usize);
                let slot =
                    slot.ok_or_else(|| Fault::pointer(&at, format!("indices below {count}"), index.to_string()))?;
                *slot = replacements.float(i);
            }
        }
        Ok(values)
    }

    /// Elements of a MAT4 accessor of floats.
    pub(super) fn matrices(&self, accessor: usize) -> Result<Vec<DMat4>, Fault> {
        let at = format!("/accessors/{accessor}");
        let found = self.document.accessors().nth(accessor);
        let usable = found.filter(|a| (a.dimensions(), a.data_type()) == (Dimensions::Mat4, DataType::F32));
        let stored = usable.filter(|a| a.sparse().is_none()).and_then(|a| Some((a.clone(), a.view()?)));
        let Some((accessor, view)) = stored.filter(|(_, view)| self.has_view(view)) else {
            return Err(Fault::pointer(at, "MAT4 of floats, stored in full", "another accessor"));
        };
        let layout = (DataType::F32, false);
        let elements = self.elements(&view, accessor.offset(), accessor.count(), 16, layout, &at)?;
        Ok((0..elements.count).map(|i| DMat4::from_cols_array(&elements.float::<16>(i).map(f64::from))).collect())
    }

    /// Elements of a SCALAR unsigned integer accessor.
    pub(in crate::format) fn indices(&self, accessor: usize) -> Result<Vec<u32>, Fault> {
        let accessor = self.accessor(accessor, 1)?;
        let at = format!("/accessors/{}", accessor.index());
        let kind = accessor.data_type();
        if !matches!(kind, DataType::U8 | DataType::U16 | DataType::U32) {
            return Err(Fault::pointer(format!("{at}/componentType"), "an unsigned integer type", format!("{kind:?}")));
        }
        let view = accessor.view().filter(|view| self.has_view(view));
        let (Some(view), None) = (view, accessor.sparse()) else {
            return Err(Fault::pointer(at, "indices stored in full", "a sparse or empty accessor"));
        };
        let elements = self.elements(&view, accessor.offset(), accessor.count(), 1, (kind, false), &at)?;
        Ok((0..elements.count).map(|i| elements.index(i)).collect())
    }

    /// Accessor `index`, known to have `components` components.
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

    fn elements(
        &self,
        view: &gltf::buffer::View<'_>,
        offset: usize,
        count: usize,
        components: usize,
        (kind, normalized): (DataType, bool),
        at: &str,
    ) -> Result<Elements<'_>, Fault> {
        let size = components * kind.size();
        let stride = view.stride().unwrap_or(size);
        if stride < size {
            return Err(Fault::pointer(at, format!("a byteStride of at least {size}"), stride.to_string()));
        }
        let needed = match count {
            0 => Some(0),
            n => (n - 1).checked_mul(stride).and_then(|b| b.checked_add(size)),
        };
        let bytes = self.view_bytes(view)?.get(offset..).unwrap_or_default();
        if needed.is_none_or(|n| n > bytes.len()) {
            let expected = format!("{count} elements of {size} bytes, {stride} apart");
            return Err(Fault::pointer(format!("{at}/count"), expected, format!("{} bytes", bytes.len())));
        }
        Ok(Elements { bytes, count, stride, kind, normalized })
    }

    /// The bytes of a buffer view, decompressed.
    pub(super) fn view_bytes(&self, view: &gltf::buffer::View<'_>) -> Result<&[u8], Fault> {
        if let Some(plain) = self.plain_views.get(&view.index()) {
            return Ok(plain);
        }
        let buffer = self.buffers.get(view.buffer().index()).map_or(&[][..], Vec::as_slice);
        let end = view.offset().checked_add(view.length());
        end.and_then(|end| buffer.get(view.offset()..end)).ok_or_else(|| {
            let expected = format!("{} bytes at offset {}", view.length(), view.offset());
            Fault::pointer(format!("/bufferViews/{}", view.index()), expected, format!("{} bytes", buffer.len()))
        })
    }
}

/// One little-endian component; signed normalised types reach −1 at both of their lowest values (glTF 2.0, 3.6.2.2).
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
