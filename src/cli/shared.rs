//! Arguments shared by several commands.

use std::collections::HashSet;
use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result, anyhow, bail};
use centaur::atomic::folder_of;
use centaur::capture::{self, Cameras, Capture, Downscale, FRAME_RATES, LoadOptions};
use centaur::format::gltf::Source;
pub(super) use centaur::format::picture_names;
use centaur::format::{self, CameraFile, Sampling, SceneFile};
use centaur::path::{self, Overview};
use centaur::render::gpu::Gpu;
use centaur::scene::frame::OPENGL_FROM_OPENCV;
use centaur::scene::{Camera, Intrinsics};
use clap::ValueEnum as _;
use glam::DVec3;

/// A step that finds out by itself where there is something for it to do.
#[derive(Clone, Copy, clap::ValueEnum)]
pub(super) enum Choice {
    /// Wherever it applies
    Auto,
    /// Never
    Off,
}

impl Choice {
    pub(super) fn is_auto(self) -> bool {
        matches!(self, Self::Auto)
    }
}

/// What is behind a scene whose file does not say so, or in place of what it says. Both are the same in every colour
/// space.
#[derive(Clone, Copy, clap::ValueEnum)]
pub(super) enum Backdrop {
    Black,
    White,
}

impl Backdrop {
    /// Colour as in `background` of a composition.
    pub(super) fn color(self) -> [f32; 3] {
        match self {
            Self::Black => [0.0; 3],
            Self::White => [1.0; 3],
        }
    }
}

/// Which pictures of a capture are used, at what size, and what of them.
#[derive(clap::Args)]
#[command(next_help_heading = "Capture")]
pub(super) struct CaptureArgs {
    #[command(flatten)]
    pub(super) pictures: PictureArgs,
    /// Use only the white parts of masks, one for each photograph (in label images: the one level other than black)
    ///
    /// The mask of images/IMG.jpg is masks/IMG.jpg.png, masks/IMG.png or masks/IMG.jpg, or the `mask_path` (VHAP:
    /// `fg_mask_path`) of a transforms.json. If there is a masks/ folder, or if one photograph has a mask, all need
    /// one. For scores, photograph and render are multiplied by the mask.
    #[arg(long)]
    pub(super) masks: bool,
}

impl CaptureArgs {
    /// Opens the capture; with `without_points` as if it had none, so that their file may be missing if they are not
    /// needed.
    pub(super) fn open(&self, path: &Path, without_points: bool) -> Result<Capture> {
        Ok(capture::open(path, &LoadOptions { without_points, ..self.options() })?)
    }

    pub(super) fn options(&self) -> LoadOptions {
        LoadOptions { masks: self.masks, ..self.pictures.options() }
    }

    /// Says so where there are masks beside the photographs, and none are wanted.
    pub(super) fn idle_masks(&self, capture: &Path) -> Option<String> {
        let folder = if capture.is_dir() { capture } else { folder_of(capture) };
        let masks = folder.join("masks");
        (!self.masks && masks.is_dir()).then(|| format!("{} exists but is not used: --masks uses it", masks.display()))
    }
}

/// Which pictures of a capture are used, and at what size.
#[derive(clap::Args)]
#[command(next_help_heading = "Capture")]
pub(super) struct PictureArgs {
    /// Divide both sides of photographs, or of rendered images, by N, from 1 to 64 (bicubic, antialiased); not with
    /// --max-side
    ///
    /// Published tables of Mip-NeRF 360 use 4 outdoors and 2 indoors.
    #[arg(long, value_name = "N", conflicts_with = "max_side", value_parser = clap::value_parser!(u32).range(1..=64))]
    downscale: Option<u32>,
    /// Shrink photographs, or rendered images, whose longer side has more than this number of pixels (at least 16)
    #[arg(long, value_name = "PIXELS", value_parser = clap::value_parser!(u32).range(16..=i64::from(Intrinsics::MAX_PICTURE_SIDE)))]
    max_side: Option<u32>,
    /// Folder with the photographs, relative to the capture, such as `images_4` [default: images]
    #[arg(long, value_name = "FOLDER")]
    pub(super) images: Option<String>,
}

