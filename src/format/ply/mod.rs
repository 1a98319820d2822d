//! PLY files: INRIA's splat layout (`save_ply` in `scene/gaussian_model.py`), that of `PlayCanvas`, and coloured
//! points.

pub mod compressed;
pub(crate) mod table;

use std::io::{BufRead, Seek, Write as _};
use std::ops::Range;
use std::path::Path;

use glam::{DVec3, Quat, Vec3};
use serde::Serialize;

use self::table::{Body, Column, Element, Header};
use super::attribute::{Attribute, Scalar};
use super::blocks::in_waves;
use super::error::{Fault, FormatError, open_file, shown};
use super::loss::WriteReport;
use super::splat_record::{DROPPING, SEEN_IN_3D, SplatRecord};
use super::{ReadOptions, SplatFile, activation, atomic_write_with};
use crate::scene::{PixelFilter, SceneError, SplatArrays, Splats, sh, smoothed_parameters};

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
    let names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"].map(str::to_owned).into_iter();
    let names = names
        .chain((0..sh::band_floats(splats.sh_degree())).map(|i| format!("f_rest_{i}")))
        .chain(["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"].map(str::to_owned));
    let names = names.map(|name| ("float", name)).chain(attributes.iter().map(|a| (a.kind.name(), a.name.clone())));
    let properties: String = names.map(|(kind, name)| format!("property {kind} {name}\n")).collect();
    let bytes = atomic_write_with(path, |out| {
        let comments = filter_comments(pixel_filter);
        let count = splats.len();
        write!(
            out,
            "ply\nformat binary_little_endian 1.0\n{comments}element vertex {count}\n{properties}end_header\n"
        )?;
        let block = |i: usize| i * ROWS..splats.len().min((i + 1) * ROWS);
        in_waves(
            splats.len().div_ceil(ROWS),
            |i| encode_rows(splats, attributes, block(i)),
            |rows| out.write_all(&rows),
        )
    })?;
    Ok(WriteReport { bytes, ..WriteReport::default() })
}

/// Start of the comment that states the variance of a pixel filter.
const VARIANCE: &str = "Centaur filter variance:";

/// Header comments of splats whose pixel filter preserves the integral of projections.
fn filter_comments(filter: PixelFilter) -> String {
    if !filter.normalized {
        return String::new();
    }
    format!("comment SplatRenderMode: mip\ncomment {VARIANCE} {}\n", filter.variance)
}

/// Number of rows encoded as one task: about 1 MB.
const ROWS: usize = 1 << 12;

fn encode_rows(splats: &Splats, attributes: &[Attribute], rows: Range<usize>) -> Vec<u8> {
    let extra: usize = attributes.iter().map(|a| a.kind.bytes()).sum();
    let mut bytes = Vec::with_capacity(rows.len() * (4 * (14 + 3 * sh::coefficients(splats.sh_degree())) + extra));
    for i in rows {
        let mut put = |values: &[f32]| values.iter().for_each(|v| bytes.extend_from_slice(&v.to_le_bytes()));
        let (dc, rest) = (splats.sh_of(i)[0], &splats.sh_of(i)[1..]);
        put(&splats.means()[i].to_array());
        put(&[0.0; 3]);
        put(&dc);
        (0..3).for_each(|channel| rest.iter().for_each(|c| put(&[c[channel]])));
        put(&[splats.opacity_logits()[i]]);
        put(&splats.log_scales()[i].to_array());
        let q = splats.rotations()[i];
        put(&[q.w, q.x, q.y, q.z]);
        attributes.iter().for_each(|a| a.kind.encode(a.values[i], &mut bytes));
    }
    bytes
}

/// Reads splats in the INRIA layout: ASCII or binary, any scalar types, with or without normals; SH degree 0 to 4, of
/// which at most 3 is kept, determined by the number of `f_rest` properties; also flat splats without `scale_2` (2DGS).
/// Other properties and elements are ignored, except `filter_3D` of Mip-Splatting, the standard deviation of each
/// splat's smoothing, which becomes part of scale and opacity. The layout of [`compressed`] is recognised by its
/// properties.
///
/// Infinite logits (opacities of exactly 0 or 1, as converted from 8-bit alpha) and log-scales of −∞ (scales of 0)
/// become the nearest finite ones.
///
/// # Errors
/// If the file cannot be read, is not such a PLY, is truncated, or holds values that [`Splats::new`] rejects.
pub fn read(path: &Path) -> Result<Splats, FormatError> {
    read_with(path, &ReadOptions::default()).map(|file| file.splats)
}

