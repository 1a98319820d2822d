// Gradients of the blend (METHODS 4.5, 2.5) with respect to mesh layers and, as moments, to splats.
//
// Splats are replayed in forward order: with t the bucket's transmittance so far and q = g·(colour still to come),
// ∂L/∂α = P·(t·g·c − q_after/(1−α)), where P is the transmittance before the bucket; no division by small t.
// Work alternates between two views of CHUNK splats × 256 pixels in workgroup memory: threads as pixels find each
// pair's weight w = P·t·α and slope p = ∂L/∂power; then threads as splats sum over pixels
//     Σp, Σp·dx, Σp·dy, Σp·dx², Σp·dx·dy, Σp·dy², Σw·g (rgb), Σw
// with d = pixel − mean, and one atomic add per sum, splat and tile leaves the workgroup. `splat_backward` turns the
// ten moments into parameter gradients. Neither view needs a given subgroup size.
// Per pair: 1 exp, ~45 flops, 4 words written and 5 read in workgroup memory.
//#import shared/view.wgsl

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> ranges: array<vec2u>;
@group(0) @binding(2) var<storage, read> pair_splats: array<u32>;
@group(0) @binding(3) var<storage, read> projected: array<vec4f>;
@group(0) @binding(4) var<storage, read> image_gradient: array<vec4f>;   // ∂L/∂rgb
@group(0) @binding(5) var<storage, read> buckets: array<vec4f>;
@group(0) @binding(6) var<storage, read> ends: array<u32>;
//#import shared/atomic_add.wgsl with TARGET=moments BINDING=7
//#if LAYERS
@group(0) @binding(8) var<storage, read> thresholds: array<f32>;
@group(0) @binding(9) var<storage, read> layer_depth: array<f32>;
@group(0) @binding(10) var<storage, read> layer_color: array<vec4f>;
@group(0) @binding(11) var<storage, read_write> layer_gradient: array<vec4f>;   // ∂L/∂rgb, ∂L/∂alpha
//#end

const ALPHA_CUT: f32 = 1.0 / 255.0;
const ALPHA_CAP: f32 = 0.99;
const EMPTY_DEPTH: f32 = 3.4028234e38;
const MOMENTS: u32 = 10u;
const BATCH: u32 = 64u;
const LANES: u32 = THREADS / CHUNK;     // threads that share a splat in the second view

var<workgroup> batch_splat: array<u32, BATCH>;
var<workgroup> batch_center: array<vec4f, BATCH>;
var<workgroup> batch_conic: array<vec4f, BATCH>;
var<workgroup> batch_color: array<vec4f, BATCH>;
//#if LAYERS
var<workgroup> batch_threshold: array<f32, BATCH * LAYERS>;
//#end
var<workgroup> pair_terms: array<vec2f, CHUNK * PIXELS>;    // [splat][pixel]: weight, slope
var<workgroup> gradient: array<vec3f, PIXELS>;
//#if !SUBGROUPS
var<workgroup> partial: array<f32, THREADS * MOMENTS>;
//#end
var<workgroup> last_end: atomic<u32>;
var<workgroup> tile_range: vec2u;

@compute @workgroup_size(THREADS)
fn main(
    @builtin(workgroup_id) group: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) thread: u32,
//#if SUBGROUPS
    @builtin(subgroup_invocation_id) subgroup_lane: u32,
    @builtin(subgroup_id) subgroup: u32,
    @builtin(subgroup_size) subgroup_size: u32,
