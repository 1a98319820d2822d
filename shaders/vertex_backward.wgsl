// One thread per pixel and layer: the gradient of the fragment's uv by its triangle's vertices, along their normals.
// Three atomic additions per fragment; 140 bytes read.

//#import shared/view.wgsl
//#import shared/mesh_fragment.wgsl

@group(0) @binding(5) var<storage, read> layer_gradient: array<vec4f>;  // [L, h, w]: of uv, see uv_backward
@group(0) @binding(6) var<storage, read> corner_normals: array<vec4u>;  // [F, 3]: world, unit, bits of floats; w: vertex
//#import shared/atomic_add.wgsl with TARGET=vertex_gradient BINDING=7

@compute @workgroup_size(256)
fn backward(
    @builtin(workgroup_id) group: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let i = group_index(group) * 256u + thread;
    let area = view.size.x * view.size.y;
    if i >= LAYERS * area || layer_triangle[i] == 0u { return; }
    let triangle = layer_triangle[i] - 1u;
    let d_uv = layer_gradient[i].xy;
    if all(d_uv == vec2f(0.0)) { return; }
    let pixel = vec2f(f32(i % area % view.size.x), f32(i % area / view.size.x));
    let ray = vec3f((pixel + 0.5 - view.principal) / view.focal, 1.0);
    let v0 = corners[3u * triangle].xyz;
    let v1 = corners[3u * triangle + 1u].xyz;
    let v2 = corners[3u * triangle + 2u].xyz;
    // As in `fragment`: relative to the ray, which keeps f32 exact far from the origin.
    let w0 = v0.xy - v0.z * ray.xy;
    let w1 = v1.xy - v1.z * ray.xy;
    let w2 = v2.xy - v2.z * ray.xy;
    let a = vec3f(cross2(w1, w2), cross2(w2, w0), cross2(w0, w1));
    let sum = a.x + a.y + a.z;
    if sum == 0.0 { return; }
    let uv01 = bitcast<vec4f>(corner_uvs[2u * triangle]);
    let uv2 = bitcast<vec2f>(corner_uvs[2u * triangle + 1u].xy);
    let gamma = vec3f(dot(d_uv, uv01.xy), dot(d_uv, uv01.zw), dot(d_uv, uv2));
    let kappa = (gamma - dot(gamma, a) / sum) / sum;
    // v × r in the same relative coordinates.
    let x0 = cross(v0, ray);
    let x1 = cross(v1, ray);
    let x2 = cross(v2, ray);
    let d = array<vec3f, 3>(kappa.z * x1 - kappa.y * x2, kappa.x * x2 - kappa.z * x0, kappa.y * x0 - kappa.x * x1);
    for (var k = 0u; k < 3u; k += 1u) {
        let n = corner_normals[3u * triangle + k];
        let world = d[k].x * view.row_x.xyz + d[k].y * view.row_y.xyz + d[k].z * view.row_z.xyz;
        add_vertex_gradient(n.w, dot(world, bitcast<vec3f>(n.xyz)));
    }
}
