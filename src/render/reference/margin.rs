//! Margins of a pixel: how far its decisions are from their thresholds.

use glam::{DVec2, DVec3};
use rayon::prelude::*;

use super::{Image, Parameters, Projected, Source, View, mesh, pixel_center, power, render};
use crate::render::contract::{ALPHA_CUT, TIE_EPSILON, TRANSMITTANCE_STOP, bilinear_taps};
use crate::scene::{Camera, HybridScene, OrderMode};

/// Weight above which a dropped splat is visible.
const VISIBLE_WEIGHT: f64 = 1e-3;

/// Smallest distances of decisions made at a pixel from their thresholds, by kind, each relative to the quantity
/// compared. Infinite where nothing is decided.
///
/// An implementation in lower precision may differ visibly only at *threshold pixels*, where one of them is small.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Margin {
    /// Alpha of splats against the cut.
    pub alpha: f64,
    /// Depth order: splat against next splat, splat against layer or surface, layer against next layer, near plane.
    pub order: f64,
    /// Barycentric distance from triangle edges, here and where the depth of a surface was sampled for a splat;
    /// bilinear weights where they decide on such a sample.
    pub edge: f64,
    /// Transmittance against the stop. 0 where the stop drops a visible splat behind a mesh layer: an
    /// implementation that traverses splats and layers in another order knows what is in front only at the end.
    pub stop: f64,
}

impl Margin {
    /// Kinds of decisions: the cut of alpha, the order of depths, edges of triangles, the stop of transmittance.
    pub const KINDS: [&str; 4] = ["alpha", "order", "edge", "stop"];
    const NONE: Self = Self { alpha: f64::INFINITY, order: f64::INFINITY, edge: f64::INFINITY, stop: f64::INFINITY };

    /// Whether any distance is below its `tolerance`.
    #[must_use]
    pub fn is_within(&self, tolerance: &Self) -> bool {
        self.within(tolerance).contains(&true)
    }

    /// Which distances are below their `tolerance`, in the order of [`Margin::KINDS`].
    #[must_use]
    pub fn within(&self, tolerance: &Self) -> [bool; 4] {
        [
            self.alpha < tolerance.alpha,
            self.order < tolerance.order,
            self.edge < tolerance.edge,
            self.stop < tolerance.stop,
        ]
    }
}

/// Renders an image, with the margins of every pixel.
#[must_use]
pub fn render_with_margins(scene: &HybridScene, camera: &Camera) -> (Image, Vec<Margin>) {
    (render(scene, camera), margins(scene, camera, &Parameters::of(scene)))
}

/// Margins of every pixel with other parameters of the same shape.
///
/// # Panics
/// If the shapes differ.
#[must_use]
pub fn margins(scene: &HybridScene, camera: &Camera, parameters: &Parameters) -> Vec<Margin> {
    let view = View::new(scene, camera, parameters);
    let triangles: Vec<_> =
        mesh::camera_triangles(scene, camera, &parameters.positions).into_iter().flatten().collect();
    let pixels = 0..view.layers.len();
    let near = f64::from(scene.composition.near);
    let hits: Vec<_> =
        pixels.clone().into_par_iter().map(|pixel| hit_margin(camera, &triangles, near, pixel)).collect();
    let surfaces: Vec<_> =
        view.splats.iter().map(|(splat, _)| surface_margin(scene, camera, &view, &hits, splat)).collect();
    pixels.into_par_iter().map(|pixel| splat_margin(&view, &surfaces, pixel, hits[pixel])).collect()
}

/// Margins of which triangles a pixel's ray hits, and in which order.
fn hit_margin(camera: &Camera, triangles: &[[DVec3; 3]], near: f64, pixel: usize) -> Margin {
    let mut margin = Margin::NONE;
    let r = camera.ray(pixel_center(camera, pixel));
    let mut depths = Vec::new();
    for x in triangles.iter().filter_map(|&v| mesh::intersect(v, r)).filter(|x| x.depth > 0.5 * near) {
        let inner = x.barycentric.into_iter().fold(f64::INFINITY, f64::min);
        margin.edge = margin.edge.min(inner.abs());
        if x.inside {
            margin.order = margin.order.min((x.depth / near - 1.0).abs());
            depths.push(x.depth);
        }
    }
    depths.sort_by(f64::total_cmp);
    for pair in depths.windows(2) {
        margin.order = margin.order.min(pair[1] / pair[0] - 1.0);
    }
    margin
}

