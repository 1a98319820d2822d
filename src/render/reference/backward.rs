//! All gradients in closed form, in one pass over the pixels' lists, back to front. The tests compare them with finite
//! differences.

use glam::{DMat2, DMat3, DVec2, DVec3};

use super::{Image, Parameters, Projected, Source, View, jacobian, mesh, power, rotation, splat_radiance};
use crate::render::contract;
use crate::scene::{Camera, HybridScene, sh, sigmoid, smoothed};

/// Derivatives with respect to a splat's projected properties.
#[derive(Clone, Copy)]
struct ProjectedGradient {
    color: DVec3,
    opacity: f64,
    center: DVec2,
    conic: DMat2,
    weight: f64,
}

/// Statistics of a splat in one view for density control. Zeros if it is culled.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ScreenStatistics {
    /// Derivative of the loss with respect to the projected mean, per pixel.
    pub center: DVec2,
    /// Sum over pixels of the weight with which its colour is blended.
    pub weight: f64,
}

/// Gradients with respect to every mip level of a mesh's textures.
struct MapGradients {
    base: Vec<Vec<f64>>,
    bands: Vec<Vec<f64>>,
}

/// Derivatives of Σ `cotangent`·[`render`](super::render) with respect to every parameter of the scene.
///
/// Orders and culls are piecewise constant and have no derivative; neither has the mip level nor, for meshes, the
/// view direction. Where alpha or a colour is clamped its derivative is zero. The gradient of a rotation is that of
/// the normalised quaternion.
///
/// # Panics
/// If `cotangent` is not of the camera's size.
#[must_use]
pub fn backward(scene: &HybridScene, camera: &Camera, cotangent: &Image) -> Parameters {
    backward_parameters(scene, camera, &Parameters::of(scene), cotangent, None).0
}

/// [`backward`] of a scene with other parameters of the same shape, and the statistics of every splat for density
/// control. The loss also includes `disparity_slopes` times each pixel's [`disparity`] (world units), differentiated by
/// the splats' weights only: depths are held fixed, and meshes are not affected.
///
/// # Panics
/// If the shapes differ, or `cotangent` or the slopes are not of the camera's size.
#[must_use]
pub fn backward_parameters(
    scene: &HybridScene,
    camera: &Camera,
    parameters: &Parameters,
    cotangent: &Image,
    disparity_slopes: Option<&[f64]>,
) -> (Parameters, Vec<ScreenStatistics>) {
    let view = View::new(scene, camera, parameters);
    let mut splats = vec![ProjectedGradient::ZERO; view.splats.len()];
    let maps = mesh::maps(scene, parameters);
    let mut texels: Vec<_> = maps.iter().map(MapGradients::zeros_like).collect();
    let mut positions = parameters.zeros_like().positions;
    let background = DVec3::from(scene.composition.background.map(f64::from));

    for pixel in 0..view.layers.len() {
        let list = view.contributions(pixel);
        let d_rgb = DVec3::from(cotangent.rgb[pixel]);
        let last = list.last().map_or(1.0, |last| last.transmittance * (1.0 - last.alpha));
        let disparity_slope = disparity_slopes.map_or(0.0, |slopes| slopes[pixel]);
        let (mut behind, mut disparity_behind) = (background, 0.0);
        for c in list.iter().rev() {
            let d_color = c.transmittance * c.alpha * d_rgb;
            let d_alpha =
                c.transmittance * d_rgb.dot(c.color - behind) - cotangent.transmittance[pixel] * last / (1.0 - c.alpha);
            let d_alpha_of_disparity = disparity_slope * c.transmittance * (1.0 / c.depth - disparity_behind);
            behind = c.alpha * c.color + (1.0 - c.alpha) * behind;
            disparity_behind = c.alpha / c.depth + (1.0 - c.alpha) * disparity_behind;
            match c.source {
                Source::Splat(i, offset) => {
                    splats[i].weight += c.transmittance * c.alpha;
                    splats[i].add(&view.splats[i].0, offset, d_color, d_alpha + d_alpha_of_disparity);
                }
                Source::Layer(i) => {
                    let hit = &view.hits[pixel][i];
                    // Clamped channels and clamped alpha have no derivative.
                    let d_color = DVec3::select(c.color.cmpgt(DVec3::ZERO), d_color, DVec3::ZERO);
                    let d_logit =
                        if c.alpha < contract::MESH_ALPHA_CAP { d_alpha * c.alpha * (1.0 - c.alpha) } else { 0.0 };
                    texels[hit.mesh].add(hit, d_color, d_logit);
                    let corners = scene.meshes[hit.mesh].triangles()[hit.triangle];
                    for (v, d) in corners.into_iter().zip(hit.corner_gradient(&maps[hit.mesh], d_color, d_logit)) {
                        positions[hit.mesh][v as usize] += camera.rotation().transpose() * d;
                    }
                }
            }
        }
    }

    let mut result = Parameters { positions, ..parameters.zeros_like() };
    let mut statistics = vec![ScreenStatistics { center: DVec2::ZERO, weight: 0.0 }; scene.splats.len()];
    for ((splat, _), gradient) in view.splats.iter().zip(&splats) {
        statistics[splat.index] = ScreenStatistics { center: gradient.center, weight: gradient.weight };
        splat_backward(scene, camera, parameters, splat, gradient, &mut result);
    }
    for (i, (mesh, levels)) in scene.meshes.iter().zip(texels).enumerate() {
        result.base[i] = mesh::pull_down(mesh.atlas().base(), levels.base);
        if let Some(bands) = mesh.atlas().bands() {
            result.bands[i] = mesh::pull_down(bands, levels.bands);
        }
    }
    (result, statistics)
}

