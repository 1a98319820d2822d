//! Evaluation of animations at a time: transforms of nodes, weights of morph targets, and animated cameras.

use std::collections::HashMap;
use std::collections::hash_map::Entry;
use std::sync::Arc;

use glam::{DMat4, DQuat, DVec4};
use gltf::animation::{Interpolation, Property};
use gltf::json::validation::Checked;
use serde::Serialize;
use serde_json::Value;

use super::camera;
use super::extension::EXTRAS;
use super::lift::Asset;
use super::shot::{FPS, is_marked};
use super::transform::{is_ours, local, placements, placements_by, unit};
use crate::format::cameras::{CameraFile, DEFAULT_FPS, Found, Frames, Sampling, chosen};
use crate::format::error::Fault;
use crate::scene::{Camera, frame::HALF_TURN};

/// Most names of animations that an error lists.
const MOST_NAMES: usize = 8;

/// Upper bound on node transforms evaluated for cameras, some seconds of work.
const MOST_STEPS: usize = 1 << 27;

/// Cameras of a document.
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
    let frame = if is_ours { HALF_TURN } else { DMat4::IDENTITY };
    let (mut found, mut notes, mut taken) = (vec![], vec![], Frames::default());
    // First and last key of the animations of a node or its ancestors; parents precede their children.
    let mut ranges: HashMap<usize, (f64, f64)> = HashMap::new();
    let mut steps = 0;
    for (node, transform) in &placed {
        let index = node.index();
        let above = parents.get(&index).and_then(|parent| ranges.get(parent)).copied();
        let range = motion.range(index).into_iter().chain(above).reduce(|a, b| (a.0.min(b.0), a.1.max(b.1)));
        ranges.extend(range.filter(|_| sampling.time.is_none()).map(|range| (index, range)));
        let Some(optics) = node.camera().filter(|_| !(sampling.without_paths && is_marked(node))) else { continue };
        let name = camera::name(node, found.len());
        let at = format!("/nodes/{index}");
        let fps = sampling.fps.or(motion.fps).unwrap_or(DEFAULT_FPS);
        let range = ranges.get(&index).copied();
        let Some((start, end)) = range.filter(|_| sampling.wants(&name, found.len())) else {
            match camera::read(document, optics.index(), *transform) {
                Ok((camera, note)) => {
                    notes.extend(note.map(|note| format!("{at}: {note}")));
                    found.push(Found { name, frames: vec![camera], start: 0.0, fps: range.map(|_| fps) });
                }
                Err(reason) => notes.push(format!("{at}: camera left out: {reason}")),
            }
            continue;
        };
        let count = taken.take(start, end, fps).map_err(|fault| fault.under(&at))?;
        // Node and its ancestors, upwards.
        let chain: Vec<usize> = std::iter::successors(Some(index), |child| parents.get(child).copied()).collect();
        steps += count * chain.len();
        if steps > MOST_STEPS {
            let expected = format!("at most {MOST_STEPS} transforms of nodes above cameras, of all frames together");
            return Err(Fault::pointer(at, expected, format!("{} of each of {count} frames", chain.len())));
        }
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

/// Animation of nodes and of their morph-target weights.
#[derive(Clone, Debug, Default)]
pub(in crate::format) struct Motion {
    tracks: HashMap<(usize, Part), Track>,
    /// Frames per second, if Centaur wrote the file.
    fps: Option<f64>,
    /// Animations that can be played, in order.
    clips: Vec<Clip>,
    /// Faults of channels that are not among the tracks.
    faults: Vec<Fault>,
    /// How many animations move what one before them moves, too.
    overruled: usize,
    /// Number of animations that were not selected.
    left_out: usize,
}

/// Animation of a document.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Clip {
    /// Name of the animation.
    pub name: Option<String>,
    /// First and last key time, in seconds.
    pub range: [f64; 2],
    /// Number of node properties that it animates.
    pub channels: usize,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
enum Part {
    Translation,
    Rotation,
    Scale,
    Weights,
}

/// Keys of one animated property. Channels share the content of accessors.
#[derive(Clone, Debug)]
struct Track {
    /// Key times in seconds, increasing; at least one.
    times: Arc<[f32]>,
    /// Values: `width` numbers per key, or three times as many: in-tangent, value, out-tangent.
    values: Arc<[f32]>,
    width: usize,
    interpolation: Interpolation,
}

impl Motion {
    /// Animations selected by name, or by index where no name matches; all if `animations` is empty. Otherwise same as
    /// [`Motion::read`].
    pub(super) fn chosen(asset: &Asset, animations: &[String]) -> Result<Self, Fault> {
        if animations.is_empty() {
            return Ok(Self::read(asset, |_| true));
        }
        let all = &asset.document.as_json().animations;
        let mut wanted = vec![false; all.len()];
        for name in animations {
            let mut these: Vec<usize> = (0..all.len()).filter(|&i| all[i].name.as_ref() == Some(name)).collect();
            if these.is_empty() {
                these.extend(name.parse().ok().filter(|number: &usize| *number < all.len()));
            }
            if these.is_empty() {
                let names = all.iter().enumerate().map(|(i, a)| a.name.clone().unwrap_or_else(|| i.to_string()));
                let mut some: Vec<String> = names.take(MOST_NAMES + 1).collect();
                if some.len() > MOST_NAMES {
                    some[MOST_NAMES] = "…".to_owned();
                }
                let found = if some.is_empty() { "none at all".to_owned() } else { some.join(", ") };
                return Err(Fault::pointer("/animations", format!("one called {name}"), found));
            }
            these.into_iter().for_each(|i| wanted[i] = true);
        }
        let mut motion = Self::read(asset, |i| wanted[i]);
        motion.left_out = wanted.iter().filter(|wanted| !**wanted).count();
        Ok(motion)
    }

    /// Reads the animations selected by index and combines them; if several channels animate the same property, the
    /// first counts. Malformed channels are left out, see [`Motion::check`].
    pub(super) fn read(asset: &Asset, wants: impl Fn(usize) -> bool) -> Self {
        let mut motion = Self::default();
        let mut arrays = Arrays { asset, times: HashMap::new(), values: HashMap::new() };
        let all = asset.document.as_json().animations.iter().enumerate();
        for (a, animation) in all.filter(|(a, _)| wants(*a)) {
            let (mut range, mut channels, mut is_overruled): (Option<[f64; 2]>, usize, bool) = (None, 0, false);
            for (c, channel) in asset.channels(a).into_iter().zip(&animation.channels) {
                let (target, track) = match arrays.track(animation, channel, &format!("/animations/{a}/channels/{c}")) {
                    Ok(read) => read,
                    Err(fault) => {
                        motion.faults.push(fault);
                        continue;
                    }
                };
                let [first, last] = track.range();
                range = Some(range.map_or([first, last], |[a, b]| [a.min(first), b.max(last)]));
                channels += 1;
                match motion.tracks.entry(target) {
                    Entry::Vacant(slot) => drop(slot.insert(track)),
                    Entry::Occupied(_) => is_overruled = true,
                }
            }
            motion.overruled += usize::from(is_overruled);
            motion.clips.extend(range.map(|range| Clip { name: animation.name.clone(), range, channels }));
            let stated = asset.root.pointer(&format!("/animations/{a}/extras/{EXTRAS}/{FPS}"));
            motion.fps = motion.fps.or(stated.and_then(Value::as_f64).filter(|fps| *fps > 0.0));
        }
        motion
    }

    /// Checks the animations; with a faulty one, the state at a time is undetermined.
    pub(super) fn check(&self) -> Result<(), Fault> {
        self.faults.first().map_or(Ok(()), |fault| Err(fault.clone()))
    }

    /// What there is to be said where animations that move the same are played together.
    pub(super) fn overruled(&self) -> Option<String> {
        let (some, all) = (self.overruled, self.clips.len());
        (some > 0).then(|| {
            format!("/animations: {some} of {all} move something that an earlier one moves: there the earlier one is played; --animation selects one")
        })
    }

    /// What is not played, a sentence each.
    pub(super) fn notes(&self) -> Vec<String> {
        let fault = self.faults.first().map(|Fault { location, expected, found }| {
            let others =
                if self.faults.len() > 1 { format!(", and {} more", self.faults.len() - 1) } else { String::new() };
            format!("{location}not played{others}: expected {expected}, found {found}")
        });
        let left_out =
            (self.left_out > 0).then(|| format!("/animations: not selected and left out: {}", self.left_out));
        fault.into_iter().chain(left_out).collect()
    }

    pub(super) fn fps(&self) -> Option<f64> {
        self.fps
    }

    pub(super) fn clips(&self) -> &[Clip] {
        &self.clips
    }

    /// First and last key of a node's own animation; `None` if it has none.
    fn range(&self, node: usize) -> Option<(f64, f64)> {
        let tracks = TRANSFORM.into_iter().filter_map(|part| self.tracks.get(&(node, part)));
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
        let track = self.tracks.get(&(node, Part::Weights)).filter(|track| target < track.width)?;
        let [weight] = track.at(time, target);
        Some(weight as f32)
    }

    /// Local transform of a node at a time.
    pub(super) fn local(&self, node: &gltf::Node<'_>, time: f64) -> DMat4 {
        let [translation, rotation, scale] = TRANSFORM.map(|part| self.tracks.get(&(node.index(), part)));
        if translation.is_none() && rotation.is_none() && scale.is_none() {
            return local(node);
        }
        let (t, r, s) = node.transform().decomposed();
        DMat4::from_scale_rotation_translation(
            scale.map_or_else(|| s.map(f64::from), |track| track.at(time, 0)).into(),
            rotation.map_or_else(|| unit(DVec4::from(r.map(f64::from))), |track| track.rotation(time)),
            translation.map_or_else(|| t.map(f64::from), |track| track.at(time, 0)).into(),
        )
    }
}

/// Parts of a node's transform.
const TRANSFORM: [Part; 3] = [Part::Translation, Part::Rotation, Part::Scale];

/// Index of the last key at or before a time, among `count` increasing keys, and the fraction of the way to the next
/// key, in [0, 1). The first key is held before its time, the last after.
pub(super) fn in_between(count: usize, key: impl Fn(usize) -> f64, time: f64) -> (usize, f64) {
    // Keys have single precision: a time that rounds to a key's counts as equal.
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

/// Accessors used by channels, each read once.
struct Arrays<'a> {
    asset: &'a Asset,
    times: HashMap<usize, Arc<[f32]>>,
    /// Values by accessor and number of components.
    values: HashMap<(usize, usize), Arc<[f32]>>,
}

impl Arrays<'_> {
    /// Animated property of a channel, and its track.
    fn track(
        &mut self,
        animation: &gltf::json::Animation,
        channel: &gltf::json::animation::Channel,
        at: &str,
    ) -> Result<((usize, Part), Track), Fault> {
        // Checked already by `Asset::open` and by the crate.
        let (which, samplers) = (channel.sampler.value(), &animation.samplers);
        let sampler = samplers.get(which).ok_or_else(|| {
            Fault::pointer(format!("{at}/sampler"), format!("a sampler below {}", samplers.len()), which.to_string())
        })?;
        let index = channel.target.node.value();
        let node = self.asset.document.nodes().nth(index).ok_or_else(|| {
            let nodes = self.asset.document.nodes().len();
            Fault::pointer(format!("{at}/target/node"), format!("a node below {nodes}"), index.to_string())
        })?;
        let (Checked::Valid(path), Checked::Valid(interpolation)) = (channel.target.path, sampler.interpolation) else {
            return Err(Fault::pointer(at, "a path and an interpolation of glTF 2.0", "another"));
        };
        // All primitives of a mesh have the same number of targets (glTF 2.0, 3.7.2.2).
        let targets = || node.mesh().and_then(|m| m.primitives().next()).map_or(0, |p| p.morph_targets().len());
        let (part, width) = match path {
            Property::Translation => (Part::Translation, 3),
            Property::Rotation => (Part::Rotation, 4),
            Property::Scale => (Part::Scale, 3),
            Property::MorphTargetWeights => (Part::Weights, targets()),
        };
        let times = self.times(sampler.input.value())?;
        let values = self.values(sampler.output.value(), part)?;
        let keys = times.len() * if interpolation == Interpolation::CubicSpline { 3 } else { 1 };
        if Some(values.len()) != keys.checked_mul(width) {
            let expected = format!("{keys} times {width} numbers");
            return Err(Fault::pointer(at, expected, values.len().to_string()));
        }
        Ok(((index, part), Track { times, values, width, interpolation }))
    }

    fn times(&mut self, accessor: usize) -> Result<Arc<[f32]>, Fault> {
        if let Some(known) = self.times.get(&accessor) {
            return Ok(Arc::clone(known));
        }
        let at = format!("/accessors/{accessor}");
        let times: Arc<[f32]> = self.asset.floats::<1>(accessor)?.into_flattened().into();
        if let Some(bad) = times.iter().find(|t| !t.is_finite()) {
            return Err(Fault::pointer(at, "finite key times", bad.to_string()));
        }
        if let Some(pair) = times.windows(2).find(|pair| pair[0] >= pair[1]) {
            return Err(Fault::pointer(at, "key times that grow", format!("{} after {}", pair[1], pair[0])));
        }
        if times.is_empty() {
            return Err(Fault::pointer(at, "at least one key time", "none"));
        }
        self.times.insert(accessor, Arc::clone(&times));
        Ok(times)
    }

    fn values(&mut self, accessor: usize, part: Part) -> Result<Arc<[f32]>, Fault> {
        let components = match part {
            Part::Rotation => 4,
            Part::Translation | Part::Scale => 3,
            Part::Weights => 1,
        };
        if let Some(known) = self.values.get(&(accessor, components)) {
            return Ok(Arc::clone(known));
        }
        let values = match components {
            4 => self.asset.floats::<4>(accessor)?.into_flattened(),
            3 => self.asset.floats::<3>(accessor)?.into_flattened(),
            _ => self.asset.floats::<1>(accessor)?.into_flattened(),
        };
        let values: Arc<[f32]> = values.into();
        if let Some(bad) = values.iter().find(|v| !v.is_finite()) {
            return Err(Fault::pointer(format!("/accessors/{accessor}"), "finite numbers", bad.to_string()));
        }
        self.values.insert((accessor, components), Arc::clone(&values));
        Ok(values)
    }
}

