use glam::DMat3;

/// Matrix of one band: rows and columns from m = −l to l, the rest unused.
type Block = [[f64; 7]; 7];

/// Rotation or reflection of SH coefficients with the object that they colour: `c' = D c` gives in direction `O d` the
/// colour that `c` gives in direction `d`.
///
/// D is the Wigner D-matrix of real harmonics, a block per band, computed by the recursion of Ivanic and Ruedenberg (J.
/// Phys. Chem. 1996, 100, 6342, with the correction of 1998). A block is a polynomial of degree l in the entries of
/// `O`, so that reflections need no special case.
#[derive(Clone, Debug, PartialEq)]
pub struct Rotation {
    bands: [Block; 3],
}

impl Rotation {
    /// Rotation for an orthogonal matrix of determinant 1 or −1.
    #[must_use]
    pub fn new(orthogonal: DMat3) -> Self {
        // Band 1 is y, z, x: the matrix itself with its axes in this order.
        const AXES: [usize; 3] = [1, 2, 0];
        let mut first = Block::default();
        for (row, i) in AXES.into_iter().enumerate() {
            for (column, j) in AXES.into_iter().enumerate() {
                first[row][column] = orthogonal.col(j)[i];
            }
        }
        let second = next(&first, &first, 2);
        let third = next(&first, &second, 3);
        Self { bands: [first, second, third].map(in_our_signs) }
    }

    /// Rotates the coefficients of bands 1 to d of one function, in place: 3, 8 or 15 RGB triples. Band 0 is invariant.
    pub fn apply(&self, mut coefficients: &mut [[f32; 3]]) {
        for (block, size) in self.bands.iter().zip([3, 5, 7]) {
            let Some((band, rest)) = coefficients.split_at_mut_checked(size) else { return };
            let mut old = [[0.0; 3]; 7];
            old.iter_mut().zip(&*band).for_each(|(old, new)| *old = new.map(f64::from));
            for (new, row) in band.iter_mut().zip(block) {
                let sum = |channel: usize| (0..size).map(|k| row[k] * old[k][channel]).sum::<f64>();
                *new = [0, 1, 2].map(|channel| sum(channel) as f32);
            }
            coefficients = rest;
        }
    }
}

/// Band `l` from band 1 and band `l − 1`, in the sign convention of the literature.
fn next(first: &Block, lower: &Block, l: i32) -> Block {
    let mut block = Block::default();
    for m in -l..=l {
        for n in -l..=l {
            block[(m + l) as usize][(n + l) as usize] = element(first, lower, l, m, n);
        }
    }
    block
}

fn element(first: &Block, lower: &Block, l: i32, m: i32, n: i32) -> f64 {
    let r = |i: i32, j: i32| first[(i + 1) as usize][(j + 1) as usize];
    // Terms outside the lower band are multiplied by 0 below.
    let low = |a: i32, b: i32| if a.abs() < l { lower[(a + l - 1) as usize][(b + l - 1) as usize] } else { 0.0 };
    let p = |i: i32, a: i32| {
        if n == l {
            r(i, 1) * low(a, l - 1) - r(i, -1) * low(a, 1 - l)
        } else if n == -l {
            r(i, 1) * low(a, 1 - l) + r(i, -1) * low(a, l - 1)
        } else {
            r(i, 0) * low(a, n)
        }
    };
    let denominator = f64::from(if n.abs() < l { (l + n) * (l - n) } else { 2 * l * (2 * l - 1) });
    let root = |x: i32| (f64::from(x) / denominator).sqrt();
    let k = m.abs();
    let u = root((l + m) * (l - m)) * p(0, m);
    let v = 0.5 * root((l + k - 1) * (l + k));
    let w = 0.5 * root((l - k - 1).max(0) * (l - k));
    let sqrt2 = std::f64::consts::SQRT_2;
    match m {
        0 => u - sqrt2 * v * (p(1, 1) + p(-1, -1)),
        1 => u + sqrt2 * v * p(1, 0) - w * (p(1, 2) + p(-1, -2)),
        -1 => u + sqrt2 * v * p(-1, 0) - w * (p(1, -2) - p(-1, 2)),
        m if m > 0 => u + v * (p(1, m - 1) - p(-1, 1 - m)) - w * (p(1, m + 1) + p(-1, -m - 1)),
        m => u + v * (p(1, m + 1) + p(-1, -m - 1)) - w * (p(1, m - 1) - p(-1, 1 - m)),
    }
}

/// Converts to the sign convention used here, the literature's times (−1)^m. Entries within rounding of 0 and ±1 become
/// exact, so that exchanging axes changes no more bits than it must.
fn in_our_signs(mut block: Block) -> Block {
    for (m, row) in block.iter_mut().enumerate() {
        for (n, value) in row.iter_mut().enumerate() {
            let signed = if (m + n) % 2 == 0 { *value } else { -*value };
            *value = if (signed - signed.round()).abs() < 1e-14 { signed.round() } else { signed };
        }
    }
    block
}

#[cfg(test)]
mod tests {
    use glam::{DQuat, DVec3};
    use rand::{RngExt as _, SeedableRng as _};
    use rand_pcg::Pcg64Mcg;

