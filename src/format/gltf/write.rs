//! Layout of a hybrid scene as JSON and one binary chunk.

use std::borrow::Cow;
use std::collections::HashMap;

use glam::{DQuat, Vec2, Vec3};
use image::ExtendedColorType;
use serde_json::{Value, json};

use super::container::Bin;
use super::extension::{
    EXTRAS, ExactCamera, HYBRID, KHR_SPLATS, Khr, OPACITY, OpacityField, ROOT_NODE, ROTATION, Radiance, SCALE,
    SceneContract, ShField, Surface, TexelSource, UNLIT, sh_attributes,
};
use crate::format::{activation, preview};
use crate::scene::{Atlas, Camera, ColorSpace, HybridScene, Mesh, Splats, Texture, frame, sh};

pub(super) const FLOAT: u32 = 5126;
const UNSIGNED_SHORT: u32 = 5123;
const UNSIGNED_INT: u32 = 5125;
const ARRAY_BUFFER: u32 = 34962;
const ELEMENT_ARRAY_BUFFER: u32 = 34963;

/// Creates the document and its binary chunk, whose content is generated while it is written.
pub(super) fn layout<'a>(
    scene: &'a HybridScene,
    cameras: &[(String, Camera)],
    extras: Option<Value>,
) -> (Value, Bin<'a>) {
    let mut out = Layout::default();
    let space = scene.composition.color_space;
    let mut children = vec![];
    for (i, mesh) in scene.meshes.iter().enumerate() {
        let index = out.mesh(mesh, space);
        children.push(out.node(json!({ "name": format!("mesh_{i}"), "mesh": index })));
    }
    if !scene.splats.is_empty() {
        let index = out.splats(&scene.splats, space);
        children.push(out.node(json!({ "name": "splats", "mesh": index })));
    }
    for (name, camera) in cameras {
        children.push(out.camera(name, camera, scene.composition.near));
    }
    let mut root = json!({
        "name": ROOT_NODE,
        // Half a turn about x: the capture's y-down world appears upright in y-up viewers. The data below stay
        // unchanged.
        "rotation": [1, 0, 0, 0],
        "extras": { EXTRAS: { "frame": "capture" } },
    });
    if !children.is_empty() {
        root["children"] = json!(children);
    }
    let root = out.node(root);
    let contract = json!({ HYBRID: SceneContract::new(&scene.composition) });
    let scenes = json!([{ "nodes": [root], "extensions": contract }]);

    out.finish(&scenes, extras, scene)
}

/// Document under construction: its arrays, and the binary chunk to which they refer.
#[derive(Default)]
struct Layout<'a> {
    nodes: Vec<Value>,
    meshes: Vec<Value>,
    materials: Vec<Value>,
    cameras: Vec<Value>,
    images: Vec<Value>,
    accessors: Vec<Value>,
    views: Vec<Value>,
    bin: Bin<'a>,
}

impl<'a> Layout<'a> {
    fn node(&mut self, node: Value) -> usize {
        self.nodes.push(node);
        self.nodes.len() - 1
    }

    /// Adds a buffer view of bytes.
    fn view(&mut self, target: Option<u32>, bytes: Vec<u8>) -> usize {
        let length = bytes.len();
        let start = self.bin.push(bytes);
        self.view_of(target, start, length)
    }

    /// Adds a buffer view of `count` rows of `stride` bytes; `row` appends one row.
    fn rows(
        &mut self,
        target: Option<u32>,
        (count, stride): (usize, usize),
        row: impl Fn(usize, &mut Vec<u8>) + Sync + 'a,
    ) -> usize {
        let start = self.bin.push_rows(count, stride, row);
        self.view_of(target, start, count * stride)
    }

    fn view_of(&mut self, target: Option<u32>, start: usize, length: usize) -> usize {
        let mut view = json!({ "buffer": 0, "byteOffset": start, "byteLength": length });
        if let Some(target) = target {
            view["target"] = json!(target);
        }
        self.views.push(view);
        self.views.len() - 1
    }

