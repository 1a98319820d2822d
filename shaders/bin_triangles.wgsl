// Lists of triangles per bin of BIN×BIN pixels, by counting: `count` triangles per bin, `scan` the counts into offsets,
// `scatter`.
//
// The order inside a bin's list is arbitrary; raster_layers does not depend on it. Per (triangle, bin) pair: one atomic
// and about 60 flops in each of `count` and `scatter`, 4 bytes written. 16 bytes per bin. A thread takes no more rows
// of a triangle than hold MOST_BINS of the picture's bins, unless that would need more threads than can be numbered.

//#import shared/view.wgsl
//#import shared/workgroup_scan.wgsl

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> corners: array<vec4f>;                 // [F, 3]
@group(0) @binding(2) var<storage, read> boxes: array<vec2u>;                   // [F]
// [bins]: counted triangles, then (reset by `scan`) scattered ones. Zero before a frame: raster_layers resets it.
@group(0) @binding(3) var<storage, read_write> bin_fill: array<atomic<u32>>;
@group(0) @binding(4) var<storage, read_write> bin_start: array<u32>;          // [bins]
@group(0) @binding(5) var<storage, read_write> pairs: array<u32>;               // [capacity]: triangles
@group(0) @binding(6) var<storage, read_write> pairs_needed: array<u32>;        // [1]: largest total so far

// Margin of `count`: two kernels may round differently, and whatever is scattered must have been counted.
const COUNTED_MARGIN: f32 = 0.01;

fn bins() -> vec2u {
    return (view.size + BIN - 1u) / BIN;
}

// Number of threads among which the rows of a triangle are divided, as `binning_shares` in render/gpu/mesh.rs.
fn shares() -> u32 {
    let wanted = (bins().x * bins().y + MOST_BINS - 1u) / MOST_BINS;
    return max(min(wanted, MOST_BINNING_THREADS / max(view.n_triangles, 1u)), 1u);
}

fn bin_at(packed: u32) -> vec2u {
    return vec2u(packed & 0xffffu, packed >> 16u);
}

// Smallest and largest value in a bin of the edge function cross(p − z_p r, q − z_q r), linear in the ray r.
// `p`, `q`: ends of the edge relative to the ray through the bin's centre; half: half a bin, in units of r.
fn edge_range(p: vec3f, q: vec3f, half: vec2f) -> vec2f {
    let middle = p.x * q.y - p.y * q.x;
    let slope = vec2f(q.z * p.y - p.z * q.y, p.z * q.x - q.z * p.x);
    let reach = dot(abs(slope), half);
    return vec2f(middle - reach, middle + reach);
}

// False only if no pixel of the bin can be inside: a pixel is inside iff all three edge functions have one sign.
// Half a bin is measured to its border, half a pixel beyond the outermost centres, and enlarged by `margin` times that:
// both for rounding.
fn may_touch(a: vec3f, b: vec3f, c: vec3f, bin: vec2u, margin: f32) -> bool {
    let half = (0.5 + 0.5 * margin) * f32(BIN) / view.focal;
    let ray = (f32(BIN) * (vec2f(bin) + 0.5) - view.principal) / view.focal;
    let p = vec3f(a.xy - a.z * ray, a.z);
    let q = vec3f(b.xy - b.z * ray, b.z);
    let s = vec3f(c.xy - c.z * ray, c.z);
    let e0 = edge_range(q, s, half);
    let e1 = edge_range(s, p, half);
    let e2 = edge_range(p, q, half);
    let some_positive = max(e0.x, max(e1.x, e2.x)) > 0.0;
    let some_negative = min(e0.y, min(e1.y, e2.y)) < 0.0;
    return !(some_positive && some_negative);
}

@compute @workgroup_size(256)
fn count(
    @builtin(workgroup_id) group: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let n_shares = shares();
    let share = group_index(group) * 256u + thread;
    let i = share / n_shares;
    if i >= view.n_triangles { return; }
    let first = bin_at(boxes[i].x);
    let last = bin_at(boxes[i].y);
    if first.y + share % n_shares > last.y { return; }
    let a = corners[3u * i].xyz;
    let b = corners[3u * i + 1u].xyz;
    let c = corners[3u * i + 2u].xyz;
    for (var y = first.y + share % n_shares; y <= last.y; y += n_shares) {
        for (var x = first.x; x <= last.x; x += 1u) {
            if all(first == last) || may_touch(a, b, c, vec2u(x, y), COUNTED_MARGIN) {
                atomicAdd(&bin_fill[y * bins().x + x], 1u);
            }
        }
    }
}

// One workgroup, 1,024 bins at a time, so that cache lines are read once and by neighbours: with a contiguous run of
// bins per thread, every load waited for the one before (1080p on an H200: 0.10 ms).
@compute @workgroup_size(256)
fn scan(@builtin(local_invocation_index) thread: u32) {
    let n = bins().x * bins().y;
    var carry = 0u;
    for (var base = 0u; base < n; base += 1024u) {
        let first = base + thread * 4u;
        var sum = 0u;
        //#for k in 0..4
        var count$k = 0u;
        if first + $ku < n { count$k = atomicExchange(&bin_fill[first + $ku], 0u); }
        sum = saturating_add(sum, count$k);
        //#end
        var start = saturating_add(carry, workgroup_scan(thread, sum));
        //#for k in 0..4
        if first + $ku < n { bin_start[first + $ku] = start; }
        start = saturating_add(start, count$k);
        //#end
        carry = saturating_add(carry, workgroup_total);
    }
    if thread == 0u { pairs_needed[0] = max(pairs_needed[0], carry); }
}

@compute @workgroup_size(256)
fn scatter(
    @builtin(workgroup_id) group: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let n_shares = shares();
    let share = group_index(group) * 256u + thread;
    let i = share / n_shares;
    if i >= view.n_triangles { return; }
    let first = bin_at(boxes[i].x);
    let last = bin_at(boxes[i].y);
    if first.y + share % n_shares > last.y { return; }
    let a = corners[3u * i].xyz;
    let b = corners[3u * i + 1u].xyz;
    let c = corners[3u * i + 2u].xyz;
    let capacity = arrayLength(&pairs);
    let n_bins = bins().x * bins().y;
    for (var y = first.y + share % n_shares; y <= last.y; y += n_shares) {
        for (var x = first.x; x <= last.x; x += 1u) {
            if all(first == last) || may_touch(a, b, c, vec2u(x, y), 0.0) {
                let bin = y * bins().x + x;
                let slot = saturating_add(bin_start[bin], atomicAdd(&bin_fill[bin], 1u));
                // A triangle that was not counted after all must not take the place of the next bin's first.
                var end = capacity;
                if bin + 1u < n_bins { end = min(bin_start[bin + 1u], capacity); }
                if slot < end { pairs[slot] = i; }
            }
        }
    }
}
