// Picture in parts under the EWA model: the sums of `blend_forward`, kept apart. One thread per pixel, which traverses
// its tile's list once for every bucket; written for readability, as it runs once per picture.
//#import shared/view.wgsl
//#import shared/blend.wgsl
//#import shared/layered.wgsl

//#if LAYERS
@group(0) @binding(9) var<storage, read> thresholds: array<f32>;
//#end

@compute @workgroup_size(256)
fn main(
    @builtin(workgroup_id) group: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let tile = group_index(group);
    let place = tile_pixel(view, tile, thread);
    if any(place >= view.size) { return; }
    let at = vec2f(place) + 0.5;
    let pixel = place.y * view.size.x + place.x;
    let range = ranges[tile];
    var parts = nothing();
    var normal = vec3f(0.0);
//#if LAYERS
    let area = view.size.x * view.size.y;
    normal = front_normal(place);
//#for l in 0..LAYERS
    let raw$l = layer_depth[$lu * area + pixel];
    let depth$l = select(EMPTY_DEPTH, raw$l, raw$l > 0.0);
//#end
//#end
    var bucket = 0u;
//#if PATIENCE
    let before = progress.pixels[pixel];
    if before.x == FINISHED { return; }
    if before.x == UNFINISHED {
        parts = kept_parts(pixel);
        bucket = before.y;
    }
    var passed = 0u;
//#end
    for (; bucket <= LAYERS; bucket++) {
//#if PATIENCE
        if passed > PATIENCE { break; }
        passed += range.y - range.x;
//#end
        for (var k = range.x; k < range.y; k++) {
            let i = pair_splats[k];
            let a = projected[3u * i];
            let column = gaussian_column(a.xy, projected[3u * i + 1u].xyz, at.x);
            let alpha = min(ALPHA_CAP, alpha_at(column, a.w, at.y - column.row));
            if alpha >= ALPHA_CUT {
                var behind = 0u;
//#for l in 0..LAYERS
                if depth$l < thresholds[i * LAYERS + $lu] { behind = $lu + 1u; }
//#end
                if behind == bucket {
                    if parts.transmittance * (1.0 - alpha) < TRANSMITTANCE_STOP { break; }
                    add_splat(&parts, alpha, projected[3u * i + 2u].xyz, a.z);
                }
            }
        }
//#for l in 0..LAYERS
        if bucket == $lu && raw$l > 0.0 { add_fragment(&parts, layer_color[$lu * area + pixel], raw$l); }
//#end
    }
//#if PATIENCE
    keep(pixel, parts, bucket > LAYERS, vec3u(bucket, 0u, 0u));
    if bucket <= LAYERS { return; }
//#end
    write_parts(pixel, parts, normal);
}
