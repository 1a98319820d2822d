//! What no training view sees of a mesh that is brought along is transparent.

use glam::DVec2;
use rayon::prelude::*;

use super::Run;
use crate::{
    geometry::{self, MeshBvh, TexelVisibility, Viewers},
    optimize::TrainError,
    render::gpu::loss::TruthAlpha,
    scene::{Atlas, Mesh, Texture},
};

/// Opacity logit of what is not seen: the least that maps have (`adam_texels.wgsl`).
pub(super) const TRANSPARENT: f32 = -6.0;

/// Which pixels of a photograph a mask leaves in, 64 to a number.
struct MaskBits {
    width: usize,
    pixels: Vec<u64>,
}

impl Run<'_> {
    /// The mesh with those texels transparent that enter nothing that the training views show: they would stay as they were made.
    pub(super) fn without_unseen(&self, mesh: Mesh) -> Result<Mesh, TrainError> {
        let reached = self.texel_visibility(&mesh)?.reached();
        let base = mesh.atlas().base();
        let mut texels = base.texels().to_vec();
        for (texel, _) in texels.chunks_exact_mut(4).zip(&reached).filter(|(_, is_reached)| !**is_reached) {
            texel[3] = TRANSPARENT;
        }
        let base = Texture::new(base.width(), base.height(), base.channels(), texels)?;
        let atlas = Atlas::new(base, mesh.atlas().bands().cloned())?;
        Ok(mesh.with_atlas(atlas))
    }

    /// What the training views see of the map of colour and opacity, if there is no other mesh.
    pub(super) fn texel_visibility(&self, mesh: &Mesh) -> Result<TexelVisibility, TrainError> {
        let shown = self.shown()?;
        let shows = |view: usize, at: DVec2| shown.get(view).is_none_or(|shown| shown.holds(at));
        let viewers = Viewers {
            cameras: &self.train_cameras,
            near: f64::from(self.composition().near),
            layers: self.options.layers as usize,
            shows: &shows,
        };
        let base = mesh.atlas().base();
        let size = [base.width() as usize, base.height() as usize];
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
