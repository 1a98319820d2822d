//! Packing of charts into a square atlas: each is placed as low as possible among those before it, including in the
//! gaps they leave.

use std::{cmp::Reverse, f64::consts::FRAC_PI_2, ops::Range};

use glam::DVec2;
use rayon::prelude::*;

use super::{charts::Chart, raster::pixels_around};

/// Scale, gutter and placement of all charts.
pub(super) struct Packing {
    /// Texels per world unit.
    pub(super) scale: f64,
    /// Texels kept free around each chart; 0 for only as many as keep bilinear samples of one chart from reading
    /// another.
    pub(super) gutter: usize,
    /// Placements, `[charts]`.
    pub(super) places: Vec<Place>,
}

/// Placement of a chart: rotation, then shift.
#[derive(Clone, Copy, Default)]
pub(super) struct Place {
    turn: DVec2,
    /// Shift, texels.
    shift: DVec2,
}

impl Place {
    /// Atlas position in texels of a chart point given in texels from the chart's low corner.
    pub(super) fn apply(&self, p: DVec2) -> DVec2 {
        self.turn.rotate(p) + self.shift
    }
}

/// Rotates a chart so that its bounding rectangle is small and upright, with the low corner at the origin. Extents
/// above `longest`, which only single triangles reach that no cut makes shorter, are scaled down to it: one sliver must
/// not take the texels of all others.
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
    let edges = chart.corners.iter().flat_map(|&[a, b, c]| [b - a, c - b, a - c]);
    // A sliver is narrowest along its longest edge.
    let longest_edge = edges.max_by(|a, b| a.length_squared().total_cmp(&b.length_squared())).unwrap_or(DVec2::X);
    let angles = (0..30).map(|i| f64::from(i) * FRAC_PI_2 / 30.0).chain([-longest_edge.to_angle()]);
    let mut best = angles.min_by(|&a, &b| area(a).total_cmp(&area(b))).unwrap_or(0.0);
    let (low, high) = bounds(best);
    if high.x - low.x > high.y - low.y {
        best += FRAC_PI_2;
    }
    let ((low, high), turn) = (bounds(best), DVec2::from_angle(best));
    // A zero extent gives an infinite quotient, which leaves it unchanged.
    let shrink = (longest / (high - low)).min(DVec2::ONE);
    for p in chart.corners.iter_mut().flatten() {
        // The maximum guards against a rounding below zero.
        *p = (turn.rotate(*p) - low).max(DVec2::ZERO) * shrink;
    }
}

/// Least fraction of the scale with a one-texel gutter at which a wider one is used; likewise for a one-texel gutter
/// relative to the largest possible scale.
const GUTTER_WORTH: f64 = 0.92;
/// Factor by which the scale falls, at least, between attempts until charts fit.
const STEP: f64 = 0.96;
/// Most cells along a side of the packing grid, or as many per root of the number of charts, whichever is more: in
/// larger atlases a cell is several texels.
const MOST_CELLS: usize = 512;
const CELLS_PER_CHART: f64 = 16.0;
/// Rotations tried for each chart: quarter turns, exact on every machine.
const TURNS: [DVec2; 4] = [DVec2::X, DVec2::Y, DVec2::NEG_X, DVec2::NEG_Y];

/// Packs all charts into `side`×`side` texels, at about the largest scale at which they fit. Gutters on each side are
/// the widest, out of 4, 2, 1 texels (up to `widest`) and the minimum for bilinear samples, that costs little
/// resolution: maps are trained through their mips, and a texel is floats that a splat could have had. `None` if the
/// charts do not fit at any useful scale. `area` is the charts' total.
pub(super) fn pack(charts: &[Chart], area: f64, side: usize, widest: usize) -> Option<Packing> {
    // Scale at which the charts would fill the atlas.
    let full = side as f64 / area.sqrt();
    let mut chosen = largest_scale(charts, 0.02 * full..full, side, 0)?;
    let mut least = GUTTER_WORTH * chosen.scale;
    for gutter in [1, 2, 4].into_iter().take_while(|gutter| *gutter <= widest) {
        match largest_scale(charts, least..chosen.scale.max(least), side, gutter) {
            Some(packing) => chosen = packing,
            None => break,
        }
        if gutter == 1 {
            least = GUTTER_WORTH * chosen.scale;
        }
    }
    Some(chosen)
}

