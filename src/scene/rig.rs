//! Rig of a moving scene: morph targets and bones under its surfaces, and splats that follow bones or triangles.
//!
//! A rig is independent of time and of the source of poses: glTF animations are one source (`format::gltf`), a tracked
//! parametric head would be another. It holds the scene's geometry before any pose; a [`Pose`] gives the transforms of
//! bones and the weights of morph targets.
//!
//! ```text
//! p = base + Σ weightₜ · deltaₜ                            morph targets
//! v = bone · p,   or   Σ wⱼ · boneⱼ · p / Σ wⱼ            one bone, or linear blend skinning
//! mean, rotation, scale = k·R·t + c,  q(R)·q,  k·s         a splat on the triangle of frame (R, k, c), see [`Frame`]
//! ```

#[cfg(test)]
mod tests;

use std::borrow::Cow;
use std::ops::Range;

use glam::{DMat3, DMat4, DQuat, DVec3, DVec4, Quat, Vec3};
use rayon::prelude::*;

use super::placement::{is_flat, orthogonal, reshape, similarity, turn, turned};
use super::{HybridScene, Mesh, SceneError, SplatArrays, check_len};

/// A pose of a rig.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Pose {
    /// Transform of each bone, from the space in which attached content is stored to the scene, for column vectors. For
    /// a joint of a skin: its global transform times its inverse bind matrix.
    pub bones: Vec<DMat4>,
    /// Weights of morph targets.
    pub weights: Vec<f32>,
}

/// Geometry of a scene before it is posed, and its attachment to bones and triangles.
#[derive(Clone, Debug, PartialEq)]
pub struct Rig {
    /// One per mesh of the scene; `None` for static meshes.
    surfaces: Vec<Option<RestSurface>>,
    /// Splats that move; all others are static.
    attached: Vec<AttachedSplats>,
    rest: Pose,
    /// Names, one per bone.
    names: Vec<String>,
}

/// A surface before it is posed.
#[derive(Clone, Debug, PartialEq)]
pub struct RestSurface {
    /// Position of every vertex, in the space of its bones.
    pub base: Vec<Vec3>,
    /// Morph targets.
    pub targets: Vec<MorphTarget>,
    /// Attachment of the vertices to bones.
    pub skinning: Skinning,
}

/// A morph target.
#[derive(Clone, Debug, PartialEq)]
pub struct MorphTarget {
    /// Index in [`Pose::weights`].
    pub weight: usize,
    /// Offset of each vertex at a weight of 1.
    pub deltas: Vec<Vec3>,
}

/// Attachment of vertices to bones.
#[derive(Clone, Debug, PartialEq)]
pub enum Skinning {
    /// Rigid: all vertices follow one bone.
    Bone(usize),
    /// Linear blend skinning. The weights of a vertex must have a positive sum, by which they are divided.
    Skin {
        /// Bones per vertex.
        width: usize,
        /// Bone indices, `[vertices · width]`.
        bones: Vec<u32>,
        /// `[vertices · width]`
        weights: Vec<f32>,
    },
}

/// Consecutive splats that move.
#[derive(Clone, Debug, PartialEq)]
pub struct AttachedSplats {
    /// Range of splats of the scene.
    pub splats: Range<usize>,
    /// Bone or triangles that they follow.
    pub anchor: Anchor,
    /// Opacity logits, one per splat, of splats that the scene holds as hidden, because in the rest pose the transform
    /// of their bone is flat, or some of their triangles have no area.
    pub hidden: Option<Vec<f32>>,
}

/// Attachment of splats.
#[derive(Clone, Debug, PartialEq)]
pub enum Anchor {
    /// A bone, relative to [`Rig::origin`].
    Bone(usize),
    /// Triangles, one per splat.
    Triangles(Binding),
}

