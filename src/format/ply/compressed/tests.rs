use std::io::Cursor;

use proptest::prelude::*;

use super::*;
use crate::format::ply::parse_splats;
use crate::format::test_scenes::{assert_same_loss, random_splats, saturated_splats};

fn written(splats: &Splats) -> (Vec<u8>, WriteReport) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("s.compressed.ply");
    let report = write(&path, splats, PixelFilter::DILATION).unwrap();
    (std::fs::read(path).unwrap(), report)
}

fn as_written(splats: &Splats) -> Splats {
    let mut arrays = SplatArrays::with_capacity(splats.len(), splats.sh_degree());
    in_morton_order(splats).iter().for_each(|&i| arrays.push(&SplatRecord::of(splats, i)));
    arrays.check().unwrap()
}

#[test]
fn round_trip_stays_within_the_stated_errors() {
    for degree in 0..4 {
        let splats = random_splats(3000, degree, 1);
        let (bytes, report) = written(&splats);
        assert_eq!(bytes.len() as u64, report.bytes);
        let back = parse_splats(Cursor::new(&bytes)).unwrap();
        assert_same_loss(&report.loss, &Loss::of_splats(&as_written(&splats), &back));
        let e = report.loss.max_error;
        assert_eq!(report.loss.sh_degree, None);
        // Chunks are smaller than the scene, whose positions span 6 and log-scales 10; y has only 10 bits.
        assert!(e.mean < 6.0 / 2046.0 && e.mean > 1e-4, "{e:?}");
        assert!(e.log_scale <= 10.0 / 2046.0 + 1e-5 && e.log_scale > 0.003, "{e:?}");
        assert!(e.rotation < 0.28 && e.rotation > 0.1, "{e:?}");
        assert!(e.opacity <= 1.0 / 510.0 + 1e-6, "{e:?}");
        // Coefficients of ±2 correspond to colours from −0.064 to 1.064.
        assert!(e.color <= 1.13 / 510.0, "{e:?}");
        assert!(e.sh <= 1.0 / 64.0 + 1e-6 && (degree == 0 || e.sh > 0.015), "{e:?}");
    }
}

#[test]
fn rotations_of_any_largest_component_and_sign() {
    for i in 0..4 {
        for sign in [-1.0, 1.0] {
            let mut c = [0.1, -0.2, 0.3, -0.25];
            c[i] = 0.9 * sign;
            let q = Quat::from_array(c).normalize();
            let back = decode_rotation(encode_rotation(q));
            assert!(q.dot(back).abs() > 0.999_99, "{q} {back}");
        }
    }
    assert_eq!(encode_rotation(Quat::IDENTITY) >> 30, 0, "w comes first");
}

#[test]
fn extremes_survive() {
    let splats = saturated_splats();
    let (bytes, report) = written(&splats);
    let back = parse_splats(Cursor::new(&bytes)).unwrap();
    assert_eq!(back.len(), splats.len());
    assert!(report.loss.max_error.opacity < 1e-6);
    assert_eq!(parse_splats(Cursor::new(written(&Splats::empty(2)).0)).unwrap(), Splats::empty(2));
    assert_eq!((coefficient(0), coefficient(255), coefficient_byte(-1e9), coefficient_byte(4.0)), (-4.0, 4.0, 0, 255));
}

#[test]
fn chunks_without_colour_bounds() {
    let splats = random_splats(2, 0, 3);
    let (bytes, _) = written(&splats);
    let end = bytes.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
    let header = String::from_utf8(bytes[..end].to_vec()).unwrap();
    let header: String = header
        .lines()
        .filter(|l| !l.ends_with("_r") && !l.ends_with("_g") && !l.ends_with("_b"))
        .fold(String::new(), |h, l| h + l + "\n");
    let mut old = header.into_bytes();
    old.extend(&bytes[end..end + 48]);
    old.extend(&bytes[end + 72..]);
    let last = old.len();
    old[last - 4..].copy_from_slice(&0x00ff_8040_u32.to_le_bytes());
    let rgb = sh::rgb_from_dc(parse_splats(Cursor::new(old)).unwrap().sh_of(1)[0]);
    let expected = [0.0, 1.0, 128.0 / 255.0];
    assert!(rgb.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-6), "{rgb:?}");
}

#[test]
fn messages_name_what_is_missing() {
    let (bytes, _) = written(&random_splats(300, 1, 3));
    let message = |from: &str, to: &str| {
        let end = bytes.windows(11).position(|w| w == b"end_header\n").unwrap();
        let header = String::from_utf8(bytes[..end].to_vec()).unwrap().replace(from, to);
        let changed = [header.as_bytes(), &bytes[end..]].concat();
        parse_splats(Cursor::new(changed)).unwrap_err().in_file(Path::new("a.ply")).to_string()
    };
    assert!(message("chunk 2", "chunk 1").contains("expected 2 chunks of 256 splats for 300 splats, found 1 chunks"));
    assert!(message("element sh 300", "element sh 299").contains("`sh` with 300 rows of uchar, found 299 rows"));
    assert!(message("f_rest_8", "f_other").contains("`f_rest` properties, found 8"));
    assert!(message("packed_scale", "other").contains("property `packed_scale`"));
}

proptest! {
    #[test]
    fn damaged_files_do_not_panic(cut in 0usize..9000, at in 0usize..9000, byte: u8, degree in 0u32..4, n in 0usize..300) {
        let (mut file, _) = written(&random_splats(n, degree, 9));
        file.truncate(cut.max(1));
        let at = at % file.len();
        file[at] = byte;
        let _ = parse_splats(Cursor::new(&file));
    }
}
