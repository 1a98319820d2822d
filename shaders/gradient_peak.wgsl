// What sets the unit of sums in fixed point, as the bits of a positive float: NaN is larger than all. The largest of what the fragments'
// gradients hold, whichever way; or, with BOUND, by which a vertex is that may have any part of the picture on its triangles, FIXED_SHARE of
// what no sum of theirs exceeds: the largest sum of a workgroup's fragments times the workgroups. 20 bytes read per pixel and layer.

//#import shared/view.wgsl
//#import shared/fixed_point.wgsl

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> layer_triangle: array<u32>;    // [L, h, w], index + 1
@group(0) @binding(2) var<storage, read> layer_gradient: array<vec4f>;  // [L, h, w]
@group(0) @binding(3) var<storage, read_write> peaks: array<atomic<u32>>;

const FRAGMENTS: u32 = 16u;            // PEAK_FRAGMENTS in texels.rs is 256 times as many

//#if BOUND
var<workgroup> sums: array<f32, 256>;
//#else
var<workgroup> largest: atomic<u32>;
//#end

@compute @workgroup_size(256)
fn peak(
    @builtin(workgroup_id) group: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let fragments = LAYERS * view.size.x * view.size.y;
    let first = group_index(group) * FRAGMENTS * 256u + thread;
//#if BOUND
    var sum = 0.0;
    for (var k = 0u; k < FRAGMENTS; k += 1u) {
        let i = first + k * 256u;
        if i < fragments && layer_triangle[i] != 0u {
            let g = abs(layer_gradient[i]);
            sum += max(max(g.x, g.y), max(g.z, g.w));
        }
    }
    sums[thread] = sum;
    for (var half = 128u; half > 0u; half /= 2u) {
        workgroupBarrier();
        if thread < half { sums[thread] += sums[thread + half]; }
    }
    if thread == 0u {
        let groups = (fragments + FRAGMENTS * 256u - 1u) / (FRAGMENTS * 256u);
        atomicMax(&peaks[PEAK], bitcast<u32>(abs(sums[0] * f32(groups) * FIXED_SHARE)));
    }
//#else
    if thread == 0u { atomicStore(&largest, 0u); }
    workgroupBarrier();
    var most = vec4u(0u);
    for (var k = 0u; k < FRAGMENTS; k += 1u) {
        let i = first + k * 256u;
        if i < fragments && layer_triangle[i] != 0u {
            most = max(most, bitcast<vec4u>(abs(layer_gradient[i])));
        }
    }
    atomicMax(&largest, max(max(most.x, most.y), max(most.z, most.w)));
    workgroupBarrier();
    if thread == 0u { atomicMax(&peaks[PEAK], atomicLoad(&largest)); }
//#end
}
