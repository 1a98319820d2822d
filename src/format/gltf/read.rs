//! From an opened asset to a hybrid scene.

use std::collections::BTreeMap;

use glam::{DMat3, DMat4, DVec3, Quat, Vec2, Vec3};
use serde::Deserialize as _;
use serde_json::Value;

use super::extension::{
    EXTRAS, ExactCamera, HYBRID, KHR_SPLATS, Khr, OPACITY, ROTATION, SCALE, SceneContract, Surface, color_space_token,
    parse_color_space, sh_attributes,
};
use super::lift::Asset;
use super::material;
use super::transform::{Similarity, is_ours, placements, similarity};
use super::triangles::{self, Triangles};
use crate::format::error::Fault;
use crate::format::{SceneFile, activation};
use crate::scene::{Atlas, Camera, ColorSpace, Composition, HybridScene, Intrinsics, Mesh, Splats, Texture, sh};

/// Image height given to cameras that do not state one.
const DEFAULT_HEIGHT: u32 = 1080;

/// Sides and pixels that the image of a camera may have, as many as the largest photographs: buffers are made for it.
const MAX_SIDE: u32 = 1 << 16;
const MAX_PIXELS: u64 = 1 << 28;

pub(in crate::format) fn scene(asset: &Asset) -> Result<SceneFile, Fault> {
    let mut notes = vec![];
    let composition = composition(asset)?;
    let (mut parts, mut meshes, mut cameras) = (vec![], vec![], vec![]);
    for (node, transform) in placements(&asset.document)? {
        let at_node = format!("/nodes/{}", node.index());
        for primitive in node.mesh().iter().flat_map(gltf::Mesh::primitives) {
            let mesh = node.mesh().map_or(0, |m| m.index());
            if let Some(khr) = primitive.extension_value(KHR_SPLATS) {
                let part = Part::read(asset, (mesh, primitive.index()), &primitive, khr, &composition, &mut notes)?;
                parts.push(part.placed(transform, &at_node)?);
            } else if let Some(geometry) = triangles::read(asset, mesh, &primitive, transform)? {
                meshes.extend(read_mesh(asset, &primitive, geometry, transform, &composition, &at_node, &mut notes)?);
            } else {
                notes.push(format!("{at_node}: a primitive that is neither triangles nor splats is left out"));
            }
        }
        if let Some(camera) = node.camera() {
            let name = node.name().or(camera.name()).map_or_else(|| format!("camera_{}", cameras.len()), str::to_owned);
            match read_camera(asset, camera.index(), transform) {
                Ok((camera, None)) => cameras.push((name, camera)),
                Ok((camera, Some(note))) => {
                    notes.push(format!("{at_node}: {note}"));
                    cameras.push((name, camera));
                }
                Err(reason) => notes.push(format!("{at_node}: camera left out: {reason}")),
            }
        }
    }
    let scene = HybridScene { splats: join(parts)?, meshes, composition };
    Ok(SceneFile { scene, cameras, notes, y_up: !is_ours(&asset.document), attributes: vec![], dropped: 0 })
}

/// The scene's contract; without one, defaults in the colour space of the first splat primitive.
fn composition(asset: &Asset) -> Result<Composition, Fault> {
    let document = &asset.document;
    if let Some(scene) = document.default_scene().or_else(|| document.scenes().next())
        && let Some(value) = scene.extension_value(HYBRID)
    {
        let at = format!("/scenes/{}/extensions/{HYBRID}", scene.index());
        let contract = SceneContract::deserialize(value)
            .map_err(|e| Fault::pointer(&at, format!("a scene of {HYBRID}"), e.to_string()))?;
        return contract.composition(&at);
    }
    let mut primitives = document.meshes().flat_map(|m| m.primitives().map(move |p| (m.index(), p)));
    let khr = primitives.find_map(|(mesh, p)| Some((mesh, p.index(), p.extension_value(KHR_SPLATS)?.clone())));
    let color_space = match khr {
        None => ColorSpace::default(),
        Some((mesh, primitive, value)) => {
            let at = format!("/meshes/{mesh}/primitives/{primitive}/extensions/{KHR_SPLATS}");
            let token = value.get("colorSpace").and_then(Value::as_str).unwrap_or("nothing");
            parse_color_space(token, &at)?
        }
    };
    Ok(Composition { color_space, ..Composition::default() })
}

