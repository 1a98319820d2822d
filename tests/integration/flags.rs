//! Effects of flags of `centaur cameras` and `centaur mesh`.

use std::fmt::Write as _;
use std::path::Path;

use crate::common::{centaur, stderr, write_capture};
use glam::DVec3;
use serde_json::{Value, json};

fn run(folder: &Path, command: &str) -> Vec<u8> {
    let output = centaur(folder).args(command.split(' ')).output().unwrap();
    assert_eq!(output.status.code(), Some(0), "{command}: {}", stderr(&output));
    output.stdout
}

/// Camera centres of a path that a command writes to `path.json`.
fn centers(folder: &Path, command: &str) -> Vec<DVec3> {
    run(folder, command);
    let path: Value = serde_json::from_slice(&std::fs::read(folder.join("path.json")).unwrap()).unwrap();
    let center =
        |frame: &Value| DVec3::from([0, 1, 2].map(|row: usize| frame["transform_matrix"][row][3].as_f64().unwrap()));
    path["frames"].as_array().unwrap().iter().map(center).collect()
}

/// The capture's cameras are on a level circle of radius 1.5 around the origin.
#[test]
fn orbits_are_as_high_and_as_wide_as_they_are_asked_to_be() {
    let folder = tempfile::tempdir().unwrap();
    write_capture(&folder.path().join("capture"), 9, (32, 24));
    for (flags, radius, height) in [
        ("", 1.5, 0.0),
        (" --height 0.5", 1.5, 0.5),
        (" --height 0.5 --height-scale 3", 1.5, 1.5),
        (" --height 0.5 --height-scale -1", 1.5, -0.5),
        (" --radius-scale 2", 3.0, 0.0),
        (" --radius 1 --radius-scale 0.25", 0.25, 0.0),
    ] {
        let orbit = format!("cameras orbit capture -o path.json --frames 6 --size 16x12{flags}");
        for center in centers(folder.path(), &orbit) {
            // The world is y down.
            let off = [center.x.hypot(center.z) - radius, center.y + height];
            assert!(off.iter().all(|off| off.abs() < 1e-6), "{orbit}: {center}");
        }
    }
}

/// In a closed path the last frame is as far from the first as consecutive frames are; an open one ends at the last
/// camera.
#[test]
fn splines_are_closed_if_they_are_asked_to_be() {
    let folder = tempfile::tempdir().unwrap();
    write_capture(&folder.path().join("capture"), 9, (32, 24));
    for (flags, gap) in [("", 1.36), (" --closed", 1.0)] {
        let spline = format!("cameras spline capture -o path.json --frames 12 --size 16x12{flags}");
        let centers = centers(folder.path(), &spline);
        let found = centers[11].distance(centers[0]) / centers[0].distance(centers[1]);
        assert!((found - gap).abs() < 0.05, "{spline}: {found}");
    }
}

#[test]
fn what_is_mended_of_a_mesh_and_how_far_it_is_compared_is_asked_for() {
    let folder = tempfile::tempdir().unwrap();
    write_capture(&folder.path().join("capture"), 9, (32, 24));
    // A sheet of 20 × 20 squares around the origin, without the four in its middle, and a small separate piece.
    let mut sheet = String::new();
    for (x, y) in (0..21).flat_map(|y| (0..21).map(move |x| (x, y))) {
        writeln!(sheet, "v {} {} 0", 0.05 * f64::from(x) - 0.5, 0.05 * f64::from(y) - 0.5).unwrap();
    }
    let is_hole = |x: i32, y: i32| (9..11).contains(&x) && (9..11).contains(&y);
    for (x, y) in (0..20).flat_map(|y| (0..20).map(move |x| (x, y))).filter(|&(x, y)| !is_hole(x, y)) {
        let corner = 21 * y + x + 1;
        writeln!(sheet, "f {corner} {} {} {}", corner + 1, corner + 22, corner + 21).unwrap();
    }
    sheet += "v 0.6 0 0\nv 0.64 0 0\nv 0.6 0.04 0\nf 442 443 444\n";
    std::fs::write(folder.path().join("sheet.obj"), sheet).unwrap();
    let mesh = |flags: &str| -> Value {
        let command = format!("mesh capture --mesh sheet.obj -o out.glb --texture-size 64 --json{flags}");
        serde_json::from_slice(&run(folder.path(), &command)).unwrap()
    };
    for (flags, holes, triangles) in
        [("", 1, 792), (" --holes off", 0, 792), (" --crumbs off", 1, 793), (" --holes off --crumbs off", 0, 793)]
    {
        let said = mesh(flags);
        let found = json!([said["holes_closed"], said["triangles"]["cleaned"]]);
        assert_eq!(found, json!([holes, triangles]), "{flags}");
    }
    // 1 % of the diagonal of the compared part of the truth.
    let within = |flags: &str| mesh(flags)["truth"]["within"].as_f64().unwrap();
    let diagonal = 1.14_f64.hypot(1.0);
    assert!((within(" --truth sheet.obj") - 0.01 * diagonal).abs() < 1e-6);
    assert!((within(" --truth sheet.obj --truth-radius 0.2") - 0.004 * 2_f64.sqrt()).abs() < 1e-6);
}
