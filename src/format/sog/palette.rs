//! Vector quantisation: cells are split where the error is largest, then Lloyd's algorithm runs among neighbours.
//!
//! Plain k-means compares every vector with each of 65,536 centroids. Here cells are halved, as in k-d trees, until
//! each is allotted at most [`GROUP`] entries; only within such a group are vectors compared with all centroids. The
//! cost of an iteration is linear in the number of vectors regardless of the palette's size, and the result is
//! deterministic.

use rayon::prelude::*;

/// Largest number of entries of a group.
const GROUP: usize = 64;
/// Upper bound on iterations; most groups end sooner.
const ITERATIONS: usize = 12;
/// Exponent: entries are shared in proportion to the squared error to this power. d/(d+2) is optimal for d-dimensional
/// data, and the coefficients of trained splats vary in few dimensions, here taken as 6.
const SHARE: f64 = 0.75;
/// Upper bound on nested halvings. Even halves of a billion take 30; the rest is for outliers, which are split off one
/// by one.
const MAX_DEPTH: u32 = 256;

/// SH coefficients above coefficient 0 of splats, one vector of `dims` floats each.
#[derive(Clone, Copy)]
pub(super) struct Vectors<'a> {
    /// SH coefficients of all splats including coefficient 0, splat-major, RGB.
    pub(super) sh: &'a [f32],
    pub(super) dims: usize,
}

impl Vectors<'_> {
    fn row(&self, i: u32) -> &[f32] {
        &self.sh[i as usize * (self.dims + 3) + 3..][..self.dims]
    }
}

/// Palette vectors `[K·dims]`, and per splat the index of the vector nearest to its own.
pub(super) struct Palette {
    pub(super) entries: Vec<f32>,
    pub(super) labels: Vec<u16>,
}

/// Palette of at most `most` (1 to 65,536) entries for `count` vectors.
pub(super) fn palette(vectors: Vectors<'_>, count: usize, most: usize) -> Palette {
    let mut members: Vec<u32> = (0..count as u32).collect();
    let spread = Spread::of(vectors, &members);
    let entries = most.clamp(1, 1 << 16).min(count.max(1));
    let groups = groups(vectors, Cell { members: &mut members, spread, entries, depth: 0 });
    let mut palette = Palette { entries: vec![], labels: vec![0; count] };
    for group in groups {
        let first = palette.entries.len() / vectors.dims;
        for (&member, label) in group.members.iter().zip(group.labels) {
            palette.labels[member as usize] = (first + usize::from(label)) as u16;
        }
        palette.entries.extend(group.centroids);
    }
    palette
}

/// Mean of some vectors, and their squared error about it along each axis.
struct Spread {
    mean: Vec<f64>,
    error: Vec<f64>,
}

impl Spread {
    fn of(vectors: Vectors<'_>, members: &[u32]) -> Self {
        // Sums over fixed chunks in fixed order: independent of the number of threads.
        let sums: Vec<_> = members.par_chunks(1 << 14).map(|chunk| sums(vectors, chunk)).collect();
        let n = members.len().max(1) as f64;
        let (mut mean, mut error) = (vec![0.0; vectors.dims], vec![0.0; vectors.dims]);
        for (sum, squares) in sums {
            mean.iter_mut().zip(sum).for_each(|(total, part)| *total += part);
            error.iter_mut().zip(squares).for_each(|(total, part)| *total += part);
        }
        for (mean, error) in mean.iter_mut().zip(&mut error) {
            *mean /= n;
            *error = (*error - n * *mean * *mean).max(0.0);
        }
        Self { mean, error }
    }
}

fn sums(vectors: Vectors<'_>, members: &[u32]) -> (Vec<f64>, Vec<f64>) {
    let (mut sum, mut squares) = (vec![0.0; vectors.dims], vec![0.0; vectors.dims]);
    for &member in members {
        for ((&v, sum), squares) in vectors.row(member).iter().zip(&mut sum).zip(&mut squares) {
            let v = f64::from(v);
            *sum += v;
            *squares += v * v;
        }
    }
    (sum, squares)
}