/// Splats in the frames of triangles.
#[derive(Clone, Debug, PartialEq)]
pub struct Binding {
    /// Index of the mesh that the triangles belong to.
    pub surface: usize,
    /// Vertices of the triangle, per splat.
    pub corners: Vec<[u32; 3]>,
    /// Means in the triangle's frame.
    pub translations: Vec<Vec3>,
    /// Orientations relative to the triangle's frame.
    pub rotations: Vec<Quat>,
    /// Linear scales relative to the triangle's size.
    pub scales: Vec<Vec3>,
    /// Frame of their view dependence.
    pub harmonics: ShFrame,
}

/// Frame that the view dependence of bound splats follows.
#[derive(Clone, Debug, PartialEq)]
pub enum ShFrame {
    /// A bone.
    Bone(usize),
    /// The triangle: per splat, the rotation from the scene's frame in the rest pose to that of the undeformed
    /// triangle.
    Triangles(Vec<DQuat>),
}

/// Frame of a triangle (S. Qian et al., `GaussianAvatars`, CVPR 2024; the extension's `edgeNormal`).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Frame {
    /// Columns: along the first edge, the normal, and across both.
    pub axes: DMat3,
    /// Mean of the first edge and the height above it.
    pub size: f64,
    /// Mean of the corners.
    pub center: DVec3,
}

impl Frame {
    /// Frame of a triangle with these corners in order; `None` if they are collinear.
    #[must_use]
    pub fn of(corners: [DVec3; 3]) -> Option<Self> {
        let [v0, v1, v2] = corners;
        let (e, u) = (v1 - v0, v2 - v0);
        let a0 = e.try_normalize()?;
        let a1 = a0.cross(u).try_normalize()?;
        let a2 = a0.cross(a1);
        let axes = DMat3::from_cols(a0, a1, a2);
        Some(Self { axes, size: 0.5 * (e.length() + a2.dot(u).abs()), center: (v0 + v1 + v2) / 3.0 })
    }
}

/// Opacity logit of splats that are not drawn, far below the least visible opacity.
pub(crate) const HIDDEN: f32 = -100.0;

impl Rig {
    /// * `surfaces`: one per mesh of the scene.
    /// * `rest`: the pose in which the scene is as it is stored.
    /// * `names`: what bones are called, for messages and for programs that show them.
    ///
    /// # Errors
    /// If lengths differ, an index is out of range, or a vertex of a skin has no positive weight.
    pub fn new(
        surfaces: Vec<Option<RestSurface>>,
        attached: Vec<AttachedSplats>,
        rest: Pose,
        names: Vec<String>,
    ) -> Result<Self, SceneError> {
        check_len("names of bones", names.len(), rest.bones.len())?;
        surfaces.iter().flatten().try_for_each(|rest_surface| rest_surface.check(&rest))?;
        for AttachedSplats { splats, anchor, hidden } in &attached {
            if splats.start > splats.end {
                return Err(SceneError::new("splats", "a range", format!("{} to {}", splats.start, splats.end)));
            }
            if let Some(logits) = hidden {
                check_len("opacities of hidden splats", logits.len(), splats.len())?;
            }
            match anchor {
                Anchor::Bone(bone) => below("bone", *bone, rest.bones.len())?,
                Anchor::Triangles(binding) => binding.check(splats.len(), &surfaces, &rest)?,
            }
        }
        Ok(Self { surfaces, attached, rest, names })
    }

    /// Surfaces, one per mesh; `None` for static ones.
    #[must_use]
    pub fn surfaces(&self) -> &[Option<RestSurface>] {
        &self.surfaces
    }

    /// Splats that move.
    #[must_use]
    pub fn attached(&self) -> &[AttachedSplats] {
        &self.attached
    }

    /// The pose in which the scene is as it is stored.
    #[must_use]
    pub fn rest(&self) -> &Pose {
        &self.rest
    }

    /// Transform under which the scene holds splats and maps that are attached to a bone: that of the rest pose, or the
    /// identity where that one is flat, under which they cannot be placed.
    ///
    /// # Panics
    /// If there is no such bone.
    #[must_use]
    pub fn origin(&self, bone: usize) -> DMat4 {
        let rest = self.rest.bones[bone];
        if is_flat(rest) { DMat4::IDENTITY } else { rest }
    }