/// The largest scale of a range, to within 1 %, at which charts fit with this gutter; `None` if they do not fit at its
/// start.
fn largest_scale(charts: &[Chart], range: Range<f64>, side: usize, gutter: usize) -> Option<Packing> {
    let grid = Grid::new(side, gutter, charts.len());
    let (mut scale, mut places) = (range.start, grid.place_all(charts, range.start).ok()?);
    let (mut fails, mut next) = (range.end, STEP * range.end);
    while next > scale {
        match grid.place_all(charts, next) {
            Ok(found) => (scale, places) = (next, found),
            Err(smaller) => (fails, next) = (next, next * smaller),
        }
    }
    while scale < 0.99 * fails {
        let middle = (scale + fails) / 2.0;
        match grid.place_all(charts, middle) {
            Ok(found) => (scale, places) = (middle, found),
            Err(_) => fails = middle,
        }
    }
    Some(Packing { scale, gutter, places })
}

/// Division of an atlas into cells for packing.
struct Grid {
    /// Side of a cell, texels.
    cell: usize,
    /// Cells along the atlas's side.
    cells: usize,
    /// Distance from a chart's points, cells along either axis, within which cells belong to the chart.
    reach: f64,
    /// Distance from a footprint's corner to the least coordinates of the chart in it, texels.
    inset: f64,
}

/// A chart in one of its rotations: the cells that it takes, as runs per row.
struct Footprint {
    turn: DVec2,
    /// Least coordinates of the rotated chart, texels.
    low: DVec2,
    width: usize,
    /// Runs per row: first cell and number of cells.
    rows: Vec<Vec<[usize; 2]>>,
    count: usize,
}

impl Grid {
    fn new(side: usize, gutter: usize, charts: usize) -> Self {
        let cell = side.div_ceil(MOST_CELLS.max((CELLS_PER_CHART * (charts as f64).sqrt()) as usize));
        // A bilinear sample reads texels whose centres are less than one texel from it.
        let texels = if gutter == 0 { 0.999 } else { gutter as f64 + 0.5 };
        // A cell counts if the centre of any of its texels does.
        let reach = (texels + (cell - 1) as f64 / 2.0) / cell as f64;
        Self { cell, cells: side / cell, reach, inset: texels - 0.49 }
    }

    /// Placement of each chart at `scale` texels per unit, in the first order tried that works; or, if none does, the
    /// factor on the scale to try next.
    fn place_all(&self, charts: &[Chart], scale: f64) -> Result<Vec<Place>, f64> {
        let footprints: Vec<Vec<Footprint>> =
            charts.par_iter().map(|c| self.footprints(c, scale)).collect::<Option<_>>().ok_or(STEP)?;
        let count = footprints.iter().map(|f| f[0].count).sum::<usize>() as f64;
        let room = (self.cells * self.cells) as f64;
        if count > room {
            // At most the cells outside gutters fall with the square of the scale.
            return Err((room / count).sqrt().min(STEP));
        }
        let sizes: [fn(&Footprint) -> usize; 2] = [|f| f.rows.len().max(f.width), |f| f.count];
        let tried = sizes.par_iter().map(|size| self.place_by(&footprints, size));
        tried.collect::<Vec<_>>().into_iter().flatten().next().ok_or(STEP)
    }

    /// Footprints of a chart in all rotations that fit the atlas; `None` if none does.
    fn footprints(&self, chart: &Chart, scale: f64) -> Option<Vec<Footprint>> {
        let found: Vec<Footprint> = TURNS.into_iter().filter_map(|turn| self.footprint(chart, scale, turn)).collect();
        (!found.is_empty()).then_some(found)
    }

