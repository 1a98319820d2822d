//! Renderings by layers compared with the reference, for both image models.

use glam::{DMat3, DVec3, Quat, Vec2, Vec3};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;

use super::{Gpu, LayeredPicture, LayeredRenderer, Renderer};
use crate::edit::Similarity;
use crate::render::contract::{ImageModel, ShDirection};
use crate::render::reference::{self, Layers};
use crate::render::testing;
use crate::scene::testing::ahead;
use crate::scene::{Atlas, Camera, Composition, HybridScene, Intrinsics, Mesh, OrderMode, Splats, Texture};

const BY_MEAN: ImageModel = ImageModel::Ray(ShDirection::Mean);
const BY_RAY: ImageModel = ImageModel::Ray(ShDirection::Ray);
const MODES: [OrderMode; 3] = [OrderMode::Stable, OrderMode::SurfaceConsistent, OrderMode::Direct];

/// PSNR of a set of values for a peak of 1, and the pixels that differ by more than 1e-2.
struct Agreement {
    psnr: f64,
    differing: usize,
}

fn agreement<const N: usize>(found: &[[f32; N]], expected: &[[f64; N]]) -> Agreement {
    assert_eq!(found.len(), expected.len());
    let (mut squares, mut differing) = (0.0, 0);
    for (f, e) in found.iter().zip(expected) {
        let worst = testing::largest(f.iter().zip(e).map(|(f, e)| (f64::from(*f) - e).abs()));
        assert!(worst.is_finite());
        squares += f.iter().zip(e).map(|(f, e)| (f64::from(*f) - e).powi(2)).sum::<f64>();
        differing += usize::from(worst > 1e-2);
    }
    let mean = squares / (found.len() * N).max(1) as f64;
    Agreement { psnr: -10.0 * mean.max(1e-20).log10(), differing }
}

fn columns<T: Copy>(values: &[T]) -> Vec<[T; 1]> {
    values.iter().map(|v| [*v]).collect()
}

fn pictures(gpu: &Gpu, scene: &HybridScene, camera: &Camera, model: ImageModel) -> (LayeredPicture, Layers) {
    let found = LayeredRenderer::new(gpu, scene, &[*camera], model).unwrap().render(camera).unwrap();
    (found, reference::render_layers(scene, camera, model))
}

/// Allowed relative error of depths, and error of normals.
const DEPTH: f64 = 1e-4;
const NORMAL: f64 = 1e-4;
/// One in this many pixels may differ by more, or count other splats: at edges and cut-offs, depths, normals and counts
/// are discontinuous.
const DECIDED_OTHERWISE: usize = 100;

/// Which pixels differ from the expected values by more than `bound` of these.
fn off<const N: usize>(found: &[[f32; N]], expected: &[[f64; N]], bound: impl Fn(&[f64; N]) -> f64) -> Vec<bool> {
    assert_eq!(found.len(), expected.len());
    let is_off = |(f, e): (&[f32; N], &[f64; N])| {
        let worst = testing::largest(f.iter().zip(e).map(|(f, e)| (f64::from(*f) - e).abs()));
        worst.is_nan() || worst > bound(e)
    };
    found.iter().zip(expected).map(is_off).collect()
}

