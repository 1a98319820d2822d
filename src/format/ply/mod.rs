//! PLY: the INRIA layout of splats (`save_ply` in `scene/gaussian_model.py`), that of `PlayCanvas`, and coloured points.

mod attribute;
pub mod compressed;
pub(crate) mod table;

use std::io::{BufRead, Seek, Write as _};
use std::ops::Range;
use std::path::Path;

use glam::{DVec3, Quat, Vec3};
use serde::Serialize;

pub use self::attribute::Attribute;
use self::table::{Column, Element, Header, Scalar};
use super::blocks::in_waves;
use super::error::{Fault, FormatError, open_file, shown};
use super::splat_record::{SEEN_IN_3D, SplatRecord};
use super::{ReadOptions, activation, atomic_write_with};
use crate::scene::{PixelFilter, SplatArrays, Splats, sh, smoothed_parameters};

/// Writes splats in the INRIA layout with (zero) normals: binary little endian, float32. `opacity` is a logit, `scale`
/// a natural logarithm, `f_rest` channel-major, `rot` (w, x, y, z). Frame and colour space are the scene's own: the
/// format cannot state them. Returns the file's size in bytes.
///
/// # Errors
/// If the file cannot be written.
pub fn write(path: &Path, splats: &Splats) -> Result<u64, FormatError> {
    write_with(path, splats, &[], PixelFilter::DILATION)
}

/// As [`write()`], followed by what else is known of every splat. That they keep their integral over a picture is said in a comment, as Brush and
/// splat-transform have it: `SplatRenderMode: mip`; and by which variance they are widened in one of our own. A filter that does not
/// keep it is not stated.
///
/// # Errors
/// If the file cannot be written, or an attribute has not as many values as there are splats.
pub fn write_with(
    path: &Path,
    splats: &Splats,
    attributes: &[Attribute],
    pixel_filter: PixelFilter,
) -> Result<u64, FormatError> {
    if let Some(a) = attributes.iter().find(|a| a.values.len() != splats.len()) {
        let expected = format!("{} values of the attribute `{}`", splats.len(), a.name);
        return Err(Fault::whole(expected, a.values.len().to_string()).in_file(path));
    }
    let bands = sh::coefficients(splats.sh_degree()) - 1;
    let names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"].map(str::to_owned).into_iter();
    let names = names
        .chain((0..3 * bands).map(|i| format!("f_rest_{i}")))
        .chain(["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"].map(str::to_owned));
    let names = names.map(|name| ("float", name)).chain(attributes.iter().map(|a| (a.kind.name(), a.name.clone())));
    let properties: String = names.map(|(kind, name)| format!("property {kind} {name}\n")).collect();
    atomic_write_with(path, |out| {
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
    })
}

/// What the comment begins with in which we state the variance of a pixel filter.
const VARIANCE: &str = "Centaur filter variance:";

/// Lines of a header of splats that keep their integral over a picture.
fn filter_comments(filter: PixelFilter) -> String {
    if !filter.normalized {
        return String::new();
    }
    format!("comment SplatRenderMode: mip\ncomment {VARIANCE} {}\n", filter.variance)
}

/// Rows that are encoded as one task: about 1 MB.
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

/// Reads splats in the INRIA layout: ASCII or binary, any scalar types, with or without normals, SH degree 0 to 4, of which 3 are kept, by
/// the number of `f_rest` properties, and flat ones without `scale_2` (2DGS); other properties and elements are ignored, but for `filter_3D` of Mip-Splatting, the standard deviation that each
/// splat is smoothed with, which becomes part of scale and opacity. The layout of [`compressed`] is told by its properties.
///
/// Infinite logits (opacities of exactly 0 or 1, as writers make them from 8-bit alpha) and log-scales of −∞ (scales of
/// 0) become the nearest finite ones.
///
/// # Errors
/// If the file cannot be read, is not such a PLY, is truncated, or holds values that [`Splats::new`] refuses.
pub fn read(path: &Path) -> Result<Splats, FormatError> {
    parse_splats(open_file(path)?).map_err(|fault| fault.in_file(path))
}

