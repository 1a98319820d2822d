#![allow(clippy::unwrap_used, reason = "a failed unwrap is a failed test")]

use glam::{DMat3, DVec3};

use super::*;
use crate::format::cameras::CameraFile;
use crate::format::test_scenes::{camera, random_scene};
use crate::format::{ReadOptions, WriteOptions, read_file, write_cameras_with_scene, write_scene};
use crate::scene::{Atlas, Mesh, Splats, Texture};

fn written(scene: &HybridScene, cameras: &[(String, Camera)]) -> (String, WriteReport) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a scene.Blend.py");
    let report = write(&path, scene, cameras, None).unwrap();
    for name in &report.beside {
        assert!(name.starts_with("a_scene_") && folder.path().join(name).is_file(), "{name}");
    }
    (std::fs::read_to_string(path).unwrap(), report)
}

fn told(script: &str) -> Value {
    let (_, rest) = script.split_once("SCENE = json.loads(r'''").unwrap();
    serde_json::from_str(rest.split_once("''')\n").unwrap().0).unwrap()
}

#[test]
fn the_script_is_told_of_every_part() {
    let scene = random_scene(20, 2, 3, 4);
    let cameras = [("it's '''quoted''' \\".to_owned(), camera()), ("side".to_owned(), camera())];
    let (script, report) = written(&scene, &cameras);
    let told = told(&script);
    assert_eq!(told["splats"], "a_scene_splats.ply");
    // Number of maps for degrees 3 and 0.
    let counts: Vec<usize> =
        told["meshes"].as_array().unwrap().iter().map(|m| m["maps"].as_array().unwrap().len()).collect();
    assert_eq!(counts, [16, 1]);
    assert_eq!(report.beside.len(), 1 + 2 + 17);
    assert_eq!(told["cameras"][0]["name"], cameras[0].0);
    let rotation: Vec<f64> = serde_json::from_value(told["cameras"][1]["rotation"].clone()).unwrap();
    let (r, t) = (camera().rotation(), camera().translation());
    assert_eq!(rotation[..3], r.row(0).to_array());
    assert_eq!(told["cameras"][1]["translation"], json!(t.to_array()));
    assert_eq!(told["cameras"][1]["fy"], camera().intrinsics().fy);
    assert_eq!(told["composition"]["colorSpace"], "srgb");
    assert_eq!(told["composition"]["near"], 0.07_f32);
    for part in PARTS {
        assert!(script.contains(part));
    }
}

#[test]
fn parts_that_are_missing_are_told_to_be() {
    let scene = random_scene(20, 2, 1, 4);
    let (script, report) = written(&HybridScene { meshes: vec![], ..scene.clone() }, &[]);
    assert_eq!((&told(&script)["meshes"], &told(&script)["cameras"]), (&json!([]), &json!([])));
    assert!(report.notes.is_empty(), "{:?}", report.notes);
    let (script, report) = written(&HybridScene { splats: Splats::empty(0), ..scene.clone() }, &[]);
    assert_eq!(told(&script)["splats"], Value::Null);
    assert_eq!(report.notes.len(), 1, "{:?}", report.notes);
    assert!(written(&scene, &[]).1.notes[0].contains("not `surfaceConsistent`"));
}

#[test]
fn opaque_surfaces_look_alike_however_many_are_shown() {
    let mut scene = random_scene(0, 2, 0, 4);
    for logit in [6.2, 6.1] {
        let opaque = |mesh: &Mesh| {
            let base = mesh.atlas().base();
            let texels = base.texels().iter().enumerate().map(|(i, v)| if i % 4 == 3 { logit } else { *v }).collect();
            let base = Texture::new(base.width(), base.height(), 4, texels).unwrap();
            mesh.clone().with_atlas(Atlas::new(base, mesh.atlas().bands().cloned()).unwrap())
        };
        scene.meshes = scene.meshes.iter().map(opaque).collect();
        let report = written(&scene, &[]).1;
        let is_opaque = logit == 6.2;
        assert_eq!((report.notes.is_empty(), report.loss.is_none()), (is_opaque, is_opaque), "{logit}: {report:?}");
    }
}

