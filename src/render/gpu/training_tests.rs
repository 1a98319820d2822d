//! Steps of training: what they learn, and what they must not change.

use glam::{DMat3, DVec3, Quat, Vec2, Vec3};

use super::{
    Gpu,
    adam::{AdamStep, SplatRates},
    exposure::{ExposureState, ExposureStep},
    geometry::{GEOMETRY_FLOATS, OPACITY},
    photographs::Truth,
    pose::{PoseState, PoseStep},
    rows::Source,
    state::{SplatState, logit, sigmoid},
    texels::TexelStep,
    training::{Show, Step, Training},
    vertices::{VertexState, VertexStep},
    view::Dropout,
};
use crate::{
    edit::Similarity,
    render::{
        reference::{self, Image, Parameters},
        testing,
    },
    scene::{
        Atlas, Camera, Composition, HybridScene, Intrinsics, Mesh, OrderMode, Splats, Texture, gather, sh,
        testing::{ahead, alike},
    },
};

pub(super) const SIDE: u32 = 256;

pub(super) fn camera(distance: f64) -> Camera {
    ahead([SIDE, SIDE], f64::from(SIDE), -distance * DVec3::Z)
}

/// `n` splats and `triangles` triangles, each of which covers the whole image.
pub(super) fn scene(n: usize, triangles: usize) -> HybridScene {
    let splats = alike((0..n).map(|i| Vec3::new(0.0, 0.0, 0.1 * i as f32)).collect(), 0.0, 0.0, [0.5; 3]);
    let corners = |i: usize| {
        let z = 0.01 * i as f32;
        [Vec3::new(-20.0, -20.0, z), Vec3::new(20.0, -20.0, z), Vec3::new(0.0, 40.0, z)]
    };
    let positions = (0..triangles).flat_map(corners).collect();
    let faces = (0..triangles as u32).map(|i| [3 * i, 3 * i + 1, 3 * i + 2]).collect();
    let uvs = vec![[Vec2::ZERO, Vec2::X, Vec2::Y]; triangles];
    let atlas = Atlas::new(Texture::zeros(16, 16, 4), None).unwrap();
    let meshes = vec![Mesh::new(positions, faces, uvs, atlas).unwrap()];
    HybridScene { splats, meshes, composition: Composition { layers: 2, ..Composition::default() } }
}

pub(super) fn step(training: &mut Training, camera: &Camera) {
    step_without(training, camera, Dropout::default());
}

fn step_without(training: &mut Training, camera: &Camera, dropout: Dropout) {
    let truth = vec![200; 4 * camera.intrinsics().pixels()];
    let usual = usual(training, camera, &truth);
    let vertices = Some(VertexStep { number: 1, rate: 0.1 });
    let exposure = Some(ExposureStep { view: 0, rate: 1e-3 });
    let pose = Some(PoseStep { view: 0, turn_rate: 1e-3, shift_rate: 1e-3 });
    training.step(&Step { dropout, vertices, exposure, pose, ..usual }).unwrap();
}

/// Nearer than the depths that pictures of finished scenes distinguish, which are rendered in another unit of length.
#[test]
fn splats_of_small_scenes_are_drawn_in_their_order() {
    let gpu = Gpu::open(None).unwrap();
    let (scene, camera) = testing::random_scene(41, 1500, 0, 0, 1, OrderMode::Stable);
    let [expected, found] = [1.0, 2_f64.powi(-20)].map(|unit| {
        let to = Similarity::new(unit, DMat3::IDENTITY, DVec3::ZERO).unwrap();
        let (scene, camera) = (to.scene(scene.clone()).unwrap(), to.camera(&camera).unwrap());
        let mut training = Training::new(&gpu, &scene, &[camera], 0.2).unwrap();
        training.render(&camera, [0.0; 3], Show::All).unwrap().rgb.into_flattened()
    });
    let off = found.iter().zip(&expected).map(|(f, e)| (f - e).abs()).sum::<f32>() / found.len() as f32;
    assert!(off < 1e-3, "{off}");
}

