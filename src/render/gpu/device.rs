//! The only file that talks to wgpu directly: adapter, device, buffers, kernels, command recording, read-back.

use std::{
    collections::HashMap,
    sync::{
        Arc, Mutex, PoisonError,
        atomic::{AtomicU64, Ordering},
    },
};

use super::{
    memory::host_memory,
    shader::{self, Access, Defines},
};

/// A failure of the adapter or the driver.
#[derive(Debug, thiserror::Error)]
pub enum GpuError {
    /// No adapter at all.
    #[error(
        "no GPU adapter found: install a Vulkan, Metal or DX12 driver; without a GPU, Mesa's software adapter works \
         (Debian/Ubuntu: apt install mesa-vulkan-drivers)"
    )]
    NoAdapter,
    /// No adapter with the requested name.
    #[error("no adapter matches {wanted:?}; available: {available}")]
    NoSuchAdapter {
        /// What was asked for.
        wanted: String,
        /// Names of all adapters.
        available: String,
    },
    /// The adapter refused a device.
    #[error("{adapter}: cannot open a device: {reason}")]
    Device {
        /// Adapter name.
        adapter: String,
        /// The driver's words.
        reason: String,
    },
    /// A buffer exceeds what the adapter can bind.
    #[error("{what} needs a buffer of {needed} MiB, but {adapter} binds at most {limit} MiB: {LESS}")]
    TooLarge {
        /// What the buffer holds.
        what: String,
        /// MiB asked for.
        needed: u64,
        /// MiB the adapter binds.
        limit: u64,
        /// Adapter name.
        adapter: String,
    },
    /// What is about to be allocated exceeds what is free.
    #[error("{what} needs {needed} MiB of memory, but {adapter} has {free} MiB free: {LESS}")]
    NotEnoughMemory {
        /// What the memory is for.
        what: String,
        /// MiB asked for.
        needed: u64,
        /// MiB that are free.
        free: u64,
        /// Adapter name.
        adapter: String,
    },
    /// The driver has no memory left.
    #[error("{adapter} is out of memory: no room for {what} beside the {held} MiB in use: {LESS}")]
    OutOfMemory {
        /// What there was no room for.
        what: String,
        /// MiB allocated before, without what the driver needs itself.
        held: u64,
        /// Adapter name.
        adapter: String,
    },
    /// The driver reported an error while running.
    #[error("{adapter}: {reason}")]
    Failed {
        /// Adapter name.
        adapter: String,
        /// The driver's words.
        reason: String,
    },
}

/// How to get by with less memory.
const LESS: &str = "fewer splats, smaller maps or smaller images need less";

impl GpuError {
    /// Whether a smaller scene or smaller images would help.
    #[must_use]
    pub fn is_lack_of_memory(&self) -> bool {
        matches!(self, Self::TooLarge { .. } | Self::NotEnoughMemory { .. } | Self::OutOfMemory { .. })
    }
}

/// What shaders may use on this adapter.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Profile {
    /// Native `atomicAdd` on f32 in storage buffers.
    pub float_atomics: bool,
    /// Subgroup operations.
    pub subgroups: bool,
    /// Timestamp queries.
    pub timestamps: bool,
    /// A software adapter: lanes are few and memory is the host's.
    pub is_cpu: bool,
}

/// One line of `centaur devices`.
#[derive(Clone, Debug, serde::Serialize)]
pub struct AdapterSummary {
    /// Name as the driver gives it.
    pub name: String,
    /// Vulkan, Metal, Dx12, …
    pub backend: String,
    /// `DiscreteGpu`, `IntegratedGpu`, `Cpu`, …
    pub kind: String,
    /// Driver name and version.
    pub driver: String,
    /// Largest buffer a shader can bind, bytes.
    pub max_binding_bytes: u64,
    /// Native f32 atomics.
    pub float_atomics: bool,
    /// Subgroup sizes, 0–0 if not supported.
    pub subgroup_size: (u32, u32),
    /// Timestamp queries.
    pub timestamps: bool,
}

/// An opened adapter.
pub struct Gpu {
    device: wgpu::Device,
    queue: wgpu::Queue,
    adapter: String,
    profile: Profile,
    limits: wgpu::Limits,
    /// Its memory is the host's.
    is_unified: bool,
    memory: Arc<Memory>,
    failure: Arc<Mutex<Option<Failure>>>,
    kernels: Mutex<HashMap<(String, Defines), Kernel>>,
}

