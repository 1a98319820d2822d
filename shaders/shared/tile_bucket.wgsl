// The bucket that a splat is in at all pixels of a tile, if it is the same everywhere (METHODS 4.4, 4.5). Most splats
// are in front of the mesh throughout a tile or behind it: these need no decision and no state of other buckets.

const MIXED: u32 = BUCKETS;             // the bucket differs from pixel to pixel

var<workgroup> nearest: array<atomic<u32>, LAYERS>;     // depth of each layer in the tile, bits of a positive f32
var<workgroup> farthest: array<atomic<u32>, LAYERS>;    // EMPTY_DEPTH if a pixel lacks the layer

fn clear_depths() {
//#for l in 0..LAYERS
    atomicStore(&nearest[$l], bitcast<u32>(EMPTY_DEPTH));
    atomicStore(&farthest[$l], 0u);
//#end
}

// Depths of layer l at some pixels of the tile, at most EMPTY_DEPTH.
fn include_depths(l: u32, low: f32, high: f32) {
    atomicMin(&nearest[l], bitcast<u32>(low));
    atomicMax(&farthest[l], bitcast<u32>(high));
}

// After a barrier. A splat is behind a layer where the layer's depth is below the threshold.
fn tile_bucket(splat: u32) -> u32 {
//#for l in LAYERS..0
    let threshold$l = thresholds[splat * LAYERS + $lu];
    if bitcast<f32>(atomicLoad(&farthest[$l])) < threshold$l { return $lu + 1u; }
    if bitcast<f32>(atomicLoad(&nearest[$l])) < threshold$l { return MIXED; }
//#end
    return 0u;
}
