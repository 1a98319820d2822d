//! The compute pipeline on wgpu. `device` is the only file that talks to wgpu; every stage is one WGSL file of the
//! same name in `shaders/`.

mod device;
mod scan;
mod shader;
mod sort;
mod view;

pub use device::{AdapterSummary, Gpu, GpuError, Profile, list_adapters};
