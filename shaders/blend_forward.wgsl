// Blends a tile's depth-sorted splats and the mesh layers, front to back. One traversal suffices: a splat belongs to
// bucket b, the number of layers in front of it at this pixel, and "over" is associative, so every bucket is
// accumulated on its own and all are composited with the layers at the end. A thread owns PER_THREAD pixels of one tile
// column, so that a splat's record is read once for all of them. For training, disparities 1/z are blended as a fourth
// colour.
// Per (splat, pixel): 1 exp, ~25 flops. Per splat and tile: 52 + 4·LAYERS bytes. Per pixel: 20·LAYERS bytes
// read, 16 written and 24·BUCKETS saved.
//#import shared/view.wgsl
//#import shared/blend.wgsl

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> ranges: array<vec2u>;
@group(0) @binding(2) var<storage, read> pair_splats: array<u32>;
@group(0) @binding(3) var<storage, read> projected: array<vec4f>;
@group(0) @binding(4) var<storage, read_write> image: array<vec4f>;      // rgb, final transmittance
//#if SAVE
@group(0) @binding(5) var<storage, read_write> buckets: array<vec4f>;    // [BUCKETS][pixel]: colour, transmittance
@group(0) @binding(6) var<storage, read_write> ends: array<vec2u>;       // [BUCKETS][pixel]: pair after the last used,
                                                                         // bits of the disparity
alias Blended = vec4f;                  // rgb, disparity
//#else
alias Blended = vec3f;                  // rgb
//#end
//#if LAYERS
@group(0) @binding(7) var<storage, read> thresholds: array<f32>;
@group(0) @binding(8) var<storage, read> layer_depth: array<f32>;
@group(0) @binding(9) var<storage, read> layer_color: array<vec4f>;
//#import shared/tile_bucket.wgsl
//#end

const BATCH: u32 = 128u;

//#import shared/batch.wgsl with COLOR=Blended
//#if LAYERS
var<workgroup> until: array<atomic<u32>, BUCKETS>;      // pair after the last that may be in a bucket
//#end
var<workgroup> finished: atomic<u32>;                   // threads with no open bucket left
var<workgroup> n_finished: u32;
var<workgroup> tile_range: vec2u;

