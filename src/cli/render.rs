mod write;

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::{Context as _, Result, bail};
use centaur::format::gltf::Source;
use centaur::format::{
    self, CameraFile, DEFAULT_FPS, MAX_FRAMES, ReadOptions, Sampling, SceneFile, frame_count, read_file,
};
use centaur::render::contract::{ImageModel, ShDirection};
use centaur::render::gpu::{Gpu, GpuError, LayeredPicture, LayeredRenderer, Picture, Renderer};
use centaur::scene::{Camera, HybridScene};
use clap::ValueEnum;

use super::interrupt;
use super::output;
use super::progress::Views;
use super::shared::{self, AdapterArgs, AnimationArgs, Backdrop, MessageArgs, PictureArgs, SamplingArgs, UpArgs};
use super::usage;
use super::video::{self, Film};

const EXAMPLES: &str = "\
Examples:
  centaur render garden.glb -o frames
  centaur render biker.spz -o from-around
  centaur render garden.glb --cameras captures/mipnerf360/garden --downscale 4 -o frames
  centaur render garden.glb --cameras shot/transforms.json --format exr -o frames
  centaur render garden.glb --cameras orbit.glb -o frames --video orbit.mp4
  centaur render garden.glb --cameras blender.usdc --camera Shot3 --fps 24 -o frames
  centaur render head.glb --time 1.5 -o smile
  centaur render fox.glb --animation Run --camera side --time 0..1 -o run
  centaur render head.glb --camera front --time 0..4 --fps 25 -o frames --video talk.mp4
  centaur render vase.glb --alpha -o cut-out
  centaur render garden.glb --exr-layers --exr-type half -o layers
  centaur render garden.glb --model ray --sh-direction ray -o as-a-ray-tracer-sees-it

Channels of --exr-layers, in the scene's own colour space (`colorSpace` in the header) and without
the background:
  R G B A                     image, premultiplied; A = 1 - visible fraction of the background
  splats.R .G .B .A           contribution of the splats, as far as meshes do not hide it
  mesh.R .G .B .A             contribution of the meshes, as far as splats do not hide it; it adds
                              up to R G B A with that of the splats
  Z, depth.first              depth along the camera's axis: expected depth, and the depth where
                              alpha passes one half; 1e10 if there is none
  N.X .Y .Z                   unit normal of the nearest mesh layer, facing the camera; y-down as in
                              `centaur inspect`: negate Y and Z for the world of glTF and USD
  count.splats                number of splats that contribute to the pixel";

/// Render a scene from given cameras or, if it has none, from all around
#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub(super) struct Args {
    /// Scene to render: .glb, .gltf, .usda, .usdc or .usdz, or splats alone in any other format that `centaur convert` reads
    #[arg(value_name = "SCENE")]
    scene: PathBuf,
    /// Cameras to render from: `embedded` (those in the scene file), or a file or folder with cameras
    ///
    /// A folder is a capture or a COLMAP model. A file is nerfstudio's `transforms*.json` or `camera_path.json`, or a
    /// .glb, .gltf, .usda, .usdc or .usdz, whose moving cameras (animated themselves, or attached to something
    /// animated) are rendered frame by frame. Photographs are not needed if the size of images is stated. `centaur
    /// cameras` makes such files.
    ///
    /// A scene without cameras is rendered from 8 places in a ring around it, `view_0` to `view_7`, in images of
    /// 1024×768, as by `centaur cameras orbit`; --up sets it upright.
    #[arg(long, value_name = "embedded|PATH", default_value = "embedded")]
    cameras: PathBuf,
    #[command(flatten)]
    up: UpArgs,
    #[command(flatten)]
    sampling: SamplingArgs,
    /// Time at which an animated glTF scene is rendered, or a range of times, of which a single still camera renders
    /// all frames
    ///
    /// Without it, frames of a moving camera show the scene as animated at their own times, and other images show its
    /// rest pose.
    #[arg(long, value_name = "SECONDS|START..END", value_parser = When::parse, allow_hyphen_values = true)]
    time: Option<When>,
    #[command(flatten)]
    played: AnimationArgs,
    /// Folder for the images, which are named after the cameras
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    /// Format of the images [default: png, with --exr-layers exr]
    #[arg(long, value_enum)]
    format: Option<Format>,
    /// Also encode the PNG images, in order, as a video (H.264, 4:2:0), using the `ffmpeg` on PATH
    #[arg(long, value_name = "FILE.mp4", value_parser = output::path(|path| output::with_extension(path, &["mp4"])))]
    video: Option<PathBuf>,
    #[command(flatten)]
    look: LookArgs,
    #[command(flatten)]
    adapter: AdapterArgs,
    #[command(flatten)]
    loading: PictureArgs,
    #[command(flatten)]
    messages: MessageArgs,
}

