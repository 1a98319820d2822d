// One thread per pixel and layer: adds the gradient from uv_backward to the triangle's vertices. Three to six atomic
// additions of integers per fragment, three where sums keep their sign; 68 bytes read.

//#import shared/view.wgsl
//#import shared/fixed_point.wgsl

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> layer_triangle: array<u32>;    // [L, h, w], index + 1
@group(0) @binding(2) var<storage, read> layer_gradient: array<vec4f>;  // [L, h, w]: of the triangle's vertices
@group(0) @binding(3) var<storage, read> corner_normals: array<vec4u>;  // [F, 3]; w: vertex
@group(0) @binding(4) var<storage, read> peaks: array<u32>;             // see fixed_point.wgsl
@group(0) @binding(5) var<storage, read_write> vertex_gradient: array<atomic<u32>>;   // [V, 2], see fixed_point.wgsl

@compute @workgroup_size(256)
fn backward(
    @builtin(workgroup_id) group: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let i = group_index(group) * 256u + thread;
    if i >= LAYERS * view.size.x * view.size.y || layer_triangle[i] == 0u { return; }
    let triangle = layer_triangle[i] - 1u;
    let g = fixed_scale(peaks[1]) * layer_gradient[i].xyz;
    if all(g == vec3f(0.0)) { return; }
    for (var k = 0u; k < 3u; k += 1u) {
        let vertex = corner_normals[3u * triangle + k].w;
        let units = i32(round(g[k]));
        if units == 0 { continue; }
        // 64-bit addition in two words: the high one gets the sign of the term and the carry of the low one, which
        // often cancel.
        let low = bitcast<u32>(units);
        let before = atomicAdd(&vertex_gradient[2u * vertex], low);
        let high = u32(before + low < before) - u32(units < 0);
        if high != 0u { atomicAdd(&vertex_gradient[2u * vertex + 1u], high); }
    }
}
