//! The only place that talks to wgpu directly: adapter, device, buffers, kernels, command recording, read-back.

mod adapters;
mod buffer;
mod error;
mod frame;
mod host_memory;
mod kernel;
mod pass_count;
#[cfg(test)]
mod translation;

use std::{
    collections::HashMap,
    panic::{AssertUnwindSafe, catch_unwind},
    sync::{Arc, Mutex, PoisonError, atomic::Ordering},
};

pub use adapters::{AdapterSummary, Profile, list_adapters, survey_adapters};
use adapters::{adapters, choose, loop_passes, max_binding_bytes, summaries, wanted_limits};
pub(crate) use buffer::Buffer;
use buffer::Memory;
use error::Failure;
pub use error::GpuError;
pub(crate) use frame::{Frame, Timer, groups};
pub(crate) use kernel::{Kernel, Stage};
use pass_count::PassCount;

use super::shader::Defines;

/// An opened adapter.
pub struct Gpu {
    device: wgpu::Device,
    queue: wgpu::Queue,
    adapter: String,
    profile: Profile,
    limits: wgpu::Limits,
    /// Whether its memory is the host's.
    is_unified: bool,
    /// Whether frames are submitted in parts: it may also draw the displays, and systems end submissions that keep it
    /// from that.
    splits_frames: bool,
    /// Whether it may abort submissions without a word (`pass_count.rs`).
    counts_passes: bool,
    /// As [`Self::loop_passes`].
    loop_passes: Option<usize>,
    memory: Arc<Memory>,
    pass_count: PassCount,
    failure: Arc<Mutex<Option<Failure>>>,
    kernels: Mutex<HashMap<(String, Defines), Kernel>>,
}

impl Gpu {
    /// Opens the best adapter, or the one that `wanted` selects: `#1` by index in [`list_adapters`], `0000:41:00.0` by
    /// PCI bus id, anything else the first whose name contains it (case-insensitive).
    ///
    /// # Errors
    /// If there is no (such) adapter or its driver refuses a device.
    pub fn open(wanted: Option<&str>) -> Result<Self, GpuError> {
        Self::open_restricted(wanted, true)
    }

    /// As [`Gpu::open`], optionally without subgroups even where they exist, so that the fallback can be tested
    /// everywhere.
    ///
    /// # Errors
    /// As [`Gpu::open`].
    pub(crate) fn open_restricted(wanted: Option<&str>, subgroups: bool) -> Result<Self, GpuError> {
        let (all, unfit) = adapters();
        let adapter = &all[choose(wanted, &summaries(&all), &unfit)?];
        let info = adapter.get_info();
        let mut wanted_features = wgpu::Features::TIMESTAMP_QUERY;
        wanted_features.set(wgpu::Features::SUBGROUP, subgroups);
        let features = adapter.features() & wanted_features;
        let limits = wanted_limits(adapter);
        let (device, queue) = pollster::block_on(adapter.request_device(&wgpu::DeviceDescriptor {
            label: Some("centaur"),
            required_features: features,
            required_limits: limits.clone(),
            memory_hints: wgpu::MemoryHints::Performance,
            ..Default::default()
        }))
        .map_err(|e| GpuError::Device { adapter: info.name.clone(), reason: e.to_string() })?;
        let failure = Arc::new(Mutex::new(None));
        let report = |slot: &Mutex<Option<Failure>>, failure: Failure| {
            slot.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(failure);
        };
        let slot = Arc::clone(&failure);
        device.on_uncaptured_error(Arc::new(move |error: wgpu::Error| report(&slot, error.into())));
        let slot = Arc::clone(&failure);
        device.set_device_lost_callback(move |reason, message| {
            if reason != wgpu::DeviceLostReason::Destroyed {
                report(&slot, Failure::Other(format!("the device was lost: {message}")));
            }
        });
        let pass_count = PassCount::new(&device);
        let is_cpu = info.device_type == wgpu::DeviceType::Cpu;
        Ok(Self {
            device,
            queue,
            loop_passes: loop_passes(&info.name, is_cpu),
            adapter: info.name,
            profile: Profile {
                subgroups: features.contains(wgpu::Features::SUBGROUP),
                timestamps: features.contains(wgpu::Features::TIMESTAMP_QUERY),
                is_cpu,
            },
            limits,
            is_unified: is_cpu || info.device_type == wgpu::DeviceType::IntegratedGpu,
            splits_frames: info.device_type == wgpu::DeviceType::IntegratedGpu,
            // Tests show that nothing goes uncounted.
            counts_passes: info.backend == wgpu::Backend::Metal || cfg!(test),
            memory: Arc::default(),
            pass_count,
            failure,
            kernels: Mutex::default(),
        })
    }

    /// The adapter's name.
    #[must_use]
    pub fn adapter(&self) -> &str {
        &self.adapter
    }

    /// Capabilities that shaders may use.
    #[must_use]
    pub fn profile(&self) -> Profile {
        self.profile
    }

