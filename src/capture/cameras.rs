//! Posed cameras alone, with or without photographs, for rendering rather than training.

use std::cmp::Ordering;
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};

use rayon::prelude::*;
use serde::Deserialize;
use serde::de::IgnoredAny;

use super::distortion::Distortion;
use super::transforms;
use super::views::{self, Frame};
use super::{CaptureError, Listed, Lists, LoadOptions, colmap, error, lists};
use crate::scene::{Camera, Intrinsics};

/// Named cameras in display order.
#[derive(Clone, Debug)]
pub struct Cameras {
    /// Names and cameras, at least one.
    pub cameras: Vec<(String, Camera)>,
    /// Frames per second, if the cameras are a path that states it.
    pub fps: Option<f64>,
    /// Whether their world is y up, as in glTF and USD, which a `transforms*.json` written by Centaur can state;
    /// otherwise it is the frame of a capture.
    pub y_up: bool,
    /// Their photographs, as far as the capture names any; the files need not exist.
    pub images: Vec<PathBuf>,
    /// Folder below which the photographs lie by the names of the cameras, with or without their suffix; `None` if one
    /// is missing or lies elsewhere, or if its lens is not that of the camera, a pinhole.
    pub images_folder: Option<PathBuf>,
    /// As [`super::Capture::passed_over`].
    pub passed_over: Vec<PathBuf>,
    /// Width and height of a picture that a `transforms*.json` states, and those of the photograph, which its camera has
    /// here instead, before downscaling: of the first camera where they differ. `None` with [`LoadOptions::images`],
    /// which asks for photographs of another size.
    pub other_size: Option<[(u32, u32); 2]>,
}

/// File `camera_path.json` of nerfstudio's viewer.
#[derive(Deserialize)]
struct CameraPath {
    camera_type: Option<String>,
    render_width: f64,
    render_height: f64,
    fps: Option<f64>,
    camera_path: Vec<Key>,
}

/// A frame of the path.
#[derive(Deserialize)]
struct Key {
    /// Camera→world matrix by rows, OpenGL axes.
    camera_to_world: Vec<f64>,
    /// Vertical field of view, degrees. The aspect given beside it is that of the image.
    fov: f64,
}

#[derive(Deserialize)]
struct Probe {
    camera_path: Option<IgnoredAny>,
}

/// Reads the cameras of a capture as found by [`super::open`], of a `transforms*.json` or of nerfstudio's
/// `camera_path.json`, whose poses are in the world that nerfstudio trained in.
///
/// Photographs need not exist if the files state the size of the image. If they do exist, cameras are those of
/// [`super::open`]. Cameras are sorted by name, numbers in names by their value; those of a `camera_path.json` are in
/// its order.
///
/// # Errors
/// If a file is missing or malformed, a camera model cannot be undistorted, a pose is no rigid motion, the size of an
/// image is not known, or there is no camera.
pub fn cameras(path: &Path, options: &LoadOptions) -> Result<Cameras, CaptureError> {
    let is_folder = std::fs::metadata(path).map_err(|source| CaptureError::Io { path: path.into(), source })?.is_dir();
    let root = if is_folder { path } else { super::folder_of(path) };
    if let Some(images) = &options.images {
        views::inside(path, "--images", images)?;
    }
    let (lists, passed_over) = lists(path, root)?;
    let (mut frames, fps, y_up, list) = match lists {
        Lists::Colmap(model) => {
            let Listed { frames, list, .. } = colmap::load(root, &model, (options, false))?;
            (frames, None, false, list)
        }
        Lists::Transforms(files) => {
            let (mut frames, mut fps, mut y_up) = (vec![], None, None);
            for (file, held_out) in &files {
                let text = error::read_text(file)?;
                if serde_json::from_str::<Probe>(&text).is_ok_and(|probe| probe.camera_path.is_some()) {
                    return camera_path(&text, file, options);
                }
                let read = transforms::parse(&text, file, root, *held_out, (options, false))?;
                if let (Some(found), None) = (read.fps, fps) {
                    fps = Some(rate(found, file)?);
                }
                // All cameras are converted to the frame of the first file.
                let turns = *y_up.get_or_insert(read.y_up) != read.y_up;
                frames.extend(read.frames.into_iter().map(|frame| if turns { frame.turned() } else { frame }));
            }
            let list = files.into_iter().next().map_or_else(PathBuf::new, |(file, _)| file);
            (frames, fps, y_up.unwrap_or_default(), list)
        }
    };
    for (i, frame) in frames.iter_mut().enumerate().filter(|(_, frame)| frame.name.is_empty()) {
        frame.name = format!("frame_{i:05}");
    }
    let images = frames.iter().map(|frame| frame.image.clone()).collect();
    let images_folder = images_folder(&frames);
    let mut found = frames.into_par_iter().map(|frame| camera(frame, options)).collect::<Result<Vec<_>, _>>()?;
    found.sort_by(|a, b| natural(&a.0, &b.0));
    let other_size = found.iter().find_map(|(.., other_size)| *other_size);
    let cameras = found.into_iter().map(|(name, camera, _)| (name, camera)).collect();
    at_least_one(Cameras { cameras, fps, y_up, images, images_folder, passed_over, other_size }, &list)
}

