// Sums in fixed point: integers come to the same whatever the order of their terms, which is another one in every run.
// The view's largest gradient of a fragment is FIXED_ONE units: 2,047 terms of that size fit, and what is 2⁻²¹ of it or
// less is lost. Of a texel's base a term is at most 0.29 of it, so that 7,000 pixels that pull alike and as hard as the
// one that pulls most fit. A texel of the bands, which are a quarter as wide, has 16 times the pixels: its terms are in
// units that are 8 times as large. Where more pixels see one texel than that leaves room for, before a wall in a coarse
// map or where all corners of triangles have one place there, units are larger by as much (`map_peak`). A vertex may
// have half of the picture on its triangles, of a wall that is far off and pulls one way: its sums have 64 bits, in two
// words, the low one first, and hold 2⁴³ terms of any size.
// FIXED_ONE, BAND_UNIT, CROWD and BAND_CROWD come from the host (`FIXED_POINT` in src/render/gpu/shader.rs).

// Words of `peaks`, written by `gradient_peak`: 0, bits of the largest gradient of a fragment by its map; 1, by its
// vertices; 2, as 0, each times the ratio of its texel's pixels to those that there is room for; 3, the number of
// crowded fragments. FIXED_ONE units of the maps are the largest gradient, or more where crowded fragments see one
// texel: as many as each implies for its own, but no more than there are. Returns bits.
fn map_peak(largest: u32, largest_crowded: u32, n_crowded: u32) -> u32 {
    let of_all = bitcast<u32>(bitcast<f32>(largest) * (f32(n_crowded) / CROWD));
    return max(largest, min(largest_crowded, of_all));
}

// Units per 1, from the bits of the largest term.
fn fixed_scale(peak: u32) -> f32 {
    let largest = bitcast<f32>(peak);
    return select(FIXED_ONE / largest, 0.0, largest < 1e-30);
}

// A 64-bit sum as a float. Converted by magnitude: for a small negative sum both words are large and would cancel.
fn wide_sum(low: u32, high: u32) -> f32 {
    if (high >> 31u) == 0u { return 4294967296.0 * f32(high) + f32(low); }
    let below = ~low + 1u;
    return -(4294967296.0 * f32(~high + u32(below == 0u)) + f32(below));
}

// Value of a unit; not finite if the largest term was not.
fn fixed_unit(peak: u32) -> f32 {
    return bitcast<f32>(peak) / FIXED_ONE;
}
