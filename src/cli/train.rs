use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::Ordering;

use anyhow::{Context as _, Result, anyhow, bail, ensure};
use centaur::atomic::Aside;
use centaur::capture::{self, Capture, LoadOptions, Split, View};
use centaur::evaluate;
use centaur::format::mesh_import;
use centaur::format::{gltf, ply};
use centaur::geometry::Surface;
use centaur::optimize::{
    self, Background, Density, MeshSource, Outcome, RefinedPose, Selection, Session, SurfaceOrigin, TrainError,
    TrainOptions, Trained,
};
use centaur::render::gpu::Gpu;
use centaur::scene::OrderMode;
use clap::ValueEnum;

use super::edits::positive;
use super::eval::{self, Details};
use super::history::Record;
use super::interrupt;
use super::output;
use super::progress::Reporter;
use super::shared::{AdapterArgs, CaptureArgs, Choice, MessageArgs};
use super::usage;

const EXAMPLES: &str = "\
Examples:
  centaur train captures/garden -o garden.glb --downscale 4 --report garden-report
  centaur train captures/tankard -o tankard.glb --masks --max-splats 200000
  centaur train captures/garden -o splats.glb --no-mesh
  centaur train captures/garden -o garden.glb --mesh scan.obj --layers 2
  centaur train captures/garden -o garden.glb --downscale 4 --resume";

/// Train a hybrid scene from a folder of posed photographs
///
/// CAPTURE is a COLMAP model (sparse/0, .bin or .txt, with images/) or a folder with transforms*.json. Every 8th
/// photograph is held out and scored at the end, or those of the capture's own split. Ctrl-C stops after the current iteration and leaves a checkpoint
/// for --resume, or after the current view and leaves the scene without scores; a second Ctrl-C stops at once.
// A flag given again replaces the former: variants of `centaur bench` change what all have.
#[derive(clap::Args)]
#[command(after_help = EXAMPLES, args_override_self = true)]
pub(super) struct Args {
    /// Folder with photographs and poses, or a transforms*.json
    capture: PathBuf,
    /// Scene to write
    #[arg(short, long, value_name = "SCENE.glb", value_parser = output::path(|path| output::with_extension(path, &["glb"])))]
    output: PathBuf,
    /// Also write the splats alone, without the mesh, in INRIA's layout
    #[arg(long, value_name = "SPLATS.ply", value_parser = output::path(|path| output::with_extension(path, &["ply"])))]
    ply: Option<PathBuf>,
    /// Folder for report.html, metrics.json and pictures of the held-out views
    #[arg(long, value_name = "DIR", conflicts_with = "no_eval")]
    report: Option<PathBuf>,
    #[command(flatten)]
    lpips: eval::LpipsArgs,
    /// Do not score the held-out views at the end
    #[arg(long, conflicts_with = "lpips_weights")]
    no_eval: bool,
    #[command(flatten)]
    adapter: AdapterArgs,

