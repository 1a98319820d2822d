//! Validation of SPZ files.

use super::{Findings, Offenders};
use crate::format::error::Location;
use crate::format::spz::container::{KNOWN_FLAGS, Packed, decode};
use crate::scene::sh;

/// Amount by which rounding may lengthen the stored components of a unit quaternion: half a step of 1/127.5 in each of
/// three (version 2), or of √½/511.
const ROTATION_TOLERANCE: [f64; 2] = [0.01, 0.002];

/// Checks an SPZ file. Values are bytes, so none is infinite or NaN; possible faults are those of the container, and
/// values at the ends of their ranges.
pub(super) fn check(bytes: &[u8], findings: &mut Findings) {
    let Packed { header, streams, notes, unused, .. } = match decode(bytes) {
        Ok(packed) => packed,
        Err(fault) => return findings.fault("SPZ_CONTENT", fault),
    };
    for note in notes {
        findings.warning("SPZ_NOT_READ", Location::File, "what Centaur reads", note);
    }
    if unused > 0 {
        findings.warning("SPZ_LENGTH", Location::File, "no bytes beside streams and extensions", unused);
    }
    if header.flags & !KNOWN_FLAGS != 0 {
        let expected = "no flags but 0x1 (anti-aliased) and 0x2 (extensions)";
        findings.warning("SPZ_FLAGS", Location::File, expected, format!("{:#x}", header.flags));
    }
    if header.sh_degree > sh::MAX_DEGREE {
        findings.warning("SPZ_SH_DEGREE", Location::File, "SH degree 0 to 3, as in glTF", header.sh_degree);
    }
    if header.fractional_bits > 24 {
        let expected = "at most 24 bits behind the point of 24-bit means";
        findings.warning("SPZ_FRACTIONAL_BITS", Location::File, expected, header.fractional_bits);
    }
    let [means, opacities, _, scales, rotations, _] = &streams;
    let mut limits = Offenders::default();
    for (i, mean) in means.as_chunks::<9>().0.iter().enumerate() {
        let fixed = mean.as_chunks::<3>().0.iter().map(|b| i32::from_le_bytes([0, b[0], b[1], b[2]]) >> 8);
        for v in fixed.filter(|v| v.unsigned_abs() >= (1 << 23) - 1) {
            limits.note(|| format!("{v} of splat {i}"));
        }
    }
    if let Some(found) = limits.summary(3 * header.count) {
        let expected = "means within 24 bits (more fractionalBits than the scene has room for clip them)";
        findings.warning("SPZ_MEAN_RANGE", Location::File, expected, found);
    }
    let clipped = scales.iter().filter(|&&b| b == 255).count();
    if clipped > 0 {
        let found = format!("{clipped} of {} at the end", scales.len());
        findings.warning("SPZ_SCALE_RANGE", Location::File, "log-scales below 5.94, where they are clipped", found);
    }
    if header.count > 0 && opacities.iter().all(|&b| b == 0) {
        findings.warning("SPZ_OPACITY_RANGE", Location::File, "splats that can be seen", "opacity 0 throughout");
    }
    let (stored, tolerance) = match header.version {
        2 => (3, ROTATION_TOLERANCE[0]),
        _ => (4, ROTATION_TOLERANCE[1]),
    };
    let mut long = Offenders::default();
    for (i, rotation) in rotations.chunks_exact(stored).enumerate() {
        let norm = stored_norm(rotation);
        if norm > 1.0 + tolerance {
            long.note(|| format!("length {norm:.4} of splat {i}"));
        }
    }
    if let Some(found) = long.summary(header.count) {
        findings.error("SPZ_ROTATION_NORM", Location::File, "parts of a unit quaternion, no longer than 1", found);
    }
}

/// Norm of the stored part of a quaternion: x, y, z (three bytes), or the smallest three.
fn stored_norm(rotation: &[u8]) -> f64 {
    let squares: f64 = match *rotation {
        [x, y, z] => [x, y, z].iter().map(|&b| (f64::from(b) / 127.5 - 1.0).powi(2)).sum(),
        [a, b, c, d] => {
            let word = u32::from_le_bytes([a, b, c, d]);
            (0..3).map(|k| (f64::from(word >> (10 * k) & 511) / 511.0).powi(2) / 2.0).sum()
        }
        _ => 0.0,
    };
    squares.sqrt()
}

#[cfg(test)]
mod tests {
    use super::super::{Finding, Severity};
    use super::*;
    use crate::format::spz::container::{STREAMS, encode};
    use crate::format::spz::{Options, Version, write};
    use crate::format::test_scenes::random_splats;

