//! Captures: readers that turn a folder of photographs into posed views and points.
//!
//! [`open`] reads poses, points and image *headers*; [`decode`] decodes one picture, [`PhotoCache`] many of them ahead
//! of time and in parallel. Every view has an ideal pinhole camera: lens distortion is removed on decoding.

mod cache;
mod cameras;
mod colmap;
mod colmap_binary;
mod colmap_records;
mod colmap_text;
mod distortion;
mod error;
mod image_file;
mod images;
mod masks;
mod photo;
mod transforms;
mod views;

use std::path::{Path, PathBuf};

pub use cache::PhotoCache;
pub use cameras::{Cameras, FRAME_RATES, cameras};
pub use distortion::{Distortion, Lens};
pub use error::CaptureError;
pub use images::{ImageSource, decode};
pub use photo::Photo;
pub(crate) use photo::pixel_index;

use glam::Vec3;

use self::views::Frame;
use crate::{
    atomic::folder_of,
    format::has_extension,
    scene::{Camera, center_and_spread},
    stats::median,
};

/// A set of posed photographs, and the sparse points of structure from motion.
#[derive(Clone, Debug)]
pub struct Capture {
    /// Name of the folder.
    pub name: String,
    /// Views, at least two, sorted by name.
    pub views: Vec<View>,
    /// Sparse points in world space, finite; empty if the capture has none.
    pub points: Vec<Point>,
    /// Files of the points, even if points are not wanted; none if the capture names none.
    pub points_files: Vec<PathBuf>,
    /// Lists of views that were ignored in favour of the one read, if the capture is a folder with several: folders of
    /// COLMAP models, and files.
    pub passed_over: Vec<PathBuf>,
}

impl Capture {
    /// Cameras of all views, in their order.
    #[must_use]
    pub fn cameras(&self) -> Vec<Camera> {
        self.views.iter().map(|view| view.camera).collect()
    }

    /// Whether any photograph has a mask applied.
    #[must_use]
    pub fn has_masks(&self) -> bool {
        self.views.iter().any(|view| view.source.mask().is_some())
    }

    /// Whether photographs may be cut out: masks are applied, or files have an alpha channel.
    #[must_use]
    pub fn may_be_cut_out(&self) -> bool {
        self.has_masks() || self.views.iter().any(|view| view.source.stores_alpha)
    }

    /// World positions of all points, rounded to f32, in their order.
    #[must_use]
    pub fn positions(&self) -> Vec<Vec3> {
        self.points.iter().map(|point| point.position.as_vec3()).collect()
    }
}

/// Content of a capture's lists, before its photographs are read.
struct Listed {
    frames: Vec<Frame>,
    /// File that lists the frames, the first if there are several.
    list: PathBuf,
    points: Vec<Point>,
    /// As [`Capture::points_files`].
    points_files: Vec<PathBuf>,
}

/// One posed photograph.
#[derive(Clone, Debug)]
pub struct View {
    /// Name in the capture, unique: COLMAP's image name or the `file_path` of a `transforms.json`, in one that Centaur
    /// wrote without the folder of the photographs.
    pub name: String,
    /// Pinhole camera at the size of the decoded picture: that of [`Lens::pinhole`], downscaled.
    pub camera: Camera,
    /// Origin and processing of the picture.
    pub source: ImageSource,
    /// Indices into [`Capture::points`] of the points found in the picture, ascending; empty if the capture does not
    /// list them.
    pub sees: Vec<u32>,
}

impl View {
    /// Width and height of the view's picture with both sides scaled, at least one pixel each.
    fn scaled_size(&self, scale: f64) -> (u32, u32) {
        let k = self.camera.intrinsics();
        let side = |n: u32| ((f64::from(n) * scale).round() as u32).max(1);
        (side(k.width), side(k.height))
    }
}

/// A sparse point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Point {
    /// World position.
    pub position: glam::DVec3,
    /// Colour, sRGB-encoded.
    pub rgb: [u8; 3],
}

