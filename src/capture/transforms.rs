//! Reader of `transforms*.json` of nerfstudio, instant-ngp and NeRF-synthetic: camera→world poses in OpenGL axes.

mod images;
mod lens;

use std::collections::HashSet;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use glam::{DMat3, DVec3};
use rayon::prelude::*;
use serde::Deserialize;
use serde_json::Value;

use self::images::{Images, plain, without};
use self::lens::{LensFields, Stated};
use super::views::{Frame, inside};
use super::{CaptureError, Listed, LoadOptions, Point, error};
use crate::{
    format::ply,
    scene::{frame::OPENGL_FROM_OPENCV, nearest_rotation},
};

/// A `transforms*.json` file. Fields not named here (`aabb_scale`, `applied_transform`, …) do not change what a camera
/// sees.
#[derive(Deserialize)]
struct Transforms {
    #[serde(flatten)]
    lens: LensFields,
    frames: Vec<FrameFields>,
    train_filenames: Option<Vec<String>>,
    test_filenames: Option<Vec<String>>,
    val_filenames: Option<Vec<String>>,
    fps: Option<f64>,
    /// Additional fields written by `centaur cameras`.
    centaur: Option<Ours>,
    /// PLY file of points, in the world of the poses (nerfstudio's `ns-process-data`).
    ply_file_path: Option<String>,
}

#[derive(Deserialize)]
struct Ours {
    y_up: Option<bool>,
    /// Folder of the photographs, with which paths begin and names do not.
    images: Option<String>,
}

/// PLY files of points that the `transforms*.json` of a folder name; none of files that cannot be read.
pub(super) fn points_files(folder: &Path) -> Vec<PathBuf> {
    #[derive(Deserialize)]
    struct Probe {
        ply_file_path: String,
    }
    let named = |file: PathBuf| {
        let probe: Probe = serde_json::from_str(&error::read_text(&file).ok()?).ok()?;
        let name = plain(&probe.ply_file_path);
        Some(folder.join(inside(&file, "/ply_file_path", &name).ok()?))
    };
    find(folder).all().into_iter().filter_map(named).collect()
}

#[derive(Deserialize)]
struct FrameFields {
    #[serde(flatten)]
    lens: LensFields,
    /// Image file; may be absent if no photograph is needed.
    #[serde(default)]
    file_path: String,
    mask_path: Option<String>,
    /// Mask file, as named by VHAP for heads.
    fg_mask_path: Option<String>,
    time: Option<Value>,
    timestep_index: Option<Value>,
    transform_matrix: Vec<[f64; 4]>,
}

/// A number, given as such or as text.
fn number(value: &Option<Value>) -> Option<f64> {
    let value = value.as_ref()?;
    value.as_f64().or_else(|| value.as_str()?.trim().parse().ok())
}

/// The `transforms*.json` files of a folder.
pub(super) struct Found {
    /// Files of the capture, each with its part in the split if there are two.
    pub(super) files: Vec<(PathBuf, Option<bool>)>,
    /// Files of a split that are ignored in favour of one with all frames.
    pub(super) passed_over: Vec<PathBuf>,
}

impl Found {
    /// All files, for when another list takes precedence.
    pub(super) fn all(self) -> Vec<PathBuf> {
        self.files.into_iter().map(|(file, _)| file).chain(self.passed_over).collect()
    }
}

/// Finds the `transforms*.json` files of a folder.
pub(super) fn find(folder: &Path) -> Found {
    let of_split = ["transforms_train.json", "transforms_test.json"].map(|name| folder.join(name));
    let one = folder.join("transforms.json");
    if one.is_file() {
        let passed_over = of_split.into_iter().filter(|file| file.is_file()).collect();
        return Found { files: vec![(one, None)], passed_over };
    }
    let [train, test] = of_split;
    // Validation views are the test split if there is no other.
    let validation = folder.join("transforms_val.json");
    let test = if !test.is_file() && validation.is_file() { validation } else { test };
    let of_split = [train, test];
    let has_both = of_split.iter().all(|file| file.is_file());
    let parts = of_split.into_iter().zip([false, true]).filter(|(file, _)| file.is_file());
    Found { files: parts.map(|(file, held_out)| (file, has_both.then_some(held_out))).collect(), passed_over: vec![] }
}

/// Content of one file.
pub(super) struct Parsed {
    pub(super) frames: Vec<Frame>,
    /// Frames per second, if the frames are a path.
    pub(super) fps: Option<f64>,
    /// See [`super::Cameras::y_up`].
    pub(super) y_up: bool,
    /// PLY file of the points.
    points: Option<PathBuf>,
}

