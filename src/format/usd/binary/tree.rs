//! Conversion of paths and specs to prims.

use super::cursor::Cursor;
use super::values::Rep;
use super::{Crate, END, PathNode};
use crate::format::error::Fault;
use crate::format::usd::document::{Field, Layer, Prim, Property, PropertyKind, Specifier, Targets, Value, Variant};

/// Greatest nesting depth of prims, as in text.
const MAX_DEPTH: usize = 200;

/// Kinds of specs.
const ATTRIBUTE: i32 = 1;
const PRIM: i32 = 6;
const ROOT: i32 = 7;
const RELATIONSHIP: i32 = 8;
const VARIANT: i32 = 10;

/// Names of metadata of prims, and those that they have in text.
const RENAMED: [(&str, &str); 3] =
    [("inheritPaths", "inherits"), ("variantSelection", "variants"), ("variantSetNames", "variantSets")];

/// Content of a spec.
enum Spec {
    Prim(Prim),
    Property(Property),
    Variant(Variant),
}

impl Spec {
    /// What has children and properties: a prim, or the content of a variant.
    fn prim(&mut self) -> Option<&mut Prim> {
        match self {
            Self::Prim(prim) => Some(prim),
            Self::Variant(variant) => Some(&mut variant.content),
            Self::Property(_) => None,
        }
    }
}

/// Value, or samples of an animated value.
enum Content {
    Value(Value),
    Samples(Vec<(f64, Value)>),
}

/// Builds `total` nodes from the place, element and jump of every entry; `None` if they do not form a tree, in which
/// case the way up from a node might not end.
pub(super) fn nodes(total: usize, [places, elements, jumps]: &[Vec<i32>; 3]) -> Option<Vec<PathNode>> {
    let mut nodes: Vec<Option<PathNode>> = vec![None; total];
    let mut seen = vec![false; places.len()];
    // Entries still to be read, with the places of their parents.
    let mut stack: Vec<(usize, Option<usize>)> = if places.is_empty() { vec![] } else { vec![(0, None)] };
    while let Some((entry, parent)) = stack.pop() {
        let (seen, jump) = (seen.get_mut(entry)?, *jumps.get(entry)?);
        let place = places[entry] as u32 as usize;
        let depth = match parent {
            None => 0,
            Some(parent) => nodes[parent]?.depth + 1,
        };
        let node = nodes.get_mut(place)?;
        if std::mem::replace(seen, true) || node.is_some() || depth > MAX_DEPTH {
            return None;
        }
        let element = elements[entry];
        *node = Some(PathNode {
            parent: parent.unwrap_or(place),
            token: element.unsigned_abs(),
            is_property: element < 0,
            depth,
        });
        if jump >= 0 {
            let sibling = entry + if jump > 0 { jump as usize } else { 1 };
            stack.push((sibling, parent));
        }
        if jump > 0 || jump == -1 {
            stack.push((entry + 1, Some(place)));
        }
    }
    Some(nodes.into_iter().map(Option::unwrap_or_default).collect())
}

impl Crate<'_> {
    /// Reads the tree of paths: for each path in depth-first order its place in the list, its last element, and whether
    /// a child, a sibling, or a child with a later sibling follows.
    pub(super) fn read_paths(&mut self, mut section: Cursor<'_>) -> Result<Vec<PathNode>, Fault> {
        let total = section.u64()?;
        let count = self.counted(&mut section, size_of::<[i32; 3]>() + size_of::<PathNode>())?;
        let entries = [section.integers(count)?, section.integers(count)?, section.integers(count)?];
        nodes(total.min(count as u64 + 1) as usize, &entries)
            .ok_or_else(|| Fault::whole("a tree of paths", "entries that are none"))
    }

    /// Builds the document from specs: path, set of fields and kind of each.
    pub(super) fn layer(&mut self, paths: &[i32], sets: &[i32], kinds: &[i32]) -> Result<Layer, Fault> {
        let mut layer = Layer::default();
        self.spend(self.paths.len() * (size_of::<Option<Spec>>() + size_of::<Vec<String>>()) / 8)?;
        let mut specs: Vec<Option<Spec>> = vec![];
        specs.resize_with(self.paths.len(), || None);
        // Names of children in order, by path.
        let mut orders: Vec<Vec<String>> = vec![vec![]; self.paths.len()];
        for ((&path, &set), &kind) in paths.iter().zip(sets).zip(kinds) {
            let path = path as u32 as usize;
            let Some(&node) = self.paths.get(path) else {
                return Err(Fault::whole(format!("paths below {}", self.paths.len()), path.to_string()));
            };
            if !matches!(kind, ATTRIBUTE | PRIM | ROOT | RELATIONSHIP | VARIANT) {
                continue;
            }
            let fields = self.field_set(set as u32)?;
            if let Some((_, Content::Value(Value::List(names)))) =
                fields.iter().find(|(name, _)| name == "primChildren")
            {
                orders[path] = names.iter().filter_map(Value::as_text).map(str::to_owned).collect();
            }
            specs[path] = Some(match kind {
                ROOT => {
                    layer.metadata = metadata(fields);
                    continue;
                }
                VARIANT => {
                    let element = self.name(node.token)?;
                    let metadata = prim(String::new(), fields).metadata;
                    Spec::Variant(variant(&element, Prim { metadata, ..Prim::default() }))
                }
                PRIM => Spec::Prim(prim(self.name(node.token)?, fields)),
                kind => Spec::Property(property(self.name(node.token)?, kind == ATTRIBUTE, fields)),
            });
        }
        Ok(self.assemble(layer, specs, &orders))
    }

    /// Attaches every spec to its parent, deepest first.
    fn assemble(&self, mut layer: Layer, mut specs: Vec<Option<Spec>>, orders: &[Vec<String>]) -> Layer {
        let mut by_depth: Vec<usize> = (0..specs.len()).filter(|&i| specs[i].is_some()).collect();
        by_depth.sort_by_key(|&i| std::cmp::Reverse(self.paths[i].depth));
        for i in by_depth {
            let Some(mut spec) = specs[i].take() else { continue };
            if let Some(prim) = spec.prim() {
                arrange(&mut prim.children, &orders[i]);
            }
            let above = specs.get_mut(self.paths[i].parent).and_then(Option::as_mut).and_then(Spec::prim);
            match (spec, above) {
                (Spec::Prim(prim), _) if self.paths[i].depth == 1 => layer.prims.push(prim),
                (Spec::Prim(prim), Some(above)) => above.children.push(prim),
                (Spec::Property(property), Some(above)) => above.properties.push(property),
                (Spec::Variant(variant), Some(above)) => above.variants.push(variant),
                // Below what is no prim.
                (_, None) => {}
            }
        }
        let root = self.paths.iter().position(|node| node.depth == 0);
        arrange(&mut layer.prims, root.map_or(&[][..], |root| &orders[root]));
        layer
    }

    /// Names and values of a set of fields.
    fn field_set(&mut self, start: u32) -> Result<Vec<(String, Content)>, Fault> {
        let mut fields = vec![];
        let mut at = start as usize;
        loop {
            let outside = || Fault::whole("a set of fields that ends", "one that does not");
            let index = *self.sets.get(at).ok_or_else(outside)?;
            if index == END {
                return Ok(fields);
            }
            let &(name, rep) = self.fields.get(index as usize).ok_or_else(outside)?;
            let name = self.name(name)?;
            at += 1;
            // Properties have specs of their own.
            if name == "properties" {
                continue;
            }
            let content = self.content(&name, rep).map_err(|fault| fault.or_at_byte(self.fields_at))?;
            fields.extend(content.map(|content| (name, content)));
        }
    }
}

