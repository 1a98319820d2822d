//! The glTF document behind a scene, kept to be written again.

use std::collections::{HashMap, HashSet};
use std::hash::{DefaultHasher, Hash as _, Hasher as _};
use std::path::Path;
use std::sync::Arc;

use glam::{DMat4, Vec2};
use rayon::prelude::*;
use serde_json::{Value, json};

use super::container::Bin;
use super::extension::{
    ANIMATION_POINTER, EXTRAS, HYBRID, KHR_SPLATS, MOVED_NODE, SceneContract, animated_property, extension_of,
};
use super::json::{channels, enlist, index, indices, items, items_mut, object_at, push, remove, retain};
use super::lift::{Asset, give_scene};
use super::merge::Content;
use super::motion::Clip;
use super::moving::Moving;
use super::nodes::{is_bare, needed, remove_nodes};
use super::remainder::{Remnant, Role, has_extras, remainder};
use super::shot::take_out;
use super::transform::is_ours;
use crate::format::cameras::{CameraFile, Sampling};
use crate::format::error::FormatError;
use crate::format::placed::similarity;
use crate::scene::{Camera, Composition, HybridScene, SceneError, frame::HALF_TURN};

/// The copyright of a file, in words.
pub(in crate::format) const COPYRIGHT: &str = "the copyright";

/// The glTF document from which a scene was read. The scene holds what is rendered; animations, skins, morph targets,
/// lights, full materials, names, extras and unknown extensions are in the document only.
///
/// Principle: **the document is written unchanged as long as it still describes the scene.** Accessors are then
/// preserved bit for bit.
///
/// | change of the scene | effect on the document |
/// |---|---|
/// | none | written as it is, with one buffer |
/// | translated, rotated, scaled ([`Source::follow`]) | gets a node above the scene with the transform |
/// | another composition | the composition is set, unless the document has none and has splats of several colour spaces, or splats and triangles in one mesh: readers accept neither with a composition, so the document is dropped |
/// | all cameras left out | cameras are removed, nodes that only placed them, and what animates either |
/// | cropped, thinned, fewer harmonics, joined, mirrored, other cameras | dropped: the scene is written anew, and [`Source::remainder`] lists what is lost. Copyright and the extras of asset, document and scene are kept |
///
/// Equality with the scene as read is tested by fingerprints of its arrays.
#[derive(Clone, Debug)]
pub struct Source {
    /// JSON document without the `uri`s of buffers.
    root: Value,
    content: Option<Content>,
    remainder: Vec<Remnant>,
    /// From coordinates of the document's frame to those that the scene has now.
    moved: DMat4,
    /// Whether the document's frame is that of the capture; else it is glTF's, from which reading turns the scene.
    is_ours: bool,
    composition: Composition,
    splats_and_meshes: u64,
    cameras: u64,
    moving: Arc<Moving>,
}

impl Source {
    /// Creates the source of a scene just read, including the binary data if the document is to be written again.
    pub(super) fn new(
        asset: Asset,
        scene: &HybridScene,
        cameras: &[(String, Camera)],
        moving: Moving,
        keep: bool,
    ) -> Self {
        let is_ours = is_ours(&asset.document);
        let remainder = remainder(&asset.root, is_ours);
        let Asset { mut root, buffers, folder, .. } = asset;
        // The document may later get a transform node and a composition, which need a scene object.
        give_scene(&mut root);
        let content = keep.then(|| Content::new(&root, buffers, &folder));
        Self {
            root,
            content,
            remainder,
            moved: DMat4::IDENTITY,
            is_ours,
            composition: scene.composition,
            splats_and_meshes: if keep || !moving.is_still() { fingerprint(scene) } else { 0 },
            cameras: fingerprint_of_cameras(cameras),
            moving: Arc::new(moving),
        }
    }

    /// Extras that were given to [`super::write_glb`].
    #[must_use]
    pub fn extras(&self) -> Option<&Value> {
        self.root.pointer("/asset/extras")?.get(EXTRAS)
    }

