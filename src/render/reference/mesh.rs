//! Mesh fragments of a pixel ray: intersection, texture filtering (mip levels as in nvdiffrast), shading.

use glam::{DVec2, DVec3, Vec2};
use rayon::prelude::*;

use super::{Fragment, Parameters, pixel_center};
use crate::geometry::MeshBvh;
use crate::render::contract;
#[cfg(test)]
use crate::scene::Atlas;
use crate::scene::{Camera, HybridScene, Mesh, Texture, sh};

/// Intersection of a ray with a mesh, and the texture filtering there. Independent of the texels' values.
pub(super) struct Hit {
    pub(super) mesh: usize,
    pub(super) triangle: usize,
    pub(super) depth: f64,
    /// Camera-space vertices, their UVs, and the ray (z = 1).
    corners: [DVec3; 3],
    uvs: [DVec2; 3],
    ray: DVec3,
    intersection: Intersection,
    /// SH basis at the direction camera→fragment in world space.
    pub(super) basis: [f64; 16],
    pub(super) base: Vec<Tap>,
    pub(super) bands: Vec<Tap>,
    /// Channels of the bands texture, 0 without.
    pub(super) band_channels: usize,
}

/// One texel of a mip level and its weight in a trilinear sample.
pub(super) struct Tap {
    pub(super) level: usize,
    pub(super) texel: usize,
    pub(super) weight: f64,
    /// ∂weight/∂uv at constant mip level.
    pub(super) slope: DVec2,
}

/// Intersection of a ray with a triangle.
pub(super) struct Intersection {
    pub(super) depth: f64,
    pub(super) barycentric: [f64; 3],
    pub(super) inside: bool,
    /// Derivatives ∂a/∂r of the unnormalised barycentrics a.
    n: [DVec3; 3],
    /// Sum of a.
    sum: f64,
}

/// Intersects ray `r` (z = 1) with the plane of a triangle of camera-space vertices `v`; `None` if they are parallel.
///
/// `inside` includes left and top edges only, so that a ray exactly through an edge that two triangles share from
/// either side hits one of them, whatever their winding: opposite edges give exactly negated `a` and `n`.
pub(super) fn intersect(v: [DVec3; 3], r: DVec3) -> Option<Intersection> {
    let n = [v[1].cross(v[2]), v[2].cross(v[0]), v[0].cross(v[1])];
    let a = n.map(|n| r.dot(n));
    let sum: f64 = a.iter().sum();
    if sum == 0.0 {
        return None;
    }
    let inside = (0..3).all(|i| {
        let (a, n) = (a[i] * sum.signum(), n[i] * sum.signum());
        a > 0.0 || a == 0.0 && (n.x > 0.0 || n.x == 0.0 && n.y > 0.0)
    });
    Some(Intersection { depth: v[0].dot(n[0]) / sum, barycentric: a.map(|a| a / sum), inside, n, sum })
}

impl Hit {
    /// Unit normal of the triangle, towards the camera, in world space.
    pub(super) fn normal(&self, camera: &Camera) -> DVec3 {
        let [a, b, c] = self.corners;
        let normal = (b - a).cross(c - a).normalize_or_zero();
        camera.rotation().transpose() * if normal.dot(self.ray) > 0.0 { -normal } else { normal }
    }