    fn footprint(&self, chart: &Chart, scale: f64, turn: DVec2) -> Option<Footprint> {
        let turned = |p: DVec2| turn.rotate(p * scale);
        let points = chart.corners.iter().flatten().map(|&p| turned(p));
        let (low, high) =
            points.fold((DVec2::INFINITY, DVec2::NEG_INFINITY), |(low, high), p| (low.min(p), high.max(p)));
        let cell = self.cell as f64;
        let extent = (high - low + 2.0 * self.inset) / cell;
        // Also rejects NaN and numbers too large to convert.
        if !extent.cmple(DVec2::splat(self.cells as f64 + 1.0)).all() {
            return None;
        }
        let [width, height] = extent.to_array().map(|n| n.ceil() as usize + 1);
        let mut taken = vec![false; width * height];
        for t in &chart.corners {
            let corners = t.map(|p| (turned(p) - low + self.inset) / cell - 0.5);
            pixels_around(&corners, self.reach, [width, height], 0..height)
                .for_each(|(x, y)| taken[y * width + x] = true);
        }
        let mut rows: Vec<Vec<[usize; 2]>> = taken.chunks(width).map(runs).collect();
        while rows.last().is_some_and(Vec::is_empty) {
            rows.pop();
        }
        let width = rows.iter().flatten().map(|[start, n]| start + n).max().unwrap_or(0);
        let count = rows.iter().flatten().map(|run| run[1]).sum();
        (width <= self.cells && rows.len() <= self.cells).then_some(Footprint { turn, low, width, rows, count })
    }

    /// Places each chart at the lowest free position, the largest first.
    fn place_by(&self, footprints: &[Vec<Footprint>], size: impl Fn(&Footprint) -> usize) -> Option<Vec<Place>> {
        let mut order: Vec<(usize, usize)> = footprints.iter().map(|f| size(&f[0])).zip(0..).collect();
        order.sort_by_key(|&(size, chart)| (Reverse(size), chart));
        let mut taken = Taken::new(self.cells);
        let mut places = vec![Place::default(); footprints.len()];
        // Charts of equal size do not search rows where one of them found no place: of many small charts most have the
        // same size.
        let (mut last, mut from) = (usize::MAX, [0; TURNS.len()]);
        for (size, chart) in order {
            if size != last {
                (last, from) = (size, [0; TURNS.len()]);
            }
            let mut best: Option<(usize, [usize; 2], &Footprint)> = None;
            for (footprint, from) in footprints[chart].iter().zip(&mut from) {
                let below = best.map_or(self.cells + 1, |b| b.0);
                let at = taken.lowest(footprint, *from, below);
                *from = at.map_or(below.saturating_sub(footprint.rows.len()), |at| at[1]).max(*from);
                if let Some(at) = at {
                    best = Some((at[1] + footprint.rows.len(), at, footprint));
                }
            }
            let (_, at, footprint) = best?;
            taken.take(footprint, at);
            let corner = DVec2::from(at.map(|n| (n * self.cell) as f64));
            places[chart] = Place { turn: footprint.turn, shift: corner + self.inset - footprint.low };
        }
        Some(places)
    }
}

/// Runs of set cells in a row: start and length.
fn runs(row: &[bool]) -> Vec<[usize; 2]> {
    let mut start = 0;
    let mut found = Vec::new();
    for same in row.chunk_by(|a, b| a == b) {
        if same[0] {
            found.push([start, same.len()]);
        }
        start += same.len();
    }
    found
}

/// Occupied cells, a bit each, in rows of whole words.
struct Taken {
    cells: usize,
    words: usize,
    bits: Vec<u64>,
    /// Longest run of free cells in each row.
    free: Vec<usize>,
}

impl Taken {
    fn new(cells: usize) -> Self {
        let words = cells.div_ceil(64);
        Self { cells, words, bits: vec![0; words * cells], free: vec![cells; cells] }
    }

    fn row(&self, y: usize) -> &[u64] {
        &self.bits[y * self.words..][..self.words]
    }