/// Options of reading a capture.
#[derive(Clone, Debug, Default)]
pub struct LoadOptions {
    /// Size of the decoded pictures.
    pub downscale: Downscale,
    /// Image folder instead of `images`, such as `images_4`. For `transforms.json` it replaces a leading `images` in
    /// the paths, or is put before paths without a folder, and before all others if images of some of them are in it.
    pub images: Option<String>,
    /// Apply masks: `masks/<name>.png`, `masks/<stem>.png` or `masks/<name>`, or the `mask_path` of a
    /// `transforms.json`. White is the object, or the only level besides black; transparent pixels count as black.
    /// Masks of several levels need white in at least one of them. With a folder `masks`, or if one image has a mask,
    /// every image needs one.
    pub masks: bool,
    /// Ignore points, as if there were none: their file is not read.
    pub without_points: bool,
}

/// Size of decoded pictures relative to their files, by Pillow's antialiased bicubic filter (INRIA 3DGS,
/// `utils/general_utils.py`).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Downscale {
    /// Full size, as stored.
    #[default]
    Full,
    /// Both sides divided by this number and rounded, halves to even as Python's `round` does for INRIA 3DGS; 0 counts
    /// as 1.
    Factor(u32),
    /// The longer side at most this many pixels.
    MaxSide(u32),
}

impl Downscale {
    /// Size of a `width`×`height` picture after downscaling, at least 1×1.
    #[must_use]
    pub fn size(self, width: u32, height: u32) -> (u32, u32) {
        let scale = match self {
            Self::Full => 1.0,
            Self::Factor(n) => 1.0 / f64::from(n.max(1)),
            Self::MaxSide(n) => (f64::from(n) / f64::from(width.max(height))).min(1.0),
        };
        let side = |n: u32| ((f64::from(n) * scale).round_ties_even() as u32).max(1);
        (side(width), side(height))
    }
}

/// Split into training views and views held out for testing.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Split {
    /// No view is held out.
    All,
    /// Every eighth view by name is held out, beginning with the first, as in INRIA 3DGS (`scene/dataset_readers.py`).
    /// If the capture has its own split (`transforms_test.json`, else `transforms_val.json`; `test_filenames`,
    /// `val_filenames`), that is used instead.
    #[default]
    Every8th,
}

impl Split {
    /// Indices into `views` for training and for testing, each in the order of `views`.
    #[must_use]
    pub fn split(self, views: &[View]) -> (Vec<usize>, Vec<usize>) {
        let mut by_name: Vec<usize> = (0..views.len()).collect();
        by_name.sort_by(|&a, &b| views[a].name.cmp(&views[b].name));
        let mut held_out = vec![false; views.len()];
        if self == Self::Every8th {
            let own_split = views.iter().any(|v| v.source.held_out().is_some());
            for (rank, &i) in by_name.iter().enumerate() {
                held_out[i] = if own_split { views[i].source.held_out() == Some(true) } else { rank % 8 == 0 };
            }
        }
        (0..views.len()).partition(|&i| !held_out[i])
    }
}

/// Whether [`open`] finds a capture in this folder: a COLMAP model or a `transforms*.json`.
#[must_use]
pub fn is_capture(folder: &Path) -> bool {
    colmap::find_model(folder).is_some() || !transforms::find(folder).files.is_empty()
}

/// PLY files of points that the `transforms*.json` of a folder name (`ply_file_path`), whether or not they are read when
/// it is opened; none of files that cannot be read.
#[must_use]
pub fn points_files(folder: &Path) -> Vec<PathBuf> {
    transforms::points_files(folder)
}

