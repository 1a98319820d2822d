use std::sync::atomic::Ordering;

use glam::{DMat3, DVec2, DVec3, Vec2, Vec3};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;

use super::{plan::Plan, *};
use crate::{
    capture::{self, Downscale, LoadOptions},
    format::gltf,
    geometry::{self, Surface, TexelSight, Viewers},
    optimize::{checkpoint::Checkpoint, resolution::ResolutionSchedule, schedule::Schedule},
    render::{
        gpu::{Renderer, state::SplatState, training::Show},
        testing::largest,
    },
    scene::{Atlas, Intrinsics, Texture},
};

mod choices;
mod photographs;

fn demo() -> Capture {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("demo");
    capture::open(&folder, &LoadOptions { downscale: Downscale::MaxSide(64), ..LoadOptions::default() }).unwrap()
}

fn checkpoints(file: &Path, resume: bool) -> Checkpoints {
    if resume { Checkpoints::Resume(file.to_owned()) } else { Checkpoints::Save(file.to_owned()) }
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

/// Four views of 32×32 side by side, without points, of pictures that are this colour in column x, through a lens with radial distortion `k1`.
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

/// A square of the demo's size at its middle.
fn square() -> MeshSource {
    let positions = [[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]].map(Vec3::from).to_vec();
    let surface = Surface { positions, triangles: vec![[0, 1, 2], [0, 2, 3]] };
    MeshSource::Given { surface, corner_uvs: None }
}

#[test]
fn units_follow_what_is_seen() {
    assert_eq!(size::unit_of_length(5.0, None), 1.0);
    assert_eq!(size::unit_of_length(4.0, Some(4.0)), 0.8);
    // A drone over a plain, three cameras side by side.
    assert_eq!((size::unit_of_length(500.0, Some(80.0)), size::unit_of_length(0.1, Some(3.0))), (24.0, 0.3));
    let mut demo = demo();
    let train: Vec<usize> = (0..demo.views.len()).collect();
    let found = size::median_depth(&demo, &train).unwrap() / capture::extent(demo.views.iter().map(|v| &v.camera));
    assert!((0.7..1.2).contains(&found), "{found}");
    // On a tripod, whose cameras have no extent: rates of means, λ and the near plane follow what they see, too.
    let [there, turned] = [0, 1].map(|i| demo.views[i].camera);
    let there_too =
        Camera::new(*turned.intrinsics(), turned.rotation(), -(turned.rotation() * there.center())).unwrap();
    // Nor have they where they differ by less than a pixel.
    let hand = DVec3::splat(1e-6);
    let beside = Camera::new(*there.intrinsics(), there.rotation(), there.translation() + hand).unwrap();
    for (cameras, depth, extent) in [
        ([there, there_too], Some(4e-3), 4e-3),
        ([there, beside], Some(4.0), 4.0),
        ([there, there_too], None, 1.0),
        ([there, turned], Some(4e-3), capture::extent(&[there, turned])),
    ] {
        assert_eq!(size::extent(&cameras, depth), extent);
    }
    // Through lenses ten times as long as where this begins, from ten times as far, things are as large.
    let through = |times: f64| {
        let k = *there.intrinsics();
        let focal = times * f64::from(k.longer_side());
        Camera::new(Intrinsics { fx: focal, fy: focal, ..k }, there.rotation(), there.translation()).unwrap()
    };
    let narrowness = [0.5, 5.0, 50.0].map(|times| size::narrowness(&[through(times)]));
    assert!(narrowness[..2] == [1.0; 2] && (narrowness[2] - 0.1).abs() < 1e-12, "{narrowness:?}");
    demo.points.clear();
    assert_eq!(size::median_depth(&demo, &train), None);
}

/// Of a mesh that is brought along, what no training view shows would stay grey and half transparent.
#[test]
fn what_no_view_sees_of_a_given_mesh_is_transparent() {
    let MeshSource::Given { mut surface, .. } = square() else { unreachable!() };
    // Far above, where no camera looks.
    let above = surface.positions.iter().map(|p| *p + Vec3::new(0.0, 0.0, 1e4)).collect::<Vec<_>>();
    surface.positions.extend(above);
    surface.triangles.extend([[4, 5, 6], [4, 6, 7]]);
    let (gpu, capture, stop) = (Gpu::open(None).unwrap(), demo(), AtomicBool::new(false));
    // On the larger map rays go to every other texel.
    for size in [64, 2048] {
        let session = Session { gpu: &gpu, checkpoints: Checkpoints::Off, stop: &stop, progress: &mut |_| {} };
        let source = MeshSource::Given { surface: surface.clone(), corner_uvs: None };
        // However few of the 42 views it has looked at.
        let options = TrainOptions { texture_size: Some(size), ..options() };
        let trained = train(&capture, source, &options, session).unwrap();
        let mesh = &trained.scene.meshes[0];
        let logits: Vec<f32> = mesh.atlas().base().texels().iter().skip(3).step_by(4).copied().collect();
        let one = Texture::new(1, 1, 1, vec![1.0]).unwrap();
        let texels_of = |faces: std::ops::Range<usize>, rim: u32| {
            let uvs = &mesh.corner_uvs()[faces];
            let drawn = geometry::transfer(&one, uvs, uvs, size, rim).unwrap();
            let logits = logits.iter().zip(drawn.texels()).filter(|(_, drawn)| **drawn > 0.0);
            logits.map(|(logit, _)| *logit).collect::<Vec<f32>>()
        };
        let (seen, hidden) = (texels_of(0..2, 0), texels_of(2..4, 0));
        // But for what coarser levels mix with the chart beside it, all of it, and a texel around it.
        let is_grey = |logit: &&f32| **logit != unseen::TRANSPARENT;
        let rim = texels_of(2..4, 1);
        assert!(hidden.len() * 8 > logits.len() && hidden.iter().filter(is_grey).count() * 15 < hidden.len());
        assert!(rim.len() > hidden.len() && rim.iter().filter(is_grey).count() * 15 < rim.len());
        // Its corners are beyond the table, and learn to be transparent.
        let opaque = seen.iter().filter(|logit| **logit > -1.0).count();
        assert!(opaque * 2 > seen.len(), "{size}: {opaque} of {}", seen.len());
        // Between charts there is nothing to hide.
        assert!(logits.iter().filter(|logit| **logit == unseen::TRANSPARENT).count() < 2 * hidden.len());
    }
}

/// Pictures of 64 pixels begin at half of the size: 32 are the least.
#[test]
fn growing_pictures_read_coarser_levels_at_first() {
    for (coarse_to_fine, levels) in [(false, 0), (true, 1)] {
        with_run(&TrainOptions { coarse_to_fine, ..options() }, |run, _, _| assert_eq!(run.coarser(), levels));
    }
}

/// Over a floor a ball with another in it, and half before it a third.
fn balls() -> Surface {
    let mut all = Surface {
        positions: [[-0.8, -0.8, 0.0], [0.8, -0.8, 0.0], [0.8, 0.8, 0.0], [-0.8, 0.8, 0.0]].map(Vec3::from).to_vec(),
        triangles: vec![[0, 1, 2], [0, 2, 3]],
    };
    for (center, radius) in [([-0.3, 0.0, 0.4], 0.35), ([-0.3, 0.0, 0.4], 0.25), ([0.35, 0.2, 0.3], 0.28)] {
        let first = all.positions.len() as u32;
        for i in 0..=10_u32 {
            for j in 0..20_u32 {
                let [a, b] = [i, j].map(|k| std::f32::consts::PI * k as f32 / 10.0);
                let direction = Vec3::new(a.sin() * b.cos(), a.sin() * b.sin(), a.cos());
                all.positions.push(Vec3::from(center) + radius * direction);
            }
        }
        let cells = (0..10).flat_map(|i| (0..20).map(move |j| [i * 20 + j, i * 20 + (j + 1) % 20]));
        let cells = cells.map(|cell| cell.map(|v| v + first));
        all.triangles.extend(cells.flat_map(|[a, b]| [[a, a + 20, b], [b, a + 20, b + 20]]));
    }
    all
}

/// Rays know of every texel under a pixel and of every one that a gradient reaches, and of hardly any other.
#[test]
fn rays_reach_what_the_renderer_shows() {
    for layers in [1, 2] {
        let options = TrainOptions { warmup: 84, texture_size: Some(256), layers, ..options() };
        with_mesh(balls(), &options, |run, training, scene| {
            let mesh = &scene.meshes[0];
            let sights = run.texel_visibility(mesh, [256; 2]).unwrap();
            let reached = sights.reached(0, u8::MAX);
            let bvh = MeshBvh::new([(mesh.positions(), mesh.triangles())]);
            let (mut pixels, mut off_center, mut missed) = (0, 0, 0);
            for camera in run.train_cameras.clone() {
                training.render(&camera, [0.0; 3], Show::MeshesAlone).unwrap();
                let width = camera.intrinsics().width;
                for (pixel, front) in (0u32..).zip(training.front_triangles(&camera).unwrap()) {
                    let at = DVec2::new(f64::from(pixel % width), f64::from(pixel / width)) + 0.5;
                    let towards = camera.rotation().transpose() * camera.ray(at);
                    let hits = bvh.all_hits(camera.center(), towards);
                    let Some(hit) = hits.iter().find(|hit| hit.triangle + 1 == front) else { continue };
                    let uvs = mesh.corner_uvs()[hit.triangle as usize].map(Vec2::as_dvec2);
                    let [a, b, c] = hit.barycentrics.to_array();
                    let uv = 256.0 * (a * uvs[0] + b * uvs[1] + c * uvs[2]);
                    let texel = (uv.y as usize).min(255) * 256 + (uv.x as usize).min(255);
                    pixels += 1;
                    off_center += usize::from(sights.texels[texel] < TexelSight::Seen(0));
                    missed += usize::from(!reached[texel]);
                }
            }
            run.run_phase(training, scene, Phase::Warmup, None).unwrap();
            let second = training.read_texel_moments().unwrap().1;
            // By what the rays say of a texel's centre, if it lies in a triangle: touched by a gradient or not, reached or not.
            let (one, uvs) = (Texture::new(1, 1, 1, vec![1.0]).unwrap(), mesh.corner_uvs());
            let drawn = geometry::transfer(&one, uvs, uvs, 256, 0).unwrap();
            let mut counts = [[[0; 2]; 2]; 3];
            for (i, moments) in second.chunks_exact(4).take(256 * 256).enumerate() {
                let sight = match sights.texels[i] {
                    _ if drawn.texels()[i] == 0.0 => 0,
                    TexelSight::Outside => unreachable!("{i} is in a triangle"),
                    TexelSight::Hidden => 1,
                    TexelSight::Seen(_) => 2,
                };
                let is_touched = moments.iter().any(|&v| v != 0.0);
                counts[sight][usize::from(is_touched)][usize::from(reached[i])] += 1;
            }
            eprintln!(
                "{layers} layers: {pixels} pixels, {off_center} on texels whose centre is not seen, {missed} missed"
            );
            eprintln!("outside, hidden, seen × untouched, touched × not reached, reached: {counts:?}");
            assert!(pixels > 20_000 && missed == 0 && off_center * 50 < pixels);
            assert_eq!(counts.map(|of_sight| of_sight[1][0]), [0; 3]);
            // Beside slivers at the poles, which are filtered with them where a pixel falls on one: of these few pixels hardly any does.
            let too_many = counts[1][0][1] + counts[2][0][1];
            assert!(too_many * 80 < counts[1..].as_flattened().as_flattened().iter().sum::<usize>());
            assert!(layers == 2 || counts[1][0][0] > 2000);
        });
    }
}

#[test]
fn checkpoints_have_the_history() {
    let (gpu, capture, folder) = (Gpu::open(None).unwrap(), demo(), tempfile::tempdir().unwrap());
    let path = folder.path().join("checkpoint");
    let history = |resume: bool, stop: bool| -> Result<Vec<u32>, TrainError> {
        let stop = AtomicBool::new(stop);
        let checkpoints = checkpoints(&path, resume);
        let session = Session { gpu: &gpu, checkpoints, stop: &stop, progress: &mut |_| {} };
        train(&capture, MeshSource::None, &options(), session).map(|t| t.history.iter().map(|p| p.iteration).collect())
    };
    assert_eq!(history(false, true).unwrap(), Vec::<u32>::new(), "only what is reported without a stop");
    let whole = Checkpoint::read(&path).unwrap();
    let mut damaged = whole.clone();
    damaged.indices.get_mut("log").unwrap().pop();
    damaged.write(&path).unwrap();
    assert!(history(true, false).unwrap_err().to_string().ends_with("log is missing or damaged"));
    whole.write(&path).unwrap();
    assert_eq!(history(true, false).unwrap(), [10, 20]);
}

/// Sets a run up to its joint phase with the square above.
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
    let mesh = run.given(surface, None).unwrap();
    let splats = run.initial_splats(&[], true).unwrap();
    let scene = HybridScene { splats, meshes: vec![mesh], composition: run.composition() };
    let mut training = run.training(&scene).unwrap();
    test(&mut run, &mut training, &scene)
}

