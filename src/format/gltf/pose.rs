//! Poses of a document: the bones and weights that its surfaces and splats follow, at rest and at a time. At rest,
//! skins are posed by their joints' own transforms and morph targets by their default weights: the state that viewers
//! show before an animation starts, and from which the static scene is made.

use std::collections::{HashMap, HashSet};
use std::sync::Arc;

use glam::{DMat4, Vec3};

use super::extension::{HYBRID, Surface};
use super::lift::Asset;
use super::motion::{Motion, in_between};
use super::transform::{Placed, all_placements_by, local};
use crate::format::cameras::short;
use crate::format::error::{Fault, from_value};
use crate::scene::rig::{Anchor, AttachedSplats, Binding, MorphTarget, Pose, RestSurface, ShFrame, Skinning};

/// Bones and weights requested so far.
#[derive(Clone, Debug)]
pub(in crate::format) struct Poses {
    bones: Vec<Bone>,
    weights: Vec<Weight>,
    of_node: HashMap<usize, usize>,
    of_skin: HashMap<usize, Vec<usize>>,
    /// Global transforms of the scene's nodes at rest.
    global: HashMap<usize, DMat4>,
    /// Parent of each node of the scene.
    above: HashMap<usize, usize>,
    /// Nodes moved by an animation of themselves or of an ancestor.
    moving: HashSet<usize>,
    rest: Pose,
}

#[derive(Clone, Debug)]
enum Bone {
    Node(usize),
    Joint {
        node: usize,
        inverse_bind: DMat4,
    },
    /// Instance of a node's content, with transform `local` in the node's space.
    Copy {
        node: usize,
        local: DMat4,
    },
}

#[derive(Clone, Debug)]
enum Weight {
    /// Weight of a node's morph target, and its value when not animated.
    Target { node: usize, target: usize, rest: f32 },
    /// Weight of one key of the extension's vertex translations.
    Key { times: Arc<[f32]>, key: usize, is_step: bool },
}

impl Bone {
    fn node(&self) -> usize {
        match self {
            Self::Node(node) | Self::Joint { node, .. } | Self::Copy { node, .. } => *node,
        }
    }
}

/// Flags of the elements to be kept.
struct Kept(Vec<bool>);

impl Kept {
    fn none_of(count: usize) -> Self {
        Self(vec![false; count])
    }

    fn keep(&mut self, i: usize) {
        self.0[i] = true;
    }

    fn retain<T>(&self, things: &mut Vec<T>) {
        let mut kept = self.0.iter();
        things.retain(|_| kept.next() == Some(&true));
    }

    /// New indices of the kept elements.
    fn numbers(&self) -> Vec<usize> {
        let mut next = 0;
        let number = |&kept: &bool| {
            next += usize::from(kept);
            next.saturating_sub(1)
        };
        self.0.iter().map(number).collect()
    }
}

impl Poses {
    /// Creates the poses for all nodes of the scene, visible or not.
    pub(in crate::format) fn new(document: &gltf::Document, motion: &Motion) -> Result<Self, Fault> {
        let (mut global, mut above, mut moving) = (HashMap::new(), HashMap::new(), HashSet::new());
        // Parents precede their children.
        for Placed { node, transform, .. } in all_placements_by(document, local)? {
            let index = node.index();
            global.insert(index, transform);
            above.extend(node.children().map(|child| (child.index(), index)));
            if motion.has_transform(index) || above.get(&index).is_some_and(|parent| moving.contains(parent)) {
                moving.insert(index);
            }
        }
        Ok(Self {
            bones: vec![],
            weights: vec![],
            of_node: HashMap::new(),
            of_skin: HashMap::new(),
            global,
            above,
            moving,
            rest: Pose::default(),
        })
    }

    /// Rest pose of the requested bones and weights.
    pub(in crate::format) fn rest(&self) -> &Pose {
        &self.rest
    }

