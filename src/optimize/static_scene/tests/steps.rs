//! Contents of a step, by phase, iteration and options.

use super::{plan::Plan, *};
use crate::{
    optimize::{
        Background,
        schedule::{self, Schedule},
    },
    render::gpu::{
        exposure::ExposureStep,
        loss::{LossValues, TruthAlpha},
        photographs::Truth,
        pose::PoseStep,
        training::Step,
    },
};

/// Sizes of the capture, all different from each other and from 1.
const UNIT: f32 = 0.5;
const EXTENT: f32 = 2.0;
const DISTANCE: f32 = 3.0;
/// Stated number of splats.
const SPLATS: u32 = 7;

/// A setup with three training views; nothing is trained.
struct Stand {
    gpu: Gpu,
    capture: Capture,
    _folder: tempfile::TempDir,
}

impl Stand {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let capture = in_a_row(folder.path(), 0.0, |x| image::Rgba([x as u8, 80, 90, 255]));
        Self { gpu: Gpu::open(None).unwrap(), capture, _folder: folder }
    }

    fn run<T>(&self, options: &TrainOptions, source: &MeshSource, look: impl FnOnce(&Run) -> T) -> T {
        let stop = AtomicBool::new(false);
        let session = Session { gpu: &self.gpu, checkpoints: Checkpoints::Off, stop: &stop, progress: &mut |_| {} };
        let mut run = Run::new(&self.capture, options, source, session).unwrap();
        assert_eq!(run.setup.train, [1, 2, 3]);
        run.setup.scales = Scales { unit: UNIT, extent: EXTENT, distance: DISTANCE, ..run.setup.scales };
        look(&run)
    }

    /// Step `t` of a phase, counted from the phase's beginning, with a mesh if there is one by then.
    fn step<T>(
        &self,
        options: &TrainOptions,
        source: &MeshSource,
        (phase, t): (Phase, u32),
        look: impl FnOnce(&Run, &Plan, &Step) -> T,
    ) -> T {
        self.run(options, source, |run| {
            let has_mesh = phase != Phase::Surface && *source != MeshSource::None;
            let plan = Plan::of(&run.setup, phase, 0, has_mesh);
            of_view(run, &plan, t, |step| look(run, &plan, step))
        })
    }
}

/// Step `t` of a plan with the second view.
fn of_view<T>(run: &Run, plan: &Plan, t: u32, look: impl FnOnce(&Step) -> T) -> T {
    let view = run.setup.train[1];
    let (photos, camera) = (&run.views.photos, run.views.cameras[view]);
    let photo = photos.of_step(view).unwrap();
    let truth = Truth::Sent { rgba: &photo.rgba, number: Some(view) };
    look(&plan.step_on(&run.setup, t, SPLATS, view, &camera, (truth, photos.alpha(view))))
}

/// Options for a tenth of a full run: a further SH degree every hundred iterations, and an opacity reset after a
/// thousand.
fn tenth() -> TrainOptions {
    TrainOptions {
        iterations: 3000,
        warmup: 900,
        surface_iterations: Some(1000),
        sh_degree: 2,
        ..TrainOptions::default()
    }
}

fn assert_near(found: f32, expected: f64) {
    assert!((f64::from(found) - expected).abs() <= 1e-6 * expected.abs(), "{found}, not {expected}");
}