/// An error outside a call that returns one.
#[derive(Clone)]
enum Failure {
    OutOfMemory,
    Other(String),
}

impl From<wgpu::Error> for Failure {
    fn from(error: wgpu::Error) -> Self {
        match error {
            wgpu::Error::OutOfMemory { .. } => Self::OutOfMemory,
            other => Self::Other(other.to_string()),
        }
    }
}

#[derive(Default)]
struct Memory {
    now: AtomicU64,
    peak: AtomicU64,
}

/// A storage, uniform or copy buffer; freed and uncounted when it and all bindings to it are dropped.
pub(crate) struct Buffer {
    raw: wgpu::Buffer,
    allocation: Arc<Allocation>,
}

/// Bytes that are counted as long as anything holds them.
struct Allocation {
    bytes: u64,
    memory: Arc<Memory>,
}

impl Drop for Allocation {
    fn drop(&mut self) {
        self.memory.now.fetch_sub(self.bytes, Ordering::Relaxed);
    }
}

/// Bytes of the buffers by which free memory is found.
const PROBE: u64 = 256 << 20;

fn instance() -> wgpu::Instance {
    let mut descriptor = wgpu::InstanceDescriptor::new_without_display_handle();
    descriptor.backends = wgpu::Backends::VULKAN | wgpu::Backends::METAL | wgpu::Backends::DX12;
    // Indirect counts are written by our own kernels and bounded there; wgpu's extra validation pass is not needed.
    descriptor.flags = wgpu::InstanceFlags::empty();
    wgpu::Instance::new(descriptor)
}

fn adapters() -> Vec<wgpu::Adapter> {
    let mut found = pollster::block_on(instance().enumerate_adapters(wgpu::Backends::all()));
    found.retain(|a| a.limits().max_compute_invocations_per_workgroup >= 256);
    // Real hardware first, software last.
    found.sort_by_key(|a| match a.get_info().device_type {
        wgpu::DeviceType::DiscreteGpu => 0,
        wgpu::DeviceType::IntegratedGpu => 1,
        wgpu::DeviceType::VirtualGpu => 2,
        wgpu::DeviceType::Other => 3,
        wgpu::DeviceType::Cpu => 4,
    });
    found
}

/// All adapters that can run the pipeline, best first.
#[must_use]
pub fn list_adapters() -> Vec<AdapterSummary> {
    adapters()
        .iter()
        .map(|a| {
            let (info, features) = (a.get_info(), a.features());
            let subgroups = features.contains(wgpu::Features::SUBGROUP);
            AdapterSummary {
                name: info.name,
                backend: format!("{:?}", info.backend),
                kind: format!("{:?}", info.device_type),
                driver: format!("{} {}", info.driver, info.driver_info).trim().to_owned(),
                max_binding_bytes: a.limits().max_storage_buffer_binding_size,
                float_atomics: features.contains(wgpu::Features::SHADER_FLOAT32_ATOMIC),
                subgroup_size: if subgroups { (info.subgroup_min_size, info.subgroup_max_size) } else { (0, 0) },
                timestamps: features.contains(wgpu::Features::TIMESTAMP_QUERY),
            }
        })
        .collect()
}

impl Gpu {
    /// Opens the best adapter, or the first whose name contains `wanted` (case-insensitive).
    ///
    /// # Errors
    /// If there is no (such) adapter or its driver refuses a device.
    pub fn open(wanted: Option<&str>) -> Result<Self, GpuError> {
        Self::open_restricted(wanted, true, true)
    }