/// Surfaces are fused and laid out by the same points: those of splats, where a capture has none.
#[test]
fn without_points_splats_say_whether_there_are_bounds() {
    let (gpu, mut capture, stop) = (Gpu::open(None).unwrap(), demo(), AtomicBool::new(false));
    capture.points.clear();
    let options = TrainOptions { shell: false, ..options() };
    let session = Session { gpu: &gpu, checkpoints: Checkpoints::Off, stop: &stop, progress: &mut |_| {} };
    let run = Run::new(&capture, &options, &MeshSource::Splats, session).unwrap();
    let near = run.initial_splats(&[], true).unwrap();
    for (distance, is_unbounded) in [(1.0, false), (100.0, true)] {
        let mut splats = near.clone().into_arrays();
        splats.means.iter_mut().for_each(|mean| *mean *= distance);
        let scene = HybridScene { splats: splats.check().unwrap(), meshes: vec![], composition: run.composition() };
        let training = run.training(&scene).unwrap();
        assert_eq!(run.charts_in(&training).unwrap().is_some(), is_unbounded);
    }
}

/// What became invisible of a surface that was found goes after training; nothing does of a run that goes on, or of the user's mesh.
#[test]
fn what_ended_faint_is_dropped_after_training() {
    let MeshSource::Given { mut surface, .. } = square() else { unreachable!() };
    // Below, where nothing is behind it.
    surface.positions.extend(surface.positions.clone().iter().map(|p| *p - Vec3::Z));
    surface.triangles.extend([[4, 5, 6], [4, 6, 7]]);
    with_mesh(surface, &options(), |run, _, scene| {
        let mesh = &scene.meshes[0];
        let one = Texture::new(1, 1, 1, vec![1.0]).unwrap();
        let upper = &mesh.corner_uvs()[..2];
        let drawn = geometry::transfer(&one, upper, upper, 64, 1).unwrap();
        let texels = drawn.texels().iter().flat_map(|drawn| [0.0, 0.0, 0.0, if *drawn > 0.0 { 2.0 } else { -5.0 }]);
        let base = Texture::new(64, 64, 4, texels.collect()).unwrap();
        let mesh = mesh.clone().with_atlas(Atlas::new(base, mesh.atlas().bands().cloned()).unwrap());
        let scene = HybridScene { meshes: vec![mesh.clone()], ..scene.clone() };
        let mut training = run.training(&scene).unwrap();
        for (hands_over, outcome, left) in
            [(true, Outcome::Finished, 2), (true, Outcome::Interrupted, 4), (false, Outcome::Finished, 4)]
        {
            run.identity.finds_surface = hands_over;
            let trained = run.finish(&mut training, &scene, outcome).unwrap();
            assert_eq!(trained.faint_triangles, 4 - left);
            let [found] = trained.scene.meshes.try_into().unwrap();
            assert_eq!(
                (found.triangles(), found.corner_uvs()),
                (&mesh.triangles()[..left], &mesh.corner_uvs()[..left])
            );
            assert_eq!(found.positions(), &mesh.positions()[..2 * left]);
            assert_eq!(found.atlas(), mesh.atlas());
        }
    });
}

