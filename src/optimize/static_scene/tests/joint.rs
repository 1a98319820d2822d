//! Joint training of splats and maps, and the file that results.

use super::{order::ViewOrder, plan::Plan, *};
use crate::{
    format::{gltf, read_scene},
    optimize::{resolution::ResolutionSchedule, schedule::Schedule},
    render::{
        gpu::{Renderer, state::SplatState, training::Show},
        testing::largest,
    },
};

/// The handover from the surface phase may keep no splats.
#[test]
fn without_any_splats_the_maps_are_trained() {
    for density in [Density::Inria, Density::Mcmc] {
        let options = TrainOptions { density, iterations: 90, ..options() };
        with_run(&options, |run, training, scene| {
            training.write_splats(&SplatState::default()).unwrap();
            let outcome = run.run_phase(training, scene, Phase::Joint, None).unwrap();
            let trained = run.finish(training, scene, outcome).unwrap();
            assert_eq!((trained.outcome, trained.scene.splats.len()), (Outcome::Finished, 0));
            let (first, last) = (trained.history[0].loss, trained.history[8].loss);
            assert!(last < first, "{first} {last}");
        });
    }
}

/// A mesh given by the user stays fixed; a surface extracted by the run is fitted to the photographs until the end.
#[test]
fn only_vertices_of_a_found_surface_move_beside_splats() {
    let options = TrainOptions { iterations: 30, surface_iterations: Some(10), ..options() };
    with_run(&options, |run, training, scene| {
        let mut positions_after = |run: &mut Run, phase| {
            run.run_phase(training, scene, phase, None).unwrap();
            training.read_meshes(&scene.meshes).unwrap()[0].positions().to_vec()
        };
        let given = scene.meshes[0].positions().to_vec();
        assert!([Phase::Warmup, Phase::Joint].iter().all(|phase| positions_after(run, *phase) == given));
        run.setup.identity.finds_surface = true;
        let warmed = positions_after(run, Phase::Warmup);
        let joint = positions_after(run, Phase::Joint);
        assert!(warmed != given && joint != warmed);
        // Vertices move across the square's plane, along its normals.
        assert!(joint.iter().zip(&given).all(|(a, b)| a.truncate() == b.truncate() && a.z != b.z), "{joint:?}");
    });
}

#[test]
fn after_an_opacity_reset_the_mesh_learns_colours_only() {
    with_run(&options(), |run, training, scene| {
        let schedule = Schedule { opacity_reset_interval: Some(5), densify_until: 1000, ..Schedule::new(1000) };
        let plan = Plan {
            phase: Phase::Joint,
            from: 0,
            iterations: 1000,
            clock: 0,
            schedule,
            order: ViewOrder::of(&run.setup, Phase::Joint),
            resolution: ResolutionSchedule { full_from: 0 },
            has_mesh: true,
            moves_vertices: false,
        };
        let before = scene.meshes[0].atlas().base().texels();
        let mut changed = |t| {
            run.step(training, &plan, t).unwrap();
            let after = training.read_meshes(&scene.meshes).unwrap().remove(0);
            let changed =
                |c: usize| before.iter().zip(after.atlas().base().texels()).skip(c).step_by(4).any(|(a, b)| a != b);
            [changed(0), changed(3)]
        };
        // The reset follows step 4.
        assert_eq!(changed(5), [true, false]);
        assert_eq!(changed(6), [true, false]);
        assert_eq!(changed(4), [true, true]);
    });
}

/// Also with filters, which the file represents by scales, opacities and its footprint.
#[test]
fn the_file_shows_what_the_trainer_showed() {
    file_shows_what_trainer_showed(&options());
    file_shows_what_trainer_showed(&TrainOptions { antialias: true, ..options() });
}

fn file_shows_what_trainer_showed(options: &TrainOptions) {
    let folder = tempfile::tempdir().unwrap();
    with_run(options, |run, training, scene| {
        run.run_phase(training, scene, Phase::Warmup, None).unwrap();
        let outcome = run.run_phase(training, scene, Phase::Joint, None).unwrap();
        let smoothing =
            training.read_splats().unwrap().geometry.iter().skip(11).step_by(12).fold(0.0, |a: f32, &b| a.max(b));
        assert_eq!(smoothing > 0.0, options.antialias);
        let trained = run.finish(training, scene, outcome).unwrap();
        let path = folder.path().join("scene.glb");
        gltf::write_glb(&path, &trained.scene, &[], None).unwrap();
        let read = read_scene(&path).unwrap();
        let mut renderer = Renderer::new(run.session.gpu, &read, &run.views.cameras).unwrap();
        for camera in run.views.cameras.clone().iter().step_by(6) {
            let before = training.render(camera, scene.composition.background, Show::All).unwrap();
            let after = renderer.render(camera).unwrap();
            let pairs = before.rgb.as_flattened().iter().zip(after.rgb.as_flattened());
            let worst = largest(pairs.map(|(a, b)| f64::from((a - b).abs())));
            assert!(worst < 1.0 / 255.0, "{worst}");
        }
    });
}
