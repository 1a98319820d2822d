//! Conversion of `UsdGeomMesh` to meshes.

use std::collections::HashMap;

use glam::{DMat4, Vec2, Vec3};

use super::materials::Materials;
use super::names;
use super::primvar::Primvar;
use super::stage::{Placed, Stage};
use crate::format::error::Fault;
use crate::format::placed::{orthogonal, turned};
use crate::format::polygon;
use crate::scene::Mesh;

/// A mesh as it is in the file: corners of polygons one after the other.
struct Polygons {
    points: Vec<Vec3>,
    counts: Vec<u32>,
    corners: Vec<u32>,
    /// Per face, whether it is a hole, which is not drawn.
    holes: Vec<bool>,
}

/// Reads one mesh per material of the prim's faces; meshes without triangles are left out.
pub(super) fn read(
    stage: &Stage<'_>,
    placed: &Placed,
    materials: &mut Materials<'_>,
    notes: &mut Vec<String>,
) -> Result<Vec<Mesh>, Fault> {
    let (prim, at) = (placed.prim, stage.path(placed.prim));
    let mut polygons = polygons(stage, prim, notes)?;
    if stage.text(prim, "subdivisionScheme").unwrap_or("catmullClark") != "none" {
        notes.push(format!("{at}: a subdivision surface is read as its control mesh"));
    }
    if polygons.counts.iter().zip(&polygons.holes).all(|(&count, &is_hole)| count < 3 || is_hole) {
        notes.push(format!("{at}: a mesh without triangles is left out"));
        return Ok(vec![]);
    }
    if placed.skeleton.is_some() {
        notes.push(format!("{at}: bound to a skeleton: shown as bound, not posed"));
    }
    if placed.transform != DMat4::IDENTITY {
        let place = |p: &mut Vec3| *p = placed.transform.transform_point3(p.as_dvec3()).as_vec3();
        polygons.points.iter_mut().for_each(place);
    }
    // All other code assumes counter-clockwise winding seen from the front.
    let is_left_handed = stage.text(prim, "orientation") == Some("leftHanded");
    let is_turned_over = is_left_handed != (placed.transform.determinant() < 0.0);
    let parts = parts(stage, placed, &polygons)?;
    let mut meshes = vec![];
    for Part { material, faces } in &parts {
        let (mut atlas, coordinates) = materials.atlas(stage, placed, *material, notes)?;
        if atlas.sh_degree() > 0 && placed.transform != DMat4::IDENTITY {
            let turn = orthogonal(placed.transform).ok_or_else(|| {
                let expected = "an invertible transform above a mesh with view-dependent colour";
                Fault::pointer(&at, expected, "one without")
            })?;
            atlas = turned(&atlas, turn).map_err(|e| Fault::from(e).under(&at))?;
        }
        let uvs = CornerUvs::of(stage, prim, &coordinates.primvar)?;
        if uvs.is_none() {
            notes
                .push(format!("{at}: a mesh without texture coordinates takes its colour from the centre of its maps"));
        }
        let (mut triangles, mut corner_uvs) = (vec![], vec![]);
        for &Face { index, first, count } in faces {
            let outline: Vec<Vec3> =
                polygons.corners[first..first + count].iter().map(|&v| polygons.points[v as usize]).collect();
            for [a, b, c] in polygon::triangles(&outline) {
                let triangle = if is_turned_over { [a, c, b] } else { [a, b, c] };
                let corners = triangle.map(|corner| first + corner);
                triangles.push(corners.map(|c| polygons.corners[c]));
                let mut of_triangle = [Vec2::splat(0.5); 3];
                if let Some(uvs) = &uvs {
                    for (uv, c) in of_triangle.iter_mut().zip(corners) {
                        *uv = uvs.at(c, polygons.corners[c], index)?;
                    }
                }
                corner_uvs.push(if uvs.is_some() { coordinates.map.corners(of_triangle) } else { of_triangle });
            }
        }
        if uvs.is_some() && coordinates.leave_the_image(&corner_uvs) {
            notes.push(format!(
                "{at}: a texture that is black beyond its borders is extended by its edge there instead"
            ));
        }
        // A mesh with one material keeps its vertices, including unused ones.
        let positions =
            if parts.len() == 1 { polygons.points.clone() } else { used_points(&polygons.points, &mut triangles) };
        if !triangles.is_empty() {
            let (atlas, said) = materials.unrolling.unrolled(&coordinates.map, atlas, &mut corner_uvs);
            notes.extend(said.map(|said| format!("{at}: {said}")));
            let mesh = Mesh::new(positions, triangles, corner_uvs, atlas);
            meshes.push(mesh.map_err(|e| Fault::from(e).under(&at))?);
        }
    }
    Ok(meshes)
}

