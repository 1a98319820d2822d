//! Buffer content: in memory, or left in the file until needed, so that a large scene is not held twice.

use std::borrow::Cow;
use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom, Write};
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::SystemTime;

use crate::format::FormatError;
use crate::format::blocks::BLOCK_BYTES;

/// The bytes of a glTF buffer.
#[derive(Clone, Debug)]
pub(in crate::format) enum Buffer {
    Memory(Arc<Vec<u8>>),
    /// Bytes of an open file, of this length, from `start` on.
    File {
        input: Arc<Input>,
        start: u64,
        length: usize,
    },
}

/// Open file, with its state when it was opened.
#[derive(Debug)]
pub(in crate::format) struct Input {
    path: PathBuf,
    file: Mutex<File>,
    length: u64,
    modified: Option<SystemTime>,
}

/// Error of reading an input; wrapped in the [`io::Error`]s of [`Buffer::read`].
#[derive(Debug, thiserror::Error)]
#[error("{}: {source}", path.display())]
struct Unreadable {
    path: PathBuf,
    source: io::Error,
}

/// Error of writing `file` from buffers; if a buffer could not be read, its file is named instead.
pub(super) fn of_writing(error: FormatError) -> FormatError {
    match error {
        FormatError::Write { file, source } => match source.downcast::<Unreadable>() {
            Ok(Unreadable { path, source }) => FormatError::Read { file: path, source },
            Err(source) => FormatError::Write { file, source },
        },
        other => other,
    }
}

impl Input {
    pub(super) fn open(path: &Path) -> io::Result<Self> {
        let file = File::open(path)?;
        let metadata = file.metadata()?;
        let (length, modified) = (metadata.len(), metadata.modified().ok());
        Ok(Self { path: path.to_owned(), file: Mutex::new(file), length, modified })
    }

    /// File handle for exclusive use.
    pub(super) fn file(&mut self) -> &mut File {
        self.file.get_mut().unwrap_or_else(PoisonError::into_inner)
    }

    /// Buffer of a range of the file, which must lie within it.
    pub(super) fn section(self, range: Range<usize>) -> Buffer {
        Buffer::File { input: Arc::new(self), start: range.start as u64, length: range.len() }
    }

    /// Reads bytes from `start` on; an error if the file has been modified since it was opened.
    fn read(&self, start: u64, bytes: &mut [u8]) -> io::Result<()> {
        // A panic in another thread cannot leave the file in a harmful state, because every read seeks first.
        let mut file = self.file.lock().unwrap_or_else(PoisonError::into_inner);
        let read = file.seek(SeekFrom::Start(start)).and_then(|_| file.read_exact(bytes));
        let now = file.metadata()?;
        if (now.len(), now.modified().ok()) != (self.length, self.modified) {
            return Err(io::Error::other("it was changed while it was in use"));
        }
        read
    }
}

impl Buffer {
    /// Opens a whole file. Small files are read now: a document may name more files than can be open at once (256 on
    /// macOS).
    pub(super) fn open(path: &Path) -> io::Result<Self> {
        let input = Input::open(path)?;
        let length = usize::try_from(input.length).map_err(io::Error::other)?;
        let file = input.section(0..length);
        if length <= BLOCK_BYTES { Ok(file.into_bytes()?.into()) } else { Ok(file) }
    }

    pub(super) fn len(&self) -> usize {
        match self {
            Self::Memory(bytes) => bytes.len(),
            Self::File { length, .. } => *length,
        }
    }

    /// Identity of the storage: buffers that share their bytes have the same place.
    pub(super) fn place(&self) -> (usize, u64) {
        match self {
            Self::Memory(bytes) => (Arc::as_ptr(bytes).addr(), 0),
            Self::File { input, start, .. } => (Arc::as_ptr(input).addr(), *start),
        }
    }

