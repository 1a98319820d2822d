use std::io::{Cursor, Write as _};

use glam::Vec3;
use proptest::prelude::*;
use serde_json::{Value, json};
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipArchive, ZipWriter};

use super::*;
use crate::format::test_scenes::random_splats;

type Files = Vec<(String, Vec<u8>)>;

fn written(splats: &Splats) -> (Vec<u8>, WriteReport) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("s.sog");
    let report = write(&path, splats, PixelFilter::DILATION).unwrap();
    let bytes = std::fs::read(&path).unwrap();
    assert_eq!(report.bytes, bytes.len() as u64);
    (bytes, report)
}

fn parse(zip: Vec<u8>) -> Result<Splats, String> {
    let set = FileSet::bundle(zip);
    set.and_then(|mut set| Ok(set.splats()?.splats)).map_err(|fault| fault.in_file(Path::new("s.sog")).to_string())
}

fn unzip(zip: &[u8]) -> Files {
    let mut archive = ZipArchive::new(Cursor::new(zip)).unwrap();
    (0..archive.len())
        .map(|i| {
            let mut member = archive.by_index(i).unwrap();
            let mut content = vec![];
            std::io::copy(&mut member, &mut content).unwrap();
            (member.name().unwrap().into_owned(), content)
        })
        .collect()
}

fn zipped(files: &Files, method: CompressionMethod) -> Vec<u8> {
    let mut zip = ZipWriter::new(Cursor::new(vec![]));
    for (name, content) in files {
        zip.start_file(name, SimpleFileOptions::default().compression_method(method)).unwrap();
        zip.write_all(content).unwrap();
    }
    zip.finish().unwrap().into_inner()
}

/// The bundle with a changed `meta.json`.
fn with_meta(zip: &[u8], change: impl FnOnce(&mut Value)) -> Vec<u8> {
    let mut files = unzip(zip);
    let (_, text) = files.iter_mut().find(|(name, _)| name == files::META).unwrap();
    let mut meta = serde_json::from_slice(text).unwrap();
    change(&mut meta);
    *text = serde_json::to_vec(&meta).unwrap();
    zipped(&files, CompressionMethod::Stored)
}

#[test]
fn round_trip_within_the_stated_loss() {
    for degree in 0..=3 {
        let splats = random_splats(3000, degree, u64::from(degree));
        let (zip, report) = written(&splats);
        let back = parse(zip.clone()).unwrap();
        assert_eq!((back.len(), back.sh_degree()), (3000, degree));
        // Splats are matched in the order in which they are written.
        let order = encode::encode(&splats, false).map_err(|_| ()).unwrap().order;
        let mut loss = Loss::default();
        for (i, &source) in order.iter().enumerate() {
            loss.max_error.include(&SplatRecord::of(&splats, source), &SplatRecord::of(&back, i));
        }
        assert_eq!(loss, report.loss, "what a reader gets is what was measured");
        let e = report.loss.max_error;
        // Half a step: 16 bits of ln(1+|x|) for |x| ≤ 3, whose derivative is 1/(1+|x|).
        let step = 2.0 * 4f32.ln() / 65535.0 * 4.0;
        assert!(e.mean > 0.0 && e.mean <= 0.51 * step, "{}", e.mean);
        assert!(e.opacity <= 0.501 / 255.0, "{}", e.opacity);
        // Half a step of √2/255 in three components, in the worst case in all of them, and the resulting error of the
        // fourth.
        assert!(e.rotation < 0.9 && e.rotation > 0.2, "{}", e.rotation);
        // 256 values over a range of 10, and over a range of 4 multiplied by C0; three times the half step of even
        // spacing leaves room for gaps.
        assert!(e.log_scale < 3.0 * 10.0 / 512.0 && e.color < 3.0 * 4.0 * 0.2821 / 512.0, "{e:?}");
        assert!((e.sh > 0.0) == (degree > 0));
        assert_eq!(written(&splats).0, zip, "the same bytes again");
        assert_eq!(parse(zipped(&unzip(&zip), CompressionMethod::Deflated)).unwrap(), back);
    }
}

