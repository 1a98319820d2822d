//! Reader of `transforms*.json` of nerfstudio, instant-ngp and NeRF-synthetic: camera→world poses in OpenGL axes.

use std::collections::HashSet;
use std::f64::consts::PI;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use glam::{DMat3, DVec3};
use rayon::prelude::*;
use serde::Deserialize;
use serde::de::IgnoredAny;
use serde_json::Value;

use super::distortion::{Distortion, Lens};
use super::views::{Frame, inside};
use super::{CaptureError, Listed, LoadOptions, Point, error, image_file};
use crate::{
    format::ply,
    scene::{Intrinsics, frame::OPENGL_FROM_OPENCV, nearest_rotation},
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

/// Intrinsics, per file or per frame.
#[derive(Deserialize)]
struct LensFields {
    camera_model: Option<String>,
    is_fisheye: Option<bool>,
    ftheta_p0: Option<IgnoredAny>,
    latlong: Option<bool>,
    equirectangular: Option<bool>,
    /// Field of view in degrees, unlike the angles below.
    x_fov: Option<f64>,
    y_fov: Option<f64>,
    camera_angle_x: Option<f64>,
    camera_angle_y: Option<f64>,
    fl_x: Option<f64>,
    fl_y: Option<f64>,
    cx: Option<f64>,
    cy: Option<f64>,
    w: Option<f64>,
    h: Option<f64>,
    k1: Option<f64>,
    k2: Option<f64>,
    k3: Option<f64>,
    k4: Option<f64>,
    k5: Option<f64>,
    k6: Option<f64>,
    p1: Option<f64>,
    p2: Option<f64>,
    /// Distortion k1 to k4, p1 and p2, which replace the separate fields (nerfstudio).
    distortion_params: Option<Vec<f64>>,
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

/// Normalises a relative path: `./train//r_0` becomes `train/r_0`, and so does `.\train\r_0`, as written by programs on
/// Windows.
fn plain(name: &str) -> String {
    let is_separator = |c: char| matches!(c, '/' | '\\');
    let parts: Vec<&str> = name.split(is_separator).filter(|part| !matches!(*part, "" | ".")).collect();
    // An absolute path remains absolute, and is refused as such.
    let root = if name.starts_with(is_separator) { "/" } else { "" };
    format!("{root}{}", parts.join("/"))
}

/// Parses one file. Without `photographs`, names need not be those of files in the capture.
pub(super) fn parse(
    text: &str,
    path: &Path,
    root: &Path,
    held_out: Option<bool>,
    (options, photographs): (&LoadOptions, bool),
) -> Result<Parsed, CaptureError> {
    let file: Transforms =
        serde_json::from_str(text).map_err(|e| CaptureError::json(path, "a transforms.json with frames", &e))?;
    let plain_all =
        |names: &Option<Vec<String>>| -> HashSet<String> { names.iter().flatten().map(|n| plain(n)).collect() };
    let trained = plain_all(&file.train_filenames);
    let tested = &plain_all(&file.test_filenames) | &plain_all(&file.val_filenames);
    let own_split = file.train_filenames.is_some() || !tested.is_empty();
    // Frames in neither list, if there is a list of training frames, are left out as by nerfstudio, which also refuses
    // names of no frame.
    let is_listed =
        |name: &str| !photographs || file.train_filenames.is_none() || trained.contains(name) || tested.contains(name);
    let names: HashSet<String> = file.frames.iter().map(|frame| plain(&frame.file_path)).collect();
    if let Some(name) = trained.union(&tested).filter(|name| photographs && !names.contains(*name)).min() {
        return Err(CaptureError::invalid(path, "train_, test_ or val_filenames", "the file_path of a frame", name));
    }
    let list: Arc<Path> = path.into();
    let in_folder = file.centaur.as_ref().and_then(|ours| ours.images.as_deref()).map(plain);
    // Ours name the folder of photographs, if they are those of its cameras: others may be distorted, or renders.
    let may_be_below = file.centaur.is_none();
    let whole_of = |name: &Path| find_image(root, name, may_be_below);
    let folder = options.images.as_ref().map(|images| root.join(images));
    let are_there = folder.as_ref().is_some_and(|folder| {
        let is_there = |name: &Path| !name.starts_with("images") && with_suffix(&folder.join(name)).is_some();
        names.iter().any(|name| inside(path, "/frames", name).is_ok_and(is_there))
    });
    let image_of = |name: &Path| match &folder {
        Some(folder) => find_in(folder, root, name, are_there),
        None => whole_of(name),
    };
    let frames = file
        .frames
        .par_iter()
        .enumerate()
        .filter(|(_, fields)| is_listed(&plain(&fields.file_path)))
        .map(|(i, fields)| {
            let file_path = plain(&fields.file_path);
            let at = format!("/frames/{i}");
            let (image, whole) = match (inside(path, &format!("{at}/file_path"), &file_path), photographs) {
                (Ok(name), _) => (image_of(name), whole_of(name)),
                (Err(e), true) => return Err(e),
                // Without photographs the name is only a label.
                (Err(_), false) => (PathBuf::new(), PathBuf::new()),
            };
            let masks = [("mask_path", &fields.mask_path), ("fg_mask_path", &fields.fg_mask_path)];
            let named =
                masks.into_iter().find_map(|(field, mask)| Some((field, mask.as_ref().filter(|m| !m.is_empty())?)));
            let mask = match named {
                Some((field, mask)) if photographs => match inside(path, &format!("{at}/{field}"), &plain(mask)) {
                    Ok(inner) => Some(root.join(inner)),
                    // Masks are not wanted.
                    Err(_) if !options.masks => None,
                    Err(e) => return Err(e),
                },
                _ => None,
            };
            let (rotation, translation) = world_to_camera(&fields.transform_matrix).ok_or_else(|| {
                let found = format!("{} rows", fields.transform_matrix.len());
                CaptureError::invalid(path, format!("{at}/transform_matrix"), "a 4×4 matrix", found)
            })?;
            let has = |side: fn(&LensFields) -> Option<f64>| side(&fields.lens).or(side(&file.lens)).is_some();
            Ok(Frame {
                lens: lens(&fields.lens, &file.lens, path, &at, (&image, &whole))?,
                has_size: has(|l| l.w) && has(|l| l.h),
                held_out: held_out.or_else(|| own_split.then(|| tested.contains(&file_path))),
                time: number(&fields.time).or(number(&fields.timestep_index)),
                name: without(in_folder.as_deref(), file_path),
                list: list.clone(),
                at,
                image,
                mask,
                rotation,
                translation,
                sees: vec![],
            })
        })
        .collect::<Result<Vec<Frame>, CaptureError>>()?;
    if let (Some(folder), true) = (&folder, photographs) {
        let listed = file.frames.iter().filter(|fields| is_listed(&plain(&fields.file_path)));
        // Photographs of other folders would keep their size, beside smaller ones.
        if let Some((other, fields)) = frames.iter().zip(listed).find(|(frame, _)| !frame.image.starts_with(folder)) {
            let expected = "a path that begins with images/, so that --images can replace that folder";
            return Err(CaptureError::invalid(path, format!("{}/file_path", other.at), expected, &fields.file_path));
        }
    }
    let points = match &file.ply_file_path {
        Some(name) if photographs => match inside(path, "/ply_file_path", &plain(name)) {
            Ok(inner) => Some(root.join(inner)),
            // Points are not wanted.
            Err(_) if options.without_points => None,
            Err(e) => return Err(e),
        },
        _ => None,
    };
    Ok(Parsed { frames, fps: file.fps, y_up: file.centaur.and_then(|ours| ours.y_up).unwrap_or_default(), points })
}

/// Path of an image without this folder, if it begins with it.
fn without(folder: Option<&str>, path: String) -> String {
    match folder.and_then(|folder| path.strip_prefix(folder)?.strip_prefix('/')) {
        Some(rest) => rest.to_owned(),
        None => path,
    }
}

/// File of an image, with a suffix added if the name has none. Where there is none beside the list and `may_be_below`
/// it, that of a name that does not begin with `images` may lie in `images`.
fn find_image(root: &Path, name: &Path, may_be_below: bool) -> PathBuf {
    let beside = root.join(name);
    let may_be_below = may_be_below && !name.starts_with("images");
    let below = || with_suffix(&root.join("images").join(name)).filter(|_| may_be_below);
    with_suffix(&beside).or_else(below).unwrap_or(beside)
}

/// Same as [`find_image`], with `images` replaced by the given folder. Other names are those of files in that folder if
/// they are without a folder, or if some of them `are_there`.
fn find_in(folder: &Path, root: &Path, name: &Path, are_there: bool) -> PathBuf {
    let beside = root.join(name);
    let is_bare = name.components().nth(1).is_none();
    let file = match name.strip_prefix("images") {
        Ok(rest) => folder.join(rest),
        Err(_) if (is_bare || are_there) && !beside.starts_with(folder) => folder.join(name),
        Err(_) => beside,
    };
    with_suffix(&file).unwrap_or(file)
}

/// The file at this path, else one with a suffix appended, if there is one.
fn with_suffix(path: &Path) -> Option<PathBuf> {
    if path.is_file() {
        return Some(path.to_owned());
    }
    // Appended, not replaced: a name like `frame.001` has no suffix.
    let candidates = ["png", "jpg", "jpeg", "PNG", "JPG", "JPEG"].map(|suffix| {
        let mut with_suffix = path.to_owned().into_os_string();
        with_suffix.push(format!(".{suffix}"));
        PathBuf::from(with_suffix)
    });
    candidates.into_iter().find(|p| p.is_file())
}

/// World→camera pose from a camera→world matrix in OpenGL axes (x right, y up, z back).
pub(super) fn world_to_camera(rows: &[[f64; 4]]) -> Option<(DMat3, DVec3)> {
    let [a, b, c, ..] = rows else { return None };
    let column = |i: usize| DVec3::new(a[i], b[i], c[i]);
    let rotation = DMat3::from_cols(column(0), -column(1), -column(2)).transpose();
    // The centre is exactly as the matrix states, even if its axes are rounded.
    Some((rotation, -(nearest_rotation(rotation) * column(3))))
}

/// Focal lengths, in pixels, that a file or a frame states for pictures of this size (width, height), if any.
fn focal_lengths(
    fields: &LensFields,
    (w, h): (f64, f64),
    path: &Path,
    at: &str,
) -> Result<Option<(f64, f64)>, CaptureError> {
    let of_angle = |side: f64, angle: f64| {
        let is_angle = angle > 0.0 && angle < PI;
        is_angle.then(|| side / (2.0 * (angle / 2.0).tan())).ok_or_else(|| {
            CaptureError::invalid(path, at, "an angle of view between 0 and π radians", format!("{angle} radians"))
        })
    };
    let of_axis = |side, fov: Option<f64>, length: Option<f64>, angle: Option<f64>| match (fov, length) {
        (Some(fov), _) => of_angle(side, fov.to_radians()).map(Some),
        (None, Some(_)) => Ok(length),
        (None, None) => angle.map(|angle| of_angle(side, angle)).transpose(),
    };
    let x = of_axis(w, fields.x_fov, fields.fl_x, fields.camera_angle_x)?;
    let y = of_axis(h, fields.y_fov, fields.fl_y, fields.camera_angle_y)?;
    Ok(x.or(y).zip(y.or(x)))
}

/// Lens of a frame, with the file's values where the frame has none of its own, for its image `whole`, instead of which
/// a smaller one may be used.
fn lens(
    frame: &LensFields,
    file: &LensFields,
    path: &Path,
    at: &str,
    (image, whole): (&Path, &Path),
) -> Result<Lens, CaptureError> {
    let value = |field: fn(&LensFields) -> Option<f64>| field(frame).or_else(|| field(file));
    let (width, height) = match (value(|l| l.w), value(|l| l.h)) {
        // A float cast saturates; invalid sizes fail the aspect check against the image.
        (Some(w), Some(h)) => (w.round() as u32, h.round() as u32),
        // Missing images are reported together later, so any size will do here.
        _ if !image.is_file() => (1, 1),
        _ if whole.is_file() => image_file::header(whole)?.stored().1,
        // Angles apply to any size, but lengths in pixels only to that of the whole image.
        _ if value(|l| l.fl_x).or(value(|l| l.fl_y)).or(value(|l| l.cx)).or(value(|l| l.cy)).is_some() => {
            let expected = "w and h beside fl_x, because the photographs are missing";
            return Err(CaptureError::invalid(path, at, expected, "neither"));
        }
        _ => image_file::header(image)?.stored().1,
    };
    let (w, h) = (f64::from(width), f64::from(height));
    // A frame's value for one axis applies to both, as in instant-ngp.
    let (fx, fy) = match focal_lengths(frame, (w, h), path, at)? {
        None => focal_lengths(file, (w, h), path, at)?,
        own => own,
    }
    .ok_or_else(|| CaptureError::invalid(path, at, "fl_x or camera_angle_x", "neither"))?;
    let cx = value(|l| l.cx).unwrap_or(w / 2.0);
    let cy = value(|l| l.cy).unwrap_or(h / 2.0);
    let intrinsics = Intrinsics { width, height, fx, fy, cx, cy };

    let k = [value(|l| l.k1), value(|l| l.k2), value(|l| l.k3), value(|l| l.k4), value(|l| l.k5), value(|l| l.k6)];
    let k = k.map(|k| k.unwrap_or(0.0));
    let p = [value(|l| l.p1), value(|l| l.p2)].map(|p| p.unwrap_or(0.0));
    let (k, [p1, p2]) = match frame.distortion_params.as_deref().or(file.distortion_params.as_deref()) {
        None => (k, p),
        Some(&[k1, k2, k3, k4, p1, p2]) => ([k1, k2, k3, k4, 0.0, 0.0], [p1, p2]),
        Some(other) => {
            let expected = "six distortion_params: k1, k2, k3, k4, p1, p2";
            return Err(CaptureError::invalid(path, at, expected, other.len().to_string()));
        }
    };
    let [k1, k2, k3, k4, k5, k6] = k;
    let model = frame.camera_model.as_deref().or(file.camera_model.as_deref());
    let unsupported = |model: &str| {
        Err(CaptureError::UnsupportedModel { path: path.into(), place: at.to_owned(), model: model.into() })
    };
    if frame.ftheta_p0.is_some() || file.ftheta_p0.is_some() {
        return unsupported("ftheta");
    }
    if frame.latlong.or(file.latlong).unwrap_or(false) {
        return unsupported("latlong");
    }
    if frame.equirectangular.or(file.equirectangular).unwrap_or(false) {
        return unsupported("equirectangular");
    }
    // A frame's own model has precedence over the file's flag.
    let of_file = file.is_fisheye.filter(|_| frame.camera_model.is_none());
    let fisheye = frame.is_fisheye.or(of_file).unwrap_or(false);
    let distortion = match model {
        None if fisheye => Distortion::Fisheye { k: [k1, k2, k3, k4], p: [0.0; 2], s: [0.0; 2] },
        Some("OPENCV_FISHEYE") => Distortion::Fisheye { k: [k1, k2, k3, k4], p: [0.0; 2], s: [0.0; 2] },
        None
        | Some("SIMPLE_PINHOLE" | "PINHOLE" | "PERSPECTIVE" | "SIMPLE_RADIAL" | "RADIAL" | "OPENCV" | "FULL_OPENCV") => {
            if let Some(model) = model.filter(|_| fisheye) {
                let expected = format!("no is_fisheye beside camera_model {model}");
                return Err(CaptureError::invalid(path, at, expected, "true"));
            }
            // OpenCV divides by the terms of these coefficients, while other programs multiply r⁸ by k4.
            if model != Some("FULL_OPENCV") {
                let unclear = [("k4", k4), ("k5", k5), ("k6", k6)].into_iter().find(|(_, k)| *k != 0.0);
                if let Some((name, value)) = unclear {
                    let expected = format!("{name} = 0 without a fisheye lens or camera_model FULL_OPENCV");
                    return Err(CaptureError::invalid(path, at, expected, value.to_string()));
                }
            }
            if k == [0.0; 6] && [p1, p2] == [0.0; 2] { Distortion::None } else { Distortion::Brown { k, p: [p1, p2] } }
        }
        Some(other) => return unsupported(other),
    };
    Ok(Lens { intrinsics, distortion })
}
