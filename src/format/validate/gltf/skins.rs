//! Validation of skins: joints and their matrices, and the joints and weights of vertices.

use std::collections::{HashMap, HashSet};

use serde_json::Value;

use super::super::{Findings, Offenders};
use super::document::{Component, Document, Elements};
use super::scenes::children;
use super::{index, items, objects, primitives};
use crate::format::gltf::json::indices;

/// Largest deviation of a vertex's sum of weights from 1, for each weight other than 0: that of Khronos' validator (glTF
/// 2.0, 3.7.3.3). For integers it is less than a step.
const WEIGHT_TOLERANCE: f64 = 2e-7;

pub(super) fn check(document: &Document<'_>, findings: &mut Findings) {
    check_skins(document, findings);
    check_nodes(document, findings);
    for (at, primitive) in primitives(document.root) {
        check_weights(document, primitive, &format!("{at}/attributes"), findings);
    }
}

fn check_skins(document: &Document<'_>, findings: &mut Findings) {
    for (at, skin) in objects(document.root, "skins", "") {
        let joints = items(skin, "joints").len();
        let Some(m) = index(skin, "inverseBindMatrices").and_then(|i| document.elements(i)) else { continue };
        let at = format!("{at}/inverseBindMatrices");
        if m.count < joints || m.components != 16 || m.kind != Component::Float {
            let expected = format!("MAT4 of Float, one for each of {joints} joints");
            let found = format!("{} elements of {} components of {:?}", m.count, m.components, m.kind);
            findings.error("SKIN_MATRICES", at, expected, found);
            continue;
        }
        let mut offenders = Offenders::default();
        for i in 0..m.count {
            let last = [3, 7, 11, 15].map(|c| m.raw(i, c));
            if last != [0.0, 0.0, 0.0, 1.0] {
                offenders.note(|| format!("{last:?} of matrix {i}"));
            }
        }
        if let Some(found) = offenders.summary(m.count) {
            findings.error("SKIN_MATRICES", at, "[0.0, 0.0, 0.0, 1.0] as the fourth row", found);
        }
    }
}

/// Checks nodes with skins, and the places of their joints in the hierarchy.
fn check_nodes(document: &Document<'_>, findings: &mut Findings) {
    let root = document.root;
    let is_bound = |(_, primitive): (String, &Value)| {
        primitive.get("attributes").is_some_and(|attributes| attributes.get("JOINTS_0").is_some())
    };
    let bound: Vec<bool> =
        objects(root, "meshes", "").map(|(at, mesh)| objects(mesh, "primitives", &at).any(is_bound)).collect();
    // Every pair of mesh and skin is checked once, regardless of the number of its nodes.
    let (mut checked, mut largest) = (HashSet::new(), HashMap::new());
    for (at, node) in objects(root, "nodes", "") {
        let mesh = index(node, "mesh");
        if let Some(pair) = mesh.zip(index(node, "skin")).filter(|pair| checked.insert(*pair)) {
            check_bound(document, pair, &at, &mut largest, findings);
        }
        if node.get("skin").is_none() && mesh.is_some_and(|mesh| bound.get(mesh) == Some(&true)) {
            findings.warning("NODE_SKIN", at, "a skin beside a mesh with JOINTS_0", "none");
        }
    }
    if !items(root, "skins").is_empty() {
        check_joints(root, findings);
    }
}

