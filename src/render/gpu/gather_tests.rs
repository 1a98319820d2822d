//! Sums over the footprints of splats, compared with the reference's blend weights.

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;

use super::{
    Gpu,
    training::{Show, Training},
};
use crate::{
    render::{
        reference::{self, Image, Parameters},
        testing,
    },
    scene::{Camera, HybridScene, OrderMode, sh},
};

/// Σw·value and Σw for every splat. A weight is the derivative of the picture by a splat's colour, and the derivative
/// of the colour by its first coefficient is Y₀.
fn sums(scene: &HybridScene, camera: &Camera, values: &[[f32; 3]]) -> Vec<[f64; 4]> {
    let k = camera.intrinsics();
    let values = Image {
        width: k.width as usize,
        height: k.height as usize,
        rgb: values.iter().map(|value| value.map(f64::from)).collect(),
        transmittance: vec![0.0; values.len()],
    };
    let (by, seen) = reference::backward_parameters(scene, camera, &Parameters::of(scene), &values, None);
    let coefficients = sh::coefficients(scene.splats.sh_degree());
    let of_splat = |(i, weight): (usize, f64)| (by.sh[coefficients * i] / sh::C0).extend(weight).to_array();
    seen.iter().map(|s| s.weight).enumerate().map(of_splat).collect()
}

#[test]
fn sums_over_splats_are_by_the_weights_of_the_reference() {
    let modes = [OrderMode::Stable, OrderMode::SurfaceConsistent, OrderMode::Direct];
    let gpus = [Gpu::with_subgroups(true), Gpu::with_subgroups(false), Gpu::open(None).unwrap().posing_as_gpu()];
    for (seed, (gpu, mode)) in gpus.iter().zip(modes).enumerate() {
        let (scene, camera) = testing::smooth_scene(seed as u64, [1, 2, 4][seed], mode);
        let mut rng = Pcg32::seed_from_u64(seed as u64);
        let pixels = camera.intrinsics().pixels();
        let values: Vec<[f32; 3]> = (0..pixels).map(|_| [0; 3].map(|_| rng.random_range(-1.0..2.0))).collect();
        let without_meshes = HybridScene { meshes: vec![], ..scene.clone() };
        let mut training = Training::new(gpu, &scene, &[camera], 0.2).unwrap();
        let [all, alone] = [&scene, &without_meshes].map(|scene| sums(scene, &camera, &values));
        let hidden = all.iter().zip(&alone).filter(|(all, alone)| all[3] < 0.9 * alone[3]).count();
        assert!(hidden > 0, "{mode:?}: meshes hide nothing");
        for (show, expected) in [(Show::All, all), (Show::SplatsAlone, alone)] {
            let found = training.gather(&camera, &values, show).unwrap();
            assert_eq!(found.len(), expected.len());
            for (i, (found, expected)) in found.iter().zip(&expected).enumerate() {
                assert!(expected[3] > 0.1, "{mode:?}, {show:?}: splat {i} is not seen");
                for (a, b) in found.iter().zip(expected) {
                    let error = (f64::from(*a) - b).abs();
                    // Weights are right up to some ulps, and values are at most 2.
                    assert!(error < 1e-4 * expected[3], "{mode:?}, {show:?}, splat {i}: {found:?}, not {expected:?}");
                }
            }
        }
        let found = training.gather(&camera, &values, Show::MeshesAlone).unwrap();
        assert_eq!(found, vec![[0.0; 4]; scene.splats.len()], "{mode:?}: of what is not shown");
    }
}
