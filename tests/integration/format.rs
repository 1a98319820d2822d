//! Readers on files made by other projects. `CENTAUR_DATA` names the folder (default `../shared/data`).

use crate::common::data;
use centaur::format::{inspect, mesh_import, ply, read_scene};
use glam::Vec3;

#[test]
#[ignore = "needs shared data"]
fn ascii_cube_of_twenty_splats() {
    let splats = read_scene(&data("oracle_javagl/jsplat-examples/data/unitCube-ascii.ply")).unwrap().splats;
    assert_eq!((splats.len(), splats.sh_degree()), (20, 0));
    assert_eq!(splats.means()[7], Vec3::new(10.0, -10.0, -10.0));
    assert_eq!(splats.sh_of(1)[0], [1.772_453_9, -1.772_453_9, -1.772_453_9]);
    assert_eq!(splats.opacity_logits()[19], 20.0);
}

#[test]
#[ignore = "needs shared data"]
fn beetle_in_ascii_and_binary_is_one_mesh() {
    let [ascii, binary] = ["ascii", "binary"].map(|kind| {
        mesh_import::read(&data(&format!("oracle_metalsplatter/PLYIO/TestData/beetle.{kind}.ply"))).unwrap()
    });
    assert_eq!(ascii.triangles, binary.triangles);
    assert!(ascii.triangles.len() > 1000, "{}", ascii.triangles.len());
    // The ASCII file has six digits.
    assert!(ascii.positions.iter().zip(&binary.positions).all(|(a, b)| (*a - *b).length() < 1e-5 * (1.0 + a.length())));
}

#[test]
#[ignore = "needs shared data"]
fn cubes_with_colours() {
    for entry in data("oracle_adobe_usd_plugins/ply/tests").read_dir().unwrap() {
        let path = entry.unwrap().path();
        let points = ply::read_points(&path).unwrap();
        assert!(points.len() >= 8, "{}: {}", path.display(), points.len());
    }
}

#[test]
#[ignore = "needs shared data"]
fn spot_and_bob() {
    for (file, vertices, triangles) in [("spot/spot.obj", 2930, 5856), ("bob/bob_tri.obj", 5344, 10688)] {
        let mesh = mesh_import::read(&data(&format!("mesh_spot_bob/{file}"))).unwrap();
        assert_eq!((mesh.positions.len(), mesh.triangles.len()), (vertices, triangles), "{file}");
        assert!(mesh.corner_uvs.is_some(), "{file}");
        // Both are closed: Euler's formula gives the genus (a cow is a sphere, a swim ring is not).
        let mut edges: Vec<_> = mesh.triangles.iter().flat_map(|&[a, b, c]| [(a, b), (b, c), (c, a)]).collect();
        edges.iter_mut().for_each(|e| *e = (e.0.min(e.1), e.0.max(e.1)));
        edges.sort_unstable();
        edges.dedup();
        let euler = (vertices + triangles) as i64 - edges.len() as i64;
        assert_eq!(euler, if file.starts_with("spot") { 2 } else { 0 });
    }
}

#[test]
#[ignore = "needs shared data"]
fn khronos_samples_import() {
    // Name, number of triangles, and whether the UVs form one atlas, from the sample's accessors.
    let samples = [
        ("Suzanne/glTF/Suzanne.gltf", 3936, true),
        ("Fox/glTF-Binary/Fox.glb", 576, true),
        ("SimpleMorph/glTF/SimpleMorph.gltf", 1, false),
        ("SimpleSkin/glTF/SimpleSkin.gltf", 8, false),
        ("SimpleSparseAccessor/glTF/SimpleSparseAccessor.gltf", 12, false),
    ];
    for (file, triangles, uvs) in samples {
        let mesh = mesh_import::read(&data(&format!("meshes_gltf_samples/{file}"))).unwrap();
        assert_eq!((mesh.triangles.len(), mesh.corner_uvs.is_some()), (triangles, uvs), "{file}");
    }
}

#[test]
#[ignore = "needs shared data"]
fn sparse_elements_replace_stored_ones() {
    let path = "meshes_gltf_samples/SimpleSparseAccessor/glTF/SimpleSparseAccessor.gltf";
    let mesh = mesh_import::read(&data(path)).unwrap();
    // Vertices 8, 10 and 12 are moved up from y = 1 (the sample's README).
    for y in [2.0, 3.0, 4.0] {
        assert!(mesh.positions.iter().any(|p| p.y == y), "{y}");
    }
}

#[test]
#[ignore = "needs shared data"]
fn khronos_samples_as_scenes() {
    let mut read = 0;
    for model in data("meshes_gltf_samples").read_dir().unwrap() {
        for folder in ["glTF", "glTF-Binary"].map(|f| model.as_ref().unwrap().path().join(f)) {
            for file in folder.read_dir().into_iter().flatten().map(|f| f.unwrap().path()) {
                if file.extension().is_some_and(|e| e == "gltf" || e == "glb") {
                    let scene = read_scene(&file).unwrap_or_else(|e| panic!("{e}"));
                    assert!(!scene.meshes.is_empty() && scene.splats.is_empty(), "{}", file.display());
                    assert!(!inspect(&file).unwrap().warnings.is_empty(), "materials are reduced, and that is said");
                    read += 1;
                }
            }
        }
    }
    assert_eq!(read, 12);
}

#[test]
#[ignore = "needs shared data"]
fn splats_of_every_format_are_told_by_content_or_name() {
    for (file, format, count) in [
        ("oracle_metalsplatter/SplatIO/TestData/test-splat.3-points-from-train.ply", "PLY", 3),
        ("splats_playcanvas/guitar.compressed.ply", "PLY", 90_854),
        ("oracle_splat_transform/splat/minimal-raw.spz", "SPZ", 4),
        ("oracle_splat_transform/splat/minimal-v2.spz", "SPZ", 4),
        ("oracle_splat_transform/splat/minimal-v4.spz", "SPZ", 4),
        ("oracle_splat_transform/splat/minimal.splat", "splat", 4),
        ("oracle_splat_transform/splat/minimal.ksplat", "ksplat", 4),
    ] {
        assert_eq!(read_scene(&data(file)).unwrap().splats.len(), count, "{file}");
        let summary = inspect(&data(file)).unwrap();
        assert_eq!((summary.format, summary.splats.unwrap().count), (format, count), "{file}");
    }
}

#[test]
#[ignore = "needs shared data"]
fn what_cannot_be_read_says_so() {
    let message = |path: &str| read_scene(&data(path)).unwrap_err().to_string();
    let picture = message("oracle_splat_transform/golden-render/tiny.webp");
    assert!(
        picture.ends_with(
            "expected a .glb, .gltf, .usda, .usdc, .usdz, .ply, .sog, .spz, .splat or .ksplat file, found other content"
        ),
        "{picture}"
    );
    let mesh = message("oracle_metalsplatter/PLYIO/TestData/beetle.binary.ply");
    assert!(mesh.contains("f_dc_0"), "{mesh}");
}