#[test]
fn few_and_no_splats() {
    for n in [0, 1, 2, 17] {
        let splats = random_splats(n, 3, 7);
        let (zip, report) = written(&splats);
        assert_eq!(parse(zip).unwrap().len(), n);
        // Up to a power of two, each splat has its own palette entry; all values share 256 levels.
        assert!(n > 2 || report.loss.max_error.sh == 0.0, "{:?}", report.loss);
    }
}

#[test]
fn a_folder_holds_the_same_as_a_bundle() {
    let folder = tempfile::tempdir().unwrap();
    let splats = random_splats(100, 1, 3);
    let path = folder.path().join("meta.json");
    let report = write(&path, &splats, PixelFilter::DILATION).unwrap();
    assert_eq!(read(&path, &ReadOptions::default()).unwrap().splats, parse(written(&splats).0).unwrap());
    let bytes: u64 = folder.path().read_dir().unwrap().map(|e| e.unwrap().metadata().unwrap().len()).sum();
    assert_eq!((report.bytes, folder.path().read_dir().unwrap().count()), (bytes, 8));

    std::fs::remove_file(folder.path().join("quats.webp")).unwrap();
    let message = read(&path, &ReadOptions::default()).unwrap_err().to_string();
    assert!(message.contains("/quats/files/0: expected a readable file, found `quats.webp`"), "{message}");
}

#[test]
fn names_do_not_lead_out_of_the_folder() {
    let folder = tempfile::tempdir().unwrap();
    let inner = folder.path().join("in");
    std::fs::create_dir(&inner).unwrap();
    let path = inner.join("meta.json");
    write(&path, &random_splats(9, 0, 3), PixelFilter::DILATION).unwrap();
    std::fs::rename(inner.join("quats.webp"), folder.path().join("quats.webp")).unwrap();
    let meta = std::fs::read_to_string(&path).unwrap();
    let outside = folder.path().join("quats.webp");
    let names = ["../quats.webp", "./../quats.webp", "..\\quats.webp", "..", "", outside.to_str().unwrap()];
    #[cfg(unix)]
    std::os::unix::fs::symlink(&outside, inner.join("link.webp")).unwrap();
    for name in names.into_iter().chain(cfg!(unix).then_some("link.webp")) {
        let quoted = serde_json::to_string(name).unwrap();
        std::fs::write(&path, meta.replace("\"quats.webp\"", &quoted)).unwrap();
        let message = read(&path, &ReadOptions::default()).unwrap_err().to_string();
        assert!(message.contains("/quats/files/0: expected a path inside the folder"), "{message}");
    }
    // The same file under another name.
    std::fs::copy(&outside, inner.join("quats.webp")).unwrap();
    std::fs::write(&path, meta.replace("\"quats.webp\"", "\"./quats.webp\"")).unwrap();
    assert_eq!(read(&path, &ReadOptions::default()).unwrap().splats.len(), 9);
    // A folder is refused, as is anything that is not a regular file, such as a pipe to which nobody writes.
    std::fs::create_dir(inner.join("none")).unwrap();
    std::fs::write(&path, meta.replace("\"quats.webp\"", "\"none\"")).unwrap();
    let message = read(&path, &ReadOptions::default()).unwrap_err().to_string();
    assert!(message.contains("/quats/files/0: expected a file, found `none`, which is none"), "{message}");
}

