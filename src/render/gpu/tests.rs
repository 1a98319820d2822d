//! The GPU pipeline compared with the f64 reference: images, gradients, limits.

use std::f64::consts::PI;

use glam::{DMat3, DVec3, Quat, Vec2, Vec3};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;

use super::{
    GpuError, LayeredRenderer, Renderer,
    backward::Backward,
    device::{Frame, Gpu},
    pipeline::Pipeline,
    status::status_buffer,
    vertices::VertexState,
};
use crate::{
    render::{
        contract::ImageModel,
        reference::{self, Image, Margin, Parameters},
        testing,
    },
    scene::{
        Atlas, Camera, Composition, HybridScene, Intrinsics, Mesh, OrderMode, PixelFilter, SplatArrays, Splats,
        Texture, sh,
    },
};

/// Renders on the GPU; with a cotangent, also returns the gradients of all splat parameters.
fn gpu_frame(
    gpu: &Gpu,
    scene: &HybridScene,
    camera: &Camera,
    cotangent: Option<&Image>,
) -> (Image, Option<Parameters>) {
    let (image, gradients, _) = special_frame(gpu, scene, camera, sh::MAX_DEGREE, &[], cotangent.map(|c| (c, None)));
    (image, gradients)
}

/// [`gpu_frame`] for splats that show SH bands up to `active` and are smoothed by `deviations`, if given, with
/// derivatives of the loss by the pixels' disparities beside their cotangents. Also returns the statistics of density
/// control `[N]`.
fn special_frame(
    gpu: &Gpu,
    scene: &HybridScene,
    camera: &Camera,
    active: u32,
    deviations: &[f64],
    cotangent: Option<(&Image, Option<&[f64]>)>,
) -> (Image, Option<Parameters>, Vec<[f32; 4]>) {
    let k = *camera.intrinsics();
    let status = cotangent.map(|_| status_buffer(gpu).unwrap());
    let mut pipeline = Pipeline::new(gpu, scene, 0, &[*camera], status.as_ref()).unwrap();
    let mut backward = status.map(|status| Backward::new(gpu, &pipeline, status).unwrap());
    let n = scene.splats.len();
    for (i, &deviation) in deviations.iter().enumerate() {
        gpu.write(&pipeline.front.splats.geometry, 48 * i as u64 + 44, &[deviation as f32]);
    }
    let terms = sh::coefficients(scene.splats.sh_degree());
    loop {
        let mut view = pipeline.prepare(gpu, camera).unwrap();
        view.sh_degree = view.sh_degree.min(active);
        if let (Some((c, slopes)), Some(b)) = (cotangent, &backward) {
            let slope = |pixel| slopes.map_or(0.0, |slopes| slopes[pixel]);
            let words = c.rgb.iter().enumerate().flat_map(|(i, &[r, g, b])| [r, g, b, slope(i)].map(|v| v as f32));
            let words: Vec<f32> = words.collect();
            gpu.write(&b.image_gradient, 0, &words);
        }
        let mut frame = Frame::new(gpu);
        pipeline.record(gpu, &mut frame, &view);
        if let Some(backward) = &backward {
            backward.record(&mut frame, &pipeline, &view);
        }
        frame.submit();
        if !pipeline.grow_if_short(gpu).unwrap() {
            break;
        }
        if let Some(backward) = &mut backward {
            backward.renew(gpu, &pipeline).unwrap();
        }
    }
    let pixels = k.pixels();
    let words: Vec<f32> = gpu.read(&pipeline.blend.image, pixels * 4).unwrap();
    let rendered = Image {
        width: k.width as usize,
        height: k.height as usize,
        rgb: words.chunks_exact(4).map(|p| [p[0], p[1], p[2]].map(f64::from)).collect(),
        transmittance: words.chunks_exact(4).map(|p| f64::from(p[3])).collect(),
    };
    let gradients = backward.as_ref().map(|b| {
        let mut out = Parameters::of(scene).zeros_like();
        let geometry: Vec<f32> = gpu.read(&b.splats.geometry, n * 12).unwrap();
        for (i, g) in geometry.chunks_exact(12).enumerate() {
            let g: Vec<f64> = g.iter().copied().map(f64::from).collect();
            out.means[i] = DVec3::new(g[0], g[1], g[2]);
            out.opacity_logits[i] = g[3];
            out.rotations[i] = [g[4], g[5], g[6], g[7]];
            out.log_scales[i] = DVec3::new(g[8], g[9], g[10]);
        }
        let sh: Vec<f32> = gpu.read(&b.splats.sh, n * 3 * terms).unwrap();
        for (i, c) in sh.chunks_exact(3).enumerate() {
            out.sh[i] = DVec3::new(f64::from(c[0]), f64::from(c[1]), f64::from(c[2]));
        }
        let texels = pipeline.front.mesh.as_ref().map_or(vec![], |m| m.read_gradients(gpu).unwrap());
        for (i, (base, bands)) in texels.into_iter().enumerate() {
            out.base[i] = base.into_iter().map(f64::from).collect();
            out.bands[i] = bands.into_iter().map(f64::from).collect();
        }
        out
    });
    let statistics = backward.as_ref().map_or(vec![], |b| gpu.read(&b.splats.statistics, n).unwrap());
    (rendered, gradients, statistics)
}

