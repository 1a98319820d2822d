// What all stages must agree on that evaluate a splat at a pixel, or bound where that is worth it.

const EMPTY_DEPTH: f32 = 3.4028234e38;  // of a pixel without a mesh layer: no threshold exceeds it

// A splat's Gaussian is exp(−½ (squares.x·dx² + squares.z·(dy − squares.y·dx)²)) at an offset (dx, dy) from its centre: Σ'⁻¹ as a sum of squares, of which
// nothing cancels. In dx², dx·dy and dy² the terms of a needle of a thousand pixels do in all digits that f32 has.
// Along a column of pixels its logarithm is x − yy·y², y rows from where that column has most of it.
struct GaussianColumn {
    x: f32,
    row: f32,
    yy: f32,
}

fn gaussian_column(center: vec2f, squares: vec3f, px: f32) -> GaussianColumn {
    let dx = px - center.x;
    return GaussianColumn(-0.5 * squares.x * dx * dx, center.y + squares.y * dx, 0.5 * squares.z);
}

// Opacity times the Gaussian, not capped.
fn alpha_at(c: GaussianColumn, opacity: f32, y: f32) -> f32 {
    return opacity * exp(c.x - c.yy * y * y);
}

// Σ'⁻¹ times an offset of dx columns from the centre, and of y rows from where that column has most: what pulls at the centre, by the logarithm.
fn pull(squares: vec3f, dx: f32, y: f32) -> vec2f {
    let down = squares.z * y;
    return vec2f(squares.x * dx - squares.y * down, down);
}
