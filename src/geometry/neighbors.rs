use std::num::NonZero;

use glam::Vec3;
use kiddo::{ImmutableKdTree, SquaredEuclidean};
use rayon::prelude::*;

/// A point itself and its three nearest neighbours.
const NEIGHBORS: NonZero<usize> = NonZero::new(4).expect("4 is not 0");

/// Mean squared distance of every point to its 3 nearest other points: the initial splat variance of INRIA 3DGS (which
/// floors it at 1e-7; this function does not).
///
/// Coincident points count as neighbours at distance 0. With fewer than 4 points the mean is over those there are; it
/// is 0 for a single point. A point that is not finite gets 0 and is not a neighbour of any other.
#[must_use]
pub fn mean_squared_distance_to_3_neighbors(points: &[Vec3]) -> Vec<f32> {
    let finite: Vec<[f32; 3]> = points.iter().filter(|p| p.is_finite()).map(Vec3::to_array).collect();
    let Ok(tree) = ImmutableKdTree::<f32, 3>::new_from_slice(&finite) else {
        // The tree only rejects more points than a u32 can number.
        return vec![0.0; points.len()];
    };
    points
        .par_iter()
        .map(|p| {
            if !p.is_finite() || finite.len() < 2 {
                return 0.0;
            }
            let found = tree.query(&p.to_array()).nearest_n::<SquaredEuclidean<f32>>(NEIGHBORS).execute();
            // The point finds itself at distance 0, so the sum is over the others; with duplicates it does not matter
            // which of the zeros is dropped.
            let others = (found.len().max(2) - 1) as f32;
            found.iter().map(|n| n.distance).sum::<f32>() / others
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn brute_force(points: &[Vec3], i: usize) -> f32 {
        let mut d: Vec<f32> =
            (0..points.len()).filter(|&j| j != i).map(|j| points[i].distance_squared(points[j])).collect();
        d.sort_by(f32::total_cmp);
        d.iter().take(3).sum::<f32>() / 3.0
    }

    #[test]
    fn equals_brute_force_also_with_duplicates() {
        use rand::{RngExt, SeedableRng};
        let mut rng = rand_pcg::Pcg64::seed_from_u64(1);
        let mut points: Vec<Vec3> = (0..500).map(|_| Vec3::from_array(rng.random::<[f32; 3]>())).collect();
        points.extend_from_within(..50);
        points.extend([Vec3::ONE; 100]);
        let fast = mean_squared_distance_to_3_neighbors(&points);
        for (i, &d) in fast.iter().enumerate() {
            let exact = brute_force(&points, i);
            // Three roundings in f32.
            assert!((d - exact).abs() <= 1e-6 * exact, "{i}: {d} against {exact}");
        }
    }

    #[test]
    fn few_or_broken_points() {
        assert!(mean_squared_distance_to_3_neighbors(&[]).is_empty());
        assert_eq!(mean_squared_distance_to_3_neighbors(&[Vec3::X]), [0.0]);
        assert_eq!(mean_squared_distance_to_3_neighbors(&[Vec3::X, Vec3::NAN, Vec3::ZERO]), [1.0, 0.0, 1.0]);
        assert_eq!(mean_squared_distance_to_3_neighbors(&[Vec3::X; 1000]), [0.0; 1000]);
    }
}