/// Splats of one primitive.
struct Part {
    means: Vec<Vec3>,
    rotations: Vec<Quat>,
    log_scales: Vec<Vec3>,
    opacity_logits: Vec<f32>,
    degree: u32,
    sh: Vec<[f32; 3]>,
}

impl Part {
    fn read(
        asset: &Asset,
        id: (usize, usize),
        primitive: &gltf::Primitive<'_>,
        khr: &Value,
        composition: &Composition,
        notes: &mut Vec<String>,
    ) -> Result<Self, Fault> {
        let at = format!("/meshes/{}/primitives/{}", id.0, id.1);
        let at_khr = format!("{at}/extensions/{KHR_SPLATS}");
        let khr = Khr::deserialize(khr).map_err(|e| Fault::pointer(&at_khr, KHR_SPLATS, e.to_string()))?;
        if khr.kernel != "ellipse" {
            return Err(Fault::pointer(format!("{at_khr}/kernel"), "ellipse", format!("`{}`", khr.kernel)));
        }
        if parse_color_space(&khr.color_space, &at_khr)? != composition.color_space {
            let expected = format!("{} throughout", color_space_token(composition.color_space));
            return Err(Fault::pointer(format!("{at_khr}/colorSpace"), expected, format!("`{}`", khr.color_space)));
        }
        if let Some(name) = khr.extensions.keys().find(|k| *k != HYBRID) {
            return Err(Fault::pointer(format!("{at_khr}/extensions"), "uncompressed splats", format!("`{name}`")));
        }
        if primitive.mode() != gltf::mesh::Mode::Points {
            return Err(Fault::pointer(format!("{at}/mode"), "0 (POINTS)", format!("{:?}", primitive.mode())));
        }
        let none = BTreeMap::new();
        let attributes = asset.attributes.get(&id).unwrap_or(&none);
        let find = |name: &str| {
            attributes.get(name).copied().ok_or_else(|| {
                Fault::pointer(format!("{at}/attributes"), format!("the attribute `{name}`"), "none of this name")
            })
        };
        let position = primitive.get(&gltf::Semantic::Positions);
        let position = position.ok_or_else(|| Fault::pointer(format!("{at}/attributes"), "POSITION", "none"))?;
        let means: Vec<Vec3> = asset.floats::<3>(position.index())?.into_iter().map(Vec3::from).collect();
        let same = |found: usize, name: &str| {
            let fault = || {
                let expected = format!("{} elements, as in POSITION", means.len());
                Fault::pointer(format!("{at}/attributes/{name}"), expected, found.to_string())
            };
            if found == means.len() { Ok(()) } else { Err(fault()) }
        };
        let rotations = asset.floats::<4>(find(ROTATION)?)?;
        same(rotations.len(), ROTATION)?;
        let scales = asset.floats::<3>(find(SCALE)?)?;
        same(scales.len(), SCALE)?;
        let opacities = asset.floats::<1>(find(OPACITY)?)?;
        same(opacities.len(), OPACITY)?;

        let harmonics = attributes.keys().filter(|name| name.contains(":SH_DEGREE_")).count();
        let degree = (0..=sh::MAX_DEGREE).find(|&d| sh::coefficients(d) == harmonics).ok_or_else(|| {
            let found = format!("{harmonics} SH attributes");
            Fault::pointer(format!("{at}/attributes"), "complete SH degrees from 0 to at most 3", found)
        })?;
        let k = sh::coefficients(degree);
        let mut interleaved = vec![[0.0; 3]; means.len() * k];
        for (c, name) in sh_attributes(degree).enumerate() {
            let coefficients = asset.floats::<3>(find(&name)?)?;
            same(coefficients.len(), &name)?;
            interleaved.iter_mut().skip(c).step_by(k).zip(coefficients).for_each(|(slot, value)| *slot = value);
        }

        let mut clamped = 0usize;
        let mut clamp = |(value, was_clamped): (f32, bool)| {
            clamped += usize::from(was_clamped);
            value
        };
        let opacity_logits = opacities.iter().map(|&[o]| clamp(activation::logit(o))).collect();
        let log_scales = scales.iter().map(|s| Vec3::from(s.map(|v| clamp(activation::log_scale(v))))).collect();
        if clamped > 0 {
            notes.push(format!(
                "{at}: {clamped} opacities of 0 or 1 or scales of 0 are clamped, so that their logit or logarithm is finite"
            ));
        }
        let rotations = rotations.into_iter().map(Quat::from_array).collect();
        Ok(Self { means, rotations, log_scales, opacity_logits, degree, sh: interleaved })
    }

