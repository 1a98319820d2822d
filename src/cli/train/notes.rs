//! Notes of a training: before it begins, on failure, and at its end.

use std::collections::{BTreeSet, HashSet};
use std::path::{Path, PathBuf};

use anyhow::anyhow;
use centaur::atomic::folder_of;
use centaur::capture::{Capture, Split};
use centaur::optimize::{RefinedPose, Selection, SurfaceOrigin, TrainError, TrainOptions, Trained};
use centaur::render::gpu::{Gpu, memory::most_splats};
use centaur::scene::Camera;
use glam::DVec3;
use image::ImageFormat;

use super::args::{Args, DensityKind};
use super::surface::SurfaceOf;
use crate::cli::{shared, shell};

pub(super) fn in_words(surface: SurfaceOrigin) -> &'static str {
    match surface {
        SurfaceOrigin::Given => "given",
        SurfaceOrigin::Points => "points of the capture",
        SurfaceOrigin::GuessedPoints => "points of the capture, taken as visible where no nearer one hides them",
        SurfaceOrigin::Splats => "fused depth of splats",
    }
}

/// Note on how far poses were refined, if they were.
pub(super) fn moved(trained: &Trained) -> Option<String> {
    let median = |of: fn(&RefinedPose) -> f64| {
        let mut values: Vec<f64> = trained.poses.iter().map(|(_, pose)| of(pose)).collect();
        values.sort_unstable_by(f64::total_cmp);
        values.get(values.len() / 2).copied()
    };
    let (distance, degrees) = (median(|pose| pose.distance)?, median(|pose| pose.degrees)?);
    Some(format!("moved by {distance:.4} (median), {degrees:.2}° (median)"))
}

/// Width to which INRIA 3DGS by default downscales wider photographs (`utils/camera_utils.py`).
const USUAL_WIDTH: u32 = 1600;

/// Notes before the training: defects of a capture are better repaired before training for hours.
pub(super) fn before_training(args: &Args, capture: &Capture, gpu: &Gpu, scores: bool) -> Vec<String> {
    let lacks = [
        (
            capture.points.is_empty() && !args.no_points,
            "has no points: splats begin at random places that its cameras look at",
        ),
        (args.loading.masks && !capture.has_masks(), "has no masks: nothing is masked"),
        (!scores && !args.no_eval && !args.all_views, "holds out no view: nothing will be scored"),
        (
            shows_motion(capture),
            "has photographs of different times, but is trained as if taken at once: moving objects will be blurred",
        ),
    ];
    let said = lacks.into_iter().filter(|(is_so, _)| *is_so);
    let widest = capture.views.iter().map(|view| view.camera.intrinsics()).max_by_key(|k| k.width);
    let large = widest.filter(|k| k.width > USUAL_WIDTH).map(|k| {
        let side = (f64::from(k.longer_side()) * f64::from(USUAL_WIDTH) / f64::from(k.width)).round();
        format!(
            "is trained on photographs {} pixels wide: published results usually use {USUAL_WIDTH} (--max-side {side} or --downscale)",
            k.width
        )
    });
    let finds_surface = args.mesh.is_none() && !args.no_mesh;
    let none_left = finds_surface && args.surface_iterations >= Some(args.iterations);
    let none_left = none_left.then(|| {
        format!(
            "--surface-iterations: leaves none of the {} iterations to train splats and mesh together",
            args.iterations
        )
    });
    let idle = args.idle().into_iter().map(|(beside, flags)| {
        format!("{beside}: {} {} no effect", flags.join(", "), if flags.len() == 1 { "has" } else { "have" })
    });
    let of_capture = said.map(|(_, what)| what.to_owned());
    let of_capture = of_capture
        .chain(out_of_sight(capture, args.split()))
        .chain(shared::passed_over(&capture.passed_over))
        .chain(not_listed(args, capture))
        .chain(large)
        .chain(lies(args, capture));
    let most = most_splats(gpu, args.sh_degree);
    // Few runs come to what nobody has asked for: those are told at the end.
    let asks = args.max_splats.is_some_and(|asked| asked > most);
    let too_many = asks.then(|| {
        format!(
            "{}: can bind at most {most} splats of degree {}, which limits --max-splats",
            gpu.adapter(),
            args.sh_degree
        )
    });
    of_capture
        .map(|what| format!("{}: {what}", args.capture.display()))
        .chain(args.loading.idle_masks(&args.capture))
        .chain(too_many)
        .chain(none_left)
        .chain(idle)
        .collect()
}

