//! Where cameras are, all together.

use glam::DVec3;

use super::Camera;

/// Mean of the centres of cameras in world space, and how far the farthest is from it in world units; zeros without
/// cameras.
#[must_use]
pub fn center_and_spread<'a>(cameras: impl IntoIterator<Item = &'a Camera>) -> (DVec3, f64) {
    let centers: Vec<DVec3> = cameras.into_iter().map(Camera::center).collect();
    let mean = centers.iter().sum::<DVec3>() / centers.len().max(1) as f64;
    (mean, centers.iter().map(|center| center.distance(mean)).fold(0.0, f64::max))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::testing::ahead;

    #[test]
    fn the_farthest_says_how_far_cameras_spread() {
        let cameras = [0.0, 1.0, 5.0].map(|x: f64| ahead([4, 3], 2.0, DVec3::new(x, -2.0, 0.0)));
        assert_eq!(center_and_spread(&cameras), (DVec3::new(2.0, -2.0, 0.0), 3.0));
        assert_eq!(center_and_spread(&cameras[2..]), (DVec3::new(5.0, -2.0, 0.0), 0.0));
        assert_eq!(center_and_spread(&[]), (DVec3::ZERO, 0.0));
    }
}