/// Every part of both models agrees to 80 dB over all pixels, including those at thresholds: a splat that only one of
/// the two cuts at 1/255 is a difference of at most 1/255.
#[test]
fn parts_equal_the_reference() {
    // Also for hardware adapters, which have other kernels: with all modes, without a mesh, and with one, two and four
    // layers.
    let [own, hardware] = [Gpu::open(None).unwrap(), Gpu::open(None).unwrap().posing_as_gpu()];
    let seeds = (0..18_u64).map(|seed| (seed, &own)).chain([3, 5, 7, 11].map(|seed| (seed, &hardware)));
    for (seed, gpu) in seeds {
        let n = [40, 300, 1500][seed as usize % 3];
        let (n_meshes, layers) = ([1, 0, 3, 2][seed as usize % 4], [1, 4, 2][seed as usize / 2 % 3]);
        let mode = MODES[seed as usize / 3 % 3];
        let (scene, camera) = testing::random_scene(seed, n, n_meshes, (seed % 4) as u32, layers, mode);
        for model in [ImageModel::Ewa, BY_MEAN, BY_RAY] {
            let (found, expected) = pictures(gpu, &scene, &camera, model);
            let background = scene.composition.background;
            let beauty = agreement(&found.over(background), &expected.over(background));
            let splats = agreement(&found.splats, &expected.splats);
            let mesh = agreement(&found.mesh, &expected.mesh);
            let count: Vec<f64> = expected.count.iter().map(|c| f64::from(*c)).collect();
            let of_itself = |depth: &[f64; 1]| DEPTH * depth[0];
            let jumps = [
                off(&found.normal, &expected.normal, |_| NORMAL),
                off(&columns(&found.expected_depth), &columns(&expected.expected_depth), of_itself),
                off(&columns(&found.median_depth), &columns(&expected.median_depth), of_itself),
                off(&columns(&found.count), &columns(&count), |_| 0.0),
            ];
            let pixels = found.splats.len();
            let decided_otherwise = (0..pixels).filter(|i| jumps.iter().any(|off| off[*i])).count();
            eprintln!(
                "scene {seed}, {n} splats, {n_meshes} meshes, {model:?}: beauty {:.1} dB ({} of {pixels} px > 0.01), splats \
                 {:.1}, mesh {:.1}; normals, depths, medians, counts off in {:?} px, any of them in {decided_otherwise}",
                beauty.psnr,
                beauty.differing,
                splats.psnr,
                mesh.psnr,
                jumps.each_ref().map(|off| off.iter().filter(|off| **off).count()),
            );
            assert!(beauty.psnr > 80.0 && splats.psnr > 80.0 && mesh.psnr > 80.0);
            assert!(decided_otherwise * DECIDED_OTHERWISE <= pixels, "{decided_otherwise} of {pixels}");
        }
    }
}

/// The picture of `Renderer` is the sum of its parts, up to contributions that the layered rendering finds only after
/// the stop at a transmittance of 1e-4.
#[test]
fn parts_sum_to_the_picture() {
    let gpu = Gpu::open(None).unwrap();
    for (seed, mode) in MODES.into_iter().enumerate() {
        let (scene, camera) = testing::random_scene(40 + seed as u64, 1500, 2, 2, 2, mode);
        let whole = Renderer::new(&gpu, &scene, &[camera]).unwrap().render(&camera).unwrap();
        let parts = LayeredRenderer::new(&gpu, &scene, &[camera], ImageModel::Ewa).unwrap().render(&camera).unwrap();
        let sum = parts.over(scene.composition.background);
        let differences = sum.as_flattened().iter().zip(whole.rgb.as_flattened()).map(|(a, b)| (a - b).abs());
        let (sum, most) = differences.fold((0.0, 0.0_f32), |(sum, most), d| (sum + d, most.max(d)));
        let mean = sum / (3 * whole.rgb.len()) as f32;
        eprintln!("{mode:?}: mean {mean:.1e}, max {most:.1e}");
        // Three buckets, with colours up to about 2.
        assert!(mean < 1e-6 && most < 6e-4, "{mean:e}, {most:e}");
    }
}

/// Needles and plates with aspect ratios up to 1 to 1000, most of them seen edge-on somewhere in a view of 120°, some
/// around the camera's plane. Much thinner ones fall between pixels, where f32 cannot decide whether a ray meets them.
#[test]
fn thin_splats_and_splats_beside_the_camera_equal_the_reference() {
    let gpu = Gpu::open(None).unwrap();
    let k = Intrinsics { width: 128, height: 96, fx: 37.0, fy: 41.0, cx: 50.0, cy: 47.0 };
    let camera = Camera::new(k, DMat3::from_rotation_y(0.3), DVec3::new(0.1, -0.2, 0.3)).unwrap();
    let mut rng = Pcg32::seed_from_u64(11);
    let (mut means, mut rotations, mut scales, mut logits, mut sh) = (vec![], vec![], vec![], vec![], vec![]);
    for i in 0..400 {
        let z = rng.random_range(0.25..6.0_f64);
        let p = DVec3::new(rng.random_range(-2.0..2.0) * z, rng.random_range(-1.5..1.5) * z, z);
        means.push((camera.rotation().transpose() * (p - camera.translation())).as_vec3());
        rotations.push(Quat::from_array([0; 4].map(|_| rng.random_range(-1.0..1.0_f32))));
        let (wide, thin) = (rng.random_range(0.05..0.5_f32), 10_f32.powf(rng.random_range(-3.5..-2.0)));
        let scale = if i % 2 == 0 { Vec3::new(wide, thin, 2.0 * thin) } else { Vec3::new(wide, thin, 0.7 * wide) };
        scales.push(scale.map(f32::ln));
        logits.push(rng.random_range(-3.0..4.0));
        sh.push([0; 3].map(|_| rng.random_range(-1.5..1.5_f32)));
    }
    let splats = Splats::new(means, rotations, scales, logits, 0, sh).unwrap();
    let scene = HybridScene { splats, meshes: vec![], composition: Composition::default() };
    let (found, expected) = pictures(&gpu, &scene, &camera, BY_MEAN);
    let beauty = agreement(&found.over([0.0; 3]), &expected.over([0.0; 3]));
    let covered = expected.transmittance.iter().filter(|t| **t < 0.9).count();
    eprintln!("{:.1} dB, {} of {} px > 0.01, {covered} covered", beauty.psnr, beauty.differing, found.splats.len());
    assert!(beauty.psnr > 80.0 && covered * 2 > found.splats.len());
}