#[test]
fn version_1_has_ranges() {
    let splats = random_splats(200, 1, 4);
    let zip = with_meta(&written(&splats).0, |meta| {
        let object = meta.as_object_mut().unwrap();
        object.remove("version");
        object.remove("count");
        meta["means"]["shape"] = json!([200, 3]);
        for (name, mins, maxs) in [
            ("scales", json!([-10.0, -10.0, -10.0]), json!([2.0, 0.0, 1.0])),
            ("sh0", json!([-1.0, -2.0, -3.0, -4.0]), json!([1.0, 2.0, 3.0, 4.0])),
            ("shN", json!(-0.5), json!(0.5)),
        ] {
            let field = meta[name].as_object_mut().unwrap();
            field.remove("codebook");
            field.insert("mins".to_owned(), mins);
            field.insert("maxs".to_owned(), maxs);
        }
    });
    let back = parse(zip.clone()).unwrap();
    assert_eq!((back.len(), back.sh_degree()), (200, 1));
    let encoded = encode::encode(&splats, false).map_err(|_| ()).unwrap();
    let byte = |image: usize, i: usize, c: usize| f32::from(encoded.images[image].at(i)[c]) / 255.0;
    let label = |i| usize::from(u16::from_le_bytes([encoded.images[6].at(i)[0], encoded.images[6].at(i)[1]]));
    for i in 0..200 {
        // f32 rounding of the table.
        let near = |a: f32, b: f32| assert!((a - b).abs() < 2e-6, "{a} {b}");
        near(back.log_scales()[i].y, -10.0 + 10.0 * byte(2, i, 1));
        near(back.sh_of(i)[0][2], -3.0 + 6.0 * byte(4, i, 2));
        near(back.opacity_logits()[i], -4.0 + 8.0 * byte(4, i, 3));
        near(back.sh_of(i)[2][1], -0.5 + byte(5, 3 * label(i) + 1, 1));
    }
    let none = parse(with_meta(&zip, |meta| meta["sh0"]["maxs"] = json!([1.0, 2.0]))).unwrap_err();
    assert_eq!(none, "s.sog: `meta.json`, /sh0/maxs: expected a number for channel 3, found none");
}

#[test]
fn a_codebook_may_lack_its_first_value() {
    let zip = written(&random_splats(500, 0, 4)).0;
    let mut expected = 0.0;
    let patched = with_meta(&zip, |meta| {
        let at = |i: usize| meta["scales"]["codebook"][i].as_f64().unwrap();
        expected = at(1) - (at(255) - at(1)) / 255.0;
        meta["scales"]["codebook"][0] = Value::Null;
    });
    let back = parse(patched).unwrap();
    let least = back.log_scales().iter().map(|s| s.min_element()).fold(f32::INFINITY, f32::min);
    assert!((f64::from(least) - expected).abs() < 1e-5, "{least} {expected}");
}

#[test]
fn a_codebook_may_be_short() {
    let zip = written(&random_splats(500, 0, 4)).0;
    let patched = |codebook: Value| parse(with_meta(&zip, |meta| meta["scales"]["codebook"] = codebook));
    let scales = |back: &Splats| {
        let values = back.log_scales().iter().flat_map(Vec3::to_array);
        values.map(|v| v.to_string()).collect::<std::collections::BTreeSet<_>>().into_iter().collect::<Vec<_>>()
    };
    assert_eq!(scales(&patched(json!([-2.0])).unwrap()), ["-2"]);
    // Indices beyond the end refer to the last value.
    assert_eq!(scales(&patched(json!([-3.0, -2.0])).unwrap()), ["-2", "-3"]);
    assert!(patched(json!([null])).unwrap_err().contains("/scales/codebook: expected 1 to 256 numbers"));
}

