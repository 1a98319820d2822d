use glam::{DVec3, Vec2, Vec3};
use rayon::prelude::*;

use super::{Contraction, GeometryError, Shell, Surface, charts, pack, surface::area_normal};
use crate::scene::Texture;

/// Width of the widest gutters, texels: the eight texels between two charts are two in the third mip level, where
/// bilinear samples of the charts still share none.
pub const WIDEST_GUTTER: u32 = 4;

/// A surface with texture coordinates for one square atlas.
#[derive(Clone, Debug, PartialEq)]
pub struct UnwrappedMesh {
    /// `[V]` world positions, as given.
    pub positions: Vec<Vec3>,
    /// `[F]` vertex indices, as given.
    pub triangles: Vec<[u32; 3]>,
    /// `[F]` UV of each corner in [0, 1].
    pub corner_uvs: Vec<[Vec2; 3]>,
    /// Quality of the atlas.
    pub stats: UnwrapStats,
}

/// Quality of an atlas.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct UnwrapStats {
    /// Number of charts.
    pub charts: usize,
    /// Texels around each chart that belong to no other; two charts are twice as far apart. With 0 they are just far
    /// enough apart for bilinear samples to share no texel.
    pub gutter: u32,
    /// Texels per world unit where the surface is parallel to its chart's plane, and where charts are not laid out in
    /// contracted space.
    pub texels_per_unit: f64,
    /// Fraction of the atlas area inside triangles.
    pub coverage: f64,
    /// Texels of a triangle relative to those in proportion to its area, mean over the area; 1 is no stretch.
    pub mean_density: f64,
    /// The same ratio for the worst triangle.
    pub min_density: f64,
}

/// Contracted space in which charts are laid out instead of the world: far content then has as many texels per pixel as
/// what the cameras look at.
#[derive(Clone, Copy, Debug)]
pub struct ChartSpace {
    /// Contraction whose ball ends at the cameras' distance.
    contraction: Contraction,
    /// Shell, if only that is contracted.
    shell: Option<Shell>,
}

impl ChartSpace {
    /// Space for an unbounded surface, all of which is contracted.
    #[must_use]
    pub fn unbounded(contraction: Contraction) -> Self {
        // A quarter of twice the cameras' distance to the focus: half their distance.
        Self { contraction: Contraction { radius: 0.25 * contraction.radius, ..contraction }, shell: None }
    }

    /// Space for a bounded surface with a shell, of which only the shell is contracted: within, cameras may be as near
    /// to anything as to what they look at.
    #[must_use]
    pub fn within_shell(contraction: Contraction, shell: Shell) -> Self {
        Self { shell: Some(shell), ..Self::unbounded(contraction) }
    }

    /// Position at which a world point is laid out.
    pub(super) fn place(&self, p: DVec3) -> DVec3 {
        let is_contracted = self.shell.is_none_or(|shell| shell.holds(p.as_vec3()));
        if is_contracted { self.contraction.contract(p) } else { p }
    }
}

