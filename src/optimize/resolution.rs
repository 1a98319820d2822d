//! Coarse-to-fine training: splats find their places on few pixels, and detail follows once there are splats for it.
//!
//! After DashGaussian (Chen et al. 2025): pictures grow at the rate at which they gain content, measured there by the
//! amplitudes of their Fourier transforms. Amplitudes of photographs fall like one over the frequency, and their sum
//! over a square of frequencies then grows like its side: so here the side of the pictures grows linearly. The number
//! of splats follows the pictures.

/// Relative side of the first pictures: a quarter of the content is there.
const FIRST: f64 = 0.25;
/// Number of sizes. All but the full one are used for equally many iterations, each in pictures made anew.
const SIZES: u32 = 7;
/// Least number of pixels along the longer side of a reduced picture.
const LEAST_SIDE: f64 = 32.0;

/// Size of pictures in the course of a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct ResolutionSchedule {
    /// Iteration from which pictures have their full size; 0 for always.
    pub(super) full_from: u32,
}

impl ResolutionSchedule {
    /// Relative side of the pictures at iteration `t`, if the longest of them has `side` pixels in full size.
    pub(super) fn scale(&self, t: u32, side: u32) -> f64 {
        let first = FIRST.max((LEAST_SIDE / f64::from(side.max(1))).min(1.0));
        if t >= self.full_from {
            return 1.0;
        }
        let step = u64::from(t) * u64::from(SIZES - 1) / u64::from(self.full_from);
        first + (1.0 - first) * step as f64 / f64::from(SIZES - 1)
    }

    /// Most splats at iteration `t` of a run that began with `initial` and ends with at most `most`: the number added
    /// is proportional to the pixels at first, to their side in the end.
    pub(super) fn max_splats(&self, t: u32, side: u32, initial: usize, most: usize) -> usize {
        if t >= self.full_from {
            return most;
        }
        let at = f64::from(t) / f64::from(self.full_from);
        let room = most.saturating_sub(initial) as f64;
        (initial + (room * self.scale(t, side).powf(2.0 - at)) as usize).min(most)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pictures_grow_in_equal_steps_to_their_size() {
        let schedule = ResolutionSchedule { full_from: 600 };
        let scales: Vec<f64> = (0..7).map(|i| schedule.scale(100 * i, 1000)).collect();
        assert_eq!(scales, [0.25, 0.375, 0.5, 0.625, 0.75, 0.875, 1.0]);
        assert_eq!(
            (schedule.scale(99, 1000), schedule.scale(599, 1000), schedule.scale(9999, 1000)),
            (0.25, 0.875, 1.0)
        );
        // A small picture begins with 32 pixels, a smaller one with its own size.
        assert_eq!((schedule.scale(0, 64), schedule.scale(300, 64)), (0.5, 0.75));
        assert_eq!((schedule.scale(0, 32), schedule.scale(0, 10), schedule.scale(0, 0)), (1.0, 1.0, 1.0));
        let never = ResolutionSchedule { full_from: 0 };
        assert_eq!((never.scale(0, 1000), never.max_splats(0, 1000, 1, 9)), (1.0, 9));
    }

    #[test]
    fn the_number_of_splats_follows_the_pictures() {
        let schedule = ResolutionSchedule { full_from: 600 };
        assert_eq!(schedule.max_splats(0, 1000, 2000, 18_000), 3000);
        assert_eq!(schedule.max_splats(600, 1000, 2000, 18_000), 18_000);
        let counts: Vec<usize> = (0..=600).map(|t| schedule.max_splats(t, 1000, 2000, 18_000)).collect();
        assert!(counts.is_sorted());
        // The number is already above the limit.
        assert_eq!(schedule.max_splats(0, 1000, 20, 10), 10);
    }
}