    /// Whether the document's animations affect anything besides cameras.
    #[must_use]
    pub fn moves(&self) -> bool {
        self.moving.rig().is_some()
    }

    /// Animations of the document.
    #[must_use]
    pub fn clips(&self) -> &[Clip] {
        self.moving.clips()
    }

    /// First and last key time of all animations and deformations, in seconds.
    #[must_use]
    pub fn range(&self) -> [f64; 2] {
        self.moving.range()
    }

    /// What there is to be said where it is played from one time to another, in seconds, a sentence each: which of
    /// animations that move the same is taken, and how long there are any.
    #[must_use]
    pub fn played(&self, span: [f64; 2]) -> Vec<String> {
        self.moving.overruled().into_iter().chain(self.moving.outside(span)).collect()
    }

    /// Frames a second, if the document states them.
    #[must_use]
    pub fn fps(&self) -> Option<f64> {
        self.moving.fps()
    }

    /// The cameras, as [`crate::format::read_cameras`] reads them from `path`, of which this is the document: in its
    /// frame, which [`CameraFile::y_up`] tells and [`CameraFile::in_frame`] changes.
    ///
    /// # Errors
    /// Those of [`crate::format::read_cameras`].
    pub fn cameras(&self, path: &Path, sampling: &Sampling<'_>) -> Result<CameraFile, FormatError> {
        self.moving.cameras(sampling).map_err(|fault| fault.in_file(path))
    }

    /// Evaluates `scene`, which was read from this document, at a time in seconds with all its animations played
    /// together: nodes, skins, morph targets, and splats with the triangles or nodes that they follow. Parts that no
    /// animation moves keep their values bit for bit.
    ///
    /// # Errors
    /// If the scene has been changed otherwise than by [`Source::follow`], or the pose has non-finite numbers.
    pub fn at(&self, scene: &HybridScene, time: f64) -> Result<HybridScene, SceneError> {
        self.moving.scene(scene, self.moved, time)
    }

    /// Animation of `scene` or of its cameras, and the transform applied since reading; `None` if the scene has changed
    /// otherwise.
    pub(in crate::format) fn moving(&self, scene: &HybridScene) -> Option<(&Moving, DMat4)> {
        let holds =
            !self.moving.is_still() && similarity(self.moved).is_some() && self.splats_and_meshes == fingerprint(scene);
        holds.then_some((&*self.moving, self.moved))
    }

    /// Parts of the document that the scene does not hold, such as `2 animations` or `the extension
    /// KHR_lights_punctual`. They are lost if the document is not written again.
    #[must_use]
    pub fn remainder(&self) -> &[Remnant] {
        &self.remainder
    }

    /// Copyright that the document states.
    #[must_use]
    pub fn copyright(&self) -> Option<&str> {
        self.root.pointer("/asset/copyright")?.as_str()
    }