#[test]
fn many_splats_are_worth_a_warning() {
    let mut scene = random_scene(1, 0, 0, 4);
    assert!(notes(&scene).is_empty());
    let mut arrays = scene.splats.into_arrays();
    let n = MANY + 1;
    arrays.means = vec![arrays.means[0]; n];
    arrays.rotations = vec![arrays.rotations[0]; n];
    arrays.log_scales = vec![arrays.log_scales[0]; n];
    arrays.opacity_logits = vec![0.0; n];
    arrays.sh = vec![[0.0; 3]; n];
    scene.splats =
        Splats::new(arrays.means, arrays.rotations, arrays.log_scales, arrays.opacity_logits, 0, arrays.sh).unwrap();
    let notes = notes(&scene);
    assert!(notes.len() == 1 && notes[0].starts_with("2000001 splats take Blender about "), "{notes:?}");
}

#[test]
fn what_cannot_be_written_is_an_error() {
    let scene = random_scene(2, 0, 0, 4);
    let error = write(Path::new("/nowhere/a.blend.py"), &scene, &[], None).unwrap_err().to_string();
    assert!(error.starts_with("/nowhere/"), "{error}");
}

/// Writes a scene with one resting and one moving camera to a script. Returns what the script is told of motion, the
/// notes, and the rows of cameras (frames, cameras, 12 numbers), if any. `change` edits the glTF from which the scene
/// is read.
fn keyed(centers: &[DVec3], change: impl Fn(&mut Value)) -> (Value, Vec<String>, Option<Vec<f64>>) {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let front = [("front".to_owned(), camera())];
    write_scene(&at("a.glb"), &random_scene(5, 0, 1, 4), &WriteOptions { cameras: &front, ..WriteOptions::default() })
        .unwrap();
    let at_center = |c: &DVec3| (String::new(), Camera::new(*camera().intrinsics(), DMat3::IDENTITY, -*c).unwrap());
    let cameras = centers.iter().map(at_center).collect();
    let path = CameraFile { cameras, fps: Some(5.0), ..CameraFile::default() };
    write_cameras_with_scene(&at("b.gltf"), &at("a.glb"), &path).unwrap();
    let mut document: Value = serde_json::from_slice(&std::fs::read(at("b.gltf")).unwrap()).unwrap();
    change(&mut document);
    std::fs::write(at("b.gltf"), document.to_string()).unwrap();
    let file = read_file(&at("b.gltf"), &ReadOptions::default()).unwrap();
    let options = WriteOptions { cameras: &file.cameras, source: file.source.as_ref(), ..WriteOptions::default() };
    let report = write_scene(&at("b.blend.py"), &file.scene, &options).unwrap();
    let told = told(&std::fs::read_to_string(at("b.blend.py")).unwrap());
    let mut arrays = zip::ZipArchive::new(std::fs::File::open(at("b_motion.npz")).unwrap()).unwrap();
    let rows = arrays.by_name("cameras.npy").ok().map(|mut member| {
        let mut bytes = vec![];
        std::io::copy(&mut member, &mut bytes).unwrap();
        let start = 10 + usize::from(u16::from_le_bytes([bytes[8], bytes[9]]));
        let shape = format!("'descr': '<f8', 'fortran_order': False, 'shape': ({},2,12,)", centers.len());
        assert!(String::from_utf8_lossy(&bytes[..start]).contains(&shape));
        bytes[start..].as_chunks().0.iter().map(|b| f64::from_le_bytes(*b)).collect()
    });
    (told["motion"].clone(), report.notes, rows)
}

