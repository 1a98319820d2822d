//! Training options that no other test sets.

use super::*;
use crate::{optimize::Background, render::gpu::Renderer, scene::Composition};

/// Rendered in front of another background than its own, black opaque content has to hide the background, and
/// transparent content must not.
#[test]
fn a_background_tells_opaque_from_transparent() {
    let gpu = Gpu::open(None).unwrap();
    for (background, alpha) in
        [(Background::White, 255), (Background::White, 0), (Background::Random, 255), (Background::Random, 0)]
    {
        let (folder, stop) = (tempfile::tempdir().unwrap(), AtomicBool::new(false));
        let capture = in_a_row(folder.path(), 0.0, |_| image::Rgba([0, 0, 0, alpha]));
        let options = TrainOptions { background, iterations: 400, ..options() };
        let session = Session { gpu: &gpu, checkpoints: Checkpoints::Off, stop: &stop, progress: &mut |_| {} };
        let scene = train(&capture, MeshSource::None, &options, session).unwrap().scene;
        let own = if background == Background::White { [1.0; 3] } else { [0.0; 3] };
        assert_eq!(scene.composition.background, own);
        let composition = Composition { background: [1.0; 3], ..scene.composition };
        let (scene, camera) = (HybridScene { composition, ..scene }, capture.views[1].camera);
        let picture = Renderer::new(&gpu, &scene, &[camera]).unwrap().render(&camera).unwrap();
        let mean = picture.rgb.iter().map(|rgb| rgb[1]).sum::<f32>() / picture.rgb.len() as f32;
        eprintln!("{background:?}, alpha {alpha}: {mean:.3} before white");
        assert!(if alpha == 255 { mean < 0.25 } else { mean > 0.9 }, "{background:?}, alpha {alpha}: {mean}");
    }
}

/// Adam on only the visible parameters, or on every texel in every step, takes other steps but learns a scene of
/// similar quality.
#[test]
fn which_parameters_a_step_moves_is_a_choice() {
    let (gpu, capture, stop) = (Gpu::open(None).unwrap(), demo(), AtomicBool::new(false));
    let psnr = |visible_only: bool, dense_texels: bool| {
        let options = TrainOptions { visible_only, dense_texels, iterations: 100, warmup: 50, ..options() };
        let session = Session { gpu: &gpu, checkpoints: Checkpoints::Off, stop: &stop, progress: &mut |_| {} };
        let psnr = train(&capture, square(), &options, session).unwrap().history.last().unwrap().psnr.unwrap();
        eprintln!("visible only {visible_only}, all texels {dense_texels}: {psnr:.2} dB held out");
        psnr
    };
    let usual = psnr(false, false);
    for chosen in [psnr(true, false), psnr(false, true)] {
        assert!((chosen - usual).abs() < 1.0 && chosen != usual, "{chosen} dB, {usual} dB without the option");
    }
}

/// A short warm-up has larger steps and leaves the rates of the next phase unchanged; a long one has smaller steps
/// throughout.
#[test]
fn a_short_warm_up_leaves_the_rates_after_it() {
    let rates = |warmup: u32| {
        let options = TrainOptions { iterations: 7000, warmup, ..options() };
        [None, Some((0, 6000)), Some((6000, 6000))].map(|joint| plan::texel_rate(&options, joint))
    };
    let usual = TrainOptions::warmup_of(7000);
    let [short, as_usual, long] = [100, usual, 2 * usual].map(rates);
    assert!(short[0] > 3.0 * as_usual[0] && short[1..] == as_usual[1..], "{short:?} {as_usual:?}");
    assert!((0..3).all(|k| long[k] < as_usual[k]) && as_usual[1] == as_usual[0], "{long:?} {as_usual:?}");
}

/// Also between the evaluations of the loss, which happen every ten iterations.
#[test]
fn held_out_views_are_looked_at_as_often_as_asked() {
    let (gpu, capture, stop) = (Gpu::open(None).unwrap(), demo(), AtomicBool::new(false));
    let options = TrainOptions { eval_every: 7, ..options() };
    let session = Session { gpu: &gpu, checkpoints: Checkpoints::Off, stop: &stop, progress: &mut |_| {} };
    let history = train(&capture, MeshSource::None, &options, session).unwrap().history;
    let reports: Vec<_> = history.iter().map(|p| (p.iteration, p.psnr.is_some())).collect();
    assert_eq!(reports, [(7, true), (10, false), (14, true), (20, true)]);
}

/// The loss of an iteration is kept even if density control then needs larger buffers.
#[test]
fn a_loss_outlives_buffers_that_grow() {
    let (gpu, mut capture, stop) = (Gpu::open(None).unwrap(), demo(), AtomicBool::new(false));
    capture.points.truncate(400);
    capture.views.iter_mut().for_each(|view| view.sees.clear());
    // Density steps are at every twentieth iteration, evaluations of the loss at every tenth.
    let options = TrainOptions { iterations: 300, ..options() };
    let session = Session { gpu: &gpu, checkpoints: Checkpoints::Off, stop: &stop, progress: &mut |_| {} };
    let trained = train(&capture, MeshSource::None, &options, session).unwrap();
    let splats = |i: usize| trained.history[i].splats;
    assert!(
        2 * splats(trained.history.len() - 1) > 3 * splats(0),
        "{} splats do not outgrow the room for half as many again as {}",
        splats(trained.history.len() - 1),
        splats(0)
    );
    let lowest = trained.history.iter().map(|progress| progress.loss).fold(f64::INFINITY, f64::min);
    for progress in &trained.history {
        // The loss of empty buffers equals the weight of SSIM.
        assert!(progress.loss != f64::from(options.ssim_weight), "iteration {}", progress.iteration);
        assert!(progress.loss < 10.0 * lowest, "iteration {}: {}", progress.iteration, progress.loss);
    }
}

#[test]
fn a_surface_is_made_of_points_where_most_views_see_many() {
    let mut demo = demo();
    let seen_by = |demo: &mut Capture, counts: &[u32]| {
        for (view, count) in demo.views.iter_mut().zip(counts.iter().cycle()) {
            view.sees = (0..*count).collect();
        }
        MeshSource::suited_to(demo)
    };
    assert_eq!(seen_by(&mut demo, &[100, 100, 0]), MeshSource::Points);
    assert_eq!(seen_by(&mut demo, &[500, 99, 99]), MeshSource::Splats);
    demo.views.clear();
    assert_eq!(MeshSource::suited_to(&demo), MeshSource::Splats);
}