/// Nothing is seen in black photographs; the run goes on without a mesh and has as many splats as before.
#[test]
fn without_a_surface_splats_are_trained_alone() {
    let (gpu, folder, stop) = (Gpu::open(None).unwrap(), tempfile::tempdir().unwrap(), AtomicBool::new(false));
    let capture = in_a_row(folder.path(), 0.0, |_| image::Rgba([0, 0, 0, 255]));
    // Hardly any splats, all transparent by the end of the surface phase.
    let options = TrainOptions { iterations: 20, surface_iterations: Some(10), max_splats: Some(5), ..options() };
    for source in [MeshSource::Splats, MeshSource::Points] {
        let session = Session { gpu: &gpu, checkpoints: Checkpoints::Off, stop: &stop, progress: &mut |_| {} };
        let trained = train(&capture, source, &options, session).unwrap();
        assert_eq!((trained.outcome, trained.surface), (Outcome::Finished, None));
        assert_eq!((trained.scene.meshes.len(), trained.scene.splats.len()), (0, 5));
        assert!(trained.no_surface.is_some_and(|why| why.contains("surface")));
    }
}

/// Also where it was stopped since.
#[test]
fn a_resumed_run_says_why_it_has_no_surface() {
    let (gpu, folder) = (Gpu::open(None).unwrap(), tempfile::tempdir().unwrap());
    let capture = in_a_row(folder.path(), 0.0, |_| image::Rgba([0, 0, 0, 255]));
    let options = TrainOptions { iterations: 40, surface_iterations: Some(10), max_splats: Some(5), ..options() };
    let run = |resume: bool| {
        let stop = AtomicBool::new(false);
        let progress = &mut |p: &Progress| stop.store(!resume && p.phase == Phase::Joint, Ordering::Relaxed);
        let checkpoints = checkpoints(&folder.path().join("checkpoint"), resume);
        let session = Session { gpu: &gpu, checkpoints, stop: &stop, progress };
        let trained = train(&capture, MeshSource::Splats, &options, session).unwrap();
        (trained.outcome, trained.no_surface.unwrap())
    };
    let [(stopped, why), (finished, why_then)] = [false, true].map(run);
    assert_eq!((stopped, finished), (Outcome::Interrupted, Outcome::Finished));
    assert!(why.contains("surface") && why == why_then, "{why:?} {why_then:?}");
}

