//! Reading of splats in the INRIA layout, and of what their file says besides.

use std::io::{BufRead, Seek};
use std::slice::ChunksExact;

use super::audit::Audit;
use super::compressed;
use super::filter::pixel_filter_of;
use super::layout::{Layout, NORMALS, is_begun, is_meant};
use super::table::{self, Body, Column, Element, Header};
use crate::format::SplatFile;
use crate::format::attribute::Attribute;
use crate::format::error::{Fault, shown};
use crate::format::splat_record::DROPPING;
use crate::scene::{SceneError, SplatArrays};

/// Parses a file of splats; `drop_invalid` leaves out those that no scene holds.
pub(super) fn parse(file: impl BufRead + Seek + Send, drop_invalid: bool) -> Result<SplatFile, Fault> {
    let (header, mut body) = table::open(file)?;
    header.repeated_property().map_or(Ok(()), Err)?;
    let is_compressed = compressed::is_compressed(&header);
    let mut notes = left_out(&header, is_compressed);
    let pixel_filter = pixel_filter_of(&header, is_compressed, &mut notes);
    if is_compressed {
        let splats = compressed::parse(&header, &mut body)?;
        return Ok(SplatFile { pixel_filter, notes, ..SplatFile::of(splats) });
    }
    let vertex = header.required("vertex")?;
    something_else(&header, vertex).map_or(Ok(()), Err)?;
    let layout = Layout::of(vertex)?;
    notes.extend(layout.notes(vertex));
    let start = |count| Rows::with_capacity(count, &layout, vertex);
    let rows = body.blocks(&header, "vertex", start, |rows, block| {
        if drop_invalid {
            rows.add_valid(block);
        } else {
            rows.add(block);
        }
        Ok(())
    })?;
    let Rows { arrays, attributes, audit, dropped, .. } = rows;
    let splats = arrays.check().map_err(|e| invalid(&header, &mut body, &layout, e))?;
    notes.extend(audit.notes(splats.means()));
    Ok(SplatFile { splats, attributes, pixel_filter, notes, dropped: Some(dropped) })
}

/// Notes on content besides splats: other tables, and lists. Scalars of splats are attributes; those of compressed
/// splats are left out.
fn left_out(header: &Header, is_compressed: bool) -> Vec<String> {
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

/// What a PLY is where its vertices have places and nothing of splats.
fn something_else(header: &Header, vertex: &Element) -> Option<Fault> {
    let has_place = ["x", "y", "z"].iter().all(|name| vertex.scalar(name).is_some());
    (has_place && !is_begun(vertex)).then(|| {
        let faces = header.element("face").map_or(0, |face| face.count);
        let found =
            if faces > 0 { format!("a mesh, no splats (`face`: {faces})") } else { "points, no splats".to_owned() };
        Fault::byte(vertex.at, "splats, with `f_dc_0` and more", found)
    })
}

/// Splats, and what else their rows hold, while these are read.
struct Rows<'a> {
    layout: &'a Layout,
    arrays: SplatArrays,
    attributes: Vec<Attribute>,
    /// Columns of `attributes`.
    columns: Vec<Column>,
    audit: Audit,
    /// Number of splats left out.
    dropped: usize,
}

impl<'a> Rows<'a> {
    fn with_capacity(count: usize, layout: &'a Layout, vertex: &Element) -> Self {
        let (mut attributes, columns) = further_attributes(vertex, layout);
        attributes.iter_mut().for_each(|a| a.values.reserve_exact(count));
        let arrays = SplatArrays::with_capacity(count, layout.sh_degree());
        Self { layout, arrays, attributes, columns, audit: Audit::of(vertex), dropped: 0 }
    }

    /// Adds the splats of all rows.
    fn add(&mut self, rows: ChunksExact<'_, u8>) {
        let (layout, rows) = (self.layout, rows.collect::<Vec<&[u8]>>());
        self.arrays.extend(rows.len(), |i| layout.decode(rows[i]));
        rows.into_iter().for_each(|row| self.add_beside(row));
    }

    /// Adds those splats that a scene may hold.
    fn add_valid(&mut self, rows: ChunksExact<'_, u8>) {
        for row in rows {
            if self.arrays.push_valid(&self.layout.decode(row)) {
                self.add_beside(row);
            } else {
                self.dropped += 1;
            }
        }
    }

    /// Adds what a row has besides its splat.
    fn add_beside(&mut self, row: &[u8]) {
        self.audit.look(row);
        self.attributes.iter_mut().zip(&self.columns).for_each(|(a, column)| a.values.push(column.f64(row)));
    }
}

/// Scalar properties of `vertex` of which neither splats nor normals are made, without values, and their columns.
fn further_attributes(vertex: &Element, layout: &Layout) -> (Vec<Attribute>, Vec<Column>) {
    let extra = vertex.scalar_properties().filter(|(_, name, _)| !NORMALS.contains(name) && !layout.reads(name));
    extra.map(|(column, name, kind)| (Attribute { name: name.to_owned(), kind, values: vec![] }, column)).unzip()
}

/// What is wrong with a splat that no scene holds: where its row begins, and as the validator says it, by row and
/// property.
fn invalid(header: &Header, body: &mut Body<impl BufRead + Seek>, layout: &Layout, error: SceneError) -> Fault {
    let fault = Fault::from(error);
    let Some((field, row)) = fault.element() else { return fault };
    let at = body.locate(header, "vertex", |i| i, fault.clone()).location;
    let Fault { expected, found, .. } = fault;
    let fault = match not_finite(header, body, layout, row) {
        Some((name, value)) => Fault::at(at, "finite numbers", format!("{value} in row {row} of `{name}`")),
        None if field == "rotations" => Fault::at(at, expected, format!("{found} in row {row} of `rot_0` to `rot_3`")),
        None => Fault::at(at, expected, format!("{found} in row {row}")),
    };
    fault.with_advice(DROPPING)
}

/// The first parameter of a row that is not finite in single precision, unless reading knows what it means, and its
/// value.
fn not_finite(
    header: &Header,
    body: &mut Body<impl BufRead + Seek>,
    layout: &Layout,
    wanted: usize,
) -> Option<(String, String)> {
    let names = header.element("vertex")?.scalar_names();
    let is_at_fault =
        |name: &str, value: f64| layout.reads(name) && !(value as f32).is_finite() && !is_meant(name, value);
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
