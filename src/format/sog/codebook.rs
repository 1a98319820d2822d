//! Codebook quantisation: 256 representative values found by Lloyd's algorithm in one dimension.

use rayon::slice::ParallelSliceMut as _;

/// Codebook of 256 values in ascending order.
pub(super) struct Codebook {
    values: [f32; 256],
    /// Midpoints between neighbours: value `i` is the nearest one between borders i−1 and i.
    borders: [f32; 255],
}

/// Upper bound on iterations. A few dozen suffice until no border passes a sample.
const ITERATIONS: usize = 100;
/// Number of bins of the density from which the initial codebook is derived.
const BINS: usize = 4096;

impl Codebook {
    /// Codebook of (locally) least squared error. Up to 256 distinct values are kept exactly.
    ///
    /// Samples are sorted first; with prefix sums over the sorted values, an iteration visits only 255 borders.
    pub(super) fn of(mut samples: Vec<f32>) -> Self {
        samples.par_sort_unstable_by(f32::total_cmp);
        let mut distinct: Vec<f32> = vec![];
        for &s in &samples {
            if distinct.last() != Some(&s) {
                distinct.push(s);
                if distinct.len() > 256 {
                    return Self::lloyd(&samples);
                }
            }
        }
        let last = distinct.last().copied().unwrap_or(0.0);
        distinct.resize(256, last);
        Self::new(std::array::from_fn(|i| distinct[i]))
    }

    fn new(values: [f32; 256]) -> Self {
        Self { values, borders: std::array::from_fn(|i| 0.5 * values[i] + 0.5 * values[i + 1]) }
    }

    /// Runs Lloyd's algorithm; `sorted` has more than 256 distinct values.
    fn lloyd(sorted: &[f32]) -> Self {
        let mut sums = Vec::with_capacity(sorted.len() + 1);
        let mut sum = 0.0;
        sums.push(sum);
        sums.extend(sorted.iter().map(|&v| {
            sum += f64::from(v);
            sum
        }));
        let mut codebook = Self::new(first_values(sorted));
        let mut ends = [0; 256];
        for _ in 0..ITERATIONS {
            let mut moved = false;
            let mut start = 0;
            let mut values = codebook.values;
            for (i, value) in values.iter_mut().enumerate() {
                let border = codebook.borders.get(i);
                let end = border.map_or(sorted.len(), |&b| start + sorted[start..].partition_point(|&v| v <= b));
                moved |= ends[i] != end;
                ends[i] = end;
                if end > start {
                    *value = ((sums[end] - sums[start]) / (end - start) as f64) as f32;
                }
                start = end;
            }
            if !moved {
                break;
            }
            codebook = Self::new(values);
        }
        codebook
    }

    /// Index of the nearest value.
    pub(super) fn nearest(&self, v: f32) -> u8 {
        self.borders.partition_point(|&b| b < v) as u8
    }

    /// Values in ascending order.
    pub(super) fn values(&self) -> &[f32; 256] {
        &self.values
    }
}

/// Initial values, whose density is proportional to the cube root of the samples' density, the optimum for many levels
/// (Panter and Dite 1951, "Quantization distortion in pulse-count modulation with nonuniform spacing of levels").
fn first_values(sorted: &[f32]) -> [f32; 256] {
    let (low, high) = (f64::from(sorted[0]), f64::from(sorted[sorted.len() - 1]));
    let width = (high - low) / BINS as f64;
    let mut cumulated = Vec::with_capacity(BINS);
    let (mut start, mut total) = (0, 0.0);
    for bin in 1..=BINS {
        let end = start + sorted[start..].partition_point(|&v| f64::from(v) <= low + width * bin as f64);
        total += ((end - start) as f64).cbrt();
        cumulated.push(total);
        start = end;
    }
    let mut bin = 0;
    std::array::from_fn(|i| {
        let wanted = total * (i as f64 + 0.5) / 256.0;
        while bin + 1 < BINS && cumulated[bin] < wanted {
            bin += 1;
        }
        let before = if bin == 0 { 0.0 } else { cumulated[bin - 1] };
        let part = (wanted - before) / (cumulated[bin] - before).max(f64::MIN_POSITIVE);
        (low + width * (bin as f64 + part.clamp(0.0, 1.0))) as f32
    })
}

#[cfg(test)]
mod tests {
    use rand::{RngExt as _, SeedableRng as _};
    use rand_pcg::Pcg64Mcg;

    use super::*;

    #[test]
    fn few_values_are_kept() {
        let samples: Vec<f32> = (0..1000).map(|i| (i % 256) as f32 * 0.37 - 40.0).collect();
        let codebook = Codebook::of(samples.clone());
        assert!(samples.iter().all(|&v| codebook.values()[usize::from(codebook.nearest(v))] == v));
        for few in [vec![], vec![3.0], vec![f32::MAX, f32::MIN]] {
            let codebook = Codebook::of(few.clone());
            assert!(few.iter().all(|&v| codebook.values()[usize::from(codebook.nearest(v))] == v), "{few:?}");
        }
    }

    #[test]
    fn nearest_is_nearest_and_normal_samples_come_near_the_optimum() {
        let mut rng = Pcg64Mcg::seed_from_u64(5);
        // The sum of twelve uniform numbers is almost normally distributed.
        let samples: Vec<f32> =
            (0..200_000).map(|_| (0..12).map(|_| rng.random_range(-0.5..0.5f32)).sum::<f32>()).collect();
        let codebook = Codebook::of(samples.clone());
        assert!(codebook.values().is_sorted());
        let mut squares = 0.0;
        for &v in &samples {
            let error = (v - codebook.values()[usize::from(codebook.nearest(v))]).abs();
            squares += f64::from(error).powi(2);
            let least = codebook.values().iter().map(|c| (v - c).abs()).fold(f32::INFINITY, f32::min);
            assert!(error <= least + 1e-6);
        }
        // Panter-Dite formula for a normal distribution and N levels: π√3/2 σ²/N² = 4.15e-5; a uniform grid over its
        // range has twice that.
        let mean = squares / samples.len() as f64;
        assert!(mean < 1.1 * 4.15e-5, "{mean:e}");
    }
}
