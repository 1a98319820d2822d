//! Format `.splat`: 32 bytes per splat without a header, as read by antimatter15's viewer.
//!
//! | bytes | content | largest error of [`write()`] |
//! |---|---|---|
//! | 0..12 | mean x, y, z, f32 | 0 |
//! | 12..24 | standard deviations (linear), f32 | rounding of f32 |
//! | 24..27 | red, green, blue of SH coefficient 0 in 255 steps | 1/510; values outside 0..1 are clipped |
//! | 27 | opacity in 255 steps | 1/510 |
//! | 28..32 | rotation w, x, y, z, a component c as 128 + 128·c | 1.1° |
//!
//! There are no further SH bands. The file cannot state its frame: as for PLY it is the scene's own, by convention y
//! down.

use std::io::{Read, Seek, SeekFrom, Write as _};
use std::path::Path;

use glam::{Quat, Vec3};

use super::blocks::{in_waves, read_in_blocks};
use super::error::{Fault, Location, open_file};
use super::loss::{Loss, SplatError, WriteReport};
use super::splat_record::{DROPPING, SplatRecord, color_bytes, dc_of_bytes, log_of_scale, logit_of_byte, opacity_byte};
use super::{FormatError, ReadOptions, SplatFile, activation, atomic_write_with};
use crate::scene::{SceneError, SplatArrays, Splats};

const BYTES: usize = 32;
/// Number of splats encoded as one task.
const ROWS: usize = 1 << 14;

/// Reads splats, and counts those left out, see [`ReadOptions::drop_invalid`]; the file says no more than splats.
/// Opacities of 0 and 1 and scales of 0 become the nearest finite parameters.
///
/// # Errors
/// If the file cannot be read, its length is not a multiple of 32, or it holds negative scales or values that
/// [`Splats::new`] rejects.
pub fn read(path: &Path, options: &ReadOptions<'_>) -> Result<SplatFile, FormatError> {
    parse(open_file(path)?, options.drop_invalid).map_err(|fault| fault.in_file(path))
}

/// Writes splats in their own order.
///
/// # Errors
/// If the file cannot be written.
pub fn write(path: &Path, splats: &Splats) -> Result<WriteReport, FormatError> {
    let mut loss = Loss::of_sh_degree(splats.sh_degree(), 0);
    let bytes = atomic_write_with(path, |out| {
        let encode_rows = |block: usize| {
            let (mut bytes, mut error) = (Vec::with_capacity(ROWS * BYTES), SplatError::default());
            for i in block * ROWS..splats.len().min((block + 1) * ROWS) {
                let splat = SplatRecord::of(splats, i);
                let row = encode(&splat);
                error.include(&splat, &decode(&row));
                bytes.extend(row);
            }
            (bytes, error)
        };
        in_waves(splats.len().div_ceil(ROWS), encode_rows, |(bytes, error)| {
            loss.max_error = loss.max_error.max(error);
            out.write_all(&bytes)
        })
    })?;
    Ok(WriteReport { bytes, loss, ..WriteReport::default() })
}

fn parse(mut file: impl Read + Seek + Send, drop_invalid: bool) -> Result<SplatFile, Fault> {
    let length = file.seek(SeekFrom::End(0)).and_then(|length| file.rewind().map(|()| length));
    let length = length.map_err(|e| Fault::unreadable(0, &e))? as usize;
    let count = length / BYTES;
    if !length.is_multiple_of(BYTES) {
        let found = format!("{} bytes after splat {count}", length % BYTES);
        return Err(Fault::byte(count * BYTES, format!("{BYTES} bytes per splat"), found));
    }
    let mut arrays = SplatArrays::with_capacity(count, 0);
    let mut dropped = 0;
    read_in_blocks(&mut file, 0, (count, BYTES), |_, rows| {
        // Rows always have the requested length.
        let splat = |row: &[u8]| decode(row.first_chunk().unwrap_or(&[0; BYTES]));
        if drop_invalid {
            dropped += rows.filter(|row| !arrays.push_valid(&splat(row))).count();
        } else {
            let rows: Vec<&[u8]> = rows.collect();
            arrays.extend(rows.len(), |i| splat(rows[i]));
        }
    })?;
    let splats = arrays.check().map_err(|e| invalid(&mut file, e))?;
    Ok(SplatFile { dropped: Some(dropped), ..SplatFile::of(splats) })
}

