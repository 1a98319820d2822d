//! Buffers, and numeric access to accessors.

use std::collections::{HashMap, HashSet};
use std::path::Path;
use std::sync::Arc;

use serde_json::Value;

use super::super::Findings;
use super::index;
use crate::format::error::{Fault, Location, shown};
use crate::format::gltf::extension::{HYBRID, KHR_SPLATS, extension_of};
use crate::format::gltf::json::lists;
use crate::format::gltf::{Loaded, meshopt::decompress};

/// Number of elements that an accessor may have without a proportional number of stored bytes.
const FEW: usize = 1 << 16;

/// Document with its buffers.
pub(super) struct Document<'a> {
    pub(super) root: &'a Value,
    /// Content of each buffer; `None` where it is unavailable.
    buffers: Vec<Option<Content<'a>>>,
    /// Decompressed buffer views, by index.
    plain_views: HashMap<usize, Vec<u8>>,
    /// Accessors whose values an extension of a primitive may provide.
    supplied: HashSet<usize>,
    pub(super) folder: &'a Path,
}

/// Content of a buffer: the first bytes of what is stored.
struct Content<'a> {
    stored: Stored<'a>,
    length: usize,
}

enum Stored<'a> {
    /// File that other buffers may share.
    File(Arc<Vec<u8>>),
    /// Binary chunk of the GLB, which is in memory as a whole.
    Chunk(&'a [u8]),
}

impl Content<'_> {
    fn bytes(&self) -> &[u8] {
        &self.stored.bytes()[..self.length]
    }
}

impl Stored<'_> {
    fn bytes(&self) -> &[u8] {
        match self {
            Self::File(bytes) => bytes,
            Self::Chunk(bytes) => bytes,
        }
    }
}

/// Accessor whose range lies within its buffer.
pub(super) struct Elements<'a> {
    pub(super) count: usize,
    pub(super) components: usize,
    pub(super) kind: Component,
    pub(super) normalized: bool,
    /// Stored elements; `None`: all zeros, except for sparse elements.
    base: Option<Run<'a>>,
    sparse: Option<Sparse<'a>>,
}

struct Sparse<'a> {
    indices: Vec<u32>,
    values: Run<'a>,
}

/// Elements `stride` bytes apart.
struct Run<'a> {
    bytes: &'a [u8],
    stride: usize,
    /// Matrix columns: stride in bytes, and components per column.
    columns: Option<(usize, usize)>,
}

/// Component type of glTF.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Component {
    Byte,
    UnsignedByte,
    Short,
    UnsignedShort,
    UnsignedInt,
    Float,
}

impl Component {
    pub(super) fn of(code: u64) -> Option<Self> {
        Some(match code {
            5120 => Self::Byte,
            5121 => Self::UnsignedByte,
            5122 => Self::Short,
            5123 => Self::UnsignedShort,
            5125 => Self::UnsignedInt,
            5126 => Self::Float,
            _ => return None,
        })
    }

    pub(super) fn size(self) -> usize {
        match self {
            Self::Byte | Self::UnsignedByte => 1,
            Self::Short | Self::UnsignedShort => 2,
            Self::UnsignedInt | Self::Float => 4,
        }
    }

    /// Largest value of an integer type.
    pub(super) fn largest(self) -> f64 {
        match self {
            Self::Byte => 127.0,
            Self::UnsignedByte => 255.0,
            Self::Short => 32767.0,
            Self::UnsignedShort => 65535.0,
            Self::UnsignedInt => f64::from(u32::MAX),
            Self::Float => f64::INFINITY,
        }
    }

    /// Decodes the component at the start of `b`.
    fn decode(self, b: &[u8]) -> f64 {
        match self {
            Self::Byte => f64::from(b[0] as i8),
            Self::UnsignedByte => f64::from(b[0]),
            Self::Short => f64::from(i16::from_le_bytes([b[0], b[1]])),
            Self::UnsignedShort => f64::from(u16::from_le_bytes([b[0], b[1]])),
            Self::UnsignedInt => f64::from(u32::from_le_bytes([b[0], b[1], b[2], b[3]])),
            Self::Float => f64::from(f32::from_le_bytes([b[0], b[1], b[2], b[3]])),
        }
    }
}