    /// Iterations of the splats, those for the surface included (INRIA 3DGS: 30000)
    #[arg(long, value_name = "N", default_value_t = TrainOptions::default().iterations, help_heading = OPTIMISATION)]
    iterations: u32,
    /// Iterations on the mesh's maps alone before it is joined with the splats; none without a mesh [default: 9000, as in HERA, and in
    /// runs of fewer than 30000 three tenths of --iterations]
    #[arg(long, value_name = "N", help_heading = OPTIMISATION)]
    warmup: Option<u32>,
    /// How splats are added and removed
    #[arg(long, value_enum, default_value_t = DensityKind::Mcmc, help_heading = OPTIMISATION)]
    density: DensityKind,
    /// Most splats there may be, which MCMC comes to if this is given; also limited by the largest buffer that the adapter binds. Without
    /// it, and without a number of floats, MCMC adds 5 % a step, up to 1000000
    #[arg(long, value_name = "N", value_parser = output::at_least_one, help_heading = OPTIMISATION)]
    max_splats: Option<usize>,
    /// Highest degree of spherical harmonics of the splats (INRIA 3DGS: 3)
    #[arg(long, value_name = "0..3", default_value_t = TrainOptions::default().sh_degree, help_heading = OPTIMISATION,
          value_parser = clap::value_parser!(u32).range(0..=3))]
    sh_degree: u32,
    /// Share of D-SSIM in the loss, the rest is L1 (INRIA 3DGS: 0.2)
    #[arg(long, value_name = "0..1", default_value_t = TrainOptions::default().ssim_weight, value_parser = share,
          help_heading = OPTIMISATION)]
    ssim_weight: f32,
    /// Start of every random sequence. The same seed gives the same scene, to the last bit, on the same adapter and driver, however many
    /// threads there are and wherever it was resumed
    #[arg(long, value_name = "N", default_value_t = TrainOptions::default().seed, help_heading = OPTIMISATION)]
    seed: u64,
    /// Save a checkpoint after every N iterations and at the end of each phase; 0 for none but that of Ctrl-C
    #[arg(long, value_name = "N", default_value_t = TrainOptions::default().checkpoint_every,
          help_heading = OPTIMISATION)]
    checkpoint_every: u32,
    /// Measure PSNR on up to four held-out views, for the progress bar, after every N iterations; 0 for only at the end of each phase
    #[arg(long, value_name = "N", default_value_t = TrainOptions::default().eval_every, help_heading = OPTIMISATION)]
    eval_every: u32,
    /// Continue from SCENE.glb.checkpoint; give the other options as before. Without this flag such a file is set aside
    #[arg(long, help_heading = OPTIMISATION)]
    resume: bool,
    /// Stop, as by Ctrl-C, when standard input ends: `centaur bench` holds its other end, whichever way it goes
    #[arg(long, hide = true)]
    stop_at_eof: bool,
    /// Filter splats as Mip-Splatting does (Yu et al. 2024), so that the scene can be seen from nearer and farther than the
    /// photographs: smoothed as far as no photograph tells, and fading instead of growing where smaller than a pixel
    #[arg(long, help_heading = OPTIMISATION)]
    antialias: bool,
    /// Begin with pictures of a quarter of the size and grow them, and the number of splats, over the first half of the run, or
    /// three quarters of --surface-iterations (the idea of DashGaussian)
    #[arg(long, help_heading = OPTIMISATION)]
    coarse_to_fine: bool,
    /// Fit an affine change of colours to each training photograph, for captures whose exposure or white balance varies; where they
    /// do not it costs quality. Held-out views are rendered without (a row of its own in comparisons)
    #[arg(long, help_heading = OPTIMISATION)]
    exposure: bool,
    /// Correct the training photographs' poses along, until a surface is made (without a mesh, to the end), for captures whose poses are
    /// not exact; where they are it may cost quality. The scene's cameras are the corrected ones, --json lists what was corrected
    #[arg(long, conflicts_with = "mesh", help_heading = OPTIMISATION)]
    refine_poses: bool,
    /// How far poses may be off, with --refine-poses: about as much as it can correct. The less, the less it costs where they are right
    #[arg(long, value_name = "DEGREES", default_value_t = TrainOptions::default().pose_reach, value_parser = positive,
          requires = "refine_poses", help_heading = OPTIMISATION)]
    pose_reach: f64,
    /// Update only the splats that an iteration's view sees (faster on large scenes; INRIA 3DGS updates all)
    #[arg(long, help_heading = OPTIMISATION)]
    visible_only: bool,
    /// Update every texel of the maps in every iteration instead of those that its view sees (HERA)
    #[arg(long, help_heading = OPTIMISATION)]
    dense_texels: bool,
    /// Most floats in splats, maps and vertices together; limits the splats, which MCMC brings up to it, and maps that are not laid out
    /// anew; for comparisons at equal size
    #[arg(long, value_name = "N", help_heading = OPTIMISATION)]
    max_floats: Option<usize>,
    /// As --max-floats, by what they take as f32, in megabytes of 10⁶ bytes
    #[arg(long, value_name = "MB", conflicts_with = "max_floats", value_parser = positive, help_heading = OPTIMISATION)]
    budget_mb: Option<f64>,

    /// Train as if the capture had no points: splats begin at random places that its cameras look at
    #[arg(long, help_heading = OPTIMISATION)]
    no_points: bool,

    /// Surface to use, in the coordinates of the poses: .glb, .gltf, .obj or .ply. Its vertices and triangles are kept as they
    /// are, and so are UVs of one material, scaled where they leave 0..1; no shell is added [default: one made from the capture, see --surface]
    #[arg(long, value_name = "FILE", conflicts_with = "no_mesh", help_heading = MESH)]
    mesh: Option<PathBuf>,
    /// Splats alone
    #[arg(long, help_heading = MESH)]
    no_mesh: bool,
    /// What the surface is made of [default: points if half of the views list 100 or more that they see, else splats]
    #[arg(long, value_enum, value_name = "splats|points", conflicts_with_all = ["mesh", "no_mesh"], help_heading = MESH)]
    surface: Option<SurfaceOf>,
    /// Of --iterations, those on splats alone before there is a surface, with which it is compared; the rest trains splats and
    /// mesh together [default: half]
    #[arg(long, value_name = "N", help_heading = MESH)]
    surface_iterations: Option<u32>,
    /// Triangles that a surface made from the capture is simplified to (ours); more are left of one of many pieces or holes, which all stay
    #[arg(long, value_name = "N", default_value_t = TrainOptions::default().triangles, value_parser = output::at_least_one, help_heading = MESH)]
    triangles: usize,
    /// Whether flat regions of a surface made from the capture are found, made flat and meshed anew with few triangles (not in the paper)
    #[arg(long, value_enum, value_name = "auto|off", default_value_t = Choice::Auto, help_heading = MESH)]
    planar: Choice,
    /// Whether what views see past a surface made from the capture, sky and far background, is tried on a sphere far around it, unless
    /// photographs have alpha or masks or there is no warm-up; its triangles are kept where they are worth it, as all are (not in the paper)
    #[arg(long, value_enum, value_name = "auto|off", default_value_t = Choice::Auto, help_heading = MESH)]
    shell: Choice,
    /// Side of the map of colour and opacity in texels, at most for a surface made from the capture, whose kept triangles
    /// get about two texels per pixel; that of view dependence has a quarter [default: the power of
    /// two from one and a half times the longer image side on, 128 to 2048]. With --max-floats or --budget-mb less where maps stay as they are laid out first
    /// (--mesh, --warmup 0): they take half of the budget at most, as far as charts have room
    #[arg(long, value_name = "TEXELS", help_heading = MESH, value_parser = clap::value_parser!(u32).range(16..=i64::from(TrainOptions::LARGEST_TEXTURE)))]
    texture_size: Option<u32>,
    /// Degree of spherical harmonics of the mesh; 0 for no view dependence (ours; HERA does not say)
    #[arg(long, value_name = "0..3", default_value_t = TrainOptions::default().band_degree, help_heading = MESH,
          value_parser = clap::value_parser!(u32).range(0..=3))]
    band_degree: u32,

    /// Rule for the order of splats and mesh (HERA: stable)
    #[arg(long, value_enum, default_value_t = Mode::SurfaceConsistent, help_heading = COMPOSITION)]
    mode: Mode,
    /// How far a mesh pixel must lie in front of a splat to override its order, relative to the extent of the
    /// cameras; `inf` turns the override off (HERA: 5 cm on heads; 0.01 is ours for static scenes)
    #[arg(long, value_name = "LAMBDA", default_value_t = TrainOptions::default().lambda, value_parser = not_negative,
          allow_hyphen_values = true, help_heading = COMPOSITION)]
    lambda: f32,
    /// Mesh layers kept per pixel: 1, 2 or 4 (HERA sets no limit; opacity saturates after a few)
    #[arg(long, value_name = "N", default_value_t = TrainOptions::default().layers, value_parser = layers,
          help_heading = COMPOSITION)]
    layers: u32,
    /// What is behind the scene (INRIA 3DGS: black); a random colour per iteration discourages holes
    #[arg(long, value_enum, default_value_t = Backdrop::Black, help_heading = COMPOSITION)]
    background: Backdrop,

    #[command(flatten)]
    loading: CaptureArgs,
    #[command(flatten)]
    messages: MessageArgs,
}

