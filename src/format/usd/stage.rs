//! Prims of a layer by path, and typed access to their attributes.

use std::borrow::Cow;
use std::collections::HashMap;

use glam::DMat4;

use super::document::{Layer, Numeric, Prim, PropertyKind, Scalar, Value, split_property};
use super::inherited::Constants;
use crate::format::cameras::short;
use crate::format::error::Fault;

/// Prims in document order, parents before children, by index.
pub(super) struct Stage<'a> {
    pub(super) prims: Vec<&'a Prim>,
    pub(super) parents: Vec<Option<usize>>,
    children: HashMap<(Option<usize>, &'a str), usize>,
    /// Time code at which [`Self::value`] evaluates; `None`: the earliest.
    pub(super) time: Option<f64>,
}

/// Length beyond which the beginning of a path is omitted: there can be a message for every prim below.
const LONG_PATH: usize = 1000;

/// Connections that are followed before a value counts as missing.
const MAX_HOPS: usize = 16;

/// Where a prim lies in the world, and what is bound to it or inherited by those below.
#[derive(Clone, Copy)]
pub(super) struct Placed {
    pub(super) prim: usize,
    pub(super) transform: DMat4,
    pub(super) binding: Option<Binding>,
    /// Skeleton with which the prim moves.
    pub(super) skeleton: Option<usize>,
    pub(super) constants: Constants,
}

/// Material bound to a prim and to those below without one of their own.
#[derive(Clone, Copy)]
pub(super) struct Binding {
    pub(super) material: usize,
    /// Whether it is bound to all prims below.
    is_strong: bool,
}

impl Binding {
    /// Material of a prim with this binding, below one with the binding `above`.
    pub(super) fn below(self, above: Option<Self>) -> Self {
        above.filter(|above| above.is_strong).unwrap_or(self)
    }
}

/// Relationship to a material, and its metadata that states how strong it is.
const MATERIAL: &str = "material:binding";
const STRENGTH: &str = "bindMaterialAs";

/// Where an input of a shader gets its value.
pub(super) enum Source<'a> {
    Value(&'a Value),
    /// Output `name` of the shader `prim`.
    Output {
        prim: usize,
        name: &'a str,
    },
}

impl<'a> Stage<'a> {
    pub(super) fn new(layer: &'a Layer) -> Self {
        let mut stage = Self { prims: vec![], parents: vec![], children: HashMap::new(), time: None };
        let mut stack: Vec<(Option<usize>, &Prim)> = layer.prims.iter().rev().map(|p| (None, p)).collect();
        while let Some((parent, prim)) = stack.pop() {
            let id = stage.prims.len();
            stage.children.entry((parent, prim.name.as_str())).or_insert(id);
            stage.prims.push(prim);
            stage.parents.push(parent);
            stack.extend(prim.children.iter().rev().map(|child| (Some(id), child)));
        }
        stage
    }

