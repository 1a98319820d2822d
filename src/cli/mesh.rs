use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context as _, Result, anyhow, ensure};
use centaur::capture::{Capture, View, decode};
use centaur::format::{ReadOptions, gltf, mesh_import, read_file};
use centaur::geometry::{
    self, Ball, ChartSpace, Contraction, MeshBvh, SparseStats, Surface, SurfaceDistance, SurfaceStats, Tidying,
    UnwrapStats, Viewers,
};
use centaur::optimize::{SurfaceOrigin, TrainOptions, point_views, surface_from_points, surface_from_splats};
use centaur::scene::{Atlas, Composition, HybridScene, Mesh, Splats, Texture, bounds};

use glam::DVec3;

use super::edits::positive;
use super::output;
use super::progress::Views;
use super::shared::{self, AdapterArgs, CaptureArgs, Choice, MessageArgs};

const EXAMPLES: &str = "\
Examples:
  centaur mesh splats.glb captures/mipnerf360/garden --downscale 4 -o surface.glb
  centaur mesh captures/mipnerf360/garden -o coarse.glb
  centaur mesh captures/mipnerf360/garden --mesh scan.obj --triangles 50000 -o scan.glb
  centaur train captures/mipnerf360/garden --mesh surface.glb -o garden.glb --downscale 4";

/// Make a surface for `centaur train --mesh`: from trained splats, from the points of a capture (coarse), or from a
/// mesh of your own
///
/// With SPLATS, the median depth of the splats is rendered from every view of CAPTURE and fused into a signed distance
/// field; its zero level is extracted, cleaned, smoothed, simplified and cut into charts with texture coordinates.
/// `centaur train --mesh` uses the result unchanged. Without --mesh, `centaur train` makes such a surface by itself,
/// from the training views alone; it then also moves its vertices, drops triangles that splats represent better, and
/// puts a shell around it.
///
/// Without SPLATS, the points that structure from motion found in each view are triangulated, triangles that hide what
/// other views see are dropped, and the rest is fused. This takes seconds.
///
/// With --mesh, nothing is fused: vertices at the same place are welded, degenerate triangles and tiny pieces are
/// dropped, small holes are closed, and the rest is simplified and cut into charts. For a modelled mesh rather than a
/// scan, --holes off --crumbs off keeps windows and small parts. (`centaur train --mesh` accepts any mesh as it is,
/// with its own texture coordinates.)
#[derive(clap::Args)]
#[command(after_help = EXAMPLES, allow_missing_positional = true)]
pub(super) struct Args {
    /// Trained splats, in any format that `centaur convert` reads; meshes in the file are ignored
    #[arg(value_name = "SPLATS")]
    splats: Option<PathBuf>,
    /// Folder with photographs and camera poses, or a transforms*.json
    capture: PathBuf,
    /// Use the mesh in this file instead of SPLATS (.glb, .gltf, .obj or .ply, in the frame of the capture); not with
    /// --planar
    #[arg(long, value_name = "MESH", conflicts_with_all = ["splats", "planar"])]
    mesh: Option<PathBuf>,
    /// Surface file to write
    #[arg(short, long, value_name = "SURFACE.glb", value_parser = output::path(|path| output::with_extension(path, &["glb"])))]
    output: PathBuf,
    /// Target number of triangles; more remain if the surface has many pieces or holes, which are all kept
    #[arg(long, value_name = "N", default_value_t = TrainOptions::default().triangles, value_parser = output::at_least_one)]
    triangles: usize,
    /// Detect flat regions, flatten them and remesh them with few triangles
    #[arg(long, value_enum, value_name = "auto|off", default_value_t = Choice::Auto)]
    planar: Choice,
    /// Close holes of up to 40 edges in flat parts of the surface of --mesh
    #[arg(long, value_enum, value_name = "auto|off", default_value_t = Choice::Auto, requires = "mesh")]
    holes: Choice,
    /// Drop pieces of the surface of --mesh with fewer than 50 triangles and less than 1/100 of the area of the largest
    /// piece
    #[arg(long, value_enum, value_name = "auto|off", default_value_t = Choice::Auto, requires = "mesh")]
    crumbs: Choice,
    /// Side in texels of the atlas for which charts and gutters are laid out
    #[arg(long, value_name = "TEXELS", default_value_t = 1024, value_parser = clap::value_parser!(u32).range(16..=i64::from(TrainOptions::LARGEST_TEXTURE)))]
    texture_size: u32,
    /// Ground truth to compare the surface with, in the frame of the capture; parts of it that no view sees do not
    /// count
    #[arg(long, value_name = "MESH")]
    truth: Option<PathBuf>,
    /// Largest distance from the point that the cameras look at, up to which surfaces are compared [default: twice the
    /// distance of the cameras in unbounded captures, else no limit]
    #[arg(long, value_name = "D", requires = "truth", value_parser = positive)]
    truth_radius: Option<f64>,
    /// Distance below which points count as correct for precision, recall and F-score [default: 1 % of the diagonal of
    /// the ground truth, or of the box around the part of it that is compared]
    #[arg(long, value_name = "D", requires = "truth", value_parser = positive)]
    within: Option<f64>,
    #[command(flatten)]
    adapter: AdapterArgs,
    #[command(flatten)]
    loading: CaptureArgs,
    #[command(flatten)]
    messages: MessageArgs,
}

