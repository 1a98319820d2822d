//! Geometry common to posed views: camera centres, viewing directions, up direction.

use glam::{DMat3, DVec3};

use super::PathError;
use crate::scene::{Camera, OpticalAxes};

/// Cosine of the angle between up and the best-fit plane's normal, at or below which the orbit is level instead.
const STEEPEST: f64 = std::f64::consts::FRAC_1_SQRT_2;

/// Least variance of the camera centres along the second axis of their best-fit plane, relative to the largest
/// variance.
const LEAST_WIDTH: f64 = 1e-4;

pub(super) struct Rig {
    pub(super) centers: Vec<DVec3>,
    forwards: Vec<DVec3>,
    axes: OpticalAxes,
    /// Up direction, of unit length.
    pub(super) up: DVec3,
}

impl Rig {
    /// # Errors
    /// If there are no views.
    pub(super) fn of(views: &[Camera]) -> Result<Self, PathError> {
        let row = |i: usize| move |view: &Camera| view.rotation().row(i);
        let centers: Vec<DVec3> = views.iter().map(Camera::center).collect();
        let forwards: Vec<DVec3> = views.iter().map(row(2)).collect();
        let first_up = -row(1)(views.first().ok_or(PathError::TooFew { expected: 1, found: 0 })?);
        let sum: DVec3 = views.iter().map(|view| -row(1)(view)).sum();
        // Equally many upright and inverted views have no mean up direction.
        let up = if sum.length() > 0.01 * views.len() as f64 { sum.normalize() } else { first_up };
        Ok(Self { centers, forwards, axes: OpticalAxes::of(views), up })
    }

    /// Least-squares nearest point to all optical axes; an error unless it lies in front of most views.
    pub(super) fn focus(&self) -> Result<DVec3, PathError> {
        let focus = self.axes.meeting_point().ok_or(PathError::NoFocus)?;
        let in_front = self.centers.iter().zip(&self.forwards).filter(|(c, d)| (focus - **c).dot(**d) > 0.0).count();
        if 2 * in_front <= self.centers.len() {
            return Err(PathError::Outwards);
        }
        Ok(focus)
    }

    /// Axis of the orbit: the normal of the best-fit plane of the camera centres, oriented upwards; or up itself where
    /// the centres are nearly collinear or the plane is more than 45° from level.
    pub(super) fn orbit_axis(&self) -> DVec3 {
        let mean = self.centers.iter().sum::<DVec3>() / self.centers.len() as f64;
        let mut covariance = DMat3::ZERO;
        for v in self.centers.iter().map(|&c| c - mean) {
            covariance += DMat3::from_cols(v * v.x, v * v.y, v * v.z);
        }
        let (values, vectors) = symmetric_eigen(covariance);
        let normal = vectors[0];
        let along = normal.dot(self.up);
        let is_plane = values[1] > LEAST_WIDTH * values[2];
        if is_plane && along.abs() > STEEPEST { normal * along.signum() } else { self.up }
    }
}

/// Eigenvalues of a symmetric matrix, ascending, and its unit eigenvectors, by Jacobi rotations.
pub(super) fn symmetric_eigen(matrix: DMat3) -> ([f64; 3], [DVec3; 3]) {
    let mut a = matrix.transpose().to_cols_array_2d();
    let mut vectors = [DVec3::X, DVec3::Y, DVec3::Z];
    // Quadratic convergence: three or four sweeps reach machine precision.
    for _ in 0..16 {
        for (p, q) in [(0, 1), (0, 2), (1, 2)] {
            if a[p][q] == 0.0 {
                continue;
            }
            let (sin, cos) = (0.5 * (2.0 * a[p][q]).atan2(a[q][q] - a[p][p])).sin_cos();
            for row in &mut a {
                (row[p], row[q]) = (cos * row[p] - sin * row[q], sin * row[p] + cos * row[q]);
            }
            let (of_p, of_q) = (a[p], a[q]);
            for i in 0..3 {
                (a[p][i], a[q][i]) = (cos * of_p[i] - sin * of_q[i], sin * of_p[i] + cos * of_q[i]);
            }
            (vectors[p], vectors[q]) = (vectors[p] * cos - vectors[q] * sin, vectors[p] * sin + vectors[q] * cos);
        }
    }
    let mut order = [0, 1, 2];
    order.sort_by(|&i, &j| a[i][i].total_cmp(&a[j][j]));
    (order.map(|i| a[i][i]), order.map(|i| vectors[i]))
}
