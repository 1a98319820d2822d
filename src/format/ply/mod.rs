//! PLY files: INRIA's splat layout (`save_ply` in `scene/gaussian_model.py`), that of `PlayCanvas`, and coloured
//! points.

mod audit;
pub mod compressed;
mod decode;
mod encode;
mod filter;
pub(super) mod layout;
mod points;
pub(crate) mod table;

use std::io::{BufRead, Seek};
use std::path::Path;

use glam::{DVec3, Vec3};
use serde::Serialize;

use self::decode::parse;
use self::points::parse_points;
use self::table::{Body, Element, Header};
use super::attribute::Attribute;
use super::error::{Fault, FormatError, open_file};
use super::loss::WriteReport;
use super::{ReadOptions, SplatFile, atomic_write_with};
use crate::scene::{PixelFilter, Splats, bounds};

/// Writes splats in the INRIA layout with (zero) normals: binary little endian, float32. `opacity` is a logit, `scale`
/// a natural logarithm, `f_rest` channel-major, `rot` (w, x, y, z). Frame and colour space are the scene's own, which
/// the format cannot state. Nothing of the splats is lost.
///
/// # Errors
/// If the file cannot be written.
pub fn write(path: &Path, splats: &Splats) -> Result<WriteReport, FormatError> {
    write_with(path, splats, &[], PixelFilter::DILATION)
}

/// Same as [`write()`], followed by further per-splat attributes. A filter that preserves the integral of projections
/// is stated by a comment, as Brush and splat-transform do: `SplatRenderMode: mip`; its variance by a comment of our
/// own. A filter that does not preserve the integral is not stated.
///
/// # Errors
/// If the file cannot be written, or the number of an attribute's values differs from that of the splats.
pub fn write_with(
    path: &Path,
    splats: &Splats,
    attributes: &[Attribute],
    pixel_filter: PixelFilter,
) -> Result<WriteReport, FormatError> {
    if let Some(a) = attributes.iter().find(|a| a.values.len() != splats.len()) {
        let expected = format!("{} values of the attribute `{}`", splats.len(), a.name);
        return Err(Fault::whole(expected, a.values.len().to_string()).in_file(path));
    }
    let bytes = atomic_write_with(path, |out| encode::encode(splats, attributes, pixel_filter, out))?;
    Ok(WriteReport { bytes, ..WriteReport::default() })
}

/// Reads splats in the INRIA layout: ASCII or binary, any scalar types, with or without normals; SH degree 0 to 4, of
/// which at most 3 is kept, determined by the number of `f_rest` properties; also flat splats without `scale_2` (2DGS).
/// `filter_3D` of Mip-Splatting, the standard deviation of each splat's smoothing, becomes part of scale and opacity.
/// The layout of [`compressed`] is recognised by its properties.
///
/// Infinite logits (opacities of exactly 0 or 1, as converted from 8-bit alpha) and log-scales of −∞ (scales of 0)
/// become the nearest finite ones.
///
/// All other scalar properties of the splats except normals become attributes, unless the file is compressed. The pixel
/// filter is [`PixelFilter::MIP`] if Mip-Splatting's `filter_3D` is present or Brush states it,
/// [`PixelFilter::NORMALIZED_DILATION`] if others do, and exactly the stated one if Centaur wrote the file. Notes are on
/// further content, on what is merged into the splats, on non-zero normals, and on positions in double precision that
/// lose more than a millionth of the scene's size.
///
/// # Errors
/// If the file cannot be read, is not such a PLY, is truncated, or holds values that [`Splats::new`] rejects.
pub fn read(path: &Path, options: &ReadOptions<'_>) -> Result<SplatFile, FormatError> {
    parse(open_file(path)?, options.drop_invalid).map_err(|fault| fault.in_file(path))
}

/// Reads points: `x y z` and, where present, `red green blue` (8-bit, or float in 0..1; grey otherwise). The frame is
/// the file's own.
///
/// # Errors
/// If the file cannot be read, is not a PLY with a `vertex` element, is truncated, or a position is not finite.
pub fn read_points(path: &Path) -> Result<Vec<(DVec3, [u8; 3])>, FormatError> {
    parse_points(open_file(path)?).map_err(|fault| fault.in_file(path))
}

pub(super) fn parse_splats(file: impl BufRead + Seek + Send) -> Result<Splats, Fault> {
    parse(file, false).map(|file| file.splats)
}

/// Table of a PLY.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Table {
    /// `vertex`, `face`, …
    pub name: String,
    /// Number of rows that the header declares.
    pub rows: usize,
    /// Names of the table's properties; those of lists with `[]`: `vertex_indices[]`.
    pub properties: Vec<String>,
    /// Lowest and highest `x y z` over finite points.
    pub bounds: Option<[[f32; 3]; 2]>,
}

/// Tables of a PLY, and whether they are those of splats, readable or not.
pub(super) fn tables(path: &Path) -> Result<(Vec<Table>, bool), FormatError> {
    let located = |fault: Fault| fault.in_file(path);
    let (header, mut body) = table::open(open_file(path)?).map_err(located)?;
    let is_of_splats = is_of_splats(&header);
    let mut tables: Vec<Table> = header.elements().iter().map(Element::describe).collect();
    // Bounds of splats are computed from the splats themselves.
    if !is_of_splats {
        body.rewind().map_err(located)?;
        for (element, table) in header.elements().iter().zip(&mut tables) {
            table.bounds = bounds_of_next(element, &mut body).map_err(located)?;
        }
    }
    Ok((tables, is_of_splats))
}

/// Bounds of the finite points of `element`, the next table in the file, if it has any.
fn bounds_of_next(element: &Element, body: &mut Body<impl BufRead + Seek>) -> Result<Option<[[f32; 3]; 2]>, Fault> {
    let Ok(xyz) = element.scalars(["x", "y", "z"]) else { return body.pass(element).map(|()| None) };
    let mut corners: Option<[Vec3; 2]> = None;
    body.next_rows(element, |row| {
        let p = Vec3::from(xyz.map(|column| row.values[column] as f32));
        if p.is_finite() {
            corners = bounds(corners.into_iter().flatten().chain([p]));
        }
        Ok(())
    })?;
    Ok(corners.map(|corners| corners.map(|corner| corner.to_array())))
}

/// Whether the tables are those of splats, be they readable or not.
pub(super) fn is_of_splats(header: &Header) -> bool {
    header.element("vertex").is_some_and(|vertex| vertex.scalar("f_dc_0").is_some())
        || compressed::is_compressed(header)
}

#[cfg(test)]
mod tests;
