//! Values that are not finite are found and named, wherever they are.

use super::{plan::Plan, *};
use crate::optimize::{
    density::mcmc::EpochWeight,
    resume::{HostState, Saved},
};

#[test]
fn a_nan_is_found_and_named() {
    // Such a splat is not drawn, so the loss does not reveal it; the first check of the run finds it nevertheless.
    for (geometry, at, value, group) in [
        (true, 12 * 7, f32::NAN, "means of splat 7"),
        (true, 12 * 8 + 3, f32::NAN, "opacity logits of splat 8"),
        (true, 12 * 9 + 8, f32::INFINITY, "log-scales of splat 9"),
        (false, 48 * 10, f32::NAN, "SH coefficients of splat 10"),
    ] {
        let error = error_with(geometry, at, value).to_string();
        let expected = format!("iteration 10 (joint): {group} not finite");
        assert_eq!(error, expected);
    }
    // Filters do not hide the value.
    with_run(&TrainOptions { density: Density::Inria, antialias: true, ..options() }, |run, training, scene| {
        training.smooth();
        let mut arrays = training.read_splats().unwrap();
        arrays.geometry[12 * 8 + 3] = f32::NAN;
        training.write_splats(&arrays).unwrap();
        let error = run.run_phase(training, scene, Phase::Joint, None).unwrap_err().to_string();
        assert_eq!(error, "iteration 10 (joint): opacity logits of splat 8 not finite");
    });
}

/// Trains with `value` at float `at` of the geometry or the SH coefficients.
fn error_with(geometry: bool, at: usize, value: f32) -> TrainError {
    // No density step before the end, since it would find such geometry earlier.
    let options = TrainOptions { density: Density::Inria, ..options() };
    with_run(&options, |run, training, scene| {
        let mut arrays = training.read_splats().unwrap();
        let values = if geometry { &mut arrays.geometry } else { &mut arrays.sh };
        values[at] = value;
        training.write_splats(&arrays).unwrap();
        run.run_phase(training, scene, Phase::Joint, None)
            .and_then(|outcome| run.finish(training, scene, outcome))
            .unwrap_err()
    })
}

#[test]
fn a_nan_in_a_map_is_found_and_named() {
    with_run(&options(), |run, training, scene| {
        let (mut first, second) = training.read_texel_moments().unwrap();
        first[4 * 70 + 1] = f32::NAN;
        assert!(training.write_texel_moments(&first, &second));
        let error = run.run_phase(training, scene, Phase::Warmup, None).unwrap_err().to_string();
        assert!(error.starts_with("iteration 10 (warm-up): a map of the mesh not finite"), "{error}");
    });
}

/// The iteration named is counted within the phase, although the clock of the schedule continues from the previous
/// phase.
#[test]
fn a_nan_at_a_density_step_is_named_by_its_phase() {
    let options = TrainOptions { iterations: 60, surface_iterations: Some(40), ..options() };
    with_run(&options, |run, training, scene| {
        run.setup.identity.finds_surface = true;
        assert_eq!(Plan::of(&run.setup, Phase::Joint, 0, true).clock, 40);
        let mut arrays = training.read_splats().unwrap();
        arrays.geometry[12 * 7] = f32::NAN;
        training.write_splats(&arrays).unwrap();
        let error = run.run_phase(training, scene, Phase::Joint, None).unwrap_err();
        let TrainError::NotFinite { phase: Phase::Joint, iteration, group } = error else { panic!("{error}") };
        assert!(iteration <= 20 && group == "means of splat 7", "iteration {iteration}: {group}");
    });
}

/// Reports come at other iterations, and splats notice an invalid exposure only when its photograph is used next.
#[test]
fn no_checkpoint_holds_an_exposure_that_is_no_number() {
    let options = TrainOptions { exposure: true, ..options() };
    with_run(&options, |run, training, scene| {
        let plan = Plan::of(&run.setup, Phase::Joint, 0, true);
        let saved = |training: &Training| {
            let (found, past) = (run.found.clone(), run.log.past.clone());
            let epoch = &EpochWeight::default();
            let host = HostState { reached: (Phase::Joint, 1), found, poses: None, epoch, past };
            Saved::capture(training, scene, host).map(drop)
        };
        run.step(training, &plan, 0).unwrap();
        saved(training).unwrap();
        let mut exposures = training.read_exposures().unwrap().unwrap();
        exposures.moments[1].fill(f32::NAN);
        training.expose(&exposures).unwrap();
        run.step(training, &plan, 1).unwrap();
        let error = saved(training).unwrap_err();
        let TrainError::NotFinite { phase: Phase::Joint, iteration: 1, group } = error else { panic!("{error}") };
        assert_eq!(group, "exposures of photographs");
    });
}
