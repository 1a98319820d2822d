//! What no training view sees of a mesh that is brought along is transparent.

use glam::DVec2;
use rayon::prelude::*;

use super::Run;
use crate::{
    geometry::{self, MeshBvh, TexelSight, TexelVisibility, Viewers},
    optimize::{TrainError, resolution::ResolutionSchedule},
    render::gpu::loss::TruthAlpha,
    scene::{Atlas, Mesh, Texture},
};

/// Texels along the side of the map on which rays are cast, at most: what nobody sees takes a ray for every view.
const LONGEST_SIDE: usize = 1024;
/// Opacity logit of what is not seen: the least that maps have (`adam_texels.wgsl`).
pub(super) const TRANSPARENT: f32 = -6.0;

/// Which pixels of a photograph a mask leaves in, 64 to a number.
struct MaskBits {
    width: usize,
    pixels: Vec<u64>,
}

impl Run<'_> {
    /// The mesh with those texels of charts transparent that enter nothing that the training views show: they would stay as they were made.
    /// Between charts there is nothing to see, and mip levels would mix it with their rims.
    pub(super) fn without_unseen(&self, mesh: Mesh) -> Result<Mesh, TrainError> {
        let base = mesh.atlas().base();
        let [width, height] = [base.width() as usize, base.height() as usize];
        let halvings = (0..16).find(|n| width.max(height) >> n <= LONGEST_SIDE).unwrap_or(16);
        let sights = self.texel_visibility(&mesh, [width, height].map(|side| (side >> halvings).max(1)))?;
        let reached = sights.reached(self.coarser());
        let [columns, rows] = sights.size;
        let mut texels = base.texels().to_vec();
        for (i, texel) in texels.chunks_exact_mut(4).enumerate() {
            let [x, y] = [i % width, i / width].map(|at| at >> halvings);
            let at = y.min(rows - 1) * columns + x.min(columns - 1);
            if sights.texels[at] == TexelSight::Hidden && !reached[at] {
                texel[3] = TRANSPARENT;
            }
        }
        let base = Texture::new(base.width(), base.height(), base.channels(), texels)?;
        let atlas = Atlas::new(base, mesh.atlas().bands().cloned())?;
        Ok(mesh.with_atlas(atlas))
    }

    /// Mip levels by which the smallest pictures of the run read coarser ones than those of full size.
    fn coarser(&self) -> u8 {
        let first = ResolutionSchedule { full_from: u32::from(self.options.coarse_to_fine) };
        -first.scale(0, self.longest_side).log2().floor() as u8
    }

    /// What the training views see of a map of `size` texels, (width, height), if there is no other mesh.
    pub(super) fn texel_visibility(&self, mesh: &Mesh, size: [usize; 2]) -> Result<TexelVisibility, TrainError> {
        let shown = self.shown()?;
        let shows = |view: usize, at: DVec2| shown.get(view).is_none_or(|shown| shown.holds(at));
        let viewers = Viewers {
            cameras: &self.train_cameras,
            near: f64::from(self.composition().near),
            layers: self.options.layers as usize,
            shows: &shows,
        };
        let bvh = MeshBvh::new([(mesh.positions(), mesh.triangles())]);
        Ok(geometry::texel_visibility(mesh, size, &bvh, &viewers)?)
    }

    /// What masks leave of the training views; empty if there are none.
    fn shown(&self) -> Result<Vec<MaskBits>, TrainError> {
        if self.truth_alpha != TruthAlpha::Mask {
            return Ok(vec![]);
        }
        let (cache, capture) = (&self.cache, self.capture);
        let of_view = |&i: &usize| {
            let photo = cache.get(&capture.views[i])?;
            Ok(MaskBits::new(photo.width as usize, &photo.rgba))
        };
        self.train.par_iter().map(of_view).collect()
    }
}

impl MaskBits {
    fn new(width: usize, rgba: &[u8]) -> Self {
        let bits = |row: &[u8]| row.chunks_exact(4).rev().fold(0, |bits, rgba| bits << 1 | u64::from(rgba[3] > 0));
        Self { width, pixels: rgba.chunks(4 * 64).map(bits).collect() }
    }

    fn holds(&self, at: DVec2) -> bool {
        let pixel = at.y as usize * self.width + at.x as usize;
        self.pixels.get(pixel / 64).is_some_and(|bits| bits >> (pixel % 64) & 1 == 1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn masks_are_kept_by_the_bit() {
        // 9 pixels to a row, so that rows do not begin with a number.
        let alpha = |pixel: usize| u8::from(pixel % 7 == 3) * 200;
        let rgba: Vec<u8> = (0..9 * 20).flat_map(|pixel| [0, 0, 0, alpha(pixel)]).collect();
        let shown = MaskBits::new(9, &rgba);
        for pixel in 0..9 * 20 {
            let at = DVec2::new((pixel % 9) as f64 + 0.9, (pixel / 9) as f64);
            assert_eq!(shown.holds(at), alpha(pixel) > 0, "{pixel}");
        }
        assert!(!shown.holds(DVec2::new(8.0, 30.0)));
    }
}