/// A first step of splats and texels for a photograph.
fn usual<'a>(training: &Training, camera: &'a Camera, truth: &'a [u8]) -> Step<'a> {
    let sh_degree = training.pipeline.front.splats.sh_degree;
    let rates = SplatRates { mean: 1e-3, opacity: 0.05, rotation: 1e-3, log_scale: 5e-3, sh_dc: 2.5e-3, sh_rest: 1e-4 };
    let n_splats = training.n_splats() as u32;
    Step {
        sh_degree,
        band_degree: 2,
        splats: Some(AdamStep { number: 1, n_splats, sh_degree, rates, ..AdamStep::default() }),
        texels: Some(TexelStep { number: 1, base_rate: 0.01, band_rate: 0.01, ..TexelStep::default() }),
        ..Step::still(camera, truth)
    }
}

/// The gradient by disparity is scaled by its weight: checked in the first moments after the first step, which are a
/// tenth of the gradient, beside the photometric gradient.
#[test]
fn a_step_learns_of_nearness_as_its_weight_says() {
    let weight = 3.0;
    for gpu in [Gpu::open(None).unwrap(), Gpu::open(None).unwrap().posing_as_gpu()] {
        let (mut scene, camera) = testing::smooth_scene(1, 2, OrderMode::Stable);
        scene.composition.background = [0.0; 3];
        let new = || Training::new(&gpu, &scene, &[camera], 0.2).unwrap();
        let picture = new().render(&camera, [0.0; 3], Show::All).unwrap().rgb;
        // The photograph differs by up to 8/255, so that pixels count with between full weight and a fifth.
        let off = |i: usize, v: f32| ((v * 255.0).round() as u8).saturating_add(2 * (i % 5) as u8);
        let truth: Vec<u8> =
            picture.iter().enumerate().flat_map(|(i, [r, g, b])| [off(i, *r), off(i, *g), off(i, *b), 255]).collect();
        let learnt = |disparity_weight: f32| {
            let mut training = new();
            let usual = usual(&training, &camera, &truth);
            training.step(&Step { band_degree: sh::MAX_DEGREE, disparity_weight, ..usual }).unwrap();
            assert_eq!(training.status().unwrap().skipped, 0);
            training.read_splats().unwrap().geometry_m
        };
        let found: Vec<f64> = learnt(weight).iter().zip(learnt(0.0)).map(|(a, b)| 10.0 * f64::from(a - b)).collect();

        let pixels = camera.intrinsics().pixels();
        let slope = |(shown, truth): (&[f32; 3], &[u8])| {
            let amiss = testing::largest((0..3).map(|c| (f64::from(shown[c]) - f64::from(truth[c]) / 255.0).abs()));
            f64::from(weight) / pixels as f64 * (-amiss / 0.02).exp()
        };
        let slopes: Vec<f64> = picture.iter().zip(truth.chunks_exact(4)).map(slope).collect();
        let k = camera.intrinsics();
        let nothing = Image {
            width: k.width as usize,
            height: k.height as usize,
            rgb: vec![[0.0; 3]; pixels],
            transmittance: vec![0.0; pixels],
        };
        let parameters = Parameters::of(&scene);
        let expected = reference::backward_parameters(&scene, &camera, &parameters, &nothing, Some(&slopes)).0;
        let rows = found.chunks_exact(GEOMETRY_FLOATS);
        let errors = rows.enumerate().flat_map(|(i, row)| {
            let expected = [
                &expected.means[i].to_array()[..],
                &[expected.opacity_logits[i]],
                &expected.rotations[i],
                &expected.log_scales[i].to_array(),
            ];
            row.iter().zip(expected.concat()).map(|(a, b)| (a - b).abs()).collect::<Vec<_>>()
        });
        let (error, largest) =
            (testing::largest(errors), testing::largest(expected.opacity_logits.iter().map(|g| g.abs())));
        eprintln!("{}: {error:.1e} of {largest:.1e}", gpu.adapter());
        // Differences between two f32 sums, of which the photometric part is the larger.
        assert!(error < 1e-4 * largest, "{error:e} of {largest:e}");
    }
}

