//! Rows of a PLY, read one by one or in blocks, so that a file need not fit into memory.

use std::io::{BufRead, Seek, SeekFrom};

use super::{Column, Element, Encoding, Header, Scalar};
use crate::format::blocks::{BLOCK_BYTES, in_blocks};
use crate::format::error::{Fault, Location, shown};

/// Longest number in ASCII that is accepted; the longest f64 written out in full takes 344 characters.
const MAX_TOKEN: usize = 512;

/// Rows after a header.
pub(crate) struct Body<R> {
    reader: R,
    /// Offset of the first row.
    start: u64,
    /// Current offset of `reader`.
    offset: u64,
    length: u64,
    encoding: Encoding,
    token: Vec<u8>,
}

/// One row: `values[column]` for scalars (NaN in place of a list), `lists[column]` for lists.
#[derive(Default)]
pub(crate) struct Row {
    /// Offset in the file.
    pub(crate) at: usize,
    pub(crate) values: Vec<f64>,
    pub(crate) lists: Vec<Vec<f64>>,
}

impl<R: BufRead + Seek> Body<R> {
    /// Creates the body; `reader` is at `start`, the end of the header, in a file of `length` bytes.
    pub(super) fn new(reader: R, start: u64, length: u64, encoding: Encoding) -> Self {
        Self { reader, start, offset: start, length, encoding, token: vec![] }
    }

    /// Passes over all rows of all elements without evaluating them. Returns the number of bytes after the last row.
    pub(crate) fn bytes_after_rows(&mut self, header: &Header) -> Result<u64, Fault> {
        self.rewind()?;
        header.elements.iter().try_for_each(|element| self.pass(element))?;
        let rest = self.length - self.offset;
        if self.encoding == Encoding::Ascii {
            self.next_token()?;
            return Ok(if self.token.is_empty() { 0 } else { rest });
        }
        Ok(rest)
    }

    /// Calls `visit` with each row, in order, of the first table called `name`.
    ///
    /// `reserve` is called once before, with the number of rows, which has then been checked against the file's length.
    pub(crate) fn rows<S>(
        &mut self,
        header: &Header,
        name: &str,
        reserve: impl FnOnce(usize) -> S,
        mut visit: impl FnMut(&mut S, &Row) -> Result<(), Fault>,
    ) -> Result<S, Fault> {
        let element = self.go_to_element(header, name)?;
        let mut state = reserve(element.count);
        self.next_rows(element, |row| visit(&mut state, row))?;
        Ok(state)
    }

    /// Seeks to the rows of the first table.
    pub(crate) fn rewind(&mut self) -> Result<(), Fault> {
        self.go_to(self.start)
    }

    /// Calls `visit` with each row of `element`, the next table in the file.
    pub(crate) fn next_rows(
        &mut self,
        element: &Element,
        mut visit: impl FnMut(&Row) -> Result<(), Fault>,
    ) -> Result<(), Fault> {
        self.check_fits(element)?;
        let mut row = Row::default();
        (0..element.count).try_for_each(|_| {
            self.row(element, &mut row)?;
            visit(&row)
        })
    }

    /// Skips the rows of `element`, the next table in the file.
    pub(crate) fn pass(&mut self, element: &Element) -> Result<(), Fault> {
        self.check_fits(element)?;
        if self.is_fixed(element) {
            // Cannot overflow or exceed the end of the file, as checked by `check_fits`.
            return self.go_to(self.offset + (element.count * element.stride) as u64);
        }
        let mut row = Row::default();
        (0..element.count).try_for_each(|_| self.row(element, &mut row))
    }