/// Step numbers of splats, maps and vertices, if these are optimised, and SH degrees of splats and maps.
#[test]
fn every_phase_counts_its_own_steps() {
    use Phase::{Joint, Surface, Warmup};
    let (stand, options, given) = (Stand::new(), tenth(), square());
    for (source, phase, t, numbers, degrees) in [
        (&MeshSource::None, Joint, 0, [Some(1), None, None], [0, 3]),
        (&MeshSource::None, Joint, 150, [Some(151), None, None], [1, 3]),
        (&MeshSource::None, Joint, 1000, [Some(1001), None, None], [2, 3]),
        (&MeshSource::Splats, Surface, 150, [Some(151), None, None], [1, 1]),
        (&MeshSource::Splats, Warmup, 0, [None, Some(1), None], [0, 0]),
        // Vertices are fixed for the first eighth of a phase.
        (&MeshSource::Splats, Warmup, 350, [None, Some(351), Some(238)], [2, 3]),
        // Splats continue after the thousand iterations of the surface phase; maps are new, without moments.
        (&MeshSource::Splats, Joint, 0, [Some(1001), Some(1), None], [2, 3]),
        (&MeshSource::Splats, Joint, 250, [Some(1251), Some(251), Some(1)], [2, 3]),
        // The user's mesh stays fixed, and its maps continue.
        (&given, Warmup, 150, [None, Some(151), None], [1, 1]),
        (&given, Joint, 20, [Some(21), Some(921), None], [0, 3]),
    ] {
        stand.step(&options, source, (phase, t), |run, plan, step| {
            let case = format!("{source:?}, {phase:?}, {t}");
            let found = [step.splats.map(|s| s.number), step.texels.map(|s| s.number), step.vertices.map(|s| s.number)];
            assert_eq!((found, [step.sh_degree, step.band_degree]), (numbers, degrees), "{case}");
            assert_eq!(step.truth_alpha, TruthAlpha::Ignore, "{case}");
            let is_whole = matches!(step.truth, Truth::Sent { rgba, number: Some(2) } if rgba.len() == 4 * 32 * 32);
            assert!(*step.camera == run.views.cameras[2] && is_whole, "{case}");
            let age = plan.clock + t;
            if let Some(splats) = step.splats {
                assert_eq!((splats.n_splats, splats.sh_degree), (SPLATS, step.sh_degree), "{case}");
                assert_eq!(splats.seed, step.dropout.seed, "{case}");
                assert_eq!(splats.rates, plan.schedule.rates(age, EXTENT), "{case}");
            }
            if let Some(texels) = step.texels {
                let joint = (phase == Joint).then_some((t, plan.iterations));
                assert_eq!(texels.base_rate, plan::texel_rate(&options, joint), "{case}");
                assert_near(texels.band_rate, 0.2 * f64::from(texels.base_rate));
            }
            if let Some(vertices) = step.vertices {
                assert_eq!(Some(vertices), schedule::vertex_step(t, plan.iterations, 32), "{case}");
            }
            assert_eq!((step.exposure, step.pose), (None, None), "{case}");
        });
    }
}

/// Pictures that are made ahead of time are dropped when their size changes.
#[test]
fn steps_look_ahead_to_the_end_of_a_size() {
    // Six smaller sizes, of ten iterations each.
    let options = TrainOptions { coarse_to_fine: true, iterations: 120, ..options() };
    with_run(&options, |run, _, _| {
        let plan = Plan::of(&run.setup, Phase::Joint, 0, true);
        let ahead = |t: u32| plan.views_after(&run.setup, t).collect::<Vec<_>>();
        assert_eq!([0, 9, 13, 59].map(|t| ahead(t).len()), [9, 0, 6, 0]);
        assert_eq!(ahead(13), (14..20).map(|t| plan.view_at(t)).collect::<Vec<_>>());
        // Once through all views, and no further than the phase goes.
        assert_eq!([60, 118, 119].map(|t| ahead(t).len()), [run.setup.train.len(), 1, 0]);
    });
}

/// Noise is scaled by the capture's unit, and by the longer steps of a short run.
#[test]
fn mcmc_alone_has_noise_and_weights() {
    let stand = Stand::new();
    for (density, t) in
        [Density::Mcmc, Density::Inria, Density::Absgs].into_iter().flat_map(|density| [(density, 0), (density, 1500)])
    {
        let options = TrainOptions { density, ..tenth() };
        stand.step(&options, &MeshSource::None, (Phase::Joint, t), |_, _, step| {
            let splats = step.splats.unwrap();
            let is_mcmc = f64::from(u8::from(density == Density::Mcmc));
            let (unit, haste) = (f64::from(UNIT), 10f64.powf(0.75 - 0.5 * f64::from(t) / 3000.0));
            assert_near(splats.opacity_weight, 0.01 * is_mcmc);
            assert_near(splats.scale_weight, 0.01 / unit * is_mcmc);
            assert_near(splats.noise, 5e5 / (unit * unit * haste) * is_mcmc);
        });
    }
}

#[test]
fn options_reach_the_step() {
    let (stand, joint) = (Stand::new(), (Phase::Joint, 1500));
    let of = |options: TrainOptions| {
        stand.step(&options, &square(), joint, |_, _, step| {
            let (splats, texels) = (step.splats.unwrap(), step.texels.unwrap());
            (step.dropout, step.disparity_weight, splats.visible_only, texels.visited_only, step.background)
        })
    };
    let usual = of(tenth());
    assert_eq!((usual.1, usual.2, usual.3, usual.4), (0.0, false, true, [0.0; 3]));
    // By default the final dropout for three views is a fifth, and half of that is reached half way.
    assert_near(usual.0.rate, 0.1);
    assert_near(of(TrainOptions { dropout: Some(0.6), ..tenth() }).0.rate, 0.3);
    assert_eq!(of(TrainOptions { dropout: Some(0.0), ..tenth() }).0.rate, 0.0);
    assert_eq!(of(TrainOptions { disparity_weight: 0.5, ..tenth() }).1, 0.5 * DISTANCE);
    assert!(of(TrainOptions { visible_only: true, ..tenth() }).2);
    assert!(!of(TrainOptions { dense_texels: true, ..tenth() }).3);
    assert_eq!(of(TrainOptions { background: Background::White, ..tenth() }).4, [1.0; 3]);

    let random = |seed: u64| TrainOptions { background: Background::Random, seed, ..tenth() };
    let (first, again, other) = (of(random(0)), of(random(0)), of(random(1)));
    assert!(first.4.iter().all(|c| (0.0..1.0).contains(c)) && first.4[0] != first.4[1], "{:?}", first.4);
    assert!(first == again && first.0.seed != other.0.seed && first.4 != other.4);
    let next =
        stand.step(&random(0), &square(), (Phase::Joint, 1501), |_, _, step| (step.dropout.seed, step.background));
    assert!(next.0 != first.0.seed && next.1 != first.4);
}

