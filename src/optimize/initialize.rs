//! Initial splats of an optimisation.

use glam::{DVec3, Quat, Vec3};
use rand::{RngExt, SeedableRng, seq::index};
use rand_pcg::Pcg64;

use crate::render::gpu::state::logit;
use crate::{
    capture::{Point, extent},
    geometry::mean_squared_distance_to_3_neighbors,
    scene::{Camera, OpticalAxes, SceneError, Splats, center_and_spread, sh},
    stats::median,
};

/// Opacity and relative scale of initial splats.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Initial {
    /// Opacity, 0 to 1.
    pub opacity: f32,
    /// Scale divided by the distance to the neighbours.
    pub scale: f32,
}

impl Initial {
    /// For density control by gradients (INRIA 3DGS, `scene/gaussian_model.py`).
    pub const INRIA: Self = Self { opacity: 0.1, scale: 1.0 };

    /// For MCMC (3DGS-MCMC's `scene/gaussian_model.py`).
    pub const MCMC: Self = Self { opacity: 0.5, scale: 0.1 };

    /// For MCMC with splats at points, in a run of so many iterations: larger in runs shorter than 30,000.
    ///
    /// Splats grow by at most half a percent per iteration, in short runs by some percent, so that in a run of 500 the
    /// first ones would stay too small until its end. The scale factor is inversely proportional to the cube root of
    /// the iterations, but at most 1 (`docs/experiments.md`).
    #[must_use]
    pub fn mcmc_in(iterations: u32) -> Self {
        let shorter = 30_000.0 / iterations.clamp(30, 30_000) as f32;
        Self { scale: Self::MCMC.scale * shorter.cbrt(), ..Self::MCMC }
    }
}

/// Creates one round splat per sparse point: scale from the distance to its three nearest neighbours, colour of the
/// point.
///
/// Of more than `max_splats` points a random sample is taken, with distances measured within the sample. Points that do
/// not fit in f32 are left out.
///
/// # Errors
/// If `sh_degree` exceeds 3.
pub fn from_points(
    points: &[Point],
    sh_degree: u32,
    initial: Initial,
    max_splats: usize,
    seed: u64,
) -> Result<Splats, SceneError> {
    let mut points: Vec<(Vec3, [u8; 3])> =
        points.iter().map(|p| (p.position.as_vec3(), p.rgb)).filter(|p| p.0.is_finite()).collect();
    if points.len() > max_splats {
        let mut rng = Pcg64::seed_from_u64(seed);
        let mut chosen = index::sample(&mut rng, points.len(), max_splats).into_vec();
        chosen.sort_unstable();
        points = chosen.into_iter().map(|i| points[i]).collect();
    }
    let (means, colors): (Vec<_>, Vec<_>) =
        points.into_iter().map(|(mean, rgb)| (mean, rgb.map(|c| f32::from(c) / 255.0))).unzip();
    among_neighbors(means, &colors, sh_degree, initial)
}

/// Creates `count` grey splats at random places that the cameras look at, for captures without points.
///
/// The cameras' common focus is the least-squares nearest point to their optical axes. Half of the splats fill a box
/// about it that reaches half-way to the median camera, where the object of an object capture is; the other half one
/// that reaches to the camera, for what surrounds it. Without such a focus in front of most cameras (axes parallel, or
/// pointing outwards) the box is centred three extents along the mean viewing direction and reaches as far.
///
/// # Errors
/// If `sh_degree` exceeds 3.
pub fn from_cameras(
    cameras: &[Camera],
    count: usize,
    sh_degree: u32,
    initial: Initial,
    seed: u64,
) -> Result<Splats, SceneError> {
    let (center, reach) = focus(cameras);
    let mut rng = Pcg64::seed_from_u64(seed);
    let means = (0..count)
        .map(|i| {
            let half = if i % 2 == 0 { 0.5 * reach } else { reach };
            let mut side = || half * (2.0 * rng.random::<f64>() - 1.0);
            (center + DVec3::new(side(), side(), side())).as_vec3()
        })
        .collect();
    among_neighbors(means, &vec![[0.5; 3]; count], sh_degree, initial)
}

/// Round splats scaled by the distance to their neighbours.
fn among_neighbors(
    means: Vec<Vec3>,
    colors: &[[f32; 3]],
    sh_degree: u32,
    initial: Initial,
) -> Result<Splats, SceneError> {
    let scales: Vec<f32> = neighbor_scales(&means).into_iter().map(|s| s * initial.scale).collect();
    round_splats(means, &scales, colors, initial.opacity, sh_degree)
}