    /// Moves the splats to where their node puts them.
    fn placed(mut self, transform: DMat4, at: &str) -> Result<Self, Fault> {
        if transform == DMat4::IDENTITY {
            return Ok(self);
        }
        let Some(Similarity { scale, rotation, .. }) = similarity(transform) else {
            let expected = "a rotation, a translation and an even, positive scale above splats";
            return Err(Fault::pointer(at, expected, "another transform"));
        };
        for mean in &mut self.means {
            *mean = transform.transform_point3(mean.as_dvec3()).as_vec3();
        }
        self.rotations.iter_mut().for_each(|q| *q = (rotation * q.as_dquat()).as_quat());
        self.log_scales.iter_mut().for_each(|s| *s = (s.as_dvec3() + scale.ln()).as_vec3());
        if self.degree > 0 {
            let harmonics = sh::Rotation::new(DMat3::from_quat(rotation));
            self.sh.chunks_exact_mut(sh::coefficients(self.degree)).for_each(|c| harmonics.apply(&mut c[1..]));
        }
        Ok(self)
    }
}

/// All parts as one, at the highest degree among them.
fn join(mut parts: Vec<Part>) -> Result<Splats, Fault> {
    let degree = parts.iter().map(|p| p.degree).max().unwrap_or(0);
    let k = sh::coefficients(degree);
    let (Some(mut all), rest) = (if parts.is_empty() { None } else { Some(parts.remove(0)) }, parts) else {
        return Ok(Splats::empty(0));
    };
    let padded = |part: &mut Part| {
        if part.degree < degree {
            let own = part.sh.chunks_exact(sh::coefficients(part.degree));
            part.sh = own.flat_map(|c| c.iter().copied().chain(std::iter::repeat([0.0; 3])).take(k)).collect();
        }
    };
    padded(&mut all);
    for mut part in rest {
        padded(&mut part);
        all.means.append(&mut part.means);
        all.rotations.append(&mut part.rotations);
        all.log_scales.append(&mut part.log_scales);
        all.opacity_logits.append(&mut part.opacity_logits);
        all.sh.append(&mut part.sh);
    }
    Ok(Splats::new(all.means, all.rotations, all.log_scales, all.opacity_logits, degree, all.sh)?)
}

/// One triangle primitive as a mesh; `None` if it has no triangle.
fn read_mesh(
    asset: &Asset,
    primitive: &gltf::Primitive<'_>,
    geometry: Triangles,
    transform: DMat4,
    composition: &Composition,
    at: &str,
    notes: &mut Vec<String>,
) -> Result<Option<Mesh>, Fault> {
    if geometry.triangles.is_empty() {
        notes.push(format!("{at}: a mesh without triangles is left out"));
        return Ok(None);
    }
    let mut atlas = material::atlas(asset, &primitive.material(), composition.color_space, notes)?;
    if atlas.sh_degree() > 0 && transform != DMat4::IDENTITY {
        let Some(Similarity { rotation, .. }) = similarity(transform) else {
            let expected = "a rotation, a translation and an even scale above a mesh with view-dependent colour";
            return Err(Fault::pointer(at, expected, "another transform"));
        };
        atlas = turned(&atlas, &sh::Rotation::new(DMat3::from_quat(rotation)))?;
    }
    let Triangles { mut positions, mut triangles, uvs } = geometry;
    let uvs = uvs.unwrap_or_else(|| {
        notes.push(format!("{at}: a mesh without texture coordinates takes its colour from the centre of its maps"));
        vec![Vec2::splat(0.5); positions.len()]
    });
    let corner_uvs = triangles.iter().map(|t| t.map(|v| uvs[v as usize])).collect();
    if let Some(source) = surface_vertices(asset, primitive, &positions)? {
        // The surface's own vertices come back in their own order.
        let count = source.iter().max().map_or(0, |&v| v as usize + 1);
        let mut own = vec![Vec3::ZERO; count];
        source.iter().zip(&positions).for_each(|(&v, &p)| own[v as usize] = p);
        triangles.iter_mut().for_each(|t| *t = t.map(|v| source[v as usize]));
        positions = own;
    }
    Ok(Some(Mesh::new(positions, triangles, corner_uvs, atlas)?))
}