/// Also while the last scores of a phase are made: what follows takes minutes.
#[test]
fn a_stop_at_the_end_of_a_phase_is_heeded_there() {
    let (gpu, folder) = (Gpu::open(None).unwrap(), tempfile::tempdir().unwrap());
    let capture = in_a_row(folder.path(), 0.0, |_| image::Rgba([0, 0, 0, 255]));
    let short = TrainOptions { iterations: 20, surface_iterations: Some(10), max_splats: Some(5), ..options() };
    let (options, path) = (TrainOptions { checkpoint_every: 1000, ..short }, folder.path().join("checkpoint"));
    let stop = AtomicBool::new(false);
    let progress = &mut |p: &Progress| stop.store((p.phase, p.iteration) == (Phase::Surface, 10), Ordering::Relaxed);
    let session = Session { gpu: &gpu, checkpoints: checkpoints(&path, false), stop: &stop, progress };
    let trained = train(&capture, MeshSource::Splats, &options, session).unwrap();
    assert_eq!((trained.outcome, trained.no_surface), (Outcome::Interrupted, None));
    assert_eq!(Checkpoint::read(&path).unwrap().meta["phase"], serde_json::to_value(Phase::Surface).unwrap());
}

/// Where a disk has no room for a checkpoint it may have for the scene, which is all that the last iteration leaves to do.
#[test]
fn the_last_checkpoint_may_fail() {
    let (gpu, capture, folder) = (Gpu::open(None).unwrap(), demo(), tempfile::tempdir().unwrap());
    let path = folder.path().join("missing/checkpoint");
    let outcome = |iterations: u32, checkpoint_every: u32, stop_after: u32| {
        let stop = AtomicBool::new(false);
        let progress = &mut |p: &Progress| stop.store(p.iteration == stop_after, Ordering::Relaxed);
        let session = Session { gpu: &gpu, checkpoints: checkpoints(&path, false), stop: &stop, progress };
        let options = TrainOptions { iterations, checkpoint_every, ..options() };
        train(&capture, MeshSource::None, &options, session).map(|trained| trained.outcome)
    };
    // One that is due, also where the run is stopped after it, and one that is asked for in the last iteration.
    for (iterations, every, stop_after) in [(10, 10, 0), (10, 10, 10), (11, 0, 10)] {
        let outcome = outcome(iterations, every, stop_after).unwrap();
        assert_eq!(outcome, Outcome::Finished, "{iterations}, {every}, {stop_after}");
    }
    for (every, stop_after) in [(10, 0), (0, 10)] {
        assert!(matches!(outcome(20, every, stop_after), Err(TrainError::Checkpoint(_))), "{every}, {stop_after}");
    }
    assert!(!path.exists());
}

