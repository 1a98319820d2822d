//! COLMAP models that are damaged, or differ slightly from what COLMAP writes.

use std::path::Path;

use super::tests::{cameras_bin, full, message, write_capture, write_text_capture};
use super::transforms_tests::write_transforms;
use super::*;

#[test]
fn byte_order_marks_are_passed_over() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    let mark = |file: &Path| {
        let text = std::fs::read_to_string(file).unwrap();
        std::fs::write(file, format!("\u{feff}{text}")).unwrap();
    };
    write_transforms(root, 0.0);
    mark(&root.join("transforms.json"));
    assert_eq!(open(root, &full()).unwrap().views.len(), 2);
    assert_eq!(cameras(root, &full()).unwrap().cameras.len(), 2);
    write_text_capture(root);
    ["cameras.txt", "images.txt", "points3D.txt"].iter().for_each(|file| mark(&root.join("sparse/0").join(file)));
    let capture = open(root, &full()).unwrap();
    assert_eq!((capture.views.len(), capture.points.len()), (3, 3));
}

/// Both when a capture is opened and when only its cameras are read.
#[test]
fn further_models_are_passed_over() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    write_capture(root, 3, 20, 10);
    let [first, second] = ["sparse/0", "sparse/1"].map(|model| root.join(model));
    std::fs::create_dir(&second).unwrap();
    for file in ["cameras.bin", "images.bin"] {
        std::fs::copy(first.join(file), second.join(file)).unwrap();
    }
    let json = root.join("transforms.json");
    std::fs::write(&json, "{}").unwrap();
    let expected = [second, json];
    assert_eq!(open(root, &full()).unwrap().passed_over, expected);
    assert_eq!(cameras(root, &full()).unwrap().passed_over, expected);
}

#[test]
fn a_model_may_be_in_both_encodings() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    let stems = ["cameras", "images", "points3D"];
    for in_text in stems {
        write_text_capture(root);
        write_capture(root, 3, 20, 10);
        for stem in stems {
            let other = format!("{stem}.{}", if stem == in_text { "bin" } else { "txt" });
            std::fs::remove_file(root.join("sparse/0").join(other)).unwrap();
        }
        let capture = open(root, &full()).unwrap();
        assert_eq!((capture.views.len(), capture.points.len()), (3, 3), "{in_text}");
    }
}

#[test]
fn models_that_do_not_add_up_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    let sparse = root.join("sparse/0");
    let refused = |file: &str, change: &dyn Fn(Vec<u8>) -> Vec<u8>| {
        let write: fn(&Path) =
            if file.ends_with(".bin") { |root| write_capture(root, 3, 20, 10) } else { write_text_capture };
        write(root);
        let path = sparse.join(file);
        std::fs::write(&path, change(std::fs::read(&path).unwrap())).unwrap();
        message(root, &full()).split_once(": ").unwrap().1.to_owned()
    };
    for (file, end) in [
        ("cameras.bin", "end at byte 64: expected no more than 1 cameras, found 2 bytes"),
        ("images.bin", "end at byte 269: expected no more than 3 images, found 2 bytes"),
        ("points3D.bin", "end at byte 185: expected no more than 3 points, found 2 bytes"),
    ] {
        assert_eq!(refused(file, &|bytes| [&bytes[..], b"ab"].concat()), end);
    }
    let fewer = refused("images.bin", &|bytes| [&2u64.to_le_bytes(), &bytes[8..]].concat());
    assert!(fewer.contains("expected no more than 2 images, found"), "{fewer}");
    let wide = refused("cameras.bin", &|_| cameras_bin(1, 1 << 40, 10, &[20.0, 20.0, 10.0, 5.0]));
    assert_eq!(wide, "camera at byte 8: expected a width and height below 2^32, found 1099511627776×10");

    let refused = |file: &str, from: &str, to: &str| {
        refused(file, &|bytes| String::from_utf8(bytes).unwrap().replace(from, to).into_bytes())
    };
    let twice = refused("images.txt", "\n3 1 0", "\n1 1 0");
    assert!(twice.ends_with(": expected a new image id, found 1"), "{twice}");
    let parameters = refused("cameras.txt", "20 20 10 5", "20 20 10 5 6");
    assert_eq!(parameters, "line 2: expected 4 parameters of PINHOLE, found 6 after them");
    for (track, found) in [
        ("0.5 1 0 2", "expected a 2-D point of a track, found the end of the line"),
        ("0.5 foo 0", "expected an image id of a track, found foo"),
        ("0.5 1 bar", "expected a 2-D point of a track, found bar"),
    ] {
        assert_eq!(refused("points3D.txt", "0.5 1 0", track), format!("line 1: {found}"));
    }
}
