// texel_backward.wgsl for software adapters, which execute the lanes of an atomic addition in turn: each thread walks
// DOWN pixels down a column.
//
// Neighbouring pixels share texels: a footprint moves by at most about a texel from one to the next. The thread sums in
// registers while a texel stays in the footprint and adds it to memory when it leaves. Per fragment 112 bytes read; per
// texel that leaves 4 atomic additions to the base and 3·((d+1)²−1) to the bands, 24 at degree 2.

//#import shared/view.wgsl
//#import shared/sh.wgsl
//#import shared/mesh_fragment.wgsl
//#import shared/fragment_gradient.wgsl

const NONE: u32 = 0xffffffffu;

// Taps in the order of their texels' parity: column even or odd, then row. A texel has the same place in the
// footprints of all points around it, so that a walk over neighbouring points can keep what it has there.
fn by_parity(t: Taps, pyramid: Pyramid, level: u32, uv: vec2f) -> Taps {
    let low = vec2i(floor(uv * vec2f(pyramid.size >> vec2u(level)) - 0.5));
    let odd = (low & vec2i(1)) == vec2i(1);
    let texel = select(t.texel, t.texel.yxwz, odd.x);
    let weight = select(t.weight, t.weight.yxwz, odd.x);
    return Taps(select(texel, texel.zwxy, odd.y), select(weight, weight.zwxy, odd.y));
}

@compute @workgroup_size(64)
fn backward(
    @builtin(workgroup_id) group: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let i = group_index(group) * 64u + thread;
    let strips = (view.size.y + DOWN - 1u) / DOWN;
    let strip = i / view.size.x;
    let x = i - strip * view.size.x;
    let layer = strip / strips;
    let top = (strip - layer * strips) * DOWN;
    if layer >= LAYERS { return; }
    let scale = fixed_scale(map_peak(peaks[0], peaks[2], peaks[3]));

    // By level (finer, coarser) and place of the footprint: the texel held there, as an index of floats, and its sum.
    //#for l in 0..2
    //#for s in 0..4
    var base_held$l_$s = NONE;
    var base_sum$l_$s = vec4f(0.0);
    //#if BANDS
    var band_held$l_$s = NONE;
    //#for k in 0..BANDS
    var band_sum$l_$s_$k = vec3f(0.0);
    //#end
    //#end
    //#end
    //#end
    //#if BANDS
    // Coefficients that are learnt now; those that are 0 for all texels need not be added.
    let terms = (view.band_degree + 1u) * (view.band_degree + 1u);
    //#end
    // One step more than there are pixels, without a texel, so that all held ones are written.
    for (var step = 0u; step <= DOWN; step += 1u) {
        let y = top + step;
        let pixel = (layer * view.size.y + y) * view.size.x + x;
        let last = step == DOWN || y >= view.size.y;
        var triangle = 0u;
        var g = vec4f(0.0);
        if !last { triangle = layer_triangle[pixel]; }
        if triangle != 0u { g = fragment_gradient(pixel, scale); }
        let f = fragment(vec2u(x, y), max(triangle, 1u) - 1u);
        let map = maps[f.mesh];
        //#for l in 0..2
        //#for s in 0..4
        var base_next$l_$s = select(base_held$l_$s, NONE, last);
        var base_weight$l_$s = 0.0;
        //#if BANDS
        var band_next$l_$s = select(band_held$l_$s, NONE, last);
        var band_weight$l_$s = 0.0;
        //#end
        //#end
        //#end
        if any(g != vec4f(0.0)) {
            let base_level = mip_level(f, map.base);
            //#if BANDS
            let band_level = mip_level(f, map.bands);
            let stride = 3u * ((map.degree + 1u) * (map.degree + 1u) - 1u);
            //#end
            //#for l in 0..2
            {
                let finer = u32(base_level);
                let share = base_level - f32(finer);
                if $l == 0 || share != 0.0 {
                    let at = taps(map.base, finer + $lu, select(share, 1.0 - share, $l == 0), f.uv);
                    let t = by_parity(at, map.base, finer + $lu, f.uv);
                    //#for s in 0..4
                    base_next$l_$s = 4u * t.texel[$s];
                    base_weight$l_$s = t.weight[$s];
                    //#end
                }
            }
            //#if BANDS
            {
                let finer = u32(band_level);
                let share = band_level - f32(finer);
                if $l == 0 || share != 0.0 {
                    let at = taps(map.bands, finer + $lu, select(share, 1.0 - share, $l == 0), f.uv);
                    let t = by_parity(at, map.bands, finer + $lu, f.uv);
                    //#for s in 0..4
                    band_next$l_$s = map.band_offset + stride * t.texel[$s];
                    band_weight$l_$s = t.weight[$s];
                    //#end
                }
            }
            //#end
            //#end
        }

        // One leaving texel at a time: a software adapter executes every addition written here for each lane in turn,
        // even when no texel leaves.
        loop {
            var leaves = NONE;
            var sum = vec4f(0.0);
            //#for l in 0..2
            //#for s in 0..4
            if leaves == NONE && base_held$l_$s != base_next$l_$s && base_held$l_$s != NONE {
                leaves = base_held$l_$s;
                sum = base_sum$l_$s;
                base_held$l_$s = NONE;
            }
            //#end
            //#end
            if leaves == NONE { break; }
            add_base_gradient(leaves, sum.x);
            add_base_gradient(leaves + 1u, sum.y);
            add_base_gradient(leaves + 2u, sum.z);
            add_base_gradient(leaves + 3u, sum.w);
        }
        let base_g = vec4f(SH_C0 * g.rgb, g.a);
        //#for l in 0..2
        //#for s in 0..4
        base_sum$l_$s = select(vec4f(0.0), base_sum$l_$s, base_held$l_$s == base_next$l_$s)
            + base_weight$l_$s * base_g;
        base_held$l_$s = base_next$l_$s;
        //#end
        //#end
        //#if BANDS
        loop {
            var leaves = NONE;
            //#for k in 0..BANDS
            var sum$k = vec3f(0.0);
            //#end
            //#for l in 0..2
            //#for s in 0..4
            if leaves == NONE && band_held$l_$s != band_next$l_$s && band_held$l_$s != NONE {
                leaves = band_held$l_$s;
                //#for k in 0..BANDS
                sum$k = band_sum$l_$s_$k;
                //#end
                band_held$l_$s = NONE;
            }
            //#end
            //#end
            if leaves == NONE { break; }
            //#for k in 0..BANDS
            if $ku + 1u < terms {
                add_band_gradient(leaves + 3u * $ku, sum$k.x);
                add_band_gradient(leaves + 3u * $ku + 1u, sum$k.y);
                add_band_gradient(leaves + 3u * $ku + 2u, sum$k.z);
            }
            //#end
        }
        let degree = min(map.degree, view.band_degree);
        let basis = sh_basis(f.direction);
        let band_g = g.rgb / BAND_UNIT;
        //#for k in 0..BANDS
        let band_g$k = select(vec3f(0.0), basis[$k + 1] * band_g, ($ku + 1u) < (degree + 1u) * (degree + 1u));
        //#end
        //#for l in 0..2
        //#for s in 0..4
        //#for k in 0..BANDS
        band_sum$l_$s_$k = select(vec3f(0.0), band_sum$l_$s_$k, band_held$l_$s == band_next$l_$s)
            + band_weight$l_$s * band_g$k;
        //#end
        band_held$l_$s = band_next$l_$s;
        //#end
        //#end
        //#end
        if last { break; }
    }
}
