//! Initial colours of the shell behind everything, from the photographs. The shell is so far away that photographs
//! agree wherever it is right; and as each texel is seen by few views, grey maps would need longer than a warm-up.

use glam::{DVec3, Vec2};
use rayon::prelude::*;

use super::{setup::Setup, views::Views};
use crate::{
    capture::Photo,
    geometry::{MeshBvh, Shell, Viewers},
    optimize::TrainError,
    scene::{Atlas, Camera, Mesh, Texture, sh},
};

/// Opacity logit of painted texels: 0.95, from which training can go either way.
const OPACITY: f32 = 3.0;
/// Border around a triangle that is painted too, texels, for those that are blended in at its edge.
const MARGIN: f32 = 1.0;

/// A triangle of the shell.
struct Face {
    corners: [DVec3; 3],
    spots: Vec<Spot>,
}

/// A texel of a face of the shell.
struct Spot {
    index: usize,
    is_inside: bool,
    position: DVec3,
    sum: [f32; 3],
    views: f32,
}

/// Paints the triangles of the shell with the mean colour of the views that warm up the maps, with exposures undone. A
/// view counts for a triangle only if it sees all its corners past the rest of the mesh.
pub(super) fn painted(setup: &Setup, views: &Views, mesh: Mesh) -> Result<Mesh, TrainError> {
    let is_far = |t: &[u32; 3]| setup.is_of_shell(&mesh, t);
    let rest: Vec<[u32; 3]> = mesh.triangles().iter().filter(|t| !is_far(t)).copied().collect();
    let bvh = MeshBvh::new([(mesh.positions(), rest.as_slice())]);
    let base = mesh.atlas().base();
    let mut faces: Vec<Face> = (mesh.triangles().iter().zip(mesh.corner_uvs()))
        .filter(|(t, _)| is_far(t))
        .map(|(t, uvs)| Face::new(t.map(|v| mesh.positions()[v as usize].as_dvec3()), *uvs, base.width()))
        .collect();
    let exposures = views.exposures.as_ref();
    // All cameras, by the capture's numbers.
    let viewers = Viewers { layers: 1, ..setup.viewers(&views.cameras) };
    for i in setup.warming_views() {
        let photo = views.photos.whole_of(i)?;
        let camera = &views.cameras[i];
        let color = |rgb| exposures.map_or(rgb, |exposures| exposures.undo(i, rgb));
        let is_seen = |face: &&mut Face| face.corners.iter().all(|p| Shell::is_seen(&viewers, i, *p, &bvh));
        faces.par_iter_mut().filter(is_seen).for_each(|face| face.add(camera, &photo, color));
    }
    let mut texels = base.texels().to_vec();
    for inside in [false, true] {
        for spot in faces.iter().flat_map(|face| &face.spots).filter(|s| s.is_inside == inside && s.views > 0.0) {
            let dc = sh::dc_from_rgb(spot.sum.map(|sum| sum / spot.views));
            texels[4 * spot.index..4 * spot.index + 4].copy_from_slice(&[dc[0], dc[1], dc[2], OPACITY]);
        }
    }
    let base = Texture::new(base.width(), base.height(), 4, texels)?;
    let atlas = Atlas::new(base, mesh.atlas().bands().cloned())?;
    Ok(mesh.with_atlas(atlas))
}

