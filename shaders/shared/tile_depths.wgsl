// Includes the depths of a thread's PER_THREAD pixels, `depth$j_$l`, in those of the tile, see tile_bucket.wgsl. Pixels
// outside the image, where `inside$j` is false, do not make a layer farther.
//#for l in 0..LAYERS
var low$l = EMPTY_DEPTH;
var high$l = 0.0;
//#for j in 0..PER_THREAD
low$l = min(low$l, depth$j_$l);
high$l = max(high$l, select(0.0, depth$j_$l, inside$j));
//#end
include_depths($lu, low$l, high$l);
//#end
