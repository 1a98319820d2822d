//! An animated head: an ellipsoid with bones and morph targets, and hair bound to its triangles.

use std::collections::HashMap;
use std::path::Path;

use centaur::format::{self, WriteOptions};
use centaur::scene::rig::Frame;
use centaur::scene::{Atlas, HybridScene, Mesh, Splats, Texture, sh};
use glam::{Mat4, Quat, Vec2, Vec3};
use rand::{RngExt as _, SeedableRng as _};
use rand_pcg::Pcg64Mcg;
use serde_json::{Value, json};

use super::{Result, View, layers};

const HYBRID: &str = "EXT_gaussian_splatting_hybrid";
const ACROSS: u32 = 24;
const DOWN: u32 = 16;
const HAIRS: usize = 150;

/// Name, parent and position of each joint. The world is y down.
const JOINTS: [(&str, Option<usize>, Vec3); 3] = [
    ("neck", None, Vec3::new(0.0, 0.9, 0.0)),
    ("skull", Some(0), Vec3::new(0.0, 0.3, 0.1)),
    ("jaw", Some(1), Vec3::new(0.0, 0.25, -0.1)),
];

/// Writes `head.glb`. Its rest pose is the bind pose, with all morph weights 0.
pub(super) fn write(folder: &Path) -> Result<()> {
    let path = folder.join("head.glb");
    let mesh = surface()?;
    let (splats, hair) = hair(&mesh)?;
    let scene = HybridScene { splats, meshes: vec![mesh], composition: layers(4) };
    let cameras = [("view0".to_owned(), View::default().camera()?)];
    format::write_scene(&path, &scene, &WriteOptions { cameras: &cameras, ..WriteOptions::default() })?;
    let mut file = File::open(&path)?;
    file.rig(&hair)?;
    file.write(&path)
}

fn surface() -> Result<Mesh> {
    let (mut positions, mut triangles, mut uvs) = (vec![], vec![], vec![]);
    let vertex = |i: u32, j: u32| {
        let (polar, azimuth) =
            (std::f32::consts::PI * j as f32 / DOWN as f32, std::f32::consts::TAU * i as f32 / ACROSS as f32);
        Vec3::new(0.62 * polar.sin() * azimuth.sin(), -0.85 * polar.cos(), -0.7 * polar.sin() * azimuth.cos())
    };
    let index = |i: u32, j: u32| match j {
        0 => 0,
        DOWN => 1,
        _ => 2 + (j - 1) * ACROSS + i % ACROSS,
    };
    positions.extend([vertex(0, 0), vertex(0, DOWN)]);
    positions.extend((1..DOWN).flat_map(|j| (0..ACROSS).map(move |i| (i, j))).map(|(i, j)| vertex(i, j)));
    let uv = |i: u32, j: u32| Vec2::new(0.02 + 0.96 * i as f32 / ACROSS as f32, 0.02 + 0.96 * j as f32 / DOWN as f32);
    for (i, j) in (0..DOWN).flat_map(|j| (0..ACROSS).map(move |i| (i, j))) {
        let corners = [[(i, j), (i + 1, j + 1), (i, j + 1)], [(i, j), (i + 1, j), (i + 1, j + 1)]];
        for corners in corners {
            let triangle = corners.map(|(i, j)| index(i, j));
            if triangle[0] != triangle[1] && triangle[1] != triangle[2] && triangle[2] != triangle[0] {
                triangles.push(triangle);
                uvs.push(corners.map(|(i, j)| uv(i, j)));
            }
        }
    }
    let size = 32;
    let texel = |t: u32| {
        let (x, y) = ((t % size) as f32 / size as f32, (t / size) as f32 / size as f32);
        let stripe = 0.5 + 0.5 * (25.0 * x).sin() * (19.0 * y).cos();
        let [r, g, b] = sh::dc_from_rgb([0.85 - 0.3 * y, 0.35 + 0.4 * stripe, 0.3 + 0.3 * x]);
        [r, g, b, 2.2 - 2.0 * stripe]
    };
    let base = Texture::new(size, size, 4, (0..size * size).flat_map(texel).collect())?;
    Ok(Mesh::new(positions, triangles, uvs, Atlas::new(base, None)?)?)
}