/// Partitions `members` about the mean of the axis with the largest error, lower ones first; returns their number: 0 if
/// all members are alike, to the precision of the sums.
fn partition(vectors: Vectors<'_>, members: &mut [u32], spread: &Spread) -> usize {
    let Some(axis) = (0..vectors.dims).max_by(|&a, &b| spread.error[a].total_cmp(&spread.error[b])) else { return 0 };
    let mut low = 0;
    for i in 0..members.len() {
        if f64::from(vectors.row(members[i])[axis]) < spread.mean[axis] {
            members.swap(low, i);
            low += 1;
        }
    }
    low
}

/// Vectors to which a number of entries is allotted, at most one each.
struct Cell<'m> {
    members: &'m mut [u32],
    spread: Spread,
    entries: usize,
    /// Number of halvings that led to the cell.
    depth: u32,
}

impl<'m> Cell<'m> {
    /// Halves the cell and shares its entries between the halves by error; returns the cell itself if it cannot be
    /// halved.
    fn halve(self, vectors: Vectors<'_>) -> Result<[Self; 2], Self> {
        let whole = self.entries < 2 || self.depth == MAX_DEPTH;
        let low = if whole { 0 } else { partition(vectors, self.members, &self.spread) };
        if low == 0 || low == self.members.len() {
            return Err(self);
        }
        let (a, b) = self.members.split_at_mut(low);
        let (spread_a, spread_b) = (Spread::of(vectors, a), Spread::of(vectors, b));
        let [due_a, due_b] = [&spread_a, &spread_b].map(|spread| spread.error.iter().sum::<f64>().powf(SHARE));
        let part = if due_a + due_b > 0.0 { due_a / (due_a + due_b) } else { 0.5 };
        let least = self.entries.saturating_sub(b.len()).max(1);
        let most = (self.entries - 1).min(a.len());
        let entries_a = ((self.entries as f64 * part).round() as usize).clamp(least, most);
        let entries_b = self.entries - entries_a;
        let depth = self.depth + 1;
        Ok([
            Self { members: a, spread: spread_a, entries: entries_a, depth },
            Self { members: b, spread: spread_b, entries: entries_b, depth },
        ])
    }
}

/// Neighbouring entries and the vectors that they represent.
struct Group<'m> {
    members: &'m [u32],
    /// Indices into `centroids`, one per member.
    labels: Vec<u8>,
    centroids: Vec<f32>,
}

fn groups<'m>(vectors: Vectors<'_>, cell: Cell<'m>) -> Vec<Group<'m>> {
    if cell.entries <= GROUP {
        return vec![lloyd(vectors, cell)];
    }
    match cell.halve(vectors) {
        Err(cell) => vec![lloyd(vectors, Cell { entries: 1, ..cell })],
        Ok([a, b]) => {
            let (mut groups_a, groups_b) = rayon::join(|| groups(vectors, a), || groups(vectors, b));
            groups_a.extend(groups_b);
            groups_a
        }
    }
}

/// Initial centroids: the means of the cell's parts, halved until each is allotted one entry.
fn first_centroids(vectors: Vectors<'_>, cell: Cell<'_>, centroids: &mut Vec<f32>) {
    match cell.halve(vectors) {
        Err(cell) => centroids.extend(cell.spread.mean.iter().map(|&m| m as f32)),
        Ok(halves) => halves.into_iter().for_each(|half| first_centroids(vectors, half, centroids)),
    }
}

fn lloyd<'m>(vectors: Vectors<'_>, cell: Cell<'m>) -> Group<'m> {
    let dims = vectors.dims;
    let mut centroids = vec![];
    let Cell { members, spread, entries, depth } = cell;
    first_centroids(vectors, Cell { members: &mut *members, spread, entries, depth }, &mut centroids);
    let members: &[u32] = members;
    let mut labels = vec![u8::MAX; members.len()];
    for _ in 0..ITERATIONS {
        let mut moved = false;
        let mut sums = vec![0.0f64; centroids.len()];
        let mut counts = vec![0usize; centroids.len() / dims];
        for (&member, label) in members.iter().zip(&mut labels) {
            let row = vectors.row(member);
            let nearest = nearest(row, &centroids, dims);
            moved |= nearest != *label;
            *label = nearest;
            counts[usize::from(nearest)] += 1;
            let sums = &mut sums[usize::from(nearest) * dims..][..dims];
            sums.iter_mut().zip(row).for_each(|(sum, &v)| *sum += f64::from(v));
        }
        if !moved {
            break;
        }
        for ((centroid, sums), &count) in centroids.chunks_exact_mut(dims).zip(sums.chunks_exact(dims)).zip(&counts) {
            if count > 0 {
                centroid.iter_mut().zip(sums).for_each(|(c, sum)| *c = (sum / count as f64) as f32);
            }
        }
    }
    Group { members, labels, centroids }
}

