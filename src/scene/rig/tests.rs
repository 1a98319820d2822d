#![allow(clippy::unwrap_used, reason = "a failed unwrap is a failed test")]

use glam::Vec2;

use super::*;
use crate::scene::placement::place;
use crate::scene::{Atlas, Composition, Splats, Texture, sh};

fn mesh(positions: &[Vec3], degree: u32) -> Mesh {
    let base = Texture::new(1, 1, 4, vec![0.1, 0.2, 0.3, 0.4]).unwrap();
    let channels = sh::band_floats(degree) as u32;
    let bands = (degree > 0)
        .then(|| Texture::new(1, 1, channels, (0..channels).map(|c| 0.1 * c as f32 - 0.3).collect()).unwrap());
    let triangles: Vec<[u32; 3]> = (2..positions.len() as u32).map(|v| [0, v - 1, v]).collect();
    let uvs = vec![[Vec2::ZERO; 3]; triangles.len()];
    Mesh::new(positions.to_vec(), triangles, uvs, Atlas::new(base, bands).unwrap()).unwrap()
}

fn one_splat(mean: Vec3, rotation: Quat, scale: f32) -> Splats {
    let harmonics = (0..16).map(|k| [0.1 * k as f32 - 0.7, 0.3, 0.05 * k as f32]).collect();
    let log_scale = Vec3::new(scale, 2.0 * scale, 0.5 * scale).map(f32::ln);
    Splats::new(vec![mean], vec![rotation], vec![log_scale], vec![1.5], 3, harmonics).unwrap()
}

fn scene(splats: Splats, meshes: Vec<Mesh>) -> HybridScene {
    HybridScene { splats, meshes, composition: Composition::default() }
}

fn similarity_of(scale: f64, rotation: DQuat, translation: DVec3) -> DMat4 {
    DMat4::from_scale_rotation_translation(DVec3::splat(scale), rotation, translation)
}

fn names(pose: &Pose) -> Vec<String> {
    (0..pose.bones.len()).map(|i| format!("joint {i}")).collect()
}

const CORNERS: [Vec3; 3] = [Vec3::ZERO, Vec3::X, Vec3::new(0.25, 0.5, 0.0)];

/// A triangle with a splat on it; both have one bone and one morph target.
fn bound(harmonics: ShFrame) -> (HybridScene, Rig) {
    let frame = Frame::of(CORNERS.map(Vec3::as_dvec3)).unwrap();
    let (translation, rotation, scale) =
        (Vec3::new(0.1, 0.3, -0.2), Quat::from_euler(glam::EulerRot::XYZ, 0.3, -0.5, 1.1), 0.2);
    let mean = (frame.size * (frame.axes * translation.as_dvec3()) + frame.center).as_vec3();
    let placed = (DQuat::from_mat3(&frame.axes) * rotation.as_dquat()).as_quat();
    let splats = one_splat(mean, placed, scale * frame.size as f32);
    let binding = Binding {
        surface: 0,
        corners: vec![[0, 1, 2]],
        translations: vec![translation],
        rotations: vec![rotation],
        scales: vec![Vec3::new(1.0, 2.0, 0.5) * scale],
        harmonics,
    };
    let rest_surface = RestSurface {
        base: CORNERS.to_vec(),
        targets: vec![MorphTarget { weight: 0, deltas: vec![Vec3::ZERO, Vec3::ZERO, Vec3::Y] }],
        skinning: Skinning::Bone(0),
    };
    let rest = Pose { bones: vec![DMat4::IDENTITY; 2], weights: vec![0.0] };
    let attached = vec![AttachedSplats { splats: 0..1, anchor: Anchor::Triangles(binding), hidden: None }];
    (
        scene(splats, vec![mesh(&CORNERS, 0)]),
        Rig::new(vec![Some(rest_surface)], attached, rest.clone(), names(&rest)).unwrap(),
    )
}

#[track_caller]
fn near(a: impl Into<DVec3>, b: impl Into<DVec3>, tolerance: f64) {
    let (a, b) = (a.into(), b.into());
    assert!(a.abs_diff_eq(b, tolerance), "{a}, expected {b}");
}

