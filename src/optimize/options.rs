//! Options of a training run, with defaults and their sources.

use super::MeshSource;
use crate::capture::Split;
use crate::scene::{Composition, OrderMode, SceneError, Splats, sh};

/// Phase of a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Phase {
    /// Splats alone, from which a surface is then made.
    Surface,
    /// Warm-up of the mesh's maps alone.
    Warmup,
    /// Splats and maps together.
    Joint,
}

impl Phase {
    /// Name for people; in files and JSON it is serde's.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Surface => "surface",
            Self::Warmup => "warm-up",
            Self::Joint => "joint",
        }
    }
}

/// Density control: how the number of splats changes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Density {
    /// Clone, split and prune on the screen-space gradient, with opacity resets (3DGS).
    Inria,
    /// As `Inria`, but splats are split where absolute gradients are large (AbsGS).
    Absgs,
    /// Relocation and growth up to the cap, with noise on the means (3DGS-MCMC). The budget is exact.
    Mcmc,
}

/// Background colour while training.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Background {
    /// RGB 0.
    Black,
    /// RGB 1.
    White,
    /// Another colour every iteration, which penalises holes; evaluation renders over black.
    Random,
}

/// Options of a training run. The default is given with each field.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(default)]
pub struct TrainOptions {
    /// Split into views to train on and views held out for scores: every eighth is held out (3DGS).
    pub split: Split,
    /// Iterations of the splats, including the surface phase: 30,000 (3DGS). In shorter runs the times of schedules
    /// shrink in proportion; in longer ones only rates that fall over the run stretch, and the time before a surface
    /// with what follows it.
    pub iterations: u32,
    /// Iterations of warm-up on the maps alone before the joint phase: 9,000 (HERA), see [`Self::warmup_of`] for
    /// shorter runs. Unused without a mesh.
    pub warmup: u32,
    /// Iterations, out of `iterations`, on splats alone before a surface is made, which these then judge: with MCMC a
    /// seventh, at least 400, at most half; half where poses are refined, which happens only in this phase, and with
    /// INRIA's and AbsGS' density control, which then goes on for half of the rest. Unused with a given mesh or without
    /// one. If not fewer than `iterations`, splats and maps are never trained together.
    pub surface_iterations: Option<u32>,
    /// The filters of Mip-Splatting: splats are smoothed as far as no training view can tell, and keep their integral
    /// over the picture however small they get, so that the scene can be viewed from other distances: off (3DGS).
    pub antialias: bool,
    /// Coarse-to-fine training: pictures begin at a quarter of their size and grow to the full one over the first half
    /// of the run, or over three quarters of the phase before a surface is made of splats; the number of splats grows
    /// with them: off (3DGS).
    pub coarse_to_fine: bool,
    /// An affine exposure per training photograph, optimised along: off (3DGS). What all photographs have in common
    /// stays in the scene; held-out views are rendered without exposure.
    pub exposure: bool,
    /// A small rotation and shift of each training camera, learnt while splats are trained without a mesh and then
    /// fixed; not available with a given mesh: off. Held-out views keep their poses, and the similarity that all
    /// corrections have in common is removed.
    pub refine_poses: bool,
    /// Approximate reach of all pose steps together, degrees: of rotation about each axis, and of shift along each axis
    /// as an angle at the distance of the extent: 0.6.
    pub pose_reach: f64,
    /// Part of the splats that an iteration drops at random by the end of the run, growing from none at its beginning,
    /// the others being made that much more opaque (`DropGaussian`, Park et al. 2025). If not set, by the number of
    /// views, see [`Self::dropout_of`].
    pub dropout: Option<f32>,
    /// Weight in the loss of the mean expected disparity of splats, Σw/z, over pixels, each weighted by how well it
    /// matches its photograph, with the median depth of what views see as unit: 0 (3DGS). It keeps content that
    /// photographs leave undetermined away from cameras: dark splats before a dark room cost nothing where training
    /// views see them, and are fog in front of what another view shows (docs/experiments.md). Masked-out pixels count
    /// in full.
    pub disparity_weight: f32,
    /// Degree of the splats' spherical harmonics: 3 (3DGS).
    pub sh_degree: u32,
    /// Weight of D-SSIM in the loss: 0.2 (3DGS).
    pub ssim_weight: f32,
    /// Density control: MCMC, which reaches the requested number of splats. The paper builds on INRIA's; at equal
    /// floats both are level on the demo (`docs/results.md`).
    pub density: Density,
    /// Upper bound on splats, which MCMC reaches by its last density step. If not set, [`Self::MOST_SPLATS`], for which
    /// MCMC does not speed up.
    pub max_splats: Option<usize>,
    /// Upper bound on trained floats (splats, maps, vertices), for comparisons. MCMC fills it; maps that are never
    /// re-packed may use at most half, space for charts permitting.
    pub max_floats: Option<usize>,
    /// Update only the splats seen by an iteration's view: off (3DGS updates all).
    pub visible_only: bool,
    /// Update every texel in every iteration, as the paper's Adam does: off. A texel that one view in many sees would
    /// be moved by up to 31 times the rate by what remains of its moments.
    pub dense_texels: bool,
    /// Seed of everything random: 0.
    pub seed: u64,
    /// Background while training: black (INRIA 3DGS).
    pub background: Background,
    /// Mesh layers per pixel, 1, 2 or 4: 2 (HERA does not say how many).
    pub layers: u32,
    /// Order of splats relative to layers: surface-consistent, which scores best on static captures
    /// (`docs/results.md`); HERA's is stable.
    pub mode: OrderMode,
    /// λ as a fraction of the capture's extent: 0.01 (HERA has 5 cm, but captures have no metric scale).
    #[serde(deserialize_with = "infinite_if_null")]
    pub lambda: f32,
    /// Side of the DC + opacity atlas, texels; the atlas of higher bands has a quarter. By default the least power of
    /// two from one and a half times the longer side of the images, clamped to 128 to 2048: all views together see more
    /// than one. The warm-up of a surface made from the capture uses this size; the surface is then packed again, at
    /// about two texels per pixel and no larger. Of a budget of floats it gets half of the fraction of the pictures that
    /// it covers, and no more than about a sixth unless its maps alone show held-back views better than splats alone.
    pub texture_size: Option<u32>,
    /// SH degree of the mesh: 2 (HERA does not say).
    pub band_degree: u32,
    /// Target number of triangles when simplifying a mesh made from the capture: 20,000; more remain where its topology
    /// needs them, and those of the shell come on top.
    pub triangles: usize,
    /// Flatten the planar regions of such a mesh and retriangulate them with few triangles: on, see
    /// docs/experiments.md.
    pub planar: bool,
    /// Shell: what views see past a surface made from the capture is put on a sphere around it, so far away that there
    /// is no parallax between views: sky and far background. Its triangles are judged like all others, by at least two
    /// views, and do not count towards `triangles`. Not made where photographs have alpha or masks, nor without a
    /// warm-up to judge it by: on, see docs/experiments.md.
    pub shell: bool,
    /// Iterations between checkpoints, besides one at the end of each phase; 0 for only that of a stopped run: 2,000.
    pub checkpoint_every: u32,
    /// Iterations between evaluations of held-out views; 0 for only at the end of each phase: 500.
    pub eval_every: u32,
}

