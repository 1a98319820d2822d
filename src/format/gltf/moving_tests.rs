//! Animated documents, compared with results of glTF's formulas computed by hand.

use glam::{DMat3, DVec3, Mat4, Vec3};
use serde_json::{Value, json};

use super::binding::geometry_digest;
use super::core_tests::{Builder, near, triangle};
use super::extension::{HYBRID, KHR_SPLATS};
use super::splat_tests::{khr, splat_document, splats};
use super::*;
use crate::edit::Similarity;
use crate::format::test_scenes::black_png;
use crate::format::{SceneFile, WriteOptions, inspect, read_file, read_scene, write_scene};
use crate::scene::rig::HIDDEN;

/// A file on disk: everything here is read by path.
pub(super) struct File {
    _folder: tempfile::TempDir,
    path: std::path::PathBuf,
}

impl File {
    fn new(b: &Builder, document: &Value) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("scene.gltf");
        std::fs::write(&path, b.file(document)).unwrap();
        Self { _folder: folder, path }
    }

    /// The rest pose, in the frame of the document.
    pub(super) fn rest(&self) -> SceneFile {
        as_stored(&self.path, &ReadOptions::default())
    }

    /// The scene read at a time, which must equal what the source of the rest pose gives for that time.
    #[track_caller]
    pub(super) fn at(&self, time: f64) -> SceneFile {
        let posed = as_stored(&self.path, &ReadOptions { time: Some(time), ..ReadOptions::default() });
        let rest = self.rest();
        assert_eq!(rest.source.unwrap().at(&rest.scene, time).unwrap(), posed.scene);
        posed
    }

    #[track_caller]
    fn positions(&self, time: f64, expected: &[[f32; 3]]) {
        let file = self.at(time);
        near(bytemuck::cast_slice(file.scene.meshes[0].positions()), expected.as_flattened(), 2e-6);
    }
}

/// A file in the frame of its document.
#[track_caller]
fn as_stored(path: &Path, options: &ReadOptions<'_>) -> SceneFile {
    let (content, source) = read_as_stored(path, options).unwrap();
    SceneFile { source: Some(source), ..SceneFile::new(content) }
}

/// An animation with one sampler a channel: (node, path, times, output, interpolation).
fn animation(b: &mut Builder, channels: &[(usize, &str, &[f32], usize, &str)]) -> Value {
    let samplers: Vec<Value> = channels
        .iter()
        .map(|(_, _, times, output, interpolation)| {
            let times: Vec<[f32; 1]> = times.iter().map(|t| [*t]).collect();
            json!({ "input": b.floats(&times), "output": output, "interpolation": interpolation })
        })
        .collect();
    let targets = channels.iter().enumerate();
    let targets: Vec<Value> = targets
        .map(|(i, (node, path, ..))| json!({ "sampler": i, "target": { "node": node, "path": path } }))
        .collect();
    json!({ "name": "nod", "samplers": samplers, "channels": targets })
}

#[test]
fn nodes_carry_meshes_by_every_interpolation() {
    let (mut b, attributes) = triangle();
    let slide = b.floats(&[[0.0f32, 0.0, 0.0], [2.0, 0.0, 0.0]]);
    let half = std::f32::consts::FRAC_1_SQRT_2;
    let turn = b.floats(&[[0.0f32, 0.0, 0.0, 1.0], [0.0, 0.0, half, half]]);
    // Cubic interpolation: with tangents 0, u = 1/4 gives 3u² − 2u³ = 5/32 of the way from 1 to 2.
    let grow = b.floats(&[[0.0f32; 3], [1.0; 3], [0.0; 3], [0.0; 3], [2.0; 3], [0.0; 3]]);
    let clip = animation(
        &mut b,
        &[
            (1, "translation", &[1.0, 3.0], slide, "LINEAR"),
            (0, "rotation", &[0.0, 2.0], turn, "STEP"),
            (1, "scale", &[0.0, 4.0], grow, "CUBICSPLINE"),
        ],
    );
    let document = json!({
        "meshes": [{ "primitives": [{ "attributes": attributes }] }],
        "nodes": [{ "children": [1] }, { "mesh": 0 }],
        "animations": [clip],
    });
    let file = File::new(&b, &document);
    let corners = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]];
    file.positions(-1.0, &corners);
    let s = 1.0 + 5.0 / 32.0;
    file.positions(1.0, &[[0.0; 3], [s, 0.0, 0.0], [0.0, s, 0.0]]);
    // At 2 s: scaled by 1.5, shifted by 1, then rotated by a quarter turn: (x, y) to (−y, x).
    file.positions(2.0, &[[0.0, 1.0, 0.0], [0.0, 2.5, 0.0], [-1.5, 1.0, 0.0]]);
    file.positions(9.0, &[[0.0, 2.0, 0.0], [0.0, 4.0, 0.0], [-2.0, 2.0, 0.0]]);
    assert!(file.rest().source.unwrap().moves());
    let summary = inspect(&file.path).unwrap();
    let clips = &summary.document.as_ref().unwrap().animations;
    assert_eq!(
        (clips.len(), clips[0].name.as_deref(), clips[0].range, clips[0].channels),
        (1, Some("nod"), [0.0, 4.0], 3)
    );
    assert!(summary.to_string().contains("├ animation: nod, 4.000 s, 3 channels"), "{summary}");
}