/// Nor do maps that have no room for its charts end the run.
#[test]
fn a_surface_that_cannot_be_laid_out_leaves_the_splats() {
    let (gpu, capture, stop) = (Gpu::open(None).unwrap(), demo(), AtomicBool::new(false));
    let options = TrainOptions { texture_size: Some(16), ..options() };
    let session = Session { gpu: &gpu, checkpoints: Checkpoints::Off, stop: &stop, progress: &mut |_| {} };
    let trained = train(&capture, MeshSource::Points, &options, session).unwrap();
    assert_eq!((trained.outcome, trained.scene.meshes.len()), (Outcome::Finished, 0));
    assert!(trained.no_surface.is_some_and(|why| why.contains("atlas")));
}

/// Splats that were trained under other cameras are not trained on, nor those of other points.
#[test]
fn checkpoints_are_of_their_cameras_and_points() {
    let (gpu, capture, folder) = (Gpu::open(None).unwrap(), demo(), tempfile::tempdir().unwrap());
    let options = TrainOptions { iterations: 60, lambda: f32::INFINITY, ..options() };
    let run = |capture: &Capture, resume: bool| {
        let stop = AtomicBool::new(false);
        let progress = &mut |_: &Progress| stop.store(true, Ordering::Relaxed);
        let checkpoints = checkpoints(&folder.path().join("checkpoint"), resume);
        let session = Session { gpu: &gpu, checkpoints, stop: &stop, progress };
        train(capture, MeshSource::None, &options, session).map(|trained| trained.outcome)
    };
    assert_eq!(run(&capture, false).unwrap(), Outcome::Interrupted);
    assert_eq!(run(&capture, true).unwrap(), Outcome::Interrupted);
    let mut moved = demo();
    let camera = &mut moved.views[3].camera;
    *camera = Camera::new(*camera.intrinsics(), camera.rotation(), camera.translation() + 1e-9).unwrap();
    let mut other = demo();
    other.points[7].position.x += 1e-9;
    for capture in [moved, other] {
        assert!(matches!(run(&capture, true), Err(TrainError::Resume(_))));
    }
}

