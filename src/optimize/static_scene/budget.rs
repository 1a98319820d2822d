//! How much a scene may become, by what was asked for and what the adapter binds.

use crate::{
    optimize::{MeshSource, TrainError, TrainOptions, memory},
    scene::{Mesh, Splats},
};

/// Bounds on splats and maps.
pub(super) struct Budget<'a> {
    options: &'a TrainOptions,
    /// Of all pictures.
    longest_side: u32,
    /// Most splats that the adapter binds.
    bindable: usize,
    /// Maps keep the size that they begin with.
    maps_stay: bool,
}

impl<'a> Budget<'a> {
    pub(super) fn of(options: &'a TrainOptions, source: &MeshSource, longest_side: u32, bindable: usize) -> Self {
        Self { options, longest_side, bindable, maps_stay: !source.is_found() || options.warmup == 0 }
    }

    /// Whether meshes leave floats for a splat at least.
    ///
    /// # Errors
    /// With both numbers, if not.
    pub(super) fn check(&self, meshes: &[Mesh]) -> Result<(), TrainError> {
        let needed = meshes.iter().map(Mesh::floats).sum::<usize>() + Splats::floats_each(self.options.sh_degree);
        match self.options.max_floats {
            Some(found) if found < needed => Err(TrainError::Budget { needed, found }),
            _ => Ok(()),
        }
    }

    /// Most splats that the budgets and the adapter's bindings allow beside these meshes.
    pub(super) fn splats_beside(&self, meshes: &[Mesh]) -> usize {
        let mesh: usize = meshes.iter().map(Mesh::floats).sum();
        let left = |floats: usize| floats.saturating_sub(mesh) / Splats::floats_each(self.options.sh_degree);
        let by_floats = self.options.max_floats.map_or(usize::MAX, |floats| left(floats).max(1));
        let asked = self.options.max_splats.unwrap_or(TrainOptions::MOST_SPLATS);
        asked.min(by_floats).min(self.bindable)
    }

    /// Side of the maps that a mesh has at most.
    pub(super) fn largest_texture(&self) -> u32 {
        self.options
            .texture_size
            .unwrap_or_else(|| (3 * self.longest_side).div_ceil(2).next_power_of_two().clamp(128, 2048))
    }

    /// Side of the maps that a mesh begins with. Those that nothing lays out anew leave at least half of a budget to the rest, as far
    /// as charts have room.
    pub(super) fn texture_size(&self) -> u32 {
        let wanted = self.largest_texture();
        let budget = self.options.max_floats.filter(|_| self.maps_stay);
        budget.map_or(wanted, |floats| memory::texture_size_within(self.options, wanted, floats / 2))
    }
}
