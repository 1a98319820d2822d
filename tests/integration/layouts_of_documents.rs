//! As [`layouts`](crate::layouts), for formats of a JSON document with images or a buffer beside it: SOG, glTF.

use std::f64::consts::SQRT_2;
use std::io::Cursor;

use crate::layouts::{Row, assert_near, floats, negated, splats, with_largest, written};
use centaur::format::{self, WriteOptions, sog};
use centaur::scene::{Composition, HybridScene, PixelFilter};
use image_webp::{ColorType, WebPDecoder, WebPEncoder};
use serde_json::{Value, json};

/// Lossless `WebP`, row by row, with unused texels at the end.
fn webp(width: usize, texels: &[[u8; 4]]) -> Vec<u8> {
    let mut texels = texels.to_vec();
    texels.resize(texels.len().next_multiple_of(4 * width), [0, 0, 0, 255]);
    let mut file: Vec<u8> = vec![];
    let [width, height] = [width, texels.len() / width].map(|side| side as u32);
    WebPEncoder::new(&mut file).encode(texels.as_flattened(), width, height, ColorType::Rgba8).unwrap();
    file
}

fn texels(webp: &[u8]) -> Vec<[u8; 4]> {
    let mut decoder = WebPDecoder::new(Cursor::new(webp)).unwrap();
    let channels = if decoder.has_alpha() { 4 } else { 3 };
    let mut bytes = vec![0; decoder.output_buffer_size().unwrap()];
    decoder.read_image(&mut bytes).unwrap();
    bytes.chunks_exact(channels).map(|t| [t[0], t[1], t[2], *t.get(3).unwrap_or(&255)]).collect()
}

