use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

use super::*;

/// The rules of HERA's stable order, written out one by one.
fn is_behind(z: f64, d: f64, sample: SurfaceDepth, lambda: f64) -> bool {
    if z - d > lambda {
        return true;
    }
    match sample {
        SurfaceDepth::Outside => true,
        SurfaceDepth::Empty => z > d,
        SurfaceDepth::Depth(surface) => z > surface * (1.0 + TIE_EPSILON),
    }
}

/// Mode `SurfaceConsistent` by definition: the nearest of all surfaces decides if it is within λ.
fn is_behind_surface_consistent(z: f64, d: f64, samples: &[SurfaceDepth], lambda: f64) -> bool {
    let nearest = samples
        .iter()
        .filter_map(|s| if let SurfaceDepth::Depth(x) = s { Some(*x) } else { None })
        .min_by(|a, b| (a - d).abs().total_cmp(&(b - d).abs()));
    match nearest {
        Some(surface) if (surface - d).abs() <= lambda => z > surface * (1.0 + TIE_EPSILON),
        _ => z > d,
    }
}

struct Case {
    z: f64,
    layers: Vec<f64>,
    samples: Vec<SurfaceDepth>,
    lambda: f64,
}

/// Depths that are multiples of 1/8, in some cases with a tie or a depth within the tie epsilon.
fn random_case(rng: &mut Pcg64Mcg) -> Case {
    let z = f64::from(rng.random_range(8..40)) / 8.0;
    let n = rng.random_range(1..=MAX_LAYERS);
    let mut layers: Vec<f64> = (0..n).map(|_| rng.random_range(1.0..5.0)).collect();
    layers.sort_by(f64::total_cmp);
    let samples = (0..n)
        .map(|_| match rng.random_range(0..8) {
            0 => SurfaceDepth::Outside,
            1 => SurfaceDepth::Empty,
            2 => SurfaceDepth::Depth(z),
            3 => SurfaceDepth::Depth(z * (1.0 - 0.5e-5)),
            4 => SurfaceDepth::Depth(z * (1.0 - 2e-5)),
            _ => SurfaceDepth::Depth(rng.random_range(1.0..5.0)),
        })
        .collect();
    let lambda = match rng.random_range(0..4) {
        0 => 0.0,
        1 => f64::INFINITY,
        _ => rng.random_range(0.001..2.0),
    };
    Case { z, layers, samples, lambda }
}

#[test]
fn thresholds_are_the_rules_of_stable_and_direct() {
    let mut rng = Pcg64Mcg::seed_from_u64(1);
    for _ in 0..200_000 {
        let Case { z, layers, samples, lambda } = random_case(&mut rng);
        let stable = thresholds(OrderMode::Stable, z, &samples, lambda);
        let direct = thresholds(OrderMode::Direct, z, &samples, lambda);
        for (i, &d) in layers.iter().enumerate() {
            // z − d > λ and d < z − λ can round differently.
            if (z - d - lambda).abs() > 1e-9 {
                assert_eq!(d < stable[i], is_behind(z, d, samples[i], lambda), "{z} {d} {:?} {lambda}", samples[i]);
            }
            assert_eq!(d < direct[i], z > d);
        }
        let expected = (0..layers.len()).filter(|&i| layers[i] < stable[i]).max().map_or(0, |i| i + 1);
        assert_eq!(bucket(&layers, &stable), expected);
    }
}

#[test]
fn threshold_is_the_nearest_sheet_rule() {
    let mut rng = Pcg64Mcg::seed_from_u64(2);
    let mut compared = 0;
    for _ in 0..400_000 {
        let Case { z, layers, samples, lambda } = random_case(&mut rng);
        // If λ is smaller than the tie epsilon, the literal rule calls a depth between a surface and a mean tied to it
        // "behind" although the surface itself is not: no threshold can express that.
        let tied = |s: &SurfaceDepth| matches!(s, SurfaceDepth::Depth(x) if (0.0..=2e-5 * z).contains(&(z - x)));
        if lambda < 2e-5 * z && samples.iter().any(tied) {
            continue;
        }
        let threshold = thresholds(OrderMode::SurfaceConsistent, z, &samples, lambda)[0];
        for &d in &layers {
            let expected = is_behind_surface_consistent(z, d, &samples, lambda);
            assert_eq!(d < threshold, expected, "z {z} d {d} {samples:?} λ {lambda} t {threshold}");
            compared += 1;
        }
    }
    assert!(compared > 500_000);
}

