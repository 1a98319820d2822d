//! Initial splats where photographs show something but structure from motion found no points: smooth walls, and what
//! lies beyond the points at the borders of pictures.
//!
//! Splats made from points begin small, so that without these such places stay black for hundreds of iterations, until
//! others have grown over them.

use std::sync::Arc;

use glam::{DVec2, DVec3};
use rayon::prelude::*;

use super::{
    TrainError,
    cells::{Cells, evenly, is_needless, stride},
    initialize::round_splats,
};
use crate::{
    capture::{CaptureError, Photo, View},
    geometry::{MeshBvh, Sight},
    scene::{Camera, LARGEST_COORDINATE, Splats},
    stats::quantile,
};

/// Border around a picture that is covered too, as a fraction of its longer side: other views may see there what no
/// training view does.
const MARGIN: f64 = 0.1;
/// A splat is not placed nearer than this fraction of the depth of every point and mesh that a view shows there … Close
/// to 1, since through a long lens what stands beside an object is hardly nearer than the object itself.
const NEARER: f64 = 0.95;
/// … in more than this fraction of the views that show anything there: it would float in front of what they see.
const HIDING_VIEWS: f64 = 0.25;
/// Nor is it placed in front of any camera, nearer than this fraction of the depth of the nearest points that the
/// camera sees, or of the distance to the nearest mesh: the camera was there, and saw past it …
const CLEAR: f64 = 0.8;
/// … after leaving out this fraction of the nearest points, which may be mismatched.
const WILD: f64 = 0.02;
/// Where a splat would float, it is tried at this multiple of its distance from the camera that shows it …
const FARTHER: f64 = 1.5;
/// … up to this many times, ending 26 times as far: beyond an object and the cameras on its other side, or in what
/// surrounds them.
const TRIES: i32 = 8;
/// A dim splat, less than this from the background in every channel, is placed as far away as the views allow unless it
/// lies between points: in mid-air it would be fog in front of what no training view sees from there, and its absence
/// is hardly noticed …
const DIM: f32 = 0.25;
/// … with points on two opposite sides whose depths differ by no more than this factor counting as between …
const ONE_DEPTH: f64 = 1.5;
/// … and "as the views allow" meaning that the evidence of the other views is at most this much below the best, as a
/// share of views …
const AS_EVIDENT: f64 = 0.15;
/// … where a view counts as showing the same thing if colours differ by less than this in every channel.
const ALIKE: f32 = 0.1;

/// Known scene content, in the capture's frame.
pub(super) struct Known<'a> {
    /// Points, and the splats placed farther away.
    pub points: &'a [DVec3],
    /// Given meshes.
    pub meshes: &'a MeshBvh,
    /// Near plane: smallest camera-space z that a camera sees.
    pub near: f64,
    /// Background colour, RGB; `None` if it changes with every iteration.
    pub background: Option<[f32; 3]>,
}

impl Known<'_> {
    /// Whether a camera's ray towards `p` hits a mesh between these fractions of the way there.
    fn has_mesh(&self, camera: &Camera, p: DVec3, from: f64, to: f64) -> bool {
        Sight::to(camera, p, self.near).has_hit(self.meshes, from, to)
    }
}

/// Creates one splat per image cell (plus a 10 % border) that contains no point and no mesh. Depth is interpolated from
/// neighbouring cells, and increased while the splat would hide what another view sees or float right in front of a
/// camera, or if it is dim and not between points. Colours are the photograph's; at most `max_splats` are made, evenly
/// distributed. Splats are round, their deviation half a cell, with opacity ½. Splats placed by one view count as
/// points for the next.
///
/// No splat is placed where a view shows the background, as there may be nothing. A cell contains all points that
/// project into it, hidden or not: a bare wall with points behind it gets no splat either.
///
/// `photo` decodes a view's picture. Cells with masked pixels are left out.
///
/// # Errors
/// If a photograph cannot be read or `sh_degree` exceeds 3.
pub(super) fn between_points(
    views: &[&View],
    known: &Known,
    sh_degree: u32,
    max_splats: usize,
    photo: impl Fn(&View) -> Result<Arc<Photo>, CaptureError> + Sync,
) -> Result<Splats, TrainError> {
    if max_splats == 0 || known.points.is_empty() {
        return Ok(Splats::empty(sh_degree));
    }
    let maps = views
        .par_iter()
        .step_by(stride(views.len()))
        .map(|view| Ok(Shown::new(&view.camera, known, &*photo(view)?)))
        .collect::<Result<Vec<Shown>, CaptureError>>()?;
    let found = covers(&maps, known);
    let kept = evenly(&found, max_splats);
    // Fewer splats are made larger.
    let wider = (found.len() as f64 / kept.len().max(1) as f64).sqrt();
    let means = kept.iter().map(|c| c.mean.as_vec3()).collect();
    let scales: Vec<f32> = kept.iter().map(|c| (c.scale * wider) as f32).collect();
    let colors: Vec<[f32; 3]> = kept.iter().map(|c| c.color).collect();
    Ok(round_splats(means, &scales, &colors, 0.5, sh_degree)?)
}

