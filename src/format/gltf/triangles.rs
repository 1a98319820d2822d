//! Triangle primitives: geometry as glTF stores it, in the frame and the pose of the scene.

use glam::{DMat4, Vec2, Vec3};
use gltf::mesh::Mode;

use super::lift::Asset;
use super::motion::Motion;
use super::pose::Poses;
use crate::format::error::Fault;
use crate::format::polygon;
use crate::scene::rig::{RestSurface, Skinning};

/// Extension for compressed triangles, which are read only if accessors have them as well.
const DRACO: &str = "KHR_draco_mesh_compression";

/// Geometry of one primitive at one node.
pub(in crate::format) struct Triangles {
    pub(in crate::format) positions: Vec<Vec3>,
    pub(in crate::format) triangles: Vec<[u32; 3]>,
    /// Texture coordinates of one set, per vertex.
    pub(in crate::format) uvs: Option<Vec<Vec2>>,
    /// Surface before posing.
    pub(super) rest_surface: RestSurface,
    /// Whether the second and third corner of every triangle have been swapped, because the node's transform is a
    /// reflection.
    pub(super) is_mirrored: bool,
    /// Vertices of the file from which these come.
    pub(super) stored: Stored,
}

/// Used subset of a file's vertices.
pub(super) struct Stored {
    /// Number of vertices in the file.
    pub(super) count: usize,
    /// Indices of the used vertices, in order; `None`: all.
    pub(super) kept: Option<Vec<usize>>,
}

impl Triangles {
    /// Removes unused vertices, as occur where parts of a mesh share the vertices of the whole.
    pub(super) fn of_used_vertices(self) -> Self {
        let Self { positions, mut triangles, uvs, rest_surface, is_mirrored, stored } = self;
        let kept = polygon::used(positions.len(), &mut triangles);
        Self {
            positions: kept.iter().map(|&vertex| positions[vertex]).collect(),
            triangles,
            uvs: uvs.map(|uvs| kept.iter().map(|&vertex| uvs[vertex]).collect()),
            rest_surface: rest_surface.gather(&kept),
            is_mirrored,
            stored: Stored { count: stored.count, kept: Some(kept) },
        }
    }

    /// Instance of the triangles at their node: `transform` is the node's global transform, `local` the instance's in
    /// the node's space. The node has no skin.
    pub(in crate::format) fn copy(
        &self,
        poses: &mut Poses,
        (node, transform): (&gltf::Node<'_>, DMat4),
        local: DMat4,
    ) -> Self {
        let skinning = Skinning::Bone(poses.copy(node.index(), local));
        let rest_surface = RestSurface { skinning, ..self.rest_surface.clone() };
        let is_mirrored = (transform * local).determinant() < 0.0;
        let mut triangles = self.triangles.clone();
        if is_mirrored != self.is_mirrored {
            triangles.iter_mut().for_each(|t| t.swap(1, 2));
        }
        let positions = rest_surface.positions(poses.rest());
        let stored = Stored { count: self.stored.count, kept: self.stored.kept.clone() };
        Self { positions, triangles, uvs: self.uvs.clone(), rest_surface, is_mirrored, stored }
    }
}

/// Reads `primitive` of the mesh of `node`, whose global transform is `transform`, with texture coordinates
/// `TEXCOORD_<uv_set>`; `None` if it has no triangles.
pub(in crate::format) fn read(
    (asset, motion): (&Asset, &Motion),
    poses: &mut Poses,
    (node, transform): (&gltf::Node<'_>, DMat4),
    primitive: &gltf::Primitive<'_>,
    uv_set: u32,
    notes: &mut Vec<String>,
) -> Result<Option<Triangles>, Fault> {
    let mesh = node.mesh().map_or(0, |m| m.index());
    let at = format!("/meshes/{mesh}/primitives/{}", primitive.index());
    let is_triangles = matches!(primitive.mode(), Mode::Triangles | Mode::TriangleStrip | Mode::TriangleFan);
    let positions = asset.positions((mesh, primitive.index()), primitive).filter(|_| is_triangles);
    let Some(positions) = positions else { return Ok(None) };
    if primitive.extension_value(DRACO).is_some() && !asset.is_stored(&positions) {
        let expected = "a primitive with its data in accessors";
        return Err(Fault::pointer(
            format!("{at}/extensions/{DRACO}"),
            expected,
            "one that is compressed by Draco alone",
        ));
    }
    let stored = asset.floats::<3>(positions.index())?.into_iter().map(Vec3::from).collect();
    let rest_surface = poses.rest_surface((asset, motion), node, primitive, stored, notes)?;
    let positions = rest_surface.positions(poses.rest());
    let count = u32::try_from(positions.len())
        .map_err(|_| Fault::pointer(&at, "fewer than 2³² vertices", positions.len().to_string()))?;
    let indices = match primitive.indices() {
        Some(accessor) => asset.indices(accessor.index())?,
        None => (0..count).collect(),
    };
    if let Some(bad) = indices.iter().find(|&&i| i >= count) {
        return Err(Fault::pointer(format!("{at}/indices"), format!("indices below {count}"), bad.to_string()));
    }
    let mut triangles: Vec<[u32; 3]> = match primitive.mode() {
        // Every second triangle of a strip has the opposite winding.
        Mode::TriangleStrip => indices
            .windows(3)
            .enumerate()
            .map(|(i, w)| if i % 2 == 0 { [w[0], w[1], w[2]] } else { [w[1], w[0], w[2]] })
            .collect(),
        Mode::TriangleFan => indices.windows(2).skip(1).map(|w| [indices[0], w[0], w[1]]).collect(),
        _ => indices.as_chunks().0.to_vec(),
    };
    let is_mirrored = node.skin().is_none() && transform.determinant() < 0.0;
    if is_mirrored {
        triangles.iter_mut().for_each(|t| t.swap(1, 2));
    }
    let uvs = match primitive.get(&gltf::Semantic::TexCoords(uv_set)) {
        Some(accessor) => Some(asset.floats::<2>(accessor.index())?.into_iter().map(Vec2::from).collect::<Vec<_>>()),
        None => None,
    };
    if let Some(found) = uvs.as_ref().map(Vec::len).filter(|&n| n != positions.len()) {
        return Err(Fault::pointer(
            format!("{at}/attributes/TEXCOORD_{uv_set}"),
            format!("{count} elements"),
            found.to_string(),
        ));
    }
    let stored = Stored { count: positions.len(), kept: None };
    Ok(Some(Triangles { positions, triangles, uvs, rest_surface, is_mirrored, stored }))
}
