//! Photographs with masks, by the command line: what scenes of them say of their training.

#![allow(clippy::unwrap_used, reason = "a failed unwrap is a failed test")]

mod common;

use std::path::Path;

use common::{centaur, stderr, write_capture};
use image::{GrayImage, Luma};
use serde_json::{Value, json};

fn run(folder: &Path, line: &str) -> Value {
    let output = centaur(folder).args(line.split(' ')).args(["--quiet", "--json"]).output().unwrap();
    assert!(output.status.success(), "{line}: {}", stderr(&output));
    serde_json::from_slice(&output.stdout).unwrap()
}

/// With other masks than in training scores are of something else.
#[test]
fn scenes_say_whether_they_were_trained_with_masks() {
    let folder = tempfile::tempdir().unwrap();
    let capture = folder.path().join("capture");
    write_capture(&capture, 9, (48, 32));
    std::fs::create_dir(capture.join("masks")).unwrap();
    let mask = GrayImage::from_fn(48, 32, |x, _| Luma([if x < 30 { 255 } else { 0 }]));
    for view in 0..9 {
        mask.save(capture.join(format!("masks/{view:03}.png"))).unwrap();
    }
    let train = "train capture -o scene.glb --no-mesh --iterations 3 --max-splats 300 --no-eval";
    for (trained, told) in [
        ("", "the scene was trained without masks, and is scored with"),
        (" --masks", "the scene was trained with masks, and is scored without"),
    ] {
        assert_eq!(run(folder.path(), &format!("{train}{trained}"))["masks"], !trained.is_empty());
        for scored in ["", " --masks"] {
            let scores = run(folder.path(), &format!("eval scene.glb capture -o scores{scored}"));
            let expected = if scored == trained { json!([]) } else { json!([told]) };
            assert_eq!(scores["notes"], expected, "{trained} {scored}");
            let report = std::fs::read_to_string(folder.path().join("scores/report.html")).unwrap();
            let row = format!("<th>masks<td>{}</tr>", !trained.is_empty());
            assert!(report.contains(&row), "{trained} {scored}");
        }
    }
}
