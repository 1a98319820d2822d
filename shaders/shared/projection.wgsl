// EWA projection of one splat (METHODS 2.2), shared by the forward and backward stages.
//#import shared/rotation.wgsl

const LOW_PASS: f32 = 0.3;              // px², added to the screen covariance's diagonal (3DGS)
const CLAMP_MARGIN: f32 = 0.3;          // of half the image, for the Jacobian's clamp

struct Gaussian {
    mean: vec3f,
    opacity: f32,
    rotation: mat3x3f,                  // columns are the local axes in world space
    scale: vec3f,
    quaternion: vec4f,                  // (w, x, y, z), unit
    quaternion_length: f32,
}

fn gaussian(a: vec4f, q: vec4f, s: vec4f) -> Gaussian {
    let l = length(q);
    let unit = q / l;
    return Gaussian(a.xyz, 1.0 / (1.0 + exp(-a.w)), rotation_matrix(unit), exp(s.xyz), unit, l);
}

struct Projection {
    t: vec3f,                           // mean, camera space
    clamped: vec2f,                     // t.xy as the Jacobian sees them (x̂, ŷ)
    inside: vec2<bool>,                 // not clamped
    m0: vec3f,                          // rows of J·W
    m1: vec3f,
    covariance: vec3f,                  // Σ2 + LOW_PASS·I: xx, xy, yy
    conic: vec3f,                       // its inverse
    center: vec2f,                      // pixels
}

fn project(v: View, g: Gaussian) -> Projection {
    let t = to_camera(v, g.mean);
    let size = vec2f(v.size);
    let margin = CLAMP_MARGIN * 0.5 * size / v.focal;
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
    let covariance = vec3f(dot(n0, n0) + LOW_PASS, dot(n0, n1), dot(n1, n1) + LOW_PASS);
    let det = covariance.x * covariance.z - covariance.y * covariance.y;
    let conic = vec3f(covariance.z, -covariance.y, covariance.x) / det;
    return Projection(t, clamped, inside, m0, m1, covariance, conic, v.focal * slope + v.principal);
}