    /// As [`Gpu::open`], pretending that native f32 atomics or subgroups are missing where told so: the fallbacks
    /// run everywhere, so that they can be tested everywhere.
    ///
    /// # Errors
    /// As [`Gpu::open`].
    pub fn open_restricted(wanted: Option<&str>, float_atomics: bool, subgroups: bool) -> Result<Self, GpuError> {
        let all = adapters();
        if all.is_empty() {
            return Err(GpuError::NoAdapter);
        }
        let name_of = |a: &wgpu::Adapter| a.get_info().name;
        let adapter = match wanted {
            None => &all[0],
            Some(w) => all.iter().find(|a| name_of(a).to_lowercase().contains(&w.to_lowercase())).ok_or_else(|| {
                GpuError::NoSuchAdapter {
                    wanted: w.to_owned(),
                    available: all.iter().map(name_of).collect::<Vec<_>>().join(", "),
                }
            })?,
        };
        let info = adapter.get_info();
        let mut wanted_features = wgpu::Features::TIMESTAMP_QUERY;
        wanted_features.set(wgpu::Features::SHADER_FLOAT32_ATOMIC, float_atomics);
        wanted_features.set(wgpu::Features::SUBGROUP, subgroups);
        let features = adapter.features() & wanted_features;
        let limits = adapter.limits();
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
        Ok(Self {
            device,
            queue,
            adapter: info.name,
            profile: Profile {
                float_atomics: features.contains(wgpu::Features::SHADER_FLOAT32_ATOMIC),
                subgroups: features.contains(wgpu::Features::SUBGROUP),
                timestamps: features.contains(wgpu::Features::TIMESTAMP_QUERY),
                is_cpu: info.device_type == wgpu::DeviceType::Cpu,
            },
            limits,
            is_unified: matches!(info.device_type, wgpu::DeviceType::Cpu | wgpu::DeviceType::IntegratedGpu),
            memory: Arc::default(),
            failure,
            kernels: Mutex::default(),
        })
    }

    /// The adapter's name.
    #[must_use]
    pub fn adapter(&self) -> &str {
        &self.adapter
    }

    /// What shaders may use.
    #[must_use]
    pub fn profile(&self) -> Profile {
        self.profile
    }

    /// Most bytes that were allocated at once since the device was opened.
    #[must_use]
    pub fn peak_bytes(&self) -> u64 {
        self.memory.peak.load(Ordering::Relaxed)
    }

    /// Most bytes that one binding can hold.
    #[must_use]
    pub fn max_binding_bytes(&self) -> u64 {
        self.limits.max_storage_buffer_binding_size.min(self.limits.max_buffer_size)
    }

    /// Most workgroups in a row of a dispatch.
    pub(crate) fn widest_dispatch(&self) -> u32 {
        self.limits.max_compute_workgroups_per_dimension
    }

    /// The same adapter, but dispatches are folded into rows of at most so many workgroups.
    #[cfg(test)]
    pub(crate) fn narrowed(mut self, widest: u32) -> Self {
        self.limits.max_compute_workgroups_per_dimension = widest;
        self
    }

    /// The first error the driver reported outside a call that returns one.
    ///
    /// # Errors
    /// That error.
    pub fn check(&self) -> Result<(), GpuError> {
        match self.failure.lock().unwrap_or_else(PoisonError::into_inner).clone() {
            None => Ok(()),
            Some(Failure::OutOfMemory) => Err(self.out_of_memory("a copy to or from the host".to_owned())),
            Some(Failure::Other(reason)) => Err(GpuError::Failed { adapter: self.adapter.clone(), reason }),
        }
    }

    fn out_of_memory(&self, what: String) -> GpuError {
        let held = self.memory.now.load(Ordering::Relaxed) >> 20;
        GpuError::OutOfMemory { what, held, adapter: self.adapter.clone() }
    }

    /// Error if a shader cannot bind a buffer of so many bytes.
    ///
    /// # Errors
    /// [`GpuError::TooLarge`], for `what`.
    pub(crate) fn ensure_bindable(&self, what: &str, bytes: u64) -> Result<(), GpuError> {
        let limit = self.max_binding_bytes();
        if bytes <= limit {
            return Ok(());
        }
        let (what, adapter) = (what.to_owned(), self.adapter.clone());
        Err(GpuError::TooLarge { what, needed: bytes >> 20, limit: limit >> 20, adapter })
    }

    /// Error if the adapter cannot hold `bytes` more. Memory that is the host's is taken from nobody by this; other
    /// memory is allocated and given back, as drivers do not otherwise say what is free.
    ///
    /// # Errors
    /// [`GpuError::NotEnoughMemory`], for `what`.
    pub(crate) fn ensure_free(&self, what: &str, bytes: u64) -> Result<(), GpuError> {
        let of_host = if self.is_unified { host_memory() } else { None };
        let mut free = of_host.unwrap_or(u64::MAX);
        if free >= bytes && !self.profile.is_cpu {
            free = self.allocatable(bytes);
        }
        if free >= bytes {
            return Ok(());
        }
        let (what, adapter) = (what.to_owned(), self.adapter.clone());
        Err(GpuError::NotEnoughMemory { what, needed: bytes >> 20, free: free >> 20, adapter })
    }

