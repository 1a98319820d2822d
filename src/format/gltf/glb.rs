//! GLB container: a 12-byte header, a JSON chunk, a binary chunk.

use std::io::{Read, Seek, SeekFrom};
use std::ops::Range;

use crate::format::error::Fault;

pub(super) const MAGIC: &[u8; 4] = b"glTF";
const JSON: u32 = 0x4E4F_534A;
const BIN: u32 = 0x004E_4942;

/// Offset of the JSON text, always the same.
pub(super) const JSON_OFFSET: usize = 20;

/// Chunks of a GLB file.
pub(super) struct Chunks {
    pub(super) json: Vec<u8>,
    /// Range of the binary chunk in the file.
    pub(super) bin: Option<Range<usize>>,
}

/// Splits a file into its chunks; the binary chunk is not read.
pub(super) fn split(file: &mut (impl Read + Seek)) -> Result<Chunks, Fault> {
    let file_length = file.seek(SeekFrom::End(0)).map_err(|e| Fault::unreadable(0, &e))? as usize;
    let mut read = |offset: usize, size: usize| -> Result<Vec<u8>, Fault> {
        // Safe to allocate: ranges have been checked against the file's length.
        let mut bytes = vec![0; size];
        let read = file.seek(SeekFrom::Start(offset as u64)).and_then(|_| file.read_exact(&mut bytes));
        read.map_err(|e| Fault::unreadable(offset as u64, &e)).map(|()| bytes)
    };
    let mut u32_at = |offset: usize| -> Result<u32, Fault> {
        if offset.saturating_add(4) > file_length {
            return Err(Fault::byte(offset, "4 more bytes of the GLB container", "the end of the file"));
        }
        Ok(u32::from_le_bytes(read(offset, 4)?.try_into().unwrap_or_default()))
    };
    if u32_at(0)? != u32::from_le_bytes(*MAGIC) {
        return Err(Fault::byte(0, "the GLB magic `glTF`", "something else"));
    }
    let version = u32_at(4)?;
    if version != 2 {
        return Err(Fault::byte(4, "GLB version 2", version.to_string()));
    }
    let length = u32_at(8)? as usize;
    if length > file_length {
        return Err(Fault::byte(8, format!("a file of {length} bytes"), format!("{file_length} bytes")));
    }
    let mut chunk = |offset: usize| -> Result<(u32, Range<usize>), Fault> {
        let size = u32_at(offset)? as usize;
        let start = offset + 8;
        let left = length.saturating_sub(start);
        if size > left {
            return Err(Fault::byte(offset, format!("a chunk of at most {left} bytes"), size.to_string()));
        }
        Ok((u32_at(offset + 4)?, start..start + size))
    };
    let (kind, json) = chunk(12)?;
    if kind != JSON {
        return Err(Fault::byte(16, "a JSON chunk first", format!("chunk type {kind:#010x}")));
    }
    let (mut offset, mut bin) = (json.end, None);
    // Chunks of other types must be ignored.
    while bin.is_none() && offset + 8 <= length {
        let (kind, data) = chunk(offset)?;
        offset = data.end;
        bin = Some(data).filter(|_| kind == BIN);
    }
    Ok(Chunks { json: read(json.start, json.len())?, bin })
}

/// Header bytes before a JSON chunk and a binary chunk of these lengths, which are both padded to multiples of 4;
/// `None` if the file would exceed the container's limit of 4 GiB.
pub(super) fn headers(json: usize, bin: usize) -> Option<[Vec<u8>; 2]> {
    let (json, bin) = (json.checked_next_multiple_of(4)?, bin.checked_next_multiple_of(4)?);
    let bin_chunk = if bin == 0 { 0 } else { 8 + bin };
    let length = u32::try_from(json.checked_add(bin_chunk)?.checked_add(20)?).ok()?;
    let words = |words: &[u32]| words.iter().flat_map(|w| w.to_le_bytes()).collect();
    let header: Vec<u8> = words(&[u32::from_le_bytes(*MAGIC), 2, length, u32::try_from(json).ok()?, JSON]);
    let bin_header = if bin == 0 { vec![] } else { words(&[u32::try_from(bin).ok()?, BIN]) };
    Some([header, bin_header])
}
