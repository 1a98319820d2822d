//! Arguments of `centaur train`.

use std::path::PathBuf;

use anyhow::{Context as _, Result, anyhow, bail, ensure};
use centaur::atomic::{self, LockFile};
use centaur::capture::{self, Capture, CaptureError, LoadOptions, Split};
use centaur::optimize::{Background, Density, MeshSource, TrainOptions};
use centaur::scene::{OrderMode, Splats};
use clap::ValueEnum;

use super::surface::{self, SurfaceOf};
use crate::cli::edits::positive;
use crate::cli::shared::{AdapterArgs, CaptureArgs, Choice, MessageArgs};
use crate::cli::{eval, output, usage};

const EXAMPLES: &str = "\
Examples:
  centaur train captures/mipnerf360/garden -o garden.glb --downscale 4 --report garden-report
  centaur train captures/tankard -o tankard.glb --masks --max-splats 200000
  centaur train captures/mipnerf360/garden -o splats.glb --no-mesh
  centaur train captures/mipnerf360/garden -o garden.glb --mesh scan.obj
  centaur train captures/mipnerf360/garden -o garden.glb --downscale 4 --resume";

/// Train a hybrid scene from a folder of photographs with known camera poses
///
/// CAPTURE is a folder with images/ and a COLMAP model (in sparse/0, sparse, colmap/sparse/0 or the folder itself; .bin
/// or .txt), or with transforms*.json.
///
/// Splats are trained alone first. Then a mesh is made, its triangles are kept where they show the photographs about as
/// well as the splats do, and mesh and splats are trained together. Every 8th photograph, or the capture's own test
/// split if it has one, is held out and scored at the end, unless --all-views is given.
///
/// Ctrl-C (or, on Unix, losing the terminal) stops training after the current step (an iteration, or making and judging
/// a surface) and saves a checkpoint for --resume. During scoring it stops after the current view and leaves the scene
/// without scores. The exit code is then that of a program ended by the signal (130 for Ctrl-C). A second Ctrl-C stops
/// immediately. An existing scene of the same name is replaced only when training is complete. Meanwhile a second
/// training with the same -o is refused.
///
/// The method is that of HERA ("the paper": Cai et al., CVPR 2025), on 3D Gaussian splatting (3DGS); docs/method.md
/// lists the defaults that differ from theirs, and why.
// A flag given again replaces the former, so that variants of `centaur bench` can override common flags.
#[derive(clap::Args)]
#[command(after_help = EXAMPLES, args_override_self = true)]
pub(in crate::cli) struct Args {
    /// Folder with photographs and camera poses, or a transforms*.json
    pub(super) capture: PathBuf,
    /// Scene file to write
    #[arg(short, long, value_name = "SCENE.glb", value_parser = output::path(|path| output::with_extension(path, &["glb"])))]
    pub(super) output: PathBuf,
    /// Also write the splats alone, without the mesh, as a .ply in the layout of INRIA 3DGS
    #[arg(long, value_name = "SPLATS.ply", value_parser = output::path(|path| output::with_extension(path, &["ply"])))]
    pub(super) ply: Option<PathBuf>,
    /// Folder for a report: report.html, metrics.json and an image of each held-out view; not with --no-eval or
    /// --all-views
    #[arg(long, value_name = "DIR", conflicts_with = "no_eval")]
    pub(super) report: Option<PathBuf>,
    #[command(flatten)]
    pub(super) lpips: eval::LpipsArgs,
    /// Skip scoring the held-out views at the end
    #[arg(long, conflicts_with = "lpips_weights")]
    pub(super) no_eval: bool,
    /// Train on all photographs; no view is held out, and none is scored
    #[arg(long, conflicts_with_all = ["report", "lpips_weights"])]
    pub(super) all_views: bool,
    #[command(flatten)]
    pub(super) adapter: AdapterArgs,

