//! Models of COLMAP that are damaged, or not quite what COLMAP writes.

use std::path::Path;

use super::tests::{full, write_capture, write_text_capture, write_transforms};
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