impl Face {
    fn new(corners: [DVec3; 3], uvs: [Vec2; 3], side: u32) -> Self {
        let [a, b, c] = uvs.map(|uv| uv * side as f32 - 0.5);
        let area = (b - a).perp_dot(c - a);
        let mut spots = vec![];
        if area > 0.0 {
            let low = (a.min(b).min(c) - MARGIN).ceil().max(Vec2::ZERO);
            let high = (a.max(b).max(c) + MARGIN).floor().min(Vec2::splat(side as f32 - 1.0));
            let heights = [c.distance(b), a.distance(c), b.distance(a)].map(|length| area / length);
            for y in low.y as u32..=high.y.max(low.y) as u32 {
                for x in low.x as u32..=high.x.max(low.x) as u32 {
                    let p = Vec2::new(x as f32, y as f32);
                    let (wa, wb) = ((c - b).perp_dot(p - b) / area, (a - c).perp_dot(p - c) / area);
                    let w = [wa, wb, 1.0 - wa - wb];
                    // Signed distances from the sides, negative outside.
                    let inside = [0, 1, 2].map(|k| w[k] * heights[k]).into_iter().fold(f32::INFINITY, f32::min);
                    if inside >= -MARGIN && x < side && y < side {
                        let position = (0..3).map(|k| f64::from(w[k]) * corners[k]).sum();
                        let index = (y * side + x) as usize;
                        spots.push(Spot { index, is_inside: inside >= 0.0, position, sum: [0.0; 3], views: 0.0 });
                    }
                }
            }
        }
        Self { corners, spots }
    }

    fn add(&mut self, camera: &Camera, photo: &Photo, color: impl Fn([f32; 3]) -> [f32; 3]) {
        for spot in &mut self.spots {
            let Some(rgb) = photo.sample(camera.project(camera.to_camera(spot.position))) else { continue };
            let rgb = color(rgb);
            spot.sum = [0, 1, 2].map(|k| spot.sum[k] + rgb[k]);
            spot.views += 1.0;
        }
    }
}

#[cfg(test)]
mod tests {
    use std::{fs, path::Path, sync::atomic::AtomicBool};

    use glam::{DMat3, DVec2};

    use super::*;
    use crate::{
        capture::{self, Capture, LoadOptions, Point},
        optimize::{Checkpoints, MeshSource, Session, TrainOptions, train},
        render::{gpu::Gpu, reference},
        scene::{HybridScene, Intrinsics, Splats},
    };

    /// Radius of the ground, which is the only near object.
    const GROUND: f64 = 1.5;

    /// Colour and hit point seen from `origin`: the ground, or the sky, which depends on direction alone.
    fn seen(origin: DVec3, direction: DVec3) -> ([f64; 3], Option<DVec3>) {
        let t = -origin.z / direction.z;
        let hit = origin + t * direction;
        if t > 0.0 && hit.truncate().length() < GROUND {
            return ([0.3 + 0.2 * (4.0 * hit.x).sin(), 0.4 + 0.2 * (5.0 * hit.y).cos(), 0.2], Some(hit));
        }
        let d = direction.normalize();
        ([0.5 + 0.3 * (2.0 * d.y.atan2(d.x)).sin(), 0.5 + 0.3 * (6.0 * d.z).sin(), 0.9], None)
    }

    fn pixels(camera: &Camera) -> impl Iterator<Item = ([f64; 3], Option<DVec3>)> {
        let k = camera.intrinsics();
        let at = move |i: u32| DVec2::new(f64::from(i % k.width) + 0.5, f64::from(i / k.width) + 0.5);
        (0..k.width * k.height).map(move |i| seen(camera.center(), camera.rotation().transpose() * camera.ray(at(i))))
    }

