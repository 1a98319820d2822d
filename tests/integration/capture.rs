//! The readers on real captures (`CENTAUR_DATA`, else `../shared/data`).

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use crate::common::data;
use centaur::capture::{Distortion, Downscale, LoadOptions, PhotoCache, Split, decode, extent, open};
use glam::{DVec2, DVec3};

fn shared(name: &str) -> PathBuf {
    let folder = data(name);
    assert!(folder.is_dir(), "{} is missing", folder.display());
    folder
}

fn masked() -> LoadOptions {
    LoadOptions { masks: true, ..LoadOptions::default() }
}

/// A copy of a model of `oracle_colmap_models`, which has no pictures, with black ones.
fn with_pictures(model: &Path, names: &[&str], size: (u32, u32)) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    for entry in std::fs::read_dir(model).unwrap() {
        let entry = entry.unwrap();
        std::fs::write(folder.path().join(entry.file_name()), std::fs::read(entry.path()).unwrap()).unwrap();
    }
    for name in names {
        let path = folder.path().join("images").join(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        image::GrayImage::new(size.0, size.1).save(path).unwrap();
    }
    folder
}

#[test]
#[ignore = "needs shared data"]
fn binary_and_text_of_one_model_agree() {
    let models = shared("oracle_colmap_models");
    let missing = open(&models.join("colmap_example_model_bin"), &LoadOptions::default()).unwrap_err().to_string();
    assert!(missing.ends_with("_bin: 11 of 11 images missing, the first is images/100_7100.JPG"), "{missing}");

    let names: Vec<String> = (7100..=7110).map(|i| format!("100_{i}.JPG")).collect();
    let names: Vec<&str> = names.iter().map(String::as_str).collect();
    let size = (283, 213);
    let [binary, text] = ["colmap_example_model_bin", "colmap_example_model_txt"].map(|model| {
        let folder = with_pictures(&models.join(model), &names, size);
        open(folder.path(), &LoadOptions::default()).unwrap()
    });
    assert_eq!((binary.points.len(), text.points.len()), (7862, 7862));
    assert_eq!((binary.views.len(), text.views.len()), (11, 11));
    // Text has six significant digits, and points in another order.
    let sum = |points: &[centaur::capture::Point]| points.iter().map(|p| p.position).sum::<DVec3>();
    assert!(sum(&binary.points).distance(sum(&text.points)) < 1e-5 * 7862.0);
    for (a, b) in binary.views.iter().zip(&text.views) {
        assert_eq!(a.name, b.name);
        assert!(a.camera.center().distance(b.camera.center()) < 1e-4);
        assert!((a.camera.rotation().x_axis).distance(b.camera.rotation().x_axis) < 1e-4);
    }

    let sub = ["1/100_7100", "1/100_7101", "1/100_7102", "1/100_7103", "2/100_7106", "2/100_7107", "2/100_7108"];
    let sub: Vec<String> = sub.iter().chain(&["2/100_7109", "2/100_7110"]).map(|n| format!("sub{n}.JPG")).collect();
    let sub: Vec<&str> = sub.iter().map(String::as_str).collect();
    let folder = with_pictures(&models.join("colmap_example_model_txt_missing_cams_and_subfolders"), &sub, size);
    let capture = open(folder.path(), &LoadOptions::default()).unwrap();
    assert_eq!(capture.views.len(), 9);
    // SIMPLE_RADIAL with k = −0.16: the frame is inside the photograph.
    assert!(!decode(&capture.views[0]).unwrap().masked);
}

/// Data that `capture` does not keep: the observations (pixel, point number) per image, and the points by number.
type Observations = (HashMap<String, Vec<(DVec2, u64)>>, HashMap<u64, DVec3>);

fn observations(sparse: &Path) -> Observations {
    fn u64_at(b: &[u8], at: usize) -> u64 {
        u64::from_le_bytes(b[at..at + 8].try_into().unwrap())
    }
    fn f64_at(b: &[u8], at: usize) -> f64 {
        f64::from_bits(u64_at(b, at))
    }
    let (mut images, mut points) = (HashMap::new(), HashMap::new());
    let b = std::fs::read(sparse.join("images.bin")).unwrap();
    let mut at = 8;
    for _ in 0..u64_at(&b, 0) {
        at += 64;
        let end = at + b[at..].iter().position(|&c| c == 0).unwrap();
        let name = String::from_utf8(b[at..end].to_vec()).unwrap();
        let count = u64_at(&b, end + 1) as usize;
        at = end + 9;
        let seen = (0..count)
            .map(|i| at + 24 * i)
            .map(|o| (DVec2::new(f64_at(&b, o), f64_at(&b, o + 8)), u64_at(&b, o + 16)))
            .filter(|&(_, id)| id != u64::MAX);
        images.insert(name, seen.collect());
        at += 24 * count;
    }
    let b = std::fs::read(sparse.join("points3D.bin")).unwrap();
    let mut at = 8;
    for _ in 0..u64_at(&b, 0) {
        points.insert(u64_at(&b, at), DVec3::new(f64_at(&b, at + 8), f64_at(&b, at + 16), f64_at(&b, at + 24)));
        at += 51 + 8 * u64_at(&b, at + 43) as usize;
    }
    (images, points)
}

