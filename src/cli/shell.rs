//! Words of commands that are printed to be pasted into a shell.

use std::borrow::Cow;
use std::ffi::OsStr;
use std::path::Path;

/// A path as a word of a command: quoted, and none that the command would take for an option.
pub(super) fn argument(path: &Path) -> String {
    let is_like_an_option = path.as_os_str().as_encoded_bytes().starts_with(b"-");
    let path = if is_like_an_option { Cow::Owned(Path::new(".").join(path)) } else { Cow::Borrowed(path) };
    String::from_utf8_lossy(&quoted(path.as_os_str(), cfg!(windows))).into_owned()
}

/// Quotes a word for a POSIX shell, or for those of Windows, where paths have backslashes and single quotes are letters
/// to `cmd`.
pub(super) fn quoted(word: &OsStr, is_windows: bool) -> Vec<u8> {
    let bytes = word.as_encoded_bytes();
    // Between percent signs `cmd` reads the name of a variable.
    let of_system = if is_windows { b'\\' } else { b'%' };
    let plain = |c: &u8| c.is_ascii_alphanumeric() || b"-_./=:,+@".contains(c) || *c == of_system;
    if !bytes.is_empty() && bytes.iter().all(plain) {
        return bytes.to_vec();
    }
    let (quote, inner) = if is_windows { (b'"', &br#"\""#[..]) } else { (b'\'', &br"'\''"[..]) };
    // Before a double quote, programs on Windows read two backslashes as one.
    let doubled = |part: &[u8]| -> Vec<u8> {
        let last = part.iter().rev().take_while(|c| is_windows && **c == b'\\').count();
        [part, &b"\\".repeat(last)[..]].concat()
    };
    let escaped = bytes.split(|c| *c == quote).map(doubled).collect::<Vec<_>>().join(inner);
    [&[quote][..], &escaped[..], &[quote][..]].concat()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_are_quoted_for_a_shell() {
        for (word, expected) in [
            ("a/b-0%", "a/b-0%"),
            ("", "''"),
            ("a b", "'a b'"),
            ("it's", r"'it'\''s'"),
            ("$x", "'$x'"),
            (r"a\", r"'a\'"),
        ] {
            assert_eq!(quoted(OsStr::new(word), false), expected.as_bytes());
        }
        for (word, expected) in [
            (r"C:\a\b-0", r"C:\a\b-0"),
            ("", r#""""#),
            (r"C:\a b\", r#""C:\a b\\""#),
            ("it's", r#""it's""#),
            (r#"a"b"#, r#""a\"b""#),
            (r#"a\b\\"c\"#, r#""a\b\\\\\"c\\""#),
            ("%PATH%", r#""%PATH%""#),
        ] {
            assert_eq!(quoted(OsStr::new(word), true), expected.as_bytes());
        }
        #[cfg(unix)]
        {
            use std::os::unix::ffi::OsStrExt as _;
            assert_eq!(quoted(OsStr::from_bytes(b"caf\xe9"), false), b"'caf\xe9'");
        }
    }

    #[cfg(not(windows))]
    #[test]
    fn files_are_no_options() {
        for (name, expected) in [("a.glb", "a.glb"), ("-y.glb", "./-y.glb"), ("-a b.glb", "'./-a b.glb'")] {
            assert_eq!(argument(Path::new(name)), expected);
        }
    }
}