pub(super) fn run(args: &Args) -> Result<()> {
    output::check_file(&args.output)?;
    output::spare(&args.output, [&args.splats, &args.mesh, &args.truth].into_iter().flatten().map(PathBuf::as_path))?;
    let mut notes = vec![];
    let truth = args.truth.as_deref().map(|file| read(file, &mut notes).map(|surface| (file, surface))).transpose()?;
    // With a given mesh, points are needed only to select the nearby part of the ground truth.
    let capture = args.loading.open(&args.capture, args.mesh.is_some() && args.truth.is_none())?;
    let passed_over = shared::passed_over(&capture.passed_over).into_iter();
    notes.extend(passed_over.map(|note| format!("{}: {note}", args.capture.display())));
    let made = match (&args.mesh, &args.splats) {
        (Some(file), _) => from_mesh(file, args, &mut notes)?,
        (None, Some(splats)) => from_splats(splats, &capture, args, &mut notes)?,
        (None, None) => from_points(&capture, args, &mut notes)?,
    };
    let left = made.steps.simplified;
    if left > args.triangles {
        notes.push(format!(
            "{}: {left} triangles remain, more than the {} of --triangles: all pieces and holes of a surface are kept",
            args.output.display(),
            args.triangles
        ));
    }
    if !args.messages.json {
        notes.iter().for_each(|note| output::note(note));
    }
    let (mesh, charts) = unwrapped(&made, args)?;
    let scene = HybridScene { splats: Splats::empty(0), meshes: vec![mesh], composition: Composition::default() };
    let bytes = gltf::write_glb(&args.output, &scene, &[], None)?;
    // The surface is there, also where it cannot be compared.
    let distance = truth.map(|(file, truth)| compare(&made.surface, file, &truth, args, &capture)).transpose()?;
    let seen = seen_part(&scene.meshes[0], args.texture_size.min(SEEN_AT) as usize, &capture)?;
    let outcome = Outcome { made, charts, seen, distance, bytes, notes };
    if args.messages.json { outcome.print_json(args) } else { outcome.print(args) }
}

/// Surface, and how it was made.
struct Made {
    surface: Surface,
    steps: SurfaceStats,
    origin: SurfaceOrigin,
}

/// Results reported on a surface.
struct Outcome {
    made: Made,
    charts: UnwrapStats,
    /// Fraction of the texels seen by views.
    seen: f64,
    /// Distances from and to the ground truth, if it is given.
    distance: Option<SurfaceDistance>,
    /// Length of the file.
    bytes: u64,
    notes: Vec<String>,
}

impl Outcome {
    fn print_json(&self, args: &Args) -> Result<()> {
        let Self { made: Made { steps, origin, .. }, charts, seen, distance, bytes, notes } = self;
        output::print_json(&serde_json::json!({
            "surface": args.output,
            "bytes": bytes,
            "notes": notes,
            "origin": origin,
            "views": steps.views, "unbounded": steps.contraction.is_some(), "holes_closed": steps.holes,
            "planes": { "found": steps.planar.planes, "triangles_before": steps.planar.before,
                        "triangles_after": steps.planar.after,
                        "part": steps.planar.before as f64 / steps.even as f64 },
            "triangles": { "extracted": steps.extracted, "cleaned": steps.cleaned, "even": steps.even,
                           "simplified": steps.simplified },
            "atlas": { "charts": charts.charts, "gutter": charts.gutter, "texels_per_unit": charts.texels_per_unit,
                       "coverage": charts.coverage, "mean_density": charts.mean_density,
                       "min_density": charts.min_density, "seen": seen },
            "truth": distance,
        }))
    }

