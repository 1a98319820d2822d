//! The bytes per splat, texel and pixel stated in ARCHITECTURE.md, compared with actual allocations.

use glam::{DVec3, Vec2, Vec3};

use super::{
    Gpu, LayeredRenderer, Renderer,
    exposure::ExposureState,
    geometry::GEOMETRY_FLOATS,
    memory::{TrainingSize, training_bytes},
    pose::PoseState,
    rows::Source,
    training::{Show, Training, TrainingOptions},
    vertices::VertexState,
};
use crate::render::contract::{ImageModel, ShDirection};
use crate::scene::testing::{ahead, alike};
use crate::scene::{Atlas, Camera, Composition, HybridScene, Mesh, SplatArrays, Splats, Texture};

const SH_DEGREE: u32 = 3;
const SH_TERMS: f64 = 16.0;
const LAYERS: u32 = 2;
/// Initial capacity for six (tile, splat) pairs per splat: 16 bytes each, or 68 in training.
const PAIRS: f64 = 6.0 * 16.0;
const TRAINING_PAIRS: f64 = 6.0 * 68.0;

/// Purpose of the memory.
#[derive(Clone, Copy, Debug)]
enum Kind {
    Training,
    /// With AbsGS, exposures and poses.
    TrainingOfAll,
    Rendering,
    Layers(ImageModel),
}

/// `n` splats, a triangle with a base map of `texels`² texels, and a picture of `side`² pixels.
fn seen(n: usize, texels: u32, side: u32) -> (HybridScene, Camera) {
    let arrays = alike(vec![Vec3::ZERO; n], -9.0, 0.0, [0.0; 3]).into_arrays();
    let splats = arrays.with_sh_degree(SH_DEGREE).check().unwrap();
    let corners = vec![Vec3::ZERO, Vec3::X, Vec3::Y];
    let uvs = vec![[Vec2::ZERO, Vec2::X, Vec2::Y]];
    let atlas = Atlas::new(Texture::zeros(texels, texels, 4), None).unwrap();
    let mesh = Mesh::new(corners, vec![[0, 1, 2]], uvs, atlas).unwrap();
    let composition = Composition { layers: LAYERS, ..Composition::default() };
    let scene = HybridScene { splats, meshes: vec![mesh], composition };
    (scene, ahead([side, side], f64::from(side), -3.0 * DVec3::Z))
}

/// Training of up to `most` splats.
fn limited<'g>(gpu: &'g Gpu, scene: &HybridScene, camera: Camera, most: usize) -> Training<'g> {
    let options = TrainingOptions { most_splats: most, ..TrainingOptions::default() };
    Training::with_options(gpu, scene, &[camera], &options).unwrap()
}

/// Peak bytes for the scene of [`seen`], whose splats are all that there will be.
fn peak(n: usize, texels: u32, side: u32, kind: Kind) -> f64 {
    let (scene, camera) = seen(n, texels, side);
    // A new adapter each time, since the peak of one never decreases. Nothing is read back, since staging counts too.
    let gpu = Gpu::open(None).unwrap();
    match kind {
        Kind::Training => drop(limited(&gpu, &scene, camera, n)),
        Kind::TrainingOfAll => {
            let options = TrainingOptions { most_splats: n, absolute_gradients: true, ..TrainingOptions::default() };
            let mut training = Training::with_options(&gpu, &scene, &[camera], &options).unwrap();
            training.expose(&ExposureState::new(1)).unwrap();
            training.refine_poses(&PoseState::new(1)).unwrap();
        }
        Kind::Rendering => drop(Renderer::new(&gpu, &scene, &[camera]).unwrap()),
        Kind::Layers(model) => drop(LayeredRenderer::new(&gpu, &scene, &[camera], model).unwrap()),
    }
    gpu.peak_bytes() as f64
}

/// Compares bytes per splat, texel and pixel. Tables of counters (sort histograms, scan sums, tile ranges) add up to
/// two per cent to these.
fn check(kind: Kind, stated: [f64; 3]) {
    let smallest = peak(50_000, 512, 256, kind);
    let per = |n, texels, side, count: f64| (peak(n, texels, side, kind) - smallest) / count;
    let found = [
        per(100_000, 512, 256, 50_000.0),
        per(50_000, 1024, 256, 1024.0 * 1024.0 - 512.0 * 512.0),
        per(50_000, 512, 1024, 1024.0 * 1024.0 - 256.0 * 256.0),
    ];
    for ((found, stated), what) in found.into_iter().zip(stated).zip(["splat", "texel", "pixel"]) {
        assert!((found / stated - 1.0).abs() < 0.02, "{kind:?}: {found} bytes per {what}, not {stated}");
    }
}

