//! The compute pipeline on wgpu.