/// Frames and points of all `files`, at least one, whose paths are relative to `root`.
pub(super) fn load(
    root: &Path,
    files: &[(PathBuf, Option<bool>)],
    options: &LoadOptions,
) -> Result<Listed, CaptureError> {
    let (mut frames, mut clouds) = (vec![], vec![]);
    for (path, held_out) in files {
        let parsed = parse(&error::read_text(path)?, path, root, *held_out, (options, true))?;
        frames.extend(parsed.frames.into_iter().map(|frame| if parsed.y_up { frame.turned() } else { frame }));
        clouds.extend(parsed.points.map(|cloud| (cloud, parsed.y_up)));
    }
    // Files of one capture may name the same points.
    clouds.dedup();
    let mut points = vec![];
    for (cloud, y_up) in clouds.iter().filter(|_| !options.without_points) {
        let turn = if *y_up { OPENGL_FROM_OPENCV } else { DVec3::ONE };
        points.extend(ply::read_points(cloud)?.into_iter().map(|(p, rgb)| Point { position: turn * p, rgb }));
    }
    let list = files.first().map_or_else(PathBuf::new, |(path, _)| path.clone());
    Ok(Listed { frames, list, points, points_files: clouds.into_iter().map(|(cloud, _)| cloud).collect() })
}

/// Parses one file. Without `photographs`, names need not be those of files in the capture.
pub(super) fn parse(
    text: &str,
    path: &Path,
    root: &Path,
    held_out: Option<bool>,
    (options, photographs): (&LoadOptions, bool),
) -> Result<Parsed, CaptureError> {
    let fields: Transforms =
        serde_json::from_str(text).map_err(|e| CaptureError::json(path, "a transforms.json with frames", &e))?;
    let split = OwnSplit::of(&fields);
    let names: HashSet<String> = fields.frames.iter().map(|frame| plain(&frame.file_path)).collect();
    if photographs {
        split.check(&names, path)?;
    }
    let instead = options.images.as_deref();
    let inner = names.iter().filter_map(|name| inside(path, "/frames", name).ok());
    // Ours name the folder of photographs, if they are those of its cameras: others may be distorted, or renders.
    let images = Images::new(root, fields.centaur.is_none(), instead, inner);
    let file = File { fields: &fields, path, list: path.into(), root, held_out, split, images, options, photographs };
    let listed: Vec<(usize, &FrameFields)> =
        fields.frames.iter().enumerate().filter(|(_, frame)| file.is_listed(frame)).collect();
    let frames = listed.par_iter().map(|&(i, frame)| file.frame(i, frame)).collect::<Result<Vec<Frame>, _>>()?;
    file.check_folder(&frames, &listed)?;
    let points = file.points()?;
    let y_up = fields.centaur.as_ref().and_then(|ours| ours.y_up).unwrap_or_default();
    Ok(Parsed { frames, fps: fields.fps, y_up, points })
}

/// Split that a file itself states, by names of frames.
struct OwnSplit {
    trained: Option<HashSet<String>>,
    tested: HashSet<String>,
}

impl OwnSplit {
    fn of(fields: &Transforms) -> Self {
        let plain_all = |names: &Vec<String>| -> HashSet<String> { names.iter().map(|name| plain(name)).collect() };
        let tested = [&fields.test_filenames, &fields.val_filenames].into_iter().flatten();
        Self { trained: fields.train_filenames.as_ref().map(plain_all), tested: tested.flat_map(plain_all).collect() }
    }

    /// Refuses names of no frame, as nerfstudio does.
    fn check(&self, frames: &HashSet<String>, path: &Path) -> Result<(), CaptureError> {
        let named = self.trained.iter().flatten().chain(&self.tested);
        named.filter(|name| !frames.contains(*name)).min().map_or(Ok(()), |name| {
            Err(CaptureError::invalid(path, "train_, test_ or val_filenames", "the file_path of a frame", name))
        })
    }

    /// Whether a frame takes part. Frames in neither list, if there is a list of training frames, are left out as by
    /// nerfstudio.
    fn lists(&self, name: &str) -> bool {
        self.trained.as_ref().is_none_or(|trained| trained.contains(name) || self.tested.contains(name))
    }

    /// Whether a frame is held out, if there is a split.
    fn holds_out(&self, name: &str) -> Option<bool> {
        let is_split = self.trained.is_some() || !self.tested.is_empty();
        is_split.then(|| self.tested.contains(name))
    }
}

/// One file, and what its frames are made with.
struct File<'a> {
    fields: &'a Transforms,
    path: &'a Path,
    /// The same, shared by the frames.
    list: Arc<Path>,
    root: &'a Path,
    /// Part of all frames in the split of several files.
    held_out: Option<bool>,
    split: OwnSplit,
    images: Images<'a>,
    options: &'a LoadOptions,
    /// Whether names are those of files in the capture.
    photographs: bool,
}

