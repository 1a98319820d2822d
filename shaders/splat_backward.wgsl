// Converts the screen-space sums of `blend_backward` to gradients of a splat's parameters, and to the statistics of
// density control. One thread per splat; gradients of splats that are not visible are stale. With POSES also a splat's
// part of the gradient by the pose's rotation: W' = exp(ω)·W rotates t and the rows J of the projection. `pose` sums
// these parts in a kernel without this large function, which Mesa's software adapter takes minutes to compile if there
// are barriers in it.
//#import shared/view.wgsl
//#import shared/projection.wgsl
//#import shared/blend.wgsl
//#import shared/sh.wgsl
//#import shared/sh_coefficients.wgsl
//#import shared/sh_gradient.wgsl
//#import shared/status.wgsl

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> geometry: array<vec4f>;
@group(0) @binding(3) var<storage, read> projected: array<vec4f>;
@group(0) @binding(4) var<storage, read> visible: array<u32>;
@group(0) @binding(5) var<storage, read> sums: array<f32>;
@group(0) @binding(6) var<storage, read_write> geometry_gradient: array<vec4f>;
@group(0) @binding(7) var<storage, read_write> sh_gradient: array<Floats>;
// Per splat, summed over views: ‖(½W·∂u, ½H·∂v)‖, number of views in which it was visible, blend weight, and, if
// ABSOLUTE, the first with sums of absolute values over pixels, else 0.
@group(0) @binding(8) var<storage, read_write> statistics: array<vec4f>;
@group(0) @binding(9) var<storage, read_write> status: Status;
//#if POSES
@group(0) @binding(10) var<storage, read_write> turn_gradient: array<vec4f>;  // of L by ω, its part; last of four is 0
//#end

