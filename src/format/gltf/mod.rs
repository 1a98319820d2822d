//! glTF 2.0 reader and writer: hybrid scenes as a core mesh and a `KHR_gaussian_splatting` primitive, connected by
//! `EXT_gaussian_splatting_hybrid`, whose schemas are in `schema/`.
//!
//! Any glTF viewer shows the meshes with an 8-bit unlit base colour and the splats as coloured points; a splat viewer
//! shows the splats; Centaur reads back exactly what it wrote.
//!
//! Hybrids are read, and plain `KHR_gaussian_splatting` files, and plain textured meshes:
//!
//! | of glTF | becomes |
//! |---|---|
//! | node transforms | part of positions, splats and cameras; harmonics turn along |
//! | splats, and meshes with view-dependent colour, below flat transforms | nothing, with a note; where the node moves, what poses show that give it an extent |
//! | nodes that `KHR_node_visibility` makes invisible | nothing, with what is below, and a note |
//! | copies by `EXT_mesh_gpu_instancing` | part of meshes and splats; where the node has a skin or splats are bound, one is shown, with a note |
//! | primitives without `POSITION` | nothing, with a note |
//! | skins, morph targets | the mesh in its rest pose: joints as they stand, default weights; see [`Source::at`] |
//! | animations | what [`Source::at`] poses the scene by |
//! | bindings of splats | what splats follow in other poses; in the rest pose splats are as they are stored; those that do not hold are ignored, with a note |
//! | deformation fields | nothing, with a note |
//! | materials | the hybrid extension's maps, else the base colour (by `KHR_materials_pbrSpecularGlossiness` the diffuse colour), or the emission of what is black or has no other picture, unlit; `alphaMode`, `KHR_texture_transform` and repeats are drawn into maps; pictures of the core that cannot be had are left out, with a note |
//! | single-sided materials | seen from both sides, with a note |
//! | `COLOR_0` | a map, with a note if its texture coordinates replace others; beside a texture a factor where it is one colour, else it is left out, with a note |
//! | splats | attributes in any component type the extension allows, or SPZ (`KHR_gaussian_splatting_compression_spz_2`) |
//! | cameras | pinholes; orthographic ones are left out, with a note |
//!
//! Files are refused that are no valid glTF 2.0, require an extension that is not understood here, or hold splats that
//! cannot be represented: another kernel, values that are not finite.

mod accessor;
#[cfg(test)]
mod accessor_tests;
pub(super) mod binding;
#[cfg(test)]
mod binding_tests;
mod buffer;
mod camera;
mod container;
#[cfg(test)]
mod core_tests;
pub(super) mod extension;
mod glb;
mod image;
pub(super) mod instancing;
#[cfg(test)]
mod instancing_tests;
mod integers;
pub(super) mod json;
mod lift;
mod material;
#[cfg(test)]
mod material_tests;
mod merge;
mod meshes;
pub(super) mod meshopt;
mod motion;
pub(super) mod moving;
#[cfg(test)]
mod moving_tests;
mod nodes;
#[cfg(test)]
mod nodes_tests;
mod pose;
mod read;
mod remainder;
mod shot;
mod sizes;
mod source;
#[cfg(test)]
mod source_tests;
#[cfg(test)]
mod splat_tests;
mod splats;
#[cfg(test)]
mod tests;
mod transform;
mod tree;
pub(super) mod triangles;
mod uri;
mod uv;
mod vertex_color;
mod write;

use std::path::Path;

use glam::DMat4;

pub(super) use image::{Texels, decode, media_type};
pub(super) use integers::write_as_integers;
pub(super) use lift::{Asset, expected_for};
pub use motion::Clip;
pub(super) use motion::Motion;
pub(super) use pose::Poses;
pub(super) use read::{not_placed, scene as scene_of};
pub use remainder::{Remnant, Role};
pub(super) use sizes::{Sizes, sizes};
pub(super) use source::COPYRIGHT;
pub use source::Source;
pub(super) use transform::{is_ours, placements};
pub(super) use tree::document as describe;
pub use tree::{Document, Node, Primitive};
pub(super) use uri::{Loaded, bytes_of_files, resolve};
pub(super) use uv::{Unrolling, UvMap};

use super::cameras::{CameraFile, Sampling};
use super::content::Content;
use super::error::Fault;
use super::{FormatError, ReadOptions};
use crate::scene::frame::HALF_TURN;
use crate::scene::{Camera, Composition, HybridScene, Splats};

/// Writes glTF; returns the file's size in bytes. A name that ends in `.gltf` gives JSON with everything embedded, any
/// other a binary glTF. `extras` goes to `asset.extras.centaur` (metrics, settings). The scene is in the frame of
/// captures, y down; below a root node of ours it is turned half about x.
///
/// Scales and opacities are stored linearly in f32, as `KHR_gaussian_splatting` requires: log-scales are recovered to
/// 1e-6, opacities to 1e-7 (logits stay finite). All other optimised values are recovered bit for bit.
///
/// # Errors
/// If the file cannot be written, would exceed the container's limit of 4 GiB, or the composition is not valid.
pub fn write_glb(
    path: &Path,
    scene: &HybridScene,
    cameras: &[(String, Camera)],
    extras: Option<serde_json::Value>,
) -> Result<u64, FormatError> {
    write_anew(path, scene, cameras, (extras, None))
}