/// What is rendered of a scene.
#[derive(clap::Args)]
#[command(next_help_heading = "Picture")]
struct LookArgs {
    /// Image model: how Gaussians are projected and ordered
    #[arg(long, value_enum, default_value_t = Model::Ewa)]
    model: Model,
    /// View direction for which `--model ray` evaluates the colour of a splat
    #[arg(long, value_enum, value_name = "mean|ray", default_value_t = Direction::Mean)]
    sh_direction: Direction,
    /// Write EXR files with splats, meshes, depth and normals in separate channels (listed below)
    #[arg(long)]
    exr_layers: bool,
    /// Leave out the background: PNG with straight alpha, EXR with premultiplied alpha
    ///
    /// Where the scene blends in sRGB, as is usual, a PNG composited over a colour in the way of browsers matches the
    /// image rendered over that colour, up to rounding. Only highlights brighter than their alpha, which PNG cannot
    /// store, get an alpha as high as their brightness. With --exr-layers, images have alpha anyway.
    #[arg(long, conflicts_with_all = ["exr_layers", "video"])]
    alpha: bool,
    /// Background colour behind the scene [default: as stated by its file, else black]
    #[arg(long, value_enum, conflicts_with_all = ["exr_layers", "alpha"])]
    background: Option<Backdrop>,
    /// Sample type of EXR files; depths and counts always have 32 bits [default: float]
    #[arg(long, value_enum)]
    exr_type: Option<ExrType>,
    /// Compression of EXR files, lossless in either case [default: zip]
    #[arg(long, value_enum)]
    exr_compression: Option<Compression>,
}

#[derive(Clone, Copy, PartialEq, ValueEnum)]
enum Format {
    /// 8 bits, sRGB, over the scene's background (or see --alpha)
    Png,
    /// Floats in linear light, Rec. 709 primaries, over the scene's background (or see --alpha)
    Exr,
}

#[derive(Clone, Copy, PartialEq, ValueEnum)]
enum Model {
    /// Rasterisation of 3DGS, as in training: projections linearised at the means and ordered by the depths of the
    /// means
    Ewa,
    /// Largest value along the ray of each pixel, in exact order, as in ray tracers
    Ray,
}

#[derive(Clone, Copy, PartialEq, ValueEnum)]
enum Direction {
    /// From the camera to the mean of the splat, as in training
    Mean,
    /// Along the ray of the pixel
    Ray,
}

#[derive(Clone, Copy, PartialEq, ValueEnum)]
enum ExrType {
    /// 32 bits
    Float,
    /// 16 bits
    Half,
}

#[derive(Clone, Copy, PartialEq, ValueEnum)]
enum Compression {
    /// Supported by every program
    Zip,
    /// Smaller for noisy images
    Piz,
}

impl LookArgs {
    fn model(&self) -> ImageModel {
        match (self.model, self.sh_direction) {
            (Model::Ewa, _) => ImageModel::Ewa,
            (Model::Ray, Direction::Mean) => ImageModel::Ray(ShDirection::Mean),
            (Model::Ray, Direction::Ray) => ImageModel::Ray(ShDirection::Ray),
        }
    }
}

/// Why nothing has a time.
const STILL: &str = "its cameras are not frames of a path and have no times";

impl Args {
    fn format(&self) -> Format {
        self.format.unwrap_or(if self.look.exr_layers { Format::Exr } else { Format::Png })
    }

