//! Selection of the triangles of a made surface that are worth their texels: in HERA the mesh has the smooth regions.
//! Huang et al. 2025 tell these by their shape; here photographs judge.

use glam::Vec2;

use super::{finding::chart_space, setup::Setup, views::Views};
use crate::{
    geometry::{self, ChartSpace, Surface, UnwrappedMesh},
    optimize::{
        Selection, TrainError,
        maps::{self, MapLayout},
        or_why_not,
    },
    render::gpu::training::Training,
    scene::{Atlas, Mesh},
};

/// Largest ratio of the squared error of the maps alone to that of the splats alone around a triangle for it to stay.
/// Maps need not be perfect without view dependence: splats are added to them.
const WORST_RATIO: f64 = 2.5;
/// Fraction of a budget for maps, per fraction of the pictures that they cover …
const MAPS_SHARE: f64 = 0.5;
/// … and upper bound on it where maps alone are no better than splats alone, apart from rounding to multiples of 32 and
/// the room that charts need: with more, too few splats are left for what maps do not show (`docs/experiments.md`).
const MOST_FOR_MAPS: f64 = 0.18;
/// Least size of a connected piece, pixels: below some 16×16 a chart's gutter costs more than the chart holds.
const LEAST_PIXELS: f64 = 256.0;
/// Most triangles of a gap that is kept with what is around it: most such are smaller than pixels, and the background
/// would show through them where no splat grew.
const MOST_OF_GAP: usize = 6;
/// Assumed fraction of an atlas that charts cover, for choosing its size.
const COVERAGE: f64 = 0.6;
/// Texels per pixel, on average over the views that see a triangle, most of them at a slant: enough for those that face
/// it. With one, splats stay in front of maps that are too coarse (`docs/experiments.md`).
const TEXELS_PER_PIXEL: f64 = 2.0;
/// Width of the gutter that is filled with the colours of its chart, texels, in the map of colour and opacity.
const GUTTER: u32 = 4;

/// Judgement of a triangle by the judging views.
#[derive(Clone, Copy, Default)]
struct Score {
    /// Sums of squared errors of maps and of splats.
    errors: [f64; 2],
    pixels: f64,
    views: u32,
}

/// Drops the triangles whose maps explain held-back views worse than the splats do, and packs the rest anew at about
/// two texels per pixel, if the budget has room. `mesh` is as it is on the GPU. `None` if nothing is left.
pub(super) fn select_faces(
    setup: &Setup,
    views: &Views,
    training: &mut Training,
    mesh: &Mesh,
) -> Result<(Option<Mesh>, Selection), TrainError> {
    let judges = setup.judging_views();
    let (scores, seen) = score(views, setup.composition().background, training, mesh, &judges)?;
    let is_far: Vec<bool> = mesh.triangles().iter().map(|t| setup.is_of_shell(mesh, t)).collect();
    let are_held_back = judges.len() < setup.train.len();
    let least = least_views(&scores, &is_far, are_held_back);
    let mut keep: Vec<bool> = (scores.iter().zip(smoothed(mesh, &scores)).zip(&least))
        .map(|((s, [maps, splats]), least)| s.views >= *least && maps <= WORST_RATIO * splats)
        .collect();
    let gaps = geometry::gaps(mesh.triangles(), &keep, MOST_OF_GAP);
    keep.iter_mut().zip(gaps).for_each(|(keep, is_gap)| *keep |= is_gap);
    let count = |keep: &[bool]| keep.iter().filter(|k| **k).count();
    let (all, large_or_small) = (keep.len(), count(&keep));
    let unseen = scores.iter().zip(&least).zip(&keep).filter(|((s, least), keep)| !**keep && s.views < **least).count();
    drop_small(mesh, &scores, &mut keep);
    let selection = Selection {
        triangles: all,
        unseen,
        worse: all - unseen - large_or_small,
        small: large_or_small - count(&keep),
    };
    if selection.kept() == 0 {
        return Ok((None, selection));
    }
    let pixels: f64 = scores.iter().zip(&keep).filter(|s| *s.1).map(|s| s.0.pixels_per_view()).sum();
    let covered: f64 = scores.iter().zip(&keep).filter(|s| *s.1).map(|s| s.0.pixels).sum();
    // Views that maps were made from flatter them.
    let ratio = if are_held_back { error_ratio(&scores, &keep) } else { 1.0 };
    let part = part_for_maps((covered / seen.max(1.0)).min(1.0), ratio);
    let size = side_for(pixels, part, mesh.atlas(), setup.options.max_floats);
    let most = most_side(size, mesh.atlas(), setup.options.max_floats);
    let chart_space = chart_space(setup, views, training)?;
    // Texels in a budget compete with splats. Bands are coarser, and share texels across charts where gutters are
    // narrow.
    let narrow = setup.options.max_floats.is_some() && mesh.atlas().bands().is_none();
    let gutter = if narrow { 0 } else { geometry::WIDEST_GUTTER };
    Ok((laid_out_anew(mesh, &keep, chart_space.as_ref(), (size, most), gutter)?, selection))
}

