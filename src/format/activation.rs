//! Conversion between the optimised parameters (log-scale, opacity logit) and the linear values that exchange formats
//! store.

use glam::Vec3;

use crate::scene::{self, Mesh, sigmoid};

/// Range of opacities. The largest is the largest f32 below 1, with logit 16.6; the smallest is the smallest normal
/// f32, with logit −87.
const OPACITY_RANGE: [f64; 2] = [f32::MIN_POSITIVE as f64, 1.0 - f32::EPSILON as f64 / 2.0];
const SCALE_RANGE: [f64; 2] = [f32::MIN_POSITIVE as f64, f32::MAX as f64];

/// Opacity `1/(1+e^-l)` of a logit, bounded away from 0 and 1.
pub(super) fn opacity(logit: f32) -> f32 {
    let [low, high] = OPACITY_RANGE;
    sigmoid(f64::from(logit)).clamp(low, high) as f32
}

/// Inverse of [`opacity`]; also, whether the opacity had to be clamped. NaN stays NaN.
pub(super) fn logit(opacity: f32) -> (f32, bool) {
    let [low, high] = OPACITY_RANGE;
    let clamped = f64::from(opacity).clamp(low, high);
    (scene::logit(clamped) as f32, clamped != f64::from(opacity))
}

/// Same as [`logit`], for a texel of a map: limited to ±16.6. Maps are filtered and averaged as logits: if the lower
/// limit were farther from 0 than the upper one, one clear texel would outweigh the opaque ones around it. A limit
/// closer to 0 would leave colour in clear texels: σ(−16.6) is 6e-8.
pub(super) fn map_logit(opacity: f32) -> f32 {
    logit(opacity.clamp(f32::EPSILON / 2.0, 1.0)).0
}

/// Logit at and above which a texel is opaque in an 8-bit image.
const OPAQUE: f32 = 6.2;

/// Number of mesh layers for a scene that states none: the maximum if a surface lets through what is behind it, as
/// cut-outs and glass do, else 1.
pub(super) fn layers(meshes: &[Mesh]) -> u32 {
    if meshes.iter().any(is_clear) { 4 } else { 1 }
}

/// Whether a surface lets through what is behind it.
pub(super) fn is_clear(mesh: &Mesh) -> bool {
    mesh.atlas().base().texels().chunks_exact(4).any(|texel| texel[3] < OPAQUE)
}

/// Scale `e^s` of a log-scale, bounded away from 0 and infinity.
pub(super) fn scale(log_scale: f32) -> f32 {
    let [low, high] = SCALE_RANGE;
    f64::from(log_scale).exp().clamp(low, high) as f32
}

/// Inverse of [`scale`]; also, whether the scale had to be clamped. NaN stays NaN.
pub(super) fn log_scale(scale: f32) -> (f32, bool) {
    let [low, high] = SCALE_RANGE;
    let clamped = f64::from(scale).clamp(low, high);
    (clamped.ln() as f32, clamped != f64::from(scale))
}

/// Logits of opacities and logarithms of scales; with a note if any of those at `at` had to be clamped.
pub(super) fn parameters(
    opacities: impl IntoIterator<Item = f32>,
    scales: impl IntoIterator<Item = [f32; 3]>,
    at: &str,
    notes: &mut Vec<String>,
) -> (Vec<f32>, Vec<Vec3>) {
    let mut clamped = 0usize;
    let mut clamp = |(value, was_clamped): (f32, bool)| {
        clamped += usize::from(was_clamped);
        value
    };
    let logits = opacities.into_iter().map(|o| clamp(logit(o))).collect();
    let log_scales = scales.into_iter().map(|s| Vec3::from(s.map(|v| clamp(log_scale(v))))).collect();
    if clamped > 0 {
        notes.push(format!(
            "{at}: {clamped} opacities not between 0 and 1 or scales not above 0 are clamped, so that their logit or logarithm is finite"
        ));
    }
    (logits, log_scales)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn inverses_and_limits() {
        for x in [-80.0f32, -9.0, -1.0, 0.0, 0.3, 5.0] {
            assert!((log_scale(scale(x)).0 - x).abs() <= 1e-6 * x.abs().max(0.1), "{x}");
            let o = opacity(x);
            let again = opacity(logit(o).0);
            assert!((again - o).abs() <= 1e-6 * o, "{o} {again}");
        }
        for x in [f32::MAX, 100.0, -100.0, f32::MIN] {
            assert!(!logit(opacity(x)).1 && logit(opacity(x)).0.is_finite(), "own values need no clamping");
            assert!(!log_scale(scale(x)).1 && log_scale(scale(x)).0.is_finite());
        }
        for x in [0.0, 1.0, 2.0, -1.0] {
            let (l, clamped) = logit(x);
            assert!(l.is_finite() && clamped, "{x}");
        }
        assert!(log_scale(0.0).1 && logit(f32::NAN).0.is_nan());
    }

    #[test]
    fn what_is_clamped_is_counted() {
        let (half, e) = (0.5f32, std::f32::consts::E);
        let mut notes = vec![];
        let (logits, log_scales) = parameters([half, half], [[1.0, e, 1.0]], "/a", &mut notes);
        assert_eq!((logits, log_scales[0].round()), (vec![0.0; 2], Vec3::Y));
        assert!(notes.is_empty(), "{notes:?}");
        let (logits, log_scales) = parameters([0.0, half, 1.0], [[0.0, 1.0, -1.0], [1.0; 3]], "/a", &mut notes);
        assert!(logits.iter().all(|l| l.is_finite()) && log_scales.iter().all(|s| s.is_finite()));
        assert!(
            notes.len() == 1 && notes[0].starts_with("/a: 4 opacities not between 0 and 1 or scales "),
            "{notes:?}"
        );
    }

    #[test]
    fn in_maps_clear_weighs_as_much_as_opaque() {
        assert_eq!((map_logit(1.0), map_logit(0.0)), (logit(1.0).0, -logit(1.0).0));
        assert_eq!((map_logit(0.3), map_logit(-1.0)), (logit(0.3).0, map_logit(0.0)));
        assert!(map_logit(f32::NAN).is_nan());
    }
}
