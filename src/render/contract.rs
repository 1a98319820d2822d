//! The composition rule as plain functions: the contribution of a splat and of a mesh fragment at a pixel, and their
//! order. Splats follow 3DGS; textured layers and the stable order follow HERA. What these leave open is decided here,
//! and stated for other implementers in `schema/EXT_gaussian_splatting_hybrid/README.md`.
//!
//! [`super::reference`] is written with these functions; the shaders implement the same rule and are tested against
//! it. All lengths are world units, all positions continuous pixels, all depths camera-space z.
//!
//! **Order.** Every ordering mode comes down to one number per splat and mesh layer, its *threshold*: at pixel p,
//! splat g is behind layer i iff the layer's depth there is below `thresholds(..)[i]`. The splat then belongs to the
//! [`bucket`] behind the last such layer, and the order at p is: splats of bucket 0, layer 1, splats of bucket 1,
//! layer 2, … — splats of one bucket by (depth, index).
//!
//! **Stop.** A splat that would take the transmittance in front of what follows below [`TRANSMITTANCE_STOP`] is not
//! added and ends its bucket. Mesh fragments are always added: there are few, and dropping an opaque one would show
//! the background through it.
//!
//! **Rays.** [`ImageModel::Ray`] shares the limits of alpha, the culling of means before the near plane and the choice
//! of fragments (the composition's nearest layers). It has no pixel filter, no thresholds and no stop. A splat does not
//! contribute along a ray on which its peak is not beyond the near plane; a peak at the depth of a fragment is in front
//! of it.

use glam::{DMat2, DVec2, DVec3};

use crate::scene::{Intrinsics, OrderMode, PixelFilter, sigmoid};

/// Largest alpha of a splat at a pixel, so that division by 1 − α is safe. INRIA 3DGS, `cuda_rasterizer/forward.cu`.
/// Where the cap applies the derivative of alpha is zero.
pub const ALPHA_CAP: f64 = 0.99;

/// Least alpha at which a splat contributes at a pixel: one step of an 8-bit image (INRIA 3DGS,
/// `cuda_rasterizer/forward.cu`). It is the only limit of a splat's extent (no 3σ cut), except that kernels of
/// projected splats, which compute in single precision, leave out splats that reach 10⁶ pixels from their centre or
/// have it 10⁷ pixels away.
pub const ALPHA_CUT: f64 = 1.0 / 255.0;

/// Transmittance below which no more splats are added. INRIA 3DGS, `cuda_rasterizer/forward.cu`.
pub const TRANSMITTANCE_STOP: f64 = 1e-4;

/// Largest alpha of a mesh fragment, for the same reason as [`ALPHA_CAP`].
pub const MESH_ALPHA_CAP: f64 = 1.0 - 1e-4;

/// Relative depth within which a splat counts as in front of a surface: splats that start exactly on a face stay
/// visible.
pub const TIE_EPSILON: f64 = 1e-5;

/// Margin around the image, in half images, within which the projection is linearised at the splat's own mean. gsplat;
/// the same as INRIA 3DGS where the principal point is centred.
pub const JACOBIAN_MARGIN: f64 = 0.3;

/// Largest number of mesh layers per pixel.
pub const MAX_LAYERS: usize = 4;

/// Image model: how a Gaussian contributes to pixels.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ImageModel {
    /// EWA splatting: the projection is linearised at the mean and widened by the scene's [`PixelFilter`]; splats are
    /// ordered by the depths of their means, and against mesh layers by the scene's mode. Used in training.
    #[default]
    Ewa,
    /// Largest value along the pixel's own ray, see [`ray_peak`]; splats are ordered by the depths of these peaks, and
    /// against mesh fragments by the fragments' depths. As in ray tracers (3DGRT, Mitsuba's `volprim_rf_basic`).
    Ray(ShDirection),
}

/// Direction at which a splat's colour is evaluated.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ShDirection {
    /// From the camera's centre to the mean: one colour per splat and picture, as in training.
    #[default]
    Mean,
    /// Direction of the pixel's ray.
    Ray,
}

/// The largest value of a Gaussian along a ray.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RayPeak {
    /// Depth of the peak, in lengths of the ray's direction; camera-space z if that has z = 1.
    pub depth: f64,
    /// Logarithm of the value, ≤ 0: minus half the squared distance to the mean in standard deviations.
    pub power: f64,
}