impl Elements<'_> {
    /// Whether any value is stored in a buffer.
    pub(super) fn is_stored(&self) -> bool {
        self.base.is_some() || self.sparse.is_some()
    }

    /// Whether they are plain numbers of things.
    pub(super) fn is_unsigned(&self) -> bool {
        let kinds = [Component::UnsignedByte, Component::UnsignedShort, Component::UnsignedInt];
        self.components == 1 && !self.normalized && kinds.contains(&self.kind)
    }

    /// Component `c` of element `i` as stored.
    pub(super) fn raw(&self, i: usize, c: usize) -> f64 {
        if let Some(sparse) = &self.sparse
            && let Ok(at) = sparse.indices.binary_search(&(i as u32))
        {
            return sparse.values.get(at, c, self.kind);
        }
        self.base.as_ref().map_or(0.0, |base| base.get(i, c, self.kind))
    }

    /// Component `c` of element `i`, normalised if the accessor says so.
    pub(super) fn value(&self, i: usize, c: usize) -> f64 {
        let raw = self.raw(i, c);
        if self.normalized { (raw / self.kind.largest()).max(-1.0) } else { raw }
    }

    /// Element `i`, with at most four components.
    pub(super) fn vector<const N: usize>(&self, i: usize) -> [f64; N] {
        std::array::from_fn(|c| if c < self.components { self.value(i, c) } else { 0.0 })
    }
}

impl Run<'_> {
    fn get(&self, i: usize, c: usize, kind: Component) -> f64 {
        let offset = match self.columns {
            Some((bytes, rows)) => c / rows * bytes + c % rows * kind.size(),
            None => c * kind.size(),
        };
        kind.decode(&self.bytes[i * self.stride + offset..])
    }
}

/// Number of components of a type.
pub(super) fn components(kind: &str) -> Option<usize> {
    Some(match kind {
        "SCALAR" => 1,
        "VEC2" => 2,
        "VEC3" => 3,
        "VEC4" | "MAT2" => 4,
        "MAT3" => 9,
        "MAT4" => 16,
        _ => return None,
    })
}

/// Size of an element in bytes, and its columns if they are padded: each begins at a multiple of 4 (glTF 2.0, 3.6.2.4).
pub(super) fn layout(kind: &str, component: Component) -> Option<(usize, Option<(usize, usize)>)> {
    let rows = match kind {
        "MAT2" => 2,
        "MAT3" => 3,
        "MAT4" => 4,
        _ => return Some((components(kind)? * component.size(), None)),
    };
    let column = (rows * component.size()).next_multiple_of(4);
    Some((rows * column, Some((column, rows))))
}

/// Accessors of primitives with an extension that may provide their values, such as compression: values that are not
/// stored are then not zero.
fn supplied(root: &Value) -> HashSet<usize> {
    let has_others = |object: &Value, known: &[&str]| {
        let names = object.get("extensions").and_then(Value::as_object);
        names.is_some_and(|names| names.keys().any(|name| !known.contains(&name.as_str())))
    };
    let mut supplied = HashSet::new();
    for (_, primitive) in super::primitives(root) {
        let splats = extension_of(primitive, KHR_SPLATS);
        if has_others(primitive, &[KHR_SPLATS, HYBRID]) || splats.is_some_and(|khr| has_others(khr, &[HYBRID])) {
            let attributes = primitive.get("attributes").and_then(Value::as_object).into_iter().flatten();
            let named = attributes.map(|(_, accessor)| accessor).chain(primitive.get("indices"));
            supplied.extend(named.filter_map(Value::as_u64).map(|i| i as usize));
        }
    }
    supplied
}

