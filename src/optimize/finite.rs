//! Detection of parameters that are no longer finite.

use super::{Phase, TrainError};
use crate::render::gpu::{state::SplatState, training::Training};

/// Error naming the parameter group that holds a NaN or an infinity, if one does. Waits for the GPU.
pub(super) fn check_finite(training: &Training, phase: Phase, iteration: u32) -> Result<(), TrainError> {
    let (first, second) = training.read_texel_moments()?;
    finite(&training.read_splats()?, [&first, &second], phase, iteration)
}

/// Error naming the parameter group that holds a NaN or an infinity, if one does: splats, or the maps that these
/// moments belong to.
pub(super) fn finite(
    splats: &SplatState,
    moments: [&[f32]; 2],
    phase: Phase,
    iteration: u32,
) -> Result<(), TrainError> {
    finite_splats(splats, phase, iteration)?;
    // The maps themselves are checked when they are read; their moments follow their gradients.
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
