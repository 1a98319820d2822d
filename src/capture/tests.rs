//! Captures written by the tests themselves: COLMAP in both encodings, and errors in them.

use std::fmt::Write as _;
use std::path::Path;

use glam::{DMat3, DVec3};
use image::{GrayImage, Luma, Rgb, RgbImage};
use proptest::prelude::*;

use super::transforms_tests::write_transforms;
use super::*;
use crate::scene::Intrinsics;

/// Contents of a `cameras.bin` with one camera.
pub(super) fn cameras_bin(model: i32, width: u64, height: u64, parameters: &[f64]) -> Vec<u8> {
    let mut out = 1u64.to_le_bytes().to_vec();
    out.extend(7u32.to_le_bytes());
    out.extend(model.to_le_bytes());
    out.extend(width.to_le_bytes());
    out.extend(height.to_le_bytes());
    out.extend(parameters.iter().flat_map(|p| p.to_le_bytes()));
    out
}

/// Contents of an `images.bin`: image i is at x = i and looks along z; every second one has an observation.
fn images_bin(names: &[String]) -> Vec<u8> {
    let mut out = (names.len() as u64).to_le_bytes().to_vec();
    for (i, name) in names.iter().enumerate() {
        out.extend((i as u32 + 1).to_le_bytes());
        for v in [1.0, 0.0, 0.0, 0.0, -(i as f64), 0.0, 0.0] {
            out.extend(f64::to_le_bytes(v));
        }
        out.extend(7u32.to_le_bytes());
        out.extend(name.bytes().chain([0]));
        let observations = i as u64 % 2;
        out.extend(observations.to_le_bytes());
        out.extend(vec![0; 24 * observations as usize]);
    }
    out
}

fn points_bin(count: u64) -> Vec<u8> {
    let mut out = count.to_le_bytes().to_vec();
    for i in 0..count {
        out.extend(i.to_le_bytes());
        for v in [i as f64, 2.0, 5.0] {
            out.extend(v.to_le_bytes());
        }
        out.extend([10, 20, 30]);
        out.extend(0.5f64.to_le_bytes());
        out.extend(1u64.to_le_bytes());
        out.extend([0; 8]);
    }
    out
}

/// Writes a binary COLMAP capture of `count` PNG images `00.png`, …, each of a different grey.
pub(super) fn write_capture(root: &Path, count: usize, width: u32, height: u32) {
    let names: Vec<String> = (0..count).map(|i| format!("{i:02}.png")).collect();
    let sparse = root.join("sparse/0");
    std::fs::create_dir_all(&sparse).unwrap();
    std::fs::create_dir_all(root.join("images")).unwrap();
    let (w, h) = (f64::from(width), f64::from(height));
    let cameras = cameras_bin(1, width.into(), height.into(), &[w, w, w / 2.0, h / 2.0]);
    std::fs::write(sparse.join("cameras.bin"), cameras).unwrap();
    std::fs::write(sparse.join("images.bin"), images_bin(&names)).unwrap();
    std::fs::write(sparse.join("points3D.bin"), points_bin(3)).unwrap();
    for (i, name) in names.iter().enumerate() {
        let image = RgbImage::from_fn(width, height, |x, y| Rgb([i as u8 * 10, x as u8, y as u8]));
        image.save(root.join("images").join(name)).unwrap();
    }
}

/// Writes a capture of three images of 20×10 pixels with a text model.
pub(super) fn write_text_capture(root: &Path) {
    write_capture(root, 3, 20, 10);
    let sparse = root.join("sparse/0");
    for stem in ["cameras", "images", "points3D"] {
        std::fs::remove_file(sparse.join(format!("{stem}.bin"))).unwrap();
    }
    std::fs::write(sparse.join("cameras.txt"), "# comment\n7 PINHOLE 20 10 20 20 10 5\n").unwrap();
    let mut images = String::from("# comment\n");
    for i in [2, 0, 1] {
        // Second lines of images: empty, and with one observation.
        write!(images, "{} 1 0 0 0 {} 0 0 7 {i:02}.png\n{}\n", i + 1, -i, ["", "1.5 2.5 -1"][i as usize % 2]).unwrap();
    }
    std::fs::write(sparse.join("images.txt"), images).unwrap();
    let points = "1 0 2 5 10 20 30 0.5 1 0\n2 1 2 5 10 20 30 0.5\n3 2 2 5 10 20 30 0.5\n";
    std::fs::write(sparse.join("points3D.txt"), points).unwrap();
}

