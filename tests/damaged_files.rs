//! Every reader on random bytes and on valid files that were damaged: no panic, no more memory than the file justifies,
//! and a message that names the file, the place, what was expected and what was found. `make fuzz` searches further.

#![allow(clippy::unwrap_used, reason = "a failed unwrap is a failed test")]

#[path = "../fuzz/src/lib.rs"]
#[allow(unreachable_pub, reason = "public in its own crate")]
mod fuzz;
mod samples;

use std::path::Path;
use std::sync::{Mutex, PoisonError};

use centaur::capture::{self, CaptureError, LoadOptions};
use centaur::format::{self, Fault, FormatError, Location, ReadOptions, Sampling};
use centaur::optimize::checkpoint::Checkpoint;
use peak_alloc::PeakAlloc;
use proptest::prelude::*;
use proptest::test_runner::{RngSeed, TestRunner};
use samples::{PHOTOGRAPH, Sample, samples};

#[global_allocator]
static MEMORY: PeakAlloc = PeakAlloc;

/// Memory is counted for the whole process, so one test runs at a time.
static ONE_AT_A_TIME: Mutex<()> = Mutex::new(());

/// Largest memory per byte of a file. 5 kB of SOG hold 40 splats of 140 bytes in images of 100 kB, and 30 bytes of a
/// PLY header name a property that takes 100 bytes of memory.
const MOST_PER_BYTE: usize = 40;
/// Largest memory per byte of a photograph, which can be grey and of a single colour: 32,768 bytes per stored byte,
/// four times that as RGBA, as much again for undistortion, and the memory of a mask and a downscaled picture.
const MOST_PER_BYTE_OF_PICTURES: usize = 12 << 15;
/// Additional memory for buffers, and for images of a size that small files may declare.
const MOST_BESIDES: usize = 16 << 20;

fn folder() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    std::fs::create_dir(folder.path().join("images")).unwrap();
    for name in ["a.png", "b.png"] {
        std::fs::write(folder.path().join("images").join(name), PHOTOGRAPH).unwrap();
    }
    folder
}

/// Reads the files in every way in which the program would; returns whether any was accepted.
fn read(folder: &Path, reader: &str, files: &[(&str, Vec<u8>)]) -> bool {
    if reader == "photograph" {
        fuzz::prepare_for_photograph(folder);
    }
    for (name, content) in files {
        std::fs::write(folder.join(name), content).unwrap();
    }
    let most_per_byte = if reader == "photograph" { MOST_PER_BYTE_OF_PICTURES } else { MOST_PER_BYTE };
    let path = folder.join(files[0].0);
    let before = MEMORY.current_usage();
    MEMORY.reset_peak_usage();
    let (taken, said) = match reader {
        "colmap_text" | "colmap_binary" | "transforms" => {
            let options = LoadOptions::default();
            let opened = capture::open(folder, &options).map(drop).map_err(of_capture);
            let cameras = capture::cameras(folder, &options).map(drop).map_err(of_capture);
            // The capture is also read for its cameras alone.
            (opened.is_ok() || cameras.is_ok(), vec![opened, cameras])
        }
        "photograph" => {
            let read = fuzz::decode(folder).map(|read| read.map_err(of_capture));
            (read.iter().any(Result::is_ok), read.into())
        }
        "checkpoint" => {
            let read = Checkpoint::read(&path).map(drop).map_err(|e| e.to_string());
            (read.is_ok(), vec![read])
        }
        "obj" | "mesh_ply" => {
            let read = format::mesh_import::read(&path).map(drop).map_err(of_format);
            (read.is_ok(), vec![read])
        }
        _ => {
            let strict = format::read_file(&path, &ReadOptions::default()).map(drop);
            let lenient = format::read_file(
                &path,
                &ReadOptions { drop_invalid: true, keep_document: true, ..ReadOptions::default() },
            )
            .map(drop);
            assert!(strict.is_err() || lenient.is_ok());
            let taken = strict.is_ok();
            let others = [
                format::inspect(&path).map(drop),
                format::validate(&path).map(drop),
                format::mesh_import::read(&path).map(drop),
                format::read_cameras(&path, &Sampling::default()).map(drop),
            ];
            // Only these formats can be posed.
            let options = ReadOptions { time: Some(0.3), ..ReadOptions::default() };
            let posed =
                ["glb", "gltf", "gltf_and_bin"].contains(&reader).then(|| format::read_file(&path, &options).map(drop));
            (
                taken,
                [strict, lenient].into_iter().chain(posed).chain(others).map(|read| read.map_err(of_format)).collect(),
            )
        }
    };
    let peak = MEMORY.peak_usage().saturating_sub(before);
    let size: usize = files.iter().map(|(_, content)| content.len()).sum();
    assert!(peak <= most_per_byte * size + MOST_BESIDES, "{reader}: {peak} bytes of memory for a file of {size}");
    for message in said.iter().filter_map(|read| read.as_ref().err()) {
        // Whatever the file contains, the message is one line that names it.
        assert!(!message.contains(['\n', '\r']) && message.len() < 600, "{message:?}");
        assert!(message.contains(&*folder.to_string_lossy()), "{message:?}");
    }
    taken
}

