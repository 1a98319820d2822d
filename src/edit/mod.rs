//! Edits of a scene: moving, filtering, thinning and joining. Pure functions in linear or n·log n time, whose results
//! do not depend on the number of threads.
//!
//! Whatever chooses among splats returns their indices, to be taken with [`gather`](crate::scene::gather): what a file
//! says about its splats besides their parameters can follow them.

mod axes;
mod join;
#[cfg(test)]
mod property_tests;
mod select;
mod similarity;
#[cfg(test)]
mod tests;

pub use axes::Axes;
pub use join::{join, with_mesh_sh_degree, with_sh_degree};
pub use select::{Crop, Volume, crop_mesh, in_crops, most_important, not_below_opacity};
pub use similarity::Similarity;