    pub(super) fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Reads the bytes of a range, cut off at the buffer's end.
    pub(super) fn read(&self, range: Range<usize>) -> io::Result<Cow<'_, [u8]>> {
        let end = range.end.min(self.len());
        let range = range.start.min(end)..end;
        match self {
            Self::Memory(bytes) => Ok(Cow::Borrowed(&bytes[range])),
            Self::File { input, start, .. } => {
                let mut bytes = vec![0; range.len()];
                let read = input.read(start + range.start as u64, &mut bytes);
                read.map_err(|source| io::Error::other(Unreadable { path: input.path.clone(), source }))?;
                Ok(Cow::Owned(bytes))
            }
        }
    }

    /// Loads the whole buffer into memory.
    pub(super) fn into_bytes(self) -> io::Result<Vec<u8>> {
        match self {
            Self::Memory(bytes) => Ok(Arc::unwrap_or_clone(bytes)),
            Self::File { length, .. } => Ok(self.read(0..length)?.into_owned()),
        }
    }

    /// Writes the first `length` bytes.
    pub(super) fn copy(&self, length: usize, out: &mut impl Write) -> io::Result<()> {
        (0..length).step_by(BLOCK_BYTES).try_for_each(|at| out.write_all(&self.read(at..length.min(at + BLOCK_BYTES))?))
    }
}

impl From<Vec<u8>> for Buffer {
    fn from(bytes: Vec<u8>) -> Self {
        Self::Memory(Arc::new(bytes))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_read_as_memory_does() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("b.bin");
        let bytes: Vec<u8> = (0..=255).cycle().take(BLOCK_BYTES + 77).collect();
        std::fs::write(&path, &bytes).unwrap();
        let memory = Buffer::from(bytes[3..].to_vec());
        let file = Input::open(&path).unwrap().section(3..bytes.len());
        assert_eq!(file.len(), memory.len());
        for range in [0..5, 100..100, BLOCK_BYTES..usize::MAX, 5_000_000..6_000_000] {
            assert_eq!(file.read(range.clone()).unwrap(), memory.read(range).unwrap());
        }
        for length in [0, 9, file.len()] {
            let (mut a, mut b) = (vec![], vec![]);
            file.copy(length, &mut a).unwrap();
            memory.copy(length, &mut b).unwrap();
            assert!(a == b && a == bytes[3..3 + length]);
        }
        assert!(file.into_bytes().unwrap() == bytes[3..]);
    }

    #[test]
    fn a_file_that_changes_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("b.bin");
        let at = |seconds| SystemTime::UNIX_EPOCH + std::time::Duration::from_secs(seconds);
        let write = |bytes: &[u8], seconds: u64| {
            std::fs::write(&path, bytes).unwrap();
            File::options().write(true).open(&path).unwrap().set_modified(at(seconds)).unwrap();
        };
        let expected = format!("{}: it was changed while it was in use", path.display());
        // Too long to be read in one block.
        let long = |value: u8, more: usize| vec![value; BLOCK_BYTES + more];
        // Replaced by content that is shorter, longer, and of the same length.
        for bytes in [&[1, 2, 3][..], &long(0, 12), &long(2, 9)] {
            write(&long(1, 9), 100);
            let open = Buffer::open(&path).unwrap();
            assert_eq!(open.read(0..9).unwrap(), [1; 9].as_slice());
            write(bytes, 200);
            let error = open.read(0..2).unwrap_err();
            assert_eq!(error.to_string(), expected);
            let file = folder.path().join("out.glb");
            let error = of_writing(FormatError::Write { file, source: error }).to_string();
            assert_eq!(error, expected.replace("b.bin: ", "b.bin: cannot read: "));
        }
        // A file that replaces it by renaming does not affect the open one.
        for bytes in [&long(1, 9)[..], &[1; 9]] {
            write(bytes, 100);
            let open = Buffer::open(&path).unwrap();
            std::fs::write(folder.path().join("new"), [3]).unwrap();
            std::fs::rename(folder.path().join("new"), &path).unwrap();
            assert_eq!(open.read(0..9).unwrap(), [1; 9].as_slice());
        }
    }
}
