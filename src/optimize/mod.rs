//! From a capture to a scene.
//!
//! [`train`] is all of it, with [`TrainOptions`] and a [`MeshSource`]. [`surface_from_splats`] and [`surface_from_points`] make a surface alone, [`initialize`] the splats that a
//! run begins with; [`checkpoint`] reads what a run leaves when it stops.

mod arrangement;
mod background;
mod cells;
pub mod checkpoint;
mod coverage;
mod cut_out;
mod density;
mod finite;
mod fused;
pub mod initialize;
mod log;
mod maps;
mod memory;
mod mesh_source;
mod options;
mod random;
mod resolution;
mod resume;
mod schedule;
mod seen_points;
mod size;
mod static_scene;

pub use fused::{from_points as surface_from_points, from_splats as surface_from_splats};
pub use log::{Progress, Selection};
pub use mesh_source::{MeshSource, SurfaceOrigin};
pub use options::{Background, Density, Phase, TrainOptions};
pub use seen_points::point_views;
pub use static_scene::{Checkpoints, Outcome, RefinedPose, Session, Trained, train};

use crate::{capture::CaptureError, geometry::GeometryError, render::gpu::GpuError, scene::SceneError};

/// Why a run failed.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TrainError {
    /// A photograph could not be read.
    #[error(transparent)]
    Capture(#[from] CaptureError),
    /// No surface could be made.
    #[error("making the mesh: {0}")]
    Geometry(#[from] GeometryError),
    /// The adapter failed.
    #[error(transparent)]
    Gpu(#[from] GpuError),
    /// A value cannot be part of a scene.
    #[error("the trained scene is not valid: {0}")]
    Scene(#[from] SceneError),
    /// An option is outside of what it may be.
    #[error("options: {0}")]
    Options(SceneError),
    /// A checkpoint could not be written or read.
    #[error(transparent)]
    Checkpoint(#[from] checkpoint::CheckpointError),
    /// A checkpoint does not fit the run.
    #[error("{0}")]
    Resume(String),
    /// Nothing to train on.
    #[error("{capture}: expected at least 2 views to train on besides those held out, found {found} in all")]
    TooFewViews {
        /// Name of the capture.
        capture: String,
        /// Views in the capture.
        found: usize,
    },
    /// What cannot be done together.
    #[error("poses are refined by splats before there is a mesh: expected none to be given, found one")]
    PosesBesideMesh,
    /// The mesh that is given lies where no photograph looks.
    #[error(
        "expected a mesh that training views see, found none of it in any: is it in the frame and the unit of the poses?"
    )]
    UnseenMesh,
    /// The budget has no room for the mesh and a splat.
    #[error("expected a budget of at least the {needed} floats that the mesh and one splat take, found {found}")]
    Budget {
        /// Floats of vertices, maps and a splat.
        needed: usize,
        /// [`TrainOptions::max_floats`].
        found: usize,
    },
    /// A parameter went to NaN or infinity.
    #[error("iteration {iteration} ({phase:?}): {group} not finite")]
    NotFinite {
        /// Phase of the run.
        phase: Phase,
        /// Iteration in that phase at which it was found.
        iteration: u32,
        /// Which parameters.
        group: String,
    },
}

/// What was made, or why it cannot be made of this geometry. What the splats have learnt is worth more than a mesh: that does not end a run.
fn or_why_not<T>(made: Result<T, TrainError>) -> Result<Result<T, GeometryError>, TrainError> {
    match made {
        Ok(made) => Ok(Ok(made)),
        Err(TrainError::Geometry(why)) => Ok(Err(why)),
        Err(error) => Err(error),
    }
}