#[test]
fn rendering_takes_the_stated_bytes() {
    let layers = f64::from(LAYERS);
    // Five mip levels: 1 + 1/4 + … + 1/256 of the four floats.
    let texel = 16.0 * 341.0 / 256.0;
    let splat = 132.0 + 12.0 * SH_TERMS + PAIRS;
    check(Kind::Rendering, [splat + 4.0 * layers, texel, 16.0 + 24.0 * layers]);
    // Where loops end, several dispatches may be needed, and more memory for them.
    let pixel = if Gpu::open(None).unwrap().loop_passes().is_some() { 80.0 } else { 64.0 } + 24.0 * layers;
    check(Kind::Layers(ImageModel::Ewa), [splat + 4.0 * layers, texel, pixel]);
    check(Kind::Layers(ImageModel::Ray(ShDirection::Mean)), [splat + 80.0, texel, pixel]);
}

#[test]
fn training_takes_the_stated_bytes() {
    let layers = f64::from(LAYERS);
    let per_splat = 332.0 + 48.0 * SH_TERMS + 4.0 * layers + TRAINING_PAIRS;
    // Texels and gradients have mips, the two moments have none.
    check(Kind::Training, [per_splat, 16.0 * (2.0 * 341.0 / 256.0 + 2.0), 108.0 + 64.0 * layers]);
}

/// During growth, old parameters and moments coexist with the larger ones, but buffers that every step rewrites do not:
/// even where the larger ones have room for hardly more splats.
#[test]
fn growing_takes_what_the_larger_buffers_take() {
    let before = 40_000;
    let (scene, camera) = seen(before, 64, 64);
    // There is room for 60,000 at first.
    for after in [90_000, 60_100] {
        let gpu = Gpu::open(None).unwrap();
        let mut training = limited(&gpu, &scene, camera, after);
        let sources: Vec<Source> = (0..after).map(|i| Source::new(i % before)).collect();
        training.rearrange(&vec![0.0; after * GEOMETRY_FLOATS], &sources).unwrap();
        let (grown, made) = (gpu.peak_bytes() as f64, peak(after, 64, 64, Kind::Training));
        // The list of row movements is not included in the computed size.
        assert!((0.99..1.01).contains(&(grown / made)), "{after} splats: {grown} bytes, not {made}");
    }
}

/// A mesh that takes its part of a budget leaves room for fewer splats than there were without it.
#[test]
fn room_for_more_splats_than_there_may_be_is_given_back() {
    let (before, after, most) = (40_000, 10_000, 25_000);
    let (scene, camera) = seen(before, 64, 64);
    let gpu = Gpu::open(None).unwrap();
    let mut training = limited(&gpu, &scene, camera, most);
    let made = gpu.peak_bytes() as f64;
    let sources: Vec<Source> = (before - after..before).map(Source::new).collect();
    training.rearrange(&vec![0.0; after * GEOMETRY_FLOATS], &sources).unwrap();
    let found = gpu.peak_bytes() as f64;
    // As above, for the list of row movements.
    assert!(found < 1.01 * made, "{found} bytes, not {made}");
    gpu.reset_peak();
    let (held, expected) = (gpu.peak_bytes() as f64, peak(most, 64, 64, Kind::Training));
    assert!((0.99..1.01).contains(&(held / expected)), "{held} bytes, not {expected}");
}

/// Growing lists of pairs does not keep the old ones, neither in a step or a rendering, nor when the number of splats
/// grows.
#[test]
fn longer_lists_take_what_they_hold() {
    let (before, after) = (20_000, 45_000);
    let pairs = 30 * before;
    let with_pairs = |n: usize, pairs: usize| {
        let more = pairs as f64 - 6.0 * n as f64;
        peak(n, 64, 64, Kind::Training) + TRAINING_PAIRS / 6.0 * more
    };
    // The per-splat data of lists and blending do coexist for a moment: 84 and 40 bytes, and four per layer.
    let twice = |n: usize| (124.0 + 4.0 * f64::from(LAYERS)) * n as f64;
    let (mut scene, camera) = seen(before, 64, 64);

    // In front of all of the picture's 16 tiles: 320,000 pairs, with a capacity of 120,000.
    let splats = scene.splats.clone().into_arrays();
    let wide = SplatArrays { log_scales: vec![Vec3::ZERO; before], ..splats }.check().unwrap();
    let narrow = std::mem::replace(&mut scene.splats, wide);
    let gpu = Gpu::open(None).unwrap();
    let mut training = limited(&gpu, &scene, camera, before);
    training.render(&camera, [0.0; 3], Show::SplatsAlone).unwrap();
    let longer = training.list_lengths()[0];
    assert_eq!(longer, 480_000, "half as many again as the picture needs");
    let (found, stated) = (gpu.peak_bytes() as f64, with_pairs(before, longer) + twice(before));
    assert!((0.99..1.01).contains(&(found / stated)), "{found} bytes, not {stated}");
    // A longer list of triangles takes nothing but itself.
    let (held, triangles) = (gpu.peak_bytes(), training.list_lengths()[1]);
    training.lengthen_lists([0, 2 * triangles]).unwrap();
    let more = gpu.peak_bytes() - held;
    assert!(more <= 2 * 4 * triangles as u64, "{more} bytes for {triangles} pairs as many again");
    drop(training);
    scene.splats = narrow;

    let (gpu, room) = (Gpu::open(None).unwrap(), 30_000);
    let mut training = limited(&gpu, &scene, camera, after);
    training.lengthen_lists([pairs, 0]).unwrap();
    let (found, stated) = (gpu.peak_bytes() as f64, with_pairs(room, pairs) + twice(room));
    assert!((0.99..1.01).contains(&(found / stated)), "{found} bytes, not {stated}");

    let sources: Vec<Source> = (0..after).map(|i| Source::new(i % before)).collect();
    training.rearrange(&vec![0.0; after * GEOMETRY_FLOATS], &sources).unwrap();
    assert_eq!(training.list_lengths()[0], pairs, "they are as long as they were");
    let (grown, stated) = (gpu.peak_bytes() as f64, with_pairs(after, pairs));
    assert!((0.99..1.01).contains(&(grown / stated)), "{grown} bytes, not {stated}");
}

