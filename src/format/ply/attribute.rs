//! What a PLY says about splats besides their parameters.

use super::table::{Column, Element, Scalar};

/// A property of every splat that is none of the parameters of the INRIA layout, under the name and type of its file:
/// a label, a confidence, a time. PLY alone can hold it.
#[derive(Clone, Debug, PartialEq)]
pub struct Attribute {
    pub(super) name: String,
    pub(super) kind: Scalar,
    pub(super) values: Vec<f64>,
}

impl Attribute {
    /// Its name in the file.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }

    /// One value per splat. Every type of PLY fits into f64.
    #[must_use]
    pub fn values(&self) -> &[f64] {
        &self.values
    }

    /// Of the splats of these indices, in their order.
    ///
    /// # Panics
    /// If an index is out of range.
    #[must_use]
    pub fn gather(&self, indices: &[usize]) -> Self {
        Self { values: indices.iter().map(|&i| self.values[i]).collect(), ..self.same_kind() }
    }

    /// Of the splats of several scenes, one after the other; `None` if they differ in name or type.
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

/// The scalar properties of `vertex` that are no `parameters` (nor normals, which say nothing), without values, and their columns.
pub(super) fn of_header(vertex: &Element, parameters: &[&str]) -> (Vec<Attribute>, Vec<Column>) {
    let is_extra = |name: &str| !["nx", "ny", "nz"].contains(&name) && !parameters.contains(&name);
    let extra = vertex.scalar_properties().filter(|(_, name, _)| is_extra(name));
    extra.map(|(i, name, kind)| (Attribute { name: name.to_owned(), kind, values: vec![] }, i)).unzip()
}
