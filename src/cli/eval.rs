use std::collections::HashSet;
use std::io;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::{Context as _, Result};
use centaur::atomic::{self, Staging};
use centaur::capture::{Capture, View, is_capture};
use centaur::evaluate::{Evaluator, held_out};
use centaur::format::{FormatError, ReadOptions, atomic_write, read_file, some_of, stored_bytes};
use centaur::metrics::{
    Evaluation, Lpips, Measured, Scores, ViewScore,
    report::{self, Picture, Report},
    side_by_side,
};
use centaur::render::gpu::Gpu;
use centaur::scene::{Camera, Composition, HybridScene, center_and_spread};
use glam::DQuat;
use image::{ImageBuffer, PixelWithColorType};

use super::history::Record;
use super::interrupt;
use super::output;
use super::progress::Views;
use super::shared::{self, AdapterArgs, Backdrop, CaptureArgs, MessageArgs};
use super::usage;

const EXAMPLES: &str = "\
Examples:
  centaur eval garden.glb captures/mipnerf360/garden --downscale 4
  centaur eval garden.glb captures/mipnerf360/garden --downscale 4 -o garden-scores --json";

/// Score a scene on the held-out photographs of its capture
///
/// Prints PSNR, SSIM, FLIP and (with --lpips-weights) LPIPS per view and their means, and the size and cost of the
/// scene. Held-out views are those whose index in the sorted list of file names is divisible by 8, unless the capture
/// has its own split. Give the same --downscale, --max-side, --images and --masks as in training.
///
/// The time, memory and curves of the training are shown for scenes written by `centaur train`, and for glTF and USD
/// files that `centaur convert` made from them, whatever it left out.
#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub(super) struct Args {
    /// Scene to score: .glb, .gltf, .usda, .usdc or .usdz, or splats alone in any other format that `centaur convert` reads
    #[arg(value_name = "SCENE")]
    scene: PathBuf,
    /// Folder with photographs and camera poses, or a transforms*.json
    capture: PathBuf,
    /// Folder for report.html, metrics.json and an image per view: photograph | render | error × 4
    #[arg(short, long, value_name = "DIR")]
    output: Option<PathBuf>,
    /// Background colour behind the scene, and behind photographs with alpha [default: as stated by the scene, else
    /// black]
    ///
    /// Splat files do not state one; those trained on NeRF-synthetic usually need white.
    #[arg(long, value_enum)]
    background: Option<Backdrop>,
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
    /// Also score LPIPS, with the weights of VGG-16 or AlexNet in this file
    ///
    /// `python3 datasets-scripts/lpips_weights.py vgg FILE` downloads the weights and writes the file.
    #[arg(long, value_name = "FILE.safetensors")]
    lpips_weights: Option<PathBuf>,
}

impl LpipsArgs {
    /// Reads the weights, if given.
    pub(super) fn open(&self) -> Result<Option<Lpips>> {
        Ok(self.lpips_weights.as_deref().map(Lpips::open).transpose()?)
    }
}