/// See [`Cameras::images_folder`].
fn images_folder(frames: &[Frame]) -> Option<PathBuf> {
    let first = frames.first()?;
    let folder = first.image.ancestors().nth(Path::new(&first.name).components().count())?;
    let is_there = |frame: &Frame| {
        let (image, named) = (&frame.image, folder.join(&frame.name));
        let has_suffix = image.parent() == named.parent() && image.file_stem() == named.file_name();
        (*image == named || has_suffix) && image.is_file() && frame.lens.distortion == Distortion::None
    };
    frames.iter().all(is_there).then(|| folder.to_owned())
}

fn at_least_one(found: Cameras, list: &Path) -> Result<Cameras, CaptureError> {
    if found.cameras.is_empty() {
        return Err(CaptureError::invalid(
            list,
            if is_json(list) { "/frames" } else { "byte 0" },
            "at least 1 camera",
            "none",
        ));
    }
    Ok(found)
}

/// Valid frame rates: at others, times would not be keys of an animation, nor the result a film.
pub const FRAME_RATES: RangeInclusive<f64> = 0.001..=1000.0;

/// Frame rate stated by a file, if valid.
fn rate(found: f64, file: &Path) -> Result<f64, CaptureError> {
    if FRAME_RATES.contains(&found) {
        return Ok(found);
    }
    let expected = format!("a number from {} to {}", FRAME_RATES.start(), FRAME_RATES.end());
    Err(CaptureError::invalid(file, "/fps", expected, format!("{found:?}")))
}

fn is_json(path: &Path) -> bool {
    path.extension().is_some_and(|e| e == "json")
}

/// Size of a picture as stated, and that of its photograph.
type Sizes = [(u32, u32); 2];

/// Name and camera of a frame, and sizes if they differ.
fn camera(frame: Frame, options: &LoadOptions) -> Result<(String, Camera, Option<Sizes>), CaptureError> {
    let invalid = |expected: &str, found: &str| CaptureError::invalid(&frame.list, frame.place(), expected, found);
    if frame.image.is_file() {
        let size = |k: &Intrinsics| (k.width, k.height);
        let states = frame.has_size && is_json(&frame.list) && options.images.is_none();
        let stated = states.then(|| size(&frame.lens.intrinsics));
        let view = views::view(frame, options)?;
        let sizes = stated.map(|stated| [stated, size(&view.source.lens.intrinsics)]);
        return Ok((view.name, view.camera, sizes.filter(|[stated, own]| stated != own)));
    }
    if let Some(folder) = &options.images {
        return Err(invalid(&format!("its image in {folder}"), "no such file"));
    }
    if !frame.has_size {
        return Err(invalid("its image, or its size as w and h", "neither"));
    }
    let camera = Camera::new(frame.lens.pinhole(), frame.rotation, frame.translation)
        .map_err(|e| CaptureError::scene(&frame.list, &frame.place(), e))?;
    let place = frame.place();
    let (name, camera) = sized(frame.name, &camera, &frame.list, &place, options)?;
    Ok((name, camera, None))
}

/// The camera at the requested size.
fn sized(
    name: String,
    camera: &Camera,
    list: &Path,
    at: &str,
    options: &LoadOptions,
) -> Result<(String, Camera), CaptureError> {
    let (width, height) = options.downscale.size(camera.intrinsics().width, camera.intrinsics().height);
    if !Intrinsics::is_size(width, height) {
        let expected =
            format!("an image of at most {} pixels, {} a side", Intrinsics::MAX_PIXELS, Intrinsics::MAX_SIDE);
        return Err(CaptureError::invalid(list, at, expected, format!("{width}×{height}")));
    }
    Ok((name, camera.resized(width, height)))
}

