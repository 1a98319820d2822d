//! Packs charts into a square atlas: each falls onto the skyline of those before it, tallest first.

use glam::DVec2;
use rayon::prelude::*;

use super::charts::Chart;

/// Where each chart lies.
pub(super) struct Packing {
    /// Texels per world unit.
    pub(super) scale: f64,
    /// Texels kept free around each chart.
    pub(super) gutter: usize,
    /// `[charts]`.
    pub(super) places: Vec<Place>,
}

/// A chart's place: quarter turns, then shift.
#[derive(Clone, Copy, Default)]
pub(super) struct Place {
    /// Quarter turns counter-clockwise.
    turns: u8,
    /// Texels the chart covers before turning.
    size: [usize; 2],
    /// Lowest texel after turning.
    origin: [usize; 2],
}

impl Place {
    /// Atlas position in texels of a chart point given in texels from the chart's low corner.
    pub(super) fn apply(&self, p: DVec2) -> DVec2 {
        let size = DVec2::new(self.size[0] as f64, self.size[1] as f64);
        let turned = match self.turns {
            0 => p,
            1 => DVec2::new(size.y - p.y, p.x),
            2 => size - p,
            _ => DVec2::new(p.y, size.x - p.x),
        };
        turned + DVec2::new(self.origin[0] as f64, self.origin[1] as f64)
    }
}

/// Turns a chart so that its bounding rectangle is small and upright, with the low corner at the origin. Of a triangle that is longer than `longest`, and
/// no cut makes shorter, lengths shrink to that: one sliver does not take their texels from all others.
pub(super) fn straighten(chart: &mut Chart, longest: f64) {
    let bounds = |angle: f64| {
        let turn = DVec2::from_angle(angle);
        let points = chart.corners.iter().flatten().map(|&p| turn.rotate(p));
        points.fold((DVec2::INFINITY, DVec2::NEG_INFINITY), |(low, high), p| (low.min(p), high.max(p)))
    };
    let area = |angle: f64| {
        let (low, high) = bounds(angle);
        (high - low).element_product()
    };
    let angles = (0..30).map(|i| f64::from(i) * std::f64::consts::FRAC_PI_2 / 30.0);
    let mut best = angles.min_by(|&a, &b| area(a).total_cmp(&area(b))).unwrap_or(0.0);
    let (low, high) = bounds(best);
    if high.x - low.x > high.y - low.y {
        best += std::f64::consts::FRAC_PI_2;
    }
    let ((low, high), turn) = (bounds(best), DVec2::from_angle(best));
    let shrink = DVec2::new(1.0, (longest / (high.y - low.y)).min(1.0));
    for p in chart.corners.iter_mut().flatten() {
        // The maximum guards against a rounding below zero.
        *p = (turn.rotate(*p) - low).max(DVec2::ZERO) * shrink;
    }
}

/// A wider gutter is taken as long as it costs no more than this fraction of the scale that a narrower one allows.
const GUTTER_WORTH: f64 = 0.92;

/// All charts in `side`×`side` texels, at about the largest scale they fit at. Gutters are 4 texels on each side, hence
/// 8 between charts, but 2 or 1 where that would cost more than a twelfth of the resolution: maps are
/// trained through their mips, and a texel is a float that a splat could have had. `None` if the charts do not fit at any useful scale. `area` is the charts' total.
pub(super) fn pack(charts: &[Chart], area: f64, side: usize) -> Option<Packing> {
    // Scale at which the charts would fill the atlas.
    let full = side as f64 / area.sqrt();
    let order = {
        let mut order: Vec<usize> = (0..charts.len()).collect();
        let height = |c: usize| charts[c].corners.iter().flatten().map(|p| p.y).fold(0.0, f64::max);
        let heights: Vec<f64> = (0..charts.len()).map(height).collect();
        order.sort_by(|&a, &b| heights[b].total_cmp(&heights[a]).then(a.cmp(&b)));
        order
    };
    let mut chosen: Option<Packing> = None;
    for gutter in [1, 2, 4] {
        let least = chosen.as_ref().map_or(0.0, |c| GUTTER_WORTH * c.scale);
        match largest_scale(charts, &order, full, least, side, gutter) {
            Some(packing) => chosen = Some(packing),
            None => break,
        }
    }
    chosen
}

