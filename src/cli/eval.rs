use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result, ensure};
use centaur::capture::{self, Capture, Photo, Split, View};
use centaur::format::gltf::Source;
use centaur::format::{ReadOptions, atomic_write, read_file};
use centaur::metrics::{
    Evaluation, Lpips, Measured, Scores, ViewScore,
    report::{self, Picture, Report},
    side_by_side,
};
use centaur::render::gpu::{Gpu, Renderer};
use centaur::scene::color::linear_to_srgb;
use centaur::scene::{Camera, ColorSpace, HybridScene};
use image::{Rgb, Rgb32FImage, RgbImage};

use super::history::Record;
use super::output;
use super::progress::Views;
use super::shared::{self, AdapterArgs, CaptureArgs, MessageArgs};

const EXAMPLES: &str = "\
Examples:
  centaur eval garden.glb captures/garden --downscale 4
  centaur eval garden.glb captures/garden --downscale 4 -o garden-scores --json";

/// Score a scene on the held-out photographs of its capture
///
/// Prints PSNR, SSIM, FLIP and with --lpips-weights LPIPS per view and their means, with what the scene costs. Views whose index in the list of file
/// names is divisible by 8 are held out, unless the capture brings its own split. Give the same --downscale,
/// --max-side, --images and --masks as in training. Seconds per iteration and the curves of the training stand in scenes that
/// `centaur train` wrote, and in what `centaur convert` made of them as glTF, whatever it left out.
#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub(super) struct Args {
    /// Scene to score: .glb, .gltf, .usda, .usdc or .usdz, or splats alone in any other format that `centaur convert` reads
    #[arg(value_name = "SCENE")]
    scene: PathBuf,
    /// Folder with photographs and poses
    capture: PathBuf,
    /// Folder for report.html, metrics.json and a picture per view: photograph | render | error × 4
    #[arg(short, long, value_name = "DIR")]
    output: Option<PathBuf>,
    #[command(flatten)]
    lpips: LpipsArgs,
    #[command(flatten)]
    adapter: AdapterArgs,
    #[command(flatten)]
    loading: CaptureArgs,
    #[command(flatten)]
    messages: MessageArgs,
}

/// The network that scores what eyes would.
#[derive(clap::Args)]
pub(super) struct LpipsArgs {
    /// Also score LPIPS, by the weights of VGG-16 or `AlexNet` in this file; `python3 datasets-scripts/lpips_weights.py vgg FILE`
    /// downloads and writes it
    #[arg(long, value_name = "FILE.safetensors")]
    lpips_weights: Option<PathBuf>,
}

impl LpipsArgs {
    /// Reads the weights, if there are any.
    pub(super) fn open(&self) -> Result<Option<Lpips>> {
        Ok(self.lpips_weights.as_deref().map(Lpips::open).transpose()?)
    }
}

/// Frames per second are a mean over this many views, each rendered so many times.
const TIMED_VIEWS: usize = 4;
const TIMED_FRAMES: u32 = 5;

pub(super) fn run(args: &Args) -> Result<()> {
    args.output.as_deref().map_or(Ok(()), output::check_folder)?;
    let file = read_file(&args.scene, &ReadOptions::default())?;
    let training = file.source.as_ref().and_then(Source::extras).and_then(Record::read);
    drop(file.source);
    let mut notes: Vec<String> = file.notes.iter().map(ToString::to_string).collect();
    let scene = file.scene;
    let capture = args.loading.open(&args.capture)?;
    // Cameras of other programs may have no size of their own.
    notes.extend(training.as_ref().and_then(|_| other_size(&file.cameras, &capture)));
    if args.loading.masks && capture.views.iter().all(|view| view.source.mask().is_none()) {
        notes.push(format!("{}: has no masks: nothing is masked", args.capture.display()));
    }
    if !args.messages.json {
        notes.iter().for_each(|note| output::note(note));
    }
    let lpips = args.lpips.open()?;
    let gpu = args.adapter.open()?;
    let evaluation = evaluate(
        &gpu,
        &scene,
        &capture,
        &Details {
            scene_file: &args.scene,
            lpips: lpips.as_ref(),
            folder: args.output.as_deref(),
            settings: &training.as_ref().map_or_else(Vec::new, Record::settings),
            training: training.as_ref(),
            messages: &args.messages,
        },
    )?;
    if args.messages.json {
        output::print_json(&Noted { evaluation: &evaluation, notes: &notes })
    } else {
        output::print(evaluation.to_string().trim_end())
    }
}

