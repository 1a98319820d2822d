// The largest magnitude among the fragments' gradients, as the bits of a positive float: NaN is larger than all. It
// sets the unit of sums in fixed point. FRAGMENTS per thread, 20 bytes read per pixel and layer; for MAPS another 100
// per fragment, for one in ONE_IN.
//
// For MAPS a gradient counts times `crowd`. If n pixels see one texel, each as this one does, each of them then has a
// gradient of at most CROWD/n of the largest, and all together CROWD of it, however large the texel is in the picture.
// A few pixels of a triangle whose corners coincide in the map would count as if they filled the picture: so crowded
// fragments are counted as well, as no more than that many see one texel (`map_peak`). A sample of one in ONE_IN
// suffices, as only many pixels matter; it has a loop of its own, since a software adapter executes branches that no
// lane takes.

//#import shared/view.wgsl
//#if MAPS
//#import shared/fixed_point.wgsl
//#import shared/mesh_fragment.wgsl
@group(0) @binding(5) var<storage, read> layer_gradient: array<vec4f>;  // [L, h, w]
@group(0) @binding(6) var<storage, read_write> peaks: array<atomic<u32>>;       // see fixed_point.wgsl

const ONE_IN: u32 = 8u;
const NONE: u32 = 0xffffffffu;

// Number of fragments sampled per row, counting rows as if extended to a multiple of 64.
fn looks_of_row() -> u32 {
    return (view.size.x + 63u) / 64u * 8u;
}

// Index of the j-th sampled fragment of all layers: of every 64 in a row eight neighbours, at a different offset in
// each of eight rows, so that thin structures along rows or across are sampled as densely as all else.
fn looked_at(j: u32) -> u32 {
    let row = j / looks_of_row();
    let k = j - row * looks_of_row();
    let column = k / 8u * 64u + 3u * row % 8u * 8u + k % 8u;
    return select(NONE, row * view.size.x + column, column < view.size.x);
}

// Number of pixels that see a texel of the coarser of its mip levels, if each sees it as this fragment does; at most
// those of the picture.
fn pixels_of_texel(f: Fragment, pyramid: Pyramid) -> f32 {
    let seen = abs(cross2(f.uv_x * vec2f(pyramid.size), f.uv_y * vec2f(pyramid.size)));
    let area = exp2(2.0 * ceil(mip_level(f, pyramid)));         // of that texel, in those of level 0
    return area / max(seen, area / f32(view.size.x * view.size.y));
}

// Factor by which these exceed the room of a sum, at least 1.
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

var<workgroup> largest_crowded: atomic<u32>;
var<workgroup> n_crowded: atomic<u32>;
//#else
@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> layer_triangle: array<u32>;    // [L, h, w], index + 1
@group(0) @binding(2) var<storage, read> layer_gradient: array<vec4f>;  // [L, h, w]
@group(0) @binding(3) var<storage, read_write> peaks: array<atomic<u32>>;       // see fixed_point.wgsl
//#end

var<workgroup> largest: atomic<u32>;

fn largest_of(v: vec4u) -> u32 {
    return max(max(v.x, v.y), max(v.z, v.w));
}

@compute @workgroup_size(256)
fn peak(
    @builtin(workgroup_id) group: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    if thread == 0u {
        atomicStore(&largest, 0u);
//#if MAPS
        atomicStore(&largest_crowded, 0u);
        atomicStore(&n_crowded, 0u);
//#end
    }
    workgroupBarrier();
    let n_fragments = LAYERS * view.size.x * view.size.y;
    let first = group_index(group) * FRAGMENTS * 256u + thread;
    var most = vec4u(0u);
    for (var k = 0u; k < FRAGMENTS; k += 1u) {
        let i = first + k * 256u;
        if i < n_fragments && layer_triangle[i] != 0u {
            most = max(most, bitcast<vec4u>(abs(layer_gradient[i])));
        }
    }
    atomicMax(&largest, largest_of(most));
//#if MAPS
    var crowded = vec4u(0u);
    var count = 0u;
    let n_groups = (n_fragments + FRAGMENTS * 256u - 1u) / (FRAGMENTS * 256u);
    let n_looks = LAYERS * view.size.y * looks_of_row();
    // Surplus groups that fill up the last row of a dispatch sample nothing.
    let first_look = select(n_looks, group_index(group) * 256u + thread, group_index(group) < n_groups);
    for (var j = first_look; j < n_looks; j += n_groups * 256u) {
        let i = looked_at(j);
        if i < n_fragments && layer_triangle[i] != 0u {
            let n = crowd(i);
            count += select(0u, ONE_IN, n > 1.0);
            crowded = max(crowded, bitcast<vec4u>(n * abs(layer_gradient[i])));
        }
    }
    atomicMax(&largest_crowded, largest_of(crowded));
    atomicAdd(&n_crowded, count);
//#end
    workgroupBarrier();
    if thread == 0u {
        atomicMax(&peaks[PEAK], atomicLoad(&largest));
//#if MAPS
        atomicMax(&peaks[2], atomicLoad(&largest_crowded));
        atomicAdd(&peaks[3], atomicLoad(&n_crowded));
//#end
    }
}
