//! Files of cameras without a scene, written or read by other programs, from which a shot is rendered.
//!
//! | | read | written |
//! |---|---|---|
//! | `.glb`, `.gltf` | cameras, and their animation: translation, rotation and scale of nodes, in every interpolation | one camera that moves, y up |
//! | `.usda`, `.usdz`, `.usdc` | cameras, and time samples of their transforms and optics | one camera that moves, y up (`.usda`) |
//! | `.json` | by `capture::cameras` | `transforms.json` of nerfstudio: camera→world, OpenGL axes (x right, y up, z backwards) |
//! | a folder | by `capture::cameras` | a COLMAP model as text in `sparse/0`: world→camera, OpenCV axes |

mod captures;
mod colmap;
#[cfg(test)]
mod tests;
mod transforms;

use std::collections::{HashMap, HashSet};
use std::path::{Component, Path, PathBuf};

pub(super) use self::colmap::write as write_model;
pub(super) use self::transforms::write as write_transforms;
use super::error::{Fault, some_of};
use super::notes::grouped;
use crate::scene::{Camera, frame};

/// Cameras in display order.
#[derive(Clone, Debug, Default)]
pub struct CameraFile {
    /// Cameras with their names; at least one if read from a file.
    pub cameras: Vec<(String, Camera)>,
    /// Frames per second, if the cameras are frames of a shot or a rate was requested.
    pub fps: Option<f64>,
    /// Whether the cameras are in a y-up world, as in glTF and USD; false for the capture's frame, which differs by
    /// half a turn about x.
    pub y_up: bool,
    /// Time of each camera, in seconds of the file's clock; empty if the cameras are not frames of a shot.
    pub times: Vec<f64>,
    /// Depth of the near plane with which they are written; `None`: that of the scene with which they are, or the usual
    /// one. Readers leave it out.
    pub near: Option<f32>,
    /// Folder below which there is a photograph by each camera's name, with or without its suffix; `None` if they are not
    /// known, as of files that name none.
    pub images: Option<PathBuf>,
    /// Notes on content that could not be represented exactly, one sentence each.
    pub notes: Vec<String>,
}

/// Selection of a file's cameras and of the frames to read.
#[derive(Clone, Copy, Debug, Default)]
pub struct Sampling<'a> {
    /// Frames per second at which animated cameras are sampled; `None`: the rate that the file states, else
    /// [`DEFAULT_FPS`].
    pub fps: Option<f64>,
    /// Only the cameras of these names, or numbers from 0 where no name is meant; empty: all that move, or all where
    /// none does.
    pub only: &'a [String],
    /// All as they are at this time, in seconds, none of them moving; `None`: frame by frame.
    pub time: Option<f64>,
    /// Whether cameras added by [`write_cameras_with_scene`](super::write_cameras_with_scene) are skipped.
    pub without_paths: bool,
}

impl Sampling<'_> {
    /// Whether a camera of this name and number, as a file's reader has them, may be asked for.
    pub(super) fn wants(&self, name: &str, number: usize) -> bool {
        self.only.is_empty() || self.only.iter().any(|only| short(only) == name || only.parse().ok() == Some(number))
    }

    /// Which of the cameras of these names are asked for.
    ///
    /// # Errors
    /// The first that is asked for and neither the name of one nor a number.
    pub fn picked(&self, names: &[&str]) -> Result<Vec<bool>, String> {
        let mut picked = vec![self.only.is_empty(); names.len()];
        for only in self.only {
            let named: Vec<bool> = names.iter().map(|name| *name == *only || *name == short(only)).collect();
            if named.contains(&true) {
                picked.iter_mut().zip(named).for_each(|(picked, is_named)| *picked |= is_named);
            } else {
                let number: usize = only.parse().map_err(|_| only.clone())?;
                *picked.get_mut(number).ok_or_else(|| only.clone())? = true;
            }
        }
        Ok(picked)
    }
}

/// Frames per second where no rate is stated.
pub const DEFAULT_FPS: f64 = 30.0;

/// Most frames of a shot, and of all cameras of a file together: 20 minutes at 30 frames per second. Two keys in a
/// small file can request all of them.
pub const MAX_FRAMES: usize = 36_000;

/// Name of an animated camera in files that Centaur writes.
pub(super) const NAME: &str = "path";

/// Most characters of a camera's name.
const MAX_NAME: usize = 100;

/// Name cut to [`MAX_NAME`] characters: it becomes part of every frame's name, and many cameras may share it.
pub(super) fn short(name: &str) -> String {
    name.chars().take(MAX_NAME).collect()
}

