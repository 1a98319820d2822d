//! A small file, or set of files, for every reader: damaged by tests, and the initial corpus of fuzzing.

#![allow(dead_code, reason = "not every program uses everything")]

mod moving;

use std::io::Cursor;
use std::path::Path;

use centaur::format::{self, CameraFile, ReadOptions, WriteOptions, ksplat, sog, spz};
use centaur::optimize::checkpoint::Checkpoint;
use centaur::render::gpu::state::SplatState;
use centaur::scene::{Atlas, Camera, Composition, HybridScene, Intrinsics, Mesh, PixelFilter, Splats, Texture, sh};
use glam::{DMat3, DVec3, Quat, Vec2, Vec3};
use image::{ImageFormat, Rgb, RgbImage};

/// Input of one call of a reader.
pub(crate) struct Sample {
    /// The target in `fuzz/` whose corpus it belongs to.
    pub(crate) reader: &'static str,
    /// Names and contents; several for a capture.
    pub(crate) files: Vec<(&'static str, Vec<u8>)>,
}

/// A grey image of 1×1 pixels.
pub(crate) const PHOTOGRAPH: &[u8] = b"\x89PNG\x0d\x0a\x1a\x0a\x00\x00\x00\x0dIHDR\x00\x00\x00\x01\x00\x00\x00\x01\x08\x00\x00\x00\x00:~\x9bU\x00\x00\x00\x0aIDATx\xdach\x00\x00\x00\x82\x00\x81\xdaE\x08;\x00\x00\x00\x00IEND\xaeB`\x82";

/// A triangle, from the glTF tutorial by Khronos.
const GLTF: &str = r#"{"asset":{"version":"2.0"},"scene":0,"scenes":[{"nodes":[0]}],"nodes":[{"mesh":0}],
"meshes":[{"primitives":[{"attributes":{"POSITION":1},"indices":0}]}],
"buffers":[{"uri":"data:application/octet-stream;base64,AAABAAIAAAAAAAAAAAAAAAAAAAAAAIA/AAAAAAAAAAAAAAAAAACAPwAAAAA=","byteLength":44}],
"bufferViews":[{"buffer":0,"byteOffset":0,"byteLength":6,"target":34963},{"buffer":0,"byteOffset":8,"byteLength":36,"target":34962}],
"accessors":[{"bufferView":0,"componentType":5123,"count":3,"type":"SCALAR","max":[2],"min":[0]},
{"bufferView":1,"componentType":5126,"count":3,"type":"VEC3","max":[1,1,0],"min":[0,0,0]}]}"#;

const OBJ: &str =
    "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nusemtl a\nf 1/1 2/2 3/3 4/4\nf -4 -3 -1\n";

const MESH_PLY: &str = "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n\
    property float s\nproperty float t\nelement face 1\nproperty list uchar uint vertex_indices\nend_header\n\
    0 0 0 0 0\n1 0 0 1 0\n1 1 0 1 1\n0 1 0 0 1\n4 0 1 2 3\n";

const CAMERAS: &str = "1 OPENCV 1 1 1.5 1.5 0.5 0.5 0.01 0 0 0\n2 PINHOLE 1 1 1.5 1.5 0.5 0.5\n";
const IMAGES: &str = "1 1 0 0 0 0 0 1.5 1 a.png\n0.5 0.5 -1\n2 0.5 0.5 0.5 0.5 0 0 1.5 2 b.png\n\n";
const POINTS: &str = "# id, position, colour, error, track\n1 0 0 0 255 0 0 0.1 1 0\n2 0.5 1 -2 0 255 0 0.1\n";

const TRANSFORMS: &str = r#"{"camera_angle_x":0.7,"w":1,"h":1,"k1":0.01,"frames":[
{"file_path":"images/a.png","transform_matrix":[[1,0,0,0],[0,1,0,0],[0,0,1,4],[0,0,0,1]]},
{"file_path":"images/b","transform_matrix":[[0,0,1,4],[0,1,0,0],[-1,0,0,0],[0,0,0,1]]}]}"#;

/// As written by nerfstudio's viewer.
const CAMERA_PATH: &str = r#"{"camera_type":"perspective","render_height":4,"render_width":8,"fps":24,"seconds":1,"camera_path":[
{"camera_to_world":[0,0,1,7,1,0,0,8,0,1,0,9,0,0,0,1],"fov":90,"aspect":2},
{"camera_to_world":[1,0,0,0,0,1,0,0,0,0,1,0,0,0,0,1],"fov":60.5,"aspect":2}]}"#;

/// Two parts in two levels of detail, with the contents of the other files.
const LEVELS: &str = r#"{"lodLevels":2,"filenames":["fine.sog","coarse.sog"],"tree":{"children":[
{"lods":{"0":{"file":0,"offset":0,"count":6},"1":{"file":1,"offset":0,"count":3}}},
{"lods":{"0":{"file":0,"offset":6,"count":3},"1":{"file":1,"offset":3,"count":1}}}]}}"#;

