// Gradient of the loss by every fragment, and its destination, in fixed point.
//#import shared/fixed_point.wgsl

@group(0) @binding(5) var<storage, read> layer_color: array<vec4f>;     // [LAYERS, h, w]: rgb, alpha
@group(0) @binding(6) var<storage, read> layer_gradient: array<vec4f>;  // [LAYERS, h, w]: of the loss by these
@group(0) @binding(7) var<storage, read> peaks: array<u32>;             // see fixed_point.wgsl
//#import shared/fixed_add.wgsl with TARGET=base_gradient BINDING=8
//#if BANDS
//#import shared/fixed_add.wgsl with TARGET=band_gradient BINDING=9
//#end

// Gradient by the colour and the opacity logit of fragment i, in units: 0 where these are clamped.
fn fragment_gradient(i: u32, scale: f32) -> vec4f {
    let color = layer_color[i];
    let gradient = scale * layer_gradient[i];
    return vec4f(
        select(vec3f(0.0), gradient.rgb, color.rgb > vec3f(0.0)),
        select(0.0, gradient.a * color.a * (1.0 - color.a), color.a < MESH_ALPHA_CAP),
    );
}
