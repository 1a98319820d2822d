//! Animations: what they make of nodes and of the weights of morph targets at a time, and the cameras that they move.

use std::collections::HashMap;
use std::collections::hash_map::Entry;

use glam::{DMat4, DQuat, DVec3, DVec4};
use gltf::animation::{Interpolation, Property};
use gltf::json::validation::Checked;
use serde::Serialize;
use serde_json::Value;

use super::camera;
use super::extension::EXTRAS;
use super::lift::Asset;
use super::shot::FPS;
use super::transform::{FLIP, is_ours, local, placements, placements_by};
use crate::format::cameras::{CameraFile, DEFAULT_FPS, Found, Sampling, chosen, frame_count};
use crate::format::error::Fault;
use crate::scene::Camera;

/// The cameras of a document.
pub(super) fn cameras(
    document: &gltf::Document,
    motion: &Motion,
    sampling: &Sampling<'_>,
) -> Result<CameraFile, Fault> {
    let placed = match sampling.time {
        Some(time) => placements_by(document, |node| motion.local(node, time))?,
        None => placements(document)?,
    };
    let nodes: Vec<gltf::Node<'_>> = document.nodes().collect();
    let mut parents: HashMap<usize, usize> = HashMap::new();
    for (node, _) in &placed {
        parents.extend(node.children().map(|child| (child.index(), node.index())));
    }
    let is_ours = is_ours(document);
    let frame = if is_ours { FLIP } else { DMat4::IDENTITY };
    let (mut found, mut notes) = (vec![], vec![]);
    for (node, transform) in &placed {
        let Some(optics) = node.camera() else { continue };
        let name = node.name().or(optics.name()).map_or_else(|| format!("camera_{}", found.len()), str::to_owned);
        let at = format!("/nodes/{}", node.index());
        // From the node upwards.
        let chain: Vec<usize> =
            std::iter::successors(Some(node.index()), |child| parents.get(child).copied()).collect();
        let Some((start, end)) = motion.range(&chain).filter(|_| sampling.time.is_none()) else {
            match camera::read(document, optics.index(), *transform) {
                Ok((camera, note)) => {
                    notes.extend(note.map(|note| format!("{at}: {note}")));
                    found.push(Found { name, frames: vec![camera], start: 0.0, fps: None });
                }
                Err(reason) => notes.push(format!("{at}: camera left out: {reason}")),
            }
            continue;
        };
        let fps = sampling.fps.or(motion.fps).unwrap_or(DEFAULT_FPS);
        let count = frame_count(start, end, fps).map_err(|fault| fault.under(&at))?;
        let frames = (0..count).map(|i| -> Result<(Camera, Option<String>), String> {
            let time = start + i as f64 / fps;
            let in_world = chain.iter().fold(DMat4::IDENTITY, |below, &n| motion.local(&nodes[n], time) * below);
            camera::read(document, optics.index(), frame * in_world).map_err(|reason| format!("{reason}, at {time} s"))
        });
        match frames.collect::<Result<Vec<_>, _>>() {
            Ok(frames) => {
                notes.extend(frames[0].1.as_ref().map(|note| format!("{at}: {note}")));
                let frames = frames.into_iter().map(|(camera, _)| camera).collect();
                found.push(Found { name, frames, start, fps: Some(fps) });
            }
            Err(reason) => notes.push(format!("{at}: camera left out: {reason}")),
        }
    }
    if let (true, Some(reason)) = (found.is_empty(), notes.first()) {
        return Err(Fault::pointer("/cameras", "a camera", reason.clone()));
    }
    chosen(found, sampling, !is_ours, notes).map_err(|fault| fault.under("/cameras"))
}

/// What moves nodes and weighs their morph targets.
#[derive(Clone, Debug, Default)]
pub(in crate::format) struct Motion {
    tracks: HashMap<(usize, Part), Track>,
    /// Frames a second, if the file is ours.
    fps: Option<f64>,
    /// What there is to be played, in order.
    clips: Vec<Clip>,
}

/// An animation of a document.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Clip {
    /// Its name.
    pub name: Option<String>,
    /// Its first key and its last, in seconds.
    pub range: [f64; 2],
    /// How many properties of nodes it moves.
    pub channels: usize,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
enum Part {
    Translation,
    Rotation,
    Scale,
    Weights,
}