/// Binding of the splats: their triangles, and their means, orientations and scales in the frames of these.
#[derive(Default)]
struct Hair {
    triangles: Vec<u32>,
    translations: Vec<[f32; 3]>,
    rotations: Vec<[f32; 4]>,
    scales: Vec<[f32; 3]>,
}

fn hair(mesh: &Mesh) -> Result<(Splats, Hair)> {
    let mut rng = Pcg64Mcg::seed_from_u64(11);
    let mut r = |low: f32, high: f32| rng.random_range(low..high);
    let corners = |t: u32| mesh.triangles()[t as usize].map(|v| mesh.positions()[v as usize].as_dvec3());
    let all = 0..mesh.triangles().len() as u32;
    let scalp: Vec<u32> = all.filter(|&t| corners(t).iter().all(|p| p.y < -0.1)).collect();
    let mut hair = Hair::default();
    let (mut means, mut rotations, mut log_scales) = (vec![], vec![], vec![]);
    for i in 0..HAIRS {
        let triangle = scalp[(i * 37) % scalp.len()];
        let frame = Frame::of(corners(triangle)).ok_or("a triangle with an area")?;
        // Normals point outwards.
        let translation = Vec3::new(r(-0.2, 0.2), r(0.1, 0.6), r(-0.2, 0.2));
        let rotation = Quat::from_xyzw(r(-1., 1.), r(-1., 1.), r(-1., 1.), r(0.1, 1.)).normalize();
        let scale = Vec3::new(r(0.08, 0.2), r(0.5, 1.1), r(0.08, 0.2));
        means.push((frame.size * (frame.axes * translation.as_dvec3()) + frame.center).as_vec3());
        rotations.push((glam::DQuat::from_mat3(&frame.axes) * rotation.as_dquat()).as_quat());
        log_scales.push((frame.size as f32 * scale).map(f32::ln));
        hair.triangles.push(triangle);
        hair.translations.push(translation.to_array());
        hair.rotations.push(rotation.to_array());
        hair.scales.push(scale.to_array());
    }
    let logits = (0..HAIRS).map(|_| r(-1.0, 3.0)).collect();
    let mut color = |low: f32, high: f32| [r(low, high), r(low, high), r(low, high)];
    let harmonics =
        (0..16 * HAIRS).map(|k| if k % 16 == 0 { sh::dc_from_rgb(color(0.1, 0.7)) } else { color(-0.3, 0.3) });
    Ok((Splats::new(means, rotations, log_scales, logits, 3, harmonics.collect())?, hair))
}

/// Document and binary chunk of a binary glTF.
struct File {
    document: Value,
    bytes: Vec<u8>,
}

impl File {
    fn open(path: &Path) -> Result<Self> {
        let file = std::fs::read(path)?;
        let length = u32::from_le_bytes(file[12..16].try_into()?) as usize;
        Ok(Self { document: serde_json::from_slice(&file[20..20 + length])?, bytes: file[28 + length..].to_vec() })
    }

    fn write(mut self, path: &Path) -> Result<()> {
        self.bytes.resize(self.bytes.len().next_multiple_of(4), 0);
        self.document["buffers"][0]["byteLength"] = json!(self.bytes.len());
        let mut text = serde_json::to_vec(&self.document)?;
        text.resize(text.len().next_multiple_of(4), b' ');
        let mut file = b"glTF\x02\0\0\0".to_vec();
        file.extend((28 + text.len() as u32 + self.bytes.len() as u32).to_le_bytes());
        for (kind, content) in [(b"JSON", &text), (b"BIN\0", &self.bytes)] {
            file.extend((content.len() as u32).to_le_bytes());
            file.extend_from_slice(kind);
            file.extend_from_slice(content);
        }
        Ok(std::fs::write(path, file)?)
    }

    fn push(&mut self, key: &str, value: Value) -> usize {
        if !self.document[key].is_array() {
            self.document[key] = json!([]);
        }
        let list = self.document[key].as_array_mut().expect("it has just been made one");
        list.push(value);
        list.len() - 1
    }

