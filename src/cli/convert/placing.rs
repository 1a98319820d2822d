//! Placement of files written to a staging folder, without replacing foreign files.

use std::fs::File;
use std::io::{self, BufRead as _, BufReader, Read as _};
use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result, bail};
use centaur::atomic::{self, Staging, folder_of};
use centaur::capture;
use centaur::format::{self, Format, Sharing};

use crate::cli::output;

/// Whether names that differ by case alone are usually one file here.
const IGNORES_CASE: bool = cfg!(any(windows, target_os = "macos"));

/// File that accompanies the output.
struct Companion {
    staged: PathBuf,
    place: PathBuf,
}

impl Companion {
    /// Whether the file is a plug-in, which belongs to the program and not to a scene.
    fn is_plugin(&self) -> bool {
        format::has_extension(&self.place, &["py"])
    }

    /// Advice on how to keep the existing file.
    fn other_ways(&self) -> &'static str {
        if self.is_plugin() {
            "a folder of its own keeps both"
        } else {
            "another name or a folder of its own keeps both"
        }
    }

    /// Whether a different file exists at its place.
    fn replaces(&self) -> io::Result<bool> {
        Ok(self.place.exists() && !is_equal(&self.staged, &self.place)?)
    }
}

/// Moves all files of `staging` to the folder of `place`, the path to which `output` leads and at which the file of its
/// name belongs: all of them or none. Returns notes.
pub(super) fn place(staging: &Staging, output: &Path, place: &Path, inputs: &[PathBuf]) -> Result<Vec<String>> {
    let named = || format!("{}: cannot write", output.display());
    let name = output.file_name().unwrap_or_default();
    let mut companions = vec![];
    for entry in staging.path().read_dir().with_context(named)? {
        let staged = entry.with_context(named)?.path();
        if staged.file_name() != Some(name) {
            let place = folder_of(place).join(staged.file_name().unwrap_or_default());
            companions.push(Companion { staged, place });
        }
    }
    spare_foreign(output, &companions, inputs)?;
    let beside = place.with_file_name(name);
    let shown = showing(output, &beside, &companions)?;
    let former = only_of_former(output, &beside, &companions, inputs);
    // A file that refers to others must not appear before them.
    let all = companions.iter().map(|file| (&*file.staged, &*file.place));
    let staged = staging.path().join(name);
    let files: Vec<(&Path, &Path)> = all.chain([(&*staged, place)]).collect();
    atomic::replace_all(staging, &files)
        .map_err(|(file, error)| anyhow::Error::from(error).context(format!("{}: cannot write", file.display())))?;
    let note =
        |other: Sharing| format!("{} uses files that were replaced: convert it again, too", other.path.display());
    Ok(shown.into_iter().map(note).chain(former.iter().map(|file| left_over(file))).collect())
}

/// Companions of the former version of `output` that the new one lacks, unless they are inputs or another export may
/// use them by its name.
fn only_of_former(output: &Path, beside: &Path, companions: &[Companion], inputs: &[PathBuf]) -> Vec<PathBuf> {
    if !format::sharing(beside, IGNORES_CASE).is_ok_and(|others| others.is_empty()) {
        return vec![];
    }
    let is_kept = |path: &PathBuf| {
        companions.iter().any(|file| file.place == *path)
            || output::spare(path, inputs.iter().map(PathBuf::as_path)).is_err()
    };
    let former = format::referred(output).into_iter().map(|name| beside.with_file_name(name));
    former.filter(|path| path.is_file() && !is_kept(path)).collect()
}

/// Note on a file of a replaced export. It stays, since copies of that export may use it, or it may be the user's.
fn left_over(file: &Path) -> String {
    format!("{}: was used by the replaced export, and is not by this one", file.display())
}

/// Rejects an output that belongs to others: a file that an export beside it uses, or points of a capture.
pub(super) fn spare_used(output: &Path) -> Result<()> {
    // Nothing can be lost there.
    if !output.is_file() {
        return Ok(());
    }
    let named = || format!("{}: cannot write", output.display());
    let place = atomic::place_of(output).with_context(named)?;
    if let Some(user) = [output, &place].into_iter().find_map(user_of) {
        bail!("{}: is a file that {} uses: expected another name", output.display(), user.display());
    }
    let real = atomic::real_path(output).with_context(named)?;
    let is_it = |file: &PathBuf| atomic::real_path(file).is_ok_and(|file| file == real);
    // Points are in the folder of their capture, or in a subfolder.
    let mut folders = real.ancestors().skip(1).take(4).filter(|_| format::has_extension(&real, &["ply"]));
    if let Some(folder) = folders.find(|folder| capture::points_files(folder).iter().any(is_it)) {
        let folder = folder.display();
        bail!("{}: holds the points of the capture {folder}: expected another name", output.display());
    }
    Ok(())
}

