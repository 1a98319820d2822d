//! Poses are in any unit of length, and so are scenes.

use std::path::Path;
use std::sync::atomic::AtomicBool;

use centaur::capture::{self, Capture, Downscale, LoadOptions};
use centaur::optimize::{Checkpoints, MeshSource, Session, TrainOptions, train};
use centaur::render::gpu::Gpu;
use centaur::scene::Camera;

/// The demo in another unit: this many of it are one of what it has.
fn demo_in(unit: f64) -> Capture {
    let small = LoadOptions { downscale: Downscale::MaxSide(64), ..LoadOptions::default() };
    let mut capture = capture::open(&Path::new(env!("CARGO_MANIFEST_DIR")).join("demo"), &small).unwrap();
    for view in &mut capture.views {
        let camera = &view.camera;
        view.camera = Camera::new(*camera.intrinsics(), camera.rotation(), camera.translation() * unit).unwrap();
    }
    capture.points.iter_mut().for_each(|point| point.position *= unit);
    capture
}

/// Held-out PSNR in dB at the end.
fn psnr(gpu: &Gpu, unit: f64, mesh: &MeshSource) -> f64 {
    let options = TrainOptions {
        iterations: 300,
        surface_iterations: Some(150),
        warmup: 60,
        // So few that the maps are worth their texels.
        max_splats: Some(600),
        triangles: 2000,
        layers: 1,
        texture_size: Some(128),
        checkpoint_every: 0,
        eval_every: 0,
        ..TrainOptions::default()
    };
    let session = Session { gpu, checkpoints: Checkpoints::Off, stop: &AtomicBool::new(false), progress: &mut |_| {} };
    let trained = train(&demo_in(unit), mesh.clone(), &options, session).unwrap();
    assert_eq!(trained.scene.meshes.is_empty(), *mesh == MeshSource::None);
    trained.history.iter().rev().find_map(|progress| progress.psnr).unwrap()
}

/// Not bit by bit: rounding differs, and the near plane, which is no farther than 0.2.
#[test]
fn scenes_are_the_same_in_millimetres_and_in_kilometres() {
    let gpu = Gpu::open(None).unwrap();
    for mesh in [MeshSource::None, MeshSource::Points] {
        let found = [1e-3, 1.0, 1e3].map(|unit| psnr(&gpu, unit, &mesh));
        eprintln!("{mesh:?}: {found:.2?} dB");
        // Where nothing was learnt, it is alike in all units.
        assert!(found.iter().all(|psnr| *psnr > 24.0), "{mesh:?}: {found:?}");
        let least = found.into_iter().fold(f64::INFINITY, f64::min);
        let most = found.into_iter().fold(f64::NEG_INFINITY, f64::max);
        assert!(most - least < 0.5, "{mesh:?}: {found:?}");
    }
}
