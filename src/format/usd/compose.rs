//! Composition within a layer: what prims inherit, refer to or specialise in the same layer, and variants that are
//! selected, in USD's order of strength (LIVRPS). Arcs to other layers are not followed.
//!
//! Each prim has a tree of [`Node`]s, the places in the layer that say something about it: [`Composer::grow`] adds
//! those to which arcs of the prim lead, [`Composer::select`] the selected variants, and [`Composer::child`] goes on to
//! a prim below. The prim is then what these places say, the strongest first.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet, VecDeque};
use std::rc::Rc;

use super::document::{
    Entry, Field, Layer, ListEdit, Prim, Property, PropertyKind, Specifier, Targets, Value, Variant, field,
    split_property,
};
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

/// Metadata with the selected variants, and with the names of the sets, the strongest first.
const SELECTION: &str = "variants";
const SETS: &str = "variantSets";

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

/// Path of a prim, as names from the root.
type PrimPath<'a> = Vec<&'a str>;

/// How a place comes to say something about a prim; the strongest first.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Kind {
    Local,
    Inherit,
    Variant,
    Reference,
    Payload,
    Specialize,
}

/// Place in the layer that says something about a prim, and the places to which arcs from there, or from above, lead.
struct Node<'a> {
    kind: Kind,
    /// What the place says; `None` if it only has arcs.
    prim: Option<&'a Prim>,
    path: PrimPath<'a>,
    /// Where the arc leads, and where it starts: targets below the former become targets below the latter.
    map: Option<Rc<(PrimPath<'a>, PrimPath<'a>)>>,
    /// Length of the path at which the arc starts: that of the node above, or less if it starts above.
    depth: usize,
    /// Variant sets of the prim of which a variant has been added.
    sets: Vec<&'a str>,
    nodes: Vec<Node<'a>>,
}

/// What a place says about a prim.
struct Opinion<'t, 'a> {
    node: &'t Node<'a>,
    prim: &'a Prim,
    /// Maps of the arcs between the place and the prim, from the place.
    maps: Vec<&'t (PrimPath<'a>, PrimPath<'a>)>,
    /// Whether the prim itself inherits it, instead of one above.
    is_inherited: bool,
}

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

/// Items of a list, or a single one.
fn items(value: &Value) -> &[Value] {
    if let Value::List(all) = value { all } else { std::slice::from_ref(value) }
}

/// Path of the prim at `path`, which may be relative to the prim at `from`.
fn resolved<'a>(from: &[&'a str], path: &'a str) -> PrimPath<'a> {
    let mut names = if path.starts_with('/') { vec![] } else { from.to_vec() };
    for name in path.split('/').filter(|name| !matches!(*name, "" | ".")) {
        if name == ".." {
            names.pop();
        } else {
            names.push(name);
        }
    }
    names
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

impl<'a> Node<'a> {
    fn new(prim: &'a Prim, path: PrimPath<'a>) -> Self {
        let depth = path.len();
        Self { kind: Kind::Local, prim: Some(prim), path, map: None, depth, sets: vec![], nodes: vec![] }
    }

    /// The node as the end of an arc from the prim at `from`.
    fn reached_by(self, kind: Kind, from: PrimPath<'a>) -> Self {
        let depth = from.len();
        Self { kind, depth, map: Some(Rc::new((self.path.clone(), from))), ..self }
    }

    /// Sorts the nodes below by strength: among arcs of one kind, those that start further down come first.
    fn sort(&mut self) {
        self.nodes.sort_by_key(|node| (node.kind, Reverse(node.depth)));
    }

    /// Whether the arc to `node`, below this one, starts at the prim itself, not at one above.
    fn states(&self, node: &Self) -> bool {
        node.depth == self.path.len()
    }

    /// Whether arcs start at the prim itself.
    fn has_arcs(&self) -> bool {
        self.nodes.iter().any(|node| self.states(node) || node.has_arcs())
    }

    /// Keeps of what is said about the prims below an instance what its own arcs lead to: USD ignores the rest.
    fn leave_to_arcs(&mut self) {
        self.prim = None;
        let depth = self.path.len();
        self.nodes.iter_mut().filter(|node| node.depth < depth).for_each(Self::leave_to_arcs);
    }

    /// Whether the place is a variant of the prim itself, which has no specifier, not something below one.
    fn is_variant(&self) -> bool {
        self.kind == Kind::Variant && self.depth == self.path.len()
    }

    fn has_variants(&self) -> bool {
        self.prim.is_some_and(|prim| !prim.variants.is_empty()) || self.nodes.iter().any(Self::has_variants)
    }

    /// Adds the variants that are selected, by set, and returns the number of nodes; the strongest selection counts.
    fn selections(&self, chosen: &mut HashMap<&'a str, &'a str>) -> usize {
        for field in self.prim.into_iter().flat_map(|prim| &prim.metadata).filter(|field| field.name == SELECTION) {
            let Value::Dictionary(entries) = &field.value else { continue };
            for entry in entries {
                if let Some(name) = entry.value.as_text() {
                    chosen.entry(&entry.key).or_insert(name);
                }
            }
        }
        1 + self.nodes.iter().map(|node| node.selections(chosen)).sum::<usize>()
    }

    /// The selected variant of the strongest set that is still to be added.
    fn next_variant(&self, chosen: &HashMap<&'a str, &'a str>) -> Option<&'a Variant> {
        let prim = self.prim?;
        let names = field(&prim.metadata, SETS).map_or(&[][..], items);
        let known: HashSet<&str> = self.sets.iter().copied().collect();
        let mut places = HashMap::new();
        for (place, name) in names.iter().filter_map(Value::as_text).enumerate() {
            places.entry(name).or_insert(place);
        }
        let is_next = |variant: &&Variant| {
            let set = variant.set.as_str();
            chosen.get(set) == Some(&variant.name.as_str()) && !known.contains(set)
        };
        let place = |variant: &&Variant| places.get(variant.set.as_str()).copied().unwrap_or(names.len());
        prim.variants.iter().filter(is_next).min_by_key(place)
    }
}

