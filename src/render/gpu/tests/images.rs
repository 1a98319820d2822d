//! Images, their limits, and those that are refused.

use glam::{DVec3, Vec3};

use super::{DECIDED_OTHERWISE, Excused, MEAN, MODES, MOST, compare, gpu_frame};
use crate::{
    render::{
        contract::ImageModel,
        gpu::{GpuError, LayeredRenderer, Renderer, device::Gpu},
        reference::{self, Margin},
        testing,
    },
    scene::{Atlas, Camera, Composition, HybridScene, Mesh, OrderMode, Texture},
};

#[test]
fn images_equal_the_reference() {
    let gpu = Gpu::open(None).unwrap();
    let hardware = [true, false].map(|subgroups| Gpu::open_restricted(None, subgroups).unwrap().posing_as_gpu());
    let (mut pixels, mut all, mut worst) = (0, Excused::default(), [0.0_f64; 2]);
    for seed in 0..54_usize {
        // All combinations of splat counts, layer counts and modes; mesh counts and degrees are cycled independently
        // beside them.
        let (size, rule) = (seed % 6, seed / 6);
        let n = [0, 1, 40, 300, 1500, 5000][size];
        let (layers, mode) = ([1, 2, 4][rule % 3], MODES[rule / 3]);
        // A single splat could lie outside of the picture.
        let n_meshes = if n > 1 { [1, 2, 0, 3][(size + rule) % 4] } else { 1 + (rule + rule / 3) % 3 };
        let sh_degree = ((size + rule / 2) % 4) as u32;
        let (scene, camera) = testing::random_scene(seed as u64, n, n_meshes, sh_degree, layers, mode);
        let (found, _) = gpu_frame(&gpu, &scene, &camera, None);
        assert!(found.transmittance.iter().any(|rest| *rest < 0.9), "scene {seed} shows nothing");
        let (mean, most, excused) = compare(&found, &scene, &camera);
        // The kernels for hardware, with lists longer than what they read at once.
        if n == 1500 {
            let (found, _) = gpu_frame(&hardware[rule % 2], &scene, &camera, None);
            let (mean, most, _) = compare(&found, &scene, &camera);
            assert!(mean < MEAN && most < MOST, "scene {seed} by those of hardware: mean {mean:e}, max {most:e}");
        }
        eprintln!(
            "scene {seed}: {n} splats, {n_meshes} meshes, degree {sh_degree}, {layers} layers, {mode:?}: mean {mean:.2e}, max {most:.2e}, \
             {} threshold pixels of {}",
            excused.pixels,
            found.rgb.len()
        );
        assert!(mean < MEAN && most < MOST, "scene {seed}: mean {mean:e}, max {most:e}");
        worst = [worst[0].max(mean), worst[1].max(most)];
        pixels += found.rgb.len();
        all.pixels += excused.pixels;
        all.differing += excused.differing;
        all.by_kind.iter_mut().zip(excused.by_kind).for_each(|(sum, count)| *sum += count);
    }
    eprintln!(
        "54 scenes: mean at most {:.1e}, max {:.1e}; {} of {pixels} pixels are threshold pixels, {} of which differ, by {:?} {:?}",
        worst[0],
        worst[1],
        all.pixels,
        all.differing,
        Margin::KINDS,
        all.by_kind
    );
    // Twice the actual number.
    assert!(all.pixels * 35 < pixels, "{} of {pixels} pixels are threshold pixels", all.pixels);
    assert!(
        DECIDED_OTHERWISE * all.differing < all.pixels,
        "{} of {} threshold pixels differ",
        all.differing,
        all.pixels
    );
}

/// The paper's figure, as in the reference (`two_rays_disagree_in_direct_order_only`), in f32.
#[test]
fn two_rays_disagree_in_direct_order_only() {
    let gpu = Gpu::open(None).unwrap();
    let (hidden, shown) = (0.499950, 0.923665);
    for (mode, expected) in MODES.into_iter().zip([[hidden, hidden], [hidden, hidden], [hidden, shown]]) {
        let (scene, camera, pixels) = testing::two_rays(mode);
        let (image, _) = gpu_frame(&gpu, &scene, &camera, None);
        for (pixel, expected) in pixels.into_iter().zip(expected) {
            assert!((image.rgb[pixel][0] - expected).abs() < 1e-5, "{mode:?}: {}", image.rgb[pixel][0]);
        }
    }
}

/// An unsupported request is an error, after which the renderer still works.
#[test]
fn a_picture_larger_than_announced_is_refused() {
    let gpu = Gpu::open(None).unwrap();
    let (scene, camera) = testing::random_scene(2, 100, 1, 1, 2, OrderMode::Stable);
    let k = *camera.intrinsics();
    let (width, height) = (4 * k.width, 4 * k.height);
    let large = camera.resized(width, height);
    let mut renderer = Renderer::new(&gpu, &scene, &[camera]).unwrap();
    let before = renderer.render(&camera).unwrap();
    let refused = renderer.render(&large).unwrap_err();
    assert!(
        matches!(refused, GpuError::ImageTooLarge { .. })
            && refused.to_string().ends_with(&format!("{width}×{height}")),
        "{refused}"
    );
    assert_eq!(renderer.render(&camera).unwrap().rgb, before.rgb);
    let mut layered = LayeredRenderer::new(&gpu, &scene, &[camera], ImageModel::Ewa).unwrap();
    assert!(matches!(layered.render(&large), Err(GpuError::ImageTooLarge { .. })));
    assert!(layered.render(&camera).is_ok());
    let composition = Composition { layers: 3, ..scene.composition };
    let scene = HybridScene { composition, ..scene };
    assert!(matches!(Renderer::new(&gpu, &scene, &[camera]), Err(GpuError::Scene(_))));
}