/// What is wrong with a splat that no scene holds, as it is stored.
fn invalid(file: &mut (impl Read + Seek), error: SceneError) -> Fault {
    const NAMES: [&str; 6] = ["x", "y", "z", "scale_0", "scale_1", "scale_2"];
    let fault = Fault::from(error);
    let Some((_, i)) = fault.element() else { return fault };
    let (offset, mut row) = ((i * BYTES) as u64, [0u8; BYTES]);
    let at = Location::Byte(offset);
    let read = file.seek(SeekFrom::Start(offset)).and_then(|_| file.read_exact(&mut row));
    let (words, _) = row.as_chunks::<4>();
    let values = NAMES.into_iter().zip(words.iter().map(|word| f32::from_le_bytes(*word)));
    let of = |(name, value): (&str, f32)| format!("{value} as {name} of splat {i}");
    let fault = if let Some(value) = values.clone().find(|(_, value)| !value.is_finite()) {
        Fault::at(at, "finite numbers", of(value))
    } else if let Some(value) = values.skip(3).find(|(_, scale)| *scale < 0.0) {
        Fault::at(at, "scales of at least 0", of(value))
    } else {
        fault.of_element(|_| at)
    };
    // What was read before can be read again, as a rule.
    if read.is_ok() { fault.with_advice(DROPPING) } else { fault }
}

fn encode(splat: &SplatRecord) -> [u8; BYTES] {
    let mut row = [0; BYTES];
    let scales = splat.log_scale.to_array().map(activation::scale);
    for (place, value) in row.as_chunks_mut::<4>().0.iter_mut().zip(splat.mean.to_array().into_iter().chain(scales)) {
        *place = value.to_le_bytes();
    }
    row[24..27].copy_from_slice(&color_bytes(splat.sh[0]));
    row[27] = opacity_byte(splat.opacity_logit);
    let q = splat.rotation;
    // A cast to u8 saturates: a component of exactly 1 would be 256.
    row[28..].copy_from_slice(&[q.w, q.x, q.y, q.z].map(|c| (128.0 + 128.0 * c).round() as u8));
    row
}

fn decode(row: &[u8; BYTES]) -> SplatRecord {
    let (words, _) = row.as_chunks::<4>();
    let float = |k: usize| f32::from_le_bytes(words[k]);
    let [w, x, y, z] = words[7].map(|b| f32::from(b) / 128.0 - 1.0);
    let [red, green, blue, alpha] = words[6];
    let mut sh = [[0.0; 3]; 16];
    sh[0] = dc_of_bytes([red, green, blue]);
    SplatRecord {
        mean: Vec3::new(float(0), float(1), float(2)),
        rotation: Quat::from_xyzw(x, y, z, w),
        log_scale: Vec3::from([3, 4, 5].map(|k| log_of_scale(float(k)))),
        opacity_logit: logit_of_byte(alpha),
        sh_degree: 0,
        sh,
    }
}

#[cfg(test)]
mod tests {
    use std::io::Cursor;

    use proptest::prelude::*;

    use super::*;
    use crate::format::test_scenes::{assert_same_loss, random_splats, saturated_splats};

    fn parse(bytes: &[u8]) -> Result<Splats, Fault> {
        super::parse(Cursor::new(bytes), false).map(|file| file.splats)
    }

