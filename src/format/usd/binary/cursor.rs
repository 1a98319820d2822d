//! Sequential reading of a crate file's bytes.

use super::compression::integers_32;
use crate::format::error::Fault;

/// Position in the file.
#[derive(Clone)]
pub(super) struct Cursor<'a> {
    file: &'a [u8],
    at: usize,
}

impl<'a> Cursor<'a> {
    pub(super) fn new(file: &'a [u8], at: u64) -> Result<Self, Fault> {
        match usize::try_from(at).ok().filter(|&at| at <= file.len()) {
            Some(at) => Ok(Self { file, at }),
            None => Err(Fault::whole(format!("offsets within {} bytes", file.len()), at.to_string())),
        }
    }

    pub(super) fn at(&self) -> usize {
        self.at
    }

    pub(super) fn fault(&self, expected: impl Into<String>, found: impl Into<String>) -> Fault {
        Fault::byte(self.at, expected, found)
    }

    pub(super) fn take(&mut self, length: usize) -> Result<&'a [u8], Fault> {
        let rest = &self.file[self.at..];
        let Some(bytes) = rest.get(..length) else {
            return Err(self.fault(format!("{length} bytes"), format!("{} to the end of the file", rest.len())));
        };
        self.at += length;
        Ok(bytes)
    }

    pub(super) fn chunk<const N: usize>(&mut self) -> Result<&'a [u8; N], Fault> {
        let bytes = self.take(N)?;
        Ok(bytes.first_chunk().expect("as many bytes as were asked for"))
    }

    pub(super) fn u32(&mut self) -> Result<u32, Fault> {
        Ok(u32::from_le_bytes(*self.chunk()?))
    }

    pub(super) fn u64(&mut self) -> Result<u64, Fault> {
        Ok(u64::from_le_bytes(*self.chunk()?))
    }

    /// Reads a count of elements that take at least `least` bytes each.
    pub(super) fn count(&mut self, least: usize) -> Result<usize, Fault> {
        let count = self.u64()?;
        let most = (self.file.len() - self.at) / least;
        usize::try_from(count)
            .ok()
            .filter(|&c| c <= most)
            .ok_or_else(|| self.fault(format!("a count of {most} or less"), count.to_string()))
    }

    /// Reads the length of an array, which older versions write in fewer bytes.
    pub(super) fn array_count(&mut self, version: [u8; 2]) -> Result<usize, Fault> {
        if version < [0, 5] {
            self.chunk::<4>()?;
        }
        let count = if version < [0, 7] { u64::from(u32::from_le_bytes(*self.chunk()?)) } else { self.u64()? };
        usize::try_from(count).map_err(|_| self.fault("the length of an array", count.to_string()))
    }

    pub(super) fn indices(&mut self, count: usize) -> Result<Vec<u32>, Fault> {
        let bytes = self.take(count.saturating_mul(4))?;
        Ok(bytes.as_chunks().0.iter().map(|b| u32::from_le_bytes(*b)).collect())
    }

    /// Reads a compressed piece that represents `count` integers.
    pub(super) fn piece(&mut self, count: usize) -> Result<&'a [u8], Fault> {
        let size = self.count(1)?;
        // A byte decompresses to at most 255 bytes, each of which represents four integers.
        if count / 1020 > size {
            return Err(self.fault(format!("at most {} integers", size * 1020), count.to_string()));
        }
        self.take(size)
    }

    pub(super) fn integers(&mut self, count: usize) -> Result<Vec<i32>, Fault> {
        let piece = self.piece(count)?;
        integers_32(piece, count).ok_or_else(|| self.fault(format!("{count} compressed integers"), "something else"))
    }

    /// Reads an offset and moves there; it is relative to its own position.
    pub(super) fn follow(&mut self) -> Result<(), Fault> {
        let start = self.at as u64;
        let offset = self.u64()?;
        let target = Self::new(self.file, start.wrapping_add(offset));
        *self = target.map_err(|fault| fault.or_at_byte(start as usize))?;
        Ok(())
    }

    /// Reads the items that a list edit sets or adds, in the order of the list that it makes.
    pub(super) fn list_op(&mut self) -> Result<Vec<u32>, Fault> {
        self.list_op_of(4, Self::u32)
    }

    /// Same as [`Self::list_op`], for items of at least `least` bytes.
    pub(super) fn list_op_of<T>(
        &mut self,
        least: usize,
        one: impl Fn(&mut Self) -> Result<T, Fault>,
    ) -> Result<Vec<T>, Fault> {
        let [flags] = *self.chunk()?;
        let mut lists: [Vec<T>; 4] = Default::default();
        // Deleted and ordered items follow, which are not read.
        for (flag, items) in [1, 2, 5, 6].into_iter().zip(&mut lists) {
            if flags >> flag & 1 == 1 {
                for _ in 0..self.count(least)? {
                    items.push(one(self)?);
                }
            }
        }
        let [explicit, added, prepended, appended] = lists;
        Ok(explicit.into_iter().chain(prepended).chain(added).chain(appended).collect())
    }
}
