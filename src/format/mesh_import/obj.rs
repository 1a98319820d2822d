//! Wavefront OBJ: positions, texture coordinates and faces. All other content is ignored.

use std::collections::HashMap;
use std::str::SplitAsciiWhitespace;

use glam::{Vec2, Vec3};

use super::Soup;
use crate::format::error::{Fault, Location, shown};
use crate::format::polygon;

/// OBJ file while being read. Indices may refer to later elements, so they are resolved at the end.
#[derive(Default)]
struct Obj {
    positions: Vec<Vec3>,
    texcoords: Vec<Vec2>,
    /// Indices of position and, if present, texture coordinate of the corners of all faces, consecutively.
    corners: Vec<(u32, Option<u32>)>,
    /// Number of corners of each face, and its offset in the file.
    faces: Vec<(usize, usize)>,
}

pub(super) fn parse(bytes: &[u8]) -> Result<Soup, Fault> {
    let (mut obj, mut soup) = (Obj::default(), Soup::default());
    let (mut names, mut material) = (HashMap::<String, usize>::new(), None);
    // Windows editors write a byte order mark before the first word.
    let text = bytes.strip_prefix("\u{feff}".as_bytes()).unwrap_or(bytes);
    let (mut offset, mut start, mut line) = (bytes.len() - text.len(), 0, String::new());
    for raw in text.split_inclusive(|&b| b == b'\n').chain([&b""[..]]) {
        if line.is_empty() {
            start = offset;
        }
        offset += raw.len();
        let text = String::from_utf8_lossy(raw);
        // A backslash does not continue a comment: exporters write Windows folders in comments.
        let is_comment = line.is_empty() && text.trim_start().starts_with('#');
        if let Some(begun) = text.trim_end().strip_suffix('\\').filter(|_| !is_comment) {
            line.push_str(begun);
            line.push(' ');
            continue;
        }
        line.push_str(&text);
        let mut words = line.split_ascii_whitespace();
        match words.next() {
            Some("v") => {
                let position = Vec3::from(numbers(&mut words, start, &line)?);
                if !position.is_finite() {
                    soup.unusable.push((obj.positions.len() as u32, Location::Byte(start as u64)));
                }
                obj.positions.push(position);
            }
            Some("vt") => {
                let [u] = numbers(&mut words, start, &line)?;
                let [v] = if words.clone().next().is_some() { numbers(&mut words, start, &line)? } else { [0.0] };
                // OBJ has v upwards.
                obj.texcoords.push(Vec2::new(u, 1.0 - v));
            }
            Some("usemtl") => {
                let count = names.len();
                let name = words.collect::<Vec<_>>().join(" ");
                material = Some(*names.entry(name).or_insert(count));
            }
            Some("f") => {
                obj.face(words, start)?;
                soup.materials.insert(material);
            }
            _ => {}
        }
        line.clear();
    }
    soup.faces = Some(Location::Byte(offset as u64));
    obj.finish(soup)
}

/// Parses the next words as numbers.
fn numbers<const N: usize>(words: &mut SplitAsciiWhitespace<'_>, start: usize, line: &str) -> Result<[f32; N], Fault> {
    let mut values = [0.0; N];
    for value in &mut values {
        let number = words.next().and_then(|word| word.parse().ok());
        let fault = || Fault::byte(start, "coordinates as in an OBJ", shown(line.trim_end().as_bytes()));
        *value = number.ok_or_else(fault)?;
    }
    Ok(values)
}

impl Obj {
    fn face(&mut self, words: SplitAsciiWhitespace<'_>, start: usize) -> Result<(), Fault> {
        let before = self.corners.len();
        for word in words {
            let mut parts = word.split('/');
            let vertex = parts.next().and_then(|text| index(text, self.positions.len()));
            let texcoord = parts.next().filter(|text| !text.is_empty());
            let texcoord = texcoord.map(|text| index(text, self.texcoords.len()));
            let (Some(vertex), Some(texcoord)) = (vertex, texcoord.map_or(Some(None), |t| t.map(Some))) else {
                return Err(Fault::byte(start, "a face of indices as in an OBJ", shown(word.as_bytes())));
            };
            self.corners.push((vertex, texcoord));
        }
        self.faces.push((self.corners.len() - before, start));
        Ok(())
    }

    /// Triangulates polygons. Points and lines are dropped.
    fn finish(self, mut soup: Soup) -> Result<Soup, Fault> {
        let uv = |i: u32| self.texcoords.get(i as usize).copied().unwrap_or(Vec2::NAN);
        let mut rest = &self.corners[..];
        for &(count, place) in &self.faces {
            let (corners, after) = rest.split_at(count);
            rest = after;
            let position = |&(v, _): &(u32, _)| self.positions.get(v as usize).copied().ok_or(v);
            let outline = corners.iter().map(position).collect::<Result<Vec<_>, _>>().map_err(|bad| {
                let expected = format!("a face of the {} vertices in the OBJ", self.positions.len());
                Fault::byte(place, expected, format!("vertex {}", u64::from(bad) + 1))
            })?;
            for triangle in polygon::triangles(&outline) {
                let corners = triangle.map(|corner| corners[corner]);
                soup.triangles.push(corners.map(|(vertex, _)| vertex));
                soup.corner_uvs.push(match corners.map(|(_, texcoord)| texcoord) {
                    [Some(a), Some(b), Some(c)] => Some([a, b, c].map(uv)),
                    _ => None,
                });
            }
        }
        soup.positions = self.positions;
        Ok(soup)
    }
}

/// Resolves an index, counted from 1, or from −1 backwards from the last of `count` elements.
fn index(text: &str, count: usize) -> Option<u32> {
    let i: i64 = text.parse().ok()?;
    let i = if i < 0 { i64::try_from(count).ok()?.checked_add(i)? } else { i - 1 };
    u32::try_from(i).ok()
}