const OPTIMISATION: &str = "Optimisation";
const MESH: &str = "Mesh";
const COMPOSITION: &str = "Composition";

#[derive(Clone, Copy, ValueEnum)]
enum DensityKind {
    /// Clone, split, prune and reset by gradient (Kerbl et al. 2023)
    Inria,
    /// The same, but splats are split where absolute gradients are large (AbsGS, Ye et al. 2024)
    Absgs,
    /// Move dead splats, grow to --max-splats (Kheradmand et al. 2024)
    Mcmc,
}

#[derive(Clone, Copy, ValueEnum)]
enum Mode {
    /// One decision per splat and layer; a splat whose mean is outside the picture is behind (HERA)
    Stable,
    /// As stable where the pixel shows the surface that was decided on, as direct elsewhere
    SurfaceConsistent,
    /// Per pixel; the order flickers
    Direct,
}

#[derive(Clone, Copy, ValueEnum)]
enum Backdrop {
    Black,
    White,
    Random,
}

fn layers(text: &str) -> Result<u32, String> {
    match text {
        "1" => Ok(1),
        "2" => Ok(2),
        "4" => Ok(4),
        _ => Err("expected 1, 2 or 4".into()),
    }
}

fn share(text: &str) -> Result<f32, String> {
    text.parse().ok().filter(|v| (0.0..=1.0).contains(v)).ok_or_else(|| "expected a number from 0 to 1".into())
}