/// All samples.
pub(crate) fn samples() -> Vec<Sample> {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let mut samples = vec![];
    let mut add = |reader, files| samples.push(Sample { reader, files });
    let scene = scene(40, 2);
    for (reader, name) in [
        ("ply", "scene.ply"),
        ("compressed_ply", "scene.compressed.ply"),
        ("spz", "scene.spz"),
        ("splat", "scene.splat"),
        ("ksplat", "scene.ksplat"),
        ("sog", "scene.sog"),
        ("glb", "scene.glb"),
        ("usdz", "scene.usdz"),
    ] {
        let write = |path: &Path| format::write_scene(path, &scene, &WriteOptions::default()).map(drop);
        add(reader, vec![(name, written(folder.path(), name, write))]);
    }
    // Maps would be separate files.
    let bare = HybridScene { meshes: vec![], ..scene.clone() };
    let write = |path: &Path| format::write_scene(path, &bare, &WriteOptions::default()).map(drop);
    add("usda", vec![("scene.usda", written(folder.path(), "scene.usda", write))]);
    add("ply", vec![("scene.ply", ascii_ply().into_bytes())]);
    for version in [spz::Version::V2, spz::Version::V3] {
        let options = spz::Options { version, ..spz::Options::default() };
        let write = |path: &Path| spz::write(path, &scene.splats, &options).map(drop);
        add("spz", vec![("scene.spz", written(folder.path(), "scene.spz", write))]);
    }
    for level in [ksplat::Level::Half, ksplat::Level::HalfAndByte] {
        let write = |path: &Path| ksplat::write(path, &scene.splats, level).map(drop);
        add("ksplat", vec![("scene.ksplat", written(folder.path(), "scene.ksplat", write))]);
    }
    for (reader, name) in [("glb", "scene.glb"), ("usda", "scene.usda")] {
        let write = |path: &Path| format::write_cameras(path, &flight()).map(drop);
        add(reader, vec![(name, written(folder.path(), name, write))]);
    }
    add("gltf", vec![("scene.gltf", GLTF.into())]);
    let (document, bin) = moving::document("scene.bin");
    let moving = vec![("scene.gltf", document.to_string().into_bytes()), ("scene.bin", bin)];
    add("glb", vec![("scene.glb", as_glb(folder.path(), &moving))]);
    add("gltf_and_bin", moving);
    for bytes in [
        &include_bytes!("../data/meshopt/ext_quantized.glb")[..],
        include_bytes!("../data/meshopt/khr_float.glb"),
        include_bytes!("../data/meshopt/transform_high.glb"),
    ] {
        add("glb", vec![("scene.glb", bytes.to_vec())]);
    }
    for bytes in [&include_bytes!("../data/usd/moving.usdc")[..], include_bytes!("../data/usd/types.usdc")] {
        add("usdc", vec![("scene.usdc", bytes.to_vec())]);
    }
    let part = |name: &'static str, count: usize| {
        let write = |path: &Path| sog::write(path, &self::scene(count, 1).splats, PixelFilter::DILATION).map(drop);
        (name, written(folder.path(), name, write))
    };
    add("streamed_sog", vec![("lod-meta.json", LEVELS.into()), part("fine.sog", 9), part("coarse.sog", 4)]);
    add("obj", vec![("mesh.obj", OBJ.into())]);
    add("mesh_ply", vec![("mesh.ply", MESH_PLY.into())]);
    add(
        "colmap_text",
        vec![("cameras.txt", CAMERAS.into()), ("images.txt", IMAGES.into()), ("points3D.txt", POINTS.into())],
    );
    add("colmap_binary", colmap_binary());
    add("transforms", vec![("transforms.json", TRANSFORMS.into())]);
    add("transforms", vec![("transforms.json", CAMERA_PATH.into())]);
    for (mask, photograph) in [(ImageFormat::Png, ImageFormat::Jpeg), (ImageFormat::Jpeg, ImageFormat::Png)] {
        add(
            "photograph",
            vec![("masks/a.png", picture(mask, [255; 3])), ("images/a.png", picture(photograph, [9, 90, 200]))],
        );
    }
    let checkpoint = Checkpoint {
        splats: SplatState::from_splats(&self::scene(3, 1).splats),
        indices: [("corners".to_owned(), vec![0, 1, 2])].into(),
        ..Checkpoint::default()
    };
    let bytes = written(folder.path(), "scene.checkpoint", |path| checkpoint.write(path));
    add("checkpoint", vec![("scene.checkpoint", bytes)]);
    samples
}

/// A picture of 16×8 pixels, black except for a coloured square.
fn picture(format: ImageFormat, color: [u8; 3]) -> Vec<u8> {
    let shown = |x: u32, y: u32| if x < 8 && y > 1 { color } else { [0; 3] };
    let mut bytes = Cursor::new(vec![]);
    let picture = RgbImage::from_fn(16, 8, |x, y| Rgb(shown(x, y)));
    picture.write_to(&mut bytes, format).expect("a picture in memory");
    bytes.into_inner()
}

