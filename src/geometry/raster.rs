//! Rasterisation of triangles: pixels whose centres lie in a triangle, or which it touches.

use std::ops::Range;

use glam::{DVec2, DVec3, Vec2};

use super::bvh::closest_barycentrics;

/// Tolerance on negative weights: the centre of a pixel on an edge shared by two triangles is rounded to either side.
const ON_EDGE: f64 = 1e-12;
/// Distance, pixels, below which positions count as equal, so that rounding leaves no pixel out.
const ROUNDING: f64 = 1e-6;

/// Calls `each` with column, row and the three corner weights for every texel in `rows` whose centre lies in the
/// triangle with these UVs, edges included, in an atlas of `size` texels (width, height). A triangle without area has
/// none.
pub(super) fn texels_in(uvs: &[Vec2; 3], size: [usize; 2], rows: Range<usize>, each: impl FnMut(usize, usize, DVec3)) {
    pixels_in(&texel_positions(uvs, size), size, rows, each);
}

/// As [`texels_in`], for corners in pixels, with (0, 0) at the centre of the first.
pub(super) fn pixels_in(
    corners: &[DVec2; 3],
    size: [usize; 2],
    rows: Range<usize>,
    mut each: impl FnMut(usize, usize, DVec3),
) {
    let [a, b, c] = *corners;
    let area = (b - a).perp_dot(c - a);
    if area == 0.0 || !area.is_finite() {
        return;
    }
    for (x, y) in pixels_around(corners, 0.0, size, rows) {
        let p = DVec2::new(x as f64, y as f64);
        let (wa, wb) = ((c - b).perp_dot(p - b) / area, (a - c).perp_dot(p - c) / area);
        let weights = DVec3::new(wa, wb, 1.0 - wa - wb);
        if weights.min_element() >= -ON_EDGE {
            each(x, y, weights);
        }
    }
}

/// As [`texels_in`], for every texel that is `wanted` and that the triangle touches, with the weights of the triangle's
/// point nearest to the texel's centre; except texels of which it only cuts off a corner, closer to it than to that
/// point. A triangle without area is treated as a line.
pub(super) fn texels_touched(
    uvs: &[Vec2; 3],
    size: [usize; 2],
    rows: Range<usize>,
    wanted: impl Fn(usize, usize) -> bool,
    mut each: impl FnMut(usize, usize, DVec3),
) {
    let corners = texel_positions(uvs, size);
    let [a, b, c] = corners.map(|p| p.extend(0.0));
    for (x, y) in pixels_around(&corners, 0.5, size, rows).filter(|&(x, y)| wanted(x, y)) {
        let p = DVec3::new(x as f64, y as f64, 0.0);
        let weights = closest_barycentrics(p, [a, b, c]);
        let nearest = a * weights.x + b * weights.y + c * weights.z;
        if (nearest - p).abs().max_element() <= 0.5 {
            each(x, y, weights);
        }
    }
}

/// Columns and rows of the pixels in `rows` whose centres lie in the triangle or within `reach` of it along both axes,
/// and a few beside them: their number is bounded by the triangle's length and area, whatever its orientation.
pub(super) fn pixels_around(
    &corners: &[DVec2; 3],
    reach: f64,
    [width, height]: [usize; 2],
    rows: Range<usize>,
) -> impl Iterator<Item = (usize, usize)> {
    let reach = reach + ROUNDING;
    let range = |low: f64, high: f64, all: Range<usize>| {
        (low.ceil().max(0.0) as usize).max(all.start)..((high.floor() + 1.0).max(0.0) as usize).min(all.end)
    };
    let [low, high] = [f64::min, f64::max].map(|of| corners.into_iter().map(|p| p.y).reduce(of).unwrap_or(f64::NAN));
    range(low - reach, high + reach, rows.start..rows.end.min(height)).flat_map(move |y| {
        let (low, high) = span(&corners, y as f64 - reach, y as f64 + reach);
        range(low - reach, high + reach, 0..width).map(move |x| (x, y))
    })
}

/// Range in x of a triangle's edges between two values of y; (∞, −∞) if there are none.
fn span(corners: &[DVec2; 3], low: f64, high: f64) -> (f64, f64) {
    let mut found = (f64::INFINITY, f64::NEG_INFINITY);
    for (from, to) in [(0, 1), (1, 2), (2, 0)].map(|(i, j)| (corners[i], corners[j])) {
        let way = to - from;
        // A level edge is in between entirely or not at all.
        let [enter, leave] = match (way.y == 0.0, (low..=high).contains(&from.y)) {
            (true, true) => [0.0, 1.0],
            (true, false) => [1.0, 0.0],
            (false, _) => [low, high].map(|y| (y - from.y) / way.y),
        };
        let (enter, leave) = if way.y < 0.0 { (leave, enter) } else { (enter, leave) };
        let (enter, leave) = (enter.max(0.0), leave.min(1.0));
        if enter <= leave {
            let [a, b] = [enter, leave].map(|t| from.x + t * way.x);
            found = (found.0.min(a).min(b), found.1.max(a).max(b));
        }
    }
    found
}