    /// Names of bones, one each.
    #[must_use]
    pub fn bone_names(&self) -> &[String] {
        &self.names
    }

    /// The scene in a pose; `scene` is the one in the rest pose, after it was moved by `moved`, a similarity. Parts
    /// that `pose` leaves in the rest pose keep their bits. Splats and view-dependent surfaces of a bone whose transform
    /// is flat are not drawn: splats are hidden, surfaces have no extent.
    ///
    /// # Errors
    /// If the scene or the pose does not belong to this rig, or `moved` is no similarity.
    pub fn pose(&self, scene: &HybridScene, pose: &Pose, moved: DMat4) -> Result<HybridScene, SceneError> {
        let Some(by) = similarity(moved) else {
            return Err(SceneError::new("moved", "a rotation, a shift and an even scale", "another transform"));
        };
        check_len("bones", pose.bones.len(), self.rest.bones.len())?;
        check_len("weights", pose.weights.len(), self.rest.weights.len())?;
        check_len("meshes", scene.meshes.len(), self.surfaces.len())?;
        let meshes = self.surfaces.iter().zip(&scene.meshes).map(|(rest_surface, mesh)| match rest_surface {
            Some(rest_surface) if rest_surface.moves(pose, &self.rest) => self.posed(rest_surface, mesh, pose, moved),
            _ => Ok(mesh.clone()),
        });
        let meshes = meshes.collect::<Result<Vec<_>, _>>()?;
        let mut splats = scene.splats.clone().into_arrays();
        self.reveal(&mut splats)?;
        for AttachedSplats { splats: these, anchor, .. } in &self.attached {
            match anchor {
                Anchor::Bone(bone) => self.follow_bone(&mut splats, these.clone(), *bone, pose, moved),
                Anchor::Triangles(binding) => {
                    let (surfaces, unmoved) = ((scene, &meshes[binding.surface]), by.rotation.inverse());
                    self.follow_triangles(&mut splats, these.start, binding, surfaces, pose, (moved, unmoved));
                }
            }
        }
        Ok(HybridScene { splats: splats.check()?, meshes, composition: scene.composition })
    }

