//! Per-frame uniform: the host's side of `shaders/shared/view.wgsl`.

use glam::Vec3;

use crate::scene::{Camera, Composition, OrderMode, sh};

/// Everything that shaders know of one view.
#[derive(Clone, Copy, Debug)]
pub(crate) struct View {
    pub(crate) camera: Camera,
    pub(crate) composition: Composition,
    pub(crate) n_splats: u32,
    /// Active SH degree of splats.
    pub(crate) sh_degree: u32,
    /// Active SH degree of mesh maps.
    pub(crate) band_degree: u32,
    pub(crate) n_triangles: u32,
    pub(crate) pair_capacity: u32,
    /// Splats that are dropped at random.
    pub(crate) dropout: Dropout,
    /// Weight in the loss, in training, of the mean over pixels of expected disparity Σw/z, 1/(1/world unit); pixels
    /// that differ from their photograph count less (`shaders/shared/loss_terms.wgsl`). Gradients by the splats'
    /// weights include it; depths and meshes are held fixed.
    pub(crate) disparity_weight: f32,
}

/// Random dropout of splats in a step, so that none relies on others that few views see (`DropGaussian`, Park et al.
/// 2025).
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Dropout {
    /// Seed that, with a splat's index, decides whether it is dropped.
    pub(crate) seed: u32,
    /// Fraction dropped, below 1. The others are more opaque by 1/(1 − rate).
    pub(crate) rate: f32,
}

/// Words of the uniform buffer.
pub(crate) const VIEW_WORDS: usize = 40;

/// Side of a tile in pixels.
pub(crate) const TILE: u32 = 16;

/// Constants that every shader has under these names.
pub(super) const CONSTANTS: [(&str, u32); 4] = [
    ("TILE", TILE),
    ("MODE_STABLE", mode_word(OrderMode::Stable)),
    ("MODE_SURFACE_CONSISTENT", mode_word(OrderMode::SurfaceConsistent)),
    ("MODE_DIRECT", mode_word(OrderMode::Direct)),
];

const fn mode_word(mode: OrderMode) -> u32 {
    match mode {
        OrderMode::Stable => 0,
        OrderMode::SurfaceConsistent => 1,
        OrderMode::Direct => 2,
    }
}

impl View {
    /// View of splats and meshes with all their bands, with room for this many (tile, splat) pairs.
    pub(crate) fn of_scene(
        camera: &Camera,
        composition: Composition,
        (n_splats, sh_degree): (usize, u32),
        n_triangles: u32,
        pair_capacity: usize,
    ) -> Self {
        let (n_splats, pair_capacity, band_degree) = (n_splats as u32, pair_capacity as u32, sh::MAX_DEGREE);
        Self { n_splats, sh_degree, band_degree, n_triangles, pair_capacity, ..Self::of(camera, composition) }
    }

    /// View without content.
    pub(crate) fn of(camera: &Camera, composition: Composition) -> Self {
        let (n_splats, sh_degree, band_degree, n_triangles, pair_capacity) = (0, 0, 0, 0, 0);
        let dropout = Dropout::default();
        Self {
            camera: *camera,
            composition,
            n_splats,
            sh_degree,
            band_degree,
            n_triangles,
            pair_capacity,
            dropout,
            disparity_weight: 0.0,
        }
    }

    /// Tiles across and down.
    pub(crate) fn tiles(&self) -> (u32, u32) {
        let k = self.camera.intrinsics();
        (k.width.div_ceil(TILE), k.height.div_ceil(TILE))
    }

    /// Number of tiles.
    pub(crate) fn n_tiles(&self) -> usize {
        let (x, y) = self.tiles();
        x as usize * y as usize
    }

    /// Number of pixels.
    pub(crate) fn pixels(&self) -> usize {
        self.camera.intrinsics().pixels()
    }

    /// The uniform's words, in the order of the WGSL struct.
    pub(crate) fn words(&self) -> [u32; VIEW_WORDS] {
        let (k, c, d) = (self.camera.intrinsics(), &self.composition, self.dropout);
        let r = self.camera.rotation().as_mat3();
        let center: Vec3 = self.camera.center().as_vec3();
        let short = (self.camera.center() - center.as_dvec3()).as_vec3();
        let mut words = Vec::with_capacity(VIEW_WORDS);
        for (row, short) in [(r.row(0), short.x), (r.row(1), short.y), (r.row(2), short.z)] {
            words.extend([row.x, row.y, row.z, short].map(f32::to_bits));
        }
        words.extend([center.x, center.y, center.z, self.disparity_weight / self.pixels() as f32].map(f32::to_bits));
        words.extend([k.fx, k.fy, k.cx, k.cy].map(|v| (v as f32).to_bits()));
        let tiles = self.tiles();
        words.extend([k.width, k.height, tiles.0, tiles.1]);
        let b = c.background;
        words.extend([b[0], b[1], b[2], 0.0].map(f32::to_bits));
        words.extend([self.n_splats, self.sh_degree, mode_word(c.mode), self.n_triangles]);
        words.extend([c.near.to_bits(), c.lambda.min(f32::MAX).to_bits(), self.pair_capacity, self.band_degree]);
        words.extend([
            c.pixel_filter.variance.to_bits(),
            u32::from(c.pixel_filter.normalized),
            d.seed,
            d.rate.to_bits(),
        ]);
        words.try_into().expect("the struct has VIEW_WORDS words")
    }
}