impl PictureArgs {
    pub(super) fn options(&self) -> LoadOptions {
        let downscale = match (self.downscale, self.max_side) {
            (Some(n), _) => Downscale::Factor(n),
            (None, Some(n)) => Downscale::MaxSide(n),
            (None, None) => Downscale::Full,
        };
        LoadOptions { downscale, images: self.images.clone(), ..LoadOptions::default() }
    }

    /// Cameras of a scene read from a glTF at `path`.
    pub(super) fn cameras_of(&self, source: &Source, path: &Path, sampling: &Sampling<'_>) -> Result<CameraFile> {
        Ok(resized(source.cameras(path, sampling)?, sampling, &self.options()))
    }

    /// As [`cameras_around`].
    pub(super) fn cameras_around(
        &self,
        path: &Path,
        file: &SceneFile,
        sampling: &Sampling<'_>,
        up: &UpArgs,
    ) -> Result<CameraFile> {
        Ok(resized(cameras_around(path, file, sampling, up)?, sampling, &self.options()))
    }

    /// Cameras of a capture, a scene or a path, with or without photographs.
    pub(super) fn cameras(&self, path: &Path, sampling: &Sampling<'_>) -> Result<CameraFile> {
        read_cameras(path, sampling, &self.options())
    }
}

/// Which cameras of a file are used.
#[derive(clap::Args)]
pub(super) struct SamplingArgs {
    /// Use only the camera with this name (or number, from 0); may be given several times [default: moving cameras,
    /// else all]
    #[arg(long, value_name = "NAME")]
    camera: Vec<String>,
    /// Frames per second of moving cameras and of videos [default: as stated by the file, else 30]
    ///
    /// Still images, such as the photographs of a capture, get no times from it.
    #[arg(long, value_name = "N", value_parser = frame_rate)]
    fps: Option<f64>,
}

impl SamplingArgs {
    pub(super) fn sampling(&self) -> Sampling<'_> {
        Sampling { fps: self.fps, only: &self.camera, ..Sampling::default() }
    }
}

/// What of a scene that moves is played.
#[derive(clap::Args)]
pub(super) struct AnimationArgs {
    /// Play only the glTF animation with this name (or number, from 0); may be given several times [default: all,
    /// played together]
    #[arg(long = "animation", value_name = "NAME")]
    pub(super) animations: Vec<String>,
}

/// Parses a time in seconds.
pub(super) fn seconds(text: &str) -> Result<f64, String> {
    text.parse().ok().filter(|t: &f64| t.is_finite()).ok_or_else(|| "expected a number of seconds".to_owned())
}

/// Parses a frame rate per second.
pub(super) fn frame_rate(text: &str) -> Result<f64, String> {
    let rate: Option<f64> = text.parse().ok();
    let expected = || format!("expected a number from {} to {}", FRAME_RATES.start(), FRAME_RATES.end());
    rate.filter(|rate| FRAME_RATES.contains(rate)).ok_or_else(expected)
}

/// What there is to say, beside a capture, of a scene that `read_file` has turned into its frame.
pub(super) fn turned(y_up: bool) -> Option<String> {
    y_up.then(|| {
        "is y up, as usual for glTF and USD: rotated by 180° about x into the frame of captures (y down)".to_owned()
    })
}

/// What there is to say, beside a capture, of a mesh that `mesh_import` has left as it is stored.
pub(super) fn as_stored(y_up: bool) -> Option<String> {
    y_up.then(|| {
        "is a glTF of another program, usually y up, and taken as it is stored: where that is not the frame of the capture (y down), `centaur convert --rotate=180,0,0` rotates it"
            .to_owned()
    })
}

