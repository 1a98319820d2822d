//! Output of commands, and checks of output paths.

use std::borrow::Cow;
use std::io::{self, Write as _};
use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result, bail};
use centaur::atomic::{self, folder_of};
use centaur::format::{is_device, one_line};
use clap::builder::{PathBufValueParser, TypedValueParser};
use indicatif::ProgressBar;

use super::shared::MessageArgs;

/// Prints one JSON object on a line of stdout.
pub(super) fn print_json(value: &impl serde::Serialize) -> Result<()> {
    write(format!("{}\n", without_codes(&serde_json::to_string(value)?)).as_bytes())
}

/// Prints a line on stdout. Control characters in it are escaped, line ends too, because names of and in files may
/// contain any character.
pub(super) fn print(line: &str) -> Result<()> {
    print_lines([line])
}

/// Prints lines on stdout at once, each as by [`print`].
pub(super) fn print_lines(lines: impl IntoIterator<Item = impl AsRef<str>>) -> Result<()> {
    let mut text = String::new();
    for line in lines {
        text.push_str(&without_codes(&one_line(line.as_ref())));
        text.push('\n');
    }
    write(text.as_bytes())
}

/// Writes `bytes` to stdout.
pub(super) fn write(bytes: &[u8]) -> Result<()> {
    Ok(io::stdout().lock().write_all(bytes).map_err(StdoutError)?)
}

/// Error of stdout: the reader is gone, or the disk is full.
#[derive(Debug, thiserror::Error)]
#[error("stdout: {0}")]
struct StdoutError(#[source] io::Error);

/// Whether the reader of stdout has closed it early, as in `centaur inspect scene.glb | head -3`. For other programs
/// that stop reading, such an error counts.
pub(super) fn is_read_enough(error: &anyhow::Error) -> bool {
    error.downcast_ref::<StdoutError>().is_some_and(|e| e.0.kind() == io::ErrorKind::BrokenPipe)
}

/// Prints a note on stderr; a reader that has gone away does not stop the command.
pub(super) fn note(text: &str) {
    let _ = writeln!(io::stderr(), "note: {}", without_codes(&one_line(text)));
}

/// Tells a note while a command goes on: a program, by [`json_line`], or else a person.
pub(super) fn say(text: &str, as_json: bool) {
    if as_json {
        json_line(&serde_json::json!({ "note": without_codes(text) }));
    } else {
        note(text);
    }
}

/// Prints one JSON object on a line of stderr; a reader that has gone away does not stop the command.
pub(super) fn json_line(value: &serde_json::Value) {
    let _ = writeln!(io::stderr(), "{value}");
}

/// Removes ` (os error 2)` and the like, with which Rust's I/O errors end and which add no information for users.
pub(super) fn without_codes(text: &str) -> Cow<'_, str> {
    const BEGIN: &str = " (os error ";
    let mut parts = text.split(BEGIN);
    let mut plain = Cow::Borrowed(parts.next().unwrap_or_default());
    for part in parts {
        match part.split_once(')') {
            Some((code, rest)) if code.parse::<i32>().is_ok() => plain.to_mut().push_str(rest),
            _ => plain.to_mut().extend([BEGIN, part]),
        }
    }
    plain
}

/// Progress bar over `length` items; hidden on request and where stderr is no terminal.
pub(super) fn bar(messages: &MessageArgs, length: u64) -> ProgressBar {
    if messages.quiet || messages.json { ProgressBar::hidden() } else { ProgressBar::new(length) }
}

/// Rejects, before hours of work, a file that could not be written at their end: its folder must exist and be writable,
/// its name must be valid, and it must not be a folder itself.
pub(super) fn check_file(path: &Path) -> Result<()> {
    if path.is_dir() {
        bail!("{}: expected the name of a file, found a folder", path.display());
    }
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    if let Some(found) = forbidden(&name, cfg!(windows)) {
        bail!("{}: expected a name that Windows allows, found {found}", path.display());
    }
    let cannot = || format!("{}: cannot write", path.display());
    probe(folder_of(&atomic::place_of(path).with_context(cannot)?)).with_context(cannot)?;
    match path.symlink_metadata() {
        // For example, if the name is too long.
        Err(e) if e.kind() != io::ErrorKind::NotFound => Err(e).with_context(cannot),
        _ => Ok(()),
    }
}

