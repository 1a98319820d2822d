// Ceilings of an adapter, for benchmarks: each entry point does one thing and little else.

@group(0) @binding(0) var<storage, read> source: array<f32>;
//#import shared/fixed_add.wgsl with TARGET=target_sums BINDING=1
//#import shared/blend.wgsl

// Arithmetic of the blend without memory traffic: LOOPS evaluations of a splat per thread, at one pixel each. Every
// parameter of the splat changes from one iteration to the next, as in a list of splats, so that no term can be moved
// out of the loop; colours and squares are permuted, which costs next to nothing, the others drift.
@compute @workgroup_size(256)
fn evaluate(@builtin(global_invocation_id) id: vec3u) {
    let pixel = vec2f(f32(id.x & 15u), f32((id.x >> 4u) & 15u)) + 0.5;
    // 0, but unknown to the compiler.
    let unknown = source[0];
    var center = vec2f(7.5, 8.1) + unknown;
    var squares = vec3f(0.02, 0.05, 0.03) + unknown;
    // Opacity so low that hundreds of splats leave some transmittance; shape so flat that the tile's corners are above
    // the cut.
    var opacity = 0.02 + unknown;
    var rgb = vec3f(0.3, 0.2, 0.1) + unknown;
    let drift = 1e-6 + unknown;
    var color = vec3f(0.0);
    var t = 1.0;
    for (var i = 0u; i < LOOPS; i++) {
        let column = gaussian_column(center, squares, pixel.x);
        let alpha = min(ALPHA_CAP, alpha_at(column, opacity, pixel.y - column.row));
        if alpha >= ALPHA_CUT {
            color += t * alpha * rgb;
            t *= 1.0 - alpha;
        }
        center += drift;
        squares = vec3f(squares.z, squares.y + drift, squares.x);
        opacity += drift;
        rgb = rgb.yzx;
    }
    if color.x + color.y + color.z + t == 12345.0 { add_target_sums(0u, t); }
}

// LOOPS atomic additions per thread, spread over 65536 slots.
@compute @workgroup_size(256)
fn atomics(@builtin(global_invocation_id) id: vec3u) {
    for (var i = 0u; i < LOOPS; i++) {
        add_target_sums((id.x * 17u + i * 4099u) & 0xffffu, 1.0);
    }
}

// Reads a word, writes a word.
//#if COPY
@group(0) @binding(2) var<storage, read_write> destination: array<f32>;

@compute @workgroup_size(256)
fn copy(@builtin(global_invocation_id) id: vec3u) {
    destination[id.x] = source[id.x];
}
//#end

@compute @workgroup_size(1)
fn nothing() {
    if source[0] == 12345.0 { add_target_sums(0u, 1.0); }
}
