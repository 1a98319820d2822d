use glam::{DVec3, Vec3};

use super::GeometryError;
use crate::scene::{Camera, OpticalAxes, center_and_spread};
use crate::stats::{median, quantile_box};

/// Fraction of a capture's points beyond [`Contraction::radius`] from which the capture counts as unbounded.
const BEYOND: f64 = 0.1;
/// Contraction of unbounded space into a ball (Mip-NeRF 360, Barron et al. 2022): points within `radius` of `center`
/// keep their place, all others move to within twice that radius, x → (2 − 1/|x|) x/|x| in units of it. Lengths are
/// world units.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Contraction {
    /// Common focus of the cameras.
    pub center: DVec3,
    /// Radius of the ball in which nothing changes.
    pub radius: f64,
}

impl Contraction {
    /// Least number of points for deciding whether a capture is unbounded.
    pub(crate) const LEAST_POINTS: usize = 100;

    /// Contraction around the cameras' common focus, its radius twice their least distance to it (the constants of
    /// 2DGS), or twice their median distance where that is more than twice the least: a walk may lead past the focus.
    ///
    /// # Errors
    /// Without cameras.
    pub fn around(cameras: &[Camera], points: &[Vec3]) -> Result<Self, GeometryError> {
        let inner = quantile_box(points.iter().map(|p| p.as_dvec3()), 0.25);
        let mean_center = || center_and_spread(cameras).0;
        // Axes that hardly cross leave it where the points are, or else among the cameras.
        let expected = inner.map_or_else(mean_center, |(low, high)| (low + high) / 2.0);
        let center = OpticalAxes::of(cameras).meeting_point_near(expected);
        let distances: Vec<f64> = cameras.iter().map(|c| c.center().distance(center)).collect();
        let least = distances.iter().copied().fold(f64::INFINITY, f64::min);
        let median =
            median(distances).ok_or_else(|| GeometryError::argument("cameras", "at least one camera", &"none"))?;
        let distance = if least < 0.5 * median { median } else { least };
        // A camera at the focus itself (a panorama): the points then give the scale.
        let fallback = inner.map_or(1.0, |(low, high)| (high - low).length());
        let distance = if distance > 1e-3 * fallback { distance } else { fallback.max(1e-6) };
        Ok(Self { center, radius: 2.0 * distance })
    }

    /// As [`Self::around`], if a tenth of the points or more lie beyond its radius; else `None`.
    ///
    /// # Errors
    /// Without cameras.
    pub fn if_unbounded(cameras: &[Camera], points: &[Vec3]) -> Result<Option<Self>, GeometryError> {
        let contraction = Self::around(cameras, points)?;
        let beyond = points.iter().filter(|p| p.as_dvec3().distance(contraction.center) > contraction.radius).count();
        let is_unbounded = points.len() >= Self::LEAST_POINTS && beyond as f64 >= BEYOND * points.len() as f64;
        Ok(is_unbounded.then_some(contraction))
    }

    /// Contracted position of a world point.
    #[must_use]
    pub fn contract(&self, p: DVec3) -> DVec3 {
        let x = (p - self.center) / self.radius;
        let distance = x.length();
        if distance <= 1.0 { p } else { self.center + x * (self.radius * (2.0 - 1.0 / distance) / distance) }
    }

    /// World point that contracts to `q`; not finite if there is none.
    #[must_use]
    pub fn expand(&self, q: DVec3) -> DVec3 {
        let x = (q - self.center) / self.radius;
        let distance = x.length();
        if distance <= 1.0 {
            q
        } else if distance < 2.0 {
            self.center + x * (self.radius / (distance * (2.0 - distance)))
        } else {
            DVec3::INFINITY
        }
    }

    /// Directional derivative of [`Self::contract`] at `p` along `d`.
    #[must_use]
    pub fn along(&self, p: DVec3, d: DVec3) -> DVec3 {
        let x = (p - self.center) / self.radius;
        let distance = x.length();
        if distance <= 1.0 {
            return d;
        }
        let outward = x / distance;
        let radial = outward * d.dot(outward);
        (radial / distance + (d - radial) * (2.0 - 1.0 / distance)) / distance
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const BALL: Contraction = Contraction { center: DVec3::new(1.0, -2.0, 0.5), radius: 3.0 };

    #[test]
    fn near_things_keep_their_place_and_far_ones_come_back() {
        for k in 0..200 {
            let direction =
                DVec3::new(f64::from(k % 7) - 3.0, f64::from(k % 11) - 5.0, 1.0 + f64::from(k % 3)).normalize();
            let p = BALL.center + direction * 0.07 * 1.07_f64.powi(k);
            let q = BALL.contract(p);
            let distance = p.distance(BALL.center);
            assert!(q.distance(BALL.center) < 6.0);
            assert_eq!(q == p, distance <= 3.0);
            assert!(BALL.expand(q).distance(p) < 1e-9 * distance * (1.0 + distance), "{p}");
        }
        // In units of the radius, 3: a distance of 4 contracts to 2 − 1/4.
        assert!(BALL.contract(BALL.center + DVec3::X * 12.0).distance(BALL.center + DVec3::X * 5.25) < 1e-12);
        for nowhere in [DVec3::X * 6.0, DVec3::Y * 7.0, DVec3::NAN] {
            assert!(!BALL.expand(BALL.center + nowhere).is_finite());
        }
    }

    #[test]
    fn the_derivative_is_that_of_differences() {
        for distance in [1.0, 2.9, 3.1, 10.0, 200.0] {
            let p = BALL.center + DVec3::new(2.0, -1.0, 2.0) / 3.0 * distance;
            for d in [DVec3::X, DVec3::new(2.0, -1.0, 2.0), DVec3::new(-0.3, 0.2, 0.9)] {
                let h = 1e-6 * distance;
                let differences = (BALL.contract(p + d * h) - BALL.contract(p - d * h)) / (2.0 * h);
                assert!(BALL.along(p, d).distance(differences) < 1e-8, "{distance} {d}");
            }
        }
    }
}
