//! What places in a layer say about a prim, and how it is put together.

use std::collections::{HashSet, VecDeque};

use super::super::document::{Field, Prim, Property, PropertyKind, Specifier, Targets, split_property};
use super::node::{Kind, Node, PrimPath, resolved};

/// What a place says about a prim.
pub(super) struct Opinion<'t, 'a> {
    pub(super) node: &'t Node<'a>,
    pub(super) prim: &'a Prim,
    /// Maps of the arcs between the place and the prim, from the place.
    pub(super) maps: Vec<&'t (PrimPath<'a>, PrimPath<'a>)>,
    /// Whether the prim itself inherits it, instead of one above.
    pub(super) is_inherited: bool,
}

/// What is said about the prim of a tree, the strongest first. What is specialised is weaker than all else.
pub(super) fn opinions<'t, 'a>(root: &'t Node<'a>) -> Vec<Opinion<'t, 'a>> {
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
pub(super) fn specifier(opinions: &[Opinion<'_, '_>]) -> Specifier {
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
    pub(super) fn put_targets(&self, property: &mut Property, stated: &Property) {
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
    pub(super) fn add_to(&self, property: &mut Property, stated: &Property) {
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
pub(super) fn blank(stated: &Property) -> Property {
    let kind = match &stated.kind {
        PropertyKind::Attribute { type_name, .. } => {
            PropertyKind::Attribute { type_name: type_name.clone(), value: None, samples: vec![], connections: None }
        }
        PropertyKind::Relationship { .. } => PropertyKind::Relationship { targets: None },
    };
    Property { name: stated.name.clone(), custom: stated.custom, uniform: stated.uniform, kind, metadata: vec![] }
}
