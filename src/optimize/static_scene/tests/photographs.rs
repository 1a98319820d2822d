//! Photographs with alpha, with varying exposure, and with slightly wrong poses.

use std::sync::Arc;

use glam::{DMat3, DVec2, DVec3};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;

use super::{plan::Plan, *};
use crate::{
    capture::View,
    geometry,
    optimize::{seen_points, static_scene::photographs::Photographs},
    stats,
};

/// The demo with its photographs changed by `change`, which gets their index in the order of names.
fn changed(folder: &Path, change: impl Fn(usize, &mut image::RgbaImage)) -> Capture {
    let demo = Path::new(env!("CARGO_MANIFEST_DIR")).join("demo");
    let [sparse, images] = ["sparse/0", "images"].map(|name| folder.join(name));
    [&sparse, &images].into_iter().for_each(|folder| std::fs::create_dir_all(folder).unwrap());
    for file in std::fs::read_dir(demo.join("sparse/0")).unwrap().map(|entry| entry.unwrap().path()) {
        std::fs::copy(&file, sparse.join(file.file_name().unwrap())).unwrap();
    }
    let mut names: Vec<_> =
        std::fs::read_dir(demo.join("images")).unwrap().map(|entry| entry.unwrap().path()).collect();
    names.sort();
    for (i, file) in names.iter().enumerate() {
        let mut picture = image::open(file).unwrap().into_rgba8();
        change(i, &mut picture);
        // Written as PNG, whatever the file's extension.
        picture.save_with_format(images.join(file.file_name().unwrap()), image::ImageFormat::Png).unwrap();
    }
    capture::open(folder, &LoadOptions { downscale: Downscale::MaxSide(64), ..LoadOptions::default() }).unwrap()
}

/// The demo with training photographs that are brighter or darker and tinted, by up to a third; held-out ones are
/// unchanged.
fn unevenly_exposed(folder: &Path) -> Capture {
    changed(folder, |i, picture| {
        let gain = |c: usize| if i % 8 == 0 { 1.0 } else { 1.0 + 0.33 * (2.4 * i as f32 + 0.7 * c as f32).sin() };
        picture
            .pixels_mut()
            .for_each(|p| [0, 1, 2].into_iter().for_each(|c| p.0[c] = (gain(c) * f32::from(p.0[c])).min(255.0) as u8));
    })
}

/// Transparent pixels do not count, whatever other photographs contain.
#[test]
fn each_photograph_has_its_own_alpha() {
    let (gpu, folder) = (Gpu::open(None).unwrap(), tempfile::tempdir().unwrap());
    let losses = |[r, g, b, a]: [u8; 4]| {
        let capture = changed(&folder.path().join(format!("{r}-{b}-{a}")), |i, picture| {
            // The first training view is left unchanged.
            for (x, _, p) in picture.enumerate_pixels_mut().filter(|_| i % 3 == 0) {
                if x < 100 {
                    p.0 = [r, g, b, a];
                }
            }
        });
        let stop = AtomicBool::new(false);
        let session = Session { gpu: &gpu, checkpoints: Checkpoints::Off, stop: &stop, progress: &mut |_| {} };
        let options = TrainOptions { iterations: 100, ..options() };
        let trained = train(&capture, MeshSource::None, &options, session).unwrap();
        trained.history.iter().map(|p| p.loss).collect::<Vec<_>>()
    };
    let [red, blue] = [[255, 0, 0, 0], [0, 0, 255, 0]].map(losses);
    assert!(red.len() == 10 && red == blue, "{red:?} {blue:?}");
    // Opaque pixels do count: by 2 % at first.
    let [red, blue] = [[255, 0, 0, 255], [0, 0, 255, 255]].map(losses);
    assert!(red.iter().zip(&blue).take(3).all(|(a, b)| (a - b).abs() > 1e-2 * a), "{red:?} {blue:?}");
}