#[test]
fn the_near_plane_is_near_in_small_scenes() {
    let cameras = demo().cameras();
    let smaller = |c: &Camera| Camera::new(*c.intrinsics(), c.rotation(), 0.02 * c.translation()).unwrap();
    let small: Vec<Camera> = cameras.iter().map(smaller).collect();
    let extent = capture::extent(&small) as f32;
    let near = |cameras: &[Camera]| surface::near_plane(size::extent(cameras, None) as f32, 0.1);
    assert_eq!(near(&cameras), 0.1);
    assert!(extent < 0.1 && near(&small) == 0.05 * extent);
    assert_eq!(near(&small[..1]), 0.05, "one camera says nothing of the size");
}

/// A splat goes after training if the mesh hides all of it from all views, not if it stands out between the points that rays look at,
/// and none does of a run that goes on.
#[test]
fn what_ended_behind_what_is_opaque_is_dropped_after_training() {
    let MeshSource::Given { mut surface, .. } = square() else { unreachable!() };
    // A box around the middle of the demo, with a lid and a floor.
    surface.positions = [-0.5, 0.5].iter().flat_map(|&z| surface.positions.iter().map(move |p| p.with_z(z))).collect();
    let sides = (0..4).flat_map(|i| [[i, (i + 1) % 4, 4 + i], [(i + 1) % 4, 4 + (i + 1) % 4, 4 + i]]);
    surface.triangles.extend(sides.chain([[4, 5, 6], [4, 6, 7]]));
    with_mesh(surface, &options(), |run, _, scene| {
        let mesh = &scene.meshes[0];
        let base = Texture::new(64, 64, 4, [0.0, 0.0, 0.0, 5.0].repeat(64 * 64)).unwrap();
        let mesh = mesh.clone().with_atlas(Atlas::new(base, mesh.atlas().bands().cloned()).unwrap());
        let mut arrays = scene.splats.clone().into_arrays();
        for (i, (mean, scale)) in arrays.means.iter_mut().zip(&mut arrays.log_scales).enumerate() {
            // The first is small and in the box. The second is, too, but for what is farther than two deviations.
            *mean = if i < 2 { Vec3::ZERO } else { Vec3::new(0.0, 0.0, 1.0 + 0.01 * (i % 10) as f32) };
            *scale = if i == 1 { Vec3::new(0.48, 0.48, 0.24) } else { Vec3::splat(0.05) }.map(f32::ln);
        }
        arrays.opacity_logits.fill(2.0);
        let scene = HybridScene { splats: arrays.check().unwrap(), meshes: vec![mesh], ..scene.clone() };
        let viewers = Viewers { cameras: &run.train_cameras, near: 0.1, layers: 1, shows: &|_, _| true };
        let by_rays =
            geometry::occluded_splats(&scene.splats, (&scene.meshes, &MeshBvh::of(&scene.meshes)), 0.02, &viewers);
        assert!(by_rays[..2] == [true; 2] && !by_rays[2..].contains(&true));
        let mut training = run.training(&scene).unwrap();
        for (outcome, dropped) in [(Outcome::Finished, 1), (Outcome::Interrupted, 0)] {
            let trained = run.finish(&mut training, &scene, outcome).unwrap();
            assert_eq!(trained.occluded_splats, dropped);
            assert_eq!(trained.scene.splats.means(), &scene.splats.means()[dropped..]);
        }
    });
}

