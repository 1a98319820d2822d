// Exposures of photographs (as in INRIA 3DGS): the photograph of a view is compared with E·(r, g, b, 1), where E is a
// 3×4 matrix per view.
//
// `pull`: converts the gradient by the exposed colours to that by the rendered ones, Eᵀ·g, in place; and sums each
// workgroup's part of g·(r, g, b, 1)ᵀ, the gradient by E; PER_THREAD pixels per thread. A photograph with alpha is
// composited over the exposed background, too; as this is common to both pictures, it must not move E: (1 −
// alpha)·(background, 1) is subtracted. That is exact for L1, which depends on differences alone, and an approximation
// for SSIM. Where meshes alone are drawn, E must not explain what they leave open: pixels then count as far as they are
// covered. 52 bytes and 32 multiply-adds per pixel, 27 MB at 960 × 540: bound by bandwidth.
// `update`: total of these sums, and a step of Adam for the view. One workgroup.

//#import shared/view.wgsl
//#import shared/adam_of_view.wgsl with TARGET=exposures FLAG=NOT_FINITE_EXPOSURES
//#import shared/status.wgsl
//#import shared/sum_rows.wgsl with ROWS=3

struct Step {
    view: u32,                          // of all views of the capture, whose E is meant
    n_groups: u32,                      // of `pull`
    rate: f32,                          // 0: E stays
    correction_1: f32,                  // 1 − β₁ᵗ, t being the steps of this view
    correction_2: f32,                  // 1 − β₂ᵗ
    is_composite: f32,                  // 1: the photograph's alpha is opacity; else 0
    is_partial: u32,                    // 1: meshes alone are drawn, which are only a part of what is seen; else 0
}

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> step: Step;
@group(0) @binding(2) var<storage, read> image: array<vec4f>;               // rgb and transmittance per pixel
@group(0) @binding(3) var<storage, read_write> gradient: array<vec4f>;      // ∂L/∂rgb; the last of four is kept
@group(0) @binding(4) var<storage, read_write> exposures: array<vec4f>;     // [view][row]
@group(0) @binding(5) var<storage, read_write> first: array<vec4f>;
@group(0) @binding(6) var<storage, read_write> second: array<vec4f>;
@group(0) @binding(7) var<storage, read_write> partial: array<vec4f>;       // [workgroup of `pull`][row]
@group(0) @binding(8) var<storage, read_write> status: Status;
@group(0) @binding(9) var<storage, read> truth: array<u32>;                 // RGBA8, r lowest

@compute @workgroup_size(256)
fn pull(
    @builtin(local_invocation_index) thread: u32,
    @builtin(workgroup_id) group: vec3u,
) {
    let index = group_index(group);
    let n_pixels = view.size.x * view.size.y;
    let e0 = exposures[3u * step.view].xyz;
    let e1 = exposures[3u * step.view + 1u].xyz;
    let e2 = exposures[3u * step.view + 2u].xyz;
    var r0 = vec4f(); var r1 = vec4f(); var r2 = vec4f();
    for (var k = 0u; k < PER_THREAD; k++) {
        let pixel = (index * PER_THREAD + k) * 256u + thread;
        if pixel < n_pixels {
            let transparent = step.is_composite * (1.0 - f32(truth[pixel] >> 24u) * (1.0 / 255.0));
            let drawn = image[pixel];
            let part = select(1.0, 1.0 - drawn.w, step.is_partial != 0u);
            let seen = part * (vec4f(drawn.xyz, 1.0) - transparent * vec4f(view.background.xyz, 1.0));
            let g = gradient[pixel];
            r0 += g.x * seen;
            r1 += g.y * seen;
            r2 += g.z * seen;
            gradient[pixel] = vec4f(g.x * e0 + g.y * e1 + g.z * e2, g.w);
        }
    }
    sums[thread] = r0;
    sums[256u + thread] = r1;
    sums[512u + thread] = r2;
    add_up(thread);
    if thread < 3u && index < step.n_groups { partial[3u * index + thread] = sums[256u * thread]; }
}

@compute @workgroup_size(256)
fn update(@builtin(local_invocation_index) thread: u32) {
    for (var row = 0u; row < 3u; row++) {
        var sum = vec4f();
        for (var i = thread; i < step.n_groups; i += 256u) { sum += partial[3u * i + row]; }
        sums[row * 256u + thread] = sum;
    }
    add_up(thread);
    if thread >= 3u || step.rate == 0.0 || status.is_short != 0u { return; }
    learn(3u * step.view + thread, sums[256u * thread], step.rate);
}
