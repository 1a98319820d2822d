//! Decompression of the two encodings of a crate file: LZ4 blocks, and integers as differences of few bytes.

/// Upper bound on bytes per byte of an LZ4 block.
const MAX_RATIO: usize = 255;

/// Decompresses a piece to at most `limit` bytes; `None` if it is malformed.
pub(super) fn decompress(piece: &[u8], limit: usize) -> Option<Vec<u8>> {
    let limit = limit.min(piece.len().saturating_mul(MAX_RATIO));
    let (&chunks, mut rest) = piece.split_first()?;
    let mut out = vec![];
    if chunks == 0 {
        lz4(rest, limit, &mut out)?;
        return Some(out);
    }
    for _ in 0..chunks {
        let (size, tail) = rest.split_first_chunk::<4>()?;
        let chunk = tail.get(..usize::try_from(i32::from_le_bytes(*size)).ok()?)?;
        // Each chunk is an independent block.
        let mut block = vec![];
        lz4(chunk, limit - out.len(), &mut block)?;
        out.append(&mut block);
        rest = &tail[chunk.len()..];
    }
    Some(out)
}

fn lz4(mut block: &[u8], limit: usize, out: &mut Vec<u8>) -> Option<()> {
    loop {
        let (&token, rest) = block.split_first()?;
        block = rest;
        let literals = length(usize::from(token >> 4), &mut block)?;
        out.extend_from_slice(block.get(..literals)?);
        block = &block[literals..];
        if out.len() > limit {
            return None;
        }
        if block.is_empty() {
            return Some(());
        }
        let (distance, rest) = block.split_first_chunk::<2>()?;
        block = rest;
        let matched = length(usize::from(token & 15), &mut block)? + 4;
        let start = out.len().checked_sub(usize::from(u16::from_le_bytes(*distance)))?;
        if start == out.len() || out.len() + matched > limit {
            return None;
        }
        // A match may overlap the bytes that it produces.
        for i in start..start + matched {
            out.push(out[i]);
        }
    }
}

/// Decodes a length that starts with `nibble`.
fn length(nibble: usize, block: &mut &[u8]) -> Option<usize> {
    let mut total = nibble;
    if nibble == 15 {
        loop {
            let (&more, rest) = block.split_first()?;
            *block = rest;
            total += usize::from(more);
            if more < 255 {
                break;
            }
        }
    }
    Some(total)
}

/// Decodes `count` 32-bit integers.
pub(super) fn integers_32(piece: &[u8], count: usize) -> Option<Vec<i32>> {
    let values = integers::<4>(piece, count, [1, 2, 4])?;
    // Differences wrap around, as in unsigned arithmetic.
    Some(values.into_iter().map(|v| v as i32).collect())
}

/// Decodes `count` 64-bit integers.
pub(super) fn integers_64(piece: &[u8], count: usize) -> Option<Vec<i64>> {
    integers::<8>(piece, count, [2, 4, 8])
}

/// Decodes integers of `N` bytes: the most frequent difference, two bits per integer (that difference, or one of
/// `sizes` bytes), the differences.
fn integers<const N: usize>(piece: &[u8], count: usize, sizes: [usize; 3]) -> Option<Vec<i64>> {
    let codes_length = count.div_ceil(4);
    let limit = N.checked_add(codes_length)?.checked_add(count.checked_mul(N)?)?;
    let content = decompress(piece, limit)?;
    let signed = |bytes: &[u8]| {
        let mut wide = if bytes.last().is_some_and(|b| b & 0x80 != 0) { [0xff; 8] } else { [0; 8] };
        wide[..bytes.len()].copy_from_slice(bytes);
        i64::from_le_bytes(wide)
    };
    let common = signed(content.get(..N)?);
    let codes = content.get(N..N + codes_length)?;
    let mut rest = &content[N + codes_length..];
    let mut values = Vec::with_capacity(count);
    let mut value = 0i64;
    for i in 0..count {
        let difference = match codes[i / 4] >> (2 * (i % 4)) & 3 {
            0 => common,
            code => {
                let (bytes, tail) = rest.split_at_checked(sizes[usize::from(code) - 1])?;
                rest = tail;
                signed(bytes)
            }
        };
        value = value.wrapping_add(difference);
        values.push(value);
    }
    Some(values)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn blocks_and_integers_of_the_format() {
        // Literals `ab`, a match of length 6 at distance 2, and the literal `c`.
        let block = [0, 0x22, b'a', b'b', 2, 0, 0x10, b'c'];
        assert_eq!(decompress(&block, 100).unwrap(), b"ababababc");
        assert!(decompress(&block, 8).is_none() && decompress(&block[..6], 100).is_none());
        let chunks = [&[2, 7, 0, 0, 0][..], &block[1..], &[2, 0, 0, 0, 0x10, b'd']].concat();
        assert_eq!(decompress(&chunks, 100).unwrap(), b"ababababcd");
        // The crate's own example: 123, 124, 125, 100125, 100125, 100126, 100126 with common difference 1.
        let content = [&[1, 0, 0, 0, 0b11_00_00_01, 0b01_00_01, 123][..], &100_000i32.to_le_bytes(), &[0, 0]].concat();
        let piece = [&[0, (content.len() as u8) << 4][..], &content].concat();
        let piece = if content.len() < 15 { piece } else { unreachable!("short enough for one token") };
        assert_eq!(integers_32(&piece, 7).unwrap(), [123, 124, 125, 100_125, 100_125, 100_126, 100_126]);
        assert!(integers_32(&piece, 9).is_none());
        assert!(decompress(&[0, 0x0f, 0, 0, 255], 1 << 20).is_none() && decompress(&[], 1).is_none());
    }
}
