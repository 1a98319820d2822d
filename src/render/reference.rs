//! The oracle: the composition rule of [`super::contract`] in f64, one pixel at a time, from an explicit
//! sorted list. No tiles, no buckets of running sums, no tricks: slow and meant to be checked by eye.

mod backward;
mod layers;
mod margin;
mod mean_rays;
mod mesh;
#[cfg(test)]
mod mip_tests;
mod order_flips;
mod parameters;
mod ray;
#[cfg(test)]
mod tests;

use glam::{DMat2, DMat3, DQuat, DVec2, DVec3};
use rayon::prelude::*;

pub use backward::{ScreenStatistics, backward, backward_parameters, disparity};
pub use layers::{Layers, render_layers};
pub use margin::{Margin, margins, render_with_margins};
pub use mean_rays::{MeanRays, render_by_mean_rays};
pub use order_flips::{OrderFlips, order_flips};
pub use parameters::{Parameter, Parameters, finite_difference};

use super::contract::{self, MAX_LAYERS, SurfaceDepth};
use crate::scene::{Camera, HybridScene, sh, sigmoid, smoothed};

/// A rendered image, row-major from the top; or, as the input of [`backward`], the derivative of a loss with respect to
/// each of its values.
#[derive(Clone, Debug, PartialEq)]
pub struct Image {
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
    /// Colour over the scene's background, in the scene's blending space, not clamped. `[height·width]`
    pub rgb: Vec<[f64; 3]>,
    /// Weight of the background: 1 − accumulated alpha. `[height·width]`
    pub transmittance: Vec<f64>,
}

impl Image {
    /// Dot product of all values of two images of one size.
    #[must_use]
    pub fn dot(&self, other: &Self) -> f64 {
        let rgb = self.rgb.as_flattened().iter().zip(other.rgb.as_flattened());
        rgb.chain(self.transmittance.iter().zip(&other.transmittance)).map(|(a, b)| a * b).sum()
    }
}

/// Contribution of a mesh layer to a pixel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Fragment {
    /// Camera-space z.
    pub depth: f64,
    /// RGB, ≥ 0.
    pub color: [f64; 3],
    /// 0 to [`contract::MESH_ALPHA_CAP`].
    pub alpha: f64,
}

impl Fragment {
    /// The fragment as the `i`-th layer of a pixel, with transmittance not yet set.
    fn contribution(&self, i: usize) -> Contribution {
        let (source, color) = (Source::Layer(i), DVec3::from(self.color));
        Contribution { source, depth: self.depth, alpha: self.alpha, color, transmittance: 0.0 }
    }
}

/// A splat projected into an image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Projected {
    /// Index of the splat in the scene.
    pub index: usize,
    /// Continuous pixel position of the mean.
    pub center: DVec2,
    /// Projected covariance with the pixel filter, px².
    pub covariance: DMat2,
    /// Inverse of the covariance, 1/px².
    pub conic: DMat2,
    /// Half width and height of the box around all pixels it contributes to, px.
    pub extent: DVec2,
    /// Camera-space z of the mean.
    pub depth: f64,
    /// Opacity, 0 to 1, after smoothing and the pixel filter.
    pub opacity: f64,
    /// RGB, ≥ 0.
    pub color: DVec3,
}

/// The mesh layers of every pixel, row-major: nearest first, at most as many as the scene's composition keeps.
#[cfg(test)]
pub(crate) fn mesh_layers(scene: &HybridScene, camera: &Camera) -> Vec<Vec<Fragment>> {
    View::new(scene, camera, &Parameters::of(scene)).layers
}

/// Renders a scene.
#[must_use]
pub fn render(scene: &HybridScene, camera: &Camera) -> Image {
    render_parameters(scene, camera, &Parameters::of(scene))
}

/// Renders a scene with other parameters of the same shape.
///
/// # Panics
/// If the shapes differ.
#[must_use]
pub fn render_parameters(scene: &HybridScene, camera: &Camera, parameters: &Parameters) -> Image {
    View::new(scene, camera, parameters).composite(scene.composition.background)
}

