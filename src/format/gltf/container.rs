//! Writes a document and its one buffer: as `.glb`, or as `.gltf` with the buffer inside as a data URI, so that either
//! way a scene is one file, which is there as a whole or not at all.

use std::borrow::Cow;
use std::io::Write as _;
use std::path::Path;

use serde_json::{Value, json};

use super::{glb, uri};
use crate::format::atomic_write_with;
use crate::format::error::{Fault, FormatError};

/// The content of buffer 0, in pieces that begin at multiples of 4 bytes.
#[derive(Default)]
pub(super) struct Bin<'a> {
    pieces: Vec<Cow<'a, [u8]>>,
    length: usize,
}

impl<'a> Bin<'a> {
    /// Appends a piece; returns where it begins.
    pub(super) fn push(&mut self, piece: impl Into<Cow<'a, [u8]>>) -> usize {
        let start = self.length.next_multiple_of(4);
        if start > self.length {
            self.pieces.push(vec![0; start - self.length].into());
        }
        let piece = piece.into();
        self.length = start + piece.len();
        self.pieces.push(piece);
        start
    }

    pub(super) fn len(&self) -> usize {
        self.length
    }
}

/// Writes to `path`; returns the file's size. `buffers[0]` of the document must be what `bin` holds.
pub(super) fn write(path: &Path, mut document: Value, bin: &Bin<'_>) -> Result<u64, FormatError> {
    let is_text = path.extension().is_some_and(|e| e.eq_ignore_ascii_case("gltf"));
    if is_text {
        if bin.len() > 0 {
            let mut text = "data:application/octet-stream;base64,".to_owned();
            // Base64 takes three bytes at a time, wherever pieces end.
            uri::encode_base64(&bin.pieces.concat(), &mut text);
            document["buffers"][0]["uri"] = json!(text);
        }
        return atomic_write_with(path, |file| Ok(serde_json::to_writer(file, &document)?));
    }
    let text = document.to_string().into_bytes();
    let headers = glb::headers(text.len(), bin.len()).ok_or_else(|| {
        Fault::whole("a scene that fits into a GLB of 4 GiB", format!("{} bytes", bin.len())).in_file(path)
    })?;
    let [padding, bin_padding] = [text.len(), bin.len()].map(|n| n.next_multiple_of(4) - n);
    atomic_write_with(path, |file| {
        file.write_all(&headers[0])?;
        file.write_all(&text)?;
        file.write_all(&b"   "[..padding])?;
        file.write_all(&headers[1])?;
        bin.pieces.iter().try_for_each(|piece| file.write_all(piece))?;
        file.write_all(&[0; 3][..bin_padding])
    })
}
