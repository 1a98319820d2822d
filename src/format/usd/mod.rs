//! OpenUSD: `.usda`, a layer as text; `.usdz`, a package of a layer and its images; and `.usdc`, a binary layer, which
//! is read only.
//!
//! * Splats are a `ParticleField3DGaussianSplat` (OpenUSD ≥ 26.3): linear scales and opacities, SH in the order of
//!   `scene::sh::basis`, sorted by depth.
//! * Meshes are `UsdGeomMesh` with UVs per corner and a `UsdPreviewSurface` whose emission and opacity show the maps
//!   without view dependence in 8 bits. The maps themselves are stored beside the layer as EXR of 32-bit floats
//!   (`centaur:baseMap`, `centaur:bandsMap`).
//! * Cameras are `UsdGeomCamera`; an off-centre principal point is an aperture offset.
//! * The composition is stored in attributes `centaur:*` of the default prim.
//! * The training record is JSON in the string `centaur` of `customLayerData`.
//!
//! Files are y up: a capture's world is rotated by half a turn about x, including SH and maps.
//!
//! Splats, meshes and cameras of other programs are converted to metres. One layer is read, with what its prims inherit,
//! refer to or specialise in it and with the variants that it selects; what would have to be composed of several layers
//! is named in the notes. Files are refused that are malformed or hold splats that cannot be represented: a transform
//! that flattens them, non-finite values.
//!
//! A `.usda` is written with its pictures beside it, under names that begin with its own. Scales and opacities are
//! stored linearly in f32, as the schema requires: log-scales are recovered to 1e-6, opacities to 1e-7, all other
//! optimised values bit for bit.
//!
//! ```text
//! file ──→ package ──→ lex, parse ──→ document ──→ compose ──→ stage, xform, to_scene (splats, surfaces, …) ──→ scene
//!                └───→ binary ──────────┘
//! file ←── package ←── print ←─────── document ←── from_scene, maps ←────────────────────────────────────────── scene
//! ```

mod binary;
mod compose;
#[cfg(test)]
mod compose_tests;
mod counts;
mod document;
mod extent;
mod foreign;
mod frame;
mod from_scene;
mod inherited;
mod lex;
mod maps;
#[cfg(test)]
mod material_tests;
mod materials;
mod names;
mod package;
mod parse;
mod primvar;
mod print;
mod shot;
mod splats;
mod stage;
mod surfaces;
#[cfg(test)]
mod tests;
#[cfg(test)]
mod text_tests;
mod to_scene;
mod views;
mod xform;

use std::path::Path;

use self::document::{Layer, Specifier};
use self::materials::Materials;
use self::package::{Opened, Place, located};
use self::stage::Stage;
use super::cameras::{CameraFile, Sampling};
use super::content::Content;
use super::error::Fault;
use super::{Format, FormatError, atomic_write, atomic_write_with, exchange};
use crate::scene::{Camera, ColorSpace, HybridScene};

/// Reads a `.usda`, `.usdc`, `.usd` or `.usdz` file in the frame of captures, y down, see [`super::SceneFile::y_up`].
///
/// # Errors
/// If the file cannot be read, or is refused for what it holds.
pub(super) fn read(path: &Path) -> Result<Content, FormatError> {
    let Opened { layer, mut place, member } = package::open(path)?;
    let scene = composed(layer).and_then(|(layer, left_out)| {
        let mut content = to_scene::scene(&layer, &mut place)?;
        content.notes.extend(left_out);
        content.in_capture_frame()
    });
    scene.map_err(|fault| located(fault, member.as_ref()).in_file(path))
}

/// Violation of a USD rule by a layer.
pub(super) struct Breach {
    /// Code of the rule, for scripts.
    pub(super) code: &'static str,
    /// Whether the rule is mandatory; false for content that is allowed but rarely intended.
    pub(super) is_error: bool,
    pub(super) fault: Fault,
}

/// All faults of a file: the one at which its reader stops, if any, and those that readers tolerate.
///
/// # Errors
/// If the file cannot be read, or is neither a layer nor a package of one.
pub(super) fn breaches(path: &Path) -> Result<Vec<Breach>, FormatError> {
    let Opened { layer, mut place, member } = package::open(path)?;
    let mut found = vec![];
    let stopped = match composed(layer) {
        Err(fault) => Some(fault),
        Ok((layer, _)) => {
            let stage = Stage::new(&layer);
            let mut materials = Materials::new(&mut place, ColorSpace::default());
            // Prims other than definitions may rely on the prims that they override.
            for prim in (0..stage.prims.len()).filter(|&i| stage.prims[i].specifier == Specifier::Def) {
                counts::check(&stage, prim, &mut found);
                found.extend(extent::check(&stage, prim));
                found.extend(materials::check(&stage, prim, &mut materials));
            }
            to_scene::scene(&layer, &mut place).err()
        }
    };
    // Reported once if both checks find the same fault.
    if let Some(fault) = stopped.filter(|fault| !found.iter().any(|breach| breach.fault.location == fault.location)) {
        found.insert(0, Breach { code: "CONTENT", is_error: true, fault });
    }
    found.iter_mut().for_each(|breach| breach.fault = located(breach.fault.clone(), member.as_ref()));
    Ok(found)
}

