//! Recording of commands, and their timing.

use super::{Buffer, Gpu, GpuError, Stage};

/// Commands that are submitted together, or in the parts that [`Self::split`] makes.
pub(crate) struct Frame<'a> {
    gpu: &'a Gpu,
    encoder: wgpu::CommandEncoder,
    pass: Option<wgpu::ComputePass<'static>>,
    timer: Option<&'a mut Timer>,
    /// Passes recorded that the adapter counts (`pass_count.rs`).
    counted: u32,
    #[cfg(test)]
    dispatches: usize,
}

impl<'a> Frame<'a> {
    /// Starts recording.
    pub(crate) fn new(gpu: &'a Gpu) -> Self {
        Self {
            gpu,
            encoder: new_encoder(gpu),
            pass: None,
            timer: None,
            counted: 0,
            #[cfg(test)]
            dispatches: 0,
        }
    }

    /// Starts recording with a timestamp around every dispatch.
    pub(crate) fn timed(gpu: &'a Gpu, timer: &'a mut Timer) -> Self {
        timer.labels.clear();
        Self { timer: Some(timer), ..Self::new(gpu) }
    }

    /// Dispatches so far.
    #[cfg(test)]
    pub(crate) fn dispatches(&self) -> usize {
        self.dispatches
    }

    /// A pass in which the stage is what is dispatched next.
    fn pass(&mut self, stage: &Stage) -> &mut wgpu::ComputePass<'static> {
        #[cfg(test)]
        {
            self.dispatches += 1;
        }
        let pass = self.open_pass(&stage.kernel.label);
        stage.encode(pass);
        pass
    }

    /// Pass for the next dispatch; with a timer, one for it alone, timed as `label`.
    fn open_pass(&mut self, label: &str) -> &mut wgpu::ComputePass<'static> {
        if self.timer.as_ref().is_some_and(|timer| timer.has_room()) {
            self.end_pass();
        }
        if let Some(timer) = &mut self.timer
            && timer.has_room()
        {
            let i = 2 * timer.labels.len() as u32;
            timer.labels.push(label.to_owned());
            let pass = self.encoder.begin_compute_pass(&wgpu::ComputePassDescriptor {
                label: Some(label),
                timestamp_writes: Some(wgpu::ComputePassTimestampWrites {
                    query_set: &timer.queries,
                    beginning_of_pass_write_index: Some(i),
                    end_of_pass_write_index: Some(i + 1),
                }),
            });
            return self.pass.insert(pass.forget_lifetime());
        }
        self.untimed_pass()
    }

    /// The open pass, or else a new one that is not timed.
    fn untimed_pass(&mut self) -> &mut wgpu::ComputePass<'static> {
        let encoder = &mut self.encoder;
        self.pass.get_or_insert_with(|| {
            encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default()).forget_lifetime()
        })
    }

    /// Dispatches `groups` workgroups, folded into rows if they exceed one (see `group_index` in WGSL); the last row is
    /// padded to full width.
    pub(crate) fn dispatch(&mut self, stage: &Stage, groups: usize) {
        if groups == 0 {
            return;
        }
        let widest = self.gpu.widest_dispatch() as usize;
        let (x, y) = (groups.min(widest), groups.div_ceil(widest));
        self.pass(stage).dispatch_workgroups(x as u32, y as u32, 1);
    }

    /// Dispatches enough workgroups for this many threads.
    pub(crate) fn dispatch_threads(&mut self, stage: &Stage, threads: usize) {
        self.dispatch(stage, groups(threads, stage.kernel.threads));
    }

    /// Dispatches the number of workgroups in the first three of the four words at index `place` of `sizes`.
    pub(crate) fn dispatch_indirect(&mut self, stage: &Stage, sizes: &Buffer, place: usize) {
        self.pass(stage).dispatch_workgroups_indirect(&sizes.raw, 16 * place as u64);
    }

    /// Fills a buffer with zeros.
    pub(crate) fn clear(&mut self, buffer: &Buffer) {
        self.end_pass();
        self.encoder.clear_buffer(&buffer.raw, 0, None);
    }

    /// Copies the start of a buffer to that of another, as much as both hold.
    pub(crate) fn copy(&mut self, from: &Buffer, to: &Buffer) {
        self.end_pass();
        let bytes = from.raw.size().min(to.raw.size());
        self.encoder.copy_buffer_to_buffer(&from.raw, 0, &to.raw, 0, bytes);
    }

    /// Ends the open pass, if there is one, and has it counted.
    fn end_pass(&mut self) {
        if self.pass.is_some() {
            self.count_pass();
        }
        self.pass = None;
    }

    /// Appends the kernel that counts the open pass, or a pass of its own, on adapters whose passes are counted.
    fn count_pass(&mut self) {
        let gpu = self.gpu;
        if !gpu.counts_passes {
            return;
        }
        let pass = self.untimed_pass();
        let stage = gpu.count_pass();
        stage.encode(pass);
        pass.dispatch_workgroups(1, 1, 1);
        self.counted += 1;
    }

    /// Ends what is to be submitted together, with a pass that is counted, and resolves its times.
    fn close(&mut self) {
        self.count_pass();
        self.pass = None;
        if let Some(timer) = &mut self.timer {
            let count = 2 * timer.labels.len() as u32;
            self.encoder.resolve_query_set(&timer.queries, 0..count, &timer.resolved.raw, 0);
        }
    }

    /// Submits the commands so far on adapters where no submission may take long ([`Gpu::splits_frames`]); does nothing
    /// elsewhere, or with a timer. What is written to buffers from here on is there for the commands that follow alone:
    /// it must concern none of those before.
    pub(crate) fn split(&mut self) {
        if !self.gpu.splits_frames || self.timer.is_some() {
            return;
        }
        self.close();
        let commands = std::mem::replace(&mut self.encoder, new_encoder(self.gpu)).finish();
        self.gpu.submit(commands, std::mem::take(&mut self.counted));
    }

    /// Hands the commands to the adapter; does not wait.
    pub(crate) fn submit(mut self) {
        self.close();
        self.gpu.submit(self.encoder.finish(), self.counted);
    }
}