/// Export for a rendering program that has the name of `file`, which lies beside it, in its text, if there is one.
/// Exports that cannot be read use nothing.
fn user_of(file: &Path) -> Option<PathBuf> {
    let name = file.file_name()?.as_encoded_bytes();
    let quoted = [b'"', b'\''].map(|quote| [&[quote][..], name, &[quote]].concat());
    let quoted = quoted.each_ref().map(Vec::as_slice);
    let is_export = |path: &PathBuf| Format::of_path(path).is_some_and(|format| !format.is_readable());
    let beside = folder_of(file).read_dir().ok()?.flatten().map(|entry| file.with_file_name(entry.file_name()));
    let mut exports: Vec<PathBuf> = beside.filter(|path| path != file && is_export(path) && path.is_file()).collect();
    exports.sort_unstable();
    exports.into_iter().find(|path| names_any_of(path, &quoted, IGNORES_CASE).unwrap_or(false))
}

/// Rejects overwriting files that the user has not named: inputs, or companions of another output.
fn spare_foreign(output: &Path, companions: &[Companion], inputs: &[PathBuf]) -> Result<()> {
    let is_own = names_one_of(output, companions, IGNORES_CASE).with_context(|| output.display().to_string())?;
    for file in companions {
        let is_foreign = !is_own && file.replaces().with_context(|| file.place.display().to_string())?;
        let what = if output::spare(&file.place, inputs.iter().map(PathBuf::as_path)).is_err() {
            "is an input"
        } else if is_foreign {
            "exists already"
        } else {
            continue;
        };
        bail!("{}: would replace {}, which {what}; {}", output.display(), file.place.display(), file.other_ways());
    }
    Ok(())
}

/// Whether the output exists and, by its text, has one of these companions, whose names may differ by case where the
/// system `ignores_case`: the output may have been renamed.
fn names_one_of(output: &Path, companions: &[Companion], ignores_case: bool) -> io::Result<bool> {
    let own = companions.iter().filter(|file| !file.is_plugin());
    let own: Vec<&[u8]> = own.filter_map(|file| Some(file.place.file_name()?.as_encoded_bytes())).collect();
    Ok(output.exists() && names_any_of(output, &own, ignores_case)?)
}

/// Whether one of these names is in the text of a file, in any case where the system `ignores_case`.
fn names_any_of(file: &Path, names: &[&[u8]], ignores_case: bool) -> io::Result<bool> {
    let are_one = |a: &[u8], b: &[u8]| if ignores_case { a.eq_ignore_ascii_case(b) } else { a == b };
    let Some(longest) = names.iter().map(|name| name.len()).max() else { return Ok(false) };
    let (mut file, mut text) = (File::open(file)?, vec![]);
    loop {
        // A name may span two reads.
        text.drain(..text.len().saturating_sub(longest));
        if (&mut file).take(1 << 20).read_to_end(&mut text)? == 0 {
            return Ok(false);
        }
        if names.iter().any(|name| text.windows(name.len()).any(|part| are_one(part, name))) {
            return Ok(true);
        }
    }
}

/// Other exports that use companions of `output` in their former version and whose names differ from it by their ending
/// only; an error for other exports.
fn showing(output: &Path, beside: &Path, companions: &[Companion]) -> Result<Vec<Sharing>> {
    let named = || format!("{}: cannot write", output.display());
    let shown = format::sharing(beside, IGNORES_CASE).with_context(named)?;
    if shown.is_empty() {
        return Ok(shown);
    }
    let mut changed = None;
    for file in companions.iter().filter(|file| !file.is_plugin()) {
        if file.replaces().with_context(named)? {
            changed = Some(file);
        }
    }
    let Some(file) = changed else { return Ok(vec![]) };
    if let Some(other) = shown.iter().find(|other| !other.is_of_one_name) {
        bail!(
            "{}: would replace {}, which {} uses; {}",
            output.display(),
            file.place.display(),
            other.path.display(),
            file.other_ways()
        );
    }
    Ok(shown)
}

/// Whether two files have equal content.
fn is_equal(a: &Path, b: &Path) -> io::Result<bool> {
    let [of_a, of_b] = [a.metadata()?, b.metadata()?];
    if of_a.len() != of_b.len() || of_a.is_file() != of_b.is_file() {
        return Ok(false);
    }
    let [mut a, mut b] = [BufReader::new(File::open(a)?), BufReader::new(File::open(b)?)];
    loop {
        let (left, right) = (a.fill_buf()?, b.fill_buf()?);
        let length = left.len().min(right.len());
        if length == 0 || left[..length] != right[..length] {
            return Ok(left.is_empty() && right.is_empty());
        }
        a.consume(length);
        b.consume(length);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_in_another_case_are_own_where_the_system_ignores_case() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        let own = [Companion { staged: at("staged"), place: at("s_splats.ply") }];
        std::fs::write(at("s.xml"), "<string value=\"S_splats.ply\"/>").unwrap();
        assert!(names_one_of(&at("s.xml"), &own, true).unwrap() && !names_one_of(&at("s.xml"), &own, false).unwrap());
        std::fs::write(at("s.xml"), "<string value=\"s_splats.ply\"/>").unwrap();
        assert!([true, false].iter().all(|&ignores_case| names_one_of(&at("s.xml"), &own, ignores_case).unwrap()));
    }
}