/// Total length of the files beside a layer to which its properties refer, see [`super::stored_bytes`]; 0 for a
/// package.
pub(super) fn bytes_beside(path: &Path) -> Result<u64, FormatError> {
    let Opened { layer, place, .. } = package::open(path)?;
    let Place::Folder(folder) = place else { return Ok(0) };
    let (layer, _) = composed(layer).map_err(|fault| fault.in_file(path))?;
    Ok(package::bytes_of_files(Stage::new(&layer).assets(), &folder))
}

/// Parses a layer and follows its arcs; also returns notes on those within the layer that cannot be followed.
fn composed(layer: Vec<u8>) -> Result<(Layer, Vec<String>), Fault> {
    document(layer).and_then(compose::composed)
}

/// Parses a layer in text or binary form.
#[expect(clippy::needless_pass_by_value, reason = "large, and of no use any more")]
fn document(layer: Vec<u8>) -> Result<Layer, Fault> {
    if layer.starts_with(binary::MAGIC) { binary::parse(&layer) } else { parse::parse(&layer) }
}

/// Writes a `.usdz`, if that is the path's extension, else a `.usda` and its pictures beside it, under names that begin
/// with its own. Every file is written whole or not at all, the layer last. Returns the size of all in bytes, and the
/// names of the pictures. `record` is kept, see [`super::SceneFile::record`]. The scene is in the frame of captures, y
/// down, and turned half about x.
///
/// # Errors
/// If a file cannot be written, a `.usdz` would hold a file of more than 4 GiB, or the composition is not valid.
pub(super) fn write(
    path: &Path,
    scene: &HybridScene,
    cameras: &[(String, Camera)],
    record: Option<&serde_json::Value>,
) -> Result<(u64, Vec<String>), FormatError> {
    scene.composition.validate().map_err(|e| Fault::from(e).in_file(path))?;
    let is_package = Format::of_path(path) == Some(Format::Usdz);
    let prefix = if is_package { String::new() } else { format!("{}_", exchange::stem(path, ".usda")) };
    let failed = |reason| FormatError::Write { file: path.to_owned(), source: std::io::Error::other(reason) };
    let export = from_scene::export(scene, cameras, record, &prefix).map_err(failed)?;
    if is_package {
        let bytes = atomic_write_with(path, |out| {
            package::write(out, |layer| print::print(&export.layer, layer), &export.files)
        })?;
        return Ok((bytes, vec![]));
    }
    let mut bytes = 0;
    for (name, content) in &export.files {
        atomic_write(&path.with_file_name(name), content)?;
        bytes += content.len() as u64;
    }
    bytes += atomic_write_with(path, |out| print::print(&export.layer, out))?;
    Ok((bytes, export.files.into_iter().map(|(name, _)| name).collect()))
}

/// Reads the cameras only, animated ones frame by frame.
pub(super) fn read_cameras(path: &Path, sampling: &Sampling<'_>) -> Result<CameraFile, FormatError> {
    let Opened { layer, member, .. } = package::open(path)?;
    let cameras = composed(layer).and_then(|(layer, _)| shot::read(layer, sampling));
    cameras.map_err(|fault| located(fault, member.as_ref()).in_file(path))
}

/// Writes cameras, given in the capture's frame, as one animated camera.
pub(super) fn write_cameras(path: &Path, cameras: &CameraFile) -> Result<u64, FormatError> {
    let layer = shot::layer(cameras);
    atomic_write_with(path, |out| print::print(&layer, out))
}

/// Format of a file that begins with `start`, if it is a layer, in text or binary form, or a package of one.
pub(super) fn format_of(start: &[u8]) -> Option<Format> {
    if start.starts_with(b"#usda") {
        Some(Format::Usda)
    } else if start.starts_with(binary::MAGIC) {
        Some(Format::Usdc)
    } else {
        package::is_package(start).then_some(Format::Usdz)
    }
}
