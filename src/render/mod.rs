//! From a scene and a camera to pixels.

pub mod gpu;
