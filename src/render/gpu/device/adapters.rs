//! Which adapters there are and what they can do.

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

fn instance() -> wgpu::Instance {
    let mut descriptor = wgpu::InstanceDescriptor::new_without_display_handle();
    descriptor.backends = wgpu::Backends::VULKAN | wgpu::Backends::METAL | wgpu::Backends::DX12;
    // Indirect counts are written by our own kernels and bounded there; wgpu's extra validation pass is not needed.
    descriptor.flags = wgpu::InstanceFlags::empty();
    wgpu::Instance::new(descriptor)
}

pub(super) fn adapters() -> Vec<wgpu::Adapter> {
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