/// Rigid parts with one texture, each a mesh of its own, share its texels.
#[test]
fn what_moves_shares_its_maps() {
    let (mut b, attributes) = triangle();
    let slide = b.floats(&[[0.0f32, 0.0, 0.0], [2.0, 0.0, 0.0]]);
    let clip = animation(&mut b, &[(0, "translation", &[0.0, 1.0], slide, "LINEAR")]);
    let image = b.view(&black_png(4, 4));
    let document = json!({
        "meshes": [{ "primitives": [{ "attributes": attributes, "material": 0 }] }],
        "nodes": [{ "children": [1, 2, 3] }, { "mesh": 0 }, { "mesh": 0 }, { "mesh": 0 }],
        "materials": [{ "pbrMetallicRoughness": { "baseColorTexture": { "index": 0 } } }],
        "textures": [{ "source": 0 }],
        "images": [{ "bufferView": image, "mimeType": "image/png" }],
        "animations": [clip],
    });
    let file = File::new(&b, &document);
    for scene in [file.rest().scene, file.at(0.5).scene] {
        let texels: Vec<&[f32]> = scene.meshes.iter().map(|mesh| mesh.atlas().base().texels()).collect();
        assert_eq!((texels.len(), texels[0].len()), (3, 64));
        assert!(texels.iter().all(|of_mesh| std::ptr::eq(*of_mesh, texels[0])));
    }
}

#[test]
fn weights_and_joints_move_a_skin() {
    let (mut b, mut attributes) = triangle();
    let weights = [[1.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.5, 0.5, 0.0, 0.0]];
    b.skinned(&mut attributes, [[0, 0, 0, 0], [1, 0, 0, 0], [0, 1, 0, 0]], weights);
    let (up, out) = (b.floats(&[[0.0f32, 0.0, 1.0]; 3]), b.floats(&[[0.0f32; 3], [0.0; 3], [1.0, 0.0, 0.0]]));
    let mut bind = Mat4::IDENTITY;
    bind.w_axis.x = -1.0;
    let inverse = b.floats(&[bind.to_cols_array(), Mat4::IDENTITY.to_cols_array()]);
    // Two targets, three keys; the middle one at 1 s.
    let keys = b.floats(&[[0.0f32], [0.0], [1.0], [0.5], [1.0], [0.5]]);
    let half = std::f32::consts::FRAC_1_SQRT_2;
    let turn = b.floats(&[[0.0f32, 0.0, 0.0, 1.0], [0.0, 0.0, half, half]]);
    let clip = animation(
        &mut b,
        &[(0, "weights", &[0.0, 1.0, 2.0], keys, "LINEAR"), (2, "rotation", &[0.0, 1.0], turn, "LINEAR")],
    );
    let document = json!({
        "meshes": [{
            "primitives": [{ "attributes": attributes, "targets": [{ "POSITION": up }, { "POSITION": out }] }],
            "weights": [0.25, 0],
        }],
        "skins": [{ "joints": [1, 2], "inverseBindMatrices": inverse }],
        "nodes": [
            { "mesh": 0, "skin": 0, "translation": [100, 100, 100], "children": [1, 2] },
            { "translation": [-100, -100, -100] }, { "translation": [-100, -98, -100] },
        ],
        "animations": [clip],
    });
    let file = File::new(&b, &document);
    let rest = [[-1.0, 0.0, 0.25], [1.0, 2.0, 0.25], [-0.5, 2.0, 0.25]];
    near(bytemuck::cast_slice(file.rest().scene.meshes[0].positions()), rest.as_flattened(), 0.0);
    // At 0.5 s the weights are (0.5, 0.25), and joint 1 is rotated by 45°. Vertex 1 (1, 0, ½) rotates to (h, h, ½), and
    // moves up by 2; vertex 2 (¼, 1, ½) is at (−¾, 1, ½) by joint 0, and at (h/4 − h, h/4 + h + 2, ½) by joint 1.
    let h = half;
    let expected = [[-1.0, 0.0, 0.5], [h, h + 2.0, 0.5], [(-0.75 - 0.75 * h) / 2.0, (3.0 + 1.25 * h) / 2.0, 0.5]];
    file.positions(0.5, &expected);
    file.positions(1.5, &[[-1.0, 0.0, 1.0], [0.0, 3.0, 1.0], [(-0.5 - 1.0) / 2.0, (1.0 + 2.5) / 2.0, 1.0]]);
}

