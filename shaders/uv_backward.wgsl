// One thread per pixel and layer: converts the gradient of the fragment's colour and alpha to that of its triangle's
// vertices, along their normals, in place; vertex_backward adds them up.
//
// ∂L/∂uv = Σ over taps of (∂weight/∂uv) · (∂L/∂sample · texel), at constant mip level. Must follow
// texel_backward, which reads the gradient that is overwritten here. Reads what shade_layers reads and 160 bytes,
// writes 16.

//#import shared/view.wgsl
//#import shared/sh.wgsl
//#import shared/mesh_fragment.wgsl

@group(0) @binding(5) var<storage, read> base_texels: array<vec4f>;     // [texels]: DC rgb, opacity logit
@group(0) @binding(6) var<storage, read_write> layer_gradient: array<vec4f>;    // [L, h, w]: of rgb, alpha → of three
                                                                                // vertices
@group(0) @binding(7) var<storage, read> corner_normals: array<vec4u>;  // [F, 3]: world, unit, bits of floats; w:
                                                                        // vertex
//#if BANDS
@group(0) @binding(8) var<storage, read> band_texels: array<f32>;       // [texels, (d+1)²−1, 3]
//#end

struct Slopes {
    texel: vec4u,
    weight: vec4f,
    du: vec4f,      // ∂weight/∂u
    dv: vec4f,
}

fn slopes(pyramid: Pyramid, level: u32, share: f32, uv: vec2f) -> Slopes {
    let t = taps(pyramid, level, share, uv);
    let size = vec2f(pyramid.size >> vec2u(level));
    let f = fract(uv * size - 0.5);
    let du = share * size.x * vec4f(f.y - 1.0, 1.0 - f.y, -f.y, f.y);
    let dv = share * size.y * vec4f(f.x - 1.0, -f.x, 1.0 - f.x, f.x);
    return Slopes(t.texel, t.weight, du, dv);
}

struct Sample {
    value: vec4f,
    du: vec4f,
    dv: vec4f,
}

fn sample_base(pyramid: Pyramid, f: Fragment) -> Sample {
    let level = mip_level(f, pyramid);
    let finer = u32(level);
    let share = level - f32(finer);
    var sum = Sample(vec4f(0.0), vec4f(0.0), vec4f(0.0));
    for (var i = 0u; i < 2u; i += 1u) {
        if i == 1u && share == 0.0 { break; }
        let s = slopes(pyramid, finer + i, select(share, 1.0 - share, i == 0u), f.uv);
        for (var k = 0u; k < 4u; k += 1u) {
            let texel = base_texels[s.texel[k]];
            sum.value += s.weight[k] * texel;
            sum.du += s.du[k] * texel;
            sum.dv += s.dv[k] * texel;
        }
    }
    return sum;
}

//#if BANDS
// Σ_k≥1 Y_k T_k of one texel.
fn band_rgb(texel: u32, basis: array<f32, 16>, degree: u32) -> vec3f {
    var rgb = vec3f(0.0);
    for (var k = 1u; k < (degree + 1u) * (degree + 1u); k += 1u) {
        let i = texel + 3u * (k - 1u);
        rgb += basis[k] * vec3f(band_texels[i], band_texels[i + 1u], band_texels[i + 2u]);
    }
    return rgb;
}

fn sample_bands(map: Maps, f: Fragment, degree: u32) -> Sample {
    let basis = sh_basis(f.direction);
    let level = mip_level(f, map.bands);
    let finer = u32(level);
    let share = level - f32(finer);
    let stride = 3u * ((map.degree + 1u) * (map.degree + 1u) - 1u);
    var sum = Sample(vec4f(0.0), vec4f(0.0), vec4f(0.0));
    for (var i = 0u; i < 2u; i += 1u) {
        if i == 1u && share == 0.0 { break; }
        let s = slopes(map.bands, finer + i, select(share, 1.0 - share, i == 0u), f.uv);
        for (var k = 0u; k < 4u; k += 1u) {
            let rgb = vec4f(band_rgb(map.band_offset + stride * s.texel[k], basis, degree), 0.0);
            sum.value += s.weight[k] * rgb;
            sum.du += s.du[k] * rgb;
            sum.dv += s.dv[k] * rgb;
        }
    }
    return sum;
}
//#end

