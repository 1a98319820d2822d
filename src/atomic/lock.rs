//! Locks of files, by which processes leave each other's work alone.

use std::fs::{self, File, OpenOptions, TryLockError};
use std::io;
use std::path::Path;

use super::{Listed, list};

/// Number of attempts to lock a file that is removed between opening and locking. The last one counts in any case: there
/// are file systems that number a file anew each time.
const MOST_TRIES: usize = 16;

/// Lock of a file, which one process at a time can hold. It ends with its process, however that ends: a file that a
/// killed process left behind keeps nobody out.
#[derive(Debug)]
pub struct Lock {
    file: File,
    excludes: bool,
}

impl Lock {
    /// Locks the file at `path`, and creates it if there is none; `None` if another process holds the lock.
    ///
    /// # Errors
    /// If the file cannot be made or opened, or not be locked although its file system has locks.
    pub fn take(path: &Path) -> io::Result<Option<Self>> {
        let mut more = 1..MOST_TRIES;
        loop {
            // Not truncated, because the file may be another process's.
            let file = OpenOptions::new().read(true).write(true).create(true).truncate(false).open(path);
            let file = or_readable(file, path)?;
            let excludes = match file.try_lock() {
                Ok(()) => true,
                Err(TryLockError::WouldBlock) => return Ok(None),
                Err(TryLockError::Error(e)) if are_unknown(&e) => false,
                Err(TryLockError::Error(e)) => return Err(e),
            };
            // A former holder may have removed the file since it was opened here: others would lock a new one.
            if is_at(&file, path) || more.next().is_none() {
                return Ok(Some(Self { file, excludes }));
            }
        }
    }

    /// The locked file, open at its beginning for reading and, unless it is another user's that is read-only here, for
    /// writing. On Windows it can be read through this handle alone.
    #[must_use]
    pub fn file(&self) -> &File {
        &self.file
    }

    /// Whether other processes are kept out; they are not where the file system has no locks.
    #[must_use]
    pub fn excludes(&self) -> bool {
        self.excludes
    }
}

/// [`Lock`] whose file is removed with it: on drop, and by [`abandon_all`](super::abandon_all).
pub struct LockFile {
    listed: Listed,
    // Released last.
    lock: Lock,
}

impl LockFile {
    /// Same as [`Lock::take`].
    ///
    /// # Errors
    /// As [`Lock::take`].
    pub fn take(path: &Path) -> io::Result<Option<Self>> {
        // A signal in between would leave the file behind.
        let mut list = list();
        let lock = Lock::take(path)?;
        Ok(lock.map(|lock| {
            list.insert(path.to_owned(), None);
            Self { listed: Listed(path.to_owned()), lock }
        }))
    }

    /// Same as [`Lock::excludes`].
    #[must_use]
    pub fn excludes(&self) -> bool {
        self.lock.excludes()
    }
}

impl Drop for LockFile {
    fn drop(&mut self) {
        // `abandon_all` removes what is listed: in between the file could have become another process's.
        let mut list = list();
        // The lock is still held, so the file is no other process's.
        let _ = fs::remove_file(&self.listed.0);
        list.remove(&self.listed.0);
    }
}

/// The file at `path`, `opened` for writing or, where that is denied, as of another user's file, for reading, which is
/// enough to lock it.
fn or_readable(opened: io::Result<File>, path: &Path) -> io::Result<File> {
    match opened {
        Err(denied) if denied.kind() == io::ErrorKind::PermissionDenied => File::open(path).map_err(|_| denied),
        done => done,
    }
}

/// Whether the file at `path` is this one.
#[cfg(unix)]
fn is_at(file: &File, path: &Path) -> bool {
    use std::os::unix::fs::MetadataExt as _;
    let place = |of: io::Result<fs::Metadata>| of.ok().map(|of| (of.dev(), of.ino()));
    place(fs::metadata(path)).is_some_and(|there| place(file.metadata()) == Some(there))
}

/// Whether there is a file at `path`, which is taken to be this one.
#[cfg(not(unix))]
fn is_at(_: &File, path: &Path) -> bool {
    path.exists()
}