/// Mean absolute difference.
fn difference(found: &[f32], expected: &[f32]) -> f32 {
    assert_eq!(found.len(), expected.len());
    found.iter().zip(expected).map(|(f, e)| (f - e).abs()).sum::<f32>() / found.len() as f32
}

/// So small or so large, also relative to the near plane, that products of three lengths, or depths as sort keys, are
/// out of range. Rounding differs, as the units are no powers of two.
#[test]
fn pictures_are_the_same_in_all_units_of_length() {
    const MODELS: [ImageModel; 2] = [ImageModel::Ewa, BY_RAY];
    let gpu = Gpu::open(None).unwrap();
    let (scene, camera) = testing::random_scene(41, 1500, 2, 2, 2, OrderMode::SurfaceConsistent);
    let whole = |scene: &HybridScene, camera: &Camera| {
        let mut renderer = Renderer::new(&gpu, scene, &[*camera]).unwrap();
        (renderer.render(camera).unwrap().rgb.into_flattened(), renderer.median_depth(camera).unwrap())
    };
    let parts = |scene: &HybridScene, camera: &Camera| {
        MODELS.map(|model| LayeredRenderer::new(&gpu, scene, &[*camera], model).unwrap().render(camera).unwrap())
    };
    let ((picture, depths), in_parts) = (whole(&scene, &camera), parts(&scene, &camera));
    for (unit, near) in [(1e-30, None), (1e-9, None), (1e-6, None), (1e20, None), (1e5, Some(1e-6))] {
        let to = Similarity::new(unit, DMat3::IDENTITY, DVec3::ZERO).unwrap();
        let (mut scene, camera) = (to.scene(scene.clone()).unwrap(), to.camera(&camera).unwrap());
        scene.composition.near = near.unwrap_or(scene.composition.near);
        let depth = |depths: &[f32]| depths.iter().map(|z| (f64::from(*z) / unit) as f32).collect::<Vec<_>>();
        let (found, found_depths) = whole(&scene, &camera);
        let mut off = vec![difference(&found, &picture), difference(&depth(&found_depths), &depths)];
        for (found, expected) in parts(&scene, &camera).iter().zip(&in_parts) {
            off.extend([
                difference(found.splats.as_flattened(), expected.splats.as_flattened()),
                difference(found.mesh.as_flattened(), expected.mesh.as_flattened()),
                difference(found.normal.as_flattened(), expected.normal.as_flattened()),
                difference(&depth(&found.expected_depth), &expected.expected_depth),
                difference(&depth(&found.median_depth), &expected.median_depth),
            ]);
        }
        eprintln!("{unit:e}: {off:?}");
        // Of depths up to 7, a pixel or two of 6,912 may have another.
        assert!(off.iter().all(|off| *off < 2e-3), "{unit:e}: {off:?}");
    }
}

/// More peaks in a pixel than one search can hold.
#[test]
fn deep_stacks_are_searched_in_parts() {
    let gpu = Gpu::open(None).unwrap();
    let (mut scene, camera) = testing::random_scene(5, 1500, 1, 0, 1, OrderMode::Direct);
    let logits: Vec<f32> = (0..1500).map(|i| -2.5 + 0.5 * (i as f32).sin()).collect();
    let s = &scene.splats;
    let wide: Vec<Vec3> = s.log_scales().iter().map(|s| *s + 1.7).collect();
    scene.splats = Splats::new(s.means().to_vec(), s.rotations().to_vec(), wide, logits, 0, s.sh().to_vec()).unwrap();
    let (found, expected) = pictures(&gpu, &scene, &camera, BY_MEAN);
    let deepest = expected.count.iter().max().copied().unwrap_or_default();
    let beauty = agreement(&found.over([0.0; 3]), &expected.over([0.0; 3]));
    eprintln!("{:.1} dB, up to {deepest} peaks a pixel", beauty.psnr);
    assert!(beauty.psnr > 80.0 && deepest > 64);
}