    /// How many of `bytes` the driver hands out now.
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
        let _ = self.device.poll(wgpu::PollType::Poll);
        found
    }

    /// A buffer, or the error that there is no memory for it.
    fn create(&self, label: &str, size: u64, usage: wgpu::BufferUsages) -> Result<wgpu::Buffer, GpuError> {
        let scope = self.device.push_error_scope(wgpu::ErrorFilter::OutOfMemory);
        let descriptor = wgpu::BufferDescriptor { label: Some(label), size, usage, mapped_at_creation: false };
        let buffer = self.device.create_buffer(&descriptor);
        match pollster::block_on(scope.pop()) {
            None => Ok(buffer),
            Some(_) => Err(self.out_of_memory(format!("{label} ({} MiB)", size >> 20))),
        }
    }

    fn allocate(&self, label: &str, bytes: u64, usage: wgpu::BufferUsages) -> Result<Buffer, GpuError> {
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
        // A checkpoint may ask for any number of words.
        self.allocate(label, (words as u64).saturating_mul(4), U::STORAGE | U::COPY_SRC | U::COPY_DST | U::INDIRECT)
    }

    /// A storage buffer with these contents.
    pub(crate) fn storage_with<T: bytemuck::Pod>(&self, label: &str, values: &[T]) -> Result<Buffer, GpuError> {
        let bytes: &[u8] = bytemuck::cast_slice(values);
        let buffer = self.storage(label, bytes.len().div_ceil(4))?;
        self.write(&buffer, 0, bytes);
        Ok(buffer)
    }

    /// A uniform buffer of `words` 4-byte words.
    pub(crate) fn uniform(&self, label: &str, words: usize) -> Result<Buffer, GpuError> {
        self.allocate(label, words as u64 * 4, wgpu::BufferUsages::UNIFORM | wgpu::BufferUsages::COPY_DST)
    }

    /// Replaces bytes from `offset` on, before the next submission runs. Lengths must be multiples of 4.
    pub(crate) fn write<T: bytemuck::Pod>(&self, buffer: &Buffer, offset: u64, values: &[T]) {
        let bytes: &[u8] = bytemuck::cast_slice(values);
        if !bytes.is_empty() {
            self.queue.write_buffer(&buffer.raw, offset, bytes);
        }
    }

    /// Waits for everything submitted and copies `count` elements from the start of `buffer`.
    ///
    /// # Errors
    /// If the driver failed on this or anything before.
    pub(crate) fn read<T: bytemuck::Pod>(&self, buffer: &Buffer, count: usize) -> Result<Vec<T>, GpuError> {
        let bytes = (count * size_of::<T>()) as u64;
        if bytes == 0 {
            return Ok(vec![]);
        }
        let usage = wgpu::BufferUsages::COPY_DST | wgpu::BufferUsages::MAP_READ;
        let staging = self.create("read-back", bytes.next_multiple_of(4), usage)?;
        let mut encoder = self.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        encoder.copy_buffer_to_buffer(&buffer.raw, 0, &staging, 0, bytes.next_multiple_of(4));
        self.queue.submit([encoder.finish()]);
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
        Ok(bytemuck::pod_collect_to_vec(&view[..bytes as usize]))
    }

    /// Waits until everything submitted has run.
    ///
    /// # Errors
    /// If the device was lost.
    pub(crate) fn wait(&self) -> Result<(), GpuError> {
        // wgpu panics when it is asked to wait for a device that is lost.
        self.check()?;
        self.device
            .poll(wgpu::PollType::wait_indefinitely())
            .map(|_| ())
            .map_err(|e| GpuError::Failed { adapter: self.adapter.clone(), reason: e.to_string() })
    }

    /// The defines that every kernel gets from the adapter.
    pub(crate) fn defines(&self) -> Defines {
        Defines::default()
            .with("FLOAT_ATOMICS", u32::from(self.profile.float_atomics))
            .with("SUBGROUPS", u32::from(self.profile.subgroups))
    }
}

/// A compiled compute entry point. Cheap to clone.
#[derive(Clone)]
pub(crate) struct Kernel {
    label: String,
    pipeline: wgpu::ComputePipeline,
    layout: wgpu::BindGroupLayout,
    slots: Vec<u32>,
}

