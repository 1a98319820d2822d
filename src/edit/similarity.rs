use glam::{DMat3, DMat4, DQuat, DVec3, Vec3};
use rayon::prelude::*;

use crate::scene::{Camera, HybridScene, Intrinsics, Mesh, SceneError, Splats, frame::OPENGL_FROM_OPENCV, placement};

/// Similarity transform `p' = scale · orthogonal · p + translation`, which preserves shape. `orthogonal` may include a
/// reflection.
///
/// Transforming both scene and camera leaves the image unchanged; a reflection mirrors it left to right.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Similarity {
    scale: f64,
    orthogonal: DMat3,
    translation: DVec3,
}

impl Similarity {
    /// Identity; leaves all values bit for bit unchanged.
    pub const IDENTITY: Self = Self { scale: 1.0, orthogonal: DMat3::IDENTITY, translation: DVec3::ZERO };

    /// Half a turn about x, [`OPENGL_FROM_OPENCV`]: from the frame of captures to a world that is y up, as those of
    /// glTF and USD are, and back.
    pub const HALF_TURN: Self =
        Self { scale: 1.0, orthogonal: DMat3::from_diagonal(OPENGL_FROM_OPENCV), translation: DVec3::ZERO };

    /// Creates the transform that scales and rotates (or reflects) about the origin, then translates.
    ///
    /// # Errors
    /// If a number is not finite, the scale is not positive or the matrix is not orthogonal to within 1e-9.
    pub fn new(scale: f64, orthogonal: DMat3, translation: DVec3) -> Result<Self, SceneError> {
        if !(scale > 0.0 && scale.is_finite()) {
            return Err(SceneError::new("scale", "a positive number", scale.to_string()));
        }
        if !(orthogonal.transpose() * orthogonal).abs_diff_eq(DMat3::IDENTITY, 1e-9) {
            return Err(SceneError::new("rotation", "an orthogonal matrix", orthogonal.to_string()));
        }
        if !translation.is_finite() {
            return Err(SceneError::new("translation", "finite numbers", translation.to_string()));
        }
        Ok(Self { scale, orthogonal, translation })
    }

    /// Composes two transforms: this one, followed by `next`.
    #[must_use]
    pub fn then(&self, next: &Self) -> Self {
        Self {
            scale: next.scale * self.scale,
            orthogonal: next.orthogonal * self.orthogonal,
            translation: next.point(self.translation),
        }
    }

    /// Transforms a point.
    #[must_use]
    pub fn point(&self, p: DVec3) -> DVec3 {
        self.scale * (self.orthogonal * p) + self.translation
    }

    /// Homogeneous 4×4 matrix of the transform, for column vectors.
    #[must_use]
    pub fn matrix(&self) -> DMat4 {
        DMat4::from_translation(self.translation) * DMat4::from_mat3(self.scale * self.orthogonal)
    }

    /// Transforms splats: means, scales, rotations and spherical harmonics.
    ///
    /// # Errors
    /// If a value leaves the range of f32.
    pub fn splats(&self, splats: Splats) -> Result<Splats, SceneError> {
        if *self == Self::IDENTITY {
            return Ok(splats);
        }
        let mut s = splats.into_arrays();
        s.means.par_iter_mut().for_each(|p| *p = self.point(p.as_dvec3()).as_vec3());
        let stretch = self.scale.ln();
        s.log_scales.par_iter_mut().for_each(|l| *l = (l.as_dvec3() + stretch).as_vec3());
        if self.orthogonal != DMat3::IDENTITY {
            let (turn, all) = (self.turn(), 0..s.rotations.len());
            s.rotations.par_iter_mut().for_each(|q| *q = (turn * q.as_dquat()).as_quat());
            placement::turn(&mut s, all, self.orthogonal);
        }
        s.check()
    }

    /// Transforms a mesh: positions and the spherical harmonics of every texel. A reflection reverses the winding of
    /// triangles, so that front faces stay front faces.
    ///
    /// # Errors
    /// If a value leaves the range of f32.
    pub fn mesh(&self, mesh: &Mesh) -> Result<Mesh, SceneError> {
        let positions: Vec<Vec3> = mesh.positions().iter().map(|p| self.point(p.as_dvec3()).as_vec3()).collect();
        let (mut triangles, mut corner_uvs) = (mesh.triangles().to_vec(), mesh.corner_uvs().to_vec());
        if self.mirrors() {
            triangles.iter_mut().for_each(|t| t.swap(1, 2));
            corner_uvs.iter_mut().for_each(|uvs| uvs.swap(1, 2));
        }
        Mesh::new(positions, triangles, corner_uvs, placement::turned(mesh.atlas(), self.orthogonal)?)
    }

    /// Camera from which the transformed scene looks as the original does from `camera`; mirrored left to right if the
    /// transform is a reflection.
    ///
    /// # Errors
    /// If a value leaves the range of f64.
    pub fn camera(&self, camera: &Camera) -> Result<Camera, SceneError> {
        if *self == Self::IDENTITY {
            return Ok(*camera);
        }
        let mut k: Intrinsics = *camera.intrinsics();
        let mut to_image = DMat3::IDENTITY;
        if self.mirrors() {
            to_image = DMat3::from_diagonal(DVec3::new(-1.0, 1.0, 1.0));
            k.cx = f64::from(k.width) - k.cx;
        }
        let rotation = to_image * camera.rotation() * self.orthogonal.transpose();
        let translation = self.scale * (to_image * camera.translation()) - rotation * self.translation;
        Camera::new(k, rotation, translation)
    }

    /// Transforms a scene; λ and the near distance scale with it.
    ///
    /// # Errors
    /// If a value leaves the range of f32.
    pub fn scene(&self, scene: HybridScene) -> Result<HybridScene, SceneError> {
        let HybridScene { splats, meshes, mut composition } = scene;
        composition.lambda = (f64::from(composition.lambda) * self.scale) as f32;
        composition.near = (f64::from(composition.near) * self.scale) as f32;
        composition.validate()?;
        let meshes = meshes.iter().map(|m| self.mesh(m)).collect::<Result<_, _>>()?;
        Ok(HybridScene { splats: self.splats(splats)?, meshes, composition })
    }

    fn mirrors(&self) -> bool {
        self.orthogonal.determinant() < 0.0
    }

    /// Rotation that transforms ellipsoids as `orthogonal` does: ellipsoids are symmetric about their centre, so a
    /// reflection `O` acts on them like the rotation `−O`.
    fn turn(&self) -> DQuat {
        DQuat::from_mat3(&if self.mirrors() { -self.orthogonal } else { self.orthogonal }).normalize()
    }
}
