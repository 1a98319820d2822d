//! Image metrics and reports.
//!
//! Images are RGB floats in display-referred \[0, 1\]. Scores meant for comparison with published tables are taken on
//! [`quantised`] images, because INRIA's scripts score images read back from PNG files.

mod evaluation;
mod flip;
mod lpips;
mod markup;
#[cfg(test)]
mod mean_tests;
mod picture;
pub mod plot;
mod psnr;
pub mod report;
mod ssim;

use image::Rgb32FImage;

pub use evaluation::{Evaluation, Measured, Scores, ViewScore};
pub use flip::flip;
pub use lpips::{Lpips, LpipsError, LpipsNet, LpipsRange, LpipsScore};
pub use picture::side_by_side;
pub use psnr::{psnr, quantised, to_rgb8};
pub use ssim::{ssim_inria, ssim_reflect, ssim_valid};

/// Two images that cannot be compared.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum MetricError {
    /// The images differ in size.
    #[error("render: expected {}×{} pixels as in the photograph, found {}×{}", expected.0, expected.1, found.0, found.1)]
    Size {
        /// Width and height of the photograph.
        expected: (u32, u32),
        /// Width and height of the render.
        found: (u32, u32),
    },
    /// An image is smaller than the metric's window allows.
    #[error("{metric}: expected images of at least {least}×{least} pixels, found {}×{}", found.0, found.1)]
    Small {
        /// Name of the metric.
        metric: &'static str,
        /// Smallest side that the metric supports.
        least: u32,
        /// Width and height found.
        found: (u32, u32),
    },
}

fn check_same_size(truth: &Rgb32FImage, render: &Rgb32FImage) -> Result<(), MetricError> {
    if truth.dimensions() == render.dimensions() {
        return Ok(());
    }
    Err(MetricError::Size { expected: truth.dimensions(), found: render.dimensions() })
}

fn check_least(metric: &'static str, least: u32, found: (u32, u32)) -> Result<(), MetricError> {
    if found.0.min(found.1) >= least {
        return Ok(());
    }
    Err(MetricError::Small { metric, least, found })
}
