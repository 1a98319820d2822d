//! Composition within a layer: what prims inherit, refer to or specialise in the same layer, and variants that are
//! selected, in USD's order of strength (LIVRPS). Arcs to other layers are not followed.
//!
//! Each prim has a tree of [`Node`]s, the places in the layer that say something about it: [`Composer::grow`] adds
//! those to which arcs of the prim lead, [`Composer::select`] the selected variants, and [`Composer::child`] goes on to
//! a prim below. The prim is then what these places say, the strongest first.

mod node;
mod opinion;
mod weight;

use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet};

use self::node::{Kind, Node, PrimPath, SELECTION, SETS, items, resolved};
use self::opinion::{blank, opinions, specifier};
use self::weight::weight;
use super::document::{Field, Layer, ListEdit, Prim, Value, Variant, field};
use crate::format::error::Fault;

/// Metadata that may refer to other layers. What still has them after composition does.
pub(super) const OUTWARD: [&str; 2] = ["references", "payload"];

/// Metadata that state arcs.
const ARCS: [(&str, Kind); 4] = [
    ("inherits", Kind::Inherit),
    ("references", Kind::Reference),
    ("payload", Kind::Payload),
    ("specializes", Kind::Specialize),
];

/// Bytes of prims allowed per byte of the layer's prims, beyond the amount allowed for any layer (`ALWAYS`). References
/// to what refers to others multiply memory; real files stay far below.
const MAX_RATIO: usize = 256;
const ALWAYS: usize = 1 << 27;

/// Bytes of prims allowed for a layer, if it does not have a quarter of them itself.
const MOST: usize = 1 << 31;

/// Bytes of a node with its path, its arc and room for nodes below it.
const NODE: usize = 8 * size_of::<Node<'_>>();

/// Greatest nesting depth of prims, as in a layer, and of arcs that lead to arcs: far below what a thread's stack can
/// hold.
const MAX_DEPTH: usize = 200;

/// Reasons for which arcs are not followed.
const CIRCLE: &str = "an arc that leads back to its own prim, or through too many others, is not followed";
const ASTRAY: &str = "a reference to a prim that is not in the layer is not followed";

/// Follows the arcs of a layer; also returns notes on those within the layer that cannot be followed.
///
/// # Errors
/// If prims would be nested too deeply, or take too much memory for a layer of this size.
pub(super) fn composed(mut layer: Layer) -> Result<(Layer, Vec<String>), Fault> {
    let wanted: Vec<bool> = layer.prims.iter().map(needs_composition).collect();
    if !wanted.contains(&true) {
        return Ok((layer, vec![]));
    }
    let (prims, notes) = {
        let mut composer = Composer::new(&layer);
        let mut prims = vec![];
        for (prim, _) in layer.prims.iter().zip(&wanted).filter(|(_, is_wanted)| **is_wanted) {
            prims.push(composer.prim(Node::new(prim, vec![prim.name.as_str()]))?);
        }
        (prims, composer.notes())
    };
    // Prims without arcs in them stay as they are, without a copy.
    let stale = layer.prims.iter_mut().zip(wanted).filter(|(_, is_wanted)| *is_wanted);
    stale.zip(prims).for_each(|((old, _), new)| *old = new);
    Ok((layer, notes))
}

/// Whether a prim or one below has variants, or states other arcs than to other layers.
fn needs_composition(prim: &Prim) -> bool {
    let mut prims = vec![prim];
    while let Some(prim) = prims.pop() {
        let arcs = arcs(prim, &[], &[]);
        let is_outward = !arcs.is_empty() && arcs.iter().all(|(_, target)| target.is_none());
        let states_more = !is_outward && prim.metadata.iter().any(|field| is_of_composition(&field.name));
        if !prim.variants.is_empty() || states_more {
            return true;
        }
        prims.extend(&prim.children);
    }
    false
}

/// Arcs that a prim at `from` states, and the prims of the layer to which they lead; `None` for those to other layers.
/// `default` is the path of the default prim.
fn arcs<'a>(prim: &'a Prim, from: &[&'a str], default: &[&'a str]) -> Vec<(Kind, Option<PrimPath<'a>>)> {
    let mut found = vec![];
    for (name, kind) in ARCS {
        let stated = prim.metadata.iter().filter(|f| f.name == name && f.edit.is_none_or(ListEdit::adds));
        let mut fields: Vec<&Field> = stated.collect();
        fields.sort_by_key(|f| ListEdit::place(f.edit));
        for value in fields.into_iter().flat_map(|f| items(&f.value)) {
            let target = match value {
                Value::Path(path) => Some(path.as_str()),
                Value::Reference(asset, path) if asset.is_empty() => Some(path.as_str()),
                Value::Asset(asset) if asset.is_empty() => Some(""),
                Value::Asset(_) | Value::Reference(..) => None,
                _ => continue,
            };
            let at = |path: &'a str| if path.is_empty() { default.to_vec() } else { resolved(from, path) };
            found.push((kind, target.map(at)));
        }
    }
    found
}