impl<'a> Document<'a> {
    /// Loads the buffers, and reports missing or too short ones.
    pub(super) fn load(root: &'a Value, bin: Option<&'a [u8]>, folder: &'a Path, findings: &mut Findings) -> Self {
        let (mut buffers, mut loaded): (Vec<Option<Content<'a>>>, _) = (vec![], Loaded::default());
        for (at, buffer) in super::objects(root, "buffers", "") {
            let needed = index(buffer, "byteLength").unwrap_or(0);
            check_media_type(buffer, &at, findings);
            let embedded = if buffers.is_empty() { bin } else { None };
            let content = match (buffer.get("uri").and_then(Value::as_str), embedded) {
                (Some(uri), _) => loaded
                    .resolve(uri, folder)
                    .map(Stored::File)
                    .map_err(|(expected, found)| findings.error("BUFFER_URI", format!("{at}/uri"), expected, found))
                    .ok(),
                (None, Some(bin)) => {
                    // The chunk ends with up to three bytes of padding.
                    if bin.len() > needed.saturating_add(3) {
                        let expected =
                            format!("{needed} bytes in the binary chunk, as declared, and up to 3 of padding");
                        findings.warning("BUFFER_LENGTH", format!("{at}/byteLength"), expected, bin.len());
                    }
                    Some(Stored::Chunk(bin))
                }
                // Some compression extensions describe a buffer that is never stored.
                (None, None) if buffer.get("extensions").is_some() => None,
                (None, None) => {
                    findings.error("BUFFER_URI", &at, "a uri or, for buffer 0, the binary chunk of a GLB", "neither");
                    None
                }
            };
            if let Some(stored) = &content
                && stored.bytes().len() < needed
            {
                let expected = format!("at most {}, the bytes there are", stored.bytes().len());
                findings.error("BUFFER_LENGTH", format!("{at}/byteLength"), expected, needed);
            }
            buffers.push(content.map(|stored| Content { length: stored.bytes().len().min(needed), stored }));
        }
        if buffers.is_empty() && bin.is_some_and(|bin| !bin.is_empty()) {
            findings.warning("BUFFER_UNUSED", "/buffers", "a buffer for the binary chunk", "none");
        }
        let mut plain_views = HashMap::new();
        let content = |i: usize| -> Option<&[u8]> { Some(buffers.get(i)?.as_ref()?.bytes()) };
        for view in decompress(root, content) {
            match view {
                Ok((view, bytes)) => drop(plain_views.insert(view, bytes)),
                Err(Fault { location: Location::Pointer(at), expected, found }) => {
                    findings.error("VIEW_COMPRESSED", at, expected, found);
                }
                Err(Fault { location, expected, found }) => {
                    findings.error("VIEW_COMPRESSED", format!("/bufferViews: {location}"), expected, found);
                }
            }
        }
        Self { root, buffers, plain_views, supplied: supplied(root), folder }
    }

    /// Whether `name` is listed in `extensionsUsed`.
    pub(super) fn uses(&self, name: &str) -> bool {
        lists(self.root, "extensionsUsed", name)
    }

    /// Object in one of the root's arrays.
    pub(super) fn object(&self, array: &str, i: usize) -> Option<&'a Value> {
        self.root.get(array)?.get(i)
    }

    /// Length of a buffer whose content is available.
    pub(super) fn buffer_length(&self, i: usize) -> Option<usize> {
        self.buffers.get(i)?.as_ref().map(|content| content.length)
    }

    /// Content of a buffer view.
    pub(super) fn view(&self, i: usize) -> Option<&[u8]> {
        if let Some(plain) = self.plain_views.get(&i) {
            return Some(plain);
        }
        let view = self.object("bufferViews", i)?;
        let start = index(view, "byteOffset").unwrap_or(0);
        let end = start.checked_add(index(view, "byteLength")?)?;
        self.buffers.get(index(view, "buffer")?)?.as_ref()?.bytes().get(start..end)
    }

    /// Whether an extension may provide the values of an accessor.
    pub(super) fn is_supplied(&self, accessor: usize) -> bool {
        let object = self.object("accessors", accessor);
        self.supplied.contains(&accessor) || object.is_some_and(|accessor| accessor.get("extensions").is_some())
    }

    /// Total length of the buffers and of decompressed views.
    pub(super) fn stored_bytes(&self) -> usize {
        let stored = self.buffers.iter().flatten().map(|content| content.length);
        stored.chain(self.plain_views.values().map(Vec::len)).fold(0, usize::saturating_add)
    }