/// The accessor of seam copies, if there is one and its claims hold: one entry per vertex, indices without gaps.
fn surface_vertices(
    asset: &Asset,
    primitive: &gltf::Primitive<'_>,
    positions: &[Vec3],
) -> Result<Option<Vec<u32>>, Fault> {
    let Some(value) = primitive.extension_value(HYBRID) else { return Ok(None) };
    let surface = Surface::deserialize(value)
        .map_err(|e| Fault::whole(format!("a mesh primitive of {HYBRID}"), e.to_string()))?;
    let Some(accessor) = surface.surface_vertices else { return Ok(None) };
    let source = asset.indices(accessor)?;
    let at = format!("/accessors/{accessor}");
    if source.len() != positions.len() {
        return Err(Fault::pointer(at, format!("{} surface vertices", positions.len()), source.len().to_string()));
    }
    let mut first: Vec<Option<Vec3>> = vec![None; positions.len()];
    for (&v, &position) in source.iter().zip(positions) {
        let Some(slot) = first.get_mut(v as usize) else {
            return Err(Fault::pointer(at, format!("surface vertices below {}", positions.len()), v.to_string()));
        };
        if *slot.get_or_insert(position) != position {
            return Err(Fault::pointer(at, "copies of a surface vertex in one place", format!("vertex {v} in two")));
        }
    }
    Ok(Some(source))
}

fn turned(atlas: &Atlas, harmonics: &sh::Rotation) -> Result<Atlas, Fault> {
    let Some(bands) = atlas.bands() else { return Ok(atlas.clone()) };
    let mut texels = bands.texels().to_vec();
    texels.chunks_exact_mut(bands.channels() as usize).for_each(|texel| harmonics.apply(texel.as_chunks_mut().0));
    Ok(Atlas::new(atlas.base().clone(), Some(Texture::new(bands.width(), bands.height(), bands.channels(), texels)?))?)
}

/// A camera and what had to be assumed about it; on failure, the reason.
fn read_camera(asset: &Asset, index: usize, transform: DMat4) -> Result<(Camera, Option<String>), String> {
    let camera = asset.document.as_json().cameras.get(index).ok_or("no such camera")?;
    let Similarity { rotation, translation, .. } =
        similarity(transform).ok_or("its node shears, mirrors or stretches")?;
    let to_camera = (DMat3::from_quat(rotation) * DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0))).transpose();
    let pose = (to_camera, -(to_camera * translation));

    let extras = camera.extras.as_ref().and_then(|e| serde_json::from_str::<Value>(e.get()).ok());
    let exact = extras.and_then(|e| serde_json::from_value::<ExactCamera>(e.get(EXTRAS)?.clone()).ok());
    if let Some(c) = exact {
        if c.width.max(c.height) > MAX_SIDE || u64::from(c.width) * u64::from(c.height) > MAX_PIXELS {
            return Err(format!("its image of {}×{} pixels is too large", c.width, c.height));
        }
        let k = Intrinsics { width: c.width, height: c.height, fx: c.fx, fy: c.fy, cx: c.cx, cy: c.cy };
        let own = (DMat3::from_cols_array(&c.rotation).transpose(), DVec3::from(c.translation));
        // glTF nodes are read in f32; a larger difference means that somebody has moved the camera.
        let tolerance = 1e-5 * (1.0 + own.1.length());
        let unmoved = own.0.abs_diff_eq(pose.0, 1e-5) && own.1.abs_diff_eq(pose.1, tolerance);
        let (rotation, translation) = if unmoved { own } else { pose };
        return Camera::new(k, rotation, translation).map(|c| (c, None)).map_err(|e| e.to_string());
    }
    let perspective = camera.perspective.as_ref().ok_or("it is not a perspective camera")?;
    let aspect = f64::from(perspective.aspect_ratio.unwrap_or(16.0 / 9.0));
    let height = f64::from(DEFAULT_HEIGHT);
    let width = (aspect * height).round().clamp(1.0, 16384.0);
    let f = 0.5 * height / (0.5 * f64::from(perspective.yfov)).tan();
    let (cx, cy) = (0.5 * width, 0.5 * height);
    let k = Intrinsics { width: width as u32, height: DEFAULT_HEIGHT, fx: f, fy: f, cx, cy };
    let note = format!("a camera without an image size is taken to have {}×{} pixels", k.width, k.height);
    Camera::new(k, pose.0, pose.1).map(|c| (c, Some(note))).map_err(|e| e.to_string())
}