/// Forward and backward pass for the scene as seen by this camera.
fn differentiable(gpu: &Gpu, scene: &HybridScene, camera: &Camera) -> (Pipeline, Backward) {
    let status = status_buffer(gpu).unwrap();
    let pipeline = Pipeline::new(gpu, scene, 0, &[*camera], Some(&status)).unwrap();
    let backward = Backward::new(gpu, &pipeline, status).unwrap();
    (pipeline, backward)
}

/// Margin within which f32 depths, alphas and barycentric coordinates may decide differently.
const TOLERANCE: Margin = Margin { alpha: 1e-4, order: 1e-5, edge: 1e-4, stop: 1e-3 };

/// Largest error of a colour, half of the contribution of a splat at the cut-off: a splat that is missed or blended
/// twice exceeds it.
const MOST: f64 = 2e-3;
/// Largest mean error, about ten times that with lavapipe; another order or filter adds fifty times as much.
const MEAN: f64 = 2e-5;
/// Upper bound of all colours in these scenes.
const BRIGHTEST: f64 = 2.0;
/// Blend weight that may change in a pixel with alphas close to the cut-off: that of two splats.
const CUT_WEIGHT: f64 = 2.0 / 255.0;
/// Blend weight that may change if the stop is close: alphas are capped at 0.99, so at most this much is left where one
/// takes the transmittance below 1e-4.
const STOP_WEIGHT: f64 = 1e-2;
/// Relative error of the gradient of a parameter class: actual errors are about 1e-6, and WGSL allows errors of 1e-5 in
/// `exp` and `inverseSqrt`; a missing term would change some per cent.
const GRADIENT: f64 = 1e-4;
/// The same for needles, whose gradients suffer from cancellation.
const NEEDLE_GRADIENT: f64 = 1e-3;
/// The same for vertices, and for texels beside a face with gradients twenty times as large: their sums are in fixed
/// point.
const FIXED_GRADIENT: f64 = 1e-3;
/// Allowed error of a single number of a gradient: relative to itself, and relative to the largest of its class, which
/// bounds the terms that may cancel.
const OF_ITSELF: f64 = 1e-3;
const OF_LARGEST: f64 = 1e-5;
/// The same of texels, whose sums are in fixed point: a third of it is found.
const OF_LARGEST_TEXEL: f64 = 3e-4;

/// Largest excused share of a scene's pixels, one fifth: a sixth occurs with 5,000 splats among meshes, and the
/// reference alone decides which pixels.
const EXCUSED: usize = 5;
/// Share of the excused pixels of all scenes that may differ, one fifth: even close decisions rarely differ in f32.
const DECIDED_OTHERWISE: usize = 5;

/// Number of pixels with a close decision, of those among them that differ, and of each kind of decision; a pixel can
/// have several.
#[derive(Default)]
struct Excused {
    pixels: usize,
    differing: usize,
    by_kind: [usize; 4],
}

/// Largest difference of a pixel with close decisions of these kinds: by weights that may change, or by the whole range
/// of colours if the order or a layer may change.
fn excused_difference([alpha, order, edge, stop]: [bool; 4]) -> f64 {
    let of = |close: bool, weight: f64| if close { weight } else { 0.0 };
    let weight = if order || edge { 1.0 } else { of(alpha, CUT_WEIGHT) + of(stop, STOP_WEIGHT) };
    BRIGHTEST * weight + MOST
}

