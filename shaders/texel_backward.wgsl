// Scatters the gradient of every fragment's colour and alpha to its texels. A thread walks RUN pixels down a column.
//
// ∂T_k = Y_k ∂rgb where the channel is not clamped at 0, ∂A = α(1−α) ∂α where α is not clamped. Every texel gets that
// times its trilinear weight, also at coarse levels; pull_mips and adam_texels hand those down to level 0. No gradient
// flows to uv, mip level or direction.
//
// Neighbouring pixels share texels: a footprint moves by at most about a texel from one to the next. The thread sums in
// registers while a texel stays in the footprint and adds it to memory when it leaves. Per fragment 112 bytes read; per
// texel that leaves 4 atomic additions of integers to the base and 3·((d+1)²−1) to the bands, 24 at degree 2.

//#import shared/view.wgsl
//#import shared/sh.wgsl
//#import shared/mesh_fragment.wgsl
//#import shared/fixed_point.wgsl

@group(0) @binding(5) var<storage, read> layer_color: array<vec4f>;     // [LAYERS, h, w]: rgb, alpha
@group(0) @binding(6) var<storage, read> layer_gradient: array<vec4f>;  // [LAYERS, h, w]: of the loss by these
@group(0) @binding(7) var<storage, read> peaks: array<u32>;             // largest of layer_gradient; of vertices
//#import shared/fixed_add.wgsl with TARGET=base_gradient BINDING=8
//#if BANDS
//#import shared/fixed_add.wgsl with TARGET=band_gradient BINDING=9
//#end

const NONE: u32 = 0xffffffffu;

@compute @workgroup_size(64)
fn backward(
    @builtin(workgroup_id) group: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let i = group_index(group) * 64u + thread;
    let strips = (view.size.y + RUN - 1u) / RUN;
    let strip = i / view.size.x;
    let x = i - strip * view.size.x;
    let layer = strip / strips;
    let top = (strip - layer * strips) * RUN;
    if layer >= LAYERS { return; }
    let scale = fixed_scale(peaks[0]);

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
    // Coefficients that are learnt now: what is 0 for all texels need not be added.
    let terms = (view.band_degree + 1u) * (view.band_degree + 1u);
    //#end
    // One step more than there are pixels: it holds nothing, so that everything leaves.
    for (var step = 0u; step <= RUN; step += 1u) {
        let y = top + step;
        let pixel = (layer * view.size.y + y) * view.size.x + x;
        let last = step == RUN || y >= view.size.y;
        var triangle = 0u;
        var g = vec3f(0.0);
        var g_logit = 0.0;
        if !last { triangle = layer_triangle[pixel]; }
        if triangle != 0u {
            let color = layer_color[pixel];
            let gradient = scale * layer_gradient[pixel];
            g = select(vec3f(0.0), gradient.rgb, color.rgb > vec3f(0.0));
            g_logit = select(0.0, gradient.a * color.a * (1.0 - color.a), color.a < MAX_ALPHA);
        }
        if last || any(g != vec3f(0.0)) || g_logit != 0.0 {
            let f = fragment(vec2u(x, y), max(triangle, 1u) - 1u);
            let map = maps[f.mesh];
            let base_level = mip_level(f, map.base);
            let base_g = vec4f(SH_C0 * g, g_logit);
            //#if BANDS
            let band_level = mip_level(f, map.bands);
            let stride = 3u * ((map.degree + 1u) * (map.degree + 1u) - 1u);
            let degree = min(map.degree, view.band_degree);
            let basis = sh_basis(f.direction);
            let band_g = g / BAND_UNIT;
            //#for k in 0..BANDS
            let band_g$k = select(vec3f(0.0), basis[$k + 1] * band_g, ($ku + 1u) < (degree + 1u) * (degree + 1u));
            //#end
            //#end
            //#for l in 0..2
            {
                let finer = u32(base_level);
                let share = base_level - f32(finer);
                if $l == 0 || share != 0.0 || last {
                    let at = taps(map.base, finer + $lu, select(share, 1.0 - share, $l == 0), f.uv);
                    let t = by_parity(at, map.base, finer + $lu, f.uv);
                    //#for s in 0..4
                    let to$s = select(4u * t.texel[$s], NONE, last);
                    if base_held$l_$s != to$s && base_held$l_$s != NONE {
                        add_base_gradient(base_held$l_$s, base_sum$l_$s.x);
                        add_base_gradient(base_held$l_$s + 1u, base_sum$l_$s.y);
                        add_base_gradient(base_held$l_$s + 2u, base_sum$l_$s.z);
                        add_base_gradient(base_held$l_$s + 3u, base_sum$l_$s.w);
                    }
                    base_sum$l_$s = select(vec4f(0.0), base_sum$l_$s, base_held$l_$s == to$s) + t.weight[$s] * base_g;
                    base_held$l_$s = to$s;
                    //#end
                }
            }
            //#if BANDS
            {
                let finer = u32(band_level);
                let share = band_level - f32(finer);
                if $l == 0 || share != 0.0 || last {
                    let at = taps(map.bands, finer + $lu, select(share, 1.0 - share, $l == 0), f.uv);
                    let t = by_parity(at, map.bands, finer + $lu, f.uv);
                    //#for s in 0..4
                    let to$s = select(map.band_offset + stride * t.texel[$s], NONE, last);
                    let stays$s = band_held$l_$s == to$s;
                    if !stays$s && band_held$l_$s != NONE {
                        //#for k in 0..BANDS
                        if $ku + 1u < terms {
                            add_band_gradient(band_held$l_$s + 3u * $ku, band_sum$l_$s_$k.x);
                            add_band_gradient(band_held$l_$s + 3u * $ku + 1u, band_sum$l_$s_$k.y);
                            add_band_gradient(band_held$l_$s + 3u * $ku + 2u, band_sum$l_$s_$k.z);
                        }
                        //#end
                    }
                    //#for k in 0..BANDS
                    band_sum$l_$s_$k = select(vec3f(0.0), band_sum$l_$s_$k, stays$s) + t.weight[$s] * band_g$k;
                    //#end
                    band_held$l_$s = to$s;
                    //#end
                }
            }
            //#end
            //#end
        }
        if last { break; }
    }
}
