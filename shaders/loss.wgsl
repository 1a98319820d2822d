// (1 − w)·mean|x − y| + w·(1 − mean SSIM(x, y)) of a rendered image x and the truth y, and its gradient (Kerbl et al.
// 2023, eq. 7): 11×11 Gaussian windows, σ = 1.5, zeros outside the image, mean over pixels and channels.
//
// With d = x − y, A = 2·m1·m2 + C1, B = 2·s12 + C2 the usual formula is S = AB / ((A + md²)(B + vd)), where md and vd
// are the window's mean and variance of d. So four blurred maps (y, d, d², xy) suffice instead of five, and the
// gradient is exactly zero where the images agree, without cancellation nearby. Its adjoint is
//     ∂S/∂x = blur(g1) + 2d·blur(g2) + y·blur(g3),
// with the slopes of S: g1 by the mean of x, g2 by blur(d²), g3 by blur(xy).
//
// A workgroup processes one channel of a tile of WIDTH × HEIGHT = 16 × 40 pixels with the 5 pixels around it that
// windows reach. It loads these into workgroup memory, with consecutive threads on consecutive pixels of a row, so that
// every cache line is read once and whole; with a thread per row each would read lines of its own. Then rows are
// blurred (8 outputs per thread out of 18 inputs), in place, then columns (5 out of 15). Per pixel and channel:
//   forward   2.0 loads, in workgroup memory 1.0 + 1.3 × 16 B stored and 1.4 + 3 × 16 B loaded, 99 multiply-adds,
//             16 B written
//   backward  2.0 loads of 16 B, in workgroup memory 1.6 + 1.3 × 16 B stored and 2.3 + 3 × 16 B loaded,
//             74 multiply-adds, 4 B written
// Memory traffic is 20 + 48 B per pixel forward and 48 + 20 + 16 B backward: 79 MB at 960 × 540, some 16 µs at 5 TB/s.

//#import shared/view.wgsl
//#import shared/loss_terms.wgsl

const ROWS: u32 = HEIGHT + 2u * REACH;
// Strides of rows, in vectors, chosen so that threads on successive rows hit different banks.
const STRIDE: u32 = WIDTH + 1u;         // of what is blurred along x, with a gap
const PAIRS: u32 = WIDTH / 2u + REACH;  // of two numbers of each of WIDTH + 2·REACH pixels, two pixels to a vector
const QUADS: u32 = (PAIRS + 1u) / 2u;   // of one number of each, four pixels to a vector
const SINGLE: u32 = ROWS * PAIRS;       // where these begin

var<workgroup> tile_memory: array<vec4f, ROWS * (PAIRS + QUADS)>;   // then ROWS × STRIDE, then sums of threads

struct Tile {
    corner: vec2u,
    channel: u32,
    inside: bool,
}

fn tile_of(group: u32) -> Tile {
    let across = (view.size.x + WIDTH - 1u) / WIDTH;
    let down = (view.size.y + HEIGHT - 1u) / HEIGHT;
    let tile = group / 3u;
    return Tile(vec2u(tile % across * WIDTH, tile / across * HEIGHT), group % 3u, tile < across * down);
}

// Image position of a column and row of a tile with its surroundings. Wraps around above and left of the image, where
// it is outside as well.
fn pixel_around(tile: Tile, column: u32, row: u32) -> vec2u { return tile.corner + vec2u(column, row) - REACH; }

fn is_inside(at: vec2u) -> bool { return all(at < view.size); }

// Sum over the workgroup's 128 threads; valid in thread 0.
fn workgroup_sum(thread: u32, value: f32) -> f32 {
    workgroupBarrier();                 // all threads have read their columns
    tile_memory[thread].x = value;
    workgroupBarrier();
    if thread < 8u {
        var sum = 0.0;
        for (var i = 0u; i < 16u; i++) { sum += tile_memory[i * 8u + thread].x; }
        tile_memory[thread].x = sum;
    }
    workgroupBarrier();
    var total = 0.0;
    if thread == 0u {
        for (var i = 0u; i < 8u; i++) { total += tile_memory[i].x; }
    }
    return total;
}

// Rendered and true colour, zeros outside the image.
fn compared(at: vec2u, channel: u32, background: f32) -> vec2f {
    if !is_inside(at) { return vec2f(); }
    return colors(at.y * view.size.x + at.x, channel, background).xy;
}

