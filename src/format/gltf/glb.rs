//! The GLB container: a 12-byte header, a JSON chunk, a binary chunk.

use crate::format::error::Fault;

pub(super) const MAGIC: &[u8; 4] = b"glTF";
const JSON: u32 = 0x4E4F_534A;
const BIN: u32 = 0x004E_4942;

/// What a GLB file holds.
pub(super) struct Chunks<'a> {
    pub(super) json: &'a [u8],
    /// Offset of `json` in the file.
    pub(super) json_offset: usize,
    pub(super) bin: Option<&'a [u8]>,
    /// Offset of `bin` in the file.
    pub(super) bin_offset: usize,
}

pub(super) fn split(bytes: &[u8]) -> Result<Chunks<'_>, Fault> {
    let u32_at = |offset: usize| -> Result<u32, Fault> {
        let word = bytes.get(offset..).and_then(|b| b.first_chunk::<4>());
        word.map(|b| u32::from_le_bytes(*b))
            .ok_or_else(|| Fault::byte(offset, "4 more bytes of the GLB container", "the end of the file"))
    };
    if !bytes.starts_with(MAGIC) {
        return Err(Fault::byte(0, "the GLB magic `glTF`", "something else"));
    }
    if u32_at(4)? != 2 {
        return Err(Fault::byte(4, "GLB version 2", u32_at(4)?.to_string()));
    }
    let length = u32_at(8)? as usize;
    if length > bytes.len() {
        return Err(Fault::byte(8, format!("a file of {length} bytes"), format!("{} bytes", bytes.len())));
    }
    let chunk = |offset: usize| -> Result<(u32, &[u8]), Fault> {
        let size = u32_at(offset)? as usize;
        let start = offset + 8;
        let data = start.checked_add(size).filter(|&end| end <= length).and_then(|end| bytes.get(start..end));
        let left = length.saturating_sub(start);
        let data =
            data.ok_or_else(|| Fault::byte(offset, format!("a chunk of at most {left} bytes"), size.to_string()))?;
        Ok((u32_at(offset + 4)?, data))
    };
    let (kind, json) = chunk(12)?;
    if kind != JSON {
        return Err(Fault::byte(16, "a JSON chunk first", format!("chunk type {kind:#010x}")));
    }
    let mut offset = 20 + json.len();
    // Chunks of other types are to be ignored.
    while offset + 8 <= length {
        let (kind, data) = chunk(offset)?;
        if kind == BIN {
            return Ok(Chunks { json, json_offset: 20, bin: Some(data), bin_offset: offset + 8 });
        }
        offset += 8 + data.len();
    }
    Ok(Chunks { json, json_offset: 20, bin: None, bin_offset: 0 })
}

/// The container's bytes before a JSON chunk and a binary chunk of these lengths, both to be padded to multiples of 4;
/// `None` if it would pass 4 GiB, the most that the container can address.
pub(super) fn headers(json: usize, bin: usize) -> Option<[Vec<u8>; 2]> {
    let (json, bin) = (json.checked_next_multiple_of(4)?, bin.checked_next_multiple_of(4)?);
    let bin_chunk = if bin == 0 { 0 } else { 8 + bin };
    let length = u32::try_from(json.checked_add(bin_chunk)?.checked_add(20)?).ok()?;
    let words = |words: &[u32]| words.iter().flat_map(|w| w.to_le_bytes()).collect();
    let header: Vec<u8> = words(&[u32::from_le_bytes(*MAGIC), 2, length, u32::try_from(json).ok()?, JSON]);
    let bin_header = if bin == 0 { vec![] } else { words(&[u32::try_from(bin).ok()?, BIN]) };
    Some([header, bin_header])
}