/// Same as [`read`], with what the file says besides: all other scalar properties of the splats except normals as
/// attributes, unless the file is compressed, and the pixel filter. It is [`PixelFilter::MIP`] if Mip-Splatting's
/// `filter_3D` is present or Brush states it, [`PixelFilter::NORMALIZED_DILATION`] if others do, and exactly the stated
/// one if Centaur wrote the file. Notes are on further content, on what is merged into the splats, on non-zero normals,
/// and on positions in double precision that lose more than a millionth of the scene's size.
///
/// # Errors
/// Those of [`read`].
pub fn read_with(path: &Path, options: &ReadOptions<'_>) -> Result<SplatFile, FormatError> {
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
            let (mut low, mut high) = (Vec3::INFINITY, Vec3::NEG_INFINITY);
            let passed = match element.scalars(["x", "y", "z"]) {
                Err(_) => body.pass(element),
                Ok(xyz) => body.next_rows(element, |row| {
                    let p = Vec3::from(xyz.map(|column| row.values[column] as f32));
                    if p.is_finite() {
                        (low, high) = (low.min(p), high.max(p));
                    }
                    Ok(())
                }),
            };
            passed.map_err(located)?;
            table.bounds = low.is_finite().then(|| [low.to_array(), high.to_array()]);
        }
    }
    Ok((tables, is_of_splats))
}

/// Whether the tables are those of splats, be they readable or not.
pub(super) fn is_of_splats(header: &Header) -> bool {
    header.element("vertex").is_some_and(|vertex| vertex.scalar("f_dc_0").is_some())
        || compressed::is_compressed(header)
}

/// What a PLY is where its vertices have places and nothing of splats.
fn of_something_else(header: &Header, vertex: &Element) -> Option<Fault> {
    let has = |name: &&str| vertex.scalar(name).is_some();
    let is_something = ["x", "y", "z"].iter().all(has) && !["f_dc_0", "opacity", "scale_0", "rot_0"].iter().any(has);
    is_something.then(|| {
        let faces = header.element("face").map_or(0, |face| face.count);
        let found =
            if faces > 0 { format!("a mesh, no splats (`face`: {faces})") } else { "points, no splats".to_owned() };
        Fault::byte(vertex.at, "splats, with `f_dc_0` and more", found)
    })
}

pub(super) fn parse_splats(file: impl BufRead + Seek + Send) -> Result<Splats, Fault> {
    parse(file, false).map(|file| file.splats)
}

