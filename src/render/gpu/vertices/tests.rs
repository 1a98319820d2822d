//! Steps of vertices compared with f64: gradients, Adam, and smoothing over the surface.

use std::collections::BTreeSet;

use glam::{DVec3, Vec2};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;

use super::*;
use crate::{
    render::{
        gpu::{
            backward::Backward,
            pipeline::Pipeline,
            status::{Status, status_buffer},
        },
        reference::{self, Image},
        testing,
    },
    scene::{Atlas, OrderMode, Texture},
};

/// β₁ and β₂ as rounded to f32; new values are weighted by 1 minus these.
const BETAS: [f32; 2] = [0.9, 0.999];
/// 2³², whose low word is 0.
const WIDE: i64 = 1 << 32;

fn mesh(positions: Vec<Vec3>, triangles: Vec<[u32; 3]>) -> Mesh {
    let uvs = vec![[Vec2::ZERO, Vec2::X, Vec2::Y]; triangles.len()];
    Mesh::new(positions, triangles, uvs, Atlas::new(Texture::zeros(1, 1, 4), None).unwrap()).unwrap()
}

/// A sheet of three by three cells with an additional triangle at a corner and one on an inner edge; and a tent.
fn meshes() -> [Mesh; 2] {
    let grid = (0..16_u8).map(|i| Vec3::new(f32::from(i % 4), f32::from(i / 4), 0.0) / 3.0);
    let cells = [0, 1, 2, 4, 5, 6, 8, 9, 10];
    let mut triangles: Vec<[u32; 3]> = cells.iter().flat_map(|&a| [[a, a + 1, a + 5], [a, a + 5, a + 4]]).collect();
    triangles.extend([[0, 16, 17], [5, 6, 18]]);
    // The last vertex belongs to no triangle.
    let others = [[-0.3, -0.1, 0.0], [-0.1, -0.3, 0.0], [0.5, 0.3, 0.4], [1.0, 1.0, 1.0]].map(Vec3::from);
    let sheet = mesh(grid.chain(others).collect(), triangles);
    let corners = [[0.0, 0.0, 1.0], [1.0, 0.0, 1.0], [1.0, 1.0, 1.0], [0.0, 1.0, 1.0], [0.5, 0.5, 1.4]];
    let tent = mesh(corners.map(Vec3::from).to_vec(), vec![[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]]);
    [sheet, tent]
}

/// Vertices with which each vertex is smoothed: its neighbours or, on a boundary (edges not shared by two triangles),
/// those along it.
fn neighbors(meshes: &[Mesh]) -> Vec<Vec<usize>> {
    let mut of = vec![];
    for mesh in meshes {
        let (first, n) = (of.len(), mesh.positions().len());
        let has = |t: &[u32; 3], v: usize| t.contains(&(v as u32));
        let shared = |a: usize, b: usize| mesh.triangles().iter().filter(|t| has(t, a) && has(t, b)).count();
        let is_border = |a: usize, b: usize| a != b && ![0, 2].contains(&shared(a, b));
        for a in 0..n {
            let on_border = (0..n).any(|b| is_border(a, b));
            let is_near = |b: &usize| if on_border { is_border(a, *b) } else { a != *b && shared(a, *b) > 0 };
            of.push((0..n).filter(is_near).map(|b| first + b).collect());
        }
    }
    of
}

/// Free vertices with the buffers of their steps.
struct Rig<'g> {
    gpu: &'g Gpu,
    vertices: Vertices,
    positions: Buffer,
    status: Buffer,
    peaks: Buffer,
}

impl<'g> Rig<'g> {
    fn new(gpu: &'g Gpu, meshes: &[Mesh], state: &VertexState) -> Self {
        let floats: Vec<f32> = meshes.iter().flat_map(Mesh::positions).flat_map(Vec3::to_array).collect();
        let positions = gpu.storage_with("positions", &floats).unwrap();
        let (status, peaks) = (status_buffer(gpu).unwrap(), gpu.storage("peaks", PEAKS).unwrap());
        let defines = gpu.defines().with("LAYERS", 1).with("BANDS", 0);
        let vertices = Vertices::new(gpu, &defines, meshes, &positions, [&status, &peaks], state).unwrap();
        Self { gpu, vertices, positions, status, peaks }
    }

    /// A step with gradients in fixed-point units, where `largest`, the largest gradient of a fragment, equals
    /// `FIXED_ONE` units.
    fn step(&self, step: &VertexStep, units: &[i64], largest: f32) {
        let words: Vec<[u32; 2]> = units.iter().map(|&u| [u as u32, (u >> 32) as u32]).collect();
        self.gpu.write(&self.vertices.gradient, 0, &words);
        self.gpu.write(&self.peaks, 4, &[largest]);
        self.vertices.set_step(self.gpu, step);
        let mut frame = Frame::new(self.gpu);
        self.vertices.record_step(&mut frame);
        frame.submit();
    }

