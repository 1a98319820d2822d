//! Placement of splats and maps by the transforms of nodes and bones, for readers of scenes and for rigs.

use std::ops::Range;

use glam::{DMat3, DMat4, DQuat, DVec3, Quat, Vec3};
use rayon::prelude::*;

use super::{Atlas, SceneError, SplatArrays, Texture, sh};

/// A similarity without mirroring, decomposed into `scale · rotation` and a translation.
pub(crate) struct Decomposed {
    pub(crate) scale: f64,
    pub(crate) rotation: DQuat,
    pub(crate) translation: DVec3,
}

/// Decomposes a transform; `None` if it shears, mirrors or scales unevenly by more than 1e-4, about the noise of f32
/// matrices multiplied along a node path.
pub(crate) fn similarity(transform: DMat4) -> Option<Decomposed> {
    let linear = DMat3::from_mat4(transform);
    let scale = linear.determinant().cbrt();
    let unit = linear * scale.recip();
    let is_rotation = scale > 0.0 && (unit.transpose() * unit).abs_diff_eq(DMat3::IDENTITY, 1e-4);
    is_rotation.then(|| Decomposed {
        // Exactly 1, so that the frame change of files written by Centaur leaves every bit alone.
        scale: if (scale - 1.0).abs() < 1e-12 { 1.0 } else { scale },
        rotation: if unit == DMat3::IDENTITY { DQuat::IDENTITY } else { DQuat::from_mat3(&unit).normalize() },
        translation: transform.w_axis.truncate(),
    })
}

/// Length of the shortest half axis that a sphere has after a transform, relative to the longest, up to which the
/// transform is flat: products of rotations and scales of 0 leave about 1e-16. `blender/motion.py` has the same limit.
const FLAT: f64 = 1e-12;

/// Orthogonal matrix nearest to the linear part of a transform, by which view dependence is rotated or mirrored; `None`
/// if the transform is flat.
pub(crate) fn orthogonal(transform: DMat4) -> Option<DMat3> {
    if let Some(Decomposed { rotation, .. }) = similarity(transform) {
        return Some(DMat3::from_quat(rotation));
    }
    let linear = DMat3::from_mat4(transform);
    if flattens(linear) {
        return None;
    }
    let mut unit = linear * linear.determinant().abs().cbrt().recip();
    // Newton's iteration for the polar decomposition, which halves lengths far from 1 and doubles the correct digits of
    // those near it.
    for _ in 0..64 {
        unit = 0.5 * (unit + unit.inverse().transpose());
    }
    (unit.transpose() * unit).abs_diff_eq(DMat3::IDENTITY, 1e-9).then_some(unit)
}

/// Whether the linear part of a transform has no inverse but for rounding: below it splats have no extent along an
/// axis, and neither splats nor surfaces with view dependence are drawn.
pub(crate) fn is_flat(transform: DMat4) -> bool {
    orthogonal(transform).is_none()
}

/// Whether an ellipsoid has no extent along an axis, relative to the longest, after a linear map.
fn flattens(linear: DMat3) -> bool {
    // Neither zero nor beyond the range of f64.
    if !linear.determinant().is_normal() {
        return true;
    }
    let largest = linear.to_cols_array().iter().fold(0.0, |largest: f64, v| largest.max(v.abs()));
    let lengths = lengths(half_axes(linear * largest.recip()));
    lengths.min_element() <= FLAT * lengths.max_element()
}

/// Applies a node's transform to some splats: means, shapes and spherical harmonics. With its linear part M a
/// covariance Σ becomes M·Σ·Mᵀ, and harmonics are rotated by [`orthogonal`]. Returns false, and does nothing, if the
/// transform is flat.
pub(crate) fn place(splats: &mut SplatArrays, these: Range<usize>, transform: DMat4) -> bool {
    if transform == DMat4::IDENTITY {
        return true;
    }
    let Some(orthogonal) = orthogonal(transform) else { return false };
    reshape(splats, these.clone(), transform);
    turn(splats, these, orthogonal);
    true
}