/// Values and moments of per-view parameters.
type OfViews = (Vec<f32>, [Vec<f32>; 2]);
type Learnt = (SplatState, Vec<f32>, Vec<Mesh>, (Vec<f32>, Vec<f32>), OfViews, Option<OfViews>, VertexState);

/// Everything that a step changes, for a scene with these meshes.
pub(super) fn learnt(training: &Training, meshes: &[Mesh]) -> Learnt {
    let read = (training.read_splats(), training.read_statistics(), training.read_meshes(meshes));
    let PoseState { values, moments, .. } = training.read_poses().unwrap().unwrap();
    let exposures = training.read_exposures().unwrap().map(|exposures| (exposures.values, exposures.moments));
    let (poses, texels) = ((values, moments), training.read_texel_moments().unwrap());
    let vertices = training.read_vertex_state().unwrap();
    (read.0.unwrap(), read.1.unwrap(), read.2.unwrap(), texels, poses, exposures, vertices)
}

/// A disc seen at an angle has the depth of its plane, not of its mean; a disc in front of it that transmits more than
/// half is ignored.
#[test]
fn depths_are_those_of_the_first_that_hides_half() {
    let k = Intrinsics { width: 40, height: 30, fx: 40.0, fy: 40.0, cx: 19.3, cy: 15.2 };
    let camera = Camera::new(k, DMat3::IDENTITY, DVec3::ZERO).unwrap();
    let splats = Splats::new(
        vec![Vec3::new(0.0, 0.0, 2.0), Vec3::new(0.0, 0.0, 4.0)],
        vec![Quat::IDENTITY, Quat::from_rotation_y(std::f32::consts::FRAC_PI_4)],
        vec![Vec3::new(2.0, 2.0, 0.002).map(f32::ln); 2],
        vec![-0.8, 2.0],
        0,
        vec![[0.0; 3]; 2],
    );
    let scene = HybridScene { splats: splats.unwrap(), meshes: vec![], composition: Composition::default() };
    for gpu in [Gpu::open(None).unwrap(), Gpu::open(None).unwrap().posing_as_gpu()] {
        let depths = Training::new(&gpu, &scene, &[camera], 0.2).unwrap().median_depth(&camera).unwrap();
        // Farther from its centre the disc hides less than half.
        for (i, depth) in depths.into_iter().enumerate().filter(|(i, _)| (12..28).contains(&(i % 40))) {
            let slope = ((i % 40) as f64 + 0.5 - k.cx) / k.fx;
            // Intersection with the plane x + z = 4.
            let expected = 4.0 / (1.0 + slope);
            assert!((f64::from(depth) / expected - 1.0).abs() < 1e-3, "pixel {i}: {depth}, not {expected}");
        }
    }
}

/// First moments of all that is learnt: a tenth of the gradients of a first step.
fn first_moments(training: &Training) -> Vec<f32> {
    let (splats, (texels, _)) = (training.read_splats().unwrap(), training.read_texel_moments().unwrap());
    let [poses, _] = training.read_poses().unwrap().unwrap().moments;
    [&splats.geometry_m, &splats.sh_m, &texels, &poses].into_iter().flatten().copied().collect()
}

fn relative(found: &[f32], expected: &[f32]) -> f64 {
    let square = |v: f32| f64::from(v) * f64::from(v);
    let difference: f64 = found.iter().zip(expected).map(|(a, b)| square(a - b)).sum();
    (difference / expected.iter().copied().map(square).sum::<f64>()).sqrt()
}

/// A training on this adapter after one step, with pictures of `cameras`.
fn stepped<'g>(gpu: &'g Gpu, scene: &HybridScene, cameras: &[Camera], at: &Camera) -> Training<'g> {
    let mut training = Training::new(gpu, scene, cameras, 0.2).unwrap();
    training.refine_poses(&PoseState::new(1)).unwrap();
    step_with_long_lists(&mut training, at);
    training
}

/// A step, repeated until its lists are long enough.
pub(super) fn step_with_long_lists(training: &mut Training, at: &Camera) {
    loop {
        step(training, at);
        if training.grow_if_short().unwrap() == 0 {
            return;
        }
    }
}

