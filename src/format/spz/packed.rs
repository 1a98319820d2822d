//! Coding of one splat in the streams of SPZ, in the file's own frame.

use glam::{Quat, Vec3};

use super::container::{Header, STREAMS};
use crate::format::splat_record::{SplatRecord, largest_component, logit_of_byte, opacity_byte};
use crate::scene::sh;

/// Factor of SH coefficient 0: covers more than the display's range, for colours that the higher bands bring back into
/// it.
const COLOR_SCALE: f32 = 0.15;

/// Largest magnitude of a 24-bit mean.
const MEAN_LIMIT: f64 = 8_388_607.0;

/// Number of fractional bits: 12 as in the format's own library, more for small scenes (a step is at most 2⁻¹⁶ of the
/// greatest coordinate), fewer if values would not fit.
pub(super) fn fractional_bits(means: &[Vec3]) -> u8 {
    let greatest = f64::from(means.iter().map(|m| m.abs().max_element()).fold(0.0, f32::max));
    if greatest == 0.0 {
        return 12;
    }
    let fitting = (MEAN_LIMIT / greatest).log2().floor();
    let wanted = (16.0 - greatest.log2().ceil()).max(12.0);
    // Between 0 and 24.
    wanted.min(fitting).clamp(0.0, 24.0) as u8
}

/// Decodes splat `i` of streams that hold at least `i + 1`.
pub(super) fn decode(header: &Header, streams: [&[u8]; STREAMS], i: usize) -> SplatRecord {
    let [means, opacities, colors, scales, rotations, bands] = streams;
    let three = |stream: &[u8]| [stream[3 * i], stream[3 * i + 1], stream[3 * i + 2]];
    let step = (-f64::from(header.fractional_bits)).exp2();
    let mean = [0, 1, 2].map(|axis| {
        let at = 9 * i + 3 * axis;
        // The highest byte carries the sign.
        let fixed = i32::from_le_bytes([0, means[at], means[at + 1], means[at + 2]]) >> 8;
        (f64::from(fixed) * step) as f32
    });
    let mut sh = [[0.0; 3]; 16];
    sh[0] = three(colors).map(|c| (f32::from(c) / 255.0 - 0.5) / COLOR_SCALE);
    let stride = header.band_bytes();
    let sh_degree = header.sh_degree.min(sh::MAX_DEGREE);
    let own = &bands[i * stride..(i + 1) * stride];
    for (coefficient, bytes) in sh[1..sh::coefficients(sh_degree)].iter_mut().zip(own.as_chunks::<3>().0) {
        *coefficient = bytes.map(|b| f32::from(b) / 128.0 - 1.0);
    }
    SplatRecord {
        mean: Vec3::from(mean),
        rotation: match header.version {
            2 => decode_first_three(three(rotations)),
            _ => decode_smallest_three([0, 1, 2, 3].map(|k| rotations[4 * i + k])),
        },
        log_scale: Vec3::from(three(scales).map(|b| f32::from(b) / 16.0 - 10.0)),
        opacity_logit: logit_of_byte(opacities[i]),
        sh_degree,
        sh,
    }
}

/// Appends a splat to the streams; `sh_bits` as in [`super::Options`].
pub(super) fn encode(header: &Header, sh_bits: [u32; 2], splat: &SplatRecord, streams: &mut [Vec<u8>; STREAMS]) {
    let [means, opacities, colors, scales, rotations, bands] = streams;
    for v in splat.mean.to_array() {
        let fixed = (f64::from(v) * f64::from(header.fractional_bits).exp2()).round().clamp(-MEAN_LIMIT, MEAN_LIMIT);
        means.extend_from_slice(&(fixed as i32).to_le_bytes()[..3]);
    }
    // Casts of floats to u8 saturate.
    opacities.push(opacity_byte(splat.opacity_logit));
    colors.extend(splat.sh[0].map(|c| (255.0 * (COLOR_SCALE * c + 0.5)).round() as u8));
    scales.extend(splat.log_scale.to_array().map(|s| (16.0 * (s + 10.0)).round() as u8));
    match header.version {
        2 => rotations.extend(encode_first_three(splat.rotation)),
        _ => rotations.extend(encode_smallest_three(splat.rotation)),
    }
    for (k, coefficient) in splat.sh().iter().enumerate().skip(1) {
        let step = 1 << (8 - if k < 4 { sh_bits[0] } else { sh_bits[1] });
        bands.extend(coefficient.map(|c| coefficient_byte(c, step)));
    }
}

