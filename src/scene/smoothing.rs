//! Smoothing of splats by an isotropic Gaussian: Mip-Splatting's 3-D filter.

use glam::{DVec3, Vec3};

/// Opacity logit of a splat that is smoothed to nothing: far below what any picture shows.
const LEAST_LOGIT: f64 = -100.0;

/// Standard deviations of a splat with these log-scales after convolution with an isotropic Gaussian of standard
/// deviation `deviation`, and the factor on its opacity that keeps its integral in space.
#[must_use]
pub fn smoothed(log_scale: DVec3, deviation: f64) -> (DVec3, f64) {
    let scale = log_scale.exp();
    if deviation == 0.0 {
        return (scale, 1.0);
    }
    let smooth = (scale * scale + deviation * deviation).map(f64::sqrt);
    (smooth, (scale / smooth).element_product())
}

/// [`smoothed`] for stored parameters: log-scales and opacity logit.
pub(crate) fn smoothed_parameters(log_scale: Vec3, opacity_logit: f32, deviation: f32) -> (Vec3, f32) {
    if deviation == 0.0 {
        return (log_scale, opacity_logit);
    }
    let (scale, factor) = smoothed(log_scale.as_dvec3(), deviation.into());
    // Logit of factor·σ(x), in a form that loses no digits at either end of σ.
    let logit = factor.ln() - ((-f64::from(opacity_logit)).exp() + (1.0 - factor)).ln();
    // Not `max`, which would replace NaN by a number.
    (scale.ln().as_vec3(), if logit < LEAST_LOGIT { LEAST_LOGIT } else { logit } as f32)
}