/// Asserts that splats are equal by means, covariances and colours.
#[track_caller]
fn same_splats(a: &Splats, b: &Splats, tolerance: f32) {
    for i in 0..a.len() {
        near(a.means()[i].as_dvec3(), b.means()[i].as_dvec3(), f64::from(tolerance));
        near(a.log_scales()[i].as_dvec3(), b.log_scales()[i].as_dvec3(), f64::from(tolerance));
        assert!(a.rotations()[i].dot(b.rotations()[i]).abs() > 1.0 - tolerance * tolerance - 1e-6);
        for (x, y) in a.sh_of(i).iter().flatten().zip(b.sh_of(i).iter().flatten()) {
            assert!((x - y).abs() <= tolerance, "{x} {y}");
        }
    }
}

#[test]
fn a_triangles_frame_is_that_of_the_extension() {
    // The example in the extension's specification.
    let frame = Frame::of(CORNERS.map(Vec3::as_dvec3)).unwrap();
    assert_eq!(frame.axes, DMat3::from_cols(DVec3::X, DVec3::Z, DVec3::NEG_Y));
    assert_eq!(frame.size, 0.75);
    near(frame.center, DVec3::new(0.416_666_667, 0.166_666_667, 0.0), 1e-9);
    assert_eq!(Frame::of([DVec3::ZERO, DVec3::ZERO, DVec3::Y]), None);
    assert_eq!(Frame::of([DVec3::ZERO, DVec3::X, DVec3::X * 3.0]), None);
}

#[test]
fn skins_blend_linearly_after_morph_targets() {
    let rest_surface = RestSurface {
        base: vec![Vec3::new(1.0, 0.0, 0.0), Vec3::new(0.0, 2.0, 0.0)],
        targets: vec![
            MorphTarget { weight: 1, deltas: vec![Vec3::Z, Vec3::Z] },
            MorphTarget { weight: 0, deltas: vec![Vec3::X, Vec3::ZERO] },
        ],
        // Weights need not add up to 1; the bone of a zero weight is ignored.
        skinning: Skinning::Skin { width: 2, bones: vec![0, 1, 1, 0], weights: vec![0.5, 1.5, 0.25, 0.0] },
    };
    let turn = similarity_of(2.0, DQuat::from_rotation_z(std::f64::consts::FRAC_PI_2), DVec3::new(0.0, 0.0, 1.0));
    let pose = Pose { bones: vec![DMat4::from_translation(DVec3::new(0.0, 4.0, 0.0)), turn], weights: vec![3.0, 0.5] };
    // Vertex 0 is (1 + 3, 0, 0.5); bone 0 moves it to (4, 4, 0.5), and bone 1 to (0, 8, 2): weighted by a quarter and
    // three quarters. Vertex 1 is (0, 2, 0.5), moved to (−4, 0, 2).
    let found = rest_surface.positions(&pose);
    near(found[0].as_dvec3(), DVec3::new(1.0, 7.0, 1.625), 1e-6);
    near(found[1].as_dvec3(), DVec3::new(-4.0, 0.0, 2.0), 1e-6);
    let gathered = rest_surface.gather(&[1, 1, 0]).positions(&pose);
    assert_eq!(gathered, [found[1], found[1], found[0]]);
}

#[test]
fn what_rests_keeps_its_bits() {
    let (rest, rig) = bound(ShFrame::Triangles(vec![DQuat::IDENTITY]));
    assert_eq!(rig.pose(&rest, rig.rest(), DMat4::IDENTITY).unwrap(), rest);
    // Also if the scene as a whole has been transformed.
    let moved = similarity_of(1.7, DQuat::from_rotation_x(0.3), DVec3::ONE);
    assert_eq!(rig.pose(&rest, rig.rest(), moved).unwrap(), rest);
}