/// Expected disparity of each pixel `[h·w]`, Σ of weight/z over its contributions, 1/world unit.
///
/// # Panics
/// If the shapes differ.
#[must_use]
pub fn disparity(scene: &HybridScene, camera: &Camera, parameters: &Parameters) -> Vec<f64> {
    let view = View::new(scene, camera, parameters);
    let of_pixel = |pixel| view.contributions(pixel).iter().map(|c| c.transmittance * c.alpha / c.depth).sum::<f64>();
    (0..view.layers.len()).map(of_pixel).collect()
}

impl ProjectedGradient {
    // Not derived, as a matrix's default is the identity.
    const ZERO: Self = Self { color: DVec3::ZERO, opacity: 0.0, center: DVec2::ZERO, conic: DMat2::ZERO, weight: 0.0 };

    /// Adds one pixel at `offset` from the centre of `splat`.
    fn add(&mut self, splat: &Projected, offset: DVec2, d_color: DVec3, d_alpha: f64) {
        self.color += d_color;
        let gaussian = power(splat, offset).exp();
        let alpha = splat.opacity * gaussian;
        if alpha < contract::ALPHA_CAP {
            let d_power = alpha * d_alpha;
            self.opacity += gaussian * d_alpha;
            self.center += d_power * (splat.conic * offset);
            self.conic += -0.5 * d_power * outer(offset, offset);
        }
    }
}

impl MapGradients {
    fn zeros_like(maps: &mesh::Maps) -> Self {
        let zeros = |levels: &[Vec<f64>]| levels.iter().map(|level| vec![0.0; level.len()]).collect();
        Self { base: zeros(&maps.base), bands: zeros(&maps.bands) }
    }

    /// Spreads the gradient of one fragment over the texels it was filtered from.
    fn add(&mut self, hit: &mesh::Hit, d_color: DVec3, d_logit: f64) {
        for tap in &hit.base {
            let texel = &mut self.base[tap.level][4 * tap.texel..][..4];
            for channel in 0..3 {
                texel[channel] += tap.weight * hit.basis[0] * d_color[channel];
            }
            texel[3] += tap.weight * d_logit;
        }
        for tap in &hit.bands {
            let channels = hit.band_channels;
            let texel = &mut self.bands[tap.level][channels * tap.texel..][..channels];
            for (i, gradient) in texel.iter_mut().enumerate() {
                *gradient += tap.weight * hit.basis[1 + i / 3] * d_color[i % 3];
            }
        }
    }
}