impl TrainOptions {
    /// Most splats of a run if neither limit is given.
    pub const MOST_SPLATS: usize = 1_000_000;
    /// Largest [`Self::dropout`].
    pub const MOST_DROPOUT: f32 = 0.9;
    /// Largest side of an atlas, texels: at 8192 Adam's moments are 2³¹ bytes, which no adapter binds; 8128 still has
    /// five mip levels, also of bands at a quarter of the side.
    pub const LARGEST_TEXTURE: u32 = 8128;

    /// # Errors
    /// If a number is outside of what its field says.
    pub fn validate(&self) -> Result<(), SceneError> {
        Composition { layers: self.layers, lambda: self.lambda, ..Composition::default() }.validate()?;
        for (field, degree) in [("sh_degree", self.sh_degree), ("band_degree", self.band_degree)] {
            if degree > sh::MAX_DEGREE {
                return Err(SceneError::new(field, "0 to 3", degree.to_string()));
            }
        }
        if !(0.0..=1.0).contains(&self.ssim_weight) {
            return Err(SceneError::new("ssim_weight", "a number from 0 to 1", self.ssim_weight.to_string()));
        }
        if !(self.pose_reach >= 0.0 && self.pose_reach.is_finite()) {
            return Err(SceneError::new("pose_reach", "a number ≥ 0", self.pose_reach.to_string()));
        }
        if !(self.disparity_weight >= 0.0 && self.disparity_weight.is_finite()) {
            return Err(SceneError::new("disparity_weight", "a number ≥ 0", self.disparity_weight.to_string()));
        }
        if let Some(part) = self.dropout.filter(|part| !(0.0..=Self::MOST_DROPOUT).contains(part)) {
            let expected = format!("a number from 0 to {}", Self::MOST_DROPOUT);
            return Err(SceneError::new("dropout", expected, part.to_string()));
        }
        for (field, n) in [("max_splats", self.max_splats), ("triangles", Some(self.triangles))] {
            if n == Some(0) {
                return Err(SceneError::new(field, "a number from 1", "0"));
            }
        }
        let splat = Splats::floats_each(self.sh_degree);
        if let Some(floats) = self.max_floats.filter(|floats| *floats < splat) {
            let expected = format!("at least the {splat} of a splat of degree {}", self.sh_degree);
            return Err(SceneError::new("max_floats", expected, floats.to_string()));
        }
        if let Some(side) = self.texture_size.filter(|side| !(16..=Self::LARGEST_TEXTURE).contains(side)) {
            let expected = format!("16 to {}", Self::LARGEST_TEXTURE);
            return Err(SceneError::new("texture_size", expected, side.to_string()));
        }
        Ok(())
    }