/// Trains with `value` at float `at` of the geometry or the SH coefficients.
fn error_with(geometry: bool, at: usize, value: f32) -> TrainError {
    // Without a density step before the end, which finds geometry earlier.
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

/// Also where the mesh is there before the splats are, and where its surface is made of points.
#[test]
fn floats_stay_within_their_budget() {
    let (gpu, capture, stop) = (Gpu::open(None).unwrap(), demo(), AtomicBool::new(false));
    let options = TrainOptions { max_floats: Some(60_000), ..options() };
    for source in [square(), MeshSource::Points, MeshSource::Splats, MeshSource::None] {
        let session = Session { gpu: &gpu, checkpoints: Checkpoints::Off, stop: &stop, progress: &mut |_| {} };
        let scene = train(&capture, source.clone(), &options, session).unwrap().scene;
        assert!(scene.total_floats() <= 60_000, "{source:?}: {}", scene.total_floats());
        assert!(scene.total_floats() > 40_000, "{source:?}: {}", scene.total_floats());
    }
    // Maps that nothing lays out anew begin as large as they may stay.
    for (source, warmup) in [(square(), 20), (MeshSource::Points, 0)] {
        let options = TrainOptions { texture_size: Some(256), warmup, ..options.clone() };
        let session = Session { gpu: &gpu, checkpoints: Checkpoints::Off, stop: &stop, progress: &mut |_| {} };
        let scene = train(&capture, source, &options, session).unwrap().scene;
        let maps = scene.meshes[0].atlas().floats();
        assert!(scene.total_floats() <= 60_000 && maps > 15_000 && maps <= 30_000, "{}, {maps}", scene.total_floats());
    }
    let options = TrainOptions { max_floats: Some(1000), ..options };
    for warmup in [0, 20] {
        let options = TrainOptions { warmup, ..options.clone() };
        let session = Session { gpu: &gpu, checkpoints: Checkpoints::Off, stop: &stop, progress: &mut |_| {} };
        let scene = train(&capture, MeshSource::Points, &options, session).unwrap().scene;
        assert!(scene.meshes.is_empty() && scene.total_floats() <= 1000, "{}", scene.total_floats());
    }
    let session = Session { gpu: &gpu, checkpoints: Checkpoints::Off, stop: &stop, progress: &mut |_| {} };
    let error = train(&capture, square(), &options, session).unwrap_err().to_string();
    assert!(error.starts_with("expected a budget of at least the ") && error.ends_with("take, found 1000"), "{error}");
}

/// Structure from motion leaves points right before cameras, in the sky and a thousand times as far: neither bounds nor how
/// large splats begin may follow them.
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
            // Whether any of it is worth its texels after so few iterations is another matter.
            let found = trained.selection.unwrap();
            assert!(found.triangles > 100, "{found:?}");
            eprintln!("{source:?}: {found:?}");
            trained.history.last().unwrap().psnr.unwrap()
        });
        eprintln!("{source:?}: {clean:.2} dB held out, {wild:.2} dB with wild points");
        assert!(wild > clean - 0.5, "{source:?}: {clean} dB held out, {wild} dB with wild points");
    }
}

#[test]
fn a_nan_is_found_and_named() {
    // Such a splat is not drawn, so that the loss says nothing; it is found by the first look at the run all the same.
    for (geometry, at, value, group) in [
        (true, 12 * 7, f32::NAN, "means of splat 7"),
        (true, 12 * 8 + 3, f32::NAN, "opacity logits of splat 8"),
        (true, 12 * 9 + 8, f32::INFINITY, "log-scales of splat 9"),
        (false, 48 * 10, f32::NAN, "SH coefficients of splat 10"),
    ] {
        let error = error_with(geometry, at, value).to_string();
        let expected = format!("iteration 10 (Joint): {group} not finite");
        assert_eq!(error, expected);
    }
    // Filters do not hide it.
    with_run(&TrainOptions { density: Density::Inria, antialias: true, ..options() }, |run, training, scene| {
        training.smooth();
        let mut arrays = training.read_splats().unwrap();
        arrays.geometry[12 * 8 + 3] = f32::NAN;
        training.write_splats(&arrays).unwrap();
        let error = run.run_phase(training, scene, Phase::Joint, None).unwrap_err().to_string();
        assert_eq!(error, "iteration 10 (Joint): opacity logits of splat 8 not finite");
    });
}

