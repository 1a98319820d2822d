// One thread per float of level 0: a step of Adam (β 0.9, 0.999; ε 1e-15 outside the root: METHODS 2.7).
//
// The gradient of a texel is its own plus a quarter of its parent's, which pull_mips has completed. 20 bytes read, 12
// written: bound by bandwidth.

//#import shared/view.wgsl
//#import shared/map.wgsl
//#import shared/adam.wgsl
//#import shared/status.wgsl

struct Step {
    base_rate: f32,
    band_rate: f32,
    correction_1: f32,      // 1 − β₁ᵗ
    correction_2: f32,      // 1 − β₂ᵗ
    visited_only: u32,      // leave floats without gradient and their moments alone
    holds_opacity: u32,     // leave opacity logits and their moments alone
}

const MAX_LOGIT: f32 = 6.0; // keeps σ' alive, so that wrong opaque surface can still fade (METHODS 6)

@group(0) @binding(0) var<uniform> map: Map;
@group(0) @binding(1) var<uniform> step: Step;
@group(0) @binding(2) var<storage, read> gradient: array<f32>;          // pyramid
@group(0) @binding(3) var<storage, read_write> texels: array<f32>;      // pyramid; level 0 is written
@group(0) @binding(4) var<storage, read_write> moments: array<vec2f>;   // level 0 only: first, second
@group(0) @binding(5) var<storage, read_write> status: Status;

@compute @workgroup_size(256)
fn adam(
    @builtin(workgroup_id) group: vec3u,
    @builtin(num_workgroups) n_groups: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let i = group_index(group, n_groups) * 256u + thread;
    if i >= map.width * map.height * map.channels || status.is_short != 0u { return; }
    let is_opacity = map.is_base != 0u && i % 4u == 3u;
    if is_opacity && step.holds_opacity != 0u { return; }
    var g = gradient[map.offset + i];
    if map.levels > 1u {
        g += 0.25 * gradient[parent_of(map, 0u, i)];
    }
    if step.visited_only != 0u && g == 0.0 { return; }
    var m = moments[map.moments + i];
    m = vec2f(mix(g, m.x, BETA_1), mix(g * g, m.y, BETA_2));
    moments[map.moments + i] = m;
    let rate = select(step.band_rate, step.base_rate, map.is_base != 0u);
    var value = texels[map.offset + i];
    value -= rate * (m.x / step.correction_1) / (sqrt(m.y / step.correction_2) + EPSILON);
    if is_opacity && is_finite(value) {
        value = clamp(value, -MAX_LOGIT, MAX_LOGIT);
    }
    texels[map.offset + i] = value;
    if !(is_finite(value) && is_finite(m.y)) {
        atomicOr(&status.not_finite, select(NOT_FINITE_BANDS, NOT_FINITE_BASE, map.is_base != 0u));
    }
}