    /// Column and row of the lowest position, from row `from` on, at which the footprint overlaps nothing and its top
    /// is below row `below`; the leftmost if there are several.
    fn lowest(&self, footprint: &Footprint, from: usize, below: usize) -> Option<[usize; 2]> {
        let height = footprint.rows.len();
        let last = below.min(self.cells + 1).checked_sub(height + 1)?;
        let longest: Vec<usize> =
            footprint.rows.iter().map(|row| row.iter().map(|run| run[1]).max().unwrap_or(0)).collect();
        // Rows with the longest runs first, as these reject most positions.
        let mut order: Vec<usize> = (0..height).collect();
        order.sort_by_key(|&row| Reverse(longest[row]));
        let (mut blocked, mut shifted) = (vec![0; self.words], vec![0; self.words]);
        let columns = self.cells - footprint.width + 1;
        'rows: for y in from..=last {
            if order.iter().any(|&row| self.free[y + row] < longest[row]) {
                continue;
            }
            blocked.fill(0);
            for &row in &order {
                if self.free[y + row] == self.cells {
                    continue;
                }
                for &[start, n] in &footprint.rows[row] {
                    block(self.row(y + row), start, n, &mut shifted, &mut blocked);
                }
                if first_clear(&blocked, columns).is_none() {
                    continue 'rows;
                }
            }
            if let Some(x) = first_clear(&blocked, columns) {
                return Some([x, y]);
            }
        }
        None
    }

    fn take(&mut self, footprint: &Footprint, [x, y]: [usize; 2]) {
        for (row, runs) in footprint.rows.iter().enumerate() {
            let bits = &mut self.bits[(y + row) * self.words..][..self.words];
            for &[start, n] in runs {
                for cell in x + start..x + start + n {
                    bits[cell / 64] |= 1 << (cell % 64);
                }
            }
            self.free[y + row] = longest_free(bits, self.cells);
        }
    }
}

/// Marks the columns at which a run of `n` cells, offset by `start`, would overlap an occupied cell of `row`.
fn block(row: &[u64], start: usize, n: usize, shifted: &mut [u64], blocked: &mut [u64]) {
    shifted.copy_from_slice(row);
    let mut reached = 1;
    while reached < n {
        let step = reached.min(n - reached);
        // In rising order, so that words are read before they are changed.
        for i in 0..shifted.len() {
            shifted[i] |= word_at(shifted, i, step);
        }
        reached += step;
    }
    for (i, blocked) in blocked.iter_mut().enumerate() {
        *blocked |= word_at(shifted, i, start);
    }
}

/// Word `i` of `bits` shifted down by `by`.
fn word_at(bits: &[u64], i: usize, by: usize) -> u64 {
    let get = |i: usize| bits.get(i).copied().unwrap_or(0);
    let (words, by) = (i + by / 64, by % 64);
    if by == 0 { get(words) } else { get(words) >> by | get(words + 1) << (64 - by) }
}

/// Index of the first clear bit among the first `count`.
fn first_clear(bits: &[u64], count: usize) -> Option<usize> {
    let (i, word) = bits.iter().enumerate().find(|(_, word)| **word != u64::MAX)?;
    Some(64 * i + word.trailing_ones() as usize).filter(|at| *at < count)
}