fn parse(file: impl BufRead + Seek + Send, drop_invalid: bool) -> Result<SplatFile, Fault> {
    let (header, mut body) = table::open(file)?;
    header.repeated_property().map_or(Ok(()), Err)?;
    let mut notes = left_out(&header);
    let pixel_filter = pixel_filter_of(&header, &mut notes);
    if compressed::is_compressed(&header) {
        let splats = compressed::parse(&header, &mut body)?;
        return Ok(SplatFile { pixel_filter, notes, ..SplatFile::of(splats) });
    }
    let vertex = header.required("vertex")?;
    of_something_else(&header, vertex).map_or(Ok(()), Err)?;
    if vertex.count == 0 {
        notes.push("holds no splats: `element vertex 0`".to_owned());
    }
    let means = vertex.columns(["x", "y", "z"])?;
    let dc = vertex.columns(["f_dc_0", "f_dc_1", "f_dc_2"])?;
    let [opacity] = vertex.columns(["opacity"])?;
    let scales = vertex.columns(["scale_0", "scale_1"])?;
    let thickness = vertex.column("scale_2");
    if thickness.is_none() {
        notes.push(format!("scale_2 is missing, as in files of 2DGS: splats are flat, {FLAT:e} thick"));
    }
    if vertex.scalar(BINDING).is_some() {
        notes.push(format!(
            "{BINDING}: from GaussianAvatars: positions, rotations and scales are relative to triangles of a mesh that is not in this file, and are read unchanged"
        ));
    }
    let wxyz = vertex.columns(["rot_0", "rot_1", "rot_2", "rot_3"])?;
    let rest = rest_columns(vertex);
    let (stored, bands) = (degree_of_rest(rest.len()).map_err(|fault| fault.at_byte(vertex.at))?, rest.len() / 3);
    let sh_degree = stored.min(sh::MAX_DEGREE);
    if sh_degree < stored {
        notes.push(format!("SH bands above degree {sh_degree} of {stored} are left out"));
    }
    let filter = vertex.column(FILTER_3D);
    if filter.is_some() {
        notes.push(format!("{FILTER_3D} of Mip-Splatting: made part of scales and opacities"));
    }
    let rest_names: Vec<String> = (0..rest.len()).map(|i| format!("f_rest_{i}")).collect();
    let parameters: Vec<&str> = PARAMETERS.into_iter().chain(rest_names.iter().map(String::as_str)).collect();
    let (mut attributes, extra) = further_attributes(vertex, &parameters);

    let decode = |row: &[u8]| {
        let v = |column: Column| column.f32(row);
        let mut sh = [[0.0; 3]; 16];
        sh[0] = dc.map(v);
        sh[1..].iter_mut().zip(0..bands).for_each(|(s, c)| *s = [0, 1, 2].map(|channel| v(rest[channel * bands + c])));
        let [w, x, y, z] = wxyz.map(v);
        let [first, second] = scales.map(v);
        let log_scale = Vec3::new(first, second, thickness.map_or(FLAT.ln(), v)).map(finite_log_scale);
        let (log_scale, opacity_logit) =
            smoothed_parameters(log_scale, finite_logit(v(opacity)), filter.map_or(0.0, |column| v(column).abs()));
        SplatRecord {
            mean: Vec3::from(means.map(v)),
            rotation: Quat::from_xyzw(x, y, z, w),
            log_scale,
            opacity_logit,
            sh_degree,
            sh,
        }
    };
    let is_double =
        vertex.scalar_properties().any(|(_, name, kind)| ["x", "y", "z"].contains(&name) && kind == Scalar::F64);
    let normals: Vec<Column> = ["nx", "ny", "nz"].iter().filter_map(|name| vertex.column(name)).collect();
    let (mut rounding, mut has_normals) = (0.0_f64, false);
    let mut look = |row: &[u8]| {
        has_normals = has_normals || normals.iter().any(|column| column.f64(row) != 0.0);
        if is_double {
            let error = |column: Column| (column.f64(row) - f64::from(column.f32(row))).abs();
            rounding = means.map(error).into_iter().fold(rounding, f64::max);
        }
    };
    let reserve = |n| {
        attributes.iter_mut().for_each(|a| a.values.reserve_exact(n));
        (SplatArrays::with_capacity(n, sh_degree), attributes, 0)
    };
    let (arrays, attributes, dropped) =
        body.blocks(&header, "vertex", reserve, |(arrays, attributes, dropped), rows| {
            let mut also = |row: &[u8]| {
                look(row);
                attributes.iter_mut().zip(&extra).for_each(|(a, c)| a.values.push(c.f64(row)));
            };
            if !drop_invalid {
                let bytes: Vec<&[u8]> = rows.collect();
                arrays.extend(bytes.len(), |i| decode(bytes[i]));
                bytes.into_iter().for_each(also);
                return Ok(());
            }
            for row in rows {
                if arrays.push_valid(&decode(row)) {
                    also(row);
                } else {
                    *dropped += 1;
                }
            }
            Ok(())
        })?;
    let splats = arrays.check().map_err(|e| invalid(&header, &mut body, &parameters, e))?;
    if has_normals {
        notes.push("nx, ny, nz: normals are left out".to_owned());
    }
    if rounding > 1e-6 * diagonal(splats.means()) {
        notes.push(format!("double-precision positions are rounded to single precision, by {rounding:.1e} at most"));
    }
    Ok(SplatFile { splats, attributes, pixel_filter, notes, dropped: Some(dropped) })
}

/// What is wrong with a splat that no scene holds: where its row begins, and as the validator says it, by row and property, of which `parameters`
/// are those that splats are made of.
fn invalid(header: &Header, body: &mut Body<impl BufRead + Seek>, parameters: &[&str], error: SceneError) -> Fault {
    let fault = Fault::from(error);
    let Some((field, row)) = fault.element() else { return fault };
    let at = body.locate(header, "vertex", |i| i, fault.clone()).location;
    let Fault { expected, found, .. } = fault;
    let fault = match not_finite(header, body, parameters, row) {
        Some((name, value)) => Fault::at(at, "finite numbers", format!("{value} in row {row} of `{name}`")),
        None if field == "rotations" => Fault::at(at, expected, format!("{found} in row {row} of `rot_0` to `rot_3`")),
        None => Fault::at(at, expected, format!("{found} in row {row}")),
    };
    fault.with_advice(DROPPING)
}