/// Reads cameras of a capture (a folder or `.json`), or of a glTF or USD file.
pub(super) fn read_cameras(path: &Path, sampling: &Sampling<'_>, options: &LoadOptions) -> Result<CameraFile> {
    let is_json = format::has_extension(path, &["json"]);
    if !(is_json || path.is_dir()) {
        let stem = path.file_stem().unwrap_or_default();
        let is_of_model = ["cameras", "images", "frames", "points3D"].iter().any(|name| stem == *name);
        if is_of_model && format::has_extension(path, &["bin", "txt"]) {
            bail!("{}: is a part of a COLMAP model: give the folder, {}", path.display(), folder_of(path).display());
        }
        return Ok(resized(format::read_cameras(path, sampling)?, sampling, options));
    }
    let read = capture::cameras(path, options)?;
    let Cameras { mut cameras, fps: stated, y_up, images_folder: images, passed_over: others, other_size, .. } = read;
    let fps = sampling.fps.or(stated);
    // Only paths state a rate, at whichever rate they are read. A frame of a path has the time of its place in the
    // whole path, even if it is the only one selected; photographs and other stills have no time.
    let mut times = stated.and(fps).map_or_else(Vec::new, |fps| (0..cameras.len()).map(|i| i as f64 / fps).collect());
    let wanted = picked(path, &cameras, sampling)?;
    retain_rows(&mut cameras, &wanted);
    retain_rows(&mut times, &wanted);
    let mut notes = passed_over(&others);
    notes.extend(other_size.map(|[(w, h), (width, height)]| {
        format!("states pictures of {w}×{h}, but has photographs of {width}×{height}: cameras have their size")
    }));
    Ok(CameraFile { cameras, fps, y_up, times, near: None, images, notes })
}

/// From how many places a scene without cameras is seen.
pub(super) const PLACES: usize = 8;

/// Which way is up in a scene without cameras.
#[derive(clap::Args)]
pub(super) struct UpArgs {
    /// Axis of the scene's world that points up, if the scene has no cameras [default: -y; y for glTF and USD of other
    /// programs]
    #[arg(long, value_name = "AXIS", value_enum, allow_hyphen_values = true)]
    pub(super) up: Option<Axis>,
}

/// Axis of a world, in either direction: x, y, z, -x, -y or -z.
#[derive(Clone, Copy, Debug, PartialEq, clap::ValueEnum)]
pub(super) enum Axis {
    #[value(alias = "+x")]
    X,
    #[value(alias = "+y")]
    Y,
    #[value(alias = "+z")]
    Z,
    #[value(name = "-x")]
    MinusX,
    #[value(name = "-y")]
    MinusY,
    #[value(name = "-z")]
    MinusZ,
}

impl Axis {
    fn direction(self) -> DVec3 {
        match self {
            Self::X => DVec3::X,
            Self::Y => DVec3::Y,
            Self::Z => DVec3::Z,
            Self::MinusX => DVec3::NEG_X,
            Self::MinusY => DVec3::NEG_Y,
            Self::MinusZ => DVec3::NEG_Z,
        }
    }
}

impl UpArgs {
    /// Axis of the world of `file` that points up.
    fn of(&self, file: &SceneFile) -> Axis {
        self.up.unwrap_or(if file.y_up { Axis::Y } else { Axis::MinusY })
    }

    /// How views around a scene without cameras stand, and how they could where that was not stated.
    pub(super) fn said(&self, file: &SceneFile) -> String {
        let up = self.of(file);
        let name = up.to_possible_value().map_or_else(String::new, |value| value.get_name().to_owned());
        match self.up {
            Some(_) => format!("with {name} up"),
            None => format!("with {name} up (where it lies on its side, --up z or another axis)"),
        }
    }
}

/// Cameras in a ring around what a scene shows that has none, in the frame of its file.
pub(super) fn cameras_around(
    path: &Path,
    file: &SceneFile,
    sampling: &Sampling<'_>,
    up: &UpArgs,
) -> Result<CameraFile> {
    let named = || path.display().to_string();
    let up = in_world(up.of(file).direction(), file.y_up);
    let Overview { views, radius, .. } = path::overview(&file.scene, up, PLACES).with_context(named)?;
    let mut cameras: Vec<_> = views.into_iter().enumerate().map(|(i, view)| (format!("view_{i}"), view)).collect();
    let wanted = picked(path, &cameras, sampling)?;
    retain_rows(&mut cameras, &wanted);
    let near = Some(near_of(file, radius));
    let cameras = CameraFile { cameras, near, ..CameraFile::default() };
    Ok(cameras.in_frame(file.y_up))
}

