use glam::Vec3;

use super::*;
use crate::{
    capture::{self, Downscale, LoadOptions},
    geometry::Surface,
};

mod choices;
mod joint;
mod nans;
mod photographs;
mod pruned;
mod resuming;
mod scale;
mod steps;
mod surfaces;
mod visibility;

fn demo() -> Capture {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("demo");
    capture::open(&folder, &LoadOptions { downscale: Downscale::MaxSide(64), ..LoadOptions::default() }).unwrap()
}

fn checkpoints(file: &Path, resume: bool) -> Checkpoints {
    if resume { Checkpoints::Resume(file.to_owned()) } else { Checkpoints::Save(file.to_owned()) }
}

/// For a session: passes on the progress reports alone.
fn on_progress(mut tell: impl FnMut(&Progress)) -> impl FnMut(Event<'_>) {
    move |event| {
        if let Event::Progress(progress) = event {
            tell(progress);
        }
    }
}

fn options() -> TrainOptions {
    TrainOptions {
        iterations: 20,
        warmup: 10,
        surface_iterations: Some(40),
        max_splats: Some(1500),
        texture_size: Some(64),
        checkpoint_every: 0,
        eval_every: 0,
        ..TrainOptions::default()
    }
}

/// A capture of four 32×32 views in a row, without points, with colour `color(x)` in column x, through a lens with
/// radial distortion `k1`.
fn in_a_row(folder: &Path, k1: f64, color: impl Fn(u32) -> image::Rgba<u8>) -> Capture {
    let frame = |i: u32| {
        let name = format!("{i}.png");
        image::RgbaImage::from_fn(32, 32, |x, _| color(x)).save(folder.join(&name)).unwrap();
        let pose = [[1.0, 0.0, 0.0, f64::from(i)], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 4.0], [0.0, 0.0, 0.0, 1.0]];
        serde_json::json!({ "file_path": name, "transform_matrix": pose })
    };
    let frames = (0..4).map(frame).collect::<Vec<_>>();
    let transforms = serde_json::json!({ "w": 32, "h": 32, "fl_x": 32.0, "k1": k1, "frames": frames });
    std::fs::write(folder.join("transforms.json"), transforms.to_string()).unwrap();
    capture::open(folder, &LoadOptions::default()).unwrap()
}

/// A square of the demo's size at its centre.
fn square() -> MeshSource {
    let positions = [[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]].map(Vec3::from).to_vec();
    let surface = Surface { positions, triangles: vec![[0, 1, 2], [0, 2, 3]] };
    MeshSource::Given { surface, corner_uvs: None }
}

/// Runs `test` on a run that is set up for its joint phase with [`square`] as mesh.
fn with_run<T>(options: &TrainOptions, test: impl FnOnce(&mut Run, &mut Training, &HybridScene) -> T) -> T {
    let MeshSource::Given { surface, .. } = square() else { unreachable!() };
    with_mesh(surface, options, test)
}

fn with_mesh<T>(
    surface: Surface,
    options: &TrainOptions,
    test: impl FnOnce(&mut Run, &mut Training, &HybridScene) -> T,
) -> T {
    let (gpu, capture, stop) = (Gpu::open(None).unwrap(), demo(), AtomicBool::new(false));
    let session = Session { gpu: &gpu, checkpoints: Checkpoints::Off, stop: &stop, progress: &mut |_| {} };
    let source = MeshSource::Given { surface: surface.clone(), corner_uvs: None };
    let mut run = Run::new(&capture, options, &source, session).unwrap();
    let mesh = start::given_mesh(&run.setup, &run.views, surface, None).unwrap();
    let splats = start::splats(&run.setup, &run.views, &[], true).unwrap();
    let scene = HybridScene { splats, meshes: vec![mesh], composition: run.setup.composition() };
    let mut training = run.training(&scene).unwrap();
    test(&mut run, &mut training, &scene)
}