/// Dispatches folded into rows of 7 workgroups, as long ones are into rows of 65,535.
#[test]
fn folded_steps_learn_the_same() {
    let (scene, camera) = testing::random_scene(31, 3000, 1, 2, 2, OrderMode::Stable);
    let (plain, folded) = (Gpu::open(None).unwrap(), Gpu::open(None).unwrap().narrowed(7));
    let [expected, found] = [&plain, &folded].map(|gpu| first_moments(&stepped(gpu, &scene, &[camera], &camera)));
    assert!(found.iter().any(|m| *m != 0.0) && found == expected);
}

/// Frames are submitted in parts where systems end long ones.
#[test]
fn steps_in_parts_learn_the_same() {
    let (scene, camera) = testing::random_scene(34, 2000, 2, 2, 2, OrderMode::Stable);
    let [whole, parts] = [false, true].map(|splits| {
        let gpu = Gpu::open(None).unwrap().splitting_frames(splits);
        let mut training = Training::new(&gpu, &scene, &[camera], 0.2).unwrap();
        training.refine_poses(&PoseState::new(1)).unwrap();
        training.expose(&ExposureState::new(1)).unwrap();
        training.free_vertices(&scene.meshes, &VertexState::new(&scene.meshes, 1e-3)).unwrap();
        for _ in 0..2 {
            step(&mut training, &camera);
            while training.grow_if_short().unwrap() > 0 {
                step(&mut training, &camera);
            }
        }
        let learnt = learnt(&training, &scene.meshes);
        let picture = training.render(&camera, [0.0; 3], Show::All).unwrap();
        training.profile();
        step(&mut training, &camera);
        let kernels: Vec<String> = training.seconds().unwrap().into_iter().map(|(kernel, _)| kernel).collect();
        (learnt, picture, kernels, gpu.passes())
    });
    assert!(whole.0.0.geometry_m.iter().any(|m| *m != 0.0));
    assert!(parts.0 == whole.0 && parts.1 == whole.1 && parts.2 == whole.2);
    assert!(parts.3 > whole.3, "{} passes, {} in parts", whole.3, parts.3);
}

/// Two of three photographs stay on the adapter, and are not sent again.
#[test]
fn photographs_that_stay_teach_what_those_teach_that_are_sent() {
    let (scene, camera) = testing::smooth_scene(1, 1, OrderMode::Stable);
    let gpu = Gpu::open(None).unwrap().posing_as_gpu();
    let bytes = 4 * camera.intrinsics().pixels();
    let photographs = [60, 120, 240].map(|grey| vec![grey; bytes]);
    let learnt = |kept: u64| {
        let mut training = Training::new(&gpu, &scene, &[camera], 0.2).unwrap();
        training.keep_photographs(kept);
        let k = camera.intrinsics();
        let mut sent = vec![];
        for number in [0, 1, 2, 2, 0, 1] {
            let rgba = &photographs[number];
            let truth = training.kept_photograph(number, (k.width, k.height)).map_or_else(
                || {
                    sent.push(number);
                    Truth::Sent { rgba, number: Some(number) }
                },
                Truth::Kept,
            );
            let step = Step { truth, ..usual(&training, &camera, rgba) };
            training.step(&step).unwrap();
        }
        assert_eq!(sent, if kept == 0 { vec![0, 1, 2, 2, 0, 1] } else { vec![0, 1, 2, 2] });
        assert_eq!(training.status().unwrap().skipped, 0);
        training.read_splats().unwrap().geometry
    };
    assert!(learnt(2 * bytes as u64) == learnt(0) && learnt(0) != super::splats::pack_geometry(&scene.splats));
}