    fn accessor(&mut self, view: usize, component: u32, kind: &str, count: usize) -> usize {
        self.accessors.push(json!({ "bufferView": view, "componentType": component, "type": kind, "count": count }));
        self.accessors.len() - 1
    }

    /// Adds an accessor of rows of N floats.
    fn floats<const N: usize>(
        &mut self,
        target: Option<u32>,
        count: usize,
        row: impl Fn(usize) -> [f32; N] + Sync + 'a,
    ) -> usize {
        let append =
            move |i, bytes: &mut Vec<u8>| row(i).iter().for_each(|v| bytes.extend_from_slice(&v.to_le_bytes()));
        let view = self.rows(target, (count, 4 * N), append);
        self.accessor(view, FLOAT, ["SCALAR", "VEC2", "VEC3", "VEC4"][N - 1], count)
    }

    /// Adds a vertex attribute.
    fn attribute<const N: usize>(&mut self, count: usize, row: impl Fn(usize) -> [f32; N] + Sync + 'a) -> usize {
        self.floats(Some(ARRAY_BUFFER), count, row)
    }

    /// Adds POSITION, with the bounds that glTF requires.
    fn positions(&mut self, positions: Cow<'a, [Vec3]>) -> usize {
        let low = positions.iter().copied().reduce(Vec3::min).unwrap_or_default();
        let high = positions.iter().copied().reduce(Vec3::max).unwrap_or_default();
        let index = self.attribute(positions.len(), move |i| positions[i].to_array());
        self.accessors[index]["min"] = json!(low.to_array());
        self.accessors[index]["max"] = json!(high.to_array());
        index
    }

    fn splats(&mut self, splats: &'a Splats, space: ColorSpace) -> usize {
        let n = splats.len();
        let mut attributes = serde_json::Map::new();
        let mut add = |name: &str, accessor: usize| attributes.insert(name.to_owned(), json!(accessor));
        add("POSITION", self.positions(splats.means().into()));
        add(ROTATION, self.attribute(n, |i| splats.rotations()[i].to_array()));
        add(SCALE, self.attribute(n, |i| splats.log_scales()[i].to_array().map(activation::scale)));
        let opacity = |i: usize| activation::opacity(splats.opacity_logits()[i]);
        add(OPACITY, self.attribute(n, move |i| [opacity(i)]));
        for (k, name) in sh_attributes(splats.sh_degree()).enumerate() {
            add(&name, self.attribute(n, move |i| splats.sh_of(i)[k]));
        }
        // Colours for viewers without the extension. COLOR_0 is linear light, regardless of the splats' colour space.
        let color_view = self.rows(Some(ARRAY_BUFFER), (n, 8), move |i, bytes| {
            let rgb = sh::rgb_from_dc(splats.sh_of(i)[0]).map(|c| c.clamp(0.0, 1.0));
            for c in space.to_linear(rgb).into_iter().chain([opacity(i)]) {
                bytes.extend_from_slice(&((c * 65535.0).round() as u16).to_le_bytes());
            }
        });
        let color = self.accessor(color_view, UNSIGNED_SHORT, "VEC4", n);
        self.accessors[color]["normalized"] = json!(true);
        add("COLOR_0", color);

        let khr = Khr {
            kernel: Some("ellipse".to_owned()),
            color_space: Some(space.name().to_owned()),
            projection: None,
            extensions: serde_json::Map::new(),
        };
        self.meshes.push(json!({
            "name": "splats",
            "primitives": [{ "mode": 0, "attributes": attributes, "extensions": { KHR_SPLATS: khr } }],
        }));
        self.meshes.len() - 1
    }

