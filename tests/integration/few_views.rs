//! A real capture of 15 views (`CENTAUR_DATA`, else `../shared/data`), of which 13 are trained on: overfitting to these
//! would show in the others.

use crate::common::{centaur, data, stderr};
use centaur::format::read_scene;

/// Minimum for every held-out view, in dB. After 20 iterations the views have 22.6 and 23.0; when this was written,
/// after 250, hybrids and splats alone had 27.0 to 28.5.
const LEAST_PSNR: f64 = 25.0;

#[test]
#[ignore = "needs shared data"]
fn fifteen_views_do_not_explode() {
    let capture = data("capture_banana16");
    let folder = tempfile::tempdir().unwrap();
    let coarse = "--max-side 128 --iterations 250 --surface-iterations 125 --warmup 80 --max-splats 4000 --triangles 2000 --texture-size 128 \
                  --layers 1 --json --quiet";
    for (name, more) in [("hybrid", &[][..]), ("splats alone", &["--no-mesh"])] {
        let mut command = centaur(folder.path());
        command.arg("train").arg(&capture).args(["-o", "scene.glb"]).args(coarse.split_whitespace()).args(more);
        let output = command.output().unwrap();
        assert!(output.status.success(), "{name}: {}", stderr(&output));
        let result: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
        let views = result["evaluation"]["views"].as_array().unwrap();
        let held_out: Vec<(&str, f64)> =
            views.iter().map(|v| (v["name"].as_str().unwrap(), v["psnr"].as_f64().unwrap())).collect();
        let scene = read_scene(&folder.path().join("scene.glb")).unwrap();
        let splats = &scene.splats;
        eprintln!("{name}: {held_out:.2?} dB, {} splats, {} meshes", splats.len(), scene.meshes.len());
        assert_eq!(held_out.len(), 2, "every 8th of 15");
        assert!(held_out.iter().all(|(_, psnr)| *psnr > LEAST_PSNR), "{name}: {held_out:?}");
        assert_eq!(scene.meshes.is_empty(), name != "hybrid");
        assert!((1000..=4000).contains(&splats.len()), "{name}: {}", splats.len());
        let is_finite = splats.means().iter().all(|v| v.is_finite())
            && splats.log_scales().iter().all(|v| v.is_finite())
            && splats.rotations().iter().all(|q| q.is_finite())
            && splats.opacity_logits().iter().all(|v| v.is_finite())
            && splats.sh().as_flattened().iter().all(|v| v.is_finite());
        assert!(is_finite, "{name}: not all splats are finite");
    }
}
