//! `UsdGeomMesh` to meshes.

use glam::{DMat3, DMat4, Vec2, Vec3};

use super::document::{Prim, Value, field};
use super::materials::Materials;
use super::names;
use super::stage::Stage;
use crate::format::error::Fault;
use crate::format::gltf::{Similarity, similarity};
use crate::scene::{Atlas, Mesh, Texture, sh};

/// Where the prim lies and which material is bound to it.
pub(super) struct Placed {
    pub(super) prim: usize,
    pub(super) transform: DMat4,
    pub(super) material: Option<usize>,
}

/// A mesh as it is in the file: corners of polygons one after the other.
struct Polygons {
    points: Vec<Vec3>,
    counts: Vec<u32>,
    corners: Vec<u32>,
}

/// `None` if it has no triangle.
pub(super) fn read(
    stage: &Stage<'_>,
    placed: &Placed,
    materials: &mut Materials<'_>,
    notes: &mut Vec<String>,
) -> Result<Option<Mesh>, Fault> {
    let (prim, at) = (placed.prim, stage.path(placed.prim));
    let polygons = polygons(stage, prim)?;
    if stage.text(prim, "subdivisionScheme").unwrap_or("catmullClark") != "none" {
        notes.push(format!("{at}: a subdivision surface is taken as its control mesh"));
    }
    if stage.prims[prim].children.iter().any(|child| child.type_name == "GeomSubset") {
        notes.push(format!("{at}: materials of parts of a mesh are left out, that of the whole is used"));
    }
    let (mut atlas, primvar) = materials.atlas(stage, placed, notes)?;
    let uvs = corner_uvs(stage, prim, &primvar, &polygons)?;
    if uvs.is_none() {
        notes.push(format!("{at}: a mesh without texture coordinates takes its colour from the centre of its maps"));
    }
    let (mut triangles, mut corner_uvs) = (vec![], vec![]);
    let mut first = 0;
    for &count in &polygons.counts {
        let count = count as usize;
        for i in 1..count.saturating_sub(1) {
            let corners = [first, first + i, first + i + 1];
            triangles.push(corners.map(|c| polygons.corners[c]));
            corner_uvs.push(corners.map(|c| uvs.as_ref().map_or(Vec2::splat(0.5), |uvs| uvs[c])));
        }
        first += count;
    }
    if triangles.is_empty() {
        notes.push(format!("{at}: a mesh without triangles is left out"));
        return Ok(None);
    }
    let mut positions = polygons.points;
    if placed.transform != DMat4::IDENTITY {
        positions.iter_mut().for_each(|p| *p = placed.transform.transform_point3(p.as_dvec3()).as_vec3());
        if atlas.sh_degree() > 0 {
            let Some(Similarity { rotation, .. }) = similarity(placed.transform) else {
                let expected = "a rotation, a translation and an even scale above a mesh with view-dependent colour";
                return Err(Fault::pointer(at, expected, "another transform"));
            };
            atlas = turned(&atlas, &sh::Rotation::new(DMat3::from_quat(rotation)))?;
        }
    }
    Ok(Some(Mesh::new(positions, triangles, corner_uvs, atlas)?))
}

fn turned(atlas: &Atlas, harmonics: &sh::Rotation) -> Result<Atlas, Fault> {
    let Some(bands) = atlas.bands() else { return Ok(atlas.clone()) };
    let mut texels = bands.texels().to_vec();
    texels.chunks_exact_mut(bands.channels() as usize).for_each(|texel| harmonics.apply(texel.as_chunks_mut().0));
    Ok(Atlas::new(atlas.base().clone(), Some(Texture::new(bands.width(), bands.height(), bands.channels(), texels)?))?)
}

/// Checked: counts and corners agree, and corners are points.
fn polygons(stage: &Stage<'_>, prim: usize) -> Result<Polygons, Fault> {
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
    Ok(Polygons { points, counts, corners })
}

/// UVs, v downwards, of all corners; `None` if the mesh has none.
fn corner_uvs(stage: &Stage<'_>, prim: usize, primvar: &str, polygons: &Polygons) -> Result<Option<Vec<Vec2>>, Fault> {
    let name = format!("primvars:{primvar}");
    let Some(values) = stage.rows::<2>(prim, &name)? else { return Ok(None) };
    let interpolation = interpolation(stage.prims[prim], &name);
    let indices = stage.indices(prim, &format!("{name}:indices"))?;
    let outside = |index: usize| {
        let at = format!("{}.{name}", stage.path(prim));
        Fault::pointer(at, format!("a value for element {index} of interpolation {interpolation}"), "none")
    };
    let mut uvs = Vec::with_capacity(polygons.corners.len());
    let faces = polygons.counts.iter().enumerate().flat_map(|(f, &n)| std::iter::repeat_n(f, n as usize));
    for ((corner, &vertex), face) in polygons.corners.iter().enumerate().zip(faces) {
        let index = match interpolation {
            "faceVarying" => corner,
            "vertex" | "varying" => vertex as usize,
            "uniform" => face,
            _ => 0,
        };
        let position = match &indices {
            Some(indices) => *indices.get(index).ok_or_else(|| outside(index))? as usize,
            None => index,
        };
        let [u, v] = *values.get(position).ok_or_else(|| outside(index))?;
        uvs.push(Vec2::new(u, 1.0 - v));
    }
    // Of our own files, unless somebody has moved the coordinates since.
    if let Some(exact) = stage.rows::<1>(prim, names::EXACT_V)?.filter(|exact| exact.len() == uvs.len())
        && interpolation == "faceVarying"
        && indices.is_none()
    {
        for ((uv, [v]), [_, stored]) in uvs.iter_mut().zip(exact).zip(&values) {
            if 1.0 - v == *stored {
                uv.y = v;
            }
        }
    }
    Ok(Some(uvs))
}

fn interpolation<'a>(prim: &'a Prim, name: &str) -> &'a str {
    let metadata = prim.property(name).map_or(&[][..], |p| &p.metadata);
    field(metadata, "interpolation").and_then(Value::as_text).unwrap_or("constant")
}