    /// Number of iterations that train splats, including --surface-iterations (INRIA 3DGS: 30000)
    #[arg(long, value_name = "N", default_value_t = TrainOptions::default().iterations, help_heading = OPTIMISATION,
          value_parser = clap::value_parser!(u32).range(1..))]
    pub(super) iterations: u32,
    /// Number of iterations that train the mesh alone, before it is joined with the splats; unused without a mesh
    /// [default: 9000, as in HERA; three tenths of --iterations if these are fewer than 30000]
    ///
    /// The warm-up trains the texture maps of the mesh and, after its first eighth, moves the vertices of a mesh that
    /// was made from the capture.
    #[arg(long, value_name = "N", help_heading = OPTIMISATION)]
    pub(super) warmup: Option<u32>,
    /// Density control: how splats are added and removed
    #[arg(long, value_enum, default_value_t = DensityKind::Mcmc, help_heading = OPTIMISATION)]
    pub(super) density: DensityKind,
    /// Maximum number of splats, also limited by the largest buffer that the adapter can bind [default: 1000000, with
    /// every --density]
    ///
    /// With --density mcmc, a number that is given here is reached; the default is only a limit.
    #[arg(long, value_name = "N", value_parser = output::at_least_one, help_heading = OPTIMISATION)]
    pub(super) max_splats: Option<usize>,
    /// Degree of the spherical harmonics of the splats (INRIA 3DGS: 3)
    ///
    /// A splat of degree 3 has 59 floats, one of degree 1 has 23, with which a small --max-floats or --budget-mb shows
    /// more (docs/experiments.md).
    #[arg(long, value_name = "0..3", default_value_t = TrainOptions::default().sh_degree, help_heading = OPTIMISATION,
          value_parser = clap::value_parser!(u32).range(0..=3))]
    pub(super) sh_degree: u32,
    /// Weight of D-SSIM in the loss; the remainder is the weight of L1 (INRIA 3DGS: 0.2)
    #[arg(long, value_name = "0..1", default_value_t = TrainOptions::default().ssim_weight, value_parser = share,
          help_heading = OPTIMISATION)]
    pub(super) ssim_weight: f32,
    /// Seed of all random numbers
    ///
    /// The same seed gives the same scene, to the last bit, on the same adapter and driver, regardless of the number of
    /// threads and of where training was interrupted and resumed.
    #[arg(long, value_name = "N", default_value_t = TrainOptions::default().seed, help_heading = OPTIMISATION,
          value_parser = output::whole_number)]
    pub(super) seed: u64,
    /// Save a checkpoint every N iterations and at the end of each phase; 0 for none
    ///
    /// With 0, Ctrl-C still saves one during training, but a run that is stopped while being scored has to start over.
    #[arg(long, value_name = "N", default_value_t = TrainOptions::default().checkpoint_every,
          help_heading = OPTIMISATION)]
    pub(super) checkpoint_every: u32,
    /// Measure PSNR on up to four held-out views every N iterations, for the progress bar; 0 for only at the end of
    /// each phase
    #[arg(long, value_name = "N", default_value_t = TrainOptions::default().eval_every, help_heading = OPTIMISATION)]
    pub(super) eval_every: u32,
    /// Continue from SCENE.glb.checkpoint; give the other options as before
    ///
    /// Without this flag, an existing checkpoint is renamed and kept.
    #[arg(long, help_heading = OPTIMISATION)]
    pub(super) resume: bool,
    /// Stop, as by Ctrl-C, when standard input ends: `centaur bench` holds the other end, and may end in any way
    #[arg(long, hide = true)]
    pub(super) stop_at_eof: bool,
    /// Prevent aliasing with the filters of Mip-Splatting (Yu et al. 2024), for scenes viewed from nearer or farther
    /// than the photographs
    ///
    /// Splats are smoothed as far as no photograph can tell the difference, and splats smaller than a pixel fade
    /// instead of growing.
    #[arg(long, help_heading = OPTIMISATION)]
    pub(super) antialias: bool,
    /// Train coarse to fine: start with images of a quarter of the side length and few splats, and increase both
    /// gradually
    ///
    /// They reach full size over the first half of the run, or over three quarters of --surface-iterations (the idea of
    /// DashGaussian).
    #[arg(long, help_heading = OPTIMISATION)]
    pub(super) coarse_to_fine: bool,
    /// Fit an affine colour correction to each training photograph, for captures whose exposure or white balance varies
    ///
    /// Costs quality where they do not vary. Held-out views are rendered without correction, so such scores need a row
    /// of their own in comparisons.
    #[arg(long, help_heading = OPTIMISATION)]
    pub(super) exposure: bool,
    /// Refine the camera poses of the training photographs, for captures with inexact poses; may cost quality where
    /// they are exact
    ///
    /// Poses are refined until a surface is made, or to the end with --no-mesh. The scene contains the refined cameras,
    /// and --json lists the corrections.
    #[arg(long, conflicts_with = "mesh", help_heading = OPTIMISATION)]
    pub(super) refine_poses: bool,
    /// With --refine-poses, roughly the largest pose error that can be corrected; the smaller, the less it costs where
    /// poses are right
    #[arg(long, value_name = "DEGREES", default_value_t = TrainOptions::default().pose_reach, value_parser = positive,
          requires = "refine_poses", help_heading = OPTIMISATION)]
    pub(super) pose_reach: f64,
    /// Fraction of the splats that each iteration drops at random, against overfitting to few views (Park et al. 2025)
    /// [default: 0.2 for up to 12 training views, falling to 0 at 20]
    ///
    /// The fraction grows from 0 at the start to this value at the end; the remaining splats are made more opaque in
    /// compensation.
    #[arg(long, value_name = "0..0.9", value_parser = dropout, help_heading = OPTIMISATION)]
    pub(super) dropout: Option<f32>,
    /// Weight of a loss on disparity, which removes dark fog and floaters from space that no photograph looks at; 0 is
    /// off
    ///
    /// The loss is the mean expected disparity of pixels that already match their photograph, times the median depth of
    /// what the views see. Try 0.01 if held-out views show floaters.
    #[arg(long, value_name = "WEIGHT", default_value_t = TrainOptions::default().disparity_weight, value_parser = finite_not_negative,
          help_heading = OPTIMISATION)]
    pub(super) disparity_weight: f32,
    /// In each iteration, update only the splats that its view sees: faster on large scenes (INRIA 3DGS updates all)
    #[arg(long, help_heading = OPTIMISATION)]
    pub(super) visible_only: bool,
    /// In each iteration, update every texel of the texture maps, not only those that its view sees (HERA)
    #[arg(long, help_heading = OPTIMISATION)]
    pub(super) dense_texels: bool,
    /// Maximum number of floats in splats, texture maps and vertices together, for comparisons at equal size
    ///
    /// Limits the number of splats, which MCMC grows until the budget is used, and the size of maps that keep their
    /// first layout (see --texture-size).
    #[arg(long, value_name = "N", help_heading = OPTIMISATION)]
    pub(super) max_floats: Option<usize>,
    /// The limit of --max-floats as a size in megabytes (10⁶ bytes) of 32-bit floats
    #[arg(long, value_name = "MB", conflicts_with = "max_floats", value_parser = positive, help_heading = OPTIMISATION)]
    pub(super) budget_mb: Option<f64>,

    /// Ignore the points of the capture: splats start at random places that its cameras look at
    #[arg(long, help_heading = OPTIMISATION)]
    pub(super) no_points: bool,

    /// Mesh to use as the surface: .glb, .gltf, .obj or .ply, in the coordinates of the camera poses [default: a
    /// surface made from the capture, see --surface]
    ///
    /// Its vertices and triangles are kept unchanged, and so are its UVs if it has one material (scaled if they leave
    /// 0..1). No shell is added.
    #[arg(long, value_name = "FILE", conflicts_with = "no_mesh", help_heading = MESH)]
    pub(super) mesh: Option<PathBuf>,
    /// Train splats alone, without a mesh
    #[arg(long, help_heading = MESH)]
    pub(super) no_mesh: bool,
    /// Source of the surface [default: points if half of the views each list 100 or more visible points, else splats]
    #[arg(long, value_enum, value_name = "splats|points", conflicts_with_all = ["mesh", "no_mesh"], help_heading = MESH)]
    pub(super) surface: Option<SurfaceOf>,
    /// Number of --iterations that train splats alone, before a surface is made [default: a seventh, at least 400, at
    /// most half; half with --refine-poses and with --density inria or absgs]
    ///
    /// The surface is compared with these splats; the remaining iterations train splats and mesh together.
    #[arg(long, value_name = "N", help_heading = MESH)]
    pub(super) surface_iterations: Option<u32>,
    /// Target number of triangles when a surface made from the capture is simplified (our choice); more remain if it
    /// has many pieces or holes, which are all kept
    #[arg(long, value_name = "N", default_value_t = TrainOptions::default().triangles, value_parser = output::at_least_one, help_heading = MESH)]
    pub(super) triangles: usize,
    /// Detect flat regions of a surface made from the capture, flatten them and remesh them with few triangles (not in
    /// the paper)
    #[arg(long, value_enum, value_name = "auto|off", default_value_t = Choice::Auto, help_heading = MESH)]
    pub(super) planar: Choice,
    /// Add a shell, a sphere far around a surface made from the capture, for sky and distant background seen past it
    /// (not in the paper)
    ///
    /// Not made if photographs have alpha or masks, or without a warm-up. Like all triangles, those of the shell are
    /// kept only where they are worth it.
    #[arg(long, value_enum, value_name = "auto|off", default_value_t = Choice::Auto, help_heading = MESH)]
    pub(super) shell: Choice,
    /// Side of the texture map of colour and opacity in texels; the map of view dependence has a quarter of it
    /// [default: 1.5 times the longer image side, rounded up to a power of two, 128 to 2048]
    ///
    /// For a surface made from the capture, this is the maximum: its kept triangles get about two texels per pixel, and
    /// all maps together about a sixth of --max-floats or --budget-mb, or up to half where maps show held-back views
    /// better than splats. Maps that keep their first layout (--mesh, --warmup 0) take at most half of such a budget,
    /// if their charts then still have room.
    #[arg(long, value_name = "TEXELS", help_heading = MESH, value_parser = clap::value_parser!(u32).range(16..=i64::from(TrainOptions::LARGEST_TEXTURE)))]
    pub(super) texture_size: Option<u32>,
    /// Degree of the spherical harmonics of the mesh; 0 for no view dependence (our choice; HERA does not state it)
    #[arg(long, value_name = "0..3", default_value_t = TrainOptions::default().band_degree, help_heading = MESH,
          value_parser = clap::value_parser!(u32).range(0..=3))]
    pub(super) band_degree: u32,

    /// Rule that orders splats and mesh by depth (HERA: stable)
    #[arg(long, value_enum, default_value_t = Mode::SurfaceConsistent, help_heading = COMPOSITION)]
    pub(super) mode: Mode,
    /// Distance by which a mesh pixel must lie in front of a splat to override its order, relative to the extent of the
    /// cameras; `inf` turns the override off (HERA: 5 cm on heads; 0.01 is our choice for static scenes)
    #[arg(long, value_name = "LAMBDA", default_value_t = TrainOptions::default().lambda, value_parser = not_negative,
          allow_hyphen_values = true, help_heading = COMPOSITION)]
    pub(super) lambda: f32,
    /// Number of mesh layers that a pixel keeps, the nearest first: 1, 2 or 4 (HERA sets no limit; opacity saturates
    /// after a few)
    #[arg(long, value_name = "N", default_value_t = TrainOptions::default().layers, value_parser = layers,
          help_heading = COMPOSITION)]
    pub(super) layers: u32,
    /// Background colour behind the scene (INRIA 3DGS: black); a random colour per iteration discourages holes
    #[arg(long, value_enum, default_value_t = Backdrop::Black, help_heading = COMPOSITION)]
    pub(super) background: Backdrop,

    #[command(flatten)]
    pub(super) loading: CaptureArgs,
    #[command(flatten)]
    pub(super) messages: MessageArgs,
}