/// `PlayCanvas`: two images with 16 bits of a signed logarithm; bytes of scales, colours and harmonics that index
/// codebooks; the smallest three of (w, x, y, z) as red, green and blue with 252 plus the index of the largest as
/// alpha; opacities as the alpha of colours.
#[test]
fn sog_images() {
    let (least, most) = ([-1.0, 0.0, 0.5], [1.0, 2.0, 1.5]);
    // In Morton order, in which they are written, with all bounds reached.
    let means: [[u16; 3]; 4] = [[0; 3], [0x1234, 0x2345, 0x3456], [0x8765, 0x1122, 0x6789], [0xffff; 3]];
    let scales: [[u8; 3]; 4] = [[0, 100, 255], [32, 33, 34], [90, 80, 70], [160, 161, 162]];
    let others: [u8; 3] = [200, 50, 150];
    let colors: [[u8; 4]; 4] = [[1, 128, 254, 10], [20, 30, 40, 100], [50, 60, 70, 200], [200, 210, 220, 250]];
    // Labels that use both bytes, and another row of 64 entries.
    let labels: [u16; 4] = [1, 0, 65, 258];
    // Coefficient k + 1 of entry `n` of the palette.
    let entry = |n: usize, k: usize| [0, 85, 170].map(|channel| ((7 * n + 31 * k + channel) % 256) as u8);
    let codebook = |first: f64, step: f64| (0..256).map(|i| first + step * f64::from(i)).collect::<Vec<f64>>();
    let [of_scales, of_colors, of_bands] =
        [codebook(-8.0, 0.03125), codebook(-2.0, 0.015_625), codebook(-1.0, 0.007_812_5)];

    let row = |i: usize| {
        let [r, g, b, a] = colors[i];
        let mean = |axis: usize| {
            let v: f64 = least[axis] + (most[axis] - least[axis]) * f64::from(means[i][axis]) / 65535.0;
            v.signum() * (v.abs().exp() - 1.0)
        };
        Row {
            mean: [0, 1, 2].map(mean),
            log_scale: scales[i].map(|byte| of_scales[usize::from(byte)]),
            wxyz: with_largest(others.map(|byte| (f64::from(byte) / 255.0 - 0.5) * SQRT_2), i),
            opacity: f64::from(a) / 255.0,
            dc: [r, g, b].map(|byte| of_colors[usize::from(byte)]),
            bands: (0..3).map(|k| entry(labels[i].into(), k).map(|byte| of_bands[usize::from(byte)])).collect(),
        }
    };
    let expected = splats(&[0, 1, 2, 3].map(row));

    let opaque = |[r, g, b]: [u8; 3]| [r, g, b, 255];
    let byte_of_means = |k: usize| means.map(|mean| opaque(mean.map(|v| v.to_le_bytes()[k])));
    let [lower, upper] = [0, 1].map(byte_of_means);
    let quats = [252, 253, 254, 255].map(|alpha| [others[0], others[1], others[2], alpha]);
    let centroid = |texel: usize| opaque(entry(texel / 192 * 64 + texel % 192 / 3, texel % 3));
    let images = [
        ("means_l.webp", webp(4, &lower)),
        ("means_u.webp", webp(4, &upper)),
        ("scales.webp", webp(4, &scales.map(opaque))),
        ("quats.webp", webp(4, &quats)),
        ("sh0.webp", webp(4, &colors)),
        ("shN_centroids.webp", webp(192, &(0..5 * 192).map(centroid).collect::<Vec<_>>())),
        ("shN_labels.webp", webp(4, &labels.map(|label| opaque([label as u8, (label >> 8) as u8, 0])))),
    ];
    let meta = json!({
        "version": 2,
        "count": 4,
        "means": { "mins": least, "maxs": most, "files": ["means_l.webp", "means_u.webp"] },
        "scales": { "codebook": of_scales, "files": ["scales.webp"] },
        "quats": { "files": ["quats.webp"] },
        "sh0": { "codebook": of_colors, "files": ["sh0.webp"] },
        "shN": { "count": 300, "bands": 1, "codebook": of_bands, "files": ["shN_centroids.webp", "shN_labels.webp"] },
    });
    let folder = tempfile::tempdir().unwrap();
    for (name, image) in images {
        std::fs::write(folder.path().join(name), image).unwrap();
    }
    std::fs::write(folder.path().join("meta.json"), meta.to_string()).unwrap();
    assert_near(&format::read_scene(&folder.path().join("meta.json")).unwrap().splats, &expected, 2e-6);

    // Codebooks and palettes are the writer's choice.
    for splats in [expected.clone(), negated(&expected)] {
        let folder = tempfile::tempdir().unwrap();
        sog::write(&folder.path().join("meta.json"), &splats, PixelFilter::DILATION).unwrap();
        let meta: Value = serde_json::from_slice(&std::fs::read(folder.path().join("meta.json")).unwrap()).unwrap();
        assert_eq!([&meta["version"], &meta["count"], &meta["shN"]["bands"]], [&json!(2), &json!(4), &json!(1)]);
        let image = |field: &str, k: usize| {
            texels(&std::fs::read(folder.path().join(meta[field]["files"][k].as_str().unwrap())).unwrap())
        };
        for (key, bounds) in [("mins", least), ("maxs", most)] {
            let off = |axis: usize| (meta["means"][key][axis].as_f64().unwrap() - bounds[axis]).abs();
            assert!((0..3).all(|axis| off(axis) < 1e-6), "{}", meta["means"]);
        }
        assert_eq!((&image("means", 0)[..4], &image("means", 1)[..4]), (&lower[..], &upper[..]));
        assert_eq!(image("quats", 0)[..4], quats);
        assert_eq!(image("sh0", 0)[..4].iter().map(|t| t[3]).collect::<Vec<_>>(), colors.map(|color| color[3]));
        let (sizes, shown) = (image("scales", 0), image("sh0", 0));
        let (centroids, labels) = (image("shN", 0), image("shN", 1));
        for i in 0..4 {
            let values = |field: &str, [r, g, b, _]: [u8; 4]| {
                [r, g, b].map(|byte| meta[field]["codebook"][usize::from(byte)].as_f64().unwrap() as f32)
            };
            assert_eq!(values("scales", sizes[i]), expected.log_scales()[i].to_array());
            assert_eq!(values("sh0", shown[i]), expected.sh_of(i)[0]);
            let label = usize::from(labels[i][0]) + 256 * usize::from(labels[i][1]);
            for k in 0..3 {
                let found = values("shN", centroids[label / 64 * 192 + label % 64 * 3 + k]);
                assert_eq!(found, expected.sh_of(i)[1 + k], "splat {i}, coefficient {}", 1 + k);
            }
        }
    }
}

