use proptest::prelude::*;

use super::*;
use crate::format::test_scenes::{assert_same_loss, random_splats, saturated_splats};
use crate::scene::sh;

const LEVELS: [Level; 3] = [Level::Float, Level::Half, Level::HalfAndByte];

fn encode(splats: &Splats, level: Level) -> (Vec<u8>, Loss) {
    let mut file = vec![];
    let loss = encode::encode(splats, level, &mut file).unwrap();
    (file, loss)
}

fn decode(bytes: &[u8]) -> Result<Splats, Fault> {
    decode::decode(std::io::Cursor::new(bytes))
}

fn message(bytes: &[u8]) -> String {
    decode(bytes).unwrap_err().in_file(Path::new("a.ksplat")).to_string()
}

/// `splats` in the order of `back`, matched by the nearest mean.
fn reordered(splats: &Splats, back: &Splats) -> Splats {
    let mut arrays = splats.clone().into_arrays();
    let k = sh::coefficients(splats.sh_degree());
    for (i, &mean) in back.means().iter().enumerate() {
        let distance = |j: &usize| splats.means()[*j].distance_squared(mean);
        let j = (0..splats.len()).min_by(|a, b| distance(a).total_cmp(&distance(b))).unwrap();
        arrays.means[i] = splats.means()[j];
        arrays.rotations[i] = splats.rotations()[j];
        arrays.log_scales[i] = splats.log_scales()[j];
        arrays.opacity_logits[i] = splats.opacity_logits()[j];
        arrays.sh[k * i..k * (i + 1)].copy_from_slice(splats.sh_of(j));
    }
    arrays.check().unwrap()
}

#[test]
fn round_trip_stays_within_the_stated_errors() {
    for level in LEVELS {
        for degree in 0..4 {
            let splats = random_splats(2000, degree, 1);
            let (bytes, loss) = encode(&splats, level);
            let back = decode(&bytes).unwrap();
            assert_eq!(back.len(), 2000);
            let same = if level == Level::Float { splats.clone() } else { reordered(&splats, &back) };
            assert_same_loss(&loss, &Loss::of_splats(&same, &back));
            assert_eq!(loss.sh_degree, (degree == 3).then_some([3, 2]));
            let e = loss.max_error;
            assert!(e.opacity <= 1.0 / 510.0 + 1e-6 && e.opacity > 0.0015, "{e:?}");
            assert!((0.05..0.066).contains(&e.color), "±2 leaves 0..1 by 0.064: {e:?}");
            // Blocks are 6/16 wide; coefficients are within ±2, and scales from e^−9 to e.
            let (mean, log_scale, rotation, sh) = match level {
                Level::Float => (0.0, 1e-6, 1e-4, 0.0),
                Level::Half => (6.0 / 16.0 / 131_068.0 + 3e-7, 4.9e-4, 0.06, 4.9e-4),
                Level::HalfAndByte => (6.0 / 16.0 / 131_068.0 + 3e-7, 4.9e-4, 0.06, 4.0 / 510.0),
            };
            assert!(e.mean <= mean && e.log_scale <= log_scale && e.rotation <= rotation, "{level:?} {e:?}");
            assert!(e.sh <= sh + 1e-6 && (degree == 0 || e.sh >= 0.9 * sh), "{level:?} {e:?}");
        }
    }
}

#[test]
fn layout_is_the_formats() {
    let splats = random_splats(600, 2, 4);
    let (bytes, _) = encode(&splats, Level::Float);
    assert_eq!(bytes.len(), HEADER + SECTION_HEADER + 600 * 140);
    assert_eq!(bytes[..8], [0, 1, 0, 0, 1, 0, 0, 0]);
    let row = &bytes[HEADER + SECTION_HEADER..];
    let float = |at: usize| f32::from_le_bytes(*row[at..].first_chunk().unwrap());
    assert_eq!(float(0), splats.means()[0].x);
    assert_eq!(float(24), splats.rotations()[0].w);
    let c = splats.sh_of(0);
    // Band 1: red −1, 0, 1, then green; band 2 follows after nine coefficients.
    assert_eq!([0, 1, 3, 9, 14].map(|k| float(44 + 4 * k)), [c[1][0], c[2][0], c[1][1], c[4][0], c[4][1]]);
    for (level, stride) in [(Level::Half, 72), (Level::HalfAndByte, 48)] {
        let (bytes, _) = encode(&splats, level);
        let word = |at: usize| u32::from_le_bytes(*bytes[HEADER + at..].first_chunk().unwrap()) as usize;
        let (buckets, full, partial) = (word(12), word(32), word(36));
        assert!(buckets == full + partial && partial > 1, "{buckets} {full} {partial}");
        assert_eq!(bytes.len(), HEADER + SECTION_HEADER + 4 * partial + 12 * buckets + 600 * stride);
        assert_eq!(word(28), bytes.len() - HEADER - SECTION_HEADER);
    }
}

