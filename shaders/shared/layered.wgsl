// The parts of one pixel, blended front to back: contributions of splats and of meshes, and their depths. The host's
// side is `render/gpu/layered.rs`, which reads PARTS vectors per pixel and binds these buffers for either image model.
//
// On adapters that limit loops, a dispatch begins no further walk through a tile's list after PATIENCE entries, and the
// next dispatch continues from there.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> ranges: array<vec2u>;
@group(0) @binding(2) var<storage, read> pair_splats: array<u32>;
@group(0) @binding(3) var<storage, read> projected: array<vec4f>;
@group(0) @binding(4) var<storage, read_write> layered: array<vec4f>;       // [pixel][PARTS]
//#if LAYERS
@group(0) @binding(5) var<storage, read> layer_depth: array<f32>;
@group(0) @binding(6) var<storage, read> layer_color: array<vec4f>;
@group(0) @binding(7) var<storage, read> layer_triangle: array<u32>;
@group(0) @binding(8) var<storage, read> corners: array<vec4f>;
//#end

//#if PATIENCE
struct Progress {
    unfinished: atomic<u32>,            // 1: some pixels are
    pixels: array<vec4u>,               // 0 at first, UNFINISHED or FINISHED; and what else goes on
}
@group(0) @binding(11) var<storage, read_write> progress: Progress;
const UNFINISHED: u32 = 1u;
const FINISHED: u32 = 2u;
//#end

struct Layered {
    splats: vec4f,                      // rgb · weight, Σ weight
    mesh: vec4f,
    depth: f32,                         // Σ weight · depth
    median: f32,                        // depth at which the transmittance falls below one half
    count: f32,                         // splats
    transmittance: f32,
}

fn nothing() -> Layered {
    return Layered(vec4f(0.0), vec4f(0.0), 0.0, 0.0, 0.0, 1.0);
}

// Adds a contribution behind all so far; returns the premultiplied colour and weight.
fn add(into: ptr<function, Layered>, alpha: f32, color: vec3f, depth: f32) -> vec4f {
    let weight = (*into).transmittance * alpha;
    let after = (*into).transmittance * (1.0 - alpha);
    (*into).depth += weight * depth;
    if (*into).transmittance >= 0.5 && after < 0.5 { (*into).median = depth; }
    (*into).transmittance = after;
    return vec4f(weight * color, weight);
}

fn add_splat(into: ptr<function, Layered>, alpha: f32, color: vec3f, depth: f32) {
    (*into).splats += add(into, alpha, color, depth);
    (*into).count += 1.0;
}

fn add_fragment(into: ptr<function, Layered>, layer: vec4f, depth: f32) {
    (*into).mesh += add(into, layer.w, layer.xyz, depth);
}

//#if PATIENCE
// Saves a pixel's state for the next dispatch, with the words `more` that it continues from.
fn keep(pixel: u32, parts: Layered, is_finished: bool, more: vec3u) {
    progress.pixels[pixel] = vec4u(select(UNFINISHED, FINISHED, is_finished), more);
    if is_finished { return; }
    atomicStore(&progress.unfinished, 1u);
    layered[PARTS * pixel] = parts.splats;
    layered[PARTS * pixel + 1u] = parts.mesh;
    layered[PARTS * pixel + 2u] = vec4f(parts.depth, parts.median, parts.count, parts.transmittance);
}

fn kept_parts(pixel: u32) -> Layered {
    let of_all = layered[PARTS * pixel + 2u];
    return Layered(layered[PARTS * pixel], layered[PARTS * pixel + 1u], of_all.x, of_all.y, of_all.z, of_all.w);
}
//#end

fn write_parts(pixel: u32, parts: Layered, normal: vec3f) {
    let weight = parts.splats.w + parts.mesh.w;
    let expected = select(0.0, parts.depth / weight, weight > 0.0);
    layered[PARTS * pixel] = parts.splats;
    layered[PARTS * pixel + 1u] = parts.mesh;
    layered[PARTS * pixel + 2u] = vec4f(expected, parts.median, parts.count, parts.transmittance);
    layered[PARTS * pixel + 3u] = vec4f(normal, 0.0);
}

//#if LAYERS
// Unit normal of the nearest fragment of a pixel, facing the camera, in world space.
fn front_normal(pixel: vec2u) -> vec3f {
    let triangle = layer_triangle[pixel.y * view.size.x + pixel.x];
    if triangle == 0u { return vec3f(0.0); }
    let a = corners[3u * (triangle - 1u)].xyz;
    let b = corners[3u * (triangle - 1u) + 1u].xyz;
    let c = corners[3u * (triangle - 1u) + 2u].xyz;
    let ray = vec3f((vec2f(pixel) + 0.5 - view.principal) / view.focal, 1.0);
    let across = cross(b - a, c - a);
    let normal = across * (select(1.0, -1.0, dot(across, ray) > 0.0) / max(length(across), 1e-30));
    return normal.x * view.row_x.xyz + normal.y * view.row_y.xyz + normal.z * view.row_z.xyz;
}
//#end