/// Splats, and what else a PLY says about them.
#[derive(Clone, Debug, PartialEq)]
pub struct PlySplats {
    /// The splats.
    pub splats: Splats,
    /// Properties that are no parameters, as many values each as there are splats.
    pub attributes: Vec<Attribute>,
    /// What they were trained to be seen with: [`PixelFilter::MIP`] where Mip-Splatting's `filter_3D` is there or Brush says so,
    /// [`PixelFilter::NORMALIZED_DILATION`] where others do, and exactly what Centaur has stated.
    pub pixel_filter: PixelFilter,
    /// What the file has besides, and what was made part of the splats, one sentence each.
    pub notes: Vec<String>,
    /// How many rows were left out, see [`ReadOptions::drop_invalid`]; `None` of a compressed file, which is read whole or not at all.
    pub dropped: Option<usize>,
}

/// As [`read`], with all other scalar properties of the splats but normals, of which a note is made where they are not zero, as of positions in
/// double precision that lose more than a millionth of the scene's size.
///
/// # Errors
/// As [`read`].
pub fn read_with(path: &Path, options: &ReadOptions<'_>) -> Result<PlySplats, FormatError> {
    parse(open_file(path)?, options.drop_invalid).map_err(|fault| fault.in_file(path))
}

/// Reads points: `x y z` and, where present, `red green blue` (8-bit, or float in 0..1; grey otherwise). Their
/// frame is the file's own.
///
/// # Errors
/// If the file cannot be read, is not a PLY with a `vertex` element, is truncated, or a position is not finite.
pub fn read_points(path: &Path) -> Result<Vec<(DVec3, [u8; 3])>, FormatError> {
    parse_points(open_file(path)?).map_err(|fault| fault.in_file(path))
}

/// A table of a PLY.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Table {
    /// `vertex`, `face`, …
    pub name: String,
    /// How many rows its header declares.
    pub rows: usize,
    /// Names of its properties; of lists with their type: `vertex_indices[]`.
    pub properties: Vec<String>,
    /// Lowest and highest `x y z`, of points that are finite.
    pub bounds: Option<[[f32; 3]; 2]>,
}