    /// Whether the adapter's memory is the host's.
    pub(crate) fn shares_host_memory(&self) -> bool {
        self.is_unified
    }

    /// Peak of allocated bytes since the device was opened, or since [`Self::reset_peak`].
    #[must_use]
    pub fn peak_bytes(&self) -> u64 {
        self.memory.peak.load(Ordering::Relaxed)
    }

    /// Resets [`Self::peak_bytes`] to the bytes allocated now.
    pub fn reset_peak(&self) {
        self.memory.peak.store(self.memory.now.load(Ordering::Relaxed), Ordering::Relaxed);
    }

    /// Largest number of bytes that one binding can hold.
    #[must_use]
    pub fn max_binding_bytes(&self) -> u64 {
        max_binding_bytes(&self.limits)
    }

    /// Limit on the passes of all loops of a thread together, if there is one: Mesa's software adapter silently ends
    /// them after that many.
    pub(crate) fn loop_passes(&self) -> Option<usize> {
        self.loop_passes
    }

    /// Largest number of workgroups in a row of a dispatch.
    pub(crate) fn widest_dispatch(&self) -> u32 {
        self.limits.max_compute_workgroups_per_dimension
    }

    /// The best adapter, with subgroups or without. Panics if it has none, as it then cannot test kernels that use
    /// them.
    #[cfg(test)]
    pub(crate) fn with_subgroups(subgroups: bool) -> Self {
        let gpu = Self::open_restricted(None, subgroups).unwrap();
        assert_eq!(gpu.profile.subgroups, subgroups, "{} has no subgroups", gpu.adapter);
        gpu
    }

    /// The same adapter, with dispatches folded into rows of at most this many workgroups.
    #[cfg(test)]
    pub(crate) fn narrowed(mut self, widest: u32) -> Self {
        self.limits.max_compute_workgroups_per_dimension = widest;
        self
    }

    /// The same adapter, with bindings limited to this many bytes.
    #[cfg(test)]
    pub(crate) fn binding_at_most(mut self, bytes: u64) -> Self {
        self.limits.max_storage_buffer_binding_size = bytes;
        self
    }

    /// Kernels compiled so far.
    #[cfg(test)]
    pub(crate) fn n_kernels(&self) -> usize {
        self.kernels.lock().unwrap().len()
    }

    /// The same adapter, treated as a GPU: uniforms, cooperating threads, memory that is not the host's.
    #[cfg(test)]
    pub(crate) fn posing_as_gpu(mut self) -> Self {
        self.kernels = Mutex::default();
        self.profile.is_cpu = false;
        self.is_unified = false;
        self.splits_frames = false;
        self.loop_passes = None;
        self
    }

    /// The same adapter, with what there is for software adapters: storage for uniforms, few threads, loops that end,
    /// memory that is the host's.
    #[cfg(test)]
    pub(crate) fn posing_as_cpu(mut self) -> Self {
        self.kernels = Mutex::default();
        self.profile.is_cpu = true;
        self.is_unified = true;
        self.splits_frames = false;
        self.loop_passes = Some(adapters::LOOP_PASSES);
        self
    }

    /// The same adapter, with frames in parts or whole.
    #[cfg(test)]
    pub(crate) fn splitting_frames(mut self, splits: bool) -> Self {
        self.splits_frames = splits;
        self
    }

    /// The first error the driver reported outside a call that returns one. Lack of memory is told once: there may be
    /// enough later (on Metal, where passes are counted, reads fail once a frame was dropped for it).
    ///
    /// # Errors
    /// That error.
    pub fn check(&self) -> Result<(), GpuError> {
        let mut failure = self.failure.lock().unwrap_or_else(PoisonError::into_inner);
        match failure.take_if(|failure| matches!(failure, Failure::OutOfMemory)).or_else(|| failure.clone()) {
            None => Ok(()),
            Some(Failure::OutOfMemory) => Err(self.out_of_memory("a copy to or from the host".to_owned())),
            Some(Failure::Other(reason)) => Err(GpuError::Failed { adapter: self.adapter.clone(), reason }),
        }
    }

    fn out_of_memory(&self, what: String) -> GpuError {
        let held = self.memory.now.load(Ordering::Relaxed) >> 20;
        GpuError::OutOfMemory { what, held, adapter: self.adapter.clone() }
    }

    /// Waits until everything submitted has run.
    ///
    /// # Errors
    /// If the device was lost.
    pub(crate) fn wait(&self) -> Result<(), GpuError> {
        self.check()?;
        self.polled(|| self.device.poll(wgpu::PollType::wait_indefinitely())).map(drop)
    }

