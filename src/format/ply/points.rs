//! Reading of coloured points.

use std::io::{BufRead, Seek};

use glam::DVec3;

use super::table;
use crate::format::error::Fault;

pub(super) fn parse_points(file: impl BufRead + Seek) -> Result<Vec<(DVec3, [u8; 3])>, Fault> {
    let (header, mut body) = table::open(file)?;
    let vertex = header.required("vertex")?;
    let [x, y, z] = vertex.scalars(["x", "y", "z"])?;
    let colours = vertex.scalars(["red", "green", "blue"]).ok();
    let scale = if vertex.is_float("red") { 255.0 } else { 1.0 };
    body.rows(&header, "vertex", Vec::with_capacity, |points, row| {
        let position = DVec3::new(row.values[x], row.values[y], row.values[z]);
        if !position.is_finite() {
            let expected = format!("finite numbers in vertex {}", points.len());
            return Err(Fault::byte(row.at, expected, format!("{:?}", position.to_array())));
        }
        // A float-to-integer cast saturates, and maps NaN to 0.
        let rgb = colours.map_or([128; 3], |columns| columns.map(|c| (row.values[c] * scale).round() as u8));
        points.push((position, rgb));
        Ok(())
    })
}