fn not_negative(text: &str) -> Result<f32, String> {
    text.parse().ok().filter(|v| *v >= 0.0).ok_or_else(|| "expected a number ≥ 0 or inf".into())
}

impl Args {
    fn options(&self) -> TrainOptions {
        TrainOptions {
            iterations: self.iterations,
            warmup: if self.no_mesh { 0 } else { self.warmup.unwrap_or(TrainOptions::warmup_of(self.iterations)) },
            surface_iterations: self.surface_iterations,
            density: match self.density {
                DensityKind::Inria => Density::Inria,
                DensityKind::Absgs => Density::Absgs,
                DensityKind::Mcmc => Density::Mcmc,
            },
            max_splats: self.max_splats,
            max_floats: self.max_floats.or(self.budget_mb.map(|mb| (mb * 1e6 / 4.0) as usize)),
            visible_only: self.visible_only,
            dense_texels: self.dense_texels,
            antialias: self.antialias,
            coarse_to_fine: self.coarse_to_fine,
            exposure: self.exposure,
            refine_poses: self.refine_poses,
            pose_reach: self.pose_reach,
            sh_degree: self.sh_degree,
            ssim_weight: self.ssim_weight,
            seed: self.seed,
            checkpoint_every: self.checkpoint_every,
            eval_every: self.eval_every,
            triangles: self.triangles,
            planar: self.planar.is_auto(),
            shell: self.shell.is_auto(),
            texture_size: self.texture_size,
            band_degree: self.band_degree,
            mode: match self.mode {
                Mode::Stable => OrderMode::Stable,
                Mode::SurfaceConsistent => OrderMode::SurfaceConsistent,
                Mode::Direct => OrderMode::Direct,
            },
            lambda: self.lambda,
            layers: self.layers,
            background: match self.background {
                Backdrop::Black => Background::Black,
                Backdrop::White => Background::White,
                Backdrop::Random => Background::Random,
            },
        }
    }