#[test]
fn bound_splats_move_as_their_triangle_does() {
    let frame = Frame::of(CORNERS.map(Vec3::as_dvec3)).unwrap();
    let undeformed = vec![DQuat::from_mat3(&frame.axes.transpose())];
    let (rest, rig) = bound(ShFrame::Triangles(undeformed));
    let transform = similarity_of(1.9, DQuat::from_euler(glam::EulerRot::YXZ, 2.0, 0.4, -0.8), DVec3::new(3., -1., 2.));
    let pose = Pose { bones: vec![transform, DMat4::IDENTITY], weights: vec![0.0] };
    let posed = rig.pose(&rest, &pose, DMat4::IDENTITY).unwrap();
    // All of it, as if the scene had been transformed.
    let mut expected = rest.splats.clone().into_arrays();
    assert!(place(&mut expected, 0..1, transform));
    same_splats(&posed.splats, &expected.check().unwrap(), 3e-6);
    near(posed.meshes[0].positions()[1].as_dvec3(), transform.transform_point3(DVec3::X), 1e-6);

    // A target that raises a corner stretches the frame: by hand, v₂ = (0.25, 1.5, 0), k = (1 + 1.5)/2.
    let pose = Pose { weights: vec![1.0], ..rig.rest().clone() };
    let posed = rig.pose(&rest, &pose, DMat4::IDENTITY).unwrap();
    // R·t = (0.1, 0.2, 0.3), for columns x, z, −y; c = (1.25, 1.5, 0)/3.
    near(posed.splats.means()[0].as_dvec3(), DVec3::new(0.125 + 1.25 / 3.0, 0.25 + 0.5, 0.375), 1e-6);
    let scales = Vec3::new(1.0, 2.0, 0.5) * 0.2 * 1.25;
    near(posed.splats.log_scales()[0].as_dvec3(), scales.map(f32::ln).as_dvec3(), 1e-6);
    // The frame has not rotated, so orientation and colours stay.
    assert!(posed.splats.rotations()[0].dot(rest.splats.rotations()[0]).abs() > 1.0 - 1e-6);
    for (a, b) in posed.splats.sh().iter().flatten().zip(rest.splats.sh().iter().flatten()) {
        assert!((a - b).abs() < 1e-6);
    }
}

#[test]
fn harmonics_turn_with_what_they_are_said_to() {
    // With harmonics in the frame of a fixed bone, colours stay, however the triangle moves.
    let (rest, rig) = bound(ShFrame::Bone(1));
    let turn = DMat4::from_quat(DQuat::from_rotation_y(1.0));
    let posed = rig.pose(&rest, &Pose { bones: vec![turn, DMat4::IDENTITY], weights: vec![0.0] }, DMat4::IDENTITY);
    assert_eq!(posed.unwrap().splats.sh(), rest.splats.sh());
    // With a rotating bone colours rotate, even if the triangle does not move.
    let posed = rig.pose(&rest, &Pose { bones: vec![DMat4::IDENTITY, turn], weights: vec![0.0] }, DMat4::IDENTITY);
    let posed = posed.unwrap().splats;
    let mut expected = rest.splats.sh().to_vec();
    sh::Rotation::new(DMat3::from_rotation_y(1.0)).apply(&mut expected[1..]);
    for (a, b) in posed.sh().iter().flatten().zip(expected.iter().flatten()) {
        assert!((a - b).abs() < 1e-6);
    }
    assert_eq!((posed.means(), posed.rotations()), (rest.splats.means(), rest.splats.rotations()));
}

#[test]
fn a_scene_that_was_moved_is_posed_where_it_is() {
    let moved = similarity_of(0.4, DQuat::from_euler(glam::EulerRot::YXZ, -1.0, 0.7, 0.2), DVec3::new(-5.0, 1.0, 0.3));
    let bone = similarity_of(1.2, DQuat::from_rotation_x(1.4), DVec3::new(0.5, 0.0, 1.0));
    let pose = Pose { bones: vec![bone, DMat4::from_quat(DQuat::from_rotation_z(0.6))], weights: vec![0.7] };
    let frame = Frame::of(CORNERS.map(Vec3::as_dvec3)).unwrap();
    let by = |rest: &HybridScene| {
        let mut splats = rest.splats.clone().into_arrays();
        assert!(place(&mut splats, 0..1, moved));
        let positions: Vec<Vec3> =
            rest.meshes[0].positions().iter().map(|p| moved.transform_point3(p.as_dvec3()).as_vec3()).collect();
        scene(splats.check().unwrap(), vec![mesh(&positions, 0)])
    };
    for harmonics in [ShFrame::Bone(1), ShFrame::Triangles(vec![DQuat::from_mat3(&frame.axes.transpose())])] {
        let (rest, rig) = bound(harmonics);
        let then_moved = by(&rig.pose(&rest, &pose, DMat4::IDENTITY).unwrap());
        let then_posed = rig.pose(&by(&rest), &pose, moved).unwrap();
        same_splats(&then_moved.splats, &then_posed.splats, 5e-6);
        for (a, b) in then_moved.meshes[0].positions().iter().zip(then_posed.meshes[0].positions()) {
            near(a.as_dvec3(), b.as_dvec3(), 2e-6);
        }
    }
}

