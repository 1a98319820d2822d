//! Single splat: the common basis of the splat codecs.

use glam::{Quat, Vec3};
use rayon::prelude::*;

use super::activation;
use crate::scene::{SplatArrays, Splats, sh};

/// Note on splats whose file requests drawing as in 2DGS.
pub(super) const SEEN_IN_3D: &str = "splats are seen as 3DGS has them";

/// What to do about splats that no scene holds, in files that can be read without them.
pub(super) const DROPPING: &str = "`centaur convert --drop-invalid` leaves such splats out";

/// One splat in the parameters of [`Splats`]. The rotation need not be normalised.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct SplatRecord {
    pub(super) mean: Vec3,
    pub(super) rotation: Quat,
    pub(super) log_scale: Vec3,
    pub(super) opacity_logit: f32,
    pub(super) sh_degree: u32,
    /// SH coefficients, of which only the first `(sh_degree + 1)²` are meaningful.
    pub(super) sh: [[f32; 3]; 16],
}

impl SplatRecord {
    pub(super) fn of(splats: &Splats, i: usize) -> Self {
        let mut all = [[0.0; 3]; 16];
        let own = splats.sh_of(i);
        all[..own.len()].copy_from_slice(own);
        Self {
            mean: splats.means()[i],
            rotation: splats.rotations()[i],
            log_scale: splats.log_scales()[i],
            opacity_logit: splats.opacity_logits()[i],
            sh_degree: splats.sh_degree(),
            sh: all,
        }
    }

    /// Whether [`Splats::new`] would accept the splat.
    fn is_valid(&self) -> bool {
        let length = self.rotation.as_dquat().length();
        self.mean.is_finite()
            && length > 0.0
            && length.is_finite()
            && self.log_scale.is_finite()
            && self.opacity_logit.is_finite()
            && self.sh().as_flattened().iter().all(|c| c.is_finite())
    }

    pub(super) fn sh(&self) -> &[[f32; 3]] {
        &self.sh[..sh::coefficients(self.sh_degree)]
    }
}

/// Arrays while being read.
impl SplatArrays {
    /// Appends a splat like [`Self::push`], unless [`Self::check`] would reject it; true if it was appended.
    pub(super) fn push_valid(&mut self, record: &SplatRecord) -> bool {
        let valid = record.is_valid();
        if valid {
            self.push(record);
        }
        valid
    }

    /// Appends a splat. Coefficients that `record` does not have are 0.
    pub(super) fn push(&mut self, record: &SplatRecord) {
        self.means.push(record.mean);
        self.rotations.push(record.rotation);
        self.log_scales.push(record.log_scale);
        self.opacity_logits.push(record.opacity_logit);
        let own = record.sh().iter().copied().chain(std::iter::repeat([0.0; 3]));
        self.sh.extend(own.take(sh::coefficients(self.sh_degree)));
    }

    /// Appends `count` splats, computed in parallel from their indices.
    pub(super) fn extend(&mut self, count: usize, record: impl Fn(usize) -> SplatRecord + Sync) {
        // Memory is extended in small portions, which are still in the cache when they are filled.
        const ROOM: usize = 1 << 14;
        for start in (0..count).step_by(ROOM) {
            self.extend_at_once(ROOM.min(count - start), |i| record(start + i));
        }
    }

    fn extend_at_once(&mut self, count: usize, record: impl Fn(usize) -> SplatRecord + Sync) {
        // Number of splats per task; large against a task's overhead.
        const PART: usize = 1 << 10;
        let (first, k) = (self.means.len(), sh::coefficients(self.sh_degree));
        self.means.resize(first + count, Vec3::ZERO);
        self.rotations.resize(first + count, Quat::IDENTITY);
        self.log_scales.resize(first + count, Vec3::ZERO);
        self.opacity_logits.resize(first + count, 0.0);
        self.sh.resize((first + count) * k, [0.0; 3]);
        let parts = (
            self.means[first..].par_chunks_mut(PART),
            self.rotations[first..].par_chunks_mut(PART),
            self.log_scales[first..].par_chunks_mut(PART),
            self.opacity_logits[first..].par_chunks_mut(PART),
            self.sh[first * k..].par_chunks_mut(PART * k),
        );
        parts.into_par_iter().enumerate().for_each(|(part, (means, rotations, log_scales, logits, sh))| {
            for (i, own) in sh.chunks_exact_mut(k).enumerate() {
                let splat = record(part * PART + i);
                (means[i], rotations[i], log_scales[i]) = (splat.mean, splat.rotation, splat.log_scale);
                logits[i] = splat.opacity_logit;
                own.iter_mut().zip(splat.sh()).for_each(|(to, from)| *to = *from);
            }
        });
    }
}

/// Rounds `levels · x` for x in 0..1 to the nearest of `0..=levels`; x outside is clamped.
pub(super) fn quantize(x: f32, levels: u32) -> u32 {
    (f64::from(x.clamp(0.0, 1.0)) * f64::from(levels)).round() as u32
}

/// Index of the component of a unit quaternion that is largest in magnitude, the first of several. Formats that store
/// the *smallest three* leave it out, as the others determine it up to its sign.
pub(super) fn largest_component(q: [f32; 4]) -> usize {
    (1..4).fold(0, |best, i| if q[i].abs() > q[best].abs() { i } else { best })
}

/// Opacity of a logit in 255 steps.
pub(super) fn opacity_byte(logit: f32) -> u8 {
    quantize(activation::opacity(logit), 255) as u8
}

/// Inverse of [`opacity_byte`]; 0 and 255 become the extreme finite logits of [`activation::logit`].
pub(super) fn logit_of_byte(byte: u8) -> f32 {
    activation::logit(f32::from(byte) / 255.0).0
}

/// Logarithm of a stored scale; NaN, which no scene may hold, for a negative one.
pub(super) fn log_of_scale(scale: f32) -> f32 {
    if scale < 0.0 { f32::NAN } else { activation::log_scale(scale).0 }
}

/// Display colour of SH coefficient 0 alone in 255 steps; values outside 0..1 are clipped.
pub(super) fn color_bytes(dc: [f32; 3]) -> [u8; 3] {
    sh::rgb_from_dc(dc).map(|c| quantize(c, 255) as u8)
}

/// Inverse of [`color_bytes`].
pub(super) fn dc_of_bytes(rgb: [u8; 3]) -> [f32; 3] {
    sh::dc_from_rgb(rgb.map(|c| f32::from(c) / 255.0))
}