/// Keys of one of these.
#[derive(Clone, Debug)]
struct Track {
    /// Seconds, growing; at least one.
    times: Vec<f64>,
    /// `width` numbers a key, or three times as many: tangent before it, value, tangent after it.
    values: Vec<f64>,
    width: usize,
    interpolation: Interpolation,
}

impl Motion {
    /// Of all animations together; of two that move the same, the first.
    pub(super) fn read(asset: &Asset) -> Result<Self, Fault> {
        let mut motion = Self::default();
        let json = asset.document.as_json();
        for (a, animation) in json.animations.iter().enumerate() {
            let mut range: Option<[f64; 2]> = None;
            for (c, channel) in animation.channels.iter().enumerate() {
                let at = format!("/animations/{a}/channels/{c}");
                // The crate checks no index of a target.
                let (node, sampler) = (channel.target.node.value(), animation.samplers.get(channel.sampler.value()));
                let (Some(sampler), Checked::Valid(property), true) =
                    (sampler, channel.target.path, node < json.nodes.len())
                else {
                    return Err(Fault::pointer(at, "a sampler, and a node that has what it moves", "another channel"));
                };
                let part = match property {
                    Property::Translation => Part::Translation,
                    Property::Rotation => Part::Rotation,
                    Property::Scale => Part::Scale,
                    Property::MorphTargetWeights => Part::Weights,
                };
                let track = Track::read(asset, sampler, part, &at)?;
                let [first, last] = track.range();
                range = Some(range.map_or([first, last], |[a, b]| [a.min(first), b.max(last)]));
                if let Entry::Vacant(slot) = motion.tracks.entry((node, part)) {
                    slot.insert(track);
                }
            }
            let (name, channels) = (animation.name.clone(), animation.channels.len());
            motion.clips.extend(range.map(|range| Clip { name, range, channels }));
            let stated = asset.root.pointer(&format!("/animations/{a}/extras/{EXTRAS}/{FPS}"));
            motion.fps = motion.fps.or(stated.and_then(Value::as_f64).filter(|fps| *fps > 0.0));
        }
        Ok(motion)
    }

    pub(super) fn fps(&self) -> Option<f64> {
        self.fps
    }

    pub(super) fn clips(&self) -> &[Clip] {
        &self.clips
    }

    /// First and last key of what moves these nodes; `None` if nothing does.
    fn range(&self, nodes: &[usize]) -> Option<(f64, f64)> {
        let tracks = nodes.iter().flat_map(|&node| TRANSFORM.map(|part| self.tracks.get(&(node, part)))).flatten();
        tracks.map(Track::range).map(|[a, b]| (a, b)).reduce(|a, b| (a.0.min(b.0), a.1.max(b.1)))
    }

    /// Whether the transform of a node itself is animated.
    pub(super) fn has_transform(&self, node: usize) -> bool {
        TRANSFORM.iter().any(|part| self.tracks.contains_key(&(node, *part)))
    }

    /// Whether the weights of a node's morph targets are animated.
    pub(super) fn has_weights(&self, node: usize) -> bool {
        self.tracks.contains_key(&(node, Part::Weights))
    }

    /// Weight of a node's morph target at a time, if it is animated.
    pub(super) fn weight(&self, node: usize, target: usize, time: f64) -> Option<f32> {
        let track = self.tracks.get(&(node, Part::Weights))?;
        Some(track.at(time, Part::Weights).get(target).map_or(0.0, |w| *w as f32))
    }

    /// Where a node puts what is in it, at a time.
    pub(super) fn local(&self, node: &gltf::Node<'_>, time: f64) -> DMat4 {
        let at = |part| self.tracks.get(&(node.index(), part)).map(|track: &Track| track.at(time, part));
        let [translation, rotation, scale] = TRANSFORM.map(at);
        if translation.is_none() && rotation.is_none() && scale.is_none() {
            return local(node);
        }
        let (t, r, s) = node.transform().decomposed();
        let rotation = rotation.map_or_else(|| DVec4::from_array(r.map(f64::from)), |v| DVec4::from_slice(&v));
        DMat4::from_scale_rotation_translation(
            scale.map_or_else(|| DVec3::from(s.map(f64::from)), |v| DVec3::from_slice(&v)),
            DQuat::from_vec4(rotation).normalize(),
            translation.map_or_else(|| DVec3::from(t.map(f64::from)), |v| DVec3::from_slice(&v)),
        )
    }
}

/// What places a node.
const TRANSFORM: [Part; 3] = [Part::Translation, Part::Rotation, Part::Scale];

