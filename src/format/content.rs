//! What readers are asked for and what they give, whatever the format.

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
    /// [`write_scene`](super::write_scene) can write it again. Its buffers stay in the file, which is kept open: the file
    /// may be replaced meanwhile, but modifying it in place is an error on use.
    pub keep_document: bool,
    /// Time in seconds at which the animations of a glTF pose the scene and its cameras; `None`: rest pose.
    pub time: Option<f64>,
    /// Animations of a glTF to play, by name, or by index from 0 where no name matches; empty: all, played together.
    pub animations: &'a [String],
}

/// Splats of a format that carries further information about them.
#[derive(Clone, Debug)]
pub struct NotedSplats {
    /// The splats.
    pub splats: Splats,
    /// Pixel filter with which the splats were trained: [`PixelFilter::NORMALIZED_DILATION`] where the file says
    /// *antialiased*.
    pub pixel_filter: PixelFilter,
    /// Notes on content that could not be represented, one sentence each.
    pub notes: Vec<String>,
}

impl NotedSplats {
    pub(super) fn new(splats: Splats, antialiased: bool, notes: Vec<String>) -> Self {
        let pixel_filter = if antialiased { PixelFilter::NORMALIZED_DILATION } else { PixelFilter::DILATION };
        Self { splats, pixel_filter, notes }
    }
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
