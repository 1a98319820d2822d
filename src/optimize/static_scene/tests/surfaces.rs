//! Surfaces that runs extract, or fail to extract.

use glam::DVec3;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;

use super::*;

/// Surfaces are fused and unwrapped with the same points: the means of splats, if a capture has no points.
#[test]
fn without_points_splats_say_whether_there_are_bounds() {
    let (gpu, mut capture, stop) = (Gpu::open(None).unwrap(), demo(), AtomicBool::new(false));
    capture.points.clear();
    let options = TrainOptions { shell: false, ..options() };
    let session = Session { gpu: &gpu, checkpoints: Checkpoints::Off, stop: &stop, progress: &mut |_| {} };
    let run = Run::new(&capture, &options, &MeshSource::Splats, session).unwrap();
    let near = start::splats(&run.setup, &run.views, &[], true).unwrap();
    for (distance, is_unbounded) in [(1.0, false), (100.0, true)] {
        let mut splats = near.clone().into_arrays();
        splats.means.iter_mut().for_each(|mean| *mean *= distance);
        let scene =
            HybridScene { splats: splats.check().unwrap(), meshes: vec![], composition: run.setup.composition() };
        let training = run.training(&scene).unwrap();
        assert_eq!(finding::chart_space(&run.setup, &run.views, &training).unwrap().is_some(), is_unbounded);
    }
}

/// Black photographs show no surface; the run continues without a mesh and keeps its number of splats.
#[test]
fn without_a_surface_splats_are_trained_alone() {
    let (gpu, folder, stop) = (Gpu::open(None).unwrap(), tempfile::tempdir().unwrap(), AtomicBool::new(false));
    let capture = in_a_row(folder.path(), 0.0, |_| image::Rgba([0, 0, 0, 255]));
    // Few splats, all transparent by the end of the surface phase.
    let options = TrainOptions { iterations: 20, surface_iterations: Some(10), max_splats: Some(5), ..options() };
    for source in [MeshSource::Splats, MeshSource::Points] {
        let session = Session { gpu: &gpu, checkpoints: Checkpoints::Off, stop: &stop, progress: &mut |_| {} };
        let trained = train(&capture, source, &options, session).unwrap();
        assert_eq!((trained.outcome, trained.surface), (Outcome::Finished, None));
        assert_eq!((trained.scene.meshes.len(), trained.scene.splats.len()), (0, 5));
        assert!(trained.no_surface.is_some_and(|why| why.contains("surface")));
    }
}

/// A run also continues if the maps have no room for the charts of its surface.
#[test]
fn a_surface_that_cannot_be_laid_out_leaves_the_splats() {
    let (gpu, capture, stop) = (Gpu::open(None).unwrap(), demo(), AtomicBool::new(false));
    let options = TrainOptions { texture_size: Some(16), ..options() };
    let session = Session { gpu: &gpu, checkpoints: Checkpoints::Off, stop: &stop, progress: &mut |_| {} };
    let trained = train(&capture, MeshSource::Points, &options, session).unwrap();
    assert_eq!((trained.outcome, trained.scene.meshes.len()), (Outcome::Finished, 0));
    assert!(trained.no_surface.is_some_and(|why| why.contains("atlas")));
}

/// Structure from motion produces wrong points: right in front of cameras, in the sky and a thousand times as far away.
/// Neither bounds nor initial splat sizes may depend on them.
#[test]
fn a_few_wild_points_do_little_harm() {
    let (gpu, stop) = (Gpu::open(None).unwrap(), AtomicBool::new(false));
    let (clean, mut wild) = (demo(), demo());
    let centers: Vec<DVec3> = wild.views.iter().map(|view| view.camera.center()).collect();
    let mut random = Pcg64::seed_from_u64(7);
    for (i, point) in wild.points.iter_mut().step_by(20).enumerate() {
        let mut side = || 2.0 * random.random::<f64>() - 1.0;
        let direction = DVec3::new(side(), side(), side()).normalize();
        let reach = [0.1, 30.0, 3000.0][i % 3];
        point.position = centers[i % centers.len()] + reach * direction;
    }
    let options =
        TrainOptions { iterations: 100, warmup: 40, surface_iterations: Some(50), max_splats: Some(2000), ..options() };
    for source in [MeshSource::Points, MeshSource::Splats] {
        let [clean, wild] = [&clean, &wild].map(|capture| {
            let session = Session { gpu: &gpu, checkpoints: Checkpoints::Off, stop: &stop, progress: &mut |_| {} };
            let trained = train(capture, source.clone(), &options, session).unwrap();
            // Whether the mesh is worth its texels after so few iterations is not tested here.
            let found = trained.selection.unwrap();
            assert!(found.triangles > 100, "{found:?}");
            eprintln!("{source:?}: {found:?}");
            trained.history.last().unwrap().psnr.unwrap()
        });
        eprintln!("{source:?}: {clean:.2} dB held out, {wild:.2} dB with wild points");
        assert!(wild > clean - 0.5, "{source:?}: {clean} dB held out, {wild} dB with wild points");
    }
}
