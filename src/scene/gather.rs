use super::{Splats, sh};

/// Selects the splats of these indices, in their order. An index may be repeated. Ascending indices, or a permutation
/// of all, are applied in place.
///
/// # Panics
/// If an index is out of range.
#[must_use]
pub fn gather(splats: Splats, indices: &[usize]) -> Splats {
    let order = Order::of(indices, splats.len());
    let mut s = splats.into_arrays();
    order.apply(&mut s.means, 1);
    order.apply(&mut s.rotations, 1);
    order.apply(&mut s.log_scales, 1);
    order.apply(&mut s.opacity_logits, 1);
    order.apply(&mut s.sh, sh::coefficients(s.sh_degree));
    s.check().expect("copies of valid splats are valid")
}

/// Leaves the rows of these indices, which ascend, of `width` elements each.
///
/// # Panics
/// If an index is out of range.
pub(crate) fn keep_rows<T: Copy>(rows: &mut Vec<T>, width: usize, ascending: impl Iterator<Item = usize>) {
    let mut kept = 0;
    for row in ascending {
        rows.copy_within(row * width..(row + 1) * width, kept * width);
        kept += 1;
    }
    rows.truncate(kept * width);
}

/// Indices, and what they allow to do in place.
enum Order<'a> {
    Ascending(&'a [usize]),
    Permutation(&'a [usize]),
    Any(&'a [usize]),
}

impl<'a> Order<'a> {
    fn of(indices: &'a [usize], count: usize) -> Self {
        if indices.is_sorted_by(|a, b| a < b) {
            return Self::Ascending(indices);
        }
        let mut seen = vec![false; count];
        let once = indices.iter().all(|&i| !std::mem::replace(&mut seen[i], true));
        if once && indices.len() == count { Self::Permutation(indices) } else { Self::Any(indices) }
    }

    /// Replaces rows of `width` elements each by the rows of these indices.
    fn apply<T: Copy>(&self, rows: &mut Vec<T>, width: usize) {
        let row = |i: usize| i * width..(i + 1) * width;
        match *self {
            Self::Ascending(indices) => {
                keep_rows(rows, width, indices.iter().copied());
                rows.shrink_to_fit();
            }
            Self::Permutation(indices) => {
                let mut placed = vec![false; indices.len()];
                for start in 0..indices.len() {
                    if placed[start] {
                        continue;
                    }
                    // Follows the cycle: each row makes room for the one that moves there.
                    let first = rows[row(start)].to_vec();
                    let mut to = start;
                    while indices[to] != start {
                        rows.copy_within(row(indices[to]), to * width);
                        placed[to] = true;
                        to = indices[to];
                    }
                    rows[row(to)].copy_from_slice(&first);
                    placed[to] = true;
                }
            }
            Self::Any(indices) => *rows = indices.iter().flat_map(|&i| &rows[row(i)]).copied().collect(),
        }
    }
}
