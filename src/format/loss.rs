//! Loss report: content of a scene that is missing from the file written from it.

use std::fmt;

use glam::{DQuat, Quat, Vec3};
use serde::Serialize;

use super::activation;
use super::error::one_line;
use super::splat_record::SplatRecord;
use crate::scene::{Splats, sh};

/// Result of writing a file.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct WriteReport {
    /// Total length in bytes of the file and its accompanying files.
    pub bytes: u64,
    /// Content that was not written.
    pub loss: Loss,
    /// Names of accompanying files, without which the file is incomplete.
    pub beside: Vec<String>,
    /// Differences between the image shown by the target program and that shown by Centaur, and what a document lost
    /// with cameras left out of it, one sentence each.
    pub notes: Vec<String>,
}

/// Content that a reader of the written file cannot recover. Measured on what was written, not derived from the format.
///
/// `Display` gives one line: the lost parts, separated by `; `, or `nothing`; rounding counts as nothing, see
/// [`Loss::is_rounding`].
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Loss {
    /// Number of meshes left out.
    pub meshes: usize,
    /// Number of cameras left out.
    pub cameras: usize,
    /// Whether the composition (order, λ, background, colour space, pixel filter) is left out.
    pub composition: bool,
    /// Names of the per-splat attributes that are left out.
    pub attributes: Vec<String>,
    /// Whether the record of how the scene was made is left out, see [`super::SceneFile::record`].
    pub record: bool,
    /// Further content of the source document that is lost: animations, extensions, extras.
    pub document: Vec<String>,
    /// SH degrees of the scene and of the file, if bands are left out.
    pub sh_degree: Option<[u32; 2]>,
    /// Largest differences between the splats and the stored ones.
    pub max_error: SplatError,
}

/// Largest absolute error per attribute, over all splats.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct SplatError {
    /// Error of the mean along x, y or z, in scene units.
    pub mean: f32,
    /// Angle between the orientations, in degrees. Half turns about the splat's axes count as zero; for round splats
    /// the angle has no effect.
    pub rotation: f32,
    /// Error of the natural logarithm of a standard deviation: 0.01 is 1 % in size. Standard deviations below 10⁻⁸
    /// count as 10⁻⁸.
    pub log_scale: f32,
    /// Error of the opacity, 0 to 1.
    pub opacity: f32,
    /// Error of the colour of SH coefficient 0 alone, `0.5 + C0·dc`, not clamped: 1 is the full display range.
    pub color: f32,
    /// Error of an SH coefficient, over the bands that both have.
    pub sh: f32,
}

impl Loss {
    /// Whether a reader recovers everything, splat parameters bit for bit.
    #[must_use]
    pub fn is_none(&self) -> bool {
        *self == Self::default()
    }

    /// Whether the only loss of the scene is f32 rounding: of storing a scale or opacity instead of its logarithm or
    /// logit, or of normalising a quaternion again. The record of how the scene was made is disregarded.
    #[must_use]
    pub fn is_rounding(&self) -> bool {
        Self { max_error: self.max_error.beyond_rounding(), record: false, ..self.clone() }.is_none()
    }

    /// Loss of splats that are written as `after`, splat by splat in the same order.
    ///
    /// # Panics
    /// If the numbers of splats differ.
    #[must_use]
    pub fn of_splats(before: &Splats, after: &Splats) -> Self {
        assert_eq!(before.len(), after.len(), "the same splats before and after");
        let mut loss = Self::of_sh_degree(before.sh_degree(), after.sh_degree());
        for i in 0..before.len() {
            loss.max_error.include(&SplatRecord::of(before, i), &SplatRecord::of(after, i));
        }
        loss
    }

    pub(super) fn of_sh_degree(before: u32, after: u32) -> Self {
        Self { sh_degree: (after < before).then_some([before, after]), ..Self::default() }
    }
}