/// Checks the joints and weights of the mesh of a node with a skin. `largest` holds the largest joint of each primitive
/// of the meshes seen before.
fn check_bound(
    document: &Document<'_>,
    (i, skin): (usize, usize),
    at: &str,
    largest: &mut HashMap<usize, Vec<f64>>,
    findings: &mut Findings,
) {
    let (Some(mesh), Some(skin)) = (document.object("meshes", i), document.object("skins", skin)) else { return };
    let joints = items(skin, "joints").len();
    let above = format!("/meshes/{i}");
    let of_mesh =
        || objects(mesh, "primitives", &above).map(|(at, object)| (at, Influences::of(document, object), object));
    let largest = largest.entry(i).or_insert_with(|| of_mesh().map(|(_, all, _)| all.largest_joint()).collect());
    for ((place, influences, primitive), largest) in of_mesh().zip(largest) {
        if influences.sets.is_empty() {
            // Those that are there but cannot be read have findings of their own, or are compressed.
            let has = |name: &str| primitive.get("attributes").is_some_and(|all| all.get(name).is_some());
            if !(has("JOINTS_0") && has("WEIGHTS_0")) {
                let found = format!("no such pair, and the skin of {at}");
                findings.error("SKIN_WEIGHTS", place, "JOINTS_0 and WEIGHTS_0", found);
            }
            continue;
        }
        let mut beyond = Offenders::default();
        // One mesh may have many skins.
        let vertices = if *largest < joints as f64 { 0 } else { influences.vertices };
        for v in 0..vertices {
            // Indices of joints with zero weight need not be valid.
            if let Some((joint, _)) = influences.of_vertex(v).find(|&(joint, _)| joint >= joints as f64) {
                beyond.note(|| format!("{joint} at vertex {v}"));
            }
        }
        if let Some(found) = beyond.summary(influences.vertices) {
            let expected = format!("joints below {joints}, as the skin of {at} has");
            findings.error("SKIN_JOINTS", format!("{place}/attributes/JOINTS_0"), expected, found);
        }
    }
}

/// Checks that the weights of every vertex add up to 1 and are each of another joint.
fn check_weights(document: &Document<'_>, primitive: &Value, at: &str, findings: &mut Findings) {
    let influences = Influences::of(document, primitive);
    let (mut negative, mut uneven, mut twice) = (Offenders::default(), Offenders::default(), Offenders::default());
    let mut joints = vec![];
    for v in 0..influences.vertices {
        joints.clear();
        let mut total: f64 = 0.0;
        for (joint, weight) in influences.of_vertex(v) {
            if weight < 0.0 {
                negative.note(|| format!("{weight} at vertex {v}"));
            }
            total += weight;
            joints.push(joint);
        }
        // NaN has a finding of its own.
        if (total - 1.0).abs() > WEIGHT_TOLERANCE * joints.len() as f64 {
            uneven.note(|| format!("{total} at vertex {v}"));
        }
        joints.sort_by(f64::total_cmp);
        if let Some(pair) = joints.windows(2).find(|pair| pair[0] == pair[1]) {
            twice.note(|| format!("joint {} at vertex {v}", pair[0]));
        }
    }
    for (code, name, offenders, expected) in [
        ("SKIN_WEIGHTS", "WEIGHTS_0", negative, "weights from 0"),
        ("SKIN_JOINTS", "JOINTS_0", twice, "every joint with a weight once per vertex"),
    ] {
        if let Some(found) = offenders.summary(influences.vertices) {
            findings.error(code, format!("{at}/{name}"), expected, found);
        }
    }
    if let Some(found) = uneven.summary(influences.vertices) {
        let (at, expected) = (format!("{at}/WEIGHTS_0"), "weights that add up to 1");
        // Sums of integers must be exact, those of floats should be near.
        if influences.sets.iter().all(|(_, weights)| weights.kind == Component::Float) {
            findings.warning("SKIN_WEIGHTS", at, expected, found);
        } else {
            findings.error("SKIN_WEIGHTS", at, expected, found);
        }
    }
}

/// Joints and weights of a primitive's vertices.
struct Influences<'a> {
    sets: Vec<(Elements<'a>, Elements<'a>)>,
    vertices: usize,
}

impl<'a> Influences<'a> {
    fn of(document: &'a Document<'_>, primitive: &Value) -> Self {
        let set = |name: &str, n: usize| {
            let accessor = primitive.get("attributes")?.get(format!("{name}_{n}"))?.as_u64()?;
            document.elements(accessor as usize).filter(|e| e.components == 4)
        };
        let sets: Vec<_> = (0..).map_while(|n| set("JOINTS", n).zip(set("WEIGHTS", n))).collect();
        let counts = sets.iter().map(|(joints, weights)| joints.count.min(weights.count));
        let vertices = counts.min().unwrap_or_default();
        Self { sets, vertices }
    }

    /// Largest joint of any vertex, at least 0.
    fn largest_joint(&self) -> f64 {
        (0..self.vertices).flat_map(|v| self.of_vertex(v)).map(|(joint, _)| joint).fold(0.0, f64::max)
    }