pub(super) fn run(args: &Args) -> Result<()> {
    args.output.as_deref().map_or(Ok(()), output::check_folder)?;
    let are_swapped = args.capture.is_file() && is_capture(&args.scene);
    usage::demand(
        !are_swapped,
        format!("expected SCENE CAPTURE, found a capture first: {} {}", args.scene.display(), args.capture.display()),
    )?;
    let mut file = read_file(&args.scene, &ReadOptions::default())?;
    let training = file.record.as_ref().and_then(Record::read);
    file.source = None;
    let mut notes: Vec<String> = file.notes.iter().map(ToString::to_string).collect();
    notes.extend(shared::turned(file.y_up).map(|note| format!("{}: {note}", args.scene.display())));
    if let Some(background) = args.background {
        file.scene.composition.background = background.color();
    }
    let capture = args.loading.open(&args.capture, true)?;
    // Refused before any note is printed.
    args.output.as_deref().map_or(Ok(()), |folder| report_pictures(folder, &capture).map(drop))?;
    let near = shared::fit_near(&mut file, capture.views.iter().map(|view| &view.camera));
    notes.extend(near.map(|near| fitted(&args.scene, near)));
    notes.extend(training.as_ref().and_then(|training| training.of_another(&capture)));
    let passed_over = shared::passed_over(&capture.passed_over).into_iter();
    notes.extend(passed_over.map(|note| format!("{}: {note}", args.capture.display())));
    notes.extend(training.as_ref().and_then(|training| saw(training, &file.cameras, &capture)));
    let other_masks = training.as_ref().and_then(|training| training.other_masks(&capture));
    notes.extend(other_masks.or_else(|| args.loading.idle_masks(&args.capture)));
    // Cameras of other programs may have no size of their own.
    notes.extend(training.as_ref().and_then(|_| other_names(&file.cameras, &capture)));
    notes.extend(training.as_ref().and_then(|_| other_size(&file.cameras, &capture)));
    notes.extend(training.as_ref().and_then(|_| other_places(&file.cameras, &capture)));
    notes.extend(args.output.as_deref().and_then(|folder| leftover(folder, &capture)));
    if args.loading.masks && !capture.has_masks() {
        notes.push(format!("{}: has no masks: nothing is masked", args.capture.display()));
    }
    if !args.messages.json {
        notes.iter().for_each(|note| output::note(note));
    }
    let lpips = args.lpips.open()?;
    let gpu = args.adapter.open()?;
    let evaluation = evaluate(
        &gpu,
        &file.scene,
        &capture,
        &Details {
            scene_file: &args.scene,
            lpips: lpips.as_ref(),
            folder: args.output.as_deref(),
            settings: &training.as_ref().map_or_else(Vec::new, Record::settings),
            training: training.as_ref(),
            messages: &args.messages,
            stop: &interrupt::stop_flag(&args.messages),
        },
    )?;
    let evaluation = match evaluation {
        ControlFlow::Continue(evaluation) => evaluation,
        ControlFlow::Break(scored) => return report_interruption(args, &scored, held_out(&capture)?.len(), &notes),
    };
    if let Some(note) = without_pixels(&evaluation) {
        let note = format!("{}: {note}", args.capture.display());
        if !args.messages.json {
            output::note(&note);
        }
        notes.push(note);
    }
    if args.messages.json {
        output::print_json(&Noted { evaluation: &evaluation, notes: &notes })
    } else {
        output::print_lines(evaluation.to_string().trim_end().split('\n'))
    }
}

/// Of a report that was begun nothing is left: an earlier one is whole.
fn report_interruption(args: &Args, scored: &[ViewScore], all: usize, notes: &[String]) -> Result<()> {
    interrupt::stopped(if args.messages.json {
        let mut said = serde_json::json!({ "outcome": "interrupted", "views": scored, "of": all, "notes": notes });
        if let Some(folder) = &args.output {
            said["output"] = serde_json::json!(folder);
        }
        output::print_json(&said)
    } else {
        let folder = args.output.as_ref();
        let left = folder.map_or_else(String::new, |folder| format!("; nothing was written to {}", folder.display()));
        output::print(&format!("stopped; {} of {all} views were scored{left}", scored.len()))
    })
}

/// Note if held-out views have no score, because their masks leave no pixel.
pub(super) fn without_pixels(evaluation: &Evaluation) -> Option<String> {
    let left_out = &evaluation.left_out;
    (!left_out.is_empty()).then(|| {
        let (count, all) = (left_out.len(), left_out.len() + evaluation.views.len());
        let names = some_of(left_out.iter().map(String::as_str));
        format!("{count} of {all} held-out views are not scored, because their masks leave no pixel: {names}")
    })
}

/// What `--json` prints.
#[derive(serde::Serialize)]
struct Noted<'a> {
    #[serde(flatten)]
    evaluation: &'a Evaluation,
    notes: &'a [String],
}