/// Mean and largest difference over pixels without close decisions, and the excused pixels.
fn compare(found: &Image, scene: &HybridScene, camera: &Camera) -> (f64, f64, Excused) {
    let (expected, margins) = reference::render_with_margins(scene, camera);
    let (mut sum, mut most, mut excused) = (0.0, 0.0_f64, Excused::default());
    for (i, margin) in margins.iter().enumerate() {
        let (found, expected) = (found.rgb[i], expected.rgb[i]);
        let differences = [0, 1, 2].map(|c| (found[c] - expected[c]).abs());
        let worst = testing::largest(differences);
        if margin.is_within(&TOLERANCE) {
            let close = margin.within(&TOLERANCE);
            assert!(worst <= excused_difference(close), "pixel {i}, {close:?}: {found:?}, not {expected:?}");
            excused.pixels += 1;
            excused.differing += usize::from(worst > MOST);
            for (count, within) in excused.by_kind.iter_mut().zip(close) {
                *count += usize::from(within);
            }
            continue;
        }
        assert!(worst.is_finite(), "pixel {i}");
        sum += differences.iter().sum::<f64>();
        most = most.max(worst);
    }
    assert!(EXCUSED * excused.pixels < margins.len(), "{} of {} are excused", excused.pixels, margins.len());
    (sum / (3 * (margins.len() - excused.pixels)) as f64, most, excused)
}

const MODES: [OrderMode; 3] = [OrderMode::Stable, OrderMode::SurfaceConsistent, OrderMode::Direct];

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

/// Needles of up to about a thousand pixels of which a large picture shows a small part, far from their centres.
#[test]
fn needles_are_those_of_the_reference_far_from_their_centres() {
    let gpu = Gpu::open(None).unwrap();
    let intrinsics = Intrinsics { width: 64, height: 48, fx: 2000.0, fy: 2000.0, cx: 1500.3, cy: 1100.6 };
    let camera = Camera::new(intrinsics, DMat3::IDENTITY, DVec3::ZERO).unwrap();
    let depth = 2.0;
    // Point on the ray through the picture's middle at this depth.
    let middle =
        depth * DVec3::new((32.0 - intrinsics.cx) / intrinsics.fx, (24.0 - intrinsics.cy) / intrinsics.fy, 1.0);
    for deviation in [300.0, 1000.0, 2000.0] {
        let mut splats = SplatArrays::default();
        for i in 0..12 {
            let turn = 0.13 + f64::from(i) * PI / 12.0;
            let across = f64::from(i % 5 - 2) * 4.0 / intrinsics.fx * depth;
            let along = [-2.0, -1.0, 1.0, 1.7][i as usize % 4] * deviation / intrinsics.fx * depth;
            let axes = DMat3::from_rotation_z(turn);
            splats.means.push((middle + axes * DVec3::new(along, across, 1e-5 * f64::from(i))).as_vec3());
            splats.rotations.push(Quat::from_rotation_z(turn as f32));
            let long = deviation / intrinsics.fx * depth;
            splats.log_scales.push(Vec3::new(long.ln() as f32, -9.0, -9.0));
            splats.opacity_logits.push(1.0);
            splats.sh.push([0.2 * i as f32, 1.0, -0.1 * i as f32]);
        }
        let splats = splats.check().unwrap();
        let scene = HybridScene { splats, meshes: vec![], composition: Composition::default() };
        let cotangent = random_cotangent(&camera, 3);
        let (found, gradient) = gpu_frame(&gpu, &scene, &camera, Some(&cotangent));
        let (mean, most, _) = compare(&found, &scene, &camera);
        let errors = class_errors(&gradient.unwrap(), &reference::backward(&scene, &camera, &cotangent));
        eprintln!("{deviation} px: mean {mean:.1e}, max {most:.1e}, {errors:?}");
        assert!(mean < MEAN && most < MOST, "{deviation} px: mean {mean:e}, max {most:e}");
        assert!(errors.iter().all(|(_, error)| *error < NEEDLE_GRADIENT), "{deviation} px: {errors:?}");
    }
}

/// Relative error of a whole class: ‖found − expected‖ / ‖expected‖.
fn relative(found: impl Iterator<Item = f64>, expected: impl Iterator<Item = f64>) -> f64 {
    let (mut difference, mut norm) = (0.0, 0.0);
    for (f, e) in found.zip(expected) {
        difference += (f - e) * (f - e);
        norm += e * e;
    }
    (difference / norm.max(1e-30)).sqrt()
}

