// One thread per triangle: camera-space corners and the bins its visible part can touch.
//
// Reads 16 bytes of indices and 36 of positions, writes 48 + 8 bytes. About 90 flops.

//#import shared/view.wgsl
//#import shared/finite.wgsl

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> positions: array<f32>;         // [V, 3], world
@group(0) @binding(2) var<storage, read> triangles: array<vec4u>;       // [F]: three vertices, unused
@group(0) @binding(3) var<storage, read_write> corners: array<vec4f>;   // [F, 3]: camera space; w: see below
@group(0) @binding(4) var<storage, read_write> boxes: array<vec2u>;     // [F]: first and last bin, x | y << 16

const NOWHERE: vec2u = vec2u(1u, 0u);   // first bin (1, 0), last bin (0, 0): empty

fn position(i: u32) -> vec3f {
    return vec3f(positions[3u * i], positions[3u * i + 1u], positions[3u * i + 2u]);
}

// +1 if edge a→b is traversed in its canonical direction, decided by position, as vertices may be copies, along seams
// and hard edges. Both triangles of an edge evaluate it in that direction and multiply by this sign, so they agree
// exactly on which side a pixel is, whatever the adapter's rounding.
fn direction(a: vec3f, b: vec3f) -> f32 {
    let is_before = select(select(a.z < b.z, a.y < b.y, a.y != b.y), a.x < b.x, a.x != b.x);
    return select(-1.0, 1.0, is_before);
}

struct Box {
    low: vec2f,
    high: vec2f,
}

fn include(box: Box, p: vec3f) -> Box {
    let uv = view.focal * p.xy / p.z + view.principal;
    return Box(min(box.low, uv), max(box.high, uv));
}

// Includes the part of edge a→b in front of the near plane: its first end and its intersection.
fn include_edge(box: Box, a: vec3f, b: vec3f) -> Box {
    var result = box;
    if a.z > view.near {
        result = include(result, a);
    }
    if (a.z > view.near) != (b.z > view.near) {
        let t = (view.near - a.z) / (b.z - a.z);
        result = include(result, vec3f(mix(a.xy, b.xy, t), view.near));
    }
    return result;
}

@compute @workgroup_size(256)
fn setup(
    @builtin(workgroup_id) group: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let i = group_index(group) * 256u + thread;
    if i >= view.n_triangles { return; }
    let t = triangles[i];
    let world = array(position(t.x), position(t.y), position(t.z));
    let a = to_camera(view, world[0]);
    let b = to_camera(view, world[1]);
    let c = to_camera(view, world[2]);
    // The sign of corner k belongs to the edge opposite to it.
    corners[3u * i] = vec4f(a, direction(world[1], world[2]));
    corners[3u * i + 1u] = vec4f(b, direction(world[2], world[0]));
    corners[3u * i + 2u] = vec4f(c, direction(world[0], world[1]));

    boxes[i] = NOWHERE;
    // Tested by bits, as a compiler may assume that comparisons never see NaN.
    if !(are_finite(vec4f(a, 0.0)) && are_finite(vec4f(b, 0.0)) && are_finite(vec4f(c, 0.0))) { return; }
    if max(a.z, max(b.z, c.z)) <= view.near { return; }
    var box = Box(vec2f(3e38), vec2f(-3e38));
    box = include_edge(box, a, b);
    box = include_edge(box, b, c);
    box = include_edge(box, c, a);
    let size = vec2f(view.size);
    if !(all(box.high >= vec2f(0.0)) && all(box.low < size)) { return; }
    // Only pixel centres count, half a pixel inside their bin, which gives a margin for rounding at no cost.
    let first = vec2u(max(box.low, vec2f(0.0))) / BIN;
    let last = min(vec2u(min(box.high, size)) / BIN, (view.size - 1u) / BIN);
    boxes[i] = vec2u(first.x | (first.y << 16u), last.x | (last.y << 16u));
}