    /// `POSITION` of a primitive, as [`Self::elements`] has it.
    pub(super) fn positions(&self, primitive: &Value) -> Option<Elements<'_>> {
        self.elements(index(primitive.get("attributes")?, "POSITION")?)
    }

    /// `None` if something about it is broken, which [`super::accessors`] reports, or if an extension may have its
    /// values.
    pub(super) fn elements(&self, accessor: usize) -> Option<Elements<'_>> {
        let is_supplied = self.is_supplied(accessor);
        let accessor = self.object("accessors", accessor)?;
        let kind = Component::of(accessor.get("componentType")?.as_u64()?)?;
        let shape = accessor.get("type")?.as_str()?;
        let count = index(accessor, "count")?;
        let base = match index(accessor, "bufferView") {
            Some(view) => Some(self.run(view, index(accessor, "byteOffset").unwrap_or(0), count, kind, shape)?),
            None => None,
        };
        let sparse = match accessor.get("sparse") {
            Some(sparse) => Some(self.sparse(sparse, kind, shape)?),
            None => None,
        };
        // Accessors without stored data are zero; limited, because the count could be any number.
        if base.is_none() && (sparse.is_none() && is_supplied || count > self.stored_bytes().max(FEW)) {
            return None;
        }
        let normalized = accessor.get("normalized") == Some(&Value::Bool(true)) && kind != Component::Float;
        Some(Elements { count, components: components(shape)?, kind, normalized, base, sparse })
    }

    fn sparse(&self, sparse: &Value, kind: Component, shape: &str) -> Option<Sparse<'_>> {
        let count = index(sparse, "count")?;
        let (indices, values) = (sparse.get("indices")?, sparse.get("values")?);
        let offset = |object: &Value| index(object, "byteOffset").unwrap_or(0);
        let index_kind = Component::of(indices.get("componentType")?.as_u64()?)?;
        let run = self.run(index(indices, "bufferView")?, offset(indices), count, index_kind, "SCALAR")?;
        let indices = (0..count).map(|i| run.get(i, 0, index_kind) as u32).collect();
        Some(Sparse { indices, values: self.run(index(values, "bufferView")?, offset(values), count, kind, shape)? })
    }

    /// Indices of a sparse accessor, and its number of elements.
    pub(super) fn sparse_indices(&self, accessor: usize) -> Option<(Vec<u32>, usize)> {
        let accessor = self.object("accessors", accessor)?;
        let kind = Component::of(accessor.get("componentType")?.as_u64()?)?;
        let sparse = self.sparse(accessor.get("sparse")?, kind, accessor.get("type")?.as_str()?)?;
        Some((sparse.indices, index(accessor, "count")?))
    }

    fn run(&self, view: usize, offset: usize, count: usize, kind: Component, shape: &str) -> Option<Run<'_>> {
        let (size, columns) = layout(shape, kind)?;
        let stride = index(self.object("bufferViews", view)?, "byteStride").unwrap_or(size);
        let bytes = self.view(view)?.get(offset..)?;
        let needed = needed(count, stride, size)?;
        (stride >= size && needed <= bytes.len()).then_some(Run { bytes, stride, columns })
    }

    /// Fault in the range of an accessor (or of its sparse part): expectation and finding.
    pub(super) fn range_fault(
        &self,
        view: usize,
        offset: usize,
        count: usize,
        kind: Component,
        shape: &str,
    ) -> Option<(String, String)> {
        let (size, _) = layout(shape, kind)?;
        let object = self.object("bufferViews", view)?;
        let stride = index(object, "byteStride").unwrap_or(size);
        if stride < size {
            return Some((format!("a byteStride of at least {size}"), stride.to_string()));
        }
        let length = index(object, "byteLength")?;
        let fits = needed(count, stride, size).and_then(|n| n.checked_add(offset)).is_some_and(|end| end <= length);
        let expected = || format!("{count} elements of {size} bytes, {stride} apart, from byte {offset} of the view");
        (!fits).then(|| (expected(), format!("a view of {length} bytes")))
    }
}

/// Checks the media type of a buffer that is in the document.
fn check_media_type(buffer: &Value, at: &str, findings: &mut Findings) {
    let data = buffer.get("uri").and_then(Value::as_str).and_then(|uri| uri.strip_prefix("data:"));
    let Some(found) = data.and_then(|data| data.split([';', ',']).next()) else { return };
    let known = ["application/octet-stream", "application/gltf-buffer"];
    if !known.iter().any(|known| known.eq_ignore_ascii_case(found)) {
        let expected = "application/octet-stream or application/gltf-buffer";
        findings.error("BUFFER_TYPE", format!("{at}/uri"), expected, shown(found.as_bytes()));
    }
}

fn needed(count: usize, stride: usize, size: usize) -> Option<usize> {
    match count {
        0 => Some(0),
        n => (n - 1).checked_mul(stride)?.checked_add(size),
    }
}