    fn is_embedded(&self) -> bool {
        self.cameras == Path::new("embedded")
    }

    /// Rejects incompatible arguments.
    fn check(&self) -> Result<()> {
        let (look, is_exr) = (&self.look, self.format == Some(Format::Exr));
        usage::demand(
            !(look.exr_layers && self.format == Some(Format::Png)),
            "--exr-layers writes EXR files: omit --format png",
        )?;
        usage::demand(
            !(self.is_embedded() && self.loading.images.is_some()),
            "--images applies to photographs: give --cameras CAPTURE, or omit --images",
        )?;
        usage::demand(
            self.is_embedded() || self.up.up.is_none(),
            "--up applies to views of a scene without cameras: omit --cameras or --up",
        )?;
        usage::demand(
            look.model == Model::Ray || look.sh_direction == Direction::Mean,
            "--sh-direction ray needs --model ray: with --model ewa, every splat has one colour",
        )?;
        usage::demand(
            self.video.is_none() || !(look.exr_layers || is_exr),
            "--video is made of PNG images: omit --format exr and --exr-layers",
        )?;
        usage::demand(
            look.exr_layers || is_exr || (look.exr_type.is_none() && look.exr_compression.is_none()),
            "--exr-type and --exr-compression apply to EXR files: give --format exr or --exr-layers",
        )
    }

    /// Single time at which the scene and its cameras are shown, if requested.
    fn moment(&self) -> Option<f64> {
        if let Some(When::At(time)) = self.time { Some(time) } else { None }
    }

    /// File with the cameras.
    fn source(&self) -> &Path {
        if self.is_embedded() { &self.scene } else { &self.cameras }
    }

    /// Cameras around a scene that has none.
    fn around(&self, file: &SceneFile, sampling: &Sampling<'_>) -> Result<CameraFile> {
        let mut shot = self.loading.cameras_around(&self.scene, file, sampling, &self.up)?;
        shot.notes.push(format!(
            "has no cameras: rendered from {} around it, {}; --cameras takes cameras of another file, `centaur cameras orbit` makes a path",
            output::counted(shot.cameras.len(), "place"),
            self.up.said(file)
        ));
        Ok(shot)
    }

    /// Cameras in the frame of the scene, with times where they are frames of a path or of a span.
    fn shot(&self, file: &mut SceneFile) -> Result<CameraFile> {
        let sampling = Sampling { time: self.moment(), ..self.sampling.sampling() };
        let has_none = self.is_embedded() && file.cameras.is_empty();
        let around = has_none.then(|| self.around(file, &sampling)).transpose()?;
        let mut shot = match (around, &file.source) {
            (Some(around), _) => around,
            (None, Some(document)) if self.is_embedded() => {
                self.loading.cameras_of(document, self.source(), &sampling)?
            }
            (None, _) => self.loading.cameras(self.source(), &sampling)?,
        };
        if shot.y_up != file.y_up {
            let (theirs, scenes) =
                if file.y_up { ("y down, as in captures", "y up") } else { ("y up", "y down, as in captures") };
            shot.notes.push(format!(
                "cameras taken to be {theirs}: rotated by 180° about x, because {} is {scenes}",
                self.scene.display()
            ));
        }
        // Where the scene has been read to.
        shot = shot.in_frame(false);
        let moving = moving(file);
        if let Some(When::Span(start, end)) = self.time {
            let document = moving.with_context(|| {
                let scene = self.scene.display();
                let is_played = file.source.as_ref().is_some_and(|document| !document.clips().is_empty());
                let found =
                    if is_played { "one whose animations move cameras at most" } else { "one without animation" };
                format!("{scene}: --time START..END: expected an animated scene, found {found}")
            })?;
            let fps = sampling.fps.or(shot.fps).or(document.fps()).unwrap_or(DEFAULT_FPS);
            shot = span(shot, [start, end], fps)?;
        }
        let idle = self.idle(&shot, moving.is_some(), !has_none);
        shot.notes.extend(idle);
        let times = shot.times.first().zip(shot.times.last());
        let played = moving.filter(|_| self.moment().is_none()).zip(times);
        let played = played.map_or_else(Vec::new, |(document, (first, last))| document.played([*first, *last]));
        file.notes.extend(played);
        Ok(shot)
    }

