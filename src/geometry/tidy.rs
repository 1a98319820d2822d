//! Tidying of surfaces from other sources on the way to charts: they may lack properties that an iso-surface has.

use super::GeometryError;
use super::holes::without_holes;
use super::reconstruct::SurfaceStats;
use super::surface::{Surface, area_normal, compact, components, first_at_place, simplified, without_broken};

/// Number of triangles below which a connected piece may be a crumb, as for an iso-surface (2DGS), ...
const CRUMB_FACES: usize = 50;
/// ... if its area is also below this fraction of the largest piece's: a box has twelve triangles.
const CRUMB_AREA: f64 = 0.01;

/// Options of [`tidy`].
#[derive(Clone, Copy, Debug)]
pub struct Tidying {
    /// Approximate upper bound on triangles.
    pub triangles: usize,
    /// Whether small pieces are dropped: a scan has crumbs, but in a model, what stands on a large ground may be as
    /// small.
    pub drops_crumbs: bool,
    /// Whether holes with few edges are closed: a scan has gaps, but windows of a model with few triangles are such
    /// holes, too.
    pub closes_holes: bool,
}

/// Welds coincident vertices, drops broken triangles and, as far as requested, crumbs, closes small holes and
/// simplifies. In the statistics the input counts as extracted. The cost is linear in the input: of many holes that
/// each span much of it the largest stay open.
///
/// # Errors
/// If no triangle is left; the message names the step.
pub fn tidy(surface: Surface, tidying: Tidying) -> Result<(Surface, SurfaceStats), GeometryError> {
    let mut stats = SurfaceStats { extracted: surface.triangles.len(), ..SurfaceStats::default() };
    let whole = compact(without_broken(welded(surface)));
    let kept = if tidying.drops_crumbs { without_crumbs(whole) } else { whole };
    stats.cleaned = kept.triangles.len();
    if stats.cleaned == 0 {
        let hint = "no triangle has an area, finite corners and indices in range";
        return Err(GeometryError::EmptySurface { step: "cleaning", hint });
    }
    let closed;
    (closed, stats.holes) = if tidying.closes_holes { without_holes(kept) } else { (kept, 0) };
    stats.even = closed.triangles.len();
    let simplified = simplified(&closed, &[], tidying.triangles)?;
    stats.simplified = simplified.triangles.len();
    Ok((simplified, stats))
}

/// Merges coincident vertices: files keep them apart where texture coordinates or normals differ.
fn welded(mut surface: Surface) -> Surface {
    let same = first_at_place(surface.positions.iter().map(|p| p.as_dvec3()));
    for v in surface.triangles.iter_mut().flatten() {
        *v = same.get(*v as usize).copied().unwrap_or(*v);
    }
    surface
}

fn without_crumbs(surface: Surface) -> Surface {
    let component = components(&surface);
    let mut pieces = vec![(0_usize, 0.0_f64); surface.positions.len()];
    let area = |t: &[u32; 3]| 0.5 * area_normal(t.map(|v| surface.positions[v as usize].as_dvec3())).length();
    for (t, &c) in surface.triangles.iter().zip(&component) {
        let (faces, sum) = &mut pieces[c as usize];
        *faces += 1;
        *sum += area(t);
    }
    let largest = pieces.iter().map(|piece| piece.1).fold(0.0, f64::max);
    let stays = |c: &u32| pieces[*c as usize].0 >= CRUMB_FACES || pieces[*c as usize].1 >= CRUMB_AREA * largest;
    let kept = surface.triangles.iter().zip(&component).filter(|(_, c)| stays(c)).map(|(t, _)| *t);
    let triangles = kept.collect();
    compact(Surface { positions: surface.positions, triangles })
}

#[cfg(test)]
mod tests {
    use glam::Vec3;

    use super::*;

    const ALL: Tidying = Tidying { triangles: 10_000, drops_crumbs: true, closes_holes: true };