// Gradient along the vertices' normals from the gradient by the UV where the pixel's ray meets the triangle.
fn by_vertices(d_uv: vec2f, pixel: u32, triangle: u32) -> vec3f {
    if all(d_uv == vec2f(0.0)) { return vec3f(0.0); }
    let at = vec2f(f32(pixel % view.size.x), f32(pixel / view.size.x));
    let ray = vec3f((at + 0.5 - view.principal) / view.focal, 1.0);
    let v0 = corners[3u * triangle].xyz;
    let v1 = corners[3u * triangle + 1u].xyz;
    let v2 = corners[3u * triangle + 2u].xyz;
    // As in `fragment`: relative to the ray, which keeps f32 exact far from the origin.
    let w0 = v0.xy - v0.z * ray.xy;
    let w1 = v1.xy - v1.z * ray.xy;
    let w2 = v2.xy - v2.z * ray.xy;
    let a = vec3f(cross2(w1, w2), cross2(w2, w0), cross2(w0, w1));
    let sum = a.x + a.y + a.z;
    if sum == 0.0 { return vec3f(0.0); }
    let uv01 = bitcast<vec4f>(corner_uvs[2u * triangle]);
    let uv2 = bitcast<vec2f>(corner_uvs[2u * triangle + 1u].xy);
    let gamma = vec3f(dot(d_uv, uv01.xy), dot(d_uv, uv01.zw), dot(d_uv, uv2));
    let kappa = (gamma - dot(gamma, a) / sum) / sum;
    // v × r in the same relative coordinates.
    let x0 = cross(v0, ray);
    let x1 = cross(v1, ray);
    let x2 = cross(v2, ray);
    let d = array<vec3f, 3>(kappa.z * x1 - kappa.y * x2, kappa.x * x2 - kappa.z * x0, kappa.y * x0 - kappa.x * x1);
    var along: array<f32, 3>;
    for (var k = 0u; k < 3u; k += 1u) {
        let world = d[k].x * view.row_x.xyz + d[k].y * view.row_y.xyz + d[k].z * view.row_z.xyz;
        along[k] = dot(world, bitcast<vec3f>(corner_normals[3u * triangle + k].xyz));
    }
    return vec3f(along[0], along[1], along[2]);
}

@compute @workgroup_size(256)
fn backward(
    @builtin(workgroup_id) group: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let i = group_index(group) * 256u + thread;
    let area = view.size.x * view.size.y;
    if i >= LAYERS * area { return; }
    let triangle = layer_triangle[i];
    if triangle == 0u { return; }
    let gradient = layer_gradient[i];
    if all(gradient == vec4f(0.0)) { return; }
    let pixel = i % area;
    let f = fragment(vec2u(pixel % view.size.x, pixel / view.size.x), triangle - 1u);
    let map = maps[f.mesh];
    // The zeroth basis function is a constant, by which base texels are multiplied to give colours.
    let scale = vec4f(vec3f(SH_C0), 1.0);
    let base = sample_base(map.base, f);
    var value = scale * base.value + vec4f(vec3f(0.5), 0.0);
    var du = scale * base.du;
    var dv = scale * base.dv;
    //#if BANDS
    let degree = min(map.degree, view.band_degree);
    if degree > 0u {
        let bands = sample_bands(map, f, degree);
        value += bands.value;
        du += bands.du;
        dv += bands.dv;
    }
    //#end
    let alpha = 1.0 / (1.0 + exp(-value.a));
    let g = vec4f(
        select(vec3f(0.0), gradient.rgb, value.rgb > vec3f(0.0)),
        select(0.0, gradient.a * alpha * (1.0 - alpha), alpha < MESH_ALPHA_CAP),
    );
    layer_gradient[i] = vec4f(by_vertices(vec2f(dot(g, du), dot(g, dv)), pixel, triangle - 1u), 0.0);
}
