//! Stability of the order of splats and mesh layers while a camera moves.

use glam::{DMat3, DVec3};
use rayon::prelude::*;

use super::{Parameters, View, rotation};
use crate::render::contract;
use crate::scene::{Camera, HybridScene, smoothed};

/// Count of changes of side between splats and mesh from one camera to the next.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct OrderFlips {
    /// Number of points compared: the six ends of each splat's axes, at one standard deviation, if in both cameras'
    /// pictures and if a layer of the pixel is within the scene's λ of the mean's depth. Farther apart, an order
    /// changes where the mesh begins or ends to hide the splat, and should.
    pub points: usize,
    /// Points at which the splat is behind a different number of layers in the two pictures.
    pub flips: usize,
}

impl OrderFlips {
    /// Fraction of points that flip, 0 to 1.
    #[must_use]
    pub fn part(self) -> f64 {
        self.flips as f64 / self.points.max(1) as f64
    }
}

impl std::ops::Add for OrderFlips {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        Self { points: self.points + other.points, flips: self.flips + other.flips }
    }
}

/// Compares the order of every splat among the mesh layers between two cameras, at points that move with the splat. If
/// it differs between neighbouring pictures of a path, a splat shows in one and not in the next: it pops (HERA's reason
/// for its stable order).
#[must_use]
pub fn order_flips(scene: &HybridScene, cameras: [&Camera; 2]) -> OrderFlips {
    let (parameters, lambda) = (Parameters::of(scene), f64::from(scene.composition.lambda));
    let views = cameras.map(|camera| View::new(scene, camera, &parameters));
    // Per splat, its index in each view.
    let mut seen = vec![[None; 2]; parameters.means.len()];
    for (which, view) in views.iter().enumerate() {
        for (place, (splat, _)) in view.splats.iter().enumerate() {
            seen[splat.index][which] = Some(place);
        }
    }
    let both = |(i, seen): (usize, &[Option<usize>; 2])| Some((i, [seen[0]?, seen[1]?]));
    let of_splat = |(i, places): (usize, [usize; 2])| {
        let (scale, _) = smoothed(parameters.log_scales[i], parameters.smoothing[i]);
        let axes = rotation(parameters.rotations[i]) * DMat3::from_diagonal(scale);
        let ends = [axes.x_axis, axes.y_axis, axes.z_axis].into_iter().flat_map(|axis| [axis, -axis]);
        let order = |which: usize, point: DVec3| {
            let view: &View = &views[which];
            let (splat, thresholds) = &view.splats[places[which]];
            let depths = layer_depths(view, point)?;
            let is_near = depths.iter().any(|depth| (depth - splat.depth).abs() <= lambda);
            is_near.then(|| contract::bucket(&depths, thresholds))
        };
        let mut found = OrderFlips::default();
        for point in ends.map(|end| parameters.means[i] + end) {
            if let (Some(a), Some(b)) = (order(0, point), order(1, point)) {
                found = found + OrderFlips { points: 1, flips: usize::from(a != b) };
            }
        }
        found
    };
    let splats: Vec<_> = seen.iter().enumerate().filter_map(both).collect();
    splats.into_par_iter().map(of_splat).reduce(OrderFlips::default, |a, b| a + b)
}

/// Depths of the layers at the pixel that shows a world point, if there is one.
fn layer_depths(view: &View, point: DVec3) -> Option<Vec<f64>> {
    let at = view.camera.in_picture(view.camera.to_camera(point))?;
    let layers = &view.layers[at.y as usize * view.camera.intrinsics().width as usize + at.x as usize];
    Some(layers.iter().map(|layer| layer.depth).collect())
}

#[cfg(test)]
mod tests {
    use glam::{DQuat, DVec2, Quat, Vec3};
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg64Mcg;

    use super::*;
    use crate::render::testing::grid_mesh;
    use crate::scene::{Atlas, Composition, Intrinsics, OrderMode, Splats, Texture};

    /// A sphere of radius 1 and splats of size 1/20 with means slightly in front of and behind its surface, like fur.
    fn furry_sphere(mode: OrderMode) -> HybridScene {
        let mut rng = Pcg64Mcg::seed_from_u64(1);
        let unit = |u: f64, v: f64| {
            let (longitude, latitude) = (u * std::f64::consts::TAU, (v - 0.5) * std::f64::consts::PI);
            DVec3::new(latitude.cos() * longitude.cos(), latitude.sin(), latitude.cos() * longitude.sin())
        };
        let sphere =
            grid_mesh([64, 32], Atlas::new(Texture::zeros(4, 4, 4), None).unwrap(), |u, v| unit(u, v).as_vec3());
        let n = 1200;
        let means: Vec<Vec3> = (0..n)
            .map(|i| {
                let at = DVec2::from_array([0; 2].map(|_| rng.random_range(0.1..0.9)));
                (unit(at.x, at.y) * [1.02, 0.97][i % 2]).as_vec3()
            })
            .collect();
        let rotations = (0..n).map(|_| Quat::from_array([0; 4].map(|_| rng.random_range(-1.0..1.0_f32)))).collect();
        let (log_scales, logits, sh) = (vec![Vec3::splat(0.05_f32.ln()); n], vec![0.0; n], vec![[0.0_f32; 3]; n]);
        let splats = Splats::new(means, rotations, log_scales, logits, 0, sh).unwrap();
        HybridScene {
            splats,
            meshes: vec![sphere],
            composition: Composition { mode, lambda: 0.3, layers: 1, ..Composition::default() },
        }
    }

    /// A camera four radii away, at `degrees` around the sphere.
    fn camera(degrees: f64) -> Camera {
        let k = Intrinsics { width: 120, height: 120, fx: 200.0, fy: 200.0, cx: 60.0, cy: 60.0 };
        let turn = DMat3::from_quat(DQuat::from_rotation_y(degrees.to_radians()));
        Camera::new(k, turn, DVec3::new(0.0, 0.0, 4.0)).unwrap()
    }

    #[test]
    fn the_stable_order_flips_far_less_than_the_direct_one() {
        let part = |mode| {
            let scene = furry_sphere(mode);
            let flips = (0..12)
                .map(|i| order_flips(&scene, [&camera(f64::from(i)), &camera(f64::from(i + 1))]))
                .fold(OrderFlips::default(), |a, b| a + b);
            assert!(flips.points > 5000, "{mode:?}: {flips:?}");
            flips.part()
        };
        let [stable, consistent, direct] =
            [OrderMode::Stable, OrderMode::SurfaceConsistent, OrderMode::Direct].map(part);
        eprintln!(
            "flips of the order a degree: stable {stable:.5}, surface-consistent {consistent:.5}, direct {direct:.5}"
        );
        assert!(direct > 0.005, "{direct}: nothing to be steady against");
        assert!(stable < direct / 4.0 && consistent < direct / 4.0, "{stable}, {consistent}, {direct}");
    }

    #[test]
    fn the_same_picture_has_no_flips() {
        let scene = furry_sphere(OrderMode::Direct);
        let flips = order_flips(&scene, [&camera(3.0), &camera(3.0)]);
        assert!(flips.points > 400 && flips.flips == 0, "{flips:?}");
        assert_eq!(order_flips(&HybridScene { meshes: vec![], ..scene }, [&camera(0.0), &camera(1.0)]).part(), 0.0);
    }
}
