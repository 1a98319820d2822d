//! The bytes of every format of packed splats, assembled by hand from the specification: a round trip cannot reveal a
//! reader and a writer that are wrong in the same way. No two components of a mean, a scale, a rotation or a colour are
//! equal.

use std::f64::consts::SQRT_2;
use std::io::Read as _;
use std::path::Path;

use centaur::format::{self, FormatError, ksplat, ply, splat, spz};
use centaur::scene::{PixelFilter, Splats};
use glam::{DQuat, DVec3};
use half::f16;

/// A splat as it is expected to be read.
pub(crate) struct Row {
    pub(crate) mean: [f64; 3],
    pub(crate) log_scale: [f64; 3],
    pub(crate) wxyz: [f64; 4],
    pub(crate) opacity: f64,
    pub(crate) dc: [f64; 3],
    /// Coefficients above band 0.
    pub(crate) bands: Vec<[f64; 3]>,
}

pub(crate) fn splats(rows: &[Row]) -> Splats {
    let vec3 = |v: [f64; 3]| DVec3::from(v).as_vec3();
    let quat = |[w, x, y, z]: [f64; 4]| DQuat::from_xyzw(x, y, z, w).normalize().as_quat();
    let degree = [1, 4, 9].iter().position(|count| *count == 1 + rows[0].bands.len()).unwrap();
    let harmonics = rows.iter().flat_map(|row| std::iter::once(&row.dc).chain(&row.bands));
    Splats::new(
        rows.iter().map(|row| vec3(row.mean)).collect(),
        rows.iter().map(|row| quat(row.wxyz)).collect(),
        rows.iter().map(|row| vec3(row.log_scale)).collect(),
        rows.iter().map(|row| (row.opacity / (1.0 - row.opacity)).ln() as f32).collect(),
        degree as u32,
        harmonics.map(|c| c.map(|v| v as f32)).collect(),
    )
    .unwrap()
}

/// Coefficient 0 of the spherical harmonics for this colour.
fn dc_of(rgb: [f64; 3]) -> [f64; 3] {
    rgb.map(|c| (c - 0.5) / 0.282_094_791_773_878_14)
}

/// A unit quaternion whose largest component, number `at`, is positive and not among `others`.
pub(crate) fn with_largest(others: [f64; 3], at: usize) -> [f64; 4] {
    let largest = (1.0 - others.iter().map(|c| c * c).sum::<f64>()).sqrt();
    assert!(others.iter().all(|c| c.abs() < largest));
    let mut all = others.to_vec();
    all.insert(at, largest);
    all.try_into().unwrap()
}

/// The same splats with every quaternion negated.
pub(crate) fn negated(splats: &Splats) -> Splats {
    let mut arrays = splats.clone().into_arrays();
    arrays.rotations.iter_mut().for_each(|q| *q = -*q);
    arrays.check().unwrap()
}

/// Mean, log-scales, rotation (x, y, z, w) with its largest component positive, opacity and coefficients of splat `i`.
fn numbers(splats: &Splats, i: usize) -> Vec<f32> {
    let (q, logit) = (splats.rotations()[i], splats.opacity_logits()[i]);
    let largest = q.to_array().into_iter().max_by(|a, b| a.abs().total_cmp(&b.abs())).unwrap();
    let (mean, log_scale) = (splats.means()[i].to_array(), splats.log_scales()[i].to_array());
    let (rotation, opacity) = ((q * largest.signum()).to_array(), 1.0 / (1.0 + (-logit).exp()));
    [&mean[..], &log_scale[..], &rotation[..], &[opacity][..], splats.sh_of(i).as_flattened()].concat()
}

#[track_caller]
pub(crate) fn assert_near(found: &Splats, expected: &Splats, tolerance: f32) {
    assert_eq!((found.len(), found.sh_degree()), (expected.len(), expected.sh_degree()));
    for i in 0..expected.len() {
        let (found, expected) = (numbers(found, i), numbers(expected, i));
        let off = found.iter().zip(&expected).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(off <= tolerance, "splat {i}, off by {off}: {found:?}, not {expected:?}");
    }
}

#[track_caller]
fn assert_bytes(found: &[u8], expected: &[u8]) {
    let differs = found.iter().zip(expected).position(|(a, b)| a != b);
    assert_eq!((found.len(), differs), (expected.len(), None), "length, and where the first byte is that differs");
}

fn read(name: &str, bytes: &[u8]) -> Splats {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(name);
    std::fs::write(&path, bytes).unwrap();
    format::read_scene(&path).unwrap().splats
}

