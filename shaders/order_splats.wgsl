// Decides, once per visible splat and mesh layer, how they are ordered. Every mode is expressed by one threshold t: at
// a pixel whose layer depth is d, the splat lies behind that layer iff d < t. See render/contract.rs.
//#import shared/view.wgsl

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> visible: array<u32>;
@group(0) @binding(2) var<storage, read> projected: array<vec4f>;
@group(0) @binding(3) var<storage, read> layer_depth: array<f32>;
@group(0) @binding(4) var<storage, read_write> thresholds: array<f32>;

const ALWAYS: f32 = 3.4028234e38;
const NEVER: f32 = -3.4028234e38;

const OUTSIDE: f32 = -1.0;
const EMPTY: f32 = 0.0;

// Depth of a layer at the splat's own projection, OUTSIDE or EMPTY.
fn surface_depth(center: vec2f, layer: u32) -> f32 {
    let size = vec2f(view.size);
    if !(all(center >= vec2f(0.0)) && all(center < size)) { return OUTSIDE; }
    let s = center - 0.5;
    let corner = floor(s);
    let f = s - corner;
    let limit = vec2i(view.size) - 1;
    let low = clamp(vec2i(corner), vec2i(0), limit);
    let high = clamp(vec2i(corner) + 1, vec2i(0), limit);
    let base = layer * view.size.x * view.size.y;
    let d = vec4f(
        layer_depth[base + u32(low.y) * view.size.x + u32(low.x)],
        layer_depth[base + u32(low.y) * view.size.x + u32(high.x)],
        layer_depth[base + u32(high.y) * view.size.x + u32(low.x)],
        layer_depth[base + u32(high.y) * view.size.x + u32(high.x)],
    );
    let w = vec4f((1.0 - f.x) * (1.0 - f.y), f.x * (1.0 - f.y), (1.0 - f.x) * f.y, f.x * f.y);
    let valid = (d > vec4f(0.0)) & (w > vec4f(0.0));
    if !any(valid) { return EMPTY; }
    let farthest = select(vec4f(0.0), d, valid);
    let nearest = select(vec4f(ALWAYS), d, valid);
    let most = max(max(farthest.x, farthest.y), max(farthest.z, farthest.w));
    let least = min(min(nearest.x, nearest.y), min(nearest.z, nearest.w));
    if most - least > view.lambda {     // a depth edge: never average across it
        var best = w.x; var at = d.x;
        if w.y > best { best = w.y; at = d.y; }
        if w.z > best { best = w.z; at = d.z; }
        if w.w > best { best = w.w; at = d.w; }
        return at;
    }
    // 1/z is affine on a plane, so its weighted mean is exact there.
    let weight = select(vec4f(0.0), w, valid);
    return dot(weight, vec4f(1.0)) / dot(weight, 1.0 / nearest);
}

@compute @workgroup_size(256)
fn main(
    @builtin(workgroup_id) group: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let i = group_index(group) * 256u + thread;
    if i >= view.n_splats || visible[i] == 0u { return; }
    let a = projected[3u * i];
    let z = a.z;
    if view.mode == MODE_DIRECT {
//#for l in 0..LAYERS
        thresholds[i * LAYERS + $lu] = z;
//#end
        return;
    }
    if view.mode == MODE_STABLE {
//#for l in 0..LAYERS
        let d$l = surface_depth(a.xy, $lu);
        var t$l = z - view.lambda;
        if d$l == OUTSIDE || (d$l > 0.0 && z > d$l * (1.0 + TIE_EPSILON)) { t$l = ALWAYS; }
        else if d$l == EMPTY { t$l = z; }
        thresholds[i * LAYERS + $lu] = max(t$l, NEVER);
//#end
        return;
    }
    // MODE_SURFACE_CONSISTENT: the nearest sheets in front of and behind the mean, one threshold for all layers.
    var front = 0.0;
    var behind = 0.0;
//#for l in 0..LAYERS
    let d$l = surface_depth(a.xy, $lu);
    if d$l > 0.0 {
        // Interpolation across edges can leave the samples unsorted.
        if z > d$l * (1.0 + TIE_EPSILON) { front = max(front, d$l); } else { behind = select(min(behind, d$l), d$l, behind == 0.0); }
    }
//#end
    var t = z;
    if front > 0.0 && behind > 0.0 {
        let middle = 0.5 * (front + behind);
        let b = min(z, behind - view.lambda);
        t = select(min(max(z, front + view.lambda), middle), b, b > middle);
    } else if front > 0.0 {
        t = max(z, front + view.lambda);
    } else if behind > 0.0 {
        t = min(z, behind - view.lambda);
    }
//#for l in 0..LAYERS
    thresholds[i * LAYERS + $lu] = clamp(t, NEVER, ALWAYS);
//#end
}
