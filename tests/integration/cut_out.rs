//! Photographs with masks or alpha on the command line: what their scenes record of training, and the background behind
//! transparent content.

use std::path::Path;

use crate::common::{centaur, stderr, write_capture};
use centaur::format::{WriteOptions, write_scene};
use centaur::scene::{Composition, HybridScene, Splats};
use glam::{Quat, Vec3};
use image::{GrayImage, Luma, Rgb, Rgba, RgbaImage};
use serde_json::{Value, json};

fn run(folder: &Path, line: &str) -> Value {
    let output = centaur(folder).args(line.split(' ')).args(["--quiet", "--json"]).output().unwrap();
    assert!(output.status.success(), "{line}: {}", stderr(&output));
    serde_json::from_slice(&output.stdout).unwrap()
}

/// Scores with masks other than those of training, or of a moved scene, are not comparable.
#[test]
fn scenes_say_whether_they_were_trained_with_masks_and_from_there() {
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
        ("", "the scene was trained without masks, but is scored with masks"),
        (" --masks", "the scene was trained with masks, but is scored without them"),
    ] {
        let outcome = run(folder.path(), &format!("{train}{trained}"));
        let notes = outcome["notes"].to_string();
        assert_eq!(outcome["masks"], !trained.is_empty());
        assert_eq!(
            notes.contains("capture/masks exists but is not used: --masks uses it"),
            trained.is_empty(),
            "{notes}"
        );
        for scored in ["", " --masks"] {
            let scores = run(folder.path(), &format!("eval scene.glb capture -o scores{scored}"));
            let expected = match (scored, trained) {
                ("", "") => json!(["capture/masks exists but is not used: --masks uses it"]),
                _ if scored == trained => json!([]),
                _ => json!([told]),
            };
            assert_eq!(scores["notes"], expected, "{trained} {scored}");
            let report = std::fs::read_to_string(folder.path().join("scores/report.html")).unwrap();
            let row = format!("<th>masks<td>{}</tr>", !trained.is_empty());
            assert!(report.contains(&row), "{trained} {scored}");
        }
    }
    for moved in ["--rotate 0,30,0", "--scale 2"] {
        run(folder.path(), &format!("convert scene.glb moved.glb {moved}"));
        let note = run(folder.path(), "eval moved.glb capture --masks")["notes"][0].clone();
        assert!(note.as_str().is_some_and(|note| note.contains("it was moved")), "{moved}: {note}");
    }
    // With another picture size, and with other names of photographs.
    let notes = run(folder.path(), "eval scene.glb capture --masks --max-side 24")["notes"].clone();
    let expected = "photographs are 24×16, but the scene was trained on 48×32: to score it at that size";
    assert!(notes[0].as_str().is_some_and(|note| note.starts_with(expected)), "{notes}");
    let list = capture.join("sparse/0/images.txt");
    let mut text = std::fs::read_to_string(&list).unwrap();
    for view in 0..9 {
        let [before, after] = [format!("{view:03}.png"), format!("other-{view}.png")];
        for folder in ["images", "masks"] {
            std::fs::rename(capture.join(folder).join(&before), capture.join(folder).join(&after)).unwrap();
        }
        text = text.replace(&before, &after);
    }
    std::fs::write(&list, text).unwrap();
    let notes = run(folder.path(), "eval scene.glb capture --masks")["notes"].clone();
    let expected = "no camera of the scene has the name of a view of the capture";
    assert!(notes[0].as_str().is_some_and(|note| note.starts_with(expected)), "{notes}");
}

/// As for NeRF-synthetic, where splats by other programs are meant for a white background without saying so.
#[test]
fn splats_of_others_are_shown_and_scored_over_white_if_asked_for() {
    let folder = tempfile::tempdir().unwrap();
    let capture = folder.path().join("capture");
    write_capture(&capture, 9, (48, 32));
    // Black and half transparent: 127/255 over white.
    for view in 0..9 {
        RgbaImage::from_pixel(48, 32, Rgba([0, 0, 0, 128]))
            .save(capture.join(format!("images/{view:03}.png")))
            .unwrap();
    }
    // Too transparent to be visible.
    let (log_scales, logits) = (vec![Vec3::splat(-5.0)], vec![-20.0]);
    let splats = Splats::new(vec![Vec3::ZERO], vec![Quat::IDENTITY], log_scales, logits, 0, vec![[0.0; 3]]).unwrap();
    let unseen = HybridScene { splats, meshes: vec![], composition: Composition::default() };
    write_scene(&folder.path().join("unseen.ply"), &unseen, &WriteOptions::default()).unwrap();
    for (flag, level) in [("", 0_u8), (" --background black", 0), (" --background white", 255)] {
        let scores = run(folder.path(), &format!("eval unseen.ply capture{flag}"));
        let psnr = scores["psnr"].as_f64();
        if level == 0 {
            assert!(psnr.is_none_or(|psnr| psnr > 90.0), "{flag}: {psnr:?}");
        } else {
            assert!((psnr.unwrap() - -20.0 * (128.0_f64 / 255.0).log10()).abs() < 1e-3, "{flag}: {psnr:?}");
        }
        assert_eq!(scores["background"], Value::from(vec![f64::from(level / 255); 3]));
        let rendered = run(folder.path(), &format!("render unseen.ply --cameras capture -o pictures{flag}"));
        let picture = folder.path().join(rendered["pictures"][0].as_str().unwrap());
        assert!(image::open(picture).unwrap().into_rgb8().pixels().all(|p| *p == Rgb([level; 3])), "{flag}");
    }
}