    /// Gradient with respect to the camera-space corners, from that of the colour before its clamp and of the opacity
    /// logit. The mip level is taken for constant.
    pub(super) fn corner_gradient(&self, maps: &Maps, d_color: DVec3, d_logit: f64) -> [DVec3; 3] {
        let mut d_uv = DVec2::ZERO;
        for tap in &self.base {
            let texel = &maps.base[tap.level][4 * tap.texel..][..4];
            let along = self.basis[0] * d_color.dot(DVec3::from_slice(texel)) + d_logit * texel[3];
            d_uv += along * tap.slope;
        }
        for tap in &self.bands {
            let texel = &maps.bands[tap.level][self.band_channels * tap.texel..][..self.band_channels];
            let terms = texel.chunks_exact(3).zip(&self.basis[1..]);
            let along: f64 = terms.map(|(t, y)| y * d_color.dot(DVec3::from_slice(t))).sum();
            d_uv += along * tap.slope;
        }
        let (b, v, r) = (self.intersection.barycentric, self.corners, self.ray);
        let gamma = self.uvs.map(|uv| d_uv.dot(uv));
        let mean: f64 = gamma.iter().zip(b).map(|(g, b)| g * b).sum();
        let kappa = gamma.map(|g| (g - mean) / self.intersection.sum);
        let mut gradient = [DVec3::ZERO; 3];
        for (i, j, k) in [(0, 1, 2), (1, 2, 0), (2, 0, 1)] {
            gradient[j] += kappa[i] * v[k].cross(r);
            gradient[k] += kappa[i] * r.cross(v[j]);
        }
        gradient
    }
}

#[cfg(test)]
impl Hit {
    /// Mip levels at which base and bands are sampled; 0 of bands that are not there.
    pub(super) fn levels(&self, camera: &Camera, atlas: &Atlas) -> [f64; 2] {
        let (_, duv) = self.intersection.footprint(camera, &self.uvs);
        [Some(atlas.base()), atlas.bands()].map(|texture| texture.map_or(0.0, |texture| mip_level(texture, duv)))
    }

    /// Samples them at these levels, whatever the footprint.
    pub(super) fn sample_at(&mut self, camera: &Camera, atlas: &Atlas, [base, bands]: [f64; 2]) {
        let (uv, _) = self.intersection.footprint(camera, &self.uvs);
        self.base = taps_at_level(atlas.base(), uv, base);
        self.bands = atlas.bands().map_or_else(Vec::new, |texture| taps_at_level(texture, uv, bands));
    }
}

impl Intersection {
    /// The UV there, and how it changes per pixel in x and in y.
    fn footprint(&self, camera: &Camera, uvs: &[DVec2; 3]) -> (DVec2, [DVec2; 2]) {
        let interpolate = |b: &[f64; 3]| b[0] * uvs[0] + b[1] * uvs[1] + b[2] * uvs[2];
        (interpolate(&self.barycentric), self.screen_derivative(camera).map(|d| interpolate(&d)))
    }

    /// ∂barycentric/∂(pixel x), ∂barycentric/∂(pixel y).
    fn screen_derivative(&self, camera: &Camera) -> [[f64; 3]; 2] {
        let k = camera.intrinsics();
        [(0, k.fx), (1, k.fy)].map(|(axis, focal)| {
            let da = self.n.map(|n| n[axis] / focal);
            let dsum: f64 = da.iter().sum();
            [0, 1, 2].map(|i| (da[i] - self.barycentric[i] * dsum) / self.sum)
        })
    }
}

/// Camera-space vertices of every triangle, per mesh.
pub(super) fn camera_triangles(scene: &HybridScene, camera: &Camera, positions: &[Vec<DVec3>]) -> Vec<Vec<[DVec3; 3]>> {
    let triangles = |(mesh, positions): (&Mesh, &Vec<DVec3>)| {
        mesh.triangles().iter().map(|t| t.map(|i| camera.to_camera(positions[i as usize]))).collect()
    };
    scene.meshes.iter().zip(positions).map(triangles).collect()
}

/// Hits of every pixel (row-major) beyond `near`, nearest first, at most `layers`.
pub(super) fn trace(scene: &HybridScene, camera: &Camera, positions: &[Vec<DVec3>]) -> Vec<Vec<Hit>> {
    let bvh = MeshBvh::of(&scene.meshes);
    let triangles = camera_triangles(scene, camera, positions);
    let pixels = camera.intrinsics().pixels();
    (0..pixels).into_par_iter().map(|pixel| trace_pixel(scene, camera, &bvh, &triangles, pixel)).collect()
}