    /// The scene in the rest pose with hidden splats shown at their [`Rig::origin`], for programs that pose it
    /// themselves.
    ///
    /// # Errors
    /// If the scene does not belong to this rig.
    pub fn revealed<'a>(&self, scene: &'a HybridScene) -> Result<Cow<'a, HybridScene>, SceneError> {
        if self.attached.iter().all(|part| part.hidden.is_none()) {
            return Ok(Cow::Borrowed(scene));
        }
        let mut splats = scene.splats.clone().into_arrays();
        self.reveal(&mut splats)?;
        let (meshes, composition) = (scene.meshes.clone(), scene.composition);
        Ok(Cow::Owned(HybridScene { splats: splats.check()?, meshes, composition }))
    }

    /// Gives hidden splats their own opacities.
    fn reveal(&self, splats: &mut SplatArrays) -> Result<(), SceneError> {
        for AttachedSplats { splats: these, hidden, .. } in &self.attached {
            if these.end > splats.means.len() {
                let found = splats.means.len().to_string();
                return Err(SceneError::new("splats", format!("at least {}", these.end), found));
            }
            if let Some(logits) = hidden {
                splats.opacity_logits[these.clone()].copy_from_slice(logits);
            }
        }
        Ok(())
    }

    fn posed(&self, rest_surface: &RestSurface, mesh: &Mesh, pose: &Pose, moved: DMat4) -> Result<Mesh, SceneError> {
        check_len("positions", mesh.positions().len(), rest_surface.base.len())?;
        let mut atlas = mesh.atlas().clone();
        let mut positions = rest_surface.positions(pose);
        if let Skinning::Bone(bone) = rest_surface.skinning
            && atlas.sh_degree() > 0
        {
            match self.since_rest(bone, pose, moved) {
                Since::Rested => {}
                Since::Moved(_, turn) => atlas = turned(&atlas, turn)?,
                Since::Gone => positions.fill(pose.bones[bone].w_axis.truncate().as_vec3()),
            }
        }
        if moved != DMat4::IDENTITY {
            positions.par_iter_mut().for_each(|p| *p = moved.transform_point3(p.as_dvec3()).as_vec3());
        }
        Mesh::new(positions, mesh.triangles().to_vec(), mesh.corner_uvs().to_vec(), atlas)
    }

    /// Change that a pose makes to content attached to a bone.
    fn since_rest(&self, bone: usize, pose: &Pose, moved: DMat4) -> Since {
        let (now, origin) = (moved * pose.bones[bone], moved * self.origin(bone));
        let Some(orthogonal_now) = orthogonal(now) else { return Since::Gone };
        if pose.bones[bone] == self.rest.bones[bone] {
            return Since::Rested;
        }
        let transform = now * origin.inverse();
        if !transform.is_finite() {
            return Since::Gone;
        }
        let turn = match similarity(transform) {
            Some(by) => DMat3::from_quat(by.rotation),
            // View dependence follows the rotation of the bone itself, which the change between two stretching
            // transforms need not have.
            None => orthogonal_now * orthogonal(origin).unwrap_or_default().transpose(),
        };
        Since::Moved(transform, turn)
    }

    fn follow_bone(&self, splats: &mut SplatArrays, these: Range<usize>, bone: usize, pose: &Pose, moved: DMat4) {
        match self.since_rest(bone, pose, moved) {
            Since::Rested => {}
            Since::Gone => splats.opacity_logits[these].fill(HIDDEN),
            Since::Moved(transform, turned_by) => {
                reshape(splats, these.clone(), transform);
                turn(splats, these, turned_by);
            }
        }
    }

    fn follow_triangles(
        &self,
        splats: &mut SplatArrays,
        first: usize,
        binding: &Binding,
        (rest, now): (&HybridScene, &Mesh),
        pose: &Pose,
        (moved, unmoved): (DMat4, DQuat),
    ) {
        let bone_turn = match binding.harmonics {
            ShFrame::Bone(bone) => match self.since_rest(bone, pose, moved) {
                Since::Moved(_, turn) => turn,
                Since::Rested | Since::Gone => DMat3::IDENTITY,
            },
            ShFrame::Triangles(_) => DMat3::IDENTITY,
        };
        for (j, &corners) in binding.corners.iter().enumerate() {
            let i = first + j;
            let places = corners_of(now, corners);
            let turned_by = if places == corners_of(&rest.meshes[binding.surface], corners) {
                // Those on triangles without area are hidden as they rest.
                splats.opacity_logits[i] = rest.splats.opacity_logits()[i];
                bone_turn
            } else if let Some(frame) = Frame::of(places) {
                let rotation = binding.place(j, &frame, splats, i);
                match &binding.harmonics {
                    ShFrame::Bone(_) => bone_turn,
                    ShFrame::Triangles(turns) => DMat3::from_quat(rotation * turns[j] * unmoved),
                }
            } else {
                splats.opacity_logits[i] = HIDDEN;
                continue;
            };
            turn(splats, i..i + 1, turned_by);
        }
    }
}

/// Positions of a triangle's corners.
fn corners_of(mesh: &Mesh, corners: [u32; 3]) -> [DVec3; 3] {
    corners.map(|v| mesh.positions().get(v as usize).copied().unwrap_or_default().as_dvec3())
}

/// Log-scale for scales of 0, whose logarithm is not finite: that of the least normal f32.
const LEAST_LOG_SCALE: f64 = -87.336_544;

/// Change of content attached to a bone.
enum Since {
    /// The bone is in its rest pose.
    Rested,
    /// Transform from the rest pose, and rotation of the view dependence.
    Moved(DMat4, DMat3),
    /// The transform of the bone is flat, as where things are scaled to zero to make them disappear.
    Gone,
}

