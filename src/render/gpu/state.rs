//! State of splats during training, as flat arrays.

use glam::Vec3;

pub use super::geometry::{GEOMETRY_FLOATS, Geometry};
use super::{geometry, splats::pack_geometry};
use crate::scene::{SceneError, Splats, check_finite, sh, smoothed_parameters};

/// Raw, unconstrained parameters and Adam moments of `N` splats, in the layout of the GPU's buffers.
///
/// All arrays have whole rows for the same `N`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SplatState {
    /// Degree of the spherical harmonics, 0 to 3.
    pub sh_degree: u32,
    /// Rows of [`Geometry`], `[N·12]`: mean x, y, z; opacity logit; quaternion w, x, y, z, not normalised; log-scale
    /// x, y, z; deviation of what it is smoothed with.
    pub geometry: Vec<f32>,
    /// `[N·(d+1)²·3]`: RGB of coefficient 0, RGB of coefficient 1, …
    pub sh: Vec<f32>,
    /// First moments of `geometry`.
    pub geometry_m: Vec<f32>,
    /// Second moments of `geometry`.
    pub geometry_v: Vec<f32>,
    /// First moments of `sh`.
    pub sh_m: Vec<f32>,
    /// Second moments of `sh`.
    pub sh_v: Vec<f32>,
}

impl SplatState {
    /// The parameters of these splats with moments of zero.
    #[must_use]
    pub fn from_splats(splats: &Splats) -> Self {
        let geometry = pack_geometry(splats);
        let sh = splats.sh().as_flattened().to_vec();
        let (zeros, sh_zeros) = (vec![0.0; geometry.len()], vec![0.0; sh.len()]);
        Self {
            sh_degree: splats.sh_degree(),
            geometry,
            sh,
            geometry_m: zeros.clone(),
            geometry_v: zeros,
            sh_m: sh_zeros.clone(),
            sh_v: sh_zeros,
        }
    }

    /// The splats without their moments, smoothed; quaternions are normalised.
    ///
    /// # Errors
    /// If a parameter is not finite, a quaternion is zero, or the arrays do not fit together.
    pub fn to_splats(&self) -> Result<Splats, SceneError> {
        let rows = || Geometry::of_rows(&self.geometry);
        let (log_scales, opacity_logits) = rows().map(smoothed).unzip();
        Splats::new(
            rows().map(|g| g.mean).collect(),
            rows().map(|g| g.rotation).collect(),
            log_scales,
            opacity_logits,
            self.sh_degree,
            self.sh.chunks_exact(3).map(|c| [c[0], c[1], c[2]]).collect(),
        )
    }

    /// Parameters, first and second moments, each for geometry and SH.
    pub(crate) fn arrays(&self) -> [&[f32]; 6] {
        [&self.geometry, &self.sh, &self.geometry_m, &self.geometry_v, &self.sh_m, &self.sh_v]
    }

    /// Number of splats.
    #[must_use]
    pub fn len(&self) -> usize {
        self.geometry.len() / GEOMETRY_FLOATS
    }

    /// True if there are no splats.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.geometry.is_empty()
    }

    /// Floats of a splat in [`Self::sh`]: 3·(d+1)².
    #[must_use]
    pub fn sh_floats(&self) -> usize {
        3 * sh::coefficients(self.sh_degree)
    }

    /// Group and splat of the first value that is not finite.
    #[must_use]
    pub fn first_non_finite(&self) -> Option<(&'static str, usize)> {
        let arrays = [
            ("parameters", &self.geometry, &self.sh),
            ("first moments", &self.geometry_m, &self.sh_m),
            ("second moments", &self.geometry_v, &self.sh_v),
        ];
        for (kind, geometry, sh) in arrays {
            let named = |group| if kind == "parameters" { group } else { kind };
            if let Some((group, splat)) = geometry_not_finite(geometry) {
                return Some((named(group), splat));
            }
            if let Some(at) = sh.iter().position(|v| !v.is_finite()) {
                return Some((named("SH coefficients"), at / self.sh_floats()));
            }
        }
        None
    }
}

/// Parameter group and splat of the first geometry float that is not finite.
pub(crate) fn geometry_not_finite(geometry: &[f32]) -> Option<(&'static str, usize)> {
    let at = geometry.iter().position(|v| !v.is_finite())?;
    Some((geometry::group_of(at % GEOMETRY_FLOATS), at / GEOMETRY_FLOATS))
}

/// Means of the splats of these rows of geometry, `[N·12]`.
///
/// # Errors
/// If any of the geometry is not finite.
pub(crate) fn means(geometry: &[f32]) -> Result<Vec<Vec3>, SceneError> {
    check_finite("splats", geometry, GEOMETRY_FLOATS)?;
    Ok(Geometry::of_rows(geometry).map(|g| g.mean).collect())
}

/// Log-scales and opacity logit after smoothing.
fn smoothed(of: Geometry) -> (Vec3, f32) {
    smoothed_parameters(of.log_scale, of.opacity_logit, of.smoothing)
}

/// Sigmoid in f32, as the GPU computes it; elsewhere that of [`crate::scene`] is used.
pub(crate) fn sigmoid(x: f32) -> f32 {
    1.0 / (1.0 + (-x).exp())
}

/// Inverse of [`sigmoid`], that of [`crate::scene`] in f32.
pub(crate) fn logit(p: f32) -> f32 {
    crate::scene::logit(p.into()) as f32
}

#[cfg(test)]
pub(crate) mod tests {
    use glam::{DVec3, Quat};

    use super::*;
    use crate::render::reference::{self, Parameters};
    use crate::render::testing::largest;
    use crate::scene::{Composition, HybridScene, testing::ahead};