impl fmt::Display for Loss {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut parts = vec![];
        if self.meshes > 0 {
            parts.push(format!("{} mesh(es)", self.meshes));
        }
        if self.cameras > 0 {
            parts.push(format!("{} camera(s)", self.cameras));
        }
        if self.composition {
            parts.push("the blending rule".to_owned());
        }
        if !self.attributes.is_empty() {
            parts.push(format!("the attributes {}", self.attributes.join(", ")));
        }
        if self.record {
            parts.push("the record of the training".to_owned());
        }
        parts.extend(self.document.iter().cloned());
        if let Some([before, after]) = self.sh_degree {
            parts.push(format!("SH bands above degree {after} of {before}"));
        }
        let e = self.max_error.beyond_rounding();
        let errors = [
            (e.mean, "position", " units"),
            (e.rotation, "rotation", "°"),
            (e.log_scale, "scale", " in ln σ"),
            (e.opacity, "opacity", " of 1"),
            (e.color, "colour", " of 1"),
            (e.sh, "SH coefficient", ""),
        ];
        let errors = errors.iter().filter(|(error, ..)| *error > 0.0);
        let errors: Vec<String> = errors.map(|(error, name, unit)| format!("{name} {error:.2e}{unit}")).collect();
        if !errors.is_empty() {
            parts.push(format!("largest errors: {}", errors.join(", ")));
        }
        if parts.is_empty() {
            return write!(f, "nothing");
        }
        write!(f, "{}", one_line(&parts.join("; ")))
    }
}

impl SplatError {
    /// Error beyond rounding: without the error due to storing a scale or opacity instead of its logarithm or logit, or
    /// to normalising a quaternion again.
    fn beyond_rounding(self) -> Self {
        // Half a unit in the last place of a logarithm of 87 is 4e-6, of an opacity 3e-8; for a quaternion it is 1e-5°.
        let beyond = |error: f32, rounding: f32| if error <= rounding { 0.0 } else { error };
        Self {
            rotation: beyond(self.rotation, 1e-4),
            log_scale: beyond(self.log_scale, 1e-5),
            opacity: beyond(self.opacity, 1e-6),
            ..self
        }
    }

    /// Larger of both errors, per attribute.
    #[must_use]
    pub fn max(self, other: Self) -> Self {
        Self {
            mean: self.mean.max(other.mean),
            rotation: self.rotation.max(other.rotation),
            log_scale: self.log_scale.max(other.log_scale),
            opacity: self.opacity.max(other.opacity),
            color: self.color.max(other.color),
            sh: self.sh.max(other.sh),
        }
    }

    /// Includes the error of one splat. SH coefficients are compared where both have them.
    pub(super) fn include(&mut self, before: &SplatRecord, after: &SplatRecord) {
        let widest = |a: [f32; 3], b: [f32; 3]| (0..3).map(|c| (a[c] - b[c]).abs()).fold(0.0, f32::max);
        let floored = |log_scale: Vec3| log_scale.max(Vec3::splat(LEAST_LOG_SCALE));
        *self = self.max(Self {
            mean: (before.mean - after.mean).abs().max_element(),
            rotation: degrees_between(before.rotation, after.rotation),
            log_scale: (floored(before.log_scale) - floored(after.log_scale)).abs().max_element(),
            opacity: (activation::opacity(before.opacity_logit) - activation::opacity(after.opacity_logit)).abs(),
            color: sh::C0 as f32 * widest(before.sh[0], after.sh[0]),
            sh: before.sh()[1..].iter().zip(&after.sh()[1..]).map(|(a, b)| widest(*a, *b)).fold(0.0, f32::max),
        });
    }
}

/// ln 10⁻⁸. Every renderer shows thinner splats as discs (projections are widened by 0.3 px), and some programs write 0
/// for them.
const LEAST_LOG_SCALE: f32 = -18.420_68;

/// Angle of the rotation between two orientations of a splat, modulo half turns about its axes. Computed from the
/// chord, which is accurate where the cosine has lost all digits.
fn degrees_between(a: Quat, b: Quat) -> f32 {
    let (a, b) = (a.as_dquat().normalize(), b.as_dquat().normalize());
    let half_turns = [DQuat::IDENTITY, I, J, K].into_iter();
    let chord = half_turns.map(|turn| a * turn).map(|a| (a - b).length().min((a + b).length())).fold(2.0, f64::min);
    (4.0 * (chord / 2.0).asin()).to_degrees() as f32
}

