//! Accompanying files of an export: the parts of a scene in formats for programs that cannot read hybrid scenes.
//!
//! For an output `STEM.…` they are named, in its folder,
//!
//! | file | content |
//! |---|---|
//! | `STEM_splats.ply` | splats in the INRIA layout with (zero) normals, see [`super::ply::write()`] |
//! | `STEM_meshI.ply` | mesh I, see [`surface::write`] |
//! | `STEM_meshI_shKK.exr` | SH coefficient KK of the maps of mesh I, `R G B` as 32-bit floats; that of 00 also has the opacity logit, `A` |
//!
//! All values are the scene's own, bit for bit: in its frame, raw parameters before activation, colours in the blending
//! space. The first row of an image is the top one, at v = 0. Coefficient 00 may differ in size from the others. There
//! is one image per coefficient, because most programs take the first four channels of an EXR for RGBA.

pub(super) mod surface;
#[cfg(test)]
mod tests;

use std::ffi::OsStr;
use std::io;
use std::path::{Path, PathBuf};

use super::{FormatError, atomic_write, exr, ply};
use crate::atomic::folder_of;
use crate::scene::{Atlas, HybridScene, sh};

/// Names and total size of the files written by [`write`]. Names are relative to the output's folder.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Beside {
    /// PLY of the splats, unless there are none.
    pub(super) splats: Option<String>,
    /// Files per mesh, in order.
    pub(super) meshes: Vec<MeshFiles>,
    /// All files, in order of writing.
    pub(super) files: Vec<String>,
    /// Total size of the files in bytes.
    pub(super) bytes: u64,
}

/// Files of a mesh.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct MeshFiles {
    /// PLY of the surface.
    pub(super) surface: String,
    /// EXR files, one per SH coefficient, in the order of [`sh::basis`].
    pub(super) maps: Vec<String>,
}

/// File-name endings of exports, grouped by the kind of their accompanying files; longer endings first.
const KINDS: [&[&str]; 2] = [&[".stock.xml", ".xml", ".blend.py"], &[".usda"]];

/// Another export whose accompanying files have the same names as those of an output.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Sharing {
    /// Path of the other export.
    pub path: PathBuf,
    /// Whether its name differs from that of the output by the ending only (`a.xml`, `a.blend.py`), and not merely by
    /// characters that are replaced by `_`.
    pub is_of_one_name: bool,
}

/// Exports in the folder of `output` that share its accompanying files, by name; `ignores_case` if names that differ by
/// case alone are one file on the system.
///
/// # Errors
/// If the folder cannot be listed.
pub fn sharing(output: &Path, ignores_case: bool) -> io::Result<Vec<Sharing>> {
    let are_one = |a: &OsStr, b: &OsStr| if ignores_case { a.eq_ignore_ascii_case(b) } else { a == b };
    let Some((kind, prefix, own)) = named(output) else { return Ok(vec![]) };
    let mut found = vec![];
    for entry in folder_of(output).read_dir()? {
        let name = entry?.file_name();
        let path = output.with_file_name(&name);
        if let Some(other) = named(&path).filter(|other| other.0 == kind && are_one(other.1.as_ref(), prefix.as_ref()))
            && !are_one(&name, output.file_name().unwrap_or_default())
        {
            found.push(Sharing { path, is_of_one_name: are_one(other.2.as_ref(), own.as_ref()) });
        }
    }
    found.sort_by(|a, b| a.path.cmp(&b.path));
    Ok(found)
}

/// Index in [`KINDS`], stem of the accompanying files, and name before the ending of an export; `None` for other names.
fn named(path: &Path) -> Option<(usize, String, String)> {
    let name = path.file_name()?.to_string_lossy().into_owned();
    let ends = |suffix: &&&str| name.to_lowercase().ends_with(**suffix);
    let of = |kind: usize| KINDS[kind].iter().find(ends).map(|suffix| (kind, suffix.len()));
    let (kind, length) = of(0).or_else(|| of(1))?;
    let own = name.get(..name.len() - length)?.to_owned();
    Some((kind, stem(path, &name[own.len()..]), own))
}

