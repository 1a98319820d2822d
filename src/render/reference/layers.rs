//! A picture in parts: contributions of splats and of meshes, each as occluded by the other, and their depths.

use glam::DVec3;
use rayon::prelude::*;

use super::{Contribution, Parameters, Source, View, mesh, ray::RayView};
use crate::render::contract::ImageModel;
use crate::scene::{Camera, HybridScene};

/// The parts of an image, row-major from the top.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Layers {
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
    /// Contribution of splats: RGB times weight, and the sum of weights. `[height·width]`
    pub splats: Vec<[f64; 4]>,
    /// Contribution of mesh fragments, likewise.
    pub mesh: Vec<[f64; 4]>,
    /// Weight of the background.
    pub transmittance: Vec<f64>,
    /// Expected depth, camera-space z: mean of the contributions' depths by weight; 0 if there is none.
    pub expected_depth: Vec<f64>,
    /// Camera-space z at which the transmittance falls below one half; 0 where it never does.
    pub median_depth: Vec<f64>,
    /// Number of splats that contribute.
    pub count: Vec<u32>,
    /// Unit normal of the nearest mesh fragment, facing the camera, in world space; zero without one.
    pub normal: Vec<[f64; 3]>,
}

impl Layers {
    /// The picture: both parts over `background`, `[height·width]`.
    #[must_use]
    pub fn over(&self, background: [f32; 3]) -> Vec<[f64; 3]> {
        let parts = self.splats.iter().zip(&self.mesh).zip(&self.transmittance);
        parts.map(|((s, m), t)| [0, 1, 2].map(|c| s[c] + m[c] + t * f64::from(background[c]))).collect()
    }
}

/// Renders a scene in parts. Under [`ImageModel::Ewa`] they sum to [`render`](super::render).
#[must_use]
pub fn render_layers(scene: &HybridScene, camera: &Camera, model: ImageModel) -> Layers {
    let parameters = Parameters::of(scene);
    let k = camera.intrinsics();
    let mut layers = Layers { width: k.width as usize, height: k.height as usize, ..Layers::default() };
    let pixels = 0..layers.width * layers.height;
    let part = |list: Vec<Contribution>, hits: &[mesh::Hit]| {
        let normal = hits.first().map_or(DVec3::ZERO, |hit| hit.normal(camera));
        Part { normal: normal.to_array(), ..Part::of(&list) }
    };
    let parts: Vec<Part> = match model {
        ImageModel::Ewa => {
            let view = View::new(scene, camera, &parameters);
            pixels.into_par_iter().map(|i| part(view.contributions(i), &view.hits[i])).collect()
        }
        ImageModel::Ray(direction) => {
            let view = RayView::new(scene, camera, &parameters, direction);
            let list = |i| view.contributions(scene, &parameters, i);
            pixels.into_par_iter().map(|i| part(list(i), &view.hits[i])).collect()
        }
    };
    for part in parts {
        layers.splats.push(part.splats);
        layers.mesh.push(part.mesh);
        layers.transmittance.push(part.transmittance);
        layers.expected_depth.push(part.expected_depth);
        layers.median_depth.push(part.median_depth);
        layers.count.push(part.count);
        layers.normal.push(part.normal);
    }
    layers
}

/// One pixel of [`Layers`].
#[derive(Default)]
struct Part {
    splats: [f64; 4],
    mesh: [f64; 4],
    transmittance: f64,
    expected_depth: f64,
    median_depth: f64,
    count: u32,
    normal: [f64; 3],
}

impl Part {
    fn of(list: &[Contribution]) -> Self {
        let mut part = Self { transmittance: 1.0, ..Self::default() };
        let (mut weights, mut depth) = (0.0, 0.0);
        for c in list {
            let weight = c.transmittance * c.alpha;
            let sum = match c.source {
                Source::Splat(..) => {
                    part.count += 1;
                    &mut part.splats
                }
                Source::Layer(_) => &mut part.mesh,
            };
            let premultiplied = (weight * c.color).extend(weight).to_array();
            sum.iter_mut().zip(premultiplied).for_each(|(s, v)| *s += v);
            weights += weight;
            depth += weight * c.depth;
            part.transmittance = c.transmittance * (1.0 - c.alpha);
            if c.transmittance >= 0.5 && part.transmittance < 0.5 {
                part.median_depth = c.depth;
            }
        }
        part.expected_depth = if weights > 0.0 { depth / weights } else { 0.0 };
        part
    }
}
