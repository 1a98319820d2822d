//! Animation data of the script: `STEM_motion.npz`, numpy arrays, with one row per frame where they vary over time.
//!
//! | array | shape | content |
//! |---|---|---|
//! | `bones`, `bones_rest` | frames × bones × 4 × 4, bones × 4 × 4 | transform from the space of the objects that follow a bone to the scene; at rest see [`Rig::origin`] |
//! | `binds` | bones × 4 × 4 | bind transforms of skin joints in the space of the surface |
//! | `weights` | frames × weights | weights of morph targets |
//! | `meshI_base` | vertices × 3 | positions of mesh I before posing, vertices as in its PLY |
//! | `meshI_deltas`, `meshI_weights` | targets × vertices × 3, targets | morph targets, and the indices of their weights |
//! | `meshI_joints`, `meshI_influences` | vertices × joints | bones of a skin and their weights; meshes without a skin have `meshI_bone` |
//! | `splat_bones` | splats | bone that a splat follows; −1: none, −2: a triangle |
//! | `splat_surfaces`, `splat_corners` | splats, splats × 3 | mesh and vertices of the triangle that a splat follows |
//! | `splat_translations`, `splat_rotations`, `splat_scales` | splats × 3, 4, 3 | splat in the frame of the bone or triangle; quaternions w, x, y, z |
//! | `splat_harmonics`, `splat_undeformed` | splats, splats × 4 | bone with which view dependence rotates; −1: the triangle, relative to its undeformed frame |
//! | `cameras` | frames × cameras × 12 | world→camera rotation, row-major, and translation |

use std::collections::HashMap;
use std::io::Write as _;
use std::path::Path;

use glam::{DMat4, DQuat};
use serde_json::{Value, json};
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipWriter};

use crate::format::cameras::{DEFAULT_FPS, Frames};
use crate::format::error::Fault;
use crate::format::exchange::surface::copied;
use crate::format::gltf::moving::Moving;
use crate::format::placed::similarity;
use crate::format::{FormatError, atomic_write};
use crate::scene::rig::{Anchor, Pose, Rig, ShFrame, Skinning};
use crate::scene::{Camera, HybridScene, SceneError};

/// Upper bound on numbers that vary over time, 512 MB; Blender makes of each a keyframe of five times the size.
const MOST_NUMBERS: usize = 1 << 26;

/// Upper bound on nodes to be placed, summed over frames: a minute of work.
const MOST_NODES: usize = 1 << 28;

/// Result of writing the animation.
pub(super) struct Written {
    /// Description of the animation for the script.
    pub(super) told: Value,
    pub(super) bytes: u64,
    /// Notes on what does not move correctly, one sentence each.
    pub(super) notes: Vec<String>,
}

/// Writes the arrays to the file `name` beside `script`; `moved` is the transform applied to the scene since it was
/// read.
pub(super) fn write(
    (script, name): (&Path, &str),
    scene: &HybridScene,
    cameras: &[(String, Camera)],
    (moving, moved): (&Moving, DMat4),
) -> Result<Written, FormatError> {
    let failed = |fault: Fault| fault.in_file(script);
    let [start, end] = moving.range();
    let fps = moving.fps().unwrap_or(DEFAULT_FPS);
    let frames = Frames::default().take(start, end, fps).map_err(failed)?;
    let numbers = moving.rig().map_or(0, |rig| 16 * rig.rest().bones.len() + rig.rest().weights.len());
    bounded(frames, numbers + 12 * cameras.len(), moving.nodes()).map_err(failed)?;
    let times: Vec<f64> = (0..frames).map(|frame| start + frame as f64 / fps).collect();
    let mut arrays = Arrays::default();
    if let Some(rig) = moving.rig() {
        arrays.rig(rig, scene, &times, moved, moving).map_err(|e| failed(Fault::from(e)))?;
    }
    let mut notes = vec![];
    let rows = camera_rows(moving, cameras, &times, moved, &mut notes).map_err(failed)?;
    if let Some(rows) = &rows {
        arrays.add("cameras", &[frames, cameras.len(), 12], rows);
    }
    let surfaces = moving.rig().map_or(&[][..], Rig::surfaces);
    let meshes: Vec<usize> = (0..surfaces.len()).filter(|&i| surfaces[i].is_some()).collect();
    let path = script.with_file_name(name);
    let bytes = arrays.zipped().map_err(|source| FormatError::Write { file: path.clone(), source })?;
    atomic_write(&path, &bytes)?;
    let told = json!({
        "fps": fps, "frames": frames, "start": start, "meshes": meshes, "names": moving.rig().map_or(&[][..], Rig::bone_names),
        "parents": moving.bone_parents(), "cameras": rows.is_some(),
        "splats": moving.rig().is_some_and(|rig| !rig.attached().is_empty()),
    });
    Ok(Written { told, bytes: bytes.len() as u64, notes })
}

