//! Enumeration of adapters, their capabilities, and the choice among them.

use std::fmt;

use super::error::GpuError;

/// Capabilities of an adapter that shaders may use.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Profile {
    /// Subgroup operations.
    pub subgroups: bool,
    /// Timestamp queries.
    pub timestamps: bool,
    /// Whether it is a software adapter: lanes are few and memory is the host's.
    pub is_cpu: bool,
}

/// Description of an adapter: one line of `centaur devices`.
#[derive(Clone, Debug, serde::Serialize)]
pub struct AdapterSummary {
    /// Position in the list, from 0.
    pub index: usize,
    /// PCI bus id, such as `0000:41:00.0`, if the driver reports it.
    pub pci_bus_id: Option<String>,
    /// Name as the driver gives it.
    pub name: String,
    /// Vulkan, Metal, Dx12, …
    pub backend: String,
    /// `DiscreteGpu`, `IntegratedGpu`, `Cpu`, …
    pub kind: String,
    /// Driver name and version.
    pub driver: String,
    /// Largest buffer that a shader can bind, bytes.
    pub max_binding_bytes: u64,
    /// Subgroup sizes, 0–0 if not supported.
    pub subgroup_size: (u32, u32),
    /// Timestamp queries.
    pub timestamps: bool,
}

/// Formats as `#0 NAME (0000:41:00.0)`, each part of which selects the adapter.
impl fmt::Display for AdapterSummary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "#{} {}", self.index, self.name)?;
        self.pci_bus_id.as_ref().map_or(Ok(()), |bus| write!(f, " ({bus})"))
    }
}

fn instance() -> wgpu::Instance {
    let mut descriptor = wgpu::InstanceDescriptor::new_without_display_handle();
    descriptor.backends = wgpu::Backends::VULKAN | wgpu::Backends::METAL | wgpu::Backends::DX12;
    // Indirect counts are written by our own kernels and bounded there; wgpu's extra validation pass is not needed.
    // `WGPU_…` in the environment sets flags all the same, such as WGPU_ALLOW_UNDERLYING_NONCOMPLIANT_ADAPTER, and
    // Direct3D's compiler.
    descriptor.flags = wgpu::InstanceFlags::empty().with_env();
    descriptor.backend_options = descriptor.backend_options.with_env();
    wgpu::Instance::new(descriptor)
}

/// Storage buffers needed: those of the kernel that binds most (`blend_backward.wgsl` in training with layers).
const STORAGE_BUFFERS: u32 = 12;
/// Workgroup memory needed, bytes: that of the kernel that uses most (`loss.wgsl`), rounded up to WebGPU's guaranteed
/// limit.
const WORKGROUP_BYTES: u32 = 16384;

/// Threads of the largest workgroups, which all have one dimension.
const WORKGROUP_THREADS: u32 = 256;

/// Uniform buffers needed: those of the kernels that bind most (such as `loss.wgsl`).
const UNIFORM_BUFFERS: u32 = 2;

/// Passes of loops after which Mesa's software adapter ends them (`LP_MAX_TGSI_LOOP_ITERATIONS`; in a loop with
/// `continue` each counts twice).
pub(super) const LOOP_PASSES: usize = 65_535;

/// Limit on the passes of all loops of a thread together, if the adapter of this name has one: of software adapters
/// Mesa's alone.
pub(super) fn loop_passes(name: &str, is_cpu: bool) -> Option<usize> {
    (is_cpu && name.contains("llvmpipe")).then_some(LOOP_PASSES)
}

/// Description of what an adapter lacks for the kernels, if anything.
fn lack(limits: &wgpu::Limits) -> Option<String> {
    let needed = [
        (limits.max_storage_buffers_per_shader_stage, STORAGE_BUFFERS, "storage buffers per shader stage"),
        (limits.max_compute_invocations_per_workgroup, WORKGROUP_THREADS, "threads in a workgroup"),
        (limits.max_compute_workgroup_size_x, WORKGROUP_THREADS, "threads in a row of a workgroup"),
        (limits.max_compute_workgroup_storage_size, WORKGROUP_BYTES, "bytes of workgroup memory"),
    ];
    let (found, expected, what) = needed.into_iter().find(|(found, expected, _)| found < expected)?;
    Some(format!("has {found} {what}, expected {expected}"))
}

