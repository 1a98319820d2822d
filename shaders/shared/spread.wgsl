// Sums over the lanes of a subgroup in `blend_backward`. $EXCHANGE(value, apart) is the value of the lane whose number
// is this one's with the bit `apart` flipped: subgroupShuffleXor, except in tests (tests/spread.wgsl).

// Sums over a subgroup of at least 8 lanes, for two splats. At every step a lane keeps half of its partial sums, and
// exchanges the other half for its neighbour's partial sums of the half that it keeps: in the end each of 32 lanes has
// one sum, after 21 exchanges in five steps, whereas 20 separate sums take five exchanges each. With fewer lanes, each
// has up to three sums; `places` says which.
fn spread(a: array<f32, SUMS>, b: array<f32, SUMS>, lane: u32, lanes: u32) -> vec3f {
    let is_upper = (vec4u(lane) & vec4u(1u, 2u, 4u, 8u)) != vec4u(0u);
    var of_splat: array<f32, SUMS>;
//#for c in 0..SUMS
    of_splat[$c] = select(a[$c], b[$c], is_upper.x) + $EXCHANGE(select(b[$c], a[$c], is_upper.x), 1u);
//#end
//#for c in 0..HALF
    let h$c = select(of_splat[$c], of_splat[$c + HALF], is_upper.y)
        + $EXCHANGE(select(of_splat[$c + HALF], of_splat[$c], is_upper.y), 2u);
//#end
    // The middle one of five has no counterpart to exchange for.
//#if ABSOLUTE
    let q2 = select(h2, h5, is_upper.z) + $EXCHANGE(select(h5, h2, is_upper.z), 4u);
//#else
    let q2 = h2 + $EXCHANGE(h2, 4u);
//#end
    let q0 = select(h0, h3, is_upper.z) + $EXCHANGE(select(h3, h0, is_upper.z), 4u);
    let q1 = select(h1, h4, is_upper.z) + $EXCHANGE(select(h4, h1, is_upper.z), 4u);
    if lanes < 16u { return vec3f(q0, q1, q2); }
    let e0 = select(q0, q2, is_upper.w) + $EXCHANGE(select(q2, q0, is_upper.w), 8u);
    let e1 = q1 + $EXCHANGE(q1, 8u);
    if lanes < 32u { return vec3f(e0, e1, 0.0); }
    let last = (lane & 16u) != 0u;
    var sum = select(e0, e1, last) + $EXCHANGE(select(e1, e0, last), 16u);
    for (var apart = 32u; apart < lanes; apart *= 2u) { sum += $EXCHANGE(sum, apart); }
    return vec3f(sum, 0.0, 0.0);
}

// Which of 2·SUMS sums a lane of `spread` holds, those of the first splat first; 2·SUMS for none.
fn places(lane: u32, lanes: u32) -> vec3u {
    const NONE: u32 = 2u * SUMS;
    let bit = (vec4u(lane) >> vec4u(0u, 1u, 2u, 3u)) & vec4u(1u);
    let of_splat = SUMS * bit.x + HALF * bit.y;
    // Of HALF sums, the first three or the rest.
    var place = vec3u(0u, 1u, 2u) + 3u * bit.z;
    if lanes >= 16u { place = vec3u(place.x + 2u * bit.w, select(NONE, place.y, bit.w == 0u), NONE); }
    if lanes >= 32u { place = vec3u(select(place.x, place.y, (lane & 16u) != 0u), NONE, NONE); }
    let inside = (place < vec3u(HALF)) & (vec3u(lane) < vec3u(32u));
    return select(vec3u(NONE), of_splat + place, inside);
}
