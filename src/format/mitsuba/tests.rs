#![allow(clippy::unwrap_used, reason = "a failed unwrap is a failed test")]

use super::*;
use crate::format::test_scenes::{camera, random_scene};
use crate::scene::Intrinsics;

/// Checks that tags are closed in order and attributes quoted, and returns (tag, attributes) of every element.
fn elements(text: &str) -> Vec<(String, Vec<(String, String)>)> {
    let (mut open, mut found) = (vec![], vec![]);
    for tag in text.split('<').skip(1).map(|rest| rest.split_once('>').unwrap().0) {
        if tag.starts_with(['?', '!']) {
            continue;
        }
        if let Some(name) = tag.strip_prefix('/') {
            assert_eq!(open.pop(), Some(name.to_owned()));
            continue;
        }
        let (tag, is_closed) = tag.strip_suffix('/').map_or((tag, false), |tag| (tag, true));
        let (name, mut rest) = tag.split_once(' ').unwrap_or((tag, ""));
        let mut attributes = vec![];
        while let Some((key, value)) = rest.split_once("=\"") {
            let (value, more) = value.split_once('"').unwrap();
            let value = ["&lt;<", "&gt;>", "&quot;\"", "&amp;&"].iter().fold(value.to_owned(), |value, pair| {
                let (escape, character) = pair.split_once(';').unwrap();
                value.replace(&format!("{escape};"), character)
            });
            attributes.push((key.trim().to_owned(), value));
            rest = more;
        }
        assert!(rest.trim().is_empty(), "{rest}");
        found.push((name.to_owned(), attributes));
        if !is_closed {
            open.push(name.to_owned());
        }
    }
    assert!(open.is_empty(), "{open:?}");
    found
}

/// Values of all parameters called `name`, in order.
fn values(text: &str, name: &str) -> Vec<String> {
    let of = |attributes: &[(String, String)], key: &str| {
        attributes.iter().find(|(k, _)| k == key).map(|(_, value)| value.clone())
    };
    let elements = elements(text);
    let named = elements.iter().filter(|(_, attributes)| of(attributes, "name").as_deref() == Some(name));
    named.filter_map(|(_, attributes)| of(attributes, "value")).collect()
}

fn exported(name: &str, scene: &HybridScene, cameras: &[(String, Camera)]) -> (String, WriteReport) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(name);
    let report = write(&path, scene, cameras).unwrap();
    let mut bytes = path.metadata().unwrap().len();
    for file in &report.beside {
        bytes += folder.path().join(file).metadata().unwrap().len();
    }
    assert_eq!((bytes, report.beside.len() + 1), (report.bytes, folder.path().read_dir().unwrap().count()));
    let text = std::fs::read_to_string(&path).unwrap();
    for file in values(&text, "filename").iter().chain(&values(&text, "map_00")) {
        assert!(report.beside.contains(file), "{file} is named and not written");
    }
    (text, report)
}

