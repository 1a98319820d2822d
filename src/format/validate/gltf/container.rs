//! Validation of the GLB container and of the JSON text.

use serde_json::Value;

use super::super::Findings;
use crate::format::error::Location;
use crate::format::gltf::write_as_integers;

const JSON: u32 = 0x4E4F_534A;
const BIN: u32 = 0x004E_4942;

/// Parts of a file.
pub(super) struct Parts<'a> {
    pub(super) root: Value,
    /// Content of the binary chunk of a GLB.
    pub(super) bin: Option<&'a [u8]>,
}

/// Parses the JSON; `None` (with findings) if that is impossible.
pub(super) fn open<'a>(bytes: &'a [u8], findings: &mut Findings) -> Option<Parts<'a>> {
    let (json, start, bin) = if bytes.starts_with(b"glTF") { chunks(bytes, findings)? } else { (bytes, 0, None) };
    match serde_json::from_slice(json) {
        Ok(mut root @ Value::Object(_)) => {
            write_as_integers(&mut root);
            Some(Parts { root, bin })
        }
        Ok(_) => {
            findings.error("JSON_SYNTAX", byte(start), "a JSON object", "another value");
            None
        }
        Err(e) => {
            let lines = json.split_inclusive(|&b| b == b'\n').take(e.line().max(1) - 1);
            let offset = start + lines.map(<[u8]>::len).sum::<usize>() + e.column();
            findings.error("JSON_SYNTAX", byte(offset), "JSON", e);
            None
        }
    }
}

fn byte(offset: usize) -> Location {
    Location::Byte(offset as u64)
}

/// JSON text, its offset, and the binary chunk.
#[expect(clippy::type_complexity, reason = "taken apart at once by the only caller")]
fn chunks<'a>(bytes: &'a [u8], findings: &mut Findings) -> Option<(&'a [u8], usize, Option<&'a [u8]>)> {
    let word = |offset: usize| bytes.get(offset..)?.first_chunk::<4>().map(|b| u32::from_le_bytes(*b));
    let (Some(version), Some(length)) = (word(4), word(8)) else {
        findings.error("GLB_HEADER", byte(0), "a header of 12 bytes", format!("{} bytes", bytes.len()));
        return None;
    };
    if version != 2 {
        findings.error("GLB_VERSION", byte(4), "version 2", version);
    }
    if length as usize != bytes.len() {
        findings.error("GLB_LENGTH", byte(8), format!("{}, the length of the file", bytes.len()), length);
    }
    let (mut json, mut bin) = (None, None);
    let mut offset = 12;
    let mut number = 0;
    while offset < bytes.len() {
        let (Some(size), Some(kind)) = (word(offset), word(offset + 4)) else {
            let left = bytes.len() - offset;
            findings.error("GLB_CHUNK_HEADER", byte(offset), "a chunk header of 8 bytes", format!("{left} bytes"));
            break;
        };
        let size = size as usize;
        let start = offset + 8;
        let left = bytes.len() - start;
        if !size.is_multiple_of(4) {
            findings.error("GLB_CHUNK_ALIGNMENT", byte(offset), "a chunk length that is a multiple of 4", size);
        }
        if size > left {
            findings.error("GLB_CHUNK_LENGTH", byte(offset), format!("a chunk of at most {left} bytes"), size);
        }
        let content = &bytes[start..start + size.min(left)];
        match (number, kind) {
            (0, JSON) => json = Some((content, start)),
            (1, BIN) => bin = Some(content),
            (0, _) | (_, JSON | BIN) => {
                let expected = "JSON first, then at most one BIN chunk";
                findings.error(
                    "GLB_CHUNK_ORDER",
                    byte(offset + 4),
                    expected,
                    format!("chunk {number} of type {kind:#010x}"),
                );
            }
            _ => {
                findings.warning(
                    "GLB_CHUNK_TYPE",
                    byte(offset + 4),
                    "chunks of type JSON or BIN",
                    format!("{kind:#010x}"),
                );
            }
        }
        offset = start + size.min(left);
        number += 1;
    }
    if json.is_none() {
        findings.error("GLB_CHUNK_ORDER", byte(12), "a JSON chunk", "none");
    }
    json.map(|(content, start)| (content, start, bin))
}
