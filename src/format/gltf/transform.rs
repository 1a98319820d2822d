//! Where nodes put things, in the capture's frame.

use std::collections::HashSet;

use glam::{DMat3, DMat4, DQuat, DVec3};
use gltf::scene::Transform;

use super::extension::{EXTRAS, ROOT_NODE};
use crate::format::error::Fault;
use crate::scene::sh;

/// Rotation of the root node of our own files: half a turn about x takes COLMAP's y-down world to glTF's y-up. It is
/// its own inverse, and exact in floating point.
const FLIP: DMat4 = DMat4::from_cols_array(&[1., 0., 0., 0., 0., -1., 0., 0., 0., 0., -1., 0., 0., 0., 0., 1.]);

/// Every node that the default scene (else the first) reaches, in document order, with its global transform. Below the
/// root node of a file of ours the transform is in the frame of the capture, elsewhere in glTF's.
pub(in crate::format) fn placements(document: &gltf::Document) -> Result<Vec<(gltf::Node<'_>, DMat4)>, Fault> {
    let Some(scene) = document.default_scene().or_else(|| document.scenes().next()) else { return Ok(vec![]) };
    let nodes: Vec<gltf::Node<'_>> = document.nodes().collect();
    let mut stack: Vec<(usize, DMat4)> = vec![];
    for node in scene.nodes() {
        stack.push((node.index(), if is_our_root(&node) { FLIP } else { DMat4::IDENTITY }));
    }
    stack.reverse();
    let mut seen = HashSet::new();
    let mut placed = vec![];
    while let Some((index, parent)) = stack.pop() {
        if !seen.insert(index) {
            return Err(Fault::pointer(format!("/nodes/{index}"), "a node with one parent", "two paths to it"));
        }
        let node = nodes[index].clone();
        let global = parent * local(&node);
        if !global.is_finite() {
            return Err(Fault::pointer(format!("/nodes/{index}"), "a finite transform", "numbers that are not"));
        }
        let children: Vec<usize> = node.children().map(|c| c.index()).collect();
        stack.extend(children.into_iter().rev().map(|c| (c, global)));
        placed.push((node, global));
    }
    Ok(placed)
}

fn is_our_root(node: &gltf::Node<'_>) -> bool {
    let marked = node.extras().as_ref().is_some_and(|extras| {
        serde_json::from_str::<serde_json::Value>(extras.get()).is_ok_and(|v| v.get(EXTRAS).is_some())
    });
    node.name() == Some(ROOT_NODE) && marked
}

fn local(node: &gltf::Node<'_>) -> DMat4 {
    match node.transform() {
        Transform::Matrix { matrix } => DMat4::from_cols_array_2d(&matrix.map(|column| column.map(f64::from))),
        Transform::Decomposed { translation, rotation, scale } => DMat4::from_scale_rotation_translation(
            DVec3::from(scale.map(f64::from)),
            DQuat::from_array(rotation.map(f64::from)).normalize(),
            DVec3::from(translation.map(f64::from)),
        ),
    }
}

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

/// Matrix `D` that rotates spherical harmonics up to degree 3: `c' = D c` has, in direction `R d`, the colour that `c`
/// has in direction `d`.
///
/// `D_ij = ∫ Y_i(d) Y_j(Rᵀd)` over the sphere; products of degree 6 are integrated exactly by 4 Gauss–Legendre nodes in
/// z times 8 azimuths.
pub(super) fn sh_rotation(rotation: DQuat) -> [[f64; 16]; 16] {
    const NODES: [(f64, f64); 4] = [
        (-0.861_136_311_594_052_6, 0.347_854_845_137_453_86),
        (-0.339_981_043_584_856_3, 0.652_145_154_862_546_1),
        (0.339_981_043_584_856_3, 0.652_145_154_862_546_1),
        (0.861_136_311_594_052_6, 0.347_854_845_137_453_86),
    ];
    let inverse = rotation.inverse();
    let mut matrix = [[0.0; 16]; 16];
    for (z, weight) in NODES {
        for step in 0..8 {
            let (sin, cos) = (f64::from(step) * std::f64::consts::FRAC_PI_4).sin_cos();
            let r = (1.0 - z * z).sqrt();
            let d = DVec3::new(r * cos, r * sin, z);
            let (to, from) = (sh::basis(d.to_array()), sh::basis((inverse * d).to_array()));
            for (row, y) in matrix.iter_mut().zip(to) {
                row.iter_mut().zip(from).for_each(|(m, x)| *m += weight * std::f64::consts::FRAC_PI_4 * y * x);
            }
        }
    }
    matrix
}

/// Applies [`sh_rotation`] to the `(d+1)²` RGB coefficients of one function.
pub(super) fn rotate_sh(matrix: &[[f64; 16]; 16], coefficients: &mut [[f32; 3]]) {
    let old: Vec<[f64; 3]> = coefficients.iter().map(|c| c.map(f64::from)).collect();
    for (new, row) in coefficients.iter_mut().zip(matrix) {
        *new = [0, 1, 2].map(|channel| row.iter().zip(&old).map(|(m, c)| m * c[channel]).sum::<f64>() as f32);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rotated_harmonics_turn_with_the_object() {
        let rotation = DQuat::from_euler(glam::EulerRot::XYZ, 0.3, -1.1, 2.0);
        let matrix = sh_rotation(rotation);
        let coefficients: Vec<[f32; 3]> = (0..16).map(|i| [i as f32 - 7.0, (i * i) as f32, 1.0]).collect();
        let mut rotated = coefficients.clone();
        rotate_sh(&matrix, &mut rotated);
        let colour = |c: &[[f32; 3]], d: DVec3| -> f64 {
            sh::basis(d.to_array()).iter().zip(c).map(|(y, c)| y * f64::from(c[1])).sum()
        };
        for d in [DVec3::X, DVec3::Y, DVec3::new(0.36, -0.48, 0.8)] {
            let (before, after) = (colour(&coefficients, d), colour(&rotated, rotation * d));
            // Coefficients reach 225 and are stored in f32: 225 · 6e-8 · 16 terms.
            assert!((before - after).abs() < 2e-4, "{before} {after}");
        }
        // Degree 1 alone is closed under rotation: a truncated stack gives the same first four.
        let mut low = coefficients[..4].to_vec();
        rotate_sh(&matrix, &mut low);
        assert!(low.iter().zip(&rotated).all(|(a, b)| (a[1] - b[1]).abs() < 1e-4));
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
        let exact = similarity(FLIP * FLIP).unwrap();
        assert!(exact.scale == 1.0 && exact.rotation == DQuat::IDENTITY);
    }
}