    /// Positions, first and second moments.
    fn read(&self) -> (Vec<DVec3>, Vec<[f32; 2]>) {
        let positions: Vec<f32> = self.gpu.read(&self.positions, 3 * self.vertices.count).unwrap();
        let moments = self.vertices.read_state(self.gpu).unwrap().moments;
        let positions = positions.chunks_exact(3).map(|p| Vec3::from_slice(p).as_dvec3()).collect();
        (positions, moments.as_chunks::<2>().0.to_vec())
    }
}

/// Adam's step number `t`, after updating the moments with a gradient.
fn adam(moments: &mut [f64; 2], g: f64, t: i32) -> f64 {
    let [first, second] = BETAS.map(f64::from);
    *moments = [first * moments[0] + (1.0 - first) * g, second * moments[1] + (1.0 - second) * g * g];
    let [first, second] = [moments[0] / (1.0 - 0.9_f64.powi(t)), moments[1] / (1.0 - 0.999_f64.powi(t))];
    first / (second.sqrt() + 1e-15)
}

/// Sixteen Jacobi iterations for (1 + 8·Laplacian)·x = steps, where the Laplacian is the difference from the mean of
/// the neighbours.
fn smoothed(steps: &[f64], neighbors: &[Vec<usize>]) -> Vec<f64> {
    (0..16).fold(steps.to_vec(), |x, _| {
        let of_vertex = |(step, around): (&f64, &Vec<usize>)| match around.len() {
            0 => *step,
            n => (step + 8.0 * around.iter().map(|v| x[*v]).sum::<f64>() / n as f64) / 9.0,
        };
        steps.iter().zip(neighbors).map(of_vertex).collect()
    })
}

#[test]
fn three_steps_equal_adam_and_jacobi_in_f64() {
    let (meshes, pixel) = (meshes(), 0.5_f32);
    let neighbors = neighbors(&meshes);
    let n = neighbors.len();
    assert_eq!(neighbors.iter().map(Vec::len).collect::<BTreeSet<_>>(), BTreeSet::from([0, 2, 4, 6]));
    assert_eq!((neighbors[0].len(), neighbors[5].len(), neighbors[9].len()), (4, 2, 6), "two on borders, one inside");
    for gpu in [Gpu::open(None).unwrap(), Gpu::open(None).unwrap().posing_as_gpu()] {
        let mut rng = Pcg32::seed_from_u64(4);
        let mut normal = || Vec3::from_array([0; 3].map(|_| rng.random_range(-1.0..1.0_f32))).normalize();
        let normals: Vec<Vec3> = (0..n).map(|_| normal()).collect();
        let state = VertexState { pixel, normals: bytemuck::cast_slice(&normals).to_vec(), moments: vec![0.0; 2 * n] };
        let rig = Rig::new(&gpu, &meshes, &state);
        let (mut positions, mut moments) = (rig.read().0, vec![[0.0_f64; 2]; n]);
        let (mut last, mut turned) = (vec![0_i64; n], 0);
        for (t, rate, largest) in [(1_usize, 0.8, 0.37_f32), (2, 0.5, 2.1e-3), (3, 1.1, 40.0)] {
            // Values of either sign and any magnitude, including some with a zero word or a carry between the words.
            let units: Vec<i64> = (0..n)
                .map(|v| match (v + 3 * t) % 8 {
                    0 => [0, WIDE, -1][v % 3],
                    1 => [-WIDE, 3 * WIDE, -5 * WIDE][v % 3],
                    2 => rng.random_range(-100..100),
                    3 => rng.random_range(-WIDE..WIDE),
                    _ => rng.random_range(-(WIDE << 6)..WIDE << 6),
                })
                .collect();
            turned += units.iter().zip(&last).filter(|(a, b)| a.signum() * b.signum() < 0).count();
            last.clone_from(&units);
            let step = VertexStep { number: t as u32, rate };
            rig.step(&step, &units, largest);

            let unit = f64::from(largest) / f64::from(FIXED_ONE);
            let of_vertex = |(m, units): (&mut [f64; 2], &i64)| adam(m, unit * *units as f64, t as i32);
            let steps: Vec<f64> = moments.iter_mut().zip(&units).map(of_vertex).collect();
            let (found, found_moments) = rig.read();
            let rate = f64::from(rate * pixel);
            for (v, smooth) in smoothed(&steps, &neighbors).into_iter().enumerate() {
                positions[v] -= rate * smooth * normals[v].as_dvec3();
                let error = found[v].distance(positions[v]);
                assert!(error < 1e-5 * rate, "step {t}, vertex {v}: {error:e} of {rate}, {} units", units[v]);
                // First moments are sums of terms that can cancel, each with its rounding.
                for (k, scale) in [moments[v][1].sqrt(), moments[v][1]].into_iter().enumerate() {
                    let (found, expected) = (f64::from(found_moments[v][k]), moments[v][k]);
                    assert!((found - expected).abs() <= 1e-5 * scale, "step {t}, vertex {v}: {found}, not {expected}");
                }
            }
        }
        assert!(turned > 5, "{turned} gradients turn round");
        assert_eq!(Status::read(&gpu, &rig.status).unwrap().not_finite, None);

        // A step that must not change anything.
        let before = rig.read();
        gpu.write(&rig.status, 0, &[1_u32]);
        rig.step(&VertexStep { number: 4, rate: 1.0 }, &last, 1.0);
        assert!(rig.read() == before);
    }
}

