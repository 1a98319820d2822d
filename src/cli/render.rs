mod write;

use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result, bail, ensure};
use centaur::format::gltf::Source;
use centaur::format::{CameraFile, DEFAULT_FPS, MAX_FRAMES, ReadOptions, Sampling, frame_count, read_file};
use centaur::render::contract::{ImageModel, ShDirection};
use centaur::render::gpu::{Gpu, GpuError, LayeredPicture, LayeredRenderer, Picture, Renderer};
use centaur::scene::{Camera, HybridScene};
use clap::ValueEnum;

use super::output;
use super::progress::Views;
use super::shared::{self, AdapterArgs, AnimationArgs, CaptureArgs, MessageArgs, SamplingArgs};
use super::{usage, video};

const EXAMPLES: &str = "\
Examples:
  centaur render garden.glb -o frames
  centaur render garden.glb --cameras captures/garden --downscale 4 -o frames
  centaur render garden.glb --cameras shot/transforms.json --format exr -o frames
  centaur render garden.glb --cameras orbit.glb -o frames --video orbit.mp4
  centaur render garden.glb --cameras blender.usdc --camera Shot3 --fps 24 -o frames
  centaur render head.glb --time 1.5 -o smile
  centaur render fox.glb --animation Run --camera side --time 0..1 -o run
  centaur render head.glb --camera front --time 0..4 --fps 25 -o frames --video talk.mp4
  centaur render vase.glb --alpha -o cut-out
  centaur render garden.glb --layers --exr-type half -o layers
  centaur render garden.glb --model ray --sh-direction ray -o as-a-ray-tracer-sees-it

Channels of --layers, all in the scene's own colour space (`colorSpace` in the header), none over
the background:
  R G B A                     the picture, premultiplied; A = 1 - what is left of the background
  splats.R .G .B .A           what splats contribute where meshes hide them
  mesh.R .G .B .A             what meshes contribute where splats hide them; both sum to R G B A
  Z, depth.first              depth along the camera's axis: expected, and where alpha passes one
                              half; 1e10 where none
  N.X .Y .Z                   unit normal of the nearest mesh layer, towards the camera; y-down as
                              `centaur inspect` has it: negate Y and Z for the world of glTF and USD
  splats.count                splats that contribute to the pixel";

/// Render a scene from given cameras
#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub(super) struct Args {
    /// Scene to render: .glb, .gltf, .usda, .usdc or .usdz, or splats alone in any other format that `centaur convert` reads
    #[arg(value_name = "SCENE")]
    scene: PathBuf,
    /// `embedded` (cameras in the scene's file), or a file or folder that has some
    ///
    /// A capture or COLMAP model (folder), nerfstudio's `transforms*.json` or `camera_path.json`; photographs are not needed
    /// where the size of images is stated. Or a .glb, .gltf, .usda, .usdc or .usdz: cameras that are animated, by themselves or by
    /// what they hang on, are rendered frame by frame. `centaur cameras` makes such files.
    #[arg(long, value_name = "embedded|PATH", default_value = "embedded")]
    cameras: PathBuf,
    #[command(flatten)]
    sampling: SamplingArgs,
    /// What a glTF scene that moves is rendered at: a time, or all frames of a span from a camera that keeps still
    ///
    /// Without it, the frames of a camera that moves show the scene as its animations have it at their times, and other pictures
    /// show it as it rests.
    #[arg(long, value_name = "SECONDS|START..END", value_parser = When::parse, allow_hyphen_values = true)]
    time: Option<When>,
    #[command(flatten)]
    played: AnimationArgs,
    /// Folder for the pictures, named after the cameras
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    /// Kind of picture [default: png, with --layers exr]
    #[arg(long, value_enum)]
    format: Option<Format>,
    /// Make a film of the PNG pictures, in order, by the `ffmpeg` on PATH: H.264, 4:2:0
    #[arg(long, value_name = "FILE.mp4", value_parser = output::path(|path| output::with_extension(path, &["mp4"])))]
    video: Option<PathBuf>,
    #[command(flatten)]
    look: LookArgs,
    #[command(flatten)]
    adapter: AdapterArgs,
    #[command(flatten)]
    loading: CaptureArgs,
    #[command(flatten)]
    messages: MessageArgs,
}

