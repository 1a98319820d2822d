//! Animated cameras of a layer: time samples of their optics and of the transforms of them and their ancestors.

use glam::DMat4;

use super::document::{Field, Layer, Prim, PropertyKind, Value};
use super::stage::Stage;
use super::to_scene::{Counts, display_name, is_ours, place_all, units};
use super::{from_scene, views, xform};
use crate::format::cameras::{CameraFile, DEFAULT_FPS, Found, Frames, NAME, Sampling, chosen};
use crate::format::error::Fault;
use crate::scene::{Camera, Composition, HybridScene, Splats, frame::HALF_TURN};

/// Time codes per second if a layer does not state them.
const DEFAULT_RATE: f64 = 24.0;

/// Upper bound on transforms evaluated for the cameras of a file: more than any real path needs, a few seconds of work.
const MAX_STEPS: usize = 50_000_000;

/// Cameras of a layer.
pub(super) fn read(mut layer: Layer, sampling: &Sampling<'_>) -> Result<CameraFile, Fault> {
    layer.sort_samples();
    let rate = |name: &str| layer.field(name).and_then(Value::as_number).filter(|v| *v > 0.0 && v.is_finite());
    let codes = rate("timeCodesPerSecond").or(rate("framesPerSecond")).unwrap_or(DEFAULT_RATE);
    let fps = sampling.fps.or(rate("framesPerSecond")).unwrap_or(codes);
    let (mut found, mut notes, mut left_out, mut taken) = (vec![], vec![], vec![], Frames::default());
    let to_world = units(&layer, &mut notes)?;
    let mut stage = Stage::new(&layer);
    let mut steps = 0_usize;
    let is_ours = is_ours(&stage);
    let to_scene = if is_ours { HALF_TURN } else { DMat4::IDENTITY };
    for placed in place_all(&stage, to_world, &mut Counts::default())? {
        let prim = stage.prims[placed.prim];
        if prim.type_name != "Camera" {
            continue;
        }
        let (name, at) = (display_name(prim), stage.path(placed.prim));
        let span = range(&stage, placed.prim);
        let times = match span {
            None => vec![None],
            Some(_) if sampling.time.is_some() => vec![sampling.time.map(|time| time * codes)],
            Some((start, end)) => {
                let is_wanted = sampling.wants(&name, found.len());
                let count = if is_wanted { taken.take(start / codes, end / codes, fps) } else { Ok(1) };
                let count = count.map_err(|fault| fault.under(&at))?;
                (0..count).map(|i| Some((start + i as f64 * codes / fps).min(end))).collect()
            }
        };
        let moves = times[0].is_some();
        let of_frame: usize =
            chain(&stage, placed.prim).iter().map(|&p| xform::attributes(stage.prims[p]).count()).sum();
        steps = steps.saturating_add(of_frame.saturating_mul(times.len()));
        if steps > MAX_STEPS {
            let found = format!("{of_frame} in each of {} frames", times.len());
            return Err(Fault::pointer(&at, format!("at most {MAX_STEPS} steps of transforms for all cameras"), found));
        }
        let mut frames: Result<Vec<Camera>, String> = Ok(vec![]);
        for time in times {
            stage.time = time;
            let transform = if moves { world(&stage, placed.prim, to_world)? } else { placed.transform };
            match (views::read(&stage, placed.prim, transform, to_scene), &mut frames) {
                (Ok((camera, note)), Ok(frames)) => {
                    notes.extend(note.filter(|_| frames.is_empty()).map(|note| format!("{at}: {note}")));
                    frames.push(camera);
                }
                (Err(reason), _) => {
                    frames = Err(time.map_or(reason.clone(), |time| format!("{reason}, at time {time}")));
                    break;
                }
                (Ok(_), Err(_)) => break,
            }
        }
        stage.time = None;
        match frames {
            Ok(frames) => {
                let start = span.map_or(0.0, |(start, _)| start / codes);
                found.push(Found { name, frames, start, fps: (moves && sampling.time.is_none()).then_some(fps) });
            }
            Err(reason) => left_out.push(format!("{at}: camera left out: {reason}")),
        }
    }
    if let (true, Some(reason)) = (found.is_empty(), left_out.first()) {
        return Err(Fault::pointer("/", "a camera", reason.clone()));
    }
    notes.append(&mut left_out);
    chosen(found, sampling, !is_ours, notes).map_err(|fault| fault.under("/"))
}