    /// Same as [`Self::rows`], without lists and in blocks: `visit` gets the scalars of consecutive rows, packed, to be
    /// accessed by [`Column`].
    pub(in crate::format::ply) fn blocks<S: Send>(
        &mut self,
        header: &Header,
        name: &str,
        reserve: impl FnOnce(usize) -> S,
        mut visit: impl FnMut(&mut S, std::slice::ChunksExact<'_, u8>) -> Result<(), Fault> + Send,
    ) -> Result<S, Fault>
    where
        R: Send,
    {
        let element = self.go_to_element(header, name)?;
        let mut state = reserve(element.count);
        let per_block = (BLOCK_BYTES / element.stride.max(1)).max(1);
        in_blocks(
            element.count,
            per_block,
            |rows, bytes| self.fill(element, rows, bytes),
            |_, bytes| visit(&mut state, bytes.chunks_exact(element.stride.max(1))),
        )?;
        Ok(state)
    }

    fn go_to_element<'h>(&mut self, header: &'h Header, name: &str) -> Result<&'h Element, Fault> {
        self.rewind()?;
        for element in &header.elements {
            if element.name == name {
                // Allocation for the rows relies on this check.
                self.check_fits(element)?;
                return Ok(element);
            }
            self.pass(element)?;
        }
        header.required(name)
    }

    /// Places `fault`, if it is that of an element `i`, at the byte where row `row_of(i)` of the table called `name`
    /// begins.
    pub(in crate::format::ply) fn locate(
        &mut self,
        header: &Header,
        name: &str,
        row_of: impl Fn(usize) -> usize,
        fault: Fault,
    ) -> Fault {
        fault.of_element(|i| Location::Byte(self.row_start(header, name, row_of(i)).unwrap_or(self.start)))
    }

    fn row_start(&mut self, header: &Header, name: &str, row: usize) -> Result<u64, Fault> {
        let element = self.go_to_element(header, name)?;
        if self.is_fixed(element) {
            return Ok(self.offset + (row * element.stride) as u64);
        }
        let mut passed = Row::default();
        (0..row).try_for_each(|_| self.row(element, &mut passed))?;
        if self.encoding == Encoding::Ascii { self.next_token() } else { Ok(self.offset) }
    }

    fn go_to(&mut self, offset: u64) -> Result<(), Fault> {
        self.reader.seek(SeekFrom::Start(offset)).map_err(|e| Fault::unreadable(offset, &e))?;
        self.offset = offset;
        Ok(())
    }

    /// Checks that the declared rows fit into the rest of the file.
    fn check_fits(&self, element: &Element) -> Result<(), Fault> {
        let least_row: usize = match self.encoding {
            // A digit and a separator each.
            Encoding::Ascii => 2 * element.properties.len(),
            _ => element.properties.iter().map(|p| p.list_length.unwrap_or(p.kind).bytes()).sum(),
        };
        // The last separator of the file may be missing.
        let left = self.length - self.offset + u64::from(self.encoding == Encoding::Ascii);
        let fits = element.count == 0
            || (least_row > 0 && element.count.checked_mul(least_row).is_some_and(|needed| needed as u64 <= left));
        if fits {
            return Ok(());
        }
        Err(Fault::byte(
            self.offset as usize,
            format!("{} rows of `{}` of at least {least_row} bytes", element.count, element.name),
            format!("{left} bytes"),
        ))
    }

    /// Whether all rows have the same length of [`Element::stride`] bytes.
    fn is_fixed(&self, element: &Element) -> bool {
        self.encoding != Encoding::Ascii && element.properties.iter().all(|p| p.list_length.is_none())
    }

    /// Replaces `bytes` by the scalars of the next `rows` rows, little endian.
    fn fill(&mut self, element: &Element, rows: usize, bytes: &mut Vec<u8>) -> Result<(), Fault> {
        if self.is_fixed(element) {
            bytes.resize(rows * element.stride, 0);
            self.reader.read_exact(bytes).map_err(|e| Fault::unreadable(self.offset, &e))?;
            self.offset += bytes.len() as u64;
            if self.encoding == Encoding::Big {
                for row in bytes.chunks_exact_mut(element.stride.max(1)) {
                    let columns = element.properties.iter().map(|p| p.column);
                    columns.for_each(|c| row[c.offset..c.offset + c.kind.bytes()].reverse());
                }
            }
            return Ok(());
        }
        bytes.clear();
        let mut row = Row::default();
        for _ in 0..rows {
            self.row(element, &mut row)?;
            let scalars = element.properties.iter().zip(&row.values).filter(|(p, _)| p.list_length.is_none());
            scalars.for_each(|(p, &value)| p.column.kind.encode(value, bytes));
        }
        Ok(())
    }

    fn row(&mut self, element: &Element, row: &mut Row) -> Result<(), Fault> {
        row.values.clear();
        row.at = self.offset as usize;
        row.lists.resize(element.properties.len(), vec![]);
        for (property, list) in element.properties.iter().zip(&mut row.lists) {
            let Some(length_kind) = property.list_length else {
                row.values.push(self.scalar(property.kind)?);
                continue;
            };
            let at = self.offset as usize;
            let length = self.scalar(length_kind)?;
            if !(length >= 0.0 && length <= (self.length - self.offset) as f64 && length.fract() == 0.0) {
                return Err(Fault::byte(at, "a list length that fits into the file", length.to_string()));
            }
            list.clear();
            for _ in 0..length as usize {
                list.push(self.scalar(property.kind)?);
            }
            row.values.push(f64::NAN);
        }
        Ok(())
    }

    fn scalar(&mut self, kind: Scalar) -> Result<f64, Fault> {
        if self.encoding == Encoding::Ascii {
            let at = self.next_token()?;
            let token = std::str::from_utf8(&self.token).ok().filter(|t| t.len() < MAX_TOKEN);
            let number = token.and_then(|t| t.parse().ok());
            return number.ok_or_else(|| Fault::byte(at as usize, "a number", shown(&self.token)));
        }
        let size = kind.bytes();
        let mut bytes = [0; 8];
        if self.length - self.offset < size as u64 {
            return Err(Fault::byte(self.offset as usize, format!("{size} more bytes"), "the end of the file"));
        }
        self.reader.read_exact(&mut bytes[..size]).map_err(|e| Fault::unreadable(self.offset, &e))?;
        if self.encoding == Encoding::Big {
            bytes[..size].reverse();
        }
        self.offset += size as u64;
        Ok(Column { offset: 0, kind }.f64(&bytes))
    }

    /// Reads the next word into `token`, of which at most [`MAX_TOKEN`] bytes are kept; empty at the end of the file.
    /// Returns the word's offset.
    fn next_token(&mut self) -> Result<u64, Fault> {
        self.token.clear();
        let mut at = self.offset;
        loop {
            let unread = self.reader.fill_buf().map_err(|e| Fault::unreadable(at, &e))?;
            if unread.is_empty() {
                return Ok(at);
            }
            let mut start = 0;
            if self.token.is_empty() {
                start = unread.iter().position(|b| !b.is_ascii_whitespace()).unwrap_or(unread.len());
                at = self.offset + start as u64;
            }
            let end = unread[start..].iter().position(u8::is_ascii_whitespace);
            let word = &unread[start..end.map_or(unread.len(), |end| start + end)];
            self.token.extend(word.iter().take(MAX_TOKEN - self.token.len()));
            let read = start + word.len();
            self.reader.consume(read);
            self.offset += read as u64;
            if end.is_some() {
                return Ok(at);
            }
        }
    }
}