/// Sums of two words equal 64-bit sums: Adam's first moments after the first step are a tenth of them.
#[test]
fn adam_has_the_sums_of_both_words() {
    let gpu = Gpu::open(None).unwrap();
    let meshes = meshes();
    let rig = Rig::new(&gpu, &meshes, &VertexState::new(&meshes, 1.0));
    let around = [0, WIDE, 1 << 31, 1 << 24, 5 * WIDE, 1 << 43, 1];
    let units: Vec<i64> = around.into_iter().flat_map(|u| [u, -u, u - 1, 1 - u]).collect();
    let units = &units[..rig.vertices.count];
    assert!(units.iter().filter(|u| **u as u32 == 0).count() > 5);
    let largest = 3.0_f32;
    rig.step(&VertexStep { number: 1, rate: 0.0 }, units, largest);
    let (positions, moments) = rig.read();
    let read_back = rig.vertices.read_gradient(&gpu, &rig.peaks).unwrap();
    for ((units, [first, second]), read) in units.iter().zip(&moments).zip(read_back) {
        let g = f64::from(largest) / f64::from(FIXED_ONE) * *units as f64;
        for (found, expected) in [(*first, 0.1 * g), (*second, (1.0 - f64::from(BETAS[1])) * g * g), (read, g)] {
            assert!((f64::from(found) - expected).abs() <= 1e-6 * expected.abs(), "{units}: {found}, not {expected}");
        }
    }
    let given = meshes.iter().flat_map(Mesh::positions).map(|p| p.as_dvec3());
    assert!(given.eq(positions), "of rate 0 nothing moves");
}

/// From the cotangent of a picture to Adam: gradients along the normals.
#[test]
fn adam_has_the_gradients_of_the_reference() {
    for (gpu, seed) in [(Gpu::open(None).unwrap(), 0), (Gpu::open(None).unwrap().posing_as_gpu(), 1)] {
        let (scene, camera) = testing::smooth_scene(seed, 2, OrderMode::SurfaceConsistent);
        let (k, mut rng) = (camera.intrinsics(), Pcg32::seed_from_u64(seed));
        let cotangent = Image {
            width: k.width as usize,
            height: k.height as usize,
            rgb: (0..k.pixels()).map(|_| [0; 3].map(|_| rng.random_range(-1.0..1.0))).collect(),
            transmittance: vec![0.0; k.pixels()],
        };
        let status = status_buffer(&gpu).unwrap();
        let mut pipeline = Pipeline::new(&gpu, &scene, 0, &[camera], Some(&status)).unwrap();
        let backward = Backward::new(&gpu, &pipeline, status, false).unwrap();
        let state = VertexState::new(&scene.meshes, 1.0);
        let front = &mut pipeline.front;
        let mesh = front.mesh.as_mut().unwrap();
        mesh.free_vertices(&gpu, &scene.meshes, &front.view, &backward.status, &state).unwrap();
        let view = pipeline.prepare(&gpu, &camera).unwrap();
        let words: Vec<f32> = cotangent.rgb.iter().flat_map(|g| [g[0], g[1], g[2], 0.0].map(|v| v as f32)).collect();
        gpu.write(&backward.image_gradient, 0, &words);
        let mut frame = Frame::new(&gpu);
        pipeline.record(&gpu, &mut frame, &view);
        backward.record(&mut frame, &pipeline, &view);
        let mesh = pipeline.front.mesh.as_ref().unwrap();
        mesh.record_vertex_backward(&mut frame);
        mesh.record_vertex_step(&gpu, &mut frame, &VertexStep { number: 1, rate: 0.0 });
        frame.submit();

        let expected = reference::backward(&scene, &camera, &cotangent).positions.concat();
        let moments = mesh.vertices().unwrap().read_state(&gpu).unwrap().moments;
        assert_eq!((moments.len(), state.normals.len()), (2 * expected.len(), 3 * expected.len()));
        let normals = state.normals.as_chunks::<3>().0.iter().map(|n| Vec3::from_array(*n).as_dvec3());
        let expected: Vec<f64> = expected.iter().zip(normals).map(|(g, n)| g.dot(n)).collect();
        let square = |difference: f64| difference * difference;
        let pairs = moments.iter().step_by(2).zip(&expected);
        let error = pairs.map(|(m, g)| square(10.0 * f64::from(*m) - g)).sum::<f64>().sqrt();
        let norm = expected.iter().copied().map(square).sum::<f64>().sqrt();
        eprintln!("{:?}: {:.1e}", gpu.profile(), error / norm);
        assert!(norm > 0.0 && error < 1e-3 * norm, "{error:e} of {norm:e}");
    }
}