/// Also if vertices have no weight.
#[test]
fn joints_that_are_invisible_carry_what_is_not() {
    let (mut b, mut attributes) = triangle();
    b.skinned(&mut attributes, [[0; 4]; 3], [[1.0, 0.0, 0.0, 0.0], [0.0; 4], [0.0; 4]]);
    let up = b.floats(&[[0.0f32, 0.0, 1.0], [0.0, 0.0, 3.0]]);
    let clip = animation(&mut b, &[(1, "translation", &[0.0, 1.0], up, "LINEAR")]);
    let mut document = json!({
        "meshes": [{ "primitives": [{ "attributes": attributes }] }],
        "skins": [{ "joints": [1] }],
        "nodes": [
            { "mesh": 0, "skin": 0 },
            { "mesh": 0, "translation": [0, 0, 1], "extensions": { "KHR_node_visibility": { "visible": false } } },
        ],
        "scenes": [{ "nodes": [0, 1] }],
        "animations": [clip],
    });
    let file = File::new(&b, &document);
    let rest = file.rest();
    let said = "/WEIGHTS_0: 2 of 3 vertices have no weight: they follow their first joint";
    assert!(rest.notes.iter().any(|note| note.ends_with(said)), "{:?}", rest.notes);
    assert_eq!((rest.scene.meshes.len(), rest.scene.meshes[0].positions()[1]), (1, Vec3::new(1.0, 0.0, 1.0)));
    file.positions(1.0, &[[0.0, 0.0, 3.0], [1.0, 0.0, 3.0], [0.0, 1.0, 3.0]]);
    for bad in [f32::NAN, -1.0] {
        let weights = b.floats(&[[bad, 0.0, 0.0, 0.0]; 3]);
        document["meshes"][0]["primitives"][0]["attributes"]["WEIGHTS_0"] = json!(weights);
        let message = read_scene(&File::new(&b, &document).path).unwrap_err().to_string();
        assert!(message.contains("/WEIGHTS_0: expected WEIGHTS_0 that add up to 1, found "), "{message}");
    }
}

#[test]
fn translations_of_the_extension_come_after_morph_targets() {
    let (mut b, attributes) = triangle();
    let times = b.floats(&[[0.0f32], [1.0], [3.0]]);
    let mut all = [[0.0f32; 3]; 9];
    all[0] = [0.0, 0.0, 5.0];
    all[4] = [1.0, 0.0, 0.0];
    all[7] = [0.0, 4.0, 0.0];
    let translations = b.floats(&all);
    for (interpolation, moved) in [("LINEAR", [1.5, 1.0, 0.0]), ("STEP", [2.0, 0.0, 0.0])] {
        let own = json!({ "times": times, "translations": translations, "interpolation": interpolation });
        let document = json!({
            "meshes": [{ "primitives": [{ "attributes": attributes, "extensions": { HYBRID: own } }] }],
            "extensionsUsed": [HYBRID],
        });
        let file = File::new(&b, &document);
        assert_eq!(file.rest().source.unwrap().range(), [0.0, 3.0]);
        // No animation is played: the time is 0.
        assert_eq!(file.rest().scene.meshes[0].positions()[0], Vec3::new(0.0, 0.0, 5.0));
        let (a, b) = (file.at(1.0).scene, file.at(1.5).scene);
        assert_eq!(a.meshes[0].positions()[1], Vec3::new(2.0, 0.0, 0.0));
        let expected = if interpolation == "LINEAR" { [1.75, 1.0, 0.0] } else { moved };
        near(&b.meshes[0].positions()[1].to_array(), &expected, 1e-6);
    }
}