impl Track {
    fn range(&self) -> [f64; 2] {
        [self.times[0], self.times[self.times.len() - 1]].map(f64::from)
    }

    fn in_between(&self, time: f64) -> (usize, f64) {
        in_between(self.times.len(), |i| f64::from(self.times[i]), time)
    }

    /// `N` numbers of row `i`, starting at column `first`.
    fn row<const N: usize>(&self, i: usize, first: usize) -> [f64; N] {
        std::array::from_fn(|c| f64::from(self.values[i * self.width + first + c]))
    }

    /// Interpolates `N` numbers, starting at column `first`, at a time. The first key's are held before it, the last
    /// key's after it.
    fn at<const N: usize>(&self, time: f64, first: usize) -> [f64; N] {
        let row = |i: usize| self.row::<N>(i, first);
        let is_cubic = self.interpolation == Interpolation::CubicSpline;
        let value = |key: usize| row(if is_cubic { 3 * key + 1 } else { key });
        let (start, u) = self.in_between(time);
        let a = value(start);
        if u == 0.0 || self.interpolation == Interpolation::Step {
            return a;
        }
        let b = value(start + 1);
        if !is_cubic {
            return std::array::from_fn(|c| a[c] * (1.0 - u) + b[c] * u);
        }
        let length = f64::from(self.times[start + 1]) - f64::from(self.times[start]);
        let (out, into) = (row(3 * start + 2), row(3 * (start + 1)));
        let (u2, u3) = (u * u, u * u * u);
        std::array::from_fn(|c| {
            a[c] * (2.0 * u3 - 3.0 * u2 + 1.0)
                + length * out[c] * (u3 - 2.0 * u2 + u)
                + b[c] * (3.0 * u2 - 2.0 * u3)
                + length * into[c] * (u3 - u2)
        })
    }

    fn rotation(&self, time: f64) -> DQuat {
        let (start, u) = self.in_between(time);
        if u == 0.0 || self.interpolation != Interpolation::Linear {
            return unit(self.at(time, 0).into());
        }
        unit(self.row(start, 0).into()).slerp(unit(self.row(start + 1, 0).into()), u)
    }
}