/// Index of the centroid with the least squared distance to `row`; the first one if there are several.
fn nearest(row: &[f32], centroids: &[f32], dims: usize) -> u8 {
    let mut best = (f32::INFINITY, 0);
    for (i, centroid) in centroids.chunks_exact(dims).enumerate() {
        // Eight partial sums, because a single sum would have to be added in order.
        let mut lanes = [0.0f32; 8];
        let ((rows, row_rest), (cs, c_rest)) = (row.as_chunks::<8>(), centroid.as_chunks::<8>());
        for (r, c) in rows.iter().zip(cs) {
            for (lane, (r, c)) in lanes.iter_mut().zip(r.iter().zip(c)) {
                *lane += (r - c) * (r - c);
            }
        }
        let rest: f32 = row_rest.iter().zip(c_rest).map(|(r, c)| (r - c) * (r - c)).sum();
        let distance = lanes.iter().sum::<f32>() + rest;
        if distance < best.0 {
            best = (distance, i);
        }
    }
    best.1 as u8
}

#[cfg(test)]
mod tests {
    use rand::{RngExt as _, SeedableRng as _};
    use rand_pcg::Pcg64Mcg;

    use super::*;

    fn error(vectors: Vectors<'_>, palette: &Palette) -> f64 {
        let squares = palette.labels.iter().enumerate().map(|(i, &label)| {
            let entry = &palette.entries[usize::from(label) * vectors.dims..][..vectors.dims];
            vectors.row(i as u32).iter().zip(entry).map(|(a, b)| f64::from(a - b).powi(2)).sum::<f64>()
        });
        squares.sum::<f64>() / palette.labels.len() as f64
    }

    #[test]
    fn separate_clusters_are_found_whatever_the_count() {
        let mut rng = Pcg64Mcg::seed_from_u64(3);
        let centers: Vec<f32> = (0..300 * 24).map(|_| rng.random_range(-1.0..1.0)).collect();
        let mut sh = vec![];
        for i in 0..6000 {
            sh.extend([9.0; 3]);
            sh.extend(centers[(i % 300) * 24..][..24].iter().map(|c| c + rng.random_range(-1e-3..1e-3f32)));
        }
        let vectors = Vectors { sh: &sh, dims: 24 };
        let many = palette(vectors, 6000, 512);
        assert!(many.entries.len() <= 512 * 24);
        // Each cluster is a cube with side 2e-3: variance 1e-6/3 along each of 24 axes.
        assert!(error(vectors, &many) < 1.5 * 24.0 * 1e-6 / 3.0, "{:e}", error(vectors, &many));
        let few = palette(vectors, 6000, 16);
        assert!(few.entries.len() == 16 * 24 && error(vectors, &few) > error(vectors, &many));
        // Without any splitting the error would be 24 variances of 1/3.
        assert!(error(vectors, &few) < 8.0, "{}", error(vectors, &few));
    }

    #[test]
    fn alike_and_few_vectors() {
        let alike = vec![0.5; 12 * 1000];
        let one = palette(Vectors { sh: &alike, dims: 9 }, 1000, 512);
        assert_eq!((one.entries, one.labels), (vec![0.5; 9], vec![0; 1000]));
        let distinct: Vec<f32> = (0..12 * 5).map(|i| i as f32).collect();
        let vectors = Vectors { sh: &distinct, dims: 9 };
        assert_eq!(error(vectors, &palette(vectors, 5, 5)), 0.0);
        assert!(palette(vectors, 0, 1).labels.is_empty());
    }
}
