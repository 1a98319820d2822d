//! Gaps that a selection of triangles leaves in a surface.

use std::collections::HashMap;

/// Marks `[F]` the triangles that are not `selected`, in groups that share edges, where a group is of at most `most`
/// triangles and selected ones are all around it: none of its edges is one of the surface. Indices may be any.
pub(crate) fn gaps(triangles: &[[u32; 3]], selected: &[bool], most: usize) -> Vec<bool> {
    let edges = |t: &[u32; 3]| [[t[0], t[1]], [t[1], t[2]], [t[2], t[0]]].map(|[a, b]| [a.min(b), a.max(b)]);
    let mut sharing: HashMap<[u32; 2], Vec<usize>> = HashMap::new();
    for (face, t) in triangles.iter().enumerate() {
        edges(t).into_iter().for_each(|edge| sharing.entry(edge).or_default().push(face));
    }
    let mut is_gap = vec![false; triangles.len()];
    let mut seen = selected.to_vec();
    for first in 0..triangles.len() {
        if std::mem::replace(&mut seen[first], true) {
            continue;
        }
        let (mut group, mut next, mut is_open, mut is_beside) = (vec![first], 0, false, false);
        while let Some(&face) = group.get(next) {
            next += 1;
            for edge in edges(&triangles[face]) {
                // Whoever is beside it joins this group now.
                let Some(faces) = sharing.remove(&edge) else { continue };
                is_open |= faces.len() == 1;
                is_beside |= faces.iter().any(|&face| selected[face]);
                group.extend(faces.iter().filter(|&&face| !std::mem::replace(&mut seen[face], true)));
            }
        }
        if is_beside && !is_open && group.len() <= most {
            group.into_iter().for_each(|face| is_gap[face] = true);
        }
    }
    is_gap
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Squares of two triangles each, `n` by `n`.
    fn squares(n: u32) -> Vec<[u32; 3]> {
        let corner = |x: u32, y: u32| y * (n + 1) + x;
        (0..n * n)
            .map(|i| (i % n, i / n))
            .flat_map(|(x, y)| {
                let [a, b, c, d] = [corner(x, y), corner(x + 1, y), corner(x, y + 1), corner(x + 1, y + 1)];
                [[a, b, d], [a, d, c]]
            })
            .collect()
    }

    #[test]
    fn small_groups_that_are_enclosed_are_gaps() {
        let triangles = squares(5);
        let of = |left_out: &[usize], most| -> Vec<usize> {
            let selected: Vec<bool> = (0..triangles.len()).map(|face| !left_out.contains(&face)).collect();
            let found = gaps(&triangles, &selected, most);
            (0..found.len()).filter(|&face| found[face]).collect()
        };
        // The square in the middle, and half of one at a corner of it, which shares no edge with it.
        assert_eq!(of(&[24, 25, 37], 2), [24, 25, 37]);
        assert_eq!(of(&[24, 25, 37], 1), [37]);
        // At the border of the surface nothing is enclosed.
        assert_eq!(of(&[0, 1, 2, 3], 9), [0; 0]);
        assert_eq!(of(&[22, 24, 25], 9), [22, 24, 25]);
        assert_eq!((of(&[], 9), of(&(0..50).collect::<Vec<_>>(), 99)), (vec![], vec![]));
    }

    #[test]
    fn a_closed_surface_that_is_left_out_whole_is_no_gap() {
        let tetrahedron = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]];
        assert_eq!(gaps(&tetrahedron, &[false; 4], 9), [false; 4]);
        assert_eq!(gaps(&tetrahedron, &[true, true, true, false], 9), [false, false, false, true]);
    }
}