#[test]
fn antialiasing_is_said_as_every_reader_knows_it() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("s.sog");
    write(&path, &random_splats(9, 0, 4), PixelFilter::NORMALIZED_DILATION).unwrap();
    let zip = std::fs::read(&path).unwrap();
    let read = |change: &dyn Fn(&mut Value)| {
        let SplatFile { pixel_filter, notes, .. } =
            FileSet::bundle(with_meta(&zip, change)).and_then(|mut set| set.splats()).unwrap();
        (pixel_filter.normalized, notes)
    };
    let both =
        |meta: &mut Value| assert_eq!((&meta["antialias"], &meta["model"]), (&json!(true), &json!("antialiased")));
    assert_eq!(read(&both), (true, vec![]));
    let with = |antialias: Value, model: Value| {
        read(&|meta| {
            meta["antialias"] = antialias.clone();
            meta["model"] = model.clone();
        })
    };
    assert_eq!(with(json!(false), json!("antialiased")), (true, vec![]));
    assert_eq!(with(json!(true), json!("default")), (false, vec![]));
    assert_eq!(with(json!(true), Value::Null), (true, vec![]), "the description's own key");
    let (antialiased, notes) = with(json!(false), json!("2dgs"));
    assert!(!antialiased && notes.len() == 1 && notes[0].starts_with("model 2dgs: "), "{notes:?}");
    assert_eq!(with(json!(true), json!("3dgs")), (true, vec!["model `3dgs`: not known, left out".to_owned()]));
    assert_eq!(with(json!(false), json!(3)), (false, vec!["model `3`: not known, left out".to_owned()]));
    // Without either there is neither.
    write(&path, &random_splats(9, 0, 4), PixelFilter::DILATION).unwrap();
    let none = |meta: &mut Value| assert!(meta.get("antialias").is_none() && meta.get("model").is_none());
    with_meta(&std::fs::read(&path).unwrap(), none);
}

#[test]
fn members_are_found_by_names_with_backslashes() {
    let zip = written(&random_splats(9, 0, 4)).0;
    let splats = parse(zip.clone()).unwrap();
    let images = json!([r"in\means_l.webp", r"in\means_u.webp"]);
    let within = with_meta(&zip, |meta| meta["means"]["files"] = images);
    // Folders, and parts of names.
    for begin in ["in/", r"in\"] {
        let mut files = unzip(&within);
        let means = files.iter_mut().filter(|(name, _)| name.starts_with("means_"));
        means.for_each(|(name, _)| name.insert_str(0, begin));
        assert_eq!(parse(zipped(&files, CompressionMethod::Stored)).unwrap(), splats, "{begin}");
    }
}

#[test]
fn what_a_file_has_besides_is_named() {
    let zip = written(&random_splats(9, 0, 4)).0;
    let more = with_meta(&zip, |meta| {
        meta["camera"] = json!({ "fov": 60, "position": [0, 1, 2.5] });
        meta["extras"] = json!("a");
    });
    let read = FileSet::bundle(more).and_then(|mut set| set.splats()).unwrap();
    assert_eq!(read.notes, ["`camera`, `extras` of meta.json: left out"]);
    assert_eq!(read.splats, parse(zip).unwrap());
}

