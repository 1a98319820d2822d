@group(0) @binding($BINDING) var<storage, read> sh: array<f32>;

// Colour of splat i in the direction at which `basis` was evaluated.
fn radiance(i: u32, basis: array<f32, 16>) -> vec3f {
    let first = i * 3u * SH_TERMS;
    var color = vec3f(0.5);
//#for k in 0..SH_TERMS
    color += basis[$k] * vec3f(sh[first + 3u * $ku], sh[first + 3u * $ku + 1u], sh[first + 3u * $ku + 2u]);
//#end
    return max(color, vec3f(0.0));
}