    /// Extras of asset, document and scene besides our own, in words, if there are any.
    #[must_use]
    pub fn extras_of_the_file(&self) -> Option<&'static str> {
        let scene = format!("/scenes/{}", self.scene());
        let mut objects = ["/asset", "", &scene].into_iter().filter_map(|path| self.root.pointer(path));
        objects.any(has_extras).then_some("extras of the file")
    }

    /// File-level metadata, in words, that is carried over to another glTF if the document is not written again.
    pub(in crate::format) fn of_the_file(&self) -> Vec<String> {
        let parts = [self.copyright().map(|_| COPYRIGHT), self.extras_of_the_file()];
        parts.into_iter().flatten().map(str::to_owned).collect()
    }

    /// Images, in words, that the document refers to but that were not found: a document that is written again still
    /// refers to them.
    pub(in crate::format) fn unfound(&self) -> Vec<String> {
        let unfound = self.content.iter().flat_map(|content| &content.unfound);
        unfound.map(|uri| format!("the picture `{uri}`, which was not found")).collect()
    }

    /// What the document loses with its cameras, in a sentence, where these are left out of it.
    pub(in crate::format) fn lost_with_cameras(&self, cameras: &[(String, Camera)]) -> Option<String> {
        let lost = channels(&self.root).filter(|channel| animates_camera(channel)).count();
        (lost > 0 && self.drops_cameras(cameras)).then(|| {
            let channels = if lost == 1 { "1 channel".to_owned() } else { format!("{lost} channels") };
            format!("/animations: {channels} of {ANIMATION_POINTER} left out with the cameras animated by it")
        })
    }

    /// Whether all cameras are left out of the document.
    fn drops_cameras(&self, cameras: &[(String, Camera)]) -> bool {
        cameras.is_empty() && self.cameras != fingerprint_of_cameras(cameras)
    }

    /// Removes parts with such a role from [`Source::remainder`], as not wanted.
    pub(super) fn forget(&mut self, is_of: impl Fn(Role) -> bool) {
        self.remainder.retain(|part| !is_of(part.role));
    }

    /// Declares cameras unwanted: animations that move only cameras no longer count as lost.
    pub fn forget_cameras(&mut self) {
        if !self.moves() && self.remainder.iter().all(|part| part.role != Role::Unplayed) {
            self.forget(|role| role == Role::Moves);
        }
    }

    /// Parts of [`Source::remainder`] that concern animation, if the document has animations.
    pub(in crate::format) fn motion(&self) -> Vec<String> {
        let is_animated = !items(&self.root, "animations").is_empty();
        let parts = self.remainder.iter().filter(|part| is_animated && part.role != Role::Rests);
        parts.map(ToString::to_string).collect()
    }

    /// Records that the scene read from this document has been transformed by `by` (for column vectors) into `scene`
    /// with `cameras`.
    pub fn follow(&mut self, by: DMat4, scene: &HybridScene, cameras: &[(String, Camera)]) {
        self.moved = by * self.moved;
        if self.content.is_some() || !self.moving.is_still() {
            self.splats_and_meshes = fingerprint(scene);
        }
        self.cameras = fingerprint_of_cameras(cameras);
        if self.contract().is_none() {
            // λ and near are defaults, which scale with the scene.
            self.composition = scene.composition;
        }
    }

    /// Whether the document still describes the scene: bit for bit as read, except for a transform (without
    /// reflection), the composition, and the removal of all cameras.
    #[must_use]
    pub fn stands(&self, scene: &HybridScene, cameras: &[(String, Camera)]) -> bool {
        self.content.is_some()
            && similarity(self.moved).is_some()
            && (cameras.is_empty() || self.cameras == fingerprint_of_cameras(cameras))
            && self.composition.color_space == scene.composition.color_space
            && (self.composition == scene.composition || self.takes_contract())
            && self.splats_and_meshes == fingerprint(scene)
    }

    /// Index of the scene that is read.
    fn scene(&self) -> usize {
        index(&self.root, "scene").unwrap_or(0)
    }

    fn contract(&self) -> Option<&Value> {
        extension_of(self.root.get("scenes")?.get(self.scene())?, HYBRID)
    }

    /// Whether a composition may be set: requires splats of its colour space, and no mesh with both splats and
    /// triangles.
    fn takes_contract(&self) -> bool {
        let space = self.composition.color_space.name();
        let is_other = |khr: &Value| khr.get("colorSpace").and_then(Value::as_str).is_some_and(|own| own != space);
        let is_apart = |mesh: &Value| {
            let primitives = items(mesh, "primitives");
            let splats: Vec<&Value> = primitives.iter().filter_map(|p| extension_of(p, KHR_SPLATS)).collect();
            [0, primitives.len()].contains(&splats.len()) && !splats.into_iter().any(is_other)
        };
        self.contract().is_some() || items(&self.root, "meshes").iter().all(is_apart)
    }

    /// Document as read, regardless of later changes of the scene, and its single buffer.
    pub(super) fn as_read(&self) -> (Value, Bin<'_>) {
        let mut root = self.root.clone();
        let bin = self.content.as_ref().map(|content| content.merge(&mut root)).unwrap_or_default();
        (root, bin)
    }

    /// Document with the transform, composition and cameras of `scene`, which is in the capture's frame, and its single
    /// buffer.
    pub(super) fn document(&self, scene: &HybridScene, cameras: &[(String, Camera)]) -> (Value, Bin<'_>) {
        let (mut root, bin) = self.as_read();
        self.place(&mut root);
        if self.drops_cameras(cameras) {
            remove_cameras(&mut root);
        }
        if scene.composition != self.composition {
            self.set_contract(&mut root, &scene.composition);
        }
        (root, bin)
    }

    /// Inserts a node with the accumulated transform above the scene.
    fn place(&self, root: &mut Value) {
        // Files are y up, and scenes are y down: `moved` has turned what is not ours, a root below has what is.
        let above = if self.is_ours { HALF_TURN * self.moved * HALF_TURN } else { HALF_TURN * self.moved };
        let Some(s) = similarity(above).filter(|_| !above.abs_diff_eq(DMat4::IDENTITY, 1e-12)) else { return };
        let current = self.scene();
        let lists: Vec<Vec<u64>> =
            items(root, "scenes").iter().map(|scene| indices(scene, "nodes").collect()).collect();
        let Some(roots) = lists.get(current).filter(|roots| !roots.is_empty()) else { return };
        let own: HashSet<u64> = roots.iter().copied().collect();
        let others = || lists.iter().enumerate().filter(|(i, _)| *i != current);
        let is_shared = others().any(|(_, list)| list.iter().any(|node| own.contains(node)));
        let mut above = |children: &[u64]| {
            let node = json!({
                "name": MOVED_NODE,
                "rotation": s.rotation.to_array(),
                "scale": [s.scale, s.scale, s.scale],
                "translation": s.translation.to_array(),
                "children": children,
            });
            push(root, "nodes", node) as u64
        };
        if !is_shared {
            let top = above(roots);
            root["scenes"][current]["nodes"] = json!([top]);
            return;
        }
        // Root nodes shared with other scenes stay there, each below a node of its own: a node may not be both a root
        // and a child.
        let tops: HashMap<u64, u64> = roots.iter().map(|&node| (node, above(&[node]))).collect();
        for (i, list) in lists.iter().enumerate().filter(|(_, list)| list.iter().any(|node| own.contains(node))) {
            root["scenes"][i]["nodes"] = list.iter().map(|node| json!(tops.get(node).unwrap_or(node))).collect();
        }
    }

    fn set_contract(&self, root: &mut Value, composition: &Composition) {
        let Some(scene) = root.get_mut("scenes").and_then(|s| s.get_mut(self.scene())) else { return };
        let new = json!(SceneContract::new(composition));
        let object = object_at(object_at(scene, "extensions"), HYBRID);
        // Absent means infinite λ and the default footprint.
        for key in ["lambda", "footprint"] {
            remove(object, key);
        }
        merge(object, &new);
        enlist(root, "extensionsUsed", HYBRID);
    }

    /// What concerns the file as a whole goes on even where the scene is written anew: copyright and extras of the
    /// asset, extras of the document, name and extras of the scene. A `record` takes the place of its own, which is of
    /// the scene as it was.
    pub(super) fn carry_over(&self, document: &mut Value, record: Option<&Value>) {
        let of = |path: &str| self.root.pointer(path).cloned();
        let scene = format!("/scenes/{}", self.scene());
        for (from, object, key) in [
            ("/asset/copyright".to_owned(), "/asset", "copyright"),
            ("/asset/extras".to_owned(), "/asset", "extras"),
            ("/extras".to_owned(), "", "extras"),
            (format!("{scene}/name"), "/scenes/0", "name"),
            (format!("{scene}/extras"), "/scenes/0", "extras"),
        ] {
            if let (Some(value), Some(Value::Object(object))) = (of(&from), document.pointer_mut(object)) {
                object.insert(key.to_owned(), value);
            }
        }
        if let Some(record) = record {
            object_at(&mut document["asset"], "extras")[EXTRAS] = record.clone();
        }
    }
}