fn camera_path(text: &str, path: &Path, options: &LoadOptions) -> Result<Cameras, CaptureError> {
    let file: CameraPath =
        serde_json::from_str(text).map_err(|e| CaptureError::json(path, "a camera_path.json", &e))?;
    if let Some(model) = file.camera_type.filter(|kind| kind != "perspective") {
        return Err(CaptureError::UnsupportedModel { path: path.into(), place: "/camera_type".to_owned(), model });
    }
    let [width, height] = [file.render_width, file.render_height].map(f64::round);
    let camera = |(i, key): (usize, &Key)| {
        let name = format!("frame_{i:05}");
        let rows: Vec<[f64; 4]> = key.camera_to_world.as_chunks::<4>().0.to_vec();
        let (rotation, translation) = transforms::world_to_camera(&rows).ok_or_else(|| {
            let found = format!("{} numbers", key.camera_to_world.len());
            CaptureError::invalid(path, format!("/camera_path/{i}/camera_to_world"), "16 numbers", found)
        })?;
        let f = 0.5 * height / (0.5 * key.fov.to_radians()).tan();
        // A float cast saturates; invalid sizes are refused below.
        let k =
            Intrinsics { width: width as u32, height: height as u32, fx: f, fy: f, cx: 0.5 * width, cy: 0.5 * height };
        let camera = Camera::new(k, rotation, translation)
            .map_err(|e| CaptureError::scene(path, &format!("/camera_path/{i}"), e))?;
        sized(name, &camera, path, &format!("/camera_path/{i}"), options)
    };
    let fps = file.fps.map(|fps| rate(fps, path)).transpose()?;
    let cameras = file.camera_path.iter().enumerate().map(camera).collect::<Result<_, _>>()?;
    let (images, passed_over) = (vec![], vec![]);
    let found = Cameras { cameras, fps, y_up: false, images, images_folder: None, passed_over, other_size: None };
    at_least_one(found, path)
}

/// Natural order of names, in which `frame_2` comes before `frame_10`.
fn natural(a: &str, b: &str) -> Ordering {
    let (mut left, mut right) = (a, b);
    loop {
        let digits = |text: &str| text.find(|c: char| !c.is_ascii_digit()).unwrap_or(text.len());
        let (i, j) = (digits(left), digits(right));
        let order = if i > 0 && j > 0 {
            let [x, y] = [&left[..i], &right[..j]].map(|number| number.trim_start_matches('0'));
            (left, right) = (&left[i..], &right[j..]);
            x.len().cmp(&y.len()).then_with(|| x.cmp(y))
        } else {
            let (mut x, mut y) = (left.chars(), right.chars());
            let heads = (x.next(), y.next());
            (left, right) = (x.as_str(), y.as_str());
            if heads == (None, None) {
                return a.cmp(b);
            }
            heads.0.cmp(&heads.1)
        };
        if order != Ordering::Equal {
            return order;
        }
    }
}

#[cfg(test)]
mod tests {
    use glam::{DMat3, DVec3};

    use super::*;
    use crate::capture::Downscale;