/// Note on a near plane that was fitted to the scene: scores at the end of a training are of what it trains.
fn fitted(scene: &Path, near: f32) -> String {
    let usual = Composition::default().near;
    let scene = scene.display();
    format!("{scene}: states no near plane: it is {near}, as in `centaur render`, instead of {usual}, as in training")
}

/// Note if the scene was trained on views that are scored.
fn saw(training: &Record, trained_on: &[(String, Camera)], capture: &Capture) -> Option<String> {
    let known: HashSet<&str> = trained_on.iter().map(|(name, _)| name.as_str()).collect();
    let scored = held_out(capture).unwrap_or_default();
    training.saw(&known, scored.iter().map(|view| view.name.as_str()))
}

/// Note if the scene has cameras, but none with a name of the capture: then nothing shows whether these are its
/// training views, or where it is.
fn other_names(trained_on: &[(String, Camera)], capture: &Capture) -> Option<String> {
    let known: HashSet<&str> = trained_on.iter().map(|(name, _)| name.as_str()).collect();
    let is_none = !known.is_empty() && !capture.views.iter().any(|view| known.contains(view.name.as_str()));
    is_none.then(|| "no camera of the scene has the name of a view of the capture: it may have other poses, or have been trained on the views that are scored".to_owned())
}

/// Note if images differ in size from those on which the scene was trained, if it states them.
fn other_size(trained_on: &[(String, Camera)], capture: &Capture) -> Option<String> {
    let size = |camera: &Camera| (camera.intrinsics().width, camera.intrinsics().height);
    let pair = |view: &View| {
        let (_, camera) = trained_on.iter().find(|(name, _)| *name == view.name)?;
        (size(camera) != size(&view.camera)).then(|| (size(camera), size(&view.camera)))
    };
    let ((w, h), (width, height)) = capture.views.iter().find_map(pair)?;
    Some(format!(
        "photographs are {width}×{height}, but the scene was trained on {w}×{h}: to score it at that size, give the same \
         --downscale, --max-side or --images"
    ))
}

/// Note if most cameras of the scene with names of the capture are displaced by a tenth of the cameras' spread, or
/// rotated by 10°: the scene was moved, or the capture has other poses. Poses refined by training are usually nearer.
fn other_places(trained_on: &[(String, Camera)], capture: &Capture) -> Option<String> {
    let pairs: Vec<(&Camera, &Camera)> = (capture.views.iter())
        .filter_map(|view| Some((&view.camera, &trained_on.iter().find(|(name, _)| *name == view.name)?.1)))
        .collect();
    let (_, spread) = center_and_spread(pairs.iter().map(|(own, _)| *own));
    let is_elsewhere = |(own, theirs): &&(&Camera, &Camera)| {
        let turned = DQuat::from_mat3(&(own.rotation() * theirs.rotation().transpose())).angle_between(DQuat::IDENTITY);
        turned.to_degrees() > 10.0 || spread > 0.0 && own.center().distance(theirs.center()) > 0.1 * spread
    };
    let elsewhere = pairs.iter().filter(is_elsewhere).count();
    (2 * elsewhere > pairs.len()).then(|| {
        "cameras of the same names have other poses in the scene: it was moved, or the poses of the capture were changed"
            .to_owned()
    })
}

/// Parameters of `evaluate` besides scene and capture.
pub(super) struct Details<'a> {
    /// Written scene file, for its size.
    pub(super) scene_file: &'a Path,
    /// LPIPS network, if scores are wanted.
    pub(super) lpips: Option<&'a Lpips>,
    /// Folder for report, metrics and images, if wanted.
    pub(super) folder: Option<&'a Path>,
    /// Settings shown in the report.
    pub(super) settings: &'a [(String, String)],
    /// Record of the training: its time, and the curves of the report.
    pub(super) training: Option<&'a Record>,
    /// Options of progress messages.
    pub(super) messages: &'a MessageArgs,
    /// Flag that, set from outside, ends evaluation after the current view.
    pub(super) stop: &'a AtomicBool,
}