/// Removes all cameras and paths of ours, nodes that only placed a camera, channels of animations that animate either,
/// and animations that are left with none.
pub(super) fn remove_cameras(root: &mut Value) {
    let has_pointers = |root: &Value| channels(root).any(|channel| animated_property(channel).is_some());
    let had_pointers = has_pointers(root);
    let mut idle = take_out(root);
    for (i, node) in (0..).zip(items_mut(root, "nodes")) {
        let Some(node) = node.as_object_mut() else { continue };
        if node.remove("camera").is_some() && is_bare(node) {
            idle.insert(i);
        }
    }
    remove(root, "cameras");
    let needed = needed(root);
    idle.retain(|node| !needed.contains(node));
    let is_idle = |node: &Value| node.as_u64().is_some_and(|node| idle.contains(&node));
    for animation in items_mut(root, "animations") {
        retain(animation, "channels", |_, channel| {
            !animates_camera(channel) && !channel.pointer("/target/node").is_some_and(is_idle)
        });
    }
    retain(root, "animations", |_, animation| animation.get("channels").is_some());
    if had_pointers && !has_pointers(root) {
        for key in ["extensionsUsed", "extensionsRequired"] {
            retain(root, key, |_, name| name != ANIMATION_POINTER);
        }
    }
    remove_nodes(root, &idle);
}