    /// Flags of a mesh that are given beside --no-mesh. Variants of `centaur bench` share them with others: they are no mistake.
    fn idle_without_mesh(&self) -> Vec<&'static str> {
        let usual = TrainOptions::default();
        let flags = [
            (self.warmup.is_some_and(|iterations| iterations > 0), "--warmup"),
            (self.dense_texels, "--dense-texels"),
            (self.surface_iterations.is_some(), "--surface-iterations"),
            (self.triangles != usual.triangles, "--triangles"),
            (!self.planar.is_auto(), "--planar"),
            (!self.shell.is_auto(), "--shell"),
            (self.texture_size.is_some(), "--texture-size"),
            (self.band_degree != usual.band_degree, "--band-degree"),
        ];
        flags.into_iter().filter(|(is_given, _)| *is_given && self.no_mesh).map(|(_, flag)| flag).collect()
    }

    /// What can be known to fail before the first iteration.
    fn check(&self) -> Result<()> {
        if let Some(report) = &self.report {
            let files = [Some(&self.output), self.ply.as_ref(), Some(&self.checkpoint())];
            if let Some(file) = files.into_iter().flatten().find(|file| output::is_same(file, report)) {
                let file = file.display();
                return Err(usage::wrong(format!("--report: expected another name than {file}, which is a file")));
            }
        }
        output::check_file(&self.output)?;
        // Also where none is to be saved on the way: Ctrl-C does.
        output::check_file(&self.checkpoint())?;
        output::spare(&self.output, self.mesh.as_deref())?;
        if let Some(ply) = &self.ply {
            output::check_file(ply)?;
            output::spare(ply, self.mesh.as_deref())?;
        }
        self.report.as_deref().map_or(Ok(()), output::check_folder)?;
        if let Some(mesh) = &self.mesh {
            ensure!(mesh.is_file(), "{}: expected a mesh file, found none", mesh.display());
        }
        let of_points = matches!(self.surface, Some(SurfaceOf::Points));
        usage::demand(!(of_points && self.no_points), "--surface points: expected points, found --no-points")?;
        let checkpoint = self.checkpoint();
        ensure!(!self.resume || checkpoint.is_file(), "{}: expected a checkpoint, found none", checkpoint.display());
        Ok(())
    }

    fn open(&self) -> Result<Capture> {
        let options = LoadOptions { without_points: self.no_points, ..self.loading.options() };
        let capture = capture::open(&self.capture, &options)?;
        self.ply.as_deref().map_or(Ok(()), |ply| output::spare(ply, capture.points_file.as_deref()))?;
        match &capture.points_file {
            Some(file) if capture.points.is_empty() => bail!(
                "{}: expected points, found none; --no-points begins with splats at random places that the cameras look at",
                file.display()
            ),
            _ => Ok(capture),
        }
    }

    /// Beside the output: `scene.glb.checkpoint`.
    fn checkpoint(&self) -> PathBuf {
        let mut name = self.output.clone().into_os_string();
        name.push(".checkpoint");
        name.into()
    }

    /// Where the mesh comes from, and what its reader says of it.
    fn mesh(&self, capture: &Capture) -> Result<(MeshSource, Vec<String>)> {
        let Some(file) = &self.mesh else {
            let source = match (self.no_mesh, self.surface) {
                (true, _) => MeshSource::None,
                (false, Some(SurfaceOf::Splats)) => MeshSource::Splats,
                (false, Some(SurfaceOf::Points)) => MeshSource::Points,
                (false, None) => MeshSource::suited_to(capture),
            };
            return Ok((source, vec![]));
        };
        let mesh = mesh_import::read(file)?;
        let surface = Surface { positions: mesh.positions, triangles: mesh.triangles };
        let notes = mesh.notes.iter().map(|note| format!("{}: {note}", file.display())).collect();
        Ok((MeshSource::Given { surface, corner_uvs: mesh.corner_uvs }, notes))
    }
}

/// What a surface is made of.
#[derive(Clone, Copy, ValueEnum)]
enum SurfaceOf {
    /// The depth of the splats after --surface-iterations, fused
    Splats,
    /// The capture's points, triangulated in every view
    Points,
}