#[test]
fn cameras_that_move_have_keys() {
    let centers = [DVec3::new(1.0, -1.0, -1.0), DVec3::new(1.0, -2.0, -1.0), DVec3::new(3.0, 0.0, -2.0)];
    let (told, notes, rows) = keyed(&centers, |_| {});
    assert_eq!((&told["cameras"], &told["frames"], &told["fps"]), (&json!(true), &json!(3), &json!(5.0)));
    assert!(!notes.iter().any(|note| note.contains("cameras")), "{notes:?}");
    let rows = rows.unwrap();
    for (frame, center) in centers.iter().enumerate() {
        let [still, moving] = [0, 1].map(|i| &rows[(2 * frame + i) * 12..][..12]);
        let rotation = camera().rotation().transpose().to_cols_array();
        let expected = rotation.into_iter().chain(camera().translation().to_array());
        assert!(still.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-12), "{still:?}");
        let expected = DMat3::IDENTITY.to_cols_array().into_iter().chain((-*center).to_array());
        assert!(moving.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-6), "{moving:?}");
    }
}

#[test]
fn a_camera_that_drops_out_leaves_all_still_and_is_noted() {
    // The animated position is also used as a scale, which is uniform in the first frame only.
    let centers = [DVec3::new(1.0, -1.0, -1.0), DVec3::new(1.0, -2.0, -1.0), DVec3::new(3.0, 0.0, -2.0)];
    let (told, notes, rows) = keyed(&centers, |document| {
        let animation = &mut document["animations"][0];
        let mut channel = animation["channels"][0].clone();
        assert_eq!(channel["target"]["path"], "translation");
        channel["target"]["path"] = json!("scale");
        animation["channels"].as_array_mut().unwrap().push(channel);
    });
    assert_eq!((&told["cameras"], &told["frames"], rows), (&json!(false), &json!(3), None));
    assert!(
        notes.last().unwrap().starts_with("cameras are not animated: at 0.2 s there are only 1 of 2, "),
        "{notes:?}"
    );
}

#[test]
fn what_is_refused_leaves_nothing_behind() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    write_scene(&at("a.glb"), &random_scene(5, 0, 1, 4), &WriteOptions::default()).unwrap();
    let cameras = [0.0, 1.0].map(|x| {
        (String::new(), Camera::new(*camera().intrinsics(), DMat3::IDENTITY, DVec3::new(x, 0.0, 0.0)).unwrap())
    });
    // Times of a shot with too many frames.
    let times = vec![0.0, 1e4];
    let path = CameraFile { cameras: cameras.into(), fps: Some(5.0), times, ..CameraFile::default() };
    write_cameras_with_scene(&at("b.glb"), &at("a.glb"), &path).unwrap();
    let file = read_file(&at("b.glb"), &ReadOptions::default()).unwrap();
    let options = WriteOptions { cameras: &file.cameras, source: file.source.as_ref(), ..WriteOptions::default() };
    let error = write_scene(&at("b.blend.py"), &file.scene, &options).unwrap_err().to_string();
    assert!(error.contains("b.blend.py: expected a shot of at most 36000 frames"), "{error}");
    let mut left: Vec<_> = std::fs::read_dir(folder.path()).unwrap().map(|entry| entry.unwrap().file_name()).collect();
    left.sort();
    assert_eq!(left, ["a.glb", "b.glb"]);
}

#[test]
fn motion_has_a_limit() {
    assert!(motion::bounded(36_000, 1864, 7456).is_ok());
    let error = motion::bounded(36_000, 0, 7457).unwrap_err().in_file(Path::new("a.blend.py")).to_string();
    assert!(error.contains("at most 268435456 nodes over time, found 7457 in each of 36000 frames"), "{error}");
    let error = motion::bounded(36_000, 1865, 0).unwrap_err().in_file(Path::new("a.blend.py")).to_string();
    let expected = "a.blend.py: expected bones, weights and cameras of at most 67108864 numbers over time, found 1865 in each of 36000 \
                    frames; a pose at one time has room";
    assert_eq!(error, expected);
}