    /// Pose at a time, in seconds.
    pub(super) fn at(&self, document: &gltf::Document, motion: &Motion, time: f64) -> Result<Pose, Fault> {
        let placed = all_placements_by(document, |node| motion.local(node, time))?;
        let global: HashMap<usize, DMat4> = placed.into_iter().map(|p| (p.node.index(), p.transform)).collect();
        let of = |node: &usize| global.get(node).copied().unwrap_or_default();
        let bones = self.bones.iter().map(|bone| match bone {
            Bone::Node(node) => of(node),
            Bone::Joint { node, inverse_bind } => of(node) * *inverse_bind,
            Bone::Copy { node, local } => of(node) * *local,
        });
        let weights = self.weights.iter().map(|weight| match weight {
            Weight::Target { node, target, rest } => motion.weight(*node, *target, time).unwrap_or(*rest),
            Weight::Key { times, key, is_step } => weight_of_key(times, *key, *is_step, time),
        });
        Ok(Pose { bones: bones.collect(), weights: weights.collect() })
    }

    /// Names of bones: those of their nodes, cut if long, because a skin may contain a node many times.
    pub(super) fn names(&self, document: &gltf::Document) -> Vec<String> {
        let named: HashMap<usize, &str> = document.nodes().filter_map(|n| Some((n.index(), n.name()?))).collect();
        let of = |node: usize| named.get(&node).map_or_else(|| format!("node {node}"), |name| short(name));
        self.bones.iter().map(|bone| of(bone.node())).collect()
    }

    /// First and last key times of vertex translations, which need no animation.
    pub(super) fn ranges(&self) -> impl Iterator<Item = [f64; 2]> {
        self.weights.iter().filter_map(|weight| match weight {
            Weight::Key { times, .. } => Some([*times.first()?, *times.last()?].map(f64::from)),
            Weight::Target { .. } => None,
        })
    }

    /// Bind transform of a joint, in the space of the surface.
    pub(super) fn bind(&self, bone: usize) -> Option<DMat4> {
        match self.bones.get(bone)? {
            Bone::Joint { inverse_bind, .. } => Some(inverse_bind.inverse()).filter(DMat4::is_finite),
            Bone::Node(_) | Bone::Copy { .. } => None,
        }
    }

    /// Per bone, for joints of a skin, the nearest ancestor joint of that skin.
    pub(super) fn parents(&self) -> Vec<Option<usize>> {
        let mut parents = vec![None; self.bones.len()];
        for bones in self.of_skin.values() {
            let by_node: HashMap<usize, usize> = bones.iter().map(|&bone| (self.bones[bone].node(), bone)).collect();
            for &bone in bones {
                let mut upwards =
                    std::iter::successors(self.above.get(&self.bones[bone].node()), |n| self.above.get(n));
                parents[bone] = upwards.find_map(|n| by_node.get(n)).copied();
            }
        }
        parents
    }

    /// Removes bones and weights that neither the surfaces nor the splats use, and renumbers the rest; skins keep all
    /// their joints.
    pub(super) fn compact(&mut self, rest_surfaces: &mut [Option<RestSurface>], attached: &mut [AttachedSplats]) {
        let (mut bones, mut weights) = (Kept::none_of(self.bones.len()), Kept::none_of(self.weights.len()));
        for rest_surface in rest_surfaces.iter().flatten() {
            rest_surface.targets.iter().for_each(|target| weights.keep(target.weight));
            match &rest_surface.skinning {
                Skinning::Bone(bone) => bones.keep(*bone),
                Skinning::Skin { bones: joints, .. } => joints.iter().for_each(|&bone| bones.keep(bone as usize)),
            }
        }
        for part in &*attached {
            match &part.anchor {
                Anchor::Bone(bone) | Anchor::Triangles(Binding { harmonics: ShFrame::Bone(bone), .. }) => {
                    bones.keep(*bone);
                }
                Anchor::Triangles(_) => {}
            }
        }
        self.of_skin.retain(|_, joints| joints.iter().any(|&bone| bones.0[bone]));
        self.of_skin.values().flatten().for_each(|&bone| bones.keep(bone));
        self.of_node.clear();
        let (bone, weight) = (bones.numbers(), weights.numbers());
        bones.retain(&mut self.bones);
        bones.retain(&mut self.rest.bones);
        weights.retain(&mut self.weights);
        weights.retain(&mut self.rest.weights);
        self.of_skin.values_mut().flatten().for_each(|joint| *joint = bone[*joint]);
        for rest_surface in rest_surfaces.iter_mut().flatten() {
            rest_surface.targets.iter_mut().for_each(|target| target.weight = weight[target.weight]);
            match &mut rest_surface.skinning {
                Skinning::Bone(b) => *b = bone[*b],
                Skinning::Skin { bones: joints, .. } => joints.iter_mut().for_each(|b| *b = bone[*b as usize] as u32),
            }
        }
        for part in attached {
            match &mut part.anchor {
                Anchor::Bone(b) | Anchor::Triangles(Binding { harmonics: ShFrame::Bone(b), .. }) => *b = bone[*b],
                Anchor::Triangles(_) => {}
            }
        }
    }