/// Corner positions in texels, with (0, 0) at the centre of the first.
pub(super) fn texel_positions(uvs: &[Vec2; 3], [width, height]: [usize; 2]) -> [DVec2; 3] {
    uvs.map(|uv| uv.as_dvec2() * DVec2::new(width as f64, height as f64) - 0.5)
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg64;

    use super::*;

    /// Rectangles of two triangles whose common edge passes through pixel centres.
    #[test]
    fn centres_on_a_common_edge_are_in_one_triangle_at_least() {
        for ([width, height], x, y) in
            [([6, 3], 10, 20), ([30, 10], 7, 101), ([49, 7], 300, 3), ([33, 77], 111, 222), ([60, 36], 9, 400)]
        {
            let at = |i: usize, j: usize| Vec2::new((x + i) as f32 + 0.5, (y + j) as f32 + 0.5) / 512.0;
            let [a, b, c, d] = [at(0, 0), at(width, 0), at(width, height), at(0, height)];
            let mut times = vec![0; 512 * 512];
            for uvs in [[a, b, c], [a, c, d]] {
                texels_in(&uvs, [512; 2], 0..512, |x, y, _| times[y * 512 + x] += 1);
            }
            for (i, n) in times.into_iter().enumerate() {
                let is_in = (x..=x + width).contains(&(i % 512)) && (y..=y + height).contains(&(i / 512));
                assert_eq!(n > 0, is_in, "{width}×{height}: {}, {}", i % 512, i / 512);
            }
        }
    }

    /// A sliver covers only texels along itself, however long it is.
    #[test]
    fn pixels_around_a_triangle_are_those_in_its_box_that_are_near() {
        let mut random = Pcg64::seed_from_u64(8);
        for i in 0..200 {
            let mut point = || DVec2::new(random.random_range(-9.0..40.0), random.random_range(-9.0..40.0));
            let a = point();
            // Every other triangle is thin.
            let corners = if i % 2 == 0 { [a, point(), point()] } else { [a, point(), a + 0.02 * point()] };
            for reach in [0.0, 0.5] {
                let around: Vec<_> = pixels_around(&corners, reach, [32; 2], 3..30).collect();
                let area = (corners[1] - corners[0]).perp_dot(corners[2] - corners[0]).abs();
                let length = corners[0].distance(corners[1]) + corners[0].distance(corners[2]) + 2.0;
                assert!(around.len() as f64 <= area + 6.0 * length, "{} {area} {length}", around.len());
                let [a, b, c] = corners.map(|p| p.extend(0.0));
                for (x, y) in (3..30).flat_map(|y| (0..32).map(move |x| (x, y))) {
                    let p = DVec3::new(x as f64, y as f64, 0.0);
                    let w = closest_barycentrics(p, [a, b, c]);
                    let away = (a * w.x + b * w.y + c * w.z - p).abs().max_element();
                    assert!(away > reach - 1e-9 || around.contains(&(x, y)), "{x} {y} {reach} {corners:?}");
                }
            }
        }
    }

    #[test]
    fn what_is_thinner_than_a_texel_touches_all_texels_along_it() {
        let touched = |uvs: [[f32; 2]; 3], rows: Range<usize>| {
            let mut found = vec![];
            texels_touched(
                &uvs.map(|uv| Vec2::from(uv) / 16.0),
                [16; 2],
                rows,
                |x, y| (x, y) != (15, 0),
                |x, y, w| {
                    assert!(w.min_element() >= 0.0 && (w.element_sum() - 1.0).abs() < 1e-12);
                    found.push((x, y));
                },
            );
            found
        };
        // A thin triangle between two rows of centres, from column 2 to 12, and its degenerate form, a line.
        for last in [3.2, 3.0] {
            let found = touched([[2.0, 3.0], [12.0, 3.0], [12.0, last]], 0..16);
            assert!((2..12).all(|x| found.contains(&(x, 2)) && found.contains(&(x, 3))), "{found:?}");
            assert!(found.iter().all(|(x, y)| (1..=12).contains(x) && (2..=3).contains(y)), "{found:?}");
        }
        assert_eq!(touched([[5.5; 2]; 3], 0..16), [(5, 5)]);
        assert_eq!(touched([[14.5, 0.5], [15.5, 0.5], [15.5, 0.6]], 0..16), [(14, 0)], "the other is not wanted");
        assert!(touched([[5.5; 2]; 3], 6..16).is_empty());
        assert!(touched([[f32::NAN; 2]; 3], 0..16).is_empty() && touched([[1e30; 2]; 3], 0..16).is_empty());
        assert!(touched([[-1e30; 2]; 3], 0..16).is_empty());
    }
}