    fn findings(bytes: &[u8]) -> Vec<Finding> {
        let mut findings = Findings::default();
        check(bytes, &mut findings);
        findings.0
    }

    fn written(version: Version) -> Vec<u8> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("s.spz");
        write(&path, &random_splats(50, 1, 1), &Options { version, ..Options::default() }).unwrap();
        std::fs::read(&path).unwrap()
    }

    #[test]
    fn what_we_write_is_faultless() {
        for version in [Version::V2, Version::V3, Version::V4] {
            assert_eq!(findings(&written(version)), []);
        }
    }

    #[test]
    fn each_rule() {
        type Streams = [Vec<u8>; STREAMS];
        let code = |version: Version, change: &dyn Fn(&mut Streams)| {
            let Packed { header, mut streams, .. } = decode(&written(version)).map_err(|_| ()).unwrap();
            change(&mut streams);
            let found = findings(&encode(&header, &streams).unwrap());
            assert_eq!(found.len(), 1, "{found:?}");
            found[0].code
        };
        assert_eq!(code(Version::V2, &|s| s[4][..3].fill(255)), "SPZ_ROTATION_NORM");
        assert_eq!(code(Version::V4, &|s| s[4][..4].fill(255)), "SPZ_ROTATION_NORM");
        assert_eq!(code(Version::V4, &|s| s[0][..3].copy_from_slice(&[0, 0, 128])), "SPZ_MEAN_RANGE");
        assert_eq!(code(Version::V4, &|s| s[3][7] = 255), "SPZ_SCALE_RANGE");
        assert_eq!(code(Version::V4, &|s| s[1].fill(0)), "SPZ_OPACITY_RANGE");
        let file = written(Version::V4);
        assert_eq!(findings(&file[..file.len() - 3])[0].code, "SPZ_CONTENT");
        assert_eq!(findings(b"NGSP")[0].code, "SPZ_CONTENT");
        let mut header = decode(&file).map_err(|_| ()).unwrap().header;
        header.fractional_bits = 30;
        let streams = decode(&file).map_err(|_| ()).unwrap().streams;
        assert_eq!(findings(&encode(&header, &streams).unwrap())[0].code, "SPZ_FRACTIONAL_BITS");
        (header.sh_degree, header.fractional_bits) = (4, 12);
        let mut wider = streams;
        wider[5] = vec![128; 50 * 72];
        assert_eq!(findings(&encode(&header, &wider).unwrap())[0].code, "SPZ_SH_DEGREE");
    }

    #[test]
    fn what_no_reader_looks_at_is_a_warning() {
        use std::io::{Read as _, Write as _};
        let only = |bytes: &[u8]| {
            let found = findings(bytes);
            assert_eq!((found.len(), found[0].severity), (1, Severity::Warning), "{found:?}");
            (found[0].code, found[0].found.clone())
        };
        for version in [Version::V2, Version::V3, Version::V4] {
            let mut file = written(version);
            file.extend([0; 7]);
            assert_eq!(only(&file), ("SPZ_LENGTH", "7".to_owned()), "{version:?}");
            let Packed { mut header, streams, .. } = decode(&written(version)).map_err(|_| ()).unwrap();
            header.flags = 0x1 | 0x80;
            assert_eq!(only(&encode(&header, &streams).unwrap()), ("SPZ_FLAGS", "0x81".to_owned()), "{version:?}");
            // An extension is optional.
            header.flags = 0x2;
            assert_eq!(findings(&encode(&header, &streams).unwrap()), []);
        }
        // Damage within the gzip content.
        let mut content = vec![];
        flate2::read::GzDecoder::new(written(Version::V3).as_slice()).read_to_end(&mut content).unwrap();
        content.extend([0; 5]);
        let mut gzip = flate2::write::GzEncoder::new(vec![], flate2::Compression::fast());
        gzip.write_all(&content).unwrap();
        assert_eq!(only(&gzip.finish().unwrap()), ("SPZ_LENGTH", "5".to_owned()));
        // A record of 8 bytes followed by a few more.
        content.truncate(content.len() - 5);
        content[14] = 0x2;
        content.extend([9, 0, 0, 0, 1, 0, 0, 0, 42, 1, 2, 3]);
        let mut gzip = flate2::write::GzEncoder::new(vec![], flate2::Compression::fast());
        gzip.write_all(&content).unwrap();
        let codes: Vec<_> = findings(&gzip.finish().unwrap()).into_iter().map(|f| (f.code, f.found)).collect();
        assert_eq!((codes[0].0, codes[1].0, codes[1].1.as_str()), ("SPZ_NOT_READ", "SPZ_LENGTH", "3"), "{codes:?}");
    }
}