/// What is rendered of a scene.
#[derive(clap::Args)]
#[command(next_help_heading = "Picture")]
struct LookArgs {
    /// What a Gaussian looks like
    #[arg(long, value_enum, default_value_t = Model::Ewa)]
    model: Model,
    /// Direction at which `--model ray` evaluates a splat's colour
    #[arg(long, value_enum, value_name = "mean|ray", default_value_t = Direction::Mean)]
    sh_direction: Direction,
    /// Write EXR files with splats, meshes, depth and normals in channels of their own
    #[arg(long)]
    layers: bool,
    /// Leave the background out: PNG with straight alpha, EXR premultiplied
    ///
    /// A PNG laid over a colour as browsers do gives the picture over that colour, up to rounding, where the scene blends in
    /// sRGB, as a rule. Only highlights that are brighter than their alpha, as PNG cannot have them, cover as much as they are
    /// bright. Layers have alpha anyway.
    #[arg(long, conflicts_with_all = ["layers", "video"])]
    alpha: bool,
    /// Samples of EXR files; depths and counts are 32 bits in either [default: float]
    #[arg(long, value_enum)]
    exr_type: Option<ExrType>,
    /// Compression of EXR files; both are lossless [default: zip]
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
    /// 3DGS rasterisation, which training uses: projections linearised at the means, ordered by these
    Ewa,
    /// The largest value along each pixel's ray, in exact order: what ray tracers do
    Ray,
}

#[derive(Clone, Copy, PartialEq, ValueEnum)]
enum Direction {
    /// From the camera to the mean, as in training
    Mean,
    /// Of the pixel's ray
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
    /// Read by every program
    Zip,
    /// Smaller where pictures are noisy
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

impl Args {
    fn format(&self) -> Format {
        self.format.unwrap_or(if self.look.layers { Format::Exr } else { Format::Png })
    }

    fn is_embedded(&self) -> bool {
        self.cameras == Path::new("embedded")
    }