    fn read(json: &str) -> Result<Cameras, CaptureError> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.json");
        std::fs::write(&path, json).unwrap();
        cameras(&path, &LoadOptions { downscale: Downscale::Factor(2), ..LoadOptions::default() })
    }

    #[test]
    fn photographs_are_not_needed_where_sizes_are_stated() {
        let matrix = "[[1, 0, 0, 4], [0, 1, 0, 5], [0, 0, 1, 6], [0, 0, 0, 1]]";
        let frame = |name: &str| format!(r#"{{ "file_path": "{name}", "transform_matrix": {matrix} }}"#);
        let frames = format!("[{}, {}, {}]", frame("../f_10.png"), frame("../f_9.png"), frame("../f_2.png"));
        let lens = r#""w": 40, "h": 20, "fl_x": 30, "fps": 12.5"#;
        let found = read(&format!(r#"{{ {lens}, "frames": {frames} }}"#)).unwrap();
        let names: Vec<&str> = found.cameras.iter().map(|(name, _)| &name[..]).collect();
        assert_eq!((names, found.fps), (vec!["../f_2.png", "../f_9.png", "../f_10.png"], Some(12.5)));
        let camera = found.cameras[0].1;
        let k = Intrinsics { width: 20, height: 10, fx: 15.0, fy: 15.0, cx: 10.0, cy: 5.0 };
        assert_eq!((*camera.intrinsics(), camera.center()), (k, DVec3::new(4.0, 5.0, 6.0)));
        assert_eq!(camera.rotation(), DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0)));

        let error = |json: &str| read(json).unwrap_err().to_string();
        let unsized_ = error(&format!(r#"{{ "fl_x": 30, "frames": {frames} }}"#));
        assert!(unsized_.ends_with("expected its image, or its size as w and h, found neither"), "{unsized_}");
        let large = error(&format!(r#"{{ "fl_x": 1e9, "fl_y": 9, "w": 1e9, "h": 9, "frames": {frames} }}"#));
        assert!(large.contains("a side, found 500000000×4"), "{large}");
        assert!(
            error(&format!(r#"{{ {lens}, "frames": [] }}"#))
                .ends_with("/frames: expected at least 1 camera, found none")
        );
        // With two files, the error names the faulty one.
        let folder = tempfile::tempdir().unwrap();
        let write = |part: &str, frame: &str| {
            let path = folder.path().join(format!("transforms_{part}.json"));
            std::fs::write(path, format!(r#"{{ {lens}, "frames": [{frame}] }}"#)).unwrap();
        };
        write("train", &frame("a.png"));
        for (fault, said) in [
            (frame("b.png").replace("[1, 0, 0, 4]", "[2, 0, 0, 4]"), "/frames/0, image b.png: pose"),
            (frame("b.png").replace("{ ", r#"{ "w": 1e9, "#), "/frames/0, image b.png"),
        ] {
            write("test", &fault);
            let error = cameras(folder.path(), &LoadOptions::default()).unwrap_err().to_string();
            assert!(error.contains(&format!("transforms_test.json: {said}")), "{error}");
        }
        for (fps, found) in [("0", "0.0"), ("1e300", "1e300")] {
            let message = error(&format!(r#"{{ "fps": {fps}, "w": 4, "h": 4, "fl_x": 3, "frames": {frames} }}"#));
            let expected = format!("/fps: expected a number from 0.001 to 1000, found {found}");
            assert!(message.ends_with(&expected), "{message}");
        }
    }

    #[test]
    fn sizes_that_differ_from_those_of_photographs_are_told() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        for image in ["a.png", "b.png", "small/a.png", "small/b.png"] {
            let side = if image.starts_with("small") { 8 } else { 16 };
            std::fs::create_dir_all(at(image).parent().unwrap()).unwrap();
            image::RgbImage::new(2 * side, side).save(at(image)).unwrap();
        }
        let matrix = "[[1, 0, 0, 4], [0, 1, 0, 5], [0, 0, 1, 6], [0, 0, 0, 1]]";
        let frame = |name: &str| format!(r#"{{ "file_path": "{name}", "transform_matrix": {matrix} }}"#);
        let found = |size: &str, images: Option<&str>| {
            let text = format!(r#"{{ {size} "fl_x": 30, "frames": [{}, {}] }}"#, frame("a.png"), frame("b.png"));
            std::fs::write(at("a.json"), text).unwrap();
            let (downscale, images) = (Downscale::Factor(2), images.map(str::to_owned));
            let found = cameras(&at("a.json"), &LoadOptions { downscale, images, ..LoadOptions::default() }).unwrap();
            (found.cameras[0].1.intrinsics().width, found.other_size)
        };
        assert_eq!(found(r#""w": 64, "h": 32,"#, None), (16, Some([(64, 32), (32, 16)])));
        assert_eq!(found(r#""w": 32, "h": 16,"#, None), (16, None));
        assert_eq!(found("", None), (16, None));
        assert_eq!(found(r#""w": 32, "h": 16,"#, Some("small")), (8, None));
    }

    #[test]
    fn camera_paths_of_nerfstudio_are_read() {
        let path = |key: &str| {
            format!(
                r#"{{ "keyframes": [], "camera_type": "perspective", "render_height": 200, "render_width": 400, "fps": 24,
                "seconds": 1, "camera_path": [{{ "camera_to_world": [0,0,1,7, 1,0,0,8, 0,1,0,9, 0,0,0,1], "fov": 90, "aspect": 2 }},
                {key}] }}"#
            )
        };
        let other = r#"{ "camera_to_world": [1,0,0,0, 0,1,0,0, 0,0,1,0, 0,0,0,1], "fov": 60, "aspect": 2 }"#;
        let found = read(&path(other)).unwrap();
        assert_eq!((found.cameras.len(), found.fps), (2, Some(24.0)));
        let (name, camera) = &found.cameras[0];
        assert_eq!((&name[..], camera.center()), ("frame_00000", DVec3::new(7.0, 8.0, 9.0)));
        // The camera looks along its −z, the third column: −x in the world; its y axis (up) is z.
        assert!(camera.rotation().row(2).abs_diff_eq(-DVec3::X, 1e-12));
        assert!(camera.rotation().row(1).abs_diff_eq(-DVec3::Z, 1e-12));
        let k = camera.intrinsics();
        assert!((k.width, k.height, k.cx, k.cy) == (200, 100, 100.0, 50.0) && (k.fx - 50.0).abs() < 1e-9);
        assert!((found.cameras[1].1.intrinsics().fy - 50.0 * 3f64.sqrt()).abs() < 1e-9);

        let error = |text: &str| read(text).unwrap_err().to_string();
        let short = error(&path(r#"{ "camera_to_world": [1, 0], "fov": 60 }"#));
        assert!(short.ends_with("/camera_path/1/camera_to_world: expected 16 numbers, found 2 numbers"), "{short}");
        assert!(error(&path(other).replace("perspective", "fisheye")).contains("camera model fisheye"));
        assert!(error(&path(other).replace("\"fps\": 24", "\"fps\": -1")).contains("fps"));
        assert!(error(r#"{ "camera_path": 3 }"#).contains("expected a camera_path.json"));
    }
}
