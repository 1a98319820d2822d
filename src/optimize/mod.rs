//! Optimisation: from a capture to a scene.
//!
//! [`train`] does all of it, given [`TrainOptions`] and a [`MeshSource`]. [`surface_from_splats`] and
//! [`surface_from_points`] only make a surface, [`initialize`] the initial splats of a run; [`checkpoint`] reads the
//! state that a stopped run leaves.

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
pub use log::{Event, Progress, Selection};
pub use mesh_source::{MeshSource, SurfaceOrigin};
pub use options::{Background, Density, Phase, TrainOptions};
pub use seen_points::point_views;
pub use static_scene::{Checkpoints, Outcome, RefinedPose, Session, Trained, train};

use crate::{capture::CaptureError, geometry::GeometryError, render::gpu::GpuError, scene::SceneError};

/// Error of a training run.
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
    /// A resulting value is not valid in a scene.
    #[error("the trained scene is not valid: {0}")]
    Scene(#[from] SceneError),
    /// An option is out of range.
    #[error("options: {0}")]
    Options(SceneError),
    /// A checkpoint could not be written or read.
    #[error(transparent)]
    Checkpoint(#[from] checkpoint::CheckpointError),
    /// A checkpoint belongs to another run.
    #[error("{0}")]
    Resume(String),
    /// Fewer than two views to train on.
    #[error("{capture}: expected at least 2 views to train on besides those held out, found {found} in all")]
    TooFewViews {
        /// Name of the capture.
        capture: String,
        /// Views in the capture.
        found: usize,
    },
    /// A scene too small or too large in its unit of length.
    #[error(
        "{capture}: expected a scene that views see from {:e} to {:e} units away, found one that they see from {found:.1e}; scale poses and points, as COLMAP's model_transformer does",
        size::DISTANCES.start(),
        size::DISTANCES.end()
    )]
    Unit {
        /// Name of the capture.
        capture: String,
        /// Typical distance of what views see, in the unit of the poses.
        found: f32,
    },
    /// Poses were to be refined beside a given mesh.
    #[error("poses are refined by splats before there is a mesh: expected no given mesh, found one")]
    PosesBesideMesh,
    /// No training view sees the given mesh.
    #[error(
        "expected a mesh that training views see, found none of it in any view: is it in the frame and unit of the camera poses?"
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
    /// A parameter became NaN or infinite.
    #[error("iteration {iteration} ({}): {group} not finite", .phase.name())]
    NotFinite {
        /// Phase of the run.
        phase: Phase,
        /// Iteration in that phase at which it was found.
        iteration: u32,
        /// The parameter group.
        group: String,
    },
}

/// Separates geometric failures, `Ok(Err(_))`, from all others, `Err(_)`: the run keeps what the splats have learnt and
/// goes on without a mesh.
fn or_why_not<T>(made: Result<T, TrainError>) -> Result<Result<T, GeometryError>, TrainError> {
    match made {
        Ok(made) => Ok(Ok(made)),
        Err(TrainError::Geometry(why)) => Ok(Err(why)),
        Err(error) => Err(error),
    }
}
