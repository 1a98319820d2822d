//! Poses can be in any unit of length and at any distance from the origin, and so can scenes.

use std::path::Path;
use std::sync::atomic::AtomicBool;

use centaur::capture::{self, Capture, Downscale, LoadOptions};
use centaur::edit::Similarity;
use centaur::evaluate::evaluate;
use centaur::optimize::{Checkpoints, MeshSource, Session, TrainOptions, Trained, train};
use centaur::render::gpu::Gpu;
use glam::{DMat3, DVec3};

/// The demo in another unit, `unit` of which equal one of the original.
fn demo_in(unit: f64) -> Capture {
    let small = LoadOptions { downscale: Downscale::MaxSide(64), ..LoadOptions::default() };
    let mut capture = capture::open(&Path::new(env!("CARGO_MANIFEST_DIR")).join("demo"), &small).unwrap();
    move_by(&mut capture, &Similarity::new(unit, DMat3::IDENTITY, DVec3::ZERO).unwrap());
    capture
}

fn move_by(capture: &mut Capture, similarity: &Similarity) {
    for view in &mut capture.views {
        view.camera = similarity.camera(&view.camera).unwrap();
    }
    capture.points.iter_mut().for_each(|point| point.position = similarity.point(point.position));
}

/// Trains a hybrid with few splats, or splats alone.
fn trained(gpu: &Gpu, capture: &Capture, mesh: &MeshSource, refine_poses: bool) -> Trained {
    let options = TrainOptions {
        refine_poses,
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
    let trained = train(capture, mesh.clone(), &options, session).unwrap();
    assert_eq!(trained.scene.meshes.is_empty(), *mesh == MeshSource::None);
    trained
}

/// Final held-out PSNR in dB.
fn psnr(trained: &Trained) -> f64 {
    trained.history.iter().rev().find_map(|progress| progress.psnr).unwrap()
}

/// Not bit-identical: rounding differs, and so does the near plane, which is at most 0.2.
#[test]
fn scenes_are_the_same_in_millimetres_and_in_kilometres() {
    let gpu = Gpu::open(None).unwrap();
    for mesh in [MeshSource::None, MeshSource::Points] {
        let found = [1e-3, 1.0, 1e3].map(|unit| psnr(&trained(&gpu, &demo_in(unit), &mesh, false)));
        eprintln!("{mesh:?}: {found:.2?} dB");
        // Untrained results would be alike in all units too.
        assert!(found.iter().all(|psnr| *psnr > 24.0), "{mesh:?}: {found:?}");
        let least = found.into_iter().fold(f64::INFINITY, f64::min);
        let most = found.into_iter().fold(f64::NEG_INFINITY, f64::max);
        assert!(most - least < 0.5, "{mesh:?}: {found:?}");
    }
}

/// At twice the distance f32 would be too coarse for the written values.
#[test]
fn scenes_are_the_same_far_from_the_origin() {
    let gpu = Gpu::open(None).unwrap();
    let near = demo_in(1.0);
    let extent = capture::extent(&near.cameras());
    let shift = Similarity::new(1.0, DMat3::IDENTITY, DVec3::new(1.0, -0.6, 0.8) * 1000.0 * extent).unwrap();
    let mut far = near.clone();
    move_by(&mut far, &shift);
    for (mesh, refine_poses) in [(MeshSource::None, true), (MeshSource::Points, false)] {
        let [(near_psnr, _), (far_psnr, there)] = [&near, &far].map(|capture| {
            let trained = trained(&gpu, capture, &mesh, refine_poses);
            (evaluate(&gpu, &trained.scene, capture, None).unwrap().mean.unwrap().psnr, trained)
        });
        eprintln!("{mesh:?}: {near_psnr:.2} {far_psnr:.2} dB");
        assert!(near_psnr > 24.0 && (far_psnr - near_psnr).abs() < 0.5, "{mesh:?}: {near_psnr} {far_psnr}");
        // Reported poses refer to the cameras as given.
        assert_eq!(there.poses.is_empty(), !refine_poses);
        for (name, pose) in &there.poses {
            let rows = pose.world_to_camera.map(|[x, y, z, t]| (DVec3::new(x, y, z), t));
            let center = -rows.iter().map(|(row, t)| *row * *t).sum::<DVec3>();
            let given = far.views.iter().find(|view| view.name == *name).unwrap().camera.center();
            assert!((center.distance(given) - pose.distance).abs() < 1e-6 * extent, "{name}: {center} {given}");
        }
    }
}
