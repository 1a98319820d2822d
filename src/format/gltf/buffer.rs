//! Content of buffers: in memory, or left in the file until it is asked for, so that a large scene is not held twice.

use std::borrow::Cow;
use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom, Write};
use std::ops::Range;
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};

use crate::format::blocks::BLOCK_BYTES;

/// The bytes of a glTF buffer.
#[derive(Clone, Debug)]
pub(in crate::format) enum Buffer {
    Memory(Vec<u8>),
    /// So many bytes of an open file from `start` on.
    File {
        file: Arc<Mutex<File>>,
        start: u64,
        length: usize,
    },
}

impl Buffer {
    /// A whole file.
    pub(super) fn open(path: &Path) -> io::Result<Self> {
        let file = File::open(path)?;
        let length = usize::try_from(file.metadata()?.len()).map_err(io::Error::other)?;
        Ok(Self::File { file: Arc::new(Mutex::new(file)), start: 0, length })
    }

    pub(super) fn len(&self) -> usize {
        match self {
            Self::Memory(bytes) => bytes.len(),
            Self::File { length, .. } => *length,
        }
    }

    pub(super) fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The bytes of a range, cut where it ends behind them.
    pub(super) fn read(&self, range: Range<usize>) -> io::Result<Cow<'_, [u8]>> {
        let end = range.end.min(self.len());
        let range = range.start.min(end)..end;
        match self {
            Self::Memory(bytes) => Ok(Cow::Borrowed(&bytes[range])),
            Self::File { file, start, .. } => {
                let mut bytes = vec![0; range.len()];
                // A thread that panicked has left the file where it does not matter.
                let mut file = file.lock().unwrap_or_else(PoisonError::into_inner);
                file.seek(SeekFrom::Start(start + range.start as u64))?;
                file.read_exact(&mut bytes)?;
                Ok(Cow::Owned(bytes))
            }
        }
    }

    /// The same in memory.
    pub(super) fn loaded(self) -> io::Result<Self> {
        Ok(match self {
            Self::Memory(bytes) => Self::Memory(bytes),
            Self::File { length, .. } => Self::Memory(self.read(0..length)?.into_owned()),
        })
    }

    /// Writes the first `length` bytes.
    pub(super) fn copy(&self, length: usize, out: &mut impl Write) -> io::Result<()> {
        (0..length).step_by(BLOCK_BYTES).try_for_each(|at| out.write_all(&self.read(at..length.min(at + BLOCK_BYTES))?))
    }
}

impl From<Vec<u8>> for Buffer {
    fn from(bytes: Vec<u8>) -> Self {
        Self::Memory(bytes)
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
        let Buffer::File { file, length, .. } = Buffer::open(&path).unwrap() else { panic!("not left in the file") };
        let file = Buffer::File { file, start: 3, length: length - 3 };
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
        assert!(matches!(file.loaded().unwrap(), Buffer::Memory(loaded) if loaded == bytes[3..]));
        // What has become shorter under our hands is an error.
        let open = Buffer::open(&path).unwrap();
        std::fs::write(&path, [1, 2, 3]).unwrap();
        assert!(open.read(0..9).is_err());
    }
}