/// All splats to place, view by view.
fn covers(maps: &[Shown], known: &Known) -> Vec<Cover> {
    let mut found: Vec<Cover> = vec![];
    for map in maps {
        let mut taken: Vec<bool> = map.points.iter().map(Option::is_some).collect();
        let hits: Vec<usize> = found.par_iter().filter_map(|c| map.cell_of(c.mean)).collect();
        hits.into_iter().for_each(|cell| taken[cell] = true);
        let own = (0..taken.len()).into_par_iter().filter(|&cell| !taken[cell]);
        let own = own.filter_map(|cell| Some((cell, map.cover(cell)?)));
        let own = own.filter(|(_, cover)| !is_needless(cover.color, known.background));
        let bare = own.filter(|(_, cover)| !known.has_mesh(&map.cells.camera, cover.mean, 0.0, f64::INFINITY));
        found.par_extend(bare.filter_map(|(cell, cover)| {
            let at_depths = (0..=TRIES).map(|k| cover.farther(map.cells.camera.center(), FARTHER.powi(k)));
            let mut allowed = at_depths.take_while(Cover::is_valid).filter(|cover| !hides(cover, maps, known));
            let is_dim = known.background.is_some_and(|empty| are_within(DIM, cover.color, empty));
            if is_dim && !map.is_between(cell) { farthest_evident(allowed, map, maps) } else { allowed.next() }
        }));
    }
    found
}

/// A splat to be placed.
struct Cover {
    mean: DVec3,
    scale: f64,
    color: [f32; 3],
}

impl Cover {
    /// The splat that looks the same from `eye`, `factor` times as far away.
    fn farther(&self, eye: DVec3, factor: f64) -> Self {
        Self { mean: eye + factor * (self.mean - eye), scale: factor * self.scale, color: self.color }
    }

    /// Whether position and scale are valid for a splat.
    fn is_valid(&self) -> bool {
        self.mean.abs().max_element() < LARGEST_COORDINATE && (self.scale as f32).is_normal()
    }
}

/// Contents of each cell of a view's picture.
struct Shown {
    cells: Cells,
    /// Inverse depth of the nearest point in the cell.
    points: Vec<Option<f64>>,
    /// Median inverse depth of the points in the cell, or of cells around it.
    nearness: Vec<Option<f64>>,
    /// Mean colour, unless a pixel of the cell is masked.
    colors: Vec<Option<[f32; 3]>>,
    /// Whether the cell is in the picture, not in the border around it.
    is_inside: Vec<bool>,
    /// Distance from the camera within which nothing is in front of it.
    clear: f64,
}

