//! Memory needed for training.

use super::{blend::sums_each, device::Gpu, front::PAIRS_PER_SPLAT, geometry::GEOMETRY_FLOATS, mesh::BIN, view::TILE};
use crate::scene::sh;

/// Room for additional splats in buffers, as a fraction of those there are: growing means new buffers.
const HEADROOM: f64 = 0.5;

/// Largest number of splats of a degree whose longest array fits one binding of the adapter.
#[must_use]
pub fn most_splats(gpu: &Gpu, sh_degree: u32) -> usize {
    let bytes_each = 4 * (3 * sh::coefficients(sh_degree)).max(GEOMETRY_FLOATS);
    gpu.max_binding_bytes() as usize / bytes_each
}

/// Capacity of buffers for `n` splats of a degree, of which there will be at most `most`: no more than these, nor than
/// the adapter binds at once, unless `n` itself exceeds that.
pub(crate) fn with_headroom(gpu: &Gpu, n: usize, sh_degree: u32, most: usize) -> usize {
    let room = (n as f64 * HEADROOM) as usize;
    (n + room).min(most).min(most_splats(gpu, sh_degree)).max(n)
}

/// Sizes that determine the memory of a training run.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct TrainingSize {
    /// Most splats that there will be.
    pub splats: usize,
    /// SH degree of the splats.
    pub sh_degree: u32,
    /// Whether density control uses absolute gradients.
    pub absolute_gradients: bool,
    /// Whether poses of photographs are refined.
    pub poses_move: bool,
    /// Triangles of all meshes.
    pub triangles: usize,
    /// Whether their vertices move.
    pub vertices_move: bool,
    /// Floats of all maps, without mips: 4 per base texel, 3·((d+1)²−1) per texel of bands.
    pub map_floats: usize,
    /// Mesh layers, 0 without a mesh.
    pub layers: usize,
    /// Width of the largest image.
    pub width: usize,
    /// Height of the largest image.
    pub height: usize,
}

/// Bytes of GPU buffers needed for training, by what they scale with.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct TrainingBytes {
    /// Parameters, gradients, moments and lists of the splats.
    pub splats: u64,
    /// Maps of the meshes, with mips, gradients and moments; triangles.
    pub meshes: u64,
    /// Images, layers and the loss's buffers.
    pub images: u64,
}

impl TrainingBytes {
    /// Sum of all bytes, saturating.
    #[must_use]
    pub fn total(&self) -> u64 {
        self.splats.saturating_add(self.meshes).saturating_add(self.images)
    }
}

/// Bytes of GPU buffers needed for training, as long as no view has more (tile, splat) pairs than there is room for at
/// first. That is also the peak while buffers grow to [`TrainingSize::splats`]: the parameters and moments of before,
/// which are there once more then, take less than the lists and gradients that are not. Saturates.
#[must_use]
pub fn training_bytes(size: &TrainingSize) -> TrainingBytes {
    let s = size;
    let wide = |n: usize| n as u64;
    let bytes = |parts: &[(u64, u64)]| {
        parts.iter().fold(0_u64, |sum, (count, floats)| sum.saturating_add(count.saturating_mul(4 * floats)))
    };
    let (pixels, layers) = (wide(s.width).saturating_mul(wide(s.height)), wide(s.layers));
    let splats = wide(s.splats);
    let sh_floats = 3 * wide(sh::coefficients(s.sh_degree));
    let per_side =
        |side: u32| wide(s.width.div_ceil(side as usize)).saturating_mul(wide(s.height.div_ceil(side as usize)));
    let tiles = per_side(TILE);
    // Parameters, gradients and two moments; projection, sums of the blend, statistics, five counters, the depth sort.
    let sums = wide(sums_each(s.absolute_gradients));
    let by_pose = if s.poses_move { 4 } else { 0 };
    let per_splat = 4 * (12 + sh_floats) + 12 + sums + 4 + 5 + 4 + layers.max(1) + by_pose;
    let pairs = wide(PAIRS_PER_SPLAT).saturating_mul(splats).saturating_add(tiles);
    // Image, its gradient, photograph, slopes of SSIM; colour, transmittance, disparity and end of every bucket.
    let mut per_pixel = 4 + 4 + 1 + 12 + 6 * (layers + 1);
    let (mut per_bin, mut meshes) = (0, 0);
    if layers > 0 {
        per_pixel += (1 + 1 + 4 + 4) * layers;
        per_bin = 2 + 16;
        // Texels and gradients have mips of up to five levels, the two moments none. Per triangle: indices, UVs,
        // corners, boxes, four pairs; a closed mesh has half as many vertices as triangles. For moving: per triangle
        // the corners' normals; per vertex gradient, moments, normals, steps, and neighbours with their starts.
        let (map_floats, triangles) = (wide(s.map_floats), wide(s.triangles));
        let (by_triangle, by_vertex) = if s.vertices_move { (12, 2 + 2 + 4 + 4 + 6 + 1) } else { (0, 0) };
        meshes = bytes(&[
            (map_floats, 2),
            (map_floats.saturating_mul(341) / 256, 2),
            (triangles, 4 + 8 + 12 + 2 + 4 + by_triangle),
            (triangles / 2, 3 + by_vertex),
        ]);
    }
    TrainingBytes {
        // Pairs: keys and values, twice; splats, also with numbers; sums. The counters of two sorts, by chunks or by
        // blocks.
        splats: bytes(&[
            (splats, per_splat),
            (pairs, 4 + 1 + 2 + sums),
            (2 * 256 * 256, 1),
            (splats.saturating_add(pairs) / 8, 1),
        ]),
        meshes,
        images: bytes(&[(pixels, per_pixel), (tiles, 2), (per_side(BIN), per_bin)]),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn there_is_room_for_no_more_splats_than_there_may_be() {
        // 192 bytes of SH coefficients per splat.
        let gpu = Gpu::open(None).unwrap().binding_at_most(192 * 1000);
        let of = |n, most| with_headroom(&gpu, n, 3, most);
        assert_eq!([of(100, usize::MAX), of(100, 120), of(100, 100), of(100, 50)], [150, 120, 100, 100]);
        assert_eq!([of(900, usize::MAX), of(900, 950), of(1100, usize::MAX)], [1000, 950, 1100]);
    }

    #[test]
    fn absurd_sizes_saturate() {
        let n = usize::MAX;
        let size = TrainingSize {
            splats: n,
            sh_degree: 3,
            absolute_gradients: true,
            poses_move: true,
            triangles: n,
            vertices_move: false,
            map_floats: n,
            layers: 4,
            width: n,
            height: n,
        };
        assert_eq!(training_bytes(&size).total(), u64::MAX);
    }
}
