// EWA projection of one splat (Kerbl et al. 2023, eq. 5; filters of Mip-Splatting), shared by the forward and backward
// stages.
//#import shared/rotation.wgsl

struct Gaussian {
    mean: vec3f,
    opacity: f32,                       // smoothed
    transparency: f32,                  // 1 − opacity before smoothing
    rotation: mat3x3f,                  // columns are the local axes in world space
    scale: vec3f,                       // smoothed
    own_share: vec3f,                   // variance before smoothing over that after: 1 unless smoothed
    quaternion: vec4f,                  // (w, x, y, z), unit
    quaternion_length: f32,
}

// s: log-scale, and the standard deviation of the Gaussian that it is smoothed with.
fn gaussian(a: vec4f, q: vec4f, s: vec4f) -> Gaussian {
    let l = length(q);
    let unit = q / l;
    let opacity = 1.0 / (1.0 + exp(-a.w));
    var scale = exp(s.xyz);
    var ratio = vec3f(1.0);             // scale before smoothing over that after
    if s.w > 0.0 {
        let smoothed = sqrt(scale * scale + s.w * s.w);
        ratio = scale / smoothed;
        scale = smoothed;
    }
    return Gaussian(
        a.xyz, opacity * ratio.x * ratio.y * ratio.z, 1.0 - opacity, rotation_matrix(unit), scale, ratio * ratio, unit, l);
}

struct Projection {
    t: vec3f,                           // mean, camera space
    clamped: vec2f,                     // t.xy as the Jacobian sees them (x̂, ŷ)
    inside: vec2<bool>,                 // not clamped
    m0: vec3f,                          // rows of M = J·W
    m1: vec3f,
    n0: vec3f,                          // rows of M·R·diag(scale): Σ2 is their Gram matrix
    n1: vec3f,
    det: f32,                           // of Σ' = Σ2 + filter, px⁴
    squares: vec3f,                     // of Σ' inverted, see blend.wgsl
    center: vec2f,                      // pixels
    opacity: f32,                       // times what the pixel filter leaves of it
}

fn project(v: View, g: Gaussian) -> Projection {
    let t = to_camera(v, g.mean);
    let size = vec2f(v.size);
    let margin = JACOBIAN_MARGIN * 0.5 * size / v.focal;
    let low = -v.principal / v.focal - margin;
    let high = (size - v.principal) / v.focal + margin;
    let slope = t.xy / t.z;
    let inside = (slope >= low) & (slope <= high);
    let clamped = t.z * clamp(slope, low, high);
    let w0 = v.row_x.xyz; let w1 = v.row_y.xyz; let w2 = v.row_z.xyz;
    let m0 = (v.focal.x / t.z) * (w0 - (clamped.x / t.z) * w2);
    let m1 = (v.focal.y / t.z) * (w1 - (clamped.y / t.z) * w2);
    let n0 = g.scale * (m0 * g.rotation);
    let n1 = g.scale * (m1 * g.rotation);
    let k = v.filter_variance;
    let xx = dot(n0, n0); let xy = dot(n0, n1); let yy = dot(n1, n1);
    // √det Σ2 is the area spanned by n0 and n1. Computed from Σ', the determinant of a needle is a difference of
    // products that agree in all of their digits; here nothing is subtracted.
    let across = cross(n0, n1);
    let area2 = dot(across, across);
    let det = area2 + k * (xx + yy) + k * k;
    let squares = vec3f(1.0, xy, 0.0) / (xx + k) + vec3f(0.0, 0.0, (xx + k) / det);
    var opacity = g.opacity;
    if v.filter_normalized != 0u { opacity *= sqrt(area2 / det); }
    return Projection(t, clamped, inside, m0, m1, n0, n1, det, squares, v.focal * slope + v.principal, opacity);
}