@compute @workgroup_size(128)
fn forward(
    @builtin(local_invocation_index) thread: u32,
    @builtin(workgroup_id) group: vec3u,
) {
    let index = group_index(group);
    let tile = tile_of(index);
    if !tile.inside {
        if thread == 0u && index < arrayLength(&means) { means[index].x = 0.0; }
        return;
    }
    let background = view.background[tile.channel];

    for (var i = thread; i < ROWS * PAIRS; i += 128u) {
        let at = pixel_around(tile, i % PAIRS * 2u, i / PAIRS);
        tile_memory[i] = vec4f(
            compared(at, tile.channel, background), compared(at + vec2u(1u, 0u), tile.channel, background));
    }
    workgroupBarrier();

    let row = thread % 64u;
    let left = thread / 64u * 8u;
    var blurred: array<vec4f, 8>;
    if row < ROWS {
        var v: array<vec4f, 18>;
        //#for i in 0..9
        {
            let pair = tile_memory[row * PAIRS + left / 2u + $iu];
            v[2 * $i] = maps_of(pair.xy);
            v[2 * $i + 1] = maps_of(pair.zw);
        }
        //#end
        //#for k in 0..8
        //#import shared/window.wgsl with NAME=blurred$k K=$k
        blurred[$k] = blurred$k;
        //#end
    }
    workgroupBarrier();
    if row < ROWS {
        //#for k in 0..8
        tile_memory[row * STRIDE + left + $ku] = blurred[$k];
        //#end
    }
    workgroupBarrier();

    let column = thread % WIDTH;
    let top = thread / WIDTH * 5u;
    let at = tile.corner + vec2u(column, top);
    let n_pixels = view.size.x * view.size.y;
    var sum = 0.0;
    var v: array<vec4f, 15>;
    //#for i in 0..15
    v[$i] = tile_memory[(top + $iu) * STRIDE + column];
    //#end
    //#for k in 0..5
    if is_inside(at + vec2u(0u, $ku)) {
        //#import shared/window.wgsl with NAME=m K=$k
        let s = ssim(m);
        sum += s.value;
        slopes[tile.channel * n_pixels + (at.y + $ku) * view.size.x + at.x] = vec4f(s.slopes, 0.0);
    }
    //#end
    let total = workgroup_sum(thread, sum);
    if thread == 0u { means[index].x = total / f32(3u * n_pixels); }
}

// Slopes g1, g2, g3, zeros outside the image.
fn slopes_at(at: vec2u, channel: u32) -> vec3f {
    if !is_inside(at) { return vec3f(); }
    return slopes[(channel * view.size.y + at.y) * view.size.x + at.x].xyz;
}

@compute @workgroup_size(128)
fn backward(
    @builtin(local_invocation_index) thread: u32,
    @builtin(workgroup_id) group: vec3u,
) {
    let index = group_index(group);
    let tile = tile_of(index);
    if !tile.inside {
        if thread == 0u && index < arrayLength(&means) { means[index].y = 0.0; }
        return;
    }
    let background = view.background[tile.channel];
    let n_pixels = view.size.x * view.size.y;

    // Four pixels per thread, so that each vector is written by one thread. The last four of a row have only two in the
    // tile.
    for (var i = thread; i < ROWS * QUADS; i += 128u) {
        let quad = i % QUADS;
        let row = i / QUADS;
        let at = pixel_around(tile, 4u * quad, row);
        let a = slopes_at(at, tile.channel);
        let b = slopes_at(at + vec2u(1u, 0u), tile.channel);
        var c = vec3f();
        var d = vec3f();
        tile_memory[row * PAIRS + 2u * quad] = vec4f(a.xy, b.xy);
        if 2u * quad + 1u < PAIRS {
            c = slopes_at(at + vec2u(2u, 0u), tile.channel);
            d = slopes_at(at + vec2u(3u, 0u), tile.channel);
            tile_memory[row * PAIRS + 2u * quad + 1u] = vec4f(c.xy, d.xy);
        }
        tile_memory[SINGLE + i] = vec4f(a.z, b.z, c.z, d.z);
    }
    workgroupBarrier();

    let row = thread % 64u;
    let left = thread / 64u * 8u;
    var blurred: array<vec3f, 8>;
    if row < ROWS {
        var v: array<vec3f, 20>;
        //#for i in 0..5
        {
            // Half of the last four is not used.
            let a = tile_memory[row * PAIRS + left / 2u + 2u * $iu];
            let b = tile_memory[row * PAIRS + left / 2u + min(2u * $iu + 1u, 8u)];
            let c = tile_memory[SINGLE + row * QUADS + left / 4u + $iu];
            v[4 * $i] = vec3f(a.xy, c.x);
            v[4 * $i + 1] = vec3f(a.zw, c.y);
            v[4 * $i + 2] = vec3f(b.xy, c.z);
            v[4 * $i + 3] = vec3f(b.zw, c.w);
        }
        //#end
        //#for k in 0..8
        //#import shared/window.wgsl with NAME=blurred$k K=$k
        blurred[$k] = blurred$k;
        //#end
    }
    workgroupBarrier();
    if row < ROWS {
        //#for k in 0..8
        tile_memory[row * STRIDE + left + $ku] = vec4f(blurred[$k], 0.0);
        //#end
    }
    workgroupBarrier();

    let column = thread % WIDTH;
    let top = thread / WIDTH * 5u;
    let at = tile.corner + vec2u(column, top);
    let scale = 1.0 / f32(3u * n_pixels);
    var l1 = 0.0;
    var v: array<vec3f, 15>;
    //#for i in 0..15
    v[$i] = tile_memory[(top + $iu) * STRIDE + column].xyz;
    //#end
    //#for k in 0..5
    if is_inside(at + vec2u(0u, $ku)) {
        //#import shared/window.wgsl with NAME=g K=$k
        let pixel = (at.y + $ku) * view.size.x + at.x;
        let c = colors(pixel, tile.channel, background);
        l1 += abs(c.x - c.y);
        gradient[4u * pixel + tile.channel] = loss_slope(c, g, scale);
        if tile.channel == 0u { gradient[4u * pixel + 3u] = disparity_slope(pixel); }
    }
    //#end
    let total = workgroup_sum(thread, l1);
    if thread == 0u { means[index].y = total * scale; }
}