/// Accessors in every document of [`bound`] that are invalid in a binding: a VEC3 of integers, and a VEC4 of length ½.
pub(super) const INTEGERS: usize = 2;
pub(super) const HALF: usize = 3;

/// A splat on a triangle that rotates, and a splat at a node of its own; `harmonics` is the SH frame of the bound
/// splat.
pub(super) fn bound(harmonics: &str, damage: impl Fn(&mut Value)) -> File {
    let (mut b, attributes) = triangle();
    let unfit = [b.accessor(5123, "VEC3", 1, &[0; 8]), b.floats(&[[0.0f32, 0.0, 0.0, 0.5]])];
    assert_eq!(unfit, [INTEGERS, HALF]);
    let half = std::f32::consts::FRAC_1_SQRT_2;
    let turn = b.floats(&[[0.0f32, 0.0, 0.0, 1.0], [0.0, 0.0, half, half]]);
    let lift = b.floats(&[[0.0f32, 0.0, 0.0], [0.0, 0.0, 2.0]]);
    let mut splats = |means: &[[f32; 3]]| {
        let n = means.len();
        let mut splats = json!({
            "POSITION": b.floats(means),
            format!("{KHR_SPLATS}:ROTATION"): b.floats(&vec![[0.0f32, 0.0, 0.0, 1.0]; n]),
            format!("{KHR_SPLATS}:SCALE"): b.floats(&vec![[0.1f32, 0.2, 0.3]; n]),
            format!("{KHR_SPLATS}:OPACITY"): b.floats(&vec![[0.7f32]; n]),
        });
        for (l, m) in [(0, 0), (1, 0), (1, 1), (1, 2)] {
            let values = vec![[0.1 + l as f32, 0.2 * m as f32, -0.3]; n];
            splats[format!("{KHR_SPLATS}:SH_DEGREE_{l}_COEF_{m}")] = json!(b.floats(&values));
        }
        splats
    };
    // The triangle's frame has the columns x, z, −y, k = 1 and c = (1/3, 1/3, 0). The splat is 0.5 above it.
    let attached = splats(&[[1.0 / 3.0, 1.0 / 3.0, 0.5]]);
    let free = splats(&[[1.0, 0.0, 0.0]]);
    // Orientation of the splat in that frame: q(R)⁻¹, a quarter turn about x.
    let binding = json!({
        "node": 0, "triangleCount": 1,
        "geometryDigest": geometry_digest(&[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
        "triangles": b.accessor(5125, "SCALAR", 1, &[0; 4]),
        "translations": b.floats(&[[0.0f32, 0.5, 0.0]]),
        "rotations": b.floats(&[[-half, 0.0, 0.0, half]]),
        "scales": b.floats(&[[0.1f32, 0.2, 0.3]]),
        "sphericalHarmonicsFrame": harmonics,
    });
    let clip = animation(
        &mut b,
        &[(0, "rotation", &[0.0, 1.0], turn, "LINEAR"), (2, "translation", &[0.0, 1.0], lift, "LINEAR")],
    );
    let khr = |extensions: Value| {
        let space = "srgb_rec709_display";
        json!({ KHR_SPLATS: { "kernel": "ellipse", "colorSpace": space, "extensions": extensions } })
    };
    let primitive = |attributes: &Value, extensions: Value| json!({ "primitives": [{ "mode": 0, "attributes": attributes, "extensions": khr(extensions) }] });
    let mut document = json!({
        "meshes": [
            { "primitives": [{ "attributes": attributes }] },
            primitive(&attached, json!({ HYBRID: { "binding": binding } })),
            primitive(&free, json!({})),
        ],
        "scenes": [{ "nodes": [0, 1, 2] }],
        "nodes": [{ "mesh": 0 }, { "mesh": 1 }, { "mesh": 2 }],
        "animations": [clip],
        "extensionsUsed": [KHR_SPLATS, HYBRID],
    });
    damage(&mut document);
    File::new(&b, &document)
}

#[test]
fn cameras_are_where_they_are_at_the_time() {
    let file = bound("node", |document| {
        document["cameras"] = json!([{ "type": "perspective", "perspective": { "yfov": 1, "znear": 0.1 } }]);
        document["nodes"][2]["camera"] = json!(0);
    });
    let at = |time: f64| file.at(time).cameras[0].1.center();
    assert!(at(0.5).abs_diff_eq(DVec3::new(0.0, 0.0, 1.0), 1e-9) && at(7.0).abs_diff_eq(DVec3::Z * 2.0, 1e-9));
    let source = file.rest().source.unwrap();
    let still = source.cameras(&file.path, &Sampling { time: Some(0.5), ..Sampling::default() }).unwrap();
    assert_eq!((still.cameras.len(), still.fps, &still.times[..]), (1, None, &[][..]));
    assert!(still.cameras[0].1.center().abs_diff_eq(DVec3::Z, 1e-9));
    let shot = source.cameras(&file.path, &Sampling { fps: Some(4.0), ..Sampling::default() }).unwrap();
    assert_eq!(shot.times, [0.0, 0.25, 0.5, 0.75, 1.0]);
}

#[test]
fn what_is_stopped_has_its_cameras_where_they_are() {
    let file = bound("node", |document| {
        document["cameras"] = json!([{ "type": "perspective", "perspective": { "yfov": 1, "znear": 0.1 } }]);
        document["nodes"][2]["camera"] = json!(0);
    });
    let source = file.at(0.5).source.unwrap();
    for time in [None, Some(0.9)] {
        let shot = source.cameras(&file.path, &Sampling { time, ..Sampling::default() }).unwrap();
        assert_eq!((shot.cameras.len(), shot.times.len()), (1, 0));
        assert!(shot.cameras[0].1.center().abs_diff_eq(DVec3::Z, 1e-9), "{}", shot.cameras[0].1.center());
    }
}

#[test]
fn bones_are_of_what_moves_and_have_the_names_of_nodes() {
    let file = bound("node", |document| {
        // The second splat does not move, and neither does another triangle.
        document["animations"][0]["channels"].as_array_mut().unwrap().pop();
        document["nodes"].as_array_mut().unwrap().push(json!({ "mesh": 0, "name": "still" }));
        document["scenes"][0]["nodes"] = json!([3, 0, 1, 2]);
        document["nodes"][0]["name"] = json!("arm");
    });
    let rest = file.rest();
    let source = rest.source.unwrap();
    let (moving, _) = source.moving(&rest.scene).unwrap();
    let rig = moving.rig().unwrap();
    // The bone of the triangle, and the bone of the splats, with whose frame their harmonics would rotate.
    assert_eq!(rig.bone_names(), ["arm", "node 1"]);
    assert_eq!((rig.attached().len(), rig.rest().weights.len()), (1, 0));
    file.at(1.0);
}

#[test]
fn joints_end_where_the_scene_ends() {
    let (mut b, mut attributes) = triangle();
    b.skinned(&mut attributes, [[0, 1, 0, 0], [1, 0, 0, 0], [0, 1, 0, 0]], [[0.5, 0.5, 0.0, 0.0]; 3]);
    let half = std::f32::consts::FRAC_1_SQRT_2;
    let turn = b.floats(&[[0.0f32, 0.0, 0.0, 1.0], [0.0, 0.0, half, half]]);
    let clip = animation(&mut b, &[(2, "rotation", &[0.0, 1.0], turn, "LINEAR")]);
    let document = json!({
        "meshes": [{ "primitives": [{ "attributes": attributes }] }],
        "skins": [{ "joints": [1, 2] }],
        "scenes": [{ "nodes": [0] }],
        // Nodes 3 and 4 are in no scene, and each is a child of the other.
        "nodes": [{ "mesh": 0, "skin": 0, "children": [1] }, { "children": [2] }, {}, { "children": [0, 4] }, { "children": [3] }],
        "animations": [clip],
    });
    let rest = File::new(&b, &document).rest();
    let source = rest.source.unwrap();
    let (moving, _) = source.moving(&rest.scene).unwrap();
    assert_eq!(moving.bone_parents(), [None, Some(0)]);
}

#[test]
fn animations_that_are_broken_are_left_out_unless_a_time_is_asked_for() {
    let broken = |damage: &dyn Fn(&mut Value)| {
        let file = bound("node", |document| damage(&mut document["animations"][0]));
        let rest = file.rest();
        let options = ReadOptions { time: Some(0.5), ..ReadOptions::default() };
        let error = read_file(&file.path, &options).unwrap_err().to_string();
        assert!(read_cameras(&file.path, &Sampling::default()).is_err());
        // The other channel still moves, and evaluation fails with the place of the broken one.
        let source = rest.source.unwrap();
        assert!(source.moves() && source.at(&rest.scene, 0.5).unwrap_err().to_string().starts_with("at 0.5 s: /"));
        let note = rest.notes.iter().find(|note| note.contains("not played")).unwrap().clone();
        (note, error)
    };
    let (note, error) = broken(&|clip| clip["samplers"][0]["interpolation"] = json!("CUBICSPLINE"));
    assert_eq!(note, "/animations/0/channels/0: not played: expected 6 times 4 numbers, found 8");
    assert!(error.ends_with("/animations/0/channels/0: expected 6 times 4 numbers, found 8"), "{error}");
    let (note, _) = broken(&|clip| clip["channels"][0]["target"]["path"] = json!("weights"));
    assert!(note.contains("/accessors/"), "{note}");
}

#[test]
fn weights_are_as_many_as_targets_and_times_grow() {
    let (mut b, attributes) = triangle();
    let up = b.floats(&[[0.0f32, 0.0, 1.0]; 3]);
    let two = b.floats(&[[0.0f32], [0.0], [1.0], [1.0]]);
    let clip = animation(&mut b, &[(0, "weights", &[0.0, 1.0], two, "LINEAR")]);
    let late = animation(&mut b, &[(0, "translation", &[0.0, 2.5, 2.0], up, "LINEAR")]);
    let first = animation(&mut b, &[(0, "scale", &[0.0, 1.0, 2.0], up, "LINEAR")]);
    let document = json!({
        "meshes": [{ "primitives": [{ "attributes": attributes, "targets": [{ "POSITION": up }] }] }],
        "nodes": [{ "mesh": 0 }],
        "animations": [clip, late, first, first],
    });
    let file = File::new(&b, &document).rest();
    assert_eq!(file.notes[0], "/animations/0/channels/0: not played, and 1 more: expected 2 times 1 numbers, found 4");
    assert!(!file.notes.iter().any(|note| note.contains("before them")), "{:?}", file.notes);
    // Notes for playing the animations.
    let said = file.source.unwrap().played([0.0, 5.0]);
    let several = "/animations: 1 of 2 move something that an earlier one moves: there the earlier one is played; --animation selects one";
    assert_eq!(said, [several, "/animations: last from 0.000 to 2.000 s: outside, the scene is as at the nearer end"]);
    let document = json!({
        "meshes": [{ "primitives": [{ "attributes": attributes }] }], "nodes": [{ "mesh": 0 }], "animations": [late],
    });
    let notes = File::new(&b, &document).rest().notes;
    assert!(notes[0].ends_with("not played: expected key times that grow, found 2 after 2.5"), "{}", notes[0]);
}

#[test]
fn a_quaternion_of_zeros_turns_nothing() {
    let (mut b, attributes) = triangle();
    for interpolation in ["STEP", "LINEAR"] {
        let turn = b.floats(&[[0.0f32; 4], [0.0; 4]]);
        let clip = animation(&mut b, &[(0, "rotation", &[0.0, 1.0], turn, interpolation)]);
        let document = json!({
            "meshes": [{ "primitives": [{ "attributes": attributes }] }],
            "nodes": [{ "mesh": 0, "rotation": [0, 0, 1, 0] }], "animations": [clip],
        });
        for time in [0.0, 0.5, 1.0] {
            File::new(&b, &document).positions(time, &[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]);
        }
    }
}

#[test]
fn what_does_not_move_says_so() {
    let file = bound("node", |document| {
        document.as_object_mut().unwrap().remove("animations");
    });
    assert!(
        file.at(2.0).notes.contains(&"/animations: there are none: at 2 s the scene is in its rest pose".to_owned())
    );
}

#[test]
fn a_pose_is_no_document() {
    let file = bound("triangle", |_| ());
    let posed = file.at(0.5);
    let source = posed.source.as_ref().unwrap();
    assert!(!source.moves() && !source.stands(&posed.scene, &posed.cameras));
    let out = file.path.with_file_name("out.glb");
    let options = WriteOptions { cameras: &posed.cameras, source: Some(source), ..WriteOptions::default() };
    let report = write_scene(&out, &posed.scene, &options).unwrap();
    // In a pose that was asked for, the animation is not counted as a loss.
    assert!(report.loss.is_rounding(), "{}", report.loss);
    let back = read_file(&out, &ReadOptions::default()).unwrap();
    assert!(!back.source.unwrap().moves());
    assert_eq!(back.scene.splats.means().len(), 2);
    // As it rests it goes on as it was, animation and all.
    let mut rest = as_stored(&file.path, &ReadOptions { keep_document: true, ..ReadOptions::default() });
    // Half a turn about x to the frame that scenes are written in, and larger on the way.
    let turn = Similarity::new(2.0, DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0)), DVec3::ZERO).unwrap();
    let mut source = rest.source.take().unwrap();
    let moved = turn.scene(rest.scene).unwrap();
    source.follow(turn.matrix(), &moved, &rest.cameras);
    let options = WriteOptions { source: Some(&source), ..WriteOptions::default() };
    let report = write_scene(&out, &moved, &options).unwrap();
    assert!(report.loss.is_none(), "{}", report.loss);
    let time = ReadOptions { time: Some(0.5), ..ReadOptions::default() };
    let back = as_stored(&out, &time).scene;
    let larger = Similarity::new(2.0, DMat3::IDENTITY, DVec3::ZERO).unwrap().scene(posed.scene).unwrap();
    near(bytemuck::cast_slice(back.splats.means()), bytemuck::cast_slice(larger.splats.means()), 1e-6);
    near(back.splats.sh().as_flattened(), larger.splats.sh().as_flattened(), 1e-6);
    near(bytemuck::cast_slice(back.splats.log_scales()), bytemuck::cast_slice(larger.splats.log_scales()), 1e-6);
    // The document can also be evaluated for the transformed scene.
    let posed = source.at(&moved, 0.5).unwrap();
    let upright = Similarity::new(1.0, DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0)), DVec3::ZERO).unwrap();
    let posed = upright.scene(posed).unwrap().splats;
    near(bytemuck::cast_slice(posed.means()), bytemuck::cast_slice(larger.splats.means()), 1e-6);
    near(posed.sh().as_flattened(), larger.splats.sh().as_flattened(), 1e-6);
}

