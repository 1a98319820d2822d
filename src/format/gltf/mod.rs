//! glTF 2.0: hybrid scenes as a core mesh and a `KHR_gaussian_splatting` primitive, tied together by
//! `EXT_gaussian_splatting_hybrid`, whose schemas lie in `schema/`.
//!
//! Any glTF viewer shows the meshes with an 8-bit unlit base colour and the splats as coloured points; a splat viewer
//! shows the splats; Centaur reads back exactly what it wrote.

mod accessor;
pub(super) mod extension;
mod glb;
mod image;
mod lift;
mod material;
mod read;
mod sizes;
#[cfg(test)]
mod tests;
mod transform;
pub(super) mod triangles;
mod write;

use std::path::Path;

pub(super) use image::{Texels, decode};
pub(super) use lift::{Asset, UNDERSTOOD, resolve};
pub(super) use read::scene as scene_of;
pub(super) use sizes::bytes_by_part;
pub(super) use transform::{Similarity, placements, similarity};

use super::{FormatError, SceneFile};
use crate::scene::{Camera, HybridScene};

/// Writes a binary glTF; returns the file's size in bytes. `extras` goes to `asset.extras.centaur` (metrics, settings).
///
/// Scales and opacities are stored linear in f32, as `KHR_gaussian_splatting` demands: log-scales come back to 1e-6,
/// opacities to 1e-7 (logits stay finite). Everything else that is optimised comes back bit for bit.
///
/// # Errors
/// If the file cannot be written, or would exceed the 4 GiB that the container can address.
pub fn write_glb(
    path: &Path,
    scene: &HybridScene,
    cameras: &[(String, Camera)],
    extras: Option<serde_json::Value>,
) -> Result<u64, FormatError> {
    write::write(path, scene, cameras, extras)
}

/// Reads a `.glb` or `.gltf` file: hybrids, plain `KHR_gaussian_splatting` files, plain textured meshes.
///
/// # Errors
/// If the file cannot be read, is not valid glTF 2.0, requires an extension that is not understood here, or holds
/// splats that cannot be represented (another kernel, a node that shears them, values that are not finite).
pub fn read(path: &Path) -> Result<SceneFile, FormatError> {
    let asset = Asset::open(path)?;
    read::scene(&asset).map_err(|fault| fault.in_file(path))
}
