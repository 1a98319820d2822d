//! Writer of a document and its single buffer: as `.glb`, or as `.gltf` with the buffer as a data URI. Either way a
//! scene is one file, written atomically.

use std::borrow::Cow;
use std::io::{self, Write};
use std::ops::Range;
use std::path::Path;

use serde_json::{Value, json};

use super::buffer::{self, Buffer};
use super::glb;
use crate::base64;
use crate::format::blocks::{BLOCK_BYTES, in_waves};
use crate::format::error::{Fault, FormatError};
use crate::format::{Format, atomic_write_with};

/// Content of buffer 0, in pieces aligned to 4 bytes.
#[derive(Default)]
pub(super) struct Bin<'a> {
    pieces: Vec<Piece<'a>>,
    length: usize,
}

enum Piece<'a> {
    Bytes(Cow<'a, [u8]>),
    Rows(Rows<'a>),
    /// First bytes of a buffer that was read.
    Copy(&'a Buffer, usize),
}

/// Rows generated while being written, so that a large scene is not held a second time.
struct Rows<'a> {
    count: usize,
    stride: usize,
    append: Box<Append<'a>>,
}

/// Function that appends the rows of a range.
type Append<'a> = dyn Fn(Range<usize>, &mut Vec<u8>) + Sync + 'a;

impl Rows<'_> {
    fn write(&self, out: &mut (impl Write + Send)) -> io::Result<()> {
        let per_block = (BLOCK_BYTES / self.stride).max(1);
        let block = |i: usize| {
            let rows = i * per_block..self.count.min((i + 1) * per_block);
            let mut bytes = Vec::with_capacity(rows.len() * self.stride);
            (self.append)(rows, &mut bytes);
            bytes
        };
        in_waves(self.count.div_ceil(per_block), block, |bytes| out.write_all(&bytes))
    }
}

impl<'a> Bin<'a> {
    /// Appends a piece; returns its offset.
    pub(super) fn push(&mut self, piece: impl Into<Cow<'a, [u8]>>) -> usize {
        let piece = piece.into();
        self.place(piece.len(), Piece::Bytes(piece))
    }

    /// Appends the first `length` bytes of a buffer; returns their offset.
    pub(super) fn push_copy(&mut self, buffer: &'a Buffer, length: usize) -> usize {
        self.place(length, Piece::Copy(buffer, length))
    }

    /// Appends `count` rows of `stride` bytes each; `row` appends the row of an index. Returns their offset.
    pub(super) fn push_rows(
        &mut self,
        count: usize,
        stride: usize,
        row: impl Fn(usize, &mut Vec<u8>) + Sync + 'a,
    ) -> usize {
        let append = Box::new(move |rows: Range<usize>, bytes: &mut Vec<u8>| rows.for_each(|i| row(i, bytes)));
        self.place(count * stride, Piece::Rows(Rows { count, stride, append }))
    }

    fn place(&mut self, length: usize, piece: Piece<'a>) -> usize {
        let start = self.length.next_multiple_of(4);
        if start > self.length {
            self.pieces.push(Piece::Bytes(vec![0; start - self.length].into()));
        }
        self.length = start + length;
        self.pieces.push(piece);
        start
    }

    pub(super) fn len(&self) -> usize {
        self.length
    }

    fn write(&self, out: &mut (impl Write + Send)) -> io::Result<()> {
        self.pieces.iter().try_for_each(|piece| match piece {
            Piece::Bytes(bytes) => out.write_all(bytes),
            Piece::Rows(rows) => rows.write(out),
            Piece::Copy(buffer, length) => buffer.copy(*length, out),
        })
    }
}

/// Text of a document before and after the content of buffer 0 in its data URI.
fn around_content(document: &mut Value) -> (String, String) {
    // Placeholder that occurs nowhere else in the document.
    for mark in 0u64.. {
        let mark = format!("(content {mark})");
        document["buffers"][0]["uri"] = json!(format!("data:application/octet-stream;base64,{mark}"));
        let text = document.to_string();
        let mut places = text.match_indices(&mark).map(|(at, _)| at);
        if let (Some(at), None) = (places.next(), places.next()) {
            return (text[..at].to_owned(), text[at + mark.len()..].to_owned());
        }
    }
    unreachable!("a document is finite")
}

/// Writes a document to `path`; returns the file's size. `buffers[0]` of the document must describe `bin`.
pub(super) fn write(path: &Path, document: Value, bin: &Bin<'_>) -> Result<u64, FormatError> {
    written(path, document, bin).map_err(buffer::of_writing)
}

fn written(path: &Path, mut document: Value, bin: &Bin<'_>) -> Result<u64, FormatError> {
    let is_text = Format::of_path(path) == Some(Format::Gltf);
    if is_text {
        if bin.len() == 0 {
            return atomic_write_with(path, |file| Ok(serde_json::to_writer(file, &document)?));
        }
        let (before, after) = around_content(&mut document);
        return atomic_write_with(path, |file| {
            file.write_all(before.as_bytes())?;
            let mut encoder = base64::Encoder::new(&mut *file);
            bin.write(&mut encoder)?;
            encoder.finish()?;
            file.write_all(after.as_bytes())
        });
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
        bin.write(file)?;
        file.write_all(&[0; 3][..bin_padding])
    })
}