/// Message of the error when opening `root`, which must be one line.
pub(super) fn message(root: &Path, options: &LoadOptions) -> String {
    let message = open(root, options).expect_err("must be refused").to_string();
    assert!(!message.contains('\n'), "one line: {message}");
    message
}

pub(super) fn full() -> LoadOptions {
    LoadOptions::default()
}

#[test]
fn binary_and_text_say_the_same() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    write_capture(root, 3, 20, 10);
    let binary = open(root, &full()).unwrap();
    assert_eq!(binary.views.iter().map(|v| &v.name[..]).collect::<Vec<_>>(), ["00.png", "01.png", "02.png"]);
    assert_eq!(binary.points[1], Point { position: DVec3::new(1.0, 2.0, 5.0), rgb: [10, 20, 30] });
    assert_eq!(binary.views[2].camera.center(), DVec3::new(2.0, 0.0, 0.0));
    assert!((extent(binary.views.iter().map(|v| &v.camera)) - 1.1).abs() < 1e-12);

    write_text_capture(root);
    let text = open(root, &full()).unwrap();
    assert_eq!(text.points, binary.points);
    for (a, b) in text.views.iter().zip(&binary.views) {
        assert_eq!((&a.name, a.camera), (&b.name, b.camera));
    }
}

#[test]
fn downscale_and_other_folders_keep_the_field_of_view() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    write_capture(root, 2, 41, 21);
    std::fs::create_dir(root.join("images_2")).unwrap();
    for i in 0..2 {
        RgbImage::new(20, 10).save(root.join(format!("images_2/{i:02}.png"))).unwrap();
    }
    let options = LoadOptions { images: Some("images_2".into()), ..full() };
    // 41/21 and 20/10 differ by 2.4 %, and so do 41/21 and 41/21 rounded to 1/2: refused, with both sizes in the
    // message.
    let refused = message(root, &options);
    assert!(refused.contains("41×21") && refused.contains("20×10"), "{refused}");

    write_capture(root, 2, 40, 20);
    let options = LoadOptions { downscale: Downscale::Factor(3), ..options };
    let view = &open(root, &options).unwrap().views[0];
    let k = view.camera.intrinsics();
    assert_eq!((k.width, k.height), (7, 3));
    assert!((k.fx - 7.0).abs() < 1e-12 && (k.fy - 40.0 * 3.0 / 20.0).abs() < 1e-12, "{k:?}");
    assert_eq!(decode(view).unwrap().rgba.len(), 7 * 3 * 4);
    assert_eq!(Downscale::MaxSide(1600).size(4000, 3000), (1600, 1200));
    assert_eq!(Downscale::MaxSide(1600).size(400, 300), (400, 300));
    assert_eq!(Downscale::Factor(0).size(4, 3), (4, 3));
    // Halves are rounded to even, as in Python.
    assert_eq!(Downscale::Factor(4).size(4946, 14), (1236, 4));
}

#[test]
fn frames_without_a_suffix_have_masks_of_their_own() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    for name in ["v.png", "a.png", "b.JPG.png"] {
        std::fs::write(at(name), []).unwrap();
    }
    let mask = |name: &str| views::find_mask(folder.path(), name);
    assert_eq!([mask("v.000"), mask("v.001")], [None, None]);
    assert_eq!(
        [mask("a.jpg"), mask("images/a.png"), mask("b.JPG")],
        ["a.png", "a.png", "b.JPG.png"].map(|n| Some(at(n)))
    );
}

