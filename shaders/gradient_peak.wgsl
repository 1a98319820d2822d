// The largest of what the fragments' gradients hold, whichever way, as the bits of a positive float: NaN is larger than
// all. It sets the unit of sums in fixed point. FRAGMENTS to a thread, 20 bytes read per pixel and layer; for MAPS 100 more per
// fragment of one row in ROWS.
//
// For MAPS a gradient counts times `crowd`: of the pixels that see one texel, n where they see it as this one does, each then has a
// gradient of CROWD/n of the largest at most, and all together CROWD of it, however large the texel is in the picture. One row in ROWS says so
// for all, as it takes many pixels to matter; in a loop of its own, since a software adapter goes through branches that no lane takes.

//#import shared/view.wgsl
//#if MAPS
//#import shared/mesh_fragment.wgsl
@group(0) @binding(5) var<storage, read> layer_gradient: array<vec4f>;  // [L, h, w]
@group(0) @binding(6) var<storage, read_write> peaks: array<atomic<u32>>;

// Pixels of a texel of the base map, of one that bands have, up to which their sum has room several times over (see fixed_point.wgsl):
// each layer and each chart that lies on the same texel adds its own.
const CROWD: f32 = 1024.0;
const BAND_CROWD: f32 = 2048.0;
const ROWS: u32 = 8u;

// Pixels that see a texel as this fragment sees its own, of the coarser of its mip levels; at most those of the picture.
fn pixels_of_texel(f: Fragment, pyramid: Pyramid) -> f32 {
    let seen = abs(cross2(f.uv_x * vec2f(pyramid.size), f.uv_y * vec2f(pyramid.size)));
    let area = exp2(2.0 * ceil(mip_level(f, pyramid)));         // of that texel, in those of level 0
    return area / max(seen, area / f32(view.size.x * view.size.y));
}

fn crowd(i: u32) -> f32 {
    let pixel = i % (view.size.x * view.size.y);
    let f = fragment(vec2u(pixel % view.size.x, pixel / view.size.x), layer_triangle[i] - 1u);
    let map = maps[f.mesh];
    var most = pixels_of_texel(f, map.base) / CROWD;
//#if BANDS
    if min(map.degree, view.band_degree) > 0u { most = max(most, pixels_of_texel(f, map.bands) / BAND_CROWD); }
//#end
    return select(1.0, most, most > 1.0);                       // also where it is not a number
}
//#else
@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> layer_triangle: array<u32>;    // [L, h, w], index + 1
@group(0) @binding(2) var<storage, read> layer_gradient: array<vec4f>;  // [L, h, w]
@group(0) @binding(3) var<storage, read_write> peaks: array<atomic<u32>>;
//#end

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
//#if MAPS
    let rows = max(view.size.y / ROWS, 1u);
    for (var k = 0u; k < FRAGMENTS / ROWS; k += 1u) {
        let j = (group_index(group) * (FRAGMENTS / ROWS) + k) * 256u + thread;
        let row = j / view.size.x;      // of those that are looked at, of all layers
        let i = (row / rows * view.size.y + row % rows * ROWS) * view.size.x + j % view.size.x;
        if row < LAYERS * rows && layer_triangle[i] != 0u {
            most = max(most, bitcast<vec4u>(crowd(i) * abs(layer_gradient[i])));
        }
    }
//#end
    atomicMax(&largest, max(max(most.x, most.y), max(most.z, most.w)));
    workgroupBarrier();
    if thread == 0u { atomicMax(&peaks[PEAK], atomicLoad(&largest)); }
}
