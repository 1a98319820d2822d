//! Identity of a run's input, by which its checkpoint is told from those of others.

use std::path::Path;

use glam::{Vec2, Vec3};

use crate::{
    capture::{Capture, View},
    optimize::{
        MeshSource,
        resume::{Input, InputMesh, InputView},
    },
    scene::Camera,
};

/// Views, points and mesh that a run is of.
pub(super) fn input(capture: &Capture, source: &MeshSource) -> Input {
    Input {
        views: capture.views.iter().map(of_view).collect(),
        points: capture.points.len(),
        positions: digest(capture.points.iter().flat_map(|p| p.position.to_array())),
        mesh: of_mesh(source),
    }
}

fn of_view(view: &View) -> InputView {
    // A file is told by its length: paths and times change where a capture is copied.
    let length = |path: &Path| std::fs::metadata(path).map_or(0, |file| file.len());
    let (k, source) = (view.camera.intrinsics(), &view.source);
    InputView {
        name: view.name.clone(),
        width: k.width,
        height: k.height,
        camera: of_camera(&view.camera),
        photograph: length(source.path()),
        mask: source.mask().map(length),
        held_out: source.held_out(),
        lens: format!("{:?}", source.lens().distortion),
    }
}

/// By the bits of its numbers.
fn of_camera(camera: &Camera) -> u64 {
    let k = camera.intrinsics();
    let (rotation, translation) = (camera.rotation().to_cols_array(), camera.translation().to_array());
    digest([rotation.as_slice(), &translation, &[k.fx, k.fy, k.cx, k.cy]].concat().into_iter())
}

fn of_mesh(source: &MeshSource) -> InputMesh {
    match source {
        MeshSource::None => InputMesh::None,
        MeshSource::Splats => InputMesh::Splats,
        MeshSource::Points => InputMesh::Points,
        MeshSource::Given { surface, corner_uvs } => {
            let positions = surface.positions.iter().flat_map(Vec3::to_array).map(f64::from);
            let corners = surface.triangles.iter().flatten().map(|&corner| f64::from(corner));
            let uvs = corner_uvs.iter().flatten().flatten().flat_map(Vec2::to_array).map(f64::from);
            let shape = digest(positions.chain(corners).chain(uvs));
            InputMesh::Given { triangles: surface.triangles.len(), shape }
        }
    }
}

/// FNV-1a hash of the bits of these numbers.
fn digest(numbers: impl Iterator<Item = f64>) -> u64 {
    let bytes = numbers.flat_map(|number| number.to_bits().to_le_bytes());
    bytes.fold(0xcbf2_9ce4_8422_2325, |hash, byte| (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::capture::LoadOptions;

    /// A run resumed with another split would be scored on views that it was trained on.
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
        // With either lens the pictures have the same size and pinhole camera.
        assert!(of("b.png", 0.01) != usual && of("a.png", 0.02) != usual);
    }
}
