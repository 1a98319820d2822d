//! Transformation of the content below nodes into one world frame, shared by glTF and USD.

use std::collections::HashMap;
use std::collections::hash_map::Entry;

use glam::{DMat3, DMat4, Vec3};

use super::error::Fault;
use crate::scene::frame::{HALF_TURN, OPENGL_FROM_OPENCV};
pub(super) use crate::scene::placement::{Decomposed, is_flat, orthogonal, similarity, turned};
use crate::scene::{Atlas, HybridScene, Mesh, SceneError, SplatArrays, Splats, placement};

/// What is said of splats that [`place`] cannot place.
pub(super) const NOT_DRAWN: &str = "splats under a flat transform are not drawn";

/// Transforms splats by a node's world transform: means, scales, rotations and spherical harmonics. Returns false, and
/// does nothing, if the transform leaves the splats no extent along an axis: they are then not drawn.
pub(super) fn place(splats: &mut SplatArrays, transform: DMat4) -> bool {
    let all = 0..splats.means.len();
    placement::place(splats, all, transform)
}

/// Joins parts into one set of splats, at the highest SH degree among them. Each part comes with its origin: a JSON
/// pointer, or the path of a prim.
pub(super) fn join(parts: Vec<(String, SplatArrays)>) -> Result<Splats, Fault> {
    let places: Vec<(usize, String)> = parts.iter().map(|(at, part)| (part.means.len(), at.clone())).collect();
    let degree = parts.iter().map(|(_, part)| part.sh_degree).max().unwrap_or(0);
    let mut parts = parts.into_iter().map(|(_, part)| part.with_sh_degree(degree));
    let Some(mut all) = parts.next() else { return Ok(Splats::empty(0)) };
    parts.for_each(|part| all.append(part));
    all.check().map_err(|e| Fault::from(e).of_part(places.iter().map(|(count, at)| (*count, at.as_str()))))
}

/// A scene of a world that is y up in the frame of the capture, half a turn about x away, or back. Nothing changes but
/// in its sign.
pub(super) fn half_turned(scene: HybridScene) -> Result<HybridScene, SceneError> {
    let HybridScene { splats, meshes, composition } = scene;
    let orthogonal = DMat3::from_diagonal(OPENGL_FROM_OPENCV);
    let mut splats = splats.into_arrays();
    let all = 0..splats.means.len();
    placement::place(&mut splats, all, HALF_TURN);
    // Maps that many meshes share are turned once, and shared again.
    let mut known: HashMap<[Option<*const f32>; 2], Atlas> = HashMap::new();
    let turned_mesh = |mesh: Mesh| -> Result<Mesh, SceneError> {
        let maps = [Some(mesh.atlas().base()), mesh.atlas().bands()];
        let atlas = match known.entry(maps.map(|map| map.map(|texture| texture.texels().as_ptr()))) {
            Entry::Occupied(entry) => entry.get().clone(),
            Entry::Vacant(entry) => entry.insert(turned(mesh.atlas(), orthogonal)?).clone(),
        };
        Ok(mesh.moved(|p: Vec3| HALF_TURN.transform_point3(p.as_dvec3()).as_vec3())?.with_atlas(atlas))
    };
    let meshes = meshes.into_iter().map(turned_mesh).collect::<Result<_, _>>()?;
    Ok(HybridScene { splats: splats.check()?, meshes, composition })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::edit::Similarity;
    use crate::format::test_scenes::random_scene;

    #[test]
    fn half_turns_are_those_of_edits_and_leave_shared_what_is() {
        let mut scene = random_scene(30, 2, 3, 4);
        scene.meshes.push(scene.meshes[0].clone());
        let turned = half_turned(scene.clone()).unwrap();
        assert_eq!(turned, Similarity::HALF_TURN.scene(scene.clone()).unwrap());
        let bands = |mesh: &Mesh| mesh.atlas().bands().map(|bands| bands.texels().as_ptr());
        assert!(bands(&turned.meshes[0]).is_some() && bands(&turned.meshes[0]) == bands(&turned.meshes[2]));
        let back = half_turned(turned).unwrap();
        assert_eq!((&back.meshes, back.splats.means()), (&scene.meshes, scene.splats.means()));
        assert_eq!((back.splats.sh(), back.splats.log_scales()), (scene.splats.sh(), scene.splats.log_scales()));
        // The quaternion has the other sign, which is the same rotation.
        assert!(back.splats.rotations().iter().zip(scene.splats.rotations()).all(|(a, b)| *a == -*b));
    }
}
