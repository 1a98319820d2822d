// Picture in parts under the ray model: every splat at its peak along the pixel's ray, in the order of these peaks and
// the mesh fragments. One thread per pixel.
//
// Exact for any number of splats: a search of the tile's list finds the nearest SLOTS peaks behind those already
// blended, which are then blended; repeated until there are fewer. The list is sorted by the least depth that a splat's
// peak can have, so that a search ends once that is beyond the farthest peak kept. About 40 flops per (splat, pixel,
// search).
//#import shared/view.wgsl
//#import shared/finite.wgsl
//#import shared/blend.wgsl
//#import shared/sh.wgsl
//#import shared/layered.wgsl

// Per splat, in units of its standard deviations over the largest one: [mean's ray a, z / largest], [camera's x axis,
// mean's pixel], [y axis, mean's pixel], [a × x axis, z], [a × y axis, 0].
@group(0) @binding(9) var<storage, read> rays: array<vec4f>;
//#if SH_BY_RAY
//#import shared/radiance.wgsl with BINDING=10
//#end

const SLOTS: u32 = 16u;                 // variables of their own while they are sought: depth0, …, depth15
const FAR: f32 = 3e38;
const NONE: u32 = 0xffffffffu;
const HIDDEN: f32 = 1e-6;               // transmittance behind which nothing changes a picture of 16 bits

struct Peak {
    depth: f32,
    alpha: f32,                         // 0: none that contributes
}

fn peak(i: u32, at: vec2f) -> Peak {
    let a = rays[5u * i];
    let x = rays[5u * i + 1u];
    let y = rays[5u * i + 2u];
    let u = rays[5u * i + 3u];
    let delta = (at - vec2f(x.w, y.w)) / view.focal;
    let ray = a.xyz + x.xyz * delta.x + y.xyz * delta.y;
    let across = (u.xyz * delta.x + rays[5u * i + 4u].xyz * delta.y) * a.w;
    let inverse = 1.0 / dot(ray, ray);
    let depth = u.w * dot(a.xyz, ray) * inverse;
    let alpha = projected[3u * i].w * exp(-0.5 * dot(across, across) * inverse);
    // Tested by bits, as a compiler may assume that comparisons never see NaN.
    let finite = are_finite(vec4f(alpha, depth, 0.0, 0.0));
    if finite && alpha >= ALPHA_CUT && depth > view.near { return Peak(depth, min(alpha, ALPHA_CAP)); }
    return Peak(0.0, 0.0);
}

@compute @workgroup_size(256)
fn main(
    @builtin(workgroup_id) group: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let tile = group_index(group);
    let place = tile_pixel(view, tile, thread);
    if any(place >= view.size) { return; }
    let at = vec2f(place) + 0.5;
    let pixel = place.y * view.size.x + place.x;
    let range = ranges[tile];
    var parts = nothing();
    var normal = vec3f(0.0);
//#if LAYERS
    let area = view.size.x * view.size.y;
    normal = front_normal(place);
    var layer = 0u;                     // the next to be blended
//#end
//#if SH_BY_RAY
    let slope = (at - view.principal) / view.focal;
    let basis = sh_basis(normalize(slope.x * view.row_x.xyz + slope.y * view.row_y.xyz + view.row_z.xyz));
//#end
    // Depth and index of the last splat blended; equal depths are ordered by index.
    var last_depth = 0.0;
    var last_splat = 0u;
    var more = true;
//#if PATIENCE
    // Progress: [state, bits of the last depth, the last splat, the next layer].
    let before = progress.pixels[pixel];
    if before.x == FINISHED { return; }
    if before.x == UNFINISHED {
        parts = kept_parts(pixel);
        last_depth = bitcast<f32>(before.y);
        last_splat = before.z;
//#if LAYERS
        layer = before.w;
//#end
    }
    var passed = 0u;
//#end
    while more && parts.transmittance >= HIDDEN {
//#if PATIENCE
        if passed > PATIENCE { break; }
//#end
//#for s in 0..16
        var depth$s = FAR;
        var alpha$s = 0.0;
        var splat$s = NONE;
//#end
        for (var k = range.x; k < range.y; k++) {
            let i = pair_splats[k];
            if projected[3u * i].z > depth15 { break; }
            let p = peak(i, at);
            let is_next = p.depth > last_depth || (p.depth == last_depth && i > last_splat);
            if p.alpha != 0.0 && is_next && (p.depth < depth15 || (p.depth == depth15 && i < splat15)) {
                // Insertion sort: the peak takes its place, farther ones move on, and the farthest drops out.
                var depth = p.depth;
                var alpha = p.alpha;
                var splat = i;
//#for s in 0..16
                if depth < depth$s || (depth == depth$s && splat < splat$s) {
                    let farther = depth$s;
                    let of_farther = alpha$s;
                    let farther_splat = splat$s;
                    depth$s = depth;
                    alpha$s = alpha;
                    splat$s = splat;
                    depth = farther;
                    alpha = of_farther;
                    splat = farther_splat;
                }
//#end
            }
        }
        more = splat15 != NONE;
        var depth: array<f32, SLOTS>;
        var alpha: array<f32, SLOTS>;
        var splat: array<u32, SLOTS>;
        var n = 0u;
//#for s in 0..16
        depth[$s] = depth$s;
        alpha[$s] = alpha$s;
        splat[$s] = splat$s;
        n += select(0u, 1u, splat$s != NONE);
//#end
        for (var slot = 0u; slot < n; slot++) {
//#if LAYERS
            while layer < LAYERS {
                let d = layer_depth[layer * area + pixel];
                if d <= 0.0 || d >= depth[slot] { break; }
                add_fragment(&parts, layer_color[layer * area + pixel], d);
                layer++;
            }
//#end
//#if SH_BY_RAY
            let color = radiance(splat[slot], basis);
//#else
            let color = projected[3u * splat[slot] + 2u].xyz;
//#end
            add_splat(&parts, alpha[slot], color, depth[slot]);
        }
        last_depth = depth15;
        last_splat = splat15;
//#if PATIENCE
        // Counted in full: even where the search of this pixel ends early, those of its neighbours may not, and the
        // limit holds for their threads together.
        passed += range.y - range.x + 4u * SLOTS;
//#end
    }
//#if PATIENCE
    var next = 0u;
//#if LAYERS
    next = layer;
//#end
    let is_finished = !more || parts.transmittance < HIDDEN;
    keep(pixel, parts, is_finished, vec3u(bitcast<u32>(last_depth), last_splat, next));
    if !is_finished { return; }
//#end
//#if LAYERS
    while layer < LAYERS {
        let d = layer_depth[layer * area + pixel];
        if d <= 0.0 { break; }
        add_fragment(&parts, layer_color[layer * area + pixel], d);
        layer++;
    }
//#end
    write_parts(pixel, parts, normal);
}