pub(crate) fn written<T>(name: &str, write: impl FnOnce(&Path) -> Result<T, FormatError>) -> Vec<u8> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(name);
    write(&path).unwrap();
    std::fs::read(path).unwrap()
}

/// A word of 32 bits from fields, each with its number of bits, starting at the top.
fn word(fields: &[(u32, u32)]) -> u32 {
    assert_eq!(fields.iter().map(|(bits, _)| bits).sum::<u32>(), 32);
    fields.iter().fold(0_u32, |word, (bits, value)| word << bits | value)
}

pub(crate) fn floats(values: &[f64]) -> Vec<u8> {
    values.iter().flat_map(|v| (*v as f32).to_le_bytes()).collect()
}

fn shorts(values: &[u16]) -> Vec<u8> {
    values.iter().flat_map(|v| v.to_le_bytes()).collect()
}

/// `PlayCanvas`: words of 11, 10 and 11 bits between the bounds of a chunk, the colour in 4 bytes, and the smallest
/// three of (w, x, y, z) in 10 bits each after the index of the largest.
#[test]
fn compressed_ply() {
    const BOUNDS: &str = "min_x min_y min_z max_x max_y max_z min_scale_x min_scale_y min_scale_z max_scale_x max_scale_y max_scale_z \
                          min_r min_g min_b max_r max_g max_b";
    const LEVELS: [u32; 3] = [2047, 1023, 2047];
    // Least and greatest means, logarithms of scales, and colours.
    let bounds: [[[f64; 3]; 2]; 3] = [
        [[-1.0, 0.0, 2.0], [1.0, 1.0, 6.0]],
        [[-6.0, -5.0, -4.0], [-2.0, -3.0, -1.0]],
        [[0.375, 0.5, 0.625], [0.75, 1.0, 0.875]],
    ];
    // In Morton order, in which they are written, with all bounds reached.
    let means: [[u32; 3]; 4] = [[0, 0, 0], [500, 300, 700], [1500, 100, 1500], [2047, 1023, 2047]];
    let scales: [[u32; 3]; 4] = [[2047, 0, 900], [1000, 400, 2047], [300, 1023, 0], [0, 700, 1500]];
    let colors: [[u32; 4]; 4] = [[0, 255, 51, 10], [255, 0, 204, 100], [102, 153, 0, 200], [204, 51, 255, 250]];
    // Smallest three components of each rotation, with another largest component in each.
    let others: [u32; 3] = [600, 300, 450];
    let harmonics = |i: usize| {
        let mut bytes: [u8; 9] = [7, 255, 17, 128, 60, 200, 33, 90, 0];
        bytes.rotate_left(i);
        bytes
    };

    let properties = |kind: &str, names: &str| -> String {
        names.split_whitespace().map(|name| format!("property {kind} {name}\n")).collect()
    };
    let packed = properties("uint", "packed_position packed_rotation packed_scale packed_color");
    let rest: String = (0..9).map(|i| format!("property uchar f_rest_{i}\n")).collect();
    let header = format!(
        "ply\nformat binary_little_endian 1.0\nelement chunk 1\n{}element vertex 4\n{packed}element sh 4\n{rest}end_header\n",
        properties("float", BOUNDS)
    );
    let mut file = header.into_bytes();
    file.extend(floats(bounds.as_flattened().as_flattened()));
    for (i, ((mean, scale), [r, g, b, a])) in (0..).zip(means.into_iter().zip(scales).zip(colors)) {
        let three = |[x, y, z]: [u32; 3]| word(&[(11, x), (10, y), (11, z)]);
        let rotation = word(&[(2, i), (10, others[0]), (10, others[1]), (10, others[2])]);
        let words = [three(mean), rotation, three(scale), word(&[(8, r), (8, g), (8, b), (8, a)])];
        file.extend(words.into_iter().flat_map(u32::to_le_bytes));
    }
    file.extend((0..4).flat_map(harmonics));

    let between = |[low, high]: [[f64; 3]; 2], codes: [u32; 3], levels: [u32; 3]| -> [f64; 3] {
        std::array::from_fn(|k| low[k] + (high[k] - low[k]) * f64::from(codes[k]) / f64::from(levels[k]))
    };
    // The middle of the bin, except for the first and the last.
    let coefficient = |byte: u8| match byte {
        0 => -4.0,
        255 => 4.0,
        _ => (f64::from(byte) + 0.5) / 32.0 - 4.0,
    };
    let row = |i: usize| {
        let ([r, g, b, a], bytes) = (colors[i], harmonics(i));
        Row {
            mean: between(bounds[0], means[i], LEVELS),
            log_scale: between(bounds[1], scales[i], LEVELS),
            wxyz: with_largest(others.map(|code| (f64::from(code) / 1023.0 - 0.5) * SQRT_2), i),
            opacity: f64::from(a) / 255.0,
            dc: dc_of(between(bounds[2], [r, g, b], [255; 3])),
            // All coefficients of red come first.
            bands: (0..3).map(|k| [0, 3, 6].map(|channel| coefficient(bytes[channel + k]))).collect(),
        }
    };
    let expected = splats(&[0, 1, 2, 3].map(row));
    assert_near(&read("golden.compressed.ply", &file), &expected, 2e-6);
    for splats in [expected.clone(), negated(&expected)] {
        assert_bytes(
            &written("a.compressed.ply", |path| ply::compressed::write(path, &splats, PixelFilter::DILATION)),
            &file,
        );
    }
}