/// The buffers of one kernel.
pub(crate) struct Bindings {
    group: wgpu::BindGroup,
    /// A bind group keeps its buffers alive.
    _allocations: Vec<Arc<Allocation>>,
}

impl Kernel {
    /// Entry point `entry` of `shaders/<file>`, specialised by `defines`; compiled once per adapter.
    pub(crate) fn new(gpu: &Gpu, file: &str, entry: &str, defines: &Defines) -> Self {
        let mut kernels = gpu.kernels.lock().unwrap_or_else(PoisonError::into_inner);
        let key = (format!("{file}:{entry}"), defines.clone());
        kernels.entry(key).or_insert_with(|| Self::compile(gpu, file, entry, defines)).clone()
    }

    fn compile(gpu: &Gpu, file: &str, entry: &str, defines: &Defines) -> Self {
        let wgsl = shader::preprocess(file, defines);
        let bindings = shader::bindings(&wgsl);
        let entries: Vec<_> = bindings
            .iter()
            .map(|&(binding, access)| wgpu::BindGroupLayoutEntry {
                binding,
                visibility: wgpu::ShaderStages::COMPUTE,
                ty: wgpu::BindingType::Buffer {
                    ty: match access {
                        Access::Uniform => wgpu::BufferBindingType::Uniform,
                        Access::Read => wgpu::BufferBindingType::Storage { read_only: true },
                        Access::ReadWrite => wgpu::BufferBindingType::Storage { read_only: false },
                    },
                    has_dynamic_offset: false,
                    min_binding_size: None,
                },
                count: None,
            })
            .collect();
        let label = format!("{}:{entry}", file.trim_end_matches(".wgsl"));
        let device = &gpu.device;
        let layout = device
            .create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor { label: Some(&label), entries: &entries });
        let pipeline_layout = device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
            label: Some(&label),
            bind_group_layouts: &[Some(&layout)],
            immediate_size: 0,
        });
        let module = device.create_shader_module(wgpu::ShaderModuleDescriptor {
            label: Some(&label),
            source: wgpu::ShaderSource::Wgsl(wgsl.into()),
        });
        let pipeline = device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
            label: Some(&label),
            layout: Some(&pipeline_layout),
            module: &module,
            entry_point: Some(entry),
            // Workgroup arrays are always written before they are read.
            compilation_options: wgpu::PipelineCompilationOptions {
                zero_initialize_workgroup_memory: false,
                ..Default::default()
            },
            cache: None,
        });
        Self { label, pipeline, layout, slots: bindings.iter().map(|b| b.0).collect() }
    }

    /// Binds `buffers` in the order of the shader's binding numbers.
    pub(crate) fn bind(&self, gpu: &Gpu, buffers: &[&Buffer]) -> Bindings {
        assert_eq!(self.slots.len(), buffers.len(), "{} has {} bindings", self.label, self.slots.len());
        let entries: Vec<_> = self
            .slots
            .iter()
            .zip(buffers)
            .map(|(&binding, b)| wgpu::BindGroupEntry { binding, resource: b.raw.as_entire_binding() })
            .collect();
        let group = gpu.device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: Some(&self.label),
            layout: &self.layout,
            entries: &entries,
        });
        Bindings { group, _allocations: buffers.iter().map(|b| Arc::clone(&b.allocation)).collect() }
    }
}

/// Commands that are submitted together.
pub(crate) struct Frame<'a> {
    gpu: &'a Gpu,
    encoder: wgpu::CommandEncoder,
    pass: Option<wgpu::ComputePass<'static>>,
    timer: Option<&'a mut Timer>,
}

impl<'a> Frame<'a> {
    /// Starts recording.
    pub(crate) fn new(gpu: &'a Gpu) -> Self {
        let encoder = gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        Self { gpu, encoder, pass: None, timer: None }
    }

    /// Starts recording with a timestamp around every dispatch.
    pub(crate) fn timed(gpu: &'a Gpu, timer: &'a mut Timer) -> Self {
        timer.labels.clear();
        Self { timer: Some(timer), ..Self::new(gpu) }
    }