/// The largest scale with this gutter to 0.3 %, unless it is below `least` or 2 % of `full`.
fn largest_scale(
    charts: &[Chart],
    order: &[usize],
    full: f64,
    least: f64,
    side: usize,
    gutter: usize,
) -> Option<Packing> {
    let attempt = |scale: f64| try_scale(charts, order, scale, side, gutter);
    let floor = least.max(0.02 * full);
    let (mut fails, mut scale) = (full, (full * 0.9).max(floor));
    loop {
        let Some(mut places) = attempt(scale) else {
            if scale <= floor {
                return None;
            }
            fails = scale;
            scale = (scale * 0.85).max(floor);
            continue;
        };
        for _ in 0..6 {
            let middle = (scale + fails) / 2.0;
            match attempt(middle) {
                Some(better) => (scale, places) = (middle, better),
                None => fails = middle,
            }
        }
        return Some(Packing { scale, gutter, places });
    }
}

/// The outline of a chart in one orientation: per column the lowest and the highest covered row, with the gutter.
#[derive(Clone, Default)]
struct Outline {
    low: Vec<usize>,
    high: Vec<usize>,
}

impl Outline {
    /// A chart of separate parts may leave columns empty: they take no room, as high as the nearest one before them, or else after.
    fn close(&mut self) {
        let mut last = self.low.iter().copied().find(|low| *low != usize::MAX).unwrap_or(0);
        for (low, high) in self.low.iter_mut().zip(&mut self.high) {
            if *low == usize::MAX {
                (*low, *high) = (last, last);
            }
            last = *low;
        }
    }

    fn height(&self) -> usize {
        self.high.iter().copied().max().unwrap_or(0)
    }

    /// Grows by `gutter` texels on all sides; the origin moves by `gutter` both ways.
    fn with_gutter(&self, gutter: usize) -> Self {
        let columns = self.low.len();
        let near = |i: usize| i.saturating_sub(2 * gutter)..(i + 1).min(columns);
        let grown = 0..columns + 2 * gutter;
        Self {
            low: grown.clone().map(|i| self.low[near(i)].iter().copied().min().unwrap_or(0)).collect(),
            high: grown.map(|i| self.high[near(i)].iter().copied().max().unwrap_or(0) + 2 * gutter).collect(),
        }
    }
}

/// Size in texels and the outlines after 0 to 3 quarter turns.
struct Footprint {
    size: [usize; 2],
    outlines: [Outline; 4],
}

fn footprint(chart: &Chart, scale: f64, side: usize, gutter: usize) -> Option<Footprint> {
    let high = chart.corners.iter().flatten().fold(DVec2::ZERO, |high, &p| high.max(p)) * scale;
    if high.max_element() + 2.0 * gutter as f64 > side as f64 {
        return None;
    }
    let size = [high.x, high.y].map(|h| (h.ceil() as usize).max(1));
    let [mut columns, mut rows] = size.map(|n| Outline { low: vec![usize::MAX; n], high: vec![0; n] });
    for t in &chart.corners {
        for k in 0..3 {
            let (a, b) = (t[k] * scale, t[(k + 1) % 3] * scale);
            outline_edge(&mut columns, a, b);
            outline_edge(&mut rows, DVec2::new(a.y, a.x), DVec2::new(b.y, b.x));
        }
    }
    [&mut columns, &mut rows].into_iter().for_each(Outline::close);
    let [w, h] = size;
    let turned = |o: &Outline, reverse: bool, flip: Option<usize>| {
        let mut o = match flip {
            None => o.clone(),
            Some(n) => {
                let flip = |v: &usize| n.saturating_sub(*v);
                Outline { low: o.high.iter().map(flip).collect(), high: o.low.iter().map(flip).collect() }
            }
        };
        if reverse {
            o.low.reverse();
            o.high.reverse();
        }
        o.with_gutter(gutter)
    };
    let outlines = [
        turned(&columns, false, None),
        turned(&rows, true, None),
        turned(&columns, true, Some(h)),
        turned(&rows, false, Some(w)),
    ];
    Some(Footprint { size, outlines })
}

/// Widens the outline by an edge, per column by the rows that the edge passes there.
fn outline_edge(outline: &mut Outline, a: DVec2, b: DVec2) {
    let (a, b) = if a.x <= b.x { (a, b) } else { (b, a) };
    let last = outline.low.len() - 1;
    let slope = if b.x > a.x { (b.y - a.y) / (b.x - a.x) } else { 0.0 };
    let (low, high) = (a.y.min(b.y), a.y.max(b.y));
    for column in (a.x as usize).min(last)..=(b.x as usize).min(last) {
        let at = |x: f64| (a.y + (x - a.x) * slope).clamp(low, high);
        let (mut from, mut to) = (at((column as f64).max(a.x)), at((column as f64 + 1.0).min(b.x)));
        if a.x == b.x {
            (from, to) = (low, high);
        }
        outline.low[column] = outline.low[column].min(from.min(to) as usize);
        outline.high[column] = outline.high[column].max(from.max(to).ceil().max(1.0) as usize);
    }
}