/// Most points and views that are looked at for [`out_of_sight`].
const MOST_POINTS: usize = 4000;
const MOST_VIEWS: usize = 100;

/// Note if fewer than 1 % of the points are in any training view: structure from motion finds points in photographs,
/// and scans have some in them.
fn out_of_sight(capture: &Capture, split: Split) -> Option<String> {
    let (train, _) = split.split(&capture.views);
    let step = |count: usize, most: usize| count.div_ceil(most).max(1);
    let views = train.iter().step_by(step(train.len(), MOST_VIEWS));
    let cameras: Vec<&Camera> = views.map(|&view| &capture.views[view].camera).collect();
    let is_seen = |p: DVec3| cameras.iter().any(|camera| camera.in_picture(camera.to_camera(p)).is_some());
    let (mut all, mut seen) = (0, 0);
    for point in capture.points.iter().step_by(step(capture.points.len(), MOST_POINTS)) {
        all += 1;
        seen += usize::from(is_seen(point.position));
    }
    let few = if seen == 0 { "none" } else { "fewer than 1 %" };
    (100 * seen < all).then(|| {
        let count = capture.points.len();
        format!("has {count} points, {few} of them in a training view: are they in the frame and unit of the poses?")
    })
}

/// Up directions, other than −y, of a capture's world, each with the right-handed frame of that up direction, as named
/// by `centaur convert --axes`.
const UPS: [(&str, DVec3, &str); 5] = [
    ("+z", DVec3::Z, "z-up"),
    ("+y", DVec3::Y, "y-up"),
    ("−z", DVec3::NEG_Z, "RBD"),
    ("+x", DVec3::X, "UBR"),
    ("−x", DVec3::NEG_X, "DRB"),
];
/// Cosine of the largest angle with −y that still counts as upright.
const UPRIGHT: f64 = 0.5;
/// Least length of the mean of the views' up vectors for a common up direction: views rotated in all ways have none.
const IN_COMMON: f64 = 0.3;

/// Element of [`UPS`] nearest to the up direction of these cameras; none if that is approximately −y, which half a turn
/// about x makes the +y of glTF.
fn up_of(cameras: &[Camera]) -> Option<(&'static str, &'static str)> {
    let sum: DVec3 = cameras.iter().map(|camera| -camera.rotation().row(1)).sum();
    let up = sum / cameras.len().max(1) as f64;
    if up.length() < IN_COMMON || up.normalize().dot(DVec3::NEG_Y) >= UPRIGHT {
        return None;
    }
    let nearest = UPS.iter().max_by(|a, b| up.dot(a.1).total_cmp(&up.dot(b.1)))?;
    Some((nearest.0, nearest.2))
}

/// Note if the capture's up direction differs from COLMAP's for upright photographs, as in many `transforms.json`: the
/// scene keeps that world.
fn lies(args: &Args, capture: &Capture) -> Option<String> {
    up_of(&capture.cameras()).map(|up| lying(&args.output, up))
}

/// [`lies`], with an element of [`UPS`]. The command is at the end, where it can be copied.
fn lying(scene: &Path, (axis, frame): (&str, &str)) -> String {
    let how = if axis == "+y" { "upside down" } else { "lying on its side" };
    let scene = shell::argument(scene);
    format!(
        "was taken with {axis} up: glTF viewers, which have +y up, will show the scene {how}; to set it upright: \
         centaur convert {scene} OUT.glb --axes {frame}:y-down"
    )
}

/// Note on the number of photographs beside the capture's own that it does not list: structure from motion may have
/// found a part of the poses, or several models.
fn not_listed(args: &Args, capture: &Capture) -> Option<String> {
    // Other folders may contain depths and normals, as in NeRF-synthetic.
    let folder = if args.capture.is_dir() { &args.capture } else { folder_of(&args.capture) };
    let root = folder.join(args.loading.pictures.images.as_deref().unwrap_or("images"));
    let listed: HashSet<&Path> = capture.views.iter().map(|view| view.source.path()).collect();
    let folders: BTreeSet<&Path> = listed.iter().filter_map(|image| image.parent()).collect();
    let entries = folders.iter().filter(|folder| folder.starts_with(&root)).filter_map(|folder| folder.read_dir().ok());
    let files = entries.flatten().flatten().map(|entry| entry.path());
    let (own, others): (Vec<PathBuf>, Vec<PathBuf>) = files
        .filter(|file| ImageFormat::from_path(file).is_ok() && file.is_file())
        .partition(|file| listed.contains(file.as_path()));
    let (own, all) = (own.len(), own.len() + others.len());
    (own < all).then(|| format!("lists {own} of the {all} photographs: the others are left out"))
}

