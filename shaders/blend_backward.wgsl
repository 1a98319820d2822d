// Gradients of the blend with respect to mesh layers and, as sums over pixels, to splats.
//
// Splats are replayed in forward order: with t the bucket's transmittance so far and q = g·(colour still to come),
// ∂L/∂α = P·(t·g·c − q_after/(1−α)), where P is the transmittance before the bucket; no division by small t.
// With w = P·t·α the pair's weight, p = ∂L/∂power, and pixels dx columns from the mean and y rows from the peak of the
// splat in their column, every splat needs these sums over pixels:
//     Σp, Σp·dx, Σp·y, Σp·dx², Σp·dx·y, Σp·y², Σw·g (rgb), Σw
// and, if ABSOLUTE, two sums of absolute values of each pixel's gradient by the mean: Σ|∂L/∂u|, Σ|∂L/∂v|. c and g have
// a fourth channel: for a splat its disparity 1/z, for a pixel the slope of the loss by its disparity Σw/z. That term
// keeps splats that cost nothing where they are, dark ones before a dark background, from floating in mid-air. Depths
// are held fixed in it, and mesh layers are not affected. A thread owns PER_THREAD pixels of one tile column (dx is
// common to them) and sums those in registers; lanes are summed by the subgroup, and subgroups through workgroup
// memory, which does all of it without subgroups. The tile's sums are written to a row of their own, beside those of
// the splat's other tiles: nothing is added by atomics, whose order would differ from run to run. `sum_pairs` adds up
// the rows of a splat, `splat_backward` turns the sums into parameter gradients. There are rows for pairs with numbers
// from WINDOW_START to before WINDOW_END; if an adapter binds too little for all rows, everything is done once for each
// window. Per pair and pixel: 1 exp, ~40 flops, no memory; per pair: 56 + 4·LAYERS bytes read, 4·SUMS written.
//#import shared/view.wgsl
//#import shared/blend.wgsl

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> ranges: array<vec2u>;
@group(0) @binding(2) var<storage, read> numbered: array<vec2u>;         // [pair]: splat, number of its row
@group(0) @binding(3) var<storage, read> projected: array<vec4f>;
@group(0) @binding(4) var<storage, read> image_gradient: array<vec4f>;   // ∂L/∂rgb, and by the disparity Σw/z
@group(0) @binding(5) var<storage, read> buckets: array<vec4f>;
@group(0) @binding(6) var<storage, read> ends: array<vec2u>;
@group(0) @binding(7) var<storage, read_write> rows: array<f32>;         // [number within the window][SUMS]
//#if LAYERS
@group(0) @binding(8) var<storage, read> thresholds: array<f32>;
@group(0) @binding(9) var<storage, read> layer_depth: array<f32>;
@group(0) @binding(10) var<storage, read> layer_color: array<vec4f>;
@group(0) @binding(11) var<storage, read_write> layer_gradient: array<vec4f>;   // ∂L/∂rgb, ∂L/∂alpha
//#import shared/tile_bucket.wgsl
//#end

const BATCH: u32 = 64u;

var<workgroup> batch_number: array<u32, BATCH>;
//#import shared/batch.wgsl with COLOR=vec4f
//#if SUBGROUPS
// [subgroup][splat of the batch][SUMS], for as many splats as there is room for.
const SUM_FLOATS: u32 = 2560u;
var<workgroup> sums_of_batch: array<f32, SUM_FLOATS>;
//#else
// Number of splats whose sums are reduced together: as many as fit in 16 KiB beside the rest.
//#if ABSOLUTE
const CHUNK: u32 = 3u;
//#else
const CHUNK: u32 = 4u;
//#end
var<workgroup> partial: array<f32, CHUNK * SUMS * THREADS>;
//#end
var<workgroup> last_end: atomic<u32>;
var<workgroup> tile_range: vec4u;     // first pair, after the last that is used; splats a batch, subgroups