/// Middle of what a scene shows, in a y-up world or in the frame of captures; `None` of one with nothing in it.
pub(super) fn middle_of(file: &SceneFile, y_up: bool) -> Option<DVec3> {
    let Overview { focus, .. } = path::overview(&file.scene, path::UP, 1).ok()?;
    Some(in_world(focus, y_up))
}

/// A vector between the frame of captures and a world, in either direction: they differ if the world is y up.
fn in_world(vector: DVec3, y_up: bool) -> DVec3 {
    if y_up { OPENGL_FROM_OPENCV * vector } else { vector }
}

/// Depth of the near plane of a scene without cameras: where nothing says what is too near to be shown, that is little
/// beside what it shows, which has this radius.
fn near_of(file: &SceneFile, radius: f64) -> f32 {
    let near = file.scene.composition.near;
    if file.states_composition { near } else { near.min(0.1 * radius as f32).max(f32::MIN_POSITIVE) }
}

/// Sets the near plane of a scene without cameras that is seen from outside of what it shows: the same as for views
/// around it. From within, the default keeps out what floats before cameras, as in training. Scores are of what is
/// rendered. Returns the depth of the near plane if that is another than before.
pub(super) fn fit_near<'c>(file: &mut SceneFile, mut cameras: impl Iterator<Item = &'c Camera>) -> Option<f32> {
    let before = file.scene.composition.near;
    // A scene with nothing in it has no radius, and needs none.
    if lacks_near(file)
        && let Ok(Overview { focus, radius, .. }) = path::overview(&file.scene, path::UP, 1)
        && cameras.all(|camera| camera.center().distance(focus) > radius)
    {
        file.scene.composition.near = near_of(file, radius);
    }
    let near = file.scene.composition.near;
    (near != before).then_some(near)
}

/// Whether the near plane of a scene depends on its cameras, see [`fit_near`].
pub(super) fn lacks_near(file: &SceneFile) -> bool {
    file.cameras.is_empty() && !file.states_composition
}

/// Which of the cameras of `path` are asked for.
fn picked(path: &Path, cameras: &[(String, Camera)], sampling: &Sampling<'_>) -> Result<Vec<bool>> {
    let names: Vec<&str> = cameras.iter().map(|(name, _)| name.as_str()).collect();
    sampling.picked(&names).map_err(|only| {
        let found = format::some_of(names.iter().copied());
        anyhow!("{}: expected a camera called {only}, found {found}", path.display())
    })
}

/// Keeps the rows that are wanted; of none, none.
fn retain_rows<T>(rows: &mut Vec<T>, wanted: &[bool]) {
    let mut wanted = wanted.iter();
    rows.retain(|_| wanted.next().is_some_and(|&is| is));
}

/// Notes on other lists of views in the folder of a capture: COLMAP models of photographs that it could not connect
/// with the first ones; nerfstudio's file beside the model from which it was made, which may have a split, masks and
/// times, and has its own world frame; files of a split beside one with all frames.
pub(super) fn passed_over(others: &[PathBuf]) -> Vec<String> {
    let name_of = |path: &PathBuf| path.file_name().unwrap_or_default().display().to_string();
    let (files, models): (Vec<_>, Vec<_>) = others.iter().partition(|path| format::has_extension(path, &["json"]));
    let of_models = (!models.is_empty()).then(|| {
        let names: Vec<String> = models.into_iter().map(name_of).collect();
        let names = format::some_of(names.iter().map(String::as_str));
        format!(
            "has further COLMAP models of other photographs ({names}): model 0 is used; to use another, rename it to 0"
        )
    });
    let of_files = files.first().map(|&first| {
        let (name, one) = (name_of(first), first.with_file_name("transforms.json"));
        let taken = if *first != one && one.is_file() { "transforms.json" } else { "a COLMAP model" };
        // One of the two files is no split.
        let advice = if name == "transforms_train.json" && files.len() > 1 {
            "to use the split, move the former away"
        } else {
            "to use that file, give it instead of the folder"
        };
        format!("has {taken}, which is used, and {name}, which is not: {advice}")
    });
    of_models.into_iter().chain(of_files).collect()
}

