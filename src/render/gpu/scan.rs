//! Prefix sums on the GPU (`shaders/scan.wgsl`), and the size of dispatches whose length only the GPU knows.

use super::device::{Buffer, Frame, Gpu, GpuError, Stage, groups};

/// Threads per workgroup.
const THREADS: usize = 256;

/// Arguments of indirect dispatches that cover a number of items kept in a GPU buffer.
pub(crate) struct DispatchSize {
    compute: Stage,
    size: Buffer,
}

impl DispatchSize {
    /// For `counts[count_word]` items, at most `capacity`, in workgroups of `block`.
    pub(crate) fn new(
        gpu: &Gpu,
        capacity: usize,
        block: usize,
        counts: &Buffer,
        count_word: u32,
    ) -> Result<Self, GpuError> {
        let defines = gpu.defines().with("COUNT_WORD", count_word).with("BLOCK", block as u32);
        let size = gpu.storage_with("dispatch size", &[0, 0, 0, capacity as u32])?;
        let compute = Stage::new(gpu, "dispatch_size.wgsl", "main", &defines, &[counts, &size]);
        Ok(Self { compute, size })
    }

    /// Computes the size from the count as it is at this point of the frame.
    pub(crate) fn record(&self, frame: &mut Frame) {
        frame.dispatch(&self.compute, 1);
    }

    /// Dispatches `stage` with it.
    pub(crate) fn dispatch(&self, frame: &mut Frame, stage: &Stage) {
        frame.dispatch_indirect(stage, &self.size);
    }
}

/// Exclusive prefix sum of u32.
pub(crate) struct Scan {
    size: DispatchSize,
    sum_blocks: Stage,
    scan_sums: Stage,
    scan_blocks: Stage,
}

impl Scan {
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
        // Software adapters pay for every barrier, not for idle lanes: long runs per thread.
        let per_thread = if gpu.profile().is_cpu { 64 } else { 8 };
        let block = THREADS * per_thread;
        let defines = gpu
            .defines()
            .with("COUNT_WORD", count_word)
            .with("TOTAL_WORD", total_word)
            .with("PER_THREAD", per_thread as u32);
        let block_sums = gpu.storage("scan block sums", groups(capacity, block))?;
        let buffers = [counts, input, &block_sums, output];
        let stage = |entry| Stage::new(gpu, "scan.wgsl", entry, &defines, &buffers);
        Ok(Self {
            size: DispatchSize::new(gpu, capacity, block, counts, count_word)?,
            sum_blocks: stage("sum_blocks"),
            scan_sums: stage("scan_sums"),
            scan_blocks: stage("scan_blocks"),
        })
    }

    /// Appends the scan to a frame.
    pub(crate) fn record(&self, frame: &mut Frame) {
        self.size.record(frame);
        self.size.dispatch(frame, &self.sum_blocks);
        frame.dispatch(&self.scan_sums, 1);
        self.size.dispatch(frame, &self.scan_blocks);
    }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg32;

    use super::*;

    #[test]
    fn scan_equals_a_running_sum() {
        // Folded into rows of 10 workgroups, as more than 65,535 would be.
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
        let size = DispatchSize::new(&gpu, capacity as usize, 256, &counts, 0).unwrap();
        for items in [0, 1, 256, 257, 256 * widest, 256 * widest + 1, 400_000_000, capacity, u32::MAX] {
            gpu.write(&counts, 0, &[items]);
            let mut frame = Frame::new(&gpu);
            size.record(&mut frame);
            frame.submit();
            let [x, y, z] = gpu.read::<u32>(&size.size, 3).unwrap()[..] else { unreachable!() };
            let needed = items.min(capacity).div_ceil(256);
            assert!(x <= widest && y <= widest && z == 1, "{items}: {x} {y} {z}");
            assert!((needed..needed + widest).contains(&(x * y)), "{items}: {x} {y}");
            // Kernels take rows for that wide.
            assert!(y == 1 || x == widest, "{items}: {x} {y}");
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
        scan.record(&mut frame);
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
        for n in [0, 1, 255, 2047, 2048, 2049, 16_383, 16_385, 100_000, capacity] {
            gpu.write(&output, 0, &vec![u32::MAX; capacity]);
            gpu.write(&counts, 0, &[7, n as u32, 8, 9]);
            let mut frame = Frame::new(gpu);
            scan.record(&mut frame);
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
