//! Prefix sums on the GPU (`shaders/scan.wgsl`), and sizes of dispatches whose length only the GPU knows.

use super::device::{Buffer, Frame, Gpu, GpuError, Stage, groups};

/// Threads per workgroup.
const THREADS: usize = 256;

/// Arguments of indirect dispatches over a number of items kept in a GPU buffer, for workgroups of several sizes.
pub(crate) struct DispatchSizes {
    compute: Stage,
    sizes: Buffer,
    blocks: Vec<usize>,
}

impl DispatchSizes {
    /// Sizes for `counts[count_word]` items, at most `capacity`, in workgroups of any of `blocks` (at most four).
    pub(crate) fn new(
        gpu: &Gpu,
        capacity: usize,
        blocks: &[usize],
        counts: &Buffer,
        count_word: u32,
    ) -> Result<Self, GpuError> {
        assert!(blocks.len() <= 4, "a thread to each, see dispatch_sizes.wgsl");
        let defines = gpu.defines().with("COUNT_WORD", count_word);
        let sizes: Vec<[u32; 4]> = blocks.iter().map(|&block| [0, 0, 0, block as u32]).collect();
        let sizes = gpu.storage_with("dispatch sizes", &sizes)?;
        let most = gpu.storage_with("most items", &[capacity as u32])?;
        let compute = Stage::new(gpu, "dispatch_sizes.wgsl", "main", &defines, &[counts, &sizes, &most]);
        Ok(Self { compute, sizes, blocks: blocks.to_vec() })
    }

    /// Appends the computation of sizes from the count at this point of the frame.
    pub(crate) fn record(&self, frame: &mut Frame) {
        frame.dispatch(&self.compute, 1);
    }

    /// Dispatches `stage`, whose workgroups take `block` items each; `block` must be one of those given to
    /// [`Self::new`].
    pub(crate) fn dispatch(&self, frame: &mut Frame, stage: &Stage, block: usize) {
        let place = self.blocks.iter().position(|&b| b == block).expect("sizes are for workgroups of that many");
        frame.dispatch_indirect(stage, &self.sizes, place);
    }
}

/// Number of items that a stage runs over.
#[derive(Clone, Copy)]
pub(crate) enum Items<'a> {
    /// Known on the host.
    Known(usize),
    /// Counted on the GPU.
    Counted(&'a DispatchSizes),
}

impl Items<'_> {
    /// Dispatches `stage`, whose workgroups take `block` items each.
    fn dispatch(self, frame: &mut Frame, stage: &Stage, block: usize) {
        match self {
            Self::Known(items) => frame.dispatch(stage, groups(items, block)),
            Self::Counted(sizes) => sizes.dispatch(frame, stage, block),
        }
    }
}

/// Exclusive prefix sum of u32 on the GPU.
pub(crate) struct Scan {
    block: usize,
    sum_blocks: Stage,
    scan_sums: Stage,
    scan_blocks: Stage,
}

impl Scan {
    /// Items per workgroup.
    pub(crate) fn block(gpu: &Gpu) -> usize {
        THREADS * per_thread(gpu)
    }

    /// Scans the first `counts[count_word]` (≤ `capacity`) words of `input` into `output`, another buffer, and writes
    /// the total to `counts[total_word]`.
    ///
    /// # Errors
    /// If the adapter cannot hold the block sums.
    pub(crate) fn new(
        gpu: &Gpu,
        capacity: usize,
        input: &Buffer,
        output: &Buffer,
        counts: &Buffer,
        count_word: u32,
        total_word: u32,
    ) -> Result<Self, GpuError> {
        let block = Self::block(gpu);
        let defines = gpu
            .defines()
            .with("COUNT_WORD", count_word)
            .with("TOTAL_WORD", total_word)
            .with("PER_THREAD", per_thread(gpu) as u32);
        let block_sums = gpu.storage("scan block sums", groups(capacity, block))?;
        let buffers = [counts, input, &block_sums, output];
        let stage = |entry| Stage::new(gpu, "scan.wgsl", entry, &defines, &buffers);
        Ok(Self {
            block,
            sum_blocks: stage("sum_blocks"),
            scan_sums: stage("scan_sums"),
            scan_blocks: stage("scan_blocks"),
        })
    }

    /// Appends the scan of `items`, which must be as many as are counted.
    pub(crate) fn record(&self, frame: &mut Frame, items: Items) {
        items.dispatch(frame, &self.sum_blocks, self.block);
        frame.dispatch(&self.scan_sums, 1);
        items.dispatch(frame, &self.scan_blocks, self.block);
    }
}