#[test]
fn every_eighth_view_is_held_out() {
    let folder = tempfile::tempdir().unwrap();
    write_capture(folder.path(), 10, 4, 4);
    let mut views = open(folder.path(), &full()).unwrap().views;
    assert_eq!(Split::Every8th.split(&views), ((1..8).chain([9]).collect(), vec![0, 8]));
    assert_eq!(Split::All.split(&views), ((0..10).collect(), vec![]));
    views.reverse();
    assert_eq!(Split::Every8th.split(&views).1, [1, 9]);
}

#[test]
fn masks_become_alpha() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    write_capture(root, 2, 8, 4);
    let options = LoadOptions { masks: true, ..full() };
    assert!(!decode(&open(root, &options).unwrap().views[0]).unwrap().masked, "no folder, no masks");
    std::fs::create_dir(root.join("masks")).unwrap();
    let mask = GrayImage::from_fn(8, 4, |x, _| Luma([if x < 4 { 255 } else { 0 }]));
    mask.save(root.join("masks/00.png.png")).unwrap();
    assert!(message(root, &options).contains("1 of 2 masks missing, the first is 01.png"));
    mask.save(root.join("masks/01.png")).unwrap();
    for view in &open(root, &options).unwrap().views {
        let photo = decode(view).unwrap();
        assert!(photo.masked && !photo.has_alpha);
        assert_eq!([photo.rgba[3 * 4 + 3], photo.rgba[4 * 4 + 3]], [255, 0]);
    }
    assert!(!decode(&open(root, &full()).unwrap().views[0]).unwrap().masked, "only when asked for");
}

#[test]
fn broken_captures_are_refused_in_one_line() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    let sparse = root.join("sparse/0");
    assert!(message(root, &full()).contains("expected a COLMAP model"));
    assert!(message(&root.join("nowhere"), &full()).contains("nowhere"));

    let refused = |file: &str, bytes: Vec<u8>| {
        write_capture(root, 3, 8, 4);
        std::fs::write(sparse.join(file), bytes).unwrap();
        message(root, &full())
    };
    let names = |n: [&str; 3]| n.map(String::from);
    let same = images_bin(&names(["00.png", "01.png", "00.png"]));
    assert!(refused("images.bin", same).contains("00.png twice"));
    for name in ["../00.png", "/etc/00.png", "", "a/../../b.png"] {
        let escape = refused("images.bin", images_bin(&names([name, "01.png", "02.png"])));
        assert!(escape.contains("inside the capture"), "{escape}");
    }
    let missing = refused("images.bin", images_bin(&names(["00.png", "x.png", "y.png"])));
    assert!(missing.contains("2 of 3 images missing, the first is images/x.png"), "{missing}");
    assert!(refused("images.bin", images_bin(&names(["00.png"; 3])[..1])).contains("at least 2"));
    assert!(refused("images.bin", 0u64.to_le_bytes().to_vec()).contains("at least 2"));
    assert!(refused("images.bin", u64::MAX.to_le_bytes().to_vec()).contains("ends at byte 8"));
    assert!(refused("cameras.bin", 0u64.to_le_bytes().to_vec()).contains("expected at least one camera"));
    let equirectangular = refused("cameras.bin", cameras_bin(17, 8, 4, &[8.0, 4.0]));
    assert!(equirectangular.contains("EQUIRECTANGULAR"), "{equirectangular}");
    assert!(refused("cameras.bin", cameras_bin(99, 8, 4, &[])).contains("99"));
    assert!(refused("cameras.bin", cameras_bin(1, 8, 4, &[-1.0, 8.0, 4.0, 2.0])).contains("focal length"));
    assert!(refused("cameras.bin", cameras_bin(1, 8, 0, &[8.0, 8.0, 4.0, 2.0])).contains("8×0"));
    let opencv = [8.0, 8.0, 4.0, 2.0, f64::NAN, 0.0, 0.0, 0.0];
    assert!(refused("cameras.bin", cameras_bin(4, 8, 4, &opencv)).contains("camera at byte 8: expected finite"));
    let mut nan = images_bin(&names(["00.png", "01.png", "02.png"]));
    nan[12..20].copy_from_slice(&f64::NAN.to_le_bytes());
    assert!(refused("images.bin", nan).contains("quaternion"));
    // The norm of the quaternion overflows to infinity, and dividing by it would give zeros.
    let mut large = images_bin(&names(["00.png", "01.png", "02.png"]));
    large[12..20].copy_from_slice(&1e200_f64.to_le_bytes());
    assert!(refused("images.bin", large).contains("quaternion"));
    let mut nan = points_bin(2);
    nan[16..24].copy_from_slice(&f64::NAN.to_le_bytes());
    assert!(refused("points3D.bin", nan).contains("point at byte 8: expected finite"));

    write_capture(root, 2, 8, 4);
    std::fs::write(sparse.join("points3D.bin"), points_bin(0)).unwrap();
    assert!(open(root, &full()).unwrap().points.is_empty(), "whether points are needed is not for the reader to say");
    std::fs::remove_file(sparse.join("points3D.bin")).unwrap();
    let without = open(root, &full()).unwrap();
    assert!(without.points.is_empty() && without.points_files.is_empty(), "a model need not come with points");
    std::fs::rename(sparse.join("images.bin"), sparse.join("frames.bin")).unwrap();
    assert!(message(root, &full()).contains("frames only"));
}

