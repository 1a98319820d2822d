//! What lies below nodes with transforms, brought into one world: the same for glTF and USD.

use glam::DMat4;

use super::error::Fault;
pub(super) use crate::scene::placement::{Decomposed, orthogonal, similarity, turned};
use crate::scene::{SplatArrays, Splats, placement};

/// Moves splats to where a node puts them: means, scales, rotations and spherical harmonics.
///
/// # Errors
/// At `at`, if the transform leaves them no extent along an axis.
pub(super) fn place(splats: &mut SplatArrays, transform: DMat4, at: &str) -> Result<(), Fault> {
    let all = 0..splats.means.len();
    if placement::place(splats, all, transform) {
        return Ok(());
    }
    Err(Fault::pointer(at, "a transform with an inverse above splats", "one without"))
}

/// All parts as one, at the highest degree among them, with where each is from: a JSON pointer, or the path of a prim.
pub(super) fn join(parts: Vec<(String, SplatArrays)>) -> Result<Splats, Fault> {
    let places: Vec<(usize, String)> = parts.iter().map(|(at, part)| (part.means.len(), at.clone())).collect();
    let degree = parts.iter().map(|(_, part)| part.sh_degree).max().unwrap_or(0);
    let mut parts = parts.into_iter().map(|(_, part)| part.with_sh_degree(degree));
    let Some(mut all) = parts.next() else { return Ok(Splats::empty(0)) };
    parts.for_each(|part| all.append(part));
    all.check().map_err(|e| Fault::from(e).of_part(places.iter().map(|(count, at)| (*count, at.as_str()))))
}