const OPTIMISATION: &str = "Optimisation";
const MESH: &str = "Mesh";
const COMPOSITION: &str = "Composition";

#[derive(Clone, Copy, ValueEnum)]
pub(super) enum DensityKind {
    /// Clone and split by gradient, prune, reset opacities (Kerbl et al. 2023)
    Inria,
    /// As inria, but split splats where absolute gradients are large (AbsGS, Ye et al. 2024)
    Absgs,
    /// Relocate dead splats, add splats up to --max-splats (Kheradmand et al. 2024)
    Mcmc,
}

#[derive(Clone, Copy, ValueEnum)]
pub(super) enum Mode {
    /// Compare each splat as a whole with a mesh layer, at the depth where its mean projects; a splat whose mean is
    /// outside the image counts as behind (HERA)
    Stable,
    /// As stable, but only for pixels of the surface that the splat was compared with; compare depths per pixel
    /// elsewhere
    SurfaceConsistent,
    /// Compare depths in every pixel; the order flickers as the camera moves
    Direct,
}

#[derive(Clone, Copy, ValueEnum)]
pub(super) enum Backdrop {
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

fn finite_not_negative(text: &str) -> Result<f32, String> {
    text.parse().ok().filter(|v| (0.0..f32::INFINITY).contains(v)).ok_or_else(|| "expected a number ≥ 0".into())
}

fn dropout(text: &str) -> Result<f32, String> {
    let most = TrainOptions::MOST_DROPOUT;
    text.parse()
        .ok()
        .filter(|part| (0.0..=most).contains(part))
        .ok_or_else(|| format!("expected a number from 0 to {most}"))
}

impl Args {
    pub(super) fn split(&self) -> Split {
        if self.all_views { Split::All } else { Split::Every8th }
    }

