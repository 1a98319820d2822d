//! Reading of scenes and cameras, whatever the format of the file.

use std::path::Path;

use super::cameras::{ADVICE, CameraFile, Sampling};
use super::content::Content;
use super::error::{Fault, NO_CAMERAS};
use super::notes::grouped;
use super::{Attribute, Format, FormatError, ReadOptions, SplatFile, detect, gltf, ksplat, ply, sog, splat, spz, usd};
use crate::scene::{Camera, Composition, HybridScene};

/// What a file says about a scene, which is in the frame of captures: x to the right, y down, z forward, as COLMAP, INRIA's `.ply` and
/// [`HybridScene`] have it, whatever the frame of the file.
#[derive(Clone, Debug)]
pub struct SceneFile {
    /// Splats, meshes and composition.
    pub scene: HybridScene,
    /// Whether the file states how splats and meshes are blended; otherwise the composition is the default, with as
    /// many layers as the meshes need.
    pub states_composition: bool,
    /// Named cameras, in the frame of the scene.
    pub cameras: Vec<(String, Camera)>,
    /// Notes on content that could not be represented exactly, one sentence each; one of several places names the first
    /// of them.
    pub notes: Vec<String>,
    /// Whether the world of the file is y up, as those of glTF and USD are: the scene and its cameras have been turned from it by
    /// [`OPENGL_FROM_OPENCV`](crate::scene::frame::OPENGL_FROM_OPENCV), and [`write_scene`](super::write_scene) turns them
    /// again. False of files that Centaur wrote, which come back as they were, and of formats that state no frame, which
    /// are taken to be in that of captures.
    pub y_up: bool,
    /// Further per-splat attributes of the file.
    pub attributes: Vec<Attribute>,
    /// Number of splats left out; `None` for formats to which [`ReadOptions::drop_invalid`] does not apply.
    pub dropped: Option<usize>,
    /// Document of a glTF, which contains more than the scene.
    pub source: Option<gltf::Source>,
    /// Centaur's record of how the scene was made, the extras given to [`gltf::write_glb`].
    pub record: Option<serde_json::Value>,
}

impl SceneFile {
    pub(super) fn new(content: Content) -> Self {
        let Content { scene, states_composition, cameras, notes, y_up, record } = content;
        Self {
            scene,
            states_composition,
            cameras,
            notes: grouped(&notes),
            y_up,
            attributes: vec![],
            dropped: None,
            source: None,
            record,
        }
    }

    fn of_splats(SplatFile { splats, pixel_filter, attributes, notes, dropped }: SplatFile) -> Self {
        let composition = Composition { pixel_filter, ..Composition::default() };
        let content = Content {
            scene: HybridScene { splats, meshes: vec![], composition },
            states_composition: false,
            cameras: vec![],
            notes,
            y_up: false,
            record: None,
        };
        Self { attributes, dropped, ..Self::new(content) }
    }
}

/// Reader of a format of splats alone.
type ReadSplats = fn(&Path, &ReadOptions<'_>) -> Result<SplatFile, FormatError>;

/// Reads a hybrid scene from a `.glb`, `.gltf`, `.usda`, `.usdc` or `.usdz` file, or splats alone from a `.ply` (INRIA
/// or compressed), `.sog`, `.spz`, `.splat` or `.ksplat`. Formats are recognised by content, see [`detect()`].
///
/// The scene is in the frame of captures: x to the right, y down, z forward, as OpenCV's cameras have it. glTF and USD of other programs,
/// which are y up, are turned half about x ([`OPENGL_FROM_OPENCV`](crate::scene::frame::OPENGL_FROM_OPENCV));
/// [`write_scene`](super::write_scene) turns them again, so that they stay where they were. What states no frame, as `.ply`, is taken as it is. Rewriting coordinates in other frames is for
/// [`edit::Axes`](crate::edit::Axes).
///
/// # Errors
/// If the file cannot be read or is none of these; see [`gltf`], [`usd`], [`ply::read`], [`sog::read`], [`spz::read`],
/// [`splat::read`] and [`ksplat::read`].
pub fn read_scene(path: &Path) -> Result<HybridScene, FormatError> {
    Ok(read_file(path, &ReadOptions::default())?.scene)
}

/// As [`read_scene`], with what the file says besides; cameras are in the frame of the scene.
///
/// # Errors
/// Those of [`read_scene`], and if a time or animations are given for a file other than glTF.
pub fn read_file(path: &Path, options: &ReadOptions<'_>) -> Result<SceneFile, FormatError> {
    let format = detect(path)?;
    if (options.time.is_some() || !options.animations.is_empty()) && !format.is_gltf() {
        let expected = "a .glb or .gltf, whose animations can be evaluated at a time";
        return Err(Fault::whole(expected, format.name()).in_file(path));
    }
    let read_splats: ReadSplats = match format {
        Format::Glb | Format::Gltf => return read_gltf(path, options),
        Format::Usda | Format::Usdc | Format::Usdz => return usd::read(path).map(SceneFile::new),
        Format::Ply | Format::CompressedPly => ply::read,
        Format::Sog => sog::read,
        Format::Spz => spz::read,
        Format::Splat => splat::read,
        Format::Ksplat => ksplat::read,
        // Never detected.
        Format::Mitsuba | Format::BlendScript => return Err(Fault::whole("a scene", format.name()).in_file(path)),
    };
    read_splats(path, options).map(SceneFile::of_splats)
}

fn read_gltf(path: &Path, options: &ReadOptions<'_>) -> Result<SceneFile, FormatError> {
    let (content, source) = gltf::read(path, options)?;
    Ok(SceneFile { source: Some(source), ..SceneFile::new(content) })
}

/// Reads the cameras of a `.glb`, `.gltf`, `.usda`, `.usdc` or `.usdz` file, ignoring other content. An animated camera
/// becomes as many cameras as the shot has frames, from the first to the last key of its animation.
///
/// # Errors
/// If the file is of none of these formats, cannot be read, is malformed, has no camera, or none of the requested name.
pub fn read_cameras(path: &Path, sampling: &Sampling<'_>) -> Result<CameraFile, FormatError> {
    match detect(path)? {
        Format::Glb | Format::Gltf => gltf::read_cameras(path, sampling),
        Format::Usda | Format::Usdc | Format::Usdz => usd::read_cameras(path, sampling),
        other => {
            let [expected, ..] = NO_CAMERAS;
            Err(Fault::whole(expected, format!("{}; {ADVICE}", other.name())).in_file(path))
        }
    }
}
