//! Pictures of `centaur render`: cut out of their background, in layers, and of scenes that are y up.

use std::path::Path;

use crate::cameras::{run, write_ball};
use crate::common::{centaur, write_capture};
use centaur::format::{WriteOptions, write_scene};
use centaur::scene::color::linear_to_srgb;
use centaur::scene::{Atlas, Composition, HybridScene, Mesh, Splats, Texture};
use glam::{Quat, Vec2, Vec3};

/// RGBA pixels, row-major from the top.
fn read_exr(path: &Path) -> Vec<[f32; 4]> {
    use exr::prelude::{Vec2, read_first_rgba_layer_from_file};
    let read = read_first_rgba_layer_from_file(
        path,
        |size: Vec2<usize>, _| (size.width(), vec![[0.0; 4]; size.area()]),
        |(width, pixels), at: Vec2<usize>, (r, g, b, a): (f32, f32, f32, f32)| {
            pixels[at.y() * *width + at.x()] = [r, g, b, a];
        },
    );
    read.unwrap().layer_data.channel_data.pixels.1
}

/// Composited over a colour as browsers do with PNG, and in linear light as EXR stores it, a cut-out equals the
/// picture.
#[test]
fn what_is_cut_out_makes_the_picture_again_over_its_background() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    write_capture(&at("capture"), 9, (32, 24));
    let background = [0.25, 0.5, 1.0];
    write_ball(&at("ball.glb"), Composition { background, ..Composition::default() });
    for model in ["ewa", "ray"] {
        let render = |out: &str, flags: &[&str]| {
            let base =
                ["render", "ball.glb", "--cameras", "capture", "--camera", "000.png", "--model", model, "-o", out];
            run(folder.path(), &[&base[..], flags].concat());
            let mut files = std::fs::read_dir(at(out)).unwrap().map(|entry| entry.unwrap().path());
            let (file, more) = (files.next().unwrap(), files.next());
            assert_eq!(more, None);
            file
        };
        let name = |kind: &str| format!("{model}-{kind}");
        let whole = image::open(render(&name("whole"), &[])).unwrap().into_rgb8();
        let cut = image::open(render(&name("cut"), &["--alpha"])).unwrap();
        assert_eq!(cut.color(), image::ColorType::Rgba8);
        let cut = cut.into_rgba8();
        let linear = read_exr(&render(&name("linear"), &["--alpha", "--format", "exr"]));
        let mut see_through = 0;
        for ((whole, cut), linear) in whole.pixels().zip(cut.pixels()).zip(&linear) {
            let alpha = f32::from(cut.0[3]) / 255.0;
            see_through += u32::from(cut.0[3] > 5 && cut.0[3] < 250);
            assert!((linear[3] - alpha).abs() <= 0.5001 / 255.0);
            for c in 0..3 {
                let over = alpha * f32::from(cut.0[c]) / 255.0 + (1.0 - alpha) * background[c];
                // Three roundings to 8 bits: of the colour, of alpha and of the reference.
                assert!((over - f32::from(whole.0[c]) / 255.0).abs() <= 1.501 / 255.0, "{over} for {whole:?}");
                let straight = if linear[3] > 0.0 { linear_to_srgb(linear[c] / linear[3]) } else { 0.0 };
                assert!((straight.clamp(0.0, 1.0) - f32::from(cut.0[c]) / 255.0).abs() <= 0.51 / 255.0);
            }
        }
        assert!(see_through > 10, "{see_through} pixels are half transparent");
    }
    let both = ["render", "ball.glb", "-o", "out", "--alpha", "--exr-layers"];
    assert_eq!(centaur(folder.path()).args(both).output().unwrap().status.code(), Some(2));
}