    fn print(&self, args: &Args) -> Result<()> {
        let Self { made, charts, seen, distance, bytes, .. } = self;
        if let Some(distance) = distance {
            output::print(&format!(
                "mean distance to the ground truth {:.5}, from it {:.5}, Chamfer distance {:.5}; within {:.5}: precision {:.3}, recall {:.3}, F-score {:.3}; views see {:.0} % of it",
                distance.accuracy,
                distance.completeness,
                distance.chamfer,
                distance.within,
                distance.precision,
                distance.recall,
                distance.f_score,
                100.0 * distance.counted,
            ))?;
        }
        output::print_lines(made.in_words().split('\n'))?;
        output::print(&format!(
            "{} charts cover {:.0} % of the atlas, gutters of {} texels; a triangle has {:.0} % of its texels on average, {:.0} % at worst; views see {:.1} % of the texels",
            charts.charts,
            100.0 * charts.coverage,
            charts.gutter,
            100.0 * charts.mean_density,
            100.0 * charts.min_density,
            100.0 * seen,
        ))?;
        output::print(&format!("wrote {}: {} triangles, {bytes} bytes", args.output.display(), made.steps.simplified))
    }
}

impl Made {
    /// How it came to be, up to its simplification.
    fn in_words(&self) -> String {
        let steps = &self.steps;
        if self.origin == SurfaceOrigin::Given {
            return format!(
                "triangles: {} read, {} kept (holes closed: {})",
                steps.extracted, steps.cleaned, steps.holes
            );
        }
        format!(
            "{} views fused{}; triangles: {} extracted, {} in pieces worth keeping (holes closed: {}), {} not rough\n\
             planes: {}, with {:.0} % of what is not rough: {} triangles, meshed anew with {}",
            steps.views,
            if steps.contraction.is_some() { " in contracted space, because there are points far away" } else { "" },
            steps.extracted,
            steps.cleaned,
            steps.holes,
            steps.even,
            steps.planar.planes,
            100.0 * steps.planar.before as f64 / steps.even as f64,
            steps.planar.before,
            steps.planar.after,
        )
    }
}

/// Reads a mesh. Its UVs are dropped and made anew.
fn read(file: &Path, notes: &mut Vec<String>) -> Result<Surface> {
    let read = mesh_import::read(file)?;
    notes.extend(shared::as_stored(read.y_up).map(|note| format!("{}: {note}", file.display())));
    Ok(Surface { positions: read.positions, triangles: read.triangles })
}

fn from_mesh(file: &Path, args: &Args, notes: &mut Vec<String>) -> Result<Made> {
    let tidying =
        Tidying { triangles: args.triangles, drops_crumbs: args.crumbs.is_auto(), closes_holes: args.holes.is_auto() };
    let (surface, steps) = geometry::tidy(read(file, notes)?, tidying)
        .with_context(|| format!("{}: expected a mesh to make a surface of", file.display()))?;
    Ok(Made { surface, steps, origin: SurfaceOrigin::Given })
}

fn from_splats(splats: &Path, capture: &Capture, args: &Args, notes: &mut Vec<String>) -> Result<Made> {
    let file = read_file(splats, &ReadOptions::default())?;
    let (scene, turned) = (file.scene, shared::turned(file.y_up));
    notes.extend(file.notes.into_iter().chain(turned).map(|note| format!("{}: {note}", splats.display())));
    ensure!(!scene.splats.is_empty(), "{}: expected trained splats, found none", splats.display());
    let gpu = args.adapter.open()?;
    let mut views = Views::new(&args.messages, "fusing", capture.views.len());
    let reached = |view| views.reach(view + 1);
    let (surface, steps) = surface_from_splats(&gpu, &scene, capture, args.triangles, args.planar.is_auto(), reached)
        .with_context(|| splats.display().to_string())?;
    views.finish();
    Ok(Made { surface, steps, origin: SurfaceOrigin::Splats })
}