#[test]
fn full_buckets_come_first() {
    let mut arrays = random_splats(1000, 0, 4).into_arrays();
    // Two distant clusters of 700 and 300 splats.
    arrays.means.iter_mut().enumerate().for_each(|(i, m)| *m = *m * 0.01 + if i < 700 { 0.0 } else { 103.0 });
    let splats = arrays.check().unwrap();
    let (bytes, loss) = encode(&splats, Level::Half);
    assert_eq!(bytes[HEADER + 32..HEADER + 40], [3, 0, 0, 0, 2, 0, 0, 0]);
    assert_eq!(bytes[HEADER + SECTION_HEADER..][..8], [188, 0, 0, 0, 44, 0, 0, 0]);
    assert!(loss.max_error.mean < 4e-5, "blocks are 5 wide: {loss:?}");
    assert_eq!(decode(&bytes).unwrap().means().iter().filter(|m| m.x < 50.0).count(), 700);
}

#[test]
fn extremes_survive() {
    for level in LEVELS {
        let splats = saturated_splats();
        let (bytes, loss) = encode(&splats, level);
        assert_eq!(decode(&bytes).unwrap().len(), splats.len());
        assert!(loss.max_error.opacity < 1e-6 && loss.max_error.mean < 0.1, "{level:?} {loss:?}");
        assert_eq!(decode(&encode(&Splats::empty(1), level).0).unwrap(), Splats::empty(1));
    }
}

#[test]
fn messages_name_place_expected_and_found() {
    let (good, _) = encode(&random_splats(300, 1, 1), Level::Half);
    let with = |at: usize, byte: u8| {
        let mut changed = good.clone();
        changed[at] = byte;
        message(&changed)
    };
    assert_eq!(
        message(&[0; 9]),
        "a.ksplat: byte 9: expected a .ksplat header of 4096 bytes, found the end of the file"
    );
    assert_eq!(with(1, 2), "a.ksplat: byte 0: expected .ksplat version 0.1, found 0.2");
    assert_eq!(with(20, 3), "a.ksplat: byte 20: expected compression level 0, 1 or 2, found 3");
    assert!(with(7, 255).contains("byte 4: expected at most "));
    assert_eq!(with(16, 0), "a.ksplat: byte 16: expected 300 splats as in the sections, found 256");
    assert_eq!(with(HEADER + 40, 3), "a.ksplat: byte 4136: expected SH degree 0 to 2, found 3");
    assert!(with(HEADER + 1, 2).contains("byte 4096: expected at most 300 splats in the section, found 556"));
    assert!(with(HEADER + 7, 255).contains("byte 4096: expected a section that ends within the file's"));
    assert!(with(HEADER + 20, 4).contains("byte 4116: expected at least 12 bytes per bucket, found 4"));
    assert!(with(HEADER + SECTION_HEADER, 0).contains("byte 5120: expected buckets for 300 splats, found for "));
    assert!(message(&good[..good.len() - 1]).contains("ends within the file's"));
    let (mut negative, _) = encode(&random_splats(2, 0, 1), Level::Float);
    let scale = HEADER + SECTION_HEADER + 12;
    negative[scale..scale + 4].copy_from_slice(&(-0.5_f32).to_le_bytes());
    assert!(
        message(&negative).ends_with(": expected finite numbers, found NaN in log_scales[0]"),
        "{}",
        message(&negative)
    );
}

proptest! {
    #[test]
    fn damaged_files_do_not_panic(
        level in 0usize..3, degree in 0u32..3, cut in 0usize..9000, body in 0usize..3000, head in 0usize..44, section in 0usize..44,
        byte: u8, which in 0usize..3,
    ) {
        let (mut file, _) = encode(&random_splats(7, degree, 9), LEVELS[level]);
        let at = [head, HEADER + section, HEADER + SECTION_HEADER + body][which];
        let at = at.min(file.len() - 1);
        file[at] = byte;
        let _ = decode(&file);
        file.truncate(cut);
        let _ = decode(&file);
    }
}
