//! Surfaces that `centaur train` is given, and of what it makes them otherwise.

use std::path::Path;

use anyhow::Result;
use centaur::capture::{self, Capture};
use centaur::format::mesh_import;
use centaur::geometry::{MeshBvh, Surface};
use centaur::optimize::MeshSource;
use clap::ValueEnum;
use glam::DVec3;

use crate::cli::shared;

/// What a surface is made of.
#[derive(Clone, Copy, ValueEnum)]
pub(super) enum SurfaceOf {
    /// Fused depth of the splats after --surface-iterations
    Splats,
    /// Points of the capture, triangulated in every view
    Points,
}

/// The mesh in a file, and notes of its reader.
pub(super) fn given(file: &Path, capture: &Capture) -> Result<(MeshSource, Vec<String>)> {
    let mesh = mesh_import::read(file)?;
    let surface = Surface { positions: mesh.positions, triangles: mesh.triangles };
    let stray = misses_points(&surface, capture).then(|| {
        "is near hardly any of the points of the capture: is it in the frame and unit of the camera poses?".to_owned()
    });
    let notes = mesh.notes.into_iter().chain(shared::as_stored(mesh.y_up)).chain(stray);
    let notes = notes.map(|note| format!("{}: {note}", file.display())).collect();
    Ok((MeshSource::Given { surface, corner_uvs: mesh.corner_uvs }, notes))
}

/// Distance at which a point counts as on a surface, relative to the extent of the cameras.
const AT_SURFACE: f64 = 0.1;
/// Fraction of `SOME_POINTS` sampled points up to which a surface counts as missing the points: an object in a large
/// scene has few.
const LEAST_AT_SURFACE: f64 = 0.002;
const SOME_POINTS: usize = 2000;

/// Whether a surface is in another place than the capture's points, as with another unit or frame.
fn misses_points(surface: &Surface, capture: &Capture) -> bool {
    let reach = AT_SURFACE * capture::extent(&capture.cameras());
    let step = capture.points.len().div_ceil(SOME_POINTS).max(1);
    let points: Vec<DVec3> = capture.points.iter().step_by(step).map(|point| point.position).collect();
    // Few points, or cameras in one place, do not determine where a surface is.
    if points.len() < 100 || reach == 0.0 {
        return false;
    }
    let triangles = MeshBvh::new([(&surface.positions[..], &surface.triangles[..])]);
    let is_at = |point: &&DVec3| triangles.closest_point(**point).is_some_and(|found| found.distance <= reach);
    points.iter().filter(is_at).count() as f64 <= LEAST_AT_SURFACE * points.len() as f64
}