/// Paths of the held-out views' images in the folder of a report. None of the capture's photographs, including training
/// views, may be there, because image names are generated anew.
pub(super) fn report_pictures(folder: &Path, capture: &Capture) -> Result<Vec<PathBuf>> {
    let views = held_out(capture)?;
    let names = shared::picture_names(views.iter().map(|v| v.name.as_str()), "png");
    let pictures: Vec<PathBuf> = names.iter().map(|name| folder.join(name)).collect();
    shared::spare_images(&pictures, capture.views.iter().map(|view| view.source.path()))?;
    Ok(pictures)
}

/// Files about all views in the folder of a report.
const REPORT: &str = "report.html";
const METRICS: &str = "metrics.json";

/// Note if the folder of a report has images of an earlier report that this one does not replace.
pub(super) fn leftover(folder: &Path, capture: &Capture) -> Option<String> {
    let metrics: serde_json::Value = serde_json::from_slice(&std::fs::read(folder.join(METRICS)).ok()?).ok()?;
    let before = metrics["views"].as_array()?.iter().filter_map(|view| view["name"].as_str());
    let now = held_out(capture).unwrap_or_default();
    let now = shared::picture_names(now.iter().map(|view| view.name.as_str()), "png");
    let mut left = shared::picture_names(before, "png");
    left.retain(|name| !now.contains(name) && folder.join(name).is_file());
    (!left.is_empty()).then(|| {
        let (folder, count) = (folder.display(), output::counted(left.len(), "picture"));
        let names = some_of(left.iter().map(String::as_str));
        format!("{folder}: has {count} of an earlier report, of views that are not scored now: {names}")
    })
}

/// Files of a report, written aside and moved to their places when all are there: until then an earlier report is
/// whole.
struct Pages {
    staging: Staging,
    /// Each file, and its place.
    files: Vec<(PathBuf, PathBuf)>,
    /// Files that are to replace those to which links lead wait there: these may be in another file system.
    elsewhere: Vec<Staging>,
}

impl Pages {
    fn within(folder: &Path) -> Result<Self> {
        let staging = Staging::within(folder).with_context(|| format!("{}: cannot write", folder.display()))?;
        Ok(Self { staging, files: vec![], elsewhere: vec![] })
    }

    /// Writes a file that comes to be at `place`, or where a link there leads.
    fn write(&mut self, place: &Path, bytes: &[u8]) -> Result<()> {
        let named = || format!("{}: cannot replace", place.display());
        let number = self.files.len().to_string();
        let end = atomic::place_of(place).with_context(named)?;
        let file = if place.is_symlink() {
            let staging = Staging::within(atomic::folder_of(&end)).with_context(named)?;
            let file = staging.path().join(number);
            self.elsewhere.push(staging);
            file
        } else {
            self.staging.path().join(number)
        };
        atomic_write(&file, bytes).map_err(|error| match error {
            FormatError::Write { source, .. } => FormatError::Write { file: end.clone(), source },
            other => other,
        })?;
        self.files.push((file, end));
        Ok(())
    }

    /// Moves all files to their places.
    fn publish(self) -> Result<()> {
        let files: Vec<(&Path, &Path)> = self.files.iter().map(|(file, place)| (&**file, &**place)).collect();
        atomic::replace_all(&self.staging, &files)
            .map_err(|(file, error)| anyhow::Error::from(error).context(format!("{}: cannot replace", file.display())))
    }
}