/// Projects splat `i` (Kerbl et al. 2023, eq. 5); `None` if it is not beyond `near` or contributes to no pixel
/// anywhere.
///
/// # Panics
/// If there is no splat `i`.
#[must_use]
pub fn project(scene: &HybridScene, camera: &Camera, parameters: &Parameters, i: usize) -> Option<Projected> {
    let mean = camera.to_camera(parameters.means[i]);
    if mean.z <= f64::from(scene.composition.near) {
        return None;
    }
    let m = jacobian(camera, mean) * camera.rotation();
    let (scale, smooth_opacity) = smoothed(parameters.log_scales[i], parameters.smoothing[i]);
    let n = rotation(parameters.rotations[i]) * DMat3::from_diagonal(scale);
    let filter = scene.composition.pixel_filter;
    let projected = DMat2::from_mat3(m * n * n.transpose() * m.transpose());
    let covariance = projected + f64::from(filter.variance) * DMat2::IDENTITY;
    let conic = covariance.inverse();
    if !conic.is_finite() {
        return None;
    }
    let opacity = sigmoid(parameters.opacity_logits[i]) * smooth_opacity * contract::filter_opacity(filter, projected);
    let extent = contract::splat_extent(opacity, DVec2::new(covariance.x_axis.x, covariance.y_axis.y))?;
    let color = splat_radiance(scene, camera, parameters, i).max(DVec3::ZERO);
    Some(Projected { index: i, center: camera.project(mean), covariance, conic, extent, depth: mean.z, opacity, color })
}

/// The centre of a pixel of a row-major image.
fn pixel_center(camera: &Camera, pixel: usize) -> DVec2 {
    let width = camera.intrinsics().width as usize;
    DVec2::new((pixel % width) as f64, (pixel / width) as f64) + 0.5
}

/// Rotation matrix of a quaternion (w, x, y, z) of any norm.
fn rotation([w, x, y, z]: [f64; 4]) -> DMat3 {
    DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize())
}

/// x and y of `t` after clamping x/z and y/z to the range in which the projection is linearised.
fn clamped(camera: &Camera, t: DVec3) -> DVec2 {
    let (min, max) = contract::jacobian_limits(camera.intrinsics());
    t.z * (t.truncate() / t.z).clamp(min, max)
}

/// ∂(u, v)/∂(x, y, z) at camera-space `t`, with a third row of zeros.
fn jacobian(camera: &Camera, t: DVec3) -> DMat3 {
    let (k, near) = (camera.intrinsics(), clamped(camera, t));
    DMat3::from_cols(
        DVec3::new(k.fx / t.z, 0.0, 0.0),
        DVec3::new(0.0, k.fy / t.z, 0.0),
        DVec3::new(-k.fx * near.x / (t.z * t.z), -k.fy * near.y / (t.z * t.z), 0.0),
    )
}

/// Colour of splat `i` before the clamp at 0, seen from the camera's centre.
fn splat_radiance(scene: &HybridScene, camera: &Camera, parameters: &Parameters, i: usize) -> DVec3 {
    radiance_along(scene, parameters, i, (parameters.means[i] - camera.center()).normalize_or(DVec3::Z))
}

/// Colour of splat `i` before the clamp at 0, in a unit direction: `0.5 + Σ Y_k sh_k`.
fn radiance_along(scene: &HybridScene, parameters: &Parameters, i: usize, direction: DVec3) -> DVec3 {
    let coefficients = sh::coefficients(scene.splats.sh_degree());
    let terms = sh::basis(direction.to_array()).into_iter().zip(&parameters.sh[i * coefficients..]);
    0.5 + terms.take(coefficients).map(|(y, sh)| y * *sh).sum::<DVec3>()
}

/// Origin of an entry of a pixel's list.
#[derive(Clone, Copy, PartialEq)]
enum Source {
    /// Index into [`View::splats`], and the pixel's offset from the splat's centre.
    Splat(usize, DVec2),
    /// Index into the pixel's layers.
    Layer(usize),
}

/// One entry of a pixel's list.
#[derive(Clone, Copy)]
struct Contribution {
    source: Source,
    /// Camera-space z of the mean, the peak or the fragment.
    depth: f64,
    alpha: f64,
    color: DVec3,
    /// Product of 1 − alpha of everything in front.
    transmittance: f64,
}

/// A scene as seen by a camera.
struct View<'a> {
    camera: &'a Camera,
    hits: Vec<Vec<mesh::Hit>>,
    layers: Vec<Vec<Fragment>>,
    /// Splats sorted by (depth, index), with their order thresholds among the layers.
    splats: Vec<(Projected, [f64; MAX_LAYERS])>,
}

/// Hits of every pixel's ray with the meshes, and their shaded fragments.
fn fragments(
    scene: &HybridScene,
    camera: &Camera,
    parameters: &Parameters,
) -> (Vec<Vec<mesh::Hit>>, Vec<Vec<Fragment>>) {
    let hits = mesh::trace(scene, camera, &parameters.positions);
    let maps = mesh::maps(scene, parameters);
    let shade = |hits: &Vec<mesh::Hit>| hits.iter().map(|hit| mesh::shade(hit, &maps[hit.mesh])).collect();
    let layers = hits.iter().map(shade).collect();
    (hits, layers)
}

