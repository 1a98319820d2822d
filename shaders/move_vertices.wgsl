// One thread per vertex: Adam on its displacement along its normal, with steps that are smooth over the surface.
//
// `start` computes Adam's step from the gradient; `diffuse`, run alternately with ODD = 0 and 1, is a Jacobi iteration
// for (1 + SMOOTHNESS·Laplacian)·x = step, which keeps noise of single vertices out of the surface; `displace` takes
// the step.

//#import shared/view.wgsl
//#import shared/adam.wgsl with FLOATS=f32
//#import shared/status.wgsl
//#import shared/fixed_point.wgsl

const SMOOTHNESS: f32 = 8.0;

struct Step {
    rate: f32,              // world units per step
    correction_1: f32,      // 1 − β₁ᵗ
    correction_2: f32,      // 1 − β₂ᵗ
    n_vertices: u32,
}

@group(0) @binding(0) var<uniform> step: Step;
@group(0) @binding(1) var<storage, read> gradient: array<u32>;          // [V, 2], along the normal, in fixed point
@group(0) @binding(2) var<storage, read_write> moments: array<vec2f>;   // [V]
@group(0) @binding(3) var<storage, read_write> steps: array<vec4f>;     // [V]: Adam's step; two iterates; unused
@group(0) @binding(4) var<storage, read> first: array<u32>;             // [V + 1]
@group(0) @binding(5) var<storage, read> neighbors: array<u32>;         // those of vertex v start at first[v]
@group(0) @binding(6) var<storage, read> normals: array<vec4f>;         // [V]
@group(0) @binding(7) var<storage, read_write> positions: array<f32>;   // [V, 3], world
@group(0) @binding(8) var<storage, read_write> status: Status;
@group(0) @binding(9) var<storage, read> peaks: array<u32>;             // see fixed_point.wgsl

@compute @workgroup_size(256)
fn start(
    @builtin(workgroup_id) group: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let v = group_index(group) * 256u + thread;
    if v >= step.n_vertices { return; }
    let g = fixed_unit(peaks[1]) * wide_sum(gradient[2u * v], gradient[2u * v + 1u]);
    if status.is_short != 0u {
        steps[v] = vec4f(0.0);
        return;
    }
    if !is_finite(g) {
        atomicOr(&status.not_finite, NOT_FINITE_VERTICES);
    }
    let m = mixed_moments(g, Moments(moments[v].x, moments[v].y));
    moments[v] = vec2f(m.first, m.second);
    let s = adam_step(m, 1.0, step.correction_1, step.correction_2);
    steps[v] = vec4f(s, s, s, 0.0);
}

@compute @workgroup_size(256)
fn diffuse(
    @builtin(workgroup_id) group: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let v = group_index(group) * 256u + thread;
    if v >= step.n_vertices { return; }
    let degree = first[v + 1u] - first[v];
    var sum = 0.0;
    for (var i = first[v]; i < first[v + 1u]; i += 1u) {
        sum += steps[neighbors[i]][1u + ODD];
    }
    let share = SMOOTHNESS / f32(max(degree, 1u));
    steps[v][2u - ODD] = (steps[v].x + share * sum) / (1.0 + share * f32(degree));
}

@compute @workgroup_size(256)
fn displace(
    @builtin(workgroup_id) group: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let v = group_index(group) * 256u + thread;
    if v >= step.n_vertices { return; }
    let shift = -step.rate * steps[v].y * normals[v].xyz;
    positions[3u * v] += shift.x;
    positions[3u * v + 1u] += shift.y;
    positions[3u * v + 2u] += shift.z;
}
