//! Contributions to pixels under [`ImageModel::Ray`](contract::ImageModel): every splat at its peak along the pixel's
//! own ray.

use glam::{DMat3, DVec3};

use super::{Contribution, Fragment, Parameters, Source, mesh, pixel_center, radiance_along, rotation};
use crate::render::contract::{self, ShDirection};
use crate::scene::{Camera, HybridScene, sigmoid};

/// A scene as seen by a camera's rays.
pub(super) struct RayView<'a> {
    camera: &'a Camera,
    near: f64,
    pub(super) hits: Vec<Vec<mesh::Hit>>,
    layers: Vec<Vec<Fragment>>,
    splats: Vec<RaySplat>,
}

struct RaySplat {
    index: usize,
    /// Transform from world space to the splat's axes, in units of its standard deviations: S⁻¹Rᵀ.
    whitening: DMat3,
    /// Camera's centre in that frame.
    origin: DVec3,
    opacity: f64,
    color: Color,
}

enum Color {
    Same(DVec3),
    /// Evaluated by `radiance_along` in the ray's direction.
    ByRay,
}

impl<'a> RayView<'a> {
    pub(super) fn new(
        scene: &HybridScene,
        camera: &'a Camera,
        parameters: &Parameters,
        direction: ShDirection,
    ) -> Self {
        let (hits, layers) = super::fragments(scene, camera, parameters);
        let near = f64::from(scene.composition.near);
        let splat = |i: usize| {
            let inverse_scale = DMat3::from_diagonal((-parameters.log_scales[i]).exp());
            let whitening = inverse_scale * rotation(parameters.rotations[i]).transpose();
            let color = match direction {
                ShDirection::Ray => Color::ByRay,
                ShDirection::Mean => Color::Same(super::splat_radiance(scene, camera, parameters, i).max(DVec3::ZERO)),
            };
            let origin = whitening * (camera.center() - parameters.means[i]);
            let opacity = sigmoid(parameters.opacity_logits[i]);
            (camera.to_camera(parameters.means[i]).z > near).then_some(RaySplat {
                index: i,
                whitening,
                origin,
                opacity,
                color,
            })
        };
        let splats = (0..parameters.means.len()).filter_map(splat).collect();
        Self { camera, near, hits, layers, splats }
    }

    /// Contributions to a pixel, front to back.
    pub(super) fn contributions(
        &self,
        scene: &HybridScene,
        parameters: &Parameters,
        pixel: usize,
    ) -> Vec<Contribution> {
        let position = pixel_center(self.camera, pixel);
        let ray = self.camera.rotation().transpose() * self.camera.ray(position); // depth 1
        let splat = |splat: &RaySplat| {
            let peak = contract::ray_peak(splat.origin, splat.whitening * ray);
            let alpha = contract::splat_alpha(splat.opacity, peak.power).filter(|_| peak.depth > self.near)?;
            let color = match splat.color {
                Color::Same(color) => color,
                Color::ByRay => radiance_along(scene, parameters, splat.index, ray.normalize()).max(DVec3::ZERO),
            };
            let source = Source::Splat(splat.index, glam::DVec2::ZERO);
            Some(Contribution { source, depth: peak.depth, alpha, color, transmittance: 0.0 })
        };
        // Splats by index come before layers, which the stable sort preserves at equal depths.
        let mut list: Vec<_> = self.splats.iter().filter_map(splat).collect();
        list.extend(self.layers[pixel].iter().enumerate().map(|(i, layer)| layer.contribution(i)));
        list.sort_by(|a, b| a.depth.total_cmp(&b.depth));
        let mut transmittance = 1.0;
        for contribution in &mut list {
            contribution.transmittance = transmittance;
            transmittance *= 1.0 - contribution.alpha;
        }
        list
    }
}
