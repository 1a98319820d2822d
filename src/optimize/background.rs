//! Initial splats behind all points: structure from motion finds no points in the sky, nor on what is too far away or
//! too smooth.
//!
//! Without these splats the sky stays black for hundreds of iterations, until others have wandered there, and near
//! geometry is bent to cover it.

use std::{f64::consts::TAU, sync::Arc};

use glam::{DVec2, DVec3, Vec3};
use rayon::prelude::*;

use super::{
    TrainError,
    cells::{Cells, evenly, is_needless, stride},
    initialize::round_splats,
};
use crate::{
    capture::{Capture, CaptureError, Photo, Point, View, extent},
    scene::{Camera, LARGEST_COORDINATE, Splats, center_and_spread},
};

/// Number of directions tested over the whole sphere, some 3° apart.
const DIRECTIONS: usize = 4000;
/// Least share of the views looking in a direction that must find it clear of points: from the others a tree may stand
/// before the sky.
const CLEAR_VIEWS: f64 = 0.6;
/// Largest mean colour deviation among unobstructed views of a direction for it to count as sky. More means nearby
/// structure: walls without points change with the viewpoint, the sky does not.
const SPREAD: f32 = 0.1;
/// Distance of the splats, in extents of the cameras, unless points lie farther: at this distance there is hardly any
/// parallax between the cameras.
const DISTANCE: f64 = 30.0;

/// Creates splats in the directions in which most of the views that look there see past all points, with the colours
/// seen there; at most `max_splats`, evenly distributed. Splats are round, about as wide as their spacing, with opacity
/// ½. None are made where the points do not tell the size of the scene, nor where the colour equals the `background`
/// (RGB; `None` if it changes with every iteration), which is rendered there anyway.
///
/// `photo` decodes a view's picture.
///
/// # Errors
/// If a photograph cannot be read or `sh_degree` exceeds 3.
pub(super) fn behind_points(
    capture: &Capture,
    views: &[usize],
    sh_degree: u32,
    max_splats: usize,
    background: Option<[f32; 3]>,
    photo: impl Fn(&View) -> Result<Arc<Photo>, CaptureError> + Sync,
) -> Result<Splats, TrainError> {
    let views: Vec<&View> = views.iter().map(|&i| &capture.views[i]).collect();
    let Some((center, radius)) = sphere(&views, &capture.points).filter(|_| max_splats > 0) else {
        return Ok(Splats::empty(sh_degree));
    };
    let maps: Vec<Clear> = views.par_iter().map(|view| Clear::new(&view.camera, &capture.points)).collect();
    let clear: Vec<DVec3> = directions()
        .filter(|&d| {
            let seen: Vec<bool> = maps.iter().filter_map(|map| map.is_clear(d)).collect();
            let clear = seen.iter().filter(|clear| **clear).count();
            clear > 0 && clear as f64 >= CLEAR_VIEWS * seen.len() as f64
        })
        .collect();
    let step = if clear.is_empty() { usize::MAX } else { stride(views.len()) };
    let some: Vec<_> = views.iter().zip(&maps).step_by(step).collect();
    // Only the colours of each picture are kept.
    let shown: Vec<Vec<Option<Vec3>>> = (some.into_par_iter())
        .map(|(view, map)| photo(view).map(|photo| clear.iter().map(|d| map.color(*d, &photo)).collect()))
        .collect::<Result<_, CaptureError>>()?;
    let agreed = |i: usize| {
        let colors: Vec<Vec3> = shown.iter().filter_map(|colors| colors[i]).collect();
        let mean = colors.iter().sum::<Vec3>() / colors.len() as f32;
        let spread = colors.iter().map(|c| c.distance(mean)).sum::<f32>() / colors.len() as f32;
        let is_agreed = !colors.is_empty() && spread <= SPREAD;
        Some(mean.to_array()).filter(|mean| is_agreed && !is_needless(*mean, background))
    };
    let found: Vec<(DVec3, [f32; 3])> = (0..clear.len()).filter_map(|i| Some((clear[i], agreed(i)?))).collect();
    let kept = evenly(&found, max_splats);
    let apart = radius * (2.0 * TAU / DIRECTIONS as f64 * found.len() as f64 / kept.len().max(1) as f64).sqrt();
    let means = kept.iter().map(|(d, _)| (center + radius * *d).as_vec3()).collect();
    let colors: Vec<[f32; 3]> = kept.iter().map(|(_, color)| *color).collect();
    Ok(round_splats(means, &vec![(apart / 2.0) as f32; kept.len()], &colors, 0.5, sh_degree)?)
}