@compute @workgroup_size(THREADS)
fn main(
    @builtin(workgroup_id) group: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let tile = group_index(group);
    if tile >= view.tiles.x * view.tiles.y { return; }
    if thread == 0u {
        tile_range = ranges[tile];
        atomicStore(&finished, 0u);
//#if LAYERS
        clear_depths();
//#for b in 0..BUCKETS
        atomicStore(&until[$b], 0u);
//#end
//#end
    }
    let range = workgroupUniformLoad(&tile_range);
    let x = (tile % view.tiles.x) * TILE + thread % TILE;
    let y = (tile / view.tiles.x) * TILE + thread / TILE * PER_THREAD;
    let px = f32(x) + 0.5;
    let n_pixels = view.size.x * view.size.y;

    var color: array<array<Blended, BUCKETS>, PER_THREAD>;
    var t: array<array<f32, BUCKETS>, PER_THREAD>;
    var end: array<array<u32, BUCKETS>, PER_THREAD>;
    var front: array<array<f32, BUCKETS>, PER_THREAD>;  // bounds the transmittance of what lies before a bucket
    var open: array<array<bool, BUCKETS>, PER_THREAD>;
//#for j in 0..PER_THREAD
    let y$j = y + $ju;
    let py$j = f32(y$j) + 0.5;
    let inside$j = x < view.size.x && y$j < view.size.y;
    let pixel$j = y$j * view.size.x + x;
//#for b in 0..BUCKETS
    color[$j][$b] = Blended();
    t[$j][$b] = 1.0;
    end[$j][$b] = range.x;
    front[$j][$b] = 1.0;
    open[$j][$b] = inside$j;
//#end
//#for l in 0..LAYERS
    var depth$j_$l = EMPTY_DEPTH;
    var layer$j_$l = vec4f(0.0);
    if inside$j {
        let d = layer_depth[$lu * n_pixels + pixel$j];
        if d > 0.0 {
            depth$j_$l = d;
            layer$j_$l = layer_color[$lu * n_pixels + pixel$j];
        }
    }
//#end
//#end
//#import shared/tile_depths.wgsl
//#if LAYERS
    // Otherwise the pixels of a bucket that has received all its splats would keep the tile going to the list's end.
    workgroupBarrier();
    var last = array<u32, BUCKETS>();
    for (var i = range.x + thread; i < range.y; i += THREADS) {
        let span = bucket_span(pair_splats[i]);
//#for b in 0..BUCKETS
        if span.x <= $bu && $bu <= span.y { last[$b] = i + 1u; }
//#end
    }
//#for b in 0..BUCKETS
    atomicMax(&until[$b], last[$b]);
//#end
    workgroupBarrier();
//#end
    var any_open = true;

    for (var start = range.x; start < range.y; start += BATCH) {
        // Closes buckets that are complete, or hidden by known content in front of them; stops when the tile has none
        // open.
        if any_open {
            any_open = false;
//#if LAYERS
//#for b in 0..BUCKETS
            let more$b = start < atomicLoad(&until[$b]);
//#end
//#end
//#for j in 0..PER_THREAD
            {
                var before = 1.0;
//#for b in 0..BUCKETS
                front[$j][$b] = before;
                open[$j][$b] = open[$j][$b] && before * t[$j][$b] >= TRANSMITTANCE_STOP;
//#if LAYERS
                open[$j][$b] = open[$j][$b] && more$b;
//#end
                any_open = any_open || open[$j][$b];
//#if $b<LAYERS
                before *= t[$j][$b] * (1.0 - layer$j_$b.w);
//#end
//#end
            }
//#end
            if !any_open { atomicAdd(&finished, 1u); }
        }
        workgroupBarrier();             // the last batch has been used, `finished` is complete
        if thread == 0u { n_finished = atomicLoad(&finished); }
        if workgroupUniformLoad(&n_finished) == THREADS { break; }
        for (var s = thread; s < min(BATCH, range.y - start); s += THREADS) {
            let i = pair_splats[start + s];
//#if SAVE
            load_splat(s, i, projected[3u * i + 2u]);
//#else
            load_splat(s, i, projected[3u * i + 2u].xyz);
//#end
        }
        workgroupBarrier();
//#if RUNS
        mark_paths(thread, min(BATCH, range.y - start));
        workgroupBarrier();
//#end
        let n = select(0u, min(BATCH, range.y - start), any_open);
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
        for (; s < end_of_$p; s += AT_ONCE) {
//#import shared/splats_at_pixels.wgsl with COUNT=AT_ONCE END=end_of_$p
//#for m in 0..AT_ONCE
            let value$m = batch_color[at$m];
//#for j in 0..PER_THREAD
            {
//#if 1<AT_ONCE
                let alpha = min(ALPHA_CAP, raw$m_$j);
//#else
                let alpha = min(ALPHA_CAP, alpha_at(column$m, center$m.w, py$j - column$m.row));
//#end
                if alpha >= ALPHA_CUT {
                    var bucket = $pu % BUCKETS;
//#for l in 0..LAYERS
                    if $pu == MIXED && depth$j_$l < threshold$m_$l { bucket = $lu + 1u; }
//#end
//#for b in 0..BUCKETS
                    if bucket == $bu && open[$j][$b] {
                        let after = t[$j][$b] * (1.0 - alpha);
                        // 3DGS stops without adding the splat that takes the transmittance below TRANSMITTANCE_STOP.
                        if front[$j][$b] * after < TRANSMITTANCE_STOP {
                            open[$j][$b] = false;
                        } else {
                            color[$j][$b] += t[$j][$b] * alpha * value$m;
                            t[$j][$b] = after;
                            end[$j][$b] = start + s + $mu + 1u;
                        }
                    }
//#end
                }
            }
//#end
//#end
        }
        s = min(s, end_of_$p);
//#end
//#if RUNS
        }
//#end
    }

//#for j in 0..PER_THREAD
    if inside$j {
        var behind = view.background.xyz;
        var transmittance = 1.0;
//#for b in BUCKETS..0
//#if $b<LAYERS
        behind = layer$j_$b.w * layer$j_$b.xyz + (1.0 - layer$j_$b.w) * behind;
        transmittance *= 1.0 - layer$j_$b.w;
//#end
        behind = color[$j][$b].xyz + t[$j][$b] * behind;
        transmittance *= t[$j][$b];
//#if SAVE
        buckets[$bu * n_pixels + pixel$j] = vec4f(color[$j][$b].xyz, t[$j][$b]);
        ends[$bu * n_pixels + pixel$j] = vec2u(end[$j][$b], bitcast<u32>(color[$j][$b].w));
//#end
//#end
        image[pixel$j] = vec4f(behind, transmittance);
    }
//#end
}
