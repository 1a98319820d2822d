//! Gradients of all parameters, and the statistics of density control.

use glam::{DMat3, DVec3, Vec2, Vec3};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;

use super::{
    FIXED_GRADIENT, MODES, check_gradients, differentiable, gpu_frame, random_cotangent, relative, special_frame,
};
use crate::{
    render::{
        contract::ImageModel,
        gpu::{
            backward::Backward,
            device::{Frame, Gpu},
            pipeline::Pipeline,
            vertices::VertexState,
        },
        reference::{self, Parameters},
        testing,
    },
    scene::{Atlas, Camera, Composition, HybridScene, Intrinsics, Mesh, OrderMode, Splats, Texture, sh},
};

/// Checks the statistics of density control: the norm of the centre's gradient in a picture 2 wide and 2 high, number
/// of views, and weight.
fn check_statistics(found: &[[f32; 4]], expected: &[reference::ScreenStatistics], camera: &Camera) {
    let k = camera.intrinsics();
    let half = 0.5 * k.size();
    assert_eq!(found.len(), expected.len());
    let largest = expected.iter().map(|e| (half * e.center).length()).fold(0.0, f64::max);
    assert!(largest > 0.0 && expected.iter().any(|e| e.weight > 0.1));
    for (i, ([norm, views, weight, _], e)) in found.iter().zip(expected).enumerate() {
        let expected = (half * e.center).length();
        assert!((f64::from(*norm) - expected).abs() <= 1e-3 * expected + 1e-5 * largest, "{i}: {norm} {expected}");
        assert!((f64::from(*weight) - e.weight).abs() <= 1e-3 * e.weight + 1e-4, "{i}: {weight} {}", e.weight);
        assert!(*views == 1.0 || *views == 0.0 && e.weight == 0.0, "{i}: {views} views, weight {}", e.weight);
    }
}

/// All parameter classes, including mips, with and without subgroups. The reference's own gradients are tested by
/// finite differences (`render/reference`); in these scenes no decision is within the reach of f32.
#[test]
fn gradients_equal_the_reference() {
    let restricted = [true, false].map(|subgroups| (Gpu::with_subgroups(subgroups), 6));
    // The kernels for GPUs are slow on a software adapter.
    let without = Gpu::with_subgroups(false);
    let others = [
        (Gpu::open(None).unwrap().posing_as_gpu(), 2),
        (without.posing_as_gpu(), 3),
        (Gpu::open(None).unwrap().narrowed(7), 2),
    ];
    for (gpu, seeds) in restricted.into_iter().chain(others) {
        for seed in 0..seeds {
            let (layers, mode) = ([1, 2, 4][seed as usize % 3], MODES[seed as usize / 2]);
            let (mut scene, camera) = testing::smooth_scene(seed, layers, mode);
            let filled = reference::mesh_layers(&scene, &camera).iter().map(Vec::len).max();
            assert_eq!(filled, Some(layers as usize));
            if seed == 5 {
                scene.meshes.clear();
            }
            if seed == 0 {
                scene.splats = testing::nearly_opaque(&scene.splats, 2);
                let alphas = reference::render_layers(&scene, &camera, ImageModel::Ewa);
                assert!(alphas.transmittance.iter().any(|rest| *rest < 0.01), "no alpha is capped");
            }
            let cotangent = random_cotangent(&camera, seed);
            let slopes: Vec<f64> = (0..camera.intrinsics().pixels()).map(|pixel| (pixel % 4) as f64).collect();
            let (expected, of_splats) =
                reference::backward_parameters(&scene, &camera, &Parameters::of(&scene), &cotangent, Some(&slopes));
            let cotangents = Some((&cotangent, Some(&slopes[..])));
            let (_, found, statistics) = special_frame(&gpu, &scene, &camera, sh::MAX_DEGREE, &[], cotangents);
            check_statistics(&statistics, &of_splats, &camera);
            check_gradients(&found.unwrap(), &expected, &format!("{:?}, scene {seed}", gpu.profile()));
        }
    }
}