/// Prim and its ancestors that determine its transform, upwards.
fn chain(stage: &Stage<'_>, prim: usize) -> Vec<usize> {
    let mut chain = vec![];
    let mut next = Some(prim);
    while let Some(prim) = next {
        chain.push(prim);
        let resets = xform::attributes(stage.prims[prim]).any(|name| name == "!resetXformStack!");
        next = stage.parents[prim].filter(|_| !resets);
    }
    chain
}

/// First and last time code of the animation of a camera's transform or optics; `None` if it is static.
fn range(stage: &Stage<'_>, camera: usize) -> Option<(f64, f64)> {
    let optics = stage.prims[camera].properties.iter().map(|p| (camera, p.name.as_str()));
    let moving =
        chain(stage, camera).into_iter().flat_map(|prim| xform::attributes(stage.prims[prim]).map(move |n| (prim, n)));
    let times = optics.chain(moving).flat_map(|(prim, name)| {
        let samples = stage.prims[prim].samples(name);
        // A single sample is a constant.
        let samples = if samples.len() > 1 { samples } else { &[] };
        samples.iter().map(|(time, _)| *time).filter(|time| time.is_finite())
    });
    times.map(|time| (time, time)).reduce(|a, b| (a.0.min(b.0), a.1.max(b.1)))
}

/// Transform of a prim to the world at the stage's time.
fn world(stage: &Stage<'_>, prim: usize, to_world: DMat4) -> Result<DMat4, Fault> {
    let mut transform = DMat4::IDENTITY;
    for prim in chain(stage, prim) {
        transform = xform::local(stage, prim)?.0 * transform;
    }
    Ok(to_world * transform)
}

/// Layer with one camera whose frames are those of `shown`, in the capture's frame: one per time code.
pub(super) fn layer(shown: &CameraFile) -> Layer {
    let fps = shown.fps.unwrap_or(DEFAULT_FPS);
    // Most times are integer time codes.
    let code = |code: f64| if (code - code.round()).abs() < 1e-6 { code.round() } else { code };
    let codes: Vec<f64> = shown.keys().into_iter().map(|time| code(time * fps)).collect();
    let [first, last] = [codes.first(), codes.last()].map(|end| end.copied().unwrap_or_default());
    let composition = Composition::default();
    let nothing = HybridScene { splats: Splats::empty(0), meshes: vec![], composition };
    let mut export = from_scene::export(&nothing, &[], None, "").expect("a scene without meshes has no pictures").layer;
    for (name, value) in
        [("startTimeCode", first), ("endTimeCode", last), ("timeCodesPerSecond", fps), ("framesPerSecond", fps)]
    {
        export.metadata.push(Field { edit: None, name: name.to_owned(), value: Value::Number(value) });
    }
    let near = shown.near.unwrap_or(composition.near);
    let frames: Vec<Prim> =
        shown.cameras.iter().map(|(_, camera)| from_scene::view(NAME, NAME, camera, near)).collect();
    export.prims[0].children.extend(merged(&frames, &codes));
    export
}

/// Merges prims that differ only in values into one with time samples.
fn merged(frames: &[Prim], codes: &[f64]) -> Option<Prim> {
    fn value_of(prim: &Prim, i: usize) -> Option<&Value> {
        match &prim.properties[i].kind {
            PropertyKind::Attribute { value, .. } => value.as_ref(),
            PropertyKind::Relationship { .. } => None,
        }
    }
    let mut prim = frames.first()?.clone();
    for i in 0..prim.properties.len() {
        let first = value_of(&frames[0], i);
        if frames.iter().all(|frame| value_of(frame, i) == first) {
            continue;
        }
        if let PropertyKind::Attribute { value, samples, .. } = &mut prim.properties[i].kind {
            *value = None;
            let of_frame = |(code, frame): (&f64, &Prim)| Some((*code, value_of(frame, i)?.clone()));
            *samples = codes.iter().zip(frames).filter_map(of_frame).collect();
        }
    }
    Some(prim)
}