    /// Capture of 96 views around a round ground under a sky, with points on the ground.
    fn under_a_sky(folder: &Path) -> Capture {
        let intrinsics = Intrinsics { width: 64, height: 48, fx: 48.0, fy: 48.0, cx: 32.0, cy: 24.0 };
        let mut frames = vec![];
        for i in 0..96 {
            let (sin, cos) = (f64::from(i) * std::f64::consts::TAU / 96.0).sin_cos();
            let center = DVec3::new(2.5 * cos, 2.5 * sin, 1.0);
            let forward = (DVec3::Z * 0.6 - center).normalize();
            let right = forward.cross(DVec3::Z).normalize();
            let rotation = DMat3::from_cols(right, forward.cross(right), forward).transpose();
            let camera = Camera::new(intrinsics, rotation, -(rotation * center)).unwrap();
            let bytes = pixels(&camera).flat_map(|(rgb, _)| rgb.map(|c| (255.0 * c).round() as u8)).collect();
            let name = format!("{i:02}.png");
            image::RgbImage::from_raw(64, 48, bytes).unwrap().save(folder.join(&name)).unwrap();
            let [x, y, z] = [right, -forward.cross(right), -forward].map(|axis| axis.to_array());
            let row = |k: usize| [x[k], y[k], z[k], center[k]];
            frames.push(serde_json::json!({
                "file_path": name, "transform_matrix": [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]],
            }));
        }
        let transforms = serde_json::json!({
            "w": 64, "h": 48, "fl_x": 48.0, "fl_y": 48.0, "cx": 32.0, "cy": 24.0, "frames": frames,
        });
        fs::write(folder.join("transforms.json"), transforms.to_string()).unwrap();
        let mut capture = capture::open(folder, &LoadOptions::default()).unwrap();
        let corners =
            (-12..=12).flat_map(|x| (-12..=12).map(move |y| DVec3::new(f64::from(x), f64::from(y), 0.0) / 8.0));
        capture.points = (corners.filter(|p| p.length() < GROUND))
            .map(|position| Point { position, rgb: seen(position + DVec3::Z, -DVec3::Z).0.map(|c| (255.0 * c) as u8) })
            .collect();
        for view in &mut capture.views {
            let is_seen = |i: &u32| {
                let p = capture.points[*i as usize].position;
                view.camera.in_picture(view.camera.to_camera(p)).is_some()
            };
            view.sees = (0..capture.points.len() as u32).filter(is_seen).collect();
        }
        capture
    }

    /// Mean absolute error of the sky in held-out views if the mesh alone is rendered.
    fn sky_error(scene: &HybridScene, capture: &Capture) -> f64 {
        let scene = HybridScene { splats: Splats::empty(0), ..scene.clone() };
        let (mut sum, mut count) = (0.0, 0.0);
        for view in capture.views.iter().step_by(8) {
            let shown = reference::render(&scene, &view.camera);
            for (rgb, (truth, hit)) in shown.rgb.iter().zip(pixels(&view.camera)) {
                if hit.is_none() {
                    sum += (0..3).map(|c| (rgb[c] - truth[c]).abs()).sum::<f64>() / 3.0;
                    count += 1.0;
                }
            }
        }
        sum / count
    }

    #[test]
    fn a_sky_becomes_a_shell() {
        let (folder, gpu, stop) = (tempfile::tempdir().unwrap(), Gpu::open(None).unwrap(), AtomicBool::new(false));
        let capture = under_a_sky(folder.path());
        let trained = |shell: bool| {
            let options = TrainOptions {
                iterations: 120,
                warmup: 120,
                surface_iterations: Some(60),
                max_splats: Some(800),
                texture_size: Some(128),
                shell,
                checkpoint_every: 0,
                eval_every: 0,
                ..TrainOptions::default()
            };
            let session = Session { gpu: &gpu, checkpoints: Checkpoints::Off, stop: &stop, progress: &mut |_| {} };
            train(&capture, MeshSource::Points, &options, session).unwrap()
        };
        let (with, without) = (trained(true), trained(false));
        let psnr = |trained: &crate::optimize::Trained| trained.history.last().unwrap().psnr.unwrap();
        let errors = [&with, &without].map(|trained| sky_error(&trained.scene, &capture));
        let found = [&with, &without].map(|t| (t.shell_triangles, psnr(t)));
        eprintln!("shell triangles and PSNR {found:?}, errors of the mesh alone {errors:?}");
        assert!(with.shell_triangles > 50, "{}", with.shell_triangles);
        assert_eq!(without.shell_triangles, 0);
        assert!(errors[0] < 0.2 * errors[1], "{errors:?}");
        // Splats can learn such a sky too.
        assert!(found[0].1 > found[1].1 - 1.0, "{found:?}");
    }
}
