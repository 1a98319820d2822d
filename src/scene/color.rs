//! Encoding of colour values in pictures: sRGB (IEC 61966-2-1), in 8 bits. Negative values, which only unclamped
//! renders have, stay on the linear segment of the transfer function.

/// Linear light from an encoded value.
#[must_use]
pub fn srgb_to_linear(c: f32) -> f32 {
    if c <= 0.040_45 { c / 12.92 } else { ((c + 0.055) / 1.055).powf(2.4) }
}

/// Encoded value from linear light.
#[must_use]
pub fn linear_to_srgb(c: f32) -> f32 {
    if c <= 0.003_130_8 { c * 12.92 } else { 1.055 * c.powf(1.0 / 2.4) - 0.055 }
}

/// 8-bit value: clamped to \[0, 1\] and rounded to the nearest k/255; NaN becomes 0.
#[must_use]
pub fn to_byte(value: f32) -> u8 {
    (value.clamp(0.0, 1.0) * 255.0 + 0.5) as u8
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn transfer_functions_are_inverse() {
        for c in [0.0_f32, 0.01, 0.5, 1.0] {
            assert!((srgb_to_linear(linear_to_srgb(c)) - c).abs() < 1e-6);
        }
    }
}