/// Gradients of a splat's parameters from those of its projected properties.
fn splat_backward(
    scene: &HybridScene,
    camera: &Camera,
    parameters: &Parameters,
    splat: &Projected,
    gradient: &ProjectedGradient,
    result: &mut Parameters,
) {
    let i = splat.index;
    // In terms of log opacity: each factor of the opacity contributes additively, and d/d(log o) is o times d/do.
    let d_log_opacity = gradient.opacity * splat.opacity;
    result.opacity_logits[i] = d_log_opacity * (1.0 - sigmoid(parameters.opacity_logits[i]));

    // Covariance: Σ' = Σ2 + kI with Σ2 = M Σ3 Mᵀ, M = J W, Σ3 = N Nᵀ, N = R diag(s).
    let mut d_covariance = -1.0 * splat.conic * gradient.conic * splat.conic;
    let filter = scene.composition.pixel_filter;
    if filter.normalized {
        // Derivative of the factor √(det Σ2 / det Σ').
        let projected = splat.covariance - f64::from(filter.variance) * DMat2::IDENTITY;
        d_covariance += 0.5 * d_log_opacity * (projected.inverse() - splat.conic);
    }
    let d_covariance = DMat3 { z_axis: DVec3::ZERO, ..DMat3::from_mat2(d_covariance) };
    let t = camera.to_camera(parameters.means[i]);
    let m = jacobian(camera, t) * camera.rotation();
    let (s, _) = smoothed(parameters.log_scales[i], parameters.smoothing[i]);
    let r = rotation(parameters.rotations[i]);
    let n = r * DMat3::from_diagonal(s);
    let d_n = 2.0 * m.transpose() * d_covariance * m * n;
    let d_jacobian = 2.0 * d_covariance * m * n * n.transpose() * camera.rotation().transpose();
    for j in 0..3 {
        // Share of the splat's own variance in the smoothed one; the rest acts through the factor Π s/s̃ of the
        // opacity.
        let own = (parameters.log_scales[i][j].exp() / s[j]).powi(2);
        result.log_scales[i][j] = own * s[j] * d_n.col(j).dot(r.col(j)) + (1.0 - own) * d_log_opacity;
    }
    result.rotations[i] = rotation_backward(parameters.rotations[i], d_n * DMat3::from_diagonal(s));

    let d_camera = mean_backward(camera, t, d_jacobian, gradient.center);
    let d_color =
        DVec3::select(splat_radiance(scene, camera, parameters, i).cmpgt(DVec3::ZERO), gradient.color, DVec3::ZERO);
    result.means[i] =
        camera.rotation().transpose() * d_camera + radiance_backward(scene, camera, parameters, i, d_color, result);
}

/// Gradient of the SH coefficients of splat `i` into `result`; returns that of its mean through the view direction.
fn radiance_backward(
    scene: &HybridScene,
    camera: &Camera,
    parameters: &Parameters,
    i: usize,
    d_color: DVec3,
    result: &mut Parameters,
) -> DVec3 {
    let to_mean = parameters.means[i] - camera.center();
    let direction = to_mean.normalize_or(DVec3::Z);
    let (basis, partials) = (sh::basis(direction.to_array()), basis_partials(direction));
    let coefficients = sh::coefficients(scene.splats.sh_degree());
    let mut d_direction = DVec3::ZERO;
    for k in 0..coefficients {
        result.sh[i * coefficients + k] = basis[k] * d_color;
        d_direction += partials[k] * parameters.sh[i * coefficients + k].dot(d_color);
    }
    d_direction.reject_from_normalized(direction) / to_mean.length()
}

/// Gradient of a camera-space mean through the centre (u, v) of its image and the Jacobian there.
fn mean_backward(camera: &Camera, t: DVec3, d_jacobian: DMat3, d_center: DVec2) -> DVec3 {
    let k = camera.intrinsics();
    let focal = DVec2::new(k.fx, k.fy);
    let zz = t.z * t.z;
    let (min, max) = contract::jacobian_limits(k);
    let mut d = DVec3::ZERO;
    for axis in 0..2 {
        let d_entry = d_jacobian.z_axis[axis]; // of −f·x̂/z²
        d[axis] += focal[axis] / t.z * d_center[axis];
        d.z -= focal[axis] / zz * (t[axis] * d_center[axis] + d_jacobian.col(axis)[axis]);
        let slope = t[axis] / t.z;
        if (min[axis]..=max[axis]).contains(&slope) {
            d[axis] -= focal[axis] / zz * d_entry;
            d.z += 2.0 * focal[axis] * t[axis] / (zz * t.z) * d_entry;
        } else {
            // x̂ = z·limit: the entry is −f·limit/z.
            d.z += focal[axis] / zz * slope.clamp(min[axis], max[axis]) * d_entry;
        }
    }
    d
}

