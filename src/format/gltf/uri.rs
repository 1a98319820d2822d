//! What a `uri` of glTF stands for: bytes in the document itself, or a file that must lie beside it.

use std::collections::HashMap;
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::buffer::Buffer;

/// Content of a data URI, or of a file in `folder` or below it. On failure: what was expected, and what was found.
pub(in crate::format) fn resolve(uri: &str, folder: &Path) -> Result<Vec<u8>, (String, String)> {
    open(uri, folder)?.into_bytes().map_err(|e| ("a readable file".to_owned(), format!("`{uri}` ({e})")))
}

/// Files that have been loaded, by their path in the system.
#[derive(Default)]
pub(in crate::format) struct Loaded(HashMap<PathBuf, Buffer>);

impl Loaded {
    /// As [`resolve`]; what many name is loaded once.
    pub(in crate::format) fn resolve(&mut self, uri: &str, folder: &Path) -> Result<Arc<Vec<u8>>, (String, String)> {
        match open_once(uri, folder, &mut self.0, true)? {
            Buffer::Memory(bytes) => Ok(bytes),
            Buffer::File { .. } => resolve(uri, folder).map(Arc::new),
        }
    }
}

/// As [`resolve`]; the file is left where it is.
fn open(uri: &str, folder: &Path) -> Result<Buffer, (String, String)> {
    open_once(uri, folder, &mut HashMap::new(), false)
}

/// As [`resolve`]; the file is left where it is, unless it is to be loaded. Those in `known`, by their path in the system, are
/// neither opened nor loaded again.
pub(super) fn open_once(
    uri: &str,
    folder: &Path,
    known: &mut HashMap<PathBuf, Buffer>,
    loads: bool,
) -> Result<Buffer, (String, String)> {
    if let Some(data) = uri.strip_prefix("data:") {
        let encoded = data.split_once(";base64,").map(|(_, encoded)| encoded);
        return encoded
            .and_then(decode_base64)
            .map(Buffer::from)
            .ok_or_else(|| ("base64 after `;base64,`".to_owned(), "a data URI without it".to_owned()));
    }
    let shown = || format!("`{uri}`");
    let inside = || "a path inside the folder of the file".to_owned();
    let name = percent_decode(uri).ok_or_else(|| ("a percent-encoded path".to_owned(), shown()))?;
    let escapes = name.contains([':', '\\'])
        || Path::new(&name)
            .components()
            .any(|c| !matches!(c, std::path::Component::Normal(_) | std::path::Component::CurDir));
    if escapes {
        return Err((inside(), shown()));
    }
    let real = |path: &Path| path.canonicalize().map_err(|e| ("a readable file".to_owned(), format!("`{name}` ({e})")));
    let base = real(if folder.as_os_str().is_empty() { Path::new(".") } else { folder })?;
    let file = real(&base.join(&name))?;
    // A symbolic link could still lead out.
    if !file.starts_with(&base) {
        return Err((inside(), shown()));
    }
    // A pipe would never end.
    if !file.is_file() {
        return Err(("a file".to_owned(), format!("`{name}`, which is none")));
    }
    if let Some(known) = known.get(&file) {
        return Ok(known.clone());
    }
    let opened = Buffer::open(&file).and_then(|file| if loads { Ok(file.into_bytes()?.into()) } else { Ok(file) });
    let opened = opened.map_err(|e| ("a readable file".to_owned(), format!("`{name}` ({e})")))?;
    known.insert(file, opened.clone());
    Ok(opened)
}

/// Length of the files at `uris`, of those that are there, each once; data URIs are none.
pub(in crate::format) fn bytes_of_files<'a>(uris: impl Iterator<Item = &'a str>, folder: &Path) -> u64 {
    let mut files = HashMap::new();
    for uri in uris.filter(|uri| !uri.starts_with("data:")) {
        // Those that are not there are none of the bytes.
        let _ = open_once(uri, folder, &mut files, false);
    }
    files.values().map(|file| file.len() as u64).sum()
}