/// Captures with mixed picture sizes need the memory of their largest pictures.
#[test]
fn pictures_of_mixed_sizes_take_what_the_largest_do() {
    let peak = |sides: &[u32]| {
        let cameras: Vec<Camera> = sides.iter().map(|side| seen(0, 16, *side).1).collect();
        let gpu = Gpu::open(None).unwrap();
        drop(Training::new(&gpu, &seen(0, 16, 16).0, &cameras, 0.2).unwrap());
        gpu.peak_bytes()
    };
    assert_eq!(peak(&[100, 200, 300]), peak(&[300]));
}

/// Also with everything that is optional, none of which is made twice.
#[test]
fn the_account_of_training_is_what_is_allocated() {
    let plain = [(50_000, 512, 256), (20_000, 64, 1000)].map(|sizes| (sizes, Kind::Training));
    let of_all = [(50_000, 64, 64), (20_000, 64, 1000)].map(|sizes| (sizes, Kind::TrainingOfAll));
    for ((splats, texels, side), kind) in plain.into_iter().chain(of_all) {
        let has_all = matches!(kind, Kind::TrainingOfAll);
        let size = TrainingSize {
            splats,
            sh_degree: SH_DEGREE,
            absolute_gradients: has_all,
            poses_move: has_all,
            triangles: 1,
            vertices_move: false,
            map_floats: 4 * texels * texels,
            layers: LAYERS as usize,
            width: side,
            height: side,
        };
        let (found, stated) = (peak(splats, texels as u32, side as u32, kind), training_bytes(&size).total() as f64);
        // As above, for counters.
        assert!((found / stated - 1.0).abs() < 0.02, "{size:?}: {found} bytes, not {stated}");
    }
}

#[test]
fn the_account_of_moving_vertices_is_what_is_allocated() {
    let cells = 100_u32;
    let corner = |i: u32| [i % (cells + 1), i / (cells + 1)].map(|x| x as f32 / cells as f32);
    let positions: Vec<Vec3> = (0..(cells + 1).pow(2)).map(corner).map(|[x, y]| Vec3::new(x, y, 0.0)).collect();
    let square = |c: u32| {
        let a = c / cells * (cells + 1) + c % cells;
        [[a, a + 1, a + cells + 2], [a, a + cells + 2, a + cells + 1]]
    };
    let triangles: Vec<[u32; 3]> = (0..cells * cells).flat_map(square).collect();
    let uvs = triangles.iter().map(|t| t.map(|v| Vec2::from(corner(v)))).collect();
    let atlas = Atlas::new(Texture::zeros(16, 16, 4), None).unwrap();
    let meshes = vec![Mesh::new(positions, triangles, uvs, atlas).unwrap()];
    let scene = HybridScene { splats: Splats::empty(0), meshes, composition: Composition::default() };
    let camera = ahead([16, 16], 16.0, -3.0 * DVec3::Z);
    let peak = |vertices_move: bool| {
        let gpu = Gpu::open(None).unwrap();
        let mut training = Training::new(&gpu, &scene, &[camera], 0.2).unwrap();
        if vertices_move {
            training.free_vertices(&scene.meshes, &VertexState::new(&scene.meshes, 1.0)).unwrap();
        }
        gpu.peak_bytes() as f64
    };
    let stated = |vertices_move: bool| {
        let triangles = scene.meshes[0].triangles().len();
        training_bytes(&TrainingSize { triangles, vertices_move, layers: 1, ..TrainingSize::default() }).total() as f64
    };
    let (found, stated) = (peak(true) - peak(false), stated(true) - stated(false));
    // A sheet has slightly more vertices than half its triangles, because of its boundary.
    assert!((found / stated - 1.0).abs() < 0.02, "{found} bytes, not {stated}");
}

#[test]
fn a_million_splats_fit_eight_gigabytes() {
    let size = TrainingSize {
        splats: 1_000_000,
        sh_degree: 3,
        absolute_gradients: false,
        poses_move: false,
        triangles: 200_000,
        vertices_move: true,
        map_floats: 4 * 2048 * 2048 + 24 * 512 * 512,
        layers: 2,
        width: 1920,
        height: 1080,
    };
    // With lists of twice as many pairs.
    let bytes = training_bytes(&size).total();
    assert!(2 * bytes < 8_000_000_000, "{bytes} bytes");
}