/// Byte of a coefficient: the multiple of `step` nearest to 128·(c + 1). 128, which represents 0, is such a multiple.
fn coefficient_byte(c: f32, step: u32) -> u8 {
    let step = step as f32;
    // A cast of a float to u8 saturates.
    ((128.0 * (c + 1.0) / step).round() * step) as u8
}

fn encode_first_three(q: Quat) -> [u8; 3] {
    let sign = if q.w < 0.0 { -1.0 } else { 1.0 };
    [q.x, q.y, q.z].map(|c| (127.5 * (sign * c + 1.0)).round() as u8)
}

fn decode_first_three(bytes: [u8; 3]) -> Quat {
    let [x, y, z] = bytes.map(|b| f32::from(b) / 127.5 - 1.0);
    Quat::from_xyzw(x, y, z, (1.0 - x * x - y * y - z * z).max(0.0).sqrt())
}

/// Encodes a rotation, from the top: 2 bits for the index of the largest component, then for each of the others, in
/// order, a sign and 9 bits of magnitude, whose maximum represents √½.
fn encode_smallest_three(q: Quat) -> [u8; 4] {
    let q = q.to_array();
    let largest = largest_component(q);
    let others = (0..4).filter(|&i| i != largest).map(|i| {
        // The largest component is made positive, so its sign need not be stored.
        let negative = (q[i] < 0.0) != (q[largest] < 0.0);
        let magnitude = (511.0 * std::f32::consts::SQRT_2 * q[i].abs()).round().min(511.0);
        u32::from(negative) << 9 | magnitude as u32
    });
    others.fold(largest as u32, |word, part| word << 10 | part).to_le_bytes()
}

fn decode_smallest_three(bytes: [u8; 4]) -> Quat {
    let mut word = u32::from_le_bytes(bytes);
    let largest = (word >> 30) as usize;
    let (mut q, mut sum) = ([0.0f32; 4], 0.0);
    for i in (0..4).rev().filter(|&i| i != largest) {
        let magnitude = (word & 511) as f32 / 511.0 * std::f32::consts::FRAC_1_SQRT_2;
        q[i] = if word >> 9 & 1 == 1 { -magnitude } else { magnitude };
        sum += q[i] * q[i];
        word >>= 10;
    }
    q[largest] = (1.0 - sum).max(0.0).sqrt();
    Quat::from_array(q)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bits_follow_the_size_of_the_scene() {
        let bits = |x: f32| fractional_bits(&[Vec3::ZERO, Vec3::new(0.0, -x, 0.0)]);
        assert_eq!([0.0, 16.0, 2047.0, 3.0, 1e-9].map(bits), [12, 12, 12, 14, 24]);
        assert_eq!([2049.0, 1e6, 1e9, f32::MAX].map(bits), [11, 3, 0, 0]);
    }

    #[test]
    fn rotations_of_any_largest_component_and_sign() {
        for i in 0..4 {
            for sign in [-1.0, 1.0] {
                let mut c = [0.1, -0.2, 0.3, -0.25];
                c[i] = 0.9 * sign;
                let q = Quat::from_array(c).normalize();
                assert!(q.dot(decode_smallest_three(encode_smallest_three(q))).abs() > 0.999_99, "{q}");
                assert!(q.dot(decode_first_three(encode_first_three(q)).normalize()).abs() > 0.9998, "{q}");
            }
        }
        assert_eq!(encode_smallest_three(Quat::IDENTITY), [0, 0, 0, 0xc0]);
        // In damaged words the squares of the components can add up to more than 1.
        assert!(decode_smallest_three([0xff; 4]).is_finite() && decode_first_three([0; 3]).is_finite());
    }

    #[test]
    fn coefficients_are_multiples_of_a_step() {
        assert_eq!([0.0, 1.0, -1.0, 9.0, -1e30].map(|c| coefficient_byte(c, 8)), [128, 255, 0, 255, 0]);
        assert_eq!([0.03, 0.04, -0.03, -0.04].map(|c| coefficient_byte(c, 8)), [128, 128 + 8, 128, 128 - 8]);
        assert_eq!([0.05, -0.3].map(|c| coefficient_byte(c, 1)), [134, 90]);
    }
}
