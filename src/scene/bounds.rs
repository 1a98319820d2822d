//! Where points are, all together.

use glam::Vec3;

/// Lower and upper corner of the box around points, in their own frame; `None` of no points.
#[must_use]
pub fn bounds(points: impl IntoIterator<Item = Vec3>) -> Option<[Vec3; 2]> {
    points.into_iter().map(|p| [p; 2]).reduce(|[low, high], [p, _]| [low.min(p), high.max(p)])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn corners_are_of_any_points() {
        assert_eq!(bounds([]), None);
        let points = [Vec3::new(1.0, -2.0, 3.0), Vec3::new(-1.0, 5.0, 0.0), Vec3::new(0.0, 0.0, 7.0)];
        assert_eq!(bounds(points), Some([Vec3::new(-1.0, -2.0, 0.0), Vec3::new(1.0, 5.0, 7.0)]));
        assert_eq!(bounds(points.into_iter().take(1)), Some([points[0]; 2]));
    }
}
