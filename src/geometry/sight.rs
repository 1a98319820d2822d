//! Who looks at a scene, and what is in the way to a point of it.

use glam::{DVec2, DVec3};

use super::bvh::{Hit, MeshBvh};
use crate::scene::Camera;

/// Who looks, and how far through.
#[derive(Clone, Copy)]
pub struct Viewers<'a> {
    /// Cameras in the mesh's frame, of pictures at the size at which they are rendered.
    pub cameras: &'a [Camera],
    /// What is no farther than this, in camera-space z, is not drawn and hides nothing; ≥ 0.
    pub near: f64,
    /// Triangles that a pixel shows, nearest first, at least 1: what as many others hide is not seen.
    pub layers: usize,
    /// Whether the picture of a camera, by its index, says anything at a continuous pixel position inside it, as not
    /// where it is masked.
    pub shows: &'a (dyn Fn(usize, DVec2) -> bool + Sync),
}

/// What [`Viewers::shows`] is of whole pictures.
const EVERYWHERE: &(dyn Fn(usize, DVec2) -> bool + Sync) = &|_, _| true;

impl<'a> Viewers<'a> {
    /// Whose pictures say something everywhere.
    #[must_use]
    pub fn unmasked(cameras: &'a [Camera], near: f64, layers: usize) -> Self {
        Self { cameras, near, layers, shows: EVERYWHERE }
    }

    /// The way on which a camera, by its index, looks at a point in world space. `None` if that is not in its picture,
    /// no farther than `near`, or where the picture says nothing.
    ///
    /// # Panics
    /// If there is no such camera.
    #[must_use]
    pub fn sight(&self, view: usize, point: DVec3) -> Option<Sight> {
        let camera = &self.cameras[view];
        let p = camera.to_camera(point);
        let at = camera.in_picture(p).filter(|_| p.z > self.near)?;
        (self.shows)(view, at).then(|| Sight::new(camera, point, p, self.near))
    }
}

/// The way from a camera to a point, and on behind it: parts of the way are 0 at the camera's centre and 1 at the
/// point. What is no farther than the near plane is not drawn, and not in the way.
#[derive(Clone, Copy, Debug)]
pub struct Sight {
    /// The point in camera space.
    pub(super) in_camera: DVec3,
    /// From the camera's centre to the point, world space.
    pub(super) way: DVec3,
    /// The camera's centre, world space.
    eye: DVec3,
    /// Part of the way up to the near plane.
    near: f64,
}

impl Sight {
    /// To a point in world space, be it in the camera's picture or not. What is no farther than `near`, in camera-space
    /// z, is not drawn.
    #[must_use]
    pub fn to(camera: &Camera, point: DVec3, near: f64) -> Self {
        Self::new(camera, point, camera.to_camera(point), near)
    }

    fn new(camera: &Camera, point: DVec3, in_camera: DVec3, near: f64) -> Self {
        let eye = camera.center();
        Self { in_camera, way: point - eye, eye, near: near / in_camera.z }
    }

    /// Whether fewer than `layers` triangles are before the point. Those in the last part `same_place` of the way are
    /// where it is.
    #[must_use]
    pub fn is_clear(&self, triangles: &MeshBvh, layers: usize, same_place: f64) -> bool {
        !triangles.has_layers(layers, self.eye, self.way, self.near, 1.0 - same_place)
    }

    /// The triangles before the point, nearest first, but for those in the last part `same_place` of the way.
    pub fn hits_before(&self, triangles: &MeshBvh, same_place: f64) -> impl Iterator<Item = Hit> + use<> {
        let near = self.near;
        let hits = triangles.hits_before(self.eye, self.way, 1.0 - same_place);
        hits.into_iter().filter(move |hit| hit.t >= near)
    }

    /// Whether there is a triangle between these parts of the way; above 1 it is behind the point.
    #[must_use]
    pub fn has_hit(&self, triangles: &MeshBvh, from: f64, to: f64) -> bool {
        triangles.any_hit(self.eye, self.way, from.max(self.near), to)
    }
}