/// Whether the views state different times.
fn shows_motion(capture: &Capture) -> bool {
    let mut times = capture.views.iter().map(|view| view.source.time());
    let first = times.next().flatten();
    times.any(|time| time != first)
}

/// Note if the number of splats was limited: by the adapter's bindings, or in density control by gradients, which has
/// no target number.
pub(super) fn capped(args: &Args, trained: &Trained, gpu: &Gpu) -> Option<String> {
    let grown = trained.scene.splats.len() + trained.occluded_splats;
    if grown >= most_splats(gpu, args.sh_degree) {
        return Some(format!(
            "{grown} splats are the most that {} can bind: another adapter might allow more",
            gpu.adapter()
        ));
    }
    let most = args.max_splats.unwrap_or(TrainOptions::MOST_SPLATS);
    let is_held_back = !matches!(args.density, DensityKind::Mcmc) && grown >= most;
    is_held_back.then(|| format!("the limit of {most} splats was reached: a larger --max-splats would allow more"))
}

fn why_no_mesh(trained: &Trained) -> String {
    match &trained.selection {
        _ if trained.faint_triangles > 0 => "its triangles became invisible in training".to_owned(),
        None => match &trained.no_surface {
            Some(why) => why.clone(),
            None => "no surface was found, or had room in the budget".to_owned(),
        },
        Some(s) if s.kept() > 0 => format!("the {} triangles that were kept had no room in the budget", s.kept()),
        Some(Selection { triangles, unseen, worse, small }) => format!(
            "of {triangles} triangles, {unseen} were seen by too few training views, {worse} had larger errors than the splats, and {small} \
             were in pieces that are too small"
        ),
    }
}

/// Note if a surface, or one of points, was requested and less was made.
pub(super) fn at_the_end(args: &Args, trained: &Trained) -> Option<String> {
    let no_mesh;
    let note = match (args.surface, trained.surface) {
        (_, None) if !args.no_mesh => {
            no_mesh = format!("the scene has no mesh: {}", why_no_mesh(trained));
            &no_mesh
        }
        (Some(SurfaceOf::Points), Some(SurfaceOrigin::GuessedPoints)) => {
            "does not list the visible points of half of its views or more: for the surface, points that no nearer one hides were taken as visible"
        }
        (Some(SurfaceOf::Points), Some(SurfaceOrigin::Splats)) => {
            "no surface could be made of its points: it was fused from the depth of the splats"
        }
        _ => return None,
    };
    Some(format!("{}: {note}", args.capture.display()))
}

/// Error with advice on which option of this command avoids it, or on the checkpoint of a run that `has_saved` one.
pub(super) fn with_advice(error: TrainError, args: &Args, has_saved: bool) -> anyhow::Error {
    match (&error, &args.mesh) {
        (TrainError::Gpu(e), _) if e.is_lack_of_memory() => {
            anyhow!("{error}; see --max-splats, --texture-size and --downscale")
        }
        (TrainError::Geometry(_), Some(mesh)) => {
            anyhow!("{}: {error}; see --texture-size, and centaur mesh --mesh, which simplifies", mesh.display())
        }
        (TrainError::UnseenMesh, Some(mesh)) => anyhow!("{}: {error}", mesh.display()),
        (TrainError::Geometry(_), None) => {
            let capture = args.capture.display();
            anyhow!("{capture}: {error}; --no-mesh trains splats alone, --mesh FILE takes yours")
        }
        (TrainError::TooFewViews { .. }, _) if !args.all_views => {
            anyhow!("{error}; --all-views holds none out")
        }
        (TrainError::NotFinite { .. }, _) if has_saved => anyhow!("{error}; the last checkpoint was saved before this"),
        _ => error.into(),
    }
}

#[cfg(test)]
mod tests {
    use centaur::capture::{self, LoadOptions};
    use centaur::edit::Axes;
    use centaur::render::gpu::GpuError;
    use centaur::scene::{Intrinsics, frame::OPENGL_FROM_OPENCV};
    use clap::Parser as _;
    use glam::DMat3;

    use super::*;
    use crate::cli::{Cli, Command};

