use std::io::{Read as _, Write as _};

use proptest::prelude::*;

use super::*;
use crate::format::test_scenes::{assert_same_loss, random_splats, saturated_splats};
use crate::scene::PixelFilter;

const VERSIONS: [Version; 3] = [Version::V2, Version::V3, Version::V4];

fn written(splats: &Splats, options: &Options) -> (Vec<u8>, WriteReport) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("s.spz");
    let report = write(&path, splats, options).unwrap();
    (std::fs::read(path).unwrap(), report)
}

fn gzipped(content: &[u8]) -> Vec<u8> {
    let mut gzip = flate2::write::GzEncoder::new(vec![], flate2::Compression::fast());
    gzip.write_all(content).unwrap();
    gzip.finish().unwrap()
}

fn message(bytes: &[u8]) -> String {
    parse(bytes).unwrap_err().in_file(Path::new("a.spz")).to_string()
}

/// [`random_splats`] with the coefficients above band 0 within ±1, which the format can store.
fn holdable(n: usize, degree: u32) -> Splats {
    let mut arrays = random_splats(n, degree, 1).into_arrays();
    let k = sh::coefficients(degree);
    arrays.sh.iter_mut().enumerate().filter(|(i, _)| i % k > 0).for_each(|(_, c)| *c = c.map(|v| 0.49 * v));
    arrays.check().unwrap()
}

#[test]
fn round_trip_stays_within_the_stated_errors() {
    for version in VERSIONS {
        for (degree, sh_bits) in [(0, [5, 4]), (1, [5, 4]), (2, [5, 4]), (3, [5, 4]), (3, [8, 8])] {
            let splats = holdable(3000, degree);
            let (bytes, report) = written(&splats, &Options { version, sh_bits, antialiased: degree == 2 });
            assert_eq!(bytes.len() as u64, report.bytes);
            let SplatFile { splats: back, pixel_filter, notes, .. } = parse(&bytes).unwrap();
            assert!(notes.is_empty());
            assert_eq!(pixel_filter.normalized, degree == 2, "the flag");
            assert_same_loss(&report.loss, &Loss::of_splats(&splats, &back));
            let e = report.loss.max_error;
            // Coordinates up to 3 have 14 fractional bits.
            assert!(e.mean <= 0.5f32.powi(15) + 1e-7 && e.mean > 2e-5, "{e:?}");
            assert!(e.log_scale <= 1.0 / 32.0 + 1e-5 && e.log_scale > 0.03, "{e:?}");
            assert!(e.opacity <= 1.0 / 510.0 + 1e-6 && e.opacity > 0.0015, "{e:?}");
            assert!(e.color <= 0.0037, "{e:?}");
            assert!(e.rotation < if version == Version::V2 { 13.5 } else { 0.28 } && e.rotation > 0.1, "{e:?}");
            let sh = match (degree, sh_bits) {
                (0, _) => 0.0,
                (1, [5, _]) => 1.0 / 32.0,
                (_, [5, _]) => 1.0 / 16.0,
                // 0.98 is the greatest coefficient.
                _ => 1.0 / 256.0,
            };
            assert!(e.sh <= sh + 1e-6 && e.sh >= 0.9 * sh, "{degree} {e:?}");
        }
    }
}

#[test]
fn extremes_survive() {
    for version in VERSIONS {
        let options = Options { version, ..Options::default() };
        let splats = saturated_splats();
        let (bytes, report) = written(&splats, &options);
        let back = parse(&bytes).unwrap().splats;
        assert_same_loss(&report.loss, &Loss::of_splats(&splats, &back));
        // Coordinates of 10⁶ leave 3 fractional bits.
        assert_eq!(back.means(), splats.means());
        assert!(report.loss.max_error.opacity < 1e-6 && report.loss.max_error.sh > 1e3, "{:?}", report.loss);
        assert_eq!(parse(&written(&Splats::empty(2), &options).0).unwrap().splats, Splats::empty(2));
    }
}

#[test]
fn notes_name_what_is_not_taken_over() {
    // One splat of degree 4, anti-aliased, with an unknown extension and a stated frame.
    let mut content = b"NGSP\x03\0\0\0\x01\0\0\0\x04\x0c\x03\0".to_vec();
    content.extend([0, 16, 0, 0, 32, 0, 0, 48, 0]);
    content.extend([255, 128, 128, 128, 160, 160, 160, 0, 0, 0, 0xc0]);
    content.extend((0..72).map(|k| 128 + k));
    content.extend([0x78, 0x56, 0x34, 0x12, 3, 0, 0, 0, 9, 9, 9]);
    content.extend(0xADBE_0003u32.to_le_bytes().into_iter().chain([4, 0, 0, 0, 6, 0, 0, 0]));
    for bytes in [content.clone(), gzipped(&content)] {
        let SplatFile { splats, pixel_filter, notes, .. } = parse(&bytes).unwrap();
        assert_eq!(pixel_filter, PixelFilter::NORMALIZED_DILATION);
        assert_eq!(splats.means()[0].to_array(), [1.0, 2.0, 3.0], "right, down, front as it is");
        assert_eq!((splats.sh_degree(), splats.sh_of(0)[1]), (3, [0.0, 1.0 / 128.0, 2.0 / 128.0]));
        assert_eq!(notes.len(), 2, "{notes:?}");
        assert!(notes[0].contains("0x12345678 (3 bytes)"), "{notes:?}");
        assert!(notes[1].contains("above degree 3 of 4"), "{notes:?}");
    }
    let last = content.len() - 4;
    content[last] = 17;
    assert!(message(&content).contains("expected a coordinate system of 0 to 16, found 17"));
}