/// How to come by cameras of a scene that has none.
pub(super) const ADVICE: &str = "`centaur cameras orbit` makes a path around any scene";

impl CameraFile {
    /// Converts the cameras to a y-up world or to the capture's frame.
    #[must_use]
    pub fn in_frame(mut self, y_up: bool) -> Self {
        if self.y_up != y_up {
            self.cameras.iter_mut().for_each(|(_, camera)| *camera = turned(camera));
        }
        self.y_up = y_up;
        self
    }

    /// Time of each camera in seconds: non-negative and strictly increasing, even in single precision, as keys of files
    /// must be. Counts from 0 where no times are stated, or where several cameras share a time.
    pub(super) fn keys(&self) -> Vec<f64> {
        let fps = self.fps.unwrap_or(DEFAULT_FPS);
        let ends = [self.times.first(), self.times.last()];
        let is_told = self.times.len() == self.cameras.len()
            && ends.iter().all(|end| end.is_some_and(|time| (0.0..1e9).contains(time)))
            && self.times.windows(2).all(|pair| (pair[0] as f32) < pair[1] as f32);
        if is_told { self.times.clone() } else { (0..self.cameras.len()).map(|i| i as f64 / fps).collect() }
    }
}

/// In the world after half a turn about x.
pub(super) fn turned(camera: &Camera) -> Camera {
    let rotation = frame::in_turned_world(camera.rotation());
    Camera::new(*camera.intrinsics(), rotation, camera.translation()).expect("a rotation, turned, is one")
}

/// Camera found in a file, with its frames: one at rest, or those of its animation.
pub(super) struct Found {
    pub(super) name: String,
    pub(super) frames: Vec<Camera>,
    /// Time of the first frame, in seconds.
    pub(super) start: f64,
    /// Frames per second; `None` if the camera is static.
    pub(super) fps: Option<f64>,
}

/// Cameras selected by `sampling` among the pinhole cameras of a file. Of cameras that are not selected, `found` may
/// hold the first frame only.
pub(super) fn chosen(
    found: Vec<Found>,
    sampling: &Sampling<'_>,
    y_up: bool,
    mut notes: Vec<String>,
) -> Result<CameraFile, Fault> {
    if found.is_empty() {
        return Err(Fault::whole("cameras", format!("none that are pinholes; {ADVICE}")));
    }
    let names: Vec<&str> = found.iter().map(|camera| camera.name.as_str()).collect();
    let is_none = |only: String| Fault::whole(format!("a camera called {only}"), some_of(names.iter().copied()));
    let mut picked = sampling.picked(&names).map_err(is_none)?.into_iter();
    let moves = found.iter().any(|camera| camera.fps.is_some());
    let (kept, others): (Vec<Found>, Vec<Found>) = found.into_iter().partition(|camera| {
        picked.next() == Some(true) && (!sampling.only.is_empty() || camera.fps.is_some() || !moves)
    });
    if sampling.only.is_empty() && !others.is_empty() {
        notes.push(format!("cameras that do not move: left out ({})", others.len()));
    }
    // Of those that rest, nothing says at which time of the others they are.
    let one_that = |moves: bool| kept.iter().find(|camera| camera.fps.is_some() == moves);
    if let (Some(moving), Some(resting)) = (one_that(true), one_that(false)) {
        let found = format!("{}, which moves, and {}, which does not", moving.name, resting.name);
        return Err(Fault::whole("cameras that all move, or none that does", found));
    }
    let fps = kept.iter().find_map(|camera| camera.fps);
    let one = kept.len() == 1;
    let (mut cameras, mut times) = (vec![], vec![]);
    for Found { name, frames, start, fps } in kept {
        times.extend(fps.into_iter().flat_map(|fps| (0..frames.len()).map(move |i| start + i as f64 / fps)));
        let of_frame = |i: usize| match fps {
            None => name.clone(),
            Some(_) if one => format!("frame_{i:05}"),
            Some(_) => format!("{name}_{i:05}"),
        };
        cameras.extend(frames.into_iter().enumerate().map(|(i, camera)| (of_frame(i), camera)));
    }
    Ok(CameraFile { cameras, fps, y_up, times, notes: grouped(&notes), ..CameraFile::default() })
}

