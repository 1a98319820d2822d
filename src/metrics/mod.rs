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

use crate::scene::SceneError;

/// Checks that a render has the size of its photograph.
fn check_same_size(truth: &Rgb32FImage, render: &Rgb32FImage) -> Result<(), SceneError> {
    let (expected, found) = (truth.dimensions(), render.dimensions());
    if found == expected {
        return Ok(());
    }
    let expected = format!("{}×{} pixels as in the photograph", expected.0, expected.1);
    Err(SceneError::new("render", expected, format!("{}×{}", found.0, found.1)))
}

/// Checks that an image has the least side that a metric supports.
fn check_least(metric: &str, least: u32, (width, height): (u32, u32)) -> Result<(), SceneError> {
    if width.min(height) >= least {
        return Ok(());
    }
    let expected = format!("images of at least {least}×{least} pixels");
    Err(SceneError::new(metric, expected, format!("{width}×{height}")))
}
