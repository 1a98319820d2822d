//! Atomic writing of files: complete or not at all, however the program ends; and locks, so that no two processes write
//! the same.

mod lock;

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::{self, BufWriter, Write as _};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use tempfile::TempDir;

pub use self::lock::{Lock, LockFile};

/// Temporary paths in use, each with the place to which it is to be restored, if any.
static LISTED: Mutex<BTreeMap<PathBuf, Option<PathBuf>>> = Mutex::new(BTreeMap::new());

fn list() -> MutexGuard<'static, BTreeMap<PathBuf, Option<PathBuf>>> {
    LISTED.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Cleans up before the program ends without unwinding, for example by a signal: removes the temporary files and
/// folders being written, and restores files that are [`Aside`]. Threads about to create or finish a temporary file
/// block until the program ends.
pub fn abandon_all() {
    let list = list();
    for (path, place) in list.iter() {
        // Errors cannot be reported any more.
        let _ = match place {
            Some(place) => put_back(path, place).map(drop),
            None if path.is_dir() => fs::remove_dir_all(path),
            None => fs::remove_file(path),
        };
    }
    std::mem::forget(list);
}

/// Blocks [`abandon_all`] while the returned guard is held, because removing temporary folders would lose the files in
/// them.
pub(crate) fn undisturbed() -> impl Drop {
    list()
}

/// Renames `path` to `place`, unless `place` is taken; whether it did.
fn put_back(path: &Path, place: &Path) -> io::Result<bool> {
    let is_free = !place.exists();
    if is_free {
        rename(path, place)?;
    }
    Ok(is_free)
}

/// Time for which a file that another program holds is tried again, and between attempts.
const PATIENCE: Duration = Duration::from_secs(2);
const PAUSE: Duration = Duration::from_millis(25);

/// Renames a file or folder, a file over what is there. On Windows, virus scanners and indexers hold new files for
/// moments, in which they cannot be renamed: it is tried again for two seconds.
///
/// # Errors
/// If it cannot be renamed.
pub fn rename(from: &Path, to: &Path) -> io::Result<()> {
    patiently(cfg!(windows), || fs::rename(from, to))
}

fn patiently(is_windows: bool, mut act: impl FnMut() -> io::Result<()>) -> io::Result<()> {
    let start = Instant::now();
    loop {
        match act() {
            // Access denied, a sharing violation, or a lock violation.
            Err(error)
                if is_windows && matches!(error.raw_os_error(), Some(5 | 32 | 33)) && start.elapsed() < PATIENCE =>
            {
                thread::sleep(PAUSE);
            }
            done => return done,
        }
    }
}

/// Writes a file's content through to the disk, where the file system can.
///
/// # Errors
/// If the disk cannot take it.
pub(crate) fn sync(file: &File) -> io::Result<()> {
    match file.sync_all() {
        Err(error) if lacks_sync(&error, cfg!(target_vendor = "apple")) => Ok(()),
        done => done,
    }
}

/// Whether an error of [`File::sync_all`] says that the file system does not have it: on Apple's systems it asks for
/// `F_FULLFSYNC`, to which network volumes answer EINVAL, ENOTTY, ENOTSUP or EOPNOTSUPP.
fn lacks_sync(error: &io::Error, is_apple: bool) -> bool {
    is_apple && matches!(error.raw_os_error(), Some(22 | 25 | 45 | 102))
}

/// Absolute path of what exists, without symbolic links.
///
/// # Errors
/// If nothing is there.
pub fn real_path(path: &Path) -> io::Result<PathBuf> {
    match path.canonicalize() {
        // Some RAM disks on Windows do not support this, nor links.
        Err(_) if cfg!(windows) && path.exists() => std::path::absolute(path),
        done => done,
    }
}

/// Entry of the list of temporary paths, removed on drop.
struct Listed(PathBuf);

impl Drop for Listed {
    fn drop(&mut self) {
        list().remove(&self.0);
    }
}

