//! **Centaur**: hybrid scenes of textured, semi-transparent meshes and 3D Gaussian splats, blended in one stable
//! depth order.
//!
//! Data flows `capture` → `geometry` → `scene` → `optimize` (over `render`, `metrics`) → `scene` → `format`.
//! ARCHITECTURE.md has the map and the invariants.

#![cfg_attr(test, allow(clippy::unwrap_used, clippy::print_stderr, reason = "a failed unwrap is a failed test"))]

pub mod capture;
pub mod edit;
pub mod format;
pub mod geometry;
pub mod metrics;
pub mod optimize;
pub mod path;
pub mod render;
pub mod scene;