/// Message of an error, after checking that it states the place, what was expected and what was found.
#[expect(clippy::needless_pass_by_value, reason = "what `map_err` takes")]
fn of_format(e: FormatError) -> String {
    match &e {
        FormatError::Read { .. } => {}
        FormatError::Content { fault: Fault { location, expected, found }, .. } => {
            let is_member_alone = matches!(location, Location::Member { at, .. } if **at == Location::File);
            // Many formats have no cameras and no meshes: nothing is malformed then, but the whole file is of another
            // kind.
            let is_of_other_kind = expected.starts_with("a file that can hold cameras");
            assert!((*location != Location::File && !is_member_alone) || is_of_other_kind, "nowhere: {e}");
            assert!(!expected.is_empty() && !found.is_empty(), "{e}");
        }
        other => panic!("nothing that reading fails of: {other}"),
    }
    e.to_string()
}

#[expect(clippy::needless_pass_by_value, reason = "what `map_err` takes")]
fn of_capture(e: CaptureError) -> String {
    let place = match &e {
        CaptureError::Points(FormatError::Content { fault, .. }) => {
            assert!(fault.location != Location::File && !fault.expected.is_empty(), "nowhere: {e}");
            return e.to_string();
        }
        CaptureError::Invalid { place, expected, found, .. } => {
            assert!(!expected.is_empty() && !found.is_empty(), "{e}");
            place
        }
        CaptureError::UnsupportedModel { place, .. } => place,
        // Of these, only the second has an offset; the others concern files, not their content.
        CaptureError::Io { .. }
        | CaptureError::Truncated { .. }
        | CaptureError::Image { .. }
        | CaptureError::Points(_)
        | CaptureError::Missing { .. } => return e.to_string(),
        other => panic!("of an unknown kind: {other}"),
    };
    let is_place = place.starts_with('/') || ["line ", "byte "].iter().any(|word| place.contains(word));
    // Items that are missing altogether.
    assert!(
        is_place
            || ["capture", "cameras", "views", "COLMAP model", "image size", "mask size", "mask"].contains(&&**place),
        "nowhere: {e}"
    );
    e.to_string()
}

#[test]
fn the_samples_are_valid() {
    let _alone = ONE_AT_A_TIME.lock().unwrap_or_else(PoisonError::into_inner);
    for Sample { reader, files } in samples() {
        assert!(read(folder().path(), reader, &files), "{reader}");
    }
}

/// A way to damage a file.
#[derive(Clone, Debug)]
enum Damage {
    Set(f64, u8),
    /// Sets four bytes: inflated counts.
    Word(f64, u32),
    Cut(f64),
    /// Repeats some bytes.
    Repeat(f64, usize),
    /// Lengthens a number in text.
    Digits(f64),
}

fn damage() -> impl Strategy<Value = Damage> {
    // Headers, which cause most errors, are at the beginning.
    let place = || prop_oneof![0.0..1.0, (0.0..1.0f64).prop_map(|x| x * x * x * x)];
    prop_oneof![
        4 => (place(), any::<u8>()).prop_map(|(at, byte)| Damage::Set(at, byte)),
        3 => (place(), prop_oneof![Just(u32::MAX), Just(1 << 31), Just(i32::MAX as u32), any::<u32>()])
            .prop_map(|(at, word)| Damage::Word(at, word)),
        1 => (0.0..1.0).prop_map(Damage::Cut),
        1 => (place(), 1usize..300).prop_map(|(at, count)| Damage::Repeat(at, count)),
        2 => place().prop_map(Damage::Digits),
    ]
}