fn write(number: u32, which: u32, sum: f32) {
    if number >= WINDOW_START && number < WINDOW_END { rows[(number - WINDOW_START) * SUMS + which] = sum; }
}

//#if PAIRWISE
//#import shared/spread.wgsl with EXCHANGE=subgroupShuffleXor
//#end

@compute @workgroup_size(THREADS)
fn main(
    @builtin(workgroup_id) group: vec3u,
    @builtin(local_invocation_index) thread: u32,
//#if SUBGROUPS
    @builtin(subgroup_invocation_id) lane: u32,
    @builtin(subgroup_id) subgroup: u32,
    @builtin(num_subgroups) subgroups: u32,
//#end
) {
    let tile = group_index(group);
    if tile >= view.tiles.x * view.tiles.y { return; }
    let pairs = ranges[tile];
    if WINDOW_START >= max(ranges[view.tiles.x * view.tiles.y].x, 1u) { return; }
//#if SUBGROUPS
    // Counted at run time: some drivers report another subgroup_size than they compile for.
    let lanes = subgroupAdd(1u);
//#if PAIRWISE
    let place = places(lane, lanes);
//#end
//#end
    if thread == 0u {
        atomicStore(&last_end, 0u);
//#if LAYERS
        clear_depths();
//#end
    }
    workgroupBarrier();
    let x = (tile % view.tiles.x) * TILE + thread % TILE;
    let y = (tile / view.tiles.x) * TILE + thread / TILE * PER_THREAD;
    let px = f32(x) + 0.5;
    let n_pixels = view.size.x * view.size.y;

    var t: array<array<f32, BUCKETS>, PER_THREAD>;
    var q: array<array<f32, BUCKETS>, PER_THREAD>;
    var before: array<array<f32, BUCKETS>, PER_THREAD>;
    var end: array<array<u32, BUCKETS>, PER_THREAD>;
    var last = 0u;
//#for j in 0..PER_THREAD
    let y$j = y + $ju;
    let py$j = f32(y$j) + 0.5;
    let inside$j = x < view.size.x && y$j < view.size.y;
    let pixel$j = y$j * view.size.x + x;
    var g$j = vec4f(0.0);
//#for b in 0..BUCKETS
    t[$j][$b] = 1.0;
    q[$j][$b] = 0.0;
    before[$j][$b] = 0.0;
    end[$j][$b] = 0u;
//#end
//#for l in 0..LAYERS
    var depth$j_$l = EMPTY_DEPTH;
//#end
    if inside$j {
        g$j = image_gradient[pixel$j];
//#for l in 0..LAYERS
        let d$l = layer_depth[$lu * n_pixels + pixel$j];
        var layer$l = vec4f(0.0);
        if d$l > 0.0 {
            depth$j_$l = d$l;
            layer$l = layer_color[$lu * n_pixels + pixel$j];
        }
//#end
        // Accumulated colours and disparities behind: S_b from the front of bucket b, R_b from its back.
        var seen = vec4f(view.background.xyz, 0.0);
//#for b in BUCKETS..0
        let bucket$b = buckets[$bu * n_pixels + pixel$j];
//#if $b<LAYERS
        let behind$b = seen;
        seen = layer$b.w * vec4f(layer$b.xyz, 1.0 / depth$j_$b) + (1.0 - layer$b.w) * seen;
//#end
        let end$b = ends[$bu * n_pixels + pixel$j];
        seen = vec4f(bucket$b.xyz, bitcast<f32>(end$b.y)) + bucket$b.w * seen;
        q[$j][$b] = dot(g$j, seen);
        end[$j][$b] = end$b.x;
        last = max(last, end[$j][$b]);
//#end
        var p = 1.0;
//#for b in 0..BUCKETS
        before[$j][$b] = p;
        p *= bucket$b.w;
//#if $b<LAYERS
        layer_gradient[$bu * n_pixels + pixel$j] = vec4f(
            p * layer$b.w * g$j.xyz,
            p * dot(g$j.xyz, layer$b.xyz - behind$b.xyz),
        );
        p *= 1.0 - layer$b.w;
//#end
//#end
    }
//#end
//#import shared/tile_depths.wgsl
    atomicMax(&last_end, last);
    workgroupBarrier();
    if thread == 0u {
        let used = atomicLoad(&last_end);
//#if SUBGROUPS
        let room = SUM_FLOATS / (subgroups * SUMS);
        // Rounded down to a multiple of 8, if there is room for that many.
        tile_range = vec4u(pairs.x, used, clamp(select(room / 8u * 8u, room, room < 8u), 1u, BATCH), subgroups);
//#else
        tile_range = vec4u(pairs.x, used, BATCH, 0u);
//#end
    }
    let range = workgroupUniformLoad(&tile_range);

    for (var start = range.x; start < range.y; start += range.z) {
        let n = min(range.z, range.y - start);
        for (var s = thread; s < n; s += THREADS) {
            let pair = numbered[start + s];
            batch_number[s] = pair.y;
            load_splat(s, pair.x, projected[3u * pair.x + 2u]);
        }
        workgroupBarrier();
//#if RUNS
        mark_paths(thread, n);
        workgroupBarrier();
//#end
        var s = 0u;
//#if RUNS
        while s < n {
            let path = block_path[s / BLOCK];
            let run = run_end(s, n);
//#end
//#for p in FIRST_PATH..PATHS
        // Path p: bucket p for all pixels, or for the last path decided per pixel.
//#if RUNS
        let end_of_$p = select(s, run, path == $pu);
//#else
        let end_of_$p = n;
//#end
//#if PAIRWISE
        if lanes >= 8u {
            for (; s < end_of_$p; s += 2u) {
//#import shared/splats_at_pixels.wgsl with COUNT=2 END=end_of_$p
                var is_seen = false;
//#for m in 0..2
                let value$m = batch_color[at$m];
//#for j in 0..PER_THREAD
                var bucket$m_$j = $pu % BUCKETS;
//#for l in 0..LAYERS
                if $pu == MIXED && depth$j_$l < threshold$m_$l { bucket$m_$j = $lu + 1u; }
//#end
//#for b in 0..BUCKETS
                let alpha$m_$j_$b = select(
                    0.0,
                    min(ALPHA_CAP, raw$m_$j),
                    min(ALPHA_CAP, raw$m_$j) >= ALPHA_CUT && bucket$m_$j == $bu && start + at$m < end[$j][$b],
                );
                is_seen = is_seen || alpha$m_$j_$b > 0.0;
//#end
//#end
//#end
                var total = vec3f(0.0);
                if subgroupAny(is_seen) {
//#for m in 0..2
                    let dx$m = px - center$m.x;
                    var sum_p$m = vec3f(0.0);     // p·(1, y, y²)
                    var sum_w$m = vec4f(0.0);     // w·(g, 1)
//#if ABSOLUTE
                    var sum_pull$m = vec2f(0.0);  // |p·Σ'⁻¹d|
//#end
//#for j in 0..PER_THREAD
//#for b in 0..BUCKETS
                    {
                        let y = y$m_$j;
                        let raw = raw$m_$j;
                        let alpha = alpha$m_$j_$b;
//#import shared/pair_gradient.wgsl with M=$m J=$j B=$b
                    }
//#end
//#end
                    let sums$m = array<f32, SUMS>(
                        sum_p$m.x, dx$m * sum_p$m.x, sum_p$m.y, dx$m * dx$m * sum_p$m.x, dx$m * sum_p$m.y, sum_p$m.z,
                        sum_w$m.x, sum_w$m.y, sum_w$m.z, sum_w$m.w,
//#if ABSOLUTE
                        sum_pull$m.x, sum_pull$m.y,
//#end
                    );
//#end
                    total = spread(sums0, sums1, lane, lanes);
                }
                let first = (subgroup * range.z + s) * SUMS;
                let places_end = min(end_of_$p - s, 2u) * SUMS;
                if place.x < places_end { sums_of_batch[first + place.x] = total.x; }
                if place.y < places_end { sums_of_batch[first + place.y] = total.y; }
                if place.z < places_end { sums_of_batch[first + place.z] = total.z; }
            }
            s = end_of_$p;
        }
//#end
        for (; s < end_of_$p; s++) {
            let center = batch_center[s];
            let squares = batch_squares[s].xyz;
            let value = batch_color[s];
            let dx = px - center.x;
            let column = gaussian_column(center.xy, squares, px);
//#for l in 0..LAYERS
            let threshold$l = batch_threshold[s * LAYERS + $lu];
//#end
            var sum_p = vec3f(0.0);     // p·(1, y, y²)
            var sum_w = vec4f(0.0);     // w·(g, 1)
//#if ABSOLUTE
            var sum_pull = vec2f(0.0);  // |p·Σ'⁻¹d|
//#end
//#for j in 0..PER_THREAD
            {
                let y = py$j - column.row;
                let raw = alpha_at(column, center.w, y);
                let alpha = min(ALPHA_CAP, raw);
                if alpha >= ALPHA_CUT {
                    var bucket = $pu % BUCKETS;
//#for l in 0..LAYERS
                    if $pu == MIXED && depth$j_$l < threshold$l { bucket = $lu + 1u; }
//#end
//#for b in 0..BUCKETS
                    if bucket == $bu && start + s < end[$j][$b] {
//#import shared/pair_gradient.wgsl with M= J=$j B=$b
                    }
//#end
                }
            }
//#end
            let sums = array<f32, SUMS>(
                sum_p.x, dx * sum_p.x, sum_p.y, dx * dx * sum_p.x, dx * sum_p.y, sum_p.z,
                sum_w.x, sum_w.y, sum_w.z, sum_w.w,
//#if ABSOLUTE
                sum_pull.x, sum_pull.y,
//#end
            );
//#if SUBGROUPS
//#for c in 0..SUMS
            let total$c = subgroupAdd(sums[$c]);
//#end
            // One sum per lane, so that all are written by one instruction.
            for (var c = lane; c < SUMS; c += lanes) {
                var total = total0;
//#for c in 1..SUMS
                if c == $cu { total = total$c; }
//#end
                sums_of_batch[(subgroup * range.z + s) * SUMS + c] = total;
            }
//#else
            let slot = s % CHUNK;
//#for c in 0..SUMS
            partial[(slot * SUMS + $cu) * THREADS + thread] = sums[$c];
//#end
            if slot == CHUNK - 1u || s == n - 1u {
                workgroupBarrier();
                for (var task = thread; task < (slot + 1u) * SUMS; task += THREADS) {
                    var sum = 0.0;
                    for (var k = 0u; k < THREADS; k++) { sum += partial[task * THREADS + (k + thread) % THREADS]; }
                    write(batch_number[s - slot + task / SUMS], task % SUMS, sum);
                }
                workgroupBarrier();
            }
//#end
        }
//#end
//#if RUNS
        }
//#end
        workgroupBarrier();             // the batch has been summed
//#if SUBGROUPS
        for (var task = thread; task < n * SUMS; task += THREADS) {
            var sum = 0.0;
            for (var k = 0u; k < range.w; k++) { sum += sums_of_batch[k * range.z * SUMS + task]; }
            write(batch_number[task / SUMS], task % SUMS, sum);
        }
        workgroupBarrier();             // and used
//#end
    }
    // Zeros for the pairs behind the last that the tile's pixels used.
    for (var pair = max(pairs.x, range.y) + thread; pair < pairs.y; pair += THREADS) {
        let number = numbered[pair].y;
        for (var c = 0u; c < SUMS; c++) { write(number, c, 0.0); }
    }
}