#[test]
fn a_hybrid_scene_is_whole() {
    let scene = random_scene(7, 2, 3, 4);
    let name = "a \"b\" <c> & $d\n";
    let cameras = [(name.to_owned(), camera()), ("other".to_owned(), camera())];
    let (text, report) = exported("my scene.XML", &scene, &cameras);
    assert_eq!(values(&text, "label"), ["a \"b\" <c> & _d_", "other"]);
    assert!(report.beside.contains(&"hybrid_rf.py".to_owned()));
    assert!(report.beside.contains(&"my_scene_mesh0_sh15.exr".to_owned()));
    assert_eq!(values(&text, "filename").len(), 4, "two shells and two meshes");
    assert_eq!(values(&text, "map_15").len(), 1, "the second mesh is of degree 0");
    let c = &scene.composition;
    assert_eq!(values(&text, "near"), [c.near.to_string()]);
    assert_eq!(values(&text, "surfaces"), [c.layers.to_string()]);
    assert_eq!(values(&text, "background"), ["0.1 0.2 0.3"]);
    assert_eq!(values(&text, "color_space"), ["srgb"]);
    assert_eq!(values(&text, "width"), ["640", "640"]);

    // The sensor of hybrid_rf.py maps a pixel to the camera's ray.
    let k = camera().intrinsics().to_owned();
    let number = |name: &str| values(&text, name)[0].parse::<f64>().unwrap();
    let intrinsics = Intrinsics {
        fx: number("focal_x"),
        fy: number("focal_y"),
        cx: number("center_x"),
        cy: number("center_y"),
        ..k
    };
    assert_eq!(intrinsics, k);
    let matrix = elements(&text).into_iter().find(|(tag, _)| tag == "matrix").unwrap().1.remove(0).1;
    let rows: Vec<f64> = matrix.split(' ').map(|v| v.parse().unwrap()).collect();
    let to_world = DMat4::from_cols_slice(&rows).transpose();
    let ray = camera().ray(glam::DVec2::new(20.5, 300.5));
    let direction = to_world.transform_vector3(DVec3::new(-ray.x, -ray.y, 1.0));
    assert!(direction.abs_diff_eq(camera().rotation().transpose() * ray, 1e-12));
    assert!(to_world.transform_point3(DVec3::ZERO).abs_diff_eq(camera().center(), 1e-12));
    assert!(report.loss.composition && report.loss.meshes == 0 && report.loss.cameras == 0);
    assert!(report.notes.iter().any(|note| note.contains("mode `surfaceConsistent`")), "{:?}", report.notes);
}

#[test]
fn splats_alone_and_meshes_alone_lose_no_rule() {
    let both = random_scene(7, 1, 1, 3);
    let splats = HybridScene { meshes: vec![], ..both.clone() };
    let (text, report) = exported("a.xml", &splats, &[]);
    assert!(report.loss.is_none() && values(&text, "color_space") == ["linear"]);
    assert!(report.notes.iter().any(|note| note.contains("no cameras")), "{:?}", report.notes);
    let meshes = HybridScene { splats: random_scene(0, 0, 0, 1).splats, ..both };
    let (text, report) = exported("a.xml", &meshes, &[("c".to_owned(), camera())]);
    assert!(report.loss.is_none() && !text.contains("ellipsoidsmesh"));
}

#[test]
fn the_stock_variant_names_what_it_leaves_out() {
    let scene = random_scene(7, 2, 3, 4);
    let (text, report) = exported("a.stock.xml", &scene, &[("c".to_owned(), camera())]);
    assert_eq!(report.beside, ["a_splats.ply"]);
    assert_eq!((report.loss.meshes, report.loss.composition), (2, true));
    assert!(text.contains("volprim_rf_basic") && !text.contains("hybrid"));
    // Mitsuba's `perspective` sensor: the tangent of half the field of view is half the width divided by the focal
    // length.
    let k = *camera().intrinsics();
    let fov: f64 = values(&text, "fov")[0].parse().unwrap();
    assert!((0.5 * f64::from(k.width) / (0.5 * fov.to_radians()).tan() - k.fx).abs() < 1e-9);
    // The sign was determined by rendering: the optical axis meets the film at one half minus the offset.
    for (name, side, at) in [("x", k.width, k.cx), ("y", k.height, k.cy)] {
        let offset: f64 = values(&text, &format!("principal_point_offset_{name}"))[0].parse().unwrap();
        assert!(offset != 0.0 && ((0.5 - offset) * f64::from(side) - at).abs() < 1e-9, "{name}: {offset}");
    }
    assert!(report.notes.iter().any(|note| note.contains("not square")), "{:?}", report.notes);
}

#[test]
fn what_cannot_be_written_is_one_line() {
    let folder = tempfile::tempdir().unwrap();
    let scene = random_scene(2, 1, 0, 4);
    let error = write(&folder.path().join("none/a.xml"), &scene, &[]).unwrap_err().to_string();
    assert!(error.contains("a_splats.ply: cannot write: ") && error.lines().count() == 1, "{error}");
    std::fs::create_dir(folder.path().join("a.xml")).unwrap();
    let error = write(&folder.path().join("a.xml"), &scene, &[]).unwrap_err().to_string();
    assert!(error.ends_with("a.xml: cannot write: a folder of this name exists"), "{error}");
}