/// Rejects writing `pictures`, all in one folder, among photographs of the capture (a folder or `.json`) from which the
/// cameras of `path` come, or of a capture that contains the folder: cameras in a file do not state where their
/// photographs are.
pub(super) fn spare_photographs(pictures: &[PathBuf], path: &Path, options: &LoadOptions) -> Result<()> {
    // Folders that do not exist yet contain no photographs.
    let Some(folder) = pictures.iter().find_map(|picture| picture.parent()?.canonicalize().ok()) else {
        return Ok(());
    };
    if path.is_dir() || format::has_extension(path, &["json"]) {
        spare_images(pictures, capture::cameras(path, options)?.images.iter().map(PathBuf::as_path))?;
    }
    let known = path.canonicalize().ok();
    // Photographs of several cameras are in subfolders of the folder for photographs.
    for place in folder.ancestors().take(6).filter(|place| Some(*place) != known.as_deref()) {
        // Unreadable folders are no captures.
        if let Ok(own) = capture::cameras(place, &LoadOptions::default()) {
            spare_images(pictures, own.images.iter().map(PathBuf::as_path))?;
        }
    }
    Ok(())
}

/// Rejects writing `pictures` over any of the photographs `images`, or beside one, where they would be taken for
/// further photographs.
pub(super) fn spare_images<'a>(pictures: &[PathBuf], images: impl Iterator<Item = &'a Path> + Clone) -> Result<()> {
    let there: HashSet<PathBuf> = images.clone().filter_map(|image| image.canonicalize().ok()).collect();
    let is_image = |picture: &&PathBuf| picture.canonicalize().is_ok_and(|place| there.contains(&place));
    if let Some(picture) = pictures.iter().find(is_image) {
        bail!("{}: is a photograph of the capture: expected another folder", picture.display());
    }
    // Paths as in the capture: a photograph may be a link to another place.
    let names: HashSet<&Path> = images.filter(|image| image.exists()).filter_map(Path::parent).collect();
    let folders: HashSet<PathBuf> = names.into_iter().filter_map(|folder| folder.canonicalize().ok()).collect();
    // Masks of the surrounding capture, which may be in nested folders; masks have the same names as renders.
    let around =
        folders.iter().flat_map(|folder| folder.ancestors().take(4).filter(|place| capture::is_capture(place)));
    let masks: HashSet<PathBuf> = around.filter_map(|place| place.join("masks").canonicalize().ok()).collect();
    for folder in pictures.iter().filter_map(|picture| picture.parent()) {
        let Ok(place) = folder.canonicalize() else { continue };
        let what = if folders.contains(&place) {
            "photographs"
        } else if place.ancestors().any(|place| masks.contains(place)) {
            "masks"
        } else {
            continue;
        };
        bail!("{}: holds {what} of the capture: expected another folder", folder.display());
    }
    Ok(())
}

fn resized(mut file: CameraFile, sampling: &Sampling<'_>, options: &LoadOptions) -> CameraFile {
    for (_, camera) in &mut file.cameras {
        let (width, height) = options.downscale.size(camera.intrinsics().width, camera.intrinsics().height);
        *camera = camera.resized(width, height);
    }
    file.fps = file.fps.or(sampling.fps);
    file
}

/// How much is said, and to whom.
#[derive(Clone, clap::Args)]
#[command(next_help_heading = "Messages")]
pub(super) struct MessageArgs {
    /// Show no progress: no bar, and no JSON lines of it on stderr
    #[arg(short, long)]
    pub(super) quiet: bool,
    /// Print one JSON object on stdout at the end; progress, and notes on the way, become JSON lines on stderr
    #[arg(long)]
    pub(super) json: bool,
}

/// Where it runs.
#[derive(clap::Args)]
pub(super) struct AdapterArgs {
    /// GPU adapter to use: any part of a name, an index such as `#1`, or a PCI bus id, as listed by `centaur devices`
    /// [default: the first]
    #[arg(long, value_name = "NAME", env = "CENTAUR_ADAPTER")]
    adapter: Option<String>,
}

impl AdapterArgs {
    pub(super) fn open(&self) -> Result<Gpu> {
        Ok(Gpu::open(self.adapter.as_deref())?)
    }
}
