//! Zip files that are written.

use std::io::{self, Seek, SeekFrom, Write};

use zip::ZipWriter;

/// Writes the members that `fill` adds, and the end.
///
/// # Errors
/// Those of `fill` and of `out`, the first.
pub(super) fn write_zip<W: Write + Seek>(
    out: W,
    fill: impl FnOnce(&mut ZipWriter<UntilError<W>>) -> io::Result<()>,
) -> io::Result<()> {
    let mut zip = ZipWriter::new(UntilError { out, has_failed: false });
    fill(&mut zip)?;
    zip.finish()?;
    Ok(())
}

/// Takes and drops everything after its first error: a zip that is dropped writes its end, and says on stderr that it cannot.
pub(super) struct UntilError<W> {
    out: W,
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
        self.attempt(bytes.len(), |out| out.write(bytes))
    }

    fn flush(&mut self) -> io::Result<()> {
        self.attempt((), Write::flush)
    }
}

impl<W: Seek> Seek for UntilError<W> {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        self.attempt(0, |out| out.seek(to))
    }
}

#[cfg(test)]
mod tests {
    use zip::write::SimpleFileOptions;

    use super::*;

    /// Full after so many bytes; counts the calls after that.
    struct Disk {
        left: usize,
        calls: usize,
    }

    impl Write for &mut Disk {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            self.left = self.left.checked_sub(bytes.len()).ok_or_else(|| {
                self.calls += 1;
                io::Error::from(io::ErrorKind::StorageFull)
            })?;
            Ok(bytes.len())
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    impl Seek for &mut Disk {
        fn seek(&mut self, _: SeekFrom) -> io::Result<u64> {
            Ok(0)
        }
    }

    #[test]
    fn a_disk_that_is_full_hears_nothing_more() {
        for left in [0, 20, 60, 1000, 1060] {
            let mut disk = Disk { left, calls: 0 };
            let filled = write_zip(&mut disk, |zip| {
                zip.start_file("a", SimpleFileOptions::default().compression_method(zip::CompressionMethod::Stored))?;
                zip.write_all(&[7; 1000])
            });
            assert_eq!(filled.unwrap_err().kind(), io::ErrorKind::StorageFull, "{left}");
            assert_eq!(disk.calls, 1, "{left}");
        }
        let mut disk = Disk { left: 1 << 20, calls: 0 };
        write_zip(&mut disk, |_| Ok(())).unwrap();
    }
}
