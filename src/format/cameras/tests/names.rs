//! Names of cameras and of their pictures.

use serde_json::json;

use super::{TURN, gltf_with, read, shot};
use crate::capture::{self, LoadOptions};
use crate::format::cameras::{CameraFile, Sampling, picture_names};
use crate::format::{read_cameras, write_cameras};

#[test]
fn names_of_pictures_are_safe_and_unique() {
    let names = |views: &[&str]| picture_names(views.iter().copied(), "png");
    let found = names(&["left/0001.jpg", "left_0001.PNG", "LEFT/0001", "../../etc/passwd", "IMG 12.tar.JPG", "..", ""]);
    let expected = ["left_0001", "left_0001_2", "LEFT_0001_3", "_.._etc_passwd", "IMG_12.tar", "view", "view_2"];
    assert_eq!(found, expected.map(|stem| format!("{stem}.png")));
    let long = format!("{}_{}", "日".repeat(100), "x".repeat(100));
    let found = names(&[&long, &format!("{long}y")]);
    assert_eq!(
        found,
        ["", "_2"].map(|number| format!("{}{number}.png", "日".repeat(66))),
        "longer than files may be called"
    );
    // Numbers that Blender appends to copies are no file extensions.
    let found = names(&["Camera", "Camera.001", "Camera.001_00007", "Camera.002.jpeg"]);
    assert_eq!(found, ["Camera", "Camera.001", "Camera.001_00007", "Camera.002"].map(|stem| format!("{stem}.png")));
    // Reserved device names of Windows.
    let found = names(&["aux", "Nul.left.png", "com1", "com10", "console", "LPT9.1.jpg"]);
    let expected = ["_aux", "_Nul.left", "_com1", "com10", "console", "_LPT9.1"];
    assert_eq!(found, expected.map(|stem| format!("{stem}.png")));
    // Camera files contain these names, unless all cameras already have names of pictures.
    let folder = tempfile::tempdir().unwrap();
    let (first, second) = (shot(1, 0.0)[0].1, shot(2, 0.0)[1].1);
    for (given, expected) in [
        (["left/0001.jpg", "left_0001.PNG"], ["left/0001.jpg", "left_0001.PNG"]),
        (["left/0001.jpg", "left_0001"], ["left_0001.png", "left_0001_2.png"]),
        (["../0001.jpg", "2.jpg"], ["_0001.png", "2.png"]),
        (["a.jpg", "A.jpg"], ["a.png", "A_2.png"]),
    ] {
        let cameras = vec![(given[0].to_owned(), first), (given[1].to_owned(), second)];
        let file = CameraFile { cameras, ..CameraFile::default() };
        for name in ["a.json", "model"] {
            write_cameras(&folder.path().join(name), &file).unwrap();
            let back = capture::cameras(&folder.path().join(name), &LoadOptions::default()).unwrap();
            let mut read: Vec<&str> = back.cameras.iter().map(|(name, _)| &name[..]).collect();
            let mut expected = expected;
            read.sort_unstable();
            expected.sort_unstable();
            assert_eq!(read, expected, "{name}");
        }
    }
}

#[test]
fn names_of_cameras_are_short() {
    let folder = tempfile::tempdir().unwrap();
    let floats: [(&str, &[f32]); 2] = [("SCALAR", &[0.0, 1.0]), ("VEC4", &TURN)];
    let channels = json!([{ "sampler": 0, "target": { "node": 0, "path": "rotation" } }]);
    let path = gltf_with(folder.path(), &floats, &json!([{ "input": 0, "output": 1 }]), &channels);
    let name = "ä".repeat(1 << 18);
    let text = std::fs::read_to_string(&path).unwrap();
    std::fs::write(&path, text.replace("moving", &name)).unwrap();
    let found = read(&path);
    assert_eq!(found.cameras[30].0, format!("{}_00030", "ä".repeat(100)));
    let only = read_cameras(&path, &Sampling { only: std::slice::from_ref(&name), ..Sampling::default() }).unwrap();
    assert_eq!(only.cameras.len(), 31);
    let usd = folder.path().join("a.usda");
    std::fs::write(&usd, format!("#usda 1.0\ndef Camera \"a\" ( displayName = \"{name}\" ) {{}}\n")).unwrap();
    assert_eq!(read(&usd).cameras[0].0, "ä".repeat(100));
    let layer = format!("#usda 1.0\ndef Xform \"{0}\" {{ def Camera \"a\" {{}} }}\n", "b".repeat(1 << 18));
    std::fs::write(&usd, layer).unwrap();
    let found = read(&usd);
    assert!(
        found.notes.iter().any(|note| note.starts_with(&format!("/{}/a: ", "b".repeat(100)))),
        "{:?}",
        found.notes[0].len()
    );
}

/// Below the folder of the file as they lie, else as in captures of nerfstudio, whatever their folder is called.
#[test]
fn photographs_that_are_known_are_named_by_their_place() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    for place in ["a/images", "a/photos", "b"] {
        std::fs::create_dir_all(at(place)).unwrap();
    }
    for (images, names, out, expected) in [
        ("a/images", ["left/1 .jpg", "left/r_2"], "a/list.json", "images/left/1 .jpg"),
        ("a/images", ["left/1 .jpg", "left/r_2"], "all.json", "a/images/left/1 .jpg"),
        ("a/images", ["left/1 .jpg", "left/r_2"], "a/images/here.json", "left/1 .jpg"),
        ("a/images", ["left/1 .jpg", "left/r_2"], "b/transforms.json", "images/left/1 .jpg"),
        ("a/photos", ["left/1 .jpg", "left/r_2"], "b/transforms.json", "images/left/1 .jpg"),
        ("a", ["1.jpg", "2.jpg"], "b/transforms.json", "images/1.jpg"),
        ("a", ["1.jpg", "2.jpg"], "a/list.json", "1.jpg"),
        // As other programs list them.
        ("a", ["images/1.jpg", "images/2.jpg"], "b/transforms.json", "images/1.jpg"),
        ("a", ["images/1.jpg", "images/2.jpg"], "all.json", "a/images/1.jpg"),
    ] {
        let images = Some(at(images));
        let cameras = names.map(|name| (name.to_owned(), shot(1, 0.0)[0].1)).to_vec();
        let file = CameraFile { cameras, fps: None, y_up: false, times: vec![], near: None, images, notes: vec![] };
        write_cameras(&at(out), &file).unwrap();
        let list: serde_json::Value = serde_json::from_slice(&std::fs::read(at(out)).unwrap()).unwrap();
        assert_eq!(list["frames"][0]["file_path"], expected, "{out}");
        let back = capture::cameras(&at(out), &LoadOptions::default()).unwrap();
        assert_eq!(back.cameras.iter().map(|(name, _)| &**name).collect::<Vec<_>>(), names, "{out}");
        assert_eq!(back.images[0], at(out).with_file_name(expected), "{out}");
    }
}
