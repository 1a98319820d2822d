//! Hybrid scenes as plain, validated data. No file formats, no GPU.
//!
//! Frames and units: world space is right-handed and has the capture's own unit of length. Camera space is
//! OpenCV's (x right, y down, z forward); **depth always means camera-space z**, for splats and meshes alike.
//! Colours are display-referred (sRGB-encoded) unless [`Composition::color_space`] says otherwise.

mod bounds;
mod camera;
mod centers;
pub mod color;
mod composition;
pub mod frame;
mod gather;
mod mesh;
mod morton;
mod optical_axes;
pub(crate) mod placement;
pub mod rig;
pub mod sh;
mod smoothing;
mod splats;
#[cfg(test)]
pub(crate) mod testing;

use rayon::prelude::*;

pub use bounds::bounds;
pub use camera::{Camera, Intrinsics};
pub(crate) use camera::{nearest_rotation, view_axes};
pub use centers::center_and_spread;
pub use composition::{ColorSpace, Composition, OrderMode, PixelFilter};
pub use gather::gather;
pub(crate) use gather::keep_rows;
pub(crate) use mesh::without_unused;
pub use mesh::{Atlas, Mesh, Texture};
pub use morton::in_morton_order;
pub(crate) use optical_axes::OpticalAxes;
pub use smoothing::smoothed;
pub(crate) use smoothing::smoothed_parameters;
pub use splats::{SplatArrays, Splats};

/// Largest coordinate given to generated geometry, world units: its square still fits in f32.
pub(crate) const LARGEST_COORDINATE: f64 = 1e18;

/// 1/(1+e⁻ˣ): from a logit, as opacities are kept, to an opacity.
#[must_use]
pub fn sigmoid(x: f64) -> f64 {
    1.0 / (1.0 + (-x).exp())
}

/// Inverse of [`sigmoid`]: infinite for 0 and 1.
#[must_use]
pub fn logit(opacity: f64) -> f64 {
    (opacity / (1.0 - opacity)).ln()
}

/// Splats, meshes and the rule by which they are blended.
///
/// By agreement it is in the frame of captures, of COLMAP and INRIA's `.ply`: x to the right, y down, z forward. A
/// scene keeps the world of its capture, and nothing here depends on where up is in that, but
/// [`read_scene`](crate::format::read_scene) turns files that are y up to y down, and
/// [`write_scene`](crate::format::write_scene) turns what it writes as y up.
#[derive(Clone, Debug, PartialEq)]
pub struct HybridScene {
    /// The 3D Gaussians; may be empty.
    pub splats: Splats,
    /// The textured, semi-transparent meshes; may be empty, in which case the scene is plain 3DGS.
    pub meshes: Vec<Mesh>,
    /// Rule by which both are put into one depth order and blended.
    pub composition: Composition,
}

impl HybridScene {
    /// Number of optimised floats: 11 + 3·(d+1)² per splat, the atlas texels, and 3 per mesh vertex.
    ///
    /// This is the budget in which hybrids and pure splats are compared (docs/results.md).
    #[must_use]
    pub fn total_floats(&self) -> usize {
        let splats = self.splats.len() * Splats::floats_each(self.splats.sh_degree());
        splats + self.meshes.iter().map(Mesh::floats).sum::<usize>()
    }
}

/// Error for a value that is not as expected in a scene, in the options, arguments, checkpoints and weights that scenes
/// come from, or in images that are compared: the field, and what is wrong with it.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{field}: expected {expected}, found {found}")]
pub struct SceneError {
    /// Name of the field, with an index where one element is at fault: `means[17]`.
    pub field: String,
    /// What is expected.
    pub expected: String,
    /// What was found.
    pub found: String,
}

impl SceneError {
    pub(crate) fn new(field: impl Into<String>, expected: impl Into<String>, found: impl Into<String>) -> Self {
        Self { field: field.into(), expected: expected.into(), found: found.into() }
    }
}

/// Checks that an array has `expected` elements.
fn check_len(field: &str, found: usize, expected: usize) -> Result<(), SceneError> {
    if found == expected {
        return Ok(());
    }
    Err(SceneError::new(field, format!("{expected} elements"), format!("{found}")))
}

/// Checks that all `values` (rows of `width` floats) are finite; the error names the first row that is not.
pub(crate) fn check_finite(field: &str, values: &[f32], width: usize) -> Result<(), SceneError> {
    // Whole blocks are checked first: without an early exit the loop is vectorised.
    const BLOCK: usize = 1 << 14;
    let at_fault = values.par_chunks(BLOCK).enumerate().find_map_first(|(block, values)| {
        let finite = values.iter().fold(true, |all, v| all & v.is_finite());
        if finite { None } else { values.iter().position(|v| !v.is_finite()).map(|i| block * BLOCK + i) }
    });
    match at_fault {
        None => Ok(()),
        Some(i) => Err(SceneError::new(format!("{field}[{}]", i / width), "finite numbers", values[i].to_string())),
    }
}