/// SH bands that are stored but not yet active are neither visible nor trained; for all stored degrees.
#[test]
fn bands_that_are_not_active_are_as_if_they_were_not_there() {
    let gpu = Gpu::open(None).unwrap();
    let (mut scene, camera) = testing::smooth_scene(3, 1, OrderMode::Stable);
    scene.meshes.clear();
    let cotangent = random_cotangent(&camera, 3);
    let of_degree = |degree: u32| {
        let splats = scene.splats.clone().into_arrays().with_sh_degree(degree).check().unwrap();
        HybridScene { splats, ..scene.clone() }
    };
    for (stored, active) in (1..=sh::MAX_DEGREE).flat_map(|stored| (0..=stored).map(move |active| (stored, active))) {
        let case = format!("degree {active} of {stored}");
        let cotangents = Some((&cotangent, None));
        let (image, found, _) = special_frame(&gpu, &of_degree(stored), &camera, active, &[], cotangents);
        let (fewer, found) = (of_degree(active), found.unwrap());
        let expected = reference::render(&fewer, &camera);
        let pairs = image.rgb.iter().flatten().zip(expected.rgb.iter().flatten());
        let most = testing::largest(pairs.map(|(a, b)| (a - b).abs()));
        // A few wide splats: only rounding differs.
        assert!(most < 1e-5, "{case}: {most:e}");

        let [terms, learnt] = [stored, active].map(sh::coefficients);
        let (mut of_active, mut beyond) = (vec![], vec![]);
        for row in found.sh.chunks_exact(terms) {
            of_active.extend_from_slice(&row[..learnt]);
            beyond.extend_from_slice(&row[learnt..]);
        }
        assert!(beyond.iter().all(|g| *g == DVec3::ZERO), "{case}");
        let found = Parameters { sh: of_active, ..found };
        check_gradients(&found, &reference::backward(&fewer, &camera, &cotangent), &case);
    }
}

/// A small triangle whose corners have equal UVs, with the largest gradients, must not make the gradients of the wall
/// around it coarser.
#[test]
fn a_face_at_one_place_of_the_map_leaves_others_their_gradients() {
    const SIDE: usize = 64;
    let k = Intrinsics { width: 320, height: 240, fx: 300.0, fy: 300.0, cx: 160.3, cy: 119.6 };
    let camera = Camera::new(k, DMat3::IDENTITY, DVec3::ZERO).unwrap();
    let mut rng = Pcg32::seed_from_u64(7);
    let texels = (0..4 * SIDE * SIDE).map(|_| rng.random_range(-0.5..0.5_f32)).collect();
    let atlas = Atlas::new(Texture::new(SIDE as u32, SIDE as u32, 4, texels).unwrap(), None).unwrap();
    let wall = [[-3.0, -3.0], [3.0, -3.0], [3.0, 3.0], [-3.0, 3.0]].map(|[x, y]| Vec3::new(x, y, 4.0));
    let face = [[0.31, 0.22], [0.55, 0.27], [0.4, 0.47]].map(|[x, y]| Vec3::new(x, y, 3.0));
    let uv = |v: usize| Vec2::new(0.4 + 0.12 * wall[v].x, 0.5 + 0.15 * wall[v].y);
    let uvs = vec![[0, 1, 2].map(uv), [0, 2, 3].map(uv), [Vec2::splat(0.95); 3]];
    let triangles = vec![[0, 1, 2], [0, 2, 3], [4, 5, 6]];
    let meshes = vec![Mesh::new([&wall[..], &face].concat(), triangles, uvs, atlas).unwrap()];
    let composition = Composition { layers: 1, ..Composition::default() };
    let scene = HybridScene { splats: Splats::empty(0), meshes, composition };
    let mut cotangent = random_cotangent(&camera, 3);
    let mut pixels_of_face = 0;
    for (rgb, layers) in cotangent.rgb.iter_mut().zip(reference::mesh_layers(&scene, &camera)) {
        let is_face = layers[0].depth < 3.5;
        *rgb = if is_face { [1.0; 3] } else { rgb.map(|g| 0.05 * g) };
        pixels_of_face += usize::from(is_face);
    }
    assert!((200..400).contains(&pixels_of_face), "{pixels_of_face}");
    // The wall does not cover the last columns of the map.
    let of_wall = |p: &Parameters| -> Vec<f64> {
        p.base[0].iter().enumerate().filter(|(i, _)| i / 4 % SIDE < 54).map(|(_, g)| *g).collect()
    };
    let expected = of_wall(&reference::backward(&scene, &camera, &cotangent));
    for gpu in [Gpu::open(None).unwrap(), Gpu::open(None).unwrap().posing_as_gpu()] {
        let found = of_wall(&gpu_frame(&gpu, &scene, &camera, Some(&cotangent)).1.unwrap());
        let error = relative(found.into_iter(), expected.iter().copied());
        eprintln!("{:?}: {error:.1e}", gpu.profile());
        assert!(error < FIXED_GRADIENT, "{:?}: relative error {error:e}", gpu.profile());
    }
}