    /// Says which flags have no effect on a scene that `moves` or not, seen by these cameras, `own` ones or made ones.
    fn idle(&self, shot: &CameraFile, moves: bool, own: bool) -> Vec<String> {
        let has_photographs = self.cameras.is_dir() || format::has_extension(&self.cameras, &["json"]);
        let is_still = shot.times.is_empty();
        let rests = is_still && moves && self.time.is_none();
        let (still, rest) = match self.moment() {
            Some(_) => ("shown at one time", ""),
            None if rests => (STILL, ", and the scene is shown in its rest pose"),
            None => (STILL, ""),
        };
        let idle = [
            ("--fps", is_still && self.video.is_none() && self.sampling.sampling().fps.is_some(), still, rest),
            ("--animation", rests && !self.played.animations.is_empty(), still, rest),
            ("--up", own && self.up.up.is_some(), "has cameras", ""),
            ("--images", !has_photographs && self.loading.images.is_some(), "names no photographs", ""),
        ];
        let said = idle.into_iter().filter(|(_, is_idle, ..)| *is_idle);
        said.map(|(flag, _, why, then)| format!("{why}: {flag} has no effect{then}")).collect()
    }

    /// Fits the near plane to all cameras that there are, whichever of them --camera picks.
    fn fit_near(&self, file: &mut SceneFile, shot: &CameraFile) {
        let picks = Sampling { time: self.moment(), ..self.sampling.sampling() };
        let leaves_out = !self.is_embedded() && !picks.only.is_empty();
        let all = Sampling { only: &[], ..picks };
        let read = (leaves_out && shared::lacks_near(file)).then(|| self.loading.cameras(self.source(), &all));
        // Nobody has asked for those that cannot be read.
        let all = read.and_then(Result::ok).map_or_else(Vec::new, |all| all.in_frame(false).cameras);
        shared::fit_near(file, all.iter().chain(&shot.cameras).map(|(_, camera)| camera));
    }

    /// Path of each camera's image.
    fn pictures(&self, shot: &CameraFile) -> Vec<PathBuf> {
        let extension = if self.format() == Format::Png { "png" } else { "exr" };
        let names = shared::picture_names(shot.cameras.iter().map(|(name, _)| name.as_str()), extension);
        names.iter().map(|name| self.output.join(name)).collect()
    }
}

pub(super) fn run(args: &Args) -> Result<()> {
    args.check()?;
    output::check_folder(&args.output)?;
    let options = ReadOptions { time: args.moment(), animations: &args.played.animations, ..ReadOptions::default() };
    let mut file = read_file(&args.scene, &options)?;
    if let Some(background) = args.look.background {
        file.scene.composition.background = background.color();
    }
    let shot = args.shot(&mut file)?;
    args.fit_near(&mut file, &shot);
    args.video.as_deref().map_or(Ok(()), |path| video::check(path, &args.output, &shot.cameras))?;
    let gpu = args.adapter.open()?;
    let pictures = args.pictures(&shot);
    shared::spare_photographs(&pictures, args.source(), &args.loading.options())?;
    let _folder = output::Folder::make(&args.output)?;
    // Notes on the scene; for cameras in the same file, both have the same notes.
    let is_said = |note: &&String| args.is_embedded() && shot.notes.contains(note);
    let notes: Vec<&String> = file.notes.iter().filter(|note| !is_said(note)).collect();
    let stop = interrupt::stop_flag(&args.messages);
    let drawn = draw(&gpu, &file, &shot, &pictures, args, &stop)?;
    if drawn < pictures.len() {
        return report_interruption(&pictures[..drawn], pictures.len(), &notes, &shot, args);
    }
    let fps = shot.fps.unwrap_or(DEFAULT_FPS);
    let aspect = shot.cameras.first().map_or(1.0, |(_, camera)| video::aspect(camera));
    let film = args.video.as_deref().map(|path| video::write(path, &pictures, (fps, aspect), &stop)).transpose()?;
    if film == Some(Film::Stopped) {
        return report_interruption(&pictures, pictures.len(), &notes, &shot, args);
    }
    if args.messages.json {
        print_json(&gpu, &pictures, &notes, &shot, args)
    } else {
        print(&pictures, &notes, &shot, args)
    }
}

