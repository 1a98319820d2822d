// A mesh fragment: intersection of a pixel's ray with the triangle of one layer, and the texels that it sees (mip
// levels as in nvdiffrast). Shared by shade_layers, both texel_backward and uv_backward, so that the gradient goes
// exactly where the colour came from.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> layer_triangle: array<u32>;    // [LAYERS, h, w], index + 1, 0 = empty
@group(0) @binding(2) var<storage, read> corners: array<vec4f>;         // [F, 3], camera space; w unused here
// [F, 2]: UV of corners 0 and 1; UV of corner 2, mesh, 0. Stored as the floats' bits, since small integers may not
// survive as floats: adapters flush denormals to 0.
@group(0) @binding(3) var<storage, read> corner_uvs: array<vec4u>;
@group(0) @binding(4) var<storage, read> maps: array<Maps>;             // [meshes]

// Change of UV per pixel that counts as edge-on: more than every texel of the largest map; squares stay finite.
const MAX_SLOPE: f32 = 1e6;

// A mip pyramid: level 0, then level 1, …, each row-major.
struct Pyramid {
    offset: u32,        // of level 0, texels
    levels: u32,
    size: vec2u,        // of level 0, texels
}

struct Maps {
    base: Pyramid,
    bands: Pyramid,
    band_offset: u32,   // of the bands' level 0, floats
    degree: u32,        // SH degree, 0: no bands
    unused: vec2u,
}

struct Fragment {
    mesh: u32,
    uv: vec2f,
    uv_x: vec2f,        // change of uv per pixel to the right
    uv_y: vec2f,        // and down
    direction: vec3f,   // camera → fragment, world, unit
}

// The four texels around a point of one mip level, with their trilinear weights.
struct Taps {
    texel: vec4u,
    weight: vec4f,
}

fn cross2(a: vec2f, b: vec2f) -> f32 {
    return a.x * b.y - a.y * b.x;
}

fn fragment(pixel: vec2u, triangle: u32) -> Fragment {
    let ray = (vec2f(pixel) + 0.5 - view.principal) / view.focal;
    let v0 = corners[3u * triangle].xyz;
    let v1 = corners[3u * triangle + 1u].xyz;
    let v2 = corners[3u * triangle + 2u].xyz;
    let w0 = v0.xy - v0.z * ray;
    let w1 = v1.xy - v1.z * ray;
    let w2 = v2.xy - v2.z * ray;
    let a = vec3f(cross2(w1, w2), cross2(w2, w0), cross2(w0, w1));
    let a_x = vec3f(v2.z * w1.y - v1.z * w2.y, v0.z * w2.y - v2.z * w0.y, v1.z * w0.y - v0.z * w1.y) / view.focal.x;
    let a_y = vec3f(v1.z * w2.x - v2.z * w1.x, v2.z * w0.x - v0.z * w2.x, v0.z * w1.x - v1.z * w0.x) / view.focal.y;
    let sum = a.x + a.y + a.z;
    // The rasteriser found this pixel inside; rounding must neither leave the triangle nor divide by zero.
    let inverse = select(0.0, 1.0 / sum, sum != 0.0);
    let b = clamp(a * inverse, vec3f(0.0), vec3f(1.0));
    let b_x = (a_x - b * (a_x.x + a_x.y + a_x.z)) * inverse;
    let b_y = (a_y - b * (a_y.x + a_y.y + a_y.z)) * inverse;
    let uv01 = bitcast<vec4f>(corner_uvs[2u * triangle]);
    let uv2_mesh = corner_uvs[2u * triangle + 1u];
    let to_uv = mat3x2f(uv01.xy, uv01.zw, bitcast<vec2f>(uv2_mesh.xy));
    let toward = ray.x * view.row_x.xyz + ray.y * view.row_y.xyz + view.row_z.xyz;
    return Fragment(
        uv2_mesh.z,
        to_uv * b,
        clamp(to_uv * b_x, vec2f(-MAX_SLOPE), vec2f(MAX_SLOPE)),
        clamp(to_uv * b_y, vec2f(-MAX_SLOPE), vec2f(MAX_SLOPE)),
        normalize(toward),
    );
}

// log2 of the footprint's longer axis in texels of level 0, clamped to the levels there are.
fn mip_level(f: Fragment, pyramid: Pyramid) -> f32 {
    let x = f.uv_x * vec2f(pyramid.size);
    let y = f.uv_y * vec2f(pyramid.size);
    let half_difference = 0.5 * (dot(x, x) - dot(y, y));
    let longest = 0.5 * (dot(x, x) + dot(y, y)) + length(vec2f(half_difference, dot(x, y)));
    return clamp(0.5 * log2(max(longest, 1e-30)), 0.0, f32(pyramid.levels - 1u));
}

fn taps(pyramid: Pyramid, level: u32, share: f32, uv: vec2f) -> Taps {
    let size = pyramid.size >> vec2u(level);
    // Every level is exactly a quarter of the one before: a geometric series.
    let offset = pyramid.offset + (pyramid.size.x * pyramid.size.y - size.x * size.y) / 3u * 4u;
    let st = uv * vec2f(size) - 0.5;
    let low = floor(st);
    let f = st - low;
    let last = vec2f(size - 1u);
    let i = vec2u(clamp(low, vec2f(0.0), last));
    let j = vec2u(clamp(low + 1.0, vec2f(0.0), last));
    return Taps(
        offset + vec4u(i.y * size.x + i.x, i.y * size.x + j.x, j.y * size.x + i.x, j.y * size.x + j.x),
        share * vec4f((1.0 - f.x) * (1.0 - f.y), f.x * (1.0 - f.y), (1.0 - f.x) * f.y, f.x * f.y),
    );
}