    /// Paths of files in attribute values of any prim.
    pub(super) fn assets(&self) -> impl Iterator<Item = &'a str> {
        let values = self.prims.iter().flat_map(|prim| &prim.properties).flat_map(|property| match &property.kind {
            PropertyKind::Attribute { value, samples, .. } => {
                value.iter().chain(samples.iter().map(|(_, value)| value)).collect()
            }
            PropertyKind::Relationship { .. } => vec![],
        });
        let of_list =
            |value: &'a Value| if let Value::List(all) = value { all.as_slice() } else { std::slice::from_ref(value) };
        values.flat_map(of_list).filter_map(|value| match value {
            Value::Asset(path) => Some(path.as_str()),
            _ => None,
        })
    }

    /// Value of an attribute at [`Self::time`].
    pub(super) fn value(&self, prim: usize, name: &str) -> Option<Cow<'a, Value>> {
        match self.time {
            None => self.prims[prim].value(name).map(Cow::Borrowed),
            Some(time) => self.prims[prim].value_at(name, time),
        }
    }

    /// Path of a prim for messages; of a very long one, the end.
    pub(super) fn path(&self, prim: usize) -> String {
        let (mut names, mut length, mut next) = (vec![], 0, Some(prim));
        while let Some(id) = next {
            let is_long = length > LONG_PATH;
            names.push(if is_long { "…".to_owned() } else { short(&self.prims[id].name) });
            length += names[names.len() - 1].len();
            next = self.parents[id].filter(|_| !is_long);
        }
        names.iter().rev().flat_map(|name| ["/", name]).collect()
    }

    /// Prim at `path`, which may be relative to `from` and may end in a property, and that property's name.
    pub(super) fn find<'p>(&self, from: usize, path: &'p str) -> Option<(usize, &'p str)> {
        let (prims, property) = split_property(path);
        let (mut at, rest) = match prims.strip_prefix('/') {
            Some(rest) => (None, rest),
            None => (Some(from), prims),
        };
        for part in rest.split('/').filter(|part| !part.is_empty()) {
            at = if part == ".." { self.parents[at?] } else { Some(*self.children.get(&(at, part))?) };
        }
        Some((at?, property))
    }

    /// Prim to which a relationship of a prim leads; `None` if there is none in the layer.
    pub(super) fn related(&self, prim: usize, name: &str) -> Option<usize> {
        let (target, _) = self.find(prim, self.prims[prim].target(name)?)?;
        Some(target)
    }

    /// Material that a prim binds itself.
    pub(super) fn binding(&self, prim: usize) -> Option<Binding> {
        let is_strong = self.prims[prim].stated(MATERIAL, STRENGTH) == Some("strongerThanDescendants");
        self.related(prim, MATERIAL).map(|material| Binding { material, is_strong })
    }

    /// Value of an input, or the shader output to which it is connected.
    pub(super) fn input(&self, prim: usize, name: &'a str) -> Option<Source<'a>> {
        let (mut prim, mut name) = (prim, name);
        for _ in 0..MAX_HOPS {
            let Some(connection) = self.prims[prim].connection(name) else {
                return self.prims[prim].value(name).map(Source::Value);
            };
            (prim, name) = self.find(prim, connection)?;
            if self.prims[prim].type_name == "Shader" && name.starts_with("outputs:") {
                return Some(Source::Output { prim, name });
            }
        }
        None
    }

    fn fault(&self, prim: usize, name: &str, expected: impl Into<String>, found: impl Into<String>) -> Fault {
        Fault::pointer(format!("{}.{name}", self.path(prim)), expected, found)
    }

    /// Elements of `N` numbers; `None` if the attribute is missing.
    pub(super) fn rows<const N: usize>(&self, prim: usize, name: &str) -> Result<Option<Vec<[f32; N]>>, Fault> {
        let Some(value) = self.prims[prim].value(name) else { return Ok(None) };
        let Some(PropertyKind::Attribute { type_name, .. }) = self.prims[prim].property(name).map(|p| &p.kind) else {
            return Ok(None);
        };
        let is_wide = Numeric::of(type_name).is_some_and(|n| n.width() == N && n.scalar != Scalar::Integer);
        let rows = |values: &[f32]| values.as_chunks::<N>().0.to_vec();
        match value {
            Value::Floats(all) if is_wide => Ok(Some(rows(all))),
            Value::Doubles(all) if is_wide => Ok(Some(rows(&all.iter().map(|&v| v as f32).collect::<Vec<_>>()))),
            _ => Err(self.fault(prim, name, format!("floats, {N} an element"), format!("`{type_name}`"))),
        }
    }

    /// Indices or counts; `None` if the attribute is missing.
    pub(super) fn indices(&self, prim: usize, name: &str) -> Result<Option<Vec<u32>>, Fault> {
        let Some(value) = self.prims[prim].value(name) else { return Ok(None) };
        let Value::Integers(all) = value else { return Err(self.fault(prim, name, "integers", "other values")) };
        let index =
            |&v: &i64| u32::try_from(v).map_err(|_| self.fault(prim, name, "indices of 32 bits", v.to_string()));
        all.iter().map(index).collect::<Result<_, _>>().map(Some)
    }

    pub(super) fn text(&self, prim: usize, name: &str) -> Option<&'a str> {
        self.prims[prim].value(name)?.as_text()
    }

    /// Single value of `N` numbers.
    pub(super) fn numbers<const N: usize>(&self, prim: usize, name: &str) -> Option<[f64; N]> {
        self.value(prim, name)?.as_numbers()?.try_into().ok()
    }

    pub(super) fn number(&self, prim: usize, name: &str) -> Option<f64> {
        self.numbers::<1>(prim, name).map(|[n]| n)
    }
}