/// Like images that need more than 65,535 workgroups in a dispatch.
#[test]
fn folded_dispatches_equal_the_reference() {
    let gpu = Gpu::open(None).unwrap().narrowed(7);
    for seed in 30..33 {
        let (scene, camera) = testing::random_scene(seed, 1500, 1, 1, 2, OrderMode::Stable);
        let (found, _) = gpu_frame(&gpu, &scene, &camera, None);
        let (mean, most, _) = compare(&found, &scene, &camera);
        assert!(mean < MEAN && most < MOST, "scene {seed}: mean {mean:e}, max {most:e}");
    }
}

/// A near plane of a foreign file that is practically 0, with a scene far from it.
#[test]
fn depths_are_ordered_far_from_a_tiny_near_plane() {
    let gpu = Gpu::open(None).unwrap();
    let (mut scene, camera) = testing::random_scene(3, 500, 0, 1, 2, OrderMode::Stable);
    let mut arrays = scene.splats.into_arrays();
    arrays.means.iter_mut().for_each(|mean| *mean *= 1000.0);
    arrays.log_scales.iter_mut().for_each(|scale| *scale += 1000f32.ln());
    scene.splats = arrays.check().unwrap();
    scene.composition.near = 1e-8;
    let camera = Camera::new(*camera.intrinsics(), camera.rotation(), 1000.0 * camera.translation()).unwrap();
    let (found, _) = gpu_frame(&gpu, &scene, &camera, None);
    let (mean, most, _) = compare(&found, &scene, &camera);
    assert!(mean < MEAN && most < MOST, "mean {mean:e}, max {most:e}");
}

/// Like models in geographic coordinates, at a thousand times their own size from the origin.
#[test]
fn scenes_far_from_the_origin_equal_the_reference() {
    let gpu = Gpu::open(None).unwrap();
    let offset = DVec3::new(8192.3, -4096.7, 5000.1);
    for seed in 0..3 {
        let (scene, camera) = testing::random_scene(seed, 500, 1, 1, 2, OrderMode::SurfaceConsistent);
        let moved = |p: Vec3| (p.as_dvec3() + offset).as_vec3();
        let mut arrays = scene.splats.into_arrays();
        arrays.means.iter_mut().for_each(|mean| *mean = moved(*mean));
        let meshes = scene.meshes.iter().map(|mesh| {
            let positions = mesh.positions().iter().copied().map(moved).collect();
            Mesh::new(positions, mesh.triangles().to_vec(), mesh.corner_uvs().to_vec(), mesh.atlas().clone()).unwrap()
        });
        let meshes = meshes.collect();
        let scene = HybridScene { splats: arrays.check().unwrap(), meshes, composition: scene.composition };
        let translation = camera.translation() - camera.rotation() * offset;
        let camera = Camera::new(*camera.intrinsics(), camera.rotation(), translation).unwrap();
        let (found, _) = gpu_frame(&gpu, &scene, &camera, None);
        let (mean, most, _) = compare(&found, &scene, &camera);
        assert!(mean < MEAN && most < MOST, "scene {seed}: mean {mean:e}, max {most:e}");
    }
}

#[test]
fn transparent_and_opaque_meshes_are_limits() {
    let gpu = Gpu::open(None).unwrap();
    for mode in MODES {
        let (scene, camera) = testing::random_scene(11, 800, 2, 1, 2, mode);
        let with_opacity = |logit: f32| {
            let mut scene = scene.clone();
            for mesh in &mut scene.meshes {
                let base = mesh.atlas().base();
                let texels = base.texels().chunks_exact(4).flat_map(|t| [t[0], t[1], t[2], logit]).collect();
                let base = Texture::new(base.width(), base.height(), 4, texels).unwrap();
                let atlas = Atlas::new(base, mesh.atlas().bands().cloned()).unwrap();
                *mesh = mesh.clone().with_atlas(atlas);
            }
            gpu_frame(&gpu, &scene, &camera, None).0
        };
        let without = gpu_frame(&gpu, &HybridScene { meshes: vec![], ..scene.clone() }, &camera, None).0;
        // The other modes change the order of splats around a layer even if it is transparent; see
        // `contract::thresholds`.
        if mode == OrderMode::Direct {
            // The order of splats is kept, but the transmittance in front of a bucket is known only at its end, so the
            // stop at 1e-4 can come some splats later: colours (up to 2 here) differ by at most that.
            for (a, b) in with_opacity(-100.0).rgb.iter().flatten().zip(without.rgb.iter().flatten()) {
                assert!((a - b).abs() < 2e-4, "{a} {b}");
            }
        }
        let opaque = with_opacity(100.0);
        for (layers, (rest, free)) in
            reference::mesh_layers(&scene, &camera).iter().zip(opaque.transmittance.iter().zip(&without.transmittance))
        {
            // An opaque layer leaves a transmittance of 1e-4.
            assert!(if layers.is_empty() { (rest - free).abs() < 1e-4 } else { *rest < 1.1e-4 });
        }
    }
}