    /// `n` splats at (i, 0, 0) with opacity ½, scale 0.01, different SH coefficients, and non-zero moments.
    pub(crate) fn state(n: usize, sh_degree: u32) -> SplatState {
        let mut s = SplatState { sh_degree, ..SplatState::default() };
        for i in 0..n {
            let geometry = Geometry {
                mean: Vec3::new(i as f32, 0.0, 0.0),
                opacity_logit: 0.0,
                rotation: Quat::from_xyzw(0.0, 0.6, 0.0, 0.8),
                log_scale: Vec3::splat(0.01_f32.ln()),
                smoothing: 0.0,
            };
            s.geometry.extend(geometry.to_row());
            s.sh.extend((0..s.sh_floats()).map(|k| i as f32 + k as f32 / 100.0));
        }
        s.geometry_m = (1..=s.geometry.len()).map(|k| k as f32).collect();
        s.geometry_v.clone_from(&s.geometry_m);
        s.sh_m = (1..=s.sh.len()).map(|k| k as f32).collect();
        s.sh_v.clone_from(&s.sh_m);
        s
    }

    #[test]
    fn splats_survive_the_round_trip() {
        let state = state(5, 2);
        let splats = state.to_splats().unwrap();
        assert_eq!(splats.len(), 5);
        assert_eq!(means(&state.geometry).unwrap(), splats.means());
        let again = SplatState::from_splats(&splats);
        assert_eq!(again.to_splats().unwrap(), splats);
        assert_eq!(again.sh, state.sh);
        for (a, b) in again.geometry.iter().zip(&state.geometry) {
            // Quaternions are normalised in f64 and rounded.
            assert!((a - b).abs() < 1e-6);
        }
        assert!(again.geometry_m.iter().chain(&again.sh_v).all(|&v| v == 0.0));
    }

    #[test]
    fn smoothing_is_kept_in_scales_and_opacities() {
        let smooth = state(1, 1);
        let with = |opacity_logit: f32, log_scale: Vec3, smoothing: f32| {
            let mut with = smooth.clone();
            Geometry::edit(&mut with.geometry, 0, |g| *g = Geometry { opacity_logit, log_scale, smoothing, ..*g });
            with.to_splats()
        };
        let log_scale = Vec3::new(-4.0, -5.0, -6.0);
        let splats = with(0.0, log_scale, 0.02).unwrap();
        // It looks as it did while training.
        let raw = with(0.0, log_scale, 0.0).unwrap();
        let camera = ahead([32, 24], 300.0, -2.0 * DVec3::Z);
        let scene = |splats| HybridScene { splats, meshes: vec![], composition: Composition::default() };
        let raw = scene(raw);
        let parameters = Parameters { smoothing: vec![f64::from(0.02_f32)], ..Parameters::of(&raw) };
        let before = reference::render_parameters(&raw, &camera, &parameters);
        let after = reference::render(&scene(splats.clone()), &camera);
        let most = largest(before.transmittance.iter().zip(&after.transmittance).map(|(a, b)| (a - b).abs()));
        let shown = largest(before.transmittance.iter().map(|t| 1.0 - t));
        // Scales and logits are stored as f32.
        assert!(most < 1e-5 * shown && shown > 0.01, "{most:e} of {shown:e}");
        let variance = |log_scale: f32| (2.0 * f64::from(log_scale)).exp();
        for (now, before) in splats.log_scales()[0].to_array().into_iter().zip([-4.0, -5.0, -6.0]) {
            assert!((variance(now) / (variance(before) + 0.02 * 0.02) - 1.0).abs() < 1e-5);
        }
        let integral = |scales: Vec3, opacity: f32| f64::from(opacity) * f64::from(scales.element_sum()).exp();
        let (after, before) =
            (integral(splats.log_scales()[0], sigmoid(splats.opacity_logits()[0])), integral(log_scale, sigmoid(0.0)));
        assert!((after / before - 1.0).abs() < 1e-4, "{after:e} {before:e}");
        assert!(with(0.0, Vec3::splat(-200.0), 0.02).is_ok(), "nothing is left of it, and that is a number");
        let opaque = with(60.0, Vec3::ZERO, 1e-9).unwrap().opacity_logits()[0];
        assert!((opaque - 60.0).abs() < 1e-3, "smoothed by next to nothing");
        assert!(with(f32::NAN, Vec3::ZERO, 0.02).is_err(), "smoothing hides nothing");
    }

    #[test]
    fn a_nan_is_named() {
        let s = state(3, 1);
        assert_eq!(s.first_non_finite(), None);
        let broken = |change: fn(&mut SplatState)| {
            let mut s = s.clone();
            change(&mut s);
            s.first_non_finite()
        };
        assert_eq!(
            broken(|s| Geometry::edit(&mut s.geometry, 1, |g| g.opacity_logit = f32::NAN)),
            Some(("opacity logits", 1))
        );
        assert_eq!(
            broken(|s| Geometry::edit(&mut s.geometry, 2, |g| g.rotation.y = f32::INFINITY)),
            Some(("rotations", 2))
        );
        let mut geometry = s.geometry.clone();
        Geometry::edit(&mut geometry, 1, |g| g.log_scale.z = f32::NAN);
        assert_eq!(means(&geometry).unwrap_err().to_string(), "splats[1]: expected finite numbers, found NaN");
        assert_eq!(broken(|s| s.sh[30] = f32::NAN), Some(("SH coefficients", 2)));
        assert_eq!(broken(|s| s.sh_v[0] = f32::NAN), Some(("second moments", 0)));
    }
}