/// Checksum that identifies a capture: of the files with its cameras, and of the sizes of its photographs (in the
/// folder `images`, see [`LoadOptions::images`]), masks and points; `None` if there are no such files.
///
/// # Errors
/// If a file with cameras cannot be read.
pub fn fingerprint(folder: &Path, images: Option<&str>) -> Result<Option<u32>, CaptureError> {
    let files = match colmap::find_model(folder) {
        Some(model) => ["cameras", "images"].map(|stem| colmap::file_of(&model, stem)).to_vec(),
        None => transforms::find(folder).files.into_iter().map(|(file, _)| file).collect(),
    };
    let mut sum = flate2::Crc::new();
    for file in &files {
        sum.update(&error::read(file)?);
    }
    let mut beside = vec![];
    // Faults of the capture are reported when it is opened.
    let options = LoadOptions { without_points: true, images: images.map(str::to_owned), ..LoadOptions::default() };
    if let Ok((listed, _)) = listed(folder, folder, &options) {
        beside.extend(listed.points_files);
        for frame in listed.frames {
            beside.extend(frame.mask.or_else(|| views::find_mask(&folder.join("masks"), &frame.name)));
            beside.push(frame.image);
        }
    }
    beside.sort();
    for (file, data) in beside.iter().filter_map(|file| Some((file, file.metadata().ok()?))) {
        let name = file.strip_prefix(folder).unwrap_or(file);
        sum.update(&slashed(name.as_os_str().as_encoded_bytes(), cfg!(windows)));
        sum.update(&data.len().to_le_bytes());
    }
    Ok((!files.is_empty()).then(|| sum.sum()))
}

/// Bytes of a path, the same on all systems.
fn slashed(path: &[u8], is_windows: bool) -> Vec<u8> {
    path.iter().map(|&byte| if is_windows && byte == b'\\' { b'/' } else { byte }).collect()
}

/// Coarsest acceptable spacing of f32 coordinates, relative to the scene's size: a quarter of a pixel in pictures of a
/// thousand.
const COARSEST: f64 = 2.5e-4;

/// Reads the capture at `path`, a folder or a `transforms*.json`.
///
/// In a folder, the first of these is taken: a COLMAP model (`.bin` or `.txt`) in `sparse/0`, `sparse`,
/// `colmap/sparse/0`, the folder itself or `0`, with images in `images/`; `transforms.json` (nerfstudio, instant-ngp);
/// `transforms_train.json` with `transforms_test.json` (NeRF-synthetic), or else with `transforms_val.json`, or one of
/// these alone, without a split. Images of a `transforms.json` of another program that are not beside it are looked
/// for in `images/`. Points of a `transforms.json` are those of its `ply_file_path` (nerfstudio), if it has one, without
/// visibility.
///
/// Image files may be larger or smaller than their camera states (`images_4`) if the aspect ratio agrees within 1 %;
/// the intrinsics are scaled to the file.
///
/// # Errors
/// If a file is missing, truncated or malformed, masks are labels of several things or all black, a camera model cannot
/// be undistorted, a pose is no rigid motion, a name leaves the capture's folder or occurs twice, cameras are too far
/// from the origin for 32-bit floats, or there are fewer than two views.
pub fn open(path: &Path, options: &LoadOptions) -> Result<Capture, CaptureError> {
    let folder = std::fs::metadata(path).map_err(|source| CaptureError::Io { path: path.into(), source })?.is_dir();
    let root = if folder { path } else { folder_of(path) };
    if !folder && !has_extension(path, &["json"]) {
        return Err(CaptureError::invalid(path, "capture", "a folder or a transforms*.json", "another file"));
    }
    if let Some(images) = &options.images {
        views::inside(path, "--images", images)?;
    }
    let (Listed { frames, list, points, points_files }, passed_over) = listed(path, root, options)?;
    let views = views::assemble(frames, &list, root, options)?;
    near_origin(&views, &points, &list)?;
    let absolute = root.canonicalize().unwrap_or_else(|_| root.into());
    let name = absolute.file_name().unwrap_or_default().to_string_lossy().into_owned();
    Ok(Capture { name, views, points, points_files, passed_over })
}

/// Lists of a capture's views.
enum Lists {
    /// The COLMAP model in this folder.
    Colmap(PathBuf),
    /// These files, at least one, each with its part in the split if there are two (`true`: held out).
    Transforms(Vec<(PathBuf, Option<bool>)>),
}

/// Reads the list of the capture at `path`, in the folder `root`; also returns the lists that were ignored.
fn listed(path: &Path, root: &Path, options: &LoadOptions) -> Result<(Listed, Vec<PathBuf>), CaptureError> {
    let (lists, passed_over) = lists(path, root)?;
    let listed = match lists {
        Lists::Colmap(model) => colmap::load(root, &model, (options, !options.without_points))?,
        Lists::Transforms(files) => transforms::load(root, &files, options)?,
    };
    Ok((listed, passed_over))
}