/// antimatter15: mean and linear scales in f32, red, green, blue and opacity, and (w, x, y, z) with an offset of 128.
#[test]
fn splat_rows() {
    let means = [[1.5, -2.25, 0.125], [-7.0, 3.0, 40.5]];
    let scales = [[0.5, 0.25, 2.0], [4.0, 0.125, 1.0]];
    let colors: [[u8; 4]; 2] = [[10, 128, 250, 200], [60, 0, 255, 30]];
    let rotations: [[u8; 4]; 2] = [[192, 160, 48, 198], [64, 208, 98, 199]];
    let bytes = |i: usize| [&floats(&means[i])[..], &floats(&scales[i]), &colors[i], &rotations[i]].concat();
    let file: Vec<u8> = (0..2).flat_map(bytes).collect();
    let row = |i: usize| {
        let [r, g, b, a] = colors[i].map(|byte| f64::from(byte) / 255.0);
        Row {
            mean: means[i],
            log_scale: scales[i].map(f64::ln),
            wxyz: rotations[i].map(|byte| f64::from(byte) / 128.0 - 1.0),
            opacity: a,
            dc: dc_of([r, g, b]),
            bands: vec![],
        }
    };
    let expected = splats(&[0, 1].map(row));
    assert_near(&read("golden.splat", &file), &expected, 1e-6);
    assert_bytes(&written("a.splat", |path| splat::write(path, &expected)), &file);
}

/// Decompressed content of an SPZ of [`spz_of_every_version`]: the header and the attributes one after the other.
fn unpacked_spz(file: &[u8]) -> Vec<u8> {
    if file.starts_with(&[0x1f, 0x8b]) {
        let mut content = vec![];
        flate2::read::GzDecoder::new(file).read_to_end(&mut content).unwrap();
        return content;
    }
    let (mut content, mut offset) = (file[..32].to_vec(), 32 + 16 * 6);
    for entry in file[32..offset].chunks_exact(16) {
        let [compressed, size] = [0, 8].map(|at| u64::from_le_bytes(entry[at..at + 8].try_into().unwrap()) as usize);
        let stream = zstd::bulk::decompress(&file[offset..offset + compressed], size).unwrap();
        assert_eq!(stream.len(), size);
        content.extend(stream);
        offset += compressed;
    }
    assert_eq!(offset, file.len());
    content
}