fn from_points(capture: &Capture, args: &Args, notes: &mut Vec<String>) -> Result<Made> {
    ensure!(
        !capture.points.is_empty(),
        "{}: expected a capture with points, found none: name trained splats before it",
        args.capture.display()
    );
    let all: Vec<usize> = (0..capture.views.len()).collect();
    let photo_of = |view: &View| capture.may_be_cut_out().then(|| decode(view).map(Arc::new)).transpose();
    let views = point_views(capture, &capture.cameras(), &all, photo_of)?;
    let (path, without) = (args.capture.display(), all.len() - views.len());
    let (surface, steps, origin) = surface_from_points(capture, &views, args.triangles, args.planar.is_auto())
        .with_context(|| match without {
            0 => path.to_string(),
            _ => format!("{path}: masks and alpha leave no points in {without} of {} views", all.len()),
        })?;
    let SparseStats { views, guessed, lifted, clear, .. } = steps;
    if !args.messages.json && !args.messages.quiet {
        output::print(&format!("{lifted} triangles of points, {clear} of which hide nothing that another view sees"))?;
    }
    if guessed > 0 {
        let capture = args.capture.display();
        notes.push(format!(
            "{capture}: does not list the visible points of {guessed} of {views} views: points that no nearer one hides were taken as visible"
        ));
    }
    Ok(Made { surface, steps: steps.surface, origin })
}

/// Unwraps the surface; its maps are still without content.
fn unwrapped(made: &Made, args: &Args) -> Result<(Mesh, UnwrapStats)> {
    let charts_in = made.steps.contraction.map(ChartSpace::unbounded);
    let unwrapped = geometry::unwrap(&made.surface, charts_in.as_ref(), args.texture_size, geometry::WIDEST_GUTTER)
        .map_err(|e| {
            let source = args.mesh.as_ref().or(args.splats.as_ref()).unwrap_or(&args.capture);
            anyhow!("{}: {e}; see --texture-size and --triangles", source.display())
        })?;
    let atlas = Atlas::new(Texture::zeros(16, 16, 4), None)?;
    let mesh = Mesh::new(unwrapped.positions, unwrapped.triangles, unwrapped.corner_uvs, atlas)?;
    Ok((mesh, unwrapped.stats))
}

/// Upper bound on texels a side for determining the visible part of a map: hidden texels cost a ray per texel and view.
const SEEN_AT: u32 = 512;

/// Fraction of the texels in charts of a square map whose centres a view of the capture sees.
fn seen_part(mesh: &Mesh, side: usize, capture: &Capture) -> Result<f64> {
    let cameras = capture.cameras();
    let viewers = Viewers::unmasked(&cameras, 0.0, 1);
    let bvh = MeshBvh::of(std::slice::from_ref(mesh));
    let (charted, seen) = geometry::texel_visibility(mesh, [side; 2], &bvh, &viewers)?.counts();
    Ok(seen as f64 / charted.max(1) as f64)
}

/// What is in this last part of the way to a point of the truth does not hide it: the truth itself, which may be rough.
const SAME_PLACE: f64 = 1e-3;

/// The surface against the truth, which is that of `file`, as far as a camera of the capture sees that.
fn compare(surface: &Surface, file: &Path, truth: &Surface, args: &Args, capture: &Capture) -> Result<SurfaceDistance> {
    let [low, high] = bounds(truth.positions.iter().copied()).unwrap_or_default();
    let (cameras, points) = (capture.cameras(), capture.positions());
    let ball = match args.truth_radius {
        Some(radius) => Ball { center: Contraction::around(&cameras, &points)?.center, radius },
        None => Contraction::if_unbounded(&cameras, &points)?
            .map_or(Ball::EVERYTHING, |Contraction { center, radius }| Ball { center, radius }),
    };
    let box_of_ball = |side: f64| (ball.center + DVec3::splat(side * ball.radius)).as_vec3();
    let diagonal = f64::from(low.max(box_of_ball(-1.0)).distance(high.min(box_of_ball(1.0))));
    let bvh = MeshBvh::new([(truth.positions.as_slice(), truth.triangles.as_slice())]);
    let viewers = Viewers::unmasked(&cameras, 0.0, 1);
    let is_seen = |p: DVec3| {
        let mut sights = (0..cameras.len()).filter_map(|view| viewers.sight(view, p));
        sights.any(|sight| sight.is_clear(&bvh, viewers.layers, SAME_PLACE))
    };
    let within = args.within.unwrap_or(0.01 * diagonal);
    geometry::surface_distance(surface, truth, within, ball, is_seen).with_context(|| {
        let file = file.display();
        format!("{file}: expected a surface that views of the capture see where this one is, found none")
    })
}

#[cfg(test)]
mod tests;