#[test]
fn splats_on_a_bone_and_maps_turn_with_it() {
    let splats = one_splat(Vec3::new(1.0, 2.0, 3.0), Quat::from_rotation_x(0.2), 0.3);
    let rest_bone = similarity_of(2.0, DQuat::from_rotation_z(0.3), DVec3::X);
    let rest_surface = RestSurface { base: CORNERS.to_vec(), targets: vec![], skinning: Skinning::Bone(0) };
    let rest = Pose { bones: vec![rest_bone], weights: vec![] };
    let scene = scene(splats, vec![mesh(&rest_surface.positions(&rest), 2)]);
    let attached = vec![AttachedSplats { splats: 0..1, anchor: Anchor::Bone(0), hidden: None }];
    let rig = Rig::new(vec![Some(rest_surface)], attached, rest.clone(), names(&rest)).unwrap();
    let by = similarity_of(0.5, DQuat::from_rotation_y(0.9), DVec3::Z);
    let posed = rig.pose(&scene, &Pose { bones: vec![by * rest_bone], weights: vec![] }, DMat4::IDENTITY).unwrap();
    let mut expected = scene.splats.clone().into_arrays();
    assert!(place(&mut expected, 0..1, by));
    same_splats(&posed.splats, &expected.check().unwrap(), 2e-6);
    let expected = turned(scene.meshes[0].atlas(), DMat3::from_rotation_y(0.9)).unwrap();
    let texels = |atlas: &Atlas| atlas.bands().unwrap().texels().to_vec();
    for (a, b) in texels(posed.meshes[0].atlas()).iter().zip(texels(&expected)) {
        assert!((a - b).abs() < 1e-6);
    }
    // Stretched splats are still ellipsoids, and maps stay as they are; scaled to zero, they vanish.
    let nothing = Pose { bones: vec![DMat4::from_scale(DVec3::splat(0.0))], weights: vec![] };
    let stretch = DMat4::from_scale(DVec3::new(1.0, 1.0, 2.0));
    let stretched = Pose { bones: vec![stretch * rest_bone], weights: vec![] };
    let posed = rig.pose(&scene, &stretched, DMat4::IDENTITY).unwrap();
    let mut expected = scene.splats.clone().into_arrays();
    assert!(place(&mut expected, 0..1, stretch));
    same_splats(&posed.splats, &expected.check().unwrap(), 2e-6);
    for (a, b) in texels(posed.meshes[0].atlas()).iter().zip(texels(scene.meshes[0].atlas())) {
        assert!((a - b).abs() < 1e-6);
    }
    let hidden = Rig::new(vec![None], rig.attached().to_vec(), rig.rest().clone(), names(rig.rest())).unwrap();
    assert_eq!(hidden.pose(&scene, &nothing, DMat4::IDENTITY).unwrap().splats.opacity_logits(), [HIDDEN]);
    // Meshes vanish too.
    let only_mesh = Rig::new(rig.surfaces().to_vec(), vec![], rig.rest().clone(), names(rig.rest())).unwrap();
    let gone = only_mesh.pose(&scene, &nothing, DMat4::IDENTITY).unwrap();
    assert!(gone.meshes[0].positions().iter().all(|p| *p == Vec3::ZERO) && gone.splats == scene.splats);
    // Scaled to a plane, a splat is not representable, and view dependence has no rotation.
    let flat = DMat4::from_translation(DVec3::Y) * DMat4::from_scale(DVec3::new(1.0, 0.0, 1.0));
    let plane = Pose { bones: vec![flat], weights: vec![] };
    assert_eq!(hidden.pose(&scene, &plane, DMat4::IDENTITY).unwrap().splats.opacity_logits(), [HIDDEN]);
    let gone = only_mesh.pose(&scene, &plane, DMat4::IDENTITY).unwrap();
    assert!(gone.meshes[0].positions().iter().all(|p| *p == Vec3::Y));
}