/// Length of what a data URI holds, and at most its own.
pub(super) fn embedded_bytes(uri: &str) -> usize {
    match uri.split_once(";base64,") {
        Some((_, encoded)) => {
            let digits = encoded.trim_end_matches('=').len();
            digits / 4 * 3 + digits % 4 * 3 / 4
        }
        None => uri.len(),
    }
}

fn percent_decode(uri: &str) -> Option<String> {
    let mut bytes = vec![];
    let mut rest = uri.as_bytes();
    while let Some((&first, tail)) = rest.split_first() {
        rest = tail;
        if first == b'%' {
            let digits = tail.first_chunk::<2>().filter(|d| d.iter().all(u8::is_ascii_hexdigit))?;
            bytes.push(u8::from_str_radix(std::str::from_utf8(digits).ok()?, 16).ok()?);
            rest = &tail[2..];
        } else {
            bytes.push(first);
        }
    }
    String::from_utf8(bytes).ok()
}

fn decode_base64(text: &str) -> Option<Vec<u8>> {
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

/// Writes what it is given in base64 (RFC 4648).
pub(super) struct Base64<W> {
    out: W,
    /// One or two bytes that wait for their group.
    rest: Vec<u8>,
}

impl<W: Write> Base64<W> {
    pub(super) fn new(out: W) -> Self {
        Self { out, rest: vec![] }
    }

    /// Pads the last group.
    pub(super) fn finish(mut self) -> io::Result<()> {
        self.out.write_all(&digits(&self.rest))
    }
}

impl<W: Write> Write for Base64<W> {
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

/// Digits of groups of three bytes, the last of which may be short.
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

/// `bytes` in base64.
#[cfg(test)]
pub(super) fn encode_base64(bytes: &[u8]) -> String {
    String::from_utf8(digits(bytes)).expect("digits are ASCII")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn uris_stay_inside_the_folder() {
        let folder = tempfile::tempdir().unwrap();
        let inner = folder.path().join("in");
        std::fs::create_dir(&inner).unwrap();
        std::fs::write(folder.path().join("secret.bin"), b"secret").unwrap();
        std::fs::write(inner.join("a b.bin"), b"ok").unwrap();
        assert_eq!(resolve("a%20b.bin", &inner).unwrap(), b"ok");
        assert_eq!(resolve("./a b.bin", &inner).unwrap(), b"ok");
        for uri in ["../secret.bin", "%2e%2e/secret.bin", "/etc/passwd", "file:///etc/passwd", "..\\secret.bin", "%zz"]
        {
            assert!(resolve(uri, &inner).is_err(), "{uri}");
        }
        #[cfg(unix)]
        {
            std::os::unix::fs::symlink(folder.path().join("secret.bin"), inner.join("link.bin")).unwrap();
            let (expected, _) = resolve("link.bin", &inner).unwrap_err();
            assert_eq!(expected, "a path inside the folder of the file");
        }
    }

    #[test]
    fn base64_with_any_padding() {
        for (text, bytes) in [("TWFu", "Man"), ("TWE=", "Ma"), ("TQ==", "M"), ("TQ", "M"), ("", "")] {
            assert_eq!(decode_base64(text).unwrap(), bytes.as_bytes());
            let encoded = encode_base64(bytes.as_bytes());
            assert!(encoded == text || text == "TQ", "{encoded}");
        }
        assert!(decode_base64("T*==").is_none());
        // However it is cut.
        let bytes: Vec<u8> = (0..40_000u32).map(|i| (i * i % 251) as u8).collect();
        for step in [1, 2, 3, 5, 7, 39_998, 40_000] {
            let mut written = vec![];
            let mut encoder = Base64::new(&mut written);
            bytes.chunks(step).for_each(|part| encoder.write_all(part).unwrap());
            encoder.finish().unwrap();
            assert!(written == digits(&bytes) && decode_base64(&String::from_utf8(written).unwrap()).unwrap() == bytes);
        }
    }
}
