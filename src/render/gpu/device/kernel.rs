//! Compiled entry points of `shaders/`, and their bindings to buffers.

use std::sync::{Arc, PoisonError};

use super::{Buffer, Gpu, buffer::Allocation};
use crate::render::gpu::shader::{self, Access, Defines};

/// A compiled compute entry point. Cheap to clone.
#[derive(Clone)]
pub(crate) struct Kernel {
    pub(super) label: Arc<str>,
    pipeline: wgpu::ComputePipeline,
    layout: wgpu::BindGroupLayout,
    /// Binding numbers, in order.
    slots: Arc<[u32]>,
    /// Threads per workgroup.
    pub(super) threads: usize,
}

/// A kernel with its buffers, ready to be dispatched.
pub(crate) struct Stage {
    pub(super) kernel: Kernel,
    bindings: wgpu::BindGroup,
    /// Keeps the buffers counted, which the bind group keeps alive.
    _allocations: Vec<Arc<Allocation>>,
}

impl Stage {
    /// As [`Kernel::new`], then [`Kernel::bind`].
    pub(crate) fn new(gpu: &Gpu, file: &str, entry: &str, defines: &Defines, buffers: &[&Buffer]) -> Self {
        Kernel::new(gpu, file, entry, defines).bind(gpu, buffers)
    }

    /// Selects it for the pass's next dispatch.
    pub(super) fn encode(&self, pass: &mut wgpu::ComputePass) {
        pass.set_pipeline(&self.kernel.pipeline);
        pass.set_bind_group(0, &self.bindings, &[]);
    }
}

impl Kernel {
    /// Entry point `entry` of `shaders/<file>`, specialised by `defines`; compiled once per adapter.
    pub(crate) fn new(gpu: &Gpu, file: &str, entry: &str, defines: &Defines) -> Self {
        let mut kernels = gpu.kernels.lock().unwrap_or_else(PoisonError::into_inner);
        let key = (format!("{file}:{entry}"), defines.clone());
        kernels.entry(key).or_insert_with(|| Self::compile(gpu, file, entry, defines)).clone()
    }

    fn compile(gpu: &Gpu, file: &str, entry: &str, defines: &Defines) -> Self {
        let mut wgsl = shader::preprocess(file, defines);
        if gpu.loop_passes.is_some() {
            // Mesa's software adapter compiles uniforms that decide on branches and loops into the code, anew for every
            // run. It does not do so with storage.
            wgsl = wgsl.replace("var<uniform>", "var<storage, read>");
        }
        #[cfg(test)]
        {
            keep(&wgsl, file, entry);
            super::translation::check(&wgsl, entry, gpu.profile.subgroups);
        }
        let bindings = shader::bindings(&wgsl);
        let threads = shader::workgroup_size(&wgsl, entry, defines) as usize;
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
        Self { label: label.into(), pipeline, layout, slots: bindings.iter().map(|b| b.0).collect(), threads }
    }

    /// Binds the kernel to `buffers`, in the order of the shader's binding numbers.
    pub(crate) fn bind(&self, gpu: &Gpu, buffers: &[&Buffer]) -> Stage {
        assert_eq!(self.slots.len(), buffers.len(), "{} has {} bindings", self.label, self.slots.len());
        let entries: Vec<_> = self
            .slots
            .iter()
            .zip(buffers)
            .map(|(&binding, b)| wgpu::BindGroupEntry { binding, resource: b.raw.as_entire_binding() })
            .collect();
        let bindings = gpu.device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: Some(&self.label),
            layout: &self.layout,
            entries: &entries,
        });
        let _allocations = buffers.iter().map(|b| Arc::clone(&b.allocation)).collect();
        Stage { kernel: self.clone(), bindings, _allocations }
    }
}

/// Writes the compiled source to the folder that `CENTAUR_WGSL` names, for `make oracle-tint`.
#[cfg(test)]
fn keep(wgsl: &str, file: &str, entry: &str) {
    use std::hash::{DefaultHasher, Hash as _, Hasher as _};

    let Some(folder) = std::env::var_os("CENTAUR_WGSL") else { return };
    let mut hasher = DefaultHasher::new();
    wgsl.hash(&mut hasher);
    let stem = file.trim_end_matches(".wgsl").replace('/', "_");
    let name = format!("{stem}-{entry}-{:016x}.wgsl", hasher.finish());
    std::fs::write(std::path::Path::new(&folder).join(name), wgsl).unwrap();
}
