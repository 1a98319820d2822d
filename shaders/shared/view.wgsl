// Uniform of the view being rendered, shared by all stages. `View::words` in render/gpu/view.rs writes the same layout;
// it also defines TILE, pixels per tile side, and the modes, MODE_….

//#import shared/group_index.wgsl

struct View {
    row_x: vec4f,                       // rows of R, world→camera; last, x, y and z of what `center` is short of the
                                        // centre
    row_y: vec4f,
    row_z: vec4f,
    center: vec3f,                      // camera centre, world
    disparity_slope: f32,               // ∂L/∂(expected disparity of a pixel), in training, at most; see
                                        // loss_terms.wgsl
    focal: vec2f,                       // pixels
    principal: vec2f,                   // pixels, continuous coordinates
    size: vec2u,                        // image, pixels
    tiles: vec2u,                       // image, tiles
    background: vec4f,                  // rgb; w unused
    n_splats: u32,
    sh_degree: u32,                     // active degree, ≤ the stored one
    mode: u32,
    n_triangles: u32,
    near: f32,
    lambda: f32,                        // 3.4e38 stands for infinity (WGSL has no literal for it)
    pair_capacity: u32,                 // (tile, splat) pairs that fit the buffers
    band_degree: u32,                   // active SH degree of mesh maps
    filter_variance: f32,               // px², added to the diagonal of projected covariances
    filter_normalized: u32,             // 1: opacities are scaled so that splats keep their integral
    dropout_seed: u32,
    dropout: f32,                       // part of the splats that are left out, the others being that much more opaque
}

// Computed from the difference to the centre, which is exact if both are far from the origin and near each other: R·p +
// t would be the difference of numbers as large as that distance.
fn to_camera(v: View, p: vec3f) -> vec3f {
    let d = p - v.center - vec3f(v.row_x.w, v.row_y.w, v.row_z.w);
    return vec3f(dot(v.row_x.xyz, d), dot(v.row_y.xyz, d), dot(v.row_z.xyz, d));
}

// Pixel of one of a tile's TILE² threads; beyond the image if that ends within the tile, or if there is no such tile.
fn tile_pixel(v: View, tile: u32, thread: u32) -> vec2u {
    return TILE * vec2u(tile % v.tiles.x, tile / v.tiles.x) + vec2u(thread % TILE, thread / TILE);
}