/// Whether an animation channel animates a camera.
fn animates_camera(channel: &Value) -> bool {
    animated_property(channel).is_some_and(|pointer| pointer.starts_with("/cameras/"))
}

/// Copies the members of `new` into `object`.
fn merge(object: &mut Value, new: &Value) {
    if let (Some(object), Some(new)) = (object.as_object_mut(), new.as_object()) {
        object.extend(new.clone());
    }
}

/// Hashes of an array's chunks of some megabytes, computed in parallel.
fn part_hashes(bytes: &[u8]) -> Vec<u64> {
    let hash = |chunk: &[u8]| {
        let mut hasher = DefaultHasher::new();
        hasher.write(chunk);
        hasher.finish()
    };
    bytes.par_chunks(1 << 20).map(hash).collect()
}

/// Hash of all arrays of a scene.
fn fingerprint(scene: &HybridScene) -> u64 {
    let mut hasher = DefaultHasher::new();
    let mut add = |bytes: &[u8]| (bytes.len(), part_hashes(bytes)).hash(&mut hasher);
    let s = &scene.splats;
    add(bytemuck::cast_slice(s.means()));
    add(bytemuck::cast_slice(s.rotations()));
    add(bytemuck::cast_slice(s.log_scales()));
    add(bytemuck::cast_slice(s.opacity_logits()));
    add(bytemuck::cast_slice(s.sh()));
    // Texels shared by many meshes are hashed once.
    let mut known = HashMap::new();
    for mesh in &scene.meshes {
        add(bytemuck::cast_slice(mesh.positions()));
        add(bytemuck::cast_slice(mesh.triangles()));
        add(bytemuck::cast_slice::<Vec2, u8>(mesh.corner_uvs().as_flattened()));
        for texture in [Some(mesh.atlas().base()), mesh.atlas().bands()].into_iter().flatten() {
            let texels = texture.texels();
            let hashes = known.entry(texels.as_ptr()).or_insert_with(|| part_hashes(bytemuck::cast_slice(texels)));
            add(bytemuck::cast_slice(&[texture.width(), texture.height()]));
            add(bytemuck::cast_slice(hashes));
        }
    }
    hasher.finish()
}

fn fingerprint_of_cameras(cameras: &[(String, Camera)]) -> u64 {
    let mut hasher = DefaultHasher::new();
    for (name, camera) in cameras {
        let k = camera.intrinsics();
        (name, k.width, k.height, [k.fx, k.fy, k.cx, k.cy].map(f64::to_bits)).hash(&mut hasher);
        camera.rotation().to_cols_array().map(f64::to_bits).hash(&mut hasher);
        camera.translation().to_array().map(f64::to_bits).hash(&mut hasher);
    }
    hasher.finish()
}
