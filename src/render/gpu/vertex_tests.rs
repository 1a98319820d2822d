//! Displaced vertices are moved back to the surface shown in photographs.

use glam::{DVec3, Vec2, Vec3};

use super::{
    Gpu,
    training::{Show, Step, Training},
    vertices::{VertexState, VertexStep},
};
use crate::scene::{Atlas, Camera, Composition, HybridScene, Intrinsics, Mesh, Splats, Texture};

const SIDE: u32 = 96;
const CELLS: u32 = 12;

/// A camera that looks at the origin from `azimuth`, 0.7 rad above the plane z = 0.
fn camera(azimuth: f64) -> Camera {
    camera_at(2.2, azimuth)
}

/// A camera with a picture about 2.2 wide at the origin.
fn camera_at(distance: f64, azimuth: f64) -> Camera {
    let size = f64::from(SIDE);
    let focal = size * distance / 2.2;
    let intrinsics = Intrinsics { width: SIDE, height: SIDE, fx: focal, fy: focal, cx: 0.5 * size, cy: 0.5 * size };
    let eye = distance * DVec3::new(azimuth.cos() * 0.7_f64.cos(), azimuth.sin() * 0.7_f64.cos(), 0.7_f64.sin());
    Camera::look_at(intrinsics, eye, DVec3::ZERO, DVec3::Z).unwrap()
}

/// A square of side 2 at heights `z(x, y)` with an opaque wave pattern of about ten pixels per wavelength.
fn sheet(z: impl Fn(f32, f32) -> f32) -> HybridScene {
    let side = CELLS + 1;
    let uv = |i: u32| Vec2::new((i % side) as f32, (i / side) as f32) / CELLS as f32;
    let position = |i: u32| {
        let p = 2.0 * uv(i) - 1.0;
        Vec3::new(p.x, p.y, z(p.x, p.y))
    };
    let corners = |c: u32| {
        let a = c / CELLS * side + c % CELLS;
        [[a, a + 1, a + side + 1], [a, a + side + 1, a + side]]
    };
    let triangles: Vec<[u32; 3]> = (0..CELLS * CELLS).flat_map(corners).collect();
    let texel = |i: u32| {
        let (x, y) = ((i % 64) as f32, (i / 64) as f32);
        [(0.6 * x).sin(), (0.7 * y).cos(), (0.5 * (x + y)).sin() * (0.3 * x).cos(), 6.0]
    };
    let base = Texture::new(64, 64, 4, (0..64 * 64).flat_map(texel).collect()).unwrap();
    let uvs = triangles.iter().map(|t| t.map(uv)).collect();
    let positions = (0..side * side).map(position).collect();
    let mesh = Mesh::new(positions, triangles, uvs, Atlas::new(base, None).unwrap()).unwrap();
    let composition = Composition { layers: 1, ..Composition::default() };
    HybridScene { splats: Splats::empty(0), meshes: vec![mesh], composition }
}

/// A step that moves only vertices.
fn of_vertices<'a>(camera: &'a Camera, truth: &'a [u8], vertices: Option<VertexStep>) -> Step<'a> {
    Step { vertices, ..Step::still(camera, truth) }
}

fn rms_height(meshes: &[Mesh]) -> f32 {
    let squares = meshes[0].positions().iter().map(|p| p.z * p.z);
    (squares.sum::<f32>() / meshes[0].positions().len() as f32).sqrt()
}

