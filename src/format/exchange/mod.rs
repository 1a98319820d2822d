//! Files beside the document of an export: what programs that cannot read a hybrid scene are given its parts in.
//!
//! For an output `STEM.…` they are called, in its folder,
//!
//! | file | content |
//! |---|---|
//! | `STEM_splats.ply` | splats in the INRIA layout with (zero) normals, see [`super::ply::write()`] |
//! | `STEM_meshI.ply` | mesh I, see [`surface::write`] |
//! | `STEM_meshI_shKK.exr` | SH coefficient KK of its maps, `R G B` of 32-bit floats; that of 00 also the logit of opacity, `A` |
//!
//! All values are the scene's own, bit for bit: its frame, raw parameters before any activation, colours in the space of
//! blending. The first row of a picture is the top one, which v = 0 belongs to. Coefficient 00 may be of another size than
//! the rest. One picture per coefficient, because most programs take the first four channels of an EXR for RGBA.

pub(super) mod surface;
#[cfg(test)]
mod tests;

use std::io;
use std::path::{Path, PathBuf};

use super::{FormatError, atomic_write, exr, ply};
use crate::atomic::folder_of;
use crate::scene::{Atlas, HybridScene, sh};

/// Names and sizes of what [`write`] wrote. Names are relative to the output's folder.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Beside {
    /// The PLY of the splats, unless there are none.
    pub(super) splats: Option<String>,
    /// One per mesh, in order.
    pub(super) meshes: Vec<MeshFiles>,
    /// All files, in the order in which they were written.
    pub(super) files: Vec<String>,
    /// Size of all.
    pub(super) bytes: u64,
}

/// The files of a mesh.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct MeshFiles {
    /// The PLY.
    pub(super) surface: String,
    /// One EXR per SH coefficient, in the order of [`sh::basis`].
    pub(super) maps: Vec<String>,
}

/// What the names of exports end in whose files beside them are of one kind; the longer first.
const KINDS: [&[&str]; 2] = [&[".stock.xml", ".xml", ".blend.py"], &[".usda"]];

/// Another export, whose files beside it have the names of those of an output.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Sharing {
    /// The export.
    pub path: PathBuf,
    /// Its own name differs from that of the output by no more than what it is for (`a.xml`, `a.blend.py`): not only where characters that are
    /// not letters became `_`.
    pub is_of_one_name: bool,
}

/// What lies in the folder of `output` and shares its files with it, by name.
///
/// # Errors
/// If the folder cannot be listed.
pub fn sharing(output: &Path) -> io::Result<Vec<Sharing>> {
    let named = |path: &Path| -> Option<(usize, String, String)> {
        let name = path.file_name()?.to_string_lossy().into_owned();
        let ends = |suffix: &&&str| name.to_lowercase().ends_with(**suffix);
        let of = |kind: usize| KINDS[kind].iter().find(ends).map(|suffix| (kind, suffix.len()));
        let (kind, length) = of(0).or_else(|| of(1))?;
        let own = name.get(..name.len() - length)?.to_owned();
        Some((kind, stem(path, &name[own.len()..]), own))
    };
    let Some((kind, prefix, own)) = named(output) else { return Ok(vec![]) };
    let mut found = vec![];
    for entry in folder_of(output).read_dir()? {
        let path = output.with_file_name(entry?.file_name());
        if let Some(other) = named(&path).filter(|other| (other.0, &other.1) == (kind, &prefix))
            && path.file_name() != output.file_name()
        {
            found.push(Sharing { path, is_of_one_name: other.2 == own });
        }
    }
    found.sort_by(|a, b| a.path.cmp(&b.path));
    Ok(found)
}

/// What the names of the files beside `output` begin with: the part of its name before `suffix` (`.xml`), which may be in
/// any case, with `_` for all but letters, digits and `-`, so that no program has to escape it.
pub(super) fn stem(output: &Path, suffix: &str) -> String {
    let name = output.file_name().unwrap_or_default().to_string_lossy();
    let cut = name.len().checked_sub(suffix.len()).filter(|&at| name.is_char_boundary(at)).unwrap_or(name.len());
    let stem = if name[cut..].eq_ignore_ascii_case(suffix) { &name[..cut] } else { &name };
    let plain = |c: char| if c.is_alphanumeric() || c == '-' { c } else { '_' };
    stem.chars().map(plain).collect()
}

/// Writes the splats, meshes and maps of `scene` into the folder of `output`, each file whole or not at all.
///
/// # Errors
/// If a file cannot be written.
pub(super) fn write(output: &Path, stem: &str, scene: &HybridScene) -> Result<Beside, FormatError> {
    let mut beside = Beside::default();
    if !scene.splats.is_empty() {
        beside.splats = Some(
            beside.add(format!("{stem}_splats.ply"), |name| ply::write(&output.with_file_name(name), &scene.splats))?,
        );
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
    /// Makes a note of a file that `write`, given its name, writes; returns the name.
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