/// Transforms means and shapes of some splats as [`place`] does, by an invertible transform, and leaves their harmonics
/// unchanged.
pub(crate) fn reshape(splats: &mut SplatArrays, these: Range<usize>, transform: DMat4) {
    let moved = |mean: &mut Vec3| *mean = transform.transform_point3(mean.as_dvec3()).as_vec3();
    splats.means[these.clone()].par_iter_mut().for_each(moved);
    let (rotations, log_scales) = (&mut splats.rotations[these.clone()], &mut splats.log_scales[these]);
    if let Some(Decomposed { scale, rotation, .. }) = similarity(transform) {
        rotations.par_iter_mut().for_each(|q| *q = (rotation * q.as_dquat()).as_quat());
        log_scales.par_iter_mut().for_each(|s| *s = (s.as_dvec3() + scale.ln()).as_vec3());
    } else {
        let linear = DMat3::from_mat4(transform);
        rotations.par_iter_mut().zip(log_scales).for_each(|(q, s)| (*q, *s) = stretched(linear, *q, *s));
    }
}

/// Rotation and log-scales of an ellipsoid after an invertible linear map.
fn stretched(linear: DMat3, rotation: Quat, log_scale: Vec3) -> (Quat, Vec3) {
    // Least axis relative to the longest, so that numbers and their squares stay in range.
    const LEAST_PART: f64 = 1e-60;
    let (size, longest) = (linear.determinant().abs().cbrt(), f64::from(log_scale.max_element()));
    let parts = (log_scale.as_dvec3() - longest).exp().max(DVec3::splat(LEAST_PART));
    let axes = DMat3::from_quat(rotation.as_dquat().normalize()) * DMat3::from_diagonal(parts);
    let axes = half_axes(linear * size.recip() * axes);
    let lengths = lengths(axes);
    // The axes of an ellipsoid may all be negated.
    let unit = axes * DMat3::from_diagonal(axes.determinant().signum() / lengths);
    let log_scale = (lengths * size).to_array().map(|length| length.ln() + longest);
    (DQuat::from_mat3(&unit).normalize().as_quat(), DVec3::from(log_scale).as_vec3())
}

/// Half axes of an ellipsoid from conjugate ones (columns): left singular vectors times singular values, by one-sided
/// Jacobi rotations, which are accurate for short axes beside long ones, too.
fn half_axes(conjugate: DMat3) -> DMat3 {
    // The remainder is squared with every sweep.
    const MAX_SWEEPS: usize = 12;
    let mut columns = [conjugate.x_axis, conjugate.y_axis, conjugate.z_axis];
    for _ in 0..MAX_SWEEPS {
        for [i, j] in [[0, 1], [0, 2], [1, 2]] {
            let (a, b) = (columns[i], columns[j]);
            let dot = a.dot(b);
            if dot.abs() <= f64::EPSILON * a.length() * b.length() {
                continue;
            }
            let cotangent = (b.length_squared() - a.length_squared()) / (2.0 * dot);
            let tangent = cotangent.signum() / (cotangent.abs() + cotangent.hypot(1.0));
            let cosine = tangent.hypot(1.0).recip();
            (columns[i], columns[j]) = (cosine * (a - tangent * b), cosine * (b + tangent * a));
        }
    }
    DMat3::from_cols(columns[0], columns[1], columns[2])
}

/// Lengths of columns.
fn lengths(columns: DMat3) -> DVec3 {
    DVec3::new(columns.x_axis.length(), columns.y_axis.length(), columns.z_axis.length())
}

/// Rotates (or mirrors) the view dependence of some splats.
pub(crate) fn turn(splats: &mut SplatArrays, these: Range<usize>, orthogonal: DMat3) {
    if splats.sh_degree > 0 && orthogonal != DMat3::IDENTITY {
        let (k, harmonics) = (sh::coefficients(splats.sh_degree), sh::Rotation::new(orthogonal));
        let all = splats.sh[these.start * k..these.end * k].par_chunks_exact_mut(k);
        all.for_each(|coefficients| harmonics.apply(&mut coefficients[1..]));
    }
}

