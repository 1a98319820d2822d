//! Cameras without a scene, in files that other programs make or read: what a shot is rendered from.
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
use std::path::{Component, Path};

use super::error::Fault;
use super::{FormatError, Kind, gltf, kind, usd};
use crate::scene::{Camera, frame};

/// Cameras in the order in which they are shown.
#[derive(Clone, Debug)]
pub struct CameraFile {
    /// At least one where it has been read, with their names.
    pub cameras: Vec<(String, Camera)>,
    /// How many are shown a second, if they are the frames of a shot or that was asked for.
    pub fps: Option<f64>,
    /// True if they are in a world with y up, as those of glTF and USD; false if they are in the frame of the capture, half a turn
    /// about x away.
    pub y_up: bool,
    /// When each of them is seen, in seconds on the clock of the file; empty if they are no frames of a shot.
    pub times: Vec<f64>,
    /// What could not be taken over exactly, one sentence each.
    pub notes: Vec<String>,
}

/// What of a file's cameras is read.
#[derive(Clone, Copy, Debug, Default)]
pub struct Sampling<'a> {
    /// Frames a second of those that move; `None`: what the file states, else [`DEFAULT_FPS`].
    pub fps: Option<f64>,
    /// Only the cameras of these names, or numbers from 0 where no name is meant; empty: all that move, or all where none does.
    pub only: &'a [String],
    /// All as they are at this time, in seconds, none of them moving; `None`: frame by frame.
    pub time: Option<f64>,
    /// None of those that [`write_cameras_with_scene`] has added.
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

/// Frames a second where nothing else is stated.
pub const DEFAULT_FPS: f64 = 30.0;

/// Most frames of a shot, and of all cameras of a file together: 20 minutes at 30 frames a second. Two keys in a small file ask for
/// all of them.
pub const MAX_FRAMES: usize = 36_000;

/// What a camera that moves is called in files that we write.
pub(super) const NAME: &str = "path";

/// Most characters of a camera's name.
const MAX_NAME: usize = 100;

/// A name as cameras have it: it stands in that of each frame, and many cameras can share one.
pub(super) fn short(name: &str) -> String {
    name.chars().take(MAX_NAME).collect()
}

/// What is expected of a file, and what of what it holds, where it is a scene without cameras. See [`FormatError::is_lack_of_cameras`].
pub(super) const NO_CAMERAS: [&str; 3] =
    ["a file that can hold cameras: .glb, .gltf, .usda, .usdc, .usdz or .json", "cameras", "a camera"];

/// How to come by cameras of a scene that has none.
const ADVICE: &str = "`centaur cameras orbit` makes a path around any scene";

/// Extensions of files that [`write_cameras`] writes; a path that has none of them is a folder for a COLMAP model.
pub const WRITABLE_CAMERAS: &[&str] = &["json", "glb", "gltf", "usda"];

impl CameraFile {
    /// The same cameras in a world that is y up, or in the frame of the capture.
    #[must_use]
    pub fn in_frame(mut self, y_up: bool) -> Self {
        if self.y_up != y_up {
            self.cameras.iter_mut().for_each(|(_, camera)| *camera = turned(camera));
        }
        self.y_up = y_up;
        self
    }