/// Also if undistorted frames reach outside the photographs, as with extreme lenses, which is treated as a mask if
/// there is no alpha.
#[test]
fn photographs_with_alpha_are_cut_out_whatever_the_lens() {
    let gpu = Gpu::open(None).unwrap();
    for (k1, opacity, is_cut_out) in [(0.0, 0, true), (10.0, 0, true), (10.0, 255, false), (0.0, 255, false)] {
        let folder = tempfile::tempdir().unwrap();
        let alpha = |x: u32| if x == 16 { opacity } else { 255 };
        let capture = in_a_row(folder.path(), k1, |x| image::Rgba([200, 100, 50, alpha(x)]));
        let photo = capture::decode(&capture.views[1]).unwrap();
        // The first pixel is outside the photograph.
        assert_eq!((photo.masked, photo.rgba[3] == 0), (k1 > 0.0 && !is_cut_out, k1 > 0.0), "{k1} {opacity}");
        let (options, stop) = (options(), AtomicBool::new(false));
        let session = Session { gpu: &gpu, checkpoints: Checkpoints::Off, stop: &stop, progress: &mut |_| {} };
        let run = Run::new(&capture, &options, &MeshSource::Splats, session).unwrap();
        assert_eq!([run.views.photos.are_cut_out, run.setup.shell.is_none()], [is_cut_out; 2], "{k1} {opacity}");
    }
}

/// Neither for a step nor ahead of one.
#[test]
fn photographs_that_the_adapter_keeps_are_not_decoded_again() {
    let (gpu, folder) = (Gpu::open(None).unwrap().posing_as_gpu(), tempfile::tempdir().unwrap());
    let capture = in_a_row(folder.path(), 0.0, |x| image::Rgba([x as u8, 80, 90, 255]));
    let (options, stop) = (options(), AtomicBool::new(false));
    let session = Session { gpu: &gpu, checkpoints: Checkpoints::Off, stop: &stop, progress: &mut |_| {} };
    let mut run = Run::new(&capture, &options, &MeshSource::None, session).unwrap();
    run.views.photos = Photographs::within(0, &capture, &run.setup.train, std::iter::empty()).unwrap();
    let splats = start::splats(&run.setup, &run.views, &[], true).unwrap();
    let scene = HybridScene { splats, meshes: vec![], composition: run.setup.composition() };
    let mut training = run.training(&scene).unwrap();
    // Two of three.
    training.keep_photographs(2 * 4 * 32 * 32);
    let plan = Plan::of(&run.setup, Phase::Joint, 0, false);
    (0..3).for_each(|t| run.step(&mut training, &plan, t).unwrap());
    // The third is the one that is not kept; what is made ahead of time stays here until a step wants it.
    assert_eq!(run.views.photos.of_steps().bytes(), 0, "kept ones are made for the next steps");
    capture.views.iter().for_each(|view| std::fs::remove_file(view.source.path()).unwrap());
    for t in 3..9 {
        let is_kept = [0, 1].map(|t| plan.view_at(t)).contains(&plan.view_at(t));
        assert_eq!(run.step(&mut training, &plan, t).is_ok(), is_kept, "{t}");
    }
}