/// What is said about the prim of a tree, the strongest first. What is specialised is weaker than all else.
fn opinions<'t, 'a>(root: &'t Node<'a>) -> Vec<Opinion<'t, 'a>> {
    let mut all = vec![];
    let mut waiting = VecDeque::from([(root, vec![], false)]);
    while let Some((node, maps, is_inherited)) = waiting.pop_front() {
        collect(node, maps, is_inherited, &mut all, &mut waiting);
    }
    all
}

/// Nodes whose opinions come last, with the fields of an [`Opinion`].
type Waiting<'t, 'a> = VecDeque<(&'t Node<'a>, Vec<&'t (PrimPath<'a>, PrimPath<'a>)>, bool)>;

fn collect<'t, 'a>(
    node: &'t Node<'a>,
    maps: Vec<&'t (PrimPath<'a>, PrimPath<'a>)>,
    is_inherited: bool,
    all: &mut Vec<Opinion<'t, 'a>>,
    waiting: &mut Waiting<'t, 'a>,
) {
    let below = maps.clone();
    if let Some(prim) = node.prim {
        all.push(Opinion { node, prim, maps, is_inherited });
    }
    for inner in &node.nodes {
        let maps = inner.map.as_deref().into_iter().chain(below.iter().copied()).collect();
        let is_inherited = is_inherited || inner.kind == Kind::Inherit && node.states(inner);
        if inner.kind == Kind::Specialize {
            waiting.push_back((inner, maps, is_inherited));
        } else {
            collect(inner, maps, is_inherited, all, waiting);
        }
    }
}

/// Specifier of a composed prim: that of the strongest opinion that defines it, of which a class that it inherits is
/// the weakest.
fn specifier(opinions: &[Opinion<'_, '_>]) -> Specifier {
    let defining = || {
        let all = opinions.iter().filter(|opinion| !opinion.node.is_variant());
        all.filter(|opinion| opinion.prim.specifier != Specifier::Over)
    };
    let own = defining().find(|opinion| !(opinion.is_inherited && opinion.prim.specifier == Specifier::Class));
    own.or_else(|| defining().next()).map_or(Specifier::Over, |opinion| opinion.prim.specifier)
}

impl Opinion<'_, '_> {
    /// Path as the composed prim has it, of a prim or property.
    fn moved(&self, path: &str) -> String {
        if self.maps.is_empty() {
            return path.to_owned();
        }
        let (prim, property) = split_property(path);
        let mut names = resolved(&self.node.path, prim);
        for (target, start) in &self.maps {
            if names.starts_with(target) {
                names = [&start[..], &names[target.len()..]].concat();
            }
        }
        let dot = if property.is_empty() { "" } else { "." };
        names.iter().flat_map(|name| ["/", *name]).chain([dot, property]).collect()
    }

    fn targets(&self, stated: Option<&Targets>) -> Option<Targets> {
        let Targets { edit, paths } = stated?;
        Some(Targets { edit: *edit, paths: paths.iter().map(|path| self.moved(path)).collect() })
    }

    /// Puts the targets that this opinion states over those of all weaker ones: edits of lists are no list until the
    /// weakest has been read.
    fn put_targets(&self, property: &mut Property, stated: &Property) {
        let (weaker, own) = match (&mut property.kind, &stated.kind) {
            (PropertyKind::Attribute { connections, .. }, PropertyKind::Attribute { connections: own, .. }) => {
                (connections, own)
            }
            (PropertyKind::Relationship { targets }, PropertyKind::Relationship { targets: own }) => (targets, own),
            _ => return,
        };
        *weaker = match (self.targets(own.as_ref()), weaker.take()) {
            (Some(own), Some(weaker)) => Some(own.over(weaker)),
            (own, weaker) => own.or(weaker),
        };
    }

    /// Adds to a property, of which stronger opinions said the rest, what this one says, but for targets.
    fn add_to(&self, property: &mut Property, stated: &Property) {
        let is_animated = property.has_spline();
        let has_value = match (&mut property.kind, &stated.kind) {
            (
                PropertyKind::Attribute { value, samples, .. },
                PropertyKind::Attribute { value: weaker, samples: weaker_samples, .. },
            ) => {
                // Samples and default are one opinion.
                let has_value = value.is_some() || !samples.is_empty() || is_animated;
                if !has_value {
                    value.clone_from(weaker);
                    samples.clone_from(weaker_samples);
                }
                has_value
            }
            (PropertyKind::Relationship { .. }, PropertyKind::Relationship { .. }) => false,
            // An attribute and a relationship of one name: the stronger stays.
            _ => return,
        };
        let known: HashSet<&str> = property.metadata.iter().map(|field| field.name.as_str()).collect();
        let is_new =
            |field: &&Field| !(known.contains(field.name.as_str()) || has_value && field.name == Property::SPLINE);
        let fields: Vec<Field> = stated.metadata.iter().filter(is_new).cloned().collect();
        property.metadata.extend(fields);
    }
}

/// Property of this name and kind of which nothing is known yet.
fn blank(stated: &Property) -> Property {
    let kind = match &stated.kind {
        PropertyKind::Attribute { type_name, .. } => {
            PropertyKind::Attribute { type_name: type_name.clone(), value: None, samples: vec![], connections: None }
        }
        PropertyKind::Relationship { .. } => PropertyKind::Relationship { targets: None },
    };
    Property { name: stated.name.clone(), custom: stated.custom, uniform: stated.uniform, kind, metadata: vec![] }
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

/// Memory of a prim without those below and without variants, in bytes, if its targets become longer by up to `longer`
/// bytes.
fn weight(prim: &Prim, longer: usize) -> usize {
    let of_targets = |targets: &Option<Targets>| {
        let paths = targets.iter().flat_map(|targets| &targets.paths);
        paths.map(|path| size_of::<String>() + path.len() + longer).sum::<usize>()
    };
    let of_property = |property: &Property| {
        let of_kind = match &property.kind {
            PropertyKind::Attribute { type_name, value, samples, connections } => {
                let values = value.iter().chain(samples.iter().map(|(_, value)| value));
                type_name.len() + values.map(weight_of_value).sum::<usize>() + of_targets(connections)
            }
            PropertyKind::Relationship { targets } => of_targets(targets),
        };
        size_of::<Property>() + property.name.len() + of_kind + weight_of_fields(&property.metadata)
    };
    let properties: usize = prim.properties.iter().map(of_property).sum();
    size_of::<Prim>() + prim.name.len() + properties + weight_of_fields(&prim.metadata)
}

fn weight_of_fields(fields: &[Field]) -> usize {
    fields.iter().map(|field| size_of::<Field>() + field.name.len() + weight_of_value(&field.value)).sum()
}

fn weight_of_value(value: &Value) -> usize {
    let content = match value {
        Value::Blocked | Value::Number(_) => 0,
        Value::Floats(all) => size_of_val(&all[..]),
        Value::Doubles(all) => size_of_val(&all[..]),
        Value::Integers(all) => size_of_val(&all[..]),
        Value::Text(text) | Value::Asset(text) | Value::Path(text) => text.len(),
        Value::Reference(asset, path) => asset.len() + path.len(),
        Value::List(all) | Value::Tuple(all) => all.iter().map(weight_of_value).sum(),
        Value::Dictionary(entries) => {
            let of_entry = |e: &Entry| size_of::<Entry>() + e.type_name.len() + e.key.len() + weight_of_value(&e.value);
            entries.iter().map(of_entry).sum()
        }
    };
    size_of::<Value>() + content
}