/// The same document in one file.
fn as_glb(folder: &Path, files: &[(&str, Vec<u8>)]) -> Vec<u8> {
    for (name, content) in files {
        std::fs::write(folder.join(name), content).expect("a file in a temporary folder");
    }
    let options = ReadOptions { keep_document: true, ..ReadOptions::default() };
    let file = format::read_file(&folder.join(files[0].0), &options).expect("a valid document");
    let options = WriteOptions { cameras: &file.cameras, source: file.source.as_ref(), ..WriteOptions::default() };
    let write = |path: &Path| format::write_scene(path, &file.scene, &options).map(drop);
    written(folder, "whole.glb", write)
}

fn written<E: std::fmt::Debug>(folder: &Path, name: &str, write: impl FnOnce(&Path) -> Result<(), E>) -> Vec<u8> {
    let path = folder.join(name);
    write(&path).expect("a valid scene in a temporary folder");
    std::fs::read(path).expect("what was written")
}

/// A square with maps among splats on a helix.
fn scene(count: usize, degree: u32) -> HybridScene {
    let t = |i: usize| i as f32 / count as f32;
    let splats = Splats::new(
        (0..count).map(|i| Vec3::new((9.0 * t(i)).cos(), (9.0 * t(i)).sin(), t(i))).collect(),
        (0..count).map(|i| Quat::from_rotation_y(3.0 * t(i))).collect(),
        (0..count).map(|i| Vec3::new(-3.0, -4.0 * t(i), -5.0)).collect(),
        (0..count).map(|i| 6.0 * t(i) - 3.0).collect(),
        degree,
        (0..count * sh::coefficients(degree)).map(|i| [(i as f32).sin() * 0.5, 0.1, -0.2]).collect(),
    )
    .expect("valid splats");
    let base = Texture::new(4, 4, 4, (0..64).map(|i| i as f32 * 0.02).collect()).expect("a texture");
    let bands = Texture::new(2, 2, 9, vec![0.1; 36]).expect("a texture");
    let mesh = Mesh::new(
        vec![Vec3::ZERO, Vec3::X, Vec3::new(1.0, 1.0, 0.0), Vec3::Y],
        vec![[0, 1, 2], [0, 2, 3]],
        vec![[Vec2::ZERO, Vec2::X, Vec2::ONE], [Vec2::ZERO, Vec2::ONE, Vec2::Y]],
        Atlas::new(base, Some(bands)).expect("an atlas"),
    )
    .expect("a mesh");
    HybridScene { splats, meshes: vec![mesh], composition: Composition::default() }
}

/// A camera that moves and rotates for a quarter of a second.
fn flight() -> CameraFile {
    let frame = |i: usize| {
        let lens = Intrinsics { width: 8, height: 4, fx: 5.0, fy: 5.0, cx: 4.0, cy: 2.0 };
        let camera = Camera::new(lens, DMat3::from_rotation_y(0.3 * i as f64), DVec3::new(0.0, 0.1 * i as f64, 2.0));
        (format!("frame_{i:05}"), camera.expect("a rigid pose"))
    };
    CameraFile {
        cameras: (0..7).map(frame).collect(),
        fps: Some(24.0),
        y_up: false,
        times: vec![],
        near: None,
        images: None,
        notes: vec![],
    }
}

fn ascii_ply() -> String {
    let names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2", "rot_0"];
    let names = names.into_iter().chain(["rot_1", "rot_2", "rot_3", "label"]);
    let properties: String = names.map(|name| format!("property float {name}\n")).collect();
    let rows: String = (0..3).map(|i| format!("{i} 1e-3 -2.5 0.1 .2 0.3 inf -4 -5 -6 1 0 0 0 {i}\n")).collect();
    format!("ply\nformat ascii 1.0\ncomment by hand\nelement vertex 3\n{properties}end_header\n{rows}")
}

/// A camera, two images and a point.
fn colmap_binary() -> Vec<(&'static str, Vec<u8>)> {
    let mut cameras = [1u64.to_le_bytes(), [1, 0, 0, 0, 1, 0, 0, 0], 1u64.to_le_bytes(), 1u64.to_le_bytes()].concat();
    cameras.extend([1.5, 1.5, 0.5, 0.5].map(f64::to_le_bytes).concat());
    let mut images = 2u64.to_le_bytes().to_vec();
    for (id, name) in [(1u32, b"a.png\0"), (2, b"b.png\0")] {
        images.extend(id.to_le_bytes());
        images.extend([1.0, 0.0, 0.0, 0.0, 0.0, 0.5, f64::from(id)].map(f64::to_le_bytes).concat());
        images.extend(1u32.to_le_bytes());
        images.extend(name);
        images.extend([1u64.to_le_bytes(), 0.5f64.to_le_bytes(), 0.5f64.to_le_bytes(), 1u64.to_le_bytes()].concat());
    }
    let mut points = [1u64.to_le_bytes(), 1u64.to_le_bytes()].concat();
    points.extend([0.1, 0.2, 0.3].map(f64::to_le_bytes).concat());
    points.extend([255, 0, 0]);
    points.extend([0.5f64.to_le_bytes(), 1u64.to_le_bytes(), [1, 0, 0, 0, 0, 0, 0, 0]].concat());
    vec![("cameras.bin", cameras), ("images.bin", images), ("points3D.bin", points)]
}