/// Exposures are fixed in the warm-up of a found surface; poses are optimised until there is a mesh.
#[test]
fn exposures_and_poses_move_in_their_phases() {
    use Phase::{Joint, Surface, Warmup};
    let stand = Stand::new();
    let options = TrainOptions { exposure: true, refine_poses: true, pose_reach: 0.9, ..tenth() };
    stand.step(&TrainOptions { refine_poses: false, ..options.clone() }, &square(), (Warmup, 500), |_, plan, step| {
        assert_eq!(step.exposure, Some(ExposureStep { view: 2, rate: Schedule::new(900).exposure_rate(500, 3) }));
        assert_eq!(plan.iterations, 900);
    });
    for (source, phase, age, is_posed) in [
        (MeshSource::None, Joint, Some(500), true),
        (MeshSource::Splats, Surface, Some(500), true),
        (MeshSource::Splats, Warmup, None, false),
        (MeshSource::Splats, Joint, Some(1500), false),
    ] {
        stand.step(&options, &source, (phase, 500), |_, plan, step| {
            let rate = age.map_or(0.0, |age| plan.schedule.exposure_rate(age, 3));
            assert_eq!(step.exposure, Some(ExposureStep { view: 2, rate }), "{source:?}, {phase:?}");
            let turn_rate = schedule::pose_rate(500, plan.iterations, 3, 0.9_f64.to_radians());
            assert!(turn_rate > 0.0);
            let expected = PoseStep { view: 2, turn_rate, shift_rate: turn_rate * EXTENT };
            assert_eq!(step.pose, is_posed.then_some(expected), "{source:?}, {phase:?}");
        });
    }
}

/// Map opacities are frozen for two hundred iterations after a reset of splat opacities, which does not happen with
/// MCMC.
#[test]
fn opacities_of_maps_are_held_after_those_of_splats_were_reset() {
    let stand = Stand::new();
    for density in [Density::Inria, Density::Mcmc] {
        // Long enough that opacities would be reset in a warm-up too, if it had splats.
        let options = TrainOptions { density, warmup: 9000, ..tenth() };
        stand.run(&options, &square(), |run| {
            let holds = |phase: Phase, clock: u32, t: u32| {
                let plan = Plan { clock, ..Plan::of(&run.setup, phase, 0, true) };
                of_view(run, &plan, t, |step| step.texels.unwrap().holds_opacity)
            };
            for clock in [0, 400] {
                let found = [999, 1000, 1199, 1200].map(|age| holds(Phase::Joint, clock, age - clock));
                let is_reset = density == Density::Inria;
                assert_eq!(found, [false, is_reset, is_reset, false], "{density:?}, {clock}");
            }
            assert!(!holds(Phase::Warmup, 0, 1100));
        });
    }
}

/// Both in the loss of training steps and in the reported loss.
#[test]
fn the_weight_of_ssim_is_that_of_the_option() {
    let options = TrainOptions { ssim_weight: 0.7, ..options() };
    with_run(&options, |run, training, scene| {
        let plan = Plan::of(&run.setup, Phase::Joint, 0, true);
        let learnt = |training: &mut Training| {
            run.step(training, &plan, 0).unwrap();
            while training.grow_if_short().unwrap() > 0 {
                run.step(training, &plan, 0).unwrap();
            }
            training.read_splats().unwrap().sh_m
        };
        let of = |weight: f32| learnt(&mut Training::new(run.session.gpu, scene, &run.views.cameras, weight).unwrap());
        let (expected, other, found) = (of(0.7), of(0.2), learnt(training));
        assert!(found == expected && found != other);

        run.run_phase(training, scene, Phase::Joint, None).unwrap();
        let LossValues { l1, ssim } = training.loss().unwrap();
        let (reported, w) = (run.log.past.history.last().unwrap().loss, f64::from(0.7_f32));
        assert!((reported - (1.0 - w) * l1 - w * (1.0 - ssim)).abs() < 1e-12, "{reported}: {l1}, {ssim}");
    });
}
