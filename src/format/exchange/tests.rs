#![allow(clippy::unwrap_used, reason = "a failed unwrap is a failed test")]

use super::*;
use crate::format::ReadOptions;
use crate::format::test_scenes::{random_mesh, random_scene};
use crate::format::{WriteOptions, write_scene};

#[test]
fn names_come_of_the_stem() {
    let of = |name: &str, suffix: &str| stem(Path::new(name), suffix);
    assert_eq!(of("out/scene.xml", ".xml"), "scene");
    assert_eq!(of("a b&c.STOCK.XML", ".stock.xml"), "a_b_c");
    assert_eq!(of("ä.xml", ".stock.xml"), "ä_xml");
    assert_eq!(of("x", ".xml"), "x");
}

#[test]
fn exports_share_files_in_any_case_where_the_system_ignores_it() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    std::fs::write(at("A b.blend.py"), "").unwrap();
    let of = |name: &str, ignores_case| {
        let found = sharing(&at(name), ignores_case).unwrap();
        found.into_iter().map(|other| (other.path, other.is_of_one_name)).collect::<Vec<_>>()
    };
    assert_eq!(of("a B.xml", true), [(at("A b.blend.py"), true)]);
    assert_eq!(of("a_b.xml", true), [(at("A b.blend.py"), false)]);
    assert!(of("A b.BLEND.py", true).is_empty() && of("c.xml", true).is_empty());
    // Elsewhere these are names of different files.
    assert!(of("a B.xml", false).is_empty() && of("a_b.xml", false).is_empty());
    assert_eq!(of("A b.BLEND.py", false), [(at("A b.blend.py"), true)]);
    assert_eq!(of("A_b.xml", false), [(at("A b.blend.py"), false)]);
}

#[test]
fn exports_refer_to_what_they_have_written_and_to_nothing_of_others() {
    let folder = tempfile::tempdir().unwrap();
    let (scene, options) = (random_scene(9, 2, 3, 5), WriteOptions::default());
    for name in ["a b.xml", "a b.blend.py"] {
        let output = folder.path().join(name);
        assert!(referred(&output).is_empty());
        let mut written = write_scene(&output, &scene, &options).unwrap().beside;
        written.retain(|name| name != "hybrid_rf.py");
        written.sort();
        assert_eq!(referred(&output), written);
    }
    assert!(["a_motion.npz", "a_mesh10.ply", "a_mesh0_sh15.exr"].iter().all(|name| is_accompanying(name, "a")));
    for name in ["a_mesh.ply", "a_mesh0.exr", "a_mesh0_sh.exr", "a_meshx_sh00.exr", "a_b_splats.ply", "a.blend.py"] {
        assert!(!is_accompanying(name, "a"), "{name}");
    }
}

#[test]
fn every_part_is_written_bit_for_bit() {
    let folder = tempfile::tempdir().unwrap();
    let scene = random_scene(9, 2, 3, 5);
    let output = folder.path().join("scene.xml");
    let beside = write(&output, "scene", &scene).unwrap();
    let mut found: Vec<(String, u64)> = std::fs::read_dir(folder.path())
        .unwrap()
        .map(|e| e.unwrap())
        .map(|e| (e.file_name().into_string().unwrap(), e.metadata().unwrap().len()))
        .collect();
    found.sort();
    let mut named = beside.files.clone();
    named.sort();
    assert_eq!(named, found.iter().map(|(name, _)| name.clone()).collect::<Vec<_>>());
    assert_eq!(beside.bytes, found.iter().map(|(_, bytes)| bytes).sum::<u64>());

    let splats = ply::read(&folder.path().join(beside.splats.unwrap()), &ReadOptions::default()).unwrap().splats;
    assert_eq!(splats, scene.splats);
    for (mesh, files) in scene.meshes.iter().zip(&beside.meshes) {
        let atlas = mesh.atlas();
        assert_eq!(files.maps.len(), sh::coefficients(atlas.sh_degree()));
        for (k, name) in files.maps.iter().enumerate() {
            let (map, first) = if k == 0 { (atlas.base(), 0) } else { (atlas.bands().unwrap(), 3 * (k - 1)) };
            let image = ::exr::prelude::read_first_flat_layer_from_file(folder.path().join(name)).unwrap().layer_data;
            assert_eq!((image.size.x() as u32, image.size.y() as u32), (map.width(), map.height()));
            let order = if k == 0 { "ABGR" } else { "BGR" };
            for (channel, letter) in image.channel_data.list.iter().zip(order.chars()) {
                assert!(channel.name.eq(&letter.to_string()));
                let c = first + "RGBA".find(letter).unwrap();
                let plane: Vec<f32> = map.texels().iter().skip(c).step_by(map.channels() as usize).copied().collect();
                assert_eq!(channel.sample_data.values_as_f32().collect::<Vec<_>>(), plane);
            }
        }
    }
}

#[test]
fn surfaces_keep_every_corner() {
    let folder = tempfile::tempdir().unwrap();
    let (path, mesh) = (folder.path().join("mesh.ply"), random_mesh(0, 3));
    let bytes = surface::write(&path, &mesh).unwrap();
    let file = std::fs::read(&path).unwrap();
    assert_eq!(bytes, file.len() as u64);
    let end = file.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
    let header = String::from_utf8(file[..end].to_vec()).unwrap();
    // All twelve corners of the tetrahedron lie on seams.
    assert!(header.contains("element vertex 12\n") && header.contains("element face 4\n"), "{header}");
    assert_eq!(file.len() - end, 12 * 20 + 4 * 13);
    let vertices: Vec<f32> = bytemuck::pod_collect_to_vec(&file[end..end + 240]);
    for (f, (corners, uvs)) in mesh.triangles().iter().zip(mesh.corner_uvs()).enumerate() {
        let face = &file[end + 240 + 13 * f..][..13];
        assert_eq!(face[0], 3);
        for c in 0..3 {
            let v = u32::from_le_bytes(face[1 + 4 * c..][..4].try_into().unwrap()) as usize;
            let p = mesh.positions()[corners[c] as usize];
            assert_eq!(vertices[5 * v..][..5], [p.x, p.y, p.z, uvs[c].x, uvs[c].y]);
        }
    }
}