/// Niantic: 24 bits per mean component with 12 fractional bits, then bytes; rotations are (x, y, z), or the smallest
/// three of (x, y, z, w) as a sign and 9 bits each after the index of the largest. Its y and z axes point in the
/// opposite directions.
#[test]
fn spz_of_every_version() {
    let means: [[i32; 3]; 4] =
        [[0x01_2345, -0x0801, 0x7a_bcde], [-5, 0x1000, -0x12_3456], [7, -9, 11], [0x20_0000, 0x30_0000, -0x40_0001]];
    assert_eq!(means[0][1].to_le_bytes()[..3], [0xff, 0xf7, 0xff], "the two's complement");
    let opacities: [u8; 4] = [10, 100, 200, 250];
    let colors: [[u8; 3]; 4] = [[1, 128, 254], [20, 30, 40], [50, 60, 70], [200, 210, 220]];
    let scales: [[u8; 3]; 4] = [[0, 100, 255], [32, 33, 34], [90, 80, 70], [160, 161, 162]];
    let first_three: [[u8; 3]; 4] = [[150, 60, 200], [60, 200, 150], [200, 150, 60], [90, 140, 30]];
    let smallest_three: [i32; 3] = [100, -200, 300];
    // Multiples of the resolution of 5 bits.
    let harmonics = |i: usize| {
        let mut bytes: [[u8; 3]; 3] = [[16, 72, 136], [200, 248, 40], [96, 160, 224]];
        bytes.as_flattened_mut().rotate_left(i);
        bytes
    };
    let fields: [[(u32, u32); 2]; 3] = smallest_three.map(|c| [(1, u32::from(c < 0)), (9, c.unsigned_abs())]);
    let smallest = |i: u32| word(&[&[(2, i)][..], fields.as_flattened()].concat()).to_le_bytes();

    for (version, number) in [(spz::Version::V2, 2), (spz::Version::V3, 3), (spz::Version::V4, 4)] {
        let streams: [Vec<u8>; 6] = [
            means.as_flattened().iter().flat_map(|v| v.to_le_bytes()[..3].to_vec()).collect(),
            opacities.to_vec(),
            colors.as_flattened().to_vec(),
            scales.as_flattened().to_vec(),
            if number == 2 { first_three.as_flattened().to_vec() } else { (0..4).flat_map(smallest).collect() },
            (0..4).flat_map(|i| harmonics(i).as_flattened().to_vec()).collect(),
        ];
        // Version, number of splats, degree, fractional bits, flags.
        let mut file = [&b"NGSP"[..], &[number, 0, 0, 0], &[4, 0, 0, 0], &[1, 12, 0]].concat();
        if number < 4 {
            file.push(0);
            file.extend(streams.concat());
        } else {
            // Number of streams, and offset of the table of their sizes.
            file.extend([6, 32, 0, 0, 0]);
            file.resize(32, 0);
            let frames = streams.each_ref().map(|stream| zstd::bulk::compress(stream, 1).unwrap());
            for (frame, stream) in frames.iter().zip(&streams) {
                file.extend([frame.len(), stream.len()].map(|size| (size as u64).to_le_bytes()).concat());
            }
            file.extend(frames.concat());
        }

        let row = |i: usize| {
            let [x, y, z, w] = if number == 2 {
                let [x, y, z] = first_three[i].map(|byte| f64::from(byte) / 127.5 - 1.0);
                [x, y, z, (1.0 - x * x - y * y - z * z).sqrt()]
            } else {
                with_largest(smallest_three.map(|c| f64::from(c) / 511.0 / SQRT_2), i)
            };
            let [mx, my, mz] = means[i].map(|v| f64::from(v) / 4096.0);
            let [along_y, along_z, along_x] = harmonics(i).map(|rgb| rgb.map(|byte| f64::from(byte) / 128.0 - 1.0));
            Row {
                mean: [mx, -my, -mz],
                log_scale: scales[i].map(|byte| f64::from(byte) / 16.0 - 10.0),
                wxyz: [w, x, -y, -z],
                opacity: f64::from(opacities[i]) / 255.0,
                dc: colors[i].map(|byte| (f64::from(byte) / 255.0 - 0.5) / 0.15),
                bands: vec![along_y.map(|c| -c), along_z.map(|c| -c), along_x],
            }
        };
        let expected = splats(&[0, 1, 2, 3].map(row));
        assert_near(&read("golden.spz", &file), &expected, 2e-6);
        let content = if number < 4 { file } else { unpacked_spz(&file) };
        for splats in [expected.clone(), negated(&expected)] {
            let options = spz::Options { version, ..spz::Options::default() };
            assert_bytes(&unpacked_spz(&written("a.spz", |path| spz::write(path, &splats, &options))), &content);
        }
    }
}

