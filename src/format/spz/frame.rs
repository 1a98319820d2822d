//! Conversion between the axes of SPZ files and those of captures.

use glam::{DMat3, DVec3, Quat, Vec3};

use crate::format::splat_record::SplatRecord;
use crate::scene::{
    frame::{OPENGL_FROM_OPENCV, sh_signs},
    sh,
};

/// Transform from a file's axes to a scene's: a quarter turn about x if the file has z up, then sign changes.
#[derive(Clone, Debug, PartialEq)]
pub(in crate::format) struct Frame {
    /// SH rotation of the quarter turn (x, y, z) → (x, z, −y), if there is one.
    quarter_turn: Option<sh::Rotation>,
    signs: Vec3,
    /// Sign of each SH coefficient under `signs`.
    sh_signs: [f32; 16],
}

impl Default for Frame {
    /// Default frame: x right, y up, z backwards.
    fn default() -> Self {
        Self::new(false, OPENGL_FROM_OPENCV.as_vec3())
    }
}

impl Frame {
    fn new(quarter_turn: bool, signs: Vec3) -> Self {
        let turn = DMat3::from_cols(DVec3::X, -DVec3::Z, DVec3::Y);
        let quarter_turn = quarter_turn.then(|| sh::Rotation::new(turn));
        Self { quarter_turn, signs, sh_signs: sh_signs(signs.as_dvec3()) }
    }

    /// Frame of a code of `SPZ_ADOBE_coordinate_system`: 1 to 8 enumerate left/right, down/up, back/front of x, y, z,
    /// the first fastest; 9 to 16 are the same with y and z exchanged (forward or back, then down or up). 0 is
    /// unspecified, which means the default frame.
    pub(super) fn from_code(code: u32) -> Option<Self> {
        if code == 0 {
            return Some(Self::default());
        }
        let index = code.checked_sub(1).filter(|&i| i < 16)?;
        let sign = |bit: u32, positive: bool| if (index >> bit & 1 == 1) == positive { 1.0 } else { -1.0 };
        // A scene's axes are right, down, front.
        Some(Self::new(index >= 8, Vec3::new(sign(0, true), sign(1, false), sign(2, true))))
    }

    /// Converts a splat from the file's axes to the scene's.
    pub(super) fn to_scene(&self, splat: &SplatRecord) -> SplatRecord {
        let Some(turn) = &self.quarter_turn else { return self.signed(splat) };
        let mut turned = SplatRecord {
            mean: Vec3::new(splat.mean.x, splat.mean.z, -splat.mean.y),
            rotation: Quat::from_rotation_x(-std::f32::consts::FRAC_PI_2) * splat.rotation,
            ..*splat
        };
        turn.apply(&mut turned.sh[1..]);
        self.signed(&turned)
    }

    /// Inverse of [`Self::to_scene`] for frames without a quarter turn, the only ones that are written.
    pub(super) fn to_file(&self, splat: &SplatRecord) -> SplatRecord {
        self.signed(splat)
    }

    /// Applies sign changes S: a covariance R Λ Rᵀ becomes (S R S) Λ (S R S)ᵀ, and S R S is a rotation even if S is a
    /// reflection.
    fn signed(&self, splat: &SplatRecord) -> SplatRecord {
        let (s, q) = (self.signs, splat.rotation);
        let mut sh = splat.sh;
        sh.iter_mut().zip(self.sh_signs).for_each(|(c, sign)| *c = c.map(|v| sign * v));
        SplatRecord {
            mean: splat.mean * s,
            rotation: Quat::from_xyzw(q.x * s.y * s.z, q.y * s.x * s.z, q.z * s.x * s.y, q.w),
            sh,
            ..*splat
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::format::test_scenes::random_splats;

    /// Directions of the file's axes in a scene (x right, y down, z front), by the three letters of a frame's name.
    fn axes(name: &str) -> DMat3 {
        let axis = |letter| match letter {
            'R' => DVec3::X,
            'L' => -DVec3::X,
            'D' => DVec3::Y,
            'U' => -DVec3::Y,
            'F' => DVec3::Z,
            _ => -DVec3::Z,
        };
        let letters: Vec<DVec3> = name.chars().map(axis).collect();
        DMat3::from_cols(letters[0], letters[1], letters[2])
    }

    #[test]
    fn every_frame_is_what_its_letters_say() {
        let names = [
            "LDB", "RDB", "LUB", "RUB", "LDF", "RDF", "LUF", "RUF", "LFD", "RFD", "LFU", "RFU", "LBD", "RBD", "LBU",
            "RBU",
        ];
        let splats = random_splats(1, 3, 5);
        let splat = SplatRecord::of(&splats, 0);
        for (name, code) in names.iter().zip(1..) {
            let m = axes(name);
            let turned = Frame::from_code(code).unwrap().to_scene(&splat);
            let mean = m * splat.mean.as_dvec3();
            assert!((turned.mean.as_dvec3() - mean).length() < 1e-6, "{name}: {mean} {}", turned.mean);
            let covariance = |q: Quat| {
                let r = DMat3::from_quat(q.as_dquat().normalize());
                r * DMat3::from_diagonal((2.0 * splat.log_scale.as_dvec3()).exp()) * r.transpose()
            };
            let difference = covariance(turned.rotation) - m * covariance(splat.rotation) * m.transpose();
            let size = (2.0 * splat.log_scale.max_element()).exp();
            assert!(
                difference.to_cols_array().iter().all(|d| d.abs() < 1e-5 * f64::from(size)),
                "{name}: {difference}"
            );
            for d in [DVec3::X, DVec3::new(0.36, -0.48, 0.8)] {
                let seen = |s: &SplatRecord, d: DVec3| -> f64 {
                    sh::basis(d.to_array()).iter().zip(s.sh).map(|(y, c)| y * f64::from(c[1])).sum()
                };
                let (before, after) = (seen(&splat, d), seen(&turned, m * d));
                assert!((before - after).abs() < 1e-5, "{name}: {before} {after}");
            }
        }
        assert_eq!(Frame::from_code(4), Some(Frame::default()));
        assert_eq!(Frame::from_code(0), Some(Frame::default()));
        assert_eq!(Frame::from_code(17), None);
        let frame = Frame::default();
        assert_eq!(frame.to_scene(&frame.to_file(&splat)), splat);
    }
}
