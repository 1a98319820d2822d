// One thread per pixel and layer: colour and alpha of the mesh fragment there, or zeros.
//
// colour = max(0, 0.5 + Σ Y_k(direction) T_k(uv)), alpha = min(σ(A(uv)), 1 − 1e-4). Reads 4 bytes; per
// fragment 80 bytes of triangle, and per texel (4 if magnified, else 8) 16 bytes of base and 12·((d+1)²−1) of bands
// at SH degree d: 96 at d = 2. About 200 flops + 6 per float of texels. Writes 16 bytes.

//#import shared/view.wgsl
//#import shared/sh.wgsl
//#import shared/mesh_fragment.wgsl

@group(0) @binding(5) var<storage, read> base_texels: array<vec4f>;     // [texels]: DC rgb, opacity logit
// [texels, (d+1)²−1, 3]. If texels begin at multiples of four floats, as at degree 2 only, they are read as vectors: a
// software adapter executes lanes in turn, and loads a vector of four in the time of two single floats.
//#if FOURS
@group(0) @binding(6) var<storage, read> band_texels: array<vec4f>;
//#else
@group(0) @binding(6) var<storage, read> band_texels: array<f32>;
//#end
@group(0) @binding(7) var<storage, read_write> layer_color: array<vec4f>;   // [LAYERS, h, w]: rgb, alpha

fn sample_base(pyramid: Pyramid, f: Fragment) -> vec4f {
    let level = mip_level(f, pyramid);
    let finer = u32(level);
    let share = level - f32(finer);
    var sum = vec4f(0.0);
    for (var i = 0u; i < 2u; i += 1u) {
        if i == 1u && share == 0.0 { break; }
        let t = taps(pyramid, finer + i, select(share, 1.0 - share, i == 0u), f.uv);
        sum += t.weight.x * base_texels[t.texel.x] + t.weight.y * base_texels[t.texel.y]
            + t.weight.z * base_texels[t.texel.z] + t.weight.w * base_texels[t.texel.w];
    }
    return sum;
}

//#if BANDS
//#if FOURS
// Sum of four coefficients times their basis functions y, from vector i on.
fn four_rgb(y: vec4f, i: u32) -> vec3f {
    let a = band_texels[i];
    let b = band_texels[i + 1u];
    let c = band_texels[i + 2u];
    return y.x * a.xyz + y.y * vec3f(a.w, b.xy) + y.z * vec3f(b.zw, c.x) + y.w * c.yzw;
}
//#else
fn band_rgb(i: u32) -> vec3f {
    return vec3f(band_texels[i], band_texels[i + 1u], band_texels[i + 2u]);
}
//#end

// Σ_k≥1 Y_k T_k.
fn sample_bands(map: Maps, f: Fragment, degree: u32) -> vec3f {
    let basis = sh_basis(f.direction);
    let level = mip_level(f, map.bands);
    let finer = u32(level);
    let share = level - f32(finer);
    let stride = 3u * ((map.degree + 1u) * (map.degree + 1u) - 1u);
    //#if FOURS
    let low = vec4f(basis[1], basis[2], basis[3], select(0.0, basis[4], degree >= 2u));
    let high = select(vec4f(0.0), vec4f(basis[5], basis[6], basis[7], basis[8]), degree >= 2u);
    //#end
    var sum = vec3f(0.0);
    for (var i = 0u; i < 2u; i += 1u) {
        if i == 1u && share == 0.0 { break; }
        let t = taps(map.bands, finer + i, select(share, 1.0 - share, i == 0u), f.uv);
        for (var k = 0u; k < 4u; k += 1u) {
            let texel = map.band_offset + stride * t.texel[k];
            //#if FOURS
            let rgb = four_rgb(low, texel / 4u) + four_rgb(high, texel / 4u + 3u);
            //#else
            var rgb = vec3f(0.0);
            //#for k in 1..4
            rgb += basis[$k] * band_rgb(texel + 3u * ($ku - 1u));
            //#end
            if degree >= 2u {
                //#for k in 4..9
                rgb += basis[$k] * band_rgb(texel + 3u * ($ku - 1u));
                //#end
            }
            if degree >= 3u {
                //#for k in 9..16
                rgb += basis[$k] * band_rgb(texel + 3u * ($ku - 1u));
                //#end
            }
            //#end
            sum += t.weight[k] * rgb;
        }
    }
    return sum;
}
//#end

@compute @workgroup_size(256)
fn shade(
    @builtin(workgroup_id) group: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let i = group_index(group) * 256u + thread;
    let area = view.size.x * view.size.y;
    if i >= LAYERS * area { return; }
    let triangle = layer_triangle[i];
    if triangle == 0u {
        layer_color[i] = vec4f(0.0);
        return;
    }
    let pixel = i % area;
    let f = fragment(vec2u(pixel % view.size.x, pixel / view.size.x), triangle - 1u);
    let map = maps[f.mesh];
    let base = sample_base(map.base, f);
    var rgb = vec3f(0.5) + SH_C0 * base.rgb;
    //#if BANDS
    let degree = min(map.degree, view.band_degree);
    if degree > 0u {
        rgb += sample_bands(map, f, degree);
    }
    //#end
    layer_color[i] = vec4f(max(rgb, vec3f(0.0)), min(1.0 / (1.0 + exp(-base.a)), MESH_ALPHA_CAP));
}
