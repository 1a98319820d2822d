//! Transforms of prims by `xformOp`s.

use glam::{DMat4, DQuat, DVec3};

use super::document::{Prim, Property, Value};
use super::stage::Stage;
use crate::format::error::Fault;

/// Upper bound on operations of one prim: far above what any program writes. Each is searched among the prim's
/// properties.
const MAX_OPERATIONS: usize = 1000;

/// Transform of a prim, and whether it ignores those of its ancestors.
pub(super) fn local(stage: &Stage<'_>, prim: usize) -> Result<(DMat4, bool), Fault> {
    let mut transform = DMat4::IDENTITY;
    let mut resets = false;
    let Some(order) = stage.prims[prim].value("xformOpOrder") else { return Ok((transform, false)) };
    let at = || format!("{}.xformOpOrder", stage.path(prim));
    let Value::List(order) = order else { return Err(Fault::pointer(at(), "a list of operations", "other values")) };
    if order.len() > MAX_OPERATIONS {
        return Err(Fault::pointer(at(), format!("at most {MAX_OPERATIONS} operations"), order.len().to_string()));
    }
    for name in order {
        let name = name.as_text().unwrap_or_default();
        if name == "!resetXformStack!" {
            (transform, resets) = (DMat4::IDENTITY, true);
            continue;
        }
        let (inverted, attribute) = match name.strip_prefix("!invert!") {
            Some(attribute) => (true, attribute),
            None => (false, name),
        };
        let values = stage.value(prim, attribute).and_then(|v| v.as_numbers()).unwrap_or_default();
        // Splines are not read; without another value, the operation does nothing.
        if values.is_empty() && stage.prims[prim].property(attribute).is_some_and(Property::has_spline) {
            continue;
        }
        let kind = attribute.split(':').nth(1).unwrap_or_default();
        let step = operation(kind, &values).filter(DMat4::is_finite).ok_or_else(|| {
            let found = format!("{} numbers", values.len());
            Fault::pointer(format!("{}.{attribute}", stage.path(prim)), "finite numbers of an xformOp", found)
        })?;
        // The first operation of the list is the outermost.
        transform *= if inverted { step.inverse() } else { step };
    }
    if !transform.is_finite() {
        return Err(Fault::pointer(at(), "a finite transform", "numbers that are not"));
    }
    Ok((transform, resets))
}

/// Names of the attributes that determine a prim's transform.
pub(super) fn attributes(prim: &Prim) -> impl Iterator<Item = &str> {
    let order = match prim.value("xformOpOrder") {
        Some(Value::List(order)) => &order[..],
        _ => &[],
    };
    order.iter().filter_map(Value::as_text).map(|name| name.strip_prefix("!invert!").unwrap_or(name))
}

/// Matrix of one operation, for column vectors. Angles are in degrees.
fn operation(kind: &str, values: &[f64]) -> Option<DMat4> {
    let axis = |letter: u8| match letter {
        b'X' => Some(DVec3::X),
        b'Y' => Some(DVec3::Y),
        b'Z' => Some(DVec3::Z),
        _ => None,
    };
    match (kind, values) {
        ("translate", &[x, y, z]) => Some(DMat4::from_translation(DVec3::new(x, y, z))),
        ("scale", &[x, y, z]) => Some(DMat4::from_scale(DVec3::new(x, y, z))),
        ("orient", &[w, x, y, z]) => {
            let q = DQuat::from_xyzw(x, y, z, w);
            (q.length() > 0.0).then(|| DMat4::from_quat(q.normalize()))
        }
        // USD's vectors are rows: its first row is our first column.
        ("transform", all) => Some(DMat4::from_cols_array(all.try_into().ok()?)),
        _ => {
            let (name, axes) = kind.split_at_checked(kind.find(['X', 'Y', 'Z'])?)?;
            match (name, axes.as_bytes(), values) {
                ("translate", &[a], &[v]) => Some(DMat4::from_translation(axis(a)? * v)),
                ("scale", &[a], &[v]) => Some(DMat4::from_scale(DVec3::ONE + axis(a)? * (v - 1.0))),
                ("rotate", &[a], &[v]) => Some(turn(axis(a)?, v)),
                // The first-named axis rotates first; angles are always given in the order x, y, z.
                ("rotate", &[first, second, third], &[x, y, z]) => {
                    let about = |letter: u8| Some(turn(axis(letter)?, [x, y, z][usize::from(letter - b'X')]));
                    Some(about(third)? * about(second)? * about(first)?)
                }
                _ => None,
            }
        }
    }
}

/// Rotation, exact for multiples of a quarter turn, such as between y up and z up.
fn turn(axis: DVec3, degrees: f64) -> DMat4 {
    let quarters = degrees / 90.0;
    if quarters.fract() != 0.0 {
        return DMat4::from_axis_angle(axis, degrees.to_radians());
    }
    let (sin, cos) = [(0.0, 1.0), (1.0, 0.0), (0.0, -1.0), (-1.0, 0.0)][quarters.rem_euclid(4.0) as usize % 4];
    let column = |v: DVec3| (v * cos + axis.cross(v) * sin + axis * (axis.dot(v) * (1.0 - cos))).extend(0.0);
    DMat4::from_cols(column(DVec3::X), column(DVec3::Y), column(DVec3::Z), glam::DVec4::W)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn operations_are_those_of_usd() {
        let p = DVec3::new(1.0, 2.0, 3.0);
        let at = |kind: &str, values: &[f64]| operation(kind, values).unwrap().transform_point3(p);
        assert_eq!(at("translateY", &[5.0]), DVec3::new(1.0, 7.0, 3.0));
        assert_eq!(at("scaleZ", &[2.0]), DVec3::new(1.0, 2.0, 6.0));
        assert_eq!(at("rotateX", &[-90.0]), DVec3::new(1.0, 3.0, -2.0));
        // Rotation about x first: (1, 2, 3) → (1, −3, 2), then about y: (2, −3, −1).
        assert_eq!(at("rotateXYZ", &[90.0, 90.0, 0.0]), DVec3::new(2.0, -3.0, -1.0));
        assert_eq!(at("rotateZYX", &[90.0, 90.0, 0.0]), DVec3::new(3.0, 1.0, 2.0));
        assert!(at("orient", &[0.5f64.sqrt(), 0.5f64.sqrt(), 0.0, 0.0]).abs_diff_eq(DVec3::new(1.0, -3.0, 2.0), 1e-12));
        let mut rows = [0.0; 16];
        [rows[0], rows[5], rows[10], rows[15], rows[12]] = [1.0, 1.0, 1.0, 1.0, 9.0];
        assert_eq!(at("transform", &rows), DVec3::new(10.0, 2.0, 3.0));
        for (kind, values) in [("translate", &[1.0][..]), ("rotateXQ", &[1.0, 2.0]), ("spin", &[1.0]), ("rotate", &[])]
        {
            assert!(operation(kind, values).is_none(), "{kind}");
        }
    }
}