fn apply(bytes: &mut Vec<u8>, damage: &Damage) {
    if bytes.is_empty() {
        return;
    }
    let place = |part: f64| ((bytes.len() as f64 * part) as usize).min(bytes.len() - 1);
    match *damage {
        Damage::Set(at, byte) => {
            let at = place(at);
            bytes[at] = byte;
        }
        Damage::Word(at, word) => {
            let at = place(at);
            bytes[at..].iter_mut().zip(word.to_le_bytes()).for_each(|(b, w)| *b = w);
        }
        Damage::Cut(at) => bytes.truncate(place(at)),
        Damage::Repeat(at, count) => {
            let at = place(at);
            let again = bytes[at..bytes.len().min(at + count)].to_vec();
            bytes.splice(at..at, again);
        }
        Damage::Digits(at) => {
            let start = place(at);
            if let Some(at) = bytes[start..].iter().position(u8::is_ascii_digit) {
                bytes.splice(start + at..start + at, *b"98765432109876543210");
            }
        }
    }
}

/// The same cases in every run, so that a failure is caused by the current change; `PROPTEST_RNG_SEED` gives others.
fn runner(cases: u32) -> TestRunner {
    let mut config = ProptestConfig::with_cases(cases);
    if config.rng_seed == RngSeed::Random {
        config.rng_seed = RngSeed::Fixed(1);
    }
    TestRunner::new(config)
}

#[test]
fn damaged_files() {
    let _alone = ONE_AT_A_TIME.lock().unwrap_or_else(PoisonError::into_inner);
    for Sample { reader, files } in samples() {
        let folder = folder();
        let strategy = (0..files.len(), proptest::collection::vec(damage(), 1..4));
        let mut runner = runner(300);
        let outcome = runner.run(&strategy, |(which, damages)| {
            let mut damaged = files.clone();
            damages.iter().for_each(|d| apply(&mut damaged[which].1, d));
            if reader == "checkpoint" {
                fuzz::mend_checksum(&mut damaged[which].1);
            }
            read(folder.path(), reader, &damaged);
            Ok(())
        });
        assert!(outcome.is_ok(), "{reader}: {}", outcome.unwrap_err());
    }
}

/// Error message for a file in which `from` is replaced by `to`, once, in its whole text or bytes.
fn said_of(reader: &str, name: &str, from: &[u8], to: &[u8]) -> String {
    let folder = folder();
    let all = samples();
    let has = |content: &[u8]| content.windows(from.len()).position(|window| window == from);
    let sample = all.iter().find(|s| s.reader == reader && s.files.iter().any(|(n, c)| *n == name && has(c).is_some()));
    let mut files =
        sample.unwrap_or_else(|| panic!("{reader}: no {name} with {:?}", from.escape_ascii())).files.clone();
    let (_, content) = files.iter_mut().find(|(n, _)| *n == name).unwrap();
    let at = has(content).unwrap();
    content.splice(at..at + from.len(), to.iter().copied());
    if content.starts_with(b"PK") {
        // Otherwise only the zip's checksums would be reported, not the content.
        mend_checksums(content);
    }
    let error = match reader {
        "colmap_text" | "colmap_binary" | "transforms" => {
            files.iter().for_each(|(name, content)| std::fs::write(folder.path().join(name), content).unwrap());
            capture::open(folder.path(), &LoadOptions::default()).unwrap_err().to_string()
        }
        _ => {
            let path = folder.path().join(name);
            std::fs::write(&path, &files[0].1).unwrap();
            format::read_file(&path, &ReadOptions::default()).unwrap_err().to_string()
        }
    };
    error.replace(&format!("{}/", folder.path().display()), "")
}