/// Rejects more than [`MOST_NUMBERS`] numbers or [`MOST_NODES`] nodes.
pub(super) fn bounded(frames: usize, numbers: usize, nodes: usize) -> Result<(), Fault> {
    for (per_frame, most, what) in [
        (numbers, MOST_NUMBERS, format!("bones, weights and cameras of at most {MOST_NUMBERS} numbers over time")),
        (nodes, MOST_NODES, format!("at most {MOST_NODES} nodes over time")),
    ] {
        if frames.saturating_mul(per_frame) > most {
            let found = format!("{per_frame} in each of {frames} frames; a pose at one time has room");
            return Err(Fault::whole(what, found));
        }
    }
    Ok(())
}

/// Rows of all cameras, frame by frame; `None` if no camera moves, or if one is missing at some time, which makes the
/// assignment ambiguous.
fn camera_rows(
    moving: &Moving,
    cameras: &[(String, Camera)],
    times: &[f64],
    moved: DMat4,
    notes: &mut Vec<String>,
) -> Result<Option<Vec<f64>>, Fault> {
    let (mut rows, mut moves) = (vec![], false);
    // Without cameras, their evaluation would only cause errors or notes.
    for time in times.iter().filter(|_| !cameras.is_empty()) {
        let (now, _) = moving.cameras_at(*time)?;
        if !now.iter().map(|(name, _)| name).eq(cameras.iter().map(|(name, _)| name)) {
            let found = format!("at {time} s there are only {} of {}", now.len(), cameras.len());
            notes.push(format!(
                "cameras are not animated: {found}, because cameras that shear, mirror or stretch are left out"
            ));
            return Ok(None);
        }
        for ((_, now), (_, rest)) in now.iter().zip(cameras) {
            let row = row(now, moved);
            moves |= row.iter().zip(row_of(rest)).any(|(a, b)| (a - b).abs() > 1e-9 * (1.0 + b.abs()));
            rows.extend(row);
        }
    }
    Ok(moves.then_some(rows))
}

/// Row of a camera after the scene has been transformed by `moved`.
fn row(camera: &Camera, moved: DMat4) -> [f64; 12] {
    let Some(by) = similarity(moved).filter(|_| moved != DMat4::IDENTITY) else { return row_of(camera) };
    let rotation = camera.rotation() * glam::DMat3::from_quat(by.rotation.inverse());
    let translation = by.scale * camera.translation() - rotation * by.translation;
    Camera::new(*camera.intrinsics(), rotation, translation).map_or_else(|_| row_of(camera), |camera| row_of(&camera))
}

fn row_of(camera: &Camera) -> [f64; 12] {
    let (r, t) = (camera.rotation().transpose().to_cols_array(), camera.translation().to_array());
    std::array::from_fn(|i| if i < 9 { r[i] } else { t[i - 9] })
}

/// Named arrays in .npy format.
#[derive(Default)]
struct Arrays(Vec<(String, Vec<u8>)>);

/// Number type of an array: its numpy name and byte form.
trait Number: Copy {
    const KIND: &'static str;
    fn append(self, bytes: &mut Vec<u8>);
}

macro_rules! number {
    ($type:ty, $kind:literal) => {
        impl Number for $type {
            const KIND: &'static str = $kind;
            fn append(self, bytes: &mut Vec<u8>) {
                bytes.extend_from_slice(&self.to_le_bytes());
            }
        }
    };
}
number!(f32, "<f4");
number!(f64, "<f8");
number!(i32, "<i4");

impl Arrays {
    fn add<T: Number>(&mut self, name: &str, shape: &[usize], values: &[T]) {
        let sides: String = shape.iter().map(|n| format!("{n},")).collect();
        let mut header = format!("{{'descr': '{}', 'fortran_order': False, 'shape': ({sides}), }}", T::KIND);
        // The header, with magic, version and length, ends in a line feed at a multiple of 64 bytes.
        let padded = (10 + header.len() + 1).next_multiple_of(64);
        header.extend(std::iter::repeat_n(' ', padded - 11 - header.len()));
        header.push('\n');
        let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
        bytes.extend_from_slice(&(header.len() as u16).to_le_bytes());
        bytes.extend_from_slice(header.as_bytes());
        values.iter().for_each(|v| v.append(&mut bytes));
        self.0.push((format!("{name}.npy"), bytes));
    }