    /// Joints of a vertex, each with its weight; those of weight 0 do not count.
    fn of_vertex(&self, v: usize) -> impl Iterator<Item = (f64, f64)> {
        let of_set = move |(joints, weights): &(Elements<'_>, Elements<'_>)| {
            joints.vector::<4>(v).into_iter().zip(weights.vector::<4>(v))
        };
        self.sets.iter().flat_map(of_set).filter(|&(_, weight)| weight != 0.0)
    }
}

/// Place of a node in the hierarchy.
#[derive(Clone, Copy)]
struct Place {
    /// Ancestor without parent.
    top: usize,
    /// Number of the node if a node comes before its descendants, and the number after those of its descendants.
    first: usize,
    after: usize,
}

/// Places of nodes; `None` for those in cycles, which have findings of their own.
fn places(root: &Value) -> Vec<Option<Place>> {
    let nodes = items(root, "nodes");
    let below: HashSet<usize> = nodes.iter().flat_map(|node| children(node, nodes.len())).collect();
    let mut places: Vec<Option<Place>> = vec![None; nodes.len()];
    let mut first = 0;
    for top in (0..nodes.len()).filter(|i| !below.contains(i)) {
        // Every node is there again below its descendants.
        let mut stack = vec![(top, false)];
        while let Some((i, is_done)) = stack.pop() {
            if is_done {
                places[i] = places[i].map(|place| Place { after: first, ..place });
            } else if places[i].is_none() {
                // Later visits are of a node of several parents, which has a finding of its own.
                places[i] = Some(Place { top, first, after: first });
                first += 1;
                stack.push((i, true));
                stack.extend(children(&nodes[i], nodes.len()).into_iter().map(|child| (child, false)));
            }
        }
    }
    places
}

/// Checks that the joints of a skin have a common ancestor, which the skeleton is or has below, and that they are in
/// all scenes of the nodes with the skin.
fn check_joints(root: &Value, findings: &mut Findings) {
    let places = places(root);
    let place = |node: u64| usize::try_from(node).ok().and_then(|node| *places.get(node)?);
    let mut tops = vec![];
    for (at, skin) in objects(root, "skins", "") {
        let joints = || indices(skin, "joints").filter_map(move |joint| Some((joint, place(joint)?)));
        let first = joints().next();
        tops.push(first.map(|(_, place)| place.top));
        let Some((first, place_of_first)) = first else { continue };
        if let Some((other, _)) = joints().find(|(_, place)| place.top != place_of_first.top) {
            let found = format!("nodes {first} and {other}, which have none");
            findings.error("SKIN_ROOT", format!("{at}/joints"), "joints with a common ancestor", found);
            continue;
        }
        let Some(skeleton) = skin.get("skeleton").and_then(Value::as_u64) else { continue };
        let Some(above) = place(skeleton) else { continue };
        if let Some((joint, _)) = joints().find(|(_, place)| !(above.first..above.after).contains(&place.first)) {
            let expected = "a common ancestor of the joints, or one of them";
            let found = format!("node {skeleton}, which is not above node {joint}");
            findings.error("SKIN_SKELETON", format!("{at}/skeleton"), expected, found);
        }
    }
    let scenes: Vec<(String, HashSet<u64>)> =
        objects(root, "scenes", "").map(|(at, scene)| (at, indices(scene, "nodes").collect())).collect();
    let mut checked = HashSet::new();
    for ((at, node), place) in objects(root, "nodes", "").zip(&places) {
        let joints = index(node, "skin").and_then(|skin| *tops.get(skin)?);
        let pair = place.map(|place| place.top).zip(joints);
        let Some((own, joints)) = pair.filter(|pair| pair.0 != pair.1 && checked.insert(*pair)) else { continue };
        for (scene, nodes) in &scenes {
            let has = |node: usize| nodes.contains(&(node as u64));
            if has(own) && !has(joints) {
                let expected = format!("joints in {scene}, as the node is");
                findings.error("SKIN_SCENE", format!("{at}/skin"), expected, format!("others, below node {joints}"));
            }
        }
    }
}