/// mkkellogg, in one section of two buckets: f32, or means in 16 bits relative to the centre of a bucket and f16, and
/// at level 2 harmonics in bytes; (w, x, y, z); harmonics band by band, and all coefficients of red first within a
/// band.
#[test]
fn ksplat_of_every_level() {
    const HEADERS: usize = 4096 + 1024;
    let centers = [[-4.0, -5.0, -6.0], [1.0, 2.0, 3.0]];
    let means: [(usize, [u16; 3]); 3] =
        [(0, [10_000, 40_000, 60_000]), (1, [1, 32_767, 65_534]), (1, [50_000, 20_000, 30_000])];
    let scales = [[0.5, 0.25, 2.0], [4.0, 0.125, 1.0], [0.0625, 8.0, 16.0]];
    let colors: [[u8; 4]; 3] = [[10, 128, 250, 200], [60, 0, 255, 30], [77, 88, 99, 111]];
    let rotation = [1.0, 3.0, -5.0, 8.0].map(|c: f64| c / 99f64.sqrt());
    let coarse = rotation.map(f16::from_f64);
    assert_eq!(coarse.map(f16::to_bits), [0x2e6f, 0x34d3, 0xb805, 0x3a6f]);

    for (level, code) in [(ksplat::Level::Float, 0), (ksplat::Level::Half, 1), (ksplat::Level::HalfAndByte, 2)] {
        let [low, high] = if code == 2 { [-1.5, 1.25] } else { [-0.75, 0.6875] };
        // Byte `j` of the 24 numbers after coefficient 0, in the order of the file.
        let harmonic_byte = |j: usize| if j == 23 { 255 } else { 11 * j as u8 };
        let harmonic = |j: usize| match code {
            2 => low + f64::from(harmonic_byte(j)) / 255.0 * (high - low),
            _ => low + j as f64 / 16.0,
        };
        let row = |i: usize| {
            let ((bucket, mean), [r, g, b, a]) = (means[i], colors[i]);
            let place = |k: usize, channel: usize| if k < 4 { 3 * channel + k - 1 } else { 9 + 5 * channel + k - 4 };
            Row {
                mean: std::array::from_fn(|k| centers[bucket][k] + (f64::from(mean[k]) - 32767.0) * 2.5 / 32767.0),
                log_scale: scales[i].map(f64::ln),
                wxyz: if code == 0 { rotation } else { coarse.map(f16::to_f64) },
                opacity: f64::from(a) / 255.0,
                dc: dc_of([r, g, b].map(|c| f64::from(c) / 255.0)),
                bands: (1..9).map(|k| [0, 1, 2].map(|channel| harmonic(place(k, channel)))).collect(),
            }
        };
        let rows = [0, 1, 2].map(row);
        let harmonics: Vec<f64> = (0..24).map(harmonic).collect();
        let halves = |values: &[f64]| shorts(&values.iter().map(|v| f16::from_f64(*v).to_bits()).collect::<Vec<_>>());
        let bytes = |i: usize| -> Vec<u8> {
            let geometry = match code {
                0 => floats(&[&rows[i].mean[..], &scales[i], &rotation].concat()),
                _ => [shorts(&means[i].1), halves(&scales[i]), halves(&rotation)].concat(),
            };
            let harmonics = match code {
                0 => floats(&harmonics),
                1 => halves(&harmonics),
                _ => (0..24).map(harmonic_byte).collect(),
            };
            [geometry, colors[i].to_vec(), harmonics].concat()
        };
        let stored: Vec<u8> = (0..3).flat_map(bytes).collect();
        let mut file = vec![0; HEADERS];
        let mut put = |at: usize, bytes: &[u8]| file[at..at + bytes.len()].copy_from_slice(bytes);
        let int = |v: u32| v.to_le_bytes();
        // Version 0.1, sections, splats, level, range of the harmonics; splats and degree of the section.
        put(0, &[0, 1]);
        [4, 8].iter().for_each(|at| put(*at, &int(1)));
        [12, 16, 4096, 4096 + 4].iter().for_each(|at| put(*at, &int(3)));
        put(20, &[code, 0]);
        put(36, &floats(&[low, high]));
        put(4096 + 40, &[2, 0]);
        let mut buckets = vec![];
        if code > 0 {
            // Splats in a full bucket, buckets, side of a block, bytes and range of means, full and partial buckets.
            for (at, value) in [(8, 256), (12, 2), (20, 12), (24, 32_767), (32, 0), (36, 2)] {
                put(4096 + at, &int(value));
            }
            put(4096 + 16, &floats(&[5.0]));
            buckets = [&int(1)[..], &int(2)[..], &floats(centers.as_flattened())[..]].concat();
        }
        put(4096 + 28, &int((buckets.len() + stored.len()) as u32));
        file.extend(buckets);
        file.extend(&stored);

        let expected = splats(&rows);
        assert_near(&read("golden.ksplat", &file), &expected, 1e-6);
        let mut found = written("a.ksplat", |path| ksplat::write(path, &expected, level));
        if code == 0 {
            // The centre of the scene, which no reader needs.
            found[24..36].fill(0);
            assert_bytes(&found, &file);
        } else {
            // Buckets, and with them means, are the writer's choice; splats have a unique order, along x.
            let size = stored.len() / 3;
            let last = found.split_off(found.len() - stored.len());
            for (found, expected) in last.chunks_exact(size).zip(stored.chunks_exact(size)) {
                assert_bytes(&found[6..], &expected[6..]);
            }
        }
    }
}