/// Bit-identical whatever the order in which workgroups run: maps, vertices, splats, poses.
#[test]
fn steps_are_the_same_in_every_run() {
    let (scene, camera) = testing::random_scene(34, 2000, 2, 2, 2, OrderMode::Stable);
    let wide = camera.resized(384, 288);
    let open = Gpu::with_subgroups;
    for (gpu, steps) in [(open(true), 6), (open(false), 3), (open(true).posing_as_gpu(), 2)] {
        let run = || {
            let mut training = Training::new(&gpu, &scene, &[wide], 0.2).unwrap();
            training.refine_poses(&PoseState::new(1)).unwrap();
            training.free_vertices(&scene.meshes, &VertexState::new(&scene.meshes, 1e-3)).unwrap();
            for _ in 0..steps {
                step(&mut training, &wide);
                while training.grow_if_short().unwrap() > 0 {
                    step(&mut training, &wide);
                }
            }
            let learnt = learnt(&training, &scene.meshes);
            assert!(learnt.2[0].positions() != scene.meshes[0].positions());
            learnt
        };
        let (first, second) = (run(), run());
        assert!(first == second, "{:?}", gpu.profile());
    }
}

/// Rendering splats without the mesh, or the mesh without splats, equals rendering a scene that has nothing else, in
/// every mode and with any number of layers; pictures are bit-identical.
#[test]
fn each_is_shown_alone_as_where_there_is_nothing_else() {
    let gpu = Gpu::open(None).unwrap();
    for (seed, mode) in [OrderMode::Stable, OrderMode::SurfaceConsistent, OrderMode::Direct].into_iter().enumerate() {
        let (scene, camera) = testing::random_scene(seed as u64, 300, 2, 1, 1 + seed as u32, mode);
        let values = vec![[0.5, 2.0, 0.0]; camera.intrinsics().pixels()];
        let of = |scene: &HybridScene, show| {
            let mut training = Training::new(&gpu, scene, &[camera], 0.2).unwrap();
            // Layers of an earlier picture must not remain.
            training.render(&camera, [0.0; 3], Show::All).unwrap();
            let picture = training.render(&camera, [0.1, 0.2, 0.3], show).unwrap();
            (picture.rgb, training.gather(&camera, &values, show).unwrap())
        };
        let without_meshes = HybridScene { meshes: vec![], ..scene.clone() };
        let (alone, expected) = (of(&scene, Show::SplatsAlone), of(&without_meshes, Show::All));
        assert!(alone.0 == expected.0 && alone.0 != of(&scene, Show::All).0, "{mode:?}");
        // Kernels with and without layers may round differently.
        let mut pairs = alone.1.as_flattened().iter().zip(expected.1.as_flattened());
        assert!(pairs.all(|(a, b)| (a - b).abs() <= 1e-6 * (1.0 + b.abs())), "{mode:?}");
        let without_splats = HybridScene { splats: Splats::empty(scene.splats.sh_degree()), ..scene.clone() };
        let (alone, expected) = (of(&scene, Show::MeshesAlone), of(&without_splats, Show::All));
        assert!(alone.0 == expected.0 && alone.0 != of(&scene, Show::All).0, "{mode:?}");
    }
}

/// Splats that only another view has seen have sums of zero.
#[test]
fn a_view_gathers_nothing_of_what_it_does_not_see() {
    let (gpu, scene, near) = (Gpu::open(None).unwrap(), scene(3, 1), camera(3.0));
    let away = camera(-3.0);
    let mut training = Training::new(&gpu, &scene, &[near], 0.2).unwrap();
    let values = vec![[1.0; 3]; (SIDE * SIDE) as usize];
    assert!(training.gather(&near, &values, Show::All).unwrap().iter().any(|sums| sums[3] > 1.0));
    assert_eq!(training.gather(&away, &values, Show::All).unwrap(), [[0.0; 4]; 3]);
}