impl<'a> View<'a> {
    fn new(scene: &HybridScene, camera: &'a Camera, parameters: &Parameters) -> Self {
        let (hits, layers) = fragments(scene, camera, parameters);
        let project = |i| project(scene, camera, parameters, i);
        let mut splats: Vec<_> = (0..parameters.means.len())
            .filter_map(project)
            .map(|splat| (splat, splat_thresholds(scene, camera, &layers, &splat)))
            .collect();
        splats.sort_by(|(a, _), (b, _)| a.depth.total_cmp(&b.depth).then(a.index.cmp(&b.index)));
        Self { camera, hits, layers, splats }
    }

    /// The picture over a background.
    fn composite(&self, background: [f32; 3]) -> Image {
        let background = DVec3::from(background.map(f64::from));
        let composite = |pixel: usize| {
            let list = self.contributions(pixel);
            let transmittance = list.last().map_or(1.0, |last| last.transmittance * (1.0 - last.alpha));
            let rgb = list.iter().map(|c| c.transmittance * c.alpha * c.color).sum::<DVec3>();
            ((rgb + transmittance * background).to_array(), transmittance)
        };
        let (rgb, transmittance) = (0..self.layers.len()).into_par_iter().map(composite).unzip();
        let k = self.camera.intrinsics();
        Image { width: k.width as usize, height: k.height as usize, rgb, transmittance }
    }

    /// Contributions to a pixel, front to back, with their place in the order: bucket b is at 2b, the layer in front of
    /// it at 2b − 1. Transmittances are not set.
    fn ordered(&self, pixel: usize) -> Vec<(usize, Contribution)> {
        let position = pixel_center(self.camera, pixel);
        let layers = &self.layers[pixel];
        let depths: Vec<f64> = layers.iter().map(|layer| layer.depth).collect();
        let mut list = Vec::new();
        for (i, (splat, thresholds)) in self.splats.iter().enumerate() {
            let offset = position - splat.center;
            // Only an acceleration: with a pixel of slack the exact test decides.
            if offset.abs().cmpgt(splat.extent + 1.0).any() {
                continue;
            }
            if let Some(alpha) = contract::splat_alpha(splat.opacity, power(splat, offset)) {
                let source = Source::Splat(i, offset);
                let place = 2 * contract::bucket(&depths, thresholds);
                let (depth, color) = (splat.depth, splat.color);
                list.push((place, Contribution { source, depth, alpha, color, transmittance: 0.0 }));
            }
        }
        for (i, layer) in layers.iter().enumerate() {
            list.push((2 * i + 1, layer.contribution(i)));
        }
        list.sort_by_key(|(place, _)| *place); // stable: splats of a bucket stay sorted by (depth, index)
        list
    }

    /// Contributions to a pixel, front to back, without those dropped by the stop.
    fn contributions(&self, pixel: usize) -> Vec<Contribution> {
        let mut list = self.ordered(pixel);
        let mut transmittance = 1.0;
        let mut ended = None;
        list.retain_mut(|(place, contribution)| {
            let behind = transmittance * (1.0 - contribution.alpha);
            if matches!(contribution.source, Source::Splat(..)) {
                if behind < contract::TRANSMITTANCE_STOP {
                    ended = Some(*place);
                }
                if ended == Some(*place) {
                    return false;
                }
            }
            contribution.transmittance = transmittance;
            transmittance = behind;
            true
        });
        list.into_iter().map(|(_, contribution)| contribution).collect()
    }
}

/// Logarithm of a splat's Gaussian at `offset` from its centre.
fn power(splat: &Projected, offset: DVec2) -> f64 {
    -0.5 * offset.dot(splat.conic * offset)
}

/// [`contract::thresholds`] of a splat among the rendered layers.
fn splat_thresholds(
    scene: &HybridScene,
    camera: &Camera,
    layers: &[Vec<Fragment>],
    splat: &Projected,
) -> [f64; MAX_LAYERS] {
    let (k, composition) = (camera.intrinsics(), &scene.composition);
    let lambda = f64::from(composition.lambda);
    let sample = |layer: usize| -> SurfaceDepth {
        let depth_at = |[x, y]: [u32; 2]| {
            let pixel = y as usize * k.width as usize + x as usize;
            layers[pixel].get(layer).map_or(0.0, |fragment| fragment.depth)
        };
        contract::surface_depth(depth_at, [k.width, k.height], splat.center, lambda)
    };
    let samples: Vec<_> = (0..composition.layers as usize).map(sample).collect();
    contract::thresholds(composition.mode, splat.depth, &samples, lambda)
}