/// Round splats of one opacity, without view dependence. `colors` are RGB, 0 to 1.
pub(super) fn round_splats(
    means: Vec<Vec3>,
    scales: &[f32],
    colors: &[[f32; 3]],
    opacity: f32,
    sh_degree: u32,
) -> Result<Splats, SceneError> {
    let n = means.len();
    let terms = sh::coefficients(sh_degree.min(sh::MAX_DEGREE));
    let mut coefficients = vec![[0.0; 3]; n * terms];
    for (row, &color) in coefficients.chunks_exact_mut(terms).zip(colors) {
        row[0] = sh::dc_from_rgb(color);
    }
    Splats::new(
        means,
        vec![Quat::IDENTITY; n],
        scales.iter().map(|s| Vec3::splat(s.ln())).collect(),
        vec![logit(opacity); n],
        sh_degree,
        coefficients,
    )
}

/// Root-mean-square distance to the three nearest neighbours, clamped to between a hundredth and ten times its median.
///
/// Clamped from below because points may coincide; INRIA's floor of √1e-7 presumes a scene of a few units. Clamped from
/// above because structure from motion leaves single points far from all others (sky, mismatches): a splat as large as
/// their distance covers every picture, and density control takes thousands of iterations to remove it.
fn neighbor_scales(means: &[Vec3]) -> Vec<f32> {
    let mut scales: Vec<f32> =
        mean_squared_distance_to_3_neighbors(means).into_iter().map(|d| d.min(f32::MAX).sqrt()).collect();
    let positive = scales.iter().filter(|&&s| s > 0.0).map(|&s| f64::from(s)).collect();
    let median = median(positive).map_or(1e-7_f32.sqrt() * 100.0, |median| median as f32);
    let floor = (median / 100.0).max(f32::MIN_POSITIVE);
    scales.iter_mut().for_each(|s| *s = s.clamp(floor, (10.0 * median).max(floor)));
    scales
}

/// Common focus of the cameras and their median distance to it, or an estimate where they have none.
fn focus(cameras: &[Camera]) -> (DVec3, f64) {
    common_focus(cameras).unwrap_or_else(|| {
        let n = cameras.len().max(1) as f64;
        let (mean, _) = center_and_spread(cameras);
        let axis = cameras.iter().map(|c| c.rotation().row(2)).sum::<DVec3>() / n;
        let reach = match 3.0 * extent(cameras) {
            e if e > 0.0 => e,
            _ => 1.0, // cameras in one place have no scale
        };
        (mean + axis * reach, reach)
    })
}

/// Median distance of the cameras to their common focus; `None` if it is not in front of most of them.
pub(super) fn distance_of_focus(cameras: &[Camera]) -> Option<f64> {
    common_focus(cameras).map(|(_, distance)| distance)
}