    /// `n`² squares of two triangles each, without those for which `leaves_out` is true; every triangle has its own
    /// vertices.
    fn sheet(n: u32, leaves_out: impl Fn(u32, u32) -> bool) -> Surface {
        let mut surface = Surface::default();
        for (x, y) in (0..n).flat_map(|y| (0..n).map(move |x| (x, y))).filter(|&(x, y)| !leaves_out(x, y)) {
            for corners in [[[0, 0], [1, 0], [1, 1]], [[0, 0], [1, 1], [0, 1]]] {
                let first = surface.positions.len() as u32;
                let place = |[a, b]: [u32; 2]| Vec3::new((x + a) as f32 / n as f32, (y + b) as f32 / n as f32, -0.0);
                surface.positions.extend(corners.map(place));
                surface.triangles.push([first, first + 1, first + 2]);
            }
        }
        surface
    }

    #[test]
    fn a_soup_with_a_hole_and_crumbs_is_made_whole() {
        let mut soup = sheet(20, |x, y| (9..11).contains(&x) && (9..11).contains(&y));
        let (whole, broken) = (soup.triangles.len(), [[0, 1, 1], [0, 1, 999_999]]);
        let first = soup.positions.len() as u32;
        soup.positions.extend([[2.0, 0.0, 0.0], [2.01, 0.0, 0.0], [2.0, 0.01, 0.0], [f32::NAN; 3]].map(Vec3::from));
        soup.triangles.extend([[first, first + 1, first + 2], [0, 1, first + 3]]);
        soup.triangles.extend(broken);
        let (tidied, stats) = tidy(soup.clone(), ALL).unwrap();
        assert_eq!((stats.extracted, stats.cleaned, stats.holes), (whole + 4, whole, 1));
        assert!(tidied.triangles.len() > whole && stats.simplified == tidied.triangles.len());
        assert!(tidied.positions.len() < 21 * 21 + 5 && tidied.positions.iter().all(|p| p.is_finite() && p.x <= 1.0));
        assert!(tidy(soup.clone(), Tidying { triangles: 100, ..ALL }).unwrap().0.triangles.len() <= 100);
        // Each step can be enabled separately.
        for (drops_crumbs, closes_holes) in [(true, false), (false, true)] {
            let (_, stats) = tidy(soup.clone(), Tidying { drops_crumbs, closes_holes, ..ALL }).unwrap();
            let expected = (whole + usize::from(!drops_crumbs), usize::from(closes_holes));
            assert_eq!((stats.cleaned, stats.holes), expected);
        }
        let (_, stats) = tidy(soup, Tidying { drops_crumbs: false, closes_holes: false, ..ALL }).unwrap();
        assert_eq!((stats.cleaned, stats.holes, stats.simplified), (whole + 1, 0, whole + 1));
    }

    #[test]
    fn few_large_triangles_are_no_crumbs() {
        let mut two = sheet(1, |_, _| false);
        let first = two.positions.len() as u32;
        two.positions.extend(sheet(1, |_, _| false).positions.iter().map(|p| *p + Vec3::X * 3.0));
        two.triangles.extend([[first, first + 1, first + 2], [first + 3, first + 4, first + 5]]);
        assert_eq!(tidy(two, ALL).unwrap().1.simplified, 4);
        // A hundred and fifty equal pieces are no crumbs either.
        let mut many = Surface::default();
        for i in 0..150_u32 {
            let square = sheet(1, |_, _| false);
            many.positions.extend(square.positions.iter().map(|p| *p + Vec3::X * 2.0 * i as f32));
            many.triangles.extend(square.triangles.iter().map(|t| t.map(|v| v + 6 * i)));
        }
        assert_eq!(tidy(many, ALL).unwrap().1.cleaned, 300);
        let nothing = Surface { positions: vec![Vec3::ZERO; 3], triangles: vec![[0, 1, 2]] };
        assert!(matches!(tidy(nothing, ALL), Err(GeometryError::EmptySurface { step: "cleaning", .. })));
        assert!(tidy(Surface::default(), ALL).is_err());
    }
}