fn try_scale(charts: &[Chart], order: &[usize], scale: f64, side: usize, gutter: usize) -> Option<Vec<Place>> {
    let footprints: Vec<Footprint> =
        charts.par_iter().map(|c| footprint(c, scale, side, gutter)).collect::<Option<_>>()?;
    let covered: usize = footprints
        .iter()
        .map(|f| f.outlines[0].high.iter().zip(&f.outlines[0].low).map(|(h, l)| h - l).sum::<usize>())
        .sum();
    if covered > side * side {
        return None;
    }
    let mut skyline = vec![0; side];
    let mut places = vec![Place::default(); charts.len()];
    for &chart in order {
        let Footprint { size, outlines } = &footprints[chart];
        let mut best: Option<(usize, usize, usize, usize)> = None;
        for (turns, outline) in outlines.iter().enumerate() {
            let Some((top, waste, x)) = drop_onto(&skyline, outline) else { continue };
            if best.is_none_or(|b| (top, waste) < (b.0, b.1)) {
                best = Some((top, waste, x, turns));
            }
        }
        let (top, _, x, turns) = best.filter(|b| b.0 <= side)?;
        let outline = &outlines[turns];
        let y = top - outline.height();
        for (column, high) in skyline[x..].iter_mut().zip(&outline.high) {
            *column = y + high;
        }
        places[chart] = Place { turns: turns as u8, size: *size, origin: [x + gutter, y + gutter] };
    }
    Some(places)
}

/// Lowest resting place on the skyline: (top, texels lost below, first column).
fn drop_onto(skyline: &[usize], outline: &Outline) -> Option<(usize, usize, usize)> {
    let height = outline.height();
    let mut best: Option<(usize, usize, usize)> = None;
    for x in 0..=skyline.len().checked_sub(outline.low.len())? {
        let limit = best.map_or(usize::MAX, |b| b.0 - height);
        let mut y = 0;
        for (&ground, &low) in skyline[x..].iter().zip(&outline.low) {
            y = y.max(ground.saturating_sub(low));
            if y > limit {
                break;
            }
        }
        if y > limit {
            continue;
        }
        let waste = skyline[x..].iter().zip(&outline.low).map(|(&ground, &low)| (y + low).saturating_sub(ground)).sum();
        if best.is_none_or(|b| (y + height, waste) < (b.0, b.1)) {
            best = Some((y + height, waste, x));
        }
    }
    best
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What is left of a chart that was split may have gaps as wide as others are.
    #[test]
    fn charts_in_parts_do_not_lie_on_others() {
        let triangle = |x: f64, y: f64, side: f64| [DVec2::new(x, y), DVec2::new(x + side, y), DVec2::new(x, y + side)];
        for gap in [6.0, 30.0] {
            // The parts of a chart beside, and then also above each other; its first columns may be empty.
            let in_parts = |i: usize| {
                let shift = if i.is_multiple_of(3) { 4.0 } else { 0.0 };
                let corners = vec![triangle(shift, 0.0, 3.0), triangle(shift + gap, 0.3 * gap, 4.0)];
                Chart { faces: vec![0, 1], corners }
            };
            let whole = |i: usize| Chart { faces: vec![0], corners: vec![triangle(0.0, 0.0, 2.0 + 0.1 * i as f64)] };
            let charts: Vec<Chart> = (0..20).map(in_parts).chain((0..30).map(whole)).collect();
            let corners = charts.iter().flat_map(|c| &c.corners);
            let area = corners.map(|[a, b, c]| (b - a).perp_dot(c - a) / 2.0).sum();
            let side = 256;
            let packing = pack(&charts, area, side).unwrap();
            let mut taken = vec![false; side * side];
            for (chart, place) in charts.iter().zip(&packing.places) {
                for corners in &chart.corners {
                    let [a, b, c] = corners.map(|p| place.apply(p * packing.scale));
                    let (low, high) = (a.min(b).min(c), a.max(b).max(c));
                    assert!(low.min_element() >= 0.0 && high.max_element() <= side as f64);
                    for y in low.y as usize..=(high.y as usize).min(side - 1) {
                        for x in low.x as usize..=(high.x as usize).min(side - 1) {
                            let p = DVec2::new(x as f64 + 0.5, y as f64 + 0.5);
                            let inside = |s: DVec2, e: DVec2| (e - s).perp_dot(p - s) > 0.0;
                            if inside(a, b) && inside(b, c) && inside(c, a) {
                                assert!(!std::mem::replace(&mut taken[y * side + x], true), "{gap}: {x} {y}");
                            }
                        }
                    }
                }
            }
        }
    }
}