/// What is in the name of a file that Windows does not allow, and would refuse only when the complete file is renamed.
fn forbidden(name: &str, is_windows: bool) -> Option<String> {
    let is_special = |c: &char| matches!(c, ':' | '*' | '?' | '"' | '<' | '>' | '|');
    let special = || name.chars().find(is_special).map(|c| format!("`{c}` in it"));
    let device = || is_device(name).then(|| "the name of a device".to_owned());
    if is_windows { special().or_else(device) } else { None }
}

/// Rejects a folder that is neither writable nor can be created. Its parent must exist, so that no mistyped path is
/// created.
pub(super) fn check_folder(path: &Path) -> Result<()> {
    if path.exists() {
        return probe(path).with_context(|| format!("{}: cannot write", path.display()));
    }
    check_file(path)
}

/// Folder for files. If it was created here, it is removed on drop if empty: a failure before the first file leaves
/// nothing behind.
#[must_use = "what is made goes again with this, unless there is something in it"]
pub(super) struct Folder {
    made: Option<PathBuf>,
}

impl Folder {
    /// Creates the folder and its ancestors if necessary.
    pub(super) fn make(path: &Path) -> Result<Self> {
        let is_new = !path.exists();
        std::fs::create_dir_all(path).with_context(|| format!("{}: cannot make the folder", path.display()))?;
        Ok(Self { made: is_new.then(|| path.to_owned()) })
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        // The system rejects this if the folder is not empty.
        let _ = self.made.as_deref().map(std::fs::remove_dir);
    }
}

/// Rejects writing `output` over one of `inputs`, which would be lost.
pub(super) fn spare<'a>(output: &Path, inputs: impl IntoIterator<Item = &'a Path>) -> Result<()> {
    // Nothing can be lost there.
    if !output.exists() {
        return Ok(());
    }
    let place = atomic::real_path(output).with_context(|| format!("{}: cannot write", output.display()))?;
    if let Some(input) = inputs.into_iter().find(|input| atomic::real_path(input).is_ok_and(|input| input == place)) {
        bail!("{}: expected another file than {}, which would be lost", output.display(), input.display());
    }
    Ok(())
}

/// Whether two paths, which need not exist yet, lead to the same place.
pub(super) fn is_same(a: &Path, b: &Path) -> bool {
    let real = |path: &Path| atomic::real_path(path).ok();
    let place = |path: &Path| real(path).or_else(|| Some(real(folder_of(path))?.join(path.file_name()?)));
    place(a).is_some_and(|a| place(b) == Some(a))
}

/// Checks that `folder` is writable by creating and removing a nameless file. Permission bits are not sufficient:
/// read-only mounts, quotas.
fn probe(folder: &Path) -> Result<()> {
    match folder.metadata() {
        Err(e) => bail!("folder {}: {e}", folder.display()),
        Ok(m) if !m.is_dir() => bail!("{} is not a folder", folder.display()),
        Ok(_) => {}
    }
    tempfile::tempfile_in(folder).map(drop).with_context(|| format!("folder {}", folder.display()))
}

/// Number with a noun in singular or plural: `1 picture`, `2 pictures`.
pub(super) fn counted(n: usize, what: &str) -> String {
    format!("{n} {what}{}", if n == 1 { "" } else { "s" })
}

/// A whole number from 0 on; for clap's `value_parser`.
pub(super) fn whole_number(text: &str) -> Result<u64, String> {
    text.parse().map_err(|_| "expected a whole number from 0".to_owned())
}

/// A whole number from 1 on; for clap's `value_parser`.
pub(super) fn at_least_one(text: &str) -> Result<usize, String> {
    text.parse().ok().filter(|n| *n > 0).ok_or_else(|| "expected a whole number from 1".into())
}

/// Parser of paths, UTF-8 or not, that `check` accepts; for clap's `value_parser`.
pub(super) fn path(check: fn(PathBuf) -> Result<PathBuf, String>) -> impl TypedValueParser<Value = PathBuf> {
    PathBufValueParser::new().try_map(check)
}

/// Accepts a path whose name ends in one of `extensions` (lower case, without dot).
pub(super) fn with_extension(path: PathBuf, extensions: &[&str]) -> Result<PathBuf, String> {
    let name = path.file_name().unwrap_or_default().to_string_lossy().to_lowercase();
    let ends = |extension: &&str| {
        name.strip_suffix(extension).and_then(|s| s.strip_suffix('.')).is_some_and(|s| !s.is_empty())
    };
    if extensions.iter().any(ends) {
        return Ok(path);
    }
    Err(expected_name(extensions))
}

