//! Stable radix sort of (u32 key, u32 value) pairs on the GPU (`shaders/radix_sort.wgsl`, or
//! `shaders/radix_sort_serial.wgsl` on software adapters).

use super::{
    device::{Buffer, Frame, Gpu, GpuError, Kernel, Stage, groups},
    scan::DispatchSizes,
};

/// Pairs per workgroup of `radix_sort.wgsl`.
pub(super) const BLOCK: usize = 2048;
/// Most bits of a key per pass.
const DIGIT_BITS: u32 = 8;
/// Most chunks of `radix_sort_serial.wgsl`, one per thread: enough for a few workgroups on each core, few enough that
/// scanning their 256 counters costs little.
const MAX_CHUNKS: usize = 256;

/// Choice between the two shaders.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Width {
    /// For many lanes: blocks, each sorted by all threads of a workgroup.
    Parallel,
    /// For few lanes: chunks, each processed by one thread.
    Serial,
}

impl Width {
    /// Choice for this many pairs. The serial shader is not used if its chunks would exceed the adapter's limit on
    /// loops.
    fn of(gpu: &Gpu, capacity: usize) -> Self {
        // A thread's passes besides those through its chunk: two through all digits.
        let longest = gpu.loop_passes().map_or(usize::MAX, |passes| passes - (2 << DIGIT_BITS));
        let is_serial = gpu.profile().is_cpu && capacity.div_ceil(MAX_CHUNKS) <= longest;
        if is_serial { Self::Serial } else { Self::Parallel }
    }
}

/// A sort of up to `capacity` pairs.
pub(crate) struct Sort {
    width: Width,
    passes: Vec<Pass>,
    keys: [Buffer; 2],
    values: [Buffer; 2],
}

/// One pass, which reads one pair of buffers and writes the other.
struct Pass {
    count: Stage,
    scan: Stage,
    scatter: Stage,
    /// Number of values of its digit.
    digits: usize,
}

impl Sort {
    /// Sorts the first `counts[count_word]` (≤ `capacity`) pairs by the lowest `bits` bits (1 to 32) of their keys.
    ///
    /// # Errors
    /// If the adapter cannot hold the buffers.
    pub(crate) fn new(
        gpu: &Gpu,
        capacity: usize,
        bits: u32,
        counts: &Buffer,
        count_word: u32,
    ) -> Result<Self, GpuError> {
        let width = Width::of(gpu, capacity);
        Self::with_width(gpu, capacity, bits, counts, count_word, width)
    }

    fn with_width(
        gpu: &Gpu,
        capacity: usize,
        bits: u32,
        counts: &Buffer,
        count_word: u32,
        width: Width,
    ) -> Result<Self, GpuError> {
        let defines = gpu
            .defines()
            .with("COUNT_WORD", count_word)
            .with("DIGITS", 1 << DIGIT_BITS)
            .with("BLOCK", BLOCK as u32)
            .with("MAX_CHUNKS", MAX_CHUNKS as u32);
        // The counts of all blocks together precede those of each.
        let (file, parts) = match width {
            Width::Parallel => ("radix_sort.wgsl", groups(capacity, BLOCK) + 1),
            Width::Serial => ("radix_sort_serial.wgsl", MAX_CHUNKS),
        };
        let kernels = ["count", "scan", "scatter"].map(|entry| Kernel::new(gpu, file, entry, &defines));
        let keys = [gpu.storage("sort keys", capacity)?, gpu.storage("sort keys", capacity)?];
        let values = [gpu.storage("sort values", capacity)?, gpu.storage("sort values", capacity)?];
        let histograms = gpu.storage("sort histograms", parts << DIGIT_BITS)?;

        let bits = bits.clamp(1, 32);
        let n_passes = bits.div_ceil(DIGIT_BITS);
        let per_pass = bits.div_ceil(n_passes);
        let mut passes = Vec::new();
        for pass in 0..n_passes {
            let shift = pass * per_pass;
            let here = per_pass.min(bits - shift);
            let uniform = gpu.uniform("sort digit", 4)?;
            gpu.write(&uniform, 0, &[shift, (1 << here) - 1, 0, 0]);
            let (from, to) = (pass as usize % 2, (pass as usize + 1) % 2);
            let buffers = [counts, &keys[from], &values[from], &keys[to], &values[to], &histograms, &uniform];
            let [count, scan, scatter] = kernels.each_ref().map(|kernel| kernel.bind(gpu, &buffers));
            passes.push(Pass { count, scan, scatter, digits: 1 << here });
        }
        Ok(Self { width, passes, keys, values })
    }

    /// Input keys, written by the caller.
    pub(crate) fn keys_in(&self) -> &Buffer {
        &self.keys[0]
    }

    /// Input values, written by the caller.
    pub(crate) fn values_in(&self) -> &Buffer {
        &self.values[0]
    }

