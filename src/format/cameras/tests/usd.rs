//! Animated cameras of USD, as text and in binary.

use std::path::Path;

use glam::DVec3;

use super::read;
use crate::format::cameras::Sampling;
use crate::format::read_cameras;

#[test]
fn time_samples_of_usd_are_followed_through_ancestors() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.usda");
    let layer = r#"#usda 1.0
(
    metersPerUnit = 0.01
    timeCodesPerSecond = 10
    upAxis = "Z"
)
def Xform "rig" {
    float xformOp:rotateZ.timeSamples = { 25: 90, 5: 0, }
    uniform token[] xformOpOrder = ["xformOp:rotateZ"]
    def Camera "shot" {
        float focalLength = 1
        float focalLength.timeSamples = { 5: 50, 25: 100 }
        double3 xformOp:translate = (300, 0, 0)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }
}
def Camera "resting" { }
"#;
    std::fs::write(&path, layer).unwrap();
    for (fps, frames) in [(None, 21), (Some(5.0), 11), (Some(20.0), 41)] {
        let found = read_cameras(&path, &Sampling { fps, ..Sampling::default() }).unwrap();
        assert_eq!((found.cameras.len(), found.fps, found.y_up), (frames, fps.or(Some(10.0)), true));
        for (i, (_, camera)) in found.cameras.iter().enumerate() {
            let part = i as f64 / (frames - 1) as f64;
            let (sin, cos) = (std::f64::consts::FRAC_PI_2 * part).sin_cos();
            // z up to y up: (x, y, z) → (x, z, −y).
            assert!(
                camera.center().abs_diff_eq(DVec3::new(3.0 * cos, 0.0, -3.0 * sin), 1e-9),
                "{i}: {}",
                camera.center()
            );
            let expected = (50.0 + 50.0 * part) / 15.2908 * 1080.0;
            assert!((camera.intrinsics().fy / expected - 1.0).abs() < 1e-6, "{i}");
        }
    }
    // Matrices are not interpolated component-wise, which would shrink the camera's axes.
    let matrices = layer.replace("float xformOp:rotateZ.timeSamples = { 25: 90, 5: 0, }", "matrix4d xformOp:transform.timeSamples = {
        5: ((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1)), 25: ((0, 1, 0, 0), (-1, 0, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1)) }")
        .replace("\"xformOp:rotateZ\"", "\"xformOp:transform\"");
    std::fs::write(&path, matrices).unwrap();
    let found = read(&path);
    let diagonal = 3.0 * 0.5_f64.sqrt();
    assert!(found.cameras[10].1.center().abs_diff_eq(DVec3::new(diagonal, 0.0, -diagonal), 1e-9));
    std::fs::write(&path, layer.replace("25: 90", "1e12: 90")).unwrap();
    let error = read_cameras(&path, &Sampling::default()).unwrap_err().to_string();
    assert!(error.contains("expected a shot of at most 36000 frames"), "{error}");

    // The limit applies to the frames of all selected cameras of a file together.
    let rig = layer.replace("25: 90", "25000: 90");
    let two = rig.replace("def Xform \"rig\" {", "def Xform \"rig\" {\n    def Camera \"other\" { }");
    std::fs::write(&path, two).unwrap();
    let error = read_cameras(&path, &Sampling::default()).unwrap_err().to_string();
    assert!(
        error.contains("/rig/shot: expected a shot of at most 36000 frames") && error.contains("after 24996"),
        "{error}"
    );
    let found = read_cameras(&path, &Sampling { only: &["shot".to_owned()], ..Sampling::default() }).unwrap();
    assert_eq!(found.cameras.len(), 24996);
    // The number of transform steps is limited too: every frame applies those of all ancestors.
    let order = ["\"xformOp:rotateZ\""; 1000].join(", ");
    let level = |content: &str| {
        format!(
            "def Xform \"a\" {{ float xformOp:rotateZ.timeSamples = {{ 0: 0, 30000: 90 }}\n uniform token[] xformOpOrder = [{order}]\n {content} }}\n"
        )
    };
    std::fs::write(&path, format!("#usda 1.0\n{}", level(&level("def Camera \"shot\" { }")))).unwrap();
    let error = read_cameras(&path, &Sampling { fps: Some(24.0), ..Sampling::default() }).unwrap_err().to_string();
    assert!(error.contains("/a/a/shot: expected at most 50000000 steps of transforms"), "{error}");
    let longer = layer.replace("\"xformOp:rotateZ\"", &format!("{order}, {order}"));
    std::fs::write(&path, longer).unwrap();
    let error = read_cameras(&path, &Sampling::default()).unwrap_err().to_string();
    assert!(error.contains("/rig.xformOpOrder: expected at most 1000 operations, found 2000"), "{error}");
    // If no camera is found, the error names those left out, whatever other notes there are.
    let sheared = layer
        .replace("float xformOp:rotateZ", "float3 xformOp:scale = (1, 2, 3)\n    float xformOp:rotateZ")
        .replace("[\"xformOp:rotateZ\"]", "[\"xformOp:rotateZ\", \"xformOp:scale\"]")
        .replace("def Camera \"resting\" { }", "");
    std::fs::write(&path, sheared.replace("metersPerUnit = 0.01", "")).unwrap();
    let error = read_cameras(&path, &Sampling::default()).unwrap_err();
    let said = "expected a camera, found /rig/shot: camera left out: its transform has shear";
    assert!(error.to_string().contains(said) && !error.is_lack_of_cameras(), "{error}");
}

#[test]
fn usd_in_binary_moves_as_its_text() {
    let at = |name: &str| Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/usd").join(name);
    let (text, binary) = (read(&at("moving.usda")), read(&at("moving.usdc")));
    assert_eq!((binary.fps, &binary.cameras), (Some(24.0), &text.cameras));
    let x: Vec<f64> = binary.cameras.iter().map(|(_, camera)| camera.center().x).collect();
    assert_eq!(x, [0.0, 1.0, 2.0, 3.0, 4.0]);
}