@compute @workgroup_size(256)
fn main(
    @builtin(workgroup_id) group: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let i = group_index(group) * 256u + thread;
    if i >= view.n_splats || visible[i] == 0u { return; }
    let first = i * SH_LOADS;
    let at = SUMS * i;
    let sp = sums[at];
    let sd = vec2f(sums[at + 1u], sums[at + 2u]);
    let sdd = vec3f(sums[at + 3u], sums[at + 4u], sums[at + 5u]);
    let weight = sums[at + 9u];
    var g_color = vec3f(sums[at + 6u], sums[at + 7u], sums[at + 8u]);

    let g = gaussian(geometry[3u * i], geometry[3u * i + 1u], geometry[3u * i + 2u]);
    let p = project(view, g);
    let q = p.squares;

    // Clamped colour channels pass no gradient.
    let offset = g.mean - view.center;
    let distance = length(offset);
    let direction = offset / distance;
    let basis = sh_basis(direction);
    let slopes = sh_basis_gradient(direction);
    let active_terms = (view.sh_degree + 1u) * (view.sh_degree + 1u);
    g_color = select(vec3f(0.0), g_color, projected[3u * i + 2u].xyz > vec3f(0.0));
    // Coefficients, overwritten below by their gradients.
    var coefficients = sh_coefficients(i, SH_TERMS);
    var g_direction = vec3f(0.0);
//#for k in 0..SH_TERMS
    {
        let on = select(0.0, 1.0, $ku < active_terms);
        g_direction += on * dot(vec3f(coefficients[3u * $ku], coefficients[3u * $ku + 1u], coefficients[3u * $ku + 2u]), g_color) * slopes[$k];
        let g_c = on * basis[$k] * g_color;
        coefficients[3u * $ku] = g_c.x;
        coefficients[3u * $ku + 1u] = g_c.y;
        coefficients[3u * $ku + 2u] = g_c.z;
    }
//#end
//#for l in 0..SH_LOADS
//#if FOURS
    sh_gradient[first + $lu] = vec4f(coefficients[4u * $lu], coefficients[4u * $lu + 1u], coefficients[4u * $lu + 2u], coefficients[4u * $lu + 3u]);
//#else
    sh_gradient[first + $lu] = coefficients[$l];
//#end
//#end
    var g_mean = (g_direction - direction * dot(direction, g_direction)) / distance;

    // Offsets δ = L·(dx, y) and Q = Σ'⁻¹ = L⁻ᵀ·D·L⁻¹, with L = [1, 0; q.y, 1] and D = diag(q.x, q.z). Screen mean:
    // ∂power/∂u = Qδ.
    let g_uv = pull(q, sd.x, sd.y);
    // Screen covariance: G_Σ = Q·(½Σp·δδᵀ)·Q. Σ2 = [n0·n0, n0·n1; n0·n1, n1·n1], n = scale ∘ Rᵀm: the derivative by n
    // is 2·G_Σ·n = L⁻ᵀ·(D·Σp·(dx, y)(dx, y)ᵀ)·(Lᵀ·Q·n), where Lᵀ·Q·n = (q.x·n0, a1) if a = Q·n. This form avoids
    // differences of products, which for a needle agree in all of their digits.
    let across = cross(p.n0, p.n1);
    let k = view.filter_variance;
    let a0 = (cross(p.n1, across) + k * p.n0) / p.det;
    let a1 = (cross(across, p.n0) + k * p.n1) / p.det;
    var g_n1 = q.z * (sdd.y * q.x * p.n0 + sdd.z * a1);
    var g_n0 = q.x * (sdd.x * q.x * p.n0 + sdd.y * a1) - q.y * g_n1;
    // power = ln(alpha/opacity), so sp is the derivative by the logarithm of the opacity and of each of its factors.
    // The factor of the pixel filter is |n0 × n1| / √det Σ'.
    if view.filter_normalized != 0u {
        let inverse = across / dot(across, across);
        g_n0 += sp * (cross(p.n1, inverse) - a0);
        g_n1 += sp * (cross(inverse, p.n0) - a1);
    }
    let g_m0 = g.rotation * (g.scale * g_n0);
    let g_m1 = g.rotation * (g.scale * g_n1);

    // Gradient of J by t; where t.xy is clamped, x̂ = z·limit depends on z alone.
    let w0 = view.row_x.xyz; let w1 = view.row_y.xyz; let w2 = view.row_z.xyz;
    let f = view.focal;
    let z = p.t.z;
    let g_j00 = dot(g_m0, w0); let g_j02 = dot(g_m0, w2);
    let g_j11 = dot(g_m1, w1); let g_j12 = dot(g_m1, w2);
    var g_t = vec3f(f / z * g_uv, -dot(f * p.t.xy, g_uv) / (z * z));
    g_t.z -= (f.x * g_j00 + f.y * g_j11) / (z * z);
    let a = -f / (z * z) * vec2f(g_j02, g_j12);
    let c = 2.0 * f * p.clamped / (z * z * z) * vec2f(g_j02, g_j12);
    let d = -f * p.clamped / (z * z * z) * vec2f(g_j02, g_j12);
    g_t.x += select(0.0, a.x, p.inside.x);
    g_t.y += select(0.0, a.y, p.inside.y);
    g_t.z += c.x + c.y + select(d.x, 0.0, p.inside.x) + select(d.y, 0.0, p.inside.y);
    g_mean += w0 * g_t.x + w1 * g_t.y + w2 * g_t.z;
//#if POSES
    let j0 = f.x / z * vec3f(1.0, 0.0, -p.clamped.x / z);
    let j1 = f.y / z * vec3f(0.0, 1.0, -p.clamped.y / z);
    let by_rows = cross(j0, vec3f(g_j00, dot(g_m0, w1), g_j02)) + cross(j1, vec3f(dot(g_m1, w0), g_j11, g_j12));
    turn_gradient[i] = vec4f(cross(p.t, g_t) - by_rows, 0.0);
//#end

    // n = Nᵀm, N = R·diag(scale): G_N = m0·g_n0ᵀ + m1·g_n1ᵀ. Smoothing multiplies the opacity by Π s/s̃.
    let g_log_scale = g.own_share * (p.n0 * g_n0 + p.n1 * g_n1) + sp * (1.0 - g.own_share);
    // H = G_N·diag(scale): h_j is its column j.
    let h0 = g.scale.x * (p.m0 * g_n0.x + p.m1 * g_n1.x);
    let h1 = g.scale.y * (p.m0 * g_n0.y + p.m1 * g_n1.y);
    let h2 = g.scale.z * (p.m0 * g_n0.z + p.m1 * g_n1.z);
    let qw = g.quaternion.x; let qx = g.quaternion.y; let qy = g.quaternion.z; let qz = g.quaternion.w;
    let g_unit = 2.0 * vec4f(
        qx * (h1.z - h2.y) + qy * (h2.x - h0.z) + qz * (h0.y - h1.x),
        -2.0 * qx * (h1.y + h2.z) + qy * (h1.x + h0.y) + qz * (h2.x + h0.z) + qw * (h1.z - h2.y),
        qx * (h1.x + h0.y) - 2.0 * qy * (h0.x + h2.z) + qz * (h1.z + h2.y) + qw * (h2.x - h0.z),
        qx * (h2.x + h0.z) + qy * (h1.z + h2.y) - 2.0 * qz * (h0.x + h1.y) + qw * (h0.y - h1.x),
    );
    let g_rotation = (g_unit - g.quaternion * dot(g.quaternion, g_unit)) / g.quaternion_length;

    geometry_gradient[3u * i] = vec4f(g_mean, sp * g.transparency);
    geometry_gradient[3u * i + 1u] = g_rotation;
    geometry_gradient[3u * i + 2u] = vec4f(g_log_scale, 0.0);

    if status.is_short != 0u { return; }
    let old = statistics[i];
    let norm = length(0.5 * vec2f(view.size) * g_uv);
    var pulled = 0.0;
//#if ABSOLUTE
    pulled = length(0.5 * vec2f(view.size) * vec2f(sums[at + 10u], sums[at + 11u]));
//#end
    statistics[i] = old + vec4f(norm, 1.0, weight, pulled);
}