/// Masked areas would not train the colours of a mesh: no mesh is made of points there, nor kept where no judging view
/// shows it.
#[test]
fn a_surface_is_of_what_masks_leave() {
    let (gpu, folder) = (Gpu::open(None).unwrap(), tempfile::tempdir().unwrap());
    let whole = changed(folder.path(), |_, _| {});
    let along = |axis: usize| stats::median(whole.points.iter().map(|point| point.position[axis]).collect()).unwrap();
    let middle = DVec3::new(along(0), along(1), along(2));
    // Indices of the judging training views, which are counted without the held-out ones.
    let judges = |i: usize| !i.is_multiple_of(8) && (i - i / 8 - 1) % 4 == 2;
    std::fs::create_dir(folder.path().join("masks")).unwrap();
    for (i, view) in whole.views.iter().enumerate() {
        let camera = view.camera.resized(224, 168);
        let center = camera.project(camera.to_camera(middle));
        // Masks show discs, but those of judging views only a corner.
        let mask = image::GrayImage::from_fn(224, 168, |x, y| {
            let is_in_disc = center.distance(DVec2::new(f64::from(x), f64::from(y))) < 0.2 * 224.0;
            // Masked pixels are 2, not 0, as JPEG may leave black.
            let is_left = if judges(i) { x + y < 8 } else { is_in_disc };
            image::Luma([if is_left { 255 } else { 2 }])
        });
        let name = Path::new(&view.name).file_name().unwrap();
        mask.save(folder.path().join("masks").join(name).with_extension("png")).unwrap();
    }
    let load = LoadOptions { downscale: Downscale::MaxSide(64), masks: true, ..LoadOptions::default() };
    let mut capture = capture::open(folder.path(), &load).unwrap();
    let points = capture.positions();
    let (cameras, all) = (capture.cameras(), Vec::from_iter(0..capture.views.len()));
    let photo_of = |view: &View| capture::decode(view).map(|photo| Some(Arc::new(photo)));
    let seen = |capture: &Capture| seen_points::point_views(capture, &cameras, &all, photo_of).unwrap();
    // The demo has no tracks; masks hide the same points whether visibility is given or guessed.
    let guessed = seen(&capture);
    capture.views.iter_mut().for_each(|view| view.sees = geometry::visible_points(&view.camera, &points));
    let views = seen(&capture);
    assert!(guessed.iter().zip(&views).all(|(guess, view)| guess.guessed && !view.guessed && guess.sees == view.sees));
    assert_eq!(guessed.len(), views.len());
    // A surface from only some of the points would be a guess.
    let few: Vec<usize> = all.iter().copied().filter(|i| judges(*i)).collect();
    let left = seen_points::point_views(&capture, &cameras, &few, photo_of).unwrap();
    assert!(seen_points::are_few_left(&capture, &few, &left) && !seen_points::are_few_left(&capture, &all, &views));
    for view in &views {
        let at = |p: DVec3| view.camera.project(view.camera.to_camera(p));
        let far = view.sees.iter().map(|&p| at(points[p as usize].as_dvec3())).filter(|p| p.x + p.y > 5.0);
        // The discs, enlarged by a pixel.
        assert!(far.map(|p| p.distance(at(middle))).all(|distance| distance < 0.2 * 64.0 + 1.0));
    }
    let [seen, listed] = [
        views.iter().map(|view| view.sees.len()).sum::<usize>(),
        capture.views.iter().map(|view| view.sees.len()).sum(),
    ];
    assert!(views.len() < all.len() && seen > 1000 && 2 * seen < listed, "{} views, {seen} of {listed}", views.len());

    let stop = AtomicBool::new(false);
    let session = Session { gpu: &gpu, checkpoints: Checkpoints::Off, stop: &stop, progress: &mut |_| {} };
    let trained = train(&capture, MeshSource::Points, &TrainOptions { layers: 1, ..options() }, session).unwrap();
    let selection = trained.selection.unwrap();
    assert!(selection.triangles > 500 && selection.unseen as f64 > 0.98 * selection.triangles as f64, "{selection:?}");
    assert_eq!(trained.scene.meshes, []);
}

#[test]
fn exposures_take_out_what_the_camera_changed() {
    let (gpu, folder) = (Gpu::open(None).unwrap(), tempfile::tempdir().unwrap());
    let capture = unevenly_exposed(folder.path());
    let held_out = |exposure: bool| {
        let stop = AtomicBool::new(false);
        // With only 400 iterations, ten per photograph, the gain varies between seeds by as much as its size.
        let options = TrainOptions { exposure, iterations: 1000, sh_degree: 0, ..options() };
        let session = Session { gpu: &gpu, checkpoints: Checkpoints::Off, stop: &stop, progress: &mut |_| {} };
        let trained = train(&capture, MeshSource::None, &options, session).unwrap();
        assert_eq!(trained.exposures.len(), if exposure { 42 } else { 0 });
        (trained.history.last().unwrap().psnr.unwrap(), trained.exposures)
    };
    let ((with, exposures), (without, _)) = (held_out(true), held_out(false));
    eprintln!("held out: {without:.2} dB, with exposures {with:.2} dB");
    assert!(with > without + 0.5, "{with} {without}");
    // The fitted exposures also differ between the brightest and the darkest photograph.
    let red = exposures.iter().map(|(_, e)| e[0]);
    let (low, high) = red.fold((f32::MAX, f32::MIN), |(low, high), e| (low.min(e), high.max(e)));
    assert!(high - low > 0.3, "{low} {high}");
}