/// Maps with their view dependence rotated (or mirrored).
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

    fn some_splats(n: usize) -> SplatArrays {
        let x = |i: usize| 2.0 * (i as f32 * 0.618_034).fract() - 1.0;
        SplatArrays {
            means: (0..n).map(|i| Vec3::new(x(i), x(i + 3), x(i + 7))).collect(),
            rotations: (0..n).map(|i| Quat::from_xyzw(x(i), x(2 * i), x(3 * i), 1.1).normalize()).collect(),
            log_scales: (0..n).map(|i| Vec3::new(4.0 * x(5 * i), x(7 * i), 3.0 * x(9 * i)) - 3.0).collect(),
            opacity_logits: vec![0.0; n],
            sh_degree: 3,
            sh: (0..16 * n).map(|i| [x(i), x(11 * i), x(13 * i)]).collect(),
        }
    }

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

    #[test]
    fn orthogonal_parts_are_those_of_nodes() {
        let turn = DMat3::from_quat(DQuat::from_euler(glam::EulerRot::YXZ, 2.0, 0.4, -0.8));
        for scale in [DVec3::splat(3.0), DVec3::new(1.0, 1e3, 1e-6), DVec3::new(2.0, -1.0, 0.5), -DVec3::ONE] {
            let transform = DMat4::from_mat3(turn * DMat3::from_diagonal(scale));
            let expected = turn * DMat3::from_diagonal(scale.signum());
            assert!(orthogonal(transform).unwrap().abs_diff_eq(expected, 1e-9), "{scale}");
        }
        for flat in [DMat4::ZERO, DMat4::from_scale(DVec3::new(1.0, 0.0, 1.0))] {
            assert!(is_flat(flat) && !place(&mut some_splats(3), 0..3, flat));
        }
    }

    /// Rounding leaves products that are flat an inverse of some 1e16; sizes do not matter.
    #[test]
    fn what_is_flat_is_so_however_it_is_turned() {
        let turn = |a: f64| DMat3::from_quat(DQuat::from_euler(glam::EulerRot::YXZ, a, 2.0 * a + 0.3, 1.0 - 3.0 * a));
        for i in 0..200 {
            let (above, below) = (turn(0.1 * f64::from(i)), turn(0.37 * f64::from(i) + 1.0));
            for size in [1e-30, 1.0, 1e30] {
                let is_flat = |scale: [f64; 3]| {
                    let scale = size * DVec3::from(scale);
                    is_flat(DMat4::from_mat3(above * DMat3::from_diagonal(scale) * below))
                };
                assert!(is_flat([1.0, 0.0, 1.0]) && is_flat([0.0, 0.0, -2.0]) && is_flat([0.0; 3]), "{i} {size}");
                assert!(!is_flat([1.0; 3]) && !is_flat([1.0, 1e-6, -1.0]) && !is_flat([1e-6, 1e-6, 1.0]), "{i} {size}");
            }
        }
    }

    #[test]
    fn covariances_follow_any_transform() {
        let turn = |a: f64| DQuat::from_euler(glam::EulerRot::YXZ, a, 2.0 * a, 1.0 - a);
        let stretch = |s: DVec3, a: f64| DMat4::from_scale_rotation_translation(s, turn(a), DVec3::new(1.0, a, -2.0));
        let uneven = stretch(DVec3::new(1.0, 0.2, 3.0), 0.3);
        let mirror = stretch(DVec3::new(-1.0, 1.0, 1.0), 0.7);
        let sheared = stretch(DVec3::new(1e-3, 1e-3, 4.0), 1.2) * uneven;
        let before = some_splats(40);
        let covariance = |s: &SplatArrays, i: usize| {
            let r = DMat3::from_quat(s.rotations[i].as_dquat().normalize());
            r * DMat3::from_diagonal((2.0 * s.log_scales[i].as_dvec3()).exp()) * r.transpose()
        };
        for transform in [uneven, mirror, sheared] {
            let mut after = before.clone();
            assert!(place(&mut after, 1..40, transform));
            let (linear, seen) = (DMat3::from_mat4(transform), orthogonal(transform).unwrap());
            for i in 1..40 {
                let expected = linear * covariance(&before, i) * linear.transpose();
                let size = expected.to_cols_array().iter().fold(0.0, |m: f64, v| m.max(v.abs()));
                let found = covariance(&after, i);
                assert!((found * size.recip()).abs_diff_eq(expected * size.recip(), 1e-5), "{found} {expected}");
                let color = |s: &SplatArrays, d: DVec3| -> f64 {
                    let k = &s.sh[i * 16..(i + 1) * 16];
                    sh::basis(d.to_array()).iter().zip(k).map(|(y, c)| y * f64::from(c[1])).sum()
                };
                let d = DVec3::new(0.36, -0.48, 0.8);
                assert!((color(&after, seen * d) - color(&before, d)).abs() < 1e-5);
            }
            assert_eq!((after.means[0], after.rotations[0]), (before.means[0], before.rotations[0]));
        }
        // An axis of length zero remains the shortest, and finite.
        let (rotation, log_scale) = stretched(DMat3::from_mat4(sheared), Quat::IDENTITY, Vec3::new(0.0, -1e30, -3.0));
        assert!(rotation.is_finite() && log_scale.is_finite() && log_scale.y < log_scale.z, "{log_scale}");
    }
}