/// As [`write_glb`], with extras and a copyright.
///
/// # Errors
/// Those of [`write_glb`].
pub(super) fn write_anew(
    path: &Path,
    scene: &HybridScene,
    cameras: &[(String, Camera)],
    (extras, copyright): (Option<serde_json::Value>, Option<&str>),
) -> Result<u64, FormatError> {
    scene.composition.validate().map_err(|e| Fault::from(e).in_file(path))?;
    let (mut document, bin) = write::layout(scene, cameras, extras);
    if let Some(copyright) = copyright {
        document["asset"]["copyright"] = copyright.into();
    }
    container::write(path, document, &bin)
}

/// As [`write_glb`], on the ground of the document that the scene was read from: all of it is written where it stands
/// ([`Source::stands`]), else what of it concerns the file as a whole, with this record in place of its own. Also
/// returns which of both.
///
/// # Errors
/// Those of [`write_glb`].
pub(super) fn write_over(
    path: &Path,
    scene: &HybridScene,
    cameras: &[(String, Camera)],
    (source, record): (&Source, Option<&serde_json::Value>),
) -> Result<(u64, bool), FormatError> {
    if source.stands(scene, cameras) {
        let (document, bin) = source.document(scene, cameras);
        return Ok((container::write(path, document, &bin)?, true));
    }
    let (mut document, bin) = write::layout(scene, cameras, None);
    source.carry_over(&mut document, record);
    Ok((container::write(path, document, &bin)?, false))
}

/// Reads a `.glb` or `.gltf` file. The scene is in the frame of captures, y down, see [`super::SceneFile::y_up`];
/// options keep the document for [`super::write_scene`], leaving its buffers in the file, and pose the scene.
///
/// # Errors
/// If the file cannot be read, or is refused for what it holds.
pub(super) fn read(path: &Path, options: &ReadOptions<'_>) -> Result<(Content, Source), FormatError> {
    let (stored, mut source) = read_as_stored(path, options)?;
    let is_turned = stored.y_up;
    let content = stored.in_capture_frame().map_err(|fault| fault.in_file(path))?;
    if is_turned {
        source.follow(HALF_TURN, &content.scene, &content.cameras);
    }
    Ok((content, source))
}

/// The same in the frame of the document, which is glTF's unless it is ours.
fn read_as_stored(path: &Path, options: &ReadOptions<'_>) -> Result<(Content, Source), FormatError> {
    let asset = Asset::open(path)?;
    let located = |fault: Fault| fault.in_file(path);
    let (mut content, mut moving) = read::scene_and_motion(&asset, options.animations).map_err(located)?;
    let mut keep = options.keep_document;
    if let Some(time) = options.time {
        let (cameras, notes) = moving.cameras_at(time).map_err(located)?;
        content.cameras = cameras;
        notes.into_iter().for_each(|note| {
            if !content.notes.contains(&note) {
                content.notes.push(note);
            }
        });
        content.notes.extend(moving.overruled().into_iter().chain(moving.outside([time; 2])));
        if moving.is_still() {
            content.notes.push(format!("/animations: there are none: at {time} s the scene is in its rest pose"));
        }
        let posed = moving.scene(&content.scene, DMat4::IDENTITY, time);
        content.scene = posed.map_err(|e| located(e.into()))?;
        // A posed scene is static, and no longer matches its document.
        keep &= moving.is_still();
        moving = moving.stopped(time);
    }
    let mut source = Source::new(asset, &content.scene, &content.cameras, moving, keep);
    if options.time.is_some() {
        source.forget(|role| matches!(role, Role::Moves | Role::Follows));
    }
    content.record = source.extras().cloned();
    Ok((content, source))
}

/// Reads the cameras only, animated ones frame by frame.
pub(super) fn read_cameras(path: &Path, sampling: &Sampling<'_>) -> Result<CameraFile, FormatError> {
    let asset = Asset::open(path)?;
    asset.check_version().map_err(|fault| fault.in_file(path))?;
    let motion = Motion::read(&asset, |_| true);
    motion.check().map_err(|fault| fault.in_file(path))?;
    motion::cameras(&asset.document, &motion, sampling).map_err(|fault| fault.in_file(path))
}

/// Writes cameras as one animated camera, in a document in the capture's frame.
pub(super) fn write_cameras(path: &Path, cameras: &CameraFile) -> Result<u64, FormatError> {
    let composition = Composition::default();
    let nothing = HybridScene { splats: Splats::empty(0), meshes: vec![], composition };
    let (mut document, mut bin) = write::layout(&nothing, &[], None);
    let near = cameras.near.unwrap_or(composition.near);
    shot::append(&mut document, &mut bin, &cameras.clone().in_frame(false), near);
    container::write(path, document, &bin)
}

/// Writes the document of a glTF again with an added animated camera, which replaces previously added ones.
pub(super) fn write_with_cameras(path: &Path, scene: &Path, cameras: &CameraFile) -> Result<u64, FormatError> {
    let options = ReadOptions { keep_document: true, ..ReadOptions::default() };
    let (content, source) = read_as_stored(scene, &options)?;
    let (mut document, mut bin) = source.as_read();
    let near = cameras.near.unwrap_or(content.scene.composition.near);
    shot::append(&mut document, &mut bin, &cameras.clone().in_frame(content.y_up), near);
    container::write(path, document, &bin)
}