/// Corrects the checksums of a zip whose members are stored consecutively with their declared lengths.
fn mend_checksums(zip: &mut [u8]) {
    let word = |zip: &[u8], at: usize| u32::from_le_bytes(*zip[at..].first_chunk().unwrap()) as usize;
    let half = |zip: &[u8], at: usize| usize::from(u16::from_le_bytes(*zip[at..].first_chunk().unwrap()));
    let (mut at, mut sums) = (0, vec![]);
    while zip[at..].starts_with(b"PK\x03\x04") {
        let start = at + 30 + half(zip, at + 26) + half(zip, at + 28);
        let end = start + word(zip, at + 18);
        let mut crc = flate2::Crc::new();
        crc.update(&zip[start..end]);
        sums.push(crc.sum().to_le_bytes());
        zip[at + 14..at + 18].copy_from_slice(&sums[sums.len() - 1]);
        at = end;
    }
    for sum in sums {
        assert!(zip[at..].starts_with(b"PK\x01\x02"), "a directory behind the members");
        zip[at + 16..at + 20].copy_from_slice(&sum);
        at += 46 + half(zip, at + 28) + half(zip, at + 30) + half(zip, at + 32);
    }
}

#[test]
fn messages_name_the_place() {
    let _alone = ONE_AT_A_TIME.lock().unwrap_or_else(PoisonError::into_inner);
    let nan = f32::NAN.to_le_bytes();
    let mut others = vec![];
    for (reader, name, from, to, said) in [
        (
            "ply",
            "scene.ply",
            &b"property float opacity\n"[..],
            &b""[..],
            "byte 36: expected a PLY with the vertex property",
        ),
        (
            "ply",
            "scene.ply",
            b"element vertex",
            b"element vertez",
            ": expected the element `vertex` before the end of the",
        ),
        ("ply", "scene.ply", b"2 1e-3", b"2 nan", "byte 471: expected finite numbers, found NaN in row 2 of `y`; "),
        (
            "compressed_ply",
            "scene.compressed.ply",
            b"element chunk",
            b"element chunc",
            ": expected the element `chunk`",
        ),
        ("spz", "scene.spz", b"NGSP", b"NGSQ", "byte 0: expected"),
        ("sog", "scene.sog", b"\"count\":40", b"\"count\":-4", "`meta.json`, /count: expected"),
        ("sog", "scene.sog", b"\"mins\":[", b"\"mins\":{", "`meta.json`, byte "),
        ("sog", "scene.sog", b"\"version\":2", b"\"version\":7", "`meta.json`, /version: expected version 2"),
        ("sog", "scene.sog", b"\"means_l.webp\"", b"\"means_x.webp\"", "`meta.json`, /means/files/0: expected"),
        ("sog", "scene.sog", b"\"quats.webp\"", b"77777777.777", "`meta.json`, /quats/files/0: expected"),
        ("sog", "scene.sog", b"\"mins\":[", b"\"nims\":[", "`meta.json`, /means/mins: expected a number for channel 0"),
        ("sog", "scene.sog", b"WEBPVP8L", b"WEBPVP8X", "`means_l.webp`, byte "),
        ("usdz", "scene.usdz", b"upAxis = \"Y\"", b"upAxis = \"N\"", "`scene.usda`, /upAxis: expected Y or Z"),
        ("usdz", "scene.usdz", b"#usda 1.0\n(", b"#usda 1.0\n}", "`scene.usda`, line 2, column 1: expected"),
        ("usda", "scene.usda", b"orientations = [(", b"orientations = [[", ": line "),
        ("glb", "scene.glb", b"\"bufferView\":0", b"\"bufferView\":z", "byte "),
        (
            "glb",
            "scene.glb",
            b"\"layers\":1",
            b"\"layers\":9",
            "/scenes/0/extensions/EXT_gaussian_splatting_hybrid/layers: expected",
        ),
        ("gltf", "scene.gltf", b"\"byteLength\":36", b"\"byteLength\":-6", "/bufferViews/1/byteLength: expected"),
        ("colmap_text", "cameras.txt", b"OPENCV 1", b"OPENCV x", "cameras.txt: line 1: expected a width"),
        ("colmap_text", "cameras.txt", b"OPENCV 1", b"OPENCW 1", "cameras.txt: line 1: expected a camera model"),
        ("colmap_text", "images.txt", b"2 b.png", b"9 b.png", "images.txt: line 3, image b.png: expected a camera"),
        ("colmap_binary", "images.bin", b"b.png", b"b.\xffng", "images.bin: image name at byte "),
        ("transforms", "transforms.json", b"[0,0,0,1]]},", b"[0,0,0]]},", "transforms.json: line 2 column "),
        (
            "transforms",
            "transforms.json",
            b"images/b",
            b"../ges/b",
            "transforms.json: /frames/1/file_path: expected a path",
        ),
    ] {
        let message = said_of(reader, name, from, to);
        if !(message.contains(said) && message.starts_with(&format!("{name}: ")) && message.contains(", found ")) {
            others.push(format!("{reader}, {said}: {message}"));
        }
    }
    assert!(others.is_empty(), "{others:#?}");
    let broken = said_of("splat", "scene.splat", &1.0f32.to_le_bytes(), &nan);
    assert!(broken.starts_with("scene.splat: byte 0: expected finite numbers, found NaN as "), "{broken}");
}

