use std::fs::File;
use std::io::{self, BufWriter, Write as _};
use std::path::Path;

use super::FormatError;

/// Writes `bytes` to `path` by way of a temporary file in the same folder, so that `path` holds either its former
/// content or all of the new one.
///
/// # Errors
/// If the folder does not exist or cannot be written to.
pub fn atomic_write(path: &Path, bytes: &[u8]) -> Result<(), FormatError> {
    atomic_write_with(path, |out| out.write_all(bytes)).map(drop)
}

/// As [`atomic_write`], for content that is produced piecemeal. Returns the number of bytes written.
///
/// # Errors
/// If the folder does not exist or cannot be written to, or `produce` fails.
pub fn atomic_write_with(
    path: &Path,
    produce: impl FnOnce(&mut BufWriter<&mut File>) -> io::Result<()>,
) -> Result<u64, FormatError> {
    write(path, produce).map_err(|source| FormatError::Write { file: path.to_owned(), source })
}

fn write(path: &Path, produce: impl FnOnce(&mut BufWriter<&mut File>) -> io::Result<()>) -> io::Result<u64> {
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

    #[test]
    fn a_failed_write_leaves_the_old_file_and_nothing_else() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.bin");
        atomic_write(&path, b"old").unwrap();
        let failed = atomic_write_with(&path, |out| {
            out.write_all(b"half of the new")?;
            Err(io::Error::other("disk full"))
        });
        assert_eq!(failed.unwrap_err().to_string(), format!("{}: cannot write: disk full", path.display()));
        assert_eq!(std::fs::read(&path).unwrap(), b"old");
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);

        assert_eq!(atomic_write_with(&path, |out| out.write_all(b"newer")).unwrap(), 5);
        assert_eq!(std::fs::read(&path).unwrap(), b"newer");
        assert!(atomic_write(&folder.path().join("none/a.bin"), b"").is_err());
        assert!(atomic_write(folder.path(), b"").is_err());
    }
}
