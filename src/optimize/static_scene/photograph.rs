//! What is rendered beside what was photographed.

use crate::{capture::Photo, evaluate, render::gpu::loss::TruthAlpha};

/// What a photograph's alpha means, as in its evaluation.
pub(super) fn truth_alpha(photo: &Photo) -> TruthAlpha {
    match (photo.masked, photo.has_alpha) {
        (true, _) => TruthAlpha::Mask,
        (false, true) => TruthAlpha::Composite,
        (false, false) => TruthAlpha::Ignore,
    }
}

/// Squared difference of a render from pixel `p` of a photograph, as both are scored.
pub(super) fn squared_error(photo: &Photo, p: usize, render: &[f32; 3], background: [f32; 3]) -> f32 {
    let (truth, mask) = evaluate::expected(photo, p, background);
    let error: f32 = truth.iter().zip(render).map(|(truth, render)| (truth - render).powi(2)).sum();
    error * mask * mask
}
