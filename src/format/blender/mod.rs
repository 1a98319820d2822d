//! Blender export: `STEM.blend.py`, a script that builds the scene, renders it and saves it as .blend, and the
//! accompanying files of [`super::exchange`].
//!
//! The script is the concatenation of the Python files of this folder, with the scene data as JSON between the first
//! and the second:
//!
//! | file | content |
//! |---|---|
//! | `head.py` | imports, written so that the script also loads without Blender |
//! | `splats.py` | splats as triangles, in the order along rays of an image model; uses numpy only |
//! | `materials.py` | node graphs |
//! | `build.py` | collection, meshes, splats, and the data from which splats are rebuilt when the camera moves |
//! | `motion.py` | bones, shape keys and keyframes of animated objects; splats that follow them |
//! | `cameras.py` | conversion of our cameras to Blender's and back |
//! | `pictures.py` | settings of Cycles, layers, EXR and PNG |
//! | `main.py` | command line |
//!
//! `docs/dcc.md` states what is exact.

mod motion;
#[cfg(test)]
mod tests;

use std::path::Path;

use glam::DMat4;
use serde_json::{Value, json};

use super::error::Fault;
use super::exchange::{self, Beside};
use super::gltf::moving::Moving;
use super::{FormatError, Loss, WriteReport, activation, atomic_write};
use crate::scene::{Camera, ColorSpace, HybridScene, OrderMode};

/// File-name ending of scripts.
pub(super) const SUFFIX: &str = ".blend.py";

const PARTS: [&str; 8] = [
    include_str!("head.py"),
    include_str!("splats.py"),
    include_str!("materials.py"),
    include_str!("build.py"),
    include_str!("motion.py"),
    include_str!("cameras.py"),
    include_str!("pictures.py"),
    include_str!("main.py"),
];

/// Number of splats from which on a warning about build time is given.
const MANY: usize = 2_000_000;

/// Writes the script and its accompanying files, the script last.
///
/// # Errors
/// If a file cannot be written, or the animation cannot be evaluated at a frame or is too large; in the latter cases
/// nothing is written.
pub(super) fn write(
    path: &Path,
    scene: &HybridScene,
    cameras: &[(String, Camera)],
    moving: Option<(&Moving, DMat4)>,
) -> Result<WriteReport, FormatError> {
    let stem = exchange::stem(path, SUFFIX);
    let (mut motion, mut notes, mut bytes, mut files) = (Value::Null, notes(scene), 0, vec![]);
    // Written first, because it may be refused.
    if let Some(moving) = moving {
        let name = format!("{stem}_motion.npz");
        let mut written = motion::write((path, &name), scene, cameras, moving)?;
        motion = written.told;
        motion["file"] = json!(name);
        notes.append(&mut written.notes);
        bytes = written.bytes;
        files.push(name);
    }
    // The script itself hides splats while what they follow is flat.
    let rig = moving.and_then(|(moving, _)| moving.rig());
    let revealed = rig.map(|rig| rig.revealed(scene)).transpose().map_err(|e| Fault::from(e).in_file(path))?;
    let mut beside = exchange::write(path, &stem, revealed.as_deref().unwrap_or(scene))?;
    beside.bytes += bytes;
    beside.files.append(&mut files);
    let script = script(&described(&stem, scene, cameras, &beside, &motion));
    atomic_write(path, script.as_bytes())?;
    let loss = Loss { composition: loses_rule(scene), ..Loss::default() };
    Ok(WriteReport { bytes: beside.bytes + script.len() as u64, beside: beside.files, notes, loss })
}

/// Whether Cycles may differ from the composition: it blends all surfaces, and in another order.
fn loses_rule(scene: &HybridScene) -> bool {
    loses_order(scene) || has_more_surfaces(scene)
}

/// Whether the composition orders splats and surfaces otherwise than by depth at each pixel.
fn loses_order(scene: &HybridScene) -> bool {
    !scene.splats.is_empty() && !scene.meshes.is_empty() && scene.composition.mode != OrderMode::Direct
}

/// Whether a ray may show more surfaces than the composition blends.
fn has_more_surfaces(scene: &HybridScene) -> bool {
    let triangles: usize = scene.meshes.iter().map(|mesh| mesh.triangles().len()).sum();
    triangles > scene.composition.layers as usize && scene.meshes.iter().any(activation::is_clear)
}

fn script(scene: &Value) -> String {
    let [head, rest @ ..] = PARTS;
    // The JSON is inside an ordinary Python string, which it must not terminate.
    let scene = scene.to_string().replace('\'', "\\u0027");
    format!(
        "#!/usr/bin/env python3\n# Written by `centaur convert` for Blender 4.5 and later; --help says what it does.\n\
         {head}\nSCENE = json.loads(r'''{scene}''')\n\n{}",
        rest.join("\n\n")
    )
}

fn described(stem: &str, scene: &HybridScene, cameras: &[(String, Camera)], beside: &Beside, motion: &Value) -> Value {
    let rule = &scene.composition;
    let meshes = beside.meshes.iter().map(|m| json!({ "surface": m.surface, "maps": m.maps }));
    json!({
        "name": stem,
        "splats": beside.splats,
        "meshes": meshes.collect::<Vec<_>>(),
        "motion": motion,
        "cameras": cameras.iter().map(|(name, camera)| described_camera(name, camera)).collect::<Vec<_>>(),
        "composition": {
            "colorSpace": match rule.color_space {
                ColorSpace::SrgbDisplay => "srgb",
                ColorSpace::LinearDisplay => "linear",
            },
            "background": rule.background,
            "near": rule.near,
            "lowPass": [rule.pixel_filter.variance, f32::from(u8::from(rule.pixel_filter.normalized))],
        },
    })
}

/// World→camera parameters of a camera with OpenCV axes; rotation row-major.
fn described_camera(name: &str, camera: &Camera) -> Value {
    let k = camera.intrinsics();
    json!({
        "name": name, "width": k.width, "height": k.height, "fx": k.fx, "fy": k.fy, "cx": k.cx, "cy": k.cy,
        "rotation": camera.rotation().transpose().to_cols_array(), "translation": camera.translation().to_array(),
    })
}

/// Notes on features of the scene that Cycles cannot reproduce.
fn notes(scene: &HybridScene) -> Vec<String> {
    let (rule, splats) = (&scene.composition, scene.splats.len());
    let mut notes = vec![];
    if loses_order(scene) {
        let mode = rule.mode.name();
        notes
            .push(format!("Blender orders splats and surfaces by depth at each pixel, as mode `direct`, not `{mode}`"));
    }
    if has_more_surfaces(scene) {
        notes.push(format!("Blender shows all surfaces along a ray, not the nearest {}", rule.layers));
    }
    if splats > MANY {
        notes.push(format!(
            "{splats} splats take Blender about {:.0} min to build and {:.0} GB of memory; --decimate makes fewer",
            splats as f64 * SECONDS_PER_SPLAT / 60.0,
            splats as f64 * BYTES_PER_SPLAT / 1e9
        ));
    }
    notes
}

/// Peak values measured with Blender 4.5.15 on 2 cores, 100 000 splats of degree 3 in the construction `ewa`.
const SECONDS_PER_SPLAT: f64 = 3e-5;
const BYTES_PER_SPLAT: f64 = 2.2e3;
