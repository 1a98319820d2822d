//! Human-readable tree of a document: nodes, their content and its position.

use std::collections::{BTreeMap, HashMap};

use glam::{DMat4, DVec3};
use serde::Serialize;
use serde_json::Value;

use super::extension::{KHR_SPLATS, SPZ, extension_of};
use super::instancing::{Single, copies};
use super::json::items;
use super::lift::Asset;
use super::motion::{Clip, Motion};
use super::remainder::remainder;
use super::transform::{Placed, all_placements_by, is_ours, local};
use crate::format::error::Fault;
use crate::scene::frame::HALF_TURN;

/// Content of a glTF document.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Document {
    /// `asset.generator`.
    pub generator: Option<String>,
    /// Nodes of the scene, each after its parent.
    pub nodes: Vec<Node>,
    /// Animations that can be played, in order.
    pub animations: Vec<Clip>,
    /// Number of objects of every kind: `meshes`, `materials`, `animations` …
    pub counts: BTreeMap<&'static str, usize>,
    /// Parts that a scene cannot hold, see [`super::Source::remainder`].
    pub remainder: Vec<String>,
}

/// A node of the scene.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Node {
    /// Index in the document.
    pub index: usize,
    /// Number of ancestors.
    pub depth: usize,
    /// Name of the node.
    pub name: Option<String>,
    /// Index of the node's camera.
    pub camera: Option<usize>,
    /// Index of the node's skin.
    pub skin: Option<usize>,
    /// Index of the node's mesh.
    pub mesh: Option<usize>,
    /// Primitives of the node's mesh.
    pub primitives: Vec<Primitive>,
    /// Lowest and highest corner of the node's mesh, including instances, by the declared bounds; y down as in a
    /// capture; without skin and morph targets.
    pub bounds: Option<[[f64; 3]; 2]>,
}

/// Primitive of a mesh.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Primitive {
    /// `splats`, `triangles`, `points` or `lines`.
    pub kind: &'static str,
    /// Number of vertices or splats.
    pub vertices: usize,
    /// Number of triangles, if the primitive has triangles.
    pub triangles: Option<usize>,
    /// SH degree of splats.
    pub sh_degree: Option<u32>,
    /// Colour space of splats.
    pub color_space: Option<String>,
    /// Whether splats are compressed by SPZ.
    pub is_spz: bool,
    /// Index of the primitive's material.
    pub material: Option<usize>,
    /// Number of morph targets.
    pub morph_targets: usize,
}

/// Bytes of a primitive's description, in memory and as text.
const BYTES_OF_PRIMITIVE: u64 = 512;

/// Describes a document. Fails if the node hierarchy is no tree, or if a mesh is at so many nodes that the description
/// of its primitives would be disproportionate.
pub(in crate::format) fn document(asset: &Asset) -> Result<Document, Fault> {
    let mut nodes: Vec<Node> = vec![];
    let mut depths: HashMap<usize, usize> = HashMap::new();
    let is_ours = is_ours(&asset.document);
    let to_capture = if is_ours { DMat4::IDENTITY } else { HALF_TURN };
    let single = Single::of(&asset.root);
    for Placed { node, transform, .. } in all_placements_by(&asset.document, local)? {
        let depth = depths.get(&node.index()).copied().unwrap_or(0);
        depths.extend(node.children().map(|child| (child.index(), depth + 1)));
        let primitives = || node.mesh().into_iter().flat_map(|m| m.primitives().map(move |p| (m.index(), p)));
        let mut boxes: Vec<[DVec3; 2]> = primitives().filter_map(|(m, p)| declared_bounds(asset, m, &p)).collect();
        // Faults of instances are reported where they are read.
        let copies = copies(asset, &single, &node, &mut vec![]).unwrap_or_default();
        if copies.is_some() {
            boxes = boxes.into_iter().reduce(|[a, b], [c, d]| [a.min(c), b.max(d)]).into_iter().collect();
        }
        let places = copies.unwrap_or_else(|| vec![DMat4::IDENTITY]);
        let all = boxes.iter().flat_map(|own| places.iter().map(move |local| (*own, transform * *local)));
        let corners = all.flat_map(|(own, place)| moved(own, to_capture * place));
        let bounds = corners
            .fold(None, |all: Option<[DVec3; 2]>, p| Some(all.map_or([p, p], |[low, high]| [low.min(p), high.max(p)])));
        let described = primitives().map(|(mesh, p)| {
            let primitive = describe(asset, mesh, &p);
            let text = primitive.color_space.as_ref().map_or(0, String::len) as u64;
            asset.spend(BYTES_OF_PRIMITIVE + text, &format!("/nodes/{}", node.index()))?;
            Ok(primitive)
        });
        nodes.push(Node {
            index: node.index(),
            depth,
            name: node.name().map(str::to_owned),
            camera: node.camera().map(|c| c.index()),
            skin: node.skin().map(|s| s.index()),
            mesh: node.mesh().map(|m| m.index()),
            primitives: described.collect::<Result<_, Fault>>()?,
            bounds: bounds.filter(|[low, high]| low.is_finite() && high.is_finite()).map(|b| b.map(|p| p.to_array())),
        });
    }
    let kinds = [
        "scenes",
        "nodes",
        "meshes",
        "materials",
        "textures",
        "images",
        "samplers",
        "cameras",
        "skins",
        "animations",
        "accessors",
        "bufferViews",
        "buffers",
    ];
    let counts = kinds.into_iter().map(|kind| (kind, items(&asset.root, kind).len())).filter(|(_, n)| *n > 0).collect();
    let generator = asset.root.pointer("/asset/generator").and_then(Value::as_str).map(str::to_owned);
    let animations = Motion::read(asset, |_| true).clips().to_vec();
    let remainder = remainder(&asset.root, is_ours).into_iter().map(|part| part.what).collect();
    Ok(Document { generator, nodes, animations, counts, remainder })
}