fn below(what: &str, index: usize, count: usize) -> Result<(), SceneError> {
    let fault = || SceneError::new(what, format!("an index below {count}"), index.to_string());
    if index < count { Ok(()) } else { Err(fault()) }
}

impl Binding {
    /// Places splats that have no place of their own on their triangles of the mesh as it rests. View dependence that
    /// follows the triangles is rotated with them, and `harmonics` is made to be relative to that. Splats
    /// on triangles without area are hidden: if there are any, returns the opacities of all, as
    /// [`AttachedSplats::hidden`] has them.
    pub(crate) fn settle(&mut self, splats: &mut SplatArrays, mesh: &Mesh) -> Option<Vec<f32>> {
        let opacities = splats.opacity_logits.clone();
        let mut hides = false;
        for (i, &corners) in self.corners.iter().enumerate() {
            let Some(frame) = Frame::of(corners_of(mesh, corners)) else {
                splats.opacity_logits[i] = HIDDEN;
                hides = true;
                continue;
            };
            let rotation = self.place(i, &frame, splats, i);
            if let ShFrame::Triangles(turns) = &mut self.harmonics {
                turn(splats, i..i + 1, DMat3::from_quat(rotation * turns[i]));
                turns[i] = rotation.inverse();
            }
        }
        hides.then_some(opacities)
    }

    /// Places splat `i`, the `j`-th that is bound, on a triangle of this frame, all but its view dependence; returns
    /// the frame's rotation.
    fn place(&self, j: usize, frame: &Frame, splats: &mut SplatArrays, i: usize) -> DQuat {
        let rotation = DQuat::from_mat3(&frame.axes);
        let mean = frame.size * (frame.axes * self.translations[j].as_dvec3()) + frame.center;
        splats.means[i] = mean.as_vec3();
        splats.rotations[i] = (rotation * self.rotations[j].as_dquat()).normalize().as_quat();
        let log_scale = (frame.size * self.scales[j].as_dvec3()).to_array().map(f64::ln);
        splats.log_scales[i] = DVec3::from(log_scale).max(DVec3::splat(LEAST_LOG_SCALE)).as_vec3();
        rotation
    }

    /// Checks that it binds this many splats to one of these surfaces.
    fn check(&self, splats: usize, surfaces: &[Option<RestSurface>], rest: &Pose) -> Result<(), SceneError> {
        below("surface", self.surface, surfaces.len())?;
        check_len("corners", self.corners.len(), splats)?;
        if let Some(rest_surface) = &surfaces[self.surface] {
            self.corners.iter().flatten().try_for_each(|&v| below("corner", v as usize, rest_surface.base.len()))?;
        }
        check_len("translations", self.translations.len(), splats)?;
        check_len("rotations", self.rotations.len(), splats)?;
        check_len("scales", self.scales.len(), splats)?;
        match &self.harmonics {
            ShFrame::Bone(bone) => below("bone", *bone, rest.bones.len()),
            ShFrame::Triangles(turns) => check_len("harmonics", turns.len(), splats),
        }
    }
}

impl RestSurface {
    /// Checks that it fits a rig with this pose.
    fn check(&self, rest: &Pose) -> Result<(), SceneError> {
        let vertices = self.base.len();
        for target in &self.targets {
            check_len("deltas", target.deltas.len(), vertices)?;
            below("weight", target.weight, rest.weights.len())?;
        }
        let (width, bones, weights) = match &self.skinning {
            Skinning::Bone(bone) => return below("bone", *bone, rest.bones.len()),
            Skinning::Skin { width, bones, weights } => (*width, bones, weights),
        };
        // Checked even without vertices, as it is a divisor.
        let count = vertices.checked_mul(width.max(1)).filter(|_| width > 0);
        let count = count.ok_or_else(|| SceneError::new("bones per vertex", "at least 1", width.to_string()))?;
        check_len("bones of a skin", bones.len(), count)?;
        check_len("weights of a skin", weights.len(), count)?;
        bones.iter().try_for_each(|&bone| below("bone", bone as usize, rest.bones.len()))?;
        let total = |weights: &[f32]| weights.iter().map(|w| f64::from(*w)).sum::<f64>();
        let weightless =
            weights.chunks_exact(width).position(|weights| total(weights).is_nan() || total(weights) <= 0.0);
        weightless.map_or(Ok(()), |v| {
            let found = total(&weights[v * width..(v + 1) * width]).to_string();
            Err(SceneError::new(format!("weights of vertex {v}"), "a sum above 0", found))
        })
    }