    /// Sorted keys; may be the same buffer as `keys_in`.
    pub(crate) fn keys_out(&self) -> &Buffer {
        &self.keys[self.passes.len() % 2]
    }

    /// Values in the order of their keys; may be the same buffer as `values_in`.
    pub(crate) fn values_out(&self) -> &Buffer {
        &self.values[self.passes.len() % 2]
    }

    /// Appends the sort to a frame. `sizes` are those of the pairs, including workgroups of [`BLOCK`].
    pub(crate) fn record(&self, frame: &mut Frame, sizes: &DispatchSizes) {
        for Pass { count, scan, scatter, digits } in &self.passes {
            match self.width {
                Width::Parallel => {
                    sizes.dispatch(frame, count, BLOCK);
                    frame.dispatch(scan, *digits);
                    sizes.dispatch(frame, scatter, BLOCK);
                }
                Width::Serial => {
                    frame.dispatch_threads(count, MAX_CHUNKS);
                    frame.dispatch(scan, 1);
                    frame.dispatch_threads(scatter, MAX_CHUNKS);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg32;

    use super::*;

    /// Sorts `keys` with values 0, 1, … in buffers of `capacity` pairs and compares with a stable sort.
    fn check(gpu: &Gpu, width: Width, bits: u32, capacity: usize, lists: &[Vec<u32>]) {
        let counts = gpu.storage("counts", 4).unwrap();
        let sort = Sort::with_width(gpu, capacity, bits, &counts, 2, width).unwrap();
        let sizes = DispatchSizes::new(gpu, capacity, &[BLOCK], &counts, 2).unwrap();
        let mask = u32::MAX >> (32 - bits);
        for keys in lists {
            let values: Vec<u32> = (0..keys.len() as u32).collect();
            gpu.write(sort.keys_in(), 0, keys);
            gpu.write(sort.values_in(), 0, &values);
            gpu.write(&counts, 8, &[keys.len() as u32]);
            let mut frame = Frame::new(gpu);
            sizes.record(&mut frame);
            sort.record(&mut frame, &sizes);
            frame.submit();
            let mut expected = values;
            expected.sort_by_key(|&v| keys[v as usize] & mask);
            let found: Vec<u32> = gpu.read(sort.values_out(), keys.len()).unwrap();
            assert!(found == expected, "{width:?}, {bits} bits, {} pairs: order of values", keys.len());
            let found: Vec<u32> = gpu.read(sort.keys_out(), keys.len()).unwrap();
            let expected: Vec<u32> = expected.iter().map(|&v| keys[v as usize]).collect();
            assert!(found == expected, "{width:?}, {bits} bits, {} pairs: keys", keys.len());
        }
    }

    #[test]
    fn longer_lists_are_sorted_by_the_same_kernels() {
        let gpu = Gpu::open(None).unwrap();
        let counts = gpu.storage("counts", 4).unwrap();
        let compiled = [1000, 2000].map(|capacity| {
            Sort::new(&gpu, capacity, 13, &counts, 2).unwrap();
            gpu.n_kernels()
        });
        assert_eq!(compiled[0], compiled[1]);
    }

    /// `sort_is_stable_at_every_length` checks the result in either case.
    #[test]
    fn chunks_are_no_longer_than_loops_go_on() {
        let gpu = Gpu::open(None).unwrap().posing_as_cpu();
        assert_eq!(
            [1, 16_000_000, 17_000_000].map(|pairs| Width::of(&gpu, pairs)),
            [Width::Serial, Width::Serial, Width::Parallel]
        );
        assert_eq!(Width::of(&gpu.posing_as_gpu(), 1), Width::Parallel);
    }

    #[test]
    fn sort_is_stable_at_every_length() {
        let gpu = Gpu::open(None).unwrap();
        // The 147 blocks of the longest list are folded into 15 rows of 10, three of them in excess.
        let narrow = Gpu::open(None).unwrap().narrowed(10);
        let mut rng = Pcg32::seed_from_u64(2);
        let capacity = 300_000; // more than a full set of shortest chunks, and several rounds of the histogram scan
        let lengths = [0, 1, 2, 1023, 1025, 2047, 2048, 2049, 100_000, 299_999, 300_000];
        for width in [Width::Parallel, Width::Serial] {
            for bits in [32, 13, 3] {
                let mut lists: Vec<Vec<u32>> =
                    lengths.iter().map(|&n| (0..n).map(|_| rng.random()).collect()).collect();
                lists.push(vec![0xdead_beef; 5000]);
                // Keys as high as those that pad the last block.
                lists.push((0..5000).map(|i| if i % 3 == 0 { 7 } else { u32::MAX }).collect());
                lists.push((0..5000).rev().collect());
                check(&gpu, width, bits, capacity, &lists);
                if width == Width::Parallel {
                    check(&narrow, width, bits, capacity, &lists);
                }
            }
        }
    }
}