/// Point nearest to the optical axes, if in front of most cameras, and the median distance to it.
fn common_focus(cameras: &[Camera]) -> Option<(DVec3, f64)> {
    let point = OpticalAxes::of(cameras).meeting_point()?;
    let median = median(cameras.iter().map(|c| c.center().distance(point)).collect())?;
    let is_in_front = |c: &&Camera| (point - c.center()).dot(c.rotation().row(2)) > 0.5 * median;
    let in_front = cameras.iter().filter(is_in_front).count();
    (median > 0.0 && 2 * in_front > cameras.len()).then_some((point, median))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::Intrinsics;

    fn point(x: f64, y: f64, z: f64) -> Point {
        Point { position: DVec3::new(x, y, z), rgb: [255, 0, 51] }
    }

    fn grid(n: usize, step: f64) -> Vec<Point> {
        (0..n * n).map(|i| point((i % n) as f64 * step, (i / n) as f64 * step, 0.0)).collect()
    }

    fn look(from: DVec3, to: DVec3) -> Camera {
        let intrinsics = Intrinsics { width: 100, height: 100, fx: 90.0, fy: 90.0, cx: 50.0, cy: 50.0 };
        Camera::look_at(intrinsics, from, to, DVec3::ZERO).unwrap()
    }

    #[test]
    fn splats_take_their_size_and_colour_from_the_points() {
        let splats = from_points(&grid(20, 0.5), 3, Initial::INRIA, 1000, 1).unwrap();
        assert_eq!((splats.len(), splats.sh_degree()), (400, 3));
        for i in 0..400 {
            // Inside and on edges there are three neighbours at 0.5; at corners the third is at √½: d² = (2·¼ + ½)/3.
            let corner = [0, 19].contains(&(i % 20)) && [0, 19].contains(&(i / 20));
            let scale = if corner { (1.0_f32 / 3.0).sqrt() } else { 0.5 };
            assert!((splats.log_scales()[i].exp() - scale).abs().max_element() < 1e-6);
            let rgb = sh::rgb_from_dc(splats.sh_of(i)[0]);
            assert!(rgb.iter().zip([1.0, 0.0, 0.2]).all(|(a, b)| (a - b).abs() < 1e-6));
            assert!(splats.sh_of(i)[1..].iter().all(|&c| c == [0.0; 3]));
            assert!((splats.opacity_logits()[i] + 9.0_f32.ln()).abs() < 1e-6); // σ⁻¹(0.1)
            assert_eq!(splats.rotations()[i], Quat::IDENTITY);
        }
        let mcmc = from_points(&grid(20, 0.5), 0, Initial::MCMC, 1000, 1).unwrap();
        assert_eq!(mcmc.opacity_logits()[0], 0.0);
        assert!((mcmc.log_scales()[25].x.exp() - 0.05).abs() < 1e-6);
        for (iterations, scale) in [(1, 1.0), (30, 1.0), (1111, 0.3), (100_000, 0.1)] {
            assert!((Initial::mcmc_in(iterations).scale - scale).abs() < 1e-3, "{iterations}");
        }
    }

    #[test]
    fn neither_outliers_nor_duplicates_get_out_of_hand() {
        let mut points = grid(20, 0.5);
        points.push(point(1e4, 0.0, 0.0));
        points.extend([point(3.1, 3.1, 0.0); 9]);
        points.push(Point { position: DVec3::splat(1e300), rgb: [0; 3] }); // beyond f32
        let splats = from_points(&points, 0, Initial::INRIA, 1000, 1).unwrap();
        assert_eq!(splats.len(), 410);
        assert!((splats.log_scales()[400].x.exp() - 5.0).abs() < 1e-5, "ten times the median");
        assert!((splats.log_scales()[405].x.exp() - 0.005).abs() < 1e-8, "a hundredth of the median");
    }

    #[test]
    fn few_points_and_none() {
        for points in [vec![], vec![point(1.0, 2.0, 3.0)], vec![point(1.0, 2.0, 3.0); 5]] {
            let splats = from_points(&points, 1, Initial::INRIA, 1000, 1).unwrap();
            assert_eq!(splats.len(), points.len());
            assert!(splats.log_scales().iter().all(|s| (s.x.exp() - 1e-7_f32.sqrt()).abs() < 1e-8));
        }
        assert!(from_points(&grid(2, 1.0), 4, Initial::INRIA, 1000, 1).is_err());
    }

    #[test]
    fn too_many_points_are_sampled_and_their_distances_grow() {
        let points = grid(40, 0.5);
        let splats = from_points(&points, 0, Initial::INRIA, 100, 1).unwrap();
        assert_eq!(splats.len(), 100);
        let mean = splats.log_scales().iter().map(|s| s.x.exp()).sum::<f32>() / 100.0;
        assert!(mean > 1.0, "a sixteenth of the points is four times as sparse: {mean}");
        assert_eq!(splats, from_points(&points, 0, Initial::INRIA, 100, 1).unwrap());
        assert_ne!(splats, from_points(&points, 0, Initial::INRIA, 100, 2).unwrap());
    }

    #[test]
    fn without_points_splats_surround_what_the_cameras_look_at() {
        let target = DVec3::new(5.0, -2.0, 1.0);
        let ring: Vec<Camera> = (0..12)
            .map(|i| f64::from(i) * 0.5)
            .map(|a| look(target + 4.0 * DVec3::new(a.cos(), a.sin(), 0.3), target))
            .collect();
        let (center, reach) = focus(&ring);
        assert!(center.distance(target) < 1e-9 && (reach - 4.0 * 1.09_f64.sqrt()).abs() < 1e-9);
        assert_eq!(distance_of_focus(&ring), Some(reach));
        let splats = from_cameras(&ring, 1000, 1, Initial::INRIA, 3).unwrap();
        assert_eq!(splats.len(), 1000);
        let offsets: Vec<f32> =
            splats.means().iter().map(|m| (*m - target.as_vec3()).abs().max_element() / reach as f32).collect();
        assert!(offsets.iter().all(|&o| o <= 1.0 + 1e-6));
        assert!(offsets.iter().step_by(2).all(|&o| o <= 0.5 + 1e-6));
        assert_eq!(splats, from_cameras(&ring, 1000, 1, Initial::INRIA, 3).unwrap());
    }

    #[test]
    fn parallel_and_outward_cameras_have_a_box_too() {
        let parallel: Vec<Camera> = (0..5).map(|i| DVec3::X * f64::from(i)).map(|c| look(c, c + DVec3::Z)).collect();
        let (center, reach) = focus(&parallel);
        assert!((reach - 6.6).abs() < 1e-9 && center.distance(DVec3::new(2.0, 0.0, 6.6)) < 1e-9);
        let outward: Vec<Camera> = (0..8)
            .map(|i| f64::from(i) * std::f64::consts::FRAC_PI_4)
            .map(|a| DVec3::new(a.cos(), a.sin(), 0.0))
            .map(|d| look(d, 2.0 * d))
            .collect();
        let (center, reach) = focus(&outward);
        assert!(center.length() < 1e-9 && (reach - 3.3).abs() < 1e-9);
        assert_eq!([&parallel, &outward].map(|cameras| distance_of_focus(cameras)), [None, None]);
        let (center, reach) = focus(&[]);
        assert_eq!((center, reach), (DVec3::ZERO, 1.0));
    }
}
