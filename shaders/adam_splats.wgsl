// A step of Adam for splats, with MCMC's regularisers and noise (Kheradmand et al. 2024). `geometry`: one thread per
// splat; `harmonics`: one thread per four active SH floats, or per one if splats do not begin at multiples of four
// (degrees 0 and 2).
//
// 28 bytes per float (parameter, gradient and two moments read, three written) and some 15 operations: bound by
// bandwidth, 1.7 kB per splat of degree 3. A splat that the view does not see has no gradient: 24 bytes per float.

//#import shared/random.wgsl
//#import shared/group_index.wgsl
//#import shared/rotation.wgsl
//#import shared/status.wgsl

struct Step {
    n_splats: u32,
    number: u32,                        // t, from 1
    seed: u32,
    visible_only: u32,                  // leave splats that this view does not see, and their moments, alone
    correction_1: f32,                  // 1 − β₁ᵗ
    correction_2: f32,                  // 1 − β₂ᵗ
    noise: f32,                         // standard deviation by which Σ3·ξ is multiplied, 0 for none
    active_floats: u32,                 // of a splat's SH, the first ones
    mean_rate: f32,
    opacity_rate: f32,
    rotation_rate: f32,
    log_scale_rate: f32,
    dc_rate: f32,
    rest_rate: f32,
    opacity_slope: f32,                 // of the regulariser by each opacity
    scale_slope: f32,                   // of the regulariser by each scale
}

@group(0) @binding(0) var<uniform> step: Step;
@group(0) @binding(1) var<storage, read> visible: array<u32>;
@group(0) @binding(6) var<storage, read_write> status: Status;
//#if GEOMETRY
// Three vectors per splat: mean and opacity logit; quaternion w, x, y, z of any length; log-scale and a constant.
@group(0) @binding(2) var<storage, read_write> parameters: array<vec4f>;
@group(0) @binding(3) var<storage, read> gradient: array<vec4f>;
@group(0) @binding(4) var<storage, read_write> first: array<vec4f>;
@group(0) @binding(5) var<storage, read_write> second: array<vec4f>;

//#import shared/adam.wgsl with FLOATS=vec4f

// New value of parameter vector i.
fn adam(i: u32, value: vec4f, g: vec4f, rates: vec4f) -> vec4f {
    let m = moments_with(g, Moments(first[i], second[i]));
    first[i] = m.first;
    second[i] = m.second;
    return value - adam_step(m, rates, step.correction_1, step.correction_2);
}

// Three independent normal numbers (Box–Muller).
fn normal(splat: u32) -> vec3f {
    let r = unit_numbers(random_words(vec4u(splat, step.number, step.seed, 0u)));
    // The logarithm is taken of numbers in (0, 1]; near 1 its error may make it positive.
    let radius = sqrt(max(-2.0 * log(vec2f(1.0) - r.xy), vec2f(0.0)));
    let angle = 6.2831853 * r.zw;
    return vec3f(radius.x * cos(angle.x), radius.x * sin(angle.x), radius.y * cos(angle.y));
}

fn logistic(x: f32) -> f32 {
    return 1.0 / (1.0 + exp(min(-x, 80.0)));   // beyond 80 the exponential overflows
}

@compute @workgroup_size(256)
fn geometry(
    @builtin(workgroup_id) group: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let i = group_index(group) * 256u + thread;
    if i >= step.n_splats || status.is_short != 0u { return; }
    let is_visible = visible[i] != 0u;
    if step.visible_only != 0u && !is_visible { return; }
    let place = 3u * i;
    //#for k in 0..3
    var g$k = vec4f();
    if is_visible { g$k = gradient[place + $ku]; }
    //#end

    var position = parameters[place];
    var g = g0;
    var opacity = logistic(position.w);
    g.w += step.opacity_slope * opacity * (1.0 - opacity);
    position = adam(place, position, g, vec4f(vec3f(step.mean_rate), step.opacity_rate));

    let quaternion = adam(place + 1u, parameters[place + 1u], g1, vec4f(step.rotation_rate));
    parameters[place + 1u] = quaternion;

    var log_scale = parameters[place + 2u];
    g = vec4f(g2.xyz + step.scale_slope * exp(log_scale.xyz), 0.0);
    log_scale = adam(place + 2u, log_scale, g, vec4f(vec3f(step.log_scale_rate), 0.0));
    parameters[place + 2u] = log_scale;

    if step.noise != 0.0 {
        // MCMC: transparent splats wander along their own shape, Δ = Σ3·ξ with Σ3 = R·S²·Rᵀ.
        let r = rotation_matrix(quaternion / max(length(quaternion), 1e-30));
        let scale = exp(log_scale.xyz);
        opacity = logistic(position.w);
        let strength = step.noise * logistic(-100.0 * (opacity - 0.005));
        position += vec4f(strength * (r * (scale * scale * (normal(i) * r))), 0.0);
    }
    parameters[place] = position;
    if !(are_finite(position) && are_finite(quaternion) && are_finite(log_scale) && are_finite(second[place])
        && are_finite(second[place + 1u]) && are_finite(second[place + 2u])) {
        atomicOr(&status.not_finite, NOT_FINITE_GEOMETRY);
    }
}
//#else
//#if FOURS
alias Floats = vec4f;
const LANES: u32 = 4u;
//#import shared/adam.wgsl with FLOATS=vec4f
//#else
alias Floats = f32;
const LANES: u32 = 1u;
//#import shared/adam.wgsl with FLOATS=f32
//#end

// [splat][coefficient][rgb]
@group(0) @binding(2) var<storage, read_write> parameters: array<Floats>;
@group(0) @binding(3) var<storage, read> gradient: array<Floats>;
@group(0) @binding(4) var<storage, read_write> first: array<Floats>;
@group(0) @binding(5) var<storage, read_write> second: array<Floats>;

@compute @workgroup_size(256)
fn harmonics(
    @builtin(workgroup_id) group: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let index = group_index(group) * 256u + thread;
    let of_splat = (step.active_floats + LANES - 1u) / LANES;
    let splat = index / of_splat;
    if splat >= step.n_splats || status.is_short != 0u { return; }
    let is_visible = visible[splat] != 0u;
    if step.visible_only != 0u && !is_visible { return; }
    let float = (index - splat * of_splat) * LANES;
    let i = (splat * SH_FLOATS + float) / LANES;
    //#if FOURS
    let number = vec4u(float) + vec4u(0u, 1u, 2u, 3u);
    let is_active = number < vec4u(step.active_floats);
    let rate = select(vec4f(step.rest_rate), vec4f(step.dc_rate), number < vec4u(3u));
    //#else
    let is_active = true;
    let rate = select(step.rest_rate, step.dc_rate, float < 3u);
    //#end
    var g = Floats();
    if is_visible { g = gradient[i]; }
    let before = parameters[i];
    let kept = Moments(first[i], second[i]);
    let moved = moments_with(g, kept);
    let m = Moments(select(kept.first, moved.first, is_active), select(kept.second, moved.second, is_active));
    first[i] = m.first;
    second[i] = m.second;
    let after = before - adam_step(m, rate, step.correction_1, step.correction_2);
    let value = select(before, after, is_active);
    parameters[i] = value;
    //#if FOURS
    let finite = are_finite(value) && are_finite(m.second);
    //#else
    let finite = is_finite(value) && is_finite(m.second);
    //#end
    if !finite { atomicOr(&status.not_finite, NOT_FINITE_SH); }
}
//#end
