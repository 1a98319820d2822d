use glam::DVec3;

use super::{Image, render_parameters};
use crate::scene::{Camera, HybridScene, Mesh, Texture};

/// Every optimised number of a scene in f64, or the derivative of a loss with respect to each.
///
/// Layouts are those of [`HybridScene`]: the reference renders from this copy, so that finite differences can move
/// a parameter by less than an f32 resolves.
#[derive(Clone, Debug, PartialEq)]
pub struct Parameters {
    /// World positions, `[N]`.
    pub means: Vec<DVec3>,
    /// Quaternions (w, x, y, z) local→world of any norm but 0, `[N]`.
    pub rotations: Vec<[f64; 4]>,
    /// Log standard deviations, `[N]`.
    pub log_scales: Vec<DVec3>,
    /// Opacity logits, `[N]`.
    pub opacity_logits: Vec<f64>,
    /// Standard deviations of the Gaussians that the splats are smoothed with ([`smoothed`](crate::scene::smoothed)),
    /// `[N]`; 0 in a scene, whose splats are as they are. Training chooses them and does not differentiate by them.
    pub smoothing: Vec<f64>,
    /// SH coefficients, `[N·(d+1)²]` RGB, splat-major.
    pub sh: Vec<DVec3>,
    /// Per mesh: level 0 of the base texture, `[height·width·4]`.
    pub base: Vec<Vec<f64>>,
    /// Per mesh: level 0 of the bands texture, `[height·width·channels]`; empty without bands.
    pub bands: Vec<Vec<f64>>,
    /// Per mesh: world positions of its vertices, `[V]`.
    pub positions: Vec<Vec<DVec3>>,
}

/// Address of one number of [`Parameters`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Parameter {
    /// (splat, axis)
    Mean(usize, usize),
    /// (splat, component w, x, y, z); the quaternion is normalised when used.
    Rotation(usize, usize),
    /// (splat, local axis)
    LogScale(usize, usize),
    /// (splat)
    OpacityLogit(usize),
    /// (splat·(d+1)² + coefficient, RGB channel)
    Sh(usize, usize),
    /// (mesh, texel·4 + channel)
    Base(usize, usize),
    /// (mesh, texel·channels + channel)
    Band(usize, usize),
    /// (mesh, vertex, axis)
    Position(usize, usize, usize),
}

impl Parameters {
    /// The parameters of a scene.
    #[must_use]
    pub fn of(scene: &HybridScene) -> Self {
        let splats = &scene.splats;
        let texels = |texture: &Texture| texture.texels().iter().copied().map(f64::from).collect();
        let bands = |mesh: &Mesh| mesh.atlas().bands().map_or_else(Vec::new, texels);
        Self {
            means: splats.means().iter().map(|m| m.as_dvec3()).collect(),
            rotations: splats.rotations().iter().map(|q| [q.w, q.x, q.y, q.z].map(f64::from)).collect(),
            log_scales: splats.log_scales().iter().map(|s| s.as_dvec3()).collect(),
            opacity_logits: splats.opacity_logits().iter().copied().map(f64::from).collect(),
            smoothing: vec![0.0; splats.len()],
            sh: splats.sh().iter().map(|c| DVec3::from(c.map(f64::from))).collect(),
            base: scene.meshes.iter().map(|m| texels(m.atlas().base())).collect(),
            bands: scene.meshes.iter().map(bands).collect(),
            positions: scene.meshes.iter().map(|m| m.positions().iter().map(|p| p.as_dvec3()).collect()).collect(),
        }
    }

    /// Zeros in the same shape.
    #[must_use]
    pub fn zeros_like(&self) -> Self {
        let zeros = |textures: &[Vec<f64>]| textures.iter().map(|t| vec![0.0; t.len()]).collect();
        Self {
            means: vec![DVec3::ZERO; self.means.len()],
            rotations: vec![[0.0; 4]; self.rotations.len()],
            log_scales: vec![DVec3::ZERO; self.log_scales.len()],
            opacity_logits: vec![0.0; self.opacity_logits.len()],
            smoothing: vec![0.0; self.smoothing.len()],
            sh: vec![DVec3::ZERO; self.sh.len()],
            base: zeros(&self.base),
            bands: zeros(&self.bands),
            positions: self.positions.iter().map(|p| vec![DVec3::ZERO; p.len()]).collect(),
        }
    }

    /// Mutable access to one number.
    ///
    /// # Panics
    /// If there is no such parameter.
    pub fn at(&mut self, parameter: Parameter) -> &mut f64 {
        match parameter {
            Parameter::Mean(i, k) => &mut self.means[i][k],
            Parameter::Rotation(i, k) => &mut self.rotations[i][k],
            Parameter::LogScale(i, k) => &mut self.log_scales[i][k],
            Parameter::OpacityLogit(i) => &mut self.opacity_logits[i],
            Parameter::Sh(i, k) => &mut self.sh[i][k],
            Parameter::Base(m, i) => &mut self.base[m][i],
            Parameter::Band(m, i) => &mut self.bands[m][i],
            Parameter::Position(m, i, k) => &mut self.positions[m][i][k],
        }
    }
}

/// Derivative of Σ `cotangent`·image with respect to one parameter of a scene's rendering, by central differences of
/// step `h`.
///
/// Independent of the closed forms of [`super::backward`]; meaningful where ±`h` crosses no threshold.
///
/// # Panics
/// If there is no such parameter, or `cotangent` is not of the camera's size.
#[must_use]
pub fn finite_difference(
    scene: &HybridScene,
    camera: &Camera,
    parameters: &Parameters,
    cotangent: &Image,
    parameter: Parameter,
    h: f64,
) -> f64 {
    let at_offset = |offset: f64| {
        let mut parameters = parameters.clone();
        *parameters.at(parameter) += offset;
        render_parameters(scene, camera, &parameters).dot(cotangent)
    };
    (at_offset(h) - at_offset(-h)) / (2.0 * h)
}
