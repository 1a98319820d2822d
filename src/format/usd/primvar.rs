//! Primvars: values of the elements of a prim, also as indices into a shorter list, and constant ones for all prims
//! below.

use super::document::Prim;
use super::stage::{Placed, Stage};
use crate::format::error::Fault;

/// Colours and opacities of meshes without a material.
pub(super) const COLORS: &str = "primvars:displayColor";
pub(super) const OPACITIES: &str = "primvars:displayOpacity";
/// Joints with which the points of a mesh move, and where these points were when they were bound to them.
pub(super) const JOINTS: &str = "primvars:skel:jointIndices";
pub(super) const BIND_TRANSFORM: &str = "primvars:skel:geomBindTransform";

/// Primvars that are looked for above a prim, too.
const INHERITED: [&str; 4] = [COLORS, OPACITIES, JOINTS, BIND_TRANSFORM];

/// Prims from which those below inherit each of [`INHERITED`].
#[derive(Clone, Copy, Default)]
pub(super) struct Constants([Option<usize>; INHERITED.len()]);

impl Constants {
    /// Prims from which those below `prim` inherit, given those from which it inherits itself. Only constant primvars
    /// are inherited; others hide those above.
    pub(super) fn below(self, stage: &Stage<'_>, prim: usize) -> Self {
        let here = stage.prims[prim];
        Self(std::array::from_fn(|i| match here.value(INHERITED[i]) {
            None => self.0[i],
            Some(_) => (interpolation(here, INHERITED[i]) == CONSTANT).then_some(prim),
        }))
    }

    fn of(self, name: &str) -> Option<usize> {
        INHERITED.iter().position(|inherited| *inherited == name).and_then(|i| self.0[i])
    }
}

/// Prim that has the primvar `name`, one of [`INHERITED`], of a placed prim: that itself, or one above.
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

    /// Same as [`Self::of`], for a primvar that a prim may inherit.
    pub(super) fn inherited(stage: &Stage<'a>, placed: &Placed, name: &str) -> Result<Option<Self>, Fault> {
        holder(stage, placed, name).map_or(Ok(None), |prim| Self::of(stage, prim, name))
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
    pub(super) fn mean(&self) -> Option<([f32; N], bool)> {
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

const CONSTANT: &str = "constant";

fn interpolation<'a>(prim: &'a Prim, name: &str) -> &'a str {
    prim.stated(name, "interpolation").unwrap_or(CONSTANT)
}

#[cfg(test)]
mod tests {
    use super::*;

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