/// What rests under a flat transform is held in the space of its bone, and splats are hidden.
#[test]
fn what_is_flat_as_it_rests_is_shown_in_other_poses() {
    let moved = similarity_of(0.5, DQuat::from_rotation_x(0.3), DVec3::X);
    let bone = DMat4::from_translation(DVec3::Z) * DMat4::from_scale(DVec3::new(1.0, 2.0, 1.0));
    let plane = DMat4::from_scale(DVec3::new(1.0, 0.0, 1.0));
    let turn = |angle: f64| DMat4::from_quat(DQuat::from_euler(glam::EulerRot::YXZ, angle, 0.4, -0.8));
    for flat in [DMat4::ZERO, plane, turn(0.7) * plane * turn(1.9)] {
        let held = one_splat(Vec3::new(1.0, 2.0, 3.0), Quat::from_rotation_x(0.2), 0.3);
        let rest = Pose { bones: vec![flat], weights: vec![] };
        let hidden = Some(held.opacity_logits().to_vec());
        let attached = vec![AttachedSplats { splats: 0..1, anchor: Anchor::Bone(0), hidden }];
        let rest_surface = RestSurface { base: CORNERS.to_vec(), targets: vec![], skinning: Skinning::Bone(0) };
        let surfaces = vec![Some(rest_surface)];
        let rig = Rig::new(surfaces, attached, rest.clone(), names(&rest)).unwrap();
        let mut arrays = held.clone().into_arrays();
        arrays.opacity_logits.fill(HIDDEN);
        assert!(place(&mut arrays, 0..1, moved));
        let atlas = turned(mesh(&CORNERS, 2).atlas(), orthogonal(moved).unwrap()).unwrap();
        let point = mesh(&[moved.transform_point3(DVec3::ZERO).as_vec3(); 3], 2).with_atlas(atlas);
        let resting = scene(arrays.check().unwrap(), vec![point]);
        assert_eq!(rig.pose(&resting, &rest, moved).unwrap(), resting);
        let revealed = rig.revealed(&resting).unwrap();
        assert_eq!(revealed.splats.opacity_logits(), held.opacity_logits());
        let posed = rig.pose(&resting, &Pose { bones: vec![bone], weights: vec![] }, moved).unwrap();
        let mut expected = held.into_arrays();
        assert!(place(&mut expected, 0..1, moved * bone));
        same_splats(&posed.splats, &expected.check().unwrap(), 5e-6);
        assert_eq!(posed.splats.opacity_logits(), revealed.splats.opacity_logits());
        near(posed.meshes[0].positions()[1].as_dvec3(), (moved * bone).transform_point3(DVec3::X), 1e-6);
    }
}

