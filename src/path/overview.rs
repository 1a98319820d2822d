//! Views of a scene that has none: from all around what it shows.

use glam::{DMat3, DVec3};

use super::{Around, PathError, Shot, orbit};
use crate::scene::{Camera, HybridScene, Intrinsics, Mesh, Splats, sigmoid};

/// Width and height of the pictures.
const SIZE: [u32; 2] = [1024, 768];
/// Vertical field of view in degrees.
const FOV_Y: f64 = 45.0;
/// How far the views look down, in degrees.
const DOWN: f64 = 15.0;
/// Part of the splats or vertices beyond each side of the box that does not count: what floats far away, as of
/// trainings.
const BEYOND: f64 = 0.05;
/// How much larger than that box what is seen is taken to be: its ends are of something.
const MARGIN: f64 = 1.15;
/// About as many splats or vertices are looked at, evenly picked.
const MOST: usize = 1 << 18;

/// What [`overview`] makes.
#[derive(Clone, Debug)]
pub struct Overview {
    /// Views in a ring, counterclockwise seen from above, all of 1024×768 and 45° high.
    pub views: Vec<Camera>,
    /// Centre of the ball that each of them has in its picture, world space.
    pub focus: DVec3,
    /// Radius of that ball in world units.
    pub radius: f64,
}

/// Up in the frame of captures, which scenes are read in.
pub const UP: DVec3 = DVec3::NEG_Y;

/// Views of a scene in a ring about it, a little above, all of which look at its middle. What it shows is the box in
/// which nine tenths of splats, weighted by opacity and large ones the less, and of vertices are along each axis. `up`
/// is a unit vector; the first view looks towards +z, or towards +y where z is nearly up or down.
///
/// # Errors
/// If there are no splats and no meshes.
pub fn overview(scene: &HybridScene, up: DVec3, count: usize) -> Result<Overview, PathError> {
    let (focus, radius) = ball(scene).ok_or(PathError::Empty)?;
    let distance = radius / (0.5 * FOV_Y).to_radians().sin();
    let ahead = if up.z.abs() > 0.9 { DVec3::Y } else { DVec3::Z };
    let ahead = (ahead - up * ahead.dot(up)).normalize();
    // Not negated, which would give zeros a sign.
    let down = DVec3::ZERO - up;
    let rotation = DMat3::from_cols(down.cross(ahead), down, ahead).transpose();
    let first = Camera::new(lens(), rotation, DVec3::Z * distance - rotation * focus)?;
    let (sin, cos) = DOWN.to_radians().sin_cos();
    let (radius_of_ring, height) = (Some(distance * cos), Some(distance * sin));
    let around = Around { focus: Some(focus), radius: radius_of_ring, height, ..Around::default() };
    let views = orbit(&[first], &around, &Shot { frames: count, size: None, fov_y: None })?;
    Ok(Overview { views, focus, radius })
}

fn lens() -> Intrinsics {
    Intrinsics::from_fov_y(SIZE[0], SIZE[1], FOV_Y.to_radians())
}

/// Middle and radius of what a scene shows.
fn ball(scene: &HybridScene) -> Option<(DVec3, f64)> {
    let boxes = [box_of_splats(&scene.splats), box_of_vertices(&scene.meshes)];
    let (low, high) = boxes.into_iter().flatten().reduce(|a, b| (a.0.min(b.0), a.1.max(b.1)))?;
    let radius = MARGIN * 0.5 * low.distance(high);
    // A point has no size to go by.
    Some((0.5 * (low + high), if radius > 0.0 { radius } else { 1.0 }))
}

/// Of few splats it matters how large they are. Those that are larger than most weigh the less, the larger they are:
/// trainings put some far behind what they show, as large as the background is in the pictures.
fn box_of_splats(splats: &Splats) -> Option<(DVec3, DVec3)> {
    let some = || (0..splats.len()).step_by(splats.len().div_ceil(MOST).max(1));
    let opacity = |i: usize| sigmoid(f64::from(splats.opacity_logits()[i]));
    let size = |i: usize| f64::from(splats.log_scales()[i].max_element()).exp();
    let mut sizes: Vec<(f64, f64)> = some().map(|i| (size(i), opacity(i))).collect();
    let usual = quantile(&mut sizes, 0.5)?;
    let weight = |i: usize| opacity(i) * (usual / size(i)).min(1.0);
    let means: Vec<(DVec3, f64)> = some().map(|i| (splats.means()[i].as_dvec3(), weight(i))).collect();
    let (low, high) = inner_box(&means)?;
    let margin = DVec3::splat(2.0 * usual);
    Some((low - margin, high + margin))
}

fn box_of_vertices(meshes: &[Mesh]) -> Option<(DVec3, DVec3)> {
    let count: usize = meshes.iter().map(|mesh| mesh.positions().len()).sum();
    let all = meshes.iter().flat_map(Mesh::positions);
    let some: Vec<(DVec3, f64)> = all.step_by(count.div_ceil(MOST).max(1)).map(|p| (p.as_dvec3(), 1.0)).collect();
    inner_box(&some)
}

/// Lower and upper corner of the box of all points, which have weights, but those outermost along each axis.
fn inner_box(points: &[(DVec3, f64)]) -> Option<(DVec3, DVec3)> {
    let (mut low, mut high) = (DVec3::ZERO, DVec3::ZERO);
    for axis in 0..3 {
        let mut along: Vec<(f64, f64)> = points.iter().map(|(point, weight)| (point[axis], *weight)).collect();
        low[axis] = quantile(&mut along, BEYOND)?;
        high[axis] = quantile(&mut along, 1.0 - BEYOND)?;
    }
    Some((low, high))
}

/// The value up to which this part of the weight lies; `None` of no values. They are sorted.
fn quantile(values: &mut [(f64, f64)], part: f64) -> Option<f64> {
    values.sort_unstable_by(|a, b| a.0.total_cmp(&b.0));
    let total: f64 = values.iter().map(|(_, weight)| weight).sum();
    let mut until = 0.0;
    let reaches = |(_, weight): &&(f64, f64)| {
        until += weight;
        until >= part * total
    };
    values.iter().find(reaches).or(values.last()).map(|(value, _)| *value)
}