/// What `--json` prints.
#[derive(serde::Serialize)]
struct Noted<'a> {
    #[serde(flatten)]
    evaluation: &'a Evaluation,
    notes: &'a [String],
}

/// Where pictures are of another size than those that the scene was trained on, if it says so.
fn other_size(trained_on: &[(String, Camera)], capture: &Capture) -> Option<String> {
    let size = |camera: &Camera| (camera.intrinsics().width, camera.intrinsics().height);
    let pair = |view: &View| {
        let (_, camera) = trained_on.iter().find(|(name, _)| *name == view.name)?;
        (size(camera) != size(&view.camera)).then(|| (size(camera), size(&view.camera)))
    };
    let ((w, h), (width, height)) = capture.views.iter().find_map(pair)?;
    Some(format!(
        "pictures are {width}×{height}, those that the scene was trained on {w}×{h}: for its scores at that size give the same \
         --downscale, --max-side or --images"
    ))
}

/// What `evaluate` is told besides scene and capture.
pub(super) struct Details<'a> {
    /// The scene as written, for its size.
    pub(super) scene_file: &'a Path,
    /// Scores LPIPS, if wanted.
    pub(super) lpips: Option<&'a Lpips>,
    /// Where report, metrics and pictures go, if anywhere.
    pub(super) folder: Option<&'a Path>,
    /// Shown in the report.
    pub(super) settings: &'a [(String, String)],
    /// What is known of the training: its time, and the curves of the report.
    pub(super) training: Option<&'a Record>,
    /// Who is told how far it is.
    pub(super) messages: &'a MessageArgs,
}

/// Renders and scores every held-out view; writes the folder of `details`.
pub(super) fn evaluate(gpu: &Gpu, scene: &HybridScene, capture: &Capture, details: &Details<'_>) -> Result<Evaluation> {
    let (_, held_out) = Split::Every8th.split(&capture.views);
    ensure!(!held_out.is_empty(), "{}: expected at least one held-out view, found none", capture.name);
    details.folder.map_or(Ok(()), shared::make_folder)?;
    let views: Vec<&View> = held_out.iter().map(|&i| &capture.views[i]).collect();
    let names = shared::picture_names(views.iter().map(|v| v.name.as_str()), "png");
    if let Some(folder) = details.folder {
        let pictures: Vec<PathBuf> = names.iter().map(|name| folder.join(name)).collect();
        // Also those that are trained on: names of pictures are made anew.
        shared::spare_images(&pictures, capture.views.iter().map(|view| view.source.path()))?;
    }
    let cameras: Vec<Camera> = views.iter().map(|v| v.camera).collect();
    let mut renderer = Renderer::new(gpu, scene, &cameras)?;
    let (mut scores, mut pictures) = (vec![], vec![]);
    let mut progress = Views::new(details.messages, "scoring", views.len());
    for (view, picture) in views.into_iter().zip(names) {
        let render = shared::image(renderer.render(&view.camera)?);
        // Photographs are sRGB-encoded.
        let (render, background) = match scene.composition.color_space {
            ColorSpace::SrgbDisplay => (render, scene.composition.background),
            ColorSpace::LinearDisplay => {
                (shared::mapped(render, linear_to_srgb), scene.composition.background.map(linear_to_srgb))
            }
        };
        let (truth, render, masked) = comparable(&capture::decode(view)?, render, background);
        let score = ViewScore::new(&view.name, &truth, &render, masked, details.lpips);
        scores.push(score.with_context(|| view.name.clone())?);
        if let Some(folder) = details.folder {
            let sheet = side_by_side(&truth, &render)?;
            let caption = caption(&scores[scores.len() - 1]);
            pictures.push(Picture::new(caption, &sheet).with_context(|| view.name.clone())?);
            write_png(&folder.join(picture), &sheet)?;
        }
        progress.advance();
    }
    progress.finish();
    let timed = &cameras[..cameras.len().min(TIMED_VIEWS)];
    let seconds = timed.iter().map(|c| renderer.seconds_per_frame(c, TIMED_FRAMES)).sum::<Result<f64, _>>()?;
    let measured = Measured {
        file_bytes: std::fs::metadata(details.scene_file).map_or(0, |m| m.len()),
        seconds_per_iteration: details.training.and_then(|t| t.seconds_per_iteration),
        trained_on: details.training.and_then(|t| t.adapter.clone()).filter(|name| name != gpu.adapter()),
        fps: Some(timed.len() as f64 / seconds.max(1e-9)),
        peak_gpu_bytes: Some(gpu.peak_bytes()),
        adapter: gpu.adapter().to_owned(),
    };
    let evaluation = Evaluation::new(scene, scores, measured);
    if let Some(folder) = details.folder {
        let page = report::html(&Report {
            title: &capture.name,
            evaluation: &evaluation,
            settings: details.settings,
            plots: &details.training.map_or_else(Vec::new, Record::plots),
            pictures: &pictures,
        });
        atomic_write(&folder.join("report.html"), page.as_bytes())?;
        atomic_write(&folder.join("metrics.json"), &serde_json::to_vec_pretty(&evaluation)?)?;
    }
    Ok(evaluation)
}

