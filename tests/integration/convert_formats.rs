//! `centaur convert` from every format to every format, there and back.

use crate::common;
use crate::convert::{as_json, convert, failure, read, splats, write_hybrid};
use centaur::format::{self, ply};
use centaur::scene::PixelFilter;
use glam::Vec3;

#[test]
fn ply_to_glb_and_back_is_the_same_scene() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    let before = splats(20, 3);
    ply::write(&path("a.ply"), &before).unwrap();
    let said = convert(folder.path(), "a.ply b.glb --strict");
    assert!(said.contains("b.glb: 20 splats of SH degree 3, "), "{said}");
    assert!(convert(folder.path(), "b.glb c.ply --strict").starts_with("lost: nothing\n"));
    let after = read(&path("c.ply")).scene.splats;
    assert_eq!((after.means(), after.sh(), after.rotations()), (before.means(), before.sh(), before.rotations()));
    let close = |a: &[f32], b: &[f32]| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-6);
    assert!(close(after.opacity_logits(), before.opacity_logits()));
    assert!(after.log_scales().iter().zip(before.log_scales()).all(|(a, b)| (*a - *b).abs().max_element() < 1e-6));
    // Without an intermediate format, bytes are identical.
    convert(folder.path(), "a.ply d.ply");
    assert_eq!(std::fs::read(path("d.ply")).unwrap(), std::fs::read(path("a.ply")).unwrap());
    assert_eq!(common::tree(folder.path()).len(), 4, "nothing else is left");
}

/// A foreign glTF is y-up; our frame is y-down, and our writer rotates it back for viewers.
#[test]
fn gltf_of_others_stays_upright() {
    let folder = tempfile::tempdir().unwrap();
    // (0, 1, 2), (1, 1, 2), (0, 3, 2) in little-endian f32.
    let floats = [0.0_f32, 1.0, 2.0, 1.0, 1.0, 2.0, 0.0, 3.0, 2.0];
    let bytes: Vec<u8> = floats.iter().flat_map(|f| f.to_le_bytes()).collect();
    std::fs::write(folder.path().join("points.bin"), &bytes).unwrap();
    let document = serde_json::json!({
        "asset": { "version": "2.0" },
        "scene": 0, "scenes": [{ "nodes": [0] }], "nodes": [{ "mesh": 0 }],
        "meshes": [{ "primitives": [{ "attributes": { "POSITION": 0 } }] }],
        "accessors": [{ "bufferView": 0, "componentType": 5126, "type": "VEC3", "count": 3,
                        "min": [0.0, 1.0, 2.0], "max": [1.0, 3.0, 2.0] }],
        "bufferViews": [{ "buffer": 0, "byteLength": bytes.len() }],
        "buffers": [{ "uri": "points.bin", "byteLength": bytes.len() }],
    });
    std::fs::write(folder.path().join("theirs.gltf"), document.to_string()).unwrap();
    // `inspect` uses the frame of crops, for meshes as for nodes.
    let inspected = |name: &str| -> serde_json::Value {
        let output = common::centaur(folder.path()).args(["inspect", name, "--json"]).output().unwrap();
        serde_json::from_slice(&output.stdout).unwrap()
    };
    let bounds = serde_json::json!([[0.0, -3.0, -2.0], [1.0, -1.0, -2.0]]);
    let theirs = inspected("theirs.gltf");
    assert_eq!((&theirs["meshes"][0]["bounds"], &theirs["document"]["nodes"][0]["bounds"]), (&bounds, &bounds));
    let layer = "#usda 1.0\ndef Mesh \"m\" {\n point3f[] points = [(0, 1, 2), (1, 1, 2), (0, 3, 2)]\n \
                 int[] faceVertexCounts = [3]\n int[] faceVertexIndices = [0, 1, 2]\n}\n";
    std::fs::write(folder.path().join("theirs.usda"), layer).unwrap();
    assert_eq!(inspected("theirs.usda")["meshes"][0]["bounds"], bounds);
    let kept = as_json(folder.path(), "theirs.gltf kept.glb --keep-box=0,-3,-2,1,-1,-2");
    assert_eq!(kept["meshes"], 1, "{kept}");
    // Unchanged, the document stays as it is; joined, it is written anew, in our frame.
    convert(folder.path(), "theirs.gltf same.glb --strict");
    let same = read(&folder.path().join("same.glb"));
    assert!(same.y_up && same.scene.meshes[0].positions()[1] == Vec3::new(1.0, -1.0, -2.0));
    let said = convert(folder.path(), "theirs.gltf theirs.gltf ours.glb");
    assert!(said.contains("note: theirs.gltf: "), "a material that is reduced is worth a note: {said}");
    assert!(said.starts_with("lost: nothing, except as noted\n"), "{said}");
    let line = failure(folder.path(), "theirs.gltf theirs.gltf strict.glb --strict");
    assert!(line.starts_with("error: theirs.gltf: --strict: "), "{line}");
    let ours = read(&folder.path().join("ours.glb"));
    let expected = [[0.0, -1.0, -2.0], [1.0, -1.0, -2.0], [0.0, -3.0, -2.0]].map(Vec3::from);
    assert_eq!(ours.scene.meshes[0].positions(), expected);
    assert!(!ours.y_up);
    // Once in our frame, it stays unchanged.
    convert(folder.path(), "ours.glb again.glb");
    let again = read(&folder.path().join("again.glb"));
    assert_eq!(again.scene.meshes[0].positions(), expected);
}