/// What is expected of a path whose name has to end in one of `extensions` (without dot).
pub(super) fn expected_name(extensions: &[&str]) -> String {
    let wanted: Vec<String> = extensions.iter().map(|e| format!(".{e}")).collect();
    format!("expected a name that ends in {}", wanted.join(" or "))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn outputs_are_probed() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        std::fs::write(at("file"), "").unwrap();
        assert!(check_file(&at("new.glb")).is_ok() && check_file(&at("file")).is_ok());
        assert!(check_folder(&at("new")).is_ok() && check_folder(folder.path()).is_ok());
        assert!(check_file(folder.path()).is_err() && check_folder(&at("file")).is_err());
        assert!(check_file(&at("none/new.glb")).is_err() && check_folder(&at("none/new")).is_err());
        assert!(check_file(&at(&"a".repeat(300))).is_err());
        let error = check_file(&at("file/new.glb")).unwrap_err();
        assert!(format!("{error:#}").ends_with("file is not a folder"), "{error:#}");
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1, "a probe was left behind");
    }

    #[test]
    fn names_that_windows_does_not_allow_are_refused_there() {
        for (name, found) in [
            ("a:b.glb", "`:` in it"),
            ("a*.glb", "`*` in it"),
            ("a?.glb", "`?` in it"),
            ("a\".glb", "`\"` in it"),
            ("<a.glb", "`<` in it"),
            ("a>.glb", "`>` in it"),
            ("a|b.glb", "`|` in it"),
            ("NUL.glb", "the name of a device"),
        ] {
            assert_eq!((forbidden(name, true).as_deref(), forbidden(name, false)), (Some(found), None), "{name}");
        }
        assert_eq!(forbidden("ä & (b).glb", true), None);
    }

    #[test]
    fn folders_that_were_made_for_nothing_go_again() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        std::fs::create_dir(at("before")).unwrap();
        for name in ["before", "empty", "full"] {
            let _folder = Folder::make(&at(name)).unwrap();
            assert!(at(name).is_dir());
            if name == "full" {
                std::fs::write(at("full/a.png"), "").unwrap();
            }
        }
        assert!(at("before").is_dir() && !at("empty").exists() && at("full/a.png").exists());
    }

    #[test]
    fn codes_of_the_system_are_left_out_and_nothing_else() {
        let plain = without_codes;
        assert_eq!(plain("a.png: No such file (os error 2)"), "a.png: No such file");
        assert_eq!(plain("no mask (b.png: No such file (os error 2)), c"), "no mask (b.png: No such file), c");
        assert_eq!(plain("a (os error 2): b (os error -13)\nc"), "a: b\nc");
        for text in ["", "a (b)", "a (os error x)", "a (os error 2", "a (os error )"] {
            assert_eq!(plain(text), text);
        }
    }

    #[test]
    fn inputs_are_spared() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        std::fs::write(at("a.glb"), "").unwrap();
        let (a, around) = (at("a.glb"), folder.path().join("./a.glb"));
        assert!(spare(&at("b.glb"), [a.as_path()]).is_ok() && spare(&a, [at("b.glb").as_path()]).is_ok());
        let error = spare(&around, [at("b.glb").as_path(), &a]).unwrap_err().to_string();
        assert!(error.ends_with("a.glb, which would be lost"), "{error}");
    }

    #[test]
    fn the_same_place_by_other_words() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        std::fs::create_dir(at("in")).unwrap();
        for name in ["a.glb", "./a.glb", "in/../a.glb", "a.glb/"] {
            assert!(is_same(&at("a.glb"), &at(name)), "{name}");
        }
        assert!(!is_same(&at("a.glb"), &at("in/a.glb")) && !is_same(&at("none/a.glb"), &at("none/a.glb")));
        std::fs::write(at("a.glb"), "").unwrap();
        assert!(is_same(&at("a.glb"), &at("./a.glb")) && !is_same(&at("a.glb"), &at("b.glb")));
    }

    #[test]
    fn extensions_ignore_case() {
        let given = |name: &str, extensions: &[&str]| with_extension(name.into(), extensions);
        assert!(given("a.GLB", &["glb"]).is_ok());
        assert!(given("a.Blend.py", &["blend.py"]).is_ok() && given("a.py", &["blend.py"]).is_err());
        assert!(given(".glb", &["glb"]).is_err());
        assert_eq!(given("a", &["glb", "ply"]).unwrap_err(), "expected a name that ends in .glb or .ply");
    }
}