/// Centre and radius of the sphere that the splats lie on: around the cameras, and beyond all points but the outermost
/// hundredth, which may be mismatched.
fn sphere(views: &[&View], points: &[Point]) -> Option<(DVec3, f64)> {
    let cameras = || views.iter().map(|v| &v.camera);
    let (center, _) = center_and_spread(cameras());
    let mut distances: Vec<f64> = points.iter().map(|p| p.position.distance(center)).collect();
    distances.retain(|d| d.is_finite());
    // Unlike a quantile it leaves out one at least.
    let most = distances.len().checked_sub(1 + distances.len().div_ceil(100))?;
    let reach = *distances.select_nth_unstable_by(most, f64::total_cmp).1;
    let radius = (DISTANCE * extent(cameras())).max(1.5 * reach);
    (radius > 0.0 && radius < LARGEST_COORDINATE).then_some((center, radius))
}

/// Unit vectors spread evenly over the sphere (Fibonacci's spiral).
fn directions() -> impl Iterator<Item = DVec3> {
    let turn = TAU * (1.0 - 2.0 / (1.0 + 5.0_f64.sqrt()));
    (0..DIRECTIONS).map(move |i| {
        let z = 1.0 - (2 * i + 1) as f64 / DIRECTIONS as f64;
        let (sin, cos) = (turn * i as f64).sin_cos();
        let r = (1.0 - z * z).sqrt();
        DVec3::new(r * cos, r * sin, z)
    })
}

/// Cells of a view's picture onto which points project, hidden or not. A direction is clear if its cell and the eight
/// around it hold no point.
struct Clear {
    cells: Cells,
    taken: Vec<bool>,
}

impl Clear {
    fn new(camera: &Camera, points: &[Point]) -> Self {
        let cells = Cells::new(camera);
        let mut taken = vec![false; cells.len()];
        points.iter().filter_map(|p| cells.of(camera.to_camera(p.position))).for_each(|cell| taken[cell] = true);
        Self { cells, taken }
    }

    /// Pixel position at which the view sees a direction, if it does.
    fn pixel_of(&self, direction: DVec3) -> Option<DVec2> {
        let camera = &self.cells.camera;
        camera.in_picture(camera.rotation() * direction)
    }

    /// Colour, 0 to 1, of a clear direction in the view's picture; `None` unless that pixel's alpha is 255.
    fn color(&self, direction: DVec3, photo: &Photo) -> Option<Vec3> {
        let uv = self.pixel_of(direction).filter(|_| self.is_clear(direction) == Some(true))?;
        let rgb = photo.whole(photo.index_at(uv))?;
        Some(Vec3::from(rgb.map(f32::from)) / 255.0)
    }

    /// Whether no point projects near a direction; `None` if the view does not look there.
    fn is_clear(&self, direction: DVec3) -> Option<bool> {
        let at = self.cells.at(self.pixel_of(direction)?);
        Some(!self.cells.around(at).any(|cell| self.taken[cell]))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        capture::{LoadOptions, open},
        scene::testing::ahead,
    };

    #[test]
    fn directions_are_spread_evenly() {
        let all: Vec<DVec3> = directions().collect();
        assert!(all.iter().all(|d| (d.length() - 1.0).abs() < 1e-12));
        assert!(all.iter().sum::<DVec3>().length() < 1.0);
        // Each octant contains an eighth of the directions.
        let octant = all.iter().filter(|d| d.cmpgt(DVec3::ZERO).all()).count();
        assert!(octant.abs_diff(DIRECTIONS / 8) < 20, "{octant}");
    }

