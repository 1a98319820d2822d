//! Files referenced by another file.

use std::path::{Component, Path, PathBuf};

use super::error::shown;
use crate::atomic::real_path;

/// Resolves the path of a file in or below `folder`, with `/` or, as programs on Windows write it, `\` between folders;
/// neither the name nor symbolic links may lead outside. On failure: expectation and finding.
pub(super) fn inside(folder: &Path, name: &str) -> Result<PathBuf, (String, String)> {
    let found = || shown(name.as_bytes());
    let refused = || ("a path inside the folder of the file".to_owned(), found());
    let stays = |c: Component<'_>| matches!(c, Component::Normal(_) | Component::CurDir);
    let path = name.replace('\\', "/");
    if path.is_empty() || path.contains(':') || !Path::new(&path).components().all(stays) {
        return Err(refused());
    }
    // The parent of a bare name is the empty path.
    let folder = if folder.as_os_str().is_empty() { Path::new(".") } else { folder };
    let real = |path: &Path| real_path(path).map_err(|e| ("a readable file".to_owned(), format!("{} ({e})", found())));
    let folder = real(folder)?;
    let path = real(&folder.join(path))?;
    if !path.starts_with(&folder) {
        return Err(refused());
    }
    // Opening or reading a pipe might never end.
    if !path.is_file() {
        return Err(("a file".to_owned(), format!("{}, which is none", found())));
    }
    Ok(path)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_inside_may_begin_with_a_dot() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::create_dir(folder.path().join("a")).unwrap();
        std::fs::write(folder.path().join("a/b"), b"").unwrap();
        let path = folder.path().join("a/b").canonicalize().unwrap();
        for name in ["a/b", "./a/b", "a/./b", "././a//b", r"a\b", r".\a\b"] {
            assert_eq!(inside(folder.path(), name), Ok(path.clone()), "{name}");
        }
        let expected = |name: &str| inside(&folder.path().join("a"), name).unwrap_err().0;
        for name in ["../a/b", "./../a/b", "b/..", "/a", "", "C:b", r"..\a\b", r"\a", r"C:\b"] {
            assert_eq!(expected(name), "a path inside the folder of the file", "{name}");
        }
        assert_eq!([".", "c"].map(expected), ["a file", "a readable file"]);
    }
}