/// Unwraps a surface: cuts it into charts, projects each onto its plane and packs them into an atlas of `atlas_size`²
/// texels with gutters. Charts grow to 60° from their seed's normal and are split where they would overlap; no chart is
/// mirrored. Positions and triangles are kept as they are; a triangle with two coincident corners gets UV 0 at all of
/// them. Deterministic.
///
/// With `charts_in`, areas and shapes are those in that space. Gutters are up to `widest_gutter` texels on each side,
/// at most [`WIDEST_GUTTER`], where that costs little resolution; see [`UnwrapStats::gutter`].
///
/// # Errors
/// If there is no triangle, an index is out of range, a position is not finite, `atlas_size` is not in
/// 16..=[`Texture::MAX_SIDE`], or the charts do not fit even with the narrowest gutters.
pub fn unwrap(
    surface: &Surface,
    charts_in: Option<&ChartSpace>,
    atlas_size: u32,
    widest_gutter: u32,
) -> Result<UnwrappedMesh, GeometryError> {
    if !(16..=Texture::MAX_SIDE).contains(&atlas_size) {
        return Err(GeometryError::argument("atlas_size", format!("16 to {} texels", Texture::MAX_SIDE), &atlas_size));
    }
    if surface.triangles.is_empty() {
        return Err(GeometryError::argument("triangles", "at least one triangle", &"none"));
    }
    let mut corners = corner_positions(surface)?;
    if let Some(space) = charts_in {
        corners.iter_mut().flatten().for_each(|p| *p = space.place(*p));
    }
    let areas: Vec<f64> = corners.par_iter().map(|t| area_normal(*t).length() / 2.0).collect();
    // A scale for surfaces without any area.
    let area = areas.iter().sum::<f64>().max(f64::MIN_POSITIVE.sqrt());
    let side = f64::from(atlas_size);
    // Packings cover some 60 % of the atlas.
    let texel = (area / 0.6).sqrt() / side;
    let longest = 0.9 * side * texel;
    let mut charts = charts::cut(corners, texel, longest);
    charts.par_iter_mut().for_each(|chart| pack::straighten(chart, longest));
    let packing = loop {
        let packing = pack::pack(&charts, area, atlas_size as usize, widest_gutter as usize)
            .ok_or(GeometryError::AtlasTooSmall { charts: charts.len(), atlas_size })?;
        // Splits off overlaps too narrow for the charts' own test, but not for the final texels: they are few, and a
        // split triangle cannot overlap again.
        let mut split = charts::split_overlaps(&mut charts, |chart, p| packing.places[chart].apply(p * packing.scale));
        if split.is_empty() {
            break packing;
        }
        split.iter_mut().for_each(|chart| pack::straighten(chart, longest));
        charts.extend(split);
    };

    let mut corner_uvs = vec![[Vec2::ZERO; 3]; surface.triangles.len()];
    let (mut covered, mut min_density) = (0.0, f64::INFINITY);
    for (chart, place) in charts.iter().zip(&packing.places) {
        for (&face, triangle) in chart.faces.iter().zip(&chart.corners) {
            let texels = triangle.map(|p| place.apply(p * packing.scale));
            corner_uvs[face as usize] = texels.map(|p| (p / side).as_vec2());
            let texel_area = (texels[1] - texels[0]).perp_dot(texels[2] - texels[0]) / 2.0;
            covered += texel_area;
            let deserved = areas[face as usize] * packing.scale * packing.scale;
            if deserved > 1e-6 {
                min_density = f64::min(min_density, texel_area / deserved);
            }
        }
    }
    let stats = UnwrapStats {
        charts: charts.len(),
        gutter: packing.gutter as u32,
        texels_per_unit: packing.scale,
        coverage: covered / (side * side),
        mean_density: covered / (area * packing.scale * packing.scale),
        min_density: min_density.min(1.0),
    };
    Ok(UnwrappedMesh { positions: surface.positions.clone(), triangles: surface.triangles.clone(), corner_uvs, stats })
}