/// Compositors make a layer of all channels with the same prefix before the dot, and know layers of RGBA, of XYZ and of
/// one channel: Blender displays nothing of others.
#[test]
fn layers_have_channels_that_compositors_know() {
    let folder = tempfile::tempdir().unwrap();
    write_capture(&folder.path().join("capture"), 3, (32, 24));
    write_ball(&folder.path().join("ball.glb"), Composition::default());
    let render = ["render", "ball.glb", "--cameras", "capture", "--camera", "000.png", "--exr-layers", "-o", "out"];
    run(folder.path(), &render);
    let image = exr::prelude::read_first_flat_layer_from_file(folder.path().join("out/000.exr")).unwrap();
    let names: Vec<String> = image.layer_data.channel_data.list.iter().map(|c| c.name.to_string()).collect();
    let mut layers = std::collections::BTreeMap::<&str, Vec<&str>>::new();
    for (layer, channel) in names.iter().filter_map(|name| name.rsplit_once('.')) {
        layers.entry(layer).or_default().push(channel);
    }
    for (layer, channels) in &layers {
        let is_known = channels.len() == 1 || [&["A", "B", "G", "R"][..], &["X", "Y", "Z"]].contains(&&channels[..]);
        assert!(is_known, "{layer}: {channels:?}");
    }
    assert_eq!(layers.into_keys().collect::<Vec<_>>(), ["N", "count", "depth", "mesh", "splats"]);
}

/// Depths, normals and counts of a tilted opaque plane, z = 4 + x, behind a splat at depth 2, seen from the origin
/// along z.
#[test]
fn layers_hold_depths_normals_and_counts() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let splats = Splats::new(
        vec![Vec3::new(-0.25, 0.0, 2.0)],
        vec![Quat::IDENTITY],
        vec![Vec3::splat(0.1_f32.ln())],
        vec![2.0],
        0,
        vec![[0.5; 3]],
    );
    let corners = [(-2.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-2.0, 1.0)].map(|(x, y)| Vec3::new(x, y, 4.0 + x));
    let atlas = Atlas::new(Texture::new(1, 1, 4, vec![0.5, 0.5, 0.5, 6.0]).unwrap(), None).unwrap();
    let uvs = vec![[Vec2::ZERO, Vec2::X, Vec2::Y]; 2];
    let mesh = Mesh::new(corners.to_vec(), vec![[0, 1, 2], [0, 2, 3]], uvs, atlas).unwrap();
    let scene = HybridScene { splats: splats.unwrap(), meshes: vec![mesh], composition: Composition::default() };
    write_scene(&at("s.glb"), &scene, &WriteOptions::default()).unwrap();
    let pose = "[[1,0,0,0],[0,-1,0,0],[0,0,-1,0],[0,0,0,1]]";
    let frame = format!(r#"{{"file_path":"a.png","transform_matrix":{pose}}}"#);
    let lens = r#""fl_x":33,"fl_y":33,"cx":16.5,"cy":16.5,"w":33,"h":33"#;
    std::fs::write(at("c.json"), format!("{{{lens},\"frames\":[{frame}]}}")).unwrap();
    for (kind, is_half) in [("float", false), ("half", true)] {
        let render = ["render", "s.glb", "--cameras", "c.json", "--exr-layers", "--exr-type", kind, "-o", kind];
        run(folder.path(), &render);
        let image = exr::prelude::read_first_flat_layer_from_file(at(kind).join("a.exr")).unwrap();
        let list = image.layer_data.channel_data.list;
        let channel = |name: &str| list.iter().find(|channel| channel.name.eq(name)).unwrap();
        let values = |name: &str| -> Vec<f32> { channel(name).sample_data.values_as_f32().collect() };
        let is_f16 = |name: &str| matches!(channel(name).sample_data, exr::prelude::FlatSamples::F16(_));
        assert_eq!([is_f16("R"), is_f16("Z"), is_f16("count.splats")], [is_half, false, false]);
        let [splat, plane, mean, first] = ["splats.A", "mesh.A", "Z", "depth.first"].map(values);
        let [count, x, y, z] = ["count.splats", "N.X", "N.Y", "N.Z"].map(values);
        let (mut before, mut bare) = (0, 0);
        for i in 0..33 * 33 {
            let depth = 4.0 / (1.0 - ((i % 33) as f32 - 16.0) / 33.0);
            assert_eq!(count[i], f32::from(splat[i] > 0.0), "{i}");
            let weight = splat[i] + plane[i];
            let [expected_mean, expected_first] = match (weight > 0.0, weight > 0.5, splat[i] > 0.5) {
                (false, ..) => [1e10; 2],
                (_, false, _) => [2.0, 1e10],
                (_, _, is_before) => {
                    [(2.0 * splat[i] + depth * plane[i]) / weight, if is_before { 2.0 } else { depth }]
                }
            };
            for (found, expected) in [(mean[i], expected_mean), (first[i], expected_first)] {
                assert!((found / expected - 1.0).abs() < 2e-3, "{kind} {i}: {found}, not {expected}");
            }
            let slant = if plane[i] > 0.0 { 0.5_f32.sqrt() } else { 0.0 };
            let off = [x[i] - slant, y[i], z[i] + slant].map(f32::abs);
            assert!(off.iter().all(|off| *off < 1e-3), "{kind} {i}: {off:?}");
            before += usize::from(splat[i] > 0.5);
            bare += usize::from(weight == 0.0);
        }
        assert!(before > 3 && bare > 100, "{before} {bare}");
    }
}