/// A node that is scaled to zero, if only along an axis, flattens what is below.
#[test]
fn splats_are_hidden_while_they_are_flat() {
    let flattened = bound("node", |document| {
        document["animations"][0]["channels"][1]["target"]["path"] = json!("scale");
    });
    assert_eq!(flattened.at(0.5).scene.splats.opacity_logits()[1], HIDDEN);
    // As they rest, too.
    for flat in [[0.0f32; 3], [1.0, 0.0, 1.0]] {
        let (mut b, attributes) = splats(false);
        let grow = b.floats(&[flat, [2.0; 3]]);
        let clip = animation(&mut b, &[(1, "scale", &[0.0, 1.0], grow, "LINEAR")]);
        let mut document = splat_document(&attributes, khr());
        document["nodes"] = json!([
            { "translation": [0, 0, 5], "children": [1] }, { "scale": flat, "children": [2] }, { "mesh": 0, "translation": [1, 0, 0] },
        ]);
        document["animations"] = json!([clip]);
        let file = File::new(&b, &document);
        let rest = file.rest();
        assert_eq!(rest.notes, ["/nodes/2: splats under a flat transform are not drawn in the rest pose"]);
        assert_eq!(rest.scene.splats.opacity_logits(), [HIDDEN; 2]);
        assert_eq!(file.at(0.0).scene, rest.scene);
        let shown = file.at(1.0).scene.splats;
        near(bytemuck::cast_slice(shown.means()), &[2.0, 0.0, 5.0, 4.0, 4.0, 11.0], 1e-6);
        near(&[shown.log_scales()[0].x.exp()], &[2.0], 1e-6);
        // A script of Blender hides them itself.
        let script = file.path.with_file_name("a.blend.py");
        let options = WriteOptions { source: rest.source.as_ref(), ..WriteOptions::default() };
        write_scene(&script, &rest.scene, &options).unwrap();
        let beside = read_scene(&script.with_file_name("a_splats.ply")).unwrap();
        assert_eq!(beside.splats.opacity_logits(), shown.opacity_logits());
    }
}

