//! Limits on the size of a scene, from the options and the adapter's binding sizes.

use crate::{
    optimize::{MeshSource, TrainError, TrainOptions, memory},
    scene::{Mesh, Splats},
};

/// Limits on splats and maps.
pub(super) struct Budget<'a> {
    options: &'a TrainOptions,
    /// Longest side of all pictures, pixels.
    longest_side: u32,
    /// Largest number of splats that the adapter can bind.
    bindable: usize,
    /// Whether maps keep their initial size, never being packed again.
    maps_stay: bool,
}

impl<'a> Budget<'a> {
    pub(super) fn of(options: &'a TrainOptions, source: &MeshSource, longest_side: u32, bindable: usize) -> Self {
        Self { options, longest_side, bindable, maps_stay: !source.is_found() || options.warmup == 0 }
    }

    /// Checks that meshes leave floats for at least one splat.
    ///
    /// # Errors
    /// [`TrainError::Budget`] with both numbers, if not.
    pub(super) fn check(&self, meshes: &[Mesh]) -> Result<(), TrainError> {
        let needed = meshes.iter().map(Mesh::floats).sum::<usize>() + Splats::floats_each(self.options.sh_degree);
        match self.options.max_floats {
            Some(found) if found < needed => Err(TrainError::Budget { needed, found }),
            _ => Ok(()),
        }
    }

    /// Largest number of splats that budgets and binding sizes allow beside these meshes.
    pub(super) fn splats_beside(&self, meshes: &[Mesh]) -> usize {
        let mesh: usize = meshes.iter().map(Mesh::floats).sum();
        let left = |floats: usize| floats.saturating_sub(mesh) / Splats::floats_each(self.options.sh_degree);
        let by_floats = self.options.max_floats.map_or(usize::MAX, |floats| left(floats).max(1));
        let asked = self.options.max_splats.unwrap_or(TrainOptions::MOST_SPLATS);
        asked.min(by_floats).min(self.bindable)
    }

    /// Largest side of a mesh's maps, texels.
    pub(super) fn largest_texture(&self) -> u32 {
        self.options
            .texture_size
            .unwrap_or_else(|| (3 * self.longest_side).div_ceil(2).next_power_of_two().clamp(128, 2048))
    }

    /// Initial side of a mesh's maps, texels. Maps that are never packed again leave at least half of a budget to the
    /// rest, space for charts permitting.
    pub(super) fn texture_size(&self) -> u32 {
        let wanted = self.largest_texture();
        let budget = self.options.max_floats.filter(|_| self.maps_stay);
        budget.map_or(wanted, |floats| memory::texture_size_within(self.options, wanted, floats / 2))
    }
}