fn describe(asset: &Asset, mesh: usize, primitive: &gltf::Primitive<'_>) -> Primitive {
    use gltf::mesh::Mode;
    let vertices = asset.positions((mesh, primitive.index()), primitive).map_or(0, |a| a.count());
    let corners = primitive.indices().map_or(vertices, |a| a.count());
    let khr = primitive.extension_value(KHR_SPLATS);
    let (kind, triangles) = match primitive.mode() {
        _ if khr.is_some() => ("splats", None),
        Mode::Triangles => ("triangles", Some(corners / 3)),
        Mode::TriangleStrip | Mode::TriangleFan => ("triangles", Some(corners.saturating_sub(2))),
        Mode::Points => ("points", None),
        Mode::Lines | Mode::LineLoop | Mode::LineStrip => ("lines", None),
    };
    let attributes = asset.attributes.get(&(mesh, primitive.index()));
    let has_degree = |l: u32| {
        let name = format!("{KHR_SPLATS}:SH_DEGREE_{l}_COEF_0");
        attributes.is_some_and(|a| a.contains_key(&name))
    };
    Primitive {
        kind,
        vertices,
        triangles,
        sh_degree: khr.map(|_| (1..=3).take_while(|&l| has_degree(l)).last().unwrap_or(0)),
        color_space: khr.and_then(|k| k.get("colorSpace")?.as_str()).map(str::to_owned),
        is_spz: khr.is_some_and(|k| extension_of(k, SPZ).is_some()),
        material: primitive.material().index(),
        morph_targets: primitive.morph_targets().len(),
    }
}

/// Corners given by `min` and `max` of POSITION, if the file has them.
fn declared_bounds(asset: &Asset, mesh: usize, primitive: &gltf::Primitive<'_>) -> Option<[DVec3; 2]> {
    use gltf::accessor::DataType;
    let accessor = asset.positions((mesh, primitive.index()), primitive)?;
    let scale = match (accessor.normalized(), accessor.data_type()) {
        (true, DataType::I8) => 127.0,
        (true, DataType::U8) => 255.0,
        (true, DataType::I16) => 32767.0,
        (true, DataType::U16) => 65535.0,
        _ => 1.0,
    };
    let corner = |key: &str| -> Option<DVec3> {
        let value = asset.root.get("accessors")?.get(accessor.index())?.get(key)?;
        let numbers: Vec<f64> = value.as_array()?.iter().filter_map(Value::as_f64).collect();
        Some(DVec3::from(<[f64; 3]>::try_from(numbers).ok()?) / scale)
    };
    Some([corner("min")?, corner("max")?])
}

/// Transformed corners of a box.
fn moved([low, high]: [DVec3; 2], transform: DMat4) -> impl Iterator<Item = DVec3> {
    (0..8).map(move |i| {
        let pick = |axis: usize| if i >> axis & 1 == 0 { low[axis] } else { high[axis] };
        transform.transform_point3(DVec3::new(pick(0), pick(1), pick(2)))
    })
}