/// Scores of all triangles from these views over this background, and the number of pixels judged.
fn score(
    views: &Views,
    background: [f32; 3],
    training: &mut Training,
    mesh: &Mesh,
    judges: &[usize],
) -> Result<(Vec<Score>, f64), TrainError> {
    let mut scores = vec![Score::default(); mesh.triangles().len()];
    let mut last_view = vec![0; scores.len()];
    let (mut view, mut seen) = (0, 0.0);
    views.compare(training, judges, background, |training, camera, errors| {
        view += 1;
        for (front, error) in training.front_triangles(camera)?.into_iter().zip(errors) {
            // Masked-out pixels have no error, and triangles that only such pixels show count as unseen: nothing
            // would teach their texels.
            if error[0] + error[1] == 0.0 {
                continue;
            }
            seen += 1.0;
            let Some(face) = (front as usize).checked_sub(1) else { continue };
            let score = &mut scores[face];
            score.errors = [0, 1].map(|k| score.errors[k] + f64::from(error[k]));
            score.pixels += 1.0;
            score.views += u32::from(std::mem::replace(&mut last_view[face], view) != view);
        }
        Ok(())
    })?;
    Ok((scores, seen))
}

impl Score {
    fn pixels_per_view(&self) -> f64 {
        self.pixels / f64::from(self.views.max(1))
    }
}

/// Squared error of the maps alone relative to that of the splats alone, over the triangles that stay.
fn error_ratio(scores: &[Score], keep: &[bool]) -> f64 {
    let sum = |k: usize| scores.iter().zip(keep).filter(|s| *s.1).map(|s| s.0.errors[k]).sum::<f64>();
    sum(0) / sum(1).max(f64::MIN_POSITIVE)
}

/// Part of a budget for maps that cover this `share` of the pictures: in proportion to it, since where splats are
/// sparse, so are texels, up to a limit, which is higher where maps are better than splats by this ratio of their
/// errors.
fn part_for_maps(share: f64, error_ratio: f64) -> f64 {
    (MAPS_SHARE * share).min(MOST_FOR_MAPS / error_ratio.min(1.0).powi(2))
}

/// Side of new maps, texels, a multiple of 32 so that mip levels go as deep as gutters separate charts: for triangles
/// covering this many `pixels`, within this `part` of the budget. At least 64 and at most the side of the old maps.
fn side_for(pixels: f64, part: f64, before: &Atlas, max_floats: Option<usize>) -> u32 {
    let largest = before.base().width();
    let texels = (TEXELS_PER_PIXEL * pixels / COVERAGE).min(affordable(part, before, max_floats));
    ((texels.sqrt() / 32.0).round() as u32 * 32).clamp(largest.min(64), largest)
}

/// Largest side, a multiple of 32 texels, to which charts may make maps of `size` texels a side grow: with no more than
/// half of the budget, and at most the side of the old maps.
fn most_side(size: u32, before: &Atlas, max_floats: Option<usize>) -> u32 {
    let texels = affordable(MAPS_SHARE, before, max_floats);
    ((texels.sqrt() / 32.0).floor() as u32).saturating_mul(32).max(size).min(before.base().width())
}

/// Texels of a base map, with a map of bands as `before`, that this `part` of the budget pays for.
fn affordable(part: f64, before: &Atlas, max_floats: Option<usize>) -> f64 {
    let per_texel = MapLayout { side: before.base().width(), degree: before.sh_degree() }.floats_per_texel();
    max_floats.map_or(f64::INFINITY, |floats| floats as f64 * part / per_texel)
}

