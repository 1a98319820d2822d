// What the adapter can do at best, for benchmarks: each entry point does one thing and little else.

@group(0) @binding(0) var<storage, read> source: array<f32>;
//#import shared/atomic_add.wgsl with TARGET=target_sums BINDING=1

// The arithmetic of the blend with no memory: LOOPS splat·pixel evaluations per thread.
@compute @workgroup_size(256)
fn evaluate(@builtin(global_invocation_id) id: vec3u) {
    let px = f32(id.x & 15u);
    let py = f32((id.x >> 4u) & 15u);
    var color = vec3f(0.0);
    var t = 1.0;
    var x = 7.5 + f32(id.x) * 1e-9;
    for (var i = 0u; i < LOOPS; i++) {
        let d = vec2f(px - x, py - 8.1);
        let power = -0.5 * (0.02 * d.x * d.x + 0.03 * d.y * d.y) - 0.001 * d.x * d.y;
        let alpha = min(0.99, 0.05 * exp(power));
        if power <= 0.0 && alpha >= 1.0 / 255.0 {
            color += t * alpha * vec3f(0.3, 0.2, 0.1);
            t *= 1.0 - alpha;
        }
        x += 1e-3;
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