    /// Refuses arguments that do not go together.
    fn check(&self) -> Result<()> {
        let (look, is_exr) = (&self.look, self.format == Some(Format::Exr));
        usage::demand(
            !(look.layers && self.format == Some(Format::Png)),
            "--layers writes EXR files: leave --format png away",
        )?;
        usage::demand(
            !(self.is_embedded() && self.loading.asks_for_photographs()),
            "--images and --masks are of photographs: say --cameras CAPTURE, or leave them away",
        )?;
        usage::demand(
            look.model == Model::Ray || look.sh_direction == Direction::Mean,
            "--sh-direction ray needs --model ray: projected splats have one colour each",
        )?;
        usage::demand(
            self.video.is_none() || !(look.layers || is_exr),
            "--video is made of PNG pictures: leave --format exr and --layers away",
        )?;
        usage::demand(
            look.layers || is_exr || (look.exr_type.is_none() && look.exr_compression.is_none()),
            "--exr-type and --exr-compression are of EXR files: say --format exr or --layers",
        )
    }
}

pub(super) fn run(args: &Args) -> Result<()> {
    args.check()?;
    output::check_folder(&args.output)?;
    let at = if let Some(When::At(time)) = args.time { Some(time) } else { None };
    let file = read_file(
        &args.scene,
        &ReadOptions { time: at, animations: &args.played.animations, ..ReadOptions::default() },
    )?;
    let sampling = Sampling { time: at, ..args.sampling.sampling() };
    let is_embedded = args.is_embedded();
    let source = if is_embedded { &args.scene } else { &args.cameras };
    let mut shot = match &file.source {
        _ if is_embedded && file.cameras.is_empty() => {
            bail!("{}: holds no cameras: say --cameras PATH", args.scene.display())
        }
        Some(document) if is_embedded => args.loading.cameras_of(document, source, &sampling)?,
        _ => args.loading.cameras(source, &sampling)?,
    };
    if shot.y_up != file.y_up {
        let (theirs, scenes) =
            if file.y_up { ("the frame of captures", "y up") } else { ("y up", "in the frame of captures") };
        shot.notes
            .push(format!("taken to be in {theirs}: turned half about x, as {} is {scenes}", args.scene.display()));
        shot = shot.in_frame(file.y_up);
    }
    let moving = file.source.as_ref().filter(|document| document.moves());
    if let Some(When::Span(start, end)) = args.time {
        ensure!(
            moving.is_some(),
            "{}: --time START..END: expected a scene that moves, found one that rests",
            args.scene.display()
        );
        let known = sampling.fps.or(moving.and_then(Source::fps));
        shot = span(shot, [start, end], known.unwrap_or(DEFAULT_FPS))?;
    }
    if moving.is_some() && args.time.is_none() && sampling.fps.is_some() && shot.times.is_empty() {
        let note = "its cameras are no frames of a path: --fps gives them no times, and the scene is shown as it rests";
        shot.notes.push(note.to_owned());
    }
    // Where nothing says when a picture is taken, the scene rests.
    let times = moving.map_or_else(Vec::new, |_| shot.times.clone());
    let (y_up, rest, cameras) = (file.y_up, file.scene, shot.cameras);
    // Of the scene; of cameras in the same file both say the same.
    let notes: Vec<String> =
        file.notes.iter().filter(|note| !(is_embedded && shot.notes.contains(note))).cloned().collect();
    args.video.as_deref().map_or(Ok(()), |path| video::check(path, &args.output, &cameras))?;
    let gpu = args.adapter.open()?;
    let poses: Vec<Camera> = cameras.iter().map(|(_, camera)| *camera).collect();
    let extension = if args.format() == Format::Png { "png" } else { "exr" };
    let names = shared::picture_names(cameras.iter().map(|(name, _)| name.as_str()), extension);
    let written: Vec<PathBuf> = names.iter().map(|name| args.output.join(name)).collect();
    shared::spare_photographs(&written, source, &args.loading.options())?;
    let _folder = output::Folder::make(&args.output)?;
    let mut progress = Views::new(&args.messages, "rendering", cameras.len());
    let composition = rest.composition;
    let mut kept: Option<AnyRenderer<'_>> = None;
    for (i, ((name, camera), path)) in cameras.iter().zip(&written).enumerate() {
        let mut renderer = match (moving.zip(times.get(i)), kept.take()) {
            (None, Some(same)) => same,
            (None, None) => AnyRenderer::new(&gpu, &rest, &poses, &args.look)?,
            // One on the GPU at a time.
            (Some((document, &time)), before) => {
                drop(before);
                let posed = document.at(&rest, time).with_context(|| args.scene.display().to_string())?;
                AnyRenderer::new(&gpu, &posed, &poses, &args.look)?
            }
        };
        let rendered = renderer.render(camera).with_context(|| name.clone())?;
        kept = Some(renderer);
        let file = write::File { path, camera, composition: &composition, y_up, args };
        match rendered {
            Rendered::Parts(parts) if args.look.layers => file.layers(parts)?,
            Rendered::Parts(parts) => file.picture(parts.flattened(composition.background))?,
            Rendered::Whole(picture) => file.picture(picture)?,
        }
        progress.advance();
    }
    progress.finish();
    let fps = shot.fps.unwrap_or(DEFAULT_FPS);
    if let Some(path) = &args.video {
        video::write(path, &written, fps)?;
    }
    if args.messages.json {
        let both: Vec<&String> = notes.iter().chain(&shot.notes).collect();
        let mut outcome = serde_json::json!({ "pictures": written, "adapter": gpu.adapter(), "notes": both });
        if let Some(path) = &args.video {
            outcome["video"] = serde_json::json!(path);
        }
        return output::print_json(&outcome);
    }
    let mut lines = vec![format!("{}: {}", args.output.display(), output::counted(written.len(), "picture"))];
    if let Some(path) = &args.video {
        lines.push(format!("{}: {:.1} s at {fps} frames a second", path.display(), written.len() as f64 / fps));
    }
    lines.extend(notes.iter().map(|note| format!("note: {}: {note}", args.scene.display())));
    lines.extend(shot.notes.iter().map(|note| format!("note: {}: {note}", source.display())));
    output::print(&lines.join("\n"))
}

/// When a scene that moves is rendered, in seconds.
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

/// One camera that keeps still, at all frames from the first time to the second.
fn span(shot: CameraFile, [start, end]: [f64; 2], fps: f64) -> Result<CameraFile> {
    // A single one keeps still, also where it is a frame of a path and has a time.
    let [(_, camera)] = &shot.cameras[..] else {
        let what = if shot.times.is_empty() { "cameras" } else { "frames of one that moves" };
        bail!(
            "--time START..END: expected one camera that keeps still, found {} {what}; --camera says which",
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

/// The fast renderer where it draws what is asked for.
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
            ImageModel::Ewa if !look.layers => Self::Whole(Box::new(Renderer::new(gpu, scene, poses)?)),
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
