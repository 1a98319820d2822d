//! Cameras as they move: by the animation of their nodes and of those above.

use std::collections::HashMap;
use std::collections::hash_map::Entry;

use glam::{DMat4, DQuat, DVec3, DVec4};
use gltf::animation::{Interpolation, Property};
use serde_json::Value;

use super::camera;
use super::extension::EXTRAS;
use super::lift::Asset;
use super::shot::FPS;
use super::transform::{FLIP, is_ours, local, placements};
use crate::format::cameras::{CameraFile, DEFAULT_FPS, Found, Sampling, chosen, frame_count};
use crate::format::error::Fault;
use crate::scene::Camera;

/// The cameras of an asset.
pub(super) fn cameras(asset: &Asset, sampling: &Sampling<'_>) -> Result<CameraFile, Fault> {
    let placed = placements(&asset.document)?;
    let nodes: Vec<gltf::Node<'_>> = asset.document.nodes().collect();
    let mut parents: HashMap<usize, usize> = HashMap::new();
    for (node, _) in &placed {
        parents.extend(node.children().map(|child| (child.index(), node.index())));
    }
    let motion = Motion::read(asset)?;
    let is_ours = is_ours(&asset.document);
    let frame = if is_ours { FLIP } else { DMat4::IDENTITY };
    let (mut found, mut notes) = (vec![], vec![]);
    for (node, transform) in &placed {
        let Some(optics) = node.camera() else { continue };
        let name = node.name().or(optics.name()).map_or_else(|| format!("camera_{}", found.len()), str::to_owned);
        let at = format!("/nodes/{}", node.index());
        // From the node upwards.
        let chain: Vec<usize> =
            std::iter::successors(Some(node.index()), |child| parents.get(child).copied()).collect();
        let Some((start, end)) = motion.range(&chain) else {
            match camera::read(asset, optics.index(), *transform) {
                Ok((camera, note)) => {
                    notes.extend(note.map(|note| format!("{at}: {note}")));
                    found.push(Found { name, frames: vec![camera], fps: None });
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
            camera::read(asset, optics.index(), frame * in_world).map_err(|reason| format!("{reason}, at {time} s"))
        });
        match frames.collect::<Result<Vec<_>, _>>() {
            Ok(frames) => {
                notes.extend(frames[0].1.as_ref().map(|note| format!("{at}: {note}")));
                let frames = frames.into_iter().map(|(camera, _)| camera).collect();
                found.push(Found { name, frames, fps: Some(fps) });
            }
            Err(reason) => notes.push(format!("{at}: camera left out: {reason}")),
        }
    }
    if let (true, Some(reason)) = (found.is_empty(), notes.first()) {
        return Err(Fault::pointer("/cameras", "a camera", reason.clone()));
    }
    chosen(found, sampling, !is_ours, notes).map_err(|fault| fault.under("/cameras"))
}

/// What moves translation, rotation and scale of nodes.
struct Motion {
    tracks: HashMap<(usize, Part), Track>,
    /// Frames a second, if the file is ours.
    fps: Option<f64>,
}

#[derive(Clone, Copy, PartialEq, Eq, Hash)]
enum Part {
    Translation,
    Rotation,
    Scale,
}

/// Keys of one of these.
struct Track {
    /// Seconds, growing; at least one.
    times: Vec<f64>,
    /// One a key, or three: tangent before it, value, tangent after it.
    values: Vec<DVec4>,
    interpolation: Interpolation,
}

impl Motion {
    /// Of all animations together; of two that move the same, the first.
    fn read(asset: &Asset) -> Result<Self, Fault> {
        let (mut tracks, mut fps) = (HashMap::new(), None);
        for animation in asset.document.animations() {
            for (c, channel) in animation.channels().enumerate() {
                let part = match channel.target().property() {
                    Property::Translation => Part::Translation,
                    Property::Rotation => Part::Rotation,
                    Property::Scale => Part::Scale,
                    Property::MorphTargetWeights => continue,
                };
                let at = format!("/animations/{}/channels/{c}", animation.index());
                if let Entry::Vacant(slot) = tracks.entry((channel.target().node().index(), part)) {
                    slot.insert(Track::read(asset, &channel.sampler(), part, &at)?);
                }
            }
            let stated = asset.root.pointer(&format!("/animations/{}/extras/{EXTRAS}/{FPS}", animation.index()));
            fps = fps.or(stated.and_then(Value::as_f64).filter(|fps| *fps > 0.0));
        }
        Ok(Self { tracks, fps })
    }

    /// First and last key of what moves these nodes; `None` if nothing does.
    fn range(&self, nodes: &[usize]) -> Option<(f64, f64)> {
        let parts = [Part::Translation, Part::Rotation, Part::Scale];
        let tracks = nodes.iter().flat_map(|&node| parts.map(|part| self.tracks.get(&(node, part)))).flatten();
        tracks.map(|t| (t.times[0], t.times[t.times.len() - 1])).reduce(|a, b| (a.0.min(b.0), a.1.max(b.1)))
    }

    /// Where a node puts what is in it, at a time.
    fn local(&self, node: &gltf::Node<'_>, time: f64) -> DMat4 {
        let at = |part| self.tracks.get(&(node.index(), part)).map(|track: &Track| track.at(time, part));
        let [translation, rotation, scale] = [Part::Translation, Part::Rotation, Part::Scale].map(at);
        if (translation, rotation, scale) == (None, None, None) {
            return local(node);
        }
        let (t, r, s) = node.transform().decomposed();
        let rotation = rotation.unwrap_or_else(|| DVec4::from_array(r.map(f64::from)));
        DMat4::from_scale_rotation_translation(
            scale.map_or_else(|| DVec3::from(s.map(f64::from)), DVec4::truncate),
            DQuat::from_vec4(rotation).normalize(),
            translation.map_or_else(|| DVec3::from(t.map(f64::from)), DVec4::truncate),
        )
    }
}

impl Track {
    fn read(asset: &Asset, sampler: &gltf::animation::Sampler<'_>, part: Part, at: &str) -> Result<Self, Fault> {
        let times: Vec<f64> = asset.floats::<1>(sampler.input().index())?.iter().map(|[t]| f64::from(*t)).collect();
        if times.is_empty() || !times.iter().all(|t| t.is_finite()) || times.windows(2).any(|w| w[0] >= w[1]) {
            return Err(Fault::pointer(at, "key times that grow", "others"));
        }
        let output = sampler.output().index();
        let values: Vec<DVec4> = if part == Part::Rotation {
            asset.floats::<4>(output)?.iter().map(|v| DVec4::from_array(v.map(f64::from))).collect()
        } else {
            asset.floats::<3>(output)?.iter().map(|v| DVec3::from(v.map(f64::from)).extend(0.0)).collect()
        };
        let interpolation = sampler.interpolation();
        let expected = times.len() * if interpolation == Interpolation::CubicSpline { 3 } else { 1 };
        if values.len() != expected || !values.iter().all(|v| v.is_finite()) {
            let found = format!("{} of which some may not be finite", values.len());
            return Err(Fault::pointer(at, format!("{expected} finite values"), found));
        }
        Ok(Self { times, values, interpolation })
    }

    /// Held before the first key and after the last.
    fn at(&self, time: f64, part: Part) -> DVec4 {
        let is_cubic = self.interpolation == Interpolation::CubicSpline;
        let value = |key: usize| if is_cubic { self.values[3 * key + 1] } else { self.values[key] };
        let after = self.times.partition_point(|t| *t <= time);
        // Keys are of single precision: a time as near to one as that can tell is that of the key.
        let is_at = |key: usize| (self.times[key] - time).abs() <= 2.5e-7 * time.abs();
        let Some(start) = after.checked_sub(1) else { return value(0) };
        if after == self.times.len() || is_at(start) {
            return value(start);
        }
        if is_at(after) {
            return value(after);
        }
        let length = self.times[after] - self.times[start];
        let u = (time - self.times[start]) / length;
        let (a, b) = (value(start), value(after));
        match self.interpolation {
            Interpolation::Step => a,
            Interpolation::Linear if part == Part::Rotation => {
                let [a, b] = [a, b].map(|q| DQuat::from_vec4(q).normalize());
                if a.is_finite() && b.is_finite() { a.slerp(b, u).into() } else { DVec4::W }
            }
            Interpolation::Linear => a.lerp(b, u),
            Interpolation::CubicSpline => {
                let (out, into) = (self.values[3 * start + 2] * length, self.values[3 * after] * length);
                let (u2, u3) = (u * u, u * u * u);
                a * (2.0 * u3 - 3.0 * u2 + 1.0)
                    + out * (u3 - 2.0 * u2 + u)
                    + b * (3.0 * u2 - 2.0 * u3)
                    + into * (u3 - u2)
            }
        }
    }
}
