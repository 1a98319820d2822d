use glam::{Quat, Vec3};
use rayon::prelude::*;

use super::{SceneError, check_finite, check_len, sh};

/// Deviation of a quaternion's length from 1 caused by rounding its four components to f32: 2 · 2⁻²⁵ if they are equal.
const UNIT_TOLERANCE: f64 = 6e-8;

/// `N` anisotropic 3D Gaussians in the parameters that are optimised (Kerbl et al. 2023).
///
/// Every array has the same length and only finite values; rotations are not zero.
#[derive(Clone, Debug, PartialEq)]
pub struct Splats {
    means: Vec<Vec3>,
    rotations: Vec<Quat>,
    log_scales: Vec<Vec3>,
    opacity_logits: Vec<f32>,
    sh_degree: u32,
    sh: Vec<[f32; 3]>,
}

impl Splats {
    /// Validates and takes the arrays.
    ///
    /// * `means` `[N]`: world position.
    /// * `rotations` `[N]`: local to world; normalised here. (`glam` stores x, y, z, w.)
    /// * `log_scales` `[N]`: natural logarithm of the standard deviation along each local axis, world units.
    /// * `opacity_logits` `[N]`: opacity = 1/(1+e^-l).
    /// * `sh` `[N·(sh_degree+1)²]`: RGB coefficients, splat-major, order of [`sh::basis`], *without* the +0.5.
    ///
    /// # Errors
    /// If lengths differ, a value is not finite, a rotation is zero or `sh_degree` exceeds 3.
    pub fn new(
        means: Vec<Vec3>,
        mut rotations: Vec<Quat>,
        log_scales: Vec<Vec3>,
        opacity_logits: Vec<f32>,
        sh_degree: u32,
        sh: Vec<[f32; 3]>,
    ) -> Result<Self, SceneError> {
        if sh_degree > sh::MAX_DEGREE {
            return Err(SceneError::new("sh_degree", "0 to 3", sh_degree.to_string()));
        }
        let n = means.len();
        check_len("rotations", rotations.len(), n)?;
        check_len("log_scales", log_scales.len(), n)?;
        check_len("opacity_logits", opacity_logits.len(), n)?;
        check_len("sh", sh.len(), n * sh::coefficients(sh_degree))?;
        check_finite("means", bytemuck::cast_slice(&means), 3)?;
        check_finite("log_scales", bytemuck::cast_slice(&log_scales), 3)?;
        check_finite("opacity_logits", &opacity_logits, 1)?;
        check_finite("sh", bytemuck::cast_slice(&sh), 3 * sh::coefficients(sh_degree))?;
        let not_a_rotation = rotations.par_iter_mut().enumerate().find_map_first(|(i, q)| {
            // In f64, so that any finite non-zero f32 quaternion is accepted.
            let length = q.as_dquat().length();
            if !(length > 0.0 && length.is_finite()) {
                return Some((i, *q));
            }
            // A quaternion of unit length within f32 precision keeps its bits, however often it passes here.
            if (length - 1.0).abs() > UNIT_TOLERANCE {
                *q = (q.as_dquat() / length).as_quat();
            }
            None
        });
        if let Some((i, q)) = not_a_rotation {
            return Err(SceneError::new(format!("rotations[{i}]"), "a non-zero quaternion", q.to_string()));
        }
        Ok(Self { means, rotations, log_scales, opacity_logits, sh_degree, sh })
    }

    /// Returns the arrays, to be changed and passed to [`Self::new`] again.
    #[must_use]
    pub fn into_arrays(self) -> SplatArrays {
        let Self { means, rotations, log_scales, opacity_logits, sh_degree, sh } = self;
        SplatArrays { means, rotations, log_scales, opacity_logits, sh_degree, sh }
    }

    /// No splats at all.
    #[must_use]
    pub fn empty(sh_degree: u32) -> Self {
        Self {
            means: vec![],
            rotations: vec![],
            log_scales: vec![],
            opacity_logits: vec![],
            sh_degree: sh_degree.min(sh::MAX_DEGREE),
            sh: vec![],
        }
    }

    /// Number of floats of one splat: mean, rotation, log-scales, opacity and colour.
    #[must_use]
    pub fn floats_each(sh_degree: u32) -> usize {
        11 + 3 * sh::coefficients(sh_degree)
    }

