// Tiles that a splat touches, exactly: those with a pixel centre where its alpha can reach ALPHA_CUT, i.e. inside the
// ellipse δᵀΣ'⁻¹δ ≤ 2·ln(255·opacity), as in gsplat. Evaluated one tile row at a time.

const TILE_EPSILON: f32 = 0.01;         // px; keeps rounding from dropping a tile

struct Ellipse {
    center: vec2f,
    squares: vec3f,                     // of Σ' inverted, see blend.wgsl
    level: f32,                         // 2·ln(255·opacity)
    extent: vec2f,                      // half width and height of the bounding box
}

fn ellipse(center: vec2f, squares: vec3f, opacity: f32) -> Ellipse {
    // The logarithm of 1 may come out below 0.
    let level = max(2.0 * log(max(255.0 * opacity, 1.0)), 0.0);
    let variance = 1.0 / squares.xz;    // along x, and along a column
    return Ellipse(center, squares, level, sqrt(level * vec2f(variance.x, variance.y + squares.y * squares.y * variance.x)));
}

// First and one-past-last tile whose pixel centres meet [low, high], within 0..count.
fn tile_span(low: f32, high: f32, count: u32) -> vec2u {
    let size = f32(TILE);
    let first = ceil((low - TILE_EPSILON + 0.5) / size - 1.0);
    let last = floor((high + TILE_EPSILON - 0.5) / size) + 1.0;
    return vec2u(clamp(vec2f(first, last), vec2f(0.0), vec2f(f32(count))));
}

fn row_span(e: Ellipse, tiles: vec2u) -> vec2u {
    return tile_span(e.center.y - e.extent.y, e.center.y + e.extent.y, tiles.y);
}

// Tiles [x, y) of tile row `row`.
fn column_span(e: Ellipse, row: u32, tiles: vec2u) -> vec2u {
    // Vertical offsets of the row's first and last pixel centres, cut to the ellipse.
    let top = max(f32(row * TILE) + 0.5 - e.center.y - TILE_EPSILON, -e.extent.y);
    let bottom = min(f32(row * TILE + TILE) - 0.5 - e.center.y + TILE_EPSILON, e.extent.y);
    if top > bottom { return vec2u(0u); }
    // The ellipse's right-most point lies on the line of its columns' peaks; if outside the row, the nearer edge has
    // the extreme.
    let tilt = e.squares.y * e.extent.x;
    let right = edge(e, clamp(tilt, top, bottom), 1.0);
    let left = edge(e, clamp(-tilt, top, bottom), -1.0);
    return tile_span(e.center.x + left, e.center.x + right, tiles.x);
}

// Number of tiles in all rows.
fn tiles_touched(e: Ellipse, tiles: vec2u) -> u32 {
    let rows = row_span(e, tiles);
    var count = 0u;
    for (var row = rows.x; row < rows.y; row++) {
        let columns = column_span(e, row, tiles);
        count += max(columns.y, columns.x) - columns.x;
    }
    return count;
}

// Horizontal offset of the ellipse at vertical offset dy, on the side of `sign`.
fn edge(e: Ellipse, dy: f32, sign: f32) -> f32 {
    let q = e.squares;
    let root = q.x * q.z * (e.extent.y - dy) * (e.extent.y + dy);
    return (q.y * q.z * dy + sign * sqrt(max(root, 0.0))) / (q.x + q.y * q.y * q.z);
}