/// View dependence follows the transform alone, whatever the rest pose of the bone: rotated below a node that
/// stretches, and mirrored.
#[test]
fn what_is_seen_turns_by_the_orthogonal_part_of_a_bone() {
    let seen = |bone: DMat4| {
        let splats = one_splat(Vec3::new(1.0, 2.0, 3.0), Quat::from_rotation_x(0.2), 0.3);
        let mut splats = splats.into_arrays();
        assert!(place(&mut splats, 0..1, bone));
        let positions = CORNERS.map(|p| bone.transform_point3(p.as_dvec3()).as_vec3());
        let flat = mesh(&positions, 2);
        let atlas = turned(flat.atlas(), orthogonal(bone).unwrap()).unwrap();
        let turned = Mesh::new(positions.to_vec(), flat.triangles().to_vec(), flat.corner_uvs().to_vec(), atlas);
        scene(splats.check().unwrap(), vec![turned.unwrap()])
    };
    let stretch = DMat4::from_scale(DVec3::new(1.0, 0.5, 3.0));
    let turn = DMat4::from_quat(DQuat::from_euler(glam::EulerRot::YXZ, 0.9, -0.4, 0.3));
    let mirror = DMat4::from_scale(DVec3::new(1.0, -2.0, 1.0));
    for (rest_bone, bone) in [(stretch, stretch * turn), (turn, mirror * stretch * turn), (mirror, turn * stretch)] {
        let rest_surface = RestSurface { base: CORNERS.to_vec(), targets: vec![], skinning: Skinning::Bone(0) };
        let rest = Pose { bones: vec![rest_bone], weights: vec![] };
        let attached = vec![AttachedSplats { splats: 0..1, anchor: Anchor::Bone(0), hidden: None }];
        let rig = Rig::new(vec![Some(rest_surface)], attached, rest.clone(), names(&rest)).unwrap();
        let posed = rig.pose(&seen(rest_bone), &Pose { bones: vec![bone], weights: vec![] }, DMat4::IDENTITY).unwrap();
        let expected = seen(bone);
        near(posed.splats.means()[0].as_dvec3(), expected.splats.means()[0].as_dvec3(), 3e-6);
        let [found, wanted] = [&posed, &expected].map(|scene| {
            let bands = scene.meshes[0].atlas().bands().unwrap().texels().iter().copied();
            scene.splats.sh().iter().flatten().copied().chain(bands).collect::<Vec<f32>>()
        });
        assert_eq!(found.len(), wanted.len());
        assert!(found.iter().zip(&wanted).all(|(a, b)| (a - b).abs() < 3e-6), "{found:?}, expected {wanted:?}");
    }
}

/// Splats whose own place is not known are where they would be had they been posed from the undeformed triangle.
#[test]
fn splats_without_a_place_settle_on_their_triangles() {
    let frame = Frame::of(CORNERS.map(Vec3::as_dvec3)).unwrap();
    let (scene_of, rig) = bound(ShFrame::Triangles(vec![DQuat::from_mat3(&frame.axes.transpose())]));
    let pose = |bone: DMat4| Pose { bones: vec![bone, DMat4::IDENTITY], weights: vec![0.0] };
    let turned_over =
        similarity_of(1.9, DQuat::from_euler(glam::EulerRot::YXZ, 2.0, 0.4, -0.8), DVec3::new(3., -1., 2.));
    let other = pose(similarity_of(0.6, DQuat::from_rotation_x(1.1), DVec3::Z));
    let posed = |pose: &Pose| rig.pose(&scene_of, pose, DMat4::IDENTITY).unwrap();
    let settled = |rest: Pose, mesh: Mesh| {
        let Anchor::Triangles(mut binding) = rig.attached()[0].anchor.clone() else { unreachable!() };
        let mut splats = scene_of.splats.clone().into_arrays();
        (splats.means[0], splats.log_scales[0]) = (Vec3::splat(9.0), Vec3::ONE);
        let hidden = binding.settle(&mut splats, &mesh);
        let attached = vec![AttachedSplats { splats: 0..1, anchor: Anchor::Triangles(binding), hidden }];
        let settled = Rig::new(rig.surfaces().to_vec(), attached, rest.clone(), names(&rest)).unwrap();
        let resting = scene(splats.check().unwrap(), vec![mesh]);
        assert_eq!(settled.pose(&resting, &rest, DMat4::IDENTITY).unwrap(), resting);
        (settled.pose(&resting, &other, DMat4::IDENTITY).unwrap(), resting)
    };
    let rest = posed(&pose(turned_over));
    let (elsewhere, resting) = settled(pose(turned_over), rest.meshes[0].clone());
    same_splats(&resting.splats, &rest.splats, 5e-6);
    same_splats(&elsewhere.splats, &posed(&other).splats, 5e-6);
    // On a triangle without area they are hidden until it has one.
    let (elsewhere, resting) = settled(pose(DMat4::ZERO), mesh(&[Vec3::ZERO; 3], 0));
    assert_eq!(resting.splats.opacity_logits(), [HIDDEN]);
    same_splats(&elsewhere.splats, &posed(&other).splats, 5e-6);
    assert_eq!(elsewhere.splats.opacity_logits(), scene_of.splats.opacity_logits());
}