#[test]
fn messages_name_place_expected_and_found() {
    assert_eq!(
        message(b"PK\x03\x04 and more than 16 bytes"),
        "a.spz: byte 0: expected an SPZ header (`NGSP`), found [50, 4b, 03, 04]"
    );
    assert_eq!(message(b"NGSP\x01\0\0\0\0\0\0\0\0\0\0\0"), "a.spz: byte 4: expected SPZ version 2, 3 or 4, found 1");
    assert_eq!(message(b"NGSP\x02\0\0\0\0\0\0\0\x05\0\0\0"), "a.spz: byte 12: expected SH degree 0 to 4, found 5");
    assert_eq!(
        message(b"NGSP\x02\0\0\0\x02\0\0\0\0\0\0\0abc"),
        "a.spz: byte 19: expected 18 bytes of means, found 3 bytes"
    );
    assert!(message(&gzipped(b"NGSP")).contains("expected 16 bytes of header, found 4 bytes"));

    let (v4, _) = written(&random_splats(9, 0, 1), &Options::default());
    let with = |at: usize, byte: u8| {
        let mut changed = v4.clone();
        changed[at] = byte;
        message(&changed)
    };
    assert!(with(15, 7).contains("byte 15: expected 5 streams, found 7"));
    assert!(with(16, 31).contains("byte 16: expected a table of 5 streams within"));
    assert!(with(8, 10).contains("byte 40: expected 90 bytes of means, found 81"));
    assert!(with(33, 255).contains("byte 32: expected means within the"));
    assert!(with(32 + 5 * 16, 0).contains("byte 112: expected means that can be decompressed"), "{}", with(112, 0));
}

#[test]
fn a_short_file_cannot_fill_the_memory() {
    for content in [*b"NGSP\x03\0\0\0\xff\xff\xff\xff\x03\x0c\0\0", *b"NGSP\x03\0\0\0\0\0\x40\0\x03\x0c\0\0"] {
        let raw = message(&content);
        assert!(raw.contains("byte 8: expected at most 67108864 bytes of splats in a file of 16"), "{raw}");
        assert!(message(&gzipped(&content)).contains("byte 8: "));
    }
    // A plausible count without the data allocates no more than the data present.
    assert!(message(b"NGSP\x03\0\0\0\0\0\x08\0\0\x0c\0\0").contains("expected 4718592 bytes of means, found 0 bytes"));
    // A zstd frame that is longer than the table says.
    let (mut v4, _) = written(&random_splats(9, 0, 1), &Options::default());
    let long = zstd::bulk::compress(&vec![0; 1 << 24], 1).unwrap();
    let frames = 32 + 5 * 16;
    let means = frames + v4[32] as usize;
    v4.splice(frames..means, long.iter().copied());
    v4[32..40].copy_from_slice(&(long.len() as u64).to_le_bytes());
    assert!(message(&v4).contains("byte 112: expected 81 bytes of means, found more"), "{}", message(&v4));
}

#[test]
fn damage_inside_gzip_is_found_by_its_checksum() {
    let (mut bytes, _) = written(&random_splats(100, 1, 1), &Options { version: Version::V3, ..Options::default() });
    let at = bytes.len() - 6;
    bytes[at] ^= 1;
    assert!(message(&bytes).contains("expected trailer that can be decompressed"), "{}", message(&bytes));
    // However much data follows the part that is read.
    let (bytes, _) = written(&random_splats(9, 1, 1), &Options { version: Version::V3, ..Options::default() });
    let mut content = vec![];
    flate2::read::GzDecoder::new(&bytes[..]).read_to_end(&mut content).unwrap();
    content.resize(content.len() + (1 << 18), 0);
    let mut long = gzipped(&content);
    parse(&long).unwrap();
    let at = long.len() - 6;
    long[at] ^= 1;
    assert!(message(&long).contains("expected trailer that can be decompressed"), "{}", message(&long));
}

proptest! {
    #[test]
    fn damaged_files_do_not_panic(
        which in 0usize..3, degree in 0u32..4, cut in 0usize..1200, at in 0usize..1200, byte: u8, packed: bool,
    ) {
        let (mut file, _) = written(&random_splats(7, degree, 9), &Options { version: VERSIONS[which], ..Options::default() });
        if which < 2 && packed {
            // Damage of the decompressed content, which the checksum does not catch.
            let mut content = vec![];
            std::io::Read::read_to_end(&mut flate2::read::GzDecoder::new(&file[..]), &mut content).unwrap();
            file = content;
        }
        file.truncate(cut.max(1));
        let at = at % file.len();
        file[at] = byte;
        let _ = parse(&file);
        if which < 2 && packed {
            let _ = parse(&gzipped(&file));
        }
    }
}
