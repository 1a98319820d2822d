// One texture of one mesh, as used by the kernels that run over its texels: a mip pyramid in a buffer of floats.

struct Map {
    offset: u32,        // of level 0, floats
    width: u32,         // of level 0, texels
    height: u32,
    levels: u32,
    channels: u32,      // floats per texel
    moments: u32,       // of level 0 in the buffer of moments, pairs
    level: u32,         // level that the kernel writes
    is_base: u32,       // 1: DC and opacity, 0: bands
}

// Offset of a level. Every level has exactly a quarter of the size of the one before: a geometric series.
fn level_offset(map: Map, level: u32) -> u32 {
    let texels = map.width * map.height - (map.width >> level) * (map.height >> level);
    return map.offset + texels / 3u * 4u * map.channels;
}

// Quotient and remainder, for i < 2³¹ and d ≤ 2¹⁴. CPUs have no integer vector division: `/` made up most of the time
// of these kernels there. The first quotient is off by at most i/d · 2⁻²¹ plus rounding, the second by one.
fn divide(i: u32, d: u32) -> vec2u {
    let inverse = 1.0 / f32(d);
    var quotient = i32(f32(i) * inverse);
    var rest = i32(i) - quotient * i32(d);
    let correction = i32(floor(f32(rest) * inverse));
    quotient += correction;
    rest -= correction * i32(d);
    let step = select(0, 1, rest >= i32(d)) - select(0, 1, rest < 0);
    return vec2u(u32(quotient + step), u32(rest - step * i32(d)));
}