/// The fuzz targets must be able to read all samples.
#[test]
fn fuzz_targets_take_the_samples() {
    let _alone = ONE_AT_A_TIME.lock().unwrap_or_else(PoisonError::into_inner);
    for Sample { reader, files } in samples() {
        let packed = || {
            let (last, others) = files.split_last().unwrap();
            let length = |bytes: &[u8]| u16::try_from(bytes.len()).unwrap().to_le_bytes();
            let others = others.iter().flat_map(|(_, bytes)| length(bytes).into_iter().chain(bytes.iter().copied()));
            others.chain(last.1.iter().copied()).collect::<Vec<u8>>()
        };
        let names: Vec<&str> = files.iter().map(|(name, _)| *name).collect();
        let (name, bytes) = &files[0];
        let taken = match reader {
            "colmap_text" | "colmap_binary" | "transforms" => fuzz::capture(&names, &packed()),
            "gltf_and_bin" | "streamed_sog" => fuzz::scene_of_files(&names, &packed()),
            "photograph" => fuzz::photograph(&names, &packed()),
            "checkpoint" => fuzz::checkpoint(bytes),
            "obj" | "mesh_ply" => fuzz::mesh(name, bytes),
            "glb" | "gltf" | "usda" | "usdc" | "usdz" => fuzz::scene_and_mesh(name, bytes),
            _ => fuzz::splats(name, bytes),
        };
        assert!(taken, "{reader}");
        let targets = Path::new(env!("CARGO_MANIFEST_DIR")).join("fuzz/fuzz_targets");
        assert!(targets.join(format!("{reader}.rs")).is_file(), "{reader}");
    }
}

/// Documents in which a few bytes are referenced many times: their content is held in memory once, or not at all.
#[test]
fn what_is_named_often_is_held_once() {
    let _alone = ONE_AT_A_TIME.lock().unwrap_or_else(PoisonError::into_inner);
    let folder = folder();
    // One triangle; then 10,000 increasing numbers, and 10,000 times the translations of three vertices.
    let keys = 10_000;
    let mut bin: Vec<u8> =
        [0.0f32, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0].iter().flat_map(|v| v.to_le_bytes()).collect();
    bin.extend((0..keys).flat_map(|i| (i as f32).to_le_bytes()));
    bin.extend((0..9 * keys).flat_map(|i| (i as f32 * 1e-6).to_le_bytes()));
    std::fs::write(folder.path().join("a.bin"), &bin).unwrap();
    let document = |primitive: serde_json::Value, animation: serde_json::Value| {
        let accessor = |view: usize, kind: &str, count: usize| serde_json::json!({ "bufferView": view, "componentType": 5126, "type": kind, "count": count, "min": [0.0, 0.0, 0.0], "max": [1.0, 1.0, 0.0] });
        let mut document = serde_json::json!({
            "asset": { "version": "2.0" }, "scene": 0, "scenes": [{ "nodes": [0] }], "nodes": [{ "mesh": 0 }],
            "meshes": [{ "primitives": [primitive] }], "animations": [animation],
            "accessors": [accessor(0, "VEC3", 3), accessor(1, "SCALAR", keys), accessor(2, "VEC3", 3 * keys), accessor(2, "VEC3", keys)],
            "bufferViews": [
                { "buffer": 0, "byteLength": 36 }, { "buffer": 0, "byteOffset": 36, "byteLength": 4 * keys },
                { "buffer": 0, "byteOffset": 36 + 4 * keys, "byteLength": 36 * keys },
            ],
            "buffers": [{ "uri": "a.bin", "byteLength": bin.len() }],
        });
        document["accessors"][1]["min"] = serde_json::json!([0.0]);
        document["accessors"][1]["max"] = serde_json::json!([keys as f32 - 1.0]);
        document
    };
    let still = serde_json::json!({ "attributes": { "POSITION": 0 } });
    let slide = serde_json::json!({ "input": 1, "output": 3 });
    let channel = serde_json::json!({ "sampler": 0, "target": { "node": 0, "path": "translation" } });
    let channels = serde_json::json!({ "samplers": [slide], "channels": vec![channel.clone(); 20_000] });
    let one = serde_json::json!({ "samplers": [slide], "channels": [channel] });
    let own = serde_json::json!({ "times": 1, "translations": 2 });
    let deformed =
        serde_json::json!({ "attributes": { "POSITION": 0 }, "extensions": { "EXT_gaussian_splatting_hybrid": own } });
    let targets = vec![serde_json::json!({ "POSITION": 0 }); 20_000];
    let targets = serde_json::json!({ "attributes": { "POSITION": 0 }, "targets": targets });
    for (name, document) in [
        ("channels", document(still, channels)),
        ("keys", document(deformed, one.clone())),
        ("targets", document(targets, one.clone())),
        ("buffers", {
            let mut document = document(serde_json::json!({ "attributes": { "POSITION": 0 } }), one);
            let buffer = document["buffers"][0].clone();
            document["buffers"] = serde_json::json!(vec![buffer; 2000]);
            document
        }),
    ] {
        let text = document.to_string();
        let path = folder.path().join("a.gltf");
        std::fs::write(&path, &text).unwrap();
        let before = MEMORY.current_usage();
        for way in 0..3 {
            MEMORY.reset_peak_usage();
            if way < 2 {
                let time = [None, Some(0.3)][way];
                let read = format::read_file(&path, &ReadOptions { time, ..ReadOptions::default() });
                assert_eq!(read.unwrap().scene.meshes[0].positions().len(), 3, "{name}");
            } else {
                format::validate(&path).unwrap();
            }
            let peak = MEMORY.peak_usage().saturating_sub(before);
            let most = MOST_PER_BYTE * (text.len() + bin.len()) + MOST_BESIDES;
            assert!(peak <= most, "{name}, {way}: {peak} bytes of memory for a file of {}", text.len() + bin.len());
        }
    }
}