fn corner_positions(surface: &Surface) -> Result<Vec<[DVec3; 3]>, GeometryError> {
    let position = |face: usize, v: u32| match surface.positions.get(v as usize) {
        Some(p) if p.is_finite() => Ok(p.as_dvec3()),
        Some(p) => Err(GeometryError::argument(format!("positions[{v}]"), "finite numbers", &p)),
        None => {
            let expected = format!("indices below {}", surface.positions.len());
            Err(GeometryError::argument(format!("triangles[{face}]"), expected, &v))
        }
    };
    let corners =
        |(face, t): (usize, &[u32; 3])| Ok([position(face, t[0])?, position(face, t[1])?, position(face, t[2])?]);
    surface.triangles.iter().enumerate().map(corners).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec2;
    use rand::{RngExt, SeedableRng};

    /// A closed, bumpy surface without handles but with a folded outline, of about 2·n² triangles.
    fn bumpy_sphere(n: u32, noise: f32) -> Surface {
        let mut rng = rand_pcg::Pcg64::seed_from_u64(7);
        let ring = 2 * n;
        let mut positions = Vec::new();
        for i in 0..=n {
            for j in 0..ring {
                let (theta, phi) =
                    (std::f32::consts::PI * i as f32 / n as f32, std::f32::consts::PI * j as f32 / n as f32);
                let p = Vec3::new(theta.sin() * phi.cos(), theta.cos(), theta.sin() * phi.sin());
                let r = 1.0 + 0.15 * (5.0 * p.x).sin() * (4.0 * p.y + 1.0).sin() + noise * (rng.random::<f32>() - 0.5);
                // Each pole is a single point.
                positions.push(if i == 0 || i == n { Vec3::new(0.0, p.y, 0.0) } else { p * r });
            }
        }
        let triangles = (0..n)
            .flat_map(|i| (0..ring).map(move |j| (i * ring + j, i * ring + (j + 1) % ring)))
            .flat_map(|(a, b)| [[a, b, b + ring], [a, b + ring, a + ring]])
            .collect();
        Surface { positions, triangles }
    }

    /// Owner of each texel centre, asserting that no two triangles share one; `u32::MAX` if there is none.
    fn rasterize(mesh: &UnwrappedMesh, size: usize) -> Vec<u32> {
        let mut owner = vec![u32::MAX; size * size];
        for (f, uvs) in (0u32..).zip(&mesh.corner_uvs) {
            assert!(uvs.iter().all(|uv| uv.min_element() >= 0.0 && uv.max_element() <= 1.0), "{f}: {uvs:?}");
            let [a, b, c] = uvs.map(|uv| uv.as_dvec2() * size as f64);
            let (low, high) = (a.min(b).min(c), a.max(b).max(c));
            for y in low.y as usize..=(high.y as usize).min(size - 1) {
                for x in low.x as usize..=(high.x as usize).min(size - 1) {
                    let p = DVec2::new(x as f64 + 0.5, y as f64 + 0.5);
                    let side = |s: DVec2, e: DVec2| (e - s).perp_dot(p - s);
                    // 1e-3 texels² inside: rounding UVs to f32 moves shared edges by 1e-4 texels.
                    if side(a, b).min(side(b, c)).min(side(c, a)) > 1e-3 {
                        assert_eq!(owner[y * size + x], u32::MAX, "texel {x} {y} lies in two triangles");
                        owner[y * size + x] = f;
                    }
                }
            }
        }
        owner
    }

    /// Chart of each triangle, where charts consist of triangles that share a UV edge bit by bit.
    fn chart_ids(mesh: &UnwrappedMesh) -> Vec<usize> {
        let mut chart: Vec<usize> = (0..mesh.corner_uvs.len()).collect();
        fn root(chart: &mut [usize], mut i: usize) -> usize {
            while chart[i] != i {
                chart[i] = chart[chart[i]];
                i = chart[i];
            }
            i
        }
        let mut at = std::collections::HashMap::new();
        for (f, uvs) in mesh.corner_uvs.iter().enumerate() {
            for uv in uvs {
                let other = *at.entry(uv.to_array().map(f32::to_bits)).or_insert(f);
                let (a, b) = (root(&mut chart, f), root(&mut chart, other));
                chart[a.max(b)] = a.min(b);
            }
        }
        (0..chart.len()).map(|f| root(&mut chart, f)).collect()
    }

    fn check(surface: &Surface, size: u32) -> UnwrapStats {
        let mesh = unwrap(surface, None, size, WIDEST_GUTTER).unwrap();
        assert_eq!((mesh.positions.len(), &mesh.triangles), (surface.positions.len(), &surface.triangles));
        let size = size as usize;
        let owner = rasterize(&mesh, size);
        let charts = chart_ids(&mesh);
        let gap = 2 * mesh.stats.gutter as usize;
        for y in 0..size {
            for x in 0..size {
                let f = owner[y * size + x];
                if f == u32::MAX {
                    continue;
                }
                // All texels up to `gap` rows below and columns to either side; rows above have been checked already.
                for j in y..(y + gap + 1).min(size) {
                    for i in x.saturating_sub(gap)..(x + gap + 1).min(size) {
                        let g = owner[j * size + i];
                        let same = g == u32::MAX || charts[f as usize] == charts[g as usize];
                        assert!(same, "texel {x} {y} and {i} {j} are of two charts");
                    }
                }
            }
        }
        mesh.stats
    }

    #[test]
    fn charts_do_not_overlap_and_keep_their_gutter() {
        for (size, noise, min_coverage) in [(512, 0.0, 0.5), (512, 0.02, 0.4), (1024, 0.0, 0.5)] {
            let stats = check(&bumpy_sphere(60, noise), size);
            eprintln!("{size}, noise {noise}: {stats:?}");
            // If there is room for the gutter.
            assert!(stats.gutter >= 1 && (size < 1024 || stats.gutter == 4), "{stats:?}");
            assert!(stats.coverage > min_coverage, "{stats:?}");
            assert!(stats.mean_density > 0.75 && stats.min_density > 0.2, "{stats:?}");
        }
    }

    #[test]
    fn a_plane_is_one_chart_without_stretch() {
        let positions: Vec<Vec3> = (0..400).map(|i| Vec3::new((i % 20) as f32, 3.0, (i / 20) as f32)).collect();
        let triangles =
            (0..380u32).filter(|i| i % 20 != 19).flat_map(|i| [[i, i + 20, i + 1], [i + 1, i + 20, i + 21]]).collect();
        let stats = check(&Surface { positions, triangles }, 256);
        assert_eq!(stats.charts, 1);
        assert!((stats.min_density - 1.0).abs() < 1e-6 && stats.coverage > 0.9, "{stats:?}");
    }

    #[test]
    fn one_sliver_takes_no_texels_from_others() {
        let plane: Vec<Vec3> = (0..400).map(|i| Vec3::new((i % 20) as f32, 3.0, (i / 20) as f32)).collect();
        let squares: Vec<_> =
            (0..380u32).filter(|i| i % 20 != 19).flat_map(|i| [[i, i + 20, i + 1], [i + 1, i + 20, i + 21]]).collect();
        // Along an axis, and in a general direction.
        for along in [Vec3::X, Vec3::new(0.8, 0.6, 0.0), Vec3::new(0.3, 0.2, 0.9).normalize()] {
            let across = along.any_orthonormal_vector();
            let sliver = |width: f32| [Vec3::ZERO, along * 1e6, across * width];
            let (mut positions, mut triangles) = (plane.clone(), squares.clone());
            positions.extend(sliver(1e-4));
            triangles.push([400, 401, 402]);
            let stats = check(&Surface { positions, triangles }, 256);
            assert!(stats.charts == 2 && stats.coverage > 0.5, "{along} {stats:?}");
            // Also if the sliver is the only triangle, or has no area.
            for width in [1e-4, 0.0] {
                check(&Surface { positions: sliver(width).to_vec(), triangles: vec![[0, 1, 2]] }, 64);
            }
        }
        // Three collinear corners, no two of them coincident.
        let line = [1.0, 2.0, 3.0].map(|i| i * 2f32.powi(70) * Vec3::new(1.0, 2.0, 3.0));
        check(&Surface { positions: line.to_vec(), triangles: vec![[0, 1, 2]] }, 64);
    }

    /// If two triangles overlap by a fifth of a texel, one is moved only if a texel centre is in both.
    #[test]
    fn overlaps_are_those_that_final_texels_see() {
        let corners = |c: [[f64; 2]; 3]| c.map(DVec2::from);
        let (left, right) = (corners([[0., 0.], [1.1, 0.], [1.1, 4.]]), corners([[0.9, 0.], [3., 0.], [0.9, 4.]]));
        for (shift, left_over) in [(0.0, 0), (0.5, 1), (0.25, 0)] {
            let mut charts = [charts::Chart { faces: vec![7, 9], corners: vec![left, right] }];
            let alone = charts::split_overlaps(&mut charts, |_, p| p + DVec2::new(shift, 0.0));
            assert_eq!((alone.len(), charts[0].faces.len()), (left_over, 2 - left_over), "{shift}");
        }
    }

    #[test]
    fn a_spiral_staircase_is_split_where_it_overlaps() {
        // Three turns, all facing up: in a single projection they would overlap.
        let mut positions = Vec::new();
        for i in 0..=180u8 {
            let a = f32::from(i) * 6.0f32.to_radians();
            for r in [0.5, 1.0] {
                positions.push(Vec3::new(r * a.cos(), a * 0.1, r * a.sin()));
            }
        }
        let triangles =
            (0..180u32).flat_map(|i| [2 * i, 2 * i + 1].map(|a| [a, a + 1 + (a % 2), a + 2 - (a % 2)])).collect();
        let stats = check(&Surface { positions, triangles }, 256);
        assert!((3..12).contains(&stats.charts), "{stats:?}");
    }

    #[test]
    fn charts_of_what_is_far_have_as_many_texels_to_a_pixel() {
        let ball = Contraction { center: DVec3::new(1.0, -2.0, 0.5), radius: 3.0 };
        // Cameras are at half the radius from the centre.
        let charts = ChartSpace::unbounded(ball).contraction;
        for distance in [300.0, 1e6] {
            let p = ball.center + DVec3::X * distance;
            let texels = charts.along(p, DVec3::Y).length();
            // A texel that is as large as a pixel at the centre is as large as a pixel here too.
            assert!((texels * distance / (0.5 * ball.radius) - 1.0).abs() < 0.01);
        }
    }

    /// Two squares of equal image size for a camera 3 in front of the centre, at distances 3 and 303.
    #[test]
    fn contracted_charts_have_the_texels_that_pixels_ask_for() {
        let square = |z: f32, side: f32| {
            [(-1., -1.), (1., -1.), (1., 1.), (-1., 1.)].map(|(x, y)| Vec3::new(x * side, y * side, z))
        };
        let positions: Vec<Vec3> = square(0.0, 0.7).into_iter().chain(square(300.0, 70.7)).collect();
        let surface = Surface { positions, triangles: vec![[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]] };
        let ratio = |charts_in: Option<&ChartSpace>| {
            let uvs = unwrap(&surface, charts_in, 256, WIDEST_GUTTER).unwrap().corner_uvs;
            let area = |f: usize| {
                let [a, b, c] = uvs[f];
                (b - a).perp_dot(c - a).abs()
            };
            (area(2) + area(3)) / (area(0) + area(1))
        };
        let charts = ChartSpace::unbounded(Contraction { center: DVec3::ZERO, radius: 6.0 });
        let (contracted, in_world) = (ratio(Some(&charts)), ratio(None));
        assert!((0.6..1.6).contains(&contracted) && in_world > 1000.0, "{contracted} {in_world}");
    }

    #[test]
    fn broken_and_degenerate_input() {
        let p = vec![Vec3::ZERO, Vec3::X, Vec3::Y, Vec3::Z, Vec3::NAN];
        let of = |triangles: Vec<[u32; 3]>| Surface { positions: p.clone(), triangles };
        assert!(matches!(unwrap(&of(vec![]), None, 64, WIDEST_GUTTER), Err(GeometryError::Argument(_))));
        assert!(matches!(unwrap(&of(vec![[0, 1, 5]]), None, 64, WIDEST_GUTTER), Err(GeometryError::Argument(_))));
        assert!(matches!(unwrap(&of(vec![[0, 1, 4]]), None, 64, WIDEST_GUTTER), Err(GeometryError::Argument(_))));
        assert!(matches!(unwrap(&of(vec![[0, 1, 2]]), None, 8, WIDEST_GUTTER), Err(GeometryError::Argument(_))));
        // Without area; repeated; flipped; three at one edge; opposite directions.
        check(&of(vec![[0, 0, 0]; 3]), 64);
        check(&of(vec![[0, 1, 2]; 3]), 128);
        check(&of(vec![[0, 1, 2], [0, 2, 1], [0, 1, 3], [1, 0, 3], [0, 1, 1], [2, 3, 0]]), 128);
        let far = Surface { positions: p[..3].iter().map(|p| p * 1e30).collect(), triangles: vec![[0, 1, 2]] };
        check(&far, 64);
        let tiny = Surface { positions: p[..3].iter().map(|p| p * 1e-30).collect(), triangles: vec![[0, 1, 2]] };
        check(&tiny, 64);
    }

    #[test]
    fn a_soup_fits_or_is_refused() {
        let mut rng = rand_pcg::Pcg64::seed_from_u64(3);
        let mut soup = |count: u32| Surface {
            positions: (0..3 * count).map(|_| Vec3::from_array(rng.random::<[f32; 3]>())).collect(),
            triangles: (0..count).map(|i| [3 * i, 3 * i + 1, 3 * i + 2]).collect(),
        };
        assert_eq!(check(&soup(300), 512).charts, 300);
        let dense = check(&soup(4000), 512);
        assert!(dense.gutter < 4, "{dense:?}");
        assert!(matches!(
            unwrap(&soup(40_000), None, 256, WIDEST_GUTTER),
            Err(GeometryError::AtlasTooSmall { charts: 40_000, .. })
        ));
    }

    #[test]
    fn the_same_surface_gives_the_same_atlas() {
        let surface = bumpy_sphere(40, 0.02);
        assert_eq!(
            unwrap(&surface, None, 256, WIDEST_GUTTER).unwrap(),
            unwrap(&surface, None, 256, WIDEST_GUTTER).unwrap()
        );
    }
}
