// Poses of photographs: for every view a rotation vector ω in camera axes, radians, and a shift c of its centre in the
// world, so that W' = exp(ω)·W and C' = C + c, where W and C are known to the host.
//
// `correct`: replaces the view that the host wrote by the corrected one, in place. One thread.
// `pull`: sums over splats the parts of the gradient by ω and c: everything that depends on a mean depends on its
// difference from the centre, so the gradient by the centre is minus that by the means. PARTS workgroups; 36 bytes per
// visible splat, bound by bandwidth.
// `update`: total of these sums, and a step of Adam for the view. One workgroup.

//#import shared/view.wgsl
//#import shared/adam_of_view.wgsl with TARGET=poses FLAG=NOT_FINITE_POSES
//#import shared/status.wgsl
//#import shared/sum_rows.wgsl with ROWS=2

struct Step {
    view: u32,                          // of the capture's, whose pose is meant
    turn_rate: f32,                     // radians; 0: the pose stays
    shift_rate: f32,                    // world units
    correction_1: f32,                  // 1 − β₁ᵗ, t being the steps of this view
    correction_2: f32,                  // 1 − β₂ᵗ
}

@group(0) @binding(0) var<storage, read_write> view: View;
@group(0) @binding(1) var<uniform> step: Step;
@group(0) @binding(2) var<storage, read_write> poses: array<vec4f>;         // [view][ω, c]; last of four is 0
@group(0) @binding(3) var<storage, read_write> first: array<vec4f>;
@group(0) @binding(4) var<storage, read_write> second: array<vec4f>;
@group(0) @binding(5) var<storage, read> turn_gradient: array<vec4f>;       // [splat]
@group(0) @binding(6) var<storage, read> geometry_gradient: array<vec4f>;   // [splat][mean, …]
@group(0) @binding(7) var<storage, read_write> partial: array<vec4f>;       // [workgroup of `pull`][∂L/∂ω, ∂L/∂c]
@group(0) @binding(8) var<storage, read_write> status: Status;
@group(0) @binding(9) var<storage, read> visible: array<u32>;               // [splat]; where 0, it has no gradient

// exp(ω)·x
fn turned(turn: vec3f, x: vec3f) -> vec3f {
    let half = 0.5 * length(turn);
    var s = 1.0;
    if half > 1e-4 { s = sin(half) / half; }
    let across = cross(turn, x);
    return x + s * cos(half) * across + 0.5 * s * s * cross(turn, across);
}

@compute @workgroup_size(1)
fn correct() {
    let turn = poses[2u * step.view].xyz;
    let shift = poses[2u * step.view + 1u].xyz;
    let w = transpose(mat3x4f(view.row_x, view.row_y, view.row_z));
    let rows = transpose(mat3x3f(turned(turn, w[0]), turned(turn, w[1]), turned(turn, w[2])));
    let center = view.center + shift;
    // Remainder of the sum in f32.
    let short = w[3] + (shift - (center - view.center));
    view.row_x = vec4f(rows[0], short.x);
    view.row_y = vec4f(rows[1], short.y);
    view.row_z = vec4f(rows[2], short.z);
    view.center = center;
}

@compute @workgroup_size(256)
fn pull(
    @builtin(local_invocation_index) thread: u32,
    @builtin(workgroup_id) group: vec3u,
) {
    let part = group_index(group);
    var by_turn = vec4f();
    var by_shift = vec3f();
    for (var i = part * 256u + thread; i < view.n_splats; i += PARTS * 256u) {
        if visible[i] != 0u {
            by_turn += turn_gradient[i];
            by_shift -= geometry_gradient[3u * i].xyz;
        }
    }
    sums[thread] = by_turn;
    sums[256u + thread] = vec4f(by_shift, 0.0);
    add_up(thread);
    if thread < 2u && part < PARTS { partial[2u * part + thread] = sums[256u * thread]; }
}

@compute @workgroup_size(256)
fn update(@builtin(local_invocation_index) thread: u32) {
    sums[thread] = partial[2u * thread];
    sums[256u + thread] = partial[2u * thread + 1u];
    add_up(thread);
    let rate = select(step.shift_rate, step.turn_rate, thread == 0u);
    if thread >= 2u || rate == 0.0 || status.is_short != 0u { return; }
    let i = 2u * step.view + thread;
    var g = sums[256u * thread];
    if thread == 0u {
        // The sum is the derivative by a rotation after exp(ω): multiplied by the transposed left Jacobian of exp, to
        // |ω|².
        let turn = poses[i].xyz;
        let across = cross(turn, g.xyz);
        g = vec4f(g.xyz - 0.5 * across + cross(turn, across) / 6.0, 0.0);
    }
    learn(i, g, rate);
}
