//! Geometry of a splat, and the order of its parameters in the rows of the geometry buffers.

use glam::{Quat, Vec3};

/// Floats of a splat's geometry.
pub const GEOMETRY_FLOATS: usize = 12;
/// Column of the opacity logit in a row of geometry.
pub(super) const OPACITY: usize = 3;

/// Raw, unconstrained geometry of a splat.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Geometry {
    /// Position, world units.
    pub mean: Vec3,
    /// Opacity before the sigmoid.
    pub opacity_logit: f32,
    /// Rotation from the splat's own axes to those of the world, not normalised.
    pub rotation: Quat,
    /// Logarithms of the standard deviations along the splat's own axes, world units.
    pub log_scale: Vec3,
    /// Standard deviation of the Gaussian that the splat is smoothed with while training (`filter_splats.wgsl`), world
    /// units; 0 for none.
    pub smoothing: f32,
}

impl Geometry {
    /// Geometry from a row: mean x, y, z; opacity logit; quaternion w, x, y, z; log-scale x, y, z; smoothing.
    #[must_use]
    pub fn from_row(row: &[f32; GEOMETRY_FLOATS]) -> Self {
        let [x, y, z, opacity_logit, qw, qx, qy, qz, sx, sy, sz, smoothing] = *row;
        Self {
            mean: Vec3::new(x, y, z),
            opacity_logit,
            rotation: Quat::from_xyzw(qx, qy, qz, qw),
            log_scale: Vec3::new(sx, sy, sz),
            smoothing,
        }
    }

    /// Row of this geometry; that of [`Self::from_row`] to the last bit.
    #[must_use]
    pub fn to_row(self) -> [f32; GEOMETRY_FLOATS] {
        let Self { mean: m, opacity_logit, rotation: q, log_scale: s, smoothing } = self;
        [m.x, m.y, m.z, opacity_logit, q.w, q.x, q.y, q.z, s.x, s.y, s.z, smoothing]
    }

    /// Geometry of the splats of these rows, `[N·12]`.
    pub fn of_rows(rows: &[f32]) -> impl Iterator<Item = Self> {
        rows.as_chunks::<GEOMETRY_FLOATS>().0.iter().map(Self::from_row)
    }

    /// Geometry of splat `i` of these rows, `[N·12]`.
    ///
    /// # Panics
    /// If `i` is out of range.
    pub(crate) fn at(rows: &[f32], i: usize) -> Self {
        Self::from_row(&rows.as_chunks::<GEOMETRY_FLOATS>().0[i])
    }

    /// Applies `change` to splat `i` of these rows, `[N·12]`.
    ///
    /// # Panics
    /// If `i` is out of range.
    pub(crate) fn edit(rows: &mut [f32], i: usize, change: impl FnOnce(&mut Self)) {
        let row = &mut rows.as_chunks_mut::<GEOMETRY_FLOATS>().0[i];
        let mut geometry = Self::from_row(row);
        change(&mut geometry);
        *row = geometry.to_row();
    }
}

/// Name of the parameters in a column of rows of geometry.
pub(super) fn group_of(column: usize) -> &'static str {
    match column {
        0..3 => "means",
        OPACITY => "opacity logits",
        4..8 => "rotations",
        8..11 => "log-scales",
        _ => "smoothing",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_are_read_and_written_in_one_order() {
        let row: [f32; GEOMETRY_FLOATS] = std::array::from_fn(|i| i as f32);
        let geometry = Geometry {
            mean: Vec3::new(0.0, 1.0, 2.0),
            opacity_logit: 3.0,
            rotation: Quat::from_xyzw(5.0, 6.0, 7.0, 4.0),
            log_scale: Vec3::new(8.0, 9.0, 10.0),
            smoothing: 11.0,
        };
        assert_eq!((Geometry::from_row(&row), geometry.to_row()), (geometry, row));
        assert_eq!(row[OPACITY], geometry.opacity_logit);
        let first_of = [(0, "means"), (3, "opacity logits"), (4, "rotations"), (8, "log-scales"), (11, "smoothing")];
        for column in 0..GEOMETRY_FLOATS {
            let expected = first_of.iter().rfind(|(first, _)| *first <= column).map(|(_, group)| *group);
            assert_eq!(Some(group_of(column)), expected, "column {column}");
        }
    }

    /// What is not changed keeps every bit: −0, a NaN's payload, a subnormal number.
    #[test]
    fn an_edit_changes_nothing_else() {
        let bits = [0x8000_0000, 0x7fc0_1234, 1, 0xff80_0000];
        let before: Vec<f32> = (0..2 * GEOMETRY_FLOATS).map(|i| f32::from_bits(bits[i % 4])).collect();
        let mut after = before.clone();
        Geometry::edit(&mut after, 1, |_| {});
        let to_bits = |rows: &[f32]| rows.iter().map(|v| v.to_bits()).collect::<Vec<_>>();
        assert_eq!(to_bits(&after), to_bits(&before));
        Geometry::edit(&mut after, 1, |g| g.smoothing = 0.5);
        let at = 2 * GEOMETRY_FLOATS - 1;
        assert_eq!((after[at], Geometry::at(&after, 1).smoothing), (0.5, 0.5));
        assert_eq!(to_bits(&after[..at]), to_bits(&before[..at]));
        assert_eq!(Geometry::of_rows(&after).count(), 2);
    }
}
