//! Where a node or a bone puts what hangs on it: for whatever reads scenes, and for rigs.

use std::ops::Range;

use glam::{DMat3, DMat4, DQuat, DVec3};
use rayon::prelude::*;

use super::{Atlas, SceneError, SplatArrays, Texture, sh};

/// `scale · rotation` and a translation: what a splat can follow.
pub(crate) struct Similarity {
    pub(crate) scale: f64,
    pub(crate) rotation: DQuat,
    pub(crate) translation: DVec3,
}

/// Takes a transform apart; `None` if it shears, mirrors or scales unevenly by more than 1e-4, about the noise of f32
/// matrices multiplied along a node path.
pub(crate) fn similarity(transform: DMat4) -> Option<Similarity> {
    let linear = DMat3::from_mat4(transform);
    let scale = linear.determinant().cbrt();
    let unit = linear * scale.recip();
    let is_rotation = scale > 0.0 && (unit.transpose() * unit).abs_diff_eq(DMat3::IDENTITY, 1e-4);
    is_rotation.then(|| Similarity {
        // Exactly 1, so that the frame change of our own files leaves every bit alone.
        scale: if (scale - 1.0).abs() < 1e-12 { 1.0 } else { scale },
        rotation: if unit == DMat3::IDENTITY { DQuat::IDENTITY } else { DQuat::from_mat3(&unit).normalize() },
        translation: transform.w_axis.truncate(),
    })
}

/// Moves some splats to where a node puts them: means, scales, rotations and spherical harmonics. False, and nothing done, if
/// the transform is no similarity.
pub(crate) fn place(splats: &mut SplatArrays, these: Range<usize>, transform: DMat4) -> bool {
    if transform == DMat4::IDENTITY {
        return true;
    }
    let Some(Similarity { scale, rotation, .. }) = similarity(transform) else { return false };
    let moved = |mean: &mut glam::Vec3| *mean = transform.transform_point3(mean.as_dvec3()).as_vec3();
    splats.means[these.clone()].par_iter_mut().for_each(moved);
    splats.rotations[these.clone()].par_iter_mut().for_each(|q| *q = (rotation * q.as_dquat()).as_quat());
    splats.log_scales[these.clone()].par_iter_mut().for_each(|s| *s = (s.as_dvec3() + scale.ln()).as_vec3());
    turn(splats, these, DMat3::from_quat(rotation));
    true
}

/// Turns (or mirrors) the view dependence of some splats.
pub(crate) fn turn(splats: &mut SplatArrays, these: Range<usize>, orthogonal: DMat3) {
    if splats.sh_degree > 0 && orthogonal != DMat3::IDENTITY {
        let (k, harmonics) = (sh::coefficients(splats.sh_degree), sh::Rotation::new(orthogonal));
        let all = splats.sh[these.start * k..these.end * k].par_chunks_exact_mut(k);
        all.for_each(|coefficients| harmonics.apply(&mut coefficients[1..]));
    }
}

/// Maps whose view dependence is turned (or mirrored).
pub(crate) fn turned(atlas: &Atlas, orthogonal: DMat3) -> Result<Atlas, SceneError> {
    let Some(bands) = atlas.bands().filter(|_| orthogonal != DMat3::IDENTITY) else { return Ok(atlas.clone()) };
    let harmonics = sh::Rotation::new(orthogonal);
    let mut texels = bands.texels().to_vec();
    texels.par_chunks_exact_mut(bands.channels() as usize).for_each(|texel| harmonics.apply(texel.as_chunks_mut().0));
    let bands = Texture::new(bands.width(), bands.height(), bands.channels(), texels)?;
    Atlas::new(atlas.base().clone(), Some(bands))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_similarities_come_apart() {
        let rotation = DQuat::from_rotation_y(0.7);
        let good = DMat4::from_scale_rotation_translation(DVec3::splat(2.5), rotation, DVec3::X);
        let s = similarity(good).unwrap();
        assert!((s.scale - 2.5).abs() < 1e-12 && s.rotation.abs_diff_eq(rotation, 1e-12) && s.translation == DVec3::X);
        assert!(similarity(DMat4::from_scale(DVec3::new(1.0, 1.0, 1.1))).is_none());
        assert!(similarity(DMat4::from_scale(DVec3::new(1.0, 1.0, -1.0))).is_none());
        assert!(similarity(DMat4::ZERO).is_none());
        let flip = DMat4::from_diagonal(glam::DVec4::new(1.0, -1.0, -1.0, 1.0));
        let exact = similarity(flip * flip).unwrap();
        assert!(exact.scale == 1.0 && exact.rotation == DQuat::IDENTITY);
    }
}