impl Gpu {
    /// Submits what was written to buffers.
    pub(super) fn submit_writes(&self) {
        Frame::new(self).submit();
    }

    /// Submits copies to `staging`, one behind the other: of this many bytes from the start of each buffer, and where
    /// passes are counted of the word that is the number of those that ran. Returns what that is unless a submission
    /// was aborted.
    pub(super) fn submit_copies<'b>(
        &'b self,
        parts: impl Iterator<Item = (&'b wgpu::Buffer, u64)>,
        staging: &wgpu::Buffer,
    ) -> u32 {
        let mut frame = Frame::new(self);
        frame.close();
        let Frame { mut encoder, counted, .. } = frame;
        let mut offset = 0;
        let ran = self.counts_passes.then(|| (self.pass_count.raw(), self.pass_count_bytes()));
        for (buffer, bytes) in parts.chain(ran) {
            encoder.copy_buffer_to_buffer(buffer, 0, staging, offset, bytes);
            offset += bytes;
        }
        self.submit(encoder.finish(), counted)
    }
}

fn new_encoder(gpu: &Gpu) -> wgpu::CommandEncoder {
    gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default())
}

/// Times every dispatch of a frame.
pub(crate) struct Timer {
    queries: wgpu::QuerySet,
    resolved: Buffer,
    labels: Vec<String>,
}

impl Timer {
    const CAPACITY: usize = 512;

    /// Whether one more dispatch can be timed.
    fn has_room(&self) -> bool {
        self.labels.len() < Self::CAPACITY
    }

    /// A timer; `None` if the adapter has no timestamps.
    pub(crate) fn new(gpu: &Gpu) -> Option<Self> {
        if !gpu.profile.timestamps {
            return None;
        }
        let count = 2 * Self::CAPACITY as u32;
        let queries = gpu.device.create_query_set(&wgpu::QuerySetDescriptor {
            label: Some("timer"),
            ty: wgpu::QueryType::Timestamp,
            count,
        });
        let usage = wgpu::BufferUsages::QUERY_RESOLVE | wgpu::BufferUsages::COPY_SRC;
        let resolved = gpu.allocate("timer", u64::from(count) * 8, usage).ok()?;
        Some(Self { queries, resolved, labels: vec![] })
    }

    /// Kernel name and seconds of every dispatch of the last timed frame, in order. Waits for it.
    ///
    /// # Errors
    /// If the driver failed.
    pub(crate) fn seconds(&self, gpu: &Gpu) -> Result<Vec<(String, f64)>, GpuError> {
        let ticks: Vec<u64> = gpu.read(&self.resolved, 2 * self.labels.len())?;
        let period = f64::from(gpu.queue.get_timestamp_period()) * 1e-9;
        Ok(self
            .labels
            .iter()
            .zip(ticks.chunks_exact(2))
            .map(|(label, t)| (label.clone(), t[1].saturating_sub(t[0]) as f64 * period))
            .collect())
    }
}

/// Number of workgroups of `size` that cover `items`.
pub(crate) fn groups(items: usize, size: usize) -> usize {
    items.div_ceil(size)
}
