//! Places in a layer that say something about a prim.

use std::cmp::Reverse;
use std::collections::{HashMap, HashSet};
use std::rc::Rc;

use super::super::document::{Prim, Value, Variant, field};

/// Metadata with the selected variants, and with the names of the sets, the strongest first.
pub(super) const SELECTION: &str = "variants";
pub(super) const SETS: &str = "variantSets";

/// Path of a prim, as names from the root.
pub(super) type PrimPath<'a> = Vec<&'a str>;

/// How a place comes to say something about a prim; the strongest first.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Kind {
    Local,
    Inherit,
    Variant,
    Reference,
    Payload,
    Specialize,
}

/// Place in the layer that says something about a prim, and the places to which arcs from there, or from above, lead.
pub(super) struct Node<'a> {
    pub(super) kind: Kind,
    /// What the place says; `None` if it only has arcs.
    pub(super) prim: Option<&'a Prim>,
    pub(super) path: PrimPath<'a>,
    /// Where the arc leads, and where it starts: targets below the former become targets below the latter.
    pub(super) map: Option<Rc<(PrimPath<'a>, PrimPath<'a>)>>,
    /// Length of the path at which the arc starts: that of the node above, or less if it starts above.
    pub(super) depth: usize,
    /// Variant sets of the prim of which a variant has been added.
    pub(super) sets: Vec<&'a str>,
    pub(super) nodes: Vec<Node<'a>>,
}

impl<'a> Node<'a> {
    pub(super) fn new(prim: &'a Prim, path: PrimPath<'a>) -> Self {
        let depth = path.len();
        Self { kind: Kind::Local, prim: Some(prim), path, map: None, depth, sets: vec![], nodes: vec![] }
    }

    /// The node as the end of an arc from the prim at `from`.
    pub(super) fn reached_by(self, kind: Kind, from: PrimPath<'a>) -> Self {
        let depth = from.len();
        Self { kind, depth, map: Some(Rc::new((self.path.clone(), from))), ..self }
    }

    /// Sorts the nodes below by strength: among arcs of one kind, those that start further down come first.
    pub(super) fn sort(&mut self) {
        self.nodes.sort_by_key(|node| (node.kind, Reverse(node.depth)));
    }

    /// Whether the arc to `node`, below this one, starts at the prim itself, not at one above.
    pub(super) fn states(&self, node: &Self) -> bool {
        node.depth == self.path.len()
    }

    /// Whether arcs start at the prim itself.
    pub(super) fn has_arcs(&self) -> bool {
        self.nodes.iter().any(|node| self.states(node) || node.has_arcs())
    }

    /// Keeps of what is said about the prims below an instance what its own arcs lead to: USD ignores the rest.
    pub(super) fn leave_to_arcs(&mut self) {
        self.prim = None;
        let depth = self.path.len();
        self.nodes.iter_mut().filter(|node| node.depth < depth).for_each(Self::leave_to_arcs);
    }

    /// Whether the place is a variant of the prim itself, which has no specifier, not something below one.
    pub(super) fn is_variant(&self) -> bool {
        self.kind == Kind::Variant && self.depth == self.path.len()
    }

    pub(super) fn has_variants(&self) -> bool {
        self.prim.is_some_and(|prim| !prim.variants.is_empty()) || self.nodes.iter().any(Self::has_variants)
    }

    /// Adds the variants that are selected, by set, and returns the number of nodes; the strongest selection counts.
    pub(super) fn selections(&self, chosen: &mut HashMap<&'a str, &'a str>) -> usize {
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
    pub(super) fn next_variant(&self, chosen: &HashMap<&'a str, &'a str>) -> Option<&'a Variant> {
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

/// Items of a list, or a single one.
pub(super) fn items(value: &Value) -> &[Value] {
    if let Value::List(all) = value { all } else { std::slice::from_ref(value) }
}

/// Path of the prim at `path`, which may be relative to the prim at `from`.
pub(super) fn resolved<'a>(from: &[&'a str], path: &'a str) -> PrimPath<'a> {
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