    fn mesh(&mut self, mesh: &'a Mesh, space: ColorSpace) -> usize {
        let split = split_at_seams(mesh);
        let positions: Vec<Vec3> = split.surface_vertices.iter().map(|&v| mesh.positions()[v as usize]).collect();
        let mut attributes = serde_json::Map::new();
        attributes.insert("POSITION".to_owned(), json!(self.positions(positions.into())));
        let uvs = split.uvs;
        let uvs = self.attribute(uvs.len(), move |i| uvs[i].to_array());
        attributes.insert("TEXCOORD_0".to_owned(), json!(uvs));
        let mut integers = |target: Option<u32>, values: &[u32]| {
            let view = self.view(target, values.iter().flat_map(|v| v.to_le_bytes()).collect());
            self.accessor(view, UNSIGNED_INT, "SCALAR", values.len())
        };
        let indices = integers(Some(ELEMENT_ARRAY_BUFFER), split.triangles.as_flattened());
        let surface = Surface { surface_vertices: Some(integers(None, &split.surface_vertices)), ..Surface::default() };
        let material = self.material(mesh.atlas(), space);
        let index = self.meshes.len();
        self.meshes.push(json!({
            "name": format!("mesh_{index}"),
            "primitives": [{
                "attributes": attributes,
                "indices": indices,
                "material": material,
                "extensions": { HYBRID: surface },
            }],
        }));
        index
    }