#[test]
fn a_bent_sheet_flattens_to_its_photographs() {
    let gpu = Gpu::open(None).unwrap();
    let cameras: Vec<Camera> = (0..5).map(|i| camera(1.3 * f64::from(i))).collect();
    let mut flat = Training::new(&gpu, &sheet(|_, _| 0.0), &cameras, 0.2).unwrap();
    let photographs: Vec<Vec<u8>> = (cameras.iter())
        .map(|c| {
            let picture = flat.render(c, [0.0; 3], Show::MeshesAlone).unwrap();
            let byte = |v: &f32| (v.clamp(0.0, 1.0) * 255.0).round() as u8;
            picture.rgb.iter().flat_map(|p| [byte(&p[0]), byte(&p[1]), byte(&p[2]), 255]).collect()
        })
        .collect();
    // A displacement of one and a half pixels.
    let scene = sheet(|x, y| 0.035 * (2.0 * x).cos() * (1.5 * y + 0.5).cos());
    let mut training = Training::new(&gpu, &scene, &cameras, 0.2).unwrap();
    training.free_vertices(&scene.meshes, &VertexState::new(&scene.meshes, 2.2 / SIDE as f32)).unwrap();
    for t in 0..160_u32 {
        let view = t as usize % cameras.len();
        // Gradients from the time when vertices are fixed have no influence later.
        let number = t.checked_sub(10).map(|t| t + 1);
        if number == Some(1) {
            let mesh = training.pipeline.front.mesh.as_ref().unwrap();
            assert!(mesh.read_vertex_gradient(&gpu).unwrap().iter().all(|g| *g == 0.0));
        }
        let step = |number| VertexStep { number, rate: 0.1 * 0.1_f32.powf(number as f32 / 150.0) };
        training.step(&of_vertices(&cameras[view], &photographs[view], number.map(step))).unwrap();
    }
    let (before, after) = (rms_height(&scene.meshes), rms_height(&training.read_meshes(&scene.meshes).unwrap()));
    eprintln!("rms height {before} became {after}");
    // Vertices at the boundary are seen by few pixels and move less.
    assert!(after < 0.3 * before, "rms height {before} became {after}");
    let state = training.read_vertex_state().unwrap();
    assert_eq!(state.moments.len(), 2 * scene.meshes[0].positions().len());
}

/// A wall with a brightness gradient across the whole picture, so that all pixels give gradients of equal sign: two
/// million pixels and hundreds of thousands give the same gradient to the central vertex, since both are means over
/// pixels. One texel is far steeper: the largest gradient of a fragment is `FIXED_ONE` units, and that of other
/// fragments is about 1,400 units, whose sum over two million fragments exceeds 32 bits.
#[test]
fn a_wall_is_pulled_as_far_in_large_pictures() {
    const STEEP: f32 = 15.0;
    let gpu = Gpu::open(None).unwrap();
    let corners = [[0.0, 0.0], [-8.0, -8.0], [8.0, -8.0], [8.0, 8.0], [-8.0, 8.0]];
    let corners = corners.map(|[x, y]| Vec3::new(x, y, 0.0));
    let uv = |v: u32| 0.5 + corners[v as usize].truncate() / 16.0;
    let triangles = vec![[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 1]];
    let red = |i: u32| if i == 64 * 33 + 33 { STEEP } else { (i % 64) as f32 / 64.0 };
    let ramp = (0..64 * 64).flat_map(|i| [red(i), 0.0, 0.0, 6.0]).collect();
    let atlas = Atlas::new(Texture::new(64, 64, 4, ramp).unwrap(), None).unwrap();
    let uvs = triangles.iter().map(|t: &[u32; 3]| t.map(uv)).collect();
    let mesh = Mesh::new(corners.to_vec(), triangles, uvs, atlas).unwrap();
    let composition = Composition { layers: 1, ..Composition::default() };
    let scene = HybridScene { splats: Splats::empty(0), meshes: vec![mesh], composition };
    let pulled = |side: u32| {
        let camera = camera_at(100.0, 0.0).resized(side, side);
        let mut training = Training::new(&gpu, &scene, &[camera], 0.0).unwrap();
        training.free_vertices(&scene.meshes, &VertexState::new(&scene.meshes, 0.01)).unwrap();
        let truth = vec![0; 4 * (side * side) as usize];
        let step = of_vertices(&camera, &truth, Some(VertexStep { number: 1, rate: 0.0 }));
        training.step(&step).unwrap();
        while training.grow_if_short().unwrap() > 0 {
            training.step(&step).unwrap();
        }
        training.pipeline.front.mesh.as_ref().unwrap().read_vertex_gradient(&gpu).unwrap()
    };
    let (few, many) = (pulled(800), pulled(1600));
    let largest = few.iter().fold(0.0_f32, |a, g| a.max(g.abs()));
    assert!(largest > 0.0 && few[0].abs() == largest, "{few:?}");
    for (few, many) in few.iter().zip(&many) {
        // The two flanks of the steep texel cancel except for a column of pixels, 1/180 of it, which is 7 % of the
        // total; an overflow would change 100 % or more.
        assert!((few - many).abs() < 0.1 * largest, "{few} {many}");
    }
}
