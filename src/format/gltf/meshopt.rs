//! Decoding of `EXT_meshopt_compression` and `KHR_meshopt_compression`: buffer views whose bytes are stored compressed.

use std::collections::HashMap;

use meshopt::{
    decode_filter_color, decode_filter_exp, decode_filter_oct, decode_filter_quat, decode_index_buffer,
    decode_index_sequence, decode_vertex_buffer,
};
use serde::Deserialize;
use serde_json::Value;

use super::extension::extension_of;
use super::json::items;
use crate::format::error::{Fault, from_value};

/// Names of the extension; KHR adds a version of the attribute codec and the filter COLOR.
pub(in crate::format) const NAMES: [&str; 2] = ["EXT_meshopt_compression", "KHR_meshopt_compression"];

/// Upper bound on decompressed bytes of vertices per stored byte: two bits of a control byte can state that a byte is
/// equal in 256 vertices. Indices take a byte or more each.
const MAX_RATIO: usize = 1024;

/// `bufferView.extensions.*_meshopt_compression`.
#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Compressed {
    buffer: usize,
    #[serde(default)]
    byte_offset: usize,
    byte_length: usize,
    byte_stride: usize,
    count: usize,
    mode: String,
    filter: Option<String>,
}

/// Compressed form of a buffer view, with its path below the view.
pub(super) fn of_view(view: &Value) -> Option<(&'static str, &Value)> {
    NAMES.into_iter().find_map(|name| Some((name, extension_of(view, name)?)))
}

/// Decompresses every compressed view of the document, given its buffers by index: (view, bytes). Many views may share
/// the same bytes, so the limit applies to all of them together.
pub(in crate::format) fn decompress<'b>(
    root: &Value,
    buffer: impl Fn(usize) -> Option<&'b [u8]>,
) -> impl Iterator<Item = Result<(usize, Vec<u8>), Fault>> {
    let views = items(root, "bufferViews").iter();
    let mut starts = HashMap::new();
    let sources = views.clone().filter_map(|view| of_view(view)?.1.get("buffer")?.as_u64());
    for bytes in sources.filter_map(|i| buffer(i as usize)) {
        let length = starts.entry(bytes.as_ptr()).or_default();
        *length = bytes.len().max(*length);
    }
    let mut total = Total { stored: starts.into_values().sum(), bytes: 0 };
    views.enumerate().filter_map(move |(i, view)| {
        let (name, value) = of_view(view)?;
        let at = format!("/bufferViews/{i}/extensions/{name}");
        let decoded = from_value::<Compressed>(value, &at, &format!("an object of {name}"))
            .and_then(|compressed| compressed.decode(buffer(compressed.buffer).unwrap_or_default(), &mut total, &at));
        Some(decoded.and_then(|bytes| {
            let declared = view.get("byteLength").and_then(Value::as_u64).unwrap_or(0);
            if bytes.len() as u64 == declared {
                return Ok((i, bytes));
            }
            let expected = format!("byteStride · count = {} bytes", bytes.len());
            Err(Fault::pointer(format!("/bufferViews/{i}/byteLength"), expected, declared.to_string()))
        }))
    })
}

/// Memory of all decompressed views of a document.
struct Total {
    /// Bytes of their buffers, counting those in the same place once.
    stored: usize,
    /// Bytes decompressed so far.
    bytes: usize,
}

impl Total {
    /// Counts bytes before they are decompressed, or rejects them.
    fn spend(&mut self, bytes: usize, at: &str) -> Result<(), Fault> {
        self.bytes = self.bytes.saturating_add(bytes);
        if self.bytes / MAX_RATIO <= self.stored {
            return Ok(());
        }
        let most = self.stored.saturating_mul(MAX_RATIO);
        let expected = format!("at most {most} bytes from all {} compressed ones", self.stored);
        Err(Fault::pointer(format!("{at}/count"), expected, "more, by repeated use"))
    }
}