    use super::*;
    use crate::scene::sh;

    /// Rotations about random and coordinate axes, with and without reflection.
    fn orthogonal_matrices() -> Vec<DMat3> {
        let mut rng = Pcg64Mcg::seed_from_u64(3);
        let mut random = || DQuat::from_array([0; 4].map(|_| rng.random_range(-1.0..1.0))).normalize();
        let mut rotations: Vec<DMat3> = (0..40).map(|_| DMat3::from_quat(random())).collect();
        let quarter = std::f64::consts::FRAC_PI_2;
        for axis in [DVec3::X, DVec3::Y, DVec3::Z] {
            rotations.extend((0..4).map(|i| DMat3::from_axis_angle(axis, f64::from(i) * quarter)));
        }
        let mirrors = [DVec3::new(-1.0, 1.0, 1.0), DVec3::new(1.0, -1.0, 1.0), DVec3::NEG_ONE];
        let mirrored: Vec<DMat3> =
            rotations.iter().zip(mirrors.iter().cycle()).map(|(r, &m)| *r * DMat3::from_diagonal(m)).collect();
        rotations.into_iter().chain(mirrored).collect()
    }

    /// `∫ Y_i(d) Y_j(Oᵀd)` over the sphere; products of degree 6 are integrated exactly by 4 Gauss–Legendre nodes in
    /// z times 8 azimuths.
    fn by_quadrature(orthogonal: DMat3) -> [[f64; 16]; 16] {
        const NODES: [(f64, f64); 4] = [
            (-0.861_136_311_594_052_6, 0.347_854_845_137_453_86),
            (-0.339_981_043_584_856_3, 0.652_145_154_862_546_1),
            (0.339_981_043_584_856_3, 0.652_145_154_862_546_1),
            (0.861_136_311_594_052_6, 0.347_854_845_137_453_86),
        ];
        let mut matrix = [[0.0; 16]; 16];
        for (z, weight) in NODES {
            for step in 0..8 {
                let (sin, cos) = (f64::from(step) * std::f64::consts::FRAC_PI_4).sin_cos();
                let r = (1.0 - z * z).sqrt();
                let d = DVec3::new(r * cos, r * sin, z);
                let (to, from) = (sh::basis(d.to_array()), sh::basis((orthogonal.transpose() * d).to_array()));
                for (row, y) in matrix.iter_mut().zip(to) {
                    row.iter_mut().zip(from).for_each(|(m, x)| *m += weight * std::f64::consts::FRAC_PI_4 * y * x);
                }
            }
        }
        matrix
    }

    #[test]
    fn blocks_are_the_integrals_that_define_them() {
        for orthogonal in orthogonal_matrices() {
            let (rotation, truth) = (Rotation::new(orthogonal), by_quadrature(orthogonal));
            for l in 1..4 {
                for m in 0..2 * l + 1 {
                    for n in 0..2 * l + 1 {
                        let difference = rotation.bands[l - 1][m][n] - truth[l * l + m][l * l + n];
                        // f64 rounding over 32 nodes and two steps of the recursion.
                        assert!(difference.abs() < 1e-13, "{orthogonal}: {difference}");
                    }
                }
            }
        }
    }

    #[test]
    fn turned_coefficients_show_in_turned_directions_what_they_showed() {
        let mut rng = Pcg64Mcg::seed_from_u64(8);
        for orthogonal in orthogonal_matrices() {
            for degree in 0..=3 {
                let k = sh::coefficients(degree);
                let before: Vec<[f32; 3]> = (0..k).map(|_| [0; 3].map(|_| rng.random_range(-2.0..2.0))).collect();
                let mut after = before.clone();
                Rotation::new(orthogonal).apply(&mut after[1..]);
                for _ in 0..20 {
                    let d = DVec3::from_array([0; 3].map(|_| rng.random_range(-1.0..1.0))).normalize();
                    let value = |c: &[[f32; 3]], d: DVec3| -> f64 {
                        sh::basis(d.to_array()).iter().zip(c).map(|(y, c)| y * f64::from(c[1])).sum()
                    };
                    let (was, is) = (value(&before, d), value(&after, orthogonal * d));
                    // Results of size 5 stored in f32, 15 of them summed.
                    assert!((was - is).abs() < 2e-6, "degree {degree}, {orthogonal}: {was} {is}");
                }
            }
        }
    }

    #[test]
    fn identity_and_half_turns_change_signs_only() {
        let coefficients: Vec<[f32; 3]> = (0..15_u8).map(|i| [0.1 * f32::from(i), 0.7, -3.3]).collect();
        let mut same = coefficients.clone();
        Rotation::new(DMat3::IDENTITY).apply(&mut same);
        assert_eq!(same, coefficients);
        let half_turn = Rotation::new(DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0)));
        half_turn.apply(&mut same);
        let magnitudes = |c: &[[f32; 3]]| c.iter().map(|c| c.map(f32::abs)).collect::<Vec<_>>();
        assert!(same != coefficients && magnitudes(&same) == magnitudes(&coefficients));
        half_turn.apply(&mut same);
        assert_eq!(same, coefficients);
    }
}