/// Number of judging views that must see each triangle: two, but one where the triangle at the median pixel is seen by
/// three or fewer. In a room each part of a wall is seen by few views at a time, and only a quarter of these judge; of
/// 13 training views three do. The median is over pixels, since triangles smaller than a pixel are missed also by views
/// that look there. Triangles of the shell (`is_far`) always need two and do not count in the median: around an object
/// they have most of the pixels, each part seen by few, and are no surface that anyone has found.
fn least_views(scores: &[Score], is_far: &[bool], are_held_back: bool) -> Vec<u32> {
    let pixels = |most: u32| -> f64 {
        let near = scores.iter().zip(is_far).filter(|(s, is_far)| s.views <= most && !**is_far);
        near.map(|(s, _)| s.pixels).sum()
    };
    let total = pixels(u32::MAX);
    // Views that the maps were made from agree with any map that only one of them made.
    let near = if are_held_back && total > 0.0 && 2.0 * pixels(3) > total { 1 } else { 2 };
    is_far.iter().map(|&is_far| if is_far { 2 } else { near }).collect()
}

/// Errors averaged over two rings of triangles: those of single triangles are noise.
fn smoothed(mesh: &Mesh, scores: &[Score]) -> Vec<[f64; 2]> {
    let mut errors: Vec<[f64; 2]> = scores.iter().map(|s| s.errors).collect();
    for _ in 0..2 {
        let mut vertices = vec![([0.0; 2], 0.0); mesh.positions().len()];
        for (t, e) in mesh.triangles().iter().zip(&errors) {
            for &v in t {
                let (sum, count) = &mut vertices[v as usize];
                *sum = [sum[0] + e[0], sum[1] + e[1]];
                *count += 1.0;
            }
        }
        let mean_at = |v: u32, k: usize| vertices[v as usize].0[k] / vertices[v as usize].1;
        let mean = |t: &[u32; 3], k: usize| t.iter().map(|&v| mean_at(v, k)).sum::<f64>() / 3.0;
        errors = mesh.triangles().iter().map(|t| [mean(t, 0), mean(t, 1)]).collect();
    }
    errors
}

/// Drops connected pieces that cover few pixels in the views.
fn drop_small(mesh: &Mesh, scores: &[Score], keep: &mut [bool]) {
    let faces: Vec<usize> = (0..keep.len()).filter(|&f| keep[f]).collect();
    let component = geometry::components(&part(mesh, keep));
    let mut pixels = vec![0.0; mesh.positions().len()];
    for (&face, &c) in faces.iter().zip(&component) {
        pixels[c as usize] += scores[face].pixels_per_view();
    }
    for (&face, &c) in faces.iter().zip(&component) {
        keep[face] = pixels[c as usize] >= LEAST_PIXELS;
    }
}

fn kept<T: Copy>(all: &[T], keep: &[bool]) -> Vec<T> {
    all.iter().zip(keep).filter(|t| *t.1).map(|t| *t.0).collect()
}

/// The kept triangles, on all vertices.
fn part(mesh: &Mesh, keep: &[bool]) -> Surface {
    Surface { positions: mesh.positions().to_vec(), triangles: kept(mesh.triangles(), keep) }
}

/// Packs the kept triangles into new charts, in maps of `size` texels a side or, where many small charts need more room
/// than their area says, up to `most`, and up to the old side if they do not fit there. If they do not fit even then,
/// all keep their charts.
fn laid_out_anew(
    mesh: &Mesh,
    keep: &[bool],
    chart_space: Option<&ChartSpace>,
    (size, most): (u32, u32),
    gutter: u32,
) -> Result<Option<Mesh>, TrainError> {
    let (part, uvs) = (geometry::compact(part(mesh, keep)), kept(mesh.corner_uvs(), keep));
    let largest = mesh.atlas().base().width();
    let within = |size: u32, most: u32| {
        maps::with_room_for_charts(size, most, |size| {
            lay_out(geometry::unwrap(&part, chart_space, size, gutter)?, &uvs, mesh.atlas(), size)
        })
    };
    let anew = match within(size, most) {
        Err(TrainError::Geometry(geometry::GeometryError::AtlasTooSmall { .. })) if most < largest => {
            within(maps::larger(most).min(largest), largest)
        }
        made => made,
    };
    Ok(match or_why_not(anew)? {
        Ok(mesh) => Some(mesh),
        Err(_) => mesh.with_triangles(keep),
    })
}

