//! What is no longer finite, and which parameters it is.

use super::{Phase, TrainError};
use crate::render::gpu::{state::SplatState, training::Training};

/// Names the parameter group that holds a NaN or an infinity. Waits.
pub(super) fn check_finite(training: &Training, phase: Phase, iteration: u32) -> Result<(), TrainError> {
    let (first, second) = training.read_texel_moments()?;
    finite(&training.read_splats()?, [&first, &second], phase, iteration)
}

/// Names the parameter group that holds a NaN or an infinity: splats, or the maps of which these are the moments.
pub(super) fn finite(
    splats: &SplatState,
    moments: [&[f32]; 2],
    phase: Phase,
    iteration: u32,
) -> Result<(), TrainError> {
    finite_splats(splats, phase, iteration)?;
    // The maps themselves are refused when read; their moments follow their gradients.
    if moments.iter().all(|values| values.iter().all(|v| v.is_finite())) {
        return Ok(());
    }
    Err(TrainError::NotFinite { phase, iteration, group: "a map of the mesh".to_owned() })
}

pub(super) fn finite_splats(state: &SplatState, phase: Phase, iteration: u32) -> Result<(), TrainError> {
    finite_group(state.first_non_finite(), phase, iteration)
}

pub(super) fn finite_group(found: Option<(&str, usize)>, phase: Phase, iteration: u32) -> Result<(), TrainError> {
    found.map_or(Ok(()), |(group, splat)| {
        Err(TrainError::NotFinite { phase, iteration, group: format!("{group} of splat {splat}") })
    })
}
