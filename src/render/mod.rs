//! Rendering: from a scene and a camera to pixels.

pub mod contract;
pub mod gpu;
pub mod reference;
#[cfg(test)]
pub(crate) mod testing;