#[cfg(test)]
mod tests {
    use glam::Vec3;

    use super::*;
    use crate::scene::testing::ahead;

    /// A camera at (1, 0, 0) that looks along z.
    fn camera() -> Camera {
        ahead([100, 100], 50.0, DVec3::X)
    }

    /// Triangles across z at these depths, around the axis of [`camera`].
    fn walls<const N: usize>(depths: [f32; N]) -> MeshBvh {
        let corners = |z: f32| [[-8.0, -9.0, z], [10.0, -9.0, z], [1.0, 9.0, z]].map(Vec3::from);
        let positions = depths.map(corners).concat();
        let triangles: Vec<[u32; 3]> = (0..N as u32).map(|i| [3 * i, 3 * i + 1, 3 * i + 2]).collect();
        MeshBvh::new([(positions.as_slice(), triangles.as_slice())])
    }

    #[test]
    fn points_are_looked_at_where_pictures_show_them() {
        let cameras = [camera(), camera()];
        let is_left = |view: usize, at: DVec2| view == 0 || at.x < 50.0;
        let masked = Viewers { shows: &is_left, ..Viewers::unmasked(&cameras, 2.0, 1) };
        let sees = |view: usize, x: f64, z: f64| masked.sight(view, DVec3::new(x, 0.0, z)).is_some();
        // In the picture, outside it, in front of the near plane, on the near plane, behind the camera.
        let points = [(1.5, 3.0), (9.0, 3.0), (1.5, 1.9), (1.5, 2.0), (1.5, -3.0)];
        assert_eq!(points.map(|(x, z)| sees(0, x, z)), [true, false, false, false, false]);
        assert_eq!([sees(1, 1.5, 3.0), sees(1, 0.5, 3.0)], [false, true]);
        assert!(Viewers { near: 1.5, ..masked }.sight(0, DVec3::new(1.5, 0.0, 1.9)).is_some());
    }

    #[test]
    fn what_is_before_a_point_is_in_the_way_from_the_near_plane_on() {
        let walls = walls([1.0, 2.0, 3.0, 4.0, 6.0]);
        let cameras = [camera()];
        let found = |near: f64, layers: usize, same_place: f64| {
            let sight = Viewers::unmasked(&cameras, near, 1).sight(0, DVec3::new(1.25, 0.0, 4.0)).unwrap();
            let depths: Vec<f64> =
                sight.hits_before(&walls, same_place).map(|hit| (4e3 * hit.t).round() / 1e3).collect();
            (sight.is_clear(&walls, layers, same_place), depths)
        };
        assert_eq!(found(0.5, 3, 1e-6), (false, vec![1.0, 2.0, 3.0]));
        assert_eq!(found(0.5, 4, 1e-6), (true, vec![1.0, 2.0, 3.0]));
        assert_eq!(found(1.5, 3, 1e-6), (true, vec![2.0, 3.0]));
        // Hits in the last three tenths of the way count as the point itself.
        assert_eq!(found(1.5, 2, 0.3), (true, vec![2.0]));
        assert_eq!(found(3.5, 1, 1e-6), (true, vec![]));
    }

    #[test]
    fn parts_of_the_way_reach_behind_the_point() {
        let walls = walls([1.0, 3.0]);
        let sight = |near: f64| Sight::to(&camera(), DVec3::new(1.0, 0.5, 2.0), near);
        assert!(sight(0.1).has_hit(&walls, 0.0, 1.0) && sight(0.1).has_hit(&walls, 1.0, 2.0));
        assert!(!sight(0.1).has_hit(&walls, 0.6, 1.4) && !sight(0.1).has_hit(&walls, 1.6, f64::INFINITY));
        // Surfaces in front of the near plane are not hit, wherever the point is.
        assert!(!sight(1.5).has_hit(&walls, 0.0, 1.0) && sight(1.5).has_hit(&walls, 0.0, 2.0));
        assert!(!sight(3.5).has_hit(&walls, 0.0, f64::INFINITY));
    }
}