/// Khronos: attributes of points, rotations as (x, y, z, w), linear scales and opacities.
#[test]
fn splats_of_gltf() {
    let means = [[1.0, 2.0, 3.0], [-4.0, 5.0, -6.0]];
    let scales = [[0.5, 0.25, 2.0], [4.0, 0.125, 1.0]];
    let opacities = [0.25, 0.75];
    // (x, y, z, w) with a length of about 127.
    let rotations: [[i8; 4]; 2] = [[26, -51, 77, 84], [-23, 46, 12, -115]];
    let harmonics = |i: usize| (0..4_usize).map(move |k| [0, 1, 2].map(|c| 0.1 * (3 * k + c) as f64 - 0.4 * i as f64));
    let row = |i: usize| {
        let [x, y, z, w] = rotations[i].map(f64::from);
        let mut harmonics = harmonics(i);
        Row {
            mean: means[i],
            log_scale: scales[i].map(f64::ln),
            wxyz: [w, x, y, z],
            opacity: opacities[i],
            dc: harmonics.next().unwrap(),
            bands: harmonics.collect(),
        }
    };
    let expected = splats(&[0, 1].map(row));
    let units: Vec<f32> = expected.rotations().iter().flat_map(|q| [q.x, q.y, q.z, q.w]).collect();
    let harmonics_of = |k: usize| [0, 1].map(|i| harmonics(i).nth(k).unwrap());
    let names = |k: usize| match k {
        0 => "SH_DEGREE_0_COEF_0".to_owned(),
        _ => format!("SH_DEGREE_1_COEF_{}", k - 1),
    };
    let khr = |name: &str| format!("KHR_gaussian_splatting:{name}");

    for in_bytes in [false, true] {
        let (mut bin, mut views, mut accessors) = (vec![], vec![], vec![]);
        let mut attributes = serde_json::Map::new();
        let mut add = |name: String, kind: &str, component: u32, bytes: &[u8]| {
            views.push(json!({ "buffer": 0, "byteOffset": bin.len(), "byteLength": bytes.len() }));
            bin.extend_from_slice(bytes);
            attributes.insert(name, json!(accessors.len()));
            // POSITION must have bounds.
            accessors.push(json!({
                "bufferView": views.len() - 1, "componentType": component, "normalized": component != 5126, "count": 2,
                "type": kind, "min": [-4, 2, -6], "max": [1, 5, 3],
            }));
        };
        add("POSITION".to_owned(), "VEC3", 5126, &floats(means.as_flattened()));
        if in_bytes {
            let bytes = rotations.as_flattened().iter().flat_map(|c| c.to_le_bytes()).collect::<Vec<u8>>();
            add(khr("ROTATION"), "VEC4", 5120, &bytes);
        } else {
            let bytes = units.iter().flat_map(|c| c.to_le_bytes()).collect::<Vec<u8>>();
            add(khr("ROTATION"), "VEC4", 5126, &bytes);
        }
        add(khr("SCALE"), "VEC3", 5126, &floats(scales.as_flattened()));
        add(khr("OPACITY"), "SCALAR", 5126, &floats(&opacities));
        for k in 0..4 {
            add(khr(&names(k)), "VEC3", 5126, &floats(harmonics_of(k).as_flattened()));
        }
        let splatting = json!({ "kernel": "ellipse", "colorSpace": "srgb_rec709_display" });
        let document = json!({
            "asset": { "version": "2.0" }, "scene": 0, "scenes": [{ "nodes": [0] }], "nodes": [{ "mesh": 0 }],
            "meshes": [{ "primitives": [{
                "mode": 0, "attributes": attributes, "extensions": { "KHR_gaussian_splatting": splatting },
            }] }],
            "buffers": [{ "uri": "golden.bin", "byteLength": bin.len() }], "bufferViews": views, "accessors": accessors,
            "extensionsUsed": ["KHR_gaussian_splatting"],
        });
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("golden.bin"), &bin).unwrap();
        std::fs::write(folder.path().join("golden.gltf"), document.to_string()).unwrap();
        // The file's world is y up: reading has turned it half about x.
        let read = format::read_scene(&folder.path().join("golden.gltf")).unwrap();
        let stored = centaur::edit::Similarity::HALF_TURN.scene(read).unwrap();
        assert_near(&stored.splats, &expected, 1e-6);
    }

    let scene = HybridScene { splats: expected.clone(), meshes: vec![], composition: Composition::default() };
    let file = written("a.glb", |path| format::write_scene(path, &scene, &WriteOptions::default()));
    let length = u32::from_le_bytes(file[12..16].try_into().unwrap()) as usize;
    let (document, bin) = (&file[20..20 + length], &file[28 + length..]);
    let document: Value = serde_json::from_slice(document).unwrap();
    let stored = |name: &str, components: usize| -> Vec<f32> {
        let number = |value: &Value| value.as_u64().unwrap() as usize;
        let attributes = &document["meshes"][0]["primitives"][0]["attributes"];
        let accessor = &document["accessors"][number(&attributes[name])];
        assert_eq!((&accessor["componentType"], &accessor["byteOffset"]), (&json!(5126), &Value::Null));
        let start = number(&document["bufferViews"][number(&accessor["bufferView"])]["byteOffset"]);
        let values = bin[start..start + 8 * components].chunks_exact(4);
        values.map(|v| f32::from_le_bytes(v.try_into().unwrap())).collect()
    };
    let narrow = |values: &[f64]| values.iter().map(|v| *v as f32).collect::<Vec<f32>>();
    assert_eq!(stored("POSITION", 3), narrow(means.as_flattened()));
    assert_eq!(stored(&khr("ROTATION"), 4), units);
    assert_eq!(stored(&khr("SCALE"), 3), narrow(scales.as_flattened()));
    for (found, opacity) in stored(&khr("OPACITY"), 1).into_iter().zip(opacities) {
        assert!((f64::from(found) - opacity).abs() < 1e-6, "{found}");
    }
    for k in 0..4 {
        assert_eq!(stored(&khr(&names(k)), 3), narrow(harmonics_of(k).as_flattened()), "{}", names(k));
    }
}
