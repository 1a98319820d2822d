// The bucket of a splat at all pixels of a tile, if it is the same everywhere. Most splats are in front of the mesh
// throughout a tile, or behind it: these need no per-pixel decision and no state of other buckets.

const MIXED: u32 = BUCKETS;             // the bucket differs from pixel to pixel

var<workgroup> nearest: array<atomic<u32>, LAYERS>;     // depth of each layer in the tile, bits of a positive f32
var<workgroup> farthest: array<atomic<u32>, LAYERS>;    // EMPTY_DEPTH if a pixel lacks the layer

fn clear_depths() {
//#for l in 0..LAYERS
    atomicStore(&nearest[$l], bitcast<u32>(EMPTY_DEPTH));
    atomicStore(&farthest[$l], 0u);
//#end
}

// Includes depths of layer l at some pixels of the tile, at most EMPTY_DEPTH.
fn include_depths(l: u32, low: f32, high: f32) {
    atomicMin(&nearest[l], bitcast<u32>(low));
    atomicMax(&farthest[l], bitcast<u32>(high));
}

// First and last bucket that a splat may be in at a pixel of the tile; call after a barrier. A splat is behind a layer
// where the layer's depth is below the threshold.
fn bucket_span(splat: u32) -> vec2u {
    var last = 0u;
//#for l in LAYERS..0
    let threshold$l = thresholds[splat * LAYERS + $lu];
    if last == 0u && bitcast<f32>(atomicLoad(&nearest[$l])) < threshold$l { last = $lu + 1u; }
    if bitcast<f32>(atomicLoad(&farthest[$l])) < threshold$l { return vec2u($lu + 1u, last); }
//#end
    return vec2u(0u, last);
}

fn tile_bucket(splat: u32) -> u32 {
    let span = bucket_span(splat);
    return select(MIXED, span.x, span.x == span.y);
}

//#if RUNS
// Splats are processed in runs that share a path through the blend: the bucket they are in throughout the tile, or
// MIXED. A run consists of blocks, since changing paths costs as much as several splats.
const BLOCK: u32 = 8u;

var<workgroup> block_path: array<u32, BATCH / BLOCK>;

fn mark_paths(thread: u32, n: u32) {
    for (var block = thread; BLOCK * block < n; block += THREADS) {
        var path = batch_bucket[BLOCK * block];
        for (var s = BLOCK * block + 1u; s < min(n, BLOCK * (block + 1u)); s++) {
            if batch_bucket[s] != path { path = MIXED; }
        }
        block_path[block] = path;
    }
}

// The splat after the run that begins with s.
fn run_end(s: u32, n: u32) -> u32 {
    var block = s / BLOCK;
    let path = block_path[block];
    while BLOCK * block < n && block_path[block] == path { block++; }
    return min(n, BLOCK * block);
}
//#end