/// Creates a temporary file or folder and its list entry, which must be dropped last.
fn listed<T: AsRef<Path>>(make: impl FnOnce() -> io::Result<T>) -> io::Result<(Listed, T)> {
    let mut list = list();
    let temporary = make()?;
    let path = temporary.as_ref().to_owned();
    list.insert(path.clone(), None);
    Ok((Listed(path), temporary))
}

/// Hidden temporary folder for files that will be renamed to a place beside it; removed with its remaining content on
/// drop.
pub struct Staging {
    folder: TempDir,
    _listed: Listed,
}

impl Staging {
    /// Creates a staging folder within `folder`.
    ///
    /// # Errors
    /// If `folder` does not exist or cannot be written to.
    pub fn within(folder: &Path) -> io::Result<Self> {
        let (listed, folder) = listed(|| tempfile::Builder::new().prefix(PREFIX).tempdir_in(folder))?;
        Ok(Self { folder, _listed: listed })
    }

    /// Path of the staging folder.
    #[must_use]
    pub fn path(&self) -> &Path {
        self.folder.path()
    }
}

/// File renamed out of the way, where nothing overwrites it.
pub struct Aside {
    listed: Listed,
    place: PathBuf,
}

impl Aside {
    /// Renames `place` to `name`; permanent unless [`Self::back`] or [`abandon_all`] is called before the value is
    /// dropped.
    ///
    /// # Errors
    /// If the file cannot be renamed.
    pub fn set(place: PathBuf, name: PathBuf) -> io::Result<Self> {
        let mut list = list();
        rename(&place, &name)?;
        list.insert(name.clone(), Some(place.clone()));
        Ok(Self { listed: Listed(name), place })
    }

    /// Current path of the file.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.listed.0
    }

    /// Renames the file back to its original name, unless that is taken by now; whether it did.
    ///
    /// # Errors
    /// If the file cannot be renamed.
    pub fn back(self) -> io::Result<bool> {
        put_back(self.path(), &self.place)
    }
}

/// Folder of a file.
#[must_use]
pub fn folder_of(file: &Path) -> &Path {
    // The parent of a bare name is the empty path, which is not a folder.
    file.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

/// Where a file of this name comes to be: where it leads, if it is a symbolic link, be there a file or not.
///
/// # Errors
/// If it is a folder, a device or a pipe, or one of links that lead to one another.
pub fn place_of(output: &Path) -> io::Result<PathBuf> {
    if output.is_dir() {
        return Err(io::Error::new(io::ErrorKind::IsADirectory, "a folder of this name exists"));
    }
    if output.exists() && !output.is_file() {
        return Err(io::Error::other("it is a device or a pipe, not a file"));
    }
    if !output.is_symlink() {
        return Ok(output.to_owned());
    }
    if let Ok(place) = output.canonicalize() {
        return Ok(place);
    }
    // Nothing is there yet.
    let mut place = output.to_owned();
    for _ in 0..MOST_LINKS {
        let Ok(target) = fs::read_link(&place) else { return Ok(place) };
        place = folder_of(&place).join(target);
    }
    Err(io::Error::other("it is one of symbolic links that lead to one another"))
}

/// As many symbolic links are followed, one after the other, as Linux does.
const MOST_LINKS: usize = 40;

/// Renames each of `files`, of which the first is in `staging`, to the second, in their order, over what is there: all
/// of them, or none where one cannot be, which is the error's.
///
/// # Errors
/// If a place is a folder, or cannot be written to.
pub fn replace_all<'a>(staging: &Staging, files: &[(&Path, &'a Path)]) -> Result<(), (&'a Path, io::Error)> {
    let _undisturbed = undisturbed();
    let mut former = vec![];
    for (i, (file, place)) in files.iter().enumerate() {
        let kept = staging.path().join(format!("{PREFIX}former-{i}"));
        let keep = || -> io::Result<Option<PathBuf>> {
            if !place.exists() {
                return Ok(None);
            }
            // A hard link keeps the former content under a second name until the new file replaces the place; not all
            // file systems support links.
            fs::hard_link(place, &kept).or_else(|_| fs::copy(place, &kept).map(drop))?;
            // See the `sync` in `write_with`.
            sync(&fs::OpenOptions::new().write(true).open(file)?)?;
            Ok(Some(kept))
        };
        let replace = || {
            #[cfg(unix)]
            keep_mode(file, place)?;
            rename(file, place)
        };
        match keep().and_then(|kept| replace().map(|()| kept)) {
            Ok(kept) => former.push((*place, kept)),
            Err(error) => {
                for (place, kept) in former.into_iter().rev() {
                    // Errors of the rollback are not reported: the first failure already is.
                    let _ = kept.map_or_else(|| fs::remove_file(place), |kept| rename(&kept, place));
                }
                return Err((place, error));
            }
        }
    }
    Ok(())
}