fn trace_pixel(
    scene: &HybridScene,
    camera: &Camera,
    bvh: &MeshBvh,
    triangles: &[Vec<[DVec3; 3]>],
    pixel: usize,
) -> Vec<Hit> {
    let r = camera.ray(pixel_center(camera, pixel));
    let towards = camera.rotation().transpose() * r;
    let mut found = Vec::new();
    // The BVH only proposes triangles, with some tolerance at edges.
    for candidate in bvh.all_hits(camera.center(), towards) {
        let (mesh, triangle) = (candidate.mesh as usize, candidate.triangle as usize);
        if let Some(x) = intersect(triangles[mesh][triangle], r)
            && x.inside
            && x.depth > f64::from(scene.composition.near)
        {
            found.push((x, mesh, triangle));
        }
    }
    // At equal depth the first in order of triangles is in front.
    found.sort_by(|(a, mesh, triangle), (b, other_mesh, other)| {
        a.depth.total_cmp(&b.depth).then((mesh, triangle).cmp(&(other_mesh, other)))
    });
    found.truncate(scene.composition.layers as usize);
    let basis = sh::basis(towards.normalize().to_array());
    let hit = |(x, mesh, triangle): (Intersection, usize, usize)| {
        let source = &scene.meshes[mesh];
        let uvs = source.corner_uvs()[triangle].map(Vec2::as_dvec2);
        let (uv, duv) = x.footprint(camera, &uvs);
        Hit {
            mesh,
            triangle,
            depth: x.depth,
            corners: triangles[mesh][triangle],
            uvs,
            ray: r,
            basis,
            base: trilinear_taps(source.atlas().base(), uv, duv),
            bands: source.atlas().bands().map_or_else(Vec::new, |t| trilinear_taps(t, uv, duv)),
            band_channels: source.atlas().bands().map_or(0, |t| t.channels() as usize),
            intersection: x,
        }
    };
    found.into_iter().map(hit).collect()
}

/// Texels in the footprint of a pixel whose UV is `uv` and changes by `duv` per pixel in x and in y.
fn trilinear_taps(texture: &Texture, uv: DVec2, duv: [DVec2; 2]) -> Vec<Tap> {
    taps_at_level(texture, uv, mip_level(texture, duv))
}

/// The mip level of a pixel in which UV changes by `duv` per pixel in x and in y; what is between two of them is mixed.
fn mip_level(texture: &Texture, duv: [DVec2; 2]) -> f64 {
    let size = DVec2::new(f64::from(texture.width()), f64::from(texture.height()));
    // The longer axis of the pixel's footprint in texels: the larger singular value of the Jacobian.
    let [dx, dy] = duv.map(|d| d * size);
    let (a, b, c) = (dx.dot(dx), dy.dot(dy), dx.dot(dy));
    let axis_squared = 0.5 * (a + b) + (0.25 * (a - b) * (a - b) + c * c).sqrt();
    (0.5 * axis_squared.log2()).clamp(0.0, f64::from(texture.mip_levels() - 1))
}

/// The texels around `uv` of the two mip levels next to `level`.
fn taps_at_level(texture: &Texture, uv: DVec2, level: f64) -> Vec<Tap> {
    let coarsest = f64::from(texture.mip_levels() - 1);
    let fine = level.floor();
    let coarse = (fine + 1.0).min(coarsest);
    let blend = level - fine;
    let mut taps = bilinear_taps(texture, fine as usize, uv, 1.0 - blend);
    taps.extend(bilinear_taps(texture, coarse as usize, uv, blend));
    taps.retain(|tap| tap.weight > 0.0 || tap.slope != DVec2::ZERO);
    taps
}

/// The four texels of a mip level around `uv`, clamped at the borders; the weights sum to `weight`.
fn bilinear_taps(texture: &Texture, level: usize, uv: DVec2, weight: f64) -> Vec<Tap> {
    let (width, height) = (texture.width() >> level, texture.height() >> level);
    let position = uv * DVec2::new(f64::from(width), f64::from(height)) - 0.5;
    let corner = position.floor();
    let f = position - corner;
    let clamp = |x: f64, n: u32| x.clamp(0.0, f64::from(n - 1)) as usize;
    let tap = |dx: f64, dy: f64| {
        let along = DVec2::new(if dx > 0.0 { f.x } else { 1.0 - f.x }, if dy > 0.0 { f.y } else { 1.0 - f.y });
        let rise = DVec2::new((2.0 * dx - 1.0) * f64::from(width), (2.0 * dy - 1.0) * f64::from(height));
        Tap {
            level,
            texel: clamp(corner.y + dy, height) * width as usize + clamp(corner.x + dx, width),
            weight: weight * along.x * along.y,
            slope: weight * rise * DVec2::new(along.y, along.x),
        }
    };
    vec![tap(0.0, 0.0), tap(1.0, 0.0), tap(0.0, 1.0), tap(1.0, 1.0)]
}