/// Scores every held-out view, and writes the folder of `details`. If stopped, nothing is written, and the scores are
/// those of the views that were done.
pub(super) fn evaluate(
    gpu: &Gpu,
    scene: &HybridScene,
    capture: &Capture,
    details: &Details<'_>,
) -> Result<ControlFlow<Vec<ViewScore>, Evaluation>> {
    let views = held_out(capture)?;
    let files = details.folder.map(|folder| report_pictures(folder, capture)).transpose()?.unwrap_or_default();
    let _folder = details.folder.map(output::Folder::make).transpose()?;
    let mut evaluator = Evaluator::new(gpu, scene, &views)?;
    let mut pages = details.folder.map(Pages::within).transpose()?;
    let (mut scores, mut left_out, mut pictures) = (vec![], vec![], vec![]);
    let mut progress = Views::new(details.messages, "scoring", views.len());
    for (i, view) in views.into_iter().enumerate() {
        if details.stop.load(Ordering::Relaxed) {
            progress.finish();
            return Ok(ControlFlow::Break(scores));
        }
        let comparison = evaluator.compare(view)?;
        if comparison.is_empty {
            left_out.push(view.name.clone());
        } else {
            let score = comparison.score(&view.name, details.lpips)?;
            if let Some((pages, file)) = pages.as_mut().zip(files.get(i)) {
                let sheet = side_by_side(&comparison.truth, &comparison.render)?;
                pictures.push(Picture::new(caption(&score), &sheet).with_context(|| view.name.clone())?);
                pages.write(file, &png(file, &sheet)?)?;
            }
            scores.push(score);
        }
        progress.advance();
    }
    progress.finish();
    let evaluation = evaluator.finish(scores)?;
    let measured = Measured {
        file_bytes: stored_bytes(details.scene_file).ok(),
        seconds_per_iteration: details.training.and_then(|t| t.seconds_per_iteration),
        training_seconds: details.training.and_then(|t| t.training_seconds),
        training_peak_gpu_bytes: details.training.and_then(|t| t.training_peak_gpu_bytes),
        trained_on: details.training.and_then(|t| t.adapter.clone()).filter(|name| name != gpu.adapter()),
        ..evaluation.measured
    };
    let evaluation = Evaluation { measured, left_out, ..evaluation };
    if let Some((folder, mut pages)) = details.folder.zip(pages) {
        let page = report::html(&Report {
            title: &capture.name,
            evaluation: &evaluation,
            settings: details.settings,
            plots: &details.training.map_or_else(Vec::new, Record::plots),
            pictures: &pictures,
        });
        pages.write(&folder.join(REPORT), page.as_bytes())?;
        pages.write(&folder.join(METRICS), &serde_json::to_vec_pretty(&evaluation)?)?;
        pages.publish()?;
    }
    Ok(ControlFlow::Continue(evaluation))
}

/// Caption of a view's image in the report.
fn caption(view: &ViewScore) -> String {
    let Scores { psnr, ssim_inria, flip, lpips, .. } = view.scores;
    let lpips = lpips.map_or_else(String::new, |l| {
        let net = l.net.name();
        format!(", LPIPS {net} {:.4} (colours −1…1), {:.4} (0…1)", l.normalized, l.unnormalized)
    });
    format!("{}: {psnr:.2} dB, SSIM {ssim_inria:.4}, FLIP {flip:.4}{lpips}", view.name)
}

/// Writes an 8-bit PNG atomically.
pub(super) fn write_png<P>(path: &Path, image: &ImageBuffer<P, Vec<u8>>) -> Result<()>
where
    P: PixelWithColorType<Subpixel = u8>,
{
    Ok(atomic_write(path, &png(path, image)?)?)
}

/// An image as the bytes of an 8-bit PNG for `path`.
fn png<P>(path: &Path, image: &ImageBuffer<P, Vec<u8>>) -> Result<Vec<u8>>
where
    P: PixelWithColorType<Subpixel = u8>,
{
    let mut bytes = io::Cursor::new(vec![]);
    image.write_to(&mut bytes, image::ImageFormat::Png).with_context(|| path.display().to_string())?;
    Ok(bytes.into_inner())
}

#[cfg(test)]
mod tests {
    use centaur::metrics::{LpipsNet, LpipsScore};
    use image::{Rgb, Rgb32FImage};

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
}