impl Compressed {
    fn decode(&self, buffer: &[u8], total: &mut Total, at: &str) -> Result<Vec<u8>, Fault> {
        let end = self.byte_offset.checked_add(self.byte_length);
        let stored = end.and_then(|end| buffer.get(self.byte_offset..end)).ok_or_else(|| {
            let expected = format!("{} bytes at offset {}", self.byte_length, self.byte_offset);
            Fault::pointer(at, expected, format!("{} bytes in buffer {}", buffer.len(), self.buffer))
        })?;
        let (stride, count) = (self.byte_stride, self.count);
        let size = stride.checked_mul(count);
        if size.is_none_or(|size| size / MAX_RATIO > stored.len()) {
            let expected = format!("at most {} bytes from {} compressed ones", stored.len() * MAX_RATIO, stored.len());
            return Err(Fault::pointer(format!("{at}/count"), expected, format!("{count} · {stride} bytes")));
        }
        let filter = self.filter.as_deref().unwrap_or("NONE");
        let is_index = matches!(self.mode.as_str(), "TRIANGLES" | "INDICES");
        let strides_hold = match (self.mode.as_str(), filter) {
            ("ATTRIBUTES", "NONE" | "EXPONENTIAL") => (4..=256).contains(&stride) && stride.is_multiple_of(4),
            ("ATTRIBUTES", "OCTAHEDRAL" | "COLOR") | ("TRIANGLES" | "INDICES", "NONE") => {
                matches!((is_index, stride), (false, 4 | 8) | (true, 2 | 4))
            }
            ("ATTRIBUTES", "QUATERNION") => stride == 8,
            (mode, filter) => {
                let expected = "a mode and a filter that go together";
                return Err(Fault::pointer(at, expected, format!("mode `{mode}`, filter `{filter}`")));
            }
        };
        if !strides_hold {
            let expected = format!("a stride of mode {} and filter {filter}", self.mode);
            return Err(Fault::pointer(format!("{at}/byteStride"), expected, stride.to_string()));
        }
        if self.mode == "TRIANGLES" && !count.is_multiple_of(3) {
            return Err(Fault::pointer(format!("{at}/count"), "a multiple of 3", count.to_string()));
        }
        total.spend(stride * count, at)?;
        let damaged = |e: meshopt::Error| {
            Fault::pointer(at, format!("{count} elements of mode {}", self.mode), format!("damaged data ({e})"))
        };
        // Little-endian words, regardless of the machine.
        let short = |words: Vec<u16>| words.iter().flat_map(|w| w.to_le_bytes()).collect();
        let long = |words: Vec<u32>| words.iter().flat_map(|w| w.to_le_bytes()).collect();
        Ok(match (self.mode.as_str(), stride) {
            ("TRIANGLES", 2) => short(decode_index_buffer(stored, count).map_err(damaged)?),
            ("TRIANGLES", _) => long(decode_index_buffer(stored, count).map_err(damaged)?),
            ("INDICES", 2) => short(decode_index_sequence(stored, count).map_err(damaged)?),
            ("INDICES", _) => long(decode_index_sequence(stored, count).map_err(damaged)?),
            _ => {
                let mut bytes = vertices(stored, count, stride).map_err(damaged)?;
                unfilter(&mut bytes, filter, stride);
                bytes
            }
        })
    }
}

/// Vertex: the codec takes its size from the type.
#[derive(Clone, Copy)]
struct Vertex<const WORDS: usize>([[u8; 4]; WORDS]);

impl<const WORDS: usize> Default for Vertex<WORDS> {
    fn default() -> Self {
        Self([[0; 4]; WORDS])
    }
}