pub(super) fn run(args: &Args) -> Result<()> {
    args.check()?;
    let capture = args.open()?;
    let (mesh, of_mesh) = args.mesh(&capture)?;
    let lpips = args.lpips.open()?;
    let gpu = args.adapter.open()?;
    let options = args.options();
    let stop = interrupt::stop_flag();
    if args.stop_at_eof {
        // A terminal that goes away hangs up on all: where that ends whoever holds the other end, it is heard of by that.
        #[cfg(unix)]
        signal_hook::flag::register(signal_hook::consts::SIGHUP, Arc::default()).context("cannot handle SIGHUP")?;
        let flag = Arc::clone(&stop);
        std::thread::spawn(move || {
            // However it ends.
            let _ = std::io::copy(&mut std::io::stdin(), &mut std::io::sink());
            flag.store(true, Ordering::Relaxed);
        });
    }
    let scores = !args.no_eval && !Split::Every8th.split(&capture.views).1.is_empty();
    ensure!(
        scores || args.report.is_none(),
        "{}: expected held-out views for --report, found none",
        args.capture.display()
    );
    if let Some(folder) = &args.report {
        eval::report_pictures(folder, &capture)?;
    }
    if scores {
        // One that cannot be read is better known now than after hours.
        evaluate::check_photographs(&capture)?;
    }
    let mut notes = before_training(args, &capture, &gpu, scores);
    notes.extend(of_mesh);
    let aside = set_aside(args)?;
    notes.extend(aside.iter().map(|aside| {
        format!("{}: was left by another run and is now {}", args.checkpoint().display(), aside.path().display())
    }));
    if !args.messages.json {
        notes.iter().for_each(|note| output::note(note));
    }
    let mut reporter = Reporter::new(&args.messages);
    let session = Session {
        gpu: &gpu,
        checkpoint: Some(args.checkpoint()),
        resume: args.resume,
        stop: &stop,
        progress: &mut |progress| reporter.update(progress),
    };
    let trained = optimize::train(&capture, mesh, &options, session);
    reporter.finish();
    // Those of other runs are aside as yet.
    let has_saved = args.checkpoint().exists();
    if let (Err(_), Some(aside)) = (&trained, aside)
        && aside.back().is_ok_and(|is_back| is_back)
    {
        output::note(&format!("{}: is back, since this run left none", args.checkpoint().display()));
    }
    let trained = trained.map_err(|error| with_advice(error, args, has_saved))?;
    if matches!(trained.outcome, Outcome::Interrupted) {
        let checkpoint = args.checkpoint();
        let line = format!("saved {}; the same command with --resume continues", checkpoint.display());
        return report_interruption(args, ("checkpoint", &checkpoint), &line, &notes);
    }
    let record = Record::new(&capture, &options, gpu.adapter(), &trained)?;
    let mut settings = record.settings();
    settings.extend(trained.surface.map(|origin| ("surface".to_owned(), in_words(origin).to_owned())));
    let moved = moved(&trained);
    settings.extend(moved.iter().map(|moved| ("poses".to_owned(), moved.clone())));
    let cameras: Vec<_> = capture.views.iter().zip(&trained.cameras).map(|(v, c)| (v.name.clone(), *c)).collect();
    let written = gltf::write_glb(&args.output, &trained.scene, &cameras, Some(serde_json::to_value(&record)?))
        .and_then(|_| args.ply.as_ref().map_or(Ok(()), |path| ply::write(path, &trained.scene.splats).map(drop)));
    if written.is_err() && has_saved {
        output::note(&format!(
            "{}: holds what was trained; the same command with --resume writes it",
            args.checkpoint().display()
        ));
    }
    written?;
    let evaluation = if scores {
        let details = Details {
            scene_file: &args.output,
            lpips: lpips.as_ref(),
            folder: args.report.as_deref(),
            settings: &settings,
            training: Some(&record),
            messages: &args.messages,
            stop: &stop,
        };
        let evaluation = eval::evaluate(&gpu, &trained.scene, &capture, &details)
            .with_context(|| format!("{} is written, but not its evaluation", args.output.display()))?;
        if evaluation.is_none() {
            let line = format!("wrote {}, without scores; centaur eval gives them", args.output.display());
            return report_interruption(args, ("scene", &args.output), &line, &notes);
        }
        evaluation
    } else {
        None
    };
    let capped = capped(args, &trained, &gpu);
    if !args.messages.json {
        capped.iter().for_each(|note| output::note(note));
    }
    notes.extend(capped);
    let last = note(args, &trained);
    if args.messages.json {
        let exposures: BTreeMap<&str, [f32; 12]> = trained.exposures.iter().map(|(name, e)| (&**name, *e)).collect();
        let poses: BTreeMap<&str, &RefinedPose> = trained.poses.iter().map(|(name, pose)| (&**name, pose)).collect();
        let outcome = serde_json::json!({
            "outcome": "finished", "scene": args.output, "points": capture.points.len(), "seconds_per_iteration": trained.seconds_per_iteration,
            "repeated_iterations": trained.repeated_iterations, "surface": trained.surface,
            "selection": trained.selection, "shell_triangles": trained.shell_triangles, "faint_triangles": trained.faint_triangles,
            "occluded_splats": trained.occluded_splats,
            "notes": notes.iter().chain(&last).collect::<Vec<_>>(),
            "exposures": exposures, "poses": poses,
            "settings": options, "evaluation": evaluation,
        });
        output::print_json(&outcome)?;
    } else {
        evaluation.map_or(Ok(()), |e| output::print(&format!("{e}")))?;
        moved.map_or(Ok(()), |moved| output::print(&format!("poses: {moved}")))?;
        last.map_or(Ok(()), |note| output::print(&format!("note: {note}")))?;
        output::print(&format!("wrote {}", args.output.display()))?;
    }
    // Everything is written and said; what was kept for resuming has served.
    let _ = std::fs::remove_file(args.checkpoint());
    Ok(())
}