    fn written(splats: &Splats) -> (Vec<u8>, WriteReport) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("s.splat");
        let report = write(&path, splats).unwrap();
        (std::fs::read(path).unwrap(), report)
    }

    #[test]
    fn round_trip_stays_within_the_stated_errors() {
        let splats = random_splats(5000, 3, 1);
        let (bytes, report) = written(&splats);
        assert_eq!((bytes.len() as u64, bytes.len()), (report.bytes, 5000 * BYTES));
        let back = parse(&bytes).unwrap();
        assert_same_loss(&report.loss, &Loss::of_splats(&splats, &back));
        assert_eq!(report.loss.sh_degree, Some([3, 0]));
        let e = report.loss.max_error;
        assert_eq!((e.mean, e.sh), (0.0, 0.0));
        // exp and ln in f64, with rounding to f32 between them: 6e-8 of the scale, and 5e-7 for a logarithm near 9.
        assert!(e.log_scale < 1e-6, "{e:?}");
        assert!(e.opacity <= 1.0 / 510.0 + 1e-6 && e.opacity > 0.0015, "{e:?}");
        assert!(e.rotation < 1.1 && e.rotation > 0.3, "{e:?}");
        // Coefficients up to ±2 exceed 0..1 by 0.064.
        assert!((0.05..0.066).contains(&e.color), "{e:?}");
    }

    #[test]
    fn layout() {
        let splats = random_splats(2, 0, 4);
        let (bytes, _) = written(&splats);
        assert_eq!(bytes[..4], splats.means()[0].x.to_le_bytes());
        assert_eq!(bytes[32 + 12..32 + 16], activation::scale(splats.log_scales()[1].x).to_le_bytes());
        let q = splats.rotations()[0];
        assert_eq!(bytes[28], (128.0 + 128.0 * q.w).round() as u8);
        assert_eq!(bytes[31], (128.0 + 128.0 * q.z).round() as u8);
    }

    #[test]
    fn extremes_survive() {
        let splats = saturated_splats();
        let (bytes, report) = written(&splats);
        assert_eq!(parse(&bytes).unwrap().len(), splats.len());
        assert!(report.loss.max_error.opacity < 1e-6, "{:?}", report.loss);
        assert_eq!(parse(&[]).unwrap(), Splats::empty(0));
    }

    #[test]
    fn messages_name_place_expected_and_found() {
        let (mut bytes, _) = written(&random_splats(2, 0, 4));
        bytes[32..36].copy_from_slice(&f32::NAN.to_le_bytes());
        let message = |bytes: &[u8]| parse(bytes).unwrap_err().in_file(Path::new("a.splat")).to_string();
        let advice = "; `centaur convert --drop-invalid` leaves such splats out";
        let nan = "a.splat: byte 32: expected finite numbers, found NaN as x of splat 1";
        assert_eq!(message(&bytes), format!("{nan}{advice}"));
        assert_eq!(
            message(&bytes[..63]),
            "a.splat: byte 32: expected 32 bytes per splat, found 31 bytes after splat 1"
        );
        bytes[32..36].fill(0);
        bytes[52..56].copy_from_slice(&(-0.5_f32).to_le_bytes());
        let negative = "a.splat: byte 32: expected scales of at least 0, found -0.5 as scale_2 of splat 1";
        assert_eq!(message(&bytes), format!("{negative}{advice}"));
        let left = super::parse(Cursor::new(&bytes), true).unwrap();
        assert_eq!((left.splats.len(), left.dropped), (1, Some(1)), "a negative scale");
        bytes[28..32].fill(128);
        bytes[52..56].fill(0);
        assert!(message(&bytes).contains("byte 0: expected a non-zero quaternion"), "{}", message(&bytes));
    }

    proptest! {
        #[test]
        fn any_bytes_do_not_panic(bytes in proptest::collection::vec(any::<u8>(), 0..400)) {
            let whole = bytes.len() / BYTES * BYTES;
            if let Ok(splats) = parse(&bytes[..whole]) {
                prop_assert_eq!(splats.len(), whole / BYTES);
            }
        }
    }
}