/// A mesh with the new charts in an atlas of `size` texels a side, with the content of `atlas` at `uvs` resampled into
/// them.
fn lay_out(unwrapped: UnwrappedMesh, uvs: &[[Vec2; 3]], atlas: &Atlas, size: u32) -> Result<Mesh, TrainError> {
    let redrawn = |texture, size, gutter| geometry::transfer(texture, uvs, &unwrapped.corner_uvs, size, gutter);
    let base = redrawn(atlas.base(), size, GUTTER)?;
    let band_side = MapLayout { side: size, degree: atlas.sh_degree() }.band_side();
    let bands = atlas.bands().map(|bands| redrawn(bands, band_side, GUTTER / 2)).transpose()?;
    Ok(Mesh::new(unwrapped.positions, unwrapped.triangles, unwrapped.corner_uvs, Atlas::new(base, bands)?)?)
}

#[cfg(test)]
mod tests {
    use glam::Vec3;

    use super::*;
    use crate::scene::Texture;

    /// Two separate strips of `n` squares each, the second half as wide; every triangle has its own texels.
    fn strips(n: u32) -> Mesh {
        let (mut positions, mut triangles, mut uvs) = (vec![], vec![], vec![]);
        for (strip, width) in [(0, 1.0), (1, 0.5)] {
            let first = positions.len() as u32;
            for i in 0..=n {
                let x = i as f32;
                positions
                    .extend([Vec3::new(x, 3.0 * strip as f32, 0.0), Vec3::new(x, 3.0 * strip as f32 + width, 0.0)]);
            }
            let place = |p: Vec3| Vec2::new(p.x / n as f32, p.y / 4.0);
            for i in 0..n {
                let a = first + 2 * i;
                for t in [[a, a + 2, a + 3], [a, a + 3, a + 1]] {
                    uvs.push(t.map(|v| place(positions[v as usize])));
                    triangles.push(t);
                }
            }
        }
        let texels = (0..64 * 64).flat_map(|i| [(i % 64) as f32 / 64.0, (i / 64) as f32 / 64.0, 0.0, 1.0]).collect();
        let atlas = Atlas::new(Texture::new(64, 64, 4, texels).unwrap(), None).unwrap();
        Mesh::new(positions, triangles, uvs, atlas).unwrap()
    }

    #[test]
    fn one_noisy_triangle_is_judged_with_those_around_it() {
        let mesh = strips(10);
        let mut scores = vec![Score { errors: [1.0, 1.0], pixels: 10.0, views: 2 }; 40];
        scores[9].errors[0] = 4.0;
        let errors = smoothed(&mesh, &scores);
        assert!(errors[9][0] < 2.0 && errors[9][0] > errors[30][0], "{errors:?}");
        assert!(errors.iter().all(|e| (e[1] - 1.0).abs() < 1e-12));
        // Faces that are not connected have no influence.
        assert!(errors[20..].iter().all(|e| (e[0] - 1.0).abs() < 1e-12));
    }

    #[test]
    fn one_view_is_enough_where_few_see_the_same_but_of_a_shell() {
        let least = |near: &[(u32, f64)], far: &[(u32, f64)], are_held_back| {
            let seen = |&(views, pixels): &(u32, f64)| Score { views, pixels, ..Score::default() };
            let scores: Vec<Score> = near.iter().chain(far).map(seen).collect();
            let is_far: Vec<bool> = (0..scores.len()).map(|i| i >= near.len()).collect();
            let least = least_views(&scores, &is_far, are_held_back);
            let (of_near, of_far) = least.split_at(near.len());
            assert!(of_far.iter().all(|&views| views == 2) && of_near.windows(2).all(|v| v[0] == v[1]), "{least:?}");
            of_near.first().copied()
        };
        let few = [(0, 0.0), (1, 20.0), (3, 40.0), (9, 50.0)];
        assert_eq!(least(&few, &[], true), Some(1));
        // Many small faces that single views see say nothing about the large ones.
        assert_eq!(least(&[(1, 1.0), (1, 1.0), (1, 1.0), (5, 9.0)], &[], true), Some(2));
        assert_eq!((least(&[(1, 1.0)], &[], false), least(&[(0, 0.0)], &[], true)), (Some(2), Some(2)));
        // Faces of the shell have no influence on the others.
        assert_eq!((least(&few, &[(9, 500.0)], true), least(&[(5, 9.0)], &[(1, 500.0)], true)), (Some(1), Some(2)));
        assert_eq!((least(&[], &[(1, 9.0)], true), least(&[], &[], true)), (None, None));
    }