impl Crate<'_> {
    fn content(&mut self, name: &str, rep: Rep) -> Result<Option<Content>, Fault> {
        let samples = if name == "timeSamples" { self.samples(rep)? } else { vec![] };
        if samples.is_empty() {
            return Ok(self.value(rep)?.map(Content::Value));
        }
        Ok(Some(Content::Samples(samples)))
    }
}

/// Sorts prims in the order of `names`; others follow in their existing order.
fn arrange(prims: &mut [Prim], names: &[String]) {
    let place: std::collections::HashMap<&str, usize> =
        names.iter().enumerate().map(|(i, n)| (n.as_str(), i)).collect();
    prims.sort_by_key(|prim| place.get(prim.name.as_str()).copied().unwrap_or(usize::MAX));
}

fn metadata(fields: Vec<(String, Content)>) -> Vec<Field> {
    let field = |(name, content)| match content {
        Content::Value(value) => Some(Field { edit: None, name, value }),
        Content::Samples(_) => None,
    };
    fields.into_iter().filter_map(field).collect()
}

fn prim(name: String, fields: Vec<(String, Content)>) -> Prim {
    // Overrides need not state that they are.
    let mut prim = Prim { name, specifier: Specifier::Over, ..Prim::default() };
    for mut field in metadata(fields) {
        // As text calls it.
        if let Some((_, name)) = RENAMED.into_iter().find(|(name, _)| *name == field.name) {
            name.clone_into(&mut field.name);
        }
        match (field.name.as_str(), &field.value) {
            ("specifier", Value::Number(n)) => {
                prim.specifier = Specifier::ALL.get(*n as usize).copied().unwrap_or(Specifier::Over);
            }
            ("typeName", Value::Text(name)) => prim.type_name.clone_from(name),
            ("primChildren", _) => {}
            _ => prim.metadata.push(field),
        }
    }
    prim
}

/// Variant with the path element `{set=name}`.
fn variant(element: &str, content: Prim) -> Variant {
    let element = element.trim_start_matches('{').trim_end_matches('}');
    let (set, name) = element.split_once('=').unwrap_or((element, ""));
    Variant { set: set.to_owned(), name: name.to_owned(), content }
}

fn property(name: String, is_attribute: bool, fields: Vec<(String, Content)>) -> Property {
    let (mut type_name, mut default, mut times, mut targets) = (String::new(), None, vec![], None);
    let mut property = Property {
        name,
        custom: false,
        uniform: false,
        kind: PropertyKind::Relationship { targets: None },
        metadata: vec![],
    };
    let texts = |values: &[Value]| values.iter().filter_map(Value::as_text).map(str::to_owned).collect();
    for (name, content) in fields {
        match (name.as_str(), content) {
            ("timeSamples", Content::Samples(samples)) => times = samples,
            (_, Content::Samples(_)) | ("variability", _) => {}
            ("custom", Content::Value(value)) => property.custom = value.as_number() == Some(1.0),
            ("typeName", Content::Value(Value::Text(name))) => type_name = name,
            ("default", Content::Value(value)) => default = Some(value),
            ("connectionPaths" | "targetPaths", Content::Value(Value::List(paths))) => {
                targets = Some(Targets::explicit(texts(&paths)));
            }
            (_, Content::Value(value)) => property.metadata.push(Field { edit: None, name, value }),
        }
    }
    property.kind = if is_attribute {
        PropertyKind::Attribute { type_name, value: default, samples: times, connections: targets }
    } else {
        PropertyKind::Relationship { targets }
    };
    property
}
