//! What readers are asked for and what they give, whatever the format.

use super::attribute::Attribute;
use super::error::Fault;
use super::{cameras, placed};
use crate::scene::{Camera, HybridScene, PixelFilter, Splats};

/// Options of reading.
#[derive(Clone, Copy, Debug, Default)]
pub struct ReadOptions<'a> {
    /// Whether splats with non-finite numbers, zero rotations or negative scales, as written by failed trainings, are
    /// left out instead of refusing the file. Applies to uncompressed `.ply` and to `.splat`; files of other formats
    /// that hold such splats are refused.
    pub drop_invalid: bool,
    /// Whether the document of a glTF is kept in [`SceneFile::source`](super::SceneFile::source), so that
    /// [`write_scene`](super::write_scene) can write it again. Its buffers stay in the file, which is kept open: the
    /// file may be replaced meanwhile, but modifying it in place is an error on use.
    pub keep_document: bool,
    /// Time in seconds at which the animations of a glTF pose the scene and its cameras; `None`: rest pose.
    pub time: Option<f64>,
    /// Animations of a glTF to play, by name, or by index from 0 where no name matches; empty: all, played together.
    pub animations: &'a [String],
}

/// What a file of splats alone says, whatever its format. The splats are in the frame of captures; a format that states
/// no frame is taken to be in it.
#[derive(Clone, Debug, PartialEq)]
pub struct SplatFile {
    /// The splats.
    pub splats: Splats,
    /// Pixel filter with which the splats were trained, [`PixelFilter::DILATION`] unless the file states another: a
    /// `.ply` may state any, SOG and SPZ [`PixelFilter::NORMALIZED_DILATION`], by saying *antialiased*.
    pub pixel_filter: PixelFilter,
    /// Further per-splat attributes, which `.ply` alone has.
    pub attributes: Vec<Attribute>,
    /// Notes on content that could not be represented, and on what was made of content, one sentence each.
    pub notes: Vec<String>,
    /// Number of splats left out; `None` for formats to which [`ReadOptions::drop_invalid`] does not apply: their files
    /// are read entirely or not at all.
    pub dropped: Option<usize>,
}

impl SplatFile {
    /// Content of a file that says nothing of its splats besides.
    pub(super) fn of(splats: Splats) -> Self {
        Self { splats, pixel_filter: PixelFilter::DILATION, attributes: vec![], notes: vec![], dropped: None }
    }
}

/// Pixel filter of splats of which a file says no more than whether they are *antialiased*, as SOG and SPZ do.
pub(super) fn pixel_filter_of(antialiased: bool) -> PixelFilter {
    if antialiased { PixelFilter::NORMALIZED_DILATION } else { PixelFilter::DILATION }
}

/// Content of a file of more than splats. The fields are those of [`SceneFile`](super::SceneFile).
#[derive(Debug)]
pub(super) struct Content {
    pub(super) scene: HybridScene,
    pub(super) states_composition: bool,
    pub(super) cameras: Vec<(String, Camera)>,
    pub(super) notes: Vec<String>,
    pub(super) y_up: bool,
    pub(super) record: Option<serde_json::Value>,
}

impl Content {
    /// What a reader has taken from a file as that has it, in the frame of the capture.
    pub(super) fn in_capture_frame(self) -> Result<Self, Fault> {
        if !self.y_up {
            return Ok(self);
        }
        let scene = placed::half_turned(self.scene).map_err(|e| Fault::from(e).under("/"))?;
        let turned = |(name, camera): (String, Camera)| (name, cameras::turned(&camera));
        let cameras = self.cameras.into_iter().map(turned).collect();
        Ok(Self { scene, cameras, ..self })
    }
}