    /// Default of [`Self::dropout`] for this many training views: a fifth (`DropGaussian`) for few views, which splats
    /// would otherwise memorise, falling to none for many, which do not profit from it.
    #[must_use]
    pub fn dropout_of(views: usize) -> f32 {
        let (few, many) = (12.0, 20.0);
        0.2 * ((many - views as f32) / (many - few)).clamp(0.0, 1.0)
    }

    /// Whether the options state a size for the scene.
    #[must_use]
    pub fn asks_for_size(&self) -> bool {
        self.max_splats.is_some() || self.max_floats.is_some()
    }

    /// Iterations of warm-up on the maps alone for this many iterations of the splats: HERA's 9,000 for 30,000 or more,
    /// in proportion for fewer.
    #[must_use]
    pub fn warmup_of(iterations: u32) -> u32 {
        (u64::from(iterations) * 9_000 / 30_000).min(9_000) as u32
    }

    /// Iterations on splats alone before a surface is made, in runs that make one.
    #[must_use]
    pub fn surface_phase_iterations(&self) -> u32 {
        // Half of a long run leaves splats too little time beside the mesh; after less than 400 iterations they are no
        // judge (`docs/experiments.md`).
        let half = self.iterations / 2;
        let is_short = self.density == Density::Mcmc && !self.refine_poses;
        let usual = if is_short { (self.iterations / 7).max(400).min(half) } else { half };
        self.surface_iterations.unwrap_or(usual).min(self.iterations)
    }

    /// Phases of a run with a mesh from this source, in their order, each with its iterations. The warm-up is left
    /// out if no surface can be made.
    #[must_use]
    pub fn phases(&self, mesh: &MeshSource) -> Vec<(Phase, u32)> {
        let phases = match mesh {
            MeshSource::None => &[Phase::Joint][..],
            MeshSource::Given { .. } => &[Phase::Warmup, Phase::Joint],
            MeshSource::Splats | MeshSource::Points => &[Phase::Surface, Phase::Warmup, Phase::Joint],
        };
        phases.iter().map(|&phase| (phase, self.iterations_of(phase, mesh.is_found()))).collect()
    }

    /// Iterations of a phase, in a run that makes its surface itself (`finds_surface`) or does not.
    pub(super) fn iterations_of(&self, phase: Phase, finds_surface: bool) -> u32 {
        match phase {
            Phase::Surface => self.surface_phase_iterations(),
            Phase::Warmup => self.warmup,
            Phase::Joint if finds_surface => self.iterations - self.surface_phase_iterations(),
            Phase::Joint => self.iterations,
        }
    }
}

/// Reads null as infinity, as JSON has no infinity and `serde_json` writes null for it.
fn infinite_if_null<'de, D: serde::Deserializer<'de>>(deserializer: D) -> Result<f32, D::Error> {
    Ok(<Option<f32> as serde::Deserialize>::deserialize(deserializer)?.unwrap_or(f32::INFINITY))
}