    /// Whether any bone or weight of the surface differs between two poses.
    fn moves(&self, pose: &Pose, other: &Pose) -> bool {
        let differs = |bone: usize| pose.bones[bone] != other.bones[bone];
        let is_skinned = match &self.skinning {
            Skinning::Bone(bone) => differs(*bone),
            Skinning::Skin { bones, .. } => {
                let any: Vec<bool> = (0..pose.bones.len()).map(differs).collect();
                any.contains(&true) && bones.iter().any(|&b| any[b as usize])
            }
        };
        is_skinned || self.targets.iter().any(|t| pose.weights[t.weight].to_bits() != other.weights[t.weight].to_bits())
    }

    /// Positions in the scene, `[V]`.
    ///
    /// # Panics
    /// If the pose has fewer bones or weights than this refers to.
    #[must_use]
    pub fn positions(&self, pose: &Pose) -> Vec<Vec3> {
        let mut positions = self.base.clone();
        for target in &self.targets {
            let weight = pose.weights[target.weight];
            if weight != 0.0 {
                positions.par_iter_mut().zip(&target.deltas).for_each(|(p, d)| *p += weight * *d);
            }
        }
        match &self.skinning {
            Skinning::Bone(bone) => {
                let bone = pose.bones[*bone];
                if bone != DMat4::IDENTITY {
                    positions.par_iter_mut().for_each(|p| *p = bone.transform_point3(p.as_dvec3()).as_vec3());
                }
            }
            Skinning::Skin { width, bones, weights } => {
                let influences = bones.par_chunks_exact(*width).zip(weights.par_chunks_exact(*width));
                positions.par_iter_mut().zip(influences).for_each(|(p, (bones, weights))| {
                    let (mut sum, mut total) = (DVec3::ZERO, 0.0);
                    for (&bone, &weight) in bones.iter().zip(weights).filter(|(_, w)| **w != 0.0) {
                        sum += f64::from(weight)
                            * (pose.bones[bone as usize] * DVec4::from((p.as_dvec3(), 1.0))).truncate();
                        total += f64::from(weight);
                    }
                    // Quantised weights add up to 1 only up to rounding.
                    *p = (sum / total).as_vec3();
                });
            }
        }
        positions
    }

    /// Bytes of memory used.
    #[must_use]
    pub fn bytes(&self) -> u64 {
        let width = if let Skinning::Skin { width, .. } = self.skinning { width } else { 0 };
        (self.base.len() * (12 * (1 + self.targets.len()) + 8 * width)) as u64
    }

    /// The surface reduced to these vertices, in this order.
    ///
    /// # Panics
    /// If there is no such vertex.
    #[must_use]
    pub fn gather(&self, vertices: &[usize]) -> Self {
        fn pick<T: Copy>(values: &[T], width: usize, vertices: &[usize]) -> Vec<T> {
            vertices.iter().flat_map(|&v| values[v * width..(v + 1) * width].iter().copied()).collect()
        }
        let targets = self.targets.iter();
        let skinning = match &self.skinning {
            Skinning::Bone(bone) => Skinning::Bone(*bone),
            Skinning::Skin { width, bones, weights } => Skinning::Skin {
                width: *width,
                bones: pick(bones, *width, vertices),
                weights: pick(weights, *width, vertices),
            },
        };
        Self {
            base: pick(&self.base, 1, vertices),
            targets: targets.map(|t| MorphTarget { weight: t.weight, deltas: pick(&t.deltas, 1, vertices) }).collect(),
            skinning,
        }
    }
}
