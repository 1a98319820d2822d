//! Further per-splat attributes of a PLY.

use super::table::{Column, Element, Scalar};

/// Per-splat property other than the parameters of the INRIA layout, with the name and type of the file: a label, a
/// confidence, a time. Only PLY can store it.
#[derive(Clone, Debug, PartialEq)]
pub struct Attribute {
    pub(super) name: String,
    pub(super) kind: Scalar,
    pub(super) values: Vec<f64>,
}

impl Attribute {
    /// Name of the property in the file.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Values, one per splat. Every PLY type fits into f64.
    #[must_use]
    pub fn values(&self) -> &[f64] {
        &self.values
    }

    /// Selects the values of the splats `indices`, in that order.
    ///
    /// # Panics
    /// If an index is out of range.
    #[must_use]
    pub fn gather(&self, indices: &[usize]) -> Self {
        Self { values: indices.iter().map(|&i| self.values[i]).collect(), ..self.same_kind() }
    }

    /// Concatenates the values of several scenes; `None` if names or types differ.
    #[must_use]
    pub fn join(parts: &[&Self]) -> Option<Self> {
        let first = parts.first()?;
        let same = parts.iter().all(|p| (&p.name, p.kind) == (&first.name, first.kind));
        let values = || parts.iter().flat_map(|p| p.values.iter().copied()).collect();
        same.then(|| Self { values: values(), ..first.same_kind() })
    }

    fn same_kind(&self) -> Self {
        Self { name: self.name.clone(), kind: self.kind, values: vec![] }
    }
}

/// Scalar properties of `vertex` other than `parameters` and normals (which carry no information), without values, and
/// their columns.
pub(super) fn of_header(vertex: &Element, parameters: &[&str]) -> (Vec<Attribute>, Vec<Column>) {
    let is_extra = |name: &str| !["nx", "ny", "nz"].contains(&name) && !parameters.contains(&name);
    let extra = vertex.scalar_properties().filter(|(_, name, _)| is_extra(name));
    extra.map(|(i, name, kind)| (Attribute { name: name.to_owned(), kind, values: vec![] }, i)).unzip()
}
