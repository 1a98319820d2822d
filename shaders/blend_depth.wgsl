// Median depth of the splats alone: depth of the splat at which the transmittance falls below one half, 0 where it
// never does. The depth is that of the Gaussian's peak along the pixel's ray, not that of its mean: on a tilted surface
// a flat splat's mean is off by up to its radius. One thread per pixel; run once per training view.
//#import shared/view.wgsl
//#import shared/blend.wgsl
//#import shared/projection.wgsl

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> ranges: array<vec2u>;
@group(0) @binding(2) var<storage, read> pair_splats: array<u32>;
@group(0) @binding(3) var<storage, read> projected: array<vec4f>;
@group(0) @binding(4) var<storage, read_write> depth: array<f32>;
@group(0) @binding(5) var<storage, read> geometry: array<vec4f>;

// Depth at which the ray through `pixel` comes closest to the splat's mean in units of its standard deviations.
fn peak_depth(i: u32, pixel: vec2f, mean_depth: f32) -> f32 {
    let g = gaussian(geometry[3u * i], geometry[3u * i + 1u], geometry[3u * i + 2u]);
    let slope = (pixel - view.principal) / view.focal;
    let ray = view.row_x.xyz * slope.x + view.row_y.xyz * slope.y + view.row_z.xyz;
    let scale = max(g.scale, vec3f(1e-3 * max(g.scale.x, max(g.scale.y, g.scale.z))));
    let along = (ray * g.rotation) / scale;
    let toward = ((g.mean - view.center) * g.rotation) / scale;
    let reach = 3.0 * max(g.scale.x, max(g.scale.y, g.scale.z));
    return clamp(dot(along, toward) / dot(along, along), mean_depth - reach, mean_depth + reach);
}

@compute @workgroup_size(256)
fn main(
    @builtin(workgroup_id) group: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let tile = group_index(group);
    let place = tile_pixel(view, tile, thread);
    if any(place >= view.size) { return; }
    let pixel = vec2f(place) + 0.5;
    let range = ranges[tile];
    var t = 1.0;
    var median = 0.0;
    for (var k = range.x; k < range.y; k++) {
        let i = pair_splats[k];
        let a = projected[3u * i];
        let column = gaussian_column(a.xy, projected[3u * i + 1u].xyz, pixel.x);
        let alpha = min(ALPHA_CAP, alpha_at(column, a.w, pixel.y - column.row));
        if alpha >= ALPHA_CUT {
            t *= 1.0 - alpha;
            if t < 0.5 {
                median = max(peak_depth(i, pixel, a.z), view.near);
                break;
            }
        }
    }
    depth[place.y * view.size.x + place.x] = median;
}
