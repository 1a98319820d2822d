// Whether floats are neither NaN nor infinite.
//
// Tested by bits, as a compiler may assume that no float is either. The sign is shifted out and the rest compared: LLVM
// (from version 22 on) takes `(bits & 0x7f800000) == 0x7f800000` for a question about the float, and answers it from
// that assumption.

const TWICE_INFINITY: u32 = 0xff000000u;    // the bits of infinity, shifted

fn is_finite(v: f32) -> bool {
    return (bitcast<u32>(v) << 1u) < TWICE_INFINITY;
}

fn are_finite(v: vec4f) -> bool {
    return all((bitcast<vec4u>(v) << vec4u(1u)) < vec4u(TWICE_INFINITY));
}
