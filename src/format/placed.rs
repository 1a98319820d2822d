//! What lies below nodes with transforms, brought into one world: the same for glTF and USD.

use glam::{DMat3, DMat4, DQuat, DVec3};
use rayon::prelude::*;

use super::error::Fault;
use crate::scene::{Atlas, SceneError, SplatArrays, Splats, Texture, sh};

/// `scale · rotation` and a translation: what a splat can follow.
pub(super) struct Similarity {
    pub(super) scale: f64,
    pub(super) rotation: DQuat,
    pub(super) translation: DVec3,
}

/// Takes a transform apart; `None` if it shears, mirrors or scales unevenly by more than 1e-4, about the noise of f32
/// matrices multiplied along a node path.
pub(super) fn similarity(transform: DMat4) -> Option<Similarity> {
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

/// Moves splats to where a node puts them: means, scales, rotations and spherical harmonics.
///
/// # Errors
/// At `at`, if the transform is no similarity.
pub(super) fn place(splats: &mut SplatArrays, transform: DMat4, at: &str) -> Result<(), Fault> {
    if transform == DMat4::IDENTITY {
        return Ok(());
    }
    let Some(Similarity { scale, rotation, .. }) = similarity(transform) else {
        let expected = "a rotation, a translation and an even, positive scale above splats";
        return Err(Fault::pointer(at, expected, "another transform"));
    };
    splats.means.par_iter_mut().for_each(|mean| *mean = transform.transform_point3(mean.as_dvec3()).as_vec3());
    splats.rotations.par_iter_mut().for_each(|q| *q = (rotation * q.as_dquat()).as_quat());
    splats.log_scales.par_iter_mut().for_each(|s| *s = (s.as_dvec3() + scale.ln()).as_vec3());
    if splats.sh_degree > 0 {
        let harmonics = sh::Rotation::new(DMat3::from_quat(rotation));
        let all = splats.sh.par_chunks_exact_mut(sh::coefficients(splats.sh_degree));
        all.for_each(|coefficients| harmonics.apply(&mut coefficients[1..]));
    }
    Ok(())
}

/// Maps whose view dependence is turned.
pub(super) fn turned(atlas: &Atlas, rotation: DQuat) -> Result<Atlas, SceneError> {
    let Some(bands) = atlas.bands() else { return Ok(atlas.clone()) };
    let harmonics = sh::Rotation::new(DMat3::from_quat(rotation));
    let mut texels = bands.texels().to_vec();
    texels.par_chunks_exact_mut(bands.channels() as usize).for_each(|texel| harmonics.apply(texel.as_chunks_mut().0));
    let bands = Texture::new(bands.width(), bands.height(), bands.channels(), texels)?;
    Atlas::new(atlas.base().clone(), Some(bands))
}

/// All parts as one, at the highest degree among them, with where each is from: a JSON pointer, or the path of a prim.
pub(super) fn join(parts: Vec<(String, SplatArrays)>) -> Result<Splats, Fault> {
    let places: Vec<(usize, String)> = parts.iter().map(|(at, part)| (part.means.len(), at.clone())).collect();
    let degree = parts.iter().map(|(_, part)| part.sh_degree).max().unwrap_or(0);
    let k = sh::coefficients(degree);
    let mut parts = parts.into_iter().map(|(_, mut part)| {
        if part.sh_degree < degree {
            let own = part.sh.chunks_exact(sh::coefficients(part.sh_degree));
            part.sh = own.flat_map(|c| c.iter().copied().chain(std::iter::repeat([0.0; 3])).take(k)).collect();
        }
        SplatArrays { sh_degree: degree, ..part }
    });
    let Some(mut all) = parts.next() else { return Ok(Splats::empty(0)) };
    for mut part in parts {
        all.means.append(&mut part.means);
        all.rotations.append(&mut part.rotations);
        all.log_scales.append(&mut part.log_scales);
        all.opacity_logits.append(&mut part.opacity_logits);
        all.sh.append(&mut part.sh);
    }
    all.check().map_err(|e| Fault::from(e).of_part(places.iter().map(|(count, at)| (*count, at.as_str()))))
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