/// The first parameter of a row that is not finite in single precision, and its value. Of opacities and scales reading knows what infinite ones mean.
fn not_finite(
    header: &Header,
    body: &mut Body<impl BufRead + Seek>,
    parameters: &[&str],
    wanted: usize,
) -> Option<(String, String)> {
    let names = header.element("vertex")?.scalar_names();
    let is_at_fault = |name: &str, value: f64| {
        let is_meant =
            (name == "opacity" && value.is_infinite()) || (name.starts_with("scale_") && value == f64::NEG_INFINITY);
        parameters.contains(&name) && !(value as f32).is_finite() && !is_meant
    };
    let (mut number, mut found) = (0, None);
    let walked = body.rows(
        header,
        "vertex",
        |_| (),
        |(), row| {
            if number == wanted {
                let mut values = names.iter().map(|(column, name)| (*name, row.values[*column]));
                found = values.find(|&(name, value)| is_at_fault(name, value));
            }
            number += 1;
            Ok(())
        },
    );
    walked.ok()?;
    let shown = |value: f64| if value.is_finite() { format!("{value:e}") } else { value.to_string() };
    found.map(|(name, value)| (name.to_owned(), shown(value)))
}

/// Of the box around points; 0 of none.
fn diagonal(points: &[Vec3]) -> f64 {
    let start = (Vec3::INFINITY, Vec3::NEG_INFINITY);
    let (low, high) = points.iter().fold(start, |(low, high), &p| (low.min(p), high.max(p)));
    if points.is_empty() { 0.0 } else { (high.as_dvec3() - low.as_dvec3()).length() }
}

/// Thickness assigned to splats without one.
const FLAT: f32 = 1e-6;

/// Property of `GaussianAvatars` with the triangle of a FLAME mesh that a splat follows.
const BINDING: &str = "binding_0";

/// Property of Mip-Splatting with the standard deviation of a splat's 3D smoothing filter; scale and opacity in the
/// file are those before smoothing.
const FILTER_3D: &str = "filter_3D";

/// Properties of a splat, except for its higher SH bands.
const PARAMETERS: [&str; 15] = [
    "x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2",
    "rot_3", FILTER_3D,
];

/// Render mode requested by the comments of a header.
#[derive(Clone, Copy)]
enum Mode {
    Usual,
    /// `SplatRenderMode: mip`, by which Brush and splat-transform mean different filters.
    Mip,
    /// Postshot's `antialiased 1`.
    Antialiased,
    /// `SplatRenderMode: 2dgs`.
    Flat,
}

/// Pixel filter stated by a header: implied by Mip-Splatting's property, otherwise by the last comment on it.
fn pixel_filter_of(header: &Header, notes: &mut Vec<String>) -> PixelFilter {
    let is_compressed = compressed::is_compressed(header);
    if !is_compressed && header.element("vertex").is_some_and(|vertex| vertex.scalar(FILTER_3D).is_some()) {
        return PixelFilter::MIP;
    }
    let (mut mode, mut unknown) = (Mode::Usual, None);
    for comment in header.comments() {
        let comment = comment.to_lowercase();
        mode = match (comment.strip_prefix("splatrendermode:").map(str::trim), comment.as_str()) {
            (Some("mip"), _) => Mode::Mip,
            (Some("2dgs"), _) => Mode::Flat,
            (Some("default"), _) | (None, "antialiased 0") => Mode::Usual,
            (None, "antialiased 1") => Mode::Antialiased,
            (None, _) => mode,
            (Some(other), _) => {
                unknown = Some(shown(other.as_bytes()));
                mode
            }
        };
    }
    notes.extend(unknown.map(|name| format!("SplatRenderMode {name}: not known, left out")));
    match mode {
        Mode::Usual => PixelFilter::DILATION,
        Mode::Antialiased => PixelFilter::NORMALIZED_DILATION,
        Mode::Flat => {
            notes.push(format!("SplatRenderMode 2dgs: {SEEN_IN_3D}"));
            PixelFilter::DILATION
        }
        Mode::Mip => mip_filter_of(header).unwrap_or_else(|| {
            notes.push(
                "SplatRenderMode mip, written by neither Brush nor Centaur: read as antialiased with 0.3 px², as in SPZ and SOG, not with Mip-Splatting's 0.1"
                    .to_owned(),
            );
            PixelFilter::NORMALIZED_DILATION
        }),
    }
}