/// Triangles replace the transform of the node of splats, even where it is flat: as they rest, and whether or not that
/// node moves.
#[test]
fn bound_splats_below_flat_nodes_are_on_their_triangle() {
    let flat = |document: &mut Value| document["nodes"][1]["scale"] = json!([0, 0, 0]);
    for harmonics in ["node", "triangle"] {
        let (file, regular) = (bound(harmonics, flat), bound(harmonics, |_| ()));
        let rest = file.rest();
        assert!(!rest.notes.iter().any(|note| note.contains("not drawn")), "{:?}", rest.notes);
        assert_eq!(file.at(0.0).scene, rest.scene);
        for time in [0.0, 1.0] {
            let [found, expected] = [&file, &regular].map(|file| file.at(time).scene.splats);
            near(bytemuck::cast_slice(found.means()), bytemuck::cast_slice(expected.means()), 1e-6);
            near(bytemuck::cast_slice(found.log_scales()), bytemuck::cast_slice(expected.log_scales()), 1e-6);
            near(found.sh().as_flattened(), expected.sh().as_flattened(), 3e-6);
            assert_eq!(found.opacity_logits(), expected.opacity_logits());
        }
        let still = bound(harmonics, |document| {
            flat(document);
            document.as_object_mut().unwrap().remove("animations");
        });
        assert_eq!(still.rest().scene.splats, rest.scene.splats);
    }
    let not_drawn = "/nodes/1: splats under a flat transform are not drawn".to_owned();
    // Nor are they drawn if their triangles are flat, too.
    let file = bound("node", |document| {
        flat(document);
        document["nodes"][0]["scale"] = json!([0, 0, 0]);
        document.as_object_mut().unwrap().remove("animations");
    });
    let rest = file.rest();
    assert!(rest.notes.contains(&not_drawn), "{:?}", rest.notes);
    assert_eq!(rest.scene.splats.len() + 1, bound("node", |_| ()).rest().scene.splats.len());
    // Where the binding does not hold, they have no place, and others follow their bones as ever.
    let file = bound("node", |document| {
        flat(document);
        let khr = &mut document["meshes"][1]["primitives"][0]["extensions"][KHR_SPLATS];
        khr["extensions"][HYBRID]["binding"]["triangleCount"] = json!(7);
    });
    let notes = file.rest().notes;
    assert!(notes.contains(&not_drawn), "{notes:?}");
    near(bytemuck::cast_slice(file.at(1.0).scene.splats.means()), &[1.0, 0.0, 2.0], 1e-6);
}