    fn accessor(&mut self, component: u32, kind: &str, count: usize, bytes: &[u8]) -> usize {
        self.bytes.resize(self.bytes.len().next_multiple_of(4), 0);
        let view = json!({ "buffer": 0, "byteOffset": self.bytes.len(), "byteLength": bytes.len() });
        self.bytes.extend_from_slice(bytes);
        let view = self.push("bufferViews", view);
        self.push("accessors", json!({ "bufferView": view, "componentType": component, "type": kind, "count": count }))
    }

    fn floats<const N: usize>(&mut self, values: &[[f32; N]]) -> usize {
        let kind = HashMap::from([(1, "SCALAR"), (3, "VEC3"), (4, "VEC4"), (16, "MAT4")])[&N];
        let bytes: Vec<u8> = values.as_flattened().iter().flat_map(|v| v.to_le_bytes()).collect();
        let index = self.accessor(5126, kind, values.len(), &bytes);
        if N <= 3 {
            let edge = |pick: fn(f32, f32) -> f32| -> Vec<f32> {
                (0..N).map(|c| values.iter().map(|v| v[c]).reduce(pick).unwrap_or(0.0)).collect()
            };
            let (low, high) = (edge(f32::min), edge(f32::max));
            self.document["accessors"][index]["min"] = json!(low);
            self.document["accessors"][index]["max"] = json!(high);
        }
        index
    }

    /// Elements of a tightly packed VEC3 accessor of floats.
    fn positions(&self, accessor: usize) -> Vec<Vec3> {
        let accessor = &self.document["accessors"][accessor];
        let view = &self.document["bufferViews"][accessor["bufferView"].as_u64().unwrap_or(0) as usize];
        let start = view["byteOffset"].as_u64().unwrap_or(0) as usize;
        let bytes = &self.bytes[start..start + 12 * accessor["count"].as_u64().unwrap_or(0) as usize];
        bytes.as_chunks::<4>().0.as_chunks::<3>().0.iter().map(|v| Vec3::from(v.map(f32::from_le_bytes))).collect()
    }

    fn named(&self, name: &str) -> Result<usize> {
        let nodes = self.document["nodes"].as_array().ok_or("nodes")?;
        Ok(nodes.iter().position(|n| n["name"] == name).ok_or("a node of this name")?)
    }

