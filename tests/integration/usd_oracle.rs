//! Our files as read by OpenUSD, and the other way round. `CENTAUR_USD_PYTHON` names a Python with
//! tests/oracles/requirements-usd.txt.

use std::path::Path;
use std::process::Command;

use centaur::edit::Similarity;
use centaur::format::{self, Loss, ReadOptions, WriteOptions, ply};
use centaur::scene::{
    Atlas, Camera, ColorSpace, Composition, HybridScene, Intrinsics, Mesh, OrderMode, Splats, Texture, sh,
};
use glam::{DMat3, DMat4, DVec3, Quat, Vec2, Vec3};
use rand::{RngExt as _, SeedableRng as _};
use rand_pcg::Pcg64Mcg;
use serde_json::{Value, json};

fn python() -> std::ffi::OsString {
    std::env::var_os("CENTAUR_USD_PYTHON").expect("CENTAUR_USD_PYTHON names a Python")
}

/// Runs the Python script of this test; returns its output.
fn script(mode: &str, file: &Path, values: &Value) -> String {
    let json = file.with_extension("values.json");
    std::fs::write(&json, values.to_string()).unwrap();
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/oracles/usd_check.py");
    let output = Command::new(python()).arg(script).arg(mode).args([file, &json]).output().unwrap();
    assert!(output.status.success(), "{mode} {}: {}", file.display(), String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}

fn splats(count: usize, degree: u32) -> Splats {
    let mut rng = Pcg64Mcg::seed_from_u64(11);
    let mut r = |low: f32, high: f32| rng.random_range(low..high);
    let mut vec3 = |low, high| Vec3::new(r(low, high), r(low, high), r(low, high));
    let means = (0..count).map(|_| vec3(-3.0, 3.0)).collect();
    let log_scales = (0..count).map(|_| vec3(-9.0, 1.0)).collect();
    let sh = (0..count * sh::coefficients(degree)).map(|_| vec3(-0.9, 0.9).to_array()).collect();
    let rotations = (0..count).map(|_| Quat::from_vec4(vec3(-1.0, 1.0).extend(0.5))).collect();
    let logits = (0..count).map(|_| vec3(-6.0, 6.0).x).collect();
    Splats::new(means, rotations, log_scales, logits, degree, sh).unwrap()
}

fn mesh(degree: u32, seed: u64) -> Mesh {
    let mut rng = Pcg64Mcg::seed_from_u64(seed);
    let mut r = |low: f32, high: f32| rng.random_range(low..high);
    let positions = (0..5).map(|_| Vec3::new(r(-1., 1.), r(-1., 1.), r(-1., 1.))).collect();
    let triangles = vec![[0, 1, 2], [0, 3, 1], [0, 2, 4], [4, 3, 2]];
    let uvs = triangles.iter().map(|_| [(); 3].map(|()| Vec2::new(r(0., 1.), r(0., 1.)))).collect();
    let mut texture =
        |w: u32, h: u32, n: u32| Texture::new(w, h, n, (0..w * h * n).map(|_| r(-3.0, 3.0)).collect()).unwrap();
    let base = texture(8, 16, 4);
    let bands = (degree > 0).then(|| texture(4, 2, sh::band_floats(degree) as u32));
    Mesh::new(positions, triangles, uvs, Atlas::new(base, bands).unwrap()).unwrap()
}

fn camera() -> Camera {
    let intrinsics = Intrinsics { width: 640, height: 480, fx: 510.3, fy: 498.7, cx: 301.1, cy: 250.9 };
    let rotation = DMat3::from_euler(glam::EulerRot::YXZ, 0.4, -0.2, 1.7);
    Camera::new(intrinsics, rotation, DVec3::new(0.3, -2.0, 5.0)).unwrap()
}

/// Half a turn about x: from the capture's y down to the file's y up.
const TURN: DMat3 = DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0));

fn turned(p: Vec3) -> [f32; 3] {
    [p.x, -p.y, -p.z]
}

fn sigmoid(logit: f32) -> f32 {
    (1.0 / (1.0 + f64::from(-logit).exp())) as f32
}