/// Limits to request: those that other adapters may lack no higher than kernels need, so that tests notice a kernel
/// that needs more.
pub(super) fn wanted_limits(of: &wgpu::Adapter) -> wgpu::Limits {
    wgpu::Limits {
        max_storage_buffers_per_shader_stage: STORAGE_BUFFERS,
        max_uniform_buffers_per_shader_stage: UNIFORM_BUFFERS,
        max_compute_workgroup_storage_size: WORKGROUP_BYTES,
        max_compute_invocations_per_workgroup: WORKGROUP_THREADS,
        max_compute_workgroup_size_x: WORKGROUP_THREADS,
        max_compute_workgroup_size_y: 1,
        max_compute_workgroup_size_z: 1,
        ..of.limits()
    }
}

/// Largest buffer, bytes, that shaders see whole: its size is passed to them as u32, and Metal lets larger ones be
/// bound.
pub(super) fn max_binding_bytes(limits: &wgpu::Limits) -> u64 {
    limits.max_storage_buffer_binding_size.min(limits.max_buffer_size).min(i32::MAX as u64)
}

/// Usable adapters, best first, and for each of the others why it is not.
pub(super) fn adapters() -> (Vec<wgpu::Adapter>, Vec<String>) {
    let mut found = pollster::block_on(instance().enumerate_adapters(wgpu::Backends::all()));
    let mut unfit = vec![];
    found.retain(|a| {
        let (info, lack) = (a.get_info(), lack(&a.limits()));
        unfit.extend(lack.iter().map(|lack| format!("{} by {:?} {lack}", info.name, info.backend)));
        lack.is_none()
    });
    // Real hardware first, software last.
    found.sort_by_key(|a| match a.get_info().device_type {
        wgpu::DeviceType::DiscreteGpu => 0,
        wgpu::DeviceType::IntegratedGpu => 1,
        wgpu::DeviceType::VirtualGpu => 2,
        wgpu::DeviceType::Other => 3,
        wgpu::DeviceType::Cpu => 4,
    });
    (found, unfit)
}

/// All adapters that can run the pipeline, best first.
#[must_use]
pub fn list_adapters() -> Vec<AdapterSummary> {
    survey_adapters().0
}

/// All adapters that can run the pipeline, best first, and of each of the others a sentence on why it cannot.
#[must_use]
pub fn survey_adapters() -> (Vec<AdapterSummary>, Vec<String>) {
    let (found, unfit) = adapters();
    (summaries(&found), unfit)
}

/// Summaries in the same order.
pub(super) fn summaries(adapters: &[wgpu::Adapter]) -> Vec<AdapterSummary> {
    let summary = |(index, a): (usize, &wgpu::Adapter)| {
        let (info, features) = (a.get_info(), a.features());
        let subgroups = features.contains(wgpu::Features::SUBGROUP);
        AdapterSummary {
            index,
            pci_bus_id: Some(info.device_pci_bus_id).filter(|bus| !bus.is_empty()),
            name: info.name,
            backend: format!("{:?}", info.backend),
            kind: format!("{:?}", info.device_type),
            driver: format!("{} {}", info.driver, info.driver_info).trim().to_owned(),
            max_binding_bytes: max_binding_bytes(&a.limits()),
            subgroup_size: if subgroups { (info.subgroup_min_size, info.subgroup_max_size) } else { (0, 0) },
            timestamps: features.contains(wgpu::Features::TIMESTAMP_QUERY),
        }
    };
    adapters.iter().enumerate().map(summary).collect()
}

/// Index of the adapter selected by `wanted`, as [`super::Gpu::open`] documents.
pub(super) fn choose(wanted: Option<&str>, all: &[AdapterSummary], unfit: &[String]) -> Result<usize, GpuError> {
    if all.is_empty() {
        return Err(GpuError::NoAdapter { unfit: unfit.to_owned() });
    }
    let Some(wanted) = wanted else { return Ok(0) };
    let found = if let Some(index) = wanted.strip_prefix('#') {
        index.parse().ok().filter(|index| *index < all.len())
    } else if let Some(bus) = parse_bus_id(wanted) {
        all.iter().position(|a| a.pci_bus_id.as_deref().and_then(parse_bus_id) == Some(bus))
    } else {
        let part = wanted.to_lowercase();
        all.iter().position(|a| a.name.to_lowercase().contains(&part))
    };
    found.ok_or_else(|| GpuError::NoSuchAdapter {
        wanted: wanted.to_owned(),
        available: {
            let named = all.iter().map(ToString::to_string).collect::<Vec<_>>().join(", ");
            // The requested adapter may be among the unusable ones.
            unfit.iter().fold(named, |all, unfit| format!("{all}; {unfit}"))
        },
    })
}