    fn rig(&mut self, hair: &Hair) -> Result<()> {
        let (root, head, splats) = (self.named("centaur_world")?, self.named("mesh_0")?, self.named("splats")?);
        let mesh = self.document["nodes"][head]["mesh"].as_u64().ok_or("a mesh")? as usize;
        let position =
            self.document["meshes"][mesh]["primitives"][0]["attributes"]["POSITION"].as_u64().ok_or("positions")?;
        let positions = self.positions(position as usize);

        // Joints, from the root of the scene downwards.
        let mut joints = vec![];
        for (name, above, place) in JOINTS {
            let from = above.map_or(Vec3::ZERO, |joint| JOINTS[joint].2);
            let node = self.push("nodes", json!({ "name": name, "translation": (place - from).to_array() }));
            let parent = above.map_or(root, |joint| joints[joint]);
            let mut children = self.document["nodes"][parent]["children"].as_array().cloned().unwrap_or_default();
            children.push(json!(node));
            self.document["nodes"][parent]["children"] = json!(children);
            joints.push(node);
        }
        let inverse_bind = self.floats(&JOINTS.map(|(_, _, place)| Mat4::from_translation(-place).to_cols_array()));
        let skin = self.push("skins", json!({ "joints": joints, "inverseBindMatrices": inverse_bind }));
        self.document["nodes"][head]["skin"] = json!(skin);
        // The jaw is below and in front, the neck at the bottom; y points down and the face looks along −z.
        let weights = |p: &Vec3| {
            let neck = ((p.y - 0.35) / 0.5).clamp(0.0, 1.0);
            let jaw = (1.0 - neck) * ((p.y - 0.1) / 0.3).clamp(0.0, 1.0) * ((-p.z) / 0.4).clamp(0.0, 1.0);
            [neck, 1.0 - neck - jaw, jaw, 0.0]
        };
        let weights = self.floats(&positions.iter().map(weights).collect::<Vec<_>>());
        let which = self.accessor(5121, "VEC4", positions.len(), &[0, 1, 2, 0].repeat(positions.len()));
        // Eyes bulge; the mouth opens.
        let eyes = |p: &Vec3| {
            let near = |x: f32| (-(*p - Vec3::new(x, -0.15, -0.6)).length_squared() / 0.02).exp();
            [0.0, 0.0, -0.25 * (near(0.25) + near(-0.25))]
        };
        let mouth = |p: &Vec3| {
            let near = (-(*p - Vec3::new(0.0, 0.4, -0.55)).length_squared() / 0.04).exp();
            [0.0, 0.2 * near, 0.1 * near]
        };
        let targets = [positions.iter().map(eyes).collect::<Vec<_>>(), positions.iter().map(mouth).collect()];
        let targets = targets.map(|deltas| json!({ "POSITION": self.floats(&deltas) }));
        let primitive = &mut self.document["meshes"][mesh]["primitives"][0];
        primitive["attributes"]["JOINTS_0"] = json!(which);
        primitive["attributes"]["WEIGHTS_0"] = json!(weights);
        primitive["targets"] = json!(targets);
        self.document["meshes"][mesh]["weights"] = json!([0.0, 0.0]);

        let n = hair.triangles.len();
        let triangles: Vec<u8> = hair.triangles.iter().flat_map(|t| t.to_le_bytes()).collect();
        let count = self.document["accessors"]
            [self.document["meshes"][mesh]["primitives"][0]["indices"].as_u64().ok_or("indices")? as usize]["count"]
            .as_u64()
            .ok_or("a count")?
            / 3;
        let binding = json!({
            "node": head, "triangleCount": count, "sphericalHarmonicsFrame": "triangle",
            "triangles": self.accessor(5125, "SCALAR", n, &triangles),
            "translations": self.floats(&hair.translations),
            "rotations": self.floats(&hair.rotations),
            "scales": self.floats(&hair.scales),
        });
        let cloud = self.document["nodes"][splats]["mesh"].as_u64().ok_or("a mesh")? as usize;
        let khr = &mut self.document["meshes"][cloud]["primitives"][0]["extensions"]["KHR_gaussian_splatting"];
        khr["extensions"] = json!({ HYBRID: { "binding": binding } });
        self.animate(&joints, head);
        Ok(())
    }

    /// Adds an animation in which the head nods, turns, speaks and stares, with all interpolations.
    fn animate(&mut self, joints: &[usize], head: usize) {
        let turns = |axis: Vec3, degrees: &[f32]| -> Vec<[f32; 4]> {
            degrees.iter().map(|d| Quat::from_axis_angle(axis, d.to_radians()).to_array()).collect()
        };
        let keys = [0.0, 0.5, 1.0, 1.5].map(|t: f32| [t]);
        let input = self.floats(&keys);
        let none = [0.0f32; 4];
        let nod = turns(Vec3::X, &[0.0, 12.0, -9.0, 0.0]);
        let nod: Vec<[f32; 4]> = nod.iter().flat_map(|q| [none, *q, [0.1, 0.0, 0.05, 0.0]]).collect();
        let outputs = [
            (joints[0], "rotation", "LINEAR", turns(Vec3::Y, &[0.0, 18.0, -15.0, 0.0])),
            (joints[1], "rotation", "CUBICSPLINE", nod),
            (joints[2], "rotation", "LINEAR", turns(Vec3::X, &[0.0, 14.0, 4.0, 0.0])),
        ];
        let (mut samplers, mut channels) = (vec![], vec![]);
        for (node, path, interpolation, values) in outputs {
            let output = self.floats(&values);
            channels.push(json!({ "sampler": samplers.len(), "target": { "node": node, "path": path } }));
            samplers.push(json!({ "input": input, "output": output, "interpolation": interpolation }));
        }
        let weights = self.floats(&[[0.0f32], [0.0], [0.4], [1.0], [1.0], [0.6], [0.0], [0.0]]);
        channels.push(json!({ "sampler": samplers.len(), "target": { "node": head, "path": "weights" } }));
        samplers.push(json!({ "input": input, "output": weights, "interpolation": "LINEAR" }));
        self.push("animations", json!({ "name": "talk", "channels": channels, "samplers": samplers }));
    }
}