/// Pixel filter meant by *mip*, if it can be determined: splat-transform writes the word for any antialiased splats.
fn mip_filter_of(header: &Header) -> Option<PixelFilter> {
    let stated =
        header.comments().iter().find_map(|comment| comment.strip_prefix(VARIANCE)?.trim().parse::<f32>().ok());
    if let Some(variance) = stated.filter(|variance| variance.is_finite() && *variance >= 0.0) {
        return Some(PixelFilter { variance, normalized: true });
    }
    let is_of_brush = header.comments().iter().any(|comment| comment.eq_ignore_ascii_case("exported from brush"));
    (is_of_brush || is_of_former_centaur(header)).then_some(PixelFilter::MIP)
}

/// Whether the header is one that Centaur wrote before it stated the variance: that comment alone; splat-transform
/// writes it above a table with properties in another order, or, in compressed files, below its own name.
fn is_of_former_centaur(header: &Header) -> bool {
    let first = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0"];
    let is_inrias = |vertex: &Element| vertex.scalar_properties().map(|(_, name, _)| name).take(first.len()).eq(first);
    header.comments() == ["SplatRenderMode: mip"]
        && (compressed::is_compressed(header) || header.element("vertex").is_some_and(is_inrias))
}

/// Notes on content besides splats: other tables, and lists. Scalars of splats are attributes; those of compressed
/// splats are left out.
fn left_out(header: &Header) -> Vec<String> {
    let is_compressed = compressed::is_compressed(header);
    let mut notes = vec![];
    for element in header.elements().iter().filter(|element| element.count > 0) {
        let name = shown(element.name().as_bytes());
        match element.name() {
            "chunk" | "sh" if is_compressed => {}
            "vertex" => {
                let extra = compressed::extra_properties(element).filter(|_| is_compressed);
                let lists = element.list_names();
                notes.extend(
                    extra.chain(lists).map(|property| format!("{} of {name}: left out", shown(property.as_bytes()))),
                );
            }
            _ => notes.push(format!("{name}, {} of it: left out", element.count)),
        }
    }
    notes
}

/// Scalar properties of `vertex` other than `parameters` and normals (which carry no information), without values, and
/// their columns.
fn further_attributes(vertex: &Element, parameters: &[&str]) -> (Vec<Attribute>, Vec<Column>) {
    let is_extra = |name: &str| !["nx", "ny", "nz"].contains(&name) && !parameters.contains(&name);
    let extra = vertex.scalar_properties().filter(|(_, name, _)| is_extra(name));
    extra.map(|(column, name, kind)| (Attribute { name: name.to_owned(), kind, values: vec![] }, column)).unzip()
}

/// Columns of `f_rest_0`, `f_rest_1`, …
fn rest_columns(element: &Element) -> Vec<Column> {
    // Beyond twice the largest accepted number, the exact number does not matter.
    (0..90).map_while(|i| element.column(&format!("f_rest_{i}"))).collect()
}

/// SH degree with `rest` coefficients above the zeroth, in three channels; one degree more than a scene can hold is
/// recognised.
fn degree_of_rest(rest: usize) -> Result<u32, Fault> {
    sh::degree_of_band_floats(rest, sh::MAX_DEGREE + 1)
        .ok_or_else(|| Fault::whole("0, 9, 24, 45 or 72 `f_rest` properties", rest.to_string()))
}

fn finite_logit(logit: f32) -> f32 {
    if logit.is_infinite() { activation::logit(if logit > 0.0 { 1.0 } else { 0.0 }).0 } else { logit }
}

fn finite_log_scale(log_scale: f32) -> f32 {
    if log_scale == f32::NEG_INFINITY { activation::log_scale(0.0).0 } else { log_scale }
}

fn parse_points(file: impl BufRead + Seek) -> Result<Vec<(DVec3, [u8; 3])>, Fault> {
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

#[cfg(test)]
mod tests;