fn values(splats: &Splats) -> Value {
    json!({
        "positions": splats.means().iter().map(Vec3::to_array).collect::<Vec<_>>(),
        "orientations": splats.rotations().iter().map(|q| [q.w, q.x, q.y, q.z]).collect::<Vec<_>>(),
        "scales": splats.log_scales().iter().map(|s| s.to_array().map(|s| f64::from(s).exp() as f32)).collect::<Vec<_>>(),
        "opacities": splats.opacity_logits().iter().map(|&l| sigmoid(l)).collect::<Vec<_>>(),
        "degree": splats.sh_degree(),
        "coefficients": splats.sh(),
    })
}

/// Appearance of a mesh in 8 bits: RGB, and opacity.
fn pictures(mesh: &Mesh) -> [Vec<u8>; 2] {
    let to_byte = |v: f32| (v.clamp(0.0, 1.0) * 255.0).round() as u8;
    let texels = || mesh.atlas().base().texels().chunks_exact(4);
    let rgb = texels().flat_map(|t| sh::rgb_from_dc([t[0], t[1], t[2]]).map(to_byte)).collect();
    [rgb, texels().map(|t| to_byte(sigmoid(t[3]))).collect()]
}

#[test]
#[ignore = "needs usd-core: make test-oracles"]
fn openusd_finds_what_was_written() {
    let folder = tempfile::tempdir().unwrap();
    let composition = Composition {
        mode: OrderMode::SurfaceConsistent,
        lambda: 0.1,
        layers: 2,
        color_space: ColorSpace::SrgbDisplay,
        background: [0.1, 0.2, 0.3],
        near: 0.07,
        ..Composition::default()
    };
    let scene = HybridScene { splats: splats(200, 3), meshes: vec![mesh(2, 1), mesh(0, 2)], composition };
    let camera = camera();
    // Rotation of quaternions and harmonics by formulas that the crate's own exact rotation must agree with.
    let mut arrays = scene.splats.clone().into_arrays();
    let harmonics = sh::Rotation::new(TURN);
    arrays.means.iter_mut().for_each(|p| *p = turned(*p).into());
    arrays.rotations.iter_mut().for_each(|q| *q = Quat::from_xyzw(1.0, 0.0, 0.0, 0.0) * *q);
    arrays.sh.chunks_exact_mut(16).for_each(|c| harmonics.apply(&mut c[1..]));
    let meshes: Vec<Value> = scene
        .meshes
        .iter()
        .map(|mesh| {
            let [emissive, opacity] = pictures(mesh);
            let corners = mesh.corner_uvs().as_flattened();
            json!({
                "points": mesh.positions().iter().map(|&p| turned(p)).collect::<Vec<_>>(),
                "indices": mesh.triangles(),
                "st": corners.iter().map(|uv| [uv.x, 1.0 - uv.y]).collect::<Vec<_>>(),
                "emissiveColor": emissive,
                "opacity": opacity,
            })
        })
        .collect();
    let points: Vec<Value> = [DVec3::ZERO, DVec3::X, DVec3::new(0.3, -0.8, 0.5)]
        .iter()
        .map(|&p| json!([(TURN * p).to_array(), camera.project(camera.to_camera(p)).to_array()]))
        .collect();
    let expected = json!({
        "splats": values(&arrays.check().unwrap()),
        "meshes": meshes,
        "cameras": [{ "path": "/Scene/front", "width": 640, "height": 480, "points": points }],
        "composition": { "lambda": 0.1f32, "layers": 2, "background": [0.1f32, 0.2f32, 0.3f32], "near": 0.07f32 },
    });
    for name in ["hybrid.usda", "hybrid.usdz"] {
        let file = folder.path().join(name);
        let cameras = [("front".to_owned(), camera)];
        format::write_scene(&file, &scene, &WriteOptions { cameras: &cameras, ..WriteOptions::default() }).unwrap();
        script("check", &file, &expected);
    }
    // OpenUSD's conversion to binary has the same content.
    let [ours, binary] =
        ["hybrid.usda", "hybrid.usdc"].map(|name| format::read_scene(&folder.path().join(name)).unwrap());
    assert!(ours == binary);
    assert_eq!((&ours.meshes, ours.composition), (&scene.meshes, scene.composition));
}

