//! The reference and the GPU compared with images and gradients of gsplat's torch reference on its garden data, which
//! `tests/oracles/gsplat_oracle.py` computes in f64 and stores as a fixture (its layout is described there).

use std::path::PathBuf;

use centaur::render::gpu::{Gpu, Renderer};
use centaur::render::reference::{self, Image, Margin};
use centaur::scene::{Camera, Composition, HybridScene, Intrinsics, Splats};
use glam::{DMat3, DVec3, Quat, Vec3};
use safetensors::{Dtype, SafeTensors};

/// The fixture's scene with gsplat's results.
struct Fixture {
    scene: HybridScene,
    camera: Camera,
    image: Image,
    /// Given derivative of the loss by the image.
    cotangent: Image,
    /// `(class, derivative by each parameter)`, for quaternions at unit norm.
    gradients: [(&'static str, Vec<f64>); 5],
}

/// Values of a tensor of f32 or f64.
fn values(file: &SafeTensors<'_>, name: &str) -> Vec<f64> {
    let tensor = file.tensor(name).unwrap();
    match tensor.dtype() {
        Dtype::F32 => {
            tensor.data().chunks_exact(4).map(|b| f64::from(f32::from_le_bytes(b.try_into().unwrap()))).collect()
        }
        Dtype::F64 => tensor.data().chunks_exact(8).map(|b| f64::from_le_bytes(b.try_into().unwrap())).collect(),
        other => panic!("{name}: {other:?}"),
    }
}

/// Rows of a tensor that contains f32 values.
fn rows<const N: usize>(values: &[f64]) -> impl Iterator<Item = [f32; N]> {
    values.chunks_exact(N).map(|row| std::array::from_fn(|i| row[i] as f32))
}

fn triples(values: &[f64]) -> Vec<[f64; 3]> {
    values.chunks_exact(3).map(|row| row.try_into().unwrap()).collect()
}

fn fixture() -> Fixture {
    let default = "target/oracles/gsplat.safetensors";
    let path = std::env::var_os("CENTAUR_GSPLAT_FIXTURE").map_or_else(|| default.into(), PathBuf::from);
    let bytes = std::fs::read(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    let file = SafeTensors::deserialize(&bytes).unwrap();
    let all = |name: &str| values(&file, name);

    let quaternions: Vec<[f32; 4]> = rows(&all("quats")).collect();
    let splats = Splats::new(
        rows(&all("means")).map(Vec3::from_array).collect(),
        quaternions.iter().map(|&[w, x, y, z]| Quat::from_xyzw(x, y, z, w)).collect(),
        rows(&all("log_scales")).map(Vec3::from_array).collect(),
        all("opacity_logits").iter().map(|&o| o as f32).collect(),
        3,
        rows(&all("sh")).collect(),
    )
    .unwrap();
    let background = rows(&all("background")).next().unwrap();
    // gsplat's near plane.
    let composition = Composition { near: 0.01, background, ..Composition::default() };

    let shape = file.tensor("image").unwrap().shape().to_vec();
    let (width, height) = (shape[1], shape[0]);
    let (k, m) = (all("K"), all("viewmat"));
    let intrinsics = Intrinsics { width: width as u32, height: height as u32, fx: k[0], fy: k[4], cx: k[2], cy: k[5] };
    let rotation = DMat3::from_cols_array(&[m[0], m[1], m[2], m[4], m[5], m[6], m[8], m[9], m[10]]).transpose();
    let camera = Camera::new(intrinsics, rotation, DVec3::new(m[3], m[7], m[11])).unwrap();

    // q/|q| does not depend on the norm, so its derivative is proportional to 1/|q|.
    let norms = quaternions.iter().map(|q| q.iter().map(|c| f64::from(*c).powi(2)).sum::<f64>().sqrt());
    let at_unit_norm = |gradient: Vec<f64>| {
        gradient.chunks_exact(4).zip(norms).flat_map(|(g, norm)| [0, 1, 2, 3].map(|i| g[i] * norm)).collect()
    };
    Fixture {
        scene: HybridScene { splats, meshes: vec![], composition },
        camera,
        image: Image {
            width,
            height,
            rgb: triples(&all("image")),
            transmittance: all("alpha").iter().map(|alpha| 1.0 - alpha).collect(),
        },
        cotangent: Image {
            width,
            height,
            rgb: triples(&all("image_gradient")),
            transmittance: vec![0.0; width * height],
        },
        gradients: [
            ("means", all("grad_means")),
            ("rotations", at_unit_norm(all("grad_quats"))),
            ("log-scales", all("grad_log_scales")),
            ("opacity logits", all("grad_opacity_logits")),
            ("SH", all("grad_sh")),
        ],
    }
}

/// Mean absolute difference of colours outside threshold pixels, the number of threshold pixels, and the largest
/// difference in these.
fn compare(found: &[[f64; 3]], expected: &[[f64; 3]], margins: &[Margin], tolerance: &Margin) -> (f64, usize, f64) {
    assert_eq!((found.len(), margins.len()), (expected.len(), expected.len()));
    let (mut sum, mut exempt, mut largest) = (0.0, 0, 0f64);
    for ((a, b), margin) in found.iter().zip(expected).zip(margins) {
        let differences = [0, 1, 2].map(|c| (a[c] - b[c]).abs());
        assert!(differences.iter().all(|d| d.is_finite()));
        if margin.is_within(tolerance) {
            exempt += 1;
            largest = differences.into_iter().fold(largest, f64::max);
        } else {
            sum += differences.iter().sum::<f64>();
        }
    }
    (sum / (3 * (expected.len() - exempt)) as f64, exempt, largest)
}

/// |found − expected| / |expected| over a whole class.
fn relative(found: &[f64], expected: &[f64]) -> f64 {
    assert_eq!(found.len(), expected.len());
    let norm = |v: &mut dyn Iterator<Item = f64>| v.map(|x| x * x).sum::<f64>().sqrt();
    norm(&mut found.iter().zip(expected).map(|(a, b)| a - b)) / norm(&mut expected.iter().copied())
}

#[test]
#[ignore = "needs the gsplat fixture: make test-oracles"]
fn reference_and_gpu_agree_with_gsplat() {
    let Fixture { scene, camera, image, cotangent, gradients } = fixture();
    let pixels = image.rgb.len();
    eprintln!("{} splats, {}×{} pixels", scene.splats.len(), image.width, image.height);

    // Both compute in f64 from the same f32 numbers; the camera's rotation, orthonormalised here, differs by 1e-7.
    let (found, margins) = reference::render_with_margins(&scene, &camera);
    let near = Margin { alpha: 1e-5, order: 1e-6, edge: 0.0, stop: 1e-5 };
    let (mean, exempt, largest) = compare(&found.rgb, &image.rgb, &margins, &near);
    eprintln!("reference: mean abs {mean:.2e}, {exempt} threshold pixels with at most {largest:.2e}");
    assert!(mean < 1e-5, "{mean:e}");
    assert!(exempt * 100 < pixels, "{exempt} of {pixels} pixels are on a threshold");
    let alpha = found.transmittance.iter().zip(&image.transmittance).map(|(a, b)| (a - b).abs()).sum::<f64>();
    assert!(alpha / (pixels as f64) < 1e-5, "alpha {:e}", alpha / pixels as f64);

    let derivatives = reference::backward(&scene, &camera, &cotangent);
    let flat = |v: &[DVec3]| v.iter().flat_map(DVec3::to_array).collect::<Vec<_>>();
    let found = [
        flat(&derivatives.means),
        derivatives.rotations.concat(),
        flat(&derivatives.log_scales),
        derivatives.opacity_logits,
        flat(&derivatives.sh),
    ];
    for (found, (class, expected)) in found.iter().zip(&gradients) {
        let error = relative(found, expected);
        eprintln!("reference: gradient of {class}: relative {error:.2e}");
        assert!(error < 1e-3, "{class}: {error:e}");
    }

    let gpu = Gpu::open(None).unwrap();
    let picture = Renderer::new(&gpu, &scene, &[camera]).unwrap().render(&camera).unwrap();
    let rgb: Vec<_> = picture.rgb.iter().map(|p| p.map(f64::from)).collect();
    // f32 throughout: after projection, alpha has a relative error of up to 1e-5.
    let near = Margin { alpha: 1e-4, order: 1e-6, edge: 0.0, stop: 1e-4 };
    let (mean, exempt, largest) = compare(&rgb, &image.rgb, &margins, &near);
    eprintln!("{}: mean abs {mean:.2e}, {exempt} threshold pixels with at most {largest:.2e}", gpu.adapter());
    assert!(mean < 1e-4, "{mean:e}");
    assert!(exempt * 100 < pixels, "{exempt} of {pixels} pixels are on a threshold");
}
