//! What moves a scene: morph targets and bones under its surfaces, and splats that follow bones or triangles.
//!
//! A rig knows nothing of time, nor of where poses come from: glTF animations are one source (`format::gltf`), a tracked
//! head of parametric shape would be another. It holds the scene's geometry before any pose; a [`Pose`] says where bones are
//! and how much targets count.
//!
//! ```text
//! p = base + Σ weightₜ · deltaₜ                            morph targets
//! v = bone · p,   or   Σ wⱼ · boneⱼ · p / Σ wⱼ            one bone, or linear blend skinning
//! mean, rotation, scale = k·R·t + c,  q(R)·q,  k·s         a splat on the triangle of frame (R, k, c), see [`Frame`]
//! ```

#[cfg(test)]
mod tests;

use std::ops::Range;

use glam::{DMat3, DMat4, DQuat, DVec3, DVec4, Quat, Vec3};
use rayon::prelude::*;

use super::placement::{orthogonal, reshape, similarity, turn, turned};
use super::{HybridScene, Mesh, SceneError, SplatArrays, check_len};

/// A moment of a rig.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Pose {
    /// Per bone, from the space in which what hangs on it is stored to the scene, column vectors. Of a joint of a skin:
    /// its global transform times its inverse bind matrix.
    pub bones: Vec<DMat4>,
    /// Per weight of morph targets.
    pub weights: Vec<f32>,
}

/// The geometry of a scene before it is posed, and what hangs on what.
#[derive(Clone, Debug, PartialEq)]
pub struct Rig {
    /// One per mesh of the scene; `None`: it keeps still.
    surfaces: Vec<Option<RestSurface>>,
    /// Splats that move; the others keep still.
    attached: Vec<AttachedSplats>,
    rest: Pose,
    /// One per bone.
    names: Vec<String>,
}

/// A surface before it is posed.
#[derive(Clone, Debug, PartialEq)]
pub struct RestSurface {
    /// Position of every vertex, in the space of its bones.
    pub base: Vec<Vec3>,
    /// What may be added to them.
    pub targets: Vec<MorphTarget>,
    /// What takes them to the scene.
    pub skinning: Skinning,
}

/// A morph target.
#[derive(Clone, Debug, PartialEq)]
pub struct MorphTarget {
    /// Index in [`Pose::weights`].
    pub weight: usize,
    /// What a weight of 1 adds to each vertex.
    pub deltas: Vec<Vec3>,
}

/// What takes vertices to the scene.
#[derive(Clone, Debug, PartialEq)]
pub enum Skinning {
    /// All of them one bone.
    Bone(usize),
    /// Linear blend skinning. Weights of a vertex add up to more than 0; what they add up to is divided by.
    Skin {
        /// Bones per vertex.
        width: usize,
        /// `[vertices · width]`
        bones: Vec<u32>,
        /// `[vertices · width]`
        weights: Vec<f32>,
    },
}

/// Consecutive splats that move.
#[derive(Clone, Debug, PartialEq)]
pub struct AttachedSplats {
    /// Which splats of the scene.
    pub splats: Range<usize>,
    /// What they follow.
    pub anchor: Anchor,
}

/// What splats follow.
#[derive(Clone, Debug, PartialEq)]
pub enum Anchor {
    /// A bone, as they are in the rest pose.
    Bone(usize),
    /// Triangles, one a splat.
    Triangles(Binding),
}

/// Splats in the frames of triangles.
#[derive(Clone, Debug, PartialEq)]
pub struct Binding {
    /// The mesh that the triangles are of.
    pub surface: usize,
    /// Three of its vertices per splat.
    pub corners: Vec<[u32; 3]>,
    /// Means in the frame of the triangle.
    pub translations: Vec<Vec3>,
    /// Orientations relative to it.
    pub rotations: Vec<Quat>,
    /// Linear scales relative to its size.
    pub scales: Vec<Vec3>,
    /// What their view dependence turns with.
    pub harmonics: ShFrame,
}

/// What the view dependence of bound splats turns with.
#[derive(Clone, Debug, PartialEq)]
pub enum ShFrame {
    /// A bone.
    Bone(usize),
    /// The triangle: per splat, what turns the frame of the scene in the rest pose to that of the undeformed triangle.
    Triangles(Vec<DQuat>),
}

