// (1 − w)·mean|x − y| + w·(1 − mean SSIM(x, y)) of a rendered image x and the truth y, and its gradient (Kerbl et al. 2023, eq. 7):
// 11×11 Gaussian windows, σ = 1.5, zeros outside the image, mean over pixels and channels.
//
// With d = x − y, A = 2·m1·m2 + C1, B = 2·s12 + C2 the usual formula is S = AB / ((A + md²)(B + vd)), where md and vd
// are the window's mean and variance of d. So four blurred maps do (y, d, d², xy) instead of five, and the gradient is
// exactly zero where the images agree, without cancellation nearby. Its adjoint is
//     ∂S/∂x = blur(g1) + 2d·blur(g2) + y·blur(g3),
// with the slopes of S: g1 by the mean of x, g2 by blur(d²), g3 by blur(xy).
//
// A workgroup does one channel of a 16 × 48 tile. Rows are blurred from global memory (8 outputs per thread out of 18
// loads), columns from workgroup memory (6 outputs out of 16 loads). Per pixel and channel:
//   forward   5.4 cached loads, 1.2 × 16 B workgroup stores and 2.7 loads, 98 multiply-adds, 16 B written
//   backward  2.7 cached 16 B loads, the same in workgroup memory, 73 multiply-adds, 4 B written
// Memory traffic is 20 + 48 B per pixel forward and 48 + 20 + 16 B backward: 79 MB at 960 × 540, some 16 µs at 5 TB/s.

//#import shared/view.wgsl
//#import shared/loss_terms.wgsl

const WIDTH: u32 = 16u;                 // of a tile; as in loss.rs
const HEIGHT: u32 = 48u;
const REACH: u32 = 5u;
const ROWS: u32 = 58u;                  // HEIGHT + 2·REACH
const STRIDE: u32 = 17u;                // WIDTH and a gap: threads on successive rows hit different banks

var<workgroup> rows: array<vec4f, 986>; // ROWS × STRIDE, blurred along x
var<workgroup> sums: array<f32, 128>;

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

// Sum over the workgroup's 128 threads; valid in thread 0.
fn workgroup_sum(thread: u32, value: f32) -> f32 {
    sums[thread] = value;
    workgroupBarrier();
    if thread < 8u {
        var sum = 0.0;
        for (var i = 0u; i < 16u; i++) { sum += sums[i * 8u + thread]; }
        sums[thread] = sum;
    }
    workgroupBarrier();
    var total = 0.0;
    if thread == 0u {
        for (var i = 0u; i < 8u; i++) { total += sums[i]; }
    }
    return total;
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
    let size = view.size;
    let background = view.background[tile.channel];

    let row = thread % 64u;
    let left = thread / 64u * 8u;
    if row < ROWS {
        // Wraps around above and left of the image, and is then outside, too.
        let py = tile.corner.y + row - REACH;
        let px = tile.corner.x + left - REACH;
        var v: array<vec4f, 18>;
        //#for i in 0..18
        v[$i] = vec4f();
        if py < size.y && px + $iu < size.x {
            v[$i] = maps_of(colors(py * size.x + px + $iu, tile.channel, background));
        }
        //#end
        //#for k in 0..8
        rows[row * STRIDE + left + $ku] = W0 * v[$k + 5] + W1 * (v[$k + 4] + v[$k + 6]) + W2 * (v[$k + 3] + v[$k + 7])
            + W3 * (v[$k + 2] + v[$k + 8]) + W4 * (v[$k + 1] + v[$k + 9]) + W5 * (v[$k] + v[$k + 10]);
        //#end
    }
    workgroupBarrier();

    let column = thread % WIDTH;
    let top = thread / WIDTH * 6u;
    let at = tile.corner + vec2u(column, top);
    let n_pixels = size.x * size.y;
    var sum = 0.0;
    var v: array<vec4f, 16>;
    //#for i in 0..16
    v[$i] = rows[(top + $iu) * STRIDE + column];
    //#end
    //#for k in 0..6
    if at.x < size.x && at.y + $ku < size.y {
        let m = W0 * v[$k + 5] + W1 * (v[$k + 4] + v[$k + 6]) + W2 * (v[$k + 3] + v[$k + 7])
            + W3 * (v[$k + 2] + v[$k + 8]) + W4 * (v[$k + 1] + v[$k + 9]) + W5 * (v[$k] + v[$k + 10]);
        let s = ssim(m);
        sum += s.value;
        slopes[tile.channel * n_pixels + (at.y + $ku) * size.x + at.x] = vec4f(s.slopes, 0.0);
    }
    //#end
    let total = workgroup_sum(thread, sum);
    if thread == 0u { means[index].x = total / f32(3u * n_pixels); }
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
    let size = view.size;
    let background = view.background[tile.channel];
    let n_pixels = size.x * size.y;

    let row = thread % 64u;
    let left = thread / 64u * 8u;
    if row < ROWS {
        let py = tile.corner.y + row - REACH;
        let px = tile.corner.x + left - REACH;
        let first = tile.channel * n_pixels + py * size.x + px;
        var v: array<vec3f, 18>;
        //#for i in 0..18
        v[$i] = vec3f();
        if py < size.y && px + $iu < size.x { v[$i] = slopes[first + $iu].xyz; }
        //#end
        //#for k in 0..8
        rows[row * STRIDE + left + $ku] = vec4f(W0 * v[$k + 5] + W1 * (v[$k + 4] + v[$k + 6])
            + W2 * (v[$k + 3] + v[$k + 7]) + W3 * (v[$k + 2] + v[$k + 8]) + W4 * (v[$k + 1] + v[$k + 9])
            + W5 * (v[$k] + v[$k + 10]), 0.0);
        //#end
    }
    workgroupBarrier();

    let column = thread % WIDTH;
    let top = thread / WIDTH * 6u;
    let at = tile.corner + vec2u(column, top);
    let scale = 1.0 / f32(3u * n_pixels);
    var l1 = 0.0;
    var v: array<vec3f, 16>;
    //#for i in 0..16
    v[$i] = rows[(top + $iu) * STRIDE + column].xyz;
    //#end
    //#for k in 0..6
    if at.x < size.x && at.y + $ku < size.y {
        let g = W0 * v[$k + 5] + W1 * (v[$k + 4] + v[$k + 6]) + W2 * (v[$k + 3] + v[$k + 7])
            + W3 * (v[$k + 2] + v[$k + 8]) + W4 * (v[$k + 1] + v[$k + 9]) + W5 * (v[$k] + v[$k + 10]);
        let pixel = (at.y + $ku) * size.x + at.x;
        let c = colors(pixel, tile.channel, background);
        l1 += abs(c.x - c.y);
        gradient[4u * pixel + tile.channel] = loss_slope(c, g, scale);
    }
    //#end
    let total = workgroup_sum(thread, l1);
    if thread == 0u { means[index].y = total * scale; }
}
