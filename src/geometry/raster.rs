//! The texels of an atlas that belong to a triangle: those whose centres lie in it, or those that it touches.

use std::ops::Range;

use glam::{DVec2, DVec3, Vec2};

use super::bvh::closest_barycentrics;

/// A weight may be so far below 0: of a centre on an edge that two triangles share it is rounded to either side.
const ON_EDGE: f64 = 1e-12;

/// Calls `each` with column, row and the weights of the three corners for every texel of `rows` whose centre lies in the triangle with
/// these UVs, in an atlas of `size` texels, (width, height); centres on its edges lie in it. Of one without area there are none.
pub(super) fn texels_in(
    uvs: &[Vec2; 3],
    size: [usize; 2],
    rows: Range<usize>,
    mut each: impl FnMut(usize, usize, DVec3),
) {
    let corners @ [a, b, c] = texel_positions(uvs, size);
    let area = (b - a).perp_dot(c - a);
    if area == 0.0 || !area.is_finite() {
        return;
    }
    for (x, y) in texels_around(&corners, 0.0, size, rows) {
        let p = DVec2::new(x as f64, y as f64);
        let (wa, wb) = ((c - b).perp_dot(p - b) / area, (a - c).perp_dot(p - c) / area);
        let weights = DVec3::new(wa, wb, 1.0 - wa - wb);
        if weights.min_element() >= -ON_EDGE {
            each(x, y, weights);
        }
    }
}

/// The same for every texel whose centre's nearest point of the triangle lies in the texel, with the weights of that point: those that it
/// touches, but for some of which it cuts off a corner. What has no area is the line that it is.
pub(super) fn texels_touched(
    uvs: &[Vec2; 3],
    size: [usize; 2],
    rows: Range<usize>,
    mut each: impl FnMut(usize, usize, DVec3),
) {
    let corners = texel_positions(uvs, size);
    let [a, b, c] = corners.map(|p| p.extend(0.0));
    for (x, y) in texels_around(&corners, 0.5, size, rows) {
        let p = DVec3::new(x as f64, y as f64, 0.0);
        let weights = closest_barycentrics(p, [a, b, c]);
        let nearest = a * weights.x + b * weights.y + c * weights.z;
        if (nearest - p).abs().max_element() <= 0.5 {
            each(x, y, weights);
        }
    }
}

/// Columns and rows of the texels of `rows` whose centres are in the box around a triangle, or no farther from it than `reach`.
fn texels_around(
    [a, b, c]: &[DVec2; 3],
    reach: f64,
    size: [usize; 2],
    rows: Range<usize>,
) -> impl Iterator<Item = (usize, usize)> {
    let (low, high) = (a.min(*b).min(*c) - reach, a.max(*b).max(*c) + reach);
    let range = |low: f64, high: f64, all: Range<usize>| {
        (low.ceil().max(0.0) as usize).max(all.start)..((high.floor() + 1.0).max(0.0) as usize).min(all.end)
    };
    let columns = range(low.x, high.x, 0..size[0]);
    range(low.y, high.y, rows.start..rows.end.min(size[1])).flat_map(move |y| columns.clone().map(move |x| (x, y)))
}

/// The same corners in texels, (0, 0) at the centre of the first.
pub(super) fn texel_positions(uvs: &[Vec2; 3], [width, height]: [usize; 2]) -> [DVec2; 3] {
    uvs.map(|uv| uv.as_dvec2() * DVec2::new(width as f64, height as f64) - 0.5)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The square of a few texels in two triangles whose common edge passes through centres.
    #[test]
    fn centres_on_a_common_edge_are_in_one_triangle_at_least() {
        for n in 1..200_usize {
            let at = |x: f32, y: f32| Vec2::new(x, y) / n as f32;
            let (low, high) = (0.5, n as f32 - 0.5);
            let [a, b, c, d] = [at(low, low), at(high, low), at(high, high), at(low, high)];
            let mut times = vec![0; n * n];
            for uvs in [[a, b, c], [a, c, d]] {
                texels_in(&uvs, [n, n], 0..n, |x, y, _| times[y * n + x] += 1);
            }
            // f32 UVs may leave the outermost centres outside.
            let inner = (0..n * n).filter(|i| (1..n - 1).contains(&(i % n)) && (1..n.max(2) - 1).contains(&(i / n)));
            inner.for_each(|i| assert!(times[i] >= 1, "{n}: {}, {}", i % n, i / n));
        }
    }

    #[test]
    fn what_is_thinner_than_a_texel_touches_all_texels_along_it() {
        let touched = |uvs: [[f32; 2]; 3], rows: Range<usize>| {
            let mut found = vec![];
            texels_touched(&uvs.map(|uv| Vec2::from(uv) / 16.0), [16; 2], rows, |x, y, w| {
                assert!(w.min_element() >= 0.0 && (w.element_sum() - 1.0).abs() < 1e-12);
                found.push((x, y));
            });
            found
        };
        // Between two rows of centres, from column 2 to 12, and a line of it.
        for last in [3.2, 3.0] {
            let found = touched([[2.0, 3.0], [12.0, 3.0], [12.0, last]], 0..16);
            assert!((2..12).all(|x| found.contains(&(x, 2)) && found.contains(&(x, 3))), "{found:?}");
            assert!(found.iter().all(|(x, y)| (1..=12).contains(x) && (2..=3).contains(y)), "{found:?}");
        }
        assert_eq!(touched([[5.5; 2]; 3], 0..16), [(5, 5)]);
        assert!(touched([[5.5; 2]; 3], 6..16).is_empty());
        assert!(touched([[f32::NAN; 2]; 3], 0..16).is_empty() && touched([[1e30; 2]; 3], 0..16).is_empty());
        assert!(touched([[-1e30; 2]; 3], 0..16).is_empty());
    }
}