/// Buffers of a GLB are parts of the file, which is in memory as a whole.
#[test]
fn a_glb_is_held_once_while_it_is_validated() {
    let _alone = ONE_AT_A_TIME.lock().unwrap_or_else(PoisonError::into_inner);
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.glb");
    let bin = vec![0_u8; 8 << 20];
    let mut json =
        format!(r#"{{"asset":{{"version":"2.0"}},"buffers":[{{"byteLength":{}}}]}}"#, bin.len()).into_bytes();
    json.resize(json.len().next_multiple_of(4), b' ');
    let length = |bytes: usize| u32::try_from(bytes).unwrap().to_le_bytes();
    let chunk = |kind: &[u8], content: &[u8]| [&length(content.len())[..], kind, content].concat();
    let chunks = [chunk(b"JSON", &json), chunk(b"BIN\0", &bin)].concat();
    let file = [&b"glTF\x02\0\0\0"[..], &length(12 + chunks.len()), &chunks[..]].concat();
    std::fs::write(&path, &file).unwrap();
    let before = MEMORY.current_usage();
    MEMORY.reset_peak_usage();
    let validation = format::validate(&path).unwrap();
    let peak = MEMORY.peak_usage().saturating_sub(before);
    assert_eq!(validation.errors, 0, "{validation}");
    assert!(peak < file.len() + file.len() / 2, "{peak} bytes of memory for a file of {}", file.len());
}

#[test]
fn random_bytes() {
    let _alone = ONE_AT_A_TIME.lock().unwrap_or_else(PoisonError::into_inner);
    let folder = folder();
    for Sample { reader, files } in samples() {
        let mut runner = runner(60);
        // With and without the format's magic bytes.
        let strategy = (0..64usize, proptest::collection::vec(any::<u8>(), 0..300));
        let outcome = runner.run(&strategy, |(start, random)| {
            let begun = |content: &[u8]| [&content[..start.min(content.len())], &random].concat();
            let files: Vec<(&str, Vec<u8>)> = files.iter().map(|(name, c)| (*name, begun(c))).collect();
            read(folder.path(), reader, &files);
            Ok(())
        });
        assert!(outcome.is_ok(), "{reader}: {}", outcome.unwrap_err());
    }
}