    /// Whether a node is animated, by itself or through an ancestor.
    pub(super) fn moves(&self, node: usize) -> bool {
        self.moving.contains(&node)
    }

    /// Whether a surface is animated.
    pub(super) fn animates(&self, rest_surface: &RestSurface, motion: &Motion) -> bool {
        let moves = |bone: usize| self.moves(self.bones[bone].node());
        let is_skinned = match &rest_surface.skinning {
            Skinning::Bone(bone) => moves(*bone),
            Skinning::Skin { bones, .. } => {
                let used: HashSet<u32> = bones.iter().copied().collect();
                used.into_iter().any(|bone| moves(bone as usize))
            }
        };
        is_skinned
            || rest_surface.targets.iter().any(|target| match &self.weights[target.weight] {
                Weight::Target { node, .. } => motion.has_weights(*node),
                Weight::Key { times, .. } => times.len() > 1,
            })
    }

    /// Bone of a node, added if necessary.
    pub(super) fn bone(&mut self, node: usize) -> usize {
        if let Some(&bone) = self.of_node.get(&node) {
            return bone;
        }
        let bone = self.add_bone(Bone::Node(node), self.global.get(&node).copied().unwrap_or_default());
        self.of_node.insert(node, bone);
        bone
    }

    /// Adds the bone of an instance at a node, with transform `local` in the node's space.
    pub(super) fn copy(&mut self, node: usize, local: DMat4) -> usize {
        let global = self.global.get(&node).copied().unwrap_or_default();
        self.add_bone(Bone::Copy { node, local }, global * local)
    }

    fn add_bone(&mut self, bone: Bone, rest: DMat4) -> usize {
        self.bones.push(bone);
        self.rest.bones.push(rest);
        self.bones.len() - 1
    }

    fn add_weight(&mut self, weight: Weight, rest: f32) -> usize {
        self.weights.push(weight);
        self.rest.weights.push(rest);
        self.weights.len() - 1
    }