impl Shown {
    fn new(camera: &Camera, known: &Known, photo: &Photo) -> Self {
        let points = known.points;
        let margin = margin(camera);
        let cells = Cells::new(&camera.padded(margin));
        let camera = &cells.camera;
        let mut seen: Vec<(usize, f64)> = (points.iter().map(|p| camera.to_camera(*p)))
            .filter(|p| p.z > known.near)
            .filter_map(|p| Some((cells.of(p)?, p.z.recip())))
            .collect();
        let to_mesh = known.meshes.closest_point(camera.center()).map_or(f64::INFINITY, |p| p.distance);
        let clear = CLEAR * to_mesh.min(nearest_depth(seen.iter().map(|s| s.1.recip()).collect()));
        seen.sort_unstable_by(|a, b| a.0.cmp(&b.0).then(a.1.total_cmp(&b.1)));
        let (mut nearest, mut median) = (vec![None; cells.len()], vec![None; cells.len()]);
        for cell in seen.chunk_by(|a, b| a.0 == b.0) {
            nearest[cell[0].0] = Some(cell[cell.len() - 1].1);
            median[cell[0].0] = Some(cell[cell.len() / 2].1);
        }
        let colors = (0..cells.len()).map(|cell| mean_color(cells.pixels(cell), margin, photo)).collect();
        // Decided by the middle of the cell.
        let within = |[from, to]: [u32; 2], size: u32| (2 * margin..2 * (margin + size)).contains(&(from + to));
        let is_inside = (0..cells.len()).map(|cell| cells.pixels(cell));
        let is_inside = is_inside.map(|[x, y]| within(x, photo.width) && within(y, photo.height)).collect();
        Self { points: nearest, nearness: spread(&cells, median), colors, is_inside, clear, cells }
    }

    fn cell_of(&self, p: DVec3) -> Option<usize> {
        self.cells.of(self.cells.camera.to_camera(p))
    }

    /// Whether points of similar depth lie on two opposite sides of a cell.
    fn is_between(&self, cell: usize) -> bool {
        [[1, 0], [0, 1], [1, 1], [1, -1]].into_iter().any(|[dx, dy]| {
            let sides = self.beside(cell, [dx, dy]).zip(self.beside(cell, [-dx, -dy]));
            sides.is_some_and(|(a, b)| a < ONE_DEPTH * b && b < ONE_DEPTH * a)
        })
    }

    /// Inverse depth of the nearest occupied cell in a direction, given in cells per step.
    fn beside(&self, cell: usize, [dx, dy]: [isize; 2]) -> Option<f64> {
        let (columns, rows) = (self.cells.columns, self.cells.rows);
        let (x, y) = (cell % columns, cell / columns);
        (1..)
            .map_while(|k| Some((x.checked_add_signed(k * dx)?, y.checked_add_signed(k * dy)?)))
            .take_while(|&(x, y)| x < columns && y < rows)
            .find_map(|(x, y)| self.points[y * columns + x])
    }

    /// Whether the picture shows a similar colour at `p`; `None` if `p` is outside of it or masked.
    fn is_alike_at(&self, p: DVec3, color: [f32; 3]) -> Option<bool> {
        let at = self.cell_of(p).filter(|&cell| self.is_inside[cell])?;
        Some(are_within(ALIKE, self.colors[at]?, color))
    }

    /// Share of the picture's cells that have a similar colour.
    fn share_alike(&self, color: [f32; 3]) -> f64 {
        let inside = self.colors.iter().zip(&self.is_inside).filter_map(|(c, is_inside)| c.filter(|_| *is_inside));
        let (alike, all) =
            inside.fold((0, 0), |(alike, all), c| (alike + u32::from(are_within(ALIKE, c, color)), all + 1));
        f64::from(alike) / f64::from(all.max(1))
    }

    fn cover(&self, cell: usize) -> Option<Cover> {
        let (camera, color) = (&self.cells.camera, self.colors[cell]?);
        let depth = self.nearness[cell]?.recip();
        let [x, y] = self.cells.pixels(cell).map(|[from, to]| f64::from(from + to) / 2.0);
        let mean = camera.center() + camera.rotation().transpose() * (depth * camera.ray(DVec2::new(x, y)));
        let scale = 0.5 * self.cells.side * depth / camera.intrinsics().fx;
        Some(Cover { mean, scale, color }).filter(Cover::is_valid)
    }
}

/// Least depth but for the [`WILD`] fraction that may be mismatched; 0 if there are none.
fn nearest_depth(depths: Vec<f64>) -> f64 {
    quantile(depths, WILD).unwrap_or(0.0)
}