/// The key that counts from a time on, of `count` that grow, and how far the time is on the way to the next: 0 up to 1. The first
/// and the last are held before and after.
pub(super) fn in_between(count: usize, key: impl Fn(usize) -> f64, time: f64) -> (usize, f64) {
    // Keys are of single precision: a time as near to one as that can tell is that of the key.
    let is_at = |i: usize| (key(i) - time).abs() <= 2.5e-7 * time.abs();
    let (mut low, mut high) = (0, count);
    while low < high {
        let middle = usize::midpoint(low, high);
        if key(middle) <= time {
            low = middle + 1;
        } else {
            high = middle;
        }
    }
    let Some(start) = low.checked_sub(1) else { return (0, 0.0) };
    if low == count || is_at(start) {
        return (start, 0.0);
    }
    if is_at(low) {
        return (low, 0.0);
    }
    (start, (time - key(start)) / (key(low) - key(start)))
}

impl Track {
    fn read(asset: &Asset, sampler: &gltf::json::animation::Sampler, part: Part, at: &str) -> Result<Self, Fault> {
        let times: Vec<f64> = asset.floats::<1>(sampler.input.value())?.iter().map(|[t]| f64::from(*t)).collect();
        if times.is_empty() || !times.iter().all(|t| t.is_finite()) || times.windows(2).any(|w| w[0] >= w[1]) {
            return Err(Fault::pointer(at, "key times that grow", "others"));
        }
        let output = sampler.output.value();
        let numbers = match part {
            Part::Rotation => asset.floats::<4>(output)?.into_flattened(),
            Part::Translation | Part::Scale => asset.floats::<3>(output)?.into_flattened(),
            Part::Weights => asset.floats::<1>(output)?.into_flattened(),
        };
        let values: Vec<f64> = numbers.into_iter().map(f64::from).collect();
        let Checked::Valid(interpolation) = sampler.interpolation else {
            return Err(Fault::pointer(at, "LINEAR, STEP or CUBICSPLINE", "another interpolation"));
        };
        let keys = times.len() * if interpolation == Interpolation::CubicSpline { 3 } else { 1 };
        let width = match part {
            Part::Rotation => 4,
            Part::Translation | Part::Scale => 3,
            // As many as there are targets.
            Part::Weights => (values.len() / keys).max(1),
        };
        let expected = keys * width;
        if values.len() != expected || !values.iter().all(|v| v.is_finite()) {
            let found = format!("{} of which some may not be finite", values.len() / width);
            return Err(Fault::pointer(at, format!("{keys} finite values"), found));
        }
        Ok(Self { times, values, width, interpolation })
    }

    fn range(&self) -> [f64; 2] {
        [self.times[0], self.times[self.times.len() - 1]]
    }

    /// Held before the first key and after the last.
    fn at(&self, time: f64, part: Part) -> Vec<f64> {
        let row = |i: usize| &self.values[i * self.width..(i + 1) * self.width];
        let is_cubic = self.interpolation == Interpolation::CubicSpline;
        let value = |key: usize| row(if is_cubic { 3 * key + 1 } else { key });
        let (start, u) = in_between(self.times.len(), |i| self.times[i], time);
        if u == 0.0 {
            return value(start).to_vec();
        }
        let (a, b) = (value(start), value(start + 1));
        let each = |f: &dyn Fn(usize) -> f64| (0..self.width).map(f).collect();
        match self.interpolation {
            Interpolation::Step => a.to_vec(),
            Interpolation::Linear if part == Part::Rotation => {
                let [a, b] = [a, b].map(|q| DQuat::from_vec4(DVec4::from_slice(q)).normalize());
                let q = if a.is_finite() && b.is_finite() { a.slerp(b, u) } else { DQuat::IDENTITY };
                q.to_array().to_vec()
            }
            Interpolation::Linear => each(&|c| a[c] * (1.0 - u) + b[c] * u),
            Interpolation::CubicSpline => {
                let length = self.times[start + 1] - self.times[start];
                let (out, into) = (row(3 * start + 2), row(3 * (start + 1)));
                let (u2, u3) = (u * u, u * u * u);
                each(&|c| {
                    a[c] * (2.0 * u3 - 3.0 * u2 + 1.0)
                        + length * out[c] * (u3 - 2.0 * u2 + u)
                        + b[c] * (3.0 * u2 - 2.0 * u3)
                        + length * into[c] * (u3 - u2)
                })
            }
        }
    }
}