#[derive(serde::Deserialize)]
struct ModelCase {
    model: String,
    id: i32,
    params: Vec<f64>,
    points: Vec<[f64; 3]>,
    pixels: Vec<[f64; 2]>,
}

/// Values computed by pycolmap: `tests/oracles/check_colmap_models.py`.
#[test]
fn camera_models_project_as_in_colmap() {
    let cases: Vec<ModelCase> = serde_json::from_str(include_str!("../../tests/data/colmap_models.json")).unwrap();
    assert_eq!(cases.len(), 17, "all models but EQUIRECTANGULAR");
    for case in cases {
        assert_eq!(colmap_records::model_of_id(case.id), Some((&case.model[..], case.params.len())));
        let lens = colmap_records::lens(&case.model, &case.params, 640, 480).unwrap();
        let k = lens.intrinsics;
        for (point, pixel) in case.points.iter().zip(case.pixels) {
            let d = lens.distortion.distort(DVec3::from(*point).truncate() / point[2]);
            let found = glam::DVec2::new(k.fx * d.x + k.cx, k.fy * d.y + k.cy);
            // Both sides compute in f64; 1e-9 of a pixel allows for a different order of operations.
            assert!(found.distance(pixel.into()) < 1e-9, "{}: {found} for {pixel:?}", case.model);
            let back = lens.undistort(found, &k).unwrap();
            let pinhole = glam::DVec2::new(k.fx * point[0] / point[2] + k.cx, k.fy * point[1] / point[2] + k.cy);
            assert!(back.distance(pinhole) < 1e-7, "{}: {back} for {pinhole}", case.model);
        }
    }
}

proptest! {
    #[test]
    fn any_bytes_are_read_or_refused(bytes in prop::collection::vec(any::<u8>(), 0..400), count in 0u64..5) {
        let path = Path::new("file");
        // With and without a plausible count in front.
        for bytes in [bytes.clone(), [&count.to_le_bytes()[..], &bytes[..]].concat()] {
            let _ = colmap_binary::cameras(&bytes, path);
            let _ = colmap_binary::images(&bytes, path);
            let _ = colmap_binary::points(&bytes, path);
        }
    }

    #[test]
    fn any_text_is_read_or_refused(text in "([0-9.\\-eNa# \n]|PINHOLE|OPENCV|x.png){0,60}") {
        let path = Path::new("file");
        let _ = colmap_text::cameras(&text, path);
        let _ = colmap_text::images(&text, path);
        let _ = colmap_text::points(&text, path);
        let _ = transforms::parse(&text, path, path, None, (&LoadOptions::default(), true));
    }

    #[test]
    fn a_cut_model_is_refused(at in 0.0..1.0f64, flip in any::<u8>()) {
        let path = Path::new("file");
        let cut = |bytes: &[u8]| bytes[..(at * bytes.len() as f64) as usize].to_vec();
        let names = ["a.png".to_owned(), "b.png".to_owned()];
        let files = [cameras_bin(4, 8, 4, &[1.0; 8]), images_bin(&names), points_bin(3)];
        prop_assert!(colmap_binary::cameras(&cut(&files[0]), path).is_err());
        prop_assert!(colmap_binary::images(&cut(&files[1]), path).is_err());
        prop_assert!(colmap_binary::points(&cut(&files[2]), path).is_err());
        for mut bytes in files {
            let i = (at * bytes.len() as f64) as usize;
            bytes[i] ^= flip;
            let _ = colmap_binary::cameras(&bytes, path);
            let _ = colmap_binary::images(&bytes, path);
            let _ = colmap_binary::points(&bytes, path);
        }
    }
}

