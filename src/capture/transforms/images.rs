//! Names of files in a `transforms*.json`, and where the images of these names are.

use std::path::{Path, PathBuf};

/// Normalises a relative path: `./train//r_0` becomes `train/r_0`, and so does `.\train\r_0`, as written by programs on
/// Windows.
pub(super) fn plain(name: &str) -> String {
    let is_separator = |c: char| matches!(c, '/' | '\\');
    let parts: Vec<&str> = name.split(is_separator).filter(|part| !matches!(*part, "" | ".")).collect();
    // An absolute path remains absolute, and is refused as such.
    let root = if name.starts_with(is_separator) { "/" } else { "" };
    format!("{root}{}", parts.join("/"))
}

/// Path of an image without this folder, if it begins with it.
pub(super) fn without(folder: Option<&str>, path: String) -> String {
    match folder.and_then(|folder| path.strip_prefix(folder)?.strip_prefix('/')) {
        Some(rest) => rest.to_owned(),
        None => path,
    }
}

/// Where images are looked for.
pub(super) struct Images<'a> {
    root: &'a Path,
    /// Whether an image that is not beside the list may be in `images`.
    may_be_below: bool,
    /// Folder instead of `images`.
    folder: Option<PathBuf>,
    /// Whether images of some names that do not begin with `images` are in `folder`.
    are_there: bool,
}

impl<'a> Images<'a> {
    /// Looks for images of `names`, paths in `root`, in the folder `instead` of `images`, if one is given.
    pub(super) fn new<'n>(
        root: &'a Path,
        may_be_below: bool,
        instead: Option<&str>,
        mut names: impl Iterator<Item = &'n Path>,
    ) -> Self {
        let folder = instead.map(|instead| root.join(instead));
        let are_there = folder.as_ref().is_some_and(|folder| {
            names.any(|name| !name.starts_with("images") && with_suffix(&folder.join(name)).is_some())
        });
        Self { root, may_be_below, folder, are_there }
    }

    /// Folder instead of `images`, if one is given.
    pub(super) fn folder(&self) -> Option<&Path> {
        self.folder.as_deref()
    }

    /// File of an image, in the folder instead of `images` if one is given.
    pub(super) fn find(&self, name: &Path) -> PathBuf {
        match &self.folder {
            Some(folder) => self.find_in(folder, name),
            None => self.find_whole(name),
        }
    }

    /// File of an image, with a suffix added if the name has none. Where there is none beside the list, that of a name
    /// that does not begin with `images` may lie in `images`.
    pub(super) fn find_whole(&self, name: &Path) -> PathBuf {
        let beside = self.root.join(name);
        let may_be_below = self.may_be_below && !name.starts_with("images");
        let below = || with_suffix(&self.root.join("images").join(name)).filter(|_| may_be_below);
        with_suffix(&beside).or_else(below).unwrap_or(beside)
    }

    /// Same as [`Self::find_whole`], with `images` replaced by the given folder. Other names are those of files in that
    /// folder if they are without a folder, or if some of them are there.
    fn find_in(&self, folder: &Path, name: &Path) -> PathBuf {
        let beside = self.root.join(name);
        let is_bare = name.components().nth(1).is_none();
        let file = match name.strip_prefix("images") {
            Ok(rest) => folder.join(rest),
            Err(_) if (is_bare || self.are_there) && !beside.starts_with(folder) => folder.join(name),
            Err(_) => beside,
        };
        with_suffix(&file).unwrap_or(file)
    }
}

/// The file at this path, else one with a suffix appended, if there is one.
fn with_suffix(path: &Path) -> Option<PathBuf> {
    if path.is_file() {
        return Some(path.to_owned());
    }
    // Appended, not replaced: a name like `frame.001` has no suffix.
    let candidates = ["png", "jpg", "jpeg", "PNG", "JPG", "JPEG"].map(|suffix| {
        let mut with_suffix = path.to_owned().into_os_string();
        with_suffix.push(format!(".{suffix}"));
        PathBuf::from(with_suffix)
    });
    candidates.into_iter().find(|p| p.is_file())
}
