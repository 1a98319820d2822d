// Scatters the gradient of every fragment's colour and alpha to its texels, a thread to a fragment.
//
// ∂T_k = Y_k ∂rgb where the channel is not clamped at 0, ∂A = α(1−α) ∂α where α is not clamped. Every texel gets that
// times its trilinear weight, also at coarse levels; pull_mips and adam_texels hand those down to level 0. No gradient
// flows to uv, mip level or direction.
//
// Per fragment 112 bytes read; per texel of its footprint, of which there are 4 or 8, 4 atomic additions of integers to the base
// and 3·((d+1)²−1) to the bands, 24 at degree 2.

//#import shared/view.wgsl
//#import shared/sh.wgsl
//#import shared/mesh_fragment.wgsl
//#import shared/fragment_gradient.wgsl

@compute @workgroup_size(64)
fn backward(
    @builtin(workgroup_id) group: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let i = group_index(group) * 64u + thread;
    let area = view.size.x * view.size.y;
    if i >= LAYERS * area { return; }
    let triangle = layer_triangle[i];
    if triangle == 0u { return; }
    let g = fragment_gradient(i, fixed_scale(peaks[0]));
    if all(g == vec4f(0.0)) { return; }
    let pixel = i % area;
    let f = fragment(vec2u(pixel % view.size.x, pixel / view.size.x), triangle - 1u);
    let map = maps[f.mesh];
    let base_g = vec4f(SH_C0 * g.rgb, g.a);
    let base_level = mip_level(f, map.base);
    let base_finer = u32(base_level);
    for (var l = 0u; l < 2u; l += 1u) {
        let share = abs(f32(1u - l) - fract(base_level));
        if share == 0.0 { break; }
        let t = taps(map.base, base_finer + l, share, f.uv);
        //#for s in 0..4
        {
            let sum = t.weight[$s] * base_g;
            add_base_gradient(4u * t.texel[$s], sum.x);
            add_base_gradient(4u * t.texel[$s] + 1u, sum.y);
            add_base_gradient(4u * t.texel[$s] + 2u, sum.z);
            add_base_gradient(4u * t.texel[$s] + 3u, sum.w);
        }
        //#end
    }
    //#if BANDS
    let degree = min(map.degree, view.band_degree);
    if degree == 0u { return; }
    let stride = 3u * ((map.degree + 1u) * (map.degree + 1u) - 1u);
    let basis = sh_basis(f.direction);
    let band_level = mip_level(f, map.bands);
    let band_finer = u32(band_level);
    for (var l = 0u; l < 2u; l += 1u) {
        let share = abs(f32(1u - l) - fract(band_level));
        if share == 0.0 { break; }
        let t = taps(map.bands, band_finer + l, share, f.uv);
        //#for s in 0..4
        {
            let texel = map.band_offset + stride * t.texel[$s];
            let weighted = t.weight[$s] / BAND_UNIT * g.rgb;
            //#for k in 0..BANDS
            if $ku + 1u < (degree + 1u) * (degree + 1u) {
                add_band_gradient(texel + 3u * $ku, basis[$k + 1] * weighted.r);
                add_band_gradient(texel + 3u * $ku + 1u, basis[$k + 1] * weighted.g);
                add_band_gradient(texel + 3u * $ku + 2u, basis[$k + 1] * weighted.b);
            }
            //#end
        }
        //#end
    }
    //#end
}
