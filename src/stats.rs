//! Medians and other quantiles, by rank: always one of the values, never a mean of two.

use glam::DVec3;

/// The value that the part `q` in 0..1 of all are below: the ⌊q·n⌋-th, counted from 0. `None` without values.
pub(crate) fn quantile(mut values: Vec<f64>, q: f64) -> Option<f64> {
    let rank = (values.len() as f64 * q) as usize;
    (rank < values.len()).then(|| *values.select_nth_unstable_by(rank, f64::total_cmp).1)
}

/// Of an even number of values the higher one in the middle. `None` without values.
pub(crate) fn median(values: Vec<f64>) -> Option<f64> {
    quantile(values, 0.5)
}

/// The element of which `of` says the median, of an even number the higher one in the middle. Those of which it says
/// the same stay in their order. `None` without elements.
pub(crate) fn median_by<T>(mut elements: Vec<T>, of: impl Fn(&T) -> f64) -> Option<T> {
    elements.sort_by(|a, b| of(a).total_cmp(&of(b)));
    let middle = elements.len() / 2;
    elements.into_iter().nth(middle)
}

/// Per axis, the `q` and 1−`q` quantiles of the finite points.
pub(crate) fn quantile_box(points: impl Iterator<Item = DVec3>, q: f64) -> Option<(DVec3, DVec3)> {
    let points: Vec<DVec3> = points.filter(|p| p.is_finite()).collect();
    let mut corners = (DVec3::ZERO, DVec3::ZERO);
    for axis in 0..3 {
        let mut values: Vec<f64> = points.iter().map(|p| p[axis]).collect();
        let skip = (values.len() as f64 * q) as usize;
        let last = values.len().checked_sub(1 + skip)?;
        values.sort_unstable_by(f64::total_cmp);
        corners.0[axis] = values[skip];
        corners.1[axis] = values[last];
    }
    Some(corners)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ranks_are_counted_from_below() {
        assert_eq!((median(vec![]), median(vec![7.0]), median(vec![3.0, 1.0])), (None, Some(7.0), Some(3.0)));
        let values: Vec<f64> = (0..100).map(|i| f64::from(i * 37 % 100)).collect();
        assert_eq!([0.0, 0.25, 0.99].map(|q| quantile(values.clone(), q)), [Some(0.0), Some(25.0), Some(99.0)]);
        assert_eq!(quantile(values, 1.0), None);
        assert_eq!(median_by(vec![(3.0, 'a'), (1.0, 'b'), (1.0, 'c'), (2.0, 'd')], |e| e.0), Some((2.0, 'd')));
        assert_eq!(median_by(vec![(1.0, 'a'), (1.0, 'b'), (0.0, 'c')], |e| e.0), Some((1.0, 'a')));
        assert_eq!(median_by(vec![], |e: &f64| *e), None);
        let points = (0..100).map(|i| DVec3::new(f64::from(i), f64::from(-i), 1.0)).chain([DVec3::NAN]);
        let expected = (DVec3::new(5.0, -94.0, 1.0), DVec3::new(94.0, -5.0, 1.0));
        assert_eq!(quantile_box(points, 0.05), Some(expected));
        assert_eq!(quantile_box([].into_iter(), 0.25), None);
    }
}