/// What a triangle defines as a frame (S. Qian et al., `GaussianAvatars`, CVPR 2024; the extension's `edgeNormal`).
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
    /// Of corners in their order; `None` if they are on a line.
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

/// Logit of splats that are not drawn, far below the least opacity that is.
const HIDDEN: f32 = -100.0;

impl Rig {
    /// * `surfaces`: one per mesh of the scene.
    /// * `rest`: the pose in which the scene is as it is stored.
    /// * `names`: what bones are called, for messages and for programs that show them.
    ///
    /// # Errors
    /// If lengths differ, an index is out of range, or nothing weighs a vertex of a skin.
    pub fn new(
        surfaces: Vec<Option<RestSurface>>,
        attached: Vec<AttachedSplats>,
        rest: Pose,
        names: Vec<String>,
    ) -> Result<Self, SceneError> {
        check_len("names of bones", names.len(), rest.bones.len())?;
        surfaces.iter().flatten().try_for_each(|rest_surface| rest_surface.check(&rest))?;
        for AttachedSplats { splats, anchor } in &attached {
            if splats.start > splats.end {
                return Err(SceneError::new("splats", "a range", format!("{} to {}", splats.start, splats.end)));
            }
            match anchor {
                Anchor::Bone(bone) => below("bone", *bone, rest.bones.len())?,
                Anchor::Triangles(binding) => binding.check(splats.len(), &surfaces, &rest)?,
            }
        }
        Ok(Self { surfaces, attached, rest, names })
    }

    /// One per mesh; `None` keeps still.
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

    /// What bones are called, one each.
    #[must_use]
    pub fn bone_names(&self) -> &[String] {
        &self.names
    }