/// Numbers of one parameter class; for texels, of one mesh.
struct Class {
    name: String,
    found: Vec<f64>,
    expected: Vec<f64>,
}

impl Class {
    fn error(&self) -> f64 {
        relative(self.found.iter().copied(), self.expected.iter().copied())
    }

    /// What the whole class may be off, relative to its norm, and one number of it, relative to the largest. Texels are summed in fixed
    /// point, of which all meshes share one unit: of the mesh that pulls least, fewer digits are left.
    fn allowed(&self) -> (f64, f64) {
        if self.name.contains("of mesh") { (FIXED_GRADIENT, OF_LARGEST_TEXEL) } else { (GRADIENT, OF_LARGEST) }
    }

    /// Largest difference of a number, of what it may be: 1 is all of it.
    fn worst(&self) -> f64 {
        let largest = testing::largest(self.expected.iter().map(|e| e.abs()));
        let (_, of_largest) = self.allowed();
        let allowed = |e: f64| (OF_ITSELF * e.abs() + of_largest * largest).max(1e-30);
        testing::largest(self.found.iter().zip(&self.expected).map(|(f, e)| (f - e).abs() / allowed(*e)))
    }
}

/// All parameter classes of the scene.
fn classes(found: &Parameters, expected: &Parameters) -> Vec<Class> {
    let flat = |v: &[DVec3]| v.iter().flat_map(DVec3::to_array).collect::<Vec<_>>();
    let named = |p: &Parameters| {
        let mut named = vec![
            ("means".to_owned(), flat(&p.means)),
            ("log-scales".to_owned(), flat(&p.log_scales)),
            ("rotations".to_owned(), p.rotations.iter().flatten().copied().collect()),
            ("opacity logits".to_owned(), p.opacity_logits.clone()),
            ("SH".to_owned(), flat(&p.sh)),
        ];
        for (m, (base, bands)) in p.base.iter().zip(&p.bands).enumerate() {
            let channels = |are_logits: bool| {
                let texels = base.iter().enumerate().filter(|(i, _)| (i % 4 == 3) == are_logits);
                texels.map(|(_, g)| *g).collect::<Vec<_>>()
            };
            named.push((format!("base colours of mesh {m}"), channels(false)));
            named.push((format!("opacity logits of mesh {m}"), channels(true)));
            named.push((format!("bands of mesh {m}"), bands.clone()));
        }
        named
    };
    let pairs = named(found).into_iter().zip(named(expected));
    let class = |((name, found), (_, expected))| Class { name, found, expected };
    pairs.map(class).filter(|class| !class.expected.is_empty()).collect()
}

/// Relative errors of all parameter classes of the scene.
fn class_errors(found: &Parameters, expected: &Parameters) -> Vec<(String, f64)> {
    classes(found, expected).into_iter().map(|class| (class.name.clone(), class.error())).collect()
}

/// Checks every class as a whole, and every number in it.
fn check_gradients(found: &Parameters, expected: &Parameters, case: &str) {
    let classes = classes(found, expected);
    assert!(classes.len() >= 5, "{case}");
    for class in classes {
        let (name, error, worst) = (&class.name, class.error(), class.worst());
        eprintln!("{case}, {name}: relative error {error:.1e}, worst number {worst:.1e} of what it may be off");
        assert!(error < class.allowed().0, "{case}, {name}: relative error {error:e}");
        assert!(worst < 1.0, "{case}, {name}: a number is off by {worst} times what it may be");
    }
}

fn random_cotangent(camera: &Camera, seed: u64) -> Image {
    let k = camera.intrinsics();
    let pixels = k.pixels();
    let mut rng = Pcg32::seed_from_u64(seed);
    Image {
        width: k.width as usize,
        height: k.height as usize,
        rgb: (0..pixels).map(|_| [0; 3].map(|_| rng.random_range(-1.0..1.0))).collect(),
        transmittance: vec![0.0; pixels],
    }
}

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
            let (moments, row) = backward.moments();
            gpu.read(moments, n * row).unwrap()
        };
        let mut plain = differentiable(&gpu, &scene, &camera);
        let expected = expected.get_or_insert_with(|| {
            let mut sums = vec![[0.0_f64; 2]; n];
            for p in 0..cotangent.rgb.len() {
                let moments = frame(&mut plain, Some(p));
                let projected: Vec<f32> = gpu.read(&plain.0.front.lists.projected, 12 * n).unwrap();
                for (i, sum) in sums.iter_mut().enumerate() {
                    let (m, q) = (&moments[10 * i..], &projected[12 * i + 4..]);
                    sum[0] += f64::from(q[0] * m[1] - q[1] * q[2] * m[2]).abs();
                    sum[1] += f64::from(q[2] * m[2]).abs();
                }
            }
            sums
        });
        let all = frame(&mut plain, None);
        let mut absolute = differentiable(&gpu, &scene, &camera);
        absolute.1.sum_absolute_gradients(&gpu, &absolute.0).unwrap();
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