    /// Surface of `primitive` of the mesh of `node` before posing, with vertices `stored`.
    pub(super) fn rest_surface(
        &mut self,
        (asset, motion): (&Asset, &Motion),
        node: &gltf::Node<'_>,
        primitive: &gltf::Primitive<'_>,
        stored: Vec<Vec3>,
        notes: &mut Vec<String>,
    ) -> Result<RestSurface, Fault> {
        let mesh = node.mesh().map_or(0, |m| m.index());
        let at = format!("/meshes/{mesh}/primitives/{}", primitive.index());
        let vertices = stored.len();
        let skinning = match node.skin() {
            Some(skin) => {
                let joints = self.joints(asset, &skin)?;
                skin_of(asset, &joints, (mesh, primitive.index()), vertices, notes)?
            }
            // The transform of a skinned mesh's own node has no effect (glTF 2.0, 3.7.3.3).
            None => Skinning::Bone(self.bone(node.index())),
        };
        let mut targets = vec![];
        let weights = node.weights().or(node.mesh().and_then(|m| m.weights())).unwrap_or_default();
        for (i, target) in primitive.morph_targets().enumerate() {
            let rest = weights.get(i).copied().unwrap_or(0.0);
            let Some(accessor) = target.positions() else { continue };
            // Targets whose weight is always zero need not be stored.
            if rest == 0.0 && !motion.has_weights(node.index()) {
                continue;
            }
            let deltas = asset.floats::<3>(accessor.index())?;
            if deltas.len() != vertices {
                let expected = format!("{vertices} elements, as in POSITION");
                return Err(Fault::pointer(format!("{at}/targets/{i}/POSITION"), expected, deltas.len().to_string()));
            }
            let weight = self.add_weight(Weight::Target { node: node.index(), target: i, rest }, rest);
            targets.push(MorphTarget { weight, deltas: deltas.into_iter().map(Vec3::from).collect() });
        }
        targets.extend(self.translations(asset, primitive, vertices, &at)?);
        Ok(RestSurface { base: stored, targets, skinning })
    }

    /// Vertex translations over time of the extension, as one morph target per key.
    fn translations(
        &mut self,
        asset: &Asset,
        primitive: &gltf::Primitive<'_>,
        vertices: usize,
        at: &str,
    ) -> Result<Vec<MorphTarget>, Fault> {
        let Some(value) = primitive.extension_value(HYBRID) else { return Ok(vec![]) };
        let at = format!("{at}/extensions/{HYBRID}");
        let surface: Surface = from_value(value, &at, &format!("a mesh primitive of {HYBRID}"))?;
        let (Some(times), Some(translations)) = (surface.times, surface.translations) else { return Ok(vec![]) };
        let times: Arc<[f32]> = asset.floats::<1>(times)?.into_flattened().into();
        let deltas = asset.floats::<3>(translations)?;
        let grows = times.windows(2).all(|w| w[0] < w[1]) && times.iter().all(|t| t.is_finite());
        if times.is_empty() || !grows || Some(deltas.len()) != vertices.checked_mul(times.len()) {
            let expected = format!("times that grow, and {vertices} translations for each");
            return Err(Fault::pointer(at, expected, format!("{} and {} translations", times.len(), deltas.len())));
        }
        let is_step = surface.interpolation.as_deref() == Some("STEP");
        let keys = deltas.chunks_exact(vertices.max(1)).enumerate().map(|(key, deltas)| {
            let rest = weight_of_key(&times, key, is_step, 0.0);
            let weight = self.add_weight(Weight::Key { times: Arc::clone(&times), key, is_step }, rest);
            MorphTarget { weight, deltas: deltas.iter().copied().map(Vec3::from).collect() }
        });
        Ok(keys.collect())
    }

    /// Bones of a skin's joints.
    fn joints(&mut self, asset: &Asset, skin: &gltf::Skin<'_>) -> Result<Vec<usize>, Fault> {
        if let Some(known) = self.of_skin.get(&skin.index()) {
            return Ok(known.clone());
        }
        let at = format!("/skins/{}", skin.index());
        let joints: Vec<usize> = skin.joints().map(|j| j.index()).collect();
        let inverse_bind = match skin.inverse_bind_matrices() {
            None => vec![DMat4::IDENTITY; joints.len()],
            Some(accessor) => asset.matrices(accessor.index())?,
        };
        if inverse_bind.len() < joints.len() {
            let at = format!("{at}/inverseBindMatrices");
            let expected = format!("{} matrices, one a joint", joints.len());
            return Err(Fault::pointer(at, expected, inverse_bind.len().to_string()));
        }
        let mut bones = vec![];
        for (&node, inverse_bind) in joints.iter().zip(inverse_bind) {
            let global = self.global.get(&node).copied().ok_or_else(|| {
                let expected = "joints in the scene of their mesh";
                Fault::pointer(format!("{at}/joints"), expected, format!("node {node}"))
            })?;
            bones.push(self.add_bone(Bone::Joint { node, inverse_bind }, global * inverse_bind));
        }
        self.of_skin.insert(skin.index(), bones.clone());
        Ok(bones)
    }
}