/// The tables of a PLY, and whether they are those of splats, be they readable or not.
pub(super) fn tables(path: &Path) -> Result<(Vec<Table>, bool), FormatError> {
    let located = |fault: Fault| fault.in_file(path);
    let (header, mut body) = table::open(open_file(path)?).map_err(located)?;
    let is_of_splats = header.element("vertex").is_some_and(|vertex| vertex.scalar("f_dc_0").is_some())
        || compressed::is_compressed(&header);
    let mut tables: Vec<Table> = header.elements().iter().map(Element::describe).collect();
    // Those of splats are told from the splats.
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

pub(super) fn parse_splats(file: impl BufRead + Seek + Send) -> Result<Splats, Fault> {
    parse(file, false).map(|file| file.splats)
}

fn parse(file: impl BufRead + Seek + Send, drop_invalid: bool) -> Result<PlySplats, Fault> {
    let (header, mut body) = table::open(file)?;
    header.repeated_property().map_or(Ok(()), Err)?;
    let mut notes = left_out(&header);
    let pixel_filter = pixel_filter_of(&header, &mut notes);
    if compressed::is_compressed(&header) {
        let splats = compressed::parse(&header, &mut body)?;
        return Ok(PlySplats { splats, attributes: vec![], pixel_filter, notes, dropped: None });
    }
    let vertex = header.required("vertex")?;
    let means = vertex.columns(["x", "y", "z"])?;
    let dc = vertex.columns(["f_dc_0", "f_dc_1", "f_dc_2"])?;
    let [opacity] = vertex.columns(["opacity"])?;
    let scales = vertex.columns(["scale_0", "scale_1"])?;
    let thickness = vertex.column("scale_2");
    if thickness.is_none() {
        notes.push(format!("scale_2 is not there, as of 2DGS: splats are flat, {FLAT:e} thick"));
    }
    if vertex.scalar(BINDING).is_some() {
        notes.push(format!(
            "{BINDING}: of GaussianAvatars: positions, rotations and scales are relative to triangles of a mesh that is not here; they are read as they are"
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
    let (mut attributes, extra) = attribute::of_header(vertex, &parameters);

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
    let splats = arrays.check().map_err(|e| body.locate(&header, "vertex", |i| i, e.into()))?;
    if has_normals {
        notes.push("nx, ny, nz: normals are left out".to_owned());
    }
    if rounding > 1e-6 * diagonal(splats.means()) {
        notes.push(format!("positions in double precision are rounded to single, by {rounding:.1e} at most"));
    }
    Ok(PlySplats { splats, attributes, pixel_filter, notes, dropped: Some(dropped) })
}

/// Of the box around points; 0 of none.
fn diagonal(points: &[Vec3]) -> f64 {
    let start = (Vec3::INFINITY, Vec3::NEG_INFINITY);
    let (low, high) = points.iter().fold(start, |(low, high), &p| (low.min(p), high.max(p)));
    if points.is_empty() { 0.0 } else { (high.as_dvec3() - low.as_dvec3()).length() }
}

/// Thickness of splats that have none.
const FLAT: f32 = 1e-6;

/// `GaussianAvatars`' triangle of a FLAME mesh that a splat hangs on.
const BINDING: &str = "binding_0";

/// Mip-Splatting's standard deviation of the Gaussian that a splat is smoothed with, beside scale and opacity before that.
const FILTER_3D: &str = "filter_3D";

/// Properties of a splat, but for its higher bands.
const PARAMETERS: [&str; 15] = [
    "x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2",
    "rot_3", FILTER_3D,
];

/// How the comments of a header want splats to be seen.
#[derive(Clone, Copy)]
enum Mode {
    Usual,
    /// `SplatRenderMode: mip`, of Brush and of splat-transform, which mean different filters.
    Mip,
    /// Postshot's `antialiased 1`.
    Antialiased,
    /// `SplatRenderMode: 2dgs`.
    Flat,
}

/// What the header says of how splats are to be seen: what Mip-Splatting adds, else the last comment that says so.
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
                "SplatRenderMode mip, by neither Brush nor Centaur: taken as antialiased with 0.3 px², as in SPZ and SOG, not with Mip-Splatting's 0.1"
                    .to_owned(),
            );
            PixelFilter::NORMALIZED_DILATION
        }),
    }
}

/// Which filter *mip* is, if it can be told: splat-transform writes the word for whatever is antialiased.
fn mip_filter_of(header: &Header) -> Option<PixelFilter> {
    let stated =
        header.comments().iter().find_map(|comment| comment.strip_prefix(VARIANCE)?.trim().parse::<f32>().ok());
    if let Some(variance) = stated.filter(|variance| variance.is_finite() && *variance >= 0.0) {
        return Some(PixelFilter { variance, normalized: true });
    }
    let is_of_brush = header.comments().iter().any(|comment| comment.eq_ignore_ascii_case("exported from brush"));
    (is_of_brush || is_of_former_centaur(header)).then_some(PixelFilter::MIP)
}

/// Whether the header is as Centaur wrote it before it stated the variance: that comment alone, which splat-transform has above a table with
/// properties in another order, or of a compressed one below its own name.
fn is_of_former_centaur(header: &Header) -> bool {
    let first = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0"];
    let is_inrias = |vertex: &Element| vertex.scalar_properties().map(|(_, name, _)| name).take(first.len()).eq(first);
    header.comments() == ["SplatRenderMode: mip"]
        && (compressed::is_compressed(header) || header.element("vertex").is_some_and(is_inrias))
}

/// What the file has besides splats: other tables, and lists. Scalars of splats are attributes, of compressed ones left out.
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

/// Columns of `f_rest_0`, `f_rest_1`, …
fn rest_columns(element: &Element) -> Vec<Column> {
    // Beyond twice the most that is accepted it does not matter how many there are.
    (0..90).map_while(|i| element.column(&format!("f_rest_{i}"))).collect()
}

/// SH degree that has `rest` coefficients above the first, in three channels; one more than a scene holds is known.
fn degree_of_rest(rest: usize) -> Result<u32, Fault> {
    (0..=sh::MAX_DEGREE + 1)
        .find(|&d| rest == 3 * (sh::coefficients(d) - 1))
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
        // A float-to-integer cast saturates, and takes NaN to 0.
        let rgb = colours.map_or([128; 3], |columns| columns.map(|c| (row.values[c] * scale).round() as u8));
        points.push((position, rgb));
        Ok(())
    })
}