/// Rearranging uses the gradient buffers as scratch space, and the next step overwrites them with its gradients,
/// including zeros for splats that the view does not see.
#[test]
fn a_step_after_splats_were_rearranged_is_that_of_such_splats() {
    let gpu = Gpu::open(None).unwrap();
    let (scene, camera) = testing::random_scene(33, 60, 1, 1, 2, OrderMode::Stable);
    let made = || stepped(&gpu, &scene, &[camera], &camera);
    let mut all = made().read_splats().unwrap();
    let behind = (camera.center() - 10.0 * camera.rotation().row(2)).as_vec3();
    for i in [2, 5] {
        behind.write_to_slice(&mut all.geometry[GEOMETRY_FLOATS * i..][..3]);
    }
    for moments in [&mut all.geometry_m, &mut all.geometry_v, &mut all.sh_m, &mut all.sh_v] {
        moments.iter_mut().enumerate().for_each(|(i, m)| *m = 1e-3 * (1 + i) as f32);
    }
    // One of the splats behind the camera occurs twice, once without moments; the others are permuted.
    let mut sources: Vec<Source> = (0..60).rev().chain([2]).map(Source::new).collect();
    sources[60] = sources[60].without_moments();
    let rows = |i: usize| all.geometry[GEOMETRY_FLOATS * i..][..GEOMETRY_FLOATS].to_vec();
    let geometry: Vec<f32> = sources.iter().flat_map(|s| rows(s.splat())).collect();
    let [expected, found] = [false, true].map(|on_gpu| {
        let mut training = made();
        training.write_splats(&all).unwrap();
        if on_gpu {
            training.rearrange(&geometry, &sources).unwrap();
        } else {
            training.write_splats(&all.rearranged(&geometry, &sources)).unwrap();
        }
        step(&mut training, &camera);
        assert_eq!(training.status().unwrap().skipped, 0);
        learnt(&training, &scene.meshes)
    });
    let unseen = [54, 57, 60].map(|i| GEOMETRY_FLOATS * i..GEOMETRY_FLOATS * (i + 1));
    // Parameters and both moments, of geometry and SH in turn.
    for (i, (found, expected)) in found.0.arrays().into_iter().zip(expected.0.arrays()).enumerate() {
        let is_geometry = [0, 2, 3].contains(&i);
        assert!(relative(found, expected) < 1e-5);
        assert!(!is_geometry || unseen.iter().all(|row| found[row.clone()] == expected[row.clone()]));
    }
    assert!(relative(&found.1, &expected.1) < 1e-5 && relative(&found.4.0, &expected.4.0) < 1e-5);
}

/// Landscape and portrait pictures in one run, neither of which fits into the other.
#[test]
fn pictures_of_other_shapes_are_learnt_from_alike() {
    let gpu = Gpu::open(None).unwrap();
    let (scene, camera) = testing::random_scene(32, 300, 1, 1, 2, OrderMode::Stable);
    let of = |width: u32, height: u32| {
        let middle = |side: u32| 0.5 * f64::from(side);
        let intrinsics = Intrinsics { width, height, fx: 40.0, fy: 40.0, cx: middle(width), cy: middle(height) };
        Camera::new(intrinsics, camera.rotation(), camera.translation()).unwrap()
    };
    let cameras = [of(90, 20), of(17, 70)];
    for at in &cameras {
        let [alone, both] = [std::slice::from_ref(at), &cameras].map(|cameras| stepped(&gpu, &scene, cameras, at));
        assert!(first_moments(&both) == first_moments(&alone));
        let [alone, both] = [alone, both].map(|training| training.loss().unwrap());
        assert_eq!((alone.l1, alone.ssim), (both.l1, both.ssim));
    }
}

#[test]
fn what_is_not_finite_is_found_in_the_step() {
    let gpu = Gpu::open(None).unwrap();
    let scene = scene(2, 1);
    let broken = |change: fn(&mut SplatState, &mut Vec<f32>)| {
        let mut training = Training::new(&gpu, &scene, &[camera(3.0)], 0.2).unwrap();
        step(&mut training, &camera(3.0));
        training.grow_if_short().unwrap();
        let mut splats = training.read_splats().unwrap();
        let (mut first, second) = training.read_texel_moments().unwrap();
        change(&mut splats, &mut first);
        training.write_splats(&splats).unwrap();
        assert!(training.write_texel_moments(&first, &second));
        step(&mut training, &camera(3.0));
        training.status().unwrap().not_finite
    };
    assert_eq!(broken(|_, _| {}), None);
    assert_eq!(broken(|s, _| s.geometry[12 + 6] = f32::NAN), Some("splat geometry"));
    assert_eq!(broken(|s, _| s.geometry_v[12 + 8] = f32::INFINITY), Some("splat geometry"));
    assert_eq!(broken(|s, _| s.sh[4] = f32::NEG_INFINITY), Some("SH coefficients"));
    assert_eq!(broken(|_, texels| texels[17] = f32::NAN), Some("a map of colour and opacity"));
}

