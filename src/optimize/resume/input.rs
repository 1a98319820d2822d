//! What a run was given, as far as its checkpoint tells it from others.

use std::fmt;

use serde::{Deserialize, Serialize};

/// Views, points and mesh.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(in crate::optimize) struct Input {
    pub(in crate::optimize) views: Vec<InputView>,
    /// How many points there are.
    pub(in crate::optimize) points: usize,
    /// Digest of where they are.
    pub(in crate::optimize) positions: u64,
    pub(in crate::optimize) mesh: InputMesh,
}

/// A view of the capture, whatever part it has in the run.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(in crate::optimize) struct InputView {
    pub(in crate::optimize) name: String,
    /// Of the pictures that are trained on, pixels.
    pub(in crate::optimize) width: u32,
    pub(in crate::optimize) height: u32,
    /// Digest of pose, focal lengths and principal point.
    pub(in crate::optimize) camera: u64,
    /// Bytes of its file.
    pub(in crate::optimize) photograph: u64,
    /// Bytes of the mask's file, if it has one.
    pub(in crate::optimize) mask: Option<u64>,
    /// Whether the capture itself keeps it for scores.
    pub(in crate::optimize) held_out: Option<bool>,
    /// The distortion that it is straightened by, in words.
    pub(in crate::optimize) lens: String,
}

/// Where the mesh comes from.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(in crate::optimize) enum InputMesh {
    None,
    Splats,
    Points,
    Given {
        triangles: usize,
        /// Digest of positions, corners and texture coordinates.
        shape: u64,
    },
}

impl fmt::Display for InputMesh {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Self::None => f.write_str("none"),
            Self::Splats => f.write_str("splats"),
            Self::Points => f.write_str("points"),
            Self::Given { triangles, shape } => write!(f, "given, {triangles} triangles, {shape:016x}"),
        }
    }
}