//#end
) {
    let tile = group_index(group, groups);
    if tile >= view.tiles.x * view.tiles.y { return; }
    if thread == 0u { atomicStore(&last_end, 0u); }
    workgroupBarrier();
    let origin = vec2u(tile % view.tiles.x, tile / view.tiles.x) * TILE;
    let x = origin.x + thread % TILE;
    let y = origin.y + thread / TILE;
    let px = f32(x) + 0.5;
    let n_pixels = view.size.x * view.size.y;

    var t: array<array<f32, BUCKETS>, PER_THREAD>;
    var q: array<array<f32, BUCKETS>, PER_THREAD>;
    var before: array<array<f32, BUCKETS>, PER_THREAD>;
    var end: array<array<u32, BUCKETS>, PER_THREAD>;
//#for j in 0..PER_THREAD
    let y$j = y + $ju * (THREADS / TILE);
    let py$j = f32(y$j) + 0.5;
    let pixel$j = y$j * view.size.x + x;
    var g$j = vec3f(0.0);
//#for b in 0..BUCKETS
    t[$j][$b] = 1.0;
    q[$j][$b] = 0.0;
    before[$j][$b] = 0.0;
    end[$j][$b] = 0u;
//#end
//#for l in 0..LAYERS
    var depth$j_$l = EMPTY_DEPTH;
//#end
    if x < view.size.x && y$j < view.size.y {
        g$j = image_gradient[pixel$j].xyz;
//#for l in 0..LAYERS
        let d$l = layer_depth[$lu * n_pixels + pixel$j];
        var layer$l = vec4f(0.0);
        if d$l > 0.0 {
            depth$j_$l = d$l;
            layer$l = layer_color[$lu * n_pixels + pixel$j];
        }
//#end
        // Colours behind: S_b from the front of bucket b, R_b from its back.
        var seen = view.background.xyz;
//#for b in BUCKETS..0
        let bucket$b = buckets[$bu * n_pixels + pixel$j];
//#if $b<LAYERS
        let behind$b = seen;
        seen = layer$b.w * layer$b.xyz + (1.0 - layer$b.w) * seen;
//#end
        seen = bucket$b.xyz + bucket$b.w * seen;
        q[$j][$b] = dot(g$j, seen);
        end[$j][$b] = ends[$bu * n_pixels + pixel$j];
        atomicMax(&last_end, end[$j][$b]);
//#end
        var p = 1.0;
//#for b in 0..BUCKETS
        before[$j][$b] = p;
        p *= bucket$b.w;
//#if $b<LAYERS
        layer_gradient[$bu * n_pixels + pixel$j] = vec4f(
            p * layer$b.w * g$j,
            p * dot(g$j, layer$b.xyz - behind$b),
        );
        p *= 1.0 - layer$b.w;
//#end
//#end
    }
    gradient[thread + $ju * THREADS] = g$j;
//#end
    workgroupBarrier();
    if thread == 0u { tile_range = vec2u(ranges[tile].x, atomicLoad(&last_end)); }
    let range = workgroupUniformLoad(&tile_range);

//#if SUBGROUPS
    let worker = subgroup * subgroup_size + subgroup_lane;
    let span = min(subgroup_size, LANES);                   // lanes that a shuffle can sum
//#else
    let worker = thread;
//#end
    let row = worker / LANES;                               // splat of the chunk in the second view
    let lane = worker % LANES;

    for (var start = range.x; start < range.y; start += BATCH) {
        let n = min(BATCH, range.y - start);
        if thread < n {
            let i = pair_splats[start + thread];
            batch_splat[thread] = i;
            batch_center[thread] = projected[3u * i];
            batch_conic[thread] = projected[3u * i + 1u];
            batch_color[thread] = projected[3u * i + 2u];
//#for l in 0..LAYERS
            batch_threshold[thread * LAYERS + $lu] = thresholds[i * LAYERS + $lu];
//#end
        }
        workgroupBarrier();
        for (var first = 0u; first < n; first += CHUNK) {
            let m = min(CHUNK, n - first);
            for (var k = 0u; k < m; k++) {
                let s = first + k;
                let index = start + s;
                let center = batch_center[s];
                let conic = batch_conic[s];
                let rgb = batch_color[s].xyz;
                let dx = px - center.x;
                let power_x = -0.5 * conic.x * dx * dx;
                let power_xy = -conic.y * dx;
//#for l in 0..LAYERS
                let threshold$l = batch_threshold[s * LAYERS + $lu];
//#end
//#for j in 0..PER_THREAD
                {
                    let dy = py$j - center.y;
                    let power = power_x + dy * (power_xy - 0.5 * conic.z * dy);
                    let raw = center.w * exp(power);
                    let alpha = min(ALPHA_CAP, raw);
                    var terms = vec2f(0.0);
                    if power <= 0.0 && alpha >= ALPHA_CUT {
                        var bucket = 0u;
//#for l in 0..LAYERS
                        if depth$j_$l < threshold$l { bucket = $lu + 1u; }
//#end
//#for b in 0..BUCKETS
                        if bucket == $bu && index < end[$j][$b] {
                            let w = t[$j][$b] * alpha;
                            let c = dot(g$j, rgb);
                            let left = q[$j][$b] - w * c;
                            // The cap passes no gradient.
                            let slope = select(t[$j][$b] * c - left / (1.0 - alpha), 0.0, raw > ALPHA_CAP);
                            terms = before[$j][$b] * vec2f(w, alpha * slope);
                            q[$j][$b] = left;
                            t[$j][$b] *= 1.0 - alpha;
                        }
//#end
                    }
                    pair_terms[k * PIXELS + thread + $ju * THREADS] = terms;
                }
//#end
            }
            workgroupBarrier();
            var sums: array<f32, MOMENTS>;
//#for c in 0..10
            sums[$c] = 0.0;
//#end
            if row < m {
                let center = batch_center[first + row].xy - vec2f(origin) - 0.5;
                for (var p = lane; p < PIXELS; p += LANES) {
                    let terms = pair_terms[row * PIXELS + p];
                    let d = vec2f(f32(p % TILE), f32(p / TILE)) - center;
                    let g = gradient[p];
                    let pd = terms.y * d;
                    sums[0] += terms.y;
                    sums[1] += pd.x;
                    sums[2] += pd.y;
                    sums[3] += pd.x * d.x;
                    sums[4] += pd.x * d.y;
                    sums[5] += pd.y * d.y;
                    sums[6] += terms.x * g.x;
                    sums[7] += terms.x * g.y;
                    sums[8] += terms.x * g.z;
                    sums[9] += terms.x;
                }
            }
//#if SUBGROUPS
            for (var step = 1u; step < span; step *= 2u) {
//#for c in 0..10
                sums[$c] += subgroupShuffleXor(sums[$c], step);
//#end
            }
            if row < m && lane % span == 0u && sums[9] != 0.0 {
                let at = batch_splat[first + row] * MOMENTS;
//#for c in 0..10
                add_moments(at + $cu, sums[$c]);
//#end
            }
            workgroupBarrier();
//#else
//#for c in 0..10
            partial[worker * MOMENTS + $cu] = sums[$c];
//#end
            workgroupBarrier();
            for (var task = thread; task < m * MOMENTS; task += THREADS) {
                let splat = task / MOMENTS;
                let c = task % MOMENTS;
                var sum = 0.0;
                for (var l = 0u; l < LANES; l++) { sum += partial[(splat * LANES + l) * MOMENTS + c]; }
                if sum != 0.0 { add_moments(batch_splat[first + splat] * MOMENTS + c, sum); }
            }
            workgroupBarrier();
//#end
        }
    }
}