/// Whether a failure to lock says that the file system has no locks: ENOLCK does, of NFS without a daemon for them.
fn are_unknown(error: &io::Error) -> bool {
    const ENOLCK: i32 = if cfg!(target_os = "linux") { 37 } else { 77 };
    const ENOTSUP: i32 = 45;
    error.kind() == io::ErrorKind::Unsupported
        || cfg!(unix) && error.raw_os_error() == Some(ENOLCK)
        || cfg!(target_vendor = "apple") && error.raw_os_error() == Some(ENOTSUP)
}

#[cfg(test)]
mod tests {
    use std::thread;
    use std::time::Duration;

    use super::*;

    #[test]
    fn one_at_a_time_holds_a_lock_and_its_file_goes_with_it() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.lock");
        // Of a process that was killed.
        fs::write(&path, "left").unwrap();
        let held = Lock::take(&path).unwrap().unwrap();
        assert!(held.excludes());
        assert!(Lock::take(&path).unwrap().is_none() && LockFile::take(&path).unwrap().is_none());
        drop(held);
        assert_eq!(fs::read(&path).unwrap(), b"left");
        let held = LockFile::take(&path).unwrap().unwrap();
        assert!(held.excludes());
        assert_eq!(list().get(&path), Some(&None));
        assert!(Lock::take(&path).unwrap().is_none() && path.exists());
        drop(held);
        assert!(!path.exists() && !list().contains_key(&path));
    }

    /// Tests may run as a user to whom nothing is denied.
    #[test]
    fn a_file_that_can_only_be_read_can_be_locked() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.lock");
        let failed = |kind: io::ErrorKind| or_readable(Err(kind.into()), &path);
        let denied = io::ErrorKind::PermissionDenied;
        assert_eq!(failed(denied).unwrap_err().kind(), denied, "there is no file");
        fs::write(&path, "left").unwrap();
        assert_eq!(failed(io::ErrorKind::StorageFull).unwrap_err().kind(), io::ErrorKind::StorageFull);
        let file = failed(denied).unwrap();
        file.try_lock().unwrap();
        assert!(Lock::take(&path).unwrap().is_none());
        drop(file);
        let mut permissions = fs::metadata(&path).unwrap().permissions();
        permissions.set_readonly(true);
        fs::set_permissions(&path, permissions).unwrap();
        assert!(Lock::take(&path).unwrap().is_some_and(|lock| lock.excludes()));
    }

    /// As while `abandon_all` removes what is listed.
    #[test]
    fn a_file_is_not_removed_while_the_list_is_in_use() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.lock");
        let held = LockFile::take(&path).unwrap().unwrap();
        let in_use = list();
        let thread = thread::spawn(move || drop(held));
        thread::sleep(Duration::from_millis(50));
        let is_there = path.exists();
        drop(in_use);
        thread.join().unwrap();
        assert!(is_there && !path.exists() && !list().contains_key(&path));
    }

    #[cfg(unix)]
    #[test]
    fn a_file_that_was_removed_is_another_than_one_made_since() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.lock");
        let file = File::create(&path).unwrap();
        assert!(is_at(&file, &path));
        fs::remove_file(&path).unwrap();
        assert!(!is_at(&file, &path));
        let other = File::create(&path).unwrap();
        assert!(!is_at(&file, &path) && is_at(&other, &path));
    }

    #[test]
    fn file_systems_without_locks_are_told_from_other_failures() {
        assert!(are_unknown(&io::ErrorKind::Unsupported.into()));
        assert!(!are_unknown(&io::ErrorKind::PermissionDenied.into()));
        #[cfg(target_os = "linux")]
        {
            assert!(are_unknown(&io::Error::from_raw_os_error(37)), "ENOLCK");
            assert!(!are_unknown(&io::Error::from_raw_os_error(5)), "EIO");
        }
        #[cfg(target_vendor = "apple")]
        assert!(are_unknown(&io::Error::from_raw_os_error(45)), "ENOTSUP");
    }
}
