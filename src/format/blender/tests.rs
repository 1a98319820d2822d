#![allow(clippy::unwrap_used, reason = "a failed unwrap is a failed test")]

use super::*;
use crate::format::test_scenes::{camera, random_scene};
use crate::scene::Splats;

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
    // Degrees 3 and 0.
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
