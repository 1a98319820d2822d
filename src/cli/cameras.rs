use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result, anyhow, bail};
use centaur::capture::LoadOptions;
use centaur::format::{
    CameraFile, DEFAULT_FPS, Format, FormatError, MAX_FRAMES, ReadOptions, Sampling, Summary, WRITABLE_CAMERAS,
    has_extension, inspect, read_file, write_cameras, write_cameras_with_scene,
};
use centaur::path::{self, Around, PathError, Shot, Spline};
use centaur::scene::{Camera, Intrinsics};
use clap::Subcommand;
use glam::DVec3;

use super::edits::{finite, point, positive};
use super::output;
use super::shared::{self, SamplingArgs, UpArgs, frame_rate, read_cameras};
use super::usage;

const EXAMPLES: &str = "\
Examples:
  centaur cameras orbit garden.glb -o orbit.json --frames 240 --size 1280x720
  centaur cameras spline captures/mipnerf360/garden -o flight.glb --keys 8 --closed
  centaur cameras lemniscate garden.glb -o eight.usda --radius-scale 0.5
  centaur cameras convert blender.glb -o shot.json --fps 24
  centaur cameras orbit biker.spz -o orbit.json --size 1920x1080 --fov 40 --radius-scale 0.8
  centaur cameras orbit garden.glb -o garden-orbit.glb --with-scene
  centaur render garden.glb --cameras orbit.json -o frames --video orbit.mp4

SOURCE is a capture or COLMAP model (folder), a transforms*.json or camera_path.json, or a .glb,
.gltf, .usda, .usdc or .usdz; scenes of Centaur contain the cameras that they were trained from.
Photographs are not needed if the size of images is stated. Coordinates are those of the capture,
y down, also for glTF and USD files of Centaur, which store them rotated by 180 degrees about x;
other glTF and USD files are y up.

To make a path, SOURCE may also be any other scene that `centaur convert` reads. If it has no
cameras, 8 cameras in a ring look at it from 15 degrees above, with 1024x768 pixels and a vertical
field of view of 45 degrees. Its centre and size are those of the box that holds nine tenths of the
splats, weighted by opacity and large ones the less, and of the vertices along each axis. That
centre is also the focus of a path around a scene of which the cameras have no point in common.

The name of OUT determines the format:
  .json          transforms.json of nerfstudio, in the world of SOURCE: transform_matrix is camera
                 to world, with OpenGL axes (x right, y up, z backwards). Also stores `fps` and,
                 under `centaur`, whether the world is y up, which Centaur reads back. `convert`
                 names photographs that are without distortion by their paths from OUT, if they lie
                 below its folder, else by paths in images/: copied there, they make OUT a capture
  .glb, .gltf    one animated camera, y up; the world of a capture (y down) is rotated by 180
                 degrees about x, as in scenes of Centaur, so that both match in Blender. Exact
                 intrinsics are in `extras`
  .usda          one Camera with time samples, also y up, one frame per time code
  a folder       COLMAP's sparse/0/{cameras,images,points3D}.txt: world to camera, OpenCV axes, in
                 the world of SOURCE, turned to y down if it is y up

If a shot in SOURCE begins later than at 0 s, .glb, .gltf and .usda keep its times.

Existing captures are neither replaced nor hidden: a folder that contains one is refused for COLMAP
and for transforms*.json.";

/// Make camera paths from posed cameras, and convert cameras between formats
///
/// Camera paths can be rendered with `centaur render --cameras` and opened in other programs.
#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub(super) struct Args {
    #[command(subcommand)]
    kind: Kind,
}

#[derive(Subcommand)]
enum Kind {
    /// Circle around the point that the cameras look at
    ///
    /// The centre is the point nearest to all optical axes. The circle lies in the plane that fits the cameras best,
    /// has their mean radius and height, starts next to the first camera, and can be looped.
    Orbit {
        #[command(flatten)]
        files: FileArgs,
        #[command(flatten)]
        shot: ShotArgs,
        #[command(flatten)]
        around: AroundArgs,
    },
    /// Smooth flight through the cameras at constant speed
    ///
    /// Cameras are visited in the order of their names (`frame_2` before `frame_10`), or of the file if it is a path.
    Spline {
        #[command(flatten)]
        files: FileArgs,
        #[command(flatten)]
        shot: ShotArgs,
        /// Number of cameras to pass through, evenly selected from all in order [default: all]
        #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(2..))]
        keys: Option<u32>,
        /// Continue from the last camera to the first, so that the shot can be looped
        #[arg(long)]
        closed: bool,
    },
    /// Figure of eight around the mean position of the cameras, facing the point that they look at
    ///
    /// It is as wide as the spread of the cameras across the view, at most half the distance; if the cameras surround
    /// the point, it lies around the direction of the first one. It can be looped.
    Lemniscate {
        #[command(flatten)]
        files: FileArgs,
        #[command(flatten)]
        shot: ShotArgs,
        #[command(flatten)]
        around: AroundArgs,
    },
    /// Convert the cameras to another format
    Convert {
        #[command(flatten)]
        files: FileArgs,
        #[command(flatten)]
        sampling: SamplingArgs,
    },
}

