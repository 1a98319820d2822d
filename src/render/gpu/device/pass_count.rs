//! Detection of submissions that the driver aborts. wgpu takes these for complete on Metal
//! (<https://github.com/gfx-rs/wgpu/issues/9545>), and reads would find what was there before.

use std::sync::{Mutex, OnceLock, PoisonError};

use super::{Buffer, Gpu, GpuError, Stage, error::LESS};
use crate::render::gpu::shader::Defines;

/// Number of compute passes that ran to their end: what the adapter counts and what the host expects. On Metal a pass
/// is what is aborted; elsewhere, but in tests, nothing is counted, and both stay 0.
pub(super) struct PassCount {
    /// As in `shaders/count_passes.wgsl`: the adapter's count, and the host's before and after the present submission.
    buffer: Buffer,
    /// Kernel that counts; compiled when the first pass ends.
    stage: OnceLock<Stage>,
    /// Passes submitted. Locked during a submission, so that all are counted in the order in which they run.
    submitted: Mutex<u32>,
}

impl PassCount {
    pub(super) fn new(device: &wgpu::Device) -> Self {
        Self { buffer: Buffer::uncounted(device, "pass count", 16), stage: OnceLock::new(), submitted: Mutex::new(0) }
    }

    /// Buffer that begins with the adapter's count, a word.
    pub(super) fn raw(&self) -> &wgpu::Buffer {
        &self.buffer.raw
    }
}

impl Gpu {
    /// Kernel that counts a pass: one workgroup, the last that the pass dispatches.
    pub(super) fn count_pass(&self) -> &Stage {
        let new = || Stage::new(self, "count_passes.wgsl", "main", &Defines::default(), &[&self.pass_count.buffer]);
        self.pass_count.stage.get_or_init(new)
    }

    /// Bytes of the adapter's count, 0 where passes are not counted.
    pub(super) fn pass_count_bytes(&self) -> u64 {
        if self.counts_passes { 4 } else { 0 }
    }

    /// Submits commands with this many counted passes. Returns what the adapter has counted after them unless something
    /// was aborted.
    pub(super) fn submit(&self, commands: wgpu::CommandBuffer, passes: u32) -> u32 {
        let mut submitted = self.pass_count.submitted.lock().unwrap_or_else(PoisonError::into_inner);
        let range = [*submitted, submitted.wrapping_add(passes)];
        if passes > 0 {
            // Written last: should the writes before a submission be aborted, this one is, and the passes do not count.
            self.queue.write_buffer(&self.pass_count.buffer.raw, 4, bytemuck::cast_slice(&range));
        }
        self.queue.submit([commands]);
        *submitted = range[1];
        range[1]
    }

    /// The error that a submission was aborted.
    pub(super) fn aborted(&self) -> GpuError {
        let reason =
            format!("a submission was aborted, as the driver ends work that takes too long or lacks memory: {LESS}");
        GpuError::Failed { adapter: self.adapter.clone(), reason }
    }

    /// Passes submitted so far.
    #[cfg(test)]
    pub(crate) fn passes(&self) -> u32 {
        *self.pass_count.submitted.lock().unwrap()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::render::gpu::device::Frame;

    fn counted(gpu: &Gpu) -> Buffer {
        gpu.storage_with("something", &[7_u32, 8]).unwrap()
    }

    #[test]
    fn frames_that_ran_are_read() {
        let gpu = Gpu::open(None).unwrap();
        // Numbers wrap around.
        *gpu.pass_count.submitted.lock().unwrap() = u32::MAX - 5;
        gpu.queue.write_buffer(gpu.pass_count.raw(), 0, &(u32::MAX - 5).to_ne_bytes());
        let (from, to) = (counted(&gpu), gpu.storage("copy", 2).unwrap());
        let stage =
            Stage::new(&gpu, "count_passes.wgsl", "main", &Defines::default(), &[&gpu.storage("other", 4).unwrap()]);
        for frames in 1..10 {
            for _ in 0..frames {
                let mut frame = Frame::new(&gpu);
                frame.dispatch(&stage, 1);
                frame.copy(&from, &to);
                frame.dispatch(&stage, 1);
                frame.submit();
            }
            assert_eq!(gpu.read::<u32>(&to, 2).unwrap(), [7, 8], "{frames} frames");
        }
        assert_eq!(gpu.passes(), (2 * 45 + 9) - 6, "two passes a frame, and one of every read");
    }

    #[test]
    fn nothing_is_read_after_an_aborted_submission() {
        // The host expects a pass that never ran; a pass that was submitted without what is written before it.
        let no_pass = |gpu: &Gpu| *gpu.pass_count.submitted.lock().unwrap() += 1;
        let no_writes = |gpu: &Gpu| {
            let mut encoder = gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
            let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
            gpu.count_pass().encode(&mut pass);
            pass.dispatch_workgroups(1, 1, 1);
            drop(pass);
            gpu.queue.submit([encoder.finish()]);
            *gpu.pass_count.submitted.lock().unwrap() += 1;
        };
        for abort in [&no_pass as &dyn Fn(&Gpu), &no_writes] {
            let gpu = Gpu::open(None).unwrap();
            let buffer = counted(&gpu);
            assert_eq!(gpu.read::<u32>(&buffer, 2).unwrap(), [7, 8]);
            abort(&gpu);
            // Nor by any read after that.
            for _ in 0..3 {
                Frame::new(&gpu).submit();
                let error = gpu.read::<u32>(&buffer, 2).unwrap_err().to_string();
                assert!(error.starts_with(&format!("{}: a submission was aborted, ", gpu.adapter())), "{error}");
                assert!(error.len() < 600 && error.contains(LESS), "{error}");
            }
        }
    }
}
