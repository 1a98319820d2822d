//! What of a document is played: animations, the rig of the scene that they move, and cameras.

use glam::DMat4;

use super::camera::{self, Cameras};
use super::motion::{self, Clip, Motion};
use super::pose::Poses;
use super::transform::placements_by;
use crate::format::cameras::{CameraFile, Sampling};
use crate::format::error::Fault;
use crate::scene::rig::{Pose, Rig};
use crate::scene::{HybridScene, SceneError};

/// What moves a scene and its cameras.
#[derive(Clone, Debug)]
pub(in crate::format) struct Moving {
    document: gltf::Document,
    motion: Motion,
    /// Bones and weights of the rig by nodes; `None` if nothing but cameras moves.
    rig: Option<(Poses, Rig)>,
    /// The time at which all of it has been stopped.
    stopped: Option<f64>,
}

impl Moving {
    pub(super) fn new(document: gltf::Document, motion: Motion, rig: Option<(Poses, Rig)>) -> Self {
        Self { document, motion, rig, stopped: None }
    }

    /// Whether there is nothing to be played.
    pub(in crate::format) fn is_still(&self) -> bool {
        self.rig.is_none() && self.clips().is_empty()
    }

    /// The same with everything where it is at a time, in seconds, whenever it is looked at.
    pub(super) fn stopped(self, time: f64) -> Self {
        Self { rig: None, stopped: Some(time), ..self }
    }

    pub(in crate::format) fn rig(&self) -> Option<&Rig> {
        self.rig.as_ref().map(|(_, rig)| rig)
    }

    /// Bones and weights of the rig at a time, in seconds.
    pub(in crate::format) fn pose(&self, time: f64) -> Result<Pose, SceneError> {
        let Some((poses, _)) = &self.rig else { return Ok(Pose::default()) };
        let pose = self.motion.check().and_then(|()| poses.at(&self.document, &self.motion, time));
        pose.map_err(|fault| at_time(fault, time))
    }

    /// The scene at a time; `rest` is as it was read, and then moved by `moved`.
    pub(super) fn scene(&self, rest: &HybridScene, moved: DMat4, time: f64) -> Result<HybridScene, SceneError> {
        let Some((_, rig)) = &self.rig else { return Ok(rest.clone()) };
        let posed = rig.pose(rest, &self.pose(time)?, moved);
        posed.map_err(|e| SceneError { field: format!("at {time} s: {}", e.field), ..e })
    }

    /// Error if anything is wrong with an animation.
    pub(in crate::format) fn check(&self) -> Result<(), Fault> {
        self.motion.check()
    }

    /// How many nodes the document has, which are placed for every pose.
    pub(in crate::format) fn nodes(&self) -> usize {
        self.document.nodes().len()
    }

    /// The cameras, those that move frame by frame.
    pub(in crate::format) fn cameras(&self, sampling: &Sampling<'_>) -> Result<CameraFile, Fault> {
        self.motion.check()?;
        motion::cameras(&self.document, &self.motion, &Sampling { time: self.stopped.or(sampling.time), ..*sampling })
    }

    /// The cameras at a time, in seconds, and what is to be said of them.
    pub(in crate::format) fn cameras_at(&self, time: f64) -> Result<(Cameras, Vec<String>), Fault> {
        self.motion.check()?;
        let (time, mut notes) = (self.stopped.unwrap_or(time), vec![]);
        let placed = placements_by(&self.document, |node| self.motion.local(node, time))?;
        Ok((camera::all(&self.document, &placed, &mut notes), notes))
    }

    /// Per bone, the joint of the same skin that is next above it.
    pub(in crate::format) fn bone_parents(&self) -> Vec<Option<usize>> {
        self.poses().map_or_else(Vec::new, Poses::parents)
    }

    /// Where a joint of a skin is in the space of the surface; `None` of other bones.
    pub(in crate::format) fn bind(&self, bone: usize) -> Option<DMat4> {
        self.poses()?.bind(bone)
    }

    fn poses(&self) -> Option<&Poses> {
        self.rig.as_ref().map(|(poses, _)| poses)
    }

    /// Frames a second, if the document states them.
    pub(in crate::format) fn fps(&self) -> Option<f64> {
        self.motion.fps()
    }

    /// As [`Motion::overruled`].
    pub(in crate::format) fn overruled(&self) -> Option<String> {
        self.motion.overruled()
    }

    /// Says so if a time is before the first key of all or after the last, by more than a thousandth of a second.
    pub(super) fn outside(&self, [start, end]: [f64; 2]) -> Option<String> {
        let [first, last] = self.range();
        let is_outside = !self.is_still() && (start < first - 1e-3 || end > last + 1e-3);
        is_outside.then(|| {
            format!("/animations: last from {first:.3} to {last:.3} s: beyond that all is as at the nearer end")
        })
    }

    /// First and last key of all animations and deformations.
    pub(in crate::format) fn range(&self) -> [f64; 2] {
        let deformations = self.poses().into_iter().flat_map(Poses::ranges);
        let ranges = self.clips().iter().map(|clip| clip.range).chain(deformations);
        ranges.reduce(|[a, b], [c, d]| [a.min(c), b.max(d)]).unwrap_or_default()
    }

    pub(super) fn clips(&self) -> &[Clip] {
        if self.stopped.is_none() { self.motion.clips() } else { &[] }
    }
}

fn at_time(fault: Fault, time: f64) -> SceneError {
    let (location, expected, found) = fault.into_parts();
    SceneError { field: format!("at {time} s: {}", location.to_string().trim_end_matches([':', ' '])), expected, found }
}
