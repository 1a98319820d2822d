//! Primvars: values of the elements of a prim, also as indices into a shorter list, and constant ones for all prims
//! below.

use std::collections::HashMap;

use super::inherited::interpolation;
use super::stage::{Placed, Stage};
use crate::format::error::Fault;

/// Prim that has the primvar `name`, one that is inherited, of a placed prim: that itself, or one above.
pub(super) fn holder(stage: &Stage<'_>, placed: &Placed, name: &str) -> Option<usize> {
    let is_own = stage.prims[placed.prim].value(name).is_some();
    if is_own { Some(placed.prim) } else { placed.constants.of(name) }
}

/// Primvar with `N` numbers per value.
pub(super) struct Primvar<'a, const N: usize> {
    /// Path of the primvar.
    at: String,
    pub(super) values: Vec<[f32; N]>,
    pub(super) interpolation: &'a str,
    pub(super) indices: Option<Vec<u32>>,
}

impl<'a, const N: usize> Primvar<'a, N> {
    /// Reads a primvar of a prim; `None` if it has none of this name.
    pub(super) fn of(stage: &Stage<'a>, prim: usize, name: &str) -> Result<Option<Self>, Fault> {
        let Some(values) = stage.rows::<N>(prim, name)? else { return Ok(None) };
        let interpolation = interpolation(stage.prims[prim], name);
        let indices = stage.indices(prim, &format!("{name}:indices"))?;
        Ok(Some(Self { at: format!("{}.{name}", stage.path(prim)), values, interpolation, indices }))
    }

    /// Value at a corner.
    pub(super) fn at(&self, corner: usize, vertex: u32, face: usize) -> Result<[f32; N], Fault> {
        let index = match self.interpolation {
            "faceVarying" => corner,
            "vertex" | "varying" => vertex as usize,
            "uniform" => face,
            _ => 0,
        };
        let place = match &self.indices {
            Some(indices) => indices.get(index).map(|&i| i as usize),
            None => Some(index),
        };
        place.and_then(|place| self.values.get(place)).copied().ok_or_else(|| {
            let expected = format!("a value for element {index} of interpolation {}", self.interpolation);
            Fault::pointer(&self.at, expected, "none")
        })
    }

    /// Mean over all elements, each as often as it is used, and whether they differ; `None` if there are none. Leaves
    /// out indices beyond the values, and values that are not finite.
    fn mean(&self) -> Option<Mean<N>> {
        let all = (0..self.indices.as_ref().map_or(self.values.len(), Vec::len)).filter_map(|element| {
            let place = self.indices.as_ref().map_or(element, |indices| indices[element] as usize);
            self.values.get(place).filter(|value| value.iter().all(|v| v.is_finite()))
        });
        let (mut first, mut sum, mut count, mut differ) = (None, [0.0_f64; N], 0_usize, false);
        for value in all {
            differ |= *first.get_or_insert(value) != value;
            sum.iter_mut().zip(value).for_each(|(sum, &v)| *sum += f64::from(v));
            count += 1;
        }
        let mean = sum.map(|sum| (sum / count as f64) as f32);
        first.map(|&first| if differ { (mean, true) } else { (first, false) })
    }
}

/// Mean of a primvar, and whether its elements differ.
pub(super) type Mean<const N: usize> = ([f32; N], bool);

/// Means of the primvar of one name, by the prim of a stage that has it. Each is taken once, because many prims may
/// inherit one long array.
pub(super) struct Means<const N: usize> {
    name: &'static str,
    known: HashMap<usize, Option<Mean<N>>>,
}

impl<const N: usize> Means<N> {
    /// Means of the primvar `name`, one that is inherited.
    pub(super) fn new(name: &'static str) -> Self {
        Self { name, known: HashMap::new() }
    }

    /// Mean of the primvar that a placed prim has or inherits; `None` if there is none, or if it is of no elements.
    pub(super) fn of(&mut self, stage: &Stage<'_>, placed: &Placed) -> Result<Option<Mean<N>>, Fault> {
        let Some(prim) = holder(stage, placed, self.name) else { return Ok(None) };
        if let Some(mean) = self.known.get(&prim) {
            return Ok(*mean);
        }
        let mean = Primvar::<N>::of(stage, prim, self.name)?.and_then(|primvar| primvar.mean());
        self.known.insert(prim, mean);
        Ok(mean)
    }
}

#[cfg(test)]
mod tests {
    use glam::DMat4;

    use super::super::document::Layer;
    use super::super::inherited::{COLORS, Constants};
    use super::super::parse::parse;
    use super::*;

    /// Otherwise a file could take time in proportion to its meshes times the values above them.
    #[test]
    fn means_of_what_prims_inherit_are_taken_once() {
        let layer = |red: &str| {
            let text = format!(
                r#"#usda 1.0
def Xform "above" {{
    color3f[] primvars:displayColor = [({red}, 0, 0), (1, 0, 0)] ( interpolation = "constant" )
    def Mesh "a" {{}}
    def Mesh "b" {{}}
    def Mesh "c" {{ color3f[] primvars:displayColor = [(0, 0.25, 0)] }}
}}
"#
            );
            parse(text.as_bytes()).unwrap()
        };
        let mut means = Means::<3>::new(COLORS);
        let mut mean_of = |layer: &Layer, prim: usize| {
            let stage = Stage::new(layer);
            let constants = Constants::default().below(stage.prims[0], 0);
            let placed = Placed { prim, transform: DMat4::IDENTITY, binding: None, skeleton: None, constants };
            means.of(&stage, &placed).unwrap()
        };
        let (first, other) = (layer("0"), layer("0.5"));
        assert_eq!(mean_of(&first, 1), Some(([0.5, 0.0, 0.0], true)));
        // The same prim with other values shows that they are not read again.
        assert_eq!(mean_of(&other, 2), Some(([0.5, 0.0, 0.0], true)));
        assert_eq!(mean_of(&first, 3), Some(([0.0, 0.25, 0.0], false)));
    }

    #[test]
    fn means_are_of_the_elements_that_there_are() {
        let primvar = |values: &[f32], indices: Option<&[u32]>| Primvar::<1> {
            at: String::new(),
            values: values.iter().map(|&v| [v]).collect(),
            interpolation: "vertex",
            indices: indices.map(<[u32]>::to_vec),
        };
        assert_eq!(primvar(&[0.1; 3], None).mean(), Some(([0.1], false)));
        assert_eq!(primvar(&[0.0, 0.5, 1.0], None).mean(), Some(([0.5], true)));
        assert_eq!(primvar(&[0.0, 0.5, 1.0], Some(&[2, 2])).mean(), Some(([1.0], false)));
        assert_eq!(primvar(&[0.0, f32::NAN, 1.0], Some(&[0, 2, 2, 2, 1, 3])).mean(), Some(([0.75], true)));
        assert_eq!(primvar(&[], None).mean(), None);
        assert_eq!(primvar(&[1.0], Some(&[])).mean(), None);
        assert_eq!(primvar(&[f32::INFINITY], Some(&[0, 7])).mean(), None);
    }
}