#[cfg(test)]
mod tests {
    use std::io::Cursor;

    use proptest::prelude::*;

    use super::*;
    use crate::format::test_scenes::random_splats;

    fn written(splats: &Splats) -> Vec<u8> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("s.ply");
        let bytes = write(&path, splats).unwrap();
        let content = std::fs::read(&path).unwrap();
        assert_eq!(bytes, content.len() as u64);
        content
    }

    /// Of splats of degree 3: 2DGS lacks the third scale, others have a band more, `GaussianAvatars` what they hang on.
    #[test]
    fn layouts_near_inrias_are_read_with_a_note() {
        let splats = random_splats(2, 3, 5);
        let plain = written(&splats);
        let end = plain.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
        let header = std::str::from_utf8(&plain[..end]).unwrap();
        let rows: Vec<Vec<f32>> = plain[end..].chunks_exact(62 * 4).map(bytemuck::pod_collect_to_vec).collect();
        let read = |header: &str, rows: Vec<Vec<f32>>| {
            let body: Vec<u8> = rows.concat().iter().flat_map(|v| v.to_le_bytes()).collect();
            let read = parse(Cursor::new([header.as_bytes(), &body].concat()), false).unwrap();
            assert_eq!((read.notes.len(), read.splats.means()), (1, splats.means()), "{:?}", read.notes);
            read
        };
        let flat = header.replace("property float scale_2\n", "");
        let flat = read(&flat, rows.iter().map(|row| [&row[..57], &row[58..]].concat()).collect());
        assert!(flat.notes[0].starts_with("scale_2 is not there, as of 2DGS"), "{:?}", flat.notes);
        for (read, written) in flat.splats.log_scales().iter().zip(splats.log_scales()) {
            assert_eq!(*read, Vec3::new(written.x, written.y, 1e-6f32.ln()));
        }
        let names: String = (45..72).map(|i| format!("property float f_rest_{i}\n")).collect();
        let header_of_4 = header.replace("property float opacity", &format!("{names}property float opacity"));
        let more = rows.iter().map(|row| {
            let channels = (0..3).flat_map(|c| [&row[9 + 15 * c..24 + 15 * c], &[7.0; 9]].concat());
            row[..9].iter().copied().chain(channels).chain(row[54..].iter().copied()).collect()
        });
        let of_4 = read(&header_of_4, more.collect());
        assert_eq!(
            (of_4.notes[0].as_str(), of_4.splats.sh()),
            ("SH bands above degree 3 of 4 are left out", splats.sh())
        );
        assert!(of_4.attributes.is_empty());
        let bound = header.replace("end_header", "property float binding_0\nend_header");
        let bound = read(&bound, rows.iter().map(|row| [&row[..], &[5.0]].concat()).collect());
        assert!(bound.notes[0].starts_with("binding_0: of GaussianAvatars"), "{:?}", bound.notes);
        assert_eq!(bound.attributes[0].values(), [5.0, 5.0]);
    }

    /// As its renderer has it: scales and opacities after the filter of 3-D, pictures by that of 2-D.
    #[test]
    fn mip_splatting_is_read_as_it_is_seen() {
        let splats = random_splats(9, 1, 5);
        let values = (0..9).map(|i| 0.01 * f64::from(i)).collect();
        let filter = Attribute { name: FILTER_3D.to_owned(), kind: Scalar::F32, values };
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("s.ply");
        write_with(&path, &splats, &[filter], PixelFilter::DILATION).unwrap();
        let read = read_with(&path, &ReadOptions::default()).unwrap();
        assert!(
            read.pixel_filter == PixelFilter::MIP && read.attributes.is_empty() && read.notes.len() == 1,
            "{read:?}"
        );
        for i in 0..9 {
            let variance = (0.01 * i as f32).powi(2);
            let [before, after] = [&splats, &read.splats].map(|s| s.log_scales()[i].map(|l| (2.0 * l).exp()));
            assert!((after - before - variance).abs().max_element() < 1e-5 * after.max_element(), "{before} {after}");
            let factor = (before / after).element_product().sqrt();
            let opacity = |s: &Splats| activation::opacity(s.opacity_logits()[i]);
            assert!((opacity(&read.splats) - factor * opacity(&splats)).abs() < 1e-6, "{i}");
        }
    }

    #[test]
    fn what_a_file_has_besides_is_named_and_how_it_is_seen_kept() {
        let splats = random_splats(3, 0, 5);
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("s.ply");
        let time = Attribute { name: "scale_t".to_owned(), kind: Scalar::F32, values: vec![1.0, 2.0, 3.0] };
        write_with(&path, &splats, std::slice::from_ref(&time), PixelFilter::MIP).unwrap();
        let content = std::fs::read(&path).unwrap();
        let text = String::from_utf8_lossy(&content);
        assert!(text.contains("\ncomment SplatRenderMode: mip\ncomment Centaur filter variance: 0.1\n"));
        let end = content.windows(10).position(|w| w == b"end_header").unwrap();
        let more = b"element extrinsic 1\nproperty float a\nelement empty 0\nproperty list uchar int b\n";
        let mut content = [&content[..end], more, &content[end..]].concat();
        content.extend(1.0_f32.to_le_bytes());
        let read = parse(Cursor::new(&content), false).unwrap();
        assert_eq!((read.pixel_filter, &read.attributes[..]), (PixelFilter::MIP, std::slice::from_ref(&time)));
        assert_eq!(read.notes, ["`extrinsic`, 1 of it: left out"]);
    }

    /// `SplatRenderMode: mip` is what others make of every *antialiased*; the last comment counts, as for splat-transform.
    #[test]
    fn comments_say_how_splats_are_seen() {
        let file = written(&random_splats(2, 0, 5));
        let end = file.windows(14).position(|w| w == b"element vertex").unwrap();
        let with = |comments: &str| {
            let lines: String = comments.split_terminator('|').map(|line| format!("comment {line}\n")).collect();
            parse(Cursor::new([&file[..end], lines.as_bytes(), &file[end..]].concat()), false).unwrap()
        };
        let (usual, mip, wide) = (PixelFilter::DILATION, PixelFilter::MIP, PixelFilter::NORMALIZED_DILATION);
        for (comments, expected, note) in [
            ("", usual, ""),
            ("SplatRenderMode: mip", mip, ""),
            ("splatrendermode:  MIP|Exported from Brush", mip, ""),
            ("SplatRenderMode: mip|Generated by splat-transform", wide, "SplatRenderMode mip, by neither Brush"),
            (
                "SplatRenderMode: mip|Centaur filter variance: 0.25",
                PixelFilter { variance: 0.25, normalized: true },
                "",
            ),
            ("SplatRenderMode: mip|Centaur filter variance: NaN", wide, "SplatRenderMode mip, by neither Brush"),
            ("SplatRenderMode: default|Centaur filter variance: 0.25", usual, ""),
            ("antialiased 1", wide, ""),
            ("antialiased 0", usual, ""),
            ("antialiased 1|SplatRenderMode: default", usual, ""),
            ("Exported from Brush|SplatRenderMode: mip|antialiased 0", usual, ""),
            ("SplatRenderMode: default|Antialiased 1", wide, ""),
            ("antialiased 1|SplatRenderMode: banana", wide, "SplatRenderMode `banana`: not known, left out"),
            ("SplatRenderMode: 2dgs", usual, "SplatRenderMode 2dgs: splats are seen as 3DGS has them"),
        ] {
            let read = with(comments);
            assert_eq!(read.pixel_filter, expected, "{comments}");
            assert_eq!(read.notes.len(), usize::from(!note.is_empty()), "{comments}: {:?}", read.notes);
            assert!(read.notes.iter().all(|said| said.starts_with(note)), "{comments}: {:?}", read.notes);
        }
    }

    #[test]
    fn every_filter_that_keeps_integrals_comes_back() {
        let folder = tempfile::tempdir().unwrap();
        let (path, splats) = (folder.path().join("s.ply"), random_splats(2, 0, 5));
        for variance in [0.1, 0.3, 0.123_456_79, 0.0, 2e-9] {
            let filter = PixelFilter { variance, normalized: true };
            write_with(&path, &splats, &[], filter).unwrap();
            let read = read_with(&path, &ReadOptions::default()).unwrap();
            assert_eq!((read.pixel_filter, read.notes.len()), (filter, 0));
            compressed::write_with(&path, &splats, filter).unwrap();
            let read = read_with(&path, &ReadOptions::default()).unwrap();
            assert_eq!((read.pixel_filter, read.notes.len()), (filter, 0));
            // As it was written before; and by splat-transform, of whatever is antialiased.
            let content = std::fs::read(&path).unwrap();
            let text = format!("comment {VARIANCE} {variance}\n");
            let at = content.windows(text.len()).position(|w| w == text.as_bytes()).unwrap();
            for (line, expected) in [
                ("", PixelFilter::MIP),
                ("comment Generated by splat-transform 3.2.0\n", PixelFilter::NORMALIZED_DILATION),
            ] {
                let file = [&content[..at], line.as_bytes(), &content[at + text.len()..]].concat();
                assert_eq!(parse(Cursor::new(file), false).unwrap().pixel_filter, expected);
            }
        }
    }

    #[test]
    fn normals_and_digits_that_are_lost_are_named() {
        let names = ["x", "y", "z", "nx", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2"];
        let notes = |kind: &str, first: &str, second: &str| {
            let properties: String = names.iter().map(|name| format!("property {kind} {name}\n")).collect();
            let text = format!(
                "ply\nformat ascii 1.0\nelement vertex 2\n{properties}property float rot_0\nproperty float rot_1\n\
                 property float rot_2\nproperty float rot_3\nend_header\n{first} 0 0 0 0 0 0 0 1 0 0 0\n{second} 0 0 0 0 0 0 0 1 0 0 0\n"
            );
            parse(Cursor::new(text), false).unwrap().notes
        };
        // Half a unit in the last place is 0.016 m there, of a scene of 1 m.
        let far = ["500000.01 0 0 0", "500001.01 0 0 0"];
        let said = notes("double", far[0], far[1]);
        assert_eq!(said, ["positions in double precision are rounded to single, by 1.0e-2 at most"]);
        assert!(notes("double", "0.01 0 0 0", "1.01 0 0 0").is_empty());
        assert!(notes("float", far[0], far[1]).is_empty(), "text may have more digits than the value");
        assert_eq!(notes("float", "0 0 0 0", "1 0 0 -1"), ["nx, ny, nz: normals are left out"]);
    }

    #[test]
    fn round_trip_is_exact() {
        for degree in 0..=3 {
            let splats = random_splats(17, degree, u64::from(degree));
            let back = parse_splats(Cursor::new(written(&splats))).unwrap();
            assert_eq!(back.means(), splats.means());
            assert_eq!(back.log_scales(), splats.log_scales());
            assert_eq!(back.opacity_logits(), splats.opacity_logits());
            assert_eq!(back.sh(), splats.sh());
            // `Splats::new` normalises once more, which may move the last bit.
            for (a, b) in back.rotations().iter().zip(splats.rotations()) {
                assert!((*a - *b).length() < 2.5e-7, "{a} {b}");
            }
        }
        assert_eq!(parse_splats(Cursor::new(written(&Splats::empty(2)))).unwrap(), Splats::empty(2));
    }

    #[test]
    fn tables_of_one_name_are_read_as_they_follow() {
        let text = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nelement vertex 2\n\
                    property float x\nproperty float y\nproperty float z\nelement note 0\nend_header\n7 8\n1 2 3\n4 5 -6\n";
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("s.ply");
        std::fs::write(&path, text).unwrap();
        let (found, is_of_splats) = tables(&path).unwrap();
        let bounds: Vec<_> = found.iter().map(|table| table.bounds).collect();
        assert_eq!(bounds, [None, Some([[1.0, 2.0, -6.0], [4.0, 5.0, 3.0]]), None]);
        assert!(!is_of_splats);
    }

    #[test]
    fn layout_is_inrias() {
        let splats = random_splats(1, 3, 5);
        let bytes = written(&splats);
        let header_end = bytes.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
        let header = std::str::from_utf8(&bytes[..header_end]).unwrap();
        let names: Vec<&str> = header.lines().filter_map(|l| l.strip_prefix("property float ")).collect();
        assert_eq!(names.len(), 62);
        assert_eq!(
            (names[3], names[9], names[53], names[54], names[61]),
            ("nx", "f_rest_0", "f_rest_44", "opacity", "rot_3")
        );
        let float = |i: usize| f32::from_le_bytes(bytes[header_end + 4 * i..][..4].try_into().unwrap());
        assert_eq!(float(9 + 15), splats.sh_of(0)[1][1], "f_rest is channel-major: 15 red, 15 green, 15 blue");
        assert_eq!(float(58), splats.rotations()[0].w, "rot_0 is w");
    }

    #[test]
    fn ascii_and_big_endian_with_extra_columns_and_lists() {
        let names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2"];
        let properties: String = names.iter().map(|n| format!("property double {n}\n")).collect();
        let header = |format: &str| {
            format!(
                "ply\nformat {format} 1.0\ncomment by hand\nelement face 1\nproperty list uchar int vertex_indices\n\
                 element vertex 1\nproperty uchar extra\n{properties}property float rot_0\nproperty float rot_1\n\
                 property float rot_2\nproperty float rot_3\nend_header\n"
            )
        };
        let values: [f64; 10] = [1.0, 2.0, 3.0, 0.1, 0.2, 0.3, -1.5, -4.0, -5.0, -6.0];
        let ascii = format!("{}3 0 0 0\n7 {} 2 0 0 0", header("ascii"), values.map(|v| v.to_string()).join(" "));
        let mut big = header("binary_big_endian").into_bytes();
        big.push(3);
        big.extend([0; 12]);
        big.push(7);
        values.iter().for_each(|v| big.extend(v.to_be_bytes()));
        [2.0f32, 0.0, 0.0, 0.0].iter().for_each(|v| big.extend(v.to_be_bytes()));
        for file in [ascii.into_bytes(), big] {
            let splats = parse_splats(Cursor::new(file)).unwrap();
            assert_eq!(splats.means(), [Vec3::new(1.0, 2.0, 3.0)]);
            assert_eq!(splats.sh(), [[0.1, 0.2, 0.3]]);
            assert_eq!(splats.opacity_logits(), [-1.5]);
            assert_eq!(splats.rotations(), [Quat::IDENTITY]);
        }
    }

    #[test]
    fn saturated_splats_become_finite() {
        let mut file = written(&random_splats(1, 0, 3));
        let row = file.len() - 17 * 4;
        file[row + 36..row + 40].copy_from_slice(&f32::INFINITY.to_le_bytes());
        file[row + 40..row + 44].copy_from_slice(&f32::NEG_INFINITY.to_le_bytes());
        let splats = parse_splats(Cursor::new(&file)).unwrap();
        assert!((16.0..17.0).contains(&splats.opacity_logits()[0]), "the f32 below 1");
        assert!((-88.0..-87.0).contains(&splats.log_scales()[0].x), "the least normal f32");
        file[row + 36..row + 40].copy_from_slice(&f32::NAN.to_le_bytes());
        assert!(parse_splats(Cursor::new(file)).is_err());
    }

    #[test]
    fn points_with_and_without_colour() {
        let file = b"ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n\
                     property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n1 2 3 4 5 6\n7 8 9 10 11 12\n";
        assert_eq!(
            parse_points(Cursor::new(file)).unwrap(),
            [(DVec3::new(1.0, 2.0, 3.0), [4, 5, 6]), (DVec3::new(7.0, 8.0, 9.0), [10, 11, 12])]
        );
        let plain = b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n\
                      end_header\n1 2 3";
        assert_eq!(parse_points(Cursor::new(plain)).unwrap(), [(DVec3::new(1.0, 2.0, 3.0), [128; 3])]);
    }

    #[test]
    fn messages_name_place_expected_and_found() {
        let message =
            |bytes: &[u8]| parse_splats(Cursor::new(bytes)).unwrap_err().in_file(Path::new("a.ply")).to_string();
        assert_eq!(
            message(b"PK\x03\x04"),
            "a.ply: byte 0: expected a PLY file (starts with `ply`), found something else"
        );
        let mut file = written(&random_splats(3, 0, 1));
        let header = |from: &str, to: &str| {
            let text = String::from_utf8_lossy(&file[..300]).replace(from, to).into_bytes();
            message(&[&text, &file[300..]].concat())
        };
        assert_eq!(
            header("ian 1.0", "ian 2.0"),
            "a.ply: byte 4: expected version 1.0 of the format, found `format binary_little_endian 2.0`"
        );
        let twice = "a.ply: byte 36: expected each property once, found `x` twice";
        assert_eq!(header("property float nx", "property float x "), twice);
        file.truncate(file.len() - 10);
        assert!(
            message(&file).contains("expected 3 rows of `vertex` of at least 68 bytes, found 194 bytes"),
            "{}",
            message(&file)
        );
        assert!(
            message(b"ply\nformat ascii 1.0\nelement vertex 18446744073709551615\nend_header\n")
                .contains("property `x`")
        );
    }

    #[test]
    fn attributes_come_back_under_their_names_and_types() {
        let splats = random_splats(3, 1, 4);
        let attribute =
            |name: &str, kind, values: [f64; 3]| Attribute { name: name.to_owned(), kind, values: values.to_vec() };
        let attributes = vec![
            attribute("label", Scalar::U8, [0.0, 7.0, 255.0]),
            attribute("time", Scalar::F64, [0.1, -2.5e300, f64::MIN_POSITIVE]),
            attribute("shift", Scalar::I16, [-32768.0, 1.0, 32767.0]),
            attribute("confidence", Scalar::F32, [0.25, f64::INFINITY, -1.0]),
        ];
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("s.ply");
        write_with(&path, &splats, &attributes, PixelFilter::DILATION).unwrap();
        let back = read_with(&path, &ReadOptions::default()).unwrap();
        assert_eq!((&back.attributes, back.dropped), (&attributes, Some(0)));
        assert_eq!(back.splats, splats);
        assert_eq!(read(&path).unwrap(), splats, "unknown to others, ignored");

        assert_eq!(attributes[0].gather(&[2, 0]).values(), [255.0, 0.0]);
        let joined = Attribute::join(&[&attributes[2], &attributes[2]]).unwrap();
        assert_eq!((joined.name(), joined.values().len()), ("shift", 6));
        assert!(Attribute::join(&[&attributes[1], &attributes[2]]).is_none());
        assert!(write_with(&path, &random_splats(4, 0, 1), &attributes, PixelFilter::DILATION).is_err());
    }

    #[test]
    fn invalid_rows_are_refused_or_dropped_with_their_attributes() {
        let splats = random_splats(6, 0, 4);
        let order = Attribute { name: "order".to_owned(), kind: Scalar::I32, values: (0..6).map(f64::from).collect() };
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("s.ply");
        write_with(&path, &splats, &[order], PixelFilter::DILATION).unwrap();
        let mut file = std::fs::read(&path).unwrap();
        let first_row = file.len() - 6 * 18 * 4;
        // A mean, a colour, an opacity; and a quaternion of zeros.
        for (row, column, value) in [(0, 1, f32::NAN), (2, 6, f32::INFINITY), (3, 9, f32::NAN)] {
            file[first_row + 4 * (18 * row + column)..][..4].copy_from_slice(&value.to_le_bytes());
        }
        file[first_row + 4 * (18 * 5 + 13)..][..16].fill(0);
        assert!(parse(Cursor::new(&file), false).is_err());
        let left = parse(Cursor::new(&file), true).unwrap();
        assert_eq!((left.dropped, left.attributes[0].values()), (Some(4), &[1.0, 4.0][..]));
        assert_eq!(left.splats.means(), [splats.means()[1], splats.means()[4]]);
    }

    proptest! {
        #[test]
        fn damaged_files_do_not_panic(cut in 0usize..2000, at in 0usize..2000, byte: u8, degree in 0u32..4) {
            let mut file = written(&random_splats(3, degree, 9));
            file.truncate(cut.max(1));
            let at = at % file.len();
            file[at] = byte;
            let _ = parse_splats(Cursor::new(&file));
            let _ = parse_points(Cursor::new(&file));
        }
    }
}
