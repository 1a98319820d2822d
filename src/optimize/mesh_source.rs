//! Source of a hybrid's mesh, and what its surface was made of.

use glam::Vec2;

use super::seen_points::are_many;
use crate::{capture::Capture, geometry::Surface};

/// Source of the mesh.
#[derive(Clone, Debug, Default, PartialEq)]
pub enum MeshSource {
    /// No mesh: plain 3DGS.
    None,
    /// Fusion of the median depths of splats, which are trained first.
    #[default]
    Splats,
    /// Points that the training views see ([`geometry::surface_from_points`](crate::geometry::surface_from_points)), or
    /// as `Splats` if these are too few. Splats are trained first all the same, to judge the surface.
    Points,
    /// The user's mesh; unwrapped if it has no texture coordinates.
    Given {
        /// Geometry in the capture's world frame.
        surface: Surface,
        /// UV of every corner `[F]`, v downwards.
        corner_uvs: Option<Vec<[Vec2; 3]>>,
    },
}

/// Data that the surface of a trained mesh was made of.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SurfaceOrigin {
    /// The user's mesh.
    Given,
    /// The capture's points, where it lists the visible points of more than half of the training views.
    Points,
    /// The capture's points, where for half of the training views or more visibility was guessed: a point counts as
    /// seen where no other is nearer ([`geometry::visible_points`](crate::geometry::visible_points)).
    GuessedPoints,
    /// Fused depths of splats.
    Splats,
}

impl MeshSource {
    /// Default source of `centaur train`: `Points` if the capture lists 100 visible points or more for its median view,
    /// else `Splats`.
    #[must_use]
    pub fn suited_to(capture: &Capture) -> Self {
        let seen = capture.views.iter().map(|view| view.sees.len()).collect();
        if are_many(seen) { Self::Points } else { Self::Splats }
    }

    /// Whether the run makes the surface itself: splats are trained before there is a mesh, and handed over to it.
    pub(super) fn is_found(&self) -> bool {
        matches!(self, Self::Splats | Self::Points)
    }
}