impl File<'_> {
    fn is_listed(&self, frame: &FrameFields) -> bool {
        !self.photographs || self.split.lists(&plain(&frame.file_path))
    }

    fn frame(&self, i: usize, fields: &FrameFields) -> Result<Frame, CaptureError> {
        let (name, at) = (plain(&fields.file_path), format!("/frames/{i}"));
        let (image, whole) = self.images_of(&name, &at)?;
        let mask = self.mask_of(fields, &at)?;
        let (rotation, translation) = world_to_camera(&fields.transform_matrix).ok_or_else(|| {
            let found = format!("{} rows", fields.transform_matrix.len());
            CaptureError::invalid(self.path, format!("{at}/transform_matrix"), "a 4×4 matrix", found)
        })?;
        let (lens, has_size) = {
            let stated = Stated::new(&fields.lens, &self.fields.lens, self.path, &at);
            (stated.lens(&image, &whole)?, stated.has_size())
        };
        let held_out = self.held_out.or_else(|| self.split.holds_out(&name));
        let time = number(&fields.time).or(number(&fields.timestep_index));
        let folder = self.fields.centaur.as_ref().and_then(|ours| ours.images.as_deref()).map(plain);
        let (name, list) = (without(folder.as_deref(), name), self.list.clone());
        Ok(Frame { name, list, at, image, mask, lens, has_size, rotation, translation, held_out, time, sees: vec![] })
    }

    /// Image of a frame, and the whole one to which its lens refers, instead of which that may be a smaller one.
    fn images_of(&self, name: &str, at: &str) -> Result<(PathBuf, PathBuf), CaptureError> {
        match inside(self.path, &format!("{at}/file_path"), name) {
            Ok(name) => Ok((self.images.find(name), self.images.find_whole(name))),
            Err(e) if self.photographs => Err(e),
            // Without photographs the name is only a label.
            Err(_) => Ok((PathBuf::new(), PathBuf::new())),
        }
    }

    /// Mask that a frame names, if it names one.
    fn mask_of(&self, fields: &FrameFields, at: &str) -> Result<Option<PathBuf>, CaptureError> {
        let masks = [("mask_path", &fields.mask_path), ("fg_mask_path", &fields.fg_mask_path)];
        let named = masks.into_iter().find_map(|(field, mask)| Some((field, mask.as_ref().filter(|m| !m.is_empty())?)));
        match named {
            Some((field, mask)) => self.beside(mask, &format!("{at}/{field}"), self.options.masks),
            None => Ok(None),
        }
    }

    /// PLY file of the points, if the file names one.
    fn points(&self) -> Result<Option<PathBuf>, CaptureError> {
        match &self.fields.ply_file_path {
            Some(name) => self.beside(name, "/ply_file_path", !self.options.without_points),
            None => Ok(None),
        }
    }

    /// File of the capture that is named at `at`. Of one that is not wanted, the name may be any.
    fn beside(&self, name: &str, at: &str, is_wanted: bool) -> Result<Option<PathBuf>, CaptureError> {
        if !self.photographs {
            return Ok(None);
        }
        match inside(self.path, at, &plain(name)) {
            Ok(inner) => Ok(Some(self.root.join(inner))),
            Err(_) if !is_wanted => Ok(None),
            Err(e) => Err(e),
        }
    }

    /// Refuses images of other folders than the one instead of `images`, if there is one: they would keep their size,
    /// beside smaller ones.
    fn check_folder(&self, frames: &[Frame], listed: &[(usize, &FrameFields)]) -> Result<(), CaptureError> {
        let Some(folder) = self.images.folder().filter(|_| self.photographs) else { return Ok(()) };
        let other = frames.iter().zip(listed).find(|(frame, _)| !frame.image.starts_with(folder));
        other.map_or(Ok(()), |(frame, (_, fields))| {
            let expected = "a path that begins with images/, so that --images can replace that folder";
            Err(CaptureError::invalid(self.path, format!("{}/file_path", frame.at), expected, &fields.file_path))
        })
    }
}

/// World→camera pose from a camera→world matrix in OpenGL axes (x right, y up, z back).
pub(super) fn world_to_camera(rows: &[[f64; 4]]) -> Option<(DMat3, DVec3)> {
    let [a, b, c, ..] = rows else { return None };
    let column = |i: usize| DVec3::new(a[i], b[i], c[i]);
    let rotation = DMat3::from_cols(column(0), -column(1), -column(2)).transpose();
    // The centre is exactly as the matrix states, even if its axes are rounded.
    Some((rotation, -(nearest_rotation(rotation) * column(3))))
}