    /// Result of `poll`. wgpu panics if it finds the device lost meanwhile, by when it has usually reported the reason.
    fn polled<T>(&self, poll: impl FnOnce() -> Result<T, wgpu::PollError>) -> Result<T, GpuError> {
        let failed = |reason: String| GpuError::Failed { adapter: self.adapter.clone(), reason };
        match catch_unwind(AssertUnwindSafe(poll)) {
            Ok(status) => status.map_err(|e| failed(e.to_string())),
            Err(_) => Err(self.check().err().unwrap_or_else(|| failed("the device was lost".to_owned()))),
        }
    }

    /// Defines for every kernel on this adapter.
    pub(crate) fn defines(&self) -> Defines {
        Defines::default().with("SUBGROUPS", u32::from(self.profile.subgroups)).with("WIDEST", self.widest_dispatch())
    }
}

#[cfg(test)]
mod tests {
    use super::{error::LESS, host_memory::host_memory, *};

    #[test]
    fn too_little_memory_is_an_error_that_says_how_much_there_is() {
        let gpu = Gpu::open(None).unwrap();
        gpu.ensure_free("a little", 1 << 20).unwrap();
        gpu.check().unwrap();
        // The memory of a GPU cannot be tested, since a test would have to allocate all of it.
        let free = gpu.is_unified.then(host_memory).flatten().unwrap_or(1 << 30);
        let error = gpu.ensure_within(free, "training", 1 << 60).unwrap_err();
        assert!(error.is_lack_of_memory());
        let text = error.to_string();
        assert!(text.starts_with("training needs 1099511627776 MiB of memory, but ") && text.contains(LESS), "{text}");
    }

    #[test]
    fn a_peak_begins_anew_with_what_is_there() {
        let gpu = Gpu::open(None).unwrap();
        let _stays = gpu.storage("stays", 100).unwrap();
        drop(gpu.storage("goes", 1000).unwrap());
        assert_eq!(gpu.peak_bytes(), 4400);
        gpu.reset_peak();
        assert_eq!(gpu.peak_bytes(), 400);
        drop(gpu.storage("comes", 500).unwrap());
        assert_eq!(gpu.peak_bytes(), 2400);
    }

    #[test]
    fn what_goes_in_pieces_arrives_whole() {
        let gpu = Gpu::open(None).unwrap();
        let words: Vec<u32> = (0..1000).collect();
        for piece in [4, 1000, 2000, 4000, 8000] {
            let buffer = gpu.storage("words", 1001).unwrap();
            gpu.write_in_pieces(&buffer, 4, bytemuck::cast_slice(&words), piece);
            let found = gpu.read::<u32>(&buffer, 1001).unwrap();
            assert!(found[0] == 0 && found[1..] == words, "{piece}");
        }
    }

    #[test]
    fn two_buffers_are_read_with_one_wait() {
        let gpu = Gpu::open(None).unwrap();
        let bytes = gpu.storage_with("bytes", &[1_u8, 2, 3, 4, 5, 6, 7, 8]).unwrap();
        let words = gpu.storage_with("words", &[7_u32, 8, 9]).unwrap();
        for (n, m) in [(8, 3), (5, 2), (0, 1), (3, 0), (0, 0)] {
            let (found, others) = gpu.read_both::<u8, u32>((&bytes, n), (&words, m)).unwrap();
            assert!(
                found == [1_u8, 2, 3, 4, 5, 6, 7, 8][..n] && others == [7_u32, 8, 9][..m],
                "{n}, {m}: {found:?}, {others:?}"
            );
        }
    }

    #[test]
    fn a_device_that_is_lost_while_it_is_waited_for_is_an_error() {
        let gpu = Gpu::open(None).unwrap();
        let lost = || -> Result<(), wgpu::PollError> { std::panic::resume_unwind(Box::new("as wgpu does")) };
        let said = || gpu.polled(lost).unwrap_err().to_string();
        assert!(said().contains("the device was lost"), "{}", said());
        *gpu.failure.lock().unwrap() = Some(Failure::Other("unplugged".to_owned()));
        assert!(said().contains("unplugged"), "{}", said());
    }

    #[test]
    fn running_out_of_memory_is_an_error_that_names_the_adapter() {
        let gpu = Gpu::open(None).unwrap();
        let held = gpu.storage("something", 3 << 18).unwrap();
        // Out of memory as wgpu reports it when staging a copy.
        let error = wgpu::Error::OutOfMemory { source: "no memory".into() };
        *gpu.failure.lock().unwrap() = Some(error.into());
        let expected = format!(
            "{} is out of memory: no room for a copy to or from the host beside the 3 MiB in use: {LESS}",
            gpu.adapter()
        );
        assert_eq!(gpu.read::<u32>(&held, 1).unwrap_err().to_string(), expected);
        // The next allocation may succeed.
        assert_eq!(gpu.read::<u32>(&held, 1).unwrap(), [0]);
        // Other failures are permanent.
        *gpu.failure.lock().unwrap() = Some(Failure::Other("lost".to_owned()));
        for error in [gpu.check().unwrap_err(), gpu.wait().unwrap_err()] {
            assert!(error.to_string().contains("lost"), "{error}");
        }
    }
}
