//! Real spherical harmonics in the sign convention of INRIA 3DGS (`utils/sh_utils.py`) and `KHR_gaussian_splatting`.

mod rotation;

pub use rotation::Rotation;

/// Highest supported degree.
pub const MAX_DEGREE: u32 = 3;

/// Y₀: 1/(2√π).
pub const C0: f64 = 0.282_094_791_773_878_14;

/// Number of coefficients per colour channel of a degree: (d+1)². Also defined for degrees beyond [`MAX_DEGREE`], as
/// files may claim; saturates.
#[must_use]
pub const fn coefficients(degree: u32) -> usize {
    let terms = (degree as usize).saturating_add(1);
    terms.saturating_mul(terms)
}

/// Floats of the coefficients above the zeroth in three channels: 3·((d+1)²−1), with 0, 9, 24 and 45 for the degrees up
/// to [`MAX_DEGREE`]. Where the number has no room, the largest there is.
#[must_use]
pub const fn band_floats(degree: u32) -> usize {
    (coefficients(degree) - 1).saturating_mul(3)
}

/// Inverse of [`band_floats`], of degrees up to `largest`.
#[must_use]
pub fn degree_of_band_floats(floats: usize, largest: u32) -> Option<u32> {
    (0..=largest).find(|&degree| band_floats(degree) == floats)
}

/// The 16 basis functions at unit direction `d`, ordered by band and then by m = −l..l.
#[must_use]
pub fn basis(d: [f64; 3]) -> [f64; 16] {
    const C1: f64 = 0.488_602_511_902_919_9;
    let [x, y, z] = d;
    let (xx, yy, zz) = (x * x, y * y, z * z);
    [
        C0,
        -C1 * y,
        C1 * z,
        -C1 * x,
        1.092_548_430_592_079_2 * x * y,
        -1.092_548_430_592_079_2 * y * z,
        0.315_391_565_252_520_05 * (2.0 * zz - xx - yy),
        -1.092_548_430_592_079_2 * x * z,
        0.546_274_215_296_039_6 * (xx - yy),
        -0.590_043_589_926_643_5 * y * (3.0 * xx - yy),
        2.890_611_442_640_554 * x * y * z,
        -0.457_045_799_464_465_8 * y * (4.0 * zz - xx - yy),
        0.373_176_332_590_115_4 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
        -0.457_045_799_464_465_8 * x * (4.0 * zz - xx - yy),
        1.445_305_721_320_277 * z * (xx - yy),
        -0.590_043_589_926_643_5 * x * (xx - 3.0 * yy),
    ]
}

/// Zeroth coefficient whose colour is `rgb` from every side: `(rgb − 0.5)/C0`.
#[must_use]
pub fn dc_from_rgb(rgb: [f32; 3]) -> [f32; 3] {
    rgb.map(|c| (f64::from(c - 0.5) / C0) as f32)
}

/// Colour of a zeroth coefficient alone, not clamped: `0.5 + C0·dc`.
#[must_use]
pub fn rgb_from_dc(dc: [f32; 3]) -> [f32; 3] {
    dc.map(|c| (0.5 + C0 * f64::from(c)) as f32)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bands_tell_their_degree() {
        assert_eq!([0, 1, 2, 3, 4].map(band_floats), [0, 9, 24, 45, 72]);
        assert_eq!([0, 9, 45, 72].map(|n| degree_of_band_floats(n, MAX_DEGREE)), [Some(0), Some(1), Some(3), None]);
        assert_eq!([72, 10].map(|n| degree_of_band_floats(n, MAX_DEGREE + 1)), [Some(4), None]);
        assert_eq!(band_floats(u32::MAX), usize::MAX);
    }
}