/// Number of frames from `start` to `end`, in seconds, both included; `None` if there are more than [`MAX_FRAMES`], or
/// `end` is before `start`. The frame at `end` counts even if `end` is early by a hundredth of a frame, or by the
/// rounding error of single precision, in which times are often stored.
#[must_use]
pub fn frame_count(start: f64, end: f64, fps: f64) -> Option<usize> {
    let unknown = (2.4e-7 * start.abs().max(end.abs()) * fps).min(0.5);
    let last = ((end - start) * fps + unknown.max(0.01)).floor();
    (0.0..MAX_FRAMES as f64).contains(&last).then(|| last as usize + 1)
}

/// Number of frames read so far of all cameras of a file, limited to [`MAX_FRAMES`].
#[derive(Default)]
pub(super) struct Frames(usize);

impl Frames {
    /// Number of frames of a further camera, see [`frame_count`].
    pub(super) fn take(&mut self, start: f64, end: f64, fps: f64) -> Result<usize, Fault> {
        let count = frame_count(start, end, fps).filter(|count| self.0 + count <= MAX_FRAMES);
        let count = count.ok_or_else(|| {
            let before = if self.0 > 0 { format!(" after {} of other cameras", self.0) } else { String::new() };
            let found = format!("{} seconds at {fps} a second{before}", end - start);
            Fault::whole(format!("a shot of at most {MAX_FRAMES} frames, of all cameras together"), found)
        })?;
        self.0 += count;
        Ok(count)
    }
}

/// File names for pictures of views, unique regardless of case: `left/0001.jpg` becomes `left_0001.png`.
pub fn picture_names<'a>(views: impl Iterator<Item = &'a str>, extension: &str) -> Vec<String> {
    // `numbers`: per name, the number at which the search for an unused suffix continues.
    let (mut taken, mut numbers) = (HashSet::new(), HashMap::new());
    let mut unique = |stem: String| {
        let mut name = stem.clone();
        if !taken.insert(stem.to_lowercase()) {
            let number = numbers.entry(stem.to_lowercase()).or_insert(2);
            loop {
                name = format!("{stem}_{number}");
                *number += 1;
                if taken.insert(name.to_lowercase()) {
                    break;
                }
            }
        }
        format!("{name}.{extension}")
    };
    views.map(|view| unique(safe_stem(view))).collect()
}

/// Image names of cameras, for files that name a photograph for each: the cameras' own names, if all are names of
/// pictures in or below a folder, else [`picture_names`].
pub(super) fn image_names(cameras: &[(String, Camera)]) -> Vec<String> {
    let names: Vec<&str> = cameras.iter().map(|(name, _)| &name[..]).collect();
    let is_picture = |name: &&str| {
        let path = Path::new(name);
        let suffix = path.extension().unwrap_or_default().to_string_lossy().to_lowercase();
        matches!(&suffix[..], "jpg" | "jpeg" | "png")
            && path.components().all(|part| matches!(part, Component::Normal(_)))
            && !name.contains(|c: char| c.is_whitespace() || c.is_control() || c == '\\')
    };
    let unique: HashSet<String> = names.iter().map(|name| name.to_lowercase()).collect();
    if unique.len() == names.len() && names.iter().all(is_picture) {
        return names.into_iter().map(str::to_owned).collect();
    }
    picture_names(names.into_iter(), "png")
}

/// Most bytes of a picture's name without number and suffix: file systems allow 255.
const MAX_STEM: usize = 200;

/// Name of a view without a picture's suffix, and with every character that a file system might treat specially
/// replaced.
fn safe_stem(view: &str) -> String {
    let path = Path::new(view);
    // Not every suffix is a picture's: Blender names copies of `Camera` `Camera.001` and so on.
    let is_picture = image::ImageFormat::from_path(path).is_ok();
    let stem = if is_picture { path.with_extension("") } else { path.to_owned() };
    let safe: String = (stem.to_string_lossy().chars())
        .map(|c| if c.is_alphanumeric() || matches!(c, '-' | '_' | '.') { c } else { '_' })
        .collect();
    match safe.trim_start_matches('.') {
        "" => "view".to_owned(),
        name if is_device(name) => format!("_{name}"),
        name => name[..name.floor_char_boundary(MAX_STEM)].to_owned(),
    }
}

/// Whether Windows treats a file of this name as a device, regardless of its extension.
#[must_use]
pub fn is_device(name: &str) -> bool {
    let name = name.split('.').next().unwrap_or_default().to_ascii_lowercase();
    let port = name.strip_prefix("com").or(name.strip_prefix("lpt"));
    matches!(&name[..], "con" | "prn" | "aux" | "nul") || port.is_some_and(|n| matches!(n.as_bytes(), [b'0'..=b'9']))
}