#[test]
fn planted_faults_are_named() {
    let zip = written(&random_splats(500, 2, 4)).0;
    let message = |change: &dyn Fn(&mut Value)| parse(with_meta(&zip, change)).unwrap_err();
    for (change, expected) in [
        (
            (&|m: &mut Value| m["version"] = json!(3)) as &dyn Fn(&mut Value),
            "/version: expected version 2, or none for version 1, found 3",
        ),
        (&|m| m["count"] = json!(1_000_000_000), "/count: expected at most"),
        (&|m| m["count"] = Value::Null, "/count: expected the number of splats, found none"),
        (&|m| m["count"] = json!(-1), "`meta.json`, /count: expected the `meta.json` of a SOG, found"),
        (&|m| m["count"] = json!(600), ": expected 600 to 66736 texels, found 24×24"),
        (&|m| m["means"]["files"] = json!(["means_l.webp"]), "/means/files: expected 2 file(s), found 1"),
        (&|m| m["means"]["mins"] = json!([0, 0]), "/means/mins: expected a number for channel 2, found none"),
        (&|m| m["means"]["maxs"] = json!([1e3, 1e3, 1e3]), "/means: expected finite numbers, found inf in means["),
        (&|m| m["scales"]["codebook"] = json!([]), "/scales/codebook: expected 1 to 256 numbers, found 0"),
        (
            &|m| m["scales"]["codebook"] = json!(vec![1.0; 257]),
            "/scales/codebook: expected 1 to 256 numbers, found 257",
        ),
        (&|m| m["sh0"]["codebook"][9] = Value::Null, "/sh0/codebook: expected 1 to 256 numbers, found null"),
        (&|m| m["shN"]["bands"] = json!(3), "/shN/bands: expected 3 as by the palette's width"),
        (&|m| m["shN"]["bands"] = json!(7), "/shN/bands: expected 1 to 3"),
        (&|m| m["shN"]["count"] = json!(1 << 17), "/shN/count: expected at most 65536"),
        (&|m| m["shN"]["count"] = json!(4096), "/shN/count: expected at most 256 entries, found 4096"),
        (&|m| m["shN"]["count"] = json!(3), "/shN/files/1: expected labels below 3, found"),
        (&|m| m["quats"]["files"] = json!(["sh0.webp"]), "/quats: expected alpha of 252 to 255, found"),
        (&|m| m["quats"]["files"] = json!(["meta.json"]), "`meta.json`, byte 8: expected a lossless WebP image, found"),
        (&|m| m["quats"]["files"] = json!(["../../x"]), "/quats/files/0: expected a readable file, found `../../x`"),
        (
            &|m| m["shN"]["files"] = json!(["sh0.webp", "sh0.webp"]),
            "`sh0.webp`, byte 25: expected 64 texels per coefficient",
        ),
    ] {
        let found = message(change);
        assert!(found.starts_with("s.sog: ") && found.contains(expected), "{found}, not {expected}");
    }
    assert!(parse(zip[..zip.len() / 2].to_vec()).unwrap_err().contains(": expected the directory of a zip before"));
    let without: Files = unzip(&zip).into_iter().filter(|(name, _)| name != files::META).collect();
    let message = parse(zipped(&without, CompressionMethod::Stored)).unwrap_err();
    assert!(message.contains("expected `meta.json` among the files of the zip"), "{message}");
}

#[test]
fn small_files_do_not_unpack_to_large_ones() {
    let zip = written(&random_splats(10, 0, 4)).0;
    let mut files = unzip(&zip);
    files[0].1 = vec![0; 50 << 20];
    let bomb = zipped(&files, CompressionMethod::Deflated);
    assert!(bomb.len() < 1 << 18);
    let message = parse(bomb).unwrap_err();
    assert!(
        message.contains("`means_l.webp`, byte ") && message.contains("expected the end of the file at"),
        "{message}"
    );
    // An image of one colour takes a few bytes at any size.
    let mut files = unzip(&zip);
    files[2].1 = texels::Texels::opaque(4096, 4096).encode();
    let message = parse(zipped(&files, CompressionMethod::Stored)).unwrap_err();
    assert!(message.contains("`scales.webp`, byte 25: expected 10 to 65556 texels, found 4096×4096"), "{message}");
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(400))]
    #[test]
    fn damaged_files_do_not_panic(
        file in 0usize..8, cut in 0usize..6000, hits in proptest::collection::vec((0usize..6000, any::<u8>()), 1..6),
        whole: bool,
    ) {
        use std::sync::LazyLock;
        static ZIP: LazyLock<Vec<u8>> = LazyLock::new(|| written(&random_splats(300, 1, 9)).0);
        let damage = |bytes: &mut Vec<u8>| {
            if cut % 4 == 0 {
                bytes.truncate(cut);
            }
            let n = bytes.len().max(1);
            for &(at, byte) in &hits {
                if let Some(slot) = bytes.get_mut(at % n) {
                    *slot = byte;
                }
            }
        };
        if whole {
            let mut zip = ZIP.clone();
            damage(&mut zip);
            let _ = parse(zip);
        } else {
            // Damage inside a member, so that the zip's checksum does not catch it.
            let mut files = unzip(&ZIP);
            damage(&mut files[file].1);
            let _ = parse(zipped(&files, CompressionMethod::Stored));
        }
    }
}