/// Peak of a Gaussian along the ray from `origin` in `direction`, both in the splat's own frame and in units of its
/// standard deviations: S⁻¹Rᵀ(c − μ) and S⁻¹Rᵀr.
#[must_use]
pub fn ray_peak(origin: DVec3, direction: DVec3) -> RayPeak {
    let depth = -origin.dot(direction) / direction.length_squared();
    // Distance from the cross product: computing o + t·d would cancel where a splat is thin.
    RayPeak { depth, power: -0.5 * origin.cross(direction).length_squared() / direction.length_squared() }
}

/// Factor on the opacity of a splat whose projection has this covariance, px², before `filter` widens it
/// (Mip-Splatting's 2-D filter).
#[must_use]
pub fn filter_opacity(filter: PixelFilter, covariance: DMat2) -> f64 {
    let widened = covariance + f64::from(filter.variance) * DMat2::IDENTITY;
    if filter.normalized { (covariance.determinant().max(0.0) / widened.determinant()).sqrt() } else { 1.0 }
}

/// Range (min, max) of (x/z, y/z) to which a mean is clamped before the projection is linearised there.
#[must_use]
pub fn jacobian_limits(k: &Intrinsics) -> (DVec2, DVec2) {
    let size = k.size();
    let (focal, principal) = (DVec2::new(k.fx, k.fy), DVec2::new(k.cx, k.cy));
    let margin = JACOBIAN_MARGIN * 0.5 * size;
    ((-principal - margin) / focal, (size - principal + margin) / focal)
}

/// Alpha of a splat of this opacity at a pixel where its Gaussian is e^`power`; `None` if it does not contribute. A
/// power above 0 is due to rounding and counts as 0; INRIA 3DGS skips such pixels (`cuda_rasterizer/forward.cu`), which
/// leaves holes along needles.
#[must_use]
pub fn splat_alpha(opacity: f64, power: f64) -> Option<f64> {
    let alpha = (opacity * power.min(0.0).exp()).min(ALPHA_CAP);
    // `f64::min` ignores NaN.
    (alpha >= ALPHA_CUT && !power.is_nan()).then_some(alpha)
}

/// Half width and height in pixels of the ellipse on which alpha is [`ALPHA_CUT`], from the variances along x and y
/// of the projected splat (pixel filter included); `None` if its opacity is below the cut everywhere.
#[must_use]
pub fn splat_extent(opacity: f64, variance: DVec2) -> Option<DVec2> {
    let squared = 2.0 * (opacity / ALPHA_CUT).ln();
    (squared >= 0.0).then(|| DVec2::new((squared * variance.x).sqrt(), (squared * variance.y).sqrt()))
}

/// Alpha of a mesh fragment from its opacity logit.
#[must_use]
pub fn mesh_alpha(logit: f64) -> f64 {
    sigmoid(logit).min(MESH_ALPHA_CAP)
}

/// Depth of one mesh layer at the projection of a splat's mean.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum SurfaceDepth {
    /// The mean does not project into the image.
    Outside,
    /// The layer is empty there.
    Empty,
    /// The interpolated depth.
    Depth(f64),
}

/// The 2×2 pixels around continuous position `uv`, clamped to the image, with their bilinear weights.
pub(super) fn bilinear_taps(uv: DVec2, size: [u32; 2]) -> [([u32; 2], f64); 4] {
    let corner = (uv - 0.5).floor();
    let f = uv - 0.5 - corner;
    let clamp = |x: f64, n: u32| (x.max(0.0) as u32).min(n - 1);
    let tap = |dx: f64, dy: f64, weight: f64| ([clamp(corner.x + dx, size[0]), clamp(corner.y + dy, size[1])], weight);
    [
        tap(0.0, 0.0, (1.0 - f.x) * (1.0 - f.y)),
        tap(1.0, 0.0, f.x * (1.0 - f.y)),
        tap(0.0, 1.0, (1.0 - f.x) * f.y),
        tap(1.0, 1.0, f.x * f.y),
    ]
}