/// Document of an animated scene.
fn moving(file: &SceneFile) -> Option<&Source> {
    file.source.as_ref().filter(|document| document.moves())
}

/// Renders the scene from every camera of the shot, posed anew at each time; where nothing says when a picture is taken, it rests. How many
/// pictures there are at the end: fewer than cameras if that was stopped.
fn draw(
    gpu: &Gpu,
    file: &SceneFile,
    shot: &CameraFile,
    pictures: &[PathBuf],
    args: &Args,
    stop: &AtomicBool,
) -> Result<usize> {
    let (moving, composition) = (moving(file), &file.scene.composition);
    let poses: Vec<Camera> = shot.cameras.iter().map(|(_, camera)| *camera).collect();
    let mut progress = Views::new(&args.messages, "rendering", poses.len());
    let mut kept: Option<AnyRenderer<'_>> = None;
    for (i, ((name, camera), path)) in shot.cameras.iter().zip(pictures).enumerate() {
        if stop.load(Ordering::Relaxed) {
            progress.finish();
            return Ok(i);
        }
        let mut renderer = match (moving.zip(shot.times.get(i)), kept.take()) {
            (None, Some(same)) => same,
            (None, None) => AnyRenderer::new(gpu, &file.scene, &poses, &args.look)?,
            // Only one posed scene is on the GPU at a time.
            (Some((document, &time)), before) => {
                drop(before);
                let posed = document.at(&file.scene, time).with_context(|| args.scene.display().to_string())?;
                AnyRenderer::new(gpu, &posed, &poses, &args.look)?
            }
        };
        let rendered = renderer.render(camera).with_context(|| name.clone())?;
        kept = Some(renderer);
        let picture = write::File { path, camera, composition, args };
        match rendered {
            Rendered::Parts(parts) if args.look.exr_layers => picture.layers(parts)?,
            Rendered::Parts(parts) => picture.picture(parts.flattened(composition.background))?,
            Rendered::Whole(whole) => picture.picture(whole)?,
        }
        progress.advance();
    }
    progress.finish();
    Ok(pictures.len())
}

/// Of pictures that were not made the folder may have those of an earlier render, and of a film there may be an earlier one.
fn report_interruption(drawn: &[PathBuf], all: usize, notes: &[&String], shot: &CameraFile, args: &Args) -> Result<()> {
    interrupt::stopped(if args.messages.json {
        let both: Vec<&String> = notes.iter().copied().chain(&shot.notes).collect();
        output::print_json(&serde_json::json!({ "outcome": "interrupted", "pictures": drawn, "notes": both }))
    } else {
        say(notes, shot, args);
        let (folder, count) = (args.output.display(), drawn.len());
        let left = if count < all { "others may be of an earlier render" } else { "but no film was made of them" };
        output::print(&format!("stopped; {folder}: {count} of {all} pictures are new, {left}"))
    })
}

/// Note if images with higher numbers than the last one are in its folder: a film made of the folder would end with
/// those of another.
fn leftover(pictures: &[PathBuf]) -> Option<String> {
    let [_, .., last] = pictures else { return None };
    let (stem, extension) = (last.file_stem()?.to_str()?, last.extension()?.to_str()?);
    let (name, digits) = stem.split_at(stem.trim_end_matches(|c: char| c.is_ascii_digit()).len());
    let (width, number) = (digits.len(), digits.parse::<u32>().ok()?);
    let exists = |n: &u32| last.with_file_name(format!("{name}{n:0width$}.{extension}")).exists();
    let count = (number.checked_add(1)?..=u32::MAX).take_while(exists).count();
    let are = if count == 1 { "is" } else { "are" };
    (count > 0)
        .then(|| format!("{} after {stem}.{extension} {are} of an earlier render", output::counted(count, "picture")))
}