/// The demo with training poses rotated by 1.5° and moved by 1.5 % of the extent, each in another direction.
fn unevenly_posed() -> Capture {
    let mut capture = demo();
    let extent = capture::extent(capture.views.iter().map(|v| &v.camera));
    let mut random = Pcg64::seed_from_u64(5);
    for (_, view) in capture.views.iter_mut().enumerate().filter(|(i, _)| i % 8 != 0) {
        let mut direction = || DVec3::from_array([0; 3].map(|_| random.random_range(-1.0..1.0))).normalize();
        let rotation = DMat3::from_axis_angle(direction(), 1.5f64.to_radians()) * view.camera.rotation();
        let center = view.camera.center() + 0.015 * extent * direction();
        view.camera = Camera::new(*view.camera.intrinsics(), rotation, -(rotation * center)).unwrap();
    }
    capture
}

/// Reprojection error of the demo's points, root mean square over all training views, in pixels, relative to the demo's
/// cameras.
fn reprojection_error(cameras: &[Camera]) -> f64 {
    let demo = demo();
    let (mut sum, mut count) = (0.0, 0);
    for (_, (view, camera)) in demo.views.iter().zip(cameras).enumerate().filter(|(i, _)| i % 8 != 0) {
        for point in demo.points.iter().step_by(10) {
            let [seen, found] = [&view.camera, camera].map(|c| c.project(c.to_camera(point.position)));
            sum += seen.distance_squared(found);
            count += 1;
        }
    }
    (sum / f64::from(count)).sqrt()
}

#[test]
fn poses_are_found_again() {
    let (gpu, capture) = (Gpu::open(None).unwrap(), unevenly_posed());
    let held_out = |refine_poses: bool| {
        let stop = AtomicBool::new(false);
        // Poses are wrong by 1.5°.
        let options = TrainOptions { refine_poses, pose_reach: 1.7, iterations: 600, sh_degree: 0, ..options() };
        let session = Session { gpu: &gpu, checkpoints: Checkpoints::Off, stop: &stop, progress: &mut |_| {} };
        let trained = train(&capture, MeshSource::None, &options, session).unwrap();
        assert_eq!(trained.poses.len(), if refine_poses { 42 } else { 0 });
        (trained.history.last().unwrap().psnr.unwrap(), trained)
    };
    let ((with, refined), (without, given)) = (held_out(true), held_out(false));
    let (before, after) = (reprojection_error(&given.cameras), reprojection_error(&refined.cameras));
    eprintln!("held out: {without:.2} dB, refined {with:.2} dB; off by {before:.2} px, then {after:.2} px");
    assert!(with > without + 2.0, "{with} {without}");
    assert!(after < 0.5 * before, "{before} {after}");
    // The reported poses are the changes made to the cameras; held-out cameras are unchanged.
    for (i, (view, camera)) in capture.views.iter().zip(&refined.cameras).enumerate() {
        match refined.poses.iter().find(|(name, _)| *name == view.name) {
            None => assert!(i % 8 == 0 && view.camera == *camera),
            Some((_, pose)) => {
                assert!((pose.distance - camera.center().distance(view.camera.center())).abs() < 1e-12);
                let turn = camera.rotation() * view.camera.rotation().transpose();
                let cosine = 0.5 * (turn.x_axis.x + turn.y_axis.y + turn.z_axis.z - 1.0);
                assert!((pose.degrees.to_radians().cos() - cosine).abs() < 1e-9);
                assert_eq!(pose.world_to_camera[1][3], camera.translation().y);
            }
        }
    }
}

#[test]
fn poses_are_not_refined_beside_a_given_mesh() {
    let (gpu, capture, stop) = (Gpu::open(None).unwrap(), demo(), AtomicBool::new(false));
    let options = TrainOptions { refine_poses: true, ..options() };
    let session = Session { gpu: &gpu, checkpoints: Checkpoints::Off, stop: &stop, progress: &mut |_| {} };
    let error = train(&capture, square(), &options, session).unwrap_err();
    assert!(matches!(error, TrainError::PosesBesideMesh), "{error}");
}