/// Mean distance in pixels between projected points and their undistorted observations in the pinhole picture, and the
/// number of these.
fn reprojection(folder: &Path) -> (f64, usize) {
    let capture = open(folder, &LoadOptions::default()).unwrap();
    let (images, points) = observations(&folder.join("sparse/0"));
    let errors: Vec<f64> = capture
        .views
        .iter()
        .flat_map(|view| images[&view.name].iter().map(move |seen| (view, seen)))
        .map(|(view, (pixel, id))| {
            let straight = view.source.lens().undistort(*pixel, view.camera.intrinsics());
            let straight = straight.expect("observations lie in the lens's domain");
            view.camera.project(view.camera.to_camera(points[id])).distance(straight)
        })
        .collect();
    (errors.iter().sum::<f64>() / errors.len() as f64, errors.len())
}

#[test]
#[ignore = "needs shared data"]
fn banana16_reprojects_through_the_undistorted_pinhole() {
    let folder = shared("capture_banana16");
    let capture = open(&folder, &LoadOptions::default()).unwrap();
    assert_eq!((capture.name.as_str(), capture.views.len(), capture.points.len()), ("capture_banana16", 15, 7865));
    assert!(matches!(capture.views[0].source.lens().distortion, Distortion::Brown { .. }));
    // COLMAP's own mean error is 0.32 px (SOURCE.md); undistortion changes its scale by a few per cent.
    let (mean, count) = reprojection(&folder);
    assert_eq!(count, 28185);
    assert!((0.28..0.36).contains(&mean), "{mean} px");
    let photo = decode(&capture.views[0]).unwrap();
    assert_eq!((photo.width, photo.height), (1504, 1000));
}

#[test]
#[ignore = "needs shared data"]
fn skull66_opens_without_observations() {
    let folder = shared("capture_skull66");
    let options = LoadOptions { downscale: Downscale::MaxSide(200), ..LoadOptions::default() };
    let capture = open(&folder, &options).unwrap();
    assert_eq!((capture.views.len(), capture.points.len()), (66, 14849));
    let (train, test) = Split::Every8th.split(&capture.views);
    assert_eq!((train.len(), test.len()), (57, 9));
    assert!(extent(capture.views.iter().map(|v| &v.camera)) > 0.0);
    // The layout of COLMAP ≥ 3.12 without an images file is refused with an explanation.
    let upstream = open(&folder.join("upstream_sparse_0"), &options).unwrap_err().to_string();
    assert!(upstream.contains("frames only"), "{upstream}");
    // Six pictures fit into the cache; every result is the same as without it.
    let cache = PhotoCache::new(200 * 133 * 4 * 7);
    for pair in capture.views[..14].windows(2) {
        cache.prefetch([&pair[1]]);
        assert_eq!(*cache.get(&pair[0]).unwrap(), decode(&pair[0]).unwrap());
    }
}

#[test]
#[ignore = "needs shared data"]
fn maryrose69_has_a_mask_per_view() {
    let folder = shared("capture_maryrose69");
    let capture = open(&folder, &masked()).unwrap();
    assert_eq!((capture.views.len(), capture.points.len()), (69, 30866));
    // SOURCE.md: 0.34 px over 181,852 observations; the camera is a pinhole, so the error must be equal.
    let (mean, count) = reprojection(&folder);
    assert_eq!(count, 181_852);
    assert!((mean - 0.34).abs() < 0.006, "{mean} px");
    // Points are on the object: nearly all project into the mask of every view.
    let view = &capture.views[30];
    let photo = decode(view).unwrap();
    assert!(photo.masked && !photo.has_alpha);
    let inside = capture.points.iter().filter(|p| {
        let uv = view.camera.project(view.camera.to_camera(p.position));
        let (x, y) = (uv.x as usize, uv.y as usize);
        x < photo.width as usize
            && y < photo.height as usize
            && photo.rgba[4 * (y * photo.width as usize + x) + 3] > 127
    });
    let share = inside.count() as f64 / capture.points.len() as f64;
    assert!(share > 0.97, "{share}");
}