    #[test]
    fn maps_get_a_part_of_a_budget_and_never_most_of_it() {
        let atlas = |side, bands: Option<u32>| {
            let bands = bands.map(|side| Texture::zeros(side, side, 9));
            Atlas::new(Texture::zeros(side, side, 4), bands).unwrap()
        };
        let (plain, floats) = (atlas(512, None), Some(600_000));
        // .18 of 600,000 floats are 164² texels of four floats, .1 are 122².
        assert_eq!([0.18, 0.1].map(|part| side_for(1e6, part, &plain, floats)), [160, 128]);
        // Bands of nine floats per 16 colour texels are taken from the same part: 154².
        assert_eq!(side_for(1e6, 0.18, &atlas(512, Some(128)), floats), 160);
        // With enough room there are two texels per pixel, and charts cover three fifths: 20,000 pixels need 258²
        // texels.
        assert_eq!((side_for(2e4, 0.18, &plain, None), side_for(2e4, 0.18, &plain, Some(10_000_000))), (256, 256));
        // Neither more texels than before, nor too few for charts.
        assert_eq!((side_for(1e9, 0.18, &plain, None), side_for(0.0, 0.0, &plain, floats)), (512, 64));
        assert_eq!(side_for(1.0, 0.18, &atlas(32, None), floats), 32);
        // Half of the budget are 273² texels: charts make maps grow so far, but not make them smaller.
        assert_eq!([160, 256, 288].map(|size| most_side(size, &plain, floats)), [256, 256, 288]);
        assert_eq!((most_side(160, &plain, None), most_side(64, &plain, Some(1000))), (512, 64));
        assert_eq!(most_side(64, &atlas(512, Some(128)), Some(10_000_000)), 512);
    }

    #[test]
    fn maps_better_than_splats_get_more_but_no_more_than_they_cover() {
        let score = |maps, splats| Score { errors: [maps, splats], ..Score::default() };
        let scores = [score(1.0, 4.0), score(9.0, 1.0), score(3.0, 4.0)];
        assert_eq!(error_ratio(&scores, &[true, false, true]), 0.5);
        assert_eq!([0.2, 1.0].map(|share| part_for_maps(share, 1.0)), [0.1, 0.18]);
        // Worse ones get no less, …
        assert_eq!(part_for_maps(1.0, 2.0), 0.18);
        // … better ones up to half of the budget.
        assert!((part_for_maps(1.0, 0.75) - 0.32).abs() < 1e-12);
        assert_eq!([0.0, 0.5].map(|ratio| part_for_maps(0.8, ratio)), [0.4; 2]);
    }

    #[test]
    fn small_pieces_go_whole_and_large_ones_stay() {
        let mesh = strips(10);
        let pixels = |f: usize| if f < 20 { 30.0 } else { 20.0 };
        // Seen twice: 15 pixels per view and triangle on the first strip, 300 in all; 200 on the second.
        let scores: Vec<Score> = (0..40).map(|f| Score { errors: [0.0; 2], pixels: pixels(f), views: 2 }).collect();
        let mut keep = vec![true; 40];
        drop_small(&mesh, &scores, &mut keep);
        assert!(keep[..20].iter().all(|k| *k) && !keep[20..].contains(&true), "{keep:?}");
        // Cut in two, neither half of the first strip is large enough.
        let mut keep: Vec<bool> = (0..40).map(|f| f != 10 && f != 11).collect();
        drop_small(&mesh, &scores, &mut keep);
        assert!(!keep.contains(&true), "{keep:?}");
    }