impl Default for TrainOptions {
    fn default() -> Self {
        Self {
            split: Split::default(),
            iterations: 30_000,
            warmup: 9_000,
            surface_iterations: None,
            antialias: false,
            coarse_to_fine: false,
            exposure: false,
            refine_poses: false,
            pose_reach: 0.6,
            dropout: None,
            disparity_weight: 0.0,
            sh_degree: 3,
            ssim_weight: 0.2,
            density: Density::Mcmc,
            max_splats: None,
            max_floats: None,
            visible_only: false,
            dense_texels: false,
            seed: 0,
            background: Background::Black,
            layers: 2,
            mode: OrderMode::SurfaceConsistent,
            lambda: 0.01,
            texture_size: None,
            band_degree: 2,
            triangles: 20_000,
            planar: true,
            shell: true,
            checkpoint_every: 2_000,
            eval_every: 500,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Surface;

    #[test]
    fn what_is_outside_of_its_range_is_named() {
        assert!(TrainOptions::default().validate().is_ok());
        let d = TrainOptions::default;
        for (options, field) in [
            (TrainOptions { layers: 3, ..d() }, "layers"),
            (TrainOptions { lambda: f32::NAN, ..d() }, "lambda"),
            (TrainOptions { sh_degree: 4, ..d() }, "sh_degree"),
            (TrainOptions { band_degree: u32::MAX, ..d() }, "band_degree"),
            (TrainOptions { ssim_weight: 1.5, ..d() }, "ssim_weight"),
            (TrainOptions { pose_reach: f64::INFINITY, ..d() }, "pose_reach"),
            (TrainOptions { dropout: Some(1.0), ..d() }, "dropout"),
            (TrainOptions { disparity_weight: -1.0, ..d() }, "disparity_weight"),
            (TrainOptions { texture_size: Some(u32::MAX), ..d() }, "texture_size"),
            (TrainOptions { max_floats: Some(58), ..d() }, "max_floats"),
            (TrainOptions { max_splats: Some(0), ..d() }, "max_splats"),
            (TrainOptions { triangles: 0, ..d() }, "triangles"),
        ] {
            assert_eq!(options.validate().unwrap_err().field, field);
        }
        for enough in
            [TrainOptions { max_floats: Some(59), ..d() }, TrainOptions { max_floats: Some(14), sh_degree: 0, ..d() }]
        {
            assert!(enough.validate().is_ok());
        }
    }

    #[test]
    fn splats_are_alone_for_a_seventh_of_long_runs_and_half_of_short_ones() {
        let before = |iterations, surface_iterations| {
            TrainOptions { iterations, surface_iterations, ..TrainOptions::default() }.surface_phase_iterations()
        };
        let usual = [0, 1, 100, 1400, 7000, 30_000, u32::MAX].map(|iterations| before(iterations, None));
        assert_eq!(usual, [0, 0, 50, 400, 1000, 4285, u32::MAX / 7]);
        let d = TrainOptions::default;
        for half in [TrainOptions { refine_poses: true, ..d() }, TrainOptions { density: Density::Inria, ..d() }] {
            assert_eq!(half.surface_phase_iterations(), half.iterations / 2);
        }
        assert_eq!([before(100, Some(70)), before(100, Some(700))], [70, 100]);
    }

    #[test]
    fn phases_are_those_that_a_mesh_needs() {
        let options = TrainOptions { iterations: 1400, warmup: 90, ..TrainOptions::default() };
        let surface = Surface { positions: vec![], triangles: vec![] };
        let given = MeshSource::Given { surface, corner_uvs: None };
        assert_eq!(options.phases(&MeshSource::None), [(Phase::Joint, 1400)]);
        assert_eq!(options.phases(&given), [(Phase::Warmup, 90), (Phase::Joint, 1400)]);
        for found in [MeshSource::Splats, MeshSource::Points] {
            let expected = [(Phase::Surface, 400), (Phase::Warmup, 90), (Phase::Joint, 1000)];
            assert_eq!(options.phases(&found), expected);
        }
    }

    #[test]
    fn options_survive_their_checkpoint() {
        for lambda in [0.01, f32::INFINITY] {
            let options = TrainOptions { lambda, ..TrainOptions::default() };
            let text = serde_json::to_string(&options).unwrap();
            assert_eq!(serde_json::from_str::<TrainOptions>(&text).unwrap(), options);
        }
        assert_eq!(serde_json::from_str::<TrainOptions>("{}").unwrap(), TrainOptions::default());
    }
}
