use std::sync::Arc;

use glam::{Vec2, Vec3};

use super::{SceneError, check_finite, check_len, sh};

/// A row-major image of `channels` floats per texel, first row at the top.
///
/// Texel (i, j) has its centre at UV ((i+½)/width, (j+½)/height); UV (0, 0) is the top-left corner, as in glTF.
///
/// Clones share their texels, so that many meshes may show one image.
#[derive(Clone, Debug, PartialEq)]
pub struct Texture {
    width: u32,
    height: u32,
    channels: u32,
    texels: Arc<Vec<f32>>,
}

impl Texture {
    /// Largest side, texels: that of Direct3D 12 textures.
    pub const MAX_SIDE: u32 = 16384;

    /// Validates and takes `texels` `[height·width·channels]`.
    ///
    /// # Errors
    /// If a side is 0 or above [`Self::MAX_SIDE`], the length is wrong or a value is not finite.
    pub fn new(width: u32, height: u32, channels: u32, texels: Vec<f32>) -> Result<Self, SceneError> {
        if ![width, height].iter().all(|side| (1..=Self::MAX_SIDE).contains(side)) {
            let expected = format!("1 to {} texels a side", Self::MAX_SIDE);
            return Err(SceneError::new("texture size", expected, format!("{width}×{height}")));
        }
        check_len("texels", texels.len(), width as usize * height as usize * channels as usize)?;
        check_finite("texels", &texels, channels.max(1) as usize)?;
        Ok(Self { width, height, channels, texels: Arc::new(texels) })
    }

    /// A texture of zeros, with sides limited by [`Self::nearest_side`].
    #[must_use]
    pub fn zeros(width: u32, height: u32, channels: u32) -> Self {
        let [width, height] = [width, height].map(Self::nearest_side);
        let texels = vec![0.0; width as usize * height as usize * channels as usize];
        Self { width, height, channels, texels: Arc::new(texels) }
    }

    /// `side`, clamped to the valid range, 1 to [`Self::MAX_SIDE`].
    #[must_use]
    pub fn nearest_side(side: u32) -> u32 {
        side.clamp(1, Self::MAX_SIDE)
    }

    /// Width in texels.
    #[must_use]
    pub fn width(&self) -> u32 {
        self.width
    }

    /// Height in texels.
    #[must_use]
    pub fn height(&self) -> u32 {
        self.height
    }

    /// Floats per texel.
    #[must_use]
    pub fn channels(&self) -> u32 {
        self.channels
    }

    /// All values, `[height·width·channels]`.
    #[must_use]
    pub fn texels(&self) -> &[f32] {
        &self.texels
    }

    /// Number of mip levels for trilinear sampling: halving while both sides stay even, at most [`Self::MAX_LEVELS`],
    /// so that every coarser texel is the exact mean of 2×2 finer ones and charts do not bleed far.
    #[must_use]
    pub fn mip_levels(&self) -> u32 {
        Self::mip_levels_of(self.width, self.height)
    }

    /// [`Self::mip_levels`] of a texture of this size.
    #[must_use]
    pub fn mip_levels_of(width: u32, height: u32) -> u32 {
        (1 + width.trailing_zeros().min(height.trailing_zeros())).min(Self::MAX_LEVELS)
    }

    /// Largest number of mip levels, as charts are packed densely. Charts `n` texels apart mix from level log₂ n on.
    pub const MAX_LEVELS: u32 = 5;
}

/// The maps of a mesh (HERA's T and A): zeroth SH coefficient and opacity at one resolution, higher bands at another.
///
/// Mesh colour = max(0, 0.5 + Σₖ Yₖ·Tₖ(uv)), opacity = σ(A(uv)).
#[derive(Clone, Debug, PartialEq)]
pub struct Atlas {
    base: Texture,
    bands: Option<Texture>,
    sh_degree: u32,
}

impl Atlas {
    /// * `base`: 4 channels: RGB of SH coefficient 0, opacity logit.
    /// * `bands`: 3·((d+1)²−1) channels for degree d = 1..3: RGB of coefficient 1, RGB of coefficient 2, …
    ///
    /// # Errors
    /// If the channel counts are none of these.
    pub fn new(base: Texture, bands: Option<Texture>) -> Result<Self, SceneError> {
        if base.channels != 4 {
            return Err(SceneError::new("base channels", "4 (SH DC RGB, opacity)", base.channels.to_string()));
        }
        let sh_degree = match bands.as_ref().map(Texture::channels) {
            None => 0,
            Some(c) => sh::degree_of_band_floats(c as usize, sh::MAX_DEGREE)
                .filter(|degree| *degree > 0)
                .ok_or_else(|| SceneError::new("band channels", "9, 24 or 45", c.to_string()))?,
        };
        Ok(Self { base, bands, sh_degree })
    }

    /// DC RGB and opacity logit.
    #[must_use]
    pub fn base(&self) -> &Texture {
        &self.base
    }

    /// Bands 1 to `sh_degree`, if any.
    #[must_use]
    pub fn bands(&self) -> Option<&Texture> {
        self.bands.as_ref()
    }