/// Otherwise every second image would be skipped.
#[test]
fn images_txt_without_its_empty_lines_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    write_capture(root, 4, 20, 10);
    let sparse = root.join("sparse/0");
    for stem in ["cameras", "images", "points3D"] {
        std::fs::remove_file(sparse.join(format!("{stem}.bin"))).unwrap();
    }
    std::fs::write(sparse.join("cameras.txt"), "7 PINHOLE 20 10 20 20 10 5\n").unwrap();
    std::fs::write(sparse.join("points3D.txt"), "1 0 2 5 10 20 30 0.5\n").unwrap();
    let line = |i: i32| format!("{} 1 0 0 0 {} 0 0 7 {i:02}.png", i + 1, -i);
    let list = |between: &str| (0..4).map(line).collect::<Vec<_>>().join(between);
    std::fs::write(sparse.join("images.txt"), list("\n\n")).unwrap();
    assert_eq!(open(root, &full()).unwrap().views.len(), 4);
    std::fs::write(sparse.join("images.txt"), list("\n1.5 2.5 -1 3 4 17\n")).unwrap();
    assert_eq!(open(root, &full()).unwrap().views.len(), 4);
    std::fs::write(sparse.join("images.txt"), list("\n")).unwrap();
    let message = message(root, &full());
    assert!(message.contains("line 2: expected the 2-D points of the image above, or an empty line"), "{message}");
}

