//! Unit of length in which a finished scene is rendered. In scenes that are very small or very large in the unit of
//! their world, depths leave the range of the sort keys, and products of lengths that of f32.

use std::borrow::Cow;

use glam::Vec3;

use crate::{
    scene::{Camera, Composition, HybridScene, Mesh, SceneError},
    stats::median,
};

/// Least depth that sort keys distinguish where the near plane is nearer still, see `compact_visible.wgsl`.
pub(super) const LEAST_DEPTH: f32 = 1e-5;

/// Largest distance of usual scenes, 2³⁰: cubes of a thousand times that, as of a far sphere, still fit in f32.
const FARTHEST: f64 = (1_u64 << 30) as f64;

/// Largest distance of usual scenes relative to the depth that sort keys count from, 2²⁶: keys distinguish depths up to
/// 2³² times that, so up to 64 times the distance.
const FARTHEST_OF_KEYS: f64 = (1_u64 << 26) as f64;

/// Distance, as a power of two, to which others are brought. Sort keys then count from a 2²⁵th of it, and distinguish
/// depths up to some 100 times it.
const USUAL: i32 = 8;

/// Approximate number of points whose distance is measured.
const MOST: usize = 1 << 16;

/// Unit of length in which a scene is rendered.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Unit {
    /// Factor on lengths of the world: a power of two, so that positions and depths keep all of their digits; 1 for
    /// usual scenes.
    factor: f64,
}

impl Unit {
    /// Unit for pictures of `scene` from `cameras`.
    pub(super) fn of(scene: &HybridScene, cameras: &[Camera]) -> Self {
        let distance = typical_distance(scene, cameras);
        Self { factor: distance.map_or(1.0, |distance| factor(distance, scene.composition.near)) }
    }

    /// The scene in this unit; copied only if that is another than the unit of the world.
    ///
    /// # Errors
    /// If the scene is not valid.
    pub(super) fn scene(self, scene: &HybridScene) -> Result<Cow<'_, HybridScene>, SceneError> {
        if self.factor == 1.0 {
            return Ok(Cow::Borrowed(scene));
        }
        let stretch = self.factor.ln();
        let mut splats = scene.splats.clone().into_arrays();
        splats.means.iter_mut().for_each(|mean| *mean = self.point(*mean));
        splats.log_scales.iter_mut().for_each(|s| *s = (s.as_dvec3() + stretch).as_vec3());
        let meshes = scene.meshes.iter().map(|mesh| mesh.clone().moved(|p| self.point(p)));
        Ok(Cow::Owned(HybridScene {
            splats: splats.check()?,
            meshes: meshes.collect::<Result<_, _>>()?,
            composition: self.composition(scene.composition),
        }))
    }

    /// The camera in this unit.
    pub(super) fn camera(self, camera: &Camera) -> Camera {
        camera.scaled(self.factor)
    }

    /// Depths in the unit of the world, from those in this one.
    pub(super) fn in_world(self, mut depths: Vec<f32>) -> Vec<f32> {
        if self.factor != 1.0 {
            depths.iter_mut().for_each(|depth| *depth = (f64::from(*depth) / self.factor) as f32);
        }
        depths
    }

    /// Points too far away for f32 stay finite: no camera sees them.
    fn point(self, point: Vec3) -> Vec3 {
        (self.factor * point.as_dvec3()).as_vec3().clamp(Vec3::MIN, Vec3::MAX)
    }

    fn composition(self, of: Composition) -> Composition {
        let length = |of: f32| (self.factor * f64::from(of)) as f32;
        // Shaders divide by depths, all of which are beyond the near plane.
        Composition { near: length(of.near).clamp(f32::MIN_POSITIVE, f32::MAX), lambda: length(of.lambda), ..of }
    }
}

/// Factor on lengths for a scene at this distance from its cameras, with this near plane: makes the distance 2⁸ to 2⁹,
/// unless it is a usual one.
fn factor(distance: f64, near: f32) -> f64 {
    let are_distinct = distance >= 1.0 || near >= LEAST_DEPTH;
    let farthest = FARTHEST.min(FARTHEST_OF_KEYS * f64::from(near.max(LEAST_DEPTH)));
    if (are_distinct && distance <= farthest) || !distance.is_normal() {
        return 1.0;
    }
    2_f64.powi(USUAL - distance.log2().floor() as i32)
}

