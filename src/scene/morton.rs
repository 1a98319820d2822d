use glam::Vec3;
use rayon::prelude::*;

use super::{Splats, bounds};

/// All indices in the order of a Morton curve through the bounding cube of the means, 2²¹ cells a side: neighbours in
/// space become neighbours in memory, which compresses and renders better. Splats of one cell keep their order.
#[must_use]
pub fn in_morton_order(splats: &Splats) -> Vec<usize> {
    let corners = bounds(splats.means().iter().copied()).unwrap_or_default();
    let [low, high] = corners.map(Vec3::as_dvec3);
    let cells = f64::from(1 << 21) / (high - low).max_element().max(f64::MIN_POSITIVE);
    let code = |p: Vec3| {
        // A float-to-integer cast saturates.
        let cell = ((p.as_dvec3() - low) * cells).to_array().map(|c| (c as u64).min((1 << 21) - 1));
        cell.into_iter().enumerate().fold(0, |code, (axis, c)| code | spread(c) << axis)
    };
    let mut keys: Vec<(u64, usize)> = splats.means().par_iter().enumerate().map(|(i, &p)| (code(p), i)).collect();
    keys.par_sort_unstable();
    keys.into_iter().map(|(_, i)| i).collect()
}

/// Inserts two zeros before each of 21 bits.
fn spread(bits: u64) -> u64 {
    let mut x = bits;
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
