//! The texels whose centres lie in a triangle of an atlas.

use std::ops::Range;

use glam::{DVec2, DVec3, Vec2};

/// Calls `each` with column, row and the weights of the three corners for every texel of `rows` whose centre lies in the triangle with
/// these UVs, in an atlas of `size` texels, (width, height); centres on its edges lie in it. Of one without area there are none.
pub(super) fn texels_in(
    uvs: &[Vec2; 3],
    size: [usize; 2],
    rows: Range<usize>,
    mut each: impl FnMut(usize, usize, DVec3),
) {
    let [a, b, c] = texel_positions(uvs, size);
    let area = (b - a).perp_dot(c - a);
    if area == 0.0 || !area.is_finite() {
        return;
    }
    let (low, high) = (a.min(b).min(c).floor().max(DVec2::ZERO), a.max(b).max(c).ceil().max(DVec2::ZERO));
    for y in (low.y as usize).max(rows.start)..(high.y as usize).saturating_add(1).min(rows.end).min(size[1]) {
        for x in low.x as usize..(high.x as usize).saturating_add(1).min(size[0]) {
            let p = DVec2::new(x as f64, y as f64);
            let (wa, wb) = ((c - b).perp_dot(p - b) / area, (a - c).perp_dot(p - c) / area);
            let weights = DVec3::new(wa, wb, 1.0 - wa - wb);
            if weights.min_element() >= 0.0 {
                each(x, y, weights);
            }
        }
    }
}

/// The same corners in texels, (0, 0) at the centre of the first.
pub(super) fn texel_positions(uvs: &[Vec2; 3], [width, height]: [usize; 2]) -> [DVec2; 3] {
    uvs.map(|uv| uv.as_dvec2() * DVec2::new(width as f64, height as f64) - 0.5)
}
