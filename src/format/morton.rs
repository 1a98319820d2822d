//! The order of splats in which neighbours in a file are neighbours in space.

use glam::Vec3;

/// Indices of `means` along a Morton curve through their bounding box, 21 bits per axis; equal keys keep their order.
pub(super) fn order(means: &[Vec3]) -> Vec<u32> {
    let low = means.iter().copied().reduce(Vec3::min).unwrap_or_default().as_dvec3();
    let high = means.iter().copied().reduce(Vec3::max).unwrap_or_default().as_dvec3();
    // In f64, in which the extent of any f32 positions is finite.
    let extent = (high - low).max_element().max(f64::MIN_POSITIVE);
    let key = |mean: Vec3| {
        let cell = (mean.as_dvec3() - low) / extent * f64::from((1u32 << 21) - 1);
        spread(cell.x as u64) | spread(cell.y as u64) << 1 | spread(cell.z as u64) << 2
    };
    let mut keyed: Vec<(u64, u32)> = means.iter().zip(0..).map(|(&mean, i)| (key(mean), i)).collect();
    keyed.sort_unstable();
    keyed.into_iter().map(|(_, i)| i).collect()
}

/// The lowest 21 bits of `x` with two zeros between each and the next.
fn spread(x: u64) -> u64 {
    let mut x = x & 0x1f_ffff;
    for (shift, mask) in [
        (32, 0x001f_0000_0000_ffff),
        (16, 0x001f_0000_ff00_00ff),
        (8, 0x100f_00f0_0f00_f00f),
        (4, 0x10c3_0c30_c30c_30c3),
        (2, 0x1249_2492_4924_9249),
    ] {
        x = (x | x << shift) & mask;
    }
    x
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bits_are_spread() {
        for bit in 0..21 {
            assert_eq!(spread(1 << bit), 1 << (3 * bit));
        }
        assert_eq!(spread(0x1f_ffff).count_ones(), 21);
    }

    #[test]
    fn octants_stay_together() {
        let corner = |i: u32| Vec3::new((i & 1) as f32, (i >> 1 & 1) as f32, (i >> 2) as f32);
        let means: Vec<Vec3> = (0..24).map(|i| 10.0 * corner(i % 8) + corner(i / 8)).collect();
        let found: Vec<u32> = order(&means).iter().map(|i| i % 8).collect();
        assert!(found.chunks(3).all(|c| c[0] == c[1] && c[1] == c[2]), "{found:?}");
        assert!(order(&[]).is_empty());
        assert_eq!(order(&[Vec3::ONE; 3]), [0, 1, 2]);
        assert_eq!(order(&[Vec3::splat(f32::MAX), Vec3::splat(f32::MIN)]), [1, 0]);
    }
}