/// Filters about as wide as the splats, and as narrow as in training.
#[test]
fn filters_equal_the_reference() {
    let gpu = Gpu::open(None).unwrap();
    for (variance, deviation) in [(20.0, 0.0), (0.1, 0.2), (20.0, 0.2), (0.1, 0.01)] {
        let (mut scene, camera) = testing::smooth_scene(3, 2, OrderMode::Stable);
        scene.composition.pixel_filter = PixelFilter { variance, normalized: true };
        let mut parameters = Parameters::of(&scene);
        let deviations: Vec<f64> =
            parameters.means.iter().map(|&mean| f64::from((deviation * camera.to_camera(mean).z) as f32)).collect();
        parameters.smoothing.clone_from(&deviations);
        let cotangent = random_cotangent(&camera, 3);
        let expected = reference::backward_parameters(&scene, &camera, &parameters, &cotangent, None).0;
        let cotangents = Some((&cotangent, None));
        let (image, found, _) = special_frame(&gpu, &scene, &camera, sh::MAX_DEGREE, &deviations, cotangents);
        let reference = reference::render_parameters(&scene, &camera, &parameters);
        let pairs = image.rgb.iter().flatten().zip(reference.rgb.iter().flatten());
        let most = testing::largest(pairs.map(|(a, b)| (a - b).abs()));
        eprintln!("{variance} px², {deviation}: image {most:.1e}");
        // A few wide splats: only rounding differs.
        assert!(most < 1e-5, "{variance} px², {deviation}: {most:e}");
        check_gradients(&found.unwrap(), &expected, &format!("{variance} px², {deviation}"));
    }
    // Needles of hundreds of pixels along no axis of the picture: their gradients suffer from cancellation.
    for long in [2.0, 4.0, 5.0] {
        let (mut scene, camera) = testing::smooth_scene(3, 2, OrderMode::Stable);
        scene.composition.pixel_filter = PixelFilter::MIP;
        let s = scene.splats.into_arrays();
        let log_scales = s.log_scales.iter().map(|l| Vec3::new(l.x + long, l.y - 1.0, l.z - 1.0)).collect();
        scene.splats = SplatArrays { log_scales, ..s }.check().unwrap();
        let cotangent = random_cotangent(&camera, 3);
        let expected = reference::backward(&scene, &camera, &cotangent);
        let found = gpu_frame(&gpu, &scene, &camera, Some(&cotangent)).1.unwrap();
        let errors = class_errors(&found, &expected);
        eprintln!("needles e^{long} times as long: {errors:?}");
        assert!(errors.iter().all(|(_, error)| *error < NEEDLE_GRADIENT), "e^{long}: {errors:?}");
    }
    // Splats from far below a pixel to many pixels, and needles, some with a deviation of about a thousand pixels.
    for seed in 0..8 {
        let (mut scene, camera) = testing::random_scene(seed, 800, 1, 1, 2, OrderMode::Stable);
        let s = scene.splats.into_arrays();
        let log_scales = s.log_scales.iter().enumerate().map(|(i, l)| match i % 40 {
            0 => Vec3::new(l.x, 4.5, l.z - 4.0),
            _ => *l - [0.0, 2.0, 4.0][i % 3] * Vec3::new(1.0, 1.0, (i % 2) as f32),
        });
        scene.splats = SplatArrays { log_scales: log_scales.collect(), ..s }.check().unwrap();
        scene.composition.pixel_filter = [PixelFilter::MIP, PixelFilter::DILATION][seed as usize % 2];
        let (mean, most, _) = compare(&gpu_frame(&gpu, &scene, &camera, None).0, &scene, &camera);
        eprintln!("scene {seed}: mean {mean:.1e}, max {most:.1e}");
        assert!(mean < MEAN && most < MOST, "scene {seed}: mean {mean:e}, max {most:e}");
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
            let (mut pipeline, backward) = differentiable(&gpu, &scene, &camera);
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