#[derive(clap::Args)]
struct FileArgs {
    /// Source of the cameras: a capture, a scene or a path; to make a path, also a scene without cameras
    #[arg(value_name = "SOURCE")]
    source: PathBuf,
    /// File (.json, .glb, .gltf or .usda) or folder (COLMAP) to write
    #[arg(short, long, value_name = "OUT", value_parser = output::path(writable))]
    output: PathBuf,
    /// Write a copy of SOURCE that contains the path, so that rendering OUT follows it; both are .glb or .gltf
    ///
    /// A path that was added to SOURCE in this way before is replaced.
    #[arg(long)]
    with_scene: bool,
    /// Print one JSON object on stdout
    #[arg(long)]
    json: bool,
}

#[derive(clap::Args)]
#[command(next_help_heading = "Shot")]
struct ShotArgs {
    /// Number of frames
    #[arg(long, value_name = "N", default_value_t = 120, value_parser = clap::value_parser!(u32).range(1..=MAX_FRAMES as i64))]
    frames: u32,
    /// Frames per second
    #[arg(long, value_name = "N", default_value_t = DEFAULT_FPS, value_parser = frame_rate)]
    fps: f64,
    /// Size of the images in pixels [default: that of the cameras]
    #[arg(long, value_name = "WxH", value_parser = size)]
    size: Option<[u32; 2]>,
    /// Vertical field of view in degrees [default: that of the cameras, or their median if they differ]
    #[arg(long, value_name = "DEGREES", value_parser = field_of_view)]
    fov: Option<f64>,
    #[command(flatten)]
    up: UpArgs,
}

#[derive(clap::Args)]
#[command(next_help_heading = "Path")]
struct AroundArgs {
    /// Point to look at, in the world of SOURCE [default: the point nearest to the optical axes of the cameras, or the
    /// middle of the scene if these do not meet]
    #[arg(long, value_name = "X,Y,Z", value_parser = point, allow_hyphen_values = true)]
    focus: Option<DVec3>,
    /// Radius of an orbit, or half the width of a figure of eight [default: from the cameras]
    #[arg(long, value_name = "R", value_parser = positive, allow_hyphen_values = true)]
    radius: Option<f64>,
    /// Height of an orbit above the focus [default: from the cameras], or half the height of a figure of eight
    /// [default: a third of the radius]
    #[arg(long, value_name = "H", value_parser = number, allow_hyphen_values = true)]
    height: Option<f64>,
    /// Factor by which the radius is multiplied
    #[arg(long, value_name = "S", default_value_t = 1.0, value_parser = positive, allow_hyphen_values = true)]
    radius_scale: f64,
    /// Factor by which the height is multiplied
    #[arg(long, value_name = "S", default_value_t = 1.0, value_parser = number, allow_hyphen_values = true)]
    height_scale: f64,
}

/// Maker of a path around a point.
type MakeAround = fn(&[Camera], &Around, &Shot) -> Result<Vec<Camera>, PathError>;

impl ShotArgs {
    fn shot(&self) -> Shot {
        Shot { frames: self.frames as usize, size: self.size, fov_y: self.fov.map(f64::to_radians) }
    }
}

impl AroundArgs {
    fn around(&self) -> Around {
        let Self { focus, radius, height, radius_scale, height_scale } = *self;
        Around { focus, radius, height, radius_scale, height_scale }
    }
}

pub(super) fn run(args: &Args) -> Result<()> {
    match &args.kind {
        Kind::Orbit { files, shot, around } => files.generate_around(shot, around, path::orbit),
        Kind::Spline { files, shot, keys, closed } => {
            let options = Spline { keys: keys.map(|n| n as usize), closed: *closed };
            files.generate(shot, |views, CameraFile { notes, .. }| {
                if let Some(keys) = keys.filter(|&keys| keys as usize > views.len()) {
                    notes.push(format!(
                        "--keys {keys}: there are only {}, which are all keys",
                        output::counted(views.len(), "camera")
                    ));
                }
                path::spline(views, &options, &shot.shot())
            })
        }
        Kind::Lemniscate { files, shot, around } => files.generate_around(shot, around, path::lemniscate),
        Kind::Convert { files, sampling } => {
            files.check()?;
            files.write(read_cameras(&files.source, &sampling.sampling(), &LoadOptions::default())?)
        }
    }
}

