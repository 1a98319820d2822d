//! The reference compared with images of gsplat: the two cases of Brush's test data (`oracle_brush` of the shared
//! data).

use crate::common::data;
use centaur::render::reference;
use centaur::scene::{Camera, Composition, HybridScene, Intrinsics, Splats};
use glam::{DMat3, DVec3, Quat, Vec3};
use safetensors::SafeTensors;

/// A tensor of f32 values with its shape.
fn tensor(file: &SafeTensors<'_>, name: &str) -> (Vec<usize>, Vec<f32>) {
    let view = file.tensor(name).unwrap();
    (view.shape().to_vec(), view.data().chunks_exact(4).map(|b| f32::from_le_bytes(b.try_into().unwrap())).collect())
}

fn rows<const N: usize>(values: &[f32]) -> impl Iterator<Item = [f32; N]> {
    values.chunks_exact(N).map(|row| row.try_into().unwrap())
}

/// Largest difference of colour or alpha from the case's image.
fn error_of(case: &str) -> f64 {
    let path = data("oracle_brush/crates/brush-bench-test/test_cases").join(case);
    let bytes = std::fs::read(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    let file = SafeTensors::deserialize(&bytes).unwrap();

    let rotations = rows(&tensor(&file, "quats").1).map(|[w, x, y, z]| Quat::from_xyzw(x, y, z, w)).collect();
    let splats = Splats::new(
        rows(&tensor(&file, "means").1).map(Vec3::from_array).collect(),
        rotations,
        rows(&tensor(&file, "scales").1).map(Vec3::from_array).collect(),
        tensor(&file, "opacities").1,
        3,
        rows(&tensor(&file, "coeffs").1).collect(),
    )
    .unwrap();
    let (shape, expected) = tensor(&file, "out_img");
    let (width, height) = (shape[1] as u32, shape[0] as u32);
    let (w, h) = (f64::from(width), f64::from(height));
    let intrinsics = Intrinsics { width, height, fx: 0.5 * w, fy: 0.5 * w, cx: 0.5 * w, cy: 0.5 * h };
    // The camera of the cases is in their source, not in the files (SOURCE.md).
    let camera = Camera::new(intrinsics, DMat3::IDENTITY, -DVec3::new(0.123, 0.456, -8.0)).unwrap();
    let composition = Composition { near: 0.01, ..Composition::default() };
    let image = reference::render(&HybridScene { splats, meshes: vec![], composition }, &camera);

    let rgba = image.rgb.iter().zip(&image.transmittance).flat_map(|([r, g, b], t)| [*r, *g, *b, 1.0 - t]);
    assert_eq!(expected.len(), 4 * image.rgb.len());
    assert!(expected.iter().any(|v| *v > 0.5), "the image is empty");
    // NaN is the largest in the total order.
    rgba.zip(expected).map(|(a, b)| (a - f64::from(b)).abs()).max_by(f64::total_cmp).unwrap()
}

/// f32 rasterisation of up to 16 overlapping splats has errors of a few 1e-6.
#[test]
#[ignore = "needs shared data"]
fn reference_renders_the_cases_of_brush() {
    for case in ["tiny_case.safetensors", "basic_case.safetensors"] {
        let error = error_of(case);
        assert!(error < 1e-5, "{case}: {error:e}");
    }
}
