use super::SceneError;
use super::color::{linear_to_srgb, srgb_to_linear};

/// Rule for the order of a splat and a mesh layer. `render::contract` has the formulas.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "camelCase")]
pub enum OrderMode {
    /// The HERA paper's rule: one decision per splat and layer at the splat's own projection, overridden per
    /// pixel where the mesh is more than λ in front of the mean.
    #[default]
    Stable,
    /// As `Stable`, but a pixel follows the splat's decision only where its mesh depth is within λ of the depth
    /// that was decided on; elsewhere the mean is compared with the pixel's own depth.
    SurfaceConsistent,
    /// The mean is compared with every pixel's own mesh depth (the paper's ablation; the order flickers).
    Direct,
}

impl OrderMode {
    pub(crate) const ALL: [Self; 3] = [Self::Stable, Self::SurfaceConsistent, Self::Direct];

    /// Name in files and reports, equal to serde's.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Stable => "stable",
            Self::SurfaceConsistent => "surfaceConsistent",
            Self::Direct => "direct",
        }
    }
}

/// Space in which colours are stored and blended.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ColorSpace {
    /// sRGB-encoded, Rec. 709 primaries (`srgb_rec709_display`): the space of photographs, used in training.
    #[default]
    SrgbDisplay,
    /// Linear light, Rec. 709 primaries (`lin_rec709_display`).
    LinearDisplay,
}

impl ColorSpace {
    /// All spaces, the default first.
    pub const ALL: [Self; 2] = [Self::SrgbDisplay, Self::LinearDisplay];

    /// Name in glTF, in EXR headers and in reports.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::SrgbDisplay => "srgb_rec709_display",
            Self::LinearDisplay => "lin_rec709_display",
        }
    }

    /// Converts a colour of this space to sRGB, as in 8-bit pictures.
    #[must_use]
    pub fn to_srgb(self, rgb: [f32; 3]) -> [f32; 3] {
        match self {
            Self::SrgbDisplay => rgb,
            Self::LinearDisplay => rgb.map(linear_to_srgb),
        }
    }

    /// Converts a colour of this space to linear light.
    #[must_use]
    pub fn to_linear(self, rgb: [f32; 3]) -> [f32; 3] {
        match self {
            Self::SrgbDisplay => rgb.map(srgb_to_linear),
            Self::LinearDisplay => rgb,
        }
    }

    /// Converts linear light to a colour of this space.
    #[must_use]
    pub fn from_linear(self, rgb: [f32; 3]) -> [f32; 3] {
        match self {
            Self::SrgbDisplay => rgb.map(linear_to_srgb),
            Self::LinearDisplay => rgb,
        }
    }
}

/// Filter that fits projected splats to pixels of finite size.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct PixelFilter {
    /// Variance added to both diagonal entries of a projected covariance, px²: every splat is at least about a pixel
    /// wide.
    pub variance: f32,
    /// Whether a splat keeps its integral over the picture: its opacity is multiplied by √(det Σ / det(Σ +
    /// variance·I)), so that one far smaller than a pixel fades instead of growing. Many programs call this
    /// *antialiased*.
    pub normalized: bool,
}

impl PixelFilter {
    /// Filter of INRIA 3DGS (`cuda_rasterizer/forward.cu`), for which almost all files are made.
    pub const DILATION: Self = Self { variance: 0.3, normalized: false };
    /// Mip-Splatting's 2-D filter: about the box of a pixel.
    pub const MIP: Self = Self { variance: 0.1, normalized: true };
    /// Filter of programs with a single bit *antialiased*: gsplat, SPZ, SOG.
    pub const NORMALIZED_DILATION: Self = Self { normalized: true, ..Self::DILATION };
}

impl Default for PixelFilter {
    fn default() -> Self {
        Self::DILATION
    }
}

/// Parameters of compositing that belong neither to splats nor to meshes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Composition {
    /// Rule of depth order.
    pub mode: OrderMode,
    /// λ in world units: how far in front of a mean a mesh pixel must be to override `Stable`'s decision.
    /// Infinite turns the override off.
    pub lambda: f32,
    /// Mesh layers kept per pixel, nearest first: 1, 2 or 4.
    pub layers: u32,
    /// Space of blending.
    pub color_space: ColorSpace,
    /// RGB of the background, in `color_space`.
    pub background: [f32; 3],
    /// Splats with depth ≤ `near` are culled; mesh fragments likewise. World units.
    pub near: f32,
    /// Filter that widens projected splats.
    pub pixel_filter: PixelFilter,
}

impl Default for Composition {
    fn default() -> Self {
        Self {
            mode: OrderMode::Stable,
            lambda: f32::INFINITY,
            layers: 1,
            color_space: ColorSpace::SrgbDisplay,
            background: [0.0; 3],
            near: 0.2,
            pixel_filter: PixelFilter::default(),
        }
    }
}

impl Composition {
    /// Checks all values.
    ///
    /// # Errors
    /// If λ is negative or NaN, `layers` is not 1, 2 or 4, `near` is not positive, the variance of the pixel filter is
    /// negative, or a number other than λ is not finite.
    pub fn validate(&self) -> Result<(), SceneError> {
        if self.lambda.is_nan() || self.lambda < 0.0 {
            return Err(SceneError::new("lambda", "a number ≥ 0", self.lambda.to_string()));
        }
        if !matches!(self.layers, 1 | 2 | 4) {
            return Err(SceneError::new("layers", "1, 2 or 4", self.layers.to_string()));
        }
        if !(self.near > 0.0 && self.near.is_finite()) {
            return Err(SceneError::new("near", "a positive number", self.near.to_string()));
        }
        let variance = self.pixel_filter.variance;
        if !(variance >= 0.0 && variance.is_finite()) {
            return Err(SceneError::new("pixel_filter.variance", "a number ≥ 0", variance.to_string()));
        }
        if !self.background.iter().all(|c| c.is_finite()) {
            return Err(SceneError::new("background", "finite numbers", format!("{:?}", self.background)));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn modes_have_one_name_each() {
        for mode in OrderMode::ALL {
            assert_eq!(serde_json::to_value(mode).unwrap(), mode.name());
        }
    }
}