/// Length of the longest run of clear bits among the first `count`.
fn longest_free(bits: &[u64], count: usize) -> usize {
    let (mut longest, mut from) = (0, 0);
    for (i, &word) in bits.iter().enumerate() {
        let mut set = word;
        while set != 0 {
            let at = 64 * i + set.trailing_zeros() as usize;
            longest = longest.max(at.min(count).saturating_sub(from));
            from = at + 1;
            set &= set - 1;
        }
    }
    longest.max(count.saturating_sub(from))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn triangle(x: f64, y: f64, side: f64) -> [DVec2; 3] {
        [DVec2::new(x, y), DVec2::new(x + side, y), DVec2::new(x, y + side)]
    }

    fn chart(corners: Vec<[DVec2; 3]>) -> Chart {
        Chart { faces: (0..corners.len() as u32).collect(), corners }
    }

    fn packed(charts: &[Chart], side: usize, widest: usize) -> Packing {
        let corners = charts.iter().flat_map(|c| &c.corners);
        let area = corners.map(|[a, b, c]| (b - a).perp_dot(c - a) / 2.0).sum();
        pack(charts, area, side, widest).unwrap()
    }

    /// Asserts that the texels whose centres are less than `reach` from a point of a chart belong to one chart only.
    fn assert_apart(charts: &[Chart], packing: &Packing, side: usize, reach: f64) {
        let mut owner = vec![None; side * side];
        for (i, (chart, place)) in charts.iter().zip(&packing.places).enumerate() {
            for corners in &chart.corners {
                let texels = corners.map(|p| place.apply(p * packing.scale));
                let [low, high] =
                    [f64::min, f64::max].map(|of| texels.iter().flat_map(DVec2::to_array).reduce(of).unwrap());
                assert!(low >= 0.0 && high <= side as f64, "{texels:?}");
                for (x, y) in pixels_around(&texels.map(|p| p - 0.5), reach, [side; 2], 0..side) {
                    assert_eq!(*owner[y * side + x].get_or_insert(i), i, "{x} {y}");
                }
            }
        }
    }

    /// The remainder of a chart that was split may have gaps as wide as other charts.
    #[test]
    fn charts_in_parts_do_not_lie_on_others() {
        for (gap, side) in [(6.0, 256), (30.0, 256), (30.0, 1100)] {
            // The parts of a chart are beside each other, and then also above each other; its first columns may be
            // empty.
            let in_parts = |i: usize| {
                let shift = if i.is_multiple_of(3) { 4.0 } else { 0.0 };
                chart(vec![triangle(shift, 0.0, 3.0), triangle(shift + gap, 0.3 * gap, 4.0)])
            };
            let whole = |i: usize| chart(vec![triangle(0.0, 0.0, 2.0 + 0.1 * i as f64)]);
            let charts: Vec<Chart> = (0..20).map(in_parts).chain((0..30).map(whole)).collect();
            for widest in [0, 4] {
                let packing = packed(&charts, side, widest);
                let reach = if packing.gutter == 0 { 0.998 } else { packing.gutter as f64 + 0.499 };
                assert_apart(&charts, &packing, side, reach);
                assert!(packing.gutter <= widest && (side < 1100 || packing.gutter == widest), "{}", packing.gutter);
            }
        }
    }

    /// A frame of four strips leaves most of the atlas free.
    #[test]
    fn charts_lie_in_what_others_leave_open() {
        let rectangle = |x: f64, y: f64, w: f64, h: f64| {
            let at = |i: f64, j: f64| DVec2::new(x + i * w, y + j * h);
            [[at(0.0, 0.0), at(1.0, 0.0), at(1.0, 1.0)], [at(0.0, 0.0), at(1.0, 1.0), at(0.0, 1.0)]]
        };
        let sides = [(0.0, 0.0, 10.0, 1.0), (0.0, 9.0, 10.0, 1.0), (0.0, 1.0, 1.0, 8.0), (9.0, 1.0, 1.0, 8.0)];
        let frame = chart(sides.iter().flat_map(|&(x, y, w, h)| rectangle(x, y, w, h)).collect());
        let small = (0..9).map(|_| chart(rectangle(0.0, 0.0, 2.4, 2.4).to_vec()));
        let charts: Vec<Chart> = std::iter::once(frame).chain(small).collect();
        let packing = packed(&charts, 128, 0);
        assert_apart(&charts, &packing, 128, 0.998);
        // The others fit within the frame, which then fills the atlas: its ten units are nearly all of 128 texels.
        assert!(packing.scale > 12.0, "{}", packing.scale);
    }

    #[test]
    fn a_run_blocks_where_it_would_meet_what_is_taken() {
        for (cells, at) in [(20, 7), (64, 63), (200, 130), (200, 64)] {
            let words = usize::div_ceil(cells, 64);
            let mut row = vec![0; words];
            row[at / 64] |= 1_u64 << (at % 64);
            for (start, n) in [(0, 1), (0, 5), (3, 1), (3, 70), (65, 64), (63, 2)] {
                let (mut shifted, mut blocked) = (vec![0; words], vec![0; words]);
                block(&row, start, n, &mut shifted, &mut blocked);
                for x in 0..64 * words {
                    let meets = (x + start..x + start + n).contains(&at);
                    assert_eq!(blocked[x / 64] >> (x % 64) & 1 == 1, meets, "{cells} {at} {start} {n} {x}");
                }
            }
        }
        assert_eq!(first_clear(&[u64::MAX, 0b1011], 128), Some(66));
        assert_eq!([1, 3, 66, 128].map(|count| longest_free(&[0b1001, 1 << 40], count)), [0, 2, 62, 100]);
        assert_eq!((first_clear(&[u64::MAX, 0b1011], 66), first_clear(&[u64::MAX], 64)), (None, None));
    }
}
