// One workgroup per bin: the LAYERS nearest triangles at every pixel, by depth and then by index.
//
// A triangle covers a pixel iff its three edge functions a_k = r·(v_i × v_j) have one sign there; they
// are linear in the pixel, so each triangle is reduced to three of them relative to the bin's centre when it is
// staged. No clipping and no division before the depth is needed: triangles through the camera plane are exact too.
//
// Per (triangle, bin): 52 bytes read, 64 bytes of workgroup memory. Per (triangle, pixel): 6 fma, 5 min/max; per hit
// another 8 flops and LAYERS compare-exchanges. Writes 8 bytes per pixel and layer. A thread owns PER_THREAD pixels, so
// that it reads a staged triangle once for all of them; THREADS cover the BIN × BIN pixels of a bin.

//#import shared/view.wgsl

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> corners: array<vec4f>;             // [F, 3]: see setup_triangles
@group(0) @binding(2) var<storage, read> bin_start: array<u32>;            // [bins]
@group(0) @binding(3) var<storage, read_write> bin_fill: array<u32>;       // [bins]
@group(0) @binding(4) var<storage, read> pairs: array<u32>;                 // [capacity]
@group(0) @binding(5) var<storage, read_write> layer_depth: array<f32>;     // [LAYERS, h, w], 0 = empty
@group(0) @binding(6) var<storage, read_write> layer_triangle: array<u32>;  // [LAYERS, h, w], index + 1

const ROWS: u32 = THREADS / BIN;        // rows between two pixels of a thread
const BATCH: u32 = 64u;                 // triangles staged at a time
const FAR: f32 = 3e38;

struct Staged {
    middle: vec3f,      // edge functions at the bin's centre
    triangle: u32,
    right: vec3f,       // their change per pixel to the right
    down: vec3f,        // and down
    z: vec3f,           // of the corners
}

var<workgroup> staged: array<Staged, BATCH>;
var<workgroup> range: vec2u;

// Edge function of p→q, evaluated in the edge's canonical direction: at the bin's centre, change to the right, change
// down.
fn edge(p: vec3f, q: vec3f, direction: f32) -> vec3f {
    let forward = direction > 0.0;
    let a = select(q, p, forward);
    let b = select(p, q, forward);
    return direction * vec3f(
        a.x * b.y - a.y * b.x,
        (b.z * a.y - a.z * b.y) / view.focal.x,
        (a.z * b.x - b.z * a.x) / view.focal.y,
    );
}

fn stage(triangle: u32, ray: vec2f) -> Staged {
    let c0 = corners[3u * triangle];
    let c1 = corners[3u * triangle + 1u];
    let c2 = corners[3u * triangle + 2u];
    let p = vec3f(c0.xy - c0.z * ray, c0.z);
    let q = vec3f(c1.xy - c1.z * ray, c1.z);
    let s = vec3f(c2.xy - c2.z * ray, c2.z);
    let e0 = edge(q, s, c0.w);
    let e1 = edge(s, p, c1.w);
    let e2 = edge(p, q, c2.w);
    return Staged(
        vec3f(e0.x, e1.x, e2.x),
        triangle,
        vec3f(e0.y, e1.y, e2.y),
        vec3f(e0.z, e1.z, e2.z),
        vec3f(p.z, q.z, s.z),
    );
}

// Top-left rule: of two triangles at an edge exactly one owns the pixel centres that lie on it, as in hardware and in
// the reference: the one to whose inside the edge function grows to the right, or down if it does not change to the
// right. Otherwise a surface would be blended twice there.
fn owns_edges(t: Staged, a: vec3f, sum: f32) -> bool {
    let inward = select(t.right, t.down, t.right == vec3f(0.0)) * sign(sum);
    return !any((a == vec3f(0.0)) & (inward <= vec3f(0.0)));
}

@compute @workgroup_size(THREADS)
fn raster(
    @builtin(workgroup_id) group: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let bins = (view.size + BIN - 1u) / BIN;
    let bin = group_index(group);
    let exists = bin < bins.x * bins.y;
    if thread == 0u {
        range = vec2u(0u);
        if exists {
            let start = min(bin_start[bin], arrayLength(&pairs));
            var end = arrayLength(&pairs);
            if bin + 1u < bins.x * bins.y { end = min(bin_start[bin + 1u], end); }
            range = vec2u(start, start + min(bin_fill[bin], end - start));
            bin_fill[bin] = 0u;
        }
    }
    let list = workgroupUniformLoad(&range);
    let corner = BIN * vec2u(bin % bins.x, bin / bins.x);
    let ray = (vec2f(corner) + 0.5 * f32(BIN) - view.principal) / view.focal;
    let own = vec2u(thread % BIN, thread / BIN);
    let offset = vec2f(own) + 0.5 - 0.5 * f32(BIN);

    //#for p in 0..PER_THREAD
    //#for l in 0..LAYERS
    var z_$p_$l = FAR;
    var id_$p_$l = 0xffffffffu;
    //#end
    //#end

    for (var base = list.x; base < list.y; base += BATCH) {
        workgroupBarrier();
        let n = min(BATCH, list.y - base);
        for (var i = thread; i < n; i += THREADS) {
            staged[i] = stage(pairs[base + i], ray);
        }
        workgroupBarrier();
        for (var i = 0u; i < n; i += 1u) {
            let t = staged[i];
            let first_row = t.middle + t.right * offset.x + t.down * offset.y;
            //#for p in 0..PER_THREAD
            {
                let a = first_row + t.down * f32($pu * ROWS);
                let low = min(a.x, min(a.y, a.z));
                let high = max(a.x, max(a.y, a.z));
                if low >= 0.0 || high <= 0.0 {
                    let sum = a.x + a.y + a.z;
                    var z = dot(a, t.z) / sum;
                    // Excludes degenerate triangles (sum 0: z is NaN) and hits behind the near plane.
                    if z > view.near && z < FAR && sum != 0.0 && owns_edges(t, a, sum) {
                        var id = t.triangle;
                        //#for l in 0..LAYERS
                        if z < z_$p_$l || (z == z_$p_$l && id < id_$p_$l) {
                            let farther = z_$p_$l;
                            let farther_id = id_$p_$l;
                            z_$p_$l = z;
                            id_$p_$l = id;
                            z = farther;
                            id = farther_id;
                        }
                        //#end
                    }
                }
            }
            //#end
        }
    }

    if !exists { return; }
    let area = view.size.x * view.size.y;
    //#for p in 0..PER_THREAD
    {
        let pixel = corner + own + vec2u(0u, $pu * ROWS);
        if all(pixel < view.size) {
            let i = pixel.y * view.size.x + pixel.x;
            //#for l in 0..LAYERS
            layer_depth[$lu * area + i] = select(0.0, z_$p_$l, id_$p_$l != 0xffffffffu);
            layer_triangle[$lu * area + i] = id_$p_$l + 1u;
            //#end
        }
    }
    //#end
}
