//! Half turn about x between the capture's world, y down, and the file's, y up. Every value keeps its bits except the
//! sign, so that the inverse is exact.

use glam::{Quat, Vec3};
use rayon::prelude::*;

use crate::scene::frame::{OPENGL_FROM_OPENCV, sh_signs};
use crate::scene::{Atlas, HybridScene, Mesh, SceneError, Texture, sh};

pub(super) fn turned(p: Vec3) -> Vec3 {
    p * OPENGL_FROM_OPENCV.as_vec3()
}

/// Rotation i·q after the half turn.
pub(super) fn turned_rotation(q: Quat) -> Quat {
    Quat::from_xyzw(q.w, -q.z, q.y, -q.x)
}

/// Rotation −i·q, the inverse of [`turned_rotation`].
fn turned_back(q: Quat) -> Quat {
    Quat::from_xyzw(-q.w, q.z, -q.y, q.x)
}

/// Turns the maps of the higher bands.
pub(super) fn turned_map(bands: &Texture) -> Texture {
    let (channels, signs) = (bands.channels() as usize, sh_signs(OPENGL_FROM_OPENCV));
    let mut texels = bands.texels().to_vec();
    texels.par_chunks_exact_mut(channels).for_each(|texel| {
        texel.iter_mut().enumerate().for_each(|(c, v)| *v *= signs[(1 + c / 3).min(15)]);
    });
    Texture::new(bands.width(), bands.height(), bands.channels(), texels)
        .expect("values that were finite are so with another sign")
}

/// Converts a scene from the file's world to the capture's.
pub(super) fn back(scene: HybridScene) -> Result<HybridScene, SceneError> {
    let HybridScene { splats, meshes, composition } = scene;
    let (mut s, signs) = (splats.into_arrays(), sh_signs(OPENGL_FROM_OPENCV));
    s.means.iter_mut().for_each(|p| *p = turned(*p));
    s.rotations.iter_mut().for_each(|q| *q = turned_back(*q));
    s.sh.par_chunks_exact_mut(sh::coefficients(s.sh_degree)).for_each(|coefficients| {
        coefficients.iter_mut().zip(signs).for_each(|(c, sign)| *c = c.map(|v| v * sign));
    });
    let of_mesh = |mesh: &Mesh| {
        let atlas = Atlas::new(mesh.atlas().base().clone(), mesh.atlas().bands().map(turned_map))?;
        let positions = mesh.positions().iter().map(|&p| turned(p)).collect();
        Mesh::new(positions, mesh.triangles().to_vec(), mesh.corner_uvs().to_vec(), atlas)
    };
    let meshes = meshes.iter().map(of_mesh).collect::<Result<_, _>>()?;
    Ok(HybridScene { splats: s.check()?, meshes, composition })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rotations_turn_and_come_back() {
        let turn = Quat::from_xyzw(1.0, 0.0, 0.0, 0.0);
        let q = Quat::from_xyzw(0.1, -0.2, 0.3, 0.9);
        assert_eq!(turned_rotation(q), turn * q);
        assert_eq!(turned_back(turned_rotation(q)), q);
    }
}
