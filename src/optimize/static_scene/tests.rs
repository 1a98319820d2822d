use std::path::Path;

use super::*;
use crate::{
    capture::{Downscale, LoadOptions},
    format::gltf,
    geometry::Surface,
    render::gpu::Renderer,
};

fn demo() -> Capture {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("demo");
    capture::open(&folder, &LoadOptions { downscale: Downscale::MaxSide(64), ..LoadOptions::default() }).unwrap()
}

fn options() -> TrainOptions {
    TrainOptions {
        iterations: 20,
        warmup: 10,
        surface_iterations: 40,
        max_splats: 1500,
        texture_size: Some(64),
        checkpoint_every: 0,
        eval_every: 0,
        ..TrainOptions::default()
    }
}

/// A square of the demo's size at its middle.
fn square() -> MeshSource {
    let positions =
        [[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]].map(glam::Vec3::from).to_vec();
    let surface = Surface { positions, triangles: vec![[0, 1, 2], [0, 2, 3]] };
    MeshSource::Given { surface, corner_uvs: None }
}

/// Sets a run up to its joint phase with the mesh above.
fn with_run<T>(options: &TrainOptions, test: impl FnOnce(&mut Run, &mut Training, &HybridScene) -> T) -> T {
    let (gpu, capture, stop) = (Gpu::open(None).unwrap(), demo(), AtomicBool::new(false));
    let session = Session { gpu: &gpu, checkpoint: None, resume: false, stop: &stop, progress: &mut |_| {} };
    let mut run = Run::new(&capture, options, &square(), session).unwrap();
    let MeshSource::Given { surface, corner_uvs } = square() else { unreachable!() };
    let mesh = surface::textured(surface, corner_uvs, options, 64).unwrap();
    let splats = run.initial_splats().unwrap();
    let scene = HybridScene { splats, meshes: vec![mesh], composition: run.composition() };
    let mut training = run.training(&scene).unwrap();
    test(&mut run, &mut training, &scene)
}

#[test]
fn a_nan_is_found_and_named() {
    // Which float of the geometry, and what it is called. A mean that is no number is not drawn, and found only when
    // the splats are looked at; a colour shows in the loss.
    for (geometry, at, name) in
        [(true, 12 * 7, "means of splat 7"), (true, 12 * 7 + 3, "opacity logits of splat 7"), (false, 48 * 7, "SH")]
    {
        let options = options();
        let error = with_run(&options, |run, training, scene| {
            let mut arrays = training.read_splats().unwrap();
            let values = if geometry { &mut arrays.geometry[0] } else { &mut arrays.sh[0] };
            values[at] = f32::NAN;
            training.write_splats(&arrays).unwrap();
            run.run_phase(training, scene, Phase::Joint, None)
                .and_then(|outcome| run.finish(training, scene, outcome))
                .unwrap_err()
        });
        let TrainError::NotFinite { phase: Phase::Joint, iteration: 1..=20, group } = &error else {
            panic!("{error}");
        };
        assert!(group.starts_with(name) || !geometry || at % 12 == 3, "{group}");
        let line = error.to_string();
        assert!(line.contains("iteration ") && line.contains(" of splat "), "{line}");
    }
}

#[test]
fn the_file_shows_what_the_trainer_showed() {
    let options = options();
    let folder = tempfile::tempdir().unwrap();
    with_run(&options, |run, training, scene| {
        run.run_phase(training, scene, Phase::Warmup, None).unwrap();
        let outcome = run.run_phase(training, scene, Phase::Joint, None).unwrap();
        let trained = run.finish(training, scene, outcome).unwrap();
        let path = folder.path().join("scene.glb");
        gltf::write_glb(&path, &trained.scene, &[], None).unwrap();
        let read = gltf::read(&path).unwrap().scene;
        let mut renderer = Renderer::new(run.session.gpu, &read, &run.cameras).unwrap();
        for camera in run.cameras.clone().iter().step_by(6) {
            let before = training.render(camera, scene.composition.background, true).unwrap();
            let after = renderer.render(camera).unwrap();
            let pairs = before.rgb.as_flattened().iter().zip(after.rgb.as_flattened());
            let worst = pairs.map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
            assert!(worst < 1.0 / 255.0, "{worst}");
        }
    });
}