/// Median distance of splats and vertices from the cameras, where each is measured from one of these in turn; `None`
/// without splats and vertices, or without cameras. A few that are far from all others change nothing.
fn typical_distance(scene: &HybridScene, cameras: &[Camera]) -> Option<f64> {
    let count = scene.splats.len() + scene.meshes.iter().map(|mesh| mesh.positions().len()).sum::<usize>();
    let points = scene.splats.means().iter().chain(scene.meshes.iter().flat_map(Mesh::positions));
    let some = points.step_by(count.div_ceil(MOST).max(1));
    let centers = cameras.iter().map(Camera::center).cycle();
    median(some.zip(centers).map(|(point, center)| point.as_dvec3().distance(center)).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{render::testing::random_scene, scene::OrderMode};

    #[test]
    fn only_unusual_scenes_get_another_unit() {
        // Captures as scaled by COLMAP, a head and a ring in metres, a house in millimetres and in kilometres, a city,
        // and near planes of other programs, also of practically 0.
        for (distance, near) in [
            (5.0, 0.2),
            (0.6, 0.03),
            (0.02, 1e-3),
            (2e4, 0.2),
            (0.02, 2e-4),
            (5e3, 0.01),
            (10.0, 1e-5),
            (10.0, 1e-4),
            (500.0, 1e-6),
            (4.0, 1e-30),
        ] {
            assert_eq!(factor(distance, near), 1.0, "{distance} {near}");
        }
        for (distance, near, expected) in [
            (5e-6, 2e-7, 2_f64.powi(26)),
            (0.75, 9e-6, 512.0),
            (1e-30, 1e-31, 2_f64.powi(108)),
            (1.5 * FARTHEST, 0.2, 256.0 / FARTHEST),
            (1e30, 1e29, 2_f64.powi(-91)),
            // Depths beyond the range of keys that count from so near.
            (1e5, 1e-6, 2_f64.powi(-8)),
            (1e7, 1e-3, 2_f64.powi(-15)),
            (9e8, 0.2, 2_f64.powi(-21)),
            // Nothing is known of the size.
            (0.0, 1e-9, 1.0),
            (f64::INFINITY, 1.0, 1.0),
            (f64::NAN, 1e-9, 1.0),
        ] {
            assert_eq!(factor(distance, near), expected, "{distance} {near}");
        }
        // Beyond the limit, keys begin at about the same depth of the world as before it.
        for near in [1e-5, 0.01, 0.2] {
            let unit = factor(1.01 * FARTHEST_OF_KEYS * f64::from(near), near);
            let first = f64::from(LEAST_DEPTH).max(unit * f64::from(near)) / unit;
            assert!((1.0..3.0).contains(&(first / f64::from(near))), "{near}: {first}");
        }
    }

    #[test]
    fn a_scene_in_another_unit_is_as_large_as_it_was() {
        let (mut scene, camera) = random_scene(1, 300, 1, 1, 2, OrderMode::Stable);
        assert_eq!(Unit::of(&scene, &[camera]), Unit { factor: 1.0 });
        assert!(matches!(Unit { factor: 1.0 }.scene(&scene).unwrap(), Cow::Borrowed(_)));
        let distance = typical_distance(&scene, &[camera, camera]).unwrap();
        assert!((2.0..7.0).contains(&distance), "{distance}");
        assert_eq!(typical_distance(&scene, &[]), None);
        scene.composition.lambda = f32::INFINITY;
        let [small, back] = [2_f64.powi(-40), 2_f64.powi(40)].map(|factor| Unit { factor });
        let there = small.scene(&scene).unwrap().into_owned();
        let to_one = 2_f64.powi(48 - distance.log2().floor() as i32);
        assert_eq!(Unit::of(&there, &[small.camera(&camera)]), Unit { factor: to_one });
        let again = back.scene(&there).unwrap().into_owned();
        assert_eq!((again.splats.means(), &again.meshes), (scene.splats.means(), &scene.meshes));
        assert_eq!((again.composition, back.camera(&small.camera(&camera))), (scene.composition, camera));
        assert_eq!(small.in_world(vec![2_f32.powi(-39), 0.0]), [2.0, 0.0]);
        // Points far from all others neither change the unit nor make a scene invalid.
        let mut splats = there.splats.clone().into_arrays();
        splats.means[0] = Vec3::MAX;
        let with_outlier = HybridScene { splats: splats.check().unwrap(), ..there };
        let unit = Unit::of(&with_outlier, &[small.camera(&camera)]);
        assert!(unit.factor > 2_f64.powi(36) && unit.scene(&with_outlier).is_ok(), "{unit:?}");
    }
}