    /// When each of them is seen, in seconds that grow, as keys of files must, also in single precision, and are not negative: from 0
    /// on where nobody says, or where several cameras move at a time.
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

/// Reads the cameras of a `.glb`, `.gltf`, `.usda`, `.usdc` or `.usdz` file, whatever else is in it. One that moves becomes as
/// many cameras as the shot has frames, from the first to the last key of what moves it.
///
/// # Errors
/// If the file is none of these, cannot be read, is malformed, or has no camera, or none of the name that is asked for.
pub fn read_cameras(path: &Path, sampling: &Sampling<'_>) -> Result<CameraFile, FormatError> {
    match kind(path)? {
        Kind::Gltf => gltf::read_cameras(path, sampling),
        Kind::Usd => usd::read_cameras(path, sampling),
        other => {
            let [expected, ..] = NO_CAMERAS;
            Err(Fault::whole(expected, format!("{}; {ADVICE}", other.name())).in_file(path))
        }
    }
}

/// Writes cameras in the format of the path's extension, one of [`WRITABLE_CAMERAS`], or as a COLMAP model into a folder, which
/// is made. Returns the bytes written.
///
/// # Errors
/// If a file cannot be written, or a COLMAP model or `transforms*.json` would replace or hide a capture that is already there.
pub fn write_cameras(path: &Path, file: &CameraFile) -> Result<u64, FormatError> {
    let extension = path.extension().unwrap_or_default().to_string_lossy().to_lowercase();
    match &extension[..] {
        "json" => transforms::write(path, file),
        "glb" | "gltf" => gltf::write_cameras(path, file),
        "usda" => usd::write_cameras(path, &file.clone().in_frame(false)),
        _ => colmap::write(path, &file.clone().in_frame(false).cameras),
    }
}

/// As [`write_cameras`], with all that is in the `.glb` or `.gltf` at `scene`, whose document is written again as it is, but for
/// cameras that were written so before.
///
/// # Errors
/// If `path` has another extension than these, `scene` cannot be read or is something else, or the file cannot be written.
pub fn write_cameras_with_scene(path: &Path, scene: &Path, file: &CameraFile) -> Result<u64, FormatError> {
    if !gltf::is_named(path) {
        return Err(Fault::whole("a name that ends in .glb or .gltf", path.display().to_string()).in_file(path));
    }
    match kind(scene)? {
        Kind::Gltf => gltf::write_with_cameras(path, scene, file),
        other => Err(Fault::whole("a .glb or .gltf, to which cameras can be added", other.name()).in_file(scene)),
    }
}

/// A camera of a file: where it is when nothing moves, and the frames that it moves through.
pub(super) struct Found {
    pub(super) name: String,
    pub(super) frames: Vec<Camera>,
    /// When the first frame is, in seconds.
    pub(super) start: f64,
    /// Frames a second; `None` if it does not move.
    pub(super) fps: Option<f64>,
}

/// What `sampling` asks for, of the cameras of a file that are pinholes. Of those that it does not ask for, the first frame will do.
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
    Ok(CameraFile { cameras, fps, y_up, times, notes })
}

/// Names in a message: the first few of them.
pub fn some_of<'a>(mut names: impl Iterator<Item = &'a str>) -> String {
    let mut some: Vec<&str> = names.by_ref().take(8).collect();
    some.extend(names.next().map(|_| "…"));
    some.join(", ")
}

/// How many frames there are from `start` to `end`, in seconds, both included; `None` if there are more than [`MAX_FRAMES`], or
/// `end` is before `start`. The end counts if it is a hundredth of a frame late, or as much as single precision, in which times often
/// are, cannot tell.
#[must_use]
pub fn frame_count(start: f64, end: f64, fps: f64) -> Option<usize> {
    let unknown = (2.4e-7 * start.abs().max(end.abs()) * fps).min(0.5);
    let last = ((end - start) * fps + unknown.max(0.01)).floor();
    (0.0..MAX_FRAMES as f64).contains(&last).then(|| last as usize + 1)
}

/// How many frames of a file's cameras have been read, of [`MAX_FRAMES`].
#[derive(Default)]
pub(super) struct Frames(usize);

impl Frames {
    /// As [`frame_count`], of a further camera.
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

/// File names for pictures of views, each one once whatever the case of its letters: `left/0001.jpg` becomes `left_0001.png`.
pub fn picture_names<'a>(views: impl Iterator<Item = &'a str>, extension: &str) -> Vec<String> {
    // With the number from which on a further one of the same name is numbered.
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

/// What cameras are called in files that name a photograph for each: as they are called, where all of those are names of pictures in or
/// below a folder, else [`picture_names`].
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

/// Most bytes of the name of a picture without number and suffix: file systems allow 255.
const MAX_STEM: usize = 200;

/// A view's name without the suffix of a picture and without anything that a file system may take for more than a letter.
fn safe_stem(view: &str) -> String {
    let path = Path::new(view);
    // Blender's copies of `Camera` are `Camera.001` and so on.
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

/// Whether Windows takes a file of this name for a device, whatever follows a dot in it.
fn is_device(name: &str) -> bool {
    let name = name.split('.').next().unwrap_or_default().to_ascii_lowercase();
    let port = name.strip_prefix("com").or(name.strip_prefix("lpt"));
    matches!(&name[..], "con" | "prn" | "aux" | "nul") || port.is_some_and(|n| matches!(n.as_bytes(), [b'0'..=b'9']))
}