#[test]
fn a_photograph_is_one_view_however_its_path_is_written() {
    let folder = tempfile::tempdir().unwrap();
    write_transforms(folder.path(), 0.0);
    let file = folder.path().join("transforms.json");
    let text = std::fs::read_to_string(&file).unwrap();
    for other in ["./0.png", ".//0.png", "././0.png", r".\\0.png"] {
        std::fs::write(&file, text.replace(r#""1.png""#, &format!("\"{other}\""))).unwrap();
        assert!(message(&file, &full()).contains("0.png twice"), "{}", message(&file, &full()));
    }
}

#[test]
fn fingerprints_are_the_same_on_all_systems() {
    assert_eq!(slashed(br"images\a/b.png", true), b"images/a/b.png");
    assert_eq!(slashed(br"images/a\b.png", false), br"images/a\b.png");
}

/// A copy has the fingerprint of the capture, until a photograph, a mask or the points change.
#[test]
fn fingerprints_are_of_photographs_masks_and_points_too() {
    let print = |change: &dyn Fn(&Path)| {
        let folder = tempfile::tempdir().unwrap();
        write_capture(folder.path(), 3, 20, 10);
        change(folder.path());
        fingerprint(folder.path(), None).unwrap()
    };
    let whole = print(&|_| ());
    assert!(whole.is_some() && whole == print(&|_| ()));
    let black = |width| GrayImage::new(width, 10);
    let changes: [&dyn Fn(&Path); 4] = [
        &|root| black(20).save(root.join("images/01.png")).unwrap(),
        &|root| {
            std::fs::create_dir(root.join("masks")).unwrap();
            black(20).save(root.join("masks/01.png")).unwrap();
        },
        &|root| {
            std::fs::create_dir(root.join("masks")).unwrap();
            black(40).save(root.join("masks/01.png.png")).unwrap();
        },
        &|root| std::fs::write(root.join("sparse/0/points3D.bin"), points_bin(4)).unwrap(),
    ];
    let mut found: Vec<Option<u32>> = changes.iter().map(|change| print(*change)).chain([whole]).collect();
    found.sort_unstable();
    found.dedup();
    assert_eq!(found.len(), 5);
    assert_eq!(fingerprint(tempfile::tempdir().unwrap().path(), None).unwrap(), None);
    // A mask that is named by a frame.
    let print = |side: u32| {
        let folder = tempfile::tempdir().unwrap();
        write_transforms(folder.path(), 0.0);
        std::fs::create_dir(folder.path().join("cut")).unwrap();
        GrayImage::new(side, 8).save(folder.path().join("cut/out.png")).unwrap();
        fingerprint(folder.path(), None).unwrap()
    };
    assert!(print(8) == print(8) && print(8) != print(800));
    // Photographs in another folder, which is the only one trained on.
    let folder = tempfile::tempdir().unwrap();
    write_capture(folder.path(), 3, 20, 10);
    let [images, smaller] = ["images", "images_2"].map(|name| folder.path().join(name));
    std::fs::rename(images, &smaller).unwrap();
    let before = fingerprint(folder.path(), Some("images_2")).unwrap();
    black(40).save(smaller.join("01.png")).unwrap();
    assert!(fingerprint(folder.path(), Some("images_2")).unwrap() != before);
}

#[test]
fn scenes_too_far_away_for_floats_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    write_transforms(root, 1000.0);
    assert!(open(root, &full()).is_ok());
    // Cameras half a metre apart, far from the origin, in a scene of half a metre.
    write_transforms(root, 5e6);
    let far = message(root, &full());
    assert!(far.contains("coordinates of 5000001, where they are 6.0e-1 apart, in a scene of 0.550"), "{far}");
    // With all cameras in one place, the points define the size of the scene.
    write_transforms(root, 0.0);
    let mut views = open(root, &full()).unwrap().views;
    let center = DVec3::new(5e5, 4e6, 0.0);
    for view in &mut views {
        let rotation = view.camera.rotation();
        view.camera = Camera::new(*view.camera.intrinsics(), rotation, -(rotation * center)).unwrap();
    }
    let is_fine = |views: &[View], away: f64| {
        near_origin(views, &[Point { position: center + DVec3::X * away, rgb: [0; 3] }], root).is_ok()
    };
    assert!(near_origin(&views, &[], root).is_ok() && is_fine(&views, 5000.0) && !is_fine(&views, 50.0));
    // So do they if the cameras differ only because files round their positions.
    let beside = views[1].camera;
    let rounded = beside.translation() + DVec3::X * 1e-8 * center.length();
    views[1].camera = Camera::new(*beside.intrinsics(), beside.rotation(), rounded).unwrap();
    assert!(near_origin(&views, &[], root).is_ok() && is_fine(&views, 5000.0) && !is_fine(&views, 50.0));
    // Distant mountains around a table do not make the scene larger.
    let apart = beside.translation() + DVec3::X;
    views[1].camera = Camera::new(*beside.intrinsics(), beside.rotation(), apart).unwrap();
    let mountains: Vec<Point> =
        (0..9).map(|i| Point { position: center + DVec3::Y * (500.0 + f64::from(i)), rgb: [0; 3] }).collect();
    assert!(near_origin(&views, &mountains, root).is_err());
}

/// Camera centres that differ only by rounding.
#[test]
fn cameras_on_a_tripod_have_no_extent() {
    let center = DVec3::new(7.1, -3.3, 2.7);
    let cameras = (0..9).map(|i| {
        let rotation = DMat3::from_rotation_y(0.3 * f64::from(i)) * DMat3::from_rotation_x(0.1 * f64::from(i));
        let intrinsics = Intrinsics { width: 8, height: 8, fx: 8.0, fy: 8.0, cx: 4.0, cy: 4.0 };
        Camera::new(intrinsics, rotation, -(rotation * center)).unwrap()
    });
    let cameras: Vec<Camera> = cameras.collect();
    assert!(cameras.iter().any(|camera| camera.center() != cameras[0].center()));
    assert_eq!(extent(&cameras), 0.0);
}