/// Decodes `count` vertices of `stride` (4, 8 … 256) bytes.
fn vertices(stored: &[u8], count: usize, stride: usize) -> meshopt::Result<Vec<u8>> {
    fn decode<const WORDS: usize>(stored: &[u8], count: usize) -> meshopt::Result<Vec<u8>> {
        let vertices: Vec<Vertex<WORDS>> = decode_vertex_buffer(stored, count)?;
        Ok(vertices.iter().flat_map(|v| v.0.as_flattened()).copied().collect())
    }
    macro_rules! by_words {
        ($($words:literal)+) => {
            match stride / 4 {
                $($words => decode::<$words>(stored, count),)+
                _ => Ok(vec![]),
            }
        };
    }
    by_words!(1 2 3 4 5 6 7 8 9 10 11 12 13 14 15 16 17 18 19 20 21 22 23 24 25 26 27 28 29 30 31 32 33 34 35 36 37 38 39 40
        41 42 43 44 45 46 47 48 49 50 51 52 53 54 55 56 57 58 59 60 61 62 63 64)
}

/// Reverses a filter in place; `stride` is one that the filter supports.
fn unfilter(bytes: &mut [u8], filter: &str, stride: usize) {
    let words = |bytes: &[u8]| -> Vec<[u16; 4]> {
        let rows = bytes.as_chunks::<8>().0.iter();
        rows.map(|r| [0, 2, 4, 6].map(|i| u16::from_le_bytes([r[i], r[i + 1]]))).collect()
    };
    let put = |bytes: &mut [u8], rows: Vec<[u16; 4]>| {
        let words = rows.into_iter().flatten().map(u16::to_le_bytes);
        bytes.as_chunks_mut::<2>().0.iter_mut().zip(words).for_each(|(old, new)| *old = new);
    };
    match (filter, stride) {
        ("OCTAHEDRAL", 4) => decode_filter_oct(bytes.as_chunks_mut::<4>().0),
        ("COLOR", 4) => decode_filter_color(bytes.as_chunks_mut::<4>().0),
        ("OCTAHEDRAL", _) => {
            let mut rows = words(bytes);
            decode_filter_oct(&mut rows);
            put(bytes, rows);
        }
        ("COLOR", _) => {
            let mut rows = words(bytes);
            decode_filter_color(&mut rows);
            put(bytes, rows);
        }
        ("QUATERNION", _) => {
            let mut rows: Vec<[i16; 4]> = words(bytes).into_iter().map(|r| r.map(u16::cast_signed)).collect();
            decode_filter_quat(&mut rows);
            put(bytes, rows.into_iter().map(|r| r.map(i16::cast_unsigned)).collect());
        }
        ("EXPONENTIAL", _) => {
            let mut words: Vec<[u32; 1]> = bytes.as_chunks::<4>().0.iter().map(|w| [u32::from_le_bytes(*w)]).collect();
            decode_filter_exp(&mut words);
            bytes.as_chunks_mut::<4>().0.iter_mut().zip(words).for_each(|(old, [new])| *old = new.to_le_bytes());
        }
        _ => {}
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use meshopt::{
        EncodeExpMode, encode_filter_color, encode_filter_exp, encode_filter_oct, encode_filter_quat,
        encode_index_buffer, encode_index_sequence, encode_vertex_buffer, encode_vertex_buffer_level,
    };
    use serde_json::json;

    use super::*;

    fn decode(stored: &[u8], extension: Value) -> Result<Vec<u8>, String> {
        let mut extension = extension;
        extension["buffer"] = json!(0);
        extension["byteLength"] = extension.get("byteLength").cloned().unwrap_or(json!(stored.len()));
        let bytes = [&extension["byteStride"], &extension["count"]].map(|v| v.as_u64().unwrap_or(0));
        let view = json!({
            "buffer": 0, "byteLength": bytes[0].saturating_mul(bytes[1]), "extensions": { NAMES[1]: extension }
        });
        let root = json!({ "bufferViews": [{}, view] });
        let mut views = decompress(&root, |i| (i == 0).then_some(stored));
        views.next().unwrap().map(|(_, bytes)| bytes).map_err(|fault| fault.in_file(Path::new("f")).to_string())
    }

    const UNIT: [[f32; 4]; 3] = [[1.0, 0.0, 0.0, 0.0], [0.6, 0.0, 0.8, 0.0], [0.0, -0.28, 0.96, 0.0]];

    #[test]
    fn every_mode_and_filter_comes_back() {
        let triangles = [0u32, 1, 2, 2, 1, 3, 4, 6, 5];
        for stride in [2, 4] {
            let narrowed: Vec<u8> = triangles.iter().flat_map(|t| t.to_le_bytes()[..stride].to_vec()).collect();
            let stored = encode_index_buffer(&triangles, 7).unwrap();
            let found = decode(&stored, json!({ "byteStride": stride, "count": 9, "mode": "TRIANGLES" })).unwrap();
            // The codec may rotate a triangle's corners.
            for (a, b) in found.chunks(3 * stride).zip(narrowed.chunks(3 * stride)) {
                assert!(
                    (0..3).any(|k| {
                        let mut b = b.to_vec();
                        b.rotate_left(k * stride);
                        b == a
                    }),
                    "{a:?} {b:?}"
                );
            }
            let stored = encode_index_sequence(&triangles, 7).unwrap();
            let found = decode(&stored, json!({ "byteStride": stride, "count": 9, "mode": "INDICES" })).unwrap();
            assert_eq!(found, narrowed);
        }
        let rows: Vec<[u8; 20]> = (0..300u32).map(|i| std::array::from_fn(|k| (i * (k as u32 + 1)) as u8)).collect();
        for stored in [encode_vertex_buffer(&rows).unwrap(), encode_vertex_buffer_level(&rows, 2, Some(0)).unwrap()] {
            let found = decode(&stored, json!({ "byteStride": 20, "count": 300, "mode": "ATTRIBUTES" })).unwrap();
            assert_eq!(found, rows.as_flattened());
        }

        let filtered = |stored: Vec<u8>, stride: usize, filter: &str| {
            decode(&stored, json!({ "byteStride": stride, "count": 3, "mode": "ATTRIBUTES", "filter": filter }))
                .unwrap()
        };
        let shorts = |bytes: &[u8]| -> Vec<f32> {
            bytes.as_chunks::<2>().0.iter().map(|b| f32::from(i16::from_le_bytes(*b)) / 32767.0).collect()
        };
        let near = |found: &[f32], expected: &[f32], tolerance: f32| {
            assert_eq!(found.len(), expected.len());
            assert!(found.iter().zip(expected).all(|(a, b)| (a - b).abs() < tolerance), "{found:?} {expected:?}");
        };
        let oct = filtered(encode_vertex_buffer(&encode_filter_oct::<u8>(&UNIT, 8)).unwrap(), 4, "OCTAHEDRAL");
        let oct: Vec<f32> = oct.iter().map(|b| f32::from(b.cast_signed()) / 127.0).collect();
        near(&oct, UNIT.as_flattened(), 0.02);
        let oct = filtered(encode_vertex_buffer(&encode_filter_oct::<u16>(&UNIT, 12)).unwrap(), 8, "OCTAHEDRAL");
        near(&shorts(&oct), UNIT.as_flattened(), 0.002);
        let quat = filtered(encode_vertex_buffer(&encode_filter_quat(&UNIT, 12)).unwrap(), 8, "QUATERNION");
        near(&shorts(&quat), UNIT.as_flattened(), 0.002);
        let exp = encode_filter_exp(&UNIT, 15, EncodeExpMode::SharedVector);
        let exp = filtered(encode_vertex_buffer(&exp).unwrap(), 16, "EXPONENTIAL");
        let exp: Vec<f32> = exp.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect();
        near(&exp, UNIT.as_flattened(), 1e-4);
        let rgba = [[1.0, 0.5, 0.0, 1.0], [0.2, 0.2, 0.2, 0.5], [0.0, 0.3, 0.9, 0.0]];
        let color = filtered(encode_vertex_buffer(&encode_filter_color::<u8>(&rgba, 8)).unwrap(), 4, "COLOR");
        near(&color.iter().map(|b| f32::from(*b) / 255.0).collect::<Vec<_>>(), rgba.as_flattened(), 0.02);
        let color = filtered(encode_vertex_buffer(&encode_filter_color::<u16>(&rgba, 12)).unwrap(), 8, "COLOR");
        let color: Vec<f32> =
            color.as_chunks::<2>().0.iter().map(|b| f32::from(u16::from_le_bytes(*b)) / 65535.0).collect();
        near(&color, rgba.as_flattened(), 0.002);
    }

    #[test]
    fn views_of_the_same_bytes_are_bounded_together() {
        // Almost as short as possible: all vertices are equal.
        let stored = encode_vertex_buffer(&vec![[0u8; 4]; 1 << 16]).unwrap();
        let compressed = json!({
            "buffer": 0, "byteLength": stored.len(), "byteStride": 4, "count": 1 << 16, "mode": "ATTRIBUTES",
        });
        let view = json!({ "buffer": 0, "byteLength": 1 << 18, "extensions": { NAMES[0]: compressed } });
        let fit = (stored.len() + 1) * MAX_RATIO / (1 << 18);
        let root = json!({ "bufferViews": vec![view; fit + 2] });
        let views: Vec<_> = decompress(&root, |_| Some(&stored)).collect();
        let held = views.iter().take_while(|view| view.is_ok()).count();
        assert!((1..=fit).contains(&held), "{held} of {fit}");
        let message = views.into_iter().last().unwrap().unwrap_err().in_file(Path::new("f")).to_string();
        let at = format!("f: /bufferViews/{}/extensions/EXT_meshopt_compression/count: expected at most ", fit + 1);
        assert!(message.starts_with(&at) && message.ends_with("found more, by repeated use"), "{message}");
    }

    #[test]
    fn what_does_not_hold_is_named_and_nothing_is_reserved_for_it() {
        let stored = encode_vertex_buffer(&[[1u32, 2, 3, 4]; 5]).unwrap();
        let at = "f: /bufferViews/1/extensions/KHR_meshopt_compression";
        let fails = |change: Value, message: &str| {
            let mut extension = json!({ "byteStride": 16, "count": 5, "mode": "ATTRIBUTES" });
            change.as_object().unwrap().iter().for_each(|(k, v)| extension[k] = v.clone());
            let found = decode(&stored, extension).unwrap_err();
            assert!(found.starts_with(&format!("{at}{message}")), "{found}");
        };
        fails(json!({ "count": u32::MAX }), "/count: expected at most");
        fails(json!({ "count": u64::MAX }), "/count: expected at most");
        fails(json!({ "byteLength": 9999 }), ": expected 9999 bytes at offset 0");
        fails(json!({ "byteOffset": u64::MAX }), ": expected");
        fails(json!({ "byteStride": 6 }), "/byteStride: expected a stride of mode ATTRIBUTES");
        fails(json!({ "byteStride": 260 }), "/byteStride: expected");
        fails(json!({ "byteStride": 20 }), ": expected 5 elements of mode ATTRIBUTES, found damaged data");
        fails(json!({ "byteLength": 9 }), ": expected 5 elements of mode ATTRIBUTES, found damaged data");
        fails(json!({ "filter": "QUATERNION" }), "/byteStride: expected");
        fails(json!({ "filter": "BLUR" }), ": expected a mode and a filter that go together");
        fails(json!({ "mode": "TRIANGLES", "byteStride": 4 }), "/count: expected a multiple of 3, found 5");
        fails(json!({ "mode": "TRIANGLES", "byteStride": 4, "count": 6 }), ": expected 6 elements of mode TRIANGLES");
        fails(json!({ "mode": 3 }), "/mode: expected an object of KHR_meshopt_compression");
    }
}
