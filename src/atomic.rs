//! Files that are written whole or not at all.

use std::fs::File;
use std::io::{self, BufWriter, Write as _};
use std::path::Path;

/// Writes to `path` what `produce` makes, by way of a temporary file in the same folder, so that `path` holds either its former content or
/// all of the new one. Returns the number of bytes written.
///
/// # Errors
/// If the folder does not exist or cannot be written to, or `produce` fails.
pub(crate) fn write_with(
    path: &Path,
    produce: impl FnOnce(&mut BufWriter<&mut File>) -> io::Result<()>,
) -> io::Result<u64> {
    let folder = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    if path.is_dir() {
        return Err(io::Error::new(io::ErrorKind::IsADirectory, "a folder of this name exists"));
    }
    let mut builder = tempfile::Builder::new();
    builder.prefix(".centaur-");
    // Temporary files are private by default; a result is as readable as the umask allows, like any other file.
    #[cfg(unix)]
    builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666));
    let mut temporary = builder.tempfile_in(folder)?;
    let mut out = BufWriter::with_capacity(1 << 20, temporary.as_file_mut());
    produce(&mut out)?;
    out.flush()?;
    drop(out);
    let bytes = temporary.as_file().metadata()?.len();
    temporary.persist(path).map_err(|e| e.error)?;
    Ok(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn write(path: &Path, bytes: &[u8]) -> io::Result<u64> {
        write_with(path, |out| out.write_all(bytes))
    }

    #[test]
    fn a_failed_write_leaves_the_old_file_and_nothing_else() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.bin");
        write(&path, b"old").unwrap();
        let failed = write_with(&path, |out| {
            out.write_all(b"half of the new")?;
            Err(io::Error::other("disk full"))
        });
        assert_eq!(failed.unwrap_err().to_string(), "disk full");
        assert_eq!(std::fs::read(&path).unwrap(), b"old");
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);

        assert_eq!(write(&path, b"newer").unwrap(), 5);
        assert_eq!(std::fs::read(&path).unwrap(), b"newer");
        assert!(write(&folder.path().join("none/a.bin"), b"").is_err());
        assert!(write(folder.path(), b"").is_err());
    }
}
