//! From a capture to a scene.

pub mod checkpoint;
pub mod density;
pub mod initialize;
pub mod schedule;
pub mod state;
