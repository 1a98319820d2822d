//! Base64 encoding and decoding (RFC 4648), for embedded data.

use std::io::{self, Write};

/// Encodes `bytes` in base64, padded.
pub(crate) fn encode(bytes: &[u8]) -> String {
    String::from_utf8(digits(bytes)).expect("digits are ASCII")
}

/// Decodes base64 in either alphabet, padded or not; `None` if `text` has other characters.
pub(crate) fn decode(text: &str) -> Option<Vec<u8>> {
    let mut bytes = Vec::with_capacity(text.len() / 4 * 3);
    let (mut bits, mut pending) = (0u32, 0);
    for c in text.trim_end_matches('=').bytes() {
        let value = match c {
            b'A'..=b'Z' => c - b'A',
            b'a'..=b'z' => c - b'a' + 26,
            b'0'..=b'9' => c - b'0' + 52,
            b'+' | b'-' => 62,
            b'/' | b'_' => 63,
            _ => return None,
        };
        bits = (bits << 6 | u32::from(value)) & 0xFF_FFFF;
        pending += 6;
        if pending >= 8 {
            pending -= 8;
            bytes.push((bits >> pending) as u8);
        }
    }
    Some(bytes)
}

/// Streaming base64 encoder.
pub(crate) struct Encoder<W> {
    out: W,
    /// One or two bytes of an incomplete group.
    rest: Vec<u8>,
}

impl<W: Write> Encoder<W> {
    pub(crate) fn new(out: W) -> Self {
        Self { out, rest: vec![] }
    }

    /// Writes the last group, padded.
    pub(crate) fn finish(mut self) -> io::Result<()> {
        self.out.write_all(&digits(&self.rest))
    }
}

impl<W: Write> Write for Encoder<W> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let missing = (3 - self.rest.len()) % 3;
        let (first, others) = bytes.split_at(missing.min(bytes.len()));
        self.rest.extend(first);
        if self.rest.len() == 3 {
            self.out.write_all(&digits(&self.rest))?;
            self.rest.clear();
        }
        let whole = others.len() / 3 * 3;
        for groups in others[..whole].chunks(3 << 12) {
            self.out.write_all(&digits(groups))?;
        }
        self.rest.extend(&others[whole..]);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        self.out.flush()
    }
}

/// Encodes groups of three bytes, the last of which may be short.
fn digits(bytes: &[u8]) -> Vec<u8> {
    const DIGITS: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let mut text = Vec::with_capacity(bytes.len().div_ceil(3) * 4);
    for group in bytes.chunks(3) {
        let word = group.iter().fold(0u32, |word, &b| word << 8 | u32::from(b)) << (8 * (3 - group.len()));
        let digit = |i: usize| DIGITS[(word >> (18 - 6 * i) & 63) as usize];
        text.extend((0..4).map(|i| if i <= group.len() { digit(i) } else { b'=' }));
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn examples_of_rfc_4648() {
        let cases =
            [("", ""), ("f", "Zg=="), ("fo", "Zm8="), ("foo", "Zm9v"), ("foob", "Zm9vYg=="), ("fooba", "Zm9vYmE=")];
        for (text, code) in cases {
            assert_eq!(encode(text.as_bytes()), code);
            for code in [code, code.trim_end_matches('=')] {
                assert_eq!(decode(code).unwrap(), text.as_bytes());
            }
        }
        assert_eq!(encode(&[0xfb, 0xff, 0xfe]), "+//+");
        assert_eq!((decode("-__-").unwrap(), decode("T*==")), (vec![0xfb, 0xff, 0xfe], None));
    }

    #[test]
    fn pieces_of_any_length_give_one_text() {
        let bytes: Vec<u8> = (0..40_000u32).map(|i| (i * i % 251) as u8).collect();
        for step in [1, 2, 3, 5, 7, 39_998, 40_000] {
            let mut written = vec![];
            let mut encoder = Encoder::new(&mut written);
            bytes.chunks(step).for_each(|part| encoder.write_all(part).unwrap());
            encoder.finish().unwrap();
            assert!(written == digits(&bytes) && decode(&String::from_utf8(written).unwrap()).unwrap() == bytes);
        }
    }
}
