//! Processing of many splats in bounded memory: the next block is read or computed while the previous one is used.

use std::io::{self, Read};

use rayon::prelude::*;

use super::error::Fault;

/// Approximate number of bytes read at once.
pub(super) const BLOCK_BYTES: usize = 4 << 20;

/// Processes `count` rows in blocks: `fill` gets a number of rows, at most `per_block`, and a buffer to fill; `visit`
/// gets the index of the first row and the bytes.
pub(super) fn in_blocks(
    count: usize,
    per_block: usize,
    mut fill: impl FnMut(usize, &mut Vec<u8>) -> Result<(), Fault> + Send,
    mut visit: impl FnMut(usize, &[u8]) -> Result<(), Fault> + Send,
) -> Result<(), Fault> {
    let (mut current, mut next) = (vec![], vec![]);
    let (mut first, mut rows) = (0, count.min(per_block));
    fill(rows, &mut current)?;
    while first < count {
        let behind = (count - first - rows).min(per_block);
        let (visited, filled) =
            rayon::join(|| visit(first, &current), || if behind > 0 { fill(behind, &mut next) } else { Ok(()) });
        visited?;
        filled?;
        std::mem::swap(&mut current, &mut next);
        (first, rows) = (first + rows, behind);
    }
    Ok(())
}

/// Reads `count` rows of `stride` bytes each from `file`, whose current position is `offset`, and calls `visit` with
/// the index of the first row and the bytes of each block.
pub(super) fn read_in_blocks(
    file: &mut (impl Read + Send),
    offset: u64,
    (count, stride): (usize, usize),
    mut visit: impl FnMut(usize, std::slice::ChunksExact<'_, u8>) + Send,
) -> Result<(), Fault> {
    let mut at = offset;
    let fill = |rows: usize, bytes: &mut Vec<u8>| {
        bytes.resize(rows * stride, 0);
        file.read_exact(bytes).map_err(|e| Fault::unreadable(at, &e))?;
        at += bytes.len() as u64;
        Ok(())
    };
    in_blocks(count, (BLOCK_BYTES / stride).max(1), fill, |first, bytes| {
        visit(first, bytes.chunks_exact(stride));
        Ok(())
    })
}

/// Computes the items `0..count` in parallel, and passes them on one by one in order.
pub(super) fn in_waves<T: Send>(
    count: usize,
    make: impl Fn(usize) -> T + Sync,
    mut consume: impl FnMut(T) -> io::Result<()> + Send,
) -> io::Result<()> {
    let width = 2 * rayon::current_num_threads();
    let wave = |start: usize| -> Vec<T> { (start..count.min(start + width)).into_par_iter().map(&make).collect() };
    let (mut current, mut start) = (wave(0), width);
    while !current.is_empty() {
        let (next, consumed) = rayon::join(|| wave(start), || current.into_iter().try_for_each(&mut consume));
        consumed?;
        (current, start) = (next, start + width);
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_row_comes_once_and_in_order() {
        for (count, per_block) in [(0, 5), (1, 5), (5, 5), (17, 5), (4, 1)] {
            let (mut filled, mut seen) = (0u8, vec![]);
            let fill = |rows: usize, bytes: &mut Vec<u8>| {
                assert!(rows <= per_block);
                bytes.clear();
                bytes.extend((0..rows).map(|i| filled + i as u8));
                filled += rows as u8;
                Ok(())
            };
            let visit = |first: usize, bytes: &[u8]| {
                assert_eq!(bytes.first().map(|&b| usize::from(b)), (first < count).then_some(first));
                seen.extend_from_slice(bytes);
                Ok(())
            };
            in_blocks(count, per_block, fill, visit).unwrap();
            assert!(seen.iter().map(|&b| usize::from(b)).eq(0..count), "{count} {per_block}: {seen:?}");
            let mut made = vec![];
            let consume = |i: usize| {
                made.push(i);
                Ok(())
            };
            in_waves(count, |i| i, consume).unwrap();
            assert!(made.into_iter().eq(0..count));
        }
        let failed =
            in_blocks(9, 2, |_, _| Ok(()), |first, _| if first == 4 { Err(Fault::whole("a", "b")) } else { Ok(()) });
        assert!(failed.is_err());
        assert!(in_waves(90, |i| i, |i| if i == 50 { Err(io::Error::other("full")) } else { Ok(()) }).is_err());
    }
}