/// The mip levels of a texture with these level-0 texels: each the 2×2 means of the one before.
pub(super) fn pyramid(texture: &Texture, texels: &[f64]) -> Vec<Vec<f64>> {
    let channels = texture.channels() as usize;
    let mut levels = vec![texels.to_vec()];
    for level in 1..texture.mip_levels() as usize {
        let (width, height) = ((texture.width() >> level) as usize, (texture.height() >> level) as usize);
        let fine = &levels[level - 1];
        let mean = |index: usize| {
            let (texel, channel) = (index / channels, index % channels);
            let corner = 2 * (texel / width) * 2 * width + 2 * (texel % width);
            let children = [corner, corner + 1, corner + 2 * width, corner + 2 * width + 1];
            children.iter().map(|child| 0.25 * fine[child * channels + channel]).sum()
        };
        let coarse = (0..width * height * channels).map(mean).collect();
        levels.push(coarse);
    }
    levels
}

/// The transpose of [`pyramid`]: gradients of all levels pulled down to level 0.
pub(super) fn pull_down(texture: &Texture, mut levels: Vec<Vec<f64>>) -> Vec<f64> {
    let channels = texture.channels() as usize;
    while levels.len() > 1 {
        let coarse = levels.pop().unwrap_or_default();
        let level = levels.len() - 1;
        let width = (texture.width() >> level) as usize;
        if let Some(fine) = levels.last_mut() {
            for (index, gradient) in fine.iter_mut().enumerate() {
                let (texel, channel) = (index / channels, index % channels);
                let parent = (texel / width / 2) * (width / 2) + texel % width / 2;
                *gradient += 0.25 * coarse[parent * channels + channel];
            }
        }
    }
    levels.pop().unwrap_or_default()
}

/// The mip pyramids of a mesh's textures.
pub(super) struct Maps {
    pub(super) base: Vec<Vec<f64>>,
    /// Empty without bands.
    pub(super) bands: Vec<Vec<f64>>,
}

/// The mip pyramids of every mesh.
pub(super) fn maps(scene: &HybridScene, parameters: &Parameters) -> Vec<Maps> {
    let of_mesh = |(i, mesh): (usize, &Mesh)| {
        let (base, bands) = (mesh.atlas().base(), mesh.atlas().bands());
        Maps {
            base: pyramid(base, &parameters.base[i]),
            bands: bands.map_or_else(Vec::new, |t| pyramid(t, &parameters.bands[i])),
        }
    };
    scene.meshes.iter().enumerate().map(of_mesh).collect()
}

/// Colour and alpha of a hit.
pub(super) fn shade(hit: &Hit, maps: &Maps) -> Fragment {
    let sample = |levels: &[Vec<f64>], taps: &[Tap], channels: usize, channel: usize| -> f64 {
        taps.iter().map(|tap| tap.weight * levels[tap.level][tap.texel * channels + channel]).sum()
    };
    let color = [0, 1, 2].map(|channel| {
        let mut sum = 0.5 + hit.basis[0] * sample(&maps.base, &hit.base, 4, channel);
        for band in 0..hit.band_channels / 3 {
            let coefficient = sample(&maps.bands, &hit.bands, hit.band_channels, 3 * band + channel);
            sum += hit.basis[band + 1] * coefficient;
        }
        sum.max(0.0)
    });
    let alpha = contract::mesh_alpha(sample(&maps.base, &hit.base, 4, 3));
    Fragment { depth: hit.depth, color, alpha }
}