    fn rig(
        &mut self,
        rig: &Rig,
        scene: &HybridScene,
        times: &[f64],
        moved: DMat4,
        moving: &Moving,
    ) -> Result<(), SceneError> {
        let (frames, count, targets) = (times.len(), rig.rest().bones.len(), rig.rest().weights.len());
        let rows = |matrix: DMat4| matrix.transpose().to_cols_array();
        let of_pose = |pose: &Pose| pose.bones.iter().flat_map(|bone| rows(moved * *bone)).collect::<Vec<_>>();
        let (mut bones, mut weights) = (Vec::with_capacity(frames * count * 16), Vec::with_capacity(frames * targets));
        for time in times {
            let pose = moving.pose(*time)?;
            bones.extend(of_pose(&pose));
            weights.extend_from_slice(&pose.weights);
        }
        self.add("bones", &[frames, count, 4, 4], &bones);
        self.add("weights", &[frames, targets], &weights);
        drop((bones, weights));
        let origins: Vec<f64> = (0..count).flat_map(|bone| rows(moved * rig.origin(bone))).collect();
        self.add("bones_rest", &[count, 4, 4], &origins);
        let binds: Vec<f64> = (0..count).flat_map(|b| rows(moving.bind(b).unwrap_or(DMat4::IDENTITY))).collect();
        self.add("binds", &[count, 4, 4], &binds);
        for (i, rest_surface) in rig.surfaces().iter().enumerate() {
            let Some(rest_surface) = rest_surface else { continue };
            let rest_surface = rest_surface.gather(&copied(&scene.meshes[i]));
            let (n, name) = (rest_surface.base.len(), |what: &str| format!("mesh{i}_{what}"));
            self.add(&name("base"), &[n, 3], bytemuck::cast_slice::<_, f32>(&rest_surface.base));
            let deltas: Vec<f32> =
                rest_surface.targets.iter().flat_map(|t| bytemuck::cast_slice(&t.deltas).to_vec()).collect();
            self.add(&name("deltas"), &[rest_surface.targets.len(), n, 3], &deltas);
            let weights: Vec<i32> = rest_surface.targets.iter().map(|t| t.weight as i32).collect();
            self.add(&name("weights"), &[weights.len()], &weights);
            match &rest_surface.skinning {
                Skinning::Bone(bone) => self.add(&name("bone"), &[1], &[*bone as i32]),
                Skinning::Skin { width, bones, weights } => {
                    let bones: Vec<i32> = bones.iter().map(|b| *b as i32).collect();
                    self.add(&name("joints"), &[n, *width], &bones);
                    self.add(&name("influences"), &[n, *width], weights);
                }
            }
        }
        if !rig.attached().is_empty() {
            self.splats(rig, scene, moved);
        }
        Ok(())
    }

    fn splats(&mut self, rig: &Rig, scene: &HybridScene, moved: DMat4) {
        let n = scene.splats.len();
        let unmoved = similarity(moved).map_or(DQuat::IDENTITY, |s| s.rotation.inverse());
        let (mut bones, mut surfaces, mut harmonics) = (vec![-1; n], vec![-1; n], vec![-1; n]);
        let (mut corners, mut translations, mut scales) = (vec![[0; 3]; n], vec![[0.0f32; 3]; n], vec![[0.0f32; 3]; n]);
        let (mut rotations, mut undeformed) = (vec![[1.0f32, 0.0, 0.0, 0.0]; n], vec![[1.0f64, 0.0, 0.0, 0.0]; n]);
        for part in rig.attached() {
            match &part.anchor {
                Anchor::Bone(bone) => {
                    bones[part.splats.clone()].fill(*bone as i32);
                    harmonics[part.splats.clone()].fill(*bone as i32);
                }
                Anchor::Triangles(binding) => {
                    let copies: HashMap<usize, usize> =
                        copied(&scene.meshes[binding.surface]).into_iter().enumerate().map(|(i, v)| (v, i)).collect();
                    for (j, i) in part.splats.clone().enumerate() {
                        (bones[i], surfaces[i]) = (-2, binding.surface as i32);
                        corners[i] = binding.corners[j].map(|v| copies.get(&(v as usize)).map_or(0, |&i| i as i32));
                        translations[i] = binding.translations[j].to_array();
                        let q = binding.rotations[j];
                        rotations[i] = [q.w, q.x, q.y, q.z];
                        scales[i] = binding.scales[j].to_array();
                        match &binding.harmonics {
                            ShFrame::Bone(bone) => harmonics[i] = *bone as i32,
                            ShFrame::Triangles(turns) => {
                                let q = turns[j] * unmoved;
                                undeformed[i] = [q.w, q.x, q.y, q.z];
                            }
                        }
                    }
                }
            }
        }
        self.add("splat_bones", &[n], &bones);
        self.add("splat_surfaces", &[n], &surfaces);
        self.add("splat_corners", &[n, 3], corners.as_flattened());
        self.add("splat_translations", &[n, 3], translations.as_flattened());
        self.add("splat_rotations", &[n, 4], rotations.as_flattened());
        self.add("splat_scales", &[n, 3], scales.as_flattened());
        self.add("splat_harmonics", &[n], &harmonics);
        self.add("splat_undeformed", &[n, 4], undeformed.as_flattened());
    }

    fn zipped(self) -> std::io::Result<Vec<u8>> {
        let mut zip = ZipWriter::new(std::io::Cursor::new(vec![]));
        let options = SimpleFileOptions::default().compression_method(CompressionMethod::Deflated);
        for (name, bytes) in self.0 {
            zip.start_file(name, options).map_err(std::io::Error::other)?;
            zip.write_all(&bytes)?;
        }
        Ok(zip.finish().map_err(std::io::Error::other)?.into_inner())
    }
}
