//! Writer of meshes as PLY, which has UVs per vertex only.

use std::collections::HashMap;
use std::io::Write as _;
use std::path::Path;

use glam::{Vec2, Vec3};

use crate::format::{FormatError, atomic_write_with};
use crate::scene::Mesh;

/// Writes a mesh as binary little-endian PLY: vertices `x y z s t` (float32), faces `list uchar int vertex_indices` of
/// three, in the order of the mesh's triangles. `t` is v downwards: (0, 0) is the top left of the maps. A vertex is
/// written once per distinct UV of its corners; unused vertices are left out. Returns the file's size.
pub(super) fn write(path: &Path, mesh: &Mesh) -> Result<u64, FormatError> {
    let (vertices, triangles) = split(mesh);
    let vertices: Vec<(Vec3, Vec2)> = vertices.into_iter().map(|(v, uv)| (mesh.positions()[v as usize], uv)).collect();
    atomic_write_with(path, |out| {
        let properties: String = ["x", "y", "z", "s", "t"].map(|name| format!("property float {name}\n")).concat();
        write!(out, "ply\nformat binary_little_endian 1.0\nelement vertex {}\n{properties}", vertices.len())?;
        write!(out, "element face {}\nproperty list uchar int vertex_indices\nend_header\n", triangles.len())?;
        for (p, uv) in &vertices {
            [p.x, p.y, p.z, uv.x, uv.y].iter().try_for_each(|v| out.write_all(&v.to_le_bytes()))?;
        }
        triangles.iter().try_for_each(|corners| {
            out.write_all(&[3])?;
            corners.iter().try_for_each(|v| out.write_all(&v.to_le_bytes()))
        })
    })
}

/// Per vertex of the file, the index of the mesh's vertex of which it is a copy.
pub(in crate::format) fn copied(mesh: &Mesh) -> Vec<usize> {
    split(mesh).0.into_iter().map(|(vertex, _)| vertex as usize).collect()
}

/// Splits vertices at UV seams: one vertex per distinct (vertex, UV) pair of the corners, in order of first use.
fn split(mesh: &Mesh) -> (Vec<(u32, Vec2)>, Vec<[u32; 3]>) {
    let mut vertices = vec![];
    let mut known: HashMap<(u32, [u32; 2]), u32> = HashMap::new();
    let triangles = mesh.triangles().iter().zip(mesh.corner_uvs()).map(|(corners, uvs)| {
        std::array::from_fn(|c| {
            let (position, uv) = (corners[c], uvs[c]);
            *known.entry((position, uv.to_array().map(f32::to_bits))).or_insert_with(|| {
                vertices.push((position, uv));
                vertices.len() as u32 - 1
            })
        })
    });
    let triangles = triangles.collect();
    (vertices, triangles)
}
