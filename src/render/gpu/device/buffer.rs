//! Buffers: allocation within limits, accounting, writing and reading back.

use std::sync::{
    Arc, Mutex, PoisonError,
    atomic::{AtomicU64, Ordering},
};

use super::{Gpu, GpuError, host_memory::host_memory};

/// Bytes allocated, at present and at most.
#[derive(Default)]
pub(super) struct Memory {
    pub(super) now: AtomicU64,
    pub(super) peak: AtomicU64,
}

/// A storage, uniform or copy buffer; freed and no longer counted when it and all bindings to it are dropped.
pub(crate) struct Buffer {
    pub(super) raw: wgpu::Buffer,
    pub(super) allocation: Arc<Allocation>,
}

/// Bytes counted as long as anything holds this.
pub(super) struct Allocation {
    bytes: u64,
    memory: Arc<Memory>,
}

impl Buffer {
    /// A zeroed storage buffer that no account of memory includes.
    pub(super) fn uncounted(device: &wgpu::Device, label: &str, size: u64) -> Self {
        use wgpu::BufferUsages as U;
        let usage = U::STORAGE | U::COPY_SRC | U::COPY_DST;
        let descriptor = wgpu::BufferDescriptor { label: Some(label), size, usage, mapped_at_creation: false };
        let allocation = Allocation { bytes: 0, memory: Arc::default() };
        Self { raw: device.create_buffer(&descriptor), allocation: Arc::new(allocation) }
    }
}

impl Drop for Allocation {
    fn drop(&mut self) {
        self.memory.now.fetch_sub(self.bytes, Ordering::Relaxed);
    }
}

/// Size of the buffers that probe free memory, bytes.
const PROBE: u64 = 256 << 20;
/// Largest part of one upload, bytes, that is staged at once: the driver keeps uncounted copies of staged data.
const STAGED: usize = 256 << 20;

impl Gpu {
    /// Checks that a shader can bind a buffer of this many bytes.
    ///
    /// # Errors
    /// [`GpuError::TooLarge`], naming `what`.
    pub(crate) fn ensure_bindable(&self, what: &str, bytes: u64) -> Result<(), GpuError> {
        let limit = self.max_binding_bytes();
        if bytes <= limit {
            return Ok(());
        }
        let (what, adapter) = (what.to_owned(), self.adapter.clone());
        Err(GpuError::TooLarge { what, needed: bytes >> 20, limit: limit >> 20, adapter })
    }

    /// Checks that the adapter can hold `bytes` more. Host memory is only queried; other memory is allocated and given
    /// back, as drivers do not otherwise report what is free.
    ///
    /// # Errors
    /// [`GpuError::NotEnoughMemory`], naming `what`.
    pub(crate) fn ensure_free(&self, what: &str, bytes: u64) -> Result<(), GpuError> {
        let of_host = if self.is_unified { host_memory() } else { None };
        let mut free = of_host.unwrap_or(u64::MAX);
        if free >= bytes && !self.profile.is_cpu {
            free = self.allocatable(bytes);
        }
        self.ensure_within(free, what, bytes)
    }

    /// Checks that `bytes` do not exceed the `free` ones.
    pub(super) fn ensure_within(&self, free: u64, what: &str, bytes: u64) -> Result<(), GpuError> {
        if free >= bytes {
            return Ok(());
        }
        let (what, adapter) = (what.to_owned(), self.adapter.clone());
        Err(GpuError::NotEnoughMemory { what, needed: bytes >> 20, free: free >> 20, adapter })
    }

    /// Number of bytes, up to `bytes`, that the driver grants at present.
    fn allocatable(&self, bytes: u64) -> u64 {
        let largest = PROBE.min(self.limits.max_buffer_size);
        let (mut found, mut probes) = (0, vec![]);
        while found < bytes {
            let size = largest.min(bytes - found).next_multiple_of(4);
            let Ok(probe) = self.create("memory probe", size, wgpu::BufferUsages::STORAGE) else { break };
            probes.push(probe);
            found += size;
        }
        probes.iter().for_each(wgpu::Buffer::destroy);
        drop(probes);
        let _ = self.polled(|| self.device.poll(wgpu::PollType::Poll));
        found
    }

    /// Creates a buffer, or returns the error that there is no memory for it.
    fn create(&self, label: &str, size: u64, usage: wgpu::BufferUsages) -> Result<wgpu::Buffer, GpuError> {
        let scope = self.device.push_error_scope(wgpu::ErrorFilter::OutOfMemory);
        let descriptor = wgpu::BufferDescriptor { label: Some(label), size, usage, mapped_at_creation: false };
        let buffer = self.device.create_buffer(&descriptor);
        match pollster::block_on(scope.pop()) {
            None => Ok(buffer),
            Some(_) => Err(self.out_of_memory(format!("{label} ({} MiB)", size >> 20))),
        }
    }

    pub(super) fn allocate(&self, label: &str, bytes: u64, usage: wgpu::BufferUsages) -> Result<Buffer, GpuError> {
        self.ensure_bindable(label, bytes)?;
        let bytes = bytes.max(16).next_multiple_of(4);
        let raw = self.create(label, bytes, usage)?;
        let now = self.memory.now.fetch_add(bytes, Ordering::Relaxed) + bytes;
        self.memory.peak.fetch_max(now, Ordering::Relaxed);
        Ok(Buffer { raw, allocation: Arc::new(Allocation { bytes, memory: Arc::clone(&self.memory) }) })
    }