/// Depth of a layer at `uv`, interpolated in its depth image (`depth_at([x, y])` at pixel centres, 0 = empty; `size` =
/// width and height).
///
/// Interpolates 1/z, which is exact on a plane, over the taps that have depth. If these differ by more than `lambda`
/// there is an edge, and the tap of largest weight alone decides, as an average across the edge lies on no surface.
/// Among equal weights the first tap in row order wins.
#[must_use]
pub fn surface_depth(depth_at: impl Fn([u32; 2]) -> f64, size: [u32; 2], uv: DVec2, lambda: f64) -> SurfaceDepth {
    let inside = (0.0..f64::from(size[0])).contains(&uv.x) && (0.0..f64::from(size[1])).contains(&uv.y);
    if !inside {
        return SurfaceDepth::Outside;
    }
    let taps = bilinear_taps(uv, size).map(|(pixel, weight)| (weight, depth_at(pixel)));
    let valid = || taps.iter().filter(|(w, d)| *w > 0.0 && *d > 0.0);
    let (nearest, farthest) = valid().fold((f64::INFINITY, 0.0_f64), |(near, far), (_, d)| (near.min(*d), far.max(*d)));
    if farthest == 0.0 {
        return SurfaceDepth::Empty;
    }
    if farthest - nearest > lambda {
        let (_, depth) = taps.into_iter().fold((0.0, 0.0), |best, tap| if tap.0 > best.0 { tap } else { best });
        return if depth > 0.0 { SurfaceDepth::Depth(depth) } else { SurfaceDepth::Empty };
    }
    let (weight, inverse) = valid().fold((0.0, 0.0), |(sw, si), (w, d)| (sw + w, si + w / d));
    SurfaceDepth::Depth(weight / inverse)
}

/// Thresholds of a splat with depth `z`, one per layer: the splat is behind layer i at a pixel iff the layer's depth
/// there is below the i-th.
///
/// `samples` holds the layers' [`surface_depth`]s, nearest layer first, at most [`MAX_LAYERS`]; [`OrderMode::Direct`]
/// ignores them. `lambda` is ≥ 0 and may be infinite.
#[must_use]
pub fn thresholds(mode: OrderMode, z: f64, samples: &[SurfaceDepth], lambda: f64) -> [f64; MAX_LAYERS] {
    let mut result = [z; MAX_LAYERS];
    match mode {
        OrderMode::Direct => {}
        OrderMode::Stable => {
            for (threshold, sample) in result.iter_mut().zip(samples) {
                *threshold = match *sample {
                    SurfaceDepth::Outside => f64::INFINITY,
                    SurfaceDepth::Empty => z,
                    SurfaceDepth::Depth(surface) if is_beyond(z, surface) => f64::INFINITY,
                    SurfaceDepth::Depth(_) => z - lambda,
                };
            }
        }
        OrderMode::SurfaceConsistent => result = [surface_consistent_threshold(z, samples, lambda); MAX_LAYERS],
    }
    result
}

/// Number of mesh layers in front of a splat at a pixel whose layers have these depths, nearest first. The largest
/// layer decides, so the order is consistent whatever the single decisions were.
#[must_use]
pub fn bucket(layer_depths: &[f64], thresholds: &[f64; MAX_LAYERS]) -> usize {
    let behind = |(depth, threshold): (&f64, &f64)| depth < threshold;
    layer_depths.iter().zip(thresholds).rposition(behind).map_or(0, |i| i + 1)
}

/// Whether a mean is behind a surface: a tie counts as in front.
fn is_beyond(z: f64, surface: f64) -> bool {
    z > surface * (1.0 + TIE_EPSILON)
}

/// The rule "follow the decision made at the surface nearest to the pixel's depth d if it is within λ of d, else
/// compare z with d", as one threshold on d, the same for every layer.
///
/// Only two surfaces matter: the last one that the mean is beyond and the first one that it is not. Around the former
/// the rule says "behind" up to `upper`, around the latter "in front" from `lower` on, and half-way between the two
/// depths the nearest surface changes.
fn surface_consistent_threshold(z: f64, samples: &[SurfaceDepth], lambda: f64) -> f64 {
    let surfaces = samples.iter().filter_map(|s| if let SurfaceDepth::Depth(d) = s { Some(*d) } else { None });
    // Interpolation across edges can leave the samples unsorted.
    let (mut before, mut after) = (None, None);
    for surface in surfaces {
        if is_beyond(z, surface) {
            before = Some(before.map_or(surface, |s: f64| s.max(surface)));
        } else {
            after = Some(after.map_or(surface, |s: f64| s.min(surface)));
        }
    }
    let upper = |surface: f64| z.max(surface + lambda);
    let lower = |surface: f64| z.min(surface - lambda);
    match (before, after) {
        (None, None) => z,
        (Some(before), None) => upper(before),
        (None, Some(after)) => lower(after),
        (Some(before), Some(after)) => {
            let middle = 0.5 * (before + after);
            if lower(after) > middle { lower(after) } else { upper(before).min(middle) }
        }
    }
}

#[cfg(test)]
mod tests;
