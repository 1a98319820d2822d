// One thread per channel of 2×2 texels of level 0: a step of Adam, and the mean of the four, which is the float of
// level 1; build_mips does the levels beyond. A map without mips has one thread per float.
//
// The gradient of a texel is its own plus a quarter of its parent's, recursively up to the coarsest level. Per float of
// level 0 17 bytes read, 13 written: bound by bandwidth. Texels that no view has seen, or hardly any, have neither
// gradient nor moments and stay as they are.
//
// `visited_only`: floats without a gradient keep their value and moments, for 5 bytes read. Steps are counted for all
// texels together, which says little about how often one was seen; instead of a bias correction of the moments, a step
// is limited to the rate. (By dense Adam, a texel seen for the first time late in a run moves by Σ 0.9ᵏ · 0.1/√0.001 =
// 31 times the rate.)

//#import shared/view.wgsl
//#import shared/map.wgsl
//#import shared/adam.wgsl with FLOATS=f32
//#import shared/status.wgsl
//#import shared/fixed_point.wgsl

struct Step {
    base_rate: f32,
    band_rate: f32,
    correction_1: f32,      // 1 − β₁ᵗ
    correction_2: f32,      // 1 − β₂ᵗ
    visited_only: u32,      // see above
    holds_opacity: u32,     // leave opacity logits and their moments alone
}

const MAX_LOGIT: f32 = 6.0; // keeps σ' alive, so that wrong opaque surface can still fade

@group(0) @binding(0) var<uniform> map: Map;
@group(0) @binding(1) var<uniform> step: Step;
@group(0) @binding(2) var<storage, read> gradient: array<i32>;          // pyramid, in fixed point's unit
@group(0) @binding(3) var<storage, read_write> texels: array<f32>;      // pyramid; levels 0 and 1 are written
@group(0) @binding(4) var<storage, read_write> moments: array<vec2f>;   // level 0 only: first, second
@group(0) @binding(5) var<storage, read_write> status: Status;
@group(0) @binding(6) var<storage, read> peaks: array<u32>;             // see fixed_point.wgsl

// Gradient of a channel of the level-1 texel in this row and column, with a quarter of its parent's, coarsest first.
fn with_parents(at: vec2u, channel: u32) -> f32 {
    var sum = 0.0;
    for (var level = map.levels - 1u; level >= 1u; level -= 1u) {
        let place = at >> vec2u(level - 1u);
        let own = level_offset(map, level) + (place.x * (map.width >> level) + place.y) * map.channels + channel;
        sum = f32(gradient[own]) + 0.25 * sum;
    }
    return sum;
}

@compute @workgroup_size(256)
fn adam(
    @builtin(workgroup_id) group: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let i = group_index(group) * 256u + thread;
    let level = min(map.levels - 1u, 1u);
    let width = map.width >> level;
    if i >= width * (map.height >> level) * map.channels || status.is_short != 0u { return; }
    let texel = divide(i, map.channels);        // index, channel
    let at = divide(texel.x, width);            // row, column
    let is_opacity = map.is_base != 0u && texel.y == 3u;
    var inherited = 0.0;
    if level == 1u { inherited = 0.25 * with_parents(at, texel.y); }
    let unit = fixed_unit(map_peak(peaks[0], peaks[2], peaks[3])) * select(BAND_UNIT, 1.0, map.is_base != 0u);
    // Everything is read before anything is written: rows are a power of two apart, and CPUs wait for a store that
    // shares the low bits of a load's address. Without mips the first of the four floats is all there is.
    let stride = vec2u(map.channels, map.width * map.channels);
    let first = dot(at.yx * (level + 1u), stride) + texel.y;
    //#for k in 0..4
    let i$k = first + dot(vec2u($ku & 1u, $ku >> 1u), stride);
    let exists$k = $ku == 0u || level == 1u;
    var g$k = 0.0;
    if exists$k { g$k = unit * (f32(gradient[map.offset + i$k]) + inherited); }
    //#end
    let sparse = step.visited_only != 0u;
    if sparse && all(vec4f(g0, g1, g2, g3) == vec4f()) { return; }
    //#for k in 0..4
    var old$k = vec2f();
    var value$k = 0.0;
    if exists$k {
        old$k = moments[map.moments + i$k];
        value$k = texels[map.offset + i$k];
    }
    //#end
    let rate = select(step.band_rate, step.base_rate, map.is_base != 0u);
    let scale = select(vec2f(step.correction_1, step.correction_2), vec2f(1.0), sparse);
    let longest = select(3e38, 1.0, sparse);
    let held = is_opacity && step.holds_opacity != 0u;
    var sum = 0.0;
    var finite = true;
    //#for k in 0..4
    {
        let m = mixed_moments(g$k, Moments(old$k.x, old$k.y));
        var value = value$k - rate * clamp(adam_step(m, 1.0, scale.x, scale.y), -longest, longest);
        if is_opacity && is_finite(value) {
            value = clamp(value, -MAX_LOGIT, MAX_LOGIT);
        }
        let stays = held || !exists$k || (g$k == 0.0 && (sparse || all(old$k == vec2f(0.0))));
        if !stays {
            moments[map.moments + i$k] = vec2f(m.first, m.second);
            texels[map.offset + i$k] = value;
            finite = finite && is_finite(value) && is_finite(m.first) && is_finite(m.second);
        }
        sum += select(value, value$k, stays);
    }
    //#end
    if level == 1u { texels[level_offset(map, 1u) + i] = 0.25 * sum; }
    if !finite {
        atomicOr(&status.not_finite, select(NOT_FINITE_BANDS, NOT_FINITE_BASE, map.is_base != 0u));
    }
}
