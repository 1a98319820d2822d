//! What a run is of, by which its checkpoint is told from those of others.

use std::path::Path;

use glam::{Vec2, Vec3};
use serde_json::Value;

use crate::{
    capture::{Capture, View},
    optimize::MeshSource,
    scene::Camera,
};

/// Views, points and mesh that a run is of.
pub(super) fn input(capture: &Capture, source: &MeshSource) -> Value {
    let size = |c: &Camera| (c.intrinsics().width, c.intrinsics().height);
    // A file is told by its length: paths and times change where a capture is copied.
    let length = |path: &Path| std::fs::metadata(path).map_or(0, |file| file.len());
    let files = |v: &View| (length(v.source.path()), v.source.mask().map(length));
    // Cameras by the bits of their numbers, which JSON may round.
    let posed = |c: &Camera| {
        let k = c.intrinsics();
        let numbers =
            [c.rotation().to_cols_array().as_slice(), &c.translation().to_array(), &[k.fx, k.fy, k.cx, k.cy]].concat();
        digest(numbers.into_iter())
    };
    // What it is to a run: seen or kept for scores, and straightened by which lens.
    let role = |v: &View| (v.source.held_out(), format!("{:?}", v.source.lens().distortion));
    let view = |v: &View| serde_json::json!([v.name, size(&v.camera), posed(&v.camera), files(v), role(v)]);
    let views: Vec<Value> = capture.views.iter().map(view).collect();
    let points = digest(capture.points.iter().flat_map(|p| p.position.to_array()));
    let mesh = match source {
        MeshSource::None => "none".to_owned(),
        MeshSource::Splats => "splats".to_owned(),
        MeshSource::Points => "points".to_owned(),
        MeshSource::Given { surface, corner_uvs } => {
            let positions = surface.positions.iter().flat_map(Vec3::to_array).map(f64::from);
            let corners = surface.triangles.iter().flatten().map(|&corner| f64::from(corner));
            let uvs = corner_uvs.iter().flatten().flatten().flat_map(Vec2::to_array).map(f64::from);
            let shape = digest(positions.chain(corners).chain(uvs));
            format!("given, {} triangles, {shape:016x}", surface.triangles.len())
        }
    };
    serde_json::json!({ "views": views, "points": (capture.points.len(), points), "mesh": mesh })
}

/// FNV-1a of the bits of these numbers.
fn digest(numbers: impl Iterator<Item = f64>) -> u64 {
    let bytes = numbers.flat_map(|number| number.to_bits().to_le_bytes());
    bytes.fold(0xcbf2_9ce4_8422_2325, |hash, byte| (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::capture::LoadOptions;

    /// Scores of a run that goes on with another split would be of views that it has learnt from.
    #[test]
    fn runs_are_told_by_their_split_and_lens() {
        let folder = tempfile::tempdir().unwrap();
        let frame = |name: &str, x: f64| {
            image::RgbImage::new(4, 4).save(folder.path().join(name)).unwrap();
            serde_json::json!({
                "file_path": name, "transform_matrix": [[1, 0, 0, x], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1]],
            })
        };
        let frames = [frame("a.png", 0.0), frame("b.png", 1.0)];
        let of = |test: &str, k1: f64| {
            let json = serde_json::json!({
                "w": 4, "h": 4, "fl_x": 8, "k1": k1, "frames": frames, "test_filenames": [test],
                "train_filenames": [if test == "a.png" { "b.png" } else { "a.png" }],
            });
            std::fs::write(folder.path().join("transforms.json"), json.to_string()).unwrap();
            let options = LoadOptions { without_points: true, ..LoadOptions::default() };
            input(&crate::capture::open(folder.path(), &options).unwrap(), &MeshSource::None)
        };
        let usual = of("a.png", 0.01);
        assert_eq!(of("a.png", 0.01), usual);
        // Both lenses leave pictures of one size and pinhole.
        assert!(of("b.png", 0.01) != usual && of("a.png", 0.02) != usual);
    }
}