/// `n` splats in a corner of the only tile, in front of 80 translucent ones that cover it, among the meshes of a random
/// scene.
fn crowded(n: usize) -> (HybridScene, Camera) {
    let camera = ahead([16, 16], 16.0, DVec3::ZERO);
    let (mut scene, _) = testing::random_scene(3, 1, 1, 0, 4, OrderMode::Stable);
    let is_wide = |i: usize| i >= n;
    let mean =
        |i| if is_wide(i) { Vec3::new(0.0, 0.0, 2.0 + 1e-3 * (i - n) as f32) } else { Vec3::new(-0.9, -0.9, 1.99) };
    let all = 0..n + 80;
    let scales = all.clone().map(|i| Vec3::splat(if is_wide(i) { 0.6_f32 } else { 0.01 }.ln())).collect();
    let logits = all.clone().map(|i| if is_wide(i) { -3.0 } else { 0.0 }).collect();
    let colors = all.clone().map(|i| [(i % 7) as f32 * 0.1, 0.3, -0.2]).collect();
    let means = all.clone().map(mean).collect();
    scene.splats = Splats::new(means, vec![Quat::IDENTITY; n + 80], scales, logits, 0, colors).unwrap();
    (scene, camera)
}

/// Mesa's software adapter ends loops after 65,535 iterations of a thread in total: 80 peaks need six searches, and
/// four layers five passes.
#[test]
fn full_tiles_are_blended_to_their_end() {
    let gpu = Gpu::open(None).unwrap();
    let (scene, camera) = crowded(14_000);
    for model in [ImageModel::Ewa, BY_MEAN, BY_RAY] {
        let (found, expected) = pictures(&gpu, &scene, &camera, model);
        let [splats, count] = [
            agreement(&found.splats, &expected.splats),
            agreement(
                &columns(&found.count),
                &columns(&expected.count.iter().map(|c| f64::from(*c)).collect::<Vec<_>>()),
            ),
        ];
        let covered = expected.transmittance.iter().filter(|t| **t < 0.1).count();
        eprintln!(
            "{model:?}: splats {:.1} dB, counts differ in {} of 256, {covered} covered",
            splats.psnr, count.differing
        );
        assert!(splats.psnr > 80.0 && count.differing < 3 && covered > 50);
    }
    let (gpu, (scene, camera)) = (gpu.posing_as_cpu(), crowded(60_000));
    let error = LayeredRenderer::new(&gpu, &scene, &[camera], BY_MEAN).unwrap().render(&camera).unwrap_err();
    assert!(error.to_string().contains("has 60080 splats, and"), "{error}");
}

/// Triangles that cover all 129,600 bins, more than the iterations of a loop on Mesa's software adapter, and a splat
/// that covers all 32,400 tiles.
#[test]
fn large_pictures_are_covered_to_their_end() {
    let gpu = Gpu::open(None).unwrap();
    let camera = ahead([3840, 2160], 1920.0, DVec3::ZERO);
    let corners = vec![Vec3::new(-20.0, -20.0, 3.0), Vec3::new(40.0, -20.0, 3.0), Vec3::new(-20.0, 40.0, 3.0)];
    let uvs = vec![[Vec2::ZERO, Vec2::X, Vec2::Y]];
    let atlas = Atlas::new(Texture::new(1, 1, 4, vec![0.5, 0.5, 0.5, 0.0]).unwrap(), None).unwrap();
    let mesh = Mesh::new(corners, vec![[0, 1, 2]], uvs, atlas).unwrap();
    let splats = Splats::new(
        vec![Vec3::new(0.0, 0.0, 2.0)],
        vec![Quat::IDENTITY],
        vec![Vec3::new(4.0_f32.ln(), 4.0_f32.ln(), -5.0)],
        vec![0.0],
        0,
        vec![[1.0; 3]],
    );
    let composition = Composition { layers: 1, ..Composition::default() };
    let scene = HybridScene { splats: splats.unwrap(), meshes: vec![mesh], composition };
    let picture = Renderer::new(&gpu, &scene, &[camera]).unwrap().render(&camera).unwrap();
    // The mesh has an opacity of one half; the splat still has 0.3 or more in the corners.
    let bare = picture.transmittance.iter().filter(|t| **t > 0.4).count();
    assert_eq!(bare, 0, "of {} pixels", picture.transmittance.len());
}
