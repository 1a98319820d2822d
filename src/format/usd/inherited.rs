//! Constant primvars, which prims inherit from those above.

use super::document::Prim;

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
    /// Prims from which those below `prim` inherit, given its index and those from which it inherits itself. Only
    /// constant primvars are inherited; others hide those above.
    pub(super) fn below(self, prim: &Prim, index: usize) -> Self {
        Self(std::array::from_fn(|i| match prim.value(INHERITED[i]) {
            None => self.0[i],
            Some(_) => (interpolation(prim, INHERITED[i]) == CONSTANT).then_some(index),
        }))
    }

    /// Prim from which the primvar `name`, one of [`INHERITED`], is inherited.
    pub(super) fn of(self, name: &str) -> Option<usize> {
        INHERITED.iter().position(|inherited| *inherited == name).and_then(|i| self.0[i])
    }
}

const CONSTANT: &str = "constant";

/// For which elements a primvar has values.
pub(super) fn interpolation<'a>(prim: &'a Prim, name: &str) -> &'a str {
    prim.stated(name, "interpolation").unwrap_or(CONSTANT)
}