/// Whether an arc to `target` from the last of `chain`, each of which led to the next, leads back: a prim would be
/// below itself.
fn leads_back(target: &[&str], chain: &[PrimPath<'_>]) -> bool {
    let is_around = |path: &PrimPath<'_>| path.starts_with(target) || target.starts_with(path);
    !target.is_empty() && chain.iter().any(is_around)
}

/// Path for messages; of a very long one, the end.
fn shown(path: &[&str]) -> String {
    const MOST: usize = 200;
    let text: String = path.iter().flat_map(|name| ["/", *name]).collect();
    let surplus = text.chars().count().saturating_sub(MOST);
    if surplus == 0 { text } else { format!("…{}", text.chars().skip(surplus).collect::<String>()) }
}

struct Composer<'a> {
    /// Prims of the layer and of its variants by the one above, `None` for the root, and by name.
    children: HashMap<(Option<*const Prim>, &'a str), &'a Prim>,
    default: PrimPath<'a>,
    /// Prims with arcs that are not followed, by reason.
    left_out: BTreeMap<&'static str, BTreeSet<PrimPath<'a>>>,
    /// Bytes of prims and nodes that the layer may take, and those that are left.
    most: usize,
    left: usize,
    /// Nodes at which arcs are being followed.
    nesting: usize,
}

impl<'a> Composer<'a> {
    fn new(layer: &'a Layer) -> Self {
        let (mut children, mut bytes) = (HashMap::new(), 0);
        for prim in &layer.prims {
            children.entry((None, prim.name.as_str())).or_insert(prim);
        }
        let mut prims: Vec<&Prim> = layer.prims.iter().collect();
        while let Some(prim) = prims.pop() {
            bytes += weight(prim, 0);
            for child in &prim.children {
                children.entry((Some(std::ptr::from_ref(prim)), child.name.as_str())).or_insert(child);
            }
            prims.extend(&prim.children);
            prims.extend(prim.variants.iter().map(|variant| &variant.content));
        }
        let default = layer.field("defaultPrim").and_then(Value::as_text);
        let most = ALWAYS.saturating_add(MAX_RATIO.saturating_mul(bytes)).min(MOST.max(bytes.saturating_mul(4)));
        Self {
            children,
            default: default.map_or_else(Vec::new, |path| resolved(&[], path)),
            left_out: BTreeMap::new(),
            most,
            left: most,
            nesting: 0,
        }
    }

    fn notes(&self) -> Vec<String> {
        let note = |(what, places): (&&str, &BTreeSet<PrimPath<'_>>)| {
            let first = places.first().map_or_else(String::new, |path| shown(path));
            match places.len() {
                1 => format!("{first}: {what}"),
                n => format!("{first} and {} more: {what}", n - 1),
            }
        };
        self.left_out.iter().map(note).collect()
    }

    /// Reserves memory for a part of the prim at `path`.
    fn spend(&mut self, bytes: usize, path: &[&str]) -> Result<(), Fault> {
        let too_many = || {
            let expected = format!("prims of at most {} bytes, composed of a layer of this size", self.most);
            Fault::pointer(shown(path), expected, "more, by repeated use")
        };
        self.left = self.left.checked_sub(bytes).ok_or_else(too_many)?;
        Ok(())
    }

    /// Composes the prim of a tree that has what comes from above, and the prims below it.
    fn prim(&mut self, mut node: Node<'a>) -> Result<Prim, Fault> {
        if node.path.len() > MAX_DEPTH {
            let expected = format!("at most {MAX_DEPTH} levels of prims");
            return Err(Fault::pointer(shown(&node.path), expected, "more, by references"));
        }
        self.grow(&mut node, &mut vec![])?;
        self.select(&mut node)?;
        let mut prim = self.merged(&node)?;
        let is_instance = field(&prim.metadata, "instanceable").and_then(Value::as_number) == Some(1.0);
        if is_instance && node.has_arcs() {
            node.leave_to_arcs();
        }
        // In USD's order, those of the weakest opinion come first.
        let (mut names, mut known) = (vec![], HashSet::new());
        for opinion in opinions(&node).iter().rev() {
            let all = opinion.prim.children.iter().map(|child| child.name.as_str());
            names.extend(all.filter(|name| known.insert(*name)));
        }
        for name in names {
            if let Some(child) = self.child(&node, name)? {
                prim.children.push(self.prim(child)?);
            }
        }
        Ok(prim)
    }

    /// Tree of the prim `name` below that of a tree, with what comes from above; `None` if nothing is said about it.
    fn child(&mut self, node: &Node<'a>, name: &'a str) -> Result<Option<Node<'a>>, Fault> {
        let prim = node.prim.and_then(|prim| self.stated(Some(prim), name));
        let mut nodes = vec![];
        for inner in &node.nodes {
            nodes.extend(self.child(inner, name)?);
        }
        if prim.is_none() && nodes.is_empty() {
            return Ok(None);
        }
        let path = [&node.path[..], &[name]].concat();
        self.spend(NODE + size_of_val(&path[..]), &path)?;
        let Node { kind, depth, .. } = *node;
        Ok(Some(Node { kind, prim, path, map: node.map.clone(), depth, sets: vec![], nodes }))
    }

    /// Follows the arcs that start at the prim of a tree, in all places that say something about it. `chain` has the
    /// paths of the nodes above, and of those from which an arc led here.
    fn grow(&mut self, node: &mut Node<'a>, chain: &mut Vec<PrimPath<'a>>) -> Result<(), Fault> {
        self.nesting += 1;
        chain.push(node.path.clone());
        for inner in &mut node.nodes {
            self.grow(inner, chain)?;
        }
        for (kind, target) in node.prim.map_or_else(Vec::new, |prim| arcs(prim, &node.path, &self.default)) {
            if let Some(target) = target
                && let Some(found) = self.follow(kind, &target, chain)?
            {
                node.nodes.push(found.reached_by(kind, node.path.clone()));
            }
        }
        // What a place inherits from beside it is also inherited from beside the prim that refers to it.
        for path in implied(node) {
            if let Some(prim) = self.stated_at(&path).filter(|_| !leads_back(&path, chain)) {
                let mut class = Node::new(prim, path);
                self.grow(&mut class, chain)?;
                node.nodes.push(class.reached_by(Kind::Inherit, node.path.clone()));
            }
        }
        node.sort();
        chain.pop();
        self.nesting -= 1;
        Ok(())
    }

    /// Tree of the prim to which an arc from the last of `chain` leads, if it can be followed.
    fn follow(
        &mut self,
        kind: Kind,
        target: &[&'a str],
        chain: &mut Vec<PrimPath<'a>>,
    ) -> Result<Option<Node<'a>>, Fault> {
        let from = chain.last().cloned().unwrap_or_default();
        let reason = if leads_back(target, chain) || self.nesting > MAX_DEPTH {
            CIRCLE
        } else {
            let found = self.at(target, chain)?;
            // Classes may be absent.
            if found.is_some() || matches!(kind, Kind::Inherit | Kind::Specialize) {
                return Ok(found);
            }
            ASTRAY
        };
        self.left_out.entry(reason).or_default().insert(from);
        Ok(None)
    }

    /// Tree of the prim at a path of the layer, composed but for its variants, which whatever refers to it may select.
    fn at(&mut self, path: &[&'a str], chain: &mut Vec<PrimPath<'a>>) -> Result<Option<Node<'a>>, Fault> {
        let Some((&first, rest)) = path.split_first() else { return Ok(None) };
        let Some(prim) = self.stated(None, first) else { return Ok(None) };
        self.spend(NODE, path)?;
        let mut node = Node::new(prim, vec![first]);
        for &name in rest {
            self.grow(&mut node, &mut vec![])?;
            self.select(&mut node)?;
            let Some(child) = self.child(&node, name)? else { return Ok(None) };
            node = child;
        }
        self.grow(&mut node, chain)?;
        Ok(Some(node))
    }

    /// Prim `name` that is stated below another, `None` for the root.
    fn stated(&self, above: Option<&Prim>, name: &'a str) -> Option<&'a Prim> {
        let key = (above.map(std::ptr::from_ref::<Prim>), name);
        self.children.get(&key).copied()
    }

    /// Prim that is stated at a path itself, not by arcs.
    fn stated_at(&self, path: &[&'a str]) -> Option<&'a Prim> {
        let mut found = None;
        for &name in path {
            found = Some(self.stated(found, name)?);
        }
        found
    }

    /// Adds the selected variants of a tree, one by one: each may select others.
    fn select(&mut self, node: &mut Node<'a>) -> Result<(), Fault> {
        while node.has_variants() {
            let mut chosen = HashMap::new();
            let count = node.selections(&mut chosen);
            // All are looked at again for each that is added.
            self.spend(count * size_of::<Node<'_>>() + chosen.len() * NODE, &node.path)?;
            if !self.add_variant(node, &chosen, &mut vec![])? {
                break;
            }
        }
        Ok(())
    }

    /// Adds the strongest variant that is selected and has not been added; false if there is none.
    fn add_variant(
        &mut self,
        node: &mut Node<'a>,
        chosen: &HashMap<&'a str, &'a str>,
        chain: &mut Vec<PrimPath<'a>>,
    ) -> Result<bool, Fault> {
        chain.push(node.path.clone());
        self.nesting += 1;
        let mut is_added = false;
        if let Some(Variant { set, content, .. }) = node.next_variant(chosen) {
            node.sets.push(set);
            let mut variant = Node { kind: Kind::Variant, ..Node::new(content, node.path.clone()) };
            self.grow(&mut variant, chain)?;
            node.nodes.push(variant);
            node.sort();
            is_added = true;
        }
        for inner in &mut node.nodes {
            is_added = is_added || self.add_variant(inner, chosen, chain)?;
        }
        self.nesting -= 1;
        chain.pop();
        Ok(is_added)
    }

    /// The prim of a tree, without those below.
    fn merged(&mut self, node: &Node<'a>) -> Result<Prim, Fault> {
        let opinions = opinions(node);
        let type_name = opinions.iter().map(|opinion| opinion.prim.type_name.as_str()).find(|name| !name.is_empty());
        let name = node.path.last().copied().unwrap_or_default();
        let specifier = specifier(&opinions);
        let mut prim = Prim { specifier, ..Prim::new(type_name.unwrap_or_default(), name) };
        let longest: usize = node.path.iter().map(|name| 1 + name.len()).sum();
        let (mut places, mut stated, mut outward) = (HashMap::new(), HashSet::new(), BTreeSet::new());
        for opinion in &opinions {
            self.spend(weight(opinion.prim, if opinion.maps.is_empty() { 0 } else { longest }), &node.path)?;
            for property in &opinion.prim.properties {
                let place = *places.entry(property.name.as_str()).or_insert_with(|| {
                    prim.properties.push(blank(property));
                    prim.properties.len() - 1
                });
                opinion.add_to(&mut prim.properties[place], property);
            }
            let is_new = |field: &&Field| !is_of_composition(&field.name) && !stated.contains(field.name.as_str());
            let fields: Vec<&Field> = opinion.prim.metadata.iter().filter(is_new).collect();
            stated.extend(fields.iter().map(|field| field.name.as_str()));
            prim.metadata.extend(fields.into_iter().cloned());
            let arcs = arcs(opinion.prim, &opinion.node.path, &self.default);
            outward.extend(arcs.into_iter().filter(|(_, target)| target.is_none()).map(|(kind, _)| kind));
        }
        for opinion in opinions.iter().rev() {
            for stated in &opinion.prim.properties {
                if let Some(&place) = places.get(stated.name.as_str()) {
                    opinion.put_targets(&mut prim.properties[place], stated);
                }
            }
        }
        let left = ARCS.into_iter().filter(|(_, kind)| outward.contains(kind));
        prim.metadata.extend(left.map(|(name, _)| Field {
            edit: None,
            name: name.to_owned(),
            value: Value::List(vec![]),
        }));
        // Of sets without a selected variant, it matters only that they are there.
        let mut sets: HashSet<&str> = opinions.iter().flat_map(|opinion| &opinion.node.sets).copied().collect();
        for variant in opinions.iter().flat_map(|opinion| &opinion.prim.variants) {
            if sets.insert(&variant.set) {
                let set = variant.set.clone();
                prim.variants.push(Variant { set, name: String::new(), content: Prim::default() });
            }
        }
        Ok(prim)
    }
}

/// Paths from which a prim inherits because a place to which its arcs lead inherits from a prim beside it.
fn implied<'a>(node: &Node<'a>) -> Vec<PrimPath<'a>> {
    let mut paths = vec![];
    for inner in &node.nodes {
        let Some((target, start)) = inner.map.as_deref() else { continue };
        for class in inner.nodes.iter().filter(|class| class.kind == Kind::Inherit && inner.states(class)) {
            if class.path.starts_with(target) && target != start {
                paths.push([&start[..], &class.path[target.len()..]].concat());
            }
        }
    }
    paths
}

fn is_of_composition(name: &str) -> bool {
    [SELECTION, SETS].contains(&name) || ARCS.iter().any(|(arc, _)| *arc == name)
}
