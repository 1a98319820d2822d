// loss.wgsl for software adapters, which execute the lanes of every load and store in turn: without workgroup memory,
// which is plain memory there, and with many outputs per thread.
//
// A thread walks down a strip of one channel, WIDTH = 8 pixels wide and HEIGHT = 64 high. It blurs a row in registers
// (8 outputs out of 18 loads) and adds it to the sums of the windows it lies in: ten to which later rows belong as
// well, moved up one place on the way, and one that is complete. Per pixel and channel, plus a sixth for the rows
// around a strip: forward 4.5 loads, 16 B written, some 160 multiplications and additions; backward 2.3 loads of 12 B,
// 2 of 4 B, 4 B written, some 110.

//#import shared/view.wgsl
//#import shared/loss_terms.wgsl

struct Strip {
    corner: vec2u,
    channel: u32,
    rows: u32,                          // that lie in the windows of its pixels, also outside of the image; 0: no strip
}

fn strip_of(index: u32) -> Strip {
    let across = (view.size.x + WIDTH - 1u) / WIDTH;
    let down = (view.size.y + HEIGHT - 1u) / HEIGHT;
    let place = index % (across * down);
    let channel = index / (across * down);
    let corner = vec2u(place % across * WIDTH, place / across * HEIGHT);
    let rows = min(HEIGHT, view.size.y - corner.y) + 2u * REACH;
    return Strip(corner, channel, select(0u, rows, channel < 3u));
}

@compute @workgroup_size(32)
fn forward(
    @builtin(local_invocation_index) thread: u32,
    @builtin(workgroup_id) group: vec3u,
) {
    let index = group_index(group) * 32u + thread;
    let strip = strip_of(index);
    let size = view.size;
    let background = view.background[strip.channel];
    let n_pixels = size.x * size.y;
    var total = 0.0;
    var part: array<vec4f, 80>;         // [8, 10]: of the windows around the current row − 5, …, + 4
    for (var row = 0u; row < strip.rows; row += 1u) {
        // Wraps around above and left of the image, where it is outside as well.
        let py = strip.corner.y + row - REACH;
        let line = min(py, size.y - 1u) * size.x;
        var v: array<vec4f, 18>;
        //#for i in 0..18
        {
            let px = strip.corner.x + $iu - REACH;
            let maps = maps_of(colors(line + min(px, size.x - 1u), strip.channel, background).xy);
            v[$i] = select(vec4f(), maps, py < size.y && px < size.x);
        }
        //#end
        //#for k in 0..8
        {
            //#import shared/window.wgsl with NAME=blurred K=$k
            let mean = part[10 * $k] + W5 * blurred;
            //#import shared/move_up.wgsl with K=$k
            let px = strip.corner.x + $ku;
            if row >= 2u * REACH && px < size.x {
                let s = ssim(mean);
                total += s.value;
                slopes[strip.channel * n_pixels + (py - REACH) * size.x + px] = vec4f(s.slopes, 0.0);
            }
        }
        //#end
    }
    if index < arrayLength(&means) { means[index].x = total / f32(3u * n_pixels); }
}

@compute @workgroup_size(32)
fn backward(
    @builtin(local_invocation_index) thread: u32,
    @builtin(workgroup_id) group: vec3u,
) {
    let index = group_index(group) * 32u + thread;
    let strip = strip_of(index);
    let size = view.size;
    let background = view.background[strip.channel];
    let n_pixels = size.x * size.y;
    let scale = 1.0 / f32(3u * n_pixels);
    var total = 0.0;
    var part: array<vec3f, 80>;
    for (var row = 0u; row < strip.rows; row += 1u) {
        let py = strip.corner.y + row - REACH;
        let line = strip.channel * n_pixels + min(py, size.y - 1u) * size.x;
        var v: array<vec3f, 18>;
        //#for i in 0..18
        {
            let px = strip.corner.x + $iu - REACH;
            v[$i] = select(vec3f(), slopes[line + min(px, size.x - 1u)].xyz, py < size.y && px < size.x);
        }
        //#end
        //#for k in 0..8
        {
            //#import shared/window.wgsl with NAME=blurred K=$k
            let mean = part[10 * $k] + W5 * blurred;
            //#import shared/move_up.wgsl with K=$k
            let px = strip.corner.x + $ku;
            if row >= 2u * REACH && px < size.x {
                let pixel = (py - REACH) * size.x + px;
                let c = colors(pixel, strip.channel, background);
                total += abs(c.x - c.y);
                gradient[4u * pixel + strip.channel] = loss_slope(c, mean, scale);
                if strip.channel == 0u { gradient[4u * pixel + 3u] = disparity_slope(pixel); }
            }
        }
        //#end
    }
    if index < arrayLength(&means) { means[index].y = total * scale; }
}