impl FileArgs {
    fn is_gltf(&self) -> bool {
        Format::of_path(&self.output).is_some_and(Format::is_gltf)
    }

    /// Whether the output is of a format of scenes, which say when a path begins.
    fn holds_times(&self) -> bool {
        Format::of_path(&self.output).is_some_and(Format::holds_paths)
    }

    /// Refuses, before anything is read, what could not be written at the end.
    fn check(&self) -> Result<()> {
        usage::demand(
            !self.with_scene || self.is_gltf(),
            format!("{}: --with-scene: expected a name that ends in .glb or .gltf", self.output.display()),
        )?;
        if is_folder(&self.output) {
            output::check_folder(&self.output)?;
        } else {
            output::check_file(&self.output)?;
        }
        if !self.with_scene {
            let spared = output::spare(&self.output, [self.source.as_path()]);
            if self.is_gltf() {
                let advice = "--with-scene writes it again with the path added";
                spared.map_err(|error| anyhow!("{error}; {advice}"))?;
            } else {
                spared?;
            }
            self.spare_scene()?;
        }
        Ok(())
    }

    /// The cameras to make a path of: those of the source or, where it is a scene without any, some around it.
    fn views(&self, up: &UpArgs) -> Result<CameraFile> {
        // A path that SOURCE has of us gives way to this one; it is none of the cameras to go by.
        let sampling = Sampling { without_paths: self.with_scene, ..Sampling::default() };
        let read = read_cameras(&self.source, &sampling, &LoadOptions::default());
        let error = match read {
            Ok(mut views) => {
                views.notes.extend(up.up.map(|_| "has cameras: --up has no effect".to_owned()));
                return Ok(views);
            }
            Err(error) => error,
        };
        let is_scene = error.downcast_ref::<FormatError>().is_some_and(FormatError::is_lack_of_cameras);
        // SOG, too, may be a .json.
        if !is_scene && !has_extension(&self.source, &["json"]) {
            return Err(error);
        }
        let scene = match read_file(&self.source, &ReadOptions::default()) {
            Ok(scene) => scene,
            Err(fault) => return Err(if is_scene { fault.into() } else { error }),
        };
        let mut views = shared::cameras_around(&self.source, &scene, &Sampling::default(), up)?;
        let up = up.said(&scene);
        views.notes.push(format!("has no cameras: the path is made from {} around the scene, {up}", shared::PLACES));
        Ok(views)
    }

    /// Rejects writing cameras alone over a scene: a path might get the name of a scene that took hours to train.
    fn spare_scene(&self) -> Result<()> {
        // Unreadable files are no scenes.
        let there =
            Some(&self.output).filter(|file| self.holds_times() && file.is_file()).and_then(|file| inspect(file).ok());
        // Meshes of the document count even if they cannot be read as a scene.
        let has_meshes = |there: &Summary| {
            let counted = there.document.as_ref().and_then(|document| document.counts.get("meshes"));
            there.splats.is_some() || !there.meshes.is_empty() || counted.is_some_and(|count| *count > 0)
        };
        if there.as_ref().is_some_and(has_meshes) {
            bail!("{}: holds a scene, which would be lost: expected another file", self.output.display());
        }
        Ok(())
    }

    /// Generates a path around what the cameras look at. Where they have no such point in common, as a single one, it
    /// is around the middle of the scene, if there is one.
    fn generate_around(&self, shot: &ShotArgs, around: &AroundArgs, make: MakeAround) -> Result<()> {
        self.generate(shot, |views, source| {
            let (around, shot) = (around.around(), shot.shot());
            let made = make(views, &around, &shot);
            let lacks_focus = matches!(made, Err(PathError::NoFocus));
            let scene = lacks_focus.then(|| read_file(&self.source, &ReadOptions::default()).ok()).flatten();
            let Some(focus) = scene.and_then(|scene| shared::middle_of(&scene, source.y_up)) else { return made };
            source.notes.push(
                "optical axes of its cameras do not meet in a point: the path is around the middle of the scene (--focus X,Y,Z)"
                    .to_owned(),
            );
            make(views, &Around { focus: Some(focus), ..around }, &shot)
        })
    }

