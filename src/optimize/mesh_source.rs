//! Where the mesh of a hybrid comes from, and what its surface was made of.

use glam::Vec2;

use super::seen_points::are_many;
use crate::{capture::Capture, geometry::Surface};

/// Where the mesh comes from.
#[derive(Clone, Debug, Default, PartialEq)]
pub enum MeshSource {
    /// No mesh: plain 3DGS.
    None,
    /// Splats are trained first and their median depths fused.
    #[default]
    Splats,
    /// Splats are trained first all the same, to judge the surface; it is made of the points that the training views see
    /// ([`geometry::surface_from_points`](crate::geometry::surface_from_points)), and only if these are too few as for `Splats`.
    Points,
    /// The user's; unwrapped if it has no texture coordinates.
    Given {
        /// Geometry in the capture's world frame.
        surface: Surface,
        /// UV of every corner, v downwards, `[F]`.
        corner_uvs: Option<Vec<[Vec2; 3]>>,
    },
}

/// What the surface of a trained mesh was made of.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SurfaceOrigin {
    /// It was the user's.
    Given,
    /// The capture's points, where it says of more than half of the training views which of them they see.
    Points,
    /// The capture's points, in half of the training views or more each taken for seen where no other is nearer
    /// ([`geometry::visible_points`](crate::geometry::visible_points)).
    GuessedPoints,
    /// The fused depth of splats.
    Splats,
}

impl MeshSource {
    /// What `centaur train` takes unless told: `Points` if the capture says of its median view that it sees 100 of them or more, else
    /// `Splats`.
    #[must_use]
    pub fn suited_to(capture: &Capture) -> Self {
        let seen = capture.views.iter().map(|view| view.sees.len()).collect();
        if are_many(seen) { Self::Points } else { Self::Splats }
    }

    /// Whether splats are trained before there is a mesh, and handed over to it.
    pub(super) fn is_found(&self) -> bool {
        matches!(self, Self::Splats | Self::Points)
    }
}