    pub(super) fn options(&self) -> TrainOptions {
        TrainOptions {
            split: self.split(),
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
            dropout: self.dropout,
            disparity_weight: self.disparity_weight,
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

    /// Flags that have no effect beside another one, with that one. Not an error, because flags are shared by variants
    /// of `centaur bench`.
    pub(super) fn idle(&self) -> Vec<(&'static str, Vec<&'static str>)> {
        let usual = TrainOptions::default();
        // Flags for reconstructed surfaces.
        let mut of_meshes = vec![
            (self.surface_iterations.is_some(), "--surface-iterations"),
            (self.triangles != usual.triangles, "--triangles"),
            (!self.planar.is_auto(), "--planar"),
            (!self.shell.is_auto(), "--shell"),
        ];
        if self.no_mesh {
            // Flags for any mesh.
            of_meshes.extend([
                (self.warmup.is_some_and(|iterations| iterations > 0), "--warmup"),
                (self.dense_texels, "--dense-texels"),
                (self.texture_size.is_some(), "--texture-size"),
                (self.band_degree != usual.band_degree, "--band-degree"),
                (self.layers != usual.layers, "--layers"),
                (self.lambda != usual.lambda, "--lambda"),
                (!matches!(self.mode, Mode::SurfaceConsistent), "--mode"),
            ]);
        }
        let is_direct = matches!(self.mode, Mode::Direct) && !self.no_mesh;
        let beside = [
            (self.no_mesh, "--no-mesh", of_meshes.clone()),
            (self.mesh.is_some(), "--mesh", of_meshes),
            (is_direct, "--mode direct", vec![(self.lambda != usual.lambda, "--lambda")]),
            (self.all_views, "--all-views", vec![(self.eval_every != usual.eval_every, "--eval-every")]),
        ];
        let given = |flags: Vec<(bool, &'static str)>| -> Vec<&str> {
            flags.into_iter().filter(|(is_given, _)| *is_given).map(|(_, flag)| flag).collect()
        };
        let idle = beside.into_iter().filter(|(is_there, ..)| *is_there).map(|(_, flag, others)| (flag, given(others)));
        idle.filter(|(_, others)| !others.is_empty()).collect()
    }

    /// Checks everything that can be known to fail before the first iteration.
    pub(super) fn check(&self) -> Result<()> {
        if let Some(report) = &self.report {
            // What is wrong with the place of the scene is said below.
            let lock = self.lock_path().ok();
            let files = [Some(&self.output), self.ply.as_ref(), Some(&self.checkpoint()), lock.as_ref()];
            if let Some(file) = files.into_iter().flatten().find(|file| output::is_same(file, report)) {
                let file = file.display();
                return Err(usage::wrong(format!("--report: expected another name than {file}, which is a file")));
            }
        }
        output::check_file(&self.output)?;
        // Also if no checkpoint is to be saved on the way, because Ctrl-C saves one.
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
        let (least, of) = (Splats::floats_each(self.sh_degree), format!("of a splat of degree {}", self.sh_degree));
        if let Some(floats) = self.options().max_floats.filter(|floats| *floats < least) {
            return Err(usage::wrong(match self.budget_mb {
                Some(mb) => format!("--budget-mb: expected at least the {} {of}, found {mb}", 4e-6 * least as f64),
                None => format!("--max-floats: expected at least the {least} {of}, found {floats}"),
            }));
        }
        let checkpoint = self.checkpoint();
        ensure!(!self.resume || checkpoint.is_file(), "{}: expected a checkpoint, found none", checkpoint.display());
        Ok(())
    }

    /// Keeps out other trainings of the same output: they would replace this one's checkpoint and scene.
    pub(super) fn lock(&self) -> Result<LockFile> {
        let path = self.lock_path()?;
        let lock = LockFile::take(&path).with_context(|| format!("{}: cannot lock", path.display()))?;
        lock.with_context(|| {
            let output = self.output.display();
            format!("{output}: another training is writing this scene: wait for its end, or give -o another name")
        })
    }

    /// Path of the lock beside where the scene comes to be, whichever links lead there: `scene.glb.lock`.
    fn lock_path(&self) -> Result<PathBuf> {
        let place = atomic::place_of(&self.output).with_context(|| format!("{}: cannot write", self.output.display()));
        let mut name = place?.into_os_string();
        name.push(".lock");
        Ok(name.into())
    }

    pub(super) fn open(&self) -> Result<Capture> {
        let options = LoadOptions { without_points: self.no_points, ..self.loading.options() };
        let capture = capture::open(&self.capture, &options).map_err(|error| match error {
            CaptureError::Points(_) => anyhow!("{error}; {WITHOUT_POINTS}"),
            _ => error.into(),
        })?;
        let files = capture.points_files.iter().map(PathBuf::as_path);
        self.ply.as_deref().map_or(Ok(()), |ply| output::spare(ply, files))?;
        match capture.points_files.first() {
            Some(file) if capture.points.is_empty() && !self.no_points => {
                bail!("{}: expected points, found none; {WITHOUT_POINTS}", file.display())
            }
            _ => Ok(capture),
        }
    }

    /// Path of the checkpoint beside the output: `scene.glb.checkpoint`.
    pub(super) fn checkpoint(&self) -> PathBuf {
        let mut name = self.output.clone().into_os_string();
        name.push(".checkpoint");
        name.into()
    }

    /// Source of the mesh, and notes of its reader.
    pub(super) fn mesh(&self, capture: &Capture) -> Result<(MeshSource, Vec<String>)> {
        let Some(file) = &self.mesh else {
            let source = match (self.no_mesh, self.surface) {
                (true, _) => MeshSource::None,
                (false, Some(SurfaceOf::Splats)) => MeshSource::Splats,
                (false, Some(SurfaceOf::Points)) => MeshSource::Points,
                (false, None) => MeshSource::suited_to(capture),
            };
            return Ok((source, vec![]));
        };
        surface::given(file, capture)
    }
}

/// Advice where points are missing.
const WITHOUT_POINTS: &str = "--no-points begins with splats at random places that the cameras look at";

#[cfg(test)]
mod tests {
    use clap::{CommandFactory as _, Parser as _};
    use serde_json::{Map, Value, json};

    use super::*;
    use crate::cli::{Cli, Command};

    /// Options by name, for the command with these flags.
    fn options(flags: &str) -> Map<String, Value> {
        let words = "centaur train capture -o scene.glb".split(' ').chain(flags.split_whitespace());
        let Command::Train(args) = Cli::try_parse_from(words).unwrap().command else { unreachable!() };
        serde_json::from_value(serde_json::to_value(args.options()).unwrap()).unwrap()
    }

    /// Flags that are not training options: file locations, which part of a capture is read, the source of the surface,
    /// and messages.
    const OTHERS: [&str; 17] = [
        "output",
        "ply",
        "report",
        "lpips-weights",
        "no-eval",
        "adapter",
        "resume",
        "stop-at-eof",
        "no-points",
        "mesh",
        "surface",
        "downscale",
        "max-side",
        "images",
        "masks",
        "quiet",
        "json",
    ];

    #[test]
    fn no_view_is_measured_where_none_is_held_out() {
        let idle = |flags: &str| {
            let words = "centaur train capture -o scene.glb".split(' ').chain(flags.split_whitespace());
            let Command::Train(args) = Cli::try_parse_from(words).unwrap().command else { unreachable!() };
            args.idle()
        };
        assert_eq!(idle("--all-views --eval-every 7"), [("--all-views", vec!["--eval-every"])]);
        assert!(idle("--all-views").is_empty() && idle("--eval-every 7").is_empty());
    }

    #[test]
    fn every_flag_sets_the_option_that_it_is_for_and_no_other() {
        let rows = [
            ("--all-views", "split", json!("all")),
            ("--iterations 40000", "iterations", json!(40_000)),
            ("--warmup 70", "warmup", json!(70)),
            ("--no-mesh", "warmup", json!(0)),
            ("--surface-iterations 80", "surface_iterations", json!(80)),
            ("--density inria", "density", json!("inria")),
            ("--density absgs", "density", json!("absgs")),
            ("--max-splats 90", "max_splats", json!(90)),
            ("--max-floats 100", "max_floats", json!(100)),
            ("--budget-mb 0.5", "max_floats", json!(125_000)),
            ("--visible-only", "visible_only", json!(true)),
            ("--dense-texels", "dense_texels", json!(true)),
            ("--antialias", "antialias", json!(true)),
            ("--coarse-to-fine", "coarse_to_fine", json!(true)),
            ("--exposure", "exposure", json!(true)),
            ("--refine-poses", "refine_poses", json!(true)),
            ("--pose-reach 1.5 beside --refine-poses", "pose_reach", json!(1.5)),
            ("--dropout 0.25", "dropout", json!(0.25)),
            ("--disparity-weight 0.125", "disparity_weight", json!(0.125)),
            ("--sh-degree 1", "sh_degree", json!(1)),
            ("--ssim-weight 0.75", "ssim_weight", json!(0.75)),
            ("--seed 110", "seed", json!(110)),
            ("--checkpoint-every 120", "checkpoint_every", json!(120)),
            ("--eval-every 130", "eval_every", json!(130)),
            ("--triangles 140", "triangles", json!(140)),
            ("--planar off", "planar", json!(false)),
            ("--shell off", "shell", json!(false)),
            ("--texture-size 150", "texture_size", json!(150)),
            ("--band-degree 3", "band_degree", json!(3)),
            ("--mode stable", "mode", json!("stable")),
            ("--mode direct", "mode", json!("direct")),
            ("--lambda 0.0625", "lambda", json!(0.0625)),
            ("--layers 4", "layers", json!(4)),
            ("--background white", "background", json!("white")),
            ("--background random", "background", json!("random")),
        ];
        let usual = options("");
        assert_eq!(json!(usual), json!(TrainOptions::default()), "defaults of flags are those of options");
        for (flags, option, value) in &rows {
            let (flag, beside) = flags.split_once(" beside ").unwrap_or((flags, ""));
            let without = options(beside);
            let with = options(&format!("{beside} {flag}")).into_iter();
            let changed: Vec<_> = with.filter(|(name, value)| without[name] != *value).collect();
            assert_eq!(changed, [((*option).to_owned(), value.clone())], "{flags}");
        }
        for option in usual.keys() {
            assert!(rows.iter().any(|(_, of_row, _)| of_row == option), "{option} is set by no flag of this table");
        }
        let command = Cli::command();
        let mut flags: Vec<&str> =
            command.find_subcommand("train").unwrap().get_arguments().filter_map(|flag| flag.get_long()).collect();
        let of_row = |flags: &'static str| flags[2..].split(' ').next().unwrap();
        let mut known: Vec<&str> = rows.iter().map(|(flags, ..)| of_row(flags)).chain(OTHERS).collect();
        flags.sort_unstable();
        known.sort_unstable();
        known.dedup();
        assert_eq!(flags, known, "a flag is in this table or among the others");
    }
}