    /// A zeroed storage buffer of `words` 4-byte words.
    pub(crate) fn storage(&self, label: &str, words: usize) -> Result<Buffer, GpuError> {
        use wgpu::BufferUsages as U;
        // Saturating, as a checkpoint may ask for any number of words.
        self.allocate(label, (words as u64).saturating_mul(4), U::STORAGE | U::COPY_SRC | U::COPY_DST | U::INDIRECT)
    }

    /// A storage buffer with these contents.
    pub(crate) fn storage_with<T: bytemuck::Pod>(&self, label: &str, values: &[T]) -> Result<Buffer, GpuError> {
        let bytes: &[u8] = bytemuck::cast_slice(values);
        let buffer = self.storage(label, bytes.len().div_ceil(4))?;
        self.write(&buffer, 0, bytes);
        Ok(buffer)
    }

    /// A uniform buffer of `words` 4-byte words, which a kernel can write as storage.
    pub(crate) fn uniform(&self, label: &str, words: usize) -> Result<Buffer, GpuError> {
        use wgpu::BufferUsages as U;
        self.allocate(label, words as u64 * 4, U::UNIFORM | U::STORAGE | U::COPY_DST)
    }

    /// Replaces bytes from `offset` on, before the next submission runs. Lengths must be multiples of 4. Waits only if
    /// there are more than [`STAGED`] bytes.
    pub(crate) fn write<T: bytemuck::Pod>(&self, buffer: &Buffer, offset: u64, values: &[T]) {
        self.write_in_pieces(buffer, offset, bytemuck::cast_slice(values), STAGED);
    }

    /// As [`Self::write`], in pieces: each is staged once the previous ones are on the adapter.
    pub(super) fn write_in_pieces(&self, buffer: &Buffer, offset: u64, bytes: &[u8], piece: usize) {
        for (i, bytes) in bytes.chunks(piece).enumerate() {
            if i > 0 {
                self.submit_writes();
                // An error here is reported by whatever waits next.
                let _ = self.polled(|| self.device.poll(wgpu::PollType::wait_indefinitely()));
            }
            self.queue.write_buffer(&buffer.raw, offset + (i * piece) as u64, bytes);
        }
    }

    /// Waits for everything submitted and copies `count` elements from the start of `buffer`.
    ///
    /// # Errors
    /// If the driver failed on this or anything before, or aborted a submission.
    pub(crate) fn read<T: bytemuck::Pod>(&self, buffer: &Buffer, count: usize) -> Result<Vec<T>, GpuError> {
        let bytes = count * size_of::<T>();
        self.fetch(&[(buffer, bytes)], |found| bytemuck::pod_collect_to_vec(&found[..bytes]))
    }

    /// As [`Self::read`] for two buffers, with one wait.
    ///
    /// # Errors
    /// As [`Self::read`].
    pub(crate) fn read_both<T: bytemuck::Pod, U: bytemuck::Pod>(
        &self,
        (first, count): (&Buffer, usize),
        (second, second_count): (&Buffer, usize),
    ) -> Result<(Vec<T>, Vec<U>), GpuError> {
        let (bytes, second_bytes) = (count * size_of::<T>(), second_count * size_of::<U>());
        self.fetch(&[(first, bytes), (second, second_bytes)], |found| {
            let rest = &found[bytes.next_multiple_of(4)..];
            (bytemuck::pod_collect_to_vec(&found[..bytes]), bytemuck::pod_collect_to_vec(&rest[..second_bytes]))
        })
    }

    /// Waits for everything submitted and reads this many bytes from the start of each buffer, concatenated at
    /// multiples of four.
    fn fetch<R>(&self, parts: &[(&Buffer, usize)], take: impl FnOnce(&[u8]) -> R) -> Result<R, GpuError> {
        let padded = |bytes: usize| bytes.next_multiple_of(4) as u64;
        let total: u64 = parts.iter().map(|(_, bytes)| padded(*bytes)).sum();
        if total == 0 {
            return Ok(take(&[]));
        }
        let usage = wgpu::BufferUsages::COPY_DST | wgpu::BufferUsages::MAP_READ;
        let staging = self.create("read-back", total + self.pass_count_bytes(), usage)?;
        let parts = parts.iter().filter(|(_, bytes)| *bytes > 0).map(|(buffer, bytes)| (&buffer.raw, padded(*bytes)));
        let passes = self.submit_copies(parts, &staging);
        let failed = |reason: String| GpuError::Failed { adapter: self.adapter.clone(), reason };
        let outcome = Arc::new(Mutex::new(None));
        let slot = Arc::clone(&outcome);
        staging.slice(..).map_async(wgpu::MapMode::Read, move |r| {
            *slot.lock().unwrap_or_else(PoisonError::into_inner) = Some(r);
        });
        self.wait()?;
        self.check()?;
        match outcome.lock().unwrap_or_else(PoisonError::into_inner).take() {
            Some(Ok(())) => {}
            Some(Err(e)) => return Err(failed(e.to_string())),
            None => return Err(failed("read-back did not finish".to_owned())),
        }
        let view = staging.slice(..).get_mapped_range().map_err(|e| failed(e.to_string()))?;
        let (found, ran) = view.split_at(total as usize);
        if self.counts_passes && ran != passes.to_ne_bytes() {
            return Err(self.aborted());
        }
        Ok(take(found))
    }
}