#[test]
fn every_format_is_written_and_read_and_lossy_ones_are_refused_by_strict() {
    let folder = tempfile::tempdir().unwrap();
    ply::write(&folder.path().join("a.ply"), &splats(50, 3)).unwrap();
    for (extension, degree) in [
        ("glb", 3),
        ("usda", 3),
        ("usdz", 3),
        ("compressed.ply", 3),
        ("sog", 3),
        ("splat", 0),
        ("ksplat", 2),
        ("spz", 3),
    ] {
        let outcome = as_json(folder.path(), &format!("a.ply b.{extension}"));
        let lossless = ["glb", "usda", "usdz"].contains(&extension);
        assert_eq!(outcome["lossless"].as_bool(), Some(lossless), "{outcome}");
        let error = outcome["loss"]["max_error"]["color"].as_f64().unwrap();
        assert!(error < 0.02, "{extension}: {error}");
        let outcome = as_json(folder.path(), &format!("b.{extension} c.ply --strict"));
        assert_eq!(
            (outcome["splats"].as_u64(), outcome["sh_degree"].as_u64()),
            (Some(50), Some(degree)),
            "{extension}"
        );
        if !lossless {
            let line = failure(folder.path(), &format!("a.ply d.{extension} --strict"));
            let expected =
                format!("error: d.{extension}: --strict: a .{} would lose ", extension.replace("compressed.", ""));
            assert!(line.starts_with(&expected) && line.contains("largest errors: "), "{line}");
        }
    }
    let sizes = ["2", "3", "4"].map(|version| {
        let outcome = as_json(folder.path(), &format!("a.ply v.spz --spz-version {version}"));
        outcome["bytes"].as_u64().unwrap()
    });
    assert!(sizes[0] != sizes[1] && sizes[1] != sizes[2], "{sizes:?}");
}