    /// Number of splats.
    #[must_use]
    pub fn len(&self) -> usize {
        self.means.len()
    }

    /// True if there are no splats.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.means.is_empty()
    }

    /// World positions, `[N]`.
    #[must_use]
    pub fn means(&self) -> &[Vec3] {
        &self.means
    }

    /// Unit quaternions local→world, `[N]`.
    #[must_use]
    pub fn rotations(&self) -> &[Quat] {
        &self.rotations
    }

    /// Log standard deviations, `[N]`.
    #[must_use]
    pub fn log_scales(&self) -> &[Vec3] {
        &self.log_scales
    }

    /// Opacity logits, `[N]`.
    #[must_use]
    pub fn opacity_logits(&self) -> &[f32] {
        &self.opacity_logits
    }

    /// Degree of the spherical harmonics, 0 to 3.
    #[must_use]
    pub fn sh_degree(&self) -> u32 {
        self.sh_degree
    }

    /// All SH coefficients, `[N·(d+1)²]` RGB, splat-major.
    #[must_use]
    pub fn sh(&self) -> &[[f32; 3]] {
        &self.sh
    }

    /// The `(d+1)²` RGB coefficients of splat `i`.
    ///
    /// # Panics
    /// If `i` is out of range.
    #[must_use]
    pub fn sh_of(&self, i: usize) -> &[[f32; 3]] {
        let k = sh::coefficients(self.sh_degree);
        &self.sh[i * k..(i + 1) * k]
    }
}

/// The arrays of [`Splats`] without their guarantees; shapes and units are those of [`Splats::new`].
#[derive(Clone, Debug, Default, PartialEq)]
#[expect(missing_docs, reason = "the fields are the arguments of `Splats::new`")]
pub struct SplatArrays {
    pub means: Vec<Vec3>,
    pub rotations: Vec<Quat>,
    pub log_scales: Vec<Vec3>,
    pub opacity_logits: Vec<f32>,
    pub sh_degree: u32,
    pub sh: Vec<[f32; 3]>,
}

impl SplatArrays {
    /// Empty, with room for `count` splats.
    pub(crate) fn with_capacity(count: usize, sh_degree: u32) -> Self {
        Self {
            means: Vec::with_capacity(count),
            rotations: Vec::with_capacity(count),
            log_scales: Vec::with_capacity(count),
            opacity_logits: Vec::with_capacity(count),
            sh_degree,
            sh: Vec::with_capacity(count * sh::coefficients(sh_degree)),
        }
    }

    /// The splats with another SH degree, at most [`sh::MAX_DEGREE`]: higher bands are dropped, or added as zeros.
    #[must_use]
    pub fn with_sh_degree(mut self, degree: u32) -> Self {
        let degree = degree.min(sh::MAX_DEGREE);
        let [before, after] = [self.sh_degree, degree].map(sh::coefficients);
        let rows = self.sh.len() / before;
        if after < before {
            (0..rows).for_each(|i| self.sh.copy_within(i * before..i * before + after, i * after));
            self.sh.truncate(rows * after);
            self.sh.shrink_to_fit();
        } else if after > before {
            let mut wider = vec![[0.0; 3]; rows * after];
            let each = wider.chunks_exact_mut(after).zip(self.sh.chunks_exact(before));
            each.for_each(|(to, from)| to[..before].copy_from_slice(from));
            self.sh = wider;
        }
        Self { sh_degree: degree, ..self }
    }

    /// Appends the splats of `other`, which must have the same SH degree.
    pub fn append(&mut self, mut other: Self) {
        self.means.append(&mut other.means);
        self.rotations.append(&mut other.rotations);
        self.log_scales.append(&mut other.log_scales);
        self.opacity_logits.append(&mut other.opacity_logits);
        self.sh.append(&mut other.sh);
    }

    /// Validates the arrays.
    ///
    /// # Errors
    /// As [`Splats::new`].
    pub fn check(self) -> Result<Splats, SceneError> {
        let Self { means, rotations, log_scales, opacity_logits, sh_degree, sh } = self;
        Splats::new(means, rotations, log_scales, opacity_logits, sh_degree, sh)
    }
}
