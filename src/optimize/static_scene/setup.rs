//! What does not change during a run: what it is given, and what follows from that.

use std::{cell::OnceCell, rc::Rc};

use super::{Phase, budget::Budget};
use crate::{
    capture::Capture,
    geometry::{MeshBvh, Shell, Viewers},
    optimize::{Background, TrainOptions, initialize, resume::Identity, size},
    scene::{Camera, Composition, Mesh, PixelFilter},
};

/// Near plane of static scenes in the capture's unit (as in INRIA 3DGS), limited to a twentieth of the extent.
const NEAR: f32 = 0.2;

/// Input of a run, and what is decided before its first iteration.
pub(super) struct Setup<'a> {
    pub(super) capture: &'a Capture,
    pub(super) options: &'a TrainOptions,
    /// What tells checkpoints of the run from those of others.
    pub(super) identity: Identity<'a>,
    /// Indices in the capture of the views to train on, at least two, ascending.
    pub(super) train: Vec<usize>,
    /// Indices in the capture of the views held out.
    pub(super) test: Vec<usize>,
    /// From the poses as given.
    pub(super) scales: Scales,
    pub(super) budget: Budget<'a>,
    /// Shell for surfaces that the run makes; none where the photographs' alpha or masks say that nothing is behind.
    pub(super) shell: Option<Shell>,
    /// Ray hierarchy of the given mesh, once [`Self::hierarchy`] was asked for it.
    pub(super) given_hierarchy: OnceCell<Rc<MeshBvh>>,
}

/// Sizes estimated from a capture as it was given: refined poses do not change them.
pub(super) struct Scales {
    /// Extent of what is trained, world units: that of the training cameras, less through narrow lenses.
    pub(super) extent: f32,
    /// The capture's unit of length, world units, see [`size::unit_of_length`].
    pub(super) unit: f32,
    /// Approximate distance of what views see, world units.
    pub(super) distance: f32,
    /// Near plane: least camera-space z of what is drawn, world units.
    pub(super) near: f32,
    /// Longest side of all pictures, pixels.
    pub(super) longest_side: u32,
}

impl Setup<'_> {
    /// Whether the run makes its surface itself; the joint phase then begins with the splats of the surface phase.
    pub(super) fn finds_surface(&self) -> bool {
        self.identity.finds_surface
    }

    /// Whether exposures are learnt in this phase: not in the warm-up of a surface made from the capture, which sees a
    /// part of the views and has exposures from the phase before.
    pub(super) fn learns_exposures(&self, phase: Phase) -> bool {
        self.options.exposure && (phase != Phase::Warmup || !self.finds_surface())
    }

    /// Whether poses are refined in this phase: only without a mesh, whose gradients with respect to the pose are not
    /// computed.
    pub(super) fn refines_poses(&self, phase: Phase) -> bool {
        self.options.refine_poses && (phase == Phase::Surface || !self.finds_surface())
    }

    pub(super) fn composition(&self) -> Composition {
        Composition {
            mode: self.options.mode,
            lambda: self.options.lambda * self.scales.extent,
            layers: self.options.layers,
            background: if self.options.background == Background::White { [1.0; 3] } else { [0.0; 3] },
            near: self.scales.near,
            pixel_filter: if self.options.antialias { PixelFilter::MIP } else { PixelFilter::DILATION },
            ..Composition::default()
        }
    }

    /// Training views that judge a made surface: every fourth, so that maps which merely repeat the views they were made
    /// from are not taken for good. Splats have learnt from all.
    pub(super) fn judging_views(&self) -> Vec<usize> {
        self.part_of_views(true)
    }

    /// Training views that warm up the maps of a mesh: those that do not judge it.
    pub(super) fn warming_views(&self) -> Vec<usize> {
        self.part_of_views(false)
    }

    /// Training views that judge, or those that do not. With fewer than eight views all do both, as splats cannot spare
    /// any; and a given mesh is not judged.
    fn part_of_views(&self, judges: bool) -> Vec<usize> {
        if !self.finds_surface() || self.train.len() < 8 {
            return self.train.clone();
        }
        let part = self.train.iter().enumerate().filter(|(i, _)| (i % 4 == 2) == judges);
        part.map(|(_, &view)| view).collect()
    }

    /// Who looks through these cameras at the scene, at all of their pictures and as many layers as are drawn.
    pub(super) fn viewers<'v>(&self, cameras: &'v [Camera]) -> Viewers<'v> {
        Viewers::unmasked(cameras, f64::from(self.scales.near), self.options.layers as usize)
    }

    /// Whether a triangle of a mesh is one of the shell.
    pub(super) fn is_of_shell(&self, mesh: &Mesh, triangle: &[u32; 3]) -> bool {
        self.shell.is_some_and(|shell| shell.holds(mesh.positions()[triangle[0] as usize]))
    }

    /// Ray hierarchy of the meshes of this run. That of a given mesh, which does not move, is built once.
    pub(super) fn hierarchy(&self, meshes: &[Mesh]) -> Rc<MeshBvh> {
        let build = || Rc::new(MeshBvh::of(meshes));
        // Nothing to keep without a mesh; and each mesh that the run makes is another one.
        if self.finds_surface() || meshes.is_empty() {
            build()
        } else {
            Rc::clone(self.given_hierarchy.get_or_init(build))
        }
    }
}

impl Scales {
    /// From the training views, `train` being their indices in the capture and `cameras` their cameras.
    pub(super) fn of(capture: &Capture, train: &[usize], cameras: &[Camera]) -> Self {
        let depth = size::median_depth(capture, train).or_else(|| initialize::distance_of_focus(cameras));
        let narrowness = size::narrowness(cameras);
        let extent = (narrowness * size::extent(cameras, depth)) as f32;
        let sides = capture.views.iter().map(|view| view.camera.intrinsics().longer_side());
        Self {
            extent,
            unit: size::unit_of_length(f64::from(extent), depth.map(|depth| narrowness * depth)) as f32,
            distance: depth.map_or(extent, |depth| depth as f32),
            near: size::near_plane(extent, NEAR),
            longest_side: sides.max().unwrap_or(1),
        }
    }
}