#[test]
fn every_reader_feeds_every_writer() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let original = splats(50, 3);
    ply::write(&at("a.ply"), &original).unwrap();
    std::fs::create_dir(at("folder")).unwrap();
    format::sog::write(&at("folder/meta.json"), &original, PixelFilter::DILATION).unwrap();
    // The INRIA layout in ASCII.
    let binary = std::fs::read(at("a.ply")).unwrap();
    let body = binary.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
    let header = String::from_utf8(binary[..body].to_vec()).unwrap().replace("binary_little_endian", "ascii");
    let numbers: Vec<String> =
        binary[body..].as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b).to_string()).collect();
    std::fs::write(at("ascii.ply"), format!("{header}{}\n", numbers.join(" "))).unwrap();

    let writers = [
        ("glb", 3),
        ("gltf", 3),
        ("usda", 3),
        ("usdz", 3),
        ("ply", 3),
        ("compressed.ply", 3),
        ("sog", 3),
        ("spz", 3),
        ("ksplat", 2),
        ("splat", 0),
    ];
    let mut readers = vec![("a.ply".to_owned(), 3), ("ascii.ply".to_owned(), 3), ("folder/meta.json".to_owned(), 3)];
    for (extension, degree) in writers {
        convert(folder.path(), &format!("a.ply in.{extension}"));
        readers.push((format!("in.{extension}"), degree));
    }
    for version in ["2", "3"] {
        convert(folder.path(), &format!("a.ply v{version}.spz --spz-version {version}"));
        readers.push((format!("v{version}.spz"), 3));
    }
    for (reader, degree) in &readers {
        for (extension, most) in writers {
            convert(folder.path(), &format!("{reader} out.{extension}"));
            let found = format::read_scene(&at(&format!("out.{extension}"))).unwrap().splats;
            let said = format!("{reader} to .{extension}");
            assert_eq!((found.len(), found.sh_degree()), (50, most.min(*degree)), "{said}");
            // Some formats reorder splats.
            let mut order: Vec<usize> = (0..50).collect();
            order.sort_by(|&a, &b| found.means()[a].x.total_cmp(&found.means()[b].x));
            for (expected, &i) in order.iter().enumerate() {
                assert!((found.means()[i].x - expected as f32).abs() < 0.05, "{said}: {}", found.means()[i]);
                let difference = found.log_scales()[i] - original.log_scales()[expected];
                assert!(difference.abs().max_element() < 0.05, "{said}: {difference}");
                assert!((found.opacity_logits()[i] - original.opacity_logits()[expected]).abs() < 0.1, "{said}");
            }
        }
        for export in ["xml", "blend.py"] {
            convert(folder.path(), &format!("{reader} out.{export}"));
            assert!(at(&format!("out.{export}")).is_file(), "{reader} to .{export}");
        }
    }
}

#[test]
fn hybrids_go_through_usd_and_back() {
    let folder = tempfile::tempdir().unwrap();
    write_hybrid(&folder.path().join("h.glb"));
    let before = read(&folder.path().join("h.glb"));
    for name in ["b.usda", "b.usdz"] {
        assert!(
            convert(folder.path(), &format!("h.glb {name} --strict")).contains("10 splats of SH degree 3, 1 mesh(es)")
        );
        convert(folder.path(), &format!("{name} back.glb --strict"));
        let after = read(&folder.path().join("back.glb"));
        assert_eq!((&after.scene.meshes, after.scene.composition), (&before.scene.meshes, before.scene.composition));
        assert_eq!(
            (after.scene.splats.means(), after.scene.splats.sh()),
            (before.scene.splats.means(), before.scene.splats.sh())
        );
        assert_eq!(after.cameras.len(), 1);
    }
    // The pictures of the .usda are beside it, and no other files are left.
    let mut names: Vec<_> = folder.path().read_dir().unwrap().map(|e| e.unwrap().file_name()).collect();
    names.sort();
    let pictures = ["b_mesh_0_bands.exr", "b_mesh_0_base.exr", "b_mesh_0_color.png", "b_mesh_0_opacity.png"];
    let expected = [&["b.usda", "b.usdz"], &pictures[..], &["back.glb", "h.glb"]].concat();
    assert_eq!(names, expected);
    let summary = common::centaur(folder.path()).args(["inspect", "b.usda"]).output().unwrap();
    let summary = String::from_utf8(summary.stdout).unwrap();
    assert!(summary.contains("b.usda: USD, ") && summary.contains("├ cameras: 1"), "{summary}");
}
