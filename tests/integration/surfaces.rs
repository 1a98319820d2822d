//! Surfaces made by `centaur train` and `centaur mesh`: what they are made of, and how near they are to a given one.

use std::fmt::Write as _;
use std::path::Path;

use crate::common::{self, demo};
use centaur::capture::{self, LoadOptions};
use centaur::format::mesh_import;
use centaur::scene::Camera;
use glam::{DVec3, Vec3};

/// The demo has no tracks.
#[test]
fn what_a_surface_was_made_of_is_said() {
    let folder = tempfile::tempdir().unwrap();
    let demo = demo().display().to_string();
    let flags = "--max-side 64 --max-splats 1000 --iterations 20 --warmup 0 --triangles 500 --texture-size 64 --quiet --json -o scene.glb";
    // One of the notes is that the demo is z up.
    for (surface, origin, notes) in
        [(Some("points"), "guessed_points", 2), (Some("splats"), "splats", 1), (None, "splats", 1)]
    {
        let mut command = common::centaur(folder.path());
        let _ = std::fs::remove_file(folder.path().join("scene.glb"));
        command.args(["train", &demo, "--report", "report"]).args(flags.split(' '));
        let output = command.args(surface.map(|s| format!("--surface={s}"))).output().unwrap();
        assert!(output.status.success(), "{}", common::stderr(&output));
        let outcome: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
        assert_eq!((outcome["surface"].as_str(), outcome["notes"].as_array().unwrap().len()), (Some(origin), notes));
        let report = std::fs::read_to_string(folder.path().join("report/report.html")).unwrap();
        let words = if notes == 2 {
            "points of the capture, taken as visible where no nearer one hides them"
        } else {
            "fused depth of splats"
        };
        assert!(report.contains(words), "{surface:?}");
    }
}

#[test]
fn a_surface_is_compared_with_what_it_should_be() {
    let folder = tempfile::tempdir().unwrap();
    let demo = demo().display().to_string();
    let mesh = |args: &str| {
        let output = common::centaur(folder.path()).args(["mesh", &demo]).args(args.split(' ')).output().unwrap();
        assert_eq!(output.status.code(), Some(0), "{}", common::stderr(&output));
        String::from_utf8(output.stdout).unwrap()
    };
    let said = mesh("-o a.glb --triangles 3000 --quiet");
    let (last, written) = (said.lines().last().unwrap(), folder.path().join("a.glb"));
    let count = mesh_import::read(&written).unwrap().triangles.len();
    assert_eq!(last, format!("wrote a.glb: {count} triangles, {} bytes", written.metadata().unwrap().len()));
    let found: serde_json::Value =
        serde_json::from_str(&mesh("-o b.glb --truth a.glb --within 1e-4 --triangles 3000 --json")).unwrap();
    let of = |key: &str| found["truth"][key].as_f64().unwrap();
    assert!(of("accuracy") < 1e-6 && of("completeness") < 1e-6 && of("f_score") == 1.0, "{found}");
    assert!(of("counted") > 0.5 && of("counted") <= 1.0, "{found}");
    assert!(found["holes_closed"].as_u64().unwrap() > 0, "{found}");
    // The surface consists of what views see, except what was filled in around corners.
    let seen = found["atlas"]["seen"].as_f64().unwrap();
    assert!(seen > 0.8 && seen <= 1.0, "{found}");
    assert_eq!(of("chamfer"), 0.5 * (of("accuracy") + of("completeness")));
    // The same surface as a user's mesh: nothing to repair, fewer triangles, new charts.
    let own: serde_json::Value =
        serde_json::from_str(&mesh("--mesh a.glb -o c.glb --triangles 1000 --truth a.glb --json")).unwrap();
    let of_triangles = |json: &serde_json::Value, step: &str| json["triangles"][step].as_u64().unwrap();
    let (whole, read) = (of_triangles(&own, "cleaned"), of_triangles(&found, "simplified"));
    assert!(own["origin"] == "given" && of_triangles(&own, "extracted") == read && whole * 10 > read * 8, "{own}");
    let left = of_triangles(&own, "simplified");
    assert!((500..=1000).contains(&left) && own["truth"]["f_score"].as_f64().unwrap() > 0.9, "{own}");
    assert_eq!(mesh_import::read(&folder.path().join("c.glb")).unwrap().triangles.len() as u64, left);
    // If so few triangles cannot be reached, a note says so.
    let few: serde_json::Value = serde_json::from_str(&mesh("--mesh a.glb -o d.glb --triangles 1 --json")).unwrap();
    let (left, notes) = (of_triangles(&few, "simplified"), few["notes"].to_string());
    let said = format!("d.glb: {left} triangles remain, more than the 1 of --triangles: ");
    assert_eq!(notes.contains(&said), left > 1, "{notes}");
    assert_eq!(few["bytes"], folder.path().join("d.glb").metadata().unwrap().len());
    // Parts that no camera sees do not count: a square above all cameras, as large as the surface.
    let seen = mesh_import::read(&folder.path().join("a.glb")).unwrap();
    let area = |[a, b, c]: [Vec3; 3]| 0.5 * (b - a).cross(c - a).length();
    let side = seen.triangles.iter().map(|t| area(t.map(|i| seen.positions[i as usize]))).sum::<f32>().sqrt();
    let cameras: Vec<_> =
        capture::open(Path::new(&demo), &LoadOptions::default()).unwrap().views.iter().map(|v| v.camera).collect();
    let ahead: DVec3 = cameras.iter().map(|c| c.rotation().row(2)).sum();
    let ahead = ahead.normalize();
    let center = cameras.iter().map(Camera::center).sum::<DVec3>() / cameras.len() as f64 - 100.0 * ahead;
    let (x, y) = ahead.any_orthonormal_pair();
    let corners = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)];
    let corners = corners.map(|(u, v)| (center + f64::from(side) * (u * x + v * y)).as_vec3());
    let mut obj = String::new();
    for p in seen.positions.iter().chain(&corners) {
        writeln!(obj, "v {} {} {}", p.x, p.y, p.z).unwrap();
    }
    let first = u32::try_from(seen.positions.len()).unwrap();
    let square = [[first, first + 1, first + 2], [first, first + 2, first + 3]];
    for [a, b, c] in seen.triangles.iter().chain(&square) {
        writeln!(obj, "f {} {} {}", a + 1, b + 1, c + 1).unwrap();
    }
    std::fs::write(folder.path().join("more.obj"), obj).unwrap();
    let with_more: serde_json::Value =
        serde_json::from_str(&mesh("-o b.glb --triangles 3000 --truth more.obj --within 1e-4 --json")).unwrap();
    let counted = with_more["truth"]["counted"].as_f64().unwrap();
    assert!((counted - 0.5 * of("counted")).abs() < 0.01, "{found} {with_more}");
    assert!(with_more["truth"]["completeness"].as_f64().unwrap() < 1e-6, "{with_more}");
    let error = common::failure(
        folder.path(),
        common::centaur(folder.path()).args(["mesh", &demo, "-o", "c.glb", "--truth", "none.ply"]),
    );
    assert!(error.contains("none.ply: cannot read"), "{error}");
}