/// Items per thread: software adapters pay for every barrier, not for idle lanes, so runs per thread are long.
fn per_thread(gpu: &Gpu) -> usize {
    if gpu.profile().is_cpu { 64 } else { 8 }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg32;

    use super::*;

    #[test]
    fn scan_equals_a_running_sum() {
        // Folded into rows of 10 workgroups, as dispatches of more than 65,535 are.
        for gpu in [Gpu::open(None).unwrap(), Gpu::open(None).unwrap().narrowed(10)] {
            check(&gpu);
        }
    }

    #[test]
    fn no_row_of_workgroups_is_wider_than_allowed() {
        let gpu = Gpu::open(None).unwrap();
        let widest = gpu.widest_dispatch();
        let counts = gpu.storage("counts", 1).unwrap();
        let capacity = u32::MAX / 2;
        let sizes = DispatchSizes::new(&gpu, capacity as usize, &[2048, 256], &counts, 0).unwrap();
        for items in [0, 1, 256, 257, 256 * widest, 256 * widest + 1, 400_000_000, capacity, u32::MAX] {
            gpu.write(&counts, 0, &[items]);
            let mut frame = Frame::new(&gpu);
            sizes.record(&mut frame);
            frame.submit();
            let found = gpu.read::<u32>(&sizes.sizes, 8).unwrap();
            for ([x, y, z, block], expected) in found.as_chunks().0.iter().copied().zip([2048, 256]) {
                assert!(
                    x <= widest && y <= widest && z == 1 && block == expected,
                    "{items}: {x} {y} {z}, {block} each"
                );
                let needed = items.min(capacity).div_ceil(block);
                assert!((needed..needed + widest).contains(&(x * y)), "{items}: {x} {y}");
                // Kernels assume rows of this width.
                assert!(y == 1 || x == widest, "{items}: {x} {y}");
            }
        }
    }

    #[test]
    fn sums_beyond_32_bits_do_not_come_round() {
        let gpu = Gpu::open(None).unwrap();
        let n = 100_000;
        let input = gpu.storage_with("input", &vec![90_000u32; n]).unwrap();
        let output = gpu.storage("output", n).unwrap();
        let counts = gpu.storage_with("counts", &[0, n as u32, 0, 0]).unwrap();
        let scan = Scan::new(&gpu, n, &input, &output, &counts, 1, 3).unwrap();
        let mut frame = Frame::new(&gpu);
        scan.record(&mut frame, Items::Known(n));
        frame.submit();
        let expected: Vec<u32> = (0..n as u64).map(|i| (90_000 * i).min(u64::from(u32::MAX)) as u32).collect();
        assert!(gpu.read::<u32>(&output, n).unwrap() == expected);
        assert_eq!(gpu.read::<u32>(&counts, 4).unwrap()[3], u32::MAX);
    }

    fn check(gpu: &Gpu) {
        let mut rng = Pcg32::seed_from_u64(1);
        let capacity = 4_300_000; // more than 256 blocks on any adapter: the middle kernel loops
        let values: Vec<u32> = (0..capacity).map(|_| rng.random_range(0..1000)).collect();
        let input = gpu.storage_with("input", &values).unwrap();
        let output = gpu.storage("output", capacity).unwrap();
        let counts = gpu.storage("counts", 4).unwrap();
        let scan = Scan::new(gpu, capacity, &input, &output, &counts, 1, 3).unwrap();
        let sizes = DispatchSizes::new(gpu, capacity, &[Scan::block(gpu)], &counts, 1).unwrap();
        for n in [0, 1, 255, 2047, 2048, 2049, 16_383, 16_385, 100_000, capacity] {
            gpu.write(&output, 0, &vec![u32::MAX; capacity]);
            gpu.write(&counts, 0, &[7, n as u32, 8, 9]);
            let mut frame = Frame::new(gpu);
            sizes.record(&mut frame);
            // Every other count is given by the host.
            let items = if n % 2 == 0 { Items::Known(n) } else { Items::Counted(&sizes) };
            scan.record(&mut frame, items);
            frame.submit();
            let mut sum = 0;
            let mut expected = vec![];
            for v in &values[..n] {
                expected.push(sum);
                sum += v;
            }
            expected.resize(capacity, u32::MAX);
            assert!(gpu.read::<u32>(&output, capacity).unwrap() == expected, "{n} elements");
            assert_eq!(gpu.read::<u32>(&counts, 4).unwrap(), [7, n as u32, 8, sum]);
        }
    }
}