/// A 4×3 depth image: depth 2 in the two left columns, 5 in the third, empty in the fourth.
fn sample(u: f64, v: f64, lambda: f64) -> SurfaceDepth {
    surface_depth(|[x, _]| [2.0, 2.0, 5.0, 0.0][x as usize], [4, 3], DVec2::new(u, v), lambda)
}

#[test]
fn surface_depth_cases() {
    use SurfaceDepth::{Depth, Empty, Outside};
    assert_eq!(sample(-0.01, 1.0, 1.0), Outside);
    assert_eq!(sample(4.0, 1.0, 1.0), Outside);
    assert_eq!(sample(1.0, 3.0, 1.0), Outside);
    // Coordinates are clamped at the border, and constant regions are exact.
    assert_eq!(sample(0.0, 0.0, 1.0), Depth(2.0));
    assert_eq!(sample(1.2, 2.9, 1.0), Depth(2.0));
    // An edge of depth 3 within λ: 1/z is interpolated. Beyond λ the nearer pixel decides.
    let Depth(z) = sample(2.0, 1.5, 4.0) else { panic!("expected a depth") };
    assert!((z - 2.0 / (1.0 / 2.0 + 1.0 / 5.0)).abs() < 1e-12);
    assert_eq!(sample(1.9, 1.5, 1.0), Depth(2.0));
    assert_eq!(sample(2.1, 1.5, 1.0), Depth(5.0));
    // Empty taps are ignored, unless all are empty.
    assert_eq!(sample(3.4, 1.5, 1.0), Depth(5.0));
    assert_eq!(sample(3.7, 1.5, 1.0), Empty);
    // At an edge the nearest of the four taps decides, and it can be empty.
    let corner = |[x, y]: [u32; 2]| [[0.0, 2.0], [5.0, 5.0]][y as usize][x as usize];
    assert_eq!(surface_depth(corner, [2, 2], DVec2::new(0.8, 0.8), 1.0), Empty);
}

#[test]
fn surface_depth_is_exact_on_a_plane() {
    // 1/z = a + b·u + c·v at pixel centres.
    let inverse = |u: f64, v: f64| 0.5 + 0.01 * u - 0.02 * v;
    let depth_at = |[x, y]: [u32; 2]| 1.0 / inverse(f64::from(x) + 0.5, f64::from(y) + 0.5);
    let SurfaceDepth::Depth(z) = surface_depth(depth_at, [9, 9], DVec2::new(4.3, 2.8), 1.0) else {
        panic!("expected a depth")
    };
    assert!((z * inverse(4.3, 2.8) - 1.0).abs() < 1e-14);
}

#[test]
fn alpha_limits() {
    assert_eq!(splat_alpha(1.0, 0.0), Some(ALPHA_CAP));
    assert_eq!(splat_alpha(0.5, 1e-9), Some(0.5));
    assert_eq!(splat_alpha(ALPHA_CUT * 0.999, 0.0), None);
    assert_eq!(splat_alpha(0.5, f64::NAN), None);
    assert_eq!(splat_extent(ALPHA_CUT * 0.999, DVec2::ONE), None);
    // On the boundary ellipse of the extent, alpha equals the cut-off.
    let e = splat_extent(0.7, DVec2::new(4.0, 9.0)).unwrap();
    assert!((0.7 * (-0.5 * e.x * e.x / 4.0_f64).exp() - ALPHA_CUT).abs() < 1e-15);
    assert!((e.y / e.x - 1.5).abs() < 1e-12);
    assert_eq!(mesh_alpha(100.0), MESH_ALPHA_CAP);
    assert_eq!(mesh_alpha(0.0), 0.5);
    assert_eq!(mesh_alpha(-1e4), 0.0);
}
