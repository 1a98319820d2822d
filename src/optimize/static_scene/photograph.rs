//! What is rendered beside what was photographed.

use crate::{capture::Photo, render::gpu::loss::TruthAlpha};

/// What a photograph's alpha means, as in its evaluation.
pub(super) fn truth_alpha(photo: &Photo) -> TruthAlpha {
    match (photo.masked, photo.has_alpha) {
        (true, _) => TruthAlpha::Mask,
        (false, true) => TruthAlpha::Composite,
        (false, false) => TruthAlpha::Ignore,
    }
}

/// Squared difference of a render from pixel `p` of a photograph: over the background where that is transparent; a mask
/// multiplies both, as in HERA.
pub(super) fn squared_error(photo: &Photo, p: usize, render: &[f32; 3], background: [f32; 3]) -> f32 {
    let truth = &photo.rgba[4 * p..4 * p + 4];
    let a = f32::from(truth[3]) / 255.0;
    let error: f32 = (0..3)
        .map(|c| {
            let rgb = f32::from(truth[c]) / 255.0;
            let seen = if photo.masked { rgb } else { a * rgb + (1.0 - a) * background[c] };
            (seen - render[c]).powi(2)
        })
        .sum();
    if photo.masked { error * a * a } else { error }
}

/// PSNR of a picture as its 8-bit file would show it, dB.
pub(super) fn psnr(photo: &Photo, render: &[[f32; 3]], background: [f32; 3]) -> f64 {
    let shown = |v: f32| (v.clamp(0.0, 1.0) * 255.0).round() / 255.0;
    let error = |(p, rgb): (usize, &[f32; 3])| f64::from(squared_error(photo, p, &rgb.map(shown), background));
    let squares: f64 = render.iter().enumerate().map(error).sum();
    -10.0 * (squares / (3 * render.len()).max(1) as f64).log10()
}