    /// SH degree of the mesh colour, 0 to 3.
    #[must_use]
    pub fn sh_degree(&self) -> u32 {
        self.sh_degree
    }

    /// Number of floats in both textures.
    #[must_use]
    pub fn floats(&self) -> usize {
        self.base.texels.len() + self.bands.as_ref().map_or(0, |b| b.texels.len())
    }
}

/// A triangle mesh with per-corner UVs and its atlas. Rendered double-sided.
#[derive(Clone, Debug, PartialEq)]
pub struct Mesh {
    positions: Vec<Vec3>,
    triangles: Vec<[u32; 3]>,
    corner_uvs: Vec<[Vec2; 3]>,
    atlas: Atlas,
}

impl Mesh {
    /// * `positions` `[V]`: world positions.
    /// * `triangles` `[F]`: indices into `positions`.
    /// * `corner_uvs` `[F]`: UV of each corner of each triangle, v downwards.
    ///
    /// # Errors
    /// If there is no triangle, an index is out of range, lengths differ or a value is not finite.
    pub fn new(
        positions: Vec<Vec3>,
        triangles: Vec<[u32; 3]>,
        corner_uvs: Vec<[Vec2; 3]>,
        atlas: Atlas,
    ) -> Result<Self, SceneError> {
        if triangles.is_empty() {
            return Err(SceneError::new("triangles", "at least one triangle", "none"));
        }
        check_len("corner_uvs", corner_uvs.len(), triangles.len())?;
        check_finite("positions", bytemuck::cast_slice(&positions), 3)?;
        check_finite("corner_uvs", bytemuck::cast_slice(&corner_uvs), 6)?;
        for (i, t) in triangles.iter().enumerate() {
            if let Some(v) = t.iter().find(|&&v| v as usize >= positions.len()) {
                return Err(SceneError::new(
                    format!("triangles[{i}]"),
                    format!("indices below {}", positions.len()),
                    v.to_string(),
                ));
            }
        }
        Ok(Self { positions, triangles, corner_uvs, atlas })
    }

    /// World positions, `[V]`.
    #[must_use]
    pub fn positions(&self) -> &[Vec3] {
        &self.positions
    }

    /// Vertex indices, `[F]`.
    #[must_use]
    pub fn triangles(&self) -> &[[u32; 3]] {
        &self.triangles
    }

    /// Number of floats of positions and textures, as counted by budgets, whether training changes them or not.
    #[must_use]
    pub fn floats(&self) -> usize {
        self.atlas.floats() + 3 * self.positions.len()
    }

    /// Per-corner UVs, `[F]`.
    #[must_use]
    pub fn corner_uvs(&self) -> &[[Vec2; 3]] {
        &self.corner_uvs
    }

    /// The maps.
    #[must_use]
    pub fn atlas(&self) -> &Atlas {
        &self.atlas
    }

    /// The same triangles and maps with each vertex where `place` puts it.
    pub(crate) fn moved(self, place: impl Fn(Vec3) -> Vec3) -> Result<Self, SceneError> {
        let mut positions = self.positions;
        positions.iter_mut().for_each(|p| *p = place(*p));
        check_finite("positions", bytemuck::cast_slice(&positions), 3)?;
        Ok(Self { positions, ..self })
    }

    /// The same geometry with other maps.
    #[must_use]
    pub fn with_atlas(self, atlas: Atlas) -> Self {
        Self { atlas, ..self }
    }

    /// The mesh reduced to the triangles to `keep`, and the vertices that they use, in their previous order; `None` if
    /// no triangle is left.
    ///
    /// # Panics
    /// If there is not one `keep` per triangle.
    #[must_use]
    pub fn with_triangles(&self, keep: &[bool]) -> Option<Self> {
        assert_eq!(keep.len(), self.triangles.len(), "one per triangle");
        let kept = self.triangles.iter().zip(&self.corner_uvs).zip(keep).filter(|(_, keep)| **keep);
        let (mut triangles, corner_uvs): (Vec<[u32; 3]>, Vec<[Vec2; 3]>) = kept.map(|((t, uvs), _)| (*t, *uvs)).unzip();
        if triangles.is_empty() {
            return None;
        }
        let (positions, _) = without_unused(&self.positions, &mut triangles);
        Some(Self { positions, triangles, corner_uvs, atlas: self.atlas.clone() })
    }
}

/// The vertices that a triangle uses, in their order, and which these are. Triangles then have the new indices.
///
/// # Panics
/// If an index is out of range.
pub(crate) fn without_unused(positions: &[Vec3], triangles: &mut [[u32; 3]]) -> (Vec<Vec3>, Vec<bool>) {
    let mut used = vec![false; positions.len()];
    triangles.as_flattened().iter().for_each(|&v| used[v as usize] = true);
    let (mut kept, mut renamed): (Vec<Vec3>, Vec<u32>) = (vec![], vec![]);
    for (&position, used) in positions.iter().zip(&used) {
        renamed.push(kept.len() as u32);
        kept.extend(used.then_some(position));
    }
    triangles.as_flattened_mut().iter_mut().for_each(|v| *v = renamed[*v as usize]);
    (kept, used)
}