    /// The scene in a pose; `scene` is that in the rest pose, after it has been moved by `moved`, a similarity. What `pose`
    /// leaves where it rests keeps its bits.
    ///
    /// # Errors
    /// If the scene or the pose is not that of this rig, `moved` is no similarity, or bones are where splats cannot follow them:
    /// flat. What a bone scales to nothing is not drawn.
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
        for AttachedSplats { splats: these, anchor } in &self.attached {
            if these.end > splats.means.len() {
                let found = splats.means.len().to_string();
                return Err(SceneError::new("splats", format!("at least {}", these.end), found));
            }
            match anchor {
                Anchor::Bone(bone) => self.follow_bone(&mut splats, these.clone(), *bone, pose, moved)?,
                Anchor::Triangles(binding) => {
                    let surfaces = (&scene.meshes[binding.surface], &meshes[binding.surface]);
                    let unmoved = by.rotation.inverse();
                    self.follow_triangles(&mut splats, these.start, binding, surfaces, pose, (moved, unmoved))?;
                }
            }
        }
        Ok(HybridScene { splats: splats.check()?, meshes, composition: scene.composition })
    }

    fn posed(&self, rest_surface: &RestSurface, mesh: &Mesh, pose: &Pose, moved: DMat4) -> Result<Mesh, SceneError> {
        check_len("positions", mesh.positions().len(), rest_surface.base.len())?;
        let mut atlas = mesh.atlas().clone();
        if let Skinning::Bone(bone) = rest_surface.skinning
            && atlas.sh_degree() > 0
            && let Since::Moved(_, turn) = self.since_rest(bone, pose, moved)?
        {
            atlas = turned(&atlas, turn)?;
        }
        let mut positions = rest_surface.positions(pose);
        if moved != DMat4::IDENTITY {
            positions.par_iter_mut().for_each(|p| *p = moved.transform_point3(p.as_dvec3()).as_vec3());
        }
        Mesh::new(positions, mesh.triangles().to_vec(), mesh.corner_uvs().to_vec(), atlas)
    }

    /// What a pose does to a thing on a bone.
    fn since_rest(&self, bone: usize, pose: &Pose, moved: DMat4) -> Result<Since, SceneError> {
        let (now, rest) = (pose.bones[bone], self.rest.bones[bone]);
        if now == rest {
            return Ok(Since::Rested);
        }
        if DMat3::from_mat4(now) == DMat3::ZERO {
            return Ok(Since::Gone);
        }
        let (now, rest) = (moved * now, moved * rest);
        let transform = now * rest.inverse();
        // Of a bone without extent where it rests nothing can be told: the inverse is not finite.
        let turn = Some(transform).filter(DMat4::is_finite).and_then(|transform| match similarity(transform) {
            Some(by) => Some(DMat3::from_quat(by.rotation)),
            // What is seen turns with the bone, which what lies between two of its transforms need not do where they stretch.
            None => Some(orthogonal(now)? * orthogonal(rest)?.transpose()),
        });
        turn.map(|turn| Since::Moved(transform, turn)).ok_or_else(|| {
            let expected = "a transform with an inverse, where it rests and now";
            SceneError::new(format!("bone {}", self.names[bone]), expected, "one without")
        })
    }

    fn follow_bone(
        &self,
        splats: &mut SplatArrays,
        these: Range<usize>,
        bone: usize,
        pose: &Pose,
        moved: DMat4,
    ) -> Result<(), SceneError> {
        match self.since_rest(bone, pose, moved)? {
            Since::Rested => {}
            Since::Gone => splats.opacity_logits[these].fill(HIDDEN),
            Since::Moved(transform, turned_by) => {
                reshape(splats, these.clone(), transform);
                turn(splats, these, turned_by);
            }
        }
        Ok(())
    }

    fn follow_triangles(
        &self,
        splats: &mut SplatArrays,
        first: usize,
        binding: &Binding,
        (rest, now): (&Mesh, &Mesh),
        pose: &Pose,
        (moved, unmoved): (DMat4, DQuat),
    ) -> Result<(), SceneError> {
        let bone_turn = match binding.harmonics {
            ShFrame::Bone(bone) => match self.since_rest(bone, pose, moved)? {
                Since::Moved(_, turn) => turn,
                Since::Rested | Since::Gone => DMat3::IDENTITY,
            },
            ShFrame::Triangles(_) => DMat3::IDENTITY,
        };
        for (j, &corners) in binding.corners.iter().enumerate() {
            let i = first + j;
            let at = |mesh: &Mesh| corners.map(|v| mesh.positions().get(v as usize).copied());
            let places = at(now);
            let turned_by = if places == at(rest) {
                bone_turn
            } else {
                let corners = places.map(|p| p.unwrap_or_default().as_dvec3());
                let Some(frame) = Frame::of(corners) else {
                    splats.opacity_logits[i] = HIDDEN;
                    continue;
                };
                let rotation = DQuat::from_mat3(&frame.axes);
                let mean = frame.size * (frame.axes * binding.translations[j].as_dvec3()) + frame.center;
                splats.means[i] = mean.as_vec3();
                splats.rotations[i] = (rotation * binding.rotations[j].as_dquat()).normalize().as_quat();
                let log_scale = (frame.size * binding.scales[j].as_dvec3()).to_array().map(f64::ln);
                splats.log_scales[i] = DVec3::from(log_scale).max(DVec3::splat(LEAST_LOG_SCALE)).as_vec3();
                match &binding.harmonics {
                    ShFrame::Bone(_) => bone_turn,
                    ShFrame::Triangles(turns) => DMat3::from_quat(rotation * turns[j] * unmoved),
                }
            };
            turn(splats, i..i + 1, turned_by);
        }
        Ok(())
    }
}

/// Of scales of 0, whose logarithm is not finite: that of the least normal f32.
const LEAST_LOG_SCALE: f64 = -87.336_544;

/// What a pose does to what hangs on a bone.
enum Since {
    /// It is where it rests.
    Rested,
    /// This takes it there, and turns what is seen of it.
    Moved(DMat4, DMat3),
    /// It is scaled to nothing, as things are made to disappear.
    Gone,
}

fn below(what: &str, index: usize, count: usize) -> Result<(), SceneError> {
    let fault = || SceneError::new(what, format!("an index below {count}"), index.to_string());
    if index < count { Ok(()) } else { Err(fault()) }
}

impl Binding {
    /// Error unless it binds this many splats to one of these surfaces.
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
    /// Error unless it is one of a rig with this pose.
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
        // Also where there are no vertices: nobody wants to divide by it.
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

    /// Whether anything that it hangs on is elsewhere than in the other pose.
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
                    // Quantised weights add up to 1 but for their rounding.
                    *p = (sum / total).as_vec3();
                });
            }
        }
        positions
    }

    /// What it takes in memory.
    #[must_use]
    pub fn bytes(&self) -> u64 {
        let width = if let Skinning::Skin { width, .. } = self.skinning { width } else { 0 };
        (self.base.len() * (12 * (1 + self.targets.len()) + 8 * width)) as u64
    }

    /// The same with only these vertices, in this order.
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