/// A step with dropout equals one with the remaining splats alone, each with its opacity scaled up.
#[test]
fn splats_that_a_step_leaves_out_are_neither_seen_nor_moved() {
    // As in `shared/random.wgsl`.
    let first_word = |of: [u32; 4]| {
        let mut v = of.map(|x| x.wrapping_mul(1_664_525).wrapping_add(1_013_904_223));
        for round in 0..2 {
            for (to, a, b) in [(0, 1, 3), (1, 2, 0), (2, 0, 1), (3, 1, 2)] {
                v[to] = v[to].wrapping_add(v[a].wrapping_mul(v[b]));
            }
            if round == 0 {
                v = v.map(|x| x ^ (x >> 16));
            }
        }
        v[0]
    };
    let (rate, seed, n) = (0.25_f32, 7, 400);
    let (scene, camera) = testing::random_scene(3, n, 1, 1, 1, OrderMode::Direct);
    let mut arrays = scene.splats.clone().into_arrays();
    arrays.opacity_logits.iter_mut().for_each(|logit| *logit = logit.min(0.4));
    let stays = |i: &usize| (first_word([*i as u32, seed, 0, 1]) >> 8) as f32 / 16_777_216.0 >= rate;
    let kept: Vec<usize> = (0..n).filter(stays).collect();
    assert!((0.7..0.8).contains(&(kept.len() as f64 / n as f64)), "{}", kept.len());
    let splats = arrays.check().unwrap();
    let mut fewer = gather(splats.clone(), &kept).into_arrays();
    fewer.opacity_logits.iter_mut().for_each(|x| *x = logit(sigmoid(*x) / (1.0 - rate)));
    let [all, fewer] = [splats, fewer.check().unwrap()].map(|splats| HybridScene { splats, ..scene.clone() });

    let gpu = Gpu::open(None).unwrap();
    let stepped = |scene: &HybridScene, dropout: Dropout| {
        let mut training = Training::new(&gpu, scene, &[camera], 0.2).unwrap();
        training.refine_poses(&PoseState::new(1)).unwrap();
        loop {
            step_without(&mut training, &camera, dropout);
            if training.grow_if_short().unwrap() == 0 {
                break;
            }
        }
        let picture = training.pipeline.read_picture(&gpu, &camera).unwrap().rgb;
        (picture, training.read_splats().unwrap())
    };
    let (found, moved) = stepped(&all, Dropout { seed, rate });
    let (expected, others) = stepped(&fewer, Dropout::default());
    let difference = found.as_flattened().iter().zip(expected.as_flattened()).map(|(a, b)| f64::from((a - b).abs()));
    assert!(testing::largest(difference) < 1e-5);
    let row = |state: &SplatState, i: usize| state.geometry_m[i * GEOMETRY_FLOATS..][..GEOMETRY_FLOATS].to_vec();
    for i in (0..n).filter(|i| !stays(i)) {
        assert!(row(&moved, i).iter().all(|m| *m == 0.0), "splat {i} was left out");
    }
    let largest = others.geometry_m.iter().fold(0.0_f32, |a, m| a.max(m.abs()));
    for (k, &i) in kept.iter().enumerate() {
        let (mut found, mut expected) = (row(&moved, i), row(&others, k));
        // By the logarithm of the opacity, to which the factor does not matter.
        found[OPACITY] /= 1.0 - sigmoid(all.splats.opacity_logits()[i]);
        expected[OPACITY] /= 1.0 - sigmoid(fewer.splats.opacity_logits()[k]);
        for (a, b) in found.iter().zip(&expected) {
            assert!((a - b).abs() < 1e-4 * largest, "splat {i}: {found:?} {expected:?}");
        }
    }
}