/// Margins of a splat's thresholds among the layers, which apply to all pixels that it shares with a mesh.
fn surface_margin(scene: &HybridScene, camera: &Camera, view: &View<'_>, hits: &[Margin], splat: &Projected) -> Margin {
    let mut margin = Margin::NONE;
    let (k, composition) = (camera.intrinsics(), &scene.composition);
    if composition.mode == OrderMode::Direct {
        return margin;
    }
    let size = k.size();
    let border = splat.center.abs().min((splat.center - size).abs()) / size;
    margin.order = border.min_element();
    if splat.center.cmplt(DVec2::ZERO).any() || splat.center.cmpge(size).any() {
        return margin;
    }
    let lambda = f64::from(composition.lambda);
    let taps = bilinear_taps(splat.center, [k.width, k.height])
        .map(|([x, y], weight)| (weight, y as usize * k.width as usize + x as usize));
    for (_, pixel) in taps {
        margin.edge = margin.edge.min(hits[pixel].edge);
    }
    for layer in 0..composition.layers as usize {
        let depths = taps.map(|(_, pixel)| view.layers[pixel].get(layer).map_or(0.0, |f| f.depth));
        let far = depths.into_iter().fold(0.0, f64::max);
        let near = depths.into_iter().filter(|d| *d > 0.0).fold(far, f64::min);
        // Every value that the sample could take is a candidate; the interpolated one lies between them.
        for depth in depths.into_iter().filter(|d| *d > 0.0) {
            margin.order = margin.order.min((splat.depth / (depth * (1.0 + TIE_EPSILON)) - 1.0).abs());
        }
        if near < splat.depth && splat.depth < far {
            let (weight, inverse) = depths
                .iter()
                .zip(taps)
                .filter(|(d, _)| **d > 0.0)
                .fold((0.0, 0.0), |(sum, inverse), (d, (w, _))| (sum + w, inverse + w / d));
            margin.order = margin.order.min((splat.depth * inverse / weight - 1.0).abs());
        }
        if far > 0.0 {
            margin.order = margin.order.min((far - near - lambda).abs() / far);
        }
        if depths.contains(&0.0) || far - near > lambda {
            let mut weights = taps.map(|(weight, _)| weight);
            weights.sort_by(f64::total_cmp);
            margin.edge = margin.edge.min(weights[0]).min(weights[3] - weights[2]);
        }
    }
    margin
}

/// `margin` combined with the margins of the splats of a pixel.
fn splat_margin(view: &View<'_>, surfaces: &[Margin], pixel: usize, mut margin: Margin) -> Margin {
    let position = pixel_center(view.camera, pixel);
    let layers = &view.layers[pixel];
    let mut previous = 0.0;
    for ((splat, thresholds), surface) in view.splats.iter().zip(surfaces) {
        let above_cut = power(splat, position - splat.center) + (splat.opacity / ALPHA_CUT).ln();
        margin.alpha = margin.alpha.min(above_cut.abs());
        if above_cut < 0.0 {
            continue;
        }
        margin.order = margin.order.min(1.0 - previous / splat.depth);
        previous = splat.depth;
        if !layers.is_empty() {
            margin.order = margin.order.min(surface.order);
            margin.edge = margin.edge.min(surface.edge);
        }
        for (layer, threshold) in layers.iter().zip(thresholds) {
            margin.order = margin.order.min((threshold / layer.depth - 1.0).abs());
        }
    }

    let (mut transmittance, mut ended) = (1.0, None);
    for (place, contribution) in view.ordered(pixel) {
        let behind = transmittance * (1.0 - contribution.alpha);
        if matches!(contribution.source, Source::Splat(..)) {
            if ended != Some(place) {
                margin.stop = margin.stop.min((behind / TRANSMITTANCE_STOP - 1.0).abs());
            }
            if ended == Some(place) || behind < TRANSMITTANCE_STOP {
                ended = Some(place);
                if place > 0 && transmittance * contribution.alpha > VISIBLE_WEIGHT {
                    margin.stop = 0.0;
                }
                continue;
            }
        }
        transmittance = behind;
    }
    margin
}