/// Names of the accompanying files to which the export for a rendering program at `output` refers: those that its name
/// gives them, sorted. None if there is no such export, or none that can be read.
#[must_use]
pub fn referred(output: &Path) -> Vec<String> {
    let Some((0, stem, _)) = named(output) else { return vec![] };
    let text = std::fs::read_to_string(output).unwrap_or_default();
    let mut names: Vec<String> =
        text.split('"').filter(|name| is_accompanying(name, &stem)).map(str::to_owned).collect();
    names.sort_unstable();
    names.dedup();
    names
}

/// Whether a name is one of those of this module's table, or that of the animation of a script for Blender.
fn is_accompanying(name: &str, stem: &str) -> bool {
    let Some(part) = name.strip_prefix(stem).and_then(|rest| rest.strip_prefix('_')) else { return false };
    let is_number = |text: &str| !text.is_empty() && text.bytes().all(|b| b.is_ascii_digit());
    let Some(of_mesh) = part.strip_prefix("mesh") else { return matches!(part, "splats.ply" | "motion.npz") };
    of_mesh.strip_suffix(".ply").is_some_and(is_number)
        || of_mesh
            .strip_suffix(".exr")
            .and_then(|map| map.split_once("_sh"))
            .is_some_and(|(mesh, coefficient)| is_number(mesh) && is_number(coefficient))
}

/// Stem of the names of accompanying files: the part of the output's name before `suffix` (`.xml`, ignoring case), with
/// `_` for all characters but letters, digits and `-`, so that no program has to escape it.
pub(super) fn stem(output: &Path, suffix: &str) -> String {
    let name = output.file_name().unwrap_or_default().to_string_lossy();
    let cut = name.len().checked_sub(suffix.len()).filter(|&at| name.is_char_boundary(at)).unwrap_or(name.len());
    let stem = if name[cut..].eq_ignore_ascii_case(suffix) { &name[..cut] } else { &name };
    let plain = |c: char| if c.is_alphanumeric() || c == '-' { c } else { '_' };
    stem.chars().map(plain).collect()
}

/// Writes the splats, meshes and maps of `scene` into the folder of `output`, each file atomically.
///
/// # Errors
/// If a file cannot be written.
pub(super) fn write(output: &Path, stem: &str, scene: &HybridScene) -> Result<Beside, FormatError> {
    let mut beside = Beside::default();
    if !scene.splats.is_empty() {
        beside.splats = Some(beside.add(format!("{stem}_splats.ply"), |name| {
            ply::write(&output.with_file_name(name), &scene.splats).map(|report| report.bytes)
        })?);
    }
    for (i, mesh) in scene.meshes.iter().enumerate() {
        let file = format!("{stem}_mesh{i}.ply");
        let surface = beside.add(file, |name| surface::write(&output.with_file_name(name), mesh))?;
        let maps = (0..sh::coefficients(mesh.atlas().sh_degree())).map(|k| {
            beside.add(format!("{stem}_mesh{i}_sh{k:02}.exr"), |name| {
                write_map(&output.with_file_name(name), mesh.atlas(), k)
            })
        });
        let maps = maps.collect::<Result<_, _>>()?;
        beside.meshes.push(MeshFiles { surface, maps });
    }
    Ok(beside)
}

impl Beside {
    /// Records a file that `write`, given its path, writes; returns the name.
    pub(super) fn add(
        &mut self,
        name: String,
        write: impl FnOnce(&str) -> Result<u64, FormatError>,
    ) -> Result<String, FormatError> {
        self.bytes += write(&name)?;
        self.files.push(name.clone());
        Ok(name)
    }
}

fn write_map(path: &Path, atlas: &Atlas, coefficient: usize) -> Result<u64, FormatError> {
    let failed = |reason: String| FormatError::Write { file: path.to_owned(), source: io::Error::other(reason) };
    let file = match (coefficient, atlas.bands()) {
        (1.., Some(bands)) => exr::encode(bands, 3 * (coefficient - 1), &["R", "G", "B"]),
        _ => exr::encode(atlas.base(), 0, &["R", "G", "B", "A"]),
    };
    let file = file.map_err(failed)?;
    atomic_write(path, &file)?;
    Ok(file.len() as u64)
}