/// Whatever stands in its arrays, a checkpoint is taken or refused.
#[test]
fn damaged_checkpoints_are_refused() {
    let (gpu, capture, folder) = (Gpu::open(None).unwrap(), demo(), tempfile::tempdir().unwrap());
    let path = folder.path().join("checkpoint");
    let options = TrainOptions {
        iterations: 30,
        surface_iterations: Some(10),
        warmup: 30,
        exposure: true,
        refine_poses: true,
        ..options()
    };
    for (source, phase) in
        [(MeshSource::Points, Phase::Warmup), (MeshSource::Splats, Phase::Warmup), (MeshSource::Splats, Phase::Joint)]
    {
        let run = |resume: bool| {
            let stop = AtomicBool::new(false);
            let progress = &mut |p: &Progress| stop.store(p.phase == phase, Ordering::Relaxed);
            let session = Session { gpu: &gpu, checkpoints: checkpoints(&path, resume), stop: &stop, progress };
            train(&capture, source.clone(), &options, session)
        };
        assert_eq!(run(false).unwrap().outcome, Outcome::Interrupted);
        let whole = Checkpoint::read(&path).unwrap();
        assert_eq!(whole.meta["phase"], serde_json::to_value(phase).unwrap());
        let names: Vec<String> = whole.tensors.keys().cloned().collect();
        assert!(!whole.tensors["vertices/normals"].is_empty(), "{phase:?}: no vertex moves");
        for name in names {
            let mut damaged = whole.clone();
            damaged.tensors.get_mut(&name).unwrap().pop();
            damaged.write(&path).unwrap();
            match run(true) {
                Err(TrainError::Resume(_)) => {}
                // An array of none lost nothing.
                Ok(_) if damaged == whole => {}
                other => panic!("{source:?}, {phase:?}, {name}: {:?}", other.map(|trained| trained.outcome)),
            }
        }
    }
}

#[test]
fn a_nan_in_a_map_is_found_and_named() {
    with_run(&options(), |run, training, scene| {
        let (mut first, second) = training.read_texel_moments().unwrap();
        first[4 * 70 + 1] = f32::NAN;
        assert!(training.write_texel_moments(&first, &second));
        let error = run.run_phase(training, scene, Phase::Warmup, None).unwrap_err().to_string();
        assert!(error.starts_with("iteration 10 (Warmup): a map of the mesh not finite"), "{error}");
    });
}

/// The handover of the surface phase may keep none.
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

/// With filters, too, which the file has in scales, opacities and its footprint.
#[test]
fn the_file_shows_what_the_trainer_showed() {
    file_shows_what_trainer_showed(&options());
    file_shows_what_trainer_showed(&TrainOptions { antialias: true, ..options() });
}

/// The user's mesh stays where it is; a surface that the run has made follows the photographs to the end.
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
        run.identity.finds_surface = true;
        let warmed = positions_after(run, Phase::Warmup);
        let joint = positions_after(run, Phase::Joint);
        assert!(warmed != given && joint != warmed);
        // Across the square's plane, the direction of its normals.
        assert!(joint.iter().zip(&given).all(|(a, b)| a.truncate() == b.truncate() && a.z != b.z), "{joint:?}");
    });
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
        let read = gltf::read(&path).unwrap().scene;
        let mut renderer = Renderer::new(run.session.gpu, &read, &run.cameras).unwrap();
        for camera in run.cameras.clone().iter().step_by(6) {
            let before = training.render(camera, scene.composition.background, Show::All).unwrap();
            let after = renderer.render(camera).unwrap();
            let pairs = before.rgb.as_flattened().iter().zip(after.rgb.as_flattened());
            let worst = largest(pairs.map(|(a, b)| f64::from((a - b).abs())));
            assert!(worst < 1.0 / 255.0, "{worst}");
        }
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
        // The reset follows the step 4.
        assert_eq!(changed(5), [true, false]);
        assert_eq!(changed(6), [true, false]);
        assert_eq!(changed(4), [true, true]);
    });
}
