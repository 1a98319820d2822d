//! Check of whether the stated extents of meshes and splats contain them. Renderers cull by extents, so too small ones
//! hide geometry; scene readers do not use them.

use glam::DVec3;

use super::Breach;
use super::document::{PropertyKind, Value};
use super::stage::Stage;
use super::to_scene::SPLATS;
use crate::format::error::Fault;

/// Tolerances for rounded bounds, which some programs compute in double precision and via a transform: relative to the
/// size, and to the distance from the origin, where single precision is coarser.
const ROUNDING: [f64; 2] = [1e-4, 1e-6];

/// Tolerated excess of an extent, relative to its size.
const SLACK: f64 = 0.01;

/// Standard deviations beyond which no program draws a splat: our limit and the schema's default is 3.
const REACH: f64 = 5.0;

type Box3 = [DVec3; 2];

/// Fault of a prim's extent: of its default, or else of the first time sample with an extent of its own.
pub(super) fn check(stage: &Stage<'_>, prim: usize) -> Option<Breach> {
    let here = stage.prims[prim];
    let positions = match here.type_name.as_str() {
        "Mesh" => "points",
        SPLATS if here.property("positions").is_some() => "positions",
        SPLATS => "positionsh",
        _ => return None,
    };
    let breach = |is_error, expected: String, found: String| {
        let fault = Fault::pointer(format!("{}.extent", stage.path(prim)), expected, found);
        Some(Breach { code: "USD_EXTENT", is_error, fault })
    };
    // Skins and morph targets move points beyond their rest positions.
    let is_moved = here.properties.iter().any(|p| p.name.starts_with("skel:") || p.name.starts_with("primvars:skel:"));
    for (extent, points) in pairs(stage, prim, positions) {
        let Some(bounds) = bounds(points) else { continue };
        let Some([low, high]) = corners(extent) else {
            return breach(true, "two corners, the lower first".to_owned(), "other values".to_owned());
        };
        let size = (bounds[1] - bounds[0]).length();
        let far = bounds[0].abs().max(bounds[1].abs()).max_element();
        let slack = ROUNDING[0] * size + ROUNDING[1] * far;
        let holds = low.cmple(bounds[0] + slack).all() && high.cmpge(bounds[1] - slack).all();
        if !holds {
            return breach(true, format!("all {positions}, {}", shown(bounds)), shown([low, high]));
        }
        let reach = if positions == "points" { Some(0.0) } else { largest_scale(stage, prim).map(|s| REACH * s) };
        let Some(reach) = reach.filter(|reach| reach.is_finite() && !is_moved) else { continue };
        let most = [bounds[0] - reach, bounds[1] + reach];
        let slack = slack + SLACK * (most[1] - most[0]).length();
        let is_tight = low.cmpge(most[0] - slack).all() && high.cmple(most[1] + slack).all();
        if !is_tight {
            return breach(false, format!("no more than {}", shown(most)), shown([low, high]));
        }
    }
    None
}

/// Extents paired with the positions at the same time.
fn pairs<'a>(stage: &Stage<'a>, prim: usize, positions: &str) -> Vec<(&'a Value, &'a Value)> {
    let here = stage.prims[prim];
    let parts = |name: &str| match here.property(name).map(|p| &p.kind) {
        Some(PropertyKind::Attribute { value, samples, .. }) => (value.as_ref(), &samples[..]),
        _ => (None, &[][..]),
    };
    let ((extent, extents), (points, moved)) = (parts("extent"), parts(positions));
    let times: std::collections::HashMap<u64, &Value> = moved.iter().map(|(at, value)| (at.to_bits(), value)).collect();
    // Static positions apply at all times.
    let at = |time: f64| times.get(&time.to_bits()).copied().or(points.filter(|_| moved.is_empty()));
    let sampled = extents.iter().filter_map(|(time, extent)| Some((extent, at(*time)?)));
    extent.zip(points).into_iter().chain(sampled).collect()
}

/// Rows of three numbers; `None` for other values.
fn rows(value: &Value) -> Option<Box<dyn ExactSizeIterator<Item = DVec3> + '_>> {
    match value {
        Value::Floats(all) => Some(Box::new(all.as_chunks::<3>().0.iter().map(|row| DVec3::from(row.map(f64::from))))),
        Value::Doubles(all) => Some(Box::new(all.as_chunks::<3>().0.iter().map(|&row| DVec3::from(row)))),
        _ => None,
    }
}

/// Bounding box of all rows; `None` if there are no rows, or non-finite numbers, at which the reader stops.
fn bounds(points: &Value) -> Option<Box3> {
    let [low, high] = rows(points)?.map(|p| [p, p]).reduce(|a, b| {
        // `min` and `max` would ignore NaN.
        let finite = a[0].is_finite() && b[0].is_finite();
        if finite { [a[0].min(b[0]), a[1].max(b[1])] } else { [DVec3::NAN; 2] }
    })?;
    (low.is_finite() && high.is_finite()).then_some([low, high])
}

fn corners(extent: &Value) -> Option<Box3> {
    let mut rows = rows(extent)?;
    let (low, high) = (rows.next()?, rows.next()?);
    (rows.next().is_none() && low.cmple(high).all()).then_some([low, high])
}

/// Largest standard deviation of splats; `None` if none is a valid number.
fn largest_scale(stage: &Stage<'_>, prim: usize) -> Option<f64> {
    let scales = stage.prims[prim].value("scales").or_else(|| stage.prims[prim].value("scalesh"))?;
    rows(scales)?.map(DVec3::max_element).reduce(f64::max)
}

fn shown([low, high]: Box3) -> String {
    let corner = |p: DVec3| format!("({:.6}, {:.6}, {:.6})", p.x, p.y, p.z);
    format!("{} to {}", corner(low), corner(high))
}
