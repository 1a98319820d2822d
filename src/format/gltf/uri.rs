//! Resolution of a glTF `uri`: embedded data, or a file beside the document.

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::buffer::Buffer;
use crate::base64;
use crate::format::error::shown;
use crate::format::inside::inside;

/// Content of a data URI, or of a file in `folder` or below it. On failure: expectation and finding.
pub(in crate::format) fn resolve(uri: &str, folder: &Path) -> Result<Vec<u8>, (String, String)> {
    open(uri, folder)?.into_bytes().map_err(|e| ("a readable file".to_owned(), format!("`{uri}` ({e})")))
}

/// Files loaded so far, by their resolved path.
#[derive(Default)]
pub(in crate::format) struct Loaded(HashMap<PathBuf, Buffer>);

impl Loaded {
    /// Same as [`resolve`]; a file referenced many times is loaded once.
    pub(in crate::format) fn resolve(&mut self, uri: &str, folder: &Path) -> Result<Arc<Vec<u8>>, (String, String)> {
        match open_once(uri, folder, &mut self.0, true)? {
            Buffer::Memory(bytes) => Ok(bytes),
            Buffer::File { .. } => resolve(uri, folder).map(Arc::new),
        }
    }
}

/// Same as [`resolve`], but does not load the file.
fn open(uri: &str, folder: &Path) -> Result<Buffer, (String, String)> {
    open_once(uri, folder, &mut HashMap::new(), false)
}

/// Same as [`resolve`], but loads the file only if requested. Files in `known`, by resolved path, are neither opened
/// nor loaded again.
pub(super) fn open_once(
    uri: &str,
    folder: &Path,
    known: &mut HashMap<PathBuf, Buffer>,
    loads: bool,
) -> Result<Buffer, (String, String)> {
    if let Some(data) = uri.strip_prefix("data:") {
        let encoded = data.split_once(";base64,").map(|(_, encoded)| encoded);
        return encoded
            .and_then(base64::decode)
            .map(Buffer::from)
            .ok_or_else(|| ("base64 after `;base64,`".to_owned(), "a data URI without it".to_owned()));
    }
    let name = percent_decode(uri).ok_or_else(|| ("a percent-encoded path".to_owned(), format!("`{uri}`")))?;
    // Between folders, a URI has `/` alone.
    if name.contains('\\') {
        return Err(("a path inside the folder of the file".to_owned(), shown(name.as_bytes())));
    }
    let file = inside(folder, &name)?;
    if let Some(known) = known.get(&file) {
        return Ok(known.clone());
    }
    let opened = Buffer::open(&file).and_then(|file| if loads { Ok(file.into_bytes()?.into()) } else { Ok(file) });
    let opened = opened.map_err(|e| ("a readable file".to_owned(), format!("`{name}` ({e})")))?;
    known.insert(file, opened.clone());
    Ok(opened)
}

/// Total length of the existing files at `uris`, each counted once; data URIs are ignored.
pub(in crate::format) fn bytes_of_files<'a>(uris: impl Iterator<Item = &'a str>, folder: &Path) -> u64 {
    let mut files = HashMap::new();
    for uri in uris.filter(|uri| !uri.starts_with("data:")) {
        // Missing files do not count.
        let _ = open_once(uri, folder, &mut files, false);
    }
    files.values().map(|file| file.len() as u64).sum()
}

/// Length of a data URI's content, at most that of the URI itself.
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
        for uri in [".\\a b.bin", ".%5Ca b.bin"] {
            assert_eq!(resolve(uri, &inner).unwrap_err().0, "a path inside the folder of the file", "{uri}");
        }
        #[cfg(unix)]
        {
            std::os::unix::fs::symlink(folder.path().join("secret.bin"), inner.join("link.bin")).unwrap();
            let (expected, _) = resolve("link.bin", &inner).unwrap_err();
            assert_eq!(expected, "a path inside the folder of the file");
        }
    }
}
