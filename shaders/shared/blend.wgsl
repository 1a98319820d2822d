// Evaluation of a splat at a pixel, on which all stages that compute or bound it must agree.

const EMPTY_DEPTH: f32 = 3.4028234e38;  // of a pixel without a mesh layer: no threshold exceeds it

// At an offset (dx, dy) from its centre a splat's Gaussian is exp(−½ (squares.x·dx² + squares.z·(dy − squares.y·dx)²)):
// Σ'⁻¹ as a sum of squares, without cancellation. Expanded in dx², dx·dy and dy², the terms of a needle of hundreds of
// pixels cancel in all digits of f32. Its logarithm, `power` in other comments, is x − yy·y² along a column of pixels,
// y rows from the splat's peak in that column.
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

// Σ'⁻¹ times the offset of dx columns from the centre and y rows from the peak in that column: ∂power/∂centre.
fn pull(squares: vec3f, dx: f32, y: f32) -> vec2f {
    let down = squares.z * y;
    return vec2f(squares.x * dx - squares.y * down, down);
}