    fn material(&mut self, atlas: &'a Atlas, space: ColorSpace) -> usize {
        let base = atlas.base();
        let view = self.view(None, preview_png(atlas, space));
        self.images.push(json!({ "bufferView": view, "mimeType": "image/png" }));
        // Image i is texture i; all textures share one sampler.
        let texture = self.images.len() - 1;

        let source = |map: &Texture, accessor: usize| TexelSource {
            accessor: Some(accessor),
            width: Some(map.width()),
            height: Some(map.height()),
            sampler: Some(0),
            ..TexelSource::default()
        };
        let count = |map: &Texture| map.width() as usize * map.height() as usize;
        let texel = |map: &'a Texture, i: usize| &map.texels()[i * map.channels() as usize..];
        let rgb = |map: &'a Texture, first: usize| {
            move |i: usize| *texel(map, i)[first..].first_chunk::<3>().expect("three channels of a coefficient")
        };
        let mut coefficients = vec![source(base, self.floats(None, count(base), rgb(base, 0)))];
        let logits = source(base, self.floats(None, count(base), move |i| [texel(base, i)[3]]));
        if let Some(bands) = atlas.bands() {
            for first in (0..bands.channels() as usize).step_by(3) {
                coefficients.push(source(bands, self.floats(None, count(bands), rgb(bands, first))));
            }
        }
        let radiance = Radiance {
            color_space: space.name().to_owned(),
            opacity: Some(OpacityField { source: logits, activation: "logistic".to_owned() }),
            spherical_harmonics: Some(ShField { degree: atlas.sh_degree(), frame: "node".to_owned(), coefficients }),
        };
        self.materials.push(json!({
            "alphaMode": "BLEND",
            "doubleSided": true,
            "pbrMetallicRoughness": {
                "baseColorTexture": { "index": texture },
                "metallicFactor": 0,
                "roughnessFactor": 1,
            },
            "extensions": { UNLIT: {}, HYBRID: radiance },
        }));
        self.materials.len() - 1
    }

    /// Adds a camera and its node; returns the node.
    fn camera(&mut self, name: &str, camera: &Camera, near: f32) -> usize {
        let (camera, node) = camera_and_node(name, camera, near, self.cameras.len());
        self.cameras.push(camera);
        self.node(node)
    }

    /// Complete document and binary chunk. Empty arrays are left out, because glTF forbids them.
    fn finish(self, scenes: &Value, extras: Option<Value>, scene: &HybridScene) -> (Value, Bin<'a>) {
        let mut used = vec![HYBRID];
        if !scene.splats.is_empty() {
            used.push(KHR_SPLATS);
        }
        if !scene.meshes.is_empty() {
            used.push(UNLIT);
        }
        let mut asset = json!({ "version": "2.0", "generator": concat!("Centaur ", env!("CARGO_PKG_VERSION")) });
        if let Some(extras) = extras {
            asset["extras"] = json!({ EXTRAS: extras });
        }
        let mut document = json!({ "asset": asset, "extensionsUsed": used, "scene": 0, "scenes": scenes });
        let textures: Vec<Value> = (0..self.images.len()).map(|i| json!({ "source": i, "sampler": 0 })).collect();
        if !textures.is_empty() {
            // Trilinear and clamped, as during the optimisation of the maps.
            document["samplers"] = json!([{ "magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071 }]);
        }
        let arrays = [
            ("nodes", self.nodes),
            ("meshes", self.meshes),
            ("materials", self.materials),
            ("textures", textures),
            ("images", self.images),
            ("cameras", self.cameras),
            ("accessors", self.accessors),
            ("bufferViews", self.views),
        ];
        for (name, array) in arrays.into_iter().filter(|(_, array)| !array.is_empty()) {
            document[name] = Value::Array(array);
        }
        if self.bin.len() > 0 {
            document["buffers"] = json!([{ "byteLength": self.bin.len() }]);
        }
        (document, self.bin)
    }
}

/// JSON of a camera, which will have this index, and of its node.
pub(super) fn camera_and_node(name: &str, camera: &Camera, near: f32, index: usize) -> (Value, Value) {
    let k = camera.intrinsics();
    let exact = ExactCamera {
        width: k.width,
        height: k.height,
        fx: k.fx,
        fy: k.fy,
        cx: k.cx,
        cy: k.cy,
        rotation: Some(camera.rotation().transpose().to_cols_array()),
        translation: Some(camera.translation().to_array()),
    };
    let [width, height] = k.size().to_array();
    let optics = json!({
        "name": name,
        "type": "perspective",
        "perspective": {
            "yfov": k.fov_y(),
            "aspectRatio": (width * k.fy) / (height * k.fx),
            "znear": near,
        },
        "extras": { EXTRAS: exact },
    });
    let node = json!({
        "name": name,
        "camera": index,
        "rotation": node_rotation(camera).to_array(),
        "translation": camera.center().to_array(),
    });
    (optics, node)
}

/// Rotation of the node that a camera is at.
pub(super) fn node_rotation(camera: &Camera) -> DQuat {
    DQuat::from_mat3(&frame::node_of_camera(camera)).normalize()
}

/// Mesh with one UV per vertex.
struct Split {
    /// Surface vertex of each glTF vertex. The first V are the surface's own, in order; copies follow.
    surface_vertices: Vec<u32>,
    uvs: Vec<Vec2>,
    triangles: Vec<[u32; 3]>,
}

fn split_at_seams(mesh: &Mesh) -> Split {
    let own = mesh.positions().len();
    let mut surface_vertices: Vec<u32> = (0..own as u32).collect();
    let mut uvs: Vec<Option<Vec2>> = vec![None; own];
    let mut copies: HashMap<(u32, [u32; 2]), u32> = HashMap::new();
    let mut triangles = Vec::with_capacity(mesh.triangles().len());
    let bits = |uv: Vec2| uv.to_array().map(f32::to_bits);
    for (triangle, corners) in mesh.triangles().iter().zip(mesh.corner_uvs()) {
        let mut split = *triangle;
        for (vertex, &uv) in split.iter_mut().zip(corners) {
            let first = *uvs[*vertex as usize].get_or_insert(uv);
            if bits(first) != bits(uv) {
                *vertex = *copies.entry((*vertex, bits(uv))).or_insert_with(|| {
                    surface_vertices.push(*vertex);
                    uvs.push(Some(uv));
                    (uvs.len() - 1) as u32
                });
            }
        }
        triangles.push(split);
    }
    Split { surface_vertices, uvs: uvs.into_iter().map(Option::unwrap_or_default).collect(), triangles }
}

/// RGBA8 preview of the maps without view dependence.
fn preview_png(atlas: &Atlas, space: ColorSpace) -> Vec<u8> {
    let base = atlas.base();
    let mut rgba = Vec::with_capacity(base.texels().len());
    for texel in base.texels().chunks_exact(4) {
        rgba.extend(preview::color(texel, space));
        rgba.push(preview::opacity(texel));
    }
    preview::png(base, &rgba, ExtendedColorType::Rgba8)
}