/// Weight of a key's translations at a time.
fn weight_of_key(times: &[f32], key: usize, is_step: bool, time: f64) -> f32 {
    let (start, u) = in_between(times.len(), |i| f64::from(times[i]), time);
    let u = if is_step { 0.0 } else { u };
    match key {
        _ if key == start => (1.0 - u) as f32,
        _ if key == start + 1 => u as f32,
        _ => 0.0,
    }
}

/// Upper bound on joint sets that are read: 32 joints per vertex.
const MAX_SETS: usize = 8;

/// Joints and weights of all sets `JOINTS_n`, `WEIGHTS_n` of a primitive. A vertex without weights follows its first
/// joint, with a note.
fn skin_of(
    asset: &Asset,
    bones: &[usize],
    id: (usize, usize),
    vertices: usize,
    notes: &mut Vec<String>,
) -> Result<Skinning, Fault> {
    let at = format!("/meshes/{}/primitives/{}/attributes", id.0, id.1);
    let attributes = asset.attributes.get(&id);
    let find = |name: String| attributes.and_then(|a| a.get(&name)).copied();
    let mut sets = vec![];
    while sets.len() < MAX_SETS
        && let n = sets.len()
        && let (Some(joints), Some(weights)) = (find(format!("JOINTS_{n}")), find(format!("WEIGHTS_{n}")))
    {
        let set = (asset.floats::<4>(joints)?, asset.floats::<4>(weights)?);
        if set.0.len() != vertices || set.1.len() != vertices {
            let expected = format!("{vertices} elements, as in POSITION");
            let found = format!("{} and {}", set.0.len(), set.1.len());
            return Err(Fault::pointer(format!("{at}/JOINTS_{n}"), expected, found));
        }
        sets.push(set);
    }
    if sets.is_empty() {
        return Err(Fault::pointer(at, "JOINTS_0 and WEIGHTS_0, as its node has a skin", "no such pair"));
    }
    let width = 4 * sets.len();
    asset.spend((vertices * width * 8) as u64, &at)?;
    let (mut all_bones, mut all_weights) = (Vec::with_capacity(vertices * width), Vec::with_capacity(vertices * width));
    let mut weightless = 0;
    for v in 0..vertices {
        let mut total = 0.0;
        for (n, (joints, weights)) in sets.iter().enumerate() {
            for (&joint, &weight) in joints[v].iter().zip(&weights[v]) {
                // Indices of joints with zero weight need not be valid.
                let bone = match bones.get(joint as usize) {
                    Some(&bone) => bone,
                    None if weight == 0.0 => bones.first().copied().unwrap_or_default(),
                    None => {
                        let expected = format!("joints below {}", bones.len());
                        let found = format!("{joint} at vertex {v}");
                        return Err(Fault::pointer(format!("{at}/JOINTS_{n}"), expected, found));
                    }
                };
                total += f64::from(weight);
                all_bones.push(bone as u32);
                all_weights.push(weight);
            }
        }
        if total == 0.0 && !bones.is_empty() {
            weightless += 1;
            let own = &mut all_weights[v * width..];
            own.fill(0.0);
            own[0] = 1.0;
        } else if total.is_nan() || total <= 0.0 {
            let found = format!("{total} at vertex {v}");
            let sets = if sets.len() > 1 { format!("WEIGHTS_0 to {}", sets.len() - 1) } else { "WEIGHTS_0".to_owned() };
            return Err(Fault::pointer(format!("{at}/WEIGHTS_0"), format!("{sets} that add up to 1"), found));
        }
    }
    if weightless > 0 {
        notes.push(format!(
            "{at}/WEIGHTS_0: {weightless} of {vertices} vertices have no weight: they follow their first joint"
        ));
    }
    Ok(Skinning::Skin { width, bones: all_bones, weights: all_weights })
}