/// The sums over pixels of |∂L/∂u| and |∂L/∂v| equal those of single-pixel cotangents added up. One kind of kernels
/// computes these, since there are thousands.
#[test]
fn absolute_gradients_are_those_of_every_pixel_alone() {
    let mut expected: Option<Vec<[f64; 2]>> = None;
    for (subgroups, poses) in [(true, false), (false, false), (true, true), (false, true)] {
        let gpu = Gpu::with_subgroups(subgroups);
        let gpu = if poses { gpu.posing_as_gpu() } else { gpu };
        let (scene, camera) = testing::smooth_scene(3, 2, OrderMode::Stable);
        let (cotangent, n) = (random_cotangent(&camera, 3), scene.splats.len());
        let frame = |(pipeline, backward): &mut (Pipeline, Backward), only: Option<usize>| -> Vec<f32> {
            let view = pipeline.prepare(&gpu, &camera).unwrap();
            let kept = |(p, g): (usize, &[f64; 3])| {
                let g = if only.is_none_or(|only| only == p) { *g } else { [0.0; 3] };
                [g[0] as f32, g[1] as f32, g[2] as f32, 0.0]
            };
            let words: Vec<f32> = cotangent.rgb.iter().enumerate().flat_map(kept).collect();
            gpu.write(&backward.image_gradient, 0, &words);
            let mut frame = Frame::new(&gpu);
            pipeline.record(&gpu, &mut frame, &view);
            backward.record(&mut frame, pipeline, &view);
            frame.submit();
            let (sums, row) = backward.sums();
            gpu.read(sums, n * row).unwrap()
        };
        let mut plain = differentiable(&gpu, &scene, &camera, false);
        let expected = expected.get_or_insert_with(|| {
            let mut sums = vec![[0.0_f64; 2]; n];
            for p in 0..cotangent.rgb.len() {
                let of_pixel = frame(&mut plain, Some(p));
                let projected: Vec<f32> = gpu.read(&plain.0.front.lists.projected, 12 * n).unwrap();
                for (i, sum) in sums.iter_mut().enumerate() {
                    let (s, q) = (&of_pixel[10 * i..], &projected[12 * i + 4..]);
                    sum[0] += f64::from(q[0] * s[1] - q[1] * q[2] * s[2]).abs();
                    sum[1] += f64::from(q[2] * s[2]).abs();
                }
            }
            sums
        });
        let all = frame(&mut plain, None);
        let mut absolute = differentiable(&gpu, &scene, &camera, true);
        let found = frame(&mut absolute, None);
        let statistics: Vec<f32> = gpu.read(&absolute.1.splats.statistics, 4 * n).unwrap();
        let k = camera.intrinsics();
        for (i, &[u, v]) in expected.iter().enumerate() {
            let row = &found[12 * i..12 * (i + 1)];
            for (found, expected) in row[10..].iter().zip([u, v]) {
                assert!((f64::from(*found) - expected).abs() <= 1e-4 * expected + 1e-7, "{i}: {found} {expected}");
            }
            let same = row[..10].iter().zip(&all[10 * i..]).all(|(a, b)| (a - b).abs() <= 1e-4 * b.abs() + 1e-6);
            assert!(same, "{i}: {row:?}");
            let norm = (0.5 * f64::from(k.width) * u).hypot(0.5 * f64::from(k.height) * v);
            assert!((f64::from(statistics[4 * i + 3]) - norm).abs() <= 1e-3 * norm + 1e-6, "{i}");
            assert!(statistics[4 * i + 3] >= statistics[4 * i], "{i}: what is absolute does not cancel");
        }
    }
}

/// Along the normals of free vertices, including mips and view dependence, but excluding the changes of these.
#[test]
fn vertex_gradients_equal_the_reference() {
    for subgroups in [true, false] {
        let gpu = Gpu::with_subgroups(subgroups);
        for seed in 0..4 {
            let (scene, camera) = testing::smooth_scene(seed, [1, 2, 4, 1][seed as usize], MODES[seed as usize % 3]);
            let cotangent = random_cotangent(&camera, seed);
            let expected = reference::backward(&scene, &camera, &cotangent).positions;
            let (mut pipeline, backward) = differentiable(&gpu, &scene, &camera, false);
            let state = VertexState::new(&scene.meshes, 1.0);
            let mesh = pipeline.front.mesh.as_mut().unwrap();
            mesh.free_vertices(&gpu, &scene.meshes, &pipeline.front.view, &backward.status, &state).unwrap();
            let view = pipeline.prepare(&gpu, &camera).unwrap();
            let words: Vec<f32> =
                cotangent.rgb.iter().flat_map(|g| [g[0], g[1], g[2], 0.0].map(|v| v as f32)).collect();
            gpu.write(&backward.image_gradient, 0, &words);
            let mut frame = Frame::new(&gpu);
            pipeline.record(&gpu, &mut frame, &view);
            backward.record(&mut frame, &pipeline, &view);
            pipeline.front.mesh.as_ref().unwrap().record_vertex_backward(&mut frame);
            frame.submit();
            let found = pipeline.front.mesh.as_ref().unwrap().read_vertex_gradient(&gpu).unwrap();
            let normals = state.normals.chunks_exact(3).map(|n| Vec3::from_slice(n).as_dvec3());
            let expected = expected.iter().flatten().zip(normals).map(|(g, n)| g.dot(n));
            let error = relative(found.into_iter().map(f64::from), expected);
            eprintln!("subgroups {subgroups}, scene {seed}: {error:.1e}");
            assert!(error < FIXED_GRADIENT, "scene {seed}: relative error {error:e}");
        }
    }
}
