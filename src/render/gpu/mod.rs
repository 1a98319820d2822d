//! The compute pipeline on wgpu. Only `device` uses wgpu directly; every stage is one WGSL file of the same name in
//! `shaders/`.

pub(crate) mod adam;
mod backward;
mod blend;
mod device;
pub(crate) mod exposure;
#[cfg(test)]
mod exposure_disparity_tests;
#[cfg(test)]
mod exposure_tests;
mod front;
#[cfg(test)]
mod gather_tests;
mod geometry;
mod layered;
#[cfg(test)]
mod layered_tests;
pub(crate) mod loss;
pub mod measure;
pub mod memory;
#[cfg(test)]
mod memory_tests;
mod mesh;
#[cfg(test)]
mod mesh_tests;
pub(crate) mod per_view;
pub(crate) mod photographs;
mod picture;
mod pipeline;
pub(crate) mod pose;
#[cfg(test)]
mod pose_tests;
mod renderer;
pub(crate) mod rows;
mod scan;
mod shader;
mod smoothing;
mod sort;
pub(crate) mod splats;
pub mod state;
pub(crate) mod status;
pub(crate) mod texels;
mod tile_pairs;
pub(crate) mod training;
mod unit;
pub(crate) mod vertices;
pub(crate) mod view;

pub use device::{AdapterSummary, Gpu, GpuError, Profile, list_adapters, survey_adapters};
pub use layered::{LayeredPicture, LayeredRenderer};
pub use picture::Picture;
pub use renderer::Renderer;

#[cfg(test)]
mod tests;
#[cfg(test)]
mod texel_tests;
#[cfg(test)]
mod training_list_tests;
#[cfg(test)]
mod training_tests;
#[cfg(test)]
mod vertex_tests;