fn in_words(surface: SurfaceOrigin) -> &'static str {
    match surface {
        SurfaceOrigin::Given => "given",
        SurfaceOrigin::Points => "points of the capture",
        SurfaceOrigin::GuessedPoints => "points of the capture, taken for seen where none is nearer",
        SurfaceOrigin::Splats => "fused depth of splats",
    }
}

/// How far poses were refined, if they were.
fn moved(trained: &Trained) -> Option<String> {
    let median = |of: fn(&RefinedPose) -> f64| {
        let mut values: Vec<f64> = trained.poses.iter().map(|(_, pose)| of(pose)).collect();
        values.sort_unstable_by(f64::total_cmp);
        values.get(values.len() / 2).copied()
    };
    let (distance, degrees) = (median(|pose| pose.distance)?, median(|pose| pose.degrees)?);
    Some(format!("moved by {distance:.4} (median), {degrees:.2}° (median)"))
}

/// To this INRIA 3DGS scales larger photographs down unless told otherwise (`utils/camera_utils.py`).
const USUAL_SIDE: u32 = 1600;

/// Said before the training: a capture that lacks something is better mended than trained for hours.
fn before_training(args: &Args, capture: &Capture, gpu: &Gpu, scores: bool) -> Vec<String> {
    let has_masks = capture.views.iter().any(|view| view.source.mask().is_some());
    let lacks = [
        (
            capture.points.is_empty() && !args.no_points,
            "has no points: splats begin at random places that its cameras look at",
        ),
        (args.loading.masks && !has_masks, "has no masks: nothing is masked"),
        (!scores && !args.no_eval, "holds no view out: nothing will be scored"),
        (
            shows_motion(capture),
            "shows several moments, which are trained as if all were one: what moves will be blurred",
        ),
    ];
    let said = lacks.into_iter().filter(|(is_so, _)| *is_so);
    let longest = |view: &View| view.camera.intrinsics().width.max(view.camera.intrinsics().height);
    let side = capture.views.iter().map(longest).max().unwrap_or(0);
    let large = (side > USUAL_SIDE).then(|| {
        format!(
            "has pictures of {side} pixels a side, as they are trained on: results are usually given for {USUAL_SIDE} \
             (--max-side {USUAL_SIDE}) or --downscale"
        )
    });
    let finds_surface = args.mesh.is_none() && !args.no_mesh;
    let none_left = finds_surface && args.iterations > 0 && args.surface_iterations >= Some(args.iterations);
    let none_left = none_left.then(|| {
        format!(
            "--surface-iterations: leaves none of the {} iterations to train splats and mesh together",
            args.iterations
        )
    });
    let idle = args.idle_without_mesh();
    let idle = (!idle.is_empty())
        .then(|| format!("--no-mesh: {} {} no effect", idle.join(", "), if idle.len() == 1 { "has" } else { "have" }));
    let of_capture = said.map(|(_, what)| what.to_owned()).chain(large);
    let most = optimize::most_splats(gpu, args.sh_degree);
    // Few runs come to what nobody has asked for: those are told at the end.
    let asks = args.max_splats.is_some_and(|asked| asked > most);
    let too_many = asks.then(|| {
        format!("{}: binds {most} splats of degree {} at most: there will be no more", gpu.adapter(), args.sh_degree)
    });
    of_capture
        .map(|what| format!("{}: {what}", args.capture.display()))
        .chain(too_many)
        .chain(none_left)
        .chain(idle)
        .collect()
}