    /// Generates a path; `make` gets the cameras of the source, and the source.
    fn generate(
        &self,
        shot: &ShotArgs,
        make: impl FnOnce(&[Camera], &mut CameraFile) -> Result<Vec<Camera>, PathError>,
    ) -> Result<()> {
        self.check()?;
        let mut source = self.views(&shot.up)?;
        let views: Vec<Camera> = source.cameras.iter().map(|(_, camera)| *camera).collect();
        let frames = match make(&views, &mut source) {
            Err(e @ (PathError::NoFocus | PathError::Outwards)) => {
                bail!("{}: {e} (--focus X,Y,Z)", self.source.display())
            }
            Err(e @ PathError::NoRadius) => bail!("{}: {e} (--radius R)", self.source.display()),
            frames => frames.with_context(|| self.source.display().to_string())?,
        };
        let named = frames.into_iter().enumerate().map(|(i, camera)| (format!("frame_{i:05}"), camera));
        let cameras: Vec<_> = named.collect();
        let times = (0..cameras.len()).map(|i| i as f64 / shot.fps).collect();
        self.write(CameraFile { cameras, fps: Some(shot.fps), times, images: None, ..source })
    }

    fn write(&self, file: CameraFile) -> Result<()> {
        let bytes = if self.with_scene {
            write_cameras_with_scene(&self.output, &self.source, &file)?
        } else {
            write_cameras(&self.output, &file)?
        };
        let CameraFile { cameras, fps, times, mut notes, y_up, .. } = file;
        if self.is_gltf() && cameras.iter().any(|(_, camera)| camera.intrinsics() != cameras[0].1.intrinsics()) {
            notes.push(
                "intrinsics differ between frames, which glTF cannot animate: every frame has a camera of its own"
                    .to_owned(),
            );
        }
        if y_up && is_folder(&self.output) {
            notes.push(
                "its world is y up: rotated by 180° about x into the frame of captures (y down), which COLMAP models have"
                    .to_owned(),
            );
        }
        if times.windows(2).any(|pair| pair[0] >= pair[1]) {
            notes.push(
                "several cameras move: the path has the frames of one after those of the other; --camera NAME selects one"
                    .to_owned(),
            );
        }
        let begins = times.first().copied().unwrap_or_default();
        if begins != 0.0 && !(self.holds_times() && begins > 0.0) {
            // Blender's first frame is at a twenty-fourth of a second: rounded, because 17 digits are useless.
            let begins = (1e3 * begins).round() / 1e3;
            notes.push(format!(
                "begins at {begins} s, which {} cannot store: there it begins at 0",
                self.output.display()
            ));
        }
        if self.json {
            return output::print_json(&serde_json::json!({
                "output": self.output, "frames": cameras.len(), "fps": fps, "bytes": bytes, "notes": notes,
            }));
        }
        let k = cameras[0].1.intrinsics();
        let rate = fps
            .map_or_else(String::new, |fps| format!(", {:.1} s at {fps} frames a second", cameras.len() as f64 / fps));
        let what = match (fps, cameras.len()) {
            (Some(_), 1) => "1 frame".to_owned(),
            (Some(_), n) => format!("{n} frames"),
            (None, 1) => "1 camera".to_owned(),
            (None, n) => format!("{n} cameras"),
        };
        notes.iter().for_each(|note| output::note(&format!("{}: {note}", self.source.display())));
        output::print(&format!("{}: {what} of {}×{}{rate}", self.output.display(), k.width, k.height))
    }
}

fn is_folder(path: &Path) -> bool {
    path.is_dir() || path.extension().is_none()
}

fn writable(path: PathBuf) -> Result<PathBuf, String> {
    if is_folder(&path) {
        return Ok(path);
    }
    output::with_extension(path, WRITABLE_CAMERAS).map_err(|e| format!("{e}, or of a folder (no extension)"))
}

fn size(text: &str) -> Result<[u32; 2], String> {
    const MOST: u32 = Intrinsics::MAX_PICTURE_SIDE;
    let side = |text: &str| text.parse().ok().filter(|n| (1..=MOST).contains(n));
    let sides = text.split_once(['x', '×', 'X']).and_then(|(w, h)| Some([side(w)?, side(h)?]));
    sides.ok_or_else(|| format!("expected width and height up to {MOST}, as in 1280x720"))
}

fn field_of_view(text: &str) -> Result<f64, String> {
    let degrees: Option<f64> = text.parse().ok();
    degrees.filter(|d| (0.1..=179.0).contains(d)).ok_or_else(|| "expected degrees from 0.1 to 179".to_owned())
}

fn number(text: &str) -> Result<f64, String> {
    finite(text).map(|[n]| n)
}

#[cfg(test)]
mod tests;
