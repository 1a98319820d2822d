// What all stages must agree on that evaluate a splat at a pixel, or bound where that is worth it.

const EMPTY_DEPTH: f32 = 3.4028234e38;  // of a pixel without a mesh layer: no threshold exceeds it

// A splat's Gaussian along a column of pixels `dx` from its centre: its logarithm is x + dy·(xy − yy·dy), `power` in other comments.
struct GaussianColumn {
    x: f32,
    xy: f32,
    yy: f32,
}

fn gaussian_column(conic: vec3f, dx: f32) -> GaussianColumn {
    return GaussianColumn(-0.5 * conic.x * dx * dx, -conic.y * dx, 0.5 * conic.z);
}

// Opacity times the Gaussian, not capped. Near the axis of a needle, terms that cancel may round to more than 0.
fn alpha_at(c: GaussianColumn, opacity: f32, dy: f32) -> f32 {
    return opacity * exp(min(c.x + dy * (c.xy - c.yy * dy), 0.0));
}
