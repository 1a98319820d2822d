// Whether floats are neither NaN nor infinite.

const EXPONENT: u32 = 0x7f800000u;

// Tested by bits, as a compiler may assume that no float is NaN.
fn is_finite(v: f32) -> bool {
    return (bitcast<u32>(v) & EXPONENT) != EXPONENT;
}

fn are_finite(v: vec4f) -> bool {
    return all((bitcast<vec4u>(v) & vec4u(EXPONENT)) != vec4u(EXPONENT));
}