/// Of a view's picture in the report.
fn caption(view: &ViewScore) -> String {
    let Scores { psnr, ssim_inria, flip, lpips, .. } = view.scores;
    let lpips = lpips.map_or_else(String::new, |l| {
        let net = l.net.name();
        format!(", LPIPS {net} {:.4} (colours −1…1), {:.4} (0…1)", l.normalized, l.unnormalized)
    });
    format!("{}: {psnr:.2} dB, SSIM {ssim_inria:.4}, FLIP {flip:.4}{lpips}", view.name)
}

/// Photograph and render as they are compared: a mask multiplies both (as in HERA), transparency shows
/// the background of the scene.
fn comparable(photo: &Photo, mut render: Rgb32FImage, background: [f32; 3]) -> (Rgb32FImage, Rgb32FImage, bool) {
    let mut truth = Rgb32FImage::new(photo.width, photo.height);
    for (t, rgba) in truth.pixels_mut().zip(photo.rgba.chunks_exact(4)) {
        let [r, g, b, a] = [0, 1, 2, 3].map(|c| f32::from(rgba[c]) / 255.0);
        let behind = if photo.masked { [0.0; 3] } else { background };
        *t = Rgb([r, g, b]);
        for (c, behind) in t.0.iter_mut().zip(behind) {
            *c = *c * a + behind * (1.0 - a);
        }
    }
    if photo.masked {
        for (r, rgba) in render.pixels_mut().zip(photo.rgba.chunks_exact(4)) {
            r.0 = r.0.map(|c| c * f32::from(rgba[3]) / 255.0);
        }
    }
    (truth, render, photo.masked)
}

/// Writes an 8-bit PNG, whole or not at all.
pub(super) fn write_png(path: &Path, image: &RgbImage) -> Result<()> {
    let mut bytes = std::io::Cursor::new(vec![]);
    image.write_to(&mut bytes, image::ImageFormat::Png).with_context(|| path.display().to_string())?;
    Ok(atomic_write(path, bytes.get_ref())?)
}

#[cfg(test)]
mod tests {
    use centaur::metrics::{LpipsNet, LpipsScore};

    use super::*;

    #[test]
    fn captions_name_network_and_colours_of_lpips() {
        let grey = |v| Rgb32FImage::from_pixel(16, 16, Rgb([v; 3]));
        let mut view = ViewScore::new("a.jpg", &grey(0.5), &grey(0.6), false, None).unwrap();
        assert!(caption(&view).starts_with("a.jpg: 20.17 dB, SSIM ") && !caption(&view).contains("LPIPS"));
        view.scores.lpips = Some(LpipsScore { net: LpipsNet::Vgg, normalized: 0.25, unnormalized: 0.125 });
        let caption = caption(&view);
        assert!(caption.ends_with(", LPIPS VGG 0.2500 (colours −1…1), 0.1250 (0…1)"), "{caption}");
    }

    #[test]
    fn masks_multiply_both_and_transparency_shows_the_background() {
        let photo = |masked: bool| Photo {
            width: 2,
            height: 1,
            rgba: vec![255, 0, 0, 0, 0, 255, 0, 255],
            has_alpha: !masked,
            masked,
        };
        let render = Rgb32FImage::from_pixel(2, 1, Rgb([0.5; 3]));
        let white = [1.0; 3];
        let (truth, masked, _) = comparable(&photo(true), render.clone(), white);
        assert_eq!(truth.as_raw(), &[0.0, 0.0, 0.0, 0.0, 1.0, 0.0]);
        assert_eq!(masked.as_raw(), &[0.0, 0.0, 0.0, 0.5, 0.5, 0.5]);
        let (truth, plain, _) = comparable(&photo(false), render.clone(), white);
        assert_eq!(truth.as_raw(), &[1.0, 1.0, 1.0, 0.0, 1.0, 0.0]);
        assert_eq!(plain, render);
    }
}