const I: DQuat = DQuat::from_xyzw(1.0, 0.0, 0.0, 0.0);
const J: DQuat = DQuat::from_xyzw(0.0, 1.0, 0.0, 0.0);
const K: DQuat = DQuat::from_xyzw(0.0, 0.0, 1.0, 0.0);

#[cfg(test)]
mod tests {
    use super::*;
    use crate::format::test_scenes::random_splats;

    struct Arrays {
        means: Vec<Vec3>,
        rotations: Vec<Quat>,
        log_scales: Vec<Vec3>,
        logits: Vec<f32>,
        sh: Vec<[f32; 3]>,
    }

    #[test]
    fn each_attribute_is_measured_in_its_unit() {
        let splats = random_splats(5, 2, 1);
        assert!(Loss::of_splats(&splats, &splats).is_none());
        let changed = |change: fn(usize, &mut Arrays)| {
            let mut arrays = Arrays {
                means: splats.means().to_vec(),
                rotations: splats.rotations().to_vec(),
                log_scales: splats.log_scales().to_vec(),
                logits: splats.opacity_logits().to_vec(),
                sh: splats.sh().to_vec(),
            };
            (0..5).for_each(|i| change(i, &mut arrays));
            let Arrays { means, rotations, log_scales, logits, sh } = arrays;
            let after = Splats::new(means, rotations, log_scales, logits, 2, sh).unwrap();
            Loss::of_splats(&splats, &after).max_error
        };
        let near = |a: f32, b: f32| (a - b).abs() <= 1e-5 * b;
        let e = changed(|i, s| s.means[i].y += 0.01 * i as f32);
        assert!((e.mean - 0.04).abs() < 1e-6 && SplatError { mean: 0.0, ..e } == SplatError::default());
        let e = changed(|i, s| s.rotations[i] *= Quat::from_rotation_y(0.1 * i as f32));
        assert!(near(e.rotation, 0.4f32.to_degrees()), "{}", e.rotation);
        let e = changed(|i, s| s.rotations[i] = -s.rotations[i]);
        assert!(e.rotation < 1e-4, "the same orientation: {}", e.rotation);
        let e = changed(|i, s| s.rotations[i] *= Quat::from_rotation_z(std::f32::consts::PI));
        assert!(e.rotation < 1e-4, "the same splat: {}", e.rotation);
        let e = changed(|i, s| s.log_scales[i].z -= 0.5);
        assert!(near(e.log_scale, 0.5));
        let e = changed(|i, s| s.logits[i] = 40.0);
        assert!(e.opacity <= 1.0 && e.opacity > 0.5);
        let e = changed(|i, s| s.sh[9 * i][2] += 1.0);
        assert!(near(e.color, sh::C0 as f32) && e.sh == 0.0);
        let e = changed(|i, s| s.sh[9 * i + 8][0] += 0.25);
        assert!(near(e.sh, 0.25) && e.color == 0.0);
    }

    #[test]
    fn the_line_names_what_is_lost() {
        assert_eq!(Loss::default().to_string(), "nothing");
        let loss = Loss {
            meshes: 2,
            cameras: 1,
            composition: true,
            attributes: vec!["label".to_owned(), "time".to_owned()],
            record: true,
            document: vec!["2 animations".to_owned()],
            sh_degree: Some([3, 0]),
            max_error: SplatError { mean: 0.00012, rotation: 0.5, ..SplatError::default() },
        };
        assert_eq!(
            loss.to_string(),
            "2 mesh(es); 1 camera(s); the blending rule; the attributes label, time; the record of the training; 2 animations; SH bands above degree 0 of 3; \
             largest errors: position 1.20e-4 units, rotation 5.00e-1°"
        );
        assert!(!loss.is_none());
    }
}