#[test]
#[ignore = "needs usd-core: make test-oracles"]
fn what_openusd_wrote_is_where_openusd_says() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("theirs.usda");
    let before = splats(100, 3);
    let said: Value = serde_json::from_str(&script("write", &file, &values(&before))).unwrap();
    let rows: [[f64; 4]; 4] = serde_json::from_value(said["world"].clone()).unwrap();
    // As scenes are read: y down.
    let world = DMat4::from_mat3(TURN) * DMat4::from_cols_array_2d(&rows);
    let linear = DMat3::from_mat4(world);
    let scale = linear.determinant().cbrt();

    let read = format::read_file(&file, &ReadOptions::default()).unwrap();
    assert!(read.y_up);
    let after = &read.scene.splats;
    let covariance = |s: &Splats, i: usize| {
        let axes =
            DMat3::from_quat(s.rotations()[i].as_dquat()) * DMat3::from_diagonal(s.log_scales()[i].as_dvec3().exp());
        axes * axes.transpose()
    };
    for i in 0..before.len() {
        let mean = world.transform_point3(before.means()[i].as_dvec3());
        assert!(mean.abs_diff_eq(after.means()[i].as_dvec3(), 1e-6), "{mean} {}", after.means()[i]);
        let expected = linear * covariance(&before, i) * linear.transpose();
        let size = expected.x_axis.x + expected.y_axis.y + expected.z_axis.z;
        assert!(expected.abs_diff_eq(covariance(after, i), 3e-6 * size), "{expected} {}", covariance(after, i));
        assert!((sigmoid(before.opacity_logits()[i]) - sigmoid(after.opacity_logits()[i])).abs() < 1e-6);
        // The radiance seen along a direction is seen along the rotated direction.
        let direction = DVec3::new(0.3, -0.5, 0.8).normalize();
        let red = |s: &Splats, d: DVec3| -> f64 {
            s.sh_of(i).iter().zip(sh::basis(d.to_array())).map(|(c, y)| f64::from(c[0]) * y).sum()
        };
        let seen = [red(&before, direction), red(after, (linear * direction / scale).normalize())];
        assert!((seen[0] - seen[1]).abs() < 2e-5, "{seen:?}");
    }
    let (name, camera) = &read.cameras[0];
    assert_eq!(name, "view");
    let ndc: Vec<[f64; 2]> = serde_json::from_value(said["ndc"].clone()).unwrap();
    let k = camera.intrinsics();
    let mut compared = 0;
    for (i, [x, y]) in ndc.iter().enumerate() {
        let p = camera.to_camera((world * before.means()[i].as_dvec3().extend(1.0)).truncate());
        let pixel = camera.project(p);
        let theirs = [(x + 1.0) / 2.0 * f64::from(k.width), (1.0 - y) / 2.0 * f64::from(k.height)];
        if p.z > 1e-3 && pixel.length() < 1e5 {
            // The image has an integer number of pixels, but apertures need not correspond to one.
            let near = (pixel.x - theirs[0]).abs().max((pixel.y - theirs[1]).abs());
            assert!(near < 1e-3 + 1e-5 * pixel.length(), "{pixel} {theirs:?}");
            compared += 1;
        }
    }
    assert!(compared > 10, "{compared}");
}

#[test]
#[ignore = "needs usd-core: make test-oracles"]
fn splats_of_nvidias_converter_are_read() {
    let folder = tempfile::tempdir().unwrap();
    let [from, to] = ["a.ply", "a.usda"].map(|name| folder.path().join(name));
    for degree in [0, 3] {
        let before = splats(100, degree);
        ply::write(&from, &before).unwrap();
        let tool = Path::new(&python()).with_file_name("usd-convert-gsplat");
        let output = Command::new(tool).arg("-i").arg(&from).arg("-o").arg(&to).output().unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        // The program keeps the axes of the PLY but declares y up.
        let after = Similarity::HALF_TURN.splats(format::read_scene(&to).unwrap().splats).unwrap();
        let e = Loss::of_splats(&before, &after).max_error;
        assert!(e.mean == 0.0 && e.sh == 0.0 && e.color == 0.0, "{e:?}");
        assert!(e.log_scale < 1e-5 && e.opacity < 1e-6 && e.rotation < 1e-3, "{e:?}");
    }
}