/// Finds the lists of the capture at `path`, a file or the folder `root`, and the other lists in that folder, which are
/// ignored.
fn lists(path: &Path, root: &Path) -> Result<(Lists, Vec<PathBuf>), CaptureError> {
    if path != root {
        return Ok((Lists::Transforms(vec![(path.into(), None)]), vec![]));
    }
    let found = transforms::find(root);
    if let Some(model) = colmap::find_model(root) {
        let passed_over = [colmap::further_models(&model), found.all()].concat();
        return Ok((Lists::Colmap(model), passed_over));
    }
    if found.files.is_empty() {
        if let Some((folder, missing, there)) = colmap::find_incomplete(root) {
            let expected = format!("{missing} beside {there}");
            return Err(CaptureError::invalid(&folder, "COLMAP model", expected, "none: it is missing"));
        }
        let expected =
            "a COLMAP model (in sparse/0, sparse, colmap/sparse/0, the folder itself or 0) or a transforms*.json";
        return Err(CaptureError::invalid(path, "capture", expected, "neither"));
    }
    Ok((Lists::Transforms(found.files), found.passed_over))
}

/// Rejects scenes so far from the origin, such as models in geographic coordinates, that 32-bit floats are too coarse
/// for them.
fn near_origin(views: &[View], points: &[Point], list: &Path) -> Result<(), CaptureError> {
    let centers: Vec<_> = views.iter().map(|view| view.camera.center()).collect();
    let distance = centers.iter().map(|center| center.abs().max_element()).fold(0.0, f64::max);
    let step = distance * f64::from(f32::EPSILON);
    // Of cameras in one place the points say how large it is.
    let depth = median(points.iter().map(|point| point.position.distance(centers[0])).collect());
    let extent = extent_or_depth(views.iter().map(|view| &view.camera), depth).unwrap_or(0.0);
    if extent == 0.0 || step <= COARSEST * extent {
        return Ok(());
    }
    let expected = "a scene near the origin, where 32-bit floats are fine enough; move the model, as COLMAP's model_transformer does";
    let found = format!("coordinates of {distance:.0}, where they are {step:.1e} apart, in a scene of {extent:.3}");
    Err(CaptureError::invalid(list, "camera positions", expected, found))
}

/// Extent of the cameras, the scene's size in INRIA 3DGS (`scene/dataset_readers.py`): 1.1 × the largest distance of a
/// camera from the mean of all camera centres, in world units. 0 without cameras, or if all are at one place.
#[must_use]
pub fn extent<'a>(cameras: impl IntoIterator<Item = &'a Camera>) -> f64 {
    let (mean, farthest) = center_and_spread(cameras);
    if farthest <= ROUNDED * mean.length() { 0.0 } else { 1.1 * farthest }
}

/// [`extent`] of cameras; where they are all in one place, how far away is what they see, `None` if nothing tells.
pub(crate) fn extent_or_depth<'a>(cameras: impl IntoIterator<Item = &'a Camera>, depth: Option<f64>) -> Option<f64> {
    let extent = extent(cameras);
    if extent > ONE_PLACE * depth.unwrap_or(0.0) { Some(extent) } else { depth }
}

/// Photographs that are decoded at once, where all are looked at: while they are, they have their full size.
pub(crate) const DECODED_AT_ONCE: usize = 4;
/// Extent of cameras, as a part of how far away is what they see, up to which they are in one place: it moves by a
/// pixel of a thousand.
const ONE_PLACE: f64 = 1e-3;
/// Centres follow from rotations and translations, which files round to some eight digits: part of their distance from
/// the origin up to which they are one.
const ROUNDED: f64 = 5e-8;

#[cfg(test)]
mod colmap_tests;
#[cfg(test)]
mod distortion_tests;
#[cfg(test)]
mod testing;
#[cfg(test)]
mod tests;
#[cfg(test)]
mod transforms_tests;