/// Polygon: its index among the faces, its first corner, and its number of corners.
struct Face {
    index: usize,
    first: usize,
    count: usize,
}

/// Faces of one material.
struct Part {
    material: Option<usize>,
    faces: Vec<Face>,
}

/// Faces other than holes, by material: that of the mesh, and those of its `GeomSubset`s.
fn parts(stage: &Stage<'_>, placed: &Placed, polygons: &Polygons) -> Result<Vec<Part>, Fault> {
    let mut of_face = vec![placed.binding.map(|own| own.material); polygons.counts.len()];
    for child in stage.prims[placed.prim].children.iter().filter(|child| child.type_name == "GeomSubset") {
        let Some((subset, _)) = stage.find(placed.prim, &child.name) else { continue };
        let Some(own) = stage.binding(subset) else { continue };
        let material = own.below(placed.binding).material;
        for face in stage.indices(subset, "indices")?.unwrap_or_default() {
            if let Some(slot) = of_face.get_mut(face as usize) {
                *slot = Some(material);
            }
        }
    }
    let mut parts: Vec<Part> = vec![];
    let mut places: HashMap<Option<usize>, usize> = HashMap::new();
    let mut first = 0;
    for (index, (material, &count)) in of_face.into_iter().zip(&polygons.counts).enumerate() {
        let (here, count) = (first, count as usize);
        first += count;
        if polygons.holes[index] {
            continue;
        }
        let place = *places.entry(material).or_insert_with(|| {
            parts.push(Part { material, faces: vec![] });
            parts.len() - 1
        });
        parts[place].faces.push(Face { index, first: here, count });
    }
    Ok(parts)
}

fn used_points(points: &[Vec3], triangles: &mut [[u32; 3]]) -> Vec<Vec3> {
    polygon::used(points.len(), triangles).into_iter().map(|vertex| points[vertex]).collect()
}

/// Reads polygons, and checks that counts and corners agree and that corners refer to points.
fn polygons(stage: &Stage<'_>, prim: usize, notes: &mut Vec<String>) -> Result<Polygons, Fault> {
    let points: Vec<Vec3> = stage.rows::<3>(prim, "points")?.unwrap_or_default().into_iter().map(Vec3::from).collect();
    let counts = stage.indices(prim, "faceVertexCounts")?.unwrap_or_default();
    let corners = stage.indices(prim, "faceVertexIndices")?.unwrap_or_default();
    let at = |name: &str| format!("{}.{name}", stage.path(prim));
    let total: u64 = counts.iter().map(|&c| u64::from(c)).sum();
    if total != corners.len() as u64 {
        let expected = format!("{total} indices, as faceVertexCounts says");
        return Err(Fault::pointer(at("faceVertexIndices"), expected, corners.len().to_string()));
    }
    if let Some(outside) = corners.iter().find(|&&v| v as usize >= points.len()) {
        let expected = format!("indices below {}", points.len());
        return Err(Fault::pointer(at("faceVertexIndices"), expected, outside.to_string()));
    }
    let mut holes = vec![false; counts.len()];
    let (named, mut astray) = (stage.indices(prim, "holeIndices")?.unwrap_or_default(), 0);
    for &face in &named {
        match holes.get_mut(face as usize) {
            Some(is_hole) => *is_hole = true,
            None => astray += 1,
        }
    }
    if astray > 0 {
        notes.push(format!("{}: {astray} of {} are not faces and are ignored", at("holeIndices"), named.len()));
    }
    Ok(Polygons { points, counts, corners, holes })
}

/// UVs of corners.
struct CornerUvs<'a> {
    primvar: Primvar<'a, 2>,
    /// Exact v of every corner, in our own files.
    exact: Option<Vec<[f32; 1]>>,
}

impl<'a> CornerUvs<'a> {
    /// Reads the UVs; `None` if the mesh has none.
    fn of(stage: &Stage<'a>, prim: usize, primvar: &str) -> Result<Option<Self>, Fault> {
        let Some(primvar) = Primvar::of(stage, prim, &format!("primvars:{primvar}"))? else { return Ok(None) };
        let is_plain = primvar.interpolation == "faceVarying" && primvar.indices.is_none();
        let exact = stage.rows::<1>(prim, names::EXACT_V)?;
        let exact = exact.filter(|exact| is_plain && exact.len() == primvar.values.len());
        Ok(Some(Self { primvar, exact }))
    }

    /// UV of a corner, v downwards.
    fn at(&self, corner: usize, vertex: u32, face: usize) -> Result<Vec2, Fault> {
        let [u, stored] = self.primvar.at(corner, vertex, face)?;
        // Unless the coordinates have been changed since they were written.
        let exact = self.exact.as_ref().map(|exact| exact[corner][0]).filter(|v| 1.0 - v == stored);
        Ok(Vec2::new(u, exact.unwrap_or(1.0 - stored)))
    }
}
