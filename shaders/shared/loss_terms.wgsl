// Shared by both kernels of the loss: buffers, the window, the compared colours, and SSIM's slopes at a pixel.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> weights: vec4f;                        // x: w; y: index of the view, for its
                                                                          // exposure; z, w: `set_truth`
@group(0) @binding(2) var<storage, read> image: array<f32>;               // rgb and transmittance per pixel
@group(0) @binding(3) var<storage, read> truth: array<u32>;               // RGBA8, r lowest
@group(0) @binding(4) var<storage, read_write> slopes: array<vec4f>;      // [channel][pixel] g1, g2, g3
@group(0) @binding(5) var<storage, read_write> gradient: array<f32>;      // ∂L/∂rgb, and by the pixel's expected
                                                                          // disparity
@group(0) @binding(6) var<storage, read_write> means: array<vec2f>;       // each tile's part of mean SSIM and L1
//#if EXPOSURE
@group(0) @binding(7) var<storage, read> exposures: array<vec4f>;         // [view][row], see exposure.wgsl
//#end

const REACH: u32 = 5u;                  // pixels of the window on either side of its centre
// Half of the normalised Gaussian, σ = 1.5.
const W0: f32 = 0.26601172;
const W1: f32 = 0.21300554;
const W2: f32 = 0.10936069;
const W3: f32 = 0.03600077;
const W4: f32 = 0.00759876;
const W5: f32 = 0.00102838;
const C1: f32 = 0.0001;                 // (0.01·range)²
const C2: f32 = 0.0009;                 // (0.03·range)²
const AMISS: f32 = 0.02;                // 5/255: what a pixel that shows its photograph differs by, about

// Rendered, then exposed colour; the true one; and the slope of the former by the colour after exposure. `background`
// is the view's, for this channel; truth with alpha is composited over the exposed background, so that pixels in which
// neither has anything do not affect the exposure.
fn colors(pixel: u32, channel: u32, background: f32) -> vec3f {
    let word = truth[pixel];
    var x = image[4u * pixel + channel];
    var behind = background;
    //#if EXPOSURE
    let row = exposures[3u * u32(weights.y) + channel];
    x = dot(row.xyz, vec3f(image[4u * pixel], image[4u * pixel + 1u], image[4u * pixel + 2u])) + row.w;
    behind = dot(row.xyz, view.background.xyz) + row.w;
    //#end
    var y = f32((word >> (8u * channel)) & 255u) * (1.0 / 255.0);
    let alpha = f32(word >> 24u) * (1.0 / 255.0);
    let slope = mix(1.0, alpha, weights.w);
    let part = mix(1.0, alpha, weights.z);
    // Not `mix`, so that y is unchanged where the part is 1.
    y = part * y + (1.0 - part) * behind;
    return vec3f(x * slope, y * slope, slope);
}

// SSIM of a window and its slopes g1, g2, g3, from the window's means of (y, d, d², xy).
struct Ssim {
    value: f32,
    slopes: vec3f,
}

fn ssim(mean: vec4f) -> Ssim {
    let md = mean.y;
    let m2 = mean.x;
    let m1 = m2 + md;
    let vd = mean.z - md * md;
    let a = 2.0 * m1 * m2 + C1;
    let b = 2.0 * (mean.w - m1 * m2) + C2;
    let c = 1.0 / (a + md * md);
    let d = 1.0 / (b + vd);
    let s = a * b * c * d;
    let by_a = b * d * md * md * c * c;
    let by_b = a * c * vd * d * d;
    return Ssim(s, vec3f(2.0 * (m2 * (by_a - by_b) + md * s * (d - c)), -s * d, 2.0 * by_b));
}

// ∂L/∂(expected disparity of a pixel), Σw/z: the full weight where the picture matches the photograph, which then
// constrains it no further; less elsewhere, where the pixel's colour has priority. Not differentiated itself.
fn disparity_slope(pixel: u32) -> f32 {
    if view.disparity_slope == 0.0 { return 0.0; }
    var amiss = 0.0;
    for (var channel = 0u; channel < 3u; channel++) {
        let c = colors(pixel, channel, view.background[channel]);
        amiss = max(amiss, abs(c.x - c.y));
    }
    return view.disparity_slope * exp(-amiss / AMISS);
}

// The four maps to be blurred, from rendered and true colour.
fn maps_of(c: vec2f) -> vec4f {
    let d = c.x - c.y;
    return vec4f(c.y, d, d * d, c.x * c.y);
}

// ∂L/∂x from its blurred slopes.
fn loss_slope(c: vec3f, slopes: vec3f, scale: f32) -> f32 {
    let d = c.x - c.y;
    let by_ssim = slopes.x + 2.0 * d * slopes.y + c.y * slopes.z;
    return c.z * scale * mix(sign(d), -by_ssim, weights.x);
}
