// The largest of what the fragments' gradients hold, whichever way, as the bits of a positive float: NaN is larger than
// all. It sets the unit of sums in fixed point. FRAGMENTS to a thread, 20 bytes read per pixel and layer; for MAPS 100 more per
// fragment of one in ONE_IN.
//
// For MAPS a gradient counts times `crowd`: of the pixels that see one texel, n where they see it as this one does, each then has a
// gradient of CROWD/n of the largest at most, and all together CROWD of it, however large the texel is in the picture. A few pixels of a
// triangle whose corners have one place in the map would count as if they filled the picture: so the fragments that are crowded are counted,
// too, as no more of them than that see one texel (`map_peak`). One in ONE_IN says so for all, as it takes many pixels to matter; in a loop of
// its own, since a software adapter goes through branches that no lane takes.

//#import shared/view.wgsl
//#if MAPS
//#import shared/fixed_point.wgsl
//#import shared/mesh_fragment.wgsl
@group(0) @binding(5) var<storage, read> layer_gradient: array<vec4f>;  // [L, h, w]
@group(0) @binding(6) var<storage, read_write> peaks: array<atomic<u32>>;       // see fixed_point.wgsl

const ONE_IN: u32 = 8u;
const NONE: u32 = 0xffffffffu;

// Fragments that are looked at, or would be if rows went on to the next multiple of 64, of a row.
fn looks_of_row() -> u32 {
    return (view.size.x + 63u) / 64u * 8u;
}

// The j-th of all layers: of every 64 in a row eight neighbours, which have another place in each of eight rows, so that there are as
// many of what is thin, along rows or across, as of all else.
fn looked_at(j: u32) -> u32 {
    let row = j / looks_of_row();
    let k = j - row * looks_of_row();
    let column = k / 8u * 64u + 3u * row % 8u * 8u + k % 8u;
    return select(NONE, row * view.size.x + column, column < view.size.x);
}

// Pixels that see a texel as this fragment sees its own, of the coarser of its mip levels; at most those of the picture.
fn pixels_of_texel(f: Fragment, pyramid: Pyramid) -> f32 {
    let seen = abs(cross2(f.uv_x * vec2f(pyramid.size), f.uv_y * vec2f(pyramid.size)));
    let area = exp2(2.0 * ceil(mip_level(f, pyramid)));         // of that texel, in those of level 0
    return area / max(seen, area / f32(view.size.x * view.size.y));
}

// Larger than 1 where they are more than a sum has room for.
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
    // Groups that only fill up the last row of a dispatch have none.
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
