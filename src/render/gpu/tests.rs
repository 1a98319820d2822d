//! The GPU pipeline compared with the f64 reference: images, gradients, limits.

mod filters;
mod gradients;
mod images;

use glam::DVec3;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;

use super::{
    backward::Backward,
    device::{Frame, Gpu},
    pipeline::Pipeline,
    status::status_buffer,
};
use crate::{
    render::{
        reference::{self, Image, Margin, Parameters},
        testing,
    },
    scene::{Camera, HybridScene, OrderMode, sh},
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
    let mut backward = status.map(|status| Backward::new(gpu, &pipeline, status, false).unwrap());
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

/// Forward and backward pass for the scene as seen by this camera, with `absolute` gradients in the statistics.
fn differentiable(gpu: &Gpu, scene: &HybridScene, camera: &Camera, absolute: bool) -> (Pipeline, Backward) {
    let status = status_buffer(gpu).unwrap();
    let pipeline = Pipeline::new(gpu, scene, 0, &[*camera], Some(&status)).unwrap();
    let backward = Backward::new(gpu, &pipeline, status, absolute).unwrap();
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

    /// What the whole class may be off, relative to its norm, and one number of it, relative to the largest. Texels are
    /// summed in fixed point, of which all meshes share one unit: of the mesh that pulls least, fewer digits are left.
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