    /// If there is no room for the charts of the kept triangles, the run continues with the old layout.
    #[test]
    fn what_cannot_be_laid_out_anew_stays_where_it_is() {
        // One triangle per texel, with no two adjacent.
        let corner = |i: u32| Vec3::new(2.0 * (i % 64) as f32, 2.0 * (i / 64) as f32, 0.0);
        let positions = (0..64 * 64).flat_map(|i| [Vec3::ZERO, Vec3::X, Vec3::Y].map(|p| corner(i) + p)).collect();
        let triangles = (0..64 * 64).map(|i| [3 * i, 3 * i + 1, 3 * i + 2]).collect();
        let uv = |p: Vec3| p.truncate() / 128.0;
        let uvs = (0..64 * 64).map(|i| [Vec3::ZERO, Vec3::X, Vec3::Y].map(|p| uv(corner(i) + p))).collect();
        let mesh = Mesh::new(positions, triangles, uvs, strips(1).atlas().clone()).unwrap();
        let keep: Vec<bool> = (0..64 * 64).map(|f| f % 2 == 0).collect();
        let left = laid_out_anew(&mesh, &keep, None, (32, 64), 0).unwrap();
        assert_eq!(left, mesh.with_triangles(&keep));
        // Few triangles fit.
        let keep: Vec<bool> = (0..64 * 64).map(|f| f < 4).collect();
        let left = laid_out_anew(&mesh, &keep, None, (64, 64), 0).unwrap().unwrap();
        assert!(left.triangles().len() == 4 && Some(left) != mesh.with_triangles(&keep));
        // Maps that should grow no further do where the charts would have no room otherwise.
        let grown = |kept: usize| {
            let keep: Vec<bool> = (0..64 * 64).map(|f| f < kept).collect();
            let [found, expected] = [32, 64].map(|most| laid_out_anew(&mesh, &keep, None, (32, most), 0).unwrap());
            assert_eq!(found, expected, "{kept}");
            let is_anew = expected != mesh.with_triangles(&keep);
            is_anew && expected.is_some_and(|mesh| mesh.atlas().base().width() == 64)
        };
        assert!((2..11).any(|power| grown(1 << power)));
    }

    /// Doubling the side could exceed a small budget.
    #[test]
    fn maps_grow_little_more_than_charts_need() {
        let grown = |needed: u32, largest| {
            maps::with_room_for_charts(64, largest, |size| match size < needed {
                true => Err(geometry::GeometryError::AtlasTooSmall { charts: 9, atlas_size: size }.into()),
                false => Ok(size),
            })
        };
        assert_eq!([64, 65, 97, 200, 600].map(|needed| grown(needed, 1000).unwrap()), [64, 96, 128, 224, 608]);
        assert_eq!(grown(100, 100).unwrap(), 100);
        assert!(grown(101, 100).is_err());
    }

    /// Even if a quarter of the side would be less.
    #[test]
    fn the_band_map_is_as_large_as_when_it_was_made() {
        let mesh = strips(10);
        let bands = Some(Texture::zeros(16, 16, 9));
        let atlas = Atlas::new(mesh.atlas().base().clone(), bands).unwrap();
        for (size, side) in [(32, 16), (128, 32)] {
            let unwrapped = geometry::unwrap(&part(&mesh, &[true; 40]), None, size, 0).unwrap();
            let laid_out = lay_out(unwrapped, mesh.corner_uvs(), &atlas, size).unwrap();
            assert_eq!(laid_out.atlas().bands().map(Texture::width), Some(side));
        }
    }

    #[test]
    fn content_follows_what_is_kept() {
        let mesh = strips(10);
        let keep: Vec<bool> = (0..40).map(|f| f < 20).collect();
        let unwrapped = geometry::unwrap(&geometry::compact(part(&mesh, &keep)), None, 128, 0).unwrap();
        let laid_out = lay_out(unwrapped, &kept(mesh.corner_uvs(), &keep), mesh.atlas(), 128).unwrap();
        assert_eq!((laid_out.triangles().len(), laid_out.positions().len()), (20, 22));
        let base = laid_out.atlas().base();
        for (t, uvs) in laid_out.triangles().iter().zip(laid_out.corner_uvs()) {
            let center = |p: [Vec3; 3]| (p[0] + p[1] + p[2]) / 3.0;
            let position = center(t.map(|v| laid_out.positions()[v as usize]));
            let texel = (uvs[0] + uvs[1] + uvs[2]) / 3.0 * 128.0;
            let found = &base.texels()[4 * (texel.y as usize * 128 + texel.x as usize)..][..2];
            // Within one texel of either atlas.
            let expected = [position.x / 10.0, position.y / 4.0];
            assert!(found.iter().zip(expected).all(|(f, e)| (f - e).abs() < 0.03), "{found:?} {expected:?}");
        }
    }
}