/// Foreign glTF and USD are y up, cameras of a capture are not: however they are combined, pictures and normals are
/// those of the converted scene.
#[test]
fn scenes_that_are_y_up_are_seen_by_captures_as_their_conversion_is() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    write_capture(&at("capture"), 3, (32, 24));
    // A tilted triangle, larger than the cameras' view.
    let layer = "#usda 1.0\n( metersPerUnit = 1\n upAxis = \"Y\" )\ndef Mesh \"m\" {\n point3f[] points = [(-9, -9, 2), (9, -9, 0), (-1, 9, -3)]\n \
                 int[] faceVertexCounts = [3]\n int[] faceVertexIndices = [0, 1, 2]\n uniform token subdivisionScheme = \"none\"\n \
                 color3f[] primvars:displayColor = [(0.2, 0.4, 0.6)]\n}\n";
    std::fs::write(at("theirs.usda"), layer).unwrap();
    run(folder.path(), &["convert", "theirs.usda", "ours.glb"]);
    let layers = |scene: &str, out: &str| {
        let said = run(folder.path(), &["render", scene, "--cameras", "capture", "--exr-layers", "-o", out]);
        let mut files: Vec<_> = std::fs::read_dir(at(out)).unwrap().map(|e| e.unwrap().path()).collect();
        files.sort();
        let channels = |path: &std::path::PathBuf| {
            let image = exr::prelude::read_first_flat_layer_from_file(path).unwrap();
            let list = image.layer_data.channel_data.list;
            list.into_iter()
                .map(|c| (c.name.to_string(), c.sample_data.values_as_f32().collect::<Vec<f32>>()))
                .collect()
        };
        let files: Vec<Vec<(String, Vec<f32>)>> = files.iter().map(channels).collect();
        (said, files)
    };
    let ((said, theirs), (quiet, ours)) = (layers("theirs.usda", "a"), layers("ours.glb", "b"));
    let note = "note: capture: cameras taken to be y down, as in captures: rotated by 180° about x, because theirs.usda is y up\n";
    assert!(said.contains(note) && !quiet.contains("180° about x"), "{said} {quiet}");
    let mut seen = false;
    for (a, b) in theirs.iter().flatten().zip(ours.iter().flatten()) {
        assert_eq!(a.0, b.0);
        seen |= a.0 == "N.Z" && a.1.iter().any(|z| *z != 0.0);
        assert!(a.1.iter().zip(&b.1).all(|(x, y)| (x - y).abs() < 1e-4 * (1.0 + x.abs())), "{}", a.0);
    }
    assert!(seen && theirs.len() == 3);
}