#[test]
fn a_splat_on_a_triangle_without_area_is_not_drawn() {
    let (rest, rig) = bound(ShFrame::Bone(1));
    let flat = Pose { weights: vec![-0.5], ..rig.rest().clone() };
    let posed = rig.pose(&rest, &flat, DMat4::IDENTITY).unwrap();
    assert_eq!(posed.splats.opacity_logits(), [HIDDEN]);
}

#[test]
fn what_does_not_fit_together_is_refused() {
    let (rest, rig) = bound(ShFrame::Bone(1));
    let with = |change: &dyn Fn(&mut RestSurface, &mut AttachedSplats)| {
        let (mut rest_surface, mut attached) = (rig.surfaces()[0].clone().unwrap(), rig.attached()[0].clone());
        change(&mut rest_surface, &mut attached);
        let built = Rig::new(vec![Some(rest_surface)], vec![attached], rig.rest().clone(), names(rig.rest()));
        built.map(|_| ()).map_err(|e| e.to_string())
    };
    assert_eq!(with(&|_, _| ()), Ok(()));
    assert_eq!(
        with(&|f, _| f.skinning = Skinning::Bone(2)),
        Err("bone: expected an index below 2, found 2".to_owned())
    );
    assert!(with(&|f, _| f.targets[0].weight = 1).unwrap_err().starts_with("weight:"));
    assert!(with(&|f, _| f.targets[0].deltas.push(Vec3::X)).unwrap_err().starts_with("deltas:"));
    assert!(with(&|_, f| f.splats = 0..2).unwrap_err().starts_with("corners:"));
    assert!(with(&|_, f| f.anchor = Anchor::Bone(7)).unwrap_err().starts_with("bone:"));
    assert!(with(&|_, f| f.hidden = Some(vec![])).unwrap_err().starts_with("opacities of hidden splats:"));
    let skin =
        |width: usize, weights: &[f32]| Skinning::Skin { width, bones: vec![0; 3 * width], weights: weights.to_vec() };
    assert_eq!(with(&|f, _| f.skinning = skin(1, &[0.5; 3])), Ok(()));
    assert!(with(&|f, _| f.skinning = skin(0, &[])).unwrap_err().starts_with("bones per vertex: expected at least 1"));
    assert!(with(&|f, _| f.skinning = skin(2, &[0.5; 3])).unwrap_err().starts_with("weights of a skin:"));
    let error = with(&|f, _| f.skinning = skin(1, &[1.0, 0.0, 1.0])).unwrap_err();
    assert_eq!(error, "weights of vertex 1: expected a sum above 0, found 0");
    #[expect(clippy::reversed_empty_ranges, reason = "what is to be refused")]
    let backwards = with(&|_, f| (f.splats, f.anchor) = (1..0, Anchor::Bone(0)));
    assert_eq!(backwards, Err("splats: expected a range, found 1 to 0".to_owned()));
    let corners = |corners: [u32; 3]| {
        with(&|_, f| {
            let Anchor::Triangles(binding) = &mut f.anchor else { unreachable!() };
            binding.corners[0] = corners;
        })
    };
    assert_eq!(corners([0, 2, 3]), Err("corner: expected an index below 3, found 3".to_owned()));
    let sheared = DMat4::from_scale(DVec3::new(1.0, 2.0, 1.0));
    assert!(rig.pose(&rest, rig.rest(), sheared).unwrap_err().to_string().starts_with("moved:"));
    assert!(rig.pose(&rest, &Pose::default(), DMat4::IDENTITY).is_err());
    let none = scene(Splats::empty(3), rest.meshes.clone());
    assert!(rig.pose(&none, rig.rest(), DMat4::IDENTITY).is_err());
    let less = scene(rest.splats.clone(), vec![]);
    assert!(rig.pose(&less, rig.rest(), DMat4::IDENTITY).is_err());
}
