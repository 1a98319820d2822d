// Projects every splat: screen ellipse, colour, depth key and the number of tiles it touches (0 = culled). One thread
// per splat. Reads 48 + 12·(d+1)² bytes, writes 56 (8 if culled).
//#import shared/view.wgsl
//#import shared/finite.wgsl
//#import shared/blend.wgsl
//#import shared/projection.wgsl
//#import shared/tile_rows.wgsl
//#import shared/sh.wgsl
//#import shared/sh_coefficients.wgsl
//#import shared/random.wgsl

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> geometry: array<vec4f>;
// 3 vectors per splat: [centre, depth, opacity], [squares, 0], [colour, disparity].
@group(0) @binding(3) var<storage, read_write> projected: array<vec4f>;
@group(0) @binding(4) var<storage, read_write> tile_count: array<u32>;
@group(0) @binding(5) var<storage, read_write> visible: array<u32>;

@compute @workgroup_size(256)
fn main(
    @builtin(workgroup_id) group: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let i = group_index(group) * 256u + thread;
    if i >= view.n_splats { return; }
    tile_count[i] = 0u;
    visible[i] = 0u;
    let g = gaussian(geometry[3u * i], geometry[3u * i + 1u], geometry[3u * i + 2u]);
    var p = project(view, g);
    if view.dropout > 0.0 {
        if unit_numbers(random_words(vec4u(i, view.dropout_seed, 0u, 1u))).x < view.dropout { return; }
        // Keeps the expected contribution to a pixel over steps.
        p.opacity /= 1.0 - view.dropout;
    }
    // Tested by bits, as a compiler may assume that comparisons never see NaN.
    if !are_finite(vec4f(p.center, p.det, p.t.z)) || !is_finite(p.opacity) { return; }
    if !(p.t.z > view.near) || !(p.opacity >= ALPHA_CUT) { return; }
    // Without a filter a splat seen edge-on has no area, and what follows would overflow.
    if !(p.det > 1e-20) { return; }
    let e = ellipse(p.center, p.squares, p.opacity);
    if !are_finite(vec4f(e.extent, 0.0, 0.0)) { return; }
    if !(max(e.extent.x, e.extent.y) < 1e6) || !(max(abs(p.center.x), abs(p.center.y)) < 1e7) { return; }
    let count = tiles_touched(e, view.tiles);
    if count == 0u { return; }

    let basis = sh_basis(normalize(g.mean - view.center));
    let active_terms = (view.sh_degree + 1u) * (view.sh_degree + 1u);
    let coefficients = sh_coefficients(i, active_terms);
    var color = vec3f(0.5);
//#for k in 0..SH_TERMS
    if $ku < active_terms {
        color += basis[$k] * vec3f(coefficients[3u * $ku], coefficients[3u * $ku + 1u], coefficients[3u * $ku + 2u]);
    }
//#end
    projected[3u * i] = vec4f(p.center, p.t.z, p.opacity);
    projected[3u * i + 1u] = vec4f(p.squares, 0.0);
    projected[3u * i + 2u] = vec4f(max(color, vec3f(0.0)), 1.0 / p.t.z);
    tile_count[i] = count;
    visible[i] = 1u;
}
