use std::collections::{HashMap, HashSet};

use glam::{DVec3, Vec3};
use meshopt::{SimplifyOptions, VertexDataAdapter};

use super::GeometryError;
use crate::scene::without_unused;

/// Bare geometry: positions `[V]` in world space and triangles `[F]` of indices into them, counter-clockwise from
/// outside. Unchecked: unwrapping refuses triangles with an index out of range, tidying drops them; other functions ask
/// for indices in range, and panic without.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Surface {
    /// World positions.
    pub positions: Vec<Vec3>,
    /// Vertex indices.
    pub triangles: Vec<[u32; 3]>,
}

/// Keeps the `keep_components` largest connected components (triangles that share a vertex) of at least
/// `min_component_faces` triangles. Drops broken triangles (index out of range, position not finite), triangles that
/// have no area or repeat another one's corners, and unused vertices. The order of what is kept does not change.
pub(super) fn clean(surface: Surface, min_component_faces: usize, keep_components: usize) -> Surface {
    let mut surface = without_broken(surface);
    let component = components(&surface);
    let mut faces = vec![0usize; surface.positions.len()];
    component.iter().for_each(|&c| faces[c as usize] += 1);
    let mut components: Vec<usize> = (0..faces.len()).filter(|&v| faces[v] >= min_component_faces.max(1)).collect();
    components.sort_by_key(|&v| (std::cmp::Reverse(faces[v]), v));
    components.truncate(keep_components);
    let mut kept = vec![false; faces.len()];
    components.iter().for_each(|&v| kept[v] = true);
    let mut of = component.iter();
    surface.triangles.retain(|_| of.next().is_some_and(|&c| kept[c as usize]));
    compact(surface)
}

/// Connected component `[F]` (triangles that share a vertex) of every triangle, named by its lowest vertex. Indices
/// must be in range.
#[must_use]
pub fn components(surface: &Surface) -> Vec<u32> {
    let mut parent: Vec<u32> = (0..surface.positions.len() as u32).collect();
    for t in &surface.triangles {
        for v in [t[1], t[2]] {
            let (a, b) = (root(&mut parent, t[0]), root(&mut parent, v));
            // The smaller index becomes the root, so that the result does not depend on the order of triangles.
            parent[a.max(b) as usize] = a.min(b);
        }
    }
    surface.triangles.iter().map(|t| root(&mut parent, t[0])).collect()
}

/// Simplifies to at most about `target_triangles` triangles, by edge collapse onto existing vertices (meshoptimizer).
/// Vertices marked in `keep`, `[V]` or fewer, stay. Topology is kept, so a surface of many pieces or holes may end
/// above the target; one below it is returned cleaned.
pub(super) fn simplify(surface: &Surface, keep: &[bool], target_triangles: usize) -> Surface {
    let (mut surface, used) = compacted(without_broken(surface.clone()));
    if surface.triangles.len() <= target_triangles {
        return surface;
    }
    let Ok(vertices) = VertexDataAdapter::new(bytemuck::cast_slice(&surface.positions), size_of::<Vec3>(), 0) else {
        return surface;
    };
    let mut locks: Vec<bool> = keep.iter().zip(used).filter_map(|(&k, used)| used.then_some(k)).collect();
    locks.resize(surface.positions.len(), false);
    let indices = meshopt::simplify_with_locks(
        bytemuck::cast_slice(&surface.triangles),
        &vertices,
        &locks,
        target_triangles.saturating_mul(3),
        f32::MAX,
        // Even triangles unwrap into charts with less stretch.
        SimplifyOptions::RegularizeLight,
        None,
    );
    surface.triangles = indices.chunks_exact(3).map(|t| [t[0], t[1], t[2]]).collect();
    compact(without_broken(surface))
}

/// As [`simplify`].
///
/// # Errors
/// If no triangle is left.
pub(super) fn simplified(surface: &Surface, keep: &[bool], target_triangles: usize) -> Result<Surface, GeometryError> {
    let simple = simplify(surface, keep, target_triangles);
    if simple.triangles.is_empty() {
        return Err(GeometryError::EmptySurface { step: "simplification", hint: "too few triangles were asked for" });
    }
    Ok(simple)
}

/// Normal of a triangle with these corners, as long as twice its area.
pub(super) fn area_normal([a, b, c]: [DVec3; 3]) -> DVec3 {
    (b - a).cross(c - a)
}

/// Root of `v` in a union-find forest, with path halving.
fn root(parent: &mut [u32], mut v: u32) -> u32 {
    while parent[v as usize] != v {
        let above = parent[parent[v as usize] as usize];
        parent[v as usize] = above;
        v = above;
    }
    v
}

/// Drops the triangles that [`clean`] counts as broken, degenerate or repeated.
pub(super) fn without_broken(mut surface: Surface) -> Surface {
    let positions = &surface.positions;
    surface.triangles.retain(|t| {
        let corner = |k: usize| positions.get(t[k] as usize).filter(|p| p.is_finite()).map(|p| p.as_dvec3());
        match (corner(0), corner(1), corner(2)) {
            (Some(a), Some(b), Some(c)) => area_normal([a, b, c]).length_squared() > 0.0,
            _ => false,
        }
    });
    let mut first_of: HashSet<[u32; 3]> = HashSet::new();
    surface.triangles.retain(|t| {
        let mut sorted = *t;
        sorted.sort_unstable();
        first_of.insert(sorted)
    });
    surface
}

/// Drops unused vertices. Every index must be in range.
#[must_use]
pub fn compact(surface: Surface) -> Surface {
    compacted(surface).0
}

/// Also which vertices are left.
fn compacted(mut surface: Surface) -> (Surface, Vec<bool>) {
    let (positions, used) = without_unused(&surface.positions, &mut surface.triangles);
    (Surface { positions, ..surface }, used)
}

/// Index of the first exactly coincident point, for every point `[N]`.
pub(super) fn first_at_place(points: impl Iterator<Item = DVec3>) -> Vec<u32> {
    let mut first = HashMap::new();
    // + 0.0 turns −0 into 0.
    (0..).zip(points).map(|(i, p)| *first.entry((p + 0.0).to_array().map(f64::to_bits)).or_insert(i)).collect()
}