/// Domain, bus, device and function of a PCI bus id. Programs differ in the digits of the domain, which some leave out,
/// and in case.
fn parse_bus_id(text: &str) -> Option<[u32; 4]> {
    let (rest, function) = text.rsplit_once('.')?;
    let (rest, device) = rest.rsplit_once(':')?;
    let (domain, bus) = rest.rsplit_once(':').unwrap_or(("0", rest));
    let number = |digits: &str| u32::from_str_radix(digits, 16).ok();
    Some([number(domain)?, number(bus)?, number(device)?, number(function)?])
}

#[cfg(test)]
mod tests {
    use super::*;

    fn adapter(index: usize, name: &str, bus: Option<&str>) -> AdapterSummary {
        AdapterSummary {
            index,
            pci_bus_id: bus.map(str::to_owned),
            name: name.to_owned(),
            backend: "Vulkan".to_owned(),
            kind: "DiscreteGpu".to_owned(),
            driver: String::new(),
            max_binding_bytes: 1 << 30,
            subgroup_size: (32, 32),
            timestamps: true,
        }
    }

    fn node() -> [AdapterSummary; 4] {
        [
            adapter(0, "NVIDIA H100", Some("0000:41:00.0")),
            adapter(1, "NVIDIA H100", Some("0000:c1:00.0")),
            adapter(2, "NVIDIA H100", Some("0001:41:00.0")),
            adapter(3, "llvmpipe (LLVM 15)", None),
        ]
    }

    #[test]
    fn loops_end_on_mesas_software_adapter_alone() {
        assert_eq!(loop_passes("llvmpipe (LLVM 15.0.6, 256 bits)", true), Some(65_535));
        for (name, is_cpu) in [
            ("Microsoft Basic Render Driver", true),
            ("SwiftShader Device (Subzero)", true),
            ("NVIDIA H100", false),
            ("Virtio-GPU Venus (llvmpipe)", false),
        ] {
            assert_eq!(loop_passes(name, is_cpu), None, "{name}");
        }
    }

    #[test]
    fn equal_adapters_are_told_apart_by_index_and_bus() {
        for (wanted, expected) in [
            ("#0", 0),
            ("#1", 1),
            ("#3", 3),
            ("0000:41:00.0", 0),
            ("0000:c1:00.0", 1),
            ("41:00.0", 0),
            // Bus addresses as printed by nvidia-smi.
            ("00000000:C1:00.0", 1),
            ("00000001:41:00.0", 2),
            ("h100", 0),
            // Without `#`, a digit is part of a name.
            ("15", 3),
            ("", 0),
        ] {
            assert_eq!(choose(Some(wanted), &node(), &[]).unwrap(), expected, "{wanted}");
        }
        assert_eq!(choose(None, &node(), &[]).unwrap(), 0);
    }

    #[test]
    fn what_is_not_there_is_an_error_that_lists_what_is() {
        for wanted in ["#4", "#-1", "#", "#h100", "0000:42:00.0", "0000:41:00.1", "abacus"] {
            let expected = format!(
                "no adapter matches {wanted:?}; available: #0 NVIDIA H100 (0000:41:00.0), #1 NVIDIA H100 (0000:c1:00.0), \
                 #2 NVIDIA H100 (0001:41:00.0), #3 llvmpipe (LLVM 15)"
            );
            assert_eq!(choose(Some(wanted), &node(), &[]).unwrap_err().to_string(), expected);
        }
        let nothing = |wanted, unfit: &[String]| choose(wanted, &[], unfit).unwrap_err().to_string();
        assert!(nothing(Some("#0"), &[]).starts_with("no GPU adapter found: install "));
        // An adapter that exists but lacks features is not reported as missing.
        let old = wgpu::Limits { max_storage_buffers_per_shader_stage: 8, ..wgpu::Limits::default() };
        let old = [format!("Old One by Gl {}", lack(&old).unwrap())];
        let said = "(Old One by Gl has 8 storage buffers per shader stage, expected 12)";
        assert!(
            nothing(None, &old).starts_with(&format!("no GPU adapter will do {said}: install ")),
            "{}",
            nothing(None, &old)
        );
        let error = choose(Some("old"), &node(), &old).unwrap_err().to_string();
        assert!(
            error.ends_with("#3 llvmpipe (LLVM 15); Old One by Gl has 8 storage buffers per shader stage, expected 12"),
            "{error}"
        );
    }
}
