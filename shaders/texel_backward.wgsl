// One thread per pixel and layer: scatters the gradient of the fragment's colour and alpha to its texels.
//
// ∂T_k = Y_k ∂rgb where the channel is not clamped at 0, ∂A = α(1−α) ∂α where α is not clamped. Every texel gets that
// times its trilinear weight, also at coarse levels; pull_mips and adam_texels hand those down to level 0. No gradient
// flows to uv, mip level or direction (METHODS 4.5). Per fragment 112 bytes read, and per texel (4 or 8) 4 atomic
// additions to the base and 3·((d+1)²−1) to the bands: 24 at degree 2.

//#import shared/view.wgsl
//#import shared/sh.wgsl
//#import shared/mesh_fragment.wgsl

@group(0) @binding(5) var<storage, read> layer_color: array<vec4f>;     // [LAYERS, h, w]: rgb, alpha
@group(0) @binding(6) var<storage, read> layer_gradient: array<vec4f>;  // [LAYERS, h, w]: of the loss by these
//#import shared/atomic_add.wgsl with TARGET=base_gradient BINDING=7
//#if BANDS
//#import shared/atomic_add.wgsl with TARGET=band_gradient BINDING=8
//#end

fn scatter_base(pyramid: Pyramid, f: Fragment, g: vec4f) {
    let level = mip_level(f, pyramid);
    let finer = u32(level);
    let share = level - f32(finer);
    for (var i = 0u; i < 2u; i += 1u) {
        if i == 1u && share == 0.0 { break; }
        let t = taps(pyramid, finer + i, select(share, 1.0 - share, i == 0u), f.uv);
        for (var k = 0u; k < 4u; k += 1u) {
            let to = 4u * t.texel[k];
            let weight = t.weight[k];
            add_base_gradient(to, weight * g.x);
            add_base_gradient(to + 1u, weight * g.y);
            add_base_gradient(to + 2u, weight * g.z);
            add_base_gradient(to + 3u, weight * g.w);
        }
    }
}

//#if BANDS
fn add_rgb(to: u32, g: vec3f) {
    add_band_gradient(to, g.x);
    add_band_gradient(to + 1u, g.y);
    add_band_gradient(to + 2u, g.z);
}

fn scatter_bands(map: Maps, f: Fragment, degree: u32, g: vec3f) {
    let basis = sh_basis(f.direction);
    let level = mip_level(f, map.bands);
    let finer = u32(level);
    let share = level - f32(finer);
    let stride = 3u * ((map.degree + 1u) * (map.degree + 1u) - 1u);
    for (var i = 0u; i < 2u; i += 1u) {
        if i == 1u && share == 0.0 { break; }
        let t = taps(map.bands, finer + i, select(share, 1.0 - share, i == 0u), f.uv);
        for (var k = 0u; k < 4u; k += 1u) {
            let texel = map.band_offset + stride * t.texel[k];
            let wg = t.weight[k] * g;
            //#for k in 1..4
            add_rgb(texel + 3u * ($ku - 1u), basis[$k] * wg);
            //#end
            if degree >= 2u {
                //#for k in 4..9
                add_rgb(texel + 3u * ($ku - 1u), basis[$k] * wg);
                //#end
            }
            if degree >= 3u {
                //#for k in 9..16
                add_rgb(texel + 3u * ($ku - 1u), basis[$k] * wg);
                //#end
            }
        }
    }
}
//#end

@compute @workgroup_size(256)
fn backward(
    @builtin(workgroup_id) group: vec3u,
    @builtin(num_workgroups) n_groups: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let i = group_index(group, n_groups) * 256u + thread;
    let area = view.size.x * view.size.y;
    if i >= LAYERS * area { return; }
    let triangle = layer_triangle[i];
    if triangle == 0u { return; }
    let color = layer_color[i];
    let gradient = layer_gradient[i];
    let g = select(vec3f(0.0), gradient.rgb, color.rgb > vec3f(0.0));
    let g_logit = select(0.0, gradient.a * color.a * (1.0 - color.a), color.a < MAX_ALPHA);
    if all(g == vec3f(0.0)) && g_logit == 0.0 { return; }
    let pixel = i % area;
    let f = fragment(vec2u(pixel % view.size.x, pixel / view.size.x), triangle - 1u);
    let map = maps[f.mesh];
    scatter_base(map.base, f, vec4f(SH_C0 * g, g_logit));
    //#if BANDS
    let degree = min(map.degree, view.band_degree);
    if degree > 0u {
        scatter_bands(map, f, degree, g);
    }
    //#end
}
