// The largest of what the fragments' gradients hold, whichever way, as the bits of a positive float: NaN is larger than
// all. It sets the unit of sums in fixed point. FRAGMENTS to a thread, 20 bytes read per pixel and layer.

//#import shared/view.wgsl

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> layer_triangle: array<u32>;    // [L, h, w], index + 1
@group(0) @binding(2) var<storage, read> layer_gradient: array<vec4f>;  // [L, h, w]
@group(0) @binding(3) var<storage, read_write> peaks: array<atomic<u32>>;

var<workgroup> largest: atomic<u32>;

@compute @workgroup_size(256)
fn peak(
    @builtin(workgroup_id) group: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    if thread == 0u { atomicStore(&largest, 0u); }
    workgroupBarrier();
    let first = group_index(group) * FRAGMENTS * 256u + thread;
    var most = vec4u(0u);
    for (var k = 0u; k < FRAGMENTS; k += 1u) {
        let i = first + k * 256u;
        if i < LAYERS * view.size.x * view.size.y && layer_triangle[i] != 0u {
            most = max(most, bitcast<vec4u>(abs(layer_gradient[i])));
        }
    }
    atomicMax(&largest, max(max(most.x, most.y), max(most.z, most.w)));
    workgroupBarrier();
    if thread == 0u { atomicMax(&peaks[PEAK], atomicLoad(&largest)); }
}