    #[test]
    fn cells_with_points_and_those_around_are_not_clear() {
        let camera = ahead([100, 50], 100.0, DVec3::ZERO);
        // A point that projects to pixel (50, 25) at any depth, and one behind the camera.
        let point = |z: f64| Point { position: DVec3::new(0.0, 0.0, z), rgb: [0; 3] };
        let map = Clear::new(&camera, &[point(1000.0), point(-1.0)]);
        let at = |x: f64, y: f64| map.is_clear(DVec3::new((x - 50.0) / 100.0, (y - 25.0) / 100.0, 1.0).normalize());
        assert_eq!([at(50.0, 25.0), at(52.9, 25.0), at(47.5, 22.5)], [Some(false); 3]);
        assert_eq!([at(58.0, 25.0), at(0.5, 0.5), at(99.5, 49.5)], [Some(true); 3]);
        assert_eq!([at(-1.0, 25.0), at(50.0, 51.0), map.is_clear(-DVec3::Z)], [None; 3]);
        assert_eq!(map.is_clear(DVec3::X), None);
    }

    /// The demo's table fills the pictures, so the cameras are tilted up to see the background.
    #[test]
    fn splats_are_where_views_agree_on_seeing_no_point() {
        let folder = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("demo");
        let mut capture = open(&folder, &LoadOptions::default()).unwrap();
        let views: Vec<usize> = (0..capture.views.len()).collect();
        let in_front_of = |background, capture: &Capture, shade: &(dyn Fn(&View) -> u8 + Sync)| {
            let photo = |view: &View| {
                let k = view.camera.intrinsics();
                let rgba = [shade(view), 100, 200, 255].repeat(k.pixels());
                let (width, height) = (k.width, k.height);
                Ok(Photo { width, height, rgba, has_alpha: false, masked: false }.into())
            };
            behind_points(capture, &views, 1, 1000, background, photo).unwrap()
        };
        let of = |capture: &Capture, shade: &(dyn Fn(&View) -> u8 + Sync)| in_front_of(None, capture, shade);
        let many = of(&capture, &|_| 50);
        assert!(!many.is_empty());
        capture.points.truncate(3);
        let all = of(&capture, &|_| 50);
        assert!(many.len() < all.len(), "{} of {}", many.len(), all.len());
        // All splats are beyond the points, in all directions, and as many as allowed.
        let reach = capture.points.iter().map(|p| p.position.length()).fold(0.0, f64::max) as f32;
        assert!(all.means().iter().all(|m| m.length() > reach));
        assert_eq!(all.len(), 1000);
        let [low, high] = [-1.0, 1.0].map(|sign| all.means().iter().filter(|m| sign * m.z > 0.0).count());
        assert!(low > 100 && high > 100, "{low} {high}");
        let color = all.sh()[0].map(|c| 0.5 + 0.282_094_8 * c);
        assert!((color[0] - 50.0 / 255.0).abs() < 1e-5 && (color[2] - 200.0 / 255.0).abs() < 1e-5, "{color:?}");
        // Pixels in the background colour need no splats.
        let [same, other] = [51.0, 53.0].map(|red: f32| Some([red / 255.0, 100.0 / 255.0, 200.0 / 255.0]));
        assert!(in_front_of(same, &capture, &|_| 50).is_empty());
        assert_eq!(in_front_of(other, &capture, &|_| 50), all);
        // Views that disagree see something near; a single view always agrees with itself.
        let differing = of(&capture, &|view| view.name.bytes().fold(0_u8, |a, b| a.wrapping_mul(31).wrapping_add(b)));
        assert!(differing.len() < all.len() / 2, "{} of {}", differing.len(), all.len());
        capture.points.clear();
        assert!(of(&capture, &|_| 50).is_empty());
    }
}