    /// Cameras around an axis, each looking down along it at 45°.
    fn around(up: DVec3) -> Vec<Camera> {
        let (x, y) = up.any_orthonormal_pair();
        let intrinsics = Intrinsics { width: 8, height: 6, fx: 8.0, fy: 8.0, cx: 4.0, cy: 3.0 };
        let camera = |i: u32| {
            let (sin, cos) = (0.7 * f64::from(i)).sin_cos();
            let ahead = (sin * x + cos * y - up).normalize();
            let right = ahead.cross(up).normalize();
            let rotation = DMat3::from_cols(right, ahead.cross(right), ahead).transpose();
            Camera::new(intrinsics, rotation, DVec3::new(0.0, 0.0, 3.0)).unwrap()
        };
        (0..9).map(camera).collect()
    }

    #[test]
    fn worlds_that_are_not_y_down_are_turned_upright() {
        let y_down: Axes = "y-down".parse().unwrap();
        for (axis, up, frame) in UPS {
            // Also if the axis deviates a little.
            for up in [up, (up + 0.4 * DVec3::new(0.5, -0.3, -0.6)).normalize()] {
                assert_eq!(up_of(&around(up)), Some((axis, frame)), "{up}");
            }
            let turn = frame.parse::<Axes>().unwrap().to(y_down);
            assert_eq!((OPENGL_FROM_OPENCV * (turn * up), turn.determinant()), (DVec3::Y, 1.0), "{axis}");
        }
        let leaning = 50_f64.to_radians();
        for up in [DVec3::NEG_Y, DVec3::new(0.0, -leaning.cos(), leaning.sin())] {
            assert_eq!(up_of(&around(up)), None, "{up}");
        }
        // Half of the views is upside down.
        let turned = [around(DVec3::Z), around(DVec3::NEG_Z)].concat();
        assert_eq!((up_of(&turned), up_of(&[])), (None, None));
    }

    #[test]
    fn points_that_no_view_sees_are_told() {
        let demo = Path::new(env!("CARGO_MANIFEST_DIR")).join("demo");
        let mut capture = capture::open(&demo, &LoadOptions::default()).unwrap();
        let said = |capture: &Capture| out_of_sight(capture, Split::Every8th);
        assert_eq!(said(&capture), None);
        // Above the cameras, which look down, is nothing; some points may be there, as of a scan of a whole building.
        let whole = capture.points.clone();
        for (left, few) in [(whole.len() / 20, None), (10, Some("fewer than 1 %")), (0, Some("none"))] {
            capture.points.clone_from(&whole);
            capture.points.iter_mut().skip(left).for_each(|point| point.position.z += 1e4);
            let count = whole.len();
            let start = few.map(|few| format!("has {count} points, {few} of them in a training view: "));
            let note = said(&capture);
            let is_so = start.as_ref().is_none_or(|start| note.as_ref().is_some_and(|note| note.starts_with(start)));
            assert!(is_so && note.is_some() == start.is_some(), "{left}: {note:?}");
        }
        capture.points.clear();
        assert_eq!(said(&capture), None);
    }

    #[test]
    fn the_command_that_turns_a_scene_upright_can_be_pasted() {
        let quoted = if cfg!(windows) { "\"my scene.glb\"" } else { "'my scene.glb'" };
        let note = lying(Path::new("my scene.glb"), ("+z", "z-up"));
        let command = format!("; to set it upright: centaur convert {quoted} OUT.glb --axes z-up:y-down");
        assert!(note.contains("lying on its side") && note.ends_with(&command), "{note}");
    }

    /// The refusal itself is tested elsewhere, for any adapter.
    #[test]
    fn what_is_too_large_for_the_adapter_comes_with_the_flags_that_make_it_smaller() {
        let words = ["centaur", "train", "capture", "-o", "scene.glb"];
        let Command::Train(args) = Cli::try_parse_from(words).unwrap().command else { unreachable!() };
        let (what, adapter) = ("the map of colour and opacity".to_owned(), "llvmpipe".to_owned());
        let error = TrainError::Gpu(GpuError::TooLarge { what, needed: 1344, limit: 128, adapter });
        let said = with_advice(error, &args, false).to_string();
        assert!(said.contains(" needs a buffer of 1344 MiB, but llvmpipe binds at most 128 MiB: "), "{said}");
        assert!(said.ends_with("; see --max-splats, --texture-size and --downscale"), "{said}");
    }
}