/// Whether its views say that they are of different times.
fn shows_motion(capture: &Capture) -> bool {
    let mut moments = capture.views.iter().map(|view| view.source.moment());
    let first = moments.next().flatten();
    moments.any(|moment| moment != first)
}

/// Where splats were held back: by what the adapter binds, or in density control by gradients, which has no number of its own to come to.
fn capped(args: &Args, trained: &Trained, gpu: &Gpu) -> Option<String> {
    let grown = trained.scene.splats.len() + trained.occluded_splats;
    if grown >= optimize::most_splats(gpu, args.sh_degree) {
        return Some(format!("{grown} splats are all that {} binds: on another there might be more", gpu.adapter()));
    }
    let most = args.max_splats.unwrap_or(TrainOptions::MOST_SPLATS);
    let is_held_back = !matches!(args.density, DensityKind::Mcmc) && grown >= most;
    is_held_back.then(|| format!("there were {most} splats: with a larger --max-splats there would be more"))
}

/// What an interrupted run left stays, under another name, where this one does not go on from it.
fn set_aside(args: &Args) -> Result<Option<Aside>> {
    let checkpoint = args.checkpoint();
    if args.resume || !checkpoint.is_file() {
        return Ok(None);
    }
    let mut names = (1..).map(|n| checkpoint.with_extension(format!("checkpoint.before-{n}")));
    let name = names.find(|name| !name.exists()).context("no name is left for an earlier checkpoint")?;
    let cannot = format!("cannot rename {}", checkpoint.display());
    Ok(Some(Aside::set(checkpoint, name).context(cannot)?))
}

fn why_no_mesh(trained: &Trained) -> String {
    match &trained.selection {
        _ if trained.faint_triangles > 0 => "its triangles became invisible in training".to_owned(),
        None => match &trained.no_surface {
            Some(why) => why.clone(),
            None => "no surface was found, or had room in the budget".to_owned(),
        },
        Some(s) if s.kept() > 0 => format!("the {} triangles that were kept had no room in the budget", s.kept()),
        Some(Selection { triangles, unseen, worse, small }) => format!(
            "of {triangles} triangles {unseen} were seen by too few training views, {worse} showed those worse than splats and {small} \
             were in pieces too small"
        ),
    }
}

/// Where a surface was wanted, or one of points, and there is less than that.
fn note(args: &Args, trained: &Trained) -> Option<String> {
    let no_mesh;
    let note = match (args.surface, trained.surface) {
        (_, None) if !args.no_mesh => {
            no_mesh = format!("the scene has no mesh: {}", why_no_mesh(trained));
            &no_mesh
        }
        (Some(SurfaceOf::Points), Some(SurfaceOrigin::GuessedPoints)) => {
            "does not say of half of its views or more which points they see: for the surface, each was taken for seen where none is nearer"
        }
        (Some(SurfaceOf::Points), Some(SurfaceOrigin::Splats)) => {
            "its points make no surface: it was fused from the depth of splats"
        }
        _ => return None,
    };
    Some(format!("{}: {note}", args.capture.display()))
}

/// The failure, and what of this command changes it, or of a run that `has_saved` a checkpoint is left.
fn with_advice(error: TrainError, args: &Args, has_saved: bool) -> anyhow::Error {
    match (&error, &args.mesh) {
        (TrainError::Gpu(e), _) if e.is_lack_of_memory() => {
            anyhow!("{error}; see --max-splats, --texture-size and --downscale")
        }
        (TrainError::Geometry(_), Some(mesh)) => anyhow!("{}: {error}; see --texture-size", mesh.display()),
        (TrainError::Geometry(_), None) => {
            let capture = args.capture.display();
            anyhow!("{capture}: {error}; --no-mesh trains splats alone, --mesh FILE takes yours")
        }
        (TrainError::NotFinite { .. }, _) if has_saved => anyhow!("{error}; the last checkpoint is from before"),
        _ => error.into(),
    }
}

/// Ctrl-C is no failure: the work so far is in a file, which is named and described.
fn report_interruption(args: &Args, (kind, file): (&str, &Path), line: &str, notes: &[String]) -> Result<()> {
    if args.messages.json {
        return output::print_json(&serde_json::json!({ "outcome": "interrupted", kind: file, "notes": notes }));
    }
    output::print(&format!("stopped; {line}"))
}
