// A batch of BATCH splats in workgroup memory; its colours are of type $COLOR.

var<workgroup> batch_center: array<vec4f, BATCH>;       // centre, depth, opacity
var<workgroup> batch_squares: array<vec4f, BATCH>;
var<workgroup> batch_color: array<$COLOR, BATCH>;
//#if LAYERS
var<workgroup> batch_threshold: array<f32, BATCH * LAYERS>;
var<workgroup> batch_bucket: array<u32, BATCH>;
//#end

// Makes splat i, of this colour, the batch's s-th.
fn load_splat(s: u32, i: u32, color: $COLOR) {
    batch_center[s] = projected[3u * i];
    batch_squares[s] = projected[3u * i + 1u];
    batch_color[s] = color;
//#for l in 0..LAYERS
    batch_threshold[s * LAYERS + $lu] = thresholds[i * LAYERS + $lu];
//#end
//#if LAYERS
    batch_bucket[s] = tile_bucket(i);
//#end
}
