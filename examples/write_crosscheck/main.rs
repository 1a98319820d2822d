//! Writes the scenes of `make crosscheck`: `cargo run --release --example write_crosscheck -- FOLDER`
//!
//! Each scene tests one feature that renderers treat differently. Cameras are chosen so that no edge of a surface
//! passes through the centre of a pixel, and that no texel is smaller than a pixel, where filters differ.

mod head;

use std::error::Error;
use std::path::Path;

use centaur::format::{self, WriteOptions};
use centaur::scene::{
    Atlas, Camera, ColorSpace, Composition, HybridScene, Intrinsics, Mesh, OrderMode, PixelFilter, Splats, Texture, sh,
};
use glam::{DMat3, DVec3, Quat, Vec2, Vec3};
use rand::{RngExt as _, SeedableRng as _};
use rand_pcg::Pcg64Mcg;

type Result<T> = std::result::Result<T, Box<dyn Error>>;

type Case = (&'static str, Cloud, Vec<Mesh>, Composition, Vec<View>);

fn main() -> Result<()> {
    let folder = std::env::args().nth(1).ok_or("usage: write_crosscheck FOLDER")?;
    let none = || Cloud { count: 0, ..Cloud::default() };
    let quads = || -> Result<Vec<Mesh>> {
        Ok(vec![
            quad([0.0, 0.0, 0.15], [0.8, 0.03, 0.25], [0.02, 0.7, 0.0], 32, 3, Opacity::Soft)?,
            quad([0.1, 0.1, -0.45], [0.9, 0.01, -0.3], [0.05, 0.8, 0.15], 24, 1, Opacity::Soft)?,
        ])
    };
    let scenes: Vec<Case> = vec![
        // Two intersecting quads with maps of degree 3 and 1; both are blended everywhere.
        ("quads", none(), quads()?, layers(4), vec![View::default()]),
        // Triangles of one texel each, which have no footprint in the maps, in a scene of large units.
        ("palette", none(), vec![palette()?], layers(1), vec![View { distance: 4e3, ..View::default() }]),
        // Only the nearest quad is blended.
        ("nearest", Cloud { count: 50, ..Cloud::default() }, quads()?, layers(1), vec![View::default()]),
        (
            "hybrid50",
            Cloud { count: 50, ..Cloud::default() },
            quads()?,
            layers(4),
            vec![View::default(), View::skewed()],
        ),
        ("linear", Cloud { count: 50, ..Cloud::default() }, quads()?, linear(), vec![View::default()]),
        // Splats across a floor that is seen at a grazing angle of 8 degrees.
        (
            "grazing",
            Cloud { count: 50, flat: 0.06, spread: [0.9, 0.03, 0.9], ..Cloud::default() },
            vec![quad([0.0; 3], [1.13, 0.0, 0.07], [0.05, 0.0, 1.21], 6, 2, Opacity::Soft)?],
            layers(1),
            vec![View { elevation: 8.0, ..View::default() }],
        ),
        // Splats and texels with opacities of nearly 0 and of 1.
        (
            "opacity",
            Cloud { count: 60, logits: Some([-12.0, -5.6, 12.0, 30.0]), ..Cloud::default() },
            vec![quad([0.0, 0.0, 0.15], [0.8, 0.03, 0.25], [0.02, 0.7, 0.0], 16, 0, Opacity::Hard)?],
            layers(2),
            vec![View::default()],
        ),
        // Splats with aspect ratios up to 1 : 100.
        (
            "needles",
            Cloud { count: 80, sizes: [0.004, 0.4], ..Cloud::default() },
            quads()?,
            layers(4),
            vec![View::default()],
        ),
        ("wide", Cloud { count: 80, spread: [1.6; 3], ..Cloud::default() }, quads()?, layers(2), vec![View::wide()]),
        // Splats alone, with the principal point off centre: Mitsuba can render this without our plug-ins too.
        ("splats80", Cloud { count: 80, ..Cloud::default() }, vec![], layers(1), vec![View::wide()]),
        // The camera is inside some of the splats.
        (
            "inside",
            Cloud { count: 60, sizes: [0.3, 0.9], spread: [1.5; 3], strongest: 0.4, ..Cloud::default() },
            quads()?,
            layers(2),
            vec![View { distance: 1.1, ..View::wide() }],
        ),
        // Coincident pairs, as density control creates them.
        ("twins", Cloud { alike: 2, ..Cloud::default() }, quads()?, layers(2), vec![View::default()]),
        // Splats at one depth, which are ordered by their index in the file; a quarter of them are flat.
        (
            "wall",
            Cloud { count: 80, spread: [0.8, 0.8, 0.0], thickness: Some(1e-5), ..Cloud::default() },
            vec![quad([0.0, 0.0, 0.6], [0.8, 0.03, 0.25], [0.02, 0.7, 0.0], 32, 1, Opacity::Soft)?],
            layers(1),
            vec![View::straight()],
        ),
        // Most rays are inside all splats at once, with ten coincident splats at each of ten places.
        (
            "crowded",
            Cloud {
                count: 100,
                sizes: [0.4, 0.7],
                spread: [0.1; 3],
                logits: Some([-4.6, -4.0, -3.4, -2.8]),
                alike: 10,
                ..Cloud::default()
            },
            quads()?,
            layers(4),
            vec![View::small()],
        ),
        // Thin splats close to one place: rays leave one before they enter the next.
        (
            "thin",
            Cloud { count: 6, flat: 1e-3, sizes: [0.2, 0.5], spread: [1e-4; 3], ..Cloud::default() },
            quads()?,
            layers(4),
            vec![View { elevation: 50.0, ..View::small() }],
        ),
        // Splats smaller than pixels, whose integral the pixel filter preserves.
        (
            "filtered",
            Cloud { count: 300, sizes: [0.002, 0.04], ..Cloud::default() },
            quads()?,
            Composition { pixel_filter: PixelFilter::MIP, ..layers(4) },
            vec![View::default()],
        ),
        (
            "hybrid10k",
            Cloud { count: 10_000, sizes: [0.01, 0.05], ..Cloud::default() },
            quads()?,
            layers(4),
            vec![View::default()],
        ),
        (
            "splats10k",
            Cloud { count: 10_000, sizes: [0.01, 0.05], ..Cloud::default() },
            vec![],
            layers(1),
            vec![View::default()],
        ),
    ];
    for (name, cloud, meshes, composition, views) in scenes {
        let cameras = views.iter().enumerate().map(|(i, view)| Ok((format!("view{i}"), view.camera()?)));
        let cameras = cameras.collect::<Result<Vec<_>>>()?;
        let scene = HybridScene { splats: cloud.splats()?, meshes, composition };
        let path = Path::new(&folder).join(format!("{name}.glb"));
        format::write_scene(&path, &scene, &WriteOptions { cameras: &cameras, ..WriteOptions::default() })?;
    }
    head::write(Path::new(&folder))
}

/// Composition ordered by the depths at each pixel, as in other programs.
fn layers(layers: u32) -> Composition {
    Composition { mode: OrderMode::Direct, layers, ..Composition::default() }
}

fn linear() -> Composition {
    Composition { color_space: ColorSpace::LinearDisplay, background: [0.1, 0.2, 0.4], ..layers(4) }
}

/// A camera that looks at the origin.
struct View {
    distance: f64,
    /// Elevation above the ground, in degrees.
    elevation: f64,
    /// Angle around the vertical axis, in radians.
    azimuth: f64,
    intrinsics: Intrinsics,
}

impl Default for View {
    fn default() -> Self {
        // 40 degrees, with the principal point slightly off centre.
        let intrinsics = Intrinsics { width: 256, height: 256, fx: 351.7, fy: 351.7, cx: 128.13, cy: 127.91 };
        Self { distance: 4.0, elevation: 5.7, azimuth: 0.13, intrinsics }
    }
}

impl View {
    /// A principal point far from the centre, and non-square pixels.
    fn skewed() -> Self {
        let intrinsics = Intrinsics { width: 240, height: 200, fx: 330.3, fy: 287.1, cx: 71.3, cy: 139.9 };
        Self { elevation: 21.0, intrinsics, ..Self::default() }
    }

    /// A field of view of 110 degrees.
    fn wide() -> Self {
        let intrinsics = Intrinsics { width: 256, height: 192, fx: 89.7, fy: 89.7, cx: 117.3, cy: 101.2 };
        Self { distance: 1.6, elevation: 13.0, intrinsics, ..Self::default() }
    }

    /// A camera that looks along z, so that splats with equal z have exactly equal depths.
    fn straight() -> Self {
        let intrinsics = Intrinsics { width: 128, height: 128, fx: 175.9, fy: 175.9, cx: 64.13, cy: 63.91 };
        Self { elevation: 0.0, azimuth: 0.0, intrinsics, ..Self::default() }
    }

    /// A field of view of 30 degrees, with few pixels.
    fn small() -> Self {
        let intrinsics = Intrinsics { width: 64, height: 64, fx: 119.3, fy: 119.3, cx: 32.13, cy: 31.91 };
        Self { intrinsics, ..Self::default() }
    }

    fn camera(&self) -> Result<Camera> {
        let (sin, cos) = self.elevation.to_radians().sin_cos();
        let azimuth = DMat3::from_rotation_y(self.azimuth);
        // The world is y down.
        let forward = azimuth * DVec3::new(0.0, sin, cos);
        let right = DVec3::Y.cross(forward).normalize();
        let rotation = DMat3::from_cols(right, forward.cross(right), forward).transpose();
        Ok(Camera::new(self.intrinsics, rotation, DVec3::new(0.0, 0.0, self.distance))?)
    }
}

/// Random splats of SH degree 3.
struct Cloud {
    count: usize,
    /// Half the width of the box of means, along each axis.
    spread: [f32; 3],
    /// Bounds of the log-uniform standard deviations along each axis of a splat.
    sizes: [f32; 2],
    /// Factor on the standard deviation along y.
    flat: f32,
    /// Opacity logits, used in turn; if `None`, opacities are uniform from 0.15 to `strongest`.
    logits: Option<[f32; 4]>,
    strongest: f32,
    /// Standard deviation of every fourth splat along its local z.
    thickness: Option<f32>,
    /// Number of consecutive splats that share the position and shape of the first.
    alike: usize,
}

impl Default for Cloud {
    fn default() -> Self {
        Self {
            count: 50,
            spread: [0.8; 3],
            sizes: [0.04, 0.25],
            flat: 1.0,
            logits: None,
            strongest: 0.98,
            thickness: None,
            alike: 1,
        }
    }
}

impl Cloud {
    fn splats(&self) -> Result<Splats> {
        let (mut rng, n) = (Pcg64Mcg::seed_from_u64(7), self.count);
        let mut r = |low: f32, high: f32| if low < high { rng.random_range(low..high) } else { low };
        let [x, y, z] = self.spread;
        let mut means: Vec<Vec3> = (0..n).map(|_| Vec3::new(r(-x, x), r(-y, y), r(-z, z))).collect();
        let turn = if self.flat < 1.0 { 0.15 } else { 1.0 };
        let mut rotations: Vec<Quat> =
            (0..n).map(|_| Quat::from_xyzw(turn * r(-1., 1.), r(-1., 1.), turn * r(-1., 1.), r(0.1, 1.))).collect();
        let [small, large] = self.sizes.map(f32::ln);
        let flat = Vec3::new(0.0, self.flat.ln(), 0.0);
        let mut log_scales: Vec<Vec3> =
            (0..n).map(|_| Vec3::new(r(small, large), r(small, large), r(small, large)) + flat).collect();
        if let Some(thickness) = self.thickness {
            log_scales.iter_mut().step_by(4).for_each(|scale| scale.z = thickness.ln());
        }
        for i in 0..n {
            let first = i - i % self.alike;
            means[i] = means[first];
            rotations[i] = rotations[first];
            log_scales[i] = log_scales[first];
        }
        let logit = |opacity: f32| (opacity / (1.0 - opacity)).ln();
        let logits = (0..n).map(|i| self.logits.map_or_else(|| logit(r(0.15, self.strongest)), |logits| logits[i % 4]));
        let logits = logits.collect();
        let mut color = |low: f32, high: f32| [r(low, high), r(low, high), r(low, high)];
        let sh = (0..16 * n).map(|i| if i % 16 == 0 { sh::dc_from_rgb(color(0.05, 0.95)) } else { color(-0.4, 0.4) });
        let sh = sh.collect();
        Ok(Splats::new(means, rotations, log_scales, logits, 3, sh)?)
    }
}

#[derive(Clone, Copy)]
enum Opacity {
    /// Intermediate values, with a hole.
    Soft,
    /// A chequerboard of 0 and 1.
    Hard,
}

/// A quad of two triangles around `center` with half sides `u` and `v`, whose diagonal is a seam of its maps.
fn quad(center: [f32; 3], u: [f32; 3], v: [f32; 3], size: u32, degree: u32, opacity: Opacity) -> Result<Mesh> {
    let [center, u, v] = [center, u, v].map(Vec3::from);
    let positions = vec![center - u - v, center + u - v, center + u + v, center - u + v];
    let uvs = vec![
        [Vec2::new(0.02, 0.0), Vec2::new(0.97, 0.0), Vec2::new(0.97, 0.95)],
        [Vec2::new(0.02, 0.04), Vec2::new(0.98, 1.0), Vec2::new(0.03, 1.0)],
    ];
    let texel = |i: u32| {
        let (x, y) = ((i % size) as f32 / size as f32, (i / size) as f32 / size as f32);
        let is_light = ((8.0 * x) as u32 + (8.0 * y) as u32).is_multiple_of(2);
        let [r, g, b] = sh::dc_from_rgb([0.15 + 0.8 * x, if is_light { 0.8 } else { 0.2 }, 0.9 - 0.7 * y]);
        let radius = (x - 0.5).hypot(y - 0.5);
        let logit = match opacity {
            Opacity::Soft => 4.0 - 9.0 * radius - if radius < 0.12 { 5.0 } else { 0.0 },
            Opacity::Hard => {
                if is_light {
                    20.0
                } else {
                    -20.0
                }
            }
        };
        [r, g, b, logit]
    };
    let base = Texture::new(size, size, 4, (0..size * size).flat_map(texel).collect())?;
    let channels = sh::band_floats(degree) as u32;
    let mut rng = Pcg64Mcg::seed_from_u64(u64::from(size));
    let bands = (degree > 0)
        .then(|| Texture::new(8, 4, channels, (0..32 * channels).map(|_| rng.random_range(-0.3..0.3)).collect()));
    Ok(Mesh::new(positions, vec![[0, 1, 2], [0, 2, 3]], uvs, Atlas::new(base, bands.transpose()?)?)?)
}

/// A quad a thousand times as large as others; all corners of a triangle have the coordinates of one texel, as in models
/// that are coloured by a palette.
fn palette() -> Result<Mesh> {
    let quad = quad([0.0, 0.0, 150.0], [800.0, 30.0, 250.0], [20.0, 700.0, 0.0], 16, 1, Opacity::Soft)?;
    let uvs = [Vec2::new(3.5, 5.5), Vec2::new(12.5, 9.5)].map(|texel| [texel / 16.0; 3]);
    Ok(Mesh::new(quad.positions().to_vec(), quad.triangles().to_vec(), uvs.to_vec(), quad.atlas().clone())?)
}
