// Per-splat data for `blend_rays`, and the ellipse outside which a splat cannot contribute: the outline of its
// ellipsoid of alpha ALPHA_CUT. One thread per splat.
//
// In coordinates δ = (slope of a pixel's ray) − (slope of the mean's ray) and with the covariance Σ' of (x − s_x z,
// y − s_y z, z), where s is the mean's slope, that outline is the ellipse around ρ²Σ'_·z / (ρ²Σ'_zz − z²) with the
// matrix ρ²/h (Σ' + ρ² Σ'_·z Σ'_z· / h), h = z² − ρ²Σ'_zz: the dual conic ρ²Σ − m mᵀ, shifted so that nothing cancels.
//#import shared/view.wgsl
//#import shared/finite.wgsl
//#import shared/blend.wgsl
//#import shared/projection.wgsl
//#import shared/tile_rows.wgsl
//#import shared/sh.wgsl

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> geometry: array<vec4f>;
//#import shared/radiance.wgsl with BINDING=2
// 3 per splat, for the tile lists: [ellipse's centre, least depth of a peak, opacity], [squares, 0], [colour, 0].
@group(0) @binding(3) var<storage, read_write> projected: array<vec4f>;
@group(0) @binding(4) var<storage, read_write> tile_count: array<u32>;
@group(0) @binding(5) var<storage, read_write> visible: array<u32>;
// 5 per splat, see `blend_rays`.
@group(0) @binding(6) var<storage, read_write> rays: array<vec4f>;

const ROUNDING: f32 = 1e-4;             // relative; bounds are widened by it
const SHARP: f32 = 1e-4;                // px²: added to the ellipse, so that one seen edge-on has an inverse

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
    let t = to_camera(view, g.mean);
    // Tested by bits, as a compiler may assume that comparisons never see NaN.
    if !are_finite(vec4f(t, g.opacity)) || !are_finite(g.quaternion) || !are_finite(vec4f(g.scale, 0.0)) { return; }
    if !(t.z > view.near) || !(g.opacity >= ALPHA_CUT) { return; }
    let slope = t.xy / t.z;
    let x = view.row_x.xyz; let y = view.row_y.xyz; let z = view.row_z.xyz;

    // Outline of the ellipsoid.
    let bare = max(2.0 * log(255.0 * g.opacity), 1e-6);
    let level = bare * (1.0 + ROUNDING);
    let n0 = view.focal.x * g.scale * ((x - slope.x * z) * g.rotation);
    let n1 = view.focal.y * g.scale * ((y - slope.y * z) * g.rotation);
    let n2 = g.scale * (z * g.rotation);
    let depth_variance = level * dot(n2, n2);
    let h = t.z * t.z - depth_variance;
    let shear = vec2f(dot(n0, n2), dot(n1, n2));
    let spread = vec3f(dot(n0, n0), dot(n0, n1), dot(n1, n1));
    let k = level / h;
    var outline = k * (spread + k * vec3f(shear.x * shear.x, shear.x * shear.y, shear.y * shear.y)) + vec3f(SHARP, 0.0, SHARP);
    // Determinant, computed as in `project`.
    let across = cross(n0, n1);
    let sheared = shear.y * n0 - shear.x * n1;
    var det = k * k * (dot(across, across) + k * dot(sheared, sheared)) + SHARP * (outline.x + outline.z - SHARP);
    let mean = view.focal * slope + view.principal;
    var center = mean - k * shear;
    let reach = max(outline.x, outline.z);
    // The ellipsoid reaches the camera's plane or past it, or is too large for f32: for the lists it is visible
    // everywhere.
    let overflows = !are_finite(vec4f(outline, h)) || !are_finite(vec4f(center, det, 0.0));
    if overflows || !(h > 1e-3 * t.z * t.z) || !(reach < 1e12) || !(max(abs(center.x), abs(center.y)) < 1e7) {
        let side = 2.0 * f32(max(view.size.x, view.size.y));
        outline = vec3f(side * side, 0.0, side * side);
        det = outline.x * outline.z;
        center = 0.5 * vec2f(view.size);
    }
    // Squares of the outline at the level that `ellipse` uses, which is not widened.
    let squares = vec3f(bare, outline.y, 0.0) / outline.x + vec3f(0.0, 0.0, bare * outline.x / det);
    let e = ellipse(center, squares, g.opacity);
    let count = tiles_touched(e, view.tiles);
    if count == 0u { return; }

    // The mean's ray in units of standard deviations, each relative to the largest.
    let largest = max(g.scale.x, max(g.scale.y, g.scale.z));
    let s = max(g.scale / largest, vec3f(1e-7));
    let areas = vec3f(s.y * s.z, s.z * s.x, s.x * s.y);
    rays[5u * i] = vec4f(((slope.x * x + slope.y * y + z) * g.rotation) / s, t.z / largest);
    rays[5u * i + 1u] = vec4f((x * g.rotation) / s, mean.x);
    rays[5u * i + 2u] = vec4f((y * g.rotation) / s, mean.y);
    // Cross products of the former with the latter two, in a form without cancellation.
    rays[5u * i + 3u] = vec4f(((y - slope.y * z) * g.rotation) / areas, t.z);
    rays[5u * i + 4u] = vec4f(((slope.x * z - x) * g.rotation) / areas, 0.0);

//#if SH_BY_RAY
    let color = vec3f(0.5);             // blend_rays computes it
//#else
    let color = radiance(i, sh_basis(normalize(g.mean - view.center)));
//#end
    let least = max(t.z - (1.0 + ROUNDING) * sqrt(depth_variance) - ROUNDING * t.z, view.near);
    projected[3u * i] = vec4f(center, least, g.opacity);
    projected[3u * i + 1u] = vec4f(squares, 0.0);
    projected[3u * i + 2u] = vec4f(color, 0.0);
    tile_count[i] = count;
    visible[i] = 1u;
}
