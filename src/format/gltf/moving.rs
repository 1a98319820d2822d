//! Animated content of a document: animations, the rig of the scene that they drive, and cameras.

use glam::DMat4;

use super::camera::{self, Cameras};
use super::motion::{self, Clip, Motion};
use super::pose::Poses;
use super::transform::placements_by;
use crate::format::cameras::{CameraFile, Sampling};
use crate::format::error::Fault;
use crate::scene::rig::{Pose, Rig};
use crate::scene::{HybridScene, SceneError};

/// Animation of a scene and its cameras.
#[derive(Clone, Debug)]
pub(in crate::format) struct Moving {
    document: gltf::Document,
    motion: Motion,
    /// Bones and weights of the rig, evaluated from nodes; `None` if only cameras are animated.
    rig: Option<(Poses, Rig)>,
    /// Time in seconds at which the animation has been frozen, if any.
    stopped: Option<f64>,
}

impl Moving {
    pub(super) fn new(document: gltf::Document, motion: Motion, rig: Option<(Poses, Rig)>) -> Self {
        Self { document, motion, rig, stopped: None }
    }

    /// Whether nothing is animated.
    pub(in crate::format) fn is_still(&self) -> bool {
        self.rig.is_none() && self.clips().is_empty()
    }

    /// Freezes the animation at a time, in seconds.
    pub(super) fn stopped(self, time: f64) -> Self {
        Self { rig: None, stopped: Some(time), ..self }
    }

    pub(in crate::format) fn rig(&self) -> Option<&Rig> {
        self.rig.as_ref().map(|(_, rig)| rig)
    }

    /// Evaluates the bones and weights of the rig at a time, in seconds.
    pub(in crate::format) fn pose(&self, time: f64) -> Result<Pose, SceneError> {
        let Some((poses, _)) = &self.rig else { return Ok(Pose::default()) };
        let pose = self.motion.check().and_then(|()| poses.at(&self.document, &self.motion, time));
        pose.map_err(|fault| at_time(fault, time))
    }

    /// Evaluates the scene at a time, in seconds; `rest` is the scene as read, transformed by `moved`.
    pub(super) fn scene(&self, rest: &HybridScene, moved: DMat4, time: f64) -> Result<HybridScene, SceneError> {
        let Some((_, rig)) = &self.rig else { return Ok(rest.clone()) };
        let posed = rig.pose(rest, &self.pose(time)?, moved);
        posed.map_err(|e| SceneError { field: format!("at {time} s: {}", e.field), ..e })
    }

    /// Checks the animations; an error if one is faulty.
    pub(in crate::format) fn check(&self) -> Result<(), Fault> {
        self.motion.check()
    }

    /// Number of nodes of the document, all of which are placed for every pose.
    pub(in crate::format) fn nodes(&self) -> usize {
        self.document.nodes().len()
    }

    /// Cameras, animated ones frame by frame.
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

    /// Per bone, the nearest ancestor joint of the same skin.
    pub(in crate::format) fn bone_parents(&self) -> Vec<Option<usize>> {
        self.poses().map_or_else(Vec::new, Poses::parents)
    }

    /// Bind transform of a skin's joint in the space of the surface; `None` for other bones.
    pub(in crate::format) fn bind(&self, bone: usize) -> Option<DMat4> {
        self.poses()?.bind(bone)
    }

    fn poses(&self) -> Option<&Poses> {
        self.rig.as_ref().map(|(poses, _)| poses)
    }

    /// Frames per second, if the document states them.
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
            format!("/animations: last from {first:.3} to {last:.3} s: outside, the scene is as at the nearer end")
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
    let Fault { location, expected, found } = fault;
    SceneError { field: format!("at {time} s: {}", location.to_string().trim_end_matches([':', ' '])), expected, found }
}
