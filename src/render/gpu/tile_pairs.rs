//! (tile, splat) pairs: for every tile of a view, its splats by depth.

use super::{
    device::{Buffer, Frame, Gpu, GpuError, Stage},
    scan::{DispatchSizes, Items, Scan},
    sort::{self, Sort},
};

/// Words of the buffer of counts: splats, visible splats, pairs, pairs that fit.
pub(super) const COUNT_SPLATS: u32 = 0;
pub(super) const COUNT_VISIBLE: u32 = 1;
pub(super) const COUNT_PAIRS: u32 = 2;
pub(super) const COUNT_STORED_PAIRS: u32 = 3;

/// Splats or pairs per workgroup of these stages.
pub(super) const PER_GROUP: usize = 256;

/// Inputs from which pairs are made.
pub(super) struct InView<'a> {
    /// The view's uniform.
    pub(super) view: &'a Buffer,
    /// `[4]`, see [`COUNT_SPLATS`].
    pub(super) counts: &'a Buffer,
    /// Visible splats, by depth.
    pub(super) splats: &'a Buffer,
    /// Number of tiles touched, `[splat]`.
    pub(super) tile_count: &'a Buffer,
    /// Laid out as `SplatLists::projected`.
    pub(super) projected: &'a Buffer,
}

/// Pairs of tiles and splats, sorted by tile and depth.
pub(crate) struct TilePairs {
    /// Range of each tile, `[tiles]` vec2u: its first pair, and the one after its last.
    pub(crate) ranges: Buffer,
    /// Splat and number of each pair, `[pair]` vec2u; empty except in training.
    pub(super) numbered: Buffer,
    /// First number of each visible splat, by depth.
    pub(super) offsets: Buffer,
    capacity: usize,
    sizes: DispatchSizes,
    gather: Stage,
    place: Scan,
    emit: Stage,
    sort: Sort,
    find_ranges: Stage,
}

impl TilePairs {
    /// Room for `capacity` pairs of up to this many tiles and splats. With `numbers`, pairs are numbered, those of a
    /// splat consecutively.
    ///
    /// # Errors
    /// If the adapter cannot hold them.
    pub(super) fn new(
        gpu: &Gpu,
        in_view: &InView,
        (tiles, splats): (usize, usize),
        capacity: usize,
        numbers: bool,
    ) -> Result<Self, GpuError> {
        let &InView { view, counts, splats: by_depth, tile_count, projected } = in_view;
        let sorted_count = gpu.storage("sorted tile counts", splats)?;
        let offsets = gpu.storage("pair offsets", splats)?;
        // One more range, which holds the number of pairs.
        let ranges = gpu.storage("tile ranges", (tiles + 1) * 2)?;
        let bits = usize::BITS - tiles.leading_zeros(); // one key more than tiles
        let sort = Sort::new(gpu, capacity, bits, counts, COUNT_STORED_PAIRS)?;
        let kept = if numbers { capacity } else { 0 };
        let splat_of = gpu.storage("splats of pairs", kept)?;
        let numbered = gpu.storage("numbers of pairs", 2 * kept)?;
        let mut emitted =
            vec![view, counts, by_depth, &offsets, tile_count, projected, sort.keys_in(), sort.values_in()];
        let mut ordered = vec![view, counts, sort.keys_out(), &ranges];
        if numbers {
            emitted.push(&splat_of);
            ordered.extend([sort.values_out(), &splat_of, &numbered]);
        }
        let defines = gpu
            .defines()
            .with("TRAIN", u32::from(numbers))
            .with("COUNT_VISIBLE", COUNT_VISIBLE)
            .with("COUNT_PAIRS", COUNT_PAIRS)
            .with("COUNT_STORED_PAIRS", COUNT_STORED_PAIRS);
        let stage = |file: &str, buffers: &[&Buffer]| Stage::new(gpu, file, "main", &defines, buffers);
        Ok(Self {
            sizes: DispatchSizes::new(gpu, capacity, &[PER_GROUP, sort::BLOCK], counts, COUNT_STORED_PAIRS)?,
            gather: stage("gather_counts.wgsl", &[counts, by_depth, tile_count, &sorted_count]),
            place: Scan::new(gpu, splats, &sorted_count, &offsets, counts, COUNT_VISIBLE, COUNT_PAIRS)?,
            emit: stage("emit_pairs.wgsl", &emitted),
            find_ranges: stage("tile_ranges.wgsl", &ordered),
            ranges,
            numbered,
            offsets,
            capacity,
            sort,
        })
    }

    /// Appends the making of pairs to a frame that has cleared [`Self::ranges`] and made the inputs. `visible` are
    /// sizes for the visible splats, including workgroups of [`PER_GROUP`] and of [`Scan::block`].
    pub(super) fn record(&self, frame: &mut Frame, visible: &DispatchSizes) {
        visible.dispatch(frame, &self.gather, PER_GROUP);
        self.place.record(frame, Items::Counted(visible));
        visible.dispatch(frame, &self.emit, PER_GROUP);
        self.sizes.record(frame);
        self.sort.record(frame, &self.sizes);
        self.sizes.dispatch(frame, &self.find_ranges, PER_GROUP);
    }

    /// Splat of every pair.
    pub(crate) fn splats(&self) -> &Buffer {
        self.sort.values_out()
    }

    /// Capacity for pairs.
    pub(crate) fn capacity(&self) -> usize {
        self.capacity
    }
}
