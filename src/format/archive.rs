//! Writing of zip files.

use std::io::{self, Seek, SeekFrom, Write};

use zip::ZipWriter;

/// Writes the members that `fill` adds, and the end of the archive.
///
/// # Errors
/// The first error of `fill` or `out`.
pub(super) fn write_zip<W: Write + Seek>(
    out: W,
    fill: impl FnOnce(&mut ZipWriter<UntilError<W>>) -> io::Result<()>,
) -> io::Result<()> {
    let mut zip = ZipWriter::new(UntilError { out, at: 0, has_failed: false });
    fill(&mut zip)?;
    zip.finish()?;
    Ok(())
}

/// Writer that discards everything after its first error: a dropped `ZipWriter` would write the archive's end and
/// report its failure on stderr.
pub(super) struct UntilError<W> {
    out: W,
    /// Actual or, after an error, assumed position: a `ZipWriter` subtracts positions.
    at: u64,
    has_failed: bool,
}

impl<W> UntilError<W> {
    fn attempt<T>(&mut self, instead: T, what: impl FnOnce(&mut W) -> io::Result<T>) -> io::Result<T> {
        if self.has_failed {
            return Ok(instead);
        }
        let result = what(&mut self.out);
        self.has_failed = result.as_ref().is_err_and(|e| e.kind() != io::ErrorKind::Interrupted);
        result
    }
}

impl<W: Write> Write for UntilError<W> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let written = self.attempt(bytes.len(), |out| out.write(bytes))?;
        self.at += written as u64;
        Ok(written)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.attempt((), Write::flush)
    }
}

impl<W: Seek> Seek for UntilError<W> {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        let instead = match to {
            SeekFrom::Start(at) => at,
            SeekFrom::Current(by) => self.at.saturating_add_signed(by),
            SeekFrom::End(_) => self.at,
        };
        self.at = self.attempt(instead, |out| out.seek(to))?;
        Ok(self.at)
    }
}

#[cfg(test)]
mod tests {
    use zip::write::SimpleFileOptions;

    use super::*;

    /// A disk that is full after this many bytes; counts the calls after that.
    struct Disk {
        left: usize,
        at: u64,
        calls: usize,
    }

    impl Write for &mut Disk {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            self.left = self.left.checked_sub(bytes.len()).ok_or_else(|| {
                self.calls += 1;
                io::Error::from(io::ErrorKind::StorageFull)
            })?;
            self.at += bytes.len() as u64;
            Ok(bytes.len())
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    impl Seek for &mut Disk {
        fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
            if let SeekFrom::Start(at) = to {
                self.at = at;
            }
            Ok(self.at)
        }
    }

    #[test]
    fn a_disk_that_is_full_hears_nothing_more() {
        for left in [0, 20, 60, 1000, 1060] {
            let mut disk = Disk { left, at: 0, calls: 0 };
            let filled = write_zip(&mut disk, |zip| {
                zip.start_file("a", SimpleFileOptions::default().compression_method(zip::CompressionMethod::Stored))?;
                zip.write_all(&[7; 1000])
            });
            assert_eq!(filled.unwrap_err().kind(), io::ErrorKind::StorageFull, "{left}");
            assert_eq!(disk.calls, 1, "{left}");
        }
        let mut disk = Disk { left: 1 << 20, at: 0, calls: 0 };
        write_zip(&mut disk, |_| Ok(())).unwrap();
    }
}