/// Also where an animation makes the transform another than at rest.
#[test]
fn bound_splats_that_rest_flat_appear_on_their_triangle() {
    let file = bound("node", |document| {
        document["nodes"][1]["scale"] = json!([0, 0, 0]);
        // One key, of numbers that are there for something else.
        let of =
            |name: &str| document["meshes"][2]["primitives"][0]["attributes"][format!("{KHR_SPLATS}:{name}")].clone();
        let sampler = json!({ "input": of("OPACITY"), "output": of("SCALE") });
        let clip = &mut document["animations"][0];
        clip["samplers"][1] = sampler;
        clip["channels"][1]["target"] = json!({ "node": 1, "path": "scale" });
    });
    let still = bound("node", |_| ());
    let at = |file: &File, time: Option<f64>| time.map_or_else(|| file.rest(), |time| file.at(time)).scene.splats;
    for time in [None, Some(0.0), Some(1.0)] {
        let [found, expected] = [&file, &still].map(|file| at(file, time));
        near(&found.means()[0].to_array(), &expected.means()[0].to_array(), 1e-6);
        assert_eq!(found.opacity_logits()[0], expected.opacity_logits()[0]);
    }
}

#[test]
fn what_cannot_be_shown_says_when() {
    let file = bound("node", |_| ());
    let rest = file.rest();
    let source = rest.source.unwrap();
    let other = bound("node", |_| ()).rest().scene;
    assert!(source.at(&other, 1.0).is_ok());
    let fewer = HybridScene { meshes: vec![], ..other };
    let error = source.at(&fewer, 1.25).unwrap_err().to_string();
    assert_eq!(error, "at 1.25 s: meshes: expected 1 elements, found 0");
    let rest = file.rest();
    let ply = file.path.with_file_name("a.ply");
    write_scene(&ply, &rest.scene, &WriteOptions::default()).unwrap();
    let error = read_file(&ply, &ReadOptions { time: Some(1.0), ..ReadOptions::default() }).unwrap_err().to_string();
    assert!(
        error.ends_with("expected a .glb or .gltf, whose animations can be evaluated at a time, found PLY"),
        "{error}"
    );
}