/// Whether a splat would stand right in front of a camera, or occlude the points and meshes of too many views.
fn hides(cover: &Cover, maps: &[Shown], known: &Known) -> bool {
    let (mut before, mut shown) = (0, 0);
    for map in maps {
        let camera = &map.cells.camera;
        let p = camera.to_camera(cover.mean);
        // Only splats in front of the camera count: behind it there may be a wall.
        if p.z > 0.0 && p.length() < map.clear {
            return true;
        }
        let Some(cell) = map.cells.of(p) else { continue };
        let has_mesh = |from: f64, to: f64| known.has_mesh(camera, cover.mean, from, to);
        let is_before = if has_mesh(0.0, NEARER.recip()) {
            Some(false)
        } else if has_mesh(NEARER.recip(), f64::INFINITY) {
            Some(true)
        } else {
            map.points[cell].map(|nearest| p.z * nearest < NEARER)
        };
        shown += usize::from(is_before.is_some());
        before += usize::from(is_before == Some(true));
    }
    f64::from(before as u32) > HIDING_VIEWS * f64::from(shown as u32)
}

/// The farthest of these candidates, which recede from the camera of `own` and share one colour, whose evidence is
/// close to the best. Evidence is how much more often the other views show a similar colour at that place than anywhere
/// in their pictures; with few views it is low.
fn farthest_evident(covers: impl Iterator<Item = Cover>, own: &Shown, maps: &[Shown]) -> Option<Cover> {
    let covers: Vec<Cover> = covers.collect();
    let color = covers.first()?.color;
    let others: Vec<(&Shown, f64)> =
        maps.iter().filter(|map| !std::ptr::eq(*map, own)).map(|map| (map, map.share_alike(color))).collect();
    let evidence = |cover: &Cover| {
        let seen = others.iter().filter_map(|(map, usual)| Some((map.is_alike_at(cover.mean, color)?, usual)));
        let (sum, count) = seen.fold((0.0, 1.0), |(sum, count), (is_alike, usual)| {
            (sum + f64::from(u8::from(is_alike)) - usual, count + 1.0)
        });
        sum / count
    };
    let evidence: Vec<f64> = covers.iter().map(evidence).collect();
    let best = evidence.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let at = evidence.iter().rposition(|e| *e >= best - AS_EVIDENT)?;
    covers.into_iter().nth(at)
}

/// Whether two colours differ by less than `most` in every channel.
fn are_within(most: f32, a: [f32; 3], b: [f32; 3]) -> bool {
    a.iter().zip(b).all(|(a, b)| (a - b).abs() < most)
}

/// Fills cells without a value with the mean of their neighbours, outwards until all are reached.
fn spread(cells: &Cells, mut values: Vec<Option<f64>>) -> Vec<Option<f64>> {
    loop {
        let empty: Vec<usize> = (0..values.len()).filter(|&i| values[i].is_none()).collect();
        let found: Vec<(usize, f64)> = (empty.iter())
            .filter_map(|&i| {
                let (sum, count) =
                    cells.around(i).filter_map(|j| values[j]).fold((0.0, 0.0), |(s, n), v| (s + v, n + 1.0));
                (count > 0.0).then(|| (i, sum / count))
            })
            .collect();
        if found.is_empty() {
            return values;
        }
        found.into_iter().for_each(|(i, value)| values[i] = Some(value));
    }
}

/// Width of the border around a picture, pixels.
fn margin(camera: &Camera) -> u32 {
    let k = camera.intrinsics();
    (MARGIN * f64::from(k.longer_side())).round() as u32
}

/// Mean colour of a range of pixels of the picture with its border, which repeats the picture's edge; `None` if the
/// range is empty or a pixel in it is masked.
fn mean_color([x, y]: [[u32; 2]; 2], margin: u32, photo: &Photo) -> Option<[f32; 3]> {
    let inside = |at: u32, size: u32| at.saturating_sub(margin).min(size.saturating_sub(1)) as usize;
    let (mut sum, mut count) = ([0; 3], 0);
    for row in y[0]..y[1] {
        for column in x[0]..x[1] {
            let rgb = photo.whole(photo.index(inside(column, photo.width), inside(row, photo.height)))?;
            (0..3).for_each(|c| sum[c] += u64::from(rgb[c]));
            count += 1;
        }
    }
    (count > 0).then(|| sum.map(|s| (s as f64 / f64::from(count) / 255.0) as f32))
}

#[cfg(test)]
mod tests;
