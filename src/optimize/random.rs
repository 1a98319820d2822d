//! Random numbers of a run: a generator for each purpose, seeded by the seed and the iteration, so that a resumed run
//! draws the same numbers as an uninterrupted one.

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;

use super::Phase;

/// Purpose of random numbers. No two share a stream.
#[derive(Clone, Copy, Debug)]
pub(super) enum Purpose {
    /// The density step after an iteration of the splats.
    Density,
    /// Random choices within an iteration: background, noise, dropout.
    Step(Phase),
    /// The order of the views in an epoch.
    ViewOrder(Phase),
}

/// Generator for iteration or epoch `at` of the splats, whichever phase that is in, or of the warm-up.
pub(super) fn generator(seed: u64, purpose: Purpose, at: u32) -> Pcg64 {
    let clock = |phase| match phase {
        Phase::Warmup => 1,
        Phase::Surface | Phase::Joint => 2,
    };
    let (seed, tag) = match purpose {
        Purpose::Density => (seed, 0),
        Purpose::Step(phase) => (seed, clock(phase)),
        Purpose::ViewOrder(phase) => (seed ^ 0x5eed, clock(phase)),
    };
    // The multiplier (2⁶⁴ over the golden ratio) keeps neighbouring seeds from sharing streams with neighbouring
    // iterations.
    Pcg64::seed_from_u64(seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) ^ (u64::from(at) << 2 | tag))
}

/// Three independent standard normal numbers (Box–Muller).
pub(super) fn normal3(rng: &mut Pcg64) -> glam::Vec3 {
    let mut pair = || {
        let radius = (-2.0 * (1.0 - rng.random::<f64>()).ln()).sqrt();
        let (sin, cos) = (std::f64::consts::TAU * rng.random::<f64>()).sin_cos();
        (radius * cos, radius * sin)
    };
    let ((x, y), (z, _)) = (pair(), pair());
    glam::DVec3::new(x, y, z).as_vec3()
}

#[cfg(test)]
mod tests {
    use std::collections::HashSet;

    use super::*;

    #[test]
    fn nothing_draws_the_numbers_of_another() {
        use Phase::{Joint, Surface, Warmup};
        let first = |seed, purpose, at| generator(seed, purpose, at).random::<u64>();
        let of_splats = [Purpose::Density, Purpose::Step(Joint), Purpose::ViewOrder(Joint)];
        let all = of_splats.into_iter().chain([Purpose::Step(Warmup), Purpose::ViewOrder(Warmup)]);
        let drawn: HashSet<u64> = all
            .flat_map(|purpose| (0..3).flat_map(move |seed| (0..1000).map(move |at| first(seed, purpose, at))))
            .collect();
        assert_eq!(drawn.len(), 5 * 3 * 1000);
        // The clock of the splats continues from phase to phase.
        assert_eq!(first(1, Purpose::Step(Surface), 7), first(1, Purpose::Step(Joint), 7));
    }

    #[test]
    fn normals_have_unit_variance() {
        let mut rng = generator(1, Purpose::Density, 2);
        let n = 20_000;
        let (mut sum, mut squares) = (glam::Vec3::ZERO, glam::Vec3::ZERO);
        for _ in 0..n {
            let x = normal3(&mut rng);
            sum += x;
            squares += x * x;
        }
        // Five standard errors: 5/√20000 = 0.035 for the mean, and √2 times that for the variance.
        assert!((sum / n as f32).abs().max_element() < 0.035);
        assert!((squares / n as f32 - 1.0).abs().max_element() < 0.05);
    }
}