/// Gradient of a quaternion (w, x, y, z) before normalisation from the gradient `h` of its rotation matrix.
fn rotation_backward(raw: [f64; 4], h: DMat3) -> [f64; 4] {
    let norm = raw.iter().map(|c| c * c).sum::<f64>().sqrt();
    let unit = raw.map(|c| c / norm);
    let [w, x, y, z] = unit;
    let h = |row: usize, column: usize| h.col(column)[row];
    let g = [
        2.0 * (x * (h(2, 1) - h(1, 2)) + y * (h(0, 2) - h(2, 0)) + z * (h(1, 0) - h(0, 1))),
        2.0 * (-2.0 * x * (h(1, 1) + h(2, 2))
            + y * (h(0, 1) + h(1, 0))
            + z * (h(0, 2) + h(2, 0))
            + w * (h(2, 1) - h(1, 2))),
        2.0 * (x * (h(0, 1) + h(1, 0)) - 2.0 * y * (h(0, 0) + h(2, 2))
            + z * (h(1, 2) + h(2, 1))
            + w * (h(0, 2) - h(2, 0))),
        2.0 * (x * (h(0, 2) + h(2, 0)) + y * (h(1, 2) + h(2, 1)) - 2.0 * z * (h(0, 0) + h(1, 1))
            + w * (h(1, 0) - h(0, 1))),
    ];
    let along: f64 = unit.iter().zip(&g).map(|(q, g)| q * g).sum();
    [0, 1, 2, 3].map(|i| (g[i] - unit[i] * along) / norm)
}

/// Partial derivatives of the polynomials of [`sh::basis`], with the same constants.
fn basis_partials(d: DVec3) -> [DVec3; 16] {
    const C1: f64 = 0.488_602_511_902_919_9;
    let DVec3 { x, y, z } = d;
    let (xx, yy, zz) = (x * x, y * y, z * z);
    let v = DVec3::new;
    [
        DVec3::ZERO,
        -C1 * DVec3::Y,
        C1 * DVec3::Z,
        -C1 * DVec3::X,
        1.092_548_430_592_079_2 * v(y, x, 0.0),
        -1.092_548_430_592_079_2 * v(0.0, z, y),
        0.315_391_565_252_520_05 * v(-2.0 * x, -2.0 * y, 4.0 * z),
        -1.092_548_430_592_079_2 * v(z, 0.0, x),
        0.546_274_215_296_039_6 * v(2.0 * x, -2.0 * y, 0.0),
        -0.590_043_589_926_643_5 * v(6.0 * x * y, 3.0 * (xx - yy), 0.0),
        2.890_611_442_640_554 * v(y * z, x * z, x * y),
        -0.457_045_799_464_465_8 * v(-2.0 * x * y, 4.0 * zz - xx - 3.0 * yy, 8.0 * y * z),
        0.373_176_332_590_115_4 * v(-6.0 * x * z, -6.0 * y * z, 6.0 * zz - 3.0 * xx - 3.0 * yy),
        -0.457_045_799_464_465_8 * v(4.0 * zz - 3.0 * xx - yy, -2.0 * x * y, 8.0 * x * z),
        1.445_305_721_320_277 * v(2.0 * x * z, -2.0 * y * z, xx - yy),
        -0.590_043_589_926_643_5 * v(3.0 * (xx - yy), -6.0 * x * y, 0.0),
    ]
}

/// Outer product a bᵀ.
fn outer(a: DVec2, b: DVec2) -> DMat2 {
    DMat2::from_cols(a * b.x, a * b.y)
}
