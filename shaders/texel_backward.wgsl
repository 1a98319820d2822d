// Scatters the gradient of every fragment's colour and alpha to its texels, one thread per fragment, one workgroup per
// ACROSS × DOWN pixels of a layer.
//
// ∂T_k = Y_k ∂rgb where the channel is not clamped at 0, ∂A = α(1−α) ∂α where α is not clamped. Every texel gets this
// times its trilinear weight, also at coarse levels, which adam_texels passes down to level 0. No gradient flows to UV,
// mip level or direction.
//
// Neighbouring pixels see the same texels, in the bands above all. So a subgroup processes the texels that its
// fragments see one by one, sums the contributions of all fragments to it, and adds every sum once, each by its own
// lane: 4 atomic additions to the base and 3·((d+1)²−1) to the bands, 24 at degree 2, per texel that a subgroup sees.
// Without subgroups there are as many for each of a fragment's 4 or 8 texels. Per fragment 112 bytes read.

//#import shared/view.wgsl
//#import shared/sh.wgsl
//#import shared/mesh_fragment.wgsl
//#import shared/fragment_gradient.wgsl

const NONE: u32 = 0xffffffffu;

@compute @workgroup_size(64)
fn backward(
    @builtin(workgroup_id) group: vec3u,
    @builtin(local_invocation_index) thread: u32,
//#if SUBGROUPS
    @builtin(subgroup_invocation_id) lane: u32,
//#end
) {
    let size = vec2u(ACROSS, DOWN);
    let blocks = (view.size + size - 1u) / size;
    let index = group_index(group);
    let layer = index / (blocks.x * blocks.y);
    if layer >= LAYERS { return; }
    let block = index - layer * blocks.x * blocks.y;
    let at = size * vec2u(block % blocks.x, block / blocks.x) + vec2u(thread % ACROSS, thread / ACROSS);
    var triangle = 0u;
    var g = vec4f(0.0);
    if all(at < view.size) {
        let i = (layer * view.size.y + at.y) * view.size.x + at.x;
        triangle = layer_triangle[i];
        if triangle != 0u { g = fragment_gradient(i, fixed_scale(map_peak(peaks[0], peaks[2], peaks[3]))); }
    }
    let is_seen = any(g != vec4f(0.0));
//#if SUBGROUPS
    if !subgroupAny(is_seen) { return; }
    // Counted at run time: some drivers report another subgroup_size than they compile for.
    let lanes = subgroupAdd(1u);
//#else
    if !is_seen { return; }
//#end
    let f = fragment(at, max(triangle, 1u) - 1u);
    let map = maps[f.mesh];
    let base_g = vec4f(SH_C0 * g.rgb, g.a);
    let base_level = mip_level(f, map.base);
    let base_finer = u32(base_level);
    for (var l = 0u; l < 2u; l += 1u) {
        let share = abs(f32(1u - l) - fract(base_level));
        let t = taps(map.base, min(base_finer + l, map.base.levels - 1u), share, f.uv);
//#if SUBGROUPS
        var left = select(vec4u(NONE), t.texel, is_seen && share != 0.0);
        loop {
            let texel = subgroupMin(min(min(left.x, left.y), min(left.z, left.w)));
            if texel == NONE { break; }
            let is_it = left == vec4u(texel);
            left = select(left, vec4u(NONE), is_it);
            // More than one of the four taps at the border of a map.
            let weight = dot(select(vec4f(0.0), t.weight, is_it), vec4f(1.0));
            let sum = subgroupAdd(vec4i(round(weight * base_g)));
            for (var c = lane; c < 4u; c += lanes) { atomicAdd(&base_gradient[4u * texel + c], select(select(sum.x, sum.y, c == 1u), select(sum.z, sum.w, c == 3u), c >= 2u)); }
        }
//#else
        if share == 0.0 { break; }
//#for s in 0..4
        {
            let sum = t.weight[$s] * base_g;
            add_base_gradient(4u * t.texel[$s], sum.x);
            add_base_gradient(4u * t.texel[$s] + 1u, sum.y);
            add_base_gradient(4u * t.texel[$s] + 2u, sum.z);
            add_base_gradient(4u * t.texel[$s] + 3u, sum.w);
        }
//#end
//#end
    }
//#if BANDS
    let degree = min(map.degree, view.band_degree);
//#if SUBGROUPS
    if subgroupMax(degree) == 0u { return; }
//#else
    if degree == 0u { return; }
//#end
    let stride = 3u * ((map.degree + 1u) * (map.degree + 1u) - 1u);
    let learnt = 3u * ((degree + 1u) * (degree + 1u) - 1u);     // floats of a texel that are learnt now
    let basis = sh_basis(f.direction);
    let band_g = g.rgb / BAND_UNIT;
    let band_level = mip_level(f, map.bands);
    let band_finer = u32(band_level);
    for (var l = 0u; l < 2u; l += 1u) {
        let share = abs(f32(1u - l) - fract(band_level));
        let t = taps(map.bands, min(band_finer + l, map.bands.levels - 1u), share, f.uv);
        let first = map.band_offset + stride * t.texel;
//#if SUBGROUPS
        var left = select(vec4u(NONE), first, is_seen && share != 0.0 && degree != 0u);
        loop {
            let float = subgroupMin(min(min(left.x, left.y), min(left.z, left.w)));
            if float == NONE { break; }
            let is_it = left == vec4u(float);
            left = select(left, vec4u(NONE), is_it);
            let count = subgroupMax(select(0u, learnt, any(is_it)));
            let weighted = dot(select(vec4f(0.0), t.weight, is_it), vec4f(1.0)) * band_g;
//#for k in 0..BANDS
            var sum$k = vec3i(0);
            if 3u * $ku < count { sum$k = subgroupAdd(vec3i(round(basis[$k + 1] * weighted))); }
//#end
            for (var c = lane; c < count; c += lanes) {
                var sum = 0;
//#for k in 0..BANDS
                if c == 3u * $ku { sum = sum$k.x; }
                if c == 3u * $ku + 1u { sum = sum$k.y; }
                if c == 3u * $ku + 2u { sum = sum$k.z; }
//#end
                atomicAdd(&band_gradient[float + c], sum);
            }
        }
//#else
        if share == 0.0 { break; }
//#for s in 0..4
        {
            let weighted = t.weight[$s] * band_g;
//#for k in 0..BANDS
            if 3u * $ku < learnt {
                add_band_gradient(first[$s] + 3u * $ku, basis[$k + 1] * weighted.r);
                add_band_gradient(first[$s] + 3u * $ku + 1u, basis[$k + 1] * weighted.g);
                add_band_gradient(first[$s] + 3u * $ku + 2u, basis[$k + 1] * weighted.b);
            }
//#end
        }
//#end
//#end
    }
//#end
}
