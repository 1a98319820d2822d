//! What the rows of splats hold that the splats do not: normals, and digits of positions.

use glam::Vec3;

use super::layout::NORMALS;
use super::table::{Column, Element};
use crate::format::attribute::Scalar;
use crate::scene::bounds;

const POSITION: [&str; 3] = ["x", "y", "z"];

/// What was found in rows.
pub(super) struct Audit {
    normals: Vec<Column>,
    /// Positions, if any of them is in double precision.
    positions: Vec<Column>,
    has_normals: bool,
    /// Largest difference of a coordinate from its value in single precision.
    rounding: f64,
}

impl Audit {
    /// Audit of no rows.
    pub(super) fn of(vertex: &Element) -> Self {
        let columns =
            |names: [&str; 3]| -> Vec<Column> { names.iter().filter_map(|name| vertex.column(name)).collect() };
        let is_double =
            vertex.scalar_properties().any(|(_, name, kind)| POSITION.contains(&name) && kind == Scalar::F64);
        let positions = if is_double { columns(POSITION) } else { vec![] };
        Self { normals: columns(NORMALS), positions, has_normals: false, rounding: 0.0 }
    }

    pub(super) fn look(&mut self, row: &[u8]) {
        self.has_normals = self.has_normals || self.normals.iter().any(|column| column.f64(row) != 0.0);
        let error = |column: &Column| (column.f64(row) - f64::from(column.f32(row))).abs();
        self.rounding = self.positions.iter().map(error).fold(self.rounding, f64::max);
    }

    /// Notes on non-zero normals, and on rounding by more than a millionth of the scene's size, which follows from the
    /// `means` of its splats.
    pub(super) fn notes(&self, means: &[Vec3]) -> Vec<String> {
        let by = self.rounding;
        let normals = self.has_normals.then(|| "nx, ny, nz: normals are left out".to_owned());
        let rounding = (by > 1e-6 * diagonal(means))
            .then(|| format!("double-precision positions are rounded to single precision, by {by:.1e} at most"));
        normals.into_iter().chain(rounding).collect()
    }
}

/// Diagonal of the box around points; 0 of none.
fn diagonal(points: &[Vec3]) -> f64 {
    bounds(points.iter().copied()).map_or(0.0, |[low, high]| (high.as_dvec3() - low.as_dvec3()).length())
}