fn print_json(gpu: &Gpu, pictures: &[PathBuf], notes: &[&String], shot: &CameraFile, args: &Args) -> Result<()> {
    let left = leftover(pictures);
    let both: Vec<&String> = notes.iter().copied().chain(&shot.notes).chain(&left).collect();
    let mut outcome = serde_json::json!({ "pictures": pictures, "adapter": gpu.adapter(), "notes": both });
    if let Some(path) = &args.video {
        outcome["video"] = serde_json::json!(path);
    }
    output::print_json(&outcome)
}

fn print(pictures: &[PathBuf], notes: &[&String], shot: &CameraFile, args: &Args) -> Result<()> {
    let mut lines = vec![format!("{}: {}", args.output.display(), output::counted(pictures.len(), "picture"))];
    if let Some(path) = &args.video {
        let fps = shot.fps.unwrap_or(DEFAULT_FPS);
        lines.push(format!("{}: {:.1} s at {fps} frames a second", path.display(), pictures.len() as f64 / fps));
    }
    say(notes, shot, args);
    leftover(pictures).iter().for_each(|note| output::note(&format!("{}: {note}", args.output.display())));
    output::print_lines(lines)
}

/// Prints notes on the scene and on its cameras.
fn say(notes: &[&String], shot: &CameraFile, args: &Args) {
    notes.iter().for_each(|note| output::note(&format!("{}: {note}", args.scene.display())));
    shot.notes.iter().for_each(|note| output::note(&format!("{}: {note}", args.source().display())));
}

/// Times, in seconds, at which an animated scene is rendered.
#[derive(Clone, Copy, Debug, PartialEq)]
enum When {
    At(f64),
    Span(f64, f64),
}

impl When {
    fn parse(text: &str) -> Result<Self, String> {
        match text.split_once("..") {
            None => shared::seconds(text).map(Self::At),
            Some((start, end)) => {
                let (start, end) = (shared::seconds(start)?, shared::seconds(end)?);
                if start <= end {
                    Ok(Self::Span(start, end))
                } else {
                    Err("expected a start before the end".to_owned())
                }
            }
        }
    }
}

/// Frames of one static camera from the first time to the second.
fn span(shot: CameraFile, [start, end]: [f64; 2], fps: f64) -> Result<CameraFile> {
    // A single camera is static, even if it is a frame of a path and has a time.
    let [(_, camera)] = &shot.cameras[..] else {
        let what = if shot.times.is_empty() { "cameras" } else { "frames of a moving one" };
        bail!(
            "--time START..END: expected one still camera, found {} {what}; --camera selects one",
            shot.cameras.len()
        );
    };
    let count = frame_count(start, end, fps).with_context(|| {
        let seconds = end - start;
        format!("--time START..END: expected at most {MAX_FRAMES} frames, found {seconds} s at {fps} a second")
    })?;
    let cameras = (0..count).map(|i| (format!("frame_{i:05}"), *camera)).collect();
    let times = (0..count).map(|i| start + i as f64 / fps).collect();
    Ok(CameraFile { cameras, fps: Some(fps), times, ..shot })
}

/// Renderer: the fast one if it supports the request.
enum AnyRenderer<'g> {
    Whole(Box<Renderer<'g>>),
    Parts(Box<LayeredRenderer<'g>>),
}

enum Rendered {
    Whole(Picture),
    Parts(LayeredPicture),
}

impl<'g> AnyRenderer<'g> {
    fn new(gpu: &'g Gpu, scene: &HybridScene, poses: &[Camera], look: &LookArgs) -> Result<Self, GpuError> {
        Ok(match look.model() {
            ImageModel::Ewa if !look.exr_layers => Self::Whole(Box::new(Renderer::new(gpu, scene, poses)?)),
            model => Self::Parts(Box::new(LayeredRenderer::new(gpu, scene, poses, model)?)),
        })
    }

    fn render(&mut self, camera: &Camera) -> Result<Rendered, GpuError> {
        Ok(match self {
            Self::Whole(renderer) => Rendered::Whole(renderer.render(camera)?),
            Self::Parts(renderer) => Rendered::Parts(renderer.render(camera)?),
        })
    }
}