    fn pass(&mut self, kernel: &Kernel) -> &mut wgpu::ComputePass<'static> {
        if let Some(timer) = &mut self.timer
            && timer.labels.len() < Timer::CAPACITY
        {
            self.pass = None;
            let i = 2 * timer.labels.len() as u32;
            timer.labels.push(kernel.label.clone());
            let pass = self.encoder.begin_compute_pass(&wgpu::ComputePassDescriptor {
                label: Some(&kernel.label),
                timestamp_writes: Some(wgpu::ComputePassTimestampWrites {
                    query_set: &timer.queries,
                    beginning_of_pass_write_index: Some(i),
                    end_of_pass_write_index: Some(i + 1),
                }),
            });
            return self.pass.insert(pass.forget_lifetime());
        }
        let encoder = &mut self.encoder;
        self.pass.get_or_insert_with(|| {
            encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default()).forget_lifetime()
        })
    }

    /// Runs `groups` workgroups, folded into two dimensions where one is too short (see `group_index` in WGSL).
    pub(crate) fn dispatch(&mut self, kernel: &Kernel, bindings: &Bindings, groups: usize) {
        if groups == 0 {
            return;
        }
        let widest = self.gpu.widest_dispatch() as usize;
        let y = groups.div_ceil(widest);
        let x = groups.div_ceil(y);
        let pass = self.pass(kernel);
        pass.set_pipeline(&kernel.pipeline);
        pass.set_bind_group(0, &bindings.group, &[]);
        pass.dispatch_workgroups(x as u32, y as u32, 1);
    }

    /// Runs as many workgroups as the three words at byte `offset` of `counts` say.
    pub(crate) fn dispatch_indirect(&mut self, kernel: &Kernel, bindings: &Bindings, counts: &Buffer, offset: u64) {
        let pass = self.pass(kernel);
        pass.set_pipeline(&kernel.pipeline);
        pass.set_bind_group(0, &bindings.group, &[]);
        pass.dispatch_workgroups_indirect(&counts.raw, offset);
    }

    /// Fills a buffer with zeros.
    pub(crate) fn clear(&mut self, buffer: &Buffer) {
        self.pass = None;
        self.encoder.clear_buffer(&buffer.raw, 0, None);
    }

    /// Hands the commands to the adapter; does not wait.
    pub(crate) fn submit(mut self) {
        self.pass = None;
        if let Some(timer) = &mut self.timer {
            let count = 2 * timer.labels.len() as u32;
            self.encoder.resolve_query_set(&timer.queries, 0..count, &timer.resolved.raw, 0);
        }
        self.gpu.queue.submit([self.encoder.finish()]);
    }
}

/// Times every dispatch of a frame.
pub(crate) struct Timer {
    queries: wgpu::QuerySet,
    resolved: Buffer,
    labels: Vec<String>,
}

impl Timer {
    const CAPACITY: usize = 512;

    /// None where the adapter has no timestamps.
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

/// Workgroups of `size` threads that cover `items`.
pub(crate) fn groups(items: usize, size: usize) -> usize {
    items.div_ceil(size)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn too_little_memory_is_an_error_that_says_how_much_there_is() {
        let gpu = Gpu::open(None).unwrap();
        gpu.ensure_free("a little", 1 << 20).unwrap();
        gpu.check().unwrap();
        if !gpu.is_unified || host_memory().is_none() {
            return; // All of a GPU's memory is not to be taken by a test.
        }
        let error = gpu.ensure_free("training", 1 << 60).unwrap_err();
        assert!(error.is_lack_of_memory());
        let text = error.to_string();
        assert!(text.starts_with("training needs 1099511627776 MiB of memory, but ") && text.contains(LESS), "{text}");
    }

    #[test]
    fn running_out_of_memory_is_an_error_that_names_the_adapter() {
        let gpu = Gpu::open(None).unwrap();
        let held = gpu.storage("something", 3 << 18).unwrap();
        // As wgpu reports it when it stages a copy.
        let error = wgpu::Error::OutOfMemory { source: "no memory".into() };
        *gpu.failure.lock().unwrap() = Some(error.into());
        let expected = format!(
            "{} is out of memory: no room for a copy to or from the host beside the 3 MiB in use: {LESS}",
            gpu.adapter()
        );
        for error in [gpu.check().unwrap_err(), gpu.read::<u32>(&held, 1).unwrap_err(), gpu.wait().unwrap_err()] {
            assert_eq!(error.to_string(), expected);
        }
    }
}