/// Gives a file the permissions of the file it is to replace, so that private files stay private.
#[cfg(unix)]
fn keep_mode(file: &Path, place: &Path) -> io::Result<()> {
    use std::os::unix::fs::PermissionsExt as _;
    let Ok(former) = mode_of(place) else { return Ok(()) };
    // Not all file systems have permissions.
    if former == mode_of(file)? { Ok(()) } else { fs::set_permissions(file, fs::Permissions::from_mode(former)) }
}

/// Makes `options` create a file that nobody can open who cannot open the file it is to replace; what `keep_mode` then
/// takes away could have been opened before.
#[cfg(unix)]
fn begin_with_mode(options: &mut fs::OpenOptions, place: &Path) {
    use std::os::unix::fs::OpenOptionsExt as _;
    if let Ok(former) = mode_of(place) {
        options.mode(former);
    }
}

/// Permissions of a file for its user, its group and others.
#[cfg(unix)]
fn mode_of(file: &Path) -> io::Result<u32> {
    use std::os::unix::fs::PermissionsExt as _;
    Ok(fs::metadata(file)?.permissions().mode() & 0o777)
}

/// Prefix of the names of temporary files and folders.
const PREFIX: &str = ".centaur-";

/// Writes the output of `produce` to `path` via a temporary file in the same folder, so that `path` holds either its
/// former content or all of the new one; if there is former content, this holds even after a system crash. Returns the
/// number of bytes written. If `path` is a symbolic link to a file, that file is replaced.
///
/// # Errors
/// If the folder does not exist or cannot be written to, or `produce` fails.
pub(crate) fn write_with(
    path: &Path,
    produce: impl FnOnce(&mut BufWriter<&mut File>) -> io::Result<()>,
) -> io::Result<u64> {
    let path = place_of(path)?;
    // Temporary files of `tempfile` are private; the result is as readable as the umask allows, like any other file, or
    // as the file it replaces.
    let mut options = File::options();
    options.read(true).write(true).create_new(true);
    #[cfg(unix)]
    begin_with_mode(&mut options, &path);
    let make = |path: &Path| options.open(path);
    let (_listed, mut temporary) = listed(|| tempfile::Builder::new().prefix(PREFIX).make_in(folder_of(&path), make))?;
    #[cfg(unix)]
    keep_mode(temporary.path(), &path)?;
    let mut out = BufWriter::with_capacity(1 << 20, temporary.as_file_mut());
    produce(&mut out)?;
    out.flush()?;
    drop(out);
    let bytes = temporary.as_file().metadata()?.len();
    // After a crash the rename may have reached the disk without the data: synchronised only if former content could be
    // lost.
    if path.exists() {
        sync(temporary.as_file())?;
    }
    // On Windows, a file that a reader has open, such as a scene overwritten by itself, can be replaced by `rename` but
    // not by `persist`, and paths may be too long for `keep`. What is renamed is not there to be removed on drop.
    let (file, temporary) = temporary.into_parts();
    drop(file);
    rename(&temporary, &path)?;
    Ok(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn write(path: &Path, bytes: &[u8]) -> io::Result<u64> {
        write_with(path, |out| out.write_all(bytes))
    }

    #[cfg(unix)]
    #[test]
    fn what_a_link_leads_to_is_written() {
        let [folder, other] = [(); 2].map(|()| tempfile::tempdir().unwrap());
        let [link, file] = [folder.path().join("a.bin"), other.path().join("b.bin")];
        std::os::unix::fs::symlink(&file, &link).unwrap();
        // Also through a chain of two links, to a file that does not exist yet.
        let between = other.path().join("c.bin");
        std::os::unix::fs::symlink("b.bin", &between).unwrap();
        fs::remove_file(&link).unwrap();
        std::os::unix::fs::symlink(&between, &link).unwrap();
        write(&link, b"old").unwrap();
        assert!(link.is_symlink() && between.is_symlink() && fs::read(&file).unwrap() == b"old");
        write(&link, b"new").unwrap();
        assert!(link.is_symlink());
        assert_eq!(fs::read(&file).unwrap(), b"new");
        assert_eq!([&folder, &other].map(|f| fs::read_dir(f.path()).unwrap().count()), [1, 2]);
        let round = folder.path().join("round");
        std::os::unix::fs::symlink("round", &round).unwrap();
        assert!(write(&round, b"").is_err() && round.is_symlink());
    }

    #[cfg(unix)]
    #[test]
    fn permissions_of_what_is_replaced_are_kept() {
        use std::os::unix::fs::PermissionsExt as _;
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.bin");
        for mode in [0o600, 0o664] {
            fs::write(&path, b"old").unwrap();
            fs::set_permissions(&path, fs::Permissions::from_mode(mode)).unwrap();
            write(&path, b"new").unwrap();
            let staging = Staging::within(folder.path()).unwrap();
            let staged = staging.path().join("staged");
            assert_eq!(fs::metadata(&path).unwrap().permissions().mode() & 0o777, mode);
            write(&staged, b"newer").unwrap();
            replace_all(&staging, &[(&staged, &path)]).unwrap();
            let is = (fs::read(&path).unwrap(), fs::metadata(&path).unwrap().permissions().mode() & 0o777);
            assert_eq!(is, (b"newer".to_vec(), mode));
        }
    }

    #[cfg(unix)]
    #[test]
    fn what_is_to_replace_a_private_file_begins_private() {
        use std::os::unix::fs::PermissionsExt as _;
        let folder = tempfile::tempdir().unwrap();
        let [private, new] = ["private", "new"].map(|name| folder.path().join(name));
        fs::write(&private, b"old").unwrap();
        fs::set_permissions(&private, fs::Permissions::from_mode(0o600)).unwrap();
        let mut options = File::options();
        options.write(true).create_new(true);
        begin_with_mode(&mut options, &private);
        options.open(&new).unwrap();
        assert_eq!(mode_of(&new).unwrap(), 0o600);
    }

    #[test]
    fn what_others_hold_for_moments_is_renamed_after_them() {
        for (code, is_windows, attempts) in [(5, true, 3), (32, true, 3), (33, true, 3), (2, true, 1), (32, false, 1)] {
            let mut made = 0;
            let done = patiently(is_windows, || {
                made += 1;
                if made < 3 { Err(io::Error::from_raw_os_error(code)) } else { Ok(()) }
            });
            assert_eq!((made, done.is_ok()), (attempts, attempts == 3), "{code} {is_windows}");
        }
    }

    #[test]
    fn volumes_that_cannot_be_synchronised_are_told_from_failures() {
        let error = io::Error::from_raw_os_error;
        assert!([22, 25, 45, 102].iter().all(|code| lacks_sync(&error(*code), true)));
        assert!(!lacks_sync(&error(45), false) && !lacks_sync(&error(28), true), "ENOSPC");
    }

    #[cfg(windows)]
    #[test]
    fn paths_may_be_long() {
        let folder = tempfile::tempdir().unwrap();
        let deep = folder.path().join("a".repeat(120)).join("b".repeat(120));
        fs::create_dir_all(&deep).unwrap();
        write(&deep.join("a.bin"), b"new").unwrap();
        assert_eq!(fs::read_dir(&deep).unwrap().count(), 1);
    }

    #[cfg(unix)]
    #[test]
    fn what_is_new_is_as_readable_as_any_file() {
        use std::os::unix::fs::PermissionsExt as _;
        let folder = tempfile::tempdir().unwrap();
        let [usual, own] = ["usual", "own"].map(|name| folder.path().join(name));
        fs::write(&usual, b"").unwrap();
        write(&own, b"").unwrap();
        let [usual, own] = [usual, own].map(|file| fs::metadata(file).unwrap().permissions().mode());
        assert_eq!(usual, own);
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
        assert_eq!(fs::read(&path).unwrap(), b"old");
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);

        assert_eq!(write(&path, b"newer").unwrap(), 5);
        assert_eq!(fs::read(&path).unwrap(), b"newer");
        assert!(write(&folder.path().join("none/a.bin"), b"").is_err());
        assert!(write(folder.path(), b"").is_err());
    }

    #[test]
    fn a_file_that_is_being_read_is_replaced() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.bin");
        write(&path, b"old").unwrap();
        let mut reader = File::open(&path).unwrap();
        write(&path, b"newer").unwrap();
        let mut held = vec![];
        io::Read::read_to_end(&mut reader, &mut held).unwrap();
        assert_eq!((&held[..], &fs::read(&path).unwrap()[..]), (&b"old"[..], &b"newer"[..]));
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
        // A failed rename leaves no files behind.
        assert!(write(&folder.path().join("a".repeat(300)), b"").is_err());
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
    }

    #[test]
    fn of_several_files_all_are_replaced_or_none() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        let [a, b, c, d] = ["a", "b", "c", "d"].map(at);
        let replace = |places: &[&Path]| {
            let staging = Staging::within(folder.path()).unwrap();
            let staged: Vec<PathBuf> = (0..places.len()).map(|i| staging.path().join(i.to_string())).collect();
            for file in &staged {
                write(file, b"new").unwrap();
            }
            let files: Vec<(&Path, &Path)> = staged.iter().map(PathBuf::as_path).zip(places.iter().copied()).collect();
            replace_all(&staging, &files).map_err(|(file, _)| file.to_owned())
        };
        write(&a, b"old").unwrap();
        fs::create_dir(&c).unwrap();
        assert_eq!(replace(&[&a, &b, &c, &d]).unwrap_err(), c);
        assert_eq!((fs::read(&a).unwrap(), b.exists(), c.is_dir(), d.exists()), (b"old".to_vec(), false, true, false));
        replace(&[&a, &b]).unwrap();
        assert_eq!([fs::read(&a).unwrap(), fs::read(&b).unwrap()], [b"new", b"new"]);
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 3, "nothing is left of it");
    }

    /// Looks only at the entries of this test in the list, since other tests write at the same time.
    #[test]
    fn what_is_abandoned_is_removed_or_back() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        let names = || {
            let entries = fs::read_dir(folder.path()).unwrap();
            let mut names: Vec<_> = entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
            names.sort();
            names
        };
        write(&at("kept"), b"old").unwrap();
        write(&at("replaced"), b"old").unwrap();
        let kept = Aside::set(at("kept"), at("kept.before")).unwrap();
        let replaced = Aside::set(at("replaced"), at("replaced.before")).unwrap();
        write(&at("replaced"), b"new").unwrap();
        assert!(kept.back().unwrap() && !replaced.back().unwrap());
        assert_eq!(names(), ["kept", "replaced", "replaced.before"]);
        assert_eq!(fs::read(at("replaced")).unwrap(), b"new");

        let staging = Staging::within(folder.path()).unwrap();
        write(&staging.path().join("a"), b"").unwrap();
        assert_eq!(list().get(staging.path()), Some(&None));
        drop(staging);
        write_with(&at("kept"), |_| {
            assert!(list().keys().any(|path| path.parent() == Some(folder.path())));
            Ok(())
        })
        .unwrap();
        assert!(!list().keys().any(|path| path.starts_with(folder.path())));
        assert_eq!(names(), ["kept", "replaced", "replaced.before"]);
    }
}
